"""Writes a flight folder (docs/FLIGHT.md) so that reading it gives back what was written, to the last bit.

Numbers are written with as many decimals as their kind has (``DECIMALS``), and with all of their digits where that would
not bring them back. Instruments tell less than a double holds: ``rounded`` brings a flight to those decimals first, and
its files stay short. Quaternions and angles told in radians come back to within one unit of the last place.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo import files
from brmgeo.errors import FlightError
from brmgeo.flight.folder import Flight
from brmgeo.flight.readings import Altimeter, Attitude, Camera, FloatArray, Frame, Imu, Odometry, Reference
from brmgeo.geo.crs import LONLAT, parse_crs
from brmgeo.pictures import encode
from brmgeo.settings import read_toml

#: Decimals that each kind of number is written with: the first of them that holds all of a file's numbers.
DECIMALS: dict[str, tuple[int, ...]] = {
    "time_s": (2, 6),
    "pose_time_s": (6,),
    "position_m": (4,),
    "quaternion": (9,),
    "agl_m": (3,),
    "attitude_deg": (4,),
    "heading_deg": (6,),
    "gyro_rad_s": (7,),
    "accel_m_s2": (6,),
    "lonlat_deg": (9,),
    "walk_m2": (6,),
    "sigma_deg": (4,),
    "count": (0,),
}


@dataclass(frozen=True, slots=True)
class FlightParts:
    """What a flight folder is to hold besides pictures and masks; None is left out.

    Attributes:
        name: of the flight.
        simulated: nobody flew it, and it may be made again.
        camera, mount: the camera and how it sits in the body.
        mount_sigma_rad: how well its roll and pitch are known, standard deviation, radians.
        frames: in order of time. Without them, and a camera, the folder is no flight yet.
        video: the file whose pictures are the frames, and the time of its first picture in seconds.
        odometry: the track; with ``walk_m2``, what it is worth is written beside it.
        odometry_format: ``tum``, or ``csv``, which holds segments where nothing says what the track is worth.
        imu, altimeter: further instruments.
        reference: where the aircraft really was, in ``reference_crs`` (x is the longitude in a geographic CRS).
    """

    name: str
    simulated: bool = False
    camera: Camera | None = None
    mount: Attitude = field(default_factory=Attitude)
    mount_sigma_rad: float = 0.0
    frames: tuple[Frame, ...] | None = None
    video: tuple[str, float] | None = None
    odometry: Odometry | None = None
    odometry_format: Literal["tum", "csv"] = "tum"
    imu: Imu | None = None
    altimeter: Altimeter | None = None
    reference: Reference | None = None
    reference_crs: str = LONLAT


def write_flight(folder: Path, parts: FlightParts) -> None:
    """Writes the tables of a flight into a folder that is there, flight.toml last.

    Raises FlightError for a frame's name that no row of frames.csv can hold, ValueError for segments that
    ``odometry_format`` cannot hold.
    """
    lines = [f"name = {_quoted(parts.name)}"]
    if parts.simulated:
        lines.append("simulated = true  # by brmgeo: no real flight")
    if parts.camera is not None:
        lines += [*_camera_lines(parts.camera), *_mount_lines(parts.mount, parts.mount_sigma_rad)]
    if parts.video is not None:
        lines += ["[frames]", f"video = {_quoted(parts.video[0])}", f"start_s = {float(parts.video[1])!r}"]
    if parts.odometry is not None:
        section = write_track(folder, parts.odometry, track_format=parts.odometry_format)
        if parts.odometry_format == "tum" and not parts.simulated:
            section |= {"axes": "flu"}
        lines += _section("odometry", section)
    if parts.frames is not None:
        _write_frames(folder / "frames.csv", parts.frames)
        lines += ["[height]", 'source = "frames"']
    if parts.altimeter is not None:
        told = parts.altimeter
        _write_table(
            folder / "altimeter.csv", ["t_s", "agl_m"], [("time_s", [told.t_s]), ("agl_m", [told.agl_m])]
        )
        lines += _section("altimeter", {"file": "altimeter.csv"})
    if parts.imu is not None:
        _write_imu(folder / "imu.csv", parts.imu)
    if parts.reference is not None:
        _write_reference(folder / "reference.csv", parts.reference, parts.reference_crs)
        lines += _section("reference", {"file": "reference.csv", "crs": parts.reference_crs})
    files.write_text(folder / "flight.toml", "\n".join(lines) + "\n")


def write_track(
    folder: Path,
    track: Odometry,
    *,
    stem: str = "odometry",
    track_format: Literal["tum", "csv"] = "tum",
    columns: Mapping[str, NDArray[Any]] | None = None,
) -> dict[str, str]:
    """Writes poses, and beside them what they are worth where the track has ``walk_m2``; the keys of [odometry].

    Args:
        stem: of the files' names: ``stem``.tum or .csv, and ``stem``.covariance.csv.
        columns: (n,) further columns of the latter: ``yaw_sigma_deg``, ``tracks``, ``blind``.

    Raises ValueError for segments in TUM without ``walk_m2``: that format has no place for them.
    """
    q = track.wxyz.T
    kinds = {"t": "pose_time_s", "xyz": "position_m", "q": "quaternion"}
    path = folder / f"{stem}.{track_format}"
    if track_format == "tum":
        if track.segment is not None and track.walk_m2 is None:
            raise ValueError("TUM has no column for segments: write them as csv")
        order = [q[1], q[2], q[3], q[0]]
        groups = [(kinds["t"], [track.t_s]), (kinds["xyz"], [*track.xyz_m.T]), (kinds["q"], order)]
        _write_table(path, None, groups, " ")
    else:
        groups = [(kinds["t"], [track.t_s]), (kinds["xyz"], [*track.xyz_m.T]), (kinds["q"], [*q])]
        header = ["t_s", "x", "y", "z", "qw", "qx", "qy", "qz"]
        if track.segment is not None:
            header.append("segment")
            groups.append(("count", [track.segment]))
        _write_table(path, header, groups)
    section = {"file": path.name, "format": track_format}
    if track.walk_m2 is not None:
        header = ["t_s", "walk_m2"]
        groups = [(kinds["t"], [track.t_s]), ("walk_m2", [track.walk_m2])]
        for name, values in (columns or {}).items():
            header.append(name)
            groups.append(("sigma_deg" if name == "yaw_sigma_deg" else "count", [values]))
        if track.segment is not None:
            header.append("segment")
            groups.append(("count", [track.segment]))
        section["covariance"] = f"{stem}.covariance.csv"
        _write_table(folder / section["covariance"], header, groups)
    return section


def write_facts(folder: Path, stem: str, facts: Mapping[str, Any]) -> None:
    """Writes what is to be said of a track that was made from the flight's frames: ``stem``.json."""
    files.write_text(folder / f"{stem}.json", json.dumps(facts, indent=1) + "\n")


