"""Crops and what happens to them: geometry against direct arithmetic, labels against the picture."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brmgeo.errors import InputError, SettingsError
from brmgeo.segment.augment import MEAN, AugmentSettings, cut, draw_crop, recolour, shrunk
from brmgeo.segment.samples import Mixture, Mosaic, Scene, Scenes, Tiles, blank_unknown
from brmgeo.segment.shards import TileInfo

PLAIN = AugmentSettings.none(0.3)


def painted(seed: int, shape: tuple[int, int] = (200, 240), gsd_m: float = 0.3) -> Scene:
    """A scene whose picture tells its label: buildings are red, all else is blue and green."""
    rng = np.random.default_rng(seed)
    label = np.zeros(shape, np.uint8)
    for _ in range(25):
        r, c, h, w = *rng.integers(0, 200, 2), *rng.integers(10, 30, 2)
        label[r : r + h, c : c + w] = 255
    image = rng.integers(40, 120, (*shape, 3), dtype=np.uint8)
    image[..., 0] = np.where(label == 255, 220, 10)
    return Scene(image, label, gsd_m)


def square(half: float) -> np.ndarray:
    return np.array([(-half, -half), (half, -half), (half, half), (-half, half)], float)


def test_an_upright_crop_at_the_scenes_own_gsd_is_a_slice() -> None:
    scene = painted(1)
    image, label = cut(scene.image, scene.label, (90.0, 120.0), square(32), 64)
    np.testing.assert_array_equal(image, scene.image[58:122, 88:152])
    np.testing.assert_array_equal(label, scene.label[58:122, 88:152])


def test_a_quarter_turn_and_a_mirror_image_are_exact() -> None:
    scene = painted(2)
    part = scene.image[58:122, 88:152]
    turned, _ = cut(scene.image, scene.label, (90.0, 120.0), np.roll(square(32), -1, 0), 64)
    np.testing.assert_array_equal(turned, np.rot90(part))
    mirrored, label = cut(scene.image, scene.label, (90.0, 120.0), square(32)[[1, 0, 3, 2]], 64)
    np.testing.assert_array_equal(mirrored, part[:, ::-1])
    np.testing.assert_array_equal(label, scene.label[58:122, 88:152][:, ::-1])


@pytest.mark.parametrize("k", [2, 3])
def test_a_coarser_crop_is_the_mean_of_blocks(k: int) -> None:
    scene = painted(3, (240, 240))
    image, label = cut(scene.image, scene.label, (120.0, 120.0), square(30 * k), 60)
    part = scene.image[120 - 30 * k : 120 + 30 * k, 120 - 30 * k : 120 + 30 * k].astype(float)
    blocks = part.reshape(60, k, 60, k, 3).mean((1, 3))
    assert np.abs(image - blocks).max() <= 1.0
    truth = scene.label[120 - 30 * k : 120 + 30 * k, 120 - 30 * k : 120 + 30 * k]
    share = (truth.reshape(60, k, 60, k) == 255).mean((1, 3))
    np.testing.assert_array_equal(label == 255, share >= 0.5)


def test_outside_the_scene_nothing_is_known() -> None:
    scene = painted(4)
    _, label = cut(scene.image, scene.label, (0.0, 0.0), square(32), 64)
    assert (label[:32] == 127).all()
    assert (label[:, :32] == 127).all()
    np.testing.assert_array_equal(label[32:, 32:], scene.label[:32, :32])
    _, far = cut(scene.image, scene.label, (-500.0, 0.0), square(32), 64)
    assert (far == 127).all()


@given(st.integers(0, 100_000))
@settings(max_examples=40, deadline=None)
def test_picture_and_label_move_together(seed: int) -> None:
    """In a scene whose red tells what is building, it still does after any turn, scale and tilt."""
    turning = AugmentSettings(
        gsd_m=(0.2, 0.6), roofs=0, objects=0, colour=0, shadow=0, haze=0, blur=0, noise=0, jpeg=0
    )
    image, label = draw_crop(Scenes([painted(5)]), np.random.default_rng(seed), 64, turning)
    inner = cv2.erode((label == 255).astype(np.uint8), np.ones((5, 5))) > 0
    outer = cv2.erode((label == 0).astype(np.uint8), np.ones((5, 5))) > 0
    # A gap of one pixel between two buildings may fall between the samples of the label.
    assert np.count_nonzero(image[inner][:, 0] <= 130) <= 4 + 0.02 * inner.sum()
    assert np.count_nonzero(image[outer][:, 0] >= 100) <= 4 + 0.02 * outer.sum()


@given(st.integers(0, 100_000))
@settings(max_examples=15, deadline=None)
def test_the_same_generator_gives_the_same_crop(seed: int) -> None:
    source = Scenes([painted(6), painted(7)])
    one, two = (draw_crop(source, np.random.default_rng(seed), 64, AugmentSettings()) for _ in range(2))
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


def test_with_all_strengths_at_zero_nothing_changes() -> None:
    scene = painted(8)
    assert (recolour(scene.image, scene.label, 0.3, np.random.default_rng(0), PLAIN) == scene.image).all()


def test_roofs_change_their_colour_and_the_ground_keeps_its_own() -> None:
    scene = painted(9)
    only = AugmentSettings(roofs=1, objects=0, colour=0, shadow=0, haze=0, blur=0, noise=0, jpeg=0)
    out = recolour(scene.image, scene.label, 0.3, np.random.default_rng(1), only).astype(int)
    moved = np.abs(out - scene.image).max(2)
    far = cv2.dilate((scene.label == 255).astype(np.uint8), np.ones((9, 9))) == 0
    assert moved[far].max() <= 1
    assert moved[scene.label == 255].mean() > 20


def test_courts_and_pools_are_drawn_on_open_ground_only() -> None:
    scene = Scene(np.full((300, 300, 3), 90, np.uint8), np.zeros((300, 300), np.uint8), 0.3)
    scene.label[100:160, 100:170] = 255
    only = AugmentSettings(roofs=0, objects=1, colour=0, shadow=0, haze=0, blur=0, noise=0, jpeg=0)
    drawn = 0
    for seed in range(10):
        out = recolour(scene.image, scene.label, 0.3, np.random.default_rng(seed), only)
        changed = (out != scene.image).any(2)
        assert not changed[scene.label == 255].any()
        drawn += bool(changed.any())
    assert drawn >= 3


def test_what_nobody_saw_has_the_mean_colour_as_in_use() -> None:
    scene = painted(13, (400, 400))
    scene.image[:200], scene.label[:200] = 0, 127
    scene.label[200:220] = 127  # seen, but on no map
    settings = AugmentSettings(gsd_m=(0.3, 0.3), turn=False, tilt=0.0, near_buildings=0.0)
    filled = 0
    for seed in range(12):
        image, label = draw_crop(Scenes([scene]), np.random.default_rng(seed), 64, settings)
        mean = (image == np.rint(255 * np.array(MEAN))).all(-1)
        assert (mean & (label != 127)).mean() < 0.01
        filled += int(mean.sum())
        if (label == 127).all():
            assert mean.mean() > 0.9
    assert filled > 2000


def test_jpeg_keeps_each_colour_in_its_channel() -> None:
    """Chroma is stored coarsely: of luma's weights red's is more than twice blue's, so a pattern in blue blurs more."""
    only = AugmentSettings(roofs=0, objects=0, colour=0, shadow=0, haze=0, blur=0, noise=0, jpeg=1)
    lost = []
    for channel in (0, 2):
        image = np.full((64, 64, 3), 128, np.uint8)
        image[::2, ::2, channel] = 250
        out = recolour(image, np.zeros((64, 64), np.uint8), 0.3, np.random.default_rng(3), only)
        lost.append(np.abs(out[..., channel].astype(int) - image[..., channel]).mean())
    assert lost[1] > lost[0]


