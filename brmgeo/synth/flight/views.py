"""A simulated flight in memory: what the matcher gets, and the truth."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from brmgeo.flight.motion import motions
from brmgeo.flight.readings import FloatArray, Reference
from brmgeo.flight.values import Motion, View
from brmgeo.synth.flight.camera import Simulator
from brmgeo.synth.flight.course import fly
from brmgeo.synth.flight.ground import RaisedFootprints
from brmgeo.synth.flight.sensors import odometry_of
from brmgeo.synth.flight.settings import SimulationSettings


class SimulatedViews(NamedTuple):
    """A flight in memory: what the matcher gets, and the truth at the frames for scores."""

    views: list[View]
    motions: list[Motion]
    reference: Reference
    yaw_rad: FloatArray


def simulate_views(
    ground: RaisedFootprints,
    path: FloatArray,
    settings: SimulationSettings | None = None,
    seed: int = 0,
    gsd_m: float = 0.5,
    *,
    relief: bool = False,
    **view_options: Any,
) -> SimulatedViews:
    """Views, motions, reference and true yaw (n,) of a masks-only flight, by the same course as ``simulate``.

    Args:
        ground: the footprints that are really there; give others than the map's to fly off the map.
        path: (k, 2) waypoints in the map frame, metres.
        gsd_m: ground sampling distance of the views.
        view_options: handed to ``make_view``.
    """
    settings = settings or SimulationSettings()
    course = fly(path, settings, seed)
    simulator = Simulator(ground, settings, course, seed)
    views = [
        simulator.view(i, simulator.mask(i, relief), gsd_m, **view_options)
        for i in range(len(course.frame_index))
    ]
    track = None if settings.odometry is None else odometry_of(course, settings.odometry, seed)
    compass = None
    if course.measured_grid_heading_deg is not None:
        compass = [math.radians(90.0 - h) for h in course.measured_grid_heading_deg]
    steps = motions(track, course.frame_times_s, compass_yaw_rad=compass)
    reference = Reference(course.frame_times_s, course.xyz_m[course.frame_index, :2])
    return SimulatedViews(views, steps, reference, course.roll_pitch_yaw[course.frame_index, 2])
