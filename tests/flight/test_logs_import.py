"""`brmgeo import` and `brmgeo inspect`: whole flight folders out of logs, and every fault in one clear line."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from log_writers import (
    ENU_FROM_FLU,
    LAT0,
    WXYZ,
    XYZ,
    T,
    bag,
    dataflash,
    dji,
    photo,
    picture,
    px4,
    turn_between,
)
from scipy.spatial.transform import Rotation
from small_flights import command

from brmgeo.flight import checks
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.logs import read_log
from brmgeo.flight.logs.inspect import inspect
from brmgeo.flight.odometry import read_odometry
from brmgeo.flight.readings import BODY_FROM_NADIR_CAMERA
from brmgeo.synth.flight import OdometryErrors, SimulationSettings, fly, lawnmower, odometry_of

pytest.importorskip("rosbags")
pytest.importorskip("pyulog")
pytest.importorskip("pymavlink")


def good(out: Path, *arguments: object) -> Flight:
    status, said = command("import", *arguments, "--out", out)
    assert status == 0, said
    return read_flight(out)


def refused(out: Path, *arguments: object) -> str:
    status, said = command("import", *arguments, "--out", out)
    assert status == 2, said
    assert said.startswith("brmgeo: ")
    assert said.count("\n") == 1, "one line"
    assert not out.exists(), "nothing half-made is left"
    assert list(out.parent.glob(f".{out.name}*")) == []
    return said


def shots(folder: Path, count: int, every_s: int = 3, **fields: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        photo(
            folder / f"DSC{i:04d}.JPG",
            time=f"2024:05:06 10:20:{10 + every_s * i}",
            lat=LAT0 + i * 1e-4,
            **fields,
        )  # type: ignore[arg-type]
    return folder


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_becomes_a_whole_flight(tmp_path: Path, kind: str) -> None:
    flight = good(tmp_path / "flight", bag(tmp_path / "log", kind), "--name", "over the town")
    assert flight.name == "over the town"
    assert np.allclose(flight.times_s, T[::20], atol=1e-6)
    assert np.allclose([f.agl_m for f in flight.frames], XYZ[::20, 2], atol=1e-3)
    # Roll and pitch come of the odometry; there is no north in it, so no compass.
    ypr = ENU_FROM_FLU[::20].as_euler("ZYX")
    assert np.allclose([f.pitch_rad for f in flight.frames], ypr[:, 1], atol=1e-5)
    assert np.allclose([f.roll_rad for f in flight.frames], ypr[:, 2], atol=1e-5)
    assert flight.frames[0].true_heading_deg is None
    assert flight.odometry is not None
    assert np.abs(flight.odometry.xyz_m - XYZ).max() < 1e-4
    assert turn_between(flight.odometry.wxyz, WXYZ) < 1e-6
    assert (flight.camera.fx, flight.camera.distortion[0]) == (50.0, 0.01)
    assert np.array_equal(flight.image(7)[:, :, ::-1], picture(7))
    imu = flight.imu()
    assert imu is not None
    assert len(imu.t_s) == len(T)
    reference = flight.reference("EPSG:5187")
    assert reference is not None
    assert reference.sigma_m == pytest.approx(np.full(len(T) // 4, 0.8))
    moved = reference.xy_m[-1] - reference.xy_m[0]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm((XYZ[::4][-1] - XYZ[0])[:2]), rel=0.01)


def test_frames_can_be_thinned_and_shifted(tmp_path: Path) -> None:
    path = bag(tmp_path / "log", "mcap", encoding="jpeg", image_clock_s=3.0)
    assert "clocks are not synchronised" in refused(tmp_path / "a", path)
    path = bag(tmp_path / "other", "mcap", encoding="jpeg", image_clock_s=0.4)
    flight = good(tmp_path / "b", path, "--shift-frames", "-0.4", "--rate", "0.5")
    assert np.allclose(flight.times_s, T[::40], atol=1e-6)


def test_a_px4_log_and_its_photos_become_a_whole_flight(tmp_path: Path) -> None:
    log = px4(tmp_path / "log.ulg", version="new")
    photos = shots(tmp_path / "photos", 7)
    flight = good(tmp_path / "flight", log, "--photos", photos)
    assert np.allclose(flight.times_s, T[::60], atol=1e-6)
    assert flight.has_images
    ypr = ENU_FROM_FLU[::60].as_euler("ZYX")
    assert np.allclose([f.pitch_rad for f in flight.frames], ypr[:, 1], atol=1e-4)
    heading = [f.true_heading_deg for f in flight.frames]
    assert np.allclose(heading, (90.0 - np.degrees(ypr[:, 0])) % 360.0, atol=0.01)
    assert flight.odometry is not None
    segment = flight.odometry.segment
    assert segment is not None
    assert int(np.flatnonzero(np.diff(segment))[0]) == 199
    assert (
        "GNSS went into this odometry"
        in command("import", log, "--photos", photos, "--out", tmp_path / "again")[1]
    )
    extra = photo(photos / "DSC0099.JPG", time="2024:05:06 10:20:55")
    assert "7 camera triggers for 8 photos" in refused(tmp_path / "c", log, "--photos", photos)
    extra.unlink()
    photo(photos / "DSC0006.JPG", time="2024:05:06 10:25:55")
    assert "are of another flight" in refused(tmp_path / "d", log, "--photos", photos)


def test_a_log_and_its_video_become_a_whole_flight(tmp_path: Path) -> None:
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(50):
        video.write(picture(i % 20))
    video.release()
    log = dataflash(tmp_path / "log.bin")
    options = log, "--video", tmp_path / "v.avi", "--fov", 43
    assert "--video-start" in refused(tmp_path / "a", *options)
    flight = good(tmp_path / "b", *options, "--video-start", 103.0)
    assert np.allclose(flight.times_s, 103.0 + np.arange(50) / 10.0)
    assert np.abs(flight.image(3)[:, :, ::-1].astype(int) - picture(3)).mean() < 12


def test_photos_become_a_whole_flight(tmp_path: Path) -> None:
    photos = shots(tmp_path / "photos", 5, xmp=dji((0.0, -74.0, 88.0), 63.5))
    flight = good(tmp_path / "flight", photos)
    assert flight.times_s.tolist() == [0.0, 3.0, 6.0, 9.0, 12.0]
    assert [f.agl_m for f in flight.frames] == [63.5] * 5
    assert np.degrees(flight.frames[0].pitch_rad) == pytest.approx(-16.0, abs=1e-3)
    assert flight.frames[0].true_heading_deg == pytest.approx(88.0, abs=1e-3)
    reference = flight.reference("EPSG:5187")
    assert reference is not None
    step = np.linalg.norm(np.diff(reference.xy_m, axis=0), axis=1)
    assert step == pytest.approx(np.full(4, 11.1), abs=0.1)
    plain = shots(tmp_path / "plain", 3)
    assert "(--agl FLOAT)" in refused(tmp_path / "a", plain)
    assert [f.agl_m for f in good(tmp_path / "b", plain, "--agl", 80).frames] == [80.0] * 3
    assert [f.agl_m for f in good(tmp_path / "c", plain, "--ground", 40).frames] == [120.0] * 3


def test_text_needs_no_library_and_its_body_can_be_turned(tmp_path: Path) -> None:
    path = tmp_path / "vio.csv"
    # An IMU that is built in with its x axis up, as EuRoC's is.
    flu_from_imu = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    from scipy.spatial.transform import Rotation

    turned = (ENU_FROM_FLU * Rotation.from_matrix(flu_from_imu)).as_quat()[:, [3, 0, 1, 2]]
    path.write_text("\n".join(",".join(f"{v:.9f}" for v in (t, *p, *q)) for t, p, q in zip(T, XYZ, turned)))
    said = refused(tmp_path / "a", path)
    assert "its +x axis points up" in said
    assert "body_deg 0,-90,0" in said
    status, _ = command("import", path, "--out", tmp_path / "b", "--body", "0,-90,0")
    assert status == 0
    from brmgeo.flight.odometry import read_odometry

    assert turn_between(read_odometry(tmp_path / "b" / "odometry.csv", "csv").wxyz, WXYZ) < 1e-5


def test_faults_are_one_line_and_named(tmp_path: Path) -> None:
    late = bag(tmp_path / "late", "mcap", imu_late_s=0.9, topics=("odom", "imu"))
    assert "clocks are not synchronised" in refused(tmp_path / "a", late)
    degrees = bag(tmp_path / "deg", "mcap", imu_scale=(180 / np.pi, 1.0), topics=("odom", "imu"))
    assert "it is in deg/s, not rad/s: give imu_units deg/s (--imu-units TEXT)" in refused(
        tmp_path / "b", degrees
    )
    gravity = bag(tmp_path / "g", "mcap", imu_scale=(1.0, 1 / 9.80665), topics=("odom", "imu"))
    assert "it is in g, not m/s2: give imu_units g (--imu-units TEXT)" in refused(tmp_path / "c", gravity)
    assert command("import", gravity, "--out", tmp_path / "d", "--imu-units", "g")[0] == 0
    for path, word in ((late, "synchronised"), (degrees, "deg/s"), (gravity, "it is in g")):
        assert any(word in line for line in inspect(path) if line.startswith("  FAULT"))

    nowhere = dataflash(tmp_path / "log.bin", position=False)
    nowhere.write_bytes(nowhere.read_bytes().replace(b"GPS\x00", b"XPS\x00"))
    assert "no position and no pictures" in refused(tmp_path / "e", nowhere)
    order = tmp_path / "o.tum"
    order.write_text("\n".join(" ".join(f"{v:.9f}" for v in (t, *p, *q)) for t, p, q in zip(T, XYZ, WXYZ)))
    assert 'look like wxyz: give quaternion = "wxyz"' in refused(tmp_path / "f", order)
    assert command("import", order, "--out", tmp_path / "n", "--quaternion", "wxyz")[0] == 0
    assert any("look like wxyz" in line for line in inspect(order) if line.startswith("  FAULT"))

    two = bag(tmp_path / "two", "mcap", topics=("odom",), twice=True)
    assert "choose one of /vins/odometry (400), /other/odometry (400) (--topic TEXT)" in refused(
        tmp_path / "h", two
    )
    assert "is there already" in command("import", order, "--out", tmp_path / "n")[1]
    assert "--imu-units 'furlong' is unknown" in refused(tmp_path / "i", order, "--imu-units", "furlong")
    assert "--camera has 3 numbers" in refused(tmp_path / "j", order, "--camera", "1,2,3")
    both = "--camera", "100,100,50,50", "--fov", 43
    assert "--camera and --fov both" in refused(tmp_path / "both", order, *both)
    images = bag(tmp_path / "images", "mcap", topics=("odom", "image"))
    assert "tells no height" in refused(tmp_path / "k", images)
    assert "(--fov FLOAT)" in refused(tmp_path / "l", images, "--agl", 60)
    assert good(tmp_path / "m", images, "--agl", 60, "--fov", 43).frames[3].agl_m == 60.0
    code, told = command("import", images, "--out", tmp_path / "o", "--agl", 60, "--camera", "50,51,30,20")
    assert code == 0, told
    assert ", fx 50.0, fy 51.0, cx 30.0, cy 20.0 (" in told
    assert "as given; mount roll 0, pitch 0, yaw 0" in told


def test_options_that_a_log_has_no_use_for_are_told(tmp_path: Path) -> None:
    path, times = tmp_path / "o.tum", tmp_path / "times.txt"
    path.write_text(
        "\n".join(" ".join(f"{v:.9f}" for v in (t, *p, *q)) for t, p, q in zip(T, XYZ, WXYZ[:, [1, 2, 3, 0]]))
    )
    times.write_text("\n".join(map(str, range(30))))
    words = [
        "--topic",
        "a",
        "--image-topic",
        "b",
        "--imu-topic",
        "c",
        "--times",
        times,
        "--video-start",
        1,
        "--agl",
        9,
        "--ground",
        2,
    ]
    status, said = command("import", path, "--out", tmp_path / "out", *words)
    assert status == 0
    left = [line.split()[0] for line in said.splitlines() if "was left out" in line]
    assert left == [
        "--video-start",
        "--image-topic",
        "--imu-topic",
        "--topic",
        "--times",
        "--agl",
        "--ground",
    ]
    log = dataflash(tmp_path / "log.bin")
    status, said = command(
        "import", log, "--out", tmp_path / "bin", "--format", "tum", "--quaternion", "xyzw"
    )
    assert status == 0
    assert "--format was left out" in said
    assert "--quaternion was left out" in said


def test_kitti_needs_times(tmp_path: Path) -> None:
    path, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    path.write_text("\n".join(f"1 0 0 {0.5 * i} 0 1 0 0 0 0 1 0" for i in range(30)))
    assert "30 poses for no frames" in refused(tmp_path / "a", path)
    times.write_text("\n".join(f"{0.1 * i:.3e}" for i in range(30)))
    assert command("import", path, "--times", times, "--out", tmp_path / "b")[0] == 0
    status, said = command("inspect", path, "--times", times)
    assert status == 0
    assert "30 in 2.9 s, 10.0 Hz" in said


def test_inspect_tells_what_is_in_a_log(tmp_path: Path) -> None:
    said = "\n".join(inspect(bag(tmp_path / "log", "mcap")))
    length = np.linalg.norm(np.diff(XYZ, axis=0), axis=1).sum()
    assert f"{length:.1f} m long" in said
    assert "400 in 20.0 s, 20.0 Hz" in said
    assert "about 36.02" in said
    assert "accuracy 0.80 m" in said
    assert "looks like m/s2, rad/s" in said
    assert "20 of 64 x 48" in said
    assert "against GNSS 0." in said
    assert "FAULT" not in said
    said = "\n".join(inspect(px4(tmp_path / "log.ulg", dropout_ms=300)))
    assert "1 told by the log: xy_reset_counter at 110.00 s" in said
    assert "1 dropouts, 0.300 s lost" in said
    good(tmp_path / "flight", tmp_path / "log")
    said = "\n".join(inspect(tmp_path / "flight"))
    assert "flight folder 'log'" in said
    (tmp_path / "words.txt").write_text("no log\n")
    status, said = command("inspect", tmp_path / "words.txt", tmp_path / "log.ulg")
    assert status == 2
    assert "vehicle_local_position" in said
    assert "1 of 2 paths could not be read" in said
    document = tmp_path / "logs.md"
    assert command("inspect", tmp_path / "log.ulg", tmp_path / "flight", "--write", document)[0] == 0
    assert document.read_text().count("\n## ") == 2


def test_photos_that_tell_no_attitude_say_so_in_the_flight(tmp_path: Path) -> None:
    photos = shots(tmp_path / "photos", 4)
    flight = good(tmp_path / "untold", photos, "--agl", 60)
    assert math.degrees(flight.mount_sigma_rad) == pytest.approx(10.0)
    assert "sigma_deg = 10.0" in (tmp_path / "untold" / "flight.toml").read_text()
    status, said = command("import", photos, "--agl", 60, "--out", tmp_path / "again")
    assert status == 0
    assert "known to 10 degrees: nothing tells how the camera looks" in said
    assert good(tmp_path / "told", photos, "--agl", 60, "--mount", "0,-15,0").mount_sigma_rad == 0.0
    gimbal = shots(tmp_path / "gimbal", 4, xmp=dji((0.0, -90.0, 46.0)))
    assert good(tmp_path / "held", gimbal, "--agl", 60).mount_sigma_rad == 0.0


def test_a_downward_cameras_track_is_refused_until_its_axes_are_told(tmp_path: Path) -> None:
    course = fly(lawnmower((0.0, 0.0, 400.0, 300.0), 75.0), SimulationSettings(), 2)
    track = odometry_of(course, OdometryErrors(), 2)
    turn = Rotation.from_matrix(BODY_FROM_NADIR_CAMERA)
    poses = turn.inv() * Rotation.from_quat(track.wxyz[:, [1, 2, 3, 0]]) * turn
    xyz = turn.inv().apply(track.xyz_m)
    rows = np.column_stack([track.t_s, xyz - xyz[0], poses.as_quat()])
    np.savetxt(tmp_path / "camera.txt", rows, fmt="%.9f")
    assert "give axes nadir (a camera that looks down)" in refused(tmp_path / "a", tmp_path / "camera.txt")
    status, said = command("import", tmp_path / "camera.txt", "--axes", "nadir", "--out", tmp_path / "b")
    assert status == 0, said
    found = read_odometry(tmp_path / "b" / "odometry.csv", "csv")
    assert checks.mirrored_m(found.xyz_m[:, :2], track.xyz_m[:, :2])[0] < 0.01
    # Whole nanoseconds, as ORB-SLAM3 writes them, say nothing of the quaternion's order; the turns do.
    lines = [" ".join([str(round(r[0] * 1e9) + 10**18), *(f"{v:.9f}" for v in r[1:])]) for r in rows]
    (tmp_path / "ns.txt").write_text("\n".join(lines))
    log = read_log(tmp_path / "ns.txt")
    assert log.kind == "tum"
    assert log.odometry is not None
    assert log.odometry.t_s[0] == pytest.approx(1e9)


@pytest.mark.parametrize(
    ("head", "order"),
    [
        (
            "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_x, v_y, v_z, b, b, b, b",
            "xyzw",
        ),
        ("timestamp,x,y,z,qw,qx,qy,qz,vx,vy,vz,bgx,bgy,bgz,bax", "wxyz"),
        (
            "#timestamp [ns], p_x [m], p_y [m], p_z [m], q_x [], q_y [], q_z [], q_w [], v, v, v, b, b, b, b",
            "xyzw",
        ),
    ],
)
def test_a_headers_names_tell_the_quaternions_order(tmp_path: Path, head: str, order: str) -> None:
    cells = [[1658132905797695744 + i * 10**8, 0.5 * i, 0.0, 50.0, *turn, *[0.0] * 7] for i, turn in
             enumerate(([0.0, 0.0, 0.0, 1.0] if order == "xyzw" else [1.0, 0.0, 0.0, 0.0],) * 60)]  # fmt: skip
    lines = [head, *(",".join(map(str, row)) for row in cells)]
    (tmp_path / "vio.csv").write_text("\n".join(lines))
    log = read_log(tmp_path / "vio.csv")
    assert log.odometry is not None
    assert len(log.odometry.t_s) == 60
    assert log.odometry.wxyz == pytest.approx(np.tile([1.0, 0.0, 0.0, 0.0], (60, 1)))
