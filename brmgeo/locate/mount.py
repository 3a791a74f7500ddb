"""How a camera sits that nobody told: roll and pitch of its mount, found by the shape of what it sees.

A camera that is tilted sees a grid as a fan: near ground large, far ground small. Levelled by a wrong mount a mask keeps
some of that, and fits the map worse than levelled rightly. So at a place that is known to some tens of metres the tilt is
the one whose levelled view the map fits best; one frame tells it to a degree or two, a few frames agree on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from brmgeo.flight.camera import ground_from_pixel, level_from_camera
from brmgeo.flight.readings import Attitude, Camera, FloatArray
from brmgeo.flight.values import View
from brmgeo.match import GroundMap, MatchSettings
from brmgeo.match.rates import Rates
from brmgeo.match.register import Registrar

#: Steps of the search, degrees: tilts about the best one so far, until none is better.
_STEPS_DEG = (8.0, 4.0, 2.0, 1.0)
_REACH_DEG = 24.0
#: Below this log-likelihood ratio a frame shows too little.
_LEAST_LLR = 8.0
#: One frame is never better than this.
_FRAME_SIGMA_DEG = 1.0
_LEAST_FRAMES = 3
_SETTLED_DEG = 1.0
#: What all frames get wrong together, however well they agree: on a real flight, with a network's masks, 2 to 4 degrees.
SYSTEMATIC_DEG = 3.0


class FoundMount(NamedTuple):
    """A mount and the standard deviation of its roll and pitch, radians."""

    mount: Attitude
    sigma_rad: float


class MountFinder:
    """Gathers what frames say of a mount's roll and pitch.

    Args:
        ground: the map.
        settings: of the matcher, for the rates.
        camera: of the frames.
        told: the mount as far as it is told; its yaw is kept.
        sigma_rad: standard deviation of its roll and of its pitch.
    """

    def __init__(
        self, ground: GroundMap, settings: MatchSettings, camera: Camera, told: Attitude, sigma_rad: float
    ) -> None:
        rates = settings.rates
        self._rates = Rates(rates.hit, rates.false_alarm, rates.independent_m2)
        self._registrar = Registrar(ground)
        self._camera, self._told, self._sigma_deg = camera, told, math.degrees(sigma_rad)
        self.said: list[tuple[float, float, float, float]] = []

    def add(
        self,
        level: Callable[[Attitude], View],
        attitude: Attitude,
        agl_m: float,
        pose: FloatArray,
        sigma_m: float,
        mount: Attitude,
    ) -> None:
        """Takes in one frame at a known place.

        Args:
            level: the frame's levelled view under a mount.
            attitude: roll and pitch of the body.
            agl_m: height above what masks show, metres.
            pose: x, y, yaw of the body as the view under ``mount`` has them.
            sigma_m: how well x and y are known.
            mount: where the search begins.
        """
        at = (
            float(round(math.degrees(mount.roll_rad - self._told.roll_rad))),
            float(round(math.degrees(mount.pitch_rad - self._told.pitch_rad))),
        )
        best = self._fit(level, at, pose, min(3.0 * sigma_m + 6.0, 45.0), 0.12)
        if best is None:
            return
        fits = {at: best}
        # Once a frame has told it, others begin where it lies.
        for step in _STEPS_DEG[2:] if self.said else _STEPS_DEG:
            before = None
            while before != at:
                before = at
                for near in _around(before, step):
                    if near not in fits and max(map(abs, near)) <= _REACH_DEG:
                        there = fits[at]
                        moved = there[1] + self._moved(attitude, agl_m, at, near, there[1][2])
                        fit = self._fit(level, near, moved, 3.0 * step + 4.0, 0.06)
                        fits[near] = (-math.inf, moved) if fit is None else fit
                        if fits[near][0] > fits[at][0]:
                            at = near
        sides = [fits.get(near, (-math.inf, pose))[0] for near in _around(at, 1.0)]
        if fits[at][0] >= _LEAST_LLR and all(map(math.isfinite, sides)):
            bends = (2 * fits[at][0] - sides[0] - sides[1], 2 * fits[at][0] - sides[2] - sides[3])
            roll, pitch = (max(1.0 / math.sqrt(max(bend, 1e-3)), _FRAME_SIGMA_DEG) for bend in bends)
            self.said.append((*at, roll, pitch))

    def found(self) -> tuple[FoundMount | None, bool]:
        """The mount by all frames so far, None before the first, and whether frames enough agree on it."""
        if not self.said:
            return None, False
        said = np.array(self.said)
        weight = said[:, 2:] ** -2.0
        mean = (weight * said[:, :2]).sum(axis=0) / weight.sum(axis=0)
        # Where frames scatter more than they say, none of them is as good as it says.
        scatter = (weight * (said[:, :2] - mean) ** 2).sum(axis=0) / max(len(said) - 1, 1)
        sigma = float(np.sqrt(np.maximum(scatter, 1.0) / weight.sum(axis=0)).max())
        agreed = len(said) >= _LEAST_FRAMES and sigma <= _SETTLED_DEG
        mount = self._mount((float(mean[0]), float(mean[1])))
        return FoundMount(mount, math.radians(math.hypot(sigma, SYSTEMATIC_DEG))), agreed

    def _mount(self, off_deg: tuple[float, float]) -> Attitude:
        roll, pitch = (math.radians(v) for v in off_deg)
        return Attitude(self._told.roll_rad + roll, self._told.pitch_rad + pitch, self._told.yaw_rad)

    def _fit(
        self,
        level: Callable[[Attitude], View],
        off_deg: tuple[float, float],
        pose: FloatArray,
        window_m: float,
        window_rad: float,
    ) -> tuple[float, FloatArray] | None:
        """How well the map fits, less what the told mount has against it, and the pose."""
        found = self._registrar.register(level(self._mount(off_deg)), pose, window_m, window_rad, self._rates)
        if found is None:
            return None
        return found.llr - 0.5 * sum((v / self._sigma_deg) ** 2 for v in off_deg), found.pose

    def _moved(
        self,
        attitude: Attitude,
        agl_m: float,
        before: tuple[float, float],
        after: tuple[float, float],
        yaw_rad: float,
    ) -> FloatArray:
        """What another mount does to the pose: what the camera looks at stays where it is."""
        middle, height = np.array([self._camera.cx, self._camera.cy]), np.array([0.0, 0.0, agl_m])
        seen = [
            ground_from_pixel(
                self._camera,
                level_from_camera(self._mount(off), attitude.roll_rad, attitude.pitch_rad),
                height,
                middle,
            )
            for off in (before, after)
        ]
        forward, left = seen[0] - seen[1]
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        return np.array([forward * c - left * s, forward * s + left * c, 0.0])


def _around(at: tuple[float, float], step: float) -> Iterator[tuple[float, float]]:
    roll, pitch = at
    yield from ((roll + step, pitch), (roll - step, pitch), (roll, pitch + step), (roll, pitch - step))
