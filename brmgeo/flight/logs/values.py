"""The one normal form that every log is read into."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError
from brmgeo.flight.frames import Axes, QuaternionOrder
from brmgeo.flight.readings import Camera, FloatArray, Imu, Odometry
from brmgeo.pictures import SUFFIXES

#: Stamps of one stream that go back by more than this are a clock that jumped, not messages that overtook each other.
MAX_REORDER_S = 0.5
#: Endings of the files that count as photos of a camera.
PHOTO_SUFFIXES = (*SUFFIXES, ".dng")
#: MAV_SENSOR_ORIENTATION of a sensor that looks down, as PX4 and ArduPilot write it, too (ROTATION_PITCH_270).
DOWN = 25
_LOOKS = {0: "forward", 2: "right", 4: "back", 6: "left", 24: "up"}


@dataclass(frozen=True, slots=True)
class LogOptions:
    """What a reader may be told besides the file.

    Attributes:
        topic: the odometry to take of a log that holds several (a topic, message name or estimator).
        image_topic, imu_topic: the same for pictures and inertial readings.
        quaternion: order of the quaternion columns of text formats.
        frame_times_s: (n,) times for KITTI poses.
        format: name of a text format; None finds it out.
        any_topic: take the first candidate where several are (for a look, not for an import).
        only_odometry: leave out what else a log holds where that costs anything, such as pictures.
    """

    topic: str | None = None
    image_topic: str | None = None
    imu_topic: str | None = None
    quaternion: QuaternionOrder | None = None
    frame_times_s: FloatArray | None = None
    format: str | None = None
    any_topic: bool = False
    only_odometry: bool = False


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """What may be told besides the log when a flight is made of it.

    ``photos`` and ``video`` stand in for pictures that the log does not hold; ``video_start_s`` is the log's time at
    which the video begins. ``camera`` is a camera, or fx, fy, cx, cy[, k1, k2, p1, p2[, k3]].
    ``body_deg`` and ``mount_deg`` are roll, pitch, yaw: of the log's body in ours, and of the camera in the body, None where
    that is not told.
    ``axes`` is one of ``frames.Axes``, or None where it is to be found out that they are ours.
    ``imu_units`` are units that the log is known to be in, such as ("deg/s", "g"). ``shift_frames_s`` is added to the
    frames' times.
    """

    options: LogOptions = field(default_factory=LogOptions)
    name: str | None = None
    photos: Path | None = None
    video: Path | None = None
    video_start_s: float = 0.0
    fov_deg: float | None = None
    camera: Camera | tuple[float, ...] | None = None
    agl_m: float | None = None
    ground_m: float | None = None
    mount_deg: tuple[float, ...] | None = None
    body_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    axes: Axes | None = None
    imu_units: tuple[str, ...] = ()
    rate_hz: float | None = None
    shift_frames_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Gnss:
    """Satellite positions: (n,) seconds, (n,) degrees WGS84, (n,) metres or NaN; ``sigma_m`` horizontal, or NaN."""

    t_s: FloatArray
    lon_deg: FloatArray
    lat_deg: FloatArray
    alt_m: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True, slots=True)
class Height:
    """Height above ground: (n,) seconds, (n,) metres. ``above`` is ``ground`` (measured) or ``take-off`` (assumed flat)."""

    t_s: FloatArray
    agl_m: FloatArray
    above: str
    source: str


@dataclass(frozen=True, slots=True)
class Orientation:
    """Attitude of the body (FLU): (n,) seconds, (n, 4) unit quaternions w, x, y, z, world_from_body, world z up.

    ``north`` is True when the world is ENU, so that the yaw is a heading. ``of_camera`` is True when the body is the
    stabilised camera (a gimbal), as a nadir camera at rest has it, and not the aircraft.
    """

    t_s: FloatArray
    wxyz: FloatArray
    north: bool
    source: str
    of_camera: bool = False


@dataclass(frozen=True, slots=True)
class CameraFrames:
    """Pictures: (n,) seconds and their file names; ``images`` yields (index, encoded bytes or array) in any order.

    An array is (h, w) or (h, w, 3) uint8, blue first as OpenCV has it.
    """

    t_s: FloatArray
    names: tuple[str, ...]
    images: Callable[[], Iterator[tuple[int, bytes | NDArray[np.uint8]]]]
    size: tuple[int, int]
    source: str


@dataclass(frozen=True, slots=True)
class Log:
    """What was read from one log. None: the log says nothing of it.

    Attributes:
        kind: ``tum``, ``euroc``, ``kitti``, ``vins-mono``, ``csv``, ``rosbag``, ``ulog``, ``ardupilot``, ``mavlink`` or
            ``photos``.
        title: what the log says of itself, for people.
        clock: what ``t_s`` counts from.
        odometry: body FLU in a z-up frame; ``odometry.source`` names topic or messages.
        uses_gnss: True when the odometry is an estimate that GNSS went into, None when that is not known.
        candidates: every odometry that the log holds, for ``LogOptions.topic``.
        lens: why the log's own calibration is not used, and what to do; empty where it is, or there is none.
        triggers_s: (n,) times at which the camera was triggered, for logs without pictures.
        stamp_offset_s: stream -> median of stamp minus record time, seconds, where both are known.
        lost: (start, seconds) of each dropout that the log reports.
        resets: (t_s, what) as the log reports them.
        notes: what was done or left out in reading, one sentence each.
        faults: what stands in the way of using the log, one sentence each.
    """

    kind: str
    title: str
    clock: str
    odometry: Odometry | None = None
    uses_gnss: bool | None = None
    candidates: tuple[str, ...] = ()
    imu: Imu | None = None
    height: Height | None = None
    attitude: Orientation | None = None
    gnss: Gnss | None = None
    frames: CameraFrames | None = None
    camera: Camera | None = None
    lens: str = ""
    triggers_s: FloatArray | None = None
    stamp_offset_s: tuple[tuple[str, float], ...] = ()
    lost: tuple[tuple[float, float], ...] = ()
    resets: tuple[tuple[float, str], ...] = ()
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


def ordered(where: str, t_s: FloatArray, notes: list[str]) -> NDArray[np.int64]:
    """Indices that put stamps in order, each once (the last of equal ones); what was mended goes to ``notes``.

    Raises FlightError where stamps go back by more than ``MAX_REORDER_S``: the clock jumped, or pieces are mixed up.
    """
    t = np.asarray(t_s, dtype=np.float64)
    if not t.size:
        return np.empty(0, dtype=np.int64)
    fall = np.maximum.accumulate(t) - t
    worst = int(fall.argmax())
    if fall[worst] > MAX_REORDER_S:
        raise FlightError(
            f"{where}: out of order: message {worst + 1} is stamped {t[worst]:.6f} s, {fall[worst]:.3f} s before an earlier "
            "one: its clock jumped or pieces were mixed up; cut the log there"
        )
    order = np.argsort(t, kind="stable")
    keep = np.append(np.diff(t[order]) > 0.0, True)
    late = int((np.diff(t) < 0).sum())
    if late:
        notes.append(
            f"{where}: {late} messages overtook each other (by up to {fall[worst]:.3f} s) and were sorted"
        )
    if not keep.all():
        notes.append(f"{where}: {int((~keep).sum())} stamps were there twice; the later message counts")
    return np.asarray(order[keep], dtype=np.int64)


def in_order(t_s: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: rows whose finite times grow. A time that is wrong costs its own row, not all that follow.

    Rows later than all before them; where that leaves out more than need be, the longest chain of growing times (Fredman,
    "On computing the length of longest increasing subsequences", 1975).
    """
    t = np.where(np.isfinite(t_s), t_s, -np.inf)
    plain = t > np.concatenate([[-np.inf], np.maximum.accumulate(t)[:-1]])
    if plain.all():
        return plain
    ends: list[float] = []
    rows: list[int] = []
    before = np.full(len(t), -1, dtype=np.int64)
    for i, value in enumerate(t.tolist()):
        if value == -math.inf:
            continue
        k = bisect_left(ends, value)
        before[i] = rows[k - 1] if k else -1
        ends[k : k + 1], rows[k : k + 1] = [value], [i]
    if len(ends) <= plain.sum():
        return plain
    chain = np.zeros(len(t), dtype=np.bool_)
    row = rows[-1]
    while row >= 0:
        chain[row] = True
        row = int(before[row])
    return chain


