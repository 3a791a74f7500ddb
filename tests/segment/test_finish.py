"""The end of a training run: scores, terms, the looks that are kept, and files that come whole or not at all."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from brmgeo.files import WRITTEN
from brmgeo.segment import finish as ending
from brmgeo.segment.finish import licence_of, score
from brmgeo.segment.ground import ScoredFrame
from brmgeo.segment.metrics import LogitHistogram
from brmgeo.segment.predict import Segmenter
from brmgeo.segment.recipe import Recipe
from brmgeo.segment.unet import UNet, UNetSettings

RECIPE = Recipe(title="tiny", work_gsd_m=0.25, source=(), unet=UNetSettings(widths=(8, 16)))


def finish(state: dict[str, Any], ground: Any, out: Path) -> dict[str, Any]:
    def say(line: str) -> None:
        assert line

    return ending.finish(
        state, RECIPE, ground, out, steps=4, reliability=lambda told: " ".join(told).encode(), say=say
    )


def test_answers_are_scored_as_they_are_and_laid_down() -> None:
    label = np.zeros((60, 80), np.uint8)
    label[20:40, 10:50] = 255
    label[:, 70:] = 127
    seen = np.roll(label == 255, -4, axis=0).astype(np.float32)  # roofs stand four rows above their outlines

    def laid(answer: np.ndarray) -> np.ndarray:
        down = np.roll(answer, 4, axis=0)
        down[:4] = np.nan
        return down

    picture = ScoredFrame(lambda: (np.zeros((60, 80, 3), np.uint8), label), 0.2, laid, 2.0)
    segmenter: Any = types.SimpleNamespace(
        probability=lambda image, gsd_m: seen, card=types.SimpleNamespace(threshold=0.5)
    )
    found = score(segmenter, [picture, picture])
    assert set(found) == {"", ", laid down from 2 m"}
    assert found[""].summary()["iou"] == pytest.approx(16 / 24, abs=1e-4)
    assert found[", laid down from 2 m"].summary()["iou"] == 1.0
    # Two frames: the whole but for unknown ground, and in the second row but for what lies beyond the frame.
    known = [s.hit + s.false + s.missed + s.rest for s in found.values()]
    assert known == [2 * 60 * 70, 2 * 56 * 70]


def test_the_card_names_the_terms_of_what_it_went_on_from() -> None:
    credits = [
        {"name": "far", "attribution": "Those who flew", "licence": "CC BY 4.0"},
        {"name": "weights 0123, which it went on from", "licence": "ODbL 1.0"},
        {"name": "own"},
    ]
    assert licence_of(credits) == (
        "Apache-2.0 for the weights; trained on far: Those who flew (CC BY 4.0); "
        "weights 0123, which it went on from: ODbL 1.0"
    )
    earlier = {"sources": [*credits[:2], {"name": "near", "licence": "CC0"}]}
    third = {
        "name": "weights 4567",
        "kind": "start",
        "licence": "Apache-2.0 for the weights; and all of it again",
        "data": earlier,
    }
    assert licence_of([credits[0], third]) == (
        "Apache-2.0 for the weights; trained on far: Those who flew (CC BY 4.0); "
        "weights 0123, which it went on from: ODbL 1.0; near: CC0"
    )
    # Terms of foreign weights are never lost behind those of what they were trained on.
    foreign = {"name": "weights 89ab", "kind": "start", "licence": "CC BY-NC 4.0"}
    for sources, more in (
        ([], ""),
        (["towns of X"], ""),
        ([{"name": "own"}], ""),
        ([{"name": "near", "licence": "CC0"}], "; near: CC0"),
    ):
        assert licence_of([{**foreign, "data": {"sources": sources}}]) == (
            f"Apache-2.0 for the weights; trained on weights 89ab: CC BY-NC 4.0{more}"
        )


@pytest.mark.parametrize("better", [1, 2])
def test_weights_are_for_the_looks_that_validation_asks_for(
    better: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    label = np.where(rng.random((100, 100)) < 0.3, 255, 0).astype(np.uint8)

    def histograms(segmenter: Segmenter, _: object) -> list[LogitHistogram]:
        own = LogitHistogram()
        noise = rng.normal(0.0, 2.0 if segmenter.looks == better else 4.0, label.shape)
        own.add((np.where(label == 255, 2.0, -2.0) + noise).astype(np.float32), label)
        return [own]

    monkeypatch.setattr(ending, "histograms", histograms)
    monkeypatch.setattr(ending, "export_onnx", lambda weights, out: out.touch())
    torch.manual_seed(0)
    ground: Any = types.SimpleNamespace(validation={}, test={}, credits=[])
    facts = finish(UNet(RECIPE.unet).state_dict(), ground, tmp_path)
    assert facts["calibration"]["looks"] == better
    assert Segmenter.load(tmp_path / "model.safetensors", "torch").looks == better


def test_a_run_that_ends_while_it_finishes_leaves_the_weights_of_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    image = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    label = np.where(image[..., 0] > 128, 255, 0).astype(np.uint8)
    frames = {"held": [ScoredFrame(lambda: (image, label), 0.25)]}
    ground: Any = types.SimpleNamespace(validation=frames, test={}, credits=[])

    def run(seed: int) -> None:
        torch.manual_seed(seed)
        finish(UNet(RECIPE.unet).state_dict(), ground, tmp_path)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    def files() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}

    with monkeypatch.context() as at_the_end:
        at_the_end.setattr(ending, "score", killed)  # weights are calibrated by then
        with pytest.raises(KeyboardInterrupt):
            run(1)
        assert files() == {}
    (tmp_path / "metrics.json").write_text("of earlier weights")
    run(2)
    before = files()
    assert set(before) == {
        "model.safetensors", "model.md", "model.onnx", "reliability.png", "metrics.edited.json", WRITTEN,
    }  # fmt: skip
    assert not [p for p in tmp_path.iterdir() if p.is_dir()]
    monkeypatch.setattr(ending, "score", killed)
    with pytest.raises(KeyboardInterrupt):
        run(3)
    assert files() == before
