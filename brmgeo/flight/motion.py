"""Steps between frames from odometry: poses at the frames' times, and from one to the next, gaps and resets marked.

A finished track gives the poses of all frames at once (``poses_at``); an odometry that runs aboard gives the newest. A
``MotionSource`` makes steps of either, frame by frame, and ``motions`` those of a whole flight.

Between two odometry poses the position is linear and the orientation a slerp (Shoemake, 1985). A step that crosses a
gap or a reset is not given at all: the matcher then bounds the movement by speed, which is honest, while an
interpolated jump would be a guess.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.readings import FloatArray, Odometry
from brmgeo.flight.values import Motion

#: Standard deviation of a visual-inertial step per axis after one second; it grows with the root of time.
STEP_NOISE_M = 0.1
#: Odometry that moves faster than this was reset: no small aircraft does.
RESET_SPEED_M_S = 60.0
#: Not even a step that the odometry is sure of is better than this.
MIN_STEP_NOISE_M = 0.02
#: Log and frame times are written with different rounding.
TIME_TOLERANCE_S = 1e-3


@dataclass(frozen=True, slots=True)
class Pose:
    """The body's pose in the odometry frame at one time.

    Attributes:
        t_s: seconds.
        xyz_m: (3,) float64.
        wxyz: (4,) float64 unit quaternion, odometry_from_body.
        segment: grows wherever the odometry broke off: no motion is taken from one segment to another.
        walk_m2: variance per axis that the steps have gathered, as ``Odometry.walk_m2``; None: nothing is said.
    """

    t_s: float
    xyz_m: FloatArray
    wxyz: FloatArray
    segment: int = 0
    walk_m2: float | None = None


def yaw_of(wxyz: FloatArray) -> FloatArray:
    """(...,) yaw of the body's x axis in radians, counter-clockwise, from (..., 4) unit quaternions w, x, y, z."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=np.float64), -1, 0)
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))


