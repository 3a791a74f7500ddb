"""Visual-inertial odometry over ground: an error-state Kalman filter on tracked points, IMU and height above ground.

The camera looks at a plane whose distance the altimeter gives; that distance is the scale. The filter's state is
attitude, velocity, position, the biases of gyro and accelerometer, the delay between camera and IMU, the camera's
boresight error, and a copy of position and attitude at the last keyframe. Each tracked point ties the present pose to
the keyframe's: its ray from the keyframe meets the plane, and the present camera must see it there.

Buildings break the plane. Every point's height above it is estimated from its own parallax since it was first seen;
the ground is the slowest layer, the lowest well-filled one, and points clearly above it are left out.

Sources: error-state filter: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), in its
global-error form; cloned keyframe: Roumeliotis & Burdick, "Stochastic cloning" (ICRA 2002); delay as a state: Li &
Mourikis, "Online temporal calibration for camera-IMU systems" (IJRR 2014); the plane's homography as measurement:
Bloesch et al., "Fusion of optical flow and inertial measurements for robust egomotion estimation" (IROS 2014).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brmgeo.flight.camera import pixel_from_ray, ray_from_pixel
from brmgeo.flight.klt import KltSettings, KltTracker
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Imu, Odometry

GRAVITY = 9.80665
WARM_BYTES = 256_000_000
# Share of the height over which the ground's unevenness pulls steps the same way; by the errors of simulated flights.
RELIEF_LENGTH = 0.18
MAX_DELAY_S = 1.5
# Error state: where each part begins. The clone (position, attitude) is last.
P, V, TH, BG, BA, TD, BS, CP, CT, SIZE = 0, 3, 6, 9, 12, 15, 16, 19, 22, 25
# The filter's attributes that a correction replaces; it makes new arrays and leaves the old ones as they are.
_CORRECTED = ("p", "v", "rot", "gyro_bias", "accel_bias", "delay", "bore", "pk", "rk")
# What a picture sees of it: all but velocity and the biases.
_SEEN = np.r_[P : P + 3, TH : TH + 3, TD : TD + 1, BS:SIZE]


@dataclass(frozen=True, slots=True)
class VioSettings:
    """Noise and thresholds; the defaults are a consumer IMU and a laser or radar altimeter.

    Attributes:
        gyro_noise, accel_noise: densities, rad/s and m/s2 per root Hz, somewhat above the data sheet's.
        gyro_walk, accel_walk: random walk of the biases, rad/s and m/s2 per root second.
        gyro_bias_sigma, accel_bias_sigma: of the biases at the start.
        speed_sigma_m_s, tilt_sigma_rad: of velocity and levelling at the start.
        agl_sigma_m: of one height reading.
        ground_walk_m_sqrt_s: how the ground below rises and falls, metres per root second.
        pixel_sigma: of one tracked point, pixels, at ten frames a second.
        unevenness_m: of the ground itself about its plane.
        delay_sigma_s, boresight_sigma_rad: of camera-IMU delay and mounting at the start; 0 holds them at zero.
        slowest_layer: tell roofs from ground; False treats all points as ground.
        keyframe_share: a new keyframe is taken after this share of the height has been flown.
        min_tracks: with fewer points common with the keyframe a frame is blind.
        layer_m: points higher than this above the ground layer (and two sigma) are left out.
        max_gap_s: after a longer pause between frames nothing is tracked across.
        warm_s: so many seconds at the beginning are gone through twice, so that speed, tilt, biases and boresight are
            known when points are first seen (at most ``WARM_BYTES`` of frames); 0: once.
        lost_m: a blind stretch that leaves the place less sure than this begins a new segment.
    """

    gyro_noise: float = math.radians(0.01)
    accel_noise: float = 0.01
    gyro_walk: float = math.radians(0.002)
    accel_walk: float = 0.0005
    gyro_bias_sigma: float = math.radians(0.5)
    accel_bias_sigma: float = 0.05
    speed_sigma_m_s: float = 15.0
    tilt_sigma_rad: float = math.radians(3.0)
    agl_sigma_m: float = 1.0
    ground_walk_m_sqrt_s: float = 0.1
    pixel_sigma: float = 1.0
    unevenness_m: float = 0.7
    delay_sigma_s: float = 0.05
    boresight_sigma_rad: float = math.radians(0.7)
    slowest_layer: bool = True
    keyframe_share: float = 0.3
    min_tracks: int = 15
    layer_m: float = 2.0
    max_gap_s: float = 1.5
    warm_s: float = 20.0
    lost_m: float = 15.0
    klt: KltSettings = field(default_factory=KltSettings)


@dataclass(frozen=True, slots=True)
class VioResult:
    """What the filter made of a flight, one row a frame.

    Attributes:
        odometry: poses of the body, z above ground; gravity-aligned, yaw 0 and x = y = 0 at the first frame. Its
            ``segment`` grows where the track was lost for good.
        walk_m2: (n,) variance per axis that the steps have gathered since the first frame, without heading and scale:
            the variance of a step between two frames is the difference.
        yaw_sigma_rad: (n,) of the yaw against the first frame's.
        tracks: (n,) points that tied the frame to its keyframe.
        blind: (n,) bool: bridged by the IMU alone.
        velocity_m_s: (n, 3) in the odometry frame.
        delay_s, delay_sigma_s: IMU time minus camera time, and its standard deviation.
        boresight_rad: (3,) rotation vector of the camera in the body frame on top of the stated mount, and sigma (3,).
        gyro_bias_rad_s, accel_bias_m_s2: (3,) at the end.
        high_share: mean share of points that were told to be above ground.
    """

    odometry: Odometry
    walk_m2: FloatArray
    yaw_sigma_rad: FloatArray
    tracks: NDArray[np.int64]
    blind: NDArray[np.bool_]
    velocity_m_s: FloatArray
    delay_s: float
    delay_sigma_s: float
    boresight_rad: FloatArray
    boresight_sigma_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    accel_bias_m_s2: FloatArray
    high_share: float


# ---------------------------------------------------------------- kernels


@nb.njit(cache=True, error_model="numpy")
def _skew(v: Any) -> Any:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2] = -v[2], v[1]
    out[1, 0], out[1, 2] = v[2], -v[0]
    out[2, 0], out[2, 1] = -v[1], v[0]
    return out


@nb.njit(cache=True, error_model="numpy")
def _exp(v: Any) -> Any:
    # Rodrigues' rotation of a rotation vector.
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    k = _skew(v)
    if angle < 1e-9:
        return np.eye(3) + k
    return np.eye(3) + math.sin(angle) / angle * k + (1.0 - math.cos(angle)) / (angle * angle) * (k @ k)


@nb.njit(cache=True, error_model="numpy")
def _propagate(p, v, rot, bg, ba, t0, t1, it, gyro, accel, qg, qa, qbg, qba, qz):  # type: ignore[no-untyped-def]
    # The nominal state from t0 to t1 through the IMU samples, with the transition (15, 15) and noise (15, 15) of its
    # error. Between samples the readings are linear; before the first and after the last they are held.
    phi = np.eye(15)
    noise = np.zeros((15, 15))
    omega = np.zeros(3)
    n = it.shape[0]
    t = t0
    i = np.searchsorted(it, t0, side="right") - 1
    while t < t1 - 1e-9:
        nxt = t1
        if i + 1 < n and it[i + 1] < t1:
            nxt = it[i + 1]
        dt = nxt - t
        if dt > 0.0:
            if i < 0:
                g, a = gyro[0], accel[0]
            elif i + 1 >= n:
                g, a = gyro[n - 1], accel[n - 1]
            else:
                share = (0.5 * (t + nxt) - it[i]) / (it[i + 1] - it[i])
                g = gyro[i] + share * (gyro[i + 1] - gyro[i])
                a = accel[i] + share * (accel[i + 1] - accel[i])
            omega = g - bg
            half = rot @ _exp(omega * (0.5 * dt))
            f = half @ (a - ba)
            acc = f.copy()
            acc[2] -= 9.80665
            p = p + v * dt + 0.5 * acc * dt * dt
            v = v + acc * dt
            rot = rot @ _exp(omega * dt)
            step = np.eye(15)
            turn = -_skew(f)
            for r in range(3):
                step[r, 3 + r] = dt
                for c in range(3):
                    step[r, 6 + c] = 0.5 * dt * dt * turn[r, c]
                    step[3 + r, 6 + c] = dt * turn[r, c]
                    step[r, 12 + c] = -0.5 * dt * dt * half[r, c]
                    step[3 + r, 12 + c] = -dt * half[r, c]
                    step[6 + r, 9 + c] = -dt * half[r, c]
            phi = step @ phi
            noise = step @ noise @ step.T
            # A reading that had to be held or stretched over a gap is worth less the longer that is.
            worse = 1.0 + (dt / 0.1) ** 2 * 100.0 if dt > 0.1 else 1.0
            for r in range(3):
                noise[3 + r, 3 + r] += qa * dt * worse
                noise[6 + r, 6 + r] += qg * dt * worse
                noise[9 + r, 9 + r] += qbg * dt
                noise[12 + r, 12 + r] += qba * dt
            noise[2, 2] += qz * dt
        t = nxt
        i += 1
    return p, v, rot, phi, noise, omega


@nb.njit(cache=True, error_model="numpy")
def _tie(p, rot, pk, rotk, rbc, vel, omega, rays, seen, weight, matrix, vector):  # type: ignore[no-untyped-def]
    # Residuals (n, 2) of normalised image coordinates, observed minus predicted; where weight is positive, J'WJ is
    # added to matrix and J'Wr to vector. pk, rotk: the keyframe's body pose; rbc: body_from_camera.
    n = rays.shape[0]
    out = np.zeros((n, 2))
    cam = rot @ rbc
    camk = rotk @ rbc
    inv = cam.T.copy()
    turn_rate = rot @ omega
    jac = np.zeros((2, 25))
    dy = np.zeros((3, 25))
    for j in range(n):
        w = camk @ rays[j]
        if w[2] > -1e-3:
            out[j, 0] = out[j, 1] = np.nan
            continue
        lam = -pk[2] / w[2]
        d = pk + lam * w - p
        y = inv @ d
        if y[2] < 1e-3:
            out[j, 0] = out[j, 1] = np.nan
            continue
        out[j, 0] = seen[j, 0] - y[0] / y[2]
        out[j, 1] = seen[j, 1] - y[1] / y[2]
        if weight[j] <= 0.0:
            continue
        # y = C'(X - p); X = pk + lam w moves with the keyframe's pose within the plane.
        in_body = rbc @ rays[j]
        d_body = rot.T @ d
        for r in range(3):
            slope = -(inv[r, 0] * w[0] + inv[r, 1] * w[1] + inv[r, 2] * w[2]) / w[2]
            dx0, dx1, dx2 = inv[r, 0], inv[r, 1], inv[r, 2] + slope
            # Rows of dx [w]x, of inv [d]x, and of the boresight's two parts: row x [v]x is the cross product row x v.
            dy[r, 0], dy[r, 1], dy[r, 2] = -inv[r, 0], -inv[r, 1], -inv[r, 2]
            dy[r, 6] = inv[r, 1] * d[2] - inv[r, 2] * d[1]
            dy[r, 7] = inv[r, 2] * d[0] - inv[r, 0] * d[2]
            dy[r, 8] = inv[r, 0] * d[1] - inv[r, 1] * d[0]
            dy[r, 15] = 0.0
            for c in range(3):
                dy[r, 15] += dy[r, 6 + c] * turn_rate[c] - inv[r, c] * vel[c]
            e0 = dx0 * rotk[0, 0] + dx1 * rotk[1, 0] + dx2 * rotk[2, 0]
            e1 = dx0 * rotk[0, 1] + dx1 * rotk[1, 1] + dx2 * rotk[2, 1]
            e2 = dx0 * rotk[0, 2] + dx1 * rotk[1, 2] + dx2 * rotk[2, 2]
            b0, b1, b2 = rbc[0, r], rbc[1, r], rbc[2, r]
            dy[r, 16] = b1 * d_body[2] - b2 * d_body[1] - lam * (e1 * in_body[2] - e2 * in_body[1])
            dy[r, 17] = b2 * d_body[0] - b0 * d_body[2] - lam * (e2 * in_body[0] - e0 * in_body[2])
            dy[r, 18] = b0 * d_body[1] - b1 * d_body[0] - lam * (e0 * in_body[1] - e1 * in_body[0])
            dy[r, 19], dy[r, 20], dy[r, 21] = dx0, dx1, dx2
            dy[r, 22] = -lam * (dx1 * w[2] - dx2 * w[1])
            dy[r, 23] = -lam * (dx2 * w[0] - dx0 * w[2])
            dy[r, 24] = -lam * (dx0 * w[1] - dx1 * w[0])
        for c in range(25):
            jac[0, c] = (dy[0, c] - y[0] / y[2] * dy[2, c]) / y[2]
            jac[1, c] = (dy[1, c] - y[1] / y[2] * dy[2, c]) / y[2]
        for k in range(_SEEN.size):
            a = _SEEN[k]
            ja, jb = weight[j] * jac[0, a], weight[j] * jac[1, a]
            for m in range(k, _SEEN.size):
                b = _SEEN[m]
                matrix[a, b] += ja * jac[0, b] + jb * jac[1, b]
            vector[a] += ja * out[j, 0] + jb * out[j, 1]
    for k in range(_SEEN.size):
        for m in range(k):
            matrix[_SEEN[k], _SEEN[m]] = matrix[_SEEN[m], _SEEN[k]]
    return out


@nb.njit(cache=True, error_model="numpy")
def _weigh(miss, base, focal, centred):  # type: ignore[no-untyped-def]
    # Cauchy weights of residuals (n, 2) about their median, or about zero; what is far off is left out.
    n = miss.shape[0]
    du = dv = 0.0
    if centred:
        du, dv = np.median(miss[:, 0]), np.median(miss[:, 1])
    size = np.empty(n)
    for j in range(n):
        size[j] = focal * math.hypot(miss[j, 0] - du, miss[j, 1] - dv)
    scale = max(0.5, 1.5 * np.median(size))
    weight = np.zeros(n)
    inliers = 0
    for j in range(n):
        if size[j] < 5.0 * scale:
            weight[j] = base[j] / (1.0 + (size[j] / scale) ** 2)
            inliers += 1
    return weight, inliers


@nb.njit(cache=True, error_model="numpy")
def _density(at, height, width):  # type: ignore[no-untyped-def]
    # Sum over points of bells of the given width, at equally spaced heights.
    out = np.zeros(at.size)
    step = at[1] - at[0]
    for j in range(height.size):
        reach = 6.0 * width[j]
        low = max(0, int((height[j] - reach - at[0]) / step))
        high = min(at.size, int((height[j] + reach - at[0]) / step) + 2)
        for i in range(low, high):
            out[i] += math.exp(-0.5 * ((at[i] - height[j]) / width[j]) ** 2) / width[j]
    return out


def ground_layer(height_m: FloatArray, sigma_m: FloatArray, least_share: float = 0.35) -> float | None:
    """Height of the slowest layer: the lowest peak of the density of heights that is not much below the highest one.

    Args:
        height_m: (n,) heights of points from their parallax, metres.
        sigma_m: (n,) their standard deviations.
        least_share: a peak counts when the density there is this share of the greatest density.

    None when there are fewer than eight points. Points on the ground all move alike and slowest; roofs move faster, each
    at its own height, so the ground is the lowest crowd, not the biggest.
    """
    if len(height_m) < 8:
        return None
    width = np.maximum(sigma_m, 0.7)
    low, high = np.percentile(height_m, [1.0, 99.0])
    at = np.arange(low - 3.0, min(high, low + 150.0) + 3.5, 0.5)
    density = _density(at, np.asarray(height_m, dtype=np.float64), width)
    inner = density[1:-1]
    peak = (inner >= density[:-2]) & (inner > density[2:]) & (inner >= least_share * density.max())
    where = np.flatnonzero(peak)
    return float(at[1 + where[0]]) if where.size else float(at[int(density.argmax())])


# ---------------------------------------------------------------- the filter


class _Points:
    """What the filter knows of each tracked point, row by row with the tracker's."""

    def __init__(self) -> None:
        self.key_ray: FloatArray = np.empty((0, 3))  # in the keyframe's camera; NaN when not seen there
        self.first_level: FloatArray = np.empty((0, 2))  # x / depth, y / depth in level axes where first seen
        self.first_place: FloatArray = np.empty((0, 3))
        self.height: FloatArray = np.empty(0)
        self.sigma: FloatArray = np.empty(0)  # inf until there is parallax

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        for name in vars(self):
            setattr(self, name, getattr(self, name)[chosen])

    def add(self, level: FloatArray, place: FloatArray) -> None:
        n = len(level)
        self.key_ray = np.concatenate([self.key_ray, np.full((n, 3), np.nan)])
        self.first_level = np.concatenate([self.first_level, level])
        self.first_place = np.concatenate([self.first_place, np.repeat(place[None], n, axis=0)])
        self.height = np.concatenate([self.height, np.zeros(n)])
        self.sigma = np.concatenate([self.sigma, np.full(n, np.inf)])


