"""Disks of random sizes that fill up: one line that names the place, and nothing half-written under a result's name."""

from __future__ import annotations

import csv
import shutil
import subprocess
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from arena import FAULTS, Arena
from kills import JOBS, digests, start

# Those whose results all go below one folder.
NAMES = ("maps --footprints", "simulate", "localize", "segment", "odometry", "import", "export", "evaluate")


PAGE = 4096


def bytes_of(folder: Path) -> int:
    """What the files below a folder take of a disk in memory."""
    return sum(-(-p.stat().st_size // PAGE) * PAGE for p in folder.rglob("*") if p.is_file())


def is_whole_table(path: Path) -> bool:
    text = path.read_text()
    rows = list(csv.reader(text.splitlines()))
    return text.endswith("\n") and len(rows) > 1 and len({len(row) for row in rows}) == 1


@pytest.mark.parametrize("name", NAMES)
def test_a_disk_that_fills_up_is_one_line(
    name: str,
    tmp_path: Path,
    arena: Arena,
    request: pytest.FixtureRequest,
    seed: int,
    kills: int,
    tally: Callable[..., None],
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    (tmp_path / "tmp").mkdir()
    place = disk / "place"
    place.mkdir()
    job = JOBS[name](place, request)
    start(job, place)
    assert arena.run("brmgeo", *job.words).kind == "accepted"
    whole = digests(job.out)
    high = bytes_of(place)
    shutil.rmtree(job.out)
    for path in place.glob(".brmgeo*"):
        shutil.rmtree(path, ignore_errors=True)
    sources = Path(shutil.copytree(place, tmp_path / "sources"))
    start(job, place)
    low = bytes_of(place) + PAGE
    rng = np.random.default_rng([seed, 4, zlib.crc32(name.encode())])
    counts: Counter[str] = Counter()
    faults = []
    for _ in range(2 * kills):
        size = low + int(rng.uniform(0.0, 1.0) * max(high - low, 8 * PAGE)) // PAGE * PAGE
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)], capture_output=True, text=True
        )
        if done.returncode != 0:
            pytest.skip(f"no small disk: {done.stderr.strip()} (it takes root)")
        try:
            shutil.copytree(sources, place)
            start(job, place)
            before = digests(job.out) if job.out.is_dir() else {}
            outcome = arena.run("brmgeo", *job.words)
            wrong = [f"{outcome.kind}: {outcome.said[-300:]}"] if outcome.kind in FAULTS else []
            if outcome.kind == "refused" and str(disk) not in outcome.said:
                wrong.append(f"the place is not named: {outcome.said[-300:]}")
            now = digests(job.out) if job.out.is_dir() else {}
            half = [n for n, v in now.items() if n.endswith((".tif", ".csv", ".gpkg", ".tum", ".png", ".toml"))
                    and outcome.kind == "refused" and n in whole and v not in (whole[n], before.get(n))]  # fmt: skip
            # A GeoPackage says when it was written, and flights.csv how long flights took.
            wrong += [
                f"{n} is half-written" for n in half
                if not n.endswith(".gpkg") and not (n == "flights.csv" and is_whole_table(job.out / n))
            ]  # fmt: skip
            wrong += [f"{n} is gone" for n in before if n not in now]
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        counts["tried"] += 1
        counts[outcome.kind] += 1
        counts["untidy"] += any("not named" in w for w in wrong)
        counts["lost"] += any("half-written" in w or "gone" in w for w in wrong)
        faults += [f"{size} bytes: {w}" for w in wrong]
    tally("full disk", name, **counts)
    assert not faults, "\n".join([f"STRESS_SEED={seed}", *faults])
