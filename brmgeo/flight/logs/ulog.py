"""PX4 logs in (ULog), through pyulog (BSD-3-Clause).

PX4 writes body FRD in NED, or in a z-down world of arbitrary heading (its FRD pose frame), microseconds since boot;
message definitions after the PX4 user guide, "uORB Message Reference" (vehicle_odometry, vehicle_local_position,
vehicle_attitude, distance_sensor), with the enums of versions before 1.14 besides the present ones.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from brmgeo.errors import FlightError, MissingInputError, one_line
from brmgeo.extras import extra
from brmgeo.flight.frames import (
    enu_flu_from_ned_frd,
    enu_from_ned,
    flu_flu_from_frd_frd,
    flu_from_frd,
)
from brmgeo.flight.logs.values import (
    DOWN,
    Gnss,
    Height,
    Log,
    LogOptions,
    Orientation,
    are_turns,
    choose,
    in_order,
    looking_down,
    mixed,
    tell_lost,
    tell_unread,
    unit,
)
from brmgeo.flight.readings import FloatArray, Imu, Odometry

Data = dict[str, Any]
#: In order of worth to a flight without GNSS: what vision said comes before what the autopilot made of everything.
_STREAMS = ("vehicle_visual_odometry", "vehicle_odometry", "vehicle_local_position")
_TYPES = b"BFIMPQALDCSOR"
_DATA = _TYPES[8]


def read_ulog(path: Path, options: LogOptions | None = None) -> Log:
    """The streams of a PX4 log that a flight needs.

    Raises FlightError for files that are no ULog or break off before the first data, and an odometry asked for that
    is not there; MissingExtraError without the package pyulog. Dropouts and resets are told in the result.
    """
    options = options or LogOptions()
    with extra("logs", "reading PX4 logs"):
        from pyulog import ULog
    if not path.is_file():
        raise MissingInputError(f"{path}: the log is missing")
    said = io.StringIO()
    data = path.read_bytes()
    whole, unread, size = *_whole_messages(data), len(data)
    try:
        with contextlib.redirect_stdout(said):  # the library reports damage by printing
            log = ULog(io.BytesIO(whole))
    except Exception as error:  # damaged bytes make the library raise nearly anything
        reason = one_line(error, 120)
        raise FlightError(
            f"{path}: no readable ULog ({reason}): download it from the vehicle again"
        ) from None
    sets: dict[str, Data] = {}
    for each in sorted(log.data_list, key=lambda d: d.multi_id):
        sets.setdefault(each.name, each.data)
    if not sets:
        raise FlightError(
            f"{path}: the ULog breaks off before its first data: download it from the vehicle again"
        )
    notes: list[str] = []
    tell_unread(notes, unread, size)
    if log.file_corruption or "corrupt" in said.getvalue().lower() or _cut_short(path):
        notes.append("the file is damaged or cut short; what was whole in it was read")

    try:
        return _normal(path, log, sets, notes, options)
    except (KeyError, IndexError) as error:
        raise FlightError(
            f"{path}: a message lacks its field {error}: the log is damaged, or of a PX4 version that is not known here"
        ) from None


def _normal(path: Path, log: Any, sets: dict[str, Data], notes: list[str], options: LogOptions) -> Log:
    found = {name: len(sets[name]["timestamp"]) for name in _STREAMS if name in sets and _usable(name, sets)}
    # Several are the rule, and they are one estimator's words: the first in order of worth is the choice.
    stream = choose(path, "odometry", options.topic, found, needs="topic", any_topic=True)
    odometry: Odometry | None = None
    resets: list[tuple[float, str]] = []
    faults: list[str] = []
    if stream is None and "vehicle_local_position" in sets:
        faults.append(
            "vehicle_local_position is there, but the autopilot never held its horizontal position valid"
        )
    if stream == "vehicle_local_position":
        odometry, resets = _local_position(path, sets, notes)
    elif stream is not None:
        odometry, resets = _odometry(path, stream, sets[stream], notes)

    attitude = None
    if "vehicle_attitude" in sets:
        t, wxyz = _attitude(sets["vehicle_attitude"])
        tell_lost(notes, "vehicle_attitude", len(t), len(sets["vehicle_attitude"]["timestamp"]))
        attitude = Orientation(t, unit(f"{path}: vehicle_attitude", wxyz), True, "vehicle_attitude")
    info = log.msg_info_dict
    gnss, used_gnss = _gnss(sets, notes), "vehicle_gps_position" in sets or "sensor_gps" in sets
    if stream in ("vehicle_odometry", "vehicle_local_position"):
        notes.append(
            f"{stream} is the autopilot's own estimate"
            + (", which GNSS goes into: it is no odometry of a flight without GNSS" if used_gnss else "")
        )
    if "estimator_selector_status" in sets and stream in ("vehicle_odometry", "vehicle_local_position"):
        _tell_switches(sets["estimator_selector_status"], notes)
    triggers = next((sets[n]["timestamp"] for n in ("camera_capture", "camera_trigger") if n in sets), None)
    return Log(
        kind="ulog",
        title=f"PX4 ULog, {info.get('ver_hw', 'unknown board')}, {info.get('ver_sw_branch') or info.get('ver_sw', '?')[:8]}",
        clock="seconds since the autopilot's boot",
        odometry=odometry,
        uses_gnss=None if stream is None or stream == "vehicle_visual_odometry" else used_gnss,
        candidates=tuple(found),
        imu=_imu(sets, notes),
        height=_height(log, sets, odometry, notes),
        attitude=attitude,
        gnss=gnss,
        triggers_s=None if triggers is None else _s(triggers),
        lost=tuple((d.timestamp * 1e-6, d.duration * 1e-3) for d in log.dropouts),
        resets=tuple(resets),
        notes=tuple(notes),
        faults=tuple(faults),
    )


def _tell_switches(data: Data, notes: list[str]) -> None:
    # The autopilot's estimate is that of the primary filter at each time; where it changes, reset counters count on.
    primary = np.asarray(data["primary_instance"], dtype=np.int64)
    at = np.flatnonzero(np.diff(primary)) + 1
    if at.size:
        notes.append(
            f"the primary estimator changes {at.size} times, first from {primary[at[0] - 1]} to {primary[at[0]]} at "
            f"{_s(data['timestamp'])[at[0]]:.3f} s"
        )


def _whole_messages(data: bytes) -> tuple[bytes, list[tuple[int, int]]]:
    """The log without what does not lead from one message to the next, and the (start, end) of what was left out.

    One wrong length makes the library pass over all that follows. A message counts where another begins at its end, and,
    of data, where it is as long as others of its topic, or four messages follow. There a way is found again too.
    """

    def follows(at: int) -> bool:
        for _ in range(4):
            if at == len(data):
                return True
            if at + 3 > len(data) or data[at + 2] not in _TYPES:
                return False
            at += 3 + data[at] + 256 * data[at + 1]
        return at <= len(data)

    at, kept, unread = 16, 0, []
    pieces = []
    lengths: dict[bytes, int] = {}
    while at + 3 <= len(data):
        end = at + 3 + data[at] + 256 * data[at + 1]
        topic = data[at + 3 : at + 5] if data[at + 2] == _DATA else b""
        usual = not topic or lengths.get(topic) == end - at
        leads = data[at + 2] in _TYPES and (
            end == len(data) or (end + 2 < len(data) and data[end + 2] in _TYPES)
        )
        if leads and (usual or follows(at)):
            lengths[topic] = end - at
            at = end
            continue
        again = next((q for q in range(at + 1, len(data) - 3) if follows(q)), None)
        if again is None:
            break
        if again != end:
            pieces.append(data[kept:at])
            unread.append((at, again))
            kept = again
        at = again
    return b"".join([*pieces, data[kept:]]), unread


def _cut_short(path: Path) -> bool:
    # Message after message by their lengths: the last must end where the file does.
    data = path.read_bytes()
    at = 16
    while at + 3 <= len(data):
        at += 3 + data[at] + 256 * data[at + 1]
    return at != len(data)


def _s(microseconds: Any) -> FloatArray:
    return np.asarray(microseconds, dtype=np.float64) * 1e-6


def _columns(data: Data, *names: str) -> FloatArray:
    return np.stack([np.asarray(data[n], dtype=np.float64) for n in names], axis=-1)


def _quaternions(data: Data) -> FloatArray:
    return _columns(data, *(f"q[{i}]" for i in range(4)))


def _positions(data: Data) -> FloatArray:
    return _columns(
        data, *(("x", "y", "z") if "x" in data else ("position[0]", "position[1]", "position[2]"))
    )


def _usable(name: str, sets: dict[str, Data]) -> bool:
    if name == "vehicle_local_position":
        return "vehicle_attitude" in sets and bool(np.any(_valid(sets[name])))
    whole = np.isfinite(_positions(sets[name])).all(axis=1) & np.isfinite(_quaternions(sets[name])).all(
        axis=1
    )
    return bool((whole & (np.linalg.norm(_quaternions(sets[name]), axis=1) > 0.5)).any())


def _valid(data: Data) -> Any:
    good = np.isfinite(_positions(data)).all(axis=1)
    return good & (np.asarray(data["xy_valid"]) != 0) if "xy_valid" in data else good


def _segments(
    t: FloatArray, data: Data, keep: Any, counters: tuple[str, ...], what: list[tuple[float, str]]
) -> Any:
    segment = np.zeros(len(t), dtype=np.int64)
    for name in counters:
        if name in data:
            steps = (
                np.diff(
                    np.asarray(data[name])[keep].astype(np.int64), prepend=np.asarray(data[name])[keep][:1]
                )
                != 0
            )
            segment += np.cumsum(steps)
            what += [(float(t[i]), name) for i in np.flatnonzero(steps)]
    what.sort()
    return segment


def _odometry(
    path: Path, name: str, data: Data, notes: list[str]
) -> tuple[Odometry, list[tuple[float, str]]]:
    xyz, q = _positions(data), _quaternions(data)
    t = _s(data["timestamp_sample"] if np.any(data.get("timestamp_sample", 0)) else data["timestamp"])
    keep = np.isfinite(xyz).all(axis=1) & are_turns(q)
    if "pose_frame" in data:  # since 1.14: 0 unknown, 1 NED, 2 FRD
        frame = np.asarray(data["pose_frame"])[keep]
        ned, frd = frame == 1, frame == 2
    else:  # before: 0 NED, 1 FRD, 2 other, 3 body; none at all in the first versions
        frame = (
            np.asarray(data["local_frame"])[keep] if "local_frame" in data else np.zeros(int(keep.sum()), int)
        )
        ned, frd = frame == 0, frame == 1
    if not (ned.all() or frd.all()):
        raise FlightError(
            f"{path}: {name}: its pose frames are {sorted({int(f) for f in frame})}, not NED or FRD throughout: "
            "choose another",
            needs="topic",
        )
    keep[np.flatnonzero(keep)[~in_order(t[keep])]] = False
    t, xyz, q = t[keep], xyz[keep], q[keep]
    resets: list[tuple[float, str]] = []
    segment = _segments(t, data, keep, ("reset_counter",), resets)
    turn = enu_flu_from_ned_frd if ned.all() else flu_flu_from_frd_frd
    xyz = enu_from_ned(xyz) if ned.all() else flu_from_frd(xyz)
    tell_lost(notes, name, len(t), len(keep), "not valid or not in order of time")
    notes.append(f"{name}: pose frame {'NED' if ned.all() else 'FRD (arbitrary heading)'}")
    return Odometry(t, xyz, turn(unit(f"{path}: {name}", q)), name, segment), resets


def _attitude(data: Data) -> tuple[FloatArray, FloatArray]:
    t, q = _s(data["timestamp"]), _quaternions(data)
    keep = are_turns(q)
    keep[np.flatnonzero(keep)[~in_order(t[keep])]] = False
    return t[keep], enu_flu_from_ned_frd(q[keep])


def _local_position(
    path: Path, sets: dict[str, Data], notes: list[str]
) -> tuple[Odometry, list[tuple[float, str]]]:
    data = sets["vehicle_local_position"]
    t = _s(data["timestamp"])
    ta, wxyz = _attitude(sets["vehicle_attitude"])
    keep = _valid(data) & (t >= ta[0]) & (t <= ta[-1])
    keep[np.flatnonzero(keep)[~in_order(t[keep])]] = False
    t, xyz = t[keep], enu_from_ned(_positions(data)[keep])
    if not len(t):
        raise FlightError(f"{path}: vehicle_local_position has no valid position with an attitude beside it")
    tell_lost(notes, "vehicle_local_position", len(t), len(keep), "not valid or not in order of time")
    resets: list[tuple[float, str]] = []
    counters = ("xy_reset_counter", "z_reset_counter", "heading_reset_counter")
    segment = _segments(t, data, keep, counters, resets)
    return Odometry(
        t, xyz, mixed(ta, unit(f"{path}: vehicle_attitude", wxyz), t), "vehicle_local_position", segment
    ), resets


def _imu(sets: dict[str, Data], notes: list[str]) -> Imu | None:
    data = sets.get("sensor_combined")
    if data is None or "gyro_rad[0]" not in data:
        return None
    t = _s(data["timestamp"])
    keep = in_order(t)
    tell_lost(notes, "sensor_combined", int(keep.sum()), len(keep))
    gyro = _columns(data, *(f"gyro_rad[{i}]" for i in range(3)))
    accel = _columns(data, *(f"accelerometer_m_s2[{i}]" for i in range(3)))
    return Imu(t[keep], flu_from_frd(gyro[keep]), flu_from_frd(accel[keep]))


def _looks(data: Data) -> int | None:
    # The orientation of a rangefinder: down where any of its messages says so.
    ways = np.asarray(data.get("orientation", ()), dtype=np.int64)
    return None if not ways.size else DOWN if (ways == DOWN).any() else int(ways[0])


def _height(log: Any, sets: dict[str, Data], odometry: Odometry | None, notes: list[str]) -> Height | None:
    found = sorted((d for d in log.data_list if d.name == "distance_sensor"), key=lambda d: d.multi_id)
    sensors = {
        "distance_sensor" if len(found) == 1 else f"distance_sensor instance {d.multi_id}": d.data
        for d in found
    }
    name = looking_down(notes, {n: _looks(data) for n, data in sensors.items()})
    if name is not None:
        data = sensors[name]
        t, d = _s(data["timestamp"]), np.asarray(data["current_distance"], dtype=np.float64)
        keep = np.isfinite(d) & (d > np.asarray(data.get("min_distance", 0.0))) & in_order(t)
        if "max_distance" in data:
            keep &= d < np.asarray(data["max_distance"])
        if "orientation" in data:
            keep &= np.asarray(data["orientation"]) == DOWN
        if "signal_quality" in data:
            keep &= np.asarray(data["signal_quality"]) != 0
        tell_lost(
            notes, name, int(keep.sum()), len(keep), "out of its range or order, or not of what is below"
        )
        if keep.any():
            told = f", orientation {DOWN}" if len(found) > 1 else ""
            return Height(t[keep], d[keep], "ground", f"{name}{told}")
    data = sets.get("vehicle_local_position")
    if data is not None and np.any(data.get("dist_bottom_valid", 0)):
        t = _s(data["timestamp"])
        keep = (np.asarray(data["dist_bottom_valid"]) != 0) & in_order(t)
        return Height(t[keep], np.asarray(data["dist_bottom"], np.float64)[keep], "ground", "dist_bottom")
    if odometry is not None:
        return Height(odometry.t_s, odometry.xyz_m[:, 2], "take-off", odometry.source)
    return None


def _gnss(sets: dict[str, Data], notes: list[str]) -> Gnss | None:
    data = sets.get("vehicle_gps_position", sets.get("sensor_gps"))
    if data is None:
        return None
    t = _s(data["timestamp"])
    keep = (np.asarray(data["fix_type"]) >= 3) & in_order(t)
    tell_lost(notes, "GNSS", int(keep.sum()), len(keep), "no fix or not in order of time")
    if not keep.any():
        return None
    if "latitude_deg" in data:  # since 1.14
        lat, lon, alt = (
            np.asarray(data[n], np.float64) for n in ("latitude_deg", "longitude_deg", "altitude_msl_m")
        )
    else:
        lat, lon, alt = (
            np.asarray(data[n], np.float64) * s for n, s in (("lat", 1e-7), ("lon", 1e-7), ("alt", 1e-3))
        )
    return Gnss(t[keep], lon[keep], lat[keep], alt[keep], np.asarray(data["eph"], np.float64)[keep])
