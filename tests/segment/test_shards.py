"""Training tiles on disk: what is written is read back, tar reads it without brmgeo, and damage is refused in one line."""

from __future__ import annotations

import json
import math
import pickle
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError
from brmgeo.segment.shards import (
    COLUMNS,
    INDEX_CSV,
    ShardWriter,
    TileInfo,
    check_label,
    entry_row,
    read_tiles,
    write_index,
)

U8 = NDArray[np.uint8]


def pairs(count: int = 7) -> list[tuple[TileInfo, U8, U8]]:
    rng = np.random.default_rng(8)
    found = []
    for i in range(count):
        size = (64, 96) if i % 2 else (64, 64)
        place = (500.25 + i, 100.0, 516.25 + i, 116.0) if i != 3 else (math.nan,) * 4
        info = TileInfo(
            key=f"r-0250-{i:05d}",
            shard=0,
            gsd_m=0.25,
            split=("train", "test")[i % 2],
            region="r",
            building_share=0.1 * i,
            known_share=1.0,
            bounds=place,
            crs="EPSG:5187" if i != 3 else "",
        )
        smooth = cv2.resize(
            rng.integers(0, 255, (8, 8, 3), dtype=np.uint8), size[::-1], interpolation=cv2.INTER_CUBIC
        )
        found.append((info, smooth, rng.choice(np.array([0, 127, 255], np.uint8), size)))
    return found


def write(folder: Path, tiles: list[tuple[TileInfo, U8, U8]], shards: int = 2, kind: str = "png") -> Path:
    folder.mkdir()
    rows, listed = [], []
    for number in range(shards):
        path = folder / f"r-{number}.tar"
        with ShardWriter(path, image_format=kind) as shard:  # type: ignore[arg-type]
            for tile in tiles[number::shards]:
                shard.add(*tile)
        rows += [entry_row(entry, number) for entry in shard.entries]
        listed.append({"file": path.name, "size": path.stat().st_size, "tiles": len(shard.entries)})
    write_index(folder / INDEX_CSV, rows)
    facts = {"format": "brmgeo-tiles", "version": 1, "tiles": len(rows), "shards": listed}
    (folder / "tiles.json").write_text(json.dumps(facts), encoding="utf-8")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write(tmp_path / "tiles", pairs())


def test_what_was_written_is_read_back(folder: Path) -> None:
    tiles = pickle.loads(pickle.dumps(read_tiles(folder)))
    expected = {info.key: (info, image, label) for info, image, label in pairs()}
    assert len(tiles) == len(tiles.infos) == 7
    for i, info in enumerate(tiles.infos):
        own, image, label = expected[info.key]
        assert (info.gsd_m, info.split, info.region, info.crs) == (own.gsd_m, own.split, own.region, own.crs)
        assert info.building_share == own.building_share
        assert info.bounds == own.bounds or (math.isnan(info.bounds[0]) and math.isnan(own.bounds[0]))
        got = tiles.read(i)
        np.testing.assert_array_equal(got[0], image)
        np.testing.assert_array_equal(got[1], label)
    assert sorted(tiles.of_split("train") + tiles.of_split("test")) == list(range(7))
    assert all(tiles.infos[i].split == "test" for i in tiles.of_split("test"))


def test_jpeg_is_near_and_its_labels_exact(tmp_path: Path) -> None:
    tiles = read_tiles(write(tmp_path / "tiles", pairs(), kind="jpg"))
    expected = {info.key: (image, label) for info, image, label in pairs()}
    for i, info in enumerate(tiles.infos):
        image, label = tiles.read(i)
        error = image.astype(float) - expected[info.key][0]
        assert np.sqrt((error**2).mean()) < 3
        np.testing.assert_array_equal(label, expected[info.key][1])


