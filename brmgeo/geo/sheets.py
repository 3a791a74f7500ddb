"""NGII sheet numbers: where a sheet lies, which sheets cover a place, and whether data lie where their sheet does.

A number is its own place: digits 1-2 are the latitude and digit 3 the longitude of a square degree (3-9 for
123-129 E, 0-2 for 130-132 E), the rest counts cells row by row from the north-west corner:

======  =======  ======================================
digits  cell     counted in
======  =======  ======================================
5       15'      4 x 4 of the degree (1:50,000)
6       7'30"    2 x 2 of the 15' sheet (1:25,000)
7       3'       5 x 5 of the 15' sheet (1:10,000)
8       1'30"    10 x 10 of the 15' sheet (1:5,000)
9       18"      10 x 10 of the 3' sheet (1:1,000)
======  =======  ======================================

Three digits count to 100; of two digits, 00 stands for the hundredth cell. Sheets are cut along whole
longitudes and latitudes, so in a projected CRS their edges are slightly turned and bent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Geod

from brmgeo.errors import CrsError, InputError
from brmgeo.geo.crs import (
    BELTS,
    LONLAT,
    crs_name,
    on_old_datum,
    parse_crs,
    require_projected_metres,
    same_crs,
    transformer,
)
from brmgeo.geo.grid import Bounds

# Square degrees that NGII numbers; other runs of digits in file names (dates, layer codes) fail this.
_LAT_RANGE = range(32, 44)
# (cells a side within the parent, digits of the counter, digits of the parent's number)
_LEVELS = {5: (4, 2, 3), 6: (2, 1, 5), 7: (5, 2, 5), 8: (10, 3, 5), 9: (10, 2, 7)}
# Korean 1985: sheets made before 2003 were cut along its longitudes and latitudes, sheets since along Korea 2000's.
_BESSEL_LONLAT = "EPSG:4162"
_EDGE_POINTS = 16


def sheet_bounds_lonlat(number: str) -> Bounds:
    """(west, south, east, north) in degrees of a sheet of 5 to 9 digits. Raises InputError for an impossible number.

    Method: FACTS on NGII numbering; 36914093 is 129.300-129.325 E, 36.000-36.025 N.
    """
    west, north, size = _cell(number)
    return (float(west), float(north - size), float(west + size), float(north))


def is_sheet_number(text: str) -> bool:
    """Whether ``text`` is a possible NGII sheet number of 5 to 9 digits."""
    try:
        _cell(text)
    except InputError:
        return False
    return True


def sheet_polygon(number: str, crs: str, bessel: bool = False) -> shapely.Polygon:
    """The sheet's outline in ``crs``, counter-clockwise, 16 segments an edge: within 1 mm of the bent edge at 1:5,000.

    ``bessel`` takes the number's longitudes and latitudes on the old datum (sheets cut before 2003).
    """
    return shapely.Polygon(_ring(number, crs, bessel))


def sheet_extent(number: str, crs: str, bessel: bool = False) -> Bounds:
    """(left, bottom, right, top) in ``crs`` of a sheet, its bent edges included; see sheet_polygon."""
    ring = _ring(number, crs, bessel)
    left, bottom = ring.min(axis=0)
    right, top = ring.max(axis=0)
    return (float(left), float(bottom), float(right), float(top))


def sheet_at(lon_deg: float, lat_deg: float, digits: int = 8) -> str:
    """The sheet of ``digits`` digits that holds a point; points on an edge belong to the sheet east or south of it.

    Raises InputError outside the numbered degrees (123-133 E, 32-44 N) or for digits other than 5 to 9.
    """
    if digits not in _LEVELS:
        raise InputError(f"sheet numbers have 5 to 9 digits, not {digits}")
    # Exact fractions of the decimal that was written: 36.025 must fall on its edge, not a binary hair beside it.
    lon, lat = Fraction(repr(float(lon_deg))), Fraction(repr(float(lat_deg)))
    lat0 = math.ceil(lat) - 1
    lon0 = math.floor(lon)
    if lat0 not in _LAT_RANGE or not 123 <= lon0 < 133:
        raise InputError(f"({lon_deg}, {lat_deg}) lies outside NGII's sheets (123-133 E, 32-44 N)")
    number, west, north, size = f"{lat0}{lon0 % 10}", Fraction(lon0), Fraction(lat0 + 1), Fraction(1)
    for level in _chain(digits):
        side, width, _ = _LEVELS[level]
        size /= side
        row, col = math.floor((north - lat) / size), math.floor((lon - west) / size)
        west, north = west + col * size, north - row * size
        count = row * side + col + 1
        number += f"{count % 10**width:0{width}d}"
    return number


def sheets_covering(bounds: Bounds, crs: str, digits: int = 8) -> list[str]:
    """All sheets that share more than a square centimetre with ``bounds`` in ``crs``, north to south, west to east.

    Raises InputError when the bounds lie outside NGII's sheets.
    """
    target = shapely.box(*bounds)
    ring = shapely.get_coordinates(shapely.segmentize(target, max(target.length / 256.0, 1e-9)))
    lon, lat = transformer(crs, LONLAT).transform(ring[:, 0], ring[:, 1])
    west, south, east, north = float(min(lon)), float(min(lat)), float(max(lon)), float(max(lat))
    if not all(map(math.isfinite, (west, south, east, north))):
        raise InputError(
            f"bounds {bounds} in {crs_name(crs)} have no longitude and latitude: check bounds and crs"
        )
    first, last = sheet_at(west, north, digits), sheet_at(east, south, digits)
    west0, north0, size = _cell(first)
    west1, north1, _ = _cell(last)
    numbers = []
    for row in range(int((north0 - north1) / size) + 1):
        for col in range(int((west1 - west0) / size) + 1):
            number = sheet_at(
                float(west0 + (col + Fraction(1, 2)) * size),
                float(north0 - (row + Fraction(1, 2)) * size),
                digits,
            )
            if sheet_polygon(number, crs).intersection(target).area > 1e-4:
                numbers.append(number)
    return numbers


def sheet_number_in(filename: str) -> str | None:
    """The sheet number in a file's name, or None: the longest run of digits that is one, the first of equals."""
    name = re.split(r"[\\/]", filename)[-1]
    runs = [run for run in re.findall(r"\d+", name) if 5 <= len(run) <= 9 and is_sheet_number(run)]
    return max(runs, key=len, default=None)


