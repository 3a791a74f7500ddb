"""QGIS 3 styles, built as XML: symbols, renderers, labels, times; as QML files and as GeoPackage default styles.

The same style elements go into a project (``brmgeo.export.qgis``), into a QML file beside a layer, and into the
``layer_styles`` table of a GeoPackage, so a layer looks the same whichever way it is opened.
Written for QGIS 3.22 and later; colours are RGBA hex.
"""

from __future__ import annotations

import sqlite3
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from brmgeo.codes import BUILDING, BUILDING_KINDS, KIND_OF_NAME, OTHER, UNKNOWN, layer_code

QGIS_VERSION = "3.22.0"
Style = list[ET.Element]
GEOMETRY_TYPES = {"Point": 0, "Line": 1, "Polygon": 2}

# Kind of building -> (label, colour), in the order of a legend. Colours keep apart for colour-blind readers and stand out
# on imagery.
KINDS = {
    "house": ("House (주택)", "#f2a541"),
    "row-house": ("Row house (연립주택)", "#e0662f"),
    "apartment": ("Apartments (아파트)", "#d45087"),
    "non-residential": ("Non-residential (주택외건물)", "#4aa8e0"),
    "wall-less": ("Canopy, no walls (무벽건물)", "#b8bcc4"),
    "greenhouse": ("Greenhouse (온실)", "#3fb68b"),
    "temporary": ("Temporary (가건물)", "#f0e05a"),
    "under-construction": ("Under construction (공사중건물)", "#a9714b"),
    "unclassified": ("Unclassified building", "#9a86d6"),
}
_KIND_OF_WORD = {kind: kind for kind in KINDS} | KIND_OF_NAME | {"건물": "unclassified"}
OTHER_COLOUR = "#9a86d6"
STATUS_COLOURS = {"converged": "#35e0c8", "ambiguous": "#ffb02e", "lost": "#ff5d5d"}
# Share of building: fine steps where countryside and villages differ, the whole of 0..1 so that maps compare.
RATIO_STOPS: tuple[tuple[float, str, int], ...] = (
    (0.0, "#440154", 0),
    (0.02, "#472f7d", 130),
    (0.05, "#3c4f8a", 190),
    (0.1, "#2c728e", 215),
    (0.15, "#21918c", 225),
    (0.2, "#28ae80", 235),
    (0.3, "#5ec962", 240),
    (0.5, "#addc30", 245),
    (1.0, "#fde725", 255),
)


def kind_of(value: str) -> tuple[str, str] | None:
    """(label, colour) of an NGII layer code (``B0014112``, ``4112``) or of a kind (``house``), None for anything else."""
    kind = BUILDING_KINDS.get(layer_code(value)) or _KIND_OF_WORD.get(value.strip())
    return None if kind is None else KINDS[kind]


def rgba(colour: str, alpha: int = 255) -> str:
    """QGIS's ``r,g,b,a`` of a ``#rrggbb`` colour and an opacity of 0..255."""
    return ",".join(str(int(colour[i : i + 2], 16)) for i in (1, 3, 5)) + f",{alpha}"


def sub(parent: ET.Element, tag: str, text: str | None = None, **attributes: object) -> ET.Element:
    """A new child of ``parent``."""
    child = ET.SubElement(parent, tag, {k: str(v) for k, v in attributes.items()})
    child.text = text
    return child


def _options(parent: ET.Element, values: Mapping[str, object]) -> None:
    option = sub(parent, "Option", type="Map")
    for name, value in values.items():
        sub(option, "Option", name=name, value=value, type="QString")


def _data_defined(parent: ET.Element, expressions: Mapping[str, str], tag: str) -> None:
    """Properties of a symbol layer that an expression computes feature by feature."""
    option = sub(sub(parent, tag), "Option", type="Map")
    sub(option, "Option", name="name", value="", type="QString")
    properties = sub(option, "Option", name="properties", type="Map")
    for name, expression in expressions.items():
        entry = sub(properties, "Option", name=name, type="Map")
        sub(entry, "Option", name="active", value="true", type="bool")
        sub(entry, "Option", name="expression", value=expression, type="QString")
        sub(entry, "Option", name="type", value=3, type="int")
    sub(option, "Option", name="type", value="collection", type="QString")


