"""The ground that a matcher looks at: the building map, its coverage per cell, its ratios in discs of any radius."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import BUILDING, UNKNOWN
from brmgeo.errors import InputError
from brmgeo.match.kernels import BLOCK
from brmgeo.match.threads import split


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
        # In bands: bincount works on a copy eight times as large.
        band = max(1, 4_000_000 // b.shape[1])
        counts = np.zeros(256, np.int64)
        for i in range(0, b.shape[0], band):
            counts += np.bincount(b[i : i + band].ravel(), minlength=256)
        if counts[BUILDING + 1 : UNKNOWN].any():
            raise InputError(
                "a building map holds 0, 1 and 255 (unknown) only: "
                f"found {int(np.flatnonzero(counts[BUILDING + 1 : UNKNOWN])[0]) + BUILDING + 1}; convert it"
            )
        if counts[BUILDING] == 0:
            raise InputError(
                f"the map of {b.shape[1] * self.gsd_m:.0f} x {b.shape[0] * self.gsd_m:.0f} m has no building: "
                "nothing can be matched to it; check the region and its footprints"
            )

    def coverage(self, cell_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Building share and known share of each cell of ``cell_px`` x ``cell_px`` pixels, from the upper left.

        Returns two (ceil(H / cell_px), ceil(W / cell_px)) float32 in [0, 1]; ground beyond the map's edge counts as
        unknown, so building <= known everywhere.
        """
        return cell_shares(self.building, cell_px)


@nb.njit(cache=True, nogil=True)
def _count_cells(building, side, built, known, i0, i1):  # type: ignore[no-untyped-def]
    rows, cols = building.shape
    for i in range(i0, i1):
        for y in range(i * side, min(rows, (i + 1) * side)):
            line = building[y]
            for j in range(built.shape[1]):
                some, seen = 0, 0
                for x in range(j * side, min(cols, (j + 1) * side)):
                    some += line[x] == BUILDING
                    seen += line[x] != UNKNOWN
                built[i, j] += some
                known[i, j] += seen


