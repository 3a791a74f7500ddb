"""A generated Korean-looking small town with its countryside, the same for the same seed, nothing in it symmetric.

``generate_town`` draws a river, a main road along it and one across, hills under forest, then the town: a crooked grid of
streets with shops and houses, apartment complexes, a school around a courtyard, works; villages of houses that face
south; farms, vinyl houses, orchards and parcels of fields on what is left. Numbers and sizes of outlines by kind follow
a real NGII 1:5,000 sheet (about 400 outlines per square kilometre, a third of them canopies, 5 to 8 % of all ground built
on and 10 to 40 % within built-up areas).
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely.geometry import Point, Polygon
from shapely.geometry.base import BaseGeometry

from brmgeo.errors import SettingsError
from brmgeo.geo.grid import Bounds
from brmgeo.synth import districts
from brmgeo.synth.districts import TownPlan
from brmgeo.synth.scene import TEMPORARY, Area, Building, Road, Town, TownStyle
from brmgeo.synth.terrain import MILLIMETRE, LocalFrame, TownGround, make_fields, make_ground, polygons_of

MARGIN_M = 140.0
_VILLAGES = (
    "양지마을회관",
    "새터마을회관",
    "안골경로당",
    "솔밭마을회관",
    "웃말회관",
    "강변마을회관",
    "범바위경로당",
    "느티나무회관",
    "고갯마을회관",
    "탑골경로당",
    "물레방아회관",
    "대숲마을회관",
)


def generate_town(bounds: Bounds, seed: int, style: TownStyle | None = None, crs: str = "EPSG:5187") -> Town:
    """A town over ``bounds`` (left, bottom, right, top; metres in ``crs``), wholly determined by seed and style.

    Everything is laid out for MARGIN_M beyond the bounds, so that pictures and sheets may reach over them.
    Raises SettingsError for bounds under 300 m on a side.
    """
    style = style or TownStyle()
    left, bottom, right, top = bounds
    if not (right - left >= 300 and top - bottom >= 300):
        raise SettingsError(f"bounds {bounds} are too small for a generated town: give at least 300 x 300 m")
    rng = np.random.default_rng([seed, 0xB0])
    domain_bounds = (left - MARGIN_M, bottom - MARGIN_M, right + MARGIN_M, top + MARGIN_M)
    ground = make_ground(domain_bounds, rng, style)
    plan = TownPlan()
    wide = style.road_scale
    plan.roads = [Road(ground.arterial, 15.5 * wide, "arterial"), Road(ground.cross, 9.5 * wide, "main")]
    plan.roads += [Road(line, 4.4, "lane") for line in ground.levees]

    woods = shapely.union_all(ground.woods) if ground.woods else Polygon()
    zones = _make_zones(ground, woods, rng, style, plan)
    zone_union = shapely.union_all([z.buffer(4.0) for z in zones]) if zones else Polygon()
    streets = districts.make_streets(ground, zone_union, rng, style)
    plan.roads += [Road(z.buffer(3.6, join_style="mitre").exterior, 6.5, "street") for z in zones]
    plan.roads += streets
    blocks = districts.town_blocks(ground, plan.roads, style)
    blocks = [b for b in blocks if not b.intersects(zone_union) and not b.intersects(woods)]
    for block in blocks:
        districts.fill_block(block, ground, rng, style, plan)
    built_up = shapely.union_all([*zones, *blocks]).buffer(9.0) if blocks or zones else Polygon()
    _countryside(ground, woods, built_up, rng, style, plan)

    surface = shapely.union_all([r.line.buffer(r.width_m / 2 + 0.6, cap_style="flat") for r in plan.roads])
    surface = surface.intersection(ground.domain)
    villages = [g.polygon for g in plan.grounds if g.kind == "village"]
    occupied = shapely.union_all(
        [ground.bank.buffer(6.0), woods.buffer(1.0), built_up, surface.buffer(0.8), *villages]
    )
    fields, tracks = make_fields(ground, occupied, rng, style)
    fields = _vinyl(fields, rng, style, plan)
    tracks = _open_tracks(tracks, shapely.union_all([ground.bank, woods, built_up, *villages]))

    blocked = shapely.union_all([surface, ground.bank.buffer(2.0), woods.buffer(-4.0)])
    reach = shapely.box(*domain_bounds)
    # Houses before sheds: an annex must not keep the next house off its plot.
    proposals = sorted(plan.proposals, key=lambda p: p.building.polygon.area < 36.0)
    kept = districts.settle(proposals, blocked, reach, rng)
    buildings = [p.building for p in kept]
    canopies = districts.lone_canopies(buildings, rng, min(0.85, 0.62 * style.density))
    buildings += districts.attach(canopies, buildings, blocked, reach)

    standing = shapely.union_all([b.polygon for b in buildings]) if buildings else Polygon()
    free = shapely.difference(reach, shapely.union_all([surface, ground.bank]))
    fields = _off_buildings(fields, shapely.union_all([g.polygon for p in kept for g in p.grounds]))
    trees = [*plan.trees, *(t for p in kept for t in p.trees), *_field_trees(fields, ground, plan, rng)]
    trees = _clear(trees, standing.buffer(0.3), free)
    return Town(
        bounds=bounds,
        crs=crs,
        seed=seed,
        style=style,
        margin_m=MARGIN_M,
        buildings=tuple(buildings),
        roads=(*plan.roads, *tracks),
        water=tuple(ground.water),
        banks=tuple(polygons_of(ground.bank.intersection(ground.domain))),
        fields=tuple(fields),
        grounds=(*plan.grounds, *(g for p in kept for g in p.grounds)),
        woods=tuple(ground.woods),
        trees=np.array(sorted(trees), dtype=np.float64).reshape(-1, 3),
        cars=_clear_cars(_road_cars(plan, rng), standing),
        contours=tuple(ground.contours),
        walls=tuple(w for p in kept for w in p.walls),
        groups=tuple(shapely.set_precision(g, MILLIMETRE) for g in plan.groups),
        names=tuple(plan.names),
    )


def _make_zones(
    ground: TownGround, woods: BaseGeometry, rng: np.random.Generator, style: TownStyle, plan: TownPlan
) -> list[Polygon]:
    """Apartment complexes, school and works: large plots at the town's edge, placed where they fit."""
    scale = min(1.0, ground.town_radius_m / 560.0)
    wanted: list[tuple[str, float, float]] = [("school", 118.0, 128.0)]
    wanted += [
        ("apartments", float(rng.uniform(170, 260)), float(rng.uniform(140, 210)))
        for _ in range(style.apartments)
    ]
    wanted += [("works", float(rng.uniform(150, 250)), float(rng.uniform(95, 150))) for _ in range(5)]
    roads = shapely.union_all([ground.arterial.buffer(13.0), ground.cross.buffer(10.0)])
    keep_out = shapely.union_all([roads, ground.bank.buffer(12.0), woods])
    zones: list[Polygon] = []
    for kind, w, h in wanted:
        if scale < 0.8 and kind != "school":
            w, h = w * 0.65, h * 0.65
        for _ in range(150):
            away = ground.town_radius_m * float(
                rng.uniform(0.25, 1.15) if kind != "works" else rng.uniform(0.9, 1.9)
            )
            at = float(rng.uniform(0, 2 * math.pi))
            x, y = ground.centre.world(np.array([[away * math.cos(at) * 1.2, away * math.sin(at)]]))[0]
            line = ground.arterial
            s = line.project(Point(x, y))
            a, b = line.interpolate(s - 15), line.interpolate(s + 15)
            angle = math.atan2(b.y - a.y, b.x - a.x) + float(rng.normal(0, 0.1))
            angle -= round(angle / (math.pi / 2)) * (math.pi / 2)
            frame = LocalFrame(float(x), float(y), angle)
            zone = districts.rectangle(float(x), float(y), w, h, angle)
            zone = Polygon(np.asarray(zone.exterior.coords)[:4] + rng.normal(0, 4.0, (4, 2)))
            padded = zone.buffer(9.0)
            if padded.intersects(keep_out) or not ground.domain.contains(padded):
                continue
            if any(padded.intersects(z) for z in zones):
                continue
            zones.append(zone)
            if kind == "school":
                districts.school(zone, frame, (w - 6, h - 6), rng, plan, "한빛초등학교")
            elif kind == "works":
                districts.works(zone, frame, (w - 6, h - 6), rng, plan)
            else:
                districts.apartment_complex(zone, frame, (w, h), rng, style, plan)
                plan.names.append((float(x), float(y), "푸른마을아파트"))
            break
    return zones


