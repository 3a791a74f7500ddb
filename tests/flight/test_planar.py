"""Planar odometry: its fits against known movements, and real photographs against their GNSS."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from brmgeo.flight.folder import read_flight
from brmgeo.flight.motion import yaw_of
from brmgeo.flight.planar import consensus, rigid_fit, run_planar

REAL = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def _moved(xy: np.ndarray, angle: float, shift: tuple[float, float]) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(xy @ np.array([[c, s], [-s, c]]) + shift)


def test_rigid_fit_undoes_a_movement() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(0.0, 50.0, (30, 2))
    angle, shift = rigid_fit(a, _moved(a, 2.5, (7.0, -3.0)))
    assert angle == pytest.approx(2.5, abs=1e-12)
    np.testing.assert_allclose(shift, [7.0, -3.0], atol=1e-10)


def test_consensus_finds_the_movement_among_wrong_matches() -> None:
    rng = np.random.default_rng(1)
    a = rng.uniform(-60.0, 60.0, (200, 2))
    b = _moved(a, -0.4, (12.0, 5.0)) + rng.normal(0.0, 0.2, a.shape)
    b[:120] = rng.uniform(-60.0, 60.0, (120, 2))
    inlier = consensus(a, b, 1.0)
    assert inlier[120:].mean() > 0.95
    assert inlier[:120].mean() < 0.05
    angle, shift = rigid_fit(a[inlier], b[inlier])
    assert angle == pytest.approx(-0.4, abs=0.005)
    np.testing.assert_allclose(shift, [12.0, 5.0], atol=0.3)
    assert not consensus(a[:1], b[:1], 1.0).any()


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "flight-sheffield").is_dir(), reason="real data are not here")
def test_real_photographs_drift_less_than_two_percent() -> None:
    flight = read_flight(REAL / "flight-sheffield")
    rows = 40
    frames = flight.frames[:rows]
    grey = (np.asarray(cv2.cvtColor(flight.image(i), cv2.COLOR_RGB2GRAY), np.uint8) for i in range(rows))
    agl, roll, pitch = (np.array([getattr(f, k) for f in frames]) for k in ("agl_m", "roll_rad", "pitch_rad"))
    result = run_planar(flight.times_s[:rows], grey, agl, roll, pitch, flight.camera, flight.mount)
    truth = flight.reference("EPSG:32617")
    assert truth is not None
    xy, seen = result.odometry.xyz_m[:, :2], truth.at(flight.times_s[:rows])
    assert result.odometry.segment is not None
    assert result.odometry.segment[-1] == 0
    start = math.pi / 2 - math.radians(frames[0].true_heading_deg or 0.0)
    error = _moved(xy, start - float(yaw_of(result.odometry.wxyz[0])), tuple(seen[0])) - seen
    length = np.hypot(*np.diff(seen, axis=0).T).sum()
    assert np.hypot(*error.T).max() < 0.02 * length + 1.5  # the receiver's own error
