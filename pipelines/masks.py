"""Masks from pictures: a flight's frames, folders of images and whole rasters through the network.

What the network said of a frame is kept by content (the frame's bytes, the weights, the settings), so a second run over
the same frames asks it nothing, and a frame, weights or a height that changed is asked anew.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import rasterio
import rasterio.enums
import rasterio.windows
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import Geod
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from brmgeo.errors import FlightError, InputError, MissingInputError, SettingsError
from brmgeo.export.cog import write_cog
from brmgeo.flight.camera import level_from_camera
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.geo.crs import LONLAT, transformer
from brmgeo.geo.grid import Window
from brmgeo.segment.predict import (
    OVERLAP_PX,
    WINDOW_PX,
    Gsd,
    Picture,
    Segmenter,
    mask_of,
    picture_of,
    read_image,
    scaled_levels,
    spans,
)
from brmgeo.segment.weights import ModelCard
from brmgeo.workflow.progress import Bar, Progress

Answer = Literal["mask", "probability"]
#: Probabilities on disk: 0 to 254 for 0 to 1, 255 for unknown.
STEPS, UNKNOWN = 254, 255
#: A network finds roofs, and a roof is seen where its height puts it: its masks are laid onto a plane this high above ground
#: (one storey), not onto the ground. Sheffield's frames then register 0.7 m nearer to the reference.
ROOF_M = 3.0
IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
SIGN = "masks.json"
_FORMAT = 1  # of the cache's files and key
_BLOCK_PX = 512
#: Frames that go through the network together, and the pixels after which no further one is added.
_BATCH, _BATCH_PX = 4, 4_000_000


# --- frames of a flight ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FrameMasks:
    """What is building in each frame of a flight, and where that is from.

    Attributes:
        flight: the flight.
        source: for reports: the flight's own masks, or the network and its weights.
        files: the network's probability of each frame; None for the flight's own masks.
        threshold: probabilities above it are building; None hands probabilities on as they are.
        roof_m: what the masks show as building stands this high above ground; 0 for outlines on the ground.
    """

    flight: Flight
    source: str
    files: tuple[Path, ...] | None = None
    threshold: float | None = None
    roof_m: float = 0.0

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
        probability = _probability(stored)
        return probability if self.threshold is None else mask_of(probability, self.threshold)


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
    flight: Flight, given: str, use: NetworkUse, progress: Progress, region: str = ""
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
        progress.say(f"{flight.name}: {warning}")
    with tempfile.TemporaryDirectory(prefix="brmgeo-masks-") as scratch:
        files = _ask(flight, segmenter, use.cache or Path(scratch), progress)
        threshold = segmenter.card.threshold if use.answer == "mask" else None
        runs = {"onnx": "ONNX Runtime", "torch": "torch"}[segmenter.backend]
        shown = "probabilities" if threshold is None else f"masks above {threshold:g}"
        source = f"network {segmenter.name} ({runs}), {shown}, roofs at {use.roof_m:g} m"
        yield FrameMasks(flight, source, files, threshold, use.roof_m)


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
    probability = _probability(_stored(segmenter.probability(picture, gsd_m)))
    return (
        probability
        if NetworkUse().answer == "probability"
        else mask_of(probability, segmenter.card.threshold)
    )


def photographed(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """A (h, w, 3) RGB picture after the JPEG that a camera would store."""
    ok, data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    seen = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert seen is not None
    return np.ascontiguousarray(seen[:, :, ::-1]).astype(np.uint8, copy=False)


def slant_gsd_m(camera: Camera, mount: Attitude, roll_rad: float, pitch_rad: float, agl_m: float) -> float:
    """Metres per pixel at the middle of a frame: height over focal length, along the camera's slant."""
    axis = level_from_camera(mount, roll_rad, pitch_rad)[:, 2]
    return float(agl_m / math.sqrt(camera.fx * camera.fy) / max(-axis[2], 0.25))


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


def _ask(flight: Flight, segmenter: Segmenter, cache: Path, progress: Progress) -> tuple[Path, ...]:
    """The file of each frame's probability, after the network has answered for those that are not there yet."""
    files: list[Path] = []
    waiting: list[tuple[Path, Picture, float]] = []
    asked = 0

    def answer() -> None:
        said = segmenter.probabilities([p for _, p, _ in waiting], [g for _, _, g in waiting])
        for (path, _, _), probability in zip(waiting, said, strict=True):
            _write_png(path, _stored(probability))
        waiting.clear()

    with progress.stage(f"{flight.name} masks") as bar:
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
        progress.say(f"{flight.name} masks: {kept} of {len(files)} frames were known from an earlier run")
    return tuple(files)


