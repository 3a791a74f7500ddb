"""Fixtures of several rooms: the command, a small town's maps, flights over it, and a network of one convolution."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import geopandas as gpd
import numpy as np
import pytest
import rasterio
import rasterio.features
import shapely
from affine import Affine
from hypothesis import settings as hypothesis_settings
from pyproj import Transformer
from small_flights import COLS, CRS, GSD, LEFT, REAL, ROWS, TOP, Said, make_flight

from brmgeo.flight.readings import Attitude, Camera
from brmgeo.match import METHODS
from brmgeo.segment.predict import Segmenter
from brmgeo.synth.flight import Imagery, RaisedFootprints, SimulationSettings, simulate
from pipelines.cli import cli, run

# The everyday run is the same for everyone; pytest --hypothesis-profile=explore looks further.
hypothesis_settings.register_profile("everyday", derandomize=True, deadline=None)
hypothesis_settings.register_profile("explore", derandomize=False, deadline=None)
hypothesis_settings.load_profile("everyday")


def _forbid_the_network(event: str, arguments: tuple[Any, ...]) -> None:
    """An audit hook under which Python code reaches this machine alone; no ``except OSError`` hides the failure."""
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        ours, address = arguments[:2]
        if ours.family not in (socket.AF_INET, socket.AF_INET6) or address is None:
            return  # a socket of this machine, or one that has been connected
        host = address[0]
    elif event in ("socket.getaddrinfo", "socket.gethostbyname"):
        host = arguments[0] or "localhost"
    else:
        return
    host = host.decode() if isinstance(host, bytes) else host
    if not host.startswith("127.") and host not in ("localhost", "::1", "0.0.0.0"):
        raise AssertionError(f"{event} to {host}: tests never leave this machine")


sys.addaudithook(_forbid_the_network)


@pytest.fixture
def say(capfd: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Runs the command in this process."""

    def call(*words: object) -> Said:
        capfd.readouterr()
        code = run(lambda: cli([str(w) for w in words], standalone_mode=False))
        got = capfd.readouterr()
        return Said(code, got.out, got.err)

    return call


@pytest.fixture(scope="session")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """600 x 500 m of houses of many sizes and turns, written with other tools than brmgeo's."""
    folder = tmp_path_factory.mktemp("maps")
    rng = np.random.default_rng(11)
    boxes: list[shapely.Polygon] = []
    while len(boxes) < 260:
        x, y = LEFT + rng.uniform(10, 590), TOP - rng.uniform(10, 490)
        box = shapely.box(x, y, x + rng.uniform(7, 22), y + rng.uniform(7, 13))
        box = shapely.affinity.rotate(box, rng.uniform(0, 90))
        if not any(box.distance(other) < 3 for other in boxes):
            boxes.append(box)
    gpd.GeoDataFrame({"floors": rng.integers(1, 5, len(boxes))}, geometry=boxes, crs=CRS).to_file(
        folder / "footprints.gpkg", layer="footprints"
    )
    affine = Affine(GSD, 0, LEFT, 0, -GSD, TOP)
    built = rasterio.features.rasterize(boxes, (ROWS, COLS), transform=affine, dtype="uint8")
    profile = {"driver": "GTiff", "height": ROWS, "width": COLS, "transform": affine, "crs": CRS}
    with rasterio.open(folder / "buildings.tif", "w", dtype="uint8", count=1, nodata=255, **profile) as dst:
        dst.write(built, 1)
    with rasterio.open(folder / "ratio.tif", "w", dtype="uint16", count=1, nodata=65535, **profile) as dst:
        dst.write(built.astype(np.uint16) * 10000, 1)
    noise = rng.integers(60, 120, (3, ROWS, COLS), dtype=np.uint8)
    with rasterio.open(
        folder / "imagery.tif", "w", dtype="uint8", count=3, photometric="RGB", **profile
    ) as dst:
        dst.write(noise + 100 * built)
    return folder


