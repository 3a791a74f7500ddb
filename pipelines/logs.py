"""Logs to flight folders, and what is in a log: ``brmgeo import`` and ``brmgeo inspect``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from brmgeo import files
from brmgeo.errors import FlightError, InputError, MissingExtraError, SettingsError
from brmgeo.flight.folder import read_flight
from brmgeo.flight.logs import read_log
from brmgeo.flight.logs.inspect import dropouts, inspect, pairs
from brmgeo.flight.logs.normal import normal
from brmgeo.flight.logs.parts import imported, is_of_camera
from brmgeo.flight.logs.pictures import Pictures, pictures_of
from brmgeo.flight.logs.values import ImportSettings, Log, LogOptions
from brmgeo.flight.write import rounded, write_flight
from brmgeo.workflow.disk import disk_errors


def import_log(path: Path, out: Path, settings: ImportSettings | None = None) -> list[str]:
    """Writes the flight folder ``out`` of a log, bag or folder of photos; what was done, a line each.

    Raises an InputError, one line, for everything that stands in the way: clocks, units and axes that cannot be right,
    a missing height or camera, pictures that do not fit the log, and an ``out`` that is not empty.
    """
    settings = settings or ImportSettings()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SettingsError(f"import: {out} is there already: remove it or choose another", needs="out")
    log = normal(path, read_log(path, settings.options), settings)
    pictures = pictures_of(path, log, settings)
    if log.odometry is None and pictures is None and log.gnss is None:
        why = f" ({log.faults[0]})" if log.faults else ""
        raise FlightError(
            f"{path}: the log has no position and no pictures{why}: nothing to localize is in it"
        )
    if log.faults and pictures is None:
        raise FlightError(f"{path}: {log.faults[0]}")
    flight = imported(path, log, pictures, settings)
    with files.whole_folder(out) as work, disk_errors(f"import {path}", out.absolute().parent):
        if pictures is not None:
            _write_pictures(work, pictures, flight.pictures)
        write_flight(work, rounded(flight.parts))
        if pictures is not None:
            try:
                read_flight(work)
            except InputError as error:
                raise FlightError(
                    f"{path}: the flight is not complete: {str(error).replace(str(work), str(out))}"
                ) from None
    return [
        *flight.says,
        *_left_out(log, settings, pictures is None),
        *log.notes,
        *log.faults,
        *dropouts(log),
    ]


def _write_pictures(work: Path, pictures: Pictures, names: dict[int, str]) -> None:
    folder = work / "frames"
    folder.mkdir()
    pictures.write(folder, names)
    if pictures.video is not None:
        folder.rmdir()


def _left_out(log: Log, settings: ImportSettings, blind: bool) -> list[str]:
    # Options that this log or video has no use for; ``blind``: there are no pictures.
    options, video, photos = settings.options, settings.video is not None, settings.photos is not None
    bag, text = log.kind == "rosbag", log.kind not in ("rosbag", "ulog", "ardupilot", "mavlink", "photos")
    gimbal = "the photos tell the camera's own attitude (gimbal), so it has none"
    unused = (
        ("--mount", is_of_camera(log) and settings.mount_deg is not None, gimbal),
        ("--mount", blind and settings.mount_deg is not None, "there are no pictures"),
        ("--shift-frames", blind and settings.shift_frames_s, "there are no pictures"),
        ("--shift-frames", video and settings.shift_frames_s, "with --video, --video-start says when its frames were taken"),
        ("--video-start", not video and settings.video_start_s, "there is no --video"),
        ("--photos", video and photos, "the pictures are those of --video"),
        ("--image-topic", options.image_topic and (video or photos), "the pictures are no bag's"),
        ("--image-topic", options.image_topic and not bag, "this is no bag"),
        ("--imu-topic", options.imu_topic and not bag, "this is no bag"),
        ("--topic", options.topic and (text or log.kind == "photos"), "there is but one track"),
        ("--format", options.format and not text, "this is no text of poses"),
        ("--quaternion", options.quaternion and not text, "this is no text of poses"),
        ("--times", options.frame_times_s is not None and log.kind != "kitti", "the log tells its own"),
        ("--camera", blind and settings.camera is not None, "there are no pictures"),
        ("--fov", blind and settings.fov_deg is not None, "there are no pictures"),
        ("--agl", blind and settings.agl_m is not None, "there are no pictures"),
        ("--rate", blind and settings.rate_hz is not None, "there are no pictures"),
        ("--ground", settings.agl_m is not None and settings.ground_m is not None, "--agl tells the height"),
    )  # fmt: skip
    return [f"{option} was left out: {why}" for option, is_so, why in unused if is_so]


def inspect_document(paths: Sequence[Path], options: LogOptions | None = None) -> tuple[str, int]:
    """Markdown of ``inspect`` for many paths, and how many of them could not be read: how docs/logs.md is made."""
    out = [
        "# What is in these logs",
        "",
        "Made by `brmgeo inspect PATH ... --write FILE`, which tells this of any log, bag, text of poses, folder of photos",
        "or flight folder. `brmgeo import PATH --out flight/` makes a flight folder of a log",
        "(`pip install 'brmgeo[logs]'` for ROS bags, PX4 and ArduPilot logs). FAULT is what import refuses, with the",
        "parameter that mends it: an option of that name (`--body` for `body_deg`). A log without",
        "pictures takes them from `--photos` (by its camera triggers) or `--video`.",
        "",
        "What a damaged log lost is noted: bytes that lead to no message, rows whose time or numbers cannot be. What one",
        "flipped bit makes of a number in a message without a checksum (ULog, .bin) looks like any other number: that",
        "cannot be found.",
        "",
    ]
    others = []
    for path in paths:
        try:
            lines = inspect(path, options)
        except (InputError, MissingExtraError) as error:
            others.append(f"- {str(error).replace(str(path), path.name)}")
            continue
        out += [f"## {path.name}", "", "```", *lines, "```", ""]
    same = pairs(paths, options)
    if same:
        out += ["## Tracks of the same minutes", "", "After the best rotation, shift and scale:", ""]
        out += [f"- {line}" for line in same] + [""]
    if others:
        out += ["## Not read", "", *others, ""]
    return "\n".join(out), len(others)
