"""What becomes of a log in a flight folder: frames with height and attitude, camera, tracks, reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError
from brmgeo.flight import frames
from brmgeo.flight.calibration import bend_of
from brmgeo.flight.folder import MAX_AGL_M, MIN_AGL_M
from brmgeo.flight.logs.pictures import Pictures
from brmgeo.flight.logs.values import Gnss, Height, ImportSettings, Log, Orientation
from brmgeo.flight.motion import slerp
from brmgeo.flight.readings import Altimeter, Attitude, Camera, FloatArray, Frame, Odometry, Reference
from brmgeo.flight.write import FlightParts
from brmgeo.geo.crs import LONLAT

#: Attitude and height are interpolated across at most this.
MAX_BRIDGE_S = 1.0
MAX_HEIGHT_BRIDGE_S = 5.0


@dataclass(frozen=True, slots=True)
class Imported:
    """A flight out of a log.

    Attributes:
        parts: what its folder is to hold.
        pictures: index of a picture -> its file name; those that become frames.
        says: what was done and left out, a sentence each.
    """

    parts: FlightParts
    pictures: dict[int, str]
    says: tuple[str, ...]


#: How well a camera that is said to look straight down by nothing but habit does so.
UNTOLD_MOUNT_DEG = 10.0


def imported(path: Path, log: Log, pictures: Pictures | None, settings: ImportSettings) -> Imported:
    """The flight of a log in the normal form and its pictures; ``path`` is for messages and the flight's name.

    Raises FlightError for a missing height or camera, one that does not fit the pictures, and frames without a time,
    height or attitude in common with the log.
    """
    says: list[str] = []
    height = _height_of(path, log, settings)
    parts = FlightParts(settings.name or path.stem, odometry_format="csv")
    chosen: dict[int, str] = {}
    if pictures is not None:
        flown, chosen = _frames(path, log, height, pictures, settings, says)
        told = (0.0, 0.0, 0.0) if is_of_camera(log) else settings.mount_deg
        unknown = told is None and log.attitude is None and log.odometry is None
        mount = told or (0.0, 0.0, 0.0)
        video, camera = pictures.video, _camera(path, log, pictures, settings)
        given = settings.fov_deg is not None or settings.camera is not None
        named = zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion)
        bent = "".join(f", {name} {value:g}" for name, value in named) if any(camera.distortion) else ""
        says.append(
            f"camera: {camera.width} x {camera.height}, fx {camera.fx:.1f}, fy {camera.fy:.1f}, cx {camera.cx:.1f}, cy "
            f"{camera.cy:.1f}{bent} ({2.0 * math.degrees(math.atan(camera.half_fov_tan)):.1f} degrees across the short "
            "side), "
            f"{'as given' if given else 'from the log' if log.camera is not None else 'from the pictures'}; mount "
            + (
                "of a stabilised camera"
                if is_of_camera(log)
                else "roll {:g}, pitch {:g}, yaw {:g}".format(*mount)
            )
            + (
                f", known to {UNTOLD_MOUNT_DEG:g} degrees: nothing tells how the camera looks"
                if unknown
                else ""
            )
        )
        parts = replace(
            parts,
            camera=camera,
            mount=Attitude(*(math.radians(v) for v in mount)),
            mount_sigma_rad=math.radians(UNTOLD_MOUNT_DEG) if unknown else 0.0,
            frames=flown,
            video=None if video is None else (video.name, settings.video_start_s),
        )
    if log.odometry is not None:
        o = log.odometry
        parts = replace(parts, odometry=replace(o, wxyz=np.round(o.wxyz, 9)))
        says.append(f"odometry.csv: {len(o.t_s)} poses of {o.source}")
    if log.imu is not None:
        parts = replace(parts, imu=log.imu)
        says.append(f"imu.csv: {len(log.imu.t_s)} readings")
    if height is not None and log.kind != "photos":
        usable = (height.agl_m >= MIN_AGL_M) & (height.agl_m <= MAX_AGL_M)
        if usable.any():
            parts = replace(parts, altimeter=Altimeter(height.t_s[usable], height.agl_m[usable]))
            says.append(f"altimeter.csv: {int(usable.sum())} heights of {height.source}")
    if log.gnss is not None:
        reference = _reference(log.gnss)
        parts = replace(parts, reference=reference, reference_crs=LONLAT)
        accuracy = "" if reference.sigma_m is None else ", with accuracy"
        says.append(f"reference.csv: {len(reference.t_s)} GNSS positions{accuracy}")
    if log.uses_gnss and log.odometry is not None:
        says.append("GNSS went into this odometry: results with it do not count as flown without GNSS")
    if pictures is None:
        says.append(
            "no pictures: give photos or a video, or add frames/, frames.csv, [camera] and [height] yourself"
        )
    return Imported(parts, chosen, tuple(says))


def _frames(
    path: Path,
    log: Log,
    height: Height | None,
    pictures: Pictures,
    settings: ImportSettings,
    says: list[str],
) -> tuple[tuple[Frame, ...], dict[int, str]]:
    keep = _wanted(pictures.t_s, settings.rate_hz)
    if log.odometry is not None:
        t = log.odometry.t_s
        if pictures.t_s[-1] < t[0] or pictures.t_s[0] > t[-1]:
            raise FlightError(
                f"{path}: clocks are not synchronised: frames from {pictures.t_s[0]:.3f} to {pictures.t_s[-1]:.3f} s, "
                f"odometry from {t[0]:.3f} to {t[-1]:.3f} s: shift the frames",
                needs="shift_frames_s",
            )
    times = pictures.t_s[keep]
    agl, good = _heights(path, times, height, settings, says)
    turned = _attitudes(path, log, times, good, says)
    dropped = int((~good).sum())
    if dropped:
        says.append(f"{dropped} of {len(times)} frames have no usable height or attitude and were left out")
    chosen = {int(i): pictures.names[i] for i in np.flatnonzero(keep)[good]}
    roll, pitch, heading = (np.zeros(len(times)), np.zeros(len(times)), None) if turned is None else turned
    flown = tuple(
        Frame(
            t_s=float(times[k]),
            file=name,
            agl_m=float(agl[k]),
            roll_rad=float(roll[k]),
            pitch_rad=float(pitch[k]),
            true_heading_deg=None if heading is None else float(heading[k]),
        )
        for k, name in zip(np.flatnonzero(good), chosen.values())
    )
    columns = ["t_s", "file", "agl_m"] + ([] if turned is None else ["roll_deg", "pitch_deg"])
    columns += [] if heading is None else ["yaw_deg"]
    says.append(f"frames.csv: {len(flown)} frames, {', '.join(columns)}")
    return flown, chosen


def _heights(
    path: Path, times: FloatArray, height: Height | None, settings: ImportSettings, says: list[str]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    # Metres above ground at the frames, and where they are known and possible.
    if height is None:
        if settings.agl_m is None:
            raise FlightError(
                f"{path}: the log tells no height: give the frames' height above ground, or that of the ground (ground_m)",
                needs="agl_m",
            )
        return np.full(len(times), settings.agl_m), np.ones(len(times), dtype=bool)
    agl = np.interp(times, height.t_s, height.agl_m)
    good = _bridged(height.t_s, times, MAX_HEIGHT_BRIDGE_S) & (agl >= MIN_AGL_M) & (agl <= MAX_AGL_M)
    if not good.any():
        raise FlightError(
            f"{path}: {height.source}: no height of {MIN_AGL_M:g} to {MAX_AGL_M:g} m at a frame: give one",
            needs="agl_m",
        )
    if height.above == "take-off":
        says.append(f"height is above the take-off point ({height.source}), taken as height above ground")
    return agl, good


def _attitudes(
    path: Path, log: Log, times: FloatArray, good: NDArray[np.bool_], says: list[str]
) -> tuple[FloatArray, FloatArray, FloatArray | None] | None:
    # Roll, pitch (radians) and heading (degrees) at the frames; ``good`` loses the frames without attitude.
    # An autopilot's and a gimbal's attitude come first; an IMU's own is of the IMU's axes, so odometry is better.
    own = log.attitude is not None and (log.attitude.north or log.odometry is None)
    attitude = log.attitude if own else log.odometry
    if attitude is None:
        return None
    known = _bridged(attitude.t_s, times, MAX_BRIDGE_S)
    if known[good].mean() < 1.0:
        says.append(f"{int((~known & good).sum())} frames without attitude were left out")
    good &= known
    if not good.any():
        raise FlightError(
            f"{path}: clocks are not synchronised: no frame ({times[0]:.3f} to {times[-1]:.3f} s) has an attitude "
            f"({attitude.t_s[0]:.3f} to {attitude.t_s[-1]:.3f} s): shift the frames",
            needs="shift_frames_s",
        )
    wxyz = _attitude_at(attitude, times)
    roll, pitch, _ = frames.euler_from_quaternion(wxyz)
    north = isinstance(attitude, Orientation) and attitude.north
    return roll, pitch, frames.heading_deg(wxyz) if north else None


def _bridged(t_s: FloatArray, at_s: FloatArray, max_gap_s: float) -> NDArray[np.bool_]:
    """(m,) bool: where values at ``t_s`` tell of ``at_s``, with no longer gap between."""
    right = np.clip(np.searchsorted(t_s, at_s), 0, len(t_s) - 1)
    left = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 1)
    near = (np.abs(t_s[right] - at_s) < 0.05) | (np.abs(t_s[left] - at_s) < 0.05)
    inside = (at_s >= t_s[0]) & (at_s <= t_s[-1]) & (t_s[right] - t_s[left] <= max_gap_s)
    return np.asarray(near | inside)


def _attitude_at(attitude: Orientation | Odometry, at_s: FloatArray) -> FloatArray:
    t = attitude.t_s
    if len(t) == 1:
        return np.repeat(attitude.wxyz, len(at_s), axis=0)
    right = np.clip(np.searchsorted(t, at_s), 1, len(t) - 1)
    share = np.clip((at_s - t[right - 1]) / (t[right] - t[right - 1]), 0.0, 1.0)
    return slerp(attitude.wxyz[right - 1], attitude.wxyz[right], share)


def _height_of(path: Path, log: Log, settings: ImportSettings) -> Height | None:
    if settings.agl_m is not None:
        return None
    if settings.ground_m is not None:
        if log.gnss is None or not np.isfinite(log.gnss.alt_m).any():
            raise FlightError(
                f"{path}: the ground's altitude is given, but the log has none above a datum: give the height above ground",
                needs="agl_m",
            )
        known = np.isfinite(log.gnss.alt_m)
        return Height(
            log.gnss.t_s[known],
            log.gnss.alt_m[known] - settings.ground_m,
            "ground",
            "GNSS altitude above ground_m",
        )
    return log.height


def _reference(gnss: Gnss) -> Reference:
    alt, sigma = (values if np.isfinite(values).all() else None for values in (gnss.alt_m, gnss.sigma_m))
    return Reference(gnss.t_s, np.stack([gnss.lon_deg, gnss.lat_deg], axis=-1), alt, sigma)


def is_of_camera(log: Log) -> bool:
    """True where the log's attitude is that of a stabilised camera, which then has no mount."""
    return log.attitude is not None and log.attitude.of_camera


