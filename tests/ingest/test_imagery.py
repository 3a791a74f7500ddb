"""Imagery on the lattice, held against analytic pictures, GDAL's own warper and the whole-equals-blocks law."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from PIL import Image
from rasterio.control import GroundControlPoint
from rasterio.enums import ColorInterp
from rasterio.warp import Resampling, reproject

from brmgeo.errors import CrsError, InputError, MissingInputError
from brmgeo.geo.crs import parse_crs, transformer
from brmgeo.geo.grid import Window, blocks, bounds_of, lattice
from brmgeo.geo.sheets import sheet_extent
from brmgeo.geo.tilegrid import KakaoGrid, Tile, TileGrid, WebMercatorGrid
from brmgeo.ingest.imagery import (
    GeoRaster,
    NgiiOrtho,
    check_imagery,
    mosaic_to_lattice,
)
from brmgeo.ingest.tiles import TileFolder

EAST = "EPSG:5187"
BOX = lattice((175000.0, 563000.0, 175150.0, 563110.0), EAST, 0.5)
# Source and result are each rounded to whole grey levels; the cubic kernel's weights add up to 1.56 in magnitude.
ROUNDING = 0.5 + 0.5 * 1.57


def field(crs: str, box: GeoBox, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) smooth picture of the world: turned ramps and waves, another in each band, so that no flip, turn, shift or
    swap of bands can pass; defined in the lattice's CRS, seen from ``crs``."""
    if crs != str(box.crs):
        x, y = transformer(crs, str(box.crs)).transform(x, y)
    left, bottom, right, top = bounds_of(box)
    e, n = (x - left) / (right - left), (y - bottom) / (top - bottom)
    return np.stack(
        [
            40 + 120 * e + 50 * n,
            200 - 60 * e - 90 * n + 20 * np.sin(9 * e + 4 * n),
            128 + 60 * np.cos(7 * n - 5 * e) + 30 * e,
        ],
        axis=-1,
    )


