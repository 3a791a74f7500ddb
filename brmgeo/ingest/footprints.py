"""Building footprints from any file: read, put into the region's CRS, held against the sheet number, merged at sheet edges.

``read_footprints`` takes one file (DXF sheet, NGII shapefile, GeoPackage, GeoJSON, GeoParquet, whatever GDAL reads);
``combine`` puts several together: what two sheets both hold is kept once, and buildings that a sheet edge cut in
two are one again.
"""

from __future__ import annotations

import math
import re
import shutil
import struct
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.codes import BUILDING_KINDS, BUILDING_LAYERS, KIND_OF_NAME
from brmgeo.errors import CrsError, InputError, MissingInputError, one_line
from brmgeo.extras import extra
from brmgeo.files import scratch_folder
from brmgeo.geo.crs import LONLAT, crs_name, require_projected_metres, same_crs, transformer
from brmgeo.geo.formats import vector_file
from brmgeo.geo.grid import Bounds, as_bounds
from brmgeo.geo.sheets import check_extent, sheet_at, sheet_number_in, sheet_polygon
from brmgeo.ingest.dxf import MAX_DROPPED_SHARE, SNAP_M, SheetFootprints, read_dxf
from brmgeo.ingest.groups import grouped
from brmgeo.ingest.repair import (
    DROPPED_KINDS,
    ClosedOutlines,
    Repair,
    repair_counts,
    repair_rings,
    shape_keys,
)
from brmgeo.memory import require_memory

with extra("maps", "reading footprints"):
    import geopandas as gpd
    import pandas as pd
    import pyogrio

COLUMNS = ("geometry", "layer", "kind", "floors", "handle", "source", "sheet")
SHEET_COLUMNS = ("geometry", "sheet", "source", "outline", "footprints", "area_m2", "dropped_share")
# Two sheets cut at one neatline round their cuts to millimetres or centimetres, each on its own.
EDGE_TOLERANCE_M = 0.05
# Neatlines agree with the sheet number to less than a millimetre; a wrong datum moves them by some 300 m.
NEATLINE_TOLERANCE_M = 5.0

# What reading takes, measured: a row with its attributes and repairs, and its geometry as WKB and as an object.
_BYTES_A_ROW = 1400
_TIMES_UNPACKED = 4

_KIND_COLUMNS = ("kind", "종류")
_FLOOR_COLUMNS = ("floors", "층수", "building:levels")
# What GDAL, QuickOSM, osmtogeojson and Geofabrik call the identity of an OpenStreetMap object, and where its other keys are.
_OSM_IDENTITY = {"osm_id", "osm_way_id", "osm_type", "full_id", "@id"}
_OSM_KEYS = {"other_tags", "fclass", "landuse", "leisure", "amenity"}
# Kinds of repairs that may have lost nothing, and what they left out then.
_LEFT_OUT = {
    "zero_area": "upright faces (walls)", "open": "open lines", "unreadable": "features without geometry",
}  # fmt: skip
# Of a frame's attrs: the rows whose geometry is there, but damaged.
_DAMAGED = "damaged"
_BUILDING_TAG = r"""["']building["']\s*(?:=>|:)\s*["']([^"']*)["']"""


