"""What can happen to a file: bits flipped, pieces lost, doubled or exchanged, odd values where sound ones stood."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

ODD = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"99999999999999999999999", b"9" * 5000, b"",
    b"=cmd|'/c calc'!A1", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", "한글 이름".encode(), "²".encode(), "١٢".encode(), b"true",
    b"null", b"[]", b"{}", b'"', b"'", b"[" * 100_000, b'{"a":' * 100_000, b"../../etc/passwd", b"/vsicurl/http://127.0.0.1:9/x",
    b"1_000", b"0x10", b"1,5", b"\r", b"\n", b"\n\n\n", b"#", b";", b"\t", b"a" * 70_000,
)  # fmt: skip
_TOKEN = re.compile(rb'[^\s,=\[\]{}:"]+')
_NUMBERS = ("<i2", "<i4", "<i8", "<f4", "<f8", ">i4", ">f8")


def _place(data: bytes, rng: np.random.Generator, head: int = 0) -> int:
    return int(rng.integers(min(head, len(data) - 1), len(data)))


def flip(data: bytes, rng: np.random.Generator, head: int = 0) -> bytes:
    """One to eight bits, anywhere."""
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 8]))):
        out[_place(data, rng, head)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def overwrite(data: bytes, rng: np.random.Generator, head: int = 0) -> bytes:
    """Up to 64 bytes by zeros, ones or noise."""
    at, size = _place(data, rng, head), int(rng.integers(1, 65))
    size = min(size, len(data) - at)
    new = (bytes(size), b"\xff" * size, rng.bytes(size))[int(rng.integers(3))]
    return data[:at] + new + data[at + size :]


def number(data: bytes, rng: np.random.Generator, head: int = 0) -> bytes:
    """A binary number by an odd one."""
    kind = np.dtype(_NUMBERS[int(rng.integers(len(_NUMBERS)))])
    odd = (np.nan, np.inf, -1.0, 1e38) if kind.kind == "f" else (-1, 0, 2 ** (kind.itemsize * 8 - 1) - 1)
    new = np.array(odd[int(rng.integers(len(odd)))]).astype(kind).tobytes()
    at = _place(data, rng, head)
    return data[:at] + new + data[at + len(new) :]


def drop(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes are gone."""
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.choice([1, 2, 7, 100, 4096])) :]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes too many."""
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.choice([1, 2, 7, 100, 4096]))) + data[at:]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """The end, or nearly all, is missing."""
    return data[: int(rng.integers(0, 64) if rng.random() < 0.2 else _place(data, rng))]


def shuffle(data: bytes, rng: np.random.Generator) -> bytes:
    """Two pieces change places, or one comes twice."""
    a, b, c = sorted(_place(data, rng) for _ in range(3))
    return (
        data[:a] + data[b:c] + data[a:b] + data[c:] if rng.random() < 0.5 else data[:b] + data[a:b] + data[b:]
    )


def odd(data: bytes, rng: np.random.Generator) -> bytes:
    """A word or number of a text by an odd one."""
    words = list(_TOKEN.finditer(data))
    if not words:
        return flip(data, rng)
    word = words[int(rng.integers(len(words)))]
    return data[: word.start()] + ODD[int(rng.integers(len(ODD)))] + data[word.end() :]


def lines(data: bytes, rng: np.random.Generator) -> bytes:
    """A line of a text is lost, doubled, moved or cut."""
    rows = data.split(b"\n")
    i, j = (int(rng.integers(len(rows))) for _ in range(2))
    match int(rng.integers(4)):
        case 0:
            del rows[i]
        case 1:
            rows.insert(i, rows[j])
        case 2:
            rows[i], rows[j] = rows[j], rows[i]
        case _:
            rows[i] = rows[i][: len(rows[i]) // 2]
    return b"\n".join(rows)


_BINARY: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    flip, flip, overwrite, number, drop, insert, cut, shuffle,
)  # fmt: skip
_TEXT = (odd, odd, odd, odd, lines, lines, flip, drop, cut, shuffle)


def damaged(data: bytes, rng: np.random.Generator, text: bool) -> tuple[str, bytes]:
    """The name of what was done, and the file after it."""
    ways = _TEXT if text else _BINARY
    way = ways[int(rng.integers(len(ways)))]
    return way.__name__, way(data, rng)
