"""Prediction against a network whose answer is plain to work out, and every kind of picture that should be refused."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from small_networks import bright_onnx, small_card, small_tensors

from brmgeo.errors import InputError, MissingExtraError, MissingInputError, SettingsError
from brmgeo.segment import predict
from brmgeo.segment.predict import Segmenter, picture_of, read_image, spans, thresholded
from brmgeo.segment.weights import save_weights


@pytest.fixture(scope="module")
def segmenter(tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    return Segmenter.load(
        bright_onnx(tmp_path_factory.mktemp("net") / "w.onnx", small_card(sha256="ab" * 32))
    )


@pytest.fixture(scope="module")
def twice(segmenter: Segmenter) -> Segmenter:
    """The same network, which looks at a picture twice."""
    return dataclasses.replace(segmenter, looks=2)


def scene(rows: int, cols: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (rows // 8 + 2, cols // 8 + 2, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (cols, rows), interpolation=cv2.INTER_CUBIC))


def expected(image: np.ndarray, reach: int = 2) -> np.ndarray:
    """The bright network's answer, in float64, over the picture continued by its mirror image."""
    card = small_card()
    x = ((image / 255.0 - np.array(card.mean)) / np.array(card.std)).sum(axis=2)
    x = np.pad(x, 20, mode="reflect")
    side = 2 * reach + 1
    mean = cv2.boxFilter(x, -1, (side, side), borderType=cv2.BORDER_REFLECT_101)
    return 1.0 / (1.0 + np.exp(-mean[20:-20, 20:-20]))


# ---------------------------------------------------------------- what it gives


@pytest.mark.parametrize("shape", [(64, 96), (100, 75), (33, 17), (16, 16), (480, 640)])
def test_any_size_is_answered_at_its_own_pixels(segmenter: Segmenter, shape: tuple[int, int]) -> None:
    image = scene(*shape)
    got = segmenter.probability(image)
    assert got.shape == shape
    assert got.dtype == np.float32
    inside = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(got[inside], expected(image)[inside], atol=2e-6)


@pytest.mark.parametrize("shape", [(64, 96), (101, 75), (20, 20), (480, 640)])
def test_two_looks_are_the_mean_of_the_picture_and_its_coarser_mirror_image(
    segmenter: Segmenter, twice: Segmenter, shape: tuple[int, int]
) -> None:
    image = scene(*shape, 3)
    size = (round(shape[1] / 1.25), round(shape[0] / 1.25))
    mirrored = np.ascontiguousarray(image[:, ::-1])
    far = segmenter.probability(np.asarray(cv2.resize(mirrored, size, interpolation=cv2.INTER_AREA)))
    far = np.asarray(cv2.resize(far, shape[::-1], interpolation=cv2.INTER_LINEAR))[:, ::-1]
    got = twice.probability(image)
    np.testing.assert_allclose(got, (segmenter.probability(image) + far) / 2, atol=2e-6)
    # Mirrored back: the second look adds what lies there, not what lies opposite.
    assert np.corrcoef(got.ravel(), expected(image).ravel())[0, 1] > 0.95


def test_a_picture_is_looked_at_as_its_card_says_or_as_asked(segmenter: Segmenter, tmp_path: Path) -> None:
    assert segmenter.looks == 1
    card = small_card(metrics={"calibration": {"looks": 2}}, sha256="cd" * 32)
    path = bright_onnx(tmp_path / "w.onnx", card)
    assert Segmenter.load(path).looks == 2
    assert Segmenter.load(path).name == "w cdcdcdcdcdcd"
    assert Segmenter.load(path, looks=1).looks == 1
    assert Segmenter.load(path, looks=1).name == "w cdcdcdcdcdcd, one look"
    for looks in (-1, 0, 3):
        with pytest.raises(SettingsError, match="give 1 or 2"):
            Segmenter.load(path, looks=looks)
    for metrics in (
        "",
        [],
        {"calibration": None},
        {"calibration": {"looks": "2"}},
        {"calibration": {"looks": 7}},
    ):
        assert small_card(metrics=metrics).looks == 1


@pytest.mark.parametrize("gsd", [None, 0.004])
def test_pictures_of_a_few_pixels_are_looked_at_twice(twice: Segmenter, gsd: float | None) -> None:
    picture = np.dstack([scene(16, 40), np.full((16, 40), 255, np.uint8)])
    picture[:, 30:, 3] = 0
    got = twice.probability(picture, gsd)
    assert np.isfinite(got[:, :30]).all()
    assert np.isnan(got[:, 30:]).all()


