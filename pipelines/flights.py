"""Flights: simulate them, locate them over a region's maps, score them, and compare the matchers over many."""

from __future__ import annotations

import functools
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError, WorkflowError
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
from brmgeo.evaluate.scores import FALSE_FIX_M, Scores, dead_reckoning, score, travelled_m
from brmgeo.evaluate.sift import SiftFix, SiftMatcher
from brmgeo.evaluate.table import FlightRow, markdown, plain, rows_csv, summarize
from brmgeo.flight.folder import Flight, may_be_remade, read_flight
from brmgeo.flight.readings import Camera
from brmgeo.flight.values import Estimate, Motion, View
from brmgeo.flight.view import make_view
from brmgeo.geo.raster import box_of, read_overview, read_raster
from brmgeo.locate.live import Located, locate, motions_of, view_at
from brmgeo.locate.maps import Maps, match_settings, read_maps
from brmgeo.locate.masks import (
    ROOF_M,
    FrameMasks,
    NetworkUse,
    above_roofs_m,
    frame_masks,
    network_mask,
    network_name,
    network_warning,
    slant_gsd_m,
)
from brmgeo.match import METHODS, GroundMap, MatchSettings, SmoothedPath
from brmgeo.region import FlightSettings, Region
from brmgeo.synth.mission import photographed
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler, serial_map
from pipelines.map_sources import NativeImagery
from pipelines.maps import native_imagery
from pipelines.odometry import odometry_name, own_odometry
from pipelines.regions import region_named, town_style

FloatArray = NDArray[np.float64]
PATHS = ("rectangle", "lawnmower", "random")


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
SIMULATED = frozenset(
    ("flight.toml", "frames.csv", "frames", "masks", "imu.csv", "altimeter.csv", "reference.csv")
    + ("odometry.tum", "odometry.csv", "odometry.covariance.csv", "odometry.json", ".recipe.json")
)


def _may_replace_results(out: Path) -> None:
    """SettingsError when ``out`` holds files that localize did not write: they would be lost."""
    _may_replace(out, "fixes.csv", "results of localize", lambda p: p.name in RESULTS or ".qgz" in p.suffix)


def _may_replace_flight(out: Path) -> None:
    """SettingsError when ``out`` holds anything but a flight that was simulated: a real one is flown but once."""
    _may_replace(out, "flight.toml", "a simulated flight", lambda p: p.name in SIMULATED)
    if (out / "flight.toml").is_file() and not may_be_remade(out):
        raise SettingsError(
            f"--out {out}: there is a flight that brmgeo did not simulate (its flight.toml does not say simulated = true), "
            "and it would be lost; give a new folder or an empty one"
        )


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


@functools.lru_cache(maxsize=1)
def _sift_matcher(imagery: Path, changed_ns: int) -> tuple[SiftMatcher, float]:
    """Features of a region's imagery, and its metres per pixel."""
    # The time of the last change is in the key, so that imagery made anew is read anew.
    pixels, bounds = read_overview(imagery, 4000)
    gsd_m = (bounds[2] - bounds[0]) / pixels.shape[2]
    return SiftMatcher(np.moveaxis(pixels, 0, -1), bounds[0], bounds[3], gsd_m), gsd_m


def sift_fixes(
    imagery: Path, pictures: Iterable[NDArray[np.uint8]], level: Callable[[int, NDArray[Any], float], View]
) -> Iterator[tuple[SiftFix | None, float]]:
    """The paper's Fig. 1: where SIFT finds each frame (h, w, 3) in a region's imagery, None where nowhere; and the seconds
    that finding it took, of the levelled frame as the matchers' are.

    ``level(index, grey, gsd_m)`` makes a view of a frame's (h, w) float32 grey levels in [0, 1].
    """
    matcher, gsd_m = _sift_matcher(imagery, imagery.stat().st_mtime_ns)
    for index, picture in enumerate(pictures):
        view = level(index, picture.astype(np.float32).mean(axis=2) / 255.0, gsd_m)
        began = time.perf_counter()
        fix = matcher.locate((view.building * 255).astype(np.uint8), gsd_m, view.nadir_px)
        yield fix, time.perf_counter() - began


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


