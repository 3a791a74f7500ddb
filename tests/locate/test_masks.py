"""Masks of frames: what the network says of them, kept by content, and laid where the outlines are."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from small_flights import exact
from small_networks import bright_onnx, small_card

from brmgeo.flight.folder import read_flight
from brmgeo.flight.readings import Attitude
from brmgeo.flight.view import make_view
from brmgeo.locate import masks as locating
from brmgeo.segment.predict import Answer, Segmenter
from brmgeo.synth.flight import RaisedFootprints, Simulator, fly
from brmgeo.synth.flight import SimulationSettings as Simulated
from brmgeo.workflow.progress import Progress


def test_the_network_is_asked_only_of_what_it_has_not_seen(
    pictured: Path, weights: Path, tmp_path: Path, asked: list
) -> None:
    cache = tmp_path / "cache"

    def ask(folder: Path, weights_file: Path, looks: int | None = None) -> list[bytes]:
        asked.clear()
        flight = read_flight(folder)
        use = locating.NetworkUse(weights=weights_file, cache=cache, looks=looks)
        with locating.frame_masks(flight, "", use, Progress(quiet=True)) as masks:
            return [masks.image(i).tobytes() for i in range(len(flight.frames))]

    first = ask(pictured, weights)
    assert len(asked) == len(first)
    assert ask(pictured, weights) == first
    assert not asked
    kept = sorted(p for p in cache.rglob("*") if p.is_file())[0]
    for damage in (b"damaged", cv2.imencode(".png", np.zeros((10, 10), np.uint8))[1].tobytes()):
        kept.write_bytes(damage)
        assert ask(pictured, weights) == first
        assert len(asked) == 1
    flight = Path(shutil.copytree(pictured, tmp_path / "f"))
    frame = flight / "frames" / read_flight(flight).frames[3].file
    cv2.imwrite(str(frame), cv2.imread(str(frame))[::-1])
    changed = ask(flight, weights)
    assert [a == b for a, b in zip(changed, first, strict=True)] == [i != 3 for i in range(len(first))]
    assert len(asked) == 1
    text = (flight / "flight.toml").read_text()
    (flight / "flight.toml").write_text(
        text.replace('source = "frames"', 'source = "fixed"\nfixed_m = 1500.0')
    )
    ask(flight, weights)
    assert len(asked) == len(first), "from another height the frames are resampled"
    ask(pictured, bright_onnx(tmp_path / "other.onnx", small_card(sha256="cd" * 32)))
    assert len(asked) == len(first)
    assert ask(pictured, weights, looks=2) != first
    assert len(asked) == len(first), "two looks are another answer"


@pytest.mark.parametrize("answer", ["mask", "probability"])
def test_masks_are_what_the_network_says(pictured: Path, weights: Path, answer: Answer) -> None:
    flight = read_flight(pictured)
    segmenter = Segmenter.load(weights)
    use = locating.NetworkUse(weights=weights, answer=answer)
    with locating.frame_masks(flight, "", use, Progress(quiet=True)) as masks:
        image = masks.image(2)
        wanted = segmenter.probability(flight.image(2), locating.frame_gsd_m(flight, 2))
        if answer == "probability":
            assert image.dtype == np.float32
            np.testing.assert_allclose(image, wanted, atol=0.5 / locating.STEPS + 1e-6)
        else:
            apart = (image > 0) != (wanted > 0.5)
            assert (np.abs(wanted[apart] - 0.5) < 1 / locating.STEPS).all()
            assert set(np.unique(image)) == {0, 255}
        files = masks.files
    assert files is not None
    assert not files[0].exists(), "without a cache nothing is left behind"


def test_a_network_over_ground_it_was_trained_on_is_told(
    pictured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = [{"name": "t", "regions": ["town-a"]}, {"name": "g", "split": "test", "regions": ["town-g"]}]
    own = bright_onnx(tmp_path / "own.onnx", small_card(data={"sources": sources}))
    card = Segmenter.load(own, threads=1).card
    assert locating.trained_over(card, "town-g") == locating.trained_over(card, "") == ""
    assert "trained on region town-a" in locating.network_warning(own, "town-a")
    flight = read_flight(pictured)
    with locating.frame_masks(flight, "", locating.NetworkUse(weights=own), Progress(), "town-a"):
        assert "trained on region town-a" in capsys.readouterr().err
    # What the weights that it went on from were trained on counts, however long ago.
    started = {"kind": "start", "data": {"sources": [{"kind": "start", "data": card.data}]}}
    later = small_card(data={"sources": [started, {"name": "others", "regions": ["town-x"]}]})
    assert "trained on region town-a" in locating.trained_over(later, "town-a")
    assert locating.trained_over(later, "town-g") == ""


@pytest.mark.parametrize("regions", [None, 5, [["demo"]], "demo"])
def test_a_card_of_another_form_says_nothing(regions: object) -> None:
    assert locating.trained_over(small_card(data={"sources": [{"regions": regions}, "demo"]}), "demo") == ""


def test_roofs_are_laid_where_their_outlines_are_on_the_ground() -> None:
    """Boxes 6 m high seen from 100 m aslant: laid onto a plane at 6 m their roofs are the map's outlines."""
    rng = np.random.default_rng(3)
    at = [(x, y) for x in range(0, 200, 25) for y in range(0, 200, 25)]
    boxes = [
        shapely.box(x, y, x + w, y + h)
        for (x, y), (w, h) in zip(at, rng.uniform(6, 16, (64, 2)), strict=True)
    ]
    ground = RaisedFootprints.from_polygons(boxes, [6.0] * len(boxes))
    own = exact(Simulated(mount=Attitude(pitch_rad=math.radians(-15)), agl_m=100.0, agl_sigma_m=0.0))
    path = np.array([[60.0, 100.0], [120.0, 100.0]])
    simulator = Simulator(ground, own, fly(path, own, 1), 1)
    pose = simulator.course

    def overlap(relief: bool, roof_m: float) -> float:
        view = make_view(
            simulator.mask(1, relief), own.camera, own.mount, math.radians(pose.measured_roll_deg[1]),
            math.radians(pose.measured_pitch_deg[1]), locating.above_roofs_m(100.0, roof_m), 0.25,
        )  # fmt: skip
        rows, cols = np.indices(view.building.shape) + 0.5
        ahead, left = (view.nadir_px[0] - rows) * 0.25, (view.nadir_px[1] - cols) * 0.25
        x, y, _ = pose.xyz_m[pose.frame_index[1]]
        yaw = pose.roll_pitch_yaw[pose.frame_index[1], 2]
        c, s = math.cos(yaw), math.sin(yaw)
        there = shapely.union_all(boxes)
        built = shapely.contains_xy(there, x + ahead * c - left * s, y + ahead * s + left * c) & view.known
        seen = (view.building > 0.5) & view.known
        return float((built & seen).sum() / (built | seen).sum())

    assert overlap(False, 0.0) > 0.97
    assert overlap(True, 6.0) > 0.95
    assert overlap(True, 0.0) < 0.85
    assert locating.above_roofs_m(4.0, 3.0) == 2.0
