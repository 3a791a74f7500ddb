"""`brmgeo segment`: frames, folders of images and rasters in windows, through the command line.

The network here is one convolution that calls what is bright building (tests/small_networks.py), and the pictures'
buildings are bright: what comes out can be worked out by hand.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp
from small_flights import CRS, Said, bytes_of

from brmgeo.flight.folder import read_flight
from brmgeo.locate.masks import frame_gsd_m
from brmgeo.segment import predict
from brmgeo.segment import raster as rasters
from brmgeo.segment.predict import Segmenter
from pipelines.segment import SIGN

Say = Callable[..., Said]


# ---------------------------------------------------------------- folders of images


def test_segment_a_flight_and_a_folder(
    pictured: Path,
    weights: Path,
    tmp_path: Path,
    say: Say,
) -> None:
    said = say("segment", pictured, "--out", tmp_path / "masks", "--weights", weights)
    assert said.code == 0, said.err
    flight = read_flight(pictured)
    facts = json.loads((tmp_path / "masks" / SIGN).read_text())
    assert facts["images"] == len(flight.frames)
    assert facts["finished"]
    assert facts["weights"] == "ab" * 32
    # They are masks by the letter of docs/FLIGHT.md.
    given = Path(shutil.copytree(pictured, tmp_path / "given"))
    shutil.copytree(tmp_path / "masks", given / "masks")
    again = read_flight(given)
    segmenter = Segmenter.load(weights)
    assert (again.mask(1) == segmenter.mask(flight.image(1), frame_gsd_m(flight, 1))).all()

    folder = tmp_path / "images"
    folder.mkdir()
    rgba = np.full((40, 60, 4), 255, np.uint8)
    rgba[:, :30, 3] = 0
    cv2.imwrite(str(folder / "a.png"), rgba)
    cv2.imwrite(str(folder / "b.jpg"), np.zeros((33, 47), np.uint8))
    words = ("segment", folder, "--weights", weights, "--gsd", 0.3, "--out", tmp_path / "p")
    assert say(*words, "--as", "probability").code == 0
    a, b = (cv2.imread(str(tmp_path / "p" / n), cv2.IMREAD_UNCHANGED) for n in ("a.png", "b.png"))
    assert (a[:, :30] == 255).all()
    assert (a[5:-5, 35:-5] == 254).all()
    assert b.shape == (33, 47)
    assert (b == 0).all()
    (folder / "a.tif").write_bytes((folder / "a.png").read_bytes())
    assert "differ only in their ending" in say(*words).line
    (folder / "a.tif").write_text("no picture")
    (folder / "a.png").rename(folder / "z.png")
    killed = ("segment", folder, "--weights", weights, "--out", tmp_path / "k")
    assert "no picture that can be decoded" in say(*killed).line
    (folder / "a.tif").unlink()
    assert say(*killed).code == 0, "the same command goes on"
    assert "other files" in say(*words[:-1], folder).line
    (tmp_path / "none").mkdir()
    assert (
        "no images" in say("segment", tmp_path / "none", "--weights", weights, "--out", tmp_path / "q").line
    )
    assert "--gsd goes with" in say("segment", pictured, *words[2:]).line
    new = tmp_path / "new"
    for gsd, told in ((-1, "--gsd -1: give metres"), (99, "too coarse")):
        assert told in say(*words[:-3], gsd, "--out", new).line
        assert not new.exists()
    # Masks of other images never lie among those that masks.json tells of.
    (folder / "z.png").rename(folder / "y.png")
    before = bytes_of(tmp_path / "k")
    assert "masks of other images (z.png)" in say(*killed).line
    assert bytes_of(tmp_path / "k") == before


def test_masks_that_somebody_corrected_are_kept(weights: Path, tmp_path: Path, say: Say) -> None:
    folder, out = tmp_path / "images", tmp_path / "masks"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(folder / name), town(40, 60))
    words = ("segment", folder, "--weights", weights, "--out", out)
    assert say(*words).code == 0
    made = (out / "a.png").read_bytes()
    assert "kept" not in say(*words).err
    cv2.imwrite(str(out / "a.png"), np.full((40, 60), 255, np.uint8))
    corrected = (out / "a.png").read_bytes()
    said = say(*words)
    assert "a.png: not as brmgeo wrote it, so it is kept as a.edited.png" in said.out + said.err
    assert (out / "a.edited.png").read_bytes() == corrected
    assert (out / "a.png").read_bytes() == made
    assert say(*words).code == 0, "what was set aside is no mask of another image"
    assert sorted(p.name for p in out.glob("[!.]*")) == ["a.edited.png", "a.png", "b.png", SIGN]


# ---------------------------------------------------------------- rasters


def write_raster(path: Path, image: np.ndarray, gsd: float = 0.5, **changes: object) -> Path:
    bands = np.moveaxis(image, -1, 0)
    profile = {
        "driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2],
        "dtype": bands.dtype, "crs": CRS, "transform": Affine(gsd, 0, 195_000, 0, -gsd, 446_000),
    }  # fmt: skip
    with rasterio.open(path, "w", **{**profile, **changes}) as dst:
        dst.write(bands)
    return path


def town(rows: int, cols: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    image = np.full((rows, cols, 3), 60, np.uint8)
    for _ in range(rows * cols // 900):
        r, c = rng.integers(0, rows - 12), rng.integers(0, cols - 20)
        image[r : r + rng.integers(6, 12), c : c + rng.integers(8, 20)] = 200
    return image


def test_a_raster_in_windows_is_as_the_whole(
    weights: Path,
    tmp_path: Path,
    say: Say,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = town(700, 1300)
    raster = write_raster(tmp_path / "in.tif", image)
    whole = Segmenter.load(weights).probability(image)
    monkeypatch.setattr(rasters, "WINDOW_PX", 256)
    monkeypatch.setattr(rasters, "OVERLAP_PX", 64)
    words = ("segment", raster, "--weights", weights, "--out")
    said = say(*words, tmp_path / "p.tif", "--as", "probability")
    assert said.code == 0, said.err
    assert "1300 x 700 px of 0.5 m" in said.out
    with rasterio.open(tmp_path / "p.tif") as src:
        assert (src.transform, src.crs, src.shape) == (
            Affine(0.5, 0, 195_000, 0, -0.5, 446_000),
            CRS,
            (700, 1300),
        )
        assert src.scales == (1e-4,)
        assert src.descriptions == ("probability of building",)
        assert src.tags()["WEIGHTS_SHA256"] == "ab" * 32
        got = src.read(1) * 1e-4
    # At the picture's own border the network sees its padding, which depends on the window's size.
    apart = np.abs(got - whole)[3:-3, 3:-3]
    assert apart.max() < 0.05
    assert (apart > 6e-5).mean() < 0.02, "windows differ from the whole only where they meet"
    assert say(*words, tmp_path / "m.tif").code == 0
    with rasterio.open(tmp_path / "m.tif") as src:
        mask = src.read(1)
    assert ((mask > 0) == (got > 0.5)).mean() > 0.9999
    assert (mask[5:-5, 5:-5] == (image[5:-5, 5:-5, 0] > 100)).mean() > 0.9
    # By two looks, in the same windows, it is what the network says of a picture.
    monkeypatch.setattr(predict, "WINDOW_PX", 256)
    monkeypatch.setattr(predict, "OVERLAP_PX", 64)
    said = say(*words, tmp_path / "two.tif", "--as", "probability", "--looks", 2)
    assert "network bright abababababab, two looks" in said.out
    with rasterio.open(tmp_path / "two.tif") as src:
        assert src.tags()["LOOKS"] == "2"
        by_two = src.read(1) * 1e-4
    assert np.abs(by_two - Segmenter.load(weights, looks=2).probability(image)).max() < 1e-4
    assert np.abs(by_two - got).max() > 0.01


def test_unknown_ground_stays_unknown(weights: Path, tmp_path: Path, say: Say) -> None:
    image = town(120, 150)
    alpha = np.full((120, 150, 1), 255, np.uint8)
    alpha[:40] = 0
    write_raster(
        tmp_path / "rgba.tif", np.concatenate([image, alpha], axis=2), photometric="RGB", alpha="yes"
    )
    image[:40] = 0
    write_raster(tmp_path / "nodata.tif", image, nodata=0)
    for name in ("rgba", "nodata"):
        out = tmp_path / f"{name}-mask.tif"
        assert say("segment", tmp_path / f"{name}.tif", "--weights", weights, "--out", out).code == 0
        with rasterio.open(out) as src:
            mask = src.read(1)
        assert ((mask == 255) == (np.arange(120) < 40)[:, None]).all(), name


@pytest.mark.parametrize(("gsd", "size"), [(0.02, (120, 160)), (2.0, (600, 800)), (0.9, (300, 400))])
def test_other_scales_are_answered_at_one_the_network_knows(
    weights: Path,
    tmp_path: Path,
    say: Say,
    gsd: float,
    size: tuple[int, int],
) -> None:
    raster = write_raster(tmp_path / "in.tif", town(300, 400), gsd)
    said = say("segment", raster, "--weights", weights, "--out", tmp_path / "m.tif")
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "m.tif") as src, rasterio.open(raster) as own:
        assert src.shape == pytest.approx(size, abs=2)  # the projection's metres are not quite the ground's
        assert src.bounds == pytest.approx(own.bounds)


def test_degrees_and_turned_rasters(weights: Path, tmp_path: Path, say: Say) -> None:
    step = 3e-6
    lonlat = Affine(step, 0, 127.0, 0, -step, 37.0)
    write_raster(tmp_path / "deg.tif", town(300, 300), crs="EPSG:4326", transform=lonlat)
    assert say("segment", tmp_path / "deg.tif", "--weights", weights, "--out", tmp_path / "m.tif").code == 0
    with rasterio.open(tmp_path / "m.tif") as src:
        rows, cols = src.shape
        assert cols / rows == pytest.approx(np.cos(np.radians(37)), abs=0.01)
    turned = Affine.translation(195_000, 446_000) @ Affine.rotation(30) @ Affine.scale(0.5, -0.5)
    write_raster(tmp_path / "turned.tif", town(100, 100), transform=turned)
    said = say("segment", tmp_path / "turned.tif", "--weights", weights, "--out", tmp_path / "t.tif")
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "t.tif") as src:
        assert src.transform.almost_equals(turned, 1e-9)


def test_grey_palette_and_other_bands(weights: Path, tmp_path: Path, say: Say) -> None:
    image = town(100, 120)
    write_raster(tmp_path / "rgb.tif", image)
    write_raster(tmp_path / "grey.tif", image[:, :, :1])
    write_raster(
        tmp_path / "five.tif", np.concatenate([image[:, :, :1] * 0, image, image * 0], axis=2)[:, :, :5]
    )
    write_raster(tmp_path / "levels.tif", image.astype(np.uint16) * 40 + 300)
    with rasterio.open(
        tmp_path / "palette.tif", "w", driver="GTiff", count=1, height=100, width=120, dtype="uint8", crs=CRS,
        transform=Affine(0.5, 0, 195_000, 0, -0.5, 446_000),
    ) as dst:  # fmt: skip
        dst.write((image[:, :, 0] > 100).astype(np.uint8), 1)
        dst.write_colormap(1, {0: (60, 60, 60, 255), 1: (200, 200, 200, 255)})
    with rasterio.open(tmp_path / "palette.tif") as src:
        assert src.colorinterp == (ColorInterp.palette,)
    answers = {}
    for name, words in {
        "rgb": (), "grey": (), "palette": (), "five": ("--bands", "2,3,4"), "levels": ("--levels", "300,10500"),
    }.items():  # fmt: skip
        out = tmp_path / f"{name}-p.tif"
        said = say("segment", tmp_path / f"{name}.tif", "--weights", weights, "--out", out, *words)
        assert said.code == 0, said.err
        with rasterio.open(out) as src:
            answers[name] = src.read(1)
    for name, answer in answers.items():
        assert (answer == answers["rgb"]).all(), name


def test_rasters_that_cannot_be_are_refused_in_one_line(
    weights: Path,
    tmp_path: Path,
    say: Say,
) -> None:
    image = town(64, 64)
    whole = write_raster(tmp_path / "whole.tif", image)
    write_raster(tmp_path / "no-crs.tif", image, crs=None)
    write_raster(tmp_path / "coarse.tif", image, gsd=30.0)
    write_raster(tmp_path / "deep.tif", image.astype(np.uint16))
    write_raster(tmp_path / "tiny.tif", image[:8])
    write_raster(tmp_path / "two.tif", image[:, :, :2])
    cut = tmp_path / "cut.tif"
    cut.write_bytes(whole.read_bytes()[:5000])
    # Blocks beyond the end of the file: it opens, and fails where it is read.
    large = write_raster(
        tmp_path / "large.tif", np.tile(image, (4, 4, 1)), tiled=True, blockxsize=64, blockysize=64
    )
    data = large.read_bytes()
    large.write_bytes(data[: len(data) * 6 // 10])
    cv2.imwrite(str(tmp_path / "frame.jpg"), image)
    (tmp_path / "text.tif").write_text("no raster")
    out = tmp_path / "m.tif"
    cases = {
        "none.tif": ((), "no such folder or raster"),
        "no-crs.tif": ((), "no coordinate reference system"),
        "coarse.tif": ((), "too coarse"),
        "deep.tif": ((), "are black and white (--levels"),
        "tiny.tif": ((), "at least 16 px"),
        "two.tif": ((), "such as 1 (--bands"),
        "cut.tif": ((), "cut.tif"),
        "large.tif": ((), "large.tif: damaged or cut short"),
        "frame.jpg": ((), "such as a frame: give the folder that holds it"),
        "text.tif": ((), "not a readable image or raster"),
        "whole.tif": (("--bands", "1,2,9"), "has bands 1 to 3 (--bands"),
    }
    for name, (words, said) in cases.items():
        line = say("segment", tmp_path / name, "--weights", weights, "--out", out, *words).line
        assert said in line, name
        assert not out.exists()
    assert "is the raster itself" in say("segment", whole, "--weights", weights, "--out", whole).line
    assert "ends in .tif" in say("segment", whole, "--weights", weights, "--out", tmp_path / "m.png").line
    assert (
        "then a higher white"
        in say("segment", whole, "--weights", weights, "--out", out, "--levels", "9,3").line
    )
    assert not [p for p in os.listdir(tmp_path) if p.startswith(".")]
