"""A flight's path out: fixes.csv, GeoJSON, GeoPackage with styles, and TUM with its sidecar."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.export import iso_utc, qgis_style, shown_until_ms, utc_ms
from brmgeo.export.vector import epsg_of, lonlat, number, write_geojson, write_layer
from brmgeo.files import plain_cell, whole_file, write_text
from brmgeo.flight.values import Estimate
from brmgeo.geo.crs import parse_crs

FIXES_HEADER = (
    *("t_s", "file", "status", "x", "y", "lon", "lat"),
    *("sigma_m", "yaw_deg", "heading_deg", "candidates", "mass"),
)


@dataclass(frozen=True, slots=True)
class TimedPath:
    """Positions in order of time.

    Attributes:
        t_s: (n,) float64 seconds of the flight's clock, not decreasing.
        xy: (n, 2) float64 x, y in the map frame, metres.
        yaw_rad: (n,) float64 yaw of the body in the map, counter-clockwise from east; NaN or None: unknown.
        sigma_m: (n,) float64 standard deviation of one axis, metres; NaN or None: unknown.
        z_m: (n,) float64 height, metres, of the reference that the writer is told. None: unknown.
        segment: (n,) int that changes where the path is broken: no line is drawn across. None: it is whole.
    """

    t_s: NDArray[np.float64]
    xy: NDArray[np.float64]
    yaw_rad: NDArray[np.float64] | None = None
    sigma_m: NDArray[np.float64] | None = None
    z_m: NDArray[np.float64] | None = None
    segment: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        n = len(self.t_s)
        shapes = [a.shape for a in (self.yaw_rad, self.sigma_m, self.z_m, self.segment) if a is not None]
        if self.xy.shape != (n, 2) or any(shape != (n,) for shape in shapes):
            raise ValueError(
                f"a track of {n} times needs xy ({n}, 2) and the others ({n},): {self.xy.shape}, {shapes}"
            )
        if (np.diff(self.t_s) < 0).any():
            raise ValueError("a track's times must not decrease")

    @property
    def pieces(self) -> list[slice]:
        """The unbroken stretches, in order of time."""
        n = len(self.t_s)
        cuts = [] if self.segment is None else (np.flatnonzero(np.diff(self.segment)) + 1).tolist()
        return [slice(a, b) for a, b in itertools.pairwise([0, *cuts, n])] if n else []

    def or_nan(self, name: str) -> NDArray[np.float64]:
        """``yaw_rad``, ``sigma_m`` or ``z_m``, all NaN where the track has none."""
        values: NDArray[np.float64] | None = getattr(self, name)
        return np.full(len(self.t_s), np.nan) if values is None else values


def write_trajectory(
    out_dir: Path,
    estimates: Sequence[Estimate],
    files: Sequence[str],
    crs: str,
    *,
    start_utc: datetime | None = None,
    smoothed: TimedPath | None = None,
    reference: TimedPath | None = None,
    z_m: NDArray[np.float64] | None = None,
    height_reference: str = "",
) -> list[Path]:
    """Writes a flight's path in all its forms into ``out_dir`` and returns the files.

    ``fixes.csv`` one row a frame; ``trajectory.geojson`` and ``trajectory.gpkg`` with the online fixes (converged ones
    only), the smoothed path and the reference; ``trajectory.tum`` with ``trajectory.json``: the smoothed path, or the
    converged fixes where there is none. ``estimates`` are in order of time, ``files`` are the frames' names; ``crs`` is
    the map's. ``z_m`` (n,) is the height at each estimate and ``height_reference`` says above what ("ground").

    Raises ValueError when lengths differ or times decrease, CrsError for points outside ``crs``.
    """
    if len(files) != len(estimates):
        raise ValueError(f"{len(estimates)} estimates, but {len(files)} file names")
    geojson, gpkg = out_dir / "trajectory.geojson", out_dir / "trajectory.gpkg"
    written = [write_fixes(out_dir / "fixes.csv", estimates, files, crs)]
    written.append(write_path_geojson(geojson, estimates, crs, start_utc, smoothed, reference))
    written.append(write_path_gpkg(gpkg, estimates, files, crs, start_utc, smoothed, reference))
    track, name = (
        (smoothed, "smoothed") if smoothed is not None else (converged_track(estimates, z_m), "online")
    )
    written += write_tum(
        out_dir / "trajectory.tum",
        track,
        crs,
        path_name=name,
        start_utc=start_utc,
        height_reference=height_reference,
    )
    return written


def converged_track(estimates: Sequence[Estimate], z_m: NDArray[np.float64] | None = None) -> TimedPath:
    """The fixes of the converged estimates; ``z_m`` (n,) float64 is the height at each of all the estimates."""
    keep = [i for i, e in enumerate(estimates) if e.position is not None]
    places = [estimates[i].position or (0.0, 0.0, 0.0) for i in keep]
    return TimedPath(
        np.array([estimates[i].t_s for i in keep], dtype=np.float64),
        np.array([p[:2] for p in places], dtype=np.float64).reshape(-1, 2),
        np.array([estimates[i].yaw_rad for i in keep], dtype=np.float64),
        np.array([p[2] for p in places], dtype=np.float64),
        None if z_m is None else np.asarray(z_m, dtype=np.float64)[keep],
    )


def write_fixes(path: Path, estimates: Sequence[Estimate], files: Sequence[str], crs: str) -> Path:
    """``fixes.csv``: ``FIXES_HEADER`` and the ``fixes_rows``; ``path`` is returned."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(FIXES_HEADER)
    writer.writerows(fixes_rows(estimates, files, crs))
    write_text(path, buffer.getvalue())
    return path


