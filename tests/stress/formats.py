"""A small sound file of every format that the command reads, made by the project's own writers, and what is run on it."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import geopandas as gpd
import log_writers
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from affine import Affine
from small_flights import CRS, LEFT, TOP
from small_maps import make_source
from small_networks import small_card, small_tensors
from small_recipes import TINY

OUT = "{out}"


@dataclass(frozen=True)
class Seed:
    """Files that may be damaged, the case that reads them (``OUT`` is a fresh path), and what of a result can be counted.

    ``head`` bytes say what the records are, and are left alone where losses are measured.
    """

    files: Sequence[Path]
    words: Sequence[object]
    call: str = "brmgeo"
    text: bool = False
    head: int = 0
    counts: Callable[[Path], dict[str, int]] | None = None
    kept: Sequence[Path] = field(
        default_factory=tuple
    )  # folders that a case may change, put back before the next


Make = Callable[[Path, pytest.FixtureRequest], Seed]
FORMATS: dict[str, Make] = {}


def made(name: str) -> Callable[[Make], Make]:
    def keep(make: Make) -> Make:
        FORMATS[name] = make
        return make

    return keep


def seed_of(name: str, folder: Path, request: pytest.FixtureRequest) -> Seed:
    folder.mkdir(parents=True, exist_ok=True)
    return FORMATS[name](folder, request)


# ---------------------------------------------------------------- footprints


def houses(n: int = 60) -> gpd.GeoDataFrame:
    rng = np.random.default_rng(5)
    shapes = [
        shapely.affinity.rotate(shapely.box(x, y, x + w, y + h), turn)
        for x, y, w, h, turn in (
            (LEFT + 40 * (k % 10), TOP - 40 * (k // 10), *rng.uniform(8, 20, 2), rng.uniform(0, 90))
            for k in range(n)
        )
    ]
    return gpd.GeoDataFrame(
        {"종류": ["아파트", "일반주택"] * (n // 2), "층수": [k % 5 for k in range(n)]},
        geometry=shapes,
        crs=CRS,
    )


def footprints_in(out: Path) -> dict[str, int]:
    return {"footprints": pyogrio.read_info(out / "footprints.gpkg", layer="footprints")["features"]}


def footprints(path: Path, files: Sequence[Path] = (), **more: Any) -> Seed:
    words = ("maps", "--footprints", path, "--crs", CRS, "--gsd", 2, "--out", OUT)
    return Seed(files or (path,), words, counts=footprints_in, **more)


@made("GeoJSON")
def _geojson(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pyogrio.write_dataframe(houses().to_crs("EPSG:4326"), folder / "t.geojson")
    return footprints(folder / "t.geojson", text=True)


@made("GeoPackage")
def _gpkg(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pyogrio.write_dataframe(houses(), folder / "t.gpkg")
    return footprints(folder / "t.gpkg", head=4096)


@made("shapefile")
def _shp(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pyogrio.write_dataframe(houses(), folder / "t.shp", encoding="EUC-KR")
    return footprints(folder / "t.shp", sorted(folder.glob("t.*")), head=100)


@made("GeoParquet")
def _parquet(folder: Path, request: pytest.FixtureRequest) -> Seed:
    houses().to_parquet(folder / "t.parquet")
    return footprints(folder / "t.parquet", head=4)


@made("FlatGeobuf")
def _fgb(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pyogrio.write_dataframe(houses(), folder / "t.fgb")
    return footprints(folder / "t.fgb", head=2048)


@made("DXF")
def _dxf(folder: Path, request: pytest.FixtureRequest) -> Seed:
    region = make_source(folder / "data")
    path = min(region.sheets.glob("*.dxf"), key=lambda p: p.stat().st_size)
    return footprints(path, text=True)


# ---------------------------------------------------------------- imagery and regions


def flat(path: Path, **profile: Any) -> Path:
    rng = np.random.default_rng(1)
    shape = {"height": 300, "width": 320, "count": 3, "dtype": "uint8"}
    place = {"transform": Affine(0.5, 0, LEFT, 0, -0.5, TOP), "crs": CRS, "photometric": "RGB"}
    with rasterio.open(path, "w", driver="GTiff", **shape, **place, **profile) as dst:
        dst.write(rng.integers(0, 255, (3, 300, 320), dtype=np.uint8))
    return path


def segmented(path: Path, request: pytest.FixtureRequest) -> Seed:
    words = ("segment", path, "--weights", request.getfixturevalue("weights"), "--out", f"{OUT}.tif")
    return Seed((path,), words)


@made("GeoTIFF, plain")
def _tiff(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return segmented(flat(folder / "p.tif"), request)


@made("GeoTIFF, deflate in tiles")
def _deflated(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return segmented(
        flat(folder / "d.tif", compress="deflate", tiled=True, blockxsize=128, blockysize=128), request
    )


@made("GeoTIFF, as imagery of maps")
def _imagery(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pyogrio.write_dataframe(houses(20), folder / "t.gpkg")
    path = flat(folder / "i.tif", compress="jpeg")
    words = ("maps", "--footprints", folder / "t.gpkg", "--crs", CRS, "--gsd", 2, "--imagery", path)
    return Seed((path,), (*words, "--out", OUT))


SMALL = f"""name = "small"
title = "Small"
crs = "{CRS}"
gsd_m = 2.0
bounds = [{LEFT}, {TOP - 200}, {LEFT + 200}, {TOP}]

