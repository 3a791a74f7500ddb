"""Coordinate reference systems: transformations, the Korean belts, grid convergence.

Everything here is easting first (``always_xy=True``), whatever axis order EPSG declares: the Korean belts
declare northing first, and that must be forgotten in one place only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError as ProjCrsError
from pyproj.exceptions import ProjError

from brmgeo.errors import CrsError
from brmgeo.geo.grid import Bounds

LONLAT = "EPSG:4326"


# The belts that NGII delivers in, each with the eastern end of its longitudes, degrees; the first begins at 123.
_DELIVERED = (("EPSG:5185", 126.0), ("EPSG:5186", 128.0), ("EPSG:5187", 130.0), ("EPSG:5188", 133.0))
_WEST_LON = 123.0

#: Projected CRSs that Korean maps come in, likelier ones first.
BELTS = (
    # Korea 2000 / KGD2002 on GRS80, within centimetres of WGS84: the belts of 2010, the unified CS, the belts before.
    *(crs for crs, _ in _DELIVERED),
    *("EPSG:5179", "EPSG:5180", "EPSG:5181", "EPSG:5182", "EPSG:5183", "EPSG:5184"),
    # Korean 1985 on Bessel, some 300 m away: the belts modified by 10.405", those without, the unified CS.
    *("EPSG:5173", "EPSG:5174", "EPSG:5175", "EPSG:5176", "EPSG:5177"),
    *("EPSG:2098", "EPSG:2097", "EPSG:2096", "EPSG:5178"),
)


@lru_cache(maxsize=256)
def parse_crs(crs: str) -> CRS:
    """The pyproj CRS that ``crs`` (an EPSG code, WKT or PROJ string) names. Raises CrsError when it names none."""
    try:
        return CRS.from_user_input(crs)
    except ProjCrsError as error:
        raise CrsError(f"crs {_short(crs)!r} is not known: give an EPSG code such as EPSG:5187") from error


@lru_cache(maxsize=256)
def transformer(src: str, dst: str) -> Transformer:
    """The transformation from ``src`` to ``dst``, x (easting, longitude) first; cached.

    CrsError for an unknown CRS, and where none leads to the other: one that is local, or whose definition is damaged.
    """
    try:
        return Transformer.from_crs(parse_crs(src), parse_crs(dst), always_xy=True)
    except ProjError as error:
        raise CrsError(
            f"no transformation leads from {_short(crs_name(src))} to {_short(crs_name(dst))}: state the crs of the data"
        ) from error


def transform_bounds(src: str, dst: str, bounds: Bounds, densify: int = 21) -> Bounds:
    """Bounds (left, bottom, right, top) in ``dst`` of a rectangle in ``src``, its edges bent as they are.

    ``densify`` is the number of points put on each edge. Raises CrsError when the rectangle has no image in ``dst``.
    """
    left, bottom, right, top = transformer(src, dst).transform_bounds(*bounds, densify_pts=densify)
    if not all(map(math.isfinite, (left, bottom, right, top))):
        raise CrsError(f"bounds {bounds} in {_short(src)} have no place in {_short(dst)}: check the crs")
    return (float(left), float(bottom), float(right), float(top))


def apart(what: str, places: Mapping[str, Bounds], where: str, ground: Bounds, crs: str) -> str | None:
    """A line that says how far off the nearest is, where none of several boxes meets a ground; None where one does.

    The usual cause is a wrong CRS, or a file of another place.

    Args:
        what: one of them, in words, such as "image".
        places: (left, bottom, right, top) of each by its name, in ``crs``; none at all are apart from nothing.
        where: the ground in words, such as "the region".
        ground: its (left, bottom, right, top).
        crs: of all of them.
    """
    left, bottom, right, top = ground
    gaps = {
        name: math.hypot(max(west - right, left - east, 0.0), max(south - top, bottom - north, 0.0))
        for name, (west, south, east, north) in places.items()
    }
    if not gaps or 0.0 in gaps.values():
        return None
    name = min(gaps, key=lambda n: gaps[n])
    return (
        f"no {what} lies on {where}: the nearest, {name}, is {gaps[name] / 1000:.1f} km away in {crs_name(crs)}; "
        f"check its crs and {where}"
    )


def require_meeting(what: str, places: Mapping[str, Bounds], where: str, ground: Bounds, crs: str) -> None:
    """Raises CrsError with the line of ``apart``, where there is one."""
    line = apart(what, places, where, ground, crs)
    if line is not None:
        raise CrsError(line)


def same_crs(a: str, b: str) -> bool:
    """Whether two CRS put the same numbers in the same place (axis order aside)."""
    return a == b or bool(parse_crs(a).equals(parse_crs(b), ignore_axis_order=True))


def crs_name(crs: str) -> str:
    """ "EPSG:5187" where the CRS has an EPSG code, else its name: short enough for a message."""
    parsed = parse_crs(crs)
    epsg = parsed.to_epsg()
    return f"EPSG:{epsg}" if epsg is not None else parsed.name


def require_projected_metres(crs: str) -> None:
    """Returns when ``crs`` is projected with both axes in metres, as a region's must be; raises CrsError otherwise."""
    parsed = parse_crs(crs)
    units = {axis.unit_conversion_factor for axis in parsed.axis_info[:2]}
    if not parsed.is_projected or units != {1.0}:
        found = (
            "geographic (degrees)" if parsed.is_geographic else f"in units of {parsed.axis_info[0].unit_name}"
        )
        raise CrsError(
            f"crs {crs_name(crs)} is {found}: a region needs a projected CRS in metres, such as EPSG:5187"
        )


