"""What a track and its instruments say of each other: each check against flights made to have the fault."""

from __future__ import annotations

import numpy as np
import pytest
from log_writers import ACCEL, GYRO, WXYZ, XYZ, T
from scipy.spatial.transform import Rotation

from brmgeo.flight import checks
from brmgeo.flight.frames import to_flu
from brmgeo.flight.readings import BODY_FROM_NADIR_CAMERA, Imu, Odometry
from brmgeo.synth.flight import (
    OdometryErrors,
    SimulationSettings,
    fly,
    lawnmower,
    odometry_of,
    random_mission,
    rectangle,
)

TRACK = Odometry(T, XYZ, WXYZ)


@pytest.mark.parametrize("lag", [-0.7, -0.1, 0.0, 0.043, 0.9])
def test_a_lag_between_clocks_is_measured(lag: float) -> None:
    rng = np.random.default_rng(3)
    gyro = np.linalg.norm(GYRO + rng.normal(0, 0.01, GYRO.shape), axis=1)
    found = checks.clock_lag_s(*checks.turn_rate(T, WXYZ), T + lag, gyro)
    assert found is not None
    assert found[0] == pytest.approx(lag, abs=0.03)


def test_no_lag_is_told_of_streams_that_do_not_resemble() -> None:
    rng = np.random.default_rng(5)
    noise = np.abs(rng.normal(0, 0.3, len(T)))
    assert checks.clock_lag_s(*checks.turn_rate(T, WXYZ), T, noise) is None
    assert checks.clock_lag_s(*checks.turn_rate(T, WXYZ), T + 500.0, noise) is None
    assert checks.clock_lag_s(T, T * 0, T, T * 0) is None


@pytest.mark.parametrize(("name", "factor"), [("rad/s", 1.0), ("deg/s", 180 / np.pi)])
@pytest.mark.parametrize(("pull", "scale"), [("m/s2", 1.0), ("g", 1 / 9.80665), ("mg", 1000 / 9.80665)])
def test_units_are_told(name: str, factor: float, pull: str, scale: float) -> None:
    imu = Imu(T, GYRO * factor, ACCEL * scale)
    assert checks.imu_units(imu, T, WXYZ) == (name, pull)
    # Without an attitude only what no aircraft does is told.
    assert checks.imu_units(imu)[0] == ("deg/s" if name == "deg/s" else None)
    assert checks.imu_units(Imu(T, GYRO * 0, ACCEL * 0), T, WXYZ) == (None, None)


def test_agreement_is_free_of_pose_and_tells_scale() -> None:
    turn = Rotation.from_euler("ZYX", [1.0, 0.2, -0.4])
    other = Odometry(T + 0.01, turn.apply(XYZ) / 1.25 + [5.0, 6.0, 7.0], WXYZ)
    rms, scale, seconds = checks.agreement_m(TRACK, other, scale=True) or (np.nan, np.nan, np.nan)
    assert (rms, scale) == pytest.approx((0.0, 1.25), abs=0.1)
    assert seconds == pytest.approx(T[-1] - T[0], abs=0.1)
    far = checks.agreement_m(TRACK, other)
    assert far is not None
    assert far[0] > 5.0
    noisy = Odometry(T, XYZ + np.random.default_rng(1).normal(0, 0.5, XYZ.shape), WXYZ)
    assert (checks.agreement_m(TRACK, noisy) or (0, 0, 0))[0] == pytest.approx(0.5 * np.sqrt(3), rel=0.1)
    assert checks.agreement_m(TRACK, Odometry(T + 1e4, XYZ, WXYZ)) is None


def test_length_leaves_out_what_lies_across_a_reset() -> None:
    jumped = XYZ.copy()
    jumped[200:] += [1000.0, 0.0, 0.0]
    segment = (np.arange(len(T)) >= 200).astype(np.int64)
    whole = checks.length_m(TRACK)
    assert whole == pytest.approx(np.linalg.norm(np.diff(XYZ, axis=0), axis=1).sum())
    step = np.linalg.norm(XYZ[200] - XYZ[199])
    assert checks.length_m(Odometry(T, jumped, WXYZ)) == pytest.approx(whole - step)
    assert checks.length_m(Odometry(T, XYZ, WXYZ, "", segment)) == pytest.approx(whole - step)


def test_the_axis_of_height_and_tilt() -> None:
    assert checks.flat_axis(XYZ) == 2
    assert checks.flat_axis(XYZ[:, [0, 2, 1]]) == 1
    assert checks.flat_axis(XYZ * 0) is None
    assert checks.median_tilt_deg(WXYZ) < 10.0
    assert checks.median_tilt_deg(WXYZ[:, [1, 0, 3, 2]]) > 150.0  # turned by half a turn about x


