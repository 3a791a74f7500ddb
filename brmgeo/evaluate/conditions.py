"""Named conditions of real flights, for simulated ones: few frames, a tilt that nobody tells, poor masks, an old map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import label

from brmgeo.flight.readings import Attitude, FloatArray
from brmgeo.geo.grid import Bounds
from brmgeo.match import GroundMap
from brmgeo.synth.flight import OdometryErrors, SimulationSettings, random_mission
from brmgeo.synth.mission import inset

_FRAMES = 12
_INTERVAL_S = 30.0
_LEG_M = (150.0, 300.0)
_LEG_SIGMA_M = (2.0, 20.0)
_TILT_DEG = (10.0, 18.0)
_NEAR_DEG = 5.0
_UNKNOWN_DEG = 10.0
_RECALL = (0.4, 0.6)
#: Streams of randomness, so that one condition leaves the others as they are.
_LEGS, _TILT, _MASKS, _MAP = range(201, 205)


@dataclass(frozen=True, slots=True)
class Condition:
    """What a simulated flight has of a real one; every draw follows from the flight's seed.

    Attributes:
        told: in words, for reports.
        long_legs: about 12 frames, 30 s and 150 to 300 m apart, along random legs; the odometry errs by 2 to 20 m a leg and
            axis (one draw a flight) and says so.
        tilt: the camera looks 10 to 18 degrees off nadir, mostly ahead; the flight says nothing of it (``unknown``:
            straight down), or the mount with an error of 5 degrees in roll and in pitch (``near``).
        poor_masks: 40 to 60 % of the roofs are found (a draw a flight), most others in no frame, and 12 false blobs a frame.
        gone: share of the map's buildings, touching ones counted as one, that are gone from the map.
    """

    told: str
    long_legs: bool = False
    tilt: Literal["unknown", "near"] | None = None
    poor_masks: bool = False
    gone: float = 0.0

    @property
    def tilt_sigma_rad(self) -> float:
        """How well the told mount is known."""
        return math.radians({None: 0.0, "near": _NEAR_DEG, "unknown": _UNKNOWN_DEG}[self.tilt])

    def settings(self, base: SimulationSettings, seed: int) -> SimulationSettings:
        """The simulator's settings under this condition."""
        if self.long_legs:
            rng = np.random.default_rng([seed, _LEGS])
            speed_m_s, sigma_m = rng.uniform(*_LEG_M) / _INTERVAL_S, rng.uniform(*_LEG_SIGMA_M)
            base = replace(
                base,
                speed_m_s=float(speed_m_s),
                frame_interval_s=_INTERVAL_S,
                odometry=replace(
                    base.odometry or OdometryErrors(),
                    noise_m_sqrt_s=float(sigma_m / math.sqrt(_INTERVAL_S)),
                    states_noise=True,
                ),
            )
        if self.tilt is not None:
            rng = np.random.default_rng([seed, _TILT])
            tilt, aside = math.radians(rng.uniform(*_TILT_DEG)), math.radians(rng.normal(0.0, 30.0))
            roll, pitch = tilt * math.sin(aside), -tilt * math.cos(aside)
            error = np.radians(rng.normal(0.0, _NEAR_DEG, 2))
            near = Attitude(roll + float(error[0]), pitch + float(error[1]))
            base = replace(
                base,
                mount=Attitude(roll, pitch),
                told_mount=near if self.tilt == "near" else Attitude(),
            )
        if self.poor_masks:
            rng = np.random.default_rng([seed, _MASKS])
            masks = replace(
                base.masks,
                missed=float(1.0 - rng.uniform(*_RECALL)),
                missed_always=0.8,
                false_blobs=12.0,
                blob_radius_m=6.0,
                edge_sigma_m=1.0,
            )
            base = replace(base, masks=masks)
        return base

    def ground(self, known: GroundMap, seed: int) -> GroundMap:
        """The map under this condition."""
        if not self.gone:
            return known
        pieces, count = label(known.building == 1, structure=np.ones((3, 3)))
        gone = np.random.default_rng([seed, _MAP]).random(count + 1) < self.gone
        gone[0] = False
        return replace(known, building=np.where(gone[pieces], 0, known.building).astype(np.uint8))


#: The conditions of ``brmgeo evaluate``, by name.
CONDITIONS = {
    "long-legs": Condition(
        "about 12 frames 150 to 300 m apart, odometry that errs by 2 to 20 m a leg and says so",
        long_legs=True,
    ),
    "tilted": Condition("camera 10 to 18 degrees off nadir, not told", tilt="unknown"),
    "tilted-near": Condition("camera 10 to 18 degrees off nadir, told to 5 degrees", tilt="near"),
    "poor-masks": Condition("40 to 60 % of the roofs found, 12 false blobs a frame", poor_masks=True),
    "old-map": Condition("a third of the map's buildings gone", gone=1.0 / 3.0),
    "photos": Condition(
        "long-legs, tilted, poor-masks and old-map together",
        long_legs=True,
        tilt="unknown",
        poor_masks=True,
        gone=1.0 / 3.0,
    ),
}


def long_legs(bounds: Bounds, settings: SimulationSettings, seed: int) -> FloatArray:
    """(n, 2) waypoints of random legs within the bounds, as long as about 12 frames need."""
    leg_m = settings.speed_m_s * settings.frame_interval_s
    return random_mission(inset(bounds, 100.0), seed, length_m=(_FRAMES - 0.3) * leg_m)
