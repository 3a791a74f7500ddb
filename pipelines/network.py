"""`brmgeo train`: from a recipe and its sources to a trained network with its curves, pictures and scores.

Folders that are not part of the project are given with ``--source NAME=PATH``.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.flight.camera import world_from_camera
from brmgeo.flight.folder import read_flight
from brmgeo.flight.view import lowered
from brmgeo.geo.grid import lattice
from brmgeo.locate.masks import frame_gsd_m
from brmgeo.maps.rasterize import building_mask
from brmgeo.region import load_region
from brmgeo.segment.augment import MEAN, STD, AugmentSettings, Source, shrunk
from brmgeo.segment.metrics import LogitHistogram, Scores, best_threshold, segmentation_scores
from brmgeo.segment.recipe import Recipe, SourceSpec, read_recipe
from brmgeo.segment.samples import Mixture, Mosaic, Scene, Scenes, Tiles
from brmgeo.segment.shards import TileSet, check_label, read_tiles
from brmgeo.segment.tiles import BUILDING, UNKNOWN
from brmgeo.synth.day import another_day
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.scene import Season, TownStyle
from brmgeo.synth.town import generate_town

T = TypeVar("T")
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
SCENES_VERSION = 1
_ORIGIN = (200_000.0, 500_000.0)
_SEASONS: tuple[Season, ...] = ("spring", "summer", "autumn", "winter")
_PICTURES = (".png", ".jpg", ".jpeg", ".tif")
_FRAME_PX = 512
_FRAMES_MOST = 150


# --- sources -----------------------------------------------------------------------------------------------------


def generated_scene(seed: int, size_m: float, gsd_m: float, day: int, cache: Path) -> Scene:
    """A town of ``size_m`` square in the style ``TownStyle.varied(seed)``, at ``gsd_m``; ``day`` > 0: another season.

    Painted once and kept in ``cache`` under the digest of what it was made from.
    """
    what = f"{SCENES_VERSION} {seed} {size_m!r} {gsd_m!r} {day}"
    path = cache / f"town-{seed}-{day}-{hashlib.sha256(what.encode()).hexdigest()[:12]}.npy"
    name = f"town {seed}" + (f", day {day}" if day else "")
    if not path.exists():
        # Each seed has a place of its own, so that noise anchored to the world differs too.
        left, bottom = _ORIGIN[0] + 2000.0 * (seed % 50), _ORIGIN[1] + 2000.0 * (seed // 50)
        bounds = (left, bottom, left + size_m, bottom + size_m)
        town = generate_town(bounds, seed, TownStyle.varied(seed))
        if day:
            other = [s for s in _SEASONS if s != town.style.season]
            town = another_day(town, other[(seed + day) % 3], 1000 * day + seed)
        box = lattice(bounds, town.crs, gsd_m)
        image = render_imagery(town, box)
        mask = building_mask([b.polygon for b in town.buildings], box.affine, (box.shape[0], box.shape[1]))
        cache.mkdir(parents=True, exist_ok=True)
        for old in cache.glob(".town-*.part"):  # what killed runs left
            if time.time() - old.stat().st_mtime > 3600:
                old.unlink(missing_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                np.save(file, np.dstack([image, mask * np.uint8(BUILDING)]))
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    both = np.load(path)
    return Scene(np.ascontiguousarray(both[..., :3]), np.ascontiguousarray(both[..., 3]), gsd_m, name)


def read_pairs(folder: Path) -> tuple[list[str], list[U8], list[U8]]:
    """Names, RGB images and labels of ``folder``/images and /masks.

    Transparent pixels and plain black or white areas are unknown. Raises MissingInputError where there are none or one
    of a pair is missing, InputError for unreadable, cut short or unequal ones and for more than 8 bits.
    """
    from brmgeo.segment.pairs import read_pair

    names, images, labels = [], [], []
    pictures = sorted(p for p in (folder / "images").glob("*") if p.suffix.lower() in _PICTURES)
    if not pictures:
        raise MissingInputError(
            f"{folder}: holds no images/*.png or *.jpg: name a folder with images/ and masks/"
        )
    for path in pictures:
        mask_path = folder / "masks" / f"{path.stem}.png"
        if not mask_path.exists():
            raise MissingInputError(
                f"{mask_path}: is not there, but {path.name} is: every image needs its mask"
            )
        image, label = read_pair(path, mask_path)
        names.append(path.stem)
        images.append(image)
        labels.append(label)
    return names, images, labels


def xyz_scenes(folder: Path, zoom: int, validation_share: float) -> tuple[list[Scene], list[Scene]]:
    """(train, validation) scenes put together from tiles named ...X-Y-Z; one scene for every group of tiles that touch.

    The western columns of the largest group, about ``validation_share`` of it, are the validation scene; the column next
    to them belongs to neither. Raises as ``read_pairs``, and InputError where no name holds X-Y-``zoom``.
    """
    names, images, labels = read_pairs(folder)
    tiles: dict[tuple[int, int], tuple[U8, U8]] = {}
    for name, image, label in zip(names, images, labels):
        found = re.search(r"(\d+)-(\d+)-(\d+)$", name)
        if found and int(found[3]) == zoom:
            tiles[int(found[1]), int(found[2])] = (image, label)
    if not tiles:
        raise InputError(
            f"{folder}: no image is named ...X-Y-{zoom}: those are the tiles of zoom level {zoom}"
        )
    # Ground metres: web-mercator's pixel shrinks with the cosine of the latitude.
    y = sum(k[1] for k in tiles) / len(tiles)
    latitude = math.atan(math.sinh(math.pi * (1 - 2 * (y + 0.5) / 2**zoom)))
    shapes = sorted({label.shape for _, label in tiles.values()})
    side = shapes[0][0]
    if shapes != [(side, side)]:
        raise InputError(
            f"{folder}: tiles of {', '.join(f'{w} x {h}' for h, w in shapes)} px: web tiles are square, all of one size"
        )
    gsd = 40_075_016.69 * math.cos(latitude) / 2**zoom / side
    groups = sorted(_touching(set(tiles)), key=lambda g: (-len(g), min(g)))
    columns = sorted({x for x, _ in groups[0]})
    held = max(1, round(validation_share * len(columns))) if validation_share > 0 else 0
    cut = columns[held - 1] if held else columns[0] - 2
    train = [{k for k in groups[0] if k[0] > cut + 1}, *groups[1:]]
    validation = [{k for k in groups[0] if k[0] <= cut}]
    return (
        [_assembled(tiles, g, side, gsd, folder.name) for g in train if g],
        [_assembled(tiles, g, side, gsd, folder.name) for g in validation if g],
    )


def _touching(keys: set[tuple[int, int]]) -> list[set[tuple[int, int]]]:
    groups = []
    left = set(keys)
    while left:
        todo, group = [left.pop()], set[tuple[int, int]]()
        while todo:
            x, y = todo.pop()
            group.add((x, y))
            near = {(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)} & left
            left -= near
            todo += near
        groups.append(group)
    return groups


def _assembled(
    tiles: dict[tuple[int, int], tuple[U8, U8]], keys: set[tuple[int, int]], side: int, gsd: float, name: str
) -> Scene:
    x0, y0 = min(x for x, _ in keys), min(y for _, y in keys)
    w, h = max(x for x, _ in keys) - x0 + 1, max(y for _, y in keys) - y0 + 1
    image = np.zeros((h * side, w * side, 3), np.uint8)
    label = np.full((h * side, w * side), UNKNOWN, np.uint8)
    for x, y in keys:
        at = (slice((y - y0) * side, (y - y0 + 1) * side), slice((x - x0) * side, (x - x0 + 1) * side))
        image[at], label[at] = tiles[x, y]
    return Scene(image, label, gsd, name)


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame to be scored: how to read its (image, label), its GSD, and how roofs of ``roof_m`` are laid down in it."""

    read: Callable[[], tuple[U8, U8]]
    gsd_m: float
    lowered: Callable[[F32], F32] | None = None
    roof_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Ground:
    """Everything that a recipe's sources hold.

    Attributes:
        train: where training crops come from.
        crops: (name, source) to take validation crops from.
        validation, test: name -> frames.
        credits: name, kind, split, attribution and licence of each source, for the model card.
        digest: of the contents of what is trained and validated on.
    """

    train: Source
    crops: list[tuple[str, Source]]
    validation: dict[str, list[Picture]]
    test: dict[str, list[Picture]]
    credits: list[dict[str, Any]]
    digest: str


