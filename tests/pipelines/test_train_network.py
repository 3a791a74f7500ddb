"""`brmgeo train`: recipes, the ground they name, what is refused, and a whole small run with its files."""

from __future__ import annotations

import json
import math
import os
import shutil
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.flight.camera import pixel_from_point, world_from_camera
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.view import lowered
from brmgeo.region import load_region
from brmgeo.segment.augment import AugmentSettings
from brmgeo.segment.metrics import LogitHistogram
from brmgeo.segment.predict import SHIPPED, Segmenter
from brmgeo.segment.shards import TileInfo
from brmgeo.segment.unet import UNet, UNetSettings
from pipelines import network, training
from pipelines.cli import cli

ROOT = Path(__file__).resolve().parents[2]
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", ROOT.parent / "shared" / "data"))
RECIPES = ROOT / "data" / "recipes"

TINY = """
title = "tiny"
work_gsd_m = 0.25
validation_crops = 4
[unet]
widths = [8, 16]
[training]
steps = 4
batch = 2
crop_px = 32
warmup_steps = 1
epoch_steps = 2
device = "cpu"
[augment]
gsd_m = [0.2, 0.4]
[[source]]
name = "towns"
kind = "generated"
seeds = [901]
size_m = 300
[[source]]
name = "held"
kind = "generated"
split = "validation"
seeds = [902]
size_m = 300
[[source]]
name = "far"
kind = "generated"
split = "test"
seeds = [903]
size_m = 300
[[source]]
name = "flown"
kind = "flight"
split = "test"
"""


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
    train, validation = network.xyz_scenes(tmp_path, zoom, 0.34)
    latitude = math.atan(math.sinh(math.pi * (1 - 2 * (y0 + 1) / 2**zoom)))
    assert train[0].gsd_m == pytest.approx(156543.03392 * 8 * math.cos(latitude) / 2**zoom, rel=1e-4)
    # Two columns of six for validation, the next for nobody, three for training; the tile far away is a scene of its own.
    assert [s.label.shape for s in validation] == [(64, 64)]
    assert [s.label.shape for s in train] == [(64, 96), (32, 32)]
    assert train[0].image[40, 0].tolist() == [((x0 + 3) % 10) * 10 + (y0 + 1) % 10] * 3
    assert {*np.unique(train[0].label[:, :32])} == {255 * ((x0 + 3) % 2)}


def test_tiles_without_neighbours_leave_unknown_ground_between(tmp_path: Path) -> None:
    write_tiles(tmp_path, [(10, 10), (11, 10), (11, 11)], 12)
    (scene,) = network.xyz_scenes(tmp_path, 12, 0.0)[0]
    assert (scene.label[32:, :32] == 127).all()


