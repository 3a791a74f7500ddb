"""A generated town as NGII map sheets in DXF, with everything that makes real sheets awkward, counted in a manifest.

Each sheet holds the town cut at its neatline: building outlines on B0014111 to B0014118, the neatline on H0017334,
roads, walls, fields, contours and spot heights, Korean names, and facility symbols as INSERTs of blocks whose contents
lie on building layers. A small share of the outlines carries one fault each: none of them changes what ground is built
on, except where ``area_m2`` of the manifest says so (an arc's bulge, the loops of a bow-tie read even-odd). The same
town gives the same bytes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from brmgeo.codes import BUILDING_LAYERS, GROUP_BOUNDARY_LAYER, NEATLINE_LAYER
from brmgeo.errors import SettingsError
from brmgeo.extras import extra
from brmgeo.geo.sheets import sheet_polygon
from brmgeo.synth.scene import Building, Town
from brmgeo.synth.terrain import MILLIMETRE, polygons_of

with extra("maps", "drawing DXF sheets"):
    from ezdxf._options import options
    from ezdxf.document import Drawing
    from ezdxf.filemanagement import new

NAME_LAYER = "H0049140"
GAP_M = 0.05
# What is injected per sheet: (kind, how many). All change the drawing, not the buildings, unless said in the manifest.
FAULTS: tuple[tuple[str, int], ...] = (
    ("open_repeated_vertex", 12),
    ("gap_5cm", 8),
    ("duplicate", 6),
    ("bow_tie", 3),
    ("spike", 5),
    ("bulge", 4),
    ("z_values", 15),
    ("line_chain", 6),
    ("zero_area", 4),
)
_ROAD_LAYERS = {
    "arterial": "A0013112",
    "main": "A0013114",
    "street": "A0013115",
    "lane": "A0013116",
    "track": "A0013117",
}
_SYMBOLS = ("PUBLIC", "SCHOOL", "TEMPLE", "WELL", "TOWER")


@dataclass
class _Outline:
    """One ring to be drawn: points without the closing one, layer, and its fault if it has any."""

    points: NDArray[np.float64]
    layer: str
    fault: str = ""


def write_sheets(
    town: Town,
    out_dir: Path,
    numbers: Sequence[str],
    versions: Sequence[str] = ("R12", "R2013"),
    faults: Sequence[tuple[str, int]] = FAULTS,
    only: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Writes ``out_dir``/NUMBER.dxf for each sheet number and returns the manifest.

    Args:
        town: what to draw; only what lies inside a sheet is drawn in it.
        numbers: NGII sheet numbers whose areas meet the town.
        versions: DXF release of each sheet, repeated as needed: "R12" (AC1009 in cp949, POLYLINE) or any later one of ezdxf
            (LWPOLYLINE; "R2013" is AC1027).
        faults: kinds and counts to inject in every sheet.
        only: those of ``numbers`` to write now, each the same as if all were; all by default.

    Returns the manifest, ready for JSON: ``crs`` and for each sheet ``file``, ``version``, ``outlines`` (true footprints in
    it), ``area_m2`` (exact union of its buildings), ``bounds``, ``cut`` (footprints cut by the neatline), ``entities``,
    ``courtyards``, ``group_boundaries``, ``symbols``, ``faults`` (kind to count) and ``handles`` (kind to DXF handles).
    Raises SettingsError where a sheet holds no building.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    before = options.write_fixed_meta_data_for_testing
    # Time stamps and GUIDs are the only things in a DXF that would differ between two runs.
    options.write_fixed_meta_data_for_testing = True
    try:
        sheets = {
            number: _write_sheet(town, out_dir, number, versions[i % len(versions)], faults, i)
            for i, number in enumerate(numbers)
            if only is None or number in only
        }
    finally:
        options.write_fixed_meta_data_for_testing = before
    return {"crs": town.crs, "seed": town.seed, "bounds": list(town.bounds), "sheets": sheets}


def clip_buildings(town: Town, sheet: Polygon) -> list[tuple[Polygon, Building, bool]]:
    """(outline, building, was cut) of all parts of buildings inside ``sheet``, on the millimetre grid."""
    shapes = np.array([b.polygon for b in town.buildings], dtype=object)
    shapely.prepare(sheet)
    whole = shapely.covers(sheet, shapes)
    touched = shapely.intersects(sheet, shapes)
    out: list[tuple[Polygon, Building, bool]] = []
    for i in np.flatnonzero(touched).tolist():
        if whole[i]:
            out.append((shapes[i], town.buildings[i], False))
        else:
            part = shapely.set_precision(shapes[i].intersection(sheet), MILLIMETRE)
            out += [(p, town.buildings[i], True) for p in polygons_of(part, 0.05)]
    return out


def _write_sheet(
    town: Town, out_dir: Path, number: str, version: str, faults: Sequence[tuple[str, int]], index: int
) -> dict[str, Any]:
    sheet = sheet_polygon(number, town.crs)
    clipped = clip_buildings(town, sheet)
    if not clipped:
        raise SettingsError(
            f"sheet {number} holds no building of the generated town: choose sheets that meet {town.bounds}"
        )
    rng = np.random.default_rng([town.seed, 0xD7, index])
    doc = _new_drawing(version)
    drawer = _Drawer(doc, lightweight=version != "R12")
    truths: list[BaseGeometry] = [polygon for polygon, _, _ in clipped]
    outlines, counts, bends = _outlines(clipped, truths, faults, rng)
    handles = _draw_outlines(drawer, outlines, bends, rng)
    for _ in range(dict(faults).get("zero_area", 0)):
        p = outlines[int(rng.integers(len(outlines)))].points[0] + rng.uniform(1, 4, 2)
        flat = np.array([p, p + [1.5, 0.0], p + [3.0, 0.0]])
        _note(handles, "zero_area", drawer.ring(flat, BUILDING_LAYERS[1], True))
        counts["zero_area"] = counts.get("zero_area", 0) + 1

    groups = [p for g in town.groups for p in polygons_of(g.intersection(sheet), 50.0)]
    for part in groups:
        drawer.ring(np.asarray(part.exterior.coords)[:-1, :2], GROUP_BOUNDARY_LAYER, True)
    drawer.ring(np.asarray(sheet.exterior.coords)[:-1], NEATLINE_LAYER, True)
    symbols = _draw_symbols(drawer, [t for t, b, _ in clipped if b.polygon.area > 60], rng)
    _draw_texts(drawer, town, sheet, clipped)
    _draw_rest(drawer, town, sheet, rng)
    path = out_dir / f"{number}.dxf"
    # ezdxf names the classes of the entities in use in the order of a set, which differs from process to process.
    for dxf_type in sorted(doc.entitydb.dxf_types_in_use()):
        doc.classes.add_class(dxf_type)
    doc.saveas(path)
    union = shapely.union_all(truths)
    return {
        "file": path.name,
        "version": doc.dxfversion,
        "outlines": len(clipped),
        "area_m2": float(union.area),
        "bounds": [float(v) for v in sheet.bounds],
        "cut": sum(1 for _, _, cut in clipped if cut),
        "courtyards": sum(len(p.interiors) for p, _, _ in clipped),
        "entities": len(doc.modelspace()),
        "group_boundaries": len(groups),
        "symbols": symbols,
        "faults": counts,
        "handles": handles,
    }


def _new_drawing(version: str) -> Drawing:
    talk = logging.getLogger("ezdxf")
    level = talk.level
    talk.setLevel(logging.ERROR)  # it warns that R12 has no drawing units, whatever units it is given
    try:
        doc = new(version, setup=False, units=0 if version == "R12" else 6)
    finally:
        talk.setLevel(level)
    if version == "R12":
        doc.encoding = "cp949"
        doc.header["$DWGCODEPAGE"] = "ANSI_949"
    return doc


def _outlines(
    clipped: Sequence[tuple[Polygon, Building, bool]],
    truths: list[BaseGeometry],
    faults: Sequence[tuple[str, int]],
    rng: np.random.Generator,
) -> tuple[list[_Outline], dict[str, int], dict[int, float]]:
    """Rings to draw, some spoiled by faults; how many faults of each kind; bulges by the number of their outline.

    ``truths``, the buildings as they will be read, change with the faults that change what ground is built on.
    """
    outlines: list[_Outline] = []
    simple: list[int] = []
    for polygon, building, cut in clipped:
        rings = [polygon.exterior, *polygon.interiors]
        if not cut and len(rings) == 1 and 20 < polygon.area < 300:
            simple.append(len(outlines))
        outlines += [_Outline(np.asarray(r.coords)[:-1, :2].copy(), building.layer) for r in rings]
    order = rng.permutation(simple).tolist()
    counts = {kind: 0 for kind, _ in faults}
    bends: dict[int, float] = {}
    standing = shapely.STRtree(truths)
    for kind, wanted in faults:
        while kind != "zero_area" and counts[kind] < wanted and order:
            k = order.pop()
            changed = _spoil(outlines[k], kind, truths, standing, bends, k)
            counts[kind] += int(changed)
    return outlines, counts, bends


def _note(handles: dict[str, list[str]], kind: str, entity: Any) -> None:
    handles.setdefault(kind, []).append(str(entity.dxf.handle))


def _draw_outlines(
    drawer: _Drawer, outlines: Sequence[_Outline], bends: Mapping[int, float], rng: np.random.Generator
) -> dict[str, list[str]]:
    """Draws every outline as its fault wants it; handles of the faulty entities by kind."""
    handles: dict[str, list[str]] = {}
    for k, o in enumerate(outlines):
        if o.fault == "line_chain":
            for a, b in zip(o.points, np.roll(o.points, -1, axis=0)):
                _note(handles, "line_chain", drawer.line(a, b, o.layer))
            continue
        points, closed = o.points, True
        if o.fault == "open_repeated_vertex":
            points, closed = np.vstack([points, points[:1]]), False
        elif o.fault == "gap_5cm":
            back = points[-1] - points[0]
            points = np.vstack([points, points[0] + back * (GAP_M / math.hypot(*back))])
            closed = False
        elevation = round(float(rng.uniform(40, 120)), 2) if o.fault == "z_values" else 0.0
        entity = drawer.ring(points, o.layer, closed, elevation, bends.get(k))
        if o.fault and o.fault != "duplicate":
            _note(handles, o.fault, entity)
        if o.fault == "duplicate":
            again = drawer.ring(np.roll(o.points, 1, axis=0), o.layer, True)
            _note(handles, "duplicate", again)
    return handles


def _spoil(
    outline: _Outline,
    kind: str,
    truths: list[BaseGeometry],
    standing: shapely.STRtree,
    bends: dict[int, float],
    k: int,
) -> bool:
    """Gives an outline its fault; keeps ``truths`` (aligned by area, matched by place) true. False where it does not fit."""
    points = outline.points
    polygon = Polygon(points)
    if kind in ("bow_tie", "spike", "bulge"):
        i = int(standing.nearest(polygon.representative_point()))
        if not truths[i].equals(polygon):
            return False
        edge = points[1] - points[0]
        length = math.hypot(*edge)
        if length < 3.0:
            return False
        area = np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1))
        outward = np.array([edge[1], -edge[0]]) / length * (1.0 if area > 0 else -1.0)
        if kind == "spike":
            tip = np.round(points[0] + edge * 0.5 + outward * 2.0, 3)
            foot = points[0] + edge * 0.5
            outline.points = np.vstack([points[:1], foot, tip, foot, points[1:]])
        elif kind == "bow_tie":
            # The draughtsman overshot the first wall: the ring crosses itself near its start.
            over = np.round(points[0] + edge / length * 0.5 + outward * 0.3, 3)
            outline.points = np.vstack([points, over])
            truths[i] = shapely.make_valid(Polygon(outline.points))
        else:
            bend = math.tan(math.radians(30) / 4) * (1.0 if area > 0 else -1.0)
            arc = _arc(points[0], points[1], bend)
            bulged = Polygon(np.vstack([points[:1], arc, points[1:]]))
            if any(int(j) != i and truths[int(j)].intersects(bulged) for j in standing.query(bulged)):
                return False
            bends[k] = bend
            truths[i] = bulged
    outline.fault = kind
    return True


def _arc(
    a: NDArray[np.float64], b: NDArray[np.float64], bulge: float, count: int = 200
) -> NDArray[np.float64]:
    """Points between ``a`` and ``b`` on the arc of a DXF bulge (tangent of a quarter of its angle)."""
    chord = b - a
    angle = 4 * math.atan(bulge)
    radius = math.hypot(*chord) / (2 * math.sin(angle / 2))
    normal = np.array([-chord[1], chord[0]]) / math.hypot(*chord)
    centre = (a + b) / 2 + normal * radius * math.cos(angle / 2)
    start = math.atan2(a[1] - centre[1], a[0] - centre[0])
    t = start + angle * np.arange(1, count) / count
    return centre + abs(radius) * np.column_stack([np.cos(t), np.sin(t)])


class _Drawer:
    """Puts entities into a drawing, as POLYLINE (R12) or LWPOLYLINE."""

    def __init__(self, doc: Drawing, lightweight: bool) -> None:
        self.doc, self._space, self._light = doc, doc.modelspace(), lightweight
        self._layers: set[str] = set()

    def layer(self, name: str) -> str:
        if name not in self._layers:
            self._layers.add(name)
            self.doc.layers.add(name, color=len(self._layers) % 250 + 1)
        return name

    def ring(
        self,
        points: NDArray[np.float64],
        layer: str,
        closed: bool,
        elevation: float = 0.0,
        bulge: float | None = None,
    ) -> Any:
        """A polyline; ``bulge`` bends its first edge, a nonzero ``elevation`` lifts it."""
        rounded = np.round(points, 3).tolist()
        attribs = {"layer": self.layer(layer)}
        if self._light:
            if elevation:
                attribs["elevation"] = elevation  # type: ignore[assignment]
            rows = [(x, y, (bulge or 0.0) if i == 0 else 0.0) for i, (x, y) in enumerate(rounded)]
            return self._space.add_lwpolyline(rows, format="xyb", close=closed, dxfattribs=attribs)
        if elevation:  # in R12 a 3D polyline, each corner at its own height
            corners = [(x, y, elevation + 0.1 * i) for i, (x, y) in enumerate(rounded)]
            return self._space.add_polyline3d(corners, close=closed, dxfattribs=attribs)
        if bulge is None:
            return self._space.add_polyline2d(rounded, close=closed, dxfattribs=attribs)
        rows = [(x, y, bulge if i == 0 else 0.0) for i, (x, y) in enumerate(rounded)]
        return self._space.add_polyline2d(rows, format="xyb", close=closed, dxfattribs=attribs)

    def line(self, a: NDArray[np.float64], b: NDArray[np.float64], layer: str) -> Any:
        start, end = np.round(a, 3).tolist(), np.round(b, 3).tolist()
        return self._space.add_line(start, end, dxfattribs={"layer": self.layer(layer)})

    def text(self, x: float, y: float, text: str, layer: str, height: float = 6.0) -> None:
        attribs = {"layer": self.layer(layer), "height": height, "insert": (round(x, 3), round(y, 3))}
        self._space.add_text(text, dxfattribs=attribs)

    def point(self, x: float, y: float, z: float, layer: str) -> None:
        self._space.add_point(
            (round(x, 3), round(y, 3), round(z, 2)), dxfattribs={"layer": self.layer(layer)}
        )

    def block(self, name: str, layer: str, draw: Callable[[Any, str], None]) -> None:
        draw(self.doc.blocks.new(name), self.layer(layer))

    def insert(self, name: str, x: float, y: float, layer: str) -> None:
        self._space.add_blockref(name, (round(x, 3), round(y, 3)), dxfattribs={"layer": self.layer(layer)})


def _draw_symbols(drawer: _Drawer, places: Sequence[Polygon], rng: np.random.Generator) -> int:
    """Facility symbols: blocks drawn with closed squares on building layers, which must never count as buildings."""
    for i, name in enumerate(_SYMBOLS):
        size = 3.0 + 0.7 * i

        def draw(block: Any, layer: str, size: float = size) -> None:
            corners = [(-size, -size), (size, -size), (size, size), (-size, size)]
            block.add_polyline2d(corners, close=True, dxfattribs={"layer": layer})
            block.add_line((-size, 0), (size, 0), dxfattribs={"layer": layer})

        drawer.block(name, BUILDING_LAYERS[i % len(BUILDING_LAYERS)], draw)
    chosen = rng.permutation(len(places))[:60].tolist()
    for i, k in enumerate(chosen):
        c = places[k].centroid
        drawer.insert(_SYMBOLS[i % len(_SYMBOLS)], c.x, c.y, f"B00142{20 + i % 9:02d}")
    return len(chosen)


def _draw_texts(
    drawer: _Drawer, town: Town, sheet: Polygon, clipped: Sequence[tuple[Polygon, Building, bool]]
) -> None:
    for x, y, name in town.names:
        if sheet.contains(shapely.Point(x, y)):
            drawer.text(x, y, name, NAME_LAYER)
    words = ("창고", "상가", "교회", "식당", "공장", "빌라", "축사", "정미소", "약국", "마트")
    large = [p for p, b, _ in clipped if p.area > 180]
    for i, polygon in enumerate(large):
        c = polygon.centroid
        drawer.text(c.x, c.y, words[i % len(words)], NAME_LAYER, 4.0)


def _draw_rest(drawer: _Drawer, town: Town, sheet: Polygon, rng: np.random.Generator) -> None:
    """All that is not a building and makes up most of a real sheet: contours, roads, walls, fields, water, spot heights."""

    def draw(geometry: BaseGeometry, layer: str, z: float = 0.0) -> None:
        for part in shapely.get_parts(shapely.intersection(geometry, sheet)):
            if part.geom_type == "LineString" and part.length > 0.5:
                drawer.ring(np.asarray(part.coords)[:, :2], layer, False, z)

    for road in town.roads:
        draw(road.line, "A0020000")
        edge = road.line.buffer(road.width_m / 2, cap_style="flat")
        for polygon in polygons_of(edge):
            draw(polygon.exterior, _ROAD_LAYERS[road.kind])
    for i, wall in enumerate(town.walls):
        draw(wall, f"B002412{1 + i % 7}")
    for i, area in enumerate(town.fields):
        draw(area.polygon.exterior, f"D00{10 + i % 9}000")
    for polygon in (*town.water, *town.banks):
        draw(polygon.exterior, "E0011111")
    for polygon in town.woods:
        draw(polygon.exterior, "D0023000")
    for line, z in town.contours:
        draw(LineString(line), "F0017111" if round(z) % 25 else "F0017114", z)
    left, bottom, right, top = town.bounds
    xy = np.column_stack([rng.uniform(left, right, 3600), rng.uniform(bottom, top, 3600)])
    for k, (x, y) in enumerate(xy[shapely.contains_xy(sheet, xy[:, 0], xy[:, 1])].tolist()):
        z = float(rng.uniform(40, 140))
        drawer.point(x, y, z, "F0027217")
        if k % 4 == 0:
            drawer.text(x + 1.5, y, f"{z:.1f}", "F0027217", 2.5)
    for x, y, radius in town.trees[:: max(1, len(town.trees) // 2500)].tolist():
        if sheet.contains(shapely.Point(x, y)):
            drawer.line(
                np.array([x - radius, y]), np.array([x + radius, y]), f"C03{int(radius * 10) % 24:02d}000"
            )