def centres(affine: Affine, height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World positions of pixel centres."""
    c, r = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return affine.a * c + affine.b * r + affine.c, affine.d * c + affine.e * r + affine.f


def truth(box: GeoBox, window: Window | None = None) -> NDArray[np.float64]:
    rows, cols = box.shape
    picture = field(str(box.crs), box, *centres(box.affine, rows, cols))
    return picture if window is None else picture[window.slices]


def write_tiles(
    root: Path, grid: TileGrid, z: int, box: GeoBox, ext: str = "png", leave_out: set[Tile] = frozenset()
) -> TileFolder:
    """Render the picture as a folder of tiles, each pixel from its own world position."""
    for tile in grid.covering(bounds_of(box), str(box.crs), z, margin_px=4):
        if tile in leave_out:
            continue
        left, _, _, top = grid.tile_bounds(tile, z)
        g = grid.gsd_m(z)
        image = field(grid.crs, box, *centres(Affine(g, 0, left, 0, -g, top), 256, 256))
        path = root / grid.path(tile, z, ext)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.clip(np.round(image), 0, 255).astype(np.uint8)).save(path)
    return TileFolder(root, grid, z)


def write_tiff(
    path: Path, image: NDArray[np.generic], affine: Affine, crs: str | None, **extra: object
) -> Path:
    """(bands, h, w) as a GeoTIFF."""
    bands, height, width = image.shape
    profile = {"driver": "GTiff", "count": bands, "height": height, "width": width, "dtype": image.dtype}
    with rasterio.open(path, "w", **profile, crs=crs, transform=affine, **extra) as dst:
        dst.write(image)
    return path


@pytest.mark.parametrize(
    ("grid", "z"),
    [(KakaoGrid(), 2), (KakaoGrid(), 1), (KakaoGrid(), 3), (WebMercatorGrid(), 18), (WebMercatorGrid(), 20)],
    ids=lambda value: str(getattr(value, "name", value)),
)
def test_tiles_land_where_they_belong(tmp_path: Path, grid: TileGrid, z: int) -> None:
    """From 0.12 m to 1 m tiles, turned against the lattice: every pixel within rounding of the analytic picture."""
    rgb, valid = mosaic_to_lattice(write_tiles(tmp_path, grid, z, BOX), BOX)
    assert rgb.shape == (*BOX.shape, 3)
    assert rgb.dtype == np.uint8
    assert valid.all()
    error = np.abs(rgb.astype(float) - np.clip(truth(BOX), 0, 255))
    assert error.max() < ROUNDING, error.max()
    # The picture is steep enough to tell: half a pixel beside the truth the mean error doubles.
    beside = BOX.affine @ Affine.translation(0.5, 0.5)
    moved = field(EAST, BOX, *centres(beside, *BOX.shape))
    assert np.abs(rgb - moved).mean() > 1.3 * np.abs(rgb - truth(BOX)).mean()


def test_blocks_are_the_whole(tmp_path: Path) -> None:
    """Any cut gives the same bits, for tiles (cubic and averaged) and for a turned GeoTIFF, with unknown parts."""
    gone = set(KakaoGrid().covering((175040.0, 563040.0, 175060.0, 563050.0), EAST, 1))
    turned = Affine(0.35, 0.11, 174990.0, 0.09, -0.41, 563105.0)
    noise = np.random.default_rng(5).integers(0, 256, (3, 300, 320)).astype(np.uint8)
    sources = [
        [write_tiles(tmp_path / "k1", KakaoGrid(), 1, BOX, leave_out=gone)],
        [write_tiles(tmp_path / "k2", KakaoGrid(), 2, BOX)],
        [GeoRaster(write_tiff(tmp_path / "n.tif", noise, turned, EAST))],
    ]
    for source in sources:
        whole, known = mosaic_to_lattice(source, BOX)
        assert known.any()
        for size in (37, 64, 150):
            for window in blocks(BOX.shape, size):
                rgb, valid = mosaic_to_lattice(source, BOX, window)
                np.testing.assert_array_equal(rgb, whole[window.slices])
                np.testing.assert_array_equal(valid, known[window.slices])
    wide = Window(-40, -40, BOX.shape[0] + 80, BOX.shape[1] + 80)
    rgb, valid = mosaic_to_lattice(sources[2], BOX, wide)
    np.testing.assert_array_equal(rgb[40:-40, 40:-40], whole)


@pytest.mark.parametrize("source_gsd", [0.5, 0.8])
def test_cubic_agrees_with_gdal(tmp_path: Path, source_gsd: float) -> None:
    """Noise, where every detail of kernel and position shows: GDAL's exact cubic warp differs by rounding only."""
    rng = np.random.default_rng(7)
    noise = rng.integers(0, 256, (3, 420, 520)).astype(np.uint8)
    e, n = transformer(EAST, "EPSG:5181").transform(174980.0, 563150.0)
    affine = Affine(source_gsd, 0, e - 20, 0, -source_gsd, n + 10)
    path = write_tiff(tmp_path / "noise.tif", noise, affine, "EPSG:5181")
    rgb, valid = mosaic_to_lattice(GeoRaster(path), BOX)
    want = np.zeros((3, *BOX.shape), np.uint8)
    reproject(
        noise, want, src_transform=affine, src_crs="EPSG:5181", dst_transform=BOX.affine, dst_crs=EAST,
        resampling=Resampling.cubic, tolerance=0.0, XSCALE=1, YSCALE=1,
    )  # fmt: skip
    inner = np.zeros(BOX.shape, bool)
    inner[8:-8, 8:-8] = valid[8:-8, 8:-8]
    assert inner.mean() > 0.8
    difference = np.abs(np.moveaxis(rgb, -1, 0).astype(int) - want)[:, inner]
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01


def test_downsampling_is_the_mean_of_the_area(tmp_path: Path) -> None:
    """Aligned and 8 times finer: the exact mean of the 64 source pixels, where cubic would alias a checkerboard."""
    rng = np.random.default_rng(3)
    fine = rng.integers(0, 256, (3, 8 * 40, 8 * 50)).astype(np.uint8)
    box = lattice((1000.0, 2000.0, 1025.0, 2020.0), EAST, 0.5)
    path = write_tiff(tmp_path / "fine.tif", fine, Affine(0.0625, 0, 1000, 0, -0.0625, 2020), EAST)
    rgb, valid = mosaic_to_lattice(GeoRaster(path), box)
    want = np.floor(fine.reshape(3, 40, 8, 50, 8).mean(axis=(2, 4)) + 0.5)
    assert valid.all()
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0), want)


