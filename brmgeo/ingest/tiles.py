"""Imagery tiles in: a folder of tiles, an MBTiles file, or a tile service read politely into a local cache.

Sources are plain values (they travel to worker processes); none of them touches a network but ``ensure_tiles`` on a
``TileService``, which the user must have named. What a service is asked for is bounded: connections, rate, retries with
exponential backoff and jitter that honour ``Retry-After``. A tile is kept only after its image decoded completely, by an
atomic rename, so a killed download resumes where it was and a half tile is never trusted. Tiles that
could not be had are counted and named, never papered over.

The user's key for a service comes from an environment variable and replaces ``{key}`` in the URL or the headers at the
last moment: it is in no value, message, log, cache path or provenance.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import random
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote, urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from brmgeo import files
from brmgeo.errors import InputError, MissingInputError, NetworkError, SettingsError, WorkflowError
from brmgeo.extras import extra
from brmgeo.geo.grid import Bounds
from brmgeo.geo.tilegrid import Tile, TileGrid, WebMercatorGrid

with extra("maps", "reading tile services"):
    import httpx

Progress = Callable[[int, int], None]

EXTENSIONS = ("png", "jpg", "jpeg", "webp")
_FORMATS = {"PNG": "png", "JPEG": "jpg", "WEBP": "webp"}
_ABSENT = "absent"
_MAX_TILE_BYTES = 16 << 20
_RETRY_STATUS = {408, 425, 429, 500, 502, 503, 504}
_ABSENT_STATUS = {204, 404, 410}
_LONGEST_WAIT_S = 120.0
# A key typed into a URL would go into provenance: a user's name and password, query parameters whose names say that they
# carry one, and what no person writes: twenty letters and digits in a row, or the groups of a UUID (VWorld's keys).
_KEYS_IN_URLS = re.compile(
    r"://[^/?#]*@"
    r"|[?&;](?:[\w.-]*(?:key|token|secret|signature|auth|pass|credential|session)\w*|sig|sign|pwd?|jwt)=(?!\{key\})[^&;{}]+"
    r"|(?<![A-Za-z0-9])(?=[A-Za-z]*[0-9])(?=[0-9]*[A-Za-z])(?=(?:[A-Za-z]*[0-9]){3})[A-Za-z0-9]{20,}"
    r"|[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}",
    re.IGNORECASE,
)


class TileSource(Protocol):
    """Tiles that are on this machine: what imagery is made of."""

    @property
    def grid(self) -> TileGrid: ...
    @property
    def level(self) -> int: ...
    @property
    def pixel_ratio(self) -> int: ...
    @property
    def attribution(self) -> str: ...
    @property
    def terms(self) -> str: ...
    @property
    def where(self) -> str:
        """What to call the source in a message."""
        ...

    def has(self, tile: Tile) -> bool:
        """Whether the tile is there (not whether it is whole)."""
        ...

    def read(self, tile: Tile) -> NDArray[np.uint8] | None:
        """(n, n, 4) uint8 RGBA with n = 256 * pixel_ratio, or None where there is no tile; InputError for a bad one."""
        ...


@dataclass(frozen=True, slots=True)
class TileFolder:
    """A folder of image tiles (PNG, JPEG or WebP) named by ``template`` (default: the grid's own) under ``root``.

    ``pixel_ratio`` 2 states "retina" tiles of 512 px on the same grid.
    """

    root: Path
    grid: TileGrid
    level: int
    template: str | None = None
    attribution: str = ""
    terms: str = ""
    pixel_ratio: int = 1

    def __post_init__(self) -> None:
        self.grid.check_level(self.level)

    @property
    def where(self) -> str:
        return (
            f"{self.root} ({self.template or self.grid.template}, {self.grid.name} grid, level {self.level})"
        )

    def file(self, tile: Tile) -> Path | None:
        """The tile's file, or None where there is none."""
        template = self.template or self.grid.template
        if "{ext}" not in template and Path(template).suffix.lower().lstrip(".") in EXTENSIONS:
            path = self.root / self.grid.path(tile, self.level, "", template)
            return path if path.is_file() else None
        for ext in EXTENSIONS:
            path = self.root / self.grid.path(tile, self.level, ext, template)
            if path.is_file():
                return path
        return None

    def has(self, tile: Tile) -> bool:
        return self.file(tile) is not None

    def read(self, tile: Tile) -> NDArray[np.uint8] | None:
        path = self.file(tile)
        if path is None:
            return None
        try:
            return decode_tile(path.read_bytes(), self.grid.tile_px * self.pixel_ratio)[0]
        except ValueError as error:
            raise InputError(f"tile {path}: {error}; replace the file, or delete it to do without") from None
        except OSError as error:
            raise InputError(f"tile {path} cannot be read: {files.told(error)}") from None

    def held(self, most: int = 200_000) -> dict[int, tuple[int, Tile, Tile]]:
        """Level -> (number of tiles, smallest x and y, largest x and y) of the first ``most`` files under ``root``."""
        out: dict[int, tuple[int, Tile, Tile]] = {}
        for number, path in enumerate(_image_files(self.root)):
            if number >= most:
                break
            found = self.grid.tile_from_path(path.relative_to(self.root).as_posix(), self.template)
            if found is not None:
                tile, z = found
                n, low, high = out.get(z, (0, tile, tile))
                low = Tile(min(low.x, tile.x), min(low.y, tile.y))
                high = Tile(max(high.x, tile.x), max(high.y, tile.y))
                out[z] = (n + 1, low, high)
        return out


@dataclass(frozen=True, slots=True)
class MBTiles:
    """An MBTiles file (SQLite, web mercator, rows counted from the south unless its metadata says ``xyz``)."""

    path: Path
    level: int
    attribution: str = ""
    terms: str = ""
    pixel_ratio: int = 1
    xyz_rows: bool = False
    grid: TileGrid = field(default_factory=WebMercatorGrid)

    @classmethod
    def open(cls, path: Path, level: int | None = None, pixel_ratio: int = 1) -> MBTiles:
        """Read the file's metadata; ``level`` defaults to its finest. InputError for no, or not an image, MBTiles."""
        if not Path(path).is_file():
            raise MissingInputError(f"there is no MBTiles file {path}")
        with _sqlite(path) as db:
            meta = {str(k): str(v) for k, v in db.execute("SELECT name, value FROM metadata")}
            levels = [z for (z,) in db.execute("SELECT DISTINCT zoom_level FROM tiles ORDER BY zoom_level")]
        if meta.get("format", "png").lower() == "pbf":
            raise InputError(
                f"{path} holds vector tiles (pbf): give an MBTiles file of images (png, jpg or webp)"
            )
        if not levels:
            raise InputError(f"{path} holds no tile at all: make it again")
        odd = [z for z in levels if not (isinstance(z, int) and 0 <= z <= 30)]
        if odd:
            raise InputError(f"{path}: {odd[0]!r} is no zoom level: the file is damaged, make it again")
        if level is not None and level not in levels:
            raise InputError(
                f"{path} has no tiles at level {level}: give one of {', '.join(map(str, levels))}"
            )
        xyz = meta.get("scheme", "tms").lower() == "xyz"
        attribution = re.sub(r"<[^>]*>", "", meta.get("attribution", ""))
        return cls(Path(path), levels[-1] if level is None else level, attribution, "", pixel_ratio, xyz)

    @property
    def where(self) -> str:
        return f"{self.path} (level {self.level})"

    def _row(self, tile: Tile, column: str) -> Any:
        y = tile.y if self.xyz_rows else self.grid.flipped(tile, self.level).y
        with _sqlite(self.path) as db:
            query = f"SELECT {column} FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
            row = db.execute(query, (self.level, tile.x, y)).fetchone()
        return None if row is None else row[0]

    def has(self, tile: Tile) -> bool:
        return self._row(tile, "1") is not None

    def read(self, tile: Tile) -> NDArray[np.uint8] | None:
        data = self._row(tile, "tile_data")
        if data is None:
            return None
        try:
            if not isinstance(data, bytes):
                raise ValueError(f"it is {type(data).__name__} {data!r:.40}, no image")
            return decode_tile(data, self.grid.tile_px * self.pixel_ratio)[0]
        except ValueError as error:
            raise InputError(
                f"tile {self.level}/{tile.x}/{tile.y} in {self.path}: {error}; make the file again"
            ) from None


@dataclass(frozen=True, slots=True)
class TileService:
    """A tile service that the user named, and how politely it is read.

    Attributes:
        url_template: with {z} {x} {y} {-y} {s} and {key}; the key itself never stands here.
        grid, level: which tiles.
        cache_dir: where tiles are kept, in the grid's own path scheme; one service a folder.
        max_connections, rate_per_s: upper bounds of what the service is asked for.
        retries: further attempts a tile, waiting ``backoff_s`` * 2^attempt (with jitter), or what Retry-After says.
        timeout_s: for one attempt, from connecting to the last byte.
        key_env: environment variable that holds the user's key.
        headers: further request headers, in which {key} is filled too.
        subdomains: values of {s}.
        missing_ok: share of the wanted tiles that may not exist (404) without failing, 0 to 1.
        give_up_after: stop asking after so many failed tiles in a row: the service is down.
    """

    url_template: str
    grid: TileGrid
    level: int
    cache_dir: Path
    max_connections: int = 4
    rate_per_s: float = 8.0
    retries: int = 5
    backoff_s: float = 1.0
    timeout_s: float = 20.0
    key_env: str | None = None
    headers: tuple[tuple[str, str], ...] = ()
    subdomains: tuple[str, ...] = ()
    attribution: str = ""
    terms: str = ""
    missing_ok: float = 0.0
    pixel_ratio: int = 1
    give_up_after: int = 20

    def __post_init__(self) -> None:
        self.grid.check_level(self.level)
        if not self.url_template.startswith(("http://", "https://")):
            raise SettingsError(
                f"tile service {self.url_template!r}: give a URL that begins with http:// or https://"
            )
        if _KEYS_IN_URLS.search(self.url_template):
            raise SettingsError(
                f"the URL of the tile service at {urlsplit(self.url_template).hostname} holds what looks like a key: "
                "write {key} in its place and name the environment variable that holds it in key_env, so that it stays "
                "out of results and messages"
            )
        wants_key = any(
            "{key}" in text for text in (self.url_template, *(value for _, value in self.headers))
        )
        if wants_key and not self.key_env:
            raise SettingsError(
                f"tile service {self.url_template} wants a {{key}}: name its environment variable in key_env"
            )
        limits = (self.max_connections, self.rate_per_s, self.timeout_s, self.give_up_after)
        if not all(value > 0 for value in limits) or self.retries < 0 or self.backoff_s < 0:
            raise SettingsError(
                f"tile service {self.url_template}: connections, rate and timeout must be above 0"
            )
        if not 0 <= self.missing_ok <= 1:
            raise SettingsError(
                f"tile service {self.url_template}: missing_ok = {self.missing_ok} is not in 0 to 1"
            )
        self.grid.path((0, 0), self.level, template=self._keyless(), subdomains=self.subdomains)

    @property
    def folder(self) -> TileFolder:
        """The cache as a source."""
        return TileFolder(
            self.cache_dir, self.grid, self.level, None, self.attribution, self.terms, self.pixel_ratio
        )

    def _keyless(self) -> str:
        return self.url_template.replace("{key}", "")

    def _secret(self) -> str:
        """The user's key, or "" where none is wanted."""
        if self.key_env is None:
            return ""
        key = os.environ.get(self.key_env, "").strip()
        if not key:
            raise SettingsError(
                f"tile service {self.url_template} wants a key: set the environment variable {self.key_env} to yours"
            )
        return key


def ensure_tiles(
    source: TileSource | TileService,
    bounds: Bounds,
    crs: str,
    *,
    margin_px: float = 4.0,
    progress: Progress | None = None,
    missing_ok: float | None = None,
) -> TileSource:
    """The tiles under ``bounds`` (in ``crs``) on this machine: a local source checked, or a service's cache filled.

    Args:
        margin_px: tile pixels around the bounds that resampling needs.
        progress: called with (tiles done, tiles wanted) from this thread.
        missing_ok: share of the tiles under the bounds that may be missing (never all); default: the service's own
            setting, 0 for a local source. What is missing stays unknown in the imagery.

    Raises MissingInputError where tiles are missing (what, where, from whom), NetworkError where a service failed,
    SettingsError where its key is not set. After a NetworkError the tiles that came are kept; the next run resumes.
    """
    wanted = source.grid.covering(bounds, crs, source.level, margin_px)
    inner = source.grid.covering(bounds, crs, source.level)
    if isinstance(source, TileService):
        allowed = source.missing_ok if missing_ok is None else missing_ok
        _Download(source, wanted, progress).run()
        local: TileSource = source.folder
        origin = f"the service {source.url_template} says that they do not exist"
    else:
        allowed = missing_ok or 0.0
        local = source
        origin = ""
    missing = [tile for tile in inner if not local.has(tile)]
    if len(missing) > allowed * len(inner) or len(missing) == len(inner):
        raise MissingInputError(_missing_message(local, missing, len(inner), origin))
    return local


def decode_tile(data: bytes, size_px: int) -> tuple[NDArray[np.uint8], str]:
    """((size, size, 4) uint8 RGBA, format) of one encoded tile; ValueError that says what is wrong with it."""
    if not data:
        raise ValueError("it is empty")
    try:
        with Image.open(io.BytesIO(data)) as image:
            kind = str(image.format)
            if kind not in _FORMATS:
                raise ValueError(f"it is {kind}, not PNG, JPEG or WebP")
            if image.size != (size_px, size_px):
                hint = (
                    ": state pixel_ratio = 2 for such tiles"
                    if image.size == (2 * size_px, 2 * size_px)
                    else ""
                )
                raise ValueError(
                    f"it has {image.size[0]} x {image.size[1]} px, wanted {size_px} x {size_px}{hint}"
                )
            # Pillow opens a PNG of 16-bit colours as one of 8 and keeps the upper half of each; its header knows better.
            deep = kind == "PNG" and data[24:25] > b"\x08"
            if deep or image.mode.startswith(("I", "F")):
                raise ValueError(f"it has 16-bit or float pixels (mode {image.mode}), wanted 8-bit colours")
            image.load()
            return np.asarray(image.convert("RGBA"), dtype=np.uint8), kind
    except ValueError:
        raise
    except UnidentifiedImageError:
        raise ValueError(f"it is no image (it begins with {data[:16]!r})") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"the image is damaged ({error})") from None


