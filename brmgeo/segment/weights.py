"""Weights of the network on disk: one safetensors file with its model card inside, and the card once more for people.

A safetensors file is a list of named arrays and nothing else, so reading one never executes code. The card travels as
JSON in the file's metadata: architecture, normalisation, threshold, calibration, the GSD it was trained for, data,
licence and scores, and the SHA-256 of all tensors and of the card itself. Whatever does not fit is refused in one line.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.extras import extra
from brmgeo.files import json_of, write_bytes, write_text

if TYPE_CHECKING:
    from brmgeo.segment.unet import UNet

FORMAT = 1
ARCHITECTURE = "brmgeo U-Net"
_MAGIC = "brmgeo_weights"
_TYPES = {"float32", "int64"}  # int64: how many batches a batch normalisation has seen
_NOT_WEIGHTS = "give a .safetensors file that training wrote"


@dataclass(frozen=True, slots=True)
class ModelCard:
    """What a network is, what it was trained on and how its answers are to be read.

    Attributes:
        format: version of this file format, 1.
        architecture: name of the network's class.
        settings: its settings as plain values (``UNetSettings.plain``).
        mean, std: of each channel; the network sees (x / 255 - mean) / std.
        threshold: a pixel is building when its calibrated probability is above it, chosen on validation.
        temperature: p = sigmoid(logit / temperature), or the mean of that over the looks.
        gsd_min_m, gsd_max_m: metres per pixel it was trained for.
        gsd_work_m: pictures outside of that range are resampled to this; None for the nearer end of the range.
        data, licence, metrics: what it was trained on, under which terms, and what it scores: plain values or text.
        sha256: of all tensors and of all other fields; ``save_weights`` fills it in.

    Raises InputError for values that no network can have.
    """

    settings: dict[str, Any]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    threshold: float
    temperature: float
    gsd_min_m: float
    gsd_max_m: float
    gsd_work_m: float | None = None
    data: Any = field(default_factory=dict)
    licence: Any = ""
    metrics: Any = field(default_factory=dict)
    format: int = FORMAT
    architecture: str = ARCHITECTURE
    sha256: str = ""

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise InputError(
                f"model card: format {self.format!r}, this release reads format {FORMAT}; "
                "take weights and brmgeo of one release"
            )
        if self.architecture != ARCHITECTURE:
            raise InputError(
                f"model card: architecture {self.architecture!r}, this release runs {ARCHITECTURE!r} only"
            )
        for name in ("mean", "std"):
            values = getattr(self, name)
            if not isinstance(values, list | tuple) or len(values) != 3 or not all(map(_number, values)):
                raise InputError(f"model card: {name} {values!r} is not three finite numbers")
            object.__setattr__(self, name, tuple(float(v) for v in values))
        positive = {n: getattr(self, n) for n in ("temperature", "gsd_min_m", "gsd_max_m")}
        if self.gsd_work_m is not None:
            positive["gsd_work_m"] = self.gsd_work_m
        positive |= {f"std[{i}]": v for i, v in enumerate(self.std)}
        for name, value in positive.items():
            if not _number(value) or value <= 0:
                raise InputError(f"model card: {name} {value!r} is not a number above zero")
        if not _number(self.threshold) or not 0 < self.threshold < 1:
            raise InputError(f"model card: threshold {self.threshold!r} does not lie between 0 and 1")
        if self.gsd_min_m > self.gsd_max_m:
            raise InputError(f"model card: gsd_min_m {self.gsd_min_m} is above gsd_max_m {self.gsd_max_m}")
        if not isinstance(self.settings, dict):
            raise InputError(f"model card: settings {self.settings!r} are not named values")

    @property
    def digest(self) -> str:
        """The first twelve digits of the checksum: what the weights go by in reports and cache keys."""
        return self.sha256[:12]

    @property
    def looks(self) -> int:
        """Looks at a picture that the threshold and the scores are for: what ``metrics["calibration"]`` says, else 1."""
        told = self.metrics.get("calibration") if isinstance(self.metrics, dict) else None
        looks = told.get("looks") if isinstance(told, dict) else None
        return looks if isinstance(looks, int) and looks in (1, 2) else 1

    def to_json(self) -> str:
        """The card as JSON of one line, keys in order."""
        return json.dumps(asdict(self), sort_keys=True, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> ModelCard:
        """The card of such a text; InputError where it is not one."""
        try:
            values = json_of(text)
        except ValueError as error:
            raise InputError(f"model card: not JSON ({error})") from None
        known = {f.name for f in fields(cls)}
        if not isinstance(values, dict):
            raise InputError("model card: not an object of named values")
        if values.get("format", FORMAT) == FORMAT and set(values) != known:
            missing, foreign = sorted(known - set(values)), sorted(set(values) - known)
            raise InputError(f"model card: fields missing {missing}, unknown {foreign}")
        # Of another format only what says so is looked at.
        return cls(**{**_BLANK, **{k: v for k, v in values.items() if k in known}})

    def to_markdown(self, name: str) -> str:
        """The card for people."""
        work = "the nearer end of it" if self.gsd_work_m is None else f"{self.gsd_work_m:g} m"
        lines = [
            f"# {name}",
            "",
            f"The {self.architecture} that finds buildings in pictures from above, for brmgeo.",
            "",
            "| | |",
            "|---|---|",
            f"| settings | {_inline(self.settings)} |",
            f"| input | RGB, (x / 255 - mean) / std; mean {_inline(self.mean)}, std {_inline(self.std)} |",
            f"| probability | sigmoid(logit / {self.temperature:g})"
            f"{', mean of two looks' if self.looks == 2 else ''}, building above {self.threshold:g} |",
            f"| trained for | {self.gsd_min_m:g} to {self.gsd_max_m:g} m per pixel; others are resampled to {work} |",
            f"| file format | {self.format} |",
            f"| SHA-256 of tensors and card | `{self.sha256}` |",
        ]
        for title, value in (("Data", self.data), ("Licence", self.licence), ("Scores", self.metrics)):
            lines += ["", f"## {title}", "", *_prose(value)]
        return "\n".join(lines) + "\n"


_BLANK: dict[str, Any] = {
    "settings": {}, "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0), "threshold": 0.5, "temperature": 1.0,
    "gsd_min_m": 1.0, "gsd_max_m": 1.0,
}  # fmt: skip


def save_weights(path: Path, tensors: Mapping[str, NDArray[Any]], card: ModelCard) -> ModelCard:
    """Writes ``path`` (.safetensors) and beside it the readable card, ``path`` with the ending .md.

    Args:
        tensors: name -> float32 or int64 array, as torch's ``state_dict`` names them.
        card: its checksum is worked out here.

    Returns the card with its checksum. Raises ValueError for other dtypes, InputError for another ending.
    """
    with extra("train", "writing weights"):
        from safetensors.numpy import save

    if path.suffix != ".safetensors":
        raise InputError(f"{path}: weights are written as .safetensors only")
    whole = {name: np.asarray(value, order="C") for name, value in tensors.items()}
    for name, value in whole.items():
        if value.dtype.name not in _TYPES:
            raise ValueError(f"tensor {name} is {value.dtype}: weights are float32 or int64")
    card = replace(card, sha256=_checksum(whole, card))
    write_bytes(path, save(whole, metadata={_MAGIC: card.to_json()}))
    write_text(path.with_suffix(".md"), card.to_markdown(path.stem))
    return card


def load_weights(path: Path) -> tuple[dict[str, NDArray[Any]], ModelCard]:
    """The tensors (name -> array) and the card of a file that ``save_weights`` wrote.

    Raises MissingInputError where there is no file; InputError, in one line, for a file that is no safetensors file, cut
    short, of another program, format version or architecture, or changed in any byte since it was written.
    """
    with extra("train", "reading .safetensors"):
        from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise MissingInputError(f"{path}: there are no weights; {_NOT_WEIGHTS}")
    try:
        with safe_open(path, framework="numpy") as file:
            text = (file.metadata() or {}).get(_MAGIC)
            if text is None:
                raise InputError(
                    f"{path}: no brmgeo model card in it: another program's weights; {_NOT_WEIGHTS}"
                )
            try:
                card = ModelCard.from_json(text)
            except InputError as error:
                raise InputError(f"{path}: {error}") from None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, TypeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a whole safetensors file ({reason}); {_NOT_WEIGHTS}") from None
    if _checksum(tensors, card) != card.sha256:
        raise InputError(
            f"{path}: the tensors or the card are not those that were written (SHA-256 differs): damaged or "
            "changed; copy the file again"
        )
    for name, value in tensors.items():
        if not np.isfinite(value).all():
            raise InputError(f"{path}: tensor {name} holds values that are no numbers: give other weights")
    return tensors, card


def load_network(path: Path) -> tuple[UNet, ModelCard]:
    """The network in evaluation mode, with its card; needs torch.

    Raises as ``load_weights``, and InputError for settings or tensors of another architecture.
    """
    tensors, card = load_weights(path)
    return build_network(tensors, card, str(path)), card


def build_network(tensors: Mapping[str, NDArray[Any]], card: ModelCard, name: str) -> UNet:
    """The network of a card with these tensors in it, in evaluation mode; InputError where they do not fit each other."""
    with extra("train", f"running {name} with torch"):
        import torch

        from brmgeo.segment.unet import UNet, UNetSettings

    known = {f.name for f in fields(UNetSettings)}
    # Cards of before there was a choice of encoder do not name it.
    foreign = sorted(set({"encoder": "plain", **card.settings}) ^ known)
    if foreign:
        raise InputError(
            f"{name}: the card's settings differ from a {ARCHITECTURE}'s in {', '.join(foreign)}"
        )
    try:
        settings = UNetSettings(**{**card.settings, "widths": tuple(card.settings["widths"])})
    except (SettingsError, TypeError) as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None
    network = UNet(settings)
    wanted = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    for key in sorted(set(wanted) | set(tensors)):
        found = tuple(tensors[key].shape) if key in tensors else "nothing"
        if key not in wanted or found != wanted[key]:
            raise InputError(
                f"{name}: tensor {key} is {found}, a {ARCHITECTURE} of widths {list(settings.widths)} "
                f"and encoder {settings.encoder} has {wanted.get(key, 'none of this name')}: weights of another architecture"
            )
    network.load_state_dict({key: torch.from_numpy(np.array(value)) for key, value in tensors.items()})
    return network.eval()


def _checksum(tensors: Mapping[str, NDArray[Any]], card: ModelCard) -> str:
    whole = hashlib.sha256(replace(card, sha256="").to_json().encode())
    for name in sorted(tensors):
        value = tensors[name]
        whole.update(f"{name}\0{value.dtype.name}\0{value.shape}\0".encode())
        whole.update(value.tobytes())
    return whole.hexdigest()


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _inline(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_inline(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_inline(v) for v in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _prose(value: Any, indent: str = "") -> list[str]:
    """A list of Markdown: a line for each named value, one for each of several things, and below it what is nested in it."""
    if isinstance(value, Mapping):
        lines = []
        for key, inner in value.items():
            if _things(inner):
                lines.append(f"{indent}- {key}:")
                for thing in inner:
                    nested = {
                        k: v
                        for k, v in thing.items()
                        if isinstance(v, Mapping) and any(map(_things, v.values()))
                    }
                    told = {k: thing[k] for k in sorted(thing, key=lambda k: k != "name") if k not in nested}
                    lines.append(f"{indent}  - {_inline(told)}")
                    for name, below in nested.items():
                        lines += [f"{indent}    - {name}:", *_prose(below, f"{indent}      ")]
            else:
                lines.append(f"{indent}- {key}: {_inline(inner)}")
        return lines
    if isinstance(value, list | tuple):
        return [f"{indent}- {_inline(inner)}" for inner in value]
    return [str(value)]


def _things(value: Any) -> bool:
    """Whether this is a list of several named values each."""
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(v, Mapping) for v in value)
