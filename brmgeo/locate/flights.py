"""A whole flight located, frame by frame as it would be live, and smoothed at the end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.folder import Flight
from brmgeo.flight.motion import poses_at
from brmgeo.flight.readings import Attitude
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.locate.localizer import Localizer, usual_reset_speed_m_s
from brmgeo.locate.maps import Maps
from brmgeo.locate.masks import FrameMasks
from brmgeo.locate.mount import FoundMount
from brmgeo.match import GroundMap, MatchSettings, SmoothedPath, make_matcher

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Located:
    """What a matcher said of one flight.

    Attributes:
        estimates: one a frame, as they were made live.
        smoothed: the path by the whole flight.
        seconds: (n,) what each step took the matcher.
        motions: from the frame before to each frame.
        found_mount: the camera's mount, where it was unknown and was found.
    """

    estimates: list[Estimate]
    smoothed: SmoothedPath
    seconds: FloatArray
    motions: list[Motion]
    found_mount: FoundMount | None = None


def locate(
    ground: GroundMap,
    views: Iterable[View],
    steps: Sequence[Motion],
    method: str,
    settings: MatchSettings,
) -> Located:
    """Runs a matcher over views that are there already, and smooths at the end."""
    matcher = make_matcher(method, ground, settings, history=True)
    estimates, seconds = [], []
    for view, motion in zip(views, steps, strict=True):
        start = time.perf_counter()
        estimate = matcher.step(view, motion)
        seconds.append(time.perf_counter() - start)
        estimates.append(estimate)
    return Located(estimates, matcher.smooth(), np.array(seconds), list(steps))


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


def locate_flight(
    maps: Maps,
    flight: Flight,
    masks: FrameMasks,
    *,
    method: str = "mask",
    settings: MatchSettings | None = None,
    compass_yaw_rad: Sequence[float | None] | None = None,
    mount_sigma_rad: float = 0.0,
    each: Callable[[Callable[[int], Estimate], Sequence[int]], Iterable[Estimate]] = map,
) -> Located:
    """Takes a whole flight through a ``Localizer``, frame by frame as it would be live, and smooths at the end.

    Args:
        maps: of the region below.
        flight: gives camera, times, readings and odometry.
        masks: of its frames.
        method, settings: as in ``Localizer``.
        compass_yaw_rad: (n,) yaw of the nose in the map frame from a trusted compass, or None.
        mount_sigma_rad: as in ``Localizer``.
        each: calls a function with each number, in order, and gives the results, as ``map`` does.
    """
    settings = settings or MatchSettings()
    here = Localizer(
        maps,
        flight.camera,
        flight.mount,
        method=method,
        settings=settings,
        roof_m=masks.roof_m,
        # The track's own poses, far closer together than frames, tell where it was reset.
        reset_speed_m_s=math.inf,
        history=True,
        mount_sigma_rad=mount_sigma_rad,
    )
    poses = poses_at(flight.odometry, flight.times_s, max_speed_m_s=usual_reset_speed_m_s(settings))
    motions: list[Motion] = []
    seconds: list[float] = []

    def step(index: int) -> Estimate:
        frame = flight.frames[index]
        estimate = here.step(
            frame.t_s,
            masks.image(index),
            Attitude(frame.roll_rad, frame.pitch_rad),
            frame.agl_m,
            poses[index],
            compass_yaw_rad=None if compass_yaw_rad is None else compass_yaw_rad[index],
            file=frame.file,
        )
        assert here.last is not None
        motions.append(here.last.motion)
        seconds.append(here.last.seconds)
        return estimate

    estimates = list(each(step, range(len(flight.frames))))
    return Located(estimates, here.smooth(), np.array(seconds), motions, here.found_mount)
