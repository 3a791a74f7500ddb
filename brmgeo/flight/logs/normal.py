"""A log held against itself: axes and units as told, and clocks, units and axes that cannot be right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brmgeo.codes import GRAVITY_M_S2
from brmgeo.errors import FlightError
from brmgeo.flight import checks, frames
from brmgeo.flight.folder import MAX_MEDIAN_TILT_DEG
from brmgeo.flight.logs.values import ImportSettings, Log
from brmgeo.flight.poses import AXES_UNTOLD
from brmgeo.flight.readings import Imu, Odometry

#: Clocks of two streams that differ by more are not of one flight recorder.
MAX_STAMP_SPREAD_S = 0.5


class Fault(NamedTuple):
    """What cannot be right, in one sentence, and the setting of ``ImportSettings`` that mends it where there is one."""

    says: str
    needs: str | None = None


def normal(path: Path, log: Log, settings: ImportSettings | None = None) -> Log:
    """The log with axes and units as told, held against itself; FlightError where clocks, units or axes cannot be right."""
    settings = settings or ImportSettings()
    odometry = log.odometry
    if odometry is not None and settings.axes not in (None, "flu"):
        xyz, wxyz = frames.to_flu(settings.axes, odometry.xyz_m, odometry.wxyz)
        odometry = replace(odometry, xyz_m=xyz, wxyz=wxyz)
    body = frames.quaternion_from_euler(*np.radians(settings.body_deg))
    if odometry is not None and any(settings.body_deg):
        odometry = replace(odometry, wxyz=frames.multiply(odometry.wxyz, frames.inverse(body)))
    imu = log.imu
    if imu is not None:
        turn = frames.rotate
        gyro, accel = turn(body, imu.gyro_rad_s), turn(body, imu.accel_m_s2)
        if "deg/s" in settings.imu_units:
            gyro = np.radians(gyro)
        for unit, factor in (("g", GRAVITY_M_S2), ("mg", GRAVITY_M_S2 * 1e-3)):
            if unit in settings.imu_units:
                accel = accel * factor
        imu = Imu(imu.t_s, gyro, accel)
    log = replace(log, odometry=odometry, imu=imu)
    for fault in faults_of(log):
        raise FlightError(f"{path}: {fault.says}", needs=fault.needs)
    if (
        odometry is not None
        and len(odometry.t_s)
        and checks.median_tilt_deg(odometry.wxyz) > MAX_MEDIAN_TILT_DEG
    ):
        fault = axes_fault(odometry)
        raise FlightError(f"{path}: {fault.says}", needs=fault.needs)
    if odometry is not None and settings.axes is None and log.kind in AXES_UNTOLD:
        says = checks.doubtful_axes(odometry)
        if says:
            raise FlightError(f"{path}: {odometry.source}: {says}", needs="axes")
    return log


def axes_fault(odometry: Odometry) -> Fault:
    """How the axes of a tilted track lie, and what would turn them."""
    up = frames.up_in_body(odometry.wxyz)
    tilt = checks.median_tilt_deg(odometry.wxyz)
    if checks.flat_axis(odometry.xyz_m) == 1:
        return Fault(
            f"{odometry.source}: height runs along y, as in a camera's axes: give axes optical", "axes"
        )
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
    return Fault(
        f"{odometry.source}: the body is tilted by {tilt:.0f} degrees (median), its {sign}{'xyz'[axis]} axis points up: it "
        f"is no x-nose, y-left, z-up body; give body_deg {advice} (and the yaw of its nose), or another quaternion order",
        "body_deg",
    )


def faults_of(log: Log) -> list[Fault]:
    """What in a log cannot be right: clocks that were not set together, units of the IMU."""
    out: list[Fault] = []
    offsets = dict(log.stamp_offset_s)
    if len(offsets) > 1:
        late, early = max(offsets, key=lambda k: offsets[k]), min(offsets, key=lambda k: offsets[k])
        spread = offsets[late] - offsets[early]
        if spread > MAX_STAMP_SPREAD_S:
            out.append(
                Fault(
                    f"clocks are not synchronised: stamps of {late} are {spread:.3f} s ahead of those of {early}, told by "
                    "the times of recording: record with one clock, or shift the frames",
                    "shift_frames_s",
                )
            )
    reference = log.odometry or log.attitude
    if log.imu is not None:
        gyro, accel = checks.imu_units(
            log.imu, *((reference.t_s, reference.wxyz) if reference else (None, None))
        )
        if accel not in (None, "m/s2"):
            pull = float(np.median(np.linalg.norm(log.imu.accel_m_s2, axis=1)))
            out.append(
                Fault(
                    f"the accelerometer's median length is {pull:.3g}: it is in {accel}, not m/s2: give imu_units {accel}",
                    "imu_units",
                )
            )
        if gyro == "deg/s":
            out.append(
                Fault(
                    "the gyro turns far faster than the aircraft: it is in deg/s, not rad/s: give imu_units deg/s",
                    "imu_units",
                )
            )
        lag = lag_s(log)
        if lag is not None and gyro != "deg/s" and abs(lag) > MAX_STAMP_SPREAD_S:
            assert reference is not None
            out.append(
                Fault(
                    f"clocks are not synchronised: the IMU tells the turns of {reference.source} {abs(lag):.3f} s too "
                    f"{'late' if lag > 0 else 'early'}: record with one clock"
                )
            )
    return out


def lag_s(log: Log) -> float | None:
    """Seconds by which the IMU tells the turns of odometry or attitude too late; None where that cannot be told."""
    reference = log.odometry or log.attitude
    if log.imu is None or reference is None or len(reference.t_s) < 20:
        return None
    found = checks.clock_lag_s(
        *checks.turn_rate(reference.t_s, reference.wxyz),
        log.imu.t_s,
        np.linalg.norm(log.imu.gyro_rad_s, axis=1),
    )
    return None if found is None else found[0]
