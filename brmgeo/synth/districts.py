"""Where people build: town blocks, villages, apartment complexes, school, works, farms and vinyl houses.

Every district proposes buildings in order of importance; ``settle`` keeps those that stand on free ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from brmgeo.synth.scene import (
    APARTMENT,
    CANOPY,
    GREENHOUSE,
    HOUSE,
    OTHER,
    ROW_HOUSE,
    TEMPORARY,
    UNDER_CONSTRUCTION,
    Area,
    Building,
    Colour,
    Road,
    Roof,
    TownStyle,
)
from brmgeo.synth.terrain import MILLIMETRE, LocalFrame, TownGround, Waves, polygons_of

# Blue, red, green, grey, brown, orange, white: the painted metal and tile roofs of the Korean countryside.
_ROOFS: tuple[tuple[Colour, ...], ...] = (
    ((58, 98, 148), (74, 118, 168), (48, 84, 128), (92, 136, 176), (66, 112, 150)),
    ((142, 62, 54), (160, 82, 68), (122, 58, 54), (150, 74, 72)),
    ((86, 128, 104), (72, 112, 92), (104, 142, 114), (62, 98, 84)),
    ((96, 98, 102), (120, 121, 122), (74, 77, 82), (138, 138, 136), (88, 92, 98)),
    ((122, 92, 74), (104, 80, 68), (138, 110, 90)),
    ((188, 108, 70), (202, 126, 82), (176, 96, 66)),
    ((196, 198, 196), (212, 211, 204), (178, 182, 186)),
)
# Flat concrete roofs: bare, with green urethane coating (the most common), grey or brick-red coating.
_FLAT: tuple[Colour, ...] = (
    (98, 142, 110), (86, 130, 104), (112, 150, 118), (78, 122, 98), (160, 158, 152), (174, 172, 166),
    (146, 146, 144), (186, 184, 178), (132, 134, 136), (150, 104, 88), (110, 150, 128), (192, 190, 186),
)  # fmt: skip
_SHED: tuple[Colour, ...] = (
    (70, 112, 160), (58, 100, 146), (164, 168, 170), (186, 188, 186), (148, 150, 150), (118, 122, 126),
    (90, 130, 112), (172, 118, 96), (136, 86, 74), (128, 96, 82),
)  # fmt: skip
_PALE: tuple[Colour, ...] = (
    (196, 204, 206),
    (172, 184, 192),
    (150, 162, 160),
    (120, 150, 176),
    (188, 186, 174),
    (104, 138, 118),
)


@dataclass(frozen=True)
class Proposal:
    """A building, the free gap it needs (metres) and the ground that comes with it if it is built."""

    building: Building
    gap_m: float = 1.2
    grounds: tuple[Area, ...] = ()
    walls: tuple[LineString, ...] = ()
    trees: tuple[tuple[float, float, float], ...] = ()
    extras: bool = False


@dataclass
class TownPlan:
    """What the districts have proposed so far."""

    proposals: list[Proposal] = field(default_factory=list)
    roads: list[Road] = field(default_factory=list)
    grounds: list[Area] = field(default_factory=list)
    walls: list[LineString] = field(default_factory=list)
    trees: list[tuple[float, float, float]] = field(default_factory=list)
    cars: list[tuple[float, float, float]] = field(default_factory=list)
    groups: list[Polygon] = field(default_factory=list)
    names: list[tuple[float, float, str]] = field(default_factory=list)


def rectangle(x: float, y: float, w: float, d: float, angle: float) -> Polygon:
    """A rectangle about (x, y), ``w`` metres along ``angle`` and ``d`` across."""
    corners = np.array([[-w, -d], [w, -d], [w, d], [-w, d]]) / 2
    return Polygon(LocalFrame(x, y, angle).world(corners))


def _jitter(rng: np.random.Generator, colour: Colour, sigma: float = 7.0) -> Colour:
    light = rng.normal(0, sigma)
    r, g, b = (int(np.clip(c + light + rng.normal(0, sigma / 2.5), 12, 245)) for c in colour)
    return r, g, b


def _metal(rng: np.random.Generator, style: TownStyle) -> Colour:
    weights = np.array(style.roof_mix) / sum(style.roof_mix)
    family = _ROOFS[int(rng.choice(len(_ROOFS), p=weights))]
    return _jitter(rng, family[int(rng.integers(len(family)))])


def _pick(rng: np.random.Generator, colours: Sequence[Colour], sigma: float = 7.0) -> Colour:
    return _jitter(rng, colours[int(rng.integers(len(colours)))], sigma)


def _house_shape(rng: np.random.Generator, x: float, y: float, w: float, d: float, angle: float) -> Polygon:
    """A rectangle, an L, a T or a rectangle with a porch: what detached houses look like from above."""
    local = [[-w, -d], [w, -d], [w, d], [-w, d]]
    form = rng.random()
    a, b = rng.uniform(0.3, 0.55), rng.uniform(0.3, 0.5)
    if form < 0.3 and min(w, d) > 6:  # L
        local = [
            [-w, -d],
            [w, -d],
            [w, d * (1 - 2 * b)],
            [w * (1 - 2 * a), d * (1 - 2 * b)],
            [w * (1 - 2 * a), d],
            [-w, d],
        ]
    elif form < 0.52 and w > 7:  # porch
        p, q, r = rng.uniform(-0.7, 0.0), rng.uniform(0.1, 0.7), rng.uniform(1.0, 2.2) * 2
        local = [
            [-w, -d],
            [w * p, -d],
            [w * p, -d - r],
            [w * q, -d - r],
            [w * q, -d],
            [w, -d],
            [w, d],
            [-w, d],
        ]
    elif form < 0.64 and min(w, d) > 7:  # two steps
        p, r = rng.uniform(-0.3, 0.3), rng.uniform(0.8, 2.0) * 2
        local = [
            [-w, -d + r],
            [w * p, -d + r],
            [w * p, -d],
            [w, -d],
            [w, d - r * 0.6],
            [w * 0.5, d - r * 0.6],
            [w * 0.5, d],
            [-w, d],
        ]
    corners = np.array(local) / 2
    if rng.random() < 0.5:
        corners[:, 0] *= -1
    return Polygon(LocalFrame(x, y, angle).world(corners))


def _house(
    rng: np.random.Generator, style: TownStyle, x: float, y: float, angle: float, lot_m: float, urban: bool
) -> list[Proposal]:
    """A detached house with its yard, annexes and canopies."""
    w = float(np.clip(rng.normal(12.0 if urban else 11.5, 2.2), 7.0, min(17.0, lot_m)))
    d = float(np.clip(rng.normal(9.4 if urban else 8.2, 1.5), 5.5, 12.5))
    floors = int(rng.choice([1, 2, 3], p=[0.45, 0.4, 0.15] if urban else [0.86, 0.13, 0.01]))
    shape = _house_shape(rng, x, y, w, d, angle)
    form = rng.random()
    roof: Roof
    if form < (0.52 if urban else 0.22):
        roof, colour = "flat", _pick(rng, _FLAT)
    elif form < (0.82 if urban else 0.78):
        roof, colour = "hip", _metal(rng, style)
    else:
        roof, colour = "gable", _metal(rng, style)
    frame = LocalFrame(x, y, angle)
    lot_w, lot_d = w + rng.uniform(3.5, 8), d + rng.uniform(6, 13)
    front = rng.uniform(0.15, 0.4) * (lot_d - d)
    lx, ly = frame.world(np.array([[rng.uniform(-1.5, 1.5), -front]]))[0]
    lot = rectangle(float(lx), float(ly), lot_w, lot_d, angle)
    lot = Polygon(np.asarray(lot.exterior.coords)[:4] + rng.normal(0, 0.7, (4, 2)))
    kind = str(rng.choice(["concrete", "yard", "gravel", "garden", "lawn"], p=[0.42, 0.24, 0.12, 0.12, 0.1]))
    walls = (LineString(lot.exterior.coords),) if rng.random() < 0.6 else ()
    trees: list[tuple[float, float, float]] = []
    corners = np.asarray(lot.exterior.coords)[:4]
    for corner in corners:
        if rng.random() < 0.35:
            px, py = corner + 0.12 * (np.array([x, y]) - corner) + rng.normal(0, 0.5, 2)
            trees.append((float(px), float(py), float(rng.uniform(0.9, 2.4))))
    house = Building(shape, HOUSE, floors, 3.0 * floors + (1.2 if roof == "flat" else 1.6), roof, colour)
    out = [Proposal(house, 1.3, (Area(lot, kind, angle, float(rng.normal())),), walls, tuple(trees))]
    # Annexes: a store, a barn, a toilet. They make up most of the small outlines of real sheets.
    for _ in range(int(rng.choice([0, 1, 2, 3], p=[0.25, 0.35, 0.25, 0.15]))):
        aw, ad = float(rng.uniform(2.2, 7.5)), float(rng.uniform(1.7, 4.2))
        su, sv = rng.choice([-1.0, 1.0], 2)
        if rng.random() < 0.5:
            aw, ad = ad, aw
        au = su * (lot_w / 2 - aw / 2 - 0.4) + rng.normal(0, 0.4)
        av = -front + sv * (lot_d / 2 - ad / 2 - 0.4) + rng.normal(0, 0.4)
        ax, ay = frame.world(np.array([[au, av]]))[0]
        annex = rectangle(float(ax), float(ay), aw, ad, angle + rng.normal(0, 0.03))
        layer = str(rng.choice([HOUSE, OTHER, TEMPORARY], p=[0.45, 0.25, 0.3]))
        out.append(Proposal(Building(annex, layer, 1, 2.6, "shed", _pick(rng, _SHED)), 0.35))
    return out


def make_streets(
    ground: TownGround, zones: BaseGeometry, rng: np.random.Generator, style: TownStyle
) -> list[Road]:
    """The town's crooked grid of streets about its centre, outside ``zones`` and the river."""
    radius = ground.town_radius_m
    warp = Waves(rng, (160.0, 600.0), 12), Waves(rng, (160.0, 600.0), 12)
    angle = np.linspace(0, 2 * math.pi, 90, endpoint=False)
    blob = radius * (
        1 + 0.13 * np.sin(3 * angle + rng.uniform(0, 6)) + 0.09 * np.sin(5 * angle + rng.uniform(0, 6))
    )
    outline = Polygon(
        ground.centre.world(np.column_stack([blob * np.cos(angle) * 1.12, blob * np.sin(angle) * 0.9]))
    )
    inside = outline.difference(shapely.union_all([ground.bank.buffer(8.0), zones]))
    lines: list[LineString] = []
    s = np.arange(-1.3 * radius, 1.3 * radius, 8.0)
    for axis in (0, 1):
        at = -1.2 * radius + rng.uniform(0, 30)
        while at < 1.2 * radius:
            low, high = sorted(rng.uniform(-1.25, 1.25, 2) * radius)
            if high - low < 0.9 * radius:
                low, high = low - 0.5 * radius, high + 0.5 * radius
            span = s[(s >= low) & (s <= high)]
            tilt = rng.normal(0, 0.03)
            fixed = np.full(span.size, at) + tilt * span
            uv = np.column_stack([span, fixed] if axis == 0 else [fixed, span])
            bend = np.column_stack([warp[0](uv), warp[1](uv)]) * 11.0
            if len(span) > 3:
                lines.append(LineString(ground.centre.world(uv + bend)))
            at += float(rng.uniform(44, 72) if axis == 0 else rng.uniform(58, 110))
    roads: list[Road] = []
    for line in lines:
        wide = float(rng.choice([4.2, 5.5, 7.5], p=[0.4, 0.4, 0.2])) * style.road_scale
        for part in shapely.get_parts(shapely.intersection(line, inside)):
            if part.geom_type == "LineString" and part.length > 45:
                roads.append(Road(part, wide, "street"))
    return roads


