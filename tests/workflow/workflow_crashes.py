"""Kills a run after each of its file-system calls in turn, and holds what the next run makes against a run in peace.

Usage: workflow_crashes.py FOLDER STRIDE: every STRIDE-th call is a place to die. The kill comes from a profiler's hook,
so the code under test knows nothing of it. Prints the number of crashes survived.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import signal
import sys
import traceback
from pathlib import Path
from types import FrameType
from typing import Any

from workflow_toys import toy_plan

from brmgeo.workflow.publish import publish
from brmgeo.workflow.store import RECORD

FILES = {"open", "close", "mkdir", "rename", "replace", "unlink", "rmdir", "flock"}
BYTES = {"write", "pwrite", "flush", "fsync", "sendfile", "ioctl", "ftruncate"}
CALLS = FILES | BYTES


def job(folder: Path, times: int) -> None:
    """The whole of a run: lock, build, publish."""
    plan = toy_plan(folder / "store", folder / "source.txt", times=times)
    with plan.store.lock("toy"):
        made = plan.build()
        publish(made["words"], folder / "out", ["words.txt", "parts"], print)
        publish(made["squares"], folder / "out", ["squares.txt"], print)


def job_killed_at(folder: Path, times: int, kill_at: int) -> bool:
    """Runs the job in a child that is killed after its file-system call number ``kill_at``; True when it was."""
    child = os.fork()
    if child == 0:
        count = 0

        def hook(frame: FrameType, event: str, function: Any) -> None:
            nonlocal count
            if event == "c_return" and function.__name__ in CALLS:
                count += 1
                if count == kill_at:
                    os.kill(os.getpid(), signal.SIGKILL)

        if kill_at:
            sys.setprofile(hook)
        try:
            job(folder, times)
        except BaseException:
            traceback.print_exc()
            os._exit(3)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return True
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"the run failed instead of finishing (kill_at={kill_at})")
    return False


def contents(folder: Path) -> dict[str, str]:
    """Digest of every result below a folder; records differ by their times and do not count."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD and not path.name.startswith(".brmgeo")
    }


def prepare(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "source.txt").write_text("a bridge over the river\n")
    os.utime(folder / "source.txt", (1e9, 1e9))
    if job_killed_at(
        folder, 2, 0
    ):  # results of earlier settings, longer than the new ones, are there already
        raise SystemExit("killed without a reason")


def main(root: Path, stride: int) -> None:
    prepare(root / "template")
    peace = root / "peace"
    shutil.copytree(root / "template", peace)
    old = contents(peace / "out")
    job_killed_at(peace, 1, 0)
    artifacts, new = contents(peace / "store" / "artifacts"), contents(peace / "out")
    assert len(new) == 7
    assert new != old
    crashes = 0
    for kill_at in itertools.count(1, stride):
        folder = root / "crash"
        shutil.copytree(root / "template", folder)
        if not job_killed_at(folder, 1, kill_at):
            break
        crashes += 1
        # What looks finished is finished, before anything is repaired.
        for name, digest in contents(folder / "store" / "artifacts").items():
            assert artifacts[name] == digest, name
        for path in (folder / "store" / "artifacts").glob("*/*"):
            assert (path / RECORD).is_file(), path
        for name, digest in contents(folder / "out").items():
            assert digest in (old.get(name), new.get(name)), name
        # A second crash at the same place changes nothing; then a run in peace ends as if nothing had been.
        job_killed_at(folder, 1, kill_at)
        job_killed_at(folder, 1, 0)
        assert contents(folder / "store" / "artifacts") == artifacts
        assert contents(folder / "out") == new
        assert not list((folder / "store" / "tmp").iterdir())
        assert not list((folder / "out").glob(".brmgeo-part*"))
        shutil.rmtree(folder)
    print(crashes)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
