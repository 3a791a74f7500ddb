"""Steps from odometry: interpolation against scipy's slerp, laws of composition, gaps and resets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from brmgeo.flight.motion import motions, slerp, yaw_of
from brmgeo.flight.readings import Odometry, Reference


def track(seconds: float = 60.0, rate: float = 10.0) -> Odometry:
    t = np.arange(0.0, seconds, 1.0 / rate)
    yaw = 0.05 * t
    rotation = Rotation.from_euler("ZYX", np.stack([yaw, 0.05 * np.sin(t), 0.04 * np.cos(t)], -1)).as_quat()
    xyz = np.stack([5.0 * t, 10.0 * np.sin(t / 9.0), np.full_like(t, 2.0)], -1)
    return Odometry(t, xyz, rotation[:, [3, 0, 1, 2]])


def test_slerp_and_yaw_agree_with_scipy() -> None:
    rng = np.random.default_rng(5)
    pairs = Rotation.random(40, rng=rng).as_quat().reshape(20, 2, 4)
    share = rng.random(20)
    ours = slerp(pairs[:, 0][:, [3, 0, 1, 2]], pairs[:, 1][:, [3, 0, 1, 2]], share)
    for (a, b), s, q in zip(pairs, share, ours):
        expected = Slerp([0.0, 1.0], Rotation.from_quat([a, b]))(s)
        assert (expected.inv() * Rotation.from_quat(q[[1, 2, 3, 0]])).magnitude() < 1e-7
        assert yaw_of(q) == pytest.approx(math.atan2(*expected.as_matrix()[[1, 0], 0]), abs=1e-9)


def test_steps_add_up_and_yaw_follows() -> None:
    odometry = track()
    times = np.array([0.0, 4.97, 10.03, 33.333, 59.9])
    steps = motions(odometry, times)
    assert steps[0].step_m is None
    assert steps[0].dt_s == 0.0
    total = np.sum([m.step_m for m in steps[1:] if m.step_m is not None], axis=0)
    assert total == pytest.approx(odometry.xyz_m[-1, :2] - odometry.xyz_m[0, :2], abs=1e-9)
    assert [m.yaw_rad for m in steps] == pytest.approx(0.05 * times, abs=2e-3)
    assert [m.dt_s for m in steps[1:]] == pytest.approx(np.diff(times))


def test_turning_the_odometry_frame_turns_the_steps() -> None:
    odometry, times = track(), np.arange(0.0, 60.0, 5.0)
    turn = Rotation.from_euler("z", 1.1)
    wxyz = (turn * Rotation.from_quat(odometry.wxyz[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    turned = Odometry(odometry.t_s, turn.apply(odometry.xyz_m) + [100.0, -7.0, 3.0], wxyz)
    for a, b in zip(motions(odometry, times)[1:], motions(turned, times)[1:]):
        assert a.step_m is not None
        assert b.step_m == pytest.approx(turn.apply([*a.step_m, 0.0])[:2], abs=1e-9)
        assert a.yaw_rad is not None
        assert b.yaw_rad is not None
        assert math.remainder(b.yaw_rad - a.yaw_rad - 1.1, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_a_gap_hides_the_steps_across_it_only() -> None:
    odometry = track()
    keep = (odometry.t_s < 21.0) | (odometry.t_s > 28.0)
    gappy = Odometry(odometry.t_s[keep], odometry.xyz_m[keep], odometry.wxyz[keep])
    steps = motions(gappy, np.arange(0.0, 60.0, 5.0))
    assert [m.step_m is None for m in steps] == [True, *[False] * 4, True, True, *[False] * 5]
    assert [m.yaw_rad is None for m in steps] == [i == 5 for i in range(12)]


def test_a_reset_hides_the_step_across_it_only() -> None:
    odometry = track()
    xyz = odometry.xyz_m.copy()
    xyz[odometry.t_s >= 22.0] -= xyz[220]
    steps = motions(Odometry(odometry.t_s, xyz, odometry.wxyz), np.arange(0.0, 60.0, 5.0))
    assert [i for i, m in enumerate(steps) if m.step_m is None] == [0, 5]


def test_one_pose_a_frame_is_no_gap() -> None:
    times = np.arange(0.0, 60.0, 5.0)
    odometry = track()
    sparse = Odometry(odometry.t_s[::50], odometry.xyz_m[::50], odometry.wxyz[::50])
    assert all(m.step_m is not None for m in motions(sparse, times)[1:])


def test_outside_the_track_nothing_is_known() -> None:
    steps = motions(track(), np.array([-10.0, -5.0, 3.0, 8.0, 70.0]))
    assert [m.step_m is None for m in steps] == [True, True, True, False, True]
    assert [m.yaw_rad is None for m in steps] == [True, True, False, False, True]


def test_no_odometry_only_passes_time_and_a_compass_is_handed_on() -> None:
    steps = motions(None, np.array([0.0, 5.0, 11.0]), compass_yaw_rad=[0.1, None, 0.3])
    assert [m.dt_s for m in steps] == [0.0, 5.0, 6.0]
    assert all(m.step_m is None and m.yaw_rad is None for m in steps)
    assert [m.compass_yaw_rad for m in steps] == [0.1, None, 0.3]


def test_a_single_frame_and_a_single_pose() -> None:
    assert len(motions(track(), np.array([5.0]))) == 1
    one = track()
    single = Odometry(one.t_s[:1], one.xyz_m[:1], one.wxyz[:1])
    steps = motions(single, np.array([0.0, 5.0]))
    assert steps[0].yaw_rad is not None
    assert steps[1].step_m is None


def test_noise_grows_with_the_root_of_time() -> None:
    steps = motions(track(), np.array([0.0, 4.0, 20.0]), step_noise_m=0.1)
    assert [m.sigma_m for m in steps] == pytest.approx([0.0, 0.2, 0.4])


def test_reference_is_unknown_outside_and_in_gaps() -> None:
    reference = Reference(np.array([0.0, 10.0, 100.0]), np.array([[0.0, 0.0], [10.0, 20.0], [0.0, 0.0]]))
    xy = reference.at(np.array([-1.0, 0.0, 5.0, 10.0, 50.0, 100.0, 101.0]))
    assert np.isnan(xy[[0, 4, 6]]).all()
    assert xy[[1, 2, 3, 5]] == pytest.approx(np.array([[0, 0], [5, 10], [10, 20], [0, 0]]))
