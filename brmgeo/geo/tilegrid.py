"""Tile grids: which image tile of a map service covers which ground, and under which path it is kept.

Two grids cover what a user in Korea meets:

- ``KakaoGrid``: EPSG:5181, 256 px, origin at the LOWER left corner (-30000, -60000), 2^(L - 3) metres per pixel at levels
  L1 (0.25 m) to L14, x to the east, y UP, path ``L{z}/{y}/{x}``. Its tiles are turned against the east-belt sheets of
  NGII by about 1.2 degrees, so imagery is reprojected, never only shifted.
- ``WebMercatorGrid``: EPSG:3857, the XYZ scheme of OpenStreetMap, VWorld and most services (y DOWN, path
  ``{z}/{x}/{y}``), OGC's WebMercatorQuad; ``tms=True`` counts y from the south instead,
  as MBTiles and TMS servers do.

A tile is a ``Tile(x, y)`` of a level z. Bounds are (left, bottom, right, top) in the grid's own CRS.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import shapely

from brmgeo.errors import CrsError, SettingsError
from brmgeo.geo.crs import parse_crs, transformer
from brmgeo.geo.grid import Bounds

TILE_PX = 256
# A bound that lies on a tile edge up to rounding must not ask for the neighbour: a ten-thousandth of a pixel.
_EDGE_TILES = 1e-4 / TILE_PX
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")


class Tile(NamedTuple):
    """Column and row of one tile in its grid's own counting."""

    x: int
    y: int


