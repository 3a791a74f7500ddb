"""A belief over place and heading that is sparse in space: blocks where it lives, two numbers for all the rest.

The state is a cell of a north-up grid and a heading bin of the odometry frame. Cells are kept in blocks of 16
x 16 of one heading; only blocks that hold more than a small share of an even spread are *listed*. Everything
else is two numbers: ``rest``, the mass that lies anywhere on the map outside the listed blocks, spread evenly,
and ``off``, the mass of "this flight is not over the map, or nothing here can be trusted". So memory and time
follow the area that is still possible. At the start nothing is listed: the first informative frame lists what fits.

Likelihoods are ratios against a background, so ``off`` and, where a frame is scored at listed blocks only,
``rest`` keep their mass and everything is normalised afterwards. Prediction moves each heading's blocks by the
odometry step turned into that heading and blurs them; mass that leaves the grid goes to ``off``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from brmgeo.maps.ratio import Disjoint
from brmgeo.match.settings import BeliefSettings
from brmgeo.match.threads import split

BLOCK = 16
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@nb.njit(cache=True, nogil=True, fastmath=True, pipeline_class=Disjoint)
def _convolve(window, half, kx, ky, out):  # type: ignore[no-untyped-def]
    """out (256,) = a window of (15 + taps) x (15 + taps) cells, flat, through kx along rows, then ky; half is scratch.

    Positions are unsigned: signed ones would be tested for counting from the end, and the loops not be vectorised.
    """
    last = np.uint64(len(kx) - 1)
    side = np.uint64(BLOCK) + last
    for i in range(side):
        p, q = np.uint64(i) * side + last, np.uint64(i * BLOCK)
        for j in range(BLOCK):
            half[q + np.uint64(j)] = 0.0
        for v in range(len(kx)):
            k, first = kx[v], p - np.uint64(v)
            for j in range(BLOCK):
                half[q + np.uint64(j)] += k * window[first + np.uint64(j)]
    for i in range(BLOCK):
        p, q = np.uint64(i) + last, np.uint64(i * BLOCK)
        for j in range(BLOCK):
            out[q + np.uint64(j)] = 0.0
        for u in range(len(ky)):
            k, first = ky[u], (p - np.uint64(u)) * np.uint64(BLOCK)
            for j in range(BLOCK):
                out[q + np.uint64(j)] += k * half[first + np.uint64(j)]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _move(blocks, index, targets, whole, ky, kx, reach, ny, nx, out, t0, t1):  # type: ignore[no-untyped-def]
    """Each target block gathered from its sources: whole-cell shift, then a separable kernel of 2 reach + 1 taps."""
    side = BLOCK + 2 * reach
    nby, nbx = index.shape[1], index.shape[2]
    window, half = np.empty(side * side, np.float32), np.empty(side * BLOCK, np.float32)
    for t in range(t0, t1):
        h, by, bx = targets[t, 0], targets[t, 1], targets[t, 2]
        top = by * BLOCK - reach - whole[h, 0]
        left = bx * BLOCK - reach - whole[h, 1]
        window[:] = 0.0
        for sy in range(max(0, top // BLOCK), min(nby - 1, (top + side - 1) // BLOCK) + 1):
            for sx in range(max(0, left // BLOCK), min(nbx - 1, (left + side - 1) // BLOCK) + 1):
                s = index[h, sy, sx]
                if s < 0:
                    continue
                i0, i1 = max(top, sy * BLOCK), min(top + side, sy * BLOCK + BLOCK)
                j0, j1 = max(left, sx * BLOCK), min(left + side, sx * BLOCK + BLOCK)
                for i in range(i0, i1):
                    source = blocks[s, i - sy * BLOCK, j0 - sx * BLOCK : j1 - sx * BLOCK]
                    first = (i - top) * side + j0 - left
                    window[first : first + j1 - j0] = source
        _convolve(window, half, kx[h], ky[h], out[t].reshape(BLOCK * BLOCK))
        if (by + 1) * BLOCK > ny or (bx + 1) * BLOCK > nx:
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if by * BLOCK + i >= ny or bx * BLOCK + j >= nx:
                        out[t, i, j] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=True)
def _mix(blocks, index, targets, share, out, t0, t1):  # type: ignore[no-untyped-def]
    """Each target block takes ``share`` from both neighbouring headings and keeps the rest."""
    headings = index.shape[0]
    for t in range(t0, t1):
        h, by, bx = targets[t, 0], targets[t, 1], targets[t, 2]
        out[t] = 0.0
        for d in range(-1, 2):
            s = index[(h + d + headings) % headings, by, bx]
            if s >= 0:
                w = np.float32(share if d != 0 else 1.0 - 2.0 * share)
                for i in range(BLOCK):
                    for j in range(BLOCK):
                        out[t, i, j] += w * blocks[s, i, j]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _mass_of(blocks):  # type: ignore[no-untyped-def]
    """(sum, maximum) of each block, float64."""
    out = np.empty((blocks.shape[0], 2), np.float64)
    for t in range(blocks.shape[0]):
        total = np.float32(0.0)
        top = np.float32(0.0)
        for i in range(BLOCK):
            for j in range(BLOCK):
                v = blocks[t, i, j]
                total += v
                top = max(top, v)
        out[t, 0] = total
        out[t, 1] = top
    return out


def _factor(llr: F32, low: float, high: float, weight: float) -> F32:
    """The bounded likelihood ratio, written over ``llr``: a frame is wrong as a whole with chance e^low."""
    if weight != 1.0:
        llr *= np.float32(weight)
    np.minimum(llr, np.float32(high), out=llr)
    np.exp(llr, out=llr)
    llr += np.float32(math.exp(low))
    return llr


@nb.njit(cache=True, nogil=True, fastmath=True)
def _search_heading(factor, listed, blocks, even, masses):  # type: ignore[no-untyped-def]
    """Posterior mass of every block of one heading; ``listed`` (nby, nbx) holds the row of a listed block or -1.

    ``even`` is the prior mass per cell of ``rest``.
    """
    ny, nx = factor.shape
    for by in range(listed.shape[0]):
        for bx in range(listed.shape[1]):
            s = listed[by, bx]
            total = np.float32(0.0)
            wide = min(BLOCK, nx - bx * BLOCK)
            for i in range(min(BLOCK, ny - by * BLOCK)):
                row = factor[by * BLOCK + i, bx * BLOCK : bx * BLOCK + wide]
                if s >= 0:
                    for j in range(wide):
                        total += (even + blocks[s, i, j]) * row[j]
                else:
                    for j in range(wide):
                        total += even * row[j]
            masses[by, bx] = total


@nb.njit(cache=True, nogil=True, fastmath=True)
def _take_blocks(factor, listed, blocks, even, cells, out):  # type: ignore[no-untyped-def]
    """Posterior blocks at ``cells`` (n, 2) block row, block col."""
    ny, nx = factor.shape
    for n in range(cells.shape[0]):
        by, bx = cells[n, 0], cells[n, 1]
        s = listed[by, bx]
        for i in range(BLOCK):
            for j in range(BLOCK):
                y, x = by * BLOCK + i, bx * BLOCK + j
                v = np.float32(0.0)
                if y < ny and x < nx:
                    v = (even + blocks[s, i, j] if s >= 0 else even) * factor[y, x]
                # Below this a cell weighs nothing even after the largest ratio; denormals would cost time.
                out[n, i, j] = v if v > 1e-25 else np.float32(0.0)


@nb.njit(cache=True, nogil=True)
def _entropy(blocks):  # type: ignore[no-untyped-def]
    total = 0.0
    flat = blocks.reshape(-1)
    for t in range(flat.shape[0]):
        v = flat[t]
        if v > 1e-12:
            total -= v * math.log(v)
    return total


def _step_kernels(fraction: F64, sigma: float, reach: int) -> F32:
    """(n, 2 reach + 1) weights of whole-cell offsets for normals of mean ``fraction`` and deviation ``sigma`` cells."""
    edges = (np.arange(-reach, reach + 2) - 0.5 - fraction[:, None]) / (sigma * math.sqrt(2.0))
    weights = np.diff(erf(edges), axis=1)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)


class Tiers(Protocol):
    """A view's log-likelihood ratios over a whole map, coarse and fine; see ``Belief.search_tiers``.

    Attributes:
        group: how many neighbouring headings share a coarse one; it divides the number of headings.
        scale: cells of the belief per coarse cell and axis, 1 or 2. A coarse block has 16 x 16 coarse cells.
        places: (n, 2) int32 rows and columns of the coarse blocks worth scoring.
        bound: (coarse block rows, coarse block cols) float32, upper bounds of the ratios in all others.
    """

    group: int
    scale: int
    places: NDArray[np.int32]
    bound: F32

    def rough(self, keys: NDArray[np.int32]) -> F32:
        """(n, 16, 16) ratios on coarse cells for keys (group, coarse block row, coarse block col)."""

    def fine(self, keys: NDArray[np.int32]) -> F32:
        """(n, 16, 16) ratios for keys (heading, block row, block col)."""


@dataclass(frozen=True, slots=True)
class Mode:
    """The heaviest place of a belief: cell coordinates (row, col) of mean and covariance, heading of the
    odometry frame.

    ``mass`` counts cells within the mode's radius and headings within 30 degrees of the heaviest cell.
    """

    mean: F64
    covariance: F64
    heading_rad: float
    heading_sigma_rad: float
    mass: float


class Belief:
    """Probability over (heading bin, cell row, cell column), off the map, and unlisted ground; it sums to 1.

    Args:
        shape: (rows, cols) of the grid of cells.
        settings: sizes, leaks and limits; ``cell_m`` is not read, all lengths here are in cells.
        heading_prior: (headings,) probabilities of the heading bins at the start, or None for an even one.
    """

    def __init__(self, shape: tuple[int, int], settings: BeliefSettings) -> None:
        self.shape = shape
        self.settings = settings
        self.headings = settings.headings
        self.grid = (-(-shape[0] // BLOCK), -(-shape[1] // BLOCK))
        self.index = np.full((self.headings, *self.grid), -1, np.int32)
        self.keys = np.empty((0, 3), np.int32)
        self.blocks = np.empty((0, BLOCK, BLOCK), np.float32)
        self.off = settings.off_map_start
        self.rest = 1.0 - settings.off_map_start
        self._spare = np.empty((0, BLOCK, BLOCK), np.float32)
        self._even_block = 1.0 / float(self.headings * self.grid[0] * self.grid[1])

    @property
    def cells(self) -> int:
        """Number of (heading, cell) pairs of the whole grid."""
        return self.headings * self.shape[0] * self.shape[1]

    def heading_of(self, bins: NDArray[np.integer] | int) -> F64:
        """Heading of bins' centres, radians counter-clockwise from east."""
        return np.asarray(bins, np.float64) * (2 * math.pi / self.headings)

    def total(self) -> float:
        """Sum of everything; 1 up to rounding after each public call."""
        return float(self.blocks.sum(dtype=np.float64)) + self.rest + self.off

    def _list(self, keys: NDArray[np.int32], blocks: F32) -> None:
        old = self.keys
        self.index[old[:, 0], old[:, 1], old[:, 2]] = -1
        self.keys, self.blocks = keys, blocks
        self.index[keys[:, 0], keys[:, 1], keys[:, 2]] = np.arange(len(keys), dtype=np.int32)

    def _buffer(self, count: int) -> F32:
        """A block array of ``count`` that does not share memory with ``blocks``; reused between calls."""
        if len(self._spare) < count:
            self._spare = np.empty((int(count * 1.3) + 64, BLOCK, BLOCK), np.float32)
        return self._spare[:count]

    def _swap(self, keys: NDArray[np.int32], fresh: F32) -> None:
        """List blocks that were written into the buffer, and keep the old array as the next buffer."""
        old = self.blocks if self.blocks.base is None else self.blocks.base
        self._list(keys, fresh)
        self._spare = old if old.ndim == 3 else np.empty((0, BLOCK, BLOCK), np.float32)

    def prune(self) -> None:
        """Unlist blocks that hold less than the settings' share of an even spread; their mass joins ``rest``."""
        if not len(self.keys):
            return
        mass = _mass_of(self.blocks)[:, 0]
        stay = mass > self.settings.keep * self._even_block
        if stay.sum() > self.settings.max_blocks:
            limit = np.partition(mass, -self.settings.max_blocks)[-self.settings.max_blocks]
            stay = mass >= limit
        if stay.all():
            return
        self.rest += float(mass[~stay].sum())
        self._list(self.keys[stay], self.blocks[stay])

    def _normalise(self) -> float:
        total = self.total()
        self.blocks *= np.float32(1.0 / total)
        self.rest /= total
        self.off /= total
        return total

    def leak(self) -> None:
        """A little leaves the map, and a little of what is off comes back to anywhere on it."""
        out, back = self.settings.leak_out, self.settings.leak_in
        self.blocks *= np.float32(1.0 - out)
        listed = float(self.blocks.sum(dtype=np.float64)) / (1.0 - out) if out < 1 else 0.0
        gone, came = out * (listed + self.rest), back * self.off
        self.rest += came - out * self.rest
        self.off += gone - came

    def predict(self, step: F64, sigma: float, heading_share: float) -> None:
        """Move by a step known in the odometry frame.

        Args:
            step: (2,) displacement in the odometry frame, cells, x then y.
            sigma: standard deviation of the displacement per axis, cells.
            heading_share: share that goes to each neighbouring heading.
        """
        before = self.total() - self.off
        if len(self.keys):
            angle = self.heading_of(np.arange(self.headings))
            east = step[0] * np.cos(angle) - step[1] * np.sin(angle)
            north = step[0] * np.sin(angle) + step[1] * np.cos(angle)
            moved = np.stack([-north, east], axis=1)
            whole = np.rint(moved).astype(np.int64)
            sigma = max(sigma, 0.4)
            reach = max(2, math.ceil(3.0 * sigma + 0.5))
            ky = _step_kernels((moved - whole)[:, 0], sigma, reach)
            kx = _step_kernels((moved - whole)[:, 1], sigma, reach)
            targets = self._reached(whole, reach)
            out = self._buffer(len(targets))
            blocks, index, shape = self.blocks, self.index, self.shape
            split(
                lambda t0, t1: _move(blocks, index, targets, whole, ky, kx, reach, *shape, out, t0, t1),
                len(targets),
                200,
            )
            self._swap(targets, out)
            self.prune()
            self._mix_headings(heading_share)
        self.off += before - (self.total() - self.off)
        self.leak()
        self.prune()

    def _reached(self, whole: NDArray[np.int64], reach: int) -> NDArray[np.int32]:
        """Keys of the blocks that moved mass can reach."""
        h = self.keys[:, 0]
        lo = [self.keys[:, 1 + a] * BLOCK + whole[h, a] - reach for a in (0, 1)]
        first = [v // BLOCK for v in lo]
        last = [(v + BLOCK - 1 + 2 * reach) // BLOCK for v in lo]
        mark = np.zeros(self.index.shape, np.bool_)
        span = [int((b - a).max()) + 1 for a, b in zip(first, last)]
        for dy in range(span[0]):
            for dx in range(span[1]):
                by, bx = first[0] + dy, first[1] + dx
                ok = (by <= last[0]) & (bx <= last[1]) & (by >= 0) & (bx >= 0)
                ok &= (by < self.grid[0]) & (bx < self.grid[1])
                mark[h[ok], by[ok], bx[ok]] = True
        return np.argwhere(mark).astype(np.int32)

    def _mix_headings(self, share: float) -> None:
        share = min(max(share, self.settings.heading_leak), 1.0 / 3.0)
        if share <= 0 or not len(self.keys):
            return
        mass = _mass_of(self.blocks)[:, 0]
        heavy = self.keys[mass * share > self.settings.keep * self._even_block]
        mark = np.zeros(self.index.shape, np.bool_)
        mark[self.keys[:, 0], self.keys[:, 1], self.keys[:, 2]] = True
        for d in (-1, 1):
            mark[(heavy[:, 0] + d) % self.headings, heavy[:, 1], heavy[:, 2]] = True
        targets = np.argwhere(mark).astype(np.int32)
        out = self._buffer(len(targets))
        before = float(mass.sum())
        blocks, index = self.blocks, self.index
        split(lambda t0, t1: _mix(blocks, index, targets, share, out, t0, t1), len(targets), 1000)
        self._swap(targets, out)
        # What would have gone to unlisted neighbours lies somewhere on the map.
        self.rest += before - float(self.blocks.sum(dtype=np.float64))

    def predict_unknown(self, radius: float, keep_heading: float) -> None:
        """Move by an unknown displacement of at most ``radius`` cells; the heading survives with ``keep_heading``.

        Everything within the radius is equally likely. Mass that would leave the grid goes to ``off``.
        """
        before = self.total() - self.off
        if len(self.keys):
            reach = max(1, math.ceil(radius))
            yy, xx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
            disc = (yy**2 + xx**2 <= max(radius, 1.0) ** 2).astype(np.float32)
            disc /= disc.sum()
            by0, bx0 = (self.keys[:, 1:].min(axis=0) - (reach // BLOCK + 1)).clip(0)
            by1, bx1 = self.keys[:, 1:].max(axis=0) + (reach // BLOCK + 2)
            by1, bx1 = min(by1, self.grid[0]), min(bx1, self.grid[1])
            size = ((by1 - by0) * BLOCK, (bx1 - bx0) * BLOCK)
            mixed = np.zeros(size, np.float32)
            parts_keys: list[NDArray[np.int32]] = []
            parts: list[F32] = []
            limit = self.settings.keep * self._even_block
            for h in range(self.headings):
                rows = np.flatnonzero(self.keys[:, 0] == h)
                if not len(rows):
                    continue
                dense = np.zeros(size, np.float32)
                for s in rows:
                    i, j = (self.keys[s, 1] - by0) * BLOCK, (self.keys[s, 2] - bx0) * BLOCK
                    dense[i : i + BLOCK, j : j + BLOCK] = self.blocks[s]
                mixed += dense
                if keep_heading > 0:
                    self._collect(
                        h,
                        self._blurred(dense, disc, by0, bx0),
                        by0,
                        bx0,
                        keep_heading,
                        limit,
                        parts_keys,
                        parts,
                    )
            if keep_heading < 1:
                even = self._blurred(mixed, disc, by0, bx0)
                share = (1.0 - keep_heading) / self.headings
                for h in range(self.headings):
                    self._collect(h, even, by0, bx0, share, limit, parts_keys, parts)
            keys, blocks = _merged(parts_keys, parts, self.index.shape)
            self._list(keys, blocks)
            # What was too thin to list lies somewhere on the map; what left the grid is off it.
            on_map = float(self._blurred(mixed, disc, by0, bx0).sum(dtype=np.float64))
            self.rest += max(0.0, on_map - float(blocks.sum(dtype=np.float64)))
        self.off += before - (self.total() - self.off)
        self.leak()
        self.prune()

    def _blurred(self, dense: F32, disc: F32, by0: int, bx0: int) -> F32:
        out: F32 = cv2.filter2D(dense, cv2.CV_32F, disc, borderType=cv2.BORDER_CONSTANT)
        np.maximum(out, 0, out=out)
        out[max(0, self.shape[0] - by0 * BLOCK) :] = 0
        out[:, max(0, self.shape[1] - bx0 * BLOCK) :] = 0
        return out

    def _collect(
        self,
        h: int,
        dense: F32,
        by0: int,
        bx0: int,
        weight: float,
        limit: float,
        keys: list[NDArray[np.int32]],
        parts: list[F32],
    ) -> None:
        n, m = dense.shape[0] // BLOCK, dense.shape[1] // BLOCK
        tiles = dense.reshape(n, BLOCK, m, BLOCK).transpose(0, 2, 1, 3)
        mass = tiles.sum(axis=(2, 3)) * weight
        rows, cols = np.nonzero(mass > limit)
        if len(rows):
            keys.append(np.stack([np.full(len(rows), h), rows + by0, cols + bx0], axis=1).astype(np.int32))
            parts.append(np.ascontiguousarray(tiles[rows, cols]) * np.float32(weight))

    def weigh_headings(self, factor: F64) -> None:
        """Multiply by a likelihood (headings,) of the heading alone, relative to an even one, and normalise."""
        self.blocks *= factor[self.keys[:, 0], None, None].astype(np.float32)
        self.rest *= float(factor.mean())
        self._normalise()
        self.prune()

    def update(self, llr: F32, low: float, high: float, weight: float = 1.0) -> float:
        """Weigh listed blocks by (n, 16, 16) log-likelihood ratios (overwritten); returns the log of the evidence."""
        self.blocks *= _factor(llr, low, high, weight)
        self.blocks[self.blocks < 1e-25] = 0.0
        total = self._normalise()
        self.prune()
        return math.log(total)

    def search(
        self, llr_of: F32 | Callable[[int], F32 | None], low: float, high: float, weight: float = 1.0
    ) -> float:
        """Weigh the whole grid, unlisted ground included, and list what stands out; returns the log of the evidence.

        Args:
            llr_of: gives the (rows, cols) float32 log-likelihood ratios of one heading bin, which are overwritten, or
                None to rule the heading out; or one such array that holds for all headings.
            low, high: bounds of the ratios.
            weight: factor of the ratios, for views that repeat what was seen.
        """
        # Headings arrive one by one, so the total is not yet known: what an even spread held is the first threshold.
        threshold = self.settings.keep * self._even_block
        limit = self.settings.max_blocks
        keys: list[NDArray[np.int32]] = []
        parts: list[F32] = []
        count = 0
        mass_all = 0.0
        masses = np.zeros(self.grid, np.float64)
        shared = _factor(llr_of, low, high, weight) if isinstance(llr_of, np.ndarray) else None
        for h in range(self.headings):
            if isinstance(llr_of, np.ndarray):
                assert shared is not None
                factor = shared
            else:
                llr = llr_of(h)
                if llr is None:
                    continue
                factor = _factor(llr, low, high, weight)
            even = np.float32(self.rest / self.cells)
            _search_heading(factor, self.index[h], self.blocks, even, masses)
            mass_all += float(masses.sum())
            cells = np.argwhere(masses > threshold)
            if len(cells):
                out = np.empty((len(cells), BLOCK, BLOCK), np.float32)
                _take_blocks(factor, self.index[h], self.blocks, even, cells, out)
                keys.append(np.concatenate([np.full((len(cells), 1), h), cells], axis=1).astype(np.int32))
                parts.append(out)
                count += len(cells)
            if count > 2 * limit:
                threshold = self._raise_threshold(keys, parts, limit)
                count = sum(map(len, keys))
        all_keys = np.concatenate(keys) if keys else np.empty((0, 3), np.int32)
        blocks = np.concatenate(parts) if parts else np.empty((0, BLOCK, BLOCK), np.float32)
        self._list(all_keys, blocks)
        self.rest = max(0.0, mass_all - float(blocks.sum(dtype=np.float64)))
        total = self._normalise()
        self.prune()
        return math.log(total)

    def search_tiers(self, tiers: Tiers, low: float, high: float, weight: float = 1.0) -> float:
        """As ``search``, at full resolution only where it may matter; returns the log of the evidence.

        Full resolution have the best blocks, listed or not, by belief and coarse ratios together (``FINE_SHARE`` of all).
        Other listed blocks are weighed by their coarse ratios; so is what else stands out, which is listed with them: it
        may be scored in full in the next frame. All other ground joins
        ``rest`` with the mass that its coarse ratios, or their upper bounds, give it: what is passed over by mistake is
        not lost, and while ``rest`` holds mass the next frame is searched anew.

        Args:
            tiers: the view's ratios.
            low, high, weight: as in ``search``.
        """
        q, s = tiers.group, tiers.scale
        side = BLOCK // s
        coarse = tuple(-(-n // s) for n in self.grid)
        groups = self.headings // q
        # How many of a coarse cell's cells lie on the map, by row and by column.
        inside = [
            np.clip(self.shape[a] - s * np.arange(coarse[a] * BLOCK), 0, s).astype(np.float32) for a in (0, 1)
        ]
        count = [v.reshape(-1, side).sum(axis=1) for v in inside]
        wide = (groups, coarse[0] * s, coarse[1] * s)
        top, mass = np.full(wide, -np.inf, np.float32), np.zeros(wide, np.float32)
        for g in range(groups):
            keys = np.insert(tiers.places, 0, g, axis=1)
            self._digest(tiers.rough(keys), tiers.places, inside, side, top[g], mass[g], low, high, weight)
        scored = np.zeros(coarse, np.bool_)
        scored[tiers.places[:, 0], tiers.places[:, 1]] = True
        bound = _factor(np.where(scored, np.float32(-np.inf), tiers.bound), low, high, weight)
        bound[scored] = 0.0
        passed = float(count[0] @ bound.repeat(s, axis=0).repeat(s, axis=1) @ count[1]) * self.headings
        top, mass = top[:, : self.grid[0], : self.grid[1]], mass[:, : self.grid[0], : self.grid[1]]

        even = np.float32(self.rest / self.cells)
        chosen = self._best(top, tiers, float(even), high, weight)
        row = self.index[chosen[:, 0], chosen[:, 1], chosen[:, 2]]
        order = np.argsort(row < 0, kind="stable")
        chosen, row = chosen[order], row[order]
        listed = int(np.count_nonzero(row >= 0))
        blocks = _factor(tiers.fine(chosen), low, high, weight)
        blocks[:listed] *= self.blocks[row[:listed]] + even
        blocks[listed:] *= even
        other = np.ones(len(self.keys), np.bool_)
        other[row[:listed]] = False
        left = self.keys[other]
        by_coarse = self._coarse_factor(tiers, left, low, high, weight)
        by_coarse *= self.blocks[other] + even
        keys, blocks = np.concatenate([chosen, left]), np.concatenate([blocks, by_coarse])
        self._clear_outside(keys, blocks)
        blocks[blocks < 1e-25] = 0.0
        rough = np.repeat(mass * even, q, axis=0)
        rough[keys[:, 0], keys[:, 1], keys[:, 2]] = 0.0
        # Listed blocks on ground that is passed over are among ``blocks``.
        gone = keys[~scored[keys[:, 1] // s, keys[:, 2] // s]]
        at = np.minimum(BLOCK, np.array(self.shape) - BLOCK * gone[:, 1:]).prod(axis=1)
        passed -= float(at @ bound[gone[:, 1] // s, gone[:, 2] // s])
        total = (
            float(blocks.sum(dtype=np.float64))
            + float(rough.sum(dtype=np.float64))
            + passed * float(even)
            + self.off
        )

        # Blocks of the whole belief that stand out, with the coarse ratios where there are no others.
        own = _mass_of(blocks)[:, 0]
        threshold = self.settings.keep * self._even_block * total
        limit = self.settings.max_blocks
        both = np.concatenate([own[own > threshold], rough[rough > threshold]])
        if len(both) > limit:
            threshold = max(threshold, float(np.partition(both, -limit)[-limit]))
        stay = own > threshold
        more = np.argwhere(rough > threshold).astype(np.int32)
        fresh = self._coarse_factor(tiers, more, low, high, weight) * even
        self._clear_outside(more, fresh)
        self._list(np.concatenate([keys[stay], more]), np.concatenate([blocks[stay], fresh]))
        self.rest = max(0.0, total - self.off - float(self.blocks.sum(dtype=np.float64)))
        self._normalise()
        self.prune()
        return math.log(total)

    def _coarse_factor(
        self, tiers: Tiers, keys: NDArray[np.int32], low: float, high: float, weight: float
    ) -> F32:
        """(n, 16, 16) likelihood ratios of blocks (heading, row, col) by their coarse ratios, or by the bound of these
        where there are none."""
        q, s = tiers.group, tiers.scale
        side = BLOCK // s
        scored = np.zeros(tiers.bound.shape, np.bool_)
        scored[tiers.places[:, 0], tiers.places[:, 1]] = True
        row, col = keys[:, 1] // s, keys[:, 2] // s
        has = scored[row, col]
        out = np.empty((len(keys), BLOCK, BLOCK), np.float32)
        out[~has] = _factor(tiers.bound[row, col][~has], low, high, weight)[:, None, None]
        if has.any():
            own = keys[has]
            places, inverse = np.unique(own // np.array([q, s, s], np.int32), axis=0, return_inverse=True)
            factor = _factor(tiers.rough(places), low, high, weight)
            cut = factor.reshape(len(places), s, side, s, side).transpose(0, 1, 3, 2, 4)
            cut = cut[inverse.ravel(), own[:, 1] % s, own[:, 2] % s]
            out[has] = cut.repeat(s, axis=1).repeat(s, axis=2)
        return out

    FINE_SHARE = 0.03
    FINE_LEAST, FINE_MOST = 2_000, 40_000

    def _best(self, top: F32, tiers: Tiers, even: float, high: float, weight: float) -> NDArray[np.int32]:
        """Keys to score in full: the best by their largest belief times their largest coarse likelihood ratio.

        ``top`` (groups, block rows, block cols) holds the coarse ratios' maxima, -inf where there are none: of these
        only listed blocks are taken, by their bounds.
        """
        q, s = tiers.group, tiers.scale
        hope = np.repeat(np.minimum(top * np.float32(weight), np.float32(high)), q, axis=0)
        hope += np.float32(math.log(max(even, 1e-30)))
        if len(self.keys):
            h, row, col = self.keys.T
            ratio = np.where(
                np.isfinite(top[h // q, row, col]), top[h // q, row, col], tiers.bound[row // s, col // s]
            )
            ratio = np.minimum(ratio * weight, high)
            hope[h, row, col] = ratio + np.log(_mass_of(self.blocks)[:, 1] + max(even, 1e-30))
        want = int(min(max(self.FINE_SHARE * hope.size, self.FINE_LEAST), self.FINE_MOST, hope.size))
        flat = hope.ravel()
        best = np.argpartition(flat, -want)[-want:]
        best = np.sort(best[np.isfinite(flat[best])])
        return np.stack(np.unravel_index(best, hope.shape), axis=1).astype(np.int32)

    def _clear_outside(self, keys: NDArray[np.int32], blocks: F32) -> None:
        """Zero in blocks what lies beyond the grid's last row and column."""
        for axis in (0, 1):
            last = np.flatnonzero(keys[:, 1 + axis] == self.grid[axis] - 1)
            used = self.shape[axis] - (self.grid[axis] - 1) * BLOCK
            if used < BLOCK:
                blocks[(last, slice(used, None)) if axis == 0 else (last, slice(None), slice(used, None))] = (
                    0.0
                )

    def _digest(
        self,
        llr: F32,
        places: NDArray[np.int32],
        inside: list[F32],
        side: int,
        top: F32,
        mass: F32,
        low: float,
        high: float,
        weight: float,
    ) -> None:
        """Largest ratio and summed likelihood ratio over the cells of each block, from coarse ratios (overwritten)."""
        n, s = len(places), BLOCK // side
        rows, cols = (v.reshape(-1, BLOCK)[places[:, a]] for a, v in enumerate(inside))
        edge = np.flatnonzero((rows[:, -1] == 0) | (cols[:, -1] == 0))
        llr[edge] = np.where(
            (rows[edge, :, None] > 0) & (cols[edge, None, :] > 0), llr[edge], np.float32(-np.inf)
        )
        at = (
            places[:, 0, None, None] * s + np.arange(s)[:, None],
            places[:, 1, None, None] * s + np.arange(s),
        )
        top[at] = llr.reshape(n, s, side, s, side).max(axis=(2, 4))
        factor = _factor(llr, low, high, weight)
        factor *= rows[:, :, None]
        factor *= cols[:, None, :]
        mass[at] = factor.reshape(n, s, side, s, side).sum(axis=(2, 4))

    @staticmethod
    def _raise_threshold(keys: list[NDArray[np.int32]], parts: list[F32], limit: int) -> float:
        mass = [_mass_of(p)[:, 0] for p in parts]
        threshold = float(np.partition(np.concatenate(mass), -limit)[-limit])
        for n, m in enumerate(mass):
            stay = m >= threshold
            keys[n], parts[n] = keys[n][stay], parts[n][stay]
        return threshold

    def entropy(self) -> float:
        """Entropy over (heading, cell) and off the map, nats; unlisted ground counts as evenly spread."""
        value = float(_entropy(self.blocks)) if len(self.blocks) else 0.0
        if self.rest > 0:
            value -= self.rest * math.log(self.rest / self.cells)
        if self.off > 0:
            value -= self.off * math.log(self.off)
        return value

    def heaviest(self, count: int) -> tuple[F64, F64, int]:
        """The heaviest cells over all headings: (n, 2) row, col of centres, (n,) mass, and how many stand out in all.

        A cell stands out when a heading of it holds more than an even spread would give it.
        """
        if not len(self.keys):
            return np.empty((0, 2)), np.empty(0), 0
        even = 1.0 / self.cells
        top = _mass_of(self.blocks)[:, 1]
        standing = self._standing(top, even)
        rows = np.argsort(top)[::-1][:count]
        flat = self.blocks[rows].reshape(-1)
        take = min(count, len(flat))
        best = np.argpartition(flat, -take)[-take:]
        best = best[flat[best] > even] if (flat[best] > even).any() else best[np.argmax(flat[best])][None]
        s, i, j = rows[best // BLOCK**2], best // BLOCK % BLOCK, best % BLOCK
        row, col = self.keys[s, 1] * BLOCK + i, self.keys[s, 2] * BLOCK + j
        place, inverse = np.unique(row.astype(np.int64) * self.shape[1] + col, return_inverse=True)
        mass = np.bincount(inverse, weights=flat[best]).astype(np.float64)
        order = np.argsort(mass)[::-1]
        place = place[order]
        centres = np.stack([place // self.shape[1] + 0.5, place % self.shape[1] + 0.5], axis=1)
        return centres, mass[order], max(standing, len(order))

    def _standing(self, top: F64, even: float) -> int:
        """How many cells hold more than ``even`` under some heading; ``top`` (n,) is the largest mass of each block."""
        held = np.flatnonzero(top > even)
        if not len(held):
            return 0
        over = np.packbits((self.blocks[held] > even).reshape(len(held), -1), axis=1)
        place = self.keys[held, 1].astype(np.int64) * self.grid[1] + self.keys[held, 2]
        order = np.argsort(place, kind="stable")
        starts = np.flatnonzero(np.diff(place[order], prepend=-1))
        return int(np.unpackbits(np.bitwise_or.reduceat(over[order], starts, axis=0)).sum(dtype=np.int64))

    def mode(self, radius: float) -> Mode | None:
        """The heaviest place within ``radius`` cells; None when nothing is listed."""
        if not len(self.keys):
            return None
        top = _mass_of(self.blocks)[:, 1]
        s = int(np.argmax(top))
        i, j = np.unravel_index(int(np.argmax(self.blocks[s])), (BLOCK, BLOCK))
        h0 = int(self.keys[s, 0])
        centre = np.array([self.keys[s, 1] * BLOCK + i + 0.5, self.keys[s, 2] * BLOCK + j + 0.5])
        spread = max(1, round(self.headings / 12))
        apart = (self.keys[:, 0] - h0 + self.headings // 2) % self.headings - self.headings // 2
        near = np.abs(apart) <= spread
        reach = radius / BLOCK + 1.0
        near &= (np.abs(self.keys[:, 1:] + 0.5 - centre / BLOCK) <= reach).all(axis=1)
        keys, apart = self.keys[near], apart[near]
        p = self.blocks[near].astype(np.float64)
        rows = keys[:, 1, None, None] * BLOCK + np.arange(BLOCK)[None, :, None] + 0.5
        cols = keys[:, 2, None, None] * BLOCK + np.arange(BLOCK)[None, None, :] + 0.5
        for _ in range(2):
            # The second pass centres the disc on the mode's mean instead of its heaviest cell.
            p2 = p * ((rows - centre[0]) ** 2 + (cols - centre[1]) ** 2 <= radius**2)
            mass = float(p2.sum())
            centre = np.array([(p2 * rows).sum(), (p2 * cols).sum()]) / mass
        dr, dc = rows - centre[0], cols - centre[1]
        cov = np.array([[(p2 * dr * dr).sum(), (p2 * dr * dc).sum()], [0.0, (p2 * dc * dc).sum()]]) / mass
        cov[1, 0] = cov[0, 1]
        cov += np.eye(2) / 12.0
        weight = p2.sum(axis=(1, 2)) / mass
        mean_bin = float((weight * apart).sum())
        bin_var = float((weight * (apart - mean_bin) ** 2).sum()) + 1.0 / 12.0
        step = 2 * math.pi / self.headings
        return Mode(centre, cov, (h0 + mean_bin) * step, math.sqrt(bin_var) * step, mass)


def _merged(
    keys: list[NDArray[np.int32]], parts: list[F32], shape: tuple[int, ...]
) -> tuple[NDArray[np.int32], F32]:
    """Blocks of equal key added up."""
    if not keys:
        return np.empty((0, 3), np.int32), np.empty((0, BLOCK, BLOCK), np.float32)
    all_keys, blocks = np.concatenate(keys), np.concatenate(parts)
    code = np.ravel_multi_index(tuple(all_keys.T), shape)
    unique, inverse = np.unique(code, return_inverse=True)
    out = np.zeros((len(unique), BLOCK, BLOCK), np.float32)
    np.add.at(out, inverse, blocks)
    return np.stack(np.unravel_index(unique, shape), axis=1).astype(np.int32), out
