"""Ratio features alone, rotation invariant: the paper's measurement in a Bayes filter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.match.belief import BLOCK
from brmgeo.match.grid import GridMatcher
from brmgeo.match.ground import GroundMap, RatioCache
from brmgeo.match.likelihood import Rates, RingMatcher, view_rings
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class RatioMatcher(GridMatcher):
    """Belief over place and heading, weighed by ring ratios; heading comes from the motion alone."""

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        super().__init__(ground, settings)
        self._cache = RatioCache(ground, settings.ratio.radius_step, self.cell_px)
        self._rings = RingMatcher(settings.ratio)
        r = settings.rates
        self._rates = Rates(r.hit, r.false_alarm, r.independent_m2)
        self._llr = np.zeros(self.belief.shape, np.float32)

    def _bounds(self) -> tuple[float, float]:
        return self.settings.rates.llr_min, self.settings.rates.llr_max

    def _look(self, view: View) -> None:
        rings = view_rings(view, self.settings.ratio.radii)
        maps = [self._cache.at_cells(float(r)) for r in rings.radius_m]
        self._llr = self._rings.score(rings, [m[0] for m in maps], [m[1] for m in maps], self._rates)

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
        """The likelihood's own peak near the pose, heading unknown: nothing to register against is left."""
        return None
