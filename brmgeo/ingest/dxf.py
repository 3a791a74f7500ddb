"""DXF sheets: building outlines of the chosen layers, from R12 to R2018, fast and with every repair told.

A sheet of 30 000 entities holds some 5 000 that are buildings. A general reader builds an object for each of them
and for every vertex; here the file is cut into tags (group code, value) by a few numpy passes over its bytes,
entities of other layers are never touched, and all coordinates of the wanted ones are parsed at once. What is
read is what ezdxf reads: the tests hold the two against each other. Binary DXF is turned into text by ezdxf first.

What counts as an outline, in modelspace and on a wanted layer:

- LWPOLYLINE and POLYLINE (2D; of 3D ones the heights are dropped; meshes are not outlines), CIRCLE;
- closed by flag, by a repeated first vertex, or over a gap of at most ``snap_m``; bulges become short chords;
- LINE and ARC, and polylines left open, joined end to end into rings (polygonised, layer by layer);
- a ring inside a ring of the same layer is its courtyard.

INSERT: NGII draws facility symbols as block references whose contents sit on building layers, so block contents do
not count, with one exception: an INSERT that itself sits on a wanted building layer, whose block is not used more than twice
(symbols repeat, buildings do not) and encloses at least ``MIN_BLOCK_AREA_M2``, is a building drawn as a block. Its
entities keep their own layer; those on layer "0" take the INSERT's, as DXF says. Both kinds are counted.

Texts are never decoded, so a wrong or missing code page cannot fail a sheet.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely
from ezdxf.filemanagement import readfile
from ezdxf.math import OCS
from numpy.typing import NDArray

from brmgeo.codes import BUILDING_KINDS, BUILDING_LAYERS, GROUP_BOUNDARY_LAYER, NEATLINE_LAYER, layer_code
from brmgeo.errors import InputError, SettingsError, one_line
from brmgeo.ingest.repair import DROPPED_KINDS, Repair, Rings, repair_counts, repair_rings

SNAP_M = 0.10
SAGITTA_M = 0.01
MAX_DROPPED_SHARE = 0.05
MIN_BLOCK_AREA_M2 = 4.0
MAX_BLOCK_USES = 2

_OUTLINE_TYPES = (b"LWPOLYLINE", b"POLYLINE", b"LINE", b"ARC", b"CIRCLE")
_NAME_BYTES = 64
_BYTES_A_VALUE = 200
_BINARY_DXF = b"AutoCAD Binary DXF"


@dataclass(slots=True)
class SheetFootprints:
    """One DXF sheet's buildings.

    Attributes:
        footprints: GeoDataFrame without CRS (a DXF has none): ``geometry`` (valid polygons, metres, as drawn),
            ``layer`` (code), ``kind`` (see codes.BUILDING_KINDS, "other" for layers of your own), ``handle`` (of the
            entity), ``source`` (file name).
        neatline: the sheet frame (layer H0017334), or None when the sheet has none.
        repairs: what was repaired or dropped, where.
        counts: facts by name: outlines, footprints, courtyards, z_dropped, bulges, chained, blocks_as_buildings,
            symbols_ignored, other_entities (on wanted layers, not outlines) and one ``repair_KIND`` a kind.
        dropped_share: outlines dropped / outlines found, in [0, 1].
    """

    footprints: gpd.GeoDataFrame
    neatline: shapely.Polygon | None
    repairs: list[Repair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    dropped_share: float = 0.0


def read_dxf(
    path: str | Path,
    layers: Sequence[str] = BUILDING_LAYERS,
    *,
    snap_m: float = SNAP_M,
    sagitta_m: float = SAGITTA_M,
    max_dropped_share: float = MAX_DROPPED_SHARE,
    max_block_uses: int = MAX_BLOCK_USES,
) -> SheetFootprints:
    """The building outlines of one DXF sheet; see the module for what counts as one.

    Args:
        path: the .dxf file, text or binary, R12 to R2018.
        layers: layer names, case ignored; "B0014112" and the older "4112" stand for each other.
        snap_m: ends of an outline at most this far apart are joined, metres.
        sagitta_m: chords that replace an arc stay within this of it, metres.
        max_dropped_share: share of outlines that may be dropped before the sheet is refused, in [0, 1].
        max_block_uses: blocks used more often than this are symbols; 0 takes no block for a building.

    A sheet without buildings gives no footprints and is no error. Raises InputError, in one line, for a file that is no DXF,
    is cut short, is damaged (with the line number), or loses more outlines than allowed; SettingsError for layer B0014119,
    which bounds groups of houses, and for values out of range.
    """
    path = Path(path)
    wanted = _wanted_layers(layers)
    if not snap_m >= 0 or not sagitta_m > 0 or not 0 <= max_dropped_share <= 1:
        raise SettingsError(
            f"snap_m {snap_m}, sagitta_m {sagitta_m}, max_dropped_share {max_dropped_share}: "
            "give snap_m >= 0, sagitta_m > 0 and a share in [0, 1]"
        )
    tags = _Tags(_dxf_text(path), path.name)
    drawn = _draw(tags, wanted, snap_m, sagitta_m, max_block_uses)

    rings = Rings(drawn.polygons(), _objects(drawn.layers), _objects(drawn.handles))
    repaired = repair_rings(rings, path.name)
    repairs = sorted(drawn.repairs + repaired.repairs, key=lambda r: (r.kind, r.layer, r.handle, r.x, r.y))
    layer = rings.layers[repaired.origin]
    frame = gpd.GeoDataFrame(
        {
            "layer": layer.astype(object),
            "kind": _objects([BUILDING_KINDS.get(name, "other") for name in layer]),
            "handle": rings.handles[repaired.origin],
            "source": _objects([path.name] * len(layer)),
        },
        geometry=gpd.GeoSeries(list(repaired.polygons), dtype="geometry"),
    )[["geometry", "layer", "kind", "handle", "source"]]
    dropped = sum(repair.kind in DROPPED_KINDS for repair in repairs)
    outlines = len(rings.polygons) + sum(repair.kind in DROPPED_KINDS for repair in drawn.repairs)
    share = dropped / outlines if outlines else 0.0
    counts = {
        "outlines": outlines,
        "footprints": len(frame),
        "courtyards": repaired.courtyards,
        **drawn.counts,
    }
    counts |= {f"repair_{kind}": n for kind, n in repair_counts(repairs).items()}
    if share > max_dropped_share:
        worst = next(repair for repair in repairs if repair.kind in DROPPED_KINDS)
        raise InputError(
            f"{path.name}: {dropped} of {outlines} outlines ({share:.0%}) are not usable, {max_dropped_share:.0%} allowed; "
            f"first: {worst.kind} on {worst.layer}, handle {worst.handle or '?'}, at {worst.x:.2f}, {worst.y:.2f}: "
            "mend the sheet or raise max_dropped_share"
        )
    return SheetFootprints(frame, _neatline(tags, snap_m, sagitta_m), repairs, counts, share)


def _wanted_layers(layers: Sequence[str]) -> dict[bytes, str]:
    """Layer name as it may stand in a file (upper case, either encoding) -> the name that results carry."""
    if isinstance(layers, str) or not layers:
        raise SettingsError(
            f"layers must be a list of layer names, such as {list(BUILDING_LAYERS[:2])}, not {layers!r}"
        )
    wanted: dict[bytes, str] = {}
    for name in layers:
        code = layer_code(name)
        if code == GROUP_BOUNDARY_LAYER:
            raise SettingsError(
                f"layer {name} bounds groups of houses, not buildings: leave it out of layers"
            )
        spellings = {code, code.removeprefix("B001")} if re.fullmatch(r"B001411\d", code) else {code}
        for spelling in spellings:
            # UTF-8 from R2007 on, a code page or \U+ escapes before; bytes are compared in ASCII upper case.
            for text in (
                spelling.encode("utf-8"),
                spelling.encode("cp949", errors="replace"),
                _escaped(spelling),
            ):
                wanted[text.upper()] = code
    return wanted


def _escaped(name: str) -> bytes:
    """A name as code pages that lack its letters write it: U+AC74 becomes ``\\U+AC74``."""
    return "".join(c if c.isascii() else f"\\U+{ord(c):04X}" for c in name).encode("ascii")


def _dxf_text(path: Path) -> bytes:
    """The bytes of a text DXF; raises InputError, in one line, for what is none."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not data.strip():
        raise InputError(f"{path.name}: the file is empty: export or download the sheet again")
    if re.match(rb"AC1\d\d\d", data):
        raise InputError(
            f"{path.name}: this is a DWG drawing, not a DXF: save it as DXF (R12 to R2018) first"
        )
    if data[:4] == b"PK\x03\x04":
        raise InputError(f"{path.name}: this is a zip archive: unpack it and give the .dxf inside")
    if data.startswith(_BINARY_DXF):
        try:
            stream = io.StringIO()
            readfile(path).write(stream)
        except Exception as error:  # ezdxf raises many kinds on damaged binary files
            reason = one_line(error, 120)
            raise InputError(
                f"{path.name}: binary DXF, damaged or cut short ({reason}): export the sheet again"
            ) from error
        return stream.getvalue().encode("utf-8", errors="replace")
    return data.removeprefix(b"\xef\xbb\xbf")


