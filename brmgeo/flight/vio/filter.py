"""The error-state filter: what it knows, and how one frame, one height and the IMU change it.

Buildings break the plane. Every point's height above it is estimated from its own parallax since it was first seen;
the ground is the slowest layer, the lowest well-filled one, and points clearly above it are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.camera import pixel_from_ray, ray_from_pixel
from brmgeo.flight.klt import KltSettings, KltTracker
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Imu
from brmgeo.flight.vio.kernels import (
    BA,
    BG,
    BS,
    CP,
    CT,
    SIZE,
    TD,
    TH,
    P,
    V,
    exp,
    ground_layer,
    propagate,
    tie,
    weigh,
)

#: The accelerometer levels the filter by its mean over this long before and after the first frame.
LEVEL_S = 0.5
# Share of the height over which the ground's unevenness pulls steps the same way; by the errors of simulated flights.
RELIEF_LENGTH = 0.18
# The filter's attributes that a correction replaces; it makes new arrays and leaves the old ones as they are.
_CORRECTED = ("p", "v", "rot", "gyro_bias", "accel_bias", "delay", "bore", "pk", "rk")


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
            known when points are first seen (at most 256 MB of frames); 0: once.
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
        self.started = False
        self._anchor: tuple[FloatArray, FloatArray] | None = None
        self.cov: FloatArray = np.zeros((SIZE, SIZE))

    def start(self, t_s: float, agl_m: float, warm: VioFilter | None = None) -> None:
        """Level by the accelerometer's mean over half a second about ``t_s``; height from the altimeter.

        ``warm`` is a filter that has gone through the first seconds already: what it learnt is taken from it, and its
        attitude and velocity are followed back to the start through the IMU.
        """
        s = self.settings
        near = np.abs(self.imu.t_s - t_s) <= LEVEL_S
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
            first = warm.rot @ self.through_imu(zero, zero, np.eye(3), self.t, warm.t)[2].T
            speed = warm.v - self.through_imu(zero, zero, first, self.t, warm.t)[1]
            turn = Attitude(0.0, 0.0, -math.atan2(first[1, 0], first[0, 0])).matrix()
            self.rot, self.v = turn @ first, turn @ speed
            # Twice as unsure as it is, and by what the way back may have cost: the same frames are used again.
            more = np.zeros(SIZE)
            more[V : V + 3], more[TH : TH + 2] = 1.0, math.radians(0.1)
            more[TD], more[BS : BS + 3] = 0.002, math.radians(0.05)
            learnt = 2.0 * np.sqrt(np.maximum(np.diag(warm.cov), 0.0)) + more
            sigma[V:CP] = np.minimum(sigma, learnt)[V:CP]
        self.cov = np.diag(sigma**2)
        self.started = True
        self._clone()

    def frame(self, t_s: float, grey: NDArray[np.uint8], agl_m: float) -> tuple[int, bool]:
        """Take in one image (h, w) uint8 and a height; the number of points used, and whether the frame was blind."""
        s = self.settings
        if not self.started:
            self.start(t_s, agl_m)
        gap = t_s - self._last_t
        if math.isfinite(gap):
            self._interval += 0.1 * (min(gap, 1.0) - self._interval)
        self._last_t = t_s
        self.advance(t_s + self.delay)
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

    def through_imu(self, p: FloatArray, v: FloatArray, rot: FloatArray, t0: float, t1: float) -> Any:
        """Position, velocity (3,) and attitude (3, 3) from IMU time ``t0`` to ``t1``, and what ``propagate`` gives more."""
        s, imu = self.settings, self.imu
        return propagate(
            p=p,
            v=v,
            rot=rot,
            bg=self.gyro_bias,
            ba=self.accel_bias,
            t0=t0,
            t1=t1,
            it=imu.t_s,
            gyro=imu.gyro_rad_s,
            accel=imu.accel_m_s2,
            qg=s.gyro_noise**2,
            qa=s.accel_noise**2,
            qbg=s.gyro_walk**2,
            qba=s.accel_walk**2,
            qz=s.ground_walk_m_sqrt_s**2,
        )

    def advance(self, t: float) -> None:
        """Follow the IMU to its time ``t``; nothing where the filter is there already."""
        if t <= self.t:
            return
        self.p, self.v, self.rot, phi, noise, self.omega = self.through_imu(
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
        self.rot = np.asarray(exp(dx[TH : TH + 3]) @ self.rot)
        self.gyro_bias = self.gyro_bias + dx[BG : BG + 3]
        self.accel_bias = self.accel_bias + dx[BA : BA + 3]
        self.delay += float(dx[TD])
        self.bore = np.asarray(exp(dx[BS : BS + 3]) @ self.bore)
        self.pk = self.pk + dx[CP : CP + 3]
        self.rk = np.asarray(exp(dx[CT : CT + 3]) @ self.rk)

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

    def high(self) -> NDArray[np.bool_]:
        """(n,) bool: points that are clearly not on the ground layer."""
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
        ground = usable & ~self.high()
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
            state = {
                "p": self.p,
                "rot": self.rot,
                "pk": self.pk,
                "rotk": self.rk,
                "rbc": self.camera_mount,
                "vel": self.v,
                "omega": self.omega,
                "rays": key,
                "seen": seen,
                "matrix": matrix,
                "vector": vector,
            }
            miss = tie(**state, weight=np.zeros(len(chosen)))
            miss = np.where(np.isfinite(miss), miss, 1e3)  # a ray that does not meet the ground
            weight, inliers = weigh(miss, base, self.focal, turn == 0)
            if inliers < s.min_tracks:
                vars(self).update(prior)
                return 0
            tie(**state, weight=weight)
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
