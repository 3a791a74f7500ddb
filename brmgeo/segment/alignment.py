"""How far a building map lies beside the imagery: offsets per block from outlines and edges, and one for the region.

Maps and orthophotos are made from different surveys, so outlines often lie some metres beside the roofs that they describe.
The offset of a block is where the map's outlines fit the picture's edges best. A roof may be brighter or darker than its
surroundings, so edges are compared by direction and not by sign: both fields hold the doubled angle of the gradient as a
complex number (as in Bigun and Granlund, 1987), under which opposite gradients agree and crossing ones count against each
other. The correlation of the two fields over all shifts (by FFT) has its peak at the offset, which a parabola through its
neighbours gives to a fraction of a pixel. Edges of shadows and of displaced facades fit on one or two sides of a house only
and at another distance for each height, so they raise the ground around the peak rather than move it.

A block without outlines, without edges, or with a second place that fits nearly as well does not tell; the region's
offset is the median of those that do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from brmgeo.geo.grid import Bounds

_SMOOTH_M = 0.35
_OUTLINE_M = 120.0  # about three houses: less may fit a hedge by chance
# Maps laid over wrong ground (80 blocks of a generated town) reached a quality of 6.1 and a lead of 1.6, seldom both.
_PEAK = 6.5
_LEAD = 1.3
_APART_M = 2.5
_LEAST_BLOCKS = 3

Complex = NDArray[np.complex64]


@dataclass(frozen=True, slots=True)
class BlockOffset:
    """The offset of one block.

    Attributes:
        dx_m, dy_m: metres east and north by which the labels must be moved to lie on the imagery; NaN where it cannot tell.
        quality: height of the peak over the typical correlation, in robust standard deviations; 0 without outlines.
        lead: height of the peak over that of the best other place, at least 1.
        outline_m: length of the outlines in the block.
        status: ``told``, or why it cannot tell: ``few outlines``, ``no peak``, ``ambiguous``, ``at the edge of the search``.
    """

    dx_m: float
    dy_m: float
    quality: float
    lead: float
    outline_m: float
    status: str


@dataclass(frozen=True, slots=True)
class RegionOffset:
    """The offset of a whole region: the median of its blocks that tell.

    Attributes:
        dx_m, dy_m: as of a block; NaN where it cannot tell.
        sigma_m: standard error of the median per axis, from the spread between blocks; NaN with one block or none.
        spread_m: robust standard deviation of single blocks about it; what one number for the region leaves over.
        told, blocks: blocks that tell, and all.
        status: ``told`` or ``cannot tell``.
    """

    dx_m: float
    dy_m: float
    sigma_m: float
    spread_m: float
    told: int
    blocks: int
    status: str


def block_offset(
    image: NDArray[np.uint8],
    seen: NDArray[np.bool_],
    mask: NDArray[np.uint8],
    gsd_m: float,
    search_m: float = 10.0,
) -> BlockOffset:
    """The offset between a picture and the building mask of the same ground.

    Args:
        image: (h, w, 3) uint8 RGB.
        seen: (h, w) bool, its known pixels.
        mask: (h, w) uint8, 1 building, 0 other, anything else unknown.
        gsd_m: metres per pixel; 0.2 to 0.5 suits houses.
        search_m: largest offset that is looked for along each axis.

    Raises ValueError where the picture is smaller than four times the search.
    """
    reach = math.ceil(search_m / gsd_m)
    if min(mask.shape) < 4 * reach:
        raise ValueError(
            f"a block of {mask.shape} px is too small to search {search_m} m at {gsd_m} m per pixel"
        )
    outlines, length_px = _outline_field(mask, _SMOOTH_M / gsd_m)
    outline_m = length_px * gsd_m
    if outline_m < _OUTLINE_M:
        return BlockOffset(math.nan, math.nan, 0.0, 1.0, outline_m, "few outlines")
    edges = _edge_field(image, seen, _SMOOTH_M / gsd_m)
    fit = _correlate(outlines, edges, reach)
    middle = float(np.median(fit))
    spread = 1.4826 * float(np.median(np.abs(fit - middle)))
    row, col = np.unravel_index(int(np.argmax(fit)), fit.shape)
    peak = float(fit[row, col]) - middle
    if spread <= 0 or peak <= 0:
        return BlockOffset(math.nan, math.nan, 0.0, 1.0, outline_m, "no peak")
    quality = peak / spread
    rows, cols = np.ogrid[: fit.shape[0], : fit.shape[1]]
    others = np.hypot(rows - row, cols - col) > _APART_M / gsd_m
    lead = peak / max(float(fit[others].max()) - middle, 1e-12)
    status = "told"
    if quality < _PEAK:
        status = "no peak"
    elif not (0 < row < fit.shape[0] - 1 and 0 < col < fit.shape[1] - 1):
        status = "at the edge of the search"
    elif lead < _LEAD:
        status = "ambiguous"
    if status != "told":
        return BlockOffset(math.nan, math.nan, quality, lead, outline_m, status)
    near = fit[row - 1 : row + 2, col - 1 : col + 2]
    down, right = row + _vertex(near[:, 1]) - reach, col + _vertex(near[1, :]) - reach
    return BlockOffset(float(right * gsd_m), float(-down * gsd_m), quality, lead, outline_m, "told")


def region_offset(blocks: Sequence[BlockOffset]) -> RegionOffset:
    """The median of the blocks that tell; ``cannot tell`` with fewer than three of them, or when they scatter too much."""
    told = np.array([(b.dx_m, b.dy_m) for b in blocks if b.status == "told"], dtype=np.float64).reshape(-1, 2)
    if len(told) < _LEAST_BLOCKS:
        return RegionOffset(math.nan, math.nan, math.nan, math.nan, len(told), len(blocks), "cannot tell")
    middle = np.median(told, axis=0)
    spread = float(1.4826 * np.median(np.abs(told - middle), axis=0).max())
    # The standard error of a median is 1.25 times that of a mean, for normal scatter.
    sigma = 1.2533 * spread / math.sqrt(len(told))
    if sigma > 1.0:
        return RegionOffset(math.nan, math.nan, sigma, spread, len(told), len(blocks), "cannot tell")
    return RegionOffset(float(middle[0]), float(middle[1]), sigma, spread, len(told), len(blocks), "told")


def offset_at(
    blocks: NDArray[np.float64], whole: NDArray[np.float64], side_m: float, bounds: Bounds
) -> tuple[float, float]:
    """(dx, dy) in metres by which the labels within ``bounds`` are moved: the median of the blocks about it that tell.

    Where fewer than three of them do, the region's; none where that cannot tell either.

    Args:
        blocks: (n, 4) float64 middle x, y and offset dx, dy of the blocks that tell.
        whole: (2,) float64 offset of the region, zero where it cannot tell.
        side_m: of a block.
        bounds: (left, bottom, right, top).
    """
    if not whole.any():
        return (0.0, 0.0)  # what the region does not tell, its blocks tell by chance
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    near = blocks[np.abs(blocks[:, :2] - (x, y)).max(axis=1) <= 1.5 * side_m, 2:]
    dx, dy = np.median(near, axis=0) if len(near) >= 3 else whole
    return (float(dx), float(dy))


def _double_angle(gx: NDArray[np.float32], gy: NDArray[np.float32]) -> tuple[Complex, NDArray[np.float32]]:
    """((gx + i gy)^2 / |g|^2, |g|): the unit direction at doubled angle and the strength."""
    strength = np.hypot(gx, gy)
    g = gx + 1j * gy
    unit = np.where(strength > 1e-6, g * g / np.maximum(strength * strength, 1e-12), 0)
    return unit.astype(np.complex64), strength


def _gradient(grey: NDArray[np.float32], sigma_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    smooth = cv2.GaussianBlur(grey, (0, 0), max(sigma_px, 0.7), borderType=cv2.BORDER_REPLICATE)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(gx, np.float32), np.asarray(gy, np.float32)


def _outline_field(mask: NDArray[np.uint8], sigma_px: float) -> tuple[Complex, float]:
    """Doubled-angle field of the outlines, and their length in pixels; nothing at the border of the unknown."""
    gx, gy = _gradient((mask == 1).astype(np.float32), sigma_px)
    unit, strength = _double_angle(gx, gy)
    strength = strength * _inside(mask <= 1, sigma_px)
    # Across an outline the gradient of a step sums to one, whatever the blur.
    return (unit * strength).astype(np.complex64), float(strength.sum())


def _edge_field(image: NDArray[np.uint8], seen: NDArray[np.bool_], sigma_px: float) -> Complex:
    """Doubled-angle field of the picture's edges, of the channel with the strongest one; strong edges saturate."""
    best_gx, best_gy = _gradient(image[..., 0].astype(np.float32), sigma_px)
    for channel in (1, 2):
        gx, gy = _gradient(image[..., channel].astype(np.float32), sigma_px)
        stronger = gx * gx + gy * gy > best_gx * best_gx + best_gy * best_gy
        best_gx, best_gy = np.where(stronger, gx, best_gx), np.where(stronger, gy, best_gy)
    unit, strength = _double_angle(best_gx, best_gy)
    known = _inside(seen, sigma_px)
    # A white roof beside black asphalt must not outweigh ten others.
    typical = float(np.percentile(strength[known > 0], 90)) if (known > 0).any() else 1.0
    weight = strength / (strength + max(typical, 1e-6)) * known
    return (unit * weight).astype(np.complex64)


