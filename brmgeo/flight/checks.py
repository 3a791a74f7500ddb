"""What a track and its instruments say of each other: lengths, units, clocks, agreement of two tracks.

Everything takes arrays and gives numbers. None means that the data cannot tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.flight.frames import inverse, multiply, rotate
from brmgeo.flight.motion import RESET_SPEED_M_S, breaks
from brmgeo.flight.readings import FloatArray, Imu, Odometry

#: Correlation of two turn rates from which their lag is believed.
MIN_CORRELATION = 0.6
#: Correlation of leaning and acceleration from which up and down are told apart.
MIN_LEANING = 0.3
#: Fewer poses than this are not looked at for their axes.
MIN_POSES = 50
#: Mean share of the way along one axis of the body that counts as flying along it.
MIN_ALONG = 0.7
#: Rest lies within these of standard gravity; a handheld or flying one too, in the median.
_GRAVITY = {"m/s2": GRAVITY_M_S2, "g": 1.0, "mg": 1000.0}


def length_m(odometry: Odometry, max_gap_s: float = 1.0, max_speed_m_s: float = RESET_SPEED_M_S) -> float:
    """Length of a track in metres, without what lies across its gaps and resets."""
    starts, _ = breaks(odometry, max_gap_s, max_speed_m_s)
    steps = np.linalg.norm(np.diff(odometry.xyz_m, axis=0), axis=1)
    return float(steps[~np.isin(odometry.t_s[:-1], starts)].sum())


def turn_rate(t_s: FloatArray, wxyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n - 1,) middle times and the rates of turning between orientations, rad/s."""
    between = multiply(inverse(wxyz[:-1]), wxyz[1:])
    angle = 2.0 * np.arctan2(np.linalg.norm(between[:, 1:], axis=1), np.abs(between[:, 0]))
    return (t_s[:-1] + t_s[1:]) / 2.0, np.asarray(angle / np.diff(t_s))


def _resampled(t_s: FloatArray, values: FloatArray, at_s: FloatArray, width_s: float) -> FloatArray:
    # Means over ``width_s``: rates from different instruments differ in noise, not in what is slow.
    total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2.0 * np.diff(t_s))])
    before, after = np.interp(at_s - width_s / 2, t_s, total), np.interp(at_s + width_s / 2, t_s, total)
    return np.asarray((after - before) / width_s)


