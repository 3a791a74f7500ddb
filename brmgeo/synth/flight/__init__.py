"""Simulated flights: a flight folder, or its views in memory, over any footprints and imagery.

An aircraft follows a path at constant speed with rounded corners, banks in the turns, wobbles and drifts in height. Its
camera sees the footprints through the full camera model; what the flight's instruments say (height, attitude,
odometry, compass) carries errors of its own. Everything follows from one seed: the same seed, settings and ground
give the same bytes. ``simulate_views`` runs the same course as ``simulate`` without the folder.

Odometry errors are those of monocular visual-inertial odometry at height: a scale bias, a random walk of the heading,
and noise. Mask errors are those of a segmentation network: buildings missed (some of them in every frame, as a
network does), false blobs, and wobbly edges; or pixels flipped in smooth patches to a given pixel accuracy.
"""

from __future__ import annotations

from brmgeo.synth.flight.camera import Simulator, frame_name
from brmgeo.synth.flight.course import RATE_HZ, Course, fly
from brmgeo.synth.flight.folder import simulate
from brmgeo.synth.flight.ground import Imagery, RaisedFootprints
from brmgeo.synth.flight.paths import lawnmower, path_from_geojson, place, random_mission, rectangle
from brmgeo.synth.flight.sensors import imu_of, odometry_of
from brmgeo.synth.flight.settings import MaskErrors, OdometryErrors, SimulationSettings
from brmgeo.synth.flight.settings_file import read_simulation_settings
from brmgeo.synth.flight.views import SimulatedViews, simulate_views

__all__ = [
    "RATE_HZ",
    "Course",
    "Imagery",
    "MaskErrors",
    "OdometryErrors",
    "RaisedFootprints",
    "SimulatedViews",
    "SimulationSettings",
    "Simulator",
    "fly",
    "frame_name",
    "imu_of",
    "lawnmower",
    "odometry_of",
    "path_from_geojson",
    "place",
    "random_mission",
    "read_simulation_settings",
    "rectangle",
    "simulate",
    "simulate_views",
]
