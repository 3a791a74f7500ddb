"""A small region for the tests of the maps job: two adjoining sheets of a generated town, and tiles painted by a formula."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from PIL import Image

from brmgeo.geo.sheets import sheet_polygon
from brmgeo.geo.tilegrid import KakaoGrid
from brmgeo.synth.sheets import write_sheets
from brmgeo.synth.town import generate_town
from pipelines.cli import cli, run

CRS, LEVEL, GSD_M, RADII_M = "EPSG:5187", 3, 0.5, (40.0, 17.3)
SHEETS = ("36808058", "36808059")
# Both sheets end in the north 40 m below the top of the region: what lies above is not known.
_MEETING = shapely.intersection(*(sheet_polygon(s, CRS) for s in SHEETS)).bounds
BOUNDS = (
    round(_MEETING[2]) - 200.0,
    round(_MEETING[3]) - 260.0,
    round(_MEETING[2]) + 200.0,
    round(_MEETING[3]) + 40.0,
)
FAULTS = (
    ("open_repeated_vertex", 6),
    ("gap_5cm", 4),
    ("duplicate", 4),
    ("spike", 3),
    ("z_values", 5),
    ("line_chain", 2),
    ("zero_area", 2),
)
TOML = f"""name = "small"
title = "A small region"
crs = "{CRS}"
gsd_m = {GSD_M}
bounds = {list(BOUNDS)}
sheets = {list(SHEETS)}

[footprints]
paths = ["sheets/*.dxf"]
attribution = "Generated footprints"
repairs_layer = true

[imagery]
kind = "tiles"
path = "tiles"
grid = "kakao"
level = {LEVEL}
attribution = "Painted tiles"
terms = "free for all"

[ratio]
radii_m = {list(RADII_M)}
"""


@dataclass(frozen=True)
class SmallRegion:
    """A folder as ``--data`` wants it, and what is true of the town in it."""

    data: Path
    truth: shapely.Geometry  # union of the town's buildings within the sheets
    outlines: int

    @property
    def sheets(self) -> Path:
        return self.data / "source" / "small" / "sheets"

    @property
    def tiles(self) -> Path:
        return self.data / "source" / "small" / "tiles"

    @property
    def out(self) -> Path:
        return self.data / "out" / "small"

    @property
    def toml(self) -> Path:
        return self.data / "regions" / "small.toml"

    def copied_to(self, folder: Path, store: bool = True) -> SmallRegion:
        """The same region elsewhere, with or without what has been built."""
        skipped = () if store else ("work", "out")
        shutil.copytree(self.data, folder, ignore=lambda at, names: skipped if Path(at) == self.data else ())
        return SmallRegion(folder, self.truth, self.outlines)

    def edit(self, before: str, after: str) -> None:
        """Changes the region file."""
        text = self.toml.read_text(encoding="utf-8")
        assert before in text
        self.toml.write_text(text.replace(before, after), encoding="utf-8")


def painted(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) colours at EPSG:5181 coordinates: smooth, and different everywhere."""
    return np.stack(
        [128 + 100 * np.sin(x / 60.0), 128 + 100 * np.sin(y / 75.0), 128 + 80 * np.cos((x + y) / 90.0)],
        axis=-1,
    )


def make_source(data: Path) -> SmallRegion:
    """Writes region file, sheets and tiles below ``data``."""
    town = generate_town(BOUNDS, 4, crs=CRS)
    source = data / "source" / "small"
    manifest = write_sheets(town, source / "sheets", SHEETS, faults=FAULTS)
    grid = KakaoGrid()
    for tile in grid.covering(BOUNDS, CRS, LEVEL, margin_px=4.0):
        left, _, _, top = grid.tile_bounds(tile, LEVEL)
        centres = (np.arange(grid.tile_px) + 0.5) * grid.gsd_m(LEVEL)
        x, y = np.meshgrid(left + centres, top - centres)
        path = source / "tiles" / grid.path(tile, LEVEL, "png")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.floor(painted(x, y) + 0.5).astype(np.uint8)).save(path)
    (data / "regions").mkdir()
    (data / "regions" / "small.toml").write_text(TOML, encoding="utf-8")
    known = shapely.union_all([sheet_polygon(s, CRS) for s in SHEETS])
    truth = shapely.intersection(shapely.union_all([b.polygon for b in town.buildings]), known)
    return SmallRegion(data, truth, sum(s["outlines"] for s in manifest["sheets"].values()))


@dataclass(frozen=True)
class Answer:
    """What a run of the command said."""

    status: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line of a known error; fails where the run said anything else after it began, or a traceback."""
        lines = [line for line in self.err.splitlines() if line.startswith("brmgeo")]
        assert self.status == 2, (self.status, self.err)
        assert len(lines) == 1, self.err
        assert self.err.splitlines()[-1] == lines[0]
        assert "Traceback" not in self.err
        return lines[0]


def brmgeo(capsys: pytest.CaptureFixture[str], *words: object) -> Answer:
    """Runs the command in this process, serially unless told otherwise by SCHEDULER."""
    capsys.readouterr()
    status = run(lambda: cli([str(w) for w in words], prog_name="brmgeo", standalone_mode=False))
    said = capsys.readouterr()
    return Answer(status, said.out, said.err)


def facts_of(region: SmallRegion) -> Mapping[str, dict[str, object]]:
    """Facts of each stage in maps.json."""
    text = json.loads((region.out / "maps.json").read_text(encoding="utf-8"))
    return {label: stage["facts"] for label, stage in text["stages"].items()}


def rasters_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(out.glob("*.tif"))}
