"""What is in a log, bag, text of poses, folder of photos or flight folder, as lines for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import Geod

from brmgeo.errors import InputError, MissingExtraError
from brmgeo.flight import checks, frames
from brmgeo.flight.folder import MAX_MEDIAN_TILT_DEG, Flight, read_flight
from brmgeo.flight.logs import kind_of, read_log
from brmgeo.flight.logs.normal import axes_fault, faults_of, lag_s
from brmgeo.flight.logs.values import Log, LogOptions
from brmgeo.flight.motion import breaks
from brmgeo.flight.poses import AXES_UNTOLD
from brmgeo.flight.readings import FloatArray, Odometry
from brmgeo.geo.crs import LONLAT


def inspect(path: Path, options: LogOptions | None = None) -> list[str]:
    """What a log, bag, text of poses, folder of photos or flight folder holds, as lines for people.

    Raises the readers' errors only where nothing can be read; faults are told as lines.
    """
    options = replace(options or LogOptions(), any_topic=True)
    if kind_of(path) == "flight":
        return _inspect_flight(path)
    log = read_log(path, options)
    lines = [f"{path.name}: {log.title} ({log.kind})", f"  clock      {log.clock}"]
    tracks = [log.odometry] if log.odometry is not None else []
    for name in log.candidates[1:7] if options.topic is None and log.kind == "rosbag" else ():
        other = read_log(path, replace(options, topic=name)).odometry
        tracks += [other] if other is not None else []
    for track in tracks:
        lines += _track_lines(track, log)
    if not tracks:
        lines.append("  odometry   none")
    for first, second in [(a, b) for i, a in enumerate(tracks) for b in tracks[i + 1 :]]:
        lines += _agreement(first, second)
    if log.resets:
        shown = ", ".join(f"{what} at {t:.2f} s" for t, what in log.resets[:4])
        lines.append(f"  resets     {len(log.resets)} told by the log: {shown}")
    lines += [f"  dropouts   {line}" for line in dropouts(log)]
    if log.attitude is not None:
        tilt = checks.median_tilt_deg(log.attitude.wxyz)
        what = "of the camera" if log.attitude.of_camera else "of the body"
        north = ", heading from north" if log.attitude.north else ""
        lines.append(
            f"  attitude   {what}, {_span(log.attitude.t_s)}, median tilt {tilt:.1f} deg{north}; {log.attitude.source}"
        )
    if log.height is not None:
        low, high = log.height.agl_m.min(), log.height.agl_m.max()
        lines.append(
            f"  height     {low:.1f} to {high:.1f} m above {log.height.above}, {_span(log.height.t_s)}; {log.height.source}"
        )
    if log.imu is not None:
        lines += _imu_lines(log)
    if log.gnss is not None:
        lines += _gnss_lines(log)
    if log.frames is not None:
        f = log.frames
        lines.append(f"  frames     {len(f.t_s)} of {f.size[0]} x {f.size[1]}, {_span(f.t_s)}; {f.source}")
    elif log.triggers_s is not None:
        lines.append(f"  triggers   {len(log.triggers_s)} of a camera")
    if log.camera is not None:
        short = 2.0 * math.degrees(math.atan(log.camera.half_fov_tan))
        lines.append(
            f"  camera     {log.camera.fx:.0f} px focal length, {short:.1f} deg across the short side"
        )
    for name, offset in log.stamp_offset_s:
        if abs(offset) > 1.0:
            lines.append(f"  stamps     {name}: {offset:+.3f} s against the recorder's clock")
    lines += [f"  note       {note}" for note in log.notes]
    lines += [f"  FAULT      {fault}" for fault in (*log.faults, *(f.says for f in faults_of(log)))]
    return lines


def dropouts(log: Log) -> list[str]:
    """What a log lost, in a line; none where it lost nothing."""
    if not log.lost:
        return []
    total, longest = sum(d for _, d in log.lost), max(log.lost, key=lambda d: d[1])
    return [
        f"{len(log.lost)} dropouts, {total:.3f} s lost in all, the longest {longest[1]:.3f} s at {longest[0]:.3f} s: "
        "the logger could not keep up"
    ]


def _span(t_s: FloatArray) -> str:
    if len(t_s) < 2:
        return f"one at {t_s[0]:.3f} s" if len(t_s) else "none"
    median = float(np.median(np.diff(t_s)))
    gaps = int((np.diff(t_s) > max(1.0, 4.0 * median)).sum())
    holes = f", {gaps} gaps (longest {np.diff(t_s).max():.1f} s)" if gaps else ""
    rate = f"{1.0 / median:.1f} Hz" if median < 1.0 else f"every {median:.1f} s"
    return f"{len(t_s)} in {t_s[-1] - t_s[0]:.1f} s, {rate}{holes}"


def _track_lines(track: Odometry, log: Log) -> list[str]:
    starts, ends = breaks(track, 1.0, 60.0)
    tilt = checks.median_tilt_deg(track.wxyz)
    broken = len(starts)
    extent = " x ".join(f"{v:.1f}" for v in np.ptp(track.xyz_m, axis=0))
    end = float(np.linalg.norm(track.xyz_m[-1] - track.xyz_m[0]))
    lines = [
        f"  odometry   {track.source}: {_span(track.t_s)}",
        f"             {checks.length_m(track):.1f} m long, extent {extent} m (x, y, z), end {end:.1f} m from its start"
        + (
            f"; {broken} gaps or resets, the first {starts[0]:.3f} to {ends[0]:.3f} s"
            if broken
            else "; whole"
        ),
        f"             body up {_axis(frames.up_in_body(track.wxyz))}, median tilt {tilt:.0f} deg",
    ]
    if checks.median_tilt_deg(track.wxyz) > MAX_MEDIAN_TILT_DEG or checks.flat_axis(track.xyz_m) in (0, 1):
        if checks.flat_axis(track.xyz_m) == 1 and checks.median_tilt_deg(track.wxyz) < MAX_MEDIAN_TILT_DEG:
            lines.append(
                "             its height seems to run along y, as in a camera's axes: import with axes optical"
            )
        elif checks.median_tilt_deg(track.wxyz) > MAX_MEDIAN_TILT_DEG:
            lines.append(f"             {axes_fault(track).says}")
    elif log.kind in AXES_UNTOLD and (says := checks.doubtful_axes(track)):
        lines.append(f"             {says}")
    if log.gnss is not None and log.odometry is track:
        fit = _against_gnss(log, track)
        if fit is not None:
            lines.append(f"             against GNSS {fit:.2f} m RMS after the best turn and shift")
    return lines


def _axis(up: FloatArray) -> str:
    length = float(np.linalg.norm(up))
    axis = int(np.abs(up).argmax())
    return f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]} ({length:.3f} steady)"


def gnss_track(log: Log) -> Odometry | None:
    """The GNSS positions of a log as a track about their first: metres east and north by azimuth and distance, and up."""
    g = log.gnss
    if g is None or len(g.t_s) < 2:
        return None
    n = len(g.t_s)
    first = np.full(n, g.lon_deg[0]), np.full(n, g.lat_deg[0])
    azimuth_deg, _, distance_m = Geod(ellps="WGS84").inv(*first, g.lon_deg, g.lat_deg)
    east, north = distance_m * np.sin(np.radians(azimuth_deg)), distance_m * np.cos(np.radians(azimuth_deg))
    up = np.where(np.isfinite(g.alt_m), g.alt_m, 0.0)
    return Odometry(
        g.t_s, np.stack([east, north, up - up[0]], axis=-1), np.tile([1.0, 0, 0, 0], (n, 1)), "GNSS"
    )


def _against_gnss(log: Log, track: Odometry) -> float | None:
    fixes = gnss_track(log)
    fit = None if fixes is None else checks.agreement_m(track, fixes)
    return None if fit is None else fit[0]


def _agreement(first: Odometry, second: Odometry) -> list[str]:
    fit = checks.agreement_m(first, second, scale=True)
    if fit is None:
        return []
    return [
        f"  agree      {second.source} on {first.source}: {fit[0]:.2f} m RMS over {fit[2]:.0f} s, scale {fit[1]:.3f}"
    ]


def _imu_lines(log: Log) -> list[str]:
    assert log.imu is not None
    mean = log.imu.accel_m_s2.mean(axis=0)
    reference = log.odometry or log.attitude
    gyro, accel = checks.imu_units(log.imu, *((reference.t_s, reference.wxyz) if reference else (None, None)))
    lag = lag_s(log)
    late = (
        ""
        if lag is None
        else f", {lag * 1e3:+.0f} ms against the turns of {reference.source if reference else ''}"
    )
    pull = ", ".join(f"{v:.2f}" for v in mean)
    return [
        f"  imu        {_span(log.imu.t_s)}; mean acceleration ({pull}); "
        f"looks like {accel or 'unknown units'}, {gyro or 'rad/s or too calm to tell'}{late}"
    ]


def _gnss_lines(log: Log) -> list[str]:
    g = log.gnss
    track = gnss_track(log)
    assert g is not None
    far = "" if track is None else f", {np.linalg.norm(np.ptp(track.xyz_m[:, :2], axis=0)):.0f} m across"
    known = g.sigma_m[np.isfinite(g.sigma_m)]
    sigma = f", accuracy {np.median(known):.2f} m" if known.size else ", accuracy not told"
    return [
        f"  gnss       {_span(g.t_s)}, about {g.lat_deg.mean():.5f} N {g.lon_deg.mean():.5f} E{far}{sigma}"
    ]


def _inspect_flight(path: Path) -> list[str]:
    flight = read_flight(path)
    t = flight.times_s
    agl = np.array([f.agl_m for f in flight.frames])
    short = 2.0 * math.degrees(math.atan(flight.camera.half_fov_tan))
    held = " and ".join(
        w for w, there in (("images", flight.has_images), ("masks", flight.has_masks)) if there
    )
    lines = [
        f"{path.name}: flight folder {flight.name!r}",
        f"  frames     {_span(t)}, {held}",
        f"  camera     {flight.camera.width} x {flight.camera.height}, {short:.1f} deg across the short side",
        f"  height     {agl.min():.1f} to {agl.max():.1f} m above ground",
    ]
    log = Log("flight", flight.name, "the flight's own", flight.odometry, imu=flight.imu())
    lines += _track_lines(flight.odometry, log) if flight.odometry is not None else ["  odometry   none"]
    if log.imu is not None:
        lines += _imu_lines(log)
    lines.append(f"  reference  {_where(flight)}")
    return lines + [f"  FAULT      {fault.says}" for fault in faults_of(log)]


def _where(flight: Flight) -> str:
    try:
        reference = flight.reference(LONLAT)
    except InputError as error:
        return f"cannot be used: {error}"
    if reference is None:
        return "none: nothing here says where it was flown"
    lon, lat = reference.xy_m.mean(axis=0)
    told = "" if reference.sigma_m is None else f", accuracy {np.median(reference.sigma_m):.2f} m"
    return f"{_span(reference.t_s)}, about {lat:.5f} N {lon:.5f} E{told}"


def pairs(paths: Sequence[Path], options: LogOptions | None = None) -> list[str]:
    """How well logs of the same minutes agree, a line a pair; nothing for logs of different flights."""
    tracks = []
    for path in paths:
        try:
            log = read_log(path, replace(options or LogOptions(), any_topic=True))
        except (InputError, MissingExtraError):
            continue
        if log.odometry is not None and log.clock.startswith("Unix"):
            tracks.append(replace(log.odometry, source=path.name))
    out: list[str] = []
    for i, first in enumerate(tracks):
        for second in tracks[i + 1 :]:
            out += [line.replace("  agree      ", "") for line in _agreement(first, second)]
    return out
