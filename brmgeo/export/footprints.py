"""Footprints as a GeoPackage: layers ``footprints`` and ``sheets``, ``repairs`` on request; same values, same bytes."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from brmgeo.errors import WorkflowError, one_line
from brmgeo.export.vector import fixed_date
from brmgeo.extras import extra
from brmgeo.files import whole_file

with extra("maps", "writing footprints"):
    import geopandas as gpd
    import pyogrio


class RepairLike(Protocol):
    """What a row of the layer ``repairs`` needs; see ``ingest.repair.Repair``."""

    @property
    def kind(self) -> str: ...
    @property
    def handle(self) -> str: ...
    @property
    def layer(self) -> str: ...
    @property
    def x(self) -> float: ...
    @property
    def y(self) -> float: ...
    @property
    def detail(self) -> str: ...
    @property
    def source(self) -> str: ...


def write_footprints_gpkg(
    path: str | Path,
    footprints: gpd.GeoDataFrame,
    sheets: gpd.GeoDataFrame,
    repairs: Sequence[RepairLike] | None = None,
) -> None:
    """Writes a GeoPackage with layers ``footprints`` and ``sheets``, and ``repairs`` (points) where they are given.

    Rows are written in their order; the same values give the same bytes. An existing file is replaced as a whole. Raises
    WorkflowError when the file cannot be written.

    Args:
        path: the .gpkg file.
        footprints, sheets: GeoDataFrames with one CRS; see ``ingest.footprints.Footprints``.
        repairs: repairs with x, y in that CRS; those without a place are left out.
    """
    path = Path(path)
    layers = {"footprints": (footprints, "Polygon"), "sheets": (sheets, "Polygon")}
    if repairs is not None:
        layers["repairs"] = (_repair_frame(repairs, footprints.crs), "Point")
    try:
        with whole_file(path) as draft, fixed_date("2000-01-01T00:00:00Z"):
            for name, (frame, kind) in layers.items():
                pyogrio.write_dataframe(
                    frame,
                    draft,
                    layer=name,
                    driver="GPKG",
                    geometry_type=kind,
                    append=draft.exists(),
                    SPATIAL_INDEX="YES",
                    VERSION="1.3",  # the newest that QGIS 3.22 (Debian 12) reads without a warning
                )
            # VACUUM leaves no freed pages behind, whose old contents would differ from run to run.
            with sqlite3.connect(draft) as database:
                database.execute("VACUUM")
            database.close()
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, sqlite3.Error, OSError) as error:
        reason = one_line(error, 160)
        raise WorkflowError(
            f"{path}: the footprints cannot be written ({reason}): check space and rights"
        ) from error


def _repair_frame(repairs: Sequence[RepairLike], crs: object) -> gpd.GeoDataFrame:
    placed = [repair for repair in repairs if np.isfinite(repair.x) and np.isfinite(repair.y)]
    names = ("kind", "source", "layer", "handle", "detail")
    columns = {name: np.array([getattr(repair, name) for repair in placed], dtype=object) for name in names}
    points = gpd.GeoSeries.from_xy([repair.x for repair in placed], [repair.y for repair in placed], crs=crs)
    return gpd.GeoDataFrame(columns, geometry=points, crs=crs)
