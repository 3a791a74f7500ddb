"""Settings of the simulator from a file: every key of its dataclasses, nothing else, and never in silence."""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.synth.flight import MaskErrors, OdometryErrors, SimulationSettings, read_simulation_settings

DOCS = Path(__file__).parents[2] / "docs" / "FLIGHT.md"


def read(tmp_path: Path, text: str) -> SimulationSettings:
    (tmp_path / "s.toml").write_text(text)
    return read_simulation_settings(tmp_path / "s.toml", SimulationSettings())


def test_every_setting_of_the_simulator_can_be_given(tmp_path: Path) -> None:
    for section, model in (("", SimulationSettings), ("masks", MaskErrors), ("odometry", OdometryErrors)):
        for field in fields(model):
            if field.name in ("camera", "mount", "told_mount", "masks", "odometry"):
                continue
            value = {"reset_times_s": [20.0, 60], "jpeg_quality": 77, "states_noise": True}.get(
                field.name, 0.75
            )
            if field.name == "agl_m":
                value = 120
            shown = str(value).lower() if isinstance(value, bool) else value
            head = f"[{section}]\n" if section else ""
            made = read(tmp_path, f"{head}{field.name} = {shown}\n")
            owner = getattr(made, section) if section else made
            got = getattr(owner, field.name)
            assert got == (tuple(value) if isinstance(value, list) else value), field.name
            assert isinstance(got, type(getattr(model(), field.name)) | float)


def test_a_told_mount_is_what_the_flight_is_located_with(tmp_path: Path) -> None:
    made = read(tmp_path, "[mount]\npitch_deg = -15.0\n")
    assert made.known_mount == made.mount
    made = read(tmp_path, "[mount]\npitch_deg = -15.0\n[told_mount]\npitch_deg = 0.0\n")
    assert made.mount.pitch_rad == pytest.approx(math.radians(-15.0))
    assert made.known_mount.pitch_rad == 0.0


def test_the_example_of_the_docs_holds(tmp_path: Path) -> None:
    found = re.search(r"```toml\n(# settings of brmgeo simulate.*?)```", DOCS.read_text(), re.DOTALL)
    assert found is not None
    made = read(tmp_path, found[1])
    table = tomllib.loads(found[1])
    assert made.masks.missed == table["masks"]["missed"]
    assert made.odometry is not None
    assert made.odometry.reset_times_s == tuple(table["odometry"]["reset_times_s"])
    assert made.mount.pitch_rad == pytest.approx(math.radians(table["mount"]["pitch_deg"]))
    assert made.camera.distortion == tuple(table["camera"]["distortion"])
    assert made.camera.width == 640


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("agl_sigam_m = 2", "did you mean 'agl_sigma_m'"),
        ("[masks]\nmised = 0.1", "did you mean 'missed'"),
        ("[odometry]\nrate = 1", "'rate_hz'"),
        ("[camra]\nwidth = 3", "did you mean 'camera'"),
        ("[mount]\npitch = 3", "did you mean 'pitch_deg'"),
        ("masks = 3", "masks: must be a table"),
        ("noise_levels = '3'", "valid number"),
        ("noise_levels = nan", "finite number"),
        ("noise_levels = true", "valid number"),
        ("jpeg_quality = 90.5", "valid integer"),
        ("[masks]\nmissed = 1.5", "less than or equal to 1"),
        ("exposure_s = -1", "greater than or equal to 0"),
        ("[odometry]\nreset_times_s = 5", "tuple"),
        ("[camera]\nfx = 500", "fx, fy, cx, cy"),
        ("[camera]\nfov_deg = 43\nfx = 500", "keep one kind"),
        ("[camera]\nwidth = 1280", "fov_deg"),
        ("[camera]\ndistortion = [1, 2]", "too few"),
        ("[camera]\ndistortion = [-3, 0, 0, 0, 0]", "distortion"),
        ("agl_m = ", "not valid TOML"),
    ],
)
def test_what_nobody_knows_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(SettingsError, match=r"s\.toml") as caught:
        read(tmp_path, text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(MissingInputError, match="no such file"):
        read_simulation_settings(tmp_path / "none.toml", SimulationSettings())