def _key(data: bytes, segmenter: Segmenter, picture: Picture, gsd_m: float) -> Path:
    size = segmenter.working_size((picture.rgb.shape[0], picture.rgb.shape[1]), gsd_m)
    settings = {
        "format": _FORMAT,
        "weights": segmenter.card.sha256,
        "backend": segmenter.backend,
        "looks": segmenter.looks,
    }
    text = json.dumps({**settings, "frame": hashlib.sha256(data).hexdigest(), "size": size}, sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()
    return Path(key[:2]) / f"{key[2:40]}.png"


def _stored(probability: NDArray[np.float32]) -> NDArray[np.uint8]:
    known = np.isfinite(probability)
    steps = np.rint(np.where(known, probability, 0.0) * STEPS)
    return np.where(known, steps, UNKNOWN).astype(np.uint8)


def _probability(stored: NDArray[np.uint8]) -> NDArray[np.float32]:
    out = stored.astype(np.float32) / np.float32(STEPS)
    out[stored == UNKNOWN] = np.nan
    return out


def _read_stored(path: Path) -> NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return (
        None if image is None or image.ndim != 2 or image.dtype != np.uint8 else np.asarray(image, np.uint8)
    )


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(".png", image)
    assert ok
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_bytes(data.tobytes())
    part.replace(path)


# --- folders of images -------------------------------------------------------------------------------------------


def segment(
    source: Path,
    out: Path,
    weights: Path | None = None,
    *,
    backend: str | None = None,
    answer: Answer = "mask",
    gsd_m: float | None = None,
    levels: tuple[float, float] | None = None,
    bands: tuple[int, ...] | None = None,
    looks: int | None = None,
) -> str:
    """Masks of a flight's frames, of a folder of images, or of one raster; returns what was done, for people.

    Args:
        source: a flight folder, a folder of images, or a GeoTIFF.
        out: a folder for masks (STEM.png), or the GeoTIFF to write.
        answer: ``mask`` (frames: 0 and 255; rasters: 0, 1, 255 = unknown) or ``probability`` (frames: 0 to 254, 255 =
            unknown; rasters: steps of 1e-4).
        gsd_m: metres per pixel of images in a plain folder; flights and rasters know theirs.
        levels: the levels that are black and white in images of more than 8 bits.
        bands: red, green and blue band of a raster, from 1.
        looks: how often the network looks at a picture, see ``Segmenter.load``; None: as its card says.
    """
    if levels is not None and not (all(map(math.isfinite, levels)) and levels[0] < levels[1]):
        raise SettingsError(f"--levels {levels[0]:g},{levels[1]:g}: give black, then a higher white")
    flight = source.is_dir() and (source / "flight.toml").is_file()
    if not source.exists():
        raise MissingInputError(f"{source}: there is no such folder or raster")
    if bands is not None and (source.is_dir() or len(bands) not in (1, 3)):
        raise SettingsError("--bands: give one band or three (red, green, blue) of a raster")
    if gsd_m is not None and (flight or not source.is_dir()):
        raise SettingsError(f"--gsd goes with a plain folder of images; {source} says its own")
    if gsd_m is not None and not (math.isfinite(gsd_m) and gsd_m > 0):
        raise SettingsError(f"--gsd {gsd_m:g}: give metres per pixel, above 0")
    if levels is not None and flight:
        raise SettingsError("--levels goes with rasters and plain folders; a flight's frames have 8 bits")
    segmenter = Segmenter.load(weights, backend, looks=looks)
    if not source.is_dir():
        return segment_raster(source, out, segmenter, answer, levels=levels, bands=bands)
    pictures = _flight_pictures(source) if flight else _folder_pictures(source, gsd_m, levels)
    return _segment_pictures(source, out, segmenter, answer, pictures)


@dataclass(frozen=True, slots=True)
class _Job:
    name: str
    picture: Any  # a function that reads it
    gsd_m: Gsd | None


def _flight_pictures(folder: Path) -> list[_Job]:
    flight = read_flight(folder)
    if not flight.has_images:
        raise MissingInputError(f"{folder}: the flight has no frames, only masks")
    return [
        _Job(frame.file, lambda i=i: frame_picture(flight, i)[0], frame_gsd_m(flight, i))
        for i, frame in enumerate(flight.frames)
    ]


def _folder_pictures(folder: Path, gsd_m: float | None, levels: tuple[float, float] | None) -> list[_Job]:
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGES and not p.name.startswith("."))
    if not files:
        raise MissingInputError(f"{folder}: there are no images ({', '.join(IMAGES)}) in it")
    return [_Job(p.name, lambda p=p: read_image(p, levels=levels), gsd_m) for p in files]


