"""One damaged file after the other through the command: what is done to it, how it ended, and what failed kept for later."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from arena import FAULTS, Arena, Outcome
from formats import OUT, Seed

Damage = Callable[[bytes, np.random.Generator], tuple[str, bytes]]
# What a reader says of rows, outlines or pictures that it did not take, with how many.
_TOLD = re.compile(
    r"\d.*(left out|lost|damaged|could not|cannot|not be read|unread|skipped|cut short|dropped|missing|not valid|"
    r"repaired|gaps?\b)"
    r"|(left out|lost|damaged|could not|cannot|unread|skipped|cut short|dropped|missing|repaired|warning).*\d",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Case:
    """A damaged file and how the command ended on it; ``lost`` says what was lost without a word."""

    file: Path
    way: str
    data: bytes
    outcome: Outcome
    lost: str = ""


def _words(seed: Seed, out: Path) -> list[str]:
    return [str(w).replace(OUT, str(out)) for w in seed.words]


def _clear(out: Path) -> None:
    for path in out.parent.glob(f"*{out.name}*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def cases(
    seed: Seed, arena: Arena, folder: Path, rng: np.random.Generator, count: int, damage: Damage
) -> Iterator[Case]:
    """Damages one of the files ``count`` times; the sound ones must be accepted first."""
    out = folder / "results" / "out"
    out.parent.mkdir()
    kept = [(path, Path(shutil.copytree(path, folder / f"kept{i}"))) for i, path in enumerate(seed.kept)]
    sound = arena.run(seed.call, *_words(seed, out))
    assert sound.kind == "accepted", sound.said
    wanted = seed.counts(out) if seed.counts else {}
    before = set(sound.said.splitlines())
    for _ in range(count):
        _clear(out)
        for path, whole in kept:
            shutil.rmtree(path)
            shutil.copytree(whole, path)
        file = seed.files[int(rng.integers(len(seed.files)))]
        whole_bytes = file.read_bytes()
        way, data = damage(whole_bytes, rng)
        file.write_bytes(data)
        try:
            outcome = arena.run(seed.call, *_words(seed, out))
        finally:
            file.write_bytes(whole_bytes)
        lost = ""
        if outcome.kind == "accepted" and seed.counts:
            found = seed.counts(out)
            told = any(_TOLD.search(line) for line in set(outcome.said.splitlines()) - before)
            less = [
                f"{n}: {found.get(n, 0)} of {w}" for n, w in wanted.items() if found.get(n, 0) < 0.95 * w - 1
            ]
            lost = "" if told else ", ".join(less)
        yield Case(file, way, data, outcome, lost)


def counted(
    part: str, name: str, seed: Seed, found: Iterator[Case], keep: Path
) -> tuple[Counter[str], list[str]]:
    """Counts of how cases ended, and a line on each that failed; its file and how to repeat it lie below ``keep``."""
    counts: Counter[str] = Counter()
    faults = []
    for number, case in enumerate(found):
        counts["tried"] += 1
        counts[case.outcome.kind] += 1
        counts["lost"] += bool(case.lost)
        if case.outcome.kind not in FAULTS and not case.lost:
            continue
        kind = "lost" if case.lost else case.outcome.kind
        there = keep / "-".join(re.sub(r"\W+", "-", f"{part} {name}").split("-")) / f"{number:03d}-{kind}"
        shutil.rmtree(there, ignore_errors=True)
        there.mkdir(parents=True)
        (there / case.file.name).write_bytes(case.data)
        said = case.outcome.said[-20_000:]
        (there / "again.txt").write_text(
            f"{case.way} of {case.file}; put {case.file.name} in its place and run\n"
            f"{seed.call} {' '.join(map(str, seed.words))}\n\n{case.lost}\n{said}\n"
        )
        last = (case.lost or said.strip().splitlines()[-1] if said.strip() or case.lost else "")[:200]
        faults.append(f"{there}: {case.way}: {last}")
    return counts, faults
