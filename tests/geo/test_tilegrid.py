"""Tile grids held against published check values, morecantile, shapely and round trips."""

from __future__ import annotations

import math

import morecantile
import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st

from brmgeo.errors import BrmgeoError, CrsError, SettingsError
from brmgeo.geo.crs import transformer
from brmgeo.geo.tilegrid import KakaoGrid, Tile, TileGrid, WebMercatorGrid, grid_named

GRIDS: list[TileGrid] = [KakaoGrid(), WebMercatorGrid(), WebMercatorGrid(tms=True)]


def tile_at(grid: TileGrid, x: float, y: float, z: int) -> Tile:
    """The tile of a point that lies on no edge."""
    (tile,) = grid.tiles_covering((x, y, x + 1e-6, y + 1e-6), z)
    return tile


def test_kakao_check_values() -> None:
    """The known place: (128.72 E, 37.67 N) lies on L1/8199/5964 and L3/2049/1491."""
    x, y = transformer("EPSG:4326", "EPSG:5181").transform(128.72, 37.67)
    assert (x, y) == pytest.approx((351752.11, 464764.41), abs=0.01)
    grid = KakaoGrid()
    assert grid.path(tile_at(grid, x, y, 1), 1, "png") == "L1/8199/5964.png"
    assert grid.path(tile_at(grid, x, y, 3), 3) == "L3/2049/1491"
    assert grid.gsd_m(1) == 0.25
    assert grid.gsd_m(14) == 2048.0
    assert grid.tile_bounds((0, 0), 3) == (-30000.0, -60000.0, -29744.0, -59744.0)


@given(st.floats(-179.9, 179.9), st.floats(-84.9, 84.9), st.integers(0, 22))
def test_web_mercator_is_morecantile(lon: float, lat: float, z: int) -> None:
    """Tile and bounds are those of morecantile, and the TMS twin is its flip."""
    tms = morecantile.tms.get("WebMercatorQuad")
    want = tms.tile(lon, lat, z)
    x, y = transformer("EPSG:4326", "EPSG:3857").transform(lon, lat)
    assert WebMercatorGrid().gsd_m(z) == tms.matrix(z).cellSize
    # A point on an edge may fall on either side.
    px = abs((x - tms.xy_bounds(want).left) / WebMercatorGrid().gsd_m(z)) % 256
    py = abs((y - tms.xy_bounds(want).top) / WebMercatorGrid().gsd_m(z)) % 256
    assume(all(1e-3 < p < 256 - 1e-3 for p in (px, py)))
    tile = tile_at(WebMercatorGrid(), x, y, z)
    assert tile == (want.x, want.y)
    bounds = tms.xy_bounds(morecantile.Tile(tile.x, tile.y, z))
    assert WebMercatorGrid().tile_bounds(tile, z) == pytest.approx(tuple(bounds), abs=1e-6)
    south = WebMercatorGrid(tms=True)
    assert south.tile_bounds(south.flipped(tile, z), z) == pytest.approx(tuple(bounds), abs=1e-6)


@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: f"{g.name}-{g.y_up}")
@given(data=st.data())
def test_tile_round_trips(grid: TileGrid, data: st.DataObject) -> None:
    """A tile's centre is in the tile, its path reads back, and its bounds are covered by itself alone."""
    z = data.draw(st.integers(max(1, grid.min_level), 14))
    columns, rows = (2 << (14 - z),) * 2 if grid.name == "kakao" else (1 << z,) * 2
    tile = Tile(data.draw(st.integers(0, columns - 1)), data.draw(st.integers(0, rows - 1)))
    left, bottom, right, top = grid.tile_bounds(tile, z)
    assert right - left == pytest.approx(256 * grid.gsd_m(z))
    assert tile_at(grid, (left + right) / 2, (bottom + top) / 2, z) == tile
    assert grid.tiles_covering((left, bottom, right, top), z) == [tile]
    for template in (None, "{z}/{x}/{-y}.{ext}", "a-{y}_{x}@{z}"):
        path = grid.path(tile, z, "jpg", template)
        assert grid.tile_from_path(path, template) == (tile, z)
    assert grid.flipped(grid.flipped(tile, z), z) == tile


