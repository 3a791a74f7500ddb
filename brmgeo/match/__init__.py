"""Matchers: where a view lies on the building map, from the view and the motion since the one before.

``make_matcher`` gives one of three with the same interface: ``step(view, motion) -> Estimate`` live, frame by
frame, and ``smooth() -> SmoothedPath`` at any time after. ``paper`` keeps the paper's candidate sets (eq.
4-7), ``ratio`` a belief weighed by ratio features, ``mask`` (the default) a belief weighed by the whole mask.
"""

from __future__ import annotations

from typing import Literal, Protocol

from brmgeo.errors import SettingsError
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.match.ground import GroundMap
from brmgeo.match.mask import MaskMatcher
from brmgeo.match.paper import PaperMatcher
from brmgeo.match.ratio import RatioMatcher
from brmgeo.match.settings import (
    BeliefSettings,
    MatchSettings,
    OdometrySettings,
    PaperSettings,
    RateSettings,
    RatioSettings,
)
from brmgeo.match.smooth import SmoothedPath

Method = Literal["paper", "ratio", "mask"]
METHODS: tuple[Method, ...] = ("paper", "ratio", "mask")

__all__ = [
    "METHODS",
    "BeliefSettings",
    "GroundMap",
    "MatchSettings",
    "Matcher",
    "Method",
    "OdometrySettings",
    "PaperSettings",
    "RateSettings",
    "RatioSettings",
    "SmoothedPath",
    "make_matcher",
]


class Matcher(Protocol):
    """What every method offers."""

    def step(self, view: View, motion: Motion) -> Estimate:
        """Take in one view and the motion since the view before (the first one's step is not used)."""

    def smooth(self) -> SmoothedPath:
        """The path of all views so far, also before the first fix."""


def make_matcher(method: str, ground: GroundMap, settings: MatchSettings | None = None) -> Matcher:
    """A fresh matcher of ``method`` (``paper``, ``ratio`` or ``mask``) on ``ground``.

    Raises SettingsError for another method.
    """
    settings = settings or MatchSettings()
    if method == "paper":
        return PaperMatcher(ground, settings)
    if method == "ratio":
        return RatioMatcher(ground, settings)
    if method == "mask":
        return MaskMatcher(ground, settings)
    raise SettingsError(f"method {method!r} is not known: choose one of {', '.join(METHODS)}")
