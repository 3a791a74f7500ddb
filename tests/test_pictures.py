"""Pictures are decoded whole, or it is said what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brmgeo import pictures
from brmgeo.errors import InputError, MissingInputError


def _picture() -> np.ndarray:
    image = np.zeros((40, 60, 3), np.uint8)
    image[:20, :, 0], image[20:, :, 2] = 255, 255
    return image


def test_colours_come_back_as_rgb() -> None:
    assert (pictures.decode(pictures.encode(_picture()), "a.png") == _picture()).all()
    seen = pictures.decode(pictures.encode(_picture(), ".jpg"), "a.jpg")
    assert seen[5, 30, 0] > 240
    assert seen[35, 30, 2] > 240
    grey = _picture()[:, :, 0]
    assert (pictures.decode(pictures.encode(grey), "a.png") == grey).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_what_is_cut_short_is_told(suffix: str) -> None:
    data = pictures.encode(_picture(), suffix)
    assert pictures.fault_of(data) is None
    with pytest.raises(InputError, match=r"a\.x: .*(cut short|no picture)"):
        pictures.decode(data[: len(data) // 2], "a.x")
    with pytest.raises(InputError, match="empty"):
        pictures.decode(b"", "a.x")
    with pytest.raises(InputError, match="no picture"):
        pictures.decode(b"plain text, and long enough", "a.x")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        pictures.read_bytes(tmp_path / "gone.png")
