"""EfficientNet-lite0 as encoder: its shape, and that published weights stand where they belong and see what they saw."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from brmgeo.errors import InputError, MissingExtraError, SettingsError
from brmgeo.segment import imagenet
from brmgeo.segment.encoder import BOTTOM, SKIPS, LiteEncoder
from brmgeo.segment.imagenet import imagenet_weights, start_from_imagenet
from brmgeo.segment.unet import UNet, UNetSettings

LITE = UNetSettings(widths=(16, 24, 32, 48, 80), encoder="efficientnet-lite0")
MEAN, STD = (0.45, 0.40, 0.35), (0.22, 0.25, 0.20)


def published(path: Path, seed: int = 3) -> LiteEncoder:
    """Writes a file as the package holds it, of random numbers, and returns the encoder that they make as they are."""
    torch.manual_seed(seed)
    own = LiteEncoder().eval()
    for name, value in own.state_dict().items():
        if name.endswith("running_mean"):
            value.normal_(0, 0.5)
        elif name.endswith("running_var"):
            value.uniform_(0.5, 2.0)
    # Named as they are published: the stem, then every block's convolutions and norms, then what is left out here.
    state = {f"_tensor{k:03d}": v.clone() for k, v in enumerate(own.state_dict().values())}
    state |= {"_blocks.13._expand_conv.weight": torch.zeros(1152, 192, 1, 1)}
    state |= {"_conv_head.weight": torch.zeros(1280, 320, 1, 1), "_fc.weight": torch.zeros(1000, 1280)}
    torch.save(state, path)
    return own


def test_features_have_the_strides_and_channels_that_the_decoder_expects() -> None:
    found = LiteEncoder().eval()(torch.zeros(1, 3, 64, 96))
    assert [tuple(f.shape[1:]) for f in found] == [
        (channels, 64 // stride, 96 // stride)
        for channels, stride in zip((*SKIPS, BOTTOM), (2, 4, 8, 16, 32))
    ]


def test_a_network_with_it_answers_pixel_by_pixel_and_is_small_enough_to_ship_twice() -> None:
    net = UNet(LITE).eval()
    assert 2 * 4 * sum(p.numel() for p in net.parameters()) < 15e6
    assert net.settings.multiple_px == 32
    with torch.inference_mode():
        assert net(torch.zeros(2, 3, 64, 96)).shape == (2, 1, 64, 96)


def test_features_lie_where_their_pixels_lie() -> None:
    torch.manual_seed(5)
    net = LiteEncoder().eval()
    x = torch.zeros(1, 3, 256, 256)
    with torch.inference_mode():
        empty = net(x)
        x[..., 126:131, 126:131] = 3.0
        seen = net(x)
    for a, b, stride in zip(empty[:3], seen, (2, 4, 8)):
        touched = torch.nonzero((a - b).abs().amax((0, 1)) > 1e-6).float()
        # Feature k stands on pixel stride * k: the touched ones lie about the square's middle.
        middle = stride * (touched.amin(0) + touched.amax(0)) / 2
        assert (middle - 128).abs().max() <= stride


def test_published_weights_see_levels_as_they_did(tmp_path: Path) -> None:
    path = tmp_path / "efficientnet-lite0.pth"
    theirs = published(path)
    ours = LiteEncoder().eval()
    start_from_imagenet(ours, path, MEAN, STD)
    levels = torch.rand(1, 3, 256, 256) * 255
    mean, std = (torch.tensor(v)[:, None, None] for v in (MEAN, STD))
    with torch.inference_mode():
        want = theirs((levels - 127) / 128)
        got = ours((levels / 255 - mean) / std)
    # Away from the border, which each pads with its own zero.
    for a, b in zip(want[:2], got[:2]):
        n = a.shape[-1] // 4
        torch.testing.assert_close(a[..., n:-n, n:-n], b[..., n:-n, n:-n], rtol=1e-3, atol=1e-3)
        assert float(a.std()) > 0.01


def test_files_that_are_not_those_weights_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "efficientnet-lite0.pth"
    path.write_bytes(b"no weights")
    with pytest.raises(InputError, match="no weights can be read"):
        start_from_imagenet(LiteEncoder(), path, MEAN, STD)
    torch.save({"_conv_stem.weight": torch.zeros(8, 3, 3, 3)}, path)
    with pytest.raises(InputError, match="another network"):
        start_from_imagenet(LiteEncoder(), path, MEAN, STD)


def test_weights_that_are_not_installed_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imagenet, "PACKAGE", "no_such_package_of_weights")
    with pytest.raises(MissingExtraError, match=r"needs no_such_package_of_weights.*brmgeo\[train\]"):
        imagenet_weights()


def test_the_installed_weights_fit() -> None:
    try:
        path = imagenet_weights()
    except MissingExtraError as error:
        pytest.skip(str(error))
    net = LiteEncoder()
    start_from_imagenet(net, path, MEAN, STD)
    own, theirs = net.state_dict(), torch.load(path, weights_only=True)
    last = theirs["_blocks.12._project_conv.weight"]
    torch.testing.assert_close(own["stages.5.1.body.6.weight"], last)
    scale = torch.tensor([255 / 128 * s for s in STD])[None, :, None, None]
    torch.testing.assert_close(own["stem.0.weight"], theirs["_conv_stem.weight"] * scale)


@pytest.mark.parametrize(
    "bad",
    [
        {"encoder": "resnet"},
        {"encoder": "efficientnet-lite0", "widths": (16, 24, 32)},
        {"encoder": "efficientnet-lite0", "norm": "group"},
        {"encoder": "efficientnet-lite0", "in_channels": 4},
    ],
)
def test_settings_that_do_not_go_together_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match="encoder"):
        UNetSettings(**bad)  # type: ignore[arg-type]
