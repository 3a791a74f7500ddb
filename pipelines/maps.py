"""Maps: sheets or other footprints and imagery in; footprints, building mask, ratio maps and their QGIS project out.

The jobs that the command line calls, over the plan of map_plan.py.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from brmgeo import files
from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.region import MapSettings
from brmgeo.settings import checked
from brmgeo.workflow.plan import StepStatus
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.publish import publish
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.store import Artifact, Store

from .map_plan import imagery_of, plan_maps
from .map_sources import VECTOR_SUFFIXES, NativeImagery, credits, find_sources, finer_imagery
from .regions import region_named, safe_name

PUBLISHED = {
    "footprints": "footprints.gpkg",
    "imagery": "imagery.tif",
    "buildings": "buildings.tif",
    "ratio": "ratio.tif",
}


def build_region(name: str, data: Path, out: Path | None, repairs: bool, scheduler_spec: str | None) -> Path:
    """Builds all maps of a region below ``data`` and publishes them; the folder they are in."""
    region, data = region_named(name, data)
    if repairs:
        region = region.model_copy(
            update={"footprints": region.footprints.model_copy(update={"repairs_layer": True})}
        )
    target = out or data / "out" / region.name
    return build_maps(region, data / "work", target, data / "source" / region.name, scheduler_spec)


def build_maps(
    region: MapSettings, store_dir: Path, out: Path, source_dir: Path, scheduler_spec: str | None
) -> Path:
    """Builds what is missing of a region's maps in the store and publishes everything in ``out``."""
    progress = Progress()
    files.require_writable(out)
    store = Store(store_dir)
    with store.lock(region.name):
        plan = plan_maps(region, store, source_dir, fetch=True)
        with scheduler(
            scheduler_spec, shared=store.root, log=store.root / "dask.log", say=progress.say
        ) as map:
            made = plan.build(map, progress)
        for artifact in made.values():
            for note in artifact.facts.get("notes", ()):
                progress.say(note)
        if "source" in made:
            publish(made["source"], source_dir, _source_names(made["source"]), progress.say)
        for label, name in PUBLISHED.items():
            if label in made:
                publish(made[label], out, [name], progress.say)
        publish(made["overview"], out, [f"{region.name}.qgz", "preview.png"], progress.say)
        _write_facts(region, made, out / "maps.json")
    fresh = [label for label, artifact in made.items() if artifact.fresh]
    if fresh:
        progress.say(f"{region.name}: made {', '.join(fresh)}; results are in {out}")
    else:
        progress.say(f"{region.name}: nothing to do, all {len(made)} stages are fresh; results are in {out}")
    return out


def _source_names(source: Artifact) -> list[str]:
    return sorted({name.split("/")[0] for name in source.record["outputs"]})


def _write_facts(region: MapSettings, made: Mapping[str, Artifact], path: Path) -> None:
    """maps.json: the facts of every stage, from their records, so that a run with nothing to do changes nothing."""
    facts = {
        "region": region.name,
        "title": region.title,
        "crs": region.crs,
        "gsd_m": region.gsd_m,
        "attribution": credits(region),
        "imagery_terms": region.imagery.terms if region.imagery else "",
        "stages": {
            label: {
                "key": artifact.key,
                "facts": artifact.facts,
                "seconds": artifact.record.get("seconds"),
            }
            for label, artifact in made.items()
        },
    }
    if files.read_json(path) != files.json_of(json.dumps(facts)):
        files.write_json(path, facts)


def _matching(pattern: Path) -> list[Path]:
    if not glob.has_magic(str(pattern)):
        raise MissingInputError(f"maps --footprints: {pattern} is not there; correct the path")
    found = [Path(p) for p in sorted(glob.glob(str(pattern), recursive=True))]
    # As in a folder: what lies beside a shapefile is no file of its own.
    found = [p for p in found if p.is_dir() or p.suffix.lower() in VECTOR_SUFFIXES]
    if not found:
        raise MissingInputError(
            f"maps --footprints: no footprints ({', '.join(VECTOR_SUFFIXES)}) are called {pattern}; correct the pattern"
        )
    return found


