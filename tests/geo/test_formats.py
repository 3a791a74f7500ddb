"""Which files of rasters and shapes are opened: those that hold their data, by whatever name, and no others."""

from __future__ import annotations

import http.server
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from affine import Affine
from small_flights import CRS, LEFT, TOP, Said

from brmgeo import memory
from brmgeo.errors import InputError, MissingInputError
from brmgeo.geo.formats import open_raster, raster_driver, vector_file
from brmgeo.ingest.footprints import read_footprints

SQUARE = gpd.GeoDataFrame(geometry=[shapely.box(LEFT, TOP - 20, LEFT + 20, TOP)], crs=CRS)


@pytest.fixture
def host() -> Iterator[tuple[str, list[str]]]:
    """A server and what it was asked for."""
    asked: list[str] = []

    class Asked(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Asked)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}", asked
    server.shutdown()
    thread.join()
    server.server_close()


def _pointers(url: str) -> dict[str, str]:
    """Texts that make GDAL ask a host, by the format that they are."""
    return {
        "VRT": (
            '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
            f"<SourceFilename>/vsicurl/{url}/x.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource>"
            "</VRTRasterBand></VRTDataset>"
        ),
        "GDAL_WMS": f'<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}</ServerUrl></Service></GDAL_WMS>',
        "OGR VRT": (
            f'<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/{url}/x.geojson</SrcDataSource>'
            "</OGRVRTLayer></OGRVRTDataSource>"
        ),
        "WFS": f"<OGRWFSDataSource><URL>{url}</URL></OGRWFSDataSource>",
        "GDALG": (
            '{"type": "gdal_streamed_alg", "command_line": '
            f'"gdal vector pipeline ! read /vsicurl/{url}/x.geojson ! write streamed_file"}}'
        ),
    }


@pytest.mark.parametrize("kind", ["VRT", "GDAL_WMS"])
def test_a_raster_that_points_elsewhere_is_refused_and_nobody_is_asked(
    kind: str, host: tuple[str, list[str]], say: Callable[..., Said], maps: Path, tmp_path: Path
) -> None:
    url, asked = host
    path = tmp_path / "x.tif"
    path.write_text(_pointers(url)[kind])
    words = ["maps", "--footprints", maps / "footprints.gpkg", "--crs", CRS, "--scheduler", "serial"]
    told = say(*words, "--imagery", path, "--out", tmp_path / "o")
    assert told.code == 2
    assert "points to other sources" in told.line
    assert say("segment", path, "--out", tmp_path / "o.tif").code == 2
    assert asked == []


@pytest.mark.parametrize("suffix", [".gpkg", ".geojson", ".shp", ".kml", ".parquet", ".csv"])
@pytest.mark.parametrize("kind", ["OGR VRT", "WFS", "GDALG"])
def test_shapes_that_point_elsewhere_are_refused_and_nobody_is_asked(
    kind: str, suffix: str, host: tuple[str, list[str]], tmp_path: Path
) -> None:
    url, asked = host
    path = tmp_path / f"x{suffix}"
    path.write_text(_pointers(url)[kind])
    with pytest.raises(InputError):
        read_footprints(path, CRS)
    assert asked == []


def test_a_pointer_in_an_archive_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as packed:
        packed.writestr("x.shp", _pointers("http://127.0.0.1:1")["OGR VRT"])
    with pytest.raises(InputError, match="points to other sources"):
        vector_file(tmp_path / "x.zip")


def test_an_archive_that_unpacks_to_more_than_there_is_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("x.geojson", b"{" + b" " * 1_000_000 + b"}")
    monkeypatch.setattr(memory, "free_bytes", lambda: 500_000)
    with pytest.raises(InputError, match=r"x\.zip, unpacked, takes"):
        vector_file(tmp_path / "x.zip")


@pytest.mark.parametrize(
    "driver", ["GPKG", "GeoJSON", "ESRI Shapefile", "FlatGeobuf", "KML", "GML", "GeoJSONSeq", "SQLite"]
)
def test_files_that_hold_shapes_are_opened_by_their_content(driver: str, tmp_path: Path) -> None:
    # Some are written under their own ending only.
    endings = {"ESRI Shapefile": ".shp", "GPKG": ".gpkg", "FlatGeobuf": ".fgb"}
    path = tmp_path / f"x{endings.get(driver, '')}"
    pyogrio.write_dataframe(SQUARE.to_crs("EPSG:4326"), path, driver=driver)
    assert vector_file(path) == path


def test_parquet_and_csv_are_opened(tmp_path: Path) -> None:
    SQUARE.to_parquet(tmp_path / "x.parquet")
    SQUARE.assign(WKT=SQUARE.geometry.to_wkt()).drop(columns="geometry").to_csv(tmp_path / "x.csv")
    assert vector_file(tmp_path / "x.parquet").name == "x.parquet"
    assert vector_file(tmp_path / "x.csv").name == "x.csv"