def _wanted(t_s: FloatArray, rate_hz: float | None) -> NDArray[np.bool_]:
    keep = np.ones(len(t_s), dtype=bool)
    if rate_hz is not None:
        last = -math.inf
        for i, t in enumerate(t_s):
            keep[i] = t - last >= 1.0 / rate_hz - 1e-3
            last = t if keep[i] else last
    return keep


def _camera(path: Path, log: Log, pictures: Pictures, settings: ImportSettings) -> Camera:
    width, height = pictures.size
    if settings.fov_deg is not None:
        return Camera.from_fov(width, height, settings.fov_deg)
    told = settings.camera
    if isinstance(told, tuple):
        fx, fy, cx, cy, *bend = told
        return Camera(width, height, fx, fy, cx, cy, bend_of("", bend))
    camera = told or log.camera or pictures.camera
    if camera is None:
        untold = "nothing tells the camera's field of view: give it in degrees across the short side"
        raise FlightError(
            f"{path}: {log.lens or untold}",
            needs="camera" if log.lens else "fov_deg",
        )
    if (camera.width, camera.height) != (width, height):
        raise FlightError(
            f"{path}: the camera's calibration is for {camera.width} x {camera.height}, its pictures {width} x {height}: "
            "give the camera of the pictures, or its field of view",
            needs="camera",
        )
    return camera
