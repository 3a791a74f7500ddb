"""Pictures and masks of others, as training tiles have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brmgeo import pictures
from brmgeo.codes import LABEL_UNKNOWN
from brmgeo.errors import InputError
from brmgeo.segment.samples import blank_unknown
from brmgeo.segment.shards import check_label

SMALLEST_PX, LARGEST_PX = 32, 8192


def read_pair(image_path: Path, mask_path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """(h, w, 3) uint8 RGB and (h, w) uint8 label of a picture and its mask; unknown where transparent or plain filler.

    Raises InputError for files that are damaged, cut short, of more than 8 bits, of odd values or of different sizes.
    """
    image, seen = _read_image(image_path)
    label = check_label(_decoded(mask_path), str(mask_path))
    if label.shape != seen.shape:
        raise InputError(
            f"{mask_path}: {label.shape[1]} x {label.shape[0]} px, its image {image_path.name} has "
            f"{seen.shape[1]} x {seen.shape[0]}; give masks of their images' sizes"
        )
    label[~seen] = LABEL_UNKNOWN
    return image, blank_unknown(image, label)


def _read_image(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """(h, w, 3) uint8 RGB and (h, w) bool, False where it is transparent; InputError for what is no 8-bit picture."""
    found = _decoded(path)
    rgb, known = pictures.rgb_of(found, str(path))
    seen = np.ones(rgb.shape[:2], np.bool_) if known is None else known
    rgb[~seen] = 0
    return rgb, seen


def _decoded(path: Path) -> NDArray[np.uint8]:
    """A picture of 8 bits and a size that training tiles may have, with all its bands."""
    found = pictures.decode(pictures.read_bytes(path), str(path))
    if found.dtype != np.uint8:
        raise InputError(f"{path}: holds {found.dtype} values; give pictures of 8 bit")
    if min(found.shape[:2]) < SMALLEST_PX or max(found.shape[:2]) > LARGEST_PX:
        raise InputError(
            f"{path}: {found.shape[1]} x {found.shape[0]} px; training tiles have {SMALLEST_PX} to {LARGEST_PX} px a side: "
            "cut or leave out the picture"
        )
    return found
