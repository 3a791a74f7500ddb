"""What all matchers share about one step: checks of what comes in, and the answer where there is no place."""

from __future__ import annotations

import math

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.flight.values import Estimate, Motion, Status, View
from brmgeo.match.ground import GroundMap


def check_view(view: View) -> None:
    """Raises FlightError where a view cannot be matched: shapes, values that are not finite, heights, GSD."""
    name = f"frame {view.file!r} at {view.t_s} s"
    if view.building.ndim != 2 or view.building.shape != view.known.shape or view.building.size == 0:
        raise FlightError(
            f"{name}: mask {view.building.shape} and known {view.known.shape} must be equal "
            "and not empty; rebuild the view"
        )
    numbers = (view.t_s, view.gsd_m, view.agl_m, view.radius_m, *view.nadir_px)
    if not all(map(math.isfinite, numbers)) or min(view.gsd_m, view.agl_m, view.radius_m) <= 0:
        raise FlightError(
            f"{name}: GSD {view.gsd_m} m, height {view.agl_m} m, radius {view.radius_m} m, nadir {view.nadir_px} "
            "must be finite and above 0; correct the flight's heights"
        )
    if not np.isfinite(view.building).all() or view.building.min() < 0 or view.building.max() > 1:
        raise FlightError(f"{name}: mask values must lie in [0, 1]; rebuild the view")


def check_motion(motion: Motion, view: View) -> None:
    """Raises FlightError where a motion is not finite or time runs backwards."""
    numbers = [motion.dt_s, motion.sigma_m]
    numbers += [] if motion.step_m is None else [float(v) for v in motion.step_m]
    numbers += [v for v in (motion.yaw_rad, motion.compass_yaw_rad) if v is not None]
    if not all(map(math.isfinite, numbers)) or motion.dt_s < 0 or motion.sigma_m < 0:
        raise FlightError(
            f"frame {view.file!r} at {view.t_s} s: motion {motion} is not finite or runs backwards; "
            "correct the odometry"
        )


def nowhere(view: View, ground: GroundMap, status: Status, extra: dict[str, float]) -> Estimate:
    """The estimate where no place stands out: an even spread over the whole map."""
    rows, cols = ground.building.shape
    width, height = cols * ground.gsd_m, rows * ground.gsd_m
    return Estimate(
        t_s=view.t_s,
        status=status,
        mean=np.array([ground.left + width / 2, ground.top - height / 2]),
        covariance=np.diag([width**2, height**2]) / 12.0,
        yaw_rad=math.nan,
        yaw_sigma_rad=math.nan,
        mass=0.0,
        candidates=np.empty((0, 2)),
        candidate_mass=np.empty(0),
        candidate_count=0,
        extra=extra,
    )
