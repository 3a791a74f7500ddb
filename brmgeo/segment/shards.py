"""Training tiles on disk: a few large tar files, an index as CSV, and tiles.json; readable without brmgeo.

A folder of tiles holds

- ``*.tar``: uncompressed shards. Each tile is three files: ``KEY.jpg`` or ``KEY.png`` (RGB), ``KEY.label.png`` (8 bit:
  0 other, 255 building, 127 unknown) and ``KEY.json`` (what the index says of it). ``tar xf`` unpacks them; loaders of the
  WebDataset kind read them as they are.
- ``index.csv``: one row a tile with its place, split and shares, and the byte offset, size and CRC-32 of its image and label
  within its shard, for reading any tile without reading the others.
- ``tiles.json``: counts, statistics, attribution, the shards with their sizes, format and version.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import tarfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_OTHER as OTHER
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import InputError, MissingInputError
from brmgeo.files import json_of, told
from brmgeo.pictures import decode, encode
from brmgeo.segment import SPLITS

FORMAT, VERSION = "brmgeo-tiles", 1
TILES_JSON, INDEX_CSV = "tiles.json", "index.csv"
JPEG_QUALITY = 95
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 6)
ImageFormat = Literal["jpg", "png"]

COLUMNS = (
    "key", "shard", "region", "split", "gsd_m", "building_share", "known_share", "left", "bottom", "right", "top", "crs",
    "image_name", "image_offset", "image_size", "image_crc32", "label_offset", "label_size", "label_crc32",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TileInfo:
    """What the index says of one training tile.

    Attributes:
        key: its name, unique in the folder.
        shard: number of its shard, from 0 in the order of tiles.json.
        gsd_m: metres per pixel.
        split: ``train``, ``validation`` or ``test``.
        region: where it was cut.
        building_share: of its known pixels, 0 to 1.
        known_share: of all its pixels, 0 to 1.
        bounds: (left, bottom, right, top) in ``crs``; NaN where nobody knows its place.
        crs: such as EPSG:5187, empty where nobody knows its place.
    """

    key: str
    shard: int
    gsd_m: float
    split: str
    region: str
    building_share: float
    known_share: float
    bounds: tuple[float, float, float, float]
    crs: str


@dataclass(frozen=True, slots=True)
class _Place:
    """Where an image and its label lie within their shard."""

    image_name: str
    image_offset: int
    image_size: int
    image_crc32: int
    label_offset: int
    label_size: int
    label_crc32: int


Entry = tuple[TileInfo, _Place]


class ShardWriter:
    """Writes one shard; the same tiles give the same bytes. Use as a context manager; ``entries`` are its index rows."""

    def __init__(self, path: Path, number: int = 0, image_format: ImageFormat = "jpg") -> None:
        self.entries: list[Entry] = []
        self._number = number
        self._suffix = image_format
        self._file = path.open("wb")
        self._tar = tarfile.open(fileobj=self._file, mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._tar.close()
        self._file.close()

    def add(self, info: TileInfo, image: NDArray[np.uint8], label: NDArray[np.uint8]) -> None:
        """Appends a tile: image (h, w, 3) uint8 RGB, label (h, w) uint8 of the three label values."""
        picture = encode_image(image, self._suffix)
        mask = encode_label(label)
        name = f"{info.key}.{self._suffix}"
        at_image = self._append(name, picture)
        at_label = self._append(f"{info.key}.label.png", mask)
        facts = {
            "region": info.region, "split": info.split, "gsd_m": info.gsd_m, "building_share": info.building_share,
            "known_share": info.known_share, "bounds": [_or_none(v) for v in info.bounds], "crs": info.crs,
        }  # fmt: skip
        self._append(f"{info.key}.json", json.dumps(facts, ensure_ascii=False).encode())
        place = _Place(
            name, at_image, len(picture), zlib.crc32(picture), at_label, len(mask), zlib.crc32(mask)
        )
        self.entries.append((replace(info, shard=self._number), place))

    def _append(self, name: str, data: bytes) -> int:
        member = tarfile.TarInfo(name)
        member.size, member.mode, member.mtime = len(data), 0o644, 0
        self._tar.addfile(member, io.BytesIO(data))
        # A tar pads each file to 512 bytes; its data begins one header before the padded end.
        return self._tar.offset - -(-len(data) // 512) * 512


def encode_image(image: NDArray[np.uint8], image_format: ImageFormat) -> bytes:
    """JPEG (quality 95, colour at full size) or PNG of (h, w, 3) uint8 RGB."""
    if image_format == "png":
        return encode(image, options=_PNG)
    full = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    return encode(image, ".jpg", quality=JPEG_QUALITY, options=full)


def encode_label(label: NDArray[np.uint8]) -> bytes:
    """PNG of (h, w) uint8."""
    return encode(label, options=_PNG)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- the index -------------------------------------------------------------------------------------------------


def entry_row(entry: Entry, shard: int | None = None) -> dict[str, Any]:
    """The row of index.csv of an entry, under another shard number where one is given."""
    info, place = entry
    left, bottom, right, top = info.bounds
    values = (
        info.key, info.shard if shard is None else shard, info.region, info.split, info.gsd_m, info.building_share,
        info.known_share, *(_or_none(v) for v in (left, bottom, right, top)), info.crs, place.image_name, place.image_offset,
        place.image_size, place.image_crc32, place.label_offset, place.label_size, place.label_crc32,
    )  # fmt: skip
    return dict(zip(COLUMNS, values, strict=True))


def write_index(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes index.csv of ``entry_row`` rows."""
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        out.writeheader()
        out.writerows(
            {n: "" if v is None else repr(v) if isinstance(v, float) else v for n, v in row.items()}
            for row in rows
        )


