"""Prediction: the probability of "building" for every pixel of a picture, by ONNX Runtime or by torch.

A picture of any size is taken whole, or in overlapping windows whose answers are blended, at its own GSD where the
network was trained for that, else resampled to one it was trained for and the answer resampled back. The network looks
twice, the second time at the mirror image, somewhat coarser, and the two answers are averaged: that finds more of the roofs
and less of what is none. ONNX Runtime is the default and needs no torch; the two agree to 1e-4.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import LABEL_BUILDING, LABEL_OTHER
from brmgeo.errors import InputError, MissingInputError, SettingsError, one_line
from brmgeo.pictures import decode, read_bytes, rgb_of, scaled_levels
from brmgeo.segment.weights import ModelCard

Backend = Literal["onnx", "torch"]
#: What is handed on of a picture: what is building, or how probable that is.
Answer = Literal["mask", "probability"]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
#: A picture's GSD: metres per pixel, or (down, across) where its pixels are not square.
Gsd = float | tuple[float, float]

SHIPPED = Path(__file__).parent / "weights" / "building-unet.onnx"
MIN_PX = 16
WINDOW_PX = 1024
OVERLAP_PX = 128
#: Pictures this many times coarser than anything in training hold no outline that could be found.
MAX_COARSER = 4.0
#: Looks at a picture that weights are calibrated for, and how many times coarser the second one is.
LOOKS, _COARSER = 2, 1.25
_ALIGN = 32  # every network of at most six levels takes multiples of this


# --- pictures ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Picture:
    """``rgb`` (h, w, 3) uint8, and ``known`` (h, w) bool: False where the picture is transparent; None: known all over."""

    rgb: U8
    known: NDArray[np.bool_] | None = None


def picture_of(image: NDArray[Any], name: str = "the image") -> Picture:
    """An image array as RGB, as ``rgb_of``: unknown where transparent.

    Raises InputError for more than 8 bits a channel (which of the levels are black and white nobody can
    tell from the picture: scale it first), other shapes, and pictures under 16 pixels on a side.
    """
    if image.dtype != np.uint8:
        raise InputError(
            f"{name}: {image.dtype} values; the network takes 8 bits a channel: say which levels are black and white, or "
            "convert it first (gdal_translate -ot Byte -scale LOW HIGH)",
            needs="levels",
        )
    rgb, known = rgb_of(image, name)
    h, w = rgb.shape[:2]
    if min(h, w) < MIN_PX:
        raise InputError(f"{name}: {w} x {h} px is too small: give at least {MIN_PX} px on each side")
    return Picture(rgb, known)


def read_image(path: Path, data: bytes | None = None, levels: tuple[float, float] | None = None) -> Picture:
    """The picture in an image file, sensor's rows and columns (an EXIF turn is not applied).

    Args:
        data: the file's bytes where they are at hand.
        levels: the levels that are black and white in a file of more than 8 bits.

    Raises MissingInputError or InputError, naming the file, where it is not there, cut short, damaged, no image, of more
    than 8 bits without ``levels``, or too small.
    """
    image = decode(read_bytes(path) if data is None else data, str(path))
    if levels is not None and image.dtype != np.uint8:
        alpha = image.ndim == 3 and image.shape[2] in (2, 4)
        seen = scaled_levels(image, *levels)
        if alpha:
            seen[:, :, -1] = np.where(image[:, :, -1] > 0, 255, 0)
        image = seen
    return picture_of(image, str(path))


# --- windows -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Span:
    """Pixels [start, stop) of a row or column of windows, and the (n,) float32 weights of its answers there."""

    start: int
    stop: int
    weight: F32


def spans(length: int, size: int, overlap: int) -> list[Span]:
    """Overlapping spans of ``size`` that cover ``length``; their weights fade over the overlaps and add up to 1 everywhere.

    One span, of weight 1, where ``length`` is not above ``size``; else spans spread evenly, overlapping by at least
    ``overlap``.
    """
    if length <= size:
        return [Span(0, length, np.ones(length, np.float32))]
    count = math.ceil((length - overlap) / (size - overlap))
    starts = [round(i * (length - size) / (count - 1)) for i in range(count)]
    at = np.arange(size)
    weights = []
    total = np.zeros(length)
    for i, start in enumerate(starts):
        weight = np.full(size, float(max(overlap, 1)))
        # Towards a border within the picture an answer knows less and counts less; never at the picture's own border.
        if i:
            weight = np.minimum(weight, at + 1.0)
        if i + 1 < count:
            weight = np.minimum(weight, size - at)
        weights.append(weight)
        total[start : start + size] += weight
    return [
        Span(s, s + size, (w / total[s : s + size]).astype(np.float32))
        for s, w in zip(starts, weights, strict=True)
    ]


# --- backends ----------------------------------------------------------------------------------------------------


class _Network(Protocol):
    def __call__(self, x: F32) -> F32:
        """(n, 3, h, w) float32 normalised -> (n, h, w) float32 calibrated probability."""


class _OnnxNetwork:
    def __init__(self, session: Any, path: Path) -> None:
        self._session = session
        self._path = path
        inputs, outputs = session.get_inputs(), session.get_outputs()
        ranks = [len(part.shape) for part in (*inputs, *outputs)]
        if len(inputs) != 1 or len(outputs) < 1 or ranks[:2] != [4, 4] or inputs[0].type != "tensor(float)":
            raise InputError(f"{path}: no network that takes (n, 3, h, w) float32 and gives (n, 1, h, w)")
        self._input = inputs[0].name

    def __call__(self, x: F32) -> F32:
        try:
            out: F32 = self._session.run(None, {self._input: x})[0][:, 0]
        except Exception as error:  # onnxruntime's errors have no common root but this
            raise _failed(error, self._path) from error
        return out


class _TorchNetwork:
    def __init__(self, network: Any, temperature: float, threads: int, path: Path) -> None:
        import torch

        self._torch = torch
        # ``threads`` is the process's own setting in torch: the last one that was loaded decides.
        torch.set_num_threads(threads)
        self._network = network.to(memory_format=torch.channels_last)
        self._temperature = temperature
        self._path = path

    def __call__(self, x: F32) -> F32:
        torch = self._torch
        try:
            with torch.inference_mode():
                seen = torch.from_numpy(x).contiguous(memory_format=torch.channels_last)
                out: F32 = torch.sigmoid(self._network(seen) / self._temperature)[:, 0].numpy()
        except RuntimeError as error:
            raise _failed(error, self._path) from error
        return out


def _failed(error: Exception, path: Path) -> Exception:
    """What a runtime's error on a picture is: MemoryError, or InputError for weights that do not run."""
    said = one_line(error)
    if "alloc" in said.lower() or isinstance(error, MemoryError):
        return MemoryError(f"the network {path.name} asks for more than there is: {said}")
    return InputError(f"{path}: the network does not run: {said}; get the weights again")