@pytest.mark.parametrize("driver", ["GTiff", "PNG", "JPEG", "BMP", "GIF", "JP2OpenJPEG", "HFA"])
def test_rasters_are_opened_by_their_content(driver: str, tmp_path: Path) -> None:
    pixels = np.arange(64 * 64, dtype=np.uint8).reshape(1, 64, 64)
    profile = {"height": 64, "width": 64, "count": 1, "dtype": "uint8"}
    with rasterio.MemoryFile() as memory:
        with memory.open(driver="GTiff", transform=Affine(1, 0, LEFT, 0, -1, TOP), crs=CRS, **profile) as out:
            out.write(pixels)
        rasterio.shutil.copy(memory.name, tmp_path / "odd", driver=driver)
    assert raster_driver(tmp_path / "odd") == driver


@pytest.mark.parametrize("name", ["x.tif.ovr", "x.tif.OVR", "X.tif.Msk"])
def test_what_lies_beside_a_raster_leads_nowhere_else(
    name: str, host: tuple[str, list[str]], maps: Path, tmp_path: Path
) -> None:
    path = tmp_path / "x.tif"
    path.write_bytes((maps / "buildings.tif").read_bytes())
    open_raster(path).close()
    (tmp_path / name).write_bytes(path.read_bytes())
    open_raster(path).close()
    (tmp_path / name).write_text(_pointers(host[0])["VRT"])
    with pytest.raises(InputError, match=f"{name} is not .*points to other sources"):
        open_raster(path)
    (tmp_path / name).write_bytes(b"BM" + bytes(99))
    with pytest.raises(InputError, match=f"{name} is no TIFF"):
        open_raster(path)
    assert host[1] == []


@pytest.mark.parametrize("key", ["OVERVIEW_FILE", "overview_file", "OVERVIEW&#95;FILE", None])
def test_an_overview_elsewhere_is_not_followed(
    key: str | None, host: tuple[str, list[str]], maps: Path, tmp_path: Path
) -> None:
    """Neither one that a file beside it names, nor its own tags."""
    path, elsewhere = tmp_path / "x.tif", f"/vsicurl/{host[0]}/x.tif"
    path.write_bytes((maps / "buildings.tif").read_bytes())
    if key is None:
        profile = {"width": 64, "height": 64, "count": 1, "dtype": "uint8", "crs": CRS}
        with rasterio.open(
            path, "w", driver="GTiff", transform=Affine(1, 0, LEFT, 0, -1, TOP), **profile
        ) as out:
            out.write(np.ones((1, 64, 64), np.uint8))
            out.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=elsewhere)
    else:
        entry = f'<MDI key="{key}">{elsewhere}</MDI>'
        (tmp_path / "x.tif.aux.xml").write_text(
            f'<PAMDataset><Metadata domain="OVERVIEWS">{entry}</Metadata></PAMDataset>'
        )
    with pytest.raises(InputError, match="names another file"):
        open_raster(path)
    assert host[1] == []


def test_schemas_and_reference_systems_are_not_fetched(host: tuple[str, list[str]], tmp_path: Path) -> None:
    url, asked = host
    gml = tmp_path / "x.gml"
    gml.write_text(
        '<wfs:FeatureCollection xmlns:wfs="http://www.opengis.net/wfs" xmlns:gml="http://www.opengis.net/gml" '
        'xmlns:a="http://a" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        f'xsi:schemaLocation="http://a {url}/?SERVICE=WFS&amp;VERSION=1.0.0&amp;REQUEST=DescribeFeatureType">'
        "<gml:featureMember><a:b><a:g><gml:Polygon><gml:outerBoundaryIs><gml:LinearRing><gml:coordinates>"
        f"{LEFT},{TOP} {LEFT},{TOP - 20} {LEFT + 20},{TOP} {LEFT},{TOP}"
        "</gml:coordinates></gml:LinearRing></gml:outerBoundaryIs></gml:Polygon></a:g></a:b></gml:featureMember>"
        "</wfs:FeatureCollection>"
    )
    assert len(read_footprints(gml, CRS, source_crs=CRS).frame) == 1
    linked = tmp_path / "x.geojson"
    pyogrio.write_dataframe(SQUARE.to_crs("EPSG:4326"), linked, driver="GeoJSON")
    crs = f'"crs": {{"type": "link", "properties": {{"href": "{url}/crs", "type": "proj4"}}}},'
    linked.write_text(linked.read_text().replace("{", "{" + crs, 1))
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as packed:
        packed.write(linked, "x.geojson")
    for path in (linked, tmp_path / "x.zip"):
        with pytest.raises(InputError, match="its CRS is a link"):
            read_footprints(path, CRS)
    assert asked == []


@pytest.mark.parametrize("check", [raster_driver, vector_file])
def test_what_is_no_file_is_said(check: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="is not there"):
        check(tmp_path / "none.tif")
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="convert"):
        check(tmp_path / "empty")
    with pytest.raises(InputError, match=r"folder"):
        check(tmp_path)
