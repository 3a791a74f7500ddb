"""Memory that is asked for before it is taken."""

from __future__ import annotations

import subprocess
import sys

import pytest

from brmgeo.errors import InputError
from brmgeo.memory import free_bytes, require_memory


def test_what_is_too_much_is_said_with_both_figures() -> None:
    require_memory(1e6, "a.dxf of 1 MB", "cut it")
    with pytest.raises(
        InputError, match=r"^a\.dxf takes about 1000000\.0 GB of memory, and [\d.]+ GB are free: cut it$"
    ):
        require_memory(1e15, "a.dxf", "cut it")


@pytest.mark.skipif(sys.platform != "linux", reason="ulimit -v is of Linux")
def test_the_process_s_own_limit_counts() -> None:
    program = (
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30));"
        "from brmgeo.memory import free_bytes; print(free_bytes())"
    )
    got = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert 0 < int(got.stdout) < 1 << 30
    assert (free_bytes() or 0) > int(got.stdout)
