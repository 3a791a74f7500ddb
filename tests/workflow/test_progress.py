"""Progress: few plain lines without a terminal, a bar on one."""

from __future__ import annotations

import contextlib
import io
import os
import pty

import pytest
import workflow_toys as toys

from brmgeo.workflow.progress import Progress, duration
from brmgeo.workflow.schedule import serial_map


def test_plain_lines_are_few() -> None:
    stream = io.StringIO()
    progress = Progress(stream)
    with progress.stage("ratio") as bar:
        assert list(bar.watch(serial_map)(toys.square, range(1000))) == [x * x for x in range(1000)]
    lines = stream.getvalue().splitlines()
    assert lines[0] == "ratio: start"
    assert lines[-1].startswith("ratio: done, 1000 items, ")
    assert len(lines) == 2


def test_slow_stages_tell_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(range(0, 10_000, 2))
    monkeypatch.setattr("brmgeo.workflow.progress.time.monotonic", lambda: float(next(now)))
    stream = io.StringIO()
    with Progress(stream).stage("ratio") as bar:
        list(bar.watch(serial_map)(toys.square, range(10)))
    # Two seconds an item, one line in each five seconds.
    assert stream.getvalue().splitlines()[1:-1] == [
        "ratio: 3 of 10, 14 s left",
        "ratio: 6 of 10, 8.0 s left",
        "ratio: 9 of 10, 2.0 s left",
    ]


def test_quiet_says_nothing_and_a_failed_stage_is_not_done() -> None:
    stream = io.StringIO()
    with Progress(stream, quiet=True).stage("ratio"):
        pass
    assert stream.getvalue() == ""
    progress = Progress(stream)
    with pytest.raises(KeyError), progress.stage("ratio"):
        raise KeyError
    assert stream.getvalue() == "ratio: start\n"
    assert progress.ran == []


def test_terminal_shows_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    main, side = pty.openpty()
    with os.fdopen(side, "w") as stream, Progress(stream).stage("ratio") as bar:
        list(bar.watch(serial_map)(toys.slow_square, range(8)))
    seen = b""
    with contextlib.suppress(OSError), os.fdopen(main, "rb", buffering=0) as screen:  # EIO is its end
        while block := screen.read(4096):
            seen += block
    assert "━" in seen.decode()
    assert b"8/8" in seen
    assert b"ratio: done, 8 items, " in seen.splitlines()[-1]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.96, "10 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (185, "3 min 05 s"),
        (7800, "2 h 10 min"),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
