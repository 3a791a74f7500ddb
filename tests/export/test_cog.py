"""Every raster that is written: valid COG, exact statistics, the same bytes for the same pixels, whole or not there."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rio_cogeo import cog_validate

from brmgeo.errors import InputError, WorkflowError
from brmgeo.export.cog import encode_ratio, output_tags, write_cog
from brmgeo.files import SCRATCH
from brmgeo.geo.grid import Window, blocks, lattice
from brmgeo.geo.raster import box_of, decode_ratio, radii_of, read_window

BOX = lattice((164000.0, 563000.0, 164700.0, 563600.5), "EPSG:5187", 0.5)
ROWS, COLS = BOX.shape
RADII = (59.1, 19.7 + 1e-13)


@pytest.fixture(scope="module")
def ratio() -> NDArray[np.uint16]:
    """Smooth ratios with unknown parts, nothing symmetric."""
    r, c = np.mgrid[0:ROWS, 0:COLS]
    out = np.stack([(r * 3 + c * 2) % 10001, (r * r // 7 + c) % 5000]).astype(np.uint16)
    out[:, :200, :90] = 65535
    out[1, 700:, 1000:] = 65535
    return out


@pytest.fixture(scope="module")
def rgb() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    r, c = np.mgrid[0:ROWS, 0:COLS]
    image = np.stack([r / 8 + 20, c / 8 + 10, 128 + 60 * np.sin(r / 40 + c / 90)], axis=-1).astype(np.uint8)
    valid = np.ones((ROWS, COLS), bool)
    valid[:130, 900:] = False
    return image, valid


def is_cog(path: Path) -> None:
    valid, errors, warnings = cog_validate(path, strict=True, quiet=True)
    assert valid, (errors, warnings)


def statistics(path: Path, band: int) -> tuple[float, ...]:
    with rasterio.open(path) as src:
        tags = src.tags(band)
    return tuple(float(tags[f"STATISTICS_{k}"]) for k in ("MINIMUM", "MAXIMUM", "MEAN", "STDDEV"))


def test_ratio(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    """Pixels, scale, nodata, radii, tags and statistics come back; overviews are means of known cells."""
    path = tmp_path / "ratio.tif"
    tags = output_tags("k123", "demo", "국토지리정보원", "")
    stats = write_cog(path, ratio, BOX, kind="ratio", radii_m=RADII, tags=tags)
    is_cog(path)
    np.testing.assert_array_equal(read_window(path), ratio)
    assert box_of(path) == BOX
    assert radii_of(path) == RADII
    for band in range(2):
        known = ratio[band][ratio[band] != 65535].astype(float)
        want = (known.min(), known.max(), known.mean(), known.std())
        assert statistics(path, band + 1) == pytest.approx(want, rel=1e-10)
        s = stats[band]
        assert s.known_px == known.size
        assert (s.minimum, s.maximum, s.mean, s.std) == pytest.approx(
            tuple(v * 1e-4 for v in want), rel=1e-10
        )
    with rasterio.open(path) as src:
        assert src.dtypes == ("uint16", "uint16")
        assert src.nodata == 65535
        assert src.scales == (1e-4, 1e-4)
        assert src.descriptions[0] == "building ratio within 59.1 m"
        assert src.compression.value.lower() == "zstd"
        assert src.tags(ns="IMAGE_STRUCTURE")["PREDICTOR"] == "2"
        kept = src.tags()
        assert {k: kept[k] for k in tags} == tags
        assert "TERMS" not in kept
        assert src.overviews(1) == [2, 4]
    with rasterio.open(path, overview_level=0) as small:
        got = small.read(1)
    even = ratio[0][: ROWS // 2 * 2, : COLS // 2 * 2].reshape(ROWS // 2, 2, COLS // 2, 2).astype(float)
    even[even == 65535] = np.nan
    inner = ~np.isnan(even).any(axis=(1, 3))
    got = got[: inner.shape[0], : inner.shape[1]]
    # GDAL scales an odd number of rows by a hair less than 2; the ramps are steep only where they wrap.
    near = np.abs(got - even.mean(axis=(1, 3))) < 12
    assert near[inner].mean() > 0.98
    assert (got[:99, :44] == 65535).all()


def test_mask(tmp_path: Path) -> None:
    """0, 1 and unknown; overviews hold nothing else and do not inflate coverage."""
    rng = np.random.default_rng(2)
    mask = (
        (rng.random((ROWS // 6 + 1, COLS // 6 + 1)) < 0.15)
        .repeat(6, 0)
        .repeat(6, 1)[:ROWS, :COLS]
        .astype(np.uint8)
    )
    mask[:, :77] = 255
    path = tmp_path / "buildings.tif"
    colours = {0: (0, 0, 0, 0), 1: (180, 60, 40, 255), 255: (200, 200, 200, 255)}
    (stats,) = write_cog(path, mask, BOX, kind="mask", colormap=colours)
    is_cog(path)
    np.testing.assert_array_equal(read_window(path)[0], mask)
    share = mask[mask != 255].mean()
    assert stats.mean == pytest.approx(share, rel=1e-12)
    assert stats.known_px == (mask != 255).sum()
    assert (stats.minimum, stats.maximum) == (0.0, 1.0)
    with rasterio.open(path) as src:
        assert src.nodata == 255
        assert src.colorinterp == (ColorInterp.palette,)
        assert src.colormap(1)[1] == (180, 60, 40, 255)
        levels = len(src.overviews(1))
    for level in range(levels):
        with rasterio.open(path, overview_level=level) as small:
            seen = small.read(1)
        assert set(np.unique(seen)) <= {0, 1, 255}
        assert seen[seen != 255].mean() == pytest.approx(share, abs=0.03)
    plain = tmp_path / "bool.tif"
    write_cog(plain, mask == 1, BOX, kind="mask")
    np.testing.assert_array_equal(read_window(plain)[0], mask == 1)


@pytest.mark.parametrize("lossless", [False, True])
def test_imagery(tmp_path: Path, rgb: tuple[NDArray[np.uint8], NDArray[np.bool_]], lossless: bool) -> None:
    """Colours close (JPEG) or equal (ZSTD), the mask exact, approximate statistics marked as such."""
    path = tmp_path / "imagery.tif"
    write_cog(path, rgb, BOX, kind="imagery", lossless=lossless)
    is_cog(path)
    image, valid = rgb
    with rasterio.open(path) as src:
        got = np.moveaxis(src.read(), 0, -1)
        assert src.mask_flag_enums[0] == [MaskFlags.per_dataset]
        np.testing.assert_array_equal(src.dataset_mask() > 0, valid)
        assert src.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        tags = src.tags(1)
        assert ("STATISTICS_APPROXIMATE" in tags) is (not lossless)
        if not lossless:
            assert src.photometric.value.lower() == "ycbcr"
    assert float(tags["STATISTICS_MEAN"]) == pytest.approx(image[valid][:, 0].mean(), rel=1e-10)
    if lossless:
        np.testing.assert_array_equal(got[valid], image[valid])
        assert (got[~valid] == 0).all()
    else:
        assert np.abs(got[valid].astype(int) - image[valid]).mean() < 2
        assert path.stat().st_size < 0.2 * image.size


@pytest.mark.parametrize("kind", ["ratio", "mask", "imagery", "lossless"])
def test_same_pixels_same_bytes(
    tmp_path: Path, ratio: NDArray[np.uint16], rgb: tuple[NDArray[np.uint8], NDArray[np.bool_]], kind: str
) -> None:
    """Whole, in aligned blocks, in odd blocks backwards, under another name: one sequence of bytes."""
    one = {"ratio": ratio, "mask": (ratio[0] % 2).astype(np.uint8)}.get(kind, rgb)

    def cut(size: int, backwards: bool) -> list[tuple[Window, object]]:
        windows = list(blocks((ROWS, COLS), size))
        pairs = [
            (w, tuple(a[w.slices] for a in one) if isinstance(one, tuple) else one[(..., *w.slices)])
            for w in windows
        ]
        return pairs[::-1] if backwards else pairs

    written = set()
    for n, data in enumerate((one, iter(cut(512, False)), cut(333, True))):
        path = tmp_path / f"{n}.tif"
        write_cog(
            path, data, BOX,
            kind="imagery" if kind == "lossless" else kind,  # type: ignore[arg-type]
            lossless=kind == "lossless",
            radii_m=RADII if kind == "ratio" else (),
            tags={"B": "2", "A": "1"} if n % 2 else {"A": "1", "B": "2"},
        )  # fmt: skip
        written.add(path.read_bytes())
    assert len(written) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.tif", "1.tif", "2.tif"]


@given(hnp.arrays(np.float64, (2, 5, 7), elements=st.one_of(st.floats(0, 1), st.just(math.nan))))
def test_ratio_encoding_round_trip(values: NDArray[np.float64]) -> None:
    """Within half a step, unknown stays unknown, and stored steps come back as they were."""
    stored = encode_ratio(values)
    back = decode_ratio(stored)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    known = ~np.isnan(values)
    assert (np.abs(back[known] - values[known]) <= 0.5e-4 + 1e-7).all()
    np.testing.assert_array_equal(encode_ratio(back), stored)


def test_ratio_encoding_keeps_every_step() -> None:
    steps = np.arange(10001, dtype=np.uint16)
    np.testing.assert_array_equal(encode_ratio(decode_ratio(steps)), steps)
    for bad in (-0.001, 1.0001):
        with pytest.raises(ValueError, match="outside"):
            encode_ratio(np.array([bad]))


def test_small_raster_and_all_unknown(tmp_path: Path) -> None:
    """A raster smaller than a block, and one that knows nothing: valid files without statistics."""
    box = lattice((0.0, 0.0, 10.0, 7.0), "EPSG:5186", 1.0)
    (stats,) = write_cog(tmp_path / "u.tif", np.full((1, 7, 10), np.nan), box, kind="ratio", radii_m=[3])
    is_cog(tmp_path / "u.tif")
    assert stats.known_px == 0
    assert math.isnan(stats.mean)
    assert (read_window(tmp_path / "u.tif") == 65535).all()
    with rasterio.open(tmp_path / "u.tif") as src:
        assert "STATISTICS_MEAN" not in src.tags(1)


def test_broken_promises_are_defects(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    """Gaps, overlaps out of the lattice, wrong shapes, types and values; nothing is left behind."""
    path = tmp_path / "x.tif"
    window = Window(0, 0, 512, 512)
    part = ratio[:, :512, :512]
    with pytest.raises(ValueError, match="tile the lattice once"):
        write_cog(path, [(window, part)], BOX, kind="ratio", radii_m=RADII)
    with pytest.raises(ValueError, match="not inside"):
        write_cog(path, [(Window(ROWS - 5, 0, 512, 512), part)], BOX, kind="ratio", radii_m=RADII)
    with pytest.raises(ValueError, match="does not fit"):
        write_cog(path, ratio.astype(np.int32), BOX, kind="ratio", radii_m=RADII)
    with pytest.raises(ValueError, match="over 10000"):
        write_cog(path, np.full((2, ROWS, COLS), 10001, np.uint16), BOX, kind="ratio", radii_m=RADII)
    with pytest.raises(ValueError, match="over 1 "):
        write_cog(path, np.full((ROWS, COLS), 2, np.uint8), BOX, kind="mask")
    with pytest.raises(ValueError, match="radii_m"):
        write_cog(path, ratio, BOX, kind="ratio")
    assert not list(tmp_path.iterdir())


def test_a_failing_block_leaves_the_old_file(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    """An error of whoever makes the blocks passes through unchanged; the former result stays, scratch files go."""
    path = tmp_path / "r.tif"
    write_cog(path, ratio, BOX, kind="ratio", radii_m=RADII)
    before = path.read_bytes()

    def failing() -> object:
        yield Window(0, 0, 512, 512), ratio[:, :512, :512]
        raise InputError("the sheet is damaged")

    with pytest.raises(InputError, match="the sheet is damaged"):
        write_cog(path, failing(), BOX, kind="ratio", radii_m=RADII)  # type: ignore[arg-type]
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["r.tif"]


def test_what_a_killed_run_left_long_ago_is_cleared_away(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    names = ("", ".blocks.tif", ".ovr.tmp")
    old, young = ([tmp_path / f"{SCRATCH}{12 * letter}.tif{name}" for name in names] for letter in ("a", "b"))
    for path in (*old, *young):
        path.touch()
        if path not in young:
            os.utime(path, (1e9, 1e9))
    write_cog(tmp_path / "r[1].tif", ratio, BOX, kind="ratio", radii_m=RADII)
    assert {*tmp_path.iterdir()} == {tmp_path / "r[1].tif", *young}


WRITE = """
import sys, numpy as np, resource, os
from pathlib import Path
from brmgeo.errors import WorkflowError
from brmgeo.export.cog import write_cog
from brmgeo.geo.grid import lattice
out, kind, limit = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
box = lattice((0, 0, 1500, 1500), "EPSG:5187", 1.0)
rng = np.random.default_rng(1)
try:
    if kind == "ratio":
        write_cog(out, rng.integers(0, 10000, (1, 1500, 1500), dtype=np.uint16), box, kind="ratio", radii_m=[5])
    else:
        rgb = rng.integers(0, 255, (1500, 1500, 3), dtype=np.uint8)
        write_cog(out, (rgb, np.ones((1500, 1500), bool)), box, kind="imagery")
    print("WRITTEN", out.stat().st_size)
