"""Training tiles: where they are cut, what their labels say, which split they belong to, and which of them are kept.

Everything here follows from numbers and arrays, so the same region gives the same tiles on any machine and in any order of
work. Labels are uint8 everywhere: OTHER, BUILDING, and UNKNOWN where no map or no imagery tells (the loss and every
metric leave those pixels out).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_OTHER as OTHER
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.geo.grid import Bounds, Window
from brmgeo.segment.samples import blank_unknown

COARSE = 8  # clouds are looked for in pixels this many times larger
_BLANK_STD = 2.0  # grey levels: flat water keeps more than this at any GSD, a placeholder picture less
_CLOUD_BRIGHT = 190
_CLOUD_COLOUR = 28
_CLOUD_ROUGH = 9.0


def tile_windows(shape: tuple[int, int], tile_px: int, overlap_px: int) -> list[Window]:
    """Windows of ``tile_px`` square that cover ``shape`` (rows, cols), row by row, neighbours sharing ``overlap_px``.

    The last one of a row or column is moved inwards to end at the edge, so it may share more. Where ``shape`` is smaller
    than a tile the one window reaches outside. Raises ValueError unless 0 <= overlap_px < tile_px.
    """
    if not 0 <= overlap_px < tile_px:
        raise ValueError(f"tiles of {tile_px} px cannot overlap by {overlap_px} px")
    rows = _starts(shape[0], tile_px, tile_px - overlap_px)
    cols = _starts(shape[1], tile_px, tile_px - overlap_px)
    return [Window(r, c, tile_px, tile_px) for r in rows for c in cols]


def _starts(length: int, tile: int, stride: int) -> list[int]:
    if length <= tile:
        return [0]
    starts = list(range(0, length - tile + 1, stride))
    return starts if starts[-1] == length - tile else [*starts, length - tile]


def rank(name: str, seed: int) -> int:
    """A 64-bit number drawn from a name: what a choice goes by that must not depend on order or machine."""
    return int.from_bytes(hashlib.sha256(f"{seed}\n{name}".encode()).digest()[:8], "big")


def cells(bounds: Bounds, side_m: float) -> list[Bounds]:
    """``bounds`` divided evenly into rectangles of about ``side_m`` a side, row by row from the north."""
    left, bottom, right, top = bounds
    rows, cols = max(1, round((top - bottom) / side_m)), max(1, round((right - left) / side_m))
    whole = Splits(bounds, rows, cols, (), 0.0)
    return [whole.block(i) for i in range(rows * cols)]


@dataclass(frozen=True, slots=True)
class Splits:
    """Ground divided into rectangular blocks, each for one split.

    Attributes:
        bounds: (left, bottom, right, top) of all blocks, metres.
        rows, cols: number of blocks, row 0 in the north.
        names: a split a block, row by row.
        guard_m: least distance on the ground between tiles of different splits.
    """

    bounds: Bounds
    rows: int
    cols: int
    names: tuple[str, ...]
    guard_m: float

    def block(self, index: int) -> Bounds:
        """(left, bottom, right, top) of one block."""
        left, bottom, right, top = self.bounds
        wide, high = (right - left) / self.cols, (top - bottom) / self.rows
        row, col = divmod(index, self.cols)
        return (left + col * wide, top - (row + 1) * high, left + (col + 1) * wide, top - row * high)

    def of(self, tile: Bounds) -> str | None:
        """The split of a tile, or None where half the guard band around it meets ground of two splits.

        Tiles of different splits are then at least ``guard_m`` apart: each keeps half of it from the border between them.
        Ground beyond the outermost blocks belongs to the nearest one.
        """
        left, bottom, right, top = self.bounds
        wide, high = (right - left) / self.cols, (top - bottom) / self.rows
        half = self.guard_m / 2
        c0 = _clamped((tile[0] - half - left) / wide, self.cols)
        c1 = _clamped((tile[2] + half - left) / wide, self.cols)
        r0 = _clamped((top - tile[3] - half) / high, self.rows)
        r1 = _clamped((top - tile[1] + half) / high, self.rows)
        met = {self.names[r * self.cols + c] for r in range(r0, r1 + 1) for c in range(c0, c1 + 1)}
        return met.pop() if len(met) == 1 else None


def _clamped(value: float, count: int) -> int:
    return min(max(int(np.floor(value)), 0), count - 1)


def spatial_splits(
    bounds: Bounds, block_m: float, guard_m: float, validation_share: float, test_share: float, seed: int = 0
) -> Splits:
    """Blocks of about ``block_m`` a side over ``bounds``, dealt to validation, test and training by their shares.

    The numbers of blocks are the shares rounded, and at least one for each share above 0 as soon as there are three
    blocks; which blocks they are is drawn from ``seed`` and the blocks' places. Fewer blocks all train.
    """
    left, bottom, right, top = bounds
    rows, cols = max(1, round((top - bottom) / block_m)), max(1, round((right - left) / block_m))
    count = rows * cols
    order = sorted(range(count), key=lambda i: rank(f"block {i // cols} {i % cols} of {rows} x {cols}", seed))
    held = [
        max(1, round(share * count)) if share > 0 and count >= 3 else 0
        for share in (test_share, validation_share)
    ]
    names = ["train"] * count
    for place, index in enumerate(order[: sum(held)]):
        names[index] = "test" if place < held[0] else "validation"
    return Splits(bounds, rows, cols, tuple(names), guard_m)


def one_split(bounds: Bounds, name: str) -> Splits:
    """All ground in one split."""
    return Splits(bounds, 1, 1, (name,), 0.0)


def make_label(mask: NDArray[np.uint8], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(h, w) uint8 label of a building mask (0, 1, 255 = outside the map) and of where imagery is known (h, w) bool."""
    label = np.full(mask.shape, UNKNOWN, np.uint8)
    label[(mask == 0) & seen] = OTHER
    label[(mask == 1) & seen] = BUILDING
    return label


