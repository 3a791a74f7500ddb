"""Entities of a DXF to lines: polylines, lines, arcs and circles of the wanted layers, and blocks that are buildings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.extras import extra
from brmgeo.ingest.dxf.tags import Tags

MIN_BLOCK_AREA_M2 = 4.0

_OUTLINE_TYPES = (b"LWPOLYLINE", b"POLYLINE", b"LINE", b"ARC", b"CIRCLE")
_NEVER_OUTLINES = (b"VERTEX", b"SEQEND", b"INSERT", b"TEXT", b"MTEXT", b"ATTRIB", b"POINT")


@dataclass(slots=True)
class Line:
    """One drawn line before it is closed or chained: a polyline, line, arc or circle."""

    xy: NDArray[np.float64]
    closed: bool
    layer: bytes
    handle: str

    def is_shut(self, snap_m: float) -> bool:
        """Whether it is closed, or its ends lie at most ``snap_m`` apart."""
        return self.closed or bool(np.hypot(*(self.xy[-1] - self.xy[0])) <= snap_m)


def in_modelspace(tags: Tags, heads: NDArray[np.int64]) -> NDArray[np.int64]:
    paper = tags.first(heads, 67)
    return heads[tags.integers(paper) != 1] if (paper >= 0).any() else heads


def lines_on(
    tags: Tags, heads: NDArray[np.int64], wanted: Iterable[bytes], sagitta_m: float, counts: dict[str, int]
) -> list[Line]:
    """Outline entities among ``heads`` whose layer is wanted, in file order."""
    types = tags.types[heads]
    outline = np.isin(types, _OUTLINE_TYPES)
    other = ~outline & ~np.isin(types, _NEVER_OUTLINES)
    layer = tags.names(tags.first(heads, 8))
    on_layer = np.isin(layer, list(wanted))
    counts["other_entities"] = counts.get("other_entities", 0) + int((other & on_layer).sum())
    pick = np.flatnonzero(outline & on_layer)
    heads_, types_, layers_ = heads[pick], types[pick], layer[pick]
    handles = [
        tags.value(int(row)).decode("ascii", errors="replace") if row >= 0 else ""
        for row in tags.first(heads_, 5)
    ]
    lines: list[tuple[int, Line]] = []
    vertices = heads[types == b"VERTEX"]
    flags = tags.integers(tags.first(heads_, 70))
    extrusions = _extrusions(tags, heads_)
    for kind in set(types_.tolist()):
        k = np.flatnonzero(types_ == kind)
        if kind in (b"LWPOLYLINE", b"POLYLINE"):
            if kind == b"POLYLINE":
                meshes = (flags[k] & (16 | 64)) != 0
                counts["other_entities"] += int(meshes.sum())
                k = k[~meshes]
                points = _polyline_points(tags, heads_[k], vertices, counts)
            else:
                points = _lwpolyline_points(tags, heads_[k], counts)
            closed = (flags[k] & 1) != 0
            found = _polylines(points, closed, sagitta_m, counts)
        else:
            found = _simple(tags, kind, heads_[k], sagitta_m)
            closed = np.full(len(k), kind == b"CIRCLE")
        three_d = (kind == b"LINE") | ((kind == b"POLYLINE") & ((flags[k] & 8) != 0))
        for j, xy, shut, world in zip(
            k.tolist(), found, closed.tolist(), np.broadcast_to(three_d, k.shape).tolist()
        ):
            if j in extrusions and not world:
                xy = _from_ocs(xy, extrusions[j])
            lines.append((int(j), Line(xy, shut, bytes(layers_[j]), handles[j])))
    lines.sort(key=lambda item: item[0])
    return [line for _, line in lines]


def _extrusions(tags: Tags, heads: NDArray[np.int64]) -> dict[int, tuple[float, float, float]]:
    """Extrusion of the entities that are drawn in a plane of their own (by position in ``heads``)."""
    rows = tags.first(heads, 210)
    out = {}
    for j in np.flatnonzero(rows >= 0):
        x, y, z = tags.floats(np.array([rows[j], rows[j] + 1, rows[j] + 2])).tolist()
        if (x, y) != (0.0, 0.0) or z < 0.0:
            out[int(j)] = (x, y, z)
    return out


def _from_ocs(xy: NDArray[np.float64], extrusion: tuple[float, float, float]) -> NDArray[np.float64]:
    """Points drawn in an entity's own plane, seen from above (elevation taken as 0)."""
    with extra("maps", "reading a DXF"):
        from ezdxf.math import OCS

    ocs = OCS(extrusion)
    return np.array([ocs.to_wcs((x, y, 0.0)).vec2 for x, y in xy], dtype=np.float64).reshape(-1, 2)