def name_track(folder: Path, section: Mapping[str, str], made_by: str) -> None:
    """Adds [odometry] to a flight.toml that has none: the keys that ``write_track`` gave, and who made it."""
    path = folder / "flight.toml"
    toml = read_toml(path, error=FlightError, missing=FlightError)
    if "odometry" in toml.data:
        return
    lines = _section("odometry", section)
    lines[0] += f"  # made by `{made_by}`"
    files.write_text(path, toml.text.rstrip("\n") + "\n" + "\n".join(lines) + "\n")


def write_picture(folder: Path, file: str, rgb: NDArray[np.uint8], *, quality: int = 92) -> None:
    """Writes a frame, (h, w, 3) uint8 RGB, into frames/ by the ending of its name."""
    path = folder / "frames" / file
    path.write_bytes(encode(rgb, path.suffix, quality=quality))


def write_mask(folder: Path, file: str, mask: NDArray[np.uint8]) -> None:
    """Writes the mask of the frame ``file``, (h, w) uint8 of 0 and 255, into masks/ as a picture of one bit a pixel."""
    data = encode(mask, options=(cv2.IMWRITE_PNG_BILEVEL, 1))
    (folder / "masks" / PurePosixPath(file).with_suffix(".png")).write_bytes(data)


def copy_thinned(flight: Flight, rows: Sequence[int], out: Path) -> None:
    """Copies a flight folder with the frames of the given rows only, everything else as it is.

    Raises FlightError for a video flight, whose frames are no files. ``out`` is an empty folder.
    """
    if flight.has_images and not (flight.folder / "frames").is_dir():
        raise FlightError(f"{flight.folder}: its frames are a video: list fewer of them in frames.csv")
    lines = (flight.folder / "frames.csv").read_text(encoding="utf-8-sig").splitlines()
    full = [i for i, line in enumerate(lines) if line.strip()]
    for path in sorted(flight.folder.iterdir()):
        if path.is_file() and path.name != "frames.csv" and not path.name.startswith("."):
            shutil.copyfile(path, out / path.name)
    for folder, wanted in (("frames", flight.has_images), ("masks", flight.has_masks)):
        for i in rows if wanted else []:
            name = PurePosixPath(flight.frames[int(i)].file)
            source = name if folder == "frames" else name.with_suffix(".png")
            (out / folder / source).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(flight.folder / folder / source, out / folder / source)
    chosen = [lines[full[0]], *(lines[full[1 + int(i)]] for i in rows)]
    files.write_text(out / "frames.csv", "\n".join(chosen) + "\n")


