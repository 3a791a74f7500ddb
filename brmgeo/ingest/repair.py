"""Outlines made whole: rings to valid polygons with courtyards, every repair told.

Building outlines come as rings that touch themselves, cross, fold back on themselves or are drawn twice. Each
fault is repaired where the building's area is certain and dropped where it is not; either way it is counted and
says where. Methods: GEOS ``MakeValid`` (structure) for crossing rings; a courtyard is a ring inside a ring of its layer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

#: (n,) shapely geometries, or texts.
Objects = NDArray[np.object_]
# Below this area (m2) an outline is no building, not even the sliver of one that a neatline cuts off (0.02 in real sheets).
MIN_AREA_M2 = 0.01
# An outline that turns back within half a degree of where it came from draws a spike, not a wall.
_SPIKE_SINE = 0.0087
# Coordinates equal to a tenth of a millimetre are the same.
_SAME_DECIMALS = 4

DROPPED_KINDS = frozenset({"open", "zero_area", "unreadable"})
"""Repairs that lost an outline; duplicates lose nothing."""


@dataclass(frozen=True, slots=True)
class Repair:
    """One thing that was done to one outline.

    Attributes:
        kind: "gap" (closed over a gap), "bow_tie" (crossed itself), "self_touch", "spike", "duplicate" (removed),
            or, with the outline dropped, "zero_area", "open" (its ends do not meet) and "unreadable".
        handle: the entity's handle or feature number, "" when it has none.
        layer: its layer.
        x, y: where, in the source's coordinates, metres; not finite where the outline has no vertex.
        detail: what was found, for people.
        source: the file's name.
    """

    kind: str
    handle: str
    layer: str
    x: float
    y: float
    detail: str = ""
    source: str = ""


@dataclass(slots=True)
class ClosedOutlines:
    """Closed outlines before repair: parallel arrays, one element an outline.

    Attributes:
        polygons: (n,) object, shapely polygons (from one ring each, or with holes), perhaps invalid.
        layers: (n,) object str; rings of one layer may be courtyards of each other.
        handles: (n,) object str.
    """

    polygons: Objects
    layers: Objects
    handles: Objects


@dataclass(slots=True)
class Repaired:
    """What ``repair_rings`` gives back.

    Attributes:
        polygons: (m,) object, valid shapely polygons with courtyards as holes, in the order of their rings.
        origin: (m,) int64, index of the ring that each came from (a bow-tie gives two polygons).
        repairs: one entry a repair.
        courtyards: number of rings that became holes.
    """

    polygons: Objects
    origin: NDArray[np.int64]
    repairs: list[Repair] = field(default_factory=list)
    courtyards: int = 0


def repair_rings(rings: ClosedOutlines, source: str = "", courtyards: bool = True) -> Repaired:
    """Valid polygons from closed outlines: spikes cut, crossings split, duplicates and empty ones out, courtyards in.

    Args:
        rings: the outlines; coordinates in metres.
        source: file name for the repairs.
        courtyards: whether a ring inside a ring of its layer is a hole in it (DXF) or a second building (formats
            that have holes of their own).
    """
    done = Repaired(np.empty(0, dtype=object), np.empty(0, dtype=np.int64))
    polygons = rings.polygons.copy()
    for i in np.flatnonzero(_has_spike(polygons)).tolist():
        trimmed, tip = _without_spikes(polygons[i])
        if tip is not None and trimmed is not None:
            done.repairs.append(
                _repair("spike", rings, i, tip, "folded back on itself; the spike was cut", source)
            )
            polygons[i] = trimmed
    polygons, origin = _made_valid(polygons, rings, done, source)
    keep = np.ones(len(polygons), dtype=bool)
    areas = shapely.area(polygons) if len(polygons) else np.empty(0)
    for j in np.flatnonzero(~(areas >= MIN_AREA_M2)).tolist():
        keep[j] = False
        i = int(origin[j])
        detail = f"encloses {max(float(areas[j]), 0.0):.3f} m2; dropped"
        done.repairs.append(_repair("zero_area", rings, i, _any_point(rings.polygons[i]), detail, source))
    polygons, origin = polygons[keep], origin[keep]

    layers = rings.layers[origin] if len(origin) else np.empty(0, dtype=object)
    keep = _first_of_equals(polygons, layers, rings, origin, done, source)
    polygons, origin, layers = polygons[keep], origin[keep], layers[keep]
    if courtyards and len(polygons):
        polygons, inside = _with_courtyards(polygons, layers)
        done.courtyards = int(inside.sum())
        polygons, origin = polygons[~inside], origin[~inside]
        # The same building on two layers counts once; only now, since a ring may be one layer's courtyard and
        # another layer's building.
        keep = _first_of_equals(
            polygons, np.full(len(polygons), "", dtype=object), rings, origin, done, source
        )
        polygons, origin = polygons[keep], origin[keep]
    done.polygons, done.origin = polygons, origin
    return done


def repair_counts(repairs: Iterable[Repair]) -> dict[str, int]:
    """Number of repairs by kind, sorted by kind."""
    return dict(sorted(Counter(repair.kind for repair in repairs).items()))


def shape_keys(polygons: Objects, decimals: int = _SAME_DECIMALS) -> list[bytes]:
    """A key a polygon, equal for equal outlines whatever their first vertex and sense of rotation.

    ``decimals`` of a metre count as the same coordinate.
    """
    if not len(polygons):
        return []
    rounded = shapely.transform(polygons, lambda xy: np.round(xy, decimals) + 0.0)
    # Repeated vertices would tell equal rings apart; normalize() settles start and rotation.
    cleaned = shapely.normalize(shapely.remove_repeated_points(rounded))
    return list(shapely.to_wkb(cleaned))


def _repair(
    kind: str, rings: ClosedOutlines, i: int, at: tuple[float, float], detail: str, source: str
) -> Repair:
    return Repair(kind, str(rings.handles[i]), str(rings.layers[i]), at[0], at[1], detail, source)


def _any_point(polygon: shapely.Polygon) -> tuple[float, float]:
    xy = shapely.get_coordinates(polygon)
    return (float(xy[0, 0]), float(xy[0, 1])) if len(xy) else (float("nan"), float("nan"))


def _turns(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) bool for an open ring of n vertices: whether the outline turns back on itself there."""
    before, after = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    dot = (before * after).sum(axis=1)
    scale = np.hypot(*before.T) * np.hypot(*after.T)
    return np.asarray((dot < 0.0) & (np.abs(cross) <= _SPIKE_SINE * scale), dtype=np.bool_)


