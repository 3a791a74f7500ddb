"""The program of docs/tutorials/aboard.md runs as it is written, with no more than a bare installation has."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from small_flights import Said, make_flight
from test_public import BARE, ROOT

import brmgeo
from brmgeo.locate.maps import read_maps

PAGE = ROOT / "docs" / "tutorials" / "aboard.md"


def test_the_program_aboard_says_what_localize_says(
    maps: Path, pictured: Path, weights: Path, tmp_path: Path, say: Callable[..., Said]
) -> None:
    program, again, _ = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    assert len([line for line in program.splitlines() if line.strip()]) <= 20
    # The network of the tests, which takes the bright houses of their town for buildings.
    network = f"Segmenter.load({str(weights)!r})"
    program, again = (code.replace("Segmenter.load()", network) for code in (program, again))
    arguments = f"sys.argv[1:] = [{str(maps)!r}, {str(pictured)!r}]\n"
    run = [sys.executable, "-c", BARE + arguments + program + again]
    done = subprocess.run(
        run,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr

    out = tmp_path / "located"
    words = ["localize", "--maps", maps, "--flight", pictured, "--weights", weights, "--out", out]
    assert say(*words).code == 0
    rows = list(csv.DictReader((out / "fixes.csv").read_text(encoding="utf-8").splitlines()))
    told = done.stdout.splitlines()
    assert len(told) == len(rows)
    for line, row in zip(told, rows, strict=True):
        if row["status"] == "converged":
            assert f"{float(row['x']):.1f} {float(row['y']):.1f} in " in line
        else:
            assert line.endswith(f": {row['status']}")
    assert any(row["status"] == "converged" for row in rows)

    here = brmgeo.Localizer.load(
        tmp_path / "here.brmgeo", read_maps(maps), masks=brmgeo.Segmenter.load(weights)
    )
    assert here is not None


@pytest.mark.slow  # a flight at video rate is drawn and followed
def test_the_program_with_odometry_of_its_own_follows_the_flight(
    maps: Path, waypoints: Path, weights: Path, tmp_path: Path
) -> None:
    words = ("--mode", "frames", "--interval", 0.2, "--no-odometry")
    filmed = make_flight(maps, waypoints, tmp_path / "filmed", *words)
    *_, program = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    code = f"""
import brmgeo
maps, flight = brmgeo.read_maps({str(maps)!r}), brmgeo.read_flight({str(filmed)!r})
{program.replace("Segmenter.load()", f"Segmenter.load({str(weights)!r})")}
print(vio.pose is not None, fix.status, np.linalg.norm(fix.mean - flight.reference(maps.crs).at(np.array([fix.t_s]))[0]))
"""
    env = {"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", BARE + code], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    pose, status, error_m = done.stdout.split()
    assert (pose, status) == ("True", "converged")
    assert float(error_m) < 5.0
