"""Training crops out of pictures and labels, and what happens to them so that a network meets more than it was given.

The gap to close is the one between imagery from above and the frames of a small aircraft: any heading, another height,
a tilted camera, other roofs, light, weather, lens and compression. A crop is cut by one homography (rotation, mirror,
scale, tilt) from a source that knows its GSD, after area averaging where the crop is coarser than the source, so that
nothing aliases; then its colours are changed. Everything comes from the ``numpy.random.Generator`` that is handed in:
the same generator, the same crop.

Labels are uint8: 0 other, 255 building, 127 unknown (outside the source, or not known there).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import SettingsError
from brmgeo.pictures import photographed
from brmgeo.settings import require_within

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
#: Of red, green and blue, 0 to 1: what the network's input is normalised with, and what stands where nothing was seen.
MEAN, STD = (0.45, 0.45, 0.42), (0.22, 0.21, 0.21)
_LARGEST = 2.0  # how many times larger the ground is shown at most, where it is
_LUMA = (0.3, 0.59, 0.11)  # of red, green and blue in grey
_ROOFS = np.array(  # light and dark grey, brown, beige, brick, slate blue, white: shingles, tiles, metal of many countries
    [
        (188, 188, 184), (150, 150, 148), (104, 102, 100), (70, 68, 68), (122, 100, 84), (96, 78, 66),
        (196, 178, 150), (168, 104, 78), (176, 72, 56), (96, 112, 132), (226, 226, 222), (84, 110, 92),
    ],
    np.float32,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class AugmentSettings:
    """How far crops depart from their source; probabilities are per crop, all strengths at 0 leave the picture as it is.

    Attributes:
        gsd_m: (finest, coarsest) metres per pixel of the crops, drawn log-uniform.
        turn: any rotation and mirror image; False keeps north up.
        tilt: largest movement of a crop's corner, as a share of its side (perspective).
        near_buildings: share of crops that are centred near a building.
        enlarge: probability that the ground is shown larger than it is, up to twice as far as its source's pixels go: houses
            as large as halls. A crop that shows half the ground may lose the building that it was centred near, and fine
            sources are kept at twice the resolution: mosaics of them take four times the pixels.
        roofs: probability that roofs get other colours, building by building.
        objects: probability that courts, pools and paved squares are drawn on open ground.
        colour: strength of changes of brightness, contrast, gamma, white balance, saturation and hue; 1 is strong.
        grey: probability that most or all colour is taken away.
        shadow, haze, blur, noise, jpeg: probabilities of each.
    """

    gsd_m: tuple[float, float] = (0.20, 0.42)
    turn: bool = True
    tilt: float = 0.10
    near_buildings: float = 0.5
    enlarge: float = 0.0
    roofs: float = 0.4
    objects: float = 0.2
    colour: float = 0.8
    grey: float = 0.0
    shadow: float = 0.3
    haze: float = 0.3
    blur: float = 0.4
    noise: float = 0.4
    jpeg: float = 0.4

    def __post_init__(self) -> None:
        low, high = self.gsd_m
        if not 0 < low <= high:
            raise SettingsError(
                f"augmentation gsd_m {self.gsd_m}: give (finest, coarsest), finest above 0 and not above coarsest"
            )
        likely = (
            "near_buildings",
            "enlarge",
            "roofs",
            "objects",
            "grey",
            "shadow",
            "haze",
            "blur",
            "noise",
            "jpeg",
        )
        require_within(self, tilt=(0, 0.3), colour=(0, 2), **dict.fromkeys(likely, (0, 1)))

    @staticmethod
    def none(gsd_m: float) -> AugmentSettings:
        """Crops at one GSD, north up, with nothing changed: for validation."""
        return AugmentSettings(
            gsd_m=(gsd_m, gsd_m), turn=False, tilt=0.0, near_buildings=0.5, enlarge=0, roofs=0, objects=0,
            colour=0, grey=0, shadow=0, haze=0, blur=0, noise=0, jpeg=0,
        )  # fmt: skip

    @property
    def finest_m(self) -> float:
        """The finest metres per pixel that are cut from a source."""
        return self.gsd_m[0] / (_LARGEST if self.enlarge > 0 else 1.0)


class Source(Protocol):
    """Pictures that crops are cut from. ``patch`` must depend on ``rng`` alone."""

    def patch(
        self, rng: np.random.Generator, reach_m: float, near_buildings: float, gsd_m: float = math.inf
    ) -> tuple[U8, U8, float, tuple[float, float]]:
        """((h, w, 3) uint8 RGB, (h, w) uint8 label, GSD in metres, (row, col) to centre the crop on).

        ``reach_m``: no pixel further than this from the centre is needed. ``near_buildings``: the share of
        patches to be centred near a building. ``gsd_m``: of the crop; a source of several GSD gives none that is much
        coarser where it has another.
        """
        ...


def draw_crop(
    source: Source, rng: np.random.Generator, size_px: int, settings: AugmentSettings
) -> tuple[U8, U8]:
    """One training crop: ((size, size, 3) uint8 RGB, (size, size) uint8 label), from ``source`` and ``rng`` alone.

    Unknown ground that is plain black or white has the mean colour, as the network meets it in use.
    """
    low, high = settings.gsd_m
    gsd = float(math.exp(rng.uniform(math.log(low), math.log(high))))
    # Half the diagonal, and what tilting moves a corner outwards.
    reach = size_px * gsd * (math.sqrt(0.5) + math.sqrt(2) * settings.tilt) + 1.0
    image, label, source_gsd, centre = source.patch(rng, reach, settings.near_buildings, gsd)
    if settings.enlarge > 0 and rng.random() < settings.enlarge:
        gsd = min(gsd, max(source_gsd, gsd / float(rng.uniform(1.0, _LARGEST))))
    image, label = cut(image, label, centre, _crop_quad(rng, size_px, gsd / source_gsd, settings), size_px)
    plain = (image == 0).all(-1) | (image == 255).all(-1)
    image = recolour(image, label, gsd, rng, settings)
    image[plain & (label == UNKNOWN)] = np.rint(255 * np.array(MEAN))
    return image, label


def _crop_quad(
    rng: np.random.Generator, size_px: int, scale: float, settings: AugmentSettings
) -> NDArray[np.float64]:
    """(4, 2) float64 (x, y) of a crop's corners about its centre, in source pixels, from the upper left clockwise."""
    half = size_px * scale / 2
    quad = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    if settings.tilt > 0:
        quad = quad + rng.uniform(-1, 1, (4, 2)) * settings.tilt * size_px * scale
    if settings.turn:
        angle = rng.uniform(0, 2 * math.pi)
        c, s = math.cos(angle), math.sin(angle)
        quad = quad @ np.array([[c, s], [-s, c]])
        if rng.random() < 0.5:
            quad = quad[[1, 0, 3, 2]]
    return quad


