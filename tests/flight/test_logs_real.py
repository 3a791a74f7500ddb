"""Real logs: every one reads, and where two describe the same minutes they agree."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from brmgeo.errors import FlightError
from brmgeo.flight import checks, frames
from brmgeo.flight.logs import ImportSettings, Log, LogOptions, read_log
from brmgeo.flight.logs.inspect import gnss_track, inspect
from pipelines.logs import import_log

DATA = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2] / "../shared/data"))
LOGS = DATA / "logs"
pytestmark = pytest.mark.skipif(not LOGS.is_dir(), reason="real logs are not here (BRMGEO_REAL_DATA)")
pytest.importorskip("rosbags")
pytest.importorskip("pyulog")
pytest.importorskip("pymavlink")

NAMES = sorted(p.name for p in LOGS.iterdir() if p.name != "SOURCE.txt") if LOGS.is_dir() else []


@cache
def look(name: str, topic: str | None = None) -> Log:
    return read_log(LOGS / name, LogOptions(topic, any_topic=True))


@pytest.mark.parametrize("name", [n for n in NAMES if n != "ROS_example.bag"])
def test_every_log_reads(name: str) -> None:
    log = look(name)
    assert log.odometry is not None or log.faults
    assert len(inspect(LOGS / name)) > 3
    for part in (log.odometry, log.imu, log.height, log.attitude, log.gnss):
        if part is not None:
            assert (np.diff(part.t_s) > 0).all()
            assert np.isfinite(part.t_s).all()
    if log.odometry is not None:
        assert np.allclose(np.linalg.norm(log.odometry.wxyz, axis=1), 1.0)


def test_three_tracks_of_mh_04_agree() -> None:
    truth, vio, loop = (
        look(n).odometry
        for n in ("MH_04_difficult_gt_euroc.csv", "wj762_vinsfusion_vio.csv", "wj762_vinsfusion_vio_loop.csv")
    )
    assert truth is not None
    assert vio is not None
    assert loop is not None
    for first, second in ((truth, vio), (truth, loop), (vio, loop)):
        rms, _, seconds = checks.agreement_m(first, second) or (np.nan, 0.0, 0.0)
        assert rms < 0.5
        assert seconds > 90.0
        # The attitudes too: in one and the same IMU, so up is the same axis for all.
        assert frames.up_in_body(first.wxyz) @ frames.up_in_body(second.wxyz) > 0.98
    late = checks.clock_lag_s(*checks.turn_rate(truth.t_s, truth.wxyz), *checks.turn_rate(vio.t_s, vio.wxyz))
    assert late is not None
    assert abs(late[0]) < 0.02


def test_the_bag_of_three_odometries_asks_which_and_they_agree() -> None:
    with pytest.raises(FlightError, match=r"groundtruth \(12765\), ORB-SLAM \(8362\), S-PTAM \(5439\)"):
        read_log(LOGS / "ROS_example.bag")
    truth, orb, ptam = (look("ROS_example.bag", n).odometry for n in ("groundtruth", "ORB-SLAM", "S-PTAM"))
    assert truth is not None
    for other in (orb, ptam):
        assert other is not None
        rms, scale, _ = checks.agreement_m(truth, other, scale=True) or (np.nan, 0.0, 0.0)
        assert rms < 0.025 * checks.length_m(other)
        assert scale == pytest.approx(1.0, abs=0.05)
        assert checks.flat_axis(other.xyz_m) == 1  # a camera's axes, which inspect says


def test_topics_of_one_bag_agree() -> None:
    odom, tf, amcl = (
        look("nav2_turtlebot.mcap", n).odometry for n in ("/odom", "/tf odom>base_link", "/amcl_pose")
    )
    assert odom is not None
    assert tf is not None
    assert amcl is not None
    assert np.array_equal(odom.t_s, tf.t_s)
    assert np.abs(odom.xyz_m - tf.xyz_m).max() < 1e-9
    rms, scale, _ = checks.agreement_m(odom, amcl, scale=True) or (np.nan, 0.0, 0.0)
    assert rms < 0.6
    assert scale == pytest.approx(1.0, abs=0.01)
    assert odom.t_s[0] == pytest.approx(928.8)  # header.stamp; it was recorded at 1 778 234 353 s


def test_the_ardupilot_log_agrees_with_its_gnss_and_its_own_gravity() -> None:
    log = look("log171.bin")
    assert log.odometry is not None
    fixes = gnss_track(log)
    assert fixes is not None
    rms, scale, _ = checks.agreement_m(log.odometry, fixes, scale=True) or (np.nan, 0.0, 0.0)
    assert rms < 2.5
    assert scale == pytest.approx(1.0, abs=0.06)
    # East and north are east and north: the shift alone must do nearly as well as any turn.
    ours = np.stack([np.interp(fixes.t_s, log.odometry.t_s, log.odometry.xyz_m[:, k]) for k in range(2)], -1)
    miss = (ours - fixes.xyz_m[:, :2]) - (ours - fixes.xyz_m[:, :2]).mean(axis=0)
    assert np.sqrt((miss**2).sum(axis=1).mean()) < 3.5


@pytest.mark.parametrize("name", ["sample.ulg", "sample_log_small.ulg", "log171.bin"])
def test_attitude_and_accelerometer_agree_on_gravity(name: str) -> None:
    log = look(name)
    assert log.imu is not None
    assert log.attitude is not None
    at = np.clip(np.searchsorted(log.attitude.t_s, log.imu.t_s), 0, len(log.attitude.t_s) - 1)
    pull = frames.rotate(log.attitude.wxyz[at], log.imu.accel_m_s2)
    mean = pull.mean(axis=0)
    assert mean[2] == pytest.approx(9.8, abs=0.4)
    assert np.hypot(mean[0], mean[1]) < 0.5


def test_px4_bench_logs_have_no_position_and_say_so(tmp_path: Path) -> None:
    for name in ("sample.ulg", "sample_log_small.ulg"):
        log = look(name)
        assert log.odometry is None
        assert "never held its horizontal position valid" in log.faults[0]
        assert log.lost
    with pytest.raises(FlightError, match=r"sample.ulg: the log has no position and no pictures"):
        import_log(LOGS / "sample.ulg", tmp_path / "flight")


@pytest.mark.parametrize(
    "name", ["cerberus_vio.csv", "log171.bin", "tf_example", "zartris_vins_result_no_loop.csv"]
)
def test_upright_logs_import_and_read_back(tmp_path: Path, name: str) -> None:
    from brmgeo.flight.odometry import read_odometry

    import_log(LOGS / name, tmp_path / "flight", ImportSettings())
    log = look(name)
    assert log.odometry is not None
    back = read_odometry(tmp_path / "flight" / "odometry.csv", "csv")
    assert np.abs(back.xyz_m - log.odometry.xyz_m).max() < 1e-4
    assert np.abs(back.wxyz - log.odometry.wxyz).max() < 1e-6


@pytest.mark.skipif(not (DATA / "photos-dji").is_dir(), reason="real photos are not here (BRMGEO_REAL_DATA)")
def test_real_photos_become_a_flight(tmp_path: Path) -> None:
    from brmgeo.flight.folder import read_flight

    import_log(DATA / "photos-dji", tmp_path / "flight")
    flight = read_flight(tmp_path / "flight")
    assert [f.agl_m for f in flight.frames] == [39.8, 40.1, 40.1]
    reference = flight.reference("EPSG:32615")
    assert reference is not None
    assert np.linalg.norm(np.diff(reference.xy_m, axis=0), axis=1) == pytest.approx([13.8, 13.8], abs=0.5)
    assert flight.image(0).shape == (2250, 4000, 3)
