"""A generated town on another day: the same buildings and roads in another season's colours and another light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brmgeo.synth.scene import Season, Town
from brmgeo.synth.terrain import CROPS


def another_day(town: Town, season: Season, seed: int) -> Town:
    """The town as a flight on another day sees it: ``render_imagery`` of it is what a camera meets there.

    Buildings, roads, trees and the borders of fields stay. Crops, leaves and the colour of grass follow ``season``; sun,
    haze, warmth, brightness and the cars on the roads are drawn from ``seed``.
    """
    rng = np.random.default_rng([seed, 0xDA])
    crops, weights = CROPS[season]
    known = {kind for kinds, _ in CROPS.values() for kind in kinds}
    drawn = rng.choice(len(crops), size=len(town.fields), p=np.array(weights) / sum(weights))
    fields = tuple(
        replace(f, kind=crops[i], shade=float(rng.normal(0.0, 1.0)) if f.shade else f.shade)
        if f.kind in known
        else f
        for f, i in zip(town.fields, drawn.tolist())
    )
    style = replace(
        town.style.with_season(season),
        sun_azimuth_deg=float(rng.uniform(100, 260)),
        sun_elevation_deg=float(rng.uniform(28, 60)),
        brightness=float(rng.uniform(0.85, 1.12)),
        contrast=float(rng.uniform(0.85, 1.15)),
        warmth=float(rng.uniform(-0.5, 0.6)),
        haze=float(rng.uniform(0.0, 0.15)),
    )
    cars = town.cars[rng.random(len(town.cars)) < 0.35]
    return replace(town, style=style, fields=fields, cars=cars)
