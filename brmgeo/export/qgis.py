"""QGIS projects for a region's maps and for a flight: layers ordered, styled, and set to play in time.

A project is XML in a zip (``.qgz``), written here without QGIS. It names its layers by relative paths, so the
folder can be moved or given away whole, and the same inputs give the same bytes. ``tests/qgis/check_qgis.py``
opens what this writes in a real QGIS.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.enums import MaskFlags

from brmgeo.errors import CrsError, InputError
from brmgeo.export import iso_utc, shown_until_ms, utc_ms
from brmgeo.export import qgis_style as style
from brmgeo.export.qgis_style import Style, sub
from brmgeo.extras import extra
from brmgeo.files import whole_file
from brmgeo.geo.formats import vector_file
from brmgeo.geo.grid import Bounds
from brmgeo.geo.raster import opened

with extra("maps", "a QGIS project"):
    import pyogrio

KIND_FIELDS = ("kind", "layer", "종류")
SHEET_FIELDS = ("sheet", "number", "name")


@dataclass(frozen=True, slots=True)
class _Layer:
    """One layer of a project; ``geometry`` is None for a raster."""

    key: str
    name: str
    source: str
    crs: CRS
    style: Style
    geometry: str | None = None
    visible: bool = True
    attribution: str = ""
    expanded: bool = False

    @property
    def id(self) -> str:
        """The layer's id in the project; QGIS replaces ids of ten characters or fewer by random ones."""
        return f"brmgeo_{self.key}"


@dataclass(frozen=True, slots=True)
class _Group:
    """Layers under one heading; of an exclusive group one layer at a time is shown."""

    name: str
    layers: Sequence[_Layer]
    exclusive: bool = False


@dataclass(frozen=True, slots=True)
class _Clock:
    """What the temporal controller plays: from, to (milliseconds since 1970 UTC), and the step."""

    start_ms: int
    end_ms: int
    step_s: float


def write_maps_project(
    path: Path,
    *,
    title: str,
    footprints: Path,
    buildings: Path,
    ratio: Path,
    imagery: Path | None = None,
    attribution: str = "",
) -> Path:
    """The QGIS project of a region's maps, written to ``path`` (.qgz) and returned.

    Layers from the top: footprints by kind, sheets with their numbers, repairs (where ``footprints`` has such a
    layer), the building mask, one layer a band of ``ratio`` (the first one shown), imagery. The project names
    the files as its neighbours (``./ratio.tif``), wherever they lie while it is written: they are published side
    by side. ``attribution`` goes into the project's and the layers' metadata and onto the map's corner.

    Raises CrsError when the files are not all in one CRS, InputError when one cannot be read.
    """
    crs, bounds, _ = _raster_facts(buildings)
    vectors: list[_Layer] = []
    styles = _vector_styles(footprints)
    if "footprints" not in styles:
        raise InputError(f"{footprints}: has no layer `footprints`; write it with export.footprints first")
    shown = {"footprints": "Building footprints", "sheets": "Sheets", "repairs": "Repaired outlines"}
    for name, (looks, geometry) in styles.items():
        _same_crs(_vector_facts(footprints, name)[2], crs, footprints)
        source = f"./{footprints.name}|layername={name}"
        visible = name != "repairs"
        open_legend = name == "footprints"
        vectors.append(
            _Layer(
                name,
                shown[name],
                source,
                crs,
                looks,
                geometry=geometry,
                visible=visible,
                attribution=attribution,
                expanded=open_legend,
            )
        )

    mask = _Layer("buildings", "Building mask", f"./{buildings.name}", crs, style.mask_style(), visible=False)
    ratio_crs, _, bands = _raster_facts(ratio)
    _same_crs(ratio_crs, crs, ratio)
    ratios = [
        _Layer(
            f"ratio_{i}",
            f"Within {radius:.4g} m" if radius is not None else f"Band {i}",
            f"./{ratio.name}",
            crs,
            style.ratio_style(i),
            visible=i == 1,
            attribution=attribution,
            expanded=i == 1,
        )
        for i, radius in enumerate(bands, start=1)
    ]
    tree: list[_Layer | _Group] = [
        _Group("Buildings", vectors),
        mask,
        _Group("Share of building", ratios, exclusive=True),
    ]
    if imagery is not None:
        image_crs, _, image_bands = _raster_facts(imagery)
        _same_crs(image_crs, crs, imagery)
        looks = style.rgb_style(len(image_bands))
        tree.append(_Layer("imagery", "Imagery", f"./{imagery.name}", crs, looks, attribution=attribution))
    _write(path, title, crs, bounds, tree, attribution, None)
    return path


