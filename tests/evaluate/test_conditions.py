"""Conditions of real flights: what each changes, from the seed alone, and that nothing else does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brmgeo.evaluate.conditions import CONDITIONS, long_legs
from brmgeo.flight.motion import motions
from brmgeo.match import GroundMap
from brmgeo.synth.flight import SimulationSettings, fly, odometry_of

PLAIN = SimulationSettings()


@pytest.mark.parametrize("seed", range(4))
def test_long_legs_are_few_frames_with_odometry_that_says_its_error(seed: int) -> None:
    settings = CONDITIONS["long-legs"].settings(PLAIN, seed)
    course = fly(long_legs((0.0, 0.0, 2500.0, 2000.0), settings, seed), settings, seed)
    assert 11 <= len(course.frame_index) <= 12
    assert settings.odometry is not None
    track = odometry_of(course, settings.odometry, seed)
    steps = motions(track, course.frame_times_s)[1:]
    assert all(step.step_m is not None and 2.0 <= step.sigma_m <= 20.0 for step in steps)
    # Nothing is said unless it is asked for, and saying it changes no pose.
    silent = odometry_of(course, replace(settings.odometry, states_noise=False), seed)
    assert silent.walk_m2 is None
    assert np.array_equal(silent.xyz_m, track.xyz_m)


@pytest.mark.parametrize(("name", "apart_deg"), [("tilted", (10.0, 18.0)), ("tilted-near", (0.0, 25.0))])
def test_a_tilt_is_flown_and_not_told(name: str, apart_deg: tuple[float, float]) -> None:
    for seed in range(20):
        settings = CONDITIONS[name].settings(PLAIN, seed)
        flown, told = (m.body_from_camera()[:, 2] for m in (settings.mount, settings.known_mount))
        assert 9.9 <= math.degrees(math.acos(-flown[2])) <= 18.1
        assert apart_deg[0] - 0.2 <= math.degrees(math.acos(flown @ told)) <= apart_deg[1] + 0.2
        # The camera looks ahead rather than back.
        assert flown[0] > -0.1


def test_a_condition_takes_a_share_of_the_maps_buildings_whole() -> None:
    building = np.zeros((200, 200), np.uint8)
    building[::10, ::10] = building[1::10, ::10] = 1
    building[150:] = 255
    before = GroundMap(building, 0.0, 0.0, 0.5)
    old = CONDITIONS["old-map"].ground(before, 3)
    changed = old.building != building
    assert ((building == 1) & ~changed).any()
    assert set(building[changed]) == {1}
    assert set(old.building[changed]) == {0}
    assert changed.sum() / (building == 1).sum() == pytest.approx(1 / 3, abs=0.1)
    assert np.array_equal(changed[:150:10], changed[1:150:10])
    assert CONDITIONS["tilted"].ground(before, 3) is before


def test_all_together_draws_what_each_draws_alone() -> None:
    together = CONDITIONS["photos"].settings(PLAIN, 5)
    legs, tilted, poor = (CONDITIONS[n].settings(PLAIN, 5) for n in ("long-legs", "tilted", "poor-masks"))
    assert 0.4 <= poor.masks.missed <= 0.6
    assert together == replace(legs, mount=tilted.mount, told_mount=tilted.told_mount, masks=poor.masks)
