"""Scores are plain arithmetic on unaligned positions; each is held against a case worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brmgeo.evaluate.report import cards
from brmgeo.evaluate.scores import dead_reckoning, rmse, score, travelled_m
from brmgeo.flight.values import Estimate, Motion, Status


def estimate(t_s: float, xy: tuple[float, float], status: Status, sigma_m: float = 1.0) -> Estimate:
    return Estimate(
        t_s=t_s,
        status=status,
        mean=np.array(xy, dtype=np.float64),
        covariance=np.eye(2) * sigma_m**2,
        yaw_rad=0.0,
        yaw_sigma_rad=0.1,
        mass=1.0,
        candidates=np.zeros((0, 2)),
        candidate_mass=np.zeros(0),
        candidate_count=0,
    )


REFERENCE = np.array([[100.0, 200.0], [130.0, 200.0], [160.0, 200.0], [190.0, 200.0], [190.0, 240.0]])


def motions(turn: float = 0.7, scale: float = 1.0) -> list[Motion]:
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    steps = np.diff(REFERENCE, axis=0) @ rotation.T * scale
    first = Motion(dt_s=0.0, step_m=None, yaw_rad=None)
    return [first] + [Motion(dt_s=5.0, step_m=s, yaw_rad=0.0) for s in steps]


def test_a_flight_worked_out_by_hand() -> None:
    estimates = [
        estimate(10, (500, 500), "lost"),
        estimate(15, (131, 200), "ambiguous"),
        estimate(20, (160, 203), "converged", sigma_m=2),
        estimate(25, (190, 260), "converged", sigma_m=2),
        estimate(30, (190, 244), "converged", sigma_m=2),
    ]
    result = score(estimates, REFERENCE + [0.0, 2.0], motions(), REFERENCE)
    assert result.first_fix_s == 10
    assert result.first_fix_m == 60
    assert result.flown_m == pytest.approx(130)
    assert result.false_fixes == 1
    assert result.share_converged == pytest.approx(3 / 5)
    assert result.rmse_after_first_fix_m == pytest.approx(math.sqrt((9 + 3600 + 16) / 3))
    assert result.rmse_whole_m == pytest.approx(2)
    assert result.within_sigma == pytest.approx((0, 2 / 3, 2 / 3))
    assert result.median_after_first_fix_m == pytest.approx(4)


def test_positions_are_never_aligned_before_they_are_scored() -> None:
    shifted = [estimate(t, (x + 7, y), "converged") for t, (x, y) in enumerate(REFERENCE)]
    assert score(shifted, None, motions(), REFERENCE).rmse_after_first_fix_m == pytest.approx(7)


def test_a_flight_that_never_converges_has_no_fix_and_no_error_of_fixes() -> None:
    result = score([estimate(t, (0, 0), "ambiguous") for t in range(5)], None, motions(), REFERENCE)
    assert result.first_fix_m is None
    assert result.rmse_after_first_fix_m is None
    assert result.within_sigma is None
    assert result.share_converged == 0


def test_odometry_alone_starts_at_the_true_pose_and_keeps_its_scale_bias() -> None:
    path = dead_reckoning(motions(turn=2.0), REFERENCE)
    assert path is not None
    assert path == pytest.approx(REFERENCE)
    biased = dead_reckoning(motions(turn=2.0, scale=1.05), REFERENCE)
    assert biased is not None
    assert np.linalg.norm(biased[-1] - REFERENCE[-1]) == pytest.approx(0.05 * math.hypot(90, 40))


def test_without_odometry_there_is_no_dead_reckoning() -> None:
    none = [Motion(dt_s=5.0, step_m=None, yaw_rad=None)] * 5
    assert dead_reckoning(none, REFERENCE) is None


def test_rmse_leaves_gaps_in_the_reference_out() -> None:
    assert rmse(np.array([3.0, np.nan, 4.0])) == pytest.approx(math.sqrt(12.5))
    assert rmse(np.array([np.nan])) is None


def test_lengths_that_differ_are_refused() -> None:
    with pytest.raises(ValueError, match="do not match"):
        score([estimate(0, (0, 0), "lost")], None, motions(), REFERENCE)


def test_a_gap_in_the_reference_is_bridged_and_costs_no_figure() -> None:
    gap = REFERENCE.copy()
    gap[[0, 2]] = np.nan
    np.testing.assert_allclose(travelled_m(gap), [0, 0, 30, 60, 100])
    np.testing.assert_allclose(travelled_m(np.full((3, 2), np.nan)), 0)
    estimates = [estimate(5.0 * i, tuple(xy), "converged") for i, xy in enumerate(REFERENCE)]
    result = score(estimates, REFERENCE, motions(scale=1.05), gap)
    assert result.frames == 3
    assert result.flown_m == pytest.approx(100)
    # Odometry starts at the first true pose, here the second frame's, and knows its heading from there on.
    reckoned = dead_reckoning(motions(scale=1.05), gap)
    assert reckoned is not None
    assert np.isnan(reckoned[0]).all()
    np.testing.assert_allclose(reckoned[1:3], [[130.0, 200.0], [161.5, 200.0]], atol=1e-9)
    assert result.odometry_rmse_m == pytest.approx(math.sqrt((0.0 + 3.0**2 + (3.0**2 + 2.0**2)) / 3))


def test_the_smoothed_path_s_error_says_what_share_of_the_flight_it_holds_for() -> None:
    part = REFERENCE + [0.0, 2.0]
    part[:2] = np.nan
    estimates = [estimate(5.0 * i, (0, 0), "ambiguous") for i in range(5)]
    result = score(estimates, part, motions(), REFERENCE)
    assert result.rmse_whole_m == pytest.approx(2)
    assert result.share_smoothed == pytest.approx(3 / 5)
    labels = [words for _, words in cards(result, 0.1)]
    assert any("60 % of the frames" in words for words in labels)
    assert score(estimates, None, motions(), REFERENCE).share_smoothed is None
    assert score(estimates, np.full((5, 2), np.nan), motions(), REFERENCE).share_smoothed == 0