class VioFilter:
    """The filter, frame by frame: ``start`` once, then ``frame`` for each image in order of time."""

    def __init__(
        self, camera: Camera, mount: Attitude, imu: Imu, settings: VioSettings | None = None
    ) -> None:
        self.camera, self.mount, self.imu = camera, mount, imu
        self.settings = s = settings or VioSettings()
        self.focal = 0.5 * (camera.fx + camera.fy)
        self.tracker = KltTracker(s.klt)
        self.points = _Points()
        self.rbc = mount.body_from_camera()
        self.delay = 0.0
        self.bore: FloatArray = np.eye(3)
        self.gyro_bias, self.accel_bias = np.zeros(3), np.zeros(3)
        self.omega = np.zeros(3)
        self.relief_walk = 0.0
        self.keyframes = 0
        self._relief_place = np.zeros(3)
        self._walk_key = 0.0
        self.segment = 0
        self._sure_walk = 0.0
        self._layer: float | None = None
        self._interval = 0.1
        self._last_t = -math.inf
        self._started = False
        self._anchor: tuple[FloatArray, FloatArray] | None = None
        self.cov: FloatArray = np.zeros((SIZE, SIZE))

    def start(self, t_s: float, agl_m: float, warm: VioFilter | None = None) -> None:
        """Level by the accelerometer's mean over half a second about ``t_s``; height from the altimeter.

        ``warm`` is a filter that has gone through the first seconds already: what it learnt is taken from it, and its
        attitude and velocity are followed back to the start through the IMU.
        """
        s = self.settings
        near = np.abs(self.imu.t_s - t_s) <= 0.5
        if not near.any():
            near = np.zeros(len(near), dtype=bool)
            near[int(np.abs(self.imu.t_s - t_s).argmin())] = True
        up = self.imu.accel_m_s2[near].mean(axis=0)
        roll = math.atan2(up[1], up[2])
        pitch = math.atan2(-up[0], math.hypot(up[1], up[2]))
        self.t = t_s + self.delay
        self.p = np.array([0.0, 0.0, agl_m])
        self.v = np.zeros(3)
        self.rot = Attitude(roll, pitch).matrix()
        sigma = np.zeros(SIZE)
        sigma[P + 2] = s.agl_sigma_m
        sigma[V : V + 3] = s.speed_sigma_m_s, s.speed_sigma_m_s, 3.0
        sigma[TH : TH + 2] = s.tilt_sigma_rad
        sigma[BG : BG + 3], sigma[BA : BA + 3] = s.gyro_bias_sigma, s.accel_bias_sigma
        sigma[TD], sigma[BS : BS + 3] = s.delay_sigma_s, s.boresight_sigma_rad
        if warm is not None:
            self.delay, self.bore = warm.delay, warm.bore
            self.gyro_bias, self.accel_bias = warm.gyro_bias, warm.accel_bias
            self.t = t_s + self.delay
            zero = np.zeros(3)
            first = warm.rot @ self._through_imu(zero, zero, np.eye(3), self.t, warm.t)[2].T
            speed = warm.v - self._through_imu(zero, zero, first, self.t, warm.t)[1]
            turn = Attitude(0.0, 0.0, -math.atan2(first[1, 0], first[0, 0])).matrix()
            self.rot, self.v = turn @ first, turn @ speed
            # Twice as unsure as it is, and by what the way back may have cost: the same frames are used again.
            more = np.zeros(SIZE)
            more[V : V + 3], more[TH : TH + 2] = 1.0, math.radians(0.1)
            more[TD], more[BS : BS + 3] = 0.002, math.radians(0.05)
            learnt = 2.0 * np.sqrt(np.maximum(np.diag(warm.cov), 0.0)) + more
            sigma[V:CP] = np.minimum(sigma, learnt)[V:CP]
        self.cov = np.diag(sigma**2)
        self._started = True
        self._clone()

    def frame(self, t_s: float, grey: NDArray[np.uint8], agl_m: float) -> tuple[int, bool]:
        """Take in one image (h, w) uint8 and a height; the number of points used, and whether the frame was blind."""
        s = self.settings
        if not self._started:
            self.start(t_s, agl_m)
        gap = t_s - self._last_t
        if math.isfinite(gap):
            self._interval += 0.1 * (min(gap, 1.0) - self._interval)
        self._last_t = t_s
        self._advance(t_s + self.delay)
        self._see_height(agl_m)
        if gap > s.max_gap_s:
            self.tracker.forget()
            self.points.keep(np.zeros(len(self.points.sigma), dtype=bool))
        alive = self.tracker.step(grey, self._expected())
        self.points.keep(alive)
        rays = ray_from_pixel(self.camera, self.tracker.px)
        self._estimate_heights(rays)
        used = self._update(rays)
        blind = used < s.min_tracks and math.isfinite(gap)
        if not blind:
            # Beyond that, where the aircraft is after a blind stretch is a guess: the track begins anew.
            sure = self.step_variance()
            if sure - self._sure_walk > s.lost_m**2:
                self.segment += 1
            self._sure_walk = sure
        if self.tracker.wants_anchor or blind:
            self._drop_strays(rays)
            rays = ray_from_pixel(self.camera, self.tracker.px)
            new = self.tracker.refill()
            if new:
                fresh = ray_from_pixel(self.camera, self.tracker.px[-new:])
                rays = np.concatenate([rays, fresh])
                self.points.add(self._level(fresh), self.p)
            self._anchor = (self.p.copy(), self.rot @ self.camera_mount)
            common = int(np.isfinite(self.points.key_ray[:, 0]).sum())
            flown = math.hypot(*(self.p - self.pk)[:2])
            if blind or common < 0.5 * len(rays) or flown > s.keyframe_share * self.p[2]:
                self._clone()
                self.points.key_ray = rays.copy()
        return used, blind

    @property
    def camera_mount(self) -> FloatArray:
        """(3, 3) body_from_camera with the boresight estimated so far."""
        return np.asarray(self.bore @ self.rbc)

    def step_variance(self) -> float:
        """Variance per axis gathered since the start, square metres, heading left out."""
        # Position against the keyframe, in axes that turn with the keyframe's heading.
        d = self.p - self.pk
        jac = np.zeros((2, SIZE))
        jac[:, P : P + 2] = np.eye(2)
        jac[:, CP : CP + 2] = -np.eye(2)
        jac[:, CT + 2] = d[1], -d[0]
        return self._walk_key + float(np.trace(jac @ self.cov @ jac.T)) / 2.0

    def _clone(self) -> None:
        if hasattr(self, "pk"):
            self._walk_key = self.step_variance()
        self.keyframes += 1
        self.pk, self.rk = self.p.copy(), self.rot.copy()
        select = np.zeros((SIZE, SIZE))
        select[:CP, :CP] = np.eye(CP)
        select[CP : CP + 3, P : P + 3] = np.eye(3)
        select[CT : CT + 3, TH : TH + 3] = np.eye(3)
        # The image was taken at a time that is known up to the delay's error.
        select[CP : CP + 3, TD] = self.v
        select[CT : CT + 3, TD] = self.rot @ self.omega
        self.cov = select @ self.cov @ select.T

    def _through_imu(self, p: FloatArray, v: FloatArray, rot: FloatArray, t0: float, t1: float) -> Any:
        s, imu = self.settings, self.imu
        noises = (s.gyro_noise, s.accel_noise, s.gyro_walk, s.accel_walk, s.ground_walk_m_sqrt_s)
        readings = (imu.t_s, imu.gyro_rad_s, imu.accel_m_s2)
        biases = (self.gyro_bias, self.accel_bias)
        return _propagate(p, v, rot, *biases, t0, t1, *readings, *(n**2 for n in noises))

    def _advance(self, t: float) -> None:
        if t <= self.t:
            return
        self.p, self.v, self.rot, phi, noise, self.omega = self._through_imu(
            self.p, self.v, self.rot, self.t, t
        )
        c = self.cov
        top = phi @ c[:15, 15:]
        c[:15, :15] = phi @ c[:15, :15] @ phi.T + noise
        c[:15, 15:] = top
        c[15:, :15] = top.T
        self.t = t

    def _correct(self, dx: FloatArray) -> None:
        self.p = self.p + dx[P : P + 3]
        self.v = self.v + dx[V : V + 3]
        self.rot = np.asarray(_exp(dx[TH : TH + 3]) @ self.rot)
        self.gyro_bias = self.gyro_bias + dx[BG : BG + 3]
        self.accel_bias = self.accel_bias + dx[BA : BA + 3]
        self.delay += float(dx[TD])
        self.bore = np.asarray(_exp(dx[BS : BS + 3]) @ self.bore)
        self.pk = self.pk + dx[CP : CP + 3]
        self.rk = np.asarray(_exp(dx[CT : CT + 3]) @ self.rk)

    def _see_height(self, agl_m: float) -> None:
        # One reading, its weight lowered where it jumps: an altimeter over a roof.
        column = self.cov[:, P + 2]
        innovation = agl_m - self.p[2]
        # Readings come with every frame but err together: ten a second count as one a second or two.
        noise = self.settings.agl_sigma_m**2 * max(1.0, 0.5 / max(self._interval, 0.02))
        limit = 3.0 * math.sqrt(float(column[P + 2]) + self.settings.agl_sigma_m**2)
        noise *= max(1.0, abs(innovation) / limit) ** 2
        total = float(column[P + 2]) + noise
        gain = column / total
        self.cov = self.cov - np.outer(gain, column)
        self._correct(gain * innovation)

    def _level(self, rays: FloatArray) -> FloatArray:
        # (n, 2) where rays meet a plane one metre below, in the odometry frame's axes.
        world = rays @ (self.rot @ self.camera_mount).T
        return np.asarray(world[:, :2] / np.maximum(-world[:, 2:3], 1e-3))

    def _expected(self) -> FloatArray | None:
        # Where the points should be now, by the poses at the anchor and now.
        if self._anchor is None or not len(self.tracker.px):
            return None
        place, cam = self._anchor
        world = ray_from_pixel(self.camera, self.tracker.anchor_px) @ cam.T
        height = np.where(np.isfinite(self.points.sigma), self.points.height, 0.0)
        reach = (place[2] - height) / np.maximum(-world[:, 2], 1e-3)
        now = (place + world * reach[:, None] - self.p) @ (self.rot @ self.camera_mount)
        return pixel_from_ray(self.camera, now)

    def _estimate_heights(self, rays: FloatArray) -> None:
        pts = self.points
        if not self.settings.slowest_layer or not len(pts.sigma):
            return
        level = self._level(rays)
        moved = pts.first_level - level
        length2 = (moved**2).sum(axis=1)
        d = self.p - pts.first_place
        excess = pts.first_place[:, 2:3] * pts.first_level - self.p[2] * level - d[:, :2]
        enough = np.sqrt(length2) * self.focal > 12.0
        safe = np.where(enough, length2, 1.0)
        pts.height = np.where(enough, (excess * moved).sum(axis=1) / safe, 0.0)
        pts.sigma = np.where(enough, self.p[2] / self.focal / np.sqrt(safe), np.inf)
        sure = pts.sigma < 6.0
        if sure.sum() >= 20:
            layer = ground_layer(pts.height[sure], pts.sigma[sure])
            # One frame's crowd may be a roof: the layer moves slowly.
            if layer is not None:
                self._layer = layer if self._layer is None else self._layer + 0.3 * (layer - self._layer)
        else:
            self._layer = None

    def _high(self) -> NDArray[np.bool_]:
        # Points that are clearly not on the ground layer.
        pts = self.points
        if self._layer is None:
            return np.zeros(len(pts.sigma), dtype=bool)
        off = pts.height - self._layer
        clear = np.maximum(self.settings.layer_m, 2.0 * np.minimum(pts.sigma, 1e6))
        return np.asarray((off > clear) | (off < -2.0 * clear))

    def _weights(self, used: NDArray[np.int64]) -> FloatArray:
        s = self.settings
        # Heights that are not known yet count as those of ordinary houses.
        height_sigma = np.full(len(used), s.unevenness_m)
        if s.slowest_layer:
            height_sigma = np.hypot(s.unevenness_m, np.minimum(self.points.sigma[used], 5.0) * 0.5)
        flown_px = self.focal * math.hypot(*(self.p - self.pk)[:2]) / self.p[2]
        sigma_px = np.hypot(s.pixel_sigma, height_sigma / self.p[2] * flown_px)
        # The same points err the same way in the next frame: more frames a second are no more information.
        rate = max(1.0, 1.0 / max(self._interval, 0.02))
        return np.asarray((self.focal / sigma_px) ** 2 / rate)

    def _update(self, rays: FloatArray) -> int:
        s = self.settings
        pts = self.points
        usable = np.isfinite(pts.key_ray[:, 0])
        ground = usable & ~self._high()
        if ground.sum() >= s.min_tracks:
            usable = ground
        # A point that has not moved far yet may be a roof as well.
        sure = ground & (pts.sigma < 2.0 * s.layer_m)
        if self._layer is not None and sure.sum() >= 2 * s.min_tracks:
            usable = sure
        chosen = np.flatnonzero(usable).astype(np.int64)
        if len(chosen) < s.min_tracks:
            return 0
        self._note_relief(chosen)
        key, seen = np.ascontiguousarray(pts.key_ray[chosen]), np.ascontiguousarray(rays[chosen, :2])
        base = self._weights(chosen)
        weight = np.zeros(len(chosen))
        prior = {name: getattr(self, name) for name in _CORRECTED}
        total = np.zeros(SIZE)
        posterior = self.cov
        for turn in range(2):
            matrix, vector = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
            arguments = (self.p, self.rot, self.pk, self.rk, self.camera_mount, self.v, self.omega, key, seen)
            miss = _tie(*arguments, np.zeros(len(chosen)), matrix, vector)
            miss = np.where(np.isfinite(miss), miss, 1e3)  # a ray that does not meet the ground
            weight, inliers = _weigh(miss, base, self.focal, turn == 0)
            if inliers < s.min_tracks:
                vars(self).update(prior)
                return 0
            _tie(*arguments, weight, matrix, vector)
            vector += matrix @ total
            gain = np.linalg.solve(np.eye(SIZE) + self.cov @ matrix, self.cov)
            total = gain @ vector
            vars(self).update(prior)
            self._correct(total)
            posterior = (gain + gain.T) / 2.0
        self.cov = posterior
        return int(inliers)

    def _note_relief(self, chosen: NDArray[np.int64]) -> None:
        # What is taken for ground lies at several heights, more than these err: low roofs are among it, and their mean
        # is not the ground's. That lengthens steps, alike over RELIEF_LENGTH of the height and then anew.
        height, sigma = self.points.height[chosen], self.points.sigma[chosen]
        known = sigma < 3.0
        relief = 0.0
        if known.sum() >= 8:
            relief = max(0.0, float(height[known].var()) - float(np.median(sigma[known])) ** 2)
        moved = math.hypot(*(self.p - self._relief_place)[:2])
        self.relief_walk += RELIEF_LENGTH * relief * moved / max(float(self.p[2]), 1.0)
        self._relief_place = self.p.copy()

    def _drop_strays(self, rays: FloatArray) -> None:
        # Points below the ground or far from where the plane, or their height, puts them: moving cars, wrong matches.
        pts = self.points
        if self._layer is None:
            return
        stray = np.isfinite(pts.sigma) & (
            pts.height - self._layer < -np.maximum(4.0, 4.0 * np.minimum(pts.sigma, 1e6))
        )
        self.tracker.keep(~stray)
        pts.keep(~stray)


