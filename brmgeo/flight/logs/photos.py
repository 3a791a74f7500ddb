"""A folder of geotagged photos in: EXIF, and XMP as DJI, senseFly and Pix4D's friends write it, MRK files and CSV lists.

Tags after the EXIF 2.32 standard (CIPA DC-008), DJI's ``drone-dji`` and Pix4D's ``Camera`` XMP namespaces. A CSV or MRK
file beside the photos goes before the photos' own tags: it is there because it is better (RTK, or an autopilot's log).
"""

from __future__ import annotations

import csv
import itertools
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from brmgeo.errors import CrsError, FlightError, MissingInputError
from brmgeo.flight.frames import (
    enu_flu_from_ned_frd,
    inverse,
    multiply,
    quaternion_from_euler,
)
from brmgeo.flight.logs.values import PHOTO_SUFFIXES, CameraFrames, Gnss, Height, Log, LogOptions, Orientation
from brmgeo.flight.readings import Camera, FloatArray
from brmgeo.geo.crs import LONLAT, parse_crs, transformer

_FULL_FRAME_DIAGONAL_MM = 43.2666
#: Pitch that takes a camera that looks ahead to one that looks down.
_NADIR_FROM_AHEAD = quaternion_from_euler(np.array(0.0), np.array(-math.pi / 2), np.array(0.0))
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


@dataclass(slots=True)
class _Photo:
    """What one photo says, as far as it says it."""

    path: Path
    size: tuple[int, int]
    t_s: float = math.nan
    lon: float = math.nan
    lat: float = math.nan
    alt: float = math.nan
    sigma: float = math.nan
    above_takeoff: float = math.nan
    above_ground: float = math.nan
    wxyz: FloatArray | None = None  # enu_from_body of a nadir camera at rest
    camera: Camera | None = None
    camera_from: str = ""
    make: str = ""
    turned_by: str = ""
    angles: tuple[float, float, float] | None = None  # as told, in degrees
    listed: bool = False


def read_photos(path: Path, options: LogOptions | None = None) -> Log:
    """The photos of a folder: places, heights, attitude of the camera, camera model, times from the first photo on.

    Raises MissingInputError for a folder without photos; FlightError, naming the photo, where one has no time, no place
    while others have one, is unreadable, or two have one time, and where sizes differ.
    """
    files = sorted(
        p for p in path.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".")
    )
    if not files:
        raise MissingInputError(f"{path}: no photos here (looked for {', '.join(PHOTO_SUFFIXES)})")
    photos = [_photo(p) for p in files]
    notes: list[str] = []
    _lists(path, photos, notes)
    photos = _in_order(photos, notes)
    t = np.array([p.t_s for p in photos])
    first = datetime.fromtimestamp(t[0], UTC)
    t = t - t[0]
    gnss = _gnss(photos, t, notes)
    attitude = _attitude(photos, t, notes)
    camera = photos[0].camera
    if camera is not None:
        notes.append(f"camera from {photos[0].camera_from}: focal length {camera.fx:.0f} px")
    folder = {p.path.name for p in photos}
    names = tuple(
        p.path.name if len(folder) == len(photos) else "_".join(p.path.relative_to(path).parts)
        for p in photos
    )

    def images() -> Iterator[tuple[int, bytes | NDArray[np.uint8]]]:
        for i, photo in enumerate(photos):
            yield i, photo.path.read_bytes()

    return Log(
        "photos",
        f"{len(photos)} photos{', ' + photos[0].make if photos[0].make else ''}",
        f"seconds since the first photo, {first:%Y-%m-%d %H:%M:%S} by the camera's clock",
        height=_height(photos, t),
        attitude=attitude,
        gnss=gnss,
        frames=CameraFrames(t, names, images, photos[0].size, "photos"),
        camera=camera,
        notes=tuple(notes),
        faults=() if gnss is not None else ("no photo has a place in its tags",),
    )


