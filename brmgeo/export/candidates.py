"""A flight's candidates as points in time, for QGIS's temporal controller and for anything that reads GeoJSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.export import iso_utc, shown_until_ms, utc_ms
from brmgeo.export.qgis_style import add_default_styles, candidates_style, qml
from brmgeo.export.vector import epsg_of, lonlat, number, write_geojson, write_layer
from brmgeo.files import whole_file, write_text
from brmgeo.flight.values import Status

GEOJSON_LIMIT = 100_000


class CandidateFrame(NamedTuple):
    """One frame's candidates: time (s), (n, 2) float64 x, y in the map frame, (n,) float64 probability, status."""

    t_s: float
    xy: NDArray[np.float64]
    mass: NDArray[np.float64]
    status: Status


def write_candidates(
    out_dir: Path,
    frames: Sequence[CandidateFrame | tuple[float, NDArray[np.float64], NDArray[np.float64], Status]],
    crs: str,
    *,
    start_utc: datetime | None = None,
    geojson_limit: int = GEOJSON_LIMIT,
) -> Path:
    """Writes all frames' candidates and returns the file: ``candidates.geojson``, or ``candidates.gpkg`` above the limit.

    GeoJSON follows RFC 7946 (WGS84 longitude and latitude, 7 decimals, no ``crs`` member) and has ``candidates.qml``
    beside it; the GeoPackage (layer ``candidates``) stays in ``crs`` and carries its style. Properties: ``x``, ``y``
    (metres in ``crs``), ``epsg`` (null or 0 when it has no code), ``start`` and ``end`` (UTC; a frame ends 1 ms before
    the next one starts), ``t_s``, ``frame`` (from 0), ``mass`` and ``status``. ``frames`` are in order of time; see
    ``brmgeo.export.utc_ms`` for ``start_utc``.
    The other file of an earlier run is removed, so that the folder tells one story.

    Raises ValueError for frames out of order or arrays of different length, CrsError for points outside ``crs``.
    """
    all_frames = [CandidateFrame(*frame) for frame in frames]
    times = np.array([frame.t_s for frame in all_frames], dtype=np.float64)
    if (np.diff(times) < 0).any():
        raise ValueError("frames are not in order of time")
    for i, frame in enumerate(all_frames):
        if frame.xy.shape != (len(frame.mass), 2):
            raise ValueError(
                f"frame {i}: xy has shape {frame.xy.shape}, mass {frame.mass.shape}: want (n, 2) and (n,)"
            )
    starts = utc_ms(start_utc, times)
    ends = shown_until_ms(starts) if len(starts) else starts
    count = sum(len(frame.mass) for frame in all_frames)

    geojson, sidecar, gpkg = (out_dir / f"candidates.{suffix}" for suffix in ("geojson", "qml", "gpkg"))
    if count <= geojson_limit:
        write_geojson(geojson, "candidates", _features(all_frames, starts, ends, crs))
        write_text(sidecar, qml(candidates_style(), "Point"))
        gpkg.unlink(missing_ok=True)
        return geojson

    lengths = [len(frame.mass) for frame in all_frames]
    xy = np.concatenate([frame.xy for frame in all_frames])
    columns = {
        "x": xy[:, 0],
        "y": xy[:, 1],
        "epsg": np.full(count, epsg_of(crs) or 0, dtype=np.int32),
        "start": np.repeat(starts.astype("datetime64[ms]"), lengths),
        "end": np.repeat(ends.astype("datetime64[ms]"), lengths),
        "t_s": np.repeat(times, lengths),
        "frame": np.repeat(np.arange(len(all_frames), dtype=np.int32), lengths),
        "mass": np.concatenate([frame.mass for frame in all_frames]).astype(np.float64),
        "status": np.repeat(np.array([frame.status for frame in all_frames], dtype=object), lengths),
    }
    with whole_file(gpkg) as scratch:
        write_layer(scratch, "candidates", shapely.points(xy), "Point", crs, columns)
        add_default_styles(scratch, {"candidates": (candidates_style(), "Point")})
    geojson.unlink(missing_ok=True)
    sidecar.unlink(missing_ok=True)
    return gpkg


def _features(
    frames: Sequence[CandidateFrame], starts: NDArray[np.int64], ends: NDArray[np.int64], crs: str
) -> Iterator[str]:
    epsg = epsg_of(crs) or "null"
    for i, frame in enumerate(frames):
        if len(frame.mass) == 0:
            continue
        # What all candidates of a frame share is written once and pasted.
        tail = (
            f'"epsg":{epsg},"start":"{iso_utc(int(starts[i]))}","end":"{iso_utc(int(ends[i]))}",'
            f'"t_s":{number(frame.t_s, 3)},"frame":{i},"status":"{frame.status}","mass":'
        )
        degrees = lonlat(frame.xy, crs)
        for (lon, lat), (x, y), mass in zip(degrees.tolist(), frame.xy.tolist(), frame.mass.tolist()):
            yield (
                f'{{"type":"Feature","geometry":{{"type":"Point","coordinates":[{lon:.7f},{lat:.7f}]}},'
                f'"properties":{{"x":{x:.3f},"y":{y:.3f},{tail}{mass:.6g}}}}}'
            )