@dataclass(slots=True)
class Footprints:
    """Buildings in one CRS, where they are known, and what had to be repaired.

    Attributes:
        frame: GeoDataFrame in the region's CRS with COLUMNS: ``geometry`` valid polygons; ``layer`` (DXF layer or the
            file's layer name); ``kind`` (see codes.BUILDING_KINDS; "" when unknown); ``floors`` Int32, missing when
            unknown; ``handle`` (DXF handle or feature number from 1); ``source`` file name; ``sheet`` number or "".
        sheets: GeoDataFrame with SHEET_COLUMNS, one row a file: where the file says what is built, and by what ``outline``
            that is known: "neatline", "number" (the sheet number's cell) or "extent" (only the data's bounds).
        repairs: every repair, x and y in the region's CRS.
        counts: facts by name, summed over files, with ``repair_KIND`` for each kind of repair.
        notes: what a user should know of how the file was read, a line each.
    """

    frame: gpd.GeoDataFrame
    sheets: gpd.GeoDataFrame
    repairs: list[Repair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_footprints(
    path: str | Path,
    crs: str | None = None,
    *,
    source_crs: str | None = None,
    layer: str | None = None,
    encoding: str | None = None,
    layers: Sequence[str] = BUILDING_LAYERS,
    sheet: str | None = None,
    snap_m: float = SNAP_M,
    max_dropped_share: float = MAX_DROPPED_SHARE,
) -> Footprints:
    """Footprints of one file in ``crs``.

    Args:
        path: .dxf, .shp, .gpkg, .geojson, .parquet or another vector file.
        crs: the region's projected CRS; None takes the file's own.
        source_crs: the file's CRS where it does not say (a DXF never does: ``crs`` is taken), or to overrule what it says.
        layer: layer of a file with several; None needs a file with one polygon layer.
        encoding: of a shapefile's attributes; None takes its .cpg, else EUC-KR, as NGII's are.
        layers: DXF layers that are buildings.
        sheet: the sheet number; None looks for one in the names of the file and its folder.
        snap_m, max_dropped_share: see ``dxf.read_dxf``.

    Kinds are in a column kind or 종류, floors in floors or 층수, where there are such.

    Vertices are transformed one by one, none added or moved. Raises MissingInputError, InputError, and CrsError for
    coordinates that do not lie where the sheet number puts them, with the distance that it would cost (see
    ``geo.sheets.check_extent``).
    """
    path = Path(path)
    if not path.exists():
        raise MissingInputError(f"{path}: no such file: check the path of the footprints")
    if path.suffix.lower() in {".dxf", ".dwg"}:
        return _from_dxf(path, crs or source_crs, source_crs, layers, sheet, snap_m, max_dropped_share)
    return _from_vector(
        path,
        crs,
        source_crs,
        layer=layer,
        encoding=encoding,
        sheet=sheet,
        snap_m=snap_m,
        max_dropped_share=max_dropped_share,
    )


def combine(parts: Sequence[Footprints], tolerance_m: float = EDGE_TOLERANCE_M) -> Footprints:
    """All footprints of several files as one: what is held twice kept once, buildings cut at sheet edges merged.

    The counts gain ``duplicates_across_sheets`` and ``merged_at_edges`` (cut pieces less merged buildings). Raises
    CrsError when the parts are in different CRSs, InputError when there are none.
    """
    if not parts:
        raise InputError("no footprints were given: name at least one file")
    crs = parts[0].frame.crs.to_wkt()
    for part in parts[1:]:
        if not same_crs(crs, part.frame.crs.to_wkt()):
            found = crs_name(part.frame.crs.to_wkt())
            raise CrsError(f"footprints are in {crs_name(crs)} and in {found}: read all into one crs")
    frame = _joined([part.frame for part in parts])
    sheets = _joined([part.sheets for part in parts])
    counts: Counter[str] = Counter()
    for part in parts:
        counts.update(part.counts)
    repairs = [repair for part in parts for repair in part.repairs]
    first, twice = _across_sheets(frame)
    repairs += twice
    frame, merged = merge_at_edges(frame[first].reset_index(drop=True), list(sheets.geometry), tolerance_m)
    totals = dict(counts) | {f"repair_{kind}": n for kind, n in repair_counts(repairs).items()}
    totals |= {"footprints": len(frame), "duplicates_across_sheets": len(twice), "merged_at_edges": merged}
    notes = [note for part in parts for note in part.notes]
    return Footprints(frame, sheets, repairs, totals, notes)


def merge_at_edges(
    frame: gpd.GeoDataFrame, sheets: Sequence[shapely.Geometry], tolerance_m: float = EDGE_TOLERANCE_M
) -> tuple[gpd.GeoDataFrame, int]:
    """Footprints with those cut at a sheet edge made one, and by how many rows that shortened the frame.

    Pieces belong together when they come from different sources, are of one kind, and run along each other, within
    ``tolerance_m``, at a sheet edge for at least half a metre or half of the shorter cut. The first piece's attributes
    stay. The area is the pieces' own, to within the tolerance times the length of the cut.

    Args:
        frame: with COLUMNS, in metres.
        sheets: outlines of the sheets (neatlines or cells), same CRS.
        tolerance_m: how far the two halves of one cut may miss each other, metres.
    """
    if len(frame) < 2 or not len(sheets):
        return frame, 0
    polygons = np.asarray(frame.geometry.values, dtype=object)
    edges = shapely.get_parts(shapely.boundary(np.asarray(sheets, dtype=object)))
    # Segments, not whole outlines: their boxes are thin, so that the tree finds only what lies at the edge.
    segments = np.concatenate([_segments(edge) for edge in edges])
    hits = shapely.STRtree(segments).query(polygons, predicate="dwithin", distance=tolerance_m)[0]
    near = np.unique(hits)
    if len(near) < 2:
        return frame, 0
    strip = shapely.union_all(
        shapely.buffer(
            segments[
                np.unique(
                    shapely.STRtree(polygons[near]).query(
                        segments, predicate="dwithin", distance=tolerance_m
                    )[0]
                )
            ],
            2.0 * tolerance_m,
        )
    )
    a, b = shapely.STRtree(polygons[near]).query(polygons[near], predicate="dwithin", distance=tolerance_m)
    a, b = near[a[a < b]], near[b[a < b]]
    source, kind = frame["source"].to_numpy(dtype=object), frame["kind"].to_numpy(dtype=object)
    pair = (source[a] != source[b]) & (kind[a] == kind[b])
    a, b = a[pair], b[pair]
    along = np.zeros(len(a), dtype=np.bool_)
    for k, (i, j) in enumerate(zip(a.tolist(), b.tolist())):
        cut_i = shapely.intersection(polygons[i].boundary, strip).length
        cut_j = shapely.intersection(polygons[j].boundary, strip).length
        reach = polygons[j].buffer(tolerance_m, cap_style="flat")
        contact = shapely.intersection(shapely.intersection(polygons[i].boundary, strip), reach).length
        along[k] = contact >= min(0.5, 0.5 * min(cut_i, cut_j)) and contact > 4.0 * tolerance_m
    roots = grouped(len(frame), a[along], b[along])
    out = polygons.copy()
    keep = np.ones(len(frame), dtype=np.bool_)
    for head in np.flatnonzero(np.bincount(roots, minlength=len(frame)) > 1).tolist():
        members = np.flatnonzero(roots == head)
        whole = _sewn(polygons[members], tolerance_m)
        if whole is not None:
            out[head] = whole
            keep[members[1:]] = False
    frame = frame.set_geometry(gpd.GeoSeries(list(out), index=frame.index, crs=frame.crs))
    return frame[keep].reset_index(drop=True), int((~keep).sum())


def _segments(line: shapely.Geometry) -> NDArray[np.object_]:
    xy = shapely.get_coordinates(line)
    return np.asarray(shapely.linestrings(np.stack([xy[:-1], xy[1:]], axis=1)), dtype=object)


def _sewn(pieces: NDArray[np.object_], tolerance_m: float) -> shapely.Polygon | None:
    """One polygon from pieces that meet within the tolerance, or None where they do not make one."""
    whole = pieces[0]
    for piece in pieces[1:]:
        whole = shapely.union(whole, shapely.snap(piece, whole, tolerance_m))
    if whole.geom_type != "Polygon" or not whole.is_valid:
        # Cuts whose ends miss each other along the edge: close the crack by growing and shrinking.
        grown = shapely.buffer(shapely.union_all(pieces), tolerance_m, join_style="mitre")
        whole = shapely.buffer(grown, -tolerance_m, join_style="mitre")
    length = float(shapely.length(pieces).sum())
    right = abs(whole.area - float(shapely.area(pieces).sum())) <= tolerance_m * length
    return whole if whole.geom_type == "Polygon" and whole.is_valid and right else None


def _across_sheets(frame: gpd.GeoDataFrame) -> tuple[NDArray[np.bool_], list[Repair]]:
    """Rows to keep, and a repair for each footprint that an earlier file holds already (to the centimetre)."""
    keep = np.ones(len(frame), dtype=np.bool_)
    repairs = []
    seen: dict[bytes, int] = {}
    polygons = np.asarray(frame.geometry.values, dtype=object)
    for j, key in enumerate(shape_keys(polygons, decimals=2)):
        i = seen.setdefault(key, j)
        if i != j and frame["source"].iat[i] != frame["source"].iat[j]:
            keep[j] = False
            x, y = shapely.get_coordinates(polygons[j])[0].tolist()
            row = frame.iloc[j]
            detail = f"also in {frame['source'].iat[i]}; removed"
            repairs.append(Repair("duplicate", row["handle"], row["layer"], x, y, detail, row["source"]))
    return keep, repairs


def _joined(frames: Sequence[gpd.GeoDataFrame]) -> gpd.GeoDataFrame:
    filled = [frame for frame in frames if len(frame)]
    if not filled:
        return frames[0]
    joined = pd.concat(filled, ignore_index=True) if len(filled) > 1 else filled[0]
    return gpd.GeoDataFrame(joined, geometry="geometry", crs=frames[0].crs)


def _from_dxf(
    path: Path,
    crs: str | None,
    source_crs: str | None,
    layers: Sequence[str],
    sheet: str | None,
    snap_m: float,
    max_dropped_share: float,
) -> Footprints:
    if crs is None:
        raise CrsError(f"{path.name}: a DXF does not say its CRS: give it, such as EPSG:5187", needs="crs")
    require_projected_metres(crs)
    native = source_crs or crs
    require_projected_metres(native)
    number = sheet or sheet_number_in(path.name) or ""
    read = read_dxf(path, layers, snap_m=snap_m, max_dropped_share=max_dropped_share)
    notes = []
    try:
        _check_place(read, path.name, native, number)
    except CrsError as as_metres:
        if read.drawn_in is None or read.drawn_in[1] == 1.0:
            raise
        unit, unit_m = read.drawn_in
        read = read_dxf(path, layers, snap_m=snap_m, max_dropped_share=max_dropped_share, unit_m=unit_m)
        try:
            _check_place(read, path.name, native, number)
        except CrsError:
            raise CrsError(f"{as_metres} (nor do they fit in {unit}, which $INSUNITS says)") from None
        notes.append(f"drawn in {unit} ($INSUNITS), read as metres")
    polygons = np.asarray(read.footprints.geometry.values, dtype=object)
    neatline = (
        None if read.neatline is None else _moved(np.array([read.neatline], dtype=object), native, crs)[0]
    )
    rows = {
        "layer": read.footprints["layer"].to_numpy(dtype=object),
        "kind": read.footprints["kind"].to_numpy(dtype=object),
        "handle": read.footprints["handle"].to_numpy(dtype=object),
    }
    polygons = _moved(polygons, native, crs)
    repairs = _repairs_moved(read.repairs, native, crs)
    return _assembled(
        path.name,
        number,
        crs,
        polygons,
        rows,
        floors=None,
        neatline=neatline,
        repairs=repairs,
        counts=read.counts,
        dropped_share=read.dropped_share,
        notes=notes + read.notes,
    )


def _check_place(read: SheetFootprints, name: str, crs: str, number: str) -> None:
    """CrsError where a sheet does not lie where its number and the CRS say."""
    numbers = [number] if number else []
    if read.neatline is not None:
        check_extent(
            read.neatline.bounds, crs, numbers, f"{name} (neatline)", NEATLINE_TOLERANCE_M, neatline=True
        )
    if len(read.footprints):
        check_extent(as_bounds(read.footprints.total_bounds), crs, numbers, name)


def _from_vector(
    path: Path,
    crs: str | None,
    source_crs: str | None,
    *,
    layer: str | None,
    encoding: str | None,
    sheet: str | None,
    snap_m: float,
    max_dropped_share: float,
) -> Footprints:
    frame = _vector_frame(path, layer, encoding)
    native = source_crs or (frame.crs.to_wkt() if frame.crs is not None else None)
    if native is None:
        beside = f" (no {path.stem}.prj beside it)" if path.suffix.lower() == ".shp" else ""
        raise CrsError(
            f"{path.name}: the file does not say its CRS{beside}: give it, such as EPSG:5187 (in a region file: "
            'crs = "EPSG:5187" under [footprints])',
            needs="source_crs",
        )
    target = crs or crs_name(native)
    require_projected_metres(target)
    try:
        transformer(native, target)
    except CrsError as error:
        raise CrsError(f"{path.name}: {error}", needs="source_crs") from error
    frame, notes = _buildings_of(frame, path.name)
    geometry = np.asarray(frame.geometry.values, dtype=object)
    polygons, row, open_rows, other = _polygons_of(geometry, snap_m)
    polygons = _moved(polygons, native, target)
    name = layer or path.stem
    number = frame.index.to_numpy() + 1
    handles = number[row].astype(str).astype(object)
    repaired = repair_rings(
        ClosedOutlines(polygons, np.full(len(row), name, dtype=object), handles), path.name, courtyards=False
    )
    repairs = list(repaired.repairs)
    for i in open_rows:
        xy = shapely.get_coordinates([geometry[i]])  # a list, for of None alone there is no array
        kind, detail = (
            ("open", "a line whose ends do not meet; dropped")
            if len(xy)
            else ("unreadable", "empty; dropped")
        )
        x, y = transformer(native, target).transform(*xy[0]) if len(xy) else (math.nan, math.nan)
        repairs.append(Repair(kind, str(number[i]), name, float(x), float(y), detail, path.name))
    flat = _without_area(repairs, frame, row, set(handles[repaired.origin]))
    left_out = +(Counter(_LEFT_OUT[repair.kind] for repair in flat) + Counter({"points": other}))
    if left_out:
        told = ", ".join(f"{n} {what}" for what, n in left_out.items())
        notes.append(f"left out, as they have no area from above: {told}")
    outlines = len(polygons) + len(open_rows) - len(flat)
    dropped = sum(repair.kind in DROPPED_KINDS for repair in repairs) - len(flat)
    share = dropped / outlines if outlines else 0.0
    if share > max_dropped_share:
        raise InputError(
            f"{path.name}: {dropped} of {outlines} outlines ({share:.0%}) are not usable, {max_dropped_share:.0%} allowed: "
            "mend the file or raise max_dropped_share"
        )
    of_sheet = sheet or _number_of(path)
    if len(repaired.polygons):
        left, bottom, right, top = map(float, shapely.total_bounds(repaired.polygons))
        check_extent((left, bottom, right, top), target, [of_sheet] if of_sheet else [], path.name)
        if not of_sheet and path.name.upper().startswith("N3A_"):
            of_sheet = _cell_around((left, bottom, right, top), target)
    from_row = row[repaired.origin]
    kinds = _kinds(frame)[from_row]
    floors = _floors(frame).iloc[from_row].array
    columns = {
        "layer": np.full(len(from_row), name, dtype=object),
        "kind": kinds,
        "handle": handles[repaired.origin],
    }
    counts = {"outlines": outlines, "footprints": len(from_row), "other_entities": other}
    counts |= {f"repair_{kind}": n for kind, n in repair_counts(repairs).items()}
    return _assembled(
        path.name,
        of_sheet,
        target,
        repaired.polygons,
        columns,
        floors=floors,
        neatline=None,
        repairs=repairs,
        counts=counts,
        dropped_share=share,
        notes=notes,
    )


def _vector_frame(path: Path, layer: str | None, encoding: str | None) -> gpd.GeoDataFrame:
    """The file's features with attributes; raises InputError in one line for what cannot be read."""
    suffix = path.suffix.lower()
    try:
        with warnings.catch_warnings():
            # GDAL warns of what is no harm here (missing .dbf, ring order); damage is checked below.
            warnings.simplefilter("ignore")
            if suffix in {".parquet", ".geoparquet"}:
                _require_room(path)
                return gpd.read_parquet(vector_file(path))
            if suffix == ".shp":
                _check_shapefile(path)
                if encoding is None and not path.with_suffix(".cpg").exists():
                    encoding = "EUC-KR"
            with _with_index(path) as whole:
                layer = layer or _only_layer(whole)
                frame = pyogrio.read_dataframe(
                    vector_file(whole), layer=layer, encoding=encoding, on_invalid="ignore"
                )
                if isinstance(frame, gpd.GeoDataFrame) and frame.geometry.isna().any():
                    missing = np.flatnonzero(frame.geometry.isna())
                    stored = pyogrio.raw.read(vector_file(whole), layer=layer, columns=[])[2]
                    frame.attrs[_DAMAGED] = [int(i) for i in missing if stored[i] is not None]
                counted = pyogrio.read_info(vector_file(whole))["features"] if suffix == ".fgb" else 0
                if len(frame) < counted:
                    raise InputError(
                        f"{path.name}: cut short or damaged: {len(frame)} of its {counted} features are there: "
                        "fetch the file again"
                    )
    except InputError:
        raise
    except Exception as error:  # GDAL, pyarrow and geopandas raise many kinds on damaged files
        reason = one_line(error)
        if "not recognized as being in a supported file format" in reason:
            reason = "no format that GDAL knows"
        elif len(reason) > 160:
            reason = f"{reason[:159]}…"
        raise InputError(
            f"{path.name}: cannot be read as footprints ({reason}): check or fetch the file again"
        ) from error
    if not isinstance(frame, gpd.GeoDataFrame):
        raise InputError(f"{path.name}: holds no geometry, only a table: give a file with building polygons")
    return frame


def _require_room(path: Path) -> None:
    """InputError where a GeoParquet file does not fit into memory: packed, a few bytes may stand for any number."""
    import pyarrow.compute
    import pyarrow.parquet

    names = [c.name for c in pyarrow.parquet.read_schema(path) if pyarrow.types.is_binary(c.type)]
    # As a dictionary a value that many rows share is unpacked once.
    file = pyarrow.parquet.ParquetFile(path, read_dictionary=names)
    needed = float(_BYTES_A_ROW * file.metadata.num_rows)
    instead = "cut the area that you need out of the file first, such as with ogr2ogr -spat"
    for batch in file.iter_batches():
        for column in batch.columns:
            if pyarrow.types.is_dictionary(column.type):
                sizes = pyarrow.compute.binary_length(column.dictionary).take(column.indices)
                needed += _TIMES_UNPACKED * (pyarrow.compute.sum(sizes).as_py() or 0)
            else:
                needed += _TIMES_UNPACKED * column.nbytes
        require_memory(needed, f"{path.name} of {file.metadata.num_rows} rows", instead)


@contextmanager
def _with_index(path: Path) -> Iterator[Path]:
    """The file itself, or, for a shapefile without .shx, a copy with one: nothing is ever written beside a source."""
    if path.suffix.lower() != ".shp" or any(
        p.suffix.lower() == ".shx" for p in path.parent.glob(f"{path.stem}.*")
    ):
        yield path
        return
    with (
        scratch_folder("shp") as folder,
        _gdal_option("SHAPE_RESTORE_SHX", "YES"),
    ):
        for part in path.parent.glob(f"{path.stem}.*"):
            shutil.copyfile(part, folder / part.name)
        yield folder / path.name


def _buildings_of(frame: gpd.GeoDataFrame, name: str) -> tuple[gpd.GeoDataFrame, list[str]]:
    """The buildings of an OpenStreetMap extract, and a note where it holds other things; other files as they are.

    An extract is known by its columns; its buildings have building=* (a column, in other_tags or in tags), or are of the
    fclass "building" (Geofabrik). InputError where nothing says which of its features are buildings.
    """
    frame = frame.reset_index(drop=True)
    columns = {str(c).lower(): c for c in frame.columns}
    if not (_OSM_IDENTITY | _OSM_KEYS) & set(columns):
        return frame, []
    said: pd.Series[Any] | None = None
    by = "building=*"
    if "building" in columns:
        said = frame[columns["building"]]
    elif "fclass" in columns:
        said, by = frame[columns["fclass"]].where(lambda v: v == "building"), "fclass=building"
    else:
        for column in ("other_tags", "tags"):
            if column in columns:
                text = frame[columns[column]].astype("string")
                said = text.str.extract(_BUILDING_TAG)[0]
    if said is None and not _OSM_KEYS & set(columns):
        return frame, []  # without any keys somebody has chosen them already
    words = None if said is None else said.astype("string").str.strip().str.lower()
    built = np.zeros(len(frame), np.bool_)
    if words is not None:
        built = (~words.isin(["", "no", "false", "0"]) & words.notna()).to_numpy(dtype=np.bool_)
    if len(frame) and not built.any():
        raise InputError(
            f"{name}: of an OpenStreetMap extract ({len(frame)} features), and nothing says which of them are buildings "
            "(building=*, or fclass=building): give its buildings alone"
        )
    if built.all():
        return frame, []
    return frame[built], [
        f"{len(frame)} features of OpenStreetMap, {int(built.sum())} of them buildings by {by}"
    ]


def _only_layer(path: Path) -> str:
    layers = [
        (str(name), str(kind)) for name, kind in pyogrio.list_layers(vector_file(path)) if kind is not None
    ]
    names = [name for name, _ in layers]
    areas = [name for name, kind in layers if "Polygon" in kind]
    if len(areas) == 1 or len(names) == 1:
        return (areas if len(areas) == 1 else names)[0]
    for usual in ("footprints", "buildings"):
        if usual in areas:
            return usual
    if not names:
        raise InputError(f"{path.name}: holds no layer with geometry: give a file with building polygons")
    raise InputError(f"{path.name}: has the layers {', '.join(names)}: say which holds the buildings")


def _check_shapefile(path: Path) -> None:
    """The header tells the length: GDAL reads what is left of a shortened file and only warns."""
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) < 100 or struct.unpack(">i", header[:4])[0] != 9994:
        raise InputError(
            f"{path.name}: this is not a shapefile (its header is missing or wrong): fetch it again"
        )
    said, found = 2 * struct.unpack(">i", header[24:28])[0], path.stat().st_size
    if found < said:
        raise InputError(
            f"{path.name}: the file is cut short: {found} of {said} bytes are there: fetch it again"
        )


