"""``brmgeo odometry``: a flight folder without odometry gets one, that every reader reads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from small_maps import BOUNDS, SmallRegion, brmgeo

from brmgeo.errors import FlightError, InputError
from brmgeo.flight.folder import read_flight
from brmgeo.flight.motion import motions
from pipelines.odometry import make_odometry, summary, thin_flight


@pytest.fixture(scope="module")
def folder(filmed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(filmed, tmp_path_factory.mktemp("flight") / "f"))


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
    assert not list(folder.glob("*.edited.*"))
    # A track that somebody changed is kept.
    made = (folder / "odometry.tum").read_text()
    (folder / "odometry.tum").write_text(f"# mine\n{made}")
    make_odometry(folder)
    assert (folder / "odometry.tum").read_text() == made
    assert (folder / "odometry.edited.tum").read_text() == f"# mine\n{made}"
    (folder / "odometry.edited.tum").unlink()
    # What a run leaves that is killed before the covariance of its track is there.
    beside = folder / "odometry.covariance.csv"
    kept = beside.read_text()
    beside.write_text(f"{kept}\n")
    with pytest.raises(FlightError, match=r"covariance\.csv: is of another run than odometry\.tum"):
        read_flight(folder)
    beside.write_text(kept)

    (folder / "imu.csv").chmod(0o666)
    thin = thin_flight(folder, tmp_path / "thin", 5.0)
    few = read_flight(thin)
    assert (thin / "imu.csv").stat().st_mode == (thin / "frames.csv").stat().st_mode, "as the umask asks"
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


def test_from_simulated_frames_to_a_report_with_no_odometry_given(
    built: SmallRegion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = tmp_path / "maps"
    shutil.copytree(built.out, maps)
    # The small region's imagery is too smooth for points to be followed.
    with rasterio.open(maps / "imagery.tif") as old:
        profile = {"driver": "GTiff", "width": old.width, "height": old.height, "count": 3, "dtype": "uint8"}
        profile |= {"crs": old.crs, "transform": old.transform, "photometric": "RGB"}
    rng = np.random.default_rng(2)
    coarse = rng.integers(30, 220, (profile["height"] // 4 + 1, profile["width"] // 4 + 1), dtype=np.uint8)
    grey = cv2.resize(coarse, (profile["width"], profile["height"]), interpolation=cv2.INTER_CUBIC)
    (maps / "imagery.tif").unlink()
    with rasterio.open(maps / "imagery.tif", "w", **profile) as new:
        new.write(np.repeat(grey[None], 3, axis=0))
    x, y = (BOUNDS[0] + BOUNDS[2]) / 2, (BOUNDS[1] + BOUNDS[3]) / 2 - 20.0
    line = tmp_path / "line.geojson"
    lonlat = Transformer.from_crs("EPSG:5187", "EPSG:4326", always_xy=True)
    places = [lonlat.transform(*p) for p in ((x - 40.0, y), (x + 10.0, y), (x + 10.0, y - 20.0))]
    line.write_text(json.dumps({"type": "LineString", "coordinates": places}))
    words = (
        "simulate",
        "--maps",
        maps,
        "--path",
        line,
        "--no-odometry",
        "--interval",
        0.5,
        "--name",
        "dense",
    )
    said = brmgeo(capsys, *words, "--out", tmp_path / "dense")
    assert said.status == 0, said.err
    flight = read_flight(tmp_path / "dense")
    assert np.allclose(np.diff(flight.times_s), 0.5)
    assert flight.odometry is None

    words = ("localize", "--maps", maps, "--flight", tmp_path / "dense", "--method", "paper")
    said = brmgeo(capsys, *words, "--out", tmp_path / "own")
    assert said.status == 0, said.err
    assert "dense odometry: made from the frames: embedded visual-inertial odometry" in said.err
    rows = (tmp_path / "own" / "fixes.csv").read_text().splitlines()[1:]
    assert len(rows) == int(flight.times_s[-1] / 5.0) + 1
    made = json.loads((tmp_path / "own" / "metrics.json").read_text())
    assert made["odometry"].startswith("made from the frames")
    assert made["odometry_rmse_m"] < 2.0
    assert made["odometry"] in (tmp_path / "own" / "report.html").read_text()
    assert made["settings"]["localize"]["odometry"] == "auto"

    said = brmgeo(capsys, *words, "--odometry", "given", "--out", tmp_path / "none")
    assert said.status == 0, said.err
    assert "made from the frames" not in said.err
    none = json.loads((tmp_path / "none" / "metrics.json").read_text())
    assert none["odometry"] == "none"
    assert none["settings"]["localize"]["odometry"] == "given"
