"""Pictures of a generated town: anchored to the world, seamless, and true to the footprints."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import shapely
from pyproj import Transformer
from rasterio.features import rasterize

from brmgeo.geo.grid import Window, lattice
from brmgeo.geo.tilegrid import KakaoGrid
from brmgeo.synth.imagery import Painter, render_imagery, tile_blocks, write_tiles
from brmgeo.synth.scene import Town, TownStyle
from brmgeo.synth.town import generate_town

BOUNDS = (195300.0, 446200.0, 195700.0, 446600.0)


@lru_cache(maxsize=2)
def town(seed: int = 5) -> Town:
    return generate_town(BOUNDS, seed, TownStyle(villages=0.0, apartments=1))


@lru_cache(maxsize=1)
def whole() -> np.ndarray:
    return render_imagery(town(), lattice(BOUNDS, "EPSG:5187", 0.5), window_px=300)


def test_a_window_is_the_same_pixels_as_in_the_whole() -> None:
    window = Window(230, 170, 260, 310)
    left, _, _, top = BOUNDS
    part = (left + 0.5 * 170, top - 0.5 * 490, left + 0.5 * 480, top - 0.5 * 230)
    alone = render_imagery(town(), lattice(part, "EPSG:5187", 0.5))
    assert alone.shape == (260, 310, 3)
    difference = np.abs(alone.astype(int) - whole()[window.slices])
    # Anti-aliased edges are rounded where the drawing is clipped; nothing else may differ.
    assert (difference > 2).mean() < 2e-3
    assert difference.mean() < 0.02


def test_same_town_same_picture() -> None:
    assert np.array_equal(render_imagery(town(), lattice(BOUNDS, "EPSG:5187", 0.5), window_px=300), whole())


def test_no_seams_between_windows() -> None:
    """Steps across window borders are no larger than steps elsewhere."""
    steps = np.abs(np.diff(whole().astype(np.float64), axis=1)).mean(axis=(0, 2))
    assert steps[299] < np.quantile(steps, 0.99) * 1.2


def test_roofs_lie_on_footprints() -> None:
    """The picture's strongest edges follow the outlines: shifted outlines fit worse."""
    box = lattice(BOUNDS, "EPSG:5187", 0.5)
    grey = cv2.cvtColor(whole(), cv2.COLOR_RGB2GRAY).astype(np.float32)
    edges = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    shapes = [b.polygon.exterior for b in town().buildings if b.polygon.area > 40]
    lines = rasterize([(s, 1) for s in shapes], out_shape=box.shape, transform=box.affine).astype(bool)
    score = {d: edges[np.roll(lines, d, (0, 1))].mean() for d in ((0, 0), (8, 0), (-8, 0), (0, 8), (0, -8))}
    assert score[0, 0] > 1.35 * max(v for d, v in score.items() if d != (0, 0))


def test_shadows_fall_away_from_the_sun() -> None:
    box = lattice(BOUNDS, "EPSG:5187", 0.5)
    union = shapely.union_all([b.polygon for b in town().buildings if b.height_m > 4])
    az = np.radians(town().style.sun_azimuth_deg)
    dx, dy = -3.0 * np.sin(az), -3.0 * np.cos(az)
    every = shapely.union_all([b.polygon for b in town().buildings]).buffer(0.5)

    def mean(x: float, y: float) -> float:
        ground = shapely.affinity.translate(union, x, y).difference(every)
        return float(whole()[rasterize([(ground, 1)], out_shape=box.shape, transform=box.affine) > 0].mean())

    assert mean(dx, dy) < 0.8 * mean(-dx, -dy)


def test_tiles_cover_the_bounds_and_are_turned(tmp_path: Path) -> None:
    painter = Painter(town(), KakaoGrid().crs, KakaoGrid().gsd_m(2))
    count = sum(write_tiles(painter, block, tmp_path, 2, ext="png") for block in tile_blocks(town(), 2))
    paths = list(tmp_path.glob("L2/*/*.png"))
    assert len(paths) == count
    left, bottom, right, top = BOUNDS
    rng = np.random.default_rng(0)
    xy = np.column_stack([rng.uniform(left, right, 400), rng.uniform(bottom, top, 400)])
    e, n = Transformer.from_crs(5187, 5181, always_xy=True).transform(xy[:, 0], xy[:, 1])
    box = lattice(BOUNDS, "EPSG:5187", 0.5)
    row, col = ((top - xy[:, 1]) / 0.5).astype(int), ((xy[:, 0] - left) / 0.5).astype(int)
    smooth = cv2.GaussianBlur(whole(), (0, 0), 2.0)
    assert box.shape == whole().shape[:2]
    mine, theirs = [], []
    # The formulas of FACTS, written out: x = floor((E + 30000) / 128), y = floor((N + 60000) / 128) at L2.
    for k in range(400):
        x, y = int((e[k] + 30000) // 128), int((n[k] + 60000) // 128)
        tile = cv2.imread(str(tmp_path / f"L2/{y}/{x}.png"))
        assert tile is not None
        assert tile.shape == (256, 256, 3)
        c = int((e[k] + 30000 - 128 * x) / 0.5)
        r = 255 - int((n[k] + 60000 - 128 * y) / 0.5)
        patch = tile[max(r - 3, 0) : r + 4, max(c - 3, 0) : c + 4, ::-1]
        theirs.append(patch.mean())
        mine.append(smooth[row[k], col[k]].mean())
    assert np.corrcoef(mine, theirs)[0, 1] > 0.85


def test_seasons_and_styles_look_different() -> None:
    box = lattice((195400.0, 446300.0, 195480.0, 446380.0), "EPSG:5187", 0.5)
    summer = render_imagery(town(), box).astype(float)
    other = generate_town(BOUNDS, 5, TownStyle.varied(12).with_season("winter"))
    assert np.abs(render_imagery(other, box) - summer).mean() > 8
