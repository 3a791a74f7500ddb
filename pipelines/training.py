"""Training tiles: imagery and footprints in; 512 x 512 pairs of image and label, their splits, statistics and map out.

The stages go on from those of the maps (``source``, ``outlines``, ``lattice``, ``footprints``): ``alignment`` (how far the
labels lie beside the imagery), ``tile-survey`` (every tile that could be cut, its split, and why it is left out), ``tiles``
(one step a shard), ``tile-index``. Foreign pairs have ``pair-survey``, ``tile-pairs`` (one step a shard), ``tile-index``.
"""

from __future__ import annotations

import functools
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from brmgeo.errors import CrsError, InputError, MissingInputError, SettingsError
from brmgeo.geo.crs import transform_bounds
from brmgeo.geo.grid import Bounds, Window, bounds_of, lattice
from brmgeo.pictures import fault_of
from brmgeo.region import Region, TrainingSettings
from brmgeo.segment import OTHER, SPLITS, UNKNOWN
from brmgeo.segment.samples import blank_unknown
from brmgeo.segment.shards import (
    FORMAT,
    INDEX_CSV,
    TILES_JSON,
    VERSION,
    ShardWriter,
    TileInfo,
    check_label,
    entry_row,
    write_index,
)
from brmgeo.segment.tiles import (
    Splits,
    Tally,
    cells,
    make_label,
    one_split,
    picture_fault,
    sample_empty,
    shares,
    spatial_splits,
    tile_windows,
)
from brmgeo.settings import checked
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.stage import Json, Map, Stage
from brmgeo.workflow.store import PUBLISHED, Artifact, Input, Store, publish
from pipelines import maps
from pipelines.maps import Inputs, read_lattice
from pipelines.regions import described_regions, flown_mark, region_named

COARSE = 8  # the survey looks at imagery in pixels this many times larger
FINEST = 1.3  # tiles may be this many times finer than their imagery, no more: upsampled pictures teach blur
SURVEY_TILES = 64
PAIRS_A_SHARD = 512
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
SMALLEST_PX, LARGEST_PX = 32, 8192
ARROW = 20.0
SAME_TOWN_M = 10.0
LEFT_OUT = {
    "empty": "without building",
    "guard": "in the guard band",
    "held-out ground": "on held-out ground",
}
# Blocks in which offsets are measured, how far they are looked for, and in what pixels: finer ones tell no more of outlines
# that are drawn to a decimetre or worse.
ALIGN = {"block_m": 250.0, "least_block_m": 100.0, "search_m": 10.0, "gsd_m": 0.25}
ALIGN_COARSEST_M = 1.2  # a house of eight pixels has edges, one of four has not


# --- alignment: how far the labels lie beside the imagery ---------------------------------------------------------


