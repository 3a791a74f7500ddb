"""The filter's arithmetic: the state through the IMU, points against the plane, weights, the slowest layer.

Sources: error-state filter: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), in its global-error
form; delay as a state: Li & Mourikis, "Online temporal calibration for camera-IMU systems" (IJRR 2014).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.flight.readings import FloatArray

# Error state: where each part begins. The clone (position, attitude) is last.
P, V, TH, BG, BA, TD, BS, CP, CT, SIZE = 0, 3, 6, 9, 12, 15, 16, 19, 22, 25
# What a picture sees of it: all but velocity and the biases.
_SEEN = np.r_[P : P + 3, TH : TH + 3, TD : TD + 1, BS:SIZE]


@nb.njit(cache=True, error_model="numpy")
def skew(v: Any) -> Any:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2] = -v[2], v[1]
    out[1, 0], out[1, 2] = v[2], -v[0]
    out[2, 0], out[2, 1] = -v[1], v[0]
    return out


@nb.njit(cache=True, error_model="numpy")
def exp(v: Any) -> Any:
    # Rodrigues' rotation of a rotation vector.
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    k = skew(v)
    if angle < 1e-9:
        return np.eye(3) + k
    return np.eye(3) + math.sin(angle) / angle * k + (1.0 - math.cos(angle)) / (angle * angle) * (k @ k)


@nb.njit(cache=True, error_model="numpy")
def propagate(p, v, rot, bg, ba, t0, t1, it, gyro, accel, qg, qa, qbg, qba, qz):  # type: ignore[no-untyped-def]
    # The nominal state from t0 to t1 through the IMU samples, with the transition (15, 15) and noise (15, 15) of its
    # error. Between samples the readings are linear; before the first and after the last they are held.
    phi = np.eye(15)
    noise = np.zeros((15, 15))
    omega = np.zeros(3)
    n = it.shape[0]
    t = t0
    i = np.searchsorted(it, t0, side="right") - 1
    while t < t1 - 1e-9:
        nxt = t1
        if i + 1 < n and it[i + 1] < t1:
            nxt = it[i + 1]
        dt = nxt - t
        if dt > 0.0:
            if i < 0:
                g, a = gyro[0], accel[0]
            elif i + 1 >= n:
                g, a = gyro[n - 1], accel[n - 1]
            else:
                share = (0.5 * (t + nxt) - it[i]) / (it[i + 1] - it[i])
                g = gyro[i] + share * (gyro[i + 1] - gyro[i])
                a = accel[i] + share * (accel[i + 1] - accel[i])
            omega = g - bg
            half = rot @ exp(omega * (0.5 * dt))
            f = half @ (a - ba)
            acc = f.copy()
            acc[2] -= GRAVITY_M_S2
            p = p + v * dt + 0.5 * acc * dt * dt
            v = v + acc * dt
            rot = rot @ exp(omega * dt)
            step = np.eye(15)
            turn = -skew(f)
            for r in range(3):
                step[r, 3 + r] = dt
                for c in range(3):
                    step[r, 6 + c] = 0.5 * dt * dt * turn[r, c]
                    step[3 + r, 6 + c] = dt * turn[r, c]
                    step[r, 12 + c] = -0.5 * dt * dt * half[r, c]
                    step[3 + r, 12 + c] = -dt * half[r, c]
                    step[6 + r, 9 + c] = -dt * half[r, c]
            phi = step @ phi
            noise = step @ noise @ step.T
            # A reading that had to be held or stretched over a gap is worth less the longer that is.
            worse = 1.0 + (dt / 0.1) ** 2 * 100.0 if dt > 0.1 else 1.0
            for r in range(3):
                noise[3 + r, 3 + r] += qa * dt * worse
                noise[6 + r, 6 + r] += qg * dt * worse
                noise[9 + r, 9 + r] += qbg * dt
                noise[12 + r, 12 + r] += qba * dt
            noise[2, 2] += qz * dt
        t = nxt
        i += 1
    return p, v, rot, phi, noise, omega


@nb.njit(cache=True, error_model="numpy")
def tie(p, rot, pk, rotk, rbc, vel, omega, rays, seen, weight, matrix, vector):  # type: ignore[no-untyped-def]
    # Residuals (n, 2) of normalised image coordinates, observed minus predicted; where weight is positive, J'WJ is
    # added to matrix and J'Wr to vector. pk, rotk: the keyframe's body pose; rbc: body_from_camera.
    n = rays.shape[0]
    out = np.zeros((n, 2))
    cam = rot @ rbc
    camk = rotk @ rbc
    inv = cam.T.copy()
    turn_rate = rot @ omega
    jac = np.zeros((2, 25))
    dy = np.zeros((3, 25))
    for j in range(n):
        w = camk @ rays[j]
        if w[2] > -1e-3:
            out[j, 0] = out[j, 1] = np.nan
            continue
        lam = -pk[2] / w[2]
        d = pk + lam * w - p
        y = inv @ d
        if y[2] < 1e-3:
            out[j, 0] = out[j, 1] = np.nan
            continue
        out[j, 0] = seen[j, 0] - y[0] / y[2]
        out[j, 1] = seen[j, 1] - y[1] / y[2]
        if weight[j] <= 0.0:
            continue
        # y = C'(X - p); X = pk + lam w moves with the keyframe's pose within the plane.
        in_body = rbc @ rays[j]
        d_body = rot.T @ d
        for r in range(3):
            slope = -(inv[r, 0] * w[0] + inv[r, 1] * w[1] + inv[r, 2] * w[2]) / w[2]
            dx0, dx1, dx2 = inv[r, 0], inv[r, 1], inv[r, 2] + slope
            # Rows of dx [w]x, of inv [d]x, and of the boresight's two parts: row x [v]x is the cross product row x v.
            dy[r, 0], dy[r, 1], dy[r, 2] = -inv[r, 0], -inv[r, 1], -inv[r, 2]
            dy[r, 6] = inv[r, 1] * d[2] - inv[r, 2] * d[1]
            dy[r, 7] = inv[r, 2] * d[0] - inv[r, 0] * d[2]
            dy[r, 8] = inv[r, 0] * d[1] - inv[r, 1] * d[0]
            dy[r, 15] = 0.0
            for c in range(3):
                dy[r, 15] += dy[r, 6 + c] * turn_rate[c] - inv[r, c] * vel[c]
            e0 = dx0 * rotk[0, 0] + dx1 * rotk[1, 0] + dx2 * rotk[2, 0]
            e1 = dx0 * rotk[0, 1] + dx1 * rotk[1, 1] + dx2 * rotk[2, 1]
            e2 = dx0 * rotk[0, 2] + dx1 * rotk[1, 2] + dx2 * rotk[2, 2]
            b0, b1, b2 = rbc[0, r], rbc[1, r], rbc[2, r]
            dy[r, 16] = b1 * d_body[2] - b2 * d_body[1] - lam * (e1 * in_body[2] - e2 * in_body[1])
            dy[r, 17] = b2 * d_body[0] - b0 * d_body[2] - lam * (e2 * in_body[0] - e0 * in_body[2])
            dy[r, 18] = b0 * d_body[1] - b1 * d_body[0] - lam * (e0 * in_body[1] - e1 * in_body[0])
            dy[r, 19], dy[r, 20], dy[r, 21] = dx0, dx1, dx2
            dy[r, 22] = -lam * (dx1 * w[2] - dx2 * w[1])
            dy[r, 23] = -lam * (dx2 * w[0] - dx0 * w[2])
            dy[r, 24] = -lam * (dx0 * w[1] - dx1 * w[0])
        for c in range(25):
            jac[0, c] = (dy[0, c] - y[0] / y[2] * dy[2, c]) / y[2]
            jac[1, c] = (dy[1, c] - y[1] / y[2] * dy[2, c]) / y[2]
        for k in range(_SEEN.size):
            a = _SEEN[k]
            ja, jb = weight[j] * jac[0, a], weight[j] * jac[1, a]
            for m in range(k, _SEEN.size):
                b = _SEEN[m]
                matrix[a, b] += ja * jac[0, b] + jb * jac[1, b]
            vector[a] += ja * out[j, 0] + jb * out[j, 1]
    for k in range(_SEEN.size):
        for m in range(k):
            matrix[_SEEN[k], _SEEN[m]] = matrix[_SEEN[m], _SEEN[k]]
    return out


@nb.njit(cache=True, error_model="numpy")
def weigh(miss, base, focal, centred):  # type: ignore[no-untyped-def]
    # Cauchy weights of residuals (n, 2) about their median, or about zero; what is far off is left out.
    n = miss.shape[0]
    du = dv = 0.0
    if centred:
        du, dv = np.median(miss[:, 0]), np.median(miss[:, 1])
    size = np.empty(n)
    for j in range(n):
        size[j] = focal * math.hypot(miss[j, 0] - du, miss[j, 1] - dv)
    scale = max(0.5, 1.5 * np.median(size))
    weight = np.zeros(n)
    inliers = 0
    for j in range(n):
        if size[j] < 5.0 * scale:
            weight[j] = base[j] / (1.0 + (size[j] / scale) ** 2)
            inliers += 1
    return weight, inliers


@nb.njit(cache=True, error_model="numpy")
def density(at, height, width):  # type: ignore[no-untyped-def]
    # Sum over points of bells of the given width, at equally spaced heights.
    out = np.zeros(at.size)
    step = at[1] - at[0]
    for j in range(height.size):
        reach = 6.0 * width[j]
        low = max(0, int((height[j] - reach - at[0]) / step))
        high = min(at.size, int((height[j] + reach - at[0]) / step) + 2)
        for i in range(low, high):
            out[i] += math.exp(-0.5 * ((at[i] - height[j]) / width[j]) ** 2) / width[j]
    return out


def ground_layer(height_m: FloatArray, sigma_m: FloatArray, least_share: float = 0.35) -> float | None:
    """Height of the slowest layer: the lowest peak of the density of heights that is not much below the highest one.

    Args:
        height_m: (n,) heights of points from their parallax, metres.
        sigma_m: (n,) their standard deviations.
        least_share: a peak counts when the density there is this share of the greatest density.

    None when there are fewer than eight points. Points on the ground all move alike and slowest; roofs move faster, each
    at its own height, so the ground is the lowest crowd, not the biggest.
    """
    if len(height_m) < 8:
        return None
    width = np.maximum(sigma_m, 0.7)
    low, high = np.percentile(height_m, [1.0, 99.0])
    at = np.arange(low - 3.0, min(high, low + 150.0) + 3.5, 0.5)
    crowd = density(at, np.asarray(height_m, dtype=np.float64), width)
    inner = crowd[1:-1]
    peak = (inner >= crowd[:-2]) & (inner > crowd[2:]) & (inner >= least_share * crowd.max())
    where = np.flatnonzero(peak)
    return float(at[1 + where[0]]) if where.size else float(at[int(crowd.argmax())])
