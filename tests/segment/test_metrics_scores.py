"""Scores against brute force, shapely-free geometry by hand, and the ratio kernel; calibration against known distortions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brmgeo.maps.ratio import disc_counts
from brmgeo.segment.metrics import (
    LogitHistogram,
    MaskScores,
    best_threshold,
    ring_features,
    segmentation_scores,
)


def random_frame(seed: int, shape: tuple[int, int] = (37, 52)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    label = rng.choice(np.array([0, 255, 127], np.uint8), shape, p=[0.6, 0.3, 0.1])
    return rng.random(shape, np.float32), label


@given(st.integers(0, 10_000), st.floats(0.05, 0.95))
def test_pixel_counts_are_those_of_a_loop(seed: int, threshold: float) -> None:
    probability, label = random_frame(seed, (9, 13))
    counts = {"hit": 0, "false": 0, "missed": 0, "rest": 0}
    for p, y in zip(probability.ravel().tolist(), label.ravel().tolist()):
        if y == 127:
            continue
        told, true = p > threshold, y == 255
        counts["hit" if told and true else "false" if told else "missed" if true else "rest"] += 1
    scores = segmentation_scores(probability, label, threshold, 0.5)
    assert {name: getattr(scores, name) for name in counts} == counts
    known = sum(counts.values())
    assert scores.accuracy == pytest.approx((counts["hit"] + counts["rest"]) / known)


def brute_edges(mask: np.ndarray, known: np.ndarray) -> list[tuple[int, int]]:
    h, w = mask.shape
    found = []
    for r in range(h):
        for c in range(w):
            near = [(r + a, c + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
            if mask[r, c] and any(
                0 <= i < h and 0 <= j < w and known[i, j] and not mask[i, j] for i, j in near
            ):
                found.append((r, c))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_outlines_and_their_distances_are_those_of_a_loop(seed: int) -> None:
    probability, label = random_frame(seed, (23, 31))
    known = label != 127
    estimate, truth = (probability > 0.7) & known, label == 255
    a, b = brute_edges(estimate, known), brute_edges(truth, known)
    reach = 1.0 / 0.7

    def near(points: list[tuple[int, int]], others: list[tuple[int, int]]) -> int:
        return sum(any(math.dist(p, q) <= reach for q in others) for p in points)

    scores = segmentation_scores(probability, label, 0.7, 0.7)
    assert (scores.edge_estimate, scores.edge_label) == (len(a), len(b))
    assert (scores.edge_estimate_hit, scores.edge_label_hit) == (near(a, b), near(b, a))


def test_features_are_those_of_the_ratio_kernel() -> None:
    rng = np.random.default_rng(5)
    mask = rng.random((61, 61)) < 0.4
    features = ring_features(mask, np.ones_like(mask))
    for k in (1, 2, 3):
        radius = 61 / 2 * (4 - k) / 3
        # The kernel's discs are about pixel centres; of an odd picture the middle is one.
        count = disc_counts(mask, radius)[30, 30]
        size = disc_counts(np.ones_like(mask), radius)[30, 30]
        assert features[k - 1] == pytest.approx(count / size)


def test_features_divide_by_what_is_known() -> None:
    mask, known = np.zeros((40, 40), bool), np.ones((40, 40), bool)
    mask[:, :20] = True
    known[:, 20:] = False
    assert ring_features(mask, known) == pytest.approx([1, 1, 1])
    assert np.isnan(ring_features(mask, np.zeros_like(known))).all()


def test_counts_add_up() -> None:
    parts = [segmentation_scores(*random_frame(s), 0.5, 0.5) for s in (1, 2)]
    both = parts[0] + parts[1]
    top, bottom = (np.concatenate([random_frame(1)[k], random_frame(2)[k]]) for k in (0, 1))
    assert both.hit == segmentation_scores(top, bottom, 0.5, 0.5).hit
    assert both.frames == 2
    assert sum(parts, MaskScores()) == both


def test_a_perfect_mask_scores_one_and_a_moved_one_knows_its_distance() -> None:
    label = np.zeros((80, 80), np.uint8)
    label[20:60, 30:50] = 255
    perfect = segmentation_scores((label > 0).astype(np.float32), label, 0.5, 0.3).summary()
    assert {k: v for k, v in perfect.items() if k not in ("feature_mae", "frames")} == dict.fromkeys(
        ("accuracy", "iou", "precision", "recall", "boundary_f1"), 1.0
    )
    assert perfect["feature_mae"] == 0
    moved = np.roll(label, 4, 1).astype(np.float32) / 255
    assert segmentation_scores(moved, label, 0.5, 0.3).iou == pytest.approx(16 / 24)
    assert segmentation_scores(moved, label, 0.5, 0.3, tolerance_m=1.21).boundary_f1 == 1.0
    assert segmentation_scores(moved, label, 0.5, 0.3, tolerance_m=0.5).boundary_f1 < 0.6


def test_frames_without_buildings_are_scored() -> None:
    label = np.zeros((20, 20), np.uint8)
    scores = segmentation_scores(np.full((20, 20), np.nan, np.float32), label, 0.5, 0.3)
    assert (scores.accuracy, scores.iou, scores.feature_mae) == (1.0, 1.0, 0.0)
    assert math.isnan(
        segmentation_scores(np.zeros((4, 4), np.float32), np.full((4, 4), 127, np.uint8), 0.5, 1).feature_mae
    )


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="not of one frame"):
        segmentation_scores(np.zeros((3, 4), np.float32), np.zeros((4, 3), np.uint8), 0.5, 0.3)


@pytest.fixture(scope="module")
def overconfident() -> tuple[LogitHistogram, np.ndarray, np.ndarray]:
    """Logits that are right after 0.8 is taken off and they are divided by 2.5."""
    rng = np.random.default_rng(3)
    right = rng.normal(-1.0, 1.5, 200_000)
    truth = rng.random(right.size) < 1 / (1 + np.exp(-right))
    logits = (2.5 * right + 0.8).astype(np.float32)
    histogram = LogitHistogram()
    label = np.where(truth, 255, 0).astype(np.uint8)
    histogram.add(logits[:90_000], label[:90_000])
    histogram.add(logits[90_000:], label[90_000:])
    return histogram, logits, truth


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("logit", [15.999999, 16.0, 17.0, 3e4, -16.0, -17.0])
def test_logits_beyond_the_limit_count_as_it(logit: float, dtype: type) -> None:
    histogram = LogitHistogram()
    histogram.add(np.full((3, 4), logit, dtype), np.full((3, 4), 255, np.uint8))
    assert histogram.building[-1 if logit > 0 else 0] == histogram.building.sum() == 12


def test_calibration_undoes_overconfidence_and_a_shift(
    overconfident: tuple[LogitHistogram, np.ndarray, np.ndarray],
) -> None:
    histogram, logits, truth = overconfident
    temperature, shift = histogram.calibration()
    assert temperature == pytest.approx(2.5, abs=0.05)
    assert shift == pytest.approx(-0.8, abs=0.05)
    assert histogram.calibration_error() > 0.05
    calibrated = LogitHistogram()
    calibrated.add(
        ((logits + shift) / temperature).astype(np.float32), np.where(truth, 255, 0).astype(np.uint8)
    )
    assert calibrated.calibration_error() < 0.01
    x = (logits + 0.3) / 2.0
    exact = np.mean(np.where(truth, np.logaddexp(0, -x), np.logaddexp(0, x)))
    assert histogram.entropy(2.0, 0.3) == pytest.approx(exact, abs=1e-3)


def test_threshold_is_that_of_the_best_iou(
    overconfident: tuple[LogitHistogram, np.ndarray, np.ndarray],
) -> None:
    histogram, logits, truth = overconfident
    p = 1 / (1 + np.exp(-logits.astype(np.float64)))

    def iou(threshold: float) -> float:
        return float(np.count_nonzero((p > threshold) & truth) / np.count_nonzero((p > threshold) | truth))

    best = max(iou(t) for t in np.linspace(0.02, 0.98, 97))
    threshold, reached = best_threshold([histogram])
    assert iou(threshold) == pytest.approx(best, abs=2e-3)
    assert reached == pytest.approx(iou(threshold), abs=1e-6)


def test_unknown_and_missing_pixels_count_nowhere() -> None:
    histogram = LogitHistogram()
    histogram.add(np.array([[1.0, np.nan, -99.0]], np.float32), np.array([[127, 255, 0]], np.uint8))
    assert (histogram.building.sum(), histogram.other.sum()) == (0, 1)
    assert histogram.calibration() == (1.0, 0.0)
    assert best_threshold([histogram]) == (0.5, 0.0)


def test_every_ground_has_the_same_say_about_the_threshold() -> None:
    rng = np.random.default_rng(4)

    def ground(share: float, shift: float) -> LogitHistogram:
        label = np.where(rng.random((200, 200)) < share, 255, 0).astype(np.uint8)
        logits = rng.normal(np.where(label == 255, 2.0, -2.0) + shift, 1.5).astype(np.float32)
        own = LogitHistogram()
        own.add(logits, label)
        return own

    dense, sparse, empty = ground(0.5, 1.0), ground(0.05, -0.5), LogitHistogram()
    found = best_threshold([dense, sparse, empty])[0]
    at = int(np.argmin(np.abs(1 / (1 + np.exp(-(dense.logits + 0.025))) - found)))
    mean = (dense.ious() + sparse.ious()) / 2
    assert mean[at] == pytest.approx(mean.max(), abs=1e-9)
    # All pixels in one pot ask the ground with the most building only.
    pot = LogitHistogram(dense.building + sparse.building, dense.other + sparse.other)
    assert best_threshold([pot])[0] != pytest.approx(found, abs=0.02)
    assert sparse.ious()[at] > sparse.ious()[int(np.argmax(pot.ious()))]
    assert best_threshold([empty]) == (0.5, 0.0)
