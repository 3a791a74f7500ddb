"""What a located flight leaves on disk: fixes, paths, candidates, metrics, a QGIS project and a report for people."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.evaluate.figures import (
    Background,
    Paths,
    SeenFrame,
    curves_figure,
    first_candidates_figure,
    map_below,
    paths_figure,
    seen_figure,
    shrinking_figure,
)
from brmgeo.evaluate.report import ReportFigure, ReportTable, metrics_json, render_report, verdict
from brmgeo.evaluate.scores import Scores, dead_reckoning, score, travelled_m
from brmgeo.evaluate.sift import sift_table
from brmgeo.files import plain_name
from brmgeo.flight.folder import Flight
from brmgeo.flight.own import odometry_name
from brmgeo.flight.values import Estimate
from brmgeo.geo.raster import read_overview
from brmgeo.locate.flights import Located, view_at
from brmgeo.locate.maps import Maps
from brmgeo.locate.masks import FrameMasks
from brmgeo.match import MatchSettings

FloatArray = NDArray[np.float64]
RESULTS = frozenset(
    ("fixes.csv", "metrics.json", "report.html", "trajectory.geojson", "trajectory.tum", "trajectory.json")
    + ("candidates.geojson", "candidates.qml")
    + tuple(f"{name}.gpkg{end}" for name in ("candidates", "trajectory") for end in ("", "-wal", "-shm"))
)
#: Groups of settings that each method reads.
READ = {
    "paper": ("odometry", "belief", "ratio", "paper"),
    "ratio": ("odometry", "rates", "belief", "ratio"),
    "mask": ("odometry", "rates", "belief"),
}


def is_result(path: Path) -> bool:
    """True for a file by a name that localize always wrote, or QGIS beside it; a project may have been edited."""
    return path.name in RESULTS


def source_of(flight: Flight) -> str:
    """What results say of a flight's data: ``simulated`` or ``as given``."""
    return "simulated" if flight.simulated else "as given"


@dataclass(frozen=True)
class FlightResults:
    """One located flight, and what is to be written of it.

    Attributes:
        maps: that it was matched to.
        masks: of its frames.
        method, settings: of the matcher.
        compass: its compass was trusted.
        odometry: ``auto`` or ``given``: whether a flight without odometry might get its own.
        interval_s: between the frames that are kept of a video then.
        located: what the matcher said.
        truth: (n, 2) where each frame was taken, NaN where unknown; None without a reference. For scores only.
        sift: match the frames to the imagery too.
        attribution: of the maps' sources.
    """

    maps: Maps
    masks: FrameMasks
    method: str
    settings: MatchSettings
    compass: bool
    odometry: str
    interval_s: float
    located: Located
    truth: FloatArray | None
    sift: bool
    attribution: str

    @property
    def mount(self) -> dict[str, float]:
        """How the camera sat, as far as was known, degrees."""
        sits = self.flight.mount
        angles = (sits.roll_rad, sits.pitch_rad, sits.yaw_rad, self.flight.mount_sigma_rad)
        names = ("roll_deg", "pitch_deg", "yaw_deg", "sigma_deg")
        return {name: round(math.degrees(angle), 4) for name, angle in zip(names, angles)}

    @property
    def flight(self) -> Flight:
        """The flight."""
        return self.masks.flight

    @cached_property
    def scores(self) -> Scores | None:
        """Errors against the reference; None where there is none."""
        if self.truth is None:
            return None
        return score(self.located.estimates, self.located.smoothed.xy, self.located.motions, self.truth)

    @property
    def sentence(self) -> str:
        """How the flight went."""
        statuses = [e.status for e in self.located.estimates]
        return verdict(self.scores, len(statuses), statuses)[0].rstrip(".")

    @cached_property
    def source(self) -> str:
        """Whether the flight is simulated."""
        return source_of(self.flight)

    @cached_property
    def names(self) -> dict[str, Any]:
        """What metrics.json says beside the scores: enough to make the result again."""
        values = asdict(self.settings)
        used = {
            "compass": self.compass,
            "roof_m": self.masks.roof_m,
            "network": self.masks.network,
            "odometry": self.odometry,
            "interval_s": self.interval_s,
            "mount": self.mount,
        }
        return {
            "flight": self.flight.name,
            "data": self.source,
            "method": self.method,
            "odometry": odometry_name(self.flight, self.source),
            "masks": self.masks.source,
            "maps": self.maps.folder.name,
            "settings": {group: values[group] for group in READ[self.method]} | {"localize": used},
            "first_frame_s": round(float(self.located.seconds[0]), 4),
        }


