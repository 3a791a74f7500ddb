"""A flight's own odometry: made from its frames, IMU and heights, where it came without any.

Video with an IMU goes through the visual-inertial filter, frames farther apart through planar odometry.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.errors import FlightError
from brmgeo.flight.folder import MADE_BY, Flight, own_method
from brmgeo.flight.planar import run_planar
from brmgeo.flight.readings import FloatArray, Imu, Odometry
from brmgeo.flight.vio import GyroInDegreesError, VioSettings, run_vio

OdometryMethod = Literal["auto", "vio", "planar"]
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
            f"{path}: accelerations of {size:.2f} at rest are in g: multiply them by {GRAVITY_M_S2} (m/s2)"
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


class _Pictures:
    """A flight's frames in grey, one by one; ``spent_s`` is what was done with them in between, processor seconds."""

    def __init__(self, flight: Flight) -> None:
        self.flight, self.spent_s = flight, 0.0

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for i in range(len(self.flight.frames)):
            grey = np.asarray(cv2.cvtColor(self.flight.image(i), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
            begin = time.process_time()
            yield grey
            self.spent_s += time.process_time() - begin


def estimate(flight: Flight, method: OdometryMethod = "auto") -> Embedded:
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
    pictures = _Pictures(flight)
    facts: dict[str, Any] = {
        "made_by": MADE_BY,
        "method": method,
        "flight": flight.name,
        "frames": len(times),
    }
    by_filter = method == "vio"
    made = _by_filter(flight, pictures, imu, facts) if by_filter else _by_pairs(flight, pictures, facts)
    track = made.odometry
    steps = np.linalg.norm(np.diff(track.xyz_m[:, :2], axis=0), axis=1)
    assert track.walk_m2 is not None
    made.facts.update(
        poses=len(track.t_s),
        seconds=round(float(track.t_s[-1] - track.t_s[0]), 3),
        length_m=round(float(steps.sum()), 1),
        blind_frames=int(made.blind.sum()),
        segments=1 if track.segment is None else int(track.segment[-1]) + 1,
        median_tracks=float(np.median(made.tracks[1:])),
        sigma_m_gathered=round(float(np.sqrt(track.walk_m2[-1])), 2),
        frames_per_second=round(len(times) / max(pictures.spent_s, 1e-9), 1),
    )
    return made


def _by_filter(flight: Flight, pictures: _Pictures, imu: Imu | None, facts: dict[str, Any]) -> Embedded:
    path, times = flight.folder / "imu.csv", flight.times_s
    if imu is None:
        raise FlightError(f"{path} is missing: add it, or choose the method planar", needs="method")
    imu = checked_imu(imu, path, times)
    agl = np.array([f.agl_m for f in flight.frames])
    try:
        result = run_vio(times, pictures, agl, imu, flight.camera, flight.mount, VioSettings())
    except GyroInDegreesError as error:
        raise FlightError(f"{path}: {error}: multiply gx, gy, gz by pi / 180") from None
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
    track = replace(result.odometry, walk_m2=result.walk_m2)
    return Embedded(track, result.yaw_sigma_rad, result.tracks, result.blind, facts)


def _by_pairs(flight: Flight, pictures: _Pictures, facts: dict[str, Any]) -> Embedded:
    agl, roll, pitch = (
        np.array([getattr(f, k) for f in flight.frames]) for k in ("agl_m", "roll_rad", "pitch_rad")
    )
    planar = run_planar(flight.times_s, pictures, agl, roll, pitch, flight.camera, flight.mount)
    n = len(planar.rows)
    facts["warnings"] = [] if n > 1 else ["no two frames could be joined"]
    return Embedded(
        replace(planar.odometry, walk_m2=planar.walk_m2),
        np.radians(0.2) * np.sqrt(np.arange(n)),
        planar.inliers,
        np.r_[False, planar.inliers[1:] == 0],
        facts,
    )


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
    ``estimate`` refuses is said and left: the flight then is located without odometry. Nothing is written.
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
    if method := own_method(flight.folder):
        return f"{MADE_FROM_FRAMES} by {MADE_BY}: {method}"
    return f"{source}: {flight.odometry.source or 'odometry'}"


def thinned_rows(times_s: FloatArray, every_s: float) -> NDArray[np.int64]:
    """(k,) indices of the first frame in each ``every_s`` seconds."""
    slot = np.floor((times_s - times_s[0]) / every_s + 1e-6)
    return np.flatnonzero(np.diff(slot, prepend=-1.0) > 0).astype(np.int64)