# --- simulated flights -----------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=2)
def read_ground(footprints: Path) -> Any:
    """Footprints made ready for the simulator, with heights from their floors (3 m each) where they are known."""
    import geopandas as gpd

    from brmgeo.synth.flight import Ground

    frame = gpd.read_file(footprints, layer="footprints" if footprints.suffix == ".gpkg" else None)
    floors = frame["floors"].fillna(1).to_numpy(dtype=float) if "floors" in frame else np.ones(len(frame))
    return Ground.from_polygons(list(frame.geometry), list(3.0 * floors))


def simulator_settings(own: FlightSettings, **changes: Any) -> Any:
    """The simulator's settings of a region: camera, height, speed and interval as its file says."""
    from brmgeo.synth.flight import FlightSettings as Simulated

    camera = Camera.from_fov(own.width_px, own.height_px, own.fov_deg)
    base = Simulated(camera=camera, speed_m_s=own.speed_m_s, frame_interval_s=own.interval_s, agl_m=own.agl_m)
    return replace(base, **changes)


def flight_path(
    kind: str, ground: Any, seed: int, bounds: tuple[float, float, float, float], crs: str
) -> FloatArray:
    """(n, 2) waypoints: a named shape placed over built-up ground by the seed, or the line of a GeoJSON file."""
    from brmgeo.synth.flight import lawnmower, path_from_geojson, place, random_mission, rectangle

    if kind == "rectangle":
        return place(rectangle((0.0, 0.0), 0.0), ground, seed, bounds)
    if kind == "random":
        return random_mission(_inset(bounds, 100.0), seed)
    if kind == "lawnmower":
        return place(lawnmower((0.0, 0.0, 400.0, 300.0), 75.0), ground, seed, bounds)
    if not Path(kind).is_file():
        raise MissingInputError(
            f"--path {kind}: give {', '.join(PATHS)}, or a GeoJSON file with a LineString"
        )
    return path_from_geojson(kind, crs)


def _inset(bounds: tuple[float, float, float, float], by: float) -> tuple[float, float, float, float]:
    left, bottom, right, top = bounds
    by = min(by, (right - left) / 4, (top - bottom) / 4)
    return (left + by, bottom + by, right - by, top - by)


@dataclass(frozen=True, slots=True)
class Simulation:
    """A flight to simulate over built maps; small, so that it travels to a worker.

    Attributes:
        maps_dir, own: the maps, and the region's camera and flight settings.
        path: rectangle, lawnmower, random, or a GeoJSON file.
        mode: masks, frames or both.
        scale_bias: of the odometry; None draws it.
        no_odometry, compass: what the aircraft carries.
        interval_s: seconds between frames; None for the region's.
        imagery: a (h, w, 3) picture by path in place of the maps' own, for flights on another day; None for the maps'.
        native: the region's imagery where that is finer than its maps: frames are drawn from it.
        settings_file: a TOML file with settings of the simulator in place of the region's and the defaults; None for none.
    """

    maps_dir: Path
    own: FlightSettings
    path: str = "rectangle"
    mode: str = "masks"
    scale_bias: float | None = None
    no_odometry: bool = False
    compass: bool = False
    interval_s: float | None = None
    imagery: Path | None = None
    native: NativeImagery | None = None
    settings_file: Path | None = None

    def settings(self) -> Any:
        """The simulator's settings: the region's, then the file's, then the options'; SettingsError for a bad file."""
        from brmgeo.synth.flight import OdometryErrors
        from pipelines.simulation import read_simulation_settings

        made = simulator_settings(self.own)
        if self.settings_file is not None:
            made = read_simulation_settings(self.settings_file, made)
        if self.no_odometry:
            made = replace(made, odometry=None)
        elif self.scale_bias is not None:
            made = replace(
                made, odometry=replace(made.odometry or OdometryErrors(), scale_bias=self.scale_bias)
            )
        if self.interval_s is not None:
            made = replace(made, frame_interval_s=self.interval_s)
        return replace(made, compass_error_deg=3.0) if self.compass else made

    def imagery_file(self) -> Path | None:
        """The picture that frames are drawn from; None where none are drawn."""
        if self.mode == "masks":
            return None
        return self.imagery or read_maps(self.maps_dir).imagery


def check_simulation(what: Simulation) -> None:
    """Raises MissingInputError when the maps lack what a simulation needs, SettingsError for a bad file of settings."""
    what.settings()
    maps = read_maps(what.maps_dir)
    if maps.footprints is None:
        raise MissingInputError(
            f"{maps.folder / 'footprints.gpkg'} is not there; a flight is simulated from the footprints: run brmgeo maps"
        )
    if what.mode != "masks" and what.imagery_file() is None:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there; frames are drawn from imagery: choose --mode masks"
        )


