"""`brmgeo train`: from a recipe and its sources to a trained network with its curves, pictures and scores.

Folders that are not part of the project are given with ``--source NAME=PATH``.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.extras import extra
from brmgeo.files import whole_files, write_json, write_listed
from brmgeo.region import load_region
from brmgeo.segment.predict import cores
from brmgeo.segment.shards import TileSet, read_tiles
from brmgeo.segment.weights import ModelCard, load_weights

with extra("train", "training a network"):
    from brmgeo.evaluate.curves import crops_figure, reliability_figure, training_figure, training_table
    from brmgeo.segment import train as engine
    from brmgeo.segment.finish import finish
    from brmgeo.segment.ground import TrainingGround, gather
    from brmgeo.segment.imagenet import imagenet_weights
    from brmgeo.segment.metrics import LogitHistogram
    from brmgeo.segment.recipe import Recipe, SourceSpec, read_recipe

    from . import training
    from .map_sources import credits
    from .regions import described_regions, region_named
    from .trainable import require_all_trainable, require_trainable

F32 = NDArray[np.float32]


# --- sources -----------------------------------------------------------------------------------------------------


def ground_of(
    recipe: Recipe,
    data: Path,
    paths: Mapping[str, Path],
    test_regions: Sequence[str],
    say: Callable[[str], None],
) -> TrainingGround:
    """The ground of a recipe's sources, all looked at before the first is painted or read.

    Args:
        paths: name of a source -> its folder, for those that ask for one. A test source whose folder is not given is left
            out; a training source must be there.
        test_regions: regions to test on besides the recipe's own.

    Raises MissingInputError and InputError as the readers do, SettingsError for a path that no source asks for
    and for regions that must not be trained on.
    """
    sources = [
        with_terms(spec, data, paths) if spec.kind == "tiles" and spec.split != "test" else spec
        for spec in sources_of(recipe, data, paths, test_regions, say)
    ]
    return gather(recipe, sources, paths, data / "work" / "scenes", lambda spec: tile_sets(spec, data, paths))


def sources_of(
    recipe: Recipe,
    data: Path,
    paths: Mapping[str, Path],
    test_regions: Sequence[str],
    say: Callable[[str], None],
) -> list[SourceSpec]:
    """The sources to be read; see ``ground_of`` for what is raised."""
    names = {s.name for s in recipe.source if s.asks_for_folder}
    for name in paths:
        if name not in names:
            raise SettingsError(
                f"--source {name}=...: the recipe asks for {', '.join(sorted(names)) or 'no folder'}; name one of these"
            )
    for region in test_regions:
        if any(region in s.regions and s.split != "test" for s in recipe.source):
            raise SettingsError(
                f"region {region} is trained on by recipe {recipe.title!r}: name another to test on"
            )
    named = {r for s in recipe.source for r in s.regions}
    own = [
        SourceSpec(name=r, kind="tiles", split="test", regions=(r,)) for r in test_regions if r not in named
    ]
    held = _held_seeds(data)
    used = []
    for spec in (*recipe.source, *own):
        if spec.split != "test" and (same := set(held).intersection(spec.seeds)):
            seed = min(same)
            raise SettingsError(
                f"recipe source {spec.name}: seed {seed} is that of region {held[seed]}, which is held out for tests; "
                "take it out"
            )
        if spec.kind == "tiles":
            require_all_trainable(spec.regions, data, spec.split)
            if spec.name in paths:
                _require_usable(spec, paths, data)
        if spec.name not in names or spec.name in paths:
            used.append(spec)
        elif spec.split == "test":
            say(f"{spec.name}: not tested on, since no --source {spec.name}=PATH is given")
        else:
            raise MissingInputError(
                f"recipe {recipe.title!r} trains on {spec.name}: give its folder, --source {spec.name}=PATH"
            )
    return used


def with_terms(spec: SourceSpec, data: Path, paths: Mapping[str, Path]) -> SourceSpec:
    """A source of tiles with what its regions' files, or its folder, say of attribution and terms."""
    if not spec.regions:
        listed = read_tiles(paths[spec.name]).facts.get("sources")
        sources = [s for s in listed if isinstance(s, dict)] if isinstance(listed, list) else []
        told = {
            "attribution": [str(s.get("attribution") or "") for s in sources],
            "licence": [str(s.get("terms") or "") for s in sources],
        }
    else:
        regions = [region_named(name, data)[0] for name in spec.regions]
        told = {
            "attribution": [credits(region) for region in regions],
            "licence": [region.imagery.terms if region.imagery else "" for region in regions],
        }
    return spec.model_copy(
        update={
            key: "; ".join(dict.fromkeys(part for part in parts if part))
            for key, parts in told.items()
            if not getattr(spec, key)  # what the recipe says counts
        }
    )