@dataclass(frozen=True, slots=True)
class SymbolLayer:
    """One layer of a symbol: its QGIS class, its properties, and those that an expression computes."""

    kind: str
    properties: Mapping[str, object]
    computed: Mapping[str, str] | None = None


def fill(colour: str, alpha: int, outline: str, width_mm: float, style: str = "solid") -> SymbolLayer:
    """A polygon's fill; ``alpha`` 0 leaves only the outline."""
    return SymbolLayer(
        "SimpleFill",
        {
            "color": rgba(colour, alpha),
            "style": "solid" if alpha else "no",
            "joinstyle": "miter",
            "outline_color": rgba(outline),
            "outline_style": style,
            "outline_width": width_mm,
            "outline_width_unit": "MM",
        },
    )


def line(colour: str, width_mm: float, style: str = "solid", alpha: int = 255) -> SymbolLayer:
    """A line; ``style`` is solid, dash or dot."""
    return SymbolLayer(
        "SimpleLine",
        {
            "line_color": rgba(colour, alpha),
            "line_style": style,
            "line_width": width_mm,
            "line_width_unit": "MM",
            "capstyle": "round",
            "joinstyle": "round",
        },
    )


def marker(
    shape: str,
    colour: str,
    size: float,
    *,
    unit: str = "MM",
    alpha: int = 255,
    outline: str = "#10141c",
    outline_mm: float = 0.2,
    ahead_mm: float = 0.0,
    computed: Mapping[str, str] | None = None,
) -> SymbolLayer:
    """A point's marker; ``unit`` MM for the size on screen, RenderMetersInMapUnits for metres on the ground.

    ``ahead_mm`` shifts the marker to its own right, which turns with its angle.
    """
    return SymbolLayer(
        "SimpleMarker",
        {
            "name": shape,
            "color": rgba(colour, alpha),
            "size": size,
            "size_unit": unit,
            "outline_color": rgba(outline),
            "outline_style": "solid",
            "outline_width": outline_mm,
            "outline_width_unit": "MM",
            "offset": f"{ahead_mm:g},0",
            "offset_unit": "MM",
            "horizontal_anchor_point": 1,
            "vertical_anchor_point": 1,
        },
        computed,
    )


def _symbol(parent: ET.Element, name: str, layers: Sequence[SymbolLayer]) -> None:
    kinds = {"SimpleFill": "fill", "SimpleLine": "line", "SimpleMarker": "marker"}
    symbol = sub(
        parent, "symbol", name=name, type=kinds[layers[0].kind], alpha=1, clip_to_extent=1, force_rhr=0
    )
    for layer in layers:
        element = sub(symbol, "layer", enabled=1, locked=0)
        element.set("class", layer.kind)
        element.set("pass", "0")
        _options(element, layer.properties)
        _data_defined(element, layer.computed or {}, "data_defined_properties")


def single(*layers: SymbolLayer) -> ET.Element:
    """A renderer that draws every feature with one symbol."""
    renderer = ET.Element(
        "renderer-v2", type="singleSymbol", symbollevels="0", enableorderby="0", forceraster="0"
    )
    _symbol(sub(renderer, "symbols"), "0", layers)
    return renderer


def categorized(
    attribute: str,
    categories: Sequence[tuple[str, str, Sequence[SymbolLayer]]],
    *,
    order_by: str | None = None,
) -> ET.Element:
    """A renderer with one symbol a value of ``attribute``: (value, legend label, symbol layers); value "" is all others.

    ``order_by`` is an expression: features are drawn by its rising value.
    """
    renderer = ET.Element(
        "renderer-v2",
        type="categorizedSymbol",
        attr=attribute,
        symbollevels="0",
        enableorderby=str(int(order_by is not None)),
        forceraster="0",
    )
    listed = sub(renderer, "categories")
    symbols = sub(renderer, "symbols")
    for i, (value, label, layers) in enumerate(categories):
        sub(listed, "category", value=value, label=label, symbol=i, render="true", type="string")
        _symbol(symbols, str(i), layers)
    if order_by is not None:
        sub(sub(renderer, "orderby"), "orderByClause", order_by, asc=1, nullsFirst=1)
    return renderer


