"""Coordinate reference systems: transformations, the Korean belts, grid convergence.

Everything here is easting first (``always_xy=True``), whatever axis order EPSG declares: the Korean belts
declare northing first, and that must be forgotten in one place only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError as ProjCrsError

from brmgeo.errors import CrsError
from brmgeo.geo.grid import Bounds

LONLAT = "EPSG:4326"


@dataclass(frozen=True, slots=True)
class Belt:
    """One projected CRS that Korean maps come in.

    Attributes:
        crs: code, for example "EPSG:5187".
        name: EPSG's name without the datum.
        datum: "GRS80" (Korea 2000 / KGD2002, within centimetres of WGS84) or "Bessel" (Korean 1985, some 300 m away).
        lon0_deg: longitude of natural origin, degrees.
        false_easting_m, false_northing_m: metres.
        lon_range: (west, east) degrees in which NGII uses the belt.
    """

    crs: str
    name: str
    datum: str
    lon0_deg: float
    false_easting_m: float
    false_northing_m: float
    lon_range: tuple[float, float]


_WEST, _CENTRAL, _EAST, _SEA, _ALL = (
    (123.0, 126.0),
    (126.0, 128.0),
    (128.0, 130.0),
    (130.0, 133.0),
    (123.0, 133.0),
)
# The modified Bessel belts carry the 10.405" by which the old datum's longitudes were off.
_MODIFIED = 10.405 / 3600.0

BELTS: tuple[Belt, ...] = (
    Belt("EPSG:5185", "West Belt 2010", "GRS80", 125.0, 200e3, 600e3, _WEST),
    Belt("EPSG:5186", "Central Belt 2010", "GRS80", 127.0, 200e3, 600e3, _CENTRAL),
    Belt("EPSG:5187", "East Belt 2010", "GRS80", 129.0, 200e3, 600e3, _EAST),
    Belt("EPSG:5188", "East Sea Belt 2010", "GRS80", 131.0, 200e3, 600e3, _SEA),
    Belt("EPSG:5179", "Unified CS (UTM-K)", "GRS80", 127.5, 1e6, 2e6, _ALL),
    Belt("EPSG:5180", "West Belt", "GRS80", 125.0, 200e3, 500e3, _WEST),
    Belt("EPSG:5181", "Central Belt", "GRS80", 127.0, 200e3, 500e3, _CENTRAL),
    Belt("EPSG:5182", "Central Belt Jeju", "GRS80", 127.0, 200e3, 550e3, _CENTRAL),
    Belt("EPSG:5183", "East Belt", "GRS80", 129.0, 200e3, 500e3, _EAST),
    Belt("EPSG:5184", "East Sea Belt", "GRS80", 131.0, 200e3, 500e3, _SEA),
    Belt("EPSG:5173", "Modified West Belt", "Bessel", 125.0 + _MODIFIED, 200e3, 500e3, _WEST),
    Belt("EPSG:5174", "Modified Central Belt", "Bessel", 127.0 + _MODIFIED, 200e3, 500e3, _CENTRAL),
    Belt("EPSG:5175", "Modified Central Belt Jeju", "Bessel", 127.0 + _MODIFIED, 200e3, 550e3, _CENTRAL),
    Belt("EPSG:5176", "Modified East Belt", "Bessel", 129.0 + _MODIFIED, 200e3, 500e3, _EAST),
    Belt("EPSG:5177", "Modified East Sea Belt", "Bessel", 131.0 + _MODIFIED, 200e3, 500e3, _SEA),
    Belt("EPSG:2098", "West Belt (unmodified)", "Bessel", 125.0, 200e3, 500e3, _WEST),
    Belt("EPSG:2097", "Central Belt (unmodified)", "Bessel", 127.0, 200e3, 500e3, _CENTRAL),
    Belt("EPSG:2096", "East Belt (unmodified)", "Bessel", 129.0, 200e3, 500e3, _EAST),
    Belt("EPSG:5178", "Unified CS", "Bessel", 127.5, 1e6, 2e6, _ALL),
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
    """The transformation from ``src`` to ``dst``, x (easting, longitude) first; cached. CrsError for an unknown CRS."""
    return Transformer.from_crs(parse_crs(src), parse_crs(dst), always_xy=True)


def transform_bounds(src: str, dst: str, bounds: Bounds, densify: int = 21) -> Bounds:
    """Bounds (left, bottom, right, top) in ``dst`` of a rectangle in ``src``, its edges bent as they are.

    ``densify`` is the number of points put on each edge. Raises CrsError when the rectangle has no image in ``dst``.
    """
    left, bottom, right, top = transformer(src, dst).transform_bounds(*bounds, densify_pts=densify)
    if not all(map(math.isfinite, (left, bottom, right, top))):
        raise CrsError(f"bounds {bounds} in {_short(src)} have no place in {_short(dst)}: check the crs")
    return (float(left), float(bottom), float(right), float(top))


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
    lon = _WEST[0] + (int(number[2]) - 3) % 10
    return belt_for_lon(lon + 0.5)


def belt_for_lon(lon_deg: float) -> str:
    """The GRS80 belt ("EPSG:5185" to "EPSG:5188") at a longitude in degrees. Raises CrsError outside 123-133 E."""
    for belt in BELTS[:4]:
        if belt.lon_range[0] <= lon_deg < belt.lon_range[1]:
            return belt.crs
    raise CrsError(
        f"longitude {lon_deg:.4f} lies outside the Korean belts (123-133 E): state the crs yourself"
    )


def belt(crs: str) -> Belt | None:
    """The Korean belt that ``crs`` is, or None."""
    code = crs_name(crs)
    return next((b for b in BELTS if b.crs == code), None)


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
