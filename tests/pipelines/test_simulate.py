"""`brmgeo simulate`: the same bytes from the same seed, what is refused, and the flight that localize makes for itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from small_flights import CRS, LEFT, TOP, Said, bytes_of

from brmgeo.errors import SettingsError
from brmgeo.flight.folder import read_flight
from brmgeo.region import Region
from pipelines import simulate as job


def test_simulate_gives_the_same_bytes_and_counts_seeds(
    maps: Path, waypoints: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    words = ("simulate", "--maps", maps, "--path", waypoints)
    for name in "ab":
        assert say(*words, "--mode", "both", "--seed", 3, "--out", tmp_path / name).code == 0
    both = bytes_of(tmp_path / "a")
    assert both == bytes_of(tmp_path / "b")
    assert {
        "flight.toml",
        "frames.csv",
        "odometry.tum",
        "imu.csv",
        "altimeter.csv",
        "reference.csv",
    } <= both.keys()
    assert any(n.startswith("frames/") for n in both)
    assert any(n.startswith("masks/") for n in both)

    said = say(*words, "--mode", "masks", "--seed", 3, "--count", 2, "--out", tmp_path / "many")
    assert said.code == 0
    assert sorted(p.name for p in (tmp_path / "many").iterdir()) == ["simulated-3", "simulated-4"]
    assert say(*words, "--mode", "masks", "--seed", 4, "--out", tmp_path / "four").code == 0
    assert bytes_of(tmp_path / "four") == bytes_of(tmp_path / "many/simulated-4")
    assert bytes_of(tmp_path / "four") != bytes_of(tmp_path / "many/simulated-3")
    assert say(*words, "--no-odometry", "--mode", "masks", "--out", tmp_path / "none").code == 0
    assert not (tmp_path / "none/odometry.tum").exists()
    assert read_flight(tmp_path / "none").odometry is None


def test_simulations_that_cannot_be_are_refused(maps: Path, tmp_path: Path, say: Callable[..., Said]) -> None:
    simulate = ("simulate", "--maps", maps, "--out", tmp_path / "s")
    assert "rectangel" in say(*simulate, "--path", "rectangel").line
    assert "GeoJSON" in say(*simulate, "--path", maps / "ratio.tif").line
    assert "--name" in say(*simulate, "--count", 2, "--name", "n").line
    assert "generated REGION" in say(*simulate, "--season", "winter").line
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in ("buildings.tif", "ratio.tif"):
        shutil.copy(maps / name, empty)
    assert "footprints.gpkg" in say("simulate", "--maps", empty, "--out", tmp_path / "s").line
    assert not (tmp_path / "s").exists()


def test_only_a_simulated_flight_is_replaced(whole: Path, tmp_path: Path) -> None:
    job.require_simulated(tmp_path / "new")
    flight = tmp_path / "flight"
    shutil.copytree(whole, flight)
    job.require_simulated(flight)
    (flight / "notes.txt").write_text("of the day")
    with pytest.raises(SettingsError, match=r"other files than a simulated flight \(notes\.txt\)") as caught:
        job.require_simulated(flight)
    assert caught.value.needs == "out"


def test_the_flight_that_localize_makes_has_a_name_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, maps: Path
) -> None:
    made: list[tuple[Path, str]] = []

    def simulate(what: job.Simulation, seed: int, out: Path, name: str) -> Path:
        made.append((out, name))
        out.mkdir(parents=True)
        return out

    monkeypatch.setattr(job, "simulate_flight", simulate)
    monkeypatch.setattr(job, "native_imagery", lambda *_: None)
    region = Region(name="r", crs=CRS, bounds=(LEFT, TOP - 500.0, LEFT + 600.0, TOP))
    assert job.default_flight(region, maps, tmp_path, 1) == made[0][0]
    # brmgeo simulate calls its own flights simulated-SEED.
    assert [name for _, name in made] == ["default-1"] == [made[0][0].name]
    job.default_flight(region, maps, tmp_path, 1)
    assert len(made) == 1