def _missing_message(source: TileSource, missing: Sequence[Tile], wanted: int, origin: str) -> str:
    """One line: how many, which, where they go, where a person gets them, and what is there instead."""
    grid, z = source.grid, source.level
    first = ", ".join(grid.path(tile, z) for tile in missing[:3]) + (", ..." if len(missing) > 3 else "")
    xs, ys = [t.x for t in missing], [t.y for t in missing]
    span = f"x {min(xs)}-{max(xs)}, y {min(ys)}-{max(ys)}"
    text = (
        f"{len(missing)} of {wanted} tiles at level {z} of the {grid.name} grid are missing ({first}; {span})"
    )
    if origin:
        return f"{text}: {origin}; check the level and the bounds, or raise missing_share (missing_ok)"
    if not isinstance(source, TileFolder):
        return f"{text} in {source.where}: get a file that covers the region, or raise missing_share (missing_ok)"
    template = source.template or grid.template
    text += f" under {source.root}, wanted as {template}.png, .jpg or .webp"
    if not source.root.is_dir():
        text += "; the folder does not exist"
    else:
        held = source.held()
        if held:
            listed = "; ".join(
                f"{n} of level {level} (x {low.x}-{high.x}, y {low.y}-{high.y})"
                for level, (n, low, high) in sorted(held.items())
            )
            text += f"; there are {listed}"
        else:
            other = next(_image_files(source.root), None)
            text += f"; it holds none{f', but {other.relative_to(source.root)}' if other else ''}"
    return (
        f"{text}; put there tiles that you may use (export them from your own tile package, or name a service or a "
        "GeoTIFF as source in the region file), or raise missing_share (missing_ok) to leave them unknown"
    )