def _countryside(
    ground: TownGround,
    woods: BaseGeometry,
    built_up: BaseGeometry,
    rng: np.random.Generator,
    style: TownStyle,
    plan: TownPlan,
) -> None:
    """Villages at the foot of the hills, farms, small works and petrol stations along the roads."""
    left, bottom, right, top = ground.domain.bounds
    area_km2 = (right - left) * (top - bottom) / 1e6
    taken = shapely.union_all([ground.bank.buffer(30.0), built_up.buffer(60.0), woods.buffer(-15.0)])
    spots: list[tuple[float, float]] = []

    def spot(keep_m: float, tries: int = 120) -> tuple[float, float] | None:
        best: tuple[float, float, float] | None = None
        for _ in range(tries):
            x, y = float(rng.uniform(left + 60, right - 60)), float(rng.uniform(bottom + 60, top - 60))
            if any(math.hypot(x - a, y - b) < keep_m for a, b in spots) or taken.intersects(
                Point(x, y).buffer(35)
            ):
                continue
            hill = float(ground.hillness(np.array([[x, y]]))[0]) - ground.forest_level
            score = -abs(hill + 0.55) + float(rng.normal(0, 0.2))
            if best is None or score > best[2]:
                best = (x, y, score)
        return best[:2] if best else None

    for i in range(round(style.villages * area_km2 / 6.0)):
        at = spot(330.0)
        if at:
            spots.append(at)
            districts.make_village(*at, ground, rng, style, plan, _VILLAGES[i % len(_VILLAGES)])
    for _ in range(round(2.4 * area_km2 * min(style.density, 1.3))):
        at = spot(140.0, 30)
        if at:
            spots.append(at)
            s = ground.river.project(Point(at))
            a, b = ground.river.interpolate(s - 20), ground.river.interpolate(s + 20)
            angle = math.atan2(b.y - a.y, b.x - a.x) + float(rng.normal(0, 0.3))
            districts.farmstead(*at, angle, rng, plan)
    # Single houses and workshops along the through roads.
    for line in (ground.arterial, ground.cross, *ground.levees):
        s = float(rng.uniform(0, 60))
        while s < line.length:
            p, q = line.interpolate(s), line.interpolate(s + 2)
            h = math.atan2(q.y - p.y, q.x - p.x)
            side = float(rng.choice([-1, 1])) * math.pi / 2
            away = float(rng.uniform(19, 34))
            x, y = p.x + away * math.cos(h + side), p.y + away * math.sin(h + side)
            if ground.domain.contains(Point(x, y)) and not taken.intersects(Point(x, y)):
                draw = rng.random()
                if draw < 0.09:
                    districts.petrol_station(x, y, h, rng, plan)
                elif draw < 0.55:
                    plan.proposals += districts._house(
                        rng, style, x, y, h + float(rng.normal(0, 0.1)), 15.0, False
                    )
                else:
                    districts._shop(rng, Point(x, y), h, plan)
            s += float(rng.exponential(85)) / max(style.density, 0.2) + 18
    # Huts scattered in the fields.
    for _ in range(round(11 * area_km2 * style.density)):
        x, y = float(rng.uniform(left, right)), float(rng.uniform(bottom, top))
        hut = districts.rectangle(
            x, y, float(rng.uniform(2.6, 7)), float(rng.uniform(2.2, 4)), float(rng.uniform(0, 3.1))
        )
        colour = districts._pick(rng, districts._SHED)
        plan.proposals.append(districts.Proposal(Building(hut, TEMPORARY, 1, 2.6, "box", colour), 1.0))


