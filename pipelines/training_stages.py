"""The stages of training tiles cut from a region, which go on from those of its maps, and the settings that make their keys.

``alignment`` (how far the labels lie beside the imagery), ``tile-survey`` (every tile that could be cut, its split, and why
it is left out), ``tiles`` (one step a shard), ``tile-index`` (of foreign pairs too).
"""

from __future__ import annotations

import functools
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from brmgeo.errors import InputError, SettingsError, listed
from brmgeo.files import json_of, write_json
from brmgeo.geo.grid import Bounds, Window, bounds_of, lattice, shape_of
from brmgeo.segment import SPLITS
from brmgeo.segment.samples import blank_unknown
from brmgeo.segment.shards import (
    FORMAT,
    INDEX_CSV,
    TILES_JSON,
    VERSION,
    ImageFormat,
    ShardWriter,
    TileInfo,
    entry_row,
    write_index,
)
from brmgeo.segment.survey import ground_facts, label_offset, sampled
from brmgeo.segment.tiles import (
    COARSE,
    Splits,
    Tally,
    cells,
    make_label,
    one_split,
    shares,
    spatial_splits,
    tile_fault,
    tile_windows,
)
from brmgeo.workflow.stage import Json, Map, Stage, plain

from .map_sources import ImageryFiles, imagery_sources
from .map_stages import Inputs, mask_of, read_lattice

if TYPE_CHECKING:
    from brmgeo.segment.alignment import BlockOffset

FINEST = 1.3  # tiles may be this many times finer than their imagery, no more: upsampled pictures teach blur
SURVEY_TILES = 64
LEFT_OUT = {
    "empty": "without building",
    "guard": "in the guard band",
    "held-out ground": "on held-out ground",
}
ALIGN_COARSEST_M = 1.2  # a house of eight pixels has edges, one of four has not


# --- alignment: how far the labels lie beside the imagery ---------------------------------------------------------


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """Blocks in which offsets are measured, how far they are looked for, and in what pixels: finer ones tell no more of
    outlines that are drawn to a decimetre or worse."""

    source: ImageryFiles
    block_m: float = 250.0
    least_block_m: float = 100.0
    search_m: float = 10.0
    gsd_m: float = 0.25


def run_alignment(inputs: Inputs, out: Path, settings: AlignmentSettings, map: Map) -> Json:
    """Writes alignment.json: the offset between footprints and imagery in each block, and the region's."""
    from brmgeo.ingest.imagery import native_gsd_m
    from brmgeo.segment.alignment import region_offset

    box, _ = read_lattice(inputs["lattice"])
    left, bottom, right, top = bounds_of(box)
    gsd_m = max(settings.gsd_m, native_gsd_m(_sources(inputs, settings.source), box))
    # A small region is cut into smaller blocks, so that a few of them can agree.
    wanted = max(settings.least_block_m, math.sqrt((right - left) * (top - bottom) / 16))
    places = cells((left, bottom, right, top), min(settings.block_m, wanted))
    side = min(places[0][2] - places[0][0], places[0][3] - places[0][1])
    search_m = min(settings.search_m, side / 4 - gsd_m)
    found: list[BlockOffset] = []
    if gsd_m <= ALIGN_COARSEST_M and search_m > 2 * gsd_m:
        work = functools.partial(_block_offset, dict(inputs), settings.source, gsd_m, search_m)
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
    write_json(out / "alignment.json", {"region": facts, "blocks": blocks})
    return facts


def _plain(value: Any) -> Any:
    """Numbers to the millimetre, None for what JSON lacks."""
    return (round(value, 3) if np.isfinite(value) else None) if isinstance(value, float) else value


def _block_offset(
    inputs: Inputs, source: ImageryFiles, gsd_m: float, search_m: float, place: Bounds
) -> BlockOffset:
    from brmgeo.ingest.imagery import mosaic_to_lattice
    from brmgeo.segment.alignment import block_offset

    own = lattice(place, str(read_lattice(inputs["lattice"])[0].crs), gsd_m)
    rgb, seen = mosaic_to_lattice(_sources(inputs, source), own)
    return block_offset(rgb, seen, _mask(inputs, own), gsd_m, search_m)


