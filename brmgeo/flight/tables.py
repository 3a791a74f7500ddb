"""Strict reading of the numeric text tables that logs are written in: every refusal names file, line and column."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brmgeo.errors import FlightError
from brmgeo.files import told
from brmgeo.flight.readings import FloatArray
from brmgeo.settings import nearest


def refuse(
    path: Path, line: int | None, column: str | int | None, message: str, *, needs: str | None = None
) -> FlightError:
    """The FlightError ``path:line: column c: message``, to be raised by the caller."""
    where = str(path) if line is None else f"{path}:{line}"
    if column is not None:
        where += f": column {column}"
    return FlightError(f"{where}: {message}", needs=needs)


@dataclass(frozen=True, slots=True)
class Table:
    """Named columns of numbers and texts, with the line each row came from."""

    path: Path
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)

    def stack(self, *names: str) -> FloatArray:
        """(n, len(names)) float64."""
        return np.stack([self.numbers[name] for name in names], axis=-1)

    def check_times(self, column: str = "t_s") -> None:
        """Raises FlightError at the first time that is not later than the one before."""
        check_increasing(self.path, self.numbers[column], self.lines, column)

    def check_range(self, column: str, low: float, high: float, advice: str) -> None:
        """Raises FlightError at the first number outside [low, high]."""
        values = self.numbers[column]
        bad = np.flatnonzero((values < low) | (values > high))
        if bad.size:
            i = int(bad[0])
            raise refuse(
                self.path, self.lines[i], column, f"{values[i]:g} is not within {low:g} to {high:g}: {advice}"
            )


def check_increasing(path: Path, times: FloatArray, lines: Sequence[int], column: str | int) -> None:
    """Raises FlightError at the first time that is not later than the one before."""
    back = np.flatnonzero(np.diff(times) <= 0)
    if back.size:
        i = int(back[0]) + 1
        raise refuse(
            path,
            lines[i],
            column,
            f"time {times[i]:.6f} s does not follow {times[i - 1]:.6f} s: rows must be in order of time, each once",
        )


def number(path: Path, line: int, column: str | int, text: str) -> float:
    """The finite number in a cell; FlightError for anything else."""
    text = text.strip()
    if not text:
        raise refuse(path, line, column, "the value is missing: fill it in or leave the whole column out")
    try:
        # float() takes "1_000" and digits of other scripts, which no log writes on purpose.
        value = float(text) if "_" not in text and text.isascii() else math.nan
    except ValueError:
        raise refuse(path, line, column, f"{text[:40]!r} is not a number") from None
    if not math.isfinite(value):
        raise refuse(path, line, column, f"{text[:40]!r} is not a finite number: remove the row")
    return value


def read_text(path: Path) -> str:
    """A UTF-8 text file; FlightError when it is missing, unreadable or not text."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise refuse(path, None, None, "the file is missing") from None
    except OSError as error:
        raise refuse(path, None, None, f"the file cannot be read ({told(error)})") from None
    except UnicodeDecodeError as error:
        raise refuse(
            path, None, None, f"byte {error.start} is not UTF-8 text: is this another format?"
        ) from None


def read_table(
    path: Path, choices: Sequence[Sequence[str]], optional: Sequence[str] = (), text: Sequence[str] = ()
) -> Table:
    """A CSV file with a header.

    Args:
        choices: sets of required columns; the header must hold one of them whole.
        optional: columns that may be there besides.
        text: those columns that are texts, not numbers.
    """
    rows = csv.reader(read_text(path).splitlines())
    try:
        header = [name.strip() for name in next(rows, [])]
    except csv.Error as error:
        raise refuse(path, 1, None, f"not CSV ({error})") from None
    known = list(dict.fromkeys([name for choice in choices for name in choice] + list(optional)))
    wanted = " or ".join(",".join(choice) for choice in choices)
    if not any(header):
        raise refuse(path, 1, None, f"the header is missing: the first line must be {wanted}")
    for i, name in enumerate(header):
        if name not in known:
            raise refuse(path, 1, i + 1, f"{name[:40]!r} is no column of this file: {nearest(name, known)}")
        if name in header[:i]:
            raise refuse(path, 1, i + 1, f"column {name!r} is there twice")
    if not any(set(choice) <= set(header) for choice in choices):
        missing = [name for name in choices[0] if name not in header]
        raise refuse(path, 1, None, f"no column {', '.join(missing)}: the header must hold {wanted}")

    cells: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise refuse(
                    path,
                    rows.line_num,
                    min(len(row), len(header)) + 1,
                    f"{len(row)} cells where the header has {len(header)}",
                )
            cells.append(row)
            lines.append(rows.line_num)
    except csv.Error as error:
        raise refuse(path, rows.line_num, None, f"not CSV ({error})") from None
    if not cells:
        raise refuse(path, 2, None, "no row follows the header")
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, list[str]] = {}
    for i, name in enumerate(header):
        if name in text:
            texts[name] = [row[i].strip() for row in cells]
        else:
            numbers[name] = np.array([number(path, line, name, row[i]) for line, row in zip(lines, cells)])
    return Table(path, numbers, texts, lines)


def read_times(path: Path) -> FloatArray:
    """(n,) float64 seconds of a text file whose first column is the time (KITTI's times.txt, TUM's rgb.txt).

    Raises FlightError where it is missing, holds no numbers, or the times do not increase.
    """
    cells, lines = read_rows(path, None, range(1, 100))
    times = np.array([number(path, line, 1, row[0]) for line, row in zip(lines, cells)])
    check_increasing(path, times, lines, 1)
    return times


def is_header(row: Sequence[str]) -> bool:
    """True for eight cells and more that all begin with a letter: names of columns."""
    return len(row) >= 8 and all(cell.strip()[:1].isalpha() for cell in row)


def read_rows(path: Path, separator: str | None, widths: range) -> tuple[list[list[str]], list[int]]:
    """Cells and line numbers of a table of numbers; '#' lines, blank lines and a first row of names alone are left out.

    Args:
        separator: ',' (one trailing comma is let pass) or None for white space.
        widths: numbers of cells a row may have; all rows must have the same.
    """
    cells: list[list[str]] = []
    lines: list[int] = []
    for i, raw in enumerate(read_text(path).splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        row = line.removesuffix(",").split(",") if separator else line.split()
        if not cells and is_header(row):
            continue
        expected = range(len(cells[0]), len(cells[0]) + 1) if cells else widths
        if len(row) not in expected:
            wanted = str(expected[0]) if len(expected) == 1 else f"{expected[0]} to {expected[-1]}"
            between = "commas" if separator else "white space"
            raise refuse(
                path, i, len(row), f"{len(row)} values between {between} where the format has {wanted}"
            )
        cells.append(row)
        lines.append(i)
    if not cells:
        raise refuse(path, None, None, "no row of numbers is in the file")
    return cells, lines
