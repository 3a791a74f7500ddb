"""The report of one flight: a single HTML page with its pictures inside, readable without a network."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any

import jinja2

from brmgeo import __version__
from brmgeo.evaluate.scores import FALSE_FIX_M, Scores


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """One picture: title, caption, bytes and their media type."""

    title: str
    caption: str
    data: bytes
    mime: str

    @property
    def base64(self) -> str:
        """The bytes as text for a data URL."""
        return base64.b64encode(self.data).decode("ascii")


@dataclass(frozen=True, slots=True)
class ReportTable:
    """One table; the first column is words, the others are figures."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def verdict(scores: Scores | None, frames: int, statuses: Sequence[str]) -> tuple[str, str]:
    """(sentence, mood) that says how the flight went; mood is ``good``, ``warn`` or ``bad``."""
    fixes = sum(s == "converged" for s in statuses)
    if scores is None:
        if not fixes:
            return f"No fix in {frames} frames. There is no reference to tell why.", "warn"
        first = next(i for i, s in enumerate(statuses) if s == "converged")
        text = f"First fix at frame {first + 1} of {frames}; {fixes} frames are fixed."
        return f"{text} There is no reference, so nothing can be said of the error.", "warn"
    if scores.first_fix_m is None:
        lost = sum(s == "lost" for s in statuses)
        why = (
            "most frames say that the aircraft is off the map"
            if lost > frames / 2
            else "several places stayed possible"
        )
        return f"No fix in {frames} frames over {scores.flown_m:.0f} m: {why}.", "warn"
    text = (
        f"First fix after {scores.first_fix_m:.0f} m of flight ({scores.first_fix_s:.0f} s); from there on "
        f"{_metres(scores.rmse_after_first_fix_m)} RMSE online"
    )
    if scores.odometry_rmse_after_first_fix_m is not None:
        text += f", where odometry alone, started at the true pose, has {_metres(scores.odometry_rmse_after_first_fix_m)}"
    if scores.false_fixes:
        return (
            f"{text}. {scores.false_fixes} of {fixes} fixes are false: more than {FALSE_FIX_M:.0f} m off.",
            "bad",
        )
    return f"{text}. No fix is false.", "good"


def cards(scores: Scores | None, seconds_per_frame: float) -> list[tuple[str, str]]:
    """(value, label) pairs for the top of the page."""
    if scores is None:
        return [(f"{seconds_per_frame * 1000:.0f} ms", "a frame")]
    within = scores.within_sigma
    return [
        (
            "none" if scores.first_fix_m is None else f"{scores.first_fix_m:.0f} m",
            "flown before the first fix",
        ),
        (_metres(scores.rmse_after_first_fix_m), "RMSE after the first fix, online"),
        (_metres(scores.rmse_whole_m), _smoothed_label(scores.share_smoothed)),
        (_metres(scores.odometry_rmse_m), "RMSE of odometry alone"),
        (f"{scores.share_converged:.0%}", "of frames have a fix"),
        (str(scores.false_fixes), "false fixes"),
        ("–" if within is None else f"{within[1]:.0%}", "of fixes within 2 sigma (86 % is ideal)"),
        (f"{seconds_per_frame * 1000:.0f} ms", "a frame"),
    ]


def render_report(
    *,
    title: str,
    subtitle: str,
    scores: Scores | None,
    statuses: Sequence[str],
    seconds_per_frame: float,
    figures: Sequence[ReportFigure],
    tables: Sequence[ReportTable],
    fixes: ReportTable | None,
    sources: Sequence[tuple[str, str]],
) -> str:
    """The page as text. ``sources`` names data, odometry, maps and settings, each as real, simulated or truth."""
    text = resources.files("brmgeo.evaluate").joinpath("report.html.j2").read_text(encoding="utf-8")
    sentence, mood = verdict(scores, len(statuses), statuses)
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(text)
    return template.render(
        title=title,
        subtitle=subtitle,
        verdict=sentence,
        mood=mood,
        cards=cards(scores, seconds_per_frame),
        figures=figures,
        tables=tables,
        fixes=fixes,
        sources=sources,
        version=__version__,
    )


def metrics_json(scores: Scores, seconds_per_frame: float, names: dict[str, Any]) -> str:
    """metrics.json of FLIGHT.md: the scores, seconds a frame, and the names of data, odometry and settings, as they are."""
    values = _rounded(asdict(scores) | {"seconds_per_frame": seconds_per_frame}) | names
    return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return value


def _smoothed_label(share: float | None) -> str:
    if share is None or share in (0.0, 1.0):
        return "RMSE of the whole path, smoothed"
    return f"RMSE of the smoothed path, which says something of {math.floor(100 * share)} % of the frames"


def _metres(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.2f} m" if value < 10 else f"{value:.1f} m" if value < 100 else f"{value:.0f} m"
