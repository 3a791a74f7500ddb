"""Who may be trained on: not what is held out or flown over, nor a copy of it, nor ground that shows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import shapely

from brmgeo.errors import CrsError, SettingsError, listed
from brmgeo.geo.crs import transform_bounds
from brmgeo.geo.grid import Bounds, as_bounds
from brmgeo.region import Region

from .map_sources import place_of
from .regions import described_regions, flown_mark, region_named

SAME_TOWN_M = 10.0


def flights_over(name: str, data: Path) -> list[str]:
    """Names of the flights, own or simulated, over a region: those below its folders and what was noted of others."""
    found = {p.parent.name for p in (data / "source" / name / "flights").glob("*/flight.toml")}
    found |= {p.name for p in (data / "out" / name / "flights").glob("*") if p.is_dir()}
    if (data / "out" / name / "evaluation").is_dir():
        found.add("the simulated flights of brmgeo evaluate")
    if (mark := flown_mark(name, data)).is_file():
        found.add(f"flights with results elsewhere ({mark} says so)")
    return sorted(found)


def require_trainable(region: Region, data: Path) -> None:
    """Raises SettingsError (one line) for a region that must not be trained on: held out, flown over, or a copy of such."""
    if region.training.hold_out:
        raise SettingsError(
            f"region {region.name} is held out (training.hold_out = true in its region file), so it is never trained on: "
            "name other regions, or cut it for testing only"
        )
    flown = flights_over(region.name, data)
    if flown:
        raise SettingsError(
            f"region {region.name} is flown over by {listed(flown)}, so it is never trained on: set training.hold_out "
            "= true in its region file to cut it for testing, or train on other regions"
        )
    for other in _tested_regions(region, data):
        if _same_town(region, other):
            raise SettingsError(
                f"region {region.name} is the same generated town as {other.name}, which is held out or flown over, so it "
                "is never trained on: give it another [generate] seed"
            )


def require_all_trainable(names: Sequence[str], data: Path, split: str | None) -> list[tuple[Region, Path]]:
    """The regions of these names, checked before the first is worked on: see ``require_trainable``.

    ``split`` is what the user asks for in place of the region files' own; tiles for testing may be cut anywhere.
    """
    found = []
    for name in names:
        region, own = region_named(name, data)
        wanted = split or ("test" if region.training.hold_out else region.training.split)
        if wanted != "test":
            require_trainable(region, own)
        found.append((region, own))
    return found


def held_ground(region: Region, data: Path) -> list[tuple[str, Bounds]]:
    """Names and bounds, in the region's CRS, of real held-out or flown regions: no tile of another region may show them.

    Generated regions only borrow their coordinates: two that overlap show different towns.
    """
    found: list[tuple[str, Bounds]] = []
    if region.generate is not None or region.training.hold_out or region.training.split == "test":
        return found
    own = shapely.box(*place_of(region))
    for other in _tested_regions(region, data):
        place = _place_in(region.crs, other) if other.generate is None else None
        if place is None:
            continue
        grown = place.buffer(region.training.guard_m, join_style="mitre")
        if grown.intersects(own):
            found.append((other.name, as_bounds(grown.bounds)))
    return found


def _tested_regions(region: Region, data: Path) -> Iterator[Region]:
    """The other regions that are held out, for testing only, or flown over."""
    for other in described_regions(data):
        if other.name == region.name:
            continue
        if other.training.hold_out or other.training.split == "test" or flights_over(other.name, data):
            yield other


def _same_town(region: Region, other: Region) -> bool:
    """Whether two generated regions show one town: it follows from seed, style and the numbers of the bounds, whatever
    the CRS and season. Bounds a few metres apart give nearly the same; from ten on hardly a building stands in both."""
    a, b = region.generate, other.generate
    if a is None or b is None or (a.seed, a.style) != (b.seed, b.style):
        return False
    pairs = zip(place_of(region), place_of(other), strict=True)
    return all(abs(own - far) <= SAME_TOWN_M for own, far in pairs)


def _place_in(crs: str, other: Region) -> Any:
    """The ground of a region in another CRS; None where it has no place there, far away as it is."""
    try:
        return shapely.box(*transform_bounds(other.crs, crs, place_of(other)))
    except CrsError:
        return None
