"""Reads a flight folder (docs/FLIGHT.md), and refuses what it does not understand.

Everything small is read and checked at once, images and masks by their headers; pixels are read on demand. The
reference is read only when it is asked for, by name, so nothing that estimates can see it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from brmgeo.codes import LABEL_BUILDING, LABEL_OTHER
from brmgeo.errors import BrmgeoError, CrsError, FlightError, InputError, listed
from brmgeo.files import digest, json_of, read_json
from brmgeo.flight.camera import border_pixels, ray_from_pixel
from brmgeo.flight.frames import Axes
from brmgeo.flight.odometry import OdometryOptions, read_odometry
from brmgeo.flight.poses import AXES_UNTOLD
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Frame, Imu, Odometry, Reference
from brmgeo.flight.tables import Table, read_table, read_times, refuse
from brmgeo.flight.video import Video
from brmgeo.geo.crs import LONLAT, convergence_rad, crs_name, parse_crs, transformer
from brmgeo.pictures import decode, read_bytes
from brmgeo.settings import nearest, read_toml

MIN_AGL_M, MAX_AGL_M = 1.0, 5000.0
MAX_ALTIMETER_GAP_S = 5.0
#: More than this between the body's z axis and up, in the middle of a flight, is another frame, not an attitude.
MAX_MEDIAN_TILT_DEG = 60.0

#: What the odometry.json of a track says that was made from the flight's own frames.
MADE_BY = "brmgeo odometry"
#: What the first line of a simulated flight's flight.toml said before there was a key for it.
_OLD_NOTE = "# Simulated by brmgeo"

_MOUNT = ("roll_deg", "pitch_deg", "yaw_deg")
_TOP: dict[str, type] = {"name": str, "simulated": bool}
_KEYS: dict[str, dict[str, type]] = {
    "camera": {"width": int, "height": int, "distortion": list}
    | dict.fromkeys(("fov_deg", "fx", "fy", "cx", "cy"), float),
    "mount": dict.fromkeys((*_MOUNT, "sigma_deg"), float),
    "frames": {"video": str, "start_s": float},
    "odometry": dict.fromkeys(("file", "format", "quaternion", "axes", "topic", "times", "covariance"), str),
    "height": {"source": str, "fixed_m": float},
    "altimeter": {"file": str, "datum": str, "ground_m": float},
    "reference": {"file": str, "crs": str},
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight, checked.

    Where its frames are a video, ``image`` opens it and keeps it open for the next frame: it is closed with the last frame,
    by ``close``, or at the end of ``with read_flight(...) as flight``.

    Attributes:
        folder: where it lies.
        name: as its flight.toml says.
        camera, mount: the camera and how it sits in the body.
        frames: in order of time, with height above ground.
        odometry: the track, or None.
        has_masks: masks/ holds a mask of every frame.
        has_images: the frames' pictures are there (a masks-only flight has none).
        simulated: nobody flew it: flight.toml says so, in its key or, in older folders, in its first comment. A comment
            is no leave to replace the folder: see ``may_be_remade``.
        axes_told: how the axes of the odometry lie is told, by its format or by flight.toml.
        mount_sigma_rad: how well the mount's roll and pitch are known, standard deviation, radians.
    """

    folder: Path
    name: str
    camera: Camera
    mount: Attitude
    frames: tuple[Frame, ...]
    odometry: Odometry | None
    has_masks: bool
    has_images: bool
    simulated: bool = False
    axes_told: bool = True
    mount_sigma_rad: float = 0.0
    _video: Video | None = None
    _video_start_s: float = 0.0
    _reference: tuple[Path, str | None] | None = None

    @property
    def times_s(self) -> FloatArray:
        """(n,) float64 times of the frames."""
        return np.array([frame.t_s for frame in self.frames])

    def image(self, index: int) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 RGB of a frame; FlightError when it cannot be decoded or has another size."""
        frame = self.frames[index]
        if self._video is not None:
            return self._video_image(self._video, index)
        if not self.has_images:
            raise FlightError(
                f"{self.folder / 'frames'}: {frame.file} is asked for, but this flight has masks only"
            )
        path = self.folder / "frames" / frame.file
        image = _decoded(path, cv2.IMREAD_COLOR)
        _check_size(path, (image.shape[1], image.shape[0]), self.camera)
        return image.astype(np.uint8, copy=False)

    def mask(self, index: int) -> NDArray[np.uint8]:
        """(height, width) uint8 building mask of a frame: 0 other, 255 building.

        Raises FlightError when there is none, it cannot be decoded, has another size or other values.
        """
        path = self.folder / "masks" / _mask_name(self.frames[index].file)
        if not self.has_masks:
            raise FlightError(f"{path}: a mask is asked for, but this flight has no masks")
        image = _decoded(path, cv2.IMREAD_UNCHANGED)
        if image.ndim == 3:
            if not (image[:, :, :3] == image[:, :, :1]).all():
                raise FlightError(f"{path}: the mask is in colour: 0 is other, 255 is building, nothing else")
            image = image[:, :, 0]
        _check_size(path, (image.shape[1], image.shape[0]), self.camera)
        if fault := mask_fault(image):
            raise FlightError(f"{path}: {fault}")
        return np.asarray(image, dtype=np.uint8)

    def compass_yaw_rad(self, crs: str, x: float, y: float) -> list[float | None]:
        """Yaw of the nose in the map frame from each frame's compass, radians; None where there is no compass.

        Args:
            crs: the map's CRS.
            x, y: about where the flight is: grid convergence is taken there.
        """
        convergence = convergence_rad(crs, x, y)
        return [
            None
            if frame.true_heading_deg is None
            else math.remainder(math.pi / 2 - math.radians(frame.true_heading_deg) + convergence, 2 * math.pi)
            for frame in self.frames
        ]

    def imu(self) -> Imu | None:
        """Inertial readings of imu.csv, or None when there is no such file."""
        path = self.folder / "imu.csv"
        if not path.exists():
            return None
        table = read_table(path, [("t_s", "gx", "gy", "gz", "ax", "ay", "az")])
        table.check_times()
        return Imu(table.numbers["t_s"], table.stack("gx", "gy", "gz"), table.stack("ax", "ay", "az"))

    def reference(self, crs: str) -> Reference | None:
        """Where the aircraft really was, in the map's ``crs``; None when the flight has no reference. For scores only.

        Raises FlightError for coordinates outside their CRS's range or area of use, and for another flight's times.
        """
        if self._reference is None:
            return None
        path, stated = self._reference
        table = read_table(path, [("t_s", "lon", "lat"), ("t_s", "x", "y")], ["alt_m", "sigma_m"])
        table.check_times()
        geographic = "lon" in table.numbers
        names = ("lon", "lat") if geographic else ("x", "y")
        if "lon" in table.numbers and ("x" in table.numbers or "y" in table.numbers):
            raise refuse(path, 1, None, "both lon, lat and x, y are there: keep one pair")
        if stated is None and not geographic:
            raise refuse(path, 1, None, 'x, y need a CRS: add crs = "EPSG:..." to [reference] in flight.toml')
        source = stated or LONLAT
        try:
            parsed = parse_crs(source)
        except CrsError as error:
            raise refuse(self.folder / "flight.toml", None, None, f"[reference] {error}") from None
        if geographic and not parsed.is_geographic:
            raise refuse(
                path, 1, None, f"columns lon, lat, but [reference] crs is {crs_name(source)}: name them x, y"
            )
        if not geographic and not parsed.is_projected:
            raise refuse(
                path, 1, None, f"columns x, y, but [reference] crs is {crs_name(source)}: name them lon, lat"
            )
        if geographic:
            table.check_range("lon", -180.0, 180.0, "is it x of a projected CRS, or are columns swapped?")
            table.check_range("lat", -90.0, 90.0, "is it y of a projected CRS, or are columns swapped?")
        _check_area(path, table, names, source)
        x, y = transformer(source, crs).transform(table.numbers[names[0]], table.numbers[names[1]])
        xy = np.stack([np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)], axis=-1)
        lost = np.flatnonzero(~np.isfinite(xy).all(axis=1))
        if lost.size:
            raise refuse(
                path, table.lines[int(lost[0])], names[0], f"the point has no place in {crs_name(crs)}"
            )
        _check_overlap(path, "reference", table.numbers["t_s"], self.times_s)
        return Reference(table.numbers["t_s"], xy, table.numbers.get("alt_m"), table.numbers.get("sigma_m"))

    def close(self) -> None:
        """Lets go of the video, where there is one; the next picture opens it again."""
        if self._video is not None:
            self._video.close()

    def __enter__(self) -> Flight:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _video_image(self, video: Video, index: int) -> NDArray[np.uint8]:
        frame = self.frames[index]
        at_s = frame.t_s - self._video_start_s
        image = video.image(round(at_s * video.rate_hz))
        if index == len(self.frames) - 1:
            video.close()
        if image is None:
            raise FlightError(
                f"{video.path}: no frame at {at_s:.3f} s ({frame.file}): check t_s in frames.csv, "
                "or give the time at which the video begins as start_s in [frames]"
            )
        _check_size(video.path, (image.shape[1], image.shape[0]), self.camera)
        return image


def mask_fault(mask: NDArray[Any]) -> str:
    """What is wrong with the values of a (height, width) mask of whole numbers; empty where nothing is."""
    other = (mask != LABEL_OTHER) & (mask != LABEL_BUILDING)
    if not other.any():
        return ""
    row, column = np.argwhere(other)[0]
    return (
        f"pixel (row {row}, column {column}) is {mask[row, column]}: {LABEL_OTHER} is other, {LABEL_BUILDING} is building, "
        "nothing else"
    )


def read_flight(folder: Path | str, *, with_odometry: bool = True) -> Flight:
    """The flight in a folder.

    Args:
        folder: where flight.toml and frames.csv lie.
        with_odometry: False leaves the odometry out, whatever state it is in.

    Raises FlightError, with file, line and column, at the first thing that is not as it should be.
    """
    folder = Path(folder)
    toml = _FlightToml(folder / "flight.toml")
    camera = _camera(toml)
    mount = Attitude(*(math.radians(toml.number("mount", k, 0.0, -360, 360)) for k in _MOUNT))

    table = read_table(
        folder / "frames.csv", [("t_s", "file")], ["agl_m", "roll_deg", "pitch_deg", "yaw_deg"], ["file"]
    )
    frames = _frames(toml, folder, table)
    times = np.array([frame.t_s for frame in frames])

    video = None
    if toml.has("frames", "video"):
        video = Video(folder / toml.text("frames", "video"))
        has_images = True
    else:
        has_images = _check_files(
            folder / "frames", [f.file for f in frames], table, camera, optional=(folder / "masks").is_dir()
        )
    masks = [_mask_name(f.file) for f in frames]
    if len(set(masks)) != len(masks):
        raise refuse(
            table.path,
            None,
            "file",
            "two frames' names differ only in their ending, so their masks would be one",
        )
    has_masks = (folder / "masks").is_dir() and _check_files(
        folder / "masks", masks, table, camera, optional=False
    )

    simulated = bool(toml.data.get("simulated", "\n".join(toml.lines).startswith(_OLD_NOTE)))
    odometry = _odometry(toml, folder, mount, frames, times) if with_odometry else None
    told = toml.section("odometry") if "odometry" in toml.data else {}
    reference = _reference(toml, folder)
    return Flight(
        folder,
        toml.text("", "name") if toml.has("", "name") else os.path.basename(os.path.realpath(folder)),
        camera,
        mount,
        frames,
        odometry,
        has_masks,
        has_images,
        simulated=simulated,
        axes_told=simulated
        or "axes" in told
        or told.get("format") not in AXES_UNTOLD
        or is_own_odometry(folder),
        mount_sigma_rad=math.radians(toml.number("mount", "sigma_deg", 0.0, 0.0, 11.0)),
        _video=video,
        _video_start_s=toml.number("frames", "start_s", 0.0),
        _reference=reference,
    )


def may_be_remade(folder: Path) -> bool:
    """True where flight.toml has ``simulated = true``: brmgeo made the flight, and nothing is lost with it.

    A flight that only a comment calls simulated may be a real one, written over a copied file.
    """
    try:
        return read_toml(folder / "flight.toml").data.get("simulated") is True
    except BrmgeoError:
        return False


# ---------------------------------------------------------------- flight.toml


class _FlightToml:
    """flight.toml with typed, located access to its keys."""

    def __init__(self, path: Path) -> None:
        if not path.parent.is_dir():
            raise FlightError(
                f"{path.parent}: no such folder: a flight is a folder with flight.toml and frames.csv"
            )
        self.path = path
        self._toml = read_toml(path, error=FlightError, missing=FlightError)
        self.data, self.lines = self._toml.data, self._toml.lines
        for key, value in self.data.items():
            if key in _TOP:
                self._typed("", key, value, _TOP[key])
            elif key not in _KEYS:
                raise self.refuse("", key, f"unknown key {key!r}: {nearest(key, [*_TOP, *_KEYS])}")
            elif not isinstance(value, dict):
                raise self.refuse("", key, f"{key!r} must be a section: [{key}]")
            else:
                for inner, cell in value.items():
                    if inner not in _KEYS[key]:
                        raise self.refuse(
                            key,
                            inner,
                            f"unknown key {inner!r} in [{key}]: {nearest(inner, list(_KEYS[key]))}",
                        )
                    self._typed(key, inner, cell, _KEYS[key][inner])

    def _typed(self, section: str, key: str, value: Any, kind: type) -> None:
        good = isinstance(value, kind) or (kind is float and isinstance(value, int))
        if kind in (int, float) and (isinstance(value, bool) or (good and not math.isfinite(value))):
            good = False
        if not good:
            words = {
                int: "a whole number",
                float: "a finite number",
                str: "a text in quotes",
                list: "a list",
                bool: "true or false",
            }
            raise self.refuse(section, key, f"{key!r} is {value!r}: it must be {words[kind]}")

    def refuse(self, section: str, key: str, message: str) -> FlightError:
        """The error at a key, or at its section where it is missing."""
        return refuse(self.path, *self._toml.where(*([section] if section else []), key), message)

    def section(self, section: str) -> dict[str, Any]:
        found: dict[str, Any] = self.data.get(section, {}) if section else self.data
        return found

    def has(self, section: str, key: str) -> bool:
        return key in self.section(section)

    def text(self, section: str, key: str) -> str:
        if not self.has(section, key):
            raise self.refuse(section, key, f"[{section}] has no {key!r}: add it")
        value = str(self.section(section)[key])
        if not value.strip():
            raise self.refuse(section, key, f"{key!r} is empty")
        return value

    def number(
        self,
        section: str,
        key: str,
        default: float | None = None,
        low: float = -math.inf,
        high: float = math.inf,
    ) -> float:
        if not self.has(section, key):
            if default is None:
                raise self.refuse(section, key, f"[{section}] has no {key!r}: add it")
            return default
        value = float(self.section(section)[key])
        if not low <= value <= high:
            raise self.refuse(section, key, f"{key!r} is {value:g}: it must be within {low:g} to {high:g}")
        return value


def _camera(toml: _FlightToml) -> Camera:
    width = int(toml.number("camera", "width", None, 8, 30000))
    height = int(toml.number("camera", "height", None, 8, 30000))
    intrinsics = [key for key in ("fx", "fy", "cx", "cy", "distortion") if toml.has("camera", key)]
    if toml.has("camera", "fov_deg"):
        if intrinsics:
            raise toml.refuse(
                "camera", intrinsics[0], f"both fov_deg and {intrinsics[0]} are given: keep one kind"
            )
        return Camera.from_fov(width, height, toml.number("camera", "fov_deg", None, 0.1, 179.0))
    if not intrinsics:
        raise toml.refuse(
            "camera", "fov_deg", "[camera] has neither fov_deg nor fx, fy, cx, cy: add one kind"
        )
    fx, fy = (toml.number("camera", key, None, 1.0, 1e6) for key in ("fx", "fy"))
    cx = toml.number("camera", "cx", None, -width, 2.0 * width)
    cy = toml.number("camera", "cy", None, -height, 2.0 * height)
    bend = toml.section("camera").get("distortion", [0.0] * 5)
    numbers = [v for v in bend if isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)]
    if len(bend) != 5 or len(numbers) != 5:
        raise toml.refuse(
            "camera", "distortion", f"distortion is {bend!r}: it must be five numbers [k1, k2, p1, p2, k3]"
        )
    k1, k2, p1, p2, k3 = (float(v) for v in bend)
    camera = Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
    # The radial part must grow up to the farthest corner, or several rays would fall on one pixel.
    corner = math.hypot(max(cx + 0.5, width - 0.5 - cx) / fx, max(cy + 0.5, height - 0.5 - cy) / fy)
    r = np.linspace(0.0, 4.0 * corner, 4001)
    bent = r * (1.0 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))
    falling = np.flatnonzero(np.diff(bent) <= 0)
    if bent[falling[0] if falling.size else -1] < corner:
        raise toml.refuse(
            "camera",
            "distortion",
            "these coefficients fold the image over itself before its corner: check them",
        )
    # The tangential part may fold it as well: every pixel, to the edge, must have one ray.
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 17))
    pixels = np.concatenate([np.stack([u.ravel(), v.ravel()], axis=-1), border_pixels(camera)])
    try:
        with np.errstate(all="ignore"):
            ray_from_pixel(camera, pixels)
    except ValueError:
        raise toml.refuse(
            "camera",
            "distortion",
            "these coefficients fold the image over itself: check them, p1 and p2 above all",
        ) from None
    return camera


def _frames(toml: _FlightToml, folder: Path, table: Table) -> tuple[Frame, ...]:
    path = table.path
    table.check_times()
    seen: dict[str, int] = {}
    for name, line in zip(table.texts["file"], table.lines):
        parts = PurePosixPath(name).parts
        if not name or "\\" in name or ".." in parts or PurePosixPath(name).is_absolute():
            raise refuse(path, line, "file", f"{name!r} is not the name of a file in frames/")
        if name in seen:
            raise refuse(path, line, "file", f"{name!r} is already in line {seen[name]}: each frame once")
        seen[name] = line
    if ("roll_deg" in table.numbers) != ("pitch_deg" in table.numbers):
        raise refuse(path, 1, None, "roll_deg and pitch_deg go together: give both or neither")
    for name in ("roll_deg", "pitch_deg"):
        if name in table.numbers:
            table.check_range(name, -90.0, 90.0, "degrees are wanted, and no view is level upside down")
    if "yaw_deg" in table.numbers:
        table.check_range("yaw_deg", -360.0, 360.0, "a heading in degrees is wanted")

    agl = _heights(toml, folder, table)
    n = len(table)
    zero = np.zeros(n)
    roll, pitch = (np.radians(table.numbers.get(key, zero)) for key in ("roll_deg", "pitch_deg"))
    yaw = table.numbers.get("yaw_deg")
    return tuple(
        Frame(
            float(table.numbers["t_s"][i]),
            table.texts["file"][i],
            float(agl[i]),
            float(roll[i]),
            float(pitch[i]),
            None if yaw is None else float(yaw[i]) % 360.0,
        )
        for i in range(n)
    )


def _heights(toml: _FlightToml, folder: Path, table: Table) -> FloatArray:
    times = table.numbers["t_s"]
    sources = ("frames", "altimeter", "fixed")
    source = toml.text("height", "source") if toml.has("height", "source") else None
    if source is None and "agl_m" not in table.numbers:
        raise toml.refuse("height", "source", f"no height: give source in [height] ({', '.join(sources)})")
    if source in (None, "frames"):
        if "agl_m" not in table.numbers:
            raise refuse(
                table.path,
                1,
                None,
                'no column agl_m, but [height] source is "frames": add it or choose another',
            )
        table.check_range("agl_m", MIN_AGL_M, MAX_AGL_M, "metres above ground are wanted")
        return table.numbers["agl_m"]
    if source == "fixed":
        return np.full(len(times), toml.number("height", "fixed_m", None, MIN_AGL_M, MAX_AGL_M))
    if source != "altimeter":
        raise toml.refuse("height", "source", f"source is {source!r}: {nearest(str(source), sources)}")

    path = folder / (toml.text("altimeter", "file") if toml.has("altimeter", "file") else "altimeter.csv")
    log = read_table(path, [("t_s", "agl_m"), ("t_s", "alt_m")])
    log.check_times()
    if "agl_m" in log.numbers:
        log.check_range("agl_m", MIN_AGL_M, MAX_AGL_M, "metres above ground are wanted")
        heights = log.numbers["agl_m"]
    else:
        if not toml.has("altimeter", "ground_m") or not toml.has("altimeter", "datum"):
            raise toml.refuse(
                "altimeter",
                "ground_m",
                f"{path.name} has altitudes: give datum and ground_m (the ground above it) in [altimeter]",
            )
        heights = log.numbers["alt_m"] - toml.number("altimeter", "ground_m")
        low = np.flatnonzero((heights < MIN_AGL_M) | (heights > MAX_AGL_M))
        if low.size:
            i = int(low[0])
            raise refuse(
                path,
                log.lines[i],
                "alt_m",
                f"{heights[i]:g} m above ground is not within {MIN_AGL_M:g} to {MAX_AGL_M:g}: check ground_m",
            )
    t = log.numbers["t_s"]
    after = np.searchsorted(t, times, side="left").clip(0, len(t) - 1)
    before = (np.searchsorted(t, times, side="right") - 1).clip(0, len(t) - 1)
    blind = (times < t[0]) | (times > t[-1]) | (t[after] - t[before] > MAX_ALTIMETER_GAP_S)
    if blind.any():
        i = int(np.flatnonzero(blind)[0])
        raise refuse(
            table.path,
            table.lines[i],
            "t_s",
            f"{path.name} has no height at {times[i]:.3f} s (it covers {t[0]:.3f} to {t[-1]:.3f} s, gaps up to "
            f"{MAX_ALTIMETER_GAP_S:g} s are bridged): remove the frame or give another [height] source",
        )
    return np.interp(times, t, heights)


# ---------------------------------------------------------------- files


def _mask_name(file: str) -> str:
    return str(PurePosixPath(file).with_suffix(".png"))


def _check_size(path: Path, size: tuple[int, int], camera: Camera) -> None:
    if size != (camera.width, camera.height):
        raise FlightError(
            f"{path}: {size[0]} x {size[1]} pixels, but [camera] in flight.toml says {camera.width} x {camera.height}"
        )


def _decoded(path: Path, flags: int) -> NDArray[Any]:
    # The sensor's own rows and columns: an EXIF turn would swap them under the calibration.
    try:
        return decode(read_bytes(path), str(path), flags=flags)
    except InputError as error:
        raise FlightError(f"{error}, or remove its row from frames.csv") from None


def _check_files(folder: Path, names: Sequence[str], table: Table, camera: Camera, *, optional: bool) -> bool:
    # All there: True. None there and that is allowed: False.
    missing = [i for i, name in enumerate(names) if not (folder / name).is_file()]
    if optional and len(missing) == len(names):
        return False
    if missing:
        i = missing[0]
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise refuse(
            table.path,
            table.lines[i],
            "file",
            f"{folder / names[i]} is missing{more}: add it or remove the row",
        )
    for name in names:
        try:
            with Image.open(folder / name) as image:
                _check_size(folder / name, image.size, camera)
        except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError):
            raise FlightError(
                f"{folder / name}: no readable image: copy it again or remove its row from frames.csv"
            ) from None
    return True


# ---------------------------------------------------------------- odometry and reference


def _odometry(
    toml: _FlightToml,
    folder: Path,
    mount: Attitude,
    frames: tuple[Frame, ...],
    times: FloatArray,
) -> Odometry | None:
    if "odometry" not in toml.data:
        stray = sorted(folder.glob("odometry.*"))
        # `brmgeo odometry` names its track in flight.toml last: a run that was killed before leaves files of its own.
        if stray and not is_own_odometry(folder):
            raise refuse(
                toml.path,
                None,
                None,
                f"{stray[0].name} is there, but no [odometry] section says its format: add file and format",
            )
        return None
    path = folder / toml.text("odometry", "file")
    format_name = toml.text("odometry", "format")
    order = toml.section("odometry").get("quaternion")
    if order not in (None, "xyzw", "wxyz"):
        raise toml.refuse("odometry", "quaternion", f"quaternion is {order!r}: it must be 'xyzw' or 'wxyz'")
    topic = toml.text("odometry", "topic") if toml.has("odometry", "topic") else None
    axes = toml.section("odometry").get("axes")
    if axes is not None and (axes not in get_args(Axes) or format_name not in AXES_UNTOLD):
        known = listed(get_args(Axes)) if format_name in AXES_UNTOLD else "left out: the format has its own"
        raise toml.refuse("odometry", "axes", f"axes is {axes!r}: for {format_name} it must be {known}")
    body = mount.body_from_camera()
    told = None
    if toml.has("odometry", "times"):
        if format_name != "kitti":
            raise toml.refuse(
                "odometry", "times", f"times are given, but {format_name} has its own: remove 'times'"
            )
        told = read_times(folder / toml.text("odometry", "times"))
    first = frames[0 if told is None else int(np.abs(times - told[0]).argmin())]
    level = Attitude(first.roll_rad, first.pitch_rad).matrix() @ body
    options = OdometryOptions(
        order, times if told is None else told, level, body, topic, told is not None, axes
    )
    odometry = read_odometry(path, format_name, options)
    if toml.has("odometry", "covariance"):
        odometry = _covariance(folder / toml.text("odometry", "covariance"), odometry)
    _check_overlap(path, "odometry", odometry.t_s, times)
    _, x, y, _ = odometry.wxyz.T
    tilt = float(np.median(np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))))
    if tilt > MAX_MEDIAN_TILT_DEG:
        raise FlightError(
            f"{path}: the orientations tilt the body by {tilt:.0f} degrees (median), so they are not those of an upright "
            "body (x nose, y left, z up) in a frame with z up: check quaternion (xyzw or wxyz) in [odometry], or turn them"
        )
    return odometry


def is_own_odometry(folder: Path) -> bool:
    """True where odometry.json says that ``brmgeo odometry`` makes, or made, the flight's odometry from its frames."""
    return own_method(folder) is not None


