"""The flight job through the command line: results by the letter of docs/FLIGHT.md, and everything that must be refused."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from pyproj import Transformer
from small_flights import COLS, CRS, REAL, ROWS, Said, bytes_of, edit

from brmgeo import files
from brmgeo.errors import SettingsError
from brmgeo.flight.folder import read_flight
from brmgeo.flight.motion import motions
from brmgeo.locate.flights import locate, locate_flight, view_at
from brmgeo.locate.maps import match_settings, read_maps
from brmgeo.locate.masks import FrameMasks
from brmgeo.match import METHODS, GroundMap, MatchSettings, make_matcher
from brmgeo.match.rates import RateLearner
from brmgeo.match.register import Registrar
from brmgeo.region import FlightSettings
from pipelines import flight_results
from pipelines.localize import localize

RESULTS = {
    "candidates.geojson", "candidates.qml", "trajectory.geojson", "trajectory.gpkg", "trajectory.tum", "trajectory.json",
    "fixes.csv", "metrics.json", "report.html",
}  # fmt: skip


@pytest.fixture
def flight(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "flight"))


def rewrite_rows(path: Path, change: Callable[[list[list[str]]], list[list[str]]]) -> None:
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("".join(",".join(row) + "\n" for row in [rows[0], *change(rows[1:])]))


# ---------------------------------------------------------------- what localize writes


@pytest.mark.parametrize("method", METHODS)
def test_result_files_agree_with_each_other(whole: Path, results: Path, method: str) -> None:
    out = results / method
    assert {p.name for p in out.iterdir()} == RESULTS | {"simulated-1.qgz", files.WRITTEN}
    assert not [p for p in results.iterdir() if p.name.startswith(".")]

    with open(out / "fixes.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    head = [
        "t_s",
        "file",
        "status",
        "x",
        "y",
        "lon",
        "lat",
        "sigma_m",
        "yaw_deg",
        "heading_deg",
        "candidates",
        "mass",
    ]
    assert list(rows[0]) == head
    frames = read_flight(whole).frames
    assert [r["file"] for r in rows] == [f.file for f in frames]
    assert {r["status"] for r in rows} <= {"converged", "ambiguous", "lost"}
    for row in rows:
        assert (row["x"] != "") == (row["y"] != "") == (row["lon"] != "") == (row["status"] == "converged")
    fixed = [r for r in rows if r["status"] == "converged"]
    to_xy = Transformer.from_crs("EPSG:4326", CRS, always_xy=True)
    for row in fixed:
        assert (
            math.dist(
                to_xy.transform(float(row["lon"]), float(row["lat"])), (float(row["x"]), float(row["y"]))
            )
            < 0.02
        )

    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["share_converged"] == pytest.approx(len(fixed) / len(rows), abs=1e-4)
    assert metrics["method"] == method
    assert metrics["data"] == "simulated"
    assert metrics["seconds_per_frame"] > 0
    reference = read_flight(whole).reference(CRS)
    assert reference is not None
    truth = {f.file: reference.at(np.array([f.t_s]))[0] for f in frames}
    errors = np.array([math.dist((float(r["x"]), float(r["y"])), truth[r["file"]]) for r in fixed])
    if fixed:
        assert metrics["first_fix_s"] == pytest.approx(float(fixed[0]["t_s"]) - frames[0].t_s, abs=1e-3)
        assert metrics["rmse_after_first_fix_m"] == pytest.approx(math.sqrt((errors**2).mean()), abs=0.01)
    else:
        assert metrics["first_fix_s"] is metrics["rmse_after_first_fix_m"] is None
    assert metrics["false_fixes"] == int((errors > 50).sum()) == 0
    if method == "mask":
        assert fixed, "the mask matcher finds a flight over a town of 260 houses"
        assert metrics["rmse_after_first_fix_m"] < 5

    drawn = json.loads((out / "candidates.geojson").read_text())
    assert "crs" not in drawn
    for name in ("start", "end", "t_s", "mass", "status", "x", "y", "epsg"):
        assert all(name in f["properties"] for f in drawn["features"][:50])
    per_frame = np.bincount([f["properties"]["frame"] for f in drawn["features"]], minlength=len(rows))
    counts = np.array([int(r["candidates"]) for r in rows])
    assert (per_frame <= counts).all()
    assert ((per_frame > 0) == (counts > 0)).all()

    track = json.loads((out / "trajectory.geojson").read_text())
    points = [f for f in track["features"] if f["geometry"]["type"] == "Point"]
    shown = [p["geometry"]["coordinates"][:2] for p in points if p["properties"].get("status") == "converged"]
    assert bool(shown) == (method == "mask" or bool(fixed))
    for row, lonlat in zip(fixed, shown, strict=True):
        assert lonlat == pytest.approx([float(row["lon"]), float(row["lat"])], abs=2e-7)
    assert len(pyogrio.list_layers(out / "trajectory.gpkg")) >= 2
    tum = [line.split() for line in (out / "trajectory.tum").read_text().splitlines()]
    assert all(len(line) == 8 for line in tum)
    assert bool(tum) == (metrics["rmse_whole_m"] is not None)
    facts = json.loads((out / "trajectory.json").read_text())
    assert facts["epsg"] == 5187
    height = {f"{f.t_s:.6f}": f.agl_m for f in frames}
    assert [float(line[3]) for line in tum] == pytest.approx([height[line[0]] for line in tum], abs=1e-3)
    assert metrics["share_smoothed"] == pytest.approx(len(tum) / len(rows), abs=1e-4)
    if tum:
        assert (facts["height_reference"], facts["rows_without_height"]) == ("ground", [])
    if method == "mask":
        online = {f"{float(r['t_s']):.6f}": math.radians(float(r["yaw_deg"])) for r in fixed}
        yaws = {line[0]: 2 * math.atan2(float(line[6]), float(line[7])) for line in tum}
        assert len(online) > 3
        assert all(abs(math.remainder(yaws[t] - yaw, 2 * math.pi)) < 0.1 for t, yaw in online.items())
    if method == "paper":
        # Its sets of places say nothing of how the aircraft was turned.
        assert facts["rows_without_yaw"] == list(range(len(tum)))
    for name in ("metrics.json", "report.html"):
        assert str(out.parent.parent) not in (out / name).read_text(), "no path of this machine leaves it"
    report = (out / "report.html").read_text()
    assert "http://" not in report.replace("http://www.w3.org", "")
    assert "https://" not in report


def test_same_inputs_same_bytes(maps: Path, whole: Path, results: Path, tmp_path: Path) -> None:
    shutil.copytree(results / "mask", tmp_path / "a")
    localize(maps, read_flight(whole), "mask", tmp_path / "b")
    a, b = bytes_of(tmp_path / "a"), bytes_of(tmp_path / "b")
    assert a.keys() == b.keys()
    timed = {"metrics.json", "report.html", files.WRITTEN}
    # GeoPackage notes the time of its last change in two places of its own tables.
    differ = {n for n in a if a[n] != b[n]} - timed
    assert differ <= {"trajectory.gpkg"}, differ
    for name in differ:
        for layer, _ in pyogrio.list_layers(tmp_path / "a" / name):
            ours, theirs = (pyogrio.read_dataframe(tmp_path / k / name, layer=layer) for k in "ab")
            if layer != "layer_styles":
                assert ours.equals(theirs), layer
    ma, mb = json.loads(a["metrics.json"]), json.loads(b["metrics.json"])
    assert {k for k in ma if ma[k] != mb[k]} <= {"seconds_per_frame", "first_frame_s"}


@pytest.mark.parametrize("method", METHODS)
def test_live_matcher_and_folder_run_say_the_same(
    maps: Path, whole: Path, results: Path, method: str
) -> None:
    rows = list(csv.DictReader((results / method / "fixes.csv").read_text().splitlines()))
    ground = read_maps(maps).ground
    flight = read_flight(whole)
    matcher = make_matcher(method, ground, match_settings(FlightSettings()))
    steps = motions(flight.odometry, flight.times_s)
    for i, (motion, row) in enumerate(zip(steps, rows, strict=True)):
        estimate = matcher.step(view_at(flight, ground.gsd_m, i), motion)
        assert estimate.status == row["status"]
        assert estimate.candidate_count == int(row["candidates"])
        if estimate.position is not None:
            assert estimate.position == pytest.approx(
                (float(row["x"]), float(row["y"]), float(row["sigma_m"])), abs=1e-3
            )


def test_maps_need_only_one_file_and_reference_is_not_needed(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(maps / "buildings.tif", one)
    (flight / "reference.csv").unlink()
    text = (flight / "flight.toml").read_text()
    (flight / "flight.toml").write_text(text[: text.index("[reference]")])
    out = tmp_path / "out"
    said = say("localize", "--maps", one, "--flight", flight, "--out", out)
    assert said.code == 0, said.err
    assert {p.name for p in out.iterdir()} == (RESULTS - {"metrics.json"}) | {
        "simulated-1.qgz",
        files.WRITTEN,
    }
    (one / "buildings.tif").unlink()
    said = say("localize", "--maps", one, "--flight", flight, "--out", tmp_path / "none")
    assert "buildings.tif is not there" in said.line
    assert not (tmp_path / "none").exists()


def test_a_file_name_with_commas_shifts_no_column(maps: Path, flight: Path, tmp_path: Path) -> None:
    rewrite_rows(flight / "frames.csv", lambda rows: rows[:2])
    (flight / "masks" / "frame_00001.png").rename(flight / "masks" / "a, b, c.png")
    edit(flight / "frames.csv", "frame_00001.jpg", '"a, b, c.jpg"')
    localize(maps, read_flight(flight), "paper", tmp_path / "out")
    with open(tmp_path / "out/fixes.csv", newline="") as handle:
        rows = list(csv.reader(handle))
    assert [row[1] for row in rows] == ["file", "frame_00000.jpg", "a, b, c.jpg"]
    report = (tmp_path / "out/report.html").read_text()
    cells = "".join(f"<td>{cell}</td>" for cell in rows[2])
    assert cells in report


@pytest.mark.parametrize("method", METHODS)
def test_metrics_hold_all_settings_that_a_method_reads(
    maps: Path, whole: Path, results: Path, method: str
) -> None:
    read: set[str] = set()

    class Watched(MatchSettings):
        def __getattribute__(self, name: str) -> object:
            read.add(name)
            return super().__getattribute__(name)

    flight, own = read_flight(whole), match_settings(FlightSettings())
    groups = {f.name: getattr(own, f.name) for f in fields(own)}
    locate_flight(read_maps(maps), flight, FrameMasks(flight, ""), method=method, settings=Watched(**groups))
    written = json.loads((results / method / "metrics.json").read_text())["settings"]
    assert written.pop("localize") == {
        "compass": False,
        "roof_m": 0.0,
        "network": None,
        "odometry": "auto",
        "interval_s": FlightSettings().interval_s,
        "mount": dict.fromkeys(("roll_deg", "pitch_deg", "yaw_deg", "sigma_deg"), 0.0),
    }
    assert set(written) == read & set(groups)
    for name, values in written.items():
        assert values == asdict(groups[name]), "nothing is rounded: a result can be repeated"


def test_reference_is_not_read_while_estimating(
    maps: Path, flight: Path, results: Path, tmp_path: Path
) -> None:
    shifted = [line.split(",") for line in (flight / "reference.csv").read_text().splitlines()]
    text = "\n".join(",".join([t, x if x == "x" else str(float(x) + 70), y]) for t, x, y in shifted)
    (flight / "reference.csv").write_text(text + "\n")
    localize(maps, read_flight(flight), "mask", tmp_path / "b")
    assert (results / "mask/fixes.csv").read_bytes() == (tmp_path / "b/fixes.csv").read_bytes()
    metrics = json.loads((tmp_path / "b/metrics.json").read_text())
    assert metrics["false_fixes"] > 0
    assert metrics["rmse_after_first_fix_m"] == pytest.approx(70, abs=5)


def without_odometry(flight: Path) -> None:
    text = (flight / "flight.toml").read_text()
    (flight / "flight.toml").write_text(text[: text.index("[odometry]")] + text[text.index("[height]") :])
    (flight / "odometry.tum").unlink()


def statuses(ground: GroundMap, flight_dir: Path, method: str) -> set[str]:
    flight = read_flight(flight_dir)
    views = [view_at(flight, ground.gsd_m, i) for i in range(len(flight.frames))]
    settings = match_settings(FlightSettings())
    located = locate(ground, views, motions(flight.odometry, flight.times_s), method, settings)
    return {e.status for e in located.estimates}


def test_without_odometry_nothing_false_is_said(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    without_odometry(flight)
    words = (
        "--compass",
        "--max-speed",
        "8",
        "--odometry-sigma",
        "20,0.05",
        "--compass-sigma",
        "5",
        "--tilt-sigma",
        "3",
    )
    said = say("localize", "--maps", maps, "--flight", flight, "--out", tmp_path / "out", *words)
    assert said.code == 0, said.err
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["odometry"] == "none"
    assert metrics["odometry_rmse_m"] is None
    assert metrics["false_fixes"] == 0
    used = metrics["settings"]["odometry"]
    assert used["max_speed_m_s"] == 8
    assert (used["step_sigma_m"], used["step_sigma_share"]) == (20, 0.05)
    assert used["compass_sigma_rad"] == pytest.approx(math.radians(5))
    assert used["attitude_sigma_rad"] == 0.0035
    assert 0.0 < metrics["settings"]["localize"]["mount"]["sigma_deg"] <= 3.0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--compass-sigma", "5"), "--compass-sigma is of the compass: give --compass too"),
        (("--tilt-sigma", "3", "--method", "paper"), "--tilt-sigma is nothing that --method paper weighs"),
        (("--odometry-sigma", "1,2,3"), "--odometry-sigma has 3 numbers"),
        (("--odometry-sigma", "-1"), "step_sigma_m = -1.0 is outside [0, 100]"),
    ],
)
def test_what_is_said_of_sensors_and_changes_nothing_is_refused(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said], words: tuple[str, ...], told: str
) -> None:
    said = say("localize", "--maps", maps, "--flight", flight, "--out", tmp_path / "out", *words)
    assert said.code == 2
    assert told in said.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", METHODS)
def test_a_flight_over_another_town_has_no_fix(maps: Path, whole: Path, method: str) -> None:
    ground = read_maps(maps).ground
    # Mirrored, the town is as built up as before but nowhere alike.
    other = replace(ground, building=np.ascontiguousarray(ground.building[:, ::-1]))
    assert "converged" not in statuses(other, whole, method)


def test_a_single_frame_is_a_flight(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    rewrite_rows(flight / "frames.csv", lambda rows: rows[:1])
    said = say("localize", "--maps", maps, "--flight", flight, "--out", tmp_path / "out")
    assert said.code == 0, said.err
    assert len((tmp_path / "out/fixes.csv").read_text().splitlines()) == 2
    ground = read_maps(maps).ground
    for method in METHODS:
        assert len(statuses(ground, flight, method)) == 1


# ---------------------------------------------------------------- what is refused


def swap_times(rows: list[list[str]]) -> list[list[str]]:
    rows[2][0], rows[3][0] = rows[3][0], rows[2][0]
    return rows


def cell(row: int, column: int, value: str) -> Callable[[list[list[str]]], list[list[str]]]:
    def change(rows: list[list[str]]) -> list[list[str]]:
        rows[row][column] = value
        return rows

    return change


def other_mask(flight: Path) -> None:
    import cv2

    path = flight / "masks" / "frame_00002.png"
    cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "time goes back": (lambda f: rewrite_rows(f / "frames.csv", swap_times), "frames.csv"),
    "time missing": (lambda f: rewrite_rows(f / "frames.csv", cell(1, 0, "")), "frames.csv"),
    "time NaN": (lambda f: rewrite_rows(f / "frames.csv", cell(1, 0, "nan")), "frames.csv"),
    "height zero": (lambda f: rewrite_rows(f / "frames.csv", cell(2, 2, "0")), "agl_m"),
    "height absurd": (lambda f: rewrite_rows(f / "frames.csv", cell(2, 2, "99999")), "agl_m"),
    "a mask is missing": (lambda f: (f / "masks/frame_00003.png").unlink(), "frame_00003.png is missing"),
    "no masks": (lambda f: shutil.rmtree(f / "masks"), "missing"),
    "mask unreadable": (lambda f: (f / "masks/frame_00003.png").write_bytes(b"no picture"), "frame_00003.png"),
    "mask of other size": (other_mask, "100 x 100"),
    "quaternion": (
        lambda f: (f / "odometry.tum").write_text("0 0 0 0 0 0 0 2\n5 1 0 0 0 0 0 2\n"),
        "odometry.tum",
    ),
    "odometry NaN": (lambda f: (f / "odometry.tum").write_text("0 nan 0 0 0 0 0 1\n5 1 0 0 0 0 0 1\n"), "odometry.tum"),
    "odometry of another flight": (
        lambda f: (f / "odometry.tum").write_text("1e6 0 0 0 0 0 0 1\n1000005 1 0 0 0 0 0 1\n"),
        "another flight",
    ),
    "reference in another CRS": (
        lambda f: edit(f / "flight.toml", 'crs = "EPSG:5187"', 'crs = "EPSG:4326"'),
        "reference.csv",
    ),
    "reference CRS unknown": (
        lambda f: edit(f / "flight.toml", 'crs = "EPSG:5187"', 'crs = "EPSG:999999"'),
        "999999",
    ),
    "no flight.toml": (lambda f: (f / "flight.toml").unlink(), "flight.toml"),
    "a key that nobody knows": (lambda f: edit(f / "flight.toml", "width", "widht"), "width"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_flights_are_refused_in_one_line_and_the_old_results_stay(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said], case: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "fixes.csv").write_text("of an earlier run\n")
    spoil, words = BAD[case]
    spoil(flight)
    said = say("localize", "--maps", maps, "--flight", flight, "--out", out)
    assert words in said.line
    assert bytes_of(out) == {"fixes.csv": b"of an earlier run\n"}
    assert {p.name for p in tmp_path.iterdir()} == {"out", "flight"}


def test_commands_refuse_what_cannot_be(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said], waypoints: Path
) -> None:
    out = tmp_path / "out"
    common = ("localize", "--maps", maps, "--flight", flight, "--out", out)
    assert say(*common, "--method", "guess").code == 2
    with pytest.raises(SettingsError, match="METHOD 'guess'"):
        localize(maps, read_flight(flight), "guess", out)
    rewrite_rows(flight / "frames.csv", lambda rows: [r[:5] for r in rows])
    edit(flight / "frames.csv", ",yaw_deg", "")
    assert "no column yaw_deg" in say(*common, "--compass").line
    assert "either a REGION" in say("localize", "--flight", flight, "--out", out).line
    assert "give --out" in say("localize", "--maps", maps, "--flight", flight).line
    assert "give --flight" in say("localize", "--maps", maps, "--out", out).line
    assert (
        "no such folder" in say("localize", "--maps", maps, "--flight", tmp_path / "none", "--out", out).line
    )
    assert "buildings.tif" in say("localize", "--maps", tmp_path, "--flight", flight, "--out", out).line

    empty = tmp_path / "empty"
    empty.mkdir()
    with rasterio.open(maps / "buildings.tif") as source:
        for name in ("buildings.tif", "ratio.tif"):
            with rasterio.open(empty / name, "w", **source.profile) as dst:
                dst.write(np.zeros((ROWS, COLS), np.uint8), 1)
    assert "no building" in say("localize", "--maps", empty, "--flight", flight, "--out", out).line
    assert not out.exists()


def test_folders_with_other_files_are_never_replaced(
    maps: Path, flight: Path, tmp_path: Path, say: Callable[..., Said], waypoints: Path
) -> None:
    localize = ("localize", "--maps", maps, "--flight", flight, "--out")
    simulate = ("simulate", "--maps", maps, "--mode", "masks", "--path", waypoints, "--out")

    def kept(words: tuple[object, ...], folder: Path, reason: str) -> None:
        before = bytes_of(folder)
        assert reason in say(*words, folder).line
        assert bytes_of(folder) == before

    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    kept(localize, mine, "(thesis.txt)")
    kept(simulate, mine, "(thesis.txt)")
    # Beside results or a simulated flight it is as precious.
    (mine / "fixes.csv").write_text("t_s\n")
    kept(localize, mine, "(thesis.txt)")
    shutil.copy(mine / "thesis.txt", flight)
    kept(simulate, flight, "(thesis.txt)")
    (flight / "thesis.txt").unlink()
    kept(localize, flight, "other files")
    (mine / "thesis.txt").unlink()
    (mine / "notes").mkdir()
    (mine / "notes" / "a.txt").write_text("b")
    kept(localize, mine, "(notes)")
    # A flight that was really flown has all the names of a simulated one.
    edit(flight / "flight.toml", "simulated = true", "# Flown on a fine day")
    kept(simulate, flight, "did not simulate")
    # A comment is no leave: the file may be a copy of a simulated flight's, filled in by hand.
    edit(flight / "flight.toml", "name =", "# Simulated by brmgeo: no real flight\nname =")
    kept(simulate, flight, "did not simulate")
    assert read_flight(flight).simulated
    edit(flight / "flight.toml", "name =", "simulated = false\nname =")
    kept(simulate, flight, "did not simulate")
    assert not read_flight(flight).simulated
    assert {p.name for p in tmp_path.iterdir()} == {"mine", "flight"}


def test_results_are_replaced_and_what_is_not_theirs_stays(
    maps: Path, whole: Path, results: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    out = tmp_path / "out"
    shutil.copytree(results / "ratio", out)
    (out / "my own project.qgz").write_bytes(b"mine")
    (out / "simulated-1.qgz").write_bytes(b"edited")
    (out / "fixes.csv").write_text("also edited")
    said = say("localize", "--maps", maps, "--flight", whole, "--method", "ratio", "--out", out)
    assert said.code == 0
    assert (out / "my own project.qgz").read_bytes() == b"mine"
    assert (out / "simulated-1.edited.qgz").read_bytes() == b"edited"
    assert (out / "fixes.edited.csv").read_text() == "also edited"
    assert (out / "fixes.csv").read_bytes() == (results / "ratio" / "fixes.csv").read_bytes()
    assert (
        f"{out / 'simulated-1.qgz'}: not as brmgeo wrote it, so it is kept as simulated-1.edited.qgz"
        in said.err
    )


def test_results_of_before_there_were_lists_are_replaced_but_for_projects(
    maps: Path, whole: Path, results: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    out = tmp_path / "out"
    shutil.copytree(results / "ratio", out)
    (out / files.WRITTEN).unlink()
    (out / "simulated-1.qgz~").write_bytes(b"of QGIS")
    said = say("localize", "--maps", maps, "--flight", whole, "--method", "ratio", "--out", out)
    assert said.code == 0
    assert {p.name for p in out.iterdir()} - RESULTS == {files.WRITTEN, "simulated-1.qgz", "simulated-1.qgz~"}


def test_a_simulated_flight_that_somebody_changed_is_not_replaced(
    maps: Path, flight: Path, say: Callable[..., Said], waypoints: Path
) -> None:
    words = ("simulate", "--maps", maps, "--mode", "masks", "--path", waypoints, "--out", flight)
    edit(flight / "flight.toml", "name =", "# Mine now\nname =")
    before = bytes_of(flight)
    assert "(flight.toml), or changed ones" in say(*words).line
    assert bytes_of(flight) == before
    edit(flight / "flight.toml", "# Mine now\nname =", "name =")
    assert say(*words).code == 0


def test_sift_is_refused_where_it_cannot_be(
    maps: Path, whole: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    words = ("localize", "--flight", whole, "--out", tmp_path / "out", "--sift", "--maps")
    assert "masks only" in say(*words, maps).line
    two = tmp_path / "two"
    two.mkdir()
    for name in ("buildings.tif", "ratio.tif"):
        shutil.copy(maps / name, two)
    assert "imagery.tif is not there" in say(*words, two).line
    assert not (tmp_path / "out").exists()


def test_the_caption_of_the_candidates_counts_what_is_drawn() -> None:
    from brmgeo.flight.values import Estimate

    def of(shown: int, count: int) -> str:
        places = np.zeros((shown, 2))
        return flight_results.how_many(
            Estimate(
                t_s=0.0,
                status="ambiguous",
                mean=places[0],
                covariance=np.eye(2),
                yaw_rad=math.nan,
                yaw_sigma_rad=math.nan,
                mass=0.1,
                candidates=places,
                candidate_mass=np.ones(shown),
                candidate_count=count,
            )
        )

    assert of(40, 40) == "Every place that fits"
    assert of(2000, 1_234_567) == "2,000 of the 1,234,567 places that fit"


def test_a_crash_while_writing_leaves_the_old_results(
    maps: Path, whole: Path, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    shutil.copytree(results / "paper", out)
    before = bytes_of(out)

    def crash(*_: object, **__: object) -> str:
        raise OSError("disk on fire")

    monkeypatch.setattr(flight_results, "render_report", crash)
    with pytest.raises(OSError, match="fire"):
        localize(maps, read_flight(whole), "mask", out)
    assert bytes_of(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


# ---------------------------------------------------------------- the real flight


def registered(maps_dir: Path, pitch_off_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """(n,) metres between each frame registered from the reference and the reference, and (n,) log ratios."""
    maps, flight = read_maps(maps_dir), read_flight(REAL)
    reference = flight.reference(maps.crs)
    assert reference is not None
    truth = reference.at(flight.times_s)
    yaws = flight.compass_yaw_rad(maps.crs, *truth[0])
    mount = replace(flight.mount, pitch_rad=flight.mount.pitch_rad + math.radians(pitch_off_deg))
    flight = replace(flight, mount=mount)
    settings = match_settings(FlightSettings())
    rates, registrar = RateLearner(settings.rates).rates, Registrar(maps.ground)
    apart, fits = [], []
    for i, (xy, yaw) in enumerate(zip(truth, yaws, strict=True)):
        view = view_at(flight, maps.ground.gsd_m, i)
        if view.building.sum() * view.gsd_m**2 < 20.0:
            continue
        assert yaw is not None
        found = registrar.register(view, np.array([*xy, yaw]), 10.0, 0.1, rates)
        assert found is not None, i
        apart.append(math.dist(found.pose[:2], xy))
        fits.append(found.llr)
    return np.array(apart), np.array(fits)


def test_every_real_frame_with_buildings_registers_on_the_map(real_maps: Path) -> None:
    apart, fits = registered(real_maps, 0.0)
    assert len(apart) >= 75
    assert np.median(apart) < 1.0
    assert apart.max() < 5.0
    assert (fits > 0).all()
    wrong_apart, wrong_fits = registered(real_maps, 5.0)
    assert np.median(wrong_apart) > 4.0
    assert np.median(wrong_fits) < np.median(fits) - 2.0


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--compass",), ("--compass", "--max-speed", "8")])
def test_real_flight_without_odometry_is_honest(
    real_maps: Path, tmp_path: Path, say: Callable[..., Said], words: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    words = ("--odometry", "given", *words)
    said = say("localize", "--maps", real_maps, "--flight", REAL, "--out", out, *words)
    assert said.code == 0, said.err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["data"] == "as given"
    assert metrics["false_fixes"] == 0
    if "--max-speed" in words:
        assert metrics["share_converged"] > 0.1
        assert metrics["rmse_after_first_fix_m"] < 1.0


@pytest.mark.slow
def test_real_flight_is_found_by_the_odometry_of_its_own_photos(
    real_maps: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    out = tmp_path / "out"
    said = say("localize", "--maps", real_maps, "--flight", REAL, "--out", out)
    assert said.code == 0, said.err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["odometry"].startswith("made from the frames: embedded planar odometry")
    assert metrics["odometry_rmse_m"] < 4.0
    assert metrics["false_fixes"] == 0
    assert metrics["share_converged"] > 0.5
    assert metrics["rmse_after_first_fix_m"] < 1.5
