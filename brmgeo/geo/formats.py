"""What a file of rasters or of shapes is, told by its first bytes.

GDAL opens whatever any of its drivers knows, whatever the file's name, and some of its formats are no data but a text that
names other files, services or commands (VRT, WMS, WFS, OGR VRT, GDALG). Who opens a file that people give asks here first.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

from brmgeo.errors import InputError, MissingInputError
from brmgeo.files import told

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
    """The GDAL driver of a raster file, for ``rasterio.open(path, driver=...)``.

    Raises MissingInputError where it is not there, InputError for any other format, and where a file beside it would make
    GDAL open something else.
    """
    head = _head_of(path)
    found = next((driver for magic, driver in _RASTERS if re.match(magic, head, re.DOTALL)), None)
    if found is None:
        raise InputError(
            f"{path} is not a readable image or raster ({_RASTER_WORDS}){_named_in(head)}; convert or fetch it again"
        )
    for suffix in (".ovr", ".msk"):
        beside = path.with_name(path.name + suffix)
        if beside.is_file() and not re.match(_RASTERS[0][0], _head_of(beside)):
            raise InputError(f"{beside} is no TIFF, as what lies beside {path.name} must be: move it away")
    for beside in (path.with_name(f"{path.name}.aux.xml"), path.with_suffix(".aux.xml")):
        if beside.is_file() and b"OVERVIEW_FILE" in beside.read_bytes():
            raise InputError(f"{beside} names another file to be read for {path.name}: move it away")
    return found


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
    return path


def _require_shapes_inside(path: Path) -> None:
    try:
        with zipfile.ZipFile(path) as packed:
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
    elif text.startswith((b"{", b"[")):
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