def own_method(folder: Path) -> str | None:
    """How odometry.json says that the flight's odometry was made from its frames; None where it was not."""
    try:
        facts = json_of((folder / "odometry.json").read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(facts, dict) or facts.get("made_by") != MADE_BY:
        return None
    return str(facts.get("method", "unknown"))


def _covariance(path: Path, odometry: Odometry) -> Odometry:
    # What `brmgeo odometry` writes beside its track: one row a pose.
    table = read_table(path, [("t_s", "walk_m2")], ["segment", "yaw_sigma_deg", "tracks", "blind"])
    table.check_times()
    times = table.numbers["t_s"]
    if len(times) != len(odometry.t_s) or np.abs(times - odometry.t_s).max(initial=0.0) > 1e-3:
        raise refuse(
            path,
            None,
            None,
            f"{len(times)} rows that do not belong to the {len(odometry.t_s)} poses of {odometry.source}: "
            "make both together, or remove 'covariance' from [odometry]",
        )
    facts = read_json(path.with_name("odometry.json"))
    made = facts.get("sha256") if isinstance(facts, dict) else None
    track = path.with_name(odometry.source)
    # What a run leaves that was killed between the two.
    if (
        isinstance(made, dict)
        and track.is_file()
        and made.get(track.name) == digest(track)
        and made.get(path.name) != digest(path)
    ):
        raise refuse(
            path,
            None,
            None,
            f"is of another run than {track.name}: make both together again, or remove 'covariance'",
        )
    walk = table.numbers["walk_m2"]
    falling = np.flatnonzero(np.diff(walk, prepend=0.0) < 0.0)
    if falling.size:
        raise refuse(
            path, table.lines[int(falling[0])], "walk_m2", "the gathered variance falls: it can only grow"
        )
    segment = table.numbers.get("segment")
    return replace(
        odometry, walk_m2=walk, segment=odometry.segment if segment is None else segment.astype(np.int64)
    )


def _check_overlap(path: Path, what: str, t: FloatArray, times: FloatArray) -> None:
    if t[-1] < times[0] or t[0] > times[-1]:
        raise FlightError(
            f"{path}: {what} of another flight: it covers {t[0]:.3f} to {t[-1]:.3f} s, the frames {times[0]:.3f} to "
            f"{times[-1]:.3f} s: give both on one clock"
        )


def _reference(toml: _FlightToml, folder: Path) -> tuple[Path, str | None] | None:
    name = toml.text("reference", "file") if toml.has("reference", "file") else "reference.csv"
    path = folder / name
    crs = toml.text("reference", "crs") if toml.has("reference", "crs") else None
    if path.is_file():
        return path, crs
    if toml.section("reference"):
        raise toml.refuse("reference", "file", f"{path} is missing: add it or remove [reference]")
    return None


def _check_area(path: Path, table: Table, names: tuple[str, str], crs: str) -> None:
    # Far outside the area that a CRS is made for, coordinates are another CRS's.
    area = parse_crs(crs).area_of_use
    if area is None:
        return
    lon, lat = transformer(crs, LONLAT).transform(table.numbers[names[0]], table.numbers[names[1]])
    lon = np.where(np.isfinite(lon), lon, np.nan)  # infinite: no place at all
    west, south, east, north = area.bounds
    slack = 1.0
    off_lon = (
        (np.asarray(lon) - west) % 360.0 > (east - west) % 360.0 + slack
        if (east - west) % 360.0
        else np.zeros(len(table), bool)
    )
    off_lon &= (west - np.asarray(lon)) % 360.0 > slack
    off = off_lon | (np.asarray(lat) < south - slack) | (np.asarray(lat) > north + slack) | ~np.isfinite(lon)
    if off.any():
        i = int(np.flatnonzero(off)[0])
        raise refuse(
            path,
            table.lines[i],
            names[0],
            f"({table.numbers[names[0]][i]:.6f}, {table.numbers[names[1]][i]:.6f}) lies outside the area of "
            f"{crs_name(crs)}: state the CRS that the reference is in",
        )