def _read_index(path: Path) -> Iterator[tuple[TileInfo, _Place]]:
    # Bytes that are no text become marks that fit no number and no name.
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        reader = csv.reader(file)
        if tuple(next(reader, ())) != COLUMNS:
            raise InputError(
                f"{path}: is not the index of training tiles of version {VERSION}; cut the tiles again"
            )
        for number, row in enumerate(reader, start=2):
            try:
                place = [float(v) if v else math.nan for v in row[7:11]]
                yield (
                    TileInfo(
                        key=row[0], shard=int(row[1]), region=row[2], split=row[3], gsd_m=float(row[4]),
                        building_share=float(row[5]), known_share=float(row[6]),
                        bounds=(place[0], place[1], place[2], place[3]), crs=row[11],
                    ),
                    _Place(row[12], *(int(v) for v in row[13:19])),
                )  # fmt: skip
            except (ValueError, IndexError, TypeError, OverflowError):
                raise InputError(f"{path}, line {number}: is damaged; cut the tiles again") from None


class TileSet:
    """Training tiles of one folder: ``len``, ``infos`` in the order of the index, ``read``; see ``read_tiles``.

    Travels to worker processes and may be read from several threads: nothing stays open.

    Attributes:
        folder: where it was read.
        infos: one TileInfo a tile.
        facts: tiles.json as a dict.
    """

    def __init__(
        self, folder: Path, infos: list[TileInfo], places: list[_Place], facts: dict[str, Any]
    ) -> None:
        self.folder = folder
        self.infos = infos
        self.facts = facts
        self._places = places
        self._shards = [str(shard["file"]) for shard in facts["shards"]]

    def __len__(self) -> int:
        return len(self.infos)

    def of_split(self, split: str) -> list[int]:
        """Numbers of the tiles of a split (``train``, ``validation``, ``test``)."""
        return [i for i, info in enumerate(self.infos) if info.split == split]

    def digest(self, chosen: Sequence[int]) -> bytes:
        """SHA-256 of what the index says of the tiles ``chosen``, the checksums of their images and labels with it."""
        rows = [entry_row((self.infos[i], self._places[i])) for i in chosen]
        return hashlib.sha256(json.dumps(rows).encode()).digest()

    def read(self, i: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """(image (h, w, 3) uint8 RGB, label (h, w) uint8) of tile ``i``.

        Raises InputError where the shard is damaged or gone, IndexError for a tile that is not there.
        """
        info, place = self.infos[i], self._places[i]
        path = self.folder / self._shards[info.shard]
        try:
            file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({told(error)}); cut the tiles again") from None
        try:
            picture = os.pread(file, place.image_size, place.image_offset)
            mask = os.pread(file, place.label_size, place.label_offset)
        finally:
            os.close(file)
        if zlib.crc32(picture) != place.image_crc32 or zlib.crc32(mask) != place.label_crc32:
            raise InputError(
                f"{path}: tile {info.key} is damaged or not the one of {INDEX_CSV}; cut the tiles again"
            )
        name = f"{path}: tile {info.key}"
        image, label = decode(picture, name, flags=cv2.IMREAD_COLOR), decode(mask, name)
        if label.ndim != 2 or image.shape[:2] != label.shape:
            raise InputError(f"{name} is not an image with a label of its size; cut the tiles again")
        return image, np.asarray(label, dtype=np.uint8)


def read_tiles(folder: Path | str) -> TileSet:
    """The training tiles in a folder with tiles.json.

    Raises MissingInputError where there are none, InputError (one line) for another format or version, a damaged index,
    or shards that are gone or of another size than recorded.
    """
    folder = Path(folder)
    path = folder / TILES_JSON
    if not path.is_file():
        raise MissingInputError(
            f"{folder}: holds no training tiles ({TILES_JSON} is not there); name another folder, or cut them first"
        )
    try:
        facts = json_of(path.read_bytes())
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: cannot be read ({' '.join(str(error).split())[:120]}); cut the tiles again"
        ) from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise InputError(
            f"{path}: is not the tiles.json of training tiles (format {FORMAT}); name another folder"
        )
    if facts.get("version") != VERSION:
        raise InputError(
            f"{path}: training tiles of version {facts.get('version')}, this brmgeo reads version {VERSION}; cut them again"
        )
    index = folder / INDEX_CSV
    if not index.is_file():
        raise InputError(f"{index}: is not there; cut the tiles again")
    shards = facts.get("shards")
    if not isinstance(shards, list) or not all(
        isinstance(s, dict) and {"file", "size"} <= s.keys() and type(s["size"]) is int for s in shards
    ):
        raise InputError(f"{path}: its list of shards is damaged; cut the tiles again")
    for shard in shards:
        file = folder / Path(str(shard["file"])).name
        size = file.stat().st_size if file.is_file() else None
        if size != shard["size"]:
            found = "is not there" if size is None else f"has {size} bytes"
            raise InputError(f"{file}: {found}, {shard['size']} bytes are recorded; cut the tiles again")
    infos, places = [], []
    for info, place in _read_index(index):
        if not 0 <= info.shard < len(shards) or info.split not in SPLITS:
            raise InputError(
                f"{index}: tile {info.key} names shard {info.shard}, split {info.split}; cut the tiles again"
            )
        most = int(shards[info.shard]["size"])
        for offset, size in ((place.image_offset, place.image_size), (place.label_offset, place.label_size)):
            if not (offset >= 0 and 0 < size <= most - offset):
                raise InputError(
                    f"{index}: tile {info.key} lies at byte {offset} with {size} bytes, its shard has {most}; "
                    "cut the tiles again"
                )
        infos.append(info)
        places.append(place)
    if len(infos) != facts.get("tiles"):
        raise InputError(
            f"{index}: lists {len(infos)} tiles, {TILES_JSON} {facts.get('tiles')}; cut the tiles again"
        )
    return TileSet(folder, infos, places, facts)


def check_label(label: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """(h, w) uint8 label of a mask picture as others write them: 0/1, 0/255, with 127 for unknown where it holds 255.

    Raises InputError for other values or a picture that is not of one band.
    """
    if label.ndim == 3 and (label[..., :1] == label[..., :3]).all():
        label = label[..., 0]
    if label.ndim != 2:
        raise InputError(
            f"{name}: a mask has one band, this one has {label.shape[-1]} that differ; give masks of 0 and 255"
        )
    values = set(np.unique(label).tolist())
    if values <= {0, 1}:
        return np.where(label == 1, BUILDING, OTHER).astype(np.uint8)
    if values <= {OTHER, UNKNOWN, BUILDING}:
        return label.astype(np.uint8)
    odd = sorted(values - {OTHER, UNKNOWN, BUILDING})[:3]
    raise InputError(
        f"{name}: holds the value {odd[0]}; a mask is 0 (other), 255 or 1 (building) and 127 (unknown)"
    )