def _has_spike(polygons: Objects) -> NDArray[np.bool_]:
    """(n,) bool: polygons whose exterior turns back on itself somewhere; all rings at once."""
    out = np.zeros(len(polygons), dtype=np.bool_)
    if not len(polygons):
        return out
    exteriors = shapely.get_exterior_ring(polygons)
    xy, index = shapely.get_coordinates(exteriors, return_index=True)
    if not len(xy):
        return out
    # Each ring repeats its first vertex at its end; that entry is left out and looked up instead.
    first = np.r_[True, index[1:] != index[:-1]]
    last = np.r_[index[1:] != index[:-1], True]
    starts, ends = np.flatnonzero(first), np.flatnonzero(last)
    before = xy - np.roll(xy, 1, axis=0)
    before[starts] = xy[starts] - xy[np.maximum(ends - 1, starts)]
    after = np.roll(xy, -1, axis=0) - xy
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    dot = (before * after).sum(axis=1)
    scale = np.hypot(before[:, 0], before[:, 1]) * np.hypot(after[:, 0], after[:, 1])
    hit = (dot < 0.0) & (np.abs(cross) <= _SPIKE_SINE * scale) & ~last
    out[np.unique(index[hit])] = True
    return out


def _without_spikes(polygon: shapely.Polygon) -> tuple[shapely.Polygon | None, tuple[float, float] | None]:
    """The polygon with its exterior's spikes cut and the first spike's tip; None, None when nothing is left of it."""
    xy = shapely.get_coordinates(shapely.get_exterior_ring(polygon))[:-1]
    tip: tuple[float, float] | None = None
    while len(xy) >= 3:
        xy = xy[np.hypot(*(xy - np.roll(xy, 1, axis=0)).T) > 1e-6]
        if len(xy) < 3:
            break
        hits = np.flatnonzero(_turns(xy))
        if not len(hits):
            return shapely.Polygon(xy, [r.coords for r in polygon.interiors]), tip
        tip = tip or (float(xy[hits[0], 0]), float(xy[hits[0], 1]))
        xy = np.delete(xy, hits[0], axis=0)
    return None, None