# ---------------------------------------------------------------- numbers


def rounded(parts: FlightParts) -> FlightParts:
    """The parts with every number brought to the decimals of its kind, so that files hold no digit too many."""
    frames = parts.frames
    if frames is not None:
        t, agl = (_round([getattr(f, k) for f in frames], kind) for k, kind in _FRAME_KINDS)
        roll, pitch = (
            np.radians(_round(np.degrees([getattr(f, k) for f in frames]), "attitude_deg"))
            for k in ("roll_rad", "pitch_rad")
        )
        heading = [f.true_heading_deg for f in frames]
        frames = tuple(
            Frame(
                float(t[i]),
                f.file,
                float(agl[i]),
                float(roll[i]),
                float(pitch[i]),
                None if heading[i] is None else float(_round([heading[i]], "heading_deg")[0]),
            )
            for i, f in enumerate(frames)
        )
    imu, altimeter, reference = parts.imu, parts.altimeter, parts.reference
    if imu is not None:
        gyro, accel = _round(imu.gyro_rad_s, "gyro_rad_s"), _round(imu.accel_m_s2, "accel_m_s2")
        imu = Imu(_round(imu.t_s, "time_s"), gyro, accel)
    if altimeter is not None:
        altimeter = Altimeter(_round(altimeter.t_s, "time_s"), _round(altimeter.agl_m, "agl_m"))
    if reference is not None:
        place = "lonlat_deg" if parse_crs(parts.reference_crs).is_geographic else "position_m"
        alt, sigma = (
            None if v is None else _round(v, "position_m") for v in (reference.alt_m, reference.sigma_m)
        )
        reference = Reference(_round(reference.t_s, "time_s"), _round(reference.xy_m, place), alt, sigma)
    return replace(
        parts,
        frames=frames,
        odometry=None if parts.odometry is None else rounded_track(parts.odometry),
        imu=imu,
        altimeter=altimeter,
        reference=reference,
    )


def rounded_track(track: Odometry) -> Odometry:
    """A track with times, positions and variances brought to the decimals of their kind; orientations stay."""
    walk = None if track.walk_m2 is None else _round(track.walk_m2, "walk_m2")
    return replace(
        track,
        t_s=_round(track.t_s, "pose_time_s"),
        xyz_m=_round(track.xyz_m, "position_m"),
        walk_m2=walk,
    )


_FRAME_KINDS = (("t_s", "time_s"), ("agl_m", "agl_m"))


def _round(values: Any, kind: str) -> FloatArray:
    # The doubles nearest to the decimals, as printing and reading them would give.
    values = np.asarray(values, dtype=np.float64)
    decimals = DECIMALS[kind][-1]
    scaled = values * 10.0**decimals
    out = np.asarray(np.rint(scaled) / 10.0**decimals)
    # Printing rounds the number itself, not its product, which may fall on the other side of a half.
    close = np.abs(np.abs(scaled - np.floor(scaled)) - 0.5) < 1e-4
    out[close] = [float(f"{v:.{decimals}f}") for v in values[close]]
    return out


def _format(columns: Sequence[NDArray[Any]], kind: str) -> str:
    values = np.stack([np.asarray(c, dtype=np.float64) for c in columns])
    for decimals in DECIMALS[kind]:
        steps = np.rint(values * 10.0**decimals)
        if (np.abs(steps) < 2.0**53).all() and (steps / 10.0**decimals == values).all():
            return f"%.{decimals}f"
    return "%.17g"


def _degrees(radians: Any) -> FloatArray:
    # Degrees that come back as just these radians where there are some, with few decimals where that will do.
    wanted = np.asarray(radians, dtype=np.float64)
    near = np.degrees(wanted)
    out = near
    for candidate in (
        np.nextafter(near, np.inf),
        np.nextafter(near, -np.inf),
        near,
        near.round(9),
        near.round(4),
    ):
        out = np.where(np.radians(candidate) == wanted, candidate, out)
    return np.asarray(out)


# ---------------------------------------------------------------- files


