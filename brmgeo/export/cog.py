"""Rasters out: how every GeoTIFF of brmgeo is written. ``geo.raster`` reads them back.

A raster is written as a cloud-optimised GeoTIFF (COG) in two steps, because overviews need the finished pixels: blocks go,
in any order, into a tiled scratch file beside the result, and one pass of GDAL's COG driver lays down overviews and
data. Only the finished, checked file gets the final name, by an atomic rename. Memory stays at a few blocks
whatever the raster's size, and the same pixels give the same bytes however they were cut into blocks.

============ ======================= ========== ============================== =========================================
kind         stored as               unknown    compression                    overviews
============ ======================= ========== ============================== =========================================
``mask``     uint8 0, 1              255        ZSTD                           MODE (averages would inflate coverage)
``ratio``    uint16 x 1e-4           65535      ZSTD, predictor 2              AVERAGE of known cells
``imagery``  3 x uint8 and a mask    mask = 0   JPEG 90 (YCbCr), or ZSTD       AVERAGE of known cells
============ ======================= ========== ============================== =========================================

Match on full resolution only; overviews are for looking. Band statistics (``STATISTICS_*``, in stored units) are exact:
they come from counts of every stored value. Those of JPEG imagery describe the pixels before compression and say so
(``STATISTICS_APPROXIMATE``).
"""

from __future__ import annotations

import contextlib
import errno
import glob
import logging
import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
import rasterio.shutil
import rasterio.windows
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio._err import CPLE_BaseError
from rasterio.errors import RasterioError

from brmgeo import files
from brmgeo.codes import RATIO_SCALE, RATIO_UNKNOWN, UNKNOWN
from brmgeo.errors import WorkflowError, one_line
from brmgeo.geo.grid import Window, blocks

Kind = Literal["mask", "ratio", "imagery"]
Rgb = tuple[NDArray[np.uint8], NDArray[np.bool_]]
Block = NDArray[Any] | Rgb

BLOCK_PX = 512
# Blocks of whole arrays: a multiple of BLOCK_PX, small enough that counting values needs little memory.
_SLICE_PX = 2048
# rasterio takes bytes here. Small, so that GDAL writes as it goes: it must not hold a twentieth of the machine's memory.
_CACHE_BYTES = 32 << 20


@dataclass(frozen=True, slots=True)
class BandStatistics:
    """Exact statistics of one band over its known pixels, in natural units (ratios in [0, 1], not stored counts)."""

    known_px: int
    minimum: float
    maximum: float
    mean: float
    std: float


def write_cog(
    path: Path,
    data: Block | Iterable[tuple[Window, Block]],
    box: GeoBox,
    *,
    kind: Kind,
    radii_m: Sequence[float] = (),
    band_descriptions: Sequence[str] = (),
    tags: Mapping[str, str] | None = None,
    colormap: Mapping[int, tuple[int, int, int, int]] | None = None,
    lossless: bool = False,
) -> list[BandStatistics]:
    """Write one raster of the region as a COG at ``path``; gives the statistics of each band.

    Args:
        path: the final name; its folder must exist. It appears only when the file is complete.
        data: the whole raster, or (window, block) pairs that tile ``box`` once, in any order. Blocks are
            ``mask``: (h, w) uint8 or bool, 0, 1 or 255 = unknown;
            ``ratio``: (bands, h, w) uint16 as stored, or float in [0, 1] with NaN = unknown (see ``encode_ratio``);
            ``imagery``: the pair (rgb, valid) of (h, w, 3) uint8 and (h, w) bool.
            Multiples of 512 px per block keep the scratch file small.
        box: the lattice of the raster.
        kind: which rules of the table above apply.
        radii_m: radius of each band of a ``ratio``, metres, kept exactly in the band tag ``radius_m``.
        band_descriptions: one per band; the default names what the band is.
        tags: metadata of the file, such as those of ``output_tags``.
        colormap: value -> (red, green, blue, alpha) for a ``mask``.
        lossless: imagery only: ZSTD instead of JPEG.

    Raises WorkflowError when the file cannot be written (no space left, no permission), naming the reason; ValueError when
    blocks break the promises above, which is a defect of the caller.
    """
    layout = _Layout(
        kind, tuple(radii_m), tuple(band_descriptions), dict(tags or {}), dict(colormap or {}), lossless
    )
    layout.check()
    path = Path(path)
    rows, cols = (int(n) for n in box.shape)
    pieces = _sliced(data, (rows, cols)) if isinstance(data, (np.ndarray, tuple)) else data
    # What GDAL may hold back in its cache must always fit: running into the end of the disk, GDAL also writes to stderr.
    reserve = min(rows * cols * layout.count * np.dtype(layout.dtype).itemsize, _CACHE_BYTES)
    files.clear_scratch(path.parent)
    try:
        with files.whole_file(path, durable=True) as part:
            _check_writable(part)
            try:
                with _gdal(path), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_CACHEMAX=_CACHE_BYTES):
                    scratch = part.with_name(f"{part.name}.blocks.tif")
                    stats = _write_blocks(scratch, pieces, box, layout, reserve)
                    # The result and its overviews (a third), and these once more while they are made; JPEG is far smaller.
                    share = 0.1 if kind == "imagery" and not lossless else 1.3
                    _check_space(part, int(share * scratch.stat().st_size))
                    rasterio.shutil.copy(scratch, part, driver="COG", **_cog_options(kind, lossless))
                _check_complete(part, path)
            finally:
                # GDAL leaves its own scratch files (overviews, masks) beside the part file when it is stopped.
                for left in path.parent.glob(f"{glob.escape(part.name)}.*"):
                    left.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from error
    return stats


