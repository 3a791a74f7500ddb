"""The ground that a network is trained and tested on: towns painted by seed, pairs, web tiles, flights, training tiles.

``gather`` puts together what a recipe's sources hold: the source of training crops, and the frames that are scored.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.files import clear_scratch, digest_of, whole_file
from brmgeo.flight.camera import slant_gsd_m, world_from_camera
from brmgeo.flight.folder import read_flight
from brmgeo.flight.view import lowered
from brmgeo.geo.grid import lattice
from brmgeo.maps.rasterize import building_mask
from brmgeo.pictures import SUFFIXES as PICTURES
from brmgeo.segment.augment import Source, shrunk
from brmgeo.segment.pairs import read_pair
from brmgeo.segment.recipe import Recipe, SourceSpec
from brmgeo.segment.samples import Mixture, Mosaic, Scene, Scenes, Tiles
from brmgeo.segment.shards import TileSet, check_label, read_tiles
from brmgeo.synth.day import another_day
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.scene import Season, TownStyle
from brmgeo.synth.town import generate_town

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
SCENES_VERSION = 1
_ORIGIN = (200_000.0, 500_000.0)
_SEASONS: tuple[Season, ...] = ("spring", "summer", "autumn", "winter")
_FRAME_PX = 512
_FRAMES_MOST = 150


# --- scenes ------------------------------------------------------------------------------------------------------


def generated_scene(seed: int, size_m: float, gsd_m: float, day: int, cache: Path) -> Scene:
    """A town of ``size_m`` square in the style ``TownStyle.varied(seed)``, at ``gsd_m``; ``day`` > 0: another season.

    Painted once and kept in ``cache`` under the digest of what it was made from.
    """
    what = f"{SCENES_VERSION} {seed} {size_m!r} {gsd_m!r} {day}"
    path = cache / f"town-{seed}-{day}-{digest_of(what)[:12]}.npy"
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
        clear_scratch(cache)
        with whole_file(path) as scratch:
            np.save(scratch, np.dstack([image, mask * np.uint8(BUILDING)]))
    both = np.load(path)
    return Scene(np.ascontiguousarray(both[..., :3]), np.ascontiguousarray(both[..., 3]), gsd_m, name)


def read_pairs(folder: Path) -> tuple[list[str], list[U8], list[U8]]:
    """Names, RGB images and labels of ``folder``/images and /masks.

    Transparent pixels and plain black or white areas are unknown. Raises MissingInputError where there are none or one
    of a pair is missing, InputError for unreadable, cut short or unequal ones and for more than 8 bits.
    """
    names, images, labels = [], [], []
    pictures = sorted(p for p in (folder / "images").glob("*") if p.suffix.lower() in PICTURES)
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
    """The tiles (x, y) in groups, each of those that are joined side by side."""
    places = sorted(keys)
    number = {place: i for i, place in enumerate(places)}
    beside = [
        (i, number[near])
        for (x, y), i in number.items()
        for near in ((x + 1, y), (x, y + 1))
        if near in number
    ]
    a, b = np.array(beside, np.int64).reshape(-1, 2).T
    pairs = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(len(places), len(places)))
    count, group = connected_components(pairs, directed=False)
    return [{places[i] for i in np.flatnonzero(group == k)} for k in range(count)]


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


# --- frames ---


@dataclass(frozen=True, slots=True)
class ScoredFrame:
    """One frame to be scored: how to read its (image, label), its GSD, and how roofs of ``roof_m`` are laid down in it."""

    read: Callable[[], tuple[U8, U8]]
    gsd_m: float
    lowered: Callable[[F32], F32] | None = None
    roof_m: float = 0.0


@dataclass(frozen=True, slots=True)
class TrainingGround:
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
    validation: dict[str, list[ScoredFrame]]
    test: dict[str, list[ScoredFrame]]
    credits: list[dict[str, Any]]
    digest: str


def reduced(scene: Scene, finest_m: float) -> Scene:
    k = max(1, int(finest_m / scene.gsd_m + 1e-6))
    return Scene(*shrunk(scene.image, scene.label, k), scene.gsd_m * k, scene.name) if k > 1 else scene


def frames_of(scene: Scene, gsd_m: float) -> list[ScoredFrame]:
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

            found.append(ScoredFrame(read, scene.gsd_m))
    return found


def flight_frames(folder: Path, roof_m: float = 0.0) -> list[ScoredFrame]:
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

    gsds = [
        slant_gsd_m(flight.camera, flight.mount, frame.roll_rad, frame.pitch_rad, frame.agl_m)
        for frame in flight.frames
    ]
    return [ScoredFrame(reader(i), gsd, layer(i) if roof_m else None, roof_m) for i, gsd in enumerate(gsds)]


def tile_frames(tiles: TileSet, chosen: Sequence[int], work_gsd_m: float) -> list[ScoredFrame]:
    """The tiles of the GSD nearest to ``work_gsd_m``, evenly thinned to what can be scored in a minute."""
    nearest = min({tiles.infos[i].gsd_m for i in chosen}, key=lambda g: abs(math.log(g / work_gsd_m)))
    own = [i for i in chosen if tiles.infos[i].gsd_m == nearest]
    own = [own[k] for k in np.linspace(0, len(own) - 1, min(_FRAMES_MOST, len(own))).astype(int)]
    return [ScoredFrame(lambda i=i: tiles.read(i), nearest) for i in own]  # type: ignore[misc]


# --- all of it ---------------------------------------------------------------------------------------------------


def gather(
    recipe: Recipe,
    sources: Iterable[SourceSpec],
    paths: Mapping[str, Path],
    scenes: Path,
    tile_sets: Callable[[SourceSpec], Iterable[tuple[str, TileSet]]],
) -> TrainingGround:
    """What ``sources`` of a recipe hold, read or made.

    Args:
        sources: the recipe's own and others, as they are wanted.
        paths: name of a source -> its folder, for those that have one.
        scenes: folder where painted towns are kept.
        tile_sets: gives what the tiles are called, and the tiles, of each set of a source of tiles.

    Raises MissingInputError and InputError as the readers do, SettingsError where there is nothing to train, validate or
    test on.
    """
    found = _Gathered(recipe)
    for spec in sources:
        if spec.split != "test":
            found.digest.update(spec.model_dump_json(exclude={"attribution", "licence"}).encode())
        if spec.kind == "generated":
            gsd = spec.gsd_m or recipe.work_gsd_m
            jobs = [(seed, day) for seed in spec.seeds for day in range(spec.days + 1)]
            towns = [generated_scene(seed, spec.size_m, gsd, day, scenes) for seed, day in jobs]
            found.use_scenes(spec, spec.split, towns)
        elif spec.kind == "xyz":
            train, validation = xyz_scenes(paths[spec.name], spec.zoom, spec.validation_share)
            found.use_scenes(spec, spec.split, train)
            found.use_scenes(spec, "validation", validation)
        elif spec.kind == "pairs":
            found.use_pairs(spec, paths[spec.name])
        elif spec.kind == "flight":
            found.frames["test"][spec.name] = flight_frames(paths[spec.name], spec.roof_m)
        else:
            for what, tiles in tile_sets(spec):
                found.use_tiles(spec, what, tiles)
        kept = ("name", "kind", "split", "regions", "seeds", "attribution", "licence")
        found.credits.append({k: getattr(spec, k) for k in kept if getattr(spec, k)})
        if spec.kind == "tiles" and not spec.regions:
            infos = read_tiles(paths[spec.name]).infos
            found.credits[-1]["regions"] = tuple(sorted({info.region for info in infos}))
    return found.ground()


@dataclass(slots=True)
class _Gathered:
    """What ``gather`` has found so far."""

    recipe: Recipe
    train: list[tuple[Source, float]] = field(default_factory=list)
    crops: list[tuple[str, Source]] = field(default_factory=list)
    frames: dict[str, dict[str, list[ScoredFrame]]] = field(
        default_factory=lambda: {"validation": {}, "test": {}}
    )
    credits: list[dict[str, Any]] = field(default_factory=list)
    digest: Any = None

    def __post_init__(self) -> None:
        self.digest = hashlib.sha256(f"{self.recipe.work_gsd_m!r} {self.recipe.validation_crops}".encode())

    def use_scenes(self, spec: SourceSpec, split: str, scenes: list[Scene]) -> None:
        if not scenes:
            return
        finest_m = self.recipe.augment.finest_m
        if split == "train":
            self.train.append((Scenes([reduced(s, finest_m) for s in scenes]), spec.weight))
        else:
            frames = [p for s in scenes for p in frames_of(s, self.recipe.work_gsd_m)]
            self.frames[split][spec.name] = frames
        if split == "validation":
            self.crops.append((spec.name, Scenes([reduced(s, finest_m) for s in scenes])))
        if split != "test":
            for scene in scenes:
                self.digest.update(scene.name.encode() + str(scene.gsd_m).encode())
                self.digest.update(hashlib.sha256(scene.image.tobytes() + scene.label.tobytes()).digest())

    def use_pairs(self, spec: SourceSpec, folder: Path) -> None:
        assert spec.gsd_m is not None
        _, images, labels = read_pairs(folder)
        # What is mostly blank teaches little, and a mosaic has room for others.
        seen = [k for k, la in enumerate(labels) if (la != UNKNOWN).mean() > 0.8]
        k = max(1, int(self.recipe.augment.finest_m / spec.gsd_m + 1e-6))
        small = [shrunk(images[i], labels[i], k) for i in seen]
        mosaic = Mosaic([a for a, _ in small], [b for _, b in small], spec.gsd_m * k)
        self.train.append((mosaic, spec.weight))
        for image, label in small:
            self.digest.update(hashlib.sha256(image.tobytes() + label.tobytes()).digest())

    def use_tiles(self, spec: SourceSpec, what: str, tiles: TileSet) -> None:
        """Those for training are divided as their own splits say; those that are not are all of the one split."""
        parts = {spec.split: list(range(len(tiles)))}
        if spec.split == "train":
            parts = {split: tiles.of_split(split) for split in ("train", "validation")}
            if not parts["train"]:
                mend = 'set split = "blocks" in its region file' if spec.regions else "cut it for training"
                raise SettingsError(
                    f"recipe source {spec.name}: {what} has no tile to train on (its split is for other uses); take it out, "
                    f"or {mend}"
                )
        for split, chosen in parts.items():
            if not chosen:
                continue
            source = Tiles(tiles, chosen)
            if split == "train":
                self.train.append((source, spec.weight / max(len(spec.regions), 1)))
            else:
                frames = tile_frames(tiles, chosen, self.recipe.work_gsd_m)
                self.frames[split].setdefault(spec.name, []).extend(frames)
            if split == "validation":
                self.crops.append((spec.name, source))
            if split != "test":
                self.digest.update(tiles.digest(chosen))

    def ground(self) -> TrainingGround:
        if not self.train or not self.crops:
            raise SettingsError(
                f"recipe {self.recipe.title!r}: names no ground to train on, or none to validate on"
            )
        for split, sets in self.frames.items():
            for name, pictures in sets.items():
                if not pictures:
                    raise SettingsError(
                        f"recipe source {name}: no frame of it for {split} has known ground: give it more, or leave it out"
                    )
        mixture = Mixture([s for s, _ in self.train], [w for _, w in self.train])
        validation, test = self.frames["validation"], self.frames["test"]
        return TrainingGround(mixture, self.crops, validation, test, self.credits, self.digest.hexdigest())