def write_results(folder: Path, final: Path, results: FlightResults) -> None:
    """Writes all files into ``folder``, which will stand at ``final``."""
    from brmgeo.export.candidates import write_candidates
    from brmgeo.export.qgis import write_flight_project

    estimates, maps, flight = results.located.estimates, results.maps, results.flight
    candidates = write_candidates(
        folder, [(e.t_s, e.candidates, e.candidate_mass, e.status) for e in estimates], maps.crs
    )
    _write_paths(folder, results)
    if results.scores is not None:
        text = metrics_json(results.scores, float(results.located.seconds.mean()), results.names)
        (folder / "metrics.json").write_text(text, encoding="utf-8")
    write_flight_project(
        folder / f"{plain_name(flight.name, 'flight')}.qgz",
        title=f"{flight.name} by {results.method}",
        candidates=candidates,
        trajectory=folder / "trajectory.gpkg",
        buildings=maps.folder / "buildings.tif",
        imagery=maps.imagery,
        t_s=flight.times_s,
        maps_href=os.path.relpath(maps.folder, final.absolute()),
        attribution=results.attribution,
    )
    (folder / "report.html").write_text(_report(results), encoding="utf-8")


def _write_paths(folder: Path, results: FlightResults) -> None:
    from brmgeo.export.trajectory import TimedPath, write_trajectory

    flight, smoothed, truth = results.flight, results.located.smoothed, results.truth
    known = np.isfinite(smoothed.xy).all(axis=1)
    agl = np.array([frame.agl_m for frame in flight.frames])
    track = reference = None
    if known.any():
        track = TimedPath(
            t_s=smoothed.t_s[known],
            xy=smoothed.xy[known],
            yaw_rad=smoothed.yaw_rad[known],
            sigma_m=smoothed.sigma_m[known],
            z_m=agl[known],
            segment=np.cumsum(~known, dtype=np.int64)[known],
        )
    if truth is not None:
        seen = np.isfinite(truth).all(axis=1)
        reference = TimedPath(
            flight.times_s[seen], truth[seen], segment=np.cumsum(~seen, dtype=np.int64)[seen]
        )
    write_trajectory(
        folder,
        results.located.estimates,
        [frame.file for frame in flight.frames],
        results.maps.crs,
        smoothed=track,
        reference=reference,
        z_m=agl,
        height_reference="ground",
    )


def _report(results: FlightResults) -> str:
    from brmgeo.export.trajectory import FIXES_HEADER, fixes_rows

    maps, flight, located = results.maps, results.flight, results.located
    estimates, names, truth = located.estimates, results.names, results.truth
    tables = []
    if results.sift and maps.imagery is not None:
        note = (
            "Frames that were drawn from this very imagery match it far better than a real camera would match an old "
            "orthophoto: simulate with --season to draw them from another day's."
        )
        tables.append(sift_table(maps.imagery, flight, truth, note if results.source == "simulated" else ""))
    agl = np.array([frame.agl_m for frame in flight.frames])
    rows = fixes_rows(estimates, [frame.file for frame in flight.frames], maps.crs)
    return render_report(
        title=f"{flight.name}, {results.method}",
        subtitle=f"{len(estimates)} frames over {maps.folder.name}, {_duration(flight.times_s)}; method {results.method}",
        scores=results.scores,
        statuses=[e.status for e in estimates],
        seconds_per_frame=float(located.seconds.mean()),
        figures=_figures(results),
        tables=tables,
        fixes=ReportTable("fixes", FIXES_HEADER, tuple(rows)),
        sources=[
            ("flight", f"{flight.name} ({results.source}), {len(estimates)} frames"),
            ("masks", results.masks.source),
            ("odometry", names["odometry"]),
            (
                "camera",
                "mount roll {roll_deg:.1f}, pitch {pitch_deg:.1f}, yaw {yaw_deg:.1f}, known to {sigma_deg:.1f} deg".format(
                    **results.mount
                ),
            ),
            ("height", f"{agl.min():.1f} to {agl.max():.1f} m above ground"),
            ("maps", f"{maps.folder.name} ({maps.crs}, {maps.ground.gsd_m:g} m per pixel)"),
            ("reference", "none" if truth is None else "of the flight folder; used for scores only"),
            ("attribution", results.attribution or "–"),
            ("settings", json.dumps(names["settings"])),
        ],
    )


