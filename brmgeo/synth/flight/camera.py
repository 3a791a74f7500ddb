"""What the camera of a simulated flight sees: masks with a network's errors, and pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from brmgeo.flight.camera import border_pixels, pixel_from_point, ray_from_pixel, world_from_camera
from brmgeo.flight.readings import Camera, FloatArray
from brmgeo.flight.values import View
from brmgeo.flight.view import make_view
from brmgeo.synth.flight.course import LATENT, MASK, PICTURE, RATE_HZ, Course
from brmgeo.synth.flight.ground import Imagery, RaisedFootprints
from brmgeo.synth.flight.settings import SimulationSettings


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _moved(x, y, field, field_box):  # type: ignore[no-untyped-def]
    # A vertex moved by the field (2, rows, cols): metres in x and y on a grid of field_box (left, bottom, spacing).
    gx = min(max((x - field_box[0]) / field_box[2], 0.0), field.shape[2] - 1.001)
    gy = min(max((y - field_box[1]) / field_box[2], 0.0), field.shape[1] - 1.001)
    c = int(gx)
    r = int(gy)
    a = gx - c
    b = gy - r
    wx = (field[0, r, c] * (1 - a) + field[0, r, c + 1] * a) * (1 - b)
    wx += (field[0, r + 1, c] * (1 - a) + field[0, r + 1, c + 1] * a) * b
    wy = (field[1, r, c] * (1 - a) + field[1, r, c + 1] * a) * (1 - b)
    wy += (field[1, r + 1, c] * (1 - a) + field[1, r + 1, c + 1] * a) * b
    return x + wx, y + wy


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _pixel(x, y, z, rot, lens, bend, max_r):  # type: ignore[no-untyped-def]
    # Image coordinates of a point relative to the camera; rot is world_from_camera.
    k1, k2, p1, p2, k3 = bend[0], bend[1], bend[2], bend[3], bend[4]
    ex = x * rot[0, 0] + y * rot[1, 0] + z * rot[2, 0]
    ey = x * rot[0, 1] + y * rot[1, 1] + z * rot[2, 1]
    ez = x * rot[0, 2] + y * rot[1, 2] + z * rot[2, 2]
    radius = math.sqrt(ex * ex + ey * ey)
    # Points far outside or behind the camera are drawn in to a circle around the frame: there they still bound
    # their polygon, and neither the horizon nor a folding distortion can bring them back into the picture.
    if radius > max_r * ez:
        ex *= max_r / radius
        ey *= max_r / radius
    else:
        ex /= ez
        ey /= ez
    r2 = ex * ex + ey * ey
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = (ex * radial + 2.0 * p1 * ex * ey + p2 * (r2 + 2.0 * ex * ex)) * lens[0] + lens[2]
    v = (ey * radial + p1 * (r2 + 2.0 * ey * ey) + 2.0 * p2 * ex * ey) * lens[1] + lens[3]
    return u, v


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _paint(  # type: ignore[no-untyped-def]
    xy,
    ring_start,
    polygon_start,
    chosen,
    values,
    heights,
    field,
    field_box,
    rot,
    position,
    lens,
    bend,
    max_r,
    image,
):
    # Polygons of the ground through the camera into the image, pixel-centre rule, even-odd within a polygon, later
    # ones over earlier ones.
    height, width = image.shape
    longest = 1
    for index in range(chosen.shape[0]):
        p = chosen[index]
        longest = max(longest, ring_start[polygon_start[p + 1]] - ring_start[polygon_start[p]])
    us = np.empty(longest)
    vs = np.empty(longest)
    crossings = np.empty(longest)
    for index in range(chosen.shape[0]):
        p = chosen[index]
        first = ring_start[polygon_start[p]]
        last = ring_start[polygon_start[p + 1]]
        low = np.inf
        high = -np.inf
        for i in range(first, last):
            x = xy[i, 0]
            y = xy[i, 1]
            if field.shape[1] > 1:
                x, y = _moved(x, y, field, field_box)
            u, v = _pixel(
                x - position[0], y - position[1], heights[index] - position[2], rot, lens, bend, max_r
            )
            us[i - first] = u
            vs[i - first] = v
            low = min(low, v)
            high = max(high, v)
        for row in range(max(0, math.ceil(low)), min(height - 1, math.floor(high)) + 1):
            count = 0
            for ring in range(polygon_start[p], polygon_start[p + 1]):
                for i in range(ring_start[ring] - first, ring_start[ring + 1] - first - 1):
                    v0 = vs[i]
                    v1 = vs[i + 1]
                    if (v0 <= row) != (v1 <= row):
                        crossings[count] = us[i] + (row - v0) / (v1 - v0) * (us[i + 1] - us[i])
                        count += 1
            crossings[:count].sort()
            for k in range(0, count - 1, 2):
                start = max(0.0, math.ceil(crossings[k]))
                stop = min(float(width), math.ceil(crossings[k + 1]))
                for column in range(int(start), int(stop)):
                    image[row, column] = values[index]


_NO_FIELD = np.zeros((2, 1, 1))


class _Sight(NamedTuple):
    rotation: FloatArray
    position: FloatArray
    box: tuple[float, float, float, float]  # bounds of the ground in sight


@dataclass(frozen=True, slots=True)
class Simulator:
    """Draws what the camera of one flight sees; every frame has randomness of its own, whatever the order."""

    ground: RaisedFootprints
    settings: SimulationSettings
    course: Course
    seed: int

    def pose(self, frame: int, reach: float = 6.0) -> _Sight:
        """The camera's true pose at a frame, and the box of ground it may see (``reach`` heights at most)."""
        row = self.course.frame_index[frame]
        roll, pitch, yaw = self.course.roll_pitch_yaw[row]
        rotation = world_from_camera(self.settings.mount, roll, pitch, yaw)
        position = self.course.xyz_m[row]
        rays = ray_from_pixel(self.settings.camera, border_pixels(self.settings.camera, 9)) @ rotation.T
        flat = np.hypot(rays[:, 0], rays[:, 1])
        with np.errstate(divide="ignore"):
            distance = np.where(rays[:, 2] < 0, position[2] * flat / -rays[:, 2], np.inf)
        distance = np.minimum(distance, reach * position[2])
        points = position[:2] + rays[:, :2] / np.maximum(flat, 1e-12)[:, None] * distance[:, None]
        # The border alone bounds the ground in sight only when the nadir is added: near the horizon it opens.
        points = np.concatenate([points, position[None, :2]])
        low, high = points.min(axis=0) - 5.0, points.max(axis=0) + 5.0
        return _Sight(rotation, position, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))

    def paint(
        self,
        image: NDArray[Any],
        pose: _Sight,
        ground: RaisedFootprints,
        chosen: NDArray[np.int64],
        values: NDArray[Any],
        heights: FloatArray,
        field: FloatArray = _NO_FIELD,
        field_box: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> None:
        """Paint ``values`` (k,) of the polygons ``chosen`` (k,) at ``heights`` (k,) above ground into ``image``."""
        camera = self.settings.camera
        corner = ray_from_pixel(camera, np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]]))
        widest = float(np.hypot(corner[:, 0], corner[:, 1]).max())
        _paint(
            xy=ground.xy,
            ring_start=ground.ring_start,
            polygon_start=ground.polygon_start,
            chosen=chosen,
            values=values,
            heights=heights,
            field=field,
            field_box=field_box,
            rot=pose.rotation,
            position=pose.position,
            lens=(camera.fx, camera.fy, camera.cx, camera.cy),
            bend=camera.distortion,
            max_r=widest * (1.05 if camera.is_distorted else 3.0),
            image=image,
        )

    def _pile(
        self, pose: _Sight, chosen: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.bool_]]:
        # Buildings as piles of outlines, far ones first and roofs last, close enough for every pixel of their walls to
        # be met: (k,) polygons, (k,) heights, (k,) whether it is the roof.
        x, y, agl = pose.position
        bounds = self.ground.bounds[chosen]
        distance = np.hypot(*((bounds[:, :2] + bounds[:, 2:]) / 2.0 - [x, y]).T)
        far_first = np.argsort(-distance, kind="stable")
        chosen, distance, bounds = chosen[far_first], distance[far_first], bounds[far_first]
        # A roof as high as the camera would cover the sky.
        tall = np.minimum(self.ground.height_m[chosen], 0.8 * agl)
        size = np.hypot(*(bounds[:, 2:] - bounds[:, :2]).T)
        lean_px = tall * (distance + size / 2.0) / (agl - tall) * self.settings.camera.fx / agl
        layers = np.clip(np.ceil(lean_px / 1.5), 1, 300).astype(np.int64) * (tall > 0)
        index = np.repeat(np.arange(len(chosen)), layers + 1)
        order = np.arange(len(index)) - np.repeat(np.cumsum(layers + 1) - layers - 1, layers + 1)
        at = tall[index] * order / np.maximum(layers[index], 1)
        return chosen[index], at, order == layers[index]

    def mask(self, frame: int, relief: bool = False) -> NDArray[np.uint8]:
        """(height, width) uint8 mask of a frame as the network would give it: 0 other, 255 building.

        With ``relief`` roofs stand where their height puts them in the picture, and walls are no building; else outlines
        are where the map has them.
        """
        errors = self.settings.masks
        rng = np.random.default_rng([self.seed, MASK, frame])
        pose = self.pose(frame)
        left, bottom, right, top = pose.box
        image = np.zeros((self.settings.camera.height, self.settings.camera.width), dtype=np.uint8)
        chosen = self.ground.near(*pose.box)

        field, field_box = _NO_FIELD, (left, bottom, errors.edge_scale_m)
        if errors.edge_sigma_m > 0:
            size = (
                math.ceil((top - bottom) / errors.edge_scale_m) + 2,
                math.ceil((right - left) / errors.edge_scale_m) + 2,
            )
            field = rng.standard_normal((2, *size)) * errors.edge_sigma_m
        if errors.missed > 0 and len(chosen):
            # One latent number a building for the whole flight, one a frame: mixed, they are standard normal again.
            always = math.sqrt(errors.missed_always)
            own = ndtri(_hash_uniform(chosen, self.seed))
            latent = always * own + math.sqrt(1.0 - always**2) * rng.standard_normal(len(chosen))
            chosen = chosen[latent >= ndtri(errors.missed)]
        heights, roof = np.zeros(len(chosen)), np.ones(len(chosen), dtype=np.bool_)
        if relief:
            chosen, heights, roof = self._pile(pose, chosen)
        values = np.where(roof, 255, 0).astype(np.uint8)
        self.paint(image, pose, self.ground, chosen, values, heights, field, field_box)

        blobs = int(rng.poisson(errors.false_blobs))
        if blobs:
            fake = _blobs(rng, blobs, pose.box, errors.blob_radius_m)
            every = np.arange(blobs, dtype=np.int64)
            self.paint(image, pose, fake, every, np.full(blobs, 255, dtype=np.uint8), np.zeros(blobs))
        if errors.pixel_accuracy is not None:
            _flip(image, 1.0 - errors.pixel_accuracy, rng)
        return image

    def picture(self, frame: int, imagery: Imagery) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 RGB: the frame as the camera takes it from ``imagery``.

        Buildings with a height stand up: their roofs are moved to where the camera sees them, and walls that face the
        camera fill the gap. Beyond the imagery its border goes on; above the horizon there is a grey sky.
        """
        settings = self.settings
        rng = np.random.default_rng([self.seed, PICTURE, frame])
        pose = self.pose(frame)
        height, width = settings.camera.height, settings.camera.width
        x0, y0, agl = pose.position

        # Metres above ground of what each pixel shows; walls count negative.
        plane = np.zeros((height, width), dtype=np.float32)
        chosen = self.ground.near(*pose.box)
        index, at, roof = self._pile(pose, chosen[self.ground.height_m[chosen] > 0])
        values = np.where(roof, at, -np.maximum(at, 1e-3)).astype(np.float32)
        self.paint(plane, pose, self.ground, index, values, at)

        rays = _ray_grid(settings.camera) @ pose.rotation.T.astype(np.float32)
        down = rays[..., 2] < -1e-3
        reach = (np.abs(plane) - np.float32(agl)) / np.where(down, rays[..., 2], np.float32(-1e-3))
        dx, dy = rays[..., 0] * reach, rays[..., 1] * reach
        part = imagery.crop(pose.box)
        part = part.coarser(max(1, int(agl / settings.camera.fx / imagery.gsd_m + 0.25)))
        # Offsets from the nadir are small numbers: float32 holds them to less than a millimetre.
        columns = dx / np.float32(part.gsd_m) + np.float32((x0 - part.left) / part.gsd_m - 0.5)
        rows = np.float32((part.top - y0) / part.gsd_m - 0.5) - dy / np.float32(part.gsd_m)
        seen = cv2.remap(part.rgb, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        light = np.asarray(seen, dtype=np.float32)

        wall = plane < 0
        if wall.any():
            light[wall] = _walls(
                dx[wall], dy[wall], -plane[wall], float(x0), float(y0), settings.sun_azimuth_deg
            )
        light[~down] = (176.0, 186.0, 196.0)

        row = min(int(self.course.frame_index[frame]), len(self.course.t_s) - 2)
        light = _motion_blur(light, settings, self.course, row)
        u = (np.arange(width, dtype=np.float32) - (width - 1) / 2) / (width / 2)
        v = (np.arange(height, dtype=np.float32) - (height - 1) / 2) / (height / 2)
        light *= (1.0 - settings.vignette * (u[None, :] ** 2 + v[:, None] ** 2) / 2.0)[..., None]
        light *= np.float32(math.exp(settings.exposure_sigma * rng.standard_normal()))
        if settings.noise_levels > 0:
            noise = rng.standard_normal(light.shape, dtype=np.float32) * np.float32(settings.noise_levels)
            light += noise * np.sqrt(np.maximum(light, 8.0) / 128.0)
        return np.clip(np.rint(light), 0, 255).astype(np.uint8)

    def view(self, frame: int, image: NDArray[np.uint8], gsd_m: float, **options: Any) -> View:
        """The view that the localizer makes of a frame, from what the instruments say."""
        c = self.course
        return make_view(
            image,
            self.settings.camera,
            self.settings.known_mount,
            math.radians(c.measured_roll_deg[frame]),
            math.radians(c.measured_pitch_deg[frame]),
            float(c.measured_agl_m[frame]),
            gsd_m,
            t_s=float(c.frame_times_s[frame]),
            file=frame_name(frame),
            **options,
        )


@lru_cache(maxsize=4)
def _ray_grid(camera: Camera) -> NDArray[np.float32]:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return ray_from_pixel(camera, np.stack([u, v], axis=-1)).astype(np.float32)


def _walls(
    dx: NDArray[np.floating[Any]],
    dy: NDArray[np.floating[Any]],
    z: NDArray[np.floating[Any]],
    x0: float,
    y0: float,
    sun_azimuth_deg: float,
) -> NDArray[np.float32]:
    # (k, 3) light of wall points: lit by how far the wall, which faces the camera, also faces the sun; a storey is 3 m.
    azimuth = math.radians(sun_azimuth_deg)
    away = np.hypot(dx, dy) + 1e-6
    facing = -(dx * math.sin(azimuth) + dy * math.cos(azimuth)) / away
    shade = 0.62 + 0.3 * facing
    along = (dx + x0 % 3000.0) * 0.8 + (dy + y0 % 3000.0) * 0.6
    window = (
        (np.mod(z, 3.0) > 0.9)
        & (np.mod(z, 3.0) < 2.2)
        & (np.mod(along, 3.0) > 0.8)
        & (np.mod(along, 3.0) < 2.3)
    )
    shade = np.where(window, shade * 0.55, shade)
    return np.asarray(shade[:, None] * np.array([206.0, 200.0, 190.0]), dtype=np.float32)


def _motion_blur(
    light: NDArray[np.float32], settings: SimulationSettings, course: Course, row: int
) -> NDArray[np.float32]:
    # The picture's own movement while the shutter is open, at its centre, as a short line of light.
    rotations = [world_from_camera(settings.mount, *course.roll_pitch_yaw[i]) for i in (row, row + 1)]
    centre = rotations[0][:, 2]
    if centre[2] > -0.05:
        return light
    point = course.xyz_m[row] + centre * (course.xyz_m[row, 2] / -centre[2])
    before, after = (
        pixel_from_point(settings.camera, r, course.xyz_m[row + i], point) for i, r in enumerate(rotations)
    )
    shift = (after - before) * (RATE_HZ * settings.exposure_s)
    length = float(np.hypot(*shift))
    if not 0.2 < length < 60.0:
        return light
    half = math.ceil(length / 2.0) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    for share in np.linspace(-0.5, 0.5, 8 * half + 1):
        c, r = half + shift[0] * share, half + shift[1] * share
        i, j = int(r), int(c)
        a, b = r - i, c - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - a, a], [1 - b, b])
    blurred = cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float32)


def frame_name(frame: int) -> str:
    """The file name of a simulated frame."""
    return f"frame_{frame:05d}.jpg"


def _hash_uniform(index: NDArray[np.int64], seed: int) -> FloatArray:
    # A number in (0, 1) for each building, the same in every frame of a flight (splitmix64, Steele et al. 2014).
    mix = np.random.default_rng([seed, LATENT]).integers(0, 2**63, dtype=np.uint64)
    with np.errstate(over="ignore"):
        z = index.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + mix
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return ((z >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53


def _blobs(
    rng: np.random.Generator, n: int, box: tuple[float, float, float, float], radius_m: float
) -> RaisedFootprints:
    # Star-shaped outlines with a few lobes, anywhere in the box.
    corners = 24
    angle = np.linspace(0.0, 2.0 * math.pi, corners + 1)
    angle[-1] = 0.0  # closed exactly
    centre = rng.uniform(box[:2], box[2:], (n, 2))
    radius = radius_m * np.exp(0.5 * rng.standard_normal(n))
    lobes = rng.standard_normal((n, 2, 3)) * 0.15
    wave = np.stack([f(np.outer([2, 3, 4], angle)) for f in (np.cos, np.sin)])
    outline = radius[:, None] * np.maximum(1.0 + np.einsum("nij,ija->na", lobes, wave), 0.3)
    xy = centre[:, None, :] + outline[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    none = np.zeros(n)
    starts = np.arange(n + 1, dtype=np.int64)
    return RaisedFootprints(xy.reshape(-1, 2), starts * (corners + 1), starts, np.zeros((n, 4)), none, none)


def _flip(image: NDArray[np.uint8], share: float, rng: np.random.Generator) -> None:
    # Smooth noise above its own quantile: exactly ``share`` of the pixels, in patches of some ten pixels.
    height, width = image.shape
    coarse = rng.standard_normal((height // 12 + 3, width // 12 + 3)).astype(np.float32)
    noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    count = round(share * image.size)
    if count:
        flat = np.argpartition(noise.ravel(), image.size - count)[image.size - count :]
        image.ravel()[flat] ^= np.uint8(255)
