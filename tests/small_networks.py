"""Networks small enough for tests: random U-Nets, and a graph of one convolution whose answer is plain to work out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from brmgeo.segment.onnx_export import finished
from brmgeo.segment.weights import ModelCard


def small_card(**changes: object) -> ModelCard:
    values: dict[str, Any] = {
        "settings": {"widths": [8, 16], "norm": "batch", "in_channels": 3},
        "mean": (0.4, 0.42, 0.39),
        "std": (0.2, 0.19, 0.21),
        "threshold": 0.45,
        "temperature": 1.3,
        "gsd_min_m": 0.1,
        "gsd_max_m": 0.5,
        "gsd_work_m": 0.25,
        "data": {"regions": ["a", "b"], "Kampala": "OpenAerialMap, CC BY 4.0"},
        "licence": "Apache-2.0",
        "metrics": {"IoU": 0.91},
    }
    return ModelCard(**{**values, **changes})


def small_tensors(widths: tuple[int, ...] = (8, 16), seed: int = 1) -> dict[str, np.ndarray]:
    import torch

    from brmgeo.segment.unet import UNet, UNetSettings

    torch.manual_seed(seed)
    return {k: v.numpy() for k, v in UNet(UNetSettings(widths=widths)).state_dict().items()}


def bright_onnx(path: Path, card: ModelCard, reach: int = 2, tile_px: int | None = None) -> Path:
    """p = sigmoid(3 x mean of the normalised picture's channels over (2 reach + 1) px squares, 0 beyond the border)."""
    side = 2 * reach + 1
    kernel = np.full((1, 3, side, side), 1.0 / side**2, np.float32)
    shapes = [1, 3], [1, 1]
    inner, outer = (["n", c, "h", "w"] for _, c in shapes)
    graph = helper.make_graph(
        [
            helper.make_node("Conv", ["picture", "kernel"], ["logit"], pads=[reach] * 4),
            helper.make_node("Sigmoid", ["logit"], ["probability"]),
        ],
        "bright",
        [helper.make_tensor_value_info("picture", TensorProto.FLOAT, inner)],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, outer)],
        [numpy_helper.from_array(kernel, "kernel")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.checker.check_model(model)
    path.write_bytes(finished(model, card, tile_px))
    return path
