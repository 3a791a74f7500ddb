"""The exported graph answers as torch does, at any size, and carries what Deepness and brmgeo read."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from small_networks import bright_onnx, small_card, small_tensors

from brmgeo.errors import InputError, MissingExtraError
from brmgeo.segment.onnx_export import deepness_metadata, export_onnx, finished
from brmgeo.segment.predict import Segmenter
from brmgeo.segment.weights import load_network, load_weights, save_weights

torch = pytest.importorskip("torch")
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights with statistics of batch normalisation that are not those of a new network."""
    path = tmp_path_factory.mktemp("w") / "w.safetensors"
    rng = np.random.default_rng(3)
    tensors = small_tensors()
    for name in tensors:
        low = {"running_mean": -0.3, "running_var": 0.5}.get(name.rsplit(".", 1)[-1])
        if low is not None:
            tensors[name] = rng.uniform(low, low + 0.8, tensors[name].shape).astype(np.float32)
    save_weights(path, tensors, small_card())
    export_onnx(path, path.with_suffix(".onnx"))
    return path


@pytest.mark.parametrize("shape", [(1, 32, 32), (3, 64, 96), (2, 128, 32)])
def test_onnx_and_torch_agree(weights: Path, shape: tuple[int, int, int]) -> None:
    import onnxruntime as ort

    network, card = load_network(weights)
    x = torch.randn(shape[0], 3, *shape[1:], generator=torch.Generator().manual_seed(5))
    with torch.no_grad():
        wanted = torch.sigmoid(network(x) / card.temperature).numpy()
    session = ort.InferenceSession(weights.with_suffix(".onnx").read_bytes())
    got = session.run(["probability"], {"picture": x.numpy()})[0]
    assert got.shape == wanted.shape
    assert np.ptp(wanted) > 0.05, "a network that gives one number everywhere shows nothing"
    np.testing.assert_allclose(got, wanted, atol=1e-4)


@pytest.mark.slow
def test_a_pretrained_kind_is_exported_too(tmp_path: Path) -> None:
    from brmgeo.segment.unet import UNet, UNetSettings

    torch.manual_seed(2)
    network = UNet(UNetSettings(widths=(8, 8, 8, 8, 8), encoder="efficientnet-lite0"))
    network.train()(torch.randn(4, 3, 64, 64))  # statistics that are not those of a new network
    path = tmp_path / "w.safetensors"
    tensors = {k: v.numpy() for k, v in network.state_dict().items()}
    save_weights(path, tensors, small_card(settings=network.settings.plain()))
    export_onnx(path, path.with_suffix(".onnx"))
    by_onnx, by_torch = (Segmenter.load(path, backend) for backend in ("onnx", "torch"))
    for shape in ((16, 16), (32, 40), (75, 100)):
        image = np.random.default_rng(1).integers(0, 256, (*shape, 3), dtype=np.uint8)
        np.testing.assert_allclose(by_onnx.probability(image), by_torch.probability(image), atol=1e-4)


def test_both_backends_give_the_same_pictures(weights: Path) -> None:
    image = np.random.default_rng(1).integers(0, 256, (75, 100, 3), dtype=np.uint8)
    by_onnx, by_torch = (Segmenter.load(weights, backend) for backend in ("onnx", "torch"))
    assert by_onnx.card == by_torch.card
    for gsd in (None, 0.05, 0.3):
        np.testing.assert_allclose(
            by_onnx.probability(image, gsd), by_torch.probability(image, gsd), atol=1e-4
        )


def test_nothing_of_the_machine_it_was_made_on_is_in_the_file(weights: Path) -> None:
    data = weights.with_suffix(".onnx").read_bytes()
    for words in (b"site-packages", b".py", str(Path.cwd()).encode(), b"stack_trace"):
        assert words not in data


def test_deepness_opens_the_tile_graph(weights: Path, tmp_path: Path) -> None:
    """Every reading of deepness/processing/models/{model_base,segmentor}.py and of its dock widget, done here."""
    import onnxruntime as ort

    path, card = tmp_path / "tile.onnx", load_weights(weights)[1]
    path.write_bytes(finished(onnx.load(weights.with_suffix(".onnx")), card, 64))
    session = ort.InferenceSession(path.read_bytes())
    assert len(session.get_inputs()) == len(session.get_outputs()) == 1
    batch, channels, height, width = session.get_inputs()[0].shape
    assert isinstance(batch, str), "any number of tiles at once"
    assert (channels, height, width) == (3, 64, 64)
    assert session.get_outputs()[0].shape[1:] == [1, 64, 64]
    meta = {k: v for k, v in session.get_modelmeta().custom_metadata_map.items() if k not in ("seal",)}
    assert str(json.loads(meta["model_type"])).capitalize() == "Segmentor"
    assert json.loads(meta["class_names"]) == {"0": "building"}
    assert float(json.loads(meta["resolution"])) == 25.0
    assert int(json.loads(meta["tile_size"])) == int(json.loads(meta["tiles_size"])) == 64
    assert 0 < int(json.loads(meta["tiles_overlap"])) < 50
    assert float(json.loads(meta["seg_thresh"])) == card.threshold
    assert int(json.loads(meta["seg_small_segment"])) == 0
    mean, std = (np.float32(json.loads(meta[f"standardization_{k}"])) for k in ("mean", "std"))
    # Its own preprocessing, on a tile of (n, h, w, c) levels, gives our probability.
    tile = np.random.default_rng(2).integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
    x = np.transpose((np.float32(tile * 1.0 / 255.0) - mean) / std, (0, 3, 1, 2))
    got = session.run(None, {session.get_inputs()[0].name: x})[0]
    np.testing.assert_allclose(got[0, 0], Segmenter.load(weights).probability(tile[0]), atol=1e-5)
    with pytest.raises(InputError, match="made for Deepness"):
        Segmenter.load(path)


def test_a_tile_that_the_network_cannot_take_is_refused(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="65 px: this network takes multiples of 2 px"):
        export_onnx(weights, tmp_path / "x.onnx", 65)
    assert not list(tmp_path.iterdir())


def test_without_its_packages_the_extra_that_brings_them_is_named(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(MissingExtraError, match=r"ONNX needs onnxscript, .*'brmgeo\[train\]'"):
        export_onnx(weights, tmp_path / "x.onnx")
    assert not list(tmp_path.iterdir())


def test_the_middle_of_the_trained_scales_is_the_resolution_without_a_working_gsd() -> None:
    card = small_card(gsd_work_m=None, gsd_min_m=0.1, gsd_max_m=0.4)
    assert json.loads(deepness_metadata(card, 512)["resolution"]) == 20.0


def test_the_seal_is_of_every_byte(tmp_path: Path) -> None:
    path = bright_onnx(tmp_path / "w.onnx", small_card())
    data = path.read_bytes()
    Segmenter.load(path)
    for at in range(0, len(data), max(1, len(data) // 60)):
        path.write_bytes(data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :])
        with pytest.raises(InputError):
            Segmenter.load(path)
