"""Text odometry in, with the dialect found out where it is not stated; reading itself is in ``brmgeo.flight.poses``."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.flight.frames import QuaternionOrder, likely_order
from brmgeo.flight.logs.values import Log, LogOptions
from brmgeo.flight.poses import OdometryOptions, read_poses
from brmgeo.flight.tables import is_header, number, read_rows, read_text

_OWN_ORDER: dict[str, QuaternionOrder] = {
    "tum": "xyzw",
    "euroc": "wxyz",
    "vins-mono": "wxyz",
    "vins-fusion": "wxyz",
}


def text_format(path: Path, quaternion: QuaternionOrder | None = None) -> str:
    """The format that a text file of poses is likely in: ``tum``, ``euroc``, ``kitti``, ``vins-fusion`` or ``csv``.

    Of eight columns with whole nanoseconds, as ORB-SLAM3 and VINS forks write them, the order of the ``quaternion`` decides.
    Raises FlightError when it is none of them, or that order is not told and cannot be found out.
    """
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    first = lines[0] if lines else ""
    if first.replace(" ", "").startswith("t_s,"):
        return "csv"
    rows = (line for line in lines if line[0] != "#" and not is_header(_cells(line)))
    row = next(rows, "")
    cells, comma = _cells(row), "," in row
    try:
        numbers = [float(c) for c in cells]
    except ValueError:
        numbers = []
    if len(numbers) == 12 and not comma:
        return "kitti"
    if len(numbers) < 8:
        raise FlightError(
            f"{path}: no poses in a known format (its first row is {row[:60]!r}): known are TUM, EuRoC, KITTI, VINS-Mono, "
            "VINS-Fusion and CSV with the header t_s,x,y,z,qw,qx,qy,qz"
        )
    whole = cells[0].strip().isdigit() and numbers[0] >= 1e11
    if comma:
        named = first.startswith("#") or is_header(_cells(first))
        return "euroc" if whole and (named or len(numbers) > 11) else "vins-fusion"
    if len(numbers) == 8 and numbers[0] < 1e11:
        return "tum"
    order = quaternion or _order_by_header(path) or _likely(path)
    if order is None:
        raise FlightError(
            f"{path}: its times are nanoseconds, and the order of its quaternions cannot be told from these turns: ORB-SLAM "
            "writes x, y, z, w, VINS w, x, y, z: say which",
            needs="quaternion",
        )
    return "tum" if order == "xyzw" and len(numbers) == 8 else "vins-fusion"


def _cells(line: str) -> list[str]:
    return line.removesuffix(",").split(",") if "," in line else line.split()


def _order_by_header(path: Path) -> QuaternionOrder | None:
    """The order of the quaternion that the names of the columns tell, such as q_WS_x or qw; None where none do."""
    for line in read_text(path).splitlines()[:3]:
        names = [re.split(r"[\[(]", name)[0].strip().lower() for name in _cells(line.strip().lstrip("#"))]
        quaternion = [name for name in names[4:8] if name[:1] == "q"]
        parts = "".join(name[-1] for name in quaternion)
        if parts in ("xyzw", "wxyz"):
            return "xyzw" if parts == "xyzw" else "wxyz"
    return None


def read_text_log(path: Path, options: LogOptions | None = None) -> Log:
    """The poses of a text file. Raises FlightError as ``read_poses`` does."""
    options = options or LogOptions()
    kind = options.format or text_format(path, options.quaternion)
    notes: list[str] = []
    faults: list[str] = []
    order = options.quaternion
    own = _OWN_ORDER.get(kind)
    if own is not None and order is None and (named := _order_by_header(path)) not in (None, own):
        notes.append(f"the header names the quaternion's parts: {named}")
        order = named
    likely = None
    if own is not None:
        likely = _likely(path)
        if order is None and options.any_topic and likely not in (None, own):
            faults.append(
                f"as {own}, the order of {kind}, the aircraft would tumble; its columns look like {likely}: "
                f"give quaternion {likely}"
            )
            order = likely
        seen = likely or "cannot be told from these turns"
        notes.append(f"quaternion read as {order or own}; likely order: {seen}")
    odometry = read_poses(path, kind, OdometryOptions(order, options.frame_times_s, own_times=True))
    rows = [line for line in read_text(path).splitlines() if line.strip() and line.strip()[0] != "#"]
    dropped = len(rows) - len(odometry.t_s) - is_header(_cells(rows[0].strip()))
    if dropped:
        notes.append(f"{dropped} rows repeat a time (a pose told again); the later one counts")
    if kind == "kitti":
        notes.append("poses of the camera; its first frame is taken as a level nadir camera's")
    clock = "Unix time" if odometry.t_s[0] > 1e8 else "the file's own"
    return Log(
        kind,
        f"{kind} text",
        clock,
        odometry,
        candidates=(path.name,),
        notes=tuple(notes),
        faults=tuple(faults),
    )


def _likely(path: Path) -> QuaternionOrder | None:
    text = next(line for line in read_text(path).splitlines() if line.strip() and line.strip()[0] != "#")
    cells, lines = read_rows(path, "," if "," in text else None, range(8, 30))
    values = np.array(
        [[number(path, n, k + 5, row[k + 4]) for k in range(4)] for row, n in zip(cells, lines)]
    )
    return likely_order(values)
