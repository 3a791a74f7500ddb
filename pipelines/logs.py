"""Logs to flight folders, and what is in a log: ``brmgeo import`` and ``brmgeo inspect``."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError, InputError, SettingsError
from brmgeo.flight import checks, frames
from brmgeo.flight.folder import MAX_AGL_M, MAX_MEDIAN_TILT_DEG, MIN_AGL_M, Flight, read_flight
from brmgeo.flight.logs import Height, Log, LogOptions, Orientation, kind_of, read_log
from brmgeo.flight.motion import breaks, slerp
from brmgeo.flight.readings import Camera, FloatArray, Imu, Odometry
from brmgeo.geo.crs import LONLAT

#: Attitude and height are interpolated across at most this.
MAX_BRIDGE_S = 1.0
#: Clocks of two streams that differ by more are not of one flight recorder.
MAX_STAMP_SPREAD_S = 0.5


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """What ``brmgeo import`` may be told besides the log; see its options.

    ``photos`` and ``video`` stand in for pictures that the log does not hold; ``video_start_s`` is the log's time at
    which the video begins. ``camera`` is fx, fy, cx, cy[, k1, k2, p1, p2, k3]. ``body_deg`` and ``mount_deg`` are roll,
    pitch, yaw: of the log's body in ours, and of the camera in the body. ``axes`` is ``flu`` or ``optical``.
    ``imu_units`` are units that the log is known to be in, such as ("deg/s", "g"). ``shift_frames_s`` is added to the
    frames' times.
    """

    options: LogOptions = field(default_factory=LogOptions)
    name: str | None = None
    photos: Path | None = None
    video: Path | None = None
    video_start_s: float = 0.0
    fov_deg: float | None = None
    camera: tuple[float, ...] | None = None
    agl_m: float | None = None
    ground_m: float | None = None
    mount_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    body_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    axes: str = "flu"
    imu_units: tuple[str, ...] = ()
    rate_hz: float | None = None
    shift_frames_s: float = 0.0


# ---------------------------------------------------------------- import


def import_log(path: Path, out: Path, settings: ImportSettings | None = None) -> list[str]:
    """Writes the flight folder ``out`` of a log, bag or folder of photos; what was done, a line each.

    Raises an InputError, one line, for everything that stands in the way: clocks, units and axes that cannot be right,
    a missing height or camera, pictures that do not fit the log, and an ``out`` that is not empty.
    """
    settings = settings or ImportSettings()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SettingsError(f"import: {out} is there already: remove it or choose another --out")
    log = read_log(path, settings.options)
    log = normal(path, log, settings)
    pictures = _pictures(path, log, settings)
    if log.odometry is None and pictures is None and log.gnss is None:
        why = f" ({log.faults[0]})" if log.faults else ""
        raise FlightError(
            f"{path}: the log has no position and no pictures{why}: nothing to localize is in it"
        )
    if log.faults and pictures is None:
        raise FlightError(f"{path}: {log.faults[0]}")
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        lines = _write(path, log, pictures, settings, work)
        if pictures is not None:
            try:
                read_flight(work)
            except InputError as error:
                raise FlightError(
                    f"{path}: the flight is not complete: {str(error).replace(str(work), str(out))}"
                ) from None
        if out.is_dir():
            out.rmdir()
        work.chmod(0o777 & ~_umask())
        work.rename(out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return [*lines, *_left_out(log, settings), *log.notes, *log.faults, *_dropouts(log)]


def _left_out(log: Log, settings: ImportSettings) -> list[str]:
    # Options that this log or video has no use for.
    out: list[str] = []
    if _of_camera(log) and any(settings.mount_deg):
        out.append("--mount was left out: the photos tell the camera's own attitude (gimbal), so it has none")
    if settings.video is not None and settings.shift_frames_s:
        out.append("--shift-frames was left out: with --video, --video-start says when its frames were taken")
    return out


def normal(path: Path, log: Log, settings: ImportSettings | None = None) -> Log:
    """The log with axes and units as told, held against itself; FlightError where clocks, units or axes cannot be right."""
    settings = settings or ImportSettings()
    odometry = log.odometry
    if odometry is not None and settings.axes == "optical":
        odometry = replace(
            odometry,
            xyz_m=frames.flu_from_optical(odometry.xyz_m),
            wxyz=frames.flu_flu_from_optical(odometry.wxyz),
        )
    body = frames.quaternion_from_euler(*np.radians(settings.body_deg))
    if odometry is not None and any(settings.body_deg):
        odometry = replace(odometry, wxyz=frames.multiply(odometry.wxyz, frames.inverse(body)))
    imu = log.imu
    if imu is not None:
        turn = frames.rotate
        gyro, accel = turn(body, imu.gyro_rad_s), turn(body, imu.accel_m_s2)
        if "deg/s" in settings.imu_units:
            gyro = np.radians(gyro)
        for unit, factor in (("g", 9.80665), ("mg", 9.80665e-3)):
            if unit in settings.imu_units:
                accel = accel * factor
        imu = Imu(imu.t_s, gyro, accel)
    log = replace(log, odometry=odometry, imu=imu)
    for fault in faults_of(log):
        raise FlightError(f"{path}: {fault}")
    if (
        odometry is not None
        and len(odometry.t_s)
        and checks.median_tilt_deg(odometry.wxyz) > MAX_MEDIAN_TILT_DEG
    ):
        raise FlightError(f"{path}: {_axes_advice(odometry)}")
    return log


def _axes_advice(odometry: Odometry) -> str:
    up = frames.up_in_body(odometry.wxyz)
    tilt = checks.median_tilt_deg(odometry.wxyz)
    if checks.flat_axis(odometry.xyz_m) == 1:
        return f"{odometry.source}: height runs along y, as in a camera's axes: give --axes optical"
    axis = int(np.abs(up).argmax())
    sign = "+" if up[axis] > 0 else "-"
    # The turn of the log's body that brings its up-pointing axis upwards.
    turns = {
        (0, "+"): "0,-90,0",
        (0, "-"): "0,90,0",
        (1, "+"): "90,0,0",
        (1, "-"): "-90,0,0",
        (2, "-"): "180,0,0",
    }
    advice = turns.get((axis, sign), "0,0,0")
    return (
        f"{odometry.source}: the body is tilted by {tilt:.0f} degrees (median), its {sign}{'xyz'[axis]} axis points up: it "
        f"is no x-nose, y-left, z-up body; give --body {advice} (and the yaw of its nose), or another --quaternion"
    )


def faults_of(log: Log) -> list[str]:
    """What in a log cannot be right, one sentence each: clocks that were not set together, units of the IMU."""
    out: list[str] = []
    offsets = dict(log.stamp_offset_s)
    if len(offsets) > 1:
        late, early = max(offsets, key=lambda k: offsets[k]), min(offsets, key=lambda k: offsets[k])
        spread = offsets[late] - offsets[early]
        if spread > MAX_STAMP_SPREAD_S:
            out.append(
                f"clocks are not synchronised: stamps of {late} are {spread:.3f} s ahead of those of {early}, told by the "
                "times of recording: record with one clock, or shift the frames by --shift-frames"
            )
    reference = log.odometry or log.attitude
    if log.imu is not None:
        gyro, accel = checks.imu_units(
            log.imu, *((reference.t_s, reference.wxyz) if reference else (None, None))
        )
        if accel not in (None, "m/s2"):
            pull = float(np.median(np.linalg.norm(log.imu.accel_m_s2, axis=1)))
            out.append(
                f"the accelerometer's median length is {pull:.3g}: it is in {accel}, not m/s2: give --imu-units {accel}"
            )
        if gyro == "deg/s":
            out.append(
                "the gyro turns far faster than the aircraft: it is in deg/s, not rad/s: give --imu-units deg/s"
            )
        lag = _lag(log)
        if lag is not None and gyro != "deg/s" and abs(lag) > MAX_STAMP_SPREAD_S:
            assert reference is not None
            out.append(
                f"clocks are not synchronised: the IMU tells the turns of {reference.source} {abs(lag):.3f} s too "
                f"{'late' if lag > 0 else 'early'}: record with one clock"
            )
    return out


def _lag(log: Log) -> float | None:
    reference = log.odometry or log.attitude
    if log.imu is None or reference is None or len(reference.t_s) < 20:
        return None
    found = checks.clock_lag_s(
        *checks.turn_rate(reference.t_s, reference.wxyz),
        log.imu.t_s,
        np.linalg.norm(log.imu.gyro_rad_s, axis=1),
    )
    return None if found is None else found[0]


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@dataclass(frozen=True, slots=True)
class _Pictures:
    t_s: FloatArray
    names: tuple[str, ...]
    size: tuple[int, int]
    write: Callable[[Path, dict[int, str]], None]
    video: Path | None = None


def _pictures(path: Path, log: Log, settings: ImportSettings) -> _Pictures | None:
    if settings.video is not None:
        return _video(path, log, settings)
    held = log.frames
    times = None if held is None else held.t_s
    if settings.photos is not None:
        beside = read_log(settings.photos)
        if beside.frames is None:
            raise FlightError(f"{settings.photos}: no photos are here")
        if log.triggers_s is None:
            raise FlightError(
                f"{path}: the log has no camera triggers (CAM, camera_capture), so photos have no time in it"
            )
        if len(log.triggers_s) != len(beside.frames.t_s):
            raise FlightError(
                f"{path}: {len(log.triggers_s)} camera triggers for {len(beside.frames.t_s)} photos in {settings.photos}: "
                "take out test shots until the numbers agree"
            )
        held, times = beside.frames, log.triggers_s
        wander = np.ptp((times - times[0]) - (held.t_s - held.t_s[0]))
        if len(times) > 1 and wander > 2.0:
            raise FlightError(
                f"{settings.photos}: times between the photos and between the log's triggers differ by {wander:.1f} s: "
                "these photos are of another flight, or some are missing"
            )
    if held is None or times is None:
        return None
    source = held

    def write(folder: Path, wanted: dict[int, str]) -> None:
        for i, image in source.images():
            if i not in wanted:
                continue
            target = folder / wanted[i]
            if isinstance(image, bytes):
                target.write_bytes(image)
            elif not cv2.imwrite(str(target), image):
                raise FlightError(f"{target}: the picture cannot be written")

    return _Pictures(times + settings.shift_frames_s, held.names, held.size, write)


def _video(path: Path, log: Log, settings: ImportSettings) -> _Pictures:
    video = settings.video
    assert video is not None
    capture = cv2.VideoCapture(str(video))
    rate, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    capture.release()
    if rate <= 0 or count <= 0:
        raise FlightError(f"{video}: no readable video: convert it (for example to H.264 in .mp4)")
    t = settings.video_start_s + np.arange(count) / rate
    if log.odometry is not None and (t[0] > log.odometry.t_s[-1] or t[-1] < log.odometry.t_s[0]):
        raise FlightError(
            f"{path}: the log covers {log.odometry.t_s[0]:.1f} to {log.odometry.t_s[-1]:.1f} s, the video {t[0]:.1f} to "
            f"{t[-1]:.1f} s: give the log's time at which the video begins as --video-start"
        )

    def write(folder: Path, wanted: dict[int, str]) -> None:
        shutil.copyfile(video, folder.parent / video.name)

    return _Pictures(t, tuple(f"{i:06d}" for i in range(count)), size, write, video)


def _bridged(t_s: FloatArray, at_s: FloatArray, max_gap_s: float) -> NDArray[np.bool_]:
    """(m,) bool: where values at ``t_s`` tell of ``at_s``, with no longer gap between."""
    right = np.clip(np.searchsorted(t_s, at_s), 0, len(t_s) - 1)
    left = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, 0, len(t_s) - 1)
    near = (np.abs(t_s[right] - at_s) < 0.05) | (np.abs(t_s[left] - at_s) < 0.05)
    inside = (at_s >= t_s[0]) & (at_s <= t_s[-1]) & (t_s[right] - t_s[left] <= max_gap_s)
    return np.asarray(near | inside)


def _attitude_at(attitude: Orientation | Odometry, at_s: FloatArray) -> FloatArray:
    t = attitude.t_s
    if len(t) == 1:
        return np.repeat(attitude.wxyz, len(at_s), axis=0)
    right = np.clip(np.searchsorted(t, at_s), 1, len(t) - 1)
    share = np.clip((at_s - t[right - 1]) / (t[right] - t[right - 1]), 0.0, 1.0)
    return slerp(attitude.wxyz[right - 1], attitude.wxyz[right], share)


def _height_of(path: Path, log: Log, settings: ImportSettings) -> Height | None:
    if settings.agl_m is not None:
        return None
    if settings.ground_m is not None:
        if log.gnss is None or not np.isfinite(log.gnss.alt_m).any():
            raise FlightError(
                f"{path}: --ground is given, but the log has no altitude above a datum: give --agl"
            )
        known = np.isfinite(log.gnss.alt_m)
        return Height(
            log.gnss.t_s[known],
            log.gnss.alt_m[known] - settings.ground_m,
            "ground",
            "GNSS altitude - --ground",
        )
    return log.height


def _write(
    path: Path, log: Log, pictures: _Pictures | None, settings: ImportSettings, out: Path
) -> list[str]:
    lines: list[str] = []
    toml = [f'name = "{_plain(settings.name or path.stem)}"']
    height = _height_of(path, log, settings)

    if pictures is not None:
        keep = _wanted(pictures.t_s, settings.rate_hz)
        if log.odometry is not None:
            t = log.odometry.t_s
            if pictures.t_s[-1] < t[0] or pictures.t_s[0] > t[-1]:
                raise FlightError(
                    f"{path}: clocks are not synchronised: frames from {pictures.t_s[0]:.3f} to {pictures.t_s[-1]:.3f} s, "
                    f"odometry from {t[0]:.3f} to {t[-1]:.3f} s: shift the frames by --shift-frames"
                )
        times = pictures.t_s[keep]
        columns: dict[str, FloatArray] = {}
        good = np.ones(len(times), dtype=bool)
        if height is not None:
            agl = np.interp(times, height.t_s, height.agl_m)
            good &= _bridged(height.t_s, times, 5.0) & (agl >= MIN_AGL_M) & (agl <= MAX_AGL_M)
            columns["agl_m"] = agl
            if not good.any():
                raise FlightError(
                    f"{path}: {height.source}: no height of {MIN_AGL_M:g} and {MAX_AGL_M:g} m at a frame: give --agl"
                )
            if height.above == "take-off":
                lines.append(
                    f"height is above the take-off point ({height.source}), taken as height above ground"
                )
        elif settings.agl_m is None:
            raise FlightError(
                f"{path}: the log tells no height: give --agl (metres above ground) or --ground"
            )
        # An autopilot's and a gimbal's attitude come first; an IMU's own is of the IMU's axes, so odometry is better.
        own = log.attitude is not None and (log.attitude.north or log.odometry is None)
        attitude = log.attitude if own else log.odometry
        if attitude is not None:
            known = _bridged(attitude.t_s, times, MAX_BRIDGE_S)
            if known[good].mean() < 1.0:
                lines.append(f"{int((~known & good).sum())} frames without attitude were left out")
            good &= known
            if not good.any():
                raise FlightError(
                    f"{path}: clocks are not synchronised: no frame ({times[0]:.3f} to {times[-1]:.3f} s) has an attitude "
                    f"({attitude.t_s[0]:.3f} to {attitude.t_s[-1]:.3f} s): shift the frames by --shift-frames"
                )
            wxyz = _attitude_at(attitude, times)
            roll, pitch, _ = (np.degrees(a) for a in frames.euler_from_quaternion(wxyz))
            columns |= {"roll_deg": roll, "pitch_deg": pitch}
            if isinstance(attitude, Orientation) and attitude.north:
                columns["yaw_deg"] = frames.heading_deg(wxyz)
        dropped = int((~good).sum())
        if dropped:
            lines.append(
                f"{dropped} of {len(times)} frames have no usable height or attitude and were left out"
            )
        chosen = np.flatnonzero(keep)[good]
        toml += _camera_lines(path, log, pictures, settings)
        mount = (0.0, 0.0, 0.0) if _of_camera(log) else settings.mount_deg
        toml += ["[mount]", *(f"{k}_deg = {v:g}" for k, v in zip(("roll", "pitch", "yaw"), mount))]
        if pictures.video is not None:
            toml += [
                "[frames]",
                f'video = "{_plain(pictures.video.name)}"',
                f"start_s = {settings.video_start_s!r}",
            ]
        toml += ["[height]"]
        toml += (
            ['source = "frames"']
            if height is not None
            else ['source = "fixed"', f"fixed_m = {settings.agl_m:g}"]
        )
        folder = out / "frames"
        folder.mkdir()
        names = {int(i): pictures.names[i] for i in chosen}
        pictures.write(folder, names)
        if pictures.video is not None:
            folder.rmdir()
        table = {name: values[good] for name, values in columns.items()}
        _csv(out / "frames.csv", times[good], table, [names[int(i)] for i in chosen])
        lines.append(f"frames.csv: {len(chosen)} frames, {', '.join(['t_s', 'file', *columns])}")
    if log.odometry is not None:
        o = log.odometry
        data = {f"{a}": o.xyz_m[:, i] for i, a in enumerate("xyz")} | {
            f"q{a}": o.wxyz[:, i] for i, a in enumerate("wxyz")
        }
        if o.segment is not None:
            data["segment"] = o.segment.astype(np.float64)
        _csv(out / "odometry.csv", o.t_s, data)
        toml += ["[odometry]", 'file = "odometry.csv"', 'format = "csv"']
        lines.append(f"odometry.csv: {len(o.t_s)} poses of {o.source}")
    if log.imu is not None:
        axes = [f"g{a}" for a in "xyz"], [f"a{a}" for a in "xyz"]
        data = {n: log.imu.gyro_rad_s[:, i] for i, n in enumerate(axes[0])}
        data |= {n: log.imu.accel_m_s2[:, i] for i, n in enumerate(axes[1])}
        _csv(out / "imu.csv", log.imu.t_s, data)
        lines.append(f"imu.csv: {len(log.imu.t_s)} readings")
    if height is not None and log.kind != "photos":
        usable = (height.agl_m >= MIN_AGL_M) & (height.agl_m <= MAX_AGL_M)
        if usable.any():
            _csv(out / "altimeter.csv", height.t_s[usable], {"agl_m": height.agl_m[usable]})
            lines.append(f"altimeter.csv: {int(usable.sum())} heights of {height.source}")
    if log.gnss is not None:
        g = log.gnss
        data = {"lon": g.lon_deg, "lat": g.lat_deg}
        for name, values in (("alt_m", g.alt_m), ("sigma_m", g.sigma_m)):
            if np.isfinite(values).all():
                data[name] = values
        _csv(out / "reference.csv", g.t_s, data)
        toml += ["[reference]", 'file = "reference.csv"', f'crs = "{LONLAT}"']
        lines.append(
            f"reference.csv: {len(g.t_s)} GNSS positions{', with accuracy' if 'sigma_m' in data else ''}"
        )
    if log.uses_gnss and log.odometry is not None:
        lines.append("GNSS went into this odometry: results with it do not count as flown without GNSS")
    if pictures is None:
        lines.append(
            "no pictures: give --photos or --video, or add frames/, frames.csv, [camera] and [height] yourself"
        )
    (out / "flight.toml").write_text("\n".join(toml) + "\n", encoding="utf-8")
    return lines


def _of_camera(log: Log) -> bool:
    return log.attitude is not None and log.attitude.of_camera


def _wanted(t_s: FloatArray, rate_hz: float | None) -> NDArray[np.bool_]:
    keep = np.ones(len(t_s), dtype=bool)
    if rate_hz is not None:
        last = -math.inf
        for i, t in enumerate(t_s):
            keep[i] = t - last >= 1.0 / rate_hz - 1e-3
            last = t if keep[i] else last
    return keep


def _camera_lines(path: Path, log: Log, pictures: _Pictures, settings: ImportSettings) -> list[str]:
    width, height = pictures.size
    head = ["[camera]", f"width = {width}", f"height = {height}"]
    if settings.fov_deg is not None:
        return [*head, f"fov_deg = {settings.fov_deg:g}"]
    camera: Camera | None = log.camera
    if settings.camera is not None:
        fx, fy, cx, cy, *bend = settings.camera
        k1, k2, p1, p2, k3 = ([*bend] + [0.0] * 5)[:5]
        camera = Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
    elif camera is None and settings.photos is not None:
        camera = read_log(settings.photos).camera
    if camera is None:
        raise FlightError(
            f"{path}: nothing tells the camera's field of view: give --fov (degrees across the short side)"
        )
    if (camera.width, camera.height) != (width, height):
        raise FlightError(
            f"{path}: the camera's calibration is for {camera.width} x {camera.height}, its pictures {width} x {height}: "
            "give --camera or --fov"
        )
    return [*head, *(f"{k} = {getattr(camera, k):.6f}" for k in ("fx", "fy", "cx", "cy"))] + (
        [f"distortion = {[float(v) for v in camera.distortion]}"] if camera.is_distorted else []
    )


def _plain(text: str) -> str:
    return "".join(c for c in text if c.isprintable() and c not in '"\\')


def _csv(
    path: Path, t_s: FloatArray, columns: dict[str, FloatArray], names: Sequence[str] | None = None
) -> None:
    head = ["t_s", *(["file"] if names is not None else []), *columns]
    rows = [",".join(head)]
    places = {"lon": 8, "lat": 8, "segment": 0}
    texts = [
        [f"{v:.{places.get(k, 7 if k[0] in 'qga' and len(k) == 2 else 4)}f}" for v in c]
        for k, c in columns.items()
    ]
    for i, t in enumerate(t_s):
        rows.append(
            ",".join([f"{t:.6f}", *([names[i]] if names is not None else []), *(c[i] for c in texts)])
        )
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _dropouts(log: Log) -> list[str]:
    if not log.lost:
        return []
    total, longest = sum(d for _, d in log.lost), max(log.lost, key=lambda d: d[1])
    return [
        f"{len(log.lost)} dropouts, {total:.3f} s lost in all, the longest {longest[1]:.3f} s at {longest[0]:.3f} s: "
        "the logger could not keep up"
    ]


# ---------------------------------------------------------------- inspect


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
    lines += [f"  dropouts   {line}" for line in _dropouts(log)]
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
    lines += [f"  FAULT      {fault}" for fault in (*log.faults, *faults_of(log))]
    return lines


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
                "             its height seems to run along y, as in a camera's axes: import with --axes optical"
            )
        elif checks.median_tilt_deg(track.wxyz) > MAX_MEDIAN_TILT_DEG:
            lines.append(f"             {_axes_advice(track)}")
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
    """The GNSS positions of a log as a track about their first: metres east, north, up (good to kilometres)."""
    g = log.gnss
    if g is None or len(g.t_s) < 2:
        return None
    east = np.radians(g.lon_deg - g.lon_deg[0]) * 6378137.0 * math.cos(math.radians(g.lat_deg[0]))
    north = (
        np.radians(g.lat_deg - g.lat_deg[0])
        * 6356752.0
        * (1.0 + 0.0101 * math.sin(math.radians(g.lat_deg[0])) ** 2)
    )
    up = np.where(np.isfinite(g.alt_m), g.alt_m, 0.0)
    return Odometry(
        g.t_s, np.stack([east, north, up - up[0]], axis=-1), np.tile([1.0, 0, 0, 0], (len(east), 1)), "GNSS"
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
    lag = _lag(log)
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
    return lines + [f"  FAULT      {fault}" for fault in faults_of(log)]


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
        except InputError:
            continue
        if log.odometry is not None and log.clock.startswith("Unix"):
            tracks.append(replace(log.odometry, source=path.name))
    out: list[str] = []
    for i, first in enumerate(tracks):
        for second in tracks[i + 1 :]:
            out += [line.replace("  agree      ", "") for line in _agreement(first, second)]
    return out


def inspect_document(paths: Sequence[Path], options: LogOptions | None = None) -> tuple[str, int]:
    """Markdown of ``inspect`` for many paths, and how many of them could not be read: how docs/logs.md is made."""
    out = [
        "# What is in these logs",
        "",
        "Made by `brmgeo inspect PATH ... --write FILE`, which tells this of any log, bag, text of poses, folder of photos",
        "or flight folder. `brmgeo import PATH --out flight/` makes a flight folder of a log",
        "(`pip install 'brmgeo[logs]'` for ROS bags, PX4 and ArduPilot logs). FAULT is what import refuses, with the",
        "option that mends it. A log without pictures takes them from `--photos` (by its camera triggers) or `--video`.",
        "",
    ]
    others = []
    for path in paths:
        try:
            lines = inspect(path, options)
        except InputError as error:
            others.append(f"- {str(error).replace(str(path), path.name)}")
            continue
        out += [f"## {path.name}", "", "```", *lines, "```", ""]
    same = pairs(paths, options)
    if same:
        out += ["## Tracks of the same minutes", "", "After the best rotation, shift and scale:", ""]
        out += [f"- {line}" for line in same] + [""]
    if others:
        out += ["## Not read", "", *others, ""]
    return "\n".join(out), len(others)