class _gdal_option:  # noqa: N801 - a context manager in the style of contextlib's
    """Sets a GDAL option within a with block and puts back what was there."""

    def __init__(self, name: str, value: str) -> None:
        self.name, self.value = name, value

    def __enter__(self) -> None:
        self.before = pyogrio.get_gdal_config_option(self.name)
        pyogrio.set_gdal_config_options({self.name: self.value})

    def __exit__(self, *_: object) -> None:
        pyogrio.set_gdal_config_options({self.name: self.before})


def _polygons_of(
    geometry: NDArray[np.object_], snap_m: float
) -> tuple[NDArray[np.object_], NDArray[np.int64], list[int], int]:
    """Single 2D polygons, the row each came from, rows that gave none though they should, and number of points."""
    polygons: list[shapely.Geometry] = []
    row: list[int] = []
    lost: list[int] = []
    others = 0
    flat = shapely.force_2d(geometry)
    for i, shape in enumerate(flat):
        if shape is None or shape.is_empty:
            lost.append(i)
            continue
        for part in shapely.get_parts(shapely.get_parts(shape)):
            if part.geom_type == "Polygon":
                polygons.append(part)
                row.append(i)
            elif part.geom_type in ("LineString", "LinearRing"):
                xy = shapely.get_coordinates(part)
                if len(xy) >= 4 - (not part.is_closed) and np.hypot(*(xy[-1] - xy[0])) <= snap_m:
                    polygons.append(shapely.Polygon(xy))
                    row.append(i)
                else:
                    lost.append(i)
            else:
                others += 1
    out = np.empty(len(polygons), dtype=object)
    out[:] = polygons
    return out, np.array(row, dtype=np.int64), lost, others


