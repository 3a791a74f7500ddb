"""`brmgeo evaluate`: the table over many flights, by kinds of masks, beside SIFT, and of results of localize."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from small_flights import Said

from brmgeo import files
from brmgeo.evaluate.table import FlightRow
from brmgeo.evaluate.trials import Trial
from brmgeo.match import METHODS
from pipelines import evaluate as job

Say = Callable[..., Said]


def test_evaluate_writes_the_table_and_compares_results(
    maps: Path, waypoints: Path, results: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    out = tmp_path / "table"
    words = (
        "evaluate",
        "--maps",
        maps,
        "--flights",
        2,
        "--path",
        waypoints,
        "--methods",
        "mask,paper",
        "--out",
        out,
    )
    said = say(*words)
    assert said.code == 0, said.err
    rows = list(csv.DictReader((out / "flights.csv").read_text().splitlines()))
    assert [(r["seed"], r["method"]) for r in rows] == [
        ("1", "mask"),
        ("1", "paper"),
        ("2", "mask"),
        ("2", "paper"),
    ]
    assert {
        "first_fix_m",
        "rmse_whole_m",
        "rmse_after_first_fix_m",
        "false_fixes",
        "odometry_rmse_m",
    } <= rows[0].keys()
    assert rows[0]["odometry_rmse_m"] == rows[1]["odometry_rmse_m"] != ""
    text = (out / "summary.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 4
    assert len({line.count("|") for line in table}) == 1
    assert "mask" in said.out
    assert "paper" in said.out
    assert "method 'x'" in say(*words[:-4], "--methods", "mask,x", "--out", out).line

    shutil.copytree(results, tmp_path / "results")
    said = say("evaluate", "--results", tmp_path / "results", "--out", tmp_path / "compared")
    assert said.code == 0, said.err
    rows = list(csv.DictReader((tmp_path / "compared/flights.csv").read_text().splitlines()))
    for row in rows:
        metrics = json.loads((tmp_path / "results" / row["method"] / "metrics.json").read_text())
        assert float(row["odometry_rmse_m"]) == pytest.approx(metrics["odometry_rmse_m"], abs=1e-3)
        assert row["false_fixes"] == str(metrics["false_fixes"])
    assert {r["method"] for r in rows} == set(METHODS)
    (tmp_path / "results/mask/metrics.json").write_text("{}")
    assert "metrics.json" in say("evaluate", "--results", tmp_path / "results").line
    assert "no metrics.json" in say("evaluate", "--results", tmp_path / "compared").line


def test_evaluate_keeps_the_flights_that_were_flown_where_one_breaks_off(
    maps: Path, say: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly = job.fly_trial

    def flown(trial: Trial) -> list[FlightRow]:
        if trial.seed == 2:
            raise ValueError("a root of\na negative number")
        return fly(trial)

    monkeypatch.setattr(job, "fly_trial", flown)
    out = tmp_path / "table"
    said = say(
        "evaluate",
        "--maps",
        maps,
        "--out",
        out,
        "--flights",
        3,
        "--methods",
        "paper",
        "--scheduler",
        "serial",
    )
    assert "1 of 3 flights broke off (seed 2: ValueError: a root of a negative number)" in said.line
    rows = csv.DictReader((out / "flights.csv").read_text(encoding="utf-8").splitlines())
    assert [row["seed"] for row in rows] == ["1", "3"]
    summary = (out / "summary.md").read_text(encoding="utf-8")
    assert "2 simulated masks-only flights" in summary
    assert "seed 2: ValueError" in summary
    assert sorted(p.name for p in out.iterdir()) == [files.WRITTEN, "flights.csv", "summary.md"]


def test_the_same_flights_with_several_kinds_of_masks(
    maps: Path, waypoints: Path, weights: Path, tmp_path: Path, say: Say
) -> None:
    words = ("evaluate", "--maps", maps, "--out", tmp_path, "--flights", 1, "--path", waypoints)
    said = say(
        *words, "--methods", "mask", "--masks", "true,network,degraded", "--weights", weights, "--looks", 2
    )
    assert said.code == 0, said.err
    rows = list(csv.DictReader((tmp_path / "flights.csv").read_text().splitlines()))
    by = {r["method"]: r for r in rows}
    assert len(rows) == 3
    assert set(by) == {f"mask, {kind} masks" for kind in ("true", "network", "degraded")}
    assert len({r["odometry_rmse_m"] for r in rows}) == 1
    assert all(int(r["false_fixes"]) == 0 for r in rows)
    assert float(by["mask, network masks"]["rmse_after_first_fix_m"]) < 3
    text = (tmp_path / "summary.md").read_text()
    assert "network bright abababababab, two looks on rendered frames" in text
    assert "accuracy of 0.916" in text
    assert "'perfect' is not known" in say(*words, "--masks", "perfect").line
    for option in (("--weights", weights), ("--looks", 1)):
        assert "give --masks network too" in say(*words, "--masks", "true", *option).line


def test_sift_is_compared_on_the_same_flights(maps: Path, waypoints: Path, tmp_path: Path, say: Say) -> None:
    words = ("evaluate", "--maps", maps, "--out", tmp_path, "--flights", 1, "--path", waypoints)
    said = say(*words, "--methods", "mask", "--sift")
    assert said.code == 0, said.err
    rows = {r["method"]: r for r in csv.DictReader((tmp_path / "flights.csv").read_text().splitlines())}
    assert set(rows) == {"mask", "SIFT"}
    assert rows["SIFT"]["odometry_rmse_m"] == rows["mask"]["odometry_rmse_m"]
    assert rows["SIFT"]["frames"] == rows["mask"]["frames"]
    # Frames drawn from the very imagery that they are matched to: the easiest case there is.
    assert float(rows["SIFT"]["share_converged"]) > 0
    assert float(rows["SIFT"]["median_after_first_fix_m"]) < 10
    text = (tmp_path / "summary.md").read_text()
    assert "easier than a real camera" in text
    assert "masks-only" not in text
    # It states no covariance, and its time is that of finding a place, not of drawing the frame.
    assert rows["SIFT"]["within_1_sigma"] == ""
    assert float(rows["SIFT"]["seconds_per_frame"]) > 0
    assert "needs a generated REGION" in say(*words, "--sift", "--season", "winter").line
    assert "--hide does not hide" in say(*words, "--sift", "--hide", "east").line
    assert "--methods: names none" in say(*words, "--methods", ",").line
