"""Ratio features alone, rotation invariant: the paper's measurement in a Bayes filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import BUILDING, UNKNOWN
from brmgeo.flight.values import View
from brmgeo.maps.ratio import disc_counts
from brmgeo.match.belief import Belief
from brmgeo.match.ground import DiscAreas, GroundMap, disc_pixels
from brmgeo.match.kernels import BLOCK
from brmgeo.match.rates import Rates
from brmgeo.match.rings import RingShares, cell_variance, ring_fit, ring_loglik, view_rings
from brmgeo.match.search import search
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor
from brmgeo.match.state import State

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class RatioScorer:
    """The ring ratios' likelihood; heading comes from the motion alone. See ``Scorer``."""

    SAMPLE = 96
    CHUNK = 4096

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        r = settings.ratio
        self.systematic_m = 0.0
        self.least_fit = (r.least_fit, 2)
        self.ground = ground
        self._settings = settings
        self._areas = DiscAreas(ground, settings.belief.cell_px(ground.gsd_m))
        self._rates = Rates(r.hit, r.false_alarm, r.independent_m2)
        n, m = self._areas.blocks
        self._every = np.stack(np.divmod(np.arange(n * m), m), axis=1).astype(np.int32)
        # Blocks that stand for the whole map where only few places are scored: the same ones in every frame.
        some = np.random.default_rng(0).permutation(len(self._every))[: self.SAMPLE]
        self._sample = self._every[np.sort(some)]
        self._rings: RingShares | None = None
        self._move = (0, np.empty(0))

    def look(self, view: View) -> None:
        """See ``Scorer``."""
        self._rings = view_rings(view, self._settings.ratio.radii)

    def evidence(self, view: View) -> tuple[float, float]:
        """See ``Scorer``."""
        return math.pi * view.radius_m**2, self._settings.ratio.repeat

    def learn(self, anchor: Anchor) -> None:
        """Ratios alone do not tell missed buildings from invented ones: nothing is learned."""

    def state(self) -> State:
        """See ``Scorer``: the ratios' spread within a cell, and how far around the map areas were summed."""
        step, variance = self._move
        return {"move_step": np.array(step), "move": variance, "margin": np.array(self._areas.margin)}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See ``Scorer``."""
        self._move = (int(state["move_step"]), state["move"])
        self._areas.widen(int(state["margin"]))

    def _at_blocks(self, blocks: NDArray[np.int32]) -> F32:
        """(n, 16, 16) log-likelihoods at blocks (row, col); cells beyond the map count for nothing."""
        assert self._rings is not None
        s = self._settings.ratio
        step = round(math.log(float(self._rings.radius_m[-1])) / 0.02)
        if self._move[0] != step:
            # The features' change within a cell is a property of the map and hardly moves with the radius.
            variance = cell_variance(*self._areas.at_blocks(self._sample, self._rings.radius_m))
            self._move = (step, variance)
        move = self._move[1]
        out = np.empty((len(blocks), BLOCK, BLOCK), np.float32)
        for n in range(0, len(blocks), self.CHUNK):
            part = slice(n, n + self.CHUNK)
            built, known = self._areas.at_blocks(blocks[part], self._rings.radius_m)
            out[part] = ring_loglik(self._rings, built, known, self._rates, s, move)
        return out

    def _background(self, inside: float) -> float:
        """Half the map's own distribution, half an even spread of each ring's share over [0, 1] (density 1).

        Where nothing on the map resembles the view, being off the map must win. ``inside`` is the log of the mean
        likelihood over the map.
        """
        return float(np.logaddexp(inside, 0.0)) - math.log(2.0)

    def _mean(self, loglik: F32, blocks: NDArray[np.int32]) -> tuple[float, int]:
        """Log of the summed likelihood over the cells of blocks that lie on the map, and how many these are."""
        rows, cols = self._areas.cells
        row = blocks[:, 0, None] * BLOCK + np.arange(BLOCK) < rows
        col = blocks[:, 1, None] * BLOCK + np.arange(BLOCK) < cols
        on_map = row[:, :, None] & col[:, None, :]
        if not on_map.any():
            return -math.inf, 0
        values = loglik[on_map]
        top = float(values.max())
        return top + math.log(float(np.exp(values - top).sum(dtype=np.float64))), len(values)

    def search(self, belief: Belief, yaw_rad: float, body: F64 | None, weight: float) -> float:
        """See ``Scorer``."""
        loglik = self._at_blocks(self._every)
        total, count = self._mean(loglik, self._every)
        rows, cols = belief.shape
        n, m = belief.grid
        field = loglik.reshape(n, m, BLOCK, BLOCK).transpose(0, 2, 1, 3).reshape(n * BLOCK, m * BLOCK)
        background = self._background(total - math.log(count))
        llr = np.asarray(field[:rows, :cols] - np.float32(background), np.float32)
        return search(belief, llr, *self._settings.rates.bounds, weight)

    def score_listed(self, belief: Belief, yaw_rad: float, body: F64 | None) -> F32:
        """See ``Scorer``."""
        code = belief.keys[:, 1] * np.int32(belief.grid[1]) + belief.keys[:, 2]
        unique, inverse = np.unique(code, return_inverse=True)
        blocks = self._every[unique]
        rest = self._sample[~np.isin(self._sample[:, 0] * belief.grid[1] + self._sample[:, 1], unique)]
        loglik = self._at_blocks(np.concatenate([blocks, rest]))
        # The map's mean likelihood: listed blocks for themselves, the others by the sample.
        own, count = self._mean(loglik[: len(blocks)], blocks)
        other, sampled = self._mean(loglik[len(blocks) :], rest)
        cells = belief.shape[0] * belief.shape[1]
        if sampled:
            own = float(np.logaddexp(own, other + math.log(max(cells - count, 1) / sampled)))
        background = self._background(own - math.log(cells))
        return np.ascontiguousarray((loglik - np.float32(background))[: len(blocks)][inverse.ravel()])

    def measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        """The rings' likelihood about the pose on a grid of 1 m, as one Gaussian; the heading stays unknown."""
        g = self.ground
        prior = covariance[:2, :2]
        window = min(3.0 * math.sqrt(float(prior.trace())) + 3.0, 40.0)
        rings = view_rings(view, self._settings.ratio.radii)
        stride = max(1, round(1.0 / g.gsd_m))
        half = math.ceil(window / (stride * g.gsd_m)) * stride
        row, col = int((g.top - pose[1]) / g.gsd_m), int((pose[0] - g.left) / g.gsd_m)
        if not (0 <= row < g.building.shape[0] and 0 <= col < g.building.shape[1]):
            return None
        built, known = self._discs_about(row, col, half, stride, rings.radius_m)
        loglik = ring_loglik(rings, built, known, self._rates, self._settings.ratio).astype(np.float64)
        offset = np.arange(-half, half + 1, stride)
        x = g.left + (col + offset + 0.5) * g.gsd_m - pose[0]
        y = g.top - (row + offset + 0.5) * g.gsd_m - pose[1]
        found = gaussian_of(loglik, x, y, prior)
        if found is None:
            return None
        place, spread, mean = found
        at = int(np.abs(y - mean[1]).argmin()), int(np.abs(x - mean[0]).argmin())
        fit = ring_fit(rings, built[:, at[0], at[1]], known[:, at[0], at[1]])
        full = np.zeros((3, 3))
        full[:2, :2] = spread
        full[2, 2] = math.pi**2
        return Anchor(np.array([*(pose[:2] + place), pose[2]]), full, fit)

    def _discs_about(self, row: int, col: int, half: int, stride: int, radii_m: F64) -> tuple[F32, F32]:
        """Square metres of building and of known ground in discs about every ``stride``-th pixel within ``half`` of one.

        Two (radii, n, n) float32.
        """
        g = self.ground
        h, w = g.building.shape
        halo = math.floor(float(radii_m[-1]) / g.gsd_m)
        reach = half + halo
        cut = np.full((2 * reach + 1, 2 * reach + 1), UNKNOWN, np.uint8)
        r0, r1 = max(0, row - reach), min(h, row + reach + 1)
        c0, c1 = max(0, col - reach), min(w, col + reach + 1)
        inside = (slice(r0 - row + reach, r1 - row + reach), slice(c0 - col + reach, c1 - col + reach))
        cut[inside] = g.building[r0:r1, c0:c1]
        inner = slice(halo, halo + 2 * half + 1, stride)
        area = np.float32(g.gsd_m**2)
        built, known = [], []
        whole = bool((cut != UNKNOWN).all())
        for radius in radii_m:
            radius_px = float(radius) / g.gsd_m
            counts = disc_counts(cut == BUILDING, radius_px)[inner, inner]
            built.append(counts.astype(np.float32) * area)
            if whole:
                known.append(np.full(counts.shape, area * disc_pixels(radius_px), np.float32))
            else:
                seen = disc_counts(cut != UNKNOWN, radius_px)[inner, inner]
                known.append(seen.astype(np.float32) * area)
        return np.stack(built), np.stack(known)


