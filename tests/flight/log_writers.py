"""One flight, written in every format by the libraries that read it, or by hand after the format's definition."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

N, RATE = 400, 20.0
T = 100.0 + np.arange(N) / RATE
_phase = np.arange(N) / RATE
YAW = 0.6 * np.sin(_phase / 2.0) + 0.8 * np.sin(_phase / 5.1)
ENU_FROM_FLU = Rotation.from_euler(
    "ZYX", np.stack([YAW, 0.05 * np.sin(_phase), 0.08 * np.cos(_phase * 1.3)], -1)
)
XYZ = np.stack([10.0 * _phase, 20.0 * np.sin(_phase / 6.0), 60.0 + np.sin(_phase / 3.0)], -1)
WXYZ = ENU_FROM_FLU.as_quat()[:, [3, 0, 1, 2]]
LON0, LAT0 = 129.35, 36.02
#: Body rates by differences of the attitude, and what an accelerometer says in a smooth flight: mostly gravity.
GYRO = np.gradient(XYZ * 0, axis=0)
GYRO[:-1] = (ENU_FROM_FLU[:-1].inv() * ENU_FROM_FLU[1:]).as_rotvec() * RATE
ACCEL = ENU_FROM_FLU.inv().apply([0.0, 0.0, 9.80665])

# Independent of the code under test: axes are exchanged by matrices and scipy.
NED_FROM_ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
NED_FROM_FRD = NED_FROM_ENU * ENU_FROM_FLU * FRD_FROM_FLU.inv()
NED = NED_FROM_ENU.apply(XYZ)
NED_WXYZ = NED_FROM_FRD.as_quat()[:, [3, 0, 1, 2]]
NED_YPR_DEG = np.degrees(NED_FROM_FRD.as_euler("ZYX"))
GYRO_FRD, ACCEL_FRD = FRD_FROM_FLU.apply(GYRO), FRD_FROM_FLU.apply(ACCEL)
LAT = LAT0 + np.degrees(XYZ[:, 1] / 6.36e6)
LON = LON0 + np.degrees(XYZ[:, 0] / (6.38e6 * np.cos(np.radians(LAT0))))


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    """Largest angle between two lists of w, x, y, z, radians."""
    first, second = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in (a, b))
    return float((first.inv() * second).magnitude().max())


def picture(i: int) -> np.ndarray:
    image = np.full((48, 64, 3), 40, np.uint8)
    cv2.circle(image, (10 + 2 * i, 24), 6, (30 * i % 255, 200, 90), -1)
    return image


# ---------------------------------------------------------------- ROS bags


def bag(
    path: Path,
    kind: str,
    *,
    topics: tuple[str, ...] = ("odom", "imu", "image", "fix", "range", "info"),
    late_s: float = 0.25,
    image_clock_s: float = 0.0,
    imu_scale: tuple[float, float] = (1.0, 1.0),
    imu_late_s: float = 0.0,
    imu_turns: bool | None = None,
    stamps: np.ndarray | None = None,
    twice: bool = False,
    encoding: str = "bgr8",
) -> Path:
    """A bag of ``kind`` ros1, db3 or mcap; messages are recorded ``late_s`` after their stamps."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types = store.types
    stamps = T if stamps is None else stamps

    def make(name: str, **fields: Any) -> Any:
        return types[name](**fields)

    def header(t: float, frame: str) -> Any:
        ns = round(t * 1e9)
        stamp = make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if ros1 else {}))

    def vector(name: str, v: np.ndarray) -> Any:
        return make(f"geometry_msgs/msg/{name}", x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def quaternion(q: np.ndarray) -> Any:
        return make(
            "geometry_msgs/msg/Quaternion", w=float(q[0]), x=float(q[1]), y=float(q[2]), z=float(q[3])
        )

    def pose(i: int) -> Any:
        return make(
            "geometry_msgs/msg/Pose", position=vector("Point", XYZ[i]), orientation=quaternion(WXYZ[i])
        )

    writer: Any
    if ros1:
        path = path.with_suffix(".bag")
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=8, storage_plugin=plugin)
    with writer:
        links: dict[str, Any] = {}

        def send(topic: str, message: Any, t: float) -> None:
            name = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, name, typestore=store)
            raw = store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name)
            writer.write(links[topic], round((t + late_s) * 1e9), raw)

        c36, c9 = np.zeros(36), np.zeros(9)
        for i in range(N):
            t = float(T[i])
            stamp = float(stamps[i])
            if "odom" in topics:
                zero = vector("Vector3", np.zeros(3))
                twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
                message = make(
                    "nav_msgs/msg/Odometry",
                    header=header(stamp, "world"),
                    child_frame_id="body",
                    pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(i), covariance=c36),
                    twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=c36),
                )
                send("/vins/odometry", message, t)
                if twice:
                    send("/other/odometry", message, t)
            if "pose" in topics:
                send(
                    "/pose",
                    make("geometry_msgs/msg/PoseStamped", header=header(stamp, "world"), pose=pose(i)),
                    t,
                )
            if "imu" in topics:
                imu = make(
                    "sensor_msgs/msg/Imu",
                    header=header(stamp + imu_late_s, "imu"),
                    orientation=quaternion(np.array([1.0, 0, 0, 0]) if imu_turns is None else WXYZ[i]),
                    orientation_covariance=c9 if imu_turns is not False else np.r_[-1.0, c9[1:]],
                    angular_velocity=vector("Vector3", GYRO[i] * imu_scale[0]),
                    angular_velocity_covariance=c9,
                    linear_acceleration=vector("Vector3", ACCEL[i] * imu_scale[1]),
                    linear_acceleration_covariance=c9,
                )
                send("/imu/data", imu, t)
            if "fix" in topics and i % 4 == 0:
                status = make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
                cov = np.array([0.64, 0, 0, 0, 0.64, 0, 0, 0, 2.25])
                fix = make(
                    "sensor_msgs/msg/NavSatFix",
                    header=header(stamp, "gps"),
                    status=status,
                    latitude=float(LAT[i]),
                    longitude=float(LON[i]),
                    altitude=float(XYZ[i, 2]),
                    position_covariance=cov,
                    position_covariance_type=2,
                )
                send("/fix", fix, t)
            if "range" in topics and i % 2 == 0:
                more = "variance" in types["sensor_msgs/msg/Range"].__dataclass_fields__
                variance = {"variance": 0.0} if more else {}
                reach = make(
                    "sensor_msgs/msg/Range",
                    header=header(stamp, "down"),
                    radiation_type=1,
                    field_of_view=0.1,
                    min_range=0.2,
                    max_range=200.0,
                    range=float(XYZ[i, 2]),
                    **variance,
                )
                send("/range", reach, t)
            if "image" in topics and i % 20 == 0:
                image = picture(i // 20)
                if encoding == "jpeg":
                    data = cv2.imencode(".jpg", image)[1].ravel()
                    message = make(
                        "sensor_msgs/msg/CompressedImage",
                        header=header(stamp + image_clock_s, "camera"),
                        format="jpeg",
                        data=data,
                    )
                    send("/camera/image_raw/compressed", message, t)
                else:
                    pixels = {
                        "bgr8": image,
                        "rgb8": image[:, :, ::-1],
                        "mono8": cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[:, :, None],
                    }[encoding]
                    message = make(
                        "sensor_msgs/msg/Image",
                        header=header(stamp + image_clock_s, "camera"),
                        height=48,
                        width=64,
                        encoding=encoding,
                        is_bigendian=0,
                        step=64 * pixels.shape[2],
                        data=np.ascontiguousarray(pixels).ravel(),
                    )
                    send("/camera/image_raw", message, t)
                    if "second image" in topics:
                        send("/right/image_raw", message, t)
            if "info" in topics and i == 0:
                small = not ros1
                region = make(
                    "sensor_msgs/msg/RegionOfInterest",
                    x_offset=0,
                    y_offset=0,
                    height=0,
                    width=0,
                    do_rectify=False,
                )
                k, r = np.array([50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1.0]), np.eye(3).ravel()
                matrices = {"d": np.array([0.01, 0, 0, 0, 0]), "k": k, "r": r, "p": np.zeros(12)}
                info = make(
                    "sensor_msgs/msg/CameraInfo",
                    header=header(stamp, "camera"),
                    height=48,
                    width=64,
                    distortion_model="plumb_bob",
                    binning_x=0,
                    binning_y=0,
                    roi=region,
                    **{(n if small else n.upper()): v for n, v in matrices.items()},
                )
                send("/camera/camera_info", info, t)
    return path


# ---------------------------------------------------------------- ULog, after the PX4 developer guide's file format


def ulog(
    path: Path,
    messages: dict[str, tuple[str, list[tuple[Any, ...]]]],
    dropout_ms: int | None = None,
) -> Path:
    """``messages``: name -> (fields "uint64_t timestamp;float x;...", rows of values); "name#1" is a second instance."""
    codes = {
        "uint64_t": "Q",
        "float": "f",
        "double": "d",
        "uint8_t": "B",
        "int32_t": "i",
        "bool": "?",
        "uint32_t": "I",
    }

    def block(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 0)]
    info = b"PX4"
    key = f"char[{len(info)}] sys_name".encode()
    out.append(block("B", bytes(40)))
    out.append(block("I", bytes([len(key)]) + key + info))
    named = [name.partition("#")[::2] for name in messages]
    out += [
        block("F", f"{name}:{fields}".encode())
        for (name, again), (fields, _) in zip(named, messages.values())
        if not again
    ]
    out += [
        block("A", struct.pack("<BH", int(again or 0), i) + name.encode())
        for i, (name, again) in enumerate(named)
    ]
    rows = []
    for i, (fields, values) in enumerate(messages.values()):
        code = "<"
        for one in fields.strip(";").split(";"):
            kind = one.split(" ")[0]
            base, _, count = kind.partition("[")
            code += codes[base] * int(count.strip("]") or 1)
        rows += [(row[0], block("D", struct.pack("<H", i) + struct.pack(code, *row))) for row in values]
    rows.sort(key=lambda r: r[0])
    for i, (_, data) in enumerate(rows):
        if dropout_ms is not None and i == len(rows) // 2:
            out.append(block("O", struct.pack("<H", dropout_ms)))
        out.append(data)
    path.write_bytes(b"".join(out))
    return path