def _require_usable(spec: SourceSpec, paths: Mapping[str, Path], data: Path) -> None:
    """Raises SettingsError for a folder of tiles that are for testing, or that another source names too."""
    folder = paths[spec.name]
    for name, other in paths.items():
        if name != spec.name and os.path.realpath(other) == os.path.realpath(folder):
            raise SettingsError(
                f"--source {spec.name} and {name} are one folder, {folder}: give it to one of them"
            )
    tiles = read_tiles(folder)
    if spec.split == "test":
        return
    tested = spec.split == "validation" and tiles.of_split("test")
    if tested or tiles.facts.get("hold_out"):
        raise SettingsError(
            f"recipe source {spec.name}: the tiles in {folder} are for testing; name another folder, or give "
            'split = "test"'
        )
    for region in sorted({info.region for info in tiles.infos}):
        if (file := data / "regions" / f"{region}.toml").is_file():
            require_trainable(load_region(file), data)


def _held_seeds(data: Path) -> dict[int, str]:
    """Seeds of the generated regions that are held out for tests, with the regions' names."""
    return {r.generate.seed: r.name for r in described_regions(data) if r.generate and r.training.hold_out}


def tile_sets(spec: SourceSpec, data: Path, paths: Mapping[str, Path]) -> Iterator[tuple[str, TileSet]]:
    """What the tiles are called, and the tiles: of each region, cut for this or found to be, or of the source's folder."""
    if not spec.regions:
        yield str(paths[spec.name]), read_tiles(paths[spec.name])
    for region in spec.regions:
        # A cut that is fresh costs nothing; one for another purpose, such as --split test, must not be trained on.
        align = training.last_aligned(region, data)
        whole = None if spec.split == "train" else spec.split
        yield (
            f"region {region}",
            read_tiles(training.cut_region(region, data, None, None, whole, align=align)),
        )


# --- the run -----------------------------------------------------------------------------------------------------


