"""The true flight along a path, and what the instruments say at the frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.errors import InputError
from brmgeo.flight.readings import FloatArray
from brmgeo.synth.flight.settings import SimulationSettings, require_possible

RATE_HZ = 100

# Streams of randomness, so that switching one effect on or off leaves the others as they are.
COURSE, SENSORS, ODOMETRY, MASK, LATENT, PICTURE = range(6)


@dataclass(frozen=True, slots=True)
class Course:
    """The true flight, 100 times a second, and what the instruments say at the frames.

    ``t_s`` (m,), ``xyz_m`` (m, 3) with z above ground, ``roll_pitch_yaw`` (m, 3) radians; ``frame_index`` (n,) rows of
    the frames; ``measured_*`` (n,) at the frames, rounded as the folder writes them.
    """

    t_s: FloatArray
    xyz_m: FloatArray
    roll_pitch_yaw: FloatArray
    frame_index: NDArray[np.int64]
    measured_agl_m: FloatArray
    measured_roll_deg: FloatArray
    measured_pitch_deg: FloatArray
    measured_grid_heading_deg: FloatArray | None

    @property
    def frame_times_s(self) -> FloatArray:
        """(n,) float64 times of the frames."""
        return self.t_s[self.frame_index]


def _rounded(path: FloatArray, radius: float) -> FloatArray:
    # Replace every corner by an arc that touches both legs, no longer than half of either.
    keep = np.r_[True, np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6]
    path = path[keep]
    out = [path[0]]
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:]):
        a, b = before - corner, after - corner
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        a, b = a / la, b / lb
        half = math.acos(float(np.clip(a @ b, -1.0, 1.0))) / 2.0
        if half > math.radians(89.9) or half < math.radians(0.5) or radius <= 0:
            out.append(corner)
            continue
        cut = min(radius / math.tan(half), 0.49 * la, 0.49 * lb)
        r = cut * math.tan(half)
        middle = corner + (a + b) / np.linalg.norm(a + b) * math.hypot(cut, r)
        start, end = corner + a * cut - middle, corner + b * cut - middle
        sweep = math.atan2(start[0] * end[1] - start[1] * end[0], float(start @ end))
        for share in np.linspace(0.0, 1.0, max(2, math.ceil(abs(sweep) * r / 0.25))):
            c, s = math.cos(sweep * share), math.sin(sweep * share)
            out.append(middle + [c * start[0] - s * start[1], s * start[0] + c * start[1]])
    out.append(path[-1])
    return np.array(out)


def _smooth_noise(rng: np.random.Generator, n: int, seconds: float) -> FloatArray:
    # Unit variance, correlated over about ``seconds``.
    sigma = seconds * RATE_HZ
    # Drawn coarse and stretched: a long filter over every sample would be most of the flight's cost.
    stride = max(1, int(sigma / 8))
    coarse = gaussian_filter1d(rng.normal(size=n // stride + 34), sigma / stride, mode="wrap")
    coarse *= math.sqrt(2.0 * math.sqrt(math.pi) * sigma / stride)
    return np.interp(np.arange(n), np.arange(len(coarse)) * stride, coarse)


def fly(path: FloatArray, settings: SimulationSettings, seed: int) -> Course:
    """The true course along ``path`` (k, 2; metres in the map frame) and the instruments' readings at the frames.

    Raises InputError for a path of fewer than two different points, SettingsError for settings out of range.
    """
    path = np.asarray(path, dtype=np.float64)
    if path.ndim != 2 or len(path) < 2 or not np.isfinite(path).all() or not np.ptp(path, axis=0).any():
        raise InputError("a flight path needs at least two different points: give more waypoints")
    require_possible(settings)
    rng = np.random.default_rng([seed, COURSE])
    track = _rounded(path, settings.turn_radius_m)
    track = track[np.r_[True, np.linalg.norm(np.diff(track, axis=0), axis=1) > 1e-6]]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))]
    n = max(2, int(along[-1] / settings.speed_m_s * RATE_HZ) + 1)
    # Four seconds more at either end, cut off below: the flight begins and ends at cruise, and no filter sees an edge.
    lead = 4 * RATE_HZ
    run = lead / RATE_HZ * settings.speed_m_s + 1.0
    ends = [(track[0] - track[1]) / along[1], (track[-1] - track[-2]) / (along[-1] - along[-2])]
    track = np.concatenate([track[:1] + run * ends[0], track, track[-1:] + run * ends[1]])
    along = np.r_[-run, along, along[-1] + run]
    t = np.arange(-lead, n + lead) / RATE_HZ
    s = t * settings.speed_m_s
    # A multirotor's path is no polygon of tiny chords: smooth it over a fifth of a second.
    xy = np.stack([np.interp(s, along, track[:, k]) for k in range(2)], axis=-1)
    xy = gaussian_filter1d(xy, 0.2 * RATE_HZ, axis=0, mode="nearest")
    velocity = np.gradient(xy, t, axis=0)
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    course = gaussian_filter1d(course, 0.3 * RATE_HZ, mode="nearest")
    accel = gaussian_filter1d(np.gradient(velocity, t, axis=0), 0.3 * RATE_HZ, axis=0, mode="nearest")
    t, xy, course, accel = (values[lead:-lead] for values in (t, xy, course, accel))
    yaw = course + math.radians(settings.crab_sigma_deg) * rng.normal()

    ahead = np.cos(yaw) * accel[:, 0] + np.sin(yaw) * accel[:, 1]
    aside = -np.sin(yaw) * accel[:, 0] + np.cos(yaw) * accel[:, 1]
    wobble = math.radians(settings.wobble_deg)
    roll = -np.arctan2(aside, GRAVITY_M_S2) + wobble * _smooth_noise(rng, n, 0.7)
    pitch = np.arctan2(ahead, GRAVITY_M_S2) + wobble * _smooth_noise(rng, n, 0.7)
    pitch += math.radians(settings.cruise_pitch_deg)
    agl = settings.agl_m + settings.agl_sigma_m * _smooth_noise(rng, n, 8.0)
    agl = np.maximum(agl, 0.2 * settings.agl_m)

    every = settings.frame_interval_s * RATE_HZ
    frames = np.unique(np.round(np.arange(0.0, n - 1e-9, every)).astype(np.int64))
    frames = frames[frames < n]
    rng = np.random.default_rng([seed, SENSORS])
    k = len(frames)

    def read(truth: FloatArray, sigma: float, decimals: int) -> FloatArray:
        return np.round(truth[frames] + sigma * (rng.normal() + rng.normal(size=k)), decimals)

    heading = None
    measured_agl = read(agl, settings.agl_error_m, 3)
    measured_roll = read(np.degrees(roll), settings.attitude_error_deg, 4)
    measured_pitch = read(np.degrees(pitch), settings.attitude_error_deg, 4)
    if settings.compass_error_deg is not None:
        heading = read(90.0 - np.degrees(yaw), settings.compass_error_deg, 3) % 360.0
    return Course(
        t,
        np.concatenate([xy, agl[:, None]], axis=1),
        np.stack([roll, pitch, yaw], axis=-1),
        frames,
        np.maximum(measured_agl, 0.1 * settings.agl_m),
        measured_roll,
        measured_pitch,
        heading,
    )
