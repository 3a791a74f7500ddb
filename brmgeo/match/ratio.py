"""Ratio features alone, rotation invariant: the paper's measurement in a Bayes filter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.maps.ratio import disc_counts
from brmgeo.match.belief import BLOCK
from brmgeo.match.grid import GridMatcher
from brmgeo.match.ground import UNKNOWN, GroundMap, RatioCache, disc_pixels
from brmgeo.match.likelihood import Rates, ring_llr, ring_loglik, view_rings
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class RatioMatcher(GridMatcher):
    """Belief over place and heading, weighed by ring ratios; heading comes from the motion alone."""

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        super().__init__(ground, settings)
        self._cache = RatioCache(ground, settings.ratio.radius_step, self.cell_px)
        r = settings.rates
        self._rates = Rates(r.hit, r.false_alarm, settings.ratio.independent_m2)
        self._llr = np.zeros(self.belief.shape, np.float32)

    def _bounds(self) -> tuple[float, float]:
        return self.settings.rates.llr_min, self.settings.rates.llr_max

    def _learn(self, view: View, anchor: Anchor) -> None:
        """Ratios alone do not tell missed buildings from invented ones: nothing is learned."""

    def _evidence(self, view: View) -> tuple[float, float]:
        return math.pi * view.radius_m**2, self.settings.ratio.repeat

    def _look(self, view: View) -> None:
        rings = view_rings(view, self.settings.ratio.radii)
        maps = [self._cache.at_cells(float(r)) for r in rings.radius_m]
        self._llr = ring_llr(
            rings, [m[0] for m in maps], [m[1] for m in maps], self._rates, self.settings.ratio
        )

    def _score_all(
        self, view: View, yaw_rad: float, wanted: NDArray[np.bool_]
    ) -> Callable[[int], F32 | None]:
        return lambda h: self._llr.copy()

    def _score_listed(self, view: View, yaw_rad: float) -> F32:
        rows, cols = self.belief.shape
        padded = np.zeros((self.belief.grid[0] * BLOCK, self.belief.grid[1] * BLOCK), np.float32)
        padded[:rows, :cols] = self._llr
        n, m = self.belief.grid
        tiles = padded.reshape(n, BLOCK, m, BLOCK).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(tiles[self.belief.keys[:, 1], self.belief.keys[:, 2]])

    def _measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        """The rings' likelihood about the pose on a grid of 1 m, as one Gaussian; the heading stays unknown.

        The likelihood may have several peaks. Its product with the pose's own Gaussian has moments; the
        Gaussian that turns the one into the other is the measurement.
        """
        g = self.ground
        prior = covariance[:2, :2]
        window = min(3.0 * math.sqrt(float(prior.trace())) + 3.0, 40.0)
        rings = view_rings(view, self.settings.ratio.radii)
        stride = max(1, round(1.0 / g.gsd_m))
        half = math.ceil(window / (stride * g.gsd_m)) * stride
        halo = math.floor(float(rings.radius_m[-1]) / g.gsd_m)
        row, col = int((g.top - pose[1]) / g.gsd_m), int((pose[0] - g.left) / g.gsd_m)
        h, w = g.building.shape
        if not (0 <= row < h and 0 <= col < w):
            return None
        reach = half + halo
        cut = np.full((2 * reach + 1, 2 * reach + 1), UNKNOWN, np.uint8)
        r0, r1, c0, c1 = (
            max(0, row - reach),
            min(h, row + reach + 1),
            max(0, col - reach),
            min(w, col + reach + 1),
        )
        cut[r0 - row + reach : r1 - row + reach, c0 - col + reach : c1 - col + reach] = g.building[
            r0:r1, c0:c1
        ]
        inner = slice(halo, halo + 2 * half + 1, stride)
        area = np.float32(g.gsd_m**2)
        built, known = [], []
        whole = bool((cut != UNKNOWN).all())
        for radius in rings.radius_m:
            counts = disc_counts(cut == 1, float(radius) / g.gsd_m)[inner, inner]
            built.append(counts.astype(np.float32) * area)
            if whole:
                known.append(np.full(counts.shape, area * disc_pixels(float(radius) / g.gsd_m), np.float32))
            else:
                known.append(
                    disc_counts(cut != UNKNOWN, float(radius) / g.gsd_m)[inner, inner].astype(np.float32)
                    * area
                )
        loglik = ring_loglik(rings, built, known, self._rates, self.settings.ratio, cell=False).astype(
            np.float64
        )
        offset = np.arange(-half, half + 1, stride)
        x = g.left + (col + offset + 0.5) * g.gsd_m - pose[0]
        y = g.top - (row + offset + 0.5) * g.gsd_m - pose[1]
        inverse = np.linalg.inv(prior)
        quad = (
            inverse[0, 0] * x[None, :] ** 2
            + 2 * inverse[0, 1] * x[None, :] * y[:, None]
            + inverse[1, 1] * y[:, None] ** 2
        )
        log = loglik - 0.5 * quad
        p = np.exp(log - log.max())
        p /= p.sum()
        mean = np.array([p.sum(axis=0) @ x, p.sum(axis=1) @ y])
        dx, dy = x - mean[0], y - mean[1]
        cov = np.array([[p.sum(axis=0) @ dx**2, dy @ p @ dx], [0.0, p.sum(axis=1) @ dy**2]])
        cov[1, 0] = cov[0, 1]
        cov += np.eye(2) / 12.0
        post = np.linalg.inv(cov)
        gain, axes = np.linalg.eigh(post - inverse)
        if gain[1] <= 0:
            return None
        gain = np.maximum(gain, 1e-4)
        info = axes @ np.diag(gain) @ axes.T
        place = pose[:2] + np.linalg.solve(info, post @ mean)
        full = np.zeros((3, 3))
        full[:2, :2] = np.linalg.inv(info)
        full[2, 2] = math.pi**2
        return Anchor(np.array([*place, pose[2]]), full)