def run_vio(
    times_s: FloatArray,
    images: Iterable[NDArray[np.uint8]],
    agl_m: FloatArray,
    imu: Imu,
    camera: Camera,
    mount: Attitude,
    settings: VioSettings | None = None,
) -> VioResult:
    """Odometry of a flight from its images, IMU and heights.

    Args:
        times_s: (n,) float64 times of the frames, increasing, seconds.
        images: n grey frames, (h, w) uint8, raw (distorted) as the camera gives them.
        agl_m: (n,) height above ground at the frames.
        imu: readings in the body frame over the whole time.
        camera, mount: the camera and how it sits in the body.

    Raises ValueError when there are fewer than two frames or IMU readings, GyroInDegreesError where the first pictures
    tell that the gyro is not in radians.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if len(times) < 2 or len(imu.t_s) < 2:
        raise ValueError(f"{len(times)} frames and {len(imu.t_s)} IMU readings: two of each are needed")
    imu = Imu(*(np.ascontiguousarray(a, dtype=np.float64) for a in (imu.t_s, imu.gyro_rad_s, imu.accel_m_s2)))
    vio = VioFilter(camera, mount, imu, settings)
    images = _warmed(vio, times, iter(images), np.asarray(agl_m, dtype=np.float64))
    n = len(times)
    xyz, turned, velocity = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3))
    walk, relief, yaw_sigma = np.empty(n), np.empty(n), np.empty(n)
    key = np.zeros(n, dtype=np.int64)
    tracks, blind = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.bool_)
    segment = np.zeros(n, dtype=np.int64)
    high = 0.0
    for i, grey in enumerate(images):
        tracks[i], blind[i] = vio.frame(float(times[i]), grey, float(agl_m[i]))
        xyz[i], velocity[i], segment[i] = vio.p, vio.v, vio.segment
        turned[i] = vio.rot
        walk[i], relief[i], key[i] = vio.step_variance(), vio.relief_walk, vio.keyframes
        yaw_sigma[i] = math.sqrt(max(0.0, float(vio.cov[TH + 2, TH + 2])))
        high += float(vio._high().mean()) if len(vio.points.sigma) else 0.0
    sigma = np.sqrt(np.maximum(np.diag(vio.cov), 0.0))
    wxyz = Rotation.from_matrix(turned).as_quat()[:, [3, 0, 1, 2]]
    return VioResult(
        Odometry(times, xyz, wxyz, "embedded visual-inertial odometry", segment),
        _even(times, walk, key, blind) + relief,
        yaw_sigma,
        tracks,
        blind,
        velocity,
        vio.delay,
        float(sigma[TD]),
        Rotation.from_matrix(vio.bore).as_rotvec(),
        sigma[BS : BS + 3],
        vio.gyro_bias,
        vio.accel_bias,
        high / n,
    )


def _even(
    times: FloatArray, walk: FloatArray, key: NDArray[np.int64], blind: NDArray[np.bool_]
) -> FloatArray:
    # Within a keyframe the variance against it is no sum of steps: it rises at once and then falls with every new frame.
    # Each step bears its share of the whole, but what a blind stretch cost stays there.
    knot = np.diff(key, prepend=-1) != 0
    knot[-1] = True
    knot |= blind
    knot[:-1] |= blind[1:]
    at = np.flatnonzero(knot)
    return np.asarray(np.interp(times, times[at], np.maximum.accumulate(walk[at])))


class GyroInDegreesError(ValueError):
    """The gyro tells the turns that the pictures show, about 57 times over."""


def coarse_delay(
    times_s: FloatArray, images: Sequence[NDArray[np.uint8]], imu: Imu, camera: Camera, mount: Attitude
) -> float:
    """IMU time minus camera time in seconds, to a few hundredths, within +-``MAX_DELAY_S``; 0 where it cannot be told.

    The aircraft's wobble shifts the whole picture, and the gyro reads it as well: the shift from picture to picture (phase
    correlation: Kuglin & Hines 1975), without its slow part, is held against the gyro's at every delay. The filter's own
    estimate is fine, but it finds only delays that are short against the wobble.

    Args:
        times_s: (n,) of the pictures; images: n grey (h, w) uint8.
        camera, mount, imu: as for ``run_vio``.

    Raises GyroInDegreesError where the shifts by the gyro are those of the pictures, but some 57 times as large.
    """
    n = len(images)
    if n < 30 or times_s[n - 1] - times_s[0] < 6.0:
        return 0.0
    factor = max(1, round(camera.width / 240))
    small = [cv2.resize(g, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA) for g in images]
    window = cv2.createHanningWindow((small[0].shape[1], small[0].shape[0]), cv2.CV_32F)
    floats = [np.asarray(g, dtype=np.float32) for g in small]
    flow = np.array([cv2.phaseCorrelate(a, b, window)[0] for a, b in itertools.pairwise(floats)]) * factor
    half = max(2, round(1.0 / float(np.median(np.diff(times_s)))))
    seen = _without_slow(flow, half)
    # Pictures that jumped (a wrong peak) must not decide.
    most = 4.0 * float(np.median(np.abs(seen)))
    seen = np.clip(seen, -most, most)
    turned = np.zeros((len(imu.t_s), 3))
    turned[1:] = np.cumsum(
        0.5 * (imu.gyro_rad_s[1:] + imu.gyro_rad_s[:-1]) * np.diff(imu.t_s)[:, None], axis=0
    )
    turned = turned @ mount.body_from_camera()
    delays = np.arange(-MAX_DELAY_S, MAX_DELAY_S + 0.01, 0.02)
    fits, scales = np.empty(len(delays)), np.empty(len(delays))
    for k, delay in enumerate(delays):
        at = np.stack([np.interp(times_s[:n] + delay, imu.t_s, turned[:, c]) for c in range(3)], axis=-1)
        step = np.diff(at, axis=0)
        told = _without_slow(np.stack([-camera.fx * step[:, 1], camera.fy * step[:, 0]], axis=-1), half)
        fits[k] = (seen * told).sum() / max(float(np.sqrt((told**2).sum() * (seen**2).sum())), 1e-9)
        scales[k] = (told**2).sum() / max(float((seen * told).sum()), 1e-9)
    best, none = int(fits.argmax()), int(np.abs(delays).argmin())
    if fits[best] > 0.5 and 20.0 < scales[best] < 170.0:
        raise GyroInDegreesError(
            f"the gyro turns {scales[best]:.0f} times as fast as the pictures: it is in degrees"
        )
    sure = fits[best] > 0.5 and fits[best] > fits[none] + 0.1
    return float(delays[best]) if sure else 0.0


def _without_slow(values: FloatArray, half: int) -> FloatArray:
    # (n, 2) minus its mean over 2 half + 1 rows.
    kernel = np.ones(2 * half + 1)
    count = np.convolve(np.ones(len(values)), kernel, "same")
    return values - np.stack([np.convolve(v, kernel, "same") / count for v in values.T], axis=-1)


def _warmed(
    vio: VioFilter, times: FloatArray, images: Iterator[NDArray[np.uint8]], agl_m: FloatArray
) -> Iterator[NDArray[np.uint8]]:
    # Starts ``vio`` with what a first filter makes of the first seconds; all the images, those first ones again.
    first: list[NDArray[np.uint8]] = []
    for _ in range(int(np.searchsorted(times, times[0] + vio.settings.warm_s))):
        grey = next(images, None)
        if grey is None:
            break
        first.append(grey)
        if len(first) * grey.nbytes > WARM_BYTES:
            break
    n = len(first)
    if n and vio.settings.delay_sigma_s > 0.0:
        vio.delay = coarse_delay(times, first, vio.imu, vio.camera, vio.mount)
    # A short beginning teaches nothing, and neither does a blind one.
    if n > 1 and times[n - 1] - times[0] >= 0.25 * vio.settings.warm_s:
        warm = VioFilter(vio.camera, vio.mount, vio.imu, vio.settings)
        warm.delay = vio.delay
        blind = [warm.frame(float(times[i]), first[i], float(agl_m[i]))[1] for i in range(n)]
        if sum(blind) <= 0.1 * n and not blind[-1]:
            vio.start(float(times[0]), float(agl_m[0]), warm)
    return itertools.chain(first, images)