@dataclass(frozen=True, slots=True)
class _Layout:
    """What a raster's file holds besides pixels; see ``write_cog``."""

    kind: Kind
    radii_m: tuple[float, ...]
    band_descriptions: tuple[str, ...]
    tags: dict[str, str]
    colormap: dict[int, tuple[int, int, int, int]]
    lossless: bool

    @property
    def count(self) -> int:
        """Number of bands."""
        return {"mask": 1, "ratio": len(self.radii_m), "imagery": 3}[self.kind]

    @property
    def dtype(self) -> str:
        return "uint16" if self.kind == "ratio" else "uint8"

    @property
    def names(self) -> tuple[str, ...]:
        """One description a band."""
        return self.band_descriptions or _default_descriptions(self.kind, self.radii_m)

    def check(self) -> None:
        if self.kind == "ratio" and not self.radii_m:
            raise ValueError("a ratio raster needs radii_m, one radius for each band")
        if len(self.names) != self.count:
            raise ValueError(f"{len(self.names)} band descriptions for {self.count} bands")


def _write_blocks(
    scratch: Path, pieces: Iterable[tuple[Window, Block]], box: GeoBox, layout: _Layout, reserve: int
) -> list[BandStatistics]:
    """The tiled scratch file with pixels, masks, tags and colours; ``reserve`` bytes stay free beside it."""
    rows, cols = (int(n) for n in box.shape)
    counts = np.zeros((layout.count, np.iinfo(layout.dtype).max + 1), dtype=np.int64)
    seen = 0
    _check_space(scratch, reserve)
    with rasterio.open(
        scratch,
        "w",
        driver="GTiff",
        height=rows,
        width=cols,
        count=layout.count,
        dtype=layout.dtype,
        crs=_rasterio_crs(box),
        transform=box.affine,
        nodata={"mask": UNKNOWN, "ratio": RATIO_UNKNOWN, "imagery": None}[layout.kind],
        tiled=True,
        blockxsize=BLOCK_PX,
        blockysize=BLOCK_PX,
        interleave="pixel",
        compress="zstd",
        zstd_level=1,
        predictor=2,
        bigtiff="IF_SAFER",
        **({"photometric": "RGB"} if layout.kind == "imagery" else {}),
    ) as dst:
        for window, block in pieces:
            values, valid = _checked(layout.kind, block, window, (rows, cols), layout.count)
            target = rasterio.windows.Window(window.col, window.row, window.width, window.height)
            dst.write(values, window=target)
            if valid is not None:
                dst.write_mask(valid, window=target)
            for band in range(layout.count):
                known = values[band] if valid is None else values[band][valid]
                counts[band] += np.bincount(known.ravel(), minlength=counts.shape[1])
            _check_space(scratch, reserve)
            seen += window.height * window.width
        if seen != rows * cols:
            raise ValueError(f"blocks hold {seen} pixels of {rows * cols}: they must tile the lattice once")
        stats = [_statistics(layout.kind, c) for c in counts]
        _describe(dst, layout, stats)
    return stats


def _describe(dst: Any, layout: _Layout, stats: Sequence[BandStatistics]) -> None:
    """Tags, band names, scales and colours."""
    dst.update_tags(**dict(sorted(layout.tags.items())))
    for band, name in enumerate(layout.names, start=1):
        dst.set_band_description(band, name)
        own = {"radius_m": repr(float(layout.radii_m[band - 1]))} if layout.kind == "ratio" else {}
        approximate = layout.kind == "imagery" and not layout.lossless
        dst.update_tags(band, **own, **_statistics_tags(layout.kind, stats[band - 1], approximate))
    if layout.kind == "ratio":
        dst.scales = (RATIO_SCALE,) * layout.count
    if layout.kind == "mask" and layout.colormap:
        dst.write_colormap(1, layout.colormap)


