"""``brmgeo odometry``: a flight folder without odometry gets one, that every reader reads; bad IMUs are named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brmgeo.errors import FlightError, InputError
from brmgeo.flight.folder import read_flight
from brmgeo.flight.motion import motions
from brmgeo.flight.readings import Attitude, Camera, Imu
from brmgeo.synth.flight import FlightSettings, Ground, Imagery, simulate
from pipelines.odometry import checked_imu, make_odometry, summary, thin_flight

CAMERA = Camera.from_fov(240, 180, 43.0)


def _imagery() -> Imagery:
    rng = np.random.default_rng(0)
    grey = sum(
        w * cv2.GaussianBlur(rng.standard_normal((700, 700)).astype(np.float32), (0, 0), s)
        for s, w in ((1.0, 1.0), (3.0, 3.0), (9.0, 8.0))
    )
    assert isinstance(grey, np.ndarray)
    rgb = np.clip(128 + 45 * grey / grey.std(), 0, 255).astype(np.uint8)
    return Imagery(np.repeat(rgb[:, :, None], 3, axis=2), -140.0, 140.0, 0.4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = replace(
        FlightSettings(camera=CAMERA, agl_m=100.0, frame_interval_s=0.25, odometry=None, turn_radius_m=15.0),
        mount=Attitude(),
    )
    path = np.array([[-50.0, -20.0], [20.0, -20.0], [20.0, 10.0]])
    out = tmp_path_factory.mktemp("flight") / "f"
    return simulate(
        out, Ground.from_polygons([]), path, "EPSG:5187", settings, 1, mode="frames", imagery=_imagery()
    )


def test_a_flight_without_odometry_gets_one(folder: Path, tmp_path: Path) -> None:
    facts = make_odometry(folder)
    assert facts["method"] == "vio"
    assert facts["length_m"] == pytest.approx(95.0, rel=0.05)
    assert any("odometry.tum" in line for line in summary(facts))
    flight = read_flight(folder)
    assert flight.odometry is not None
    assert flight.odometry.walk_m2 is not None
    assert json.loads((folder / "odometry.json").read_text())["made_by"] == "brmgeo odometry"
    steps = motions(flight.odometry, flight.times_s)
    assert all(m.step_m is not None and m.sigma_m >= 0.02 for m in steps[1:])
    truth = np.loadtxt(folder / "reference.csv", delimiter=",", skiprows=1)
    end = np.hypot(*(truth[-1, 1:3] - truth[0, 1:3]))
    assert np.hypot(*(flight.odometry.xyz_m[-1] - flight.odometry.xyz_m[0])[:2]) == pytest.approx(
        end, abs=2.5
    )
    # Again: the same names, one section.
    make_odometry(folder)
    assert (folder / "flight.toml").read_text().count("[odometry]") == 1

    thin = thin_flight(folder, tmp_path / "thin", 5.0)
    few = read_flight(thin)
    assert [f.t_s for f in few.frames] == [0.0, 5.0, 10.0, 15.0]
    assert few.odometry is not None
    with pytest.raises(InputError, match="new or empty"):
        thin_flight(folder, thin, 5.0)

    # What belongs to other poses is refused.
    lines = (thin / "odometry.covariance.csv").read_text().splitlines()
    (thin / "odometry.covariance.csv").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(FlightError, match="do not belong"):
        read_flight(thin)


def test_planar_needs_no_imu(folder: Path, tmp_path: Path) -> None:
    copy = thin_flight(folder, tmp_path / "planar", 1.0)
    toml = (copy / "flight.toml").read_text().split("[odometry]")[0]
    (copy / "flight.toml").write_text(toml)
    for name in ("imu.csv", "odometry.tum", "odometry.covariance.csv", "odometry.json"):
        (copy / name).unlink(missing_ok=True)
    with pytest.raises(FlightError, match=r"imu\.csv is missing"):
        make_odometry(copy, "vio")
    facts = make_odometry(copy)
    assert facts["method"] == "planar"
    assert facts["segments"] == 1
    assert facts["length_m"] == pytest.approx(95.0, rel=0.1)


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
