"""The stages of a region's maps, in the order of the data: what each computes, and the settings that make its key.

``source`` (a generated region makes its own inputs), ``outlines`` (one a file), ``lattice``, ``footprints``, ``imagery``,
``buildings``, ``ratio``, ``overview``.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from brmgeo.codes import BUILDING, OTHER, UNKNOWN
from brmgeo.errors import InputError, SettingsError, listed
from brmgeo.files import json_of
from brmgeo.geo.crs import require_meeting
from brmgeo.geo.grid import Bounds, Window, as_bounds, blocks, bounds_of, gsd_of, lattice, shape_of
from brmgeo.geo.sheets import check_extent, sheet_polygon
from brmgeo.workflow.stage import Json, Map, Stage, unstated

from .map_sources import ImageryFiles, imagery_sources
from .regions import town_style

if TYPE_CHECKING:
    from brmgeo.ingest.footprints import Footprints

BLOCK_PX = 2048
MAX_PIXELS = 200_000**2  # 100 x 100 km at 0.5 m: beyond that a stray outline is likelier than a region
Inputs = Mapping[str, Path]


# --- source: a generated region makes its own inputs ----------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """The ground that is generated, and its recipe: see [generate] of a region file."""

    seed: int
    sheets: tuple[str, ...]
    bounds: Bounds
    crs: str
    level: int
    # A region without them keeps its key.
    style: int | None = unstated(None)
    season: str | None = unstated(None)


def run_source(inputs: Inputs, out: Path, settings: SourceSettings, map: Map) -> Json:
    """Writes the sheets, the imagery tiles and the manifest of a generated region."""
    from brmgeo.synth.region import write_region

    manifest = write_region(
        out,
        settings.bounds,
        settings.seed,
        settings.sheets,
        crs=settings.crs,
        level=settings.level,
        style=town_style(settings.style, settings.season),
        map=map,
    )
    return {
        "buildings": manifest["buildings"],
        "area_m2": round(manifest["area_m2"], 2),
        "tiles": manifest["tiles"],
    }


# --- outlines: one file of footprints, repaired, in the region's CRS ------------------------------------------


@dataclass(frozen=True, slots=True)
class OutlinesSettings:
    """One file of footprints (``member`` of the input where that is a folder), the sheet that it is, if any, and how it is
    read: see [footprints] of a region file."""

    member: str
    name: str
    crs: str
    sheet: str | None
    sheets: tuple[str, ...]
    layers: tuple[str, ...]
    snap_m: float
    max_dropped_share: float
    source_crs: str | None
    layer: str | None
    encoding: str | None


def run_outlines(inputs: Inputs, out: Path, settings: OutlinesSettings, map: Map) -> Json:
    """Reads one sheet or vector file; writes its footprints, the area they cover and what was repaired."""
    from brmgeo.ingest.footprints import read_footprints
    from brmgeo.ingest.repair import repair_counts

    path = inputs["file"] / settings.member if settings.member else inputs["file"]
    name = settings.name
    read = read_footprints(
        path,
        settings.crs,
        source_crs=settings.source_crs,
        layer=settings.layer,
        encoding=settings.encoding,
        layers=settings.layers,
        sheet=settings.sheet,
        snap_m=settings.snap_m,
        max_dropped_share=settings.max_dropped_share,
    )
    if len(read.frame) and not settings.sheet:
        check_extent(as_bounds(read.frame.total_bounds), settings.crs, settings.sheets, what=name)
    # NGII's shapefiles all have one name: what two of them hold must still be told apart.
    read.frame["source"] = name
    read.sheets["source"] = name
    read.frame.to_parquet(out / "footprints.parquet")
    read.sheets.to_parquet(out / "sheets.parquet")
    repairs = [asdict(r) | {"source": name} for r in read.repairs]
    notes = [f"{name}: {note}" for note in read.notes]
    rest = {"counts": read.counts, "repairs": repairs, **({} if len(read.frame) else {"notes": notes})}
    (out / "rest.json").write_text(json.dumps(rest, ensure_ascii=False), encoding="utf-8")
    examples: dict[str, list[Json]] = {}
    for repair in repairs:
        kept = examples.setdefault(repair["kind"], [])
        if len(kept) < 3:
            # What has no vertex lies nowhere.
            kept.append(repair | {k: None for k in ("x", "y") if not math.isfinite(repair[k])})
    return {
        "file": name,
        "area_m2": round(float(read.frame.area.sum()), 2),
        "dropped_share": round(float(read.sheets["dropped_share"].max()), 6) if len(read.sheets) else 0.0,
        "counts": read.counts,
        "repairs": repair_counts(read.repairs),
        "examples": examples,
        **({"notes": notes} if notes else {}),
    }


def read_outlines(folder: Path) -> Footprints:
    """The footprints that an ``outlines`` artifact holds."""
    import geopandas as gpd

    from brmgeo.ingest.footprints import Footprints
    from brmgeo.ingest.repair import Repair

    rest = json_of((folder / "rest.json").read_bytes())
    return Footprints(
        gpd.read_parquet(folder / "footprints.parquet"),
        gpd.read_parquet(folder / "sheets.parquet"),
        [Repair(**row) for row in rest["repairs"]],
        rest["counts"],
        rest.get("notes", []),  # of a file without footprints, to say why
    )


# --- lattice: the region's grid and the area in which the map is known ---------------------------------------


@dataclass(frozen=True, slots=True)
class LatticeSettings:
    """The region's grid, and its place as far as it is stated."""

    crs: str
    gsd_m: float
    bounds: Bounds | None
    sheets: tuple[str, ...]