def tell_lost(
    notes: list[str], name: str, kept: int, of: int, why: str = "not numbers or not in order of time"
) -> None:
    """Notes how many of a stream's rows were left out, where there were such."""
    if kept < of:
        notes.append(f"{name}: {of - kept} of {of} rows ({(of - kept) / of:.1%}) are {why}, and left out")


def tell_unread(notes: list[str], unread: Sequence[tuple[int, int]], size: int) -> None:
    """Notes the parts (first byte, byte after the last) of a file that could not be read, where there were such."""
    if unread:
        lost = sum(end - start for start, end in unread)
        places = f"{len(unread)} places, the first" if len(unread) > 1 else "one place,"
        notes.append(
            f"damaged at {places} at byte {unread[0][0]}: {lost} of {size} bytes ({lost / size:.2%}) could not be read and "
            "were passed over"
        )


def looking_down(notes: list[str], sensors: dict[str, int | None]) -> str | None:
    """The rangefinder whose distances are heights, of ``sensors`` (name -> orientation; None: not told); None of none.

    Why others are not taken goes to ``notes``. One that is alone and tells no orientation is taken, which is noted.
    """
    down = [name for name, way in sensors.items() if way == DOWN]
    if not down and len(sensors) == 1 and None in sensors.values():
        down = list(sensors)
        notes.append(f"{down[0]}: no orientation is told; its distances are taken as heights")
    for name, way in sensors.items():
        if name in down[:1]:
            continue
        why = (
            f"it looks {_LOOKS.get(way, 'elsewhere than down')} (orientation {way})"
            if way is not None
            else ""
        )
        why = f"{down[0]} looks down, too, and comes first" if name in down else why
        notes.append(f"{name} is not taken as height: {why or 'it tells no orientation'}")
    return next(iter(down), None)


