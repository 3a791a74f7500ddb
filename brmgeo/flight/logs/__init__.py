"""Logs in: what people's flights are really written in, to one normal form (``Log``).

``read_log`` finds out what a file or folder is. The libraries of binary logs are optional (``pip install
'brmgeo[logs]'``) and loaded when first needed. The formats ``rosbag``, ``ulog`` and ``ardupilot`` of flight.toml are
registered here.
"""

from __future__ import annotations

from pathlib import Path

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.logs.ardupilot import read_ardupilot
from brmgeo.flight.logs.photos import PHOTO_SUFFIXES, read_photos
from brmgeo.flight.logs.rosbag import read_rosbag
from brmgeo.flight.logs.text import read_text_log
from brmgeo.flight.logs.ulog import read_ulog
from brmgeo.flight.logs.values import CameraFrames, Gnss, Height, Log, LogOptions, Orientation
from brmgeo.flight.odometry import OdometryOptions, Reader, register
from brmgeo.flight.readings import Odometry

__all__ = ["CameraFrames", "Gnss", "Height", "Log", "LogOptions", "Orientation", "kind_of", "read_log"]

_BY_SUFFIX = {
    ".bag": "rosbag",
    ".mcap": "rosbag",
    ".db3": "rosbag",
    ".ulg": "ulog",
    ".bin": "ardupilot",
    ".log": "ardupilot",
    ".tlog": "ardupilot",
}
_READERS = {
    "rosbag": read_rosbag,
    "ulog": read_ulog,
    "ardupilot": read_ardupilot,
    "photos": read_photos,
    "text": read_text_log,
}


def kind_of(path: Path) -> str:
    """What a path holds: ``rosbag``, ``ulog``, ``ardupilot``, ``photos``, ``text`` or ``flight`` (a flight folder).

    Raises MissingInputError when there is nothing, FlightError when it is none of these.
    """
    if not path.exists():
        raise MissingInputError(f"{path}: no such file or folder: give a log, a bag or a folder of photos")
    if path.is_dir():
        if (path / "flight.toml").is_file():
            return "flight"
        if (path / "metadata.yaml").is_file():
            return "rosbag"
        if any(p.suffix.lower() in PHOTO_SUFFIXES for p in path.rglob("*")):
            return "photos"
        raise FlightError(
            f"{path}: the folder holds no flight.toml, no metadata.yaml (ROS 2 bag) and no photos: give the log itself"
        )
    with path.open("rb") as file:
        head = file.read(16)
    for magic, kind in (
        (b"ULog\x01\x12\x35", "ulog"),
        (b"#ROSBAG", "rosbag"),
        (b"\x89MCAP", "rosbag"),
        (b"SQLite format 3", "rosbag"),
        (b"\xa3\x95", "ardupilot"),
    ):
        if head.startswith(magic):
            return kind
    return _BY_SUFFIX.get(path.suffix.lower(), "text")


def read_log(path: Path | str, options: LogOptions | None = None) -> Log:
    """The log, bag, text of poses or folder of photos at ``path``, in the normal form.

    Raises FlightError or MissingInputError, one line each: see the readers of the formats.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "flight":
        raise FlightError(f"{path}: this is a flight folder already")
    return _READERS[kind](path, options or LogOptions())


def _reader(kind: str) -> Reader:
    def read(path: Path, options: OdometryOptions) -> Odometry:
        if options.quaternion is not None:
            raise FlightError(
                f"{path}: quaternion order is given, but this format names its parts: remove 'quaternion'"
            )
        try:
            log = _READERS[kind](path, LogOptions(options.topic, only_odometry=True))
        except MissingInputError as error:
            raise FlightError(str(error)) from None
        if log.odometry is None or not len(log.odometry.t_s):
            raise FlightError(f"{path}: the log holds no odometry: remove [odometry] or give another file")
        return log.odometry

    return read


for _kind in ("rosbag", "ulog", "ardupilot"):
    register(_kind, _reader(_kind))
