"""Weights on disk: what is written comes back, and whatever was changed, cut, foreign or newer is refused in one line."""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from small_networks import small_card, small_tensors

from brmgeo.errors import InputError, MissingInputError
from brmgeo.segment.weights import build_network, load_network, load_weights, save_weights

torch = pytest.importorskip("torch")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_weights(tmp_path / "w.safetensors", small_tensors(), small_card())
    return tmp_path / "w.safetensors"


def one_line(error: pytest.ExceptionInfo[InputError], path: Path) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert str(path) in text
    return text


def test_what_is_written_comes_back(weights: Path) -> None:
    tensors, card = load_weights(weights)
    expected = small_tensors()
    assert tensors.keys() == expected.keys()
    for name, value in expected.items():
        assert tensors[name].dtype == value.dtype
        assert tensors[name].shape == value.shape
        assert (tensors[name] == value).all()
    assert card == small_card(sha256=card.sha256)
    assert len(card.sha256) == 64
    text = weights.with_suffix(".md").read_text()
    for words in (card.sha256, "0.1 to 0.5 m", "OpenAerialMap, CC BY 4.0", "Apache-2.0", "IoU"):
        assert words in text
    assert sorted(p.name for p in weights.parent.iterdir()) == ["w.md", "w.safetensors"]


def test_the_readable_card_gives_every_source_a_line_of_its_own() -> None:
    sources = [{"name": "Kampala", "licence": "CC BY 4.0"}, {"name": "towns", "seeds": (1, 2)}]
    text = small_card(data={"steps": 7, "sources": sources}).to_markdown("w")
    lines = text.splitlines()
    at = lines.index("- sources:")
    assert lines[at + 1 : at + 3] == ["  - name Kampala, licence CC BY 4.0", "  - name towns, seeds 1, 2"]
    assert "- steps: 7" in lines


def test_the_readable_card_shows_earlier_parts_below_the_later_one() -> None:
    earlier = {"steps": 7, "sources": [{"name": "towns", "seeds": [1, 2]}]}
    sources = [{"name": "weights 0123", "data": earlier, "licence": "CC BY 4.0"}, {"name": "Kampala"}]
    lines = small_card(data={"sources": sources}).to_markdown("w").splitlines()
    at = lines.index("- sources:")
    assert lines[at + 1 : at + 7] == [
        "  - name weights 0123, licence CC BY 4.0",
        "    - data:",
        "      - steps: 7",
        "      - sources:",
        "        - name towns, seeds 1, 2",
        "  - name Kampala",
    ]


def test_same_weights_same_bytes(weights: Path, tmp_path: Path) -> None:
    tensors, card = load_weights(weights)
    again = tmp_path / "again.safetensors"
    save_weights(again, dict(reversed(tensors.items())), card)
    assert again.read_bytes() == weights.read_bytes()


def test_the_network_of_a_file_answers_as_the_one_that_was_saved(weights: Path) -> None:
    from brmgeo.segment.unet import UNet, UNetSettings

    torch.manual_seed(1)
    saved = UNet(UNetSettings(widths=(8, 16))).eval()
    loaded, _ = load_network(weights)
    x = torch.randn(1, 3, 32, 48)
    with torch.no_grad():
        assert torch.equal(saved(x), loaded(x))


def not_a_number(path: Path) -> None:
    tensors, card = load_weights(path)
    spoilt = {name: np.array(value) for name, value in tensors.items()}
    spoilt["head.bias"][0] = np.nan
    save_weights(path, spoilt, card)


def flip(at: Callable[[bytes], int]) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[at(bytes(data))] ^= 1
        path.write_bytes(bytes(data))

    return change


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def pickled(path: Path) -> None:
    # A pickle that would write a file when it were loaded.
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (path.with_name("executed"),))

    path.write_bytes(pickle.dumps(Evil()))


def torch_file(path: Path) -> None:
    torch.save({"a": torch.zeros(3)}, path)


def foreign(path: Path) -> None:
    save_file(small_tensors(), path, metadata={"format": "pt"})