def _without_area(
    repairs: Sequence[Repair], frame: gpd.GeoDataFrame, row: NDArray[np.int64], kept: set[str]
) -> list[Repair]:
    """Those repairs that dropped what never was an outline: walls of 3D shapes, lines beside areas, rows without geometry.

    A flat feature that encloses nothing is an outline that was lost, and so are open lines where all outlines are lines, and
    what GDAL read and GEOS could not.

    Args:
        repairs: of the file.
        frame: its features.
        row: the row that each closed outline came from.
        kept: handles of the features that gave a footprint.
    """
    kinds = frame.geometry.iloc[row].geom_type
    lines = bool(kinds.isin(["LineString", "MultiLineString", "LinearRing"]).all()) and len(row) > 0
    solid = {str(n + 1) for n in frame.index[frame.geometry.has_z]}
    damaged = {str(n + 1) for n in frame.attrs.get(_DAMAGED, ())}
    never = {
        "zero_area": lambda handle: handle in solid or handle in kept,
        "open": lambda handle: not lines,
        "unreadable": lambda handle: handle not in damaged,
    }
    return [repair for repair in repairs if repair.kind in never and never[repair.kind](repair.handle)]


def _moved(geometry: NDArray[np.object_], src: str, dst: str) -> NDArray[np.object_]:
    """Geometries with every vertex transformed, or the same ones when the CRS is the same."""
    if not len(geometry) or same_crs(src, dst):
        return geometry
    change = transformer(src, dst)
    moved = shapely.transform(geometry, lambda xy: np.stack(change.transform(xy[:, 0], xy[:, 1]), axis=1))
    bounds = np.asarray(shapely.total_bounds(moved))
    if not np.isfinite(bounds).all():
        raise CrsError(
            f"coordinates have no place in {crs_name(dst)} when read as {crs_name(src)}: check the crs"
        )
    return np.asarray(moved, dtype=object)


