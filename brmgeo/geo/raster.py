"""Rasters in: pixels, placement and bands of the GeoTIFFs of a region, as ``export.cog`` writes them.

``read_raster`` needs rasterio alone, so that a program aboard reads its map with few libraries; ``box_of`` is for who
makes rasters on the same lattice.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rasterio
import rasterio.windows
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError, RasterioIOError

from brmgeo.codes import RATIO_SCALE, RATIO_UNKNOWN
from brmgeo.errors import InputError, MissingInputError, one_line
from brmgeo.geo.formats import open_raster
from brmgeo.geo.grid import Bounds, Window

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """A whole raster and where it lies.

    Attributes:
        pixels: (bands, h, w) stored values in the file's dtype; row 0 is the northernmost.
        left, top: outer corner of pixel (0, 0), metres in ``crs``.
        gsd_m: metres per pixel.
        crs: code ("EPSG:5187"), or WKT where there is no code.
    """

    pixels: NDArray[Any]
    left: float
    top: float
    gsd_m: float
    crs: str

    @property
    def bounds(self) -> Bounds:
        """(left, bottom, right, top), metres in ``crs``."""
        rows, cols = self.pixels.shape[1:]
        return (self.left, self.top - rows * self.gsd_m, self.left + cols * self.gsd_m, self.top)


def read_raster(path: Path) -> Raster:
    """A whole raster with its place.

    Raises MissingInputError where it is not there; InputError where it cannot be read, has no CRS, or its pixels are no
    squares with north up.
    """
    with opened(path) as src:
        place = src.transform
        crs = _crs_of(src, path)
        if place.b or place.d or place.a <= 0 or place.e != -place.a:
            raise InputError(f"{path}: its pixels are no squares with north up: it was not written by brmgeo")
        return Raster(_read(src, path, None, None), float(place.c), float(place.f), float(place.a), crs)


def box_of(path: Path) -> GeoBox:
    """The lattice of a raster; raises MissingInputError or InputError where there is no readable, placed raster."""
    from odc.geo.geobox import GeoBox

    with opened(path) as src:
        return GeoBox(src.shape, src.transform, _crs_of(src, path))


def radii_of(path: Path) -> tuple[float, ...]:
    """Radius of each band of a ratio raster, metres; raises InputError where the raster does not state them."""
    with opened(path) as src:
        try:
            return tuple(float(src.tags(band)["radius_m"]) for band in src.indexes)
        except (KeyError, ValueError):
            raise InputError(
                f"{path} is no ratio raster: its bands state no radius_m; build the maps again"
            ) from None


def decode_ratio(stored: NDArray[np.uint16]) -> NDArray[np.float32]:
    """float32 ratios in [0, 1], NaN where unknown, from the stored uint16 steps."""
    out = (stored * RATIO_SCALE).astype(np.float32)
    out[stored == RATIO_UNKNOWN] = np.nan
    return out


def read_window(path: Path, window: Window | None = None, bands: Sequence[int] | None = None) -> NDArray[Any]:
    """Stored values of a window as (bands, h, w) in the file's dtype; the whole raster by default.

    ``bands`` counts from 1. Where the window reaches outside the raster the values are the raster's nodata (0 for imagery).
    Raises MissingInputError or InputError where the raster cannot be read.
    """
    with opened(path) as src:
        return _read(src, path, window, bands)


def read_overview(path: Path, most_px: int) -> tuple[NDArray[Any], Bounds]:
    """The whole raster at most ``most_px`` on its longer side, from its overviews: (bands, h, w), and its bounds.

    Bounds are (left, bottom, right, top) in the raster's CRS. Masks are picked, pictures averaged, so that a mask keeps its
    values. Raises MissingInputError or InputError where the raster cannot be read.
    """
    with opened(path) as src:
        shrink = max(1.0, max(src.height, src.width) / most_px)
        shape = (src.count, max(1, round(src.height / shrink)), max(1, round(src.width / shrink)))
        how = Resampling.average if src.count == 3 else Resampling.nearest
        try:
            pixels = src.read(out_shape=shape, resampling=how)
        except RasterioError as error:
            raise InputError(f"{path} is damaged: {one_line(error)}") from error
        return pixels, (src.bounds.left, src.bounds.bottom, src.bounds.right, src.bounds.top)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A raster opened for reading by rasterio, whose error becomes ours: MissingInputError or InputError."""
    if not Path(path).is_file():
        raise MissingInputError(f"there is no raster {path}: build the maps first")
    try:
        src = open_raster(path)
    except RasterioIOError as error:
        raise InputError(f"{path} is not a readable raster: {one_line(error)}") from error
    with src:
        yield src


def _crs_of(src: Any, path: Path) -> str:
    if src.crs is None:
        raise InputError(f"{path} has no coordinate reference system: it was not written by brmgeo")
    return str(src.crs.to_wkt() if src.crs.to_epsg() is None else src.crs)


def _read(src: Any, path: Path, window: Window | None, bands: Sequence[int] | None) -> NDArray[Any]:
    """What ``read_window`` gives, of an open raster."""
    wanted = window or Window(0, 0, src.height, src.width)
    index = list(bands) if bands is not None else list(src.indexes)
    fill = 0 if src.nodata is None else src.nodata
    out = np.full((len(index), wanted.height, wanted.width), fill, dtype=src.dtypes[0])
    r0, c0 = max(0, wanted.row), max(0, wanted.col)
    r1, c1 = min(src.height, wanted.row + wanted.height), min(src.width, wanted.col + wanted.width)
    if r1 > r0 and c1 > c0:
        inner = rasterio.windows.Window(c0, r0, c1 - c0, r1 - r0)
        rows = slice(r0 - wanted.row, r1 - wanted.row)
        cols = slice(c0 - wanted.col, c1 - wanted.col)
        try:
            out[:, rows, cols] = src.read(index, window=inner)
        except (RasterioError, CPLE_BaseError, IndexError) as error:
            raise InputError(f"{path} is damaged or has not these bands: {one_line(error)}") from error
    return out
