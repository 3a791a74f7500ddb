"""Measure the three matchers over simulated flights: first fix, errors, calibration, false fixes, time per step.

    python benchmarks/matchers.py --footprints FILE [--flights 50] [--first-seed 0] [--methods mask ratio paper]

Masks-only flights along the paper's rectangle over built-up ground, with odometry like VINS-Mono's. With ``--off-map`` all
buildings within 250 m of each path are taken out of the map first: no fix may come of that. Without
``--footprints`` the real sheet in BRMGEO_REAL_DATA (default ../shared/data) is used where present, else a generated town.

    python benchmarks/matchers.py --large 30 [--frames 6] [--methods mask ratio]

The same ground at 1 m, moved and mirrored, fills a map of 30 x 30 km in which it lies as it is once; the first frames of
one flight over it: time of the first and the later steps, listed blocks, and the process's peak memory.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import resource
import time
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import rasterio.features
from affine import Affine
from shapely.geometry import Polygon

from brmgeo.match import METHODS, GroundMap, make_matcher
from brmgeo.synth.flight import RaisedFootprints, SimulatedViews, place, rectangle, simulate_views

GSD_M = 0.5
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def generated_town(seed: int = 7) -> list[Polygon]:
    """Rectangles in districts over 2.2 x 2.8 km."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(170):
        angle, middle = rng.uniform(0, math.pi), rng.uniform([0, 0], [2200, 2800])
        for _ in range(rng.integers(6, 30)):
            x, y = middle + rng.normal(0, 70, 2)
            a, b, t = rng.uniform(4, 16), rng.uniform(3, 9), angle + rng.normal(0, 0.05)
            c, s = math.cos(t), math.sin(t)
            corners = [(a, b), (-a, b), (-a, -b), (a, -b)]
            out.append(Polygon([(x + u * c - v * s, y + u * s + v * c) for u, v in corners]))
    return out


def raster(polygons: list[Any]) -> GroundMap:
    """The polygons' building mask by the pixel-centre rule."""
    bounds = np.array([p.bounds for p in polygons])
    left, bottom = np.floor(bounds[:, :2].min(axis=0) / GSD_M) * GSD_M
    right, top = np.ceil(bounds[:, 2:].max(axis=0) / GSD_M) * GSD_M
    shape = (round((top - bottom) / GSD_M), round((right - left) / GSD_M))
    mask = rasterio.features.rasterize(
        ((p, 1) for p in polygons),
        out_shape=shape,
        transform=Affine(GSD_M, 0, left, 0, -GSD_M, top),
        dtype=np.uint8,
    )
    return GroundMap(mask, float(left), float(top), GSD_M)


def without_surroundings(ground: GroundMap, xy: Any, margin_m: float = 250.0) -> GroundMap:
    """The map with all buildings within ``margin_m`` of a path's bounds taken out."""
    mask, g = ground.building.copy(), ground.gsd_m
    (x0, y0), (x1, y1) = xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m
    rows = slice(max(0, int((ground.top - y1) / g)), max(0, int((ground.top - y0) / g)))
    cols = slice(max(0, int((x0 - ground.left) / g)), max(0, int((x1 - ground.left) / g)))
    mask[rows, cols] = 0
    return GroundMap(mask, ground.left, ground.top, g)


