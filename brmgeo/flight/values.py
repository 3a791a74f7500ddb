"""Values that the flight side hands to the matchers, and what they answer.

Conventions (see also ``brmgeo.geo``). The map frame is ENU (x east, y north). The body frame is FLU. The odometry frame is
gravity-aligned, z up, with arbitrary origin and yaw. Yaw is in radians, counter-clockwise from the x axis of
its frame; in the map frame that is counter-clockwise from east.

A ``View`` is drawn from above with its row 0 towards the aircraft's nose and its columns growing to the
aircraft's right, whatever the mounting of the camera. For yaw y in the map, a point of the view that lies
``f`` metres ahead of and ``l`` metres to the left of the nadir point is at (x + f cos y - l sin y, y + f sin y + l cos y).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Status = Literal["converged", "ambiguous", "lost"]


@dataclass(frozen=True, slots=True)
class View:
    """One frame's buildings, levelled and resampled to the map's GSD, nose up.

    Attributes:
        t_s: time of the frame, seconds.
        building: (h, w) float32 in [0, 1], probability or share of building of each pixel; 0 where unknown.
        known: (h, w) bool, False where the camera did not see or the mask says nothing.
        gsd_m: metres per pixel.
        nadir_px: (row, col) of the point straight below the camera, edge convention; may lie outside the array.
        agl_m: height above ground, metres.
        radius_m: radius of the largest disc about the nadir point that the paper's h x h crop covers
            (half of the field of view's ground width: z tan(alpha / 2)), metres.
        file: the frame's name, for messages and results.
    """

    t_s: float
    building: NDArray[np.float32]
    known: NDArray[np.bool_]
    gsd_m: float
    nadir_px: tuple[float, float]
    agl_m: float
    radius_m: float
    file: str = ""


@dataclass(frozen=True, slots=True)
class Motion:
    """The movement from the previous view to this one, as odometry tells it.

    Attributes:
        dt_s: seconds since the previous view.
        step_m: (2,) float64, displacement in the odometry frame, metres; None when there is no odometry, or a gap or
            reset lies between: then only ``max_speed_m_s * dt_s`` bounds the movement.
        yaw_rad: yaw of the body (nose) in the odometry frame at this view; None when unknown.
        sigma_m: standard deviation of the step from the odometry itself, metres per axis, without scale and drift.
        compass_yaw_rad: yaw of the body in the map frame from a trusted compass, or None.
    """

    dt_s: float
    step_m: NDArray[np.float64] | None
    yaw_rad: float | None
    sigma_m: float = 0.0
    compass_yaw_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """A matcher's answer for one view. ``position`` gives a place only together with a status and a covariance.

    Attributes:
        t_s: time of the view, seconds.
        status: ``converged`` (one place), ``ambiguous`` (several), ``lost`` (off the map, or nothing fits).
        mean: (2,) float64 x, y in the map frame, metres: best place known, whatever the status.
        covariance: (2, 2) float64, square metres.
        yaw_rad: yaw of the body in the map frame, or NaN when unknown.
        yaw_sigma_rad: its standard deviation, radians (NaN when unknown).
        mass: probability of the mode that ``mean`` describes, in [0, 1].
        candidates: (n, 2) float64 x, y of candidate cells or of the belief's heaviest cells.
        candidate_mass: (n,) float64, their probability (uniform for the paper's sets).
        candidate_count: number of candidates in all (``candidates`` may be cut to the heaviest).
        extra: matcher-specific numbers worth keeping (entropy, off-map mass, scale, ...), by name.
    """

    t_s: float
    status: Status
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    yaw_rad: float
    yaw_sigma_rad: float
    mass: float
    candidates: NDArray[np.float64]
    candidate_mass: NDArray[np.float64]
    candidate_count: int
    extra: dict[str, float] = field(default_factory=dict)

    @property
    def position(self) -> tuple[float, float, float] | None:
        """(x, y, sigma_m) when converged, else None; sigma_m is the root of half the covariance's trace."""
        if self.status != "converged":
            return None
        return float(self.mean[0]), float(self.mean[1]), float(np.sqrt(np.trace(self.covariance) / 2.0))
