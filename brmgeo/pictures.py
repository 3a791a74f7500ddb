"""Pictures from files: decoded whole, or told what is wrong with them."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from brmgeo.errors import InputError, MissingInputError

#: Endings of the picture files that are looked for in folders.
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def fault_of(data: bytes) -> str | None:
    """What is wrong with the bytes of a picture file, in a few words; None for a whole picture.

    OpenCV fills up what is missing of a picture with grey and says nothing; Pillow refuses it. So it is decoded twice, which
    costs three milliseconds a 640 x 480 JPEG.
    """
    if not data:
        return "the file is empty"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures and odd tags, which do not matter here
            with Image.open(io.BytesIO(data)) as shown:
                shown.load()
    except Image.DecompressionBombError:
        return "too many pixels for one picture"
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        # Pillow knows fewer kinds of TIFF and PNG than OpenCV; of those OpenCV's word counts.
        if data[:2] == b"\xff\xd8" or "truncated" in str(error) or "broken" in str(error):
            return f"damaged or cut short ({error})"
    return None


def read_bytes(path: Path) -> bytes:
    """A picture file's bytes; MissingInputError where it is not there, InputError where it cannot be read."""
    if not path.is_file():
        raise MissingInputError(f"{path}: there is no such picture")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the picture cannot be read ({error.strerror})") from None


def decode(data: bytes, name: str, *, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """(h, w) or (h, w, bands) of a picture file's bytes, sensor's rows and columns, channels as RGB or RGBA.

    Args:
        name: of the file, for messages.
        flags: OpenCV's; an EXIF turn is never applied.

    Raises InputError, naming the file, for what is empty, cut short, damaged or no picture.
    """
    fault = fault_of(data)
    image = None
    if fault is None:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            fault = "no picture that can be decoded"
    if image is None:
        raise InputError(f"{name}: {fault}: copy it again, or convert it to PNG or JPEG")
    if image.ndim == 3 and image.shape[2] >= 3:
        image = image[:, :, [2, 1, 0, 3][: image.shape[2]]]
    return np.ascontiguousarray(image)


def encode(image: NDArray[np.uint8], suffix: str = ".png", *, quality: int = 95) -> bytes:
    """The bytes of a picture file: (h, w) grey or (h, w, 3) RGB; ``quality`` of a JPEG, 1 to 100."""
    bands = image[:, :, ::-1] if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in (".jpg", ".jpeg") else []
    done, data = cv2.imencode(suffix, np.ascontiguousarray(bands), options)
    if not done:
        raise ValueError(f"a picture of {image.shape} {image.dtype} cannot be written as {suffix}")
    return data.tobytes()