def simulate_flight(what: Simulation, seed: int, out: Path, name: str) -> Path:
    """Writes a flight folder over built maps, in place of an earlier one; returns it."""
    from brmgeo.synth.flight import simulate

    _may_replace_flight(out)
    check_simulation(what)
    maps = read_maps(what.maps_dir)
    assert maps.footprints is not None
    ground = read_ground(maps.footprints)
    settings = what.settings()
    route = flight_path(what.path, ground, seed, maps.bounds, maps.crs)
    file = what.imagery_file()
    native = what.native if what.imagery is None else None
    own = what.own.model_copy(update={"agl_m": settings.agl_m, "fov_deg": _seen_deg(settings)})
    imagery = None if file is None else _imagery_of(own, route, native, file)
    with _whole_folder(out) as scratch:
        simulate(
            scratch,
            ground,
            route,
            maps.crs,
            settings,
            seed,
            mode=what.mode,  # type: ignore[arg-type]
            imagery=imagery,
            name=name,
        )
    return out


def _seen_deg(settings: Any) -> float:
    """The cone about straight down, degrees, that a simulated camera sees across its short side, tilt counted in."""
    camera, mount = settings.camera, settings.mount
    fov = 2 * math.degrees(math.atan(camera.half_fov_tan))
    tilt = math.degrees(math.hypot(mount.roll_rad, mount.pitch_rad))
    return float(max(fov, min(fov + 2 * tilt, 150.0)))


def _imagery_of(own: FlightSettings, route: FloatArray, native: NativeImagery | None, file: Path) -> Any:
    """What frames along a route are drawn from: the finer imagery where there is some, else a whole picture's file."""
    from brmgeo.synth.flight import Imagery

    if native is not None:
        reach = own.agl_m * math.tan(math.radians(own.fov_deg) / 2) * 2.5 + 60.0
        (left, bottom), (right, top) = route.min(axis=0) - reach, route.max(axis=0) + reach
        return Imagery(*native.around((left, bottom, right, top)), native.gsd_m)
    picture = read_raster(file)
    return Imagery(np.moveaxis(picture.pixels, 0, -1), picture.left, picture.top, picture.gsd_m)


def _simulate_one(job: tuple[Simulation, int, Path, str]) -> Path:
    return simulate_flight(*job)


def simulate_flights(
    what: Simulation, jobs: Sequence[tuple[int, Path, str]], scheduler_spec: str | None
) -> list[Path]:
    """Many flights, one for each (seed, folder, name), side by side; returns their folders."""
    check_simulation(what)
    for _, out, _ in jobs:
        _may_replace_flight(out)
    progress = Progress()
    with scheduler(scheduler_spec, say=progress.say) as map, progress.stage("simulate") as bar:
        return list(bar.watch(map)(_simulate_one, [(what, *job) for job in jobs]))


def other_day(own: Region, maps_dir: Path, season: str, seed: int, out: Path) -> Path:
    """Writes a generated region's imagery as it is on another day of ``season``, on the maps' lattice; returns ``out``."""
    from brmgeo.export.cog import write_cog
    from brmgeo.synth.day import another_day
    from brmgeo.synth.imagery import render_imagery
    from brmgeo.synth.town import generate_town

    if own.generate is None:
        raise SettingsError(
            f"--season {season}: region {own.name} is not generated, so nobody knows how it looks on another day; "
            "leave --season out"
        )
    assert own.bounds is not None
    box = box_of(maps_dir / "buildings.tif")
    style = town_style(own.generate.style, own.generate.season)
    town = generate_town(own.bounds, own.generate.seed, style, own.crs)
    picture = render_imagery(another_day(town, season, seed), box)  # type: ignore[arg-type]
    write_cog(out, (picture, np.ones(picture.shape[:2], bool)), box, kind="imagery")
    return out


# --- many flights, side by side --------------------------------------------------------------------------------


MASKS = ("true", "network", "degraded", "simulated")
PAPER_ACCURACY = 0.916


@dataclass(frozen=True, slots=True)
class MaskComparison:
    """The same flights with several kinds of masks.

    Attributes:
        kinds: ``true`` (what a perfect network sees in the frame), ``network`` (on rendered frames), ``degraded`` (the true
            ones at the pixel accuracy of the paper's network), ``simulated`` (the simulator's own errors).
        weights, looks: of the network; None for those that ship, and for as many as they ask for.
    """

    kinds: tuple[str, ...]
    weights: Path | None = None
    looks: int | None = None


