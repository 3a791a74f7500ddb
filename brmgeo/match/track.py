"""The local track after a fix: place, heading of the odometry frame and odometry scale as one Gaussian.

Online it is an extended Kalman filter; the smoother (``brmgeo.match.smooth``) uses the same motion model over
the whole flight. State: x, y (metres, map frame), psi (yaw of the odometry frame in the map, radians), s (log
of the scale: a true step is exp(s) times the measured one). Scale and heading are states, not noise, because
their errors are the same from step to step: a bias of 5 % is 50 m after 1 km, and no noise per step explains that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Motion
from brmgeo.match.settings import OdometrySettings

F64 = NDArray[np.float64]


def wrap(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def turned(vector: F64, angle: float) -> F64:
    """(2,) ``vector`` turned counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def advance(state: F64, motion: Motion, settings: OdometrySettings) -> tuple[F64, F64, F64]:
    """The state one step on, the (4, 4) Jacobian and the (4, 4) noise; ``motion.step_m`` must be known."""
    assert motion.step_m is not None
    step = math.exp(state[3]) * turned(np.asarray(motion.step_m, np.float64), state[2])
    after = state.copy()
    after[:2] += step
    jac = np.eye(4)
    jac[:2, 2] = (-step[1], step[0])
    jac[:2, 3] = step
    noise = step_noise(motion, settings)
    return after, jac, noise


def step_noise(motion: Motion, settings: OdometrySettings) -> F64:
    """(4, 4) covariance that one step adds."""
    assert motion.step_m is not None
    length = float(np.hypot(*motion.step_m))
    var = settings.step_sigma_m**2 + motion.sigma_m**2 + (settings.step_sigma_share * length) ** 2
    drift = settings.drift_rad_per_sqrt_s**2 * max(motion.dt_s, 0.0)
    # Half of a step's drift has come about when the step is made: a third of its variance, across the track.
    var += drift * length**2 / 3.0
    walk = settings.scale_walk_per_sqrt_s**2 * max(motion.dt_s, 0.0)
    return np.diag([var, var, drift + 1e-10, walk + 1e-10])


@dataclass(slots=True)
class Track:
    """Mean (4,) and covariance (4, 4) of x, y, psi, s."""

    mean: F64
    covariance: F64

    @property
    def sigma_m(self) -> float:
        """Root of half the trace of the place's covariance, metres."""
        return math.sqrt(max(0.0, float(self.covariance[0, 0] + self.covariance[1, 1])) / 2.0)

    def predict(self, motion: Motion, settings: OdometrySettings) -> None:
        """Move by one step of odometry."""
        self.mean, jac, noise = advance(self.mean, motion, settings)
        self.covariance = jac @ self.covariance @ jac.T + noise

    def distance2(self, pose: F64, covariance: F64, yaw_rad: float) -> float:
        """Squared Mahalanobis distance (3 degrees of freedom) of a measured pose x, y, yaw of the body."""
        error, spread = self._innovation(pose, covariance, yaw_rad)
        return float(error @ np.linalg.solve(spread, error))

    def update(self, pose: F64, covariance: F64, yaw_rad: float) -> None:
        """Take in a measured pose x, y, yaw of the body; ``yaw_rad`` is the body's yaw in the odometry frame."""
        error, spread = self._innovation(pose, covariance, yaw_rad)
        gain = np.linalg.solve(spread, self.covariance[:3]).T
        self.mean = self.mean + gain @ error
        self.mean[2] = wrap(float(self.mean[2]))
        keep = np.eye(4)
        keep[:, :3] -= gain
        # Joseph's form stays symmetric and positive whatever the rounding.
        self.covariance = keep @ self.covariance @ keep.T + gain @ covariance @ gain.T

    def _innovation(self, pose: F64, covariance: F64, yaw_rad: float) -> tuple[F64, F64]:
        error = np.array(
            [pose[0] - self.mean[0], pose[1] - self.mean[1], wrap(pose[2] - yaw_rad - float(self.mean[2]))]
        )
        return error, self.covariance[:3, :3] + covariance
