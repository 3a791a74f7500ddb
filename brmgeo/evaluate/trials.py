"""Trials: one simulated flight over built maps, located by every method over the very same views, and scored."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import MissingInputError
from brmgeo.evaluate.conditions import CONDITIONS, long_legs
from brmgeo.evaluate.scores import score
from brmgeo.evaluate.sift import sift_fixes
from brmgeo.evaluate.table import FlightRow
from brmgeo.flight.camera import slant_gsd_m
from brmgeo.flight.readings import Attitude, FloatArray
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.geo.grid import Bounds
from brmgeo.locate.flights import Located, locate
from brmgeo.locate.localizer import Localizer
from brmgeo.locate.maps import Maps, match_settings, read_maps
from brmgeo.locate.masks import ROOF_M, above_roofs_m, network_mask
from brmgeo.match import GroundMap
from brmgeo.pictures import photographed
from brmgeo.region import FlightSettings
from brmgeo.synth.flight import (
    Course,
    MaskErrors,
    OdometryErrors,
    RaisedFootprints,
    SimulationSettings,
    Simulator,
    fly,
    simulate_views,
)
from brmgeo.synth.mission import (
    FineImagery,
    flight_path,
    imagery_along,
    inset,
    path_name,
    read_ground,
    simulator_settings,
)

Side = Literal["east", "west", "north", "south"]
#: Kinds of masks that flights are compared with.
MASKS = ("true", "network", "degraded", "simulated")
#: Pixel accuracy of the paper's network.
PAPER_ACCURACY = 0.916
#: Views reach over the cut of a hidden half: a flight keeps so far away from it, metres.
_REACH_M = 150.0
#: Assumed of a fix by SIFT, which states no covariance of its own, metres.
_SIFT_SIGMA_M = 2.0


@dataclass(frozen=True, slots=True)
class MaskComparison:
    """The same flights with several kinds of masks.

    Attributes:
        kinds: ``true`` (what a perfect network sees in the frame), ``network`` (on rendered frames), ``degraded`` (the true
            ones at the pixel accuracy of the paper's network), ``simulated`` (the simulator's own errors).
        weights, looks: of the network; None for those that ship, and for as many as they ask for.
    """

    kinds: tuple[str, ...]
    weights: Path | None = None
    looks: int | None = None


@dataclass(frozen=True, slots=True)
class FrameSource:
    """What the frames of simulated flights are drawn from.

    Attributes:
        native: imagery finer than the maps'.
        imagery: the picture in a raster, such as another day's; without both, the maps' own imagery.
        season: of the other day, for reports.
    """

    native: FineImagery | None = None
    imagery: Path | None = None
    season: str | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """One simulated flight of an evaluation; small, so that it travels to a worker.

    Attributes:
        maps_dir, own: the maps, and the region's camera and flight settings.
        seed: of the flight; odd ones have odometry that is too long, even ones too short.
        methods: matchers, all over the same views.
        path: rectangle, lawnmower, random, or a GeoJSON file.
        scale_bias: of the odometry, for odd seeds.
        hide: the half of the map that is hidden and flown over.
        masks: kinds of masks to fly with; None for the simulator's alone, without frames.
        sift: also match frames to the imagery.
        drawn: what frames are drawn from.
        condition: what else is as on real flights; None for nothing.
    """

    maps_dir: Path
    own: FlightSettings
    seed: int
    methods: tuple[str, ...]
    path: str = "rectangle"
    scale_bias: float = 0.05
    hide: Side | None = None
    masks: MaskComparison | None = None
    sift: bool = False
    drawn: FrameSource = FrameSource()
    condition: str | None = None


def fly_trial(trial: Trial) -> list[FlightRow]:
    """Simulates one flight and runs every method over the very same views; one row a method, and kind of masks.

    Raises MissingInputError where the maps lack what the flight needs, InputError where its path does not fit.
    """
    maps = read_maps(trial.maps_dir)
    if maps.footprints is None:
        raise MissingInputError(f"{maps.folder / 'footprints.gpkg'} is not there; build the maps again")
    ground, bounds, known = read_ground(maps.footprints), maps.bounds, maps.ground
    if trial.hide is not None:
        known, bounds = hide_half(maps, trial.hide)
    sign = 1.0 if trial.seed % 2 else -1.0
    settings = simulator_settings(trial.own, odometry=OdometryErrors(scale_bias=sign * trial.scale_bias))
    condition = None if trial.condition is None else CONDITIONS[trial.condition]
    if condition is not None:
        settings = condition.settings(settings, trial.seed)
        known = condition.ground(known, trial.seed)
    if condition is not None and condition.long_legs:
        course, route = "legs", long_legs(bounds, settings, trial.seed)
    else:
        course = path_name(trial.path)
        route = flight_path(trial.path, ground, trial.seed, bounds, maps.crs)
    # Frames show roofs where their height puts them, and so do the masks that are compared with the network's.
    relief = trial.masks is not None
    flown = simulate_views(ground, route, settings, trial.seed, maps.ground.gsd_m, relief=relief)
    truth = flown.reference.at(np.array([v.t_s for v in flown.views]))
    scene = _TrialFlight(trial, maps, ground, route, settings)
    seen = {"": flown.views}
    if trial.masks is not None:
        seen = {kind: scene.views(kind, trial.masks, flown.views) for kind in trial.masks.kinds}
    flight = f"{course}-{trial.seed}"
    under = f", {trial.condition}" if trial.condition else ""
    rows = []
    for method in trial.methods:
        for kind, views in seen.items():
            if condition is not None and condition.tilt is not None:
                located = scene.located(
                    replace(maps, ground=known), flown.motions, method, condition.tilt_sigma_rad
                )
            else:
                located = locate(known, views, flown.motions, method, match_settings(trial.own))
            rows.append(
                FlightRow(
                    flight=flight,
                    seed=trial.seed,
                    method=f"{method}, {kind} masks" if kind else method + under,
                    scores=score(located.estimates, located.smoothed.xy, flown.motions, truth),
                    seconds_per_frame=float(located.seconds.mean()),
                    first_frame_s=float(located.seconds[0]),
                )
            )
    if trial.sift:
        estimates, seconds = scene.sift_estimates()
        # SIFT states no covariance of its own, so what lies within its sigma says nothing.
        scores = replace(score(estimates, None, flown.motions, truth), within_sigma=None)
        rows.append(FlightRow(flight, trial.seed, "SIFT", scores, float(np.mean(seconds)), seconds[0]))
    return rows


@dataclass(frozen=True)
class _TrialFlight:
    """One flight of a trial: what it flies over, along and with."""

    trial: Trial
    maps: Maps
    ground: RaisedFootprints
    route: FloatArray
    settings: SimulationSettings

    @cached_property
    def course(self) -> Course:
        """The course, the same for all kinds of masks."""
        return fly(self.route, self.settings, self.trial.seed)

    def located(self, maps: Maps, steps: Sequence[Motion], method: str, sigma_rad: float) -> Located:
        """The flight by a localizer that knows the told mount to ``sigma_rad``, and looks for it."""
        own = self.trial.own
        here = Localizer(
            maps,
            self.settings.camera,
            self.settings.known_mount,
            method=method,
            settings=match_settings(own),
            history=True,
            mount_sigma_rad=sigma_rad,
        )
        simulator = self._simulator(self.settings)
        estimates, seconds = [], []
        for i, motion in enumerate(steps):
            mask = simulator.mask(i, relief=False)
            attitude, agl_m = Attitude(*self._attitude_rad(i)), float(self.course.measured_agl_m[i])
            estimates.append(here.take(float(self.course.frame_times_s[i]), mask, attitude, agl_m, motion))
            assert here.last is not None
            seconds.append(here.last.seconds)
        return Located(estimates, here.smooth(), np.array(seconds), list(steps), here.found_mount)

    def views(self, kind: str, masks: MaskComparison, simulated: list[View]) -> list[View]:
        """The flight's views by one kind of mask: the same course, the same readings, only the masks differ."""
        if kind == "simulated":
            return simulated
        images: Iterable[NDArray[Any]]
        if kind == "network":
            images = (
                network_mask(picture, self._gsd_m(i), masks.weights, masks.looks)
                for i, picture in enumerate(self._pictures())
            )
        else:
            errors = MaskErrors.none() if kind == "true" else MaskErrors.degraded(PAPER_ACCURACY)
            simulator = self._simulator(replace(self.settings, masks=errors))
            images = (simulator.mask(i, relief=True) for i in range(len(self.course.frame_index)))
        # All of them show roofs where the camera sees them, so all are laid onto the same plane.
        return [
            self._measured_view(i, image, ROOF_M, self.maps.ground.gsd_m) for i, image in enumerate(images)
        ]

    def sift_estimates(self) -> tuple[list[Estimate], list[float]]:
        """What SIFT alone says of each frame, and its seconds: a fix where RANSAC accepts one, else nothing."""
        assert self.maps.imagery is not None
        left, bottom, right, top = self.maps.bounds
        middle = np.array([(left + right) / 2, (bottom + top) / 2])
        out: list[Estimate] = []
        seconds: list[float] = []
        found = sift_fixes(
            self.maps.imagery,
            self._pictures(),
            lambda i, grey, gsd_m: self._measured_view(i, grey, 0.0, gsd_m),
        )
        for i, (fix, took) in enumerate(found):
            seconds.append(took)
            # Assumed, for the estimate's form: a fix to two metres; without one, anywhere.
            sigma_m = (
                _SIFT_SIGMA_M if fix is not None else math.hypot(right - left, top - bottom) / math.sqrt(12.0)
            )
            out.append(
                Estimate(
                    t_s=float(self.course.frame_times_s[i]),
                    status="lost" if fix is None else "converged",
                    mean=middle if fix is None else fix.xy,
                    covariance=np.eye(2) * sigma_m**2,
                    yaw_rad=math.nan,
                    yaw_sigma_rad=math.nan,
                    mass=0.0 if fix is None else 1.0,
                    candidates=np.empty((0, 2)),
                    candidate_mass=np.empty(0),
                    candidate_count=0,
                )
            )
        return out, seconds

    def _simulator(self, settings: SimulationSettings) -> Simulator:
        return Simulator(self.ground, settings, self.course, self.trial.seed)

    def _pictures(self) -> Iterator[NDArray[np.uint8]]:
        """The frames, (h, w, 3) RGB, as a camera would have stored them."""
        drawn, simulator = self.trial.drawn, self._simulator(self.settings)
        file = drawn.imagery or self.maps.imagery or self.maps.folder / "imagery.tif"
        imagery = imagery_along(
            self.route, self.settings, file, drawn.native if drawn.imagery is None else None
        )
        for i in range(len(self.course.frame_index)):
            yield photographed(simulator.picture(i, imagery), self.settings.jpeg_quality)

    def _attitude_rad(self, i: int) -> tuple[float, float]:
        """Roll and pitch as the aircraft measured them at a frame."""
        course = self.course
        return math.radians(course.measured_roll_deg[i]), math.radians(course.measured_pitch_deg[i])

    def _gsd_m(self, i: int) -> float:
        """Metres per pixel at the middle of a frame, by what the aircraft measured."""
        agl_m = float(self.course.measured_agl_m[i])
        return slant_gsd_m(self.settings.camera, self.settings.known_mount, *self._attitude_rad(i), agl_m)

    def _measured_view(self, i: int, image: NDArray[Any], roof_m: float, gsd_m: float) -> View:
        """A frame's picture or mask, levelled by what the aircraft measured, laid onto the plane at ``roof_m``."""
        return make_view(
            image,
            self.settings.camera,
            self.settings.known_mount,
            *self._attitude_rad(i),
            above_roofs_m(float(self.course.measured_agl_m[i]), roof_m),
            gsd_m,
            t_s=float(self.course.frame_times_s[i]),
        )


def hide_half(maps: Maps, side: Side) -> tuple[GroundMap, Bounds]:
    """The map without one half (cut away, unknown), and bounds within that half, for a flight that sees nothing else."""
    building = maps.ground.building
    rows, cols = building.shape
    left, bottom, right, top = maps.bounds
    x, y = left + cols // 2 * maps.ground.gsd_m, top - rows // 2 * maps.ground.gsd_m
    parts: dict[Side, tuple[NDArray[np.uint8], float, float, Bounds]] = {
        "east": (building[:, : cols // 2], left, top, (x, bottom, right, top)),
        "west": (building[:, cols // 2 :], x, top, (left, bottom, x, top)),
        "north": (building[rows // 2 :], left, y, (left, y, right, top)),
        "south": (building[: rows // 2], left, top, (left, bottom, right, y)),
    }
    kept, kept_left, kept_top, hidden = parts[side]
    # Views reach over the cut: a strip of the hidden half must not lie within any of them.
    cut = GroundMap(np.ascontiguousarray(kept), kept_left, kept_top, maps.ground.gsd_m)
    return cut, inset(hidden, _REACH_M)
