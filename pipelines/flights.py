"""Flights: locate them over a region's maps and score them."""

from __future__ import annotations

import functools
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.evaluate.figures import (
    Background,
    Paths,
    Seen,
    curves_figure,
    first_candidates_figure,
    paths_figure,
    seen_figure,
    shrinking_figure,
)
from brmgeo.evaluate.report import ReportFigure, ReportTable, metrics_json, render_report, verdict
from brmgeo.evaluate.scores import FALSE_FIX_M, dead_reckoning, score, travelled_m
from brmgeo.evaluate.sift import sift_fixes
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.own import odometry_name, own_odometry
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.geo.raster import read_overview
from brmgeo.locate.live import Located, locate, motions_of, view_at
from brmgeo.locate.maps import Maps, match_settings, read_maps
from brmgeo.locate.masks import (
    FrameMasks,
    NetworkUse,
    frame_masks,
)
from brmgeo.match import METHODS, GroundMap, MatchSettings, SmoothedPath
from brmgeo.region import FlightSettings
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import serial_map

FloatArray = NDArray[np.float64]


# --- one flight ------------------------------------------------------------------------------------------------


def localize(
    maps_dir: Path,
    flight_dir: Path,
    method: str,
    out: Path,
    *,
    flight_settings: FlightSettings | None = None,
    compass: bool = False,
    sift: bool = False,
    max_speed_m_s: float | None = None,
    network: NetworkUse | None = None,
    odometry: str = "auto",
    attribution: str = "",
) -> Path:
    """Locates a flight over built maps and writes all its results into ``out``; returns the report's path.

    A flight without odometry gets its own from its frames, where they are dense enough, unless ``odometry`` is "given".
    ``out`` is replaced as a whole, at the end: a run that fails leaves what was there. ``max_speed_m_s`` bounds the
    movement where odometry says nothing (default: the region's). ``network`` says where masks come from (default: the
    flight's own where it has some, else the network that ships with brmgeo).
    """
    if method not in METHODS:
        raise SettingsError(f"METHOD {method!r} is not known: choose one of {', '.join(METHODS)}")
    _may_replace_results(out)
    progress = Progress()
    maps = read_maps(maps_dir.absolute())
    flight = read_flight(flight_dir)
    if sift and maps.imagery is None:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there; --sift matches frames to imagery: leave it out"
        )
    if sift and not flight.has_images:
        raise InputError(
            f"{flight_dir / 'frames'}: --sift is given, but the flight has masks only; leave it out"
        )
    if odometry == "auto":
        tried = own_odometry(flight, (flight_settings or FlightSettings()).interval_s)
        flight = tried.flight
        if tried.says:
            progress.say(f"{flight.name} odometry: {tried.says}")
    reference = flight.reference(maps.crs)
    yaws = flight.compass_yaw_rad(maps.crs, *_middle(maps)) if compass else None
    if compass and (yaws is None or all(y is None for y in yaws)):
        raise InputError(
            f"{flight_dir / 'frames.csv'}: --compass is given, but there is no column yaw_deg; add it or leave --compass out"
        )
    own = flight_settings or FlightSettings()
    if max_speed_m_s is not None:
        own = own.model_copy(update={"max_speed_m_s": max_speed_m_s})
    settings = match_settings(own)
    steps = motions_of(flight, yaws, own.max_speed_m_s)
    source = _source_of(flight)
    given, use = f"{source}: masks/ of the flight folder", network or NetworkUse()
    with frame_masks(flight, given, use, progress, maps.folder.name) as masks:
        with progress.stage(f"{flight.name} {method}") as bar:
            views = bar.watch(serial_map)(
                functools.partial(view_at, flight, maps.ground.gsd_m, masks=masks), range(len(flight.frames))
            )
            located = locate(maps.ground, views, steps, method, settings)
        truth = None if reference is None else reference.at(flight.times_s)
        with _whole_folder(out) as scratch:
            _write_results(
                scratch, out, maps, masks, located, steps, truth, method, settings, source, sift, attribution
            )
    report = out / "report.html"
    progress.say(f"{flight.name} by {method}: {_sentence(located, truth, steps)}; report: {report}")
    return report


def _middle(maps: Maps) -> tuple[float, float]:
    left, bottom, right, top = maps.bounds
    return (left + right) / 2, (bottom + top) / 2


def _source_of(flight: Flight) -> str:
    return "simulated" if flight.simulated else "as given"


RESULTS = frozenset(
    ("fixes.csv", "metrics.json", "report.html", "trajectory.geojson", "trajectory.tum", "trajectory.json")
    + ("candidates.geojson", "candidates.qml")
    + tuple(f"{name}.gpkg{end}" for name in ("candidates", "trajectory") for end in ("", "-wal", "-shm"))
)


def _may_replace_results(out: Path) -> None:
    """SettingsError when ``out`` holds files that localize did not write: they would be lost."""
    _may_replace(out, "fixes.csv", "results of localize", lambda p: p.name in RESULTS or ".qgz" in p.suffix)


