"""Embedded odometry of a flight folder: ``brmgeo odometry flight/`` writes the track, what it is worth, and facts."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError, InputError
from brmgeo.flight.folder import MADE_BY, Flight, is_own_odometry, read_flight
from brmgeo.flight.planar import run_planar
from brmgeo.flight.readings import Imu, Odometry
from brmgeo.flight.vio import GyroInDegreesError, VioSettings, run_vio

FloatArray = NDArray[np.float64]
Method = Literal["auto", "vio", "planar"]
MADE_FROM_FRAMES = "made from the frames"
#: Slower than this, frames do not overlap enough in time for points to be followed between them.
VIDEO_INTERVAL_S = 0.6
#: So many frames show whether a flight's pictures overlap enough for planar odometry.
PROBE_FRAMES = 6


@dataclass(frozen=True, slots=True)
class Embedded:
    """A track made from the frames, and what is worth saying about it."""

    odometry: Odometry
    yaw_sigma_rad: FloatArray
    tracks: NDArray[np.int64]
    blind: NDArray[np.bool_]
    facts: dict[str, Any]


def checked_imu(imu: Imu, path: Path, times_s: FloatArray) -> Imu:
    """The IMU as it is; FlightError when its units, axes or times cannot be right."""
    if len(imu.t_s) < 2:
        raise FlightError(
            f"{path}: {len(imu.t_s)} reading: odometry needs a hundred or so a second of the whole flight"
        )
    first, last = float(imu.t_s[0]), float(imu.t_s[-1])
    if last < times_s[-1] - 1.0 or first > times_s[0] + 1.0:
        raise FlightError(
            f"{path}: readings from {first:.2f} to {last:.2f} s, but frames from {times_s[0]:.2f} to {times_s[-1]:.2f} s: "
            "give both on one clock, or cut the flight to what both cover"
        )
    gap = float(np.diff(imu.t_s).max())
    if gap > 1.0:
        at = float(imu.t_s[int(np.diff(imu.t_s).argmax())])
        raise FlightError(f"{path}: no reading for {gap:.1f} s after {at:.2f} s: cut the flight there")
    pull = np.median(imu.accel_m_s2, axis=0)
    size = float(np.median(np.linalg.norm(imu.accel_m_s2, axis=1)))
    if 0.8 < size < 1.25:
        raise FlightError(
            f"{path}: accelerations of {size:.2f} at rest are in g: multiply them by 9.80665 (m/s2)"
        )
    if not 8.0 < size < 12.0:
        raise FlightError(f"{path}: accelerations of {size:.2f} m/s2 (median), not about 9.8: check the unit")
    if pull[2] < 0.5 * size:
        raise FlightError(
            f"{path}: gravity reads {pull[0]:.1f}, {pull[1]:.1f}, {pull[2]:.1f} m/s2: in body axes (x nose, y left, z up) "
            "it is about +9.8 on z; for x nose, y right, z down turn the signs of y and z"
        )
    fast = float(np.percentile(np.abs(imu.gyro_rad_s), 99.0))
    if fast > 6.0:
        raise FlightError(
            f"{path}: turning rates of {fast:.0f} rad/s look like degrees: multiply them by pi / 180"
        )
    return imu


def estimate(flight: Flight, method: Method = "auto") -> Embedded:
    """The flight's odometry from its own frames.

    ``auto`` takes the visual-inertial filter where there is an imu.csv and video-rate frames, else the planar odometry.
    Raises FlightError for a flight without pictures, and where the IMU's units, axes or times cannot be right.
    """
    if not flight.has_images:
        raise FlightError(
            f"{flight.folder / 'frames'}: no pictures: odometry is made from the frames themselves"
        )
    times = flight.times_s
    if len(times) < 2:
        raise FlightError(f"{flight.folder / 'frames.csv'}: one frame: odometry needs two or more")
    imu = flight.imu()
    interval = float(np.median(np.diff(times)))
    if method == "auto":
        method = "vio" if imu is not None and interval <= VIDEO_INTERVAL_S else "planar"
    agl = np.array([f.agl_m for f in flight.frames])
    spent = 0.0

    def pictures() -> Iterator[NDArray[np.uint8]]:
        nonlocal spent
        for i in range(len(times)):
            grey = np.asarray(cv2.cvtColor(flight.image(i), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            begin = time.process_time()
            yield grey
            spent += time.process_time() - begin

    facts: dict[str, Any] = {
        "made_by": MADE_BY,
        "method": method,
        "flight": flight.name,
        "frames": len(times),
    }
    if method == "vio":
        if imu is None:
            raise FlightError(f"{flight.folder / 'imu.csv'} is missing: add it, or use --method planar")
        imu = checked_imu(imu, flight.folder / "imu.csv", times)
        try:
            result = run_vio(times, pictures(), agl, imu, flight.camera, flight.mount, VioSettings())
        except GyroInDegreesError as error:
            raise FlightError(
                f"{flight.folder / 'imu.csv'}: {error}: multiply gx, gy, gz by pi / 180"
            ) from None
        made = Embedded(
            replace(result.odometry, walk_m2=result.walk_m2),
            result.yaw_sigma_rad,
            result.tracks,
            result.blind,
            facts,
        )
        facts |= {
            "delay_ms": round(1000.0 * result.delay_s, 2),
            "delay_sigma_ms": round(1000.0 * result.delay_sigma_s, 2),
            "boresight_deg": [round(math.degrees(v), 3) for v in result.boresight_rad],
            "boresight_sigma_deg": [round(math.degrees(v), 3) for v in result.boresight_sigma_rad],
            "gyro_bias_deg_s": [round(math.degrees(v), 4) for v in result.gyro_bias_rad_s],
            "accel_bias_m_s2": [round(float(v), 4) for v in result.accel_bias_m_s2],
            "share_above_ground": round(result.high_share, 4),
            "start_speed_m_s": round(float(np.hypot(*result.velocity_m_s[min(len(times) - 1, 20), :2])), 2),
        }
        facts["warnings"] = _warnings(facts)
    else:
        roll, pitch = (np.array([getattr(f, k) for f in flight.frames]) for k in ("roll_rad", "pitch_rad"))
        planar = run_planar(times, pictures(), agl, roll, pitch, flight.camera, flight.mount)
        n = len(planar.rows)
        made = Embedded(
            replace(planar.odometry, walk_m2=planar.walk_m2),
            np.radians(0.2) * np.sqrt(np.arange(n)),
            planar.inliers,
            np.r_[False, planar.inliers[1:] == 0],
            facts,
        )
        facts["warnings"] = [] if n > 1 else ["no two frames could be joined"]
    track = made.odometry
    steps = np.linalg.norm(np.diff(track.xyz_m[:, :2], axis=0), axis=1)
    assert track.walk_m2 is not None
    facts |= {
        "poses": len(track.t_s),
        "seconds": round(float(track.t_s[-1] - track.t_s[0]), 3),
        "length_m": round(float(steps.sum()), 1),
        "blind_frames": int(made.blind.sum()),
        "segments": 1 if track.segment is None else int(track.segment[-1]) + 1,
        "median_tracks": float(np.median(made.tracks[1:])),
        "sigma_m_gathered": round(float(np.sqrt(track.walk_m2[-1])), 2),
        "frames_per_second": round(len(times) / max(spent, 1e-9), 1),
    }
    return made


@dataclass(frozen=True, slots=True)
class OwnOdometry:
    """What a flight without odometry got from its frames.

    Attributes:
        flight: with odometry where some could be made, and fewer frames where they came at video rate.
        says: one line about it; empty where nothing was tried.
    """

    flight: Flight
    says: str = ""


def own_odometry(flight: Flight, every_s: float) -> OwnOdometry:
    """The flight with odometry from its own frames, where it has none and the frames are dense enough; else as it is.

    Frames at video rate with an imu.csv go through the visual-inertial filter, and a frame every ``every_s`` seconds is
    left to be matched. Others are joined by planar odometry, where more than half of the first frames overlap. What
    ``brmgeo odometry`` would refuse is said and left: the flight then is located without odometry. Nothing is written.
    """
    if flight.odometry is not None or not flight.has_images or len(flight.frames) < 3:
        return OwnOdometry(flight)
    dense = float(np.median(np.diff(flight.times_s))) <= VIDEO_INTERVAL_S
    few = replace(flight, frames=flight.frames[:PROBE_FRAMES])
    try:
        if flight.imu() is not None and dense:
            made = estimate(flight, "vio")
        elif not dense and 2 * (estimate(few, "planar").facts["segments"] - 1) >= len(few.frames) - 1:
            return OwnOdometry(flight, "none: the frames do not overlap enough to make it from them")
        else:
            made = estimate(flight, "planar")
    except FlightError as error:
        return OwnOdometry(flight, f"none: it cannot be made from the frames: {error}")
    facts = made.facts
    says = (
        f"{MADE_FROM_FRAMES}: {made.odometry.source}, {facts['length_m']:.0f} m in {facts['seconds']:.0f} s, "
        f"{facts['blind_frames']} of {facts['poses']} poses blind, {facts['segments']} segment(s)"
    )
    says = "; ".join([says, *facts["warnings"]])
    kept = thinned_rows(flight.times_s, every_s) if dense else np.arange(len(flight.frames))
    if len(kept) < len(flight.frames):
        says += f"; every {every_s:g} s one of its {len(flight.frames)} frames is matched"
    frames = tuple(flight.frames[int(i)] for i in kept)
    return OwnOdometry(replace(flight, odometry=replace(made.odometry, source=says), frames=frames), says)


def odometry_name(flight: Flight, source: str) -> str:
    """Where a flight folder's odometry comes from, for reports: ``source`` tells who made the flight."""
    if flight.odometry is None:
        return "none"
    if flight.odometry.source.startswith(MADE_FROM_FRAMES):
        return flight.odometry.source
    if is_own_odometry(flight.folder):
        method = json.loads((flight.folder / "odometry.json").read_text(encoding="utf-8"))["method"]
        return f"{MADE_FROM_FRAMES} by {MADE_BY}: {method}"
    return f"{source}: {flight.odometry.source or 'odometry'}"


