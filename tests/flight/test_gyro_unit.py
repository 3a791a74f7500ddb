"""A gyro in degrees is told by the pictures, on a flight so calm that its rates alone say nothing."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brmgeo.flight.readings import Attitude, Camera, Imu
from brmgeo.flight.vio import GyroInDegreesError
from brmgeo.flight.vio.delay import coarse_delay

CAMERA = Camera.from_fov(128, 96, 43.0)
TIMES = np.arange(64) / 8.0


def _calm() -> tuple[Imu, Sequence[NDArray[np.uint8]]]:
    """8 s of wobbling by half a degree, and what a camera over flat ground sees of it: a shifted picture."""
    t = np.arange(1700) / 200.0 - 0.25
    roll, pitch = np.radians(0.6) * np.sin(4.1 * t), np.radians(0.6) * np.sin(5.3 * t + 1.0)
    gyro = np.stack([np.gradient(roll, t), np.gradient(pitch, t), 0.0 * t], axis=-1)
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (200, 300)).astype(np.float32), (0, 0), 1.5)
    pictures = []
    for when in TIMES:
        # Nadir: the left side up turns the view to the right, the nose down shows what lies behind higher up.
        right = CAMERA.fx * np.interp(when, t, roll)
        down = CAMERA.fy * np.interp(when, t, pitch)
        shift = np.array([[1.0, 0.0, -80.0 + right], [0.0, 1.0, -50.0 - down]])
        pictures.append(cv2.warpAffine(texture, shift, (128, 96)).astype(np.uint8))
    return Imu(t, gyro, np.tile([0.0, 0.0, 9.81], (len(t), 1))), pictures


def test_the_pictures_tell_a_gyro_in_degrees() -> None:
    imu, pictures = _calm()
    degrees = Imu(imu.t_s, np.degrees(imu.gyro_rad_s), imu.accel_m_s2)
    assert np.percentile(np.abs(degrees.gyro_rad_s), 99.0) < 4.0, "no rate that an aircraft could not have"
    assert abs(coarse_delay(TIMES, pictures, imu, CAMERA, Attitude())) < 0.03
    with pytest.raises(GyroInDegreesError, match=r"[4567]\d times as fast"):
        coarse_delay(TIMES, pictures, degrees, CAMERA, Attitude())
