"""NED/FRD to ENU/FLU and quaternions, held against matrices and scipy; the order of quaternions told from flights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brmgeo.flight import frames
from brmgeo.flight.readings import Attitude

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
FLU_FROM_NADIR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
angles = st.floats(-3.1, 3.1)
turns = st.builds(lambda y, p, r: Rotation.from_euler("ZYX", [y, p, r]), angles, st.floats(-1.5, 1.5), angles)
vectors = st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3).map(np.array)


def wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat()[..., [3, 0, 1, 2]]


def matrix(q: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(q[..., [1, 2, 3, 0]]).as_matrix()


@given(turns, vectors)
def test_an_attitude_turns_with_its_frames(turn: Rotation, v: np.ndarray) -> None:
    ned_from_frd = turn.as_matrix()
    q = frames.enu_flu_from_ned_frd(wxyz(turn))
    assert np.allclose(matrix(q), ENU_FROM_NED @ ned_from_frd @ FLU_FROM_FRD.T, atol=1e-12)
    # The law: turn a body vector and then its frame, or its frame and then itself.
    assert np.allclose(
        frames.rotate(q, frames.flu_from_frd(v)), frames.enu_from_ned(turn.apply(v)), atol=1e-8
    )
    q = frames.flu_flu_from_frd_frd(wxyz(turn))
    assert np.allclose(
        frames.rotate(q, frames.flu_from_frd(v)), frames.flu_from_frd(turn.apply(v)), atol=1e-8
    )
    for axes, flu_from_axes in (
        ("optical", FLU_FROM_OPTICAL),
        ("nadir", FLU_FROM_NADIR),
        ("frd", FLU_FROM_FRD),
    ):
        there, q = frames.to_flu(axes, turn.apply(v), wxyz(turn))
        assert np.allclose(there, flu_from_axes @ turn.apply(v), atol=1e-8)
        assert np.allclose(frames.rotate(q, flu_from_axes @ v), there, atol=1e-8)
    assert np.allclose(frames.enu_from_ned(frames.enu_from_ned(v)), v)


@given(turns, turns, vectors)
def test_quaternion_algebra_is_that_of_matrices(a: Rotation, b: Rotation, v: np.ndarray) -> None:
    qa, qb = wxyz(a), wxyz(b)
    assert np.allclose(matrix(frames.multiply(qa, qb)), (a * b).as_matrix(), atol=1e-12)
    assert np.allclose(matrix(frames.inverse(qa)), a.inv().as_matrix(), atol=1e-12)
    assert np.allclose(frames.rotate(qa, v), a.apply(v), atol=1e-8)
    assert np.allclose(
        matrix(frames.quaternion_from_matrix(a.as_matrix()[None])[0]), a.as_matrix(), atol=1e-12
    )


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_are_those_of_the_house(yaw: float, pitch: float, roll: float) -> None:
    q = frames.quaternion_from_euler(np.array(roll), np.array(pitch), np.array(yaw))
    assert np.allclose(matrix(q), Attitude(roll, pitch, yaw).matrix(), atol=1e-12)
    back = frames.euler_from_quaternion(q)
    assert np.allclose(
        matrix(frames.quaternion_from_euler(*back)), Attitude(roll, pitch, yaw).matrix(), atol=1e-7
    )


@pytest.mark.parametrize("half_turn", [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [0, 0, 0]])
def test_half_turns_have_quaternions(half_turn: list[float]) -> None:
    rotation = Rotation.from_rotvec(half_turn).as_matrix()
    assert np.allclose(matrix(frames.quaternion_from_matrix(rotation[None])[0]), rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("yaw_ned_deg", "east", "north"), [(0, 0, 1), (90, 1, 0), (180, 0, -1), (270, -1, 0)]
)
def test_plain_words(yaw_ned_deg: float, east: float, north: float) -> None:
    # A level aircraft of heading 90 in NED has its nose to the east, its left to the north, its roof upwards.
    q = frames.enu_flu_from_ned_frd(
        frames.quaternion_from_euler(np.array(0.0), np.array(0.0), np.radians(yaw_ned_deg))
    )
    assert frames.rotate(q, np.array([1.0, 0.0, 0.0])) == pytest.approx([east, north, 0.0], abs=1e-12)
    assert frames.rotate(q, np.array([0.0, 0.0, 1.0])) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)
    off = (frames.heading_deg(q) - yaw_ned_deg + 180.0) % 360.0 - 180.0
    assert off == pytest.approx(0.0, abs=1e-9)


def test_signs_of_roll_and_pitch() -> None:
    # FRD: roll right is positive, nose up is positive. FLU: left up is positive (the same), nose down is positive.
    q = frames.enu_flu_from_ned_frd(frames.quaternion_from_euler(np.array(0.1), np.array(0.2), np.array(0.3)))
    roll, pitch, yaw = frames.euler_from_quaternion(q)
    assert (roll, pitch) == pytest.approx((0.1, -0.2))
    assert yaw == pytest.approx(np.pi / 2 - 0.3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["wxyz", "xyzw"]), turns)
def test_the_order_is_told_from_a_flight_that_turns(seed: int, order: str, mount: Rotation) -> None:
    # Whatever way the IMU is built in: the world's up stays put in the body, the heading does not.
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.1, 400)) + np.linspace(0.0, 5.0, 400)
    lean = rng.normal(0, 0.04, (400, 2))
    flight = Rotation.from_euler("ZYX", np.c_[heading, lean]) * mount
    q = wxyz(flight)
    told = frames.likely_order(q if order == "wxyz" else q[:, [1, 2, 3, 0]])
    assert told in (order, None)
    if mount.magnitude() < 0.5:
        assert told == order


def test_a_straight_course_with_banking_is_not_taken_for_the_other_order() -> None:
    rng = np.random.default_rng(2)
    for bank in (0.1, 0.3):
        lean = np.c_[rng.normal(0, 0.01, 400), rng.normal(0, 0.02, 400), rng.normal(0, bank, 400)]
        q = wxyz(Rotation.from_euler("ZYX", lean))
        assert frames.likely_order(q) == "wxyz"
    q = wxyz(Rotation.from_euler("ZYX", lean / 3.0))
    assert frames.likely_order(q[:, [1, 2, 3, 0]]) is None


def test_a_sensor_that_is_built_in_upside_down_is_not_taken_for_banking() -> None:
    # The heading wanders as steep banking would: told rightly, or not at all.
    for seed in range(400):
        rng = np.random.default_rng(seed)
        heading = np.cumsum(rng.normal(0, 0.1, 400)) + np.linspace(0.0, 5.0, 400)
        flight = Rotation.from_euler("ZYX", np.c_[heading, rng.normal(0, 0.04, (400, 2))])
        mount = Rotation.from_rotvec(
            np.radians(rng.uniform(155, 180)) * np.array([1.0, 0.1, 0.0]) / np.hypot(1, 0.1)
        )
        q = wxyz(flight * mount)
        assert frames.likely_order(q) in ("wxyz", None), seed
        assert frames.likely_order(q[:, [1, 2, 3, 0]]) in ("xyzw", None), seed


def test_the_order_is_not_told_where_nothing_tells_it() -> None:
    still = np.tile([0.5, 0.5, 0.5, 0.5], (50, 1))
    assert frames.likely_order(still) is None
    level = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))
    assert frames.likely_order(level) == "wxyz"  # as xyzw it would lie upside down
    assert frames.likely_order(level[:, [1, 2, 3, 0]]) is None  # level, or level and facing the other way