def shares(label: NDArray[np.uint8]) -> tuple[float, float]:
    """(share of building among the known pixels, share of known pixels) of a label; 0 building where nothing is known."""
    known = int((label != UNKNOWN).sum())
    built = int((label == BUILDING).sum())
    return (built / known if known else 0.0, known / label.size)


def picture_fault(
    rgb: NDArray[np.uint8],
    seen: NDArray[np.bool_],
    ground: NDArray[np.bool_] | None = None,
    cloud_share: float = 0.5,
) -> str | None:
    """Why a picture teaches nothing: ``blank``, ``cloudy``, or None.

    Args:
        rgb: (h, w, 3) uint8, best a small version of the tile (1/8): clouds are large.
        seen: (h, w) bool, its known pixels.
        ground: (h, w) bool, known pixels without building, which are searched for cloud; without it none is looked for.
        cloud_share: share of the ground that may be cloud.

    Blank is a picture of one colour, as services send where they have none. Cloud is bright, without colour and smooth,
    which a large white roof is too: so only ground between buildings is judged.
    """
    if not seen.any():
        return "blank"
    values = rgb.astype(np.float32)
    grey = values.mean(axis=-1)
    if float(values[seen].std(axis=0).max()) < _BLANK_STD:
        return "blank"
    if ground is None or not ground.any():
        return None
    high, low = rgb.max(axis=-1).astype(np.int16), rgb.min(axis=-1).astype(np.int16)
    rough = np.sqrt(np.maximum(_mean3(grey * grey) - _mean3(grey) ** 2, 0))
    cloud = (low >= _CLOUD_BRIGHT) & (high - low <= _CLOUD_COLOUR) & (rough <= _CLOUD_ROUGH) & ground
    return "cloudy" if cloud.sum() > cloud_share * ground.sum() else None


def tile_fault(
    mask: NDArray[np.uint8],
    rgb: NDArray[np.uint8],
    seen: NDArray[np.bool_],
    min_known_share: float,
    cloud_share: float,
) -> tuple[tuple[float, float], str | None]:
    """((share of building, share of known pixels) of a tile as ``shares``, why it is left out or None).

    It is ``unknown`` where too little is known, ``blank`` and ``cloudy`` as ``picture_fault``; filler is not known.

    Args:
        mask: (h, w) uint8 building mask, 0, 1, 255 = outside the map; sides are multiples of COARSE.
        rgb: (h / COARSE, w / COARSE, 3) uint8, the tile's picture in pixels COARSE times larger.
        seen: (h / COARSE, w / COARSE) bool, where imagery is known.
        min_known_share: the least share of known pixels.
        cloud_share: the largest share of the ground that may be cloud.
    """
    told = seen & (blank_unknown(rgb, np.zeros(seen.shape, np.uint8), 2) != UNKNOWN)
    label = make_label(mask, np.repeat(np.repeat(told, COARSE, axis=0), COARSE, axis=1))
    built, known = shares(label)
    if known < min_known_share or known == 0:
        return (built, known), "blank" if seen.any() and not told.any() else "unknown"
    ground = told & (mask[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE] == 0)
    return (built, known), picture_fault(rgb, told, ground, cloud_share)


