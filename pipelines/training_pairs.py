"""Training tiles of pictures and masks of others: ``pair-survey`` and ``tile-pairs`` (one step a shard), and the job."""

from __future__ import annotations

import functools
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.pictures import SUFFIXES
from brmgeo.region import TrainingSettings
from brmgeo.segment import SPLITS
from brmgeo.segment.pairs import read_pair
from brmgeo.segment.shards import ShardWriter, TileInfo, entry_row
from brmgeo.segment.survey import ground_facts, sampled
from brmgeo.segment.tiles import Tally, pair_fault, shares
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler
from brmgeo.workflow.stage import Json, Map, Stage
from brmgeo.workflow.store import Input, Store

from .map_stages import Inputs
from .regions import safe_name
from .training import publish_tiles, results_folder
from .training_stages import (
    INDEX,
    SURVEY_TILES,
    IndexSettings,
    SourceCredit,
    none_left,
    surveyed,
    told_dropped,
    write_entries,
)

PAIRS_A_SHARD = 512
PICTURES = (*SUFFIXES, ".webp")
Pair = tuple[str, str, str]
"""Key, name of the image, name of the mask."""


@dataclass(frozen=True, slots=True)
class PairsSettings:
    """Some pairs, and what is known of them."""

    gsd_m: float
    split: str
    region: str
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, slots=True)
class PairSurveySettings(PairsSettings):
    """All pairs, and which of them are kept: see [training] of a region file."""

    seed: int
    max_cloud_share: float
    empty_share: float


def run_pair_survey(inputs: Inputs, out: Path, settings: PairSurveySettings, map: Map) -> Json:
    """Writes survey.json: all image + mask pairs with their shares, and why those that are not kept are left out."""
    pairs = settings.pairs
    todo = [pairs[first : first + SURVEY_TILES] for first in range(0, len(pairs), SURVEY_TILES)]
    work = functools.partial(_survey_pairs, dict(inputs), replace(settings, pairs=()))
    found = [tile for some in map(work, todo) for tile in some]
    ground = ground_facts(found)
    facts = sampled(found, settings.empty_share, settings.seed) | {"ground": ground}
    if not facts["kept"]:
        hints = {
            "unknown": "masks hold 0, 255 and, for unknown, 127; see that pictures are not transparent or plain filler",
            "blank": "give pictures of more than one colour",
            "cloudy": "give pictures of a clearer day",
            "empty": "--empty-share 1 keeps them",
        }
        raise InputError(none_left(settings.region, facts["dropped"], hints))
    (out / "survey.json").write_text(json.dumps({"facts": facts, "tiles": found}), encoding="utf-8")
    return facts


def _survey_pairs(inputs: Inputs, settings: PairSurveySettings, pairs: Sequence[Pair]) -> list[Json]:
    found: list[Json] = []
    for key, image_name, mask_name in pairs:
        image, label = read_pair(inputs["images"] / image_name, inputs["masks"] / mask_name)
        built, known = shares(label)
        fault = "unknown" if known == 0 else pair_fault(image, label, settings.max_cloud_share)
        found.append(
            {
                "key": key,
                "gsd_m": settings.gsd_m,
                "split": settings.split,
                "built": round(built, 6),
                "known": round(known, 6),
                "dropped": fault,
            }
        )
    return found


def run_pairs(inputs: Inputs, out: Path, settings: PairsSettings, map: Map) -> Json:
    """Writes shard.tar and entries.json of those of some image + mask pairs that the survey keeps, as they are."""
    tallies = {split: Tally() for split in SPLITS}
    kept = {tile["key"]: tile for tile in surveyed(inputs["survey"])}
    own = [pair for pair in settings.pairs if pair[0] in kept]
    rows: list[Json] = []
    if own:
        with ShardWriter(out / "shard.tar", image_format="png") as shard:
            for key, image_name, mask_name in own:
                image, label = read_pair(inputs["images"] / image_name, inputs["masks"] / mask_name)
                tile, nowhere = kept[key], float("nan")
                info = TileInfo(
                    key=key,
                    shard=0,
                    gsd_m=settings.gsd_m,
                    split=settings.split,
                    region=settings.region,
                    building_share=tile["built"],
                    known_share=tile["known"],
                    bounds=(nowhere, nowhere, nowhere, nowhere),
                    crs="",
                )
                shard.add(info, image, label)
                tallies[settings.split].add(image, label)
        rows = [entry_row(entry) for entry in shard.entries]
    write_entries(out, rows, tallies)
    return {"tiles": len(rows)}


PAIR_SURVEY = Stage("pair-survey", 1, run_pair_survey)
PAIRS = Stage("tile-pairs", 3, run_pairs)


