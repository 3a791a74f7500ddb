"""Imagery in: tiles, GeoTIFFs, images with world files and NGII orthophotos, drawn once onto the region's lattice.

Every pixel of the lattice is computed by itself: its centre is carried into the source's pixel plane, and the source is
sampled there. Nothing depends on how the lattice is cut into blocks, so a block is bit-identical to the same window of the
whole, and seams cannot appear:

- Positions: exact transformation (PROJ) at the corners of 32 x 32 px cells that are fixed to the lattice, bilinear in
  between. Between projected CRSs the error is below 1e-4 px at 0.5 m (a cell bends by about 16^2 / 8 / 6.4e6 m).
- Values: cubic convolution (Keys 1981, a = -0.5) where a source pixel is at least about as large as a lattice pixel;
  the exact mean over the lattice pixel's area where sources are over 1.5 times finer (cubic would alias).
- Validity: a pixel is known where the source pixel under its centre is. Beside unknown source pixels the known ones of the
  nearest four are weighted bilinearly.

Sources come in order of priority: the first that knows a pixel gives it.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import rasterio
import rasterio.windows
from affine import Affine
from numba import njit
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from brmgeo.errors import CrsError, InputError, MissingInputError, one_line
from brmgeo.geo.crs import (
    belt_for_sheet,
    crs_name,
    parse_crs,
    require_meeting,
    same_crs,
    transform_bounds,
    transformer,
)
from brmgeo.geo.formats import open_raster
from brmgeo.geo.grid import Bounds, Window, bounds_of, gsd_of
from brmgeo.geo.sheets import is_sheet_number, sheet_extent, sheet_number_in
from brmgeo.geo.tilegrid import Tile
from brmgeo.ingest.tiles import TileSource
from brmgeo.pictures import colour_bands, palette_of, scaled_levels

_CELL_PX = 32
# The largest piece of a source that is held at once, pixels a side.
_PIECE_PX = 2048
_AVERAGE_ABOVE = 1.5
_SQUARE_TOLERANCE = 0.005


@dataclass(frozen=True, slots=True)
class GeoRaster:
    """A GeoTIFF, or JPEG/PNG/TIFF with a world file (formats: ``geo.formats``), with 1 (grey), 3 or more bands.

    Attributes:
        path: the file.
        crs: needed where the file states none (world files); must agree where it does.
        bands: the bands (from 1) that are red, green, blue, or one for grey; default: as the file labels them.
        value_range: (black, white) of the stored values; needed for anything but 8-bit.
    """

    path: Path
    crs: str | None = None
    bands: tuple[int, ...] | None = None
    value_range: tuple[float, float] | None = None
    attribution: str = ""
    terms: str = ""


@dataclass(frozen=True, slots=True)
class NgiiOrtho:
    """An NGII orthophoto of one sheet, which comes without georeferencing.

    The image is taken to fill the rectangle about its sheet: ``sheet_extent`` of the sheet's number in its belt. Sheets are
    cut along longitudes and latitudes, which are turned against the belt's axes by the convergence (up to 0.6 degrees, 25 m
    over a sheet), so that rectangle is larger than the sheet itself. An image cut otherwise gets pixels that are not square
    and is refused, as a guess would shift every roof; then ``bounds`` (left, bottom, right, top) state its place.
    Where a world file lies beside the image, that one counts.

    Attributes:
        sheet: sheet number; default: the one in the file's name.
        crs: default: the GRS80 belt of the sheet's number.
    """

    path: Path
    sheet: str | None = None
    crs: str | None = None
    bounds: Bounds | None = None
    value_range: tuple[float, float] | None = None
    attribution: str = ""
    terms: str = ""


ImagerySource = TileSource | GeoRaster | NgiiOrtho


def mosaic_to_lattice(
    sources: ImagerySource | Sequence[ImagerySource], box: GeoBox, window: Window | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Imagery on a window of the lattice: (h, w, 3) uint8 RGB and (h, w) bool, True where a source knows the pixel.

    Args:
        sources: in order of priority.
        box: the region's lattice (projected, metres).
        window: part of it, the whole by default; it may reach outside.

    Unknown pixels are 0. Reads only what lies under the window and keeps no file open. Raises InputError for a damaged
    source, MissingInputError for an absent file, CrsError where a source's CRS is missing or contradicts the stated one.
    """
    rows, cols = (int(n) for n in box.shape)
    window = window or Window(0, 0, rows, cols)
    rgb = np.zeros((window.height, window.width, 3), dtype=np.uint8)
    valid = np.zeros((window.height, window.width), dtype=bool)
    for source in sources if isinstance(sources, Sequence) else [sources]:
        if valid.all():
            break
        with _plane_of(source) as plane:
            _draw(plane, box, window, rgb, valid)
    return rgb, valid