def _figures(results: FlightResults) -> list[ReportFigure]:
    maps, estimates, truth = results.maps, results.located.estimates, results.truth
    photo = _background(maps.imagery or maps.folder / "buildings.tif")
    mask = _background(maps.folder / "buildings.tif")
    reckoned = flown = errors = drift = None
    if truth is not None:
        reckoned, flown = dead_reckoning(results.located.motions, truth), travelled_m(truth)
        errors = np.linalg.norm(np.array([e.mean for e in estimates]) - truth, axis=1)
        drift = None if reckoned is None else np.linalg.norm(reckoned - truth, axis=1)
    smoothed = results.located.smoothed.xy
    path = smoothed if np.isfinite(smoothed).any() else None
    return [
        ReportFigure(
            "Paths",
            "Where the aircraft flew and what was made of it (after the paper's Fig. 9). Online fixes are what a pilot "
            "would have had at that moment; the smoothed path uses the whole flight, also before the first fix.",
            paths_figure(photo, Paths(truth, reckoned, path), estimates),
            "image/png",
        ),
        ReportFigure(
            "Error and certainty over time",
            "Error of the online fixes beside two sigma and odometry alone, the spread of the belief, and its entropy or "
            "the number of candidates. Background: status of each frame.",
            curves_figure(estimates, errors, drift),
            "image/svg+xml",
        ),
        ReportFigure(
            "What the camera saw",
            "Some frames, the building mask of each as the matcher gets it (levelled, nose up, grey where nothing is "
            "known), and the building map at the online fix, turned alike, with the mask's outlines on it.",
            seen_figure(_seen(maps, results.masks, estimates)),
            "image/png",
        ),
        ReportFigure(
            "Candidates of the first frame",
            f"{how_many(estimates[0])} the first frame, over the building mask (after the paper's Fig. 10); the stronger "
            "the red, the more probable.",
            first_candidates_figure(mask, estimates[0], None if truth is None else truth[0]),
            "image/png",
        ),
        ReportFigure(
            "Candidates over frames",
            "How the odometry thins them out (after the paper's Fig. 11).",
            shrinking_figure(mask, estimates, truth, flown),
            "image/png",
        ),
    ]


def how_many(estimate: Estimate) -> str:
    """How many of an estimate's places a picture of its candidates shows, for its caption."""
    shown, count = len(estimate.candidates), estimate.candidate_count
    return "Every place that fits" if shown >= count else f"{shown:,} of the {count:,} places that fit"


def _seen(maps: Maps, masks: FrameMasks, estimates: Sequence[Estimate]) -> list[SeenFrame]:
    """Four frames: spread over the fixes, or over the flight where there is none."""
    flight = masks.flight
    fixed = [i for i, e in enumerate(estimates) if e.status == "converged"]
    pool = np.array(fixed or range(len(estimates)))
    chosen = pool[np.unique(np.linspace(0, len(pool) - 1, min(4, len(pool))).round().astype(int))]
    out = []
    for i in chosen.tolist():
        view, estimate = view_at(flight, maps.ground.gsd_m, i, masks), estimates[i]
        at_fix = estimate.status == "converged" and math.isfinite(estimate.yaw_rad)
        out.append(
            SeenFrame(
                f"frame {i + 1}, {estimate.t_s - estimates[0].t_s:.0f} s, {estimate.status}",
                flight.image(i) if flight.has_images else None,
                view.building,
                view.known,
                map_below(maps.ground, view, estimate.mean, estimate.yaw_rad) if at_fix else None,
            )
        )
    return out


def _background(path: Path) -> Background:
    pixels, bounds = read_overview(path, 1600)
    return Background(pixels[0] if len(pixels) == 1 else np.moveaxis(pixels, 0, -1), bounds)


def _duration(times: FloatArray) -> str:
    seconds = float(times[-1] - times[0]) if len(times) else 0.0
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"
