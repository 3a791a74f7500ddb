"""What a simulated flight is told: options win over the settings file, and the file over the region."""

from __future__ import annotations

from pathlib import Path

from brmgeo.region import FlightSettings as OfRegion
from brmgeo.synth.flight import OdometryErrors
from pipelines.simulate import Simulation


def test_options_win_over_the_file_and_the_file_over_the_region(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        "agl_m = 90\nframe_interval_s = 2\nagl_sigma_m = 9\n[odometry]\nscale_bias = 0.2\nrate_hz = 5\n"
    )
    own = OfRegion()
    made = Simulation(tmp_path, own, settings_file=file).settings()
    assert (made.agl_m, made.agl_sigma_m, made.speed_m_s) == (90, 9, own.speed_m_s)
    assert (made.odometry.scale_bias, made.odometry.rate_hz) == (0.2, 5)
    made = Simulation(tmp_path, own, settings_file=file, scale_bias=-0.1, interval_s=3.0).settings()
    assert (made.odometry.scale_bias, made.odometry.rate_hz, made.frame_interval_s) == (-0.1, 5, 3.0)
    assert Simulation(tmp_path, own, settings_file=file, no_odometry=True).settings().odometry is None
    assert Simulation(tmp_path, own).settings().odometry == OdometryErrors()
