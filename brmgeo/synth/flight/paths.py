"""Paths to fly: the paper's rectangle, lines back and forth, random legs, waypoints of a file, and their place."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import shapely
from scipy.ndimage import uniform_filter

from brmgeo.errors import InputError
from brmgeo.files import json_of, told
from brmgeo.flight.readings import FloatArray
from brmgeo.geo.crs import LONLAT, transformer
from brmgeo.synth.flight.ground import RaisedFootprints


def rectangle(
    centre: tuple[float, float], heading_deg: float, perimeter_m: float = 1075.0, aspect: float = 0.75
) -> FloatArray:
    """(5, 2) closed rectangle flown to the right; the first side points to ``heading_deg`` (clockwise from north).

    The paper's flight is 1 075 m long; ``aspect`` is short side over long side.
    """
    long = perimeter_m / 2.0 / (1.0 + aspect)
    f, r = long / 2.0, long * aspect / 2.0
    ahead = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    right = np.array([ahead[1], -ahead[0]])
    corners = [(-f, -r), (f, -r), (f, r), (-f, r), (-f, -r)]
    return np.array([np.asarray(centre) + a * ahead + b * right for a, b in corners])


def lawnmower(
    bounds: tuple[float, float, float, float], spacing_m: float, heading_deg: float = 90.0
) -> FloatArray:
    """(n, 2) back-and-forth lines that cover ``bounds``, flown along ``heading_deg``."""
    left, bottom, right, top = bounds
    centre = np.array([(left + right) / 2.0, (bottom + top) / 2.0])
    ahead = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    side = np.array([ahead[1], -ahead[0]])
    half = np.array([(right - left) / 2.0, (top - bottom) / 2.0])
    reach_along, reach_across = float(np.abs(ahead) @ half), float(np.abs(side) @ half)
    lines = max(1, round(2.0 * reach_across / spacing_m) + 1)
    points = []
    for i, across in enumerate(np.linspace(-reach_across, reach_across, lines) if lines > 1 else [0.0]):
        ends = (-reach_along, reach_along) if i % 2 == 0 else (reach_along, -reach_along)
        points += [centre + a * ahead + across * side for a in ends]
    return np.array(points)


def random_mission(
    bounds: tuple[float, float, float, float], seed: int, length_m: float = 1500.0, leg_m: float = 250.0
) -> FloatArray:
    """(n, 2) legs of random length and turn within ``bounds``, ``length_m`` long in all."""
    rng = np.random.default_rng([seed, 101])
    left, bottom, right, top = bounds
    low, high = np.array([left, bottom]), np.array([right, top])
    points = [low + rng.uniform(0.2, 0.8, 2) * (high - low)]
    course, flown = rng.uniform(0, 2 * math.pi), 0.0
    while flown < length_m:
        leg = min(rng.uniform(0.5, 1.5) * leg_m, length_m - flown)
        for _ in range(100):
            turn = course + rng.normal(0.0, 1.0)
            goal = points[-1] + leg * np.array([math.cos(turn), math.sin(turn)])
            if (goal >= low).all() and (goal <= high).all():
                break
            course = rng.uniform(0, 2 * math.pi)
        goal = np.clip(goal, low, high)
        flown += max(float(np.linalg.norm(goal - points[-1])), 1.0)
        course = math.atan2(*(goal - points[-1])[::-1])
        points.append(goal)
    return np.array(points)


def path_from_geojson(file: Path | str, crs: str) -> FloatArray:
    """(n, 2) waypoints in ``crs`` from a GeoJSON file (longitude, latitude): its first LineString, or its Points in order.

    Raises InputError when the file holds neither, or is not GeoJSON.
    """
    file = Path(file)
    try:
        data = json_of(file.read_bytes())
        features = data["features"] if data["type"] == "FeatureCollection" else [data]
        shapes = [f["geometry"] if f["type"] == "Feature" else f for f in features]
        lines = [g["coordinates"] for g in shapes if g["type"] == "LineString"]
        points = [g["coordinates"] for g in shapes if g["type"] == "Point"]
        lonlat = np.array([[float(v) for v in p[:2]] for p in (lines[0] if lines else points)])
    except OSError as error:
        raise InputError(f"{file}: the waypoints cannot be read ({told(error)})") from None
    except (ValueError, KeyError, TypeError, IndexError):
        raise InputError(f"{file}: not a GeoJSON file with a LineString or Points") from None
    if len(lonlat) < 2 or (np.abs(lonlat) > [180.0, 90.0]).any():
        raise InputError(f"{file}: give at least two waypoints, in longitude and latitude (RFC 7946)")
    x, y = transformer(LONLAT, crs).transform(lonlat[:, 0], lonlat[:, 1])
    return np.stack([x, y], axis=-1)


def place(
    shape: FloatArray,
    ground: RaisedFootprints,
    seed: int,
    bounds: tuple[float, float, float, float] | None = None,
    margin_m: float = 60.0,
    min_built: float = 0.08,
) -> FloatArray:
    """``shape`` (n, 2), turned and moved at random so that it lies over built-up ground of the map.

    Built-up means that, within squares of 120 m along the path, buildings cover ``min_built`` of the ground on average
    and a quarter of that everywhere. Where 500 draws find no such place, the most built-up one of them is taken.
    Raises InputError when the shape does not fit into the bounds (default: those of the footprints).
    """
    left, bottom, right, top = ground.extent if bounds is None else bounds
    low, high = np.array([left, bottom]) + margin_m, np.array([right, top]) - margin_m
    cell = 30.0
    size = np.maximum(np.ceil((np.array([right, top]) - [left, bottom]) / cell).astype(int), 1)
    built = np.zeros((size[1], size[0]))
    middle = (ground.bounds[:, :2] + ground.bounds[:, 2:]) / 2.0
    at = np.floor((middle - [left, bottom]) / cell).astype(int)
    inside = (at >= 0).all(axis=1) & (at < size).all(axis=1)
    np.add.at(built, (at[inside, 1], at[inside, 0]), ground.area_m2[inside] / cell**2)
    built = uniform_filter(built, 4, mode="constant")

    rng = np.random.default_rng([seed, 102])
    centred = shape - (shape.min(axis=0) + shape.max(axis=0)) / 2.0
    best: FloatArray | None = None
    best_share = -1.0
    for _ in range(500):
        angle = rng.uniform(0.0, 2.0 * math.pi)
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        turned = np.asarray(centred @ turn.T, dtype=np.float64)
        room_low, room_high = low - turned.min(axis=0), high - turned.max(axis=0)
        if (room_high < room_low).any():
            continue
        path: FloatArray = turned + rng.uniform(room_low, room_high)
        along = np.asarray(shapely.get_coordinates(shapely.segmentize(shapely.LineString(path), 25.0)))
        rc = np.clip(np.floor((along - [left, bottom]) / cell).astype(int), 0, size - 1)
        shares = built[rc[:, 1], rc[:, 0]]
        if shares.mean() >= min_built and shares.min() >= min_built / 4.0:
            return path
        if shares.mean() > best_share:
            best, best_share = path, float(shares.mean())
    if best is None:
        raise InputError(
            f"a path of {np.ptp(shape, axis=0).round()} m does not fit {margin_m:g} m inside bounds "
            f"({left:.0f}, {bottom:.0f}, {right:.0f}, {top:.0f}): fly a shorter one or give wider bounds"
        )
    return best
