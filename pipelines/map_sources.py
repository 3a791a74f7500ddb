"""Where the maps of a region come from: the files of its footprints and its imagery, found below its source folder."""

from __future__ import annotations

import functools
import glob
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError, listed
from brmgeo.files import digest_of
from brmgeo.geo.formats import open_raster
from brmgeo.geo.grid import Bounds, as_bounds, bounds_of, lattice
from brmgeo.geo.sheets import sheet_extent, sheet_number_in
from brmgeo.geo.tilegrid import grid_named
from brmgeo.region import ImagerySettings, MapSettings
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.stage import unstated
from brmgeo.workflow.store import Input

from .regions import where_to_get

if TYPE_CHECKING:
    from brmgeo.ingest.imagery import ImagerySource
    from brmgeo.ingest.tiles import MBTiles, TileFolder

RASTER_SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg", ".png", ".jp2", ".img")
VECTOR_SUFFIXES = (".dxf", ".shp", ".gpkg", ".geojson", ".json", ".parquet", ".fgb")


# --- footprints -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SourceFile:
    """One source of footprints: its files (``file`` and what belongs to it) or the folder that holds it as ``member``,
    a name of its own among all, and the sheet that its path states."""

    inputs: Mapping[str, Input]
    member: str
    name: str
    sheet: str | None


def find_sources(region: MapSettings, source_dir: Path) -> list[SourceFile]:
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


def _number_of(path: Path, region: MapSettings) -> str | None:
    """The sheet that a file's name (or, of NGII's shapefiles, its folder's) states: the region's, else any it could be."""
    for name in (path.name, path.parent.name):
        for number in sorted(region.sheets, key=len, reverse=True):
            if number in name:
                return number
    return sheet_number_in(path.name) if path.suffix.lower() == ".dxf" else None


# --- imagery --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImageryFiles:
    """What an imagery source is, but for the place of its files: those of a folder or MBTiles file, or of a folder by name.

    Attributes:
        kind, grid, level, template, crs, value_range, bands, pixel_ratio: as of [imagery] in a region file.
        member: of the input that is a folder, the folder of tiles in it.
        files: names of rasters, all in one folder.
    """

    kind: str
    grid: str
    level: int | None
    template: str | None
    member: str
    files: tuple[str, ...]
    crs: str | None
    value_range: tuple[float, float] | None
    bands: tuple[int, ...] | None
    # What was made before there was a choice stays fresh.
    pixel_ratio: int = unstated(1)

    @classmethod
    def of(cls, given: ImagerySettings, member: str = "", files: Iterable[str] = ()) -> ImageryFiles:
        """What the [imagery] of a region file says of its files."""
        return cls(
            kind=given.kind,
            grid=given.grid,
            level=given.level,
            template=given.template,
            member=member,
            files=tuple(files),
            crs=given.crs,
            value_range=given.value_range,
            bands=given.bands,
            pixel_ratio=given.pixel_ratio,
        )

    def root(self, inputs: Mapping[str, Path]) -> Path:
        """The folder or MBTiles file of the source among a stage's inputs: its rasters by their names, else ``imagery``."""
        return inputs[self.files[0]].parent if self.files else inputs["imagery"]


@functools.lru_cache(maxsize=4)
def imagery_sources(source: ImageryFiles, root: Path) -> list[ImagerySource]:
    """The adapters of an imagery source over local files below ``root``."""
    from brmgeo.ingest.imagery import GeoRaster, NgiiOrtho

    if source.kind != "raster":
        return [tile_source(source, root)]
    found: list[ImagerySource] = []
    for path in (root / name for name in source.files):
        number = sheet_number_in(path.name)
        if number is not None and not _is_placed(path):
            found.append(NgiiOrtho(path, number, value_range=source.value_range))
        else:
            found.append(GeoRaster(path, crs=source.crs, bands=source.bands, value_range=source.value_range))
    return found


def tile_source(source: ImageryFiles, root: Path) -> MBTiles | TileFolder:
    """The tiles of an imagery source that is no raster, below ``root``."""
    from brmgeo.ingest.tiles import MBTiles, TileFolder

    if source.kind == "mbtiles":
        return MBTiles.open(root, source.level, source.pixel_ratio)
    assert source.level is not None
    folder = root / source.member if source.member else root
    return TileFolder(
        folder, grid_named(source.grid), source.level, source.template, pixel_ratio=source.pixel_ratio
    )


