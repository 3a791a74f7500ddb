"""Steps from odometry: interpolation against scipy's slerp, laws of composition, gaps and resets, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from brmgeo.flight.motion import (
    MIN_STEP_NOISE_M,
    RESET_SPEED_M_S,
    STEP_NOISE_M,
    MotionSource,
    Pose,
    breaks,
    motions,
    poses_at,
    slerp,
    yaw_of,
)
from brmgeo.flight.readings import FloatArray, Odometry, Reference
from brmgeo.flight.values import Motion


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


# ---------------------------------------------------------------- frame by frame


def _motions_in_one_go(
    odometry: Odometry | None,
    frame_times_s: FloatArray,
    *,
    compass_yaw_rad: Sequence[float | None] | None = None,
    max_gap_s: float = 1.0,
    max_speed_m_s: float = RESET_SPEED_M_S,
    step_noise_m: float = STEP_NOISE_M,
) -> list[Motion]:
    times = np.asarray(frame_times_s, dtype=np.float64)
    n = len(times)
    compass = [None] * n if compass_yaw_rad is None else list(compass_yaw_rad)
    dt = np.diff(times, prepend=times[:1])
    if odometry is None or len(odometry.t_s) == 0:
        return [Motion(float(dt[i]), None, None, 0.0, compass[i]) for i in range(n)]

    t = odometry.t_s
    tolerance = 1e-3  # log and frame times are written with different rounding
    inside = (times >= t[0] - tolerance) & (times <= t[-1] + tolerance)
    xy = np.stack([np.interp(times, t, odometry.xyz_m[:, k]) for k in range(2)], axis=-1)
    if len(t) > 1:
        left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        share = np.clip((times - t[left]) / (t[left + 1] - t[left]), 0.0, 1.0)
        yaw = yaw_of(slerp(odometry.wxyz[left], odometry.wxyz[left + 1], share))
    else:
        yaw = np.repeat(yaw_of(odometry.wxyz), n)

    walk = None if odometry.walk_m2 is None else np.interp(times, t, odometry.walk_m2)

    starts, ends = breaks(odometry, max_gap_s, max_speed_m_s)
    # Breaks come in order and do not overlap: count those a time lies beyond, and whether it is within one.
    begun = np.searchsorted(starts, times - tolerance, side="left")
    ended = np.searchsorted(ends, times + tolerance, side="right")
    within = begun > ended

    out: list[Motion] = []
    for i in range(n):
        have_yaw = bool(inside[i] and not within[i])
        step = None
        if (
            i
            and inside[i]
            and inside[i - 1]
            and not within[i]
            and not within[i - 1]
            and ended[i] == ended[i - 1]
        ):
            step = xy[i] - xy[i - 1]
        sigma = 0.0
        if step is not None:
            sigma = step_noise_m * float(np.sqrt(max(dt[i], 0.0)))
            if walk is not None:
                sigma = float(np.sqrt(max(walk[i] - walk[i - 1], MIN_STEP_NOISE_M**2)))
        out.append(Motion(float(dt[i]), step, float(yaw[i]) if have_yaw else None, sigma, compass[i]))
    return out


@st.composite
def _broken_tracks(draw: st.DrawFn) -> tuple[Odometry, FloatArray]:
    """A track with gaps, resets and segments where they fall, and frames before, within, on and after it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(1, 60))
    gaps = rng.choice([0.1, 0.11, 0.39, 1.2, 7.0], n, p=[0.5, 0.3, 0.1, 0.05, 0.05])
    t = 5.0 + np.cumsum(gaps)
    xyz = np.cumsum(rng.normal(0.0, 1.0, (n, 3)), axis=0)
    if draw(st.booleans()):
        xyz[n // 2 :] += draw(st.sampled_from([5.0, 30.0, 500.0]))
    segment = np.cumsum(rng.random(n) < 0.05) if draw(st.booleans()) else None
    walk = np.cumsum(rng.random(n) * 1e-3) if draw(st.booleans()) else None
    wxyz = Rotation.random(n, rng=rng).as_quat()
    on = rng.choice(t, draw(st.integers(0, 10)))
    between = rng.uniform(t[0] - 2.0, t[-1] + 2.0, draw(st.integers(0, 30)))
    frames = np.sort(np.concatenate([on, on + 5e-4, between]))
    return Odometry(t, xyz, wxyz, "drawn", segment, walk), frames


def _same(ours: Motion, theirs: Motion) -> bool:
    if (ours.step_m is None) is not (theirs.step_m is None):
        return False
    same_step = (
        ours.step_m is None or theirs.step_m is None or ours.step_m.tobytes() == theirs.step_m.tobytes()
    )
    numbers = ("dt_s", "yaw_rad", "sigma_m", "compass_yaw_rad")
    return same_step and all(getattr(ours, name) == getattr(theirs, name) for name in numbers)


@settings(deadline=None, max_examples=200)
@given(_broken_tracks(), st.floats(0.05, 3.0), st.sampled_from([10.0, RESET_SPEED_M_S]))
def test_motions_frame_by_frame_are_those_of_the_whole_flight(
    flown: tuple[Odometry, FloatArray], max_gap_s: float, max_speed_m_s: float
) -> None:
    odometry, frames = flown
    compass = [None if i % 3 == 0 else 0.1 * i for i in range(len(frames))]
    for track_of in (odometry, None):
        ours = motions(
            track_of, frames, compass_yaw_rad=compass, max_gap_s=max_gap_s, max_speed_m_s=max_speed_m_s
        )
        theirs = _motions_in_one_go(
            track_of, frames, compass_yaw_rad=compass, max_gap_s=max_gap_s, max_speed_m_s=max_speed_m_s
        )
        assert len(ours) == len(theirs) == len(frames)
        assert all(_same(a, b) for a, b in zip(ours, theirs))


@settings(deadline=None, max_examples=50)
@given(_broken_tracks(), st.integers(0, 50))
def test_a_source_goes_on_from_its_state(flown: tuple[Odometry, FloatArray], cut: int) -> None:
    odometry, frames = flown
    poses = poses_at(odometry, frames)
    whole, first, second = MotionSource(), MotionSource(), MotionSource()
    expected = [whole.motion(t, pose) for t, pose in zip(frames, poses)]
    for t, pose in zip(frames[:cut], poses[:cut]):
        first.motion(t, pose)
    state = first.state()
    assert all(isinstance(value, np.ndarray) for value in state.values())
    second.restore(state)
    after = [second.motion(t, pose) for t, pose in zip(frames[cut:], poses[cut:])]
    assert all(_same(a, b) for a, b in zip(after, expected[cut:]))


def test_a_live_source_gives_no_step_faster_than_a_reset_or_across_segments() -> None:
    level = np.array([1.0, 0.0, 0.0, 0.0])
    source = MotionSource(max_speed_m_s=20.0)
    told = [
        (Pose(0.0, np.zeros(3), level), False),
        (Pose(5.0, np.array([90.0, 0.0, 0.0]), level), True),
        (Pose(10.0, np.array([290.0, 0.0, 0.0]), level), False),  # 40 m/s
        (Pose(15.0, np.array([300.0, 0.0, 0.0]), level, segment=1), False),
        (None, False),
        (Pose(25.0, np.array([301.0, 0.0, 0.0]), level, segment=1), False),
        (Pose(30.0, np.array([302.0, 0.0, 0.0]), level, segment=1), True),
    ]
    made = [source.motion(5.0 * i, pose, 0.5) for i, (pose, _) in enumerate(told)]
    assert [m.step_m is not None for m in made] == [joined for _, joined in told]
    assert [m.yaw_rad is not None for m in made] == [pose is not None for pose, _ in told]
    assert [m.dt_s for m in made] == [0.0, *[5.0] * 6]
    assert {m.compass_yaw_rad for m in made} == {0.5}


def test_poses_count_the_breaks_before_them() -> None:
    odometry = track()
    keep = (odometry.t_s < 21.0) | (odometry.t_s > 28.0)
    gappy = Odometry(odometry.t_s[keep], odometry.xyz_m[keep], odometry.wxyz[keep])
    poses = poses_at(gappy, np.array([-1.0, 0.0, 10.05, 25.0, 30.0, 59.9, 70.0]))
    assert [None if p is None else p.segment for p in poses] == [None, 0, 0, None, 1, 1, None]
    assert poses[2] is not None
    assert poses[2].xyz_m == pytest.approx((odometry.xyz_m[100] + odometry.xyz_m[101]) / 2)
    assert poses_at(None, np.arange(3.0)) == [None] * 3
