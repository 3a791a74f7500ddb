"""A flight's own odometry: made from its frames where they overlap, refused in words where its readings cannot be right."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brmgeo.errors import FlightError
from brmgeo.flight import own
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.motion import motions
from brmgeo.flight.own import Embedded, checked_imu, estimate, odometry_name, own_odometry
from brmgeo.flight.readings import Imu, Odometry


def test_a_flight_without_odometry_has_one_of_its_own(filmed: Path, tmp_path: Path) -> None:
    bare = Path(shutil.copytree(filmed, tmp_path / "bare"))
    flight = read_flight(bare)
    before = sorted(p.name for p in bare.iterdir())
    got = own_odometry(flight, 5.0)
    assert got.says.startswith("made from the frames: embedded visual-inertial odometry, ")
    assert f"every 5 s one of its {len(flight.frames)} frames" in got.says
    assert [f.t_s for f in got.flight.frames] == [0.0, 5.0, 10.0, 15.0]
    assert got.flight.odometry is not None
    assert len(got.flight.odometry.t_s) == len(flight.frames)
    steps = motions(got.flight.odometry, got.flight.times_s)
    assert all(m.step_m is not None and 15.0 < np.hypot(*m.step_m) < 30.0 for m in steps[1:])
    assert odometry_name(got.flight, "simulated") == got.says
    assert sorted(p.name for p in bare.iterdir()) == before
    assert own_odometry(got.flight, 5.0).flight is got.flight
    assert odometry_name(flight, "simulated") == "none"

    # Readings in g: said, and the flight goes on without.
    rows = np.loadtxt(bare / "imu.csv", delimiter=",", skiprows=1)
    rows[:, 4:] /= 9.80665
    np.savetxt(bare / "imu.csv", rows, "%.6f", ",", header="t_s,gx,gy,gz,ax,ay,az", comments="")
    wrong = own_odometry(read_flight(bare), 5.0)
    assert "are in g" in wrong.says
    assert wrong.flight.odometry is None
    assert len(wrong.flight.frames) == len(flight.frames)


def test_odometry_of_frames_far_apart(filmed: Path, tmp_path: Path) -> None:
    few = Path(shutil.copytree(filmed, tmp_path / "few"))
    lines = (few / "frames.csv").read_text().splitlines()
    (few / "frames.csv").write_text("\n".join([lines[0], *lines[1::10]]) + "\n")
    got = own_odometry(read_flight(few), 5.0)
    assert got.says.startswith("made from the frames: embedded planar odometry, ")
    assert len(got.flight.frames) == 8
    assert got.flight.odometry is not None
    rng = np.random.default_rng(5)
    for path in (few / "frames").iterdir():
        noise = rng.integers(0, 255, (180, 240, 3), dtype=np.uint8)
        cv2.imwrite(str(path), noise)
    alone = own_odometry(read_flight(few), 5.0)
    assert "do not overlap" in alone.says
    assert alone.flight.odometry is None


def test_the_filter_needs_an_imu_and_says_what_else_would_do(filmed: Path, tmp_path: Path) -> None:
    bare = Path(shutil.copytree(filmed, tmp_path / "bare"))
    (bare / "imu.csv").unlink()
    with pytest.raises(
        FlightError, match=r"imu\.csv is missing: add it, or choose the method planar$"
    ) as refused:
        estimate(read_flight(bare), "vio")
    assert refused.value.needs == "method"


def test_what_the_filter_found_is_said(filmed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def made(flight: Flight, method: str = "auto") -> Embedded:
        n, t = len(flight.frames), flight.times_s
        facts = {"length_m": 30.0, "seconds": 3.0, "blind_frames": 0, "poses": n, "segments": 1}
        facts |= {"warnings": ["the camera's times differ from the IMU's by +80 ms"]}
        track = Odometry(t, np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), "embedded", None, 0.01 * t)
        return Embedded(track, 0 * t, np.ones(n, np.int64), np.zeros(n, np.bool_), facts)

    monkeypatch.setattr(own, "estimate", made)
    assert "differ from the IMU's by +80 ms" in own_odometry(read_flight(filmed), 5.0).says


def _still(n: int = 200) -> Imu:
    accel: NDArray[np.float64] = np.tile([0.1, 0.0, 9.8], (n, 1))
    return Imu(np.arange(n) * 0.05, np.zeros((n, 3)), accel)


def test_bad_imus_are_named() -> None:
    path, times = Path("imu.csv"), np.array([0.5, 9.0])
    imu = _still()
    assert checked_imu(imu, path, times) is imu
    spin = np.zeros((200, 3))
    spin[::20] = 30.0
    later = Imu(imu.t_s + 100.0, imu.gyro_rad_s, imu.accel_m_s2)
    hole = np.where(imu.t_s > 4.0, imu.t_s + 2.0, imu.t_s)
    cases = [
        (replace(imu, accel_m_s2=imu.accel_m_s2 / 9.8), "in g"),
        (replace(imu, accel_m_s2=imu.accel_m_s2 * 3.28), "check the unit"),
        (replace(imu, accel_m_s2=imu.accel_m_s2 * [1, -1, -1]), "turn the signs"),
        (replace(imu, gyro_rad_s=spin), "degrees"),
        (later, "one clock"),
        (replace(imu, t_s=hole), "no reading for"),
    ]
    for bad, words in cases:
        with pytest.raises(FlightError, match=words):
            checked_imu(bad, path, times)
    with pytest.raises(FlightError, match=r"imu\.csv: 1 reading"):
        checked_imu(Imu(imu.t_s[:1], imu.gyro_rad_s[:1], imu.accel_m_s2[:1]), path, times)
