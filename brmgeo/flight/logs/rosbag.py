"""ROS bags in: ROS 1 .bag, ROS 2 .mcap and .db3 (or its folder), through rosbags (Apache-2.0).

Times are ``header.stamp``, never the time of recording; the difference of the two is kept, because it tells clocks
that were not set together. Body frames are FLU by REP-103 and taken as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import BrmgeoError, FlightError, MissingInputError
from brmgeo.flight.logs.values import (
    CameraFrames,
    Gnss,
    Height,
    Log,
    LogOptions,
    Orientation,
    choose,
    missing_library,
    ordered,
    unit,
)
from brmgeo.flight.readings import Camera, FloatArray, Imu, Odometry

_ODOMETRY = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
_TF = "tf2_msgs/msg/TFMessage"
_TF1 = "tf/msg/tfMessage"
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_IMU, _FIX, _RANGE, _INFO = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/NavSatFix",
    "sensor_msgs/msg/Range",
    "sensor_msgs/msg/CameraInfo",
)
#: Frames that odometry is told in, by REP-105 and by the habits of VIO packages.
_FIXED_FRAMES = ("odom", "world", "map", "camera_init", "local_origin")
_COLOURS = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2BGR,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
}
_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4} | dict.fromkeys(
    ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), 2
)


@dataclass(slots=True)
class _Stream:
    """Stamps, record times and rows of one topic."""

    stamps: list[float] = field(default_factory=list)
    recorded: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)

    def add(self, stamp: Any, recorded_ns: int, row: list[float]) -> None:
        self.stamps.append(float(stamp.sec) + float(stamp.nanosec) * 1e-9)
        self.recorded.append(recorded_ns * 1e-9)
        self.rows.append(row)

    def table(self, where: str, notes: list[str], width: int) -> tuple[FloatArray, FloatArray]:
        """Times in order and their rows; FlightError when the stamps are empty."""
        t = np.array(self.stamps, dtype=np.float64)
        if t.size > 1 and not t.any():
            raise FlightError(
                f"{where}: every header.stamp is zero: the driver sets no time; stamp the messages first"
            )
        order = ordered(where, t, notes)
        return t[order], np.array(self.rows, dtype=np.float64).reshape(-1, width)[order]


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_library(path, "ROS bags", "rosbags") from None
    if not path.exists():
        raise MissingInputError(f"{path}: the bag is missing")
    place = path
    if path.suffix == ".db3" and (path.parent / "metadata.yaml").is_file():
        place = path.parent
    try:
        with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except BrmgeoError:
        raise
    except Exception as error:  # damaged bytes make the library raise nearly anything
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise FlightError(
            f"{path}: the bag is damaged, cut short or not indexed ({reason}): recover it with 'rosbag reindex' (ROS 1), "
            "'ros2 bag reindex' or 'mcap recover', or record it again"
        ) from None


def _counts(reader: Any, types: tuple[str, ...]) -> dict[str, int]:
    out: dict[str, int] = {}
    for kind in types:
        for c in reader.connections:
            if c.msgtype == kind and c.msgcount:
                out[c.topic] = out.get(c.topic, 0) + c.msgcount
    return out


def _odometry_counts(reader: Any) -> tuple[dict[str, int], dict[str, int]]:
    # Streams of poses, and transforms ("/tf odom>base_link"), which are asked only where there is no pose stream.
    poses: dict[str, int] = {}
    for kind in _ODOMETRY:
        poses |= _counts(reader, (kind,))
    links: dict[str, int] = {}
    connections = [
        c for c in reader.connections if c.msgtype in (_TF, _TF1) and not c.topic.endswith("tf_static")
    ]
    for connection, _, raw in reader.messages(connections=connections) if connections else ():  # [] means all
        for link in reader.deserialize(raw, connection.msgtype).transforms:
            parent, child = link.header.frame_id.strip("/"), link.child_frame_id.strip("/")
            if parent in _FIXED_FRAMES and child not in _FIXED_FRAMES:
                name = f"{connection.topic} {parent}>{child}"
                links[name] = links.get(name, 0) + 1
    return poses, links


def _pose(message: Any) -> list[float]:
    pose = message
    while hasattr(pose, "pose"):  # Odometry and PoseWithCovarianceStamped wrap it twice
        pose = pose.pose
    if hasattr(pose, "transform"):
        p, q = pose.transform.translation, pose.transform.rotation
    else:
        p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.w, q.x, q.y, q.z]


def read_rosbag(path: Path, options: LogOptions | None = None) -> Log:
    """The streams of a ROS bag that a flight needs.

    Raises FlightError when several topics hold odometry or pictures and none is chosen (the message lists them), for
    damaged bags, stamps that jump back, empty quaternions; MissingInputError without the package rosbags.
    """
    options = options or LogOptions()
    more = not options.only_odometry
    notes: list[str] = []
    with _open(path) as reader:
        poses, links = _odometry_counts(reader)
        wanted = options.topic
        pool = (
            poses
            if (wanted is None and poses) or wanted in poses
            else links
            if wanted is None
            else poses | links
        )
        first_kind = _counts(reader, _ODOMETRY[:1])
        if wanted is None and first_kind:
            pool = first_kind  # nav_msgs/Odometry is meant to be odometry; a PoseStamped may be a goal
        topic = choose(path, "odometry", "--topic", wanted, pool, options.any_topic)
        image_topic = choose(
            path,
            "pictures",
            "--image-topic",
            options.image_topic,
            _counts(reader, _IMAGES) if more else {},
            options.any_topic,
        )
        imus = _counts(reader, (_IMU,)) if more else {}
        imu_topic = choose(path, "inertial readings", "--imu-topic", options.imu_topic, imus, True)
        if len(imus) > 1 and options.imu_topic is None:
            notes.append(
                f"{imu_topic} is taken of {len(imus)} inertial streams: {', '.join(imus)} (--imu-topic)"
            )
        fixes = _counts(reader, (_FIX,)) if more else {}
        fix_topic = max(fixes, key=lambda name: fixes[name], default=None)
        range_topic = next(iter(_counts(reader, (_RANGE,)) if more else ()), None)
        infos = list(_counts(reader, (_INFO,)) if more else ())
        info_topic = None
        if image_topic and infos:
            base = image_topic.split("/image")[0]
            info_topic = next(
                (i for i in infos if i.rsplit("/", 1)[0] == base), infos[0] if len(infos) == 1 else None
            )

        streams = {
            name: _Stream() for name in (topic, image_topic, imu_topic, fix_topic, range_topic) if name
        }
        tf = topic.split(" ")[0] if topic and ">" in topic and topic in links else None
        sizes: list[tuple[int, int]] = []
        suffix = ".png"
        camera: Camera | None = None
        frame_ids = ""
        taken = {tf or topic, image_topic, imu_topic, fix_topic, range_topic, info_topic}
        connections = [c for c in reader.connections if c.topic in taken]
        for connection, recorded, raw in reader.messages(connections=connections) if connections else ():
            message = reader.deserialize(raw, connection.msgtype)
            name = connection.topic
            if tf and name == tf:
                for link in message.transforms:
                    assert topic is not None
                    if f"{tf} {link.header.frame_id.strip('/')}>{link.child_frame_id.strip('/')}" == topic:
                        streams[topic].add(link.header.stamp, recorded, _pose(link))
            elif name == topic:
                streams[name].add(message.header.stamp, recorded, _pose(message))
                frame_ids = (
                    frame_ids or f"{message.header.frame_id} > {getattr(message, 'child_frame_id', '?')}"
                )
            elif name == image_topic:
                if not sizes:
                    image, suffix = _picture(path, message)
                    decoded = (
                        image
                        if isinstance(image, np.ndarray)
                        else cv2.imdecode(np.frombuffer(image, np.uint8), -1)
                    )
                    if decoded is None:
                        raise FlightError(f"{path}: {name}: the first picture cannot be decoded")
                    sizes.append((decoded.shape[1], decoded.shape[0]))
                streams[name].add(message.header.stamp, recorded, [len(streams[name].rows)])
            elif name == imu_topic:
                g, a = message.angular_velocity, message.linear_acceleration
                # By the message's definition, -1 says that no orientation is told.
                q, told = message.orientation, float(message.orientation_covariance[0] != -1.0)
                turn = [told * q.w, told * q.x, told * q.y, told * q.z]
                streams[name].add(message.header.stamp, recorded, [g.x, g.y, g.z, a.x, a.y, a.z, *turn])
            elif name == fix_topic and message.status.status >= 0:
                known = message.position_covariance_type > 0
                sigma = float(np.sqrt(max(message.position_covariance[0], 0.0))) if known else np.nan
                row = [message.longitude, message.latitude, message.altitude, sigma]
                streams[name].add(message.header.stamp, recorded, row)
            elif name == range_topic and message.min_range <= message.range <= message.max_range:
                streams[name].add(message.header.stamp, recorded, [message.range])
            elif name == info_topic and camera is None:
                camera = _camera(message)
                if camera is None:
                    notes.append(
                        f"{name}: its distortion model {message.distortion_model!r} or matrix is not used"
                    )
        title = f"ROS {'2' if reader.is2 else '1'} bag, {len({c.topic for c in reader.connections})} topics"
        record_start = reader.start_time * 1e-9

    odometry = attitude = imu = gnss = height = frames = None
    if topic and streams[topic].rows:
        t, rows = streams[topic].table(f"{path}: {topic}", notes, 7)
        odometry = Odometry(t, rows[:, :3], unit(f"{path}: {topic}", rows[:, 3:]), topic)
        if frame_ids:
            notes.append(f"{topic}: frames {frame_ids}")
    if imu_topic and streams[imu_topic].rows:
        t, rows = streams[imu_topic].table(f"{path}: {imu_topic}", notes, 10)
        imu = Imu(t, rows[:, :3], rows[:, 3:6])
        length = np.linalg.norm(rows[:, 6:], axis=1)
        if (np.abs(length - 1.0) < 0.01).all() and not (rows[:, 6:] == [1.0, 0.0, 0.0, 0.0]).all():
            attitude = Orientation(t, rows[:, 6:] / length[:, None], False, imu_topic)
    if fix_topic and streams[fix_topic].rows:
        t, rows = streams[fix_topic].table(f"{path}: {fix_topic}", notes, 4)
        gnss = Gnss(t, rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3])
    if range_topic and streams[range_topic].rows:
        t, rows = streams[range_topic].table(f"{path}: {range_topic}", notes, 1)
        height = Height(t, rows[:, 0], "ground", range_topic)
    if image_topic and streams[image_topic].rows:
        t, rows = streams[image_topic].table(f"{path}: {image_topic}", notes, 1)
        place = {int(row[0]): i for i, row in enumerate(rows)}  # order of recording -> order of time
        frames = CameraFrames(
            t,
            tuple(f"{i:06d}{suffix}" for i in range(len(t))),
            lambda: _pictures(path, str(image_topic), place),
            sizes[0],
            image_topic,
        )
    offsets = tuple(
        (name, float(np.median(np.array(s.stamps) - np.array(s.recorded))))
        for name, s in streams.items()
        if s.rows
    )
    stamp = min((min(s.stamps) for s in streams.values() if s.rows), default=record_start)
    return Log(
        "rosbag",
        title,
        "Unix time (header.stamp)"
        if stamp > 1e8
        else "header.stamp, from the start of a robot or simulation",
        odometry,
        candidates=tuple(poses | links),
        imu=imu,
        height=height,
        attitude=attitude,
        gnss=gnss,
        frames=frames,
        camera=camera,
        stamp_offset_s=offsets,
        notes=tuple(notes),
    )


def _camera(info: Any) -> Camera | None:
    k = [float(v) for v in (info.k if hasattr(info, "k") else info.K)]
    d = [float(v) for v in (info.d if hasattr(info, "d") else info.D)]
    if k[0] <= 0 or info.distortion_model not in ("plumb_bob", "") or len(d) not in (0, 4, 5):
        return None
    k1, k2, p1, p2, k3 = (d + [0.0] * 5)[:5]
    return Camera(int(info.width), int(info.height), k[0], k[4], k[2], k[5], (k1, k2, p1, p2, k3))


def _picture(path: Path, message: Any) -> tuple[bytes | NDArray[np.uint8], str]:
    # A compressed picture stays as it is; a raw one becomes an array.
    data = np.asarray(message.data, dtype=np.uint8)
    if hasattr(message, "format"):
        return data.tobytes(), ".png" if data[:4].tobytes() == b"\x89PNG" else ".jpg"
    encoding = str(message.encoding)
    rows = data.reshape(message.height, message.step)
    if encoding in ("mono16", "16UC1"):
        order = ">u2" if message.is_bigendian else "<u2"
        deep = np.ascontiguousarray(rows[:, : 2 * message.width]).view(order)
        return (deep >> 8).astype(np.uint8), ".png"
    channels = _CHANNELS.get(encoding, 1)
    image = np.ascontiguousarray(rows[:, : channels * message.width])
    if channels > 1:
        image = image.reshape(message.height, message.width, channels)
    if encoding in _COLOURS:
        return np.asarray(cv2.cvtColor(image, _COLOURS[encoding]), dtype=np.uint8), ".png"
    if encoding not in ("mono8", "8UC1", "bgr8", "8UC3"):
        raise FlightError(
            f"{path}: pictures are encoded as {encoding!r}: record mono8, bgr8, rgb8 or compressed ones"
        )
    return image, ".png"


def _pictures(
    path: Path, topic: str, place: dict[int, int]
) -> Iterator[tuple[int, bytes | NDArray[np.uint8]]]:
    with _open(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for i, (connection, _, raw) in enumerate(reader.messages(connections=connections)):
            if i in place:
                yield place[i], _picture(path, reader.deserialize(raw, connection.msgtype))[0]