class TileGrid(ABC):
    """A pyramid of square tiles in one projected CRS; see the module's docstring for the two that exist."""

    name: ClassVar[str]
    epsg: ClassVar[int]
    min_level: ClassVar[int]
    max_level: ClassVar[int]
    template: ClassVar[str]
    tile_px: ClassVar[int] = TILE_PX

    @property
    def crs(self) -> str:
        """The grid's CRS, such as ``EPSG:5181``."""
        return f"EPSG:{self.epsg}"

    @property
    @abstractmethod
    def y_up(self) -> bool:
        """True where y grows to the north."""

    @abstractmethod
    def gsd_m(self, z: int) -> float:
        """Pixel size at level z in metres of the grid's CRS; raises SettingsError for a level the grid lacks."""

    @abstractmethod
    def _origin(self, z: int) -> tuple[float, float]:
        """World position of the corner from which x and y are counted."""

    @abstractmethod
    def _count(self, z: int) -> tuple[int, int]:
        """Number of tiles (columns, rows) at level z."""

    def check_level(self, z: int) -> None:
        """Raises SettingsError unless z is a level of this grid."""
        if not self.min_level <= z <= self.max_level:
            raise SettingsError(
                f"tile level {z} does not exist in the {self.name} grid: give {self.min_level} to {self.max_level}"
            )

    def tile_bounds(self, tile: tuple[int, int], z: int) -> Bounds:
        """(left, bottom, right, top) of a tile in the grid's CRS, metres."""
        span = self.gsd_m(z) * self.tile_px
        ox, oy = self._origin(z)
        x, y = tile
        if self.y_up:
            return (ox + x * span, oy + y * span, ox + (x + 1) * span, oy + (y + 1) * span)
        return (ox + x * span, oy - (y + 1) * span, ox + (x + 1) * span, oy - y * span)

    def tiles_covering(self, bounds: Bounds, z: int) -> list[Tile]:
        """All tiles at level z that share area with ``bounds`` (grid CRS, metres), row by row from the north.

        Raises CrsError where the bounds reach outside the grid.
        """
        x0, y0, x1, y1 = self._range(bounds, z)
        rows = range(y1 - 1, y0 - 1, -1) if self.y_up else range(y0, y1)
        return [Tile(x, y) for y in rows for x in range(x0, x1)]

    def covering(self, bounds: Bounds, crs: str, z: int, margin_px: float = 0.0) -> list[Tile]:
        """All tiles at level z that share area with ``bounds`` of another CRS, row by row from the north.

        The outline of ``bounds`` is reprojected with points every few tiles, so that its turn and curvature count: only
        tiles under the true outline are named, not those of its bounding box. ``margin_px`` widens the outline by that
        many tile pixels, for a resampling kernel. Raises CrsError where the bounds are outside the grid or its CRS.
        """
        left, bottom, right, top = bounds
        if not all(map(math.isfinite, bounds)) or not (right > left and top > bottom):
            raise SettingsError(f"bounds {bounds} span no area: give left < right and bottom < top")
        ring = shapely.box(left, bottom, right, top).exterior
        ring = shapely.segmentize(ring, max(right - left, top - bottom) / 64.0)
        points = shapely.get_coordinates(ring)
        x, y = transformer(crs, self.crs).transform(points[:, 0], points[:, 1])
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise CrsError(f"bounds {bounds} in {crs} cannot be placed in {self.crs}: check the region's CRS")
        outline = shapely.Polygon(np.column_stack([x, y])).buffer(
            margin_px * self.gsd_m(z), join_style="mitre"
        )
        tiles = self.tiles_covering(outline.bounds, z)
        edge = _EDGE_TILES * self.gsd_m(z) * self.tile_px
        corners = np.array([self.tile_bounds(t, z) for t in tiles]) + np.array([edge, edge, -edge, -edge])
        shapely.prepare(outline)
        hit = shapely.intersects(outline, shapely.box(*corners.T))
        return [t for t, h in zip(tiles, hit) if h]

    def path(
        self,
        tile: tuple[int, int],
        z: int,
        ext: str = "",
        template: str | None = None,
        subdomains: Sequence[str] = (),
    ) -> str:
        """The path or URL of a tile: ``template`` (default: the grid's own) with its placeholders filled.

        Placeholders: {z} {x} {y}, {-y} (y counted from the other side), {s} (one of ``subdomains``, always the same one for
        a tile) and {ext}. Where the template has no {ext}, ``.ext`` is appended if given.
        Raises SettingsError for any other placeholder.
        """
        template = self.template if template is None else template
        x, y = tile
        values = {"z": str(z), "x": str(x), "y": str(y), "-y": str(self.flipped(tile, z).y), "ext": ext}
        if subdomains:
            values["s"] = subdomains[(x + y) % len(subdomains)]

        def fill(match: re.Match[str]) -> str:
            if match[1] in values:
                return values[match[1]]
            hint = "list its subdomains" if match[1] == "s" else "use {z}, {x}, {y}, {-y}, {s} or {ext}"
            raise SettingsError(
                f"tile template {template!r} has a placeholder {match[0]} without a value: {hint}"
            )

        filled = _PLACEHOLDER.sub(fill, template)
        return filled if not ext or "{ext}" in template else f"{filled}.{ext}"

    def tile_from_path(self, path: str, template: str | None = None) -> tuple[Tile, int] | None:
        """The inverse of ``path`` without subdomains: (tile, z), or None where ``path`` does not fit the template."""
        template = self.template if template is None else template
        found = _template_pattern(template).fullmatch(path.replace("\\", "/"))
        if found is None:
            return None
        group = found.groupdict()
        z = int(group["z"]) if group.get("z") is not None else 0
        if "flip" not in group:
            return Tile(int(group["x"]), int(group["y"])), z
        return self.flipped((int(group["x"]), int(group["flip"])), z), z

    def flipped(self, tile: tuple[int, int], z: int) -> Tile:
        """The same tile with y counted from the opposite side of the grid (XYZ <-> TMS)."""
        return Tile(tile[0], self._count(z)[1] - 1 - tile[1])

    def _range(self, bounds: Bounds, z: int) -> tuple[int, int, int, int]:
        """Half-open index ranges (x0, y0, x1, y1) of the tiles under ``bounds``."""
        left, bottom, right, top = bounds
        if not all(map(math.isfinite, bounds)) or not (right > left and top > bottom):
            raise SettingsError(f"bounds {bounds} span no area: give left < right and bottom < top")
        span = self.gsd_m(z) * self.tile_px
        ox, oy = self._origin(z)
        low, high = (bottom - oy, top - oy) if self.y_up else (oy - top, oy - bottom)
        x0, y0 = math.floor((left - ox) / span + _EDGE_TILES), math.floor(low / span + _EDGE_TILES)
        x1 = max(x0 + 1, math.ceil((right - ox) / span - _EDGE_TILES))
        y1 = max(y0 + 1, math.ceil(high / span - _EDGE_TILES))
        columns, rows = self._count(z)
        if x0 < 0 or y0 < 0 or x1 > columns or y1 > rows:
            shown = ", ".join(f"{b:.0f}" for b in bounds)
            raise CrsError(
                f"bounds ({shown}) in {self.crs} reach outside the {self.name} tile grid: check the region's CRS and bounds"
            )
        return x0, y0, x1, y1


