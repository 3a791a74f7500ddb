"""Camera geometry: signs as FLIGHT.md states them, OpenCV as oracle, and the round trip over the ground."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brmgeo.flight.camera import (
    distort,
    ground_from_pixel,
    level_from_camera,
    pixel_from_point,
    pixel_from_ray,
    ray_from_pixel,
    undistort,
    world_from_camera,
)
from brmgeo.flight.readings import Attitude, Camera

PLAIN = Camera.from_fov(640, 480, 43.0)
BENT = Camera(800, 600, 470.0, 475.0, 402.0, 296.0, (-0.12, 0.02, 0.001, -0.0008, -0.001))
angles = st.floats(-0.4, 0.4)


@given(angles, angles, st.floats(-3.0, 3.0))
def test_attitude_is_intrinsic_yaw_pitch_roll(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    assert np.allclose(Attitude(roll, pitch, yaw).matrix(), expected, atol=1e-12)


def test_positive_roll_lifts_the_left_side_and_positive_pitch_lowers_the_nose() -> None:
    left, nose = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    assert (Attitude(roll_rad=0.1).matrix() @ left)[2] > 0
    assert (Attitude(pitch_rad=0.1).matrix() @ nose)[2] < 0


def test_plain_nadir_camera_has_the_nose_at_the_image_top_and_the_right_wing_at_its_right() -> None:
    rotation = world_from_camera(Attitude(), 0.0, 0.0, math.pi / 2)  # nose to the north
    position = np.array([1000.0, 2000.0, 100.0])
    ahead = pixel_from_point(PLAIN, rotation, position, np.array([1000.0, 2010.0, 0.0]))
    east = pixel_from_point(PLAIN, rotation, position, np.array([1010.0, 2000.0, 0.0]))
    assert ahead == pytest.approx([319.5, 239.5 - PLAIN.fy * 0.1])
    assert east == pytest.approx([319.5 + PLAIN.fx * 0.1, 239.5])


def test_a_camera_with_negative_mount_pitch_looks_ahead_of_nadir() -> None:
    rotation = level_from_camera(Attitude(pitch_rad=math.radians(-16.0)), 0.0, 0.0)
    centre = ground_from_pixel(PLAIN, rotation, np.array([0.0, 0.0, 100.0]), np.array([319.5, 239.5]))
    assert centre == pytest.approx([100.0 * math.tan(math.radians(16.0)), 0.0], abs=1e-9)


def test_field_of_view_is_across_the_short_side() -> None:
    assert PLAIN.half_fov_tan == pytest.approx(math.tan(math.radians(21.5)))
    assert Camera.from_fov(480, 640, 43.0).half_fov_tan == pytest.approx(math.tan(math.radians(21.5)))
    edge = ray_from_pixel(PLAIN, np.array([319.5, -0.5]))
    assert -edge[1] == pytest.approx(math.tan(math.radians(21.5)))


@given(angles, angles, st.floats(-3.0, 3.0), st.floats(0.0, 799.0), st.floats(0.0, 599.0))
def test_ground_and_back(roll: float, pitch: float, yaw: float, u: float, v: float) -> None:
    rotation = world_from_camera(Attitude(0.02, -0.1, 0.3), roll, pitch, yaw)
    position = np.array([229000.0, 379000.0, 120.0])
    ground = ground_from_pixel(BENT, rotation, position, np.array([u, v]))
    assume(np.isfinite(ground).all() and np.hypot(*(ground - position[:2])) <= 5000.0)
    back = pixel_from_point(BENT, rotation, position, np.array([*ground, 0.0]))
    assert back == pytest.approx([u, v], abs=1e-5)


def test_projection_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-40, 40, (50, 2)), rng.uniform(0, 10, 50)]
    rotation = world_from_camera(Attitude(0.01, -0.2, 0.1), 0.05, -0.03, 0.7)
    position = np.array([3.0, -2.0, 90.0])
    vector, _ = cv2.Rodrigues(rotation.T)
    matrix = np.array([[BENT.fx, 0, BENT.cx], [0, BENT.fy, BENT.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, vector, -rotation.T @ position, matrix, np.array(BENT.distortion))
    assert np.allclose(pixel_from_point(BENT, rotation, position, points), expected[:, 0], atol=1e-6)


def test_undistort_inverts_distort_and_refuses_a_fold() -> None:
    rng = np.random.default_rng(2)
    ideal = rng.uniform(-0.8, 0.8, (200, 2))
    assert np.allclose(undistort(BENT, distort(BENT, ideal)), ideal, atol=1e-9)
    folded = Camera(800, 600, 300.0, 300.0, 399.5, 299.5, (-0.9, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="fold"):
        ray_from_pixel(folded, np.array([-0.5, -0.5]))


def test_rays_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(pixel_from_ray(PLAIN, np.array([0.1, 0.1, -1.0]))).all()
    rotation = level_from_camera(Attitude(pitch_rad=-math.pi / 2), 0.0, 0.0)  # straight ahead
    above = ground_from_pixel(PLAIN, rotation, np.array([0.0, 0.0, 50.0]), np.array([319.5, 10.0]))
    assert np.isnan(above).all()