@dataclass(slots=True)
class _Points:
    """Vertices of many polylines: (n, 2) xy, (n,) bulge to the next vertex, (k + 1,) offsets of each polyline."""

    xy: NDArray[np.float64]
    bulge: NDArray[np.float64]
    offsets: NDArray[np.int64]


def _lwpolyline_points(tags: Tags, heads: NDArray[np.int64], counts: dict[str, int]) -> _Points:
    owner = _owner_of_rows(tags, heads)
    rows = np.flatnonzero((tags.codes == 10) & (owner >= 0))
    xy = _xy(tags, rows)
    bulge = np.zeros(len(rows))
    bulges = np.flatnonzero((tags.codes == 42) & (owner >= 0))
    vertex = np.searchsorted(rows, bulges) - 1
    real = (
        (vertex >= 0) & (owner[rows[np.maximum(vertex, 0)]] == owner[bulges])
        if len(rows)
        else np.zeros(0, dtype=bool)
    )
    if len(rows):
        bulge[vertex[real]] = tags.floats(bulges[real])
    offsets = np.concatenate([[0], np.cumsum(np.bincount(owner[rows], minlength=len(heads)))]).astype(
        np.int64
    )
    counts["z_dropped"] += int((tags.floats(tags.first(heads, 38)) != 0.0).sum())
    return _Points(xy, bulge, offsets)


def _polyline_points(
    tags: Tags, heads: NDArray[np.int64], vertices: NDArray[np.int64], counts: dict[str, int]
) -> _Points:
    order = np.argsort(heads)
    at = np.searchsorted(heads[order], vertices, side="right") - 1
    # A vertex belongs to the polyline just before it, with nothing but vertices between.
    polylines = np.flatnonzero(tags.types == b"POLYLINE")
    nearest = (
        polylines[np.maximum(np.searchsorted(polylines, vertices, side="right") - 1, 0)]
        if len(polylines)
        else vertices
    )
    mine = (
        (at >= 0) & (heads[order][np.maximum(at, 0)] == nearest)
        if len(heads)
        else np.zeros(len(vertices), dtype=bool)
    )
    vertices, owner = vertices[mine], order[at[mine]]
    control = (tags.integers(tags.first(vertices, 70)) & 16) != 0
    vertices, owner = vertices[~control], owner[~control]
    rows = tags.first(vertices, 10)
    if (rows < 0).any():
        row = int(tags.heads[vertices[np.flatnonzero(rows < 0)[0]]])
        raise InputError(
            f"{tags.name}: damaged at line {tags.line(row)}: a VERTEX without coordinates: export the sheet again"
        )
    xy = _xy(tags, rows)
    z = tags.floats(tags.first(vertices, 30))
    counts["z_dropped"] += len(np.unique(owner[z != 0.0]))
    bulge = tags.floats(tags.first(vertices, 42))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=len(heads)))]).astype(np.int64)
    return _Points(xy, bulge, offsets)


def _owner_of_rows(tags: Tags, heads: NDArray[np.int64]) -> NDArray[np.int32]:
    """(n,) int32: for every tag the position in ``heads`` of the entity that it belongs to, -1 for others."""
    owner = np.full(len(tags.heads), -1, dtype=np.int32)
    owner[heads] = np.arange(len(heads), dtype=np.int32)
    sizes = np.diff(np.append(tags.heads, len(tags.codes)))
    before = np.full(int(tags.heads[0]), -1, dtype=np.int32)
    return np.concatenate([before, np.repeat(owner, sizes)])