@settings(max_examples=15, deadline=None)
@given(st.integers(-40, 40), st.integers(-40, 40), st.integers(0, 1000))
def test_an_aligned_image_is_copied(dr: int, dc: int, seed: int) -> None:
    """On the lattice itself nothing is resampled: the pixels come through unchanged, shifted by whole pixels."""
    from tempfile import TemporaryDirectory

    image = np.random.default_rng(seed).integers(0, 256, (3, 60, 70)).astype(np.uint8)
    box = lattice((0.0, 0.0, 25.0, 20.0), EAST, 0.5)
    with TemporaryDirectory() as folder:
        affine = Affine(0.5, 0, dc * 0.5, 0, -0.5, 20.0 - dr * 0.5)
        rgb, valid = mosaic_to_lattice(GeoRaster(write_tiff(Path(folder, "a.tif"), image, affine, EAST)), box)
    want, known = np.zeros((40, 50, 3), np.uint8), np.zeros((40, 50), bool)
    r0, r1, c0, c1 = max(0, dr), min(40, dr + 60), max(0, dc), min(50, dc + 70)
    if r1 > r0 and c1 > c0:
        want[r0:r1, c0:c1] = np.moveaxis(image, 0, -1)[r0 - dr : r1 - dr, c0 - dc : c1 - dc]
        known[r0:r1, c0:c1] = True
    np.testing.assert_array_equal(rgb, want)
    np.testing.assert_array_equal(valid, known)


def test_missing_tiles_are_unknown_and_the_next_source_fills_them(tmp_path: Path) -> None:
    """A hole stays a hole of its own shape; a second source fills it and nothing else."""
    grid = KakaoGrid()
    x, y = transformer(EAST, grid.crs).transform(175075.0, 563055.0)
    (gone,) = grid.tiles_covering((x, y, x + 0.01, y + 0.01), 1)
    holed = write_tiles(tmp_path / "a", grid, 1, BOX, leave_out={gone})
    first, known = mosaic_to_lattice(holed, BOX)
    cx, cy = transformer(EAST, grid.crs).transform(*centres(BOX.affine, *BOX.shape))
    left, bottom, right, top = grid.tile_bounds(gone, 1)
    inside = (cx >= left) & (cx < right) & (cy > bottom) & (cy <= top)
    np.testing.assert_array_equal(~known, inside)
    assert (first[~known] == 0).all()
    assert np.abs(first[known] - truth(BOX)[known]).max() < ROUNDING

    red = np.zeros((3, 20, 20), np.uint8)
    red[0] = 250
    filler = GeoRaster(write_tiff(tmp_path / "red.tif", red, Affine(20, 0, 174900, 0, -20, 563300), EAST))
    both, all_known = mosaic_to_lattice([holed, filler], BOX)
    assert all_known.all()
    np.testing.assert_array_equal(both[known], first[known])
    assert (both[inside] == [250, 0, 0]).all()


