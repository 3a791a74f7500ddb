"""Opens every QGIS project under a folder in a real QGIS, checks it, and renders it.

Run with the Python that has QGIS's own bindings (Debian: ``apt install qgis python3-qgis``), without a display::

    QT_QPA_PLATFORM=offscreen /usr/bin/python3 tests/qgis/check_qgis.py data/out/demo [--out pictures]

Checked: every layer is valid, in the right CRS, on the map, and drawn by the renderer it was given; the layers' order;
for flights also that times are active, that the project's time range covers the candidates, and that each time shows the
candidates of one frame, no more and no fewer. Pictures must not be blank, and those of a flight must differ in time.
Prints what it found; exit status 1 when something is wrong, 2 when there is nothing to check.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsCoordinateTransform,
    QgsDateTimeRange,
    QgsFeatureRequest,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProject,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
    QgsVectorLayerTemporalContext,
)
from qgis.PyQt.QtCore import QDateTime, QSize, Qt
from qgis.PyQt.QtGui import QColor, QImage

MAPS_ORDER = ["footprints", "sheets", "repairs", "buildings", "ratio_", "imagery"]
FLIGHT_ORDER = [
    *("fix_now", "smoothed_now", "reference_now", "candidates", "trail", "reference_path"),
    *("smoothed_path", "online_path", "buildings", "imagery"),
]
RENDERERS = {
    "footprints": ("categorizedSymbol", "singleSymbol"),
    "candidates": ("categorizedSymbol",),
    "buildings": ("paletted",),
    "ratio_": ("singlebandpseudocolor",),
    "imagery": ("multibandcolor", "singlebandgray"),
}
TIMED = ("fix_now", "smoothed_now", "reference_now", "candidates", "trail")


class Findings:
    """What was found wrong, printed as it comes."""

    def __init__(self):
        self.failures = 0

    def check(self, good, what):
        """Prints and counts ``what`` unless ``good``."""
        if not good:
            self.failures += 1
            print(f"  WRONG: {what}")
        return good


def key(layer):
    """The layer's id as brmgeo.export.qgis names it."""
    return layer.id().removeprefix("brmgeo_")


def rank(layer_id, order):
    """Where a layer belongs; -1 when it has no place."""
    return next((i for i, name in enumerate(order) if layer_id.startswith(name)), -1)