def _in_order(photos: list[_Photo], notes: list[str]) -> list[_Photo]:
    # Sorted by time; FlightError for photos of several sizes, without a time, or of one time.
    if len({p.size for p in photos}) > 1:
        odd = next(p for p in photos if p.size != photos[0].size)
        raise FlightError(
            f"{odd.path}: {odd.size[0]} x {odd.size[1]} pixels, but {photos[0].path.name} has "
            f"{photos[0].size[0]} x {photos[0].size[1]}: give photos of one camera, upright ones apart"
        )
    timeless = [p for p in photos if math.isnan(p.t_s)]
    if timeless:
        raise FlightError(
            f"{timeless[0].path}: no time of exposure in EXIF (DateTimeOriginal) or in a list beside the photos: copy the "
            "originals, tags are lost when photos are edited or sent"
        )
    order = np.argsort(np.array([p.t_s for p in photos]), kind="stable")
    if (order != np.arange(len(photos))).any():
        notes.append("the photos' names are not in order of time; they were sorted by time")
    photos = [photos[i] for i in order]
    for before, photo in itertools.pairwise(photos):
        if photo.t_s <= before.t_s:
            raise FlightError(
                f"{photo.path}: the same time as {before.path.name}, to the whole second: give a .MRK or CSV with "
                "finer times beside the photos, or leave one out"
            )
    return photos


def _gnss(photos: list[_Photo], t: FloatArray, notes: list[str]) -> Gnss | None:
    lonlat = np.array([[p.lon, p.lat] for p in photos])
    placed = np.isfinite(lonlat).all(axis=1)
    if not placed.any():
        return None
    if not placed.all():
        lost = photos[int(np.flatnonzero(~placed)[0])]
        notes.append(f"{int((~placed).sum())} photos have no place, the first is {lost.path.name}")
    some = [p for p, good in zip(photos, placed) if good]
    alt, sigma = np.array([p.alt for p in some]), np.array([p.sigma for p in some])
    return Gnss(t[placed], lonlat[placed, 0], lonlat[placed, 1], alt, sigma)


def _height(photos: list[_Photo], t: FloatArray) -> Height | None:
    for name, above in (("above_ground", "ground"), ("above_takeoff", "take-off")):
        values = np.array([getattr(p, name) for p in photos])
        if np.isfinite(values).all():
            teller = "the list" if photos[0].listed else "XMP"
            return Height(t, values, above, f"{name.replace('_', ' ')} of {teller}")
    return None


def _attitude(photos: list[_Photo], t: FloatArray, notes: list[str]) -> Orientation | None:
    # Zeros are what software writes that does not know the gimbal: no camera keeps to the horizon and to north that well.
    blank = [p for p in photos if p.angles == (0.0, 0.0, 0.0)]
    if blank:
        notes.append(
            f"{blank[0].turned_by}: roll, pitch and yaw are 0, 0, 0 in {len(blank)} of {len(photos)} photos: not told, so "
            "no attitude is used"
        )
        return None
    turned = [p.wxyz for p in photos if p.wxyz is not None]
    if len(turned) == len(photos):
        return Orientation(t, np.stack(turned), True, photos[0].turned_by, of_camera=True)
    if turned:
        notes.append(f"{len(photos) - len(turned)} photos have no attitude, so none is used")
    return None


# ---------------------------------------------------------------- one photo


def _photo(path: Path) -> _Photo:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged tags, which then count as not there
            with Image.open(path) as image:
                size = image.size
                exif = image.getexif()
                main = dict(exif)
                detail = dict(exif.get_ifd(ExifTags.IFD.Exif))
                gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
                xmp = image.info.get("xmp") or main.get(700) or b""
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        raise FlightError(f"{path}: no readable photo: copy it again or leave it out") from None
    photo = _Photo(path, size)
    photo.make = " ".join(
        dict.fromkeys(str(main.get(k, "")).replace("\x00", "").strip() for k in (271, 272) if main.get(k))
    )
    photo.t_s = _time(detail, main)
    _place(photo, gps)
    tags = _tags(xmp)
    _vendor(photo, tags)
    _optics(photo, detail, tags)
    return photo