@pytest.mark.parametrize(("source_gsd_m", "widest"), [(0.1, 80), (0.3, 54), (0.4, 40)])
def test_ground_is_shown_up_to_twice_as_large_but_not_beyond_its_own_pixels(
    source_gsd_m: float, widest: int
) -> None:
    """A building of 16 m is 40 px wide at 0.4 m, and at most as wide as twice that or its own pixels say."""
    half = round(8 / source_gsd_m)
    label = np.zeros((round(60 / source_gsd_m),) * 2, np.uint8)
    middle = len(label) // 2
    label[middle - half : middle + half, middle - half : middle + half] = 255
    source = Scenes([Scene(np.zeros((*label.shape, 3), np.uint8), label, source_gsd_m)])
    larger = dataclasses.replace(AugmentSettings.none(0.4), near_buildings=1.0, enlarge=1.0)
    assert larger.finest_m == pytest.approx(0.2)
    widths = []
    for seed in range(150):
        _, seen = draw_crop(source, np.random.default_rng(seed), 192, larger)
        across = (seen == 255).any(0)
        if not (across[0] or across[-1]):
            widths.append(int(across.sum()))
    assert len(widths) > 50
    assert min(widths) == pytest.approx(40, abs=1 + 0.06 * (widest - 40))
    assert max(widths) == pytest.approx(widest, abs=1 + 0.06 * (widest - 40))