except WorkflowError as error:
    print("REFUSED", error)
print("LEFT", os.listdir(out.parent))
"""


@pytest.mark.parametrize("limit", [100_000, 4_500_000])
def test_a_file_that_cannot_grow(tmp_path: Path, limit: int) -> None:
    """Writes that fail at the start, midway and in the last pass (also where GDAL does not raise) end in one line."""
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", WRITE, tmp_path / "a.tif", "ratio", str(limit)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = run.stdout.splitlines()
    assert lines[0].startswith(f"REFUSED cannot write {tmp_path / 'a.tif'}: ")
    assert lines[1:] == ["LEFT []"]


@pytest.mark.parametrize(("size", "kind"), [("3m", "imagery"), ("6m", "ratio")])
def test_full_disk(tmp_path: Path, size: str, kind: str) -> None:
    """On a small tmpfs: one line that says so, on stdout only, and nothing left."""
    mount = f'mount -t tmpfs -o size={size} t "$0" && exec "$@"'
    probe = ["unshare", "-rm", "sh", "-c", mount, str(tmp_path)]
    try:
        possible = subprocess.run([*probe, "true"], capture_output=True).returncode == 0
    except OSError:
        possible = False
    if not possible:
        pytest.skip("cannot mount a tmpfs in a namespace of its own here")
    run = subprocess.run(
        [*probe, sys.executable, "-W", "error", "-c", WRITE, str(tmp_path / "a.tif"), kind, "0"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = run.stdout.splitlines()
    assert "the disk is full" in lines[0]
    assert "free some space" in lines[0]
    assert lines[1:] == ["LEFT []"]
    assert run.stderr == ""


def test_unwritable_folder(tmp_path: Path, ratio: NDArray[np.uint16]) -> None:
    """A folder that is not there, or that is a file, or that may not be written."""
    for folder, reason in ((tmp_path / "no", "No such file"), (tmp_path / "file", "Not a directory")):
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(WorkflowError, match=reason):
            write_cog(folder / "a.tif", ratio, BOX, kind="ratio", radii_m=RADII)
    if os.geteuid() != 0:
        tmp_path.chmod(0o500)
        with pytest.raises(WorkflowError, match="Permission denied"):
            write_cog(tmp_path / "a.tif", ratio, BOX, kind="ratio", radii_m=RADII)
        tmp_path.chmod(0o700)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_raster(tmp_path: Path) -> None:
    """Sixteen times the pixels, nearly the same peak: blocks are streamed."""
    program = """
import sys, resource, numpy as np
from pathlib import Path
from brmgeo.export.cog import write_cog
from brmgeo.geo.grid import lattice, blocks
n = int(sys.argv[2])
box = lattice((0, 0, n, n), "EPSG:5187", 1.0)
block = np.arange(1024 * 1024, dtype=np.uint32).astype(np.uint16).reshape(1, 1024, 1024) % 7919
pieces = ((w, block[:, : w.height, : w.width]) for w in blocks(box.shape, 1024))
write_cog(Path(sys.argv[1]), pieces, box, kind="ratio", radii_m=[1])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    peak = {}
    for n in (2048, 8192):
        run = subprocess.run(
            [sys.executable, "-c", program, tmp_path / "a.tif", str(n)],
            capture_output=True,
            text=True,
            check=True,
        )
        peak[n] = int(run.stdout)
    assert peak[8192] - peak[2048] < 100_000, peak