def test_a_huge_picture_in_windows_is_as_the_whole(
    segmenter: Segmenter, twice: Segmenter, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = scene(700, 333, 4)
    whole, by_two = segmenter.probability(image), twice.probability(image)
    monkeypatch.setattr(predict, "WINDOW_PX", 128)
    monkeypatch.setattr(predict, "OVERLAP_PX", 32)
    parts = segmenter.probability(image)
    # A window's coarser pixels lie elsewhere than those of the whole: up to half a pixel, at edges of random noise.
    assert np.abs(twice.probability(image) - by_two).mean() < 0.003
    # Where two windows meet, each has seen only its mirror beyond its own border, and there it weighs little.
    assert np.abs(parts - whole)[2:-2, 2:-2].max() < 0.03
    assert np.median(np.abs(parts - whole)) < 1e-6


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3000), st.integers(64, 400), st.floats(0, 0.5))
def test_weights_of_overlapping_spans_add_up_to_one(length: int, size: int, share: float) -> None:
    overlap = int(share * size)
    total = np.zeros(length)
    cut = spans(length, size, overlap)
    for before, after in pairwise(cut):
        assert before.stop - after.start >= overlap
        assert before.start < after.start
    for span in cut:
        assert 0 <= span.start < span.stop <= length
        assert span.stop - span.start <= size
        assert (span.weight > 0).all()
        total[span.start : span.stop] += span.weight
    np.testing.assert_allclose(total, 1.0, atol=1e-6)


def test_pictures_together_are_as_each_alone(segmenter: Segmenter) -> None:
    images = [scene(64, 80, 1), scene(96, 64, 2), scene(64, 80, 3), scene(128, 160, 4)]
    gsds = [0.2, 0.2, None, 0.05]
    together = segmenter.probabilities(images, gsds)
    for image, gsd, answer in zip(images, gsds, together, strict=True):
        np.testing.assert_allclose(segmenter.probability(image, gsd), answer, atol=1e-6)


@pytest.mark.parametrize(
    ("gsd", "size"),
    [
        (None, (120, 160)),
        (0.1, (120, 160)),
        (0.5, (120, 160)),
        (0.05, (24, 32)),
        (1.0, (480, 640)),
        ((0.2, 0.2), (120, 160)),
        ((0.3, 0.2), (144, 128)),
        ((0.05, 0.1), (24, 64)),
    ],
)
def test_only_a_gsd_out_of_training_is_resampled(
    segmenter: Segmenter, gsd: object, size: tuple[int, int]
) -> None:
    assert segmenter.working_size((120, 160), gsd) == size  # type: ignore[arg-type]


def test_resampled_pictures_give_the_same_ground(segmenter: Segmenter) -> None:
    image = scene(128, 160, 7)
    fine = np.asarray(cv2.resize(image, (640, 512), interpolation=cv2.INTER_CUBIC))
    native = segmenter.probability(image, 0.25)
    resampled = segmenter.probability(fine, 0.0625)
    assert resampled.shape == (512, 640)
    back = cv2.resize(resampled, (160, 128), interpolation=cv2.INTER_AREA)
    assert np.abs(back - native)[4:-4, 4:-4].max() < 0.05


def test_without_a_working_gsd_the_nearer_end_of_training_is_taken(tmp_path: Path) -> None:
    card = small_card(gsd_work_m=None, sha256="cd" * 32)
    net = Segmenter.load(bright_onnx(tmp_path / "w.onnx", card))
    assert net.working_size((100, 100), 0.05) == (50, 50)
    assert net.working_size((100, 100), 1.0) == (200, 200)


def test_nonsense_gsds_are_refused(segmenter: Segmenter) -> None:
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(SettingsError, match="above zero"):
            segmenter.probability(scene(32, 32), bad)
    with pytest.raises(InputError, match=r"10 m per pixel is too coarse.*0\.1 to 0\.5 m"):
        segmenter.probability(scene(32, 32), 10.0)


def test_unknown_pixels_stay_unknown_and_do_not_darken_their_neighbours(segmenter: Segmenter) -> None:
    image = np.full((64, 64, 3), 102, np.uint8)
    alpha = np.full((64, 64, 1), 255, np.uint8)
    alpha[:, :20] = 0
    image[:, :20] = 0
    got = segmenter.probability(np.concatenate([image, alpha], axis=2))
    assert np.isnan(got[:, :20]).all()
    plain = segmenter.probability(np.full((64, 64, 3), 102, np.uint8))
    np.testing.assert_allclose(got[3:-3, 20:60], plain[3:-3, 20:60], atol=0.02)
    assert (segmenter.mask(np.concatenate([image, alpha], axis=2))[:, :20] == 0).all()
    assert np.isnan(segmenter.probability(np.zeros((32, 32, 4), np.uint8))).all()
    known = np.ones((64, 64), bool)
    known[5] = False
    assert (np.isnan(segmenter.probability(image, known=known)) == ~known).all()