def _made_valid(
    polygons: Objects, rings: ClosedOutlines, done: Repaired, source: str
) -> tuple[Objects, NDArray[np.int64]]:
    """Valid polygons, one or more an outline, and the outline that each came from."""
    origin = np.arange(len(polygons), dtype=np.int64)
    bad = np.flatnonzero(~shapely.is_valid(polygons)) if len(polygons) else np.empty(0, dtype=np.int64)
    if not len(bad):
        return polygons, origin
    extra: list[tuple[int, shapely.Polygon]] = []
    for i in bad:
        reason = str(shapely.is_valid_reason(polygons[i]))
        # "structure" keeps what the ring runs around twice; "linework" would make a hole of it.
        fixed = shapely.make_valid(polygons[i], method="structure", keep_collapsed=False)
        parts = [part for part in _polygon_parts(fixed) if part.area >= MIN_AREA_M2]
        whole = sum(part.area for part in parts)
        if not parts:
            polygons[i] = shapely.Polygon()
            continue
        kind = "self_touch" if reason.startswith("Ring Self-intersection") else "bow_tie"
        at = _reason_point(reason) or _any_point(polygons[i])
        detail = (
            f"{reason.split('[')[0].lower()}; {whole:.2f} m2 in {len(parts)} part{'s' * (len(parts) > 1)}"
        )
        done.repairs.append(_repair(kind, rings, int(i), at, detail, source))
        polygons[i] = parts[0]
        extra += [(int(i), part) for part in parts[1:]]
    if extra:
        more = np.empty(len(extra), dtype=object)
        more[:] = [part for _, part in extra]
        polygons = np.concatenate([polygons, more])
        origin = np.concatenate([origin, np.array([i for i, _ in extra], dtype=np.int64)])
        order = np.argsort(origin, kind="stable")
        polygons, origin = polygons[order], origin[order]
    return polygons, origin


def _polygon_parts(geometry: shapely.Geometry) -> list[shapely.Polygon]:
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return [part for part in parts if shapely.get_type_id(part) == 3]


def _reason_point(reason: str) -> tuple[float, float] | None:
    """GEOS writes the place of a fault as "Self-intersection[x y]"."""
    x, _, y = reason.partition("[")[2].rstrip("]").partition(" ")
    try:
        return float(x), float(y)
    except ValueError:
        return None


def _first_of_equals(
    polygons: Objects,
    layers: Objects,
    rings: ClosedOutlines,
    origin: NDArray[np.int64],
    done: Repaired,
    source: str,
) -> NDArray[np.bool_]:
    """(n,) bool, False for outlines that repeat an earlier one of the same layer."""
    seen: dict[tuple[str, bytes], int] = {}
    keep = np.ones(len(polygons), dtype=np.bool_)
    for j, key in enumerate(shape_keys(polygons)):
        first = seen.setdefault((str(layers[j]), key), j)
        if first != j:
            keep[j] = False
            a, b = int(origin[first]), int(origin[j])
            detail = (
                f"same outline as {rings.handles[a] or 'an earlier one'} on layer {rings.layers[a]}; removed"
            )
            done.repairs.append(_repair("duplicate", rings, b, _any_point(polygons[j]), detail, source))
    return keep


def _with_courtyards(polygons: Objects, layers: Objects) -> tuple[Objects, NDArray[np.bool_]]:
    """Polygons with the rings inside them as holes, and which of the given ones became holes.

    Rings are nested to any depth: a ring at odd depth is a courtyard, at even depth a building (in a courtyard).
    A ring that shares a stretch of wall with the one around it is not a courtyard.
    """
    outer, inner = shapely.STRtree(polygons).query(polygons)
    box = shapely.bounds(polygons)
    # Boxes sort out nearly all pairs, each polygon with itself first, before GEOS must look.
    pair = (
        (outer != inner)
        & (box[outer, :2] <= box[inner, :2]).all(axis=1)
        & (box[outer, 2:] >= box[inner, 2:]).all(axis=1)
    )
    outer, inner = outer[pair], inner[pair]
    pair = layers[outer] == layers[inner]
    outer, inner = outer[pair], inner[pair]
    pair = shapely.contains(polygons[outer], polygons[inner])
    outer, inner = outer[pair], inner[pair]
    if len(outer):
        shared = shapely.length(
            shapely.intersection(shapely.boundary(polygons[outer]), shapely.boundary(polygons[inner]))
        )
        outer, inner = outer[shared <= 1e-6], inner[shared <= 1e-6]
    depth = np.bincount(inner, minlength=len(polygons))
    hole = depth % 2 == 1
    out = polygons.copy()
    areas = shapely.area(polygons)
    holes_of: dict[int, list[int]] = {}
    for j in np.flatnonzero(hole):
        around = outer[inner == j]
        parent = int(around[np.argmin(areas[around])])
        holes_of.setdefault(parent, []).append(int(j))
    for parent, children in holes_of.items():
        shell = polygons[parent]
        made = shapely.Polygon(
            shell.exterior,
            [r.coords for r in shell.interiors] + [polygons[j].exterior.coords for j in children],
        )
        if not made.is_valid:
            made = shapely.difference(shell, shapely.union_all(polygons[children]))
            made = max(_polygon_parts(made), key=lambda part: part.area, default=shell)
        out[parent] = made
    return out, hole
