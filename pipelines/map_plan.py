"""The plan of a region's maps: which stages there are, of which files and settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from brmgeo.errors import SettingsError
from brmgeo.geo.crs import require_projected_metres
from brmgeo.geo.sheets import is_sheet_number
from brmgeo.region import MapSettings
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.store import Input, Step, Store

from .map_sources import (
    ImageryFiles,
    SourceFile,
    credits,
    find_sources,
    imagery_inputs,
    place_of,
)
from .map_stages import (
    BUILDINGS,
    FOOTPRINTS,
    IMAGERY,
    LATTICE,
    OUTLINES,
    OVERVIEW,
    RATIO,
    SOURCE,
    CombineSettings,
    LatticeSettings,
    MosaicSettings,
    OutlinesSettings,
    OverviewSettings,
    RasterSettings,
    RatioMapsSettings,
    SourceSettings,
)

MAX_RADIUS_PX = 5_000  # a block's halo, and with it memory, grows with the radius


def plan_maps(region: MapSettings, store: Store, source_dir: Path, fetch: bool = False) -> Plan:
    """The steps of a region's maps; with ``fetch`` the tiles of a service that the user named are fetched for it.

    Raises MissingInputError (which files or tiles, where they go, where to get them).
    """
    _require_sound(region)
    plan = Plan(store, region.name)
    generated = None if region.generate is None else plan.add(SOURCE, {}, _source_settings(region))
    files = _generated_files(region, generated) if generated else find_sources(region, source_dir)
    outlines = _add_outlines(plan, region, files)
    stated = bool(region.sheets) or region.bounds is not None
    grid = plan.add(
        LATTICE,
        {} if stated else outlines,
        LatticeSettings(crs=region.crs, gsd_m=region.gsd_m, bounds=region.bounds, sheets=region.sheets),
    )
    footprints = plan.add(
        FOOTPRINTS, outlines, CombineSettings(repairs_layer=region.footprints.repairs_layer)
    )
    imagery = _add_imagery(plan, region, source_dir, fetch)
    drawn: dict[str, Input] = {"lattice": grid, "footprints": footprints}
    owner = region.footprints.attribution
    buildings = plan.add(BUILDINGS, drawn, RasterSettings(region=region.name, attribution=owner, terms=""))
    ratio = plan.add(
        RATIO,
        drawn,
        RatioMapsSettings(region=region.name, attribution=owner, terms="", radii_m=region.ratio.radii()),
    )
    inputs: dict[str, Input] = {"footprints": footprints, "buildings": buildings, "ratio": ratio}
    if imagery is not None:
        inputs["imagery"] = imagery
    title = region.title or region.name
    plan.add(OVERVIEW, inputs, OverviewSettings(name=region.name, title=title, attribution=credits(region)))
    return plan


def _require_sound(region: MapSettings) -> None:
    """Raises CrsError or SettingsError for what a region file cannot be seen to be wrong in by itself."""
    require_projected_metres(region.crs)
    for number in region.sheets:
        if not is_sheet_number(number):
            raise SettingsError(
                f"region {region.name}: sheets: {number!r} is not an NGII sheet number of 5 to 9 digits, such as 36914093"
            )
    widest = max(region.ratio.radii())
    if widest > MAX_RADIUS_PX * region.gsd_m:
        raise SettingsError(
            f"region {region.name}: the largest radius of the ratio maps is {widest:g} m; at most {MAX_RADIUS_PX} px, here "
            f"{MAX_RADIUS_PX * region.gsd_m:g} m, are possible: give smaller radii or a larger gsd_m"
        )


def imagery_of(
    region: MapSettings, store: Store, source_dir: Path, fetch: bool = False
) -> tuple[dict[str, Input], ImageryFiles]:
    """What a region's imagery is made from: its local files or, where it is generated, the step that makes them.

    Raises as ``plan_maps``.
    """
    assert region.imagery is not None
    if region.generate is None:
        return imagery_inputs(region, region.imagery, source_dir, fetch)
    made = store.step(SOURCE, {}, _source_settings(region))
    return {"imagery": made}, ImageryFiles.of(region.imagery, "tiles")


def _source_settings(region: MapSettings) -> SourceSettings:
    assert region.generate is not None
    if not region.sheets:
        raise SettingsError(
            f"region {region.name}: [generate] needs sheets, which the buildings are drawn on"
        )
    return SourceSettings(
        seed=region.generate.seed,
        sheets=region.sheets,
        bounds=place_of(region),
        crs=region.crs,
        level=(region.imagery.level if region.imagery else None) or 1,
        style=region.generate.style,
        season=region.generate.season,
    )


def _generated_files(region: MapSettings, source: Step[SourceSettings]) -> list[SourceFile]:
    return [SourceFile({"file": source}, f"sheets/{s}.dxf", f"{s}.dxf", s) for s in region.sheets]


def _add_outlines(
    plan: Plan, region: MapSettings, files: Sequence[SourceFile]
) -> dict[str, Step[OutlinesSettings]]:
    """One step a file, by sheet or, where another has that, by the file's name."""
    own = region.footprints
    steps: dict[str, Step[OutlinesSettings]] = {}
    for file in files:
        name = file.sheet or file.name
        name = name if name not in steps else file.name
        settings = OutlinesSettings(
            member=file.member,
            name=file.name,
            crs=region.crs,
            sheet=file.sheet,
            sheets=region.sheets,
            layers=own.layers,
            snap_m=own.snap_m,
            max_dropped_share=own.max_dropped_share,
            source_crs=own.crs,
            layer=own.layer,
            encoding=own.encoding,
        )
        steps[name] = plan.add(OUTLINES, file.inputs, settings, f"outlines {name}")
    return steps


def _add_imagery(
    plan: Plan, region: MapSettings, source_dir: Path, fetch: bool
) -> Step[MosaicSettings] | None:
    given = region.imagery
    if given is None:
        return None
    inputs, source = imagery_of(region, plan.store, source_dir, fetch)
    return plan.add(
        IMAGERY,
        {"lattice": plan.steps["lattice"], **inputs},
        MosaicSettings(
            region=region.name,
            attribution=given.attribution,
            terms=given.terms,
            source=source,
            compression=given.compression,
        ),
    )