def _write_table(
    path: Path,
    header: Sequence[str] | None,
    groups: Sequence[tuple[str, Sequence[NDArray[Any]]]],
    separator: str = ",",
) -> None:
    # One format call over all numbers: row by row it would be most of a masks-only flight's time.
    formats = [_format(columns, kind) for kind, columns in groups for _ in columns]
    table = np.column_stack([np.asarray(c, dtype=np.float64) for _, columns in groups for c in columns])
    row = separator.join(formats) + "\n"
    head = "" if header is None else ",".join(header) + "\n"
    files.write_text(path, head + (row * len(table)) % tuple(table.ravel().tolist()))


def _write_frames(path: Path, frames: Sequence[Frame]) -> None:
    header = ["t_s", "file", "agl_m"]
    groups = [(kind, [np.array([getattr(f, k) for f in frames])]) for k, kind in _FRAME_KINDS]
    attitude = np.array([[f.roll_rad, f.pitch_rad] for f in frames])
    if attitude.any():
        header += ["roll_deg", "pitch_deg"]
        groups += [("attitude_deg", [column]) for column in _degrees(attitude).T]
    headings = [f.true_heading_deg for f in frames]
    told = [h for h in headings if h is not None]
    if len(told) == len(frames):
        header.append("yaw_deg")
        groups.append(("heading_deg", [np.array(told)]))
    elif told:
        raise FlightError(f"{path}: a compass that tells of some frames only has no place in frames.csv")
    formats = [_format(columns, kind) for kind, columns in groups]
    columns = [[f % v for v in values[0].tolist()] for f, (_, values) in zip(formats, groups)]
    rows = [
        ",".join([cells[0], _cell(path, frame.file), *cells[1:]]) for frame, *cells in zip(frames, *columns)
    ]
    files.write_text(path, "\n".join([",".join(header), *rows]) + "\n")


def _write_imu(path: Path, imu: Imu) -> None:
    header = ["t_s", "gx", "gy", "gz", "ax", "ay", "az"]
    gyro, accel = [*imu.gyro_rad_s.T], [*imu.accel_m_s2.T]
    _write_table(path, header, [("time_s", [imu.t_s]), ("gyro_rad_s", gyro), ("accel_m_s2", accel)])


def _write_reference(path: Path, reference: Reference, crs: str) -> None:
    geographic = parse_crs(crs).is_geographic
    header = ["t_s", *(("lon", "lat") if geographic else ("x", "y"))]
    place = "lonlat_deg" if geographic else "position_m"
    groups = [("time_s", [reference.t_s]), (place, [*reference.xy_m.T])]
    for name, values in (("alt_m", reference.alt_m), ("sigma_m", reference.sigma_m)):
        if values is not None:
            header.append(name)
            groups.append(("position_m", [values]))
    _write_table(path, header, groups)


def _cell(path: Path, name: str) -> str:
    if name != name.strip() or len(name.splitlines()) != 1:
        raise FlightError(f"{path}: {name!r} cannot be the name of a frame: rename the file")
    return '"' + name.replace('"', '""') + '"' if "," in name or '"' in name else name


def _quoted(text: str) -> str:
    # JSON's escapes are TOML's; what Python takes for the end of a line is escaped too.
    text = json.dumps(text, ensure_ascii=False)
    return "".join(f"\\u{ord(c):04x}" if c in "\x7f\x85\u2028\u2029" else c for c in text)


def _section(name: str, keys: Mapping[str, str]) -> list[str]:
    return [f"[{name}]", *(f"{key} = {_quoted(value)}" for key, value in keys.items())]


def _camera_lines(camera: Camera) -> list[str]:
    lines = ["[camera]", f"width = {camera.width}", f"height = {camera.height}"]
    lines += [f"{key} = {float(getattr(camera, key))!r}" for key in ("fx", "fy", "cx", "cy")]
    if camera.is_distorted:
        lines.append(f"distortion = [{', '.join(repr(float(v)) for v in camera.distortion)}]")
    return lines


def _mount_lines(mount: Attitude, sigma_rad: float) -> list[str]:
    degrees = _degrees([mount.roll_rad, mount.pitch_rad, mount.yaw_rad])
    keys = ("roll_deg", "pitch_deg", "yaw_deg")
    lines = ["[mount]", *(f"{key} = {float(value)!r}" for key, value in zip(keys, degrees))]
    return lines + ([f"sigma_deg = {float(_degrees([sigma_rad])[0])!r}"] if sigma_rad else [])