def town_blocks(ground: TownGround, roads: list[Road], style: TownStyle) -> list[Polygon]:
    """Blocks between the streets and through roads, road surface taken off."""
    lines = [r.line for r in roads]
    limit = ground.centre
    disc = Point(limit.x, limit.y).buffer(1.25 * ground.town_radius_m)
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all([*lines, disc.exterior])]))
    surface = shapely.union_all(
        [r.line.buffer(r.width_m / 2 + 1.2, cap_style="flat") for r in roads] + [ground.bank.buffer(10.0)]
    )
    blocks: list[Polygon] = []
    for face in faces:
        if face.area < 0.4 * disc.area:
            blocks += polygons_of(face.difference(surface), 260.0)
    return [b for b in blocks if b.area < 30_000 and b.buffer(-6).area > 0]


def fill_block(
    block: Polygon, ground: TownGround, rng: np.random.Generator, style: TownStyle, plan: TownPlan
) -> None:
    """Shops along the through road, dense houses and row houses elsewhere, with some plots left empty."""
    distance = block.distance(ground.arterial)
    from_centre = block.centroid.distance(Point(ground.centre.x, ground.centre.y)) / ground.town_radius_m
    shops = distance < 14 and from_centre < 0.85
    ring = block.exterior
    keep = style.density * (0.97 - 0.3 * from_centre)
    base_kind = "concrete" if shops or rng.random() < 0.45 else str(rng.choice(["yard", "gravel", "village"]))
    if rng.random() < 0.05 + 0.3 * max(0.0, from_centre - 0.5):
        base_kind = str(rng.choice(["grass", "gravel", "garden"]))
        keep *= 0.3
    plan.grounds.append(Area(block, base_kind, 0.0, float(rng.normal())))
    rows = rng.random() < 0.16 and not shops
    depth = 0.0
    for k in range(3):
        inset = 6.2 + depth + (1.5 if k else 0.0)
        inner = block.buffer(-inset, join_style="mitre")
        for part in polygons_of(inner, 30.0 if k else 1.0):
            ring = part.exterior
            s = rng.uniform(0, 8)
            while s < ring.length - 3:
                p, q = ring.interpolate(s), ring.interpolate(min(s + 1.0, ring.length))
                angle = math.atan2(q.y - p.y, q.x - p.x) + rng.normal(0, 0.035)
                lot = float(rng.uniform(13, 18))
                if rng.random() < keep:
                    if shops and k == 0 and p.distance(ground.arterial) < 40:
                        lot = _shop(rng, p, angle, plan)
                    elif rows and k == 0:
                        lot = _row_house(rng, p, angle, plan)
                    elif rng.random() < 0.07:
                        lot = _shop(rng, p, angle, plan)
                    else:
                        plan.proposals += _house(
                            rng, style, p.x, p.y, angle + rng.choice([0, math.pi]), lot, True
                        )
                s += lot
        depth += float(rng.uniform(15, 19))


