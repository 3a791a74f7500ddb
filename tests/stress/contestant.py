"""Runs cases that come as lines of JSON, in one process, and says how each ended.

The command's last door is not gone through: an exception that no message was written for is a fault.
"""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from pipelines.cli import cli, run

SPACE_BYTES = 10 << 30


def brmgeo(*words: str) -> None:
    cli(list(words), standalone_mode=False)


def recipe(path: str) -> None:
    from brmgeo.segment.recipe import read_recipe

    read_recipe(Path(path))


def saved(path: str, maps: str) -> None:
    from brmgeo.locate.localizer import Localizer
    from brmgeo.locate.maps import read_maps

    Localizer.load(path, read_maps(maps))


def decode(path: str) -> None:
    """Says what the decoder says of a picture, without brmgeo."""
    import cv2

    cv2.imread(path)


CALLS: dict[str, Callable[..., None]] = {"brmgeo": brmgeo, "recipe": recipe, "saved": saved, "decode": decode}


def peak_bytes() -> int:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) * 1024 if found else 0


def ended(call: str, words: list[str], said: Callable[[], str]) -> tuple[str, str]:
    """Kind and words of one case."""
    try:
        code = run(lambda: CALLS[call](*words))
    except MemoryError:
        return "memory", said() + traceback.format_exc()
    except BaseException:
        return "traceback", said() + traceback.format_exc()
    text = said()
    if code == 0:
        return "accepted", text
    if code == 70:
        return "traceback", text
    lines = [line for line in text.splitlines() if line.startswith("brmgeo")]
    return ("refused" if code == 2 and len(lines) == 1 else "untidy"), f"{text}\nexit {code}"


def main(scratch: Path) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (SPACE_BYTES, SPACE_BYTES))
    answers = os.fdopen(os.dup(1), "w")
    file = os.open(scratch / f"said-{os.getpid()}", os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)

    def said() -> str:
        sys.stdout.flush()
        sys.stderr.flush()
        return os.pread(file, 1 << 20, 0).decode(errors="replace")

    for line in sys.stdin:
        os.ftruncate(file, 0)
        Path("/proc/self/clear_refs").write_text("5")
        call, *words = json.loads(line)
        kind, text = ended(call, words, said)
        answers.write(json.dumps({"kind": kind, "said": text, "peak": peak_bytes()}) + "\n")
        answers.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
