"""Sets of candidate pixels: found by ratios, kept by what a motion allows, followed pair by pair, counted."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import RATIO_SCALE, RATIO_UNKNOWN
from brmgeo.match.threads import split

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

STEPS = round(1 / RATIO_SCALE)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _search(maps, wanted, limit, counts, out, i0, i1):  # type: ignore[no-untyped-def]
    n, _rows, cols = maps.shape
    line = np.empty(cols, np.int32)
    for i in range(i0, i1):
        line[:] = 0
        for k in range(n):
            source = maps[k, i]
            f = wanted[k]
            for j in range(cols):
                v = np.int32(source[j])
                # What is unknown is further than any limit from any ratio.
                line[j] += abs(v - f) + (v == RATIO_UNKNOWN) * 1_000_000
        total = 0
        target = out[i]
        for j in range(cols):
            hit = line[j] < limit
            target[j] = hit
            total += hit
        counts[i] = total


def search_ratios(maps: NDArray[np.uint16], f: F64, e1: float, out: U8) -> int:
    """Mark every pixel with ``sum_k |M_k - f_k| < e1`` (eq. 5); returns how many.

    Args:
        maps: (n, H, W) uint16 ratios x 1e-4, 65535 unknown: such a pixel is never marked.
        f: (n,) ratios in [0, 1]; compared to the nearest 1e-4, as the maps are.
        e1: bound.
        out: (H, W) uint8, written.
    """
    counts = np.empty(maps.shape[1], np.int64)
    wanted = np.rint(f * STEPS).astype(np.int32)
    limit = np.int32(min(math.ceil(e1 * STEPS - 1e-6), 900_000))
    split(lambda i0, i1: _search(maps, wanted, limit, counts, out, i0, i1), len(counts), 64)
    return int(counts.sum())


@nb.njit(cache=True, nogil=True)
def _runs(mask, starts, ends, counts, i0, i1):  # type: ignore[no-untyped-def]
    """Runs [start, end) of set pixels of each row, and how many there are."""
    cols = mask.shape[1]
    for i in range(i0, i1):
        row = mask[i]
        n = 0
        before = np.uint8(0)
        for j in range(cols):
            v = row[j]
            if v != before:
                if v:
                    starts[i, n] = j
                else:
                    ends[i, n] = j
                    n += 1
                before = v
        if before:
            ends[i, n] = cols
            n += 1
        counts[i] = n


@nb.njit(cache=True, nogil=True)
def _keep_reached(starts, ends, counts, spans, reach, out, left, i0, i1):  # type: ignore[no-untyped-def]
    """Clear every pixel of rows [i0, i1) of ``out`` that no run reaches; ``left`` counts what stays in each row.

    A run [s, e) reaches, in the row t below it, the columns [s + a, e - 1 + b) of each span [a, b) of that row
    offset: one step up and one down in a row of differences, whatever the length.
    """
    rows, cols = out.shape
    diff = np.zeros(cols + 1, np.int32)
    for i in range(i0, i1):
        target = out[i]
        some = np.uint8(0)
        for j in range(cols):
            some |= target[j]
        left[i] = 0
        if not some:
            continue
        diff[:] = 0
        for t in range(2 * reach + 1):
            q = i - (t - reach)
            if q < 0 or q >= rows:
                continue
            for part in range(0, 4, 2):
                lo, hi = spans[t, part], spans[t, part + 1]
                if lo >= hi:
                    continue
                for r in range(counts[q]):
                    a = max(0, starts[q, r] + lo)
                    b = min(cols, ends[q, r] - 1 + hi)
                    if a < b:
                        diff[a] += 1
                        diff[b] -= 1
        depth = 0
        kept = 0
        for j in range(cols):
            depth += diff[j]
            v = target[j] & np.uint8(depth > 0)
            target[j] = v
            kept += v
        left[i] = kept


class RingReach:
    """Which pixels can be reached from a set of pixels by a ring of offsets; its buffers are kept between calls."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._starts = np.empty((shape[0], shape[1] // 2 + 1), np.int32)
        self._ends = np.empty_like(self._starts)
        self._counts = np.empty(shape[0], np.int64)
        self._left = np.empty(shape[0], np.int64)

    def keep(self, mask: U8, spans: NDArray[np.int64], reach: int, out: U8) -> int:
        """Clear in ``out`` all p without a set q of ``mask`` whose offset p - q lies in the spans; returns
        what is left.

        ``spans`` is (2 reach + 1, 4) int64 as ``ring_spans`` gives it; row offsets count downwards.
        """
        starts, ends, counts, left = self._starts, self._ends, self._counts, self._left
        split(lambda i0, i1: _runs(mask, starts, ends, counts, i0, i1), len(counts), 64)
        split(
            lambda i0, i1: _keep_reached(
                starts, ends, counts, spans, reach, out=out, left=left, i0=i0, i1=i1
            ),
            len(left),
            64,
        )
        return int(left.sum())