def _may_replace(out: Path, sign: str, what: str, ours: Callable[[Path], bool]) -> None:
    there = sorted(out.iterdir()) if out.is_dir() else []
    foreign = [p for p in there if not ours(p)] or ([] if not there or (out / sign).is_file() else there)
    if foreign or out.is_file():
        raise SettingsError(
            f"--out {out}: there are other files than {what} ({(foreign or [out])[0].name}), and the folder is replaced as "
            "a whole; give a new folder or an empty one"
        )


@contextmanager
def _whole_folder(out: Path) -> Iterator[Path]:
    """A scratch folder beside ``out`` that takes its place when the block ends without an error."""
    out = out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    os.chmod(scratch, 0o755)
    try:
        yield scratch
        old = scratch.with_name(f"{scratch.name}.old")
        if out.exists():
            os.rename(out, old)
        try:
            os.rename(scratch, out)
        except BaseException:
            if old.exists():
                os.rename(old, out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _sentence(located: Located, truth: FloatArray | None, steps: Sequence[Motion]) -> str:
    scores = None if truth is None else score(located.estimates, located.smoothed.xy, steps, truth)
    return verdict(scores, len(located.estimates), [e.status for e in located.estimates])[0].rstrip(".")


def _write_results(
    folder: Path,
    final: Path,
    maps: Maps,
    masks: FrameMasks,
    located: Located,
    steps: Sequence[Motion],
    truth: FloatArray | None,
    method: str,
    settings: MatchSettings,
    source: str,
    sift: bool,
    attribution: str,
) -> None:
    from brmgeo.export.candidates import write_candidates
    from brmgeo.export.qgis import write_flight_project
    from brmgeo.export.trajectory import Track, write_trajectory

    flight = masks.flight
    estimates, smoothed, times = located.estimates, located.smoothed, flight.times_s
    files = [frame.file for frame in flight.frames]
    known = np.isfinite(smoothed.xy).all(axis=1)
    agl = np.array([frame.agl_m for frame in flight.frames])
    track = (
        Track(
            smoothed.t_s[known],
            smoothed.xy[known],
            smoothed.yaw_rad[known],
            smoothed.sigma_m[known],
            agl[known],
            np.cumsum(~known, dtype=np.int64)[known],
        )
        if known.any()
        else None
    )
    seen = None if truth is None else np.isfinite(truth).all(axis=1)
    candidates = write_candidates(
        folder, [(e.t_s, e.candidates, e.candidate_mass, e.status) for e in estimates], maps.crs
    )
    write_trajectory(
        folder,
        estimates,
        files,
        maps.crs,
        smoothed=track,
        reference=None
        if truth is None or seen is None
        else Track(times[seen], truth[seen], segment=np.cumsum(~seen, dtype=np.int64)[seen]),
        z_m=agl,
        height_reference="ground",
    )
    scores = None if truth is None else score(estimates, smoothed.xy, steps, truth)
    names: dict[str, Any] = {
        "flight": flight.name,
        "data": source,
        "method": method,
        "odometry": odometry_name(flight, source),
        "masks": masks.source,
        "maps": maps.folder.name,
        "settings": _plain_settings(settings, method),
        "first_frame_s": float(located.seconds[0]),
    }
    per_frame = float(located.seconds.mean())
    if scores is not None:
        (folder / "metrics.json").write_text(metrics_json(scores, per_frame, names), encoding="utf-8")
    write_flight_project(
        folder / f"{_safe(flight.name)}.qgz",
        title=f"{flight.name} by {method}",
        candidates=candidates,
        trajectory=folder / "trajectory.gpkg",
        buildings=maps.folder / "buildings.tif",
        imagery=maps.imagery,
        t_s=times,
        maps_href=os.path.relpath(maps.folder, final.absolute()),
        attribution=attribution,
    )
    tables = []
    if sift:
        tables.append(sift_table(maps, flight, truth))
    figures = _figures(maps, masks, estimates, smoothed, steps, truth)
    fixes = (folder / "fixes.csv").read_text(encoding="utf-8").splitlines()
    text = render_report(
        title=f"{flight.name}, {method}",
        subtitle=f"{len(estimates)} frames over {maps.folder.name}, {_duration(times)}; method {method}",
        scores=scores,
        statuses=[e.status for e in estimates],
        seconds_per_frame=per_frame,
        figures=figures,
        tables=tables,
        fixes=ReportTable(
            "fixes", tuple(fixes[0].split(",")), tuple(tuple(line.split(",")) for line in fixes[1:])
        ),
        sources=[
            ("flight", f"{flight.name} ({source}), {len(estimates)} frames"),
            ("masks", masks.source),
            ("odometry", names["odometry"]),
            ("height", f"{agl.min():.1f} to {agl.max():.1f} m above ground"),
            ("maps", f"{maps.folder.name} ({maps.crs}, {maps.ground.gsd_m:g} m per pixel)"),
            ("reference", "none" if truth is None else "of the flight folder; used for scores only"),
            ("attribution", attribution or "–"),
            ("settings", json.dumps(names["settings"])),
        ],
    )
    (folder / "report.html").write_text(text, encoding="utf-8")


def _plain_settings(settings: MatchSettings, method: str) -> dict[str, Any]:
    from dataclasses import asdict

    groups = {
        "paper": ("paper",),
        "ratio": ("odometry", "belief", "ratio"),
        "mask": ("odometry", "rates", "belief"),
    }
    values = asdict(settings)
    return {group: values[group] for group in groups[method]}


def _figures(
    maps: Maps,
    masks: FrameMasks,
    estimates: list[Estimate],
    smoothed: SmoothedPath,
    steps: Sequence[Motion],
    truth: FloatArray | None,
) -> list[ReportFigure]:
    photo = _background(maps.imagery or maps.folder / "buildings.tif")
    mask = _background(maps.folder / "buildings.tif")
    reckoned = None if truth is None else dead_reckoning(steps, truth)
    flown = None if truth is None else travelled_m(truth)
    errors = None if truth is None else np.linalg.norm(np.array([e.mean for e in estimates]) - truth, axis=1)
    drift = None if reckoned is None or truth is None else np.linalg.norm(reckoned - truth, axis=1)
    path = smoothed.xy if np.isfinite(smoothed.xy).any() else None
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
            seen_figure(_seen(maps, masks, estimates)),
            "image/png",
        ),
        ReportFigure(
            "Candidates of the first frame",
            f"{_how_many(estimates[0])} the first frame, over the building mask (after the paper's Fig. 10); the stronger "
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


def _how_many(estimate: Estimate) -> str:
    shown, count = len(estimate.candidates), estimate.candidate_count
    return "Every place that fits" if shown >= count else f"{shown:,} of the {count:,} places that fit"


def _seen(maps: Maps, masks: FrameMasks, estimates: Sequence[Estimate]) -> list[Seen]:
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
            Seen(
                f"frame {i + 1}, {estimate.t_s - estimates[0].t_s:.0f} s, {estimate.status}",
                flight.image(i) if flight.has_images else None,
                view.building,
                view.known,
                _below(maps.ground, view, estimate.mean, estimate.yaw_rad) if at_fix else None,
            )
        )
    return out


