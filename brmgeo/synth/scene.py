"""The values of a generated region: what stands where. No file format, no picture, no randomness in here.

Coordinates are metres in ``Town.crs`` (x easting, y northing). Polygons are on a millimetre grid, as NGII's sheets are.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon

from brmgeo.codes import BUILDING_LAYERS
from brmgeo.geo.grid import Bounds

Season = Literal["spring", "summer", "autumn", "winter"]
Roof = Literal["flat", "hip", "gable", "shed", "metal", "apartment", "vinyl", "canopy", "box"]
RoadKind = Literal["arterial", "main", "street", "lane", "track"]
Colour = tuple[int, int, int]

# Names of NGII's layers of building outlines, in the order of their codes.
OTHER, HOUSE, ROW_HOUSE, UNDER_CONSTRUCTION, APARTMENT, CANOPY, GREENHOUSE, TEMPORARY = BUILDING_LAYERS


@dataclass(frozen=True, slots=True)
class TownStyle:
    """What makes one generated region look unlike another; every number is free within the range given.

    Attributes:
        density: factor on the number of buildings, 0 (an empty countryside) to about 1.3.
        forest_share: share of the ground under forest, 0 to 0.6.
        villages: number of villages per 6 km2 besides the town.
        apartments: number of apartment complexes.
        greenhouse_share, orchard_share: share of field parcels under vinyl houses and orchards.
        road_scale: factor on road widths.
        season: palette of fields and trees.
        roof_mix: weights of blue, red, green, grey, brown, orange and white metal or tile roofs.
        sun_azimuth_deg: where the light comes from, clockwise from north; sun_elevation_deg above the horizon.
        brightness, contrast: factors on the finished picture about its middle grey.
        warmth: -1 (bluish) to 1 (yellowish).
        haze: 0 to 0.4, share of white veil.
        blur_m: standard deviation of the sensor's point spread, metres.
        noise: standard deviation of sensor noise, grey levels.
    """

    density: float = 1.0
    forest_share: float = 0.24
    villages: float = 9.0
    apartments: int = 3
    greenhouse_share: float = 0.06
    orchard_share: float = 0.05
    road_scale: float = 1.0
    season: Season = "summer"
    roof_mix: tuple[float, ...] = (0.26, 0.15, 0.14, 0.2, 0.1, 0.08, 0.07)
    sun_azimuth_deg: float = 152.0
    sun_elevation_deg: float = 51.0
    brightness: float = 1.0
    contrast: float = 1.0
    warmth: float = 0.1
    haze: float = 0.05
    blur_m: float = 0.16
    noise: float = 2.0

    @staticmethod
    def varied(seed: int) -> TownStyle:
        """A style drawn from ``seed``: other roofs, season, light, density and camera for each one."""
        rng = np.random.default_rng([seed, 0x57])
        season: Season = ("spring", "summer", "autumn", "winter")[
            int(rng.choice(4, p=[0.25, 0.35, 0.25, 0.15]))
        ]
        return TownStyle(
            density=float(rng.uniform(0.6, 1.25)),
            forest_share=float(rng.uniform(0.05, 0.45)),
            villages=float(rng.uniform(3, 12)),
            apartments=int(rng.integers(1, 6)),
            greenhouse_share=float(rng.uniform(0.01, 0.18)),
            orchard_share=float(rng.uniform(0.0, 0.15)),
            road_scale=float(rng.uniform(0.85, 1.3)),
            season=season,
            roof_mix=tuple(float(w) for w in rng.dirichlet(np.full(7, 1.5))),
            sun_azimuth_deg=float(rng.uniform(105, 255)),
            sun_elevation_deg=float(rng.uniform(33, 70)),
            brightness=float(rng.uniform(0.85, 1.15)),
            contrast=float(rng.uniform(0.85, 1.2)),
            warmth=float(rng.uniform(-0.6, 0.7)),
            haze=float(rng.uniform(0.0, 0.18)),
            blur_m=float(rng.uniform(0.08, 0.35)),
            noise=float(rng.uniform(0.8, 4.0)),
        )

    def with_season(self, season: Season) -> TownStyle:
        """The same style at another time of the year."""
        return replace(self, season=season)


@dataclass(frozen=True, slots=True)
class Building:
    """One outline: polygon (holes are courtyards), NGII layer code, floors, height in metres, roof and its colour."""

    polygon: Polygon
    layer: str
    floors: int
    height_m: float
    roof: Roof
    colour: Colour
    name: str = ""


@dataclass(frozen=True, slots=True)
class Road:
    """A centre line with its width in metres."""

    line: LineString
    width_m: float
    kind: RoadKind


@dataclass(frozen=True, slots=True)
class Area:
    """A piece of ground: field, yard, water and so on. ``angle_rad`` is the direction of its rows where it has any."""

    polygon: Polygon
    kind: str
    angle_rad: float = 0.0
    shade: float = 0.0


@dataclass(frozen=True, slots=True)
class Town:
    """A generated region.

    Attributes:
        bounds: (left, bottom, right, top) that was asked for. Everything goes on for ``margin_m`` beyond it.
        crs: the projected CRS of all coordinates.
        seed, style: what it was made from.
        buildings: outlines that do not overlap (canopies touch their houses); the order has no meaning.
        roads: centre lines, wide ones first.
        water, banks: the river and its flood plain.
        fields: parcels, ``kind`` is the crop.
        grounds: yards, playgrounds, car parks, in the order of painting.
        woods: forest polygons.
        trees: (n, 3) float64 x, y and crown radius in metres of single trees.
        cars: (n, 3) float64 x, y and direction in radians.
        contours: (line, height in metres) every five metres.
        walls: walls around yards.
        groups: boundaries of groups of houses (not buildings).
        names: (x, y, Korean text).
    """

    bounds: Bounds
    crs: str
    seed: int
    style: TownStyle
    margin_m: float
    buildings: tuple[Building, ...]
    roads: tuple[Road, ...]
    water: tuple[Polygon, ...]
    banks: tuple[Polygon, ...]
    fields: tuple[Area, ...]
    grounds: tuple[Area, ...]
    woods: tuple[Polygon, ...]
    trees: NDArray[np.float64]
    cars: NDArray[np.float64]
    contours: tuple[tuple[LineString, float], ...]
    walls: tuple[LineString, ...]
    groups: tuple[Polygon, ...] = ()
    names: tuple[tuple[float, float, str], ...] = field(default=())

    def footprints(self) -> gpd.GeoDataFrame:
        """Buildings as a table with columns layer, floors, height_m, roof, name, geometry in ``crs``."""
        rows = {
            "layer": [b.layer for b in self.buildings],
            "floors": [b.floors for b in self.buildings],
            "height_m": [b.height_m for b in self.buildings],
            "roof": [b.roof for b in self.buildings],
            "name": [b.name for b in self.buildings],
        }
        return gpd.GeoDataFrame(rows, geometry=[b.polygon for b in self.buildings], crs=self.crs)

    def built_area_m2(self) -> float:
        """Exact area under buildings within ``bounds``, square metres."""
        union = shapely.union_all(np.array([b.polygon for b in self.buildings], dtype=object))
        return float(shapely.area(shapely.intersection(union, shapely.box(*self.bounds))))
