"""Odometry files in: TUM, EuRoC, KITTI, VINS-Mono CSV and plain CSV, to one value.

Each format is one reader in ``READERS``; another format is added by ``register``. What comes out is the pose of the
body (FLU) in a gravity-aligned frame, z up; see ``brmgeo.flight.readings.Odometry``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.flight.readings import BODY_FROM_NADIR_CAMERA, FloatArray, Odometry
from brmgeo.flight.tables import check_increasing, nearest, number, read_rows, read_table, refuse

QuaternionOrder = Literal["xyzw", "wxyz"]
UNIT_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class OdometryOptions:
    """What a reader may need besides the file.

    Attributes:
        quaternion: order of the quaternion where it is not the format's own.
        frame_times_s: (n,) times of the frames, for formats without times.
        level_from_camera: (3, 3) rotation from the optical frame to the level frame at the first frame, for
            formats in the camera's frame.
        body_from_camera: (3, 3) the camera's mount, for the same.
    """

    quaternion: QuaternionOrder | None = None
    frame_times_s: FloatArray | None = None
    level_from_camera: FloatArray = field(default_factory=lambda: BODY_FROM_NADIR_CAMERA)
    body_from_camera: FloatArray = field(default_factory=lambda: BODY_FROM_NADIR_CAMERA)


Reader = Callable[[Path, OdometryOptions], Odometry]
READERS: dict[str, Reader] = {}
#: Formats of FLIGHT.md whose readers are not in this version.
PLANNED = ("rosbag", "ulog", "ardupilot")


def register(name: str, reader: Reader) -> None:
    """Makes ``read_odometry`` read the format ``name`` (as written in flight.toml) with ``reader``."""
    READERS[name] = reader


def read_odometry(path: Path, format_name: str, options: OdometryOptions | None = None) -> Odometry:
    """The odometry in a file.

    Args:
        path: the file.
        format_name: ``tum``, ``euroc``, ``kitti``, ``vins-mono`` or ``csv``, or what ``register`` added.

    Raises FlightError, with line and column, for an unknown format, rows that are not of the format, times that do
    not increase, numbers that are not finite, and quaternions whose length is not 1 within ``UNIT_TOLERANCE``.
    """
    if format_name not in READERS:
        formats = ", ".join(READERS)
        if format_name in PLANNED:
            raise FlightError(
                f"{path}: odometry format {format_name!r} is not read by this version: convert it to one of {formats}"
            )
        raise FlightError(
            f"{path}: odometry format {format_name!r} is unknown: {nearest(format_name, [*READERS, *PLANNED])}"
        )
    return READERS[format_name](path, options or OdometryOptions())


def _finish(
    path: Path, t: FloatArray, xyz: FloatArray, wxyz: FloatArray, lines: list[int], columns: str
) -> Odometry:
    check_increasing(path, t, lines, columns.split()[0])
    length = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > UNIT_TOLERANCE)
    if bad.size:
        i = int(bad[0])
        raise refuse(
            path,
            lines[i],
            columns.split()[1],
            f"the quaternion's length is {length[i]:.4f}, not 1: check the format and the order of the columns",
        )
    return Odometry(t, xyz, wxyz / length[:, None], path.name)


def _text_reader(separator: str | None, widths: range, nanoseconds: bool, order: QuaternionOrder) -> Reader:
    def read(path: Path, options: OdometryOptions) -> Odometry:
        cells, lines = read_rows(path, separator, widths)
        t = np.empty(len(cells))
        values = np.empty((len(cells), 7))
        for i, (row, line) in enumerate(zip(cells, lines)):
            if nanoseconds:
                stamp = row[0].strip()
                if not stamp.lstrip("+-").isdigit():
                    raise refuse(path, line, 1, f"time {stamp[:40]!r} is not a whole number of nanoseconds")
                t[i] = int(stamp) / 1e9
            else:
                t[i] = number(path, line, 1, row[0])
            for k in range(7):
                values[i, k] = number(path, line, k + 2, row[k + 1])
        wxyz = values[:, 3:]
        if (options.quaternion or order) == "xyzw":
            wxyz = wxyz[:, [3, 0, 1, 2]]
        return _finish(path, t, values[:, :3], wxyz, lines, "1 5-8")

    return read


def _read_csv(path: Path, options: OdometryOptions) -> Odometry:
    if options.quaternion is not None:
        raise refuse(
            path,
            None,
            None,
            "quaternion order is given, but this format names its columns: remove 'quaternion'",
        )
    table = read_table(path, [("t_s", "x", "y", "z", "qw", "qx", "qy", "qz")])
    return _finish(
        path,
        table.numbers["t_s"],
        table.stack("x", "y", "z"),
        table.stack("qw", "qx", "qy", "qz"),
        table.lines,
        "t_s qw,qx,qy,qz",
    )


def _read_kitti(path: Path, options: OdometryOptions) -> Odometry:
    # Rows are first_camera_from_camera, 3 x 4. The first camera's tilt (mount, roll and pitch) makes its frame level.
    if options.quaternion is not None:
        raise refuse(
            path,
            None,
            None,
            "quaternion order is given, but this format has rotation matrices: remove 'quaternion'",
        )
    cells, lines = read_rows(path, None, range(12, 13))
    times = options.frame_times_s
    if times is None or len(times) != len(cells):
        have = "no frames" if times is None else f"{len(times)} frames"
        raise refuse(
            path,
            None,
            None,
            f"{len(cells)} poses for {have}: KITTI has no times, so it needs one pose a frame",
        )
    poses = np.array([[number(path, n, k + 1, c) for k, c in enumerate(r)] for r, n in zip(cells, lines)])
    poses = poses.reshape(-1, 3, 4)
    rotation = poses[:, :, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > UNIT_TOLERANCE) | (np.linalg.det(rotation) < 0.0))
    if bad.size:
        raise refuse(
            path, lines[int(bad[0])], 1, "the left 3 x 3 numbers are no rotation: is this a KITTI pose file?"
        )
    level = options.level_from_camera
    body = level @ rotation @ options.body_from_camera.T
    return _finish(
        path, np.asarray(times, dtype=np.float64), poses[:, :, 3] @ level.T, _wxyz(body), lines, "1 1-12"
    )


def _wxyz(rotation: FloatArray) -> FloatArray:
    # (n, 4) unit quaternions, by the largest component (Shepperd, 1978), so that no half turn divides by zero.
    m = rotation
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=-1)
    out = np.empty((len(m), 4))
    for i, largest in enumerate(squares.argmax(axis=1)):
        r = m[i]
        if largest == 0:
            q = [1 + trace[i], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
        elif largest == 1:
            q = [r[2, 1] - r[1, 2], 1 + 2 * r[0, 0] - trace[i], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]]
        elif largest == 2:
            q = [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - trace[i], r[1, 2] + r[2, 1]]
        else:
            q = [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - trace[i]]
        out[i] = q
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


register("tum", _text_reader(None, range(8, 9), False, "xyzw"))
register("euroc", _text_reader(",", range(8, 30), True, "wxyz"))
register("kitti", _read_kitti)
register("vins-mono", _text_reader(",", range(8, 12), True, "wxyz"))
register("csv", _read_csv)
