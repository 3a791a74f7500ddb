"""What `brmgeo maps` leaves in its output folder, held against oracles that share no code with it."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer
from rio_cogeo.cogeo import cog_validate
from small_maps import BOUNDS, CRS, GSD_M, RADII_M, SHEETS, SmallRegion, facts_of, painted

from brmgeo.geo.sheets import sheet_polygon

COLS, ROWS = round((BOUNDS[2] - BOUNDS[0]) / GSD_M), round((BOUNDS[3] - BOUNDS[1]) / GSD_M)


def pixel_centres(margin_px: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = BOUNDS[0] + (np.arange(-margin_px, COLS + margin_px) + 0.5) * GSD_M
    y = BOUNDS[3] - (np.arange(-margin_px, ROWS + margin_px) + 0.5) * GSD_M
    return tuple(np.meshgrid(x, y))  # type: ignore[return-value]


def mask_by_points(built: SmallRegion, margin_px: int = 0) -> NDArray[np.uint8]:
    """0, 1, 255 by asking shapely of every pixel centre."""
    polygons = gpd.read_file(built.out / "footprints.gpkg", layer="footprints").geometry.values
    buildings = shapely.union_all(polygons)
    known = shapely.union_all([sheet_polygon(s, CRS) for s in SHEETS])
    shapely.prepare(buildings)
    shapely.prepare(known)
    x, y = pixel_centres(margin_px)
    return np.where(shapely.contains_xy(known, x, y), shapely.contains_xy(buildings, x, y), 255).astype(
        np.uint8
    )


def read(path: Path) -> NDArray[np.uint16]:
    with rasterio.open(path) as src:
        return src.read()


@pytest.mark.parametrize("name", ["imagery.tif", "buildings.tif", "ratio.tif"])
def test_rasters_are_cogs_on_the_lattice_with_tags(built: SmallRegion, name: str) -> None:
    valid, errors, _ = cog_validate(built.out / name, strict=False)
    assert valid, errors
    text = json.loads((built.out / "maps.json").read_text(encoding="utf-8"))
    with rasterio.open(built.out / name) as src:
        assert src.crs.to_epsg() == 5187
        assert src.shape == (ROWS, COLS)
        assert src.transform.almost_equals(
            rasterio.Affine(GSD_M, 0, BOUNDS[0], 0, -GSD_M, BOUNDS[3]), precision=1e-12
        )
        tags = src.tags()
        assert text["stages"][name.removesuffix(".tif")]["key"] in tags.values()
        credit = "Painted tiles" if name == "imagery.tif" else "Generated footprints"
        assert any(credit in value for value in tags.values())
        if name == "imagery.tif":
            assert any("free for all" in value for value in tags.values())
        if name == "ratio.tif":
            assert src.dtypes == ("uint16",) * len(RADII_M)
            assert src.nodata == 65535
            assert src.scales == (1e-4,) * len(RADII_M)
            assert [float(src.tags(k)["radius_m"]) for k in src.indexes] == list(RADII_M)
            assert all(src.descriptions)
        if name == "buildings.tif":
            assert src.dtypes == ("uint8",)
            assert src.nodata == 255


def test_everything_else_is_there_and_opens(built: SmallRegion) -> None:
    assert {p.name for p in built.out.iterdir() if not p.name.startswith(".")} == {
        "footprints.gpkg",
        "imagery.tif",
        "buildings.tif",
        "ratio.tif",
        "maps.json",
        "preview.png",
        "small.qgz",
    }
    with zipfile.ZipFile(built.out / "small.qgz") as project:
        assert any(name.endswith(".qgs") for name in project.namelist())
    with Image.open(built.out / "preview.png") as picture:
        assert min(picture.size) > 300
        assert np.asarray(picture.convert("L")).std() > 10
    layers = {str(name) for name in gpd.list_layers(built.out / "footprints.gpkg")["name"]}
    assert {"footprints", "sheets", "repairs"} <= layers


def test_facts_of_the_region(built: SmallRegion) -> None:
    facts = facts_of(built)
    frame = gpd.read_file(built.out / "footprints.gpkg", layer="footprints")
    union = shapely.union_all(frame.geometry.values).area
    assert facts["footprints"]["area_m2"] == pytest.approx(union, abs=0.01)
    assert facts["footprints"]["counts"]["footprints"] == len(frame)  # type: ignore[index]
    assert facts["lattice"]["rows"] == ROWS
    mask = read(built.out / "buildings.tif")[0]
    assert facts["buildings"]["building_area_m2"] == (mask == 1).sum() * GSD_M**2
    assert facts["buildings"]["known_area_m2"] == (mask != 255).sum() * GSD_M**2
    assert facts["imagery"]["known_share"] == 1.0
    for sheet in SHEETS:
        own = facts[f"outlines {sheet}"]
        for kind in ("duplicate", "spike"):
            assert own["repairs"][kind] > 0  # type: ignore[index]
            assert own["examples"][kind][0]["handle"]  # type: ignore[index]


def test_footprints_are_the_towns_buildings(built: SmallRegion) -> None:
    frame = gpd.read_file(built.out / "footprints.gpkg", layer="footprints")
    found = shapely.union_all(frame.geometry.values)
    assert found.area == pytest.approx(built.truth.area, rel=1e-3)
    assert found.symmetric_difference(built.truth).area < 1e-3 * built.truth.area
    assert facts_of(built)["footprints"]["counts"]["merged_at_edges"] > 0  # type: ignore[index]
    assert len(frame) < built.outlines


def test_buildings_equal_an_independent_rasterisation(built: SmallRegion) -> None:
    mask, expected = read(built.out / "buildings.tif")[0], mask_by_points(built)
    different = np.argwhere(mask != expected)
    x, y = pixel_centres()
    outlines = shapely.boundary(shapely.union_all([built.truth, *(sheet_polygon(s, CRS) for s in SHEETS)]))
    points = shapely.points(x[tuple(different.T)], y[tuple(different.T)])
    near = shapely.union_all([outlines, built.truth.boundary])
    # Only a centre on an outline, to the quarter millimetre of the raster's own steps, may go either way.
    assert (shapely.distance(points, near) < 1e-3).all()
    assert len(different) < 5
    assert {0, 1, 255} == set(np.unique(mask).tolist())


def test_ratios_equal_brute_force_at_a_thousand_cells(built: SmallRegion) -> None:
    reach = 90
    wide = mask_by_points(built, reach)
    wide[reach : reach + ROWS, reach : reach + COLS] = read(built.out / "buildings.tif")[0]
    maps = read(built.out / "ratio.tif")
    rng = np.random.default_rng(5)
    cells = zip(rng.integers(0, ROWS, 1000).tolist(), rng.integers(0, COLS, 1000).tolist())
    step = np.arange(-reach, reach + 1)
    squared = step[:, None] ** 2 + step[None, :] ** 2
    discs = [squared <= (radius / GSD_M) ** 2 for radius in RADII_M]
    for row, col in cells:
        around = wide[row : row + 2 * reach + 1, col : col + 2 * reach + 1]
        for band, disc in enumerate(discs):
            inside = around[disc]
            known, built_up = int((inside != 255).sum()), int((inside == 1).sum())
            found = int(maps[band, row, col])
            if known == 0:
                assert found == 65535
            else:
                assert abs(found - 1e4 * built_up / known) <= 0.5 + 1e-6


def test_imagery_shows_what_was_painted(built: SmallRegion) -> None:
    image = np.moveaxis(read(built.out / "imagery.tif")[:3], 0, -1)
    x, y = pixel_centres()
    to_tiles = Transformer.from_crs(CRS, "EPSG:5181", always_xy=True)
    expected = painted(*to_tiles.transform(x, y))
    difference = np.abs(image - expected)
    assert np.median(difference) < 2.5  # JPEG
    assert np.percentile(difference, 99.9) < 10
