"""What is building in each frame of a flight: the flight's own masks, or a network's, laid onto the roofs' plane.

What the network said of a frame is kept by content (the frame's bytes, the weights, the settings), so a second run over
the same frames asks it nothing, and a frame, weights or a height that changed is asked anew.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from brmgeo.codes import UNKNOWN
from brmgeo.errors import FlightError, InputError, MissingInputError
from brmgeo.files import digest_of, scratch_folder, write_bytes
from brmgeo.flight.camera import slant_gsd_m
from brmgeo.flight.folder import Flight
from brmgeo.pictures import decode, encode, read_bytes
from brmgeo.segment.predict import Answer, Picture, Segmenter, picture_of, read_image, thresholded
from brmgeo.segment.weights import ModelCard

#: Probabilities as they are kept: 0 to 254 for 0 to 1, ``UNKNOWN`` for unknown.
STEPS = 254
#: A network finds roofs, and a roof is seen where its height puts it: its masks are laid onto a plane this high above ground
#: (one storey), not onto the ground. Sheffield's frames then register 0.7 m nearer to the reference.
ROOF_M = 3.0
_FORMAT = 1  # of the cache's files and key
#: Frames that go through the network together, and the pixels after which no further one is added.
_BATCH, _BATCH_PX = 4, 4_000_000


class Counter(Protocol):
    """Is told how far a piece of work is."""

    def update(self, done: int, total: int) -> None:
        """``done`` of ``total`` items are done."""


class Watch(Protocol):
    """Is told what happens while masks are made; the room itself prints nothing."""

    def say(self, line: str) -> None:
        """One line for people."""

    def stage(self, label: str) -> AbstractContextManager[Counter]:
        """A piece of work, for as long as the block lasts."""


@dataclass(frozen=True, slots=True)
class FrameMasks:
    """What is building in each frame of a flight, and where that is from.

    Attributes:
        flight: the flight.
        source: for reports: the flight's own masks, or the network and its weights.
        files: the network's probability of each frame; None for the flight's own masks.
        threshold: probabilities above it are building; None hands probabilities on as they are.
        roof_m: what the masks show as building stands this high above ground; 0 for outlines on the ground.
        network: what the network is known by (``known_by``) and its ``answer``; None for the flight's own masks.
    """

    flight: Flight
    source: str
    files: tuple[Path, ...] | None = None
    threshold: float | None = None
    roof_m: float = 0.0
    network: Mapping[str, Any] | None = None

    def agl_m(self, index: int) -> float:
        """Height of a frame above what its mask shows, metres."""
        return above_roofs_m(self.flight.frames[index].agl_m, self.roof_m)

    def image(self, index: int) -> NDArray[Any]:
        """(height, width) of one frame: uint8 0 or 255, or float32 probability with NaN where unknown."""
        if self.files is None:
            return self.flight.mask(index)
        stored = _read_stored(self.files[index])
        if stored is None:
            raise InputError(f"{self.files[index]}: a mask that was kept is damaged or gone: run again")
        return network_image(stored, self.threshold)


@dataclass(frozen=True, slots=True)
class NetworkUse:
    """How the network is to be used on frames.

    Attributes:
        wanted: ``given`` masks where the flight has them, else the network; or the ``network`` in any case.
        weights: their file; None for those that ship with brmgeo. A file means the network in any case.
        answer: hand the matcher masks or probabilities. Masks are the better evidence: a frame's fit to the map tells
            right from wrong two to four times as clearly as with probabilities, and lies as near to the truth.
        cache: folder in which answers are kept; None keeps none beyond the run.
        roof_m: height above ground of the roofs it finds.
        looks: how often it looks at a frame; None: as the weights' card says.
    """

    wanted: Literal["given", "network"] = "given"
    weights: Path | None = None
    answer: Answer = "mask"
    cache: Path | None = None
    roof_m: float = ROOF_M
    looks: int | None = None

    def asks_network(self, flight: Flight) -> bool:
        """True where the network is to make the masks of a flight."""
        return self.wanted == "network" or self.weights is not None or not flight.has_masks


@contextmanager
def frame_masks(
    flight: Flight, given: str, use: NetworkUse, watch: Watch, region: str = ""
) -> Iterator[FrameMasks]:
    """The masks of a flight's frames, for as long as the block lasts; the network runs on frames not seen before.

    Args:
        given: what reports call masks of the flight folder.
        region: whose maps the flight is matched with; where the network was trained on it, that is said.

    Raises InputError for frames that are damaged or of another size, MissingInputError without weights or frames.
    """
    if not use.asks_network(flight):
        yield FrameMasks(flight, given)
        return
    if not flight.has_images:
        raise MissingInputError(
            f"{flight.folder}: the network is to make masks, but the flight has no frames; put them into frames/"
        )
    segmenter = Segmenter.load(use.weights, looks=use.looks)
    if warning := trained_over(segmenter.card, region):
        watch.say(f"{flight.name}: {warning}")
    with scratch_folder("masks") as scratch:
        files = _ask(flight, segmenter, use.cache or scratch, watch)
        threshold = segmenter.card.threshold if use.answer == "mask" else None
        runs = {"onnx": "ONNX Runtime", "torch": "torch"}[segmenter.backend]
        shown = "probabilities" if threshold is None else f"masks above {threshold:g}"
        source = f"network {segmenter.name} ({runs}), {shown}, roofs at {use.roof_m:g} m"
        network = known_by(segmenter) | {"answer": use.answer}
        yield FrameMasks(flight, source, files, threshold, use.roof_m, network)


def known_by(segmenter: Segmenter) -> dict[str, Any]:
    """What tells a network's answers from another's: the digest of its weights, what runs it, and how often it looks."""
    return {
        "weights": segmenter.card.sha256,
        "backend": segmenter.backend,
        "looks": segmenter.looks,
    }


def above_roofs_m(agl_m: float, roof_m: float) -> float:
    """Height above roofs of a camera ``agl_m`` above ground; at least half of that."""
    return max(agl_m - roof_m, agl_m / 2.0)


@functools.lru_cache(maxsize=2)
def _segmenter(weights: Path | None, looks: int | None = None) -> Segmenter:
    return Segmenter.load(weights, threads=1, looks=looks)


def trained_over(card: ModelCard, region: str) -> str:
    """What is to be said where a network was trained on the region that it is used over; empty where it was not."""
    named = set(_trained_regions(card.data))
    if region not in named:
        return ""
    return f"the network was trained on region {region}, so results over it look better than elsewhere"


def _trained_regions(data: Any) -> Iterator[str]:
    """Regions among the sources of a card's data that were not for tests, and of the weights that it went on from."""
    sources = data.get("sources") if isinstance(data, dict) else None
    for source in sources if isinstance(sources, list) else ():
        if isinstance(source, dict) and source.get("split") != "test":
            regions = source.get("regions")
            yield from (
                r for r in (regions if isinstance(regions, list | tuple) else ()) if isinstance(r, str)
            )
            yield from _trained_regions(source.get("data"))


