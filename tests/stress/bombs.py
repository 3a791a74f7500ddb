"""Small files that ask for much: told and refused, or done, within the time and memory of a small file."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
import shapely
from affine import Affine
from arena import FAULTS, Arena
from formats import CRS, LEFT, SMALL, TOP

DEEP = 100_000
Bomb = Callable[[Path, pytest.FixtureRequest], tuple[object, ...]]


def _maps_of(path: Path) -> tuple[object, ...]:
    return ("brmgeo", "maps", "--footprints", path, "--crs", CRS, "--gsd", 2, "--out", path.parent / "out")


def _deep_region(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    (folder / "data/regions").mkdir(parents=True)
    (folder / "data/regions/small.toml").write_text(f"{SMALL}x = {'[' * DEEP}{']' * DEEP}\n")
    return ("brmgeo", "maps", "small", "--data", folder / "data")


def _deep_recipe(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    (folder / "r.toml").write_text(f"x = {'{a=' * DEEP}1{'}' * DEEP}\n")
    return ("recipe", folder / "r.toml")


def _deep_path(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    (folder / "p.geojson").write_text('{"a":' * DEEP + "1" + "}" * DEEP)
    maps = request.getfixturevalue("maps")
    return (
        "brmgeo",
        "simulate",
        "--maps",
        maps,
        "--path",
        folder / "p.geojson",
        "--mode",
        "masks",
        "--out",
        folder / "o",
    )


def _deep_footprints(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    (folder / "p.geojson").write_text(
        '{"type":"FeatureCollection","features":[{"type":"Feature","properties":{},"geometry":{"type":"Polygon",'
        f'"coordinates":{"[" * DEEP}{"]" * DEEP}}}}}]}}'
    )
    return _maps_of(folder / "p.geojson")


def _parquet(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    turn = np.linspace(0, 2 * np.pi, 100_000)
    ring = shapely.Polygon(np.stack([LEFT + 50 * np.cos(turn), TOP + 50 * np.sin(turn)], -1))
    column = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(100, np.int32)), pa.array([shapely.to_wkb(ring)])
    )
    geo = {
        "version": "1.0.0",
        "primary_column": "geometry",
        "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Polygon"], "crs": None}},
    }
    chunks = pa.chunked_array([column.cast(pa.binary())] * 30)
    table = pa.table({"geometry": chunks}).replace_schema_metadata({"geo": json.dumps(geo)})
    pq.write_table(
        table,
        folder / "b.parquet",
        compression="zstd",
        use_dictionary=True,
        dictionary_pagesize_limit=1 << 24,
    )
    return _maps_of(folder / "b.parquet")


def _outline(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    turn = np.linspace(0, 2 * np.pi, 1_000_000, endpoint=False)
    x, y = LEFT + 400 * np.cos(turn), TOP + 400 * np.sin(turn)
    body = "".join(f"0\nVERTEX\n8\nB0014111\n10\n{a:.6f}\n20\n{b:.6f}\n" for a, b in zip(x, y, strict=True))
    (folder / "o.dxf").write_text(
        f"0\nSECTION\n2\nENTITIES\n0\nPOLYLINE\n8\nB0014111\n66\n1\n70\n1\n{body}0\nSEQEND\n0\nENDSEC\n0\nEOF\n"
    )
    return _maps_of(folder / "o.dxf")


def _sparse(path: Path) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=10**6, height=10**6, count=3, dtype="uint8", crs=CRS, tiled=True,
        blockxsize=8192, blockysize=8192, transform=Affine(0.3, 0, LEFT, 0, -0.3, TOP), BIGTIFF="YES", SPARSE_OK=True,
        compress="deflate", photometric="RGB", interleave="pixel",
    ):  # fmt: skip
        pass
    return path


def _raster(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    path = _sparse(folder / "s.tif")
    return (
        "brmgeo",
        "segment",
        path,
        "--weights",
        request.getfixturevalue("weights"),
        "--out",
        folder / "o.tif",
    )


def _imagery(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    from formats import houses

    houses().to_file(folder / "t.gpkg")
    return (*_maps_of(folder / "t.gpkg"), "--imagery", _sparse(folder / "s.tif"))


def _pictures(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    words = ("segment", folder, "--weights", request.getfixturevalue("weights"), "--gsd", 0.3)
    return ("brmgeo", *words, "--out", folder.parent / "masks")


def _png(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    """60 000 x 60 000 pixels of one colour, some 400 kB."""
    side = 60_000
    packer = zlib.compressobj(9)
    row = bytes(1 + side // 8)
    data = b"".join(packer.compress(row) for _ in range(side)) + packer.flush()

    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    (folder / "p.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", data) + part(b"IEND", b"")
    )
    return _pictures(folder, request)


def _jpeg(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    """A head that promises 65 500 x 65 500 pixels."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 65_500, 65_500)
    (folder / "p.jpg").write_bytes(data)
    return _pictures(folder, request)


def _state(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    with (
        zipfile.ZipFile(folder / "s.brm", "w", zipfile.ZIP_DEFLATED) as packed,
        packed.open("header.npy", "w") as part,
    ):
        for _ in range(1000):
            part.write(bytes(1 << 20))
    return ("saved", folder / "s.brm", request.getfixturevalue("maps"))


def _gsd(folder: Path, request: pytest.FixtureRequest) -> tuple[object, ...]:
    from formats import houses

    houses().to_file(folder / "t.gpkg")
    return tuple(0.00001 if w == 2 else w for w in _maps_of(folder / "t.gpkg"))


BOMBS: dict[str, Bomb] = {
    "region TOML 100 000 deep": _deep_region, "recipe TOML 100 000 deep": _deep_recipe,
    "path GeoJSON 100 000 deep": _deep_path,
    "footprints GeoJSON 100 000 deep": _deep_footprints, "GeoParquet of 300 million vertices": _parquet,
    "DXF outline of a million vertices": _outline, "segment of a raster of 10^6 x 10^6": _raster,
    "imagery of 10^6 x 10^6": _imagery, "PNG of 60 000 x 60 000": _png, "JPEG of 65 500 x 65 500": _jpeg,
    "saved state that unpacks to 1 GB": _state, "map of 0.01 mm": _gsd,
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_told_or_done_in_bounds(
    name: str, tmp_path: Path, arena: Arena, request: pytest.FixtureRequest, tally: Callable[..., None]
) -> None:
    folder = tmp_path / "bomb"
    folder.mkdir()
    call, *words = BOMBS[name](folder, request)
    outcome = arena.run(str(call), *words)
    tally("bombs", name, tried=1, **{outcome.kind: 1})
    told = f"{outcome.kind} after {outcome.seconds:.1f} s, {outcome.peak / 2**30:.1f} GiB: {outcome.said[-2000:]}"
    print(told)
    assert outcome.kind not in (*FAULTS, "long"), told
