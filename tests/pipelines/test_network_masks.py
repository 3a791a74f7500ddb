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
import shapely
from small_flights import REAL, Said, bytes_of, make_flight
from small_networks import bright_onnx, small_card

from brmgeo.flight.folder import read_flight
from brmgeo.flight.readings import Attitude
from brmgeo.flight.view import make_view
from brmgeo.locate import masks as locating
from brmgeo.locate.live import view_at
from brmgeo.locate.maps import match_settings, read_maps
from brmgeo.match.rates import RateLearner
from brmgeo.match.register import Registrar
from brmgeo.region import FlightSettings
from brmgeo.segment.predict import Answer, Segmenter
from brmgeo.synth.flight import FlightSettings as Simulated
from brmgeo.synth.flight import Ground, Simulator, fly
from brmgeo.workflow.progress import Progress

Say = Callable[..., Said]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The shape of every picture that a network has been asked about."""
    seen: list[tuple[int, ...]] = []
    own = Segmenter.probabilities

    def counted(self: Segmenter, images: list, gsds: list) -> list:
        seen.extend(i.rgb.shape for i in images)
        return own(self, images, gsds)

    monkeypatch.setattr(Segmenter, "probabilities", counted)
    return seen


# ---------------------------------------------------------------- localize


def frames_of(flight: Path) -> list[str]:
    return [frame.file for frame in read_flight(flight).frames]


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
    frame = flight / "frames" / frames_of(flight)[3]
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
    ground = Ground.from_polygons(boxes, [6.0] * len(boxes))
    own = Simulated(mount=Attitude(pitch_rad=math.radians(-15)), agl_m=100.0, agl_sigma_m=0.0).exact()
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
