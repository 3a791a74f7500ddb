"""`brmgeo evaluate`: many simulated flights through the matchers, or the results of localize, side by side in one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from brmgeo.errors import MissingInputError, SettingsError, WorkflowError
from brmgeo.evaluate.conditions import CONDITIONS
from brmgeo.evaluate.table import FlightRow, markdown, plain, read_row, rows_csv, summarize
from brmgeo.evaluate.trials import MASKS, PAPER_ACCURACY, Trial, fly_trial
from brmgeo.files import list_written, require_writable, set_aside, write_text
from brmgeo.locate.maps import Maps, read_maps
from brmgeo.locate.masks import network_name, network_warning
from brmgeo.match import METHODS
from brmgeo.synth.mission import path_name
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import scheduler

#: What is written.
TABLES = ("flights.csv", "summary.md")
_SIMULATED = "12 % of buildings missed, 3 false blobs a frame, wobbly edges"


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Many simulated flights over the same maps.

    Attributes:
        trial: the first flight; the others have the seeds after its own.
        flights: how many, under each of the conditions.
        conditions: names of ``CONDITIONS`` to fly under; none for plain flights.
        out: folder of flights.csv and summary.md.
        scheduler_spec: what runs them, see ``scheduler``.
    """

    trial: Trial
    flights: int
    out: Path
    scheduler_spec: str | None = None
    conditions: tuple[str, ...] = ()

    @property
    def trials(self) -> list[Trial]:
        """All flights."""
        return [
            replace(self.trial, seed=self.trial.seed + i, condition=condition)
            for condition in self.conditions or (None,)
            for i in range(self.flights)
        ]


def evaluate(what: Evaluation) -> str:
    """Flies many simulated flights, writes flights.csv (as they land), summary.md and returns the table as text.

    WorkflowError, after all is written, where a flight broke off.
    """
    maps = read_maps(what.trial.maps_dir)
    check_evaluation(what, maps)
    shown = _evidence(what.trial)
    progress = Progress()
    masks = what.trial.masks
    if masks is not None and "network" in masks.kinds:
        warning = network_warning(masks.weights, maps.folder.name)
        if warning:
            progress.say(warning)
    rows: list[FlightRow] = []
    broken: list[str] = []
    table = what.out / TABLES[0]
    require_writable(what.out)
    set_aside(what.out, TABLES, progress.say)
    with (
        scheduler(what.scheduler_spec, shared=what.out, say=progress.say) as map,
        progress.stage("flights") as bar,
    ):
        for result in bar.watch(map)(_trial_or_why, what.trials):
            if isinstance(result, str):
                broken.append(result)
            else:
                rows += result
                _write(what.out, TABLES[0], rows_csv(rows))
    if not rows:
        raise WorkflowError(f"evaluate: none of {len(what.trials)} flights could be flown; {broken[0]}")
    note = _note(what, maps, shown, broken)
    summaries = summarize(rows)
    _write(what.out, TABLES[1], f"{note}\n\n{markdown(summaries)}")
    if broken:
        raise WorkflowError(
            f"evaluate: {len(broken)} of {len(what.trials)} flights broke off ({broken[0]}); the others are in {table}"
        )
    return f"{note}\n\n{plain(summaries)}\n\nwritten: {table}, {what.out / 'summary.md'}"


