"""What a file of rasters or of shapes is, told by its first bytes.

GDAL opens whatever any of its drivers knows, whatever the file's name, and some of its formats are no data but a text that
names other files, services or commands (VRT, WMS, WFS, OGR VRT, GDALG). Who opens a file that people give asks here first.
"""

from __future__ import annotations

import mmap
import os
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import rasterio
from rasterio.errors import NotGeoreferencedWarning

from brmgeo.errors import InputError, MissingInputError
from brmgeo.files import told
from brmgeo.memory import require_memory

# GDAL would ask the host that a GML file names for its schema.
os.environ.setdefault("GML_DOWNLOAD_SCHEMA", "NO")

_HEAD = 1 << 16
# GDAL looks for these anywhere in a file's first bytes.
_POINTERS = re.compile(rb"<OGR\w+DataSource|<GDAL_WM\w+|<VRTDataset|<GDALTileIndexDataset|gdal_streamed_alg")
_RASTERS = (
    (rb"II[*+]\0|MM\0[*+]", "GTiff"),
    (rb"\xff\xd8\xff", "JPEG"),
    (rb"\x89PNG\r\n\x1a\n", "PNG"),
    (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", "JP2OpenJPEG"),
    (rb"RIFF.{4}WEBP", "WEBP"),
    (rb"BM", "BMP"),
    (rb"GIF8[79]a", "GIF"),
    (rb"EHFA_HEADER_TAG", "HFA"),
)
_RASTER_WORDS = "GeoTIFF, JPEG, PNG, JPEG 2000, WebP, BMP, GIF, Erdas Imagine"
# Of a shapefile, sqlite (GeoPackage), FlatGeobuf, Parquet, and of the archive that a shapefile comes in.
_SHAPES = re.compile(rb"\0\0\x27\x0a|SQLite format 3\0|fgb\x03|PAR1")
_ROOTS = {b"kml", b"FeatureCollection", b"osm", b"gpx", b"CityModel"}
_VECTOR_WORDS = "shapefile, GeoPackage, GeoJSON, GeoParquet, FlatGeobuf, KML, GML, OSM, GPX, CSV, MapInfo, File Geodatabase"
_TEXTS = {".csv", ".tsv", ".txt", ".tab", ".mif", ".geojsonl", ".geojsons"}
# A coordinate reference system that GDAL would fetch.
_LINKED_CRS = re.compile(
    rb'"crs"\s*:\s*\{[^{}]*(?:\{[^{}]*\}[^{}]*)?"type"\s*:\s*"(?:link|url)', re.IGNORECASE
)
# What lies beside or within a shapefile.
_BESIDE = {
    ".dbf",
    ".shx",
    ".prj",
    ".cpg",
    ".qpj",
    ".sbn",
    ".sbx",
    ".qix",
    ".xml",
    ".qmd",
    ".fix",
    ".idx",
    ".ind",
}


def raster_driver(path: Path) -> str:
    """The GDAL driver of a raster file; MissingInputError where it is not there, InputError for any other format."""
    head = _head_of(path)
    found = next((driver for magic, driver in _RASTERS if re.match(magic, head, re.DOTALL)), None)
    if found is None:
        raise InputError(
            f"{path} is not a readable image or raster ({_RASTER_WORDS}){_named_in(head)}; convert or fetch it again"
        )
    return found


def open_raster(path: Path) -> Any:
    """A raster file opened for reading by rasterio, whose errors pass.

    Raises MissingInputError and InputError as ``raster_driver``, and InputError where the file, or one beside it, names
    another as its overview, which GDAL would open, whatever it is.
    """
    driver = raster_driver(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for beside in _overviews_and_masks(path):
            if raster_driver(beside) != "GTiff":
                raise InputError(
                    f"{beside} is no TIFF, as what lies beside {path.name} must be: move it away"
                )
            open_raster(beside).close()
    src = rasterio.open(path, driver=driver)
    if any(name.upper() == "OVERVIEW_FILE" for name in src.tags(ns="OVERVIEWS")):
        src.close()
        raise InputError(
            f"{path}: it, or its .aux.xml, names another file as its overview, which is not followed: convert it"
        )
    return src


def _overviews_and_masks(path: Path) -> list[Path]:
    """Files whose names say that they are the raster's; GDAL does not tell upper from lower case there."""
    wanted = {path.name.lower() + suffix for suffix in (".ovr", ".msk")}
    return [path.with_name(name) for name in os.listdir(path.parent) if name.lower() in wanted]


def vector_file(path: Path) -> Path:
    """The absolute path of a file of shapes that may be opened by GDAL.

    Raises MissingInputError where it is not there, InputError for any other format than those that hold shapes themselves.
    """
    path = path.absolute()
    if path.is_dir():
        if path.suffix.lower() != ".gdb":
            raise InputError(f"{path} is a folder: give a file of shapes ({_VECTOR_WORDS})")
        return path
    head = _head_of(path)
    if head.startswith(b"PK\x03\x04"):
        _require_shapes_inside(path)
    else:
        _require_shapes(head, path.suffix.lower(), str(path))
        if _is_json(head):
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
                _require_own_crs(whole, str(path))
    return path


def _is_json(head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith((b"{", b"["))


def _require_own_crs(text: bytes | mmap.mmap, name: str) -> None:
    if _LINKED_CRS.search(text):
        raise InputError(
            f"{name}: its CRS is a link, which is not followed: write it in longitude and latitude"
        )


def _require_shapes_inside(path: Path) -> None:
    try:
        with zipfile.ZipFile(path) as packed:
            require_memory(
                sum(info.file_size for info in packed.infolist()),
                f"{path.name}, unpacked,",
                "unpack it and cut out the area that you need",
            )
            for info in packed.infolist():
                suffix = Path(info.filename).suffix.lower()
                if info.is_dir() or suffix in _BESIDE:
                    continue
                with packed.open(info) as member:
                    _require_shapes(member.read(_HEAD), suffix, f"{path}: {info.filename}")
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError) as error:
        raise InputError(
            f"{path} is no readable zip archive ({error}): unpack it and give what is inside"
        ) from None


def _require_shapes(head: bytes, suffix: str, name: str) -> None:
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if _POINTERS.search(head):
        good = False
    elif _is_json(head):
        _require_own_crs(head, name)
        good = True
    elif text.startswith(b"<"):
        good = _root_of(text) in _ROOTS
    elif suffix == ".tab":
        good = text.lower().startswith(b"!table") and b"native" in text.lower()
    else:
        # A block of an OSM .pbf begins with its length and the word OSMHeader.
        good = (
            _SHAPES.match(head) is not None
            or b"OSMHeader" in head[:32]
            or (suffix in _TEXTS and b"\0" not in head)
        )
    if not good:
        raise InputError(
            f"{name} holds no shapes in a format that is read here ({_VECTOR_WORDS}){_named_in(head)}; convert it or "
            "fetch it again"
        )


def _root_of(text: bytes) -> bytes:
    """The local name of the first element of XML, b"" where there is none in the first bytes."""
    found = re.search(
        rb"<(?:[\w.-]+:)?([A-Za-z_][\w.-]*)", re.sub(rb"<!--.*?-->", b"", text, flags=re.DOTALL)
    )
    return found[1] if found else b""


def _named_in(head: bytes) -> str:
    """For a message: that this is a text that points elsewhere, which nobody would take for data."""
    found = _POINTERS.search(head)
    if found is None:
        return ""
    return f": it is a text ({found[0].decode().strip('<')}) that points to other sources, which are not followed"


def _head_of(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD)
    except FileNotFoundError:
        raise MissingInputError(f"{path} is not there: check its name") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {told(error)}") from None