def write_flight_project(
    path: Path,
    *,
    title: str,
    candidates: Path,
    trajectory: Path,
    buildings: Path,
    imagery: Path | None = None,
    t_s: NDArray[np.float64],
    start_utc: datetime | None = None,
    maps_href: str | None = None,
    attribution: str = "",
) -> Path:
    """The QGIS project of one flight's results, written to ``path`` (.qgz) and returned; its temporal controller plays it.

    Layers from the top: the aircraft at its current fix (two sigma ring, heading arrow), the smoothed and the
    reference position, candidates of the current frame, the fixes so far, the paths, the building mask, imagery.
    ``candidates`` and ``trajectory`` (.gpkg) lie beside the project and are named as neighbours; the maps by
    ``maps_href``, the relative path from the project's folder to theirs (worked out from where the files lie now when
    not given). ``t_s`` (n,) float64 are the times of the frames, seconds after ``start_utc`` (see
    ``brmgeo.export.utc_ms``): they give the time range and the step.

    Raises CrsError when trajectory and maps are not in one CRS, InputError when a file cannot be read or ``t_s`` is empty.
    """
    if len(t_s) == 0:
        raise InputError(f"{path.name}: a flight without frames has nothing to play")
    crs, bounds, _ = _raster_facts(buildings)
    href = maps_href if maps_href is not None else os.path.relpath(buildings.parent, path.parent)
    href = Path(href).as_posix().rstrip("/")

    found = {
        name: _vector_facts(trajectory, name)
        for path_name in ("online", "smoothed", "reference")
        for name in (path_name, f"{path_name}_path")
    }
    for geometry, _, layer_crs in found.values():
        if geometry is not None:
            _same_crs(layer_crs, crs, trajectory)
    now, paths = _path_layers(
        trajectory, {name: geometry for name, (geometry, _, _) in found.items()}, crs, attribution
    )
    tree: list[_Layer | _Group] = [
        _Group("Now", now),
        *_candidate_layers(candidates, crs, attribution),
        _Group("Paths", paths),
    ]
    mask = style.mask_style("#ffffff", 90) if imagery is not None else style.mask_style("#5b6472", 230)
    tree.append(_Layer("buildings", "Building mask", f"{href}/{buildings.name}", crs, mask))
    if imagery is not None:
        _, _, image_bands = _raster_facts(imagery)
        looks = style.rgb_style(len(image_bands))
        tree.append(
            _Layer("imagery", "Imagery", f"{href}/{imagery.name}", crs, looks, attribution=attribution)
        )
    extent = (
        _path_bounds(trajectory, [name for name, facts in found.items() if facts[0] is not None]) or bounds
    )
    _write(path, title, crs, extent, tree, attribution, _clock(t_s, start_utc))
    return path


def _path_layers(
    trajectory: Path, geometries: Mapping[str, str | None], crs: CRS, attribution: str
) -> tuple[list[_Layer], list[_Layer]]:
    """What moves with the clock, and the paths below it; tables without a geometry are left out."""

    def vector(layer_id: str, table: str, name: str, looks: Style, visible: bool = True) -> list[_Layer]:
        geometry = geometries[table]
        if geometry is None:
            return []
        source = f"./{trajectory.name}|layername={table}"
        return [_Layer(layer_id, name, source, crs, looks, geometry, visible, attribution)]

    tracks = {name: style.track_styles(name) for name in ("online", "smoothed", "reference")}
    now = vector("fix_now", "online", "Fix (ring: 2 sigma)", tracks["online"][0])
    now += vector("smoothed_now", "smoothed", "Smoothed position", tracks["smoothed"][0])
    now += vector("reference_now", "reference", "Reference position", tracks["reference"][0])
    paths = vector("trail", "online", "Fixes so far", style.trail_style(style.ONLINE))
    paths += vector("reference_path", "reference_path", "Reference path", tracks["reference"][1])
    paths += vector("smoothed_path", "smoothed_path", "Smoothed path", tracks["smoothed"][1])
    paths += vector("online_path", "online_path", "Online fixes, whole flight", tracks["online"][1], False)
    return now, paths