def _vinyl(fields: list[Area], rng: np.random.Generator, style: TownStyle, plan: TownPlan) -> list[Area]:
    """Turns some parcels, in clusters, into ground under vinyl houses."""
    if not fields or style.greenhouse_share <= 0:
        return fields
    middles = np.array([[f.polygon.centroid.x, f.polygon.centroid.y] for f in fields])
    target = style.greenhouse_share * sum(f.polygon.area for f in fields)
    chosen: set[int] = set()
    done = 0.0
    while done < target and len(chosen) < len(fields):
        seed = int(rng.integers(len(fields)))
        near = np.argsort(np.hypot(*(middles - middles[seed]).T))[: int(rng.integers(2, 8))]
        for k in near.tolist():
            if k not in chosen and 450 < fields[k].polygon.area < 9000:
                chosen.add(k)
                done += fields[k].polygon.area
                districts.vinyl_houses(fields[k], rng, plan)
            elif k not in chosen:
                done += 0.02 * target
    return [
        Area(f.polygon, "vinyl_ground", f.angle_rad, f.shade) if i in chosen else f
        for i, f in enumerate(fields)
    ]


def _open_tracks(tracks: list[Road], closed: BaseGeometry) -> list[Road]:
    """Farm tracks end where woods, river and settlements begin."""
    out: list[Road] = []
    for road in tracks:
        for part in shapely.get_parts(road.line.difference(closed)):
            if part.geom_type == "LineString" and part.length > 30:
                out.append(Road(part, road.width_m, road.kind))
    return out


def _off_buildings(fields: list[Area], yards: BaseGeometry) -> list[Area]:
    shapely.prepare(yards)
    out: list[Area] = []
    for f in fields:
        if shapely.intersects(yards, f.polygon):
            out += [
                Area(p, f.kind, f.angle_rad, f.shade) for p in polygons_of(f.polygon.difference(yards), 80.0)
            ]
        else:
            out.append(f)
    return out


