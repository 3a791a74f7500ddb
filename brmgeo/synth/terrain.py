"""The ground of a generated region: relief, river, through roads, woods, contours and field parcels."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import contourpy
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from brmgeo.geo.grid import Bounds
from brmgeo.synth.scene import Area, Road, TownStyle

MILLIMETRE = 0.001


class Waves:
    """A smooth random field: a sum of cosines with wavelengths in a range, mean 0, standard deviation 1."""

    def __init__(self, rng: np.random.Generator, wavelengths_m: tuple[float, float], count: int = 24) -> None:
        low, high = wavelengths_m
        wavelength = np.exp(rng.uniform(math.log(low), math.log(high), count))
        direction = rng.uniform(0, 2 * math.pi, count)
        self._k = (2 * math.pi / wavelength)[:, None] * np.column_stack(
            [np.cos(direction), np.sin(direction)]
        )
        self._phase = rng.uniform(0, 2 * math.pi, count)
        self._scale = math.sqrt(2.0 / count)

    def __call__(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values at points (..., 2), metres."""
        return np.asarray(np.cos(xy @ self._k.T + self._phase).sum(axis=-1) * self._scale, dtype=np.float64)


@dataclass(frozen=True)
class LocalFrame:
    """A local frame: ``u`` along a direction, ``v`` to the left of it, about an origin."""

    x: float
    y: float
    angle_rad: float

    def world(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """World points (n, 2) from local ones."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        uv = np.asarray(uv, dtype=np.float64)
        return np.stack(
            [self.x + uv[..., 0] * c - uv[..., 1] * s, self.y + uv[..., 0] * s + uv[..., 1] * c], axis=-1
        )


@dataclass(frozen=True)
class TownGround:
    """What the districts are laid out on."""

    domain: Polygon
    water: list[Polygon]
    bank: BaseGeometry
    river: LineString
    arterial: LineString
    cross: LineString
    levees: list[LineString]
    centre: LocalFrame
    town_radius_m: float
    hills: Waves
    forest_level: float
    woods: list[Polygon]
    contours: list[tuple[LineString, float]]

    def hillness(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far uphill points (n, 2) lie: forest begins at ``forest_level``."""
        return _hillness(xy, self.hills, self.river, self.centre, self.town_radius_m)


def polygons_of(geometry: BaseGeometry, min_area_m2: float = 0.0) -> list[Polygon]:
    """The polygons within any geometry that are larger than ``min_area_m2``."""
    parts = shapely.get_parts(np.atleast_1d(np.asarray(geometry, dtype=object)))
    parts = shapely.get_parts(parts)
    return [p for p in parts if p.geom_type == "Polygon" and not p.is_empty and p.area > min_area_m2]


def _hillness(
    xy: NDArray[np.float64], hills: Waves, river: LineString, centre: LocalFrame, radius: float
) -> NDArray[np.float64]:
    distance = shapely.distance(shapely.points(xy), river)
    rise = np.clip((distance - 260.0) / 800.0, 0.0, 1.2)
    town = np.hypot(xy[:, 0] - centre.x, xy[:, 1] - centre.y) / max(radius, 1.0)
    return np.asarray(hills(xy) + 1.5 * rise - 3.2 * np.exp(-0.5 * (town / 1.05) ** 2), dtype=np.float64)


def make_ground(domain_bounds: Bounds, rng: np.random.Generator, style: TownStyle) -> TownGround:
    """Relief, river, through roads and woods over ``domain_bounds``."""
    left, bottom, right, top = domain_bounds
    width, height = right - left, top - bottom
    size = min(width, height)
    scale = min(1.0, size / 2200.0)
    middle = LocalFrame(
        (left + right) / 2 + rng.uniform(-0.06, 0.06) * width,
        (bottom + top) / 2 + rng.uniform(-0.06, 0.06) * height,
        math.radians(rng.uniform(50, 130)),
    )
    reach = 0.75 * math.hypot(width, height)
    t = np.arange(-reach, reach + 1, 12.0)
    side = float(rng.choice([-1.0, 1.0]))
    a1, a2 = rng.uniform(130, 210) * scale, rng.uniform(25, 45) * scale
    l1, l2 = rng.uniform(1500, 2300) * scale, rng.uniform(520, 760) * scale
    p1, p2 = rng.uniform(0, 2 * math.pi, 2)
    meander = a1 * np.sin(2 * math.pi * t / l1 + p1)
    offset = -side * rng.uniform(120, 220) * scale
    n = offset + meander + a2 * np.sin(2 * math.pi * t / l2 + p2)
    river = LineString(middle.world(np.column_stack([t, n])))

    half = (21 + 6 * np.sin(t / 173 + p1) + 4 * np.sin(t / 61 + p2) + rng.normal(0, 0.6, t.size)) * scale
    bank_half = half + (24 + 12 * np.sin(t / 260 + p2) + 6 * np.sin(t / 97)) * scale
    shift = 7 * scale * np.sin(t / 118 + p2)  # the stream wanders within its plain: sand lies on one side
    lower = n + shift - half
    upper = n + shift + half
    water = _ribbon(middle, t, lower, upper)
    bank = _ribbon(middle, t, n - bank_half, n + bank_half)
    levees = [LineString(middle.world(np.column_stack([t, n + s * (bank_half + 3.0)]))) for s in (-1.0, 1.0)]

    smooth = offset + 0.6 * meander + side * (rng.uniform(245, 285) + 18 * np.sin(t / 410 + p2)) * scale
    arterial = LineString(middle.world(np.column_stack([t, smooth])))
    t0 = rng.uniform(-0.1, 0.1) * size
    i0 = int(np.searchsorted(t, t0))
    slope = math.atan2(smooth[i0 + 4] - smooth[i0 - 4], t[i0 + 4] - t[i0 - 4])
    x0, y0 = middle.world(np.array([[t[i0], smooth[i0]]]))[0]
    radius = min(560.0, 0.27 * size)
    # Local v points away from the river whichever side the town is on; the frame is mirrored by its user.
    centre = LocalFrame(float(x0), float(y0), middle.angle_rad + slope)

    v = np.arange(-reach, reach + 1, 20.0)
    turn = rng.uniform(-0.15, 0.15)
    cross_u = (
        rng.uniform(-40, 40)
        + 26 * scale * np.sin(v / 310 + p1)
        + v * turn
        + 40 * scale * np.sin(v / 700 + p2)
    )
    cross = LineString(centre.world(np.column_stack([cross_u, v])))

    domain = shapely.box(*domain_bounds)
    relief = _relief(domain_bounds, rng, scale, river, centre, radius)
    level = float(np.quantile(relief.hill, 1.0 - style.forest_share))
    keep_out = shapely.union_all([bank.buffer(12.0), arterial.buffer(20.0), cross.buffer(10.0)])
    return TownGround(
        domain=domain,
        water=polygons_of(water.intersection(domain)),
        bank=bank,
        river=river,
        arterial=arterial,
        cross=cross,
        levees=levees,
        centre=centre,
        town_radius_m=radius,
        hills=relief.hills,
        forest_level=level,
        woods=_woods(relief, level, domain, keep_out),
        contours=_contours(relief, level, domain),
    )


@dataclass(frozen=True, slots=True)
class _Relief:
    """How hilly the ground is, on a grid: ``x`` (w,), ``y`` (h,) metres, ``hill`` and its ``rough`` (h, w)."""

    hills: Waves
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    hill: NDArray[np.float64]
    rough: NDArray[np.float64]


def _relief(
    bounds: Bounds,
    rng: np.random.Generator,
    scale: float,
    river: LineString,
    centre: LocalFrame,
    radius: float,
) -> _Relief:
    left, bottom, right, top = bounds
    hills = Waves(rng, (max(380.0 * scale, 120.0), max(1500.0 * scale, 400.0)), 28)
    step = 12.0
    x = np.arange(left - step, right + 2 * step, step)
    y = np.arange(bottom - step, top + 2 * step, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    hill = _hillness(grid.reshape(-1, 2), hills, river, centre, radius).reshape(grid.shape[:2])
    rough = Waves(rng, (35.0, 130.0), 40)(grid.reshape(-1, 2)).reshape(hill.shape)
    return _Relief(hills, x, y, hill, rough)


def _woods(relief: _Relief, level: float, domain: Polygon, keep_out: BaseGeometry) -> list[Polygon]:
    """Woods where it is hillier than ``level``, ragged at their edges, clearings over 400 m2 left open."""
    woods: list[Polygon] = []
    traced = contourpy.contour_generator(
        relief.x, relief.y, relief.hill + 0.13 * relief.rough, fill_type=contourpy.FillType.OuterOffset
    )
    filled: Any = traced.filled(level, float(relief.hill.max()) + 10.0)
    points, offsets = filled
    for ring, cuts in zip(points, offsets):
        parts = [ring[a:b] for a, b in itertools.pairwise(cuts)]
        shape = shapely.make_valid(Polygon(parts[0], [p for p in parts[1:] if Polygon(p).area > 400.0]))
        woods += polygons_of(shape.intersection(domain).difference(keep_out), 500.0)
    return woods


def _contours(relief: _Relief, level: float, domain: Polygon) -> list[tuple[LineString, float]]:
    """Contour lines every 5 m, each with its height."""
    hill = relief.hill
    elevation = 62.0 + 14.0 * np.maximum(hill + 0.8, 0) + 60.0 * np.maximum(hill - level + 0.25, 0) ** 1.3
    lines: list[tuple[LineString, float]] = []
    tracer = contourpy.contour_generator(
        relief.x, relief.y, elevation + 0.6 * relief.rough, line_type=contourpy.LineType.Separate
    )
    for z in np.arange(45.0, float(elevation.max()), 5.0):
        rings: Any = tracer.lines(z)
        for line in rings:
            if len(line) > 3:
                clipped = shapely.intersection(LineString(line), domain)
                lines += [(p, float(z)) for p in shapely.get_parts(clipped) if p.geom_type == "LineString"]
    return lines


def _ribbon(
    frame: LocalFrame, t: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> BaseGeometry:
    ring = np.concatenate([np.column_stack([t, lower]), np.column_stack([t, upper])[::-1]])
    return shapely.make_valid(Polygon(frame.world(ring)))


CROPS = {
    "spring": (
        ("paddy_wet", "soil", "barley", "grass", "mulch"),
        (0.42, 0.26, 0.12, 0.08, 0.12),
    ),
    "summer": (
        ("rice", "maize", "pepper", "grass", "soil", "mulch"),
        (0.52, 0.12, 0.12, 0.07, 0.08, 0.09),
    ),
    "autumn": (
        ("rice_ripe", "stubble", "cabbage", "grass", "soil"),
        (0.45, 0.22, 0.12, 0.08, 0.13),
    ),
    "winter": (
        ("stubble", "soil", "barley", "grass_dry"),
        (0.5, 0.28, 0.1, 0.12),
    ),
}


def make_fields(
    ground: TownGround, taken: BaseGeometry, rng: np.random.Generator, style: TownStyle
) -> tuple[list[Area], list[Road]]:
    """Parcels over the free ground outside ``taken``, and the farm tracks between them.

    Land near the river is consolidated: long parcels in strips along tracks. Uphill the parcels are small and crooked.
    """
    left, bottom, right, top = ground.domain.bounds
    spacing = 340.0
    count = max(4, int((right - left) * (top - bottom) / spacing**2))
    seeds = np.column_stack([rng.uniform(left, right, count), rng.uniform(bottom, top, count)])
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(seeds), extend_to=ground.domain))
    shapely.prepare(taken)
    crops, weights = CROPS[style.season]
    base = np.array(weights)
    fields: list[Area] = []
    tracks: list[Road] = []
    for cell in shapely.intersection(cells, ground.domain):
        if cell.is_empty or shapely.covers(taken, cell):
            continue
        middle = np.array([[cell.centroid.x, cell.centroid.y]])
        uphill = float(ground.hillness(middle)[0]) > ground.forest_level - 0.75
        along = ground.river.project(shapely.Point(middle[0]))
        a, b = ground.river.interpolate(along - 20), ground.river.interpolate(along + 20)
        angle = math.atan2(b.y - a.y, b.x - a.x) + rng.normal(0, 0.9 if uphill else 0.22)
        frame = LocalFrame(cell.centroid.x, cell.centroid.y, angle)
        free = shapely.difference(cell, taken)
        if free.area < 300.0:
            continue
        mix = rng.dirichlet(base * 5.0 + 0.05)
        pieces = _crooked(cell, rng) if uphill else _strips(cell, frame, rng, tracks)
        cut = shapely.intersection(np.array(pieces, dtype=object), free)
        cut = shapely.buffer(cut, -0.45, join_style="mitre", mitre_limit=2.0)
        for piece in cut:
            for part in polygons_of(piece, 120.0):
                rectangle = shapely.minimum_rotated_rectangle(part)
                if part.area < 0.25 * rectangle.area:
                    continue
                c = shapely.get_coordinates(rectangle)
                edge = c[1] - c[0] if np.hypot(*(c[1] - c[0])) > np.hypot(*(c[2] - c[1])) else c[2] - c[1]
                rows = math.atan2(edge[1], edge[0])
                kind = str(rng.choice(crops, p=mix))
                if rng.random() < style.orchard_share * (2.2 if uphill else 0.7):
                    kind = "orchard"
                elif uphill and kind in ("rice", "paddy_wet", "rice_ripe"):
                    kind = str(rng.choice(crops[1:]))
                fields.append(Area(part, kind, rows, float(rng.normal())))
    return fields, tracks


def _strips(cell: Polygon, frame: LocalFrame, rng: np.random.Generator, tracks: list[Road]) -> list[Polygon]:
    reach = 0.75 * math.sqrt(cell.area) + 160.0
    pieces: list[Polygon] = []
    v = -reach
    while v < reach:
        depth = float(rng.uniform(70, 115))
        line = LineString(frame.world(np.array([[-reach, v], [reach, v]])))
        inside = shapely.intersection(line, cell)
        tracks += [
            Road(part, 3.2, "track")
            for part in shapely.get_parts(inside)
            if part.length > 40 and part.geom_type == "LineString"
        ]
        u = -reach
        while u < reach:
            wide = float(rng.choice([rng.uniform(14, 24), rng.uniform(24, 42)]))
            skew = rng.normal(0, 1.0, 2)
            corners = [
                [u, v + 2.2],
                [u + wide, v + 2.2],
                [u + wide + skew[1], v + depth - 2.2],
                [u + skew[0], v + depth - 2.2],
            ]
            pieces.append(Polygon(frame.world(np.array(corners))))
            u += wide + 1.0 + max(0.0, float(skew.max()))
        v += depth
    return [p for p in pieces if p.intersects(cell)]


def _crooked(cell: Polygon, rng: np.random.Generator) -> list[Polygon]:
    left, bottom, right, top = cell.bounds
    count = max(4, int((right - left) * (top - bottom) / 1050.0))
    seeds = np.column_stack([rng.uniform(left, right, count), rng.uniform(bottom, top, count)])
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(seeds), extend_to=cell))
    return [p for p in shapely.intersection(cells, cell) if p.geom_type == "Polygon"]