def check_extent(
    extent: Bounds,
    crs: str,
    sheets: Sequence[str],
    what: str = "data",
    tolerance_m: float = 20.0,
    neatline: bool = False,
) -> float:
    """How far ``extent`` of data read as ``crs`` reaches beyond its sheets, metres; raises CrsError above ``tolerance_m``.

    A DXF never says its CRS: extents tell false northing and datum, the sheet number tells the belt. Where the
    stated CRS does not fit, the Korean belts are tried, and the message says which fits and how far off the
    stated one would have put the data.

    Args:
        extent: (left, bottom, right, top) of the outlines or of the neatline, in ``crs`` as stated.
        crs: the stated CRS.
        sheets: numbers of the sheets that the data belong to; empty when unknown (then only the CRS's own
            neighbourhood is checked, with 300 km of margin).
        what: the name used in the message.
        tolerance_m: allowed overhang. Outlines are cut at the neatline, so a datum mix-up (some 300 m) shows.
        neatline: the extent is the sheet's own frame and must match on all four sides, not only lie inside.
    """
    require_projected_metres(crs)
    if not sheets:
        return _check_area_of_use(extent, crs, what)
    stated = min(_misfit(extent, crs, sheets, bessel, neatline) for bessel in _graticules(crs))
    if stated <= tolerance_m:
        return stated
    fits: list[tuple[float, int, str]] = []
    for order, candidate in enumerate(BELTS):
        for bessel in _graticules(candidate):
            misfit = _misfit(extent, candidate, sheets, bessel, neatline)
            if misfit <= tolerance_m:
                fits.append((misfit if neatline else 0.0, order, candidate))
    place = f"{what}: coordinates lie {_distance(stated)} from sheet {_listed(sheets)} when read as {crs_name(crs)}"
    if not fits:
        left, bottom, right, top = extent
        raise CrsError(
            f"{place}, and no Korean belt fits x {left:.0f}..{right:.0f}, y {bottom:.0f}..{top:.0f}: "
            "check the crs and the sheet number in the file's name"
        )
    best = min(fits)[2]
    cost = _distance_between(extent, crs, best)
    raise CrsError(
        f'{place}; {best} fits (the stated one would put them {_distance(cost)} off): set crs = "{best}"'
    )


def _check_area_of_use(extent: Bounds, crs: str, what: str) -> float:
    """0.0 when the extent's centre lies within 300 km of where the CRS is meant for."""
    x, y = (extent[0] + extent[2]) / 2.0, (extent[1] + extent[3]) / 2.0
    lon, lat = transformer(crs, LONLAT).transform(x, y)
    area = parse_crs(crs).area_of_use
    if math.isfinite(lon) and math.isfinite(lat):
        if area is None or area.east < area.west:
            return 0.0
        near_lon, near_lat = min(max(lon, area.west), area.east), min(max(lat, area.south), area.north)
        distance = Geod(ellps="GRS80").inv(lon, lat, near_lon, near_lat)[2]
        if distance <= 300e3:
            return 0.0
        found = f"{_distance(distance)} outside the area that {crs_name(crs)} is meant for"
    else:
        found = f"nowhere on earth when read as {crs_name(crs)}"
    raise CrsError(f"{what}: coordinates around x {x:.0f}, y {y:.0f} lie {found}: state the crs they are in")


