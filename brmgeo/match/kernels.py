"""The loops over blocks that the belief and its search are made of.

A block is 16 x 16 cells of one heading, float32. Positions in flat arrays are unsigned where a loop is to be vectorised.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from brmgeo.maps.ratio import Disjoint

BLOCK = 16
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@nb.njit(cache=True, nogil=True, fastmath=True, pipeline_class=Disjoint)
def _convolve(window, half, kx, ky, out):  # type: ignore[no-untyped-def]
    """out (256,) = a window of (15 + taps) x (15 + taps) cells, flat, through kx along rows, then ky; half is scratch.

    Positions are unsigned: signed ones would be tested for counting from the end, and the loops not be vectorised.
    """
    last = np.uint64(len(kx) - 1)
    side = np.uint64(BLOCK) + last
    for i in range(side):
        p, q = np.uint64(i) * side + last, np.uint64(i * BLOCK)
        for j in range(BLOCK):
            half[q + np.uint64(j)] = 0.0
        for v in range(len(kx)):
            k, first = kx[v], p - np.uint64(v)
            for j in range(BLOCK):
                half[q + np.uint64(j)] += k * window[first + np.uint64(j)]
    for i in range(BLOCK):
        p, q = np.uint64(i) + last, np.uint64(i * BLOCK)
        for j in range(BLOCK):
            out[q + np.uint64(j)] = 0.0
        for u in range(len(ky)):
            k, first = ky[u], (p - np.uint64(u)) * np.uint64(BLOCK)
            for j in range(BLOCK):
                out[q + np.uint64(j)] += k * half[first + np.uint64(j)]


@nb.njit(cache=True, nogil=True, fastmath=True)
def move_blocks(blocks, index, targets, whole, ky, kx, reach, ny, nx, out, t0, t1):  # type: ignore[no-untyped-def]
    """Each target block gathered from its sources: whole-cell shift, then a separable kernel of 2 reach + 1 taps."""
    side = BLOCK + 2 * reach
    nby, nbx = index.shape[1], index.shape[2]
    window, half = np.empty(side * side, np.float32), np.empty(side * BLOCK, np.float32)
    for t in range(t0, t1):
        h, by, bx = targets[t, 0], targets[t, 1], targets[t, 2]
        top = by * BLOCK - reach - whole[h, 0]
        left = bx * BLOCK - reach - whole[h, 1]
        window[:] = 0.0
        for sy in range(max(0, top // BLOCK), min(nby - 1, (top + side - 1) // BLOCK) + 1):
            for sx in range(max(0, left // BLOCK), min(nbx - 1, (left + side - 1) // BLOCK) + 1):
                s = index[h, sy, sx]
                if s < 0:
                    continue
                i0, i1 = max(top, sy * BLOCK), min(top + side, sy * BLOCK + BLOCK)
                j0, j1 = max(left, sx * BLOCK), min(left + side, sx * BLOCK + BLOCK)
                for i in range(i0, i1):
                    source = blocks[s, i - sy * BLOCK, j0 - sx * BLOCK : j1 - sx * BLOCK]
                    first = (i - top) * side + j0 - left
                    window[first : first + j1 - j0] = source
        _convolve(window, half, kx[h], ky[h], out[t].reshape(BLOCK * BLOCK))
        if (by + 1) * BLOCK > ny or (bx + 1) * BLOCK > nx:
            for i in range(BLOCK):
                for j in range(BLOCK):
                    if by * BLOCK + i >= ny or bx * BLOCK + j >= nx:
                        out[t, i, j] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=True)
def mix_headings(blocks, index, targets, share, out, t0, t1):  # type: ignore[no-untyped-def]
    """Each target block takes ``share`` from both neighbouring headings and keeps the rest."""
    headings = index.shape[0]
    for t in range(t0, t1):
        h, by, bx = targets[t, 0], targets[t, 1], targets[t, 2]
        out[t] = 0.0
        for d in range(-1, 2):
            s = index[(h + d + headings) % headings, by, bx]
            if s >= 0:
                w = np.float32(share if d != 0 else 1.0 - 2.0 * share)
                for i in range(BLOCK):
                    for j in range(BLOCK):
                        out[t, i, j] += w * blocks[s, i, j]


@nb.njit(cache=True, nogil=True, fastmath=True)
def mass_of(blocks):  # type: ignore[no-untyped-def]
    """(sum, maximum) of each block, float64."""
    out = np.empty((blocks.shape[0], 2), np.float64)
    for t in range(blocks.shape[0]):
        total = np.float32(0.0)
        top = np.float32(0.0)
        for i in range(BLOCK):
            for j in range(BLOCK):
                v = blocks[t, i, j]
                total += v
                top = max(top, v)
        out[t, 0] = total
        out[t, 1] = top
    return out


def factor_of(llr: F32, low: float, high: float, weight: float) -> F32:
    """The bounded likelihood ratio, written over ``llr``: a frame is wrong as a whole with chance e^low."""
    if weight != 1.0:
        llr *= np.float32(weight)
    np.minimum(llr, np.float32(high), out=llr)
    np.exp(llr, out=llr)
    llr += np.float32(math.exp(low))
    return llr


@nb.njit(cache=True, nogil=True, fastmath=True)
def weigh_heading(factor, listed, blocks, even, masses):  # type: ignore[no-untyped-def]
    """Posterior mass of every block of one heading; ``listed`` (nby, nbx) holds the row of a listed block or -1.

    ``even`` is the prior mass per cell of ``rest``.
    """
    ny, nx = factor.shape
    for by in range(listed.shape[0]):
        for bx in range(listed.shape[1]):
            s = listed[by, bx]
            total = np.float32(0.0)
            wide = min(BLOCK, nx - bx * BLOCK)
            for i in range(min(BLOCK, ny - by * BLOCK)):
                row = factor[by * BLOCK + i, bx * BLOCK : bx * BLOCK + wide]
                if s >= 0:
                    for j in range(wide):
                        total += (even + blocks[s, i, j]) * row[j]
                else:
                    for j in range(wide):
                        total += even * row[j]
            masses[by, bx] = total


@nb.njit(cache=True, nogil=True, fastmath=True)
def take_blocks(factor, listed, blocks, even, cells, out):  # type: ignore[no-untyped-def]
    """Posterior blocks at ``cells`` (n, 2) block row, block col."""
    ny, nx = factor.shape
    for n in range(cells.shape[0]):
        by, bx = cells[n, 0], cells[n, 1]
        s = listed[by, bx]
        for i in range(BLOCK):
            for j in range(BLOCK):
                y, x = by * BLOCK + i, bx * BLOCK + j
                v = np.float32(0.0)
                if y < ny and x < nx:
                    v = (even + blocks[s, i, j] if s >= 0 else even) * factor[y, x]
                # Below this a cell weighs nothing even after the largest ratio; denormals would cost time.
                out[n, i, j] = v if v > 1e-25 else np.float32(0.0)


@nb.njit(cache=True, nogil=True)
def entropy_of(blocks):  # type: ignore[no-untyped-def]
    total = 0.0
    flat = blocks.reshape(-1)
    for t in range(flat.shape[0]):
        v = flat[t]
        if v > 1e-12:
            total -= v * math.log(v)
    return total


def step_kernels(fraction: F64, sigma: float, reach: int) -> F32:
    """(n, 2 reach + 1) weights of whole-cell offsets for normals of mean ``fraction`` and deviation ``sigma`` cells."""
    edges = (np.arange(-reach, reach + 2) - 0.5 - fraction[:, None]) / (sigma * math.sqrt(2.0))
    weights = np.diff(erf(edges), axis=1)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)
