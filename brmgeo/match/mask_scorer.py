"""The default method: the whole building mask of a view against the map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.match.belief import Belief
from brmgeo.match.ground import GroundMap
from brmgeo.match.mask import MapCover, MaskTiers, ViewPoints, mask_templates, view_points
from brmgeo.match.rates import RateLearner
from brmgeo.match.register import Registrar
from brmgeo.match.search import search_tiers
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor
from brmgeo.match.state import State

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class MaskScorer:
    """The mask's log-likelihood ratio; sub-cell registration; rates that are learned. See ``Scorer``."""

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        self.systematic_m = settings.rates.systematic_sigma_m
        self.least_fit = (settings.rates.least_fit, 1)
        self._settings = settings
        cell_px = settings.belief.cell_px(ground.gsd_m)
        self._cell_m = cell_px * ground.gsd_m
        self._cover = MapCover(*ground.coverage(cell_px))
        # Of cells of 10 m and more, larger ones would tell nothing of single buildings.
        self._scale = 2 if self._cell_m < 10.0 else 1
        self._coarse = self._cover.coarser() if self._scale == 2 else self._cover
        self._registrar = Registrar(ground)
        self._learner = RateLearner(settings.rates)
        self._points: ViewPoints | None = None

    def look(self, view: View) -> None:
        """See ``Scorer``."""
        self._points = view_points(view, self._cell_m / 2.0)

    def evidence(self, view: View) -> tuple[float, float]:
        """See ``Scorer``."""
        return float(np.count_nonzero(view.known)) * view.gsd_m**2, self._settings.rates.repeat

    def _tiers(self, belief: Belief, yaw_rad: float, body: F64 | None, weight: float) -> MaskTiers:
        assert self._points is not None
        return MaskTiers(
            points=self._points,
            cover=self._cover,
            coarse=self._coarse,
            scale=self._scale,
            cell_m=self._cell_m,
            yaw_rad=belief.heading_of(np.arange(belief.headings)) + yaw_rad,
            rates=self._learner.rates,
            weight=weight,
            body=body,
        )

    def search(self, belief: Belief, yaw_rad: float, body: F64 | None, weight: float) -> float:
        """See ``Scorer``."""
        tiers = self._tiers(belief, yaw_rad, body, weight)
        return search_tiers(belief, tiers, *self._settings.rates.bounds, weight)

    def score_listed(self, belief: Belief, yaw_rad: float, body: F64 | None) -> F32:
        """See ``Scorer``."""
        assert self._points is not None
        if body is not None:
            return self._tiers(belief, yaw_rad, body, 1.0).fine(belief.keys)
        wanted = np.zeros(belief.headings, np.bool_)
        wanted[belief.keys[:, 0]] = True
        yaw = belief.heading_of(np.arange(belief.headings)) + yaw_rad
        templates = mask_templates(self._points, yaw, self._cell_m, self._learner.rates, wanted)
        return self._cover.score_blocks(belief.keys, templates)

    def measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        """See ``Scorer``: registered at the map's own pixels."""
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
        tilt = (self._settings.odometry.attitude_sigma_rad * view.agl_m) ** 2
        return Anchor(found.pose, found.covariance + np.diag([tilt, tilt, 0.0]), fit)

    def learn(self, anchor: Anchor) -> None:
        """See ``Scorer``: rates from what the view and the map have in common."""
        assert self._points is not None
        self._learner.learn(*self._registrar.counts(self._points, anchor.pose))

    def state(self) -> State:
        """See ``Scorer``: the rates."""
        return self._learner.state()

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See ``Scorer``."""
        self._learner.restore(state)
