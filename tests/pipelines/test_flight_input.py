"""What the commands make of awkward flights, logs and paths: each is taken right or told in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.readings import Odometry
from pipelines.flights import motions_of

TOML = """name = "small"
[camera]
width = 32
height = 24
fov_deg = 43.0
[height]
source = "frames"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A flight folder of four frames, without odometry."""
    cv2 = pytest.importorskip("cv2")
    root = tmp_path / "flight"
    (root / "frames").mkdir(parents=True)
    for i in range(4):
        cv2.imwrite(str(root / "frames" / f"f{i}.png"), np.full((24, 32, 3), 40 * i, np.uint8))
    rows = [f"{i},f{i}.png,100" for i in range(4)]
    (root / "frames.csv").write_text("\n".join(["t_s,file,agl_m", *rows]) + "\n")
    (root / "flight.toml").write_text(TOML)
    return root


def track(speed_m_s: float) -> Odometry:
    """A straight track of 3 s at ten poses a second."""
    t = np.arange(31) / 10.0
    xyz = np.stack([speed_m_s * t, 0 * t, 0 * t], axis=-1)
    return Odometry(t, xyz, np.tile([1.0, 0.0, 0.0, 0.0], (31, 1)), "straight")


def test_a_fast_aircraft_is_no_reset_where_its_speed_is_allowed(folder: Path) -> None:
    flight = replace(read_flight(folder), odometry=track(90.0))
    assert [m.step_m is None for m in motions_of(flight)] == [True] * 4
    steps = motions_of(flight, None, 100.0)
    assert [m.step_m is None for m in steps] == [True, False, False, False]
    slow = replace(cast(Flight, flight), odometry=track(30.0))
    # A low bound is of movement without odometry: the track itself is believed up to what aircraft fly.
    assert all(m.step_m is not None for m in motions_of(slow, None, 8.0)[1:])
