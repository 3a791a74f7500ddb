"""Georeferenced rasters of any size through the network: seen at its working GSD, answered in blended windows."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.enums
import rasterio.windows
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import Geod
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from brmgeo.codes import BUILDING, OTHER, UNKNOWN
from brmgeo.errors import InputError, one_line
from brmgeo.geo import formats
from brmgeo.geo.crs import LONLAT, transformer
from brmgeo.geo.grid import Window
from brmgeo.memory import require_memory
from brmgeo.pictures import colour_bands, palette_of, scaled_levels
from brmgeo.segment.predict import (
    MIN_PX,
    OVERLAP_PX,
    WINDOW_PX,
    Answer,
    Picture,
    Segmenter,
    picture_of,
    spans,
    thresholded,
)

_BLOCK_PX = 512
# About a day of work on two cores.
_MOST_PX = 40_000_000_000
_BYTES_A_COLUMN = 6000


class RasterReader:
    """An open raster, seen at the network's working GSD; made by ``open_raster``.

    Attributes:
        box: lattice of the answers: the raster's own where its GSD is one that the network was trained for, else the
            working GSD over the same ground.
        gsd_m: metres on the ground of a pixel of ``box``.
        native_m: the same of the raster's own pixels.
    """

    def __init__(
        self,
        src: Any,
        path: Path,
        segmenter: Segmenter,
        levels: tuple[float, float] | None,
        bands: tuple[int, ...] | None,
    ) -> None:
        if src.crs is None and path.suffix.lower() in (".jpg", ".jpeg", ".png"):
            raise InputError(
                f"{path}: a picture without place or scale, such as a frame: give the folder that holds it, and its metres "
                "per pixel",
                needs="gsd_m",
            )
        if src.crs is None:
            raise InputError(
                f"{path}: no coordinate reference system, so nobody knows its scale or place; state it first "
                "(gdal_edit.py -a_srs EPSG:... FILE)"
            )
        if src.transform == Affine.identity():
            raise InputError(
                f"{path}: no georeferencing beside the CRS: its corner and pixel size are not stated"
            )
        self._src, self._path, self._levels, self._segmenter = src, path, levels, segmenter
        self._bands = colour_bands(src, path, bands)
        self._palette = palette_of(src, path, self._bands)
        if (
            self._palette is None
            and levels is None
            and any(src.dtypes[b - 1] != "uint8" for b in self._bands)
        ):
            raise InputError(
                f"{path}: {src.dtypes[self._bands[0] - 1]} values; the network takes 8 bits a channel: say which levels "
                "are black and white",
                needs="levels",
            )
        down, across = ground_gsd_m(src, path)
        self.native_m = math.sqrt(down * across)
        try:
            rows, cols = segmenter.working_size((src.height, src.width), (down, across))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if min(rows, cols) < MIN_PX:
            raise InputError(
                f"{path}: {cols} x {rows} px are too few: give a raster of at least {MIN_PX} px a side"
            )
        if rows * cols > _MOST_PX:
            raise InputError(
                f"{path}: {cols} x {rows} px at {self.native_m:.3g} m, days of work: cut out what you need first, at most "
                f"{_MOST_PX:.0e} px"
            )
        require_memory(
            _BYTES_A_COLUMN * cols, f"{path.name} of {cols} x {rows} px", "cut it into narrower strips"
        )
        self._scale = (src.height / rows, src.width / cols)
        self.gsd_m = self.native_m * math.sqrt(self._scale[0] * self._scale[1])
        affine = src.transform @ Affine.scale(self._scale[1], self._scale[0])
        epsg = src.crs.to_epsg()
        self.box = GeoBox((rows, cols), affine, f"EPSG:{epsg}" if epsg else src.crs.to_wkt())

    def known(self, row: int, col: int, height: int, width: int) -> NDArray[np.bool_]:
        """(height, width) bool of a window of ``box``: True where the raster shows something."""
        with self._reading():
            mask = self._src.dataset_mask(
                window=self._window(row, col, height, width),
                out_shape=(height, width),
                resampling=rasterio.enums.Resampling.nearest,
            )
        return np.asarray(mask > 0)

    def picture(self, row: int, col: int, height: int, width: int) -> Picture | None:
        """A window of ``box`` as a picture; None where nothing of it is known."""
        known = self.known(row, col, height, width)
        if not known.any():
            return None
        shrunk = self._scale[0] * self._scale[1] > 1.0
        how = rasterio.enums.Resampling.average if shrunk else rasterio.enums.Resampling.cubic
        if self._scale == (1.0, 1.0) or self._palette is not None:
            how = rasterio.enums.Resampling.nearest
        with self._reading():
            seen = self._src.read(
                list(self._bands),
                window=self._window(row, col, height, width),
                out_shape=(len(self._bands), height, width),
                resampling=how,
            )
        image = np.moveaxis(seen, 0, -1)
        if self._palette is not None:
            image = self._palette[image[:, :, 0], :3]
        elif self._levels is not None:
            image = scaled_levels(image, *self._levels)
        return Picture(picture_of(image, str(self._path)).rgb, None if known.all() else known)

    def blocks(
        self, answer: Answer = "mask", progress: Callable[[int, int], object] | None = None
    ) -> Iterator[tuple[Window, NDArray[Any]]]:
        """What the network says, in rows of blocks of ``box``, each as soon as no window to come can touch it.

        Blocks are (h, w) uint8 of the maps' codes for ``mask``, and (1, h, w) float32 in [0, 1], NaN where unknown, for
        ``probability``. Memory grows with the width alone (6 kB a column). ``progress`` is told windows done and all.

        Raises InputError where the raster is damaged or cut short.
        """
        rows, cols = (int(n) for n in self.box.shape)
        down, across = (spans(n, WINDOW_PX, OVERLAP_PX) for n in (rows, cols))
        # Sums of weighted answers over the rows that are not written yet, from row ``top`` on.
        sums = np.zeros((min(rows, WINDOW_PX + _BLOCK_PX), cols), np.float32)
        top = count = 0
        for i, row in enumerate(down):
            for col in across:
                picture = self.picture(row.start, col.start, row.stop - row.start, col.stop - col.start)
                if picture is not None:
                    part = np.nan_to_num(self._segmenter.probability(picture))
                    place = (slice(row.start - top, row.stop - top), slice(col.start, col.stop))
                    sums[place] += row.weight[:, None] * part * col.weight
                count += 1
                if progress is not None:
                    progress(count, len(down) * len(across))
            last = i + 1 == len(down)
            ready = rows if last else down[i + 1].start // _BLOCK_PX * _BLOCK_PX
            for start in range(top, ready, _BLOCK_PX):
                height = min(_BLOCK_PX, ready - start)
                for left in range(0, cols, 4 * _BLOCK_PX):
                    width = min(4 * _BLOCK_PX, cols - left)
                    p = np.clip(sums[start - top : start - top + height, left : left + width], 0.0, 1.0)
                    p = np.where(self.known(start, left, height, width), p, np.float32(np.nan))
                    window = Window(start, left, height, width)
                    yield (
                        window,
                        codes_of(p, self._segmenter.card.threshold) if answer == "mask" else p[None],
                    )
            moved = ready - top
            sums[: len(sums) - moved] = sums[moved:].copy()
            sums[len(sums) - moved :] = 0.0
            top = ready

    def _window(self, row: int, col: int, height: int, width: int) -> rasterio.windows.Window:
        down, across = self._scale
        return rasterio.windows.Window(col * across, row * down, width * across, height * down)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        # Told here: within the writing of the result it would pass for a fault of the disk that is written to.
        try:
            yield
        except (RasterioError, CPLE_BaseError) as error:
            told = one_line(error, 200)
            raise InputError(f"{self._path}: damaged or cut short ({told}); copy it again") from None


@contextmanager
def open_raster(
    path: Path,
    segmenter: Segmenter,
    *,
    levels: tuple[float, float] | None = None,
    bands: tuple[int, ...] | None = None,
) -> Iterator[RasterReader]:
    """A raster opened for a network, for as long as the block lasts.

    Args:
        levels: the levels that are black and white in a raster of more than 8 bits.
        bands: its red, green and blue band, or its grey one, counted from 1; None: as the file says.

    Raises InputError for files that are no readable raster, have no place, are too coarse or too small, have more than 8
    bits where ``levels`` is not given, and for bands that are not there or must be stated.
    """
    try:
        with warnings.catch_warnings():
            # That a raster has no place is told as an error of its own.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            src = formats.open_raster(path)
        with src:
            yield RasterReader(src, path, segmenter, levels, bands)
    except RasterioError as error:
        raise InputError(f"{path}: not a readable raster: {' '.join(str(error).split())[:300]}") from None


def codes_of(probability: NDArray[np.float32], threshold: float) -> NDArray[np.uint8]:
    """(h, w) uint8 of the maps' codes: building above ``threshold``, unknown where NaN, other elsewhere."""
    building = thresholded(probability, threshold) > 0
    return np.where(np.isnan(probability), UNKNOWN, np.where(building, BUILDING, OTHER)).astype(np.uint8)


def ground_gsd_m(src: Any, path: Path) -> tuple[float, float]:
    """Metres on the ground of one pixel down and one across, in the middle of an open raster, whatever its CRS.

    Raises InputError where the raster lies nowhere on the ground.
    """
    row, col = src.height / 2.0, src.width / 2.0
    points = [src.transform @ at for at in ((col, row), (col, row + 1.0), (col + 1.0, row))]
    xs, ys = zip(*points, strict=True)
    lon, lat = transformer(src.crs.to_wkt(), LONLAT).transform(np.array(xs), np.array(ys))
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        raise InputError(f"{path}: its middle has no longitude and latitude: the CRS or the corner is wrong")
    geod = Geod(ellps="WGS84")
    down, across = (geod.inv(lon[0], lat[0], lon[k], lat[k])[2] for k in (1, 2))
    if not (down > 0 and across > 0):
        raise InputError(f"{path}: its pixels cover no ground: the CRS or the pixel size is wrong")
    return float(down), float(across)
