"""What the instruments of a simulated flight say all along: odometry, inertial unit and altimeter."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.flight.frames import quaternion_from_euler
from brmgeo.flight.readings import Altimeter, Imu, Odometry
from brmgeo.synth.flight.course import ODOMETRY, RATE_HZ, SENSORS, Course
from brmgeo.synth.flight.settings import OdometryErrors, SimulationSettings


def odometry_of(course: Course, errors: OdometryErrors, seed: int) -> Odometry:
    """Odometry with errors along a course, in a frame of random origin and yaw, rounded as the folder writes it."""
    rng = np.random.default_rng([seed, ODOMETRY])
    stride = max(1, round(RATE_HZ / errors.rate_hz))
    rows = np.arange(0, len(course.t_s), stride)
    t, xyz, rpy = course.t_s[rows], course.xyz_m[rows], course.roll_pitch_yaw[rows]
    dt = np.diff(t, prepend=t[0])
    n = len(t)
    scale = 1.0 + (errors.scale_sigma * rng.normal() if errors.scale_bias is None else errors.scale_bias)
    drift = math.radians(errors.drift_deg_sqrt_min) * np.cumsum(rng.normal(size=n) * np.sqrt(dt / 60.0))
    turn = rng.uniform(-math.pi, math.pi) + drift
    step = np.diff(xyz, axis=0, prepend=xyz[:1]) * scale
    # A step belongs to the time between two poses: turn it by the mean of their errors.
    between = np.r_[turn[0], (turn[1:] + turn[:-1]) / 2.0]
    silent = np.zeros(n, dtype=bool)
    origin = np.zeros((n, 3))
    for when in errors.reset_times_s:
        silent |= (t > when) & (t < when + 2.0)
        after = t >= when
        new_yaw = rng.uniform(-math.pi, math.pi)
        turn, between = turn + after * new_yaw, between + after * new_yaw
    c, s = np.cos(between), np.sin(between)
    turned = np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1], step[:, 2]], axis=-1)
    walk = rng.normal(size=(n, 3)) * (errors.noise_m_sqrt_s * np.sqrt(dt))[:, None]
    track = np.cumsum(turned + walk, axis=0)
    for when in errors.reset_times_s:
        first = int(np.searchsorted(t, when + 2.0))
        if first < n:
            origin[first:] = track[first]
    track = track - origin
    wxyz = np.round(quaternion_from_euler(rpy[:, 0], rpy[:, 1], rpy[:, 2] + turn), 9)
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)
    keep = ~silent
    gathered = np.round(errors.noise_m_sqrt_s**2 * (t - t[0]), 6)[keep] if errors.states_noise else None
    return Odometry(
        np.round(t, 6)[keep], np.round(track, 4)[keep], wxyz[keep], "odometry.tum", walk_m2=gathered
    )


def imu_of(course: Course, seed: int) -> Imu:
    """What a consumer-grade unit in the body says along a course, at the course's own rate.

    Noise densities 0.005 deg/s and 0.002 m/s2 per root Hz, constant biases of 0.1 deg/s and 0.02 m/s2.
    """
    rng = np.random.default_rng([seed, SENSORS, 1])
    roll, pitch, yaw = course.roll_pitch_yaw.T
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1))
    gyro = (turn[:-1].inv() * turn[1:]).as_rotvec() * RATE_HZ
    # A reading is of its own time, not of the hundredth of a second after it.
    gyro = (np.concatenate([gyro[:1], gyro]) + np.concatenate([gyro, gyro[-1:]])) / 2.0
    velocity = np.gradient(course.xyz_m, course.t_s, axis=0)
    accel = np.gradient(velocity, course.t_s, axis=0)
    accel = turn.inv().apply(accel + [0.0, 0.0, GRAVITY_M_S2])
    root = math.sqrt(RATE_HZ)
    gyro += math.radians(0.1) * rng.normal(size=3) + math.radians(0.005) * root * rng.normal(size=gyro.shape)
    accel += 0.02 * rng.normal(size=3) + 0.002 * root * rng.normal(size=accel.shape)
    return Imu(course.t_s, gyro, accel)


def altimeter_of(course: Course, settings: SimulationSettings, seed: int) -> Altimeter:
    """Heights above ground along a course, ten a second, with the errors of the settings."""
    rng = np.random.default_rng([seed, SENSORS, 2])
    tenth = slice(None, None, RATE_HZ // 10)
    agl = course.xyz_m[tenth, 2]
    agl = agl + settings.agl_error_m * (rng.normal() + rng.normal(size=len(agl)))
    return Altimeter(course.t_s[tenth], agl)
