"""A process that runs cases of the command one after the other, and a watchdog over it that outlives hangs and crashes."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).resolve().parents[2]
HANG_S = 30.0
BUSY_S = 120.0  # where others have the processor
MEMORY_BYTES = 3 << 30  # of a case on inputs of some kilobytes
FAULTS = ("untidy", "traceback", "hang", "memory", "crash")


@dataclass(frozen=True)
class Outcome:
    """How a case ended: accepted, refused, long (stopped while it told how long it takes), or one of FAULTS.

    With what it said, its seconds, and its bytes of memory at most.
    """

    kind: str
    said: str = ""
    seconds: float = 0.0
    peak: int = 0


class Arena:
    """One process of ``contestant.py``, started anew after a case that it did not survive."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Arena:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> int | None:
        if self._process is None:
            return None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()
        code, self._process = self._process.returncode, None
        return code

    def _start(self) -> subprocess.Popen[str]:
        self.scratch.mkdir(parents=True, exist_ok=True)
        env = os.environ | {
            "SCHEDULER": "serial",
            "OMP_NUM_THREADS": "2",
            "TMPDIR": str(self.scratch),
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        }
        return subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("contestant.py")), str(self.scratch)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=env,
            cwd=self.scratch,
            start_new_session=True,
        )

    def _worked_s(self) -> float:
        """Seconds of processor that the process has had."""
        with contextlib.suppress(psutil.Error):
            times = psutil.Process(self._process.pid if self._process else None).cpu_times()
            return float(times.user + times.system)
        return math.inf

    def run(self, call: str, *words: object, within_s: float = HANG_S) -> Outcome:
        """Runs one of ``contestant.CALLS`` with these words."""
        if self._process is None or self._process.poll() is not None:
            self._end()
            self._process = self._start()
            within_s += 90.0  # the first one imports and compiles
        begun = time.monotonic()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([call, *map(str, words)]) + "\n")
        self._process.stdin.flush()
        worked = self._worked_s()
        ready: list[object] = []
        while not ready and (seconds := time.monotonic() - begun) < max(within_s, BUSY_S):
            if seconds > within_s and self._worked_s() - worked > within_s:
                break
            ready, _, _ = select.select([self._process.stdout], [], [], 1.0)
        seconds = time.monotonic() - begun
        if not ready:
            said = (self.scratch / f"said-{self._process.pid}").read_text(errors="replace")
            self._end()
            kind = "long" if re.search(r"\d of \d.* left$", said, re.MULTILINE) else "hang"
            return Outcome(kind, f"{said}\nno end within {seconds:.0f} s", seconds)
        line = self._process.stdout.readline()
        if not line:
            code = self._end()
            return Outcome("crash", f"the process ended with {code}", seconds)
        answer: dict[str, Any] = json.loads(line)
        kind = answer["kind"]
        if kind in ("accepted", "refused") and answer["peak"] > MEMORY_BYTES:
            kind = "memory"
        return Outcome(kind, answer["said"], seconds, answer["peak"])
