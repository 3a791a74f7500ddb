"""Rasters as the network sees them: bands, palettes, ground metres, and what would mend a fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from small_networks import bright_onnx, small_card

from brmgeo.codes import BUILDING, OTHER, UNKNOWN
from brmgeo.errors import BrmgeoError
from brmgeo.segment.predict import Segmenter
from brmgeo.segment.raster import codes_of, open_raster

PLACE = Affine(0.5, 0, 195_000, 0, -0.5, 446_000)


@pytest.fixture(scope="module")
def segmenter(tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    card = small_card(gsd_min_m=0.1, gsd_max_m=1.0, gsd_work_m=None)
    return Segmenter.load(bright_onnx(tmp_path_factory.mktemp("net") / "bright.onnx", card))


def write(path: Path, bands: np.ndarray, **changes: object) -> Path:
    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "crs": "EPSG:5187", "transform": PLACE,
    }  # fmt: skip
    with rasterio.open(path, "w", **{**profile, **changes}) as dst:
        dst.write(bands)
    return path


def noise(count: int, rows: int = 90, cols: int = 70) -> np.ndarray:
    return np.random.default_rng(2).integers(0, 255, (count, rows, cols), dtype=np.uint8)


def test_blocks_are_what_the_network_says_of_the_picture(tmp_path: Path, segmenter: Segmenter) -> None:
    bands = noise(3)
    told: list[tuple[int, int]] = []
    with open_raster(write(tmp_path / "a.tif", bands), segmenter) as reader:
        assert reader.box.shape == (90, 70)
        assert reader.gsd_m == pytest.approx(0.5, rel=0.01)
        (window, said), = reader.blocks("probability", lambda *at: told.append(at))  # fmt: skip
        (_, codes), = reader.blocks("mask")  # fmt: skip
    assert (window.row, window.col, window.height, window.width) == (0, 0, 90, 70)
    wanted = segmenter.probability(np.moveaxis(bands, 0, -1))
    assert (said[0] == wanted).all()
    assert (codes == np.where(wanted > segmenter.card.threshold, BUILDING, OTHER)).all()
    assert told == [(1, 1)]


def test_what_nobody_knows_has_a_code_of_its_own() -> None:
    p = np.array([[0.2, 0.8, np.nan]], np.float32)
    assert codes_of(p, 0.5).tolist() == [[OTHER, BUILDING, UNKNOWN]]


@pytest.mark.parametrize(
    ("bands", "changes", "options", "needs"),
    [
        (noise(3).astype(np.uint16), {}, {}, "levels"),
        (noise(2), {}, {}, "bands"),
        (noise(3), {}, {"bands": (1, 2, 9)}, "bands"),
        (noise(3, 10, 10), {}, {}, None),
        (noise(3), {"crs": None}, {}, None),
    ],
)
def test_a_fault_says_which_parameter_mends_it(
    tmp_path: Path, segmenter: Segmenter, bands: np.ndarray, changes: dict, options: dict, needs: str | None
) -> None:
    path = write(tmp_path / "a.tif", bands, **changes)
    with pytest.raises(BrmgeoError, match=r"a\.tif") as caught, open_raster(path, segmenter, **options):
        pass
    assert caught.value.needs == needs
    assert "--" not in str(caught.value)


def test_a_raster_of_a_million_rows_and_columns_is_refused_before_work_begins(
    tmp_path: Path, segmenter: Segmenter
) -> None:
    # Sparse: no block is stored, so the file is small.
    profile = {
        "driver": "GTiff",
        "count": 3,
        "height": 10**6,
        "width": 10**6,
        "dtype": "uint8",
        "tiled": True,
    }
    with rasterio.open(
        tmp_path / "a.tif", "w", crs="EPSG:5187", transform=PLACE, blockxsize=4096, blockysize=4096, bigtiff="yes",
        sparse_ok=True, **profile,
    ):  # fmt: skip
        pass
    with (
        pytest.raises(BrmgeoError, match=r"1000000 x 1000000 px at 0\.5 m, days of work"),
        open_raster(tmp_path / "a.tif", segmenter),
    ):
        pass