def fixes_rows(estimates: Sequence[Estimate], files: Sequence[str], crs: str) -> list[tuple[str, ...]]:
    """One row of ``FIXES_HEADER`` a frame, as FLIGHT.md says.

    ``x, y, lon, lat`` are empty unless the status is converged; whatever is not known (NaN) is empty too. ``yaw_deg`` is
    counter-clockwise from east in [-180, 180), ``heading_deg`` clockwise from grid north in [0, 360). ``file`` is a
    ``plain_cell``.
    """
    track = converged_track(estimates)
    degrees = iter(lonlat(track.xy, crs)) if len(track.t_s) else iter(())
    rows = []
    for estimate, file in zip(estimates, files, strict=True):
        place = ["", "", "", ""]
        if estimate.position is not None:
            lon, lat = next(degrees)
            place = [f"{estimate.mean[0]:.3f}", f"{estimate.mean[1]:.3f}", f"{lon:.7f}", f"{lat:.7f}"]
        sigma = math.sqrt(max(float(np.trace(estimate.covariance)) / 2.0, 0.0))
        yaw, heading = _angles(estimate.yaw_rad)
        mass = f"{estimate.mass:.6g}" if math.isfinite(estimate.mass) else ""
        rows.append(
            (
                _time(estimate.t_s),
                plain_cell(file),
                estimate.status,
                *place,
                _text(sigma, 3),
                _text(yaw, 3),
                _text(heading, 3),
                str(estimate.candidate_count),
                mass,
            )
        )
    return rows


def write_path_geojson(
    path: Path,
    estimates: Sequence[Estimate],
    crs: str,
    start_utc: datetime | None = None,
    smoothed: TimedPath | None = None,
    reference: TimedPath | None = None,
) -> Path:
    """``trajectory.geojson`` (RFC 7946): lines of each path, then points with their time, status and sigma.

    The property ``path`` says which: ``online``, ``smoothed`` or ``reference``. The online line is cut where frames
    in between did not converge. ``path`` is returned.
    """
    write_geojson(path, "trajectory", _path_features(estimates, crs, start_utc, smoothed, reference))
    return path


def _tracks(
    estimates: Sequence[Estimate], smoothed: TimedPath | None, reference: TimedPath | None
) -> list[tuple[str, TimedPath, list[slice]]]:
    # Name, points and unbroken stretches of each path that there is.
    whole = (("smoothed", smoothed), ("reference", reference))
    online = ("online", converged_track(estimates), _runs(estimates))
    return [online, *((name, track, track.pieces) for name, track in whole if track is not None)]