@pytest.mark.parametrize(
    "bad",
    [
        {"gsd_m": (0.4, 0.2)},
        {"gsd_m": (0.0, 0.2)},
        {"haze": 1.5},
        {"enlarge": 1.5},
        {"tilt": 0.5},
        {"colour": -1.0},
    ],
)
def test_strengths_out_of_range_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=next(iter(bad))):
        AugmentSettings(**bad)


def test_shrinking_cuts_the_rest_off_and_passes_the_unknown_on() -> None:
    scene = painted(10, (31, 44))
    scene.label[0, 0] = 127
    image, label = shrunk(scene.image, scene.label, 3)
    assert (image.shape, label.shape) == ((10, 14, 3), (10, 14))
    assert label[0, 0] == 127
    assert (label == 127).sum() == 1


# --- sources -----------------------------------------------------------------------------------------------------


def test_scenes_are_drawn_by_their_known_area_and_near_buildings_when_asked() -> None:
    small, large = painted(11, (100, 100)), painted(12, (200, 200))
    source = Scenes([small, large])
    patches = [source.patch(np.random.default_rng(k), 20.0, 0.0) for k in range(400)]
    assert np.mean([p[0].shape[0] == 200 for p in patches]) == pytest.approx(0.8, abs=0.06)
    lonely = Scene(np.zeros((400, 400, 3), np.uint8), np.zeros((400, 400), np.uint8), 0.3)
    lonely.label[300:310, 50:60] = 255
    near = [Scenes([lonely]).patch(np.random.default_rng(k), 12.0, 1.0)[3] for k in range(50)]
    assert all(math.dist(p, (305, 55)) < 12 / 0.3 * 0.6 + 10 for p in near)


