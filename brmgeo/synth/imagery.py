"""Aerial pictures of a generated town: orthophotos with roofs, shadows, fields, trees and roads, and Kakao tile folders.

Everything is anchored to the world: noise is looked up by the pixel's place in its lattice and each object's detail comes
from its own random stream, so a window of a picture is the same pixels as that window painted alone.

The picture is built from the ground up. Ground colours and their textures (furrows, paddies, gravel, asphalt, a canopy of
crowns under the woods) come first; then buildings and trees in order of height, each first throwing its shadow on
all that is lower and then covering it with its own lit top. Slopes are shaded by Lambert's law. Last come large-scale
variation, haze, the sensor's blur and its noise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numba as nb
import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from brmgeo.geo.crs import transformer
from brmgeo.geo.grid import gsd_of
from brmgeo.geo.tilegrid import KakaoGrid, Tile
from brmgeo.pictures import encode
from brmgeo.synth.scene import Building, Season, Town
from brmgeo.synth.terrain import Waves

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
_SHIFT = 4
_WINDOW_PX = 1024
_BLOCK_PX = 2048
_PERIOD_PX = 1024
_TILED_PX = 2112
_CANOPY_PX = 1536

# Texture classes of the ground and the strength of fine (0.3 m), middle (1.2 m) and coarse (6 m) noise on them.
_MEADOW, _CROP, _SOIL, _PAVED, _WATER, _WOODS, _GRAVEL, _SMOOTH = range(8)
_GRAIN = np.array(
    [
        [0.060, 0.070, 0.070],
        [0.050, 0.045, 0.035],
        [0.045, 0.050, 0.055],
        [0.028, 0.022, 0.045],
        [0.010, 0.014, 0.035],
        [0.0, 0.0, 0.0],
        [0.075, 0.060, 0.060],
        [0.020, 0.015, 0.030],
    ],
    dtype=np.float32,
)

# kind: (colour, spread between parcels, texture, row spacing in metres, row strength)
_GROUND: dict[str, tuple[tuple[int, int, int], float, int, float, float]] = {
    "rice": ((98, 124, 68), 0.07, _CROP, 0.9, 0.035),
    "rice_ripe": ((176, 156, 82), 0.07, _CROP, 0.9, 0.035),
    "paddy_wet": ((104, 100, 84), 0.10, _WATER, 1.2, 0.03),
    "barley": ((112, 140, 72), 0.08, _CROP, 1.4, 0.05),
    "stubble": ((160, 146, 112), 0.07, _SOIL, 1.6, 0.08),
    "maize": ((78, 106, 56), 0.08, _CROP, 1.2, 0.10),
    "pepper": ((110, 116, 82), 0.09, _SOIL, 1.3, 0.15),
    "cabbage": ((120, 146, 98), 0.08, _SOIL, 0.9, 0.15),
    "mulch": ((128, 120, 108), 0.10, _SOIL, 1.2, 0.19),
    "grass": ((112, 128, 76), 0.09, _MEADOW, 0.0, 0.0),
    "grass_dry": ((150, 138, 102), 0.07, _MEADOW, 0.0, 0.0),
    "soil": ((142, 123, 99), 0.10, _SOIL, 1.5, 0.10),
    "orchard": ((122, 128, 84), 0.07, _MEADOW, 0.0, 0.0),
    "vinyl_ground": ((138, 128, 104), 0.08, _GRAVEL, 0.0, 0.0),
    "village": ((128, 126, 94), 0.05, _MEADOW, 0.0, 0.0),
    "concrete": ((168, 164, 154), 0.07, _SMOOTH, 0.0, 0.0),
    "yard": ((160, 146, 122), 0.08, _GRAVEL, 0.0, 0.0),
    "gravel": ((152, 146, 134), 0.07, _GRAVEL, 0.0, 0.0),
    "garden": ((98, 114, 66), 0.10, _CROP, 0.9, 0.14),
    "lawn": ((100, 128, 70), 0.08, _MEADOW, 0.0, 0.0),
    "asphalt": ((116, 117, 119), 0.06, _PAVED, 0.0, 0.0),
    "complex": ((112, 126, 90), 0.04, _MEADOW, 0.0, 0.0),
    "parking": ((104, 106, 110), 0.03, _PAVED, 0.0, 0.0),
    "playground": ((166, 120, 98), 0.10, _SMOOTH, 0.0, 0.0),
    "sports": ((194, 174, 138), 0.03, _GRAVEL, 0.0, 0.0),
}
_MEADOW_COLOUR: dict[Season, tuple[int, int, int]] = {
    "spring": (136, 136, 88),
    "summer": (106, 122, 70),
    "autumn": (142, 130, 84),
    "winter": (150, 138, 106),
}
_CANOPY: dict[Season, tuple[tuple[int, int, int], ...]] = {
    "spring": ((66, 88, 50), (96, 122, 62), (112, 136, 74), (58, 78, 48)),
    "summer": ((52, 76, 44), (70, 98, 52), (84, 110, 56), (46, 68, 42)),
    "autumn": ((60, 78, 46), (136, 104, 52), (122, 82, 46), (98, 104, 54)),
    "winter": ((54, 72, 48), (116, 104, 88), (104, 94, 80), (50, 66, 44)),
}
_ROAD_COLOUR = {
    "arterial": (104, 105, 108),
    "main": (110, 111, 113),
    "street": (128, 127, 125),
    "lane": (160, 157, 149),
    "track": (150, 141, 116),
}
_CARS = (
    (222, 222, 220),
    (232, 232, 230),
    (52, 54, 58),
    (40, 41, 44),
    (128, 130, 134),
    (168, 170, 172),
    (58, 78, 122),
    (142, 44, 40),
)


@lru_cache(maxsize=24)
def _noise(seed: int, sigma_px: float) -> F32:
    """(P, P) float32 periodic noise, mean 0, standard deviation 1, blurred by ``sigma_px``."""
    white = np.random.default_rng([seed, 77]).standard_normal((_PERIOD_PX, _PERIOD_PX))
    if sigma_px <= 0:
        return _tiled(white.astype(np.float32))
    f = np.fft.fftfreq(_PERIOD_PX)
    damp = np.exp(-2 * (math.pi * sigma_px) ** 2 * f**2)
    smooth = np.fft.ifft2(np.fft.fft2(white) * damp[:, None] * damp[None, :]).real
    return _tiled((smooth / smooth.std()).astype(np.float32))


def _tiled(periodic: F32) -> F32:
    """A periodic picture repeated to _TILED_PX, so that a window anywhere is a slice of it."""
    index = np.arange(_TILED_PX) % _PERIOD_PX
    return np.ascontiguousarray(periodic[np.ix_(index, index)])


@lru_cache(maxsize=2)
def _sensor_noise(seed: int, sigma: float) -> F32:
    """(T, T, 3) float32 periodic noise of the sensor: mostly grey, a little coloured."""
    grey = np.random.default_rng([seed + 8, 77]).standard_normal((_PERIOD_PX, _PERIOD_PX, 1))
    tint = _noise(seed + 9, 0.6)[:_PERIOD_PX, :_PERIOD_PX, None]
    both = sigma * (0.8 * grey + 0.5 * tint * np.array([1.0, -0.3, -0.7]))
    return _tiled(both.astype(np.float32))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _raise_domes(height, owner, radius, cx, cy, lift, gsd_m):  # type: ignore[no-untyped-def]
    # height (n, n) float32 and owner (n, n) int32, periodic, are lifted to the domes (1-based in owner) that stand higher.
    size = height.shape[0]
    for k in range(radius.size):
        r = radius[k] / gsd_m
        rise = 1.15 * radius[k]
        x0, y0, n = int(cx[k] - r), int(cy[k] - r), int(2 * r) + 2
        for y in range(y0, y0 + n):
            for x in range(x0, x0 + n):
                d2 = ((x - cx[k]) ** 2 + (y - cy[k]) ** 2) / (r * r)
                if d2 < 1:
                    dome = np.float32(rise * math.sqrt(1 - d2) + lift[k])
                    if dome > height[y % size, x % size]:
                        height[y % size, x % size] = dome
                        owner[y % size, x % size] = k + 1


@lru_cache(maxsize=8)
def _canopy(seed: int, season: Season, gsd_m: float, azimuth_deg: float, elevation_deg: float) -> U8:
    """(P, P, 3) uint8 periodic closed forest seen from above: lit domes of many sizes, dark gaps between them."""
    rng = np.random.default_rng([seed, 78])
    size = _CANOPY_PX
    height = np.zeros((size, size), np.float32)
    owner = np.zeros((size, size), np.int32)
    ground = (size * gsd_m) ** 2
    count = int(ground / 9.5)
    radius = np.sort(np.clip(rng.lognormal(0.72, 0.32, count), 0.9, 4.6))
    cx, cy = rng.uniform(0, size, (2, count))
    lift = rng.uniform(0.0, 2.6, count)
    _raise_domes(height, owner, radius, cx, cy, lift, gsd_m)
    rough = np.tile(_noise(seed + 5, max(0.35 / gsd_m, 0.6))[:_PERIOD_PX, :_PERIOD_PX], (2, 2))[:size, :size]
    height += 0.22 * rough
    east = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / (2 * gsd_m)
    north = (np.roll(height, 1, 0) - np.roll(height, -1, 0)) / (2 * gsd_m)
    az, el = math.radians(azimuth_deg), math.radians(elevation_deg)
    sun = np.array([math.sin(az) * math.cos(el), math.cos(az) * math.cos(el), math.sin(el)])
    lit = (-0.75 * east * sun[0] - 0.75 * north * sun[1] + sun[2]) / np.sqrt(1 + 0.56 * (east**2 + north**2))
    shade = np.ones_like(height)
    for step in (0.8, 1.6, 2.6, 3.8):
        dx, dy = round(sun[0] / math.cos(el) * step / gsd_m), round(-sun[1] / math.cos(el) * step / gsd_m)
        blocker = np.roll(height, (-dy, -dx), (0, 1)) - step * math.tan(el)
        shade = np.minimum(shade, 1 - 0.5 * np.clip((blocker - height) / 0.8, 0, 1))
    light = (
        np.clip(0.3 + 0.78 * np.clip(lit, 0, 1.2), 0.25, 1.3)
        * shade
        * np.clip(0.55 + 0.16 * height, 0.45, 1.12)
    )
    palette = np.array(_CANOPY[season], dtype=np.float32)
    kind = rng.choice(len(palette), count + 1, p=[0.38, 0.28, 0.16, 0.18])
    tint = palette[kind] * rng.normal(1.0, 0.09, (count + 1, 1)) * rng.normal(1.0, 0.03, (count + 1, 3))
    return np.asarray(np.clip(tint[owner] * (1.22 * light)[..., None], 0, 255), dtype=np.uint8)


@lru_cache(maxsize=512)
def _crown(seed: int, season: Season, radius_px: int, kind: int, azimuth_deg: float) -> tuple[F32, F32]:
    """((n, n, 3) colour, (n, n, 1) alpha) of one tree seen from above."""
    rng = np.random.default_rng([seed, 79, radius_px, kind])
    n = 2 * radius_px + 3
    y, x = (np.mgrid[0:n, 0:n] - (n - 1) / 2) / max(radius_px, 1)
    angle = np.arctan2(y, x)
    edge = 1 + sum(rng.normal(0, 0.07) * np.cos(k * angle + rng.uniform(0, 6.3)) for k in range(2, 7))
    d = np.hypot(x, y) / edge
    alpha = np.clip((1 - d) * radius_px * 0.8 + 0.5, 0, 1)
    az = math.radians(azimuth_deg)
    toward = x * math.sin(az) - y * math.cos(az)
    lump = cv2.GaussianBlur(rng.standard_normal((n, n)), (0, 0), max(radius_px * 0.14, 0.6))
    lump = lump / max(float(lump.std()), 1e-6)
    light = 0.92 + 0.42 * toward * np.clip(d, 0, 1) + 0.12 * lump
    palette = _CANOPY[season]
    tint = np.array(palette[kind % len(palette)], dtype=np.float64) * rng.normal(1.08, 0.08)
    colour = np.clip(light[..., None] * tint, 8, 250)
    return colour.astype(np.float32), alpha[..., None].astype(np.float32)


@dataclass
class _Shapes:
    """Polygons in lattice pixels with their bounding boxes, ready to be culled and filled."""

    rings: list[list[NDArray[np.float64]]]
    boxes: NDArray[np.float64]

    def near(self, left: float, top: float, right: float, bottom: float) -> list[int]:
        b = self.boxes
        if not len(b):
            return []
        hit = (b[:, 0] <= right) & (b[:, 2] >= left) & (b[:, 1] <= bottom) & (b[:, 3] >= top)
        return [int(i) for i in np.flatnonzero(hit)]


class Painter:
    """Paints windows of one town at one GSD in one CRS.

    Global pixel (row, col) is the one whose upper left corner lies at x = col * gsd, y = -row * gsd. ``paint`` gives the
    same pixels for the same place whatever window they are in.
    """

    def __init__(self, town: Town, crs: str, gsd_m: float) -> None:
        self._town, self._gsd = town, gsd_m
        self._style, self._seed = town.style, town.seed
        move = None if crs == town.crs else transformer(town.crs, crs)

        def pixels(xy: NDArray[np.float64]) -> NDArray[np.float64]:
            if move is not None:
                xy = np.column_stack(move.transform(xy[:, 0], xy[:, 1]))
            return np.column_stack([xy[:, 0] / gsd_m, -xy[:, 1] / gsd_m])

        self._pixels = pixels
        left, bottom, right, top = town.bounds
        probe = pixels(
            np.array(
                [[(left + right) / 2, (bottom + top) / 2], [(left + right) / 2 + 100.0, (bottom + top) / 2]]
            )
        )
        self._turn = math.atan2(-(probe[1, 1] - probe[0, 1]), probe[1, 0] - probe[0, 0])
        self._buildings = self._shapes([b.polygon for b in town.buildings])
        self._order = sorted(range(len(town.buildings)), key=lambda i: (town.buildings[i].height_m, i))
        self._fields = self._shapes([f.polygon for f in town.fields])
        self._grounds = self._shapes([g.polygon for g in town.grounds])
        self._woods = self._shapes(town.woods)
        self._banks = self._shapes(town.banks)
        self._water = self._shapes(town.water)
        self._sand = self._shapes([p.buffer(5.0) for p in town.water])
        self._walls = [pixels(np.asarray(w.coords)) for w in town.walls]
        self._wall_boxes = np.array([[*w.min(0), *w.max(0)] for w in self._walls]).reshape(-1, 4)
        ranks = ("track", "lane", "street", "main", "arterial")
        roads = sorted(town.roads, key=lambda r: ranks.index(r.kind))
        self._road_kinds = [r.kind for r in roads]
        self._roads = self._shapes([r.line.buffer(r.width_m / 2, cap_style="flat") for r in roads])
        self._kerbs = self._shapes(
            [
                r.line.buffer(r.width_m / 2 + (2.4 if r.kind == "arterial" else 0.9), cap_style="flat")
                for r in roads
            ]
        )
        self._marks: list[tuple[NDArray[np.float64], tuple[int, int, int], bool]] = []
        for r in roads:
            if r.kind in ("arterial", "main"):
                half = r.width_m / 2
                for off in (0.18, -0.18) if r.kind == "arterial" else (0.0,):
                    self._mark(r.line, off, (206, 170, 70), False)
                for off in (half - 0.5, 0.5 - half):
                    self._mark(r.line, off, (214, 214, 210), False)
                for off in (half / 2, -half / 2) if r.kind == "arterial" else ():
                    self._mark(r.line, off, (214, 214, 210), True)
        self._mark_boxes = np.array([[*m[0].min(0), *m[0].max(0)] for m in self._marks]).reshape(-1, 4)
        self._trees = (
            np.column_stack([pixels(town.trees[:, :2]), town.trees[:, 2]])
            if len(town.trees)
            else np.zeros((0, 3))
        )
        self._cars = (
            np.column_stack([pixels(town.cars[:, :2]), town.cars[:, 2] + self._turn])
            if len(town.cars)
            else np.zeros((0, 3))
        )
        rng = np.random.default_rng([self._seed, 80])
        self._broad = [
            Waves(rng, (70.0, 420.0), 16),
            Waves(rng, (50.0, 260.0), 16),
            Waves(rng, (8.0, 40.0), 30),
        ]
        az, el = math.radians(self._style.sun_azimuth_deg), math.radians(self._style.sun_elevation_deg)
        az -= self._turn
        self._sun = np.array([math.sin(az) * math.cos(el), math.cos(az) * math.cos(el), math.sin(el)])
        # Pixels of shadow per metre of height, in (col, row).
        self._cast = np.array([-math.sin(az), math.cos(az)]) / math.tan(el) / gsd_m
        tallest = max((b.height_m for b in town.buildings), default=0.0)
        self._reach_px = int(max(tallest, 12.0) / math.tan(el) / gsd_m) + 40

    def _shapes(self, polygons: object) -> _Shapes:
        rings: list[list[NDArray[np.float64]]] = []
        boxes: list[list[float]] = []
        for polygon in shapely.get_parts(np.asarray(polygons, dtype=object)):
            # Multi-part buffers are painted as one shape: fillPoly is even-odd and the parts do not overlap.
            for_shape = [
                self._pixels(np.asarray(ring.coords)[:, :2])
                for part in shapely.get_parts(polygon)
                for ring in (part.exterior, *part.interiors)
            ]
            every = np.concatenate(for_shape) if for_shape else np.zeros((1, 2))
            rings.append(for_shape)
            boxes.append([*every.min(0), *every.max(0)])
        return _Shapes(rings, np.array(boxes).reshape(-1, 4))

    def _mark(
        self, line: shapely.LineString, offset_m: float, colour: tuple[int, int, int], dashed: bool
    ) -> None:
        moved = shapely.offset_curve(line, offset_m) if offset_m else line
        for part in shapely.get_parts(moved):
            if dashed:
                for s in np.arange(0, part.length - 5.0, 13.0):
                    piece = shapely.ops.substring(part, s, s + 5.0)
                    self._marks.append((self._pixels(np.asarray(piece.coords)), colour, True))
            else:
                points = np.asarray(part.coords)
                for k in range(0, len(points) - 1, 12):
                    self._marks.append((self._pixels(points[k : k + 13]), colour, False))

    # --- painting one window -------------------------------------------------------------------------------------

    def paint(self, row: int, col: int, height: int, width: int) -> U8:
        """(height, width, 3) uint8 RGB of global pixels [row, row + height) x [col, col + width)."""
        pad = 12 + int(3 * self._style.blur_m / self._gsd)
        self._origin = np.array([col - pad, row - pad], dtype=np.float64)
        shape = (height + 2 * pad, width + 2 * pad)
        self._frame = (col - pad, row - pad, col - pad + shape[1], row - pad + shape[0])
        rows, cols = np.arange(row - pad, row - pad + shape[0]), np.arange(col - pad, col - pad + shape[1])
        self._wrap = np.ix_(rows % _PERIOD_PX, cols % _PERIOD_PX)
        img = self._ground(shape, rows, cols)
        shadow = np.zeros(shape, np.uint8)
        self._draw_walls(img, shadow)
        self._draw_cars(img, shadow)
        self._draw_tops(img, shadow)
        soft = (
            cv2.GaussianBlur(shadow, (0, 0), max(0.12 / self._gsd, 0.4)).astype(np.float32)[..., None] / 255.0
        )
        broad = 1.0 + 0.035 * self._low(self._broad[0], shape, 64)
        img *= broad[..., None] - (soft * broad[..., None]) * np.array([0.64, 0.60, 0.51], np.float32)
        return self._develop(img)[pad : pad + height, pad : pad + width]

    def _points(
        self, ring: NDArray[np.float64], origin: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        at = self._origin if origin is None else origin
        return np.asarray(np.round((ring - at - 0.5) * (1 << _SHIFT)), dtype=np.int32)

    def _fill(
        self, target: NDArray[np.uint8], rings: list[NDArray[np.float64]], colour: object, smooth: bool = True
    ) -> None:
        kind = cv2.LINE_AA if smooth else cv2.LINE_8
        cv2.fillPoly(target, [self._points(r) for r in rings], colour, kind, _SHIFT)

    def _low(self, waves: Waves, shape: tuple[int, int], step: int = 16) -> F32:
        """A smooth field over the window, sampled on a fixed world grid every ``step`` pixels."""
        x0, y0 = (math.floor(v / step) * step for v in self._origin)
        nx, ny = shape[1] // step + 3, shape[0] // step + 3
        xs, ys = (x0 + step * np.arange(nx)) * self._gsd, -(y0 + step * np.arange(ny)) * self._gsd
        grid = waves(np.stack(np.meshgrid(xs, ys), axis=-1)).astype(np.float32)
        dx, dy = self._origin[0] - x0, self._origin[1] - y0
        moved = np.array([[1 / step, 0, dx / step], [0, 1 / step, dy / step]], np.float32)
        return np.asarray(
            cv2.warpAffine(
                grid,
                moved,
                (shape[1], shape[0]),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            ),
            dtype=np.float32,
        )

    def _ground(self, shape: tuple[int, int], rows: NDArray[np.int64], cols: NDArray[np.int64]) -> F32:
        base, label, lines = self._country(shape)
        self._yards(base, label, lines)
        self._streets(base, label, lines)
        return self._textured(base, label, lines, rows, cols)

    def _country(self, shape: tuple[int, int]) -> tuple[U8, U8, F32]:
        """Meadows, fields, sand, woods and water: their colours, what each pixel is, and factors on its light."""
        town, gsd, frame = self._town, self._gsd, self._frame
        base = np.empty((*shape, 3), np.uint8)
        base[:] = _MEADOW_COLOUR[self._style.season]
        label = np.zeros(shape, np.uint8)
        lines = np.ones(shape, np.float32)
        for i in self._banks.near(*frame):
            self._fill(
                base, self._banks.rings[i], tuple(int(c * 0.97) for c in _MEADOW_COLOUR[self._style.season])
            )
        for i in self._fields.near(*frame):
            f = town.fields[i]
            rings, box = self._fields.rings[i], self._fields.boxes[i]
            self._area(base, label, lines, rings, box, kind=f.kind, angle=f.angle_rad, shade=f.shade, index=i)
        for i in self._sand.near(*frame):
            ragged = self._low(self._broad[2], shape)
            sand = np.zeros(shape, np.uint8)
            self._fill(sand, self._sand.rings[i], 255)
            here = (sand > 127) & (ragged + 0.6 * self._low(self._broad[1], shape) > 0.1)
            base[here] = (188, 176, 148)
            label[here] = _GRAVEL
        for i in self._woods.near(*frame):
            self._fill(label, self._woods.rings[i], _WOODS, False)
        for i in self._water.near(*frame):
            self._fill(base, self._water.rings[i], (84, 100, 92))
            self._fill(label, self._water.rings[i], _WATER, False)
            water = np.zeros(shape, np.uint8)
            self._fill(water, self._water.rings[i], 255)
            depth = cv2.GaussianBlur(water, (0, 0), 4.5 / gsd).astype(np.float32) / 255.0
            inside = (water > 127).astype(np.float32)
            lines *= 1.0 + inside * (0.32 - 0.42 * depth + 0.05 * self._low(self._broad[2], shape))
        return base, label, lines

    def _yards(self, base: U8, label: U8, lines: F32) -> None:
        """Grounds about buildings, parking places and sports fields."""
        for i in self._grounds.near(*self._frame):
            g = self._town.grounds[i]
            angle = g.angle_rad + self._turn
            rings, box = self._grounds.rings[i], self._grounds.boxes[i]
            self._area(base, label, lines, rings, box, kind=g.kind, angle=angle, shade=g.shade, index=i)
            if g.kind == "parking":
                self._stalls(base, rings, angle)
            elif g.kind == "sports":
                self._track(base, rings)

    def _streets(self, base: U8, label: U8, lines: F32) -> None:
        """Kerbs and surfaces of roads, lesser ones first, and the paint on them."""
        frame = self._frame
        near = self._roads.near(*frame)
        for kind in ("track", "lane", "street", "main", "arterial"):
            colour = _ROAD_COLOUR[kind]
            mine = [i for i in near if self._road_kinds[i] == kind]
            for i in mine:
                if kind == "track":
                    continue
                kerb = (158, 156, 150) if kind in ("arterial", "street") else (134, 130, 104)
                self._fill(base, self._kerbs.rings[i], kerb)
                self._fill(label, self._kerbs.rings[i], _SMOOTH, False)
            for i in mine:
                self._fill(base, self._roads.rings[i], colour)
                self._fill(label, self._roads.rings[i], _PAVED if kind != "track" else _GRAVEL, False)
                self._fill_ones(lines, self._roads.rings[i])
        strength = min(1.0, 0.2 / self._gsd)
        b = self._mark_boxes
        hit = (b[:, 0] <= frame[2]) & (b[:, 2] >= frame[0]) & (b[:, 1] <= frame[3]) & (b[:, 3] >= frame[1])
        for k in np.flatnonzero(hit).tolist():
            points, paint, _ = self._marks[k]
            mixed = tuple(int(strength * p + (1 - strength) * 106) for p in paint)
            cv2.polylines(base, [self._points(points)], False, mixed, 1, cv2.LINE_AA, _SHIFT)

    def _textured(
        self, base: U8, label: U8, lines: F32, rows: NDArray[np.int64], cols: NDArray[np.int64]
    ) -> F32:
        """The painted ground with the grain of each surface, worn patches and the crowns of woods."""
        gsd, shape = self._gsd, label.shape
        part = self._texture
        texture = np.take(_GRAIN[:, 0], label) * part(
            _noise(self._seed, round(0.3 / gsd, 2) if gsd < 0.6 else 0.5)
        )
        texture += np.take(_GRAIN[:, 1], label) * part(_noise(self._seed + 1, round(1.2 / gsd, 2)))
        texture += np.take(_GRAIN[:, 2], label) * part(_noise(self._seed + 2, round(6.0 / gsd, 2)))
        img = base.astype(np.float32)
        img *= ((1.0 + texture) * lines)[..., None]
        # Worn and wet patches: green and brown do not vary together.
        patch = self._low(self._broad[1], shape) * 0.022
        patch += 0.03 * part(_noise(self._seed + 3, round(9.0 / gsd, 2)))
        vegetated = (label == _MEADOW) | (label == _CROP)
        img[..., 0] *= 1.0 + np.where(vegetated, 1.1 * patch, 0.3 * patch)
        img[..., 2] *= 1.0 - np.where(vegetated, 0.7 * patch, 0.0)
        woods = label == _WOODS
        if woods.any():
            st = self._style
            canopy = _canopy(self._seed, st.season, gsd, st.sun_azimuth_deg, st.sun_elevation_deg)
            at = np.ix_(rows % _CANOPY_PX, cols % _CANOPY_PX)
            alpha = cv2.GaussianBlur(woods.astype(np.float32), (0, 0), 0.35 / gsd)[..., None]
            mix = self._low(self._broad[0], shape)[..., None]
            crowns = canopy[at].astype(np.float32) * (
                1.0 + 0.15 * np.concatenate([mix, 0.7 * mix, 0.5 * mix], -1)
            )
            img += alpha * (crowns - img)
        return img

    def _fill_ones(self, lines: F32, rings: list[NDArray[np.float64]]) -> None:
        cv2.fillPoly(lines, [self._points(r) for r in rings], 1.0, cv2.LINE_8, _SHIFT)

    def _roi(self, box: NDArray[np.float64], margin: int = 2) -> tuple[int, int, int, int] | None:
        """(row0, row1, col0, col1) of a bounding box within the window, or None."""
        left, top, right, bottom = self._frame
        c0, r0 = max(int(box[0]) - margin, left) - left, max(int(box[1]) - margin, top) - top
        c1, r1 = min(int(box[2]) + margin + 1, right) - left, min(int(box[3]) + margin + 1, bottom) - top
        return (r0, r1, c0, c1) if r1 > r0 and c1 > c0 else None

    def _area(
        self, base: U8, label: U8, lines: F32, rings: list[NDArray[np.float64]], box: NDArray[np.float64], *,
        kind: str, angle: float, shade: float, index: int,
    ) -> None:  # fmt: skip
        """One parcel or yard: its colour, its texture class and its rows."""
        colour, spread, texture, spacing, strength = _GROUND[kind]
        rng = np.random.default_rng([self._seed, 81, index])
        hue = 0.012 if texture in (_PAVED, _SMOOTH, _GRAVEL) else 0.018
        tint = np.array(colour) * (1 + spread * float(np.clip(shade, -2, 2)) * 0.8) * rng.normal(1.0, hue, 3)
        if kind in ("village", "lawn", "grass", "complex", "orchard", "garden") and self._style.season in (
            "winter",
            "autumn",
        ):
            tint = 0.5 * tint + 0.5 * np.array(_MEADOW_COLOUR[self._style.season])
        self._fill(base, rings, tuple(int(np.clip(c, 0, 255)) for c in tint))
        self._fill(label, rings, texture, False)
        roi = self._roi(box)
        if roi is None or not strength or spacing / self._gsd < 2.2:
            return
        r0, r1, c0, c1 = roi
        y = (np.arange(r0, r1) + self._origin[1]).astype(np.float64)[:, None] * self._gsd
        x = (np.arange(c0, c1) + self._origin[0]).astype(np.float64)[None, :] * self._gsd
        # Rows run along ``angle``; the lattice's y points down.
        across = x * math.sin(angle) + y * math.cos(angle)
        noise = _noise(self._seed + 4, round(4.0 / self._gsd, 2))
        wobble = noise[
            np.ix_(
                (np.arange(r0, r1) + int(self._origin[1])) % _PERIOD_PX,
                (np.arange(c0, c1) + int(self._origin[0])) % _PERIOD_PX,
            )
        ]
        phase = (across + 0.05 * spacing * wobble) * (2 * math.pi / spacing)
        wave = np.cos(phase)
        if kind in ("mulch", "pepper", "cabbage"):  # plastic film or plants on ridges: sharp stripes
            wave = np.tanh(2.5 * wave)
        patchy = 1.0 + 0.5 * wobble
        stripes = (1.0 + strength * patchy * wave * rng.uniform(0.5, 1.3)).astype(np.float32)
        mask = np.zeros((r1 - r0, c1 - c0), np.uint8)
        at = self._origin + np.array([c0, r0])
        cv2.fillPoly(mask, [self._points(r, at) for r in rings], 1, cv2.LINE_8, _SHIFT)
        lines[r0:r1, c0:c1] = np.where(mask > 0, stripes, lines[r0:r1, c0:c1])

    def _stalls(self, base: U8, rings: list[NDArray[np.float64]], angle: float) -> None:
        ring = rings[0]
        middle = ring[:-1].mean(axis=0)
        along, across = (
            np.array([math.cos(angle), -math.sin(angle)]),
            np.array([-math.sin(angle), -math.cos(angle)]),
        )
        uv = np.column_stack([(ring - middle) @ along, (ring - middle) @ across])
        low, high = uv.min(0), uv.max(0)
        step = 2.5 / self._gsd
        strength = min(1.0, 0.15 / self._gsd)
        colour = tuple(int(106 + strength * 110) for _ in range(3))
        for v in (-5.0 / self._gsd, 5.0 / self._gsd):
            for u in np.arange(low[0] + step, high[0] - step / 2, step):
                a = middle + u * along + (v - 2.4 / self._gsd) * across
                b = middle + u * along + (v + 2.4 / self._gsd) * across
                cv2.polylines(base, [self._points(np.array([a, b]))], False, colour, 1, cv2.LINE_AA, _SHIFT)

    def _track(self, base: U8, rings: list[NDArray[np.float64]]) -> None:
        """The running track's lanes on a school's sports ground."""
        ring = rings[0][:4]
        middle = ring.mean(axis=0)
        u, v = (ring[1] - ring[0]) / 2, (ring[2] - ring[1]) / 2
        if np.hypot(*u) < np.hypot(*v):
            u, v = v, u
        ru, rv = np.hypot(*u), np.hypot(*v)
        t = np.linspace(0, 2 * math.pi, 90)
        for inset in (3.0, 5.0, 7.0):
            b = rv - inset / self._gsd
            straight = max(ru - inset / self._gsd - b, 1.0)
            x = b * np.cos(t) + np.where(np.cos(t) >= 0, straight, -straight)
            points = middle + np.outer(x, u / ru) + np.outer(b * np.sin(t), v / rv)
            cv2.polylines(base, [self._points(points)], True, (206, 192, 164), 1, cv2.LINE_AA, _SHIFT)

    def _draw_walls(self, img: F32, shadow: U8) -> None:
        b = self._wall_boxes
        left, top, right, bottom = self._frame
        if not len(b):
            return
        for i in np.flatnonzero(
            (b[:, 0] <= right) & (b[:, 2] >= left) & (b[:, 1] <= bottom) & (b[:, 3] >= top)
        ):
            wall = self._walls[int(i)]
            for part in (0.5, 1.0):
                cv2.polylines(
                    shadow, [self._points(wall + self._cast * 1.3 * part)], False, 150, 1, cv2.LINE_AA, _SHIFT
                )
            cv2.polylines(img, [self._points(wall)], False, (176.0, 172.0, 164.0), 1, cv2.LINE_8, _SHIFT)
            cv2.polylines(shadow, [self._points(wall)], False, 0, 1, cv2.LINE_8, _SHIFT)

    def _draw_cars(self, img: F32, shadow: U8) -> None:
        left, top, right, bottom = self._frame
        c = self._cars
        near = (c[:, 0] > left - 20) & (c[:, 0] < right + 20) & (c[:, 1] > top - 20) & (c[:, 1] < bottom + 20)
        for i in np.flatnonzero(near):
            x, y, angle = c[int(i)]
            rng = np.random.default_rng([self._seed, 82, int(i)])
            long, wide = (7.5, 2.3) if rng.random() < 0.06 else (float(rng.uniform(4.1, 4.9)), 1.85)
            middle = np.array([x, y])
            colour = np.array(
                _CARS[int(rng.choice(len(_CARS), p=[0.24, 0.14, 0.16, 0.14, 0.12, 0.1, 0.06, 0.04]))],
                dtype=np.float64,
            )
            u = np.array([math.cos(angle), -math.sin(angle)]) / self._gsd
            v = np.array([u[1], -u[0]])

            def box(
                a0: float,
                a1: float,
                b: float,
                u: NDArray[np.float64] = u,
                v: NDArray[np.float64] = v,
                at: NDArray[np.float64] = middle,
            ) -> NDArray[np.float64]:
                return np.array(
                    [at + a0 * u - b * v, at + a1 * u - b * v, at + a1 * u + b * v, at + a0 * u + b * v]
                )

            body = box(-long / 2, long / 2, wide / 2)
            self._sweep(shadow, body, self._cast * 1.3)
            cv2.fillConvexPoly(shadow, self._points(body), 0, cv2.LINE_8, _SHIFT)
            cv2.fillConvexPoly(img, self._points(body), colour.tolist(), cv2.LINE_8, _SHIFT)
            if self._gsd < 0.45:
                glass = (colour * 0.2 + 22).tolist()
                cv2.fillConvexPoly(
                    img, self._points(box(0.12 * long, 0.27 * long, wide * 0.42)), glass, cv2.LINE_8, _SHIFT
                )
                cv2.fillConvexPoly(
                    img, self._points(box(-0.38 * long, -0.28 * long, wide * 0.42)), glass, cv2.LINE_8, _SHIFT
                )

    def _sweep(self, shadow: U8, ring: NDArray[np.float64], by: NDArray[np.float64]) -> None:
        """The ground that a ring covers while it moves by a vector: the shadow of an upright prism."""
        for a, b in zip(ring, np.roll(ring, -1, axis=0)):
            cv2.fillConvexPoly(
                shadow, self._points(np.array([a, b, b + by, a + by])), 255, cv2.LINE_AA, _SHIFT
            )

    def _draw_tops(self, img: F32, shadow: U8) -> None:
        """Buildings and trees, lowest first: each throws its shadow, then covers what lies under it."""
        left, top, right, bottom = self._frame
        reach = self._reach_px
        near = set(self._buildings.near(left - reach, top - reach, right + reach, bottom + reach))
        todo: list[tuple[float, int, int]] = [
            (self._town.buildings[i].height_m, 0, i) for i in self._order if i in near
        ]
        t = self._trees
        around = 30.0 / self._gsd
        hit = (
            (t[:, 0] > left - around)
            & (t[:, 0] < right + around)
            & (t[:, 1] > top - around)
            & (t[:, 1] < bottom + around)
        )
        todo += [(1.1 + 1.7 * float(t[i, 2]), 1, int(i)) for i in np.flatnonzero(hit)]
        todo.sort()
        for height, is_tree, i in todo:
            if is_tree:
                self._tree(img, shadow, i, height)
            else:
                self._building(img, shadow, i)

    def _tree(self, img: F32, shadow: U8, i: int, height: float) -> None:
        x, y, radius = self._trees[i]
        r = radius / self._gsd
        centre = np.array([x, y])
        thrown = self._points(centre + self._cast * height * 0.55)
        axes = (round(r * 1.15 * 16), round(r * 0.92 * 16))
        turn = math.degrees(math.atan2(self._cast[1], self._cast[0]))
        ring = cv2.ellipse2Poly((0, 0), (max(axes[0], 8), max(axes[1], 8)), round(turn), 0, 360, 20)
        cv2.fillConvexPoly(shadow, (ring + thrown).astype(np.int32), 225, cv2.LINE_AA, _SHIFT)
        n = max(1, round(r))
        kind = i % 7
        colour, alpha = _crown(self._seed, self._style.season, n, kind, self._style.sun_azimuth_deg)
        r0, c0 = (
            math.floor(y) - n - 1 - int(self._origin[1]),
            math.floor(x) - n - 1 - int(self._origin[0]),
        )
        size = colour.shape[0]
        a, b = max(0, -r0), max(0, -c0)
        c, d = min(size, img.shape[0] - r0), min(size, img.shape[1] - c0)
        if c <= a or d <= b:
            return
        here = (slice(r0 + a, r0 + c), slice(c0 + b, c0 + d))
        cover = alpha[a:c, b:d]
        img[here] += cover * (colour[a:c, b:d] - img[here])
        shadow[here] = np.where(cover[..., 0] > 0.45, 0, shadow[here])

    # --- roofs ---------------------------------------------------------------------------------------------------

    def _lambert(self, direction: NDArray[np.float64] | tuple[float, float], pitch: float) -> float:
        """Brightness of a slope that faces ``direction`` (east, north), relative to flat ground."""
        e, n = direction
        c, s = math.cos(pitch), math.sin(pitch)
        lit = (e * s * self._sun[0] + n * s * self._sun[1] + c * self._sun[2]) / self._sun[2]
        return float(np.clip(0.22 + 0.78 * lit, 0.35, 1.5))

    def _building(self, img: F32, shadow: U8, i: int) -> None:
        b = self._town.buildings[i]
        rings = self._buildings.rings[i]
        by = self._cast * b.height_m
        for ring in rings:
            if b.roof == "canopy":  # open below: the shadow is the roof's own outline, moved
                cv2.fillPoly(shadow, [self._points(ring[:-1] + by)], 255, cv2.LINE_AA, _SHIFT)
            self._sweep(shadow, ring[:-1], by)
        if len(rings) == 1:
            cv2.fillPoly(shadow, [self._points(rings[0] + by)], 255, cv2.LINE_AA, _SHIFT)
        roi = self._roi(self._buildings.boxes[i], 3)
        if roi is None:
            return
        _r0, _r1, _c0, _c1 = roi
        # Paint the roof on its own ground with a rim, so that it does not depend on where a window cuts it.
        left, top, right, bottom = self._buildings.boxes[i]
        rim = max(4, int(1.6 / self._gsd))
        fc, fr = math.floor(left) - rim, math.floor(top) - rim
        w, h = math.ceil(right) + rim - fc, math.ceil(bottom) + rim - fr
        at = np.array([fc, fr], dtype=np.float64)
        mask = np.zeros((h, w), np.uint8)
        cv2.fillPoly(mask, [self._points(r, at) for r in rings], 255, cv2.LINE_AA, _SHIFT)
        roof = self._roof(b, i, rings, at, mask)
        oc, orow = fc - int(self._origin[0]), fr - int(self._origin[1])
        a0, a1, b0, b1 = max(0, -orow), min(h, img.shape[0] - orow), max(0, -oc), min(w, img.shape[1] - oc)
        if a1 <= a0 or b1 <= b0:
            return
        here = (slice(orow + a0, orow + a1), slice(oc + b0, oc + b1))
        alpha = mask[a0:a1, b0:b1].astype(np.float32)[..., None] / 255.0
        shadow[here] = np.where(alpha[..., 0] > 0.5, 0, shadow[here])
        if b.roof == "vinyl":
            alpha = alpha * 0.93
        img[here] += alpha * (roof[a0:a1, b0:b1] - img[here])

    def _roof(
        self, b: Building, index: int, rings: list[NDArray[np.float64]], at: NDArray[np.float64], mask: U8
    ) -> F32:
        """(h, w, 3) float32 lit roof over the pixels from global corner ``at``."""
        gsd = self._gsd
        rng = np.random.default_rng([self._seed, 83, index])
        h, w = mask.shape
        y, x = np.mgrid[0:h, 0:w].astype(np.float32)
        px, py = (x + 0.5) * gsd, (y + 0.5) * gsd
        ring = (rings[0] - at) * gsd
        box = cv2.minAreaRect(ring[:-1].astype(np.float32))
        corners = cv2.boxPoints(box)
        e0, e1 = corners[1] - corners[0], corners[2] - corners[1]
        along = e0 if np.hypot(*e0) >= np.hypot(*e1) else e1
        long, wide = max(box[1]), max(min(box[1]), 0.5)
        along = along / max(float(np.hypot(*along)), 1e-6)
        across = np.array([-along[1], along[0]])
        mid = corners.mean(axis=0)
        u = (px - mid[0]) * along[0] + (py - mid[1]) * along[1]
        v = (px - mid[0]) * across[0] + (py - mid[1]) * across[1]
        facing = (float(across[0]), float(-across[1]))  # east, north of growing v
        rows, cols = (np.arange(h) + int(at[1])) % _PERIOD_PX, (np.arange(w) + int(at[0])) % _PERIOD_PX
        wrap = np.ix_(rows, cols)
        fine, stain = (
            _noise(self._seed + 6, round(0.25 / gsd, 2))[wrap],
            _noise(self._seed + 7, round(1.6 / gsd, 2))[wrap],
        )
        light = 1.0 + 0.022 * fine
        colour = np.array(b.colour, dtype=np.float32)
        tone = np.ones((h, w, 3), np.float32)
        if b.roof == "hip":
            light = light * self._hip(ring, px, py) * (1.0 + 0.03 * stain)
        elif b.roof in ("gable", "metal"):
            pitch = 0.42 if b.roof == "gable" else 0.16
            ridge = rng.normal(0, 0.03) * wide
            up, down = self._lambert(facing, pitch), self._lambert((-facing[0], -facing[1]), pitch)
            light = light * np.where(v > ridge, up, down)
            light = light * (1.0 + 0.10 * (np.abs(v - ridge) < max(0.18, 0.6 * gsd)))
            seam = float(rng.uniform(0.7, 1.3))
            if seam > 2.1 * gsd:
                light = light * (1.0 + 0.035 * np.cos(u * (2 * math.pi / seam)))
            light = light * (1.0 + (0.05 if b.roof == "metal" else 0.03) * stain)
            if b.roof == "metal" and rng.random() < 0.5 and long > 18:
                every, start = float(rng.uniform(4.5, 8.0)), float(rng.uniform(0, 5))
                panel = (((u + start) % every) < 0.9) & (np.abs(v) > 0.08 * wide) & (np.abs(v) < 0.42 * wide)
                tone += 0.22 * panel[..., None] * ((205.0 / colour) - 1.0).clip(-0.5, 1.5)
            if b.roof == "metal" and rng.random() < 0.35:
                rust = np.clip(stain + 0.6 * fine - 1.3, 0, 1)[..., None]
                tone *= 1.0 - rust * np.array([0.06, 0.26, 0.36], np.float32)
        elif b.roof in ("shed", "box"):
            tilt = float(rng.choice([-1.0, 1.0]))
            light = light * self._lambert((tilt * facing[0], tilt * facing[1]), 0.12) * (1.0 + 0.045 * stain)
            if 2.1 * gsd < 0.5:
                light = light * (1.0 + 0.04 * np.cos(u * (2 * math.pi / 0.55)))
        elif b.roof == "vinyl":
            side = np.clip(2 * v / wide, -1, 1)
            slope = np.arcsin(side * 0.85)
            sun_v = self._sun[0] * facing[0] + self._sun[1] * facing[1]
            lit = (np.sin(slope) * sun_v + np.cos(slope) * self._sun[2]) / self._sun[2]
            light = light * (0.36 + 0.62 * np.clip(lit, 0.1, 1.35)) * (1.0 + 0.05 * stain)
            light = light * (1.0 - 0.07 * (((u % 2.0) < 0.3) if gsd < 0.5 else 0.0))
            light = light * (1.0 + 0.09 * (np.abs(v) < 0.35))
        elif b.roof == "canopy":
            light = (
                light
                * (1.0 + 0.03 * stain)
                * self._lambert((facing[0] * rng.choice([-1, 1]), facing[1]), 0.08)
            )
            light = light * (1.0 - 0.06 * ((u % 1.8) < 0.25)) if gsd < 0.5 else light
        else:
            light, tone = self._flat(
                b, light, tone, fine, stain, mask, u=u, v=v, long=long, wide=wide, rng=rng
            )
        return np.asarray(colour * tone * light[..., None], dtype=np.float32)

    def _hip(self, ring: NDArray[np.float64], px: F32, py: F32) -> F32:
        """Slopes rise from every eave: a pixel belongs to its nearest wall; ridges and valleys lie between."""
        best = np.full(px.shape, 1e9, np.float32)
        second = best.copy()
        light = np.ones(px.shape, np.float32)
        turn = np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
        for a, b in itertools.pairwise(ring):
            edge = b - a
            length = float(np.hypot(*edge))
            if length < 0.3:
                continue
            d = edge / length
            s = np.clip((px - a[0]) * d[0] + (py - a[1]) * d[1], 0, length)
            distance = np.hypot(px - a[0] - s * d[0], py - a[1] - s * d[1])
            outward = np.array([d[1], -d[0]]) if turn > 0 else np.array([-d[1], d[0]])
            mine = self._lambert((float(outward[0]), float(-outward[1])), 0.46)
            closer = distance < best
            second = np.where(closer, best, np.minimum(second, distance))
            light = np.where(closer, np.float32(mine), light)
            best = np.where(closer, distance, best)
        ridge = (second - best < max(0.22, 0.7 * self._gsd)) & (best > 0.5)
        courses = 1.0 + 0.04 * np.cos(best * (2 * math.pi / 0.62)) if self._gsd < 0.29 else 1.0
        return np.asarray(
            light * courses * (1.0 + 0.10 * ridge) * (1.0 - 0.12 * (best < 0.22)), dtype=np.float32
        )

    def _flat(
        self, b: Building, light: F32, tone: F32, fine: F32, stain: F32, mask: U8, *, u: F32, v: F32, long: float,
        wide: float, rng: np.random.Generator,
    ) -> tuple[F32, F32]:  # fmt: skip
        """A flat concrete roof: parapet, its shadow, stains, stair heads, tanks and machines with shadows of their own."""
        gsd = self._gsd
        light = light * (1.0 + 0.045 * stain + 0.02 * fine)
        inside = mask > 127
        deep = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 3) * gsd
        h, w = mask.shape
        parapet = (deep < max(0.32, 0.9 * gsd)) & inside
        shade = np.zeros((h, w), np.float32)
        for length in (0.5, 1.0):
            moved = cv2.warpAffine(
                mask,
                np.array([[1, 0, self._cast[0] * length], [0, 1, self._cast[1] * length]], np.float32),
                (w, h),
            )
            shade = np.maximum(shade, (moved < 128).astype(np.float32))
        light = np.where(parapet, light * 1.0, light * (1.0 - 0.42 * shade))
        tone = np.where(parapet[..., None], np.float32(0.45) + 0.55 * tone + 0.08, tone)
        grey = np.array(b.colour, np.float32)
        things: list[tuple[float, float, float, float, float, tuple[float, float, float]]] = []
        if b.roof == "apartment":
            cores = max(2, round(long / 19))
            for c in range(cores):
                at = -long / 2 + (c + 0.5) * long / cores
                things.append(
                    (
                        at,
                        float(rng.normal(0, 0.3)),
                        float(rng.uniform(4.5, 6.0)),
                        float(rng.uniform(3.6, 5.0)),
                        2.9,
                        (186, 184, 178),
                    )
                )
                things.append(
                    (at + long / cores / 2, float(rng.uniform(-3, 3)), 1.2, 1.2, 0.9, (150, 150, 150))
                )
        elif b.polygon.area > 45:
            su, sv = rng.choice([-1.0, 1.0], 2)
            bw, bd = float(rng.uniform(2.6, 4.2)), float(rng.uniform(2.2, 3.6))
            at_u, at_v = su * (0.5 * long - bw * 0.75), sv * (0.5 * wide - bd * 0.75)
            if rng.random() < 0.75 or b.floors > 1:
                top = tuple(float(t) for t in np.clip(grey * rng.uniform(0.9, 1.25), 60, 225))
                things.append((at_u, at_v, bw, bd, 2.3, (top[0], top[1], top[2])))
            if rng.random() < 0.6:
                tank = ((212, 178, 70), (70, 112, 176), (196, 198, 198))[int(rng.integers(3))]
                things.append((at_u - su * bw, at_v, 1.5, 1.5, 1.6, tank))
            for _ in range(int(min(14, b.polygon.area / 90))):
                things.append((
                    float(rng.uniform(-0.42, 0.42) * long), float(rng.uniform(-0.38, 0.38) * wide),
                    float(rng.uniform(0.8, 2.4)),
                    float(rng.uniform(0.7, 1.6)), float(rng.uniform(0.6, 1.4)), (188, 188, 186),
                ))  # fmt: skip
        for at_u, at_v, bw, bd, tall, colour in things:
            box = (np.abs(u - at_u) < bw / 2) & (np.abs(v - at_v) < bd / 2) & inside
            if not box.any():
                continue
            thrown = np.zeros((h, w), np.float32)
            base = box.astype(np.float32)
            for part in np.linspace(0.2, 1.0, 5):
                by = self._cast * tall * part
                thrown = np.maximum(
                    thrown, cv2.warpAffine(base, np.array([[1, 0, by[0]], [0, 1, by[1]]], np.float32), (w, h))
                )
            light = light * (1.0 - 0.5 * thrown * inside * ~box)
            light = np.where(box, 1.02 + 0.03 * fine, light)
            tone = np.where(box[..., None], np.array(colour, np.float32) / grey, tone)
        return np.asarray(light, dtype=np.float32), np.asarray(tone, dtype=np.float32)

    # --- the camera ----------------------------------------------------------------------------------------------

    def _develop(self, img: F32) -> U8:
        """Colour, contrast and haze as one matrix, then the sensor's blur and noise."""
        st = self._style
        gain = np.array([1 + 0.06 * st.warmth, 1.0, 1 - 0.08 * st.warmth]) * st.brightness
        contrast = st.contrast * 1.04
        # Optics and air take some of every colour.
        fade = 0.8 * np.eye(3) + 0.2 * np.array([0.3, 0.59, 0.11])
        linear = (1 - st.haze) * fade @ np.diag(gain * contrast)
        shift = (1 - st.haze) * 118.0 * (1 - contrast) + st.haze * np.array([196.0, 204.0, 214.0])
        img = cv2.transform(img, np.column_stack([linear, shift]).astype(np.float32))
        sigma = st.blur_m / self._gsd
        if sigma > 0.25:
            img = cv2.GaussianBlur(img, (0, 0), sigma)
        img += self._texture(_sensor_noise(self._seed, st.noise))
        np.maximum(img, 0, out=img)
        return np.asarray(cv2.convertScaleAbs(img), dtype=np.uint8)

    def _texture(self, periodic: F32) -> F32:
        """The window's part of a periodic picture of _TILED_PX pixels: a view wherever the window is small enough."""
        r, c = self._frame[1] % _PERIOD_PX, self._frame[0] % _PERIOD_PX
        h, w = self._frame[3] - self._frame[1], self._frame[2] - self._frame[0]
        if r + h <= _TILED_PX and c + w <= _TILED_PX:
            return periodic[r : r + h, c : c + w]
        return np.asarray(periodic[self._wrap])


