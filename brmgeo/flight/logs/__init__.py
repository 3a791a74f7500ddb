"""Logs in: what people's flights are really written in, to one normal form (``Log``).

``read_log`` finds out what a file or folder is. The libraries of binary logs are optional (``pip install
'brmgeo[logs]'``) and loaded when first needed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.logs.values import (
    PHOTO_SUFFIXES,
    CameraFrames,
    Gnss,
    Height,
    ImportSettings,
    Log,
    LogOptions,
    Orientation,
)

__all__ = [
    "READERS",
    "CameraFrames",
    "Gnss",
    "Height",
    "ImportSettings",
    "Log",
    "LogOptions",
    "Orientation",
    "kind_of",
    "read_log",
]

_BY_SUFFIX = {
    ".bag": "rosbag",
    ".mcap": "rosbag",
    ".db3": "rosbag",
    ".ulg": "ulog",
    ".bin": "ardupilot",
    ".log": "ardupilot",
    ".tlog": "ardupilot",
}


def _rosbag(path: Path, options: LogOptions) -> Log:
    from brmgeo.flight.logs.rosbag import read_rosbag

    return read_rosbag(path, options)


def _ulog(path: Path, options: LogOptions) -> Log:
    from brmgeo.flight.logs.ulog import read_ulog

    return read_ulog(path, options)


def _ardupilot(path: Path, options: LogOptions) -> Log:
    from brmgeo.flight.logs.ardupilot import read_ardupilot

    return read_ardupilot(path, options)


def _photos(path: Path, options: LogOptions) -> Log:
    from brmgeo.flight.logs.photos import read_photos

    return read_photos(path, options)


def _text(path: Path, options: LogOptions) -> Log:
    from brmgeo.flight.logs.text import read_text_log

    return read_text_log(path, options)


#: Readers by what ``kind_of`` says, each loaded when first asked for.
READERS: dict[str, Callable[[Path, LogOptions], Log]] = {
    "rosbag": _rosbag,
    "ulog": _ulog,
    "ardupilot": _ardupilot,
    "photos": _photos,
    "text": _text,
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

    Raises FlightError, MissingInputError or MissingExtraError, one line each: see the readers of the formats.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "flight":
        raise FlightError(f"{path}: this is a flight folder already")
    return READERS[kind](path, options or LogOptions())
