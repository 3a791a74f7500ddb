"""ArduPilot logs in: dataflash .bin/.log, through pymavlink (LGPL-3.0), and telemetry by its ending.

ArduPilot writes body FRD in NED, angles in degrees; times are TimeUS since boot, or TimeMS before 2015. Message names
after the ArduPilot "Log Messages".
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.files import scratch_folder
from brmgeo.flight.frames import enu_flu_from_ned_frd, enu_from_ned, flu_from_frd, quaternion_from_euler
from brmgeo.flight.logs.mavlink import Clock, Messages, library, opened, read_telemetry, rows_of
from brmgeo.flight.logs.values import (
    DOWN,
    Gnss,
    Height,
    Log,
    LogOptions,
    Orientation,
    choose,
    looking_down,
    mixed,
    tell_lost,
    tell_unread,
)
from brmgeo.flight.readings import FloatArray, Imu, Odometry

#: Filters in order of worth: EKF3, EKF2, EKF1 of the TimeMS era (positions PN, PE, PD), and visual odometry.
_FILTERS = ("XKF1", "NKF1", "EKF1")
_HEAD = b"\xa3\x95"
_FORMAT = 0x80  # of the messages that tell the lengths of the others
_PAGE = 528  # bytes of a page of dataflash
_DATAFLASH = (
    *_FILTERS,
    "ATT",
    "AHR2",
    "VISP",
    "IMU",
    "XKF4",
    "NKF4",
    "PARM",
    "RFND",
    "CTUN",
    "GPS",
    "GPA",
    "CAM",
    "TRIG",
    "MSG",
    "ORGN",
)


def read_ardupilot(path: Path, options: LogOptions | None = None) -> Log:
    """The streams of an ArduPilot log (.bin, .log) or of MAVLink telemetry (.tlog) that a flight needs.

    Raises FlightError for files that are no such log and an odometry asked for that is not there; MissingExtraError
    without the package pymavlink.
    """
    options = options or LogOptions()
    if path.suffix.lower() == ".tlog":
        return read_telemetry(path, options)
    notes: list[str] = []
    found = _messages(path, notes)
    time = _boot_seconds(found)
    euler = rows_of(found.get("ATT", []), lambda m: [time(m), m.Roll, m.Pitch, m.Yaw], notes)
    attitude = None
    if euler.size:
        attitude = Orientation(euler[:, 0], _from_degrees(euler[:, 1:4]), True, "ATT")
    counts, odometry = _odometry(path, found, time, attitude, options, notes)
    gnss = _gnss(found, time, notes)
    own = odometry is not None and odometry.source != "VISP"
    if odometry is not None and own:
        more = (
            ", which GNSS goes into: it is no odometry of a flight without GNSS" if gnss is not None else ""
        )
        notes.append(f"{odometry.source} is the autopilot's own estimate{more}")
    cameras = rows_of(found.get("CAM", []) or found.get("TRIG", []), lambda m: [time(m)], notes)
    return Log(
        kind="ardupilot",
        title=next((str(m.Message) for m in found.get("MSG", [])), "ArduPilot dataflash log"),
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


def _messages(path: Path, notes: list[str]) -> Messages:
    with library(path) as (reader, _), ExitStack() as stack:
        if path.suffix.lower() == ".log":
            log = reader.DFReader_text(str(path), zero_time_base=True)
        else:
            data = path.read_bytes()
            if data[:2] != _HEAD:
                raise FlightError(
                    f"{path}: no ArduPilot dataflash log: it does not begin with a message header"
                )
            whole, unread = _whole_messages(data)
            source = path
            if unread:
                # The library stops at the first type that it does not know, and reads files by their names alone.
                source = stack.enter_context(scratch_folder("log")) / path.name
                source.write_bytes(whole)
            tell_unread(notes, unread, len(data))
            log = reader.DFReader_binary(str(source), zero_time_base=True)
        try:
            found = opened(_DATAFLASH, log)
        finally:
            close = getattr(log, "close", None)
            if close is not None:
                close()
    if not found:
        raise FlightError(f"{path}: the log holds none of the messages of a flight: is it cut short?")
    return found


def _whole_messages(data: bytes) -> tuple[bytes, list[tuple[int, int]]]:
    """The log without what does not lead from one message to the next, and the (start, end) of what was left out.

    A message counts where its type has a length, and it ends where another begins or the file ends. A way is found again
    at the next such message.
    """
    lengths = {_FORMAT: 89}
    at = kept = 0
    unread: list[tuple[int, int]] = []
    pieces = []
    lost: int | None = None
    while at + 3 <= len(data):
        length = lengths.get(data[at + 2], 0) if data[at : at + 2] == _HEAD else 0
        end = at + length
        if length and (data[end : end + 2] == _HEAD or end == len(data) or len(data) - end < _PAGE):
            if lost is not None:
                pieces.append(data[kept:lost])
                unread.append((lost, at))
                kept, lost = at, None
            if data[at + 2] == _FORMAT and end <= len(data):
                lengths[data[at + 3]] = data[at + 4]
            at = end
        else:
            lost = at if lost is None else lost
            found = data.find(_HEAD, at + 1)
            at = found if found >= 0 else len(data)
    # Logs are written in pages: what stands behind the last message within one is no loss.
    if lost is not None and len(data) - lost >= _PAGE:
        pieces.append(data[kept:lost])
        unread.append((lost, len(data)))
        kept = len(data)
    return b"".join([*pieces, data[kept:]]), unread


def _odometry(
    path: Path,
    found: Messages,
    time: Clock,
    attitude: Orientation | None,
    options: LogOptions,
    notes: list[str],
) -> tuple[tuple[str, ...], Odometry | None]:
    # The names of every track that is there, and the chosen one.
    streams = {name: _core(name, found, time, notes) for name in _FILTERS if name in found}
    counts = {name: len(messages) for name, (messages, _) in streams.items() if messages}
    seen = rows_of(
        found.get("VISP", []),
        lambda m: [time(m), m.PX, m.PY, m.PZ, m.Roll, m.Pitch, m.Yaw, getattr(m, "Rst", 0)],
        notes,
    )
    if seen.size:
        counts = {"VISP": len(seen)} | counts
    stream = choose(path, "odometry", options.topic, counts, needs="topic", any_topic=True)
    if stream is None:
        return tuple(counts), None
    if stream == "VISP":
        segment = seen[:, 7].astype(np.int64)
        xyz = enu_from_ned(seen[:, 1:4])
        return tuple(counts), Odometry(seen[:, 0], xyz, _from_degrees(seen[:, 4:7]), "VISP", segment)
    messages, parts = streams[stream]
    segment_of = {id(m): part for m, part in zip(messages, parts)}
    rows = rows_of(
        messages,
        lambda m: [time(m), m.PN, m.PE, m.PD, m.Roll, m.Pitch, m.Yaw, segment_of[id(m)]],
        notes,
    )
    # The filter says zero until it has an origin.
    begun = np.flatnonzero(rows[:, 1:4].any(axis=1)) if rows.size else np.empty(0, np.int64)
    if not begun.size:
        notes.append(f"{stream} says zero throughout: the filter never had a position")
        return tuple(counts), None
    rows = rows[begun[0] :]
    wxyz = _from_degrees(rows[:, 4:7])
    if attitude is not None and stream == "EKF1":
        # EKF1 tells angles late in some versions.
        wxyz = mixed(attitude.t_s, attitude.wxyz, rows[:, 0])
    part = rows[:, 7].astype(np.int64) if rows[-1, 7] > rows[0, 7] else None
    return tuple(counts), Odometry(rows[:, 0], enu_from_ned(rows[:, 1:4]), wxyz, stream, part)


def _imu(found: Messages, time: Clock, notes: list[str]) -> Imu | None:
    inertial = [m for m in found.get("IMU", []) if getattr(m, "I", 0) == 0]
    rows = rows_of(inertial, lambda m: [time(m), m.GyrX, m.GyrY, m.GyrZ, m.AccX, m.AccY, m.AccZ], notes)
    return Imu(rows[:, 0], flu_from_frd(rows[:, 1:4]), flu_from_frd(rows[:, 4:7])) if rows.size else None


def _boot_seconds(found: Messages) -> Clock:
    # TimeUS; before 2015 TimeMS. The GPS of that era tells the time of week as TimeMS and the boot time as T.
    def seconds(message: Any) -> float:
        fields = message.get_fieldnames()
        if "TimeUS" in fields:
            return float(message.TimeUS) * 1e-6
        if message.get_type() == "GPS" and "T" in fields:
            return float(message.T) * 1e-3
        return float(message.TimeMS) * 1e-3 if "TimeMS" in fields else float("nan")

    return seconds


def _core(name: str, found: Messages, time: Clock, notes: list[str]) -> tuple[list[Any], list[int]]:
    # One estimator of those that run side by side: the primary core of each time, or the first where none is told; and the
    # segment of each message, which grows where the primary changes.
    messages = found[name]
    key = next((k for k in ("C", "I") if hasattr(messages[0], k)), None)
    if key is None:
        return messages, [0] * len(messages)
    told = rows_of(
        [m for m in found.get(f"{name[:-1]}4", []) if getattr(m, key, 0) == 0 and hasattr(m, "PI")],
        lambda m: [time(m), m.PI],
        notes,
    )
    if not told.size:
        told = np.array([[0.0, min(getattr(m, key) for m in messages)]])
    switches = np.flatnonzero(np.diff(told[:, 1])) + 1
    since = np.append(0, switches)
    starts, cores = told[switches, 0], told[since, 1].astype(np.int64)
    part = np.searchsorted(starts, [time(m) for m in messages], side="right")
    kept = [i for i, m in enumerate(messages) if getattr(m, key) == cores[part[i]]]
    names = str(cores[0]) if not switches.size else "the primary one"
    tell_lost(notes, name, len(kept), len(messages), f"of other cores than {names}")
    if switches.size:
        notes.append(
            f"{name}: the primary core changes {switches.size} times, first from {cores[0]} to {cores[1]} at "
            f"{starts[0]:.3f} s: the track begins anew there"
        )
    return [messages[i] for i in kept], [int(part[i]) for i in kept]


def _from_degrees(angles: FloatArray) -> FloatArray:
    return enu_flu_from_ned_frd(quaternion_from_euler(*np.radians(angles).T))


def _gnss(found: Messages, time: Clock, notes: list[str]) -> Gnss | None:
    fixes = [m for m in found.get("GPS", []) if getattr(m, "Status", 0) >= 3 and getattr(m, "I", 0) == 0]
    rows = rows_of(fixes, lambda m: [time(m), m.Lng, m.Lat, m.Alt], notes)
    if not rows.size:
        return None
    sigma = np.full(len(rows), np.nan)
    accuracy = rows_of(
        [m for m in found.get("GPA", []) if getattr(m, "I", 0) == 0], lambda m: [time(m), m.HAcc], notes
    )
    if accuracy.size:
        sigma = np.interp(rows[:, 0], accuracy[:, 0], accuracy[:, 1])
    return Gnss(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], sigma)


def _height(found: Messages, time: Clock, odometry: Odometry | None, notes: list[str]) -> Height | None:
    sensors = _rangefinders(found)
    name = looking_down(notes, {n: way for n, (way, _, _) in sensors.items()})
    if name is not None:
        _, field, messages = sensors[name]
        ranges = [m for m in messages if getattr(m, "Orient", DOWN) == DOWN and getattr(m, "Stat", 4) == 4]
        rows = rows_of(ranges, lambda m: [time(m), getattr(m, field)], notes)
        if rows.size and (rows[:, 1] > 0.0).any():
            return Height(rows[:, 0], rows[:, 1], "ground", name)
    if odometry is not None:
        return Height(odometry.t_s, odometry.xyz_m[:, 2], "take-off", odometry.source)
    return None


def _rangefinders(found: Messages) -> dict[str, tuple[int | None, str, list[Any]]]:
    # Name -> orientation, the field of its distance, its messages. Logs before 4.0 tell two in one message, and their
    # orientations among the parameters alone.
    sets = {str(m.Name): float(m.Value) for m in found.get("PARM", []) if hasattr(m, "Value")}
    each: dict[int, list[Any]] = {}
    for m in found.get("RFND", []):
        each.setdefault(int(getattr(m, "Instance", 0)), []).append(m)
    out: dict[str, tuple[int | None, str, list[Any]]] = {}
    for number, messages in sorted(each.items()):
        ways = [int(m.Orient) for m in messages if hasattr(m, "Orient")]
        for field in ("Dist", "Dist1", "Dist2"):
            if not any(getattr(m, field, 0.0) > 0.0 for m in messages):
                continue
            nth = number + 1 if field == "Dist" else int(field[-1])
            told = [sets[n] for n in (f"RNGFND{nth}_ORIENT", "RNGFND_ORIENT")[: 1 + (nth == 1)] if n in sets]
            way = (DOWN if DOWN in ways else ways[0]) if ways else int(told[0]) if told else None
            alone = len(each) == 1 and field != "Dist2"
            out["RFND" if alone else f"RFND {nth}"] = (way, field, messages)
    return out