def test_pairs_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="images"):
        network.read_pairs(tmp_path)
    write_tiles(tmp_path, [(1, 1), (2, 1)], 12)
    with pytest.raises(InputError, match="zoom level 13"):
        network.xyz_scenes(tmp_path, 13, 0.0)
    (tmp_path / "masks" / "OAM-2-1-12.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="readable picture"):
        network.read_pairs(tmp_path)
    (tmp_path / "masks" / "OAM-2-1-12.png").unlink()
    with pytest.raises(MissingInputError, match="every image needs its mask"):
        network.read_pairs(tmp_path)


def test_pairs_cut_short_transparent_or_of_other_sizes(tmp_path: Path) -> None:
    write_tiles(tmp_path, [(1, 1), (2, 1)], 12)
    image = tmp_path / "images" / "OAM-2-1-12.png"
    seen = np.dstack([np.full((32, 32, 3), 90, np.uint8), np.full((32, 32), 255, np.uint8)])
    seen[:, :10, 3] = 0
    cv2.imwrite(str(image), seen)
    label = network.read_pairs(tmp_path)[2][1]
    assert (label[:, :10] == 127).all()
    assert not (label[:, 10:] == 127).any()
    for part in ("images", "masks"):
        cv2.imwrite(str(tmp_path / part / image.name), np.full((48, 48), 255, np.uint8))
    with pytest.raises(InputError, match="32 x 32, 48 x 48 px: web tiles are square"):
        network.xyz_scenes(tmp_path, 12, 0.0)
    cv2.imwrite(str(image), np.full((48, 48), 40000, np.uint16))
    with pytest.raises(InputError, match="uint16"):
        network.read_pairs(tmp_path)
    noise = np.random.default_rng(1).integers(0, 255, (48, 48, 3), dtype=np.uint8)
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    image.unlink()
    image.with_suffix(".jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut short"):
        network.read_pairs(tmp_path)


def test_roofs_are_laid_onto_their_outlines_on_the_ground() -> None:
    camera = Camera(400, 300, 300.0, 300.0, 199.5, 149.5)
    # 20 degrees forward: pixels of one row see the same distance ahead.
    tilt = world_from_camera(Attitude(0.0, math.radians(-20.0), 0.0), 0.0, 0.0, 0.0)
    agl, roof = 60.0, 5.0
    corners = np.array([[10.0, -8.0], [25.0, -8.0], [25.0, 6.0], [10.0, 6.0]])
    at = np.array([0.0, 0.0, agl])

    def drawn(z: float) -> np.ndarray:
        uv = pixel_from_point(camera, tilt, at, np.column_stack([corners, np.full(4, z)]))
        label = np.zeros((300, 400), np.uint8)
        cv2.fillPoly(label, [np.rint(uv * 256).astype(np.int32)], 255, shift=8)
        return label

    moved = lowered(drawn(roof).astype(np.float32), camera, tilt, agl, roof)
    want = drawn(0.0)
    known = np.isfinite(moved)
    assert known.mean() > 0.8
    both, either = ((moved > 127) & (want == 255)).sum(), ((moved > 127) | ((want == 255) & known)).sum()
    assert both / either > 0.97
    roofs = drawn(roof)
    assert ((roofs == 255) & (want == 255)).sum() / ((roofs == 255) | (want == 255)).sum() < 0.9
    # Tilted to the horizon: sky is unknown, and nothing else breaks.
    sky = world_from_camera(Attitude(0.0, math.radians(-85.0), 0.0), 0.0, 0.0, 0.0)
    over = lowered(np.ones((300, 400), np.float32), camera, sky, agl, roof)
    assert np.isnan(over[0]).all()
    assert set(over[np.isfinite(over)]) == {1.0}


def test_answers_are_scored_as_they_are_and_laid_down() -> None:
    label = np.zeros((60, 80), np.uint8)
    label[20:40, 10:50] = 255
    label[:, 70:] = 127
    seen = np.roll(label == 255, -4, axis=0).astype(np.float32)  # roofs stand four rows above their outlines

    def laid(answer: np.ndarray) -> np.ndarray:
        down = np.roll(answer, 4, axis=0)
        down[:4] = np.nan
        return down

    picture = network.Picture(lambda: (np.zeros((60, 80, 3), np.uint8), label), 0.2, laid, 2.0)
    segmenter: Any = types.SimpleNamespace(
        probability=lambda image, gsd_m: seen, card=types.SimpleNamespace(threshold=0.5)
    )
    found = network.score(segmenter, [picture, picture])
    assert set(found) == {"", ", laid down from 2 m"}
    assert found[""].summary()["iou"] == pytest.approx(16 / 24, abs=1e-4)
    assert found[", laid down from 2 m"].summary()["iou"] == 1.0
    # Two frames: the whole but for unknown ground, and in the second row but for what lies beyond the frame.
    known = [s.hit + s.false + s.missed + s.rest for s in found.values()]
    assert known == [2 * 60 * 70, 2 * 56 * 70]


@pytest.mark.skipif(
    not (REAL / "flight-sheffield").exists(), reason="real flight not here: set BRMGEO_REAL_DATA"
)
def test_roofs_of_a_real_flight_are_laid_towards_the_camera() -> None:
    pictures = network._flight_frames(REAL / "flight-sheffield", 3.0)
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
        network._flight_frames(REAL / "flight-sheffield", 40.0)


def test_the_card_names_the_terms_of_what_it_went_on_from() -> None:
    credits = [
        {"name": "far", "attribution": "Those who flew", "licence": "CC BY 4.0"},
        {"name": "weights 0123, which it went on from", "licence": "ODbL 1.0"},
        {"name": "own"},
    ]
    assert network.licence_of(credits) == (
        "Apache-2.0 for the weights; trained on far: Those who flew (CC BY 4.0); "
        "weights 0123, which it went on from: ODbL 1.0"
    )
    earlier = {"sources": [*credits[:2], {"name": "near", "licence": "CC0"}]}
    third = {
        "name": "weights 4567",
        "kind": "start",
        "licence": "Apache-2.0 for the weights; and all of it again",
        "data": earlier,
    }
    assert network.licence_of([credits[0], third]) == (
        "Apache-2.0 for the weights; trained on far: Those who flew (CC BY 4.0); "
        "weights 0123, which it went on from: ODbL 1.0; near: CC0"
    )
    # Terms of foreign weights are never lost behind those of what they were trained on.
    foreign = {"name": "weights 89ab", "kind": "start", "licence": "CC BY-NC 4.0"}
    for sources, more in (
        ([], ""),
        (["towns of X"], ""),
        ([{"name": "own"}], ""),
        ([{"name": "near", "licence": "CC0"}], "; near: CC0"),
    ):
        assert network.licence_of([{**foreign, "data": {"sources": sources}}]) == (
            f"Apache-2.0 for the weights; trained on weights 89ab: CC BY-NC 4.0{more}"
        )


def test_seeds_of_held_out_regions_are_not_trained_on(tmp_path: Path) -> None:
    (tmp_path / "regions").mkdir()
    shutil.copy(ROOT / "data" / "regions" / "demo.toml", tmp_path / "regions")
    (tmp_path / "regions" / "faulty.toml").write_text("no region")
    for split in ("train", "validation"):
        text = TINY.replace('split = "validation"', "").replace(
            "seeds = [901]", f'seeds = [1, 901]\nsplit = "{split}"'
        )
        with pytest.raises(SettingsError, match="seed 1 is that of region demo, which is held out"):
            gather(text, tmp_path)


def test_terms_of_training_tiles_are_those_of_their_regions(tmp_path: Path) -> None:
    (tmp_path / "regions").mkdir()
    for name in ("town-a", "town-b", "kampala"):
        shutil.copy(ROOT / "data" / "regions" / f"{name}.toml", tmp_path / "regions")
    real = network.SourceSpec(name="mine", kind="tiles", regions=("kampala",))
    (told,) = [network.with_terms(real, tmp_path, {}).model_dump()]
    assert network.licence_of([told]) == (
        "Apache-2.0 for the weights; trained on mine: (c) OpenStreetMap contributors, ODbL 1.0; "
        "OpenAerialMap contributors, CC BY 4.0 (CC BY 4.0)"
    )
    own = network.SourceSpec(name="own", kind="tiles", regions=("town-a", "town-b"))
    assert network.with_terms(own, tmp_path, {}).licence == "Apache-2.0, as brmgeo"
    said = own.model_copy(update={"licence": "mine", "attribution": "me"})
    assert network.with_terms(said, tmp_path, {}) == said
    # What nobody states is not taken for free.
    pairs = {"name": "far", "kind": "pairs", "split": "train"}
    assert network.licence_of([pairs]).endswith("trained on far: terms not stated")
    for more in ({}, {"licence": "CC BY-NC 4.0"}):
        assert network.licence_of([{**pairs, "split": "test", **more}]) == "Apache-2.0 for the weights"


def test_weights_of_another_network_are_refused_before_any_ground_is_painted(tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(TINY)
    shipped = SHIPPED.with_suffix(".safetensors")
    with pytest.raises(InputError, match=r"building-unet.safetensors: .* widths \[16, 24, .*, not \[8, 16\]"):
        network.train(recipe, tmp_path, tmp_path / "out", start=shipped)
    assert {*tmp_path.iterdir()} == {recipe}


def test_a_generated_scene_is_painted_once_and_labels_its_roofs(tmp_path: Path) -> None:
    scene = network.generated_scene(901, 300.0, 0.5, 0, tmp_path)
    (file,) = tmp_path.iterdir()
    before = file.stat().st_mtime_ns
    again = network.generated_scene(901, 300.0, 0.5, 0, tmp_path)
    assert file.stat().st_mtime_ns == before
    np.testing.assert_array_equal(scene.image, again.image)
    assert 0.01 < (scene.label == 255).mean() < 0.5
    assert {*np.unique(scene.label)} == {0, 255}
    winter = network.generated_scene(901, 300.0, 0.5, 1, tmp_path)
    np.testing.assert_array_equal(scene.label, winter.label)
    assert (scene.image != winter.image).mean() > 0.5


def test_the_projects_recipes_hold_and_never_train_on_what_is_for_testing() -> None:
    held = {
        region.generate.seed
        for path in (ROOT / "data" / "regions").glob("[a-z]*.toml")
        if (region := load_region(path)).generate and region.training.hold_out
    }
    assert 1 in held
    for path in RECIPES.glob("*.toml"):
        recipe = network.read_recipe(path)
        for source in recipe.source:
            if source.split != "test":
                assert not held & set(source.seeds), path
                assert source.kind != "flight"
                assert "sheffield" not in source.name


def test_a_recipe_says_only_what_differs_from_its_base(tmp_path: Path) -> None:
    whole, again = tmp_path / "whole.toml", tmp_path / "again.toml"
    whole.write_text(TINY)
    again.write_text(
        'base = "whole"\ntitle = "again"\n[training]\nsteps = 5\n'
        '[[source]]\nname = "towns"\nweight = 3.0\n[[source]]\nname = "more"\nkind = "pairs"\n'
    )
    base, recipe = network.read_recipe(whole), network.read_recipe(again)
    assert (recipe.title, recipe.training) == ("again", replace(base.training, steps=5))
    assert (recipe.unet, recipe.augment, recipe.work_gsd_m) == (base.unet, base.augment, base.work_gsd_m)
    first, *others, last = recipe.source
    assert first == base.source[0].model_copy(update={"weight": 3.0})
    assert (tuple(others), last.name) == (base.source[1:], "more")

    for text, said in {
        'base = "none"': r"no such recipe \(the base of again.toml\); there are: again, whole",
        "base = 3": "again.toml:1: base: give the name",
        'base = "../whole"': "give the name of a recipe in the same folder",
        'base = "again"': "again.toml:1: base: 'again' leads back to this recipe",
        'base = "whole"\n[training]\n[[source]]\nweight = 2.0': "again.toml:3: source.0.name: missing key",
        'base = "whole"\n[[source]]\nname = []': r"again.toml:3: source.0.name: .*string \(found \[\]\)",
        'base = "whole"\n[[source]]\nname = "towns"\nweight = 0': "again.toml:4: source.towns.weight: .*greater than 0",
    }.items():
        again.write_text(text)
        with pytest.raises((SettingsError, MissingInputError), match=said):
            network.read_recipe(again)
    again.write_text(
        'base = "whole"\n' + 2 * '[[source]]\nname = "towns"\nkind = "generated"\nseeds = [901]\n'
    )
    with pytest.raises(SettingsError, match="two sources have this name"):
        network.train(again, tmp_path, tmp_path / "out")
    whole.write_text('base = "again"\n' + TINY)
    again.write_text('base = "whole"')
    with pytest.raises(SettingsError, match=r"whole.toml:1: base: 'again' leads back"):
        network.read_recipe(again)


def test_recipes_that_are_wrong_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "tiny.toml"
    with pytest.raises(MissingInputError, match="no such recipe"):
        network.read_recipe(path)
    path.write_text(TINY.replace("seeds = [901]", "seed = 901"))
    with pytest.raises(
        SettingsError, match=r"tiny.toml:19: source.towns.seed: unknown key; did you mean 'seeds'"
    ):
        network.read_recipe(path)
    path.write_text("title = ")
    with pytest.raises(SettingsError, match="not valid TOML"):
        network.read_recipe(path)
    for wrong, said in {
        "stepz = 4": r"tiny.toml:8: training.stepz: unknown key; did you mean 'steps'\?",
        "steps = 4.5": r"tiny.toml:8: training.steps: .*integer.*4\.5",
        "steps = 4\nseed = -1": r"tiny.toml:7: training: TrainSettings.seed = -1 is outside",
        'steps = 4\nlr = "high"': r"tiny.toml:9: training.lr: .*'high'",
        'steps = 4\ndevice = "tpu"': "training.device: .*cuda",
    }.items():
        path.write_text(TINY.replace('device = "cpu"\n', "").replace("steps = 4", wrong))
        with pytest.raises(SettingsError, match=said):
            network.read_recipe(path)
    for right, wrong, said in (
        (
            "gsd_m = [0.2, 0.4]",
            "gsd_m = [0.2]",
            r"tiny.toml:15: augment.gsd_m: has too few items \(found \[0.2\]\)",
        ),
        ("gsd_m = [0.2, 0.4]", "gsd_m = [0.3, 0.4]", "work_gsd_m 0.25 lies outside"),
        ("widths = [8, 16]", "widths = [8, 16]\nin_channels = 4", "pictures have 3"),
        ("crop_px = 32", "crop_px = 31", "multiples of 2"),
        ("steps = 4", "steps = 4\nimagenet = true", r"need \[unet\] encoder"),
    ):
        path.write_text(TINY.replace(right, wrong))
        with pytest.raises(SettingsError, match=said):
            network.train(path, tmp_path, tmp_path / "out")


def gather(recipe: str, tmp_path: Path, **paths: Path) -> Any:
    file = tmp_path / "recipe.toml"
    file.write_text(recipe)
    return network.gather(network.read_recipe(file), tmp_path, paths, (), 0.2, lambda text: None)


def test_sources_that_are_wrong_are_refused(tmp_path: Path) -> None:
    pairs = TINY + '[[source]]\nname = "abroad"\nkind = "pairs"\ngsd_m = 0.1\n'
    with pytest.raises(MissingInputError, match="--source abroad=PATH"):
        gather(pairs, tmp_path)
    with pytest.raises(SettingsError, match="name one of these"):
        gather(TINY, tmp_path, nowhere=tmp_path)
    with pytest.raises(SettingsError, match="tests only"):
        gather(TINY.replace('kind = "flight"\nsplit = "test"', 'kind = "flight"'), tmp_path, flown=tmp_path)
    with pytest.raises(SettingsError, match="roof_m is of flights only"):
        gather(TINY.replace("seeds = [903]", "seeds = [903]\nroof_m = 3.0"), tmp_path)
    with pytest.raises(SettingsError, match="two sources have this name"):
        gather(TINY.replace('name = "far"', 'name = "held"'), tmp_path)
    with pytest.raises(SettingsError, match="names no seeds"):
        gather(TINY.replace("seeds = [903]", ""), tmp_path)
    tiles = TINY + '[[source]]\nname = "own"\nkind = "tiles"\nregions = {}\n'
    with pytest.raises(SettingsError, match="named twice"):
        gather(tiles.format('["a", "a"]'), tmp_path)
    with pytest.raises(MissingInputError, match="--source own=PATH"):
        gather(tiles.format("[]"), tmp_path)


def test_tiles_in_a_folder_are_a_source(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for part in ("images", "masks"):
        (tmp_path / part).mkdir()
    for k in range(3):
        label = np.zeros((80, 90), np.uint8)
        label[20:40, 10 : 40 + 10 * k] = 255
        picture = rng.integers(0, 255, (80, 90, 3)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), picture)
        cv2.imwrite(str(tmp_path / "masks" / f"{k}.png"), label)
    given = (tmp_path / "images", tmp_path / "masks")
    splits = {"train": "train", "validation": "validation", "test": "test", "far": "test"}
    for name, split in splits.items():
        out, by = tmp_path / name, ("Those who flew", "CC BY 4.0")
        training.cut_pairs(*given, out, 0.25, name, split, *by, "serial")
    source = '[[source]]\nkind = "tiles"\nname = "{0}"\nsplit = "{0}"\n'
    paths = {split: tmp_path / split for split in ("train", "validation", "test")}
    own = TINY[: TINY.index("[[source]]")] + "".join(source.format(split) for split in paths)
    ground = gather(own, tmp_path, **paths)
    image, label, gsd_m, _ = ground.train.patch(np.random.default_rng(1), 10.0, 1.0)
    assert (image.shape, label.shape, gsd_m) == ((80, 90, 3), (80, 90), 0.25)
    assert set(np.unique(label)) == {0, 255}
    assert len(ground.validation["validation"]) == len(ground.test["test"]) == 3
    credit = ground.credits[0]
    assert (credit["attribution"], credit["licence"]) == ("Those who flew", "CC BY 4.0")
    assert credit["regions"] == ("train",)

    def refused(told: str, **other: Path) -> None:
        with pytest.raises((SettingsError, MissingInputError), match=told):
            gather(own, tmp_path, **paths | other)

    far = tmp_path / "far"
    refused("source train: the tiles in .* are for testing", train=far)
    facts = json.loads((far / "tiles.json").read_text()) | {"hold_out": False}
    (far / "tiles.json").write_text(json.dumps(facts))
    refused("source validation: the tiles in .* are for testing", validation=far)
    refused("has no tile to train on .* or cut it with --split train", train=far)
    refused("train and validation are one folder", validation=tmp_path / "train")
    refused("holds no training tiles", train=tmp_path / "images")
    (tmp_path / "regions").mkdir()
    text = (ROOT / "data" / "regions" / "demo.toml").read_text().replace('name = "demo"', 'name = "train"')
    (tmp_path / "regions" / "train.toml").write_text(text)
    refused("region train is held out")


def test_a_region_that_is_held_out_is_never_trained_on(tmp_path: Path) -> None:
    (tmp_path / "regions").mkdir()
    (tmp_path / "regions" / "demo.toml").write_text((ROOT / "data" / "regions" / "demo.toml").read_text())
    own = TINY + '[[source]]\nname = "own"\nkind = "tiles"\nregions = ["demo"]\n'
    with pytest.raises(SettingsError, match="held out"):
        gather(own, tmp_path)


@pytest.mark.slow
def test_tiles_are_cut_for_what_they_are_wanted_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Tiles for validation are never trained on, those of a region without training tiles are refused."""
    asked: list[Any] = []

    class Cut:
        def __init__(self, splits: list[str]) -> None:
            self.infos = [
                TileInfo(str(k), 0, 0.25, s, "a", 0.1, 1.0, (0, 0, 1, 1), "") for k, s in enumerate(splits)
            ]

        def __len__(self) -> int:
            return len(self.infos)

        def of_split(self, split: str) -> list[int]:
            return [i for i, info in enumerate(self.infos) if info.split == split]

        def digest(self, chosen: list[int]) -> bytes:
            return bytes(chosen)

        def read(self, i: int, /) -> Any:
            return np.zeros((64, 64, 3), np.uint8), np.zeros((64, 64), np.uint8)

    def cut_region(name: str, data: Path, out: None, spec: None, split: str | None, align: bool) -> Cut:
        asked.append(split)
        return Cut([split] * 3 if split else ["train", "validation"] if name == "a" else ["test"])

    monkeypatch.setattr(training, "cut_region", cut_region)
    monkeypatch.setattr(training, "last_aligned", lambda *args: False)
    monkeypatch.setattr(network, "with_terms", lambda spec, *_: spec)
    monkeypatch.setattr(training, "require_all_trainable", lambda *args: [])
    monkeypatch.setattr(network, "read_tiles", lambda tiles: tiles)
    found = {
        split: [part for part, *_ in network._tile_sources(
            network.SourceSpec(name="t", kind="tiles", split=split, regions=("a",)), tmp_path, {}, 0.3
        )]
        for split in ("train", "validation", "test")
    }  # fmt: skip
    assert found == {"train": ["train", "validation"], "validation": ["validation"], "test": ["test"]}
    assert asked == [None, "validation", "test"]
    with pytest.raises(SettingsError, match="region b has no tile to train on"):
        gather(TINY + '[[source]]\nname = "own"\nkind = "tiles"\nregions = ["a", "b"]\n', tmp_path)


@pytest.mark.slow
def test_a_whole_run_writes_its_files_and_goes_on_where_it_ended(tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.toml"
    averaged = TINY.replace("steps = 4", "steps = 4\nmean_from = 3")
    recipe.write_text(averaged)
    out = tmp_path / "out"
    said: list[str] = []
    facts = network.train(recipe, tmp_path, out, say=said.append)
    assert facts["training"]["epochs_kept"] == [2, 2]
    assert any("flown: not tested on" in line for line in said)
    made = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert made == {
        "checkpoint.safetensors", "curves.csv", "curves.png", "metrics.json", "model.onnx", "reliability.png",
        "model.md", "model.safetensors", "pictures/epoch-001.png", "pictures/epoch-002.png",
    }  # fmt: skip
    assert json.loads((out / "metrics.json").read_text()) == facts
    assert set(facts["scores"]) == {"validation: held", "test: far"}
    segmenter = Segmenter.load(out / "model.safetensors")
    assert segmenter.backend == "onnx"  # the graph beside it, by its name
    hit = union = 0
    for picture in gather(TINY, tmp_path).test["far"]:
        image, label = picture.read()
        mask = segmenter.mask(image, picture.gsd_m)
        hit += int(((mask == 255) & (label == 255)).sum())
        union += int(((mask == 255) | (label == 255)).sum())
    assert facts["scores"]["test: far"]["iou"] == pytest.approx(hit / union, abs=2e-4)
    assert segmenter.looks == facts["calibration"]["looks"]
    shift = facts["calibration"]["shift"]
    assert abs(shift) > 0.01  # a network of four steps is far from calibrated
    trained, kept = load_file(out / "checkpoint.safetensors"), load_file(out / "model.safetensors")
    for name, tensor in kept.items():
        more = shift if name == "head.bias" else 0.0
        np.testing.assert_allclose(tensor, trained[f"best/{name}"] + more, atol=6e-5)
    assert {"seeds": [901]}.items() <= segmenter.card.data["sources"][0].items()
    assert len((out / "curves.csv").read_text().splitlines()) == 3
    weights = (out / "model.safetensors").read_bytes()
    said.clear()
    network.train(recipe, tmp_path, out, say=said.append)
    assert not any(line.startswith("epoch") for line in said)
    assert (out / "model.safetensors").read_bytes() == weights
    recipe.write_text(averaged.replace("seeds = [901]", "seeds = [901]\nweight = 2.0"))
    with pytest.raises(InputError, match="other settings or data"):
        network.train(recipe, tmp_path, out, say=said.append)
    short = network.train(recipe, tmp_path, tmp_path / "short", steps=2, say=said.append)
    assert short["training"]["steps"] == 2
    assert short["training"]["epochs_kept"] == [1, 1]


@pytest.mark.parametrize("better", [1, 2])
def test_weights_are_for_the_looks_that_validation_asks_for(
    better: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    label = np.where(rng.random((100, 100)) < 0.3, 255, 0).astype(np.uint8)

    def histograms(segmenter: Segmenter, _: object) -> list[LogitHistogram]:
        own = LogitHistogram()
        noise = rng.normal(0.0, 2.0 if segmenter.looks == better else 4.0, label.shape)
        own.add((np.where(label == 255, 2.0, -2.0) + noise).astype(np.float32), label)
        return [own]

    monkeypatch.setattr(network, "_histograms", histograms)
    monkeypatch.setattr("brmgeo.segment.onnx_export.export_onnx", lambda weights, out: out.touch())
    recipe_path = tmp_path / "tiny.toml"
    recipe_path.write_text(TINY)
    unet = UNetSettings(widths=(8, 16))
    torch.manual_seed(0)
    ground: Any = types.SimpleNamespace(validation={}, test={}, credits=[])
    facts = network.finish(
        UNet(unet).state_dict(), unet, network.read_recipe(recipe_path), AugmentSettings(), ground,
        tmp_path, lambda _: None, 4,
    )  # fmt: skip
    assert facts["calibration"]["looks"] == better
    assert Segmenter.load(tmp_path / "model.safetensors", "torch").looks == better


def test_a_run_that_ends_while_it_finishes_leaves_the_weights_of_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    image = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    label = np.where(image[..., 0] > 128, 255, 0).astype(np.uint8)
    frames = {"held": [network.Picture(lambda: (image, label), 0.25)]}
    ground: Any = types.SimpleNamespace(validation=frames, test={}, credits=[])

    def finish(seed: int) -> None:
        unet = UNetSettings(widths=(8, 16))
        torch.manual_seed(seed)
        recipe = network.Recipe(title="tiny", work_gsd_m=0.25, source=())
        state = UNet(unet).state_dict()
        network.finish(state, unet, recipe, AugmentSettings(), ground, tmp_path, lambda _: None, 4)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    def files() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}

    with monkeypatch.context() as at_the_end:
        at_the_end.setattr(network, "score", killed)  # weights are calibrated by then
        with pytest.raises(KeyboardInterrupt):
            finish(1)
        assert files() == {}
    (tmp_path / "metrics.json").write_text("of earlier weights")
    finish(2)
    before = files()
    assert set(before) == {"model.safetensors", "model.md", "model.onnx", "reliability.png"}
    assert not (tmp_path / ".finish").exists()
    monkeypatch.setattr(network, "score", killed)
    with pytest.raises(KeyboardInterrupt):
        finish(3)
    assert files() == before


def test_the_command_passes_everything_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setattr(network, "train", lambda *args, **kw: seen.update(args=args, **kw))
    cli(["train", "demo", "--data", str(tmp_path), "--source", "a=b", "--steps", "5"], standalone_mode=False)
    assert seen["args"] == (tmp_path / "recipes" / "short.toml", tmp_path, tmp_path / "out" / "demo" / "unet")
    assert (seen["paths"], seen["test_regions"], seen["steps"]) == ({"a": Path("b")}, ("demo",), 5)
    cli(["train", "demo", "--recipe", "shipped", "--data", str(tmp_path)], standalone_mode=False)
    assert seen["args"][2] == tmp_path / "out" / "demo" / "unet-shipped"
    cli(["train", "--recipe", "shipped", "--data", str(tmp_path)], standalone_mode=False)
    assert seen["args"][2] == tmp_path / "out" / "shipped" / "unet"
    with pytest.raises(SettingsError, match="NAME=PATH"):
        cli(["train", "--source", "a"], standalone_mode=False)
