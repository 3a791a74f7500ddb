"""The camera as geometry: pixels, rays and the ground.

Rotations are (3, 3) and named destination_from_source; see ``brmgeo.flight.readings`` for the frames and the pixel
convention (OpenCV's: centres are whole numbers). The distortion model is OpenCV's: radial k1, k2, k3, tangential
p1, p2 (OpenCV documentation, "Camera Calibration and 3D Reconstruction").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.readings import Attitude, Camera, FloatArray


def level_from_camera(mount: Attitude, roll_rad: float, pitch_rad: float) -> FloatArray:
    """(3, 3) rotation from the optical frame to the level frame (x ahead, y left, z up) of the aircraft."""
    return Attitude(roll_rad, pitch_rad).matrix() @ mount.body_from_camera()


def world_from_camera(mount: Attitude, roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """(3, 3) rotation from the optical frame to ENU; yaw counter-clockwise from east."""
    return Attitude(roll_rad, pitch_rad, yaw_rad).matrix() @ mount.body_from_camera()


def slant_gsd_m(camera: Camera, mount: Attitude, roll_rad: float, pitch_rad: float, agl_m: float) -> float:
    """Metres per pixel at the middle of a frame: height over focal length, along the camera's slant."""
    axis = level_from_camera(mount, roll_rad, pitch_rad)[:, 2]
    return float(agl_m / math.sqrt(camera.fx * camera.fy) / max(-axis[2], 0.25))


def distort(camera: Camera, xy: FloatArray) -> FloatArray:
    """(..., 2) distorted normalised image coordinates from (..., 2) ideal ones (x / z, y / z)."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(camera: Camera, xy: FloatArray, iterations: int = 30) -> FloatArray:
    """(..., 2) ideal normalised coordinates from distorted ones, by Newton steps on ``distort``.

    Raises ValueError where the model cannot be inverted: the coefficients fold the image over itself.
    """
    goal = np.asarray(xy, dtype=np.float64)
    if not camera.is_distorted:
        return goal.copy()
    ideal = goal.copy()
    step = 1e-6
    for _ in range(iterations):
        here = distort(camera, ideal)
        miss = goal - here
        if np.abs(miss).max(initial=0.0) < 1e-12:
            break
        jx = (distort(camera, ideal + [step, 0.0]) - here) / step
        jy = (distort(camera, ideal + [0.0, step]) - here) / step
        det = jx[..., 0] * jy[..., 1] - jx[..., 1] * jy[..., 0]
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        ideal = ideal + np.stack(
            [
                (jy[..., 1] * miss[..., 0] - jy[..., 0] * miss[..., 1]) / det,
                (jx[..., 0] * miss[..., 1] - jx[..., 1] * miss[..., 0]) / det,
            ],
            axis=-1,
        )
    here = distort(camera, ideal)
    outward = (here * ideal).sum(axis=-1) >= 0.0
    if not (np.abs(goal - here).max(initial=0.0) < 1e-8 and outward.all()):
        raise ValueError(
            "the distortion coefficients fold the image over itself: no ray belongs to some pixels"
        )
    return ideal


def ray_from_pixel(camera: Camera, uv: FloatArray) -> FloatArray:
    """(..., 3) rays in the optical frame with z = 1 from (..., 2) pixels (u, v)."""
    uv = np.asarray(uv, dtype=np.float64)
    bent = np.stack([(uv[..., 0] - camera.cx) / camera.fx, (uv[..., 1] - camera.cy) / camera.fy], axis=-1)
    ideal = undistort(camera, bent)
    return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)


def pixel_from_ray(camera: Camera, rays: FloatArray) -> FloatArray:
    """(..., 2) pixels (u, v) from (..., 3) rays in the optical frame; NaN for rays that do not point into the scene."""
    rays = np.asarray(rays, dtype=np.float64)
    z = rays[..., 2:3]
    ahead = z > 1e-9
    bent = distort(camera, rays[..., :2] / np.where(ahead, z, 1.0))
    uv = bent * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return np.where(ahead, uv, np.nan)


def pixel_from_point(
    camera: Camera, rotation: FloatArray, position: FloatArray, points: FloatArray
) -> FloatArray:
    """(..., 2) pixels of (..., 3) points; ``rotation`` is points_from_camera, ``position`` the camera's (3,)."""
    return pixel_from_ray(camera, (np.asarray(points, dtype=np.float64) - position) @ rotation)


def ground_from_pixel(
    camera: Camera, rotation: FloatArray, position: FloatArray, uv: FloatArray, ground_z: float = 0.0
) -> FloatArray:
    """(..., 2) x, y where the pixels' rays meet the plane z = ``ground_z``; NaN for rays that never do."""
    rays = ray_from_pixel(camera, uv) @ rotation.T
    down = rays[..., 2:3] < -1e-9
    reach = (ground_z - position[2]) / np.where(down, rays[..., 2:3], -1.0)
    return np.where(down, position[:2] + rays[..., :2] * reach, np.nan)


def border_pixels(camera: Camera, per_side: int = 33) -> NDArray[np.float64]:
    """(4 * per_side, 2) pixels (u, v) around the image's outer edge."""
    left, right, top, bottom = -0.5, camera.width - 0.5, -0.5, camera.height - 0.5
    u, v = np.linspace(left, right, per_side), np.linspace(top, bottom, per_side)
    sides = [
        np.stack([u, np.full_like(u, top)], -1),
        np.stack([np.full_like(v, right), v], -1),
        np.stack([u[::-1], np.full_like(u, bottom)], -1),
        np.stack([np.full_like(v, left), v[::-1]], -1),
    ]
    return np.concatenate(sides)
