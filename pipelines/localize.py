"""A flight located over a region's maps: readings and masks in, the matchers' answers out, and all result files."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from brmgeo.errors import FlightError, InputError, MissingInputError, SettingsError
from brmgeo.files import require_replaceable, whole_folder
from brmgeo.flight.checks import doubtful_axes, mirrored_m
from brmgeo.flight.folder import Flight
from brmgeo.flight.own import own_odometry
from brmgeo.flight.readings import Attitude, Reference
from brmgeo.geo.crs import apart
from brmgeo.geo.grid import as_bounds
from brmgeo.locate.flights import locate_flight
from brmgeo.locate.localizer import MIN_MOUNT_SIGMA_RAD
from brmgeo.locate.maps import match_settings, read_maps
from brmgeo.locate.masks import NetworkUse, frame_masks
from brmgeo.match import METHODS, MatchSettings
from brmgeo.region import FlightSettings
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import serial_map

from .flight_results import FlightResults, is_result, source_of, write_results


@dataclass(frozen=True, slots=True)
class Sensors:
    """What somebody knows of an aircraft's sensors, as standard deviations; None where nothing is known.

    Attributes:
        step_m, step_share: of an odometry step per axis: metres, and as a share of its length.
        compass_deg: of the compass.
        tilt_deg: of the mount's roll and pitch, in place of what the flight says.
    """

    step_m: float | None = None
    step_share: float | None = None
    compass_deg: float | None = None
    tilt_deg: float | None = None

    def settings(self, base: MatchSettings) -> MatchSettings:
        """A matcher's settings with what is known; SettingsError for a number out of range."""
        known = {
            "step_sigma_m": self.step_m,
            "step_sigma_share": self.step_share,
            "compass_sigma_rad": None if self.compass_deg is None else math.radians(self.compass_deg),
        }
        given = {name: value for name, value in known.items() if value is not None}
        return replace(base, odometry=replace(base.odometry, **given)) if given else base