def text_style(size_pt: float, colour: str, **attributes: object) -> ET.Element:
    """Text that a white rim keeps readable on any ground."""
    text = ET.Element("text-style", {k: str(v) for k, v in attributes.items()})
    text.set("fontSize", str(size_pt))
    text.set("textColor", rgba(colour))
    fixed = {"fontSizeUnit": "Point", "fontFamily": "Sans Serif", "fontWeight": "75", "textOpacity": "1"}
    text.attrib.update(fixed | {"textOrientation": "horizontal"})
    sub(text, "families")
    sub(
        text,
        "text-buffer",
        bufferDraw=1,
        bufferSize=0.8,
        bufferSizeUnits="MM",
        bufferColor=rgba("#ffffff", 220),
        bufferOpacity=1,
        bufferJoinStyle=128,
        bufferNoFill=1,
    )
    return text


def labels(expression: str, *, size_pt: float, colour: str, at: str) -> ET.Element:
    """Labels with the text of ``expression``, below and right of the point that the geometry expression ``at`` gives."""
    labeling = ET.Element("labeling", type="simple")
    settings = sub(labeling, "settings", calloutType="simple")
    settings.append(text_style(size_pt, colour, fieldName=expression, isExpression=1))
    sub(
        settings,
        "placement",
        placement=1,
        quadOffset=8,
        xOffset=1.2,
        yOffset=1.2,
        offsetUnits="MM",
        priority=8,
        geometryGeneratorEnabled=1,
        geometryGeneratorType="PointGeometry",
        geometryGenerator=at,
    )
    sub(settings, "rendering", drawLabels=1, obstacle=0, upsidedownLabels=0, fontMaxPixelSize=10000)
    return labeling


def times(start: str, end: str) -> ET.Element:
    """Features are shown from the time in field ``start`` to that in field ``end``; without ``end`` they stay."""
    element = ET.Element(
        "temporal",
        enabled="1",
        mode="2",
        startField=start,
        endField=end,
        startExpression="",
        endExpression="",
        durationField="",
        fixedDuration="0",
        durationUnit="s",
        accumulate="0",
        limitMode="1",  # the end belongs to the range: it lies 1 ms before the next start
    )
    fixed = sub(element, "fixedRange")
    sub(fixed, "start")
    sub(fixed, "end")
    return element


def _pipe(renderer: ET.Element, *, smooth: bool) -> Style:
    pipe = ET.Element("pipe")
    method = "bilinear" if smooth else "nearestNeighbour"
    sub(
        sub(pipe, "provider"),
        "resampling",
        enabled=str(smooth).lower(),
        zoomedInResamplingMethod="nearestNeighbour",
        zoomedOutResamplingMethod=method,
        maxOversampling=2,
    )
    pipe.append(renderer)
    sub(pipe, "brightnesscontrast", brightness=0, contrast=0, gamma=1)
    sub(pipe, "huesaturation", saturation=0, grayscaleMode=0, colorizeOn=0, invertColors=0)
    sub(pipe, "rasterresampler", maxOversampling=2)
    sub(pipe, "resamplingStage", "provider" if smooth else "resamplingFilter")
    return [pipe, ET.Element("blendMode")]


def rgb_style(bands: int) -> Style:
    """Imagery as it is: bands 1-3 as red, green, blue (one band as grey), without stretching."""
    if bands < 3:
        grey = ET.Element(
            "rasterrenderer",
            type="singlebandgray",
            grayBand="1",
            alphaBand="-1",
            opacity="1",
            gradient="BlackToWhite",
        )
        enhancement = sub(grey, "contrastEnhancement")
        for tag, text in (("minValue", "0"), ("maxValue", "255"), ("algorithm", "StretchToMinimumMaximum")):
            sub(enhancement, tag, text)
        return _pipe(grey, smooth=True)
    renderer = ET.Element(
        "rasterrenderer",
        type="multibandcolor",
        redBand="1",
        greenBand="2",
        blueBand="3",
        alphaBand="4" if bands == 4 else "-1",
        opacity="1",
    )
    for name in ("red", "green", "blue"):
        # Stated, though it changes nothing: otherwise QGIS stretches by statistics of its own.
        enhancement = sub(renderer, f"{name}ContrastEnhancement")
        for tag, text in (("minValue", "0"), ("maxValue", "255"), ("algorithm", "NoEnhancement")):
            sub(enhancement, tag, text)
    return _pipe(renderer, smooth=True)