def test_tar_alone_reads_the_shards(folder: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.mkdir()
    for shard in sorted(folder.glob("*.tar")):
        subprocess.run(["tar", "xf", str(shard), "-C", str(plain)], check=True)
    for info, image, label in pairs():
        bgr = cv2.imread(str(plain / f"{info.key}.png"))
        np.testing.assert_array_equal(bgr[..., ::-1], image)
        np.testing.assert_array_equal(cv2.imread(str(plain / f"{info.key}.label.png"), -1), label)
        facts = json.loads((plain / f"{info.key}.json").read_text())
        assert facts["split"] == info.split
        assert (
            facts["bounds"] == (None if not info.crs else list(info.bounds)) or facts["bounds"] == [None] * 4
        )
    assert len(list(plain.iterdir())) == 21


def test_same_tiles_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = write(tmp_path / "again", pairs())
    for path in folder.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()


def damaged(folder: Path, what: str) -> None:
    if what == "no folder":
        (folder / "tiles.json").unlink()
    elif what == "not json":
        (folder / "tiles.json").write_text("{")
    elif what == "foreign":
        (folder / "tiles.json").write_text('{"format": "coco"}')
    elif what == "version":
        text = json.loads((folder / "tiles.json").read_text()) | {"version": 2}
        (folder / "tiles.json").write_text(json.dumps(text))
    elif what == "no index":
        (folder / INDEX_CSV).unlink()
    elif what == "index header":
        (folder / INDEX_CSV).write_text("key,shard\n")
    elif what == "index row":
        text = (folder / INDEX_CSV).read_text().replace(",0.25,", ",a quarter,", 1)
        (folder / INDEX_CSV).write_text(text)
    elif what == "index bytes":
        data = (folder / INDEX_CSV).read_bytes()
        (folder / INDEX_CSV).write_bytes(data.replace(b",0.25,", b",\xff\xfe,", 1))
    elif what in ("offset", "size"):
        lines = (folder / INDEX_CSV).read_text().splitlines(keepends=True)
        row = lines[1].split(",")
        column = COLUMNS.index(f"image_{what}")
        row[column] = {"offset": "-1", "size": str(10**15)}[what]
        (folder / INDEX_CSV).write_text("".join([lines[0], ",".join(row), *lines[2:]]))
    elif what == "index short":
        lines = (folder / INDEX_CSV).read_text().splitlines(keepends=True)
        (folder / INDEX_CSV).write_text("".join(lines[:-1]))
    elif what == "shard gone":
        (folder / "r-1.tar").unlink()
    elif what == "shard short":
        (folder / "r-1.tar").write_bytes((folder / "r-1.tar").read_bytes()[:-512])
    elif what == "shards list":
        text = json.loads((folder / "tiles.json").read_text()) | {"shards": ["r-1.tar"]}
        (folder / "tiles.json").write_text(json.dumps(text))
    else:
        raise AssertionError(what)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no folder", "holds no training tiles"),
        ("not json", "cannot be read"),
        ("foreign", "not the tiles.json of training tiles"),
        ("version", "version 2, this brmgeo reads version 1"),
        ("no index", "is not there"),
        ("index header", "not the index of training tiles"),
        ("index row", "line 2"),
        ("index bytes", "line 2"),
        ("offset", "lies at byte -1"),
        ("size", "1000000000000000 bytes, its shard has"),
        ("index short", "lists 6 tiles"),
        ("shard gone", "is not there"),
        ("shard short", "bytes are recorded"),
        ("shards list", "list of shards is damaged"),
    ],
)
def test_damage_is_refused_in_one_line(folder: Path, what: str, said: str) -> None:
    damaged(folder, what)
    with pytest.raises(InputError, match=said) as error:
        read_tiles(folder)
    assert "\n" not in str(error.value)
    assert (what == "no folder") == isinstance(error.value, MissingInputError)


def test_a_flipped_byte_is_found_when_its_tile_is_read(folder: Path) -> None:
    tiles = read_tiles(folder)
    data = bytearray((folder / "r-0.tar").read_bytes())
    data[512 + 200] ^= 0xFF  # within the first image
    (folder / "r-0.tar").write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"tile r-0250-00000 is damaged"):
        tiles.read(0)
    tiles.read(1)


def test_masks_of_others_become_labels() -> None:
    assert check_label(np.array([[0, 1]]), "m").tolist() == [[0, 255]]
    assert check_label(np.array([[0, 255, 127]]), "m").tolist() == [[0, 255, 127]]
    grey = np.repeat(np.array([[[0], [255]]], np.uint8), 3, axis=2)
    assert check_label(grey, "m").tolist() == [[0, 255]]
    with pytest.raises(InputError, match="holds the value 7"):
        check_label(np.array([[0, 7]]), "m")
    with pytest.raises(InputError, match="one band"):
        check_label(np.dstack([grey[..., 0], grey[..., 0], 255 - grey[..., 0]]), "m")
