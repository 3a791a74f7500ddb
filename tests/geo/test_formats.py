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

from brmgeo.errors import InputError, MissingInputError
from brmgeo.geo.formats import raster_driver, vector_file
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


def test_what_lies_beside_a_raster_leads_nowhere_else(maps: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.tif"
    path.write_bytes((maps / "buildings.tif").read_bytes())
    assert raster_driver(path) == "GTiff"
    (tmp_path / "x.tif.aux.xml").write_text(
        '<MDI key="OVERVIEW_FILE">/vsicurl/http://127.0.0.1:1/x.tif</MDI>'
    )
    with pytest.raises(InputError, match="names another file"):
        raster_driver(path)
    (tmp_path / "x.tif.aux.xml").unlink()
    (tmp_path / "x.tif.ovr").write_text(_pointers("http://127.0.0.1:1")["VRT"])
    with pytest.raises(InputError, match=r"x\.tif\.ovr is no TIFF"):
        raster_driver(path)


@pytest.mark.parametrize("check", [raster_driver, vector_file])
def test_what_is_no_file_is_said(check: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="is not there"):
        check(tmp_path / "none.tif")
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="convert"):
        check(tmp_path / "empty")
    with pytest.raises(InputError, match=r"folder"):
        check(tmp_path)