def _path_features(
    estimates: Sequence[Estimate],
    crs: str,
    start_utc: datetime | None,
    smoothed: TimedPath | None,
    reference: TimedPath | None,
) -> Iterator[str]:
    epsg = epsg_of(crs) or "null"
    tracks = _tracks(estimates, smoothed, reference)
    degrees = {name: lonlat(track.xy, crs) for name, track, _ in tracks if len(track.t_s)}
    for name, track, runs in tracks:
        for run in runs:
            if len(track.t_s[run]) < 2:
                continue
            coordinates = ",".join(f"[{lon:.7f},{lat:.7f}]" for lon, lat in degrees[name][run].tolist())
            stamps = utc_ms(start_utc, track.t_s[run])
            yield (
                f'{{"type":"Feature","geometry":{{"type":"LineString","coordinates":[{coordinates}]}},'
                f'"properties":{{"path":"{name}","epsg":{epsg},"start":"{iso_utc(int(stamps[0]))}",'
                f'"end":"{iso_utc(int(stamps[-1]))}"}}}}'
            )
    for name, track, _ in tracks:
        if name == "reference" or not len(track.t_s):
            continue
        starts, ends = _spans(track, estimates if name == "online" else None, start_utc)
        status = '"converged"' if name == "online" else "null"
        for i, (lon, lat) in enumerate(degrees[name].tolist()):
            yaw, heading = _angles(float(track.or_nan("yaw_rad")[i]))
            yield (
                f'{{"type":"Feature","geometry":{{"type":"Point","coordinates":[{lon:.7f},{lat:.7f}]}},'
                f'"properties":{{"path":"{name}","t_s":{number(float(track.t_s[i]), 3)},"status":{status},'
                f'"sigma_m":{number(float(track.or_nan("sigma_m")[i]), 3)},"yaw_deg":{number(yaw, 3)},'
                f'"heading_deg":{number(heading, 3)},"x":{track.xy[i, 0]:.3f},"y":{track.xy[i, 1]:.3f},"epsg":{epsg},'
                f'"start":"{iso_utc(int(starts[i]))}","end":"{iso_utc(int(ends[i]))}"}}}}'
            )


def write_path_gpkg(
    path: Path,
    estimates: Sequence[Estimate],
    files: Sequence[str],
    crs: str,
    start_utc: datetime | None = None,
    smoothed: TimedPath | None = None,
    reference: TimedPath | None = None,
) -> Path:
    """``trajectory.gpkg`` in ``crs``: points in ``online``, ``smoothed`` and ``reference``, lines in ``*_path``; returned.

    Points carry their time span (``start``, ``end``, UTC), ``t_s``, ``sigma_m``, ``yaw_deg``, ``heading_deg``; the online
    ones also frame, file, status and mass. Layers of paths that are not there, or of lines of fewer than two points, are
    left out, but ``online`` always is there. The styles make QGIS's temporal controller play the points.
    """
    kept = [i for i, e in enumerate(estimates) if e.position is not None]
    tracks = _tracks(estimates, smoothed, reference)
    styles: dict[str, tuple[qgis_style.Style, str]] = {}
    with whole_file(path) as scratch:
        for name, track, runs in tracks:
            starts, ends = _spans(track, estimates if name == "online" else None, start_utc)
            angles = np.array([_angles(float(y)) for y in track.or_nan("yaw_rad")], dtype=np.float64).reshape(
                -1, 2
            )
            columns: dict[str, NDArray[Any]] = {
                "start": starts.astype("datetime64[ms]"),
                "end": ends.astype("datetime64[ms]"),
                "t_s": track.t_s,
                "sigma_m": track.or_nan("sigma_m"),
                "yaw_deg": angles[:, 0],
                "heading_deg": angles[:, 1],
            }
            if name == "online":
                columns |= {
                    "frame": np.array(kept, dtype=np.int32),
                    "file": np.array([files[i] for i in kept], dtype=object),
                    "status": np.array([estimates[i].status for i in kept], dtype=object),
                    "mass": np.array([estimates[i].mass for i in kept], dtype=np.float64),
                }
            write_layer(scratch, name, shapely.points(track.xy), "Point", crs, columns)
            points_look, line_look = qgis_style.track_styles(name)
            styles[name] = (points_look, "Point")
            lines = [track.xy[run] for run in runs if len(track.t_s[run]) >= 2]
            if lines:
                geometry = np.array([shapely.linestrings(xy) for xy in lines], dtype=object)
                length = {"length_m": shapely.length(geometry)}
                write_layer(scratch, f"{name}_path", geometry, "LineString", crs, length)
                styles[f"{name}_path"] = (line_look, "Line")
        qgis_style.add_default_styles(scratch, styles)
    return path


