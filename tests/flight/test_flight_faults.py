"""Faults of flight folders that once went by unseen, or ended in a traceback."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from log_writers import XYZ, N, T, bag, dataflash, shots_of, telemetry

from brmgeo.errors import FlightError
from brmgeo.flight.camera import distort
from brmgeo.flight.folder import read_flight
from brmgeo.flight.logs import read_log
from brmgeo.flight.odometry import OdometryOptions, read_odometry
from brmgeo.flight.readings import Camera

TOML = """name = "small"
[camera]
width = 64
height = 48
fov_deg = 43.0
[height]
source = "frames"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "flight"
    (root / "frames").mkdir(parents=True)
    (root / "masks").mkdir()
    rng = np.random.default_rng(1)
    for i in range(3):
        picture = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        (root / "frames" / f"f{i}.jpg").write_bytes(cv2.imencode(".jpg", picture)[1].tobytes())
        mask = (rng.random((48, 64)) < 0.5).astype(np.uint8) * 255
        (root / "masks" / f"f{i}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    rows = [f"{i},f{i}.jpg,100,{4.0 * i},0" for i in range(3)]
    (root / "frames.csv").write_text("\n".join(["t_s,file,agl_m,roll_deg,pitch_deg", *rows]) + "\n")
    (root / "flight.toml").write_text(TOML)
    return root


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
def test_a_picture_cut_short_is_no_picture(folder: Path, share: float) -> None:
    flight = read_flight(folder)
    for kind in ("frames/f1.jpg", "masks/f1.png"):
        path = folder / kind
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FlightError, match=r"f1\.jpg: .*cut short"):
        flight.image(1)
    with pytest.raises(FlightError, match=r"f1\.png: .*(cut short|no picture that can be decoded)"):
        flight.mask(1)


def test_what_a_camera_adds_behind_the_picture_does_not_matter(folder: Path) -> None:
    flight = read_flight(folder)
    before = flight.image(1)
    path = folder / "frames" / "f1.jpg"
    path.write_bytes(path.read_bytes() + b"maker's own words" * 9)
    assert np.array_equal(flight.image(1), before)


def kitti(folder: Path, count: int) -> None:
    rows = [f"1 0 0 {i} 0 1 0 0 0 0 1 0" for i in range(count)]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    (folder / "flight.toml").write_text(TOML + '[odometry]\nfile = "poses.txt"\nformat = "kitti"\n')


def test_kitti_poses_have_a_file_of_times(folder: Path) -> None:
    kitti(folder, 21)
    with pytest.raises(FlightError, match=r"21 poses for 3 frames: .*times"):
        read_flight(folder)
    toml = folder / "flight.toml"
    toml.write_text(toml.read_text() + 'times = "times.txt"\n')
    times = 0.9 + np.arange(21) / 20.0
    (folder / "times.txt").write_text("".join(f"{t:e}\n" for t in times))
    odometry = read_flight(folder).odometry
    assert odometry is not None
    assert np.allclose(odometry.t_s, times, atol=1e-6)
    # The first pose is at 0.9 s: the camera's tilt there is that of the frame at 1 s, 4 degrees to the right.
    assert odometry.xyz_m[-1] == pytest.approx(
        [0.0, -20.0 * np.cos(np.radians(4)), -20.0 * np.sin(np.radians(4))]
    )
    (folder / "times.txt").write_text("0.9\n1.0\n")
    with pytest.raises(FlightError, match="21 poses for 2 times"):
        read_flight(folder)
    (folder / "times.txt").write_text("0.9\n1.1\n1.0\n")
    with pytest.raises(FlightError, match=r"times\.txt:3: .*order of time"):
        read_flight(folder)
    toml.write_text(toml.read_text().replace('"kitti"', '"tum"'))
    with pytest.raises(FlightError, match=r"flight\.toml:\d+: .*tum has its own"):
        read_flight(folder)


