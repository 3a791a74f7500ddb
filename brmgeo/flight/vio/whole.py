"""The odometry of a finished flight: a loop over ``Vio``, and what its steps are worth, evened out afterwards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brmgeo.flight.readings import Attitude, Camera, FloatArray, Imu, Odometry
from brmgeo.flight.vio.filter import VioSettings
from brmgeo.flight.vio.kernels import BS, TD
from brmgeo.flight.vio.live import Vio


@dataclass(frozen=True, slots=True)
class VioResult:
    """What the filter made of a flight, one row a frame.

    Attributes:
        odometry: poses of the body, z above ground; gravity-aligned, yaw 0 and x = y = 0 at the first frame. Its
            ``segment`` grows where the track was lost for good.
        walk_m2: (n,) variance per axis that the steps have gathered since the first frame, without heading and scale:
            the variance of a step between two frames is the difference.
        yaw_sigma_rad: (n,) of the yaw against the first frame's.
        tracks: (n,) points that tied the frame to its keyframe.
        blind: (n,) bool: bridged by the IMU alone.
        velocity_m_s: (n, 3) in the odometry frame.
        delay_s, delay_sigma_s: IMU time minus camera time, and its standard deviation.
        boresight_rad: (3,) rotation vector of the camera in the body frame on top of the stated mount, and sigma (3,).
        gyro_bias_rad_s, accel_bias_m_s2: (3,) at the end.
        high_share: mean share of points that were told to be above ground.
    """

    odometry: Odometry
    walk_m2: FloatArray
    yaw_sigma_rad: FloatArray
    tracks: NDArray[np.int64]
    blind: NDArray[np.bool_]
    velocity_m_s: FloatArray
    delay_s: float
    delay_sigma_s: float
    boresight_rad: FloatArray
    boresight_sigma_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    accel_bias_m_s2: FloatArray
    high_share: float


def run_vio(
    times_s: FloatArray,
    images: Iterable[NDArray[np.uint8]],
    agl_m: FloatArray,
    imu: Imu,
    camera: Camera,
    mount: Attitude,
    settings: VioSettings | None = None,
) -> VioResult:
    """Odometry of a flight from its images, IMU and heights.

    Args:
        times_s: (n,) float64 times of the frames, increasing, seconds.
        images: n grey frames, (h, w) uint8, raw (distorted) as the camera gives them.
        agl_m: (n,) height above ground at the frames.
        imu: readings in the body frame over the whole time.
        camera, mount: the camera and how it sits in the body.

    Raises ValueError when there are fewer than two frames or IMU readings, GyroInDegreesError where the first pictures
    tell that the gyro is not in radians.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if len(times) < 2 or len(imu.t_s) < 2:
        raise ValueError(f"{len(times)} frames and {len(imu.t_s)} IMU readings: two of each are needed")
    vio = Vio(camera, mount, settings, interval_s=float(np.median(np.diff(times))))
    steps = vio.imu(imu.t_s, imu.gyro_rad_s, imu.accel_m_s2)
    for t_s, grey, height in zip(times, images, np.asarray(agl_m, dtype=np.float64), strict=True):
        steps += vio.frame(float(t_s), grey, float(height))
    steps += vio.finish()
    assert vio.filter is not None
    high = 0.0
    for step in steps:
        high += step.high_share
    walk = _even(
        times,
        np.array([step.variance_m2 for step in steps]),
        np.array([step.keyframes for step in steps], dtype=np.int64),
        blind := np.array([step.blind for step in steps], dtype=np.bool_),
    )
    sigma = np.sqrt(np.maximum(np.diag(vio.filter.cov), 0.0))
    odometry = Odometry(
        times,
        np.array([step.pose.xyz_m for step in steps]),
        np.array([step.pose.wxyz for step in steps]),
        "embedded visual-inertial odometry",
        np.array([step.pose.segment for step in steps], dtype=np.int64),
    )
    return VioResult(
        odometry=odometry,
        walk_m2=walk + np.array([step.relief_m2 for step in steps]),
        yaw_sigma_rad=np.array([step.yaw_sigma_rad for step in steps]),
        tracks=np.array([step.tracks for step in steps], dtype=np.int64),
        blind=blind,
        velocity_m_s=np.array([step.velocity_m_s for step in steps]),
        delay_s=vio.filter.delay,
        delay_sigma_s=float(sigma[TD]),
        boresight_rad=Rotation.from_matrix(vio.filter.bore).as_rotvec(),
        boresight_sigma_rad=sigma[BS : BS + 3],
        gyro_bias_rad_s=vio.filter.gyro_bias,
        accel_bias_m_s2=vio.filter.accel_bias,
        high_share=high / len(steps),
    )


def _even(
    times: FloatArray, walk: FloatArray, key: NDArray[np.int64], blind: NDArray[np.bool_]
) -> FloatArray:
    # Within a keyframe the variance against it is no sum of steps: it rises at once and then falls with every new frame.
    # Each step bears its share of the whole, but what a blind stretch cost stays there.
    knot = np.diff(key, prepend=-1) != 0
    knot[-1] = True
    knot |= blind
    knot[:-1] |= blind[1:]
    at = np.flatnonzero(knot)
    return np.asarray(np.interp(times, times[at], np.maximum.accumulate(walk[at])))