def write_tum(
    path: Path,
    track: TimedPath,
    crs: str,
    *,
    path_name: str,
    start_utc: datetime | None = None,
    height_reference: str = "",
) -> list[Path]:
    """TUM (``t x y z qx qy qz qw``, metres in ``crs``, nothing subtracted) and the JSON sidecar that explains it.

    The quaternion turns the body (FLU) into the map (ENU) and holds yaw alone. TUM has no word for unknown: a height
    that is not known is written as 0 and a yaw that is not known as the identity; the sidecar says which rows.
    """
    z = track.or_nan("z_m")
    yaw = track.or_nan("yaw_rad")
    z_known, yaw_known = np.isfinite(z), np.isfinite(yaw)
    z, yaw = np.where(z_known, z, 0.0), np.where(yaw_known, yaw, 0.0)
    qz, qw = np.sin(yaw / 2.0), np.cos(yaw / 2.0)
    rows = np.column_stack([track.t_s, track.xy, z, np.zeros_like(z), np.zeros_like(z), qz, qw])
    text = "".join(
        "{:.6f} {:.4f} {:.4f} {:.4f} {:.9f} {:.9f} {:.9f} {:.9f}\n".format(*row) for row in rows.tolist()
    )
    facts = {
        "file": path.name,
        "path": path_name,
        "columns": ["t", "x", "y", "z", "qx", "qy", "qz", "qw"],
        "epsg": epsg_of(crs),
        "crs": parse_crs(crs).name,
        "origin": [0.0, 0.0, 0.0],
        "units": "seconds, metres",
        "time": f"seconds after {iso_utc(int(utc_ms(start_utc, np.zeros(1))[0]))}",
        "height_reference": height_reference if z_known.any() else "",
        "map_frame": "ENU: x easting, y northing, z up",
        "body_frame": "FLU: x forward, y left, z up",
        "quaternion": "xyzw, map from body, yaw only, counter-clockwise from east",
        "rows": len(track.t_s),
        "rows_without_height": np.flatnonzero(~z_known).tolist() if z_known.any() else "all",
        "rows_without_yaw": np.flatnonzero(~yaw_known).tolist(),
    }
    sidecar = path.with_suffix(".json")
    write_text(path, text)
    write_text(sidecar, json.dumps(facts, indent=2, ensure_ascii=False) + "\n")
    return [path, sidecar]


def _runs(estimates: Sequence[Estimate]) -> list[slice]:
    """Slices of the converged fixes whose frames follow one another without one that did not converge."""
    runs: list[slice] = []
    begin = count = 0
    for estimate in estimates:
        if estimate.position is not None:
            count += 1
        elif count > begin:
            runs.append(slice(begin, count))
            begin = count
    return [*runs, slice(begin, count)] if count > begin else runs


def _spans(
    track: TimedPath, estimates: Sequence[Estimate] | None, start_utc: datetime | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last millisecond of each point. An online fix ends with its frame, not with the next fix."""
    if estimates is None:
        starts = utc_ms(start_utc, track.t_s)
        return starts, shown_until_ms(starts) if len(starts) else starts
    starts = utc_ms(start_utc, np.array([e.t_s for e in estimates], dtype=np.float64))
    ends = shown_until_ms(starts) if len(starts) else starts
    keep = np.array([e.position is not None for e in estimates], dtype=bool)
    return starts[keep], ends[keep]


def _angles(yaw_rad: float) -> tuple[float, float]:
    """(yaw_deg in [-180, 180), heading_deg in [0, 360)), rounded as they are written; NaN for NaN."""
    if not math.isfinite(yaw_rad):
        return math.nan, math.nan
    degrees = round(math.degrees(yaw_rad), 3)
    return (degrees + 180.0) % 360.0 - 180.0, (90.0 - degrees) % 360.0


def _time(t_s: float) -> str:
    return f"{t_s:.6f}".rstrip("0").rstrip(".")


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
