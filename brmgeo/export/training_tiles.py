"""The index of training tiles as a GeoPackage: where they lie, their splits, and the measured offsets of their labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from brmgeo.export.qgis_style import Style, add_default_styles, categorized, fill, line, single
from brmgeo.export.vector import write_layer

ARROW = 20.0


def write_tiles_gpkg(
    path: Path, rows: Sequence[Mapping[str, Any]], credit: str, blocks: Sequence[Mapping[str, Any]]
) -> None:
    """Writes ``tiles``, one polygon a tile, coloured by split when QGIS opens it, and ``alignment``, the measured offsets as
    lines ARROW times as long.

    Args:
        rows: of the index of training tiles, with place and CRS.
        credit: whose the tiles are.
        blocks: of alignment.json; those that tell are drawn.
    """
    colours = {"train": "#2f6bff", "validation": "#ffb02e", "test": "#e0457b"}
    boxes = np.array([shapely.box(*(row[n] for n in ("left", "bottom", "right", "top"))) for row in rows])
    columns: dict[str, NDArray[Any]] = {
        name: np.array([row[name] for row in rows], dtype=object)
        for name in ("key", "region", "split", "image_name")
    }
    for name in ("gsd_m", "building_share", "known_share"):
        columns[name] = np.array([row[name] for row in rows], dtype=np.float64)
    columns["shard"] = np.array([row["shard"] for row in rows], dtype=np.int64)
    columns["source"] = np.array([credit] * len(rows), dtype=object)
    write_layer(path, "tiles", boxes, "Polygon", rows[0]["crs"], columns)
    style = categorized(
        "split", [(name, name.capitalize(), [fill(c, 45, c, 0.4)]) for name, c in colours.items()]
    )
    styles: dict[str, tuple[Style, str]] = {"tiles": ([style], "Polygon")}
    told = [b for b in blocks if b["status"] == "told"]
    if told:
        numbers = np.array([[*b["bounds"], b["dx_m"], b["dy_m"]] for b in told], dtype=np.float64)
        middle = (numbers[:, :2] + numbers[:, 2:4]) / 2
        arrows = shapely.linestrings(np.stack([middle, middle + ARROW * numbers[:, 4:]], axis=1))
        values = {
            name: np.array([b[name] for b in told], dtype=np.float64) for name in ("dx_m", "dy_m", "quality")
        }
        write_layer(path, "alignment", arrows, "LineString", rows[0]["crs"], values)
        styles["alignment"] = ([single(line("#10141c", 1.1), line("#35e0c8", 0.6))], "Line")
    add_default_styles(path, styles)
