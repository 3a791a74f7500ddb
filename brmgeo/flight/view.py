"""Levelled views: a frame's mask laid onto the ground, nose up, at the map's GSD, and the ratios measured in it.

Every pixel of the view is followed down to the flat ground and back through the camera into the frame, so tilt,
mounting, distortion and height are all undone in one resampling. A view pixel that covers several frame pixels is
averaged from enough samples for none to be skipped. The whole frame is used, not only the paper's square crop.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import disc_radii
from brmgeo.flight.camera import (
    border_pixels,
    ground_from_pixel,
    level_from_camera,
    pixel_from_point,
    ray_from_pixel,
)
from brmgeo.flight.readings import Attitude, Camera, FloatArray
from brmgeo.flight.values import View

MAX_SAMPLES = 8
_ROWS = 256  # of a frame that are moved at a time


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _resample(image, scale, rot, agl, lens, bend, max_r2, reach2, top, left, gsd, samples, out, known):  # type: ignore[no-untyped-def]
    # image (h, w); rot level_from_camera; lens fx fy cx cy; bend k1 k2 p1 p2 k3; top, left: metres ahead and to
    # the left of the nadir of the view's corner. A sample counts when its ray lands inside the frame.
    height, width = image.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    k1, k2, p1, p2, k3 = bend[0], bend[1], bend[2], bend[3], bend[4]
    bent = k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0
    step = gsd / samples
    needed = (samples * samples + 1) // 2
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            count = 0
            for a in range(samples):
                f = top - i * gsd - (a + 0.5) * step
                ray_x = f * rot[0, 0] - agl * rot[2, 0]
                ray_y = f * rot[0, 1] - agl * rot[2, 1]
                ray_z = f * rot[0, 2] - agl * rot[2, 2]
                for b in range(samples):
                    s = left - j * gsd - (b + 0.5) * step
                    if f * f + s * s > reach2:
                        continue
                    z = ray_z + s * rot[1, 2]
                    if z <= 1e-9:
                        continue
                    inverse = 1.0 / z
                    x = (ray_x + s * rot[1, 0]) * inverse
                    y = (ray_y + s * rot[1, 1]) * inverse
                    if bent:
                        r2 = x * x + y * y
                        if r2 > max_r2:
                            continue
                        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
                        y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
                        x = xd
                    u = x * fx + cx
                    v = y * fy + cy
                    if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
                        continue
                    # Both are above -1: cutting off the fraction of one more is a floor, and a cheap one.
                    u0 = int(u + 1.0) - 1
                    v0 = int(v + 1.0) - 1
                    du = u - u0
                    dv = v - v0
                    u1 = min(u0 + 1, width - 1)
                    v1 = min(v0 + 1, height - 1)
                    u0 = max(u0, 0)
                    v0 = max(v0, 0)
                    p00 = image[v0, u0]
                    p01 = image[v0, u1]
                    p10 = image[v1, u0]
                    p11 = image[v1, u1]
                    if p00 == p11 and p01 == p10 and p00 == p01:  # nearly everywhere in a mask
                        total += p00
                        count += 1
                        continue
                    upper = p00 * (1.0 - du) + p01 * du
                    lower = p10 * (1.0 - du) + p11 * du
                    value = upper * (1.0 - dv) + lower * dv
                    if value == value:  # NaN marks what a probability image does not know
                        total += value
                        count += 1
            if count >= needed:
                out[i, j] = total * scale / count
                known[i, j] = True
            else:
                out[i, j] = 0.0
                known[i, j] = False


@lru_cache(maxsize=16)
def _rays(camera: Camera) -> tuple[FloatArray, float]:
    # Rays over the whole frame (not the border alone: the horizon may cross it) and the square of the widest.
    u = np.linspace(-0.5, camera.width - 0.5, 17)
    v = np.linspace(-0.5, camera.height - 0.5, 17)
    inner = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = ray_from_pixel(camera, np.concatenate([border_pixels(camera), inner]))
    return rays, float((rays[:, :2] ** 2).sum(axis=1).max())


def make_view(
    image: NDArray[Any],
    camera: Camera,
    mount: Attitude,
    roll_rad: float,
    pitch_rad: float,
    agl_m: float,
    gsd_m: float,
    *,
    t_s: float = 0.0,
    file: str = "",
    max_radius_m: float | None = None,
    max_off_nadir_deg: float = 75.0,
    max_stretch: float = 4.0,
) -> View:
    """The view of one frame: levelled, undistorted, nose up, at ``gsd_m``, nadir on a pixel corner.

    Args:
        image: (height, width) mask of the frame: bool, uint8 (0 other, 255 building) or float32/float64
            probability in [0, 1] with NaN where unknown.
        mount: the camera against the body.
        roll_rad, pitch_rad: attitude of the body.
        agl_m: height above the (flat) ground.
        max_radius_m: leave out what lies farther from the nadir point.
        max_off_nadir_deg: pixels seen more obliquely than this are unknown.
        max_stretch: so are those where a frame pixel covers over this many view pixels (or, for a frame
            coarser than the map, this many times its own size at the nadir) in the direction of sight.

    Returns a View whose ``building`` and ``known`` are (h, w); all unknown (1 x 1) where the camera sees no ground.
    Raises ValueError for an image of another size than the camera's, a height or GSD that is not positive and finite,
    or a distortion that folds the image over itself.
    """
    if image.shape != (camera.height, camera.width):
        raise ValueError(
            f"an image of {image.shape} does not fit a camera of {(camera.height, camera.width)}"
        )
    if not (math.isfinite(agl_m) and agl_m > 0 and math.isfinite(gsd_m) and gsd_m > 0):
        raise ValueError(f"height {agl_m} m and GSD {gsd_m} m must be positive")
    rotation = level_from_camera(mount, roll_rad, pitch_rad)
    frame_gsd = agl_m / max(camera.fx, camera.fy)
    cos2 = frame_gsd / (max_stretch * max(gsd_m, frame_gsd))
    max_tan = min(math.tan(math.radians(max_off_nadir_deg)), math.sqrt(max(1.0 / cos2 - 1.0, 0.0)))
    reach = min(agl_m * max_tan, math.inf if max_radius_m is None else max_radius_m)
    top, left, rows, cols = _extent(camera, rotation, agl_m, gsd_m, reach)

    scale = 1.0
    if image.dtype == np.uint8:
        scale = 1.0 / 255.0
    elif image.dtype == np.bool_:
        image = image.view(np.uint8)
    samples = min(MAX_SAMPLES, max(1, math.ceil(gsd_m / frame_gsd - 0.05)))
    building = np.empty((rows, cols), dtype=np.float32)
    known = np.empty((rows, cols), dtype=np.bool_)
    _resample(
        image=np.ascontiguousarray(image),
        scale=scale,
        rot=rotation,
        agl=float(agl_m),
        lens=(camera.fx, camera.fy, camera.cx, camera.cy),
        bend=camera.distortion,
        max_r2=_rays(camera)[1] * 1.0001,
        reach2=reach * reach,
        top=top * gsd_m,
        left=left * gsd_m,
        gsd=float(gsd_m),
        samples=samples,
        out=building,
        known=known,
    )
    return View(
        t_s=t_s,
        building=building,
        known=known,
        gsd_m=gsd_m,
        nadir_px=(float(top), float(left)),
        agl_m=agl_m,
        radius_m=agl_m * camera.half_fov_tan,
        file=file,
    )


def _extent(
    camera: Camera, rotation: FloatArray, agl_m: float, gsd_m: float, reach_m: float
) -> tuple[int, int, int, int]:
    # The nadir's row and column in the view, and its rows and columns: all of the ground that the frame shows in reach.
    level = _rays(camera)[0] @ rotation.T
    flat = np.hypot(level[:, 0], level[:, 1])
    # A ray above the limit still bounds the view: in its direction the view ends at the reach.
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(level[:, 2] < 0, agl_m * flat / -level[:, 2], np.inf)
    distance = np.minimum(distance, reach_m)
    points = level[:, :2] / np.where(flat > 0, flat, 1.0)[:, None] * distance[:, None]
    (f0, s0), (f1, s1) = points.min(axis=0), points.max(axis=0)
    top, left = math.ceil(f1 / gsd_m - 1e-9), math.ceil(s1 / gsd_m - 1e-9)
    rows = max(1, top - math.floor(f0 / gsd_m + 1e-9))
    cols = max(1, left - math.floor(s0 / gsd_m + 1e-9))
    return top, left, rows, cols


def lowered(
    image: NDArray[np.float32], camera: Camera, rotation: FloatArray, agl_m: float, height_m: float
) -> NDArray[np.float32]:
    """(h, w) float32 of what stands ``height_m`` above the ground, moved to where its outline on the ground would be seen.

    Args:
        image: (h, w) float32, such as a probability of roofs.
        rotation: (3, 3) world_from_camera, z upwards; any heading.
        agl_m: height of the camera above ground.
        height_m: of what stands, below the camera.

    NaN where that lies beyond the frame, or the ground beyond the horizon.
    """
    h, w = image.shape
    at = np.array([0.0, 0.0, agl_m])
    out = np.empty_like(image)
    for top in range(0, h, _ROWS):
        v, u = np.mgrid[top : min(top + _ROWS, h), :w].astype(np.float64)
        xy = ground_from_pixel(camera, rotation, at, np.dstack([u, v]))
        source = pixel_from_point(camera, rotation, at, np.dstack([xy, np.full(u.shape, height_m)]))
        out[top : top + _ROWS] = cv2.remap(
            image,
            np.nan_to_num(source, nan=-10.0).astype(np.float32),
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=math.nan,
        )
    return out


class Features(NamedTuple):
    """Ratios of a view: ``f`` (n,) in [0, 1] or NaN where nothing is known, ``known_share`` (n,), ``radii_m`` (n,)."""

    f: FloatArray
    known_share: FloatArray
    radii_m: FloatArray


def features(view: View, n: int = 3) -> Features:
    """The paper's features f_k: share of building in ``n`` discs about the nadir point (eq. 1, 2).

    The radii are R, R (n-1)/n, ..., R/n with R = ``view.radius_m``, largest first, so f[0] is the whole disc. A pixel
    belongs to a disc when its centre does. Ratios are over known pixels; ``known_share`` says what part of the
    disc's pixels is known (pixels beyond the view count as unknown).
    """
    if n < 1:
        raise ValueError(f"{n} discs asked for: give at least one")
    radii = np.array(disc_radii(view.radius_m, n))
    row0, col0 = view.nadir_px
    rows, cols = view.building.shape
    dy2 = (np.arange(rows) + 0.5 - row0) ** 2
    dx2 = (np.arange(cols) + 0.5 - col0) ** 2
    distance2 = dy2[:, None] + dx2[None, :]
    f, share = np.full(n, np.nan), np.zeros(n)
    for k, radius in enumerate(radii):
        r2 = (radius / view.gsd_m) ** 2
        seen = (distance2 <= r2) & view.known
        count = int(seen.sum())
        whole = _disc_pixels(row0 % 1.0, col0 % 1.0, r2)
        share[k] = count / whole if whole else 0.0
        if count:
            f[k] = float(view.building[seen].sum(dtype=np.float64)) / count
    return Features(f, share, radii)


def _disc_pixels(row0: float, col0: float, r2: float) -> int:
    """Number of pixel centres within sqrt(r2) pixels of the point (row0, col0), over the endless plane."""
    reach = math.ceil(math.sqrt(r2)) + 1
    centres = np.arange(-reach, reach + 1) + 0.5
    return int(((centres - row0)[:, None] ** 2 + (centres - col0)[None, :] ** 2 <= r2).sum())
