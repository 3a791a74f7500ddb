"""Training: a killed run ends as one that was not, the loss ignores what is unknown, and a tiny network really learns."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from brmgeo.errors import InputError, SettingsError
from brmgeo.segment import train as engine
from brmgeo.segment.augment import AugmentSettings
from brmgeo.segment.samples import Scene, Scenes
from brmgeo.segment.train import Epoch, Run, Trainer, TrainSettings, loss_of, rate_at, validation_crops
from brmgeo.segment.unet import UNetSettings

TINY = UNetSettings(widths=(8, 16, 24))
SETTINGS = TrainSettings(
    seed=3, steps=8, batch=2, crop_px=32, warmup_steps=2, epoch_steps=3, checkpoint_steps=2, threads=1, device="cpu",
    accumulate=2,
)  # fmt: skip


def town(seed: int) -> Scene:
    """Bright squares on dark, noisy ground; a corner is unknown."""
    rng = np.random.default_rng(seed)
    image = rng.normal(70, 12, (160, 160, 3))
    label = np.zeros((160, 160), np.uint8)
    for _ in range(14):
        r, c, h, w = *rng.integers(0, 140, 2), *rng.integers(8, 24, 2)
        label[r : r + h, c : c + w] = 255
        image[r : r + h, c : c + w] = rng.normal(190, 12, image[r : r + h, c : c + w].shape)
    label[:20, :20] = 127
    return Scene(np.clip(image, 0, 255).astype(np.uint8), label, 0.3)


@pytest.fixture(scope="module")
def crops() -> tuple[np.ndarray, np.ndarray]:
    return validation_crops([Scenes([town(9)])], 6, 32, 0.3)


def trainer(folder: Path, crops: Any, settings: TrainSettings = SETTINGS, data: str = "towns") -> Trainer:
    return Trainer(TINY, settings, AugmentSettings(), Scenes([town(1), town(2)]), crops, folder, data)


def state_of(run: Run) -> dict[str, torch.Tensor]:
    parts = {"model": run.model.state_dict(), "average": run.average.state_dict(), "best": run.best}
    return {f"{part}/{name}": t for part, state in parts.items() for name, t in state.items()}


class Killed(BaseException):
    """As abrupt as a signal: no handler of the library catches it."""


@pytest.mark.parametrize("killed_at", [1, 2, 3, 5, 7])
def test_a_killed_run_ends_as_one_that_was_not(tmp_path: Path, crops: Any, killed_at: int) -> None:
    whole = trainer(tmp_path / "whole", crops).train()

    def kill(step: int, loss: float) -> None:
        if step == killed_at:
            raise Killed

    with pytest.raises(Killed):
        trainer(tmp_path / "killed", crops).train(on_step=kill)
    resumed = trainer(tmp_path / "killed", crops).train()
    assert resumed.step == whole.step == 8
    assert resumed.history == whole.history
    for name, tensor in state_of(whole).items():
        assert torch.equal(tensor, state_of(resumed)[name]), name


@pytest.mark.parametrize("killed_at", [3, 5, 7])
def test_the_mean_of_late_epochs_is_kept_through_a_kill(tmp_path: Path, crops: Any, killed_at: int) -> None:
    settings = dataclasses.replace(SETTINGS, epoch_steps=2, mean_from=4)
    epochs: list[dict[str, torch.Tensor]] = []

    def keep(run: Run, probability: np.ndarray) -> None:
        if run.step >= 4:
            epochs.append({k: t.clone().double() for k, t in run.average.state_dict().items()})

    whole = trainer(tmp_path / "whole", crops, settings).train(on_epoch=keep)
    assert len(epochs) == 3
    for name, tensor in whole.best.items():
        mean = sum(e[name] for e in epochs) / 3
        wanted = mean if tensor.is_floating_point() else epochs[-1][name]
        torch.testing.assert_close(tensor.double(), wanted, atol=1e-6, rtol=1e-5)
    assert any(not torch.equal(t, whole.average.state_dict()[n]) for n, t in whole.best.items())

    def kill(step: int, loss: float) -> None:
        if step == killed_at:
            raise Killed

    with pytest.raises(Killed):
        trainer(tmp_path / "killed", crops, settings).train(on_step=kill)
    resumed = trainer(tmp_path / "killed", crops, settings).train()
    for name, tensor in state_of(whole).items():
        assert torch.equal(tensor, state_of(resumed)[name]), name


LITE = UNetSettings(widths=(8, 8, 8, 8, 8), encoder="efficientnet-lite0")
LITE_SETTINGS = dataclasses.replace(
    SETTINGS,
    steps=3,
    batch=2,
    accumulate=1,
    crop_px=64,
    warmup_steps=1,
    epoch_steps=2,
    encoder_lr=0.25,
    weight_decay=0.0,
)


def lite(folder: Path, settings: TrainSettings = LITE_SETTINGS) -> Trainer:
    source = Scenes([town(1)])
    return Trainer(
        LITE, settings, AugmentSettings(grey=0.5), source, validation_crops([source], 2, 64, 0.3), folder
    )


def test_a_killed_run_of_a_pretrained_kind_ends_as_one_that_was_not(tmp_path: Path) -> None:
    whole = lite(tmp_path / "whole").train()

    def kill(step: int, loss: float) -> None:
        if step == 2:
            raise Killed

    with pytest.raises(Killed):
        lite(tmp_path / "killed", LITE_SETTINGS).train(on_step=kill)
    resumed = lite(tmp_path / "killed").train()
    for name, tensor in state_of(whole).items():
        assert torch.equal(tensor, state_of(resumed)[name]), name


def test_the_encoder_learns_at_its_own_rate_and_every_weight_learns(tmp_path: Path) -> None:
    own = lite(tmp_path)
    run = own.start()
    own.advance(run)
    rates = {id(p): g["lr"] for g in run.optimiser.param_groups for p in g["params"]}
    full = rate_at(0, LITE_SETTINGS)
    for name, parameter in run.model.named_parameters():
        assert rates[id(parameter)] == pytest.approx(full * (0.25 if name.startswith("encoder.") else 1.0)), (
            name
        )


def test_imagenet_weights_are_where_a_run_starts_and_nothing_else_needs_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = dataclasses.replace(LITE_SETTINGS, imagenet=True, steps=1, warmup_steps=0)
    started: list[Path] = []
    monkeypatch.setattr(engine, "imagenet_weights", lambda: tmp_path / "published.pth")
    monkeypatch.setattr(engine, "start_from_imagenet", lambda encoder, path, mean, std: started.append(path))
    own = lite(tmp_path / "run", settings)
    own.save(own.start())
    assert started == [tmp_path / "published.pth"]
    lite(tmp_path / "run", settings).start()
    source = Scenes([town(1)])
    given = engine.tensors_of(own.start().best)
    Trainer(
        LITE, settings, AugmentSettings(), source, (np.empty(0), np.empty(0)), tmp_path / "b", "", given
    ).start()
    assert len(started) == 1


@pytest.mark.parametrize("changes", [{"imagenet": True}, {"encoder_lr": 0.5}])
def test_what_only_a_pretrained_encoder_has_is_refused_without_one(changes: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=r"need \[unet\] encoder"):
        engine.require_fit(TINY, dataclasses.replace(SETTINGS, **changes))


def test_one_crop_of_one_coarsest_pixel_is_refused() -> None:
    alone = dataclasses.replace(SETTINGS, batch=1, crop_px=32)
    with pytest.raises(SettingsError, match="give a larger batch"):
        engine.require_fit(LITE, alone)
    engine.require_fit(TINY, alone)


def test_a_finished_run_has_nothing_left_to_do(tmp_path: Path, crops: Any) -> None:
    trainer(tmp_path, crops).train()
    steps: list[int] = []
    again = trainer(tmp_path, crops).train(on_step=lambda step, loss: steps.append(step))
    assert not steps
    assert [e.step for e in again.history] == [3, 6, 8]


def test_an_interrupted_write_leaves_the_checkpoint_before(
    tmp_path: Path, crops: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = trainer(tmp_path, crops)
    run = own.start()
    own.advance(run)
    own.save(run)
    before = (tmp_path / "checkpoint.safetensors").read_bytes()

    def torn(tensors: Any, path: Path, metadata: Any) -> None:
        path.write_bytes(before[:100])
        raise Killed

    monkeypatch.setattr(engine, "save_file", torn)
    own.advance(run)
    with pytest.raises(Killed):
        own.save(run)
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.safetensors"]


def test_checkpoints_of_other_runs_and_damaged_ones_are_refused(tmp_path: Path, crops: Any) -> None:
    own = trainer(tmp_path, crops)
    run = own.start()
    own.save(run)
    with pytest.raises(InputError, match="other settings or data"):
        trainer(tmp_path, crops, data="other towns").start()
    with pytest.raises(InputError, match="other settings or data"):
        trainer(tmp_path, crops, dataclasses.replace(SETTINGS, lr=1e-3)).start()
    # What does not change the result may change.
    trainer(tmp_path, crops, dataclasses.replace(SETTINGS, checkpoint_steps=1)).start()
    path = tmp_path / "checkpoint.safetensors"
    with safe_open(path, "pt") as file:
        facts = json.loads(file.metadata()["brmgeo"])
    tensors = load_file(path)
    save_file(tensors, path, {"brmgeo": json.dumps(facts | {"version": 99})})
    with pytest.raises(InputError, match="another version"):
        own.start()
    for part in ("model", "best"):
        left = tensors.copy()
        left.pop(next(n for n in left if n.startswith(part) and n.endswith("weight")))
        save_file(left, path, {"brmgeo": json.dumps(facts)})
        with pytest.raises(InputError, match="not a whole checkpoint"):
            own.start()
    del facts["step"]
    save_file(tensors, path, {"brmgeo": json.dumps(facts)})
    with pytest.raises(InputError, match="not a whole checkpoint"):
        own.start()
    path.write_bytes(b"\x00" * 64)
    with pytest.raises(InputError, match="is not a checkpoint"):
        own.start()


def test_a_tiny_network_learns_bright_squares(tmp_path: Path, crops: Any) -> None:
    settings = TrainSettings(
        seed=1, steps=60, batch=4, crop_px=32, lr=1e-2, warmup_steps=5, epoch_steps=30, ema=0.9, device="cpu"
    )
    mild = AugmentSettings(roofs=0, objects=0, colour=0.2, haze=0, shadow=0, gsd_m=(0.25, 0.35))
    own = Trainer(TINY, settings, mild, Scenes([town(1), town(2)]), crops, tmp_path)
    seen: list[np.ndarray] = []
    run = own.train(lambda run, probability: seen.append(probability))
    assert run.history[-1].validation_iou > 0.85
    assert seen[-1].shape == crops[1].shape
    assert run.history[-1].loss < run.history[0].loss
    np.testing.assert_allclose(seen[-1], 1 / (1 + np.exp(-engine.predict(run.average, crops[0]))), atol=1e-5)


def test_a_run_goes_on_from_given_weights_or_refuses_them(tmp_path: Path, crops: Any) -> None:
    first = trainer(tmp_path / "first", crops).train()
    weights = engine.tensors_of(first.best)
    source, mild = Scenes([town(1)]), AugmentSettings()
    second = Trainer(TINY, SETTINGS, mild, source, crops, tmp_path / "second", "", weights)
    for name, tensor in second.start().model.state_dict().items():
        np.testing.assert_array_equal(tensor.numpy(), weights[name])
    second.save(second.start())
    with pytest.raises(InputError, match="other settings or data"):
        Trainer(TINY, SETTINGS, mild, source, crops, tmp_path / "second", "").start()
    other = UNetSettings(widths=(8, 16, 32))
    with pytest.raises(InputError, match=r"not of a U-Net .* encoder plain"):
        Trainer(other, SETTINGS, mild, source, crops, tmp_path / "third", "", weights).start()


def test_a_run_that_comes_apart_stops_at_once(tmp_path: Path, crops: Any) -> None:
    own = trainer(tmp_path, crops)
    run = own.start()
    with torch.no_grad():
        next(run.model.parameters()).fill_(math.nan)
    own.save(run)
    before = (tmp_path / "checkpoint.safetensors").read_bytes()
    with pytest.raises(SettingsError, match="came apart at step 1"):
        own.train()
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == before


def test_patience_stops_a_run_that_gets_no_better(tmp_path: Path, crops: Any) -> None:
    own = trainer(tmp_path, crops, dataclasses.replace(SETTINGS, patience=2))
    run = own.start()
    run.step = 6
    run.history += [Epoch(1, 2, 1e-3, 1.0, 0.5, 0.3), Epoch(2, 4, 1e-3, 0.9, 0.6, 0.3)]
    own.save(run)
    assert own.train().step == 8  # one bad epoch is not two
    assert trainer(tmp_path, crops, dataclasses.replace(SETTINGS, patience=2)).start().step == 8
    run.history.append(Epoch(3, 6, 1e-3, 0.9, 0.6, 0.3))
    own.save(run)
    assert own.train().step == 6


def test_the_loss_is_that_of_the_formulas_and_blind_to_the_unknown() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (2, 6, 7))
    label = rng.choice(np.array([0, 255, 127], np.uint8), (2, 6, 7))
    s = TrainSettings(overlap_weight=0.7, false_positives=0.3, false_negatives=0.6)
    known, y = label != 127, label == 255
    p = 1 / (1 + np.exp(-logits))
    entropy = -np.where(y, np.log(p), np.log(1 - p))[known].mean()
    hit = (p * y)[known].sum()
    wrong = 0.3 * (p * ~y)[known].sum() + 0.6 * ((1 - p) * y)[known].sum()
    expected = entropy + 0.7 * (1 - (hit + 1) / (hit + wrong + 1))

    def loss(values: np.ndarray) -> float:
        x = torch.from_numpy(values[:, None].astype(np.float32))
        return float(loss_of(x, torch.from_numpy(label), s))

    assert loss(logits) == pytest.approx(expected, rel=1e-5)
    assert loss(np.where(known, logits, 50.0)) == pytest.approx(expected, rel=1e-5)
    nothing = torch.full((1, 4, 4), 127, dtype=torch.uint8)
    assert float(loss_of(torch.zeros(1, 1, 4, 4), nothing, s)) == pytest.approx(0.0, abs=1e-6)


def test_the_rate_rises_then_falls_to_a_hundredth() -> None:
    s = TrainSettings(steps=100, warmup_steps=10, lr=0.5)
    rates = [rate_at(k, s) for k in range(100)]
    assert rates[0] == pytest.approx(0.05)
    assert max(rates) == rates[10] == pytest.approx(0.5)
    assert all(a > b for a, b in itertools.pairwise(rates[10:]))
    assert rate_at(55, s) == pytest.approx(0.5 * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi / 2))))
    assert rates[-1] == pytest.approx(0.005, rel=0.1)


@pytest.mark.parametrize(
    "bad", [{"steps": 0}, {"lr": 0.0}, {"ema": 1.0}, {"warmup_steps": 2000}, {"device": "tpu"}, {"batch": 0}, {"seed": -1},
     {"stop_after": -5}, {"mean_from": 2001}, {"encoder_lr": 0.0}, {"encoder_lr": 1.5}],
)  # fmt: skip
def test_settings_that_cannot_train_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=next(iter(bad))):
        TrainSettings(**bad)


def test_crops_must_fit_the_network(tmp_path: Path, crops: Any) -> None:
    with pytest.raises(SettingsError, match="multiples of 4"):
        trainer(tmp_path, crops, dataclasses.replace(SETTINGS, crop_px=30))


def test_crops_drawn_ahead_are_those_of_their_step(tmp_path: Path, crops: Any) -> None:
    one = trainer(tmp_path, crops)
    run = one.start()
    for _ in range(3):
        one.advance(run)
    source = Scenes([town(1), town(2)])
    for key in ((3, 0), (3, 1), (4, 0)):
        images, labels = one._crops(*key)
        wanted = engine.batch_of(source, 3, *key, 2, 32, AugmentSettings())
        assert np.array_equal(images, wanted[0])
        assert np.array_equal(labels, wanted[1])


def test_compiling_without_a_compiler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(SettingsError, match=r"needs a C\+\+ compiler"):
        engine.require_fit(UNetSettings(widths=(8, 16)), TrainSettings(compile=True))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch compiles with its own old parts
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_compiled_run_learns_what_a_plain_one_learns(tmp_path: Path, crops: Any) -> None:
    plain = trainer(tmp_path / "plain", crops).train()
    fused = trainer(tmp_path / "fused", crops, dataclasses.replace(SETTINGS, compile=True, threads=1)).train()
    for name, tensor in state_of(plain).items():
        torch.testing.assert_close(tensor, state_of(fused)[name], rtol=0.02, atol=0.02)
