"""A flight to simulate over built maps: its ground, its path, its camera, and the imagery that its frames are drawn from."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError
from brmgeo.flight.readings import Camera, FloatArray
from brmgeo.geo.crs import require_meeting
from brmgeo.geo.formats import vector_file
from brmgeo.geo.grid import Bounds, as_bounds
from brmgeo.geo.raster import read_raster
from brmgeo.region import FlightSettings
from brmgeo.synth.flight import (
    Imagery,
    RaisedFootprints,
    SimulationSettings,
    lawnmower,
    path_from_geojson,
    place,
    random_mission,
    rectangle,
)

#: Paths that have a name; others are GeoJSON files.
PATHS = ("rectangle", "lawnmower", "random")
_FLOOR_M = 3.0
#: A waypoint farther off the maps than this is a wrong one.
_FAR_M = 20_000.0


class FineImagery(Protocol):
    """Imagery that is finer than the maps, cut where it is asked for."""

    @property
    def gsd_m(self) -> float:
        """Its metres per pixel."""

    def around(self, bounds: Bounds) -> tuple[NDArray[np.uint8], float, float]:
        """(rgb (h, w, 3), left, top) over (left, bottom, right, top), metres of the maps' CRS."""


@functools.lru_cache(maxsize=2)
def read_ground(footprints: Path) -> RaisedFootprints:
    """Footprints made ready for the simulator, with heights from their floors (3 m each) where they are known."""
    import geopandas as gpd

    frame = gpd.read_file(
        vector_file(footprints), layer="footprints" if footprints.suffix == ".gpkg" else None
    )
    floors = frame["floors"].fillna(1).to_numpy(dtype=float) if "floors" in frame else np.ones(len(frame))
    return RaisedFootprints.from_polygons(list(frame.geometry), list(_FLOOR_M * floors))


def simulator_settings(own: FlightSettings, **changes: Any) -> SimulationSettings:
    """The simulator's settings of a region: camera, height, speed and interval as its file says, then ``changes``."""
    camera = Camera.from_fov(own.width_px, own.height_px, own.fov_deg)
    base = SimulationSettings(
        camera=camera, speed_m_s=own.speed_m_s, frame_interval_s=own.interval_s, agl_m=own.agl_m
    )
    return replace(base, **changes)


def flight_path(path: str, ground: RaisedFootprints, seed: int, bounds: Bounds, crs: str) -> FloatArray:
    """(n, 2) waypoints in ``crs``: one of ``PATHS`` placed over built-up ground by the seed, or the line of a GeoJSON file.

    Raises MissingInputError for what is neither, InputError for a shape that does not fit into the bounds, a file that
    holds no line, or one that leads more than 20 km away from them.
    """
    if path == "rectangle":
        return place(rectangle((0.0, 0.0), 0.0), ground, seed, bounds)
    if path == "random":
        return random_mission(inset(bounds, 100.0), seed)
    if path == "lawnmower":
        return place(lawnmower((0.0, 0.0, 400.0, 300.0), 75.0), ground, seed, bounds)
    if not Path(path).is_file():
        raise MissingInputError(
            f"path {path}: give {', '.join(PATHS)}, or a GeoJSON file with a LineString", needs="path"
        )
    route = path_from_geojson(path, crs)
    require_meeting(
        "path", {path: as_bounds((*route.min(axis=0), *route.max(axis=0)))}, "the maps", bounds, crs
    )
    away = np.maximum(np.array(bounds[:2]) - route, route - np.array(bounds[2:])).max(axis=1)
    if not away.max() <= _FAR_M:
        raise InputError(
            f"{path}: waypoint {int(away.argmax()) + 1} lies {away.max() / 1000.0:.0f} km off the maps: correct it"
        )
    return route


def path_name(path: str) -> str:
    """What a flight along a path is called."""
    return path if path in PATHS else Path(path).stem


def inset(bounds: Bounds, by: float) -> Bounds:
    """Bounds drawn in by so many metres on each side, at most by a quarter of their size."""
    left, bottom, right, top = bounds
    by = min(by, (right - left) / 4, (top - bottom) / 4)
    return (left + by, bottom + by, right - by, top - by)


def imagery_along(
    route: FloatArray, settings: SimulationSettings, file: Path, fine: FineImagery | None = None
) -> Imagery:
    """What frames along a (n, 2) route are drawn from: the finer imagery where there is some, else the whole of a raster.

    Raises MissingInputError or InputError where the raster cannot be read, CrsError where it does not meet the route.
    """
    if fine is not None:
        reach = settings.agl_m * math.tan(math.radians(_seen_deg(settings)) / 2) * 2.5 + 60.0
        (left, bottom), (right, top) = route.min(axis=0) - reach, route.max(axis=0) + reach
        return Imagery(*fine.around((left, bottom, right, top)), fine.gsd_m)
    picture = read_raster(file)
    flown = as_bounds((*route.min(axis=0), *route.max(axis=0)))
    require_meeting("imagery", {str(file): picture.bounds}, "the flight's path", flown, picture.crs)
    return Imagery(np.moveaxis(picture.pixels, 0, -1), picture.left, picture.top, picture.gsd_m)


def _seen_deg(settings: SimulationSettings) -> float:
    """The cone about straight down, degrees, that a simulated camera sees across its short side, tilt counted in."""
    camera, mount = settings.camera, settings.mount
    fov = 2 * math.degrees(math.atan(camera.half_fov_tan))
    tilt = math.degrees(math.hypot(mount.roll_rad, mount.pitch_rad))
    return float(max(fov, min(fov + 2 * tilt, 150.0)))