def _xy(tags: Tags, rows: NDArray[np.int64], step: int = 1) -> NDArray[np.float64]:
    """(k, 2) float64: the coordinate pairs whose x stand at ``rows``; y is the tag after each."""
    if not len(rows):
        return np.empty((0, 2))
    after = np.minimum(rows + step, len(tags.codes) - 1)
    wrong = np.flatnonzero(tags.codes[after] != tags.codes[rows] + 10)
    if len(wrong):
        row = int(after[wrong[0]])
        raise InputError(
            f"{tags.name}: damaged at line {tags.line(row)}: an x coordinate without its y: export the sheet again"
        )
    values = tags.floats(np.stack([rows, after], axis=1).reshape(-1))
    return values.reshape(-1, 2)


def _polylines(
    points: _Points, closed: NDArray[np.bool_], sagitta_m: float, counts: dict[str, int]
) -> list[NDArray[np.float64]]:
    """Vertices of each polyline, bulges flattened."""
    bulged = np.unique(np.searchsorted(points.offsets, np.flatnonzero(points.bulge != 0.0), side="right") - 1)
    out = [points.xy[a:b] for a, b in zip(points.offsets[:-1].tolist(), points.offsets[1:].tolist())]
    counts["bulges"] += len(bulged)
    for j in bulged.tolist():
        a, b = int(points.offsets[j]), int(points.offsets[j + 1])
        out[j] = flatten_bulges(points.xy[a:b], points.bulge[a:b], bool(closed[j]), sagitta_m)
    return out


def flatten_bulges(
    xy: NDArray[np.float64], bulge: NDArray[np.float64], closed: bool, sagitta_m: float
) -> NDArray[np.float64]:
    """(m, 2) float64 vertices of a polyline whose arcs became chords within ``sagitta_m`` of them.

    Args:
        xy: (n, 2) float64 vertices, metres.
        bulge: (n,) float64, tan of a quarter of the arc's angle from each vertex to the next; positive counter-clockwise.
        closed: whether the last vertex has an arc or line to the first.
        sagitta_m: largest distance between arc and chord, metres, > 0.
    """
    pieces: list[NDArray[np.float64]] = []
    n = len(xy)
    for i in range(n):
        pieces.append(xy[i : i + 1])
        if i == n - 1 and not closed:
            break
        b = float(bulge[i])
        p, q = xy[i], xy[(i + 1) % n]
        chord = float(np.hypot(*(q - p)))
        if abs(b) * chord < 2e-6:  # bends by less than a thousandth of a millimetre
            continue
        angle = 4.0 * math.atan(b)
        radius = chord * (1.0 + b * b) / (4.0 * abs(b))
        # The centre lies left of the chord for a counter-clockwise arc of less than half a turn.
        offset = chord * (1.0 - b * b) / (4.0 * b)
        direction = (q - p) / chord
        centre = (p + q) / 2.0 + offset * np.array([-direction[1], direction[0]])
        start = math.atan2(p[1] - centre[1], p[0] - centre[0])
        steps = _arc_steps(radius, abs(angle), sagitta_m)
        phi = start + angle * np.arange(1, steps) / steps
        pieces.append(centre + radius * np.stack([np.cos(phi), np.sin(phi)], axis=1))
    return np.concatenate(pieces) if pieces else xy


def _arc_steps(radius: float, angle: float, sagitta_m: float) -> int:
    # 4 asin sqrt(s / 2r) is 2 acos(1 - s / r) without its loss of digits for flat arcs.
    return max(2, math.ceil(angle / (4.0 * math.asin(math.sqrt(min(sagitta_m / (2.0 * radius), 0.5))))))


