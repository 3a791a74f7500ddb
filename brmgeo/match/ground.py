"""The ground that a matcher looks at: the building map, its coverage per cell, its ratio maps at any radius."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.maps.ratio import disc_counts

UNKNOWN = 255


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """A building mask with its place in the map frame.

    Attributes:
        building: (H, W) uint8, row 0 in the north: 0 other, 1 building, 255 unknown.
        left, top: x of the left edge and y of the upper edge, metres.
        gsd_m: metres per pixel, > 0.

    Raises InputError for another dtype or shape, values other than 0, 1, 255, or a map without any building.
    """

    building: NDArray[np.uint8]
    left: float
    top: float
    gsd_m: float

    def __post_init__(self) -> None:
        b = self.building
        if b.ndim != 2 or b.dtype != np.uint8 or min(b.shape) < 2:
            raise InputError(
                f"a building map must be (H, W) uint8 of at least 2 x 2: got {b.shape} {b.dtype}; convert it"
            )
        if not (self.gsd_m > 0 and all(map(math.isfinite, (self.left, self.top, self.gsd_m)))):
            raise InputError(
                f"a map needs a finite place and GSD > 0: left {self.left}, top {self.top}, GSD {self.gsd_m} m"
            )
        counts = np.bincount(b.ravel(), minlength=256)
        if counts[2:UNKNOWN].any():
            raise InputError(
                "a building map holds 0, 1 and 255 (unknown) only: "
                f"found {int(np.flatnonzero(counts[2:UNKNOWN])[0]) + 2}; convert it"
            )
        if counts[1] == 0:
            raise InputError(
                f"the map of {b.shape[1] * self.gsd_m:.0f} x {b.shape[0] * self.gsd_m:.0f} m has no building: "
                "nothing can be matched to it; check the region and its footprints"
            )

    def coverage(self, cell_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Building share and known share of each cell of ``cell_px`` x ``cell_px`` pixels, from the upper left.

        Returns two (ceil(H / cell_px), ceil(W / cell_px)) float32 in [0, 1]; ground beyond the map's edge counts as
        unknown, so building <= known everywhere.
        """
        h, w = self.building.shape
        ny, nx = -(-h // cell_px), -(-w // cell_px)
        built = np.zeros((ny, nx), np.float32)
        known = np.zeros((ny, nx), np.float32)
        # Row bands keep the temporaries small on maps of gigabytes.
        band = max(1, 2_000_000 // max(1, nx * cell_px * cell_px))
        for i in range(0, ny, band):
            rows = self.building[i * cell_px : (i + band) * cell_px]
            n = -(-rows.shape[0] // cell_px)
            padded = np.full((n * cell_px, nx * cell_px), UNKNOWN, np.uint8)
            padded[: rows.shape[0], :w] = rows
            tiles = padded.reshape(n, cell_px, nx, cell_px)
            built[i : i + n] = np.count_nonzero(tiles == 1, axis=(1, 3))
            known[i : i + n] = np.count_nonzero(tiles != UNKNOWN, axis=(1, 3))
        area = np.float32(cell_px * cell_px)
        built /= area
        known /= area
        return built, known


def disc_pixels(radius_px: float) -> int:
    """Number of pixels of a disc about a pixel's centre, by the centre rule."""
    reach = math.floor(radius_px)
    dx = np.arange(-reach, reach + 1, dtype=np.float64)
    return int((dx[:, None] ** 2 + dx[None, :] ** 2 <= radius_px**2).sum())


class RatioCache:
    """Building and known ground in discs about every cell, per step of radius.

    Radii are rounded to a geometric ladder of ``step`` (0.04: 4 %), so a frame's radius is off by at most 2 %. A ratio
    then changes by about 2 * 2 % of the difference between the disc's rim and its mean, some 1e-3 on real ground,
    against a noise of the features of 2e-2 and more. The least recently used radii are dropped beyond ``keep``.

    Args:
        ground: the map.
        step: relative size of a step, > 0.
        cell_px: areas are kept at the centres of cells of this many pixels.
        keep: number of radii kept.
    """

    def __init__(self, ground: GroundMap, step: float, cell_px: int, keep: int = 48) -> None:
        self._ground = ground
        self._step = math.log1p(step)
        self._cell = cell_px
        self._keep = keep
        self._kept: OrderedDict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = OrderedDict()
        building = ground.building
        self._built_mask = building == 1
        self._known = ground.coverage(cell_px)[1]

    def radius(self, radius_m: float) -> float:
        """The ladder's radius nearest to ``radius_m``, metres."""
        return math.exp(round(math.log(radius_m) / self._step) * self._step)

    def at_cells(self, radius_m: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(built, known) square metres within the ladder's radius of each cell's centre, two (ny, nx) float32."""
        step = round(math.log(radius_m) / self._step)
        if step in self._kept:
            self._kept.move_to_end(step)
            return self._kept[step]
        radius_px = math.exp(step * self._step) / self._ground.gsd_m
        area = np.float32(self._ground.gsd_m**2)
        built = self._sampled(disc_counts(self._built_mask, radius_px, threads=2)) * area
        # Known ground only divides: its share over the cells in reach is near enough, and exact where all is known.
        reach = math.ceil(radius_px / self._cell)
        offset = np.arange(-reach, reach + 1) * self._cell
        distance = np.hypot(offset[:, None], offset[None, :])
        disc = np.clip((radius_px - distance) / self._cell + 0.5, 0.0, 1.0).astype(np.float32)
        known = cv2.filter2D(self._known, cv2.CV_32F, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT)
        pair = (built, np.maximum(known * np.float32(math.pi * radius_px**2) * area, built))
        self._kept[step] = pair
        while len(self._kept) > self._keep:
            self._kept.popitem(last=False)
        return pair

    def _sampled(self, counts: NDArray[np.unsignedinteger]) -> NDArray[np.float32]:
        """Counts at cell centres: of the middle pixel, or the mean of the four about a centre on a pixel corner."""
        c = self._cell
        if c == 1:
            return counts.astype(np.float32)
        h, w = counts.shape
        rows, cols = np.arange(-(-h // c)) * c + c // 2, np.arange(-(-w // c)) * c + c // 2
        rows, cols = np.minimum(rows, h - 1), np.minimum(cols, w - 1)
        if c % 2:
            return counts[np.ix_(rows, cols)].astype(np.float32)
        r0, c0 = np.maximum(rows - 1, 0), np.maximum(cols - 1, 0)
        total = counts[np.ix_(rows, cols)].astype(np.float32)
        for rr, cc in ((r0, cols), (rows, c0), (r0, c0)):
            total += counts[np.ix_(rr, cc)]
        return total / np.float32(4)
