"""Building ratio map localization: where a drone is, without GNSS, from free building maps.

The names here are what a program aboard needs; each is imported when it is asked for, so that ``import brmgeo`` costs
nothing. The rooms below hold the rest.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brmgeo.errors import BrmgeoError
    from brmgeo.flight.folder import Flight, read_flight
    from brmgeo.flight.motion import Pose, poses_at
    from brmgeo.flight.readings import Attitude, Camera
    from brmgeo.flight.values import Estimate, Motion, View
    from brmgeo.flight.vio import Vio, VioSettings
    from brmgeo.locate.localizer import Localizer
    from brmgeo.locate.maps import Maps, read_maps
    from brmgeo.match import GroundMap, MatchSettings
    from brmgeo.segment.predict import Segmenter

__version__ = "0.1.0"

_ROOMS = {
    "Attitude": "brmgeo.flight.readings",
    "BrmgeoError": "brmgeo.errors",
    "Camera": "brmgeo.flight.readings",
    "Estimate": "brmgeo.flight.values",
    "Flight": "brmgeo.flight.folder",
    "GroundMap": "brmgeo.match",
    "Localizer": "brmgeo.locate.localizer",
    "Maps": "brmgeo.locate.maps",
    "MatchSettings": "brmgeo.match",
    "Motion": "brmgeo.flight.values",
    "Pose": "brmgeo.flight.motion",
    "Segmenter": "brmgeo.segment.predict",
    "View": "brmgeo.flight.values",
    "Vio": "brmgeo.flight.vio",
    "VioSettings": "brmgeo.flight.vio",
    "poses_at": "brmgeo.flight.motion",
    "read_flight": "brmgeo.flight.folder",
    "read_maps": "brmgeo.locate.maps",
}

__all__ = [
    "Attitude",
    "BrmgeoError",
    "Camera",
    "Estimate",
    "Flight",
    "GroundMap",
    "Localizer",
    "Maps",
    "MatchSettings",
    "Motion",
    "Pose",
    "Segmenter",
    "View",
    "Vio",
    "VioSettings",
    "poses_at",
    "read_flight",
    "read_maps",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'brmgeo' has no attribute {name!r}")
    value = getattr(importlib.import_module(_ROOMS[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