def _candidate_layers(candidates: Path, crs: CRS, attribution: str) -> list[_Layer]:
    """The candidates' layer; none where there is no candidate."""
    lonlat = candidates.suffix == ".geojson"
    facts = pyogrio.read_info(
        vector_file(candidates), layer=None if lonlat else candidates.stem, force_feature_count=True
    )
    # A GeoJSON file without features has no geometry type, and QGIS drops such a layer.
    if not facts["features"]:
        return []
    return [
        _Layer(
            "candidates",
            "Candidates",
            f"./{candidates.name}" + ("" if lonlat else f"|layername={candidates.stem}"),
            CRS.from_epsg(4326) if lonlat else crs,
            style.candidates_style(),
            geometry="Point",
            attribution=attribution,
            expanded=True,
        )
    ]


def _clock(t_s: NDArray[np.float64], start_utc: datetime | None) -> _Clock:
    starts = utc_ms(start_utc, np.sort(t_s))
    step_s = float(np.median(np.diff(starts))) / 1000.0 if len(starts) > 1 else 1.0
    return _Clock(int(starts[0]), int(shown_until_ms(starts)[-1]), max(round(step_s, 3), 0.001))


def style_footprints(footprints: Path) -> None:
    """Makes a region's styles the defaults of ``footprints.gpkg``, for people who open the file without the project.

    Covers the layers footprints, sheets and repairs, as far as they are there; call it where the file is made.
    Raises InputError when the file cannot be read.
    """
    style.add_default_styles(footprints, _vector_styles(footprints))


def _vector_styles(footprints: Path) -> dict[str, tuple[Style, str]]:
    """Style and geometry of the layers that a region's vector file has, in the order in which they are drawn."""
    styles: dict[str, tuple[Style, str]] = {}
    for name in ("footprints", "sheets", "repairs"):
        geometry, fields, _ = _vector_facts(footprints, name)
        if geometry is None:
            continue
        field = next(
            (f for f in (KIND_FIELDS if name == "footprints" else SHEET_FIELDS) if f in fields), None
        )
        if name == "footprints":
            styles[name] = (style.footprints_style(field, _distinct(footprints, name, field)), geometry)
        elif name == "sheets":
            styles[name] = (style.sheets_style(field), geometry)
        else:
            styles[name] = (style.repairs_style(geometry), geometry)
    return styles


def _raster_facts(path: Path) -> tuple[CRS, Bounds, list[float | None]]:
    """CRS, bounds, and the radius of each band that QGIS counts (None where the band does not tell one)."""
    with opened(path) as src:
        if src.crs is None:
            raise CrsError(f"{path}: has no CRS; build the maps again")
        # QGIS sees a mask inside the file as a further band, the alpha.
        masked = src.count == 3 and MaskFlags.per_dataset in src.mask_flag_enums[0]
        tags = [src.tags(i).get("radius_m") for i in src.indexes]
        b = src.bounds
        crs = CRS.from_user_input(src.crs.to_wkt())
    return (
        crs,
        (b.left, b.bottom, b.right, b.top),
        [None if t is None else float(t) for t in tags + [None] * masked],
    )


def _vector_facts(path: Path, layer: str) -> tuple[str | None, list[str], CRS | None]:
    """Point, Line or Polygon, the field names and the CRS of a layer; None when the file has no such layer."""
    try:
        if layer not in pyogrio.list_layers(vector_file(path))[:, 0]:
            return None, [], None
        info = pyogrio.read_info(vector_file(path), layer=layer)
    except pyogrio.errors.DataSourceError as error:
        raise InputError(f"{path}: cannot be read as a vector file ({error}); write it again") from error
    kind = str(info["geometry_type"])
    geometry = next((g for g in ("Point", "Line", "Polygon") if g in kind), "Polygon")
    return (
        geometry,
        [str(f) for f in info["fields"]],
        CRS.from_user_input(info["crs"]) if info["crs"] else None,
    )