def _misfit(extent: Bounds, crs: str, sheets: Sequence[str], bessel: bool, neatline: bool) -> float:
    """Largest distance, metres, by which the extent's sides pass (or, for a neatline, miss) those of the sheets."""
    boxes = np.array([sheet_extent(number, crs, bessel) for number in sheets])
    if not np.isfinite(boxes).all():
        return math.inf
    beyond = np.concatenate(
        [boxes[:, :2].min(axis=0) - extent[:2], np.asarray(extent[2:]) - boxes[:, 2:].max(axis=0)]
    )
    return float(np.abs(beyond).max() if neatline else max(beyond.max(), 0.0))


def _graticules(crs: str) -> tuple[bool, ...]:
    """On the old datum a sheet may be cut along old longitudes (made so) or new ones (transformed later)."""
    return (True, False) if on_old_datum(crs) else (False,)


def _distance_between(extent: Bounds, a: str, b: str) -> float:
    """Metres on the ground between the extent's centre read as ``a`` and as ``b``."""
    if same_crs(a, b):
        return 0.0
    x, y = (extent[0] + extent[2]) / 2.0, (extent[1] + extent[3]) / 2.0
    lon_a, lat_a = transformer(a, LONLAT).transform(x, y)
    lon_b, lat_b = transformer(b, LONLAT).transform(x, y)
    if not all(map(math.isfinite, (lon_a, lat_a, lon_b, lat_b))):
        return math.inf
    return float(Geod(ellps="GRS80").inv(lon_a, lat_a, lon_b, lat_b)[2])


def _distance(metres: float) -> str:
    if not math.isfinite(metres):
        return "immeasurably far"
    return f"{metres / 1000.0:.1f} km" if metres >= 2000.0 else f"{metres:.0f} m"


def _listed(sheets: Sequence[str]) -> str:
    return sheets[0] if len(sheets) == 1 else f"{sheets[0]} and {len(sheets) - 1} more"


@lru_cache(maxsize=4096)
def _cell(number: str) -> tuple[Fraction, Fraction, Fraction]:
    """(west, north, size) of a sheet in exact degrees."""
    if not 5 <= len(number) <= 9 or not number.isascii() or not number.isdigit():
        raise InputError(f"{number!r} is not a sheet number: give 5 to 9 digits, such as 36914093")
    lat0 = int(number[:2])
    if lat0 not in _LAT_RANGE:
        raise InputError(f"sheet {number} would lie at {lat0} N: sheet numbers begin with 32 to 43")
    west, north, size = Fraction(123 + (int(number[2]) - 3) % 10), Fraction(lat0 + 1), Fraction(1)
    for level in _chain(len(number)):
        side, width, start = _LEVELS[level]
        count = int(number[start : start + width])
        if count == 0 and side * side == 10**width:
            count = side * side
        if not 1 <= count <= side * side:
            raise InputError(
                f"sheet {number} does not exist: digits {start + 1}-{start + width} count 1 to {side * side}, not {count}"
            )
        size /= side
        row, col = divmod(count - 1, side)
        west, north = west + col * size, north - row * size
    return west, north, size


def _chain(digits: int) -> tuple[int, ...]:
    """The levels passed through on the way to a number of ``digits`` digits."""
    return {5: (5,), 6: (5, 6), 7: (5, 7), 8: (5, 8), 9: (5, 7, 9)}[digits]


@lru_cache(maxsize=4096)
def _ring(number: str, crs: str, bessel: bool) -> NDArray[np.float64]:
    """(65, 2) float64 closed ring of a sheet in ``crs``; read-only, because it is cached."""
    west, south, east, north = sheet_bounds_lonlat(number)
    t = np.linspace(0.0, 1.0, _EDGE_POINTS, endpoint=False)
    ones = np.ones_like(t)
    lon = np.concatenate(
        [west + (east - west) * t, east * ones, east + (west - east) * t, west * ones, [west]]
    )
    lat = np.concatenate(
        [south * ones, south + (north - south) * t, north * ones, north + (south - north) * t, [south]]
    )
    x, y = transformer(_BESSEL_LONLAT if bessel else LONLAT, crs).transform(lon, lat)
    ring = np.stack([x, y], axis=1)
    ring.setflags(write=False)
    return ring
