"""A matcher's state: another process goes on from it, bit for bit; without a history it does not grow with the flight."""

from __future__ import annotations

import io
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from match_scene import Flight, blank_view, fly, path, run, town
from numpy.typing import NDArray

from brmgeo.errors import InputError, SettingsError
from brmgeo.flight.values import Estimate, Motion
from brmgeo.match import (
    METHODS,
    BeliefSettings,
    GroundMap,
    MatchSettings,
    PaperSettings,
    RatioSettings,
    make_matcher,
)

SETTINGS = MatchSettings(
    belief=BeliefSettings(headings=72, cell_m=6.0, converged_mass=0.9),
    ratio=RatioSettings(least_fit=0.3),
    paper=PaperSettings(radii=6, e1=0.1, eps_m=6.0, d_max_m=20.0),
)
SCENE = town(42, 700.0, 400)
GROUND = SCENE.ground()
# Unknown ground within reach, so that areas are summed and not taken for whole discs.
GROUND.building[:80, :120] = 255


@pytest.fixture(scope="module")
def flight() -> Flight:
    """A search, a fix, two blank views, a step without odometry and another view."""
    f = fly(
        SCENE, *path((1180.0, 5240.0), [(0.3, 8), (1.7, 6)], step_m=22.0), missed=0.03, blank=range(11, 13)
    )
    return replace(f, motions=[replace(m, step_m=None) if i == 13 else m for i, m in enumerate(f.motions)])


def saved(state: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The state through a file, as another process would read it."""
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as loaded:
        return dict(loaded)


def same(a: Estimate, b: Estimate) -> bool:
    """Whether all of two estimates is equal, bit for bit."""
    names = ("t_s", "mean", "covariance", "yaw_rad", "yaw_sigma_rad", "mass", "candidates", "candidate_mass")
    return (
        (a.status, a.candidate_count) == (b.status, b.candidate_count)
        and list(a.extra) == list(b.extra)
        and all(np.array(a.extra[k]).tobytes() == np.array(b.extra[k]).tobytes() for k in a.extra)
        and all(np.asarray(getattr(a, n)).tobytes() == np.asarray(getattr(b, n)).tobytes() for n in names)
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_restored_matcher_goes_on_bit_for_bit(method: str, flight: Flight) -> None:
    n = len(flight.views)
    whole = make_matcher(method, GROUND, SETTINGS, history=True)
    estimates, states = [], []
    for view, motion in zip(flight.views, flight.motions, strict=True):
        states.append(whole.state())
        estimates.append(whole.step(view, motion))
    statuses = [e.status for e in estimates]
    first = statuses.index("converged")
    assert len(set(statuses)) > 1
    smoothed = whole.smooth()
    # Before any view, in the middle of the search or after it, after the fix, over the blank views and after the gap.
    for cut in sorted({0, 3, first + 1, 12, 14}):
        after = make_matcher(method, GROUND, SETTINGS, history=True)
        after.restore(saved(states[cut]))
        for i in range(cut, n):
            assert same(after.step(flight.views[i], flight.motions[i]), estimates[i]), (cut, i)
        path_after = after.smooth()
        for name in ("t_s", "xy", "yaw_rad", "sigma_m"):
            assert getattr(smoothed, name).tobytes() == getattr(path_after, name).tobytes()


@pytest.mark.parametrize("method", METHODS)
def test_a_state_holds_arrays_only_and_is_its_own(method: str, flight: Flight) -> None:
    matcher = make_matcher(method, GROUND, SETTINGS)
    run(matcher, replace(flight, views=flight.views[:3]))
    state = matcher.state()
    assert all(isinstance(v, np.ndarray) and v.dtype.kind in "biufU" for v in state.values())
    assert not any(k.startswith("history") for k in state)
    kept = {k: v.copy() for k, v in state.items()}
    for i in (3, 4):
        matcher.step(flight.views[i], flight.motions[i])
    assert all(v.tobytes() == kept[k].tobytes() for k, v in state.items())


@pytest.mark.parametrize(
    ("method", "slack", "per_view"),
    [("mask", 500_000, 20_000), ("ratio", 500_000, 20_000), ("paper", 3_000, 60)],
)
def test_without_a_history_nothing_grows_with_the_flight(
    method: str, slack: int, per_view: int, flight: Flight
) -> None:
    small = GroundMap(np.ascontiguousarray(GROUND.building[::2, ::2]), GROUND.left, GROUND.top, 2.0)
    belief = BeliefSettings(headings=8, cell_m=20.0, max_blocks=200)
    settings = replace(SETTINGS, belief=belief, paper=replace(SETTINGS.paper, pair_work=0))

    def growth(history: bool) -> tuple[int, int]:
        """Bytes that 120 views add to the state, and to all that the matcher holds."""
        matcher = make_matcher(method, small, settings, history=history)
        state, held = [], []
        for i in range(150):
            step = 20.0 * np.array([math.cos(i / 5), math.sin(i / 5)]) if i else None
            view = flight.views[i % 4] if i % 3 else blank_view()
            matcher.step(replace(view, t_s=5.0 * i), Motion(5.0, step, i / 5, 0.1))
            if i in (29, 149):
                state.append(sum(v.nbytes for v in matcher.state().values()))
                held.append(len(pickle.dumps(matcher)))
        return state[1] - state[0], held[1] - held[0]

    # The belief waxes and wanes within its settings' bound.
    assert max(growth(False)) < slack
    assert min(growth(True)) > 120 * per_view > slack
    with pytest.raises(SettingsError, match="history=True"):
        make_matcher(method, small, settings).smooth()


@pytest.mark.parametrize("method", METHODS)
def test_a_state_of_another_matcher_is_refused(method: str, flight: Flight) -> None:
    matcher = make_matcher(method, GROUND, SETTINGS)
    run(matcher, replace(flight, views=flight.views[:2]))
    state = matcher.state()
    other = "mask" if method != "mask" else "ratio"
    coarse = replace(SETTINGS, belief=replace(SETTINGS.belief, cell_m=7.0))
    beside = GroundMap(GROUND.building, GROUND.left + 5.0, GROUND.top, GROUND.gsd_m)
    for fresh, words in (
        (make_matcher(other, GROUND, SETTINGS), f"another method: {method} there, {other} here"),
        (make_matcher(method, GROUND, coarse), r"another settings: belief.cell_m is 6.0 there, 7.0 here"),
        (make_matcher(method, beside, SETTINGS), "another ground"),
        (make_matcher(method, GROUND, SETTINGS, history=True), "history"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            fresh.restore(state)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("method", "name", "value"),
    [
        ("mask", "belief.blocks", np.zeros((3, 8, 8), np.float32)),
        ("mask", "belief.keys", np.full((3, 3), 10**6, np.int32)),
        ("mask", "belief.keys", None),
        ("mask", "frame", np.array("sideways")),
        ("mask", "scorer.hits", np.zeros(3)),
        ("ratio", "belief.rest", np.zeros((), np.float32)),
        ("paper", "theta_start", np.array([0, 10**6])),
        ("paper", "before", np.zeros(3, np.uint8)),
    ],
)
def test_a_damaged_state_is_refused(method: str, name: str, value: Any, flight: Flight) -> None:
    matcher = make_matcher(method, GROUND, SETTINGS)
    run(matcher, replace(flight, views=flight.views[:5]))
    state = matcher.state()
    assert name in state
    del state[name]
    if value is not None:
        state[name] = value
    with pytest.raises(InputError, match=f"damaged|{name}"):
        make_matcher(method, GROUND, SETTINGS).restore(state)