def test_grey_is_repeated_in_all_channels(segmenter: Segmenter) -> None:
    grey = scene(48, 48)[:, :, 0]
    three = segmenter.probability(np.repeat(grey[:, :, None], 3, axis=2))
    assert (segmenter.probability(grey) == three).all()
    assert (segmenter.probability(grey[:, :, None]) == three).all()


def test_mask_is_above_the_threshold() -> None:
    p = np.array([[0.0, 0.44, 0.46, np.nan, 1.0]], np.float32)
    assert thresholded(p, 0.45).tolist() == [[0, 0, 255, 0, 255]]


def test_onnx_runtime_and_its_card_need_no_torch(tmp_path: Path) -> None:
    path = bright_onnx(tmp_path / "w.onnx", small_card(sha256="ab" * 32))
    code = (
        "import sys, numpy as np; from pathlib import Path; from brmgeo.segment.predict import Segmenter\n"
        f"s = Segmenter.load(Path({str(path)!r})); s.probability(np.zeros((32, 32, 3), np.uint8), 0.3)\n"
        "print(s.backend, s.name, sorted({'torch', 'onnx', 'onnxscript'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert done.stdout.split("\n")[0] == "onnx w abababababab []", done.stderr


# ---------------------------------------------------------------- which file, which backend


def test_torch_runs_the_same_card(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from brmgeo.segment.weights import load_network

    path = tmp_path / "w.safetensors"
    save_weights(path, small_tensors(), small_card())
    net = Segmenter.load(path)
    assert net.backend == "torch"
    image = scene(64, 96)
    network, card = load_network(path)
    x = (torch.tensor(image / 255.0) - torch.tensor(card.mean)) / torch.tensor(card.std)
    with torch.no_grad():
        logit = network(x.permute(2, 0, 1)[None].float())[0, 0]
    np.testing.assert_allclose(net.probability(image), torch.sigmoid(logit / 1.3).numpy(), atol=1e-5)


def test_without_torch_the_extra_that_brings_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(path, small_tensors(), small_card())
    monkeypatch.setitem(sys.modules, "torch", None)
    told = r"w\.safetensors with torch needs torch, which is not installed: pip install 'brmgeo\[train\]'"
    with pytest.raises(MissingExtraError, match=told):
        Segmenter.load(path)


def test_wrong_files_are_refused_in_one_line(tmp_path: Path) -> None:
    good = bright_onnx(tmp_path / "w.onnx", small_card(sha256="ab" * 32))
    data = good.read_bytes()
    cases: list[tuple[str, bytes | None, str]] = [
        ("none.onnx", None, "no such weights"),
        ("w.pt", b"PK", "never opened"),
        ("picture.onnx", b"\x89PNG" + bytes(100), "not an ONNX file of brmgeo"),
        ("cut.onnx", data[:-7], "SHA-256 differs"),
        ("flipped.onnx", data.replace(b"Sigmoid", b"Softmax"), "SHA-256 differs"),
        ("threshold.onnx", data.replace(b"0.45", b"0.55"), "SHA-256 differs"),
        ("kernel.onnx", data[:60] + bytes([data[60] ^ 1]) + data[61:], "SHA-256 differs"),
    ]
    for name, content, words in cases:
        path = tmp_path / name
        if content is not None:
            assert content != data, name
            path.write_bytes(content)
        with pytest.raises(InputError) as error:
            Segmenter.load(path)
        assert words in str(error.value), name
        assert name in str(error.value)
        assert "\n" not in str(error.value)
    with pytest.raises(SettingsError, match="tensorrt"):
        Segmenter.load(good, "tensorrt")
    tile = bright_onnx(tmp_path / "tile.onnx", small_card(), tile_px=64)
    with pytest.raises(InputError, match="64 px only, made for Deepness"):
        Segmenter.load(tile)


def test_a_graph_of_other_weights_beside_a_file_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    path = tmp_path / "w.safetensors"
    card = save_weights(path, small_tensors(), small_card())
    with pytest.raises(MissingInputError, match="as ONNX where torch"):
        Segmenter.load(path, "onnx")
    bright_onnx(tmp_path / "w.onnx", card)
    assert Segmenter.load(path).backend == "onnx"
    assert Segmenter.load(path, "torch").backend == "torch"
    bright_onnx(tmp_path / "w.onnx", small_card(sha256="ab" * 32))
    with pytest.raises(InputError, match="of other weights"):
        Segmenter.load(path)


# ---------------------------------------------------------------- pictures


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((64, 64, 3), np.uint16), "uint16 values"),
        (np.zeros((64, 64), np.float32), "float32 values"),
        (np.zeros((64, 64), bool), "bool values"),
        (np.zeros((64, 64, 5), np.uint8), "channels"),
        (np.zeros((2, 64, 64, 3), np.uint8), "channels"),
        (np.zeros((15, 64, 3), np.uint8), "64 x 15 px is too small"),
        (np.zeros((0, 0, 3), np.uint8), "too small"),
    ],
)
def test_arrays_that_are_no_8_bit_picture_are_refused(image: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        picture_of(image)
    assert "\n" not in str(error.value)


def jpeg(path: Path) -> Path:
    Image.fromarray(scene(64, 96)).save(path, quality=92)
    return path


def cut(path: Path) -> None:
    jpeg(path)
    path.write_bytes(path.read_bytes()[:1500])


def headless(path: Path) -> None:
    jpeg(path)
    path.write_bytes(b"\xff\xd8\xff" + bytes(2000))


def flipped(path: Path) -> None:
    Image.fromarray(scene(64, 96)).save(path)
    data = bytearray(path.read_bytes())
    data[data.index(b"IDAT") + 40] ^= 255
    path.write_bytes(bytes(data))


BAD_FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "missing": ("a.jpg", lambda p: None, "no such picture"),
    "empty": ("a.jpg", lambda p: p.write_bytes(b""), "empty"),
    "text": ("a.jpg", lambda p: p.write_text("no picture at all"), "no picture that can be decoded"),
    "JPEG cut short": ("a.jpg", cut, "cut short"),
    "JPEG without a head": ("a.jpg", headless, "damaged"),
    "PNG with a flipped byte": ("a.png", flipped, "cut short"),
    "16 bits": ("a.png", lambda p: cv2.imwrite(str(p), np.full((64, 64, 3), 9000, np.uint16)), "levels are black"),
    "16 bits of grey": ("a.png", lambda p: cv2.imwrite(str(p), np.full((64, 64), 9000, np.uint16)), "levels are black"),
    "tiny": ("a.png", lambda p: cv2.imwrite(str(p), np.zeros((8, 300, 3), np.uint8)), "300 x 8 px"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_image_files_are_refused_in_one_line(tmp_path: Path, case: str) -> None:
    name, make, words = BAD_FILES[case]
    make(tmp_path / name)
    with pytest.raises(InputError) as error:
        read_image(tmp_path / name)
    assert words in str(error.value)
    assert str(tmp_path / name) in str(error.value)
    assert "\n" not in str(error.value)


def test_image_files_of_every_kind_are_read(tmp_path: Path) -> None:
    rgb = scene(40, 60)
    for name, image in (
        ("rgb.png", Image.fromarray(rgb)),
        ("rgb.tif", Image.fromarray(rgb)),
        ("palette.png", Image.fromarray(rgb).quantize(200)),
    ):
        image.save(tmp_path / name)
        got = read_image(tmp_path / name)
        wanted = np.asarray(image.convert("RGB"))
        assert got.known is None
        assert (got.rgb == wanted).all(), name
    Image.fromarray(rgb[:, :, 0]).save(tmp_path / "grey.png")
    assert (read_image(tmp_path / "grey.png").rgb == rgb[:, :, :1]).all()
    alpha = np.zeros((40, 60), np.uint8)
    alpha[10:, :] = 7
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "rgba.png")
    got = read_image(tmp_path / "rgba.png")
    assert (got.rgb == rgb).all()
    assert got.known is not None
    assert (got.known == (alpha > 0)).all()
    turned = Image.fromarray(rgb)
    exif = turned.getexif()
    exif[0x0112] = 6
    turned.save(tmp_path / "turned.jpg", exif=exif, quality=95)
    assert read_image(tmp_path / "turned.jpg").rgb.shape == (40, 60, 3)


def test_16_bits_with_stated_levels(tmp_path: Path) -> None:
    ramp = np.linspace(0, 20000, 64).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), np.repeat(np.tile(ramp, (32, 1))[:, :, None], 3, axis=2))
    got = read_image(tmp_path / "a.png", levels=(5000, 15000)).rgb[0, :, 0].astype(float)
    wanted = np.clip((ramp.astype(float) - 5000) / 10000 * 255, 0, 255)
    assert np.abs(got - wanted).max() <= 0.51
