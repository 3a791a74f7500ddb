"""Tile sources: folders, MBTiles, and a service that misbehaves (a server on the loopback; nothing leaves the machine)."""

from __future__ import annotations

import errno
import io
import logging
import os
import pickle
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from brmgeo.errors import InputError, MissingInputError, NetworkError, SettingsError, WorkflowError
from brmgeo.files import SCRATCH
from brmgeo.geo.tilegrid import KakaoGrid, Tile, WebMercatorGrid
from brmgeo.ingest.tiles import MBTiles, TileFolder, TileService, decode_tile, ensure_tiles

sys.path.insert(0, str(Path(__file__).parent))
from tile_server import TileServer, tile_image, tile_server

GRID = KakaoGrid()
# Four by three tiles of level 3 exactly.
BOUNDS = (*GRID.tile_bounds((2048, 1490), 3)[:2], *GRID.tile_bounds((2051, 1492), 3)[2:])
WANTED = 12


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("no_proxy", "127.0.0.1")


def service(server: TileServer, cache: Path, **changes: Any) -> TileService:
    """A service that retries at once, so that tests are quick."""
    settings: dict[str, Any] = {"rate_per_s": 2000.0, "backoff_s": 0.005, "timeout_s": 2.0, "retries": 4}
    return TileService(f"{server.url}/t/{{z}}/{{x}}/{{y}}.png", GRID, 3, cache, **{**settings, **changes})


def fill(source: Any, **more: Any) -> Any:
    return ensure_tiles(source, BOUNDS, "EPSG:5181", margin_px=0, **more)


def check_all(local: TileFolder) -> None:
    """Every tile is the one that the server has under that name."""
    for tile in GRID.tiles_covering(BOUNDS, 3):
        image = local.read(tile)
        assert image is not None
        want = np.asarray(Image.open(io.BytesIO(tile_image(f"/t/3/{tile.x}/{tile.y}.png"))))
        np.testing.assert_array_equal(image[..., :3], want)
        assert (image[..., 3] == 255).all()


def left_overs(folder: Path) -> list[Path]:
    return [p for p in folder.rglob("*") if p.name.startswith(SCRATCH)]


def test_download_is_complete_and_kept(tmp_path: Path) -> None:
    """All tiles under the grid's own names; progress runs to the end; the second time nothing is asked."""
    seen: list[tuple[int, int]] = []
    with tile_server() as server:
        source = service(server, tmp_path / "c", attribution="© someone")
        local = fill(source, progress=lambda done, total: seen.append((done, total)))
        check_all(local)
        assert (tmp_path / "c/L3/1491/2049.png").is_file()
        assert local.attribution == "© someone"
        assert len(server.paths) == WANTED
        assert seen == [(n, WANTED) for n in range(WANTED + 1)]
        assert fill(source) == local
        assert len(server.paths) == WANTED
    assert not left_overs(tmp_path)


@pytest.mark.parametrize("fault", ["drop", "500", "429", "truncate", "half-image", "junk", "empty", "512px"])
def test_passing_faults_are_retried(tmp_path: Path, fault: str) -> None:
    """Each tile fails twice, then comes: the result is the same as from a good server, and nothing bad was kept."""
    with tile_server(lambda path, attempt: fault if attempt < 2 else "ok") as server:
        check_all(fill(service(server, tmp_path)))
        assert set(server.attempts.values()) == {3}
    assert not left_overs(tmp_path)


