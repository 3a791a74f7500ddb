"""How much memory there is, and a word before work begins that would take more."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from brmgeo.errors import InputError


def free_bytes() -> int | None:
    """Memory that this process may still take: what the machine has free, within the limits of its control group and
    its own (ulimit -v); None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text(encoding="ascii"))
        found.append(limit - int((group / "memory.current").read_text(encoding="ascii")))
    if sys.platform == "linux":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            with contextlib.suppress(OSError, ValueError):
                pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
                found.append(limit - pages * resource.getpagesize())
    return max(0, min(found)) if found else None


def require_memory(needed: float, what: str, instead: str) -> None:
    """InputError where ``needed`` bytes are more than there is: ``what`` would take them; ``instead`` says what to do."""
    free = free_bytes()
    if free is not None and needed > free:
        raise InputError(
            f"{what} takes about {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free: {instead}"
        )
