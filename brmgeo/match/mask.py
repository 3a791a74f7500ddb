"""Log-likelihood ratios of a view's whole mask against a background, block by block, and over a whole map in three tiers.

For a pose, c is the building share of a map cell under a patch of the view, m its known share, k the
mask's building share and w its known share. A mask pixel is building with P1 over a mapped building and P0
elsewhere; under the background, that this view has nothing to do with this place, with the view's own rate pb.
A hypothesis is a cell, not a point: which pixel of the map lies under a mask pixel is open by about the cell's size, so
the mask pixel is building with p = P0 + (P1-P0) c/m. Per patch

    llr = k m log(p/pb) + (w-k) m log((1-p)/(1-pb)).

The logarithm of the mean, not the mean of the logarithms: a pose between the centres of cells and headings then keeps
its evidence (docs/matchers.md has figures). With U = m log(p/(1-p)), V = m log(1-p) of the map a heading costs two
correlations, of U with k and of V with w, and, where ground is unknown, one of m with the background's part. A whole
map is searched in three tiers (``MaskTiers``): the ratio feature of a disc bounds what any heading can reach, cells
twice as large and headings twice as wide rank what is left, and the best of these are scored at full resolution.
Unknown ground and unseen pixels add nothing. Mask and map differ by whole buildings, so a patch counts as its area over
the area that carries one independent observation. pb is kept within [P0, P1]: a blank view then says nothing in favour
of any place, it only speaks against built-up ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import View
from brmgeo.maps.ratio import Disjoint
from brmgeo.match.kernels import BLOCK
from brmgeo.match.rates import Rates
from brmgeo.match.threads import split

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


@dataclass(frozen=True, slots=True)
class MaskTemplates:
    """A view laid onto cells, for each of some yaws of the body in the map (zeros for those not wanted).

    Attributes:
        built, seen: (yaws, 2 R + 1, 2 R + 1) float32, building and known area of the mask in units of the independent area.
        background: the same shape, minus the log-likelihood under the background; it applies where the map is known.
        rates: P1 and P0.
    """

    built: F32
    seen: F32
    background: F32
    rates: Rates

    @property
    def reach(self) -> int:
        """R, cells."""
        return int(self.built.shape[1]) // 2


def mask_templates(
    points: ViewPoints, yaw_rad: F64, cell_m: float, rates: Rates, wanted: NDArray[np.bool_] | None = None
) -> MaskTemplates:
    """The view on cells of ``cell_m``: the ratio at a cell is the sum over the template, its middle on the cell.

    Areas are shared between the four nearest cell centres.
    """
    reach = math.ceil(points.reach_m / cell_m) + 1
    shape = (len(yaw_rad), 2 * reach + 1, 2 * reach + 1)
    k, w = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    if wanted is None:
        wanted = np.ones(len(yaw_rad), np.bool_)
    shown, unit = wanted, np.float32(1.0 / rates.independent_m2)
    split(
        lambda h0, h1: _splat(
            points.forward,
            points.left,
            points.built * unit,
            points.known * unit,
            yaw=yaw_rad,
            wanted=shown,
            cell=cell_m,
            reach=reach,
            out_k=k,
            out_w=w,
            h0=h0,
            h1=h1,
        ),
        len(yaw_rad),
        8 if shown.sum() > 16 else len(yaw_rad),
    )
    pb = rates.background(points.rate)
    of_built, of_other = np.float32(-math.log(pb)), np.float32(-math.log(1 - pb))
    return MaskTemplates(k, w, of_built * k + of_other * (w - k), rates)


@nb.njit(cache=True, nogil=True, fastmath=True, pipeline_class=Disjoint)
def _correlate_blocks(cover, cols, first, template, low, high, heading, out, t0, t1):  # type: ignore[no-untyped-def]
    """Adds to out[t] (256,) the correlation of a cover with template[heading[t]] at the 16 x 16 cells of a block.

    cover is flat with ``cols`` to a row; first[t] is where the block's upper left cell meets the template's; row v of
    a template is zero outside [low[h, v], high[h, v]). Four rows at a time stay in registers, if the compiler knows
    that arrays do not overlap. Positions are unsigned: signed ones would be tested for counting from the end, and the
    loop would not be vectorised.
    """
    c = np.uint64(cols)
    for t in range(t0, t1):
        h = heading[t]
        for i in range(0, BLOCK, 4):
            acc = np.zeros(4 * BLOCK, np.float32)
            for v in range(template.shape[1]):
                line = first[t] + (i + v) * cols
                for u in range(low[h, v], high[h, v]):
                    w = template[h, v, u]
                    if w == 0.0:
                        continue
                    p = np.uint64(line + u)
                    for j in range(BLOCK):
                        k = np.uint64(j)
                        acc[k] += w * cover[p + k]
                        acc[k + np.uint64(16)] += w * cover[p + c + k]
                        acc[k + np.uint64(32)] += w * cover[p + c + c + k]
                        acc[k + np.uint64(48)] += w * cover[p + c + c + c + k]
            for n in range(4 * BLOCK):
                out[t, i * BLOCK + n] += acc[n]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _log_covers(built, known, p0, gain, odds, other, i0, i1):  # type: ignore[no-untyped-def]
    """odds = m log(p / (1 - p)), other = m log(1 - p) with p = p0 + gain * c / m of rows i0 to i1."""
    empty_odds, empty_other = math.log(p0 / (1.0 - p0)), math.log(1.0 - p0)
    for i in range(i0, i1):
        for j in range(built.shape[1]):
            m = known[i, j]
            if built[i, j] <= 0.0:
                odds[i, j], other[i, j] = m * empty_odds, m * empty_other
            else:
                p = p0 + gain * min(built[i, j] / m, 1.0)
                rest = math.log(1.0 - p)
                odds[i, j], other[i, j] = m * (math.log(p) - rest), m * rest


class MapCover:
    """The map's building and known cover on a grid of cells, ready for correlation with templates.

    Args:
        built, known: (rows, cols) float32 shares of the cells.
    """

    def __init__(self, built: F32, known: F32) -> None:
        self.shape = built.shape
        self.blocks = (-(-built.shape[0] // BLOCK), -(-built.shape[1] // BLOCK))
        self._covers = (built, known)
        self._margin = 0
        self._gaps = self._unknown_blocks(known)
        self._near_gap: tuple[int, NDArray[np.bool_]] | None = None
        self._most: tuple[int, F32] | None = None
        self._evidence: tuple[Rates, int, F32, F32] | None = None

    @property
    def built(self) -> F32:
        """(rows, cols) building share of the cells."""
        return self._inner(0)

    @property
    def known(self) -> F32:
        """(rows, cols) known share of the cells."""
        return self._inner(1)

    def _inner(self, which: int) -> F32:
        m = self._margin
        return self._covers[which][m : m + self.shape[0], m : m + self.shape[1]]

    def coarser(self) -> MapCover:
        """The same ground in cells twice as large; what lies beyond the edge is unknown."""
        rows, cols = (-(-n // 2) for n in self.shape)
        halves = []
        for which in (0, 1):
            total = np.zeros((rows, cols), np.float32)
            for i in (0, 1):
                for j in (0, 1):
                    part = self._inner(which)[i::2, j::2]
                    total[: part.shape[0], : part.shape[1]] += part
            total *= np.float32(0.25)
            halves.append(total)
        return MapCover(halves[0], halves[1])

    def score_blocks(self, keys: NDArray[np.int32], templates: MaskTemplates) -> F32:
        """Ratios at blocks: (n, 16, 16) float32 for keys (heading, block row, block col).

        Cells beyond the map get a ratio as well, of the ground that their view would show.
        """
        out = np.zeros((len(keys), BLOCK * BLOCK), np.float32)
        if len(keys):
            reach = templates.reach
            self._widen(reach)
            near = self._near_unknown(reach)[keys[:, 1], keys[:, 2]]
            # Where all ground in reach is known, the background's part is its template's sum.
            out[~near] = templates.background.sum(axis=(1, 2))[keys[~near, 0], None]
            odds, other = self._logs(templates.rates)
            self._correlate(other, keys, templates.seen, out)
            self._correlate(odds, keys, templates.built, out)
            some = np.zeros((int(near.sum()), BLOCK * BLOCK), np.float32)
            self._correlate(self._covers[1], keys[near], templates.background, some)
            out[near] += some
        return out.reshape(-1, BLOCK, BLOCK)

    def _logs(self, rates: Rates) -> tuple[F32, F32]:
        """U and V of the module's docstring for cells with their margin, 0 where nothing is known; kept for these rates."""
        if self._evidence is None or self._evidence[:2] != (rates, self._margin):
            built, known = self._covers
            # Rates that are learned change often, the map's size does not.
            kept = self._evidence if self._evidence and self._evidence[2].shape == built.shape else None
            odds, other = kept[2:] if kept else (np.empty_like(built), np.empty_like(built))
            self._evidence = None
            split(
                lambda i0, i1: _log_covers(
                    built, known, rates.false_alarm, rates.hit - rates.false_alarm, odds, other, i0, i1
                ),
                len(built),
                64,
            )
            self._evidence = (rates, self._margin, odds, other)
        return self._evidence[2], self._evidence[3]

    def most_built(self, radius: int) -> F32:
        """(block rows, block cols) float32: the most building, in cells, that any cell of a block has within ``radius``
        cells of it; infinite where ground in that reach is unknown."""
        if self._most is None or self._most[0] != radius:
            y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
            disc = (x**2 + y**2 <= radius**2).astype(np.float32)
            sums = cv2.filter2D(
                np.ascontiguousarray(self.built), cv2.CV_32F, disc, borderType=cv2.BORDER_CONSTANT
            )
            rows, cols = (n * BLOCK for n in self.blocks)
            whole = np.zeros((rows, cols), np.float32)
            whole[: sums.shape[0], : sums.shape[1]] = sums
            most = whole.reshape(self.blocks[0], BLOCK, self.blocks[1], BLOCK).max(axis=(1, 3))
            most[self._near_unknown(radius)] = np.inf
            self._most = (radius, most)
        return self._most[1]

    def _correlate(self, cover: F32, keys: NDArray[np.int32], template: F32, out: F32) -> None:
        margin, reach = self._margin, template.shape[1] // 2
        cols = cover.shape[1]
        row, col = (keys[:, n].astype(np.int64) * BLOCK + margin - reach for n in (1, 2))
        filled = template != 0
        some = filled.any(axis=2)
        low = np.where(some, filled.argmax(axis=2), 0)
        high = np.where(some, template.shape[2] - filled[:, :, ::-1].argmax(axis=2), 0)
        flat, first, heading = cover.reshape(-1), row * cols + col, keys[:, 0].astype(np.int64)
        split(
            lambda t0, t1: _correlate_blocks(
                flat, cols, first, template, low=low, high=high, heading=heading, out=out, t0=t0, t1=t1
            ),
            len(keys),
            16,
        )

    def _widen(self, margin: int) -> None:
        """See that there are at least ``margin`` cells of unknown ground around, rows and cols to whole blocks."""
        if margin > self._margin or self._margin == 0:
            shape = tuple(n * BLOCK + 2 * margin for n in self.blocks)
            inner = (slice(margin, margin + self.shape[0]), slice(margin, margin + self.shape[1]))
            wide = []
            for which in (0, 1):
                wide.append(np.zeros(shape, np.float32))
                wide[-1][inner] = self._inner(which)
            self._covers, self._margin = (wide[0], wide[1]), margin

    def _unknown_blocks(self, known: F32) -> NDArray[np.bool_]:
        """(block rows, block cols): whether a block holds unknown ground, beyond the map's edge included."""
        out = np.ones(self.blocks, np.bool_)
        full = (known.shape[0] // BLOCK, known.shape[1] // BLOCK)
        for i in range(full[0]):
            band = known[i * BLOCK : (i + 1) * BLOCK, : full[1] * BLOCK].reshape(BLOCK, full[1], BLOCK)
            out[i, : full[1]] = (band < 0.9999).any(axis=(0, 2))
        return out

    def _near_unknown(self, reach: int) -> NDArray[np.bool_]:
        """(block rows, block cols): whether a block with unknown ground is in reach of a block."""
        far = -(-reach // BLOCK)
        if self._near_gap is None or self._near_gap[0] != far:
            wide = np.pad(self._gaps, far, constant_values=True).astype(np.uint8)
            near = cv2.dilate(wide, np.ones((2 * far + 1, 2 * far + 1), np.uint8))
            inner = near[far : far + self.blocks[0], far : far + self.blocks[1]]
            self._near_gap = (far, inner.astype(np.bool_))
        return self._near_gap[1]


def ceiling(points: ViewPoints, rates: Rates) -> tuple[F64, F64]:
    """The most that the mask's ratio can be over known ground with so much building in the view's reach.

    The building may lie anywhere in reach: it is laid under the mask's own building, and evenly, where it gains most (the
    ratio is concave in c). So the bound needs nothing but the ratio feature of a disc, holds for all headings, and no
    place above a limit can be missed by it.

    Returns (n,) square metres of building, increasing from 0, and (n,) the ratio's upper bound there; beyond the last
    the bound stays.
    """
    built, known = float(points.built.sum(dtype=np.float64)), points.area_m2
    pb = rates.background(points.rate)
    share = np.linspace(0.0, 1.0, 65)
    p = rates.false_alarm + (rates.hit - rates.false_alarm) * share
    other = (known - built) * math.log((1 - rates.false_alarm) / (1 - pb))
    return share * built, (built * np.log(p / pb) + other) / rates.independent_m2


class MaskTiers:
    """One view's ratios over a whole map in three tiers, for ``Belief.search_tiers``.

    First the ratio feature of the disc about a place, which needs no heading, bounds what any heading can reach there
    (``ceiling``): blocks that stay below ``PRUNE`` are not looked at again. Then larger cells and headings of 10
    degrees are scored; the belief asks for full resolution only where these are best.

    Args:
        points: the view in patches of half a cell: shared between cells, their own size is not in the templates.
        cover, coarse: the map in the belief's cells, and in cells ``scale`` times as large.
        scale: 1 or 2.
        cell_m: size of the belief's cells, metres.
        yaw_rad: (headings,) yaw of the body in the map for each heading of the belief, evenly spaced.
        rates: P1, P0 and the independent area.
        weight: factor that the belief will put on the ratios.
        body: None, or (headings,) log weights of the body's yaws, normalised, where the yaw does not follow from the
            belief's heading: then a ratio is the mean over them, the same for all headings.
    """

    PRUNE = -6.0

    def __init__(
        self,
        points: ViewPoints,
        cover: MapCover,
        coarse: MapCover,
        scale: int,
        cell_m: float,
        yaw_rad: F64,
        rates: Rates,
        weight: float,
        body: F64 | None = None,
    ) -> None:
        n = len(yaw_rad)
        merged = n // 36 if n % 36 == 0 else 1
        self.scale = scale
        self.group = merged if body is None else n
        self._cover, self._coarse = cover, coarse
        self._fine = mask_templates(points, yaw_rad, cell_m, rates)
        middle = yaw_rad[::merged] + (merged - 1) * math.pi / n
        self._rough = mask_templates(points, middle, scale * cell_m, rates)
        self._body = body
        self._rough_body = None if body is None else np.logaddexp.reduce(body.reshape(-1, merged), axis=1)
        area, bound = ceiling(points, rates)
        side = scale * cell_m
        built = coarse.most_built(math.ceil(points.reach_m / side) + 1).astype(np.float64) * side**2
        self.bound = np.interp(built, area, bound).astype(np.float32)
        self.bound[np.isinf(built)] = np.inf
        self.places = np.argwhere(self.bound * weight > self.PRUNE).astype(np.int32)

    def rough(self, keys: NDArray[np.int32]) -> F32:
        """(n, 16, 16) ratios on coarse cells for keys (group of headings, coarse block row, coarse block col)."""
        if self._rough_body is None:
            return self._coarse.score_blocks(keys, self._rough)
        return _over_yaws(self._coarse, keys[:, 1:], self._rough, self._rough_body)

    def fine(self, keys: NDArray[np.int32]) -> F32:
        """(n, 16, 16) ratios for keys (heading, block row, block col)."""
        if self._body is None:
            return self._cover.score_blocks(keys, self._fine)
        places, inverse = np.unique(keys[:, 1:], axis=0, return_inverse=True)
        return _over_yaws(self._cover, places, self._fine, self._body)[inverse.ravel()]


def _over_yaws(cover: MapCover, places: NDArray[np.int32], templates: MaskTemplates, log_weight: F64) -> F32:
    """(n, 16, 16) ratios at places (row, col of blocks), as the weighted mean of the likelihoods over yaws."""
    total = np.full((len(places), BLOCK, BLOCK), -np.inf, np.float32)
    for h in np.flatnonzero(log_weight > log_weight.max() - 15.0):
        keys = np.concatenate([np.full((len(places), 1), h), places], axis=1).astype(np.int32)
        np.logaddexp(total, cover.score_blocks(keys, templates) + np.float32(log_weight[h]), out=total)
    return total
