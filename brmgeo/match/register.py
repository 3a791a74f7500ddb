"""Sub-cell registration of a view on the full-resolution building map, with its own covariance.

The log-likelihood ratio of points (``Rates.weights``) is summed at the map's own pixels for small offsets and turns
about a guess: first on 2 m pixels over the whole window, then on the map's own over what is left. On 2 m pixels it is
linear in the building share, hence a little low where outlines are ragged. The ratio's
exponential over all offsets and turns is the posterior under an even prior in the window; its moments are the
pose and its covariance. The covariance is widened by a floor for what the model leaves out (roofs that lean,
height, map errors of decimetres).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import BUILDING, OTHER, UNKNOWN
from brmgeo.flight.values import View
from brmgeo.match.ground import GroundMap, cell_shares
from brmgeo.match.mask import ViewPoints, view_points
from brmgeo.match.rates import Rates
from brmgeo.match.threads import split

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _offsets(built, known, all_known, forward, left, a, b, row, col, per_m, yaw, half, out, h0, h1):  # type: ignore[no-untyped-def]
    """Sum of a * built + b * known at each (yaw, row offset, col offset); pixels outside the array are unknown.

    With ``all_known`` the array ``known`` is not read: it is 1 everywhere.
    """
    size = 2 * half + 1
    rows, cols = built.shape
    for h in range(h0, h1):
        c, s = math.cos(yaw[h]), math.sin(yaw[h])
        acc = np.zeros((size, size), np.float32)
        total = np.float32(0.0)
        for n in range(forward.shape[0]):
            j = math.floor(col + (forward[n] * c - left[n] * s) * per_m)
            i = math.floor(row - (forward[n] * s + left[n] * c) * per_m)
            va, vb = a[n], b[n]
            if i - half < 0 or j - half < 0 or i + half >= rows or j + half >= cols:
                for di in range(size):
                    ii = i - half + di
                    if ii < 0 or ii >= rows:
                        continue
                    for dj in range(size):
                        jj = j - half + dj
                        if 0 <= jj < cols:
                            acc[di, dj] += va * built[ii, jj] + vb * known[ii, jj]
            elif all_known:
                total += vb
                for di in range(size):
                    line = built[i - half + di]
                    for dj in range(size):
                        acc[di, dj] += va * line[j - half + dj]
            else:
                for di in range(size):
                    line, other = built[i - half + di], known[i - half + di]
                    for dj in range(size):
                        acc[di, dj] += va * line[j - half + dj] + vb * other[j - half + dj]
        out[h] = acc + total


@dataclass(frozen=True, slots=True)
class Registration:
    """Pose of a view on the map: (x, y, yaw) in metres and radians, its (3, 3) covariance, and how well it fits.

    Attributes:
        llr: log-likelihood ratio of the best pose against the background.
        contrast: how far the best pose lies above the window's median.
        counts: square metres (building, other) over mapped buildings, then elsewhere on known ground.
        edge: whether the posterior of the place touches the window's edge, so it may lie outside.
    """

    pose: F64
    covariance: F64
    llr: float
    contrast: float
    counts: tuple[float, float, float, float]
    edge: bool


class Registrar:
    """Registers views on one map.

    Args:
        ground: the map.
        floor_m: standard deviation per axis that every registration has at least, metres.
        floor_rad: the same for the yaw, radians.
    """

    COARSE_M = 2.0

    def __init__(self, ground: GroundMap, floor_m: float = 0.25, floor_rad: float = 0.004) -> None:
        self._ground = ground
        self._floor = np.diag([floor_m**2, floor_m**2, floor_rad**2])
        self._coarse_px = max(1, round(self.COARSE_M / ground.gsd_m))

    def register(
        self, view: View, pose: F64, window_m: float, window_rad: float, rates: Rates
    ) -> Registration | None:
        """The view's pose near ``pose`` (x, y, yaw), searched within ``window_m`` per axis and ``window_rad`` of yaw.

        None when the view has no known pixel, or no ground in reach is known.
        """
        coarse = view_points(view, self.COARSE_M)
        if not len(coarse.forward) or coarse.reach_m > 5000:
            return None
        cell = self._coarse_px * self._ground.gsd_m
        half = max(2, math.ceil(window_m / cell))
        # Far patches move by the cell's size per step of yaw, so none is stepped over.
        step = max(cell / max(coarse.reach_m, cell), 0.005)
        n = max(1, math.ceil(window_rad / step))
        yaw = pose[2] + step * np.arange(-n, n + 1)
        reach = coarse.reach_m + (half + 2) * cell
        shares, origin = self._crop(pose[:2], reach, self._coarse_px)
        score = self._scores(coarse, pose[:2], yaw, half, rates, shares, cell, origin)
        first, cov, edge = _moments(score, yaw, cell)
        centre = pose[:2] + first[:2]
        # The fine window covers the coarse posterior and its pixels.
        spread = math.sqrt(max(cov[0, 0], cov[1, 1]))
        if edge or spread > 1.5 * cell:
            return self._result(coarse, score, np.array([*centre, first[2]]), cov, edge)
        gsd = self._ground.gsd_m
        fine = view_points(view, max(gsd, 1.0))
        half = math.ceil(min(2.5 * spread + 0.5 * cell, 3.0 * cell) / gsd)
        fine_step = max(gsd / max(fine.reach_m, gsd), 0.0025)
        n = math.ceil(min(2.5 * math.sqrt(cov[2, 2]) + 0.5 * step, window_rad + step) / fine_step)
        yaw = first[2] + fine_step * np.arange(-n, n + 1)
        crop, origin = self._crop(centre, fine.reach_m + half * gsd + 2.0, 1)
        score = self._scores(fine, centre, yaw, half, rates, crop, gsd, origin)
        second, cov, edge = _moments(score, yaw, gsd)
        place = centre + second[:2]
        return self._result(fine, score, np.array([*place, second[2]]), cov, edge)

    def _crop(self, centre: F64, reach_m: float, cell_px: int) -> tuple[tuple[F32, F32], tuple[float, float]]:
        """Building and known shares of the map's cells of ``cell_px`` pixels about ``centre``, and the crop's (left, top).

        Cells are those of the whole map. The crop is empty where ``centre`` is far off the map.
        """
        g = self._ground
        col, row = (centre[0] - g.left) / g.gsd_m, (g.top - centre[1]) / g.gsd_m
        reach = reach_m / g.gsd_m
        h, w = g.building.shape
        r0, c0 = (
            min(max(0, math.floor((v - reach) / cell_px) * cell_px), n) for v, n in ((row, h), (col, w))
        )
        r1, c1 = (min(n, math.ceil((v + reach) / cell_px) * cell_px) for v, n in ((row, h), (col, w)))
        cut = g.building[r0 : max(r1, r0), c0 : max(c1, c0)]
        return cell_shares(cut, cell_px), (g.left + c0 * g.gsd_m, g.top - r0 * g.gsd_m)

    def _scores(
        self,
        points: ViewPoints,
        centre: F64,
        yaw: F64,
        half: int,
        rates: Rates,
        shares: tuple[F32, F32],
        cell: float,
        origin: tuple[float, float],
    ) -> F32:
        """Ratios at (yaw, row, col) offsets."""
        a_k, a_o, b_k, b_o = rates.weights(points.rate)
        other = points.known - points.built
        a = (a_k * points.built + a_o * other).astype(np.float32)
        b = (b_k * points.built + b_o * other).astype(np.float32)
        left, top = origin
        col, row = (centre[0] - left) / cell, (top - centre[1]) / cell
        out = np.empty((len(yaw), 2 * half + 1, 2 * half + 1), np.float32)
        whole = bool(shares[1].size and shares[1].min() >= 0.9999)
        split(
            lambda h0, h1: _offsets(
                *shares,
                whole,
                points.forward,
                points.left,
                a=a,
                b=b,
                row=row,
                col=col,
                per_m=1.0 / cell,
                yaw=yaw,
                half=half,
                out=out,
                h0=h0,
                h1=h1,
            ),
            len(yaw),
            2,
        )
        return out

    def _result(self, points: ViewPoints, score: F32, pose: F64, cov: F64, edge: bool) -> Registration:
        top = float(score.max())
        return Registration(
            pose=pose,
            covariance=cov + self._floor,
            llr=top,
            contrast=top - float(np.median(score)),
            counts=self.counts(points, pose),
            edge=edge,
        )

    def counts(self, points: ViewPoints, pose: F64) -> tuple[float, float, float, float]:
        """Square metres of the view (building, other) over mapped buildings, then elsewhere, at a pose."""
        g = self._ground
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x = pose[0] + points.forward * c - points.left * s
        y = pose[1] + points.forward * s + points.left * c
        col = np.floor((x - g.left) / g.gsd_m).astype(np.int64)
        row = np.floor((g.top - y) / g.gsd_m).astype(np.int64)
        h, w = g.building.shape
        ok = (row >= 0) & (col >= 0) & (row < h) & (col < w)
        kind = np.full(len(x), UNKNOWN, np.uint8)
        kind[ok] = g.building[row[ok], col[ok]]
        other = points.known - points.built
        on, off = kind == BUILDING, kind == OTHER
        return (
            float(points.built[on].sum()),
            float(other[on].sum()),
            float(points.built[off].sum()),
            float(other[off].sum()),
        )


def _moments(score: F32, yaw: F64, cell: float) -> tuple[F64, F64, bool]:
    """Mean (x and y offset, yaw), covariance, and whether more than 2 % of the mass lies on the window's edge."""
    weight = np.exp(score.astype(np.float64) - float(score.max()))
    weight /= weight.sum()
    half = score.shape[1] // 2
    offset = np.arange(-half, half + 1) * cell
    by_yaw, by_row, by_col = weight.sum(axis=(1, 2)), weight.sum(axis=(0, 2)), weight.sum(axis=(0, 1))
    mean = np.array([by_col @ offset, -(by_row @ offset), by_yaw @ yaw])
    dx, dy, dh = offset - mean[0], -offset - mean[1], yaw - mean[2]
    cov = np.empty((3, 3))
    cov[0, 0], cov[1, 1], cov[2, 2] = by_col @ dx**2, by_row @ dy**2, by_yaw @ dh**2
    cov[0, 1] = cov[1, 0] = dy @ weight.sum(axis=0) @ dx
    cov[0, 2] = cov[2, 0] = dh @ weight.sum(axis=1) @ dx
    cov[1, 2] = cov[2, 1] = dh @ weight.sum(axis=2) @ dy
    step = float(yaw[1] - yaw[0]) if len(yaw) > 1 else 0.0
    cov += np.diag([cell**2, cell**2, step**2]) / 12.0
    edge = by_row[0] + by_row[-1] + by_col[0] + by_col[-1] > 0.02
    if len(yaw) > 2 and by_yaw[0] + by_yaw[-1] > 0.05:
        # Few buildings leave the yaw open: the window's own middle and width must not pass for a measurement of it.
        cov[2, :2] = cov[:2, 2] = 0.0
        cov[2, 2] = math.pi**2
    return mean, cov, bool(edge)
