"""The demo region's inputs: two adjoining NGII sheets and a folder of imagery tiles, all from one seed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from brmgeo.geo.grid import Bounds
from brmgeo.synth.imagery import write_kakao_tiles
from brmgeo.synth.scene import TownStyle
from brmgeo.synth.sheets import write_sheets
from brmgeo.synth.town import generate_town

DEMO_CRS = "EPSG:5187"
DEMO_BOUNDS: Bounds = (194430.0, 444640.0, 196630.0, 447380.0)
"""2.20 x 2.74 km about the edge at 128.95 E between the two sheets; the town is invented."""
DEMO_SHEETS = ("36808058", "36808059")
DEMO_SEED = 1


def make_demo(
    out_dir: Path, seed: int = DEMO_SEED, level: int = 1, style: TownStyle | None = None
) -> dict[str, Any]:
    """Writes ``out_dir``/sheets/*.dxf, tiles/L{level}/{y}/{x}.jpg and manifest.json; returns the manifest.

    The manifest is write_sheets' with ``buildings`` and ``area_m2`` within DEMO_BOUNDS and ``tiles`` (grid, level, count).
    """
    town = generate_town(DEMO_BOUNDS, seed, style, DEMO_CRS)
    manifest = write_sheets(town, out_dir / "sheets", DEMO_SHEETS)
    count = write_kakao_tiles(town, out_dir / "tiles", level)
    manifest["buildings"] = len(town.buildings)
    manifest["area_m2"] = town.built_area_m2()
    manifest["tiles"] = {"grid": "kakao", "level": level, "count": count, "template": "L{z}/{y}/{x}.jpg"}
    (out_dir / "manifest.json").write_text(
        json.dumps(manifest, ensure_ascii=False, indent=1) + "\n", encoding="utf-8"
    )
    return manifest
