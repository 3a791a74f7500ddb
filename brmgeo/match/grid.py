"""The filter that ``ratio`` and ``mask`` share: belief on a grid, status, local track, smoother.

One step: move the belief by odometry, weigh it by the view, read off the heaviest place. While mass lies
outside the listed blocks the view is scored over the whole map, so nothing that still is possible is left out;
once the belief is concentrated it is scored only where the belief lives. After a fix a local track (place,
heading, scale) is carried along and corrected by measured poses; the belief goes on alone and remains the
judge of whether there is a fix at all.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Estimate, Motion, Status, View
from brmgeo.match.belief import Belief, Mode
from brmgeo.match.ground import GroundMap
from brmgeo.match.history import History, kept
from brmgeo.match.scorer import Scorer
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor, SmoothedPath, smooth_path
from brmgeo.match.state import State, check_state, damaged, signature, under, within
from brmgeo.match.steps import check_motion, check_view, nowhere
from brmgeo.match.track import Track, wrap

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
YawFrame = Literal["odometry", "map", "body"]


class GridMatcher:
    """Bayes filter over place and heading; see the module.

    Args:
        method: its name.
        ground: the map.
        settings: of belief, odometry and the method.
        scorer: how well a view fits where; fresh, of the same map and settings.
        history: whether all frames are kept, so that the flight can be smoothed.
    """

    def __init__(
        self, method: str, ground: GroundMap, settings: MatchSettings, scorer: Scorer, history: bool
    ) -> None:
        self.method = method
        self.ground = ground
        self.settings = settings
        self.scorer = scorer
        cell_px = settings.belief.cell_px(ground.gsd_m)
        self.cell_m = cell_px * ground.gsd_m
        h, w = ground.building.shape
        self.belief = Belief((-(-h // cell_px), -(-w // cell_px)), settings.belief)
        self.track: Track | None = None
        self.history = History() if history else None
        self._started = False
        self._misses = 0
        self._off_frames = 0
        self._confirmed = False
        self._fits: deque[float] = deque(maxlen=scorer.least_fit[1])
        self._frame: YawFrame = "odometry"
        self._unfixed_searches = 0
        self._since_informed_m = 0.0

    def _lasting_m(self, agl_m: float) -> float:
        """Error per axis that stays the same from frame to frame, metres: levelling, and what the method adds."""
        odometry = self.settings.odometry
        levelling = math.hypot(odometry.attitude_sigma_rad, odometry.mount_sigma_rad)
        return math.hypot(levelling * agl_m, self.scorer.systematic_m)

    # The filter

    def step(self, view: View, motion: Motion) -> Estimate:
        """Take in one view and the motion since the one before, and say where the aircraft is.

        Raises FlightError for a view or motion that is malformed (``check_view``, ``check_motion``).
        """
        check_view(view)
        check_motion(motion, view)
        frame = _frame(motion)
        if frame == "map":
            motion = replace(motion, yaw_rad=motion.compass_yaw_rad)
        if self.history is not None:
            self.history.add(view.t_s, motion, view)
        if self._started:
            self._predict(motion, frame)
        self._frame = frame
        if motion.compass_yaw_rad is not None and motion.yaw_rad is not None:
            like = self._compass_likelihood(motion.compass_yaw_rad - motion.yaw_rad)
            self.belief.weigh_headings(like / like.mean())
        self.scorer.look(view)
        self._update(view, motion)
        self._started = True
        mode = self.belief.mode(self.settings.belief.mode_radius_m / self.cell_m)
        return self._estimate(view, motion, mode)

    def _predict(self, motion: Motion, frame: YawFrame) -> None:
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
            gain = self.scorer.search(self.belief, yaw, body, weight)
        else:
            llr = self.scorer.score_listed(self.belief, yaw, body)
            gain = self.belief.update(llr, *self.settings.rates.bounds, weight)
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
        if not self._started or motion.step_m is None:
            return 1.0
        area, repeat = self.scorer.evidence(view)
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
        none: Status = "lost" if self._off_frames >= s.lost_frames else "ambiguous"
        cells, mass, count = belief.heaviest(s.candidates)
        extra = {
            "entropy": belief.entropy(),
            "off_map": belief.off,
            "unlisted": belief.rest,
            "listed_blocks": float(len(belief.keys)),
        }
        if mode is None:
            return nowhere(view, self.ground, none, extra)
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
        cov = cov + np.eye(2) * self._lasting_m(view.agl_m) ** 2
        sigma = math.sqrt(float(np.trace(cov)) / 2.0)
        fixed = sure and sigma <= s.converged_sigma_m and self._confirmed
        if fixed:
            self._unfixed_searches = 0
        yaw, yaw_sigma = self._body_yaw(motion, heading, heading_sigma)
        return Estimate(
            t_s=view.t_s,
            status="converged" if fixed else none,
            mean=mean,
            covariance=cov,
            yaw_rad=yaw,
            yaw_sigma_rad=yaw_sigma,
            mass=mode.mass,
            candidates=self._world(cells),
            candidate_mass=mass,
            candidate_count=count,
            extra=extra,
        )

    def _body_yaw(self, motion: Motion, heading: float, sigma: float) -> tuple[float, float]:
        """Yaw of the body in the map and its deviation, from the heading that the belief or the track knows."""
        if motion.yaw_rad is not None:
            return wrap(heading + motion.yaw_rad), sigma
        if motion.step_m is None:
            return wrap(heading), sigma
        if motion.compass_yaw_rad is not None:
            return wrap(motion.compass_yaw_rad), self.settings.odometry.compass_sigma_rad
        return math.nan, math.nan

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
        if np.trace(cov) < np.trace(pose_cov[:2, :2]):
            # After a step as wide as this the belief, which has seen the view, knows the place better than the track.
            pose[:2] = mean
            pose_cov[:2, :2] = cov
            pose_cov[:2, 2] = pose_cov[2, :2] = 0.0
        place, place_cov = pose[:2].copy(), pose_cov[:2, :2].copy()
        if body is None and motion.step_m is not None:
            if motion.compass_yaw_rad is None:
                return place, place_cov, heading, heading_sigma
            pose[2] = motion.compass_yaw_rad
            pose_cov[2, :] = pose_cov[:, 2] = 0.0
            pose_cov[2, 2] = odo.compass_sigma_rad**2
        anchor = self.scorer.measure(view, pose, pose_cov)
        if anchor is not None and body is None and motion.step_m is not None:
            # The body's yaw says nothing of the odometry frame's heading.
            of_place = anchor.covariance.copy()
            of_place[2, :] = of_place[:, 2] = 0.0
            of_place[2, 2] = math.pi**2
            anchor = Anchor(np.array([*anchor.pose[:2], track.mean[2]]), of_place, anchor.fit)
        if anchor is not None:
            d2 = track.distance2(anchor.pose, anchor.covariance, turn)
            if d2 < 16.3 or fresh:
                track.update(anchor.pose, anchor.covariance, turn)
                place, place_cov = track.mean[:2].copy(), track.covariance[:2, :2].copy()
                self._misses = 0
                self._confirmed |= self._fits_well(anchor.fit)
                if self._confirmed:
                    if self.history is not None:
                        self.history.anchors[-1] = anchor
                    self.scorer.learn(anchor)
            else:
                self._misses += 1
                if self._misses >= 3:
                    self.track, self._confirmed = None, False
                    self._misses = 0
        if motion.step_m is None and body is None:
            self.track = None
        return place, place_cov, float(track.mean[2]), math.sqrt(float(track.covariance[2, 2]))

    def _fits_well(self, fit: float) -> bool:
        # A view of next to no building has no fit, good or bad.
        if not math.isnan(fit):
            self._fits.append(fit)
        least, frames = self.scorer.least_fit
        return len(self._fits) == frames and float(np.mean(self._fits)) >= least

    # After the flight

    def smooth(self) -> SmoothedPath:
        """The most likely path of the whole flight so far, also before the first fix; see ``brmgeo.match.smooth``.

        Raises SettingsError where no history is kept.
        """
        history = kept(self.history)

        def register(i: int, pose: F64, covariance: F64) -> Anchor | None:
            anchor = self.scorer.measure(history.views[i].view(history.times_s[i]), pose, covariance)
            if anchor is None:
                return None
            error = anchor.pose - pose
            error[2] = wrap(float(error[2]))
            d2 = float(error @ np.linalg.solve(covariance + anchor.covariance, error))
            return anchor if d2 < 16.3 else None

        path = smooth_path(
            history.times_s, history.motions, history.anchors, self.settings.odometry, register
        )
        lasting = np.array([self._lasting_m(v.agl_m) for v in history.views])
        return SmoothedPath(path.t_s, path.xy, path.yaw_rad, np.hypot(path.sigma_m, lasting))

    # From process to process

    def state(self) -> State:
        """All that the frames so far have left, as named arrays; see ``brmgeo.match.state``."""
        tracks = [] if self.track is None else [self.track]
        parts = within("belief", self.belief.state()) | within("scorer", self.scorer.state())
        if self.history is not None:
            parts |= within("history", self.history.state())
        return {
            **signature(self.method, self.ground, self.settings),
            **parts,
            "track.mean": np.array([t.mean for t in tracks], np.float64).reshape(-1, 4),
            "track.covariance": np.array([t.covariance for t in tracks], np.float64).reshape(-1, 4, 4),
            "started": np.array(self._started),
            "misses": np.array(self._misses),
            "off_frames": np.array(self._off_frames),
            "confirmed": np.array(self._confirmed),
            "fits": np.array(self._fits, np.float64),
            "frame": np.array(self._frame),
            "unfixed_searches": np.array(self._unfixed_searches),
            "since_informed_m": np.array(self._since_informed_m),
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave: the next steps give what the uninterrupted matcher would have given, bit for bit.

        This matcher must be fresh. Raises InputError for a state of another method, map or settings, or one with a
        history where this one keeps none (or the other way round), or a damaged one; then make another matcher.
        """
        check_state(state, self.state())
        frame = str(state["frame"])
        if frame not in get_args(YawFrame) or len(state["track.mean"]) != len(state["track.covariance"]):
            raise damaged("its track or frame is not one")
        self.belief.restore(under(state, "belief"))
        self.scorer.restore(under(state, "scorer"))
        if self.history is not None:
            self.history.restore(under(state, "history"))
        track = under(state, "track")
        self.track = Track(track["mean"][0], track["covariance"][0]) if len(track["mean"]) else None
        self._started, self._confirmed = bool(state["started"]), bool(state["confirmed"])
        self._misses, self._off_frames = int(state["misses"]), int(state["off_frames"])
        self._fits.extend(state["fits"].tolist())
        self._frame = cast(YawFrame, frame)
        self._unfixed_searches = int(state["unfixed_searches"])
        self._since_informed_m = float(state["since_informed_m"])


def _frame(motion: Motion) -> YawFrame:
    """What the belief's heading is counted from: without odometry, the map's axes if a compass gives the body's yaw,
    else the body itself."""
    if motion.step_m is not None or motion.yaw_rad is not None:
        return "odometry"
    return "map" if motion.compass_yaw_rad is not None else "body"
