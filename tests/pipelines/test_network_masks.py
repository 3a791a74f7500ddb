"""The network in the loop: masks of frames by content, through the command line.

The network here is one convolution that calls what is bright building (tests/small_networks.py), and the pictures'
buildings are bright: what comes out can be worked out by hand.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_flights import REAL, Said, bytes_of, make_flight

from brmgeo.flight.folder import read_flight
from brmgeo.locate import masks as locating
from brmgeo.locate.flights import view_at
from brmgeo.locate.maps import match_settings, read_maps
from brmgeo.match.rates import RateLearner
from brmgeo.match.register import Registrar
from brmgeo.region import FlightSettings
from brmgeo.workflow.progress import Progress

Say = Callable[..., Said]


# ---------------------------------------------------------------- localize


def frames_of(flight: Path) -> list[str]:
    return [frame.file for frame in read_flight(flight).frames]


@pytest.mark.slow
def test_localize_runs_the_network_where_there_are_no_masks(
    maps: Path, pictured: Path, weights: Path, tmp_path: Path, say: Say, asked: list
) -> None:
    before = bytes_of(pictured)
    words = ["localize", "--maps", maps, "--flight", pictured, "--weights", weights, "--out", tmp_path / "a"]
    said = say(*words)
    assert said.code == 0, said.err
    frames = len(frames_of(pictured))
    assert asked == [(480, 640, 3)] * frames
    assert bytes_of(pictured) == before
    metrics = json.loads((tmp_path / "a/metrics.json").read_text())
    assert metrics["masks"].startswith("network bright abababababab (ONNX Runtime), ")
    assert metrics["settings"]["localize"]["network"] == {
        "weights": "ab" * 32, "backend": "onnx", "looks": 1, "answer": "mask"
    }  # fmt: skip
    assert metrics["data"] == "simulated"
    assert metrics["false_fixes"] == 0
    assert metrics["rmse_after_first_fix_m"] < 5
    assert "network bright abababababab" in (tmp_path / "a/report.html").read_text()
    assert len([p for p in (tmp_path / ".brmgeo-masks").rglob("*") if p.is_file()]) == frames
    fixes = (tmp_path / "a/fixes.csv").read_bytes()
    said = say(*words)
    assert len(asked) == frames
    assert f"{frames} of {frames} frames were known" in said.err
    assert (tmp_path / "a/fixes.csv").read_bytes() == fixes


def test_given_masks_are_used_unless_the_network_is_wanted(
    maps: Path, waypoints: Path, weights: Path, tmp_path: Path, say: Say, asked: list
) -> None:
    folder = make_flight(maps, waypoints, tmp_path / "f", "--mode", "both")
    flight, quiet = read_flight(folder), Progress(quiet=True)
    with locating.frame_masks(flight, "as given", locating.NetworkUse(), quiet) as masks:
        assert masks.source == "as given"
        assert (masks.image(1) == flight.mask(1)).all()
    assert not asked
    for use in (locating.NetworkUse(weights=weights), locating.NetworkUse(wanted="network", weights=weights)):
        asked.clear()
        with locating.frame_masks(flight, "as given", use, quiet) as masks:
            assert masks.source.startswith("network bright")
        assert len(asked) == len(flight.frames)
    shutil.rmtree(folder / "frames")
    words = ("localize", "--maps", maps, "--flight", folder, "--out", tmp_path / "out")
    assert "has no frames" in say(*words, "--weights", weights).line
    assert "has no frames" in say(*words, "--masks", "network").line


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: f.write_bytes(f.read_bytes()[:9000]), "cut short"),
        (lambda f: cv2.imwrite(str(f), np.zeros((480, 641, 3), np.uint8)), "641 x 480"),
    ],
)
def test_damaged_frames_are_refused_in_one_line(
    maps: Path,
    pictured: Path,
    weights: Path,
    tmp_path: Path,
    say: Say,
    spoil: Callable[[Path], object],
    words: str,
) -> None:
    flight = Path(shutil.copytree(pictured, tmp_path / "f"))
    frame = sorted((flight / "frames").iterdir())[1]
    spoil(frame)
    said = say(
        "localize", "--maps", maps, "--flight", flight, "--weights", weights, "--out", tmp_path / "out"
    )
    assert words in said.line
    assert frame.name in said.line
    assert not (tmp_path / "out").exists()


def test_bad_weights_are_refused_before_anything_is_done(
    maps: Path,
    pictured: Path,
    weights: Path,
    tmp_path: Path,
    say: Say,
) -> None:
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(weights.read_bytes()[:-1])
    words = ("localize", "--maps", maps, "--flight", pictured, "--out", tmp_path / "out", "--weights")
    assert "SHA-256 differs" in say(*words, bad).line
    assert "no such weights" in say(*words, tmp_path / "none.safetensors").line
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- the real flight


@pytest.mark.slow
def test_every_real_frame_registers_on_the_map_by_the_shipped_network(
    real_maps: Path, tmp_path: Path
) -> None:
    """The whole chain on a real flight that the network was never trained on: pictures, masks, registration."""
    built, flight = read_maps(real_maps), read_flight(REAL)
    reference = flight.reference(built.crs)
    assert reference is not None
    truth = reference.at(flight.times_s)
    yaws = flight.compass_yaw_rad(built.crs, *truth[0])
    rates = RateLearner(match_settings(FlightSettings()).rates).rates
    registrar = Registrar(built.ground)
    use = locating.NetworkUse(wanted="network", cache=tmp_path)
    apart = []
    with locating.frame_masks(flight, "", use, Progress(quiet=True)) as masks:
        for i, (xy, yaw) in enumerate(zip(truth, yaws, strict=True)):
            given = view_at(flight, built.ground.gsd_m, i)
            if given.building.sum() * given.gsd_m**2 < 20.0:
                continue  # no roof in sight
            view = view_at(flight, built.ground.gsd_m, i, masks)
            assert yaw is not None
            found = registrar.register(view, np.array([*xy, yaw]), 10.0, 0.1, rates)
            apart.append(10.0 if found is None else math.dist(found.pose[:2], xy))
    assert len(apart) >= 75
    assert np.median(apart) < 2.0, np.percentile(apart, [25, 50, 75, 90])
