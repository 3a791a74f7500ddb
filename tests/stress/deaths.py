"""Dask workers that die, and schedulers that never answer: every wait has an end and a word."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arena import ROOT
from kills import Job, Run, maps_of_a_region

END_S = 90.0  # for a whole run, with what it had to do before; of dead workers it waits a minute for new ones


@pytest.fixture
def job(tmp_path: Path, request: pytest.FixtureRequest) -> Job:
    return maps_of_a_region(tmp_path, request)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a scheduler, and its two workers, which nobody starts again."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    dask = [sys.executable, "-m", "dask"]
    (tmp_path / "cluster").mkdir()
    options = {
        "env": env,
        "cwd": tmp_path / "cluster",
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    address = f"tcp://127.0.0.1:{port}"
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"], **options
    )  # type: ignore[call-overload]
    words = ["--no-nanny", "--nthreads", "1", "--no-dashboard"]
    workers = [subprocess.Popen([*dask, "worker", address, *words], **options) for _ in range(2)]  # type: ignore[call-overload]
    time.sleep(6.0)
    try:
        yield address, workers
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()


def ended(job: Job, folder: Path, within_s: float, meanwhile: Callable[[Run], None]) -> tuple[str, str]:
    run = Run(job, folder)
    meanwhile(run)
    begun = time.monotonic()
    status = run.wait(within_s)
    text = run.said.read_text(errors="replace")
    kind = "hang" if status is None else {0: "accepted", 2: "refused"}.get(status, "traceback")
    return kind, f"{kind} {time.monotonic() - begun:.0f} s after that: {text[-600:]}"


@pytest.mark.parametrize("dying", [1, 2])
def test_dead_workers_are_told(
    job: Job,
    cluster: tuple[str, list[subprocess.Popen[bytes]]],
    tmp_path: Path,
    dying: int,
    seed: int,
    tally: Callable[..., None],
) -> None:
    address, workers = cluster
    moment = float(np.random.default_rng([seed, 5, dying]).uniform(0.0, 4.0))

    def kill(run: Run) -> None:
        # The workers have begun, or are about to.
        while run.process.poll() is None and "imagery: start" not in run.said.read_text():
            time.sleep(0.05)
        with contextlib.suppress(subprocess.TimeoutExpired):
            run.process.wait(moment)
        for worker in workers[:dying]:
            os.kill(worker.pid, signal.SIGKILL)

    kind, told = ended(replace(job, scheduler=address), tmp_path, END_S + 60.0 * (dying == 1), kill)
    tally("dying workers", f"{dying} of 2, after {moment:.1f} s", tried=1, **{kind: 1})
    assert kind in (("accepted",) if dying == 1 else ("refused", "accepted")), told


def test_a_scheduler_that_never_answers_is_told(job: Job, tmp_path: Path, tally: Callable[..., None]) -> None:
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen(16)
        held: list[socket.socket] = []

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    held.append(mute.accept()[0])

        threading.Thread(target=accept, daemon=True).start()
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        kind, told = ended(replace(job, scheduler=address), tmp_path, END_S, lambda run: None)
    tally("dying workers", "a scheduler that never answers", tried=1, **{kind: 1})
    assert kind == "refused", told