def _number(value: Any) -> float:
    # EXIF rationals, XMP texts such as "+39.80" or "361/100"; NaN for anything that is no finite number.
    try:
        if isinstance(value, str):
            top, _, bottom = value.partition("/")
            number = float(top) / float(bottom) if bottom else float(top)
        else:
            number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def _time(detail: dict[int, Any], main: dict[int, Any]) -> float:
    text = detail.get(36867) or detail.get(36868) or main.get(306)
    if not isinstance(text, str):
        return math.nan
    try:
        moment = datetime.strptime(text.replace("\x00", "").strip(), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return math.nan
    fraction = str(detail.get(37521) or detail.get(37520) or "").replace("\x00", "").strip()
    return moment.timestamp() + (float("0." + fraction) if fraction.isdecimal() else 0.0)


def _place(photo: _Photo, gps: dict[int, Any]) -> None:
    def degrees(value: Any, sign: Any, negative: str) -> float:
        try:
            d, m, s = (_number(v) for v in value)
        except (TypeError, ValueError):
            return math.nan
        out = d + m / 60.0 + s / 3600.0
        return -out if str(sign).strip("\x00 ").upper() == negative else out

    lat, lon = degrees(gps.get(2), gps.get(1), "S"), degrees(gps.get(4), gps.get(3), "W")
    # A receiver without a fix writes zeros.
    if math.isfinite(lat) and math.isfinite(lon) and (lat, lon) != (0.0, 0.0):
        photo.lat, photo.lon = lat, lon
        below = gps.get(5) in (1, b"\x01")
        altitude = _number(gps.get(6))
        photo.alt = -altitude if below else altitude
        photo.sigma = _number(gps.get(31))


def _tags(xmp: bytes | str) -> dict[str, str]:
    # Attributes and elements alike, by local name with the prefix: "drone-dji:GimbalYawDegree" -> text.
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)
    found = dict(re.findall(r'([\w-]+:[\w-]+)\s*=\s*"([^"]*)"', text))
    found |= {
        name: re.sub(r"<[^>]+>", " ", body).strip()
        for name, body in re.findall(r"<((?!rdf:|x:)[\w-]+:[\w-]+)[^>/]*>(.*?)</\1>", text, re.DOTALL)
    }
    return found


def _angles(tags: dict[str, str], *names: str) -> tuple[float, float, float] | None:
    values = tuple(_number(tags.get(n)) for n in names)
    return (values[0], values[1], values[2]) if all(math.isfinite(v) for v in values) else None