# --- tile-survey: every tile that could be cut ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SplitSettings:
    """How ground is dealt to training, validation and test: see [training] of a region file."""

    bounds: Bounds
    split: str
    block_m: float
    guard_m: float
    validation_share: float
    test_share: float
    seed: int

    def splits(self) -> Splits:
        """The blocks of the ground, or all of it in one split."""
        if self.split != "blocks":
            return one_split(self.bounds, self.split)
        return spatial_splits(
            self.bounds, self.block_m, self.guard_m, self.validation_share, self.test_share, self.seed
        )


@dataclass(frozen=True, slots=True)
class SurveySettings(SplitSettings):
    """Which tiles could be cut, and what is asked of them: see [training] of a region file.

    Attributes:
        align: the labels are moved by their measured offset.
        held: names and bounds of ground that no tile may show.
    """

    region: str
    source: ImageryFiles
    tile_px: int
    overlap_px: int
    gsd_m: tuple[float, ...]
    empty_share: float
    min_known_share: float
    max_cloud_share: float
    align: bool
    held: tuple[tuple[str, Bounds], ...]


def run_survey(inputs: Inputs, out: Path, settings: SurveySettings, map: Map) -> Json:
    """Writes survey.json: all candidates with their split and shares, and why those that are not kept are left out."""
    from brmgeo.ingest.imagery import check_imagery, native_gsd_m

    box, _ = read_lattice(inputs["lattice"])
    native = native_gsd_m(_sources(inputs, settings.source), box)
    fine = [g for g in settings.gsd_m if g * FINEST < native]
    gsds = [g for g in settings.gsd_m if g not in fine]
    if not gsds:
        raise SettingsError(
            f"region {settings.region}: its imagery has {native:.3g} m per pixel, much coarser than all of the "
            f"training.gsd_m {listed([f'{g:g}' for g in fine])}: give coarser ones, or finer imagery"
        )
    grids = {g: grid_at(box, g) for g in gsds}
    todo = [
        (g, first, windows[first : first + SURVEY_TILES])
        for g in gsds
        for windows in [tile_windows(shape_of(grids[g]), settings.tile_px, settings.overlap_px)]
        for first in range(0, len(windows), SURVEY_TILES)
    ]
    work = functools.partial(_survey_some, dict(inputs), settings)
    found = [tile for some in map(work, todo) for tile in some]
    ground = ground_facts(found)
    facts = sampled(found, settings.empty_share, settings.seed) | {
        "imagery_gsd_m": round(native, 4),
        "gsd_m": gsds,
        "gsd_too_fine_m": fine,
        "ground": ground,
    }
    if not facts["kept"]:
        if "unknown" in facts["dropped"]:
            check_imagery(_sources(inputs, settings.source), box)
        place = ", ".join(f"{v:.0f}" for v in settings.bounds)
        hints = {
            "unknown": f"see that map and imagery both reach the region's bounds, {place} in {box.crs}",
            "blank": "see that the imagery is not of one colour there",
            "cloudy": "give clearer imagery, or a larger training.max_cloud_share",
            "empty": "training.empty_share = 1 keeps them",
            "guard": "give a larger training.block_m or a smaller training.guard_m",
            "held-out ground": f"that of {listed([name for name, _ in settings.held])}: give other bounds",
        }
        raise InputError(none_left(settings.region, facts["dropped"], hints))
    (out / "survey.json").write_text(json.dumps({"facts": facts, "tiles": found}), encoding="utf-8")
    return facts


def none_left(region: str, dropped: Mapping[str, int], hints: Mapping[str, str]) -> str:
    """The line for tiles that were all left out: how many for what reason, and the hint for the commonest."""
    most = max(dropped, key=lambda reason: dropped[reason], default="")
    hint = hints.get(most, "check the map, the imagery and [training]")
    return f"{region}: no tile is left: {told_dropped(dropped) or 'none was cut'}; {hint}"