@dataclass(frozen=True, slots=True)
class Drawn:
    """What the frames of simulated flights are drawn from: ``native``, imagery finer than the maps', or the picture in
    the file ``imagery`` (another day's), or, without both, the maps' own imagery."""

    native: NativeImagery | None = None
    imagery: Path | None = None
    season: str | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """One simulated flight of an evaluation; ``hide`` hides half of the map under the flight.

    ``masks`` flies it with several kinds of masks; None with the simulator's alone, without frames. ``sift`` also
    matches frames to the imagery.
    """

    maps_dir: Path
    own: FlightSettings
    seed: int
    methods: tuple[str, ...]
    path: str
    scale_bias: float
    hide: str | None
    masks: MaskComparison | None = None
    sift: bool = False
    drawn: Drawn = Drawn()


def fly_trial(trial: Trial) -> list[FlightRow]:
    """Simulates one flight and runs every method over the very same views; one row a method."""
    from brmgeo.synth.flight import OdometryErrors, simulate_views

    maps = read_maps(trial.maps_dir)
    if maps.footprints is None:
        raise MissingInputError(f"{maps.folder / 'footprints.gpkg'} is not there; run brmgeo maps again")
    ground, bounds, known = read_ground(maps.footprints), maps.bounds, maps.ground
    if trial.hide is not None:
        known, bounds = _half_hidden(maps, trial.hide)
    sign = 1.0 if trial.seed % 2 else -1.0
    settings = simulator_settings(trial.own, odometry=OdometryErrors(scale_bias=sign * trial.scale_bias))
    route = flight_path(trial.path, ground, trial.seed, bounds, maps.crs)
    # Frames show roofs where their height puts them, and so do the masks that are compared with the network's.
    relief = trial.masks is not None
    flown = simulate_views(ground, route, settings, trial.seed, maps.ground.gsd_m, relief=relief)
    truth = flown.reference.at(np.array([v.t_s for v in flown.views]))
    seen = {"": flown.views}
    if trial.masks is not None:
        seen = _views_by_masks(trial, trial.masks, maps, ground, route, settings, flown.views)
    rows = []
    for method in trial.methods:
        for kind, views in seen.items():
            located = locate(known, views, flown.motions, method, match_settings(trial.own))
            rows.append(
                FlightRow(
                    flight=f"{_path_name(trial.path)}-{trial.seed}",
                    seed=trial.seed,
                    method=f"{method}, {kind} masks" if kind else method,
                    scores=score(located.estimates, located.smoothed.xy, flown.motions, truth),
                    seconds_per_frame=float(located.seconds.mean()),
                    first_frame_s=float(located.seconds[0]),
                )
            )
    if trial.sift:
        estimates, seconds = _sift_estimates(trial, maps, ground, route, settings)
        # SIFT states no covariance of its own, so what lies within its sigma says nothing.
        scores = replace(score(estimates, None, flown.motions, truth), within_sigma=None)
        rows.append(
            FlightRow(
                flight=f"{_path_name(trial.path)}-{trial.seed}",
                seed=trial.seed,
                method="SIFT",
                scores=scores,
                seconds_per_frame=float(np.mean(seconds)),
                first_frame_s=seconds[0],
            )
        )
    return rows


def _sift_estimates(
    trial: Trial, maps: Maps, ground: Any, route: FloatArray, settings: Any
) -> tuple[list[Estimate], list[float]]:
    """What SIFT alone says of each frame of a trial, and its seconds: a fix where RANSAC accepts one, else nothing."""
    from brmgeo.synth.flight import Simulator, fly

    assert maps.imagery is not None
    course = fly(route, settings, trial.seed)
    simulator = Simulator(ground, settings, course, trial.seed)
    left, bottom, right, top = maps.bounds
    middle = np.array([(left + right) / 2, (bottom + top) / 2])
    out: list[Estimate] = []
    seconds: list[float] = []
    for i, (fix, took) in enumerate(
        sift_fixes(
            maps.imagery,
            _pictures(trial, maps, route, settings, simulator),
            lambda i, grey, gsd_m: _measured_view(settings, course, i, grey, 0.0, gsd_m),
        )
    ):
        seconds.append(took)
        # Assumed, for the estimate's form: a fix to two metres; without one, anywhere.
        sigma_m = 2.0 if fix is not None else math.hypot(right - left, top - bottom) / math.sqrt(12.0)
        out.append(
            Estimate(
                t_s=float(course.frame_times_s[i]),
                status="lost" if fix is None else "converged",
                mean=middle if fix is None else fix.xy,
                covariance=np.eye(2) * sigma_m**2,
                yaw_rad=math.nan,
                yaw_sigma_rad=math.nan,
                mass=0.0 if fix is None else 1.0,
                candidates=np.empty((0, 2)),
                candidate_mass=np.empty(0),
                candidate_count=0,
            )
        )
    return out, seconds


