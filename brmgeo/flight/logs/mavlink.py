"""MAVLink telemetry in (.tlog), through pymavlink (LGPL-3.0), and what it shares with ArduPilot's own logs.

Bodies are FRD in NED, angles in radians. Message names after the MAVLink "common" definitions.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.errors import FlightError, MissingInputError, one_line
from brmgeo.extras import extra
from brmgeo.flight.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, quaternion_from_euler
from brmgeo.flight.logs.values import (
    Gnss,
    Height,
    Log,
    LogOptions,
    Orientation,
    choose,
    in_order,
    looking_down,
    mixed,
    tell_lost,
)
from brmgeo.flight.readings import FloatArray, Imu, Odometry

Messages = dict[str, list[Any]]
Clock = Callable[[Any], float]
_TELEMETRY = (
    "LOCAL_POSITION_NED",
    "ODOMETRY",
    "VISION_POSITION_ESTIMATE",
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "HIGHRES_IMU",
    "SCALED_IMU",
    "RAW_IMU",
    "DISTANCE_SENSOR",
    "RANGEFINDER",
    "GPS_RAW_INT",
    "CAMERA_FEEDBACK",
    "CAMERA_IMAGE_CAPTURED",
    "CAMERA_TRIGGER",
)


def rows_of(
    messages: list[Any], get: Callable[[Any], list[float]], notes: list[str], needed: int | None = None
) -> FloatArray:
    """(n, k) rows whose first column, the time, grows and whose first ``needed`` are numbers.

    A message that lacks a field, or has no number in it, is of another version, or damaged, and left out, which goes to
    ``notes``. Of no row at all, (0, 0).
    """
    out: list[list[float]] = []
    for message in messages:
        try:
            row = get(message)
        except (AttributeError, ValueError):
            continue
        if all(np.isfinite(v) for v in row[:needed]):
            out.append(row)
    rows = np.array(out, dtype=np.float64) if out else np.empty((0, 0))
    rows = rows[in_order(rows[:, 0])] if out else rows
    if messages:
        tell_lost(notes, messages[0].get_type(), len(rows), len(messages))
    return rows


def opened(names: tuple[str, ...], log: Any) -> dict[str, list[Any]]:
    """The messages of the given names, by name, in the order of the log."""
    found: dict[str, list[Any]] = {}
    while (message := log.recv_match(type=list(names))) is not None:
        found.setdefault(message.get_type(), []).append(message)
    return found


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    # The library's C part complains of every damaged byte straight to file descriptor 2.
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@contextlib.contextmanager
def library(path: Path) -> Iterator[Any]:
    """The library's readers (DFReader, mavutil) for one file; FlightError for whatever it stumbles over."""
    os.environ.setdefault("MAVLINK20", "1")
    with extra("logs", "reading ArduPilot logs"):
        from pymavlink import DFReader, mavutil
    if not path.is_file():
        raise MissingInputError(f"{path}: the log is missing")
    try:
        with contextlib.redirect_stdout(io.StringIO()), _quiet():
            yield DFReader, mavutil
    except FlightError:
        raise
    except Exception as error:  # damaged bytes make the library raise nearly anything
        reason = one_line(error, 120)
        raise FlightError(
            f"{path}: no readable ArduPilot log ({reason}): download it from the vehicle again"
        ) from None


def read_telemetry(path: Path, options: LogOptions) -> Log:
    """The streams of MAVLink telemetry that a flight needs.

    Raises FlightError for files that are no telemetry and an odometry asked for that is not there; MissingExtraError
    without the package pymavlink.
    """
    with library(path) as (_, mavutil):
        log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega", notimestamps=False)
        try:
            found = opened((*_TELEMETRY, "BAD_DATA"), log)
        finally:
            log.close()
    unread = [len(message.data) for message in found.pop("BAD_DATA", [])]
    if not found:
        raise FlightError(f"{path}: no MAVLink message of a flight: is it a .tlog, and whole?")
    found, sender = _of_vehicle(found)
    time, notes = _boot_clock(found), [sender]
    if unread:
        notes.append(
            f"damaged in {len(unread)} pieces: {sum(unread)} bytes could not be read and were passed over"
        )
    attitude = _attitude(found, time, notes)
    counts, odometry = _odometry(path, found, time, attitude, options, notes)
    own = odometry is not None and odometry.source == "LOCAL_POSITION_NED"
    gnss = _gnss(found, time, notes)
    if own:
        notes.append(
            "LOCAL_POSITION_NED is the autopilot's own estimate"
            + (", which GNSS goes into" if gnss is not None else "")
        )
    shots = next((found[n] for n in _TELEMETRY[-3:] if n in found), [])
    cameras = rows_of(shots, lambda m: [time(m)], notes)
    return Log(
        kind="mavlink",
        title="MAVLink telemetry (.tlog)",
        clock="seconds since the autopilot's boot",
        odometry=odometry,
        uses_gnss=gnss is not None if own else None,
        candidates=counts,
        imu=_imu(found, time, notes),
        height=_height(found, time, odometry, notes),
        attitude=attitude,
        gnss=gnss,
        triggers_s=cameras[:, 0] if cameras.size else None,
        notes=tuple(notes),
    )


def _of_vehicle(found: Messages) -> tuple[Messages, str]:
    # A ground station hears itself and others: the vehicle is the one that tells most.
    senders: dict[int, int] = {}
    for messages in found.values():
        for m in messages:
            senders[m.get_srcSystem()] = senders.get(m.get_srcSystem(), 0) + 1
    vehicle = max(senders, key=lambda s: senders[s])
    own = {n: kept for n, ms in found.items() if (kept := [m for m in ms if m.get_srcSystem() == vehicle])}
    return own, f"MAVLink system {vehicle}" + (f", of {sorted(senders)}" if len(senders) > 1 else "")