def check_imagery(sources: Sequence[ImagerySource], box: GeoBox) -> None:
    """Raises CrsError when raster files are given and none of them, and no tiles, lies on the lattice.

    The message names the nearest file and how far off it is: the usual cause is a wrong CRS.
    """
    places: dict[str, Bounds] = {}
    for source in sources:
        if not isinstance(source, (GeoRaster, NgiiOrtho)):
            return
        with _plane_of(source) as plane:
            corners = [
                plane.affine @ c
                for c in ((0, 0), (plane.width, 0), (0, plane.height), (plane.width, plane.height))
            ]
            xs, ys = zip(*corners)
            there = transform_bounds(plane.crs, str(box.crs), (min(xs), min(ys), max(xs), max(ys)))
            places[f"{source.path} in {crs_name(plane.crs)}"] = there
    require_meeting("image", places, "the region's bounds", bounds_of(box), str(box.crs))


def native_gsd_m(sources: Sequence[ImagerySource], box: GeoBox) -> float:
    """Ground metres per pixel of the coarsest of the sources, at the middle of a lattice (projected, metres).

    Raises as ``mosaic_to_lattice``.
    """
    found = 0.0
    for source in sources:
        with _plane_of(source) as plane:
            found = max(found, gsd_of(box) / max(min(_scale(plane, box)), 1e-12))
    return found


