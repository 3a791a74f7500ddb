"""Stages and functions for the workflow tests: at module level, so that workers in other processes can import them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import FlightError, InputError
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.schedule import look_around
from brmgeo.workflow.stage import Json, Map, Stage, unstated
from brmgeo.workflow.store import Store

CALLS: list[str] = []


def square(x: int) -> int:
    return x * x


def noise_block(seed: int) -> NDArray[np.float64]:
    """A block whose sums would show any change of order or rounding."""
    block = np.random.default_rng(seed).normal(size=(200, 300)).cumsum(axis=1)
    return np.asarray(np.sin(block) / (1 + seed))


def slow_square(x: int) -> int:
    time.sleep(0.05)
    return x * x


def refuse(x: int) -> int:
    if x == 3:
        raise FlightError("frames.csv line 7, column t_s: 'abc' is no number; write seconds")
    return x


def fail_with_os_error(x: int) -> int:
    if x == 3:
        raise OSError(28, "No space left on device", "/somewhere/full")
    return x


def process_of(x: int) -> int:
    return os.getpid()


def threads_of(x: int) -> str | None:
    return os.environ.get("NUMBA_NUM_THREADS")


def look_around_elsewhere(token: str) -> tuple[bool, str]:
    """As a worker on another machine answers, where the shared folder is not mounted."""
    return look_around(f"/another/machine/{token}")


def die(x: int) -> int:
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def die_once(item: tuple[int, str]) -> int:
    """Kills its worker the first time it meets item 3; ``item`` is a number and the file that remembers."""
    x, memory = item
    if x == 3 and not os.path.exists(memory):
        Path(memory).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


@dataclass(frozen=True, slots=True)
class Nothing:
    """Settings of a stage that has none."""


@dataclass(frozen=True, slots=True)
class Words:
    times: int = unstated(1)


@dataclass(frozen=True, slots=True)
class Noise:
    blocks: int


@dataclass(frozen=True, slots=True)
class Fill:
    chunks: int


def run_words(inputs: Mapping[str, Path], out: Path, settings: Words, map: Map) -> dict[str, Json]:
    """Upper-cases a source file; a folder with a file more."""
    CALLS.append("words")
    text = inputs["text"].read_text().upper() * settings.times
    (out / "words.txt").write_text(text)
    (out / "parts").mkdir()
    for index, word in enumerate(text.split()):
        (out / "parts" / f"{index}.txt").write_text(word)
    return {"words": len(text.split())}


def run_squares(inputs: Mapping[str, Path], out: Path, settings: Nothing, map: Map) -> dict[str, Json]:
    CALLS.append("squares")
    length = len((inputs["words"] / "words.txt").read_text())
    squares = list(map(square, range(length)))
    (out / "squares.txt").write_text("\n".join(str(s) for s in squares))
    return {"sum": sum(squares)}


def run_noise(inputs: Mapping[str, Path], out: Path, settings: Noise, map: Map) -> dict[str, Json]:
    CALLS.append("noise")
    blocks = list(map(noise_block, range(settings.blocks)))
    np.stack(blocks).tofile(out / "noise.bin")
    return {"mean": float(np.mean(blocks))}


def run_fill(inputs: Mapping[str, Path], out: Path, settings: Fill, map: Map) -> dict[str, Json]:
    with open(out / "big.bin", "wb") as handle:
        for _ in range(settings.chunks):
            handle.write(b"x" * 65536)
    return {}


def run_refuse(inputs: Mapping[str, Path], out: Path, settings: Nothing, map: Map) -> dict[str, Json]:
    (out / "half.txt").write_text("half")
    raise InputError("sheet 1.dxf: cut off at line 3; fetch it again")


WORDS = Stage("words", 1, run_words)
SQUARES = Stage("squares", 1, run_squares)
NOISE = Stage("noise", 1, run_noise)
FILL = Stage("fill", 1, run_fill)
REFUSE = Stage("refuse", 1, run_refuse)


def toy_plan(root: Path, source: Path, times: int = 1) -> Plan:
    """Two steps, the second of which eats the first."""
    plan = Plan(Store(root), "toy")
    words = plan.add(WORDS, {"text": source}, Words(times))
    plan.add(SQUARES, {"words": words}, Nothing())
    return plan
