"""Settings of the matchers, with units and ranges: frozen, checked once, the same for live use and for a folder."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from brmgeo.errors import SettingsError
from brmgeo.settings import require_within


def _check_rates(owner: Any) -> None:
    if owner.false_alarm >= owner.hit:
        raise SettingsError(
            f"{type(owner).__name__}.false_alarm = {owner.false_alarm} is not below hit = {owner.hit}: "
            "swap or correct them"
        )


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """How far odometry may be trusted; the same numbers serve belief, track and smoother.

    Attributes:
        scale_sigma: standard deviation of the scale (true step = exp(s) * step), share, [0, 0.5].
        scale_walk_per_sqrt_s: random walk of the scale, share per root second, [0, 0.1].
        drift_rad_per_sqrt_s: random walk of the odometry frame's heading, radians per root second, [0, 0.1]
            (0.75 degrees per root minute is 0.0017).
        step_sigma_m: noise of a step per axis that does not depend on its length, metres, [0, 100].
        step_sigma_share: noise of a step per axis as a share of its length, [0, 1].
        max_speed_m_s: bound of the movement where odometry says nothing, metres per second, [0.1, 500].
        attitude_sigma_rad: standard deviation of the views' levelling, radians, [0, 0.2]: it moves a view by
            that angle times the height, each frame anew and once for the whole flight.
        mount_sigma_rad: standard deviation of the camera mount's roll and of its pitch, radians, [0, 0.2]: it moves all
            views of a flight alike, by that angle times the height, so it is added to what is reported alone.
        compass_sigma_rad: standard deviation of a trusted compass, radians, [0.001, pi].
        reset_keeps_heading: probability that the odometry frame's heading survives a step of None, [0, 1].
    """

    scale_sigma: float = 0.05
    scale_walk_per_sqrt_s: float = 0.0005
    drift_rad_per_sqrt_s: float = 0.0020
    step_sigma_m: float = 0.15
    step_sigma_share: float = 0.01
    max_speed_m_s: float = 25.0
    attitude_sigma_rad: float = 0.0035
    mount_sigma_rad: float = 0.0
    compass_sigma_rad: float = 0.15
    reset_keeps_heading: float = 0.5

    def __post_init__(self) -> None:
        require_within(
            self,
            scale_sigma=(0, 0.5),
            scale_walk_per_sqrt_s=(0, 0.1),
            drift_rad_per_sqrt_s=(0, 0.1),
            step_sigma_m=(0, 100),
            step_sigma_share=(0, 1),
            max_speed_m_s=(0.1, 500),
            attitude_sigma_rad=(0, 0.2),
            mount_sigma_rad=(0, 0.2),
            compass_sigma_rad=(0.001, math.pi),
            reset_keeps_heading=(0, 1),
        )


@dataclass(frozen=True, slots=True)
class RateSettings:
    """How a mask and a map disagree where both look at the same ground.

    Attributes:
        hit: P1, share of mask pixels that are building over a mapped building, (0, 1).
        false_alarm: P0, the same elsewhere, (0, hit).
        independent_m2: ground area that carries one independent observation, square metres, [1, 1e5]: mask and map
            differ by whole buildings, so pixels of one building count together.
        llr_min, llr_max: bounds of one frame's log-likelihood ratio, [-50, 0] and [1, 80]: a frame may be
            wrong as a whole.
        repeat: weight of a view's evidence per share of new ground in it, [0.1, 100]: views overlap, and what
            two of them show counts little more than once, else a hovering aircraft would grow sure of a place
            that only looks alike. 1 would hold if masks of the same ground always had the same errors.
        systematic_sigma_m: standard deviation per axis of what all views of a flight get wrong together, metres, [0, 100]:
            roofs lean away from the camera by height over AGL times their distance, and where buildings stand on one
            side of it a view is pulled to that side for many frames. No filter averages that away: it is added to
            what is reported, not to what is measured.
        least_fit: the first fix needs a registered view in which building and map overlap this well (Dice: twice
            the common area over the sum of both), [0, 1].
        learn: whether P1 falls and P0 rises when registered frames fit worse than these say; they never get
            more trusting.

    The defaults are not the shares of pixels that one would count (0.87 and 0.015 in the simulator): masks
    miss whole buildings, and lower rates with a smaller independent area tell places apart best while a wrong
    map still gains nothing (docs/matchers.md has the table).
    """

    hit: float = 0.75
    false_alarm: float = 0.03
    independent_m2: float = 180.0
    llr_min: float = -8.0
    llr_max: float = 25.0
    repeat: float = 3.0
    systematic_sigma_m: float = 0.5
    least_fit: float = 0.6
    learn: bool = True

    def __post_init__(self) -> None:
        require_within(
            self,
            hit=(0.05, 0.999),
            false_alarm=(0.0005, 0.9),
            independent_m2=(1, 1e5),
            llr_min=(-50, 0),
            llr_max=(1, 80),  # its exponential is a float32
            repeat=(0.1, 100),
            systematic_sigma_m=(0, 100),
            least_fit=(0, 1),
        )
        _check_rates(self)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of one frame's log-likelihood ratio."""
        return self.llr_min, self.llr_max


