"""Matchers: where a view lies on the building map, from the view and the motion since the one before.

``make_matcher`` gives one of three with the same interface: ``step(view, motion) -> Estimate`` live, frame by
frame; ``state()`` and ``restore(state)``, so that another process goes on from there; and, where a history is kept,
``smooth() -> SmoothedPath`` at any time after. ``paper`` keeps the paper's candidate sets (eq.
4-7), ``ratio`` a belief weighed by ratio features, ``mask`` (the default) a belief weighed by the whole mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from brmgeo.errors import SettingsError
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.match.grid import GridMatcher
from brmgeo.match.ground import GroundMap
from brmgeo.match.mask_scorer import MaskScorer
from brmgeo.match.paper import PaperMatcher
from brmgeo.match.ratio_scorer import RatioScorer
from brmgeo.match.settings import (
    BeliefSettings,
    MatchSettings,
    OdometrySettings,
    PaperSettings,
    RateSettings,
    RatioSettings,
)
from brmgeo.match.smooth import SmoothedPath
from brmgeo.match.state import State

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
    "State",
    "make_matcher",
]


class Matcher(Protocol):
    """What every method offers."""

    def step(self, view: View, motion: Motion) -> Estimate:
        """Take in one view and the motion since the view before (the first one's step is not used)."""

    def smooth(self) -> SmoothedPath:
        """The path of all views so far, also before the first fix; SettingsError where no history is kept."""

    def state(self) -> State:
        """All that the views so far have left, as named arrays: numbers and words without dimensions, no objects."""

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave, on a fresh matcher of the same method, map, settings and history: estimates are
        equal, bit for bit, to those of the uninterrupted one. InputError for a state of another, or a damaged one."""


def make_matcher(
    method: str, ground: GroundMap, settings: MatchSettings | None = None, history: bool = False
) -> Matcher:
    """A fresh matcher of ``method`` (``paper``, ``ratio`` or ``mask``) on ``ground``.

    With ``history`` it keeps every view, for ``smooth``; without, its memory does not grow with the flight. Raises
    SettingsError for another method.
    """
    settings = settings or MatchSettings()
    if method == "paper":
        return PaperMatcher(ground, settings, history)
    if method == "ratio":
        return GridMatcher(method, ground, settings, RatioScorer(ground, settings), history)
    if method == "mask":
        return GridMatcher(method, ground, settings, MaskScorer(ground, settings), history)
    raise SettingsError(f"method {method!r} is not known: choose one of {', '.join(METHODS)}")