def _shop(rng: np.random.Generator, p: Point, angle: float, plan: TownPlan) -> float:
    w, d = float(np.clip(rng.lognormal(2.6, 0.35), 8, 34)), float(rng.uniform(9, 15))
    floors = int(rng.choice([1, 2, 3, 4, 5], p=[0.22, 0.3, 0.26, 0.15, 0.07]))
    shape = _house_shape(rng, p.x, p.y, w, d, angle)
    roof: Roof = "flat" if floors > 1 or rng.random() < 0.5 else "metal"
    colour = _pick(rng, _FLAT) if roof == "flat" else _pick(rng, _SHED)
    lot = rectangle(p.x, p.y, w + 2, d + 6, angle)
    ground = Area(lot, str(rng.choice(["concrete", "asphalt"])), angle, float(rng.normal()))
    plan.proposals.append(
        Proposal(Building(shape, OTHER, floors, 3.5 * floors + 1, roof, colour), 0.7, (ground,))
    )
    if rng.random() < 0.55:
        back = LocalFrame(p.x, p.y, angle).world(np.array([[rng.uniform(-3, 3), d / 2 + 4.5]]))[0]
        shed = rectangle(
            float(back[0]), float(back[1]), float(rng.uniform(3, 9)), float(rng.uniform(2.5, 5)), angle
        )
        plan.proposals.append(Proposal(Building(shed, TEMPORARY, 1, 2.8, "shed", _pick(rng, _SHED)), 0.4))
    return w + float(rng.choice([rng.uniform(1.5, 4), rng.uniform(6, 18)], p=[0.75, 0.25]))


