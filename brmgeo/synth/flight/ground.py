"""What a simulated flight flies over: footprints made ready for drawing, and imagery."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.flight.readings import FloatArray

EDGE_STEP_M = 2.0


@dataclass(frozen=True, slots=True)
class RaisedFootprints:
    """Footprints made ready for drawing; make it once with ``from_polygons`` and use it for many flights.

    Attributes:
        xy: (v, 2) vertices of all rings in the map frame, edges cut to ``EDGE_STEP_M``; the last repeats the first.
        ring_start: (r + 1,) first vertex of each ring.
        polygon_start: (p + 1,) first ring of each polygon.
        bounds: (p, 4) left, bottom, right, top of each polygon.
        area_m2: (p,) areas.
        height_m: (p,) heights above ground, 0 where unknown.
    """

    xy: FloatArray
    ring_start: NDArray[np.int64]
    polygon_start: NDArray[np.int64]
    bounds: FloatArray
    area_m2: FloatArray
    height_m: FloatArray

    @classmethod
    def from_polygons(
        cls, polygons: Sequence[Any], heights_m: Sequence[float] | None = None
    ) -> RaisedFootprints:
        """Ready ground from shapely Polygons or MultiPolygons (map CRS, metres) and their heights."""
        geometries = np.asarray(list(polygons), dtype=object)
        heights = np.zeros(len(geometries)) if heights_m is None else np.asarray(heights_m, dtype=np.float64)
        if len(heights) != len(geometries):
            raise ValueError(f"{len(heights)} heights for {len(geometries)} polygons")
        if not len(geometries):
            none = np.zeros(1, dtype=np.int64)
            return cls(np.empty((0, 2)), none, none, np.empty((0, 4)), np.empty(0), np.empty(0))
        parts, owner = shapely.get_parts(geometries, return_index=True)
        fine = shapely.segmentize(parts, EDGE_STEP_M)
        rings, ring_owner = shapely.get_rings(fine, return_index=True)
        xy, vertex_owner = shapely.get_coordinates(rings, return_index=True)
        ring_start = np.searchsorted(vertex_owner, np.arange(len(rings) + 1))
        polygon_start = np.searchsorted(ring_owner, np.arange(len(parts) + 1))
        return cls(
            np.ascontiguousarray(xy),
            ring_start.astype(np.int64),
            polygon_start.astype(np.int64),
            np.asarray(shapely.bounds(parts), dtype=np.float64),
            np.asarray(shapely.area(parts), dtype=np.float64),
            np.nan_to_num(heights[owner]),
        )

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounds of all footprints (left, bottom, right, top)."""
        if not len(self.bounds):
            raise InputError("the map has no building: give bounds to fly in")
        low, high = self.bounds[:, :2].min(axis=0), self.bounds[:, 2:].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def near(self, left: float, bottom: float, right: float, top: float) -> NDArray[np.int64]:
        """Indices of the polygons whose bounds touch a box."""
        b = self.bounds
        return np.flatnonzero((b[:, 0] <= right) & (b[:, 2] >= left) & (b[:, 1] <= top) & (b[:, 3] >= bottom))


@dataclass(frozen=True, slots=True)
class Imagery:
    """A picture of the ground from straight above: (h, w, 3) uint8 RGB, north up, its corner and metres per pixel."""

    rgb: NDArray[np.uint8]
    left: float
    top: float
    gsd_m: float

    def crop(self, box: tuple[float, float, float, float]) -> Imagery:
        """The part within (left, bottom, right, top), or the nearest pixel of it."""
        rows, cols = self.rgb.shape[:2]
        c0, c1 = ((x - self.left) / self.gsd_m for x in (box[0], box[2]))
        r0, r1 = ((self.top - y) / self.gsd_m for y in (box[3], box[1]))
        left, top = min(max(math.floor(c0), 0), cols - 1), min(max(math.floor(r0), 0), rows - 1)
        right, bottom = min(max(math.ceil(c1), left + 1), cols), min(max(math.ceil(r1), top + 1), rows)
        return Imagery(
            self.rgb[top:bottom, left:right],
            self.left + left * self.gsd_m,
            self.top - top * self.gsd_m,
            self.gsd_m,
        )

    def coarser(self, factor: int) -> Imagery:
        """The same at ``factor`` times the metres per pixel, by averaging."""
        rows, cols = (max(1, n // factor) for n in self.rgb.shape[:2])
        if factor <= 1 or rows * factor > self.rgb.shape[0] or cols * factor > self.rgb.shape[1]:
            return self
        small = cv2.resize(
            self.rgb[: rows * factor, : cols * factor], (cols, rows), interpolation=cv2.INTER_AREA
        )
        return Imagery(np.asarray(small, dtype=np.uint8), self.left, self.top, self.gsd_m * factor)