def network_warning(weights: Path | None, region: str) -> str:
    """``trained_over`` of the network of these weights; raises as ``Segmenter.load``."""
    return trained_over(_segmenter(weights).card, region)


def network_name(weights: Path | None, looks: int | None = None) -> str:
    """What reports call the network of these weights; raises as ``Segmenter.load``."""
    return f"network {_segmenter(weights, looks).name}"


def network_mask(
    picture: NDArray[np.uint8], gsd_m: float, weights: Path | None, looks: int | None = None
) -> NDArray[Any]:
    """What ``FrameMasks`` would hand on of a (h, w, 3) RGB frame, on one processor thread, kept nowhere."""
    segmenter = _segmenter(weights, looks)
    return network_image(stored_of(segmenter.probability(picture, gsd_m)), segmenter.card.threshold)


def network_image(stored: NDArray[np.uint8], threshold: float | None) -> NDArray[Any]:
    """(h, w) of an answer as it is kept: uint8 0 or 255 by the threshold; without one, float32 probability."""
    probability = probability_of(stored)
    return probability if threshold is None else thresholded(probability, threshold)


def frame_gsd_m(flight: Flight, index: int) -> float:
    """Metres per pixel at the middle of a flight's frame."""
    frame = flight.frames[index]
    return slant_gsd_m(flight.camera, flight.mount, frame.roll_rad, frame.pitch_rad, frame.agl_m)