def gather(
    recipe: Recipe,
    data: Path,
    paths: Mapping[str, Path],
    test_regions: Sequence[str],
    finest_m: float,
    say: Callable[[str], None],
) -> Ground:
    """The sources of a recipe, read or made.

    Args:
        paths: name of a source -> its folder, for those of the kinds pairs, xyz and flight. A test source whose
            folder is not given is left out; a training source must be there.
        test_regions: regions to test on besides the recipe's own.
        finest_m: the finest GSD of any crop: what is much finer is averaged down once, here.

    Raises MissingInputError and InputError as the readers do, SettingsError for a path that no source asks for
    and for regions that must not be trained on.
    """
    train: list[tuple[Source, float]] = []
    crops: list[tuple[str, Source]] = []
    frames: dict[str, dict[str, list[Picture]]] = {"validation": {}, "test": {}}
    credits = []
    digest = hashlib.sha256(f"{recipe.work_gsd_m!r} {recipe.validation_crops}".encode())

    def use(name: str, split: str, scenes: list[Scene], weight: float) -> None:
        if not scenes:
            return
        if split == "train":
            train.append((Scenes([_reduced(s, finest_m) for s in scenes]), weight))
        else:
            frames[split][name] = [p for s in scenes for p in _frames_of(s, recipe.work_gsd_m)]
        if split == "validation":
            crops.append((name, Scenes([_reduced(s, finest_m) for s in scenes])))
        if split != "test":
            for scene in scenes:
                digest.update(scene.name.encode() + str(scene.gsd_m).encode())
                digest.update(hashlib.sha256(scene.image.tobytes() + scene.label.tobytes()).digest())

    for spec in _checked(recipe, data, paths, test_regions, say):
        if spec.kind == "tiles" and spec.split != "test":
            spec = with_terms(spec, data, paths)
        if spec.split != "test":
            digest.update(spec.model_dump_json(exclude={"attribution", "licence"}).encode())
        if spec.kind == "generated":
            cache = data / "work" / "scenes"
            gsd = spec.gsd_m or recipe.work_gsd_m
            jobs = [(seed, day) for seed in spec.seeds for day in range(spec.days + 1)]
            scenes = []
            for seed, day in jobs:
                scenes.append(generated_scene(seed, spec.size_m, gsd, day, cache))
            use(spec.name, spec.split, scenes, spec.weight)
        elif spec.kind == "xyz":
            parts = xyz_scenes(paths[spec.name], spec.zoom, spec.validation_share)
            use(spec.name, spec.split, parts[0], spec.weight)
            use(spec.name, "validation", parts[1], spec.weight)
        elif spec.kind == "pairs":
            assert spec.gsd_m is not None
            _, images, labels = read_pairs(paths[spec.name])
            # What is mostly blank teaches little, and a mosaic has room for others.
            seen = [k for k, la in enumerate(labels) if (la != UNKNOWN).mean() > 0.8]
            k = max(1, int(finest_m / spec.gsd_m + 1e-6))
            small = [shrunk(images[i], labels[i], k) for i in seen]
            train.append((Mosaic([a for a, _ in small], [b for _, b in small], spec.gsd_m * k), spec.weight))
            for image, label in small:
                digest.update(hashlib.sha256(image.tobytes() + label.tobytes()).digest())
        elif spec.kind == "flight":
            frames["test"][spec.name] = _flight_frames(paths[spec.name], spec.roof_m)
        else:
            for part, weight, source, pictures, seen_digest in _tile_sources(
                spec, data, paths, recipe.work_gsd_m
            ):
                if part == "train":
                    train.append((source, weight))
                else:
                    frames[part].setdefault(spec.name, []).extend(pictures)
                if part == "validation":
                    crops.append((spec.name, source))
                if part != "test":
                    digest.update(seen_digest)
        credits.append(
            {
                k: getattr(spec, k)
                for k in ("name", "kind", "split", "regions", "seeds", "attribution", "licence")
                if getattr(spec, k)
            }
        )
        if spec.kind == "tiles" and not spec.regions:
            infos = read_tiles(paths[spec.name]).infos
            credits[-1]["regions"] = tuple(sorted({info.region for info in infos}))
    if not train or not crops:
        raise SettingsError(f"recipe {recipe.title!r}: names no ground to train on, or none to validate on")
    for split, sets in frames.items():
        for name, pictures in sets.items():
            if not pictures:
                raise SettingsError(
                    f"recipe source {name}: no frame of it for {split} has known ground: give it more, or leave it out"
                )
    mixture = Mixture([s for s, _ in train], [w for _, w in train])
    return Ground(mixture, crops, frames["validation"], frames["test"], credits, digest.hexdigest())


