"""Pictures from files: decoded whole, or told what is wrong with them; their bands, palettes and levels as 8-bit RGB."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

from brmgeo.errors import InputError, MissingInputError, one_line
from brmgeo.files import told

#: Endings of the picture files that are looked for in folders.
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_JPEG_FLAGS = (cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR, cv2.IMREAD_GRAYSCALE)
# Where Pillow takes a picture for a bomb.
_MOST_PX = 178_956_970
_TOO_MANY = "too many pixels for one picture"
# Words of Pillow's errors for a picture whose kind it knows; "decoder error" is that of compressed TIFFs.
_DAMAGE = ("truncated", "broken", "decoder error")


def read_bytes(path: Path) -> bytes:
    """A picture file's bytes; MissingInputError where it is not there, InputError where it cannot be read."""
    if not path.is_file():
        raise MissingInputError(f"{path}: there is no such picture")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the picture cannot be read ({told(error)})") from None


def decode(data: bytes, name: str, *, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """(h, w) or (h, w, bands) of a picture file's bytes, sensor's rows and columns, channels as RGB or RGBA.

    Args:
        name: of the file, for messages.
        flags: OpenCV's; an EXIF turn is never applied.

    Raises InputError, naming the file, for what is empty, cut short, damaged or no picture: whatever its decoder warns of.
    """
    if not data:
        raise _faulty(name, "the file is empty")
    image = _jpeg(data, name, flags) if data[:2] == b"\xff\xd8" else None
    if image is None:
        _require_whole(data, name)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise _faulty(name, "no picture that can be decoded")
        if image.ndim == 3 and image.shape[2] >= 3:
            image = image[:, :, [2, 1, 0, 3][: image.shape[2]]]
    return np.ascontiguousarray(image)


def _faulty(name: str, fault: str) -> InputError:
    return InputError(f"{name}: {fault}: copy it again, or convert it to PNG or JPEG")


def _jpeg(data: bytes, name: str, flags: int) -> NDArray[Any] | None:
    """A JPEG's pixels, the same as OpenCV's, by a decoder whose warnings are errors; None for one that it does not know.

    OpenCV fills up what is missing of a picture with grey and says nothing of what it could not make sense of.
    """
    try:
        height, width, colours, _ = simplejpeg.decode_jpeg_header(data)
        if height * width > _MOST_PX:
            raise _faulty(name, _TOO_MANY)
        if colours not in ("Gray", "YCbCr", "RGB") or flags not in _JPEG_FLAGS:
            return None
        grey = flags == cv2.IMREAD_GRAYSCALE or (flags == cv2.IMREAD_UNCHANGED and colours == "Gray")
        image: NDArray[np.uint8] = simplejpeg.decode_jpeg(
            data, colorspace="GRAY" if grey else "RGB", strict=True
        )
    except ValueError as error:
        raise _faulty(name, f"damaged or cut short ({one_line(error, 120)})") from None
    return image[:, :, 0] if grey else image


def _require_whole(data: bytes, name: str) -> None:
    """InputError for a picture that Pillow calls damaged, and OpenCV fills up."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures and odd tags, which do not matter here
            with Image.open(io.BytesIO(data)) as shown:
                shown.load()
    except Image.DecompressionBombError:
        raise _faulty(name, _TOO_MANY) from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        # Pillow knows fewer kinds of TIFF and PNG than OpenCV; of those OpenCV's word counts.
        if data[:2] == b"\xff\xd8" or any(word in str(error) for word in _DAMAGE):
            raise _faulty(name, f"damaged or cut short ({error})") from None


def encode(
    image: NDArray[np.uint8], suffix: str = ".png", *, quality: int = 95, options: Sequence[int] = ()
) -> bytes:
    """The bytes of a picture file: (h, w) grey or (h, w, 3) RGB; ``quality`` of a JPEG, 1 to 100; ``options``: OpenCV's."""
    bands = image[:, :, ::-1] if image.ndim == 3 else image
    own = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in (".jpg", ".jpeg") else []
    done, data = cv2.imencode(suffix, np.ascontiguousarray(bands), [*own, *options])
    if not done:
        raise ValueError(f"a picture of {image.shape} {image.dtype} cannot be written as {suffix}")
    return data.tobytes()


def photographed(rgb: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """A (h, w, 3) RGB picture after the JPEG, of a quality of 1 to 100, that a camera would store."""
    data = np.frombuffer(encode(rgb, ".jpg", quality=quality), np.uint8)
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1])


