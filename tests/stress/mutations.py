"""Damaged files of every format: accepted, or refused in one line; never a traceback, a hang, a crash or much memory."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from arena import Arena
from cases import cases, counted
from conftest import out
from damage import damaged
from formats import FORMATS, seed_of


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_accepted_or_refused_in_one_line(
    name: str,
    tmp_path: Path,
    arena: Arena,
    request: pytest.FixtureRequest,
    seed: int,
    size: int,
    tally: Callable[..., None],
) -> None:
    made = seed_of(name, tmp_path / "seed", request)
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    found = cases(made, arena, tmp_path, rng, size, lambda data, rng: damaged(data, rng, made.text))
    counts, faults = counted("damaged", name, made, found, out())
    counts["lost"] = 0  # what was cut off cleanly tells nobody; losses.py damages records in place
    tally("damaged", name, **counts)
    bad = [line for line in faults if "-lost:" not in line]
    assert not bad, "\n".join([f"STRESS_SEED={seed}", *bad])
