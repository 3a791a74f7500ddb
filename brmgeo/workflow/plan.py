"""A region's steps in order: what is fresh, why something is not, and building what is missing.

Keys follow from sources and settings alone, so the whole plan is keyed without running anything, on an empty store too.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from brmgeo.errors import BrmgeoError, WorkflowError
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.schedule import serial_map
from brmgeo.workflow.stage import Json, Map, S, Stage, canonical
from brmgeo.workflow.store import Artifact, Input, Step, Store


@dataclass(frozen=True, slots=True)
class StepStatus:
    """How one step stands.

    Attributes:
        label: the step.
        state: ``fresh`` (in the store), ``stale`` (made before from something else), ``missing`` (never made here),
            ``damaged`` (files of the store were changed or removed).
        key: 64 hexadecimal digits.
        path: where its outputs are, or will be.
        reasons: why it is not fresh, one line each.
    """

    label: str
    state: Literal["fresh", "stale", "missing", "damaged"]
    key: str
    path: Path
    reasons: tuple[str, ...]


class Plan:
    """The steps of one region, in the order they are added, over one store."""

    def __init__(self, store: Store, region: str) -> None:
        self.store = store
        self.region = region
        self.steps: dict[str, Step[Any]] = {}

    def add(
        self,
        stage: Stage[S],
        inputs: Mapping[str, Input],
        settings: S,
        label: str | None = None,
    ) -> Step[S]:
        """Keys a step and appends it; see ``Store.step``. Several steps of one stage need labels of their own."""
        step = self.store.step(stage, inputs, settings, label)
        if step.label in self.steps:
            raise ValueError(
                f"two steps of the plan are called {step.label!r}: give one of them another label"
            )
        self.steps[step.label] = step
        return step

    def build(self, map: Map = serial_map, progress: Progress | None = None) -> dict[str, Artifact]:
        """All artifacts by label; only what is missing runs. Hold ``store.lock(region)`` around it.

        Neighbours of one stage that do not need each other (the files of a region) are built side by side by ``map``,
        each wholly within one of its workers. Where some of them fail, the others are finished and kept first.

        Raises what the stages raise, see ``Store.build``.
        """
        progress = progress or Progress(quiet=True)
        made: dict[str, Artifact] = {}
        for group in self._groups():
            missing = [step for step in group if self.store.find(step) is None]
            if len(missing) > 1:
                with progress.stage(missing[0].stage.name) as bar:
                    self._build_side_by_side(missing, bar.watch(map))
            elif missing:
                with progress.stage(missing[0].label) as bar:
                    self.store.build(missing[0], bar.watch(map))
            for step in group:
                if step not in missing:
                    progress.fresh(step.label)
                self.store.remember(self.region, step)
                made[step.label] = replace(self.store.build(step, map), fresh=step in missing)
        return made

    def _groups(self) -> list[list[Step[Any]]]:
        """The steps in order, neighbours of one stage together as long as none of them needs another."""
        groups: list[list[Step[Any]]] = []
        for step in self.steps.values():
            group = groups[-1] if groups else []
            if group and group[0].stage == step.stage and not any(i in group for i in step.inputs.values()):
                group.append(step)
            else:
                groups.append([step])
        return groups

    def _build_side_by_side(self, steps: Sequence[Step[Any]], map: Map) -> None:
        errors = []
        for step, error in zip(steps, map(functools.partial(_build_alone, self.store.root), steps)):
            if error is None:
                self.store.remember(self.region, step)
            else:
                errors.append(error)
        if len(errors) > 1:
            raise type(errors[0])(
                f"{errors[0]} (and {len(errors) - 1} more of {len(steps)} {steps[0].stage.name} failed)",
                needs=errors[0].needs,
            ) from errors[0]
        if errors:
            raise errors[0]

    def status(self, verify: bool = False) -> list[StepStatus]:
        """How each step stands; with ``verify`` the contents of all outputs are held against their records."""
        return [self._status(step, verify) for step in self.steps.values()]

    def why(self, label: str) -> list[str]:
        """Lines that say why a step would run, or that it would not. Raises WorkflowError for an unknown label."""
        if label not in self.steps:
            raise WorkflowError(
                f"region {self.region} has no stage {label!r}: it has {', '.join(self.steps) or 'none'}"
            )
        status = self._status(self.steps[label], verify=False)
        if status.state == "fresh":
            record = self.store.find(self.steps[label])
            when = record.record["end"] if record else "just now"
            return [
                f"{label} is fresh: made {when} from the same inputs and settings (key {status.key[:12]})"
            ]
        return [f"{label} is {status.state}:", *(f"  {line}" for line in status.reasons)]

    def _status(self, step: Step[Any], verify: bool) -> StepStatus:
        def answer(state: Literal["fresh", "stale", "missing", "damaged"], *reasons: str) -> StepStatus:
            return StepStatus(step.label, state, step.key, step.path, reasons)

        wrong = self.store.damage(step)
        if wrong is not None:
            return answer("damaged", f"in the store, {wrong}")
        found = self.store.find(step)
        if found is not None:
            lines = self.store.verify(found) if verify else []
            return answer("damaged", *lines) if lines else answer("fresh")
        before = self.store.latest(self.region, step.label)
        if before is None:
            return answer("missing", f"it has never been made for region {self.region}")
        if before["key"] == step.key:
            return answer("missing", f"its outputs were removed from the store ({step.path})")
        return answer("stale", *changes(before, step.origin))


def _build_alone(root: Path, step: Step[Any]) -> BrmgeoError | None:
    """Builds one step within this process; an error of its input is returned, so that its neighbours go on."""
    try:
        Store(root).build(step, serial_map)
    except WorkflowError:
        raise  # a full disk or the like is no fault of this step alone
    except BrmgeoError as error:
        return error
    return None


def changes(before: Json, after: Json) -> list[str]:
    """One line for each field in which two origins (see ``Store.step``) differ."""
    lines = []
    for field in ("stage", "version"):
        if before[field] != after[field]:
            lines.append(f"{field}: {before[field]} -> {after[field]}")
    old, new = _flat(before["settings"]), _flat(after["settings"])
    for name in sorted(old.keys() | new.keys()):
        if name not in new:
            lines.append(f"{name}: {_short(old[name])} -> no longer set")
        elif name not in old:
            lines.append(f"{name}: not set -> {_short(new[name])}")
        elif canonical(old[name]) != canonical(new[name]):
            lines.append(f"{name}: {_short(old[name])} -> {_short(new[name])}")
    sources, now = before["inputs"], after["inputs"]
    for name in sorted(sources.keys() | now.keys()):
        if name not in now:
            lines.append(f"input {name}: no longer used")
        elif name not in sources:
            lines.append(f"input {name}: new")
        else:
            lines += _input_changes(name, sources[name], now[name])
    return lines


def _input_changes(name: str, before: Json, after: Json) -> list[str]:
    if "key" in after:
        if before.get("key") == after["key"]:
            return []
        return [f"input {name}: stage {after['label']} gives another result, for reasons of its own"]
    if before.get("sha256") == after["sha256"]:
        return []
    old, new = before.get("files"), after.get("files")
    if old is None or new is None:
        return [f"input {name}: content changed ({after['path']})"]
    kinds = {
        "added": sorted(new.keys() - old.keys()),
        "removed": sorted(old.keys() - new.keys()),
        "changed": sorted(n for n in new.keys() & old.keys() if new[n] != old[n]),
    }
    parts = [f"{len(names)} {kind} ({_listed(names)})" for kind, names in kinds.items() if names]
    return [f"input {name}: files {', '.join(parts)} in {after['path']}"]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _flat(value: Json, prefix: str = "") -> dict[str, Json]:
    """Nested settings as one level of dotted names."""
    flat: dict[str, Json] = {}
    for name, item in value.items():
        if isinstance(item, dict) and item:
            flat |= _flat(item, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = item
    return flat


def _short(value: Json) -> str:
    text = canonical(value).replace(",", ", ") if isinstance(value, list) else canonical(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
