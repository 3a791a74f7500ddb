"""Rasterising against shapely's own point-in-polygon test, GDAL and area; windows against the whole, bit for bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio.features
import shapely
from affine import Affine
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from shapely import MultiPolygon, Polygon, STRtree

from brmgeo.codes import UNKNOWN
from brmgeo.geo.grid import Window, blocks, lattice
from brmgeo.maps.rasterize import building_mask, known_mask, mask_window

REAL = Path(
    os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / ".." / "shared" / "data")
)
SIZE = 48

# affine 3.1 would rather see @ where odc-geo and older versions of affine know only *.
pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")


def town_box(gsd_m: float) -> GeoBox:
    """A lattice far from the origin, where floating point hurts."""
    left, bottom = round(351_752.0 / gsd_m) * gsd_m, round(464_764.0 / gsd_m) * gsd_m
    return lattice((left, bottom, left + SIZE * gsd_m, bottom + SIZE * gsd_m), "EPSG:5181", gsd_m)


def world_from_pixel(box: GeoBox, rc: NDArray[np.float64]) -> NDArray[np.float64]:
    """World (x, y) of (row, col), pixel edges at whole numbers."""
    a = box.affine
    return np.stack([a.c + rc[..., 1] * a.a, a.f + rc[..., 0] * a.e], axis=-1)


def centres(box: GeoBox) -> NDArray[np.float64]:
    rows, cols = np.mgrid[0 : box.shape[0], 0 : box.shape[1]]
    return world_from_pixel(box, np.stack([rows + 0.5, cols + 0.5], axis=-1))


# Vertices in pixels: on centres, on edges and anywhere, also outside the map.
position = st.one_of(
    st.integers(-12, 2 * SIZE + 12).map(lambda n: n / 2), st.floats(-6, SIZE + 6, allow_nan=False)
)
ring = st.lists(st.tuples(position, position), min_size=3, max_size=7)
gsds = st.sampled_from([0.5, 0.3, 0.1, 1.0, 2.7])


def polygon(box: GeoBox, points: list[tuple[float, float]]) -> Polygon:
    return Polygon(world_from_pixel(box, np.array(points)))


@settings(deadline=None, max_examples=50)
@given(gsds, st.lists(ring, min_size=1, max_size=5), st.integers(9, 30), st.booleans())
def test_a_window_equals_the_whole_even_where_corners_lie_on_pixel_centres(
    gsd_m: float, rings: list[list[tuple[float, float]]], size: int, as_tree: bool
) -> None:
    box = town_box(gsd_m)
    polygons = [polygon(box, points) for points in rings]
    known = [polygon(box, [(0.5, 0.5), (0.5, 40.5), (33.5, 44.5), (44.0, 3.0)])]
    whole = building_mask(polygons, box.affine, (SIZE, SIZE))
    whole[~known_mask(known, box.affine, (SIZE, SIZE))] = UNKNOWN
    for window in blocks((SIZE, SIZE), size):
        part = mask_window(STRtree(polygons) if as_tree else polygons, known, window.box_in(box))
        np.testing.assert_array_equal(part, whole[window.slices])


@settings(deadline=None, max_examples=80)
@given(gsds, ring)
def test_pixels_are_those_whose_centres_shapely_finds_inside(
    gsd_m: float, points: list[tuple[float, float]]
) -> None:
    box = town_box(gsd_m)
    shape = polygon(box, points)
    if not shape.is_valid:
        shape = shapely.make_valid(shape)
    assume(shape.geom_type in ("Polygon", "MultiPolygon"))
    mask = building_mask([shape], box.affine, (SIZE, SIZE)) == 1
    xy = centres(box)
    inside = shapely.contains_xy(shape, xy[..., 0], xy[..., 1])
    clear = shapely.distance(shape.boundary, shapely.points(xy)) > gsd_m / 1000
    np.testing.assert_array_equal(mask[clear], inside[clear])


def test_touching_polygons_share_no_pixel_and_leave_none_out() -> None:
    box = town_box(0.5)
    left = polygon(box, [(3.5, 2.5), (30.5, 2.5), (30.5, 20.5), (11.5, 14.5)])
    right = polygon(box, [(3.5, 2.5), (11.5, 14.5), (30.5, 20.5), (3.5, 40.5)])
    a, b = (building_mask([p], box.affine, (SIZE, SIZE)) for p in (left, right))
    assert not (a & b).any()
    union = building_mask([shapely.union(left, right)], box.affine, (SIZE, SIZE))
    np.testing.assert_array_equal(a | b, union)


def test_overlaps_count_once_and_courtyards_stay_open() -> None:
    box = town_box(0.5)
    outer = world_from_pixel(box, np.array([(4, 4), (4, 30), (30, 30), (30, 4)]))
    yard = world_from_pixel(box, np.array([(10, 10), (10, 20), (20, 20), (20, 10)]))
    block = Polygon(outer, [yard])
    mask = building_mask([block], box.affine, (SIZE, SIZE))
    assert mask.sum() == 26 * 26 - 10 * 10
    assert not mask[10:20, 10:20].any()
    twice = building_mask([block, MultiPolygon([block]), None, Polygon()], box.affine, (SIZE, SIZE))
    np.testing.assert_array_equal(twice, mask)
    filled = building_mask([block, Polygon(yard)], box.affine, (SIZE, SIZE))
    assert filled.sum() == 26 * 26


def test_unknown_wins_over_building_and_nothing_known_is_all_unknown() -> None:
    box = town_box(0.5)
    everywhere = polygon(box, [(-5, -5), (-5, 60), (60, 60), (60, -5)])
    west = polygon(box, [(-5, -5), (-5, 20), (60, 20), (60, -5)])
    mask = mask_window([everywhere], [west], box)
    assert (mask[:, :20] == 1).all()
    assert (mask[:, 20:] == UNKNOWN).all()
    assert (mask_window([everywhere], [], box) == UNKNOWN).all()
    assert (mask_window([], [everywhere], box) == 0).all()
    far = Window(500, 500, 9, 7).box_in(box)
    assert (mask_window([everywhere], [everywhere], far) == UNKNOWN).all()


def test_agrees_with_gdal_away_from_ties() -> None:
    box = town_box(0.5)
    rng = np.random.default_rng(7)
    some = [polygon(box, list(map(tuple, rng.uniform(-9, 57, (3, 2))))) for _ in range(30)]
    ours = building_mask(some, box.affine, (SIZE, SIZE))
    theirs = rasterio.features.rasterize(some, out_shape=(SIZE, SIZE), transform=box.affine, dtype="uint8")
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("affine", "polygons", "found"),
    [
        (Affine.rotation(10.0), [shapely.box(0, 0, 1, 1)], "rotated|rotation"),
        (Affine.identity(), [shapely.box(0, 0, 1e9, 1)], "px from the window"),
    ],
)
def test_what_cannot_be_drawn_exactly_is_refused(affine: Affine, polygons: list[Any], found: str) -> None:
    with pytest.raises(ValueError, match=found):
        building_mask(polygons, affine, (5, 5))


@pytest.mark.skipif(not (REAL / "ngii").is_dir(), reason=f"no real sheet in {REAL / 'ngii'}")
def test_area_of_the_real_sheet_is_that_of_its_polygons() -> None:
    geopandas = pytest.importorskip("geopandas")
    footprints = geopandas.read_file(REAL / "ngii" / "36914093_buildings.gpkg").geometry.to_numpy()
    box = lattice(tuple(shapely.total_bounds(footprints)), "EPSG:5187", 0.5)
    shape = (int(box.shape[0]), int(box.shape[1]))
    mask = building_mask(footprints, box.affine, shape)
    area_m2 = shapely.union_all(footprints).area
    assert abs(mask.sum() * 0.25 / area_m2 - 1) < 1e-3
    theirs = rasterio.features.rasterize(footprints, out_shape=shape, transform=box.affine, dtype="uint8")
    assert (mask != theirs).sum() < 1e-4 * mask.sum()  # corners on pixel centres only
    tree = STRtree(footprints)
    known = [shapely.box(*shapely.total_bounds(footprints)).buffer(1.0)]
    for window in (Window(0, 0, 700, 900), Window(1234, 987, 640, 333), Window(5000, 4000, 700, 700)):
        part = mask_window(tree, known, window.box_in(box))
        r1, c1 = min(window.row + window.height, shape[0]), min(window.col + window.width, shape[1])
        inside = part[: r1 - window.row, : c1 - window.col]
        np.testing.assert_array_equal(inside, mask[window.row : r1, window.col : c1])
