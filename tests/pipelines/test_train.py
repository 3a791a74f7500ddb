"""`brmgeo train`: the ground that recipes name, what is refused, and a whole small run with its files."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file
from small_recipes import TINY

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.segment.finish import licence_of
from brmgeo.segment.predict import SHIPPED, Segmenter
from brmgeo.segment.recipe import SourceSpec, read_recipe
from brmgeo.segment.shards import TileInfo
from pipelines import train as job
from pipelines import training
from pipelines.cli import cli
from pipelines.training_pairs import cut_pairs

ROOT = Path(__file__).resolve().parents[2]
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", ROOT.parent / "shared" / "data"))
RECIPES = ROOT / "data" / "recipes"


def test_settings_that_do_not_fit_each_other_are_refused_before_any_ground_is_painted(tmp_path: Path) -> None:
    path = tmp_path / "tiny.toml"
    for right, wrong, said in (
        ("crop_px = 32", "crop_px = 31", "multiples of 2"),
        ("steps = 4", "steps = 4\nimagenet = true", r"need \[unet\] encoder"),
    ):
        path.write_text(TINY.replace(right, wrong))
        with pytest.raises(SettingsError, match=said):
            job.train(path, tmp_path, tmp_path / "out")
    assert {*tmp_path.iterdir()} == {path}


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
    real = SourceSpec(name="mine", kind="tiles", regions=("kampala",))
    (told,) = [job.with_terms(real, tmp_path, {}).model_dump()]
    assert licence_of([told]) == (
        "Apache-2.0 for the weights; trained on mine: (c) OpenStreetMap contributors, ODbL 1.0; "
        "OpenAerialMap contributors, CC BY 4.0 (CC BY 4.0)"
    )
    own = SourceSpec(name="own", kind="tiles", regions=("town-a", "town-b"))
    assert job.with_terms(own, tmp_path, {}).licence == "Apache-2.0, as brmgeo"
    said = own.model_copy(update={"licence": "mine", "attribution": "me"})
    assert job.with_terms(said, tmp_path, {}) == said
    # What nobody states is not taken for free.
    pairs = {"name": "far", "kind": "pairs", "split": "train"}
    assert licence_of([pairs]).endswith("trained on far: terms not stated")
    for more in ({}, {"licence": "CC BY-NC 4.0"}):
        assert licence_of([{**pairs, "split": "test", **more}]) == "Apache-2.0 for the weights"


def test_weights_of_another_network_are_refused_before_any_ground_is_painted(tmp_path: Path) -> None:
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(TINY)
    shipped = SHIPPED.with_suffix(".safetensors")
    with pytest.raises(InputError, match=r"building-unet.safetensors: .* widths \[16, 24, .*, not \[8, 16\]"):
        job.train(recipe, tmp_path, tmp_path / "out", start=shipped)
    assert {*tmp_path.iterdir()} == {recipe}


def gather(recipe: str, tmp_path: Path, **paths: Path) -> Any:
    file = tmp_path / "recipe.toml"
    file.write_text(recipe)
    return job.ground_of(read_recipe(file), tmp_path, paths, (), lambda text: None)


def test_sources_that_are_wrong_are_refused(tmp_path: Path) -> None:
    pairs = TINY + '[[source]]\nname = "abroad"\nkind = "pairs"\ngsd_m = 0.1\n'
    with pytest.raises(MissingInputError, match="--source abroad=PATH"):
        gather(pairs, tmp_path)
    with pytest.raises(SettingsError, match="name one of these"):
        gather(TINY, tmp_path, nowhere=tmp_path)
    tiles = TINY + '[[source]]\nname = "own"\nkind = "tiles"\nregions = {}\n'
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
        cut_pairs(
            *given,
            tmp_path / name,
            gsd_m=0.25,
            name=name,
            split=split,
            attribution="Those who flew",
            terms="CC BY 4.0",
            scheduler_spec="serial",
        )
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
    refused("has no tile to train on .* or cut it for training", train=far)
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
                TileInfo(
                    key=str(k),
                    shard=0,
                    gsd_m=0.25,
                    split=s,
                    region="a",
                    building_share=0.1,
                    known_share=1.0,
                    bounds=(0, 0, 1, 1),
                    crs="",
                )
                for k, s in enumerate(splits)
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
    monkeypatch.setattr(job, "with_terms", lambda spec, *_: spec)
    monkeypatch.setattr(job, "require_all_trainable", lambda *args: [])
    monkeypatch.setattr(job, "read_tiles", lambda tiles: tiles)
    validated = {}
    for split in ("train", "validation", "test"):
        own = f'[[source]]\nname = "t"\nkind = "tiles"\nsplit = "{split}"\nregions = ["a"]\n'
        ground = gather(TINY + own, tmp_path)
        validated[split] = [name for name, _ in ground.crops]
        assert ("t" in ground.validation, "t" in ground.test) == (split != "test", split == "test")
    assert validated == {"train": ["held", "t"], "validation": ["held", "t"], "test": ["held"]}
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
    facts = job.train(recipe, tmp_path, out, say=said.append)
    assert facts["training"]["epochs_kept"] == [2, 2]
    assert any("flown: not tested on" in line for line in said)
    made = {p.relative_to(out).as_posix() for p in out.rglob("[!.]*") if p.is_file()}
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
    (out / "metrics.json").write_text("with notes")
    job.train(recipe, tmp_path, out, say=said.append)
    assert (out / "metrics.edited.json").read_text() == "with notes"
    assert [p.name for p in out.rglob("*.edited.*")] == ["metrics.edited.json"]
    assert not any(line.startswith("epoch") for line in said)
    assert (out / "model.safetensors").read_bytes() == weights
    recipe.write_text(averaged.replace("seeds = [901]", "seeds = [901]\nweight = 2.0"))
    with pytest.raises(InputError, match="other settings or data"):
        job.train(recipe, tmp_path, out, say=said.append)
    short = job.train(recipe, tmp_path, tmp_path / "short", steps=2, say=said.append)
    assert short["training"]["steps"] == 2
    assert short["training"]["epochs_kept"] == [1, 1]


def test_the_command_passes_everything_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setattr(job, "train", lambda *args, **kw: seen.update(args=args, **kw))
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes" / "short.toml").touch()
    cli(["train", "demo", "--data", str(tmp_path), "--source", "a=b", "--steps", "5"], standalone_mode=False)
    assert seen["args"] == (tmp_path / "recipes" / "short.toml", tmp_path, tmp_path / "out" / "demo" / "unet")
    assert (seen["paths"], seen["test_regions"], seen["steps"]) == ({"a": Path("b")}, ("demo",), 5)
    cli(["train", "demo", "--recipe", "shipped", "--data", str(tmp_path)], standalone_mode=False)
    assert seen["args"][2] == tmp_path / "out" / "demo" / "unet-shipped"
    cli(["train", "--recipe", "shipped", "--data", str(tmp_path)], standalone_mode=False)
    assert seen["args"][2] == tmp_path / "out" / "shipped" / "unet"
    with pytest.raises(SettingsError, match="NAME=PATH"):
        cli(["train", "--source", "a"], standalone_mode=False)
