"""The generated town: the same for the same seed, plausible, and free of overlaps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import shapely

from brmgeo.codes import BUILDING_LAYERS
from brmgeo.errors import SettingsError
from brmgeo.synth.scene import APARTMENT, CANOPY, HOUSE, Town, TownStyle
from brmgeo.synth.town import generate_town

BOUNDS = (195200.0, 446000.0, 195800.0, 446600.0)


@lru_cache(maxsize=4)
def town(seed: int = 3) -> Town:
    return generate_town(BOUNDS, seed, TownStyle(villages=16.0))


def outlines(t: Town) -> np.ndarray:
    return np.array([b.polygon for b in t.buildings], dtype=object)


def test_same_seed_gives_the_same_town_and_another_seed_another() -> None:
    again = generate_town(BOUNDS, 3, TownStyle(villages=16.0))
    assert shapely.to_wkb(outlines(again)).tolist() == shapely.to_wkb(outlines(town())).tolist()
    assert [b.colour for b in again.buildings] == [b.colour for b in town().buildings]
    assert np.array_equal(again.trees, town().trees)
    other = generate_town(BOUNDS, 4)
    assert (
        shapely.area(
            shapely.union_all(outlines(other)).symmetric_difference(shapely.union_all(outlines(town())))
        )
        > 3000
    )


def test_buildings_are_valid_and_do_not_overlap() -> None:
    shapes = outlines(town())
    assert shapely.is_valid(shapes).all()
    assert {b.layer for b in town().buildings} <= set(BUILDING_LAYERS)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    pairs = first < second
    common = shapely.area(shapely.intersection(shapes[first[pairs]], shapes[second[pairs]]))
    assert common.max(initial=0.0) < 0.05
    layers = [b.layer for b in town().buildings]
    for i, j in zip(first[pairs], second[pairs]):
        assert CANOPY in (layers[i], layers[j])  # only lean-to roofs touch anything


def test_buildings_keep_off_water_and_roads() -> None:
    union = shapely.union_all(outlines(town()))
    assert union.intersection(shapely.union_all(town().water)).area == 0
    surface = shapely.union_all(
        [r.line.buffer(r.width_m / 2, cap_style="flat") for r in town().roads if r.kind != "track"]
    )
    assert union.intersection(surface).area < 1.0


def test_statistics_are_those_of_a_small_korean_town() -> None:
    t = town()
    share = t.built_area_m2() / 600.0**2
    assert 0.03 < share < 0.25
    sizes = {k: np.median([b.polygon.area for b in t.buildings if b.layer == k]) for k in (HOUSE, CANOPY)}
    assert 30 < sizes[HOUSE] < 140
    assert 6 < sizes[CANOPY] < 30
    floors = [b.floors for b in t.buildings if b.layer == APARTMENT]
    assert all(5 <= f <= 22 for f in floors)
    assert all(b.height_m > 2 for b in t.buildings)


def test_nothing_is_repeated() -> None:
    """No two outlines have the same shape: a map of copies would make places look alike."""
    spans = [
        tuple(np.round(shapely.length(b.polygon.exterior) + np.array([0, b.polygon.area]), 3))
        for b in town().buildings
    ]
    assert len(set(spans)) > 0.97 * len(spans)


def test_built_area_is_the_union_within_bounds() -> None:
    box = shapely.box(*BOUNDS)
    parts = shapely.area(shapely.intersection(outlines(town()), box)).sum()
    assert town().built_area_m2() == pytest.approx(parts, abs=1.0)
    table = town().footprints()
    assert table.crs.to_epsg() == 5187
    assert len(table) == len(town().buildings)


def test_density_changes_the_number_of_buildings() -> None:
    sparse = generate_town(BOUNDS, 3, TownStyle(density=0.4, villages=16.0))
    assert len(sparse.buildings) < 0.7 * len(town().buildings)


def test_styles_vary_and_repeat() -> None:
    assert TownStyle.varied(5) == TownStyle.varied(5)
    assert TownStyle.varied(5) != TownStyle.varied(6)
    assert {TownStyle.varied(s).season for s in range(20)} == {"spring", "summer", "autumn", "winter"}


def test_bounds_too_small_are_refused() -> None:
    with pytest.raises(SettingsError, match="300 x 300"):
        generate_town((0, 0, 100, 1000), 1)