def clock_lag_s(
    first_t_s: FloatArray,
    first: FloatArray,
    second_t_s: FloatArray,
    second: FloatArray,
    max_lag_s: float = 2.0,
) -> tuple[float, float] | None:
    """How much later the second stream's stamps are than the first's for the same turns, and their correlation.

    Args:
        first_t_s, first: (n,) times and rates of turning; second_t_s, second: (m,) of another instrument.
        max_lag_s: lags up to this are looked for.

    The lag of the largest normalised cross-correlation on a 20 ms lattice, refined by a parabola. None where the streams
    do not overlap for 5 s, do not turn, or do not resemble each other (``MIN_CORRELATION``).
    """
    if min(len(first_t_s), len(second_t_s)) < 10:
        return None
    start, end = max(first_t_s[0], second_t_s[0]), min(first_t_s[-1], second_t_s[-1])
    step = 0.02
    width = max(step, 2.0 * float(max(np.median(np.diff(first_t_s)), np.median(np.diff(second_t_s)))))
    if end - start < 5.0 + 2.0 * max_lag_s:
        return None
    at = np.arange(start + max_lag_s, min(end - max_lag_s, start + max_lag_s + 600.0), step)
    fixed = _resampled(first_t_s, first, at, width)
    if fixed.std() < 0.01:
        return None
    lags = np.arange(-max_lag_s, max_lag_s + step / 2, step)
    scores = np.array([_correlation(fixed, _resampled(second_t_s, second, at + lag, width)) for lag in lags])
    best = int(scores.argmax())
    if scores[best] < MIN_CORRELATION or best in (0, len(lags) - 1):
        return None
    left, middle, right = scores[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return float(lags[best] + shift * step), float(middle)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    spread = float(a.std() * b.std())
    return float(((a - a.mean()) * (b - b.mean())).mean() / spread) if spread > 1e-12 else 0.0


def imu_units(
    imu: Imu, t_s: FloatArray | None = None, wxyz: FloatArray | None = None
) -> tuple[str | None, str | None]:
    """Units that a gyro (``rad/s``, ``deg/s``) and an accelerometer (``m/s2``, ``g``, ``mg``) are in; None: cannot tell.

    Args:
        imu: readings in unknown units.
        t_s, wxyz: (n,) times and (n, 4) orientations from elsewhere, or None. With them the gyro is held against the
            turns; without, only what no aircraft does in rad/s is told.
    """
    pull = float(np.median(np.linalg.norm(imu.accel_m_s2, axis=1)))
    accel = next((name for name, g in _GRAVITY.items() if 0.7 * g < pull < 1.4 * g), None)
    speed = np.linalg.norm(imu.gyro_rad_s, axis=1)
    gyro = None
    if t_s is not None and wxyz is not None and len(t_s) > 10 and len(imu.t_s) > 10:
        when, rate = turn_rate(t_s, wxyz)
        start, end = max(when[0], imu.t_s[0]), min(when[-1], imu.t_s[-1])
        if end - start > 1.0:
            at = np.arange(start, min(end, start + 3600.0), 0.05)
            width = max(0.1, 2.0 * float(np.median(np.diff(t_s))))
            ours, theirs = _resampled(imu.t_s, speed, at, width), _resampled(when, rate, at, width)
            turning = theirs > max(0.05, float(np.quantile(theirs, 0.5)))
            if turning.sum() > 20:
                ratio = float(np.median(ours[turning] / theirs[turning]))
                gyro = "rad/s" if 0.3 < ratio < 3.0 else "deg/s" if 20.0 < ratio < 170.0 else None
    if gyro is None and float(np.quantile(speed, 0.9)) > 8.0:
        gyro = "deg/s"
    return gyro, accel


def median_tilt_deg(wxyz: FloatArray) -> float:
    """Median angle between the body's z axis and up, degrees."""
    up = 1.0 - 2.0 * (wxyz[:, 1] ** 2 + wxyz[:, 2] ** 2)
    return float(np.degrees(np.median(np.arccos(np.clip(up, -1.0, 1.0)))))


def flat_axis(xyz_m: FloatArray) -> int | None:
    """Axis along which a track extends least by far (0, 1 or 2), None where no axis is clearly the least."""
    spread = np.sort(np.ptp(xyz_m, axis=0))
    if spread[1] < 1.0 or spread[0] > 0.6 * spread[1]:
        return None
    return int(np.ptp(xyz_m, axis=0).argmin())


def agreement_m(
    first: Odometry, second: Odometry, *, scale: bool = False
) -> tuple[float, float, float] | None:
    """How well two tracks of one flight fit: RMS distance in metres after the best rotation and shift, the scale, seconds.

    Args:
        first, second: tracks on one clock; ``second`` is laid onto ``first``.
        scale: also fit a scale (monocular tracks have none of their own).

    None where they share less than 5 s. Least squares by Umeyama, "Least-squares estimation of transformation parameters
    between two point patterns" (1991).
    """
    start, end = max(first.t_s[0], second.t_s[0]), min(first.t_s[-1], second.t_s[-1])
    inside = (second.t_s >= start) & (second.t_s <= end)
    if end - start < 5.0 or inside.sum() < 5:
        return None
    t = second.t_s[inside]
    near = np.abs(first.t_s[_nearest(first.t_s, t)] - t) < 1.0
    if near.sum() < 5:
        return None
    t, theirs = t[near], second.xyz_m[inside][near]
    ours = np.stack([np.interp(t, first.t_s, first.xyz_m[:, k]) for k in range(3)], axis=-1)
    a, b = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(sign) @ vt
    factor = float((s * sign).sum() / (b**2).sum()) if scale and (b**2).sum() > 0.0 else 1.0
    miss = a - factor * b @ rotation.T
    return float(np.sqrt((miss**2).sum(axis=1).mean())), factor, float(end - start)


def _nearest(t_s: FloatArray, at_s: FloatArray) -> NDArray[np.int64]:
    right = np.clip(np.searchsorted(t_s, at_s), 1, max(len(t_s) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(t_s) - 1)
    return np.asarray(np.where(at_s - t_s[left] <= t_s[right] - at_s, left, right), dtype=np.int64)


def leaning(odometry: Odometry) -> float | None:
    """Correlation of a track's horizontal acceleration with the way that its z axis leans, in [-1, 1].

    What flies by thrust or lift leans to where it accelerates: well above 0 where z points up, well below where it points
    down, so that the track is mirrored. The track's scale does not matter. None for less than 20 s or four poses a second,
    or where nothing leans or turns (a straight course, a stabilised camera).
    """
    step, smooth, slow = 0.1, 5.0, 20.0
    at = np.arange(odometry.t_s[0], min(odometry.t_s[-1], odometry.t_s[0] + 3600.0), step)
    if len(at) < 200 or len(odometry.t_s) < 0.4 * len(at):
        return None

    def quick(values: FloatArray) -> FloatArray:
        even = np.stack([np.interp(at, odometry.t_s, v) for v in values.T], axis=-1)
        return np.asarray(gaussian_filter1d(even, smooth, axis=0))

    def fast(values: FloatArray) -> FloatArray:
        return np.asarray(values - gaussian_filter1d(values, slow, axis=0))

    lean = fast(quick(rotate(odometry.wxyz, np.array([0.0, 0.0, 1.0]))[:, :2]))
    way = quick(odometry.xyz_m[:, :2])
    push = fast(np.gradient(np.gradient(way, step, axis=0), step, axis=0))
    size = float(np.sqrt((lean**2).sum() * (push**2).sum()))
    parts = [float(part.sum()) for part in np.array_split((lean * push).sum(axis=1), 20)]
    mean, error = float(np.mean(parts)), float(np.std(parts)) / np.sqrt(20.0)
    if np.sqrt((lean**2).sum(axis=1).mean()) < 1e-3 or abs(mean) < 1.5 * error:
        return None
    return 20.0 * mean / size


def along_body(odometry: Odometry) -> FloatArray:
    """(2,) mean direction of the horizontal way in the body's x and y; its length is 1 where it never changes.

    Only where the track moves at more than a third of its median speed.
    """
    steps = np.diff(odometry.xyz_m, axis=0) / np.diff(odometry.t_s)[:, None]
    speed = np.hypot(steps[:, 0], steps[:, 1])
    moving = speed > max(float(np.median(speed)) / 3.0, 1e-9)
    if not moving.any():
        return np.zeros(2)
    ahead = rotate(inverse(odometry.wxyz[:-1][moving]), steps[moving])[:, :2]
    return np.asarray((ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)).mean(axis=0))


def doubtful_axes(odometry: Odometry) -> str:
    """What speaks against a track in x nose, y left, z up, and the axes to give; empty where nothing does.

    A monocular SLAM's track begins as the world of its first camera. Of one that looks down the z axis points down all the
    way, and nothing but leaning, and the axis that it flies along, tells it from a body whose z axis points up.
    """
    lean = leaning(odometry) if len(odometry.t_s) >= MIN_POSES else None
    if len(odometry.t_s) < MIN_POSES or (lean is not None and lean > MIN_LEANING):
        return ""
    x, y = along_body(odometry).tolist()
    camera = abs(y) > MIN_ALONG
    if lean is not None and lean < -MIN_LEANING:
        axes = "nadir (a camera that looks down)" if camera else "frd, or nadir (a camera that looks down)"
        return (
            "it leans away from where it accelerates, so its z axis points down, and read as z up it would be mirrored: "
            f"give axes {axes}; flu keeps it as it is"
        )
    own_world = not odometry.xyz_m[0].any() and abs(abs(float(odometry.wxyz[0, 0])) - 1.0) < 1e-9
    if camera or (own_world and abs(x) < MIN_ALONG):
        what = "it flies along its y axis" if camera else "it begins as its own world"
        return (
            f"{what}, as the track of a camera that looks down does, whose z axis points down: give axes nadir, or "
            "flu where x is the nose, y left and z up"
        )
    return ""


def mirrored_m(xy_m: FloatArray, reference_m: FloatArray) -> tuple[float, float]:
    """Root mean squares of what is left between two plane tracks (n, 2) after the best turn, scale and shift, metres: as
    they are, and with the first mirrored (Umeyama, "Least-squares estimation of transformation parameters", 1991)."""
    a, b = ((v - v.mean(axis=0)) @ [1.0, 1j] for v in (xy_m, reference_m))
    size = float((np.abs(a) ** 2).sum())

    def left(track: NDArray[np.complex128]) -> float:
        turn = (np.conj(track) * b).sum() / max(size, 1e-12)
        return float(np.sqrt((np.abs(b - turn * track) ** 2).mean()))

    return left(a), left(np.conj(a))
