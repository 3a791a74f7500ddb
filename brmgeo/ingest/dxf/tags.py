"""A text DXF as tags: group codes and values, found by a few numpy passes over its bytes."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, one_line
from brmgeo.extras import extra
from brmgeo.files import told
from brmgeo.memory import require_memory

_NAME_BYTES = 64
_BYTES_A_VALUE = 200
# What reading takes at its peak, measured, per byte of a file of nothing but vertices.
_TIMES_READ = 32
_BINARY_DXF = b"AutoCAD Binary DXF"


def text_of(path: Path) -> bytes:
    """The bytes of a text DXF; raises InputError, in one line, for what is none."""
    try:
        require_memory(
            _TIMES_READ * path.stat().st_size,
            f"{path.name} of {path.stat().st_size / 1e6:.0f} MB",
            "save the layers that you need, or parts of the drawing, as files of their own",
        )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {told(error)}") from error
    if not data.strip():
        raise InputError(f"{path.name}: the file is empty: export or download the sheet again")
    if re.match(rb"AC1\d\d\d", data):
        raise InputError(
            f"{path.name}: this is a DWG drawing, not a DXF: save it as DXF (R12 to R2018) first"
        )
    if data[:4] == b"PK\x03\x04":
        raise InputError(f"{path.name}: this is a zip archive: unpack it and give the .dxf inside")
    if data.startswith(_BINARY_DXF):
        with extra("maps", "reading a binary DXF"):
            from ezdxf.filemanagement import readfile
        try:
            stream = io.StringIO()
            readfile(path).write(stream)
        except Exception as error:  # ezdxf raises many kinds on damaged binary files
            reason = one_line(error, 120)
            raise InputError(
                f"{path.name}: binary DXF, damaged or cut short ({reason}): export the sheet again"
            ) from error
        return stream.getvalue().encode("utf-8", errors="replace")
    return data.removeprefix(b"\xef\xbb\xbf")


class Tags:
    """A text DXF as tags: group codes and where in the bytes their values lie, and entities as ranges of tags.

    Attributes:
        codes: (n,) int32 group codes, up to and without EOF.
        starts, ends: (n,) int64, value i is ``data[starts[i]:ends[i]]``, blanks at both ends left out.
        heads: (m,) int64 tags with code 0, each the start of an entity, then n.
        types: (m,) S, their values.
        entities, blocks: half-open ranges of heads: section ENTITIES and section BLOCKS.
    """

    def __init__(self, data: bytes, name: str) -> None:
        self.data, self.name = data, name
        array = np.frombuffer(data, dtype=np.uint8)
        newline = np.flatnonzero(array == 10)
        if len(newline) == 0 or newline[-1] != len(data) - 1:
            newline = np.append(newline, len(data))
        first = np.concatenate([[0], newline[:-1] + 1])
        pairs = len(newline) // 2
        self._array = array
        codes, good = self._codes(first[0 : 2 * pairs : 2], newline[0 : 2 * pairs : 2])
        starts, ends = self._trim(first[1 : 2 * pairs : 2], newline[1 : 2 * pairs : 2])
        zeros = np.flatnonzero((codes == 0) & good)
        eof = zeros[self._names(starts[zeros], ends[zeros]) == b"EOF"]
        length = int(eof[0]) if len(eof) else pairs
        bad = np.flatnonzero(~good[:length])
        if len(bad):
            self._refuse(int(bad[0]), first, newline, is_dxf=bool(len(zeros)) and int(zeros[0]) < int(bad[0]))
        if length == 0:
            raise InputError(f"{name}: this is not a DXF (no tag could be read): give a .dxf sheet")
        self.codes, self.starts, self.ends = codes[:length], starts[:length], ends[:length]
        heads = zeros[zeros < length]
        self.types = self._names(self.starts[heads], self.ends[heads])
        self.heads = np.append(heads, length)
        if not len(eof):
            self._refuse_truncated(len(newline))
        self.entities = self._section(b"ENTITIES")
        self.blocks = self._section(b"BLOCKS")
        if self.entities is None:
            raise InputError(
                f"{name}: the DXF has no ENTITIES section, so it draws nothing: export the sheet again"
            )

    def _codes(
        self, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Group codes of lines, and whether each line is one: blanks, up to four digits, perhaps blanks and CR."""
        start, end = self._trim(start, end)
        width = end - start
        good = (width >= 1) & (width <= 4)
        code = np.zeros(len(start), dtype=np.int32)
        for k in range(4):
            at = np.flatnonzero(good & (width > k))
            digit = self._array[start[at] + k].astype(np.int32) - 48
            good[at] &= (digit >= 0) & (digit <= 9)
            code[at] = code[at] * 10 + digit
        return code, good

    def _trim(
        self, start: NDArray[np.int64], end: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Line ranges without blanks, tabs and carriage returns at both ends."""
        start, end = start.copy(), end.copy()
        array = self._array
        rows = np.flatnonzero(end > start)
        while len(rows):
            rows = rows[np.isin(array[end[rows] - 1], (13, 32, 9))]
            end[rows] -= 1
            rows = rows[end[rows] > start[rows]]
        rows = np.flatnonzero(end > start)
        while len(rows):
            rows = rows[np.isin(array[start[rows]], (32, 9))]
            start[rows] += 1
            rows = rows[end[rows] > start[rows]]
        return start, end

    def _names(self, start: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """Values as fixed-width byte strings, cut after 64 bytes."""
        width = int(min(max((end - start).max(initial=1), 1), _NAME_BYTES))
        columns = np.arange(width)
        at = np.minimum(start[:, None] + columns, len(self._array) - 1)
        raw = np.where(columns < (end - start)[:, None], self._array[at], 0).astype(np.uint8)
        return np.ascontiguousarray(raw).view(f"S{width}").reshape(-1)

    def _section(self, name: bytes) -> tuple[int, int] | None:
        """Range of heads within a section, its SECTION and ENDSEC left out."""
        for k in np.flatnonzero(self.types == b"SECTION"):
            row = int(self.heads[k]) + 1
            if row < len(self.codes) and self.codes[row] == 2 and self.value(row) == name:
                ends = np.flatnonzero(self.types[k:] == b"ENDSEC")
                return int(k) + 1, int(k) + int(ends[0]) if len(ends) else len(self.types)
        return None

    def _refuse(self, row: int, first: NDArray[np.int64], newline: NDArray[np.int64], is_dxf: bool) -> None:
        found = self.data[first[2 * row] : newline[2 * row]].strip()[:20]
        shown = "".join(c if c.isprintable() else "." for c in found.decode("ascii", errors="replace"))
        if not is_dxf:
            raise InputError(
                f"{self.name}: this is not a DXF (line {2 * row + 1} begins {shown!r}): give a .dxf sheet"
            )
        raise InputError(
            f"{self.name}: damaged at line {2 * row + 1}: a group code was expected, found {shown!r}: export the sheet again"
        )

    def _refuse_truncated(self, lines: int) -> None:
        where = "before any section"
        opened = np.flatnonzero(self.types == b"SECTION")
        closed = np.flatnonzero(self.types == b"ENDSEC")
        if len(opened):
            row = int(self.heads[opened[-1]]) + 1
            section = self.value(row).decode("ascii", errors="replace") if row < len(self.codes) else "?"
            inside = not len(closed) or closed[-1] < opened[-1]
            where = f"inside section {section}" if inside else f"after section {section}"
            if inside and len(self.types) > opened[-1] + 1:
                where += f", entity {self.types[-1].decode('ascii', errors='replace')}"
        raise InputError(
            f"{self.name}: the file is cut short: it ends at line {lines} {where}, without the EOF mark: "
            "fetch the sheet again"
        )

    def value(self, row: int) -> bytes:
        """The value of tag ``row``."""
        return self.data[int(self.starts[row]) : int(self.ends[row])]

    def line(self, row: int) -> int:
        """The line number, from 1, of the value of tag ``row``."""
        return 2 * row + 2

    def first(self, heads: NDArray[np.int64], code: int) -> NDArray[np.int64]:
        """(k,) int64: for each of the given entities the first tag with ``code``, or -1."""
        rows = np.flatnonzero(self.codes == code)
        at = np.searchsorted(rows, self.heads[heads])
        found = np.append(rows, len(self.codes))[at]
        return np.where(found < self.heads[heads + 1], found, -1)

    def names(self, rows: NDArray[np.int64]) -> NDArray[np.bytes_]:
        """Upper-case values of tags as byte strings, b"" for row -1."""
        found = np.maximum(rows, 0)
        start = self.starts[found]
        return np.char.upper(self._names(start, np.where(rows >= 0, self.ends[found], start)))

    def floats(self, rows: NDArray[np.int64], default: float = 0.0) -> NDArray[np.float64]:
        """(k,) float64 values of tags, ``default`` for row -1. Raises InputError naming the line of what is no number."""
        out = np.full(len(rows), default)
        some = np.flatnonzero(rows >= 0)
        if not len(some):
            return out
        start, end = self.starts[rows[some]], self.ends[rows[some]]
        low, high = int(start[0]), int(end[-1])
        if np.all(start[1:] > start[:-1]) and high - low < _BYTES_A_VALUE * len(some):
            # Where values lie close together they are cut out of the bytes in one pass; line ends separate them.
            step = np.zeros(high - low + 2, dtype=np.int8)
            step[start - low] = 1
            step[end + 1 - low] = -1
            wanted = np.cumsum(step[: high - low], dtype=np.int8).view(np.bool_)
            values = _numbers(
                self.data[low:high] if wanted.all() else self._array[low:high][wanted].tobytes()
            )
            if values is not None and len(values) == len(some) and np.isfinite(values).all():
                out[some] = values
                return out
        for k in some:
            text = self.value(int(rows[k]))
            try:
                out[k] = float(text)
            except ValueError:
                out[k] = math.nan
            if not math.isfinite(out[k]):
                shown = text[:20].decode("ascii", errors="replace")
                raise InputError(
                    f"{self.name}: damaged at line {self.line(int(rows[k]))}: a number was expected, found {shown!r}: "
                    "export the sheet again"
                )
        return out

    def integers(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """(k,) int64 values of tags, 0 for row -1."""
        return self.floats(rows).astype(np.int64)


def _numbers(text: bytes) -> NDArray[np.float64] | None:
    """Numbers separated by white space, or None where something is no number."""
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError:
        return None
