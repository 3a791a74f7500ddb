"""Region files: finding them, and writing new ones from sheet numbers or bounds."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from pyproj import Transformer

from brmgeo.errors import CrsError, SettingsError, WorkflowError
from brmgeo.files import told, whole_file
from brmgeo.geo.crs import (
    LONLAT,
    belt_for_lon,
    belt_for_sheet,
    crs_name,
    require_projected_metres,
    transform_bounds,
    transformer,
)
from brmgeo.geo.grid import Bounds
from brmgeo.geo.sheets import sheet_extent, sheets_covering
from brmgeo.region import Region, load_region
from brmgeo.settings import build, read_toml

if TYPE_CHECKING:
    from brmgeo.synth.scene import TownStyle

MAX_AREA_M2 = 1e10
NGII = "https://map.ngii.go.kr"
#: Regions and recipes that ship: beside the wiring, in a checkout as in a wheel.
SHIPPED = Path(__file__).parents[1] / "data"

_TEXT = """\
# Region {name}: see {template} for every key that a region can have.
name = "{name}"
title = {title}
crs = "{crs}"                # {crs_note}
gsd_m = 0.5
{bounds}sheets = [{sheets}]

[footprints]
paths = ["sheets/*.dxf"]         # below data/source/{name}/
attribution = "국토지리정보원 (National Geographic Information Institute), 수치지형도"

# [imagery]                      # optional: uncomment one of the kinds described in _template.toml
# kind = "tiles"
# path = "tiles"
# grid = "kakao"
# level = 1
# attribution = "..."
# terms = "..."

