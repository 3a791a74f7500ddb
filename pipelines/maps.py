"""Maps: sheets or other footprints and imagery in; footprints, building mask, ratio maps and their QGIS project out.

The stages, in the order of the data: ``source`` (a generated region makes its own inputs), ``outlines`` (one a file),
``lattice``, ``footprints``, ``imagery``, ``buildings``, ``ratio``, ``overview``.
"""

from __future__ import annotations

import functools
import glob
import hashlib
import json
import math
import os
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from brmgeo.errors import InputError, MissingInputError, SettingsError, WorkflowError
from brmgeo.geo.crs import require_projected_metres
from brmgeo.geo.grid import Bounds, Window, blocks, bounds_of, gsd_of, lattice
from brmgeo.geo.sheets import check_extent, is_sheet_number, sheet_extent, sheet_number_in, sheet_polygon
from brmgeo.geo.tilegrid import grid_named
from brmgeo.region import ImagerySettings, Region
from brmgeo.settings import checked
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.stage import Json, Map, Stage
from brmgeo.workflow.store import Artifact, Input, Step, Store, publish
from pipelines.regions import region_named, town_style, where_to_get

if TYPE_CHECKING:
    from brmgeo.ingest.footprints import Footprints

BLOCK_PX = 2048
MAX_PIXELS = 200_000**2  # 100 x 100 km at 0.5 m: beyond that a stray outline is likelier than a region
MAX_RADIUS_PX = 5_000  # a block's halo, and with it memory, grows with the radius
RASTER_SUFFIXES = (".tif", ".tiff", ".vrt", ".jpg", ".jpeg", ".png", ".jp2", ".img")
VECTOR_SUFFIXES = (".dxf", ".shp", ".gpkg", ".geojson", ".json", ".parquet", ".fgb")
Inputs = Mapping[str, Path]


# --- source: a generated region makes its own inputs ----------------------------------------------------------