@dataclass(frozen=True)
class KakaoGrid(TileGrid):
    """Kakao's grid: EPSG:5181, y up from (-30000, -60000), 2^(L - 3) m per pixel, L1 to L14."""

    name: ClassVar[str] = "kakao"
    epsg: ClassVar[int] = 5181
    min_level: ClassVar[int] = 1
    max_level: ClassVar[int] = 14
    template: ClassVar[str] = "L{z}/{y}/{x}"

    @property
    def y_up(self) -> bool:
        return True

    def gsd_m(self, z: int) -> float:
        self.check_level(z)
        return 2.0 ** (z - 3)

    def _origin(self, z: int) -> tuple[float, float]:
        return (-30000.0, -60000.0)

    def _count(self, z: int) -> tuple[int, int]:
        # Two by two tiles of L14 (524 km each) hold all of Korea; beyond lies only a wrong CRS.
        n = 2 << (self.max_level - z)
        return n, n


@dataclass(frozen=True)
class WebMercatorGrid(TileGrid):
    """The XYZ grid in EPSG:3857 (OGC's WebMercatorQuad); ``tms=True`` counts y from the south."""

    tms: bool = False

    name: ClassVar[str] = "webmercator"
    epsg: ClassVar[int] = 3857
    min_level: ClassVar[int] = 0
    max_level: ClassVar[int] = 24
    template: ClassVar[str] = "{z}/{x}/{y}"

    @property
    def y_up(self) -> bool:
        return self.tms

    def gsd_m(self, z: int) -> float:
        self.check_level(z)
        return 2.0 * _mercator_half_m() / self.tile_px / 2.0**z

    def _origin(self, z: int) -> tuple[float, float]:
        half = _mercator_half_m()
        return (-half, -half if self.tms else half)

    def _count(self, z: int) -> tuple[int, int]:
        return 1 << z, 1 << z


def grid_named(name: str) -> TileGrid:
    """The grid that a region file names: ``kakao``, ``webmercator`` or ``xyz`` (the same), or ``tms``."""
    grids: dict[str, TileGrid] = {
        "kakao": KakaoGrid(),
        "webmercator": WebMercatorGrid(),
        "xyz": WebMercatorGrid(),
        "tms": WebMercatorGrid(tms=True),
    }
    if name not in grids:
        raise SettingsError(f"there is no tile grid {name!r}: give one of {', '.join(grids)}")
    return grids[name]


@lru_cache(maxsize=1)
def _mercator_half_m() -> float:
    """Half the side of the square that web mercator maps the earth to, metres."""
    ellipsoid = parse_crs("EPSG:3857").ellipsoid
    assert ellipsoid is not None
    return math.pi * float(ellipsoid.semi_major_metre)


@lru_cache(maxsize=32)
def _template_pattern(template: str) -> re.Pattern[str]:
    """A pattern with groups x, y or flip, z for paths made by ``template``; any extension is accepted."""
    groups = {
        "x": r"(?P<x>\d+)",
        "y": r"(?P<y>\d+)",
        "-y": r"(?P<flip>\d+)",
        "z": r"(?P<z>\d+)",
        "ext": r"[A-Za-z0-9]+",
    }
    parts = _PLACEHOLDER.split(template)
    seen: set[str] = set()
    pattern = re.escape(parts[0])
    for name, text in zip(parts[1::2], parts[2::2]):
        if name not in groups:
            raise SettingsError(
                f"tile template {template!r}: {{{name}}} cannot be read back from a folder of files"
            )
        pattern += groups[name] if name not in seen else f"(?P={'flip' if name == '-y' else name})"
        pattern += re.escape(text)
        seen.add(name)
    if "x" not in seen or not seen & {"y", "-y"}:
        raise SettingsError(f"tile template {template!r} needs {{x}} and {{y}} (or {{-y}})")
    return re.compile(pattern if "ext" in seen else pattern + r"(?:\.[A-Za-z0-9]+)?")