def with_terms(spec: SourceSpec, data: Path, paths: Mapping[str, Path]) -> SourceSpec:
    """A source of tiles with what its regions' files, or its folder, say of attribution and terms."""
    from pipelines.map_sources import credits
    from pipelines.regions import region_named

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


def _checked(
    recipe: Recipe,
    data: Path,
    paths: Mapping[str, Path],
    test_regions: Sequence[str],
    say: Callable[[str], None],
) -> list[SourceSpec]:
    """The sources to be read, all looked at before the first is painted or read; see ``gather`` for what is raised."""
    from pipelines.trainable import require_all_trainable

    names = {
        s.name
        for s in recipe.source
        if s.kind in ("pairs", "xyz", "flight") or (s.kind == "tiles" and not s.regions)
    }
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
    every = [s.name for s in recipe.source]
    for name in every:
        if every.count(name) > 1:
            raise SettingsError(f"recipe source {name}: two sources have this name; give each its own")
    towns = [r for s in recipe.source for r in s.regions]
    for region in towns:
        if towns.count(region) > 1:
            raise SettingsError(
                f"recipe: region {region} is named twice; its tiles are cut for one purpose, so name it once"
            )
    held = _held_seeds(data)
    used = []
    for spec in (*recipe.source, *own):
        if spec.kind == "generated" and not spec.seeds:
            raise SettingsError(f"recipe source {spec.name}: is of kind generated and names no seeds")
        if spec.kind == "generated" and spec.split != "test" and (same := set(held).intersection(spec.seeds)):
            seed = min(same)
            raise SettingsError(
                f"recipe source {spec.name}: seed {seed} is that of region {held[seed]}, which is held out for tests; "
                "take it out"
            )
        if spec.kind == "flight" and spec.split != "test":
            raise SettingsError(f'recipe source {spec.name}: a flight is for tests only: split = "test"')
        if spec.roof_m and spec.kind != "flight":
            raise SettingsError(f"recipe source {spec.name}: roof_m is of flights only; take it out")
        if spec.kind == "pairs" and (spec.gsd_m is None or spec.split != "train"):
            raise SettingsError(f"recipe source {spec.name}: pairs are for training, and need their gsd_m")
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