@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: f"{g.name}-{g.y_up}")
def test_covering_is_the_tiles_under_the_turned_outline(grid: TileGrid) -> None:
    """Against shapely: the tiles that overlap the reprojected region, not those at its bounding box's corners."""
    bounds = (164000.0, 563000.0, 166200.0, 565780.0)  # EPSG:5187, about the paper's area
    z = 2 if grid.name == "kakao" else 18
    got = grid.covering(bounds, "EPSG:5187", z)
    edge = np.linspace(0, 1, 2001)[:-1]
    left, b, r, t = bounds
    xs = np.concatenate(
        [left + (r - left) * edge, np.full(2000, r), r - (r - left) * edge, np.full(2000, left)]
    )
    ys = np.concatenate([np.full(2000, b), b + (t - b) * edge, np.full(2000, t), t - (t - b) * edge])
    outline = shapely.Polygon(np.column_stack(transformer("EPSG:5187", grid.crs).transform(xs, ys)))
    box = grid.tiles_covering(outline.bounds, z)
    want = {tile for tile in box if outline.intersection(shapely.box(*grid.tile_bounds(tile, z))).area > 1.0}
    assert want <= set(got)
    assert all(shapely.box(*grid.tile_bounds(tile, z)).distance(outline) < 0.01 for tile in got)
    assert len(got) == len(set(got))
    if grid.name == "kakao":
        assert len(got) < len(box)
    tops = [grid.tile_bounds(tile, z)[3] for tile in got]
    assert tops == sorted(tops, reverse=True)
    assert set(got) <= set(grid.covering(bounds, "EPSG:5187", z, margin_px=300))
    assert len(grid.covering(bounds, "EPSG:5187", z, margin_px=300)) > len(got)


def test_templates() -> None:
    """Subdomains are stable for a tile, unknown placeholders are refused."""
    grid = WebMercatorGrid()
    url = "https://{s}.example.org/{z}/{x}/{y}.png"
    assert grid.path((3, 4), 5, template=url, subdomains="abc") == "https://b.example.org/5/3/4.png"
    with pytest.raises(SettingsError, match=r"\{s\}.*subdomains"):
        grid.path((3, 4), 5, template=url)
    with pytest.raises(SettingsError, match=r"\{zoom\}"):
        grid.path((3, 4), 5, template="{zoom}/{x}/{y}")
    with pytest.raises(SettingsError, match="needs"):
        grid.tile_from_path("5/3", "{z}/{x}")
    assert grid.tile_from_path("thumbs.db") is None
    assert grid.tile_from_path("5/3/4.png.part") is None


def test_refusals() -> None:
    """Wrong levels, places outside the grid and unknown names are one clear line."""
    with pytest.raises(SettingsError, match="1 to 14"):
        KakaoGrid().gsd_m(15)
    with pytest.raises(SettingsError, match="0 to 24"):
        WebMercatorGrid().gsd_m(25)
    with pytest.raises(CrsError, match="outside the kakao"):
        KakaoGrid().tiles_covering((-30001.0, 0.0, -30000.5, 1.0), 1)
    with pytest.raises(CrsError, match="kakao"):
        KakaoGrid().covering((-82.8, 28.0, -82.7, 28.1), "EPSG:4326", 1)
    with pytest.raises(BrmgeoError, match="nonsense"):
        KakaoGrid().covering((0, 0, 1, 1), "EPSG:nonsense", 1)
    with pytest.raises(SettingsError, match="no area"):
        KakaoGrid().tiles_covering((math.nan, 0.0, 1.0, 1.0), 1)
    with pytest.raises(SettingsError, match="no area"):
        KakaoGrid().covering((1, 1, 1, 2), "EPSG:5181", 1)
    with pytest.raises(SettingsError, match="kakao, webmercator, xyz"):
        grid_named("google")
    assert grid_named("xyz") == WebMercatorGrid()
    assert grid_named("kakao") == KakaoGrid()
