"""Commands killed at random moments: nothing is half-written or lost, and the next run ends as if nothing had been.

What two undisturbed runs write alike must be the same after a kill and a second run. SIGTERM also cleans up at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import log_writers
import numpy as np
import psutil
import pytest
from arena import ROOT
from small_maps import make_source
from small_recipes import TINY

from brmgeo.files import WRITTEN

END_S = 30.0
# These tell how long things took, or how far a run has come.
TIMED = {"report.html", "metrics.json", "flights.csv", "summary.md"}
PROGRESS = {"masks.json", WRITTEN}


@dataclass(frozen=True)
class Job:
    """A command whose results are ``out``; ``first`` stands there before it runs, ``again``: whether it may replace."""

    words: Sequence[object]
    out: Path
    first: Path | None = None
    again: bool = True
    own: str = ""  # a file of the user's that may lie among the results
    work: Sequence[Path] = ()  # what else it writes, taken away before a run from the start
    scheduler: str = "serial"


Make = Callable[[Path, pytest.FixtureRequest], Job]


def maps_of_a_region(folder: Path, request: pytest.FixtureRequest) -> Job:
    region = make_source(folder / "data")
    words = ("maps", "small", "--data", region.data)
    return Job(words, region.out, own="my own.qgz", work=(region.data / "work",), scheduler="local")


def _map_files(folder: Path, request: pytest.FixtureRequest) -> Job:
    from formats import CRS, houses

    houses().to_file(folder / "t.gpkg")
    words = ("maps", "--footprints", folder / "t.gpkg", "--crs", CRS, "--gsd", 1, "--out", folder / "out")
    return Job(words, folder / "out", own="mine.txt")


def _simulate(folder: Path, request: pytest.FixtureRequest) -> Job:
    words = ("simulate", "--maps", request.getfixturevalue("maps"), "--out", folder / "out")
    return Job((*words, "--path", request.getfixturevalue("waypoints")), folder / "out")


def _simulate_count(folder: Path, request: pytest.FixtureRequest) -> Job:
    job = _simulate(folder, request)
    return Job((*job.words, "--mode", "masks", "--count", 3), job.out, scheduler="local")


def _localize(folder: Path, request: pytest.FixtureRequest) -> Job:
    words = (
        "localize",
        "--maps",
        request.getfixturevalue("maps"),
        "--flight",
        request.getfixturevalue("whole"),
    )
    return Job((*words, "--method", "ratio", "--out", folder / "out"), folder / "out")


def _segment(folder: Path, request: pytest.FixtureRequest) -> Job:
    words = ("segment", request.getfixturevalue("pictured"), "--weights", request.getfixturevalue("weights"))
    return Job((*words, "--out", folder / "out"), folder / "out")


def _odometry(folder: Path, request: pytest.FixtureRequest) -> Job:
    words = ("odometry", folder / "out", "--method", "vio")
    return Job(words, folder / "out", first=request.getfixturevalue("filmed"))


def _import(folder: Path, request: pytest.FixtureRequest) -> Job:
    bag = log_writers.bag(folder / "b", "mcap")
    return Job(("import", bag, "--out", folder / "out"), folder / "out", again=False)


def _export(folder: Path, request: pytest.FixtureRequest) -> Job:
    results = request.getfixturevalue("located") / "paper"
    out = folder / "out"
    return Job(("export", results, "--path", "candidates", "--out", out / "c.gpkg"), out, own="mine.txt")


def _evaluate(folder: Path, request: pytest.FixtureRequest) -> Job:
    words = (
        "evaluate",
        "--maps",
        request.getfixturevalue("maps"),
        "--flights",
        2,
        "--methods",
        "ratio,paper",
    )
    words = (*words, "--path", request.getfixturevalue("waypoints"), "--out", folder / "out")
    return Job(words, folder / "out", scheduler="local")


def _train(folder: Path, request: pytest.FixtureRequest) -> Job:
    recipe = folder / "tiny.toml"
    recipe.write_text(TINY.split('[[source]]\nname = "flown"')[0])
    words = ("train", "--recipe", recipe, "--data", folder / "data", "--threads", 1, "--out", folder / "out")
    return Job(words, folder / "out")


JOBS: dict[str, Make] = {
    "maps": maps_of_a_region, "maps --footprints": _map_files, "simulate": _simulate, "simulate --count": _simulate_count,
    "localize": _localize, "segment": _segment, "odometry": _odometry, "import": _import, "export": _export,
    "evaluate": _evaluate, "train": _train,
}  # fmt: skip


class Run:
    """One process of the command, with a temporary folder and a session of its own."""

    def __init__(self, job: Job, folder: Path) -> None:
        self.temporary = folder / "tmp"
        self.temporary.mkdir(exist_ok=True)
        self.said = folder / "said.txt"
        env = os.environ | {
            "SCHEDULER": job.scheduler,
            "TMPDIR": str(self.temporary),
            "PYTHONPATH": str(ROOT),
        }
        with open(self.said, "wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "brmgeo", *map(str, job.words)],
                stdin=subprocess.DEVNULL, stdout=file, stderr=file, env=env, cwd=folder, start_new_session=True,
            )  # fmt: skip

    def family(self) -> list[psutil.Process]:
        """All that still run and come of this run."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if os.getsid(process.pid) == self.process.pid and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def wait(self, within_s: float) -> int | None:
        """Exit status; None, and killed, where there is none in time."""
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            for process in self.family():
                with contextlib.suppress(psutil.Error):
                    process.kill()
            self.process.wait()
            return None

    def orphans(self) -> list[str]:
        """Names of what outlives the run by ten seconds; they are ended."""
        _, alive = psutil.wait_procs(self.family(), timeout=10.0)
        names = [p.name() for p in alive]
        for process in alive:
            with contextlib.suppress(psutil.Error):
                process.kill()
        return names


