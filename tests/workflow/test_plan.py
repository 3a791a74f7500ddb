"""Plans: what is fresh, stale, missing or damaged, and why."""

from __future__ import annotations

import io
import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
import workflow_toys as toys

from brmgeo.errors import WorkflowError
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.progress import Progress
from brmgeo.workflow.stage import Stage
from brmgeo.workflow.store import Store


@dataclass(frozen=True)
class Grid:
    gsd_m: float
    crs: str


@dataclass(frozen=True)
class Before:
    radii_m: tuple[float, ...]
    grid: Grid
    old: int


@dataclass(frozen=True)
class After:
    radii_m: tuple[float, ...]
    grid: Grid
    new: int | None


def states(plan: Plan) -> list[str]:
    return [s.state for s in plan.status()]


def test_a_plan_knows_its_keys_before_anything_runs(tmp_path: Path, source: Path) -> None:
    plan = toys.toy_plan(tmp_path / "store", source)
    assert states(plan) == ["missing", "missing"]
    assert plan.why("squares") == ["squares is missing:", "  it has never been made for region toy"]
    promised = {s.label: (s.key, s.path) for s in plan.status()}
    assert not toys.CALLS
    made = plan.build()
    assert {label: (a.key, a.path) for label, a in made.items()} == promised
    assert states(plan) == ["fresh", "fresh"]
    assert plan.status(verify=True) == plan.status()
    assert plan.why("words")[0].startswith("words is fresh: made 20")


def test_a_warm_run_computes_nothing(tmp_path: Path, source: Path) -> None:
    toys.toy_plan(tmp_path / "store", source).build()
    progress = Progress(io.StringIO())

    def no_map(*args: object) -> object:
        raise AssertionError("a warm run fans nothing out")

    made = toys.toy_plan(tmp_path / "store", source).build(no_map, progress)  # type: ignore[arg-type]
    assert toys.CALLS == ["words", "squares"]
    assert not any(a.fresh for a in made.values())
    assert (progress.ran, progress.skipped) == ([], ["words", "squares"])


def test_only_what_depends_on_a_change_runs_again(tmp_path: Path, source: Path) -> None:
    def plan(words: int, noise: int) -> Plan:
        p = Plan(Store(tmp_path / "store"), "toy")
        first = p.add(toys.WORDS, {"text": source}, toys.Words(words))
        p.add(toys.SQUARES, {"words": first}, toys.Nothing())
        p.add(toys.NOISE, {}, toys.Noise(noise))
        return p

    plan(1, 1).build()
    toys.CALLS.clear()
    assert states(plan(1, 2)) == ["fresh", "fresh", "stale"]
    plan(1, 2).build()
    assert toys.CALLS == ["noise"]
    toys.CALLS.clear()
    plan(2, 2).build()
    assert toys.CALLS == ["words", "squares"]
    toys.CALLS.clear()
    plan(1, 1).build()  # both are still in the store
    assert toys.CALLS == []


def test_why_names_the_settings_that_changed(tmp_path: Path, source: Path) -> None:
    store = Store(tmp_path / "store")

    def run(inputs: object, out: Path, settings: object, map: object) -> dict[str, int]:
        return {}

    def plan(version: int, settings: Before | After) -> Plan:
        p = Plan(store, "toy")
        p.add(Stage("words", version, run), {"text": source}, settings)
        return p

    plan(1, Before((78.8,), Grid(0.5, "EPSG:5187"), 1)).build()
    after = plan(2, After((118.2, 39.4), Grid(0.25, "EPSG:5187"), None))
    assert after.why("words") == [
        "words is stale:",
        "  version: 1 -> 2",
        "  grid.gsd_m: 0.5 -> 0.25",
        "  new: not set -> null",
        "  old: 1 -> no longer set",
        "  radii_m: [78.8] -> [118.2, 39.4]",
    ]


def test_why_names_the_sources_that_changed(tmp_path: Path, source: Path) -> None:
    tiles = tmp_path / "tiles"
    tiles.mkdir()
    for name in "abcd":
        (tiles / f"{name}.png").write_text(name)

    def plan(*names: str) -> Plan:
        p = Plan(Store(tmp_path / "store"), "toy")
        places = {"sheets/1.dxf": source, "sheets/2.dxf": source, "text": source, "tiles": tiles}
        first = p.add(toys.WORDS, {name: places[name] for name in ("text", *names)}, toys.Words())
        p.add(toys.SQUARES, {"words": first}, toys.Nothing())
        return p

    plan("sheets/1.dxf", "tiles").build()
    source.write_text("a tunnel under the river\n")
    (tiles / "a.png").unlink()
    (tiles / "b.png").write_text("other")
    for name in "wxyz":
        (tiles / f"{name}.png").write_text(name)
    after = plan("sheets/2.dxf", "tiles")
    assert states(after) == ["stale", "stale"]
    assert after.why("words") == [
        "words is stale:",
        "  input sheets/1.dxf: no longer used",
        "  input sheets/2.dxf: new",
        f"  input text: content changed ({source})",
        f"  input tiles: files 4 added (w.png, x.png, y.png, ...), 1 removed (a.png), 1 changed (b.png) in {tiles}",
    ]
    assert (
        after.why("squares")[1] == "  input words: stage words gives another result, for reasons of its own"
    )


def test_why_of_removed_and_damaged_artifacts(tmp_path: Path, source: Path) -> None:
    plan = toys.toy_plan(tmp_path / "store", source)
    made = plan.build()
    shutil.rmtree(made["words"].path)
    (made["squares"].path / "squares.txt").write_text("0")
    assert states(plan) == ["missing", "damaged"]
    assert "its outputs were removed from the store" in plan.why("words")[1]
    assert plan.why("squares")[1] == "  in the store, squares.txt has 1 bytes, 81 were recorded"
    plan.build()
    assert states(plan) == ["fresh", "fresh"]


def test_verifying_status_reads_the_contents(tmp_path: Path, source: Path) -> None:
    plan = toys.toy_plan(tmp_path / "store", source)
    made = plan.build()
    (made["words"].path / "words.txt").write_text("B BRIDGE OVER THE RIVER\n")
    assert states(plan) == ["fresh", "fresh"]
    assert [s.state for s in plan.status(verify=True)] == ["damaged", "fresh"]


def test_unknown_and_repeated_labels(tmp_path: Path, source: Path) -> None:
    plan = toys.toy_plan(tmp_path / "store", source)
    with pytest.raises(WorkflowError, match="no stage 'ratio': it has words, squares"):
        plan.why("ratio")
    with pytest.raises(ValueError, match="two steps"):
        plan.add(toys.WORDS, {"text": source}, toys.Words(3))
    assert plan.add(toys.WORDS, {"text": source}, toys.Words(3), label="more").label == "more"