class _Tags:
    """A text DXF as tags: group codes and where in the bytes their values lie, and entities as ranges of tags.

    Attributes:
        codes: (n,) int32 group codes, up to and without EOF.
        starts, ends: (n,) int64, value i is ``data[starts[i]:ends[i]]``, blanks at both ends left out.
        heads: (m,) int64 tags with code 0, each the start of an entity, then n.
        types: (m,) S, their values.
        entities, blocks: half-open ranges of heads: section ENTITIES and section BLOCKS.
    """

    def __init__(self, data: bytes, name: str) -> None:
        self.data, self.name = data, name
        array = np.frombuffer(data, dtype=np.uint8)
        newline = np.flatnonzero(array == 10)
        if len(newline) == 0 or newline[-1] != len(data) - 1:
            newline = np.append(newline, len(data))
        first = np.concatenate([[0], newline[:-1] + 1])
        pairs = len(newline) // 2
        self._array = array
        codes, good = self._codes(first[0 : 2 * pairs : 2], newline[0 : 2 * pairs : 2])
        starts, ends = self._trim(first[1 : 2 * pairs : 2], newline[1 : 2 * pairs : 2])
        zeros = np.flatnonzero((codes == 0) & good)
        eof = zeros[self._names(starts[zeros], ends[zeros]) == b"EOF"]
        length = int(eof[0]) if len(eof) else pairs
        bad = np.flatnonzero(~good[:length])
        if len(bad):
            self._refuse(int(bad[0]), first, newline, is_dxf=bool(len(zeros)) and int(zeros[0]) < int(bad[0]))
        if length == 0:
            raise InputError(f"{name}: this is not a DXF (no tag could be read): give a .dxf sheet")
        self.codes, self.starts, self.ends = codes[:length], starts[:length], ends[:length]
        heads = zeros[zeros < length]
        self.types = self._names(self.starts[heads], self.ends[heads])
        self.heads = np.append(heads, length)
        if not len(eof):
            self._refuse_truncated(len(newline))
        self.entities = self._section(b"ENTITIES")
        self.blocks = self._section(b"BLOCKS")
        if self.entities is None:
            raise InputError(
                f"{name}: the DXF has no ENTITIES section, so it draws nothing: export the sheet again"
            )

    def _codes(
        self, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Group codes of lines, and whether each line is one: blanks, up to four digits, perhaps blanks and CR."""
        start, end = self._trim(start, end)
        width = end - start
        good = (width >= 1) & (width <= 4)
        code = np.zeros(len(start), dtype=np.int32)
        for k in range(4):
            at = np.flatnonzero(good & (width > k))
            digit = self._array[start[at] + k].astype(np.int32) - 48
            good[at] &= (digit >= 0) & (digit <= 9)
            code[at] = code[at] * 10 + digit
        return code, good

    def _trim(
        self, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Line ranges without blanks, tabs and carriage returns at both ends."""
        start, end = start.copy(), end.copy()
        array = self._array
        rows = np.flatnonzero(end > start)
        while len(rows):
            rows = rows[np.isin(array[end[rows] - 1], (13, 32, 9))]
            end[rows] -= 1
            rows = rows[end[rows] > start[rows]]
        rows = np.flatnonzero(end > start)
        while len(rows):
            rows = rows[np.isin(array[start[rows]], (32, 9))]
            start[rows] += 1
            rows = rows[end[rows] > start[rows]]
        return start, end

    def _names(self, start: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """Values as fixed-width byte strings, cut after 64 bytes."""
        width = int(min(max((end - start).max(initial=1), 1), _NAME_BYTES))
        columns = np.arange(width)
        at = np.minimum(start[:, None] + columns, len(self._array) - 1)
        raw = np.where(columns < (end - start)[:, None], self._array[at], 0).astype(np.uint8)
        return np.ascontiguousarray(raw).view(f"S{width}").reshape(-1)

    def _section(self, name: bytes) -> tuple[int, int] | None:
        """Range of heads within a section, its SECTION and ENDSEC left out."""
        for k in np.flatnonzero(self.types == b"SECTION"):
            row = int(self.heads[k]) + 1
            if row < len(self.codes) and self.codes[row] == 2 and self.value(row) == name:
                ends = np.flatnonzero(self.types[k:] == b"ENDSEC")
                return int(k) + 1, int(k) + int(ends[0]) if len(ends) else len(self.types)
        return None

    def _refuse(self, row: int, first: NDArray[np.int64], newline: NDArray[np.int64], is_dxf: bool) -> None:
        found = self.data[first[2 * row] : newline[2 * row]].strip()[:20]
        shown = "".join(c if c.isprintable() else "." for c in found.decode("ascii", errors="replace"))
        if not is_dxf:
            raise InputError(
                f"{self.name}: this is not a DXF (line {2 * row + 1} begins {shown!r}): give a .dxf sheet"
            )
        raise InputError(
            f"{self.name}: damaged at line {2 * row + 1}: a group code was expected, found {shown!r}: export the sheet again"
        )

    def _refuse_truncated(self, lines: int) -> None:
        where = "before any section"
        opened = np.flatnonzero(self.types == b"SECTION")
        closed = np.flatnonzero(self.types == b"ENDSEC")
        if len(opened):
            row = int(self.heads[opened[-1]]) + 1
            section = self.value(row).decode("ascii", errors="replace") if row < len(self.codes) else "?"
            inside = not len(closed) or closed[-1] < opened[-1]
            where = f"inside section {section}" if inside else f"after section {section}"
            if inside and len(self.types) > opened[-1] + 1:
                where += f", entity {self.types[-1].decode('ascii', errors='replace')}"
        raise InputError(
            f"{self.name}: the file is cut short: it ends at line {lines} {where}, without the EOF mark: "
            "fetch the sheet again"
        )

    def value(self, row: int) -> bytes:
        """The value of tag ``row``."""
        return self.data[int(self.starts[row]) : int(self.ends[row])]

    def line(self, row: int) -> int:
        """The line number, from 1, of the value of tag ``row``."""
        return 2 * row + 2

    def first(self, heads: NDArray[np.int64], code: int) -> NDArray[np.int64]:
        """(k,) int64: for each of the given entities the first tag with ``code``, or -1."""
        rows = np.flatnonzero(self.codes == code)
        at = np.searchsorted(rows, self.heads[heads])
        found = np.append(rows, len(self.codes))[at]
        return np.where(found < self.heads[heads + 1], found, -1)

    def names(self, rows: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """Upper-case values of tags as byte strings, b"" for row -1."""
        found = np.maximum(rows, 0)
        start = self.starts[found]
        return np.char.upper(self._names(start, np.where(rows >= 0, self.ends[found], start)))

    def floats(self, rows: NDArray[np.int64], default: float = 0.0) -> NDArray[np.float64]:
        """(k,) float64 values of tags, ``default`` for row -1. Raises InputError naming the line of what is no number."""
        out = np.full(len(rows), default)
        some = np.flatnonzero(rows >= 0)
        if not len(some):
            return out
        start, end = self.starts[rows[some]], self.ends[rows[some]]
        low, high = int(start[0]), int(end[-1])
        if np.all(start[1:] > start[:-1]) and high - low < _BYTES_A_VALUE * len(some):
            # Where values lie close together they are cut out of the bytes in one pass; line ends separate them.
            step = np.zeros(high - low + 2, dtype=np.int8)
            step[start - low] = 1
            step[end + 1 - low] = -1
            wanted = np.cumsum(step[: high - low], dtype=np.int8).view(np.bool_)
            values = _numbers(
                self.data[low:high] if wanted.all() else self._array[low:high][wanted].tobytes()
            )
            if values is not None and len(values) == len(some) and np.isfinite(values).all():
                out[some] = values
                return out
        for k in some:
            text = self.value(int(rows[k]))
            try:
                out[k] = float(text)
            except ValueError:
                out[k] = math.nan
            if not math.isfinite(out[k]):
                shown = text[:20].decode("ascii", errors="replace")
                raise InputError(
                    f"{self.name}: damaged at line {self.line(int(rows[k]))}: a number was expected, found {shown!r}: "
                    "export the sheet again"
                )
        return out

    def integers(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """(k,) int64 values of tags, 0 for row -1."""
        return self.floats(rows).astype(np.int64)


def _numbers(text: bytes) -> NDArray[np.float64] | None:
    """Numbers separated by white space, or None where something is no number."""
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError:
        return None


@dataclass(slots=True)
class _Drawn:
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


@dataclass(slots=True)
class _Line:
    """One drawn line before it is closed or chained: a polyline, line, arc or circle."""

    xy: NDArray[np.float64]
    closed: bool
    layer: bytes
    handle: str


def _draw(
    tags: _Tags, wanted: dict[bytes, str], snap_m: float, sagitta_m: float, max_block_uses: int
) -> _Drawn:
    """Rings on the wanted layers of modelspace."""
    assert tags.entities is not None
    drawn = _Drawn(counts=dict.fromkeys(("z_dropped", "bulges", "chained"), 0))
    heads = _in_modelspace(tags, np.arange(*tags.entities))
    lines = _lines(tags, heads, wanted, sagitta_m, drawn.counts)
    lines += _block_lines(tags, heads, wanted, snap_m, sagitta_m, max_block_uses, drawn.counts)
    _close(lines, wanted, snap_m, drawn, tags.name)
    return drawn


def _in_modelspace(tags: _Tags, heads: NDArray[np.int64]) -> NDArray[np.int64]:
    paper = tags.first(heads, 67)
    return heads[tags.integers(paper) != 1] if (paper >= 0).any() else heads


def _lines(
    tags: _Tags, heads: NDArray[np.int64], wanted: Iterable[bytes], sagitta_m: float, counts: dict[str, int]
) -> list[_Line]:
    """Outline entities among ``heads`` whose layer is wanted, in file order."""
    types = tags.types[heads]
    outline = np.isin(types, _OUTLINE_TYPES)
    other = ~outline & ~np.isin(
        types, (b"VERTEX", b"SEQEND", b"INSERT", b"TEXT", b"MTEXT", b"ATTRIB", b"POINT")
    )
    layer = tags.names(tags.first(heads, 8))
    on_layer = np.isin(layer, list(wanted))
    counts["other_entities"] = counts.get("other_entities", 0) + int((other & on_layer).sum())
    pick = np.flatnonzero(outline & on_layer)
    heads_, types_, layers_ = heads[pick], types[pick], layer[pick]
    handles = [
        tags.value(int(row)).decode("ascii", errors="replace") if row >= 0 else ""
        for row in tags.first(heads_, 5)
    ]
    lines: list[tuple[int, _Line]] = []
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
            lines.append((int(j), _Line(xy, shut, bytes(layers_[j]), handles[j])))
    lines.sort(key=lambda item: item[0])
    return [line for _, line in lines]


def _extrusions(tags: _Tags, heads: NDArray[np.int64]) -> dict[int, tuple[float, float, float]]:
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
    ocs = OCS(extrusion)
    return np.array([ocs.to_wcs((x, y, 0.0)).vec2 for x, y in xy], dtype=np.float64).reshape(-1, 2)


@dataclass(slots=True)
class _Points:
    """Vertices of many polylines: (n, 2) xy, (n,) bulge to the next vertex, (k + 1,) offsets of each polyline."""

    xy: NDArray[np.float64]
    bulge: NDArray[np.float64]
    offsets: NDArray[np.int64]


def _lwpolyline_points(tags: _Tags, heads: NDArray[np.int64], counts: dict[str, int]) -> _Points:
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
    tags: _Tags, heads: NDArray[np.int64], vertices: NDArray[np.int64], counts: dict[str, int]
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


def _owner_of_rows(tags: _Tags, heads: NDArray[np.int64]) -> NDArray[np.int32]:
    """(n,) int32: for every tag the position in ``heads`` of the entity that it belongs to, -1 for others."""
    owner = np.full(len(tags.heads), -1, dtype=np.int32)
    owner[heads] = np.arange(len(heads), dtype=np.int32)
    sizes = np.diff(np.append(tags.heads, len(tags.codes)))
    before = np.full(int(tags.heads[0]), -1, dtype=np.int32)
    return np.concatenate([before, np.repeat(owner, sizes)])


def _xy(tags: _Tags, rows: NDArray[np.int64], step: int = 1) -> NDArray[np.float64]:
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


def _simple(
    tags: _Tags, kind: bytes, heads: NDArray[np.int64], sagitta_m: float
) -> list[NDArray[np.float64]]:
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


def _block_lines(
    tags: _Tags,
    heads: NDArray[np.int64],
    wanted: dict[bytes, str],
    snap_m: float,
    sagitta_m: float,
    max_block_uses: int,
    counts: dict[str, int],
) -> list[_Line]:
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
    out: list[_Line] = []
    taken = 0
    for k in candidates:
        lines = _exploded(tags, int(inserts[k]), bytes(layers[k]), blocks, wanted, sagitta_m, depth=0)
        solid = [line for line in lines if line.layer in wanted]
        area = sum(
            shapely.Polygon(line.xy).area for line in solid if len(line.xy) >= 3 and _is_shut(line, snap_m)
        )
        if area >= MIN_BLOCK_AREA_M2:
            out += solid
            taken += 1
    counts["blocks_as_buildings"], counts["symbols_ignored"] = taken, len(inserts) - taken
    return out


def _block_heads(tags: _Tags) -> dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]]:
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
    tags: _Tags,
    insert: int,
    layer: bytes,
    blocks: dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]],
    wanted: dict[bytes, str],
    sagitta_m: float,
    depth: int,
) -> list[_Line]:
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
    parts = _lines(tags, content, {**wanted, b"0": ""}, sagitta_m / factor, ignored)
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
                    _Line(xy if extrusion is None else _from_ocs(xy, extrusion), part.closed, own, handle)
                )
    return out