def run_lattice(inputs: Inputs, out: Path, settings: LatticeSettings, map: Map) -> Json:
    """Writes lattice.json: the grid, and the known areas with their names.

    Known is where the sheets lie; without sheets, the bounds; without both, inside the neatlines, or else the bounding
    box of the footprints, and the facts say which.
    """
    crs, gsd_m, bounds = settings.crs, settings.gsd_m, settings.bounds
    known, basis = _known_ground(inputs, settings)
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
            f"the region's bounds {_rounded(frame)} ({crs}) share no ground with its sheets {listed(settings.sheets)}; "
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


def _known_ground(
    inputs: Inputs, settings: LatticeSettings
) -> tuple[list[tuple[str, shapely.Geometry]], str]:
    """The known areas with their names, and what they were taken from."""
    if settings.sheets:
        return [(s, sheet_polygon(s, settings.crs)) for s in settings.sheets], "sheets"
    if settings.bounds is not None:
        return [("bounds", shapely.box(*settings.bounds))], "bounds"
    read = [read_outlines(path) for path in inputs.values()]
    outlines = {r.sheets["outline"].iat[0] for r in read if len(r.sheets)}
    if outlines and outlines <= {"neatline", "number"}:
        known = [
            (r.sheets["sheet"].iat[0] or r.sheets["source"].iat[0], r.sheets.geometry.iat[0]) for r in read
        ]
        return known, "the files' own sheets (neatline or sheet number)"
    boxes = [r.frame.total_bounds for r in read if len(r.frame)]
    if not boxes:
        raise InputError(
            f"{', '.join(inputs)}: no building outline in any of them, so the region has no place; "
            f"check the layers, or give --sheets or --bounds{_why_none(n for r in read for n in r.notes)}"
        )
    low, high = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
    basis = "bounding box of the footprints; state --sheets or --bounds where the map is known further"
    return [("bounding box", shapely.box(*low, *high))], basis


@functools.lru_cache(maxsize=4)
def read_lattice(folder: Path) -> tuple[GeoBox, tuple[tuple[str, shapely.Geometry], ...]]:
    """The lattice that a ``lattice`` artifact holds, and its named known areas."""
    text = json_of((folder / "lattice.json").read_bytes())
    known = tuple((name, shapely.from_wkt(wkt)) for name, wkt in text["known"])
    return lattice(as_bounds(text["bounds"]), text["crs"], text["gsd_m"]), known


# --- footprints: all files together, buildings cut at sheet edges made whole ---------------------------------


@dataclass(frozen=True, slots=True)
class CombineSettings:
    """What footprints.gpkg holds besides footprints and sheets."""

    repairs_layer: bool


