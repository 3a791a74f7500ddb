"""What a person sees while stages run: a bar with the time left on a terminal, a few plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from brmgeo.workflow.stage import Map, R, T

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

_EVERY_S = 5.0


class Progress:
    """Shows stages on ``stream`` (stderr by default).

    On a terminal that is a bar; elsewhere a line at a stage's start and end, and at most one each five seconds
    between. With ``quiet`` nothing is shown.
    """

    def __init__(self, stream: TextIO | None = None, quiet: bool = False) -> None:
        self._stream = stream or sys.stderr
        self._quiet = quiet
        self.ran: list[str] = []
        self.skipped: list[str] = []

    def fresh(self, label: str) -> None:
        """Notes a stage that needs no work."""
        self.skipped.append(label)

    def say(self, line: str) -> None:
        """Writes one line."""
        if not self._quiet:
            print(line, file=self._stream, flush=True)

    @contextmanager
    def stage(self, label: str) -> Iterator[Bar]:
        """Shows one stage while the body runs it."""
        start = time.monotonic()
        if self._quiet or not self._stream.isatty():
            self.say(f"{label}: start")
            bar = Bar(label, self.say)
            yield bar
        else:
            with _terminal_bar(self._stream) as rich:
                bar = Bar(label, self.say, rich)
                yield bar
        self.ran.append(label)
        count = f"{bar.done} items, " if bar.done > 1 else ""
        self.say(f"{label}: done, {count}{duration(time.monotonic() - start)}")


class Bar:
    """The progress of one stage; ``watch`` makes its ``map`` report here."""

    def __init__(self, label: str, say: Callable[[str], None], rich: RichProgress | None = None) -> None:
        self.done = 0
        self._label = label
        self._say = say
        self._said = time.monotonic()
        self._rich = rich
        self._task = rich.add_task(label, total=None) if rich else None

    def update(self, done: int, total: int) -> None:
        """Shows that ``done`` of ``total`` items are done, for work that is not mapped."""
        self.done = done
        now = time.monotonic()
        if self._rich and self._task is not None:
            self._rich.update(self._task, completed=done, total=total)
        elif now - self._said >= _EVERY_S and done < total:
            self._said = now
            self._say(f"{self._label}: {done} of {total}")

    def watch(self, map: Map) -> Map:
        """``map``, telling the bar of each result."""

        def watched(function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]:
            work = list(items)
            start = said = time.monotonic()
            if self._rich and self._task is not None:
                self._rich.reset(self._task, total=len(work))
            for count, result in enumerate(map(function, work), start=1):
                self.done += 1
                now = time.monotonic()
                if self._rich and self._task is not None:
                    self._rich.update(self._task, completed=count)
                elif now - said >= _EVERY_S and count < len(work):
                    said = now
                    left = (now - start) / count * (len(work) - count)
                    self._say(f"{self._label}: {count} of {len(work)}, {duration(left)} left")
                yield result

        return watched


@contextmanager
def _terminal_bar(stream: TextIO) -> Iterator[RichProgress]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<14}"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(file=stream), transient=True) as rich:
        yield rich


def duration(seconds: float) -> str:
    """A duration as a person writes it: 0.4 s, 12 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