def mask_style(colour: str = "#ff4d4d", alpha: int = 150) -> Style:
    """buildings.tif: 0 is clear, 1 a colour, 255 (unknown) grey."""
    renderer = ET.Element(
        "rasterrenderer", type="paletted", band="1", alphaBand="-1", opacity="1", nodataColor=""
    )
    palette = sub(renderer, "colorPalette")
    sub(palette, "paletteEntry", value=OTHER, color="#ffffff", alpha=0, label="No building")
    sub(palette, "paletteEntry", value=BUILDING, color=colour, alpha=alpha, label="Building")
    sub(palette, "paletteEntry", value=UNKNOWN, color="#6b7280", alpha=110, label="Unknown (no sheet here)")
    return _pipe(renderer, smooth=False)


def ratio_style(band: int) -> Style:
    """One band of ratio.tif: share of building, 0..1, from dark and thin to bright and opaque."""
    renderer = ET.Element(
        "rasterrenderer",
        type="singlebandpseudocolor",
        band=str(band),
        alphaBand="-1",
        opacity="0.75",
        nodataColor="",
        classificationMin="0",
        classificationMax="1",
    )
    shader = sub(
        sub(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode=1,
        clip=0,
        minimumValue=0,
        maximumValue=1,
        labelPrecision=2,
    )
    for value, colour, alpha in RATIO_STOPS:
        sub(shader, "item", value=value, color=colour, alpha=alpha, label=f"{100 * value:g} %")
    # A continuous legend would space the stops evenly in value and squeeze the low ones into a line.
    sub(shader, "rampLegendSettings", useContinuousLegend=0, orientation=2, direction=0)
    return _pipe(renderer, smooth=True)


def footprints_style(attribute: str | None, values: Sequence[str]) -> Style:
    """Footprints by kind, for the ``values`` that ``attribute`` takes; all alike without an attribute."""
    if attribute is None:
        return [single(fill(OTHER_COLOUR, 110, OTHER_COLOUR, 0.3))]
    known: list[tuple[str, str, str]] = []
    for label, colour in KINDS.values():
        known += [(v, label, colour) for v in sorted(values) if kind_of(v) == (label, colour)]
    known += [(v, v.capitalize(), OTHER_COLOUR) for v in sorted(values) if kind_of(v) is None and v]
    categories = [(v, label, [fill(colour, 120, colour, 0.3)]) for v, label, colour in known]
    categories.append(("", "Other" if known else "Building", [fill("#8b93a1", 120, "#8b93a1", 0.3)]))
    return [categorized(attribute, categories)]


def sheets_style(attribute: str | None) -> Style:
    """Sheets as outlines, labelled with their number at the upper left corner."""
    renderer = single(fill("#ffffff", 0, "#ffffff", 0.9), fill("#ffffff", 0, "#12315c", 0.45, "dash"))
    if attribute is None:
        return [renderer]
    corner = "make_point(x_min($geometry), y_max($geometry))"
    return [renderer, labels(f'"{attribute}"', size_pt=9, colour="#12315c", at=corner)]


def repairs_style(geometry: str) -> Style:
    """Repaired outlines: a warning mark that stays small."""
    if geometry == "Point":
        return [single(marker("diamond", "#ffd23f", 2.4, outline="#7a1f1f", outline_mm=0.35))]
    if geometry == "Line":
        return [single(line("#7a1f1f", 0.9), line("#ffd23f", 0.5))]
    return [single(fill("#ffd23f", 60, "#b3261e", 0.5))]


def candidates_style() -> Style:
    """Candidates of the current frame, coloured by the frame's status, larger where more likely."""
    # Shares of a belief span decades; on a logarithmic scale the heavy ones stand out and the light ones stay visible.
    size = 'scale_linear(log10(max("mass", 0.00001)), -5, 0, 1.1, 3.2)'
    words = {
        "converged": "Candidate, frame converged",
        "ambiguous": "Candidate, frame ambiguous",
        "lost": "Candidate, frame lost",
    }
    categories = [
        (
            status,
            words[status],
            [
                marker(
                    "circle",
                    colour,
                    1.4,
                    alpha=215,
                    outline="#1b1f27",
                    outline_mm=0.08,
                    computed={"size": size},
                )
            ],
        )
        for status, colour in STATUS_COLOURS.items()
    ]
    return [times("start", "end"), categorized("status", categories, order_by='"mass"')]


# What the paths of a flight look like, in the project and in the GeoPackage alike.
ONLINE, SMOOTHED, REFERENCE = "#35e0c8", "#2f6bff", "#ffffff"
DARK = "#10141c"


def track_styles(name: str) -> tuple[Style, Style]:
    """(style of the points, style of the line) of the path ``name``: online, smoothed or reference."""
    if name == "online":
        return fix_style(ONLINE), path_style(ONLINE, 0.5, DARK)
    if name == "smoothed":
        return now_style(SMOOTHED, "circle", "#ffffff"), path_style(SMOOTHED, 1.0, "#ffffff")
    # Thin and on top of the smoothed path: where both run together, each is still seen.
    return now_style(REFERENCE, "square", DARK), path_style(REFERENCE, 0.35, DARK)


def trail_style(colour: str) -> Style:
    """Points that appear at their time and stay: the track so far."""
    return [times("start", ""), single(marker("circle", colour, 1.5, outline="#0b2a26", outline_mm=0.15))]


def fix_style(colour: str) -> Style:
    """The aircraft at its current fix: a ring of two sigma on the ground, an arrow along the heading."""
    ring = marker(
        "circle",
        colour,
        10.0,
        unit="RenderMetersInMapUnits",
        alpha=60,
        outline=colour,
        outline_mm=0.6,
        computed={"size": '4 * "sigma_m"'},
    )
    arrow = marker(
        "filled_arrowhead",
        "#ffffff",
        6.5,
        outline="#0b2a26",
        outline_mm=0.4,
        ahead_mm=5.0,
        # filled_arrowhead points to the right, angles turn clockwise; an unknown heading hides the arrow.
        computed={"angle": 'coalesce("heading_deg", 0) - 90', "enabled": '"heading_deg" is not null'},
    )
    dot = marker("circle", colour, 2.6, outline="#0b2a26", outline_mm=0.3)
    return [times("start", "end"), single(ring, arrow, dot)]


def now_style(colour: str, shape: str, outline: str) -> Style:
    """A small mark at the current position of a path."""
    return [times("start", "end"), single(marker(shape, colour, 3.2, outline=outline, outline_mm=0.4))]


def path_style(colour: str, width_mm: float, casing: str) -> Style:
    """A path as a line over a wider casing of the other brightness, so that it is seen on dark and bright ground."""
    return [single(line(casing, width_mm + 0.5, alpha=190), line(colour, width_mm))]


def qml(style: Style, geometry: str | None = None) -> str:
    """The text of a QML file: ``style`` for a layer of ``geometry`` (Point, Line, Polygon) or for a raster."""
    root = ET.Element("qgis", version=QGIS_VERSION, styleCategories="Symbology|Labeling|Temporal")
    if geometry is not None:
        has_labels = any(e.tag == "labeling" for e in style)
        root.set("labelsEnabled", str(int(has_labels)))
    root.extend(style)
    if geometry is not None:
        sub(root, "blendMode", "0")
        sub(root, "layerOpacity", "1")
        sub(root, "layerGeometryType", str(GEOMETRY_TYPES[geometry]))
    ET.indent(root, " ")
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + ET.tostring(root, "unicode") + "\n"
    )


