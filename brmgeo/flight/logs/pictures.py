"""Pictures for a flight out of a log: its own, photos taken at its camera triggers, or a video."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.flight.logs import read_log
from brmgeo.flight.logs.values import ImportSettings, Log
from brmgeo.flight.readings import Camera, FloatArray
from brmgeo.flight.video import Video
from brmgeo.pictures import encode


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures that become a flight's frames: (n,) log seconds, their names, size (width, height) in pixels.

    ``write`` puts those of its second argument, index -> file name, into a folder. ``video`` is the file that holds them
    all, ``camera`` what photos beside the log say of theirs.
    """

    t_s: FloatArray
    names: tuple[str, ...]
    size: tuple[int, int]
    write: Callable[[Path, dict[int, str]], None]
    video: Path | None = None
    camera: Camera | None = None


def pictures_of(path: Path, log: Log, settings: ImportSettings) -> Pictures | None:
    """The pictures of a log, of the photos or of the video that the settings name; None where there are none.

    Raises FlightError for photos that do not fit the log's camera triggers and a video that cannot be read or does not fit
    the log's times.
    """
    if settings.video is not None:
        return _video(path, log, settings)
    held = log.frames
    times = None if held is None else held.t_s
    camera = None
    if settings.photos is not None:
        beside = read_log(settings.photos)
        if beside.frames is None:
            raise FlightError(f"{settings.photos}: no photos are here")
        if log.triggers_s is None:
            raise FlightError(
                f"{path}: the log has no camera triggers (CAM, camera_capture), so photos have no time in it"
            )
        if len(log.triggers_s) != len(beside.frames.t_s):
            raise FlightError(
                f"{path}: {len(log.triggers_s)} camera triggers for {len(beside.frames.t_s)} photos in {settings.photos}: "
                "take out test shots until the numbers agree"
            )
        held, times, camera = beside.frames, log.triggers_s, beside.camera
        wander = np.ptp((times - times[0]) - (held.t_s - held.t_s[0]))
        if len(times) > 1 and wander > 2.0:
            raise FlightError(
                f"{settings.photos}: times between the photos and between the log's triggers differ by {wander:.1f} s: "
                "these photos are of another flight, or some are missing"
            )
    if held is None or times is None:
        return None
    source = held

    def write(folder: Path, wanted: dict[int, str]) -> None:
        for i, image in source.images():
            if i not in wanted:
                continue
            target = folder / wanted[i]
            if not isinstance(image, bytes):
                image = encode(image[:, :, ::-1] if image.ndim == 3 else image, target.suffix)
            target.write_bytes(image)

    return Pictures(times + settings.shift_frames_s, held.names, held.size, write, camera=camera)


def _video(path: Path, log: Log, settings: ImportSettings) -> Pictures:
    video = settings.video
    assert video is not None
    film = Video(video)
    if film.count <= 0:
        raise FlightError(f"{video}: the video does not tell how many pictures it has: convert it")
    t = settings.video_start_s + np.arange(film.count) / film.rate_hz
    if log.odometry is not None and (t[0] > log.odometry.t_s[-1] or t[-1] < log.odometry.t_s[0]):
        raise FlightError(
            f"{path}: the log covers {log.odometry.t_s[0]:.1f} to {log.odometry.t_s[-1]:.1f} s, the video {t[0]:.1f} to "
            f"{t[-1]:.1f} s: give the log's time at which the video begins",
            needs="video_start_s",
        )

    def write(folder: Path, wanted: dict[int, str]) -> None:
        shutil.copyfile(video, folder.parent / video.name)

    return Pictures(t, tuple(f"{i:06d}" for i in range(film.count)), film.size, write, video)