def test_kinds_of_rasters(tmp_path: Path) -> None:
    """Grey, alpha, near infrared, palette, 16-bit and nodata; a south-up file; JPEG with world file."""
    affine = Affine(0.5, 0, 175000, 0, -0.5, 563110)
    want = np.moveaxis(np.clip(np.round(truth(BOX)), 0, 255).astype(np.uint8), -1, 0)

    grey, known = mosaic_to_lattice(GeoRaster(write_tiff(tmp_path / "g.tif", want[:1], affine, EAST)), BOX)
    assert known.all()
    for band in range(3):
        np.testing.assert_array_equal(grey[..., band], want[0])

    alpha = np.full((1, *BOX.shape), 255, np.uint8)
    alpha[:, :30, :50] = 0
    four = np.concatenate([want, alpha])
    path = write_tiff(tmp_path / "rgba.tif", four, affine, EAST, photometric="RGB", alpha="YES")
    rgb, known = mosaic_to_lattice(GeoRaster(path), BOX)
    np.testing.assert_array_equal(known, alpha[0] > 0)
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0)[:, known], want[:, known])

    nir = write_tiff(tmp_path / "nir.tif", np.concatenate([alpha, want]), affine, EAST)
    with rasterio.open(nir, "r+") as dst:
        dst.colorinterp = [ColorInterp.undefined, ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    rgb, known = mosaic_to_lattice(GeoRaster(nir), BOX)
    assert known.all()
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0), want)
    rgb, _ = mosaic_to_lattice(GeoRaster(nir, bands=(4, 3, 2)), BOX)
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0), want[::-1])

    deep = want.astype(np.uint16) * 8 + 100
    deep[:, 5, 7] = 60000
    path = write_tiff(tmp_path / "deep.tif", deep, affine, EAST, nodata=60000)
    with pytest.raises(InputError, match=r"uint16.*value_range"):
        mosaic_to_lattice(GeoRaster(path), BOX)
    rgb, known = mosaic_to_lattice(GeoRaster(path, value_range=(100, 100 + 255 * 8)), BOX)
    assert (~known).sum() == 1
    assert not known[5, 7]
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0)[:, known], want[:, known])

    south_up = Affine(0.5, 0, 175000, 0, 0.5, 563000)
    rgb, known = mosaic_to_lattice(
        GeoRaster(write_tiff(tmp_path / "s.tif", want[:, ::-1], south_up, EAST)), BOX
    )
    assert known.all()
    np.testing.assert_array_equal(np.moveaxis(rgb, -1, 0), want)

    with rasterio.open(
        tmp_path / "p.tif", "w", driver="GTiff", count=1, dtype="uint8", height=2, width=2, crs=EAST,
        transform=Affine(100, 0, 174990, 0, -100, 563150),
    ) as dst:  # fmt: skip
        dst.write(np.array([[[0, 1], [2, 3]]], np.uint8))
        dst.write_colormap(1, {0: (9, 8, 7, 255), 1: (1, 2, 3, 255), 2: (50, 60, 70, 255), 3: (5, 5, 5, 255)})
    rgb, known = mosaic_to_lattice(GeoRaster(tmp_path / "p.tif"), BOX)
    assert known.all()
    assert tuple(rgb[0, 0]) == pytest.approx((9, 8, 7), abs=3)

    Image.fromarray(np.moveaxis(want, 0, -1)).save(tmp_path / "photo.jpg", quality=98, subsampling=0)
    # A world file names the CENTRE of the first pixel.
    (tmp_path / "photo.jgw").write_text("0.5\n0\n0\n-0.5\n175000.25\n563109.75\n")
    with pytest.raises(CrsError, match=r"photo\.jpg.*state its crs"):
        mosaic_to_lattice(GeoRaster(tmp_path / "photo.jpg"), BOX)
    photo = GeoRaster(tmp_path / "photo.jpg", crs=EAST)
    rgb, known = mosaic_to_lattice(photo, BOX)
    assert known.all()
    assert np.abs(rgb - truth(BOX)).max() < 6
    # What the .prj says counts where nobody says otherwise.
    (tmp_path / "photo.PRJ").write_text(parse_crs(EAST).to_wkt("WKT1_ESRI"))
    np.testing.assert_array_equal(mosaic_to_lattice(GeoRaster(tmp_path / "photo.jpg"), BOX)[0], rgb)
    (tmp_path / "photo.PRJ").write_text("no crs")
    with pytest.raises(CrsError, match=r"photo\.PRJ cannot be read as a CRS") as raised:
        mosaic_to_lattice(GeoRaster(tmp_path / "photo.jpg"), BOX)
    assert raised.value.needs == "imagery_crs"
    np.testing.assert_array_equal(mosaic_to_lattice(photo, BOX)[0], rgb)


def test_a_crs_without_a_place_on_earth_is_as_good_as_none(tmp_path: Path) -> None:
    image = np.full((3, 220, 300), 90, np.uint8)
    local = 'LOCAL_CS["site grid",UNIT["metre",1]]'
    shape = {"width": 300, "height": 220, "count": 3, "dtype": "uint8", "crs": local, "transform": BOX.affine}
    with rasterio.open(tmp_path / "local.tif", "w", driver="GTiff", **shape) as out:
        out.write(image)
    with pytest.raises(CrsError, match=r"local\.tif states no .*on earth.*state its crs"):
        mosaic_to_lattice(GeoRaster(tmp_path / "local.tif"), BOX)
    assert mosaic_to_lattice(GeoRaster(tmp_path / "local.tif", crs=EAST), BOX)[1].all()


