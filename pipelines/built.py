"""The built maps that a command works over: those of a region, built first where they are not fresh, or of any folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from brmgeo.errors import SettingsError
from brmgeo.locate.maps import read_maps
from brmgeo.region import FlightSettings, Region

from .regions import region_named, safe_name


@dataclass(frozen=True, slots=True)
class BuiltMaps:
    """Built maps and the settings that go with them.

    Attributes:
        name: the region's, or the folder's.
        folder: of the maps.
        flight: flight settings: the region's, or the defaults.
        attribution: of what the maps were made from; empty where nobody says.
        region: whose maps they are; None for a folder.
    """

    name: str
    folder: Path
    flight: FlightSettings
    attribution: str = ""
    region: Region | None = None


def maps_for(
    command: str, region: str | None, maps_dir: Path | None, data: Path, scheduler_spec: str | None
) -> BuiltMaps:
    """The maps of a region, built first where they are not fresh, or of a folder; SettingsError for both or neither."""
    from .map_sources import credits
    from .maps import build_region

    if (region is None) == (maps_dir is None):
        raise SettingsError(
            f"{command}: give either a REGION (such as demo) or --maps with a folder of built maps"
        )
    if maps_dir is not None:
        read_maps(maps_dir.absolute())
        return BuiltMaps(safe_name(maps_dir.absolute().name), maps_dir, FlightSettings())
    assert region is not None
    own, data = region_named(region, data)
    folder = build_region(region, data, None, False, scheduler_spec)
    return BuiltMaps(own.name, folder, own.flight, credits(own), own)
