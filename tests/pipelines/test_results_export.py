"""brmgeo export writes the very points of the results, in the CRS and format that are asked for."""

from __future__ import annotations

import csv
import itertools
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer

from brmgeo.errors import BrmgeoError, CrsError, InputError, MissingInputError, SettingsError
from brmgeo.export.candidates import write_candidates
from brmgeo.export.trajectory import TimedPath, write_trajectory
from brmgeo.files import SCRATCH
from brmgeo.flight.values import Estimate
from pipelines.cli import cli, run
from pipelines.results import export_results

CRS = "EPSG:5187"
XY = np.array([[195_100.25 + 10 * i, 445_900.5 + 3 * i] for i in range(6)])


@pytest.fixture
def results(tmp_path: Path) -> Path:
    out = tmp_path / "results"
    out.mkdir()
    estimates = [
        Estimate(
            t_s=5.0 * i,
            status="converged" if i > 1 else "ambiguous",
            mean=xy,
            covariance=np.eye(2),
            yaw_rad=0.5,
            yaw_sigma_rad=0.1,
            mass=1.0,
            candidates=xy[None],
            candidate_mass=np.ones(1),
            candidate_count=1,
        )
        for i, xy in enumerate(XY)
    ]
    smoothed = TimedPath(np.arange(6) * 5.0, XY + 0.5, np.full(6, np.nan), np.full(6, 1.5))
    write_trajectory(out, estimates, [f"{i}.jpg" for i in range(6)], CRS, smoothed=smoothed)
    write_candidates(out, [(e.t_s, e.candidates, e.candidate_mass, e.status) for e in estimates], CRS)
    return out


def test_points_are_those_of_the_results_in_every_format(results: Path, tmp_path: Path) -> None:
    lonlat = np.column_stack(Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(*XY.T))
    out = tmp_path / "a.csv"
    assert "smoothed, 6 points" in export_results(results, "smoothed", out, None)
    rows = list(csv.DictReader(out.read_text().splitlines()))
    np.testing.assert_allclose([[float(r["x"]), float(r["y"])] for r in rows], XY + 0.5, atol=1e-4)
    assert [float(r["sigma_m"]) for r in rows] == [1.5] * 6
    assert {r["yaw_deg"] for r in rows} == {""}

    out = tmp_path / "b.geojson"
    export_results(results, "online", out, None)
    features = json.loads(out.read_text())["features"]
    np.testing.assert_allclose([f["geometry"]["coordinates"] for f in features], lonlat[2:], atol=2e-7)
    assert [f["properties"]["file"] for f in features] == ["2.jpg", "3.jpg", "4.jpg", "5.jpg"]

    out = tmp_path / "c.gpkg"
    for crs, places in ((None, XY), ("EPSG:4326", lonlat)):
        export_results(results, "candidates", out, crs)
        frame = pyogrio.read_dataframe(out, layer="candidates")
        assert frame.crs.to_epsg() == (5187 if crs is None else 4326)
        np.testing.assert_allclose(
            np.column_stack([frame.geometry.x, frame.geometry.y]), places, atol=0.02 if crs is None else 2e-7
        )
        assert frame["frame"].tolist() == list(range(6))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "b.geojson", "c.gpkg", "results"]


@pytest.mark.parametrize(
    ("what", "name", "crs", "error", "words"),
    [
        ("reference", "a.csv", None, MissingInputError, "no reference path; there are online, smoothed"),
        ("online", "a.dwg", None, SettingsError, ".geojson"),
        ("online", "none/a.csv", None, SettingsError, "no folder"),
        ("online", "a.geojson", "EPSG:5187", SettingsError, "leave --crs out"),
        ("online", "a.csv", "EPSG:999999", CrsError, "999999"),
        ("online", "a.csv", "EPSG:5773", CrsError, "EGM96 height, which has no x, y"),
        ("online", "a.csv", "EPSG:4978", CrsError, "which has no x, y"),
        ("online", "a.csv", "+proj=ortho +lat_0=-37 +lon_0=-53", CrsError, "no place in"),
        ("online", "results/trajectory.gpkg", None, SettingsError, "choose another name"),
    ],
)
def test_what_cannot_be_written_is_refused(
    results: Path, tmp_path: Path, what: str, name: str, crs: str | None, error: type[BrmgeoError], words: str
) -> None:
    before = (results / "trajectory.gpkg").read_bytes()
    with pytest.raises(error, match=re.escape(words)):
        export_results(results, what, tmp_path / name, crs)
    assert (results / "trajectory.gpkg").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["results"]


@pytest.mark.parametrize(
    ("what", "damage"),
    [*itertools.product(["candidates", "online"], ["cut", "noise", "no points"]), ("candidates", "no UTF-8")],
)
def test_damaged_results_are_one_line(results: Path, tmp_path: Path, what: str, damage: str) -> None:
    path = results / ("candidates.geojson" if what == "candidates" else "trajectory.gpkg")
    whole = path.read_bytes()
    if damage == "no points":
        frame = pyogrio.read_dataframe(path, layer=what)
        frame.geometry = [shapely.box(*p.bounds[:2], 200.0, 60.0) for p in frame.geometry]
        path.unlink()
        pyogrio.write_dataframe(frame, path, layer=what)
    else:
        size = len(whole) // 2
        harm = {
            "cut": b"",
            "noise": bytes(range(256)) * 8,
            "no UTF-8": whole[size:].replace(b"converged", b"conv\xffrged"),
        }
        path.write_bytes(whole[:size] + harm[damage])
    with pytest.raises(InputError, match=re.escape(f"{path}: ")) as told:
        export_results(results, what, tmp_path / "a.csv", None)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize("free", [0, 1, 3, 12])