def _below(ground: GroundMap, view: View, xy: FloatArray, yaw_rad: float) -> NDArray[np.uint8]:
    """(h, w) uint8 building map at each pixel of a view whose nadir is at ``xy``; 255 beyond the map."""
    rows, cols = np.indices(view.building.shape) + 0.5
    ahead, left = (view.nadir_px[0] - rows) * view.gsd_m, (view.nadir_px[1] - cols) * view.gsd_m
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    col = np.floor((xy[0] + ahead * c - left * s - ground.left) / ground.gsd_m).astype(np.int64)
    row = np.floor((ground.top - xy[1] - ahead * s - left * c) / ground.gsd_m).astype(np.int64)
    h, w = ground.building.shape
    inside = (row >= 0) & (row < h) & (col >= 0) & (col < w)
    out = np.full(view.building.shape, 255, np.uint8)
    out[inside] = ground.building[row[inside], col[inside]]
    return out


def _background(path: Path) -> Background:
    pixels, bounds = read_overview(path, 1600)
    return Background(pixels[0] if len(pixels) == 1 else np.moveaxis(pixels, 0, -1), bounds)


def sift_table(maps: Maps, flight: Flight, truth: FloatArray | None) -> ReportTable:
    """The paper's Fig. 1 as a table: SIFT features of each frame against the region's imagery."""
    assert maps.imagery is not None

    def level(index: int, grey: NDArray[Any], gsd_m: float) -> View:
        f = flight.frames[index]
        return make_view(
            grey, flight.camera, flight.mount, f.roll_rad, f.pitch_rad, f.agl_m, gsd_m, t_s=f.t_s
        )

    found = right = 0
    pictures = (flight.image(index) for index in range(len(flight.frames)))
    for index, (fix, _) in enumerate(sift_fixes(maps.imagery, pictures, level)):
        if fix is not None:
            found += 1
            if truth is not None and np.linalg.norm(fix.xy - truth[index]) <= FALSE_FIX_M:
                right += 1
    total = len(flight.frames)
    return ReportTable(
        "SIFT against the imagery (the paper's Fig. 1)",
        ("", "frames", "share"),
        (
            ("frames", str(total), ""),
            ("with a match that RANSAC accepts", str(found), f"{found / total:.0%}"),
            (
                "of these within 50 m of the reference",
                str(right) if truth is not None else "–",
                f"{right / total:.0%}",
            ),
        ),
        "Frames that were drawn from this very imagery match it far better than a real camera would match an old "
        "orthophoto: simulate with --season to draw them from another day's."
        if _source_of(flight) == "simulated"
        else "",
    )


def _duration(times: FloatArray) -> str:
    seconds = float(times[-1] - times[0]) if len(times) else 0.0
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _safe(text: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in text).strip(".-") or "flight"


def flight_name(folder: Path) -> str:
    """The name that a flight's results go by."""
    return _safe(read_flight(folder).name)