class _Plane(Protocol):
    """A source as one plane of pixels; column and row may lie anywhere, outside is unknown."""

    crs: str
    affine: Affine
    width: int
    height: int

    def read(self, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """(h, w, 3) uint8 and (h, w) bool of a window inside the plane."""
        ...


class _TilePlane:
    """All tiles of one level side by side, row 0 in the north."""

    def __init__(self, source: TileSource) -> None:
        grid, z = source.grid, source.level
        self.source = source
        self.tile_px = grid.tile_px * source.pixel_ratio
        self.crs = grid.crs
        last = grid.flipped((0, 0), z).y
        left, _, _, top = grid.tile_bounds((0, last if grid.y_up else 0), z)
        pixel = grid.gsd_m(z) / source.pixel_ratio
        self.affine = Affine(pixel, 0.0, left, 0.0, -pixel, top)
        self.last = last
        # Every grid is square in tiles.
        self.width = self.height = (last + 1) * self.tile_px
        # Pieces overlap by part of a tile: decode it once. 64 tiles are 16 MB.
        self.tile = lru_cache(maxsize=64)(source.read)

    def read(self, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        rgb = np.zeros((window.height, window.width, 3), dtype=np.uint8)
        valid = np.zeros((window.height, window.width), dtype=bool)
        n = self.tile_px
        for tile_row in range(window.row // n, (window.row + window.height - 1) // n + 1):
            y = self.last - tile_row if self.source.grid.y_up else tile_row
            for tile_col in range(window.col // n, (window.col + window.width - 1) // n + 1):
                image = self.tile(Tile(tile_col, y))
                if image is None:
                    continue
                r0, c0 = tile_row * n - window.row, tile_col * n - window.col
                rows = slice(max(0, r0), min(window.height, r0 + n))
                cols = slice(max(0, c0), min(window.width, c0 + n))
                part = image[rows.start - r0 : rows.stop - r0, cols.start - c0 : cols.stop - c0]
                rgb[rows, cols] = part[..., :3]
                valid[rows, cols] = part[..., 3] >= 128
        return rgb, valid


class _FilePlane:
    """An opened raster file, placed."""

    def __init__(self, src: Any, source: GeoRaster | NgiiOrtho, crs: str, affine: Affine) -> None:
        self.src = src
        self.source = source
        self.crs = crs
        self.affine = affine
        self.width, self.height = int(src.width), int(src.height)
        self.bands = _colour_bands(src, source)
        self.palette = palette_of(src, source.path, self.bands)

    def read(self, window: Window) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        target = rasterio.windows.Window(window.col, window.row, window.width, window.height)
        try:
            values = self.src.read(list(self.bands), window=target)
            valid = self.src.dataset_mask(window=target) > 0
        except (RasterioError, CPLE_BaseError) as error:
            raise InputError(
                f"{self.source.path} is damaged: {one_line(error)}; fetch or export it again"
            ) from error
        if self.palette is not None:
            colours = self.palette[values[0]]
            return np.ascontiguousarray(colours[..., :3]), valid & (colours[..., 3] >= 128)
        if self.source.value_range is not None:
            low, high = self.source.value_range
            bad = ~np.isfinite(values).all(axis=0) if values.dtype.kind == "f" else np.zeros_like(valid)
            values, valid = scaled_levels(values, low, high), valid & ~bad
        image = np.moveaxis(values, 0, -1)
        return np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3))), valid


@contextlib.contextmanager
def _plane_of(source: ImagerySource) -> Iterator[_Plane]:
    """The source's pixel plane; files are open only inside the block (GDAL's handles belong to one task)."""
    if not isinstance(source, (GeoRaster, NgiiOrtho)):
        yield _TilePlane(source)
        return
    path = Path(source.path)
    if not path.is_file():
        raise MissingInputError(f"there is no image {path}")
    with warnings.catch_warnings():
        # Said better below, with what to do.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            src = open_raster(path)
        except (RasterioError, CPLE_BaseError) as error:
            raise InputError(
                f"{path} is not a readable image ({one_line(error)}); fetch or export it again"
            ) from error
    with src:
        placed = not src.transform.is_identity
        if isinstance(source, NgiiOrtho):
            crs, affine = _ortho_place(source, src, placed)
        else:
            if not placed:
                if points := len(src.gcps[0]) or src.rpcs:
                    by = (
                        f"{points} control points (GCPs)"
                        if isinstance(points, int)
                        else "a camera model (RPC)"
                    )
                    raise InputError(
                        f"{path} is placed by {by}, not upright: warp it first, as with gdalwarp -t_srs EPSG:5187 "
                        f"{path.name} {path.stem}-upright.tif"
                    )
                raise InputError(
                    f"{path} has no georeferencing: put its world file (such as {path.stem}.tfw or .jgw) beside it, "
                    "or, for an NGII orthophoto, state its sheet number"
                )
            crs, affine = _file_crs(source, src), src.transform
        yield _FilePlane(src, source, crs, affine)


def _file_crs(source: GeoRaster, src: Any) -> str:
    """The CRS of a raster file, where it and the user must not contradict each other; else that of the .prj beside it.

    One without a place on earth, as CAD programs and GDAL write it for "none", is as good as none.
    """
    own, local = None, ""
    if src.crs is not None:
        epsg = src.crs.to_epsg()
        own = f"EPSG:{epsg}" if epsg else src.crs.to_wkt()
    elif source.crs is None:
        own = _crs_beside(source.path)
    if own is not None and parse_crs(own).is_engineering:
        local = f" on earth, only {crs_name(own)!r}"
        own = None
    if own is None and source.crs is None:
        raise CrsError(
            f"{source.path} states no coordinate reference system{local}: state its crs, such as crs = 'EPSG:5187'",
            needs="imagery_crs",
        )
    if own is None or source.crs is None:
        name = source.crs or own or ""
        parse_crs(name)
        return name
    if not same_crs(own, source.crs):
        raise CrsError(
            f"{source.path} says it is in {crs_name(own)}, but crs = {crs_name(source.crs)} is stated: leave crs out, or "
            "correct the file"
        )
    return own


def _crs_beside(image: Path) -> str | None:
    """The CRS of the .prj beside an image with a world file, None where there is none; CrsError for a damaged one."""
    for path in sorted(image.parent.iterdir()):
        if path.stem == image.stem and path.suffix.lower() == ".prj":
            try:
                text = path.read_text(encoding="utf-8", errors="replace").strip()
                parse_crs(text)
            except (OSError, CrsError) as error:
                raise CrsError(
                    f"{path} cannot be read as a CRS: {one_line(error)}", needs="imagery_crs"
                ) from error
            return text
    return None


def _ortho_place(source: NgiiOrtho, src: Any, placed: bool) -> tuple[str, Affine]:
    """CRS and affine of an NGII orthophoto; see NgiiOrtho."""
    number = source.sheet or sheet_number_in(source.path.name)
    if number is None or not is_sheet_number(number):
        raise InputError(
            f"{source.path}: {f'{number!r} is' if number else 'the file name holds'} no NGII sheet number: state the sheet, "
            "such as 36914093"
        )
    crs = source.crs or belt_for_sheet(number)
    parse_crs(crs)
    if placed:
        if src.crs is not None and not same_crs(src.crs.to_wkt(), crs):
            raise CrsError(
                f"{source.path} says it is in {crs_name(src.crs.to_wkt())}, but sheet {number} is taken in {crs_name(crs)}: "
                "state its crs"
            )
        return crs, src.transform
    left, bottom, right, top = source.bounds or sheet_extent(number, crs)
    gx, gy = (right - left) / src.width, (top - bottom) / src.height
    if not (gx > 0 and gy > 0 and abs(gx / gy - 1.0) <= _SQUARE_TOLERANCE):
        place = "its bounds" if source.bounds else f"sheet {number}"
        raise InputError(
            f"{source.path} has {src.width} x {src.height} px, which on {place} "
            f"gives pixels of {gx:.4f} x {gy:.4f} m: state the bounds (left, bottom, right, top) that it really covers"
        )
    return crs, Affine(gx, 0.0, left, 0.0, -gy, top)


def _colour_bands(src: Any, source: GeoRaster | NgiiOrtho) -> tuple[int, ...]:
    """Bands to read as grey or red, green, blue."""
    bands = colour_bands(src, source.path, source.bands if isinstance(source, GeoRaster) else None)
    low_high = source.value_range
    if low_high is not None and not low_high[1] > low_high[0]:
        raise InputError(f"{source.path}: value_range {low_high} is empty: give (black, white)")
    dtype = src.dtypes[bands[0] - 1]
    if dtype != "uint8" and low_high is None:
        raise InputError(
            f"{source.path} holds {dtype} values: state value_range, the values of black and of white, such as [0, 2047]"
        )
    return bands


def _draw(
    plane: _Plane, box: GeoBox, window: Window, rgb: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> None:
    """Fill the pixels of the window that are not valid yet from one source."""
    su, sv = _scale(plane, box)
    if not (math.isfinite(su) and math.isfinite(sv)):
        raise CrsError(
            f"imagery in {crs_name(plane.crs)} cannot be placed on the region in {box.crs}: check both"
        )
    average = max(su, sv) > _AVERAGE_ABOVE
    margin = math.ceil(max(su, sv) / 2 + 1) if average else 3
    step = int(min(1024, max(_CELL_PX, _PIECE_PX / max(su, sv))))
    for r in range(0, window.height, step):
        for c in range(0, window.width, step):
            piece = Window(
                window.row + r, window.col + c, min(step, window.height - r), min(step, window.width - c)
            )
            rows, cols = slice(r, r + piece.height), slice(c, c + piece.width)
            if valid[rows, cols].all():
                continue
            first_row, first_col = piece.row // _CELL_PX, piece.col // _CELL_PX
            node_rows = _cell_edges(first_row, (piece.row + piece.height - 1) // _CELL_PX + 1)
            node_cols = _cell_edges(first_col, (piece.col + piece.width - 1) // _CELL_PX + 1)
            u, v = _source_pixels(plane, box, node_rows, node_cols)
            if not np.isfinite(u).any():
                continue
            c0, c1 = math.floor(np.nanmin(u)) - margin, math.ceil(np.nanmax(u)) + margin
            r0, r1 = math.floor(np.nanmin(v)) - margin, math.ceil(np.nanmax(v)) + margin
            c0, c1 = max(0, c0), min(plane.width, c1)
            r0, r1 = max(0, r0), min(plane.height, r1)
            if c1 <= c0 or r1 <= r0:
                continue
            canvas, known = plane.read(Window(r0, c0, r1 - r0, c1 - c0))
            if not known.any():
                continue
            _sample(
                canvas,
                known,
                _whole_neighbourhoods(known),
                canvas_row=r0,
                canvas_col=c0,
                node_u=u,
                node_v=v,
                row0=piece.row - first_row * _CELL_PX,
                col0=piece.col - first_col * _CELL_PX,
                span_u=su if average else 0.0,
                span_v=sv if average else 0.0,
                out=rgb[rows, cols],
                out_valid=valid[rows, cols],
            )


def _cell_edges(first: int, last: int) -> NDArray[np.float64]:
    """Pixel edges of cells first to last of the lattice."""
    return np.arange(first * _CELL_PX, (last + 1) * _CELL_PX, _CELL_PX, dtype=np.float64)


def _source_pixels(
    plane: _Plane, box: GeoBox, rows: NDArray[np.float64], cols: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(column, row) in the source's plane of a mesh of lattice pixel edges; NaN where there is none."""
    a = box.affine
    x, y = np.meshgrid(a.c + cols * a.a, a.f + rows * a.e)
    if not same_crs(str(box.crs), plane.crs):
        x, y = transformer(str(box.crs), plane.crs).transform(x, y)
    inverse = ~plane.affine
    u = inverse.a * x + inverse.b * y + inverse.c
    v = inverse.d * x + inverse.e * y + inverse.f
    lost = ~(np.isfinite(u) & np.isfinite(v))
    u[lost] = v[lost] = np.nan
    return u, v


def _scale(plane: _Plane, box: GeoBox) -> tuple[float, float]:
    """Source pixels per lattice pixel along the source's columns and rows, at the lattice's centre: one for all blocks."""
    rows, cols = (int(n) // 2 for n in box.shape)
    step = max(1.0, 16.0 / gsd_of(box))
    u, v = _source_pixels(
        plane,
        box,
        np.array([rows, rows + step], dtype=np.float64),
        np.array([cols, cols + step], dtype=np.float64),
    )
    su = math.hypot(u[0, 1] - u[0, 0], u[1, 0] - u[0, 0]) / step
    sv = math.hypot(v[0, 1] - v[0, 0], v[1, 0] - v[0, 0]) / step
    return float(su), float(sv)


def _whole_neighbourhoods(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True where all 4 x 4 pixels from (row, col) down and right are known; False where they leave the canvas."""
    out = np.zeros_like(known)
    if min(known.shape) >= 4:
        across = known[:, :-3] & known[:, 1:-2] & known[:, 2:-1] & known[:, 3:]
        out[:-3, :-3] = across[:-3] & across[1:-2] & across[2:-1] & across[3:]
    return out


@njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator, unused-ignore]
def _keys(f):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The four weights of cubic convolution (Keys 1981, a = -0.5) for a fraction f past the second pixel."""
    return (
        f * (-0.5 + f * (1.0 - 0.5 * f)),
        1.0 + f * f * (-2.5 + 1.5 * f),
        f * (0.5 + f * (2.0 - 1.5 * f)),
        f * f * (-0.5 + 0.5 * f),
    )


@njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator, unused-ignore]
def _row(canvas, r, c, band, a0, a1, a2, a3):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Four weighted pixels of one row."""
    return (
        a0 * canvas[r, c, band]
        + a1 * canvas[r, c + 1, band]
        + a2 * canvas[r, c + 2, band]
        + a3 * canvas[r, c + 3, band]
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _sample(  # type: ignore[no-untyped-def]  # pragma: no cover
    canvas, known, whole, canvas_row, canvas_col, node_u, node_v, row0, col0, span_u, span_v, out, out_valid
):
    """Sample ``canvas`` (source pixels from canvas_row, canvas_col) for every pixel of ``out`` that is not valid yet.

    ``known``: its known pixels; ``whole``: see ``_whole_neighbourhoods``.
    ``node_u``, ``node_v``: source columns and rows at cell corners, of which the first lies (row0, col0) pixels before
    ``out``. ``span_u``, ``span_v``: size of a lattice pixel in source pixels to average over, or 0 for cubic convolution.
    """
    height, width = out_valid.shape
    rows, cols = known.shape
    total = np.empty(3)
    for i in range(height):
        ki = (row0 + i) // 32
        ti = ((row0 + i) % 32 + 0.5) / 32.0
        for j in range(width):
            if out_valid[i, j]:
                continue
            kj = (col0 + j) // 32
            tj = ((col0 + j) % 32 + 0.5) / 32.0
            u0 = node_u[ki, kj] + (node_u[ki, kj + 1] - node_u[ki, kj]) * tj
            u1 = node_u[ki + 1, kj] + (node_u[ki + 1, kj + 1] - node_u[ki + 1, kj]) * tj
            v0 = node_v[ki, kj] + (node_v[ki, kj + 1] - node_v[ki, kj]) * tj
            v1 = node_v[ki + 1, kj] + (node_v[ki + 1, kj + 1] - node_v[ki + 1, kj]) * tj
            u = u0 + (u1 - u0) * ti
            v = v0 + (v1 - v0) * ti
            if not (np.isfinite(u) and np.isfinite(v)):
                continue
            near_r, near_c = math.floor(v) - canvas_row, math.floor(u) - canvas_col
            if near_r < 0 or near_r >= rows or near_c < 0 or near_c >= cols or not known[near_r, near_c]:
                continue
            total[:] = 0.0
            weight = 0.0
            if span_u > 0.0:
                # The exact mean over an upright rectangle of the pixel's size.
                a0, a1 = u - 0.5 * span_u, u + 0.5 * span_u
                b0, b1 = v - 0.5 * span_v, v + 0.5 * span_v
                for r in range(math.floor(b0), math.ceil(b1)):
                    cr = r - canvas_row
                    if cr < 0 or cr >= rows:
                        continue
                    in_r = min(b1, r + 1.0) - max(b0, float(r))
                    for c in range(math.floor(a0), math.ceil(a1)):
                        cc = c - canvas_col
                        if cc < 0 or cc >= cols or not known[cr, cc]:
                            continue
                        w = in_r * (min(a1, c + 1.0) - max(a0, float(c)))
                        weight += w
                        for band in range(3):
                            total[band] += w * canvas[cr, cc, band]
            else:
                left, top = math.floor(u - 0.5), math.floor(v - 0.5)
                fu, fv = u - 0.5 - left, v - 0.5 - top
                r, c = top - 1 - canvas_row, left - 1 - canvas_col
                if r >= 0 and r < rows and c >= 0 and c < cols and whole[r, c]:
                    a0, a1, a2, a3 = _keys(fu)
                    b0, b1, b2, b3 = _keys(fv)
                    weight = (a0 + a1 + a2 + a3) * (b0 + b1 + b2 + b3)
                    for band in range(3):
                        total[band] = (
                            b0 * _row(canvas, r, c, band, a0, a1, a2, a3)
                            + b1 * _row(canvas, r + 1, c, band, a0, a1, a2, a3)
                            + b2 * _row(canvas, r + 2, c, band, a0, a1, a2, a3)
                            + b3 * _row(canvas, r + 3, c, band, a0, a1, a2, a3)
                        )
                else:
                    for m in range(2):
                        for n in range(2):
                            r, c = top + m - canvas_row, left + n - canvas_col
                            if r < 0 or r >= rows or c < 0 or c >= cols or not known[r, c]:
                                continue
                            w = (fv if m else 1.0 - fv) * (fu if n else 1.0 - fu)
                            weight += w
                            for band in range(3):
                                total[band] += w * canvas[r, c, band]
            for band in range(3):
                value = math.floor(total[band] / weight + 0.5)
                out[i, j, band] = np.uint8(min(255.0, max(0.0, value)))
            out_valid[i, j] = True
