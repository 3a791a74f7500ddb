"""A small town of rectangles with exact geometry, views of it and odometry over it: the ground of the matchers' tests.

Views are computed from the rectangles themselves, point by point, never from the map's raster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.match import GroundMap, Matcher

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Town:
    """(n, 5) rectangles: centre x, y, half length, half width, angle in radians; bounds of the town."""

    rects: F64
    left: float
    bottom: float
    size_m: float

    def covers(self, x: F64, y: F64, which: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Whether points lie in a building."""
        rects = self.rects if which is None else self.rects[which]
        near = (
            (rects[:, 0] > x.min() - 60)
            & (rects[:, 0] < x.max() + 60)
            & (rects[:, 1] > y.min() - 60)
            & (rects[:, 1] < y.max() + 60)
        )
        inside = np.zeros(x.shape, np.bool_)
        for cx, cy, a, b, t in rects[near]:
            u = (x - cx) * math.cos(t) + (y - cy) * math.sin(t)
            v = -(x - cx) * math.sin(t) + (y - cy) * math.cos(t)
            inside |= (np.abs(u) <= a) & (np.abs(v) <= b)
        return inside

    def ground(self, gsd_m: float = 1.0) -> GroundMap:
        n = round(self.size_m / gsd_m)
        out = np.zeros((n, n), np.uint8)
        top = self.bottom + self.size_m
        for cx, cy, a, b, t in self.rects:
            r = math.hypot(a, b)
            c0, c1 = max(0, int((cx - r - self.left) / gsd_m)), min(n, int((cx + r - self.left) / gsd_m) + 2)
            r0, r1 = max(0, int((top - cy - r) / gsd_m)), min(n, int((top - cy + r) / gsd_m) + 2)
            if c1 <= c0 or r1 <= r0:
                continue
            x = self.left + (np.arange(c0, c1)[None, :] + 0.5) * gsd_m - cx
            y = top - (np.arange(r0, r1)[:, None] + 0.5) * gsd_m - cy
            u, v = x * math.cos(t) + y * math.sin(t), -x * math.sin(t) + y * math.cos(t)
            out[r0:r1, c0:c1] |= ((np.abs(u) <= a) & (np.abs(v) <= b)).astype(np.uint8)
        return GroundMap(out, self.left, top, gsd_m)


def town(
    seed: int, size_m: float = 1500.0, count: int = 900, left: float = 1000.0, bottom: float = 5000.0
) -> Town:
    """Streets of houses at odd angles in districts, no two alike."""
    rng = np.random.default_rng(seed)
    rects = []
    while len(rects) < count:
        angle = rng.uniform(0, math.pi)
        at = rng.uniform(0, size_m, 2)
        for _ in range(rng.integers(5, 25)):
            p = at + rng.normal(0, 60, 2)
            rects.append(
                [
                    left + p[0],
                    bottom + p[1],
                    rng.uniform(4, 14),
                    rng.uniform(3, 8),
                    angle + rng.normal(0, 0.05),
                ]
            )
    return Town(np.array(rects[:count]), left, bottom, size_m)


def view_at(
    scene: Town,
    x: float,
    y: float,
    yaw_rad: float,
    t_s: float = 0.0,
    *,
    missed: float = 0.0,
    rng: np.random.Generator | None = None,
    gsd_m: float = 1.0,
    half: tuple[float, float] = (59.0, 79.0),
) -> View:
    """What a camera at (x, y) sees, nose up, ``half`` metres ahead and to the side, with some buildings missed."""
    rows, cols = round(2 * half[0] / gsd_m), round(2 * half[1] / gsd_m)
    forward = half[0] - (np.arange(rows)[:, None] + 0.5) * gsd_m
    left = half[1] - (np.arange(cols)[None, :] + 0.5) * gsd_m
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    which = None if rng is None or missed == 0 else rng.random(len(scene.rects)) >= missed
    inside = scene.covers(x + forward * c - left * s, y + forward * s + left * c, which)
    building = inside.astype(np.float32)
    if rng is not None and missed > 0:
        for _ in range(3):
            r0, c0 = rng.integers(0, rows - 8), rng.integers(0, cols - 8)
            building[r0 : r0 + 7, c0 : c0 + 7] = 1
    known = np.ones((rows, cols), np.bool_)
    return View(t_s, building, known, gsd_m, (rows / 2.0, cols / 2.0), 150.0, half[0], f"{t_s:.0f}.png")


def blank_view(t_s: float = 0.0) -> View:
    """A view without any building."""
    return View(
        t_s,
        np.zeros((118, 158), np.float32),
        np.ones((118, 158), np.bool_),
        1.0,
        (59.0, 79.0),
        150.0,
        59.0,
        "blank.png",
    )


@dataclass(frozen=True)
class Flight:
    """True places (n, 2) and yaws (n,), views and motions."""

    xy: F64
    yaw: F64
    views: list[View]
    motions: list[Motion]


def path(start: tuple[float, float], legs: list[tuple[float, int]], step_m: float = 25.0) -> tuple[F64, F64]:
    """Places and yaws along legs of (yaw in radians, number of steps)."""
    xy, yaw = [np.array(start)], [legs[0][0]]
    for angle, count in legs:
        for _ in range(count):
            xy.append(xy[-1] + step_m * np.array([math.cos(angle), math.sin(angle)]))
            yaw.append(angle)
    return np.array(xy), np.array(yaw)


def fly(
    scene: Town,
    xy: F64,
    yaw: F64,
    *,
    seed: int = 0,
    scale: float = 1.0,
    missed: float = 0.1,
    odometry: bool = True,
    odometry_yaw: float = 1.1,
    blank: range = range(0),
) -> Flight:
    """Views and odometry (scale error, arbitrary yaw, a little noise) along a path."""
    rng = np.random.default_rng(seed)
    views, motions = [], []
    c, s = math.cos(-odometry_yaw), math.sin(-odometry_yaw)
    for i, (p, a) in enumerate(zip(xy, yaw)):
        t = 5.0 * i
        views.append(
            blank_view(t) if i in blank else view_at(scene, p[0], p[1], a, t, missed=missed, rng=rng)
        )
        if i == 0 or not odometry:
            motions.append(Motion(0.0 if i == 0 else 5.0, None, a - odometry_yaw if odometry else None))
        else:
            d = (p - xy[i - 1]) * scale
            step = np.array([c * d[0] - s * d[1], s * d[0] + c * d[1]]) + rng.normal(0, 0.1, 2)
            motions.append(Motion(5.0, step, a - odometry_yaw, 0.1))
    return Flight(xy, yaw, views, motions)


def run(matcher: Matcher, flight: Flight) -> list[Estimate]:
    """All estimates of a flight."""
    return [matcher.step(v, m) for v, m in zip(flight.views, flight.motions)]


def errors(flight: Flight, estimates: list[Estimate]) -> F64:
    """(n,) metres from the truth; NaN where there is no fix."""
    out = np.full(len(estimates), np.nan)
    for i, e in enumerate(estimates):
        if e.position is not None:
            out[i] = math.hypot(e.position[0] - flight.xy[i, 0], e.position[1] - flight.xy[i, 1])
    return out