def test_an_image_placed_by_control_points_says_so(tmp_path: Path) -> None:
    points = [GroundControlPoint(r, c, 175000 + c / 2, 563110 - r / 2) for r in (0, 220) for c in (0, 300)]
    shape = {"width": 300, "height": 220, "count": 3, "dtype": "uint8"}
    with rasterio.open(tmp_path / "gcp.tif", "w", driver="GTiff", crs=EAST, gcps=points, **shape) as out:
        out.write(np.full((3, 220, 300), 90, np.uint8))
    with pytest.raises(InputError, match=r"placed by 4 control points \(GCPs\).*gdalwarp"):
        mosaic_to_lattice(GeoRaster(tmp_path / "gcp.tif"), BOX)


def test_ngii_ortho_by_its_sheet_number(tmp_path: Path) -> None:
    """No georeferencing: the sheet's rectangle in its belt places it; another shape is refused, stated bounds are taken."""
    left, bottom, right, top = sheet_extent("36914093", EAST)
    box = lattice((left + 500, bottom + 700, left + 620, bottom + 800), EAST, 1.0)
    gsd = 2.0
    width, height = round((right - left) / gsd), round((top - bottom) / gsd)
    affine = Affine((right - left) / width, 0, left, 0, -(top - bottom) / height, top)
    image = np.clip(np.round(field(EAST, box, *centres(affine, height, width))), 0, 255).astype(np.uint8)
    path = tmp_path / "정사영상_2023_36914093.tif"
    Image.fromarray(image).save(path)
    with pytest.raises(InputError, match=r"no georeferencing.*sheet number"):
        mosaic_to_lattice(GeoRaster(path, crs=EAST), box)
    rgb, valid = mosaic_to_lattice(NgiiOrtho(path), box)
    assert valid.all()
    assert np.abs(rgb - np.clip(truth(box), 0, 255)).max() < ROUNDING

    Image.fromarray(image[: height - 60]).save(tmp_path / "36914093b.tif")
    with pytest.raises(InputError, match=r"state the bounds"):
        mosaic_to_lattice(NgiiOrtho(tmp_path / "36914093b.tif"), box)
    stated = NgiiOrtho(tmp_path / "36914093b.tif", bounds=(left, top + affine.e * (height - 60), right, top))
    np.testing.assert_array_equal(mosaic_to_lattice(stated, box)[0], rgb)

    Image.fromarray(image).save(tmp_path / "photo.tif")
    with pytest.raises(InputError, match="sheet"):
        mosaic_to_lattice(NgiiOrtho(tmp_path / "photo.tif"), box)
    np.testing.assert_array_equal(
        mosaic_to_lattice(NgiiOrtho(tmp_path / "photo.tif", "36914093"), box)[0], rgb
    )


