"""A simulated flight as a flight folder."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from brmgeo.errors import FlightError, InputError, SettingsError
from brmgeo.flight.folder import read_flight
from brmgeo.flight.readings import FloatArray, Frame, Reference
from brmgeo.flight.write import FlightParts, rounded, write_flight, write_mask, write_picture
from brmgeo.geo.crs import LONLAT, convergence_rad, transformer
from brmgeo.synth.flight.camera import Simulator, frame_name
from brmgeo.synth.flight.course import RATE_HZ, Course, fly
from brmgeo.synth.flight.ground import Imagery, RaisedFootprints
from brmgeo.synth.flight.sensors import altimeter_of, imu_of, odometry_of
from brmgeo.synth.flight.settings import SimulationSettings


def simulate(
    out: Path | str,
    ground: RaisedFootprints,
    path: FloatArray,
    crs: str,
    settings: SimulationSettings | None = None,
    seed: int = 0,
    *,
    mode: Literal["masks", "frames", "both"] = "masks",
    imagery: Imagery | None = None,
    relief: bool | None = None,
    lonlat: bool = False,
    name: str | None = None,
) -> Path:
    """Writes the flight folder ``out`` and returns it; the same arguments give the same bytes.

    Args:
        out: a folder that is not there yet, or empty.
        ground, path: as for ``simulate_views``, in ``crs``.
        mode: ``masks`` writes masks/ only (no network is needed to localize the flight), ``frames`` pictures
            rendered from ``imagery`` with imu.csv and altimeter.csv, ``both`` all of it.
        relief: roofs stand where their height puts them; default: in pictures and the masks that go with them.
        lonlat: write the reference as longitude and latitude, else as x, y in ``crs``.

    Raises InputError when ``out`` holds files already, or pictures are wanted without imagery; SettingsError for settings
    out of range, or of which a flight comes that ``read_flight`` refuses (nothing is left in ``out`` then).
    """
    out = Path(out)
    settings = settings or SimulationSettings()
    if mode != "masks" and imagery is None:
        raise InputError(f"mode {mode!r} draws pictures and needs imagery: give some, or choose mode 'masks'")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"{out}: a simulated flight needs a new or empty folder: remove it or choose another"
        )
    course = fly(path, settings, seed)
    simulator = Simulator(ground, settings, course, seed)
    out.mkdir(parents=True, exist_ok=True)
    pictures, masks = mode in ("frames", "both"), mode in ("masks", "both")
    for folder, wanted in (("frames", pictures), ("masks", masks)):
        if wanted:
            (out / folder).mkdir()
    for i in range(len(course.frame_index)):
        if masks:
            write_mask(out, frame_name(i), simulator.mask(i, pictures if relief is None else relief))
        if pictures:
            assert imagery is not None
            shown = simulator if relief is not False else replace(simulator, ground=_flat(ground))
            write_picture(out, frame_name(i), shown.picture(i, imagery), quality=settings.jpeg_quality)
    parts = FlightParts(
        name=name or f"simulated-{seed}",
        simulated=True,
        camera=settings.camera,
        mount=settings.known_mount,
        frames=_frames(course, crs),
        odometry=None if settings.odometry is None else odometry_of(course, settings.odometry, seed),
        imu=imu_of(course, seed) if pictures else None,
        altimeter=altimeter_of(course, settings, seed) if pictures else None,
        reference=_reference(course, crs, lonlat),
        reference_crs=LONLAT if lonlat else crs,
    )
    write_flight(out, rounded(parts))
    try:
        read_flight(out)
    except FlightError as error:
        shutil.rmtree(out)
        told = str(error).replace(f"{out}{os.sep}", "")
        raise SettingsError(
            f"the simulated flight {parts.name} could not be read again ({told}): choose settings nearer to a real flight's"
        ) from None
    return out


def _frames(course: Course, crs: str) -> tuple[Frame, ...]:
    headings: list[float | None] = [None] * len(course.frame_index)
    if course.measured_grid_heading_deg is not None:
        x, y = course.xyz_m[course.frame_index[0], :2]
        convergence = math.degrees(convergence_rad(crs, float(x), float(y)))
        headings = ((course.measured_grid_heading_deg + convergence) % 360.0).tolist()
    t, agl = course.frame_times_s, course.measured_agl_m
    roll, pitch = np.radians(course.measured_roll_deg), np.radians(course.measured_pitch_deg)
    return tuple(
        Frame(float(t[i]), frame_name(i), float(agl[i]), float(roll[i]), float(pitch[i]), heading)
        for i, heading in enumerate(headings)
    )


def _reference(course: Course, crs: str, lonlat: bool) -> Reference:
    every = slice(None, None, RATE_HZ // 5)
    t, xy = course.t_s[every], course.xyz_m[every, :2]
    if lonlat:
        xy = np.stack(transformer(crs, LONLAT).transform(xy[:, 0], xy[:, 1]), axis=-1)
    return Reference(t, xy)


def _flat(ground: RaisedFootprints) -> RaisedFootprints:
    return replace(ground, height_m=np.zeros_like(ground.height_m))
