"""Odometry from pictures and attitude alone: features matched between frames, levelled onto the ground, moved rigidly.

Without an IMU nothing bridges what the pictures do not show, and levelling errors of the attitude go straight into the
steps: a degree of error that changes between two frames is 2.6 m at 150 m. Each step says how sure it is.

Sources: features: Lowe, "Distinctive Image Features from Scale-Invariant Keypoints" (IJCV 2004), with RootSIFT (Arandjelovic
& Zisserman, CVPR 2012); consensus: Fischler & Bolles, "Random Sample Consensus" (CACM 1981); rigid fit: Umeyama (PAMI
1991) with the scale held, because height above ground gives it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.camera import level_from_camera, ray_from_pixel
from brmgeo.flight.frames import quaternion_from_euler
from brmgeo.flight.motion import RESET_SPEED_M_S
from brmgeo.flight.readings import Attitude, Camera, FloatArray, Odometry


@dataclass(frozen=True, slots=True)
class PlanarSettings:
    """How frames are matched and what a step is worth.

    Attributes:
        features: kept a frame.
        ratio: Lowe's ratio of nearest to second nearest.
        inlier_m: a match agrees with a movement within this on the ground, per 100 m of height.
        min_inliers: with fewer agreeing matches there is no step.
        keyframe_share: frames are matched to a keyframe until it is this share of the height behind.
        attitude_sigma_rad: of roll and pitch, each frame anew; None estimates nothing and takes 0.3 deg.
        min_interval_s: frames that follow the last one matched sooner are passed over.
        max_speed_m_s: faster steps are refused.
    """

    features: int = 1500
    ratio: float = 0.8
    inlier_m: float = 1.5
    min_inliers: int = 15
    keyframe_share: float = 0.15
    attitude_sigma_rad: float = math.radians(0.3)
    min_interval_s: float = 0.5
    max_speed_m_s: float = RESET_SPEED_M_S


@dataclass(frozen=True, slots=True)
class PlanarResult:
    """Poses of the frames that were matched, and what their steps are worth.

    Attributes:
        odometry: level poses with the given roll and pitch; ``segment`` grows where frames could not be joined.
        rows: (n,) which frames these are.
        walk_m2: (n,) variance per axis gathered by the steps.
        inliers: (n,) matches that agreed.
    """

    odometry: Odometry
    rows: NDArray[np.int64]
    walk_m2: FloatArray
    inliers: NDArray[np.int64]


def rigid_fit(a: FloatArray, b: FloatArray) -> tuple[float, FloatArray]:
    """Angle (counter-clockwise, radians) and shift (2,) that take points ``a`` (n, 2) to ``b`` with least squares."""
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    za, zb = (a - ca) @ [1.0, 1.0j], (b - cb) @ [1.0, 1.0j]
    angle = float(np.angle(np.vdot(za, zb)))
    c, s = math.cos(angle), math.sin(angle)
    return angle, np.asarray(cb - [c * ca[0] - s * ca[1], s * ca[0] + c * ca[1]])


def consensus(
    a: FloatArray, b: FloatArray, tolerance: float, seed: int = 0, draws: int = 400
) -> NDArray[np.bool_]:
    """(n,) bool: the matches a -> b (n, 2) that agree with one rigid movement within ``tolerance``."""
    n = len(a)
    if n < 2:
        return np.zeros(n, dtype=np.bool_)
    rng = np.random.default_rng(seed)
    za, zb = a @ [1.0, 1.0j], b @ [1.0, 1.0j]
    pick = rng.integers(0, n, (draws, 2))
    ea, eb = za[pick[:, 1]] - za[pick[:, 0]], zb[pick[:, 1]] - zb[pick[:, 0]]
    # Two points that are close together, or whose distance changed, tell nothing of the rotation.
    good = (np.abs(ea) > 10.0 * tolerance) & (np.abs(np.abs(ea) - np.abs(eb)) < 2.0 * tolerance)
    if not good.any():
        return np.zeros(n, dtype=np.bool_)
    turn = (eb[good] / ea[good]) / np.abs(eb[good] / ea[good])
    shift = zb[pick[good, 0]] - turn * za[pick[good, 0]]
    miss = np.abs(turn[:, None] * za + shift[:, None] - zb)
    cost = np.minimum(miss, tolerance).sum(axis=1)
    inlier = miss[int(cost.argmin())] < tolerance
    for _ in range(3):
        if inlier.sum() < 2:
            break
        angle, move = rigid_fit(a[inlier], b[inlier])
        inlier = np.abs(za * np.exp(1j * angle) + move @ [1.0, 1.0j] - zb) < tolerance
    return np.asarray(inlier)


@dataclass(slots=True)
class _Shot:
    row: int
    ground: FloatArray  # (n, 2) ahead and left of the point below the camera, metres
    descriptors: NDArray[np.float32]
    place: FloatArray
    yaw: float


def run_planar(
    times_s: FloatArray,
    images: Iterable[NDArray[np.uint8]],
    agl_m: FloatArray,
    roll_rad: FloatArray,
    pitch_rad: FloatArray,
    camera: Camera,
    mount: Attitude,
    settings: PlanarSettings | None = None,
) -> PlanarResult:
    """Odometry of a flight from its images, attitude and heights.

    Args:
        times_s: (n,) float64, increasing, seconds.
        images: n grey frames (h, w) uint8, raw as the camera gives them.
        agl_m, roll_rad, pitch_rad: (n,) at the frames.
        camera, mount: the camera and how it sits in the body.

    The yaw is 0 and x = y = 0 at the first frame; z is the height above ground.
    """
    s = settings or PlanarSettings()
    sift = cv2.SIFT.create(nfeatures=s.features, contrastThreshold=0.02)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    rows: list[int] = []
    places: list[FloatArray] = []
    yaws: list[float] = []
    segments: list[int] = []
    walks: list[float] = []
    counts: list[int] = []
    key: _Shot | None = None
    last: _Shot | None = None
    walk_key, segment = 0.0, 0
    walk_last = 0.0
    for row, grey in enumerate(images):
        if last is not None and times_s[row] - times_s[last.row] < s.min_interval_s:
            continue
        shot = _look(
            sift, grey, row, float(agl_m[row]), float(roll_rad[row]), float(pitch_rad[row]), camera, mount
        )
        found, joined = 0, True
        walk = walk_last
        if key is not None and last is not None:
            step, base = _join(matcher, key, shot, float(agl_m[row]), s), key
            if step is None and last is not key:
                key, walk_key = last, walk_last
                step, base = _join(matcher, key, shot, float(agl_m[row]), s), key
            if step is not None:
                c, n = math.cos(base.yaw), math.sin(base.yaw)
                move = step[1]
                shot.place = base.place + [c * move[0] - n * move[1], n * move[0] + c * move[1]]
                shot.yaw = base.yaw + step[0]
                fast = np.hypot(*(shot.place - last.place)) > s.max_speed_m_s * (
                    times_s[row] - times_s[last.row]
                )
                joined = not fast
                found = step[2]
                walk = walk_key + step[3]
            else:
                joined = False
            if not joined:
                segment += 1
                shot.place, shot.yaw, walk = last.place.copy(), last.yaw, walk_last
        rows.append(row)
        places.append(shot.place)
        yaws.append(shot.yaw)
        segments.append(segment)
        walks.append(walk)
        counts.append(found)
        last, walk_last = shot, walk
        if key is None or not joined or np.hypot(*(shot.place - key.place)) > s.keyframe_share * agl_m[row]:
            key, walk_key = shot, walk
    at = np.array(rows, dtype=np.int64)
    quaternions = quaternion_from_euler(np.asarray(roll_rad)[at], np.asarray(pitch_rad)[at], np.array(yaws))
    xyz = np.concatenate([np.array(places), np.asarray(agl_m)[at][:, None]], axis=1)
    odometry = Odometry(
        np.asarray(times_s)[at], xyz, quaternions, "embedded planar odometry", np.array(segments)
    )
    return PlanarResult(
        odometry, at, np.maximum.accumulate(np.array(walks)), np.array(counts, dtype=np.int64)
    )


def _look(
    sift: cv2.SIFT,
    grey: NDArray[np.uint8],
    row: int,
    agl_m: float,
    roll: float,
    pitch: float,
    camera: Camera,
    mount: Attitude,
) -> _Shot:
    points, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None or not len(points):
        return _Shot(row, np.empty((0, 2)), np.empty((0, 128), np.float32), np.zeros(2), 0.0)
    uv = np.array([p.pt for p in points], dtype=np.float64)
    rays = ray_from_pixel(camera, uv) @ level_from_camera(mount, roll, pitch).T
    # Near the horizon a pixel is many metres: leave that out.
    down = rays[:, 2] < -0.35 * np.linalg.norm(rays, axis=1)
    ground = rays[down, :2] * (agl_m / -rays[down, 2:3])
    root = np.sqrt(descriptors[down] / np.maximum(descriptors[down].sum(axis=1, keepdims=True), 1e-6))
    return _Shot(row, ground, root.astype(np.float32), np.zeros(2), 0.0)


def _join(
    matcher: cv2.BFMatcher, a: _Shot, b: _Shot, agl_m: float, s: PlanarSettings
) -> tuple[float, FloatArray, int, float] | None:
    # Yaw change, step in a's axes, inliers and variance per axis; None when the frames do not match.
    if len(a.ground) < s.min_inliers or len(b.ground) < s.min_inliers:
        return None
    pairs = matcher.knnMatch(b.descriptors, a.descriptors, k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < s.ratio * p[1].distance]
    if len(good) < s.min_inliers:
        return None
    from_b = b.ground[[m.queryIdx for m in good]]
    to_a = a.ground[[m.trainIdx for m in good]]
    tolerance = s.inlier_m * agl_m / 100.0
    inlier = consensus(from_b, to_a, tolerance)
    count = int(inlier.sum())
    if count < s.min_inliers:
        return None
    angle, shift = rigid_fit(from_b[inlier], to_a[inlier])
    c, n = math.cos(angle), math.sin(angle)
    moved = from_b[inlier] @ np.array([[c, n], [-n, c]]) + shift
    spread = float(((moved - to_a[inlier]) ** 2).sum(axis=1).mean()) / 2.0
    # What levelling errs in either frame moves the point below the camera; matches err a little each, and together.
    variance = 2.0 * (agl_m * s.attitude_sigma_rad) ** 2 + spread / count + (0.1 * tolerance) ** 2
    return angle, shift, count, variance
