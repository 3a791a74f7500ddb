"""A simulated flight as a flight folder."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError
from brmgeo.flight.readings import FloatArray
from brmgeo.geo.crs import LONLAT, convergence_rad, transformer
from brmgeo.synth.flight.camera import Simulator, frame_name
from brmgeo.synth.flight.course import RATE_HZ, SENSORS, fly
from brmgeo.synth.flight.ground import Ground, Imagery
from brmgeo.synth.flight.sensors import imu_of, odometry_of
from brmgeo.synth.flight.settings import FlightSettings


def _toml(name: str, settings: FlightSettings, reference: str, altimeter: bool) -> str:
    camera, mount = settings.camera, settings.mount
    lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    lines = ["# Simulated by brmgeo: no real flight"]
    lines += [
        f"name = {json.dumps(name)}",
        "[camera]",
        f"width = {camera.width}",
        f"height = {camera.height}",
    ]
    lines += [f"{key} = {float(value)!r}" for key, value in lens.items()]
    if camera.is_distorted:
        lines.append(f"distortion = [{', '.join(repr(float(v)) for v in camera.distortion)}]")
    lines.append("[mount]")
    for key in ("roll", "pitch", "yaw"):
        lines.append(f"{key}_deg = {round(math.degrees(getattr(mount, key + '_rad')), 9)!r}")
    if settings.odometry is not None:
        lines += ["[odometry]", 'file = "odometry.tum"', 'format = "tum"']
    lines += ["[height]", 'source = "frames"']
    if altimeter:
        lines += ["[altimeter]", 'file = "altimeter.csv"']
    lines += ["[reference]", 'file = "reference.csv"', f"crs = {json.dumps(reference)}"]
    return "\n".join(lines) + "\n"


def _write_rows(
    path: Path, header: str, columns: Sequence[Any], formats: Sequence[str], separator: str = ","
) -> None:
    # One format call over all numbers: row by row it would be most of a masks-only flight's time.
    table = np.column_stack(columns)
    row = separator.join(formats) + "\n"
    path.write_text(
        header + (row * len(table)) % tuple(table.ravel().tolist()), encoding="utf-8", newline="\n"
    )


def simulate(
    out: Path | str,
    ground: Ground,
    path: FloatArray,
    crs: str,
    settings: FlightSettings | None = None,
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

    Raises InputError when ``out`` holds files already, or pictures are wanted without imagery.
    """
    out = Path(out)
    settings = settings or FlightSettings()
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
    count = len(course.frame_index)
    for i in range(count):
        if masks:
            image = simulator.mask(i, pictures if relief is None else relief)
            _write_image(
                out / "masks" / f"{Path(frame_name(i)).stem}.png", image, [cv2.IMWRITE_PNG_BILEVEL, 1]
            )
        if pictures:
            assert imagery is not None
            shown = simulator if relief is not False else replace(simulator, ground=_flat(ground))
            _write_image(
                out / "frames" / frame_name(i),
                shown.picture(i, imagery)[:, :, ::-1],
                [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality],
            )

    x, y = course.xyz_m[course.frame_index[0], :2]
    header = "t_s,file,agl_m,roll_deg,pitch_deg"
    columns: list[Any] = [
        course.frame_times_s,
        course.measured_agl_m,
        course.measured_roll_deg,
        course.measured_pitch_deg,
    ]
    formats = ["%.2f", "%.3f", "%.4f", "%.4f"]
    if course.measured_grid_heading_deg is not None:
        header += ",yaw_deg"
        convergence = math.degrees(convergence_rad(crs, float(x), float(y)))
        columns.append((course.measured_grid_heading_deg + convergence) % 360.0)
        formats.append("%.6f")
    rows = [[f % v for f, v in zip(formats, values)] for values in zip(*columns)]
    lines = [",".join([row[0], frame_name(i), *row[1:]]) for i, row in enumerate(rows)]
    (out / "frames.csv").write_text("\n".join([header, *lines]) + "\n", encoding="utf-8", newline="\n")

    if settings.odometry is not None:
        track = odometry_of(course, settings.odometry, seed)
        xyzw = [track.wxyz[:, k] for k in (1, 2, 3, 0)]
        values = [track.t_s, *track.xyz_m.T, *xyzw]
        _write_rows(out / "odometry.tum", "", values, ["%.6f"] + ["%.4f"] * 3 + ["%.17g"] * 4, " ")
    every = slice(None, None, RATE_HZ // 5)
    t, place_xy = course.t_s[every], course.xyz_m[every, :2]
    if lonlat:
        lon, lat = transformer(crs, LONLAT).transform(place_xy[:, 0], place_xy[:, 1])
        _write_rows(out / "reference.csv", "t_s,lon,lat\n", [t, lon, lat], ["%.2f", "%.9f", "%.9f"])
    else:
        _write_rows(out / "reference.csv", "t_s,x,y\n", [t, place_xy], ["%.2f", "%.4f", "%.4f"])
    if pictures:
        gyro, accel = imu_of(course, seed)
        values = [course.t_s, gyro, accel]
        _write_rows(
            out / "imu.csv", "t_s,gx,gy,gz,ax,ay,az\n", values, ["%.2f"] + ["%.7f"] * 3 + ["%.6f"] * 3
        )
        rng = np.random.default_rng([seed, SENSORS, 2])
        tenth = slice(None, None, RATE_HZ // 10)
        agl = course.xyz_m[tenth, 2]
        agl = agl + settings.agl_error_m * (rng.normal() + rng.normal(size=len(agl)))
        _write_rows(out / "altimeter.csv", "t_s,agl_m\n", [course.t_s[tenth], agl], ["%.2f", "%.3f"])
    toml = _toml(name or f"simulated-{seed}", settings, LONLAT if lonlat else crs, pictures)
    (out / "flight.toml").write_text(toml, encoding="utf-8", newline="\n")
    return out


def _flat(ground: Ground) -> Ground:
    return replace(ground, height_m=np.zeros_like(ground.height_m))


def _write_image(path: Path, image: NDArray[np.uint8], options: list[int]) -> None:
    ok, data = cv2.imencode(path.suffix, image, options)
    assert ok
    path.write_bytes(data.tobytes())
