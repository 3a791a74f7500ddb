"""ArduPilot logs in: dataflash .bin/.log and telemetry .tlog, through pymavlink (LGPL-3.0).

ArduPilot writes body FRD in NED, angles in degrees; times are TimeUS since boot, or TimeMS before 2015. Message names
after the ArduPilot "Log Messages" and the MAVLink "common" definitions.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, quaternion_from_euler
from brmgeo.flight.logs.ulog import mixed
from brmgeo.flight.logs.values import Gnss, Height, Log, LogOptions, Orientation, choose, missing_library
from brmgeo.flight.readings import FloatArray, Imu, Odometry

#: Filters in order of worth: EKF3, EKF2, EKF1 of the TimeMS era (positions PN, PE, PD), and visual odometry.
_FILTERS = ("XKF1", "NKF1", "EKF1")
_DATAFLASH = (
    *_FILTERS,
    "ATT",
    "AHR2",
    "VISP",
    "IMU",
    "RFND",
    "CTUN",
    "GPS",
    "GPA",
    "CAM",
    "TRIG",
    "MSG",
    "ORGN",
)
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
_G = 9.80665


def _rows(messages: list[Any], get: Callable[[Any], list[float]], needed: int | None = None) -> FloatArray:
    # (n, k) rows whose first column, the time, grows and whose first ``needed`` are numbers; a message that lacks a
    # field is of another version, or damaged, and left out.
    out: list[list[float]] = []
    last = -np.inf
    for message in messages:
        try:
            row = get(message)
        except AttributeError:
            continue
        if row[0] > last and all(np.isfinite(v) for v in row[:needed]):
            out.append(row)
            last = row[0]
    return np.array(out, dtype=np.float64) if out else np.empty((0, 0))


def _opened(path: Path, names: tuple[str, ...], log: Any) -> dict[str, list[Any]]:
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
def _library(path: Path) -> Iterator[Any]:
    os.environ.setdefault("MAVLINK20", "1")
    try:
        from pymavlink import DFReader, mavutil
    except ImportError:
        raise missing_library(path, "ArduPilot logs", "pymavlink") from None
    if not path.is_file():
        raise MissingInputError(f"{path}: the log is missing")
    try:
        with contextlib.redirect_stdout(io.StringIO()), _quiet():
            yield DFReader, mavutil
    except FlightError:
        raise
    except Exception as error:  # damaged bytes make the library raise nearly anything
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise FlightError(
            f"{path}: no readable ArduPilot log ({reason}): download it from the vehicle again"
        ) from None


def read_ardupilot(path: Path, options: LogOptions | None = None) -> Log:
    """The streams of an ArduPilot log (.bin, .log) or of MAVLink telemetry (.tlog) that a flight needs.

    Raises FlightError for files that are no such log and an odometry asked for that is not there; MissingInputError
    without the package pymavlink.
    """
    options = options or LogOptions()
    if path.suffix.lower() == ".tlog":
        return _telemetry(path, options)
    with _library(path) as (reader, _):
        if path.suffix.lower() == ".log":
            log = reader.DFReader_text(str(path), zero_time_base=True)
        else:
            if path.stat().st_size and path.read_bytes()[:2] != b"\xa3\x95":
                raise FlightError(
                    f"{path}: no ArduPilot dataflash log: it does not begin with a message header"
                )
            log = reader.DFReader_binary(str(path), zero_time_base=True)
        try:
            found = _opened(path, _DATAFLASH, log)
        finally:
            close = getattr(log, "close", None)
            if close is not None:
                close()
    if not found:
        raise FlightError(f"{path}: the log holds none of the messages of a flight: is it cut short?")
    notes: list[str] = []
    boot = _boot_seconds(found)

    def time(m: Any) -> float:
        return boot(m)

    euler = _rows(found.get("ATT", []), lambda m: [time(m), m.Roll, m.Pitch, m.Yaw])
    attitude = None
    if euler.size:
        attitude = Orientation(euler[:, 0], _from_degrees(euler[:, 1:4]), True, "ATT")
    streams = {name: _core(found[name]) for name in _FILTERS if name in found}
    counts = {name: len(rows) for name, rows in streams.items() if rows}
    seen = _rows(
        found.get("VISP", []),
        lambda m: [time(m), m.PX, m.PY, m.PZ, m.Roll, m.Pitch, m.Yaw, getattr(m, "Rst", 0)],
    )
    if seen.size:
        counts = {"VISP": len(seen)} | counts
    stream = choose(path, "odometry", "--topic", options.topic, counts, any_topic=True)
    odometry = None
    if stream == "VISP":
        segment = seen[:, 7].astype(np.int64)
        odometry = Odometry(
            seen[:, 0], enu_from_ned(seen[:, 1:4]), _from_degrees(seen[:, 4:7]), "VISP", segment
        )
    elif stream is not None:
        rows = _rows(streams[stream], lambda m: [time(m), m.PN, m.PE, m.PD, m.Roll, m.Pitch, m.Yaw])
        begun = (
            np.flatnonzero(rows[:, 1:4].any(axis=1)) if rows.size else np.empty(0, np.int64)
        )  # the filter says zero until it has an origin
        if begun.size:
            rows = rows[begun[0] :]
            wxyz = _from_degrees(rows[:, 4:7])
            if attitude is not None and stream == "EKF1":
                wxyz = mixed(
                    attitude.t_s, attitude.wxyz, rows[:, 0]
                )  # EKF1 tells angles late in some versions
            odometry = Odometry(rows[:, 0], enu_from_ned(rows[:, 1:4]), wxyz, stream)
        else:
            notes.append(f"{stream} says zero throughout: the filter never had a position")
    imu = None
    inertial = [m for m in found.get("IMU", []) if getattr(m, "I", 0) == 0]
    if inertial:
        rows = _rows(inertial, lambda m: [time(m), m.GyrX, m.GyrY, m.GyrZ, m.AccX, m.AccY, m.AccZ])
        if rows.size:
            imu = Imu(rows[:, 0], flu_from_frd(rows[:, 1:4]), flu_from_frd(rows[:, 4:7]))
    gnss = _gnss(found, time)
    if odometry is not None and stream != "VISP":
        notes.append(
            f"{stream} is the autopilot's own estimate"
            + (
                ", which GNSS goes into: it is no odometry of a flight without GNSS"
                if gnss is not None
                else ""
            )
        )
    cameras = _rows(found.get("CAM", []) or found.get("TRIG", []), lambda m: [time(m)])
    first = next((str(m.Message) for m in found.get("MSG", [])), "ArduPilot dataflash log")
    return Log(
        "ardupilot",
        first,
        "seconds since the autopilot's boot",
        odometry,
        None if odometry is None or stream == "VISP" else gnss is not None,
        tuple(counts),
        imu,
        _height(found, time, odometry),
        attitude,
        gnss,
        triggers_s=cameras[:, 0] if cameras.size else None,
        notes=tuple(notes),
    )


def _boot_seconds(found: dict[str, list[Any]]) -> Callable[[Any], float]:
    # TimeUS; before 2015 TimeMS. The GPS of that era tells the time of week as TimeMS and the boot time as T.
    def seconds(message: Any) -> float:
        fields = message.get_fieldnames()
        if "TimeUS" in fields:
            return float(message.TimeUS) * 1e-6
        if message.get_type() == "GPS" and "T" in fields:
            return float(message.T) * 1e-3
        return float(message.TimeMS) * 1e-3 if "TimeMS" in fields else float("nan")

    return seconds


def _core(messages: list[Any]) -> list[Any]:
    # One estimator of those that run side by side: the first core.
    key = next((k for k in ("C", "I") if hasattr(messages[0], k)), None)
    if key is None:
        return messages
    first = min(getattr(m, key) for m in messages)
    return [m for m in messages if getattr(m, key) == first]


def _from_degrees(angles: FloatArray) -> FloatArray:
    return enu_flu_from_ned_frd(quaternion_from_euler(*np.radians(angles).T))


def _gnss(found: dict[str, list[Any]], time: Callable[[Any], float]) -> Gnss | None:
    fixes = [m for m in found.get("GPS", []) if getattr(m, "Status", 0) >= 3 and getattr(m, "I", 0) == 0]
    rows = _rows(fixes, lambda m: [time(m), m.Lng, m.Lat, m.Alt])
    if not rows.size:
        return None
    sigma = np.full(len(rows), np.nan)
    accuracy = _rows(
        [m for m in found.get("GPA", []) if getattr(m, "I", 0) == 0], lambda m: [time(m), m.HAcc]
    )
    if accuracy.size:
        sigma = np.interp(rows[:, 0], accuracy[:, 0], accuracy[:, 1])
    return Gnss(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], sigma)


def _height(
    found: dict[str, list[Any]], time: Callable[[Any], float], odometry: Odometry | None
) -> Height | None:
    ranges = [
        m for m in found.get("RFND", []) if getattr(m, "Orient", 25) == 25 and getattr(m, "Stat", 4) == 4
    ]
    rows = _rows(ranges, lambda m: [time(m), m.Dist if hasattr(m, "Dist") else m.Dist1])
    if rows.size and (rows[:, 1] > 0.0).any():
        return Height(rows[:, 0], rows[:, 1], "ground", "RFND")
    if odometry is not None:
        return Height(odometry.t_s, odometry.xyz_m[:, 2], "take-off", odometry.source)
    return None


def _telemetry(path: Path, options: LogOptions) -> Log:
    with _library(path) as (_, mavutil):
        log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega", notimestamps=False)
        try:
            found = _opened(path, _TELEMETRY, log)
        finally:
            log.close()
    if not found:
        raise FlightError(f"{path}: no MAVLink message of a flight: is it a .tlog, and whole?")
    # A ground station hears itself and others: the vehicle is the one that tells most.
    senders: dict[int, int] = {}
    for messages in found.values():
        for m in messages:
            senders[m.get_srcSystem()] = senders.get(m.get_srcSystem(), 0) + 1
    vehicle = max(senders, key=lambda s: senders[s])
    found = {n: kept for n, ms in found.items() if (kept := [m for m in ms if m.get_srcSystem() == vehicle])}
    notes = [f"MAVLink system {vehicle}"] + ([f"of {sorted(senders)}"] if len(senders) > 1 else [])

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

    attitude = None
    euler = _rows(found.get("ATTITUDE", []), lambda m: [time(m), m.roll, m.pitch, m.yaw])
    quaternions = _rows(found.get("ATTITUDE_QUATERNION", []), lambda m: [time(m), m.q1, m.q2, m.q3, m.q4])
    if euler.size:
        wxyz = enu_flu_from_ned_frd(quaternion_from_euler(*euler[:, 1:4].T))
        attitude = Orientation(euler[:, 0], wxyz, True, "ATTITUDE")
    elif quaternions.size:
        wxyz = enu_flu_from_ned_frd(quaternions[:, 1:5])
        attitude = Orientation(quaternions[:, 0], wxyz, True, "ATTITUDE_QUATERNION")
    # A filter without a position says NaN: then there is no odometry of it.
    tracks = {
        "VISION_POSITION_ESTIMATE": _rows(
            found.get("VISION_POSITION_ESTIMATE", []),
            lambda m: [time(m), m.x, m.y, m.z, m.roll, m.pitch, m.yaw, getattr(m, "reset_counter", 0)],
        ),
        "LOCAL_POSITION_NED": _rows(
            found.get("LOCAL_POSITION_NED", []) if attitude is not None else [],
            lambda m: [time(m), m.x, m.y, m.z],
        ),
    }
    counts = {name: len(rows) for name, rows in tracks.items() if rows.size}
    stream = choose(path, "odometry", "--topic", options.topic, counts, any_topic=True)
    odometry = None
    if stream == "LOCAL_POSITION_NED":
        assert attitude is not None
        rows = tracks[stream]
        odometry = Odometry(
            rows[:, 0], enu_from_ned(rows[:, 1:4]), mixed(attitude.t_s, attitude.wxyz, rows[:, 0]), stream
        )
    elif stream is not None:
        rows = tracks[stream]
        wxyz = enu_flu_from_ned_frd(quaternion_from_euler(*rows[:, 4:7].T))
        odometry = Odometry(rows[:, 0], enu_from_ned(rows[:, 1:4]), wxyz, stream, rows[:, 7].astype(np.int64))
    imu = None
    name = next((n for n in ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU") if n in found), None)
    if name is not None:
        gyro, accel = (
            (1.0, 1.0) if name == "HIGHRES_IMU" else (1e-3, _G * 1e-3)
        )  # milliradians, thousandths of g
        rows = _rows(found[name], lambda m: [time(m), m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc])
        if rows.size:
            imu = Imu(rows[:, 0], flu_from_frd(rows[:, 1:4]) * gyro, flu_from_frd(rows[:, 4:7]) * accel)
    height = None
    down = _rows(
        [m for m in found.get("DISTANCE_SENSOR", []) if m.orientation == 25],
        lambda m: [time(m), m.current_distance / 100.0],
    )
    ranges = _rows(found.get("RANGEFINDER", []), lambda m: [time(m), m.distance])
    if down.size:
        height = Height(down[:, 0], down[:, 1], "ground", "DISTANCE_SENSOR")
    elif ranges.size and (ranges[:, 1] > 0.0).any():
        height = Height(ranges[:, 0], ranges[:, 1], "ground", "RANGEFINDER")
    elif odometry is not None:
        height = Height(odometry.t_s, odometry.xyz_m[:, 2], "take-off", odometry.source)
    gnss = None
    rows = _rows(
        [m for m in found.get("GPS_RAW_INT", []) if m.fix_type >= 3],
        lambda m: [
            time(m),
            m.lon * 1e-7,
            m.lat * 1e-7,
            m.alt * 1e-3,
            (getattr(m, "h_acc", 0) or np.nan) * 1e-3,
        ],
        4,
    )
    if rows.size:
        gnss = Gnss(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4])
    if stream == "LOCAL_POSITION_NED":
        notes.append(
            "LOCAL_POSITION_NED is the autopilot's own estimate"
            + (", which GNSS goes into" if rows.size else "")
        )
    shots = next((found[n] for n in _TELEMETRY[-3:] if n in found), [])
    cameras = _rows(shots, lambda m: [time(m)])
    return Log(
        "mavlink",
        "MAVLink telemetry (.tlog)",
        "seconds since the autopilot's boot",
        odometry,
        None if stream != "LOCAL_POSITION_NED" else bool(rows.size),
        tuple(counts),
        imu,
        height,
        attitude,
        gnss,
        triggers_s=cameras[:, 0] if cameras.size else None,
        notes=(
            ", ".join(notes[:2]) if len(senders) > 1 else notes[0],
            *notes[2 if len(senders) > 1 else 1 :],
        ),
    )
