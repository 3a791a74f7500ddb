"""The ratio kernel against brute force, FFT and laws; blocks against the whole, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from brmgeo.codes import RATIO_UNKNOWN, UNKNOWN
from brmgeo.maps.ratio import disc_counts, halo_px, ratio_maps


def brute_counts(mask: NDArray[Any], radius: float) -> NDArray[np.int64]:
    """Adds the mask shifted by every offset of the disc."""
    height, width = mask.shape
    r2, reach = radius * radius, int(radius) + 1
    out = np.zeros(mask.shape, np.int64)
    for dy in range(-min(reach, height - 1), min(reach, height - 1) + 1):
        for dx in range(-min(reach, width - 1), min(reach, width - 1) + 1):
            if dx * dx + dy * dy <= r2:
                y0, y1, x0, x1 = max(0, -dy), min(height, height - dy), max(0, -dx), min(width, width - dx)
                out[y0:y1, x0:x1] += mask[y0 + dy : y1 + dy, x0 + dx : x1 + dx] != 0
    return out


def brute_ratio(building: NDArray[np.uint8], radius: float) -> NDArray[np.int64]:
    count, known = brute_counts(building == 1, radius), brute_counts(building != UNKNOWN, radius)
    return np.where(known > 0, (2 * count * 10_000 + known) // np.maximum(2 * known, 1), RATIO_UNKNOWN)


def fft_counts(mask: NDArray[np.bool_], radius: float) -> NDArray[np.int64]:
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = (x * x + y * y <= radius * radius).astype(np.float64)
    full = scipy.signal.fftconvolve(mask.astype(np.float64), disc, mode="full")
    return np.rint(full[reach : reach + mask.shape[0], reach : reach + mask.shape[1]]).astype(np.int64)


def town(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Rectangles of building and a few of unknown ground."""
    mask = np.zeros(shape, np.uint8)
    for k in range(shape[0] * shape[1] // 900 + 1):
        y, x = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        h, w = rng.integers(2, 30, 2)
        mask[y : y + h, x : x + w] = UNKNOWN if k % 9 == 8 else 1
    return mask


shapes = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=45)
masks = shapes.flatmap(lambda s: hnp.arrays(np.bool_, s))
radii = st.one_of(
    st.floats(0.01, 20), st.integers(1, 20).map(float), st.integers(1, 400).map(lambda n: n**0.5)
)
buildings = shapes.flatmap(lambda s: hnp.arrays(np.uint8, s, elements=st.sampled_from([0, 1, UNKNOWN])))


@settings(deadline=None, max_examples=60)
@given(masks, radii)
def test_counts_equal_brute_force(mask: NDArray[np.bool_], radius: float) -> None:
    counts = disc_counts(mask, radius)
    assert counts.dtype == np.uint16
    np.testing.assert_array_equal(counts, brute_counts(mask, radius))


@settings(deadline=None, max_examples=60)
@given(buildings, st.lists(radii, min_size=1, max_size=3))
def test_ratios_equal_brute_force(building: NDArray[np.uint8], some_radii: list[float]) -> None:
    maps = ratio_maps(building, some_radii)
    assert maps.shape == (len(some_radii), *building.shape)
    for band, radius in zip(maps, some_radii, strict=True):
        np.testing.assert_array_equal(band, brute_ratio(building, radius))
        assert ((band <= 10_000) == (brute_counts(building != UNKNOWN, radius) > 0)).all()


@pytest.mark.parametrize("radius", [20.0, 39.4, 78.8, 118.2, 144.0])
def test_counts_equal_fft(radius: float) -> None:
    mask = np.random.default_rng(int(radius)).random((311, 457)) < 0.4
    counts = disc_counts(mask, radius)
    assert counts.dtype == np.uint16
    np.testing.assert_array_equal(counts, fft_counts(mask, radius))


@pytest.mark.parametrize(("radius", "fill"), [(145.0, 0.5), (200.3, 1.0), (400.0, 0.9)])
def test_large_radii_count_in_uint32(radius: float, fill: float) -> None:
    mask = np.random.default_rng(1).random((620, 530)) <= fill
    counts = disc_counts(mask, radius)
    assert counts.dtype == np.uint32
    assert counts.max() > 65_535 * fill * 0.9
    np.testing.assert_array_equal(counts, fft_counts(mask, radius))


def test_large_radius_ratio_equals_integer_division() -> None:
    building = town(np.random.default_rng(2), (500, 420))
    count, known = fft_counts(building == 1, 170.0), fft_counts(building != UNKNOWN, 170.0)
    np.testing.assert_array_equal(
        ratio_maps(building, [170.0])[0], (2 * count * 10_000 + known) // (2 * known)
    )


def test_radius_beyond_the_mask_sees_all_of_it() -> None:
    mask = np.random.default_rng(3).random((40, 9)) < 0.3
    assert (disc_counts(mask, 1000.0) == mask.sum()).all()
    assert (disc_counts(mask, 41.0) == mask.sum()).all()


def test_radius_below_one_pixel_is_the_pixel_itself() -> None:
    building = np.array([[0, 1, UNKNOWN]], np.uint8)
    np.testing.assert_array_equal(ratio_maps(building, [0.3, 0.99]), [[[0, 10_000, RATIO_UNKNOWN]]] * 2)


