"""EfficientNet-lite0 without its classifier, as the encoder of a U-Net.

After Tan and Le, "EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks" (ICML 2019), in the form that
its authors published for small processors (github.com/tensorflow/tpu, models/official/efficientnet/lite): inverted
residual blocks without squeeze-and-excitation, ReLU6. Ours ends earlier (``STAGES``), and strided convolutions are padded
alike on all sides, so that features lie where their pixels lie.

Its value is in the weights that it can start from (``brmgeo.segment.imagenet``): those learned on photographs know edges,
textures and things that a few hectares of real ground with labels cannot teach.
"""

from __future__ import annotations

from torch import Tensor, nn

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
