"""Masks from pictures: a flight's frames, folders of images and whole rasters through the network."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.export.cog import write_cog
from brmgeo.files import write_bytes
from brmgeo.flight.folder import read_flight
from brmgeo.geo.crs import LONLAT, transformer
from brmgeo.geo.grid import Window
from brmgeo.locate.masks import Answer, frame_gsd_m, frame_picture, stored_of
from brmgeo.pictures import encode
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
from brmgeo.workflow.progress import Bar, Progress

IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
SIGN = "masks.json"
_BLOCK_PX = 512


def photographed(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """A (h, w, 3) RGB picture after the JPEG that a camera would store."""
    ok, data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    seen = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert seen is not None
    return np.ascontiguousarray(seen[:, :, ::-1]).astype(np.uint8, copy=False)


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
            write_bytes(out / name, encode(mask if answer == "mask" else stored_of(probability)))
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
