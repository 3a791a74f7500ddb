"""How often a mask sees a building where the map has one and where it has none: given, and learned from views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.match.settings import RateSettings
from brmgeo.match.state import State

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rates:
    """P1, P0 and the area of one independent observation, as they are now."""

    hit: float
    false_alarm: float
    independent_m2: float

    def background(self, rate: float) -> float:
        """pb of a view of this ``rate``: kept within [P0, P1]."""
        return min(max(rate, self.false_alarm), self.hit)

    def weights(self, rate: float) -> tuple[float, float, float, float]:
        """Of points: the ratio is c a + m b, which is exact where c is 0 or 1 (between them it is the mean of two
        logarithms, never above the logarithm of the mean); these are, per square metre, (a of building, a of other,
        b of building, b of other) for a view of this ``rate``."""
        p1, p0 = self.hit, self.false_alarm
        pb = self.background(rate)
        scale = 1.0 / self.independent_m2
        return (
            scale * math.log(p1 / p0),
            scale * math.log((1 - p1) / (1 - p0)),
            scale * math.log(p0 / pb),
            scale * math.log((1 - p0) / (1 - pb)),
        )


class RateLearner:
    """P1 and P0 from registered views: more careful than the settings where the views are worse, never more trusting.

    Counts are kept in independent areas, so that one view weighs about as much as the buildings it shows; the
    settings count as ``PRIOR`` such areas each, and old views fade.
    """

    PRIOR = 60.0
    FADE = 0.98

    def __init__(self, settings: RateSettings) -> None:
        self._settings = settings
        self._hits = np.array([settings.hit, 1.0 - settings.hit]) * self.PRIOR
        self._alarms = np.array([settings.false_alarm, 1.0 - settings.false_alarm]) * self.PRIOR
        self.rates = Rates(settings.hit, settings.false_alarm, settings.independent_m2)

    def learn(self, built_on: float, other_on: float, built_off: float, other_off: float) -> None:
        """Take in one registered view: square metres of building and other, over mapped buildings and elsewhere."""
        if not self._settings.learn:
            return
        unit = self.rates.independent_m2
        self._hits = self._hits * self.FADE + (1 - self.FADE) * self._prior(self._settings.hit)
        self._alarms = self._alarms * self.FADE + (1 - self.FADE) * self._prior(self._settings.false_alarm)
        self._hits += np.array([built_on, other_on]) / unit
        self._alarms += np.array([built_off, other_off]) / unit
        hit = float(self._hits[0] / self._hits.sum())
        alarm = float(self._alarms[0] / self._alarms.sum())
        # A map and masks that hardly agree must not talk the filter into believing anything.
        hit = min(max(hit, 0.4), self._settings.hit)
        alarm = max(min(alarm, 0.5 * hit), self._settings.false_alarm)
        # Rates are kept until they have moved: the map's logarithms are kept for them.
        if abs(hit - self.rates.hit) > 0.02 or abs(math.log(alarm / self.rates.false_alarm)) > 0.1:
            self.rates = Rates(hit, alarm, unit)

    def _prior(self, share: float) -> F64:
        return np.array([share, 1.0 - share]) * self.PRIOR

    def state(self) -> State:
        """The counts and the rates as named arrays."""
        return {
            "hits": self._hits,
            "alarms": self._alarms,
            "rates": np.array([self.rates.hit, self.rates.false_alarm], np.float64),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up what ``state`` gave."""
        self._hits, self._alarms = state["hits"], state["alarms"]
        hit, false_alarm = state["rates"].tolist()
        self.rates = Rates(hit, false_alarm, self._settings.independent_m2)