@nb.njit(cache=True, nogil=True)
def census(mask, stride, by_row, by_col, sample):  # type: ignore[no-untyped-def]
    """Set pixels per row and per column, and every ``stride``-th of them as (row, col); returns how many of these."""
    by_col[:] = 0
    seen = 0
    n = 0
    for i in range(mask.shape[0]):
        row = mask[i]
        total = 0
        for j in range(row.shape[0]):
            by_col[j] += row[j]
            total += row[j]
        by_row[i] = total
        if total:
            for j in range(row.shape[0]):
                if row[j]:
                    if seen % stride == 0 and n < sample.shape[0]:
                        sample[n, 0] = i
                        sample[n, 1] = j
                        n += 1
                    seen += 1
    return n


def ring_spans(distance: float, eps: float, inner: float | None = None) -> tuple[NDArray[np.int64], int]:
    """Row by row, the whole-pixel offsets that some heading allows: the union of boxes about a circle.

    A pixel offset (dx, dy) belongs when ``|dx - d cos t| < eps`` and ``|dy - d sin t| < eps`` for some t. With
    ``inner`` 0 the whole disc of ``distance`` and its boxes belong (used where only the speed bounds the movement).

    Returns (2 reach + 1, 4) int64 spans [a, b) and [c, d) per row offset -reach..reach (an empty one has a >=
    b), and reach.
    """
    reach = math.ceil(distance + eps) + 1
    spans = np.zeros((2 * reach + 1, 4), np.int64)
    for t in range(2 * reach + 1):
        dy = float(t - reach)
        # sin t must lie within (dy - eps, dy + eps) / d.
        low, high = max(dy - eps, -distance), min(dy + eps, distance)
        if low > high or (low == high and abs(dy - low) >= eps):
            continue
        nearest = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
        farthest = max(abs(low), abs(high))
        most = math.sqrt(max(distance**2 - nearest**2, 0.0))
        least = math.sqrt(max(distance**2 - farthest**2, 0.0)) if inner is None else 0.0
        # Offsets dx with |dx - c| < eps for some c in [least, most] (and mirrored): open intervals.
        a, b = math.floor(least - eps) + 1, math.ceil(most + eps)
        if a <= -a + 1:
            spans[t, 0], spans[t, 1] = -b + 1, b
        else:
            spans[t] = (a, b, -b + 1, -a + 1)
    return spans, reach


@nb.njit(cache=True, nogil=True)
def follow_pairs(rows_at, cols_at, row_start, prev, theta_start, theta, distance, eps, limit, pairs):  # type: ignore[no-untyped-def]
    """Pairs (new, previous) that eq. 4 and 6 allow.

    New candidates by row (cols_at sorted within row_start[i]:row_start[i + 1]); previous ones (m, 2) row, col with
    directions theta[theta_start[p]:theta_start[p + 1]]. Returns the number of pairs, or -1 when ``pairs`` is too small.
    """
    rows = row_start.shape[0] - 1
    n = 0
    for p in range(prev.shape[0]):
        r, c = prev[p, 0], prev[p, 1]
        first = n
        for a in range(theta_start[p], theta_start[p + 1]):
            x = c + distance * math.cos(theta[a])
            y = r - distance * math.sin(theta[a])
            for i in range(max(0, math.floor(y - eps) + 1), min(rows - 1, math.ceil(y + eps) - 1) + 1):
                lo, hi = row_start[i], row_start[i + 1]
                end = hi
                # First candidate of the row right of the box's left side.
                while lo < hi:
                    mid = (lo + hi) // 2
                    if cols_at[mid] <= x - eps:
                        lo = mid + 1
                    else:
                        hi = mid
                while lo < end and cols_at[lo] < x + eps:
                    known = False
                    for q in range(first, n):
                        if pairs[q, 0] == lo:
                            known = True
                            break
                    if not known:
                        if n >= limit:
                            return -1
                        pairs[n, 0] = lo
                        pairs[n, 1] = p
                        n += 1
                    lo += 1
    return n
