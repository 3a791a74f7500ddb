"""Reading one DXF sheet: brmgeo, plain ezdxf and GDAL side by side, as ratios of one run.

``python benchmarks/dxf_readers.py [--write docs/benchmarks-dxf.md]`` generates a sheet as large as real ones (30 000
entities on 110 layers) in R12 and R2018 and reads it with all three, interleaved, taking the best of several rounds;
real sheets are added where BRMGEO_REAL_DATA (default ../shared/data) has them. What is timed:

- brmgeo: ``read_dxf``: outlines of the eight building layers, closed, repaired, courtyards as holes, GeoDataFrame.
- ezdxf: ``readfile`` and a pass over modelspace that takes the vertices of polylines on the same layers; no repair.
- GDAL: ``pyogrio.read_dataframe`` of the whole sheet; no repair. It has no way to leave out the other layers unread.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import ezdxf
import numpy as np
import pyogrio

from brmgeo.codes import BUILDING_LAYERS
from brmgeo.ingest.dxf import read_dxf

ROUNDS = 3
REAL = (
    Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[1] / "../shared/data")) / "ngii"
)


def write_sheet(path: Path, version: str, entities: int = 30_000, seed: int = 1) -> None:
    """A sheet with the mix of a real one: a sixth buildings, contours of many vertices, roads, walls, symbols, texts."""
    rng = np.random.default_rng(seed)
    doc = ezdxf.new(version)
    doc.encoding = "cp949"
    space = doc.modelspace()
    others = [f"{group}00{i:05d}" for group in "ACDEFGH" for i in range(11110, 11125)][:102]
    symbol = doc.blocks.new("SYMBOL")
    symbol.add_circle((0, 0), 3.0, dxfattribs={"layer": "B0014111"})
    old = version == "R12"

    def polyline(xy: np.ndarray, layer: str, close: bool) -> None:
        xy = np.round(xy + (229_000.0, 465_000.0), 3)
        if old:
            space.add_polyline2d(xy.tolist(), close=close, dxfattribs={"layer": layer})
        else:
            space.add_lwpolyline(xy.tolist(), close=close, dxfattribs={"layer": layer})

    vertices = 10 if old else 22
    for i in range(entities):
        at = rng.uniform(0.0, 2500.0, 2)
        share = i % 12
        if share < 2:
            w, h = rng.uniform(5.0, 25.0, 2)
            square = np.array([[0, 0], [w, 0], [w, h], [w / 2, h], [w / 2, h * 1.4], [0, h * 1.4]])
            polyline(at + square, BUILDING_LAYERS[i % 8], True)
        elif share < 8:
            walk = at + np.cumsum(rng.normal(0.0, 3.0, (vertices, 2)), axis=0)
            polyline(walk, others[i % len(others)], False)
        elif share < 10:
            at = np.round(at + (229_000.0, 465_000.0), 3)
            space.add_line(at, at + 1.0, dxfattribs={"layer": others[i % len(others)]})
        elif share == 10:
            space.add_text(
                "건물 이름", height=2.0, dxfattribs={"layer": others[i % len(others)], "insert": at}
            )
        else:
            space.add_blockref("SYMBOL", at, dxfattribs={"layer": f"B00142{i % 10:02d}"})
    doc.saveas(path)


def with_brmgeo(path: Path) -> int:
    return len(read_dxf(path).footprints)


def with_ezdxf(path: Path) -> int:
    wanted = set(BUILDING_LAYERS)
    rings = []
    for entity in ezdxf.readfile(path).modelspace():
        if entity.dxf.layer not in wanted:
            continue
        if entity.dxftype() == "LWPOLYLINE":
            rings.append(np.array(entity.get_points("xy")))
        elif entity.dxftype() == "POLYLINE":
            rings.append(np.array([vertex.dxf.location.vec2 for vertex in entity.vertices]))
    return len(rings)


def with_gdal(path: Path) -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return len(pyogrio.read_dataframe(path))


def measure(path: Path) -> dict[str, float]:
    """Best processor seconds of each reader over interleaved rounds: a busy machine disturbs all alike, and little."""
    readers: dict[str, Callable[[Path], int]] = {
        "brmgeo": with_brmgeo,
        "ezdxf": with_ezdxf,
        "gdal": with_gdal,
    }
    best = dict.fromkeys(readers, float("inf"))
    for _ in range(ROUNDS):
        for name, reader in readers.items():
            start = time.process_time()
            reader(path)
            best[name] = min(best[name], time.process_time() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", type=Path, help="write the table as this Markdown file")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        sheets = []
        for version in ("R12", "R2018"):
            path = Path(folder) / f"generated, 30 000 entities, {version}.dxf"
            write_sheet(path, version)
            sheets.append(path)
        sheets += sorted(REAL.glob("*.dxf")) if REAL.is_dir() else []
        for path in sheets:
            best = measure(path)
            size, count = path.stat().st_size / 1e6, with_brmgeo(path)
            rows.append(
                f"| {path.stem} | {size:.1f} | {count} | {best['gdal']:.3f} | {best['brmgeo'] / best['gdal']:.2f} "
                f"| {best['ezdxf'] / best['gdal']:.1f} | {best['ezdxf'] / best['brmgeo']:.1f} |"
            )
    gdal = ".".join(map(str, pyogrio.__gdal_version__))
    table = "\n".join(
        [
            "| sheet | MB | footprints | GDAL, CPU s | brmgeo / GDAL | ezdxf / GDAL | ezdxf / brmgeo |",
            "|---|---|---|---|---|---|---|",
            *rows,
        ]
    )
    print(table)
    if options.write:
        about = (__doc__ or "").split("\n\n", 1)[1].strip()
        options.write.write_text(
            f"# Reading DXF sheets\n\nWritten by `python benchmarks/dxf_readers.py --write docs/benchmarks-dxf.md`.\n\n"
            f"{about}\n\n{table}\n\nPython {platform.python_version()}, ezdxf {ezdxf.__version__}, GDAL {gdal} (pyogrio "
            f"{pyogrio.__version__}), {os.cpu_count()} cores; best processor time of {ROUNDS} interleaved rounds. "
            "Trust the ratios, not the seconds.\n",
            encoding="utf-8",
        )


if __name__ == "__main__":
    main()
