"""The matchers' kernels against brute force, and the laws of the belief."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from match_scene import town, view_at
from scipy.ndimage import gaussian_filter, shift

from brmgeo.errors import InputError, SettingsError
from brmgeo.flight.values import Motion
from brmgeo.match import (
    BeliefSettings,
    GroundMap,
    OdometrySettings,
    RateSettings,
    RatioSettings,
    make_matcher,
)
from brmgeo.match.belief import Belief
from brmgeo.match.candidates import RingReach, follow_pairs, ring_spans, search_ratios
from brmgeo.match.ground import DiscAreas, chords, disc_pixels
from brmgeo.match.kernels import BLOCK
from brmgeo.match.mask import MapCover, MaskTiers, mask_templates, view_points
from brmgeo.match.rates import RateLearner, Rates
from brmgeo.match.register import Registrar
from brmgeo.match.rings import RingShares, ring_loglik, view_rings
from brmgeo.match.search import search, search_tiers
from brmgeo.match.smooth import Anchor, smooth_path, solve_tridiagonal
from brmgeo.match.track import Track

RATES = Rates(0.85, 0.03, 300.0)


# --- paper ------------------------------------------------------------------------------------------------------


def test_search_equals_numpy() -> None:
    rng = np.random.default_rng(1)
    maps = rng.integers(0, 10001, (3, 150, 70)).astype(np.uint16)
    maps[1, 3, 4] = 65535
    out = np.empty((150, 70), np.uint8)
    for e1 in (0.05, 0.4, 2.9):
        n = search_ratios(maps, np.array([0.3, 0.51234, 0.2]), e1, out)
        wanted = np.array([3000, 5123, 2000])
        total = np.abs(maps.astype(np.int64) - wanted[:, None, None]).sum(axis=0)
        expected = (total < e1 * 1e4) & (maps != 65535).all(axis=0)
        assert np.array_equal(out, expected)
        assert n == expected.sum()


def ring_by_definition(dy: int, dx: int, d: float, eps: float) -> bool:
    """Whether some heading t has |dx - d cos t| < eps and |dy - d sin t| < eps, by trying many headings."""
    t = np.linspace(0, 2 * math.pi, 20001)
    return bool(((np.abs(dx - d * np.cos(t)) < eps) & (np.abs(dy - d * np.sin(t)) < eps)).any())


@pytest.mark.parametrize(("d", "eps"), [(7.3, 2.2), (3.0, 4.1), (0.0, 1.5), (9.8, 0.6)])
def test_ring_spans_hold_what_some_heading_allows(d: float, eps: float) -> None:
    spans, reach = ring_spans(d, eps)
    for dy in range(-reach, reach + 1):
        a, b, c, e = spans[dy + reach]
        for dx in range(-reach, reach + 1):
            listed = a <= dx < b or c <= dx < e
            assert listed == ring_by_definition(dy, dx, d, eps), (dy, dx)


def test_motion_scatter_equals_brute_force() -> None:
    rng = np.random.default_rng(2)
    before = (rng.random((90, 140)) < 0.004).astype(np.uint8)
    before[40, 20:60] = 1
    now = (rng.random((90, 140)) < 0.5).astype(np.uint8)
    spans, reach = ring_spans(17.4, 3.3)
    expected = np.zeros_like(now)
    for i, j in np.argwhere(before):
        for t in range(2 * reach + 1):
            y = i + t - reach
            if not 0 <= y < 90:
                continue
            for lo, hi in (spans[t, :2], spans[t, 2:]):
                expected[y, max(0, j + lo) : max(0, min(140, j + hi))] = 1
    expected &= now
    kept = RingReach((90, 140)).keep(before, spans, reach, now)
    assert np.array_equal(now, expected)
    assert kept == expected.sum() > 0


def test_pairs_follow_equation_4() -> None:
    rng = np.random.default_rng(3)
    new = np.unique(rng.integers(0, 60, (300, 2)), axis=0).astype(np.int32)
    prev = rng.integers(10, 50, (25, 2)).astype(np.int32)
    start = np.arange(0, 51, 2)
    theta = rng.uniform(-math.pi, math.pi, 50)
    row_start = np.searchsorted(new[:, 0], np.arange(61))
    pairs = np.empty((10000, 2), np.int32)
    n = follow_pairs(new[:, 0], new[:, 1], row_start, prev, start, theta, 12.0, 3.5, 10000, pairs)
    expected = set()
    for (p, (r, c)), k in itertools.product(enumerate(prev), (0, 1)):
        x, y = c + 12.0 * math.cos(theta[2 * p + k]), r - 12.0 * math.sin(theta[2 * p + k])
        expected |= {(i, p) for i, (rr, cc) in enumerate(new) if abs(cc - x) < 3.5 and abs(rr - y) < 3.5}
    assert {tuple(map(int, v)) for v in pairs[:n]} == expected
    assert len(expected) == n > 20


# --- likelihoods --------------------------------------------------------------------------------------------------


def cover_with_unknown(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    known = np.ones((45, 52), np.float32)
    known[10:25, 30:44] = 0
    known[30, 5:9] = 0.5
    built = (rng.random((45, 52)) * (rng.random((45, 52)) < 0.3)).astype(np.float32) * known
    return built, known


def llr_by_definition(view_k, view_w, built, known, at, rate, rates) -> float:  # type: ignore[no-untyped-def]
    """The formula of the module, patch by patch, for a template about cell ``at``."""
    p1, p0 = rates.hit, rates.false_alarm
    pb = min(max(rate, p0), p1)
    reach = view_k.shape[0] // 2
    total = 0.0
    for oy, ox in itertools.product(range(-reach, reach + 1), repeat=2):
        i, j = at[0] + oy, at[1] + ox
        if not (0 <= i < built.shape[0] and 0 <= j < built.shape[1]):
            continue
        k, w = view_k[oy + reach, ox + reach], view_w[oy + reach, ox + reach]
        c, m = built[i, j], known[i, j]
        p = p0 + (p1 - p0) * c / m if m > 0 else p0
        total += k * m * math.log(p / pb) + (w - k) * m * math.log((1 - p) / (1 - pb))
    return total / rates.independent_m2


def test_mask_ratio_equals_the_formula() -> None:
    scene = town(1, 600.0, 150)
    cell = 20.0
    points = view_points(view_at(scene, 1300, 5300, 0.7), cell / 2)
    built, known = cover_with_unknown(4)
    yaw = np.array([0.3, 2.5])
    templates = mask_templates(points, yaw, cell, RATES)
    reach = templates.reach
    view_k, view_w = np.zeros_like(templates.built), np.zeros_like(templates.built)
    for h in range(2):
        for f, lft, k, w in zip(points.forward, points.left, points.built, points.known):
            x = (f * math.cos(yaw[h]) - lft * math.sin(yaw[h])) / cell + reach
            y = -(f * math.sin(yaw[h]) + lft * math.cos(yaw[h])) / cell + reach
            i, j = math.floor(y), math.floor(x)
            for di, dj in itertools.product((0, 1), repeat=2):
                share = (1 - abs(y - i - di)) * (1 - abs(x - j - dj))
                view_k[h, i + di, j + dj] += share * k
                view_w[h, i + di, j + dj] += share * w
    cover = MapCover(built, known)
    keys = np.array([[0, 0, 1], [1, 1, 2], [1, 2, 3], [0, 2, 0]], np.int32)
    listed = cover.score_blocks(keys, templates)
    rng = np.random.default_rng(5)
    for n, (h, by, bx) in enumerate(keys):
        for _ in range(12):
            i, j = rng.integers(0, BLOCK, 2)
            at = (by * BLOCK + i, bx * BLOCK + j)
            if at[0] >= 45 or at[1] >= 52:
                continue
            expected = llr_by_definition(view_k[h], view_w[h], built, known, at, points.rate, RATES)
            assert listed[n, i, j] == pytest.approx(expected, abs=2e-3)


def tiers_of(
    seed: int, headings: int = 72, weight: float = 1.0, size_m: float = 700.0, count: int = 300
) -> tuple[MaskTiers, MapCover, np.ndarray]:
    """A view's tiers over a town with unknown ground in one corner, with the cover and the place of the truth."""
    scene = town(seed, size_m, count)
    ground = scene.ground(1.0)
    ground.building[:60, :90] = 255
    ground.building[round(0.62 * size_m) :] *= size_m < 1000
    cover = MapCover(*ground.coverage(5))
    truth = np.array([1000 + 0.55 * size_m, 5000 + 0.45 * size_m])
    points = view_points(view_at(scene, *truth, 0.9, missed=0.1, rng=np.random.default_rng(seed)), 2.5)
    yaw = np.arange(headings) * (2 * math.pi / headings)
    tiers = MaskTiers(points, cover, cover.coarser(), 2, 5.0, yaw, RATES, weight)
    return tiers, cover, np.array([(5000 + size_m - truth[1]) / 5, (truth[0] - 1000) / 5])