@dataclass(frozen=True, slots=True)
class BeliefSettings:
    """The grid belief and when it counts as a fix.

    Attributes:
        cell_m: size of a cell, metres, [1, 50]; rounded to whole map pixels.
        headings: heading bins over the full circle, [8, 720].
        off_map_start: belief that the flight starts off the map, (0, 1).
        leak_out, leak_in: share that leaves the map, or comes back to anywhere on it, each frame, [0, 0.5].
        heading_leak: least share that goes to each neighbouring heading bin each frame, [0, 0.3].
        max_blocks: bound of listed blocks (16 x 16 cells of one heading, 1 KiB each), [100, 10_000_000].
        keep: a block is listed while its mass exceeds this share of an even spread's, (0, 1].
        mode_radius_m: cells this close to the heaviest one belong to its mode, metres, [5, 500].
        converged_mass: belief that one mode must hold, (0.5, 1).
        converged_sigma_m: largest spread (root of half the trace) of a fix, metres, [0.1, 200].
        lost_mass, lost_frames: the status is ``lost`` once off the map has held more than this belief, (0, 1), for so
            many frames in a row, [1, 1000]: one view that looks like nothing on the map is no evidence yet, and a
            start without any is ``ambiguous``.
        candidates: how many of the heaviest cells an estimate lists, [1, 1_000_000].
    """

    cell_m: float = 5.0
    headings: int = 72
    off_map_start: float = 0.5
    leak_out: float = 1e-3
    leak_in: float = 2e-2
    heading_leak: float = 0.002
    max_blocks: int = 120_000
    keep: float = 0.05
    mode_radius_m: float = 40.0
    converged_mass: float = 0.99
    converged_sigma_m: float = 15.0
    lost_mass: float = 0.8
    lost_frames: int = 5
    candidates: int = 2000

    def __post_init__(self) -> None:
        require_within(
            self,
            cell_m=(1, 50),
            headings=(8, 720),
            off_map_start=(1e-9, 1 - 1e-9),
            leak_out=(0, 0.5),
            leak_in=(0, 0.5),
            heading_leak=(0, 0.3),
            max_blocks=(100, 10_000_000),
            keep=(1e-9, 1),
            mode_radius_m=(5, 500),
            converged_mass=(0.5, 1),
            converged_sigma_m=(0.1, 200),
            lost_mass=(0, 1),
            lost_frames=(1, 1000),
            candidates=(1, 1_000_000),
        )

    def cell_px(self, gsd_m: float) -> int:
        """Whole pixels of a map of ``gsd_m`` to a cell's side, at least one."""
        return max(1, round(self.cell_m / gsd_m))


@dataclass(frozen=True, slots=True)
class RatioSettings:
    """Ratio features of the ``ratio`` matcher, and of every cache of ratio maps.

    Attributes:
        radii: number of radii, r_k = k / radii of the largest disc (eq. 3), [1, 32].
        radius_step: ratio maps are kept per step of this relative size, [0.001, 0.2]; a frame takes the nearest, so the
            radius is off by half a step at most.
        noise: standard deviation of a ring's ratio that no rate explains, [0.001, 0.5].
        dof: degrees of freedom of the Student likelihood of one ring, [1, 100].
        hit, false_alarm: as in ``RateSettings``.
        independent_m2: as in ``RateSettings``, for the scatter of a ring's ratio, square metres, [1, 1e5].
        repeat: as in ``RateSettings``, [0.1, 100].
        least_fit: the first fix needs two successive views whose rings hold the building that the map's rings hold (Dice
            of areas, mean of the two), [0, 1].
    """

    radii: int = 8
    radius_step: float = 0.04
    noise: float = 0.012
    dof: float = 5.0
    hit: float = 0.7
    false_alarm: float = 0.04
    independent_m2: float = 300.0
    repeat: float = 5.0
    least_fit: float = 0.9

    def __post_init__(self) -> None:
        require_within(
            self,
            radii=(1, 32),
            radius_step=(0.001, 0.2),
            noise=(0.001, 0.5),
            dof=(1, 100),
            hit=(0.05, 0.999),
            false_alarm=(0.0005, 0.9),
            independent_m2=(1, 1e5),
            repeat=(0.1, 100),
            least_fit=(0, 1),
        )
        _check_rates(self)


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """The paper's constants (eq. 4-7); the defaults are its own figures.

    Attributes:
        radii: n, number of radii, [1, 16].
        e1: bound of ``sum_k |M_k - f_k|``, (0, 16].
        eps_m: half side of the box around the predicted point, metres, [0.1, 500].
        d_max_m: converged when every candidate lies this close to their mean, metres, [0.1, 1000].
        pair_work: eq. 4 is applied pair by pair while that takes no more box tests than this, [0, 1e10]; above it,
            any heading is allowed.
        follow_turns: whether the odometry's turn between two steps is added to the heading through the two previous
            candidates. The paper does not; without it a flight that turns loses its candidates and starts again.
    """

    radii: int = 3
    e1: float = 0.3
    eps_m: float = 25.0
    d_max_m: float = 75.0
    pair_work: int = 60_000_000
    follow_turns: bool = False

    def __post_init__(self) -> None:
        require_within(
            self, radii=(1, 16), e1=(1e-6, 16), eps_m=(0.1, 500), d_max_m=(0.1, 1000), pair_work=(0, 1e10)
        )


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """All settings of the matchers; each method reads the groups it needs."""

    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    rates: RateSettings = field(default_factory=RateSettings)
    belief: BeliefSettings = field(default_factory=BeliefSettings)
    ratio: RatioSettings = field(default_factory=RatioSettings)
    paper: PaperSettings = field(default_factory=PaperSettings)