def _require_usable(spec: SourceSpec, paths: Mapping[str, Path], data: Path) -> None:
    """Raises SettingsError for a folder of tiles that are for testing, or that another source names too."""
    from pipelines.trainable import require_trainable

    folder = paths[spec.name]
    for name, other in paths.items():
        if name != spec.name and other.resolve() == folder.resolve():
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
    from pipelines.regions import described_regions

    return {r.generate.seed: r.name for r in described_regions(data) if r.generate and r.training.hold_out}


def _reduced(scene: Scene, finest_m: float) -> Scene:
    k = max(1, int(finest_m / scene.gsd_m + 1e-6))
    return Scene(*shrunk(scene.image, scene.label, k), scene.gsd_m * k, scene.name) if k > 1 else scene


def _frames_of(scene: Scene, gsd_m: float) -> list[Picture]:
    """The scene in frames of 512 px at about ``gsd_m``; those that are mostly unknown are left out."""
    side = math.ceil(_FRAME_PX * gsd_m / scene.gsd_m)
    h, w = scene.label.shape
    found = []
    for r in range(0, max(h - side // 2, 1), side):
        for c in range(0, max(w - side // 2, 1), side):
            part = scene.label[r : r + side, c : c + side]
            if (part != UNKNOWN).mean() < 0.3:
                continue

            def read(r: int = r, c: int = c) -> tuple[U8, U8]:
                return scene.image[r : r + side, c : c + side], scene.label[r : r + side, c : c + side]

            found.append(Picture(read, scene.gsd_m))
    return found


def _flight_frames(folder: Path, roof_m: float = 0.0) -> list[Picture]:
    """The frames of a flight with its masks, onto which roofs of a height above 0 can be laid.

    Raises MissingInputError without frames or masks, SettingsError where the roofs reach a camera.
    """
    flight = read_flight(folder)
    if not (flight.has_images and flight.has_masks):
        raise MissingInputError(f"{folder}: a flight to test on needs frames and masks")
    for frame in flight.frames:
        if frame.agl_m <= 2 * roof_m:
            raise SettingsError(
                f"{folder}: frame {frame.file} was taken {frame.agl_m:g} m above ground, too low for roof_m {roof_m:g}: "
                "take such frames out of the flight, or roof_m out of the recipe"
            )

    def reader(i: int) -> Callable[[], tuple[U8, U8]]:
        def read() -> tuple[U8, U8]:
            return np.ascontiguousarray(flight.image(i)), check_label(flight.mask(i), flight.frames[i].file)

        return read

    def layer(i: int) -> Callable[[F32], F32]:
        frame = flight.frames[i]
        tilt = world_from_camera(flight.mount, frame.roll_rad, frame.pitch_rad, 0.0)
        return lambda answer: lowered(answer, flight.camera, tilt, frame.agl_m, roof_m)

    return [
        Picture(reader(i), frame_gsd_m(flight, i), layer(i) if roof_m else None, roof_m)
        for i in range(len(flight.frames))
    ]


def _tile_sets(spec: SourceSpec, data: Path, paths: Mapping[str, Path]) -> Iterator[tuple[str, TileSet]]:
    """What the tiles are called, and the tiles: of each region, cut for this or found to be, or of the source's folder."""
    from pipelines import training

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


def _tile_sources(
    spec: SourceSpec, data: Path, paths: Mapping[str, Path], work_gsd_m: float
) -> Iterator[tuple[str, float, Source, list[Picture], bytes]]:
    """(split, weight, source, frames, digest) of each set of tiles.

    Those that are for training are divided as their own splits say; those that are not are all of the one split.
    Raises SettingsError for a set without tiles to train on.
    """
    share = spec.weight / max(len(spec.regions), 1)
    for what, tiles in _tile_sets(spec, data, paths):
        if spec.split == "train":
            parts = {split: tiles.of_split(split) for split in ("train", "validation")}
            if not parts["train"]:
                raise SettingsError(
                    f"recipe source {spec.name}: {what} has no tile to train on (its split is for other uses); take it out, "
                    + (
                        'or set split = "blocks" in its region file'
                        if spec.regions
                        else "or cut it with --split train"
                    )
                )
        else:
            parts = {spec.split: list(range(len(tiles)))}
        for split, chosen in parts.items():
            if chosen:
                frames = _tile_frames(tiles, chosen, work_gsd_m)
                yield split, share, Tiles(tiles, chosen), frames, tiles.digest(chosen)


def _tile_frames(tiles: TileSet, chosen: Sequence[int], work_gsd_m: float) -> list[Picture]:
    """The tiles of the GSD nearest to ``work_gsd_m``, evenly thinned to what can be scored in a minute."""
    nearest = min({tiles.infos[i].gsd_m for i in chosen}, key=lambda g: abs(math.log(g / work_gsd_m)))
    own = [i for i in chosen if tiles.infos[i].gsd_m == nearest]
    own = [own[k] for k in np.linspace(0, len(own) - 1, min(_FRAMES_MOST, len(own))).astype(int)]
    return [Picture(lambda i=i: tiles.read(i), nearest) for i in own]  # type: ignore[misc]


# --- the run -----------------------------------------------------------------------------------------------------


def _cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    from brmgeo.segment import train as engine
    from brmgeo.segment.imagenet import imagenet_weights
    from brmgeo.segment.weights import load_weights

    started = time.monotonic()
    recipe = read_recipe(recipe_path)
    unet, settings, augment = recipe.unet, recipe.training, recipe.augment
    if steps is not None:
        settings = replace(
            settings,
            steps=steps,
            warmup_steps=min(settings.warmup_steps, steps // 4),
            mean_from=min(settings.mean_from, steps),
        )
    settings = replace(settings, threads=threads or settings.threads or _cores())
    # What a first run lacks is said before any ground is painted.
    engine.require_fit(unet, settings)
    initial, before = load_weights(start) if start is not None else (None, None)
    if before is not None:
        found, wanted = {"encoder": "plain", **before.settings}, unet.plain()
        if other := [f"{k} {found.get(k)}, not {v}" for k, v in wanted.items() if found.get(k) != v]:
            raise InputError(
                f"{start}: the recipe cannot go on from these weights, which have {', '.join(other)}: "
                "give its [unet] their settings"
            )
    if settings.imagenet and initial is None and not engine.checkpoint_of(out).exists():
        imagenet_weights()
    ground = gather(recipe, data, paths or {}, test_regions, augment.finest_m, say)
    crops = engine.validation_crops(
        [s for _, s in ground.crops], recipe.validation_crops, settings.crop_px, recipe.work_gsd_m
    )
    if before is not None:
        ground.credits.append(
            {
                "name": f"weights {before.digest}, which it went on from",
                "kind": "start",
                "licence": before.licence,
                "data": before.data,
            }
        )
    elif settings.imagenet:
        ground.credits.append(
            {
                "name": "efficientnet-lite0 learned on ImageNet, which the encoder went on from",
                "kind": "start",
                "attribution": "Tan and Le 2019, github.com/tensorflow/tpu; as PyTorch tensors by ML Illustrated",
                "licence": "Apache-2.0",
            }
        )
    out.mkdir(parents=True, exist_ok=True)
    trainer = engine.Trainer(unet, settings, augment, ground.train, crops, out, ground.digest, initial)
    say(
        f"{recipe.title}: {settings.steps} steps of {settings.batch * settings.accumulate} crops on {trainer.device.type}"
    )
    began: list[float] = []

    def on_step(step: int, loss: float) -> None:
        began.append(time.monotonic())
        del began[1:-50]
        if step % 25 == 0 and len(began) > 2:
            pace = (began[-1] - began[1]) / (len(began) - 2)
            say(f"step {step} of {settings.steps}, loss {loss:.3f}, {pace:.2f} s a step")

    def on_epoch(run: engine.Run, probability: F32) -> None:
        last = run.history[-1]
        write_curves(out, [asdict(e) for e in run.history])
        _show(out / "pictures" / f"epoch-{last.epoch:03d}.png", *crops, probability)
        say(
            f"epoch {last.epoch}, step {last.step}: loss {last.loss:.3f}, validation loss {last.validation_loss:.3f}, "
            f"IoU {last.validation_iou:.3f}"
        )

    run = trainer.train(on_epoch, on_step)
    best = run.best_epoch
    kept = [e.epoch for e in engine.epochs_in_mean(run.history, settings)] or [best.epoch if best else 0]
    told = f"the mean of epochs {kept[0]} to {kept[-1]}" if len(kept) > 1 else f"epoch {kept[0]}"
    say(f"trained: {run.step} steps, kept: {told}")
    facts = finish(run.best, unet, recipe, augment, ground, out, say, run.step)
    facts["training"] = {
        "recipe": recipe_path.stem,
        "steps": run.step,
        "epochs_kept": [kept[0], kept[-1]],
        "seconds_of_this_run": round(time.monotonic() - started),
        "device": trainer.device.type,
    }
    _write_text(out / "metrics.json", json.dumps(facts, indent=1, ensure_ascii=False) + "\n")
    return facts


def finish(
    state: Mapping[str, Any], unet: Any, recipe: Recipe, augment: AugmentSettings, ground: Ground, out: Path,
    say: Callable[[str], None], steps: int,
) -> dict[str, Any]:  # fmt: skip
    """Calibrates on validation frames, scores as ``brmgeo segment`` would answer, writes weights, card and ONNX.

    All of it is made in a folder of its own and moved to ``out`` when it is whole, the weights first: those of a run that
    is killed on the way are those of before, or none.
    """
    from brmgeo.segment.onnx_export import export_onnx
    from brmgeo.segment.predict import LOOKS, Segmenter
    from brmgeo.segment.train import tensors_of
    from brmgeo.segment.unet import shifted
    from brmgeo.segment.weights import ModelCard, save_weights

    low, high = augment.gsd_m
    card = ModelCard(
        settings=unet.plain(), mean=MEAN, std=STD, threshold=0.5, temperature=1.0, gsd_min_m=low, gsd_max_m=high,
        gsd_work_m=recipe.work_gsd_m,
        data={"recipe": recipe.title, "steps": steps, "sources": ground.credits},
        licence=licence_of(ground.credits),
    )  # fmt: skip
    made = out / ".finish"
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    weights = made / "model.safetensors"
    save_weights(weights, tensors_of(state), card)
    asked = {
        looks: _histograms(Segmenter.load(weights, "torch", looks=looks), ground.validation)
        for looks in range(1, LOOKS + 1)
    }
    reached = {looks: best_threshold(grounds)[1] for looks, grounds in asked.items()}
    looks = max(reached, key=lambda k: reached[k])
    say(f"IoU on validation {reached[1]:.4f} by one look, {reached[2]:.4f} by two: weights for {looks}")
    before = _weighed(asked[looks])
    temperature, shift = before.calibration()
    card = replace(card, temperature=round(temperature, 4))
    # The shift goes into the weights: whoever reads them, or the ONNX, has calibrated answers without knowing of it.
    tensors = tensors_of(shifted(state, shift))
    save_weights(weights, tensors, card)
    # What fits the mean of two looks goes into each of them, which is nearly the same: so the threshold is chosen, and the
    # calibration's error taken, on what comes out.
    segmenter = Segmenter.load(weights, "torch", looks=looks)
    grounds = _histograms(segmenter, ground.validation)
    after = _weighed(grounds)
    card = replace(card, threshold=round(best_threshold(grounds)[0], 3))
    calibration = {
        "looks": segmenter.looks,
        "temperature": card.temperature,
        "shift": round(shift, 4),
        "threshold": card.threshold,
        "calibration_error_before": round(before.calibration_error(), 4),
        "calibration_error": round(after.calibration_error(), 4),
    }
    say(
        f"calibrated on validation: temperature {card.temperature}, shift {calibration['shift']}, threshold {card.threshold}"
    )
    segmenter = replace(segmenter, card=card)
    scores = {
        # What cannot be told of a source (features of frames without room for a disc) is left out.
        f"{split}: {name}{height}": {k: v for k, v in own.summary().items() if math.isfinite(v)}
        for split, sets in (("validation", ground.validation), ("test", ground.test))
        for name, pictures in sets.items()
        for height, own in score(segmenter, pictures).items()
    }
    for name, row in scores.items():
        told = ", ".join(f"{k} {v:g}" for k, v in row.items())
        say(f"{name}: {told}")
    # The scores belong into the card; the tensors and with them the answers stay what they are.
    card = replace(card, metrics={"calibration": calibration, **scores})
    save_weights(weights, tensors, card)
    export_onnx(weights, made / "model.onnx")
    _draw_reliability(made / "reliability.png", {"as trained": before, "calibrated": after})
    # What belongs to other weights goes before they do.
    for name in ("model.onnx", "metrics.json"):
        (out / name).unlink(missing_ok=True)
    for name in ("model.safetensors", "model.md", "model.onnx", "reliability.png"):
        (made / name).replace(out / name)
    made.rmdir()
    return {"calibration": calibration, "scores": scores}


def _histograms(segmenter: Any, validation: Mapping[str, Sequence[Picture]]) -> list[LogitHistogram]:
    """What a ``Segmenter`` says of each kind of validation ground."""
    parts = []
    for pictures in validation.values():
        own = LogitHistogram()
        for picture in pictures:
            image, label = picture.read()
            p = np.clip(segmenter.probability(image, picture.gsd_m).astype(np.float64), 1e-7, 1 - 1e-7)
            own.add(np.log(p / (1 - p)).astype(np.float32), label)
        parts.append(own)
    return parts


def _weighed(parts: Sequence[LogitHistogram]) -> LogitHistogram:
    """All kinds of ground in one, each counting the same, whatever its area."""
    whole = LogitHistogram()
    most = max(int((h.building + h.other).sum()) for h in parts)
    for own in parts:
        times = most / max(int((own.building + own.other).sum()), 1)
        whole.building += np.rint(own.building * times).astype(np.int64)
        whole.other += np.rint(own.other * times).astype(np.int64)
    return whole


def score(segmenter: Any, pictures: Sequence[Picture]) -> dict[str, Scores]:
    """The scores of frames by a ``brmgeo.segment.predict.Segmenter``, at the frames' own GSD.

    Under "" those of the answers as they are; where these can be laid onto the ground, under ", laid down from H m" those
    of what lies there, over the pixels whose roofs are within the frame.
    """
    total = {"": Scores()}
    for picture in pictures:
        image, label = picture.read()
        probability = segmenter.probability(image, picture.gsd_m)
        answers = {"": (probability, label)}
        if picture.lowered:
            laid = picture.lowered(probability)
            own = np.where(np.isnan(laid), np.uint8(UNKNOWN), label)
            answers[f", laid down from {picture.roof_m:g} m"] = laid, own
        for how, (seen, truth) in answers.items():
            found = segmentation_scores(seen, truth, segmenter.card.threshold, picture.gsd_m)
            total[how] = total.get(how, Scores()) + found
    return total


_OWN_LICENCE = "Apache-2.0 for the weights"


def licence_of(credits: Sequence[Mapping[str, Any]]) -> str:
    """One line for the model card: the weights' own licence and what their sources and those of earlier parts ask for."""
    asked = []
    for credit in _with_earlier(credits):
        licence, attribution = credit.get("licence"), credit.get("attribution")
        if credit.get("split") == "test":
            continue
        if not licence and credit.get("kind") in ("tiles", "pairs", "xyz"):
            licence = "terms not stated"
        if licence:
            asked.append(f"{credit['name']}: " + (f"{attribution} ({licence})" if attribution else licence))
    return _OWN_LICENCE + ("; trained on " + "; ".join(dict.fromkeys(asked)) if asked else "")


def _with_earlier(credits: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """The credits, and after weights that training went on from theirs; in place of them where the terms are the same."""
    for credit in credits:
        data = credit.get("data")
        sources = data.get("sources") if isinstance(data, Mapping) else None
        earlier: list[Mapping[str, Any]] = []
        if credit.get("kind") == "start" and isinstance(sources, list):
            earlier = list(_with_earlier([s for s in sources if isinstance(s, Mapping) and "name" in s]))
        told = str(credit.get("licence", "")).startswith(_OWN_LICENCE) and any(
            c.get("licence") for c in earlier
        )
        if not told:
            yield credit
        yield from earlier


# --- files for people --------------------------------------------------------------------------------------------


def _write_text(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def write_curves(out: Path, epochs: Sequence[Mapping[str, Any]]) -> None:
    """curves.csv and curves.png: losses, validation IoU and learning rate of every epoch."""
    table = io.StringIO()
    writer = csv.DictWriter(table, list(epochs[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(epochs)
    _write_text(out / "curves.csv", table.getvalue())
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [e["step"] for e in epochs]
    left.plot(steps, [e["loss"] for e in epochs], marker="o", ms=3, label="training")
    left.plot(steps, [e["validation_loss"] for e in epochs], marker="o", ms=3, label="validation")
    left.set(xlabel="step", ylabel="loss", ylim=(0, None))
    left.legend(frameon=False)
    right.plot(steps, [e["validation_iou"] for e in epochs], color="tab:green", marker="o", ms=3)
    right.set(xlabel="step", ylabel="IoU on validation crops", ylim=(0, 1))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    part = out / ".curves.png.part"
    figure.savefig(part, dpi=110, format="png")
    part.replace(out / "curves.png")


def _draw_reliability(path: Path, histograms: Mapping[str, LogitHistogram]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    for name, histogram in histograms.items():
        said, was, _ = histogram.reliability()
        axes.plot(said, was, marker="o", ms=4, label=name)
    axes.set(
        xlabel="probability said", ylabel="share that is building", xlim=(0, 1), ylim=(0, 1), aspect="equal"
    )
    axes.legend(frameon=False)
    part = path.with_name(f".{path.name}.part")
    figure.savefig(part, dpi=110, format="png")
    part.replace(path)


def _show(path: Path, images: U8, labels: U8, probability: F32, most: int = 24, columns: int = 8) -> None:
    """Crops with their true outlines (yellow) above the probability (blue to red; unknown ground grey)."""
    chosen = np.linspace(0, len(images) - 1, min(most, len(images))).astype(int)
    cells = []
    for i in chosen:
        shown = np.ascontiguousarray(images[i][..., ::-1])
        outline, _ = cv2.findContours(
            (labels[i] == BUILDING).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(shown, outline, -1, (0, 255, 255), 1)
        heat = cv2.applyColorMap((probability[i] * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
        heat[labels[i] == UNKNOWN] = 90
        cells.append(np.pad(np.vstack([shown, heat]), ((2, 2), (2, 2), (0, 0)), constant_values=255))
    while len(cells) % columns:
        cells.append(np.full_like(cells[0], 255))
    rows = [np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)]
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, png = cv2.imencode(".png", np.vstack(rows))
    assert ok
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(png.tobytes())
    part.replace(path)
