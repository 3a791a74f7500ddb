"""Where training crops come from: large scenes, mosaics of small tiles, sets of training tiles, and mixtures of them.

Each is a ``brmgeo.segment.augment.Source``: what it gives depends on the random generator that is handed in and on
nothing else, so that a training run can be taken up again at any step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import InputError
from brmgeo.segment.augment import Source

U8 = NDArray[np.uint8]
Patch = tuple[U8, U8, float, tuple[float, float]]
_POINTS = 20_000
#: Crops are at most this many times finer than what they are cut from: upsampled pictures teach blur.
_FINEST = 1.3


@dataclass(frozen=True, slots=True)
class Scene:
    """A picture of some ground: image (h, w, 3) uint8 RGB, label (h, w) uint8 (0, 255, 127), metres per pixel."""

    image: U8
    label: U8
    gsd_m: float
    name: str = ""

    def __post_init__(self) -> None:
        if self.image.shape != (*self.label.shape, 3) or not self.gsd_m > 0:
            raise InputError(
                f"scene {self.name!r}: image {self.image.shape}, label {self.label.shape}, {self.gsd_m} m/px: "
                "give (h, w, 3) RGB, its (h, w) label and a GSD above 0"
            )


class Scenes:
    """Crops anywhere in large scenes, each as often as its share of the known ground.

    Raises InputError for no scene, or none with known ground.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        if not scenes:
            raise InputError("no scene to train on: name at least one")
        self._scenes = list(scenes)
        rng = np.random.default_rng(0)
        self._built: list[NDArray[np.int64]] = []
        area = []
        for scene in scenes:
            pixels = np.flatnonzero(scene.label == BUILDING)
            pixels = pixels[rng.integers(pixels.size, size=min(_POINTS, pixels.size))]
            self._built.append(np.stack(np.divmod(pixels, scene.label.shape[1]), axis=-1))
            area.append(float(np.count_nonzero(scene.label != UNKNOWN)) * scene.gsd_m**2)
        if not sum(area) > 0:
            raise InputError(
                f"scenes {', '.join(s.name or '?' for s in scenes)}: no pixel of them is known ground; leave them out"
            )
        self._odds = np.array(area) / sum(area)

    def patch(
        self, rng: np.random.Generator, reach_m: float, near_buildings: float, gsd_m: float = math.inf
    ) -> Patch:
        """See ``Source``."""
        k = int(rng.choice(len(self._scenes), p=self._odds))
        scene, built = self._scenes[k], self._built[k]
        h, w = scene.label.shape
        near, away = rng.random() < near_buildings, rng.uniform(-0.4, 0.4, 2) * reach_m / scene.gsd_m
        row, col = rng.uniform(0, h), rng.uniform(0, w)
        if near and len(built):
            row, col = built[rng.integers(len(built))] + 0.5 + away
        # A crop whose middle is not in the scene would hold mostly mirrored ground.
        return scene.image, scene.label, scene.gsd_m, (float(np.clip(row, 0, h)), float(np.clip(col, 0, w)))