def pair_fault(image: NDArray[np.uint8], label: NDArray[np.uint8], cloud_share: float) -> str | None:
    """Why the picture of a foreign pair is left out, as ``picture_fault``; None where it is not.

    Blank as it is, cloudy as the survey of a region sees it: in pixels COARSE times larger.

    Args:
        image: (h, w, 3) uint8 RGB.
        label: (h, w) uint8.
        cloud_share: the largest share of the ground that may be cloud.
    """
    fault = picture_fault(image, label != UNKNOWN)
    rows, cols = (n // COARSE for n in label.shape)
    seen = label[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE][:rows, :cols]
    if fault is not None or not (seen == OTHER).any():
        return fault
    whole = image[: rows * COARSE, : cols * COARSE]
    small = np.asarray(cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return picture_fault(small, seen != UNKNOWN, seen == OTHER, cloud_share)


def _mean3(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over 3 x 3 pixels, edges repeated."""
    padded = np.pad(values, 1, mode="edge")
    h, w = values.shape
    total = sum(padded[r : r + h, c : c + w] for r in range(3) for c in range(3))
    return np.asarray(total / 9.0, dtype=np.float32)


def sample_empty(built: int, empty: Sequence[str], share: float, seed: int = 0) -> set[str]:
    """Which of the tiles without buildings are kept beside ``built`` ones with buildings.

    As many as make up at most ``share`` of all, drawn by name, so that a tile's fate does not hang on the order of work.
    All of them where ``share`` is 1.
    """
    most = len(empty) if share >= 1 else int(share * built / (1 - share) + 1e-9)
    return set(sorted(empty, key=lambda name: rank(name, seed))[:most])


@dataclass(slots=True)
class Tally:
    """Exact counts over tiles; two tallies add up to that of both.

    Attributes:
        tiles, empty: tiles, and those of them without a building.
        building, other, unknown: pixels.
        colour_sum, colour_square: sums over the known pixels of each channel's values 0 to 255 and of their squares.
    """

    tiles: int = 0
    empty: int = 0
    building: int = 0
    other: int = 0
    unknown: int = 0
    colour_sum: tuple[int, int, int] = (0, 0, 0)
    colour_square: tuple[int, int, int] = (0, 0, 0)

    def add(self, image: NDArray[np.uint8], label: NDArray[np.uint8]) -> None:
        """Counts one tile: image (h, w, 3) uint8, label (h, w) uint8."""
        known = label != UNKNOWN
        values = image[known].astype(np.int64)
        built = int((label == BUILDING).sum())
        self.tiles += 1
        self.empty += int(built == 0)
        self.building += built
        self.other += int(known.sum()) - built
        self.unknown += int(label.size - known.sum())
        self.colour_sum = _plus(self.colour_sum, values.sum(axis=0).tolist())
        self.colour_square = _plus(self.colour_square, (values * values).sum(axis=0).tolist())

    def merge(self, others: Iterable[Tally]) -> Tally:
        """Takes others in; returns itself."""
        for other in others:
            self.tiles += other.tiles
            self.empty += other.empty
            self.building += other.building
            self.other += other.other
            self.unknown += other.unknown
            self.colour_sum = _plus(self.colour_sum, other.colour_sum)
            self.colour_square = _plus(self.colour_square, other.colour_square)
        return self

    def colour(self) -> tuple[list[float], list[float]] | None:
        """(mean, standard deviation) of red, green and blue over the known pixels, 0 to 1; None where none is known."""
        known = self.building + self.other
        if not known:
            return None
        mean = [s / known for s in self.colour_sum]
        spread = [max(q / known - m * m, 0.0) ** 0.5 for q, m in zip(self.colour_square, mean, strict=True)]
        return [m / 255 for m in mean], [s / 255 for s in spread]

    def told(self) -> dict[str, Any]:
        """The counts and what follows from them, for tiles.json."""
        known = self.building + self.other
        return {
            "tiles": self.tiles,
            "empty_tiles": self.empty,
            "empty_share": round(self.empty / self.tiles, 4),
            "pixels": {"building": self.building, "other": self.other, "unknown": self.unknown},
            "building_share": round(self.building / known, 6) if known else None,
            # How many other pixels stand against one of a building: the weight that evens them out.
            "other_per_building": round(self.other / self.building, 4) if self.building else None,
            **self.colour_told(),
        }

    def colour_told(self) -> dict[str, list[float] | None]:
        """Mean and standard deviation of each channel, 0 to 1, to six digits; None where no pixel is known."""
        colour = self.colour()
        if colour is None:
            return {"mean": None, "std": None}
        return {"mean": [round(v, 6) for v in colour[0]], "std": [round(v, 6) for v in colour[1]]}


def _plus(a: Sequence[int], b: Sequence[int]) -> tuple[int, int, int]:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
