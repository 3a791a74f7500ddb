"""A mount that nobody told: found by what the camera sees, and no place is surer than it until then."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brmgeo.errors import InputError, SettingsError
from brmgeo.flight.motion import motions
from brmgeo.flight.readings import Attitude
from brmgeo.flight.values import Estimate
from brmgeo.locate.localizer import Localizer
from brmgeo.locate.maps import Maps, read_maps
from brmgeo.region import FlightSettings
from brmgeo.synth.flight import Simulator, fly, odometry_of, place, rectangle
from brmgeo.synth.mission import read_ground, simulator_settings

TRUE = Attitude(math.radians(-4.0), math.radians(-13.0))
FRAMES = 10
Feed = Callable[[Localizer, int, int], list[Estimate]]


@pytest.fixture(scope="module")
def built(maps: Path) -> Maps:
    return read_maps(maps)


@pytest.fixture(scope="module")
def tilted(built: Maps) -> tuple[Feed, np.ndarray]:
    """Feeds a localizer with frames of a camera that looks 13 degrees ahead; and where the frames were taken."""
    assert built.footprints is not None
    ground = read_ground(built.footprints)
    settings = simulator_settings(FlightSettings(), mount=TRUE, agl_m=100.0)
    course = fly(place(rectangle((0.0, 0.0), 0.0, perimeter_m=500.0), ground, 3, built.bounds), settings, 3)
    simulator = Simulator(ground, settings, course, 3)
    assert settings.odometry is not None
    steps = motions(odometry_of(course, settings.odometry, 3), course.frame_times_s)
    masks = [simulator.mask(i, False) for i in range(FRAMES)]

    def feed(here: Localizer, first: int, last: int) -> list[Estimate]:
        return [
            here.take(
                float(course.frame_times_s[i]),
                masks[i],
                Attitude(
                    math.radians(course.measured_roll_deg[i]), math.radians(course.measured_pitch_deg[i])
                ),
                float(course.measured_agl_m[i]),
                steps[i],
            )
            for i in range(first, last)
        ]

    return feed, course.xyz_m[course.frame_index[:FRAMES], :2]


def told_nothing(built: Maps, **more: float) -> Localizer:
    camera = simulator_settings(FlightSettings()).camera
    return Localizer(built, camera, Attitude(), **{"mount_sigma_rad": math.radians(10.0)} | more)  # type: ignore[arg-type]


def test_a_tilt_that_nobody_told_is_found_and_the_flight_located_with_it(
    built: Maps, tilted: tuple[Feed, np.ndarray]
) -> None:
    feed, truth = tilted
    here = told_nothing(built)
    estimates = feed(here, 0, FRAMES)
    assert here.found_mount is not None
    mount, sigma_rad = here.found_mount
    assert here.mount == mount
    # Frames agree to a degree; what they get wrong together they cannot know.
    assert 3.0 <= math.degrees(sigma_rad) <= math.hypot(3.0, 1.0)
    assert math.degrees(mount.roll_rad - TRUE.roll_rad) == pytest.approx(0.0, abs=1.5)
    assert math.degrees(mount.pitch_rad - TRUE.pitch_rad) == pytest.approx(0.0, abs=1.5)
    last = estimates[-1]
    assert last.position is not None
    error = float(np.hypot(*(last.mean - truth[-1])))
    assert error < 4.0
    assert error < 2.0 * math.sqrt(float(np.trace(last.covariance)) / 2.0)
    # Before that nothing was said that the tilt could make wrong.
    for estimate, xy in zip(estimates, truth):
        if estimate.position is not None:
            sigma = math.sqrt(float(np.trace(estimate.covariance)) / 2.0)
            assert np.hypot(*(estimate.mean - xy)) < 3.0 * sigma
    with pytest.raises(InputError, match="times must increase"):
        feed(here, 0, 1)
    # Read as straight down, and believed to be, the same flight is off by its tilt and does not know it.
    sure = told_nothing(built, mount_sigma_rad=0.0)
    wrong = [e for e in feed(sure, 0, 6) if e.position is not None]
    assert all(np.hypot(*(e.mean - truth[i])) > 10.0 for i, e in enumerate(wrong[:1]))


def test_a_localizer_that_still_looks_for_its_mount_is_saved_whole(
    built: Maps, tilted: tuple[Feed, np.ndarray], tmp_path: Path
) -> None:
    feed, _ = tilted
    whole = told_nothing(built)
    wanted = feed(whole, 0, FRAMES)
    for cut in (5,):
        here = told_nothing(built)
        feed(here, 0, cut)
        here.save(tmp_path / "state")
        again = Localizer.load(tmp_path / "state", built)
        assert (again.found_mount is None) == (here.found_mount is None)
        found = feed(again, cut, FRAMES)
        for one, other in zip(wanted[cut:], found):
            assert np.array_equal(one.mean, other.mean)
            assert np.array_equal(one.covariance, other.covariance)
            assert one.status == other.status
        assert again.found_mount == whole.found_mount


def test_what_is_known_exactly_is_not_looked_for(built: Maps) -> None:
    camera = simulator_settings(FlightSettings()).camera
    here = Localizer(built, camera, TRUE, mount_sigma_rad=math.radians(3.5))
    assert here._finder is None
    assert replace(TRUE) == here.mount
    with pytest.raises(SettingsError, match="mount known to 20 degrees: give 0 to 11"):
        Localizer(built, camera, TRUE, mount_sigma_rad=math.radians(20.0))
