"""Training the U-Net: loss, schedule, averaged weights, and a run that can be killed at any moment and taken up again.

Step k sees crops that follow from (seed, k, place in the batch) and from nothing else, so nothing but the step's number,
the weights and the optimiser's moments is needed to go on: a run that was killed and resumed gives the same weights, bit
for bit on the same CPU with the same number of threads, as one that was not; on a GPU, whose sums come in no fixed order,
nearly the same. The checkpoint is one safetensors
file that replaces the one before atomically.

AdamW (Loshchilov and Hutter 2019) under a cosine schedule with linear warm-up; binary cross-entropy plus a Tversky term
(Salehi et al. 2017; soft Dice where both of its weights are one half) against the imbalance of buildings and ground;
an exponential moving average of all weights, which is what is validated, and of the best epoch or as a mean of many is kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import safetensors
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import InputError, SettingsError
from brmgeo.files import digest_of, json_of, whole_file
from brmgeo.segment.augment import MEAN, STD, AugmentSettings, Source, draw_crop
from brmgeo.segment.imagenet import imagenet_weights, start_from_imagenet
from brmgeo.segment.unet import UNet, UNetSettings
from brmgeo.settings import require_within

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
FORMAT, VERSION = "brmgeo-checkpoint", 1
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """One training run.

    Attributes:
        seed: of the weights and of every crop.
        steps: of the optimiser, at most; the schedule of the learning rate is laid out for them.
        stop_after: steps after which to stop before that; 0: never. For a run that another one goes on from.
        batch: crops a forward pass; accumulate: passes a step (their gradients are averaged).
        crop_px: side of a crop, a multiple of the U-Net's ``multiple_px``.
        lr, warmup_steps: the highest learning rate, and the steps to reach it; then a cosine down to a hundredth.
        encoder_lr: the same of a ``efficientnet-lite0`` encoder, as a share of lr: less keeps more of what it knew.
        weight_decay: of convolution weights; norms and biases have none.
        ema: decay of the moving average of the weights, a step.
        mean_from: the step from which on the weights that are kept are the plain mean of all epochs' moving averages
            (Izmailov et al. 2018, Cha et al. 2021: better on ground of another kind), batch normalisation's statistics
            among them; 0, or where patience ends the run before: those of the best epoch.
        overlap_weight: of the Tversky term, beside cross-entropy's 1.
        false_positives, false_negatives: weights of the two errors in the Tversky term.
        epoch_steps: steps between validations.
        patience: epochs without a better validation loss after which training stops; 0: never.
        checkpoint_steps: steps between checkpoints; one is also written at every epoch.
        threads: of torch; 0 leaves them as they are.
        device: ``cpu``, ``cuda``, or ``auto``: a GPU where there is one, in bfloat16.
        imagenet: start a ``efficientnet-lite0`` encoder from weights learned on ImageNet, in place of random ones; not
            where the whole network goes on from weights of its own.
        compile: let torch.compile fuse the network's passes; a step then takes 0.7 times as long on one core, 0.9 times
            on two, after half a minute of compiling. Needs a C++ compiler.

    Raises SettingsError for values that no run can have.
    """

    seed: int = 1
    steps: int = 2000
    stop_after: int = 0
    batch: int = 6
    accumulate: int = 1
    crop_px: int = 192
    lr: float = 2e-3
    warmup_steps: int = 100
    encoder_lr: float = 1.0
    weight_decay: float = 0.01
    ema: float = 0.995
    mean_from: int = 0
    overlap_weight: float = 0.5
    false_positives: float = 0.5
    false_negatives: float = 0.5
    epoch_steps: int = 100
    patience: int = 0
    checkpoint_steps: int = 50
    threads: int = 0
    device: Device = "auto"
    imagenet: bool = False
    compile: bool = False

    def __post_init__(self) -> None:
        counts = ("steps", "batch", "accumulate", "crop_px", "epoch_steps", "checkpoint_steps")
        require_within(self, **dict.fromkeys(counts, (1, math.inf)))
        require_within(
            self, **dict.fromkeys(("seed", "stop_after", "mean_from", "patience", "threads"), (0, math.inf))
        )
        if not 0 < self.encoder_lr <= 1:
            raise SettingsError(
                f"training encoder_lr {self.encoder_lr}: give a share of lr, above 0 and at most 1"
            )
        if not 0 < self.lr < 1 or not 0 <= self.ema < 1 or not 0 <= self.warmup_steps < self.steps:
            raise SettingsError(
                f"training lr {self.lr}, ema {self.ema}, warmup_steps {self.warmup_steps}: lr lies in (0, 1), "
                f"ema in [0, 1), the warm-up within the {self.steps} steps"
            )
        if self.mean_from and self.mean_from > min(self.steps, self.stop_after or self.steps):
            raise SettingsError(
                f"training mean_from {self.mean_from}: the run ends before it; give a step within it, or 0"
            )
        if self.device not in get_args(Device):
            raise SettingsError(f"training device {self.device!r}: give {', '.join(get_args(Device))}")


@dataclass(frozen=True, slots=True)
class Epoch:
    """What is known after an epoch: mean training loss, validation loss and IoU at 0.5 of the averaged weights."""

    epoch: int
    step: int
    lr: float
    loss: float
    validation_loss: float
    validation_iou: float


@dataclass(slots=True)
class Run:
    """A training run between two steps: everything that a checkpoint holds; ``best`` is what will be kept."""

    step: int
    model: UNet
    average: UNet
    best: dict[str, Tensor]
    optimiser: torch.optim.AdamW
    history: list[Epoch] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    @property
    def best_epoch(self) -> Epoch | None:
        """The epoch with the lowest validation loss."""
        return min(self.history, key=lambda e: e.validation_loss) if self.history else None


def normalised(image: U8) -> F32:
    """(..., h, w, 3) uint8 RGB to (..., 3, h, w) float32, (x / 255 - MEAN) / STD, as the network takes it."""
    x = (image.astype(np.float32) / 255.0 - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return np.ascontiguousarray(np.moveaxis(x, -1, -3))


def batch_of(
    source: Source, seed: int, step: int, part: int, size: int, crop_px: int, augment: AugmentSettings
) -> tuple[U8, U8]:
    """(n, s, s, 3) and (n, s, s) uint8: the crops of one forward pass, from (seed, step, part) alone."""
    crops = [
        draw_crop(source, np.random.default_rng([seed, step, part, k]), crop_px, augment) for k in range(size)
    ]
    return np.stack([c[0] for c in crops]), np.stack([c[1] for c in crops])


def loss_of(logits: Tensor, label: Tensor, settings: TrainSettings) -> Tensor:
    """The loss over known pixels: binary cross-entropy + weight * (1 - Tversky index of the batch).

    logits (n, 1, h, w) float; label (n, h, w) uint8. A batch without any known pixel costs 0.
    """
    x = logits.squeeze(1).float()
    known = (label != UNKNOWN).float()
    y = (label == BUILDING).float()
    count = known.sum().clamp(min=1.0)
    entropy = (functional.binary_cross_entropy_with_logits(x, y, reduction="none") * known).sum() / count
    p = torch.sigmoid(x) * known
    hit = (p * y).sum()
    wrong = settings.false_positives * (p * (1 - y)).sum()
    wrong = wrong + settings.false_negatives * ((1 - p) * y * known).sum()
    overlap = (hit + 1.0) / (hit + wrong + 1.0)
    return entropy + settings.overlap_weight * (1 - overlap)


def rate_at(step: int, settings: TrainSettings) -> float:
    """The learning rate of a step (from 0): linear warm-up, then a cosine down to a hundredth."""
    if step < settings.warmup_steps:
        return settings.lr * (step + 1) / settings.warmup_steps
    done = (step - settings.warmup_steps) / max(settings.steps - settings.warmup_steps, 1)
    return settings.lr * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))


def require_fit(unet: UNetSettings, settings: TrainSettings) -> None:
    """Raises SettingsError where a network cannot be trained with such settings."""
    multiple = unet.multiple_px
    named = f"a U-Net of {len(unet.widths)} levels, encoder {unet.encoder},"
    if settings.crop_px % multiple:
        raise SettingsError(f"crops of {settings.crop_px} px: {named} takes multiples of {multiple}")
    if settings.batch == 1 and settings.crop_px == multiple and unet.norm == "batch":
        raise SettingsError(
            f"batch 1 with crops of {multiple} px: the coarsest level of {named} sees one pixel, which batch normalisation "
            "cannot take; give a larger batch or larger crops"
        )
    if unet.encoder == "plain" and (settings.imagenet or settings.encoder_lr != 1.0):
        raise SettingsError(
            'training imagenet, encoder_lr: need [unet] encoder = "efficientnet-lite0"; the plain one has no such weights'
        )
    if settings.compile and not shutil.which(os.environ.get("CXX", "g++")):
        raise SettingsError(
            "training compile = true: needs a C++ compiler, and there is no g++ here (CXX names another); install one, "
            "or leave compile out"
        )


def checkpoint_of(folder: Path) -> Path:
    """Where the checkpoint of a run in a folder lies."""
    return folder / "checkpoint.safetensors"


class Trainer:
    """One training run in one folder.

    Args:
        unet, settings, augment: what is trained, and how.
        source: of training crops.
        validation: (images (n, s, s, 3) uint8, labels (n, s, s) uint8), the same for every epoch; held-out ground.
        folder: where ``checkpoint.safetensors`` lies.
        data: names the sources and their contents; a checkpoint of other data is not resumed.
        initial: weights to go on from (``UNet.state_dict`` as arrays), in place of random ones.

    Raises SettingsError for a crop size that the U-Net does not take, InputError for initial weights that do not fit it.
    """

    def __init__(
        self,
        unet: UNetSettings,
        settings: TrainSettings,
        augment: AugmentSettings,
        source: Source,
        validation: tuple[U8, U8],
        folder: Path,
        data: str = "",
        initial: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        require_fit(unet, settings)
        self._unet, self._settings, self._augment = unet, settings, augment
        self._source, self._validation = source, validation
        self._path = checkpoint_of(folder)
        what = {
            "unet": unet.plain(),
            "settings": {
                k: v
                for k, v in asdict(settings).items()
                if k not in ("threads", "device", "checkpoint_steps")
            },
            "augment": asdict(augment),
            "data": data,
        }
        self._initial = {name: torch.from_numpy(np.array(v)) for name, v in (initial or {}).items()}
        if initial:
            whole = hashlib.sha256()
            for name in sorted(initial):
                whole.update(name.encode() + np.ascontiguousarray(initial[name]).tobytes())
            what["initial"] = whole.hexdigest()
        self._digest = digest_of(json.dumps(what, sort_keys=True))
        gpu = settings.device != "cpu" and torch.cuda.is_available()
        if settings.device == "cuda" and not gpu:
            raise SettingsError("training device cuda: there is no GPU that torch can use; leave it at auto")
        self.device = torch.device("cuda" if gpu else "cpu")
        self._drawing: dict[tuple[int, int], Future[tuple[U8, U8]]] = {}
        self._drawers = ThreadPoolExecutor(1, "crops")
        self._forward: tuple[UNet, Callable[[Tensor], Tensor]] | None = None

    def start(self) -> Run:
        """The run of the checkpoint where there is one, otherwise a new one.

        Raises InputError where the checkpoint is damaged or of another run.
        """
        if self._settings.threads:
            torch.set_num_threads(self._settings.threads)
        with torch.random.fork_rng():
            torch.manual_seed(self._settings.seed)
            model = UNet(self._unet)
        if self._settings.imagenet and not self._initial and not self._path.exists():
            start_from_imagenet(model.encoder, imagenet_weights(), MEAN, STD)
        if self._initial:
            try:
                model.load_state_dict(self._initial)
            except RuntimeError:
                raise InputError(
                    f"the weights to go on from are not of a U-Net of the widths {list(self._unet.widths)}, "
                    f"{self._unet.norm} norm and encoder {self._unet.encoder}: give the recipe their settings"
                ) from None
        average = UNet(self._unet)
        average.load_state_dict(model.state_dict())
        for net in (model, average):
            # torch's stubs know this form of `to` of tensors only.
            net.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        groups = []
        for known in (False, True):
            own = [p for n, p in model.named_parameters() if n.startswith("encoder.") == known]
            share = self._settings.encoder_lr if known else 1.0
            for decay, some in (
                (self._settings.weight_decay, [p for p in own if p.ndim > 1]),
                (0.0, [p for p in own if p.ndim <= 1]),
            ):
                if some:
                    groups.append({"params": some, "weight_decay": decay, "share": share})
        optimiser = torch.optim.AdamW(groups, lr=self._settings.lr, betas=(0.9, 0.99))
        run = Run(0, model, average, _copy(average.state_dict()), optimiser)
        if self._path.exists():
            self._load(run)
        return run

    def train(
        self,
        on_epoch: Callable[[Run, F32], None] | None = None,
        on_step: Callable[[int, float], None] | None = None,
    ) -> Run:
        """Trains to the last step or until patience runs out, from the checkpoint where there is one.

        ``on_epoch(run, probability)`` is called after every epoch, before its checkpoint is written, with the validation
        crops' (n, s, s) probabilities; ``on_step(step, loss)`` after every step. Raises SettingsError where the loss is
        no number any more.
        """
        s = self._settings
        run = self.start()
        last = min(s.steps, s.stop_after or s.steps)
        while run.step < last and not self._exhausted(run):
            loss = self.advance(run)
            if not math.isfinite(loss):
                raise SettingsError(
                    f"training came apart at step {run.step}: its loss is no number any more; begin again with an lr "
                    f"smaller than {s.lr:g} or a longer warm-up, in another folder"
                )
            if on_step:
                on_step(run.step, loss)
            if run.step % s.epoch_steps == 0 or run.step == last:
                probability = self._close_epoch(run)
                if on_epoch:
                    on_epoch(run, probability)
                self.save(run)
            elif run.step % s.checkpoint_steps == 0:
                self.save(run)
        return run

    def advance(self, run: Run) -> float:
        """One step of the optimiser; its loss."""
        s = self._settings
        lr = rate_at(run.step, s)
        for group in run.optimiser.param_groups:
            group["lr"] = lr * group["share"]
        run.model.train()
        run.optimiser.zero_grad(set_to_none=True)
        total = 0.0
        for part in range(s.accumulate):
            images, labels = self._crops(run.step, part)
            x = torch.from_numpy(normalised(images)).to(self.device, memory_format=torch.channels_last)
            with self._precision():
                logits = self._passes(run.model)(x)
            loss = loss_of(logits, torch.from_numpy(labels).to(self.device), s) / s.accumulate
            loss.backward()  # type: ignore[no-untyped-call]
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(run.model.parameters(), 1.0)
        run.optimiser.step()
        run.step += 1
        # A young average forgets its random start quickly.
        decay = min(s.ema, (1 + run.step) / (10 + run.step))
        with torch.no_grad():
            for kept, new in zip(run.average.state_dict().values(), run.model.state_dict().values()):
                if kept.is_floating_point():
                    kept.lerp_(new, 1 - decay)
                else:
                    kept.copy_(new)
        run.losses.append(total)
        return total

    def _crops(self, step: int, part: int) -> tuple[U8, U8]:
        """The crops of one pass; those of the next one are drawn meanwhile, in a thread of their own."""
        s = self._settings
        after = (step, part + 1) if part + 1 < s.accumulate else (step + 1, 0)
        for key in ((step, part), after):
            if key not in self._drawing:
                self._drawing[key] = self._drawers.submit(
                    batch_of, self._source, s.seed, *key, s.batch, s.crop_px, self._augment
                )
        return self._drawing.pop((step, part)).result()

    def _passes(self, model: UNet) -> Callable[[Tensor], Tensor]:
        if not self._settings.compile:
            return model
        if self._forward is None or self._forward[0] is not model:
            self._forward = (model, torch.compile(model))
        return self._forward[1]

    def _precision(self) -> contextlib.AbstractContextManager[Any]:
        if self.device.type == "cuda":
            return torch.autocast("cuda", torch.bfloat16)
        return contextlib.nullcontext()

    def _close_epoch(self, run: Run) -> F32:
        images, labels = self._validation
        logits = np.concatenate([predict(run.average, images[i : i + 8]) for i in range(0, len(images), 8)])
        loss = float(loss_of(torch.from_numpy(logits)[:, None], torch.from_numpy(labels), self._settings))
        known, built = labels != UNKNOWN, labels == BUILDING
        marked = (logits > 0) & known
        union = np.count_nonzero(marked | built)
        iou = np.count_nonzero(marked & built) / union if union else 1.0
        before = run.best_epoch
        epoch = Epoch(
            len(run.history) + 1,
            run.step,
            rate_at(run.step - 1, self._settings),
            float(np.mean(run.losses)),
            loss,
            float(iou),
        )
        run.history.append(epoch)
        run.losses.clear()
        if averaged := epochs_in_mean(run.history, self._settings):
            run.best = mean_with(run.best, run.average.state_dict(), len(averaged))
        elif before is None or loss < before.validation_loss:
            run.best = _copy(run.average.state_dict())
        return np.asarray(1 / (1 + np.exp(-logits)), np.float32)

    def _exhausted(self, run: Run) -> bool:
        best = run.best_epoch
        patience = self._settings.patience
        return bool(patience and best and len(run.history) - best.epoch >= patience)

    # --- the checkpoint ------------------------------------------------------------------------------------------

    def save(self, run: Run) -> None:
        """Replaces the checkpoint atomically by one of this moment."""
        tensors: dict[str, Tensor] = {}
        parts = {"model": run.model.state_dict(), "average": run.average.state_dict(), "best": run.best}
        for part, state in parts.items():
            tensors |= {f"{part}/{name}": t.detach().cpu().contiguous() for name, t in state.items()}
        for number, state in run.optimiser.state_dict()["state"].items():
            tensors |= {
                f"optimiser/{number}/{name}": t.detach().cpu().contiguous() for name, t in state.items()
            }
        # Shared storage (a state and its copy) is refused by safetensors: each tensor gets its own.
        tensors = {name: t.clone() for name, t in tensors.items()}
        facts = {
            "format": FORMAT,
            "version": VERSION,
            "digest": self._digest,
            "step": run.step,
            "history": [asdict(e) for e in run.history],
            "losses": run.losses,
        }
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path, durable=True) as scratch:
            save_file(tensors, scratch, {"brmgeo": json.dumps(facts)})

    def _load(self, run: Run) -> None:
        path = self._path
        try:
            with safetensors.safe_open(path, "pt") as file:
                facts = json_of((file.metadata() or {})["brmgeo"])
            tensors = load_file(path)
        except (safetensors.SafetensorError, KeyError, ValueError, OSError) as error:
            raise InputError(
                f"{path}: is not a checkpoint ({' '.join(str(error).split())[:100]}); delete it to begin again"
            ) from None
        if facts.get("format") != FORMAT or facts.get("version") != VERSION:
            raise InputError(f"{path}: is a checkpoint of another version; delete it to begin again")
        if facts.get("digest") != self._digest:
            raise InputError(
                f"{path}: belongs to a run with other settings or data; name another folder, or delete it to begin again"
            )
        try:
            run.model.load_state_dict(_part(tensors, "model"))
            run.average.load_state_dict(_part(tensors, "average"))
            run.best = _part(tensors, "best")
            if run.best.keys() != run.average.state_dict().keys():
                raise KeyError("best")
            state: dict[int, dict[str, Tensor]] = {}
            for name, tensor in _part(tensors, "optimiser").items():
                number, key = name.split("/")
                state.setdefault(int(number), {})[key] = tensor
            groups = run.optimiser.state_dict()["param_groups"]
            run.optimiser.load_state_dict({"state": state, "param_groups": groups})
            run.step = int(facts["step"])
            run.history = [Epoch(**e) for e in facts["history"]]
            run.losses = list(facts["losses"])
        except (RuntimeError, KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"{path}: is not a whole checkpoint ({' '.join(str(error).split())[:100]}); delete it to begin again"
            ) from None


def epochs_in_mean(history: Sequence[Epoch], settings: TrainSettings) -> list[Epoch]:
    """The epochs whose averages' mean is kept; none where the best epoch is, which without ``mean_from`` is always."""
    return [e for e in history if settings.mean_from and e.step >= settings.mean_from]