def _field_trees(
    fields: list[Area], ground: TownGround, plan: TownPlan, rng: np.random.Generator
) -> list[tuple[float, float, float]]:
    """Orchard rows, lone trees on field borders and river banks, the ragged edge of the woods, street trees."""
    trees: list[tuple[float, float, float]] = []
    for f in fields:
        if f.kind == "orchard":
            c = f.polygon.centroid
            frame = LocalFrame(c.x, c.y, f.angle_rad)
            step_u, step_v = rng.uniform(3.4, 5.0), rng.uniform(4.4, 6.0)
            r = 0.5 * math.hypot(
                f.polygon.bounds[2] - f.polygon.bounds[0], f.polygon.bounds[3] - f.polygon.bounds[1]
            )
            u, v = np.meshgrid(np.arange(-r, r, step_u), np.arange(-r, r, step_v))
            points = frame.world(np.column_stack([u.ravel(), v.ravel()]) + rng.normal(0, 0.25, (u.size, 2)))
            inside = shapely.contains_xy(f.polygon.buffer(-1.6), points[:, 0], points[:, 1])
            inside &= rng.random(len(points)) < 0.94
            crown = rng.normal(1.55, 0.22)
            trees += [(float(x), float(y), float(crown * rng.uniform(0.75, 1.15))) for x, y in points[inside]]
        elif rng.random() < 0.16:
            ring = f.polygon.exterior
            for _ in range(int(rng.integers(1, 5))):
                p = ring.interpolate(float(rng.random()), normalized=True)
                trees.append((p.x, p.y, float(rng.uniform(0.9, 2.8))))
    for wood in ground.woods:
        ring = wood.exterior
        for s in np.arange(0, ring.length, 5.0):
            p = ring.interpolate(float(s + rng.normal(0, 2)))
            trees.append(
                (
                    p.x + float(rng.normal(0, 2.2)),
                    p.y + float(rng.normal(0, 2.2)),
                    float(rng.uniform(1.4, 3.6)),
                )
            )
    for levee in ground.levees:
        for s in np.arange(0, levee.length, 9.0):
            if rng.random() < 0.28:
                p = levee.interpolate(float(s))
                trees.append(
                    (
                        p.x + float(rng.normal(0, 5)),
                        p.y + float(rng.normal(0, 5)),
                        float(rng.uniform(1.0, 2.6)),
                    )
                )
    line = ground.arterial
    near = Point(ground.centre.x, ground.centre.y)
    for s in np.arange(0, line.length, 8.0):
        p, q = line.interpolate(s), line.interpolate(s + 1)
        if p.distance(near) < ground.town_radius_m * 1.1:
            h = math.atan2(q.y - p.y, q.x - p.x)
            for side in (-1, 1):
                if rng.random() < 0.7:
                    away = side * 9.2
                    trees.append(
                        (p.x - away * math.sin(h), p.y + away * math.cos(h), float(rng.uniform(1.2, 2.2)))
                    )
    return trees


def _clear(
    trees: list[tuple[float, float, float]], standing: BaseGeometry, free: BaseGeometry
) -> list[tuple[float, float, float]]:
    """Trees whose trunks stand neither in a building nor on a road."""
    if not trees:
        return trees
    xy = np.array(trees)
    shapely.prepare(standing)
    shapely.prepare(free)
    good = ~shapely.intersects_xy(standing, xy[:, 0], xy[:, 1]) & shapely.contains_xy(
        free, xy[:, 0], xy[:, 1]
    )
    return [t for t, g in zip(trees, good.tolist()) if g]


def _road_cars(plan: TownPlan, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    cars = list(plan.cars)
    spacing = {"arterial": 55.0, "main": 80.0, "street": 42.0, "lane": 110.0}
    for road in plan.roads:
        if road.kind not in spacing:
            continue
        s = float(rng.exponential(spacing[road.kind]))
        while s < road.line.length:
            p, q = road.line.interpolate(s), road.line.interpolate(s + 1.0)
            h = math.atan2(q.y - p.y, q.x - p.x)
            side = float(rng.choice([-1.0, 1.0]))
            lane = road.width_m * (rng.choice([0.14, 0.34]) if road.kind == "arterial" else 0.27)
            if road.kind == "street":
                lane = road.width_m / 2 - 1.1  # parked at the kerb
            cars.append((p.x + side * lane * math.sin(h), p.y - side * lane * math.cos(h), h))
            s += float(rng.exponential(spacing[road.kind])) + 6.0
    return cars


def _clear_cars(
    cars: list[tuple[float, float, float]], standing: BaseGeometry
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    xy = np.array(cars, dtype=np.float64).reshape(-1, 3)
    near = standing.buffer(1.2)
    shapely.prepare(near)
    return np.asarray(xy[~shapely.intersects_xy(near, xy[:, 0], xy[:, 1])], dtype=np.float64)