def localize(
    maps_dir: Path,
    flight: Flight,
    method: str,
    out: Path,
    *,
    flight_settings: FlightSettings | None = None,
    compass: bool = False,
    sift: bool = False,
    max_speed_m_s: float | None = None,
    sensors: Sensors | None = None,
    network: NetworkUse | None = None,
    odometry: str = "auto",
    attribution: str = "",
) -> Path:
    """Locates a flight over built maps and writes all its results into ``out``; returns the report's path.

    A mount that is unknown is found first, and the flight located with it. A flight without odometry gets its own from its
    frames, where they are dense enough, unless ``odometry`` is "given".
    ``out`` is replaced as a whole, at the end: a run that fails leaves what was there. ``max_speed_m_s`` bounds the
    movement where odometry says nothing (default: the region's); ``sensors`` says what the sensors are worth. ``network``
    says where masks come from (default: the flight's own where it has some, else the network that ships with brmgeo).
    """
    if method not in METHODS:
        raise SettingsError(f"METHOD {method!r} is not known: choose one of {', '.join(METHODS)}")
    require_replaceable(
        out, "fixes.csv", "results of localize", lambda p: is_result(p) or ".qgz" in p.suffix, keeps=True
    )
    progress = Progress()
    maps = read_maps(maps_dir.absolute())
    if sift and maps.imagery is None:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there, and SIFT matches frames to imagery: do without it",
            needs="sift",
        )
    if sift and not flight.has_images:
        raise InputError(
            f"{flight.folder / 'frames'}: the flight has masks only, and SIFT needs frames: do without it",
            needs="sift",
        )
    if sensors is not None and sensors.tilt_deg is not None:
        flight = replace(flight, mount_sigma_rad=math.radians(sensors.tilt_deg))
    as_given, own = flight, flight_settings or FlightSettings()
    if max_speed_m_s is not None:
        own = own.model_copy(update={"max_speed_m_s": max_speed_m_s})
    settings = (sensors or Sensors()).settings(match_settings(own))
    if odometry == "auto":
        tried = own_odometry(flight, own.interval_s)
        flight = tried.flight
        if tried.says:
            progress.say(f"{flight.name} odometry: {tried.says}")
    if flight.odometry is not None and not flight.axes_told and (says := doubtful_axes(flight.odometry)):
        raise FlightError(f"{flight.folder}: {flight.odometry.source}: {says} (in [odometry] of flight.toml)")
    reference = flight.reference(maps.crs)
    if reference is not None:
        there = as_bounds((*np.nanmin(reference.xy_m, axis=0), *np.nanmax(reference.xy_m, axis=0)))
        # No fault: a flight off the map is one that localize must say "lost" of.
        if line := apart("reference", {flight.name: there}, "the maps", maps.bounds, maps.crs):
            progress.say(line)
        if flight.odometry is not None:
            _require_unmirrored(flight, reference)
    yaws = flight.compass_yaw_rad(maps.crs, *maps.middle) if compass else None
    if yaws is not None and all(yaw is None for yaw in yaws):
        raise InputError(
            f"{flight.folder / 'frames.csv'}: a compass is to be trusted, but there is no column yaw_deg: add it, or do "
            "without",
            needs="compass",
        )
    given, use = f"{source_of(flight)}: masks/ of the flight folder", network or NetworkUse()
    with frame_masks(flight, given, use, progress, maps.folder.name) as masks:
        with progress.stage(f"{flight.name} {method}") as bar:
            located = locate_flight(
                maps, flight, masks, method=method, settings=settings, compass_yaw_rad=yaws,
                mount_sigma_rad=flight.mount_sigma_rad, each=bar.watch(serial_map),
            )  # fmt: skip
        if located.found_mount is not None:
            # Odometry of the frames, and masks, were made with the other mount: all of it again with the one that was found.
            progress.say(_mount_line(flight, *located.found_mount))
            mount, sigma_rad = located.found_mount
            return localize(
                maps_dir,
                replace(as_given, mount=mount, mount_sigma_rad=sigma_rad),
                method,
                out,
                flight_settings=flight_settings,
                compass=compass,
                sift=sift,
                max_speed_m_s=max_speed_m_s,
                sensors=None if sensors is None else replace(sensors, tilt_deg=None),
                network=network,
                odometry=odometry,
                attribution=attribution,
            )
        if method == "mask" and flight.mount_sigma_rad >= MIN_MOUNT_SIGMA_RAD:
            progress.say(
                f"{flight.name}: the camera's mount, known to {math.degrees(flight.mount_sigma_rad):g} degrees, was not "
                "found: fixes are no surer than it is"
            )
        results = FlightResults(
            maps=maps,
            masks=masks,
            method=method,
            settings=settings,
            compass=compass,
            odometry=odometry,
            interval_s=own.interval_s,
            located=located,
            truth=None if reference is None else reference.at(flight.times_s),
            sift=sift,
            attribution=attribution,
        )
        with (
            whole_folder(out, say=progress.say, ours=is_result) as scratch,
            disk_errors(f"localize {flight.name}", out.absolute().parent),
        ):
            write_results(scratch, out, results)
    report = out / "report.html"
    progress.say(f"{flight.name} by {method}: {results.sentence}; report: {report}")
    return report


def _require_unmirrored(flight: Flight, reference: Reference) -> None:
    """FlightError where the odometry agrees with the reference only if it is mirrored."""
    assert flight.odometry is not None
    times = flight.times_s
    true, told = (
        reference.at(times),
        np.stack([np.interp(times, flight.odometry.t_s, v) for v in flight.odometry.xyz_m[:, :2].T], axis=-1),
    )
    known = np.isfinite(true).all(axis=1)
    if known.sum() < 10:
        return
    as_it_is, mirrored = mirrored_m(told[known], true[known])
    if as_it_is > 5.0 and mirrored < 0.25 * as_it_is:
        raise FlightError(
            f"{flight.folder}: the odometry is mirrored: {as_it_is:.0f} m from the reference after the best turn, scale and "
            f"shift, and {mirrored:.1f} m when mirrored; its z axis points down: say so with axes in [odometry] of "
            "flight.toml (nadir for a camera that looks down, else frd), or import it again with them"
        )


def _mount_line(flight: Flight, mount: Attitude, sigma_rad: float) -> str:
    roll, pitch, yaw = (math.degrees(v) for v in (mount.roll_rad, mount.pitch_rad, mount.yaw_rad))
    return (
        f"{flight.name}: the camera seems to look {abs(pitch):.1f} +- {math.degrees(sigma_rad):.1f} degrees "
        f"{'ahead' if pitch < 0 else 'behind'}: mount roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f}; give it as [mount] "
        "in flight.toml"
    )
