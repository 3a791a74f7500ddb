"""Trials: what half of the map hides, and one flight by several kinds of masks."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import shapely
from small_flights import COLS, GSD, LEFT, ROWS, TOP

from brmgeo.evaluate.trials import MaskComparison, Side, Trial, fly_trial, hide_half
from brmgeo.locate.maps import read_maps
from brmgeo.region import FlightSettings


@pytest.mark.parametrize("side", get_args(Side))
def test_hidden_half_of_the_map_is_never_found(maps: Path, side: Side) -> None:
    built = read_maps(maps)
    kept, (left, bottom, right, top) = hide_half(built, side)
    rows, cols = kept.building.shape
    kept_box = shapely.box(kept.left, kept.top - rows * kept.gsd_m, kept.left + cols * kept.gsd_m, kept.top)
    assert not kept_box.intersects(shapely.box(left, bottom, right, top))
    assert rows * cols == ROWS * COLS // 2
    row, col = round((TOP - kept.top) / GSD), round((kept.left - LEFT) / GSD)
    assert (kept.building == built.ground.building[row : row + rows, col : col + cols]).all()


def test_a_trial_flies_every_method_and_kind_of_masks_over_the_same_course(
    maps: Path, waypoints: Path
) -> None:
    trial = Trial(
        maps,
        FlightSettings(),
        2,
        ("mask", "paper"),
        str(waypoints),
        masks=MaskComparison(("true", "simulated")),
    )
    rows = fly_trial(trial)
    assert [(r.method, r.flight, r.seed) for r in rows] == [
        (f"{method}, {kind} masks", "line-2", 2)
        for method in ("mask", "paper")
        for kind in ("true", "simulated")
    ]
    assert len({r.scores.odometry_rmse_m for r in rows}) == 1
    for row in rows[:2]:
        assert row.scores.rmse_after_first_fix_m is not None
        assert row.scores.rmse_after_first_fix_m < 3.0
    # What a network would see at best is found no later than what has errors.
    true, simulated = (r.scores.first_fix_s for r in rows[:2])
    assert true is not None
    assert simulated is not None
    assert true <= simulated
    assert not any(r.scores.false_fixes for r in rows)