def _row_house(rng: np.random.Generator, p: Point, angle: float, plan: TownPlan) -> float:
    w, d = float(rng.uniform(15, 23)), float(rng.uniform(10, 13))
    floors = int(rng.choice([2, 3, 4, 5], p=[0.1, 0.35, 0.4, 0.15]))
    shape = _house_shape(rng, p.x, p.y, w, d, angle)
    lot = Area(rectangle(p.x, p.y, w + 3, d + 7, angle), "asphalt", angle, float(rng.normal()))
    building = Building(shape, ROW_HOUSE, floors, 2.9 * floors + 1.2, "flat", _pick(rng, _FLAT))
    plan.proposals.append(Proposal(building, 2.0, (lot,)))
    side = LocalFrame(p.x, p.y, angle).world(np.array([[rng.uniform(-6, 6), -d / 2 - 2.2]]))[0]
    for j in range(int(rng.integers(1, 3))):
        plan.cars.append(
            (
                float(side[0]) + j * 2.7 * math.cos(angle),
                float(side[1]) + j * 2.7 * math.sin(angle),
                angle + math.pi / 2,
            )
        )
    return w + float(rng.uniform(5, 9))


def _wander(rng: np.random.Generator, x: float, y: float, heading: float, length: float) -> LineString:
    """A lane from a point that turns a little every 14 m."""
    points = [(x, y)]
    for _ in range(int(length / 14)):
        heading += rng.normal(0, 0.16)
        x, y = x + 14 * math.cos(heading), y + 14 * math.sin(heading)
        points.append((x, y))
    return LineString(points)


def make_village(
    x: float,
    y: float,
    ground: TownGround,
    rng: np.random.Generator,
    style: TownStyle,
    plan: TownPlan,
    name: str,
) -> None:
    """Houses along a few crooked lanes, all facing about south, and a hall."""
    face = rng.normal(0, 0.3)
    direction = rng.uniform(0, math.pi)
    lanes: list[LineString] = []
    half = float(rng.uniform(80, 150))
    first = _wander(rng, x, y, direction, half)
    second = _wander(rng, x, y, direction + math.pi, half)
    main = LineString([*list(second.coords)[::-1], *list(first.coords)[1:]])
    lanes.append(main)
    for _ in range(int(rng.integers(3, 7))):
        p = main.interpolate(float(rng.uniform(0.05, 0.95)), normalized=True)
        lanes.append(
            _wander(
                rng,
                p.x,
                p.y,
                direction + float(rng.choice([-1, 1])) * rng.uniform(1.2, 1.9),
                float(rng.uniform(45, 125)),
            )
        )
    plan.roads += [Road(lane, 3.2 + (1.2 if i == 0 else 0.0), "lane") for i, lane in enumerate(lanes)]
    nearest = min((ground.arterial, ground.cross, *ground.levees), key=lambda r: r.distance(Point(x, y)))
    q = nearest.interpolate(nearest.project(Point(x, y)))
    link = np.linspace(0, 1, 12)[:, None] * np.array([[q.x - x, q.y - y]]) + np.array([[x, y]])
    link[1:-1] += (
        np.cumsum(rng.normal(0, 2.5, (10, 2)), axis=0) * np.sin(np.linspace(0, math.pi, 10))[:, None]
    )
    if nearest.distance(Point(x, y)) < 700:
        plan.roads.append(Road(LineString(link), 4.2, "lane"))
    keep = 0.82 * style.density
    placed: list[Proposal] = []
    for i, lane in enumerate(lanes):
        s = rng.uniform(2, 10)
        while s < lane.length:
            for side in (-1.0, 1.0):
                if rng.random() > keep:
                    continue
                p = lane.interpolate(s + rng.uniform(-4, 4))
                q = lane.interpolate(min(s + 2.0, lane.length))
                h = math.atan2(q.y - p.y, q.x - p.x) + side * math.pi / 2
                off = float(rng.uniform(9.5, 16))
                angle = face + rng.normal(0, 0.16) + (math.pi / 2 if rng.random() < 0.17 else 0.0)
                placed += _house(
                    rng, style, p.x + off * math.cos(h), p.y + off * math.sin(h), angle, 16.0, False
                )
            s += float(rng.uniform(15, 23))
        if i == 0 and rng.random() < 0.8:
            p = lane.interpolate(0.5, normalized=True)
            hall = rectangle(p.x + 13, p.y - 9, float(rng.uniform(11, 15)), float(rng.uniform(8, 10)), face)
            plan.names.append((p.x + 13, p.y - 9, name))
            building = Building(hall, OTHER, 1, 4.5, "flat", _pick(rng, _FLAT), name)
            yard = Area(rectangle(p.x + 13, p.y - 12, 24, 20, face), "asphalt", face, 0.0)
            plan.proposals.append(Proposal(building, 1.5, (yard,)))
    plan.proposals += placed
    hull = shapely.union_all([lane.buffer(26.0) for lane in lanes])
    for part in polygons_of(hull.simplify(3.0), 100.0):
        plan.groups.append(part)
        plan.grounds.insert(0, Area(part, "village", 0.0, float(rng.normal())))
    for _ in range(int(half / 2)):
        lane = lanes[int(rng.integers(len(lanes)))]
        p = lane.interpolate(float(rng.random()), normalized=True)
        plan.trees.append(
            (p.x + float(rng.normal(0, 17)), p.y + float(rng.normal(0, 17)), float(rng.uniform(1.0, 3.3)))
        )