def gaussian_of(loglik: F64, x: F64, y: F64, prior: F64) -> tuple[F64, F64, F64] | None:
    """The Gaussian measurement that a likelihood on a grid amounts to, seen from a Gaussian prior about the origin.

    The likelihood may have several peaks. Its product with the prior has moments; the Gaussian that turns the one into
    the other is the measurement.

    Args:
        loglik: (rows, cols) log-likelihood.
        x, y: (cols,) and (rows,) places, metres.
        prior: (2, 2) covariance.

    Returns the measured place, its (2, 2) covariance and the product's mean; None where the likelihood says nothing.
    """
    inverse = np.linalg.inv(prior)
    quad = (
        inverse[0, 0] * x[None, :] ** 2
        + 2 * inverse[0, 1] * x[None, :] * y[:, None]
        + inverse[1, 1] * y[:, None] ** 2
    )
    log = loglik - 0.5 * quad
    p = np.exp(log - log.max())
    p /= p.sum()
    mean = np.array([p.sum(axis=0) @ x, p.sum(axis=1) @ y])
    dx, dy = x - mean[0], y - mean[1]
    cov = np.array([[p.sum(axis=0) @ dx**2, dy @ p @ dx], [0.0, p.sum(axis=1) @ dy**2]])
    cov[1, 0] = cov[0, 1]
    cov += np.eye(2) / 12.0
    post = np.linalg.inv(cov)
    gain, axes = np.linalg.eigh(post - inverse)
    if gain[1] <= 0:
        return None
    gain = np.maximum(gain, 1e-4)
    info = axes @ np.diag(gain) @ axes.T
    return np.linalg.solve(info, post @ mean), np.linalg.inv(info), mean
