"""Scores of one flight against its reference: when the first fix came, how good it was, how honest sigma is.

Nothing is aligned first: estimates and reference are compared in the map's own coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Estimate, Motion

FALSE_FIX_M = 50.0


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one flight by one method; lengths in metres, times in seconds, shares in [0, 1].

    Attributes:
        frames: frames with a reference.
        flown_m: length of the reference path; gaps in it are bridged by their chord.
        first_fix_s, first_fix_m: time and distance flown before the first converged estimate; None without one.
        rmse_whole_m: of the smoothed path, over the frames where it says something; None without one.
        rmse_after_first_fix_m: of the online estimates that are converged, from the first fix on; None without one.
        rmse_whole_online_m: of the online best place over all frames, whatever its status.
        false_fixes: converged estimates more than 50 m off.
        share_converged: share of all frames that are converged.
        share_converged_after_first_fix: the same from the first fix on.
        within_sigma: share of converged estimates within 1, 2 and 3 sigma_m of the truth; a round Gaussian
            in two dimensions has 0.39, 0.86 and 0.99.
        median_after_first_fix_m, worst_after_first_fix_m: of the same errors as rmse_after_first_fix_m.
        odometry_rmse_m, odometry_rmse_after_first_fix_m: odometry alone, started at the first true pose, over the
            whole path and over the frames from the first fix on; None without odometry.
        share_smoothed: share of the frames with a reference that ``rmse_whole_m`` is taken over; None without a
            smoothed path.
    """

    frames: int
    flown_m: float
    first_fix_s: float | None
    first_fix_m: float | None
    rmse_whole_m: float | None
    rmse_after_first_fix_m: float | None
    rmse_whole_online_m: float | None
    false_fixes: int
    share_converged: float
    share_converged_after_first_fix: float | None
    within_sigma: tuple[float, float, float] | None
    median_after_first_fix_m: float | None
    worst_after_first_fix_m: float | None
    odometry_rmse_m: float | None
    odometry_rmse_after_first_fix_m: float | None
    share_smoothed: float | None = None


def travelled_m(reference_xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) float64 metres along (n, 2) positions up to each; a gap (NaN) counts its chord, spread evenly over its frames."""
    n = len(reference_xy)
    known = np.flatnonzero(np.isfinite(reference_xy).all(axis=1))
    if not len(known):
        return np.zeros(n)
    lengths = np.linalg.norm(np.diff(reference_xy[known], axis=0), axis=1)
    along = np.interp(np.arange(n), known, np.concatenate([[0.0], np.cumsum(lengths)]))
    return np.asarray(along, dtype=np.float64)


def rmse(errors: NDArray[np.float64]) -> float | None:
    """Root of the mean square of (n,) errors; None for no errors. NaNs do not count."""
    errors = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(errors**2))) if errors.size else None


def dead_reckoning(
    motions: Sequence[Motion], reference_xy: NDArray[np.float64], heading_from_m: float = 50.0
) -> NDArray[np.float64] | None:
    """(n, 2) float64 path of odometry alone, started at the first true position and heading; None without odometry.

    The reference holds positions only, so the true heading at the start is that of its first
    ``heading_from_m`` metres against the same stretch of odometry. Before the first frame with a reference the path is
    NaN. After a gap in odometry the path stands still over the gap, as odometry that starts anew at its last
    position would.
    """
    if len(motions) < 2 or all(m.step_m is None for m in motions[1:]):
        return None
    known = np.flatnonzero(np.isfinite(reference_xy).all(axis=1))
    if len(known) < 2:
        return None
    start = int(known[0])
    steps = np.array([np.zeros(2) if m.step_m is None else m.step_m for m in motions])
    steps[0] = 0.0
    path = np.cumsum(steps, axis=0)
    path -= path[start]
    path[:start] = np.nan
    flown = np.nan_to_num(np.linalg.norm(reference_xy - reference_xy[start], axis=1))
    reach = np.flatnonzero(flown >= heading_from_m)
    end = int(reach[0]) if reach.size else int(np.argmax(flown))
    true, told = reference_xy[end] - reference_xy[start], path[end]
    turn = math.atan2(true[1], true[0]) - math.atan2(told[1], told[0])
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return np.asarray(reference_xy[start] + path @ rotation.T, dtype=np.float64)


def score(
    estimates: Sequence[Estimate],
    smoothed_xy: NDArray[np.float64] | None,
    motions: Sequence[Motion],
    reference_xy: NDArray[np.float64],
) -> Scores:
    """Scores of one flight.

    Args:
        estimates: n online estimates, one a frame.
        smoothed_xy: (n, 2) float64 smoothed path, metres, NaN where it says nothing; or None.
        motions: n motions, the first of which is ignored.
        reference_xy: (n, 2) float64 true positions in the map's CRS, metres; NaN where the reference has a gap.

    Raises ValueError when the lengths differ.
    """
    n = len(estimates)
    if reference_xy.shape != (n, 2) or len(motions) != n:
        raise ValueError(
            f"{n} estimates, {len(motions)} motions and reference {reference_xy.shape} do not match"
        )
    known = np.isfinite(reference_xy).all(axis=1)
    mean = np.array([e.mean for e in estimates], dtype=np.float64).reshape(n, 2)
    errors = np.linalg.norm(mean - reference_xy, axis=1)
    converged = np.array([e.status == "converged" for e in estimates], dtype=bool)
    travelled = travelled_m(reference_xy)
    first = int(np.argmax(converged)) if converged.any() else None
    fixes = converged & known
    after = errors[fixes]
    sigma = np.array([np.sqrt(np.trace(e.covariance) / 2.0) for e in estimates])
    within = None
    if fixes.any():
        ratio = errors[fixes] / np.maximum(sigma[fixes], 1e-9)
        within = (
            float(np.mean(ratio <= 1)),
            float(np.mean(ratio <= 2)),
            float(np.mean(ratio <= 3)),
        )
    reckoned = dead_reckoning(motions, reference_xy)
    smoothed = None if smoothed_xy is None else np.linalg.norm(np.asarray(smoothed_xy) - reference_xy, axis=1)
    drift = None if reckoned is None else np.linalg.norm(reckoned - reference_xy, axis=1)
    t0 = estimates[0].t_s if n else 0.0
    return Scores(
        frames=int(known.sum()),
        flown_m=float(travelled[-1]) if n else 0.0,
        first_fix_s=None if first is None else float(estimates[first].t_s - t0),
        first_fix_m=None if first is None else float(travelled[first]),
        rmse_whole_m=None if smoothed is None else rmse(smoothed),
        rmse_after_first_fix_m=rmse(after),
        rmse_whole_online_m=rmse(errors),
        false_fixes=int(np.sum(after > FALSE_FIX_M)),
        share_converged=float(converged.mean()) if n else 0.0,
        share_converged_after_first_fix=None if first is None else float(converged[first:].mean()),
        within_sigma=within,
        median_after_first_fix_m=float(np.median(after)) if after.size else None,
        worst_after_first_fix_m=float(after.max()) if after.size else None,
        odometry_rmse_m=None if drift is None else rmse(drift),
        odometry_rmse_after_first_fix_m=None if drift is None or first is None else rmse(drift[first:]),
        share_smoothed=None
        if smoothed is None or not known.any()
        else float(np.isfinite(smoothed[known]).mean()),
    )
