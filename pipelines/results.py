"""What ``localize`` wrote, in another format or CRS: nothing is estimated anew, nothing is left out."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyogrio

from brmgeo.errors import InputError, MissingInputError, SettingsError, WorkflowError, one_line
from brmgeo.files import clear_scratch, whole_file
from brmgeo.geo.crs import LONLAT, parse_crs
from brmgeo.geo.formats import vector_file
from brmgeo.workflow.disk import disk_errors

WHAT = ("online", "smoothed", "reference", "candidates")
DRIVERS = {".gpkg": "GPKG", ".geojson": "GeoJSON", ".csv": "CSV"}


def export_results(results: Path, what: str, out: Path, crs: str | None) -> str:
    """Writes one path, or the candidates, of a results folder as points into ``out``; returns a line that tells what.

    The suffix of ``out`` names the format: .gpkg, .geojson (always longitude and latitude) or .csv (columns x, y, or
    lon, lat for a geographic CRS). ``crs`` is that of the map where it is not given. Columns are those of the results.

    Raises MissingInputError where the results have no such path, InputError for damaged ones, SettingsError for an unknown
    format or a CRS that GeoJSON cannot have, CrsError for an unknown one, WorkflowError where the disk does not take it.
    """
    driver = DRIVERS.get(out.suffix.lower())
    if driver is None:
        raise SettingsError(
            f"export --out {out}: give a name that ends in one of {', '.join(DRIVERS)} (trajectory.tum is in the results)"
        )
    target = None if crs is None else parse_crs(crs)
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
    with _damage_told(source):
        frame = pyogrio.read_dataframe(vector_file(source), layer=layer)
        if not (frame.geom_type == "Point").all():
            raise ValueError("there are other shapes than points")
        if what == "candidates" and source.suffix == ".geojson" and target is None:
            epsg = frame["epsg"].dropna()
            target = parse_crs(f"EPSG:{int(epsg.iloc[0])}") if len(epsg) else parse_crs(LONLAT)
    if target is not None:
        frame = frame.to_crs(target)
    # Columns that name a place are of the CRS that is written, or they would contradict the points.
    frame = frame.drop(columns=[c for c in ("x", "y", "epsg") if c in frame])
    names = ("lon", "lat") if frame.crs.is_geographic else ("x", "y")
    digits = 8 if frame.crs.is_geographic else 4
    for name, values in zip(names, (frame.geometry.x, frame.geometry.y), strict=True):
        frame[name] = values.round(digits)
    clear_scratch(out.absolute().parent)
    with whole_file(out) as scratch, disk_errors(f"export --out {out}", out.absolute().parent):
        if driver == "CSV":
            columns = [*names, *(c for c in frame.columns if c not in (*names, "geometry"))]
            frame[columns].to_csv(scratch, index=False, lineterminator="\n")
        else:
            _write(frame, scratch, out, what, driver)
    return f"wrote {out}: {what}, {len(frame)} points, {frame.crs.name}"


def _write(frame: Any, scratch: Path, out: Path, layer: str, driver: str) -> None:
    # GDAL does not tell of every write that a full disk did not take.
    try:
        pyogrio.write_dataframe(frame, scratch, layer=layer, driver=driver)
        written = pyogrio.read_info(vector_file(scratch), layer=layer, force_feature_count=True)["features"]
        reason = f"{written} of {len(frame)} points came through" if written != len(frame) else ""
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, InputError) as error:
        reason = one_line(error, 120)
    if reason:
        raise WorkflowError(f"{out}: cannot be written ({reason}): check space and rights")


@contextmanager
def _damage_told(path: Path) -> Iterator[None]:
    try:
        yield
    except (
        pyogrio.errors.DataSourceError,
        pyogrio.errors.DataLayerError,
        ValueError,
        OverflowError,
        LookupError,
        AttributeError,  # a layer without a geometry
    ) as error:
        raise InputError(
            f"{path}: not as localize wrote it ({one_line(error, 120)}): run localize again"
        ) from None


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
    with _damage_told(path):
        layers = [str(name) for name, _ in pyogrio.list_layers(vector_file(path))]
    if what not in layers:
        there = ", ".join(itertools.filterfalse(lambda n: n not in WHAT, layers))
        raise MissingInputError(f"{path}: these results have no {what} path; there are {there}")
    return path, what
