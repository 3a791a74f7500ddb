"""ROS bags in: ROS 1 .bag, ROS 2 .mcap and .db3 (or its folder), through rosbags (Apache-2.0).

Times are ``header.stamp``, never the time of recording; the difference of the two is kept, because it tells clocks
that were not set together. Body frames are FLU by REP-103 and taken as they are.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import BrmgeoError, FlightError, InputError, MissingInputError, one_line
from brmgeo.extras import extra
from brmgeo.flight.calibration import bend_of
from brmgeo.flight.logs.values import (
    DOWN,
    CameraFrames,
    Gnss,
    Height,
    Log,
    LogOptions,
    Orientation,
    choose,
    looking_down,
    ordered,
    tell_lost,
    unit,
)
from brmgeo.flight.readings import Camera, FloatArray, Imu, Odometry
from brmgeo.pictures import decode

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


#: Words in the names of rangefinders that look elsewhere -> MAV_SENSOR_ORIENTATION.
_WAYS = {"front": 0, "forward": 0, "right": 2, "back": 4, "rear": 4, "left": 6, "up": 24, "upward": 24}


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
    with extra("logs", "reading ROS bags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
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
        reason = one_line(error, 160)
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
    damaged bags, stamps that jump back, empty quaternions; MissingExtraError without the package rosbags.
    """
    options = options or LogOptions()
    notes: list[str] = []
    with _open(path) as reader:
        topics = _chosen(path, reader, options, notes)
        got = _Gathered(path, topics, notes)
        taken = topics.taken
        connections = [c for c in reader.connections if c.topic in taken]
        read: Counter[str] = Counter()
        for connection, recorded, raw in reader.messages(connections=connections) if connections else ():
            read[connection.topic] += 1
            got.take(connection.topic, reader.deserialize(raw, connection.msgtype), recorded)
        for topic in sorted({c.topic for c in connections}):
            counted = sum(c.msgcount for c in connections if c.topic == topic)
            tell_lost(notes, topic, read[topic], counted, "counted by the bag but not found in it")
        if not options.only_odometry:
            _tell_left(reader, taken, notes)
        title = f"ROS {'2' if reader.is2 else '1'} bag, {len({c.topic for c in reader.connections})} topics"
        record_start = reader.start_time * 1e-9
    return _normal(path, got, title, record_start)


def _tell_left(reader: Any, taken: set[str | None], notes: list[str]) -> None:
    # Topics with messages that nothing was taken of, with their types.
    left: dict[str, int] = {}
    for c in reader.connections:
        if c.topic not in taken and c.msgcount:
            name = f"{c.topic} ({c.msgtype})"
            left[name] = left.get(name, 0) + c.msgcount
    if left:
        told = ", ".join(f"{name}: {count}" for name, count in list(left.items())[:8])
        more = f" and {len(left) - 8} more" if len(left) > 8 else ""
        notes.append(f"{len(left)} topics were not read, with messages: {told}{more}")


@dataclass(frozen=True, slots=True)
class _Topics:
    """Which topic of a bag is taken for what; ``odometry`` may be a link of transforms, "/tf odom>base_link"."""

    odometry: str | None
    image: str | None
    imu: str | None
    fix: str | None
    range: str | None
    info: str | None
    is_link: bool
    candidates: tuple[str, ...]

    @property
    def link_topic(self) -> str | None:
        """The topic of transforms that holds the odometry; None for a topic of poses."""
        return self.odometry.split(" ")[0] if self.odometry and self.is_link else None

    @property
    def taken(self) -> set[str | None]:
        """Every topic to be read."""
        return {
            self.link_topic or self.odometry, self.image, self.imu, self.fix, self.range, self.info
        }  # fmt: skip