def frame_picture(flight: Flight, index: int) -> tuple[Picture, bytes]:
    """A frame as a picture, and the bytes that it is known by; FlightError where its size is not the camera's."""
    path = flight.folder / "frames" / flight.frames[index].file
    if path.is_file():
        data = path.read_bytes()
        picture = read_image(path, data)
    else:  # a frame of a video
        image = flight.image(index)
        picture, data = picture_of(image, flight.frames[index].file), image.tobytes()
    camera = flight.camera
    if picture.rgb.shape[:2] != (camera.height, camera.width):
        raise FlightError(
            f"{path}: {picture.rgb.shape[1]} x {picture.rgb.shape[0]} px, but [camera] in flight.toml says "
            f"{camera.width} x {camera.height}"
        )
    return picture, data


def _ask(flight: Flight, segmenter: Segmenter, cache: Path, watch: Watch) -> tuple[Path, ...]:
    """The file of each frame's probability, after the network has answered for those that are not there yet."""
    files: list[Path] = []
    waiting: list[tuple[Path, Picture, float]] = []
    asked = 0

    def answer() -> None:
        said = segmenter.probabilities([p for _, p, _ in waiting], [g for _, _, g in waiting])
        for (path, _, _), probability in zip(waiting, said, strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, encode(stored_of(probability)))
        waiting.clear()

    with watch.stage(f"{flight.name} masks") as bar:
        for index in range(len(flight.frames)):
            picture, data = frame_picture(flight, index)
            gsd_m = frame_gsd_m(flight, index)
            path = cache / _key(data, segmenter, picture, gsd_m)
            stored = _read_stored(path)
            if stored is None or stored.shape != picture.rgb.shape[:2]:
                waiting.append((path, picture, gsd_m))
                asked += 1
            files.append(path)
            pixels = sum(p.rgb.shape[0] * p.rgb.shape[1] for _, p, _ in waiting)
            if len(waiting) == _BATCH or pixels > _BATCH_PX or index + 1 == len(flight.frames):
                answer()
            bar.update(index + 1, len(flight.frames))
    kept = len(files) - asked
    if kept:
        watch.say(f"{flight.name} masks: {kept} of {len(files)} frames were known from an earlier run")
    return tuple(files)


def _key(data: bytes, segmenter: Segmenter, picture: Picture, gsd_m: float) -> Path:
    size = segmenter.working_size((picture.rgb.shape[0], picture.rgb.shape[1]), gsd_m)
    asked = {"format": _FORMAT, **known_by(segmenter), "frame": digest_of(data), "size": size}
    text = json.dumps(asked, sort_keys=True)
    key = digest_of(text)
    return Path(key[:2]) / f"{key[2:40]}.png"


def stored_of(probability: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(h, w) uint8 of a probability as it is kept: ``STEPS`` for 1, 255 where it is NaN."""
    known = np.isfinite(probability)
    steps = np.rint(np.where(known, probability, 0.0) * STEPS)
    return np.where(known, steps, UNKNOWN).astype(np.uint8)


def probability_of(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) float32 probability in [0, 1] of what was kept; NaN where that is unknown."""
    out = stored.astype(np.float32) / np.float32(STEPS)
    out[stored == UNKNOWN] = np.nan
    return out


def _read_stored(path: Path) -> NDArray[np.uint8] | None:
    """(h, w) of an answer that was kept; None where it is not there, or damaged."""
    try:
        image = decode(read_bytes(path), str(path))
    except InputError:
        return None
    return np.asarray(image, np.uint8) if image.ndim == 2 and image.dtype == np.uint8 else None