[ratio]                          # radii by eq. 3: (n + 1 - k) / n * agl_m * tan(fov_deg / 2)
n = 3
agl_m = 150.0
fov_deg = 43.0
"""


def shipped(file: str, data: Path) -> Path:
    """A file below ``data``, such as ``regions/demo.toml``; where it is not there, the one that ships under that name."""
    own, beside = data / file, SHIPPED / file
    return beside if not own.is_file() and beside.is_file() else own


def region_named(name: str, data: Path) -> tuple[Region, Path]:
    """The region of that name (or of that TOML file) and the folder whose source/, work/ and out/ belong to it."""
    if name.endswith(".toml") or "/" in name:
        return load_region(Path(name)), data
    return load_region(shipped(f"regions/{name}.toml", data)), data


def recipe_named(name: str, data: Path) -> Path:
    """The file of the recipe of that name (or that path)."""
    return Path(name) if name.endswith(".toml") else shipped(f"recipes/{name}.toml", data)


def described_regions(data: Path) -> Iterator[Region]:
    """The regions of ``data``/regions, and those that ship; whoever asks for one with a faulty file is told then."""
    folders = (data / "regions", SHIPPED / "regions")
    for name in sorted({path.name for folder in folders for path in folder.glob("[!_]*.toml")}):
        with suppress(SettingsError):
            yield load_region(shipped(f"regions/{name}", data))


def flown_mark(name: str, data: Path) -> Path:
    """The file that says that a region has been flown over with results where nobody looks for them."""
    return data / "source" / name / "flown"


def note_flown(name: str, data: Path, out: Path) -> None:
    """Keeps in mind that results over a region went to ``out``: such a region is not trained on."""
    usual = (os.path.realpath(data / "out" / name / part) for part in ("flights", "evaluation"))
    if not any(Path(os.path.realpath(out)).is_relative_to(place) for place in usual):
        mark = flown_mark(name, data)
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


def town_style(style: int | None, season: str | None) -> TownStyle | None:
    """The style of a generated region by the keys of its [generate]; None, the plain one, without them."""
    from brmgeo.synth.scene import TownStyle

    if style is None and season is None:
        return None
    drawn = TownStyle() if style is None else TownStyle.varied(style)
    return drawn if season is None else drawn.with_season(season)  # type: ignore[arg-type]


def new_region(
    name: str,
    data: Path,
    sheets: tuple[str, ...] = (),
    bounds: Bounds | None = None,
    bounds_crs: str = LONLAT,
    title: str = "",
) -> Path:
    """Writes data/regions/NAME.toml from sheet numbers or bounds, and returns its path.

    The belt's CRS follows from the sheet numbers, or from the longitude of the bounds' centre; the sheets that
    cover the bounds are worked out. Raises SettingsError for a name that exists or cannot be one, and for sheets
    of different belts.
    """
    path = data / "regions" / f"{name}.toml"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise SettingsError(
            f"new region {name!r}: a name has letters, digits, - and _ only, and begins with one of the first two"
        )
    if path.exists():
        raise SettingsError(f"{path} exists: choose another name, or remove the file first")
    if bool(sheets) == (bounds is not None):
        raise SettingsError(f"new region {name}: give either --sheets or --bounds")
    sheets = tuple(dict.fromkeys(sheets))
    text_bounds = ""
    if bounds is None:
        belts = sorted({belt_for_sheet(s) for s in sheets})
        extents = [sheet_extent(s, belts[0]) for s in sheets]
        if len(belts) > 1:
            raise SettingsError(
                f"new region {name}: sheets lie in the belts {', '.join(belts)}; give the sheets of one belt, or --bounds"
            )
        crs, note = belts[0], "the belt of these sheets"
        left, bottom = min(e[0] for e in extents), min(e[1] for e in extents)
        right, top = max(e[2] for e in extents), max(e[3] for e in extents)
        note += f": x {left:.0f}..{right:.0f}, y {bottom:.0f}..{top:.0f}"
    else:
        crs, placed = _in_metres(name, bounds, bounds_crs, data)
        if (placed[2] - placed[0]) * (placed[3] - placed[1]) > MAX_AREA_M2:
            raise SettingsError(
                f"new region {name}: bounds {bounds} span {(placed[2] - placed[0]) / 1000:.0f} x "
                f"{(placed[3] - placed[1]) / 1000:.0f} km; a region has at most 100 x 100 km, give smaller bounds"
            )
        sheets = tuple(sheets_covering(placed, crs))
        text_bounds = (
            f"bounds = [{', '.join(f'{v:.1f}' for v in placed)}]   # left, bottom, right, top in metres\n"
        )
        note = "the belt at this longitude"
    text = _TEXT.format(
        name=name,
        template=shipped("regions/_template.toml", data),
        title=json.dumps(title or name, ensure_ascii=False),  # TOML's strings are JSON's
        crs=crs,
        crs_note=note,
        bounds=text_bounds,
        sheets=", ".join(f'"{s}"' for s in sheets),
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as draft:
            draft.write_text(text, encoding="utf-8")
            build(read_toml(draft), Region)
    except OSError as error:
        raise WorkflowError(f"{path} cannot be written: {told(error)} (--data)") from None
    return path


def _in_metres(name: str, bounds: Bounds, bounds_crs: str, data: Path) -> tuple[str, Bounds]:
    """The belt's CRS and the bounds in it, widened to whole metres."""
    left, bottom, right, top = bounds
    if not all(map(math.isfinite, bounds)) or not (left < right and bottom < top):
        raise SettingsError(
            f"new region {name}: bounds {bounds} must be left,bottom,right,top with left < right, bottom < top"
        )
    if bounds_crs == LONLAT:
        if max(abs(left), abs(right)) > 180 or max(abs(bottom), abs(top)) > 90:
            raise SettingsError(
                f"new region {name}: bounds {bounds} are not degrees; give --crs EPSG:... for bounds in metres"
            )
        crs = _belt(name, (left + right) / 2, data)
        left, bottom, right, top = transform_bounds(LONLAT, crs, bounds)
    else:
        require_projected_metres(bounds_crs)
        to_lonlat: Transformer = transformer(bounds_crs, LONLAT)
        lon, _ = to_lonlat.transform((left + right) / 2, (bottom + top) / 2)
        crs = crs_name(bounds_crs)
        _belt(name, lon, data)
    return crs, (
        float(math.floor(left)),
        float(math.floor(bottom)),
        float(math.ceil(right)),
        float(math.ceil(top)),
    )


def _belt(name: str, lon_deg: float, data: Path) -> str:
    try:
        return belt_for_lon(lon_deg)
    except CrsError:
        raise SettingsError(
            f"new region {name}: longitude {lon_deg:.2f} lies outside Korea (123-133 E), where NGII's sheets are; elsewhere "
            f"copy {shipped('regions/_template.toml', data)} and state crs, bounds and paths yourself, or use brmgeo maps "
            "--footprints"
        ) from None


def where_to_get(sheet: str) -> str:
    """How a person gets an NGII sheet, in half a sentence."""
    return f"{NGII} (국토정보플랫폼, 수치지형도, sheet {sheet}; free after registering)"


def safe_name(text: str) -> str:
    """The text as the name of a region or folder: ASCII letters, digits, - and _."""
    name = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in text).strip("-_")
    return name[:64] or "region"