def _chosen(path: Path, reader: Any, options: LogOptions, notes: list[str]) -> _Topics:
    more = not options.only_odometry
    poses, links = _odometry_counts(reader)
    wanted = options.topic
    if wanted is None:
        # nav_msgs/Odometry is meant to be odometry; a PoseStamped may be a goal.
        pool = _counts(reader, _ODOMETRY[:1]) or poses or links
    else:
        pool = poses if wanted in poses else poses | links
    any_topic = options.any_topic
    topic = choose(path, "odometry", wanted, pool, needs="topic", any_topic=any_topic)
    pictures = _counts(reader, _IMAGES) if more else {}
    image = choose(path, "pictures", options.image_topic, pictures, needs="image_topic", any_topic=any_topic)
    imus = _counts(reader, (_IMU,)) if more else {}
    imu = choose(path, "inertial readings", options.imu_topic, imus, needs="imu_topic", any_topic=True)
    if len(imus) > 1 and options.imu_topic is None:
        notes.append(f"{imu} is taken of {len(imus)} inertial streams: {', '.join(imus)} (imu_topic)")
    fixes = _counts(reader, (_FIX,)) if more else {}
    infos = list(_counts(reader, (_INFO,)) if more else ())
    info = None
    if image and infos:
        base = image.split("/image")[0]
        info = next((i for i in infos if i.rsplit("/", 1)[0] == base), infos[0] if len(infos) == 1 else None)
    return _Topics(
        odometry=topic,
        image=image,
        imu=imu,
        fix=max(fixes, key=lambda name: fixes[name], default=None),
        range=_range(reader, notes) if more else None,
        info=info,
        is_link=bool(topic and ">" in topic and topic in links),
        candidates=tuple(poses | links),
    )


def _range(reader: Any, notes: list[str]) -> str | None:
    # The rangefinder that looks down, by its topic's and frame's name: a Range tells no direction otherwise.
    frames: dict[str, str] = {}
    connections = [c for c in reader.connections if c.msgtype == _RANGE and c.msgcount]
    for connection, _, raw in reader.messages(connections=connections) if connections else ():
        if connection.topic not in frames:
            message = reader.deserialize(raw, connection.msgtype)
            frames[connection.topic] = f"{connection.topic} {message.header.frame_id}".lower()
            if len(frames) == len({c.topic for c in connections}):
                break
    ways: dict[str, int | None] = {}
    for topic, name in frames.items():
        words = set(re.split(r"[^a-z]+", name))
        down = words & {"down", "downward", "bottom", "ground", "nadir", "height", "altitude", "agl"}
        other = next((way for word, way in _WAYS.items() if word in words), None)
        ways[f"{topic} (frame {name.split(' ')[1]!r})"] = DOWN if down else other
    chosen = looking_down(notes, ways)
    return None if chosen is None else chosen.split(" ")[0]


class _Gathered:
    """What the messages of the chosen topics say, gathered one by one."""

    def __init__(self, path: Path, topics: _Topics, notes: list[str]) -> None:
        self.path, self.topics, self.notes = path, topics, notes
        names = (topics.odometry, topics.image, topics.imu, topics.fix, topics.range)
        self.streams = {name: _Stream() for name in names if name}
        self.size: tuple[int, int] | None = None
        self.suffix = ".png"
        self.camera: Camera | None = None
        self.lens = ""
        self.frame_ids = ""

    def take(self, name: str, message: Any, recorded: int) -> None:
        """One message of the topic ``name``, recorded at so many nanoseconds."""
        topics, tf = self.topics, self.topics.link_topic
        if tf and name == tf:
            for link in message.transforms:
                assert topics.odometry is not None
                if (
                    f"{tf} {link.header.frame_id.strip('/')}>{link.child_frame_id.strip('/')}"
                    == topics.odometry
                ):
                    self.streams[topics.odometry].add(link.header.stamp, recorded, _pose(link))
        elif name == topics.odometry:
            self.streams[name].add(message.header.stamp, recorded, _pose(message))
            ids = f"{message.header.frame_id} > {getattr(message, 'child_frame_id', '?')}"
            self.frame_ids = self.frame_ids or ids
        elif name == topics.image:
            if self.size is None:
                self._first_picture(name, message)
            stream = self.streams[name]
            stream.add(message.header.stamp, recorded, [len(stream.rows)])
        elif name == topics.imu:
            g, a = message.angular_velocity, message.linear_acceleration
            # By the message's definition, -1 says that no orientation is told.
            q, told = message.orientation, float(message.orientation_covariance[0] != -1.0)
            turn = [told * q.w, told * q.x, told * q.y, told * q.z]
            self.streams[name].add(message.header.stamp, recorded, [g.x, g.y, g.z, a.x, a.y, a.z, *turn])
        elif name == topics.fix and message.status.status >= 0:
            known = message.position_covariance_type > 0
            sigma = float(np.sqrt(max(message.position_covariance[0], 0.0))) if known else np.nan
            row = [message.longitude, message.latitude, message.altitude, sigma]
            self.streams[name].add(message.header.stamp, recorded, row)
        elif name == topics.range and message.min_range <= message.range <= message.max_range:
            self.streams[name].add(message.header.stamp, recorded, [message.range])
        elif name == topics.info and self.camera is None and not self.lens:
            try:
                self.camera = _camera(message)
            except FlightError as error:
                self.lens = f"{name}: {error}"
                self.notes.append(self.lens)

    def _first_picture(self, name: str, message: Any) -> None:
        image, self.suffix = _picture(self.path, message)
        if isinstance(image, bytes):
            try:
                image = decode(image, f"{self.path}: {name}")
            except InputError as error:
                raise FlightError(f"{error}; the first picture cannot be decoded") from None
        self.size = image.shape[1], image.shape[0]

    def table(self, name: str | None, width: int) -> tuple[FloatArray, FloatArray] | None:
        """Times in order and their rows (n, width) of a topic; None where it is not taken, or empty."""
        if not name or not self.streams[name].rows:
            return None
        return self.streams[name].table(f"{self.path}: {name}", self.notes, width)