def apartment_complex(
    zone: Polygon,
    frame: LocalFrame,
    size: tuple[float, float],
    rng: np.random.Generator,
    style: TownStyle,
    plan: TownPlan,
) -> None:
    """Parallel slabs that face south or so, car parks between them, a playground, walkway roofs, a small shop."""
    w, h = size
    south = frame.angle_rad
    south -= round(south / (math.pi / 2)) * (math.pi / 2)
    slab_angle = south + rng.normal(0, 0.05)
    plan.grounds.append(Area(zone, "complex", slab_angle, float(rng.normal())))
    local = LocalFrame(frame.x, frame.y, slab_angle)
    tall = rng.random() < 0.55
    tone = _pick(rng, _FLAT[4:10] if tall else _FLAT, 4.0)
    reach = 0.5 * math.hypot(w, h)
    depth = float(rng.uniform(11.5, 14.5))
    inner = zone.buffer(-7.0)
    v = -reach + rng.uniform(4, 16)
    while v < reach:
        u = -reach + rng.uniform(0, 14)
        while u < reach:
            length = float(rng.uniform(34, 72))
            floors = int(rng.integers(12, 21)) if tall else int(rng.integers(5, 7))
            x, y = local.world(np.array([[u + length / 2, v + rng.normal(0, 2.2)]]))[0]
            slab = _slab(
                rng,
                float(x),
                float(y),
                length,
                depth + float(rng.normal(0, 0.3)),
                slab_angle + float(rng.normal(0, 0.006)),
            )
            if not inner.contains(slab) or rng.random() > 0.5 + 0.5 * style.density:
                u += 5.0
                continue
            u += length + float(rng.uniform(9, 18))
            building = Building(
                slab, APARTMENT, floors, 2.85 * floors + 2.0, "apartment", _jitter(rng, tone, 3.0)
            )
            lane_at = local.world(np.array([[u - length / 2 - 12, v - depth / 2 - 11.0]]))[0]
            park = rectangle(float(lane_at[0]), float(lane_at[1]), length + 6, 15.0, slab_angle).intersection(
                inner
            )
            grounds = tuple(Area(p, "parking", slab_angle, 0.0) for p in polygons_of(park, 60.0))
            plan.proposals.append(Proposal(building, 6.0, grounds))
            for area in grounds:
                _fill_parking(area, slab_angle, rng, plan, 0.62)
            for t in np.arange(-length / 2, length / 2, 5.5):
                for off, chance in ((depth / 2 + 3.4, 0.75), (-depth / 2 - 2.6, 0.55)):
                    if rng.random() < chance:
                        px, py = LocalFrame(float(x), float(y), slab_angle).world(
                            np.array([[t + rng.normal(0, 1), off + rng.normal(0, 0.5)]])
                        )[0]
                        plan.trees.append((float(px), float(py), float(rng.uniform(1.2, 2.6))))
            if rng.random() < 0.6:
                cx, cy = local.world(np.array([[u + rng.uniform(-30, 0), v - depth / 2 - 4.0]]))[0]
                roof = rectangle(float(cx), float(cy), float(rng.uniform(12, 30)), 2.6, slab_angle)
                plan.proposals.append(
                    Proposal(Building(roof, CANOPY, 1, 3.0, "canopy", _pick(rng, _PALE)), 0.4)
                )
        v += depth + (float(rng.uniform(34, 44)) if tall else float(rng.uniform(23, 29)))
    for _ in range(4):
        px, py = frame.world(np.array([[rng.uniform(-w, w) * 0.42, rng.uniform(-h, h) * 0.42]]))[0]
        low = rectangle(
            float(px), float(py), float(rng.uniform(9, 22)), float(rng.uniform(6, 12)), slab_angle
        )
        floors = int(rng.integers(1, 4))
        plan.proposals.append(
            Proposal(Building(low, OTHER, floors, 3.4 * floors, "flat", _pick(rng, _FLAT)), 3.0)
        )
    px, py = frame.world(np.array([[rng.uniform(-w, w) * 0.35, rng.uniform(-h, h) * 0.35]]))[0]
    plan.grounds.append(Area(Point(px, py).buffer(8.0), "playground", 0.0, float(rng.normal())))
    _edge_trees(zone, rng, plan, 6.0, 0.7)


