"""Embedded odometry of a flight folder: ``brmgeo odometry flight/`` writes the track, what it is worth, and facts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.files import digest, whole_files, whole_folder
from brmgeo.flight.folder import MADE_BY, is_own_odometry, read_flight
from brmgeo.flight.own import OdometryMethod, estimate, thinned_rows
from brmgeo.flight.write import copy_thinned, name_track, rounded_track, write_facts, write_track
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.progress import Progress


def method_named(name: str) -> OdometryMethod:
    """The method of a name; InputError for another one."""
    if name not in ("auto", "vio", "planar"):
        raise InputError(f"method {name!r} is not known: choose auto, vio or planar")
    return name  # type: ignore[return-value]


def make_odometry(flight_dir: Path, method: OdometryMethod = "auto") -> dict[str, Any]:
    """Makes a flight's odometry and writes it into its folder; returns the facts.

    ``odometry.tum`` (poses), ``odometry.covariance.csv`` (what they are worth), ``odometry.json`` (facts); flight.toml gets
    an [odometry] section, so that localize reads them. A flight that came with odometry of its own keeps it: then the
    names begin with ``embedded`` and flight.toml stays as it is. A run that is killed leaves a folder that the next one
    mends: the facts come first and tell whose the files are, flight.toml last. A track that somebody changed since it was
    written there is set aside.
    """
    ours = is_own_odometry(flight_dir)
    flight = read_flight(flight_dir, with_odometry=not ours)
    stem = "odometry" if flight.odometry is None else "embedded"
    made = estimate(flight, method)
    facts = made.facts | {"track": f"{stem}.tum", "covariance": f"{stem}.covariance.csv"}
    columns: dict[str, NDArray[Any]] = {
        "yaw_sigma_deg": np.round(np.degrees(made.yaw_sigma_rad), 4),
        "tracks": made.tracks,
        "blind": made.blind,
    }
    track = rounded_track(made.odometry)
    track = replace(track, wxyz=np.round(track.wxyz, 9))
    names = (f"{stem}.json", facts["track"], facts["covariance"])
    with whole_files(flight_dir, names, Progress().say) as work:
        section = write_track(work, track, stem=stem, columns=columns)
        # A run that is killed between the two leaves a new track beside old covariance: whoever reads them can tell.
        facts["sha256"] = {name: digest(work / name) for name in names[1:]}
        write_facts(work, stem, facts)
    name_track(flight_dir, section, MADE_BY)
    return facts


def thin_flight(flight_dir: Path, out: Path, every_s: float) -> Path:
    """A flight folder with a frame every ``every_s`` seconds and the whole odometry: what a matcher wants of a video.

    Pictures and masks are copied as they are. Raises InputError for a video flight, whose frames are no files, for an
    interval that is not positive, and for a folder that holds something already. ``out`` comes into being whole, or not.
    """
    if not every_s > 0:
        raise InputError(f"every {every_s} s: give seconds, more than 0", needs="every_s")
    flight = read_flight(flight_dir)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: the thinned flight needs a new or empty folder")
    with whole_folder(out) as work, disk_errors(f"odometry --thin {out}", out.absolute().parent):
        copy_thinned(flight, [int(i) for i in thinned_rows(flight.times_s, every_s)], work)
        read_flight(work)
    return out


def summary(facts: dict[str, Any]) -> list[str]:
    """What a person wants to know of the track, line by line."""
    lines = [
        f"{facts['track']}: {facts['poses']} poses, {facts['length_m']:.0f} m in {facts['seconds']:.0f} s "
        f"by {facts['method']}, "
        f"{facts['blind_frames']} blind, {facts['segments']} segment(s), median {facts['median_tracks']:.0f} points, "
        f"sigma of the steps {facts['sigma_m_gathered']:.1f} m in all, {facts['frames_per_second']:.0f} frames/s"
    ]
    return lines + [f"note: {w}" for w in facts["warnings"]]
