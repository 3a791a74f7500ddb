"""Rasters read back: pixels where they lie, windows over the edge, and what is no raster of a region."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError
from brmgeo.export.cog import write_cog
from brmgeo.geo.grid import Window, bounds_of, gsd_of, lattice
from brmgeo.geo.raster import box_of, radii_of, read_overview, read_raster, read_window

BOX = lattice((164000.0, 563000.0, 164700.0, 563600.5), "EPSG:5187", 0.5)
ROWS, COLS = BOX.shape
RADII = (59.1, 19.7 + 1e-13)
# A transverse Mercator that no code names.
LOCAL = "+proj=tmerc +lat_0=37.1 +lon_0=128.3 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80 +units=m"


@pytest.fixture(scope="module")
def ratio() -> NDArray[np.uint16]:
    """Smooth ratios with unknown parts, nothing symmetric."""
    r, c = np.mgrid[0:ROWS, 0:COLS]
    out = np.stack([(r * 3 + c * 2) % 10001, (r * r // 7 + c) % 5000]).astype(np.uint16)
    out[:, :200, :90] = 65535
    return out


@pytest.mark.parametrize("crs", ["EPSG:5187", LOCAL])
def test_a_raster_lies_where_its_lattice_is(tmp_path: Path, crs: str) -> None:
    """Pixels and place as the lattice has them, to the last bit, also at a GSD that binary fractions cannot hold."""
    box = lattice((-30.3, 562999.9, 41.1, 563060.0), crs, 0.3)
    mask = (np.arange(box.shape[0] * box.shape[1]).reshape(box.shape) % 3 == 0).astype(np.uint8)
    write_cog(tmp_path / "m.tif", mask, box, kind="mask")
    got = read_raster(tmp_path / "m.tif")
    np.testing.assert_array_equal(got.pixels, mask[None])
    left, _, _, top = bounds_of(box)
    assert (got.left, got.top, got.gsd_m) == (left, top, gsd_of(box))
    assert got.bounds == pytest.approx(bounds_of(box), abs=1e-9)
    kept = box_of(tmp_path / "m.tif")
    assert got.crs == str(kept.crs)
    assert kept.crs == box.crs
    assert (kept.shape, kept.affine) == (box.shape, box.affine)
    small, bounds = read_overview(tmp_path / "m.tif", 50)
    assert max(small.shape) == 50
    assert bounds == pytest.approx(bounds_of(box), abs=1e-9)


def test_reading_takes_no_heavy_library_with_it(tmp_path: Path) -> None:
    """A map is read aboard: rasterio and numpy alone, without what makes maps."""
    write_cog(tmp_path / "m.tif", np.ones((ROWS, COLS), bool), BOX, kind="mask")
    program = """
import sys
from pathlib import Path
import brmgeo.geo.crs
from brmgeo.geo.raster import read_overview, read_raster, read_window
path = Path(sys.argv[1])
read_window(path), read_overview(path, 100)
print(read_raster(path).crs)
for heavy in ("odc", "xarray", "pandas", "geopandas", "dask", "matplotlib", "ezdxf", "scipy", "shapely", "cv2"):
    assert heavy not in sys.modules, heavy
"""
    run = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "m.tif"], capture_output=True, text=True, check=False
    )
    assert (run.stdout, run.stderr) == ("EPSG:5187\n", "")


@settings(max_examples=25, deadline=None)
@given(st.integers(-30, ROWS + 30), st.integers(-30, COLS + 30), st.integers(1, 80), st.integers(1, 80))
def test_windows_outside_are_unknown(
    tmp_path_factory: pytest.TempPathFactory, row: int, col: int, height: int, width: int
) -> None:
    """A window is the crop of the raster padded with its nodata."""
    r, c = np.mgrid[0:ROWS, 0:COLS]
    whole = ((r * 3 + c * 2) % 10001).astype(np.uint16)
    path = tmp_path_factory.getbasetemp() / "windows.tif"
    if not path.exists():
        write_cog(path, whole[None], BOX, kind="ratio", radii_m=[1.0])
    padded = np.pad(whole, 120, constant_values=65535)
    want = padded[row + 120 : row + 120 + height, col + 120 : col + 120 + width]
    np.testing.assert_array_equal(read_window(path, Window(row, col, height, width), [1])[0], want)


def test_reading_refuses(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    """Absent, junk, truncated and foreign rasters are told apart."""
    with pytest.raises(MissingInputError, match=r"no\.tif"):
        read_window(tmp_path / "no.tif")
    (tmp_path / "junk.tif").write_bytes(b"junk")
    with pytest.raises(InputError, match="not a readable image or raster"):
        box_of(tmp_path / "junk.tif")
    path = tmp_path / "r.tif"
    write_cog(path, ratio, BOX, kind="ratio", radii_m=RADII)
    (tmp_path / "cut.tif").write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cut\.tif"):
        read_window(tmp_path / "cut.tif")
    with pytest.raises(InputError, match="bands"):
        read_window(path, bands=[7])
    write_cog(tmp_path / "m.tif", np.zeros((ROWS, COLS), np.uint8), BOX, kind="mask")
    with pytest.raises(InputError, match="no ratio raster"):
        radii_of(tmp_path / "m.tif")


@pytest.mark.parametrize(
    ("place", "crs", "told"),
    [
        (Affine(0.5, 0, 10, 0, -0.5, 20), None, "no coordinate reference system"),
        (Affine(0.5, 0, 10, 0, -0.4, 20), "EPSG:5187", "no squares with north up"),
        (Affine(0.5, 0.1, 10, 0, -0.5, 20), "EPSG:5187", "no squares with north up"),
        (Affine(0.5, 0, 10, 0, 0.5, 20), "EPSG:5187", "no squares with north up"),
    ],
)
def test_what_no_map_is_laid_out_like_is_refused(
    tmp_path: Path, place: Affine, crs: str | None, told: str
) -> None:
    path = tmp_path / "other.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=4, width=5, count=1, dtype="uint8", crs=crs, transform=place
    ) as out:
        out.write(np.zeros((1, 4, 5), np.uint8))
    with pytest.raises(InputError, match=told):
        read_raster(path)