def test_refusals(tmp_path: Path) -> None:
    """Absent, damaged, unplaced, contradicting and far-off files say in one line what to do."""
    image = np.zeros((3, 600, 600), np.uint8)
    image[:] = np.random.default_rng(0).integers(0, 255, (600, 600))
    good = write_tiff(tmp_path / "good.tif", image, Affine(0.5, 0, 175000, 0, -0.5, 563200), EAST)
    with pytest.raises(MissingInputError, match=r"nothing\.tif"):
        mosaic_to_lattice(GeoRaster(tmp_path / "nothing.tif"), BOX)
    (tmp_path / "junk.tif").write_bytes(b"not an image at all")
    with pytest.raises(InputError, match=r"junk\.tif is not a readable image"):
        mosaic_to_lattice(GeoRaster(tmp_path / "junk.tif"), BOX)
    (tmp_path / "cut.tif").write_bytes(good.read_bytes()[:500_000])
    with pytest.raises(InputError, match=r"cut\.tif"):
        mosaic_to_lattice(GeoRaster(tmp_path / "cut.tif"), BOX)
    with pytest.raises(CrsError, match=r"EPSG:5187, but crs = EPSG:5181"):
        mosaic_to_lattice(GeoRaster(good, crs="EPSG:5181"), BOX)
    with pytest.raises(InputError, match="bands 1 to 3"):
        mosaic_to_lattice(GeoRaster(good, bands=(1, 2, 7)), BOX)
    two = write_tiff(tmp_path / "two.tif", image[:2], Affine(0.5, 0, 175000, 0, -0.5, 563200), EAST)
    with pytest.raises(InputError, match=r"two\.tif has two bands: state"):
        mosaic_to_lattice(GeoRaster(two), BOX)
    assert mosaic_to_lattice(GeoRaster(two, bands=(2,)), BOX)[1].any()
    check_imagery([GeoRaster(good)], BOX)
    far = lattice((175000.0, 563000.0, 175150.0, 563110.0), "EPSG:5186", 0.5)
    with pytest.raises(CrsError, match=r"good\.tif in EPSG:5187, is 17\d\.\d km away"):
        check_imagery([GeoRaster(good)], far)
    for error in (InputError, CrsError):
        with pytest.raises(error) as caught:
            mosaic_to_lattice(
                GeoRaster(tmp_path / "junk.tif") if error is InputError else GeoRaster(good, "EPSG:5181"), BOX
            )
        assert "\n" not in str(caught.value)


def test_retina_tiles(tmp_path: Path) -> None:
    """512 px tiles on the 256 px grid are drawn at half the pixel size once pixel_ratio says so, and refused before."""
    grid = KakaoGrid()
    for tile in grid.covering(bounds_of(BOX), EAST, 3, margin_px=4):
        left, _, _, top = grid.tile_bounds(tile, 3)
        image = field(grid.crs, BOX, *centres(Affine(0.5, 0, left, 0, -0.5, top), 512, 512))
        path = tmp_path / grid.path(tile, 3, "png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.clip(np.round(image), 0, 255).astype(np.uint8)).save(path)
    rgb, valid = mosaic_to_lattice(TileFolder(tmp_path, grid, 3, pixel_ratio=2), BOX)
    assert valid.all()
    assert np.abs(rgb - np.clip(truth(BOX), 0, 255)).max() < ROUNDING
    with pytest.raises(InputError, match=r"512 x 512 px, wanted 256 x 256: state pixel_ratio = 2"):
        mosaic_to_lattice(TileFolder(tmp_path, grid, 3), BOX)


def test_convergence_is_real() -> None:
    """The two grids are turned against each other here, so the tests above exercise more than a shift."""
    x, y = transformer(EAST, "EPSG:5181").transform([175000.0, 175100.0], [563000.0, 563000.0])
    assert abs(math.degrees(math.atan2(y[1] - y[0], x[1] - x[0]))) > 0.9


def test_real_tiles_of_two_levels_agree() -> None:
    """Drone imagery published at z20 and z21: drawn on one lattice in UTM they agree best without any shift."""
    home = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2].parent / "shared/data"))
    folder = home / "training-kampala/images"
    if not folder.is_dir():
        pytest.skip(f"no real tiles in {folder}")
    grid = WebMercatorGrid()
    fine, coarse = (TileFolder(folder, grid, z, "OAM-{x}-{y}-{z}.png") for z in (21, 20))
    centre = grid.tile_bounds((1238454, 1046531), 21)
    x, y = transformer("EPSG:3857", "EPSG:32636").transform(centre[0], centre[1])
    box = lattice((x - 40, y - 30, x + 40, y + 30), "EPSG:32636", 0.15)
    a, known_a = mosaic_to_lattice(fine, box)
    b, known_b = mosaic_to_lattice(coarse, box)
    # The publisher left single pixels transparent.
    assert known_a.mean() > 0.999
    assert known_b.mean() > 0.995
    grey_a, grey_b = a.mean(axis=-1), b.mean(axis=-1)
    error = {
        (dr, dc): np.abs(grey_a - np.roll(grey_b, (dr, dc), (0, 1)))[3:-3, 3:-3].mean()
        for dr in (-1, 0, 1)
        for dc in (-1, 0, 1)
    }
    assert min(error, key=error.__getitem__) == (0, 0)
    assert error[0, 0] < 0.7 * min(e for shift, e in error.items() if shift != (0, 0))