def cut(
    image: U8, label: U8, centre: tuple[float, float], quad: NDArray[np.float64], size_px: int
) -> tuple[U8, U8]:
    """The square crop whose corners are ``quad`` about ``centre``.

    Args:
        image, label: (h, w, 3) and (h, w) uint8.
        centre: (row, col), edge convention, the pixel coordinates that quad's (0, 0) stands for.
        quad: (4, 2) float64 (x, y) corners in source pixels, from the crop's upper left clockwise.
        size_px: side of the crop.

    Returns (size, size, 3) uint8 and (size, size) uint8. Where the crop is coarser than the source, whole blocks of source
    pixels are averaged first; a block is building when at least half of its pixels are, unknown when any is. Outside the
    source the picture is mirrored and the label is unknown.
    """
    corners = quad + np.array([centre[1], centre[0]])
    side = float(np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1).mean()) / size_px
    k = max(1, int(side + 0.25))
    # Only the part under the crop, with edges on whole blocks.
    margin = 2 * k + 2
    left, top = (np.floor((corners.min(0) - margin) / k) * k).astype(int)
    right, bottom = (np.ceil((corners.max(0) + margin) / k) * k).astype(int)
    image, label = _window(image, label, int(top), int(left), int(bottom), int(right))
    image, label = shrunk(image, label, k)
    # From pixel edges to OpenCV's pixel centres.
    source = ((corners - (left, top)) / k - 0.5).astype(np.float32)
    n = size_px - 0.5
    target = np.array([(-0.5, -0.5), (n, -0.5), (n, n), (-0.5, n)], np.float32)
    move = cv2.getPerspectiveTransform(target, source)
    flags = cv2.WARP_INVERSE_MAP
    size = (size_px, size_px)
    crop = cv2.warpPerspective(
        image, move, size, flags=flags | cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    answer = cv2.warpPerspective(
        label,
        move,
        size,
        flags=flags | cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=UNKNOWN,
    )
    return np.asarray(crop, np.uint8), np.asarray(answer, np.uint8)


def shrunk(image: U8, label: U8, k: int) -> tuple[U8, U8]:
    """(h / k, w / k, 3) and (h / k, w / k) uint8: means of blocks of k x k pixels.

    What is left over at the right and below is cut off. A block is building when at least half of its pixels are,
    unknown when any is.
    """
    if k == 1:
        return image, label
    h, w = label.shape[0] // k, label.shape[1] // k
    image, label = image[: h * k, : w * k], label[: h * k, : w * k]
    area = cv2.INTER_AREA
    built = cv2.resize((label == BUILDING).astype(np.float32), (w, h), interpolation=area)
    unknown = cv2.resize((label == UNKNOWN).astype(np.float32), (w, h), interpolation=area)
    # Averages of zeros and ones in float32: a half is 0.5 give or take a rounding.
    coarse = np.where(unknown > 1e-3, UNKNOWN, np.where(built > 0.499, BUILDING, 0)).astype(np.uint8)
    return np.asarray(cv2.resize(image, (w, h), interpolation=area), np.uint8), coarse


def _window(image: U8, label: U8, top: int, left: int, bottom: int, right: int) -> tuple[U8, U8]:
    """A window that may reach outside: mirrored there, and unknown."""
    h, w = label.shape
    rows, cols = slice(max(top, 0), min(bottom, h)), slice(max(left, 0), min(right, w))
    part, known = image[rows, cols], label[rows, cols]
    if 0 in known.shape:
        shape = (bottom - top, right - left)
        return np.zeros((*shape, 3), np.uint8), np.full(shape, UNKNOWN, np.uint8)
    border = (max(-top, 0), max(bottom - h, 0), max(-left, 0), max(right - w, 0))
    if any(border):
        part = np.asarray(cv2.copyMakeBorder(part, *border, cv2.BORDER_REFLECT), np.uint8)
        known = np.asarray(cv2.copyMakeBorder(known, *border, cv2.BORDER_CONSTANT, value=UNKNOWN), np.uint8)
    return part, known


def recolour(image: U8, label: U8, gsd_m: float, rng: np.random.Generator, settings: AugmentSettings) -> U8:
    """The same ground under another roof, light, sky and camera: (h, w, 3) uint8; the label stays what it is."""
    img = image.astype(np.float32)
    if rng.random() < settings.roofs:
        img = _roofs(img, label, rng)
    if rng.random() < settings.objects:
        img = _objects(img, label, gsd_m, rng)
    if settings.colour > 0:
        img = _colour(img, settings.colour, rng)
    if settings.grey > 0 and rng.random() < settings.grey:
        left = np.float32(rng.uniform(0, 0.4))
        img = left * img + (1 - left) * cv2.transform(img, np.array([_LUMA], np.float32))[..., None]
    if rng.random() < settings.shadow:
        img = _shadow(img, rng)
    if rng.random() < settings.haze:
        veil = np.array([200, 206, 214], np.float32) * np.float32(rng.uniform(0.85, 1.1))
        share = np.float32(rng.uniform(0.05, 0.35))
        img = img * (1 - share) + veil * share
    if rng.random() < settings.blur:
        img = _blur(img, rng)
    if rng.random() < settings.noise:
        sigma = rng.uniform(1.0, 9.0)
        grey = rng.standard_normal((*label.shape, 1), np.float32)
        noise = 0.8 * grey + 0.4 * rng.standard_normal(img.shape, np.float32)
        img = np.asarray(img + np.float32(sigma) * noise, np.float32)
    out = np.clip(img, 0, 255).astype(np.uint8)
    if rng.random() < settings.jpeg:
        out = photographed(out, int(rng.integers(35, 96)))
    return out


def _roofs(img: F32, label: U8, rng: np.random.Generator) -> F32:
    """Other roof colours, one a building, over the roof's own light and shade."""
    count, parts = cv2.connectedComponents((label == BUILDING).astype(np.uint8), connectivity=4)
    if count < 2:
        return img
    chosen: NDArray[np.bool_] = np.asarray(rng.random(count) < rng.uniform(0.4, 1.0))
    chosen[0] = False
    colours = _ROOFS[rng.integers(len(_ROOFS), size=count)] * rng.normal(1, 0.12, (count, 1))
    colours = (colours + rng.normal(0, 12, (count, 3))).astype(np.float32)
    keep = rng.uniform(0.0, 0.4, (count, 1)).astype(np.float32)
    flat = parts.ravel()
    grey = img @ np.array(_LUMA, np.float32)
    area = np.maximum(np.bincount(flat, minlength=count), 1)
    mean = np.bincount(flat, grey.ravel(), count) / area
    # A roof's own light and shade about its mean, at most doubled: near-black roofs hold little but noise.
    relative = (grey / np.maximum(mean, 40.0).astype(np.float32)[parts])[..., None]
    painted = np.clip(relative, 0, 2) * colours[parts] * (1 - keep[parts]) + img * keep[parts]
    soft = cv2.GaussianBlur((chosen[parts]).astype(np.float32), (0, 0), 0.7)[..., None]
    return np.asarray(painted * soft + img * (1 - soft), np.float32)


_COURTS = np.array(  # hard courts, clay, turf, rubber
    [
        (58, 104, 168),
        (70, 120, 88),
        (168, 96, 72),
        (92, 140, 70),
        (110, 112, 116),
        (88, 92, 128),
        (150, 150, 146),
    ],
    np.float32,
)


def _objects(img: F32, label: U8, gsd_m: float, rng: np.random.Generator) -> F32:
    """Flat things that are no building, where the ground is open: courts with their lines, pools, car parks, slabs."""
    img = img.copy()
    ground = (label == 0).astype(np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        free = cv2.distanceTransform(ground, cv2.DIST_L2, 3)
        reach = min(float(free.max()) * 0.98, 26.0 / gsd_m)
        if reach * gsd_m < 3.0:
            break
        reach *= float(rng.uniform(0.4, 1.0))
        fits = np.flatnonzero(free > reach)
        row, col = divmod(int(fits[rng.integers(fits.size)]), label.shape[1])
        corner = float(rng.uniform(0.45, 0.8))  # half the angle between the diagonals
        size = (2 * reach * math.cos(corner), 2 * reach * math.sin(corner))
        angle = float(rng.uniform(0, 180))
        layer = img.copy()
        _draw_object(layer, (col, row), size, angle, gsd_m, rng)
        drawn = (np.abs(layer - img).max(2) > 0).astype(np.float32)[..., None]
        grain = cv2.GaussianBlur(rng.standard_normal(label.shape, np.float32), (0, 0), 2.0)[..., None]
        img = layer + np.float32(rng.uniform(2, 30)) * grain * drawn
        ground[drawn[..., 0] > 0] = 0
    return np.asarray(img, np.float32)


def _draw_object(
    layer: F32,
    at: tuple[int, int],
    size: tuple[float, float],
    angle: float,
    gsd_m: float,
    rng: np.random.Generator,
) -> None:
    """One court, pool, car park or slab of ``size`` (long, wide) pixels about ``at`` (column, row), drawn into ``layer``."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))

    def box(u: float, v: float, long: float, wide: float) -> NDArray[np.int32]:
        """Corners, in sixteenths of a pixel, of a rectangle at (u, v) of the object's own axes, all in shares of it."""
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (long / 2, wide / 2) + (u, v)
        corners = corners * size
        xy = np.column_stack([corners[:, 0] * c - corners[:, 1] * s, corners[:, 0] * s + corners[:, 1] * c])
        return np.rint((xy + at) * 16).astype(np.int32)

    def fill(corners: NDArray[np.int32], colour: NDArray[np.floating]) -> None:
        rgb = tuple(float(v) for v in np.clip(colour, 0, 255))
        cv2.fillPoly(layer, [corners], rgb, cv2.LINE_AA, 4)

    def line(corners: NDArray[np.int32]) -> None:
        white = (float(rng.uniform(190, 240)),) * 3
        cv2.polylines(layer, [corners], True, white, 1, cv2.LINE_AA, 4)

    jitter = rng.uniform(0.75, 1.2) * np.ones(3) + rng.normal(0, 0.06, 3)
    draw = rng.random()
    if draw < 0.5:
        outer, inner = _COURTS[rng.integers(len(_COURTS), size=2)] * jitter
        fill(box(0, 0, 1, 1), outer)
        courts = int(rng.integers(1, 4))
        for k in range(courts):
            v, wide = (k + 0.5) / courts - 0.5, 0.8 / courts
            fill(box(0, v, 0.8, wide), inner)
            for long, high in ((0.72, 0.85), (0.72, 0.62), (0.38, 0.62), (0.004, 0.85)):
                line(box(0, v, long, wide * high))
    elif draw < 0.65:
        fill(box(0, 0, 1, 1), np.array([196, 188, 176]) * jitter)
        fill(box(0, 0, 0.7, 0.6), np.array([110, 200, 212]) * jitter)
    elif draw < 0.85:
        fill(box(0, 0, 1, 1), np.array([104, 104, 106]) * jitter)
        bays = max(2, int(size[0] * gsd_m / 2.7))
        deep = min(0.45, 5.0 / max(size[1] * gsd_m, 1.0))
        for k in range(bays):
            u = (k + 0.5) / bays - 0.5
            for v in (-0.5 + deep / 2, 0.5 - deep / 2):
                line(box(u, v, 1 / bays, deep))
                if rng.random() < 0.45:
                    fill(box(u, v, 0.65 / bays, 0.85 * deep), rng.uniform(20, 240) + rng.normal(0, 15, 3))
    else:
        fill(box(0, 0, 1, 1), np.full(3, rng.uniform(110, 220)) * jitter)


def _colour(img: F32, strength: float, rng: np.random.Generator) -> F32:
    """Gamma, brightness, contrast, white balance, saturation, hue."""
    s = strength
    gamma = math.exp(rng.normal(0, 0.22 * s))
    img = 255.0 * np.power(np.clip(img, 0, 255) / 255.0, np.float32(gamma))
    gain = np.exp(rng.normal(0, 0.16 * s) + rng.normal(0, 0.06 * s, 3)).astype(np.float32)
    saturation = math.exp(rng.normal(-0.05, 0.25 * s))
    # Turning colours about the grey axis, then towards or away from grey: one matrix.
    turn = rng.normal(0, 0.12 * s)
    c, q, third = math.cos(turn), math.sin(turn) / math.sqrt(3), (1 - math.cos(turn)) / 3
    hue = np.full((3, 3), third) + c * np.eye(3) + q * np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]])
    grey = np.tile(_LUMA, (3, 1))
    matrix = (saturation * np.eye(3) + (1 - saturation) * grey) @ hue @ np.diag(gain)
    img = cv2.transform(img.astype(np.float32), matrix.astype(np.float32))
    contrast = math.exp(rng.normal(0, 0.15 * s))
    middle = float(img.mean())
    img = (img - middle) * contrast + middle + rng.normal(0, 10 * s)
    return np.asarray(img, np.float32)