def _is_shut(line: _Line, snap_m: float) -> bool:
    return line.closed or bool(np.hypot(*(line.xy[-1] - line.xy[0])) <= snap_m)


def _close(lines: list[_Line], wanted: dict[bytes, str], snap_m: float, drawn: _Drawn, source: str) -> None:
    """Turns lines into rings: closed ones as they are, near-closed ones snapped, the rest chained end to end."""
    loose: dict[str, list[_Line]] = {}
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


def _chain(layer: str, members: list[_Line], snap_m: float, drawn: _Drawn, source: str) -> None:
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
    groups = _components([joined[2 * k : 2 * k + 2] for k in left])
    for group in groups:
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
    parent = list(range(len(ends)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    seen: dict[tuple[float, float], int] = {}
    for i, pair in enumerate(ends):
        for x, y in pair.tolist():
            a, b = root(seen.setdefault((x, y), i)), root(i)
            parent[max(a, b)] = min(a, b)
    groups: dict[int, list[int]] = {}
    for i in range(len(ends)):
        groups.setdefault(root(i), []).append(i)
    return list(groups.values())


def _neatline(tags: _Tags, snap_m: float, sagitta_m: float) -> shapely.Polygon | None:
    """The largest ring on the sheet frame's layer, or None."""
    assert tags.entities is not None
    wanted = {NEATLINE_LAYER.encode(): NEATLINE_LAYER, NEATLINE_LAYER[4:].encode(): NEATLINE_LAYER}
    drawn = _Drawn(counts=dict.fromkeys(("z_dropped", "bulges", "chained"), 0))
    heads = _in_modelspace(tags, np.arange(*tags.entities))
    _close(_lines(tags, heads, wanted, sagitta_m, drawn.counts), wanted, snap_m, drawn, tags.name)
    frames = [polygon for polygon in drawn.polygons() if polygon.is_valid and polygon.area > 0.0]
    return max(frames, key=lambda polygon: polygon.area, default=None)


def _objects(values: Sequence[str]) -> NDArray[np.object_]:
    out = np.empty(len(values), dtype=object)
    out[:] = list(values)
    return out