def _load_onnx(path: Path, threads: int) -> tuple[_OnnxNetwork, ModelCard]:
    import onnxruntime as ort

    from brmgeo.segment.onnx_export import CARD_KEY, check_seal

    ort.disable_telemetry_events()  # those of Windows, which the room's environment variable leaves alone
    data = path.read_bytes()
    check_seal(data, str(path))
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common root but this
        raise InputError(f"{path}: ONNX Runtime cannot open it: {one_line(error, 200)}") from None
    try:
        card = ModelCard.from_json(session.get_modelmeta().custom_metadata_map.get(CARD_KEY, ""))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not all(isinstance(n, str) for n in session.get_inputs()[0].shape[2:]):
        raise InputError(
            f"{path}: a graph for tiles of {session.get_inputs()[0].shape[2]} px only, made for Deepness; give the .onnx "
            "without a fixed tile, or the .safetensors"
        )
    return _OnnxNetwork(session, path), card


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Segmenter:
    """A loaded network: ``probability`` and ``mask`` of pictures.

    Attributes:
        card: its model card.
        backend: ``onnx`` or ``torch``.
        path: the file it was read from.
        looks: 1 or 2, see ``load``.
    """

    card: ModelCard
    backend: Backend
    path: Path
    _network: _Network
    looks: int

    def __post_init__(self) -> None:
        if self.looks not in (1, 2):
            raise SettingsError(f"looks {self.looks}: give 1 or 2")

    @classmethod
    def load(
        cls,
        path: Path | str | None = None,
        backend: str | None = None,
        threads: int | None = None,
        looks: int | None = None,
    ) -> Segmenter:
        """The network of a file.

        Args:
            path: .onnx or .safetensors; None for the weights that ship with brmgeo.
            backend: ``onnx`` (default) or ``torch``. With a .safetensors file ONNX Runtime runs the .onnx of the
                same weights that lies beside it; where there is none, torch is the default.
            threads: processor threads; None for all cores.
            looks: 2: the answer is the mean of what the network says of the picture and of its mirror image at 1.25 times
                its GSD; 1: of the picture alone, in 0.6 of the time; None: as the card's threshold and scores were made.

        Raises InputError for files that are not what they should be, MissingInputError where one is not there,
        MissingExtraError where torch is to run it and is not installed, and SettingsError for another backend or other
        looks.
        """
        if backend is not None and backend not in get_args(Backend):
            raise SettingsError(f"backend {backend!r}: give one of {', '.join(get_args(Backend))}")
        given = SHIPPED if path is None else Path(path)
        if given.suffix not in (".onnx", ".safetensors"):
            raise InputError(
                f"{given}: weights are .safetensors or .onnx files; others (such as pickles) are never opened"
            )
        if not given.is_file():
            raise MissingInputError(
                f"{given}: there are no such weights; give a file that is there, or train some",
                needs="weights",
            )
        threads = threads or cores()
        graph, tensors = given.with_suffix(".onnx"), given.with_suffix(".safetensors")
        if backend is None:
            backend = "onnx" if graph.is_file() else "torch"
        if backend == "torch":
            from brmgeo.segment.weights import load_network

            # An .onnx of it, made where torch is installed, runs without.
            network, card = load_network(tensors)
            runs = _TorchNetwork(network, card.temperature, threads, tensors)
            return cls(card, "torch", tensors, runs, card.looks if looks is None else looks)
        if not graph.is_file():
            raise MissingInputError(
                f"{graph}: ONNX Runtime needs it; export {given.name} as ONNX where torch is installed"
            )
        runner, card = _load_onnx(graph, threads)
        if given == tensors:
            from brmgeo.segment.weights import load_weights

            if load_weights(given)[1].sha256 != card.sha256:
                raise InputError(f"{graph}: of other weights than {given.name} beside it; export them anew")
        return cls(card, "onnx", graph, runner, card.looks if looks is None else looks)

    @property
    def name(self) -> str:
        """What reports call it: the file's name, the weights' digest, and its looks where they are not the card's."""
        other = "" if self.looks == self.card.looks else f", {'one look' if self.looks == 1 else 'two looks'}"
        return f"{self.path.stem} {self.card.digest}{other}"

    def working_size(self, shape: tuple[int, int], gsd_m: Gsd | None) -> tuple[int, int]:
        """(rows, columns) at which the network sees a picture of ``shape``: its own where its GSD is within training.

        Raises InputError for a GSD over four times coarser than any in training, SettingsError for one that is none.
        """
        if gsd_m is None:
            return shape
        down, across = gsd_m if isinstance(gsd_m, tuple) else (gsd_m, gsd_m)
        if not all(math.isfinite(g) and g > 0 for g in (down, across)):
            raise SettingsError(f"GSD {gsd_m} m: give metres per pixel above zero")
        card = self.card
        if max(down, across) > MAX_COARSER * card.gsd_max_m:
            raise InputError(
                f"{max(down, across):g} m per pixel is too coarse: these weights were trained for "
                f"{card.gsd_min_m:g} to {card.gsd_max_m:g} m"
            )
        square = max(down, across) <= 1.1 * min(down, across)
        # A raster's metres are its projection's, a frame's height is measured: a few percent are no other scale.
        if square and card.gsd_min_m / 1.05 <= down <= card.gsd_max_m * 1.05:
            return shape
        mean = math.sqrt(down * across)
        work = card.gsd_work_m or min(max(mean, card.gsd_min_m), card.gsd_max_m)
        return max(1, round(shape[0] * down / work)), max(1, round(shape[1] * across / work))

    def probability(
        self,
        image: NDArray[Any] | Picture,
        gsd_m: Gsd | None = None,
        known: NDArray[np.bool_] | None = None,
    ) -> F32:
        """Calibrated probability of "building" of every pixel: (h, w) float32 in [0, 1], NaN where the picture is unknown.

        Args:
            image: (h, w, 3) uint8 RGB; also grey, and with alpha (see ``picture_of``).
            gsd_m: metres per pixel; None runs the network on the pixels as they are.
            known: (h, w) bool, False where the picture shows nothing.
        """
        picture = image if isinstance(image, Picture) else picture_of(image)
        if known is not None:
            picture = Picture(picture.rgb, known)
        return self.probabilities([picture], [gsd_m])[0]

    def probabilities(
        self, images: Sequence[NDArray[Any] | Picture], gsds_m: Sequence[Gsd | None]
    ) -> list[F32]:
        """``probability`` of some pictures at once: those that the network sees at one size go through it together."""
        pictures = [i if isinstance(i, Picture) else picture_of(i) for i in images]
        works = [self._work(p, g) for p, g in zip(pictures, gsds_m, strict=True)]
        answers: list[F32 | None] = [None] * len(works)
        for shape in dict.fromkeys(w.shape for w in works):
            same = [i for i, w in enumerate(works) if w.shape == shape]
            for i, answer in zip(same, self._windows(np.stack([works[i] for i in same])), strict=True):
                answers[i] = answer
        return [_placed(a, p) for a, p in zip(answers, pictures, strict=True) if a is not None]

    def _work(self, picture: Picture, gsd_m: Gsd | None) -> U8:
        """The picture as the network sees it: at its working size, what is unknown in no colour."""
        rgb = picture.rgb
        if picture.known is not None:
            # The training's mean, not black, which looks like a shadow.
            blank = np.clip(np.rint(np.array(self.card.mean) * 255.0), 0, 255).astype(np.uint8)
            rgb = np.where(picture.known[..., None], rgb, blank)
        shape = (rgb.shape[0], rgb.shape[1])
        work = self.working_size(shape, gsd_m)
        if work == shape:
            return rgb
        how = cv2.INTER_AREA if work[0] * work[1] < shape[0] * shape[1] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(rgb, work[::-1], interpolation=how), np.uint8)

    def mask(self, image: NDArray[Any] | Picture, gsd_m: Gsd | None = None) -> U8:
        """(h, w) uint8: 255 where the probability is above the card's threshold, else (also where unknown) 0."""
        return thresholded(self.probability(image, gsd_m), self.card.threshold)

    def _windows(self, rgb: U8) -> F32:
        """(n, h, w) probability of (n, h, w, 3) pictures of any one size."""
        rows, cols = (spans(n, WINDOW_PX, OVERLAP_PX) for n in rgb.shape[1:3])
        if len(rows) == len(cols) == 1:
            return self._look(rgb)
        out = np.zeros(rgb.shape[:3], np.float32)
        for row in rows:
            for col in cols:
                place = (slice(None), slice(row.start, row.stop), slice(col.start, col.stop))
                out[place] += row.weight[:, None] * self._look(rgb[place]) * col.weight
        return np.clip(out, 0.0, 1.0)

    def _look(self, rgb: U8) -> F32:
        """(n, h, w) probability of (n, h, w, 3) pictures that go through the network in one piece."""
        first = self._run(rgb)
        if self.looks == 1:
            return first
        h, w = rgb.shape[1:3]
        # Probabilities are averaged, not logits, which would magnify what two backends differ by where a look is certain.
        size = (max(1, round(w / _COARSER)), max(1, round(h / _COARSER)))
        mirrored = np.ascontiguousarray(rgb[:, :, ::-1])
        far = np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in mirrored])
        for own, other in zip(first, self._run(np.asarray(far, np.uint8))):
            own += cv2.resize(other, (w, h), interpolation=cv2.INTER_LINEAR)[:, ::-1]
        return np.asarray(np.clip(0.5 * first, 0.0, 1.0), np.float32)

    def _run(self, rgb: U8) -> F32:
        n, h, w = rgb.shape[:3]
        down, across = -h % _ALIGN, -w % _ALIGN
        top, left = down // 2, across // 2  # half on each side: the borders are all alike
        if down or across:
            border = ((0, 0), (top, down - top), (left, across - left), (0, 0))
            rgb = np.pad(rgb, border, mode="reflect" if min(h, w) > 1 else "edge")
        scale, shift = _normalisation(self.card.mean, self.card.std)
        x = np.empty((n, 3, *rgb.shape[1:3]), np.float32)
        for channel in range(3):
            np.multiply(rgb[..., channel], scale[channel], out=x[:, channel], dtype=np.float32)
            x[:, channel] += shift[channel]
        return self._network(x)[:, top : top + h, left : left + w]


def _placed(answer: F32, picture: Picture) -> F32:
    """A working size's answer at the picture's own size, NaN where the picture is unknown."""
    shape = (picture.rgb.shape[0], picture.rgb.shape[1])
    if answer.shape != shape:
        back = cv2.resize(np.ascontiguousarray(answer), shape[::-1], interpolation=cv2.INTER_LINEAR)
        answer = np.clip(np.asarray(back, np.float32), 0.0, 1.0)
    if picture.known is None:
        return np.ascontiguousarray(answer)
    return np.where(picture.known, answer, np.float32(np.nan))


def thresholded(probability: F32, threshold: float) -> U8:
    """(h, w) uint8: 255 where ``probability`` is above ``threshold``, else, and where it is NaN, 0."""
    with np.errstate(invalid="ignore"):
        return np.where(probability > threshold, LABEL_BUILDING, LABEL_OTHER).astype(np.uint8)


@lru_cache(maxsize=8)
def _normalisation(mean: tuple[float, ...], std: tuple[float, ...]) -> tuple[F32, F32]:
    scale = 1.0 / (255.0 * np.array(std))
    return scale.astype(np.float32), (-np.array(mean) / np.array(std)).astype(np.float32)
