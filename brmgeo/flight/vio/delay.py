"""How far the camera's clock is from the IMU's, by the pictures' shifts: coarsely, before the filter refines it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.readings import Attitude, Camera, FloatArray, Imu

MAX_DELAY_S = 1.5


class GyroInDegreesError(ValueError):
    """The gyro tells the turns that the pictures show, about 57 times over."""


def coarse_delay(
    times_s: FloatArray,
    images: Sequence[NDArray[np.uint8]],
    imu: Imu,
    camera: Camera,
    mount: Attitude,
    interval_s: float | None = None,
) -> float:
    """IMU time minus camera time in seconds, to a few hundredths, within +-``MAX_DELAY_S``; 0 where it cannot be told.

    The aircraft's wobble shifts the whole picture, and the gyro reads it as well: the shift from picture to picture (phase
    correlation: Kuglin & Hines 1975), without its slow part, is held against the gyro's at every delay. The filter's own
    estimate is fine, but it finds only delays that are short against the wobble.

    Args:
        times_s: (n,) of the pictures; images: n grey (h, w) uint8.
        camera, mount, imu: as for ``run_vio``.
        interval_s: median time between the flight's frames, where it is known; None: between these.

    Raises GyroInDegreesError where the shifts by the gyro are those of the pictures, but some 57 times as large.
    """
    n = len(images)
    if n < 30 or times_s[-1] - times_s[0] < 6.0:
        return 0.0
    factor = max(1, round(camera.width / 240))
    small = [cv2.resize(g, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA) for g in images]
    window = cv2.createHanningWindow((small[0].shape[1], small[0].shape[0]), cv2.CV_32F)
    floats = [np.asarray(g, dtype=np.float32) for g in small]
    flow = np.array([cv2.phaseCorrelate(a, b, window)[0] for a, b in itertools.pairwise(floats)]) * factor
    interval = float(np.median(np.diff(times_s))) if interval_s is None else interval_s
    half = max(2, round(1.0 / interval))
    seen = _without_slow(flow, half)
    # Pictures that jumped (a wrong peak) must not decide.
    most = 4.0 * float(np.median(np.abs(seen)))
    seen = np.clip(seen, -most, most)
    turned = np.zeros((len(imu.t_s), 3))
    turned[1:] = np.cumsum(
        0.5 * (imu.gyro_rad_s[1:] + imu.gyro_rad_s[:-1]) * np.diff(imu.t_s)[:, None], axis=0
    )
    turned = turned @ mount.body_from_camera()
    delays = np.arange(-MAX_DELAY_S, MAX_DELAY_S + 0.01, 0.02)
    fits, scales = np.empty(len(delays)), np.empty(len(delays))
    for k, delay in enumerate(delays):
        at = np.stack([np.interp(times_s + delay, imu.t_s, turned[:, c]) for c in range(3)], axis=-1)
        step = np.diff(at, axis=0)
        told = _without_slow(np.stack([-camera.fx * step[:, 1], camera.fy * step[:, 0]], axis=-1), half)
        fits[k] = (seen * told).sum() / max(float(np.sqrt((told**2).sum() * (seen**2).sum())), 1e-9)
        scales[k] = (told**2).sum() / max(float((seen * told).sum()), 1e-9)
    best, none = int(fits.argmax()), int(np.abs(delays).argmin())
    if fits[best] > 0.5 and 20.0 < scales[best] < 170.0:
        raise GyroInDegreesError(
            f"the gyro turns {scales[best]:.0f} times as fast as the pictures: it is in degrees"
        )
    sure = fits[best] > 0.5 and fits[best] > fits[none] + 0.1
    return float(delays[best]) if sure else 0.0


def _without_slow(values: FloatArray, half: int) -> FloatArray:
    # (n, 2) minus its mean over 2 half + 1 rows.
    kernel = np.ones(2 * half + 1)
    count = np.convolve(np.ones(len(values)), kernel, "same")
    return values - np.stack([np.convolve(v, kernel, "same") / count for v in values.T], axis=-1)
