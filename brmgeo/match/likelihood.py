"""Log-likelihood ratios of a view against a background: of its whole mask, and of its ratio rings.

**Mask.** For a pose, c is the building share of a map cell under a patch of the view, m its known share, k the
mask's building share and w its known share. A mask pixel is building with P1 over a mapped building and P0
elsewhere; under the background, that this view has nothing to do with this place, with the view's own rate pb.
Per patch

    llr = k [c log(P1/pb) + (m-c) log(P0/pb)] + (w-k) [c log((1-P1)/(1-pb)) + (m-c) log((1-P0)/(1-pb))] = c a + m b,

so a heading costs one correlation of the building cover with ``a`` and, where ground is unknown, one of the
known cover with ``b``. Unknown ground and unseen pixels add nothing. Mask and map differ by whole buildings,
so a patch counts as its area over the area that carries one independent observation. pb is kept within [P0,
P1]: a blank view then says nothing in favour of any place, it only speaks against built-up ones.

**Rings.** The ratios in n discs (eq. 1-3) are differenced into n rings, whose errors hardly depend on each
other. A ring's share is expected at P0 + (P1-P0) G and scatters by missed and invented buildings, P(1-P) over
the number of independent areas in the ring, by the position within a cell, and by a floor; a Student density
keeps one odd ring from deciding. The background is the map's own distribution: the mean likelihood over all
its cells, half and half with an even spread over rings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.match.belief import BLOCK
from brmgeo.match.settings import RateSettings, RatioSettings
from brmgeo.match.threads import THREADS, pool, split

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ViewPoints:
    """A view as patches on the ground.

    Attributes:
        forward, left: (n,) float32 metres from the nadir point, ahead of and to the left of the nose.
        built, known: (n,) float32 square metres of building and of known mask in the patch.
    """

    forward: F32
    left: F32
    built: F32
    known: F32

    @property
    def rate(self) -> float:
        """Share of building in what is known, [0, 1]; 0 when nothing is known."""
        total = float(self.known.sum(dtype=np.float64))
        return float(self.built.sum(dtype=np.float64)) / total if total > 0 else 0.0

    @property
    def area_m2(self) -> float:
        """Known area, square metres."""
        return float(self.known.sum(dtype=np.float64))

    @property
    def reach_m(self) -> float:
        """Distance of the farthest known patch from the nadir point, metres."""
        if not len(self.forward):
            return 0.0
        return float(np.sqrt(np.max(self.forward**2 + self.left**2)))


def view_points(view: View, patch_m: float) -> ViewPoints:
    """The view's known ground in square patches of about ``patch_m`` (whole pixels, at least one)."""
    q = max(1, round(patch_m / view.gsd_m))
    h, w = view.known.shape
    n, m = -(-h // q), -(-w // q)
    known = np.zeros((n * q, m * q), np.float32)
    known[:h, :w] = view.known
    built = np.zeros((n * q, m * q), np.float32)
    built[:h, :w] = view.building
    built *= known
    share = np.float32(view.gsd_m**2)
    known_sum = known.reshape(n, q, m, q).sum(axis=(1, 3)) * share
    built_sum = built.reshape(n, q, m, q).sum(axis=(1, 3)) * share
    rows, cols = np.nonzero(known_sum > 0)
    forward = (view.nadir_px[0] - (rows + 0.5) * q) * view.gsd_m
    left = (view.nadir_px[1] - (cols + 0.5) * q) * view.gsd_m
    return ViewPoints(
        forward.astype(np.float32), left.astype(np.float32), built_sum[rows, cols], known_sum[rows, cols]
    )


@dataclass(frozen=True, slots=True)
class Rates:
    """P1, P0 and the area of one independent observation, as they are now."""

    hit: float
    false_alarm: float
    independent_m2: float

    def weights(self, rate: float) -> tuple[float, float, float, float]:
        """Per square metre: (a of building, a of other, b of building, b of other) for a view of this ``rate``."""
        p1, p0 = self.hit, self.false_alarm
        pb = min(max(rate, p0), p1)
        scale = 1.0 / self.independent_m2
        return (
            scale * math.log(p1 / p0),
            scale * math.log((1 - p1) / (1 - p0)),
            scale * math.log(p0 / pb),
            scale * math.log((1 - p0) / (1 - pb)),
        )


class RateLearner:
    """P1 and P0 from registered views: more careful than the settings where the views are worse, never more trusting.

    Counts are kept in independent areas, so that one view weighs about as much as the buildings it shows; the
    settings count as ``PRIOR`` such areas each, and old views fade.
    """

    PRIOR = 60.0
    FADE = 0.98

    def __init__(self, settings: RateSettings) -> None:
        self._settings = settings
        self._hits = np.array([settings.hit, 1.0 - settings.hit]) * self.PRIOR
        self._alarms = np.array([settings.false_alarm, 1.0 - settings.false_alarm]) * self.PRIOR
        self.rates = Rates(settings.hit, settings.false_alarm, settings.independent_m2)

    def learn(self, built_on: float, other_on: float, built_off: float, other_off: float) -> None:
        """Take in one registered view: square metres of building and other, over mapped buildings and elsewhere."""
        if not self._settings.learn:
            return
        unit = self.rates.independent_m2
        self._hits = self._hits * self.FADE + (1 - self.FADE) * self._prior(self._settings.hit)
        self._alarms = self._alarms * self.FADE + (1 - self.FADE) * self._prior(self._settings.false_alarm)
        self._hits += np.array([built_on, other_on]) / unit
        self._alarms += np.array([built_off, other_off]) / unit
        hit = float(self._hits[0] / self._hits.sum())
        alarm = float(self._alarms[0] / self._alarms.sum())
        # A map and masks that hardly agree must not talk the filter into believing anything.
        hit = min(max(hit, 0.4), self._settings.hit)
        alarm = max(min(alarm, 0.5 * hit), self._settings.false_alarm)
        self.rates = Rates(hit, alarm, unit)

    def _prior(self, share: float) -> F64:
        return np.array([share, 1.0 - share]) * self.PRIOR


@nb.njit(cache=True, nogil=True)
def _splat(forward, left, built, known, yaw, wanted, cell, reach, out_k, out_w, h0, h1):  # type: ignore[no-untyped-def]
    """Patches laid onto cells about the nadir's cell for each yaw, area shared between the four nearest centres."""
    size = 2 * reach + 1
    for h in range(h0, h1):
        if not wanted[h]:
            continue
        c, s = math.cos(yaw[h]), math.sin(yaw[h])
        for i in range(size):
            for j in range(size):
                out_k[h, i, j] = 0.0
                out_w[h, i, j] = 0.0
        for n in range(forward.shape[0]):
            x = (forward[n] * c - left[n] * s) / cell + reach
            y = -(forward[n] * s + left[n] * c) / cell + reach
            j0, i0 = math.floor(x), math.floor(y)
            fx, fy = x - j0, y - i0
            for di in range(2):
                wy = fy if di else 1.0 - fy
                for dj in range(2):
                    w = wy * (fx if dj else 1.0 - fx)
                    i, j = i0 + di, j0 + dj
                    if 0 <= i < size and 0 <= j < size:
                        out_k[h, i, j] += w * built[n]
                        out_w[h, i, j] += w * known[n]


def mask_templates(
    points: ViewPoints, yaw_rad: F64, cell_m: float, rates: Rates, wanted: NDArray[np.bool_] | None = None
) -> tuple[F32, F32]:
    """Templates a and b of the mask's log-likelihood ratio, for each yaw of the body in the map (zeros where
    not wanted).

    Returns two (yaws, 2 R + 1, 2 R + 1) float32: the ratio at a cell is the sum over the template of a times
    the map's building share and b times its known share, the template's middle on the cell.
    """
    reach = math.ceil(points.reach_m / cell_m) + 1
    shape = (len(yaw_rad), 2 * reach + 1, 2 * reach + 1)
    k, w = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    if wanted is None:
        wanted = np.ones(len(yaw_rad), np.bool_)
    shown = wanted
    split(
        lambda h0, h1: _splat(
            points.forward,
            points.left,
            points.built,
            points.known,
            yaw_rad,
            shown,
            cell_m,
            reach,
            k,
            w,
            h0,
            h1,
        ),
        len(yaw_rad),
        8 if shown.sum() > 16 else len(yaw_rad),
    )
    a_k, a_o, b_k, b_o = rates.weights(points.rate)
    w -= k
    return np.float32(a_k) * k + np.float32(a_o) * w, np.float32(b_k) * k + np.float32(b_o) * w


class MapCover:
    """The map's building and known cover on the grid of cells, ready for correlation with templates.

    Args:
        built, known: (rows, cols) float32 shares of the cells.
    """

    TILE = 1024

    def __init__(self, built: F32, known: F32) -> None:
        self.built, self.known = built, known
        self.shape = built.shape
        self._margin = -1
        self._built_pad = self._known_pad = np.empty((0, 0), np.float32)
        self._reach = -1

    def padded(self, margin: int) -> tuple[F32, F32]:
        """Both covers with at least ``margin`` cells of unknown ground around, rows and cols to whole blocks."""
        if margin > self._margin:
            rows, cols = self.shape
            after = (margin + -rows % BLOCK, margin + -cols % BLOCK)
            pad = ((margin, after[0]), (margin, after[1]))
            self._built_pad, self._known_pad = np.pad(self.built, pad), np.pad(self.known, pad)
            self._margin = margin
        cut = self._margin - margin
        view = (slice(cut, None), slice(cut, None))
        return self._built_pad[view], self._known_pad[view]

    def score_blocks(self, keys: NDArray[np.int32], a: F32, b: F32) -> F32:
        """Ratios at listed blocks: (n, 16, 16) float32 for keys (heading, block row, block col); a, b by heading."""
        out = np.empty((len(keys), BLOCK, BLOCK), np.float32)
        if len(keys):
            reach = a.shape[1] // 2
            built, known = self.padded(reach)
            split(lambda t0, t1: _score_blocks(built, known, keys, a, b, out, t0, t1), len(keys), 16)
        return out

    def score_all(self, a: F32, b: F32, wanted: NDArray[np.bool_]) -> Iterator[F32 | None]:
        """Ratios at every cell, heading by heading: (rows, cols) float32, or None where ``wanted`` is False.

        By Fourier transforms of tiles of at most 1024 cells, a few headings at a time, so memory does not
        follow the number of headings. The known cover's part varies slowly: it is summed on cells four times
        as large and interpolated, which changes the ratio only near the edge of known ground, by a few
        hundredths of the template's sum at most.
        """
        reach = a.shape[1] // 2
        self._prepare(reach)
        for first in range(0, len(a), THREADS):
            some = [h for h in range(first, min(first + THREADS, len(a))) if wanted[h]]
            outs = pool().map(lambda h: self._correlate(a[h], b[h], reach), some)
            for h in range(first, min(first + THREADS, len(a))):
                yield next(outs) if wanted[h] else None

    def _prepare(self, reach: int) -> None:
        """Tiles, their size and, for small maps, their spectra for templates of this reach."""
        if self._reach == reach:
            return
        self._reach = reach
        rows, cols = self.shape
        core = self.TILE - 2 * reach if max(self.shape) > self.TILE else max(self.shape)
        if core < 64:
            core = max(self.shape)
        self._tiles = [
            (r, c, min(core, rows - r), min(core, cols - c))
            for r in range(0, rows, core)
            for c in range(0, cols, core)
        ]
        self._size = (
            scipy.fft.next_fast_len(min(rows, core) + 2 * reach, real=True),
            scipy.fft.next_fast_len(min(cols, core) + 2 * reach, real=True),
        )
        self._spectra: list[NDArray[np.complex64] | None] = []
        built, known = self.padded(reach)
        keep = len(self._tiles) <= 16
        for r, c, h, w in self._tiles:
            cut = built[r : r + h + 2 * reach, c : c + w + 2 * reach]
            # Without a building in reach the correlation with ``a`` is zero; without room to keep it, it is made anew.
            self._spectra.append(scipy.fft.rfft2(cut, s=self._size) if keep and cut.any() else None)
        self._keep = keep
        n, m = -(-known.shape[0] // 4), -(-known.shape[1] // 4)
        wide = np.zeros((n * 4, m * 4), np.float32)
        wide[: known.shape[0], : known.shape[1]] = known
        coarse = wide.reshape(n, 4, m, 4).mean(axis=(1, 3))
        self._coarse_size = (scipy.fft.next_fast_len(n, real=True), scipy.fft.next_fast_len(m, real=True))
        self._coarse_known = scipy.fft.rfft2(coarse, s=self._coarse_size)

    def _correlate(self, a: F32, b: F32, reach: int) -> F32:
        rows, cols = self.shape
        side = -(-b.shape[0] // 4) * 4
        wide = np.zeros((side, side), np.float32)
        wide[: b.shape[0], : b.shape[1]] = b
        sums = wide.reshape(side // 4, 4, side // 4, 4).sum(axis=(1, 3))
        product = np.conj(scipy.fft.rfft2(sums, s=self._coarse_size))
        product *= self._coarse_known
        slow = scipy.fft.irfft2(product, s=self._coarse_size, overwrite_x=True)
        affine = np.array([[0.25, 0.0, 0.0], [0.0, 0.25, 0.0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        out: F32 = cv2.warpAffine(slow, affine, (cols, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        template: NDArray[np.complex64] | None = None
        built, _ = self.padded(reach)
        for (r, c, h, w), kept in zip(self._tiles, self._spectra):
            spectrum = kept
            if spectrum is None:
                cut = built[r : r + h + 2 * reach, c : c + w + 2 * reach]
                if self._keep or not cut.any():
                    continue
                spectrum = scipy.fft.rfft2(cut, s=self._size)
            if template is None:
                template = np.conj(scipy.fft.rfft2(a, s=self._size))
            fast = scipy.fft.irfft2(spectrum * template, s=self._size, overwrite_x=True)
            out[r : r + h, c : c + w] += fast[:h, :w]
        return out


@nb.njit(cache=True, nogil=True, fastmath=True)
def _score_blocks(built, known, keys, a, b, out, t0, t1):  # type: ignore[no-untyped-def]
    size = a.shape[1]
    for t in range(t0, t1):
        h, top, left = keys[t, 0], keys[t, 1] * BLOCK, keys[t, 2] * BLOCK
        acc = np.zeros((BLOCK, BLOCK), np.float32)
        # Where all ground in reach is known, the second correlation is the template's sum.
        whole = True
        for i in range(top, top + BLOCK + size - 1):
            for j in range(left, left + BLOCK + size - 1):
                if known[i, j] < 0.9999:
                    whole = False
                    break
            if not whole:
                break
        total = np.float32(0.0)
        for oy in range(size):
            for ox in range(size):
                va, vb = a[h, oy, ox], b[h, oy, ox]
                if va == 0.0 and vb == 0.0:
                    continue
                if whole:
                    total += vb
                    for i in range(BLOCK):
                        row = built[top + i + oy]
                        for j in range(BLOCK):
                            acc[i, j] += va * row[left + ox + j]
                else:
                    for i in range(BLOCK):
                        row = built[top + i + oy]
                        other = known[top + i + oy]
                        for j in range(BLOCK):
                            acc[i, j] += va * row[left + ox + j] + vb * other[left + ox + j]
        for i in range(BLOCK):
            for j in range(BLOCK):
                out[t, i, j] = acc[i, j] + total


@dataclass(frozen=True, slots=True)
class Rings:
    """Ring shares of a view: (n,) float64 ``share`` in [0, 1] and known area ``area_m2``, and the ``radius_m``
    of the discs."""

    share: F64
    area_m2: F64
    radius_m: F64


def view_rings(view: View, count: int) -> Rings:
    """Shares of building in ``count`` rings between the radii r_k = k / count of the view's largest disc (eq. 1-3).

    A pixel belongs to a disc when its centre does; unknown pixels count in neither sum. A ring without known
    pixels has area 0.
    """
    h, w = view.known.shape
    row = (np.arange(h) + 0.5 - view.nadir_px[0]) * view.gsd_m
    col = (np.arange(w) + 0.5 - view.nadir_px[1]) * view.gsd_m
    ring = np.sqrt(row[:, None] ** 2 + col[None, :] ** 2) * (count / view.radius_m)
    index = np.minimum(np.ceil(ring).astype(np.int64) - 1, count).clip(0)
    known = view.known
    n = np.bincount(index[known], minlength=count + 1)[:count].astype(np.float64)
    k = np.bincount(index[known], weights=view.building[known].astype(np.float64), minlength=count + 1)[
        :count
    ]
    share = np.divide(k, n, out=np.zeros(count), where=n > 0)
    radius = view.radius_m * (np.arange(count) + 1) / count
    return Rings(share, n * view.gsd_m**2, radius)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _ring_loglik(built, known, share, area, hit, alarm, unit, floor, move, dof, out, i0, i1):  # type: ignore[no-untyped-def]
    """log p(rings | cell): (rows, cols) from (n, rows, cols) square metres of building and known ground in discs."""
    n, _rows, cols = built.shape
    # lgamma terms make densities of different widths comparable with the even spread of the background.
    const = math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2) - 0.5 * math.log(dof * math.pi)
    for i in range(i0, i1):
        for j in range(cols):
            used = 0
            # Products instead of sums of logarithms: at most 32 factors between 1e-7 and 1e6 stay in range.
            spread = 1.0
            apart = 1.0
            for k in range(n):
                if area[k] <= 0:
                    continue
                b, m = built[k, i, j], known[k, i, j]
                if k:
                    b -= built[k - 1, i, j]
                    m -= known[k - 1, i, j]
                if m < 0.5 * area[k]:
                    # Ground that the map does not know: as good as the background's even spread.
                    continue
                g = b / m
                p = alarm + (hit - alarm) * g
                var = (g * hit * (1 - hit) + (1 - g) * alarm * (1 - alarm)) * unit / area[k]
                var += floor * floor + move[k]
                d = share[k] - p
                spread *= var
                apart *= 1.0 + d * d / (dof * var)
                used += 1
            out[i, j] = used * const - 0.5 * math.log(spread) - 0.5 * (dof + 1) * math.log(apart)


def ring_loglik(
    rings: Rings, built: F32, known: F32, rates: Rates, settings: RatioSettings, move: F64 | None = None
) -> F32:
    """log p(rings | place), (...) float32, for maps of the ground in the discs of the rings' radii.

    Args:
        rings: of the view.
        built, known: (n, ..., cols) float32 square metres of building and of known ground in each disc.
        rates: P1, P0 and the independent area.
        settings: floor and degrees of freedom.
        move: (n,) variance of each ring's ratio within what a place stands for (``cell_variance``), or None for points.
    """
    n, cols = len(built), built.shape[-1]
    flat_built, flat_known = built.reshape(n, -1, cols), known.reshape(n, -1, cols)
    more = np.zeros(n) if move is None else move
    out = np.empty(flat_built.shape[1:], np.float32)
    split(
        lambda i0, i1: _ring_loglik(
            flat_built, flat_known, rings.share, rings.area_m2,
            rates.hit, rates.false_alarm, rates.independent_m2, settings.noise, more, settings.dof, out, i0, i1,
        ),
        len(out),
        64,
    )  # fmt: skip
    return out.reshape(built.shape[1:])


def cell_variance(built: F32, known: F32) -> F64:
    """(n,) variance of each ring's ratio within a cell, from (n, ..., rows, cols) areas in discs about cells' centres.

    A place is spread evenly over its cell: a twelfth of the variance between neighbouring cells, per axis.
    """
    ring_built = np.diff(built, axis=0, prepend=np.float32(0))
    ring_known = np.diff(known, axis=0, prepend=np.float32(0))
    share = np.divide(ring_built, ring_known, out=np.zeros_like(ring_built), where=ring_known > 0)
    axes = tuple(range(1, share.ndim))
    total = np.zeros(len(built))
    for axis in (-2, -1):
        total += (np.diff(share, axis=axis) ** 2).mean(axis=axes, dtype=np.float64) / 12.0
    return total
