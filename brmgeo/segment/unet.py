"""The U-Net in plain torch: an encoder, a decoder and the skips between them, sized by its settings.

After Ronneberger, Fischer and Brox, "U-Net: Convolutional Networks for Biomedical Image Segmentation" (MICCAI 2015):
two 3 x 3 convolutions a level, 2 x 2 max pooling on the way down, 2 x 2 up-convolutions on the way up, the encoder's
features concatenated to the decoder's. Three things differ, as they do in nearly every U-Net since: the convolutions
are padded, so that the answer has the size of the picture; each is followed by a normalisation, so that it trains
from scratch in an hour; and one logit comes out in place of two classes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from brmgeo.errors import SettingsError

Norm = Literal["batch", "group", "none"]
_GROUP = 8


@dataclass(frozen=True, slots=True)
class UNetSettings:
    """The shape of a U-Net; its plain values go into the model card.

    Attributes:
        widths: channels of each level from the finest to the coarsest, 2 to 6 levels, multiples of 8.
        norm: ``batch``, ``group`` (groups of 8 channels, for batches of one or two) or ``none``.
        in_channels: 3 for RGB.

    Raises SettingsError for values outside of these.
    """

    widths: tuple[int, ...] = (16, 32, 64, 128, 192)
    norm: Norm = "batch"
    in_channels: int = 3

    def __post_init__(self) -> None:
        if not 2 <= len(self.widths) <= 6 or any(w <= 0 or w % _GROUP for w in self.widths):
            raise SettingsError(
                f"U-Net widths {self.widths}: give 2 to 6 channel counts, multiples of {_GROUP}, finest level first"
            )
        if self.norm not in get_args(Norm):
            raise SettingsError(f"U-Net norm {self.norm!r}: give one of {', '.join(get_args(Norm))}")
        if self.in_channels < 1:
            raise SettingsError(f"U-Net in_channels {self.in_channels}: give 1 or more (3 for RGB)")

    @property
    def multiple_px(self) -> int:
        """Height and width of the input must be multiples of this."""
        return int(2 ** (len(self.widths) - 1))

    def plain(self) -> dict[str, Any]:
        """The settings as plain values, for a model card."""
        return {**asdict(self), "widths": list(self.widths)}


def _norm(kind: Norm, channels: int) -> nn.Module:
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    return nn.GroupNorm(channels // _GROUP, channels) if kind == "group" else nn.Identity()


def _double(inner: int, outer: int, norm: Norm) -> nn.Sequential:
    layers: list[nn.Module] = []
    for source in (inner, outer):
        layers += [
            nn.Conv2d(source, outer, 3, padding=1, bias=norm == "none"),
            _norm(norm, outer),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """``forward``: (n, in_channels, h, w) float32 normalised pictures to (n, 1, h, w) float32 logits of "building".

    h and w are multiples of ``settings.multiple_px``; anything else fails in the concatenation.
    """

    def __init__(self, settings: UNetSettings | None = None) -> None:
        super().__init__()
        self.settings = settings = settings or UNetSettings()
        widths, norm = settings.widths, settings.norm
        sources = (settings.in_channels, *widths[:-1])
        self.down = nn.ModuleList(_double(a, b, norm) for a, b in zip(sources, widths))
        pairs = list(zip(widths[:0:-1], widths[-2::-1]))
        self.up = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in pairs)
        self.merge = nn.ModuleList(_double(2 * b, b, norm) for _, b in pairs)
        self.head = nn.Conv2d(widths[0], 1, 1)
        self.pool = nn.MaxPool2d(2)
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module is not self.head:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        skips: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else self.pool(x))
            skips.append(x)
        skips.pop()
        for up, merge in zip(self.up, self.merge):
            x = merge(torch.cat([skips.pop(), up(x)], dim=1))
        out: Tensor = self.head(x)
        return out

    def parameter_count(self) -> int:
        """Number of trained numbers."""
        return sum(p.numel() for p in self.parameters())