def _is_placed(path: Path) -> bool:
    """Whether a raster says where it lies, by its own header or a world file beside it."""
    import warnings

    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with open_raster(path) as src:
                return not src.transform.is_identity or bool(src.gcps[0]) or src.rpcs is not None
        except (InputError, RasterioError):
            return True  # the adapter says what is wrong with it


def imagery_inputs(
    region: MapSettings, given: ImagerySettings, source_dir: Path, fetch: bool
) -> tuple[dict[str, Input], ImageryFiles]:
    """The local files of an imagery source, by name, and what the stage must know of them; with ``fetch`` those of a service
    are fetched first.

    Raises MissingInputError: which files or tiles, where they go, where to get them.
    """
    path = source_dir / given.path
    if given.kind == "service":
        cache = _service_tiles(region, given, source_dir, fetch)
        return {"imagery": cache}, ImageryFiles.of(given)
    if given.kind == "raster":
        files = _rasters(region, path)
        inputs: dict[str, Input] = {p.name: p for file in files for p in (file, *_beside(file))}
        return inputs, ImageryFiles.of(given, files=[f.name for f in files])
    if not path.exists():
        raise MissingInputError(
            f"region {region.name}: imagery is missing: {path} is not there; put "
            f"{'a folder of tiles' if given.kind == 'tiles' else 'the MBTiles file'} there (grid {given.grid}, level "
            f"{given.level}{_tile_range(region, given)}), or take [imagery] out of the region file"
        )
    from brmgeo.ingest.tiles import ensure_tiles

    source = ImageryFiles.of(given)
    ensure_tiles(tile_source(source, path), place_of(region), region.crs, missing_ok=given.missing_share)
    return {"imagery": path}, source


def _tile_range(region: MapSettings, given: ImagerySettings) -> str:
    if given.kind != "tiles" or given.level is None:
        return ""
    tiles = grid_named(given.grid).covering(place_of(region), region.crs, given.level)
    xs, ys = [t.x for t in tiles], [t.y for t in tiles]
    return f": {len(tiles)} tiles, x {min(xs)}-{max(xs)}, y {min(ys)}-{max(ys)}"


def _service_tiles(region: MapSettings, given: ImagerySettings, source_dir: Path, fetch: bool) -> Path:
    """The folder in which the tiles of a service are kept, filled when asked for."""
    from brmgeo.ingest.tiles import TileService, ensure_tiles

    assert given.url is not None
    assert given.level is not None
    name = f"{given.grid}-{given.level}-{digest_of(given.url)[:8]}"
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


def _rasters(region: MapSettings, path: Path) -> list[Path]:
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


@dataclass(frozen=True, slots=True)
class NativeImagery:
    """A region's imagery at its sources' own metres per pixel, cut where it is asked for; small, so that it travels."""

    source: ImageryFiles
    root: Path
    crs: str
    gsd_m: float

    def around(self, bounds: Bounds) -> tuple[NDArray[np.uint8], float, float]:
        """(rgb (h, w, 3), left, top) over (left, bottom, right, top); pixels that no source knows are 0."""
        from brmgeo.ingest.imagery import mosaic_to_lattice

        box = lattice(bounds, self.crs, self.gsd_m)
        left, _, _, top = bounds_of(box)
        return mosaic_to_lattice(imagery_sources(self.source, self.root), box)[0], left, top


def finer_imagery(region: MapSettings, source: ImageryFiles, root: Path) -> NativeImagery | None:
    """The imagery of a region where it is finer than the region's lattice, by a whole number of steps; else None."""
    from brmgeo.ingest.imagery import native_gsd_m

    box = lattice(place_of(region), region.crs, region.gsd_m)
    native = native_gsd_m(imagery_sources(source, root), box)
    steps = math.floor(region.gsd_m / native + 0.05)
    return NativeImagery(source, root, region.crs, region.gsd_m / steps) if steps > 1 else None


# --- both -----------------------------------------------------------------------------------------------------


def place_of(region: MapSettings) -> Bounds:
    """(left, bottom, right, top) that a region covers: its bounds, else those of its sheets."""
    return as_bounds(region.bounds) if region.bounds is not None else _sheets_bounds(region)


def _sheets_bounds(region: MapSettings) -> Bounds:
    extents = np.array([sheet_extent(s, region.crs) for s in region.sheets])
    return as_bounds([*extents[:, :2].min(axis=0), *extents[:, 2:].max(axis=0)])


def credits(region: MapSettings) -> str:
    """Whose the footprints and the imagery of a region are, each said once."""
    parts = [region.footprints.attribution, region.imagery.attribution if region.imagery else ""]
    return "; ".join(dict.fromkeys(p for p in parts if p))
