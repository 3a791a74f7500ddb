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
(symbols repeat, buildings do not) and encloses at least ``entities.MIN_BLOCK_AREA_M2``, is a building drawn as a block. Its
entities keep their own layer; those on layer "0" take the INSERT's, as DXF says. Both kinds are counted.

Texts are never decoded, so a wrong or missing code page cannot fail a sheet.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.codes import BUILDING_KINDS, BUILDING_LAYERS, GROUP_BOUNDARY_LAYER, NEATLINE_LAYER, layer_code
from brmgeo.errors import InputError, SettingsError, listed
from brmgeo.extras import extra
from brmgeo.ingest.dxf.chains import DrawnRings, close
from brmgeo.ingest.dxf.entities import (
    MIN_BLOCK_AREA_M2,
    block_lines,
    blocks_left_out,
    in_modelspace,
    kinds_left_out,
    layers_drawn_on,
    lines_on,
)
from brmgeo.ingest.dxf.tags import Tags, text_of
from brmgeo.ingest.repair import DROPPED_KINDS, ClosedOutlines, Repair, repair_counts, repair_rings

with extra("maps", "reading DXF sheets"):
    import geopandas as gpd

SNAP_M = 0.10
SAGITTA_M = 0.01
MAX_DROPPED_SHARE = 0.05
MAX_BLOCK_USES = 2
# Of $INSUNITS, as the DXF reference numbers them.
_UNITS = {
    "1": ("inches", 0.0254), "2": ("feet", 0.3048), "3": ("miles", 1609.344), "4": ("millimetres", 0.001),
    "5": ("centimetres", 0.01), "6": ("metres", 1.0), "7": ("kilometres", 1000.0), "10": ("yards", 0.9144),
    "14": ("decimetres", 0.1), "15": ("decametres", 10.0), "16": ("hectometres", 100.0),
    "21": ("US survey feet", 1200.0 / 3937.0),
}  # fmt: skip


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
        drawn_in: the unit that $INSUNITS names, in words, and its metres; None where it names none.
        notes: what of the wanted layers was not read, a line each.
    """

    footprints: gpd.GeoDataFrame
    neatline: shapely.Polygon | None
    repairs: list[Repair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    dropped_share: float = 0.0
    drawn_in: tuple[str, float] | None = None
    notes: list[str] = field(default_factory=list)


def read_dxf(
    path: str | Path,
    layers: Sequence[str] = BUILDING_LAYERS,
    *,
    snap_m: float = SNAP_M,
    sagitta_m: float = SAGITTA_M,
    max_dropped_share: float = MAX_DROPPED_SHARE,
    max_block_uses: int = MAX_BLOCK_USES,
    unit_m: float = 1.0,
) -> SheetFootprints:
    """The building outlines of one DXF sheet; see the module for what counts as one.

    Args:
        path: the .dxf file, text or binary, R12 to R2018.
        layers: layer names, case ignored; "B0014112" and the older "4112" stand for each other.
        snap_m: ends of an outline at most this far apart are joined, metres.
        sagitta_m: chords that replace an arc stay within this of it, metres.
        max_dropped_share: share of outlines that may be dropped before the sheet is refused, in [0, 1].
        max_block_uses: blocks used more often than this are symbols; 0 takes no block for a building.
        unit_m: metres of the unit that it is drawn in; what $INSUNITS says is told (``drawn_in``), not believed, because
            templates set it and surveyors draw in metres all the same.

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
    tags = Tags(text_of(path), path.name)
    drawn = _draw(tags, wanted, snap_m / unit_m, sagitta_m / unit_m, max_block_uses, unit_m)
    drawn.repairs = [replace(r, x=unit_m * r.x, y=unit_m * r.y) for r in drawn.repairs]

    rings = ClosedOutlines(
        _in_metres(drawn.polygons(), unit_m), _objects(drawn.layers), _objects(drawn.handles)
    )
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
    neatline = _neatline(tags, snap_m / unit_m, sagitta_m / unit_m)
    if neatline is not None:
        neatline = _in_metres(np.array([neatline], dtype=object), unit_m)[0]
    notes = _left_out(tags, wanted, counts)
    return SheetFootprints(frame, neatline, repairs, counts, share, _unit(tags), notes)


