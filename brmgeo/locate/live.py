"""A flight located frame by frame: its views, its motions, and the matcher's answers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.folder import Flight
from brmgeo.flight.motion import RESET_SPEED_M_S, motions
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.locate.masks import FrameMasks
from brmgeo.match import GroundMap, MatchSettings, SmoothedPath, make_matcher

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Located:
    """What a matcher said of one flight; ``seconds`` (n,) is what each step took."""

    estimates: list[Estimate]
    smoothed: SmoothedPath
    seconds: FloatArray


def locate(
    ground: GroundMap,
    views: Iterator[View] | Sequence[View],
    steps: Sequence[Motion],
    method: str,
    settings: MatchSettings,
) -> Located:
    """Runs a matcher over a flight's views, live, and smooths at the end."""
    matcher = make_matcher(method, ground, settings, history=True)
    estimates, seconds = [], []
    for view, motion in zip(views, steps, strict=True):
        start = time.perf_counter()
        estimate = matcher.step(view, motion)
        seconds.append(time.perf_counter() - start)
        estimates.append(estimate)
    return Located(estimates, matcher.smooth(), np.array(seconds))


def view_at(flight: Flight, gsd_m: float, index: int, masks: FrameMasks | None = None) -> View:
    """The levelled view of one frame's mask, of the flight's own where no others are given."""
    frame = flight.frames[index]
    return make_view(
        flight.mask(index) if masks is None else masks.image(index),
        flight.camera,
        flight.mount,
        frame.roll_rad,
        frame.pitch_rad,
        frame.agl_m if masks is None else masks.agl_m(index),
        gsd_m,
        t_s=frame.t_s,
        file=frame.file,
    )


def motions_of(
    flight: Flight, compass_yaw_rad: list[float | None] | None = None, max_speed_m_s: float = RESET_SPEED_M_S
) -> list[Motion]:
    """The flight's motions, with what a trusted compass says of each frame.

    Odometry that moves faster than ``max_speed_m_s``, and than ``RESET_SPEED_M_S``, was reset there.
    """
    return motions(
        flight.odometry,
        flight.times_s,
        compass_yaw_rad=compass_yaw_rad,
        max_speed_m_s=max(RESET_SPEED_M_S, max_speed_m_s),
    )