def cut_pairs(
    images: Path,
    masks: Path,
    out: Path,
    *,
    gsd_m: float,
    name: str,
    split: str,
    attribution: str,
    terms: str,
    scheduler_spec: str | None,
    empty_share: float | None = None,
) -> Path:
    """Makes training tiles of pictures and the masks of the same names; the folder that they are in.

    Raises MissingInputError for folders without pictures and pictures without a mask, InputError for damaged ones,
    SettingsError for a flight's own pictures unless they are for testing.
    """
    rules = TrainingSettings()
    empty_share = rules.empty_share if empty_share is None else empty_share
    if not 0 <= empty_share <= 1:
        raise SettingsError(f"tiles --pairs: --empty-share {empty_share:g} is no share of the tiles (0 to 1)")
    if not 0.02 <= gsd_m <= 10:
        raise SettingsError(f"tiles --pairs: --gsd {gsd_m:g} is no size of a pixel in metres (0.02 to 10)")
    for folder in (images, masks) if split != "test" else ():
        at = Path(os.path.realpath(folder))
        if any((p / "flight.toml").is_file() for p in (at, *at.parents[:2])):
            raise SettingsError(
                f"tiles --pairs: {folder} is of a flight (flight.toml stands by it), which is for testing only: give "
                "--split test, or other pictures"
            )
    safe = safe_name(name)
    pairs = [(f"{safe}-{stem}", image, mask) for stem, image, mask in _paired(images, masks)]
    progress = Progress()
    with results_folder(out, safe), (store := Store(out / ".brmgeo")).lock(safe):
        plan = Plan(store, safe)
        survey = PairSurveySettings(
            gsd_m=gsd_m,
            split=split,
            region=safe,
            pairs=tuple(pairs),
            seed=rules.seed,
            max_cloud_share=rules.max_cloud_share,
            empty_share=empty_share,
        )
        names = _add_shards(plan, {"images": images, "masks": masks}, survey)
        shards = {shard: plan.steps[label] for label, shard in names.items()}
        index = IndexSettings(
            region=safe,
            title=name,
            hold_out=split == "test",
            tile_px=None,
            overlap_px=0,
            shards=tuple(names.values()),
            align=False,
            blocks=None,
            credit=attribution,
            sources=(SourceCredit("imagery and masks", attribution, terms),),
        )
        plan.add(INDEX, {"survey": plan.steps[PAIR_SURVEY.name]} | shards, index)
        with scheduler(
            scheduler_spec, shared=store.root, log=store.root / "dask.log", say=progress.say
        ) as map:
            made = plan.build(map, progress)
        publish_tiles(made, names, out)
    facts = made["pair-survey"].facts
    why = f" ({told_dropped(facts['dropped'])})" if facts["dropped"] else ""
    progress.say(
        f"{safe}: {facts['kept']} tiles ({split}), {len(pairs) - facts['kept']} left out{why}; results are in {out}"
    )
    return out


def _add_shards(plan: Plan, inputs: Mapping[str, Input], survey: PairSurveySettings) -> dict[str, str]:
    """The survey, and one step a shard; its label -> its name."""
    step = plan.add(PAIR_SURVEY, inputs, survey)
    names: dict[str, str] = {}
    for number, first in enumerate(range(0, len(survey.pairs), PAIRS_A_SHARD)):
        shard = f"{survey.region}-{number:03d}"
        settings = PairsSettings(
            gsd_m=survey.gsd_m,
            split=survey.split,
            region=survey.region,
            pairs=survey.pairs[first : first + PAIRS_A_SHARD],
        )
        plan.add(PAIRS, {**inputs, "survey": step}, settings, f"tiles {shard}")
        names[f"tiles {shard}"] = shard
    return names


def _paired(images: Path, masks: Path) -> list[Pair]:
    """(key, image's name, mask's name) of all pairs, by name."""
    found = []
    for folder in (images, masks):
        if not folder.is_dir():
            raise MissingInputError(
                f"tiles --pairs: {folder} is not a folder; give a folder of images and one of masks"
            )
        files = [
            p for p in sorted(folder.iterdir()) if p.suffix.lower() in PICTURES and not p.name.startswith(".")
        ]
        own = Counter(p.stem for p in files)
        double = sorted(stem for stem, count in own.items() if count > 1)
        if double:
            raise InputError(
                f"tiles --pairs: {folder} holds several pictures named {double[0]} that differ in their ending only; "
                "leave one of them"
            )
        found.append({p.stem: p.name for p in files})
    pictures, labels = found
    if not pictures:
        raise MissingInputError(f"tiles --pairs: {images} holds no picture ({', '.join(PICTURES)})")
    lonely = sorted(pictures.keys() ^ labels.keys())
    if lonely:
        where = masks if lonely[0] in pictures else images
        raise MissingInputError(
            f"tiles --pairs: {len(lonely)} pictures have no partner, such as {lonely[0]}, which {where} lacks; "
            "images and masks have the same names"
        )
    safe = Counter(safe_name(stem) for stem in pictures)
    return [
        # Names that differ only in what a key cannot hold get a number.
        (safe_name(stem) + (f"-{i:05d}" if safe[safe_name(stem)] > 1 else ""), name, labels[stem])
        for i, (stem, name) in enumerate(sorted(pictures.items()))
    ]