def _simple(tags: Tags, kind: bytes, heads: NDArray[np.int64], sagitta_m: float) -> list[NDArray[np.float64]]:
    """Points of LINE, ARC and CIRCLE entities."""
    rows = tags.first(heads, 10)
    if (rows < 0).any():
        row = int(tags.heads[heads[np.flatnonzero(rows < 0)[0]]])
        raise InputError(
            f"{tags.name}: damaged at line {tags.line(row)}: {kind.decode()} without coordinates: export again"
        )
    start = _xy(tags, rows)
    if kind == b"LINE":
        ends = tags.first(heads, 11)
        if (ends < 0).any():
            row = int(tags.heads[heads[np.flatnonzero(ends < 0)[0]]])
            raise InputError(
                f"{tags.name}: damaged at line {tags.line(row)}: LINE without an end: export the sheet again"
            )
        return list(np.stack([start, _xy(tags, ends)], axis=1))
    radius = tags.floats(tags.first(heads, 40))
    a0 = tags.floats(tags.first(heads, 50), 0.0) if kind == b"ARC" else np.zeros(len(heads))
    a1 = tags.floats(tags.first(heads, 51), 360.0) if kind == b"ARC" else np.full(len(heads), 360.0)
    out = []
    for c, r, begin, end in zip(start, radius.tolist(), np.radians(a0).tolist(), np.radians(a1).tolist()):
        sweep = (end - begin) % math.tau or math.tau
        steps = max(8 if kind == b"CIRCLE" else 2, _arc_steps(max(r, 1e-9), sweep, sagitta_m))
        phi = begin + sweep * np.arange(steps + (kind == b"ARC")) / steps
        out.append(c + r * np.stack([np.cos(phi), np.sin(phi)], axis=1))
    return out


def block_lines(
    tags: Tags,
    heads: NDArray[np.int64],
    wanted: dict[bytes, str],
    snap_m: float,
    sagitta_m: float,
    max_block_uses: int,
    least_area: float,
    counts: dict[str, int],
) -> list[Line]:
    """Outlines of the block references that are buildings (see the module); counts those and the symbols."""
    inserts = heads[tags.types[heads] == b"INSERT"]
    counts["blocks_as_buildings"] = counts["symbols_ignored"] = 0
    if not len(inserts):
        return []
    names = tags.names(tags.first(inserts, 2)).tolist()
    layers = tags.names(tags.first(inserts, 8))
    uses = Counter(names)
    candidates = [
        k for k in np.flatnonzero(np.isin(layers, list(wanted))).tolist() if uses[names[k]] <= max_block_uses
    ]
    blocks = _block_heads(tags) if candidates else {}
    out: list[Line] = []
    taken = 0
    for k in candidates:
        lines = _exploded(tags, int(inserts[k]), bytes(layers[k]), blocks, wanted, sagitta_m, depth=0)
        solid = [line for line in lines if line.layer in wanted]
        area = sum(
            shapely.Polygon(line.xy).area for line in solid if len(line.xy) >= 3 and line.is_shut(snap_m)
        )
        if area >= least_area:
            out += solid
            taken += 1
    counts["blocks_as_buildings"], counts["symbols_ignored"] = taken, len(inserts) - taken
    return out


def kinds_left_out(tags: Tags, heads: NDArray[np.int64], wanted: Iterable[bytes]) -> Counter[str]:
    """Entities on the wanted layers that are drawn but not read, by kind: splines, hatches, faces, meshes."""
    heads = heads[np.isin(tags.names(tags.first(heads, 8)), list(wanted))]
    types = tags.types[heads]
    mesh = (types == b"POLYLINE") & ((tags.integers(tags.first(heads, 70)) & (16 | 64)) != 0)
    other = heads[mesh | ~np.isin(types, (*_OUTLINE_TYPES, *_NEVER_OUTLINES))]
    return Counter(kind.decode("ascii", errors="replace") for kind in tags.types[other].tolist())


