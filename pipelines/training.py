"""Training tiles: imagery and footprints in; 512 x 512 pairs of image and label, their splits, statistics and map out.

The jobs that the command line calls, over the plan of training_plan.py; pairs of others are in training_pairs.py.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from brmgeo.errors import SettingsError, listed
from brmgeo.files import read_json, require_writable
from brmgeo.region import Region, TrainingSettings
from brmgeo.segment.shards import FORMAT, TILES_JSON
from brmgeo.settings import checked
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.publish import PUBLISHED, publish, withdraw
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.store import Artifact, Store

from .maps import told_status
from .regions import region_named
from .trainable import require_all_trainable
from .training_plan import plan_tiles


def cut_region(
    name: str,
    data: Path,
    out: Path | None,
    scheduler_spec: str | None,
    split: str | None = None,
    gsd_m: Sequence[float] | None = None,
    align: bool = False,
) -> Path:
    """Cuts the training tiles of a region and publishes them; the folder they are in.

    Raises SettingsError for a region that is held out or flown over, unless all its tiles are for testing.
    """
    region, data = require_all_trainable([name], data, split)[0]
    changes: dict[str, Any] = {}
    if split is not None:
        changes["split"] = split
    if gsd_m is not None:
        changes["gsd_m"] = tuple(gsd_m)
    if changes:
        region = region.model_copy(update={"training": _changed(region.training, changes)})
    return cut_tiles(region, data, out or data / "out" / region.name / "tiles", scheduler_spec, align)


def _changed(settings: TrainingSettings, changes: Mapping[str, Any]) -> TrainingSettings:
    return checked(TrainingSettings, settings.model_dump() | dict(changes), "tiles")


def cut_tiles(region: Region, data: Path, out: Path, scheduler_spec: str | None, align: bool = False) -> Path:
    """Builds what is missing of a region's training tiles and publishes them in ``out``."""
    progress = Progress()
    store = Store(data / "work")
    with results_folder(out, region.name), store.lock(region.name):
        plan, names = plan_tiles(region, store, data, fetch=True, align=align)
        with scheduler(
            scheduler_spec, shared=store.root, log=store.root / "dask.log", say=progress.say
        ) as map:
            made = plan.build(map, progress)
        publish_tiles(made, names, out)
    facts = made["tile-index"].facts
    told = ", ".join(f"{count} {split}" for split, count in facts["by_split"].items())
    survey = made["tile-survey"].facts
    if survey["gsd_too_fine_m"]:
        progress.say(
            f"{region.name}: nothing cut at {listed([f'{g:g} m' for g in survey['gsd_too_fine_m']])}: much finer than "
            f"the imagery's {survey['imagery_gsd_m']:.3g} m per pixel"
        )
    offset = made["alignment"].facts
    if offset["status"] == "told":
        moved = "the labels were moved by it" if align else "--align moves the labels by it"
        progress.say(
            f"{region.name}: labels lie {np.hypot(offset['dx_m'], offset['dy_m']):.2f} m beside the imagery (move them by "
            f"{offset['dx_m']:+.2f} m east, {offset['dy_m']:+.2f} m north; {offset['told']} of {offset['blocks']} blocks "
            f"tell); {moved}"
        )
    else:
        progress.say(
            f"{region.name}: how far the labels lie beside the imagery cannot be told ({offset['told']} of "
            f"{offset['blocks']} blocks tell)" + ("; they stay where they are" if align else "")
        )
    progress.say(
        f"{region.name}: {facts['tiles']} tiles ({told}) in {facts['shards']} shards; results are in {out}"
    )
    return out


@contextmanager
def results_folder(out: Path, region: str) -> Iterator[None]:
    """Makes the folder of a region's tiles; where the work fails, empty folders that this made are gone again.

    Raises SettingsError where it holds the tiles of something else, WorkflowError where it cannot be written.
    """
    facts = _read_dict(out / TILES_JSON)
    there = f"tiles of {facts.get('region')}" if facts.get("format") == FORMAT else "another tiles.json"
    if (out / TILES_JSON).exists() and there != f"tiles of {region}":
        raise SettingsError(
            f"{out}: holds {there}, which those of {region} would replace in part: give another --out, or move them away"
        )
    new = [p for p in (out, *out.parents) if not os.path.exists(p)]
    try:
        require_writable(out)
        yield
    except BaseException:
        with suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise


def _read_dict(path: Path) -> dict[str, Any]:
    """A JSON object; empty for a file that is not there or holds none."""
    try:
        found = read_json(path)
    except OSError:
        return {}
    return found if isinstance(found, dict) else {}


def _published_before(out: Path, region: str) -> set[str]:
    """Files of tiles in ``out`` that an earlier run put there, and no file of the user's."""
    shards = _read_dict(out / TILES_JSON).get("shards")
    names = {str(s.get("file")) for s in shards or [] if isinstance(s, dict)}
    names |= _read_dict(out / PUBLISHED).keys()
    shard = re.compile(rf"{re.escape(region)}-(\d{{4,}}-)?\d{{3,}}\.tar", re.ASCII)
    return {name for name in names if shard.fullmatch(name) or name in ("alignment.json", "index.gpkg")}


def publish_tiles(made: Mapping[str, Artifact], names: Mapping[str, str], out: Path) -> None:
    """Puts index and shards (label of each one's step -> its name) in ``out``, and takes away what an earlier cut left."""
    index, say = made["tile-index"], Progress().say
    before, wanted = _published_before(out, index.step.settings.region), set(index.record["outputs"])
    for label, name in names.items():
        if (made[label].path / "shard.tar").exists():
            publish(made[label], out, {"shard.tar": f"{name}.tar"}, say)
            wanted.add(f"{name}.tar")
    publish(index, out, sorted(index.record["outputs"]), say)
    if "alignment" in made:
        publish(made["alignment"], out, ["alignment.json"], say)
        wanted.add("alignment.json")
    if before - wanted:  # of an earlier cut with other settings
        withdraw(out, before - wanted, say)


def status_lines(name: str, data: Path, verify: bool = False) -> list[str]:
    """One line a stage of a region's training tiles, with a reason below each that is not fresh; none before a cut."""
    plan = _plan_as_last_cut(name, data)
    if plan is None:
        return []
    return told_status(
        step for step in plan.status(verify) if step.label == "alignment" or step.label.startswith("tile")
    )


def why_lines(name: str, stage: str, data: Path) -> list[str] | None:
    """Why a stage of a region's training tiles would run, or that it would not; None for a stage that is none of them."""
    plan = _plan_as_last_cut(name, data)
    return None if plan is None or stage not in plan.steps else plan.why(stage)


def last_aligned(name: str, data: Path) -> bool:
    """True where the tiles of a region were aligned when they were last cut."""
    region, data = region_named(name, data)
    last = Store(data / "work").latest(region.name, "tile-index")
    return bool(last is not None and last["settings"]["align"])


def _plan_as_last_cut(name: str, data: Path) -> Plan | None:
    """The steps of a region's tiles, aligned or not as they were last cut; None when they never were."""
    region, data = region_named(name, data)
    store = Store(data / "work")
    last = store.latest(region.name, "tile-index")
    return None if last is None else plan_tiles(region, store, data, align=last["settings"]["align"])[0]