US = np.round(T * 1e6).astype(np.int64)


def px4(path: Path, *, version: str = "local", ahead: bool = False, **options: Any) -> Path:
    """A PX4 log: ``local`` (position + attitude), ``old`` or ``new`` vehicle_odometry, ``vision`` in an FRD frame.

    ``ahead``: the first rangefinder looks forward, the second one down.
    """
    messages: dict[str, tuple[str, list[tuple[Any, ...]]]] = {
        "vehicle_attitude": (
            "uint64_t timestamp;float[4] q;",
            [(int(u), *map(float, q)) for u, q in zip(US, NED_WXYZ)],
        ),
        "sensor_combined": (
            "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
            [(int(u), *map(float, g), *map(float, a)) for u, g, a in zip(US, GYRO_FRD, ACCEL_FRD)],
        ),
        "distance_sensor": (
            "uint64_t timestamp;float min_distance;float max_distance;float current_distance;uint8_t orientation;",
            [(int(u), 0.2, 150.0, float(h), 25) for u, h in zip(US[::4], XYZ[::4, 2])],
        ),
        "camera_trigger": ("uint64_t timestamp;uint32_t seq;", [(int(u), k) for k, u in enumerate(US[::60])]),
    }
    if ahead:
        fields, rows = messages["distance_sensor"]
        messages["distance_sensor"] = fields, [(*row[:3], 12.0, 0) for row in rows]
        messages["distance_sensor#1"] = fields, rows
    if version == "local":
        messages["vehicle_local_position"] = (
            "uint64_t timestamp;float x;float y;float z;bool xy_valid;uint8_t xy_reset_counter;",
            [(int(u), *map(float, p), i > 5, int(i >= 200)) for i, (u, p) in enumerate(zip(US, NED))],
        )
        messages["vehicle_gps_position"] = (
            "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;float eph;uint8_t fix_type;",
            [
                (
                    int(US[i]),
                    round(LAT[i] * 1e7),
                    round(LON[i] * 1e7),
                    round(XYZ[i, 2] * 1e3),
                    0.9,
                    3 if i > 40 else 1,
                )
                for i in range(0, N, 4)
            ],
        )
    if version == "new":
        messages["sensor_gps"] = (
            "uint64_t timestamp;double latitude_deg;double longitude_deg;double altitude_msl_m;float eph;uint8_t fix_type;",
            [(int(US[i]), float(LAT[i]), float(LON[i]), float(XYZ[i, 2]), 0.9, 3) for i in range(0, N, 4)],
        )
        messages["vehicle_odometry"] = (
            "uint64_t timestamp;uint64_t timestamp_sample;uint8_t pose_frame;float[3] position;float[4] q;"
            "uint8_t reset_counter;",
            [
                (int(u) + 3000, int(u), 1, *map(float, p), *map(float, q), int(i >= 200))
                for i, (u, p, q) in enumerate(zip(US, NED, NED_WXYZ))
            ],
        )
    if version == "old":
        messages["vehicle_odometry"] = (
            "uint64_t timestamp;float x;float y;float z;float[4] q;uint8_t local_frame;",
            [(int(u), *map(float, p), *map(float, q), 0) for u, p, q in zip(US, NED, NED_WXYZ)],
        )
    if version == "vision":
        frd = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
        q = (frd * ENU_FROM_FLU * FRD_FROM_FLU.inv()).as_quat()[:, [3, 0, 1, 2]]
        messages["vehicle_visual_odometry"] = (
            "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;",
            [(int(u), 2, *map(float, p), *map(float, r)) for u, p, r in zip(US, frd.apply(XYZ), q)],
        )
    return ulog(path, messages, **options)


