"""What ``localize`` wrote, in another format or CRS: nothing is estimated anew, nothing is left out."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyogrio
import pyogrio.errors
import shapely
from pyproj import CRS

from brmgeo.errors import CrsError, InputError, MissingInputError, SettingsError, one_line
from brmgeo.files import clear_scratch, plain_cell, read_json, write_bytes
from brmgeo.geo.crs import LONLAT, parse_crs
from brmgeo.geo.formats import vector_file

if TYPE_CHECKING:
    import geopandas

WHAT = ("online", "smoothed", "reference", "candidates")
DRIVERS = {".gpkg": "GPKG", ".geojson": "GeoJSON", ".csv": "CSV"}


def export_results(results: Path, what: str, out: Path, crs: str | None) -> str:
    """Writes one path, or the candidates, of a results folder as points into ``out``; returns a line that tells what.

    The suffix of ``out`` names the format: .gpkg, .geojson (always longitude and latitude) or .csv (columns x, y, or
    lon, lat for a geographic CRS). ``crs`` is that of the map where it is not given. Columns are those of the results.

    Texts of a .csv are ``plain_cell``s.

    Raises MissingInputError where the results have no such path, InputError for damaged ones, SettingsError for an unknown
    format or a CRS that GeoJSON cannot have, CrsError for an unknown one.
    """
    driver = DRIVERS.get(out.suffix.lower())
    if driver is None:
        raise SettingsError(
            f"export --out {out}: give a name that ends in one of {', '.join(DRIVERS)} (trajectory.tum is in the results)"
        )
    target = None if crs is None else parse_crs(crs)
    if target is not None and (not (target.is_projected or target.is_geographic)):
        raise CrsError(
            f"crs {crs!r} is {target.name}, which has no x, y or longitude, latitude: give another",
            needs="crs",
        )
    if driver == "GeoJSON":
        if target is not None and target != parse_crs(LONLAT):
            raise SettingsError(
                f"export --crs {crs}: GeoJSON is longitude and latitude by its standard; leave --crs out or write .gpkg"
            )
        target = parse_crs(LONLAT)
    if not out.absolute().parent.is_dir():
        raise SettingsError(f"export --out {out}: there is no folder {out.parent}; make it or choose another")
    source, layer = _source(results, what)
    if out.exists() and out.samefile(source):
        raise SettingsError(f"export --out {out}: that is the file it is read from; choose another name")
    frame = _points(source, layer)
    if what == "candidates" and source.suffix == ".geojson" and target is None:
        target = _map_crs(source, frame)
    if target is not None:
        frame = frame.to_crs(target)
        if not np.isfinite(shapely.get_coordinates(frame.geometry.array)).all():
            raise CrsError(
                f"{source}: points of {what} have no place in {target.name}: give another CRS", needs="crs"
            )
    # Columns that name a place are of the CRS that is written, or they would contradict the points.
    frame = frame.drop(columns=[c for c in ("x", "y", "epsg") if c in frame])
    names = ("lon", "lat") if frame.crs.is_geographic else ("x", "y")
    digits = 8 if frame.crs.is_geographic else 4
    for name, values in zip(names, (frame.geometry.x, frame.geometry.y), strict=True):
        frame[name] = values.round(digits)
    if driver == "CSV":
        columns = [*names, *(c for c in frame.columns if c not in (*names, "geometry"))]
        table = frame[columns].map(lambda cell: plain_cell(cell) if isinstance(cell, str) else cell)
        data = table.to_csv(index=False, lineterminator="\n").encode()
    else:
        # In memory first: GDAL's writer of GeoJSON does not tell that a disk is full.
        buffer = io.BytesIO()
        pyogrio.write_dataframe(frame, buffer, layer=what, driver=driver)
        data = buffer.getvalue()
    clear_scratch(out.absolute().parent)
    write_bytes(out, data)
    return f"wrote {out}: {what}, {len(frame)} points, {frame.crs.name}"


def _points(source: Path, layer: str | None) -> geopandas.GeoDataFrame:
    """The points of a file of results, all with a place in a known CRS; InputError for others, or a file that is damaged."""
    try:
        frame = pyogrio.read_dataframe(vector_file(source), layer=layer)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, ValueError) as error:
        raise _damaged(source, one_line(error)) from None
    if "geometry" not in frame or frame.crs is None:
        raise _damaged(source, "its features have no place" if "geometry" not in frame else "it names no CRS")
    wrong = ~(shapely.get_type_id(frame.geometry.array) == shapely.GeometryType.POINT)
    wrong |= shapely.is_empty(frame.geometry.array)
    if wrong.any():
        raise _damaged(source, f"{wrong.sum()} of {len(frame)} features are no points")
    # GDAL passes over what is no feature without a word.
    told = read_json(source) if source.suffix == ".geojson" else None
    features = told.get("features") if isinstance(told, dict) else None
    if isinstance(features, list) and len(features) != len(frame):
        raise _damaged(source, f"{len(features) - len(frame)} of {len(features)} features are none")
    return frame


def _map_crs(source: Path, frame: geopandas.GeoDataFrame) -> CRS:
    """The CRS of the map, which GeoJSON tells as a property of its points; longitude and latitude where it has no code."""
    if not len(frame):
        return parse_crs(LONLAT)
    codes = frame["epsg"].dropna().unique().tolist() if "epsg" in frame else [""]
    if not codes:
        return parse_crs(LONLAT)
    if len(codes) > 1 or not isinstance(codes[0], int | float) or codes[0] != int(codes[0]):
        raise _damaged(source, "its points do not name the map's CRS as one number, epsg")
    return parse_crs(f"EPSG:{int(codes[0])}")


def _damaged(source: Path, why: str) -> InputError:
    return InputError(f"{source}: not as localize wrote it ({why}): run localize again")


def _source(results: Path, what: str) -> tuple[Path, str | None]:
    """The file that holds it, and its layer."""
    if not (results / "fixes.csv").is_file():
        raise MissingInputError(
            f"{results / 'fixes.csv'} is not there; give a folder that brmgeo localize wrote"
        )
    if what == "candidates":
        found = [p for p in (results / "candidates.geojson", results / "candidates.gpkg") if p.is_file()]
        if not found:
            raise MissingInputError(f"{results}: no candidates.geojson or .gpkg; run localize again")
        return found[0], None
    path = results / "trajectory.gpkg"
    if not path.is_file():
        raise MissingInputError(f"{path} is not there; run localize again")
    try:
        layers = [str(name) for name, _ in pyogrio.list_layers(vector_file(path))]
    except pyogrio.errors.DataSourceError as error:
        raise _damaged(path, one_line(error)) from None
    if what not in layers:
        there = ", ".join(itertools.filterfalse(lambda n: n not in WHAT, layers))
        raise MissingInputError(f"{path}: these results have no {what} path; there are {there}")
    return path, what