def slerp(first: FloatArray, second: FloatArray, share: FloatArray) -> FloatArray:
    """(n, 4) unit quaternions ``share`` (n,) of the way from ``first`` to ``second`` (n, 4), along the shorter arc."""
    dot = (first * second).sum(axis=-1, keepdims=True)
    second = np.where(dot < 0.0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    share = np.asarray(share, dtype=np.float64)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.sin((1.0 - share) * angle) / np.sin(angle)
        b = np.sin(share * angle) / np.sin(angle)
    close = angle < 1e-6  # sin is linear here, and 0 / 0 at equality
    mixed = np.where(close, 1.0 - share, a) * first + np.where(close, share, b) * second
    return np.asarray(mixed / np.linalg.norm(mixed, axis=-1, keepdims=True))


def breaks(odometry: Odometry, max_gap_s: float, max_speed_m_s: float) -> tuple[FloatArray, FloatArray]:
    """(k,) start and (k,) end times of the pieces of a track that no motion may be taken across.

    A gap is longer than ``max_gap_s`` and than four times the track's median interval (a track of one pose a frame
    is whole); a reset is a jump that would need more than ``max_speed_m_s``, or a change of ``odometry.segment``.
    """
    dt = np.diff(odometry.t_s)
    if not dt.size:
        return np.empty(0), np.empty(0)
    gap = dt > max(max_gap_s, 4.0 * float(np.median(dt)))
    jump_m = np.linalg.norm(np.diff(odometry.xyz_m, axis=0), axis=1)
    # A metre of slack: at hundreds of poses a second ordinary noise is a high speed.
    reset = jump_m > max_speed_m_s * dt + 1.0
    broken = gap | reset
    if odometry.segment is not None:
        broken |= np.diff(odometry.segment) != 0
    return odometry.t_s[:-1][broken], odometry.t_s[1:][broken]


def poses_at(
    odometry: Odometry | None,
    times_s: FloatArray,
    *,
    max_gap_s: float = 1.0,
    max_speed_m_s: float = RESET_SPEED_M_S,
) -> list[Pose | None]:
    """The pose of a finished track at each time: None outside the track and within a gap or reset.

    Args:
        odometry: the track, or None: then every pose is None.
        times_s: (n,) float64, increasing.
        max_gap_s, max_speed_m_s: see ``breaks``; ``segment`` counts those that a time lies beyond.
    """
    times = np.asarray(times_s, dtype=np.float64)
    n = len(times)
    if odometry is None or len(odometry.t_s) == 0:
        return [None] * n
    t = odometry.t_s
    known = (times >= t[0] - TIME_TOLERANCE_S) & (times <= t[-1] + TIME_TOLERANCE_S)
    xyz = np.stack([np.interp(times, t, odometry.xyz_m[:, k]) for k in range(3)], axis=-1)
    if len(t) > 1:
        left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        share = np.clip((times - t[left]) / (t[left + 1] - t[left]), 0.0, 1.0)
        wxyz = slerp(odometry.wxyz[left], odometry.wxyz[left + 1], share)
    else:
        wxyz = np.repeat(odometry.wxyz, n, axis=0)
    walk = None if odometry.walk_m2 is None else np.interp(times, t, odometry.walk_m2)

    starts, ends = breaks(odometry, max_gap_s, max_speed_m_s)
    # Breaks come in order and do not overlap: count those a time lies beyond, and whether it is within one.
    begun = np.searchsorted(starts, times - TIME_TOLERANCE_S, side="left")
    ended = np.searchsorted(ends, times + TIME_TOLERANCE_S, side="right")
    known &= begun <= ended
    return [
        Pose(float(times[i]), xyz[i], wxyz[i], int(ended[i]), None if walk is None else float(walk[i]))
        if known[i]
        else None
        for i in range(n)
    ]


class MotionSource:
    """Motions frame by frame, from the poses at the frames; of what came before it keeps the last frame only.

    Args:
        max_speed_m_s: faster than this from one pose to the next, and a metre, is a reset, as in ``breaks``: no step is
            given. ``math.inf`` where ``poses_at`` has looked for resets already, pose by pose of the track.
        step_noise_m: standard deviation of a step of one second per axis; ``sigma_m`` grows with the root of time. Poses
            that say themselves what their steps are worth (``walk_m2``) are believed instead.
    """

    def __init__(self, *, max_speed_m_s: float = RESET_SPEED_M_S, step_noise_m: float = STEP_NOISE_M) -> None:
        self.max_speed_m_s, self.step_noise_m = max_speed_m_s, step_noise_m
        self._t_s: float | None = None
        self._pose: Pose | None = None

    def motion(self, t_s: float, pose: Pose | None, compass_yaw_rad: float | None = None) -> Motion:
        """The motion from the frame before to the frame at ``t_s``.

        Args:
            t_s: time of the frame, seconds.
            pose: the body's pose then, in the odometry frame; None where there is none.
            compass_yaw_rad: yaw in the map frame from a trusted compass, or None.

        The first Motion has ``dt_s`` 0 and no step. A step is None where either frame has no pose, from one segment to
        another, and across a reset. The yaw is the pose's: after a reset it may be counted from a new origin.
        """
        dt = 0.0 if self._t_s is None else float(t_s - self._t_s)
        before, self._t_s, self._pose = self._pose, t_s, pose
        if pose is None:
            return Motion(dt, None, None, 0.0, compass_yaw_rad)
        step, sigma = None, 0.0
        if before is not None and self._joined(before, pose):
            step = pose.xyz_m[:2] - before.xyz_m[:2]
            if pose.walk_m2 is None or before.walk_m2 is None:
                sigma = self.step_noise_m * math.sqrt(max(dt, 0.0))
            else:
                sigma = math.sqrt(max(pose.walk_m2 - before.walk_m2, MIN_STEP_NOISE_M**2))
        return Motion(dt, step, float(yaw_of(pose.wxyz)), sigma, compass_yaw_rad)

    def _joined(self, before: Pose, pose: Pose) -> bool:
        if before.segment != pose.segment:
            return False
        if math.isinf(self.max_speed_m_s):
            return True
        moved_m = float(np.linalg.norm(pose.xyz_m - before.xyz_m))
        return moved_m <= self.max_speed_m_s * (pose.t_s - before.t_s) + 1.0

    def state(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        """What the next motion depends on, by name: numbers as arrays of no dimension. Empty before the first frame."""
        out: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {}
        if self._t_s is not None:
            out["t_s"] = np.array(self._t_s, dtype=np.float64)
        if (pose := self._pose) is not None:
            out["pose_t_s"] = np.array(pose.t_s, dtype=np.float64)
            out["pose_xyz_m"] = np.array(pose.xyz_m, dtype=np.float64)
            out["pose_wxyz"] = np.array(pose.wxyz, dtype=np.float64)
            out["pose_segment"] = np.array(pose.segment, dtype=np.int64)
            if pose.walk_m2 is not None:
                out["pose_walk_m2"] = np.array(pose.walk_m2, dtype=np.float64)
        return out

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Goes on from what ``state`` gave: the motions that follow are those of the source it was taken from."""
        self._t_s = float(state["t_s"]) if "t_s" in state else None
        self._pose = None
        if "pose_t_s" in state:
            self._pose = Pose(
                float(state["pose_t_s"]),
                np.array(state["pose_xyz_m"], dtype=np.float64),
                np.array(state["pose_wxyz"], dtype=np.float64),
                int(state["pose_segment"]),
                float(state["pose_walk_m2"]) if "pose_walk_m2" in state else None,
            )


def motions(
    odometry: Odometry | None,
    frame_times_s: FloatArray,
    *,
    compass_yaw_rad: Sequence[float | None] | None = None,
    max_gap_s: float = 1.0,
    max_speed_m_s: float = RESET_SPEED_M_S,
    step_noise_m: float = STEP_NOISE_M,
) -> list[Motion]:
    """One Motion a frame of a whole flight: the step from the frame before it, and the yaw at it.

    Args:
        odometry: the track, or None: then every step and yaw is None and only time passes.
        frame_times_s: (n,) float64, increasing.
        compass_yaw_rad: (n,) yaw in the map frame from a trusted compass, or None.
        max_gap_s, max_speed_m_s: see ``breaks``.
        step_noise_m: see ``MotionSource``.

    A step is None outside the track and across a gap or reset; the yaw is None outside the track and within a gap.
    """
    times = np.asarray(frame_times_s, dtype=np.float64)
    poses = poses_at(odometry, times, max_gap_s=max_gap_s, max_speed_m_s=max_speed_m_s)
    compass = [None] * len(times) if compass_yaw_rad is None else list(compass_yaw_rad)
    # The track's own poses, far closer together than frames, have told where it was reset.
    source = MotionSource(max_speed_m_s=math.inf, step_noise_m=step_noise_m)
    return [source.motion(float(times[i]), poses[i], compass[i]) for i in range(len(times))]