def _normal(path: Path, got: _Gathered, title: str, record_start_s: float) -> Log:
    topics, notes, streams = got.topics, got.notes, got.streams
    odometry = attitude = imu = gnss = height = frames = None
    if (poses := got.table(topics.odometry, 7)) is not None:
        t, rows = poses
        name = str(topics.odometry)
        odometry = Odometry(t, rows[:, :3], unit(f"{path}: {name}", rows[:, 3:]), name)
        if got.frame_ids:
            notes.append(f"{name}: frames {got.frame_ids}")
    if (inertial := got.table(topics.imu, 10)) is not None:
        t, rows = inertial
        imu = Imu(t, rows[:, :3], rows[:, 3:6])
        length = np.linalg.norm(rows[:, 6:], axis=1)
        if (np.abs(length - 1.0) < 0.01).all() and not (rows[:, 6:] == [1.0, 0.0, 0.0, 0.0]).all():
            attitude = Orientation(t, rows[:, 6:] / length[:, None], False, str(topics.imu))
    if (fixes := got.table(topics.fix, 4)) is not None:
        t, rows = fixes
        gnss = Gnss(t, rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3])
    if (ranges := got.table(topics.range, 1)) is not None:
        t, rows = ranges
        height = Height(t, rows[:, 0], "ground", str(topics.range))
    if (shots := got.table(topics.image, 1)) is not None:
        t, rows = shots
        place = {int(row[0]): i for i, row in enumerate(rows)}  # order of recording -> order of time
        names = tuple(f"{i:06d}{got.suffix}" for i in range(len(t)))
        topic = str(topics.image)
        assert got.size is not None
        frames = CameraFrames(t, names, lambda: _pictures(path, topic, place), got.size, topic)
    offsets = tuple(
        (name, float(np.median(np.array(s.stamps) - np.array(s.recorded))))
        for name, s in streams.items()
        if s.rows
    )
    stamp = min((min(s.stamps) for s in streams.values() if s.rows), default=record_start_s)
    clock = (
        "Unix time (header.stamp)" if stamp > 1e8 else "header.stamp, from the start of a robot or simulation"
    )
    return Log(
        kind="rosbag",
        title=title,
        clock=clock,
        odometry=odometry,
        candidates=topics.candidates,
        imu=imu,
        height=height,
        attitude=attitude,
        gnss=gnss,
        frames=frames,
        camera=got.camera,
        lens=got.lens,
        stamp_offset_s=offsets,
        notes=tuple(notes),
    )


def _camera(info: Any) -> Camera:
    k = [float(v) for v in (info.k if hasattr(info, "k") else info.K)]
    if k[0] <= 0:
        raise FlightError(
            "its camera is not calibrated (the matrix is zero): give the camera or its field of view"
        )
    bend = bend_of(str(info.distortion_model), info.d if hasattr(info, "d") else info.D)
    return Camera(int(info.width), int(info.height), k[0], k[4], k[2], k[5], bend)


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