def run_footprints(inputs: Inputs, out: Path, settings: CombineSettings, map: Map) -> Json:
    """Writes footprints.gpkg with the layers footprints, sheets and, when asked for, repairs."""
    from brmgeo.export.footprints import write_footprints_gpkg
    from brmgeo.export.qgis import style_footprints
    from brmgeo.ingest.footprints import combine

    whole = combine([read_outlines(path) for path in inputs.values()])
    if not len(whole.frame):
        raise InputError(
            f"{listed(list(inputs))}: no building outline in any of them; check [footprints] layers"
            f"{_why_none(whole.notes)}"
        )
    write_footprints_gpkg(
        out / "footprints.gpkg",
        whole.frame,
        whole.sheets,
        whole.repairs if settings.repairs_layer else None,
    )
    style_footprints(out / "footprints.gpkg")
    return {
        "area_m2": round(_area_of_union(np.asarray(whole.frame.geometry.values)), 2),
        "counts": whole.counts,
        "by_layer": {str(k): int(v) for k, v in whole.frame["layer"].value_counts().sort_index().items()},
    }


def _why_none(notes: Iterable[str]) -> str:
    told = list(notes)
    return f" ({'; '.join(told[:2])})" if told else ""


def _area_of_union(polygons: NDArray[np.object_]) -> float:
    """What shapely.union_all(polygons).area gives, with only those united that meet another: most stand alone."""
    a, b = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    meets = np.zeros(len(polygons), dtype=np.bool_)
    meets[a[a != b]] = True
    return float(shapely.area(polygons[~meets]).sum() + shapely.union_all(polygons[meets]).area)


# --- what every raster says of itself -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """The metadata of a raster: whose it is and how it may be used."""

    region: str
    attribution: str
    terms: str

    def tags(self, out: Path) -> dict[str, str]:
        """The tags of a raster in the folder ``out`` of an artifact."""
        from brmgeo.export.cog import output_tags

        return output_tags(out.name, self.region, self.attribution, self.terms)


# --- imagery: mosaicked and resampled once onto the lattice ---------------------------------------------------


@dataclass(frozen=True, slots=True)
class MosaicSettings(RasterSettings):
    """Where imagery comes from and how it is kept."""

    source: ImageryFiles
    compression: str


def run_imagery(inputs: Inputs, out: Path, settings: MosaicSettings, map: Map) -> Json:
    """Writes imagery.tif, block by block."""
    from brmgeo.export.cog import write_cog
    from brmgeo.ingest.imagery import check_imagery

    box, _ = read_lattice(inputs["lattice"])
    source, root = settings.source, settings.source.root(inputs)
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
        tags=settings.tags(out),
        lossless=settings.compression == "zstd",
    )
    if not seen:
        raise InputError(
            f"imagery in {root} has no pixel inside the region's bounds {_rounded(bounds_of(box))} ({box.crs})"
        )
    return {"known_share": round(seen / (box.shape[0] * box.shape[1]), 6)}


