"""Steps between frames from an odometry track: interpolated at the frames' times, with gaps and resets marked.

Between two odometry poses the position is linear and the orientation a slerp (Shoemake, 1985). A step that crosses a
gap or a reset is not given at all: the matcher then bounds the movement by speed, which is honest, while an
interpolated jump would be a guess.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brmgeo.flight.readings import FloatArray, Odometry
from brmgeo.flight.values import Motion

#: Standard deviation of a visual-inertial step per axis after one second; it grows with the root of time.
STEP_NOISE_M = 0.1
#: Odometry that moves faster than this was reset: no small aircraft does.
RESET_SPEED_M_S = 60.0
#: Not even a step that the odometry is sure of is better than this.
MIN_STEP_NOISE_M = 0.02


def yaw_of(wxyz: FloatArray) -> FloatArray:
    """(...,) yaw of the body's x axis in radians, counter-clockwise, from (..., 4) unit quaternions w, x, y, z."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=np.float64), -1, 0)
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))


def slerp(first: FloatArray, second: FloatArray, share: FloatArray) -> FloatArray:
    """(n, 4) unit quaternions ``share`` (n,) of the way from ``first`` to ``second`` (n, 4), along the shorter arc."""
    dot = (first * second).sum(axis=-1, keepdims=True)
    second = np.where(dot < 0.0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    share = np.asarray(share, dtype=np.float64)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.sin((1.0 - share) * angle) / np.sin(angle)
        b = np.sin(share * angle) / np.sin(angle)
    close = angle < 1e-6  # sin is linear here, and 0 / 0 at equality
    mixed = np.where(close, 1.0 - share, a) * first + np.where(close, share, b) * second
    return np.asarray(mixed / np.linalg.norm(mixed, axis=-1, keepdims=True))


def breaks(odometry: Odometry, max_gap_s: float, max_speed_m_s: float) -> tuple[FloatArray, FloatArray]:
    """(k,) start and (k,) end times of the pieces of a track that no motion may be taken across.

    A gap is longer than ``max_gap_s`` and than four times the track's median interval (a track of one pose a frame
    is whole); a reset is a jump that would need more than ``max_speed_m_s``, or a change of ``odometry.segment``.
    """
    dt = np.diff(odometry.t_s)
    if not dt.size:
        return np.empty(0), np.empty(0)
    gap = dt > max(max_gap_s, 4.0 * float(np.median(dt)))
    jump_m = np.linalg.norm(np.diff(odometry.xyz_m, axis=0), axis=1)
    # A metre of slack: at hundreds of poses a second ordinary noise is a high speed.
    reset = jump_m > max_speed_m_s * dt + 1.0
    broken = gap | reset
    if odometry.segment is not None:
        broken |= np.diff(odometry.segment) != 0
    return odometry.t_s[:-1][broken], odometry.t_s[1:][broken]


def motions(
    odometry: Odometry | None,
    frame_times_s: FloatArray,
    *,
    compass_yaw_rad: Sequence[float | None] | None = None,
    max_gap_s: float = 1.0,
    max_speed_m_s: float = RESET_SPEED_M_S,
    step_noise_m: float = STEP_NOISE_M,
) -> list[Motion]:
    """One Motion a frame: the step from the frame before it, in the odometry frame, and the yaw at it.

    Args:
        odometry: the track, or None: then every step and yaw is None and only time passes.
        frame_times_s: (n,) float64, increasing.
        compass_yaw_rad: (n,) yaw in the map frame from a trusted compass, or None.
        max_gap_s, max_speed_m_s: see ``breaks``.
        step_noise_m: standard deviation of a step of one second per axis; ``sigma_m`` grows with the root of time. An
            odometry that says itself what its steps are worth (``walk_m2``) is believed instead.

    The first Motion has ``dt_s`` 0 and no step. A step is None outside the track and across a gap or reset; the yaw
    is None outside the track and within a gap. After a reset the yaw may be counted from a new origin.
    """
    times = np.asarray(frame_times_s, dtype=np.float64)
    n = len(times)
    compass = [None] * n if compass_yaw_rad is None else list(compass_yaw_rad)
    dt = np.diff(times, prepend=times[:1])
    if odometry is None or len(odometry.t_s) == 0:
        return [Motion(float(dt[i]), None, None, 0.0, compass[i]) for i in range(n)]

    t = odometry.t_s
    tolerance = 1e-3  # log and frame times are written with different rounding
    inside = (times >= t[0] - tolerance) & (times <= t[-1] + tolerance)
    xy = np.stack([np.interp(times, t, odometry.xyz_m[:, k]) for k in range(2)], axis=-1)
    if len(t) > 1:
        left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        share = np.clip((times - t[left]) / (t[left + 1] - t[left]), 0.0, 1.0)
        yaw = yaw_of(slerp(odometry.wxyz[left], odometry.wxyz[left + 1], share))
    else:
        yaw = np.repeat(yaw_of(odometry.wxyz), n)

    walk = None if odometry.walk_m2 is None else np.interp(times, t, odometry.walk_m2)

    starts, ends = breaks(odometry, max_gap_s, max_speed_m_s)
    # Breaks come in order and do not overlap: count those a time lies beyond, and whether it is within one.
    begun = np.searchsorted(starts, times - tolerance, side="left")
    ended = np.searchsorted(ends, times + tolerance, side="right")
    within = begun > ended

    out: list[Motion] = []
    for i in range(n):
        have_yaw = bool(inside[i] and not within[i])
        step = None
        if (
            i
            and inside[i]
            and inside[i - 1]
            and not within[i]
            and not within[i - 1]
            and ended[i] == ended[i - 1]
        ):
            step = xy[i] - xy[i - 1]
        sigma = 0.0
        if step is not None:
            sigma = step_noise_m * float(np.sqrt(max(dt[i], 0.0)))
            if walk is not None:
                sigma = float(np.sqrt(max(walk[i] - walk[i - 1], MIN_STEP_NOISE_M**2)))
        out.append(Motion(float(dt[i]), step, float(yaw[i]) if have_yaw else None, sigma, compass[i]))
    return out