def check_project(path, name, out, findings):
    """Checks one project and renders it into pictures called by ``name``."""
    project = QgsProject()
    if not findings.check(project.read(str(path)), f"{path}: QGIS cannot read it: {project.error()}"):
        return
    layers = project.layerTreeRoot().layerOrder()
    ids = [key(layer) for layer in layers]
    flight = "fix_now" in ids
    kind = "flight" if flight else "maps"
    print(
        f"{path}: {kind} project in {project.crs().authid()}, {len(layers)} layers, title {project.title()!r}"
    )
    findings.check(
        project.crs().isValid() and not project.crs().isGeographic(), "the project's CRS is not projected"
    )
    findings.check(bool(layers), "it has no layers")
    findings.check(project.metadata().abstract() != "", "it has no abstract, so no attribution")
    order = FLIGHT_ORDER if flight else MAPS_ORDER
    ranks = [rank(i, order) for i in ids]
    findings.check(-1 not in ranks and ranks == sorted(ranks), f"the layers' order is {ids}")
    view = project.viewSettings().defaultViewExtent()
    for layer in layers:
        check_layer(layer, project, view, findings)
    if flight and "candidates" not in ids:
        print("  no candidates, so nothing plays")
    elif flight:
        check_times(project, findings)
        check_defaults(path.parent, findings)
        span = project.timeSettings().temporalRange()
        whole = span.begin().msecsTo(span.end())
        step = max(int(project.timeSettings().timeStep() * 1000), 1)
        early = span.begin().addMSecs(min(whole, step // 2))
        late = span.begin().addMSecs(int(whole * 0.8))
        first = render(project, view, out / f"{name}-early.png", early, findings)
        second = render(project, view, out / f"{name}-late.png", late, findings)
        findings.check(first != second, "the map looks the same at two times: nothing plays")
        empty = render(project, view, None, span.begin().addYears(-1), findings)
        findings.check(
            empty != first, "a year before the flight the map looks the same: candidates have no time"
        )
    else:
        render(project, view, out / f"{name}.png", None, findings)


def check_layer(layer, project, view, findings):
    """One layer: valid, in its CRS, on the map, drawn as styled."""
    name = f"layer {key(layer)}"
    if not findings.check(layer.isValid(), f"{name} is not valid: {layer.source()}"):
        return
    crs = layer.crs()
    lonlat = layer.source().split("|")[0].endswith(".geojson")
    wanted = "EPSG:4326" if lonlat else project.crs().authid()
    findings.check(crs.isValid() and crs.authid() == wanted, f"{name} is in {crs.authid()}, not in {wanted}")
    if isinstance(layer, QgsVectorLayer):
        renderer = layer.renderer().type()
        detail = f"{layer.featureCount()} features"
        if layer.featureCount() == 0:
            print(f"  {key(layer):16} {renderer:22} no features")
            return
    else:
        renderer = layer.renderer().type()
        detail = f"{layer.width()} x {layer.height()} px, {layer.bandCount()} bands"
    to_project = QgsCoordinateTransform(crs, project.crs(), project)
    extent = to_project.transformBoundingBox(layer.extent())
    findings.check(
        extent.intersects(view), f"{name} lies off the map: {extent.toString(0)} against {view.toString(0)}"
    )
    allowed = next(
        (kinds for start, kinds in RENDERERS.items() if key(layer).startswith(start)), ("singleSymbol",)
    )
    findings.check(renderer in allowed, f"{name} is drawn by {renderer}, not by {allowed}")
    if isinstance(layer, QgsRasterLayer):
        check_raster(layer, findings)
    elif renderer == "categorizedSymbol":
        field = layer.renderer().classAttribute()
        listed = {c.value() for c in layer.renderer().categories()}
        values = {v for v in layer.uniqueValues(layer.fields().indexOf(field)) if isinstance(v, str)}
        findings.check(values <= listed, f"{name}: {sorted(values - listed)} of field {field} have no style")
    if key(layer) == "sheets":
        findings.check(layer.labelsEnabled() and layer.labeling() is not None, "sheets have no labels")
    if key(layer) in TIMED:
        findings.check(layer.temporalProperties().isActive(), f"{name}: times are not active")
    print(f"  {key(layer):16} {renderer:22} {detail}")


def check_raster(layer, findings):
    """Ratios run from 0 to 1 in the units QGIS shows, and the mask has its three colours."""
    if key(layer).startswith("ratio_"):
        shader = layer.renderer().shader().rasterShaderFunction()
        stops = [item.value for item in shader.colorRampItemList()]
        findings.check(stops[0] == 0 and stops[-1] == 1, f"{key(layer)}: colours run over {stops}")
        stats = layer.dataProvider().bandStatistics(layer.renderer().band())
        sound = 0 <= stats.minimumValue <= stats.maximumValue <= 1
        findings.check(
            sound,
            f"{key(layer)}: values run over {stats.minimumValue}..{stats.maximumValue}, not within 0..1",
        )
    if key(layer) == "buildings":
        values = {int(c.value) for c in layer.renderer().classes()}
        findings.check(values == {0, 1, 255}, f"buildings: colours for {sorted(values)}, not 0, 1, 255")


def opened_by_hand(source):
    """A layer as the desktop opens it: the default style is loaded after construction, which would undo its times."""
    options = QgsVectorLayer.LayerOptions()
    options.loadDefaultStyle = False
    layer = QgsVectorLayer(source, "by hand", "ogr", options)
    layer.loadDefaultStyle()
    return layer


def as_utc(moment):
    """QGIS before 3.30 drops the zone of a file's times and compares bare clock readings: read them as UTC."""
    return QDateTime(moment.date(), moment.time(), Qt.UTC) if moment.timeSpec() == Qt.LocalTime else moment


def check_defaults(folder, findings):
    """The files opened by hand, outside the project, come up styled and with active times."""
    found = []
    for name in (
        "candidates.geojson",
        "candidates.gpkg|layername=candidates",
        "trajectory.gpkg|layername=online",
    ):
        if (folder / name.split("|")[0]).is_file():
            layer = opened_by_hand(f"{folder}/{name}")
            good = layer.isValid() and layer.featureCount() > 0
            if good and findings.check(
                layer.temporalProperties().isActive(), f"{name}, opened by hand, has no active times"
            ):
                found.append(name)
    for name in ("smoothed_path", "reference_path"):
        layer = opened_by_hand(f"{folder}/trajectory.gpkg|layername={name}")
        if layer.isValid():
            layers = layer.renderer().symbol().symbolLayerCount()
            findings.check(
                layers == 2, f"{name}, opened by hand, has {layers} symbol layers, not line and casing"
            )
    print(f"  styled when opened by hand: {', '.join(found)}")


def check_times(project, findings):
    """The project's range covers the candidates, and at each moment exactly one frame's candidates show."""
    layer = project.mapLayer("brmgeo_candidates")
    span = project.timeSettings().temporalRange()
    sound = span.begin().isValid() and span.end().isValid() and span.begin() < span.end()
    if not findings.check(sound, "the project has no time range") or layer.featureCount() == 0:
        return
    controller = project.readNumEntry("TemporalControllerWidget", "/NavigationMode", -1)[0]
    findings.check(controller == 1, f"the temporal controller's mode is {controller}, not 1 (animated)")
    names = ("frame", "start", "end")
    indices = [layer.fields().indexOf(n) for n in names]
    if not findings.check(-1 not in indices, f"candidates lack one of {names}"):
        return
    frames, counts = {}, {}
    for feature in layer.getFeatures(QgsFeatureRequest().setSubsetOfAttributes(indices)):
        frame, start, end = (feature[n] for n in names)
        counts[frame] = counts.get(frame, 0) + 1
        if frame not in frames:
            if not findings.check(
                isinstance(start, QDateTime), f"start is {type(start).__name__}, not a time"
            ):
                return
            frames[frame] = (as_utc(start), as_utc(end))
    begin, end = min(s for s, _ in frames.values()), max(e for _, e in frames.values())
    findings.check(
        span.begin() <= begin and span.end() >= end,
        f"the range {span.begin().toString(Qt.ISODateWithMs)} to {span.end().toString(Qt.ISODateWithMs)} does not cover "
        f"the candidates, {begin.toString(Qt.ISODateWithMs)} to {end.toString(Qt.ISODateWithMs)}",
    )
    context = QgsVectorLayerTemporalContext()
    context.setLayer(layer)
    ordered = sorted(frames)
    for frame in sorted({ordered[0], ordered[len(ordered) // 2], ordered[-1]}):
        start, end = frames[frame]
        moment = start.addMSecs(start.msecsTo(end) // 2)
        expression = layer.temporalProperties().createFilterString(context, QgsDateTimeRange(moment, moment))
        shown = sum(1 for _ in layer.getFeatures(QgsFeatureRequest().setFilterExpression(expression)))
        at = moment.toString(Qt.ISODateWithMs)
        findings.check(
            shown == counts[frame], f"at {at} {shown} candidates show, frame {frame} has {counts[frame]}"
        )
    total = sum(counts.values())
    first, last = begin.toString(Qt.ISODate), end.toString(Qt.ISODate)
    print(f"  plays {len(frames)} frames with candidates, {total} in all, {first} to {last}")


def render(project, view, path, moment, findings):
    """Draws the visible layers as the map window would; returns the pixels and, with a path, writes them as PNG."""
    settings = QgsMapSettings()
    root = project.layerTreeRoot()
    settings.setLayers([layer for layer in root.layerOrder() if root.findLayer(layer.id()).isVisible()])
    settings.setDestinationCrs(project.crs())
    settings.setTransformContext(project.transformContext())
    settings.setEllipsoid(project.ellipsoid())
    settings.setBackgroundColor(QColor("white"))
    settings.setOutputSize(QSize(1400, 1000))
    settings.setOutputDpi(110)
    settings.setFlag(QgsMapSettings.Antialiasing, True)
    settings.setExtent(QgsRectangle(view))
    if moment is not None:
        settings.setIsTemporal(True)
        settings.setTemporalRange(QgsDateTimeRange(moment, moment))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    for error in job.errors():
        findings.check(False, f"drawing {error.layerID}: {error.message}")
    image = job.renderedImage().convertToFormat(QImage.Format_RGB32)
    bits = image.constBits()
    bits.setsize(image.sizeInBytes())
    pixels = bytes(bits)
    if path is not None:
        image.save(str(path))
        # Every 997th pixel is enough to tell a map from a blank sheet or a flat colour.
        colours = {pixels[i : i + 4] for i in range(0, len(pixels), 4 * 997)}
        findings.check(len(colours) > 8, f"{path.name} is blank: {len(colours)} colours")
        print(f"  drew {path}")
    return pixels


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="a folder, searched for .qgz files, or one .qgz")
    parser.add_argument("--out", type=Path, help="where the pictures go (a temporary folder when not given)")
    arguments = parser.parse_args()
    projects = sorted(arguments.folder.rglob("*.qgz")) if arguments.folder.is_dir() else [arguments.folder]
    if not projects or not projects[0].is_file():
        print(
            f"{arguments.folder}: no .qgz below it; run `make maps` or `make localize` first", file=sys.stderr
        )
        return 2
    out = arguments.out or Path(tempfile.mkdtemp(prefix="brmgeo-qgis-"))
    out.mkdir(parents=True, exist_ok=True)
    application = QgsApplication([], False)
    application.initQgis()
    print(f"QGIS {Qgis.QGIS_VERSION}")
    findings = Findings()
    for path in projects:
        name = path.stem
        if path != arguments.folder:
            name = "-".join(path.relative_to(arguments.folder).with_suffix("").parts)
        check_project(path, name, out, findings)
    application.exitQgis()
    print("all well" if not findings.failures else f"{findings.failures} wrong")
    return 1 if findings.failures else 0


if __name__ == "__main__":
    sys.exit(main())