def train(
    recipe_path: Path,
    data: Path,
    out: Path,
    *,
    paths: Mapping[str, Path] | None = None,
    test_regions: Sequence[str] = (),
    steps: int | None = None,
    threads: int | None = None,
    start: Path | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Trains by a recipe, or takes up where a run in ``out`` ended, then calibrates, tests and writes the results.

    ``out`` receives model.safetensors and .md (the card), model.onnx, metrics.json, curves.csv and .png, reliability.png,
    pictures/epoch-NNN.png and checkpoint.safetensors; returns what is in metrics.json. ``start``: weights
    (.safetensors) to go on from in place of random ones. Raises SettingsError, InputError.
    """
    started = time.monotonic()
    recipe = _of_steps(read_recipe(recipe_path), steps)
    settings = replace(recipe.training, threads=threads or recipe.training.threads or cores())
    # What a first run lacks is said before any ground is painted.
    engine.require_fit(recipe.unet, settings)
    initial, before = load_weights(start) if start is not None else (None, None)
    if before is not None:
        _require_same_network(recipe, before, start)
    elif settings.imagenet and not engine.checkpoint_of(out).exists():
        imagenet_weights()
    ground = ground_of(recipe, data, paths or {}, test_regions, say)
    ground.credits.extend(_start_credits(recipe, before))
    crops = engine.validation_crops(
        [s for _, s in ground.crops], recipe.validation_crops, settings.crop_px, recipe.work_gsd_m
    )
    out.mkdir(parents=True, exist_ok=True)
    trainer = engine.Trainer(
        recipe.unet,
        settings,
        recipe.augment,
        ground.train,
        crops,
        out,
        data=ground.digest,
        initial=initial,
    )
    passes = settings.batch * settings.accumulate
    say(f"{recipe.title}: {settings.steps} steps of {passes} crops on {trainer.device.type}")

    def on_epoch(run: engine.Run, probability: F32) -> None:
        last, epochs = run.history[-1], [asdict(e) for e in run.history]
        write_listed(out / "curves.csv", training_table(epochs).encode(), say)
        write_listed(out / "curves.png", training_figure(epochs), say)
        write_listed(out / "pictures" / f"epoch-{last.epoch:03d}.png", crops_figure(*crops, probability), say)
        say(
            f"epoch {last.epoch}, step {last.step}: loss {last.loss:.3f}, validation loss {last.validation_loss:.3f}, "
            f"IoU {last.validation_iou:.3f}"
        )

    run = trainer.train(on_epoch, _pace(settings.steps, say))
    best = run.best_epoch
    kept = [e.epoch for e in engine.epochs_in_mean(run.history, settings)] or [best.epoch if best else 0]
    told = f"the mean of epochs {kept[0]} to {kept[-1]}" if len(kept) > 1 else f"epoch {kept[0]}"
    say(f"trained: {run.step} steps, kept: {told}")
    facts = finish(run.best, recipe, ground, out, steps=run.step, reliability=_reliability, say=say)
    facts["training"] = {
        "recipe": recipe_path.stem,
        "steps": run.step,
        "epochs_kept": [kept[0], kept[-1]],
        "seconds_of_this_run": round(time.monotonic() - started),
        "device": trainer.device.type,
    }
    with whole_files(out, ["metrics.json"], say) as made:
        write_json(made / "metrics.json", facts)
    return facts


def _of_steps(recipe: Recipe, steps: int | None) -> Recipe:
    """The recipe with another number of steps where one is asked for."""
    if steps is None:
        return recipe
    own = recipe.training
    warmup, mean_from = min(own.warmup_steps, steps // 4), min(own.mean_from, steps)
    return replace(recipe, training=replace(own, steps=steps, warmup_steps=warmup, mean_from=mean_from))


def _require_same_network(recipe: Recipe, before: ModelCard, start: Path | None) -> None:
    """Raises InputError for weights that are of another network than the recipe's."""
    found, wanted = {"encoder": "plain", **before.settings}, recipe.unet.plain()
    if other := [f"{k} {found.get(k)}, not {v}" for k, v in wanted.items() if found.get(k) != v]:
        raise InputError(
            f"{start}: the recipe cannot go on from these weights, which have {', '.join(other)}: "
            "give its [unet] their settings"
        )


def _start_credits(recipe: Recipe, before: ModelCard | None) -> Iterator[dict[str, Any]]:
    """What the weights of the start are owed to, for the model card."""
    if before is not None:
        yield {
            "name": f"weights {before.digest}, which it went on from",
            "kind": "start",
            "licence": before.licence,
            "data": before.data,
        }
    elif recipe.training.imagenet:
        yield {
            "name": "efficientnet-lite0 learned on ImageNet, which the encoder went on from",
            "kind": "start",
            "attribution": "Tan and Le 2019, github.com/tensorflow/tpu; as PyTorch tensors by ML Illustrated",
            "licence": "Apache-2.0",
        }


def _pace(steps: int, say: Callable[[str], None]) -> Callable[[int, float], None]:
    """Says every 25 steps how the training goes."""
    began: list[float] = []

    def on_step(step: int, loss: float) -> None:
        began.append(time.monotonic())
        del began[1:-50]
        if step % 25 == 0 and len(began) > 2:
            pace = (began[-1] - began[1]) / (len(began) - 2)
            say(f"step {step} of {steps}, loss {loss:.3f}, {pace:.2f} s a step")

    return on_step


def _reliability(histograms: Mapping[str, LogitHistogram]) -> bytes:
    return reliability_figure({name: own.reliability()[:2] for name, own in histograms.items()})
