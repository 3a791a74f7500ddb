"""The paper's matcher: sets of candidate pixels, as written in its eq. 4-7.

One step:

- **Search** (eq. 5): every map pixel with ``sum_k |M_k - f_k| < e1``, over the n ratio maps at the frame's own radii.
- **Heading** (eq. 4): a candidate c of the frame before, that came from b one frame earlier, flew in the
  direction of c - b.
- **Motion** (eq. 6): a pixel stays a candidate when it lies in the box of half side eps about (x + d cos
  theta, y + d sin theta) of some candidate c of the frame before, d being the odometry's distance. While there
  is only one earlier frame, any theta.
- **Fix** (eq. 7): converged when every candidate lies within d_max of their mean; the mean is the position.
- When no candidate is left the search starts again from the whole map.

Where the text leaves a choice, this is what is done here:

- Theta is the heading through the two previous candidates and nothing else. A flight that turns by more than the box
  forgives loses its candidates there and starts again; ``PaperSettings.follow_turns`` adds the odometry's turn
  between the two steps to theta, which the text does not.
- The pairs (b, c) behind eq. 4 are followed one by one while that is affordable (``PaperSettings.pair_work``
  box tests); with more candidates than that nearly every heading occurs at nearly every candidate, and any
  heading is allowed. That keeps more candidates, never fewer.
- Candidates are whole pixels; a box contains a pixel when its centre lies strictly inside.
- A pixel of the map where some ratio is unknown is no candidate, and a frame with a ratio unknown keeps all.
- The restart takes the frame's own search result as the new first set.
- A frame without an odometry step lets candidates move by up to the greatest speed in any direction; the pairs
  start anew.
- Ratios are compared on the map's 1e-4 steps. The radii are those of the frame, rounded to the settings' radius step.
- A position's covariance is the spread of its candidates, and at least that of the box (eps).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import disc_radii
from brmgeo.flight.values import Estimate, Motion, Status, View
from brmgeo.flight.view import Features, features
from brmgeo.maps.ratio import ratio_maps
from brmgeo.match.candidates import RingReach, census, follow_pairs, ring_spans, search_ratios
from brmgeo.match.ground import GroundMap
from brmgeo.match.history import History, kept
from brmgeo.match.settings import MatchSettings
from brmgeo.match.smooth import Anchor, SmoothedPath, smooth_path
from brmgeo.match.state import State, check_state, damaged, signature, under, within
from brmgeo.match.steps import check_motion, check_view, nowhere
from brmgeo.match.track import wrap

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


class PaperMatcher:
    """Candidate sets; see the module.

    The estimate's mean is the mean of all candidates, whatever the status; ``ambiguous`` while several places
    are left, ``lost`` when a frame fits nowhere on the map.
    """

    def __init__(self, ground: GroundMap, settings: MatchSettings, history: bool) -> None:
        self.ground = ground
        self.settings = settings
        self.history = History() if history else None
        shape = ground.building.shape
        self._maps: OrderedDict[int, NDArray[np.uint16]] = OrderedDict()
        self._now = np.zeros(shape, np.uint8)
        self._before = np.zeros(shape, np.uint8)
        self._reach = RingReach(shape)
        self._have = False
        self._count = 0
        # Pairs behind eq. 4: candidates (m, 2) and the directions in which each arrived.
        self._places: I32 | None = None
        self._theta_start = np.zeros(1, np.int64)
        self._theta = np.empty(0)
        self._last_step: F64 | None = None
        self._pairs = np.empty((2_000_000, 2), np.int32)

    def _ratios(self, largest_m: float) -> NDArray[np.uint16]:
        """(n, H, W) ratio maps for a frame's largest radius, rounded to the ladder; the last few steps are kept."""
        step = math.log1p(self.settings.ratio.radius_step)
        key = round(math.log(largest_m) / step)
        if key not in self._maps:
            radii = disc_radii(math.exp(key * step) / self.ground.gsd_m, self.settings.paper.radii)
            self._maps[key] = ratio_maps(self.ground.building, radii, threads=2)
            while len(self._maps) > 4:
                self._maps.popitem(last=False)
        self._maps.move_to_end(key)
        return self._maps[key]

    def step(self, view: View, motion: Motion) -> Estimate:
        """Take in one view and the motion since the one before; see the module.

        Raises FlightError for a view or motion that is malformed.
        """
        check_view(view)
        check_motion(motion, view)
        if self.history is not None:
            self.history.add(view.t_s, motion)
        f = features(view, self.settings.paper.radii)
        restarted = False
        found = searched = self._search(f)
        if self._have and found:
            left = self._constrain(motion)
            if left == 0:
                # None left: start again from this frame's own search.
                restarted = True
                self._places = None
                self._search(f)
            else:
                found = left
        elif not found:
            self._places = None
        self._count = found
        self._have = found > 0
        self._last_step = None if motion.step_m is None else np.asarray(motion.step_m, np.float64)
        self._before, self._now = self._now, self._before
        return self._estimate(view, motion, searched, restarted)

    def _search(self, f: Features) -> int:
        """Mark in ``_now`` what fits a frame by itself, all where a ratio of it is unknown; returns how many."""
        if np.isfinite(f.f).all():
            return search_ratios(self._ratios(float(f.radii_m[0])), f.f, self.settings.paper.e1, self._now)
        self._now[:] = 1
        return self._now.size

    def _constrain(self, motion: Motion) -> int:
        """Keep of ``_now`` what the motion allows from ``_before``; returns how many are left."""
        g = self.ground.gsd_m
        s = self.settings.paper
        eps = s.eps_m / g
        if motion.step_m is None:
            self._places = None
            far = self.settings.odometry.max_speed_m_s * motion.dt_s / g
            if far > max(self._now.shape):
                return int(np.count_nonzero(self._now))
            spans, reach = ring_spans(far, eps, inner=0.0)
            return self._reach.keep(self._before, spans, reach, self._now)
        distance = float(np.hypot(*motion.step_m)) / g
        if self._places is not None and self._last_step is not None:
            kept = self._follow(motion, distance, eps)
            if kept >= 0:
                return kept
        spans, reach = ring_spans(distance, eps)
        kept = self._reach.keep(self._before, spans, reach, self._now)
        self._begin_pairs(kept, distance, eps)
        return kept

    def _listed(self) -> tuple[I32, NDArray[np.int64]]:
        """(n, 2) row, col of ``_now`` in row order, and where each row starts."""
        rows, cols = self.ground.building.shape
        flat = np.flatnonzero(self._now)
        places = np.stack(np.divmod(flat, cols), axis=1).astype(np.int32)
        start = np.searchsorted(places[:, 0], np.arange(rows + 1)).astype(np.int64)
        return places, start

    def _begin_pairs(self, count: int, distance: float, eps: float) -> None:
        """Pairs of ``_before`` and ``_now`` under any heading, when they are few enough."""
        self._places = None
        if count == 0 or count * self._count > self.settings.paper.pair_work:
            return
        places, _ = self._listed()
        before = np.stack(np.nonzero(self._before), axis=1)
        chunks, starts = [], [0]
        for place in places:
            dx = place[1] - before[:, 1].astype(np.float64)
            dy = before[:, 0].astype(np.float64) - place[0]
            theta = np.arctan2(dy, dx)
            near = (np.abs(dx - distance * np.cos(theta)) < eps) & (
                np.abs(dy - distance * np.sin(theta)) < eps
            )
            chunks.append(theta[near])
            starts.append(starts[-1] + int(near.sum()))
            if starts[-1] > len(self._pairs):
                return
        self._places, self._theta, self._theta_start = places, np.concatenate(chunks), np.array(starts)

    def _follow(self, motion: Motion, distance: float, eps: float) -> int:
        """Eq. 4 and 6 pair by pair; -1 when there are too many pairs."""
        assert self._places is not None
        assert self._last_step is not None
        assert motion.step_m is not None
        if len(self._theta) * (2 * eps) > self.settings.paper.pair_work:
            self._places = None
            return -1
        step = np.asarray(motion.step_m, np.float64)
        turn = 0.0
        if self.settings.paper.follow_turns and np.hypot(*step) > 0 and np.hypot(*self._last_step) > 0:
            turn = math.atan2(step[1], step[0]) - math.atan2(self._last_step[1], self._last_step[0])
        places, start = self._listed()
        n = follow_pairs(
            places[:, 0],
            places[:, 1],
            start,
            self._places,
            theta_start=self._theta_start,
            theta=self._theta + turn,
            distance=distance,
            eps=eps,
            limit=len(self._pairs),
            pairs=self._pairs,
        )
        if n < 0:
            self._places = None
            return -1
        pairs = self._pairs[:n]
        order = np.argsort(pairs[:, 0], kind="stable")
        new, old = pairs[order, 0], pairs[order, 1]
        unique, starts = np.unique(new, return_index=True)
        dx = places[new, 1].astype(np.float64) - self._places[old, 1]
        dy = self._places[old, 0].astype(np.float64) - places[new, 0]
        self._now[:] = 0
        kept = places[unique]
        self._now[kept[:, 0], kept[:, 1]] = 1
        self._places, self._theta = kept, np.arctan2(dy, dx)
        self._theta_start = np.append(starts, n).astype(np.int64)
        return len(kept)

    def _estimate(self, view: View, motion: Motion, searched: int, restarted: bool) -> Estimate:
        s = self.settings.paper
        g = self.ground.gsd_m
        extra = {"searched": float(searched), "restarted": float(restarted)}
        rows, cols = self.ground.building.shape
        if not self._have:
            return nowhere(view, self.ground, "lost", extra)
        by_row, by_col = np.empty(rows, np.int32), np.empty(cols, np.int32)
        most = self.settings.belief.candidates
        sample = np.empty((most, 2), np.int32)
        taken = census(self._before, -(-self._count // most), by_row, by_col, sample)
        y = self.ground.top - (np.arange(rows) + 0.5) * g
        x = self.ground.left + (np.arange(cols) + 0.5) * g
        mean = np.array([by_col @ x, by_row @ y]) / self._count
        var = np.array([by_col @ (x - mean[0]) ** 2, by_row @ (y - mean[1]) ** 2]) / self._count
        # Far candidates along one axis alone already forbid convergence; the distance is checked only if they do not.
        r, c = np.flatnonzero(by_row), np.flatnonzero(by_col)
        half = max(
            abs(y[r[0]] - mean[1]), abs(y[r[-1]] - mean[1]), abs(x[c[0]] - mean[0]), abs(x[c[-1]] - mean[0])
        )
        status: Status = "ambiguous"
        if half <= s.d_max_m:
            i, j = np.nonzero(self._before)
            if float(np.hypot(x[j] - mean[0], y[i] - mean[1]).max()) <= s.d_max_m:
                status = "converged"
        candidates = np.stack([x[sample[:taken, 1]], y[sample[:taken, 0]]], axis=1)
        cov = np.diag(np.maximum(var, s.eps_m**2 / 3.0))
        heading, heading_sigma = self._heading(motion)
        if status == "converged" and self.history is not None:
            spread = np.diag([cov[0, 0], cov[1, 1], math.pi**2])
            self.history.anchors[-1] = Anchor(np.array([*mean, 0.0]), spread)
        return Estimate(
            t_s=view.t_s,
            status=status,
            mean=mean,
            covariance=cov,
            yaw_rad=heading,
            yaw_sigma_rad=heading_sigma,
            mass=1.0 if status == "converged" else 1.0 / self._count,
            candidates=candidates,
            candidate_mass=np.full(len(candidates), 1.0 / self._count),
            candidate_count=self._count,
            extra=extra,
        )

    def _heading(self, motion: Motion) -> tuple[float, float]:
        """Yaw of the body in the map and its spread, from the directions in which the candidates arrived."""
        if self._places is None or not len(self._theta) or motion.step_m is None or motion.yaw_rad is None:
            return math.nan, math.nan
        total = complex(np.exp(1j * self._theta).mean())
        if abs(total) < 1e-6:
            return math.nan, math.nan
        course = math.atan2(float(motion.step_m[1]), float(motion.step_m[0]))
        sigma = math.sqrt(max(-2.0 * math.log(abs(total)), 1e-4))
        return wrap(math.atan2(total.imag, total.real) - course + motion.yaw_rad), sigma

    def smooth(self) -> SmoothedPath:
        """The path through all fixes by odometry; the paper itself has no smoother.

        Raises SettingsError where no history is kept.
        """
        history = kept(self.history)
        # A set's mean says nothing of the yaw: the heading comes from the fixes' places.
        motions = [Motion(m.dt_s, m.step_m, None, m.sigma_m) for m in history.motions]
        return smooth_path(history.times_s, motions, history.anchors, self.settings.odometry)

    def state(self) -> State:
        """All that the frames so far have left, as named arrays; see ``brmgeo.match.state``."""
        paired = self._places is not None
        return {
            **signature("paper", self.ground, self.settings),
            **({} if self.history is None else within("history", self.history.state())),
            "before": np.packbits(self._before),
            "have": np.array(self._have),
            "count": np.array(self._count),
            "paired": np.array(paired),
            "places": np.empty((0, 2), np.int32) if self._places is None else self._places,
            "theta": self._theta if paired else np.empty(0),
            "theta_start": self._theta_start if paired else np.empty(0, np.int64),
            "last_step": np.full(2, np.nan) if self._last_step is None else self._last_step,
        }

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See ``GridMatcher.restore``."""
        check_state(state, self.state())
        start, theta = np.array(state["theta_start"]), np.array(state["theta"])
        if bool(state["paired"]) and (
            len(start) != len(state["places"]) + 1
            or (start[0], start[-1]) != (0, len(theta))
            or (np.diff(start) < 0).any()
        ):
            raise damaged("its pairs do not fit its candidates")
        if self.history is not None:
            self.history.restore(under(state, "history"))
        self._before = np.unpackbits(state["before"], count=self._before.size).reshape(self._before.shape)
        self._have, self._count = bool(state["have"]), int(state["count"])
        self._places = np.array(state["places"]) if state["paired"] else None
        self._theta, self._theta_start = theta, start
        step = np.array(state["last_step"])
        self._last_step = None if np.isnan(step[0]) else step