def layers_drawn_on(tags: Tags, heads: NDArray[np.int64]) -> Counter[str]:
    """Names of layers, in upper case, by the number of entities on them that could be outlines."""
    outlines = heads[np.isin(tags.types[heads], _OUTLINE_TYPES)]
    return Counter(_text(name) for name in tags.names(tags.first(outlines, 8)).tolist())


def blocks_left_out(tags: Tags, heads: NDArray[np.int64], wanted: Iterable[bytes]) -> Counter[str]:
    """Blocks that are put on other layers but hold outlines of the wanted ones, by the number of those."""
    inserts = heads[tags.types[heads] == b"INSERT"]
    inserts = inserts[~np.isin(tags.names(tags.first(inserts, 8)), list(wanted))]
    blocks = _block_heads(tags) if len(inserts) else {}
    found: Counter[str] = Counter()
    for name in set(tags.names(tags.first(inserts, 2)).tolist()) & set(blocks):
        held = blocks[name][0]
        held = held[np.isin(tags.types[held], _OUTLINE_TYPES)]
        found[_text(name)] = int(np.isin(tags.names(tags.first(held, 8)), list(wanted)).sum())
    return +found


def _text(name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("cp949", errors="replace")


def _block_heads(tags: Tags) -> dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Contents and base point of every block, by upper-case name."""
    if tags.blocks is None:
        return {}
    out: dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]] = {}
    heads = np.arange(*tags.blocks)
    begins, ends = heads[tags.types[heads] == b"BLOCK"], heads[tags.types[heads] == b"ENDBLK"]
    for begin in begins.tolist():
        end = (
            int(ends[np.searchsorted(ends, begin)]) if len(ends) and ends[-1] > begin else int(heads[-1]) + 1
        )
        one = np.array([begin])
        name = bytes(tags.names(tags.first(one, 2))[0])
        base = np.array([tags.floats(tags.first(one, code))[0] for code in (10, 20)])
        out[name] = (np.arange(begin + 1, end), base)
    return out


def _exploded(
    tags: Tags,
    insert: int,
    layer: bytes,
    blocks: dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]],
    wanted: dict[bytes, str],
    sagitta_m: float,
    depth: int,
) -> list[Line]:
    """Lines of one block reference, placed; nested references are followed eight deep."""
    one = np.array([insert])

    def number(code: int, default: float) -> float:
        return float(tags.floats(tags.first(one, code), default)[0])

    content, base = blocks.get(
        bytes(tags.names(tags.first(one, 2))[0]), (np.empty(0, dtype=np.int64), np.zeros(2))
    )
    scale = np.array([number(41, 1.0), number(42, 1.0)])
    turn = math.radians(number(50, 0.0))
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    at = np.array([number(10, 0.0), number(20, 0.0)])
    extrusion = _extrusions(tags, one).get(0)
    factor = float(np.abs(scale).max()) or 1.0
    ignored: dict[str, int] = dict.fromkeys(("z_dropped", "bulges"), 0)
    parts = lines_on(tags, content, {**wanted, b"0": ""}, sagitta_m / factor, ignored)
    if depth < 8:
        for nested in content[tags.types[content] == b"INSERT"].tolist():
            own = bytes(tags.names(tags.first(np.array([nested]), 8))[0])
            parts += _exploded(tags, nested, own, blocks, wanted, sagitta_m / factor, depth + 1)
    handle = (
        tags.value(int(row)).decode("ascii", errors="replace") if (row := tags.first(one, 5)[0]) >= 0 else ""
    )
    columns, rows = max(int(number(70, 1.0)), 1), max(int(number(71, 1.0)), 1)
    spacing = np.array([number(44, 0.0), number(45, 0.0)])
    out = []
    for part in parts:
        own = layer if part.layer == b"0" else part.layer
        for i in range(columns):
            for j in range(rows):
                shift = np.array([i, j]) * spacing
                xy = ((part.xy - base) * scale + shift) @ rotation.T + at
                out.append(
                    Line(xy if extrusion is None else _from_ocs(xy, extrusion), part.closed, own, handle)
                )
    return out