def _distinct(path: Path, layer: str, field: str | None) -> list[str]:
    if field is None:
        return []
    found = pyogrio.read_dataframe(
        vector_file(path), sql=f'SELECT DISTINCT "{field}" AS v FROM "{layer}"', read_geometry=False
    )
    return sorted(str(v) for v in found["v"] if v is not None)


def _same_crs(found: CRS | None, wanted: CRS, path: Path) -> None:
    if found is None or not found.equals(wanted, ignore_axis_order=True):
        name = "no CRS" if found is None else found.name
        raise CrsError(
            f"{path}: is in {name}, the region's maps in {wanted.name}; write it in the region's CRS"
        )


def _path_bounds(trajectory: Path, layers: Sequence[str]) -> Bounds | None:
    """Bounds of a flight's layers, widened by a fifth and at least 100 m; None when they hold no point."""
    boxes = [
        pyogrio.read_info(vector_file(trajectory), layer=name, force_total_bounds=True)["total_bounds"]
        for name in layers
    ]
    boxes = [b for b in boxes if b is not None and np.isfinite(b).all() and tuple(b) != (0, 0, 0, 0)]
    if not boxes:
        return None
    low, high = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
    margin = max(100.0, 0.2 * float((high - low).max()))
    return float(low[0] - margin), float(low[1] - margin), float(high[0] + margin), float(high[1] + margin)


def _write(
    path: Path,
    title: str,
    crs: CRS,
    bounds: Bounds,
    tree: Sequence[_Layer | _Group],
    attribution: str,
    clock: _Clock | None,
) -> None:
    root = ET.Element("qgis", version=style.QGIS_VERSION, projectname=title)
    sub(root, "homePath", path="")
    sub(root, "title", title)
    _srs(sub(root, "projectCrs"), crs)
    top = sub(root, "layer-tree-group")
    layers: list[_Layer] = []
    for node in tree:
        if isinstance(node, _Layer):
            _tree_layer(top, node)
            layers.append(node)
        elif node.layers:
            group = sub(top, "layer-tree-group", name=node.name, checked="Qt::Checked", expanded=1)
            if node.exclusive:
                group.set("mutually-exclusive", "1")
                group.set("mutually-exclusive-child", "0")
            for layer in node.layers:
                _tree_layer(group, layer)
            layers += node.layers
    canvas = sub(root, "mapcanvas", name="theMapCanvas", annotationsVisible=1)
    sub(canvas, "units", "meters")
    _extent(canvas, bounds)
    sub(canvas, "rotation", "0")
    _srs(sub(canvas, "destinationsrs"), crs)
    sub(canvas, "rendermaptile", "0")
    listed = sub(root, "projectlayers")
    for layer in layers:
        _map_layer(listed, layer)
    order = sub(root, "layerorder")
    for layer in layers:
        sub(order, "layer", id=layer.id)
    _properties(root, attribution, clock)
    metadata = sub(root, "projectMetadata")
    sub(metadata, "title", title)
    sub(metadata, "abstract", f"{title}. {attribution}".strip())
    sub(metadata, "author", "brmgeo")
    view = sub(root, "ProjectViewSettings", UseProjectScales=0, rotation=0)
    left, bottom, right, top_y = bounds
    _srs(sub(view, "DefaultViewExtent", xmin=left, ymin=bottom, xmax=right, ymax=top_y), crs)
    if clock is not None:
        settings = sub(
            root,
            "ProjectTimeSettings",
            timeStepUnit="s",
            timeStep=clock.step_s,
            frameRate=4,
            cumulativeTemporalRange=0,
        )
        span = sub(settings, "TemporalRange")
        sub(span, "start", iso_utc(clock.start_ms))
        sub(span, "end", iso_utc(clock.end_ms))

    ET.indent(root, " ")
    text = (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + ET.tostring(root, "unicode") + "\n"
    )
    with whole_file(path) as scratch, zipfile.ZipFile(scratch, "w") as archive:
        entry = zipfile.ZipInfo(f"{path.stem}.qgs", date_time=(1980, 1, 1, 0, 0, 0))
        entry.compress_type = zipfile.ZIP_DEFLATED
        entry.external_attr = 0o644 << 16
        archive.writestr(entry, text.encode())