def _repairs_moved(repairs: Sequence[Repair], src: str, dst: str) -> list[Repair]:
    if not repairs or same_crs(src, dst):
        return list(repairs)
    x, y = transformer(src, dst).transform([r.x for r in repairs], [r.y for r in repairs])
    return [replace(r, x=float(a), y=float(b)) for r, a, b in zip(repairs, x, y)]


def _number_of(path: Path) -> str:
    """NGII's vector files are all called N3A_...: the number stands in their folder's name."""
    for name in (path.name, path.parent.name):
        number = sheet_number_in(name)
        if number is not None and len(number) >= 7:
            return number
    return ""


def _cell_around(bounds: Bounds, crs: str) -> str:
    """The 1:5,000 sheet that holds all of an NGII vector file (they are delivered by sheet), or "" where none does."""
    x, y = (bounds[0] + bounds[2]) / 2.0, (bounds[1] + bounds[3]) / 2.0
    try:
        number = sheet_at(*transformer(crs, LONLAT).transform(x, y))
        check_extent(bounds, crs, [number], tolerance_m=1.0)
    except (InputError, CrsError):
        return ""
    return number


def _column(frame: gpd.GeoDataFrame, usual: Sequence[str]) -> str | None:
    names = {str(name).casefold(): str(name) for name in frame.columns}
    return next((names[name] for name in usual if name in names), None)


