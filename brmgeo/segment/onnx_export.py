"""The network as an ONNX file: what brmgeo itself runs, and what the QGIS plugin Deepness and others can open.

The graph takes normalised RGB (n, 3, h, w) float32, (x / 255 - mean) / std, and gives calibrated probabilities of
"building" (n, 1, h, w) float32: the calibration and the sigmoid are in the graph. The metadata hold Deepness's keys
(https://qgis-plugin-deepness.readthedocs.io; its code reads ``tile_size`` where its pages say ``tiles_size``: both are
written), the model card, and a checksum of the whole file. Deepness cannot open graphs of variable size: give ``tile_px``.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from brmgeo.errors import InputError
from brmgeo.extras import extra
from brmgeo.files import digest_of, write_bytes
from brmgeo.segment.weights import ModelCard, load_network

CARD_KEY = "brmgeo_weights"
_SEAL = b"brmgeo-sha256:"
OPSET = 20
TILE_PX = 512
OVERLAP_PERCENT = 15


def export_onnx(weights: Path, out: Path, tile_px: int | None = None) -> ModelCard:
    """Writes the network of ``weights`` (.safetensors) to ``out`` (.onnx); returns its card. Needs torch, onnx, onnxscript.

    Args:
        tile_px: height and width of the input, fixed, for Deepness; None for any size the network takes.

    Raises MissingExtraError where the packages are not installed, InputError for bad weights or a size that does not fit.
    """
    with extra("train", "writing ONNX"):
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
        import torch

    network, card = load_network(weights)
    multiple = network.settings.multiple_px
    if tile_px is not None and (tile_px < multiple or tile_px % multiple):
        raise InputError(f"a tile of {tile_px} px: this network takes multiples of {multiple} px")

    class Answer(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, picture: torch.Tensor) -> torch.Tensor:
            return torch.sigmoid(self.network(picture) / card.temperature)

    # Two sizes that differ, so that nothing is taken for the same by chance.
    example = torch.zeros(2, 3, 4 * multiple, 6 * multiple)
    free = torch.export.Dim.DYNAMIC
    with _quiet():
        program = torch.onnx.export(
            Answer().eval(),
            (example,),
            dynamo=True,
            opset_version=OPSET,
            input_names=["picture"],
            output_names=["probability"],
            dynamic_shapes={"picture": {0: free, 2: free, 3: free}},
            external_data=False,
            verbose=False,
        )
    assert program is not None
    data = finished(program.model_proto, card, tile_px)
    write_bytes(out, data)
    return card


def finished(model: Any, card: ModelCard, tile_px: int | None = None) -> bytes:
    """The bytes of an ONNX model (a ModelProto, picture in, probability out) with its sizes, metadata, card and seal."""
    _tidy(model, tile_px)
    model.producer_name, model.producer_version = "brmgeo", ""
    for key, value in deepness_metadata(card, tile_px or TILE_PX).items():
        model.metadata_props.add(key=key, value=value)
    model.metadata_props.add(key=CARD_KEY, value=card.to_json())
    model.metadata_props.add(key="seal", value=(_SEAL + b"0" * 64).decode())
    data: bytes = model.SerializeToString(deterministic=True)
    return data.replace(_SEAL + b"0" * 64, _SEAL + _seal_of(data).encode())


def deepness_metadata(card: ModelCard, tile_px: int) -> dict[str, str]:
    """What Deepness reads, each value as JSON: resolution in centimetres per pixel, overlap in percent."""
    # The middle of a range of scales is its geometric one.
    gsd_m = card.gsd_work_m or math.sqrt(card.gsd_min_m * card.gsd_max_m)
    values: Mapping[str, Any] = {
        "model_type": "Segmentor",
        "class_names": {"0": "building"},
        "resolution": round(100.0 * gsd_m, 2),
        "tile_size": tile_px,
        "tiles_size": tile_px,
        "tiles_overlap": OVERLAP_PERCENT,
        "seg_thresh": card.threshold,
        "seg_small_segment": 0,
        "standardization_mean": list(card.mean),
        "standardization_std": list(card.std),
    }
    return {key: json.dumps(value) for key, value in values.items()}


def check_seal(data: bytes, name: str) -> None:
    """InputError where the bytes of an ONNX file are not those that ``export_onnx`` wrote."""
    at = data.find(_SEAL)
    if at < 0:
        raise InputError(f"{name}: not an ONNX file of brmgeo; give one that brmgeo wrote")
    if data[at + len(_SEAL) : at + len(_SEAL) + 64] != _seal_of(data).encode():
        raise InputError(
            f"{name}: not the bytes that were written (SHA-256 differs): damaged or changed; copy the file again"
        )


def _seal_of(data: bytes) -> str:
    at = data.index(_SEAL) + len(_SEAL)
    return digest_of(data[:at] + b"0" * 64 + data[at + 64 :])


def _tidy(model: Any, tile_px: int | None) -> None:
    """Names for the sizes that vary; and none of the exporter's notes, which hold paths of the machine it ran on."""
    graph = model.graph
    for entry in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info):
        del entry.metadata_props[:]
        entry.doc_string = ""
    del graph.value_info[:]
    for entry in (*graph.input, *graph.output):
        n, _, h, w = entry.type.tensor_type.shape.dim
        n.dim_param = "pictures"
        for dim, name in ((h, "height"), (w, "width")):
            if tile_px is None:
                dim.dim_param = name
            else:
                dim.dim_value = tile_px


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter warns of its own future and prints as it goes; neither is for who calls it."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore", FutureWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        log.setLevel(level)
