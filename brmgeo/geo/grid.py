"""The region lattice: one grid of pixels, cut into blocks, with halos.

A lattice is an ``odc.geo.GeoBox`` whose pixel edges lie on whole multiples of the GSD; every raster of a
region is a window of it, so cropping, padding and overlapping are exact integer operations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from affine import Affine

from brmgeo.errors import SettingsError

if TYPE_CHECKING:
    # odc-geo brings xarray and pandas with it: only what makes a lattice imports it.
    from odc.geo.geobox import GeoBox

Bounds = tuple[float, float, float, float]


def lattice(bounds: Bounds, crs: str, gsd_m: float) -> GeoBox:
    """The smallest lattice of ``gsd_m`` pixels that covers ``bounds`` (left, bottom, right, top; metres).

    Raises SettingsError for empty or non-finite bounds.
    """
    from odc.geo.geobox import GeoBox

    left, bottom, right, top = bounds
    if not all(map(math.isfinite, bounds)) or not (right > left and top > bottom) or not gsd_m > 0:
        raise SettingsError(
            f"bounds {bounds} at GSD {gsd_m} m span no area: give left < right and bottom < top"
        )
    # A hair of tolerance: 12.5 / 0.1 must not gain a pixel from binary fractions.
    c0, r1 = math.floor(left / gsd_m + 1e-6), math.floor(bottom / gsd_m + 1e-6)
    c1, r0 = math.ceil(right / gsd_m - 1e-6), math.ceil(top / gsd_m - 1e-6)
    affine = Affine(gsd_m, 0.0, c0 * gsd_m, 0.0, -gsd_m, r0 * gsd_m)
    return GeoBox((r0 - r1, c1 - c0), affine, crs)


def bounds_of(box: GeoBox) -> Bounds:
    """(left, bottom, right, top) of a lattice in its own CRS."""
    b = box.extent.boundingbox
    return (b.left, b.bottom, b.right, b.top)


def as_bounds(values: Iterable[Any]) -> Bounds:
    """Four numbers of an array or a file as (left, bottom, right, top)."""
    left, bottom, right, top = (float(v) for v in values)
    return (left, bottom, right, top)


def shape_of(box: GeoBox) -> tuple[int, int]:
    """(rows, cols) of a lattice."""
    return int(box.shape[0]), int(box.shape[1])


def gsd_of(box: GeoBox) -> float:
    """Metres per pixel of a lattice."""
    return float(box.affine.a)


@dataclass(frozen=True, slots=True)
class Window:
    """Rows [row, row + height) and columns [col, col + width) of a lattice."""

    row: int
    col: int
    height: int
    width: int

    def padded(self, halo_px: int) -> Window:
        """The window with ``halo_px`` more pixels on every side; it may reach outside the lattice."""
        h = halo_px
        return Window(self.row - h, self.col - h, self.height + 2 * h, self.width + 2 * h)

    def box_in(self, box: GeoBox) -> GeoBox:
        """This window's own lattice; also where it reaches outside ``box``."""
        affine = box.affine @ Affine.translation(self.col, self.row)
        return type(box)((self.height, self.width), affine, box.crs)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Row and column slices into an array of the whole lattice."""
        return slice(self.row, self.row + self.height), slice(self.col, self.col + self.width)


def blocks(shape: tuple[int, int], size_px: int) -> Iterator[Window]:
    """Windows of at most ``size_px`` square that tile ``shape`` (rows, cols) once, row by row."""
    rows, cols = shape
    for row in range(0, rows, size_px):
        for col in range(0, cols, size_px):
            yield Window(row, col, min(size_px, rows - row), min(size_px, cols - col))
