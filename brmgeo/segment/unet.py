"""The U-Net in plain torch: an encoder, a decoder and the skips between them, sized by its settings.

After Ronneberger, Fischer and Brox, "U-Net: Convolutional Networks for Biomedical Image Segmentation" (MICCAI 2015):
two 3 x 3 convolutions a level, 2 x 2 max pooling on the way down, 2 x 2 up-convolutions on the way up, the encoder's
features concatenated to the decoder's. Three things differ, as they do in nearly every U-Net since: the convolutions
are padded, so that the answer has the size of the picture; each is followed by a normalisation, so that it trains
from scratch in an hour; and one logit comes out in place of two classes.

In place of the encoder's lower levels it can have one that was trained on photographs before
(``brmgeo.segment.encoder``); its finest level, its decoder and the skips stay what they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from brmgeo.errors import SettingsError
from brmgeo.segment.encoder import BOTTOM, SKIPS, LiteEncoder

Encoder = Literal["plain", "efficientnet-lite0"]
Norm = Literal["batch", "group", "none"]
_GROUP = 8


@dataclass(frozen=True, slots=True)
class UNetSettings:
    """The shape of a U-Net; its plain values go into the model card.

    Attributes:
        widths: channels of each level from the finest to the coarsest, 2 to 6 levels, multiples of 8.
        norm: ``batch``, ``group`` (groups of 8 channels, for batches of one or two) or ``none``.
        in_channels: 3 for RGB.
        encoder: ``plain``, Ronneberger's; or ``efficientnet-lite0`` below the finest level. Then there are five widths,
            those of the decoder at strides 1, 2, 4, 8 and 16, in_channels is 3 and norm ``batch``.

    Raises SettingsError for values outside of these.
    """

    widths: tuple[int, ...] = (16, 32, 64, 128, 192)
    norm: Norm = "batch"
    in_channels: int = 3
    encoder: Encoder = "plain"

    def __post_init__(self) -> None:
        if not 2 <= len(self.widths) <= 6 or any(w <= 0 or w % _GROUP for w in self.widths):
            raise SettingsError(
                f"U-Net widths {self.widths}: give 2 to 6 channel counts, multiples of {_GROUP}, finest level first"
            )
        if self.norm not in get_args(Norm):
            raise SettingsError(f"U-Net norm {self.norm!r}: give one of {', '.join(get_args(Norm))}")
        if self.in_channels < 1:
            raise SettingsError(f"U-Net in_channels {self.in_channels}: give 1 or more (3 for RGB)")
        if self.encoder not in get_args(Encoder):
            raise SettingsError(f"U-Net encoder {self.encoder!r}: give one of {', '.join(get_args(Encoder))}")
        lite = (len(self.widths), self.norm, self.in_channels) == (len(SKIPS) + 1, "batch", 3)
        if self.encoder != "plain" and not lite:
            raise SettingsError(
                f"U-Net with encoder {self.encoder}: has {len(SKIPS) + 1} widths, norm batch and in_channels 3, not "
                f"{len(self.widths)}, {self.norm} and {self.in_channels}"
            )

    @property
    def multiple_px(self) -> int:
        """Height and width of the input must be multiples of this."""
        return int(2 ** (len(self.widths) - (self.encoder == "plain")))

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
        if settings.encoder == "plain":
            sources = (settings.in_channels, *widths[:-1])
            self.down = nn.ModuleList(_double(a, b, norm) for a, b in zip(sources, widths))
            skips, widths, bottom = widths[:-1], widths[:-1], widths[-1]
        else:
            self.down = nn.ModuleList([_double(settings.in_channels, widths[0], norm)])
            self.encoder = LiteEncoder()
            skips, bottom = (widths[0], *SKIPS), BOTTOM
        sources = (bottom, *widths[:0:-1])
        self.up = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in zip(sources, widths[::-1]))
        self.merge = nn.ModuleList(_double(a + b, b, norm) for a, b in zip(skips[::-1], widths[::-1]))
        self.head = nn.Conv2d(widths[0], 1, 1)
        self.pool = nn.MaxPool2d(2)
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module is not self.head:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        if self.settings.encoder == "plain":
            skips: list[Tensor] = []
            for level, block in enumerate(self.down):
                x = block(x if level == 0 else self.pool(x))
                skips.append(x)
        else:
            skips = [self.down[0](x), *self.encoder(x)]
        x = skips.pop()
        for up, merge in zip(self.up, self.merge):
            x = merge(torch.cat([skips.pop(), up(x)], dim=1))
        out: Tensor = self.head(x)
        return out


def shifted(state: Mapping[str, Tensor], shift: float) -> dict[str, Tensor]:
    """Weights of a U-Net every logit of which is ``shift`` higher than with ``state``."""
    return {**state, "head.bias": state["head.bias"] + shift}
