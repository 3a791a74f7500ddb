"""Pictures are decoded whole, or it is said what is wrong with them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from rasterio.enums import ColorInterp

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
    assert pictures.decode(data, "a.x").shape == (40, 60, 3)
    with pytest.raises(InputError, match=r"a\.x: .*(cut short|no picture)"):
        pictures.decode(data[: len(data) // 2], "a.x")
    with pytest.raises(InputError, match="empty"):
        pictures.decode(b"", "a.x")
    with pytest.raises(InputError, match="no picture"):
        pictures.decode(b"plain text, and long enough", "a.x")


def _noise(rows: int = 120, cols: int = 160) -> np.ndarray:
    return np.random.default_rng(4).integers(0, 255, (rows, cols, 3), dtype=np.uint8)


@pytest.mark.parametrize("flags", [cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR, cv2.IMREAD_GRAYSCALE])
@pytest.mark.parametrize("bands", [1, 3])
def test_a_jpeg_s_pixels_are_opencv_s(flags: int, bands: int) -> None:
    data = pictures.encode(_noise() if bands == 3 else _noise()[:, :, 0], ".jpg")
    wanted = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    got = pictures.decode(data, "a.jpg", flags=flags)
    assert (got == (wanted[:, :, ::-1] if wanted.ndim == 3 else wanted)).all()


def test_damage_within_a_jpeg_is_found_where_pictures_move() -> None:
    """Bits flipped behind the header, the end marker left: what is not refused has every block at its place, and only its
    brightness from some block on, or one block, is another."""
    data = pictures.encode(_noise(), ".jpg", quality=80)
    whole = pictures.decode(data, "a.jpg", flags=cv2.IMREAD_GRAYSCALE).astype(int)
    rng = np.random.default_rng(1)
    first = data.index(b"\xff\xda") + 14
    refused = moved = 0
    for _ in range(100):
        damaged = bytearray(data)
        damaged[rng.integers(first, len(data) - 2)] ^= 1 << rng.integers(8)
        try:
            seen = pictures.decode(bytes(damaged), "a.jpg", flags=cv2.IMREAD_GRAYSCALE).astype(int)
        except InputError:
            refused += 1
        else:
            slopes = np.abs(np.diff(seen, axis=1) - np.diff(whole, axis=1))
            moved += bool((slopes > 6).mean() > 0.05)
    assert refused > 30
    assert moved <= 2


def test_what_a_camera_appends_is_no_damage() -> None:
    data = pictures.encode(_picture(), ".jpg")
    assert (pictures.decode(data + b"\0" * 500, "a.jpg") == pictures.decode(data, "a.jpg")).all()
    assert (pictures.decode(data + data, "a.jpg") == pictures.decode(data, "a.jpg")).all()


def test_a_damaged_png_is_told() -> None:
    data = bytearray(pictures.encode(_noise()))
    data[len(data) // 2] ^= 4
    with pytest.raises(InputError, match="damaged or cut short"):
        pictures.decode(bytes(data), "a.png")


def test_a_jpeg_of_printing_colours_is_read() -> None:
    out = io.BytesIO()
    Image.fromarray(_picture()).convert("CMYK").save(out, "jpeg")
    assert pictures.decode(out.getvalue(), "a.jpg", flags=cv2.IMREAD_COLOR).shape == (40, 60, 3)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        pictures.read_bytes(tmp_path / "gone.png")


def test_a_photograph_has_lost_a_little_and_keeps_its_colours() -> None:
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :32, 0], picture[:, 32:, 2] = 200, 150
    seen = pictures.photographed(picture, 90)
    assert seen.shape == picture.shape
    assert seen.dtype == np.uint8
    assert (seen != picture).any()
    assert np.abs(seen[8:40, 4:28].astype(int) - (200, 0, 0)).max() < 6
    assert np.abs(seen[8:40, 36:60].astype(int) - (0, 0, 150)).max() < 6


def test_grey_and_transparent_pictures_as_rgb() -> None:
    grey = _picture()[:, :, 0]
    rgb, known = pictures.rgb_of(grey, "a")
    assert known is None
    assert (rgb == grey[:, :, None]).all()
    alpha = np.where(np.arange(60) < 20, 0, 9).astype(np.uint8) + np.zeros((40, 1), np.uint8)
    for image in (np.dstack([_picture(), alpha]), np.dstack([grey, alpha])):
        rgb, known = pictures.rgb_of(image, "a")
        assert rgb.shape == (40, 60, 3)
        assert known is not None
        assert (known == (alpha > 0)).all()
    with pytest.raises(InputError, match="a: an array of"):
        pictures.rgb_of(np.zeros((4, 4, 5), np.uint8), "a")


def test_levels_are_cut_off_and_rounded() -> None:
    values = np.array([-5.0, 0.0, 1.0, 3.0, 510.0, 9e9, np.inf, np.nan], np.float32)
    assert pictures.scaled_levels(values, 0, 510).tolist() == [0, 0, 1, 2, 255, 255, 255, 0]


class _Raster:
    """What is asked of a raster that rasterio opened."""

    def __init__(self, *kinds: ColorInterp, dtype: str = "uint8") -> None:
        self.colorinterp, self.count = kinds, len(kinds)
        self.indexes, self.dtypes = tuple(range(1, self.count + 1)), (dtype,) * self.count

    def colormap(self, band: int) -> dict[int, tuple[int, int, int, int]]:
        return {band: (1, 2, 3, 255), 400: (9, 9, 9, 255)}


C = ColorInterp


@pytest.mark.parametrize(
    ("kinds", "stated", "bands"),
    [
        ((C.blue, C.green, C.red, C.alpha), None, (3, 2, 1)),
        ((C.undefined, C.red, C.green, C.blue), None, (2, 3, 4)),
        ((C.gray, C.undefined, C.undefined, C.undefined), None, (1, 2, 3)),
        ((C.alpha, C.gray), None, (2,)),
        ((C.gray,), None, (1,)),
        ((C.alpha,), None, (1,)),
        ((C.gray, C.undefined), (2,), (2,)),
        ((C.red, C.green, C.blue), (3, 2, 1), (3, 2, 1)),
    ],
)
def test_bands_of_colour(
    kinds: tuple[C, ...], stated: tuple[int, ...] | None, bands: tuple[int, ...]
) -> None:
    assert pictures.colour_bands(_Raster(*kinds), Path("a.tif"), stated) == bands


@pytest.mark.parametrize(
    ("kinds", "stated"),
    [
        ((C.gray, C.undefined), None),
        ((C.gray, C.undefined, C.alpha), None),
        ((C.red, C.green, C.blue), (1, 2)),
        ((C.red, C.green, C.blue), (0,)),
    ],
)
def test_bands_that_nobody_can_tell_are_refused(kinds: tuple[C, ...], stated: tuple[int, ...] | None) -> None:
    with pytest.raises(InputError, match=r"a\.tif") as caught:
        pictures.colour_bands(_Raster(*kinds), Path("a.tif"), stated)
    assert caught.value.needs == "bands"


def test_a_palette_is_a_table_of_256_colours() -> None:
    table = pictures.palette_of(_Raster(C.palette), Path("a.tif"), (1,))
    assert table is not None
    assert table.shape == (256, 4)
    assert table[:2].tolist() == [[0, 0, 0, 0], [1, 2, 3, 255]]
    assert pictures.palette_of(_Raster(C.gray), Path("a.tif"), (1,)) is None
    with pytest.raises(InputError, match=r"a\.tif: a palette of uint16"):
        pictures.palette_of(_Raster(C.palette, dtype="uint16"), Path("a.tif"), (1,))


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate"])
def test_damage_that_the_decoder_of_a_tiff_tells_is_no_picture(compression: str) -> None:
    """OpenCV fills up what follows it, and only its log says so."""
    buffer = io.BytesIO()
    Image.fromarray(_noise()).save(buffer, "TIFF", compression=compression)
    data = bytearray(buffer.getvalue())
    assert (pictures.decode(bytes(data), "a.tif") == _noise()).all()
    data[len(data) // 2 : len(data) // 2 + 8] = b"\xff" * 8
    with pytest.raises(InputError, match=r"a\.tif: damaged"):
        pictures.decode(bytes(data), "a.tif")


def test_a_jpeg_that_promises_billions_of_pixels_is_refused_before_it_is_decoded() -> None:
    data = bytearray(pictures.encode(_picture(), ".jpg"))
    at = data.find(b"\xff\xc0") + 5
    data[at : at + 4] = (65_500).to_bytes(2, "big") * 2
    with pytest.raises(InputError, match=r"a\.jpg: too many pixels"):
        pictures.decode(bytes(data), "a.jpg")
