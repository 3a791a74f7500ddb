"""Where training tiles lie, their splits, labels, faults and statistics, held against brute force and shapely."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_OTHER as OTHER
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.segment.tiles import (
    Tally,
    cells,
    make_label,
    one_split,
    picture_fault,
    sample_empty,
    shares,
    spatial_splits,
    tile_fault,
    tile_windows,
)

BOUNDS = (180_460.0, 456_580.0, 181_960.0, 457_680.0)


@settings(deadline=None)
@given(
    st.tuples(st.integers(1, 900), st.integers(1, 900)),
    st.sampled_from([64, 128, 256]).flatmap(
        lambda tile: st.tuples(st.just(tile), st.integers(0, min(tile - 1, 200)))
    ),
)
def test_tiles_cover_everything_and_overlap_at_least_as_set(
    shape: tuple[int, int], sizes: tuple[int, int]
) -> None:
    tile, overlap = sizes
    windows = tile_windows(shape, tile, overlap)
    covered = np.zeros(shape, bool)
    for w in windows:
        assert (w.height, w.width) == (tile, tile)
        assert w.row >= 0
        assert w.col >= 0
        assert w.row + tile <= max(shape[0], tile)
        assert w.col + tile <= max(shape[1], tile)
        covered[w.slices] = True
    assert covered.all()
    assert len({(w.row, w.col) for w in windows}) == len(windows)
    for starts in ({w.row for w in windows}, {w.col for w in windows}):
        steps = np.diff(sorted(starts))
        assert (steps <= tile - overlap).all()
        assert (steps[:-1] == tile - overlap).all()  # only the last one is moved inwards


@pytest.mark.parametrize("overlap", [-1, 64, 65, 200])
def test_tiles_that_would_overlap_by_all_of_themselves_are_refused(overlap: int) -> None:
    with pytest.raises(ValueError, match="cannot overlap"):
        tile_windows((300, 200), 64, overlap)


@pytest.mark.parametrize("guard", [0.0, 20.0, 75.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tiles_of_different_splits_are_a_guard_band_apart(seed: int, guard: float) -> None:
    splits = spatial_splits(BOUNDS, 300.0, guard, 0.2, 0.2, seed)
    own: dict[str, list[shapely.Polygon]] = {}
    lost = 0
    for side in (60.0, 120.0):
        for x in np.arange(BOUNDS[0], BOUNDS[2] - side, 43.0):
            for y in np.arange(BOUNDS[1], BOUNDS[3] - side, 43.0):
                name = splits.of((x, y, x + side, y + side))
                if name is None:
                    lost += 1
                else:
                    own.setdefault(name, []).append(shapely.box(x, y, x + side, y + side))
    assert set(own) == {"train", "validation", "test"}
    assert lost > 0
    for a, b in combinations(own.values(), 2):
        assert shapely.distance(shapely.union_all(a), shapely.union_all(b)) >= guard - 1e-6
    # What is inside one block and clear of its borders always belongs to it.
    for i, name in enumerate(splits.names):
        left, bottom, right, top = splits.block(i)
        inner = guard / 2 + 0.01
        assert splits.of((left + inner, bottom + inner, right - inner, top - inner)) == name


def test_splits_follow_their_shares_and_seed() -> None:
    whole = spatial_splits((0.0, 0.0, 5000.0, 4000.0), 200.0, 20.0, 0.15, 0.1, 3)
    assert len(whole.names) == 25 * 20
    assert whole.names.count("validation") == 75
    assert whole.names.count("test") == 50
    assert whole == spatial_splits((0.0, 0.0, 5000.0, 4000.0), 200.0, 20.0, 0.15, 0.1, 3)
    assert whole.names != spatial_splits((0.0, 0.0, 5000.0, 4000.0), 200.0, 20.0, 0.15, 0.1, 4).names
    small = spatial_splits((0.0, 0.0, 900.0, 300.0), 300.0, 20.0, 0.01, 0.0)
    assert sorted(small.names) == ["train", "train", "validation"]
    assert set(spatial_splits((0.0, 0.0, 300.0, 300.0), 300.0, 20.0, 0.5, 0.5).names) == {"train"}


def test_ground_beyond_the_blocks_belongs_to_the_nearest() -> None:
    splits = one_split(BOUNDS, "test")
    assert splits.of((BOUNDS[0] - 500, BOUNDS[1], BOUNDS[0] - 400, BOUNDS[3])) == "test"


def test_cells_tile_the_bounds_once() -> None:
    parts = [shapely.box(*c) for c in cells(BOUNDS, 260.0)]
    assert len(parts) == 6 * 4
    assert shapely.union_all(parts).area == pytest.approx(1500 * 1100)
    assert sum(p.area for p in parts) == pytest.approx(1500 * 1100)


def test_labels_know_what_nobody_knows() -> None:
    mask = np.array([[0, 1, 255], [0, 1, 255]], np.uint8)
    seen = np.array([[True, True, True], [False, False, False]])
    label = make_label(mask, seen)
    assert label.tolist() == [[OTHER, BUILDING, UNKNOWN], [UNKNOWN, UNKNOWN, UNKNOWN]]
    assert shares(label) == (0.5, 2 / 6)
    assert shares(np.full((4, 4), UNKNOWN, np.uint8)) == (0.0, 0.0)


def test_blank_and_cloudy_pictures_are_found_and_white_roofs_are_not_clouds() -> None:
    rng = np.random.default_rng(5)
    seen = np.ones((64, 64), bool)
    field = np.clip(rng.normal((110, 125, 80), 9, (64, 64, 3)), 0, 255).astype(np.uint8)
    assert picture_fault(field, seen, seen) is None
    assert picture_fault(np.full((64, 64, 3), 229, np.uint8), seen, seen) == "blank"
    assert picture_fault(np.full((64, 64, 3), (90, 110, 70), np.uint8), seen) == "blank"
    half = field.copy()
    half[:, :20] = 0
    part = seen.copy()
    part[:, :20] = False
    assert picture_fault(half, part, part) is None
    assert picture_fault(half, np.zeros_like(seen)) == "blank"
    cloud = field.copy()
    cloud[:, :40] = np.clip(rng.normal(236, 3, (64, 40, 1)), 0, 255)
    assert picture_fault(cloud, seen, seen) == "cloudy"
    assert picture_fault(cloud, seen, seen, cloud_share=0.7) is None
    roof = seen.copy()
    roof[:, :40] = False  # the same white, but the map says it is a building
    assert picture_fault(cloud, seen, roof) is None


def test_a_tile_is_left_out_for_what_is_unknown_blank_or_cloudy() -> None:
    rng = np.random.default_rng(6)
    field = np.clip(rng.normal((110, 125, 80), 9, (16, 16, 3)), 0, 255).astype(np.uint8)
    mask, seen = np.zeros((128, 128), np.uint8), np.ones((16, 16), bool)
    mask[:, :32] = 1
    assert tile_fault(mask, field, seen, 0.5, 0.5) == ((0.25, 1.0), None)
    half = seen.copy()
    half[:, 8:] = False
    assert tile_fault(mask, field, half, 0.6, 0.5) == ((0.5, 0.5), "unknown")
    assert tile_fault(np.full_like(mask, 255), field, seen, 0.0, 0.5) == ((0.0, 0.0), "unknown")
    assert tile_fault(mask, np.zeros_like(field), seen, 0.5, 0.5) == ((0.0, 0.0), "blank")
    cloud = np.clip(rng.normal(236, 3, (16, 16, 1)), 0, 254).astype(np.uint8).repeat(3, axis=2)
    assert tile_fault(mask, cloud, seen, 0.5, 0.5) == ((0.25, 1.0), "cloudy")
    mask[:] = 1  # the same white, but all of it is building
    assert tile_fault(mask, cloud, seen, 0.5, 0.5) == ((1.0, 1.0), None)


@given(st.integers(0, 400), st.integers(0, 400), st.floats(0, 1))
def test_tiles_without_buildings_are_sampled_down_to_their_share(
    built: int, empty: int, share: float
) -> None:
    names = [f"tile-{i}" for i in range(empty)]
    kept = sample_empty(built, names, share)
    assert kept <= set(names)
    assert kept == sample_empty(built, names[::-1], share)
    if share < 1 and len(kept) < empty:
        assert len(kept) <= share * (built + len(kept)) + 1e-6
        assert len(kept) + 1 > share * (built + len(kept) + 1) - 1e-6  # one more would be too many
    else:
        assert len(kept) == empty


def test_tallies_count_like_numpy_and_add_up() -> None:
    rng = np.random.default_rng(2)
    images = rng.integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    labels = rng.choice(np.array([OTHER, BUILDING, UNKNOWN], np.uint8), (3, 32, 32))
    labels[2] = OTHER
    whole, parts = Tally(), []
    for image, label in zip(images, labels, strict=True):
        whole.add(image, label)
        one = Tally()
        one.add(image, label)
        parts.append(one)
    assert Tally().merge(parts) == whole
    assert (whole.tiles, whole.empty) == (3, 1)
    assert whole.building == (labels == BUILDING).sum()
    assert whole.unknown == (labels == UNKNOWN).sum()
    colour = whole.colour()
    assert colour is not None
    known = images[labels != UNKNOWN] / 255.0
    np.testing.assert_allclose(colour[0], known.mean(axis=0))
    np.testing.assert_allclose(colour[1], known.std(axis=0))
    assert Tally().colour() is None
