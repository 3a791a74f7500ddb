"""`brmgeo segment`: masks of a flight's frames, of a folder of images, or of a whole raster, by the network."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.files import WRITTEN, read_json, write_json, write_listed
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.locate.masks import frame_gsd_m, frame_picture, stored_of
from brmgeo.pictures import SUFFIXES, encode
from brmgeo.segment.predict import Answer, Gsd, Picture, Segmenter, read_image, thresholded
from brmgeo.workflow.progress import Progress

SIGN = "masks.json"


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
        out: a folder for masks (STEM.png), or the GeoTIFF to write. A mask that somebody changed since it was written there
            is set aside.
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


# --- folders of images -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Job:
    """One image: its file's name, what reads it, and its metres per pixel."""

    name: str
    picture: Callable[[], Picture]
    gsd_m: Gsd | None


def _frame(flight: Flight, index: int) -> Picture:
    return frame_picture(flight, index)[0]


def _flight_pictures(folder: Path) -> list[_Job]:
    flight = read_flight(folder)
    if not flight.has_images:
        raise MissingInputError(f"{folder}: the flight has no frames, only masks")
    return [
        _Job(frame.file, functools.partial(_frame, flight, i), frame_gsd_m(flight, i))
        for i, frame in enumerate(flight.frames)
    ]


def _folder_pictures(folder: Path, gsd_m: float | None, levels: tuple[float, float] | None) -> list[_Job]:
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    if not files:
        raise MissingInputError(f"{folder}: there are no images ({', '.join(SUFFIXES)}) in it")
    return [_Job(p.name, functools.partial(read_image, p, levels=levels), gsd_m) for p in files]


def _segment_pictures(
    source: Path, out: Path, segmenter: Segmenter, answer: Answer, jobs: Sequence[_Job]
) -> str:
    names = [f"{Path(job.name).stem}.png" for job in jobs]
    _may_write(source, out, names)
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
    share = 0.0
    # A picture or a scale that cannot be is told before there is a folder.
    rows, cols, _ = jobs[0].picture().rgb.shape
    segmenter.working_size((rows, cols), jobs[0].gsd_m)
    out.mkdir(parents=True, exist_ok=True)
    # Before the masks, so that the same command may go on where one was killed.
    write_json(out / SIGN, facts)
    progress = Progress()
    with progress.stage("masks") as bar:
        for done, (job, name) in enumerate(zip(jobs, names, strict=True), start=1):
            probability = segmenter.probability(job.picture(), job.gsd_m)
            mask = thresholded(probability, segmenter.card.threshold)
            data = encode(mask if answer == "mask" else stored_of(probability))
            write_listed(out / name, data, progress.say)
            share += float((mask > 0).mean()) / len(jobs)
            bar.update(done, len(jobs))
    write_json(out / SIGN, {**facts, "finished": True, "building_share": round(share, 6)})
    return f"wrote {len(jobs)} of {answer} into {out}; {share:.1%} building; network {segmenter.name}"


def _may_write(source: Path, out: Path, names: Sequence[str]) -> None:
    """InputError for two images of one stem, SettingsError where ``out`` holds what is none of these masks."""
    double = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
    if double:
        raise InputError(
            f"{source}: two images' names differ only in their ending, so both would be {double}"
        )
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not (out / SIGN).is_file()):
        raise SettingsError(
            f"--out {out}: there are other files than masks; give a new folder or an empty one"
        )
    # What is not listed is none of our masks: it stays.
    listed = read_json(out / WRITTEN)
    others = sorted({p.name for p in out.glob("*.png") if listed is None or p.name in listed} - set(names))
    if others:
        raise SettingsError(
            f"--out {out}: there are masks of other images ({others[0]}{' and others' if others[1:] else ''}); give a new "
            "folder, or take them away first"
        )


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

    Raises SettingsError where the result may not stand at ``out``, else as ``open_raster``.
    """
    # Here, for the masks of pictures need none of the libraries of maps.
    from brmgeo.export.cog import write_cog
    from brmgeo.segment.raster import open_raster

    if out.suffix.lower() not in (".tif", ".tiff"):
        raise SettingsError(f"--out {out}: a raster's mask is a GeoTIFF: give a name that ends in .tif")
    if out.exists() and out.samefile(raster):
        raise SettingsError(f"--out {out} is the raster itself; give another name")
    if not out.absolute().parent.is_dir():
        raise SettingsError(f"--out {out}: there is no folder {out.absolute().parent}; make it first")
    with (
        open_raster(raster, segmenter, levels=levels, bands=bands) as reader,
        Progress().stage(f"{raster.name} {answer}") as bar,
    ):
        stats = write_cog(
            out,
            reader.blocks(answer, bar.update),
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
    rows, cols = reader.box.shape
    shown = "no pixel is known" if not stats.known_px else f"{stats.mean:.1%} building"
    return (
        f"wrote {out}: {cols} x {rows} px of {reader.gsd_m:.3g} m (the raster's: {reader.native_m:.3g} m), {shown}; "
        f"network {segmenter.name}"
    )
