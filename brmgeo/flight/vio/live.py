"""The odometry frame by frame: readings and pictures in as they come, the newest pose out."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brmgeo.flight.frames import quaternion_from_matrix
from brmgeo.flight.motion import Pose
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Imu
from brmgeo.flight.vio.delay import MAX_DELAY_S
from brmgeo.flight.vio.filter import LEVEL_S, VioFilter, VioSettings
from brmgeo.flight.vio.kernels import TH
from brmgeo.flight.vio.warm import TimedFrame, warm_up

#: The warm start holds no more of its pictures than this.
WARM_BYTES = 256_000_000
#: The warm start waits for readings until so long after its last frame: what the clocks may differ, and some room.
READ_ON_S = MAX_DELAY_S + 0.5
#: Frames wait so long for readings that do not come; the last reading is then held.
PATIENCE_S = 3.0
#: While no frame comes readings older than this are let go: before the first one, and in a pause.
IDLE_S = 30.0


@dataclass(frozen=True, slots=True)
class VioStep:
    """What the filter made of one frame.

    Attributes:
        pose: of the body, z above ground; gravity-aligned, yaw 0 and x = y = 0 at the first frame.
        velocity_m_s: (3,) in the odometry frame.
        yaw_sigma_rad: of the yaw against the first frame's.
        tracks: points that tied the frame to its keyframe.
        blind: bridged by the IMU alone.
        high_share: share of points that were told to be above ground.
        keyframes: how many were taken so far.
        variance_m2: per axis since the first frame, by the filter; between keyframes it falls again.
        relief_m2: what the ground's unevenness adds to it.
    """

    pose: Pose
    velocity_m_s: FloatArray
    yaw_sigma_rad: float
    tracks: int
    blind: bool
    high_share: float
    keyframes: int
    variance_m2: float
    relief_m2: float


class Vio:
    """Visual-inertial odometry aboard: ``imu`` and ``frame`` as readings and pictures come, ``pose`` at any time.

    Args:
        camera, mount: the camera and how it sits in the body.
        settings: noise and thresholds.
        interval_s: median time between frames, where it is known beforehand; None: that of the first frames.
        segment: number of the first segment. A program that starts again in flight gives one that it has not had yet: its
            poses are counted from a new origin, and no motion may be taken from the old ones to them.

    When there is a pose. The warm start goes through the first ``settings.warm_s`` (20) seconds twice: their frames are
    held back, and the first pose comes when a frame and readings to ``READ_ON_S`` (2 s) beyond them are there. The call
    that brings the last of these works through all held frames two times, which takes seconds; frames that come
    meanwhile are given afterwards and are soon caught up with. With ``warm_s`` 0 the first frame has a pose as soon as
    there are readings to half a second after it, but speed, tilt and biases are learnt while flying, and a delay between
    the clocks of more than a tenth of a second is not found.

    After that a frame is finished by the first reading at or after it, on the IMU's clock. Where readings do not come
    for ``PATIENCE_S`` the last one is held. Nothing else looks ahead, so a flight given bit by bit yields what it yields
    given whole (``run_vio``), but for two things: ``Pose.walk_m2`` is the largest variance so far, which ``run_vio``
    spreads evenly between keyframes afterwards, and ``run_vio`` knows ``interval_s``.

    Memory: the frames held at the start (``WARM_BYTES`` at most, less where they come slowly), those that wait for
    readings, and readings since the newest frame or of ``IDLE_S``.
    """

    def __init__(
        self,
        camera: Camera,
        mount: Attitude,
        settings: VioSettings | None = None,
        *,
        interval_s: float | None = None,
        segment: int = 0,
    ) -> None:
        self.camera, self.mount, self.settings = camera, mount, settings or VioSettings()
        self._interval_s, self._segment = interval_s, segment
        self._filter: VioFilter | None = None
        self._newest: VioStep | None = None
        self._waiting: deque[TimedFrame] = deque()
        self._last_t = -math.inf
        self._readings: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()
        self._read_to = -math.inf
        self._walk_m2 = 0.0

    @property
    def pose(self) -> Pose | None:
        """The newest pose, of the last frame that is finished (``pose.t_s``); None until there is one."""
        return None if self._newest is None else self._newest.pose

    def pose_at(self, t_s: float) -> Pose | None:
        """The newest pose, followed through the readings to ``t_s`` seconds: of a frame that is not finished yet.

        Past the last reading it is held. None before the first pose, and for a time before the newest pose or more than
        ``PATIENCE_S`` after it.
        """
        if self._filter is None or (pose := self.pose) is None:
            return None
        if t_s == pose.t_s or not pose.t_s <= t_s <= pose.t_s + PATIENCE_S:
            return pose if t_s == pose.t_s else None
        vio = self._filter
        self._merge(vio)
        p, _, rot, *_ = vio.through_imu(vio.p, vio.v, vio.rot, vio.t, t_s + vio.delay)
        return replace(pose, t_s=t_s, xyz_m=p, wxyz=quaternion_from_matrix(rot))

    @property
    def filter(self) -> VioFilter | None:
        """The filter, for what it has learnt (delay, boresight, biases); None until it has started."""
        return self._filter

    def imu(self, t_s: ArrayLike, gyro_rad_s: ArrayLike, accel_m_s2: ArrayLike) -> list[VioStep]:
        """Take in one reading or several, in order of time; the frames that they finish, mostly none or one.

        Args:
            t_s: () or (n,) seconds.
            gyro_rad_s, accel_m_s2: (3,) or (n, 3) in the body frame (FLU).

        Raises ValueError for shapes that do not fit and times that fall; GyroInDegreesError where the first pictures tell
        that the gyro is not in radians.
        """
        t = np.array(t_s, dtype=np.float64, ndmin=1)
        gyro, accel = (np.array(a, dtype=np.float64, ndmin=2) for a in (gyro_rad_s, accel_m_s2))
        if t.ndim != 1 or gyro.shape != (len(t), 3) or accel.shape != (len(t), 3):
            raise ValueError(
                f"{np.shape(t_s)} times, {np.shape(gyro_rad_s)} turning rates, {np.shape(accel_m_s2)} accelerations: "
                "give (n,), (n, 3) and (n, 3)"
            )
        if not len(t):
            return []
        if t[0] < self._read_to or (np.diff(t) < 0.0).any():
            raise ValueError(f"the IMU's times fall at or after {t[0]:.6f} s: give readings in order of time")
        self._readings.append((t, gyro, accel))
        self._read_to = float(t[-1])
        if self._waiting:
            return self._go_on()
        if self._filter is not None:
            self._idle(self._filter)
        else:
            while self._readings[0][0][-1] < self._read_to - IDLE_S:
                self._readings.popleft()
        return []

    def frame(self, t_s: float, grey: NDArray[np.uint8], agl_m: float) -> list[VioStep]:
        """Take in one frame; the frames that are finished now, in order: none, this one, or ones before it as well.

        Args:
            t_s: seconds, more than the last frame's.
            grey: (h, w) uint8, raw (distorted) as the camera gives it; copied.
            agl_m: height above ground, metres.

        Raises ValueError for a picture that is not the camera's, a time that does not grow, and where no readings have
        come by the time the filter should start; GyroInDegreesError as ``imu``.
        """
        picture = np.array(grey)
        if picture.shape != (self.camera.height, self.camera.width) or picture.dtype != np.uint8:
            raise ValueError(
                f"a picture of {picture.shape} {picture.dtype}: give uint8 of {(self.camera.height, self.camera.width)}"
            )
        if not t_s > self._last_t:
            raise ValueError(
                f"a frame at {t_s:.6f} s after one at {self._last_t:.6f} s: give them in order of time"
            )
        self._last_t = float(t_s)
        self._waiting.append(TimedFrame(float(t_s), picture, float(agl_m)))
        return self._go_on()

    def finish(self) -> list[VioStep]:
        """The frames that still wait, with the readings there are: the flight is over."""
        return self._go_on(over=True) if self._waiting else []

    def _go_on(self, over: bool = False) -> list[VioStep]:
        done: list[VioStep] = []
        if self._filter is None:
            count = self._beginning(over)
            if count is None:
                return done
            self._filter = self._started(count)
        while self._waiting and (over or self._is_read(self._waiting[0].t_s + self._filter.delay)):
            self._merge(self._filter)
            done.append(self._taken(self._filter, self._waiting.popleft()))
        return done

    def _is_read(self, t_s: float) -> bool:
        # Whether the readings reach this time, or have been waited for in vain.
        return self._read_to >= t_s or self._last_t > t_s + PATIENCE_S

    def _beginning(self, over: bool) -> int | None:
        # How many of the waiting frames the warm start goes through; None while it has to wait.
        first = self._waiting[0].t_s
        count = sum(frame.t_s < first + self.settings.warm_s for frame in self._waiting)
        most = WARM_BYTES // self._waiting[0].grey.nbytes + 1
        if not over and count == len(self._waiting) < most:
            return None
        count = min(count, most)
        until = self._waiting[count - 1].t_s + READ_ON_S if count else first + LEVEL_S
        return count if over or self._is_read(until) else None

    def _started(self, count: int) -> VioFilter:
        imu = _joined(list(self._readings))
        if imu is None or len(imu.t_s) < 2:
            raise ValueError(f"no IMU readings have come by {self._last_t:.2f} s: they are needed to start")
        vio = VioFilter(self.camera, self.mount, imu, self.settings)
        warm_up(vio, [self._waiting[i] for i in range(count)], self._interval_s)
        self._readings.clear()
        return vio

    def _merge(self, vio: VioFilter) -> None:
        # The new readings to the filter's, which lets go of those that it has passed.
        imu = vio.imu
        if self._readings:
            joined = _joined([(imu.t_s, imu.gyro_rad_s, imu.accel_m_s2), *self._readings])
            assert joined is not None
            imu = joined
            self._readings.clear()
        if vio.started:
            kept = max(0, int(np.searchsorted(imu.t_s, vio.t, side="right")) - 1)
            imu = Imu(imu.t_s[kept:], imu.gyro_rad_s[kept:], imu.accel_m_s2[kept:])
        vio.imu = imu

    def _idle(self, vio: VioFilter) -> None:
        # No frame comes: the filter follows at a distance, so that the readings do not pile up.
        if self._read_to - IDLE_S > vio.t + 1.0:
            self._merge(vio)
            vio.advance(self._read_to - IDLE_S)

    def _taken(self, vio: VioFilter, frame: TimedFrame) -> VioStep:
        tracks, blind = vio.frame(*frame)
        variance = vio.step_variance()
        self._walk_m2 = max(self._walk_m2, variance)
        self._newest = VioStep(
            pose=Pose(
                t_s=frame.t_s,
                xyz_m=vio.p.copy(),
                wxyz=quaternion_from_matrix(vio.rot),
                segment=self._segment + vio.segment,
                walk_m2=self._walk_m2 + vio.relief_walk,
            ),
            velocity_m_s=vio.v.copy(),
            yaw_sigma_rad=math.sqrt(max(0.0, float(vio.cov[TH + 2, TH + 2]))),
            tracks=tracks,
            blind=blind,
            high_share=float(vio.high().mean()) if len(vio.points.sigma) else 0.0,
            keyframes=vio.keyframes,
            variance_m2=variance,
            relief_m2=vio.relief_walk,
        )
        return self._newest


def _joined(parts: list[tuple[FloatArray, FloatArray, FloatArray]]) -> Imu | None:
    return Imu(*(np.concatenate(column) for column in zip(*parts))) if parts else None
