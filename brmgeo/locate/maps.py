"""The maps that a flight is matched to, and the matchers' settings over them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from brmgeo.errors import MissingInputError
from brmgeo.geo.raster import read_raster
from brmgeo.match import GroundMap, MatchSettings, OdometrySettings, PaperSettings
from brmgeo.region import FlightSettings


@dataclass(frozen=True, slots=True)
class Maps:
    """A folder of built maps: the matcher's ground, its CRS, and where imagery and footprints are (None when absent)."""

    folder: Path
    ground: GroundMap
    crs: str
    imagery: Path | None
    footprints: Path | None

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top) of the map, metres."""
        rows, cols = self.ground.building.shape
        g = self.ground
        return (g.left, g.top - rows * g.gsd_m, g.left + cols * g.gsd_m, g.top)

    @property
    def middle(self) -> tuple[float, float]:
        """x and y of the map's middle, metres."""
        left, bottom, right, top = self.bounds
        return (left + right) / 2, (bottom + top) / 2


def read_maps(folder: Path | str) -> Maps:
    """The maps in a folder; MissingInputError where buildings.tif is not there, InputError where it is no map."""
    folder = Path(folder)
    path = folder / "buildings.tif"
    if not path.is_file():
        raise MissingInputError(f"{path} is not there; build the maps first")
    return _read_maps(folder, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=2)
def _read_maps(folder: Path, changed_ns: int) -> Maps:
    # The time of the last change is in the key, so that maps built anew are read anew.
    buildings = read_raster(folder / "buildings.tif")
    ground = GroundMap(buildings.pixels[0], buildings.left, buildings.top, buildings.gsd_m)
    imagery, footprints = folder / "imagery.tif", folder / "footprints.gpkg"
    return Maps(
        folder,
        ground,
        buildings.crs,
        imagery if imagery.is_file() else None,
        footprints if footprints.is_file() else None,
    )


def match_settings(flight: FlightSettings) -> MatchSettings:
    """The matchers' settings for a region: the paper's constants and the greatest speed are the region's own."""
    return MatchSettings(
        odometry=OdometrySettings(max_speed_m_s=flight.max_speed_m_s),
        paper=PaperSettings(radii=flight.rings, e1=flight.e1, eps_m=flight.eps_m, d_max_m=flight.d_max_m),
    )