def add_default_styles(gpkg: Path, styles: Mapping[str, tuple[Style, str]]) -> None:
    """Makes ``styles`` (layer name -> style, geometry) the styles with which QGIS opens the layers of a GeoPackage.

    Writes the table ``layer_styles`` as QGIS itself does, always with the same bytes. Replaces an earlier table.
    """
    with closing(sqlite3.connect(gpkg)) as db, db:
        db.execute("DROP TABLE IF EXISTS layer_styles")
        db.execute(
            "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), "
            "f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), "
            "styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30), "
            "update_time DATETIME)"
        )
        columns = dict(db.execute("SELECT table_name, column_name FROM gpkg_geometry_columns"))
        for name, (style, geometry) in styles.items():
            db.execute(
                "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, "
                "styleQML, styleSLD, useAsDefault, description, owner, ui, update_time) "
                "VALUES ('', '', ?, ?, ?, ?, '', 1, ?, '', NULL, '2000-01-01T00:00:00.000Z')",
                (name, columns[name], "brmgeo", qml(style, geometry), f"brmgeo: {name}"),
            )
        # Registered as plain attributes, or readers that trust gpkg_contents alone would not find it.
        db.execute(
            "INSERT OR REPLACE INTO gpkg_contents (table_name, data_type, identifier, description, last_change) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles', '', '2000-01-01T00:00:00.000Z')"
        )