def _shadow(img: F32, rng: np.random.Generator) -> F32:
    """One soft-edged darker polygon, a little bluer than what lies in the light: a cloud, or something tall outside."""
    h, w = img.shape[:2]
    points = rng.uniform(-0.3, 1.3, (int(rng.integers(3, 6)), 2)) * (w, h)
    hull = cv2.convexHull(points.astype(np.float32)).astype(np.int32)
    mask = np.zeros((h, w), np.float32)
    cv2.fillPoly(mask, [hull], 1.0)
    mask = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.8, 12.0)))[..., None]
    depth = np.float32(rng.uniform(0.3, 0.65)) * np.array([1.0, 0.98, 0.92], np.float32)
    return np.asarray(img * (1 - depth * mask), np.float32)


def _blur(img: F32, rng: np.random.Generator) -> F32:
    """Out of focus, or moved; or too sharp, as small cameras like their pictures."""
    draw = rng.random()
    if draw < 0.5:
        return np.asarray(cv2.GaussianBlur(img, (0, 0), float(rng.uniform(0.4, 1.5))), np.float32)
    if draw < 0.7:
        n = int(rng.integers(3, 8))
        kernel = np.zeros((n, n), np.float32)
        angle = rng.uniform(0, math.pi)
        d = np.array([math.cos(angle), math.sin(angle)]) * (n - 1) / 2
        a, b = np.rint((n - 1) / 2 - d).astype(int), np.rint((n - 1) / 2 + d).astype(int)
        cv2.line(kernel, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1.0)
        return np.asarray(cv2.filter2D(img, -1, kernel / kernel.sum()), np.float32)
    soft = cv2.GaussianBlur(img, (0, 0), 1.0)
    return np.asarray(img + np.float32(rng.uniform(0.3, 1.2)) * (img - soft), np.float32)