def render_imagery(town: Town, box: GeoBox, window_px: int = _WINDOW_PX) -> U8:
    """(H, W, 3) uint8 RGB orthophoto of ``town`` over ``box``, a north-up GeoBox of square pixels in any CRS.

    A window of ``box`` rendered by itself holds the same pixels. Where ``box`` reaches further than Town.margin_m
    beyond the town there is meadow.
    """
    gsd = gsd_of(box)
    painter = Painter(town, str(box.crs), gsd)
    row0, col0 = round(-box.affine.f / gsd), round(box.affine.c / gsd)
    rows, cols = box.shape
    out = np.empty((rows, cols, 3), np.uint8)
    for r in range(0, rows, window_px):
        for c in range(0, cols, window_px):
            h, w = min(window_px, rows - r), min(window_px, cols - c)
            out[r : r + h, c : c + w] = painter.paint(row0 + r, col0 + c, h, w)
    return out


def tile_blocks(town: Town, level: int) -> list[list[Tile]]:
    """The tiles of Kakao's grid that ``town.bounds`` touches, in blocks that are painted in one go."""
    grid = KakaoGrid()
    group = _BLOCK_PX // grid.tile_px
    found: dict[tuple[int, int], list[Tile]] = {}
    for tile in grid.covering(town.bounds, town.crs, level, margin_px=4.0):
        found.setdefault((tile.y // group, tile.x // group), []).append(tile)
    return [block for _, block in sorted(found.items())]


def write_tiles(
    painter: Painter, block: list[Tile], out_dir: Path, level: int, ext: str = "jpg", quality: int = 86
) -> int:
    """Paints and writes one of ``tile_blocks``, with a painter in the grid's CRS and at the level's GSD; their number."""
    grid = KakaoGrid()
    gsd, px = grid.gsd_m(level), grid.tile_px
    spans = [grid.tile_bounds(t, level) for t in block]
    left, top = min(s[0] for s in spans), max(s[3] for s in spans)
    right, bottom = max(s[2] for s in spans), min(s[1] for s in spans)
    row0, col0 = round(-top / gsd), round(left / gsd)
    patch = painter.paint(row0, col0, round((top - bottom) / gsd), round((right - left) / gsd))
    for tile, span in zip(block, spans):
        r, c = round((top - span[3]) / gsd), round((span[0] - left) / gsd)
        path = out_dir / grid.path(tile, level, ext)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode(patch[r : r + px, c : c + px], f".{ext}", quality=quality))
    return len(block)
