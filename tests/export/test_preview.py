from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from matplotlib.colors import to_rgb
from PIL import Image
from small_region import GSD, LEFT, TOP, Region, write_region

from brmgeo.errors import InputError
from brmgeo.export import preview
from brmgeo.export.preview import write_preview


@pytest.fixture(scope="module")
def region(tmp_path_factory: pytest.TempPathFactory) -> Region:
    return write_region(tmp_path_factory.mktemp("region"))


def draw(region: Region, path: Path, **changes: object) -> np.ndarray:
    arguments = {
        "buildings": region.buildings,
        "ratio": region.ratio,
        "title": "Demo 대관령",
        "attribution": "국토지리정보원",
    }
    write_preview(path, **(arguments | changes))  # type: ignore[arg-type]
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.fixture(scope="module")
def plain(region: Region, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return draw(region, tmp_path_factory.mktemp("plain") / "p.png")


def near(picture: np.ndarray, colour: str) -> np.ndarray:
    return np.abs(picture.astype(int) - np.array([round(255 * c) for c in to_rgb(colour)])).max(axis=-1) <= 3


def test_width_is_1600_and_buildings_cover_their_share(region: Region, plain: np.ndarray) -> None:
    assert plain.shape[1] == preview.WIDTH_PX
    with rasterio.open(region.buildings) as src:
        share = (src.read(1) == 1).mean()
    # The left panel, by its place in the figure, without the marks that lie over it.
    left = plain[:, round(preview.LEFT * 1600) : round((preview.LEFT + preview.PANEL_W) * 1600)]
    panel = near(left, preview.ROOF).sum() / (704 * 704 * 250 / 350)
    assert 0.75 * share < panel < 1.2 * share


def test_imagery_is_shown_where_it_is_given_and_the_same_maps_give_the_same_bytes(
    region: Region, plain: np.ndarray, tmp_path: Path
) -> None:
    with_imagery = draw(region, tmp_path / "a.png", imagery=region.imagery)
    half = 800
    assert (plain[:, :half] != with_imagery[:, :half]).any(axis=-1).mean() > 0.3
    np.testing.assert_array_equal(plain[:, half:], with_imagery[:, half:])
    draw(region, tmp_path / "b.png", imagery=region.imagery)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_each_band_can_be_shown_and_one_that_is_not_there_is_refused(
    region: Region, plain: np.ndarray, tmp_path: Path
) -> None:
    second = draw(region, tmp_path / "b.png", band=2)
    assert (plain[:, 800:] != second[:, 800:]).any(axis=-1).mean() > 0.2
    with pytest.raises(InputError, match="band 3"):
        draw(region, tmp_path / "c.png", band=3)
    assert not (tmp_path / "c.png").exists()


def test_long_strips_keep_a_readable_height(tmp_path: Path) -> None:
    for rows, cols in ((40, 2000), (2000, 40)):
        profile = {"driver": "GTiff", "height": rows, "width": cols, "crs": "EPSG:5187", "count": 1}
        profile["transform"] = Affine(GSD, 0, LEFT, 0, -GSD, TOP)
        mask, ratio = tmp_path / f"m{rows}.tif", tmp_path / f"r{rows}.tif"
        with rasterio.open(mask, "w", dtype="uint8", **profile) as dst:
            dst.write(np.ones((1, rows, cols), np.uint8))
        with rasterio.open(ratio, "w", dtype="uint16", **profile) as dst:
            dst.write(np.zeros((1, rows, cols), np.uint16))
        write_preview(tmp_path / "p.png", buildings=mask, ratio=ratio, title="strip")
        with Image.open(tmp_path / "p.png") as image:
            assert image.width == preview.WIDTH_PX
            assert 400 < image.height < 1500


def test_an_unreadable_raster_is_named(region: Region, tmp_path: Path) -> None:
    (tmp_path / "junk.tif").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.tif"):
        draw(region, tmp_path / "p.png", ratio=tmp_path / "junk.tif")