def run_source(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes the sheets, the imagery tiles and the manifest of a generated region."""
    from brmgeo.synth.region import write_region

    manifest = write_region(
        out,
        as_bounds(settings["bounds"]),
        settings["seed"],
        settings["sheets"],
        crs=settings["crs"],
        level=settings["level"],
        style=town_style(settings.get("style"), settings.get("season")),
        map=map,
    )
    return {
        "buildings": manifest["buildings"],
        "area_m2": round(manifest["area_m2"], 2),
        "tiles": manifest["tiles"],
    }


# --- outlines: one file of footprints, repaired, in the region's CRS ------------------------------------------


def run_outlines(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Reads one sheet or vector file; writes its footprints, the area they cover and what was repaired."""
    from brmgeo.ingest.footprints import read_footprints
    from brmgeo.ingest.repair import repair_counts

    path = inputs["file"] / settings["member"] if settings["member"] else inputs["file"]
    name = settings["name"]
    read = read_footprints(
        path,
        settings["crs"],
        source_crs=settings["source_crs"],
        layer=settings["layer"],
        encoding=settings["encoding"],
        layers=settings["layers"],
        sheet=settings["sheet"],
        snap_m=settings["snap_m"],
        max_dropped_share=settings["max_dropped_share"],
    )
    if len(read.frame) and not settings["sheet"]:
        check_extent(as_bounds(read.frame.total_bounds), settings["crs"], settings["sheets"], what=name)
    # NGII's shapefiles all have one name: what two of them hold must still be told apart.
    read.frame["source"] = name
    read.sheets["source"] = name
    read.frame.to_parquet(out / "footprints.parquet")
    read.sheets.to_parquet(out / "sheets.parquet")
    repairs = [asdict(r) | {"source": name} for r in read.repairs]
    rest = {"counts": read.counts, "repairs": repairs}
    (out / "rest.json").write_text(json.dumps(rest, ensure_ascii=False), encoding="utf-8")
    examples: dict[str, list[Json]] = {}
    for repair in repairs:
        kept = examples.setdefault(repair["kind"], [])
        if len(kept) < 3:
            kept.append(repair)
    return {
        "file": name,
        "area_m2": round(float(read.frame.area.sum()), 2),
        "dropped_share": round(float(read.sheets["dropped_share"].max()), 6) if len(read.sheets) else 0.0,
        "counts": read.counts,
        "repairs": repair_counts(read.repairs),
        "examples": examples,
    }


def read_outlines(folder: Path) -> Footprints:
    """The footprints that an ``outlines`` artifact holds."""
    import geopandas as gpd

    from brmgeo.ingest.footprints import Footprints
    from brmgeo.ingest.repair import Repair

    rest = json.loads((folder / "rest.json").read_text(encoding="utf-8"))
    return Footprints(
        gpd.read_parquet(folder / "footprints.parquet"),
        gpd.read_parquet(folder / "sheets.parquet"),
        [Repair(**row) for row in rest["repairs"]],
        rest["counts"],
    )


# --- lattice: the region's grid and the area in which the map is known ---------------------------------------


def run_lattice(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes lattice.json: the grid, and the known areas with their names.

    Known is where the sheets lie; without sheets, the bounds; without both, inside the neatlines, or else the bounding
    box of the footprints, and the facts say which.
    """
    crs, gsd_m, bounds = settings["crs"], settings["gsd_m"], settings["bounds"]
    known: list[tuple[str, shapely.Geometry]]
    if settings["sheets"]:
        known, basis = [(s, sheet_polygon(s, crs)) for s in settings["sheets"]], "sheets"
    elif bounds is not None:
        known, basis = [("bounds", shapely.box(*bounds))], "bounds"
    else:
        read = [read_outlines(path) for path in inputs.values()]
        outlines = {r.sheets["outline"].iat[0] for r in read if len(r.sheets)}
        if outlines and outlines <= {"neatline", "number"}:
            known = [
                (r.sheets["sheet"].iat[0] or r.sheets["source"].iat[0], r.sheets.geometry.iat[0])
                for r in read
            ]
            basis = "the files' own sheets (neatline or sheet number)"
        else:
            boxes = [r.frame.total_bounds for r in read if len(r.frame)]
            if not boxes:
                raise InputError(
                    f"{', '.join(inputs)}: no building outline in any of them, so the region has no place; "
                    "check the layers, or give --sheets or --bounds"
                )
            low, high = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
            known = [("bounding box", shapely.box(*low, *high))]
            basis = (
                "bounding box of the footprints; state --sheets or --bounds where the map is known further"
            )
    frame = as_bounds(bounds if bounds is not None else shapely.total_bounds([p for _, p in known]))
    box = lattice(frame, crs, gsd_m)
    if box.shape[0] * box.shape[1] > MAX_PIXELS:
        raise SettingsError(
            f"the region spans {(frame[2] - frame[0]) / 1000:.0f} x {(frame[3] - frame[1]) / 1000:.0f} km by its {basis}, "
            f"{box.shape[1]} x {box.shape[0]} px: too many; state smaller bounds or a larger GSD, or look for stray outlines"
        )
    area = float(shapely.union_all([p for _, p in known]).intersection(shapely.box(*bounds_of(box))).area)
    if area == 0.0:
        raise SettingsError(
            f"the region's bounds {_rounded(frame)} ({crs}) share no ground with its sheets {listed(settings['sheets'])}; "
            "correct the bounds, the sheets or the crs"
        )
    text = {
        "crs": crs,
        "bounds": list(bounds_of(box)),
        "gsd_m": gsd_m,
        "known": [[name, shapely.to_wkt(p, rounding_precision=-1)] for name, p in known],
    }
    (out / "lattice.json").write_text(json.dumps(text), encoding="utf-8")
    return {
        "rows": box.shape[0],
        "cols": box.shape[1],
        "bounds": list(bounds_of(box)),
        "known_area_m2": round(area, 1),
        "known_area_from": basis,
    }


@functools.lru_cache(maxsize=4)
def read_lattice(folder: Path) -> tuple[GeoBox, tuple[tuple[str, shapely.Geometry], ...]]:
    """The lattice that a ``lattice`` artifact holds, and its named known areas."""
    text = json.loads((folder / "lattice.json").read_text(encoding="utf-8"))
    known = tuple((name, shapely.from_wkt(wkt)) for name, wkt in text["known"])
    return lattice(as_bounds(text["bounds"]), text["crs"], text["gsd_m"]), known


# --- footprints: all files together, buildings cut at sheet edges made whole ---------------------------------


def run_footprints(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes footprints.gpkg with the layers footprints, sheets and, when asked for, repairs."""
    from brmgeo.export.footprints import write_footprints_gpkg
    from brmgeo.export.qgis import style_footprints
    from brmgeo.ingest.footprints import combine

    whole = combine([read_outlines(path) for path in inputs.values()])
    if not len(whole.frame):
        raise InputError(
            f"{listed(list(inputs))}: no building outline in any of them; check [footprints] layers"
        )
    write_footprints_gpkg(
        out / "footprints.gpkg",
        whole.frame,
        whole.sheets,
        whole.repairs if settings["repairs_layer"] else None,
    )
    style_footprints(out / "footprints.gpkg")
    return {
        "area_m2": round(_area_of_union(np.asarray(whole.frame.geometry.values)), 2),
        "counts": whole.counts,
        "by_layer": {str(k): int(v) for k, v in whole.frame["layer"].value_counts().sort_index().items()},
    }


def _area_of_union(polygons: NDArray[np.object_]) -> float:
    """What shapely.union_all(polygons).area gives, with only those united that meet another: most stand alone."""
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    meets = np.zeros(len(polygons), dtype=np.bool_)
    meets[a[a != b]] = True
    return float(shapely.area(polygons[~meets]).sum() + shapely.union_all(polygons[meets]).area)


# --- imagery: mosaicked and resampled once onto the lattice ---------------------------------------------------


def run_imagery(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes imagery.tif, block by block."""
    from brmgeo.export.cog import write_cog
    from brmgeo.ingest.imagery import check_imagery

    box, _ = read_lattice(inputs["lattice"])
    source = json.dumps(settings["source"])
    files = settings["source"]["files"]
    root = str(inputs[files[0]].parent if files else inputs["imagery"])
    check_imagery(imagery_sources(source, root), box)
    windows = list(blocks(shape_of(box), BLOCK_PX))
    seen = 0

    def pieces() -> Iterator[tuple[Window, tuple[NDArray[np.uint8], NDArray[np.bool_]]]]:
        nonlocal seen
        work = functools.partial(_imagery_block, source, root, inputs["lattice"])
        for window, block in zip(windows, map(work, windows), strict=True):
            seen += int(block[1].sum())
            yield window, block

    write_cog(
        out / "imagery.tif",
        pieces(),
        box,
        kind="imagery",
        tags=_tags(out, settings),
        lossless=settings["compression"] == "zstd",
    )
    if not seen:
        raise InputError(
            f"imagery in {root} has no pixel inside the region's bounds {_rounded(bounds_of(box))} ({box.crs})"
        )
    return {"known_share": round(seen / (box.shape[0] * box.shape[1]), 6)}


def _imagery_block(source: str, root: str, lattice_dir: Path, window: Window) -> Any:
    from brmgeo.ingest.imagery import mosaic_to_lattice

    box, _ = read_lattice(lattice_dir)
    return mosaic_to_lattice(imagery_sources(source, root), box, window)


@dataclass(frozen=True, slots=True)
class NativeImagery:
    """A region's imagery at its sources' own metres per pixel, cut where it is asked for; small, so that it travels."""

    source: str
    root: str
    crs: str
    gsd_m: float

    def around(self, bounds: Bounds) -> tuple[NDArray[np.uint8], float, float]:
        """(rgb (h, w, 3), left, top) over (left, bottom, right, top); pixels that no source knows are 0."""
        from brmgeo.ingest.imagery import mosaic_to_lattice

        box = lattice(bounds, self.crs, self.gsd_m)
        left, _, _, top = bounds_of(box)
        return mosaic_to_lattice(imagery_sources(self.source, self.root), box)[0], left, top


def native_imagery(region: Region, data: Path) -> NativeImagery | None:
    """The imagery that a built region was made from, where that is finer than its lattice; else None."""
    from brmgeo.ingest.imagery import native_gsd_m

    if region.imagery is None:
        return None
    plan = plan_maps(region, Store(data / "work"), data / "source" / region.name)
    step = plan.steps["imagery"]
    places = {name: i.path if isinstance(i, Step) else Path(i) for name, i in step.inputs.items()}
    source = step.settings["source"]
    root = places[source["files"][0]].parent if source["files"] else places["imagery"]
    box, _ = read_lattice(places["lattice"])
    text = json.dumps(source)
    native = native_gsd_m(imagery_sources(text, str(root)), box)
    steps = math.floor(region.gsd_m / native + 0.05)
    return NativeImagery(text, str(root), region.crs, region.gsd_m / steps) if steps > 1 else None


@functools.lru_cache(maxsize=4)
def imagery_sources(source: str, root: str) -> list[Any]:
    """The adapters that settings of an imagery source describe, over local files below ``root``."""
    from brmgeo.ingest.imagery import GeoRaster, NgiiOrtho
    from brmgeo.ingest.tiles import MBTiles, TileFolder

    settings = json.loads(source)
    base = Path(root)
    if settings["kind"] in ("tiles", "service"):
        folder = base / settings["member"] if settings["member"] else base
        grid, ratio = grid_named(settings["grid"]), settings.get("pixel_ratio", 1)
        return [TileFolder(folder, grid, settings["level"], settings["template"], pixel_ratio=ratio)]
    if settings["kind"] == "mbtiles":
        return [MBTiles.open(base, settings["level"], settings.get("pixel_ratio", 1))]
    found: list[Any] = []
    for path in (base / name for name in settings["files"]):
        number = sheet_number_in(path.name)
        limits = None if settings["value_range"] is None else tuple(settings["value_range"])
        bands = None if settings["bands"] is None else tuple(settings["bands"])
        if number is not None and not _is_placed(path):
            found.append(NgiiOrtho(path, number, value_range=limits))
        else:
            found.append(GeoRaster(path, crs=settings["crs"], bands=bands, value_range=limits))
    return found


def _is_placed(path: Path) -> bool:
    """Whether a raster says where it lies, by its own header or a world file beside it."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.open(path) as src:
                return not src.transform.is_identity or bool(src.gcps[0])
        except RasterioError:
            return True  # the adapter says what is wrong with it


# --- buildings and ratio maps, block by block straight from the footprints ------------------------------------


def run_buildings(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes buildings.tif: 0, 1, and 255 where the map is not known."""
    from brmgeo.export.cog import write_cog

    box, _ = read_lattice(inputs["lattice"])
    windows = list(blocks(shape_of(box), BLOCK_PX))
    work = functools.partial(building_block, inputs["footprints"], inputs["lattice"])
    built = known = 0

    def pieces() -> Iterator[tuple[Window, NDArray[np.uint8]]]:
        nonlocal built, known
        for window, block in zip(windows, map(work, windows), strict=True):
            built += int((block == 1).sum())
            known += int((block != 255).sum())
            yield window, block

    colours = {0: (0, 0, 0, 0), 1: (214, 69, 65, 255), 255: (160, 160, 160, 255)}
    write_cog(out / "buildings.tif", pieces(), box, kind="mask", tags=_tags(out, settings), colormap=colours)
    pixel = gsd_of(box) ** 2
    return {
        "building_area_m2": round(built * pixel, 2),
        "known_area_m2": round(known * pixel, 2),
        "building_share": round(built / known, 6) if known else None,
    }


def building_block(footprints_dir: Path, lattice_dir: Path, window: Window) -> NDArray[np.uint8]:
    """(h, w) uint8 building mask of one window, read from the footprints that touch it."""
    from pyogrio.raw import read as read_raw

    from brmgeo.maps.rasterize import mask_window

    box, known = read_lattice(lattice_dir)
    own = bounds_of(window.box_in(box))
    reach = gsd_of(box)
    touched = (own[0] - reach, own[1] - reach, own[2] + reach, own[3] + reach)
    wkb = read_raw(footprints_dir / "footprints.gpkg", layer="footprints", columns=[], bbox=touched)[2]
    return mask_window(shapely.from_wkb(wkb), [p for _, p in known], window.box_in(box))


def run_ratio(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes ratio.tif, one band a radius, largest first."""
    from brmgeo.export.cog import write_cog

    box, _ = read_lattice(inputs["lattice"])
    radii_m = tuple(settings["radii_m"])
    windows = list(blocks(shape_of(box), BLOCK_PX))
    work = functools.partial(ratio_block, inputs["footprints"], inputs["lattice"], radii_m)
    statistics = write_cog(
        out / "ratio.tif",
        zip(windows, map(work, windows), strict=True),
        box,
        kind="ratio",
        radii_m=radii_m,
        tags=_tags(out, settings),
    )
    return {
        "radii_m": list(radii_m),
        "mean": [round(s.mean, 6) if s.mean is not None else None for s in statistics],
    }


def ratio_block(
    footprints_dir: Path, lattice_dir: Path, radii_m: Sequence[float], window: Window
) -> NDArray[np.uint16]:
    """(n, h, w) uint16 ratio maps of one window, counted over a halo as wide as the largest disc."""
    from brmgeo.maps.ratio import halo_px, ratio_maps

    box, _ = read_lattice(lattice_dir)
    radii_px = [r / gsd_of(box) for r in radii_m]
    halo = max(halo_px(r) for r in radii_px)
    mask = building_block(footprints_dir, lattice_dir, window.padded(halo))
    maps = ratio_maps(mask, radii_px)
    return np.ascontiguousarray(maps[:, halo : halo + window.height, halo : halo + window.width])


# --- overview: what a person opens first ----------------------------------------------------------------------


def run_overview(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes the QGIS project and preview.png."""
    from brmgeo.export.preview import write_preview
    from brmgeo.export.qgis import write_maps_project

    imagery = inputs["imagery"] / "imagery.tif" if "imagery" in inputs else None
    buildings, ratio = inputs["buildings"] / "buildings.tif", inputs["ratio"] / "ratio.tif"
    write_maps_project(
        out / f"{settings['name']}.qgz",
        title=settings["title"],
        footprints=inputs["footprints"] / "footprints.gpkg",
        buildings=buildings,
        ratio=ratio,
        imagery=imagery,
        attribution=settings["attribution"],
    )
    write_preview(
        out / "preview.png",
        imagery=imagery,
        buildings=buildings,
        ratio=ratio,
        title=settings["title"],
        attribution=settings["attribution"],
    )
    return {}


SOURCE = Stage("source", 2, run_source)
OUTLINES = Stage("outlines", 1, run_outlines)
LATTICE = Stage("lattice", 1, run_lattice)
FOOTPRINTS = Stage("footprints", 1, run_footprints)
IMAGERY = Stage("imagery", 1, run_imagery)
BUILDINGS = Stage("buildings", 1, run_buildings)
RATIO = Stage("ratio", 1, run_ratio)
OVERVIEW = Stage("overview", 1, run_overview)

PUBLISHED = {
    "footprints": "footprints.gpkg",
    "imagery": "imagery.tif",
    "buildings": "buildings.tif",
    "ratio": "ratio.tif",
}


# --- the plan of a region -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SourceFile:
    """One source of footprints: its files (``file`` and what belongs to it) or the folder that holds it as ``member``,
    a name of its own among all, and the sheet that its path states."""

    inputs: Mapping[str, Input]
    member: str
    name: str
    sheet: str | None


def plan_maps(region: Region, store: Store, source_dir: Path, fetch: bool = False) -> Plan:
    """The steps of a region's maps; with ``fetch`` the tiles of a service that the user named are fetched for it.

    Raises MissingInputError (which files or tiles, where they go, where to get them).
    """
    require_projected_metres(region.crs)
    for number in region.sheets:
        if not is_sheet_number(number):
            raise SettingsError(
                f"region {region.name}: sheets: {number!r} is not an NGII sheet number of 5 to 9 digits, such as 36914093"
            )
    widest = max(region.ratio.radii())
    if widest > MAX_RADIUS_PX * region.gsd_m:
        raise SettingsError(
            f"region {region.name}: the largest radius of the ratio maps is {widest:g} m; at most {MAX_RADIUS_PX} px, here "
            f"{MAX_RADIUS_PX * region.gsd_m:g} m, are possible: give smaller radii or a larger gsd_m"
        )
    plan = Plan(store, region.name)
    place = region.bounds
    generated: Step | None = None
    if region.generate is not None:
        if not region.sheets:
            raise SettingsError(
                f"region {region.name}: [generate] needs sheets, which the buildings are drawn on"
            )
        bounds = place_of(region)
        generated = plan.add(
            SOURCE,
            {},
            {
                "seed": region.generate.seed,
                "sheets": region.sheets,
                "bounds": bounds,
                "crs": region.crs,
                "level": (region.imagery.level if region.imagery else None) or 1,
                # Only where they are given: a region without them keeps its key.
                **region.generate.model_dump(include={"style", "season"}, exclude_none=True),
            },
        )
    files = _generated_files(region, generated) if generated else find_sources(region, source_dir)
    own = region.footprints
    outlines: dict[str, Step] = {}
    for file in files:
        label = f"outlines {file.sheet or file.name}"
        label = label if label not in outlines else f"outlines {file.name}"
        settings = {
            "member": file.member,
            "name": file.name,
            "crs": region.crs,
            "sheet": file.sheet,
            "sheets": region.sheets,
            "layers": own.layers,
            "snap_m": own.snap_m,
            "max_dropped_share": own.max_dropped_share,
            "source_crs": own.crs,
            "layer": own.layer,
            "encoding": own.encoding,
        }
        outlines[label] = plan.add(OUTLINES, file.inputs, settings, label)
    by_name = {label.removeprefix("outlines "): step for label, step in outlines.items()}
    stated = bool(region.sheets) or place is not None
    grid = plan.add(
        LATTICE,
        {} if stated else by_name,
        {"crs": region.crs, "gsd_m": region.gsd_m, "bounds": place, "sheets": region.sheets},
    )
    footprints = plan.add(
        FOOTPRINTS,
        by_name,
        {"repairs_layer": own.repairs_layer},
    )
    attribution = credits(region)
    metadata = {"region": region.name, "attribution": own.attribution, "terms": ""}
    imagery: Step | None = None
    if region.imagery is not None:
        given = region.imagery
        sources, settings = (
            ({"imagery": generated}, _imagery_settings(given, "tiles"))
            if generated
            else _imagery_inputs(region, given, source_dir, fetch)
        )
        imagery = plan.add(
            IMAGERY,
            {"lattice": grid, **sources},
            {
                "source": settings,
                "compression": given.compression,
                "region": region.name,
                "attribution": given.attribution,
                "terms": given.terms,
            },
        )
    buildings = plan.add(BUILDINGS, {"lattice": grid, "footprints": footprints}, metadata)
    ratio = plan.add(
        RATIO, {"lattice": grid, "footprints": footprints}, {"radii_m": region.ratio.radii(), **metadata}
    )
    inputs: dict[str, Input] = {"footprints": footprints, "buildings": buildings, "ratio": ratio}
    if imagery is not None:
        inputs["imagery"] = imagery
    plan.add(
        OVERVIEW,
        inputs,
        {"name": region.name, "title": region.title or region.name, "attribution": attribution},
    )
    return plan


def find_sources(region: Region, source_dir: Path) -> list[SourceFile]:
    """The files that a region's footprint paths name; raises MissingInputError for sheets without a file."""
    own = region.footprints
    found: dict[Path, None] = {}
    for pattern in own.paths:
        if not pattern:
            raise SettingsError(
                f"region {region.name}: footprints.paths holds an empty path; name a file or a pattern"
            )
        anchor = Path(pattern).anchor
        below = (Path(anchor) if anchor else source_dir).glob(pattern[len(anchor) :])
        found |= dict.fromkeys(sorted(p for p in below if not p.name.startswith(".") and p.is_file()))
    alike = Counter(p.name for p in found)
    files = [
        SourceFile(
            _parts_of(p),
            "",
            p.name if alike[p.name] == 1 else f"{p.parent.name}/{p.name}",
            _number_of(p, region),
        )
        for p in found
    ]
    if len({f.name for f in files}) < len(files):
        raise SettingsError(
            f"region {region.name}: several footprint files are called {_twice(f.name for f in files)}; "
            "rename their folders or put them together"
        )
    covered = {f.sheet for f in files}
    missing = [s for s in region.sheets if s not in covered]
    if missing and (not files or covered != {None}):
        first = missing[0]
        places = " or ".join(own.paths)
        raise MissingInputError(
            f"region {region.name}: {len(missing)} of {len(region.sheets)} sheets are missing: {listed(missing, 12)}; "
            f"put files named like {first}.dxf into {source_dir} ({places}); get them from {where_to_get(first)}"
        )
    if not files:
        raise MissingInputError(
            f"region {region.name}: no footprints at {source_dir} matching {' or '.join(own.paths)}; put building outlines "
            "there (DXF, shapefile, GeoPackage, GeoJSON, GeoParquet) or correct [footprints] paths"
        )
    return files


def missing_sources(name: str, data: Path) -> list[str]:
    """What a new region still wants, in lines for a person; empty when all its inputs are there."""
    region, data = region_named(name, data)
    try:
        if region.generate is None:
            find_sources(region, data / "source" / region.name)
    except MissingInputError as error:
        return [str(error)]
    return []


def _twice(names: Iterable[str]) -> str:
    return Counter(names).most_common(1)[0][0]


def _parts_of(path: Path) -> dict[str, Input]:
    """The file and, of a shapefile, those that belong to it: the key covers them all."""
    parts: dict[str, Input] = {"file": path}
    if path.suffix.lower() == ".shp":
        for beside in sorted(path.parent.glob(f"{glob.escape(path.stem)}.*")):
            if beside.suffix.lower() in (".shx", ".dbf", ".prj", ".cpg"):
                parts[beside.suffix.lower()] = beside
    return parts


def _number_of(path: Path, region: Region) -> str | None:
    """The sheet that a file's name (or, of NGII's shapefiles, its folder's) states: the region's, else any it could be."""
    for name in (path.name, path.parent.name):
        for number in sorted(region.sheets, key=len, reverse=True):
            if number in name:
                return number
    return sheet_number_in(path.name) if path.suffix.lower() == ".dxf" else None


def _generated_files(region: Region, source: Step) -> list[SourceFile]:
    return [SourceFile({"file": source}, f"sheets/{s}.dxf", f"{s}.dxf", s) for s in region.sheets]


def _imagery_settings(given: ImagerySettings, member: str = "", files: Sequence[str] = ()) -> dict[str, Json]:
    return {
        "kind": given.kind,
        "grid": given.grid,
        "level": given.level,
        "template": given.template,
        "member": member,
        "files": list(files),
        "crs": given.crs,
        "value_range": given.value_range,
        "bands": given.bands,
        # Only where it is stated, so that what was made before there was a choice stays fresh.
        **({"pixel_ratio": given.pixel_ratio} if given.pixel_ratio != 1 else {}),
    }


def _imagery_inputs(
    region: Region, given: ImagerySettings, source_dir: Path, fetch: bool
) -> tuple[dict[str, Input], dict[str, Json]]:
    """The local files of an imagery source, by name, and what the stage must know of them."""
    path = source_dir / given.path
    if given.kind == "service":
        cache = _service_tiles(region, given, source_dir, fetch)
        return {"imagery": cache}, _imagery_settings(given)
    if given.kind == "raster":
        files = _rasters(region, path)
        inputs: dict[str, Input] = {p.name: p for file in files for p in (file, *_beside(file))}
        return inputs, _imagery_settings(given, files=[f.name for f in files])
    if not path.exists():
        raise MissingInputError(
            f"region {region.name}: imagery is missing: {path} is not there; put "
            f"{'a folder of tiles' if given.kind == 'tiles' else 'the MBTiles file'} there (grid {given.grid}, level "
            f"{given.level}{_tile_range(region, given)}), or take [imagery] out of the region file"
        )
    from brmgeo.ingest.tiles import MBTiles, TileFolder, TileSource, ensure_tiles

    source: TileSource
    if given.kind == "mbtiles":
        source = MBTiles.open(path, given.level, given.pixel_ratio)
    else:
        assert given.level is not None
        source = TileFolder(
            path, grid_named(given.grid), given.level, given.template, pixel_ratio=given.pixel_ratio
        )
    ensure_tiles(source, place_of(region), region.crs, missing_ok=given.missing_share)
    return {"imagery": path}, _imagery_settings(given)


def _tile_range(region: Region, given: ImagerySettings) -> str:
    if given.kind != "tiles" or given.level is None:
        return ""
    tiles = grid_named(given.grid).covering(place_of(region), region.crs, given.level)
    xs, ys = [t.x for t in tiles], [t.y for t in tiles]
    return f": {len(tiles)} tiles, x {min(xs)}-{max(xs)}, y {min(ys)}-{max(ys)}"


def _service_tiles(region: Region, given: ImagerySettings, source_dir: Path, fetch: bool) -> Path:
    """The folder in which the tiles of a service are kept, filled when asked for."""
    from brmgeo.ingest.tiles import TileService, ensure_tiles

    assert given.url is not None
    assert given.level is not None
    name = f"{given.grid}-{given.level}-{hashlib.sha256(given.url.encode()).hexdigest()[:8]}"
    cache = source_dir / "cache" / name
    if not fetch:
        if not cache.is_dir():
            raise MissingInputError(
                f"region {region.name}: no tile of {given.url} has been fetched yet; "
                f"`brmgeo maps {region.name}` fetches them into {cache}"
            )
        return cache
    service = TileService(
        given.url,
        grid_named(given.grid),
        given.level,
        cache,
        max_connections=given.connections,
        rate_per_s=given.rate_per_s,
        retries=given.retries,
        timeout_s=given.timeout_s,
        key_env=given.key_env,
        attribution=given.attribution,
        terms=given.terms,
        missing_ok=given.missing_share,
        pixel_ratio=given.pixel_ratio,
    )
    with Progress().stage("imagery tiles") as bar:
        ensure_tiles(service, place_of(region), region.crs, progress=bar.update)
    return cache


def _rasters(region: Region, path: Path) -> list[Path]:
    """The images that a path, pattern or folder names; all in one folder."""
    if path.is_file():
        return [path]
    found = path.iterdir() if path.is_dir() else path.parent.glob(path.name)
    files = sorted(f for f in found if f.suffix.lower() in RASTER_SUFFIXES and not f.name.startswith("."))
    if not files:
        raise MissingInputError(
            f"region {region.name}: imagery is missing: no image ({', '.join(RASTER_SUFFIXES)}) at {path}; put GeoTIFFs, "
            "rasters with world files or NGII ortho there, or take [imagery] out of the region file"
        )
    return files


def _beside(image: Path) -> list[Path]:
    """What else says where an image lies and how it looks: world files, .prj, .aux.xml, .ovr and the like."""
    stem = glob.escape(image.stem)
    return sorted(
        p
        for p in image.parent.glob(f"{stem}.*")
        if p != image and p.is_file() and p.suffix.lower() not in (*RASTER_SUFFIXES, *VECTOR_SUFFIXES)
    )


def place_of(region: Region) -> Bounds:
    """(left, bottom, right, top) that a region covers: its bounds, else those of its sheets."""
    return as_bounds(region.bounds) if region.bounds is not None else _sheets_bounds(region)


def _sheets_bounds(region: Region) -> Bounds:
    extents = np.array([sheet_extent(s, region.crs) for s in region.sheets])
    return as_bounds([*extents[:, :2].min(axis=0), *extents[:, 2:].max(axis=0)])


def credits(region: Region) -> str:
    parts = [region.footprints.attribution, region.imagery.attribution if region.imagery else ""]
    return "; ".join(dict.fromkeys(p for p in parts if p))


# --- the jobs that the command line calls ---------------------------------------------------------------------


def build_region(name: str, data: Path, out: Path | None, repairs: bool, scheduler_spec: str | None) -> Path:
    """Builds all maps of a region below ``data`` and publishes them; the folder they are in."""
    region, data = region_named(name, data)
    if repairs:
        region = region.model_copy(
            update={"footprints": region.footprints.model_copy(update={"repairs_layer": True})}
        )
    target = out or data / "out" / region.name
    return build_maps(region, data / "work", target, data / "source" / region.name, scheduler_spec)


def build_maps(
    region: Region, store_dir: Path, out: Path, source_dir: Path, scheduler_spec: str | None
) -> Path:
    """Builds what is missing of a region's maps in the store and publishes everything in ``out``."""
    progress = Progress()
    require_writable(out)
    store = Store(store_dir)
    with store.lock(region.name):
        plan = plan_maps(region, store, source_dir, fetch=True)
        with scheduler(scheduler_spec, shared=store.root, say=progress.say) as map:
            made = plan.build(map, progress)
        if "source" in made:
            publish(made["source"], source_dir, _source_names(made["source"]))
        for label, name in PUBLISHED.items():
            if label in made:
                publish(made[label], out, [name])
        publish(made["overview"], out, [f"{region.name}.qgz", "preview.png"])
        _write_facts(region, made, out / "maps.json")
    fresh = [label for label, artifact in made.items() if artifact.fresh]
    if fresh:
        progress.say(f"{region.name}: made {', '.join(fresh)}; results are in {out}")
    else:
        progress.say(f"{region.name}: nothing to do, all {len(made)} stages are fresh; results are in {out}")
    return out


def require_writable(out: Path) -> None:
    """Raises WorkflowError at once rather than after all the work."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        reason = (
            "a file stands there"
            if isinstance(error, (FileExistsError, NotADirectoryError))
            else error.strerror
        )
        raise WorkflowError(f"results cannot be written to {out} ({reason}); choose another place") from None


def _source_names(source: Artifact) -> list[str]:
    return sorted({name.split("/")[0] for name in source.record["outputs"]})


def _write_facts(region: Region, made: Mapping[str, Artifact], path: Path) -> None:
    """maps.json: the facts of every stage, from their records, so that a run with nothing to do changes nothing."""
    facts = {
        "region": region.name,
        "title": region.title,
        "crs": region.crs,
        "gsd_m": region.gsd_m,
        "attribution": credits(region),
        "imagery_terms": region.imagery.terms if region.imagery else "",
        "stages": {
            label: {
                "key": artifact.key,
                "facts": artifact.facts,
                "seconds": artifact.record.get("seconds"),
            }
            for label, artifact in made.items()
        },
    }
    text = json.dumps(facts, indent=1, ensure_ascii=False) + "\n"
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def region_of_files(
    out: Path,
    footprints: Sequence[Path],
    crs: str,
    imagery: Path | None,
    sheets: str | None,
    bounds: Sequence[float] | None,
    gsd_m: float,
    radii_m: Sequence[float] | None,
    layer: str | None,
    encoding: str | None,
    source_crs: str | None,
    repairs: bool,
) -> Region:
    """A region without a region file, for ``brmgeo maps --footprints``; raises MissingInputError for absent files."""
    for path in (*footprints, *([imagery] if imagery else [])):
        if not path.exists():
            raise MissingInputError(f"maps --footprints: {path} is not there; correct the path")
    numbers = tuple(s.strip() for s in sheets.split(",") if s.strip()) if sheets else ()
    files = dict.fromkeys(p.absolute() for path in footprints for p in _files_of(path))
    name = out.absolute().name
    asked: dict[str, Any] = {
        "name": safe_name(name),
        "title": name,
        "crs": crs.upper(),
        "gsd_m": gsd_m,
        "bounds": None if bounds is None else tuple(bounds),
        "sheets": numbers,
        "footprints": {
            "paths": tuple(glob.escape(str(p)) for p in files),
            "layer": layer,
            "encoding": encoding,
            "crs": source_crs,
            "repairs_layer": repairs,
        },
        "imagery": None if imagery is None else {"kind": "raster", "path": str(imagery.absolute())},
    }
    if radii_m is not None:
        asked["ratio"] = {"radii_m": tuple(radii_m)}
    # A region file must say where the region is; here the footprints may.
    placeless = bounds is None and not numbers
    if placeless:
        asked["bounds"] = (0.0, 0.0, 1.0, 1.0)
    region = checked(Region, asked, "maps --footprints")
    return region.model_copy(update={"bounds": None}) if placeless else region


def _files_of(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = [p for p in sorted(path.iterdir()) if p.suffix.lower() in VECTOR_SUFFIXES]
    if not files:
        raise MissingInputError(
            f"maps --footprints: {path} holds no footprints ({', '.join(VECTOR_SUFFIXES)})"
        )
    return files


def safe_name(text: str) -> str:
    """The text as the name of a region or folder: ASCII letters, digits, - and _."""
    name = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in text).strip("-_")
    return name[:64] or "region"


def status_lines(name: str, data: Path, verify: bool = False) -> list[str]:
    """One line a stage, and a reason below each that is not fresh."""
    region, data = region_named(name, data)
    plan = plan_maps(region, Store(data / "work"), data / "source" / region.name)
    lines = []
    for step in plan.status(verify):
        lines.append(f"{step.label:<24} {step.state:<8} {step.key[:12]}")
        lines += [f"    {reason}" for reason in step.reasons]
    return lines


def why_lines(name: str, stage: str, data: Path) -> list[str]:
    """Why a stage of a region would run, or that it would not."""
    region, data = region_named(name, data)
    return plan_maps(region, Store(data / "work"), data / "source" / region.name).why(stage)


def _tags(out: Path, settings: Json) -> dict[str, str]:
    from brmgeo.export.cog import output_tags

    return output_tags(out.name, settings["region"], settings["attribution"], settings["terms"])


def shape_of(box: GeoBox) -> tuple[int, int]:
    """(rows, cols) of a lattice."""
    return int(box.shape[0]), int(box.shape[1])


def as_bounds(values: Any) -> Bounds:
    """Four values of a JSON file as (left, bottom, right, top)."""
    left, bottom, right, top = (float(v) for v in values)
    return (left, bottom, right, top)


def _rounded(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(v, 1) for v in values)


def listed(names: Sequence[str], most: int = 4) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