def digests(out: Path) -> dict[str, str]:
    """Every result by name; what begins with a dot is none."""
    return {
        str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(out.rglob("*"))
        if p.is_file() and not any(part.startswith(".") for part in p.relative_to(out).parts)
    }


def litter(folder: Path) -> list[str]:
    """Scratch of ours in a job's folder, and anything in its temporary one."""
    found = [*folder.rglob(".brmgeo-part-*"), *(folder / "tmp").iterdir(), *folder.glob("data/work/tmp/*")]
    return sorted({str(p.relative_to(folder)) for p in found})


def start(job: Job, folder: Path) -> None:
    """Puts a job's folder back to where nothing has run."""
    for path in (job.out, *job.work):
        shutil.rmtree(path, ignore_errors=True)
    if job.first is not None:
        shutil.copytree(job.first, job.out)
    if job.own:
        job.out.mkdir(parents=True, exist_ok=True)
        (job.out / job.own).write_text("mine")
    for path in folder.rglob(".brmgeo-part-*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.rmtree(folder / "tmp", ignore_errors=True)


def _age(folder: Path) -> None:
    """Two hours go by."""
    then = time.time() - 7200.0
    for path in (p for name in litter(folder) for p in (folder / name, *(folder / name).rglob("*"))):
        os.utime(path, (then, then), follow_symlinks=False)


def _undisturbed(job: Job, folder: Path) -> tuple[dict[str, str], set[str], float]:
    """Digests of the results that do not differ between two runs, the names of all, and how long a run takes."""
    found = []
    for _ in range(2):
        start(job, folder)
        begun = time.monotonic()
        run = Run(job, folder)
        assert run.wait(300.0) == 0, run.said.read_text()
        seconds = time.monotonic() - begun
        found.append(digests(job.out))
    same = {n: v for n, v in found[0].items() if found[1].get(n) == v and Path(n).name not in TIMED}
    return same, set(found[0]), seconds


def _killed(
    job: Job, folder: Path, how: signal.Signals, wait_s: float, same: dict[str, str], old: bool
) -> list[str]:
    """What is wrong after a kill and after the run that follows; empty where nothing is."""
    wrong = []
    if not old or not job.again:
        start(job, folder)
    before = digests(job.out)
    run = Run(job, folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        run.process.wait(wait_s)
    run.process.send_signal(how)
    status = run.wait(END_S)
    text = run.said.read_text(errors="replace")
    if status is None:
        return [f"no end {END_S:.0f} s after {how.name}"]
    if status not in (0, -how, 128 + how, 130) or "Traceback" in text:
        wrong.append(f"exit {status}: {text.strip().splitlines()[-1:]}")
    if names := run.orphans():
        wrong.append(f"still running: {names}")
    now = digests(job.out)
    for name, value in same.items():
        if name in now and name not in PROGRESS and now[name] not in (value, before.get(name)):
            wrong.append(f"{name} is half-written")
    wrong += [f"{name} is gone" for name in before if name not in now]
    if how is signal.SIGTERM and status != 0:
        wrong += [f"{name} stays after SIGTERM" for name in litter(folder)]
    _age(folder)
    # What may not be replaced and is whole already has no next run: it would be refused, and rightly.
    if job.again or any(now.get(name) != value for name, value in same.items()):
        run = Run(job, folder)
        if (status := run.wait(300.0)) != 0:
            return [
                *wrong,
                f"the next run ends with {status}: {run.said.read_text().strip().splitlines()[-1:]}",
            ]
    now = digests(job.out)
    wrong += [f"{name} differs after the next run" for name, value in same.items() if now.get(name) != value]
    wrong += [f"{name} stays after the next run" for name in litter(folder)]
    if job.own and (job.out / job.own).read_text() != "mine":
        wrong.append(f"the user's {job.own} is gone")
    return wrong


@pytest.mark.parametrize("name", JOBS)
def test_killed_commands_leave_nothing_half_done(
    name: str,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    seed: int,
    kills: int,
    tally: Callable[..., None],
) -> None:
    job = JOBS[name](tmp_path, request)
    (tmp_path / "beside.txt").write_text("mine")
    rng = np.random.default_rng([seed, 3, zlib.crc32(name.encode())])
    same, _, seconds = _undisturbed(job, tmp_path)
    counts: Counter[str] = Counter()
    faults = []
    for number in range(kills):
        how = signal.SIGTERM if number % 2 else signal.SIGKILL
        moment = float(rng.uniform(0.0, 1.0)) * seconds
        # Every other pair of kills meets results that are there already.
        wrong = _killed(job, tmp_path, how, moment, same, old=number % 4 >= 2)
        counts["tried"] += 1
        counts["hang"] += any("no end" in w for w in wrong)
        counts["traceback"] += any("Traceback" in w or "exit 1" in w for w in wrong)
        counts["lost"] += any("gone" in w or "half-written" in w or "differs" in w for w in wrong)
        counts["untidy"] += any("stays" in w or "still running" in w for w in wrong)
        counts["accepted"] += not wrong
        faults += [f"{how.name} after {moment:.2f} s of {seconds:.2f} s: {w}" for w in wrong]
    assert (tmp_path / "beside.txt").read_text() == "mine"
    tally("killed", name, **counts)
    assert not faults, "\n".join([f"STRESS_SEED={seed}", *faults])
