"""Building ratio maps: how much of the disc around every pixel is building, counted exactly.

Method: a bit-sliced sliding disc
---------------------------------
The count of a pixel's disc follows from the count one row above: the disc gains one pixel per column on its lower
arc and loses one per column on its upper arc, 2 (2R + 1) pixels for R whole pixels of radius. What is written on
the mask does not matter, so rural and dense maps cost the same. Three ideas make it fast.

1. *Sixteen pixels in one word.* A row is cut into 16 strips of S columns. Word ``j`` of the packed row holds, in bit
   ``k``, the mask at column ``k S + j``. The neighbour ``dx`` columns away of all 16 pixels is then word ``j + dx``:
   no bit is ever shifted. Rows are stored with a border so that ``j + dx`` always exists, and neighbouring words lie
   side by side in memory, so the compiler turns the loops over ``j`` into vector instructions.
2. *Carry-save adders.* The counts of a row are held in bit planes: plane ``p`` has bit ``p`` of every count, in the
   layout of the packed mask. A full adder takes three words of the same weight to one of this weight
   (``a ^ b ^ c``) and one of double weight (the majority). Fifteen of them add 16 arc words to four planes and
   leave one carry of weight 16; the carries of all groups are added to the next four planes in the same way, and
   the few carries of weight 256 ripple through the rest.
3. *Subtracting by adding.* Beside the packed mask lies its complement. A pixel that leaves is added as ``1 - pixel``,
   and the number of ones that this puts in is the same for all pixels of a row: it is taken off, modulo a power of
   two, when the planes are turned back into numbers by a 16 x 16 bit transposition (four rounds of swaps).

Counts are integers throughout and a ratio is one division at the end, so a block with ``halo_px`` more pixels on each
side gives bit for bit what the whole map gives.

A pixel belongs to the disc when its centre does: dx^2 + dy^2 <= r^2, with any positive r and r^2 in
float64 (so that a radius of ``math.sqrt(265)`` means 265). Known pixels of a disc are
those of the disc clipped to the array (from chord sums, no pass over the map) less the unknown ones (a second
sliding disc, run only over the part of the array that unknown pixels can reach).

Sources: carry-save counting after Harley and Seal (H. S. Warren, Hacker's Delight, 2nd ed., 5-1) and bit matrix
transposition (7-3); ratio maps and disc radii after eq. 1 and 3 of the building ratio map paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.compiler import Compiler
from numpy.typing import NDArray

from brmgeo.codes import RATIO_SCALE, RATIO_UNKNOWN, UNKNOWN

UNIT = round(1 / RATIO_SCALE)
"""A ratio of one, in the units of ``ratio_maps``."""

_LANES = 16  # pixels in a packed word
_VECTOR = 32  # words; a strip is a multiple of it
_STRIP_MAX = (
    512  # words of a strip that are worked on at a time: keeps planes and carries in the first-level cache
)
_MOST_INPUTS = 4096  # disc or arc pixels added at a time: bounds the scratch for carries

_Count = NDArray[np.uint16] | NDArray[np.uint32]
_F = TypeVar("_F", bound=Callable[..., Any])


class Disjoint(Compiler):
    """numba's compiler, told that the arrays of a function do not overlap.

    The compiler would else test at each call of ``_add_16`` whether any of its 20 rows overlap: a third of the time.
    """

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, ret: Any, flags: Any, locals_: Any
    ):
        flags.noalias = True
        super().__init__(typingctx, targetctx, library, args, ret, flags, locals_)  # type: ignore[no-untyped-call]


def jit(function: _F) -> _F:
    """numba.njit that compiles at the first call, keeps the result on disk and lets go of the GIL."""
    return cast(_F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def _jit_disjoint(function: _F) -> _F:
    """jit for a function that reads nothing through one array that it writes through another."""
    return cast(
        _F, numba.njit(cache=True, nogil=True, error_model="numpy", pipeline_class=Disjoint)(function)
    )


# --- adders on words; the casts keep numba from widening 16-bit words to 64 bits -------------------------------


@jit
def _sum(a: Any, b: Any, c: Any) -> Any:
    return np.uint16(np.uint16(a ^ b) ^ c)


@jit
def _carry(a: Any, b: Any, c: Any) -> Any:
    return np.uint16(np.uint16(a & b) | np.uint16(c & np.uint16(a | b)))


@_jit_disjoint
def _add_16(words: Any, at: Any, planes: Any, lowest: Any, carry: Any) -> None:
    """Adds 16 rows of words to planes[lowest : lowest + 4]; what overflows, of 16 times the weight, goes to carry.

    at: (16,) uint64 positions in words (flat) of the rows. Unsigned, since numba would test a signed index for
    counting from the end and the loop would no longer be vectorised.
    """
    a0, a1, a2, a3, a4, a5, a6, a7 = at[0], at[1], at[2], at[3], at[4], at[5], at[6], at[7]
    b0, b1, b2, b3, b4, b5, b6, b7 = at[8], at[9], at[10], at[11], at[12], at[13], at[14], at[15]
    p1, p2, p4, p8 = planes[lowest], planes[lowest + 1], planes[lowest + 2], planes[lowest + 3]
    for index in range(carry.size):
        i = np.uint64(index)
        s = p1[i]
        x, y = words[a0 + i], words[b0 + i]
        c0, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a1 + i], words[b1 + i]
        c1, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a2 + i], words[b2 + i]
        c2, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a3 + i], words[b3 + i]
        c3, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a4 + i], words[b4 + i]
        c4, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a5 + i], words[b5 + i]
        c5, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a6 + i], words[b6 + i]
        c6, s = _carry(s, x, y), _sum(s, x, y)
        x, y = words[a7 + i], words[b7 + i]
        c7, s = _carry(s, x, y), _sum(s, x, y)
        p1[i] = s
        s = p2[i]
        d0, s = _carry(s, c0, c1), _sum(s, c0, c1)
        d1, s = _carry(s, c2, c3), _sum(s, c2, c3)
        d2, s = _carry(s, c4, c5), _sum(s, c4, c5)
        d3, s = _carry(s, c6, c7), _sum(s, c6, c7)
        p2[i] = s
        s = p4[i]
        e0, s = _carry(s, d0, d1), _sum(s, d0, d1)
        e1, s = _carry(s, d2, d3), _sum(s, d2, d3)
        p4[i] = s
        s = p8[i]
        carry[i] = _carry(s, e0, e1)
        p8[i] = _sum(s, e0, e1)


@jit
def _half_add(plane: Any, carry: Any) -> None:
    for i in range(carry.size):
        x, c = plane[i], carry[i]
        plane[i] = np.uint16(x ^ c)
        carry[i] = np.uint16(x & c)


@jit
def _add(words: Any, base: int, offsets: Any, planes: Any, carries: Any, at: Any) -> None:
    """Adds the rows of words at base + offsets (a multiple of 16 of them) to the planes, modulo their number.

    carries: (a row for each 16 offsets and two more, S) scratch, the last row zero; at: (16,) uint64 scratch.
    """
    # np.int64(0), here and below: numba would compile a function once more for each plain constant.
    groups = offsets.size // 16
    for g in range(groups):
        for k in range(16):
            at[k] = np.uint64(base + offsets[16 * g + k])
        _add_16(words, at, planes, np.int64(0), carries[g])
    flat = carries.reshape(-1)
    rows, width = carries.shape
    carry = carries[rows - 2]
    for first in range(0, groups, 16):
        for k in range(16):
            at[k] = np.uint64((first + k if first + k < groups else rows - 1) * width)
        _add_16(flat, at, planes, np.int64(4), carry)
        for p in range(8, planes.shape[0]):
            _half_add(planes[p], carry)


# --- words to numbers ------------------------------------------------------------------------------------------


@jit
def _swap(low: Any, high: Any, shift: Any, mask: Any) -> None:
    """Exchanges the bits of low under mask << shift with the bits of high under mask."""
    for i in range(low.size):
        a, b = low[i], high[i]
        t = np.uint16(np.uint16(np.uint16(a >> shift) ^ b) & mask)
        high[i] = np.uint16(b ^ t)
        low[i] = np.uint16(a ^ np.uint16(t << shift))


@jit
def _transposed(planes: Any, first: Any, square: Any) -> None:
    """Bit p of word k of square becomes bit k of plane first + p, or 0 where there is no such plane; square: (16, S)."""
    for p in range(16):
        word = square[p]
        if first + p < planes.shape[0]:
            plane = planes[first + p]
            for i in range(word.size):
                word[i] = plane[i]
        else:
            for i in range(word.size):
                word[i] = 0
    for r in range(4):
        distance = 8 >> r
        shift, mask = np.uint16(distance), np.uint16(0xFFFF // ((1 << distance) + 1))
        for p in range(16):
            if not p & distance:
                _swap(square[p], square[p + distance], shift, mask)


@jit
def _emit(planes: Any, bias: int, square: Any, row: Any) -> None:
    """Writes the counts held in planes, less bias, to row (uint16, or uint32 where more than 16 planes are used)."""
    used, width = planes.shape[0], square.shape[1]
    _transposed(planes, np.int64(0), square)
    low_bias, low_mask = np.uint16(bias & 0xFFFF), np.uint16(((1 << used) - 1) & 0xFFFF)
    if used <= 16:
        for k in range(_LANES):
            piece, source = row[k * width : (k + 1) * width], square[k]
            for i in range(piece.size):
                piece[i] = np.uint16(np.uint16(source[i] - low_bias) & low_mask)
        return
    for k in range(_LANES):
        piece, source = row[k * width : (k + 1) * width], square[k]
        for i in range(piece.size):
            piece[i] = source[i]
    _transposed(planes, np.int64(16), square)
    all_bias, all_mask = np.uint32(bias & 0xFFFFFFFF), np.uint32((1 << used) - 1)
    for k in range(_LANES):
        piece, source = row[k * width : (k + 1) * width], square[k]
        for i in range(piece.size):
            value = np.uint32(np.uint32(source[i]) << np.uint32(16)) | np.uint32(piece[i])
            piece[i] = np.uint32(np.uint32(value - all_bias) & all_mask)


# --- packing and sliding ---------------------------------------------------------------------------------------


@jit
def _pack(mask: Any, value: int, row0: int, col0: int, border: Any, words: Any) -> None:
    """Packs ``mask == value`` around a tile into words[0] and its complement into words[1].

    words: (2, h + 2 by + 1, S + 2 bx) uint16 for a tile of h rows whose first pixel is (row0, col0), border (by, bx).
    Bit k of words[0, y + by, j + bx] is pixel (row0 + y, col0 + k S + j); pixels outside the array are 0. The row
    after the last holds zeros, for sums that need something to add that changes nothing.
    """
    height, width = mask.shape
    by, bx = border
    n = words.shape[2]
    strip = n - 2 * bx
    v = np.uint8(value)
    for line in range(words.shape[1]):
        packed, complement = words[0, line], words[1, line]
        packed[:] = 0
        y = row0 + line - by
        if 0 <= y < height and line < words.shape[1] - 1:
            source = mask[y]
            for k in range(_LANES):
                first = col0 + k * strip - bx  # the column of word 0
                lo, hi = min(max(0, -first), n), max(0, min(n, width - first))
                if lo < hi:
                    pixels, target, shift = source[first + lo : first + hi], packed[lo:hi], np.uint16(k)
                    for i in range(pixels.size):
                        target[i] |= np.uint16(np.uint16(pixels[i] == v) << shift)
        for i in range(n):
            complement[i] = np.uint16(~packed[i])


def _slider(
    words: NDArray[np.uint16], border: tuple[int, int], half: NDArray[np.int64], used: int
) -> tuple[Any, ...]:
    """All that one disc needs to slide over packed words: (words, border, offsets of disc and arcs, scratch).

    half: (2R + 1,) int64, half-height of the disc at dx = -R..R. used: number of planes, at least 8.
    """
    lines, stride = words.shape[1:]
    radius = half.size // 2
    dx = np.arange(-radius, radius + 1)
    length = 2 * half + 1
    count = int(length.sum())
    dy = np.arange(count) - np.repeat(np.cumsum(length) - length + half, length)
    # Filled up to whole groups: the disc with the row of zeros as row 0 sees it, ...
    disc = np.full(-(-count // 16) * 16, (lines - 1 - border[0]) * stride - border[1])
    disc[:count] = dy * stride + np.repeat(dx, length)
    # ... the arcs with pairs of a pixel and its complement, which come to one like any other pair.
    arcs = np.zeros((-(-2 * half.size // 16) * 8, 2), np.int64)
    arcs[:, 1] = lines * stride
    arcs[: half.size, 0] = half * stride + dx
    arcs[: half.size, 1] += (-1 - half) * stride + dx
    strip = stride - 2 * border[1]
    most = min(max(disc.size, arcs.size), _MOST_INPUTS)
    planes = np.zeros((used, strip), np.uint16)
    square = np.empty((16, strip), np.uint16)
    carries = np.zeros((-(-most // 16) + 2, strip), np.uint16)
    return words, border, disc, arcs.ravel(), planes, square, carries, np.empty(16, np.uint64)


@jit
def _slide(slider: Any, y: int, row: Any) -> None:
    """Counts of the tile's row y into row: from nothing for row 0, for each other row from the one before it."""
    words, border, disc, arcs, planes, square, carries, at = slider
    base = (y + border[0]) * words.shape[2] + border[1]
    flat = words.reshape(-1)
    # One place that adds, for both: the adders are long when compiled.
    source = arcs
    if y == 0:
        planes[:] = 0
        source = disc
    for first in range(0, source.size, _MOST_INPUTS):
        _add(flat, base, source[first : first + _MOST_INPUTS], planes, carries, at)
    _emit(planes, y * (arcs.size // 2), square, row)


@jit
def _count_tile(slider: Any, tile: Any, out: Any) -> None:
    """Counts of a tile (row0, row1, col0, col1) into the whole out (H, W)."""
    row0, row1, col0, col1 = tile
    for y in range(row1 - row0):
        _slide(slider, y, out[row0 + y, col0:col1])


@jit
def _extent(mask: Any, value: int, row0: int, row1: int, col0: int, col1: int) -> Any:
    """(row0, row1, col0, col1) of the pixels equal to value in a window of the mask; all 0 where there is none."""
    v = np.uint8(value)
    top, bottom, left, right = 0, 0, col1, col0
    for y in range(row0, row1):
        line = mask[y, col0:col1]
        found = 0
        for i in range(line.size):
            found += line[i] == v
        if found:
            top, bottom = (top if bottom else y), y + 1
            first, last = 0, line.size - 1
            while line[first] != v:
                first += 1
            while line[last] != v:
                last -= 1
            left, right = min(left, col0 + first), max(right, col0 + last + 1)
    return (top, bottom, left, right) if bottom else (0, 0, 0, 0)


@jit
def _census(mask: Any) -> Any:
    """Whether any pixel is UNKNOWN, and whether any is neither that nor 0 nor 1."""
    unknown, other = np.uint8(0), np.uint8(0)
    for y in range(mask.shape[0]):
        line = mask[y]
        for i in range(line.size):
            v = line[i]
            unknown = np.uint8(unknown | np.uint8(v == UNKNOWN))
            other = np.uint8(other | np.uint8(np.uint8(v > 1) & np.uint8(v != UNKNOWN)))
    return unknown > 0, other > 0


# --- ratios ----------------------------------------------------------------------------------------------------


@jit
def _clip(chord: Any, y: int, height: int, reach: Any) -> Any:
    """Chords of the disc about a pixel of row y that lie in the array: their number, and reach[x] summed over them.

    chord: (2R + 1,) half-width of the disc at dy = -R..R. reach: (m,) int64, reach[x] = sum of min(chord, x), so that
    the clipped disc of column x has number + reach[x] + reach[width - 1 - x] pixels (m - 1 being as good as more).
    """
    radius = chord.size // 2
    top, bottom = min(radius, y), min(radius, height - 1 - y)
    reach[:] = 0
    for k in range(radius - top, radius + bottom + 1):
        for x in range(reach.size):
            reach[x] += min(chord[k], x)
    return top + bottom + 1


@jit
def _divide(count: Any, known: Any, out: Any) -> None:
    """Count over known in units of 1e-4, rounded half up.

    The quotient is exact in spite of the floating point: (count UNIT + known / 2) / known is a multiple of
    1 / (2 known); a quarter of 1 / known more keeps it away from whole numbers by more than float64 can err.
    """
    for i in range(out.size):
        k = np.float64(known[i])
        ratio = (np.float64(count[i]) * UNIT + (0.5 * k + 0.25)) / max(k, 1.0)
        out[i] = np.uint16(np.int32(ratio)) if k > 0.0 else np.uint16(RATIO_UNKNOWN)


@jit
def _divide_by(count: Any, known: int, out: Any) -> None:
    """_divide where the whole row has one known count: a product, exact for the same reason."""
    scale, half = UNIT / np.float64(known), 0.5 + 0.25 / np.float64(known)
    for i in range(out.size):
        out[i] = np.uint16(np.int32(np.float64(count[i]) * scale + half))


@jit
def _ratio_tile(
    slider: Any, shadow: Any, dark_window: Any, chord: Any, tile: Any, out: Any, scratch: Any
) -> None:
    """Ratios of a tile (row0, row1, col0, col1) into the whole out (H, W).

    slider, shadow: of the building and of the unknown pixels; shadow's words cover dark_window = (row0, row1, col0,
    col1) of the tile, outside of which no disc holds an unknown pixel. chord: half-widths of the disc at dy = -R..R.
    scratch: two rows of counts (col1 - col0,), uint16 or uint32, one of int64, and (R + 1,) int64, R along x.
    """
    height, width = out.shape
    row0, row1, col0, col1 = tile
    dark0, dark1, left, right = dark_window
    row, covered, known, reach = scratch
    unknown = covered[left:right]
    radius, radius_y = reach.size - 1, chord.size // 2
    # Columns [inner0, inner1) of the tile are a radius away from the array's sides.
    inner0 = min(max(radius - col0, 0), row.size)
    inner1 = max(min(width - radius - col0, row.size), inner0)
    seen = -1
    number = 0
    for y in range(row1 - row0):
        _slide(slider, y, row)
        here = row0 + y
        # Away from the array's top and bottom all rows are clipped alike.
        alike = min(here, radius_y) + (height + 1) * min(height - 1 - here, radius_y)
        if alike != seen:
            seen = alike
            number = _clip(chord, here, height, reach)
            for i in range(row.size):
                x = col0 + i
                known[i] = number + reach[min(x, radius)] + reach[min(width - 1 - x, radius)]
        target = out[here, col0:col1]
        _divide(row[:inner0], known[:inner0], target[:inner0])
        if inner1 > inner0:
            _divide_by(row[inner0:inner1], known[inner0], target[inner0:inner1])
        _divide(row[inner1:], known[inner1:], target[inner1:])
        if dark0 <= y < dark1 and left < right:
            _slide(shadow, y - dark0, unknown)
            _divide(row[left:right], known[left:right] - unknown, target[left:right])


# --- the public side -------------------------------------------------------------------------------------------


def _radius(radius_px: float) -> float:
    radius = float(radius_px)
    if not (math.isfinite(radius) and 0 < radius <= 30_000):
        raise ValueError(f"disc of radius {radius_px} px asked for: give a radius above 0 and up to 30000 px")
    return radius


def halo_px(radius_px: float) -> int:
    """Border in pixels that a block needs on each side for its ratios and counts to equal the whole map's.

    Raises ValueError for a radius that is not a positive finite number of pixels, or is above 30 000.
    """
    return math.floor(_radius(radius_px))


def _half_heights(radius_px: float) -> NDArray[np.int64]:
    """(2R + 1,) largest dy with dx^2 + dy^2 <= r^2 for dx = -R..R."""
    radius = _radius(radius_px)
    r2 = radius * radius
    dx = np.arange(-math.floor(radius), math.floor(radius) + 1, dtype=np.int64)
    half: NDArray[np.int64] = np.floor(np.sqrt(np.maximum(r2 - dx * dx, 0.0))).astype(np.int64)
    # The root may be off by one unit in its last place: let whole numbers decide.
    half += (half + 1) ** 2 + dx * dx <= r2
    half -= (half**2 + dx * dx > r2) & (half > 0)
    return half


def _disc(radius_px: float, shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Half-heights for dx = -R..R, half-widths for dy = -R..R, planes needed; cut to what an array of shape can hold."""
    whole = _half_heights(radius_px)
    ry, rx = (min(whole.size // 2, n - 1) for n in shape)
    middle = whole.size // 2
    half = np.minimum(whole[middle - rx : middle + rx + 1], ry)
    chord = np.minimum(whole[middle - ry : middle + ry + 1], rx)
    return half, chord, max(8, int((2 * half + 1).sum()).bit_length())


def _count_dtype(radius_px: float) -> type[np.uint16] | type[np.uint32]:
    return np.uint16 if int((2 * _half_heights(radius_px) + 1).sum()) <= 65_535 else np.uint32


def _contiguous(mask: NDArray[Any], what: str) -> NDArray[np.uint8]:
    if mask.ndim != 2 or mask.size == 0 or mask.dtype not in (np.bool_, np.uint8):
        raise ValueError(
            f"{what}: (rows, columns) of bool or uint8 asked for, found {mask.shape} {mask.dtype}"
        )
    return np.ascontiguousarray(mask).view(np.uint8)


def _tiles(shape: tuple[int, int], rows: int, cols: int) -> list[tuple[int, int, int, int]]:
    """(row0, row1, col0, col1) of tiles of about equal size, at most rows x cols."""

    def cuts(length: int, most: int) -> list[tuple[int, int]]:
        n = -(-length // most)
        return [(length * k // n, length * (k + 1) // n) for k in range(n)]

    return [(*r, *c) for r in cuts(shape[0], rows) for c in cuts(shape[1], cols)]


def _packed(
    mask: NDArray[np.uint8], value: int, tile: tuple[int, int, int, int], border: tuple[int, int]
) -> NDArray[np.uint16]:
    """The mask around a tile as _pack makes it."""
    row0, row1, col0, col1 = tile
    # Whole vectors: the few words that a vector loop leaves over would take as long as all the others.
    strip = -(-(col1 - col0) // (_LANES * _VECTOR)) * _VECTOR
    words = np.empty((2, row1 - row0 + 2 * border[0] + 1, strip + 2 * border[1]), np.uint16)
    _pack(mask, value, row0, col0, border, words)
    return words


def _each(work: Callable[[tuple[int, int, int, int]], None], tiles: list[Any], threads: int) -> None:
    if threads < 1:
        raise ValueError(f"{threads} threads asked for: give 1 or more")
    if threads == 1 or len(tiles) == 1:
        for tile in tiles:
            work(tile)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, tiles):
            pass


def disc_counts(mask: NDArray[np.bool_] | NDArray[np.uint8], radius_px: float, *, threads: int = 1) -> _Count:
    """Number of set pixels in the disc around every pixel.

    Args:
        mask: (H, W) bool or uint8, not 0 where set; pixels outside the array count as 0.
        radius_px: radius in pixels, above 0; a pixel belongs to the disc when dx^2 + dy^2 <= r^2.
        threads: number of threads to use.

    Returns:
        (H, W) uint16, or uint32 where the whole disc has more than 65 535 pixels (radius above 144).

    Raises:
        ValueError: mask of another shape or dtype, radius not in (0, 30 000], threads below 1.
    """
    pixels = _contiguous(mask, "disc_counts mask")
    if mask.dtype != np.bool_:
        pixels = (pixels != 0).view(np.uint8)
    shape = (pixels.shape[0], pixels.shape[1])
    half, chord, used = _disc(radius_px, shape)
    border = (chord.size // 2, half.size // 2)
    out = np.empty(shape, _count_dtype(radius_px))

    def work(tile: tuple[int, int, int, int]) -> None:
        _count_tile(_slider(_packed(pixels, 1, tile, border), border, half, used), tile, out)

    _each(work, _tiles(shape, -(-shape[0] // max(threads, 1)), _LANES * _STRIP_MAX), threads)
    return cast(_Count, out)


def ratio_maps(
    building: NDArray[np.uint8],
    radii_px: Sequence[float],
    *,
    threads: int = 1,
    out: NDArray[np.uint16] | None = None,
) -> NDArray[np.uint16]:
    """Share of building among the known pixels of the disc around every pixel, one map a radius.

    Args:
        building: (H, W) uint8: 1 building, 0 other, 255 unknown; everything outside the array is unknown.
        radii_px: n radii in pixels, each above 0, in any order.
        threads: number of threads to use; the result does not depend on it.
        out: (n, H, W) uint16 in C order to write to; a used one spares the system from handing out fresh memory,
            which takes a fifth of the time.

    Returns:
        (n, H, W) uint16 (``out`` where given) in units of 1e-4, rounded half up; RATIO_UNKNOWN (65 535) where no pixel of
        the disc is known. A block with ``halo_px(radius)`` more pixels on each side (or up to the edge of the
        whole) gives the whole map's values.

    Raises:
        ValueError: mask of another shape, dtype or with other values, no radius or one not in (0, 30 000], threads
            below 1, an out that does not fit.
    """
    pixels, some_unknown = _checked(building)
    shape = (pixels.shape[0], pixels.shape[1])
    if len(radii_px) == 0:
        raise ValueError("ratio_maps: no radius given: give at least one, in pixels")
    discs = [_disc(radius, shape) for radius in radii_px]
    border = (max(d[1].size for d in discs) // 2, max(d[0].size for d in discs) // 2)
    if out is None:
        out = np.empty((len(discs), *shape), np.uint16)
    elif out.shape != (len(discs), *shape) or out.dtype != np.uint16 or not out.flags.c_contiguous:
        raise ValueError(
            f"ratio_maps out: C-ordered uint16 {(len(discs), *shape)} asked for, found {out.shape} {out.dtype}"
        )
    maps = out

    def work(tile: tuple[int, int, int, int]) -> None:
        row0, row1, col0, col1 = tile
        words = _packed(pixels, 1, tile, border)
        around = (
            max(row0 - border[0], 0), min(row1 + border[0], shape[0]),
            max(col0 - border[1], 0), min(col1 + border[1], shape[1]),
        )  # fmt: skip
        dark, window = words, (0, 0, 0, 0)
        if some_unknown:
            top, bottom, left, right = _extent(pixels, UNKNOWN, *around)
            if bottom > top:
                reached = (
                    max(top - border[0], row0), min(bottom + border[0], row1),
                    max(left - border[1], col0), min(right + border[1], col1),
                )  # fmt: skip
                dark = _packed(pixels, UNKNOWN, reached, border)
                window = (reached[0] - row0, reached[1] - row0, reached[2] - col0, reached[3] - col0)
        for (half, chord, used), radius, band in zip(discs, radii_px, maps):
            slider = _slider(words, border, half, used)
            shadow = _slider(dark, border, half, used) if window[1] > window[0] else slider
            width, dtype = col1 - col0, _count_dtype(radius)
            scratch = (
                np.empty(width, dtype), np.zeros(width, dtype),
                np.empty(width, np.int64), np.empty(half.size // 2 + 1, np.int64),
            )  # fmt: skip
            _ratio_tile(slider, shadow, window, chord, tile, band, scratch)

    # Small tiles where something is unknown: it then touches few of them, and the others are spared the second disc.
    rows, cols = (1024, 2048) if some_unknown else (shape[0], _LANES * _STRIP_MAX)
    _each(work, _tiles(shape, min(rows, -(-shape[0] // max(threads, 1))), cols), threads)
    return maps


def _checked(building: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], bool]:
    """The mask in row order, and whether anything in it is unknown."""
    if building.dtype != np.uint8:
        raise ValueError(f"building mask: uint8 of 0, 1 and 255 asked for, found {building.dtype}")
    pixels = _contiguous(building, "building mask")
    some_unknown, others = _census(pixels)
    if others:
        raise ValueError(f"building mask: 0, 1 and 255 (unknown) asked for, found also {_others(pixels)}")
    return pixels, bool(some_unknown)


def _others(pixels: NDArray[np.uint8]) -> list[int]:
    return sorted({int(v) for v in np.unique(pixels)} - {0, 1, UNKNOWN})