def flown(path: np.ndarray, seed: int, **settings: float) -> Odometry:
    """VIO of a simulated flight: body x nose, y left, z up."""
    course = fly(path, SimulationSettings(**settings), seed)  # type: ignore[arg-type]
    return odometry_of(course, OdometryErrors(), seed)


def told_in(axes: str, track: Odometry) -> Odometry:
    """The same flight as one told in other axes has it, whose own first pose is the world."""
    turn = {"flu": np.eye(3), "frd": np.diag([1.0, -1.0, -1.0]), "nadir": BODY_FROM_NADIR_CAMERA.T}[axes]
    poses = Rotation.from_matrix(turn) * Rotation.from_quat(track.wxyz[:, [1, 2, 3, 0]])
    poses = poses * Rotation.from_matrix(turn).inv()
    xyz = track.xyz_m @ turn.T
    return Odometry(track.t_s, xyz - xyz[0], poses.as_quat()[:, [3, 0, 1, 2]])


TURNING = {
    "rectangle": rectangle((0.0, 0.0), 0.4),
    "mission": random_mission((0.0, 0.0, 2000.0, 2000.0), 3),
    "lawnmower": lawnmower((0.0, 0.0, 400.0, 300.0), 75.0),
}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("path", TURNING)
def test_a_track_whose_z_axis_points_down_is_told_by_its_leaning(path: str, seed: int) -> None:
    track = flown(TURNING[path], seed)
    lean = checks.leaning(track)
    assert lean is not None
    assert lean > 0.4
    assert checks.doubtful_axes(track) == checks.doubtful_axes(told_in("flu", track)) == ""
    for axes, words in (
        ("nadir", "give axes nadir (a camera that looks down);"),
        ("frd", "give axes frd, or nadir"),
    ):
        other = told_in(axes, track)
        down = checks.leaning(other)
        assert down is not None
        assert down < -0.4
        assert words in checks.doubtful_axes(other)
        # Turned as it says, nothing is left to say, and the flight is the same again.
        xyz, wxyz = to_flu(axes, other.xyz_m, other.wxyz)  # type: ignore[arg-type]
        assert checks.doubtful_axes(Odometry(track.t_s, xyz, wxyz)) == ""
        assert xyz == pytest.approx(track.xyz_m - track.xyz_m[0], abs=1e-6)
        # A scale that is unknown changes nothing.
        assert checks.doubtful_axes(Odometry(other.t_s, other.xyz_m * 0.037, other.wxyz)) != ""


def test_a_straight_or_stabilised_track_is_asked_for_where_it_may_be_a_cameras() -> None:
    straight = flown(np.array([[0.0, 0.0], [900.0, 120.0]]), 2)
    assert checks.leaning(straight) is None
    assert checks.doubtful_axes(straight) == ""
    assert "it flies along its y axis" in checks.doubtful_axes(told_in("nadir", straight))
    # A gimbal keeps the camera level: only the way tells.
    level = flown(TURNING["lawnmower"], 1, wobble_deg=0.0, cruise_pitch_deg=0.0)
    yaw = Rotation.from_quat(level.wxyz[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, 0]
    held = Rotation.from_euler("Z", yaw[:, None]).as_quat()[:, [3, 0, 1, 2]]
    level = Odometry(level.t_s, level.xyz_m, held)
    assert checks.leaning(level) is None
    assert checks.doubtful_axes(level) == ""
    assert "give axes nadir, or flu" in checks.doubtful_axes(told_in("nadir", level))
    # Flown with its nose to the north: the way says nothing either, but that the first pose is the world.
    north = Odometry(
        level.t_s, level.xyz_m - level.xyz_m[0], np.tile([1.0, 0.0, 0.0, 0.0], (len(level.t_s), 1))
    )
    assert "it begins as its own world" in checks.doubtful_axes(north)


def test_a_mirrored_track_is_told_by_a_reference() -> None:
    track = flown(TURNING["mission"], 5).xyz_m[:, :2]
    turn = Rotation.from_euler("Z", 0.8).as_matrix()[:2, :2]
    true = track @ turn.T * 1.1 + [300.0, -20.0]
    as_it_is, mirrored = checks.mirrored_m(track, true)
    assert as_it_is == pytest.approx(0.0, abs=1e-6)
    assert mirrored > 50.0
    assert checks.mirrored_m(track * [1.0, -1.0], true) == pytest.approx((mirrored, as_it_is), abs=1e-6)
