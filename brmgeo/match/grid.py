"""The filter that ``ratio`` and ``mask`` share: belief on a grid, status, local track, smoother.

One step: move the belief by odometry, weigh it by the view, read off the heaviest place. While mass lies
outside the listed blocks the view is scored over the whole map, so nothing that still is possible is left out;
once the belief is concentrated it is scored only where the belief lives. After a fix a local track (place,
heading, scale) is carried along and corrected by measured poses; the belief goes on alone and remains the
judge of whether there is a fix at all.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError
from brmgeo.flight.values import Estimate, Motion, Status, View
from brmgeo.match.belief import Belief, Mode
from brmgeo.match.ground import GroundMap
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor, SmoothedPath, smooth_path
from brmgeo.match.track import Track, wrap

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Frame = Literal["odometry", "map", "body"]


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


class GridMatcher(ABC):
    """Bayes filter over place and heading; see the module. Subclasses say how well a view fits where."""

    def __init__(self, ground: GroundMap, settings: MatchSettings) -> None:
        self.ground = ground
        self.settings = settings
        self.cell_px = max(1, round(settings.belief.cell_m / ground.gsd_m))
        self.cell_m = self.cell_px * ground.gsd_m
        h, w = ground.building.shape
        self.belief = Belief((-(-h // self.cell_px), -(-w // self.cell_px)), settings.belief)
        self.track: Track | None = None
        self._misses = 0
        self._off_frames = 0
        self._confirmed = False
        self._fits: list[float] = []
        self._frame: Frame = "odometry"
        self._unfixed_searches = 0
        self._since_informed_m = 0.0
        self._views: list[View] = []
        self._motions: list[Motion] = []
        self._anchors: list[Anchor | None] = []

    # What a method adds

    @abstractmethod
    def _look(self, view: View) -> None:
        """Prepare for scoring one view."""

    @abstractmethod
    def _search(self, view: View, yaw_rad: float, body: F64 | None, weight: float) -> float:
        """Weigh the belief by the view's ratios over the whole map; returns the log of the evidence.

        ``yaw_rad`` is the body's yaw in the odometry frame; ``body`` is None, or (headings,) log weights of the body's
        yaw in the map where the odometry does not know it.
        """

    @abstractmethod
    def _score_listed(self, view: View, yaw_rad: float, body: F64 | None) -> F32:
        """(n, 16, 16) ratios of the belief's listed blocks; arguments as in ``_search``."""

    @abstractmethod
    def _measure(self, view: View, pose: F64, covariance: F64) -> Anchor | None:
        """The view's pose measured near a pose with a covariance, or None where it cannot be trusted."""

    @abstractmethod
    def _bounds(self) -> tuple[float, float]:
        """Bounds of one frame's ratio."""

    @abstractmethod
    def _evidence(self, view: View) -> tuple[float, float]:
        """Ground that the evidence comes from, square metres, and its weight per share of new ground."""

    def _systematic(self) -> float:
        """What all views of a flight get wrong together beside their levelling, metres per axis."""
        return 0.0

    def _lasting_m(self, view: View) -> float:
        """Error per axis that stays the same from frame to frame, metres: levelling, and what the method adds."""
        return math.hypot(self.settings.odometry.attitude_sigma_rad * view.agl_m, self._systematic())

    @abstractmethod
    def _least_fit(self) -> tuple[float, int]:
        """How well measured poses must fit before there is a first fix, in the mean of so many successive frames."""

    @abstractmethod
    def _learn(self, view: View, anchor: Anchor) -> None:
        """Adapt to a view whose pose is well known."""

    # The filter

    def step(self, view: View, motion: Motion) -> Estimate:
        """Take in one view and the motion since the one before, and say where the aircraft is.

        Raises FlightError for a view or motion that is malformed (``check_view``, ``check_motion``).
        """
        check_view(view)
        check_motion(motion, view)
        started = bool(self._views)
        frame = _frame(motion)
        if frame == "map":
            motion = replace(motion, yaw_rad=motion.compass_yaw_rad)
        self._views.append(_packed(view))
        self._motions.append(motion)
        self._anchors.append(None)
        if started:
            self._predict(motion, frame)
        self._frame = frame
        if motion.compass_yaw_rad is not None and motion.yaw_rad is not None:
            like = self._compass_likelihood(motion.compass_yaw_rad - motion.yaw_rad)
            self.belief.weigh_headings(like / like.mean())
        self._look(view)
        self._update(view, motion)
        mode = self.belief.mode(self.settings.belief.mode_radius_m / self.cell_m)
        return self._estimate(view, motion, mode)

    def _predict(self, motion: Motion, frame: Frame) -> None:
        odo = self.settings.odometry
        if motion.step_m is None:
            self.track, self._confirmed = None, False
            radius = max(1.0, odo.max_speed_m_s * motion.dt_s / self.cell_m)
            keep = odo.reset_keeps_heading if motion.yaw_rad is not None and frame == self._frame else 0.0
            self.belief.predict_unknown(radius, keep)
            return
        if frame != self._frame:
            # The belief's heading was another frame's: the odometry's own is not known yet.
            self.track, self._confirmed = None, False
            self.belief.predict_unknown(1.0, 0.0)
        step = np.asarray(motion.step_m, np.float64)
        length = float(np.hypot(*step))
        scale, scale_sigma = 0.0, odo.scale_sigma
        if self.track is not None:
            scale, scale_sigma = float(self.track.mean[3]), math.sqrt(float(self.track.covariance[3, 3]))
        # The scale's error is the same in every step: its spread grows with distance, not with the root of it.
        before = self._since_informed_m
        along2 = scale_sigma**2 * ((before + length) ** 2 - before**2)
        self._since_informed_m = before + length
        bin_rad = 2 * math.pi / self.settings.belief.headings
        across2 = (bin_rad * length) ** 2 / 12.0
        own2 = odo.step_sigma_m**2 + motion.sigma_m**2 + (odo.step_sigma_share * length) ** 2
        sigma = math.sqrt(0.5 * (along2 + across2) + own2)
        drift2 = odo.drift_rad_per_sqrt_s**2 * motion.dt_s
        share = 0.5 * drift2 / bin_rad**2
        self.belief.predict(step * math.exp(scale) / self.cell_m, sigma / self.cell_m, share)
        if self.track is not None:
            self.track.predict(motion, odo)

    def _compass_likelihood(self, heading_rad: float) -> F64:
        """(headings,) likelihood of each heading bin when a compass says ``heading_rad``."""
        bins = self.belief.heading_of(np.arange(self.belief.headings))
        apart = np.angle(np.exp(1j * (bins - heading_rad)))
        sigma = math.hypot(self.settings.odometry.compass_sigma_rad, math.pi / self.belief.headings)
        return np.asarray(np.exp(-0.5 * (apart / sigma) ** 2) + 1e-4)

    def _update(self, view: View, motion: Motion) -> None:
        weight = self._novelty(view, motion)
        yaw = motion.yaw_rad if motion.yaw_rad is not None else 0.0
        body = self._body_weights(motion) if motion.yaw_rad is None and motion.step_m is not None else None
        known = self.belief.rest > 1e-3
        # Flying where the map does not reach must not cost a search each frame.
        if known and (
            self._unfixed_searches < 10 or self._unfixed_searches % 3 == 0 or not len(self.belief.keys)
        ):
            gain = self._search(view, yaw, body, weight)
        else:
            gain = self.belief.update(self._score_listed(view, yaw, body), *self._bounds(), weight)
        self._unfixed_searches += 1
        if gain > 2.0:
            self._since_informed_m = 0.0

    def _body_weights(self, motion: Motion) -> F64:
        """(headings,) log weights of the body's yaw in the map where the odometry knows the step but not the yaw."""
        n = self.belief.headings
        if motion.compass_yaw_rad is None:
            return np.full(n, -math.log(n))
        weight = self._compass_likelihood(motion.compass_yaw_rad)
        return np.asarray(np.log(weight / weight.sum()))

    def _novelty(self, view: View, motion: Motion) -> float:
        """Weight of the view's evidence, by the share of it that the view before did not show; 1 if unknown."""
        if len(self._views) < 2 or motion.step_m is None:
            return 1.0
        area, repeat = self._evidence(view)
        # Even a view of old ground says a little: its mask has errors of its own.
        return min(1.0, max(0.02, repeat * float(np.hypot(*motion.step_m)) / math.sqrt(max(area, 1.0))))

    # From belief to estimate

    def _world(self, cell: F64) -> F64:
        """x, y of (..., 2) cell coordinates (row, col)."""
        return np.stack(
            [self.ground.left + cell[..., 1] * self.cell_m, self.ground.top - cell[..., 0] * self.cell_m],
            axis=-1,
        )

    def _estimate(self, view: View, motion: Motion, mode: Mode | None) -> Estimate:
        s = self.settings.belief
        belief = self.belief
        self._off_frames = self._off_frames + 1 if belief.off > s.lost_mass else 0
        cells, mass, count = belief.heaviest(s.candidates)
        extra = {
            "entropy": belief.entropy(),
            "off_map": belief.off,
            "unlisted": belief.rest,
            "listed_blocks": float(len(belief.keys)),
        }
        if mode is None:
            h, w = self.ground.building.shape
            g = self.ground.gsd_m
            middle = np.array([self.ground.left + w * g / 2, self.ground.top - h * g / 2])
            spread = np.diag([(w * g) ** 2, (h * g) ** 2]) / 12.0
            status: Status = "lost" if self._off_frames >= s.lost_frames else "ambiguous"
            return Estimate(
                view.t_s,
                status,
                middle,
                spread,
                math.nan,
                math.nan,
                0.0,
                np.empty((0, 2)),
                np.empty(0),
                0,
                extra,
            )
        mean = self._world(mode.mean)
        r, c = mode.covariance[0, 0], mode.covariance[1, 1]
        cross = -mode.covariance[0, 1]
        cov = np.array([[c, cross], [cross, r]]) * self.cell_m**2
        heading, heading_sigma = mode.heading_rad, mode.heading_sigma_rad
        sure = mode.mass > s.converged_mass
        if not sure:
            self._fits.clear()
        if sure:
            mean, cov, heading, heading_sigma = self._follow(view, motion, mean, cov, heading, heading_sigma)
        elif mode.mass < 0.5:
            self.track, self._confirmed = None, False
        if self.track is not None:
            extra["scale"] = math.exp(float(self.track.mean[3]))
        # What lasts the whole flight is averaged away by no filter.
        cov = cov + np.eye(2) * self._lasting_m(view) ** 2
        sigma = math.sqrt(float(np.trace(cov)) / 2.0)
        if sure and sigma <= s.converged_sigma_m and self._confirmed:
            status = "converged"
            self._unfixed_searches = 0
        else:
            status = "lost" if self._off_frames >= s.lost_frames else "ambiguous"
        if motion.yaw_rad is not None:
            yaw = wrap(heading + motion.yaw_rad)
        elif motion.step_m is None:
            yaw = wrap(heading)
        elif motion.compass_yaw_rad is not None:
            yaw, heading_sigma = wrap(motion.compass_yaw_rad), self.settings.odometry.compass_sigma_rad
        else:
            yaw, heading_sigma = math.nan, math.nan
        return Estimate(
            view.t_s, status, mean, cov, yaw, heading_sigma, mode.mass, self._world(cells), mass, count, extra
        )

    def _follow(
        self, view: View, motion: Motion, mean: F64, cov: F64, heading: float, heading_sigma: float
    ) -> tuple[F64, F64, float, float]:
        """Place and heading refined by a measured pose; the belief's own where there is none."""
        body = motion.yaw_rad
        odo = self.settings.odometry
        if self.track is not None:
            apart = self.track.mean[:2] - mean
            spread = cov + self.track.covariance[:2, :2] + np.eye(2) * self.cell_m**2
            if float(apart @ np.linalg.solve(spread, apart)) > 16.0:
                # The belief is the judge: a track that left the one place it knows is wrong.
                self.track, self._confirmed = None, False
        fresh = self.track is None
        if self.track is None:
            sigma_s = odo.scale_sigma
            self.track = Track(
                np.array([*mean, heading, 0.0]),
                np.block(
                    [
                        [cov, np.zeros((2, 2))],
                        [np.zeros((2, 2)), np.diag([heading_sigma**2, sigma_s**2])],
                    ]
                ),
            )
        track = self.track
        turn = body if body is not None else 0.0
        pose = np.array([*track.mean[:2], track.mean[2] + turn])
        pose_cov = track.covariance[:3, :3].copy()
        if body is None and motion.step_m is not None:
            if motion.compass_yaw_rad is None:
                return track.mean[:2].copy(), track.covariance[:2, :2].copy(), heading, heading_sigma
            pose[2] = motion.compass_yaw_rad
            pose_cov[2, :] = pose_cov[:, 2] = 0.0
            pose_cov[2, 2] = odo.compass_sigma_rad**2
        anchor = self._measure(view, pose, pose_cov)
        if anchor is not None and body is None and motion.step_m is not None:
            # The body's yaw says nothing of the odometry frame's heading.
            place = anchor.covariance.copy()
            place[2, :] = place[:, 2] = 0.0
            place[2, 2] = math.pi**2
            anchor = Anchor(np.array([*anchor.pose[:2], track.mean[2]]), place, anchor.fit)
        if anchor is not None:
            d2 = track.distance2(anchor.pose, anchor.covariance, turn)
            if d2 < 16.3 or fresh:
                track.update(anchor.pose, anchor.covariance, turn)
                self._misses = 0
                self._confirmed |= self._fits_well(anchor.fit)
                if self._confirmed:
                    self._anchors[-1] = anchor
                    self._learn(view, anchor)
            else:
                self._misses += 1
                if self._misses >= 3:
                    self.track, self._confirmed = None, False
                    self._misses = 0
        result = (
            track.mean[:2].copy(),
            track.covariance[:2, :2].copy(),
            float(track.mean[2]),
            math.sqrt(float(track.covariance[2, 2])),
        )
        if motion.step_m is None and body is None:
            self.track = None
        return result

    def _fits_well(self, fit: float) -> bool:
        # A view of next to no building has no fit, good or bad.
        if not math.isnan(fit):
            self._fits.append(fit)
        least, frames = self._least_fit()
        return len(self._fits) >= frames and float(np.mean(self._fits[-frames:])) >= least

    # After the flight

    def smooth(self) -> SmoothedPath:
        """The most likely path of the whole flight so far, also before the first fix; see ``brmgeo.match.smooth``."""

        def register(i: int, pose: F64, covariance: F64) -> Anchor | None:
            anchor = self._measure(_unpacked(self._views[i]), pose, covariance)
            if anchor is None:
                return None
            error = anchor.pose - pose
            error[2] = wrap(float(error[2]))
            d2 = float(error @ np.linalg.solve(covariance + anchor.covariance, error))
            return anchor if d2 < 16.3 else None

        path = smooth_path(
            [v.t_s for v in self._views], self._motions, self._anchors, self.settings.odometry, register
        )
        lasting = np.array([self._lasting_m(v) for v in self._views])
        return SmoothedPath(path.t_s, path.xy, path.yaw_rad, np.hypot(path.sigma_m, lasting))


def _frame(motion: Motion) -> Frame:
    """What the belief's heading is counted from: without odometry, the map's axes if a compass gives the body's yaw,
    else the body itself."""
    if motion.step_m is not None or motion.yaw_rad is not None:
        return "odometry"
    return "map" if motion.compass_yaw_rad is not None else "body"


def _packed(view: View) -> View:
    """The view in a quarter of the memory: the smoother looks at every view again."""
    scaled = np.rint(view.building * 255).astype(np.uint8)
    return View(view.t_s, scaled, view.known, view.gsd_m, view.nadir_px, view.agl_m, view.radius_m, view.file)  # type: ignore[arg-type]


def _unpacked(view: View) -> View:
    building = view.building.astype(np.float32) / np.float32(255)
    return View(
        view.t_s, building, view.known, view.gsd_m, view.nadir_px, view.agl_m, view.radius_m, view.file
    )
