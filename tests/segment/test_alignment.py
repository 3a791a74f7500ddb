"""Offsets between a map and a picture of a generated town: known ones are found again, wrong maps tell nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from brmgeo.geo.grid import Window, lattice
from brmgeo.maps.rasterize import building_mask
from brmgeo.segment.alignment import BlockOffset, block_offset, region_offset
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.town import generate_town

U8 = NDArray[np.uint8]
BOUNDS = (184_900.0, 451_000.0, 185_340.0, 451_440.0)
GSD_M = 0.4
HALF = 550


@dataclass(frozen=True)
class Ground:
    image: U8
    buildings: NDArray[np.object_]

    def mask(self, dx_m: float, dy_m: float) -> U8:
        """The map as it is when it lies by -(dx, dy) beside the ground: it must be moved by (dx, dy)."""
        moved = shapely.transform(self.buildings, lambda xy: xy - (dx_m, dy_m))
        box = lattice(BOUNDS, "EPSG:5187", GSD_M)
        return building_mask(moved, box.affine, self.image.shape[:2])

    def offsets(self, mask: U8, image: U8 | None = None) -> list[BlockOffset]:
        """Those of the four quarters."""
        picture = self.image if image is None else image
        found = []
        for row in (0, HALF):
            for col in (0, HALF):
                at = Window(row, col, HALF, HALF).slices
                found.append(block_offset(picture[at], np.ones((HALF, HALF), bool), mask[at], GSD_M, 8.0))
        return found


@pytest.fixture(scope="module")
def ground() -> Ground:
    town = generate_town(BOUNDS, 31)
    box = lattice(BOUNDS, town.crs, GSD_M)
    return Ground(render_imagery(town, box), np.array([b.polygon for b in town.buildings], dtype=object))


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (2.35, -1.7), (-5.9, 4.25)])
def test_known_offsets_are_found_again(ground: Ground, dx: float, dy: float) -> None:
    found = region_offset(ground.offsets(ground.mask(dx, dy)))
    assert found.status == "told"
    assert found.told >= 3
    assert math.hypot(found.dx_m - dx, found.dy_m - dy) < 0.2
    assert found.sigma_m < 0.2


def test_a_negative_has_the_same_offset(ground: Ground) -> None:
    mask = ground.mask(1.5, 2.0)
    plain, negative = (ground.offsets(mask, image) for image in (ground.image, 255 - ground.image))
    assert any(block.status == "told" for block in plain)
    for a, b in zip(plain, negative, strict=True):
        assert a.status == b.status
        if a.status == "told":
            assert (a.dx_m, a.dy_m) == pytest.approx((b.dx_m, b.dy_m), abs=1e-3)


def test_the_wrong_map_tells_nothing(ground: Ground) -> None:
    mask = ground.mask(0.0, 0.0)
    for wrong in (mask[::-1], mask[:, ::-1], np.roll(mask, (250, 170), (0, 1))):
        found = region_offset(ground.offsets(np.ascontiguousarray(wrong)))
        assert found.status == "cannot tell"
        assert math.isnan(found.dx_m)


def test_too_little_tells_nothing(ground: Ground) -> None:
    at = np.s_[:HALF, :HALF]
    image, seen, mask = ground.image[at], np.ones((HALF, HALF), bool), ground.mask(0.0, 0.0)[at]
    assert block_offset(image, seen, np.zeros_like(mask), GSD_M).status == "few outlines"
    assert block_offset(image, seen, np.full_like(mask, 255), GSD_M).status == "few outlines"
    assert block_offset(np.zeros_like(image), seen, mask, GSD_M).status == "no peak"
    assert block_offset(image, ~seen, mask, GSD_M).status == "no peak"
    with pytest.raises(ValueError, match="too small"):
        block_offset(image[:60, :60], seen[:60, :60], mask[:60, :60], GSD_M)


def test_borders_of_the_unknown_are_no_edges(ground: Ground) -> None:
    """A picture that ends within the block, and a map that ends elsewhere, must not be laid edge on edge."""
    best = max(range(4), key=lambda i: ground.offsets(ground.mask(0.0, 0.0))[i].quality)
    at = Window((best // 2) * HALF, (best % 2) * HALF, HALF, HALF).slices
    image, mask = ground.image[at].copy(), ground.mask(2.0, 1.0)[at].copy()
    seen = np.ones((HALF, HALF), bool)
    seen[:, 400:] = False
    image[:, 400:] = 0
    mask[:, 390:] = 255
    found = block_offset(image, seen, mask, GSD_M)
    assert found.status == "told"
    assert (found.dx_m, found.dy_m) == pytest.approx((2.0, 1.0), abs=0.4)


def block(dx: float, dy: float) -> BlockOffset:
    return BlockOffset(dx, dy, 20.0, 3.0, 900.0, "told")


def test_the_region_is_the_median_and_outliers_do_not_move_it() -> None:
    rng = np.random.default_rng(4)
    blocks: list[BlockOffset] = [
        block(1.0 + rng.normal(0, 0.1), -2.0 + rng.normal(0, 0.1)) for _ in range(40)
    ]
    blocks += [block(*rng.uniform(-9, 9, 2)) for _ in range(8)]
    blocks += [replace(block(0, 0), status="no peak")] * 10
    found = region_offset(blocks)
    assert (found.dx_m, found.dy_m) == pytest.approx((1.0, -2.0), abs=0.1)
    assert (found.told, found.blocks) == (48, 58)
    assert 0.05 < found.spread_m < 0.3


def scattered(values: Sequence[tuple[float, float]]) -> list[BlockOffset]:
    return [block(*v) for v in values]


def test_few_or_scattered_blocks_tell_nothing() -> None:
    assert region_offset([]).status == "cannot tell"
    assert region_offset(scattered([(1, 1), (1, 1)])).status == "cannot tell"
    assert region_offset(scattered([(-7, 3), (0, -6), (5, 8), (9, 0)])).status == "cannot tell"
    assert region_offset(scattered([(1, 1), (1.1, 1), (1, 0.9)])).status == "told"