def _imagery_block(
    source: ImageryFiles, root: Path, lattice_dir: Path, window: Window
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    from brmgeo.ingest.imagery import mosaic_to_lattice

    box, _ = read_lattice(lattice_dir)
    return mosaic_to_lattice(imagery_sources(source, root), box, window)


# --- buildings and ratio maps, block by block straight from the footprints ------------------------------------


def run_buildings(inputs: Inputs, out: Path, settings: RasterSettings, map: Map) -> Json:
    """Writes buildings.tif: 0, 1, and 255 where the map is not known.

    CrsError where no outline lies within the lattice: that would be a map which knows that nothing is built.
    """
    import pyogrio

    from brmgeo.export.cog import write_cog

    box, _ = read_lattice(inputs["lattice"])
    footprints = inputs["footprints"] / "footprints.gpkg"
    there = {footprints.name: as_bounds(pyogrio.read_info(footprints, layer="footprints")["total_bounds"])}
    require_meeting("building outline", there, "the region's bounds", bounds_of(box), str(box.crs))
    windows = list(blocks(shape_of(box), BLOCK_PX))
    work = functools.partial(building_block, inputs["footprints"], inputs["lattice"])
    built = known = 0

    def pieces() -> Iterator[tuple[Window, NDArray[np.uint8]]]:
        nonlocal built, known
        for window, block in zip(windows, map(work, windows), strict=True):
            built += int((block == BUILDING).sum())
            known += int((block != UNKNOWN).sum())
            yield window, block

    colours = {OTHER: (0, 0, 0, 0), BUILDING: (214, 69, 65, 255), UNKNOWN: (160, 160, 160, 255)}
    write_cog(out / "buildings.tif", pieces(), box, kind="mask", tags=settings.tags(out), colormap=colours)
    pixel = gsd_of(box) ** 2
    return {
        "building_area_m2": round(built * pixel, 2),
        "known_area_m2": round(known * pixel, 2),
        "building_share": round(built / known, 6) if known else None,
    }


def building_block(footprints_dir: Path, lattice_dir: Path, window: Window) -> NDArray[np.uint8]:
    """(h, w) uint8 building mask of one window, read from the footprints that touch it."""
    return mask_of(footprints_dir, lattice_dir, window.box_in(read_lattice(lattice_dir)[0]))


def mask_of(
    footprints_dir: Path, lattice_dir: Path, own: GeoBox, offset_m: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.uint8]:
    """(h, w) uint8 building mask of a grid of any GSD, drawn from the footprints that touch it.

    The map, footprints and known areas alike, is moved by ``offset_m`` (east, north) first.
    """
    from pyogrio.raw import read as read_raw

    from brmgeo.maps.rasterize import mask_window

    _, known = read_lattice(lattice_dir)
    left, bottom, right, top = bounds_of(own)
    reach, (dx, dy) = gsd_of(own), offset_m
    touched = (left - dx - reach, bottom - dy - reach, right - dx + reach, top - dy + reach)
    wkb = read_raw(footprints_dir / "footprints.gpkg", layer="footprints", columns=[], bbox=touched)[2]
    polygons, areas = shapely.from_wkb(wkb), np.array([p for _, p in known], dtype=object)
    if dx or dy:
        polygons, areas = (shapely.transform(a, lambda xy: xy + (dx, dy)) for a in (polygons, areas))
    return mask_window(polygons, areas, own)


@dataclass(frozen=True, slots=True)
class RatioMapsSettings(RasterSettings):
    """Radii of the ratio maps in metres, largest first."""

    radii_m: tuple[float, ...]


def run_ratio(inputs: Inputs, out: Path, settings: RatioMapsSettings, map: Map) -> Json:
    """Writes ratio.tif, one band a radius, largest first."""
    from brmgeo.export.cog import write_cog

    box, _ = read_lattice(inputs["lattice"])
    radii_m = settings.radii_m
    windows = list(blocks(shape_of(box), BLOCK_PX))
    work = functools.partial(ratio_block, inputs["footprints"], inputs["lattice"], radii_m)
    statistics = write_cog(
        out / "ratio.tif",
        zip(windows, map(work, windows), strict=True),
        box,
        kind="ratio",
        radii_m=radii_m,
        tags=settings.tags(out),
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


@dataclass(frozen=True, slots=True)
class OverviewSettings:
    """What project and preview are called, and whose the maps are."""

    name: str
    title: str
    attribution: str


def run_overview(inputs: Inputs, out: Path, settings: OverviewSettings, map: Map) -> Json:
    """Writes the QGIS project and preview.png."""
    from brmgeo.export.preview import write_preview
    from brmgeo.export.qgis import write_maps_project

    imagery = inputs["imagery"] / "imagery.tif" if "imagery" in inputs else None
    buildings, ratio = inputs["buildings"] / "buildings.tif", inputs["ratio"] / "ratio.tif"
    write_maps_project(
        out / f"{settings.name}.qgz",
        title=settings.title,
        footprints=inputs["footprints"] / "footprints.gpkg",
        buildings=buildings,
        ratio=ratio,
        imagery=imagery,
        attribution=settings.attribution,
    )
    write_preview(
        out / "preview.png",
        imagery=imagery,
        buildings=buildings,
        ratio=ratio,
        title=settings.title,
        attribution=settings.attribution,
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


def _rounded(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(v, 1) for v in values)