def mean_with(mean: Mapping[str, Tensor], state: Mapping[str, Tensor], count: int) -> dict[str, Tensor]:
    """The mean of ``count`` states of weights: of the last one, ``state``, and the ``mean`` of those before it."""
    new = _copy(state)
    for name, tensor in new.items():
        if count > 1 and tensor.is_floating_point():
            new[name] = torch.lerp(mean[name], tensor, 1.0 / count)
    return new


def _copy(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: t.detach().cpu().clone() for name, t in state.items()}


def _part(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    return {name.removeprefix(part + "/"): t for name, t in tensors.items() if name.startswith(part + "/")}


def validation_crops(
    sources: Sequence[Source], each: int, crop_px: int, gsd_m: float, seed: int = 0
) -> tuple[U8, U8]:
    """(n, s, s, 3) and (n, s, s) uint8: ``each`` unchanged crops at ``gsd_m`` of every source, the same for a seed."""
    plain = AugmentSettings.none(gsd_m)
    parts = [batch_of(source, seed, 0, k, each, crop_px, plain) for k, source in enumerate(sources)]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


@contextlib.contextmanager
def _evaluating(net: UNet) -> Iterator[None]:
    before = net.training
    net.eval()
    try:
        with torch.inference_mode():
            yield
    finally:
        net.train(before)


def predict(net: UNet, images: U8) -> F32:
    """(n, h, w) float32 logits of (n, h, w, 3) uint8 RGB of any size: mirrored at the edges up to what the U-Net takes."""
    _, h, w, _ = images.shape
    multiple = net.settings.multiple_px
    pad = ((0, 0), (0, -h % multiple), (0, -w % multiple), (0, 0))
    x = normalised(np.pad(images, pad, mode="symmetric"))
    device = next(net.parameters()).device
    with _evaluating(net):
        y = net(torch.from_numpy(x).to(device, memory_format=torch.channels_last))
    return np.asarray(y[:, 0, :h, :w].cpu().numpy(), np.float32)


def tensors_of(state: Mapping[str, Tensor]) -> dict[str, NDArray[Any]]:
    """The weights as arrays, for ``brmgeo.segment.weights``."""
    return {name: t.detach().cpu().numpy() for name, t in state.items()}