def belt_for_sheet(number: str) -> str:
    """The GRS80 belt ("EPSG:5185" to "EPSG:5188") that NGII delivers a sheet in: its third digit decides."""
    if len(number) < 3 or not number.isascii() or not number.isdigit():
        raise CrsError(f"{number!r} is not a sheet number: give 5 to 9 digits, such as 36914093")
    lon = _WEST_LON + (int(number[2]) - 3) % 10
    return belt_for_lon(lon + 0.5)


def belt_for_lon(lon_deg: float) -> str:
    """The GRS80 belt ("EPSG:5185" to "EPSG:5188") at a longitude in degrees. Raises CrsError outside 123-133 E."""
    if lon_deg >= _WEST_LON:
        for crs, east in _DELIVERED:
            if lon_deg < east:
                return crs
    raise CrsError(
        f"longitude {lon_deg:.4f} lies outside the Korean belts (123-133 E): state the crs yourself"
    )


def on_old_datum(crs: str) -> bool:
    """Whether ``crs`` is a Korean belt on the old datum (Korean 1985, Bessel), some 300 m away from today's."""
    ellipsoid = parse_crs(crs).ellipsoid
    return crs_name(crs) in BELTS and ellipsoid is not None and ellipsoid.name == "Bessel 1841"


def convergence_rad(crs: str, x: float, y: float) -> float:
    """Grid convergence at (x, y) of a projected CRS, radians: the clockwise angle from true north to grid north.

    Heading from grid north = heading from true north - convergence. Positive east of the central meridian.
    """
    geodetic = parse_crs(crs).geodetic_crs
    assert geodetic is not None
    lon, lat = transformer(crs, geodetic.to_wkt()).transform(x, y)
    if not (math.isfinite(lon) and math.isfinite(lat)):
        raise CrsError(f"({x}, {y}) has no place in {crs_name(crs)}: check the crs")
    return math.radians(_proj(crs).get_factors(lon, lat).meridian_convergence)


@lru_cache(maxsize=64)
def _proj(crs: str) -> Proj:
    return Proj(parse_crs(crs))


def _short(crs: str) -> str:
    return crs if len(crs) <= 40 else crs[:37] + "..."
