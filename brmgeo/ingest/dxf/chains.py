"""Lines to closed rings: as they are drawn, over a gap, or chained end to end."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.ingest.dxf.entities import Line
from brmgeo.ingest.groups import grouped
from brmgeo.ingest.repair import Repair


@dataclass(slots=True)
class DrawnRings:
    """Closed rings found so far, as parallel lists, and what was seen on the way."""

    rings: list[NDArray[np.float64]] = field(default_factory=list)
    layers: list[str] = field(default_factory=list)
    handles: list[str] = field(default_factory=list)
    repairs: list[Repair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def polygons(self) -> NDArray[np.object_]:
        """One polygon a ring, perhaps invalid."""
        if not self.rings:
            return np.empty(0, dtype=object)
        sizes = [len(ring) for ring in self.rings]
        rings = shapely.linearrings(
            np.concatenate(self.rings), indices=np.repeat(np.arange(len(sizes)), sizes)
        )
        return np.asarray(shapely.polygons(rings), dtype=object)


def close(lines: list[Line], wanted: dict[bytes, str], snap_m: float, drawn: DrawnRings, source: str) -> None:
    """Turns lines into rings: closed ones as they are, near-closed ones snapped, the rest chained end to end."""
    loose: dict[str, list[Line]] = {}
    for line in lines:
        layer, xy = wanted[line.layer], line.xy
        if len(xy) == 0:
            drawn.repairs.append(
                Repair("unreadable", line.handle, layer, math.nan, math.nan, "no vertices", source)
            )
            continue
        gap = math.hypot(xy[-1, 0] - xy[0, 0], xy[-1, 1] - xy[0, 1])
        # Two points and a line are not closed by their being short, only by a flag or a third vertex.
        if not line.closed and (gap > snap_m or len(xy) < 4 - (gap > 1e-6)):
            loose.setdefault(layer, []).append(line)
            continue
        if gap > 1e-6 and not line.closed:
            detail = f"ends {gap:.3f} m apart; joined"
            drawn.repairs.append(
                Repair("gap", line.handle, layer, float(xy[0, 0]), float(xy[0, 1]), detail, source)
            )
        if len(xy) < 3:
            xy = np.concatenate([xy, np.repeat(xy[-1:], 3 - len(xy), axis=0)])
        drawn.rings.append(xy)
        drawn.layers.append(layer)
        drawn.handles.append(line.handle)
    for layer, members in loose.items():
        _chain(layer, members, snap_m, drawn, source)


def _chain(layer: str, members: list[Line], snap_m: float, drawn: DrawnRings, source: str) -> None:
    """Rings from the open lines of one layer, joined where their ends lie within ``snap_m``; the others are dropped."""
    ends = np.concatenate([line.xy[[0, -1]] for line in members])
    joined = _snapped(ends, snap_m)
    strings = []
    for k, line in enumerate(members):
        xy = line.xy.copy()
        xy[0], xy[-1] = joined[2 * k], joined[2 * k + 1]
        strings.append(shapely.LineString(xy) if len(xy) > 1 else shapely.LineString([xy[0], xy[0]]))
    # Ring edges that cross or repeat must meet in vertices before faces can be found.
    faces, *_ = shapely.polygonize_full([shapely.node(shapely.GeometryCollection(strings))])
    rings = shapely.get_parts(faces)
    tree = shapely.STRtree(strings)
    used: set[int] = set()
    for ring in rings:
        shell = shapely.Polygon(ring.exterior)
        touching = [int(k) for k in tree.query(shell.exterior, predicate="intersects")]
        along = [k for k in touching if shapely.intersection(strings[k], shell.exterior).length > 0.0]
        used.update(along)
        drawn.rings.append(shapely.get_coordinates(shell.exterior))
        drawn.layers.append(layer)
        drawn.handles.append(members[min(along)].handle if along else "")
        moved = np.hypot(*(joined - ends).T).reshape(-1, 2)[along].max(initial=0.0)
        if moved > 1e-6:
            at = joined[2 * min(along)]
            detail = f"chained lines {moved:.3f} m apart; joined"
            drawn.repairs.append(
                Repair("gap", drawn.handles[-1], layer, float(at[0]), float(at[1]), detail, source)
            )
    drawn.counts["chained"] += len(rings)
    left = [k for k in range(len(members)) if k not in used]
    # Lines that hang together are one outline that did not close, not many.
    for group in _components([joined[2 * k : 2 * k + 2] for k in left]):
        k = left[group[0]]
        length = sum(float(strings[left[g]].length) for g in group)
        detail = (
            f"{len(group)} line{'s' * (len(group) > 1)} of {length:.1f} m whose ends do not meet; dropped"
        )
        x, y = (float(v) for v in joined[2 * k])
        drawn.repairs.append(Repair("open", members[k].handle, layer, x, y, detail, source))


def _snapped(points: NDArray[np.float64], snap_m: float) -> NDArray[np.float64]:
    """The points with each replaced by the first one of its cluster within ``snap_m``."""
    out = points.copy()
    ends = np.asarray(shapely.points(points), dtype=object)
    a, b = shapely.STRtree(ends).query(ends, predicate="dwithin", distance=max(snap_m, 1e-9))
    order = np.lexsort((b, a))
    first = np.full(len(points), len(points))
    np.minimum.at(first, a[order], b[order])
    for k in range(len(points)):
        root = k
        while first[root] != root:
            root = int(first[root])
        out[k] = points[root]
    return out


def _components(ends: list[NDArray[np.float64]]) -> list[list[int]]:
    """Groups of lines that share end points, in order."""
    if not ends:
        return []
    owner = np.repeat(np.arange(len(ends)), 2)
    _, first, point = np.unique(np.concatenate(ends), axis=0, return_index=True, return_inverse=True)
    heads = grouped(len(ends), owner, owner[first[point.reshape(-1)]])
    return [np.flatnonzero(heads == head).tolist() for head in np.unique(heads)]