def _kinds(frame: gpd.GeoDataFrame) -> NDArray[np.object_]:
    column = _column(frame, _KIND_COLUMNS)
    out = np.full(len(frame), "", dtype=object)
    if column is not None:
        for i, value in enumerate(frame[column].tolist()):
            text = "" if value is None or value != value else str(value).strip()
            out[i] = KIND_OF_NAME.get(text) or BUILDING_KINDS.get(text.upper()) or text
    return out


def _floors(frame: gpd.GeoDataFrame) -> pd.Series[Any]:
    column = _column(frame, _FLOOR_COLUMNS)
    if column is None:
        return pd.Series([pd.NA] * len(frame), dtype="Int32")
    numbers = pd.to_numeric(
        frame[column].map(
            lambda value: re.sub(r"[^\d.\-]", "", str(value)) or None if value is not None else None
        ),
        errors="coerce",
    ).to_numpy(dtype=float, na_value=math.nan)
    # NGII writes 0 where the number of floors was not surveyed.
    known = np.isfinite(numbers) & (numbers > 0) & (numbers < 1000)
    return pd.Series(pd.array(np.where(known, np.round(numbers), 0).astype(np.int32), dtype="Int32")).where(
        known
    )


def _assembled(
    source: str,
    number: str,
    crs: str,
    polygons: NDArray[np.object_],
    columns: dict[str, NDArray[np.object_]],
    *,
    floors: Any,
    neatline: shapely.Geometry | None,
    repairs: list[Repair],
    counts: dict[str, int],
    dropped_share: float,
    notes: list[str],
) -> Footprints:
    n = len(polygons)
    frame = gpd.GeoDataFrame(
        {
            **columns,
            "floors": pd.array([pd.NA] * n, dtype="Int32") if floors is None else floors,
            "source": np.full(n, source, dtype=object),
            "sheet": np.full(n, number, dtype=object),
        },
        geometry=gpd.GeoSeries(list(polygons), dtype="geometry"),
        crs=crs,
    )[list(COLUMNS)]
    if neatline is not None:
        outline, place = "neatline", neatline
    elif number:
        outline, place = "number", sheet_polygon(number, crs)
    else:
        outline, place = "extent", shapely.box(*shapely.total_bounds(polygons)) if n else shapely.Polygon()
    sheets = gpd.GeoDataFrame(
        {
            "sheet": np.array([number], dtype=object),
            "source": np.array([source], dtype=object),
            "outline": np.array([outline], dtype=object),
            "footprints": np.array([n], dtype=np.int64),
            "area_m2": np.array([float(shapely.area(polygons).sum()) if n else 0.0]),
            "dropped_share": np.array([dropped_share]),
        },
        geometry=gpd.GeoSeries([place], dtype="geometry"),
        crs=crs,
    )[list(SHEET_COLUMNS)]
    return Footprints(frame, sheets, repairs, counts, notes)
