"""A small region and flight, written with other tools than brmgeo's own writers, for the tests of brmgeo.export."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import rasterio
import rasterio.features
import shapely
from affine import Affine

from brmgeo.flight.values import Estimate

CRS = "EPSG:5187"
LEFT, TOP, GSD, ROWS, COLS = 352_000.0, 565_000.0, 0.5, 500, 700


@dataclass(frozen=True)
class Region:
    folder: Path
    footprints: Path
    buildings: Path
    ratio: Path
    imagery: Path
    polygons: list[shapely.Polygon]


def write_region(folder: Path) -> Region:
    """footprints.gpkg, buildings.tif, ratio.tif (two radii) and imagery.tif of 350 x 250 m, nothing symmetric."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    polygons = []
    for _ in range(40):
        x, y = LEFT + rng.uniform(20, 300), TOP - rng.uniform(20, 220)
        polygons.append(
            shapely.affinity.rotate(shapely.box(x, y, x + rng.uniform(6, 25), y + 9), rng.uniform(0, 90))
        )
    layers = [f"B001411{d}" for d in "12356781"] * 5
    frame = gpd.GeoDataFrame({"layer": layers}, geometry=polygons, crs=CRS)
    frame.to_file(folder / "footprints.gpkg", layer="footprints")
    sheet = shapely.box(LEFT + 5, TOP - 245, LEFT + 345, TOP - 5)
    gpd.GeoDataFrame({"sheet": ["37807039"]}, geometry=[sheet], crs=CRS).to_file(
        folder / "footprints.gpkg", layer="sheets"
    )

    affine = Affine(GSD, 0, LEFT, 0, -GSD, TOP)
    known = rasterio.features.rasterize([sheet], (ROWS, COLS), transform=affine).astype(bool)
    built = rasterio.features.rasterize(polygons, (ROWS, COLS), transform=affine, dtype="uint8")
    mask = np.where(known, built, 255).astype(np.uint8)
    profile = {"driver": "GTiff", "height": ROWS, "width": COLS, "transform": affine, "crs": CRS}
    with rasterio.open(folder / "buildings.tif", "w", dtype="uint8", count=1, nodata=255, **profile) as dst:
        dst.write(mask, 1)
    with rasterio.open(folder / "ratio.tif", "w", dtype="uint16", count=2, nodata=65535, **profile) as dst:
        for band, radius in enumerate((59.1, 19.7), start=1):
            share = np.clip(np.hypot(*np.mgrid[-250:250, -350:350]) / 450, 0, 1) / band
            dst.write(np.where(known, share * 1e4, 65535).astype(np.uint16), band)
            dst.update_tags(band, radius_m=f"{radius:g}")
        dst.scales = (1e-4, 1e-4)
    with rasterio.open(
        folder / "imagery.tif", "w", dtype="uint8", count=3, photometric="RGB", **profile
    ) as dst:
        dst.write(rng.integers(40, 160, (3, ROWS, COLS), dtype=np.uint8))
    names = ("footprints.gpkg", "buildings.tif", "ratio.tif", "imagery.tif")
    return Region(folder, *(folder / name for name in names), polygons)


def estimate(
    t_s: float, x: float, y: float, status: str, *, yaw: float = 0.3, sigma: float = 4.0, n: int = 5
) -> Estimate:
    """An estimate with ``n`` candidates in a row to the east of (x, y)."""
    cells = np.column_stack([x + 2.0 * np.arange(n), np.full(n, y)])
    mass = np.arange(1, n + 1) / max(n * (n + 1) / 2, 1)
    return Estimate(
        t_s=t_s,
        status=status,  # type: ignore[arg-type]
        mean=np.array([x, y]),
        covariance=np.eye(2) * sigma**2,
        yaw_rad=yaw,
        yaw_sigma_rad=0.1,
        mass=0.9,
        candidates=cells,
        candidate_mass=mass,
        candidate_count=n,
    )


def flight(count: int = 12) -> list[Estimate]:
    """North-east through the region; frames 0-3 are ambiguous, 6 is lost, the others have converged."""
    out = []
    for i in range(count):
        status = "ambiguous" if i < 4 else "lost" if i == 6 else "converged"
        yaw = math.nan if i == 0 else 0.7
        out.append(estimate(5.0 * i, LEFT + 60 + 15 * i, TOP - 200 + 12 * i, status, yaw=yaw, n=60 - 4 * i))
    return out
