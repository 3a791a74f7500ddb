"""A generated region as the files that a real one is made from: NGII sheets and a folder of imagery tiles."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from brmgeo import files
from brmgeo.geo.grid import Bounds
from brmgeo.geo.tilegrid import KakaoGrid
from brmgeo.synth.imagery import Painter, tile_blocks, write_tiles
from brmgeo.synth.scene import Town, TownStyle
from brmgeo.synth.sheets import write_sheets
from brmgeo.synth.town import generate_town

T = TypeVar("T")
R = TypeVar("R")


class Mapper(Protocol):
    """``map`` in this process or over others: results in the order of the items."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]: ...


def write_region(
    out_dir: Path,
    bounds: Bounds,
    seed: int,
    sheets: Sequence[str],
    *,
    crs: str = "EPSG:5187",
    level: int = 1,
    style: TownStyle | None = None,
    map: Mapper = map,
) -> dict[str, Any]:
    """Writes ``sheets/*.dxf``, ``tiles/L{level}/{y}/{x}.jpg`` and ``manifest.json`` into ``out_dir``; returns the manifest.

    Args:
        out_dir: an existing folder, visible to whatever ``map`` runs on.
        bounds, seed, style, crs: of the town, as ``generate_town``.
        sheets: NGII sheet numbers to draw, in R12 and R2013 by turns.
        level: level of Kakao's tile grid, 1 (0.25 m) to 3 (1 m).
        map: takes the sheets and blocks of tiles, each a job of its own; the files do not depend on it.

    Returns ``write_sheets``' manifest with ``buildings``, ``area_m2`` (within the bounds) and ``tiles`` (their number).
    Raises SettingsError as ``generate_town`` and ``write_sheets`` do.
    """
    town = generate_town(bounds, seed, style, crs)
    frozen = pickle.dumps(town, protocol=5)
    # Workers read the town from a file, once each: as an argument it would travel with every block.
    parcel = out_dir / ".town.pickle"
    parcel.write_bytes(frozen)
    try:
        work = functools.partial(_write_part, out_dir, files.digest_of(frozen), tuple(sheets), level)
        # Sheets first: they are the longest jobs.
        jobs: list[tuple[str, int]] = [("sheet", i) for i in range(len(sheets))]
        jobs += [("tiles", k) for k in range(len(tile_blocks(town, level)))]
        parts = list(map(work, jobs))
    finally:
        parcel.unlink()
    manifest: dict[str, Any] = {**parts[0], "sheets": {}} if sheets else {}
    for part in parts[: len(sheets)]:
        manifest["sheets"] |= part["sheets"]
    manifest["buildings"] = len(town.buildings)
    manifest["area_m2"] = town.built_area_m2()
    manifest["tiles"] = sum(part["tiles"] for part in parts[len(sheets) :])
    files.write_json(out_dir / "manifest.json", manifest)
    return manifest


def _write_part(
    out_dir: Path, digest: str, sheets: tuple[str, ...], level: int, job: tuple[str, int]
) -> dict[str, Any]:
    kind, k = job
    town = _town(out_dir / ".town.pickle", digest)
    if kind == "sheet":
        return write_sheets(town, out_dir / "sheets", sheets, only=(sheets[k],))
    painter = _painter(out_dir / ".town.pickle", digest, level)
    return {"tiles": write_tiles(painter, tile_blocks(town, level)[k], out_dir / "tiles", level)}


@functools.lru_cache(maxsize=1)
def _town(path: Path, digest: str) -> Town:
    """The town in a file; ``digest`` tells apart two that lay at one path."""
    frozen = path.read_bytes()
    assert files.digest_of(frozen) == digest
    town = pickle.loads(frozen)
    assert isinstance(town, Town)
    return town


@functools.lru_cache(maxsize=1)
def _painter(path: Path, digest: str, level: int) -> Painter:
    grid = KakaoGrid()
    return Painter(_town(path, digest), grid.crs, grid.gsd_m(level))