@pytest.mark.parametrize("bend", [(0.0, 0.0, 2.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.5, 0.0)])
def test_tangential_distortion_that_folds_is_refused(folder: Path, bend: tuple[float, ...]) -> None:
    camera = Camera.from_fov(64, 48, 43.0)
    words = f"fx = {camera.fx}\nfy = {camera.fy}\ncx = 31.5\ncy = 23.5\ndistortion = "
    toml = folder / "flight.toml"
    toml.write_text(TOML.replace("fov_deg = 43.0\n", words + f"{list(bend)}\n"))
    with pytest.raises(FlightError, match=r"flight\.toml:\d+: .*fold"):
        read_flight(folder)
    # Of the same kind, and a hundred times less: a real lens.
    toml.write_text(TOML.replace("fov_deg = 43.0\n", words + f"{[v / 100.0 for v in bend]}\n"))
    assert read_flight(folder).camera.is_distorted
    assert not np.allclose(distort(read_flight(folder).camera, np.array([0.3, 0.2])), [0.3, 0.2])


def test_an_empty_odometry_section_is_not_none(folder: Path) -> None:
    (folder / "flight.toml").write_text(TOML + "[odometry]\n")
    with pytest.raises(FlightError, match=r"flight\.toml:\d+: .*no 'file'"):
        read_flight(folder)


def test_what_a_killed_brmgeo_odometry_leaves_is_no_stray(folder: Path) -> None:
    (folder / "odometry.tum").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(FlightError, match="no \\[odometry\\] section"):
        read_flight(folder)
    (folder / "odometry.json").write_text(json.dumps({"made_by": "brmgeo odometry"}))
    assert read_flight(folder).odometry is None


def test_a_stereo_bag_is_odometry(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    path = bag(tmp_path / "log", "mcap", topics=("odom", "image", "second image", "imu"))
    with pytest.raises(FlightError, match="2 streams hold pictures"):
        read_log(path)
    odometry = read_odometry(path, "rosbag", OdometryOptions())
    assert np.allclose(odometry.t_s, T, atol=1e-6)
    assert np.abs(odometry.xyz_m - XYZ).max() < 1e-6


def test_time_marks_are_of_the_camera_already(tmp_path: Path) -> None:
    # DJI: "latitude after compensation": the 36 mm north and -120 mm east from the antenna are in the place.
    folder = shots_of(tmp_path / "photos", 3)
    rows = [
        f"{i + 1}\t{100000 + 2.5 * i:.6f}\t[2300]\t   36,N\t -120,E\t  190,V\t{36.5 + i * 1e-4:.8f},Lat\t128.50000000,Lon\t"
        "180.500,Ellh\t0.011, 0.013, 0.030\t50,Q"
        for i in range(3)
    ]
    (folder / "flight_Timestamp.MRK").write_text("\n".join(rows))
    gnss = read_log(folder).gnss
    assert gnss is not None
    assert gnss.lat_deg.tolist() == pytest.approx([36.5, 36.5001, 36.5002], abs=1e-9)
    assert gnss.lon_deg.tolist() == pytest.approx([128.5] * 3, abs=1e-9)


def test_a_dataflash_log_of_a_camera_that_saw_nothing(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    seen = read_log(dataflash(tmp_path / "seen.bin", vision=1.0)).odometry
    assert seen is not None
    assert seen.source == "VISP"
    assert np.abs(seen.xyz_m - XYZ).max() < 1e-3
    assert seen.segment is not None
    assert np.flatnonzero(np.diff(seen.segment)).tolist() == [199]
    blind = read_log(dataflash(tmp_path / "blind.bin", vision=float("nan")))
    assert blind.candidates == ("XKF1",)
    assert read_log(dataflash(tmp_path / "alone.bin", vision=float("nan"), position=False)).odometry is None


@pytest.mark.parametrize("what", ["local_position_ned", "attitude", "vision_position_estimate"])
def test_a_stream_that_says_nothing_is_not_there(tmp_path: Path, what: str) -> None:
    pytest.importorskip("pymavlink")
    log = read_log(telemetry(tmp_path / "flight.tlog", empty=what))
    assert log.imu is not None
    assert len(log.imu.t_s) == N
    assert (log.attitude is None) == (what == "attitude")
    assert (log.odometry is None) == (what in ("local_position_ned", "attitude"))