def _ahead(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Attitude (FLU in ENU) of the body that a nadir camera sits in, of a camera told as looking ahead (FRD, degrees)."""
    looking = quaternion_from_euler(*(np.radians(np.array(v)) for v in (roll, pitch, yaw)))
    # At pitch -90 the camera looks down and its top points along the heading: that is the nadir camera at rest.
    return enu_flu_from_ned_frd(multiply(looking, inverse(_NADIR_FROM_AHEAD)))


def _down(roll: float, pitch: float, yaw: float) -> FloatArray:
    """The same of a camera, or an aircraft with a nadir camera, told as level at zero (FRD, degrees)."""
    return enu_flu_from_ned_frd(quaternion_from_euler(*(np.radians(np.array(v)) for v in (roll, pitch, yaw))))


def _vendor(photo: _Photo, tags: dict[str, str]) -> None:
    if any(n.startswith("drone-dji:") for n in tags):
        photo.above_takeoff = _number(tags.get("drone-dji:RelativeAltitude"))
        gimbal = _angles(tags, *(f"drone-dji:Gimbal{a}Degree" for a in ("Roll", "Pitch", "Yaw")))
        if gimbal is not None:
            photo.wxyz, photo.angles = _ahead(*gimbal), gimbal
            photo.turned_by = "DJI gimbal"
        deviation = [_number(tags.get(f"drone-dji:RtkStd{a}")) for a in ("Lon", "Lat")]
        if all(math.isfinite(v) for v in deviation) and tags.get("drone-dji:RtkFlag", "0").strip() not in (
            "0",
            "",
        ):
            photo.sigma = max(deviation)
        place = [_number(tags.get(k)) for k in ("drone-dji:GpsLongitude", "drone-dji:GpsLatitude")]
        if math.isnan(photo.lon) and all(math.isfinite(v) for v in place):
            photo.lon, photo.lat = place
            photo.alt = _number(tags.get("drone-dji:AbsoluteAltitude"))
        return
    parrot = _angles(tags, *(f"drone-parrot:Camera{a}Degree" for a in ("Roll", "Pitch", "Yaw")))
    if parrot is not None:
        photo.wxyz, photo.angles = _ahead(*parrot), parrot
        photo.turned_by = "Parrot camera"
        return
    own = _angles(tags, "Camera:Roll", "Camera:Pitch", "Camera:Yaw")
    if own is not None:
        # Pix4D's and senseFly's zero pitch is straight down; others write that as -90.
        photo.wxyz, photo.angles = _ahead(*own) if own[1] < -45.0 else _down(*own), own
        photo.turned_by = "XMP Camera, pitch 0 is " + ("ahead" if own[1] < -45.0 else "straight down")
    accuracy = _number(tags.get("Camera:GPSXYAccuracy"))
    if math.isfinite(accuracy):
        photo.sigma = accuracy
    photo.above_ground = _number(tags.get("Camera:AboveGroundAltitude"))


def _optics(photo: _Photo, detail: dict[int, Any], tags: dict[str, str]) -> None:
    width, height = photo.size
    centre = ((width - 1) / 2.0, (height - 1) / 2.0)

    def plain(focal: float, source: str) -> None:
        photo.camera, photo.camera_from = Camera(width, height, focal, focal, *centre), source

    # Calibrations in pixels are of the original: a photo made smaller since keeps their numbers.
    middle = _number(tags.get("drone-dji:CalibratedOpticalCenterX"))
    original = 2.0 * middle if middle > 0.0 else _number(detail.get(40962))
    smaller = width / original if original > 0.0 and max(width, height) == width else 1.0
    # DJI's own calibration: "date;fx,fy,cx,cy,k1,k2,p1,p2,k3", the centre as an offset.
    dewarp = [_number(v) for v in tags.get("drone-dji:DewarpData", "").partition(";")[2].split(",")]
    if len(dewarp) == 9 and all(math.isfinite(v) for v in dewarp) and dewarp[0] > 0.0:
        fx, fy, cx, cy = (v * smaller for v in dewarp[:4])
        k1, k2, p1, p2, k3 = dewarp[4:]
        cx, cy = width / 2 + cx - 0.5, height / 2 + cy - 0.5
        photo.camera, photo.camera_from = Camera(width, height, fx, fy, cx, cy), "XMP DewarpData"
        if tags.get("drone-dji:DewarpFlag", "0").strip() == "1":
            photo.camera_from += ", whose distortion is out of the photo already (DewarpFlag 1)"
        else:
            photo.camera = replace(photo.camera, distortion=(k1, k2, p1, p2, k3))
        return
    calibrated = _number(tags.get("drone-dji:CalibratedFocalLength"))
    if calibrated > 0.0:
        return plain(calibrated * smaller, "XMP CalibratedFocalLength")
    focal_mm = _number(detail.get(37386))
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0}.get(detail.get(41488, 2), 25.4)
    density = _number(detail.get(41486))
    perspective = _number(tags.get("Camera:PerspectiveFocalLength"))
    if perspective > 0.0 and density > 0.0:
        return plain(perspective * density / unit_mm * smaller, "XMP PerspectiveFocalLength")
    if focal_mm > 0.0 and density > 0.0:
        focal = focal_mm * density / unit_mm * smaller
        if 0.3 * width < focal < 20.0 * width:  # several makers write the density of the print here
            return plain(focal, "EXIF focal length and sensor density")
    equivalent = _number(detail.get(41989))
    if equivalent > 0.0:
        # The equivalent is that of the whole sensor; a 16:9 photo is cut out of a 4:3 one at full width.
        long, short = max(width, height), min(width, height)
        cut = long / short > 1.6
        diagonal = long * 1.25 if cut else math.hypot(width, height)
        source = f"EXIF 35 mm equivalent {equivalent:g} mm" + (
            ", as a full-width cut of a 4:3 sensor" if cut else ""
        )
        return plain(equivalent / _FULL_FRAME_DIAGONAL_MM * diagonal, source)
    return None


# ---------------------------------------------------------------- lists beside the photos


_COLUMNS = {
    "name": ("name", "file", "filename", "image", "label", "photo"),
    "lat": ("lat", "latitude", "latitude/y"),
    "lon": ("lon", "lng", "long", "longitude", "longitude/x"),
    "alt": ("alt", "altitude", "height/z", "alt_msl", "height", "alt_exif"),
    "relative": ("relativealtitude", "relalt", "agl", "agl_m", "salt"),
    "roll": ("roll", "roll_deg"),
    "pitch": ("pitch", "pitch_deg"),
    "yaw": ("yaw", "yaw_deg", "heading"),
    "sigma": ("sigma_m", "accuracy", "hacc", "accuracyhorizontal"),
    "t": ("t_s", "time_s"),
}


def _lists(folder: Path, photos: list[_Photo], notes: list[str]) -> None:
    # Places from what lies beside the photos: DJI's time marks, or the first list that tells places; the rest is told.
    others = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    used: set[Path] = {p.path for p in photos}
    marks = [p for p in others if p.suffix.lower() == ".mrk"]
    _marks(marks, photos, notes)
    used |= set(marks)
    if not marks:
        for path in (p for p in others if p.suffix.lower() in (".csv", ".txt")):
            if _list(path, folder, photos, notes):
                used.add(path)
                break
    unread = [p for p in others if p not in used]
    lists = [p.name for p in unread if p.suffix.lower() in (".csv", ".txt")]
    if lists:
        why = (
            "time marks go before them"
            if marks
            else "no header with name, latitude, longitude, or not the first"
        )
        notes.append(f"lists beside the photos that were not read: {', '.join(lists[:5])} ({why})")
    kinds = Counter(p.suffix.lower() or p.name for p in unread if p.name not in lists)
    if kinds:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        notes.append(f"files beside the photos that were not read: {told}")


def _list(path: Path, folder: Path, photos: list[_Photo], notes: list[str]) -> bool:
    # Whether a list told places of photos, which then are theirs.
    lines = path.read_bytes().decode("utf-8-sig", "replace").splitlines()
    numbered = [(i, line) for i, line in enumerate(lines, start=1) if line.strip()]
    if len(numbered) < 2:
        return False
    head = numbered[0][1].lstrip("# ").strip()
    crs = _crs_line(head)
    if crs is not None:
        # OpenDroneMap's geo.txt: a CRS, then name x y [z] [yaw pitch roll] [horizontal and vertical accuracy].
        names = ("name", "lon", "lat", "alt", "yaw", "pitch", "roll", "sigma")
        where = {k: i for i, k in enumerate(names)}
        rows = [line.split() for _, line in numbered[1:]]
    else:
        cells = re.split(r"[,;\t]\s*|\s+" if "," not in head and ";" not in head else r"[,;]", head.lower())
        where = {k: cells.index(n) for k, names in _COLUMNS.items() for n in names if n in cells}
        if not {"name", "lat", "lon"} <= set(where):
            return False
        delimiter = next((d for d in ",;\t" if d in numbered[1][1]), " ")
        rows = list(csv.reader([line for _, line in numbered[1:]], delimiter=delimiter))
    named: dict[str, list[_Photo]] = {}
    for p in photos:
        for name in {p.path.name.lower(), p.path.relative_to(folder).as_posix().lower()}:
            named.setdefault(name, []).append(p)
    used = 0
    for (number, _), row in zip(numbered[1:], rows):
        name = row[where["name"]].strip().lower() if len(row) > where["name"] else ""
        meant = named.get(name, [])
        if len(meant) > 1:
            raise FlightError(
                f"{path}:{number}: {len(meant)} photos are named {name}: write their folders, too"
            )
        if not meant:
            continue
        values = {k: _number(row[i]) if i < len(row) else math.nan for k, i in where.items() if k != "name"}
        if crs is not None:
            values["lon"], values["lat"] = transformer(crs, LONLAT).transform(values["lon"], values["lat"])
        if not (abs(values["lat"]) <= 90.0 and abs(values["lon"]) <= 180.0):
            raise FlightError(
                f"{path}:{number}: ({row[where['lon']]}, {row[where['lat']]}) is no place: check the header"
            )
        _tell(meant[0], values, path.name)
        used += 1
    if used:
        notes.append(f"{path.name}: places of {used} of {len(photos)} photos taken from this list")
    return used > 0


def _crs_line(head: str) -> str | None:
    # The CRS that OpenDroneMap's lists begin with: an EPSG code, a PROJ string, or "WGS84 UTM 52N".
    utm = re.fullmatch(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", head, re.IGNORECASE)
    if utm:
        return f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    if not re.match(r"EPSG:|\+proj|WGS84$", head, re.IGNORECASE):
        return None
    try:
        parse_crs(head)
    except CrsError:
        return None
    return head


def _tell(photo: _Photo, values: dict[str, float], source: str) -> None:
    photo.lat, photo.lon = values["lat"], values["lon"]
    photo.alt = values.get("alt", photo.alt)
    photo.sigma = values.get("sigma", photo.sigma)
    if math.isfinite(values.get("relative", math.nan)):
        photo.above_takeoff, photo.listed = values["relative"], True
    if math.isfinite(values.get("t", math.nan)):
        photo.t_s = values["t"]
    roll, pitch, yaw = (values.get(k, math.nan) for k in ("roll", "pitch", "yaw"))
    if all(math.isfinite(v) for v in (roll, pitch, yaw)):
        # An autopilot's list tells the aircraft's attitude, level at zero; a gimbal's tells -90 for down.
        photo.wxyz = _ahead(roll, pitch, yaw) if pitch < -45.0 else _down(roll, pitch, yaw)
        photo.turned_by, photo.angles = source, (roll, pitch, yaw)


def _marks(marks: list[Path], photos: list[_Photo], notes: list[str]) -> None:
    # A folder's marks are those of its photos; a mark file that is alone is that of all.
    folders = [m.parent for m in marks]
    for mark in marks:
        if folders.count(mark.parent) > 1:
            raise FlightError(
                f"{mark}: {folders.count(mark.parent)} time mark files in one folder: put each into a folder with its photos"
            )
        own = photos if len(marks) == 1 else [p for p in photos if p.path.parent == mark.parent]
        if not own:
            raise FlightError(f"{mark}: no photo is in the folder of these time marks: put them together")
        _mrk(mark, own, notes)
    lost = [p for p in photos if len(marks) > 1 and p.path.parent not in folders]
    if lost:
        raise FlightError(
            f"{lost[0].path}: no time mark file in its folder, but in {len(marks)} others: their times are not of one clock"
        )


def _mrk(path: Path, photos: list[_Photo], notes: list[str]) -> None:
    # number, seconds of the GPS week, [week], offsets N E V in mm, Lat, Lon, Ellh, sigmas N, E, V in m, quality.
    # The places are of the camera already: the offsets from the antenna are in them (DJI Zenmuse P1 User Manual,
    # "Image Log File": "longitude", "latitude after compensation"); only a track of one's own antenna needs them.
    rows: dict[int, list[float]] = {}
    for line, text in enumerate(path.read_bytes().decode("utf-8", "replace").splitlines(), start=1):
        if not text.strip():
            continue
        numbers = [float(v) for v in _NUMBER.findall(text)]
        if len(numbers) < 12 or "Lat" not in text:
            raise FlightError(f"{path}:{line}: no line of a DJI time mark file: {text[:60]!r}")
        rows[int(numbers[0])] = numbers
    # The photo's own running number is the mark's; a flight that is one block may begin elsewhere.
    matched = 0
    serial = [re.findall(r"\d+", p.path.stem) for p in photos]
    keys = [int(s[-1]) if s else -1 for s in serial]
    by_order = len(rows) == len(photos) and not set(keys) <= set(rows)
    for i, photo in enumerate(photos):
        row = rows.get(sorted(rows)[i] if by_order else keys[i])
        if row is None:
            continue
        _, tow, week, _, _, _, photo.lat, photo.lon, alt, sn, se, _ = row[:12]
        photo.alt, photo.sigma = alt, max(sn, se)
        photo.t_s = 315_964_800.0 + week * 604_800.0 + tow
        matched += 1
    if 0 < matched < len(photos):
        raise FlightError(
            f"{path}: time marks for {matched} of {len(photos)} photos: their times and the others' are not of one clock; "
            "take out the photos without a mark, or the mark file"
        )
    notes.append(
        f"{path.name}: places, accuracy and GPS times of {matched} photos taken from DJI's time marks"
    )