@pytest.mark.parametrize("fault", ["stall", "drip"])
def test_a_stalling_server_does_not_hold_us(tmp_path: Path, fault: str) -> None:
    """One tile hangs at first (or sends a byte now and then): its attempt is cut off at the timeout and tried again."""
    slow = "/t/3/2049/1491.png"
    with tile_server(lambda p, n: fault if p == slow and not n else "ok", stall_s=300.0) as server:
        start = time.monotonic()
        check_all(fill(service(server, tmp_path, timeout_s=0.4)))
        assert time.monotonic() - start < 30.0  # far less than the server would take, on a busy machine too
        assert server.attempts[slow] >= 2


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("500", "HTTP 500"),
        ("drop", "connection failed"),
        ("half-image", "damaged"),
        ("junk", "no image"),
        ("512px", "pixel_ratio = 2"),
    ],
)
def test_lasting_faults_are_named_and_resumed(tmp_path: Path, fault: str, words: str) -> None:
    """Two bad tiles: an error counts and names them, the others are kept, a healed server is asked for those two only."""
    bad = {"/t/3/2049/1491.png", "/t/3/2051/1490.png"}
    with tile_server(lambda path, attempt: fault if path in bad else "ok") as server:
        source = service(server, tmp_path, retries=2)
        with pytest.raises(NetworkError, match=f"2 of 12 tiles could not be read.*{words}") as caught:
            fill(source)
        message = str(caught.value)
        assert "L3/1491/2049" in message
        assert "L3/1490/2051" in message
        assert "\n" not in message
        assert all(server.attempts[path] == 3 for path in bad)
        assert sum(1 for _ in tmp_path.rglob("*.png")) == WANTED - 2
        server.behave = lambda path, attempt: "ok"
        server.paths.clear()
        check_all(fill(source))
        assert set(server.paths) == bad
        assert len(server.paths) == 2


def test_retry_after_is_honoured(tmp_path: Path) -> None:
    """After a 429 that asks for a second, nobody asks again before; a wait of hours is not sat out."""
    first = "/t/3/2048/1492.png"
    with tile_server(
        lambda p, n: "429" if p == first and not n else "ok", retry_after="1", delay_s=0.1
    ) as server:
        check_all(fill(service(server, tmp_path / "a", max_connections=2)))
        again = server.times[[i for i, p in enumerate(server.paths) if p == first][1]]
        # One request of the other connection may be under way already when the answer comes.
        assert sum(t < again - 0.01 for t in server.times) <= 3
        assert again - server.times[0] > 0.95
    with tile_server(lambda p, n: "429", retry_after="7200") as server:
        with pytest.raises(NetworkError, match=r"asks to wait 7200 s"):
            fill(service(server, tmp_path / "b", max_connections=1, give_up_after=2))
        assert len(server.times) <= 3


def test_rate_and_connections_are_bounded(tmp_path: Path) -> None:
    """Never more requests at a time than allowed, and over any stretch no more than the rate lets through."""
    with tile_server(delay_s=0.05) as server:
        fill(service(server, tmp_path / "c", max_connections=3))
        assert 2 <= server.open_most <= 3
    with tile_server() as server:
        fill(service(server, tmp_path / "r", rate_per_s=25.0, max_connections=8))
        # Twelve requests leave eleven gaps of 1/25 s; the first may be late to arrive, on a busy machine by a good deal.
        assert server.times[-1] - server.times[0] > 0.3


def test_a_dead_service_is_left_alone(tmp_path: Path) -> None:
    """Nobody listens, or all fails: we stop after a few tiles in a row (one more may be on its way), and hammer no more."""
    with tile_server(lambda p, n: "500") as server:
        with pytest.raises(NetworkError, match=r"12 of 12 .*not asked for after [34] failures in a row"):
            fill(service(server, tmp_path / "a", retries=1, give_up_after=3, max_connections=1))
        assert len(server.paths) <= 2 * 5
    with pytest.raises(NetworkError, match="connection failed"):
        fill(service(server, tmp_path / "b", retries=0))
    assert not left_overs(tmp_path)


