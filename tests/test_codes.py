"""Numbers that several rooms share."""

from __future__ import annotations

import math

import pytest

from brmgeo.codes import BUILDING_KINDS, BUILDING_LAYERS, KIND_OF_NAME, KOREAN_KINDS, disc_radii, layer_code


def test_disc_radii_follow_equation_3() -> None:
    # 150 m above ground through 43 degrees, at 0.5 m: the paper's discs.
    radii = disc_radii(150.0 * math.tan(math.radians(43.0) / 2) / 0.5, 3)
    assert radii == pytest.approx([118.2, 78.8, 39.4], abs=0.06)
    assert disc_radii(9.0, 1) == (9.0,)


def test_kinds_have_names_and_layers_codes() -> None:
    assert set(KOREAN_KINDS) == set(BUILDING_KINDS.values())
    assert all(layer_code(code.removeprefix("B001").lower()) == code for code in BUILDING_LAYERS)
    assert layer_code(" walls ") == "WALLS"
    assert (KIND_OF_NAME["단독주택"], KIND_OF_NAME["무벽건물"]) == ("house", "wall-less")