def are_turns(wxyz: FloatArray) -> NDArray[np.bool_]:
    """(n,) bool: quaternions (n, 4) of a length near 1; where over one in fifty has another, all with one (see ``unit``)."""
    length = np.linalg.norm(wxyz, axis=1)
    there = np.isfinite(length) & (length > 0.5)
    near = there & (np.abs(length - 1.0) < 0.01)
    return np.asarray(near if near.sum() >= 0.98 * there.sum() else there)


def unit(where: str, wxyz: FloatArray) -> FloatArray:
    """(n, 4) normalised; FlightError where one has no length near 1."""
    length = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1.0) < 0.01))
    if bad.size:
        i = int(bad[0])
        raise FlightError(
            f"{where}: message {i + 1}: the quaternion's length is {length[i]:.4f}, not 1: no orientation is there; "
            "choose another topic"
        )
    return np.asarray(wxyz / length[:, None])


def mixed(t_s: FloatArray, wxyz: FloatArray, at_s: FloatArray) -> FloatArray:
    """(m, 4) attitudes at ``at_s``, between neighbours by the straight mean (nlerp): they lie milliseconds apart."""
    if len(t_s) == 1:
        return np.repeat(wxyz, len(at_s), axis=0)
    right = np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1)
    share = np.clip((at_s - t_s[right - 1]) / (t_s[right] - t_s[right - 1]), 0.0, 1.0)[:, None]
    first, second = wxyz[right - 1], wxyz[right]
    second = np.where((first * second).sum(axis=1, keepdims=True) < 0.0, -second, second)
    between = (1.0 - share) * first + share * second
    return np.asarray(between / np.linalg.norm(between, axis=1, keepdims=True))


def choose(
    path: object, what: str, wanted: str | None, found: dict[str, int], *, needs: str, any_topic: bool
) -> str | None:
    """The stream to take of ``found`` (name -> messages); None when there is none.

    Raises FlightError that lists the candidates when ``wanted`` is not there or several are; ``needs`` is the option of
    ``LogOptions`` that chooses.
    """
    listed = ", ".join(f"{name} ({count})" for name, count in found.items())
    if wanted is not None:
        if wanted in found:
            return wanted
        raise FlightError(
            f"{path}: no {what} named {wanted!r}: there {'is ' + listed if listed else 'is none'}",
            needs=needs,
        )
    if len(found) > 1 and not any_topic:
        raise FlightError(f"{path}: {len(found)} streams hold {what}: choose one of {listed}", needs=needs)
    return next(iter(found), None)