def _tree_layer(parent: ET.Element, layer: _Layer) -> None:
    sub(
        parent,
        "layer-tree-layer",
        id=layer.id,
        name=layer.name,
        source=layer.source,
        providerKey="gdal" if layer.geometry is None else "ogr",
        checked="Qt::Checked" if layer.visible else "Qt::Unchecked",
        expanded=int(layer.expanded),
    )


def _map_layer(parent: ET.Element, layer: _Layer) -> None:
    element = sub(
        parent,
        "maplayer",
        type="raster" if layer.geometry is None else "vector",
        hasScaleBasedVisibilityFlag=0,
    )
    sub(element, "id", layer.id)
    sub(element, "datasource", layer.source)
    sub(element, "layername", layer.name)
    _srs(sub(element, "srs"), layer.crs)
    if layer.attribution:
        metadata = sub(element, "resourceMetadata")
        sub(metadata, "title", layer.name)
        sub(metadata, "rights", layer.attribution)
        sub(element, "attribution", layer.attribution)
    if layer.geometry is None:
        sub(element, "provider", "gdal")
        # 255 of the building mask means unknown, which is shown; of the others, nodata is clear.
        sub(sub(element, "noData"), "noDataList", bandNo=1, useSrcNoData=int(layer.key != "buildings"))
    else:
        element.set("geometry", layer.geometry)
        element.set("labelsEnabled", str(int(any(e.tag == "labeling" for e in layer.style))))
        sub(element, "provider", "ogr", encoding="UTF-8")
        sub(element, "layerGeometryType", str(style.GEOMETRY_TYPES[layer.geometry]))
    element.extend(layer.style)


def _properties(root: ET.Element, attribution: str, clock: _Clock | None) -> None:
    properties = sub(root, "properties")
    sub(sub(properties, "Paths"), "Absolute", "false", type="bool")
    sub(sub(properties, "SpatialRefSys"), "ProjectionsEnabled", "1", type="int")
    readable = ET.tostring(style.text_style(9, style.DARK), "unicode")
    scale_bar = sub(properties, "ScaleBar")
    sub(scale_bar, "TextFormat", readable, type="QString")
    sub(scale_bar, "Enabled", "true", type="bool")
    sub(scale_bar, "Placement", "0", type="int")
    if attribution:
        label = sub(properties, "CopyrightLabel")
        sub(label, "Enabled", "true", type="bool")
        sub(label, "Label", attribution, type="QString")
        sub(label, "Font", readable, type="QString")
        sub(label, "Placement", "3", type="int")
    if clock is not None:
        # Without these the controller opens switched off, and the layers show all times at once.
        controller = sub(properties, "TemporalControllerWidget")
        sub(controller, "NavigationMode", "1", type="int")
        sub(controller, "StartDateTime", iso_utc(clock.start_ms), type="QString")
        sub(controller, "EndDateTime", iso_utc(clock.end_ms), type="QString")


def _extent(parent: ET.Element, bounds: Bounds) -> None:
    extent = sub(parent, "extent")
    for tag, value in zip(("xmin", "ymin", "xmax", "ymax"), bounds):
        sub(extent, tag, repr(float(value)))


def _srs(parent: ET.Element, crs: CRS) -> None:
    element = sub(parent, "spatialrefsys")
    epsg = crs.to_epsg()
    sub(element, "wkt", crs.to_wkt())
    sub(element, "authid", f"EPSG:{epsg}" if epsg else "")
    sub(element, "description", crs.name)
    sub(element, "geographicflag", str(crs.is_geographic).lower())
