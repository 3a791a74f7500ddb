"""The flight folder: a good one is read to the letter, and every fault of the list is refused with its place."""

from __future__ import annotations

import math
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import shapely

from brmgeo.errors import FlightError
from brmgeo.flight.camera import pixel_from_point, world_from_camera
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.motion import motions
from brmgeo.flight.video import Video
from brmgeo.flight.view import make_view
from brmgeo.geo.crs import transformer

SHEFFIELD = (
    Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2] / "../shared/data"))
    / "flight-sheffield"
)
CRS = "EPSG:5187"
TOML = """name = "small"
[camera]
width = 32
height = 24
fov_deg = 43.0
[mount]
roll_deg = 1.0
pitch_deg = -2.0
yaw_deg = 3.0
[odometry]
file = "odometry.csv"
format = "csv"
[height]
source = "frames"
[reference]
file = "reference.csv"
crs = "EPSG:4326"
"""


def png(path: Path, image: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "flight"
    (root / "frames").mkdir(parents=True)
    (root / "masks").mkdir()
    rows, track, reference = (
        ["t_s,file,agl_m,roll_deg,pitch_deg,yaw_deg"],
        ["t_s,x,y,z,qw,qx,qy,qz"],
        ["t_s,lon,lat"],
    )
    rng = np.random.default_rng(1)
    for i in range(4):
        rows.append(f"{5 * i},f{i}.jpg,{150 + i},1.0,-2.0,{(358 + i) % 360}")
        image = np.zeros((24, 32, 3), np.uint8)
        image[..., 2] = 200  # red, in OpenCV's order
        png(root / "frames" / f"f{i}.jpg", image)
        png(root / "masks" / f"f{i}.png", (rng.random((24, 32)) < 0.5).astype(np.uint8) * 255)
    for i in range(151):
        track.append(f"{i / 10},{i / 2},0,1,1,0,0,0")
        reference.append(f"{i / 10},{129.31 + i * 1e-6:.7f},36.01")
    (root / "flight.toml").write_text(TOML)
    (root / "frames.csv").write_text("\n".join(rows) + "\n")
    (root / "odometry.csv").write_text("\n".join(track) + "\n")
    (root / "reference.csv").write_text("\n".join(reference) + "\n")
    return root


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_good_folder_is_read_to_the_letter(folder: Path) -> None:
    flight = read_flight(folder)
    assert flight.name == "small"
    assert flight.camera.fx == pytest.approx(12.0 / math.tan(math.radians(21.5)))
    assert [
        math.degrees(v) for v in (flight.mount.roll_rad, flight.mount.pitch_rad, flight.mount.yaw_rad)
    ] == (pytest.approx([1.0, -2.0, 3.0]))
    assert flight.times_s.tolist() == [0.0, 5.0, 10.0, 15.0]
    assert [f.agl_m for f in flight.frames] == [150.0, 151.0, 152.0, 153.0]
    assert math.degrees(flight.frames[2].pitch_rad) == pytest.approx(-2.0)
    assert [f.true_heading_deg for f in flight.frames] == [358.0, 359.0, 0.0, 1.0]
    red = flight.image(1)
    assert red.shape == (24, 32, 3)
    assert red[..., 0].mean() > 150 > 50 > red[..., 2].mean()
    assert set(np.unique(flight.mask(1))) == {0, 255}
    assert flight.imu() is None
    assert flight.odometry is not None
    steps = motions(flight.odometry, flight.times_s)
    assert steps[1].step_m == pytest.approx([25.0, 0.0])
    reference = flight.reference(CRS)
    assert reference is not None
    expected = transformer("EPSG:4326", CRS).transform(129.31, 36.01)
    assert reference.xy_m[0] == pytest.approx(expected, abs=1e-6)


def test_compass_headings_are_turned_to_the_grid(folder: Path) -> None:
    flight = read_flight(folder)
    x, y = transformer("EPSG:4326", CRS).transform(129.31, 36.01)
    yaw = flight.compass_yaw_rad(CRS, x, y)[2]
    # True north drawn in the grid: a step along the meridian.
    x1, y1 = transformer("EPSG:4326", CRS).transform(129.31, 36.011)
    assert yaw == pytest.approx(math.atan2(y1 - y, x1 - x), abs=1e-5)


def test_reference_in_projected_coordinates(folder: Path) -> None:
    (folder / "reference.csv").write_text("t_s,x,y,alt_m\n0,229000,379000,210\n15,229100,379000,211\n")
    edit(folder / "flight.toml", "EPSG:4326", "EPSG:5187")
    reference = read_flight(folder).reference("EPSG:5186")
    assert reference is not None
    assert reference.alt_m is not None
    assert reference.alt_m.tolist() == [210.0, 211.0]
    back = transformer("EPSG:5186", "EPSG:5187").transform(*reference.xy_m[1])
    assert back == pytest.approx((229100, 379000), abs=1e-5)


def test_intrinsics_with_distortion(folder: Path) -> None:
    new = "fx = 30.0\nfy = 31\ncx = 15.5\ncy = 11.5\ndistortion = [-0.1, 0.02, 0.0, 0.0, 0]"
    edit(folder / "flight.toml", "fov_deg = 43.0", new)
    camera = read_flight(folder).camera
    assert (camera.fy, camera.distortion[0]) == (31.0, -0.1)


def test_heights_fixed_and_from_an_altimeter(folder: Path) -> None:
    edit(folder / "flight.toml", 'source = "frames"', 'source = "fixed"\nfixed_m = 120')
    assert {f.agl_m for f in read_flight(folder).frames} == {120.0}
    edit(folder / "flight.toml", 'source = "fixed"', 'source = "altimeter"')
    (folder / "altimeter.csv").write_text(
        "t_s,agl_m\n" + "".join(f"{t},{100 + t}\n" for t in range(0, 17, 2))
    )
    assert [f.agl_m for f in read_flight(folder).frames] == [100.0, 105.0, 110.0, 115.0]
    (folder / "altimeter.csv").write_text(
        "t_s,alt_m\n" + "".join(f"{t},{300 + t}\n" for t in range(0, 17, 2))
    )
    with pytest.raises(FlightError, match="ground_m"):
        read_flight(folder)
    edit(folder / "flight.toml", "[reference]", '[altimeter]\ndatum = "msl"\nground_m = 190.0\n[reference]')
    assert [f.agl_m for f in read_flight(folder).frames] == [110.0, 115.0, 120.0, 125.0]
    (folder / "altimeter.csv").write_text("t_s,alt_m\n0,300\n4,300\n12,300\n16,300\n")
    with pytest.raises(
        FlightError, match=r"frames.csv:3: column t_s: altimeter.csv has no height at 5.000 s"
    ):
        read_flight(folder)


def test_masks_only_frames_only_and_no_odometry(folder: Path) -> None:
    for path in (folder / "frames").iterdir():
        path.unlink()
    (folder / "frames").rmdir()
    flight = read_flight(folder)
    assert not flight.has_images
    assert flight.mask(0).shape == (24, 32)
    with pytest.raises(FlightError, match="masks only"):
        flight.image(0)
    edit(folder / "flight.toml", '[odometry]\nfile = "odometry.csv"\nformat = "csv"\n', "")
    with pytest.raises(FlightError, match="no \\[odometry\\] section"):
        read_flight(folder)
    (folder / "odometry.csv").unlink()
    assert read_flight(folder).odometry is None


def test_a_single_frame_is_a_flight(folder: Path) -> None:
    lines = (folder / "frames.csv").read_text().splitlines()
    (folder / "frames.csv").write_text("\n".join(lines[:2]))
    flight = read_flight(folder)
    assert len(motions(flight.odometry, flight.times_s)) == len(flight.frames) == 1


def test_a_video_stands_in_for_the_frames(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = cv2.VideoWriter(str(folder / "flight.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (32, 24))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for i in range(31):
        writer.write(np.full((24, 32, 3), 8 * i, np.uint8))
    writer.release()
    for path in (folder / "frames").iterdir():
        path.unlink()
    edit(folder / "flight.toml", "[height]", '[frames]\nvideo = "flight.avi"\n[height]')
    flight = read_flight(folder)
    for i in (0, 2, 1, 3):  # back and forth
        assert flight.image(i).mean() == pytest.approx(80 * i, abs=4)
    video = Video(folder / "flight.avi")
    assert not video.is_open
    opened: list[Path] = []
    real = av.open
    monkeypatch.setattr(av, "open", lambda file, **options: opened.append(file) or real(file, **options))
    for i in range(31):
        assert video.image(i) is not None
    assert len(opened) == 1, "in order, each picture is decoded once"
    assert video.image(31) is None
    assert not pickle.loads(pickle.dumps(video)).is_open
    video.close()
    assert not video.is_open
    assert video.image(3) is not None
    del opened[:]
    with read_flight(folder) as flight:
        flight.image(1)
        flight.image(2)
        assert len(opened) == 2, "once to look at it, once to read"
    assert flight.image(3).mean() == pytest.approx(240, abs=4)
    assert len(opened) == 3, "it was closed with the flight"
    flight.image(3)
    assert len(opened) == 4, "and with the last frame"
    edit(folder / "frames.csv", "15,f3.jpg", "99,f3.jpg")
    with pytest.raises(FlightError, match=r"no frame at 99.000 s \(f3.jpg\)"):
        read_flight(folder).image(3)
    (folder / "flight.avi").write_bytes(b"no video")
    with pytest.raises(FlightError, match="no readable video"):
        read_flight(folder)


def film(path: Path, codec: str, pictures: list[np.ndarray]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.gop_size = 15
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def attempt(video: Video, number: int) -> np.ndarray | None:
    try:
        return video.image(number)
    except FlightError:
        return None


@pytest.mark.parametrize(("name", "codec", "least"), [("f.mp4", "libx264", 0.8), ("f.avi", "mpeg4", 0.6)])
def test_pictures_that_a_videos_decoder_complains_of_are_told(
    tmp_path: Path, name: str, codec: str, least: float
) -> None:
    rng = np.random.default_rng(3)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (240, 500, 3)).astype(np.uint8), (0, 0), 3)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX)
    path = tmp_path / name
    film(path, codec, [np.ascontiguousarray(ground[40:200, 5 * i : 5 * i + 240]) for i in range(30)])
    video = Video(path)
    assert (video.count, video.rate_hz, video.size) == (30, 10.0, (240, 160))
    whole = [video.image(i) for i in range(30)]
    capture = cv2.VideoCapture(str(path))
    assert all(np.array_equal(image, capture.read()[1][:, :, ::-1]) for image in whole)
    data = path.read_bytes()
    wrong = {"told": 0, "taken": 0}
    for _ in range(10):
        damaged = bytearray(data)
        for at in rng.integers(len(data) // 8, len(data) * 7 // 8, 3):
            damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        video = Video(path)
        found = [attempt(video, i) for i in range(30)]
        wrong["told"] += sum(image is None for image in found)
        wrong["taken"] += sum(
            bool((np.abs(image.astype(int) - true).max(axis=2) > 16).mean() > 0.02)
            for image, true in zip(found, whole)
            if image is not None
        )
    assert wrong["told"] > least * (wrong["told"] + wrong["taken"])


LENS = "fx = 20.0\nfy = 20.0\ncx = 15.5\ncy = 11.5\ndistortion = "

Fault = Callable[[Path], None]
FAULTS: list[tuple[str, Fault, str]] = [
    ("no folder", lambda f: f.rename(f.with_name("gone")), "no such folder"),
    ("no toml", lambda f: (f / "flight.toml").unlink(), "flight.toml: there is no such file"),
    (
        "bad toml",
        lambda f: edit(f / "flight.toml", "width = 32", "width 32"),
        r"flight.toml:3: column \d+: not valid TOML",
    ),
    (
        "unknown key",
        lambda f: edit(f / "flight.toml", "fov_deg", "fov_degg"),
        r":5: column 1: unknown key 'fov_degg' .*'fov_deg'",
    ),
    (
        "unknown section",
        lambda f: edit(f / "flight.toml", "[mount]", "[mont]"),
        r":6: column 1: .*did you mean 'mount'",
    ),
    (
        "text for number",
        lambda f: edit(f / "flight.toml", "43.0", '"43"'),
        r":5: column 1: 'fov_deg' is '43'",
    ),
    ("nan in toml", lambda f: edit(f / "flight.toml", "43.0", "nan"), r":5: column 1: 'fov_deg' is nan"),
    (
        "fov and fx",
        lambda f: edit(f / "flight.toml", "fov_deg", "fx = 3.0\nfov_deg"),
        r":5: .*both fov_deg and fx",
    ),
    ("no camera", lambda f: edit(f / "flight.toml", "fov_deg = 43.0", ""), "neither fov_deg nor fx"),
    ("fold", lambda f: edit(f / "flight.toml", "fov_deg = 43.0", LENS + "[-0.9,0,0,0,0]"), "fold"),
    (
        "four numbers",
        lambda f: edit(f / "flight.toml", "fov_deg = 43.0", LENS + "[0.1,0,0,0]"),
        "five numbers",
    ),
    ("no frames.csv", lambda f: (f / "frames.csv").unlink(), "frames.csv: the file is missing"),
    ("no rows", lambda f: (f / "frames.csv").write_text("t_s,file\n"), r"frames.csv:2: no row"),
    (
        "no header",
        lambda f: (f / "frames.csv").write_text("0,f0.jpg\n"),
        r"frames.csv:1: column 1: '0' is no column",
    ),
    (
        "unknown column",
        lambda f: edit(f / "frames.csv", "agl_m", "agl"),
        r"frames.csv:1: column 3: 'agl' .*'agl_m'",
    ),
    (
        "missing time",
        lambda f: edit(f / "frames.csv", "5,f1.jpg", ",f1.jpg"),
        r"frames.csv:3: column t_s: the value is missing",
    ),
    (
        "time goes back",
        lambda f: edit(f / "frames.csv", "10,f2", "4,f2"),
        r"frames.csv:4: column t_s: .* order of time",
    ),
    ("time repeats", lambda f: edit(f / "frames.csv", "10,f2", "5,f2"), r"frames.csv:4: column t_s"),
    (
        "nan",
        lambda f: edit(f / "frames.csv", "151", "nan"),
        r"frames.csv:3: column agl_m: 'nan' is not a finite",
    ),
    (
        "agl zero",
        lambda f: edit(f / "frames.csv", "151", "0"),
        r"frames.csv:3: column agl_m: 0 is not within",
    ),
    (
        "agl absurd",
        lambda f: edit(f / "frames.csv", "151", "99999"),
        r"frames.csv:3: column agl_m: 99999 is not within",
    ),
    (
        "short row",
        lambda f: edit(f / "frames.csv", ",151,1.0,-2.0,359", ",151,1.0"),
        r"frames.csv:3: column 5: 4 cells",
    ),
    (
        "frame twice",
        lambda f: edit(f / "frames.csv", "f1.jpg", "f0.jpg"),
        r"frames.csv:3: column file: .*line 2",
    ),
    (
        "frame elsewhere",
        lambda f: edit(f / "frames.csv", "f1.jpg", "../f1.jpg"),
        r"frames.csv:3: column file",
    ),
    (
        "roll alone",
        lambda f: (f / "frames.csv").write_text("t_s,file,agl_m,roll_deg\n0,f0.jpg,150,1\n"),
        "go together",
    ),
    ("upside down", lambda f: edit(f / "frames.csv", "151,1.0", "151,180"), r"frames.csv:3: column roll_deg"),
    (
        "missing frame",
        lambda f: (f / "frames/f2.jpg").unlink(),
        r"frames.csv:4: column file: .*f2.jpg is missing",
    ),
    (
        "missing mask",
        lambda f: (f / "masks/f2.png").unlink(),
        r"frames.csv:4: column file: .*f2.png is missing",
    ),
    (
        "junk frame",
        lambda f: (f / "frames/f2.jpg").write_bytes(b"junk" * 99) and None,
        "f2.jpg: no readable image",
    ),
    (
        "small frame",
        lambda f: png(f / "frames/f2.jpg", np.zeros((12, 16, 3), np.uint8)),
        "f2.jpg: 16 x 12 pixels",
    ),
    ("small mask", lambda f: png(f / "masks/f2.png", np.zeros((12, 16), np.uint8)), "f2.png: 16 x 12 pixels"),
    (
        "height unknown",
        lambda f: edit(f / "flight.toml", '"frames"', '"baro"'),
        r"flight.toml:14: column 1: source is 'baro'",
    ),
    ("no fixed height", lambda f: edit(f / "flight.toml", '"frames"', '"fixed"'), "fixed_m"),
    ("fixed zero", lambda f: edit(f / "flight.toml", '"frames"', '"fixed"\nfixed_m = 0'), r":15: .*fixed_m"),
    (
        "no altimeter",
        lambda f: edit(f / "flight.toml", '"frames"', '"altimeter"'),
        "altimeter.csv: the file is missing",
    ),
    ("no agl", lambda f: (f / "frames.csv").write_text("t_s,file\n0,f0.jpg\n"), "no column agl_m"),
    ("odometry gone", lambda f: (f / "odometry.csv").unlink(), "odometry.csv: the file is missing"),
    ("no format", lambda f: edit(f / "flight.toml", 'format = "csv"\n', ""), r"flight.toml:10: .*'format'"),
    ("no bag", lambda f: edit(f / "flight.toml", '"csv"', '"rosbag"'), "damaged, cut short or not indexed"),
    (
        "quaternion order",
        lambda f: edit(f / "flight.toml", '"csv"', '"csv"\nquaternion = "zyxw"'),
        "'xyzw' or 'wxyz'",
    ),
    (
        "quaternion length",
        lambda f: edit(f / "odometry.csv", "1,1,0,0,0", "1,0.5,0,0,0"),
        r"odometry.csv:2: column qw,qx,qy,qz",
    ),
    (
        "other flight",
        lambda f: (f / "odometry.csv").write_text("t_s,x,y,z,qw,qx,qy,qz\n900,0,0,0,1,0,0,0\n"),
        "odometry of another flight",
    ),
    (
        "on its side",
        lambda f: (f / "odometry.csv").write_text(
            (f / "odometry.csv").read_text().replace("1,1,0,0,0", "1,0.6,0.8,0,0")
        ),
        "upright body",
    ),
    ("no reference", lambda f: (f / "reference.csv").unlink(), "reference.csv is missing"),
]


@pytest.mark.parametrize(("fault", "message"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS])
def test_faults_are_refused(folder: Path, fault: Fault, message: str) -> None:
    fault(folder)
    with pytest.raises(FlightError, match=message) as caught:
        read_flight(folder)
    assert "\n" not in str(caught.value)


REFERENCE_FAULTS: list[tuple[str, Fault, str]] = [
    (
        "projected as degrees",
        lambda f: (f / "reference.csv").write_text("t_s,lon,lat\n0,229000,379000\n"),
        r"reference.csv:2: column lon: 229000",
    ),
    ("degrees as projected", lambda f: edit(f / "flight.toml", "EPSG:4326", "EPSG:5187"), "columns lon, lat"),
    (
        "degrees named x, y",
        lambda f: (
            edit(f / "reference.csv", "lon,lat", "x,y"),
            edit(f / "flight.toml", "EPSG:4326", "EPSG:5187"),
        ),
        r"reference.csv:2: column x: .*outside the area",
    ),
    (
        "x, y without crs",
        lambda f: (
            edit(f / "reference.csv", "lon,lat", "x,y"),
            edit(f / "flight.toml", 'crs = "EPSG:4326"', ""),
        ),
        "need a CRS",
    ),
    ("x, y in degrees", lambda f: edit(f / "reference.csv", "lon,lat", "x,y"), "columns x, y"),
    ("unknown crs", lambda f: edit(f / "flight.toml", "EPSG:4326", "EPSG:999999"), "not known"),
    (
        "swapped",
        lambda f: (f / "reference.csv").write_text("t_s,lon,lat\n0,36.0,129.3\n"),
        "column lat: 129.3",
    ),
    (
        "other times",
        lambda f: (f / "reference.csv").write_text("t_s,lon,lat\n900,129.3,36.0\n"),
        "reference of another flight",
    ),
    ("nan", lambda f: edit(f / "reference.csv", "36.01", "nan"), r"reference.csv:2: column lat: 'nan'"),
    (
        "time goes back",
        lambda f: edit(f / "reference.csv", "\n0.2,", "\n0.05,"),
        r"reference.csv:4: column t_s",
    ),
]


@pytest.mark.parametrize(
    ("fault", "message"), [f[1:] for f in REFERENCE_FAULTS], ids=[f[0] for f in REFERENCE_FAULTS]
)
def test_faults_of_the_reference_are_refused(folder: Path, fault: Fault, message: str) -> None:
    fault(folder)
    flight = read_flight(folder)  # never read while estimating
    with pytest.raises(FlightError, match=message):
        flight.reference(CRS)


@pytest.mark.parametrize(("value", "message"), [(1, "is 1: 0 is other"), (128, "is 128: 0 is other")])
def test_masks_of_other_values_are_refused(folder: Path, value: int, message: str) -> None:
    png(folder / "masks/f1.png", np.full((24, 32), value, np.uint8))
    with pytest.raises(FlightError, match=message):
        read_flight(folder).mask(1)


def test_a_truncated_image_is_refused_when_it_is_read(folder: Path) -> None:
    whole = (folder / "masks/f1.png").read_bytes()
    (folder / "masks/f1.png").write_bytes(whole[: len(whole) // 2])
    flight = read_flight(folder)
    with pytest.raises(FlightError, match=r"f1\.png"):
        flight.mask(1)


# ---------------------------------------------------------------- the real flight


@pytest.fixture(scope="module")
def sheffield() -> tuple[Flight, np.ndarray, list[float | None], list[shapely.Polygon]]:
    if not SHEFFIELD.is_dir():
        pytest.skip("the real flight is not here (BRMGEO_REAL_DATA)")
    import pyogrio

    flight = read_flight(SHEFFIELD)
    reference = flight.reference("EPSG:32617")
    assert reference is not None
    xy = reference.at(flight.times_s)
    roofs = shapely.get_parts(shapely.from_wkb(pyogrio.raw.read(SHEFFIELD / "footprints.gpkg")[2]))
    return flight, xy, flight.compass_yaw_rad("EPSG:32617", *xy[0]), list(roofs)


def overlap(
    data: tuple[Flight, np.ndarray, list[float | None], list[shapely.Polygon]], pitch_off_deg: float
) -> float:
    flight, xy, yaw, roofs = data
    mount = flight.mount
    mount = type(mount)(mount.roll_rad, mount.pitch_rad + math.radians(pitch_off_deg), mount.yaw_rad)
    shares = []
    for i in range(0, len(flight.frames), 3):
        frame, heading = flight.frames[i], yaw[i]
        assert heading is not None
        rotation = world_from_camera(mount, frame.roll_rad, frame.pitch_rad, heading)
        drawn = np.zeros((flight.camera.height, flight.camera.width), np.uint8)
        for roof in roofs:
            ring = np.c_[shapely.get_coordinates(roof.exterior), np.zeros(len(roof.exterior.coords))]
            uv = pixel_from_point(flight.camera, rotation, np.array([*xy[i], frame.agl_m]), ring)
            if np.isfinite(uv).all() and np.abs(uv).max() < 1e4:
                cv2.fillPoly(drawn, [np.round(uv * 16).astype(np.int32)], 255, shift=4)
        mask = flight.mask(i)
        either = ((drawn > 0) | (mask > 0)).sum()
        if either > 500:
            shares.append(((drawn > 0) & (mask > 0)).sum() / either)
    assert len(shares) > 20
    return float(np.median(shares))


def test_traced_roofs_and_real_masks_overlap_as_flight_md_says(
    sheffield: tuple[Flight, np.ndarray, list[float | None], list[shapely.Polygon]],
) -> None:
    assert overlap(sheffield, 0.0) > 0.955
    assert overlap(sheffield, 5.0) < 0.8


def test_real_views_lie_on_the_map(
    sheffield: tuple[Flight, np.ndarray, list[float | None], list[shapely.Polygon]],
) -> None:
    flight, xy, yaw, roofs = sheffield
    tree = shapely.union_all(np.array(roofs, dtype=object))
    shapely.prepare(tree)
    agreement = []
    for i in range(0, len(flight.frames), 8):
        frame, heading = flight.frames[i], yaw[i]
        assert heading is not None
        view = make_view(
            flight.mask(i), flight.camera, flight.mount, frame.roll_rad, frame.pitch_rad, frame.agl_m, 0.5
        )
        rows, cols = np.nonzero(view.known)
        ahead = (view.nadir_px[0] - rows - 0.5) * view.gsd_m
        left = (view.nadir_px[1] - cols - 0.5) * view.gsd_m
        x = xy[i, 0] + ahead * math.cos(heading) - left * math.sin(heading)
        y = xy[i, 1] + ahead * math.sin(heading) + left * math.cos(heading)
        on_map = shapely.contains_xy(tree, x, y)
        in_view = view.building[rows, cols] > 0.5
        agreement.append((on_map & in_view).sum() / max((on_map | in_view).sum(), 1))
    assert np.median(agreement) > 0.94