def _pictures(
    trial: Trial, maps: Maps, route: FloatArray, settings: Any, simulator: Any
) -> Iterator[NDArray[np.uint8]]:
    """The frames of a trial, as a camera would have stored them."""
    drawn = trial.drawn
    native = drawn.native if drawn.imagery is None else None
    imagery = _imagery_of(
        trial.own, route, native, drawn.imagery or maps.imagery or maps.folder / "imagery.tif"
    )
    for i in range(len(simulator.course.frame_index)):
        yield photographed(simulator.picture(i, imagery), settings.jpeg_quality)


def _measured_view(
    settings: Any, course: Any, i: int, image: NDArray[Any], roof_m: float, gsd_m: float
) -> View:
    """A frame's picture or mask, levelled by what the aircraft measured, laid onto the plane at ``roof_m``."""
    return make_view(
        image,
        settings.camera,
        settings.mount,
        math.radians(course.measured_roll_deg[i]),
        math.radians(course.measured_pitch_deg[i]),
        above_roofs_m(float(course.measured_agl_m[i]), roof_m),
        gsd_m,
        t_s=float(course.frame_times_s[i]),
    )


def _views_by_masks(
    trial: Trial,
    masks: MaskComparison,
    maps: Maps,
    ground: Any,
    route: FloatArray,
    settings: Any,
    simulated: list[View],
) -> dict[str, list[View]]:
    """The views of one flight by kind of mask: the same course, the same readings, only the masks differ."""
    from brmgeo.synth.flight import MaskErrors, Simulator, fly

    course = fly(route, settings, trial.seed)
    frames = range(len(course.frame_index))
    errors = {"true": MaskErrors.none(), "degraded": MaskErrors.degraded(PAPER_ACCURACY)}
    seen = {}
    for kind in masks.kinds:
        own = replace(settings, masks=errors.get(kind, settings.masks))
        simulator = Simulator(ground, own, course, trial.seed)
        if kind == "simulated":
            seen[kind] = simulated
            continue
        if kind == "network":
            images = (
                network_mask(
                    picture,
                    slant_gsd_m(
                        settings.camera,
                        settings.mount,
                        math.radians(course.measured_roll_deg[i]),
                        math.radians(course.measured_pitch_deg[i]),
                        float(course.measured_agl_m[i]),
                    ),
                    masks.weights,
                    masks.looks,
                )
                for i, picture in enumerate(_pictures(trial, maps, route, settings, simulator))
            )
        else:
            images = (simulator.mask(i, relief=True) for i in frames)
        # All of them show roofs where the camera sees them, so all are laid onto the same plane.
        seen[kind] = [
            _measured_view(settings, course, i, image, ROOF_M, maps.ground.gsd_m)
            for i, image in zip(frames, images)
        ]
    return seen


def _path_name(path: str) -> str:
    return path if path in PATHS else Path(path).stem


def _trial_or_why(trial: Trial) -> list[FlightRow] | str:
    # One flight that cannot be flown must not cost the others.
    try:
        return fly_trial(trial)
    except Exception as error:
        return f"seed {trial.seed}: {type(error).__name__}: {' '.join(str(error).split())}"


