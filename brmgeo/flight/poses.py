"""Text files of poses in: TUM, EuRoC, KITTI, VINS-Mono and VINS-Fusion CSV and plain CSV, to one value.

What comes out is the pose of the body (FLU) in a gravity-aligned frame, z up; see ``brmgeo.flight.readings.Odometry``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from brmgeo.flight.frames import Axes, QuaternionOrder, likely_order, quaternion_from_matrix
from brmgeo.flight.readings import BODY_FROM_NADIR_CAMERA, FloatArray, Odometry
from brmgeo.flight.tables import check_increasing, number, read_rows, read_table, read_text, refuse

UNIT_TOLERANCE = 0.01
#: Rows that repeat a time are one pose told again when they lie no farther apart than this.
REPEAT_M = 0.5
#: Formats that do not say how the axes of their tracks lie.
AXES_UNTOLD = ("tum", "euroc", "vins-mono", "vins-fusion")
#: A whole number as logs write it: isdigit takes "²" too, and int() refuses thousands of digits.
WHOLE = re.compile(r"[+-]?[0-9]{1,30}")


@dataclass(frozen=True, slots=True)
class OdometryOptions:
    """What a reader may need besides the file.

    Attributes:
        quaternion: order of the quaternion where it is not the format's own.
        frame_times_s: (n,) times of the poses, for formats without times; those of the frames where none are told.
        level_from_camera: (3, 3) rotation from the optical frame to the level frame at the first frame, for
            formats in the camera's frame.
        body_from_camera: (3, 3) the camera's mount, for the same.
        topic: which of several, for logs that hold more than one odometry.
        own_times: ``frame_times_s`` are from a file of the poses' own.
        axes: those of the track's world and body, where they are not ours; ``nadir`` takes the two rotations above.
    """

    quaternion: QuaternionOrder | None = None
    frame_times_s: FloatArray | None = None
    level_from_camera: FloatArray = field(default_factory=lambda: BODY_FROM_NADIR_CAMERA)
    body_from_camera: FloatArray = field(default_factory=lambda: BODY_FROM_NADIR_CAMERA)
    topic: str | None = None
    own_times: bool = False
    axes: Axes | None = None


PoseReader = Callable[[Path, OdometryOptions], Odometry]


def _finish(
    path: Path, t: FloatArray, xyz: FloatArray, wxyz: FloatArray, lines: list[int], columns: str
) -> Odometry:
    # Some writers tell a pose again when they have corrected it (V102 of EuRoC's VINS): the later word counts.
    repeats = np.flatnonzero(np.diff(t) == 0.0)
    for i in repeats.tolist():
        apart = float(np.linalg.norm(xyz[i + 1] - xyz[i]))
        if apart > REPEAT_M:
            raise refuse(
                path,
                lines[i + 1],
                columns.split()[0],
                f"time {t[i]:.6f} s is there twice, {apart:.2f} m apart: rows must be in order of time, each once",
            )
    if repeats.size:
        keep = np.setdiff1d(np.arange(len(t)), repeats)
        t, xyz, wxyz, lines = t[keep], xyz[keep], wxyz[keep], [lines[i] for i in keep]
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


def _seconds(path: Path, lines: list[int], texts: list[str], nanoseconds: bool | None) -> FloatArray:
    # None: VINS writes whole nanoseconds, forks write seconds. One unit for the whole file, told by its largest time.
    texts = [text.strip() for text in texts]
    whole = [WHOLE.fullmatch(text) is not None for text in texts]
    if nanoseconds and not all(whole):
        i = whole.index(False)
        raise refuse(path, lines[i], 1, f"time {texts[i][:40]!r} is not a whole number of nanoseconds")
    values = np.array([number(path, line, 1, text) for line, text in zip(lines, texts)])
    if nanoseconds is None:
        largest = float(np.abs(values).max())
        nanoseconds = largest >= 1e17 or (all(whole) and largest >= 1e11)
    if not nanoseconds:
        return values
    return np.array([int(t) / 1e9 if w else v / 1e9 for t, w, v in zip(texts, whole, values.tolist())])


def _text_reader(
    separator: str | None,
    widths: range,
    nanoseconds: bool | None,
    order: QuaternionOrder,
    dialects: bool = False,
) -> PoseReader:
    def read(path: Path, options: OdometryOptions) -> Odometry:
        between = separator
        if dialects:
            rows = (line for line in read_text(path).splitlines() if line.strip() and line.strip()[0] != "#")
            between = "," if "," in next(rows, ",") else None
        cells, lines = read_rows(path, between, widths)
        t = _seconds(path, lines, [row[0] for row in cells], nanoseconds)
        values = np.empty((len(cells), 7))
        for i, (row, line) in enumerate(zip(cells, lines)):
            for k in range(7):
                values[i, k] = number(path, line, k + 2, row[k + 1])
        wxyz = values[:, 3:]
        if (options.quaternion or order) == "xyzw":
            wxyz = wxyz[:, [3, 0, 1, 2]]
        found = _finish(path, t, values[:, :3], wxyz, lines, "1 5-8")
        likely = likely_order(values[:, 3:])
        if options.quaternion is None and likely not in (None, order):
            raise refuse(
                path,
                lines[0],
                "5-8",
                f"read as {order} the aircraft would tumble; the columns look like {likely}: give quaternion = "
                f'"{likely}" (or "{order}" if they are right) in [odometry]',
                needs="quaternion",
            )
        return found

    return read


def _read_csv(path: Path, options: OdometryOptions) -> Odometry:
    if options.quaternion is not None:
        raise refuse(
            path,
            None,
            None,
            "quaternion order is given, but this format names its columns: remove 'quaternion'",
        )
    table = read_table(path, [("t_s", "x", "y", "z", "qw", "qx", "qy", "qz")], ["segment"])
    found = _finish(
        path,
        table.numbers["t_s"],
        table.stack("x", "y", "z"),
        table.stack("qw", "qx", "qy", "qz"),
        table.lines,
        "t_s qw,qx,qy,qz",
    )
    if "segment" not in table.numbers:
        return found
    kept = np.append(np.diff(table.numbers["t_s"]) != 0.0, True)
    return replace(found, segment=table.numbers["segment"][kept].astype(np.int64))


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
        if times is not None and options.own_times:
            message = f"{len(cells)} poses for {len(times)} times: the file of times is of another track"
        else:
            have = "no frames" if times is None else f"{len(times)} frames"
            message = (
                f"{len(cells)} poses for {have}: KITTI has no times, so it needs one pose a frame, or a file of times "
                "(times in [odometry] of flight.toml)"
            )
        raise refuse(path, None, None, message, needs="frame_times_s")
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
        path,
        np.asarray(times, dtype=np.float64),
        poses[:, :, 3] @ level.T,
        quaternion_from_matrix(body),
        lines,
        "1 1-12",
    )


#: The text formats, as written in flight.toml, and their readers.
TEXT_READERS: dict[str, PoseReader] = {
    "tum": _text_reader(None, range(8, 9), None, "xyzw"),
    "euroc": _text_reader(",", range(8, 30), True, "wxyz"),
    "kitti": _read_kitti,
    "vins-mono": _text_reader(",", range(8, 12), None, "wxyz", dialects=True),
    "vins-fusion": _text_reader(",", range(8, 12), None, "wxyz", dialects=True),
    "csv": _read_csv,
}


def read_poses(path: Path, format_name: str, options: OdometryOptions | None = None) -> Odometry:
    """The odometry in a text file; ``format_name`` is one of ``TEXT_READERS``.

    Raises FlightError, with line and column, for rows that are not of the format, times that do not increase, numbers
    that are not finite, quaternions whose length is not 1 within ``UNIT_TOLERANCE``, and quaternions that are plainly in
    the other order than the format's, unless ``options.quaternion`` states it.
    """
    return TEXT_READERS[format_name](path, options or OdometryOptions())