@pytest.mark.parametrize("name", ["a.gpkg", "a.geojson", "a.csv"])
def test_a_full_disk_under_an_export_is_told_with_its_place(
    results: Path, small_disk: Path, name: str, free: int
) -> None:
    (small_disk / "fill").write_bytes(bytes((1 << 20) - 4096 * free))
    if free and name != "a.gpkg":
        export_results(results, "candidates", small_disk / name, None)
        return
    with pytest.raises(OSError, match="No space left") as told:
        export_results(results, "candidates", small_disk / name, None)
    assert told.value.filename == str(small_disk / name)
    assert [p.name for p in small_disk.iterdir()] == ["fill"]


def test_what_a_killed_export_left_goes_with_a_later_one(results: Path, tmp_path: Path) -> None:
    left = [tmp_path / f"{SCRATCH}0123456789ab.gpkg{end}" for end in ("", "-journal")]
    for path in left:
        path.write_text("half")
        os.utime(path, (1e9, 1e9))
    export_results(results, "online", tmp_path / "a.csv", None)
    assert not any(path.exists() for path in left)


def test_the_command_refuses_a_folder_that_is_no_result(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    call: Callable[..., int] = lambda *words: run(lambda: cli([str(w) for w in words], standalone_mode=False))  # noqa: E731
    assert call("export", tmp_path, "--out", tmp_path / "a.csv") == 2
    assert "brmgeo localize wrote" in capfd.readouterr().err
    assert call("export", results, "--out", tmp_path / "a.csv") == 0
    assert "online, 4 points" in capfd.readouterr().out


def _text(words: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(words)


def _features(geometry: str, properties: str = "{}") -> Callable[[Path], object]:
    feature = f'{{"type":"Feature","geometry":{geometry},"properties":{properties}}}'
    return _text(f'{{"type":"FeatureCollection","features":[{feature}]}}')


POINT = '{"type":"Point","coordinates":[127,37]}'


@pytest.mark.parametrize(
    ("what", "damage", "words"),
    [
        ("candidates", _text(""), "candidates.geojson"),
        ("candidates", _text('{"type":"FeatureCollection","features":['), "candidates.geojson"),
        ("candidates", _text('{"type":"FeatureCollection","features":["a"]}'), "1 of 1 features are none"),
        ("candidates", _features("null"), "run localize again"),
        ("candidates", _features('{"type":"LineString","coordinates":[[127,37],[127.1,37]]}'), "no points"),
        ("candidates", _features(POINT), "epsg"),
        ("candidates", _features(POINT, '{"epsg":"x"}'), "epsg"),
        ("candidates", _features(POINT, '{"epsg":0.5}'), "epsg"),
        ("candidates", _features(POINT, '{"epsg":-7}'), "EPSG:-7"),
        ("online", lambda path: path.write_bytes(path.read_bytes()[:4000]), "trajectory.gpkg"),
        ("online", lambda path: path.write_bytes(b"\0" * 5000), "trajectory.gpkg"),
        (
            "online",
            lambda path: path.write_bytes(path.read_bytes()[:8192] + b"\7" * 90_000),
            "trajectory.gpkg",
        ),
    ],
)
def test_damaged_results_are_told_and_nothing_is_written(
    results: Path, tmp_path: Path, what: str, damage: Callable[[Path], object], words: str
) -> None:
    damage(results / ("candidates.geojson" if what == "candidates" else "trajectory.gpkg"))
    with pytest.raises(BrmgeoError, match=re.escape(words)) as told:
        export_results(results, what, tmp_path / "a.csv", None)
    assert isinstance(told.value, InputError | CrsError)
    assert "\n" not in str(told.value)
    assert [p.name for p in tmp_path.iterdir()] == ["results"]


@pytest.mark.parametrize("name", ["a.csv", "a.geojson", "a.gpkg"])
def test_a_full_disk_is_one_line_with_the_place(
    results: Path, small_disk: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (small_disk / "ballast").write_bytes(bytes(1 << 20))
    words = ["export", str(results), "--out", str(small_disk / name)]
    assert run(lambda: cli(words, standalone_mode=False)) == 2
    told = capfd.readouterr().err
    assert f"{small_disk / name} cannot be read or written: the disk is full" in told
    assert told.count("\n") == 1
    assert [p.name for p in small_disk.iterdir()] == ["ballast"]


def test_no_cell_is_a_formula_and_numbers_stay_numbers(results: Path, tmp_path: Path) -> None:
    names = ["=1+1.jpg", "+a.jpg", "-2+3.jpg", "@SUM(1).jpg", "'=a.jpg", "a.jpg"]
    places = [-195_100.25 - i for i in range(6)]
    frame = pyogrio.read_dataframe(results / "candidates.geojson")
    frame["file"], frame["number"] = names, places
    for name in ("candidates.geojson", "candidates.gpkg"):
        (results / name).unlink(missing_ok=True)
    pyogrio.write_dataframe(frame, results / "candidates.gpkg")
    export_results(results, "candidates", tmp_path / "a.csv", None)
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [r["file"] for r in rows] == [*(f"'{n}" for n in names[:5]), "a.jpg"]
    assert [float(r["number"]) for r in rows] == places