class Mosaic:
    """Crops out of mosaics of many small tiles, each of which is too small for a crop of its own.

    For every patch tiles are drawn, turned by quarters, mirrored and laid side by side; half of the mosaics are made of
    blocks of one tile and its three mirror images, where roofs go on over the inner seams. Tiles are (h, h, 3) uint8 with
    (h, h) labels, all of one size and GSD. Raises InputError otherwise.
    """

    def __init__(self, images: Sequence[U8], labels: Sequence[U8], gsd_m: float) -> None:
        shapes = {im.shape for im in images} | {(*la.shape, 3) for la in labels}
        if len(shapes) != 1 or len(images) != len(labels) or len({*next(iter(shapes))[:2]}) != 1:
            raise InputError(
                f"mosaic of {len(images)} images and {len(labels)} labels of the sizes {sorted(shapes)}: "
                "give as many of both, square, all of one size"
            )
        self._images, self._labels, self._gsd = list(images), list(labels), gsd_m
        self._side: int = images[0].shape[0]

    def patch(
        self, rng: np.random.Generator, reach_m: float, near_buildings: float, gsd_m: float = math.inf
    ) -> Patch:
        """See ``Source``; every tile is as near to buildings as it is."""
        side, mirrored = self._side, bool(rng.random() < 0.5)
        # One tile more than the crop needs, so that seams fall anywhere in it.
        n = int(np.ceil(2 * reach_m / self._gsd / side)) + 1
        n += n % 2
        image = np.empty((n * side, n * side, 3), np.uint8)
        label = np.empty((n * side, n * side), np.uint8)
        step = 2 if mirrored else 1
        for r in range(0, n, step):
            for c in range(0, n, step):
                k, turn, flip = int(rng.integers(len(self._images))), int(rng.integers(4)), rng.random() < 0.5
                for source, canvas in ((self._images[k], image), (self._labels[k], label)):
                    tile = np.rot90(source, turn)
                    tile = tile[:, ::-1] if flip else tile
                    if mirrored:
                        tile = np.concatenate([tile, tile[:, ::-1]], 1)
                        tile = np.concatenate([tile, tile[::-1]], 0)
                    canvas[r * side :, c * side :][: step * side, : step * side] = tile
        middle = n * side / 2
        row, col = middle + rng.uniform(-0.5, 0.5, 2) * side
        return image, label, self._gsd, (float(row), float(col))


class _Info(Protocol):
    @property
    def gsd_m(self) -> float: ...
    @property
    def building_share(self) -> float: ...


class Readable(Protocol):
    """What ``Tiles`` needs of a ``brmgeo.segment.shards.TileSet``."""

    @property
    def infos(self) -> Sequence[_Info]: ...
    def read(self, i: int, /) -> tuple[U8, U8]: ...


class Tiles:
    """Crops out of the training tiles ``chosen`` (their numbers) of a tile set; raises InputError for none.

    Crops that reach over a tile's border see it mirrored, without a label.
    """

    def __init__(self, tiles: Readable, chosen: Sequence[int]) -> None:
        if not len(chosen):
            raise InputError("none of the training tiles is in the split asked for: cut more of them")
        self._tiles, self._chosen = tiles, np.asarray(chosen)
        self._gsd = np.array([tiles.infos[i].gsd_m for i in chosen])
        self._built = np.array([tiles.infos[i].building_share > 0 for i in chosen])

    def patch(
        self, rng: np.random.Generator, reach_m: float, near_buildings: float, gsd_m: float = math.inf
    ) -> Patch:
        """See ``Source``."""
        near = rng.random() < near_buildings
        fits = self._gsd <= max(_FINEST * gsd_m, float(self._gsd.min()))
        built = fits & self._built
        i = int(rng.choice(self._chosen[built if near and built.any() else fits]))
        image, label = self._tiles.read(i)
        h, w = label.shape
        row, col = rng.uniform(0.3, 0.7, 2) * (h, w)
        return image, label, self._tiles.infos[i].gsd_m, (float(row), float(col))


class Mixture:
    """Each patch from one of several sources, drawn by weight. Raises InputError for weights that are not above 0."""

    def __init__(self, sources: Sequence[Source], weights: Sequence[float]) -> None:
        if not sources or len(sources) != len(weights) or min(weights) <= 0:
            raise InputError(
                f"{len(sources)} sources with the weights {list(weights)}: give one above 0 for each"
            )
        self._sources, self._odds = list(sources), np.array(weights) / sum(weights)

    def patch(
        self, rng: np.random.Generator, reach_m: float, near_buildings: float, gsd_m: float = math.inf
    ) -> Patch:
        """See ``Source``."""
        source = self._sources[int(rng.choice(len(self._sources), p=self._odds))]
        return source.patch(rng, reach_m, near_buildings, gsd_m)


def blank_unknown(image: U8, label: U8, least_px: int = 13) -> U8:
    """The label with 127 where the picture is plain white or black over ``least_px`` or more: nothing was seen there."""
    out = label.copy()
    for value in (0, 255):
        plain = (image == value).all(-1).astype(np.uint8)
        kernel = np.ones((least_px, least_px), np.uint8)
        out[cv2.morphologyEx(plain, cv2.MORPH_OPEN, kernel) > 0] = UNKNOWN
    return out