def encode_ratio(ratio: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Ratios as stored: uint16 steps of 1e-4, 65535 for NaN, from any float array in [0, 1]; ValueError outside."""
    unknown = np.isnan(ratio)
    steps = np.floor(np.where(unknown, 0.0, ratio).astype(np.float64) / RATIO_SCALE + 0.5)
    if steps.size and not (steps.min() >= 0 and steps.max() <= round(1 / RATIO_SCALE)):
        raise ValueError("ratios lie outside [0, 1]")
    out = steps.astype(np.uint16)
    out[unknown] = RATIO_UNKNOWN
    return out


def output_tags(stage_key: str, region: str, attribution: str = "", terms: str = "") -> dict[str, str]:
    """The file metadata that every result carries; empty ones are left out."""
    tags = {
        "STAGE_KEY": stage_key,
        "REGION": region,
        "ATTRIBUTION": attribution,
        "TERMS": terms,
        "SOFTWARE": "brmgeo",
    }
    return {name: value for name, value in tags.items() if value}


def _sliced(data: Block, shape: tuple[int, int]) -> Iterator[tuple[Window, Block]]:
    """A whole raster as blocks."""
    for window in blocks(shape, _SLICE_PX):
        rows, cols = window.slices
        if isinstance(data, tuple):
            yield window, (data[0][rows, cols], data[1][rows, cols])
        else:
            yield window, data[..., rows, cols]


def _checked(
    kind: Kind, block: Block, window: Window, shape: tuple[int, int], count: int
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """(bands, h, w) as stored and the validity of imagery, after checking what the caller promised."""
    inside = 0 <= window.row <= shape[0] - window.height and 0 <= window.col <= shape[1] - window.width
    if not inside or window.height <= 0 or window.width <= 0:
        raise ValueError(f"{window} is not inside a raster of {shape[0]} x {shape[1]}")
    values: NDArray[Any]
    valid: NDArray[np.bool_] | None = None
    if kind == "imagery":
        if not isinstance(block, tuple):
            raise ValueError("a block of imagery is the pair (rgb, valid)")
        rgb, valid = block
        # Unknown pixels are black, so that nothing invented lies under the mask.
        values = np.ascontiguousarray(np.moveaxis(np.where(valid[..., None], rgb, 0), -1, 0))
    else:
        if isinstance(block, tuple):
            raise ValueError(f"a block of a {kind} is one array")
        values = block if block.ndim == 3 else block[None]
        if kind == "ratio" and values.dtype.kind == "f":
            values = encode_ratio(values)
        if kind == "mask" and values.dtype == bool:
            values = values.astype(np.uint8)
    wanted = np.uint16 if kind == "ratio" else np.uint8
    if values.shape != (count, window.height, window.width) or values.dtype != wanted:
        raise ValueError(f"a block of {values.shape} {values.dtype} does not fit {count} bands of {window}")
    top = {"mask": 1, "ratio": round(1 / RATIO_SCALE), "imagery": 255}[kind]
    unknown = {"mask": UNKNOWN, "ratio": RATIO_UNKNOWN, "imagery": -1}[kind]
    if kind != "imagery" and ((values > top) & (values != unknown)).any():
        raise ValueError(f"a {kind} holds values over {top} that are not {unknown} (unknown)")
    return values, valid


def _statistics(kind: Kind, counts: NDArray[np.int64]) -> BandStatistics:
    """Exact statistics from the number of pixels of each stored value."""
    counts = counts.copy()
    if kind != "imagery":
        counts[-1] = 0  # the last value of the dtype means unknown
    values = np.flatnonzero(counts)
    if not values.size:
        return BandStatistics(0, math.nan, math.nan, math.nan, math.nan)
    # Python integers: sums of squares of a 22k x 22k ratio raster leave the range where float64 is exact.
    total = sum(int(counts[v]) for v in values)
    first = sum(int(counts[v]) * int(v) for v in values)
    second = sum(int(counts[v]) * int(v) ** 2 for v in values)
    std = math.sqrt(total * second - first * first) / total
    scale = RATIO_SCALE if kind == "ratio" else 1.0
    low, high = int(values[0]), int(values[-1])
    return BandStatistics(total, low * scale, high * scale, first / total * scale, std * scale)


def _statistics_tags(kind: Kind, stats: BandStatistics, approximate: bool) -> dict[str, str]:
    """GDAL's band metadata, in stored units; none for a band without a known pixel."""
    if not stats.known_px:
        return {}
    scale = RATIO_SCALE if kind == "ratio" else 1.0
    tags = {
        "STATISTICS_MINIMUM": repr(round(stats.minimum / scale)),
        "STATISTICS_MAXIMUM": repr(round(stats.maximum / scale)),
        "STATISTICS_MEAN": f"{stats.mean / scale:.12g}",
        "STATISTICS_STDDEV": f"{stats.std / scale:.12g}",
    }
    return {"STATISTICS_APPROXIMATE": "YES", **tags} if approximate else tags


def _default_descriptions(kind: Kind, radii_m: Sequence[float]) -> tuple[str, ...]:
    if kind == "ratio":
        return tuple(f"building ratio within {radius:g} m" for radius in radii_m)
    return ("building (1), other (0), unknown (255)",) if kind == "mask" else ("red", "green", "blue")


def _cog_options(kind: Kind, lossless: bool) -> dict[str, str]:
    """Creation options of GDAL's COG driver for one kind."""
    common = {"BLOCKSIZE": str(BLOCK_PX), "BIGTIFF": "IF_SAFER", "OVERVIEWS": "IGNORE_EXISTING"}
    if kind == "imagery" and not lossless:
        return {
            **common,
            "COMPRESS": "JPEG",
            "QUALITY": "90",
            "OVERVIEW_QUALITY": "85",
            "RESAMPLING": "AVERAGE",
        }
    # Predictor 2 earns nothing on 0/1 masks.
    predictor = "NO" if kind == "mask" else "STANDARD"
    resampling = "MODE" if kind == "mask" else "AVERAGE"
    return {**common, "COMPRESS": "ZSTD", "LEVEL": "3", "PREDICTOR": predictor, "RESAMPLING": resampling}


def _rasterio_crs(box: GeoBox) -> Any:
    if box.crs is None:
        raise ValueError("the lattice has no CRS")
    epsg = box.crs.to_epsg()
    return rasterio.crs.CRS.from_epsg(epsg) if epsg else rasterio.crs.CRS.from_wkt(box.crs.to_wkt())


class _Recorder(logging.Handler):
    """Keeps the error messages that GDAL reports while it flushes: rasterio logs them and goes on."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.errors: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or "CPLE_FileIO" in message or "No space" in message:
            self.errors.append(message)


@contextlib.contextmanager
def _gdal(path: Path) -> Iterator[None]:
    """Turns what GDAL raises, and what it only logs, while writing ``path`` into one WorkflowError."""
    recorder = _Recorder()
    log = logging.getLogger("rasterio")
    log.addHandler(recorder)
    try:
        yield
    except (RasterioError, CPLE_BaseError) as error:
        reasons = [*recorder.errors, str(error)]
        cause = error.__cause__ or error.__context__
        if cause is not None:
            reasons.append(str(cause))
        raise _unwritable(path, OSError("; ".join(reasons))) from error
    finally:
        log.removeHandler(recorder)
    if recorder.errors:
        raise _unwritable(path, OSError("; ".join(recorder.errors)))


def _unwritable(path: Path, error: OSError) -> WorkflowError:
    """One line: which file, why, and what to do. GDAL tells what the disk said in words of its own, without a number."""
    found = error.strerror or one_line(error)
    why = files.reason(error)
    if any(words in found.lower() for words in ("no space", "quota", "too large")):
        why = why or files.reason_of(errno.ENOSPC)
    if why is None:
        return WorkflowError(
            f"cannot write {path}: {found}; check the folder, its permissions and its free space"
        )
    return WorkflowError(f"cannot write {path}: {why} ({found})")


def _check_space(path: Path, need: int) -> None:
    """Raises OSError (ENOSPC) where fewer than ``need`` bytes are free beside ``path``."""
    free = shutil.disk_usage(path.parent).free
    if free < need:
        found = f"{free / 1e6:.1f} MB free in {path.parent}, {need / 1e6:.1f} MB wanted"
        raise OSError(errno.ENOSPC, found)


def _check_writable(part: Path) -> None:
    """Fails early, with the system's own reason, where nothing can be written."""
    with open(part, "wb"):
        pass
    part.unlink()


def _check_complete(part: Path, path: Path) -> None:
    """The data blocks of full resolution come last in a COG: the file must reach to the end of the last one.

    GDAL can miss a failed write at close, so what it says is not enough.
    """
    size = part.stat().st_size
    try:
        with rasterio.open(part, driver="GTiff") as src:
            last_x, last_y = (src.width - 1) // BLOCK_PX, (src.height - 1) // BLOCK_PX
            start = src.get_tag_item(f"BLOCK_OFFSET_{last_x}_{last_y}", "TIFF", bidx=1)
            length = src.get_tag_item(f"BLOCK_SIZE_{last_x}_{last_y}", "TIFF", bidx=1)
    except (RasterioError, CPLE_BaseError) as error:
        raise _unwritable(path, OSError(one_line(error))) from error
    # A block of nodata only may be left out of the file; then there is nothing to check.
    if start is not None and length is not None and size < int(start) + int(length):
        raise _unwritable(path, OSError(f"the file ends at byte {size}, before its last block"))