def _warnings(facts: dict[str, Any]) -> list[str]:
    found = []
    delay, sigma = facts["delay_ms"], facts["delay_sigma_ms"]
    if abs(delay) > max(10.0, 3.0 * sigma):
        found.append(
            f"the camera's times differ from the IMU's by {delay:+.0f} ms (sigma {sigma:.0f}): corrected here; "
            f"add {delay / 1000.0:+.3f} to t_s in frames.csv to correct it everywhere"
        )
    for axis, angle, error in zip(
        ("roll", "pitch", "yaw"), facts["boresight_deg"], facts["boresight_sigma_deg"]
    ):
        if abs(angle) > max(0.4, 3.0 * error):
            found.append(
                f"the camera's mount is off by {angle:+.2f} deg in {axis} (sigma {error:.2f}): corrected here; "
                f"correct {axis}_deg in [mount] of flight.toml for the views too"
            )
    return found


def method_named(name: str) -> Method:
    """The method of a name; InputError for another one."""
    if name not in ("auto", "vio", "planar"):
        raise InputError(f"method {name!r} is not known: choose auto, vio or planar")
    return name  # type: ignore[return-value]


def make_odometry(flight_dir: Path, method: Method = "auto") -> dict[str, Any]:
    """Makes a flight's odometry and writes it into its folder; returns the facts.

    ``odometry.tum`` (poses), ``odometry.covariance.csv`` (what they are worth), ``odometry.json`` (facts); flight.toml gets
    an [odometry] section, so that localize reads them. A flight that came with odometry of its own keeps it: then the
    names begin with ``embedded`` and flight.toml stays as it is. A run that is killed leaves a folder that the next one
    mends: the facts come first and tell whose the files are, flight.toml last.
    """
    toml = flight_dir / "flight.toml"
    ours = is_own_odometry(flight_dir)
    flight = read_flight(flight_dir, with_odometry=not ours)
    stem = "odometry" if flight.odometry is None else "embedded"
    made = estimate(flight, method)
    facts = made.facts | {"track": f"{stem}.tum", "covariance": f"{stem}.covariance.csv"}
    _replace(flight_dir / f"{stem}.json", json.dumps(facts, indent=1) + "\n")
    write_track(flight_dir, stem, made)
    text = toml.read_text(encoding="utf-8-sig")
    if "odometry" not in tomllib.loads(text):
        section = (
            f'[odometry]  # made by `{MADE_BY}`\nfile = "{stem}.tum"\nformat = "tum"\n'
            f'covariance = "{stem}.covariance.csv"\n'
        )
        _replace(toml, text.rstrip("\n") + "\n" + section)
    return facts