def card_of(**changes: object) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        data = path.read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + length])
        card = json.loads(header["__metadata__"]["brmgeo_weights"]) | changes
        header["__metadata__"]["brmgeo_weights"] = json.dumps({k: v for k, v in card.items() if v != "drop"})
        text = json.dumps(header).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + length :])

    return change


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "a byte of a tensor": (flip(lambda data: len(data) - 5), "SHA-256 differs"),
    "a byte of the threshold": (flip(lambda data: data.index(b"0.45") + 3), "SHA-256 differs"),
    "no numbers": (not_a_number, "tensor head.bias holds values that are no numbers"),
    "another threshold": (card_of(threshold=0.6), "SHA-256 differs"),
    "other settings": (card_of(settings={"widths": [8, 24], "norm": "batch", "in_channels": 3}), "SHA-256"),
    "cut short": (cut, "not a whole safetensors file"),
    "empty": (lambda p: p.write_bytes(b""), "not a whole safetensors file"),
    "a picture": (lambda p: p.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(500)), "not a whole safetensors file"),
    "a pickle": (pickled, "not a whole safetensors file"),
    "a torch file": (torch_file, "not a whole safetensors file"),
    "another program's": (foreign, "no brmgeo model card"),
    "a newer format": (card_of(format=2, extra=1), "format 2, this release reads format 1"),
    "another architecture": (card_of(architecture="SegFormer"), "SegFormer"),
    "a field missing": (card_of(temperature="drop"), "fields missing ['temperature']"),
    "a field too many": (card_of(colour="red"), "unknown ['colour']"),
    "no number": (card_of(threshold="high"), "threshold 'high'"),
    "a threshold of 1": (card_of(threshold=1.0), "threshold 1.0"),
    "two means": (card_of(mean=[0.1, 0.2]), "mean"),
    "a deviation of 0": (card_of(std=[0.1, 0.2, 0]), "std[2]"),
    "GSD the wrong way round": (card_of(gsd_min_m=0.9), "gsd_min_m"),
    "a temperature of infinity": (card_of(temperature=float("inf")), "temperature"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_weights_are_refused_in_one_line(weights: Path, case: str) -> None:
    spoil, words = BAD[case]
    spoil(weights)
    with pytest.raises(InputError) as error:
        load_weights(weights)
    assert words in one_line(error, weights)
    assert not weights.with_name("executed").exists()


def test_no_file_is_missing_input(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"none\.safetensors: there are no weights"):
        load_weights(tmp_path / "none.safetensors")


@pytest.mark.parametrize(
    ("widths", "settings", "words"),
    [
        ((8, 24), {"widths": [8, 16]}, "another architecture"),
        ((8, 16, 24), {"widths": [8, 16]}, "another architecture"),
        ((8, 16), {"widths": [8, 16, 24]}, "another architecture"),
        ((8, 16), {"widths": [7, 16]}, "multiples of 8"),
        ((8, 16), {"widths": [8, 16], "depth": 3}, "depth"),
    ],
)
def test_tensors_that_are_not_the_cards_are_refused(
    tmp_path: Path, widths: tuple[int, ...], settings: dict[str, object], words: str
) -> None:
    path = tmp_path / "w.safetensors"
    full = {"norm": "batch", "in_channels": 3, **settings}
    save_weights(path, small_tensors(widths), small_card(settings=full))
    with pytest.raises(InputError, match=words) as error:
        load_network(path)
    one_line(error, path)


def test_a_tensor_missing_or_of_another_shape_is_named() -> None:
    tensors = small_tensors()
    del tensors["head.bias"]
    with pytest.raises(InputError, match=r"head\.bias is nothing"):
        build_network(tensors, small_card(), "w")
    tensors = small_tensors()
    tensors["head.weight"] = tensors["head.weight"][:, :4]
    with pytest.raises(InputError, match=r"head\.weight is \(1, 4, 1, 1\)"):
        build_network(tensors, small_card(), "w")


def test_only_safetensors_of_plain_numbers_are_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.safetensors only"):
        save_weights(tmp_path / "w.pt", small_tensors(), small_card())
    with pytest.raises(ValueError, match="float64"):
        save_weights(tmp_path / "w.safetensors", {"a": np.zeros(3)}, small_card())
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="temperature"):
        replace(small_card(), temperature=0.0)