def all_blocks(cover: MapCover, headings: int) -> np.ndarray:
    h, i, j = np.mgrid[0:headings, 0 : cover.blocks[0], 0 : cover.blocks[1]]
    return np.stack([h.ravel(), i.ravel(), j.ravel()], axis=1).astype(np.int32)


def dense_ratios(tiers: MaskTiers, cover: MapCover, headings: int) -> np.ndarray:
    """(headings, rows, cols) ratios at full resolution."""
    n, m = cover.blocks
    llr = tiers.fine(all_blocks(cover, headings)).reshape(headings, n, m, BLOCK, BLOCK)
    whole = llr.transpose(0, 1, 3, 2, 4).reshape(headings, n * BLOCK, m * BLOCK)
    return np.ascontiguousarray(whole[:, : cover.shape[0], : cover.shape[1]])


@pytest.mark.parametrize("seed", [1, 2])
def test_no_place_exceeds_the_bound_of_its_ratio_feature(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MaskTiers, "PRUNE", -1.0)
    # Open ground in the south, so that the bound rules something out.
    tiers, cover, _ = tiers_of(seed, headings=36, size_m=1600.0, count=1200)
    llr = tiers.fine(all_blocks(cover, 36)).reshape(36, *cover.blocks, BLOCK, BLOCK).max(axis=(0, 3, 4))
    bound = tiers.bound.repeat(2, axis=0).repeat(2, axis=1)[: cover.blocks[0], : cover.blocks[1]]
    assert (llr <= bound + 0.02).all()
    scored = np.zeros(tiers.bound.shape, np.bool_)
    scored[tuple(tiers.places.T)] = True
    assert scored.any()
    assert not scored.all()
    assert (tiers.bound[~scored] <= MaskTiers.PRUNE).all()