def _slab(rng: np.random.Generator, x: float, y: float, length: float, depth: float, angle: float) -> Polygon:
    """A 판상형 slab: stair cores stick out at the north side, balconies step along the south one."""
    cores = max(2, round(length / 19))
    unit = length / cores
    north: list[list[float]] = []
    for c in range(cores):
        at = -length / 2 + (c + 0.5) * unit
        half, out = float(rng.uniform(2.0, 2.7)), float(rng.uniform(1.2, 1.9))
        north += [
            [at - half, depth / 2],
            [at - half, depth / 2 + out],
            [at + half, depth / 2 + out],
            [at + half, depth / 2],
        ]
    step = float(rng.choice([0.0, 0.9, 1.4]))
    cut = -length / 2 + unit * float(rng.integers(1, cores + 1)) if step else 0.0
    south = [[length / 2, -depth / 2]]
    if step and cut < length / 2 - 1:
        south += [[cut, -depth / 2], [cut, -depth / 2 - step], [-length / 2, -depth / 2 - step]]
    else:
        south += [[-length / 2, -depth / 2]]
    ring = [[-length / 2, depth / 2], *north, [length / 2, depth / 2], *south]
    return Polygon(LocalFrame(x, y, angle).world(np.array(ring)))


def _fill_parking(area: Area, angle: float, rng: np.random.Generator, plan: TownPlan, share: float) -> None:
    c = area.polygon.centroid
    local = LocalFrame(c.x, c.y, angle)
    r = 0.5 * math.hypot(*(np.array(area.polygon.bounds[2:]) - np.array(area.polygon.bounds[:2])))
    inside = area.polygon.buffer(-2.0)
    for v in (-5.0, 5.0):
        for u in np.arange(-r, r, 2.5):
            x, y = local.world(np.array([[u + rng.normal(0, 0.08), v + rng.normal(0, 0.25)]]))[0]
            if rng.random() < share and inside.contains(Point(x, y)):
                plan.cars.append((float(x), float(y), angle + math.pi / 2 + float(rng.normal(0, 0.02))))


def _edge_trees(zone: Polygon, rng: np.random.Generator, plan: TownPlan, step: float, share: float) -> None:
    ring = zone.buffer(-2.6).exterior
    for s in np.arange(0, ring.length, step):
        if rng.random() < share:
            p = ring.interpolate(s + rng.normal(0, 1.0))
            plan.trees.append(
                (
                    p.x + float(rng.normal(0, 0.6)),
                    p.y + float(rng.normal(0, 0.6)),
                    float(rng.uniform(1.4, 3.2)),
                )
            )


def school(
    zone: Polygon,
    frame: LocalFrame,
    size: tuple[float, float],
    rng: np.random.Generator,
    plan: TownPlan,
    name: str,
) -> None:
    """A school around a courtyard (a ring in a ring), a gym, a walkway roof and the sports ground."""
    w, h = size
    angle = frame.angle_rad
    plan.grounds.append(Area(zone, "concrete", angle, float(rng.normal())))
    bw, bd, wing = float(rng.uniform(50, 64)), float(rng.uniform(34, 44)), float(rng.uniform(9, 11))
    x, y = frame.world(
        np.array([[-w / 2 + bw / 2 + rng.uniform(8, 14), h / 2 - bd / 2 - rng.uniform(9, 13)]])
    )[0]
    outer = rectangle(float(x), float(y), bw, bd, angle)
    off = rng.uniform(-1.0, 1.0, 2)
    inner = rectangle(
        float(x + off[0]), float(y + off[1]), bw - 2 * wing, bd - 2 * wing + rng.uniform(-2, 2), angle
    )
    ring = Polygon(outer.exterior, [inner.exterior])
    floors = int(rng.integers(3, 5))
    green = (Area(inner, "lawn", angle, 0.3),)
    plan.proposals.append(
        Proposal(Building(ring, OTHER, floors, 3.6 * floors + 1, "flat", _pick(rng, _FLAT), name), 4.0, green)
    )
    plan.names.append((float(x), float(y) - bd / 2 + 4, name))
    c = inner.centroid
    for _ in range(9):
        plan.trees.append(
            (c.x + float(rng.normal(0, 6)), c.y + float(rng.normal(0, 4)), float(rng.uniform(1.2, 2.6)))
        )
    gx, gy = frame.world(np.array([[w / 2 - 24, h / 2 - 24 + rng.uniform(-3, 3)]]))[0]
    gym = rectangle(float(gx), float(gy), float(rng.uniform(27, 33)), float(rng.uniform(20, 24)), angle)
    plan.proposals.append(Proposal(Building(gym, OTHER, 2, 11.0, "metal", _pick(rng, _SHED[:6])), 4.0))
    wx, wy = frame.world(np.array([[w / 2 - 46, h / 2 - 16]]))[0]
    walk = rectangle(float(wx), float(wy), 12.0, 2.8, angle)
    plan.proposals.append(Proposal(Building(walk, CANOPY, 1, 3.0, "canopy", _pick(rng, _PALE)), 0.2))
    px, py = frame.world(np.array([[rng.uniform(-4, 4), -h / 2 + (h - bd) / 2 - 6]]))[0]
    plan.grounds.append(
        Area(rectangle(float(px), float(py), w - 14, h - bd - 34, angle), "sports", angle, 0.0)
    )
    _edge_trees(zone, rng, plan, 5.5, 0.85)


