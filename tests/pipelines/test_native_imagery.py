"""Frames are drawn from a region's imagery as its tiles have it, where its maps are coarser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from small_maps import BOUNDS, CRS, brmgeo, make_source, painted

from brmgeo.region import load_region
from pipelines.maps import native_imagery


def test_imagery_around_a_place_is_as_fine_as_its_tiles(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = make_source(tmp_path)
    assert brmgeo(capsys, "maps", "small", "--data", tmp_path, "--scheduler", "serial").status == 0
    region = load_region(small.toml)
    assert native_imagery(region, tmp_path) is None  # tiles of 1 m, maps of 0.5 m

    small.edit("gsd_m = 0.5", "gsd_m = 2.0")
    assert brmgeo(capsys, "maps", "small", "--data", tmp_path, "--scheduler", "serial").status == 0
    native = native_imagery(load_region(small.toml), tmp_path)
    assert native is not None
    assert native.gsd_m == 1.0
    middle = ((BOUNDS[0] + BOUNDS[2]) / 2, (BOUNDS[1] + BOUNDS[3]) / 2)
    rgb, left, top = native.around((middle[0] - 50, middle[1] - 40, middle[0] + 50, middle[1] + 40))
    assert rgb.shape == (80, 100, 3)
    x, y = np.meshgrid(left + np.arange(100) + 0.5, top - np.arange(80) - 0.5)
    kakao = Transformer.from_crs(CRS, "EPSG:5181", always_xy=True)
    expected = painted(*kakao.transform(x, y))
    assert np.abs(rgb - expected).max() < 3.0  # tiles are rounded and resampled once


def test_a_region_without_imagery_has_none(tmp_path: Path) -> None:
    small = make_source(tmp_path)
    text = small.toml.read_text(encoding="utf-8")
    start, end = text.index("[imagery]"), text.index("[ratio]")
    small.toml.write_text(text[:start] + text[end:], encoding="utf-8")
    assert native_imagery(load_region(small.toml), tmp_path) is None