def told_dropped(dropped: Mapping[str, int]) -> str:
    """Such as "12 unknown, 3 without building", the commonest reason first."""
    common = sorted(dropped.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {LEFT_OUT.get(reason, reason)}" for reason, count in common)


def grid_at(box: GeoBox, gsd_m: float) -> GeoBox:
    """The lattice of tiles at one GSD over the region's."""
    return lattice(bounds_of(box), str(box.crs), gsd_m)


def _sources(inputs: Inputs, source: ImageryFiles) -> list[Any]:
    return imagery_sources(source, source.root(inputs))


def _survey_some(
    inputs: Inputs, settings: SurveySettings, todo: tuple[float, int, list[Window]]
) -> list[Json]:
    """The candidates of one GSD from the ``first`` on."""
    from brmgeo.ingest.imagery import mosaic_to_lattice

    gsd_m, first, windows = todo
    box, _ = read_lattice(inputs["lattice"])
    grid, splits = grid_at(box, gsd_m), settings.splits()
    held = [shapely.box(*b) for _, b in settings.held]
    found: list[Json] = []
    for number, window in enumerate(windows, start=first):
        own = window.box_in(grid)
        bounds = bounds_of(own)
        tile: dict[str, Any] = {
            "key": f"{settings.region}-{round(gsd_m * 1000):04d}-{number:05d}",
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
        mask = _mask(inputs, own, settings.align)
        a = own.affine
        coarse = Affine(a.a * COARSE, 0.0, a.c, 0.0, a.e * COARSE, a.f)
        small = GeoBox((window.height // COARSE, window.width // COARSE), coarse, grid.crs)
        rgb, seen = mosaic_to_lattice(_sources(inputs, settings.source), small)
        (built, known), fault = tile_fault(
            mask, rgb, seen, settings.min_known_share, settings.max_cloud_share
        )
        tile |= {"built": round(built, 6), "known": round(known, 6), "dropped": fault}
        if tile["dropped"] is None and tile["split"] is None:
            tile["dropped"] = "guard"
    return found


def _mask(inputs: Inputs, own: GeoBox, align: bool = False) -> NDArray[np.uint8]:
    """(h, w) uint8 building mask of one tile; with ``align`` the map is moved by its offset from the imagery first."""
    offset = label_offset(inputs["alignment"], bounds_of(own)) if align else (0.0, 0.0)
    return mask_of(inputs["footprints"], inputs["lattice"], own, offset)


@functools.lru_cache(maxsize=2)
def surveyed(folder: Path) -> tuple[Json, ...]:
    """The tiles of a survey that are kept."""
    text = json_of((folder / "survey.json").read_bytes())
    return tuple(t for t in text["tiles"] if t["dropped"] is None)


# --- tiles: one shard ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TilesSettings:
    """The stretch of the survey that goes into one shard, ``count`` numbers of one GSD from ``first`` on."""

    region: str
    source: ImageryFiles
    tile_px: int
    align: bool
    gsd_m: float
    first: int
    count: int
    image_format: ImageFormat


def run_tiles(inputs: Inputs, out: Path, settings: TilesSettings, map: Map) -> Json:
    """Writes shard.tar with the kept tiles of one stretch of the survey, and entries.json: its index and counts."""
    from brmgeo.ingest.imagery import mosaic_to_lattice

    first, last = settings.first, settings.first + settings.count
    own = [
        t for t in surveyed(inputs["survey"]) if t["gsd_m"] == settings.gsd_m and first <= t["number"] < last
    ]
    rows, tallies = [], {split: Tally() for split in SPLITS}
    if own:
        box, _ = read_lattice(inputs["lattice"])
        grid = grid_at(box, settings.gsd_m)
        with ShardWriter(out / "shard.tar", image_format=settings.image_format) as shard:
            for tile in own:
                window = Window(tile["row"], tile["col"], settings.tile_px, settings.tile_px)
                place = window.box_in(grid)
                rgb, seen = mosaic_to_lattice(_sources(inputs, settings.source), grid, window)
                # Filler is no ground, whether its file says so or not.
                label = blank_unknown(rgb, make_label(_mask(inputs, place, settings.align), seen))
                built, known = shares(label)
                info = TileInfo(
                    key=tile["key"],
                    shard=0,
                    gsd_m=tile["gsd_m"],
                    split=tile["split"],
                    region=settings.region,
                    building_share=round(built, 6),
                    known_share=round(known, 6),
                    bounds=bounds_of(place),
                    crs=str(box.crs),
                )
                shard.add(info, rgb, label)
                tallies[tile["split"]].add(rgb, label)
        rows = [entry_row(entry) for entry in shard.entries]
    write_entries(out, rows, tallies)
    return {"tiles": len(rows)}


def write_entries(out: Path, rows: Sequence[Json], tallies: Mapping[str, Tally]) -> None:
    """entries.json of a shard: its rows of the index, and what was counted in it."""
    text = {"rows": rows, "tallies": {split: asdict(tally) for split, tally in tallies.items()}}
    (out / "entries.json").write_text(json.dumps(text), encoding="utf-8")


# --- tile-index: what a person and a program look at first --------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DealtBlocks:
    """The blocks of the ground: name of the split, left, bottom, right, top of each."""

    guard_m: float
    blocks: tuple[tuple[str, float, float, float, float], ...]


@dataclass(frozen=True, slots=True)
class SourceCredit:
    """Whose something is, and how it may be used."""

    what: str
    attribution: str
    terms: str


@dataclass(frozen=True, slots=True)
class IndexSettings:
    """What the index says besides what it counts; None for what nobody knows of foreign pairs."""

    region: str
    title: str
    hold_out: bool
    tile_px: int | None
    overlap_px: int
    shards: tuple[str, ...]
    align: bool
    blocks: DealtBlocks | None
    credit: str
    sources: tuple[SourceCredit, ...]


def run_index(inputs: Inputs, out: Path, settings: IndexSettings, map: Map) -> Json:
    """Writes index.csv, index.gpkg (where the tiles' places are known) and tiles.json over all shards."""
    from brmgeo.export.training_tiles import write_tiles_gpkg

    rows: list[Json] = []
    shards: list[Json] = []
    tallies = {split: Tally() for split in SPLITS}
    for name in settings.shards:
        folder = inputs[name]
        text = json_of((folder / "entries.json").read_bytes())
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
    facts = json_of((inputs["survey"] / "survey.json").read_bytes())["facts"]
    if not rows:
        raise InputError(none_left(settings.region, facts["dropped"], {}))
    write_index(out / INDEX_CSV, rows)
    offsets = None
    if "alignment" in inputs:
        offsets = json_of((inputs["alignment"] / "alignment.json").read_bytes())
    if all(row["left"] is not None for row in rows):
        write_tiles_gpkg(out / "index.gpkg", rows, settings.credit, offsets["blocks"] if offsets else [])
    statistics = next(split for split in SPLITS if tallies[split].tiles)
    whole = {
        "format": FORMAT,
        "version": VERSION,
        "region": settings.region,
        "title": settings.title,
        "hold_out": settings.hold_out,
        "tiles": len(rows),
        "tile_px": settings.tile_px,
        "overlap_px": settings.overlap_px,
        "labels": {"0": "other", "127": "unknown", "255": "building"},
        "by_gsd_m": _counted(rows, "gsd_m"),
        "by_split": _counted(rows, "split"),
        "splits": {
            split: tally.told() | {"by_gsd_m": _counted([r for r in rows if r["split"] == split], "gsd_m")}
            for split, tally in tallies.items()
            if tally.tiles
        },
        # Of training tiles wherever there are some; brmgeo's own network is normalised with constants instead.
        "statistics": {"split": statistics} | tallies[statistics].colour_told(),
        "survey": facts,
        "alignment": None if offsets is None else {"corrected": settings.align} | offsets["region"],
        "blocks": plain(settings.blocks),
        "sources": plain(settings.sources),
        "shards": shards,
    }
    write_json(out / TILES_JSON, whole)
    return {"tiles": len(rows), "by_split": whole["by_split"], "shards": len(shards)}


def _counted(rows: Sequence[Json], column: str) -> Json:
    return {str(name): count for name, count in sorted(Counter(row[column] for row in rows).items())}


ALIGNMENT = Stage("alignment", 1, run_alignment)
SURVEY = Stage("tile-survey", 2, run_survey)
TILES = Stage("tiles", 2, run_tiles)
INDEX = Stage("tile-index", 2, run_index)
