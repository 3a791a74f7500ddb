"""The plan of a region's training tiles: the stages of its maps that they need, and their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from brmgeo.errors import SettingsError
from brmgeo.geo.grid import bounds_of, lattice, shape_of
from brmgeo.region import Region
from brmgeo.segment.tiles import tile_windows
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.store import Input, Store

from .map_plan import plan_maps
from .map_sources import ImageryFiles, credits, place_of
from .trainable import held_ground
from .training_stages import (
    ALIGNMENT,
    INDEX,
    SURVEY,
    TILES,
    AlignmentSettings,
    DealtBlocks,
    IndexSettings,
    SourceCredit,
    SurveySettings,
    TilesSettings,
    grid_at,
)


def plan_tiles(
    region: Region, store: Store, data: Path, fetch: bool = False, align: bool = False
) -> tuple[Plan, dict[str, str]]:
    """The steps of a region's training tiles, and the label of each shard's step -> the shard's name.

    With ``align`` the labels are moved by their measured offset; measured and told it is in any case.

    Raises SettingsError for a region without imagery, and as ``plan_maps``.
    """
    if region.imagery is None:
        raise SettingsError(
            f"region {region.name} has no imagery, so no training tile can be cut: add [imagery] to its region file"
        )
    whole = plan_maps(region, store, data / "source" / region.name, fetch)
    plan = Plan(store, region.name)
    for label, step in whole.steps.items():
        if label not in ("imagery", "buildings", "ratio", "overview"):
            plan.steps[label] = step
    imagery = whole.steps["imagery"]
    source: ImageryFiles = imagery.settings.source
    inputs: dict[str, Input] = {
        **{name: item for name, item in imagery.inputs.items() if name != "lattice"},
        "lattice": plan.steps["lattice"],
        "footprints": plan.steps["footprints"],
    }
    alignment = plan.add(ALIGNMENT, inputs, AlignmentSettings(source))
    if align:
        inputs["alignment"] = alignment
    rules = _survey_settings(region, source, data, align)
    survey = plan.add(SURVEY, inputs, rules)
    names = _add_shards(plan, region, inputs | {"survey": survey}, rules)
    listed: dict[str, Input] = {"survey": survey, "alignment": alignment}
    listed |= {name: plan.steps[label] for label, name in names.items()}
    plan.add(INDEX, listed, _index_settings(region, rules, tuple(names.values())))
    return plan, names


def _survey_settings(region: Region, source: ImageryFiles, data: Path, align: bool) -> SurveySettings:
    own = region.training
    return SurveySettings(
        bounds=bounds_of(lattice(place_of(region), region.crs, region.gsd_m)),
        split="test" if own.hold_out else own.split,
        block_m=own.block_m,
        guard_m=own.guard_m,
        validation_share=own.validation_share,
        test_share=own.test_share,
        seed=own.seed,
        region=region.name,
        source=source,
        tile_px=own.tile_px,
        overlap_px=own.overlap_px,
        gsd_m=own.gsd_m,
        empty_share=own.empty_share,
        min_known_share=own.min_known_share,
        max_cloud_share=own.max_cloud_share,
        align=align,
        held=tuple(held_ground(region, data)),
    )


def _add_shards(
    plan: Plan, region: Region, inputs: Mapping[str, Input], rules: SurveySettings
) -> dict[str, str]:
    """One step a shard; its label -> its name."""
    own = region.training
    box = lattice(place_of(region), region.crs, region.gsd_m)
    names: dict[str, str] = {}
    for gsd_m in own.gsd_m:
        count = len(tile_windows(shape_of(grid_at(box, gsd_m)), own.tile_px, own.overlap_px))
        for number, first in enumerate(range(0, count, own.shard_tiles)):
            name = f"{region.name}-{round(gsd_m * 1000):04d}-{number:03d}"
            settings = TilesSettings(
                region=region.name,
                source=rules.source,
                tile_px=own.tile_px,
                align=rules.align,
                gsd_m=gsd_m,
                first=first,
                count=own.shard_tiles,
                image_format=own.image_format,
            )
            plan.add(TILES, inputs, settings, f"tiles {name}")
            names[f"tiles {name}"] = name
    return names


def _index_settings(region: Region, rules: SurveySettings, shards: Sequence[str]) -> IndexSettings:
    assert region.imagery is not None
    dealt = rules.splits()
    return IndexSettings(
        region=region.name,
        title=region.title,
        hold_out=region.training.hold_out,
        tile_px=rules.tile_px,
        overlap_px=rules.overlap_px,
        shards=tuple(shards),
        align=rules.align,
        blocks=DealtBlocks(
            dealt.guard_m, tuple((name, *dealt.block(i)) for i, name in enumerate(dealt.names))
        ),
        credit=credits(region),
        sources=(
            SourceCredit("imagery", region.imagery.attribution, region.imagery.terms),
            SourceCredit("footprints", region.footprints.attribution, ""),
        ),
    )
