"""Log-likelihoods of a view's ratio rings.

The ratios in n discs (eq. 1-3) are differenced into n rings, whose errors hardly depend on each
other. A ring's share is expected at P0 + (P1-P0) G and scatters by missed and invented buildings, P(1-P) over
the number of independent areas in the ring, by the position within a cell, and by a floor; a Student density
keeps one odd ring from deciding. The background is the map's own distribution: the mean likelihood over all
its cells, half and half with an even spread over rings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import disc_radii
from brmgeo.flight.values import View
from brmgeo.match.rates import Rates
from brmgeo.match.settings import RatioSettings
from brmgeo.match.threads import split

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RingShares:
    """Ring shares of a view: (n,) float64 ``share`` in [0, 1] and known area ``area_m2``, and the ``radius_m``
    of the discs."""

    share: F64
    area_m2: F64
    radius_m: F64


def view_rings(view: View, count: int) -> RingShares:
    """Shares of building in ``count`` rings between the radii r_k = k / count of the view's largest disc (eq. 1-3).

    A pixel belongs to a disc when its centre does; unknown pixels count in neither sum. A ring without known
    pixels has area 0.
    """
    h, w = view.known.shape
    row = (np.arange(h) + 0.5 - view.nadir_px[0]) * view.gsd_m
    col = (np.arange(w) + 0.5 - view.nadir_px[1]) * view.gsd_m
    ring = np.sqrt(row[:, None] ** 2 + col[None, :] ** 2) * (count / view.radius_m)
    index = np.minimum(np.ceil(ring).astype(np.int64) - 1, count).clip(0)
    known = view.known
    n = np.bincount(index[known], minlength=count + 1)[:count].astype(np.float64)
    k = np.bincount(index[known], weights=view.building[known].astype(np.float64), minlength=count + 1)[
        :count
    ]
    share = np.divide(k, n, out=np.zeros(count), where=n > 0)
    radius = np.array(disc_radii(view.radius_m, count)[::-1])
    return RingShares(share, n * view.gsd_m**2, radius)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _ring_loglik(built, known, share, area, hit, alarm, unit, floor, move, dof, out, i0, i1):  # type: ignore[no-untyped-def]
    """log p(rings | cell): (rows, cols) from (n, rows, cols) square metres of building and known ground in discs."""
    n, _rows, cols = built.shape
    # lgamma terms make densities of different widths comparable with the even spread of the background.
    const = math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2) - 0.5 * math.log(dof * math.pi)
    for i in range(i0, i1):
        for j in range(cols):
            used = 0
            # Products instead of sums of logarithms: at most 32 factors between 1e-7 and 1e6 stay in range.
            spread = 1.0
            apart = 1.0
            for k in range(n):
                if area[k] <= 0:
                    continue
                b, m = built[k, i, j], known[k, i, j]
                if k:
                    b -= built[k - 1, i, j]
                    m -= known[k - 1, i, j]
                if m < 0.5 * area[k]:
                    # Ground that the map does not know: as good as the background's even spread.
                    continue
                g = b / m
                p = alarm + (hit - alarm) * g
                var = (g * hit * (1 - hit) + (1 - g) * alarm * (1 - alarm)) * unit / area[k]
                var += floor * floor + move[k]
                d = share[k] - p
                spread *= var
                apart *= 1.0 + d * d / (dof * var)
                used += 1
            out[i, j] = used * const - 0.5 * math.log(spread) - 0.5 * (dof + 1) * math.log(apart)


def ring_loglik(
    rings: RingShares, built: F32, known: F32, rates: Rates, settings: RatioSettings, move: F64 | None = None
) -> F32:
    """log p(rings | place), (...) float32, for maps of the ground in the discs of the rings' radii.

    Args:
        rings: of the view.
        built, known: (n, ..., cols) float32 square metres of building and of known ground in each disc.
        rates: P1, P0 and the independent area.
        settings: floor and degrees of freedom.
        move: (n,) variance of each ring's ratio within what a place stands for (``cell_variance``), or None for points.
    """
    n, cols = len(built), built.shape[-1]
    flat_built, flat_known = built.reshape(n, -1, cols), known.reshape(n, -1, cols)
    more = np.zeros(n) if move is None else move
    out = np.empty(flat_built.shape[1:], np.float32)
    split(
        lambda i0, i1: _ring_loglik(
            flat_built,
            flat_known,
            rings.share,
            rings.area_m2,
            hit=rates.hit,
            alarm=rates.false_alarm,
            unit=rates.independent_m2,
            floor=settings.noise,
            move=more,
            dof=settings.dof,
            out=out,
            i0=i0,
            i1=i1,
        ),
        len(out),
        64,
    )
    return out.reshape(built.shape[1:])


def cell_variance(built: F32, known: F32) -> F64:
    """(n,) variance of each ring's ratio within a cell, from (n, ..., rows, cols) areas in discs about cells' centres.

    A place is spread evenly over its cell: a twelfth of the variance between neighbouring cells, per axis.
    """
    ring_built = np.diff(built, axis=0, prepend=np.float32(0))
    ring_known = np.diff(known, axis=0, prepend=np.float32(0))
    share = np.divide(ring_built, ring_known, out=np.zeros_like(ring_built), where=ring_known > 0)
    axes = tuple(range(1, share.ndim))
    total = np.zeros(len(built))
    for axis in (-2, -1):
        total += (np.diff(share, axis=axis) ** 2).mean(axis=axes, dtype=np.float64) / 12.0
    return total


def ring_fit(rings: RingShares, built: NDArray[np.floating], known: NDArray[np.floating]) -> float:
    """How far the building in a view's rings and in the map's agree, as Dice of areas, in [0, 1]; NaN for too little of it.

    Args:
        rings: of the view.
        built, known: (n,) square metres of building and of known ground in the map's discs of the rings' radii.

    At the true place it is about 0.95, at the best of all wrong places on a map of the same kind of town about 0.75
    (docs/matchers.md); views with less than 2 % of building say nothing.
    """
    inside, seen = np.diff(built, prepend=0.0), np.diff(known, prepend=0.0)
    share = np.divide(inside, seen, out=np.zeros(len(inside)), where=seen > 0)
    area = np.where(seen > 0, rings.area_m2, 0.0)
    if not area.sum() or float((rings.share * area).sum()) < 0.02 * float(area.sum()):
        return math.nan
    return 1.0 - float((np.abs(rings.share - share) * area).sum() / ((rings.share + share) * area).sum())
