"""Ground to train and test on: web tiles as they lie, pairs that are whole, towns painted once, roofs laid down."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.segment.ground import flight_frames, generated_scene, read_pairs, xyz_scenes

ROOT = Path(__file__).resolve().parents[2]
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", ROOT.parent / "shared" / "data"))


def write_tiles(folder: Path, keys: list[tuple[int, int]], zoom: int) -> None:
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)
    for x, y in keys:
        name = f"OAM-{x}-{y}-{zoom}.png"
        cv2.imwrite(str(folder / "images" / name), np.full((32, 32, 3), (x % 10) * 10 + y % 10, np.uint8))
        cv2.imwrite(str(folder / "masks" / name), np.full((32, 32), 255 * (x % 2), np.uint8))


def test_web_tiles_lie_as_on_the_ground_and_validation_is_apart(tmp_path: Path) -> None:
    x0, y0, zoom = 1238424, 1046544, 21
    keys = [(x0 + x, y0 + y) for x in range(6) for y in range(2)] + [(x0 + 20, y0)]
    write_tiles(tmp_path, keys, zoom)
    train, validation = xyz_scenes(tmp_path, zoom, 0.34)
    latitude = math.atan(math.sinh(math.pi * (1 - 2 * (y0 + 1) / 2**zoom)))
    assert train[0].gsd_m == pytest.approx(156543.03392 * 8 * math.cos(latitude) / 2**zoom, rel=1e-4)
    # Two columns of six for validation, the next for nobody, three for training; the tile far away is a scene of its own.
    assert [s.label.shape for s in validation] == [(64, 64)]
    assert [s.label.shape for s in train] == [(64, 96), (32, 32)]
    assert train[0].image[40, 0].tolist() == [((x0 + 3) % 10) * 10 + (y0 + 1) % 10] * 3
    assert {*np.unique(train[0].label[:, :32])} == {255 * ((x0 + 3) % 2)}


def test_tiles_without_neighbours_leave_unknown_ground_between(tmp_path: Path) -> None:
    write_tiles(tmp_path, [(10, 10), (11, 10), (11, 11)], 12)
    (scene,) = xyz_scenes(tmp_path, 12, 0.0)[0]
    assert (scene.label[32:, :32] == 127).all()


def test_pairs_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="images"):
        read_pairs(tmp_path)
    write_tiles(tmp_path, [(1, 1), (2, 1)], 12)
    with pytest.raises(InputError, match="zoom level 13"):
        xyz_scenes(tmp_path, 13, 0.0)
    (tmp_path / "masks" / "OAM-2-1-12.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="no picture that can be decoded"):
        read_pairs(tmp_path)
    (tmp_path / "masks" / "OAM-2-1-12.png").unlink()
    with pytest.raises(MissingInputError, match="every image needs its mask"):
        read_pairs(tmp_path)


def test_pairs_cut_short_transparent_or_of_other_sizes(tmp_path: Path) -> None:
    write_tiles(tmp_path, [(1, 1), (2, 1)], 12)
    image = tmp_path / "images" / "OAM-2-1-12.png"
    seen = np.dstack([np.full((32, 32, 3), 90, np.uint8), np.full((32, 32), 255, np.uint8)])
    seen[:, :10, 3] = 0
    cv2.imwrite(str(image), seen)
    label = read_pairs(tmp_path)[2][1]
    assert (label[:, :10] == 127).all()
    assert not (label[:, 10:] == 127).any()
    for part in ("images", "masks"):
        cv2.imwrite(str(tmp_path / part / image.name), np.full((48, 48), 255, np.uint8))
    with pytest.raises(InputError, match="32 x 32, 48 x 48 px: web tiles are square"):
        xyz_scenes(tmp_path, 12, 0.0)
    cv2.imwrite(str(image), np.full((48, 48), 40000, np.uint16))
    with pytest.raises(InputError, match="uint16"):
        read_pairs(tmp_path)
    noise = np.random.default_rng(1).integers(0, 255, (48, 48, 3), dtype=np.uint8)
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    image.unlink()
    image.with_suffix(".jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut short"):
        read_pairs(tmp_path)


def test_a_generated_scene_is_painted_once_and_labels_its_roofs(tmp_path: Path) -> None:
    scene = generated_scene(901, 300.0, 0.5, 0, tmp_path)
    (file,) = tmp_path.iterdir()
    before = file.stat().st_mtime_ns
    again = generated_scene(901, 300.0, 0.5, 0, tmp_path)
    assert file.stat().st_mtime_ns == before
    np.testing.assert_array_equal(scene.image, again.image)
    assert 0.01 < (scene.label == 255).mean() < 0.5
    assert {*np.unique(scene.label)} == {0, 255}
    winter = generated_scene(901, 300.0, 0.5, 1, tmp_path)
    np.testing.assert_array_equal(scene.label, winter.label)
    assert (scene.image != winter.image).mean() > 0.5


@pytest.mark.skipif(
    not (REAL / "flight-sheffield").exists(), reason="real flight not here: set BRMGEO_REAL_DATA"
)
def test_roofs_of_a_real_flight_are_laid_towards_the_camera() -> None:
    pictures = flight_frames(REAL / "flight-sheffield", 3.0)
    moved = []
    for picture in pictures[::10]:
        label = picture.read()[1]
        assert picture.lowered is not None
        laid = picture.lowered((label == 255).astype(np.float32))
        known = (label != 127) & np.isfinite(laid)
        if (label[known] == 255).mean() > 0.05:
            rows = [np.flatnonzero((m & known).any(1)).mean() for m in (label == 255, laid > 0.5)]
            moved.append(rows[1] - rows[0])
    # The camera looks 16 degrees forward: the most of a frame lies ahead, where the ground is seen below what stands on it.
    assert len(moved) >= 3
    assert np.median(moved) > 1
    with pytest.raises(SettingsError, match="too low for roof_m 40"):
        flight_frames(REAL / "flight-sheffield", 40.0)
