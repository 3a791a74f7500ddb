"""The table keeps flights that were never fixed in its quantiles, and adds nothing up that should not be."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from brmgeo.errors import InputError
from brmgeo.evaluate.report import metrics_json
from brmgeo.evaluate.scores import Scores
from brmgeo.evaluate.table import FlightRow, markdown, plain, read_row, rows_csv, summarize

BASE = Scores(
    frames=40,
    flown_m=1075.0,
    first_fix_s=10.0,
    first_fix_m=50.0,
    rmse_whole_m=3.0,
    rmse_after_first_fix_m=1.0,
    rmse_whole_online_m=20.0,
    false_fixes=0,
    share_converged=0.5,
    share_converged_after_first_fix=1.0,
    within_sigma=(0.4, 0.9, 1.0),
    median_after_first_fix_m=0.8,
    worst_after_first_fix_m=2.0,
    odometry_rmse_m=30.0,
    odometry_rmse_after_first_fix_m=31.0,
)
NEVER = replace(
    BASE,
    first_fix_s=None,
    first_fix_m=None,
    rmse_after_first_fix_m=None,
    within_sigma=None,
    share_converged=0.0,
)


def rows(method: str, scores: list[Scores]) -> list[FlightRow]:
    return [FlightRow(f"f{i}", i, method, s, 0.1 * (i + 1), 0.5) for i, s in enumerate(scores)]


def test_a_flight_without_fix_counts_as_infinitely_late() -> None:
    summary = summarize(rows("mask", [BASE, NEVER, NEVER]))[0]
    assert summary.fixed == 1
    assert summary.first_fix_median_m is None
    assert summary.early_share == pytest.approx(1 / 3)
    assert summary.rmse_after_median_m == 1.0
    late = replace(BASE, first_fix_m=700.0)
    assert summarize(rows("mask", [BASE, late, NEVER]))[0].first_fix_median_m == 700.0


def test_methods_keep_their_order_and_their_own_figures() -> None:
    false = replace(BASE, false_fixes=3)
    table = summarize(rows("mask", [BASE, BASE]) + rows("paper", [false, NEVER]))
    assert [s.method for s in table] == ["mask", "paper"]
    assert (table[1].false_flights, table[1].false_fixes) == (1, 3)
    assert table[0].within_2_sigma == pytest.approx(0.9)
    assert table[0].seconds_per_frame == pytest.approx(0.15)


def test_markdown_text_and_csv_hold_every_method_and_flight() -> None:
    all_rows = rows("mask", [BASE, NEVER]) + rows("ratio", [BASE])
    summaries = summarize(all_rows)
    lines = markdown(summaries).splitlines()
    assert len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
    assert "ratio" in plain(summaries).splitlines()[0]
    read = list(csv.DictReader(io.StringIO(rows_csv(all_rows))))
    assert [r["method"] for r in read] == ["mask", "mask", "ratio"]
    assert read[1]["first_fix_m"] == ""
    assert rows_csv([replace(all_rows[0], flight="@SUM(1)")]).splitlines()[1].startswith("'@SUM(1),")
    assert float(read[0]["within_2_sigma"]) == 0.9


def test_the_table_shows_time_all_sigmas_odometry_after_the_fix_and_what_is_smoothed() -> None:
    half = replace(BASE, share_smoothed=0.5, first_fix_s=30.0)
    summary = summarize(rows("mask", [half, half, NEVER]))
    table = {line.split("  ")[0].strip(): line.split()[-1] for line in plain(summary).splitlines()}
    assert table["first fix, median s"] == "30"
    assert (table["fixes within 1 sigma"], table["2 sigma"], table["3 sigma"]) == ("40%", "90%", "100%")
    assert table["odometry alone after fix, median m"] == "31.0"
    assert table["frames smoothed"] == "50%"


def test_a_first_frame_s_time_that_is_not_known_is_a_dash_and_an_empty_cell() -> None:
    known, unknown = (FlightRow("f", 1, "mask", BASE, 0.1, s) for s in (0.5, float("nan")))
    assert "nan" not in markdown(summarize([unknown])) + plain(summarize([unknown])) + rows_csv([unknown])
    assert summarize([unknown])[0].first_frame_s is None
    assert summarize([known, unknown])[0].first_frame_s == 0.5


def test_a_row_is_read_back_from_the_metrics_of_a_flight(tmp_path: Path) -> None:
    names = {"flight": "f", "method": "mask", "first_frame_s": 0.5}
    path = tmp_path / "metrics.json"
    for scores in (BASE, NEVER):
        path.write_text(metrics_json(scores, 0.25, names))
        assert read_row(path) == FlightRow("f", 0, "mask", scores, 0.25, 0.5)
    old = {k: v for k, v in asdict(BASE).items() if k != "share_smoothed"}
    path.write_text(json.dumps(old | {"seconds_per_frame": 0.25, "flight": "f", "method": "mask"}))
    assert read_row(path).scores == BASE
    path.write_text("[1, 2]")
    with pytest.raises(InputError, match=r"metrics\.json: not the metrics\.json of a located flight"):
        read_row(path)
