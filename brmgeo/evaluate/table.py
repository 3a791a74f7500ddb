"""The table over many flights and methods, side by side, after the paper's Table II: as text, Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from brmgeo.errors import InputError
from brmgeo.evaluate.scores import Scores
from brmgeo.files import json_of, plain_cell

EARLY_M = 450.0
#: Figures that metrics.json of earlier versions lack: their results still compare.
_LATER = {"within_sigma", "share_smoothed"}


@dataclass(frozen=True, slots=True)
class FlightRow:
    """One flight by one method.

    ``seconds_per_frame`` is the mean of all its steps, the first one included; ``first_frame_s`` is that first step alone,
    NaN where it is not known.
    """

    flight: str
    seed: int
    method: str
    scores: Scores
    seconds_per_frame: float
    first_frame_s: float


@dataclass(frozen=True, slots=True)
class MethodSummary:
    """One method over many flights; None where no flight had the figure.

    Attributes:
        method, flights: which, and how many flights.
        fixed: flights with a first fix at all.
        first_fix_median_s: of the time flown before the first fix, counted as the distance is.
        first_fix_median_m, first_fix_p95_m: of distance flown before it; a flight without fix counts as infinite, and
            an infinite quantile is None.
        early_share: share of flights fixed within 450 m.
        rmse_after_median_m, rmse_after_p95_m: of each flight's online RMSE after its first fix.
        rmse_whole_median_m: of each flight's smoothed RMSE over the whole path.
        smoothed_share: mean share of a flight's frames that its smoothed path says something of; None without one.
        odometry_median_m, odometry_after_median_m: of each flight's odometry alone, over the whole path and from the first
            fix on.
        false_flights, false_fixes: flights with a false fix, and false fixes in all.
        within_1_sigma, within_2_sigma, within_3_sigma: share of all fixes within so many sigma.
        converged_share: share of all frames.
        seconds_per_frame, first_frame_s: medians over the flights; the first frame's None where it is not known.
    """

    method: str
    flights: int
    fixed: int
    first_fix_median_s: float | None
    first_fix_median_m: float | None
    first_fix_p95_m: float | None
    early_share: float
    rmse_after_median_m: float | None
    rmse_after_p95_m: float | None
    rmse_whole_median_m: float | None
    smoothed_share: float | None
    odometry_median_m: float | None
    odometry_after_median_m: float | None
    false_flights: int
    false_fixes: int
    within_1_sigma: float | None
    within_2_sigma: float | None
    within_3_sigma: float | None
    converged_share: float
    seconds_per_frame: float
    first_frame_s: float | None


def read_row(path: Path) -> FlightRow:
    """The row of one located flight, from its metrics.json; InputError for a file that is none."""
    try:
        values = json_of(path.read_bytes())
        within = values["within_sigma"]
        fields = {n: values[n] for n in Scores.__dataclass_fields__ if n not in _LATER}
        fields["share_smoothed"] = values.get("share_smoothed")
        scores = Scores(**fields, within_sigma=None if within is None else (within[0], within[1], within[2]))
        return FlightRow(
            flight=values["flight"],
            seed=0,
            method=values["method"],
            scores=scores,
            seconds_per_frame=values["seconds_per_frame"],
            first_frame_s=values.get("first_frame_s", math.nan),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not the metrics.json of a located flight, or of another version of brmgeo ({error!r}): locate the "
            "flight again"
        ) from None


def summarize(rows: Sequence[FlightRow]) -> list[MethodSummary]:
    """One summary a method, in the order in which the methods first appear."""
    return [_summary(m, [r for r in rows if r.method == m]) for m in dict.fromkeys(r.method for r in rows)]


def _summary(method: str, rows: Sequence[FlightRow]) -> MethodSummary:
    scores = [r.scores for r in rows]
    first = [float("inf") if s.first_fix_m is None else s.first_fix_m for s in scores]
    first_s = [float("inf") if s.first_fix_s is None else s.first_fix_s for s in scores]
    fixes = [(s.within_sigma, s.share_converged * s.frames) for s in scores if s.within_sigma is not None]
    weight = sum(w for _, w in fixes)
    within = [sum(v[k] * w for v, w in fixes) / weight if weight else None for k in range(3)]
    shares = [s.share_smoothed for s in scores if s.share_smoothed is not None]
    first_frames = [r.first_frame_s for r in rows if np.isfinite(r.first_frame_s)]
    return MethodSummary(
        method=method,
        flights=len(rows),
        fixed=sum(np.isfinite(first)),
        first_fix_median_s=_quantile(first_s, 0.5),
        first_fix_median_m=_quantile(first, 0.5),
        first_fix_p95_m=_quantile(first, 0.95),
        early_share=float(np.mean(np.asarray(first) <= EARLY_M)),
        rmse_after_median_m=_quantile([s.rmse_after_first_fix_m for s in scores], 0.5),
        rmse_after_p95_m=_quantile([s.rmse_after_first_fix_m for s in scores], 0.95),
        rmse_whole_median_m=_quantile([s.rmse_whole_m for s in scores], 0.5),
        smoothed_share=float(np.mean(shares)) if shares else None,
        odometry_median_m=_quantile([s.odometry_rmse_m for s in scores], 0.5),
        odometry_after_median_m=_quantile([s.odometry_rmse_after_first_fix_m for s in scores], 0.5),
        false_flights=sum(s.false_fixes > 0 for s in scores),
        false_fixes=sum(s.false_fixes for s in scores),
        within_1_sigma=within[0],
        within_2_sigma=within[1],
        within_3_sigma=within[2],
        converged_share=float(np.mean([s.share_converged for s in scores])),
        seconds_per_frame=float(np.median([r.seconds_per_frame for r in rows])),
        first_frame_s=float(np.median(first_frames)) if first_frames else None,
    )


def _quantile(values: Sequence[float | None], q: float) -> float | None:
    present = [v for v in values if v is not None]
    if not present:
        return None
    # "higher" keeps a quantile among flights that are fixed apart from those that never are
    value = float(
        np.quantile(present, q, method="median_unbiased" if np.isfinite(present).all() else "higher")
    )
    return value if np.isfinite(value) else None


_COLUMNS = (
    ("method", lambda s: s.method),
    ("flights", lambda s: str(s.flights)),
    ("with a fix", lambda s: str(s.fixed)),
    ("first fix, median s", lambda s: _number(s.first_fix_median_s, 0)),
    ("first fix, median m", lambda s: _number(s.first_fix_median_m, 0)),
    ("95 % m", lambda s: _number(s.first_fix_p95_m, 0)),
    (f"within {EARLY_M:.0f} m", lambda s: f"{s.early_share:.0%}"),
    ("RMSE after fix, median m", lambda s: _number(s.rmse_after_median_m, 2)),
    ("95 % m", lambda s: _number(s.rmse_after_p95_m, 2)),
    ("RMSE whole path (smoothed), median m", lambda s: _number(s.rmse_whole_median_m, 2)),
    ("frames smoothed", lambda s: _share(s.smoothed_share)),
    ("odometry alone, median m", lambda s: _number(s.odometry_median_m, 1)),
    ("odometry alone after fix, median m", lambda s: _number(s.odometry_after_median_m, 1)),
    ("flights with a false fix", lambda s: str(s.false_flights)),
    ("false fixes", lambda s: str(s.false_fixes)),
    ("fixes within 1 sigma", lambda s: _share(s.within_1_sigma)),
    ("2 sigma", lambda s: _share(s.within_2_sigma)),
    ("3 sigma", lambda s: _share(s.within_3_sigma)),
    ("frames with a fix", lambda s: f"{s.converged_share:.0%}"),
    ("ms a frame", lambda s: _number(s.seconds_per_frame * 1000, 0)),
    ("ms first frame", lambda s: _number(None if s.first_frame_s is None else s.first_frame_s * 1000, 0)),
)


def markdown(summaries: Sequence[MethodSummary]) -> str:
    """The summaries as a Markdown table, one row a method."""
    head = [name for name, _ in _COLUMNS]
    lines = [f"| {' | '.join(head)} |", f"|{'|'.join('---' for _ in head)}|"]
    lines += [f"| {' | '.join(show(s) for _, show in _COLUMNS)} |" for s in summaries]
    return "\n".join(lines) + "\n"


def plain(summaries: Sequence[MethodSummary]) -> str:
    """The summaries for a terminal: one line a figure, one column a method."""
    rows = [[name, *(show(s) for s in summaries)] for name, show in _COLUMNS]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))])
        for row in rows
    )


def rows_csv(rows: Sequence[FlightRow]) -> str:
    """One line a flight and method with all its scores."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    names = [n for n in Scores.__dataclass_fields__ if n != "within_sigma"]
    writer.writerow(
        [
            "flight",
            "seed",
            "method",
            *names,
            "within_1_sigma",
            "within_2_sigma",
            "within_3_sigma",
            "seconds_per_frame",
            "first_frame_s",
        ]
    )
    for row in rows:
        values = asdict(row.scores)
        within = values["within_sigma"] or (None, None, None)
        cells = [values[n] for n in names] + [*within, row.seconds_per_frame, row.first_frame_s]
        writer.writerow([plain_cell(row.flight), row.seed, row.method, *(_cell(c) for c in cells)])
    return buffer.getvalue()


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


def _cell(value: float | int | None) -> str:
    return (
        ""
        if value is None or value != value
        else f"{value:.4f}".rstrip("0").rstrip(".")
        if isinstance(value, float)
        else str(value)
    )