[footprints]
paths = ["t.gpkg"]
attribution = "me"
"""


def region(folder: Path, more: str = "") -> tuple[Path, Path, tuple[object, ...]]:
    """Data folder, region file, and the words that build its maps; what was built before stays."""
    source = folder / "data/source/small"
    source.mkdir(parents=True)
    pyogrio.write_dataframe(houses(20), source / "t.gpkg")
    toml = folder / "data/regions/small.toml"
    toml.parent.mkdir(parents=True)
    toml.write_text(SMALL + more)
    return folder / "data", toml, ("maps", "small", "--data", folder / "data", "--out", OUT)


@made("region TOML")
def _region(folder: Path, request: pytest.FixtureRequest) -> Seed:
    _, toml, words = region(folder, "[ratio]\nradii_m = [40.0, 17.3]\n[training]\ntile_px = 256\nseed = 3\n")
    return Seed((toml,), words, text=True)


def tiles_of(level: int, at: Callable[[Any], Path | None], grid: Any, suffix: str) -> dict[Any, bytes]:
    """Noise for every tile over the small region, as bytes of a picture, also written where ``at`` says."""
    rng = np.random.default_rng(2)
    found = {}
    for tile in grid.covering((LEFT, TOP - 200, LEFT + 200, TOP), CRS, level, margin_px=4.0):
        picture = rng.integers(0, 255, (grid.tile_px, grid.tile_px, 3), dtype=np.uint8)
        found[tile] = cv2.imencode(suffix, cv2.GaussianBlur(picture, (0, 0), 3))[1].tobytes()
        if (path := at(tile)) is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(found[tile])
    return found


@made("tile pictures, Kakao")
def _kakao(folder: Path, request: pytest.FixtureRequest) -> Seed:
    from brmgeo.geo.tilegrid import KakaoGrid

    more = '[imagery]\nkind = "tiles"\npath = "tiles"\ngrid = "kakao"\nlevel = 4\nattribution = "me"\n'
    data, _, words = region(folder, more)
    tiles, grid = data / "source/small/tiles", KakaoGrid()
    tiles_of(4, lambda tile: tiles / grid.path(tile, 4, "png"), grid, ".png")
    return Seed(sorted(tiles.rglob("*.png")), words)


@made("tile pictures, XYZ")
def _xyz(folder: Path, request: pytest.FixtureRequest) -> Seed:
    from brmgeo.geo.tilegrid import WebMercatorGrid

    more = '[imagery]\nkind = "tiles"\npath = "tiles"\ngrid = "webmercator"\nlevel = 17\nattribution = "me"\n'
    data, _, words = region(folder, more)
    tiles, grid = data / "source/small/tiles", WebMercatorGrid()
    tiles_of(17, lambda tile: tiles / grid.path(tile, 17, "jpg"), grid, ".jpg")
    return Seed(sorted(tiles.rglob("*.jpg")), words)


@made("MBTiles")
def _mbtiles(folder: Path, request: pytest.FixtureRequest) -> Seed:
    from brmgeo.geo.tilegrid import WebMercatorGrid

    data, _, words = region(folder, '[imagery]\nkind = "mbtiles"\npath = "t.mbtiles"\nattribution = "me"\n')
    path = data / "source/small/t.mbtiles"
    tiles = tiles_of(17, lambda tile: None, WebMercatorGrid(), ".png")
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        db.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        db.execute("INSERT INTO metadata VALUES ('format', 'png')")
        rows = [(17, t.x, (1 << 17) - 1 - t.y, picture) for t, picture in tiles.items()]
        db.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
        db.commit()
    return Seed((path,), words)


@made("maps.json and records of earlier runs")
def _records(folder: Path, request: pytest.FixtureRequest) -> Seed:
    data, _, words = region(folder)
    request.getfixturevalue("arena").run(
        "brmgeo", *("maps", "small", "--data", data, "--out", data / "out/small")
    )
    files = [*(data / "out").rglob("*.json"), *(data / "work").rglob("*.json")]
    words = (*words[:-1], data / "out/small")
    return Seed(sorted(files), words, text=True, kept=(data / "work", data / "out"))


# ---------------------------------------------------------------- flights


def flight(folder: Path, request: pytest.FixtureRequest, name: str, like: str = "whole") -> Seed:
    """A file of a flight, and localize over it."""
    there = Path(shutil.copytree(request.getfixturevalue(like), folder / "f"))
    maps = request.getfixturevalue("maps")
    words = ("localize", "--maps", maps, "--flight", there, "--method", "ratio", "--out", OUT)
    return Seed((there / name,), words, text=True)


for _name in ("flight.toml", "frames.csv", "odometry.tum", "reference.csv"):
    FORMATS[_name] = lambda folder, request, name=_name: flight(folder, request, name)  # type: ignore[misc]


@made("mask pictures")
def _masks(folder: Path, request: pytest.FixtureRequest) -> Seed:
    seed = flight(folder, request, "flight.toml")
    return Seed(sorted((folder / "f/masks").glob("*.png")), seed.words)


@made("imu.csv and altimeter.csv")
def _imu(folder: Path, request: pytest.FixtureRequest) -> Seed:
    there = Path(shutil.copytree(request.getfixturevalue("filmed"), folder / "f"))
    return Seed((there / "imu.csv", there / "altimeter.csv"), ("inspect", there), text=True)


@made("frames, JPEG")
def _jpeg(folder: Path, request: pytest.FixtureRequest) -> Seed:
    pictures = folder / "p"
    pictures.mkdir()
    rng = np.random.default_rng(3)
    for k in range(3):
        noise = cv2.GaussianBlur(rng.integers(0, 255, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
        cv2.imwrite(str(pictures / f"{k}.jpg"), noise)
    words = ("segment", pictures, "--weights", request.getfixturevalue("weights"), "--gsd", 0.3, "--out", OUT)
    return Seed(sorted(pictures.iterdir()), words)


@made("frames, PNG")
def _png(folder: Path, request: pytest.FixtureRequest) -> Seed:
    seed = _jpeg(folder, request)
    for path in seed.files:
        cv2.imwrite(str(path.with_suffix(".png")), cv2.imread(str(path)))
        path.unlink()
    return Seed([p.with_suffix(".png") for p in seed.files], seed.words)


@made("simulate --settings TOML")
def _settings(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = folder / "s.toml"
    path.write_text(
        "agl_sigma_m = 8.0\nattitude_error_deg = 0.5\nexposure_s = 0.01\nnoise_levels = 6.0\n[camera]\nfov_deg = 60.0\n"
        "distortion = [-0.05, 0.01, 0.0, 0.0, 0.0]\n[mount]\npitch_deg = -10.0\n[masks]\nmissed = 0.2\n"
        "[odometry]\nscale_bias = 0.08\nreset_times_s = [30.0]\n"
    )
    words = ("simulate", "--maps", request.getfixturevalue("maps"), "--mode", "masks", "--out", OUT)
    return Seed(
        (path,), (*words, "--path", request.getfixturevalue("waypoints"), "--settings", path), text=True
    )


@made("path GeoJSON")
def _path(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = Path(shutil.copy(request.getfixturevalue("waypoints"), folder / "path.geojson"))
    words = ("simulate", "--maps", request.getfixturevalue("maps"), "--mode", "masks", "--out", OUT)
    return Seed((path,), (*words, "--path", path), text=True)


# ---------------------------------------------------------------- logs


def rows_in(out: Path) -> dict[str, int]:
    """Rows of every table of a flight, and its pictures."""
    found = {p.name: len(p.read_bytes().splitlines()) - 1 for p in out.glob("*.csv")}
    return found | {"frames": len(list(out.glob("frames/*")))}


def imported(path: Path, files: Sequence[Path] = (), *more: object, **seed: Any) -> Seed:
    return Seed(files or (path,), ("import", path, "--out", OUT, *more), counts=rows_in, **seed)


@made("ULog")
def _ulog(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = log_writers.px4(folder / "a.ulg", version="new")
    return imported(path, head=1500)


@made("ULog, local position")
def _ulog_local(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return imported(log_writers.px4(folder / "a.ulg"), head=1500)


@made("ArduPilot .bin")
def _bin(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return imported(log_writers.dataflash(folder / "a.bin"), head=900)


@made("ArduPilot .log")
def _log(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = log_writers.as_text(log_writers.dataflash(folder / "a.bin"))
    return imported(path, text=True, head=900)


@made("MAVLink .tlog")
def _tlog(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return imported(log_writers.telemetry(folder / "a.tlog"))


@made("ROS 1 bag")
def _ros1(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return imported(log_writers.bag(folder / "b", "ros1"), head=4200)


@made("ROS 2 bag, db3")
def _db3(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = log_writers.bag(folder / "b", "db3")
    return imported(path, sorted(path.iterdir()), head=8192)


@made("ROS 2 bag, mcap")
def _mcap(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = log_writers.bag(folder / "b", "mcap", encoding="jpeg")
    return imported(path, sorted(path.iterdir()), head=8192)


@made("video")
def _video(folder: Path, request: pytest.FixtureRequest) -> Seed:
    log = log_writers.dataflash(folder / "a.bin")
    video = cv2.VideoWriter(str(folder / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(40):
        video.write(log_writers.picture(i % 20))
    video.release()
    return imported(
        log, (folder / "v.avi",), "--video", folder / "v.avi", "--fov", 43, "--video-start", 103, head=6000
    )


@made("geotagged photos")
def _photos(folder: Path, request: pytest.FixtureRequest) -> Seed:
    photos = log_writers.shots_of(folder / "photos", 4, xmp=log_writers.dji((0.0, -90.0, 46.0)))
    return imported(photos, sorted(photos.iterdir()))


def poses(folder: Path, suffix: str, line: Callable[..., str], head: str = "") -> Seed:
    path = folder / f"vio.{suffix}"
    rows = [line(t, *p, *q) for t, p, q in zip(log_writers.T, log_writers.XYZ, log_writers.WXYZ)]
    path.write_text("\n".join([*([head] if head else []), *rows, ""]))
    return imported(path, text=True)


@made("odometry, TUM")
def _tum(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return poses(
        folder,
        "tum",
        lambda t, x, y, z, w, a, b, c: " ".join(f"{v:.9f}" for v in (t, x, y, z, a, b, c, w)),
    )


@made("odometry, EuRoC or VINS")
def _euroc(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return poses(
        folder, "csv", lambda t, *v: ",".join([f"{round(t * 1e9) + 10**18}", *(f"{n:.9f}" for n in v)])
    )


@made("odometry, plain CSV")
def _csv(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return poses(folder, "csv", lambda *v: ",".join(f"{n:.9f}" for n in v), "t_s,x,y,z,qw,qx,qy,qz")


# ---------------------------------------------------------------- networks, states, results


def network(path: Path, folder: Path) -> Seed:
    pictures = folder / "p"
    pictures.mkdir()
    cv2.imwrite(
        str(pictures / "a.png"), np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    )
    backend = "torch" if path.suffix == ".safetensors" else "onnx"
    words = ("segment", pictures, "--weights", path, "--backend", backend, "--gsd", 0.3, "--out", OUT)
    return Seed((path,), words)


@made("weights, ONNX")
def _onnx(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return network(Path(shutil.copy(request.getfixturevalue("weights"), folder / "w.onnx")), folder)


@made("weights, safetensors")
def _safetensors(folder: Path, request: pytest.FixtureRequest) -> Seed:
    from brmgeo.segment.weights import save_weights

    save_weights(folder / "w.safetensors", small_tensors(), small_card())
    return network(folder / "w.safetensors", folder)


@made("recipe TOML")
def _recipe(folder: Path, request: pytest.FixtureRequest) -> Seed:
    path = folder / "tiny.toml"
    path.write_text(TINY)
    return Seed((path,), (path,), call="recipe", text=True)


@made("saved Localizer")
def _saved(folder: Path, request: pytest.FixtureRequest) -> Seed:
    from brmgeo.flight.folder import read_flight
    from brmgeo.flight.readings import Attitude
    from brmgeo.locate.localizer import Localizer
    from brmgeo.locate.maps import match_settings, read_maps
    from brmgeo.region import FlightSettings

    maps, flown = request.getfixturevalue("maps"), read_flight(request.getfixturevalue("whole"))
    here = Localizer(
        read_maps(maps), flown.camera, flown.mount, method="paper", settings=match_settings(FlightSettings())
    )
    frame = flown.frames[0]
    here.step(
        frame.t_s,
        flown.mask(0),
        Attitude(frame.roll_rad, frame.pitch_rad),
        frame.agl_m,
        None,
        file=frame.file,
    )
    here.save(folder / "state.brm")
    return Seed((folder / "state.brm",), (folder / "state.brm", maps), call="saved")


def results(folder: Path, request: pytest.FixtureRequest, name: str, what: str) -> Seed:
    there = Path(shutil.copytree(request.getfixturevalue("located") / "paper", folder / "r"))
    return Seed((there / name,), ("export", there, "--path", what, "--out", f"{OUT}.csv"), text=True)


@made("results: candidates.geojson")
def _candidates(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return results(folder, request, "candidates.geojson", "candidates")


@made("results: fixes.csv")
def _fixes(folder: Path, request: pytest.FixtureRequest) -> Seed:
    return results(folder, request, "fixes.csv", "online")


@made("results: trajectory.gpkg")
def _trajectory(folder: Path, request: pytest.FixtureRequest) -> Seed:
    seed = results(folder, request, "trajectory.gpkg", "online")
    return Seed(seed.files, seed.words)


@made("results: metrics.json, compared")
def _metrics(folder: Path, request: pytest.FixtureRequest) -> Seed:
    there = Path(shutil.copytree(request.getfixturevalue("located"), folder / "r"))
    (there / "paper/metrics.json").write_text(
        json.dumps(json.loads((there / "paper/metrics.json").read_text()), indent=1)
    )
    return Seed((there / "paper/metrics.json",), ("evaluate", "--results", there, "--out", OUT), text=True)
