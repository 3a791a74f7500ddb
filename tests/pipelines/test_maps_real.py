"""`brmgeo maps` on real building outlines: one sheet in four formats, and a place on another continent."""

from __future__ import annotations

import os
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from small_maps import brmgeo, rasters_of

REAL = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))
NGII, SHEFFIELD = REAL / "ngii", REAL / "flight-sheffield"
CRS, SHEET = "EPSG:5187", "36914093"
AREA_M2 = 354_361.0  # from the data's own notes
PART = (228_300.0, 379_000.0, 228_800.0, 379_400.0)
ngii = pytest.mark.skipif(not NGII.is_dir(), reason=f"no real sheet in {NGII}")
Capture = pytest.CaptureFixture[str]


def masks(out: Path) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    with rasterio.open(out / "buildings.tif") as src:
        return src.read(1)


@ngii
@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_one_sheet_in_several_formats_is_one_mask(capsys: Capture, tmp_path: Path, whole: bool) -> None:
    place = ("--sheets", SHEET) if whole else ("--bounds", ",".join(map(str, PART)))
    found = {}
    names = ("N3A_B0010000.shp", f"{SHEET}_r12.dxf", f"{SHEET}_r2018.dxf", f"{SHEET}_buildings.gpkg")
    for name in names if whole else names[:2]:
        out = tmp_path / name.replace(".", "-")
        words = ("--footprints", NGII / name, "--crs", CRS, *place, "--out", out, "--radii", "30")
        said = brmgeo(capsys, "maps", *words)
        assert said.status == 0, said.err
        found[name] = masks(out)
        union = shapely.union_all(gpd.read_file(out / "footprints.gpkg", layer="footprints").geometry.values)
        assert union.area == pytest.approx(AREA_M2, rel=1e-3)
        within = union if whole else shapely.intersection(union, shapely.box(*PART))
        assert (found[name] == 1).sum() * 0.25 == pytest.approx(within.area, rel=1e-3 if whole else 5e-3)
    first, *others = found.values()
    assert set(np.unique(first).tolist()) == ({0, 1, 255} if whole else {0, 1})
    for other in others:
        np.testing.assert_array_equal(other, first)


@ngii
@pytest.mark.parametrize("crs", ["EPSG:5186", "EPSG:5174", "EPSG:5176", "EPSG:5183"])
def test_wrong_belt_or_datum_is_refused(capsys: Capture, tmp_path: Path, crs: str) -> None:
    sheet = NGII / f"{SHEET}_r12.dxf"
    said = brmgeo(capsys, "maps", "--footprints", sheet, "--crs", crs, "--out", tmp_path / "out")
    assert f"when read as {crs}" in said.error
    assert f'set crs = "{CRS}"' in said.error
    assert not list((tmp_path / "out").glob("*.tif"))


@ngii
def test_a_real_sheet_without_buildings(capsys: Capture, tmp_path: Path) -> None:
    sheet = NGII / "35812062_contours_only.dxf"
    said = brmgeo(capsys, "maps", "--footprints", sheet, "--crs", CRS, "--out", tmp_path / "out")
    assert said.status == 2
    assert "35812062" in said.error


@pytest.mark.skipif(not SHEFFIELD.is_dir(), reason=f"no real flight in {SHEFFIELD}")
def test_a_region_in_florida(capsys: Capture, tmp_path: Path) -> None:
    roofs = gpd.read_file(SHEFFIELD / "footprints.gpkg").to_crs("EPSG:32617").geometry
    centre = shapely.box(*roofs.total_bounds).centroid
    box = shapely.box(*(round(v) for v in shapely.buffer(centre, 60.0, cap_style="square").bounds))
    out = tmp_path / "sheffield"
    words = (
        "maps",
        "--footprints",
        SHEFFIELD / "footprints.gpkg",
        "--crs",
        "EPSG:32617",
        "--imagery",
        SHEFFIELD / "ortho.tif",
        "--gsd",
        "0.5",
        "--radii",
        "20,10",
        "--bounds",
        ",".join(map(str, box.bounds)),
        "--out",
        out,
    )
    said = brmgeo(capsys, *words)
    assert said.status == 0, said.err
    built_on = shapely.intersection(shapely.union_all(roofs.values), box).area
    assert built_on > 100
    assert (masks(out) == 1).sum() * 0.25 == pytest.approx(built_on, rel=0.02)
    with rasterio.open(out / "imagery.tif") as src, rasterio.open(SHEFFIELD / "ortho.tif") as ortho:
        x, y = (src.bounds.left + src.bounds.right) / 2, (src.bounds.bottom + src.bounds.top) / 2
        assert src.crs.to_epsg() == 32617
        here = np.array(list(src.sample([(x, y)])))[0, :3].astype(float)
        there = np.array(list(ortho.sample([(x, y)])))[0, :3].astype(float)
        assert np.abs(here - there).max() < 60
    before = rasters_of(out)
    assert "nothing to do" in brmgeo(capsys, *words).err
    assert rasters_of(out) == before