def test_ratio_rounds_half_up_at_exact_ties() -> None:
    # 1/32 = 312.5e-4 and 3/32 = 937.5e-4 are ties: a strip of 32 known pixels that every disc covers.
    for ones, want in ((1, 313), (3, 938), (5, 1563)):
        strip = np.zeros((1, 32), np.uint8)
        strip[0, :ones] = 1
        assert (ratio_maps(strip, [32.0]) == want).all()


@settings(deadline=None, max_examples=25)
@given(buildings, radii)
def test_turning_the_map_turns_the_ratios(building: NDArray[np.uint8], radius: float) -> None:
    for turns in (1, 2, 3):
        turned = ratio_maps(np.rot90(building, turns), [radius])[0]
        np.testing.assert_array_equal(turned, np.rot90(ratio_maps(building, [radius])[0], turns))


@settings(deadline=None, max_examples=25)
@given(masks, radii, radii)
def test_counts_grow_with_the_radius(mask: NDArray[np.bool_], a: float, b: float) -> None:
    assert (disc_counts(mask, min(a, b)) <= disc_counts(mask, max(a, b))).all()


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(1, 60), st.integers(0, 260), st.integers(0, 200))
def test_a_block_with_halo_equals_the_whole(seed: int, radius: float, row: int, col: int) -> None:
    rng = np.random.default_rng(seed)
    building = town(rng, (270, 210)) if seed % 3 else (rng.random((270, 210)) < 0.4).astype(np.uint8)
    used = [radius, radius / 2]
    whole = ratio_maps(building, used)
    height, width = rng.integers(1, 120, 2)
    halo = halo_px(radius)
    r1, c1 = min(row + height, 270), min(col + width, 210)
    r0, c0 = max(row - halo, 0), max(col - halo, 0)
    block = ratio_maps(building[r0 : r1 + halo, c0 : c1 + halo], used)
    inner = block[:, row - r0 : r1 - r0, col - c0 : c1 - c0]
    np.testing.assert_array_equal(inner, whole[:, row:r1, col:c1])
    # Outside the array is unknown, so a border of unknown pixels changes nothing.
    padded = np.pad(building, halo, constant_values=UNKNOWN)
    np.testing.assert_array_equal(ratio_maps(padded, used)[:, halo : halo + 270, halo : halo + 210], whole)


def test_unknown_corner_in_a_map_of_many_tiles() -> None:
    building = (np.random.default_rng(4).random((1500, 2300)) < 0.3).astype(np.uint8)
    building[1400:, :100] = UNKNOWN
    maps = ratio_maps(building, [39.4, 20.0], threads=2)
    for band, radius in zip(maps, (39.4, 20.0), strict=True):
        count, known = fft_counts(building == 1, radius), fft_counts(building != UNKNOWN, radius)
        want = np.where(known > 0, (2 * count * 10_000 + known) // np.maximum(2 * known, 1), RATIO_UNKNOWN)
        np.testing.assert_array_equal(band, want)


@pytest.mark.parametrize("shape", [(1, 1), (300, 500), (40, 8300)])
def test_threads_change_nothing(shape: tuple[int, int]) -> None:
    building = town(np.random.default_rng(5), shape)
    one = ratio_maps(building, [25.5, 7.0], threads=1)
    np.testing.assert_array_equal(one, ratio_maps(building, [25.5, 7.0], threads=2))
    np.testing.assert_array_equal(
        disc_counts(building == 1, 25.5), disc_counts(building == 1, 25.5, threads=3)
    )


def test_input_is_left_alone_and_its_memory_order_does_not_matter() -> None:
    building = np.asfortranarray(town(np.random.default_rng(6), (90, 70)))
    building.setflags(write=False)
    before = building.copy()
    maps = ratio_maps(building, [9.0])
    np.testing.assert_array_equal(building, before)
    np.testing.assert_array_equal(maps, ratio_maps(np.ascontiguousarray(before), [9.0]))
    reused = np.full_like(maps, 7)
    assert ratio_maps(building, [9.0], out=reused) is reused
    np.testing.assert_array_equal(maps, reused)


def test_halo_is_the_whole_pixels_of_the_radius() -> None:
    assert [halo_px(r) for r in (0.4, 1.0, 118.2, 144.9999)] == [0, 1, 118, 144]


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf"), 1e6])
def test_a_radius_out_of_range_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        disc_counts(np.ones((3, 3), bool), radius)
    with pytest.raises(ValueError, match="radius"):
        halo_px(radius)


@pytest.mark.parametrize(
    ("call", "found"),
    [
        (lambda: ratio_maps(np.full((3, 3), 7, np.uint8), [1.0]), r"\[7\]"),
        (lambda: ratio_maps(np.zeros((3, 3), np.uint8), []), "no radius"),
        (lambda: ratio_maps(np.zeros((3, 3, 1), np.uint8), [1.0]), r"\(3, 3, 1\)"),
        (lambda: ratio_maps(np.zeros((0, 3), np.uint8), [1.0]), r"\(0, 3\)"),
        (lambda: disc_counts(np.zeros((3, 3), np.float32), 1.0), "float32"),
        (lambda: disc_counts(np.zeros((3, 3), np.uint8), 1.0, threads=0), "threads"),
        (lambda: ratio_maps(np.zeros((3, 3), np.uint8), [1.0], out=np.zeros((1, 3, 4), np.uint16)), "out"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(call: Any, found: str) -> None:
    with pytest.raises(ValueError, match=found):
        call()