def _segment_pictures(
    source: Path, out: Path, segmenter: Segmenter, answer: Answer, jobs: Sequence[_Job]
) -> str:
    names = [f"{Path(job.name).stem}.png" for job in jobs]
    double = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
    if double:
        raise InputError(
            f"{source}: two images' names differ only in their ending, so both would be {double}"
        )
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not (out / SIGN).is_file()):
        raise SettingsError(
            f"--out {out}: there are other files than masks; give a new folder or an empty one"
        )
    others = sorted({p.name for p in out.glob("*.png")} - set(names))
    if others:
        raise SettingsError(
            f"--out {out}: there are masks of other images ({others[0]}{' and others' if others[1:] else ''}); give a new "
            "folder, or take them away first"
        )
    facts: dict[str, Any] = {
        "source": str(source),
        "answer": answer,
        "values": "0 other, 255 building" if answer == "mask" else "0 to 254 for 0 to 1, 255 unknown",
        "weights": segmenter.card.sha256,
        "network": segmenter.name,
        "backend": segmenter.backend,
        "looks": segmenter.looks,
        "threshold": segmenter.card.threshold,
        "images": len(jobs),
        "finished": False,
    }
    progress = Progress()
    share = 0.0
    # A picture or a scale that cannot be is told before there is a folder.
    rows, cols, _ = jobs[0].picture().rgb.shape
    segmenter.working_size((rows, cols), jobs[0].gsd_m)
    # Before the masks, so that the same command may go on where one was killed.
    _write_facts(out, facts)
    with progress.stage("masks") as bar:
        for done, (job, name) in enumerate(zip(jobs, names, strict=True), start=1):
            probability = segmenter.probability(job.picture(), job.gsd_m)
            mask = mask_of(probability, segmenter.card.threshold)
            _write_png(out / name, mask if answer == "mask" else _stored(probability))
            share += float((mask > 0).mean()) / len(jobs)
            bar.update(done, len(jobs))
    _write_facts(out, {**facts, "finished": True, "building_share": round(share, 6)})
    return f"wrote {len(jobs)} of {answer} into {out}; {share:.1%} building; network {segmenter.name}"