def cell_shares(building: NDArray[np.uint8], cell_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """``GroundMap.coverage`` of an (H, W) uint8 mask, of which there need not be any building."""
    h, w = building.shape
    shape = (-(-h // cell_px), -(-w // cell_px))
    built, known = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    split(lambda i0, i1: _count_cells(building, cell_px, built, known, i0, i1), shape[0], 64)
    area = np.float32(cell_px * cell_px)
    built /= area
    known /= area
    return built, known


def disc_pixels(radius_px: float) -> int:
    """Number of pixels of a disc about a pixel's centre, by the centre rule."""
    reach = math.floor(radius_px)
    dx = np.arange(-reach, reach + 1, dtype=np.float64)
    return int((dx[:, None] ** 2 + dx[None, :] ** 2 <= radius_px**2).sum())


@nb.njit(cache=True, nogil=True, fastmath=True)
def _disc_sums(prefix, shape, at, weight, first, blocks, shift, out, n0, n1):  # type: ignore[no-untyped-def]
    """Sums over discs about the cells of blocks, from sums along rows.

    prefix holds, flat, (f, rows, cols) = shape: the sum of a row's sub-cells before edge f * col + phase. Row t of
    disc k lies first[k] + t sub-cells below the top of its cell; at[k, t] is where in prefix the right and left
    ends and the edges after them lie, from there; weight[k, t] are the weights of these four sums. A row without
    weight ends disc k. Positions are unsigned: signed ones would be tested for counting from the end, and the
    loop would not be vectorised.
    """
    factor, cols = shape[0], shape[2]
    for n in range(n0, n1):
        left = blocks[n, 1] * BLOCK + shift
        for k in range(at.shape[0]):
            for i in range(BLOCK):
                top = (blocks[n, 0] * BLOCK + i + shift) * factor + first[k]
                acc = np.zeros(BLOCK, np.float32)
                for t in range(at.shape[1]):
                    a, b = weight[k, t, 0], weight[k, t, 1]
                    if a == 0.0 and b == 0.0:
                        break
                    c, d = weight[k, t, 2], weight[k, t, 3]
                    base = (top + t) * cols + left
                    p, q = np.uint64(base + at[k, t, 0]), np.uint64(base + at[k, t, 1])
                    r, s = np.uint64(base + at[k, t, 2]), np.uint64(base + at[k, t, 3])
                    for j in range(BLOCK):
                        u = np.uint64(j)
                        acc[u] += (
                            a * prefix[p + u] + b * prefix[q + u] - c * prefix[r + u] - d * prefix[s + u]
                        )
                for j in range(BLOCK):
                    out[k, n, i, j] = acc[j]


def chords(radius: float, factor: int) -> tuple[int, NDArray[np.int64], NDArray[np.float32]]:
    """First row, ends (rows, 4, 2) and weights (rows, 4) of ``_disc_sums`` for a disc of ``radius`` sub-cells."""
    middle = factor / 2.0
    first, last = math.floor(middle - radius), math.ceil(middle + radius)
    edge = np.clip(np.arange(first, last + 1) - middle, -radius, radius)
    # Mean half chord of each row: the disc keeps its area exactly. As a product the root's argument is never negative.
    area = 0.5 * (edge * np.sqrt((radius - edge) * (radius + edge)) + radius**2 * np.arcsin(edge / radius))
    half = np.diff(area)
    at = np.empty((len(half), 4, 2), np.int64)
    weight = np.empty((len(half), 4), np.float32)
    for end, x in ((0, middle + half), (2, middle - half)):
        whole = np.floor(x).astype(np.int64)
        for more in (0, 1):
            at[:, end + more, 0] = (whole + more) % factor
            at[:, end + more, 1] = (whole + more) // factor
        weight[:, end], weight[:, end + 1] = 1.0 - (x - whole), x - whole
    return first, at, weight


class DiscAreas:
    """Building and known ground in discs of any radii about the centres of cells, block by block of 16 x 16 cells.

    Sub-cells of the map (half a cell where a cell has an even number of pixels) are summed along rows once; a disc is
    then four sums a row, whatever stands on the map. The rim cuts sub-cells by area, as if their buildings were spread
    evenly: against counting pixels that is off by less than a hundredth of a ring's ratio, below the features' noise
    (``tests/match``). No radius is rounded and nothing is kept per radius, so a large map costs 4 bytes a
    sub-cell, and heights may change from frame to frame.

    Args:
        ground: the map.
        cell_px: pixels of a cell's side.

    Attributes:
        cells, blocks: (rows, cols) of the map's cells, and of the blocks that hold them.
        margin: how many cells around the map were summed, -1 before the first disc. Sums of known ground are rounded
            where unknown ground lies within it, so equal answers need an equal margin.
    """

    def __init__(self, ground: GroundMap, cell_px: int) -> None:
        h, w = ground.building.shape
        self._cell_m = cell_px * ground.gsd_m
        self.cells = (-(-h // cell_px), -(-w // cell_px))
        self.blocks = (-(-self.cells[0] // BLOCK), -(-self.cells[1] // BLOCK))
        self.margin = -1
        factor = next((f for f in range(2, cell_px + 1) if cell_px % f == 0), 1)
        if self.cells[0] * self.cells[1] * factor**2 > 300_000_000:
            factor = 1
        self._factor = factor
        built, known = ground.coverage(cell_px // factor)
        if factor > 1:
            known = ground.coverage(cell_px)[1]
        self._covers = ((built, factor), (known, 1))
        self._prefix: list[NDArray[np.float32]] = []
        self._whole = np.empty((0, 0), np.bool_)

    def at_blocks(
        self, blocks: NDArray[np.int32], radii_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Square metres of building and of known ground in each disc: two (radii, n, 16, 16) float32.

        ``blocks`` is (n, 2): row and column of blocks. Ground beyond the map's edge is unknown.
        """
        margin = math.ceil(float(radii_m.max()) / self._cell_m) + 2
        self.widen(margin)
        built = self._sums(0, blocks, radii_m)
        known = np.empty_like(built)
        whole = self._whole[blocks[:, 0], blocks[:, 1]]
        known[:, whole] = (math.pi * radii_m**2)[:, None, None, None]
        known[:, ~whole] = self._sums(1, blocks[~whole], radii_m)
        return built, np.maximum(known, built, out=known)

    def widen(self, margin: int) -> None:
        """Sum as far as ``margin`` cells around the map, if it is not done."""
        if margin > self.margin:
            self.margin = margin
            self._prefix = [_row_sums(cover, f, self.cells, margin) for cover, f in self._covers]
            self._whole = self._all_known()

    def _all_known(self) -> NDArray[np.bool_]:
        """(block rows, block cols): whether all ground in reach of a block is known."""
        sums = self._prefix[1][0]
        side = BLOCK + 2 * self.margin
        across = sums[:, side::BLOCK] - sums[:, :-side:BLOCK]
        down = np.cumsum(across, axis=0, dtype=np.float64)
        down = np.concatenate([np.zeros((1, down.shape[1])), down])
        return np.asarray(down[side::BLOCK] - down[:-side:BLOCK] > side * side - 0.01)

    def _sums(
        self, which: int, blocks: NDArray[np.int32], radii_m: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """(radii, n, 16, 16) square metres of one cover in discs."""
        prefix, factor = self._prefix[which], self._covers[which][1]
        sub_m = self._cell_m / factor
        discs = [chords(float(r) / sub_m, factor) for r in radii_m]
        rows = max(len(weight) for _, _, weight in discs)
        at = np.zeros((len(discs), rows + 1, 4), np.int64)
        weight = np.zeros((len(discs), rows + 1, 4), np.float32)
        for k, (_, ends, weights) in enumerate(discs):
            at[k, : len(ends)] = ends[:, :, 0] * prefix[0].size + ends[:, :, 1]
            weight[k, : len(ends)] = weights
        first = np.array([top for top, _, _ in discs])
        sums = np.empty((len(discs), len(blocks), BLOCK, BLOCK), np.float32)
        flat, margin = prefix.reshape(-1), self.margin
        split(
            lambda n0, n1: _disc_sums(
                flat,
                prefix.shape,
                at,
                weight,
                first=first,
                blocks=blocks,
                shift=margin,
                out=sums,
                n0=n0,
                n1=n1,
            ),
            len(blocks),
            32,
        )
        sums *= np.float32(sub_m**2)
        return sums


def _row_sums(
    cover: NDArray[np.float32], factor: int, cells: tuple[int, int], margin: int
) -> NDArray[np.float32]:
    """(factor, rows, cols) sums along rows before each edge, with ``margin`` cells around, whole blocks inside."""
    rows, cols = (-(-n // BLOCK) * BLOCK + 2 * margin for n in cells)
    out = np.zeros((factor, rows * factor, cols + 1), np.float32)
    line = np.zeros((cols + 1) * factor + 1, np.float64)
    for i, row in enumerate(cover):
        line[1 + margin * factor : 1 + margin * factor + len(row)] = row
        total = np.cumsum(line)
        for phase in range(factor):
            out[phase, margin * factor + i] = total[phase : phase + (cols + 1) * factor : factor]
    return out