def large_map(ground: GroundMap, side_km: float, seed: int = 0) -> GroundMap:
    """The ground at 1 m in the middle of a square map, which copies of it fill: moved round, two in three mirrored."""
    one = ground.building[:: round(1.0 / GSD_M), :: round(1.0 / GSD_M)]
    (h, w), n = one.shape, round(side_km * 1000)
    building = np.zeros((n, n), np.uint8)
    rng = np.random.default_rng(seed)
    middle = (n // h // 2, n // w // 2)
    for r in range(-(-n // h)):
        for c in range(-(-n // w)):
            copy = one
            if (r, c) != middle:
                flips = ((1, 1), (-1, 1), (1, -1))[rng.integers(3)]
                copy = np.roll(one[:: flips[0], :: flips[1]], rng.integers(0, min(h, w), 2), (0, 1))
            part = building[r * h : (r + 1) * h, c * w : (c + 1) * w]
            part[:] = copy[: part.shape[0], : part.shape[1]]
    return GroundMap(building, ground.left - middle[1] * w, ground.top + middle[0] * h, 1.0)


def large(method: str, ground: GroundMap, flight: SimulatedViews, side_km: float, frames: int) -> str:
    """One line of the large map's table, measured in this process."""
    wide = large_map(ground, side_km)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    cpu, wall, blocks = [time.process_time()], [time.perf_counter()], []
    matcher = make_matcher(method, wide)
    cpu.append(time.process_time())
    wall.append(time.perf_counter())
    for view, motion in zip(flight.views[:frames], flight.motions):
        estimate = matcher.step(view, motion)
        cpu.append(time.process_time())
        wall.append(time.perf_counter())
        blocks.append(int(estimate.extra.get("listed_blocks", 0)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    c, w = np.diff(cpu), np.diff(wall)
    return (
        f"| {method} | {side_km:g} x {side_km:g} km | {c[0]:.1f} | {c[1]:.1f} ({w[1]:.1f}) | "
        f"{', '.join(f'{v:.2f}' for v in c[2:])} | {', '.join(map(str, blocks))} | {before / 1e6:.1f} | {peak / 1e6:.1f} |"
    )


def fly(method: str, ground: GroundMap, flight: SimulatedViews) -> dict[str, Any]:
    """One flight through one matcher."""
    matcher = make_matcher(method, ground, history=True)
    xy = flight.reference.xy_m
    flown = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    fixed, error, sigma, wall = [], [], [], []
    cpu = time.process_time()
    for view, motion, truth in zip(flight.views, flight.motions, xy):
        start = time.perf_counter()
        estimate = matcher.step(view, motion)
        wall.append(time.perf_counter() - start)
        fixed.append(estimate.position is not None)
        error.append(float(np.hypot(*(estimate.mean - truth))))
        sigma.append(math.sqrt(float(np.trace(estimate.covariance)) / 2))
    cpu = time.process_time() - cpu
    fix, err, sig = np.array(fixed), np.array(error), np.array(sigma)
    smooth = matcher.smooth()
    off = np.hypot(*(smooth.xy - xy).T)
    first = int(np.argmax(fix)) if fix.any() else None
    return {
        "first_m": math.inf if first is None else float(flown[first]),
        "rmse_m": math.nan if first is None else float(np.sqrt(np.mean(err[first:][fix[first:]] ** 2))),
        "smooth_m": float(np.sqrt(np.mean(off**2))),
        "false": bool((fix & (err > 50)).any()),
        "converged": float(fix.mean()),
        "normed": err[fix] / sig[fix],
        "smooth_normed": (off / smooth.sigma_m)[np.isfinite(off)],
        "wall_s": float(np.mean(wall)),
        "first_step_s": wall[0],
        "cpu_s": cpu / len(wall),
    }


def row(method: str, runs: list[dict[str, Any]]) -> str:
    """One line of the table."""
    get = {k: np.array([r[k] for r in runs]) for k in runs[0] if k not in ("normed", "smooth_normed")}
    normed = np.concatenate([r["normed"] for r in runs])
    smooth = np.concatenate([r["smooth_normed"] for r in runs])

    def within(values: Any, limit: float) -> str:
        return f"{100 * np.mean(values < limit):.0f} %" if len(values) else "-"

    first = np.sort(get["first_m"])
    p95 = first[min(len(first) - 1, math.ceil(0.95 * len(first)) - 1)]
    rmse = get["rmse_m"][np.isfinite(get["rmse_m"])]
    whole = get["smooth_m"][np.isfinite(get["smooth_m"])]
    return (
        f"| {method} | {len(runs)} | {np.median(first):.0f} | {p95:.0f} | {first[-1]:.0f} "
        f"| {np.median(rmse) if len(rmse) else math.nan:.2f} | {np.median(whole) if len(whole) else math.nan:.2f} "
        f"| {int(get['false'].sum())} | {100 * get['converged'].mean():.0f} % "
        f"| {within(normed, 1)} / {within(normed, 2)} / {within(normed, 3)} | {within(smooth, 2)} "
        f"| {get['wall_s'].mean():.3f} | {get['first_step_s'].mean():.2f} | {get['cpu_s'].mean():.3f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--footprints", type=Path)
    parser.add_argument("--flights", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["mask", "ratio", "paper"])
    parser.add_argument("--off-map", action="store_true")
    parser.add_argument("--large", type=float, metavar="KM")
    parser.add_argument("--frames", type=int, default=6)
    options = parser.parse_args()
    sheet = options.footprints or REAL / "ngii" / "36914093_buildings.gpkg"
    if sheet.exists():
        polygons = [p for p in gpd.read_file(sheet).geometry if p is not None and not p.is_empty]
    else:
        sheet, polygons = Path("a generated town"), list(generated_town())
    ground, real = raster(polygons), RaisedFootprints.from_polygons(polygons)
    h, w = ground.building.shape
    print(f"{sheet.name}: {w * GSD_M:.0f} x {h * GSD_M:.0f} m, seeds from {options.first_seed}\n")
    if options.large:
        print("| method | map | making it, CPU s | first step, CPU s (wall) | later steps, CPU s | listed blocks | "
              "map alone, peak GB | peak GB |\n" + "|---" * 8 + "|")  # fmt: skip
        seed = options.first_seed
        flight = simulate_views(real, place(rectangle((0.0, 0.0), 0.0), real, seed), seed=seed)
        for method in options.methods:
            # A process of its own: peaks do not come down again.
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                arguments = (method, ground, flight, options.large, options.frames)
                print(pool.apply(large, arguments), flush=True)
        return
    print("| method | flights | first fix median m | 95 % | max | RMSE after m | smoothed m | false | converged "
          "| within 1/2/3 sigma | smoothed 2 sigma | s/step | first step s | CPU s/step |")  # fmt: skip
    print("|---" * 14 + "|")
    shape = rectangle((0.0, 0.0), 0.0)
    for method in options.methods:
        runs = []
        for seed in range(options.first_seed, options.first_seed + options.flights):
            flight = simulate_views(real, place(shape, real, seed), seed=seed)
            here = without_surroundings(ground, flight.reference.xy_m) if options.off_map else ground
            runs.append(fly(method, here, flight))
        print(row(method, runs), flush=True)


if __name__ == "__main__":
    main()