def maps_of_files(
    out: Path,
    footprints: Sequence[Path],
    *,
    crs: str,
    imagery: Path | None = None,
    imagery_crs: str | None = None,
    sheets: str | None = None,
    bounds: Sequence[float] | None = None,
    gsd_m: float | None = None,
    radii_m: Sequence[float] | None = None,
    layer: str | None = None,
    encoding: str | None = None,
    source_crs: str | None = None,
    repairs: bool = False,
) -> MapSettings:
    """Maps without a region file, for ``brmgeo maps --footprints``; raises MissingInputError for absent files.

    A region file must say where the region is; here the footprints may.
    """
    if imagery_crs is not None and imagery is None:
        raise SettingsError(
            "maps --footprints: the CRS of imagery is stated, but no imagery", needs="imagery"
        )
    # A name that is there is no pattern, whatever its characters.
    named = [p for path in footprints for p in ([path] if path.exists() else _matching(path))]
    if imagery is not None and not imagery.exists():
        raise MissingInputError(f"maps --footprints: {imagery} is not there; correct the path")
    numbers = tuple(s.strip() for s in sheets.split(",") if s.strip()) if sheets else ()
    found = dict.fromkeys(p.absolute() for path in named for p in _files_of(path))
    name = out.absolute().name
    asked: dict[str, Any] = {
        "name": safe_name(name),
        "title": name,
        "crs": crs.upper(),
        "bounds": None if bounds is None else tuple(bounds),
        "sheets": numbers,
        "footprints": {
            "paths": tuple(glob.escape(str(p)) for p in found),
            "layer": layer,
            "encoding": encoding,
            "crs": source_crs,
            "repairs_layer": repairs,
        },
        "imagery": None
        if imagery is None
        else {"kind": "raster", "path": str(imagery.absolute()), "crs": imagery_crs},
    }
    if gsd_m is not None:
        asked["gsd_m"] = gsd_m
    if radii_m is not None:
        asked["ratio"] = {"radii_m": tuple(radii_m)}
    return checked(MapSettings, asked, "maps --footprints")


def _files_of(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = [p for p in sorted(path.iterdir()) if p.suffix.lower() in VECTOR_SUFFIXES]
    if not found:
        raise MissingInputError(
            f"maps --footprints: {path} holds no footprints ({', '.join(VECTOR_SUFFIXES)})"
        )
    return found


def missing_sources(name: str, data: Path) -> list[str]:
    """What a new region still wants, in lines for a person; empty when all its inputs are there."""
    region, data = region_named(name, data)
    try:
        if region.generate is None:
            find_sources(region, data / "source" / region.name)
    except MissingInputError as error:
        return [str(error)]
    return []


def native_imagery(region: MapSettings, data: Path) -> NativeImagery | None:
    """The imagery that a built region was made from, where that is finer than its lattice; else None."""
    if region.imagery is None:
        return None
    inputs, source = imagery_of(region, Store(data / "work"), data / "source" / region.name)
    places = {n: Path(i) if isinstance(i, str | Path) else i.path for n, i in inputs.items()}
    return finer_imagery(region, source, source.root(places))


def status_lines(name: str, data: Path, verify: bool = False) -> list[str]:
    """One line a stage, and a reason below each that is not fresh."""
    region, data = region_named(name, data)
    plan = plan_maps(region, Store(data / "work"), data / "source" / region.name)
    return told_status(plan.status(verify))


def told_status(steps: Iterable[StepStatus]) -> list[str]:
    """One line a step, and a reason below each that is not fresh."""
    lines = []
    for step in steps:
        lines.append(f"{step.label:<24} {step.state:<8} {step.key[:12]}")
        lines += [f"    {reason}" for reason in step.reasons]
    return lines


def why_lines(name: str, stage: str, data: Path) -> list[str]:
    """Why a stage of a region would run, or that it would not."""
    region, data = region_named(name, data)
    return plan_maps(region, Store(data / "work"), data / "source" / region.name).why(stage)