def check_evaluation(what: Evaluation, maps: Maps) -> None:
    """SettingsError for an evaluation that cannot be, MissingInputError where the maps lack the imagery that it needs."""
    trial = what.trial
    for method in trial.methods:
        if method not in METHODS:
            raise SettingsError(f"method {method!r} is not known: choose among {', '.join(METHODS)}")
    if not trial.methods and not trial.sift:
        raise SettingsError(f"--methods: names none; give some of {', '.join(METHODS)}")
    if what.flights < 1:
        raise SettingsError(f"--flights {what.flights}: give 1 or more")
    if trial.sift and trial.hide is not None:
        raise SettingsError("--sift matches the imagery, which --hide does not hide: leave out one of them")
    for name in what.conditions:
        if name not in CONDITIONS:
            raise SettingsError(f"--conditions: {name!r} is not known: choose among {', '.join(CONDITIONS)}")
    if what.conditions and (trial.masks is not None or trial.sift):
        raise SettingsError(
            "--conditions have masks of their own and no frames: leave out --masks and --sift"
        )
    kinds = () if trial.masks is None else trial.masks.kinds
    for kind in kinds:
        if kind not in MASKS:
            raise SettingsError(f"--masks: {kind!r} is not known: choose among {', '.join(MASKS)}")
    drawable = trial.drawn.native is not None or trial.drawn.imagery is not None
    if "network" in kinds and maps.imagery is None and not drawable:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there; the network's frames are drawn from imagery"
        )
    if trial.sift and maps.imagery is None:
        raise MissingInputError(
            f"{maps.folder / 'imagery.tif'} is not there; --sift matches frames to imagery: leave it out"
        )


def _evidence(trial: Trial) -> str:
    """What the methods are given, for the note above the table."""
    season, masks = trial.drawn.season, trial.masks
    shown = f"masks: {_SIMULATED}"
    if masks is not None:
        told = {
            "true": "what a perfect network would see in the frame",
            "degraded": f"true ones with pixels flipped in patches to an accuracy of {PAPER_ACCURACY}",
            "simulated": _SIMULATED,
        }
        if "network" in masks.kinds:
            day = f" of another day ({season})" if season else ""
            told["network"] = f"{network_name(masks.weights, masks.looks)} on rendered frames{day}"
        shown = "masks: " + "; ".join(f"{kind}: {told[kind]}" for kind in masks.kinds)
    if trial.sift:
        shown += "; SIFT: each frame for itself against the imagery, " + (
            f"drawn as on another day ({season})"
            if season
            else "drawn from this very imagery, which is far easier than a real camera (--season draws another day's)"
        )
    return shown


def _note(what: Evaluation, maps: Maps, shown: str, broken: Sequence[str]) -> str:
    """What was flown, and what broke off."""
    trial = what.trial
    where = "over ground that the map does not show" if trial.hide else "over built-up ground"
    frameless = "masks-only " if trial.masks is None and not trial.sift else ""
    note = (
        f"{len(what.trials) - len(broken)} simulated {frameless}flights ({path_name(trial.path)}, seeds "
        f"{trial.seed} to {trial.seed + what.flights - 1}) {where} of {maps.folder.name}; "
        f"odometry: simulated, scale bias {trial.scale_bias:+.0%} or the opposite, heading drift 0.75 deg per root minute; "
        f"{shown}. Nothing is aligned before it is scored."
    )
    if what.conditions:
        note += " Conditions: " + "; ".join(f"{n}: {CONDITIONS[n].told}" for n in what.conditions) + "."
    if broken:
        note += f" {len(broken)} of {len(what.trials)} flights broke off and are not in the table: {'; '.join(broken)}."
    return note


def _trial_or_why(trial: Trial) -> list[FlightRow] | str:
    # One flight that cannot be flown must not cost the others.
    try:
        return fly_trial(trial)
    except Exception as error:
        return f"seed {trial.seed}: {type(error).__name__}: {' '.join(str(error).split())}"


def compare_results(folders: Sequence[Path], out: Path | None) -> str:
    """The table of results that ``localize`` has written: every metrics.json below the folders."""
    found = sorted({p for folder in folders for p in folder.rglob("metrics.json")})
    if not found:
        raise MissingInputError(
            f"{', '.join(map(str, folders))}: no metrics.json below; run localize over flights with a reference first"
        )
    rows = [read_row(path) for path in found]
    summaries = summarize(rows)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        set_aside(out, TABLES, Progress().say)
        _write(out, TABLES[0], rows_csv(rows))
        _write(out, TABLES[1], markdown(summaries))
    return plain(summaries)


def _write(out: Path, name: str, text: str) -> None:
    write_text(out / name, text)
    list_written(out, [name])