def _half_hidden(maps: Maps, side: str) -> tuple[GroundMap, tuple[float, float, float, float]]:
    """The map without one half (cut away, unknown), and the bounds of that half."""
    building = maps.ground.building
    rows, cols = building.shape
    left, bottom, right, top = maps.bounds
    x, y = left + cols // 2 * maps.ground.gsd_m, top - rows // 2 * maps.ground.gsd_m
    g = maps.ground
    parts = {
        "east": (building[:, : cols // 2], left, top, (x, bottom, right, top)),
        "west": (building[:, cols // 2 :], x, top, (left, bottom, x, top)),
        "north": (building[rows // 2 :], left, y, (left, y, right, top)),
        "south": (building[: rows // 2], left, top, (left, bottom, right, y)),
    }
    kept, kept_left, kept_top, hidden = parts[side]
    # Views reach over the cut: a strip of the hidden half must not lie within any of them.
    return GroundMap(np.ascontiguousarray(kept), kept_left, kept_top, g.gsd_m), _inset(hidden, 150.0)


def evaluate(
    maps_dir: Path,
    own: FlightSettings,
    flights: int,
    first_seed: int,
    methods: tuple[str, ...],
    path: str,
    scale_bias: float,
    hide: str | None,
    out: Path,
    scheduler_spec: str | None,
    masks: MaskComparison | None = None,
    sift: bool = False,
    drawn: Drawn = Drawn(),
) -> str:
    """Flies many simulated flights, writes flights.csv (as they land), summary.md and returns the table as text.

    With ``masks`` each flight is flown with several kinds of masks; with ``sift`` its frames are also matched to the
    imagery. Frames are drawn from ``drawn``.

    WorkflowError, after all is written, where a flight broke off.
    """
    for method in methods:
        if method not in METHODS:
            raise SettingsError(f"method {method!r} is not known: choose among {', '.join(METHODS)}")
    if not methods and not sift:
        raise SettingsError(f"--methods: names none; give some of {', '.join(METHODS)}")
    if flights < 1:
        raise SettingsError(f"--flights {flights}: give 1 or more")
    if sift and hide is not None:
        raise SettingsError("--sift matches the imagery, which --hide does not hide: leave out one of them")
    for kind in masks.kinds if masks is not None else ():
        if kind not in MASKS:
            raise SettingsError(f"--masks: {kind!r} is not known: choose among {', '.join(MASKS)}")
    maps = read_maps(maps_dir.absolute())
    usual = "12 % of buildings missed, 3 false blobs a frame, wobbly edges"
    shown = f"masks: {usual}"
    if masks is not None:
        told = {
            "true": "what a perfect network would see in the frame",
            "degraded": f"true ones with pixels flipped in patches to an accuracy of {PAPER_ACCURACY}",
            "simulated": usual,
        }
        if "network" in masks.kinds:
            if maps.imagery is None and drawn.native is None and drawn.imagery is None:
                raise MissingInputError(
                    f"{maps.folder / 'imagery.tif'} is not there; the network's frames are drawn from imagery"
                )
            day = f" of another day ({drawn.season})" if drawn.season else ""
            told["network"] = f"{network_name(masks.weights, masks.looks)} on rendered frames{day}"
        shown = "masks: " + "; ".join(f"{kind}: {told[kind]}" for kind in masks.kinds)
    if sift:
        if maps.imagery is None:
            raise MissingInputError(
                f"{maps.folder / 'imagery.tif'} is not there; --sift matches frames to imagery: leave it out"
            )
        shown += "; SIFT: each frame for itself against the imagery, " + (
            f"drawn as on another day ({drawn.season})"
            if drawn.season
            else "drawn from this very imagery, which is far easier than a real camera (--season draws another day's)"
        )
    trials = [
        Trial(maps.folder, own, seed, methods, path, scale_bias, hide, masks, sift, drawn)
        for seed in range(first_seed, first_seed + flights)
    ]
    progress = Progress()
    if masks is not None and "network" in masks.kinds:
        warning = network_warning(masks.weights, maps.folder.name)
        if warning:
            progress.say(warning)
    rows: list[FlightRow] = []
    broken: list[str] = []
    out.mkdir(parents=True, exist_ok=True)
    with scheduler(scheduler_spec, say=progress.say) as map, progress.stage("flights") as bar:
        for result in bar.watch(map)(_trial_or_why, trials):
            if isinstance(result, str):
                broken.append(result)
            else:
                rows += result
                _replace_text(out / "flights.csv", rows_csv(rows))
    if not rows:
        raise WorkflowError(f"evaluate: none of {flights} flights could be flown; {broken[0]}")
    where = "over ground that the map does not show" if hide else "over built-up ground"
    frameless = "masks-only " if masks is None and not sift else ""
    note = (
        f"{flights - len(broken)} simulated {frameless}flights ({_path_name(path)}, seeds "
        f"{first_seed} to {first_seed + flights - 1}) {where} of {maps.folder.name}; "
        f"odometry: simulated, scale bias {scale_bias:+.0%} or the opposite, heading drift 0.75 deg per root minute; "
        f"{shown}. Nothing is aligned before it is scored."
    )
    if broken:
        note += (
            f" {len(broken)} of {flights} flights broke off and are not in the table: {'; '.join(broken)}."
        )
    summaries = summarize(rows)
    _replace_text(out / "summary.md", f"{note}\n\n{markdown(summaries)}")
    if broken:
        raise WorkflowError(
            f"evaluate: {len(broken)} of {flights} flights broke off ({broken[0]}); the others are in {out / 'flights.csv'}"
        )
    return f"{note}\n\n{plain(summaries)}\n\nwritten: {out / 'flights.csv'}, {out / 'summary.md'}"


def _replace_text(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def compare_results(folders: Sequence[Path], out: Path | None) -> str:
    """The table of results that ``localize`` has written: every metrics.json below the folders."""
    found = sorted({p for folder in folders for p in folder.rglob("metrics.json")})
    if not found:
        raise MissingInputError(
            f"{', '.join(map(str, folders))}: no metrics.json below; run localize over flights with a reference first"
        )
    rows = []
    # Results of versions before these figures still compare.
    later = {"within_sigma", "share_smoothed"}
    for path in found:
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            within = values["within_sigma"]
            fields = {n: values[n] for n in Scores.__dataclass_fields__ if n not in later}
            fields["share_smoothed"] = values.get("share_smoothed")
            scores = Scores(
                **fields, within_sigma=None if within is None else (within[0], within[1], within[2])
            )
            rows.append(
                FlightRow(
                    values["flight"],
                    0,
                    values["method"],
                    scores,
                    values["seconds_per_frame"],
                    values.get("first_frame_s", math.nan),
                )
            )
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is not a metrics.json of brmgeo localize ({error!r}); run localize again"
            ) from None
    summaries = summarize(rows)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _replace_text(out / "flights.csv", rows_csv(rows))
        _replace_text(out / "summary.md", markdown(summaries))
    return plain(summaries)


# --- the jobs that the command line calls ----------------------------------------------------------------------


def maps_for(
    command: str, region: str | None, maps_dir: Path | None, data: Path, scheduler_spec: str | None
) -> tuple[Region, Path, str]:
    """The region's settings, the folder of its maps (built first where they are not fresh), and its attribution.

    With ``maps_dir`` in place of a region the settings are the defaults.
    """
    from pipelines.map_sources import credits
    from pipelines.maps import build_region

    if (region is None) == (maps_dir is None):
        raise SettingsError(
            f"{command}: give either a REGION (such as demo) or --maps with a folder of built maps"
        )
    if maps_dir is not None:
        read_maps(maps_dir.absolute())
        return (
            Region.model_construct(name=_safe(maps_dir.absolute().name), flight=FlightSettings()),
            maps_dir,
            "",
        )
    assert region is not None
    own, data = region_named(region, data)
    return own, build_region(region, data, None, False, scheduler_spec), credits(own)


def default_flight(own: Region, maps_dir: Path, data: Path, seed: int) -> Path:
    """The flight that is simulated when none is given: the paper's rectangle, made once a seed.

    Frames, for the network to make masks of, where the maps have imagery; else masks.
    """
    # Not the name that brmgeo simulate gives: a flight that somebody made is never replaced by this one.
    name = f"default-{seed}"
    out = data / "source" / own.name / "flights" / name
    maps = read_maps(maps_dir.absolute())
    mode = "frames" if maps.imagery is not None else "masks"
    recipe = json.dumps(
        {
            "seed": seed,
            "mode": mode,
            "flight": own.flight.model_dump(),
            "imagery": None if own.imagery is None else own.imagery.model_dump(mode="json"),
            "footprints": _digest(maps.footprints),
        }
    )
    note = out / ".recipe.json"
    if not note.is_file() or note.read_text(encoding="utf-8") != recipe:
        Progress().say(f"{name}: simulating the paper's rectangle over {own.name} (seed {seed})")
        native = native_imagery(own, data) if mode != "masks" else None
        simulate_flight(Simulation(maps.folder, own.flight, mode=mode, native=native), seed, out, name)
        note.write_text(recipe, encoding="utf-8")
    return out


def _digest(path: Path | None) -> str:
    import hashlib

    if path is None:
        return ""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def flight_name(folder: Path) -> str:
    """The name that a flight's results go by."""
    return _safe(read_flight(folder).name)