def test_a_mosaic_is_made_of_its_tiles() -> None:
    rng = np.random.default_rng(1)
    images = [np.full((16, 16, 3), 10 * k, np.uint8) for k in range(1, 8)]
    labels = [np.full((16, 16), 255 * (k % 2), np.uint8) for k in range(1, 8)]
    image, label, gsd, centre = Mosaic(images, labels, 0.5).patch(rng, 30.0, 0.5)
    assert gsd == 0.5
    assert image.shape[0] >= 2 * 30.0 / 0.5
    assert all(abs(c - image.shape[0] / 2) <= 8 for c in centre)
    assert set(np.unique(image).tolist()) <= {10 * k for k in range(1, 8)}
    np.testing.assert_array_equal(label == 255, image[..., 0] // 10 % 2 == 1)


def test_mosaics_go_on_over_mirrored_seams() -> None:
    images = [np.random.default_rng(k).integers(0, 255, (16, 16, 3), dtype=np.uint8) for k in range(3)]
    mosaic = Mosaic(images, [np.zeros((16, 16), np.uint8)] * 3, 0.5)
    mirrored = 0
    for k in range(20):
        image = mosaic.patch(np.random.default_rng(k), 14.0, 0.0)[0]
        mirrored += bool((image[:, 15] == image[:, 16]).all())
    assert 4 <= mirrored <= 16


def test_mosaics_of_unlike_tiles_are_refused() -> None:
    a, b = np.zeros((16, 16, 3), np.uint8), np.zeros((16, 20), np.uint8)
    with pytest.raises(InputError, match="all of one size"):
        Mosaic([a], [b], 0.5)


class Set:
    """A tile set in memory."""

    def __init__(self) -> None:
        self.infos = [
            TileInfo(
                key=str(k),
                shard=0,
                gsd_m=0.25,
                split="train",
                region="r",
                building_share=0.1 * (k % 2),
                known_share=1.0,
                bounds=(0, 0, 1, 1),
                crs="EPSG:5187",
            )
            for k in range(6)
        ]

    def read(self, i: int, /) -> tuple[np.ndarray, np.ndarray]:
        return np.full((32, 32, 3), i, np.uint8), np.zeros((32, 32), np.uint8)


def test_tiles_are_those_chosen_and_the_built_ones_where_asked() -> None:
    source = Tiles(Set(), [1, 2, 3])
    drawn = [source.patch(np.random.default_rng(k), 5.0, 0.0) for k in range(60)]
    assert {int(d[0][0, 0, 0]) for d in drawn} == {1, 2, 3}
    assert {d[2] for d in drawn} == {0.25}
    built = {int(source.patch(np.random.default_rng(k), 5.0, 1.0)[0][0, 0, 0]) for k in range(40)}
    assert built == {1, 3}
    with pytest.raises(InputError, match="cut more"):
        Tiles(Set(), [])


def test_tiles_much_coarser_than_the_crop_are_not_drawn() -> None:
    tiles = Set()
    tiles.infos = [dataclasses.replace(t, gsd_m=(0.25, 0.35, 0.47)[k % 3]) for k, t in enumerate(tiles.infos)]
    source = Tiles(tiles, range(6))
    for gsd, allowed in ((0.2, {0.25}), (0.28, {0.25, 0.35}), (0.45, {0.25, 0.35, 0.47}), (0.1, {0.25})):
        drawn = {source.patch(np.random.default_rng(k), 5.0, 0.5, gsd)[2] for k in range(60)}
        assert drawn == allowed
    plain = AugmentSettings.none(0.2)
    fine = {int(draw_crop(source, np.random.default_rng(k), 16, plain)[0][8, 8, 0]) for k in range(30)}
    assert fine == {0, 3}


def test_a_mixture_draws_by_weight() -> None:
    mixture = Mixture([Scenes([painted(1, (50, 50))]), Scenes([painted(2, (60, 60))])], [3, 1])
    sizes = [mixture.patch(np.random.default_rng(k), 5.0, 0.5)[0].shape[0] for k in range(400)]
    assert np.mean(np.array(sizes) == 50) == pytest.approx(0.75, abs=0.07)
    with pytest.raises(InputError, match="above 0"):
        Mixture([Scenes([painted(1)])], [0.0])


def test_plain_areas_of_a_picture_are_unknown() -> None:
    image = np.random.default_rng(0).integers(5, 250, (64, 64, 3), dtype=np.uint8)
    image[:, 40:] = 255
    image[3:6, 3:6] = 255  # something white and small
    label = blank_unknown(image, np.zeros((64, 64), np.uint8))
    assert (label[:, 40:] == 127).all()
    assert not (label[:, :40] == 127).any()


def test_scenes_whose_arrays_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="give"):
        Scene(np.zeros((4, 5, 3), np.uint8), np.zeros((4, 4), np.uint8), 0.3)
    with pytest.raises(InputError, match="no scene"):
        Scenes([])
    nothing = Scene(np.zeros((4, 4, 3), np.uint8), np.full((4, 4), 127, np.uint8), 0.3, "fog")
    with pytest.raises(InputError, match="scenes fog: no pixel"):
        Scenes([nothing])
