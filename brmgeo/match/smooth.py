"""The flight's path after the flight: all fixes and all odometry at once, also before the first fix.

Each frame's state is x, y, heading of the odometry frame and log scale (``brmgeo.match.track``). Odometry
links neighbours, registered poses anchor; the least-squares problem is solved by Gauss-Newton with robust
weights on the anchors, and each linear problem by forward and backward elimination of its block-tridiagonal
normal matrix, which also gives every frame's covariance. A step without odometry cuts the chain; a piece
without an anchor has no place, nor has a frame whose sigma exceeds ``MOST_SIGMA_M``: its rows are NaN with infinite
sigma.

In a second round the frames without an anchor are registered about the smoothed poses: seen from behind, the
part before the first fix is as well known as the rest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Motion
from brmgeo.match.settings import OdometrySettings
from brmgeo.match.track import advance, wrap

F64 = NDArray[np.float64]

#: Beyond this a place is none: one fix whose heading is open says nothing of where the frames about it were.
MOST_SIGMA_M = 200.0
#: A yaw whose variance exceeds this is as good as unknown; pi^2 stands for no yaw at all.
MOST_YAW_VARIANCE = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedPath:
    """The whole path after the flight.

    Attributes:
        t_s: (n,) times of the views, seconds.
        xy: (n, 2) places in the map frame, metres; NaN where nothing anchors that part of the flight, or so loosely that
            sigma would exceed 200 m.
        yaw_rad: (n,) yaw of the body in the map frame; NaN where unknown.
        sigma_m: (n,) root of half the trace of the place's covariance, metres; infinite where ``xy`` is NaN.
    """

    t_s: F64
    xy: F64
    yaw_rad: F64
    sigma_m: F64


@dataclass(frozen=True, slots=True)
class Anchor:
    """A measured pose: (3,) x, y, yaw of the body, its (3, 3) covariance, and how well the view overlaps the map (Dice)."""

    pose: F64
    covariance: F64
    fit: float = 1.0


def smooth_path(
    times_s: Sequence[float],
    motions: Sequence[Motion],
    anchors: Sequence[Anchor | None],
    settings: OdometrySettings,
    register: Callable[[int, F64, F64], Anchor | None] | None = None,
    rounds: int = 2,
) -> SmoothedPath:
    """The most likely path.

    Args:
        times_s: (n,) times of the views.
        motions: n motions; the first one's step is not used.
        anchors: n poses or None.
        settings: error model of the odometry.
        register: gives an anchor for frame i near (3,) x, y, yaw of the body with (3, 3) covariance, or None; used for
            frames that have none.
        rounds: how often frames are registered anew.
    """
    n = len(times_s)
    xy = np.full((n, 2), np.nan)
    yaw = np.full(n, np.nan)
    sigma = np.full(n, np.inf)
    cuts = [0, *(i for i in range(1, n) if motions[i].step_m is None), n]
    anchors = list(anchors)
    for first, last in itertools.pairwise(cuts):
        span = range(first, last)
        if not any(anchors[i] is not None for i in span):
            continue
        piece = _Piece([motions[i] for i in span], settings)
        solved = piece.solve([anchors[i] for i in span])
        for _ in range(rounds if register is not None else 0):
            found = False
            for k, i in enumerate(span):
                if anchors[i] is None and register is not None:
                    about = _about(motions[i], solved[0][k], solved[1][k], settings)
                    anchors[i] = None if about is None else register(i, *about)
                    found |= anchors[i] is not None
            if not found:
                break
            solved = piece.solve([anchors[i] for i in span])
        for k, i in enumerate(span):
            mean, cov = solved[0][k], solved[1][k]
            spread = math.sqrt(max(0.0, float(cov[0, 0] + cov[1, 1])) / 2.0)
            if spread > MOST_SIGMA_M:
                continue
            xy[i], sigma[i] = mean[:2], spread
            body = motions[i].yaw_rad
            anchor = anchors[i]
            if body is not None:
                if float(cov[2, 2]) <= MOST_YAW_VARIANCE:
                    yaw[i] = wrap(float(mean[2]) + body)
            elif anchor is not None and float(anchor.covariance[2, 2]) <= MOST_YAW_VARIANCE:
                yaw[i] = wrap(float(anchor.pose[2]))
    return SmoothedPath(np.asarray(times_s, np.float64), xy, yaw, sigma)


def _about(motion: Motion, mean: F64, covariance: F64, settings: OdometrySettings) -> tuple[F64, F64] | None:
    """(3,) x, y, yaw of the body about which a view is registered and its covariance; None where that yaw is unknown."""
    pose, spread = mean[:3].copy(), covariance[:3, :3].copy()
    if motion.yaw_rad is not None:
        pose[2] = wrap(float(mean[2]) + motion.yaw_rad)
        return pose, spread
    if motion.compass_yaw_rad is None:
        # The heading of the odometry's frame is not the body's yaw.
        return None
    pose[2] = motion.compass_yaw_rad
    spread[2, :] = spread[:, 2] = 0.0
    spread[2, 2] = settings.compass_sigma_rad**2
    return pose, spread


class _Piece:
    """One chain of steps without a gap."""

    ROBUST = 9.0  # squared distance beyond which an anchor loses weight (3 degrees of freedom: 97 %)

    def __init__(self, motions: list[Motion], settings: OdometrySettings) -> None:
        self._motions = motions
        self._settings = settings

    def solve(self, anchors: Sequence[Anchor | None]) -> tuple[F64, F64]:
        """(n, 4) states and (n, 4, 4) covariances."""
        states = self._start(anchors)
        covs = np.empty((len(states), 4, 4))
        for _ in range(8):
            step, covs = self._newton(states, anchors)
            states = states + step
            if float(np.abs(step[:, :2]).max()) < 1e-3:
                break
        return states, covs

    def _start(self, anchors: Sequence[Anchor | None]) -> F64:
        """Odometry hung up at the first anchor, forwards and backwards."""
        k = next(i for i, a in enumerate(anchors) if a is not None)
        anchor = anchors[k]
        assert anchor is not None
        n = len(self._motions)
        states = np.zeros((n, 4))
        heading = self._heading(anchors)
        states[k, :2] = anchor.pose[:2]
        states[:, 2] = heading
        for i in range(k + 1, n):
            states[i] = advance(states[i - 1], self._motions[i], self._settings)[0]
        for i in range(k - 1, -1, -1):
            step = advance(states[i], self._motions[i + 1], self._settings)[0][:2] - states[i, :2]
            states[i, :2] = states[i + 1, :2] - step
        return states

    def _heading(self, anchors: Sequence[Anchor | None]) -> float:
        """Heading of the odometry frame that the anchors' yaws agree on, or their places where yaw is not known."""
        turn = complex(0.0)
        for anchor, motion in zip(anchors, self._motions):
            if anchor is not None and motion.yaw_rad is not None:
                weight = 1.0 / (float(anchor.covariance[2, 2]) + 0.01)
                angle = float(anchor.pose[2]) - motion.yaw_rad
                turn += weight * complex(math.cos(angle), math.sin(angle))
        if abs(turn) == 0.0:
            here = [i for i, a in enumerate(anchors) if a is not None]
            track = np.cumsum(
                [
                    np.zeros(2) if m.step_m is None or i == 0 else m.step_m
                    for i, m in enumerate(self._motions)
                ],
                axis=0,
            )
            places = np.array([anchors[i].pose[:2] for i in here])  # type: ignore[union-attr]
            a = (track[here] - track[here].mean(axis=0)) @ np.array([1, 1j])
            b = (places - places.mean(axis=0)) @ np.array([1, 1j])
            turn = complex(np.sum(b * np.conj(a)))
        return math.atan2(turn.imag, turn.real)

    def _newton(self, states: F64, anchors: Sequence[Anchor | None]) -> tuple[F64, F64]:
        n = len(states)
        diag = np.zeros((n, 4, 4))
        below = np.zeros((n, 4, 4))  # block (i, i - 1)
        right = np.zeros((n, 4))
        # A weak prior holds what no anchor reaches; the scale's is the settings' own.
        diag[0] += np.diag([1e-10, 1e-10, 1e-4, 1.0 / max(self._settings.scale_sigma, 1e-4) ** 2])
        right[0, 3] -= states[0, 3] / max(self._settings.scale_sigma, 1e-4) ** 2
        for i in range(1, n):
            after, jac, noise = advance(states[i - 1], self._motions[i], self._settings)
            info = np.linalg.inv(noise)
            error = states[i] - after
            error[2] = wrap(float(error[2]))
            diag[i] += info
            diag[i - 1] += jac.T @ info @ jac
            below[i] -= info @ jac
            right[i] -= info @ error
            right[i - 1] += jac.T @ info @ error
        for i, anchor in enumerate(anchors):
            if anchor is None:
                continue
            yaw = self._motions[i].yaw_rad
            rows = 2 if yaw is None else 3
            info = np.linalg.inv(anchor.covariance[:rows, :rows])
            error = states[i, :rows] - anchor.pose[:rows]
            if yaw is not None:
                error[2] = wrap(float(states[i, 2] + yaw - anchor.pose[2]))
            d2 = float(error @ info @ error)
            info = info * (1.0 if d2 <= self.ROBUST else (self.ROBUST / d2))
            diag[i, :rows, :rows] += info
            right[i, :rows] -= info @ error
        return solve_tridiagonal(diag, below, right)


def solve_tridiagonal(diag: F64, below: F64, right: F64) -> tuple[F64, F64]:
    """Solution (n, m) of the symmetric block-tridiagonal system and the (n, m, m) diagonal blocks of its inverse."""
    n, _m = right.shape
    pivot_inv = np.empty_like(diag)
    carried = np.empty_like(right)
    for i in range(n):
        block, value = diag[i].copy(), right[i].copy()
        if i:
            factor = below[i] @ pivot_inv[i - 1]
            block -= factor @ below[i].T
            value -= factor @ carried[i - 1]
        pivot_inv[i] = np.linalg.inv(block)
        carried[i] = value
    out = np.empty_like(right)
    covs = np.empty_like(diag)
    out[-1] = pivot_inv[-1] @ carried[-1]
    covs[-1] = pivot_inv[-1]
    for i in range(n - 2, -1, -1):
        gain = pivot_inv[i] @ below[i + 1].T
        out[i] = pivot_inv[i] @ carried[i] - gain @ out[i + 1]
        covs[i] = pivot_inv[i] + gain @ covs[i + 1] @ gain.T
    return out, covs