@pytest.fixture(scope="session")
def waypoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A line of 250 m within the map, in longitude and latitude."""
    xy = [(LEFT + 200, TOP - 250), (LEFT + 350, TOP - 220), (LEFT + 380, TOP - 320)]
    lon, lat = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(*zip(*xy, strict=True))
    path = tmp_path_factory.mktemp("path") / "line.geojson"
    path.write_text(
        json.dumps({"type": "LineString", "coordinates": [list(p) for p in zip(lon, lat, strict=True)]})
    )
    return path


@pytest.fixture(scope="session")
def whole(maps: Path, waypoints: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A masks-only flight of some ten frames with all that a flight has; never change it."""
    out = tmp_path_factory.mktemp("flight") / "f"
    return make_flight(maps, waypoints, out, "--compass", "--scale-bias", 0.03)


@pytest.fixture(scope="session")
def results(maps: Path, whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What localize wrote of that flight, one folder a method; never change it."""
    out = tmp_path_factory.mktemp("results")
    for method in METHODS:
        words = ["localize", "--maps", maps, "--flight", whole, "--method", method, "--out", out / method]
        assert run(lambda words=words: cli([str(w) for w in words], standalone_mode=False)) == 0
    return out


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that calls what is bright building; the town's houses are bright."""
    from small_networks import bright_onnx, small_card

    card = small_card(
        mean=(0.52, 0.52, 0.52), std=(0.05, 0.05, 0.05), threshold=0.5, temperature=1.0, gsd_min_m=0.05,
        gsd_max_m=1.0, gsd_work_m=None, sha256="ab" * 32,
    )  # fmt: skip
    return bright_onnx(tmp_path_factory.mktemp("net") / "bright.onnx", card)


@pytest.fixture(scope="session")
def pictured(maps: Path, waypoints: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight like ``whole`` with frames in place of masks; never change it."""
    out = tmp_path_factory.mktemp("pictured") / "f"
    return make_flight(maps, waypoints, out, "--mode", "frames", "--scale-bias", 0.03)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of video frames over a plain with much to be seen on it, an IMU, and no odometry; never change it."""
    rng = np.random.default_rng(0)
    grey = sum(
        w * cv2.GaussianBlur(rng.standard_normal((700, 700)).astype(np.float32), (0, 0), s)
        for s, w in ((1.0, 1.0), (3.0, 3.0), (9.0, 8.0))
    )
    assert isinstance(grey, np.ndarray)
    rgb = np.clip(128 + 45 * grey / grey.std(), 0, 255).astype(np.uint8)
    imagery = Imagery(np.repeat(rgb[:, :, None], 3, axis=2), -140.0, 140.0, 0.4)
    settings = SimulationSettings(
        camera=Camera.from_fov(240, 180, 43.0),
        mount=Attitude(),
        agl_m=100.0,
        frame_interval_s=0.25,
        odometry=None,
        turn_radius_m=15.0,
    )
    path = np.array([[-50.0, -20.0], [20.0, -20.0], [20.0, 10.0]])
    out = tmp_path_factory.mktemp("flight") / "f"
    return simulate(
        out,
        RaisedFootprints.from_polygons([]),
        path,
        "EPSG:5187",
        settings,
        1,
        mode="frames",
        imagery=imagery,
    )


@pytest.fixture(scope="session")
def real_maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps under the flight over Sheffield; skips where that is not here."""
    if not REAL.is_dir():
        pytest.skip("the real flight is not here (BRMGEO_REAL_DATA)")
    out = tmp_path_factory.mktemp("real") / "maps"
    words = ["maps", "--footprints", REAL / "footprints.gpkg", "--crs", "EPSG:32617", "--out", out]
    words += ["--scheduler", "serial"]
    assert run(lambda: cli([str(w) for w in words], standalone_mode=False)) == 0
    return out


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A tmpfs of 1 MiB."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = shutil.which("mount")
    if mount is None:
        pytest.skip("no mount command to make a small disk with")
    done = subprocess.run(
        [mount, "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        pytest.skip(f"no small disk: {done.stderr.strip() or 'mount failed'} (it takes root)")
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The shape of every picture that a network has been asked about."""
    seen: list[tuple[int, ...]] = []
    own = Segmenter.probabilities

    def counted(self: Segmenter, images: list, gsds: list) -> list:
        seen.extend(i.rgb.shape for i in images)
        return own(self, images, gsds)

    monkeypatch.setattr(Segmenter, "probabilities", counted)
    return seen
