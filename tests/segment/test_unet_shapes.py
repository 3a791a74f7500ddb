"""The U-Net against its definition: sizes, parameters counted by hand, what its settings refuse."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brmgeo.errors import SettingsError
from brmgeo.segment.train import predict
from brmgeo.segment.unet import UNet, UNetSettings, shifted


def counted(widths: tuple[int, ...], channels: int = 3) -> int:
    """Numbers in convolutions (no bias under a norm), norms (two a channel), up-convolutions (with bias) and the head."""
    total = 0
    for a, b in zip((channels, *widths[:-1]), widths):
        total += 9 * a * b + 9 * b * b + 4 * b
    for a, b in zip(widths[1:], widths[:-1]):
        total += 4 * a * b + b + 9 * 2 * b * b + 9 * b * b + 4 * b
    return total + widths[0] + 1


@pytest.mark.parametrize("widths", [(8, 16), (16, 32, 64, 128, 192)])
def test_parameters_are_those_of_the_definition(widths: tuple[int, ...]) -> None:
    net = UNet(UNetSettings(widths=widths))
    assert sum(p.numel() for p in net.parameters()) == counted(widths)


def test_the_default_is_small_enough_to_ship_twice() -> None:
    assert 2 * 4 * sum(p.numel() for p in UNet().parameters()) < 15e6


@pytest.mark.parametrize("norm", ["batch", "group", "none"])
def test_the_answer_has_the_size_of_the_picture(norm: str) -> None:
    net = UNet(UNetSettings(widths=(8, 16, 24), norm=norm)).eval()  # type: ignore[arg-type]
    with torch.inference_mode():
        assert net(torch.zeros(2, 3, 20, 36)).shape == (2, 1, 20, 36)


@pytest.mark.parametrize("encoder", ["plain", "efficientnet-lite0"])
def test_a_shift_is_the_same_everywhere(encoder: str) -> None:
    torch.manual_seed(1)
    net = UNet(UNetSettings(widths=(8, 16, 24, 32, 40), encoder=encoder)).eval()  # type: ignore[arg-type]
    x = torch.randn(1, 3, 64, 64)
    with torch.inference_mode():
        before = net(x)
        state = shifted(net.state_dict(), -0.7)
        assert torch.equal(net(x), before)
        net.load_state_dict(state)
        assert torch.allclose(net(x), before - 0.7, atol=1e-5)


def test_a_pixel_sees_far_and_is_moved_with_the_picture() -> None:
    torch.manual_seed(0)
    net = UNet(UNetSettings(widths=(8, 16, 24))).eval()
    x = torch.randn(1, 3, 96, 96)
    with torch.inference_mode():
        y = net(x)
        moved = net(torch.roll(x, (4, 8), (2, 3)))
        changed = x.clone()
        changed[0, :, 48, 48] += 5
        touched = (net(changed) - y)[0, 0].abs() > 1e-6
    inner = (slice(36, 52), slice(36, 52))
    np.testing.assert_allclose(moved[0, 0][40:56, 44:60], y[0, 0][inner], atol=1e-5)
    rows = torch.nonzero(touched.any(1)).ravel()
    assert 10 <= int(rows.max() - 48) <= 24


def test_pictures_of_any_size_are_predicted_and_left_as_they_are() -> None:
    net = UNet(UNetSettings(widths=(8, 16, 24))).train()
    images = np.random.default_rng(0).integers(0, 255, (1, 33, 50, 3), dtype=np.uint8)
    logits = predict(net, images)
    assert logits.shape == (1, 33, 50)
    assert net.training
    np.testing.assert_allclose(predict(net, images[:, :32, :48])[:, :8, :8], logits[:, :8, :8], atol=1e-4)


@pytest.mark.parametrize(
    "bad",
    [{"widths": (16,)}, {"widths": (16, 20)}, {"widths": (0, 8)}, {"norm": "layer"}, {"in_channels": 0}],
)
def test_settings_that_are_no_unet_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match="U-Net"):
        UNetSettings(**bad)  # type: ignore[arg-type]
