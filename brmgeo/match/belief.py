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
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.match.kernels import (
    BLOCK,
    entropy_of,
    factor_of,
    mass_of,
    mix_headings,
    move_blocks,
    step_kernels,
)
from brmgeo.match.settings import BeliefSettings
from brmgeo.match.state import State, damaged
from brmgeo.match.threads import split

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


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
        self.even_block = 1.0 / float(self.headings * self.grid[0] * self.grid[1])

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

    def list_blocks(self, keys: NDArray[np.int32], blocks: F32) -> None:
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
        self.list_blocks(keys, fresh)
        self._spare = old if old.ndim == 3 else np.empty((0, BLOCK, BLOCK), np.float32)

    def state(self) -> State:
        """Everything as named arrays, a copy."""
        return {
            "keys": self.keys.copy(),
            "blocks": self.blocks.copy(),
            "rest": np.array(self.rest),
            "off": np.array(self.off),
            "grid": np.array([self.headings, *self.shape], np.int64),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up what ``state`` gave; InputError where it is of another grid or contradicts itself."""
        keys, blocks = state["keys"], state["blocks"]
        if state["grid"].tolist() != [self.headings, *self.shape]:
            raise damaged(f"its belief is of {state['grid'].tolist()} headings and cells")
        inside = ((keys >= 0) & (keys < self.index.shape)).all() and len(np.unique(keys, axis=0)) == len(keys)
        if len(keys) != len(blocks) or not inside:
            raise damaged("its belief lists blocks that are not there")
        self.list_blocks(keys, blocks)
        self.rest, self.off = float(state["rest"]), float(state["off"])

    def prune(self) -> None:
        """Unlist blocks that hold less than the settings' share of an even spread; their mass joins ``rest``."""
        if not len(self.keys):
            return
        mass = mass_of(self.blocks)[:, 0]
        stay = mass > self.settings.keep * self.even_block
        if stay.sum() > self.settings.max_blocks:
            limit = np.partition(mass, -self.settings.max_blocks)[-self.settings.max_blocks]
            stay = mass >= limit
        if stay.all():
            return
        self.rest += float(mass[~stay].sum())
        self.list_blocks(self.keys[stay], self.blocks[stay])

    def normalise(self) -> float:
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
            ky = step_kernels((moved - whole)[:, 0], sigma, reach)
            kx = step_kernels((moved - whole)[:, 1], sigma, reach)
            targets = self._reached(whole, reach)
            out = self._buffer(len(targets))
            blocks, index, (ny, nx) = self.blocks, self.index, self.shape
            split(
                lambda t0, t1: move_blocks(
                    blocks,
                    index,
                    targets,
                    whole,
                    ky=ky,
                    kx=kx,
                    reach=reach,
                    ny=ny,
                    nx=nx,
                    out=out,
                    t0=t0,
                    t1=t1,
                ),
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
        mass = mass_of(self.blocks)[:, 0]
        heavy = self.keys[mass * share > self.settings.keep * self.even_block]
        mark = np.zeros(self.index.shape, np.bool_)
        mark[self.keys[:, 0], self.keys[:, 1], self.keys[:, 2]] = True
        for d in (-1, 1):
            mark[(heavy[:, 0] + d) % self.headings, heavy[:, 1], heavy[:, 2]] = True
        targets = np.argwhere(mark).astype(np.int32)
        out = self._buffer(len(targets))
        before = float(mass.sum())
        blocks, index = self.blocks, self.index
        split(lambda t0, t1: mix_headings(blocks, index, targets, share, out, t0, t1), len(targets), 1000)
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
            limit = self.settings.keep * self.even_block
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
            self.list_blocks(keys, blocks)
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
        self.normalise()
        self.prune()

    def update(self, llr: F32, low: float, high: float, weight: float = 1.0) -> float:
        """Weigh listed blocks by (n, 16, 16) log-likelihood ratios (overwritten); returns the log of the evidence."""
        self.blocks *= factor_of(llr, low, high, weight)
        self.blocks[self.blocks < 1e-25] = 0.0
        total = self.normalise()
        self.prune()
        return math.log(total)

    def entropy(self) -> float:
        """Entropy over (heading, cell) and off the map, nats; unlisted ground counts as evenly spread."""
        value = float(entropy_of(self.blocks)) if len(self.blocks) else 0.0
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
        top = mass_of(self.blocks)[:, 1]
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
        top = mass_of(self.blocks)[:, 1]
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