def _image_files(root: Path) -> Iterator[Path]:
    """Image files under a folder, in order of name within each folder."""
    for folder, names, found in os.walk(root):
        names.sort()
        for name in sorted(found):
            if name.rsplit(".", 1)[-1].lower() in EXTENSIONS:
                yield Path(folder, name)


@contextlib.contextmanager
def _sqlite(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection, closed at the end; sqlite's errors become InputError."""
    try:
        with contextlib.closing(sqlite3.connect(f"{Path(path).absolute().as_uri()}?mode=ro", uri=True)) as db:
            yield db
    except sqlite3.Error as error:
        raise InputError(f"{path} is no readable MBTiles file: {error}; make it again") from None


class _Gate:
    """Lets requests pass at most at a rate, and holds all of them back while the service asks for a pause."""

    def __init__(self, rate_per_s: float) -> None:
        self._step = 1.0 / rate_per_s
        self._next = 0.0
        self._lock = threading.Lock()

    def wait(self, stop: threading.Event) -> None:
        while not stop.is_set():
            with self._lock:
                now = time.monotonic()
                if now >= self._next:
                    self._next = now + self._step
                    return
                delay = self._next - now
            stop.wait(delay)

    def pause(self, seconds: float) -> None:
        with self._lock:
            self._next = max(self._next, time.monotonic() + seconds)


class _TryAgainError(Exception):
    """One attempt failed in a way that may pass; ``wait_s`` is what the service asked for."""

    def __init__(self, reason: str, wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.wait_s = wait_s


class _RefusedError(Exception):
    """The service refuses this user (key, terms): asking on would be wrong."""


class _Download:
    """One filling of a service's cache."""

    def __init__(self, service: TileService, tiles: Sequence[Tile], progress: Progress | None) -> None:
        self.service = service
        self.tiles = tiles
        self.progress = progress
        self.gate = _Gate(service.rate_per_s)
        self.stop = threading.Event()
        self.jitter = random.Random()

    def run(self) -> None:
        service, total = self.service, len(self.tiles)
        self._claim_cache()
        folder = service.folder
        todo = [t for t in self.tiles if not folder.has(t) and not self._absent(t).is_file()]
        done, failed, row = total - len(todo), [], 0
        if self.progress is not None:
            self.progress(done, total)
        if not todo:
            return
        key = service._secret()
        limits = httpx.Limits(max_connections=service.max_connections)
        headers = {"User-Agent": "brmgeo (imagery tiles for a map region)", "Accept": "image/*"}
        headers |= {name: value.replace("{key}", key) for name, value in service.headers}
        refused = ""
        with (
            _quiet_http_logs(),
            httpx.Client(limits=limits, timeout=service.timeout_s, headers=headers) as client,
            ThreadPoolExecutor(service.max_connections) as pool,
        ):
            try:
                futures = {pool.submit(self._tile, client, tile, key): tile for tile in todo}
                for future in as_completed(futures):
                    try:
                        problem = future.result()
                    except _RefusedError as error:
                        refused, problem = str(error), str(error)
                    if problem is None:
                        done, row = done + 1, 0
                        if self.progress is not None:
                            self.progress(done, total)
                    elif problem:
                        failed.append((futures[future], problem))
                        row += 1
                    if refused or row >= service.give_up_after:
                        self.stop.set()
            finally:
                # Also on Ctrl-C: what is waiting must not start.
                self.stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
        if refused:
            raise NetworkError(
                f"tile service {service.url_template} refuses: {refused}; check your key"
                f"{f' in {service.key_env}' if service.key_env else ''} and what its terms allow you"
            )
        if failed:
            listed = ", ".join(f"{service.grid.path(t, service.level)} {why}" for t, why in failed[:3])
            more = ", ..." if len(failed) > 3 else ""
            lost = total - done
            gave_up = (
                f", {lost - len(failed)} not asked for after {row} failures in a row"
                if lost > len(failed)
                else ""
            )
            raise NetworkError(
                f"tile service {service.url_template}: {lost} of {total} tiles could not be read ({listed}{more}{gave_up}); "
                f"{done} are kept in {service.cache_dir}: run again to go on"
            )

    def _claim_cache(self) -> None:
        """One service a cache folder, and no left-overs of a killed run."""
        service = self.service
        record = service.cache_dir / "source.json"
        mine = {"url_template": service.url_template, "grid": service.grid.name}
        try:
            service.cache_dir.mkdir(parents=True, exist_ok=True)
            other = files.read_json(record)
            if other is not None and other != mine:
                raise SettingsError(
                    f"{service.cache_dir} keeps tiles of {other.get('url_template')}: give {service.url_template} "
                    "a cache folder of its own"
                )
            if not record.is_file():
                files.write_json(record, mine, durable=True)
            files.clear_scratch(service.cache_dir, deep=True)
        except OSError as error:
            raise WorkflowError(f"cannot write tile cache {service.cache_dir}: {files.told(error)}") from None

    def _absent(self, tile: Tile) -> Path:
        """The marker of a tile that the service says does not exist."""
        return self.service.cache_dir / self.service.grid.path(tile, self.service.level, _ABSENT)

    def _keep(self, path: Path, data: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_bytes(path, data, durable=True)

    def _tile(self, client: httpx.Client, tile: Tile, key: str) -> str | None:
        """Fetch and keep one tile. None when done, "" when stopped before it was asked for, else why it failed."""
        service = self.service
        url = service.grid.path(
            tile,
            service.level,
            template=service.url_template.replace("{key}", "\0"),
            subdomains=service.subdomains,
        ).replace("\0", quote(key, safe=""))
        for attempt in range(service.retries + 1):
            self.gate.wait(self.stop)
            if self.stop.is_set():
                return ""
            try:
                data = self._get(client, url)
                if data is None:
                    self._keep(self._absent(tile), b"")
                    return None
                try:
                    _, kind = decode_tile(data, service.grid.tile_px * service.pixel_ratio)
                except ValueError as error:
                    raise _TryAgainError(
                        f"answered with something else: {error}".replace(key or "\0", "***")
                    ) from None
                target = service.cache_dir / service.grid.path(tile, service.level, _FORMATS[kind])
                self._keep(target, data)
                return None
            except _TryAgainError as error:
                if attempt == service.retries:
                    return f"{error} ({attempt + 1} attempts)"
                wait = service.backoff_s * 2.0**attempt * self.jitter.uniform(0.5, 1.5)
                if error.wait_s is not None:
                    if error.wait_s > _LONGEST_WAIT_S:
                        return f"{error}, asks to wait {error.wait_s:.0f} s: come back later"
                    self.gate.pause(error.wait_s)
                    wait = max(wait, error.wait_s)
                self.stop.wait(min(wait, _LONGEST_WAIT_S))
            except OSError as error:
                self.stop.set()
                raise WorkflowError(
                    f"cannot write tile cache {service.cache_dir}: {files.told(error)}"
                ) from None
        return ""

    def _get(self, client: httpx.Client, url: str) -> bytes | None:
        """The body of one answer, None where the service says that there is no such tile."""
        deadline = time.monotonic() + self.service.timeout_s
        try:
            with client.stream("GET", url) as answer:
                status = answer.status_code
                if status in _ABSENT_STATUS:
                    return None
                if status in (401, 403):
                    raise _RefusedError(f"HTTP {status}")
                if status in _RETRY_STATUS:
                    raise _TryAgainError(f"HTTP {status}", _retry_after_s(answer.headers.get("Retry-After")))
                if status != 200:
                    raise _TryAgainError(f"HTTP {status}")
                body = bytearray()
                for piece in answer.iter_bytes():
                    body += piece
                    if len(body) > _MAX_TILE_BYTES:
                        raise _TryAgainError(f"sends more than {_MAX_TILE_BYTES >> 20} MB for a tile")
                    # httpx limits the time between bytes; a server that drips must not hold a worker for ever.
                    if time.monotonic() > deadline:
                        raise _TryAgainError(f"is slower than {self.service.timeout_s:g} s")
                return bytes(body)
        except httpx.TimeoutException:
            raise _TryAgainError(f"no answer within {self.service.timeout_s:g} s") from None
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            # The error's text may quote the URL with the key: its kind has to do.
            raise _TryAgainError(f"connection failed ({type(error).__name__})") from None


def _retry_after_s(value: str | None) -> float | None:
    """Seconds that a Retry-After header asks for (a number or a date), or None."""
    if not value:
        return None
    try:
        return max(0.0, float(value))
    except ValueError:
        pass
    try:
        return max(0.0, parsedate_to_datetime(value).timestamp() - time.time())
    except (TypeError, ValueError):
        return None


@contextlib.contextmanager
def _quiet_http_logs() -> Iterator[None]:
    """httpx and httpcore log every URL, and a URL may hold the user's key."""
    loggers = [logging.getLogger(name) for name in ("httpx", "httpcore")]
    children = [
        logging.getLogger(name)
        for name in list(logging.root.manager.loggerDict)
        if name.startswith("httpcore.")
    ]
    before = [(log, log.level) for log in (*loggers, *children)]
    for log, _ in before:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in before:
            log.setLevel(level)
