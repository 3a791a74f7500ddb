"""Point, line and polygon features out: RFC 7946 GeoJSON lines and GeoPackage layers, the same bytes for the same values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import CrsError
from brmgeo.extras import extra
from brmgeo.files import whole_file
from brmgeo.geo.crs import parse_crs, transformer

with extra("maps", "writing results for GIS"):
    import pyarrow as pa
    import pyogrio
    import shapely


def lonlat(xy: NDArray[np.float64], crs: str) -> NDArray[np.float64]:
    """(n, 2) float64 WGS84 longitude, latitude in degrees of (n, 2) x, y in ``crs``.

    Raises CrsError for a point that has no longitude and latitude.
    """
    lon, lat = transformer(crs, "EPSG:4326").transform(xy[:, 0], xy[:, 1])
    out = np.column_stack([lon, lat]).astype(np.float64, copy=False)
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any():
        x, y = xy[bad][0]
        raise CrsError(
            f"point x {x}, y {y}: has no longitude and latitude in {crs}; check the CRS of the region"
        )
    return out


def epsg_of(crs: str) -> int | None:
    """The EPSG code of a CRS, None when it has none."""
    code = parse_crs(crs).to_epsg()
    return None if code is None else int(code)


def number(value: float, digits: int) -> str:
    """A JSON number with ``digits`` decimals, ``null`` for NaN and infinities."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "null"


def write_geojson(path: Path, name: str, features: Iterable[str]) -> None:
    """A FeatureCollection of ready features (JSON text), one a line, written whole or not at all."""
    with whole_file(path) as scratch, scratch.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f'{{"type":"FeatureCollection","name":"{name}","features":[\n')
        separator = ""
        for feature in features:
            file.write(separator + feature)
            separator = ",\n"
        file.write("\n]}\n")


def write_layer(
    path: Path,
    layer: str,
    geometry: Any,
    geometry_type: Literal["Point", "LineString", "Polygon"],
    crs: str,
    columns: Mapping[str, NDArray[Any]],
) -> None:
    """Adds one layer to the GeoPackage ``path``, which is made when it is not there.

    ``geometry`` (n,) array of shapely geometries; ``columns`` name -> (n,) bool, int, float64 (NaN is NULL), str, or
    datetime64[ms], which is taken and marked as UTC.
    """
    arrays = [pa.array(shapely.to_wkb(geometry), type=pa.binary())]
    for values in columns.values():
        # An empty column of objects tells no type, so texts are named as such.
        kind = {"M": pa.timestamp("ms", tz="UTC"), "O": pa.string()}.get(values.dtype.kind)
        arrays.append(pa.array(values, type=kind, from_pandas=values.dtype.kind == "f"))
    # 1.3 is what the QGIS of a stable distribution reads without a warning.
    options = {"VERSION": "1.3"} if not path.exists() else {}
    with fixed_date():
        # Arrow batches are written several times faster than columns of Python objects.
        pyogrio.write_arrow(
            pa.table(arrays, names=["geom", *columns]),
            path,
            layer=layer,
            driver="GPKG",
            geometry_name="geom",
            geometry_type=geometry_type,
            crs=crs,
            dataset_options=options,
            layer_options={"GEOMETRY_NAME": "geom"},
        )


@contextmanager
def fixed_date(date: str = "2000-01-01T00:00:00.000Z") -> Iterator[None]:
    """GDAL stamps a GeoPackage with the time of writing; this gives it always the same one, so equal contents are equal
    bytes."""
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": date})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})
