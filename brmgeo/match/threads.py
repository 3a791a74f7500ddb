"""Two threads for the heavy loops.

The kernels are serial numba that lets go of the interpreter lock; work is split here. numba's own parallel
loops are not used: their default scheduler must not be entered from two threads at once, and under load each
entry waits for all of its threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

THREADS = min(4, os.cpu_count() or 1)


@lru_cache(maxsize=1)
def pool() -> ThreadPoolExecutor:
    """The room's threads, started at first use."""
    return ThreadPoolExecutor(THREADS, thread_name_prefix="brmgeo-match")


def split(work: Callable[[int, int], None], count: int, least: int) -> None:
    """Call ``work(first, last)`` on ranges that cover ``count``, in threads when each gets at least ``least`` items."""
    parts = min(THREADS, count // max(least, 1))
    if parts < 2:
        work(0, count)
        return
    cuts = [count * k // parts for k in range(parts + 1)]
    list(pool().map(work, cuts[:-1], cuts[1:]))