def works(
    zone: Polygon, frame: LocalFrame, size: tuple[float, float], rng: np.random.Generator, plan: TownPlan
) -> None:
    """Factories and warehouses on concrete, with offices, lean-to roofs and containers."""
    w, h = size
    plan.grounds.append(Area(zone, "concrete", frame.angle_rad, -0.5 + float(rng.normal(0, 0.5))))
    inner = zone.buffer(-5.0)
    v = -h / 2 + 6
    while v < h / 2 - 14:
        u = -w / 2 + rng.uniform(5, 10)
        depth = float(rng.uniform(17, 38))
        while u < w / 2 - 18:
            length = float(rng.uniform(22, 62))
            angle = frame.angle_rad + float(rng.normal(0, 0.012))
            x, y = frame.world(np.array([[u + length / 2, v + depth / 2]]))[0]
            hall = _house_shape(rng, float(x), float(y), length, depth - float(rng.uniform(0, 5)), angle)
            u += length + float(rng.uniform(5, 16))
            if inner.contains(hall) and rng.random() < 0.85:
                plan.proposals.append(
                    Proposal(
                        Building(hall, OTHER, 1, float(rng.uniform(7, 12)), "metal", _pick(rng, _SHED)), 3.0
                    )
                )
            for _ in range(2):
                bx, by = frame.world(np.array([[u + rng.uniform(-20, 0), v - 4.5 + rng.uniform(-2, 2)]]))[0]
                box = rectangle(
                    float(bx),
                    float(by),
                    *((6.1, 2.5) if rng.random() < 0.6 else (3.1, 2.4)),
                    angle + float(rng.normal(0, 0.1)),
                )
                plan.proposals.append(
                    Proposal(Building(box, TEMPORARY, 1, 2.6, "box", _pick(rng, _SHED)), 0.5)
                )
        v += depth + float(rng.uniform(11, 17))
    c = frame.world(np.array([[rng.uniform(-0.3, 0.3) * w, -h / 2 + 11]]))[0]
    office = rectangle(float(c[0]), float(c[1]), float(rng.uniform(12, 22)), 9.0, frame.angle_rad)
    plan.proposals.append(Proposal(Building(office, OTHER, 2, 7.5, "flat", _pick(rng, _FLAT)), 3.0))
    for _ in range(14):
        x, y = frame.world(np.array([[rng.uniform(-0.47, 0.47) * w, -h / 2 + rng.uniform(2.5, 6)]]))[0]
        plan.cars.append((float(x), float(y), frame.angle_rad + math.pi / 2))


def petrol_station(x: float, y: float, angle: float, rng: np.random.Generator, plan: TownPlan) -> None:
    """A wide roof on posts over the pumps and a small shop behind."""
    plan.grounds.append(Area(rectangle(x, y, 36, 26, angle), "concrete", angle, 0.8))
    frame = LocalFrame(x, y, angle)
    roof = rectangle(x, y, float(rng.uniform(13, 19)), float(rng.uniform(8, 11)), angle)
    plan.proposals.append(Proposal(Building(roof, CANOPY, 1, 5.5, "canopy", _pick(rng, _PALE)), 1.0))
    sx, sy = frame.world(np.array([[2.0, 10.0]]))[0]
    shop = rectangle(float(sx), float(sy), 11.0, 6.0, angle)
    plan.proposals.append(Proposal(Building(shop, OTHER, 1, 4.0, "flat", _pick(rng, _FLAT)), 1.0))
    plan.cars.append((float(sx) - 9, float(sy) - 1, angle))


def farmstead(x: float, y: float, angle: float, rng: np.random.Generator, plan: TownPlan) -> None:
    """Long cattle sheds side by side, a feed silo hut and a dung shed."""
    count = int(rng.integers(2, 5))
    frame = LocalFrame(x, y, angle)
    depth = float(rng.uniform(11, 17))
    length = float(rng.uniform(32, 66))
    colour = _pick(rng, _SHED)
    yard = Area(
        rectangle(x, y, length + 16, count * (depth + 8) + 10, angle), "gravel", angle, float(rng.normal())
    )
    for i in range(count):
        shift = rng.normal(0, 3.0)
        cx, cy = frame.world(np.array([[shift, (i - (count - 1) / 2) * (depth + 7.0)]]))[0]
        barn = rectangle(
            float(cx),
            float(cy),
            length * float(rng.uniform(0.75, 1.05)),
            depth * float(rng.uniform(0.9, 1.05)),
            angle + float(rng.normal(0, 0.012)),
        )
        building = Building(barn, OTHER, 1, 5.5, "metal", _jitter(rng, colour, 10.0))
        plan.proposals.append(Proposal(building, 2.0, (yard,) if i == 0 else ()))
    for _ in range(3):
        cx, cy = frame.world(np.array([[rng.choice([-1, 1]) * (length / 2 + 6), rng.uniform(-12, 12)]]))[0]
        hut = rectangle(float(cx), float(cy), float(rng.uniform(3, 8)), float(rng.uniform(3, 6)), angle)
        plan.proposals.append(Proposal(Building(hut, OTHER, 1, 3.2, "shed", _pick(rng, _SHED)), 0.6))


