"""What a track and its instruments say of each other: each check against flights made to have the fault."""

from __future__ import annotations

import numpy as np
import pytest
from log_writers import ACCEL, GYRO, WXYZ, XYZ, T
from scipy.spatial.transform import Rotation

from brmgeo.flight import checks
from brmgeo.flight.readings import Imu, Odometry

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