# ---------------------------------------------------------------- ArduPilot dataflash and telemetry


def dataflash(
    path: Path,
    *,
    era: str = "TimeUS",
    position: bool = True,
    vision: float | None = None,
    switch: int | None = None,
) -> Path:
    """An ArduPilot .bin: FMT records, then rows in order of time. ``era`` is TimeUS or TimeMS (before 2015).

    ``vision`` times the positions are told as those of a camera, too (NaN: by one that saw nothing).
    ``switch``: from this row on the second core is the primary one, and the first tells nothing of use; the first
    rangefinder then looks forward, the second one down.
    """
    us = era == "TimeUS"
    clock = "Q" if us else "I"
    name = "XKF1" if us else "EKF1"
    old = "Status,TimeMS,Lat,Lng,Alt,T"
    formats: dict[str, tuple[int, str, str]] = {
        "ATT": (130, clock + "fff", f"{era},Roll,Pitch,Yaw"),
        "IMU": (131, clock + "ffffff", f"{era},GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        "RFND": (133, clock + "f", f"{era},Dist"),
        "CAM": (134, clock + "H", f"{era},Img"),
        "GPS": (135, *(("QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt") if us else ("BILLfI", old))),
    }  # fmt: skip
    if switch is not None:
        formats["XKF4"] = (137, "QBB", "TimeUS,C,PI")
        formats["RFND"] = (133, "QBfB", "TimeUS,Instance,Dist,Orient")
    if vision is not None:
        formats["VISP"] = (136, clock + "ffffffB", f"{era},PX,PY,PZ,Roll,Pitch,Yaw,Rst")
    if position:
        formats[name] = (
            132,
            clock + ("B" if us else "") + "ffffff",
            f"{era},{'C,' if us else ''}Roll,Pitch,Yaw,PN,PE,PD",
        )
    sizes = {"B": ("B", 1), "f": ("f", 4), "Q": ("Q", 8), "I": ("I", 4), "H": ("H", 2), "L": ("i", 4)}

    def fmt(kind: int, label: str, code: str, columns: str) -> bytes:
        length = 3 + sum({"n": 4, "N": 16, "Z": 64}.get(c, sizes.get(c, ("", 0))[1]) for c in code)
        body = struct.pack("<BB4s16s64s", kind, length, label.encode(), code.encode(), columns.encode())
        return b"\xa3\x95\x80" + body

    out = [fmt(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    out += [fmt(k, label, code, columns) for label, (k, code, columns) in formats.items()]

    def row(label: str, *values: Any) -> None:
        kind, code, _ = formats[label]
        out.append(
            b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(sizes[c][0] for c in code), *values)
        )

    for i in range(N):
        t = int(US[i]) if us else int(US[i]) // 1000
        y, p, r = (float(v) for v in NED_YPR_DEG[i])
        row("IMU", t, *map(float, GYRO_FRD[i]), *map(float, ACCEL_FRD[i]))
        row("ATT", t, r, p, y % 360.0)
        if vision is not None:
            row("VISP", t, *(float(v) * vision for v in NED[i]), r, p, y % 360.0, int(i >= 200))
        if switch is not None:
            row("XKF4", t, 0, int(i >= switch))
            row("XKF4", t, 1, int(i >= switch))
        if position:
            row(
                name,
                t,
                *([int(switch is not None and i >= switch)] if us else []),
                r,
                p,
                y % 360.0,
                *(map(float, NED[i]) if i > 3 else (0.0, 0.0, 0.0)),
            )
            if us:
                # the other core is not ours
                row(name, t, int(switch is None or i < switch), r, p, y, 9e3, 9e3, 9e3)
        if switch is not None:
            row("RFND", t, 0, 12.0, 0)
            row("RFND", t, 1, float(XYZ[i, 2]), 25)
        elif i % 2 == 0:
            row("RFND", t, float(XYZ[i, 2]))
        if i % 4 == 0:
            place = round(LAT[i] * 1e7), round(LON[i] * 1e7), float(XYZ[i, 2])
            row("GPS", *((t, 3, t // 1000, 2300, *place) if us else (3, 12345, *place, t)))
        if i % 60 == 0:
            row("CAM", t, i // 60)
    path.write_bytes(b"".join(out))
    return path


def as_text(path: Path) -> Path:
    """The .log that a ground station makes of a .bin."""
    from pymavlink import DFReader

    log = DFReader.DFReader_binary(str(path))
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    kinds = [f for f in log.formats.values() if f.name != "FMT"]
    lines += [f"FMT, {f.type}, {f.len}, {f.name}, {f.format}, {','.join(f.columns)}" for f in kinds]
    while (m := log.recv_match()) is not None:
        if m.get_type() != "FMT":
            lines.append(", ".join([m.get_type(), *(repr(getattr(m, c)) for c in m.get_fieldnames())]))
    log.close()
    path.with_suffix(".log").write_text("\n".join(lines) + "\n")
    return path.with_suffix(".log")


def telemetry(path: Path, *, empty: str | None = None) -> Path:
    """A .tlog as a ground station writes it: Unix microseconds, big endian, then the packet.

    ``empty`` names a message whose numbers are all NaN, as of a filter without a position.
    """
    from pymavlink.dialects.v20 import ardupilotmega as mav

    link = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    station = mav.MAVLink(None, srcSystem=255, srcComponent=190)
    out = []

    def send(i: int, message: Any, sender: Any = link) -> None:
        out.append(struct.pack(">Q", 1_700_000_000_000_000 + int(US[i])) + message.pack(sender))

    for i in range(N):
        ms = int(US[i] // 1000)
        y, p, r = (float(v) for v in np.radians(NED_YPR_DEG[i]))
        nan = float("nan")
        turn = (nan, nan, nan) if empty == "attitude" else (r, p, y)
        place = (nan, nan, nan) if empty == "local_position_ned" else tuple(map(float, NED[i]))
        send(i, mav.MAVLink_attitude_message(ms, *turn, 0.0, 0.0, 0.0))
        send(i, mav.MAVLink_local_position_ned_message(ms, *place, 0.0, 0.0, 0.0))
        if empty == "vision_position_estimate":
            send(i, mav.MAVLink_vision_position_estimate_message(int(US[i]), *[nan] * 6))
        g, a = np.round(GYRO_FRD[i] * 1e3).astype(int), np.round(ACCEL_FRD[i] / 9.80665e-3).astype(int)
        send(i, mav.MAVLink_scaled_imu_message(ms, *map(int, a), *map(int, g), 0, 0, 0))
        if i % 4 == 0:
            send(i, mav.MAVLink_distance_sensor_message(ms, 20, 15000, int(XYZ[i, 2] * 100), 0, 0, 25, 0))
            place = round(LAT[i] * 1e7), round(LON[i] * 1e7), round(XYZ[i, 2] * 1e3)
            send(
                i,
                mav.MAVLink_gps_raw_int_message(
                    int(US[i]), 3, *place, 90, 90, 0, 0, 12, 0, 800, 900, 0, 0, 0
                ),
            )
        if i % 20 == 0:
            send(i, mav.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), station)
    path.write_bytes(b"".join(out))
    return path


# ---------------------------------------------------------------- photos


def photo(
    path: Path,
    *,
    time: str = "2024:05:06 10:20:30",
    lat: float | None = LAT0,
    lon: float = LON0,
    alt: float = 160.0,
    xmp: str = "",
    focal: tuple[float, int] | None = (3.61, 20),
    make: str = "DJI",
    size: tuple[int, int] = (80, 60),
    sub: str | None = None,
) -> Path:
    """A geotagged JPEG."""
    from PIL import Image

    image = Image.new("RGB", size, (90, 120, 60))
    exif = Image.Exif()
    exif[271], exif[272] = make, "CAM"
    detail = exif.get_ifd(0x8769)
    detail[36867] = time
    if sub is not None:
        detail[37521] = sub
    if focal is not None:
        detail[37386], detail[41989] = focal
    if lat is not None:
        gps = exif.get_ifd(0x8825)

        def dms(v: float) -> tuple[float, float, float]:
            v = abs(v)
            return float(int(v)), float(int(v * 60 % 60)), v * 3600 % 60

        gps[1], gps[2], gps[3], gps[4] = (
            "N" if lat >= 0 else "S",
            dms(lat),
            "E" if lon >= 0 else "W",
            dms(lon),
        )
        gps[5], gps[6] = b"\x00", alt
    image.save(path, exif=exif, **({"xmp": xmp.encode()} if xmp else {}))
    return path


def dji(gimbal: tuple[float, float, float], relative: float = 60.0, more: str = "") -> str:
    """XMP as DJI writes it; ``gimbal`` is roll, pitch, yaw in degrees."""
    r, p, y = gimbal
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
        f'drone-dji:RelativeAltitude="{relative:+.2f}" drone-dji:GimbalRollDegree="{r:+.2f}" '
        f'drone-dji:GimbalPitchDegree="{p:+.2f}" drone-dji:GimbalYawDegree="{y:+.2f}" {more}/></rdf:RDF></x:xmpmeta>'
    )


def shots_of(folder: Path, count: int, every_s: int = 3, **fields: Any) -> Path:
    """A folder of photos, one every ``every_s`` seconds, on the way north."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        time = f"2024:05:06 10:20:{10 + every_s * i}"
        photo(folder / f"DJI_{i + 1:04d}.JPG", time=time, lat=LAT0 + i * 1e-4, **fields)
    return folder