def _boot_clock(found: Messages) -> Clock:
    booted = [
        (m._timestamp - m.time_boot_ms * 1e-3)
        for ms in found.values()
        for m in ms
        if hasattr(m, "time_boot_ms")
    ]
    start = float(np.median(booted)) if booted else 0.0

    def time(m: Any) -> float:
        if hasattr(m, "time_boot_ms"):
            return float(m.time_boot_ms) * 1e-3
        stamp = getattr(m, "time_usec", getattr(m, "usec", 0)) * 1e-6
        # Some senders put Unix time there; the boot time is then that of the ground station's receipt.
        return float(stamp) if 0.0 < stamp < 1e8 else float(m._timestamp - start)

    return time


def _attitude(found: Messages, time: Clock, notes: list[str]) -> Orientation | None:
    euler = rows_of(found.get("ATTITUDE", []), lambda m: [time(m), m.roll, m.pitch, m.yaw], notes)
    if euler.size:
        wxyz = enu_flu_from_ned_frd(quaternion_from_euler(*euler[:, 1:4].T))
        return Orientation(euler[:, 0], wxyz, True, "ATTITUDE")
    rows = rows_of(found.get("ATTITUDE_QUATERNION", []), lambda m: [time(m), m.q1, m.q2, m.q3, m.q4], notes)
    if rows.size:
        wxyz = enu_flu_from_ned_frd(rows[:, 1:5])
        return Orientation(rows[:, 0], wxyz, True, "ATTITUDE_QUATERNION")
    return None


def _odometry(
    path: Path,
    found: Messages,
    time: Clock,
    attitude: Orientation | None,
    options: LogOptions,
    notes: list[str],
) -> tuple[tuple[str, ...], Odometry | None]:
    # The names of every track that is there, and the chosen one. A filter without a position says NaN: then there is no
    # odometry of it.
    tracks = {
        "VISION_POSITION_ESTIMATE": rows_of(
            found.get("VISION_POSITION_ESTIMATE", []),
            lambda m: [time(m), m.x, m.y, m.z, m.roll, m.pitch, m.yaw, getattr(m, "reset_counter", 0)],
            notes,
        ),
        "LOCAL_POSITION_NED": rows_of(
            found.get("LOCAL_POSITION_NED", []) if attitude is not None else [],
            lambda m: [time(m), m.x, m.y, m.z],
            notes,
        ),
    }
    counts = {name: len(rows) for name, rows in tracks.items() if rows.size}
    stream = choose(path, "odometry", options.topic, counts, needs="topic", any_topic=True)
    if stream is None:
        return tuple(counts), None
    rows = tracks[stream]
    if stream == "LOCAL_POSITION_NED":
        assert attitude is not None
        wxyz, segment = mixed(attitude.t_s, attitude.wxyz, rows[:, 0]), None
    else:
        wxyz = enu_flu_from_ned_frd(quaternion_from_euler(*rows[:, 4:7].T))
        segment = rows[:, 7].astype(np.int64)
    return tuple(counts), Odometry(rows[:, 0], enu_from_ned(rows[:, 1:4]), wxyz, stream, segment)


def _imu(found: Messages, time: Clock, notes: list[str]) -> Imu | None:
    name = next((n for n in ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU") if n in found), None)
    if name is None:
        return None
    # The others tell milliradians and thousandths of g.
    gyro, accel = (1.0, 1.0) if name == "HIGHRES_IMU" else (1e-3, GRAVITY_M_S2 * 1e-3)
    rows = rows_of(found[name], lambda m: [time(m), m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc], notes)
    if not rows.size:
        return None
    return Imu(rows[:, 0], flu_from_frd(rows[:, 1:4]) * gyro, flu_from_frd(rows[:, 4:7]) * accel)


def _height(found: Messages, time: Clock, odometry: Odometry | None, notes: list[str]) -> Height | None:
    sensors: Messages = {}
    for m in found.get("DISTANCE_SENSOR", []):
        sensors.setdefault(f"DISTANCE_SENSOR {m.id}, orientation {m.orientation}", []).append(m)
    name = looking_down(notes, {n: int(messages[0].orientation) for n, messages in sensors.items()})
    if name is not None:
        down = rows_of(sensors[name], lambda m: [time(m), m.current_distance / 100.0], notes)
        if down.size:
            source = "DISTANCE_SENSOR" if len(sensors) == 1 else name
            return Height(down[:, 0], down[:, 1], "ground", source)
    ranges = rows_of(found.get("RANGEFINDER", []), lambda m: [time(m), m.distance], notes)
    if ranges.size and (ranges[:, 1] > 0.0).any():
        return Height(ranges[:, 0], ranges[:, 1], "ground", "RANGEFINDER")
    if odometry is not None:
        return Height(odometry.t_s, odometry.xyz_m[:, 2], "take-off", odometry.source)
    return None


def _gnss(found: Messages, time: Clock, notes: list[str]) -> Gnss | None:
    rows = rows_of(
        [m for m in found.get("GPS_RAW_INT", []) if m.fix_type >= 3],
        lambda m: [
            time(m),
            m.lon * 1e-7,
            m.lat * 1e-7,
            m.alt * 1e-3,
            (getattr(m, "h_acc", 0) or np.nan) * 1e-3,
        ],
        notes,
        4,
    )
    return Gnss(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4]) if rows.size else None
