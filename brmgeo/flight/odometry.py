"""Odometry in, whatever it is written in: one function over text files of poses and the logs of autopilots and robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.frames import inverse, multiply, quaternion_from_matrix, rotate, to_flu
from brmgeo.flight.poses import TEXT_READERS, OdometryOptions, PoseReader
from brmgeo.flight.readings import Odometry
from brmgeo.settings import nearest

__all__ = ["READERS", "OdometryOptions", "read_odometry"]


def _of_log(kind: str) -> PoseReader:
    def read(path: Path, options: OdometryOptions) -> Odometry:
        from brmgeo.flight.logs import READERS as LOG_READERS
        from brmgeo.flight.logs import LogOptions

        if options.quaternion is not None:
            raise FlightError(
                f"{path}: quaternion order is given, but this format names its parts: remove 'quaternion'"
            )
        try:
            log = LOG_READERS[kind](path, LogOptions(options.topic, only_odometry=True))
        except MissingInputError as error:
            raise FlightError(str(error)) from None
        if log.odometry is None or not len(log.odometry.t_s):
            raise FlightError(f"{path}: the log holds no odometry: remove [odometry] or give another file")
        return log.odometry

    return read


#: Every format that flight.toml may name; the logs' readers, with their libraries, are loaded when first asked for.
READERS: dict[str, PoseReader] = {
    **TEXT_READERS,
    **{kind: _of_log(kind) for kind in ("rosbag", "ulog", "ardupilot")},
}


def read_odometry(path: Path, format_name: str, options: OdometryOptions | None = None) -> Odometry:
    """The odometry in a file.

    Args:
        path: the file.
        format_name: one of ``READERS``: ``tum``, ``euroc``, ``kitti``, ``vins-mono``, ``vins-fusion``, ``csv``,
            ``rosbag``, ``ulog`` or ``ardupilot``.

    Raises FlightError, with line and column, for an unknown format and as ``brmgeo.flight.poses.read_poses`` and the
    readers of logs do; MissingExtraError where a log's library is not installed.
    """
    if format_name not in READERS:
        raise FlightError(
            f"{path}: odometry format {format_name!r} is unknown: {nearest(format_name, list(READERS))}"
        )
    options = options or OdometryOptions()
    odometry = READERS[format_name](path, options)
    if options.axes in (None, "flu"):
        return odometry
    if options.axes == "nadir":
        # The first camera is the world; its tilt makes it level.
        level, body = (
            quaternion_from_matrix(m) for m in (options.level_from_camera, options.body_from_camera)
        )
        xyz, wxyz = rotate(level, odometry.xyz_m), multiply(multiply(level, odometry.wxyz), inverse(body))
    else:
        xyz, wxyz = to_flu(options.axes, odometry.xyz_m, odometry.wxyz)
    return replace(odometry, xyz_m=xyz, wxyz=wxyz)
