"""Ratio maps three ways and ours: time and peak memory, written as a table to docs/benchmarks-ratio.md.

    python benchmarks/ratio_maps.py            maps up to 4403 x 5555 px
    python benchmarks/ratio_maps.py --full     and 11 000 and 22 000 px squared

Every method runs in a process of its own with one thread, so that its peak memory is its own; the processes of one
row follow each other directly, ours first and last, and times are processor seconds given also as multiples of ours,
because a machine is rarely idle. All give the share of building for the same radii; only ours is exact.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "benchmarks-ratio.md"
PAPER = (118.2, 78.8, 39.4)  # px: three discs of a view from 150 m with 43 degrees, at 0.5 m
XARRAY_CROP = 384  # px: xarray-spatial is timed on a crop and scaled by the number of pixels
METHODS = ("ours", "scipy.fft shared", "scipy fftconvolve", "cv2.filter2D", "xarray-spatial")
GIB = 1 << 30


def town(height: int, width: int, share: float) -> Any:
    """(H, W) uint8: rectangles of 10-50 px until about ``share`` of the ground is built; the same each time."""
    import numpy as np

    rng = np.random.default_rng(7)
    mask = np.zeros((height, width), np.uint8)
    # Rectangles thrown at random cover 1 - exp(-their area / the ground).
    for _ in range(int(-np.log(1 - share) * height * width / 900)):
        y, x = int(rng.integers(-50, height)), int(rng.integers(-50, width))
        h, w = rng.integers(10, 51, 2)
        mask[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] = 1
    return mask


def disc(radius: float, dtype: Any) -> Any:
    import numpy as np

    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return (x * x + y * y <= radius * radius).astype(dtype)


def work_of(method: str, mask: Any, radii: list[float]) -> Callable[[], Any]:
    """A call that makes the ratio maps of a mask by one method."""
    import numpy as np

    if method == "ours":
        from brmgeo.maps.ratio import ratio_maps

        reused = np.zeros((len(radii), *mask.shape), np.uint16)
        ratio_maps(mask[:64, :64].copy(), radii)  # compiles, or reads what was compiled
        return lambda: ratio_maps(mask, radii, out=reused)
    if method == "scipy.fft shared":
        import scipy.fft

        def shared() -> list[Any]:
            halo = int(max(radii))
            shape = [scipy.fft.next_fast_len(n + 2 * halo, real=True) for n in mask.shape]
            forward = scipy.fft.rfft2(mask.astype(np.float32), shape)
            maps = []
            for radius in radii:
                kernel, reach = disc(radius, np.float32), int(radius)
                product = scipy.fft.rfft2(kernel / kernel.sum(), shape)
                product *= forward
                maps.append(
                    scipy.fft.irfft2(product, shape)[
                        reach : reach + mask.shape[0], reach : reach + mask.shape[1]
                    ].copy()
                )
            return maps

        return shared
    if method == "scipy fftconvolve":
        import scipy.signal

        def convolve() -> list[Any]:
            image = mask.astype(np.float32)
            kernels = [disc(radius, np.float32) for radius in radii]
            return [scipy.signal.fftconvolve(image, k / k.sum(), mode="same") for k in kernels]

        return convolve
    if method == "cv2.filter2D":
        import cv2

        cv2.setNumThreads(1)

        def filtered() -> list[Any]:
            kernels = [disc(radius, np.float32) for radius in radii]
            return [
                cv2.filter2D(mask, cv2.CV_32F, k / k.sum(), borderType=cv2.BORDER_CONSTANT) for k in kernels
            ]

        return filtered
    import xarray
    from xrspatial.convolution import convolution_2d

    crop = xarray.DataArray(mask[:XARRAY_CROP, :XARRAY_CROP].astype(np.float32), dims=("y", "x"))
    convolution_2d(crop[:32, :32], disc(2.0, np.float32))  # compiles

    def focal() -> list[Any]:
        kernels = [disc(radius, np.float32) for radius in radii]
        return [convolution_2d(crop, k / k.sum()).data for k in kernels]

    return focal


def child(method: str, height: int, width: int, share: float, radii: list[float]) -> None:
    """Runs one method once or a few times in this process and prints what it took as JSON."""
    mask = town(height, width, share)
    work = work_of(method, mask, radii)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for _ in range(10 if method == "ours" else 1 if mask.size > 30e6 or method == "xarray-spatial" else 2):
        started = time.process_time()
        work()
        seconds.append(time.process_time() - started)
    scale = mask.size / min(mask.size, XARRAY_CROP**2) if method == "xarray-spatial" else 1.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"s": min(seconds) * scale, "mb": (peak - before) / 1024, "scaled": scale > 1}))


def measure(method: str, height: int, width: int, share: float, radii: tuple[float, ...]) -> dict[str, Any]:
    """child() in a process of its own, one thread."""
    threads = ("OMP", "OPENBLAS", "MKL", "NUMBA")
    done = subprocess.run(
        [sys.executable, __file__, "--child", method, str(height), str(width), str(share), *map(str, radii)],
        env=os.environ | {f"{t}_NUM_THREADS": "1" for t in threads},
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def cases(full: bool) -> list[tuple[int, int, float, tuple[float, ...], tuple[str, ...]]]:
    """(height, width, share built, radii, methods) of each row."""
    most, ours = METHODS[:4], METHODS[:1]
    rows = [
        (4403, 5555, 0.02, PAPER, METHODS),
        (4403, 5555, 0.40, PAPER, METHODS),
        *((1000, 1000, 0.4, (r,), most) for r in (20.0, 118.2, 400.0)),
        *((4403, 5555, 0.4, (r,), most) for r in (20.0, 50.0, 118.2, 200.0, 400.0)),
    ]
    if full:
        rows += [(11_000, 11_000, share, PAPER, most) for share in (0.02, 0.4)]
        rows += [(11_000, 11_000, 0.4, (r,), ours) for r in (20.0, 400.0)]
        rows += [(22_000, 22_000, share, PAPER, METHODS[:1] + METHODS[3:4]) for share in (0.02, 0.4)]
        rows += [(22_000, 22_000, 0.4, (r,), ours) for r in (20.0, 400.0)]
    return rows


def machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    return f"{model}, {os.cpu_count()} cores, {memory:.0f} GiB, Python {platform.python_version()}"


def versions() -> str:
    from importlib.metadata import version

    names = ("numba", "numpy", "scipy", "opencv-python-headless", "xarray-spatial")
    return ", ".join(f"{name} {version(name)}" for name in names)


def row_of(height: int, width: int, share: float, radii: tuple[float, ...], methods: tuple[str, ...]) -> str:
    """One line of the table; ours is measured before and after the others and the faster counts."""
    got = {m: measure(m, height, width, share, radii) for m in methods}
    if len(methods) > 1:
        again = measure("ours", height, width, share, radii)
        got["ours"] = min(got["ours"], again, key=lambda g: float(g["s"]))
    own = got["ours"]["s"]
    cells = [f"{height} x {width}", f"{100 * share:.0f} %", " / ".join(f"{r:g}" for r in radii)]
    for method in METHODS:
        g = got.get(method)
        if g is None:
            cells.append("-")
        elif method == "ours":
            cells.append(f"**{1000 * g['s']:.0f} ms**, {g['mb']:.0f} MB")
        else:
            scaled = g["scaled"]
            times = f"{'~' if scaled else ''}{g['s'] / own:.{0 if g['s'] / own >= 20 else 1}f} x"
            cells.append(times if scaled else f"{times}, {g['mb']:.0f} MB")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--full", action="store_true", help="also 11 000 and 22 000 px squared (many minutes)"
    )
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        method, height, width, share, *radii = args.child
        child(method, int(height), int(width), float(share), [float(r) for r in radii])
        return
    head = ["map, px", "built", "radii, px", *METHODS]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    print("\n".join(lines), flush=True)
    measure("ours", 300, 300, 0.4, (150.0, 20.0))  # fills numba's cache, so that no row pays for compiling
    for case in cases(args.full):
        lines.append(row_of(*case))
        print(lines[-1], flush=True)
        write(lines, args.full)
    print(f"wrote {TABLE.relative_to(ROOT)}")


def write(lines: list[str], full: bool) -> None:
    """The table as it stands, so that an interrupted run is not lost."""
    text = f"""# Ratio maps: time and memory

Made by `python benchmarks/ratio_maps.py{" --full" if full else ""}` on {datetime.datetime.now(datetime.UTC):%Y-%m-%d}.
{machine()}; {versions()}.
Load average at the end: {os.getloadavg()[0]:.1f}. Where others work on the same machine, trust the ratios.

One thread. Ours: processor time of the best of ten runs, into output memory already in use, from mask to ratios in
1e-4. Others: how many times as long, from mask to float32 ratios without rounding. MB: peak memory beyond the mask
and the libraries, outputs included (2 bytes a pixel and radius in ours, 4 in the others).
`~`: timed on a crop of {XARRAY_CROP} x {XARRAY_CROP} px and scaled by the number of pixels.

"""
    TABLE.parent.mkdir(exist_ok=True)
    TABLE.write_text(text + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
