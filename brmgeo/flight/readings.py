"""What a flight's instruments said, as values: camera, attitude, frames, odometry, inertial readings, reference.

Frames of reference. World is ENU, body is FLU (x nose, y left, z up), a level frame is the body turned so that z is up
and x is the heading. Angles are intrinsic yaw-pitch-roll and right-handed in FLU: positive roll lifts the left side,
positive pitch lowers the nose. The camera's optical frame has x to the image's right, y to its bottom, z into the
scene; with a mount of zeros it looks straight down and the image's top points to the nose.

Image coordinates (u, v) follow OpenCV, as calibration tools write them: pixel centres are whole numbers, so the
principal point of a perfect camera is ((width - 1) / 2, (height - 1) / 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Optical frame of a nadir camera against the body: image right = -left, image down = -nose, view = -up.
BODY_FROM_NADIR_CAMERA: FloatArray = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True)
class Attitude:
    """Roll, pitch and yaw in radians, applied as R = Rz(yaw) Ry(pitch) Rx(roll)."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0

    def matrix(self) -> FloatArray:
        """(3, 3) float64 rotation, parent_from_child."""
        sr, cr = math.sin(self.roll_rad), math.cos(self.roll_rad)
        sp, cp = math.sin(self.pitch_rad), math.cos(self.pitch_rad)
        sy, cy = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )

    def body_from_camera(self) -> FloatArray:
        """(3, 3) float64 rotation of a camera whose mount this attitude is."""
        return self.matrix() @ BODY_FROM_NADIR_CAMERA


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with OpenCV's distortion (k1, k2, p1, p2, k3); lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float) -> Camera:
        """The undistorted camera with square pixels that sees ``fov_deg`` across its short side."""
        focal = min(width, height) / 2.0 / math.tan(math.radians(fov_deg) / 2.0)
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)

    @property
    def half_fov_tan(self) -> float:
        """tan(alpha / 2) across the short side: ground half width for one metre of height."""
        if self.height <= self.width:
            return self.height / 2.0 / self.fy
        return self.width / 2.0 / self.fx

    @property
    def is_distorted(self) -> bool:
        """True when any distortion coefficient is not zero."""
        return any(self.distortion)


@dataclass(frozen=True, slots=True)
class Frame:
    """One row of frames.csv with its height resolved.

    ``true_heading_deg`` is the compass reading, clockwise from true north; None when the file has none.
    """

    t_s: float
    file: str
    agl_m: float
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    true_heading_deg: float | None = None


@dataclass(frozen=True, slots=True)
class Odometry:
    """Poses of the body (FLU) in a gravity-aligned frame, z up, of arbitrary origin and yaw.

    Attributes:
        t_s: (n,) float64, strictly increasing, seconds.
        xyz_m: (n, 3) float64.
        wxyz: (n, 4) float64 unit quaternions, odometry_from_body.
        source: the file's name, for messages and results.
        segment: (n,) int64 that grows wherever the source says it was reset: no motion is taken across. None: nothing
            is said.
        walk_m2: (n,) float64, never falling: variance per axis that the steps have gathered, without heading and
            scale; between two poses it is the difference. None: nothing is said.
    """

    t_s: FloatArray
    xyz_m: FloatArray
    wxyz: FloatArray
    source: str = ""
    segment: NDArray[np.int64] | None = None
    walk_m2: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Imu:
    """Inertial readings in the body frame (FLU): (n,) seconds, (n, 3) rad/s, (n, 3) m/s2 (at rest +9.81 on z)."""

    t_s: FloatArray
    gyro_rad_s: FloatArray
    accel_m_s2: FloatArray


@dataclass(frozen=True, slots=True)
class Altimeter:
    """Heights above ground: (n,) seconds, (n,) metres."""

    t_s: FloatArray
    agl_m: FloatArray


@dataclass(frozen=True, slots=True)
class Reference:
    """Where the aircraft really was, in the map's CRS: (n,) seconds, (n, 2) metres, (n,) metres or None.

    ``sigma_m`` is the receiver's own horizontal accuracy, (n,) metres, or None when nothing is said.
    """

    t_s: FloatArray
    xy_m: FloatArray
    alt_m: FloatArray | None = None
    sigma_m: FloatArray | None = None

    def at(self, times_s: FloatArray, max_gap_s: float = 30.0) -> FloatArray:
        """(m, 2) float64 positions at ``times_s``, linear in between; NaN outside and in gaps over ``max_gap_s``."""
        times = np.asarray(times_s, dtype=np.float64)
        xy = np.stack([np.interp(times, self.t_s, self.xy_m[:, k]) for k in range(2)], axis=-1)
        after = np.searchsorted(self.t_s, times, side="left").clip(0, len(self.t_s) - 1)
        before = (np.searchsorted(self.t_s, times, side="right") - 1).clip(0, len(self.t_s) - 1)
        unknown = (times < self.t_s[0]) | (times > self.t_s[-1])
        unknown |= self.t_s[after] - self.t_s[before] > max_gap_s
        xy[unknown] = np.nan
        return xy
