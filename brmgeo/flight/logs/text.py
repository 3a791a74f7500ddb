"""Text odometry in, with the dialect found out where it is not stated; reading itself is in ``brmgeo.flight.poses``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.flight.frames import QuaternionOrder, likely_order
from brmgeo.flight.logs.values import Log, LogOptions
from brmgeo.flight.poses import OdometryOptions, read_poses
from brmgeo.flight.tables import number, read_rows, read_text

_OWN_ORDER: dict[str, QuaternionOrder] = {
    "tum": "xyzw",
    "euroc": "wxyz",
    "vins-mono": "wxyz",
    "vins-fusion": "wxyz",
}


def text_format(path: Path) -> str:
    """The format that a text file of poses is likely in: ``tum``, ``euroc``, ``kitti``, ``vins-fusion`` or ``csv``.

    Raises FlightError when it is none of them.
    """
    lines = read_text(path).splitlines()
    first = next((line.strip() for line in lines if line.strip()), "")
    if first.replace(" ", "").startswith("t_s,"):
        return "csv"
    row = next((line.strip() for line in lines if line.strip() and line.strip()[0] != "#"), "")
    comma = "," in row
    cells = row.removesuffix(",").split(",") if comma else row.split()
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
    if comma:
        whole = cells[0].strip().isdigit() and numbers[0] >= 1e11
        return "euroc" if whole and (first.startswith("#") or len(numbers) > 11) else "vins-fusion"
    return "tum" if len(numbers) == 8 and numbers[0] < 1e11 else "vins-fusion"


def read_text_log(path: Path, options: LogOptions | None = None) -> Log:
    """The poses of a text file. Raises FlightError as ``read_poses`` does."""
    options = options or LogOptions()
    kind = options.format or text_format(path)
    notes: list[str] = []
    faults: list[str] = []
    order = options.quaternion
    own = _OWN_ORDER.get(kind)
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
    rows = len([line for line in read_text(path).splitlines() if line.strip() and line.strip()[0] != "#"])
    dropped = rows - len(odometry.t_s) - (kind == "csv")
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