def run_alignment(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes alignment.json: the offset between footprints and imagery in each block, and the region's."""
    from brmgeo.ingest.imagery import native_gsd_m
    from brmgeo.segment.alignment import BlockOffset, region_offset

    box, _ = read_lattice(inputs["lattice"])
    left, bottom, right, top = bounds_of(box)
    gsd_m = max(settings["gsd_m"], native_gsd_m(_sources(inputs, settings), box))
    # A small region is cut into smaller blocks, so that a few of them can agree.
    wanted = max(settings["least_block_m"], math.sqrt((right - left) * (top - bottom) / 16))
    places = cells((left, bottom, right, top), min(settings["block_m"], wanted))
    side = min(places[0][2] - places[0][0], places[0][3] - places[0][1])
    search_m = min(settings["search_m"], side / 4 - gsd_m)
    found: list[BlockOffset] = []
    if gsd_m <= ALIGN_COARSEST_M and search_m > 2 * gsd_m:
        work = functools.partial(_block_offset, dict(inputs), json.dumps(settings), gsd_m, search_m)
        found = list(map(work, places))
    whole = region_offset(found)
    counts = dict(sorted(Counter(b.status for b in found).items()))
    facts = {
        **{name: _plain(value) for name, value in asdict(whole).items()},
        "by_status": counts,
        "block_m": round(side, 1),
        "search_m": round(search_m, 2),
        "gsd_m": round(gsd_m, 4),
    }
    blocks = [
        {"bounds": [round(v, 3) for v in place]} | {n: _plain(v) for n, v in asdict(block).items()}
        for place, block in zip(places, found, strict=False)
    ]
    text = json.dumps({"region": facts, "blocks": blocks}, indent=1)
    (out / "alignment.json").write_text(text + "\n", encoding="utf-8")
    return facts


def _plain(value: Any) -> Any:
    """Numbers to the millimetre, None for what JSON lacks."""
    return (round(value, 3) if np.isfinite(value) else None) if isinstance(value, float) else value


def _block_offset(inputs: Inputs, text: str, gsd_m: float, search_m: float, place: Bounds) -> Any:
    from brmgeo.ingest.imagery import mosaic_to_lattice
    from brmgeo.segment.alignment import block_offset

    own = lattice(place, str(read_lattice(inputs["lattice"])[0].crs), gsd_m)
    rgb, seen = mosaic_to_lattice(_sources(inputs, json.loads(text)), own)
    return block_offset(rgb, seen, _mask(inputs, own), gsd_m, search_m)


@functools.lru_cache(maxsize=2)
def _offsets(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(n, 4) x, y, dx, dy of the blocks that tell; the region's (dx, dy), zero where it cannot tell; side of a block."""
    text = json.loads((folder / "alignment.json").read_text(encoding="utf-8"))
    told = [
        ((b["bounds"][0] + b["bounds"][2]) / 2, (b["bounds"][1] + b["bounds"][3]) / 2, b["dx_m"], b["dy_m"])
        for b in text["blocks"]
        if b["status"] == "told"
    ]
    whole = text["region"]
    own = (whole["dx_m"], whole["dy_m"]) if whole["status"] == "told" else (0.0, 0.0)
    return np.array(told, dtype=np.float64).reshape(-1, 4), np.array(own), float(whole["block_m"])


def label_offset(folder: Path, bounds: Bounds) -> tuple[float, float]:
    """(dx, dy) in metres by which the labels of a tile are moved: the median of the blocks about it that tell.

    Where fewer than three of them do, the region's; none where that cannot tell either.
    """
    blocks, whole, side = _offsets(folder)
    if not whole.any():
        return (0.0, 0.0)  # what the region does not tell, its blocks tell by chance
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    near = blocks[np.abs(blocks[:, :2] - (x, y)).max(axis=1) <= 1.5 * side, 2:]
    dx, dy = np.median(near, axis=0) if len(near) >= 3 else whole
    return (float(dx), float(dy))


# --- tile-survey: every tile that could be cut ------------------------------------------------------------------


def run_survey(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes survey.json: all candidates with their split and shares, and why those that are not kept are left out."""
    from brmgeo.ingest.imagery import check_imagery, native_gsd_m

    box, _ = read_lattice(inputs["lattice"])
    native = native_gsd_m(_sources(inputs, settings), box)
    fine = [g for g in settings["gsd_m"] if g * FINEST < native]
    gsds = [g for g in settings["gsd_m"] if g not in fine]
    if not gsds:
        raise SettingsError(
            f"region {settings['region']}: its imagery has {native:.3g} m per pixel, much coarser than all of the "
            f"training.gsd_m {maps.listed([f'{g:g}' for g in fine])}: give coarser ones, or finer imagery"
        )
    grids = {g: _grid(box, g) for g in gsds}
    todo = [
        (g, first, windows[first : first + SURVEY_TILES])
        for g in gsds
        for windows in [tile_windows(maps.shape_of(grids[g]), settings["tile_px"], settings["overlap_px"])]
        for first in range(0, len(windows), SURVEY_TILES)
    ]
    work = functools.partial(_survey_some, dict(inputs), json.dumps(settings))
    found = [tile for some in map(work, todo) for tile in some]
    ground = _ground_of(found)
    facts = _sampled(found, settings) | {
        "imagery_gsd_m": round(native, 4),
        "gsd_m": gsds,
        "gsd_too_fine_m": fine,
        "ground": ground,
    }
    if not facts["kept"]:
        if "unknown" in facts["dropped"]:
            check_imagery(_sources(inputs, settings), box)
        place = ", ".join(f"{v:.0f}" for v in settings["bounds"])
        hints = {
            "unknown": f"see that map and imagery both reach the region's bounds, {place} in {box.crs}",
            "blank": "see that the imagery is not of one colour there",
            "cloudy": "give clearer imagery, or a larger training.max_cloud_share",
            "empty": "training.empty_share = 1 keeps them",
            "guard": "give a larger training.block_m or a smaller training.guard_m",
            "held-out ground": f"that of {maps.listed([name for name, _ in settings['held']])}: give other bounds",
        }
        raise InputError(none_left(settings["region"], facts["dropped"], hints))
    (out / "survey.json").write_text(json.dumps({"facts": facts, "tiles": found}), encoding="utf-8")
    return facts


def _sampled(found: Sequence[Json], settings: Json) -> dict[str, Any]:
    """Marks the tiles without buildings that are too many of a GSD and split; what then is kept and left out."""
    for g, split in sorted({(t["gsd_m"], t["split"]) for t in found if not t["dropped"]}):
        own = [t for t in found if t["gsd_m"] == g and t["split"] == split and not t["dropped"]]
        empty = [t["key"] for t in own if t["built"] == 0]
        kept = sample_empty(len(own) - len(empty), empty, settings["empty_share"], settings["seed"])
        for tile in own:
            if tile["built"] == 0 and tile["key"] not in kept:
                tile["dropped"] = "empty"
    dropped = Counter(t["dropped"] or "kept" for t in found)
    return {
        "candidates": len(found),
        "kept": dropped.pop("kept", 0),
        "dropped": dict(sorted(dropped.items())),
    }


def none_left(region: str, dropped: Mapping[str, int], hints: Mapping[str, str]) -> str:
    """The line for tiles that were all left out: how many for what reason, and the hint for the commonest."""
    most = max(dropped, key=lambda reason: dropped[reason], default="")
    hint = hints.get(most, "check the map, the imagery and [training]")
    return f"{region}: no tile is left: {told_dropped(dropped) or 'none was cut'}; {hint}"


def told_dropped(dropped: Mapping[str, int]) -> str:
    """Such as "12 unknown, 3 without building", the commonest reason first."""
    common = sorted(dropped.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {LEFT_OUT.get(reason, reason)}" for reason, count in common)


def _ground_of(found: Sequence[Json]) -> Json:
    """What the ground is like before tiles without buildings are sampled down, from the tiles with map and imagery."""
    known = [t for t in found if t["known"] > 0 and t["dropped"] in (None, "guard")]
    weight = sum(t["known"] for t in known)
    return {
        "tiles": len(known),
        "empty": sum(t["built"] == 0 for t in known),
        "building_share": round(sum(t["built"] * t["known"] for t in known) / weight, 6) if weight else None,
    }


def _grid(box: GeoBox, gsd_m: float) -> GeoBox:
    """The lattice of tiles at one GSD over the region's."""
    return lattice(bounds_of(box), str(box.crs), gsd_m)


def _sources(inputs: Inputs, settings: Json) -> list[Any]:
    files = settings["source"]["files"]
    root = str(inputs[files[0]].parent if files else inputs["imagery"])
    return maps.imagery_sources(json.dumps(settings["source"]), root)


def _splits(settings: Json) -> Splits:
    bounds = maps.as_bounds(settings["bounds"])
    if settings["split"] != "blocks":
        return one_split(bounds, settings["split"])
    return spatial_splits(
        bounds,
        settings["block_m"],
        settings["guard_m"],
        settings["validation_share"],
        settings["test_share"],
        settings["seed"],
    )


def _survey_some(inputs: Inputs, text: str, todo: tuple[float, int, list[Window]]) -> list[Json]:
    """The candidates of one GSD from the ``first`` on."""
    from brmgeo.ingest.imagery import mosaic_to_lattice

    settings = json.loads(text)
    gsd_m, first, windows = todo
    box, _ = read_lattice(inputs["lattice"])
    grid, splits = _grid(box, gsd_m), _splits(settings)
    held = [shapely.box(*b) for _, b in settings["held"]]
    found: list[Json] = []
    for number, window in enumerate(windows, start=first):
        own = window.box_in(grid)
        bounds = bounds_of(own)
        tile: dict[str, Any] = {
            "key": f"{settings['region']}-{round(gsd_m * 1000):04d}-{number:05d}",
            "number": number,
            "gsd_m": gsd_m,
            "row": window.row,
            "col": window.col,
            "bounds": [round(v, 6) for v in bounds],
            "split": splits.of(bounds),
            "built": 0.0,
            "known": 0.0,
            "dropped": None,
        }
        found.append(tile)
        if any(area.intersects(shapely.box(*bounds)) for area in held):
            tile["dropped"] = "held-out ground"
            continue
        mask = _mask(inputs, own, settings["align"])
        a = own.affine
        coarse = Affine(a.a * COARSE, 0.0, a.c, 0.0, a.e * COARSE, a.f)
        small = GeoBox((window.height // COARSE, window.width // COARSE), coarse, grid.crs)
        rgb, seen = mosaic_to_lattice(_sources(inputs, settings), small)
        told = seen & (blank_unknown(rgb, np.zeros(seen.shape, np.uint8), 2) != UNKNOWN)
        ground = told & (mask[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE] == 0)
        label = make_label(mask, np.repeat(np.repeat(told, COARSE, axis=0), COARSE, axis=1))
        built, known = shares(label)
        tile["built"], tile["known"] = round(built, 6), round(known, 6)
        if known < settings["min_known_share"] or known == 0:
            tile["dropped"] = "blank" if seen.any() and not told.any() else "unknown"
        else:
            tile["dropped"] = picture_fault(rgb, told, ground, settings["max_cloud_share"])
        if tile["dropped"] is None and tile["split"] is None:
            tile["dropped"] = "guard"
    return found


def _mask(inputs: Inputs, own: GeoBox, align: bool = False) -> NDArray[np.uint8]:
    """(h, w) uint8 building mask of one tile, drawn at its own GSD from the footprints that touch it.

    With ``align`` the map is moved by its offset from the imagery first.
    """
    from pyogrio.raw import read as read_raw

    from brmgeo.maps.rasterize import mask_window

    _, known = read_lattice(inputs["lattice"])
    left, bottom, right, top = bounds_of(own)
    reach = own.affine.a
    dx, dy = label_offset(inputs["alignment"], (left, bottom, right, top)) if align else (0.0, 0.0)
    touched = (left - dx - reach, bottom - dy - reach, right - dx + reach, top - dy + reach)
    wkb = read_raw(inputs["footprints"] / "footprints.gpkg", layer="footprints", columns=[], bbox=touched)[2]
    polygons, areas = shapely.from_wkb(wkb), np.array([p for _, p in known], dtype=object)
    if dx or dy:
        polygons, areas = (shapely.transform(a, lambda xy: xy + (dx, dy)) for a in (polygons, areas))
    return mask_window(polygons, areas, own)


@functools.lru_cache(maxsize=2)
def _surveyed(folder: Path) -> tuple[Json, ...]:
    """The tiles of a survey that are kept."""
    text = json.loads((folder / "survey.json").read_text(encoding="utf-8"))
    return tuple(t for t in text["tiles"] if t["dropped"] is None)


# --- tiles: one shard ---------------------------------------------------------------------------------------------


def run_tiles(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes shard.tar with the kept tiles of one stretch of the survey, and entries.json: its index and counts."""
    from brmgeo.ingest.imagery import mosaic_to_lattice

    first, last = settings["first"], settings["first"] + settings["count"]
    own = [
        t
        for t in _surveyed(inputs["survey"])
        if t["gsd_m"] == settings["gsd_m"] and first <= t["number"] < last
    ]
    rows, tallies = [], {split: Tally() for split in SPLITS}
    if own:
        box, _ = read_lattice(inputs["lattice"])
        grid = _grid(box, settings["gsd_m"])
        with ShardWriter(out / "shard.tar", image_format=settings["image_format"]) as shard:
            for tile in own:
                window = Window(tile["row"], tile["col"], settings["tile_px"], settings["tile_px"])
                place = window.box_in(grid)
                rgb, seen = mosaic_to_lattice(_sources(inputs, settings), grid, window)
                # Filler is no ground, whether its file says so or not.
                label = blank_unknown(rgb, make_label(_mask(inputs, place, settings["align"]), seen))
                built, known = shares(label)
                info = TileInfo(
                    tile["key"],
                    0,
                    tile["gsd_m"],
                    tile["split"],
                    settings["region"],
                    round(built, 6),
                    round(known, 6),
                    bounds_of(place),
                    str(box.crs),
                )
                shard.add(info, rgb, label)
                tallies[tile["split"]].add(rgb, label)
        rows = [entry_row(entry) for entry in shard.entries]
    _write_entries(out, rows, tallies)
    return {"tiles": len(rows)}


def _write_entries(out: Path, rows: Sequence[Json], tallies: Mapping[str, Tally]) -> None:
    text = {"rows": rows, "tallies": {split: asdict(tally) for split, tally in tallies.items()}}
    (out / "entries.json").write_text(json.dumps(text), encoding="utf-8")


# --- tile-index: what a person and a program look at first --------------------------------------------------------


def run_index(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes index.csv, index.gpkg (where the tiles' places are known) and tiles.json over all shards."""
    rows: list[Json] = []
    shards: list[Json] = []
    tallies = {split: Tally() for split in SPLITS}
    for name in settings["shards"]:
        folder = inputs[name]
        text = json.loads((folder / "entries.json").read_text(encoding="utf-8"))
        for split, tally in text["tallies"].items():
            tallies[split].merge([Tally(**tally)])
        if not text["rows"]:
            continue
        rows += [row | {"shard": len(shards)} for row in text["rows"]]
        shards.append(
            {
                "file": f"{name}.tar",
                "size": (folder / "shard.tar").stat().st_size,
                "tiles": len(text["rows"]),
            }
        )
    facts = json.loads((inputs["survey"] / "survey.json").read_text(encoding="utf-8"))["facts"]
    if not rows:
        raise InputError(none_left(settings["region"], facts["dropped"], {}))
    write_index(out / INDEX_CSV, rows)
    offsets = None
    if "alignment" in inputs:
        offsets = json.loads((inputs["alignment"] / "alignment.json").read_text(encoding="utf-8"))
    if all(row["left"] is not None for row in rows):
        _write_gpkg(out / "index.gpkg", rows, settings["credit"], offsets["blocks"] if offsets else [])
    statistics = next(split for split in SPLITS if tallies[split].tiles)
    whole = {
        "format": FORMAT,
        "version": VERSION,
        "region": settings["region"],
        "title": settings["title"],
        "hold_out": settings["hold_out"],
        "tiles": len(rows),
        "tile_px": settings["tile_px"],
        "overlap_px": settings["overlap_px"],
        "labels": {"0": "other", "127": "unknown", "255": "building"},
        "by_gsd_m": _counted(rows, "gsd_m"),
        "by_split": _counted(rows, "split"),
        "splits": {
            split: _told(tally) | {"by_gsd_m": _counted([r for r in rows if r["split"] == split], "gsd_m")}
            for split, tally in tallies.items()
            if tally.tiles
        },
        # Of training tiles wherever there are some; brmgeo's own network is normalised with constants instead.
        "statistics": {"split": statistics} | _colour_told(tallies[statistics]),
        "survey": facts,
        "alignment": None if offsets is None else {"corrected": settings["align"]} | offsets["region"],
        "blocks": settings["blocks"],
        "sources": settings["sources"],
        "shards": shards,
    }
    (out / TILES_JSON).write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return {"tiles": len(rows), "by_split": whole["by_split"], "shards": len(shards)}


def _counted(rows: Sequence[Json], column: str) -> Json:
    return {str(name): count for name, count in sorted(Counter(row[column] for row in rows).items())}


def _told(tally: Tally) -> Json:
    known = tally.building + tally.other
    return {
        "tiles": tally.tiles,
        "empty_tiles": tally.empty,
        "empty_share": round(tally.empty / tally.tiles, 4),
        "pixels": {"building": tally.building, "other": tally.other, "unknown": tally.unknown},
        "building_share": round(tally.building / known, 6) if known else None,
        # How many other pixels stand against one of a building: the weight that evens them out.
        "other_per_building": round(tally.other / tally.building, 4) if tally.building else None,
        **_colour_told(tally),
    }


def _colour_told(tally: Tally) -> Json:
    colour = tally.colour()
    if colour is None:
        return {"mean": None, "std": None}
    return {"mean": [round(v, 6) for v in colour[0]], "std": [round(v, 6) for v in colour[1]]}


def _write_gpkg(path: Path, rows: Sequence[Json], credit: str, blocks: Sequence[Json]) -> None:
    """index.gpkg: ``tiles``, one polygon a tile, coloured by split when QGIS opens it, and ``alignment``, the measured
    offsets as lines ARROW times as long."""
    from brmgeo.export.qgis_style import Style, add_default_styles, categorized, fill, line, single
    from brmgeo.export.vector import write_layer

    colours = {"train": "#2f6bff", "validation": "#ffb02e", "test": "#e0457b"}
    boxes = np.array([shapely.box(*(row[n] for n in ("left", "bottom", "right", "top"))) for row in rows])
    columns: dict[str, NDArray[Any]] = {
        name: np.array([row[name] for row in rows], dtype=object)
        for name in ("key", "region", "split", "image_name")
    }
    for name in ("gsd_m", "building_share", "known_share"):
        columns[name] = np.array([row[name] for row in rows], dtype=np.float64)
    columns["shard"] = np.array([row["shard"] for row in rows], dtype=np.int64)
    columns["source"] = np.array([credit] * len(rows), dtype=object)
    write_layer(path, "tiles", boxes, "Polygon", rows[0]["crs"], columns)
    style = categorized(
        "split", [(name, name.capitalize(), [fill(c, 45, c, 0.4)]) for name, c in colours.items()]
    )
    styles: dict[str, tuple[Style, str]] = {"tiles": ([style], "Polygon")}
    told = [b for b in blocks if b["status"] == "told"]
    if told:
        numbers = np.array([[*b["bounds"], b["dx_m"], b["dy_m"]] for b in told], dtype=np.float64)
        middle = (numbers[:, :2] + numbers[:, 2:4]) / 2
        arrows = shapely.linestrings(np.stack([middle, middle + ARROW * numbers[:, 4:]], axis=1))
        values = {
            name: np.array([b[name] for b in told], dtype=np.float64) for name in ("dx_m", "dy_m", "quality")
        }
        write_layer(path, "alignment", arrows, "LineString", rows[0]["crs"], values)
        styles["alignment"] = ([single(line("#10141c", 1.1), line("#35e0c8", 0.6))], "Line")
    add_default_styles(path, styles)


ALIGNMENT = Stage("alignment", 1, run_alignment)
SURVEY = Stage("tile-survey", 2, run_survey)
TILES = Stage("tiles", 2, run_tiles)
INDEX = Stage("tile-index", 2, run_index)


# --- the plan -----------------------------------------------------------------------------------------------------


def plan_tiles(
    region: Region, store: Store, data: Path, fetch: bool = False, align: bool = False
) -> tuple[Plan, dict[str, str]]:
    """The steps of a region's training tiles, and the label of each shard's step -> the shard's name.

    With ``align`` the labels are moved by their measured offset; measured and told it is in any case.

    Raises SettingsError for a region without imagery, and as ``plan_maps``.
    """
    if region.imagery is None:
        raise SettingsError(
            f"region {region.name} has no imagery, so no training tile can be cut: add [imagery] to its region file"
        )
    whole = maps.plan_maps(region, store, data / "source" / region.name, fetch)
    plan = Plan(store, region.name)
    for label, step in whole.steps.items():
        if label not in ("imagery", "buildings", "ratio", "overview"):
            plan.steps[label] = step
    imagery = whole.steps["imagery"]
    own = region.training
    inputs: dict[str, Input] = {
        **{name: item for name, item in imagery.inputs.items() if name != "lattice"},
        "lattice": plan.steps["lattice"],
        "footprints": plan.steps["footprints"],
    }
    box = lattice(maps.place_of(region), region.crs, region.gsd_m)
    source = imagery.settings["source"]
    alignment = plan.add(ALIGNMENT, inputs, {"source": source, **ALIGN})
    if align:
        inputs["alignment"] = alignment
    cut = {"region": region.name, "source": source, "tile_px": own.tile_px, "align": align}
    rules = own.model_dump(
        include={
            "overlap_px", "gsd_m", "empty_share", "split", "block_m", "guard_m", "validation_share", "test_share", "seed",
            "min_known_share", "max_cloud_share",
        }
    )  # fmt: skip
    if own.hold_out:
        rules["split"] = "test"
    survey = plan.add(
        SURVEY,
        inputs,
        cut | rules | {"bounds": bounds_of(box), "held": held_ground(region, data)},
    )
    names: dict[str, str] = {}
    for gsd_m in own.gsd_m:
        count = len(tile_windows(maps.shape_of(_grid(box, gsd_m)), own.tile_px, own.overlap_px))
        for number, first in enumerate(range(0, count, own.shard_tiles)):
            name = f"{region.name}-{round(gsd_m * 1000):04d}-{number:03d}"
            plan.add(
                TILES,
                inputs | {"survey": survey},
                cut
                | {
                    "gsd_m": gsd_m,
                    "first": first,
                    "count": own.shard_tiles,
                    "image_format": own.image_format,
                },
                f"tiles {name}",
            )
            names[f"tiles {name}"] = name
    blocks = _splits(json.loads(json.dumps(rules | {"bounds": bounds_of(box)})))
    plan.add(
        INDEX,
        {"survey": survey, "alignment": alignment}
        | {name: plan.steps[label] for label, name in names.items()},
        {
            "region": region.name,
            "title": region.title,
            "hold_out": own.hold_out,
            "tile_px": own.tile_px,
            "overlap_px": own.overlap_px,
            "shards": list(names.values()),
            "align": align,
            "blocks": {
                "guard_m": blocks.guard_m,
                "blocks": [[name, *blocks.block(i)] for i, name in enumerate(blocks.names)],
            },
            "credit": maps.credits(region),
            "sources": [
                {
                    "what": "imagery",
                    "attribution": region.imagery.attribution,
                    "terms": region.imagery.terms,
                },
                {"what": "footprints", "attribution": region.footprints.attribution, "terms": ""},
            ],
        },
    )
    return plan, names


# --- who may be trained on ------------------------------------------------------------------------------------------


def flights_over(name: str, data: Path) -> list[str]:
    """Names of the flights, own or simulated, over a region: those below its folders and what was noted of others."""
    found = {p.parent.name for p in (data / "source" / name / "flights").glob("*/flight.toml")}
    found |= {p.name for p in (data / "out" / name / "flights").glob("*") if p.is_dir()}
    if (data / "out" / name / "evaluation").is_dir():
        found.add("the simulated flights of brmgeo evaluate")
    if (mark := flown_mark(name, data)).is_file():
        found.add(f"flights with results elsewhere ({mark} says so)")
    return sorted(found)


def require_trainable(region: Region, data: Path) -> None:
    """Raises SettingsError (one line) for a region that must not be trained on: held out, flown over, or a copy of such."""
    if region.training.hold_out:
        raise SettingsError(
            f"region {region.name} is held out (training.hold_out = true in its region file), so it is never trained on: "
            "name other regions, or cut it for testing only"
        )
    flown = flights_over(region.name, data)
    if flown:
        raise SettingsError(
            f"region {region.name} is flown over by {maps.listed(flown)}, so it is never trained on: set training.hold_out "
            "= true in its region file to cut it for testing, or train on other regions"
        )
    for other in _tested_regions(region, data):
        if _same_town(region, other):
            raise SettingsError(
                f"region {region.name} is the same generated town as {other.name}, which is held out or flown over, so it "
                "is never trained on: give it another [generate] seed"
            )


def require_all_trainable(names: Sequence[str], data: Path, split: str | None) -> list[tuple[Region, Path]]:
    """The regions of these names, checked before the first is worked on: see ``require_trainable``.

    ``split`` is what the user asks for in place of the region files' own; tiles for testing may be cut anywhere.
    """
    found = []
    for name in names:
        region, own = region_named(name, data)
        wanted = split or ("test" if region.training.hold_out else region.training.split)
        if wanted != "test":
            require_trainable(region, own)
        found.append((region, own))
    return found


def held_ground(region: Region, data: Path) -> list[tuple[str, Bounds]]:
    """Names and bounds, in the region's CRS, of real held-out or flown regions: no tile of another region may show them.

    Generated regions only borrow their coordinates: two that overlap show different towns.
    """
    found: list[tuple[str, Bounds]] = []
    if region.generate is not None or region.training.hold_out or region.training.split == "test":
        return found
    own = shapely.box(*maps.place_of(region))
    for other in _tested_regions(region, data):
        place = _place_in(region.crs, other) if other.generate is None else None
        if place is None:
            continue
        grown = place.buffer(region.training.guard_m, join_style="mitre")
        if grown.intersects(own):
            found.append((other.name, maps.as_bounds(grown.bounds)))
    return found


def _tested_regions(region: Region, data: Path) -> Iterator[Region]:
    """The other regions that are held out, for testing only, or flown over."""
    for other in described_regions(data):
        if other.name == region.name:
            continue
        if other.training.hold_out or other.training.split == "test" or flights_over(other.name, data):
            yield other


def _same_town(region: Region, other: Region) -> bool:
    """Whether two generated regions show one town: it follows from seed, style and the numbers of the bounds, whatever
    the CRS and season. Bounds a few metres apart give nearly the same; from ten on hardly a building stands in both."""
    a, b = region.generate, other.generate
    if a is None or b is None or (a.seed, a.style) != (b.seed, b.style):
        return False
    pairs = zip(maps.place_of(region), maps.place_of(other), strict=True)
    return all(abs(own - far) <= SAME_TOWN_M for own, far in pairs)


def _place_in(crs: str, other: Region) -> Any:
    """The ground of a region in another CRS; None where it has no place there, far away as it is."""
    try:
        return shapely.box(*transform_bounds(other.crs, crs, maps.place_of(other)))
    except CrsError:
        return None


# --- the jobs that the command line calls ---------------------------------------------------------------------------


def cut_region(
    name: str,
    data: Path,
    out: Path | None,
    scheduler_spec: str | None,
    split: str | None = None,
    gsd_m: Sequence[float] | None = None,
    align: bool = False,
) -> Path:
    """Cuts the training tiles of a region and publishes them; the folder they are in.

    Raises SettingsError for a region that is held out or flown over, unless all its tiles are for testing.
    """
    region, data = require_all_trainable([name], data, split)[0]
    changes: dict[str, Any] = {}
    if split is not None:
        changes["split"] = split
    if gsd_m is not None:
        changes["gsd_m"] = tuple(gsd_m)
    if changes:
        region = region.model_copy(update={"training": _changed(region.training, changes)})
    return cut_tiles(region, data, out or data / "out" / region.name / "tiles", scheduler_spec, align)


def _changed(settings: TrainingSettings, changes: Mapping[str, Any]) -> TrainingSettings:
    return checked(TrainingSettings, settings.model_dump() | dict(changes), "tiles")


def cut_tiles(region: Region, data: Path, out: Path, scheduler_spec: str | None, align: bool = False) -> Path:
    """Builds what is missing of a region's training tiles and publishes them in ``out``."""
    progress = Progress()
    store = Store(data / "work")
    with _folder(out, region.name), store.lock(region.name):
        plan, names = plan_tiles(region, store, data, fetch=True, align=align)
        with scheduler(scheduler_spec, shared=store.root, say=progress.say) as map:
            made = plan.build(map, progress)
        _publish(made, names, out)
    facts = made["tile-index"].facts
    told = ", ".join(f"{count} {split}" for split, count in facts["by_split"].items())
    survey = made["tile-survey"].facts
    if survey["gsd_too_fine_m"]:
        progress.say(
            f"{region.name}: nothing cut at {maps.listed([f'{g:g} m' for g in survey['gsd_too_fine_m']])}: much finer than "
            f"the imagery's {survey['imagery_gsd_m']:.3g} m per pixel"
        )
    offset = made["alignment"].facts
    if offset["status"] == "told":
        moved = "the labels were moved by it" if align else "--align moves the labels by it"
        progress.say(
            f"{region.name}: labels lie {np.hypot(offset['dx_m'], offset['dy_m']):.2f} m beside the imagery (move them by "
            f"{offset['dx_m']:+.2f} m east, {offset['dy_m']:+.2f} m north; {offset['told']} of {offset['blocks']} blocks "
            f"tell); {moved}"
        )
    else:
        progress.say(
            f"{region.name}: how far the labels lie beside the imagery cannot be told ({offset['told']} of "
            f"{offset['blocks']} blocks tell)" + ("; they stay where they are" if align else "")
        )
    progress.say(
        f"{region.name}: {facts['tiles']} tiles ({told}) in {facts['shards']} shards; results are in {out}"
    )
    return out


@contextmanager
def _folder(out: Path, region: str) -> Iterator[None]:
    """Makes the folder of a region's tiles; where the work fails, empty folders that this made are gone again.

    Raises SettingsError where it holds the tiles of something else, WorkflowError where it cannot be written.
    """
    facts = _read_dict(out / TILES_JSON)
    there = f"tiles of {facts.get('region')}" if facts.get("format") == FORMAT else "another tiles.json"
    if (out / TILES_JSON).exists() and there != f"tiles of {region}":
        raise SettingsError(
            f"{out}: holds {there}, which those of {region} would replace in part: give another --out, or move them away"
        )
    new = [p for p in (out, *out.parents) if not os.path.exists(p)]
    try:
        maps.require_writable(out)
        yield
    except BaseException:
        with suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise


def _read_dict(path: Path) -> dict[str, Any]:
    """A JSON object; empty for a file that is not there or holds none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _published_before(out: Path, region: str) -> set[str]:
    """Files of tiles in ``out`` that an earlier run put there, and no file of the user's."""
    shards = _read_dict(out / TILES_JSON).get("shards")
    names = {str(s.get("file")) for s in shards or [] if isinstance(s, dict)}
    names |= _read_dict(out / PUBLISHED).keys()
    shard = re.compile(rf"{re.escape(region)}-(\d{{4,}}-)?\d{{3,}}\.tar", re.ASCII)
    return {name for name in names if shard.fullmatch(name) or name in ("alignment.json", "index.gpkg")}


def _publish(made: Mapping[str, Artifact], names: Mapping[str, str], out: Path) -> None:
    index = made["tile-index"]
    before, wanted = _published_before(out, index.step.settings["region"]), set(index.record["outputs"])
    for label, name in names.items():
        if (made[label].path / "shard.tar").exists():
            publish(made[label], out, {"shard.tar": f"{name}.tar"})
            wanted.add(f"{name}.tar")
    publish(index, out, sorted(index.record["outputs"]))
    if "alignment" in made:
        publish(made["alignment"], out, ["alignment.json"])
        wanted.add("alignment.json")
    for stale in before - wanted:
        (out / stale).unlink(missing_ok=True)  # of an earlier cut with other settings


def status_lines(name: str, data: Path, verify: bool = False) -> list[str]:
    """One line a stage of a region's training tiles, with a reason below each that is not fresh; none before a cut."""
    plan = _plan_as_last_cut(name, data)
    if plan is None:
        return []
    lines = []
    for step in plan.status(verify):
        if step.label == "alignment" or step.label.startswith("tile"):
            lines.append(f"{step.label:<24} {step.state:<8} {step.key[:12]}")
            lines += [f"    {reason}" for reason in step.reasons]
    return lines


def why_lines(name: str, stage: str, data: Path) -> list[str] | None:
    """Why a stage of a region's training tiles would run, or that it would not; None for a stage that is none of them."""
    plan = _plan_as_last_cut(name, data)
    return None if plan is None or stage not in plan.steps else plan.why(stage)


def last_aligned(name: str, data: Path) -> bool:
    """True where the tiles of a region were aligned when they were last cut."""
    region, data = region_named(name, data)
    last = Store(data / "work").latest(region.name, "tile-index")
    return bool(last is not None and last["settings"]["align"])


def _plan_as_last_cut(name: str, data: Path) -> Plan | None:
    """The steps of a region's tiles, aligned or not as they were last cut; None when they never were."""
    region, data = region_named(name, data)
    store = Store(data / "work")
    last = store.latest(region.name, "tile-index")
    return None if last is None else plan_tiles(region, store, data, align=last["settings"]["align"])[0]


# --- pairs: images and masks of others ------------------------------------------------------------------------------


def run_pair_survey(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes survey.json: all image + mask pairs with their shares, and why those that are not kept are left out."""
    pairs = settings["pairs"]
    todo = [pairs[first : first + SURVEY_TILES] for first in range(0, len(pairs), SURVEY_TILES)]
    work = functools.partial(_survey_pairs, dict(inputs), json.dumps(settings | {"pairs": None}))
    found = [tile for some in map(work, todo) for tile in some]
    ground = _ground_of(found)
    facts = _sampled(found, settings) | {"ground": ground}
    if not facts["kept"]:
        hints = {
            "unknown": "masks hold 0, 255 and, for unknown, 127; see that pictures are not transparent or plain filler",
            "blank": "give pictures of more than one colour",
            "cloudy": "give pictures of a clearer day",
            "empty": "--empty-share 1 keeps them",
        }
        raise InputError(none_left(settings["region"], facts["dropped"], hints))
    (out / "survey.json").write_text(json.dumps({"facts": facts, "tiles": found}), encoding="utf-8")
    return facts


def _survey_pairs(inputs: Inputs, text: str, pairs: Sequence[Sequence[str]]) -> list[Json]:
    settings = json.loads(text)
    found: list[Json] = []
    for key, image_name, mask_name in pairs:
        image, label = read_pair(inputs["images"] / image_name, inputs["masks"] / mask_name)
        built, known = shares(label)
        fault = "unknown" if known == 0 else _pair_fault(image, label, settings["max_cloud_share"])
        found.append(
            {
                "key": key,
                "gsd_m": settings["gsd_m"],
                "split": settings["split"],
                "built": round(built, 6),
                "known": round(known, 6),
                "dropped": fault,
            }
        )
    return found


def _pair_fault(image: NDArray[np.uint8], label: NDArray[np.uint8], cloud_share: float) -> str | None:
    """Blank as it is, cloudy as the survey of a region sees it: in pixels COARSE times larger."""
    import cv2

    fault = picture_fault(image, label != UNKNOWN)
    rows, cols = (n // COARSE for n in label.shape)
    seen = label[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE][:rows, :cols]
    if fault is not None or not (seen == OTHER).any():
        return fault
    whole = image[: rows * COARSE, : cols * COARSE]
    small = np.asarray(cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return picture_fault(small, seen != UNKNOWN, seen == OTHER, cloud_share)


def run_pairs(inputs: Inputs, out: Path, settings: Json, map: Map) -> Json:
    """Writes shard.tar and entries.json of those of some image + mask pairs that the survey keeps, as they are."""
    tallies = {split: Tally() for split in SPLITS}
    kept = {tile["key"]: tile for tile in _surveyed(inputs["survey"])}
    own = [pair for pair in settings["pairs"] if pair[0] in kept]
    rows: list[Json] = []
    if own:
        with ShardWriter(out / "shard.tar", image_format="png") as shard:
            for key, image_name, mask_name in own:
                image, label = read_pair(inputs["images"] / image_name, inputs["masks"] / mask_name)
                tile, nowhere = kept[key], float("nan")
                info = TileInfo(
                    key,
                    0,
                    settings["gsd_m"],
                    settings["split"],
                    settings["region"],
                    tile["built"],
                    tile["known"],
                    (nowhere, nowhere, nowhere, nowhere),
                    "",
                )
                shard.add(info, image, label)
                tallies[settings["split"]].add(image, label)
        rows = [entry_row(entry) for entry in shard.entries]
    _write_entries(out, rows, tallies)
    return {"tiles": len(rows)}


def read_pair(image_path: Path, mask_path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """(h, w, 3) uint8 RGB and (h, w) uint8 label of a picture and its mask; unknown where transparent or plain filler.

    Raises InputError for files that are damaged, cut short, of more than 8 bits, of odd values or of different sizes.
    """
    image, seen = _read_image(image_path)
    label = check_label(_read_mask(mask_path), str(mask_path))
    if label.shape != seen.shape:
        raise InputError(
            f"{mask_path}: {label.shape[1]} x {label.shape[0]} px, its image {image_path.name} has "
            f"{seen.shape[1]} x {seen.shape[0]}; give masks of their images' sizes"
        )
    label[~seen] = UNKNOWN
    return image, blank_unknown(image, label)


def _read_image(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """(h, w, 3) uint8 RGB and (h, w) bool, False where it is transparent; InputError for what is no 8-bit picture."""
    found = _decoded(path)
    if found.ndim == 2:
        found = np.repeat(found[..., None], 3, axis=2)
    if found.shape[-1] not in (3, 4):
        raise InputError(f"{path}: has {found.shape[-1]} bands; give grey, RGB or RGBA pictures")
    seen = found[..., 3] > 0 if found.shape[-1] == 4 else np.ones(found.shape[:2], np.bool_)
    rgb = np.ascontiguousarray(found[..., 2::-1])
    rgb[~seen] = 0
    return rgb, seen


def _read_mask(path: Path) -> NDArray[np.uint8]:
    return _decoded(path)


def _decoded(path: Path) -> NDArray[np.uint8]:
    """A picture as OpenCV reads it, with all its bands."""
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if data.size and (fault := fault_of(data.tobytes())):
        raise InputError(f"{path}: {fault}: copy the file again")
    found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if found is None:
        raise InputError(
            f"{path}: is not a readable picture; fetch or export it again, or take it out with its partner"
        )
    if found.dtype != np.uint8:
        raise InputError(f"{path}: holds {found.dtype} values; give pictures of 8 bit")
    if min(found.shape[:2]) < SMALLEST_PX or max(found.shape[:2]) > LARGEST_PX:
        raise InputError(
            f"{path}: {found.shape[1]} x {found.shape[0]} px; training tiles have {SMALLEST_PX} to {LARGEST_PX} px a side: "
            "cut or leave out the picture"
        )
    return np.asarray(found, dtype=np.uint8)


PAIR_SURVEY = Stage("pair-survey", 1, run_pair_survey)
PAIRS = Stage("tile-pairs", 3, run_pairs)


def cut_pairs(
    images: Path,
    masks: Path,
    out: Path,
    gsd_m: float,
    name: str,
    split: str,
    attribution: str,
    terms: str,
    scheduler_spec: str | None,
    empty_share: float | None = None,
) -> Path:
    """Makes training tiles of pictures and the masks of the same names; the folder that they are in.

    Raises MissingInputError for folders without pictures and pictures without a mask, InputError for damaged ones,
    SettingsError for a flight's own pictures unless they are for testing.
    """
    rules = TrainingSettings()
    empty_share = rules.empty_share if empty_share is None else empty_share
    if not 0 <= empty_share <= 1:
        raise SettingsError(f"tiles --pairs: --empty-share {empty_share:g} is no share of the tiles (0 to 1)")
    if not 0.02 <= gsd_m <= 10:
        raise SettingsError(f"tiles --pairs: --gsd {gsd_m:g} is no size of a pixel in metres (0.02 to 10)")
    for folder in (images, masks) if split != "test" else ():
        at = folder.resolve()
        if any((p / "flight.toml").is_file() for p in (at, *at.parents[:2])):
            raise SettingsError(
                f"tiles --pairs: {folder} is of a flight (flight.toml stands by it), which is for testing only: give "
                "--split test, or other pictures"
            )
    safe = maps.safe_name(name)
    pairs = [(f"{safe}-{stem}", *files) for stem, *files in _paired(images, masks)]
    progress = Progress()
    inputs: dict[str, Input] = {"images": images, "masks": masks}
    own = {"gsd_m": gsd_m, "split": split, "region": safe}
    with _folder(out, safe), (store := Store(out / ".brmgeo")).lock(safe):
        plan = Plan(store, safe)
        drawn = {"seed": rules.seed, "max_cloud_share": rules.max_cloud_share, "empty_share": empty_share}
        survey = plan.add(PAIR_SURVEY, inputs, own | drawn | {"pairs": pairs})
        names: dict[str, str] = {}
        for number, first in enumerate(range(0, len(pairs), PAIRS_A_SHARD)):
            shard = f"{safe}-{number:03d}"
            some = pairs[first : first + PAIRS_A_SHARD]
            plan.add(PAIRS, inputs | {"survey": survey}, own | {"pairs": some}, f"tiles {shard}")
            names[f"tiles {shard}"] = shard
        plan.add(
            INDEX,
            {"survey": survey} | {shard: plan.steps[label] for label, shard in names.items()},
            {
                "region": safe,
                "title": name,
                "hold_out": split == "test",
                "tile_px": None,
                "overlap_px": 0,
                "shards": list(names.values()),
                "align": False,
                "blocks": None,
                "credit": attribution,
                "sources": [{"what": "imagery and masks", "attribution": attribution, "terms": terms}],
            },
        )
        with scheduler(scheduler_spec, shared=store.root, say=progress.say) as map:
            made = plan.build(map, progress)
        _publish(made, names, out)
    facts = made["pair-survey"].facts
    why = f" ({told_dropped(facts['dropped'])})" if facts["dropped"] else ""
    progress.say(
        f"{safe}: {facts['kept']} tiles ({split}), {len(pairs) - facts['kept']} left out{why}; results are in {out}"
    )
    return out


def _paired(images: Path, masks: Path) -> list[tuple[str, str, str]]:
    """(key, image's name, mask's name) of all pairs, by name."""
    found = []
    for folder in (images, masks):
        if not folder.is_dir():
            raise MissingInputError(
                f"tiles --pairs: {folder} is not a folder; give a folder of images and one of masks"
            )
        files = [
            p for p in sorted(folder.iterdir()) if p.suffix.lower() in PICTURES and not p.name.startswith(".")
        ]
        own = Counter(p.stem for p in files)
        double = sorted(stem for stem, count in own.items() if count > 1)
        if double:
            raise InputError(
                f"tiles --pairs: {folder} holds several pictures named {double[0]} that differ in their ending only; "
                "leave one of them"
            )
        found.append({p.stem: p.name for p in files})
    pictures, labels = found
    if not pictures:
        raise MissingInputError(f"tiles --pairs: {images} holds no picture ({', '.join(PICTURES)})")
    lonely = sorted(pictures.keys() ^ labels.keys())
    if lonely:
        where = masks if lonely[0] in pictures else images
        raise MissingInputError(
            f"tiles --pairs: {len(lonely)} pictures have no partner, such as {lonely[0]}, which {where} lacks; "
            "images and masks have the same names"
        )
    safe = Counter(maps.safe_name(stem) for stem in pictures)
    return [
        # Names that differ only in what a key cannot hold get a number.
        (maps.safe_name(stem) + (f"-{i:05d}" if safe[maps.safe_name(stem)] > 1 else ""), name, labels[stem])
        for i, (stem, name) in enumerate(sorted(pictures.items()))
    ]