def _left_out(tags: Tags, wanted: dict[bytes, str], counts: dict[str, int]) -> list[str]:
    """What a user should know of what was not read."""
    assert tags.entities is not None
    heads = in_modelspace(tags, np.arange(*tags.entities))
    names = listed(list(dict.fromkeys(wanted.values())))
    notes = []
    if counts["other_entities"]:
        kinds = kinds_left_out(tags, heads, wanted)
        notes.append(f"on {names} left out, as they are no outlines: {_numbered(kinds, '')}")
    if counts["outlines"]:
        return notes  # blocks of other layers are symbols then
    blocks = blocks_left_out(tags, heads, wanted)
    if blocks:
        notes.append(
            f"no outline is on {names} but in blocks that are put on other layers, {_numbered(blocks, 'in ')}: "
            "explode the blocks"
        )
    else:
        layers = layers_drawn_on(tags, heads)
        there = f"lines are on {listed(sorted(layers), 12)}" if layers else "there are no lines at all"
        notes.append(f"no outline is on {names}; {there}")
    return notes


def _numbered(found: Counter[str], between: str) -> str:
    return listed([f"{n} {between}{what}" for what, n in sorted(found.items())], 12)


def _in_metres(polygons: NDArray[np.object_], unit_m: float) -> NDArray[np.object_]:
    return polygons if unit_m == 1.0 else np.asarray(shapely.transform(polygons, lambda xy: unit_m * xy))


def _unit(tags: Tags) -> tuple[str, float] | None:
    """The unit of the header's $INSUNITS in words, and its metres."""
    rows = np.flatnonzero(tags.codes[: int(tags.heads[min(2, len(tags.heads) - 1)])] == 9)
    for row in rows.tolist():
        if tags.value(row) == b"$INSUNITS":
            return _UNITS.get(tags.value(row + 1).decode("ascii", errors="replace"))
    return None


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


def _draw(
    tags: Tags, wanted: dict[bytes, str], snap: float, sagitta: float, max_block_uses: int, unit_m: float
) -> DrawnRings:
    """Closed outlines on the wanted layers of modelspace, in drawing units as ``snap`` and ``sagitta`` are."""
    assert tags.entities is not None
    drawn = DrawnRings(counts=dict.fromkeys(("z_dropped", "bulges", "chained"), 0))
    heads = in_modelspace(tags, np.arange(*tags.entities))
    lines = lines_on(tags, heads, wanted, sagitta, drawn.counts)
    least = MIN_BLOCK_AREA_M2 / unit_m**2
    lines += block_lines(tags, heads, wanted, snap, sagitta, max_block_uses, least, drawn.counts)
    close(lines, wanted, snap, drawn, tags.name)
    return drawn


def _neatline(tags: Tags, snap_m: float, sagitta_m: float) -> shapely.Polygon | None:
    """The largest ring on the sheet frame's layer, or None."""
    assert tags.entities is not None
    wanted = {NEATLINE_LAYER.encode(): NEATLINE_LAYER, NEATLINE_LAYER[4:].encode(): NEATLINE_LAYER}
    drawn = DrawnRings(counts=dict.fromkeys(("z_dropped", "bulges", "chained"), 0))
    heads = in_modelspace(tags, np.arange(*tags.entities))
    close(lines_on(tags, heads, wanted, sagitta_m, drawn.counts), wanted, snap_m, drawn, tags.name)
    frames = [polygon for polygon in drawn.polygons() if polygon.is_valid and polygon.area > 0.0]
    return max(frames, key=lambda polygon: polygon.area, default=None)


def _objects(values: Sequence[str]) -> NDArray[np.object_]:
    out = np.empty(len(values), dtype=object)
    out[:] = list(values)
    return out
