"""Odometry files: each format gives the same track, and each fault is refused with its line."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brmgeo.errors import FlightError
from brmgeo.flight.odometry import OdometryOptions, read_odometry
from brmgeo.flight.poses import read_poses
from brmgeo.flight.readings import Attitude

LOGS = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2] / "../shared/data")) / "logs"

T = 1_500_000_000.0 + np.arange(20) * 0.5
XYZ = np.stack([np.arange(20) * 2.5, np.sin(np.arange(20) / 5.0), np.full(20, 1.5)], -1)
XYZW = Rotation.from_euler(
    "ZYX", np.stack([np.arange(20) * 0.1, np.full(20, 0.05), np.full(20, -0.02)], -1)
).as_quat()


def write(path: Path, format_name: str) -> Path:
    lines = []
    for t, (x, y, z), (qx, qy, qz, qw) in zip(T, XYZ, XYZW):
        ns = f"{round(t * 10)}00000000"
        lines.append(
            {
                "tum": f"{t:.6f} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}",
                "euroc": f"{ns},{x:.9f},{y:.9f},{z:.9f},{qw:.9f},{qx:.9f},{qy:.9f},{qz:.9f},0,0,0,0,0,0,0,0,0",
                "vins-mono": f"{ns},{x:.9f},{y:.9f},{z:.9f},{qw:.9f},{qx:.9f},{qy:.9f},{qz:.9f},1,2,3,",
                "csv": f"{t:.6f},{x:.9f},{y:.9f},{z:.9f},{qw:.9f},{qx:.9f},{qy:.9f},{qz:.9f}",
            }[format_name]
        )
    head = {"euroc": ["#timestamp, p_x"], "csv": ["t_s,x,y,z,qw,qx,qy,qz"], "tum": ["# t x y z"]}
    path.write_text("\n".join([*head.get(format_name, []), *lines, ""]))
    return path


@pytest.mark.parametrize("format_name", ["tum", "euroc", "vins-mono", "csv"])
def test_formats_give_the_same_track(tmp_path: Path, format_name: str) -> None:
    found = read_odometry(write(tmp_path / "odometry.txt", format_name), format_name)
    assert np.allclose(found.t_s, T, atol=1e-6)
    assert np.allclose(found.xyz_m, XYZ, atol=1e-8)
    assert np.allclose(found.wxyz, XYZW[:, [3, 0, 1, 2]], atol=1e-8)


def test_quaternion_order_of_a_fork(tmp_path: Path) -> None:
    path = write(tmp_path / "o", "tum")
    found = read_odometry(path, "tum", OdometryOptions("wxyz"))
    assert np.allclose(found.wxyz, XYZW, atol=1e-8)
    with pytest.raises(FlightError, match="remove 'quaternion'"):
        read_odometry(write(tmp_path / "c", "csv"), "csv", OdometryOptions("xyzw"))


def test_kitti_poses_of_a_tilted_camera_come_out_level(tmp_path: Path) -> None:
    mount, first = Attitude(0.02, -0.3, 0.1), Attitude(0.04, -0.06)
    body_from_camera = mount.body_from_camera()
    level_from_camera = first.matrix() @ body_from_camera
    truth = Rotation.from_euler("ZYX", [[0.0, -0.06, 0.04], *[[0.1 * i, 0.03, -0.01] for i in range(1, 20)]])
    world_from_camera = truth.as_matrix() @ body_from_camera
    rows = []
    for rotation, xyz in zip(world_from_camera, XYZ - XYZ[0]):
        pose = np.c_[level_from_camera.T @ rotation, level_from_camera.T @ xyz]
        rows.append(" ".join(f"{v:.12e}" for v in pose.ravel()))
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(rows))
    options = OdometryOptions(None, T, level_from_camera, body_from_camera)
    found = read_odometry(path, "kitti", options)
    assert np.allclose(found.xyz_m, XYZ - XYZ[0], atol=1e-9)
    apart = (truth.inv() * Rotation.from_quat(found.wxyz[:, [1, 2, 3, 0]])).magnitude()
    assert apart.max() < 1e-7
    with pytest.raises(FlightError, match="20 poses for 19 frames"):
        read_odometry(path, "kitti", OdometryOptions(None, T[1:]))
    path.write_text("\n".join(" ".join(["1"] * 12) for _ in range(20)))
    with pytest.raises(FlightError, match=r"poses.txt:1: .*no rotation"):
        read_odometry(path, "kitti", options)


@pytest.mark.parametrize(
    ("row", "new", "message"),
    [
        (3, "1500000000.2 0 0 0 0 0 0 1", r":4: column 1: time .* order of time"),
        (3, "1500000000.5 0 0 0 0 0 0 1", r":4: column 1: time"),
        (5, "1500000002.0 nan 0 0 0 0 0 1", r":6: column 2: 'nan'"),
        (5, "1500000002.0 0 0 0 0 0 inf 1", r":6: column 7: 'inf'"),
        (5, "1500000002.0 0 0 0 0 0 0 2", r":6: column 5-8: the quaternion's length is 2.0000"),
        (5, "1500000002.0 0 0 0 0 0 0 0", r":6: column 5-8: the quaternion's length is 0.0000"),
        (5, "1500000002.0 0 0 0 0 0 0", r":6: column 7: 7 values"),
        (5, "1500000002.0 0 0 0 0 0 0 1 9", r":6: column 9: 9 values"),
        (5, "1500000002.0 0 zero 0 0 0 0 1", r":6: column 3: 'zero' is not a number"),
    ],
)
def test_faulty_rows_are_refused_with_their_place(tmp_path: Path, row: int, new: str, message: str) -> None:
    path = write(tmp_path / "o.tum", "tum")
    lines = path.read_text().splitlines()
    lines[row] = new
    path.write_text("\n".join(lines))
    with pytest.raises(FlightError, match=message):
        read_odometry(path, "tum")


def test_faulty_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "o"
    with pytest.raises(FlightError, match="missing"):
        read_odometry(path, "tum")
    path.write_text("# nothing\n")
    with pytest.raises(FlightError, match="no row"):
        read_odometry(path, "tum")
    path.write_bytes(b"\x89PNG\xff\x00")
    with pytest.raises(FlightError, match="not UTF-8"):
        read_odometry(path, "tum")
    path.write_text("1403638128.345,0,0,0,1,0,0,0\n")
    with pytest.raises(FlightError, match="nanoseconds"):
        read_odometry(path, "euroc")
    path.write_text("0,1,2\n")
    with pytest.raises(FlightError, match=r"column 1.*no column of this file"):
        read_odometry(path, "csv")


@pytest.mark.parametrize("separator", [",", " "])
@pytest.mark.parametrize("seconds", [True, False])
@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_vins_dialects_and_their_wrong_order(
    tmp_path: Path, separator: str, seconds: bool, order: str
) -> None:
    path = tmp_path / "vio.csv"
    columns = XYZW if order == "xyzw" else XYZW[:, [3, 0, 1, 2]]
    path.write_text(
        "\n".join(
            separator.join(
                [f"{t:.9f}" if seconds else f"{round(t * 10)}00000000", *(f"{v:.9f}" for v in [*p, *q])]
            )
            for t, p, q in zip(T, XYZ, columns)
        )
    )
    found = read_odometry(path, "vins-fusion", OdometryOptions(order))
    assert np.allclose(found.t_s, T, atol=1e-6)
    assert np.allclose(found.wxyz, XYZW[:, [3, 0, 1, 2]], atol=1e-8)
    if order == "xyzw":
        with pytest.raises(FlightError, match='look like xyzw: give quaternion = "xyzw"'):
            read_odometry(path, "vins-fusion")
    else:
        assert np.array_equal(read_odometry(path, "vins-mono").wxyz, found.wxyz)


def test_a_pose_told_again_counts_once_and_segments_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "o.tum", "tum")
    lines = path.read_text().splitlines()
    lines.insert(6, lines[5].replace(" ", "  "))
    path.write_text("\n".join(lines))
    assert np.array_equal(read_odometry(path, "tum").t_s, T)
    csv = tmp_path / "o.csv"
    csv.write_text("t_s,x,y,z,qw,qx,qy,qz,segment\n0,0,0,0,1,0,0,0,0\n1,1,0,0,1,0,0,0,0\n2,1,0,0,1,0,0,0,1\n")
    segment = read_odometry(csv, "csv").segment
    assert segment is not None
    assert segment.tolist() == [0, 0, 1]


@pytest.mark.parametrize("format_name", ["rosbag", "ulog", "ardupilot"])
def test_log_formats_are_found_by_name(tmp_path: Path, format_name: str) -> None:
    with pytest.raises(FlightError, match=r"log.* missing"):
        read_odometry(tmp_path / "log", format_name)


def test_unknown_formats_name_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="did you mean 'euroc'"):
        read_odometry(tmp_path / "log", "eurok")


@pytest.mark.skipif(not LOGS.is_dir(), reason="real logs are not here (BRMGEO_REAL_DATA)")
def test_real_logs() -> None:
    euroc = read_odometry(LOGS / "MH_04_difficult_gt_euroc.csv", "euroc")
    assert len(euroc.t_s) == 19753
    assert euroc.xyz_m[0] == pytest.approx([4.677066, -1.749440, 0.568567])
    vins = read_odometry(LOGS / "cerberus_vio.csv", "vins-mono")
    assert vins.wxyz[0] == pytest.approx([0.99980, -0.00125, -0.02014, -0.00001], abs=1e-4)
    assert len(read_odometry(LOGS / "fr2_desk_ORB_kf_mono.txt", "tum").t_s) == 157
    fork = read_odometry(LOGS / "wj762_vinsfusion_vio.csv", "tum")
    assert fork.wxyz[0, 1] == pytest.approx(0.83767, abs=1e-4)
    with pytest.raises(FlightError, match="look like xyzw"):
        read_odometry(LOGS / "wj762_vinsfusion_vio.csv", "vins-fusion")
    with pytest.raises(FlightError, match="look like wxyz"):
        read_odometry(LOGS / "wj762_vinsfusion_vio_loop.csv", "tum")
    assert len(read_odometry(LOGS / "V102.txt", "tum").t_s) == 803
    assert math.isclose(np.linalg.norm(vins.wxyz[7]), 1.0)


@pytest.mark.parametrize("time", ["²", "9" * 5000, "١٢٣", "1_000"])
@pytest.mark.parametrize("form", ["euroc", "vins-mono", "tum"])
def test_a_time_that_is_no_plain_number_is_one_line(tmp_path: Path, form: str, time: str) -> None:
    path = tmp_path / "odometry.txt"
    between = " " if form == "tum" else ","
    path.write_text("\n".join(between.join([t, *"0001000"[:7]]) for t in ("100000000000", time)))
    with pytest.raises(FlightError, match=":2: column 1: "):
        read_poses(path, form)


def test_the_times_of_a_file_have_one_unit(tmp_path: Path) -> None:
    path = tmp_path / "vins.csv"
    path.write_text(
        "".join(f"{t},0,0,0,1,0,0,0,\n" for t in (0, 50_000_000_000, 100_000_000_000, 150_000_000_000))
    )
    assert read_poses(path, "vins-mono").t_s.tolist() == [0.0, 50.0, 100.0, 150.0]