def test_tiles_that_do_not_exist(tmp_path: Path) -> None:
    """404 is an answer: asked once, allowed up to the stated share, an error beyond it."""
    gone = {"/t/3/2048/1490.png", "/t/3/2049/1490.png", "/t/3/2050/1490.png"}
    with tile_server(lambda path, attempt: "404" if path in gone else "ok") as server:
        with pytest.raises(MissingInputError, match=r"3 of 12 tiles.*do not exist.*missing_ok"):
            fill(service(server, tmp_path))
        assert all(server.attempts[path] == 1 for path in gone)
        local = fill(service(server, tmp_path, missing_ok=0.25))
        assert all(server.attempts[path] == 1 for path in gone)
        assert local.read(Tile(2048, 1490)) is None
        assert local.read(Tile(2048, 1491)) is not None
        server.behave = lambda path, attempt: "404"
        with pytest.raises(MissingInputError, match="12 of 12"):
            fill(service(server, tmp_path / "none", missing_ok=1.0))


def test_the_key_stays_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It reaches the service in URL and header, and appears in no log, message, value, file or file name."""
    key = "s3cr3t/k+y&x"
    monkeypatch.setenv("MY_TILE_KEY", key)
    for name in ("httpx", "httpcore", "httpcore.http11", "httpcore.connection"):
        monkeypatch.setattr(logging.getLogger(name), "level", logging.DEBUG)
    caplog.set_level(logging.DEBUG)

    def url(server: TileServer) -> str:
        return f"{server.url}/{{key}}/{{z}}/{{x}}/{{y}}.png?k={{key}}"

    shown = []
    with tile_server() as server:
        source = TileService(
            url(server), GRID, 3, tmp_path / "c", rate_per_s=999, key_env="MY_TILE_KEY",
            headers=(("X-Key", "KakaoAK {key}"),),
        )  # fmt: skip
        local = fill(source)
        assert all("/s3cr3t%2Fk%2By%26x/3/" in path for path in server.paths)
        assert all(h["X-Key"] == f"KakaoAK {key}" for h in server.headers)
        shown += [
            repr(source),
            repr(local),
            repr(pickle.dumps(source)),
        ]
        for n, fault in enumerate(("drop", "junk", "500", "403", "stall")):
            server.behave = lambda path, attempt, fault=fault: fault
            poor = TileService(
                url(server), GRID, 3, tmp_path / f"f{n}", rate_per_s=999, backoff_s=0.001, retries=1, timeout_s=0.2,
                key_env="MY_TILE_KEY", give_up_after=2,
            )  # fmt: skip
            with pytest.raises(NetworkError) as caught:
                fill(poor)
            shown.append(str(caught.value))
            if fault == "403":
                assert "refuses: HTTP 403; check your key in MY_TILE_KEY" in str(caught.value)
    shown += [record.getMessage() for record in caplog.records]
    for path in tmp_path.rglob("*"):
        shown.append(str(path))
        if path.is_file():
            shown.append(path.read_bytes().decode("latin-1"))
    assert not [text for text in shown if "s3cr3t" in text]

    monkeypatch.delenv("MY_TILE_KEY")
    with pytest.raises(SettingsError, match="environment variable MY_TILE_KEY"):
        fill(TileService(source.url_template, GRID, 3, tmp_path / "k", key_env="MY_TILE_KEY"))


def test_a_killed_download_resumes(tmp_path: Path) -> None:
    """kill -9 in the middle: what has a tile's name is whole, and the next run fetches only the rest."""
    program = """
import sys
from pathlib import Path
from brmgeo.geo.tilegrid import KakaoGrid
from brmgeo.ingest.tiles import TileService, ensure_tiles
url, cache, *bounds = sys.argv[1:]
source = TileService(url, KakaoGrid(), 3, Path(cache), max_connections=2, rate_per_s=1000)
ensure_tiles(source, tuple(map(float, bounds)), "EPSG:5181", margin_px=0,
             progress=lambda done, total: print(done, flush=True))
"""
    with tile_server(delay_s=0.05) as server:
        source = service(server, tmp_path)
        arguments = [source.url_template, str(tmp_path), *map(str, BOUNDS)]
        with subprocess.Popen(
            [sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True, env={**os.environ}
        ) as run:
            assert run.stdout is not None
            for line in run.stdout:
                if int(line) >= 4:
                    run.send_signal(signal.SIGKILL)
                    break
        kept = [p for p in tmp_path.rglob("*.png") if not p.name.startswith(SCRATCH)]
        assert 4 <= len(kept) < WANTED
        for path in kept:
            decode_tile(path.read_bytes(), 256)
        server.paths.clear()
        # A half tile of a killed writer: never under a tile's name, never taken for one.
        (tmp_path / "L3/1492").mkdir(parents=True, exist_ok=True)
        orphan = tmp_path / f"L3/1492/{SCRATCH}0123.png"
        orphan.write_bytes(tile_image("/x")[:50])
        os.utime(orphan, (1, 1))
        check_all(fill(source))
        assert len(server.paths) == WANTED - len(kept)
        assert not orphan.exists()


def test_one_service_one_cache(tmp_path: Path) -> None:
    """The tiles of two services are never mixed in one folder."""
    with tile_server() as server:
        fill(service(server, tmp_path))
        other = TileService(server.url + "/other/{z}/{x}/{y}.png", GRID, 3, tmp_path)
        with pytest.raises(SettingsError, match="cache folder of its own"):
            fill(other)


def test_a_cache_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk and a folder that is a file end the download in one line, at once, without half tiles."""
    (tmp_path / "file").write_bytes(b"")
    with tile_server() as server:
        with pytest.raises(WorkflowError, match=r"cannot write tile cache .*file"):
            fill(service(server, tmp_path / "file"))
        fill(service(server, tmp_path / "c", missing_ok=1.0))
        for path in (tmp_path / "c").rglob("*.png"):
            path.unlink()
        server.paths.clear()

        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(WorkflowError, match="the disk is full: free some space") as caught:
            fill(service(server, tmp_path / "c", max_connections=2))
        assert "\n" not in str(caught.value)
        assert len(server.paths) <= 4
    assert not list((tmp_path / "c").rglob("*.png"))
    assert not left_overs(tmp_path)


def test_service_settings_are_checked(tmp_path: Path) -> None:
    """Keys in plain text, missing key_env, odd URLs and numbers are refused before anything is asked."""
    for url in (
        "https://a/{z}/{x}/{y}?apikey=abc123",
        "https://a/{z}/{x}/{y}?access_token=abc&x=1",
        "https://a/{z}/{x}/{y}?v=2&sig=abc",
        "https://a/{z}/{x}/{y}?auth=abc",
        "https://a/{z}/{x}/{y}?x=1;subscription-key=abc",
        "https://user:abc@a/{z}/{x}/{y}",
        "https://a/9f86d081884c7d659a2feaabc/{z}/{x}/{y}",
        "https://a/req/wmts/1.0.0/0A1B2C3D-1ABC-2ABC-3ABC-0123456789AB/Satellite/{z}/{y}/{x}.jpeg".lower(),
    ):
        with pytest.raises(SettingsError, match="what looks like a key") as caught:
            TileService(url, GRID, 3, tmp_path)
        assert "abc" not in str(caught.value)
    for url in (
        "https://a/arcgis/rest/services/World_Imagery_2021_12/MapServer/tile/{z}/{y}/{x}",
        "https://xdworld.vworld.kr/2d/Satellite/service/{z}/{x}/{y}.jpeg?signed=no&design=4",
        "https://mts{s}.a/vt/lyrs=s&x={x}&y={y}&z={z}",
        "https://a/styles/satellite-streets-v12/tiles/{z}/{x}/{y}@2x",
    ):
        TileService(url.replace("{s}", "1").replace("signed=no&", ""), GRID, 3, tmp_path)
    TileService("https://a/{z}/{x}/{y}?apikey={key}", GRID, 3, tmp_path, key_env="K")
    with pytest.raises(SettingsError, match="key_env"):
        TileService("https://a/{key}/{z}/{x}/{y}", GRID, 3, tmp_path)
    with pytest.raises(SettingsError, match="http"):
        TileService("ftp://a/{z}/{x}/{y}", GRID, 3, tmp_path)
    with pytest.raises(SettingsError, match=r"\{zoom\}"):
        TileService("https://a/{zoom}/{x}/{y}", GRID, 3, tmp_path)
    with pytest.raises(SettingsError, match="level 15"):
        TileService("https://a/{z}/{x}/{y}", GRID, 15, tmp_path)
    with pytest.raises(SettingsError, match="missing_ok"):
        TileService("https://a/{z}/{x}/{y}", GRID, 3, tmp_path, missing_ok=2)


def test_folder_says_what_is_missing(tmp_path: Path) -> None:
    """No folder, an empty one, one of another level, one named otherwise, a hole: each told apart in one line."""
    folder = TileFolder(tmp_path / "tiles", GRID, 3)
    with pytest.raises(MissingInputError, match=r"12 of 12 tiles.*L3/1492/2048, .*does not exist.*put there"):
        fill(folder)
    folder.root.mkdir()
    with pytest.raises(MissingInputError, match="it holds none;"):
        fill(folder)
    (folder.root / "old").mkdir()
    (folder.root / "old/7.png").write_bytes(tile_image("a"))
    with pytest.raises(MissingInputError, match=r"it holds none, but old/7\.png"):
        fill(folder)
    (folder.root / "L2/2980").mkdir(parents=True)
    (folder.root / "L2/2980/4096.png").write_bytes(tile_image("a"))
    with pytest.raises(MissingInputError, match=r"there are 1 of level 2 \(x 4096-4096, y 2980-2980\)"):
        fill(folder)
    for tile in GRID.tiles_covering(BOUNDS, 3)[1:]:
        path = folder.root / GRID.path(tile, 3, "jpg")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((256, 256, 3), tile.x % 256, np.uint8)).save(path)
    with pytest.raises(MissingInputError, match=r"1 of 12 .*L3/1492/2048; x 2048-2048, y 1492-1492"):
        fill(folder)
    assert fill(folder, missing_ok=0.1) is folder
    own = TileFolder(folder.root, GRID, 3, template="L{z}/{y}/{x}.jpg")
    assert fill(own, missing_ok=0.1) is own


def test_bad_tiles_are_named(tmp_path: Path) -> None:
    """A corrupt, an empty, a wrongly sized and a 16-bit tile are refused by name; transparency is kept."""
    folder = TileFolder(tmp_path, GRID, 3)
    path = tmp_path / "L3/5/6.png"
    path.parent.mkdir(parents=True)
    good = tile_image("a")
    for data, words in (
        (good[: len(good) // 2], "damaged"),
        (b"", "empty"),
        (b"<html>", "no image"),
        (tile_image("a", 512), "512 x 512 px, wanted 256 x 256"),
        (tile_image("a", 100), "100 x 100 px"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"6\.png.*{words}") as caught:
            folder.read(Tile(6, 5))
        assert "\n" not in str(caught.value)
    Image.fromarray(np.zeros((256, 256), np.uint16)).save(path)
    with pytest.raises(InputError, match="16-bit"):
        folder.read(Tile(6, 5))
    for channels in (3, 4):  # which Pillow opens as 8-bit colours
        path.write_bytes(cv2.imencode(".png", np.full((256, 256, channels), 1700, np.uint16))[1].tobytes())
        with pytest.raises(InputError, match="16-bit"):
            folder.read(Tile(6, 5))
    Image.fromarray(np.zeros((256, 256), np.uint8)).save(path.with_suffix(".gif"))
    path.write_bytes(path.with_suffix(".gif").read_bytes())
    with pytest.raises(InputError, match="GIF, not PNG"):
        folder.read(Tile(6, 5))
    rgba = np.random.default_rng(0).integers(0, 255, (256, 256, 4)).astype(np.uint8)
    Image.fromarray(rgba).save(path)
    np.testing.assert_array_equal(folder.read(Tile(6, 5)), rgba)
    assert folder.read(Tile(7, 5)) is None


def make_mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **meta: str) -> None:
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        db.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        db.executemany("INSERT INTO metadata VALUES (?, ?)", meta.items())
        db.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", [(*k, v) for k, v in tiles.items()])
        db.commit()


def test_mbtiles(tmp_path: Path) -> None:
    """Rows count from the south (or as the metadata says); levels, formats and damage are checked."""
    grid = WebMercatorGrid()
    x, y = 224803, 101420
    south = (1 << 18) - 1 - y
    make_mbtiles(tmp_path / "a.mbtiles", {(18, x, south): tile_image("n"), (17, 1, 1): tile_image("m")},
                 format="png", attribution="<a href='x'>someone</a>")  # fmt: skip
    source = MBTiles.open(tmp_path / "a.mbtiles")
    assert source.level == 18
    assert source.attribution == "someone"
    image = source.read(Tile(x, y))
    assert image is not None
    np.testing.assert_array_equal(image, decode_tile(tile_image("n"), 256)[0])
    assert source.read(Tile(x, y + 1)) is None
    assert pickle.loads(pickle.dumps(source)) == source
    inside = grid.tile_bounds((x, y), 18)
    assert ensure_tiles(source, inside, "EPSG:3857", margin_px=0) is source
    beside = grid.tile_bounds((x + 1, y), 18)
    with pytest.raises(MissingInputError, match=r"1 of 1 tiles at level 18.*a\.mbtiles"):
        ensure_tiles(source, beside, "EPSG:3857")
    with pytest.raises(InputError, match="level 3: give one of 17, 18"):
        MBTiles.open(tmp_path / "a.mbtiles", level=3)

    make_mbtiles(tmp_path / "x.mbtiles", {(18, x, y): tile_image("n")}, scheme="xyz")
    assert MBTiles.open(tmp_path / "x.mbtiles").has(Tile(x, y))
    make_mbtiles(tmp_path / "v.mbtiles", {(1, 0, 0): b"x"}, format="pbf")
    with pytest.raises(InputError, match="vector"):
        MBTiles.open(tmp_path / "v.mbtiles")
    make_mbtiles(tmp_path / "e.mbtiles", {})
    with pytest.raises(InputError, match="no tile at all"):
        MBTiles.open(tmp_path / "e.mbtiles")
    (tmp_path / "junk.mbtiles").write_bytes(b"junk" * 1000)
    with pytest.raises(InputError, match=r"junk\.mbtiles is no readable MBTiles"):
        MBTiles.open(tmp_path / "junk.mbtiles")
    with pytest.raises(MissingInputError, match=r"no\.mbtiles"):
        MBTiles.open(tmp_path / "no.mbtiles")


@pytest.mark.parametrize("value", ["text", 1.5, 7])
def test_a_tile_of_mbtiles_that_is_no_blob_is_named(tmp_path: Path, value: object) -> None:
    make_mbtiles(tmp_path / "a.mbtiles", {(2, 1, 1): tile_image("a")})
    with closing(sqlite3.connect(tmp_path / "a.mbtiles")) as db, db:
        db.execute("UPDATE tiles SET tile_data = ?", (value,))
    source = MBTiles.open(tmp_path / "a.mbtiles")
    with pytest.raises(InputError, match=r"^tile 2/1/2 in .*a\.mbtiles: it is (str|float|int) .*, no image"):
        source.read(Tile(1, 2))


@pytest.mark.parametrize("level", ["x", 1.5, -1, 99])
def test_a_level_of_mbtiles_that_is_none_is_said(tmp_path: Path, level: object) -> None:
    make_mbtiles(tmp_path / "a.mbtiles", {(2, 1, 1): tile_image("a")})
    with closing(sqlite3.connect(tmp_path / "a.mbtiles")) as db, db:
        db.execute("UPDATE tiles SET zoom_level = ?", (level,))
    with pytest.raises(InputError, match="is no zoom level"):
        MBTiles.open(tmp_path / "a.mbtiles")