def _write_facts(out: Path, facts: dict[str, Any]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    part = out / f".{SIGN}.part"
    part.write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    part.replace(out / SIGN)


# --- rasters -----------------------------------------------------------------------------------------------------


def segment_raster(
    raster: Path,
    out: Path,
    segmenter: Segmenter,
    answer: Answer = "mask",
    *,
    levels: tuple[float, float] | None = None,
    bands: tuple[int, ...] | None = None,
) -> str:
    """What is building in a georeferenced raster, as a cloud-optimised GeoTIFF; returns what was done, for people.

    The result lies on the raster's own pixels where its GSD is one that the network was trained for, else on pixels of
    the network's working GSD over the same ground. Read and written in overlapping windows, blended; memory grows with
    the width alone (6 kB a column).

    Raises MissingInputError or InputError for rasters that cannot be read, have no CRS, are too coarse, or have more than
    8 bits where ``levels`` is not given.
    """
    if not raster.is_file():
        raise MissingInputError(f"{raster}: there is no such raster")
    if out.suffix.lower() not in (".tif", ".tiff"):
        raise SettingsError(f"--out {out}: a raster's mask is a GeoTIFF: give a name that ends in .tif")
    if out.exists() and out.samefile(raster):
        raise SettingsError(f"--out {out} is the raster itself; give another name")
    if not out.absolute().parent.is_dir():
        raise SettingsError(f"--out {out}: there is no folder {out.absolute().parent}; make it first")
    try:
        with _placed_or_not(raster) as src:
            reader = _RasterReader(src, raster, segmenter, levels, bands)
            progress = Progress()
            with progress.stage(f"{raster.name} {answer}") as bar:
                stats = write_cog(
                    out,
                    reader.blocks(segmenter, answer, bar),
                    reader.box,
                    kind="mask" if answer == "mask" else "ratio",
                    # A probability is the ratio of building at the point itself.
                    radii_m=() if answer == "mask" else (0.0,),
                    band_descriptions=() if answer == "mask" else ("probability of building",),
                    tags={
                        "SOFTWARE": "brmgeo",
                        "NETWORK": segmenter.name,
                        "WEIGHTS_SHA256": segmenter.card.sha256,
                        "THRESHOLD": repr(segmenter.card.threshold),
                        "LOOKS": str(segmenter.looks),
                    },
                )[0]
    except RasterioError as error:
        raise InputError(f"{raster}: not a readable raster: {' '.join(str(error).split())[:300]}") from None
    rows, cols = reader.box.shape
    shown = "no pixel is known" if not stats.known_px else f"{stats.mean:.1%} building"
    return (
        f"wrote {out}: {cols} x {rows} px of {reader.gsd_m:.3g} m (the raster's: {reader.native_m:.3g} m), {shown}; "
        f"network {segmenter.name}"
    )


@contextmanager
def _placed_or_not(raster: Path) -> Iterator[Any]:
    """A raster opened without rasterio's warning where it has no place: that is told as an error of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        src = rasterio.open(raster)
    with src:
        yield src


class _RasterReader:
    """An open raster, seen at the network's working GSD."""

    def __init__(
        self,
        src: Any,
        path: Path,
        segmenter: Segmenter,
        levels: tuple[float, float] | None,
        bands: tuple[int, ...] | None,
    ) -> None:
        if src.crs is None and path.suffix.lower() in (".jpg", ".jpeg", ".png"):
            raise InputError(
                f"{path}: a picture without place or scale, such as a frame: give the folder that holds it, with --gsd, "
                "metres per pixel"
            )
        if src.crs is None:
            raise InputError(
                f"{path}: no coordinate reference system, so nobody knows its scale or place; state it first "
                "(gdal_edit.py -a_srs EPSG:... FILE)"
            )
        if src.transform == Affine.identity():
            raise InputError(
                f"{path}: no georeferencing beside the CRS: its corner and pixel size are not stated"
            )
        self._src, self._path, self._levels = src, path, levels
        self._bands = _rgb_bands(src, path, bands)
        self._palette = _palette(src, self._bands)
        if (
            self._palette is None
            and levels is None
            and any(src.dtypes[b - 1] != "uint8" for b in self._bands)
        ):
            raise InputError(
                f"{path}: {src.dtypes[self._bands[0] - 1]} values; the network takes 8 bits a channel: say which levels "
                "are black and white (--levels LOW,HIGH)"
            )
        down, across = _ground_gsd_m(src, path)
        self.native_m = math.sqrt(down * across)
        try:
            rows, cols = segmenter.working_size((src.height, src.width), (down, across))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if min(rows, cols) < 16:
            raise InputError(
                f"{path}: {cols} x {rows} px are too few: give a raster of at least 16 px a side"
            )
        self._scale = (src.height / rows, src.width / cols)
        self.gsd_m = self.native_m * math.sqrt(self._scale[0] * self._scale[1])
        affine = src.transform @ Affine.scale(self._scale[1], self._scale[0])
        epsg = src.crs.to_epsg()
        self.box = GeoBox((rows, cols), affine, f"EPSG:{epsg}" if epsg else src.crs.to_wkt())

    def _window(self, row: int, col: int, height: int, width: int) -> rasterio.windows.Window:
        down, across = self._scale
        return rasterio.windows.Window(col * across, row * down, width * across, height * down)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        # Told here: within the writing of the result it would pass for a fault of the disk that is written to.
        try:
            yield
        except (RasterioError, CPLE_BaseError) as error:
            told = " ".join(str(error).split())[:200]
            raise InputError(f"{self._path}: damaged or cut short ({told}); copy it again") from None

    def known(self, row: int, col: int, height: int, width: int) -> NDArray[np.bool_]:
        """(height, width) bool of a window of the working lattice: True where the raster shows something."""
        with self._reading():
            mask = self._src.dataset_mask(
                window=self._window(row, col, height, width),
                out_shape=(height, width),
                resampling=rasterio.enums.Resampling.nearest,
            )
        return np.asarray(mask > 0)

    def picture(self, row: int, col: int, height: int, width: int) -> Picture | None:
        """A window of the working lattice as a picture; None where nothing of it is known."""
        known = self.known(row, col, height, width)
        if not known.any():
            return None
        shrunk = self._scale[0] * self._scale[1] > 1.0
        how = rasterio.enums.Resampling.average if shrunk else rasterio.enums.Resampling.cubic
        if self._scale == (1.0, 1.0) or self._palette is not None:
            how = rasterio.enums.Resampling.nearest
        with self._reading():
            seen = self._src.read(
                list(self._bands),
                window=self._window(row, col, height, width),
                out_shape=(len(self._bands), height, width),
                resampling=how,
            )
        image = np.moveaxis(seen, 0, -1)
        if self._palette is not None:
            image = self._palette[image[:, :, 0]]
        elif self._levels is not None:
            image = scaled_levels(image, *self._levels)
        return Picture(picture_of(image, str(self._path)).rgb, None if known.all() else known)

    def blocks(self, segmenter: Segmenter, answer: Answer, bar: Bar) -> Iterator[tuple[Window, NDArray[Any]]]:
        """The result in rows of blocks, each as soon as no window to come can touch it."""
        rows, cols = (int(n) for n in self.box.shape)
        down, across = (spans(n, WINDOW_PX, OVERLAP_PX) for n in (rows, cols))
        # Sums of weighted answers over the rows that are not written yet, from row ``top`` on.
        sums = np.zeros((min(rows, WINDOW_PX + _BLOCK_PX), cols), np.float32)
        top = count = 0
        for i, row in enumerate(down):
            for col in across:
                picture = self.picture(row.start, col.start, row.stop - row.start, col.stop - col.start)
                if picture is not None:
                    part = np.nan_to_num(segmenter.probability(picture))
                    place = (slice(row.start - top, row.stop - top), slice(col.start, col.stop))
                    sums[place] += row.weight[:, None] * part * col.weight
                count += 1
                bar.update(count, len(down) * len(across))
            last = i + 1 == len(down)
            ready = rows if last else down[i + 1].start // _BLOCK_PX * _BLOCK_PX
            for start in range(top, ready, _BLOCK_PX):
                height = min(_BLOCK_PX, ready - start)
                for left in range(0, cols, 4 * _BLOCK_PX):
                    width = min(4 * _BLOCK_PX, cols - left)
                    p = np.clip(sums[start - top : start - top + height, left : left + width], 0.0, 1.0)
                    p = np.where(self.known(start, left, height, width), p, np.float32(np.nan))
                    window = Window(start, left, height, width)
                    yield window, _as_mask(p, segmenter.card.threshold) if answer == "mask" else p[None]
            moved = ready - top
            sums[: len(sums) - moved] = sums[moved:].copy()
            sums[len(sums) - moved :] = 0.0
            top = ready


def _as_mask(p: NDArray[np.float32], threshold: float) -> NDArray[np.uint8]:
    building = mask_of(p, threshold) > 0
    return np.where(np.isnan(p), 255, building.astype(np.uint8)).astype(np.uint8)


def _rgb_bands(src: Any, path: Path, bands: tuple[int, ...] | None) -> tuple[int, ...]:
    """The bands that are red, green and blue, or the one that is grey."""
    if bands is not None:
        if any(not 1 <= b <= src.count for b in bands):
            raise SettingsError(f"--bands {','.join(map(str, bands))}: {path} has bands 1 to {src.count}")
        return bands
    kinds = rasterio.enums.ColorInterp
    named = {kind: band for band, kind in reversed(list(enumerate(src.colorinterp, start=1)))}
    if all(kind in named for kind in (kinds.red, kinds.green, kinds.blue)):
        return named[kinds.red], named[kinds.green], named[kinds.blue]
    if src.count == 2 and kinds.alpha not in named:
        raise SettingsError(f"{path} has two bands: say which are red, green and blue, or grey (--bands 1)")
    return (1, 2, 3) if src.count >= 3 else (1,)


def _palette(src: Any, bands: tuple[int, ...]) -> NDArray[np.uint8] | None:
    if len(bands) != 1 or src.colorinterp[bands[0] - 1] != rasterio.enums.ColorInterp.palette:
        return None
    table = np.zeros((256, 3), np.uint8)
    for value, colour in src.colormap(bands[0]).items():
        if 0 <= value < 256:
            table[value] = colour[:3]
    return table


def _ground_gsd_m(src: Any, path: Path) -> tuple[float, float]:
    """Metres on the ground of one pixel down and one across, in the middle of the raster, whatever its CRS."""
    row, col = src.height / 2.0, src.width / 2.0
    points = [src.transform @ at for at in ((col, row), (col, row + 1.0), (col + 1.0, row))]
    xs, ys = zip(*points, strict=True)
    lon, lat = transformer(src.crs.to_wkt(), LONLAT).transform(np.array(xs), np.array(ys))
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        raise InputError(f"{path}: its middle has no longitude and latitude: the CRS or the corner is wrong")
    geod = Geod(ellps="WGS84")
    down, across = (geod.inv(lon[0], lat[0], lon[k], lat[k])[2] for k in (1, 2))
    if not (down > 0 and across > 0):
        raise InputError(f"{path}: its pixels cover no ground: the CRS or the pixel size is wrong")
    return float(down), float(across)
