"""What a method adds to the grid filter: how well a view fits where."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.match.belief import Belief
from brmgeo.match.smooth import Anchor
from brmgeo.match.state import State

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Scorer(Protocol):
    """Scores views on one map. ``look`` comes first, and what follows is about that view.

    Attributes:
        systematic_m: what all views of a flight get wrong together beside their levelling, metres per axis.
        least_fit: how well measured poses must fit before there is a first fix, in the mean of so many successive frames.
    """

    systematic_m: float
    least_fit: tuple[float, int]

    def look(self, view: View) -> None:
        """Prepare for scoring one view."""

    def search(self, belief: Belief, yaw_rad: float, body: F64 | None, weight: float) -> float:
        """Weigh the belief by the view's ratios over the whole map; returns the log of the evidence.

        ``yaw_rad`` is the body's yaw in the odometry frame; ``body`` is None, or (headings,) log weights of the body's
        yaw in the map where the odometry does not know it.
        """

    def score_listed(self, belief: Belief, yaw_rad: float, body: F64 | None) -> F32:
        """(n, 16, 16) ratios of the belief's listed blocks; arguments as in ``search``."""

    def evidence(self, view: View) -> tuple[float, float]:
        """Ground that the evidence comes from, square metres, and its weight per share of new ground."""

    def measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        """Any view's pose measured near a pose with a covariance, or None where it cannot be trusted."""

    def learn(self, anchor: Anchor) -> None:
        """Adapt to the view, whose pose is well known."""

    def state(self) -> State:
        """What earlier views changed, as named arrays."""

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Take up what ``state`` gave."""
