"""The weights that ship: whole, small, of one piece, the same by both backends, and telling what they were made of."""

from __future__ import annotations

import numpy as np
import pytest

from brmgeo.segment.predict import SHIPPED, Segmenter
from brmgeo.segment.weights import load_weights
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.town import generate_town

TENSORS = SHIPPED.with_suffix(".safetensors")


def test_they_are_of_one_piece_and_small() -> None:
    _, card = load_weights(TENSORS)
    net = Segmenter.load()
    assert (net.backend, net.path) == ("onnx", SHIPPED)
    assert net.card == card
    assert card.sha256 in SHIPPED.with_suffix(".md").read_text(encoding="utf-8")
    assert sum(p.stat().st_size for p in SHIPPED.parent.iterdir()) < 15e6
    for field in (card.data, card.licence, card.metrics):
        assert field
        assert "preliminary" not in str(field)


def test_both_backends_agree_and_find_a_towns_roofs() -> None:
    pytest.importorskip("torch")
    from brmgeo.geo.grid import lattice
    from brmgeo.maps.rasterize import building_mask

    town = generate_town((0.0, 0.0, 400.0, 400.0), 977)
    box = lattice((120.0, 120.0, 240.0, 240.0), "EPSG:5187", 0.3)
    picture = render_imagery(town, box)
    by_onnx, by_torch = (Segmenter.load(TENSORS, backend) for backend in ("onnx", "torch"))
    seen = by_onnx.probability(picture, 0.3)
    np.testing.assert_allclose(seen, by_torch.probability(picture, 0.3), atol=1e-4)
    built = building_mask([b.polygon for b in town.buildings], box.affine, (400, 400)) > 0
    found = by_onnx.mask(picture, 0.3) > 0
    assert (built & found).sum() / (built | found).sum() > 0.45
