"""After the flight nothing is told that was not measured: no yaw of a dummy, no place without a heading, no cell twice."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brmgeo.flight.values import Motion
from brmgeo.match import BeliefSettings, OdometrySettings
from brmgeo.match.belief import Belief
from brmgeo.match.search import search
from brmgeo.match.smooth import Anchor, smooth_path

N = 12
STEP = np.array([25.0, 0.0])
TIMES = [5.0 * i for i in range(N)]
NO_YAW = np.diag([200.0, 200.0, math.pi**2])


def steps(yaw_rad: float | None = None, compass: float | None = None) -> list[Motion]:
    return [Motion(5.0 if i else 0.0, STEP if i else None, yaw_rad, 0.05, compass) for i in range(N)]


def at(i: int, yaw: float, covariance: NDArray[np.float64]) -> Anchor:
    # The odometry's frame is turned by a right angle: what goes east in it goes north on the map.
    return Anchor(np.array([1000.0, 5000.0 + 25.0 * i, yaw]), covariance)


def test_an_anchor_without_a_yaw_gives_the_smoothed_path_none() -> None:
    anchors = [at(i, 0.0, NO_YAW) if i in (2, 8, 11) else None for i in range(N)]
    path = smooth_path(TIMES, steps(), anchors, OdometrySettings())
    assert np.isfinite(path.xy).all()
    assert np.isnan(path.yaw_rad).all()
    measured = [at(i, 1.1, np.diag([1.0, 1.0, 1e-4])) if i in (2, 8) else None for i in range(N)]
    path = smooth_path(TIMES, steps(), measured, OdometrySettings())
    assert np.flatnonzero(np.isfinite(path.yaw_rad)).tolist() == [2, 8]
    np.testing.assert_allclose(path.yaw_rad[[2, 8]], 1.1)


def test_one_place_without_a_heading_is_one_place_and_no_path() -> None:
    anchors = [at(5, 0.0, NO_YAW) if i == 5 else None for i in range(N)]
    path = smooth_path(TIMES, steps(), anchors, OdometrySettings())
    assert np.flatnonzero(np.isfinite(path.xy).all(axis=1)).tolist() == [5]
    assert (np.isfinite(path.sigma_m) == np.isfinite(path.xy[:, 0])).all()
    np.testing.assert_allclose(path.xy[5], [1000.0, 5125.0], atol=1.0)
    # A heading from the body's yaw makes it a path again.
    pose = [at(5, math.pi / 2, np.diag([1.0, 1.0, 1e-4])) if i == 5 else None for i in range(N)]
    path = smooth_path(TIMES, steps(yaw_rad=0.0), pose, OdometrySettings())
    np.testing.assert_allclose(path.xy, [[1000.0, 5000.0 + 25.0 * i] for i in range(N)], atol=0.5)
    np.testing.assert_allclose(path.yaw_rad, math.pi / 2, atol=0.01)


def test_views_are_registered_about_the_body_s_yaw_never_about_the_odometry_frame_s() -> None:
    asked: list[NDArray[np.float64]] = []

    def register(_: int, pose: NDArray[np.float64], covariance: NDArray[np.float64]) -> Anchor | None:
        asked.append(np.array([*pose, covariance[2, 2]]))
        return None

    anchors = [at(i, 0.0, NO_YAW) if i in (2, 8) else None for i in range(N)]
    smooth_path(TIMES, steps(), anchors, OdometrySettings(), register)
    assert not asked
    smooth_path(TIMES, steps(compass=0.4), anchors, OdometrySettings(), register)
    assert len(asked) == N - 2
    np.testing.assert_allclose(np.array(asked)[:, 2], 0.4)
    np.testing.assert_allclose(np.array(asked)[:, 3], OdometrySettings().compass_sigma_rad ** 2)


def test_a_cell_that_stands_out_under_many_headings_is_one_candidate() -> None:
    belief = Belief((70, 85), BeliefSettings(headings=8, keep=1e-6))
    llr = np.random.default_rng(1).normal(-4, 1, (8, 70, 85)).astype(np.float32)
    llr[:, 30, 40] = 13
    llr[2:5, 33, 60] = 13
    search(belief, lambda h: llr[h].copy(), -30.0, 25.0)
    centres, mass, count = belief.heaviest(2000)
    full = np.zeros((8, 80, 96), np.float32)
    for (h, i, j), block in zip(belief.keys, belief.blocks, strict=True):
        full[h, 16 * i : 16 * i + 16, 16 * j : 16 * j + 16] = block
    assert count == int((full > 1.0 / belief.cells).any(axis=0).sum()) == len(centres) == len(mass)
