"""Footprints and known areas to masks, by the pixel-centre rule, the same in every window.

A pixel is building when its centre lies in a polygon. GDAL follows this rule too, but in floating point relative to
the corner of the window that it is given: a centre that lies on an outline, which happens all the time where
surveyed corners fall on round numbers, may then be in for one window and out for the next, and a block would not
equal the whole. Here coordinates are first put on a grid of 1/1024 pixel that belongs to the lattice and not to the
window, and everything after that is whole numbers, so no window can differ. At 0.5 m a vertex moves by at most
0.25 mm. The rule for ties is that left and top outlines belong to a polygon, right and bottom ones do not, so a pixel
centre on the seam of two touching polygons belongs to exactly one of them.

Each part of a multipolygon is filled on its own, its courtyards left out, and added to the mask: footprints that
overlap never cancel each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from shapely import STRtree

from brmgeo.codes import UNKNOWN
from brmgeo.maps.ratio import jit

_STEPS = 1024  # positions per pixel, even: a pixel's centre is one of them
_REACH_PX = 1_000_000  # products of two such distances in steps still fit 64 bits

Polygons = Sequence[Any] | NDArray[Any]
"""Shapely Polygons and MultiPolygons in the lattice's CRS; empty ones and None are passed over."""


@jit
def _fill(xy: Any, ring_ends: Any, part_ends: Any, mask: Any) -> None:
    """Sets the pixels of mask whose centres lie in a part.

    xy: (n, 2) int64 vertices of closed rings, in steps from the mask's corner, y downwards. ring_ends: (r,) end of
    each ring in xy. part_ends: (p,) end of each part in ring_ends.

    Each edge flips, in every row whose centre line it crosses, the pixels from its crossing on; one sweep along the
    row turns flips into pixels. Work is the length of the outlines plus the area of their boxes.
    """
    height, width = mask.shape
    half = _STEPS // 2
    flips = np.zeros(0, np.uint8)
    ring, vertex = 0, 0
    for part in range(part_ends.size):
        first_ring, first = ring, vertex
        ring = part_ends[part]
        vertex = ring_ends[ring - 1]
        left, top = xy[first, 0], xy[first, 1]
        right, bottom = left, top
        for v in range(first, vertex):
            left, right = min(left, xy[v, 0]), max(right, xy[v, 0])
            top, bottom = min(top, xy[v, 1]), max(bottom, xy[v, 1])
        # Rows and columns with centres in [top, bottom) and [left, right): ceiling of (edge - half) / steps.
        row0, row1 = max(-((half - top) // _STEPS), 0), min(-((half - bottom) // _STEPS), height)
        col0, col1 = max(-((half - left) // _STEPS), 0), min(-((half - right) // _STEPS), width)
        if row0 >= row1 or col0 >= col1:
            continue
        cols = col1 - col0
        need = (row1 - row0) * cols
        if flips.size < need:
            flips = np.zeros(need, np.uint8)
        else:
            flips[:need] = 0
        start = first
        for r in range(first_ring, ring):
            for v in range(start, ring_ends[r] - 1):
                x0, y0, x1, y1 = xy[v, 0], xy[v, 1], xy[v + 1, 0], xy[v + 1, 1]
                if y0 > y1:
                    x0, y0, x1, y1 = x1, y1, x0, y0
                # Rows with y0 <= centre < y1: a vertex on a centre line counts for one of its two edges.
                low = max(-((half - y0) // _STEPS), row0)
                high = min(-((half - y1) // _STEPS), row1)
                for row in range(low, high):
                    along = (row * _STEPS + half - y0) * (x1 - x0)
                    # The first column whose centre is at the crossing or right of it, in whole numbers.
                    col = -(((half - x0) * (y1 - y0) - along) // ((y1 - y0) * _STEPS))
                    if col < col1:
                        flips[(row - row0) * cols + max(col - col0, 0)] ^= 1
            start = ring_ends[r]
        for row in range(row0, row1):
            inside = np.uint8(0)
            line = (row - row0) * cols
            for col in range(cols):
                inside ^= flips[line + col]
                if inside:
                    mask[row, col0 + col] = 1


def _in_steps(values: NDArray[np.float64], origin: float, pixel: float) -> NDArray[np.int64]:
    """Coordinates along one axis in steps from a window's edge; the rounding is the lattice's, not the window's."""
    steps: NDArray[np.int64] = np.rint(values / pixel * _STEPS).astype(np.int64)
    return steps - round(origin / pixel * _STEPS)


def building_mask(polygons: Polygons, affine: Affine, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Pixels whose centres lie in any of the polygons.

    Args:
        polygons: shapely Polygons and MultiPolygons, world coordinates; courtyards are holes, overlaps count once.
            Empty geometries and None are passed over, other kinds of geometry hold no area and give nothing.
        affine: world from pixel (col, row), north up, of the window; its corner on whole multiples of the pixel.
        shape: (H, W) of the window.

    Returns:
        (H, W) uint8, 1 inside, 0 outside. A window holds what the same window of any other mask on the lattice does.

    Raises:
        ValueError: affine is rotated or sheared, or a polygon reaches a million pixels away from the window.
    """
    if affine.b != 0 or affine.d != 0 or affine.a == 0 or affine.e == 0:
        raise ValueError(
            f"building_mask: a north-up affine without rotation asked for, found {tuple(affine)[:6]}"
        )
    mask = np.zeros(shape, np.uint8)
    parts = shapely.get_parts(np.asarray(polygons, dtype=object).ravel())
    parts = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)]
    if len(parts) == 0 or mask.size == 0:
        return mask
    rings, part_of_ring = shapely.get_rings(parts, return_index=True)
    coords, ring_of_vertex = shapely.get_coordinates(rings, return_index=True)
    xy = np.empty(coords.shape, np.int64)
    xy[:, 0] = _in_steps(coords[:, 0], affine.c, affine.a)
    xy[:, 1] = _in_steps(coords[:, 1], affine.f, affine.e)
    ring_ends = np.cumsum(np.bincount(ring_of_vertex, minlength=len(rings)))
    part_ends = np.cumsum(np.bincount(part_of_ring, minlength=len(parts)))
    if not np.isfinite(coords).all() or np.abs(xy).max() > _REACH_PX * _STEPS:
        raise ValueError(
            f"building_mask: a polygon reaches {np.abs(xy).max() / _STEPS:.3g} px from the window's corner, where "
            f"{_REACH_PX} are the most: check its coordinates, or cut it to the region"
        )
    _fill(xy, ring_ends, part_ends, mask)
    return mask


def known_mask(areas: Polygons, affine: Affine, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels whose centres lie in any of the areas (sheets) that footprints were taken from.

    Arguments and errors as ``building_mask``; returns (H, W) bool.
    """
    return building_mask(areas, affine, shape).view(np.bool_)


def _touching(geometries: Polygons | STRtree, box: GeoBox) -> NDArray[Any]:
    """The geometries whose bounds meet a window."""
    a = box.affine
    xs, ys = (a.c, a.c + box.shape[1] * a.a), (a.f, a.f + box.shape[0] * a.e)
    # A pixel more: on a far lattice the corner itself is rounded.
    left, right = min(xs) - abs(a.a), max(xs) + abs(a.a)
    bottom, top = min(ys) - abs(a.e), max(ys) + abs(a.e)
    if isinstance(geometries, STRtree):
        found = np.sort(geometries.query(shapely.box(left, bottom, right, top)))
        return cast(NDArray[Any], geometries.geometries[found])
    some = np.asarray(geometries, dtype=object).ravel()
    b = shapely.bounds(some)
    touching: NDArray[Any] = some[
        (b[:, 0] <= right) & (b[:, 2] >= left) & (b[:, 1] <= top) & (b[:, 3] >= bottom)
    ]
    return touching


def mask_window(footprints: Polygons | STRtree, known: Polygons | STRtree, box: GeoBox) -> NDArray[np.uint8]:
    """Building mask of one window of the lattice: 1 building, 0 other, 255 unknown.

    Args:
        footprints: building polygons in the box's CRS, as an array or, where many windows are drawn, an STRtree of
            them. Only those that touch the window are looked at, so memory follows the window.
        known: polygons of the areas that the footprints cover (sheets). Outside them a pixel is unknown, whatever
            is drawn there.
        box: the window, ``Window.box_in(lattice)``; north up.

    Returns:
        (H, W) uint8, equal to the same window of the whole lattice's mask.

    Raises:
        ValueError: as ``building_mask``.
    """
    shape = (int(box.shape[0]), int(box.shape[1]))
    mask = building_mask(_touching(footprints, box), box.affine, shape)
    mask[~known_mask(_touching(known, box), box.affine, shape)] = UNKNOWN
    return mask