@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_tiers_equal_bayes_where_all_is_scored_in_full(
    weight: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brmgeo.match.search.FINE_LEAST", 10**9)
    monkeypatch.setattr("brmgeo.match.search.FINE_MOST", 10**9)
    monkeypatch.setattr(MaskTiers, "PRUNE", -math.inf)
    tiers, cover, _ = tiers_of(4, weight=weight)
    llr = dense_ratios(tiers, cover, 72)
    one, two = (Belief(cover.shape, BeliefSettings(keep=1e-9)) for _ in range(2))
    # A second view upon the first: some ground is listed by then.
    for _ in range(2):
        gain = search(one, lambda h: llr[h].copy(), -8.0, 25.0, weight)
        assert search_tiers(two, tiers, -8.0, 25.0, weight) == pytest.approx(gain, abs=1e-3)
    np.testing.assert_allclose(dense(two), dense(one), rtol=2e-3, atol=1e-9)
    assert two.off == pytest.approx(one.off, rel=1e-3)
    assert two.rest == pytest.approx(one.rest, rel=1e-2, abs=1e-6)


@pytest.mark.parametrize("seed", [5, 7, 8, 10])
def test_tiers_find_what_a_full_search_finds(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brmgeo.match.search.FINE_LEAST", 0)
    tiers, cover, truth = tiers_of(seed)
    llr = dense_ratios(tiers, cover, 72)
    full, quick = (Belief(cover.shape, BeliefSettings()) for _ in range(2))
    gain = search(full, lambda h: llr[h].copy(), -8.0, 25.0)
    assert search_tiers(quick, tiers, -8.0, 25.0) == pytest.approx(gain, abs=0.1)
    assert quick.total() == pytest.approx(1.0, abs=1e-5)
    one, two = full.mode(8.0), quick.mode(8.0)
    assert one is not None
    assert two is not None
    assert np.hypot(*(one.mean - truth)) < 3
    np.testing.assert_allclose(two.mean, one.mean, atol=0.4)
    assert two.mass == pytest.approx(one.mass, abs=0.02)
    # Blocks with coarse ratios hold about what full ones hold: the masses differ by little in all.
    assert np.abs(dense(quick).sum(axis=0) - dense(full).sum(axis=0)).sum() < 0.1


def test_yaws_unknown_are_averaged_over() -> None:
    tiers, cover, _ = tiers_of(9, headings=36)
    log_weight = np.log(np.random.default_rng(1).dirichlet(np.ones(36)))
    scene = town(9, 700.0, 300)
    truth = (1385.0, 5315.0)
    points = view_points(view_at(scene, *truth, 0.9, missed=0.1, rng=np.random.default_rng(9)), 2.5)
    yaw = np.arange(36) * (2 * math.pi / 36)
    free = MaskTiers(points, cover, cover.coarser(), 2, 5.0, yaw, RATES, 1.0, log_weight)
    llr = tiers.fine(all_blocks(cover, 36)).reshape(36, -1, BLOCK, BLOCK).astype(np.float64)
    expected = np.log((np.exp(llr) * np.exp(log_weight)[:, None, None, None]).sum(axis=0))
    got = free.fine(np.array([[3, 1, 1], [30, 1, 1], [0, 4, 2]], np.int32))
    np.testing.assert_allclose(got[0], got[1])
    np.testing.assert_allclose(got[0], expected[cover.blocks[1] + 1], atol=1e-3)
    belief = Belief(cover.shape, BeliefSettings(headings=36))
    search_tiers(belief, free, -8.0, 25.0)
    whole = dense(belief)
    np.testing.assert_allclose(whole[0], whole[20], atol=1e-9)
    assert belief.total() == pytest.approx(1.0, abs=1e-5)


def test_unknown_ground_and_unseen_pixels_say_nothing() -> None:
    points = view_points(view_at(town(1, 600.0, 150), 1300, 5300, 0.7), 2.5)
    templates = mask_templates(points, np.array([0.4]), 5.0, RATES)
    nothing = np.zeros((64, 64), np.float32)
    score = MapCover(nothing, nothing).score_blocks(np.array([[0, 1, 1]], np.int32), templates)
    assert np.array_equal(score, np.zeros_like(score))


def test_blank_view_speaks_for_no_place() -> None:
    rng = np.random.default_rng(7)
    built = (rng.random((64, 64)) < 0.2).astype(np.float32)
    built[:, :10] = 0
    points = view_points(view_at(town(1, 600.0, 1), 1300, 5300, 0.7), 2.5)
    assert points.rate == 0
    templates = mask_templates(points, np.array([0.4]), 5.0, RATES)
    inner = np.array([[0, 1, 1], [0, 1, 2], [0, 2, 1], [0, 2, 2]], np.int32)
    score = MapCover(built, np.ones_like(built)).score_blocks(inner, templates)
    assert score.max() <= 1e-3
    assert score[3, 0, 0] < -1


def test_rings_equal_brute_force() -> None:
    view = view_at(town(2, 600.0, 200), 1300, 5320, 0.4)
    view.known[20:40, 30:90] = False
    rings = view_rings(view, 5)
    for k in range(5):
        lo, hi = view.radius_m * k / 5, view.radius_m * (k + 1) / 5
        built = n = 0
        for i, j in itertools.product(range(view.known.shape[0]), range(view.known.shape[1])):
            r = math.hypot(i + 0.5 - view.nadir_px[0], j + 0.5 - view.nadir_px[1])
            if view.known[i, j] and (lo < r <= hi or (k == 0 and r == 0)):
                n += 1
                built += view.building[i, j]
        assert rings.area_m2[k] == n
        assert rings.share[k] == pytest.approx(built / n)


@pytest.mark.parametrize("cell_px", [10, 9, 7, 1])
def test_disc_areas_equal_counting(cell_px: int) -> None:
    ground = town(3, 400.0, 120).ground(1.0 if cell_px < 9 else 0.5)
    ground.building[100:140, 100:150] = 255
    g, (h, w) = ground.gsd_m, ground.building.shape
    blocks = np.array([[0, 0], [1, 1], [1, 0]], np.int32)
    radii = np.array([7.4, 30.0, 47.0])
    areas = DiscAreas(ground, cell_px)
    areas.at_blocks(blocks, radii[:1])
    built, known = areas.at_blocks(blocks, radii)
    y, x = np.mgrid[0:h, 0:w] + 0.5
    noise = []
    for n, i, j in itertools.product(range(3), (0, 7, 15), (1, 8)):
        row, col = (blocks[n] * BLOCK + (i, j) + 0.5) * cell_px
        if row > h or col > w:
            continue
        inside = [(x - col) ** 2 + (y - row) ** 2 <= (r / g) ** 2 for r in radii]
        for k, disc in enumerate(inside):
            # A rim cuts sub-cells (and of known ground, which only divides, cells) by area, not pixel by pixel.
            assert built[k, n, i, j] == pytest.approx(
                (ground.building[disc] == 1).sum() * g * g, abs=radii[k]
            )
            assert known[k, n, i, j] == pytest.approx(
                max((ground.building[disc] != 255).sum() * g * g, built[k, n, i, j]), rel=0.07, abs=radii[k]
            )
        ring = inside[2] & ~inside[1]
        if (ground.building[ring] != 255).sum() > 3000:
            exact = (ground.building[ring] == 1).sum() / (ground.building[ring] != 255).sum()
            got = (built[2, n, i, j] - built[1, n, i, j]) / (known[2, n, i, j] - known[1, n, i, j])
            noise.append(got - exact)
    # Below the noise that no rate explains.
    assert not noise or np.sqrt(np.mean(np.square(noise))) < 0.006
    whole = DiscAreas(GroundMap(np.ones((640, 640), np.uint8), 0.0, 0.0, 0.5), 10)
    built, known = whole.at_blocks(np.array([[1, 1]], np.int32), radii[:2])
    for k in (0, 1):
        np.testing.assert_allclose(built[k], math.pi * radii[k] ** 2, rtol=1e-5)
        np.testing.assert_allclose(known[k], math.pi * radii[k] ** 2, rtol=1e-5)


def test_ring_density_is_the_student_density() -> None:
    rings = RingShares(
        np.array([0.3, 0.1, 0.6]), np.array([400.0, 1200.0, 0.0]), np.array([10.0, 20.0, 30.0])
    )
    built = np.array([[[100.0, 0.0]], [[300.0, 100.0]], [[300.0, 900.0]]], np.float32)
    known = np.array([[[400.0, 400.0]], [[1600.0, 700.0]], [[2800.0, 2800.0]]], np.float32)
    settings = RatioSettings()
    move = np.array([1e-4, 2e-4, 3e-4])
    got = ring_loglik(rings, built, known, RATES, settings, move)
    for j, used in ((0, (0, 1)), (1, (0,))):
        expected = 0.0
        for k in used:
            g = (built[k, 0, j] - (built[k - 1, 0, j] if k else 0)) / (
                known[k, 0, j] - (known[k - 1, 0, j] if k else 0)
            )
            mean = RATES.false_alarm + (RATES.hit - RATES.false_alarm) * g
            var = g * RATES.hit * (1 - RATES.hit) + (1 - g) * RATES.false_alarm * (1 - RATES.false_alarm)
            var = var * RATES.independent_m2 / rings.area_m2[k] + settings.noise**2 + move[k]
            expected += scipy.stats.t.logpdf(rings.share[k], settings.dof, mean, math.sqrt(var))
        assert got[0, j] == pytest.approx(expected, abs=1e-4)


def test_rates_follow_what_is_seen() -> None:
    learner = RateLearner(RateSettings(hit=0.85, false_alarm=0.03))
    for _ in range(150):
        learner.learn(600.0, 400.0, 1500.0, 8500.0)
    assert learner.rates.hit == pytest.approx(0.6, abs=0.08)
    assert learner.rates.false_alarm == pytest.approx(0.15, abs=0.03)
    careful = RateLearner(RateSettings(hit=0.7, false_alarm=0.04))
    for _ in range(50):
        careful.learn(990.0, 10.0, 10.0, 9990.0)
    assert (careful.rates.hit, careful.rates.false_alarm) == (0.7, 0.04)
    fixed = RateLearner(RateSettings(learn=False))
    fixed.learn(0.0, 1000.0, 1000.0, 0.0)
    assert fixed.rates.hit == RateSettings().hit


# --- belief -------------------------------------------------------------------------------------------------------


def dense(belief: Belief) -> np.ndarray:
    rows, cols = belief.grid
    out = np.zeros((belief.headings, rows * BLOCK, cols * BLOCK))
    for (h, by, bx), block in zip(belief.keys, belief.blocks):
        out[h, by * BLOCK : (by + 1) * BLOCK, bx * BLOCK : (bx + 1) * BLOCK] = block
    return out[:, : belief.shape[0], : belief.shape[1]]


def small_belief(seed: int = 0, **changes: float) -> Belief:
    belief = Belief((70, 85), BeliefSettings(headings=8, keep=1e-6, **changes))  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    llr = rng.normal(-4, 1, (8, 70, 85)).astype(np.float32)
    llr[3, 30, 40] = 14
    llr[3, 33, 41] = 13
    search(belief, lambda h: llr[h].copy(), -30.0, 25.0)
    return belief


def test_search_equals_bayes_on_the_whole_grid() -> None:
    rng = np.random.default_rng(9)
    llr = rng.normal(0, 2, (8, 70, 85))
    belief = Belief((70, 85), BeliefSettings(headings=8, keep=1e-9))
    gain = search(belief, lambda h: llr[h].astype(np.float32), -30.0, 25.0)
    expected = 0.5 / llr.size * np.exp(llr)
    total = expected.sum() + 0.5
    np.testing.assert_allclose(dense(belief), expected / total, rtol=2e-4)
    assert belief.off == pytest.approx(0.5 / total, rel=1e-4)
    assert gain == pytest.approx(math.log(total), abs=1e-4)


def test_listed_update_equals_search_where_everything_is_listed() -> None:
    one, two = small_belief(1), small_belief(1)
    one.rest = two.rest = 0.0
    rng = np.random.default_rng(10)
    llr = rng.normal(0, 2, (8, 80, 96)).astype(np.float32)
    tiles = llr.reshape(8, 5, BLOCK, 6, BLOCK).transpose(0, 1, 3, 2, 4)
    one.update(np.ascontiguousarray(tiles[tuple(one.keys.T)]), -8.0, 25.0)
    search(two, lambda h: np.ascontiguousarray(llr[h, :70, :85]), -8.0, 25.0)
    np.testing.assert_allclose(dense(one), dense(two), rtol=1e-3, atol=1e-9)
    assert one.off == pytest.approx(two.off, rel=1e-3)


def test_prediction_shifts_and_blurs_each_heading() -> None:
    belief = small_belief(2, leak_out=0.0, leak_in=0.0, heading_leak=0.0)
    before = dense(belief)
    step = np.array([5.3, -2.1])
    belief.predict(step, 1.3, 0.0)
    after = dense(belief)
    for h in range(8):
        t = 2 * math.pi * h / 8
        dx, dy = 5.3 * math.cos(t) + 2.1 * math.sin(t), 5.3 * math.sin(t) - 2.1 * math.cos(t)
        weight = before[h].sum()
        if weight < 0.2:
            continue
        rows, cols = np.mgrid[0:70, 0:85]
        for grid, move in ((rows, -dy), (cols, dx)):
            mean0, mean1 = (grid * before[h]).sum() / weight, (grid * after[h]).sum() / after[h].sum()
            assert mean1 - mean0 == pytest.approx(move, abs=0.03)
            var0 = ((grid - mean0) ** 2 * before[h]).sum() / weight
            var1 = ((grid - mean1) ** 2 * after[h]).sum() / after[h].sum()
            assert var1 - var0 == pytest.approx(1.3**2, abs=0.2)
        expected = gaussian_filter(shift(before[h], (-dy, dx), order=1), 1.3)
        assert np.abs(expected - after[h]).max() < 0.03 * after[h].max() + 0.05 * expected.max()
    assert belief.total() == pytest.approx(1.0, abs=1e-6)


OPERATION = st.tuples(st.sampled_from(["step", "gap", "update", "search", "compass"]), st.integers(0, 10**6))


@settings(max_examples=25, deadline=None)
@given(st.lists(OPERATION, min_size=1, max_size=8))
def test_belief_sums_to_one(operations: list[tuple[str, int]]) -> None:
    belief = Belief((50, 61), BeliefSettings(headings=8, max_blocks=120))
    for kind, seed in operations:
        rng = np.random.default_rng(seed)
        if kind == "step":
            belief.predict(rng.normal(0, 6, 2), rng.uniform(0, 3), rng.uniform(0, 0.3))
        elif kind == "gap":
            belief.predict_unknown(rng.uniform(0.5, 9), rng.uniform(0, 1))
        elif kind == "update":
            belief.update(rng.normal(-2, 6, belief.blocks.shape).astype(np.float32), -8.0, 25.0)
        elif kind == "search":
            search(belief, lambda h, r=rng: r.normal(-2, 4, (50, 61)).astype(np.float32), -8.0, 25.0)
        else:
            belief.weigh_headings(rng.uniform(0.01, 2, 8))
        assert belief.total() == pytest.approx(1.0, abs=1e-4)
        assert belief.off >= 0
        assert belief.rest >= -1e-9
        assert len(belief.keys) <= 120
        if len(belief.blocks):
            assert belief.blocks.min() >= 0
            assert np.array_equal(belief.index[tuple(belief.keys.T)], np.arange(len(belief.keys)))
        assert (belief.index >= 0).sum() == len(belief.keys)


def test_nothing_underflows_in_a_thousand_bad_frames() -> None:
    belief = small_belief(3)
    for _ in range(1000):
        belief.predict(np.array([1.0, 0.5]), 0.5, 0.01)
        belief.update(np.full(belief.blocks.shape, -40, np.float32), -8.0, 25.0)
    assert belief.total() == pytest.approx(1.0, abs=1e-4)
    assert belief.off + belief.rest > 0.9
    assert np.isfinite(belief.entropy())


def test_unknown_motion_spreads_within_the_radius_only() -> None:
    belief = small_belief(4, leak_in=0.0)
    belief.update(np.where(belief.blocks == belief.blocks.max(), 0.0, -60.0).astype(np.float32), -50.0, 25.0)
    belief.off, belief.rest = 0.0, 0.0
    belief.normalise()
    belief.predict_unknown(6.0, 0.0)
    marginal = dense(belief).sum(axis=0)
    rows, cols = np.nonzero(marginal > 1e-6)
    assert np.hypot(rows - 30, cols - 40).max() <= 6.0
    assert len(rows) == disc_pixels(6.0)
    assert dense(belief).sum(axis=(1, 2)).std() < 1e-4


# --- registration, track, smoother ------------------------------------------------------------------------------


def test_registration_finds_the_pose() -> None:
    scene = town(5, 600.0, 450)
    registrar = Registrar(scene.ground(0.5))
    rng = np.random.default_rng(11)
    for _ in range(4):
        pose = np.array([*rng.uniform(1200, 1400, 1), *rng.uniform(5200, 5400, 1), rng.uniform(-3, 3)])
        view = view_at(scene, *pose, missed=0.1, rng=rng, gsd_m=0.5)
        found = registrar.register(view, pose + [3.1, -2.4, 0.04], 8.0, 0.12, RATES)
        assert found is not None
        assert not found.edge
        error = found.pose - pose
        assert math.hypot(*error[:2]) < 0.6
        assert abs(error[2]) < 0.015
        assert error @ np.linalg.solve(found.covariance, error) < 16


def test_track_update_is_the_linear_gaussian_posterior() -> None:
    rng = np.random.default_rng(12)
    root = rng.normal(size=(4, 4))
    cov = root @ root.T + np.eye(4)
    noise = np.diag([1.0, 2.0, 0.1])
    track = Track(np.array([10.0, 20.0, 0.2, 0.01]), cov.copy())
    z = np.array([11.0, 19.0, 0.5])
    track.update(z, noise, 0.1)
    H = np.eye(3, 4)
    info = np.linalg.inv(cov) + H.T @ np.linalg.inv(noise) @ H
    expected = np.linalg.solve(
        info, np.linalg.solve(cov, [10.0, 20.0, 0.2, 0.01]) + H.T @ np.linalg.solve(noise, z - [0, 0, 0.1])
    )
    np.testing.assert_allclose(track.mean, expected, atol=1e-9)
    np.testing.assert_allclose(track.covariance, np.linalg.inv(info), atol=1e-9)


def test_block_tridiagonal_solver_equals_dense() -> None:
    rng = np.random.default_rng(13)
    n, m = 7, 4
    root = np.zeros((n * m, n * m))
    for i in range(n):
        root[i * m : (i + 1) * m, max(0, i - 1) * m : (i + 1) * m] = rng.normal(size=(m, m * (1 + (i > 0))))
    full = root @ root.T + np.eye(n * m)
    # A product of a lower bidiagonal matrix and its transpose is block tridiagonal.
    diag = np.stack([full[i * m : (i + 1) * m, i * m : (i + 1) * m] for i in range(n)])
    below = np.zeros((n, m, m))
    for i in range(1, n):
        below[i] = full[i * m : (i + 1) * m, (i - 1) * m : i * m]
    right = rng.normal(size=(n, m))
    x, cov = solve_tridiagonal(diag, below, right)
    np.testing.assert_allclose(x.ravel(), np.linalg.solve(full, right.ravel()), atol=1e-8)
    inverse = np.linalg.inv(full)
    for i in range(n):
        np.testing.assert_allclose(cov[i], inverse[i * m : (i + 1) * m, i * m : (i + 1) * m], atol=1e-8)


def test_smoother_recovers_scale_and_the_part_before_the_first_fix() -> None:
    n = 30
    xy = np.stack([np.arange(n) * 25.0, 40 * np.sin(np.arange(n) / 6)], axis=1)
    motions = [Motion(0.0, None, 0.3)]
    c, s = math.cos(-0.8), math.sin(-0.8)
    for d in np.diff(xy, axis=0) * 1.05:
        motions.append(Motion(5.0, np.array([c * d[0] - s * d[1], s * d[0] + c * d[1]]), 0.3, 0.05))
    anchors: list[Anchor | None] = [None] * n
    for i in range(12, n, 3):
        anchors[i] = Anchor(np.array([*xy[i], 0.3 + 0.8]), np.diag([0.25, 0.25, 1e-4]))
    anchors[20] = Anchor(np.array([xy[20, 0] + 60, xy[20, 1], 1.1]), np.diag([0.25, 0.25, 1e-4]))
    times = [5.0 * i for i in range(n)]
    path = smooth_path(times, motions, anchors, OdometrySettings())
    error = np.hypot(*(path.xy - xy).T)
    assert error.max() < 3.0
    assert (error < 3 * path.sigma_m + 0.5).all()
    assert path.sigma_m[0] > path.sigma_m[15]
    cut = [*motions]
    cut[6] = Motion(5.0, None, 0.3)
    broken = smooth_path(times, cut, anchors, OdometrySettings())
    assert np.isnan(broken.xy[:6]).all()
    assert np.isinf(broken.sigma_m[:6]).all()
    assert np.isfinite(broken.xy[6:]).all()


# --- values -------------------------------------------------------------------------------------------------------


def test_coverage_equals_counting() -> None:
    rng = np.random.default_rng(14)
    building = rng.choice(np.array([0, 1, 255], np.uint8), (23, 31), p=[0.6, 0.3, 0.1])
    built, known = GroundMap(building, 0, 0, 0.5).coverage(5)
    assert built.shape == (5, 7)
    for i, j in itertools.product(range(5), range(7)):
        cell = building[i * 5 : i * 5 + 5, j * 5 : j * 5 + 5]
        assert built[i, j] == pytest.approx((cell == 1).sum() / 25)
        assert known[i, j] == pytest.approx((cell != 255).sum() / 25)


def test_values_refuse_nonsense() -> None:
    with pytest.raises(InputError, match="no building"):
        GroundMap(np.zeros((10, 10), np.uint8), 0, 0, 0.5)
    with pytest.raises(InputError, match="found 7"):
        GroundMap(np.full((10, 10), 7, np.uint8), 0, 0, 0.5)
    with pytest.raises(InputError, match="uint8"):
        GroundMap(np.ones((10, 10), np.float32), 0, 0, 0.5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="GSD"):
        GroundMap(np.ones((10, 10), np.uint8), 0, 0, float("nan"))
    with pytest.raises(SettingsError, match="headings"):
        BeliefSettings(headings=3)
    with pytest.raises(SettingsError, match="false_alarm"):
        RateSettings(hit=0.1, false_alarm=0.5)
    with pytest.raises(SettingsError, match="paper, ratio, mask"):
        make_matcher("magic", GroundMap(np.ones((10, 10), np.uint8), 0, 0, 1.0))


def testchords_of_any_radius_are_finite_and_keep_the_area():
    # For the first ones r ** 2 (pow) is a bit less than r * r, which once made a root of a negative number.
    odd = [57.33697737834437, 31.09665930593685, 29.363052226938056, 1.5854919348047054, 38.64392663542872]
    for radius in [*odd, *np.random.default_rng(5).uniform(0.3, 60.0, 500)]:
        _first, at, weight = chords(float(radius), 5)
        assert np.isfinite(weight).all()
        ends = (
            weight[:, 0] * (at[:, 0, 1] * 5 + at[:, 0, 0]) + weight[:, 1] * (at[:, 1, 1] * 5 + at[:, 1, 0])
        ).sum()
        starts = (
            weight[:, 2] * (at[:, 2, 1] * 5 + at[:, 2, 0]) + weight[:, 3] * (at[:, 3, 1] * 5 + at[:, 3, 0])
        ).sum()
        assert ends - starts == pytest.approx(math.pi * radius**2, rel=1e-4)