def _inside(known: NDArray[np.bool_], sigma_px: float) -> NDArray[np.float32]:
    """1 where all pixels that a gradient looks at are known, else 0."""
    size = 2 * math.ceil(3 * max(sigma_px, 0.7) + 1) + 1
    kernel = np.ones((size, size), np.uint8)
    eroded = cv2.erode(known.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray(eroded, dtype=np.float32)


def _correlate(outlines: Complex, edges: Complex, reach: int) -> NDArray[np.float64]:
    """(2 reach + 1)^2 agreement of the outlines, moved down and right by -reach..reach pixels, with the edges."""
    shape = [fft.next_fast_len(n + reach) for n in outlines.shape]
    spectrum = np.conj(fft.fft2(outlines, shape)) * fft.fft2(edges, shape)
    whole = fft.ifft2(spectrum).real
    at = np.arange(-reach, reach + 1)
    return np.asarray(whole[np.ix_(at, at)], dtype=np.float64)


def _vertex(three: NDArray[np.float64]) -> float:
    """Where the parabola through three equally spaced values peaks, from the middle one; -0.5 to 0.5."""
    a, b, c = (float(v) for v in three)
    bend = a - 2 * b + c
    return 0.0 if bend >= 0 else max(-0.5, min(0.5, 0.5 * (a - c) / bend))
