"""Weighing a belief by a view over the whole map: in full, or at full resolution only where it may matter."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from brmgeo.match.belief import Belief
from brmgeo.match.kernels import BLOCK, factor_of, mass_of, take_blocks, weigh_heading

F32 = NDArray[np.float32]

#: The best blocks have full resolution: this share of all, at least and at most so many.
FINE_SHARE = 0.03
FINE_LEAST, FINE_MOST = 2_000, 40_000


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


def search(
    belief: Belief, llr_of: F32 | Callable[[int], F32 | None], low: float, high: float, weight: float = 1.0
) -> float:
    """Weigh the whole grid, unlisted ground included, and list what stands out; returns the log of the evidence.

    Args:
        llr_of: gives the (rows, cols) float32 log-likelihood ratios of one heading bin, which are overwritten, or
            None to rule the heading out; or one such array that holds for all headings.
        low, high: bounds of the ratios.
        weight: factor of the ratios, for views that repeat what was seen.
    """
    # Headings arrive one by one, so the total is not yet known: what an even spread held is the first threshold.
    threshold = belief.settings.keep * belief.even_block
    limit = belief.settings.max_blocks
    keys: list[NDArray[np.int32]] = []
    parts: list[F32] = []
    count = 0
    mass_all = 0.0
    masses = np.zeros(belief.grid, np.float64)
    shared = factor_of(llr_of, low, high, weight) if isinstance(llr_of, np.ndarray) else None
    for h in range(belief.headings):
        if isinstance(llr_of, np.ndarray):
            assert shared is not None
            factor = shared
        else:
            llr = llr_of(h)
            if llr is None:
                continue
            factor = factor_of(llr, low, high, weight)
        even = np.float32(belief.rest / belief.cells)
        weigh_heading(factor, belief.index[h], belief.blocks, even, masses)
        mass_all += float(masses.sum())
        cells = np.argwhere(masses > threshold)
        if len(cells):
            out = np.empty((len(cells), BLOCK, BLOCK), np.float32)
            take_blocks(factor, belief.index[h], belief.blocks, even, cells, out)
            keys.append(np.concatenate([np.full((len(cells), 1), h), cells], axis=1).astype(np.int32))
            parts.append(out)
            count += len(cells)
        if count > 2 * limit:
            threshold = _raise_threshold(keys, parts, limit)
            count = sum(map(len, keys))
    all_keys = np.concatenate(keys) if keys else np.empty((0, 3), np.int32)
    blocks = np.concatenate(parts) if parts else np.empty((0, BLOCK, BLOCK), np.float32)
    belief.list_blocks(all_keys, blocks)
    belief.rest = max(0.0, mass_all - float(blocks.sum(dtype=np.float64)))
    total = belief.normalise()
    belief.prune()
    return math.log(total)


def search_tiers(belief: Belief, tiers: Tiers, low: float, high: float, weight: float = 1.0) -> float:
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
    given = _Bounds(low, high, weight)
    q, s = tiers.group, tiers.scale
    top, mass = _coarse(belief, tiers, given)
    scored = np.zeros(tiers.bound.shape, np.bool_)
    scored[tiers.places[:, 0], tiers.places[:, 1]] = True
    bound = given.factor(np.where(scored, np.float32(-np.inf), tiers.bound))
    bound[scored] = 0.0
    count = [v.reshape(-1, BLOCK // s).sum(axis=1) for v in _inside(belief, s)]
    passed = float(count[0] @ bound.repeat(s, axis=0).repeat(s, axis=1) @ count[1]) * belief.headings

    even = np.float32(belief.rest / belief.cells)
    keys, blocks = _weighed(belief, tiers, top, even, given)
    rough = np.repeat(mass * even, q, axis=0)
    rough[keys[:, 0], keys[:, 1], keys[:, 2]] = 0.0
    # Listed blocks on ground that is passed over are among ``blocks``.
    gone = keys[~scored[keys[:, 1] // s, keys[:, 2] // s]]
    at = np.minimum(BLOCK, np.array(belief.shape) - BLOCK * gone[:, 1:]).prod(axis=1)
    passed -= float(at @ bound[gone[:, 1] // s, gone[:, 2] // s])
    total = (
        float(blocks.sum(dtype=np.float64))
        + float(rough.sum(dtype=np.float64))
        + passed * float(even)
        + belief.off
    )

    # Blocks of the whole belief that stand out, with the coarse ratios where there are no others.
    own = mass_of(blocks)[:, 0]
    threshold = belief.settings.keep * belief.even_block * total
    limit = belief.settings.max_blocks
    both = np.concatenate([own[own > threshold], rough[rough > threshold]])
    if len(both) > limit:
        threshold = max(threshold, float(np.partition(both, -limit)[-limit]))
    stay = own > threshold
    more = np.argwhere(rough > threshold).astype(np.int32)
    fresh = _coarse_factor(tiers, more, given) * even
    _clear_outside(belief, more, fresh)
    belief.list_blocks(np.concatenate([keys[stay], more]), np.concatenate([blocks[stay], fresh]))
    belief.rest = max(0.0, total - belief.off - float(belief.blocks.sum(dtype=np.float64)))
    belief.normalise()
    belief.prune()
    return math.log(total)


class _Bounds(NamedTuple):
    """Bounds of the ratios and their factor."""

    low: float
    high: float
    weight: float

    def factor(self, llr: F32) -> F32:
        """The bounded likelihood ratio, written over ``llr``."""
        return factor_of(llr, self.low, self.high, self.weight)


def _inside(belief: Belief, scale: int) -> list[F32]:
    """How many of a coarse cell's cells lie on the map, by row and by column, whole coarse blocks."""
    return [
        np.clip(n - scale * np.arange(-(-blocks // scale) * BLOCK), 0, scale).astype(np.float32)
        for n, blocks in zip(belief.shape, belief.grid)
    ]


def _coarse(belief: Belief, tiers: Tiers, given: _Bounds) -> tuple[F32, F32]:
    """Largest coarse ratio (-inf where there is none) and summed coarse likelihood ratio of each block.

    Two (groups, block rows, block cols) float32.
    """
    s = tiers.scale
    inside = _inside(belief, s)
    rows, cols = (-(-n // s) * s for n in belief.grid)
    wide = (belief.headings // tiers.group, rows, cols)
    top, mass = np.full(wide, -np.inf, np.float32), np.zeros(wide, np.float32)
    for g in range(len(top)):
        llr = tiers.rough(np.insert(tiers.places, 0, g, axis=1))
        _digest(llr, tiers.places, inside, given, top=top[g], mass=mass[g])
    return top[:, : belief.grid[0], : belief.grid[1]], mass[:, : belief.grid[0], : belief.grid[1]]


def _weighed(
    belief: Belief, tiers: Tiers, top: F32, even: np.float32, given: _Bounds
) -> tuple[NDArray[np.int32], F32]:
    """Keys and posterior blocks, not normalised: the best in full, all other listed ones by their coarse ratios."""
    chosen = _best(belief, top, tiers, float(even), given)
    row = belief.index[chosen[:, 0], chosen[:, 1], chosen[:, 2]]
    order = np.argsort(row < 0, kind="stable")
    chosen, row = chosen[order], row[order]
    listed = int(np.count_nonzero(row >= 0))
    blocks = given.factor(tiers.fine(chosen))
    blocks[:listed] *= belief.blocks[row[:listed]] + even
    blocks[listed:] *= even
    other = np.ones(len(belief.keys), np.bool_)
    other[row[:listed]] = False
    left = belief.keys[other]
    by_coarse = _coarse_factor(tiers, left, given)
    by_coarse *= belief.blocks[other] + even
    keys, blocks = np.concatenate([chosen, left]), np.concatenate([blocks, by_coarse])
    _clear_outside(belief, keys, blocks)
    blocks[blocks < 1e-25] = 0.0
    return keys, blocks


def _coarse_factor(tiers: Tiers, keys: NDArray[np.int32], given: _Bounds) -> F32:
    """(n, 16, 16) likelihood ratios of blocks (heading, row, col) by their coarse ratios, or by the bound of these
    where there are none."""
    q, s = tiers.group, tiers.scale
    side = BLOCK // s
    scored = np.zeros(tiers.bound.shape, np.bool_)
    scored[tiers.places[:, 0], tiers.places[:, 1]] = True
    row, col = keys[:, 1] // s, keys[:, 2] // s
    has = scored[row, col]
    out = np.empty((len(keys), BLOCK, BLOCK), np.float32)
    out[~has] = given.factor(tiers.bound[row, col][~has])[:, None, None]
    if has.any():
        own = keys[has]
        places, inverse = np.unique(own // np.array([q, s, s], np.int32), axis=0, return_inverse=True)
        factor = given.factor(tiers.rough(places))
        cut = factor.reshape(len(places), s, side, s, side).transpose(0, 1, 3, 2, 4)
        cut = cut[inverse.ravel(), own[:, 1] % s, own[:, 2] % s]
        out[has] = cut.repeat(s, axis=1).repeat(s, axis=2)
    return out


def _best(belief: Belief, top: F32, tiers: Tiers, even: float, given: _Bounds) -> NDArray[np.int32]:
    """Keys to score in full: the best by their largest belief times their largest coarse likelihood ratio.

    ``top`` (groups, block rows, block cols) holds the coarse ratios' maxima, -inf where there are none: of these
    only listed blocks are taken, by their bounds.
    """
    q, s = tiers.group, tiers.scale
    hope = np.repeat(np.minimum(top * np.float32(given.weight), np.float32(given.high)), q, axis=0)
    hope += np.float32(math.log(max(even, 1e-30)))
    if len(belief.keys):
        h, row, col = belief.keys.T
        ratio = np.where(
            np.isfinite(top[h // q, row, col]), top[h // q, row, col], tiers.bound[row // s, col // s]
        )
        ratio = np.minimum(ratio * given.weight, given.high)
        hope[h, row, col] = ratio + np.log(mass_of(belief.blocks)[:, 1] + max(even, 1e-30))
    want = int(min(max(FINE_SHARE * hope.size, FINE_LEAST), FINE_MOST, hope.size))
    flat = hope.ravel()
    best = np.argpartition(flat, -want)[-want:]
    best = np.sort(best[np.isfinite(flat[best])])
    return np.stack(np.unravel_index(best, hope.shape), axis=1).astype(np.int32)


def _clear_outside(belief: Belief, keys: NDArray[np.int32], blocks: F32) -> None:
    """Zero in blocks what lies beyond the grid's last row and column."""
    for axis in (0, 1):
        last = np.flatnonzero(keys[:, 1 + axis] == belief.grid[axis] - 1)
        used = belief.shape[axis] - (belief.grid[axis] - 1) * BLOCK
        if used < BLOCK:
            blocks[(last, slice(used, None)) if axis == 0 else (last, slice(None), slice(used, None))] = 0.0


def _digest(
    llr: F32, places: NDArray[np.int32], inside: list[F32], given: _Bounds, *, top: F32, mass: F32
) -> None:
    """Largest ratio and summed likelihood ratio over the cells of each block, from coarse ratios (overwritten)."""
    n, s = len(places), top.shape[0] * BLOCK // len(inside[0])
    side = BLOCK // s
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
    factor = given.factor(llr)
    factor *= rows[:, :, None]
    factor *= cols[:, None, :]
    mass[at] = factor.reshape(n, s, side, s, side).sum(axis=(2, 4))


def _raise_threshold(keys: list[NDArray[np.int32]], parts: list[F32], limit: int) -> float:
    mass = [mass_of(p)[:, 0] for p in parts]
    threshold = float(np.partition(np.concatenate(mass), -limit)[-limit])
    for n, m in enumerate(mass):
        stay = m >= threshold
        keys[n], parts[n] = keys[n][stay], parts[n][stay]
    return threshold