def write_track(folder: Path, stem: str, made: Embedded) -> None:
    """Writes ``stem``.tum and .covariance.csv (t_s, walk_m2, yaw_sigma_deg, tracks, blind, segment), one row a pose."""
    track = made.odometry
    assert track.walk_m2 is not None
    rows = []
    for t, p, q in zip(track.t_s, track.xyz_m, track.wxyz):
        numbers = [f"{t:.6f}", *(f"{v:.4f}" for v in p), *(f"{v:.9f}" for v in q[[1, 2, 3, 0]])]
        rows.append(" ".join(numbers))
    _replace(folder / f"{stem}.tum", "\n".join(rows) + "\n")
    segment = np.zeros(len(track.t_s), dtype=np.int64) if track.segment is None else track.segment
    lines = ["t_s,walk_m2,yaw_sigma_deg,tracks,blind,segment"]
    values = zip(track.t_s, track.walk_m2, np.degrees(made.yaw_sigma_rad), made.tracks, made.blind, segment)
    lines += [f"{t:.6f},{w:.6f},{y:.4f},{n},{int(b)},{s}" for t, w, y, n, b, s in values]
    _replace(folder / f"{stem}.covariance.csv", "\n".join(lines) + "\n")


def thin_flight(flight_dir: Path, out: Path, every_s: float) -> Path:
    """A flight folder with a frame every ``every_s`` seconds and the whole odometry: what a matcher wants of a video.

    Pictures and masks are copied as they are. Raises InputError for a video flight, whose frames are no files, for an
    interval that is not positive, and for a folder that holds something already. ``out`` comes into being whole, or not.
    """
    if not every_s > 0:
        raise InputError(f"--every {every_s}: give seconds, more than 0")
    flight = read_flight(flight_dir)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: the thinned flight needs a new or empty folder")
    if flight.has_images and not (flight_dir / "frames").is_dir():
        raise InputError(f"{flight_dir}: its frames are a video: list fewer of them in frames.csv")
    kept = thinned_rows(flight.times_s, every_s)
    lines = (flight_dir / "frames.csv").read_text(encoding="utf-8-sig").splitlines()
    rows = [i for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
    chosen = [lines[rows[0]], *(lines[rows[1 + int(i)]] for i in kept)]
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.absolute().parent) as scratch:
        work = Path(scratch) / out.name
        work.mkdir()
        for path in sorted(flight_dir.iterdir()):
            if path.is_file() and path.name != "frames.csv" and not path.name.startswith("."):
                shutil.copy2(path, work / path.name)
        for folder, wanted in (("frames", flight.has_images), ("masks", flight.has_masks)):
            for i in kept if wanted else []:
                name = flight.frames[int(i)].file
                source = Path(name) if folder == "frames" else Path(name).with_suffix(".png")
                (work / folder / source).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(flight_dir / folder / source, work / folder / source)
        _replace(work / "frames.csv", "\n".join(chosen) + "\n")
        read_flight(work)
        if out.is_dir():
            out.rmdir()
        work.rename(out)
    return out


def thinned_rows(times_s: FloatArray, every_s: float) -> NDArray[np.int64]:
    """(k,) indices of the first frame in each ``every_s`` seconds."""
    slot = np.floor((times_s - times_s[0]) / every_s + 1e-6)
    return np.flatnonzero(np.diff(slot, prepend=-1.0) > 0).astype(np.int64)


def _replace(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8", newline="\n")
    os.replace(part, path)


def summary(facts: dict[str, Any]) -> list[str]:
    """What a person wants to know of the track, line by line."""
    lines = [
        f"{facts['track']}: {facts['poses']} poses, {facts['length_m']:.0f} m in {facts['seconds']:.0f} s "
        f"by {facts['method']}, "
        f"{facts['blind_frames']} blind, {facts['segments']} segment(s), median {facts['median_tracks']:.0f} points, "
        f"sigma of the steps {facts['sigma_m_gathered']:.1f} m in all, {facts['frames_per_second']:.0f} frames/s"
    ]
    return lines + [f"note: {w}" for w in facts["warnings"]]
