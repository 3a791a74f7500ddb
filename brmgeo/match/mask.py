"""The default matcher: the whole building mask of a view against the map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.match.grid import GridMatcher
from brmgeo.match.ground import GroundMap
from brmgeo.match.likelihood import (
    MapCover,
    MaskTiers,
    RateLearner,
    ViewPoints,
    mask_templates,
    view_points,
)
from brmgeo.match.register import Registrar
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class MaskMatcher(GridMatcher):
    """Belief over place and heading, weighed by the mask's log-likelihood ratio; sub-cell registration after a fix."""

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        super().__init__(ground, settings)
        self._cover = MapCover(*ground.coverage(self.cell_px))
        # Of cells of 10 m and more, larger ones would tell nothing of single buildings.
        self._scale = 2 if self.cell_m < 10.0 else 1
        self._coarse = self._cover.coarser() if self._scale == 2 else self._cover
        self._registrar = Registrar(ground)
        self._learner = RateLearner(settings.rates)
        self._points: ViewPoints | None = None

    def _bounds(self) -> tuple[float, float]:
        return self.settings.rates.llr_min, self.settings.rates.llr_max

    def _systematic(self) -> float:
        return self.settings.rates.systematic_sigma_m

    def _least_fit(self) -> tuple[float, int]:
        return self.settings.rates.least_fit, 1

    def _evidence(self, view: View) -> tuple[float, float]:
        return float(np.count_nonzero(view.known)) * view.gsd_m**2, self.settings.rates.repeat

    def _look(self, view: View) -> None:
        self._points = view_points(view, self.cell_m / 2.0)

    def _tiers(self, yaw_rad: float, body: F64 | None, weight: float) -> MaskTiers:
        assert self._points is not None
        yaw = self.belief.heading_of(np.arange(self.belief.headings)) + yaw_rad
        return MaskTiers(
            self._points,
            self._cover,
            self._coarse,
            self._scale,
            self.cell_m,
            yaw,
            self._learner.rates,
            weight,
            body,
        )

    def _search(self, view: View, yaw_rad: float, body: F64 | None, weight: float) -> float:
        return self.belief.search_tiers(self._tiers(yaw_rad, body, weight), *self._bounds(), weight)

    def _score_listed(self, view: View, yaw_rad: float, body: F64 | None) -> F32:
        assert self._points is not None
        if body is not None:
            return self._tiers(yaw_rad, body, 1.0).fine(self.belief.keys)
        wanted = np.zeros(self.belief.headings, np.bool_)
        wanted[self.belief.keys[:, 0]] = True
        yaw = self.belief.heading_of(np.arange(self.belief.headings)) + yaw_rad
        templates = mask_templates(self._points, yaw, self.cell_m, self._learner.rates, wanted)
        return self._cover.score_blocks(self.belief.keys, templates)

    def _measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        sigma = math.sqrt(max(float(covariance[0, 0]), float(covariance[1, 1])))
        turn = math.sqrt(float(covariance[2, 2]))
        window = min(3.0 * sigma + 2.0, 40.0)
        found = self._registrar.register(
            view, pose, window, min(3.0 * turn + 0.01, 0.35), self._learner.rates
        )
        if found is None or found.edge or found.llr < 4.0:
            return None
        if max(found.covariance[0, 0], found.covariance[1, 1]) > 9.0:
            return None
        on_both, missed, extra, _ = found.counts
        fit = 2 * on_both / max(2 * on_both + missed + extra, 1.0)
        # The frame's own share of the levelling error; the flight's own is added to what is reported.
        tilt = (self.settings.odometry.attitude_sigma_rad * view.agl_m) ** 2
        return Anchor(found.pose, found.covariance + np.diag([tilt, tilt, 0.0]), fit)

    def _learn(self, view: View, anchor: Anchor) -> None:
        assert self._points is not None
        self._learner.learn(*self._registrar.counts(self._points, anchor.pose))