def vinyl_houses(parcel: Area, rng: np.random.Generator, plan: TownPlan) -> None:
    """Greenhouses side by side along a parcel's long direction."""
    c = parcel.polygon.centroid
    frame = LocalFrame(c.x, c.y, parcel.angle_rad)
    rect = np.asarray(affinity.rotate(parcel.polygon, -parcel.angle_rad, origin=c, use_radians=True).bounds)
    u0, v0, u1, v1 = rect - np.array([c.x, c.y, c.x, c.y])
    wide = float(rng.uniform(6.2, 8.2))
    gap = float(rng.uniform(0.8, 1.7))
    inner = parcel.polygon.buffer(-0.4)
    v = v0 + 1.0 + wide / 2
    while v < v1 - wide / 2:
        a, b = u0 + 2.0 + float(rng.uniform(0, 4)), u1 - 2.0 - float(rng.uniform(0, 9))
        if rng.random() < 0.92 and b - a > 14:
            x, y = frame.world(np.array([[(a + b) / 2, v]]))[0]
            house = rectangle(float(x), float(y), b - a, wide, parcel.angle_rad + float(rng.normal(0, 0.004)))
            kept = polygons_of(house.intersection(inner), 60.0)
            if kept and kept[0].area > 0.93 * house.area:
                colour = _jitter(rng, (206, 212, 212) if rng.random() < 0.8 else (132, 142, 140), 6.0)
                plan.proposals.append(Proposal(Building(house, GREENHOUSE, 1, 3.2, "vinyl", colour), 0.5))
        v += wide + gap


def lone_canopies(houses: Sequence[Building], rng: np.random.Generator, share: float) -> list[Building]:
    """Lean-to roofs that share an edge with a house: about a third of all outlines of a real sheet."""
    out: list[Building] = []
    for b in houses:
        if b.layer in (GREENHOUSE, CANOPY) or b.polygon.area < 24 or b.floors > 6:
            continue
        for _ in range(int(rng.choice([0, 1, 2], p=[1 - share, share * 0.7, share * 0.3]))):
            ring = np.asarray(shapely.geometry.polygon.orient(b.polygon).exterior.coords)
            k = int(rng.integers(len(ring) - 1))
            edge = ring[k + 1] - ring[k]
            length = float(np.hypot(*edge))
            if length < 2.4:
                continue
            along = edge / length
            out_of = np.array([along[1], -along[0]])
            w = float(min(length, rng.uniform(2.4, 9.0) if length < 20 else rng.uniform(5, 20)))
            at = float(rng.uniform(0, length - w))
            d = float(rng.uniform(1.3, 3.6) if length < 20 else rng.uniform(2.5, 6.5))
            p = ring[k] + along * at
            shape = Polygon([p, p + out_of * d, p + along * w + out_of * d, p + along * w])
            colour = _pick(rng, _PALE if rng.random() < 0.5 else _SHED)
            out.append(Building(shape, CANOPY, 1, 2.6, "canopy", colour))
    return out


def settle(
    proposals: Sequence[Proposal], blocked: BaseGeometry, domain: Polygon, rng: np.random.Generator
) -> list[Proposal]:
    """The proposals that stand inside ``domain``, off ``blocked`` ground and clear of all earlier ones."""
    shapes = shapely.set_precision(
        np.array([p.building.polygon for p in proposals], dtype=object), MILLIMETRE
    )
    shapely.prepare(blocked)
    good = ~shapely.intersects(blocked, shapes) & shapely.covers(domain, shapes)
    good &= np.array([s.geom_type == "Polygon" and s.area > 2.0 for s in shapes])
    tree = shapely.STRtree(shapes)
    gaps = np.array([p.gap_m for p in proposals])
    first, second = tree.query(shapes, predicate="dwithin", distance=gaps)
    rivals: dict[int, list[int]] = {}
    for i, j in zip(first.tolist(), second.tolist()):
        if j < i:
            rivals.setdefault(i, []).append(j)
        elif i < j:
            rivals.setdefault(j, []).append(i)
    kept: list[Proposal] = []
    for i, proposal in enumerate(proposals):
        if good[i] and not any(good[j] for j in rivals.get(i, ())):
            b = proposal.building
            layer = (
                UNDER_CONSTRUCTION
                if b.layer == OTHER and b.polygon.area > 130 and rng.random() < 0.006
                else b.layer
            )
            kept.append(
                Proposal(
                    Building(shapes[i], layer, b.floors, b.height_m, b.roof, b.colour, b.name),
                    proposal.gap_m,
                    proposal.grounds,
                    proposal.walls,
                    proposal.trees,
                )
            )
        else:
            good[i] = False
    return kept


def attach(
    canopies: Sequence[Building], built: Sequence[Building], blocked: BaseGeometry, domain: Polygon
) -> list[Building]:
    """The canopies that overlap no building but the edge they hang on."""
    if not canopies:
        return []
    shapes = shapely.set_precision(np.array([b.polygon for b in canopies], dtype=object), MILLIMETRE)
    standing = np.array([b.polygon for b in built], dtype=object)
    shapely.prepare(blocked)
    good = ~shapely.intersects(blocked, shapes) & shapely.covers(domain, shapes)
    good &= np.array([s.geom_type == "Polygon" and s.area > 2.0 for s in shapes])
    clash: NDArray[np.float64] = np.zeros(len(shapes))
    i, j = shapely.STRtree(standing).query(shapes, predicate="intersects")
    np.maximum.at(clash, i, shapely.area(shapely.intersection(shapes[i], standing[j])))
    good &= clash < 0.02
    i, j = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    for a, b in sorted(zip(i.tolist(), j.tolist())):
        if b < a and good[a] and good[b]:
            good[a] = False
    return [
        Building(shapes[k], c.layer, c.floors, c.height_m, c.roof, c.colour, c.name)
        for k, c in enumerate(canopies)
        if good[k]
    ]