# --- as 8-bit RGB ------------------------------------------------------------------------------------------------


def rgb_of(image: NDArray[np.uint8], name: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """(h, w, 3) RGB of (h, w) or (h, w, 1 to 4), and (h, w) bool, False where it is transparent; None: nowhere.

    Grey is repeated in the three channels; a second or fourth channel is alpha, and 0 there is transparent. Raises
    InputError, with ``name``, for other shapes.
    """
    if image.ndim == 2:
        image = image[:, :, None]
    if image.ndim != 3 or image.shape[2] not in (1, 2, 3, 4):
        raise InputError(
            f"{name}: an array of {image.shape}; give rows x columns x 1 to 4 channels (grey or RGB, with alpha or without)"
        )
    channels = image.shape[2]
    known = image[:, :, -1] > 0 if channels in (2, 4) else None
    rgb = np.repeat(image[:, :, :1], 3, axis=2) if channels < 3 else image[:, :, :3]
    return np.ascontiguousarray(rgb), None if known is None or known.all() else known


def scaled_levels(values: NDArray[Any], low: float, high: float) -> NDArray[np.uint8]:
    """``low`` to ``high`` of any numbers as 0 to 255, cut off at the ends, halves upwards; NaN becomes 0."""
    levels = np.nan_to_num((values.astype(np.float64) - low) * (255.0 / (high - low)))
    return np.floor(np.clip(levels, 0.0, 255.0) + 0.5).astype(np.uint8)


def colour_bands(raster: Any, path: Path, stated: Sequence[int] | None = None) -> tuple[int, ...]:
    """The bands (from 1) of a raster opened by rasterio that are red, green and blue, or the one that is grey.

    They are the ``stated`` ones; else those that the file labels; else its first three, or its first, that are not alpha.
    Raises InputError for bands that are not there, and where two bands do not say which is which.
    """
    if stated is not None:
        told = ",".join(map(str, stated))
        if not set(stated) <= set(raster.indexes):
            raise InputError(f"bands {told}: {path} has bands 1 to {raster.count}", needs="bands")
        if len(stated) not in (1, 3):
            raise InputError(f"bands {told}: state one band of {path}, or three", needs="bands")
        return tuple(stated)
    kinds = [kind.name for kind in raster.colorinterp]
    if {"red", "green", "blue"} <= set(kinds):
        return tuple(kinds.index(colour) + 1 for colour in ("red", "green", "blue"))
    colours = [band for band, kind in enumerate(kinds, start=1) if kind != "alpha"]
    if len(colours) == 2:
        raise InputError(
            f"{path} has two bands: state bands, which are red, green and blue, or which one is grey, such as 1",
            needs="bands",
        )
    return tuple(colours[:3] if len(colours) > 2 else colours or [1])


def palette_of(raster: Any, path: Path, bands: Sequence[int]) -> NDArray[np.uint8] | None:
    """(256, 4) RGBA of each value of the one band of a raster opened by rasterio; None where it has no palette.

    Raises InputError for a palette of more than 256 colours.
    """
    if len(bands) != 1 or raster.colorinterp[bands[0] - 1].name != "palette":
        return None
    if (kind := raster.dtypes[bands[0] - 1]) != "uint8":
        raise InputError(
            f"{path}: a palette of {kind} values: expand it to RGB first (gdal_translate -expand rgb)"
        )
    table = raster.colormap(bands[0])
    return np.array([table.get(value, (0, 0, 0, 0)) for value in range(256)], dtype=np.uint8)
