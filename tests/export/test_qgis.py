from __future__ import annotations

import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
from small_region import CRS, Region, flight, write_region

from brmgeo.codes import BUILDING_KINDS
from brmgeo.errors import CrsError, InputError
from brmgeo.export import qgis_style
from brmgeo.export.candidates import write_candidates
from brmgeo.export.qgis import style_footprints, write_flight_project, write_maps_project
from brmgeo.export.trajectory import TimedPath, write_trajectory

CHECK = Path(__file__).parents[1] / "qgis" / "check_qgis.py"
SYSTEM_PYTHON = "/usr/bin/python3"
START = datetime(2026, 5, 1, 3, 0, tzinfo=UTC)
ATTRIBUTION = "국토지리정보원 (NGII) & others"


@pytest.fixture(scope="module")
def region(tmp_path_factory: pytest.TempPathFactory) -> Region:
    return write_region(tmp_path_factory.mktemp("region") / "out")


def maps_project(region: Region, path: Path) -> Path:
    return write_maps_project(
        path,
        title="Demo <1>",
        footprints=region.footprints,
        buildings=region.buildings,
        ratio=region.ratio,
        imagery=region.imagery,
        attribution=ATTRIBUTION,
    )


def flight_project(region: Region, limit: int = 100_000, name: str = "mask") -> Path:
    folder = region.folder / "flights" / "square" / name
    folder.mkdir(parents=True, exist_ok=True)
    estimates = flight()
    t_s = np.array([e.t_s for e in estimates])
    xy = np.array([e.mean for e in estimates])
    found = write_candidates(
        folder,
        [(e.t_s, e.candidates, e.candidate_mass, e.status) for e in estimates],
        CRS,
        start_utc=START,
        geojson_limit=limit,
    )
    track = TimedPath(t_s, xy + 1.0, np.full(12, 0.7), np.full(12, 2.0))
    write_trajectory(
        folder, estimates, ["f"] * 12, CRS, start_utc=START, smoothed=track, reference=TimedPath(t_s, xy)
    )
    return write_flight_project(
        folder / "flight.qgz",
        title="Square",
        candidates=found,
        trajectory=folder / "trajectory.gpkg",
        buildings=region.buildings,
        imagery=region.imagery,
        t_s=t_s,
        start_utc=START,
        attribution=ATTRIBUTION,
    )


def opened(path: Path) -> ET.Element:
    with zipfile.ZipFile(path) as archive:
        (name,) = archive.namelist()
        assert name == f"{path.stem}.qgs"
        text = archive.read(name).decode()
    return ET.fromstring(text.split("\n", 1)[1])


def layers_of(root: ET.Element) -> dict[str, ET.Element]:
    return {e.findtext("id", ""): e for e in root.iterfind("projectlayers/maplayer")}


def tree_ids(root: ET.Element) -> list[str]:
    return [e.get("id", "") for e in root.iter("layer-tree-layer")]


def test_layers_are_in_order_and_found_beside_the_project(region: Region, tmp_path: Path) -> None:
    root = opened(maps_project(region, tmp_path / "demo.qgz"))
    ids = [
        f"brmgeo_{name}" for name in ("footprints", "sheets", "buildings", "ratio_1", "ratio_2", "imagery")
    ]
    assert tree_ids(root) == ids == list(layers_of(root))
    # QGIS replaces ids of ten characters or fewer, and then finds none of the layers.
    assert all(len(i) > 10 for i in ids)
    for layer in layers_of(root).values():
        source = layer.findtext("datasource", "")
        assert source.startswith("./")
        assert (region.folder / source.split("|")[0]).is_file()
    assert root.findtext("title") == "Demo <1>"
    assert ATTRIBUTION in root.findtext("projectMetadata/abstract", "")
    checked = {e.get("id"): e.get("checked") for e in root.iter("layer-tree-layer")}
    assert checked["brmgeo_ratio_1"] == "Qt::Checked"
    assert checked["brmgeo_ratio_2"] == "Qt::Unchecked"
    bands = [layers_of(root)[f"brmgeo_ratio_{i}"].find("pipe/rasterrenderer").get("band") for i in (1, 2)]
    assert bands == ["1", "2"]
    assert layers_of(root)["brmgeo_ratio_2"].findtext("layername") == "Within 19.7 m"


def test_every_kind_in_the_footprints_has_a_style_in_plain_words(region: Region, tmp_path: Path) -> None:
    renderer = layers_of(opened(maps_project(region, tmp_path / "d.qgz")))["brmgeo_footprints"].find(
        "renderer-v2"
    )
    assert renderer is not None
    assert renderer.get("attr") == "layer"
    labels = {c.get("value"): c.get("label") for c in renderer.iterfind("categories/category")}
    assert set(gpd.read_file(region.footprints, layer="footprints")["layer"]) == set(labels) - {""}
    assert labels["B0014115"] == "Apartments (아파트)"
    assert labels[""] == "Other"
    assert len(renderer.findall("symbols/symbol")) == len(labels)


def test_the_vector_file_carries_the_styles_and_keeps_its_features(region: Region, tmp_path: Path) -> None:
    copies = [tmp_path / "a.gpkg", tmp_path / "b.gpkg"]
    for copy in copies:
        shutil.copy(region.footprints, copy)
        style_footprints(copy)
    style_footprints(copies[1])
    found = [pyogrio.read_dataframe(c, layer="layer_styles", read_geometry=False) for c in copies]
    assert list(found[0]["f_table_name"]) == ["footprints", "sheets"]
    assert found[0].equals(found[1]), "styling twice is styling once"
    root = ET.fromstring(found[0]["styleQML"][0].split("\n", 1)[1])
    assert root.find("renderer-v2").get("type") == "categorizedSymbol"
    assert root.findtext("layerGeometryType") == "2"
    assert pyogrio.read_dataframe(copies[0], layer="footprints").equals(
        pyogrio.read_dataframe(region.footprints, layer="footprints")
    )


@pytest.mark.parametrize("digit", "012345678")
def test_new_and_old_layer_codes_and_ingest_s_names_mean_the_same_kind(digit: str) -> None:
    assert qgis_style.kind_of(f"B001411{digit}") == qgis_style.kind_of(f"411{digit}")
    assert qgis_style.kind_of(f"411{digit}") is not None
    assert qgis_style.kind_of(BUILDING_KINDS[f"B001411{digit}"]) == qgis_style.kind_of(f"411{digit}")
    assert qgis_style.kind_of("B0014119") is None
    assert qgis_style.kind_of("shed") is None


@pytest.mark.parametrize("limit", [100_000, 10])
def test_flight_project_plays_the_flight_over_the_maps(region: Region, limit: int) -> None:
    path = flight_project(region, limit)
    root = opened(path)
    assert root.findtext("ProjectTimeSettings/TemporalRange/start") == "2026-05-01T03:00:00.000Z"
    assert root.findtext("ProjectTimeSettings/TemporalRange/end") == "2026-05-01T03:00:59.999Z"
    settings = root.find("ProjectTimeSettings")
    assert settings is not None
    assert (settings.get("timeStepUnit"), float(settings.get("timeStep", "0"))) == ("s", 5.0)
    assert root.findtext("properties/TemporalControllerWidget/NavigationMode") == "1"
    layers = layers_of(root)
    for name in ("fix_now", "smoothed_now", "reference_now", "candidates", "trail"):
        temporal = layers[f"brmgeo_{name}"].find("temporal")
        assert temporal is not None, name
        assert (temporal.get("enabled"), temporal.get("startField")) == ("1", "start")
    for layer in layers.values():
        assert (path.parent / layer.findtext("datasource", "").split("|")[0]).resolve().is_file()


def test_the_maps_may_be_named_where_they_will_be(region: Region, tmp_path: Path) -> None:
    source = flight_project(region).parent
    path = write_flight_project(
        tmp_path / "f.qgz",
        title="t",
        candidates=source / "candidates.geojson",
        trajectory=source / "trajectory.gpkg",
        buildings=region.buildings,
        t_s=np.arange(3.0),
        maps_href="../../..",
    )
    layers = layers_of(opened(path))
    assert layers["brmgeo_buildings"].findtext("datasource") == "../../../buildings.tif"
    assert "brmgeo_imagery" not in layers


def test_the_same_inputs_give_the_same_bytes_wherever_they_lie(region: Region, tmp_path: Path) -> None:
    moved = Region(
        tmp_path / "b", *(tmp_path / "b" / p.name for p in _files(region)), polygons=region.polygons
    )
    shutil.copytree(region.folder, moved.folder)
    one, two = (
        maps_project(region, tmp_path / "p.qgz").read_bytes(),
        maps_project(moved, tmp_path / "b" / "p.qgz").read_bytes(),
    )
    assert one == two
    assert flight_project(region, name="x").read_bytes() == flight_project(moved, name="x").read_bytes()


def _files(region: Region) -> tuple[Path, ...]:
    return region.footprints, region.buildings, region.ratio, region.imagery


def test_files_in_two_crs_or_unreadable_ones_are_refused(region: Region, tmp_path: Path) -> None:
    other = tmp_path / "other.gpkg"
    gpd.GeoDataFrame({"layer": ["B0014111"]}, geometry=region.polygons[:1], crs="EPSG:5186").to_file(
        other, layer="footprints"
    )
    arguments = {"title": "t", "buildings": region.buildings, "ratio": region.ratio}
    with pytest.raises(CrsError, match=r"other\.gpkg"):
        write_maps_project(tmp_path / "a.qgz", footprints=other, **arguments)
    (tmp_path / "junk.gpkg").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.gpkg"):
        write_maps_project(tmp_path / "a.qgz", footprints=tmp_path / "junk.gpkg", **arguments)
    with pytest.raises(InputError, match=r"gone\.tif"):
        write_maps_project(
            tmp_path / "a.qgz",
            title="t",
            buildings=tmp_path / "gone.tif",
            ratio=region.ratio,
            footprints=region.footprints,
        )
    with pytest.raises(InputError, match="without frames"):
        write_flight_project(
            tmp_path / "a.qgz",
            title="t",
            candidates=other,
            trajectory=other,
            buildings=region.buildings,
            t_s=np.empty(0),
        )
    assert not (tmp_path / "a.qgz").exists()


# A real QGIS


def run_check(folder: Path, out: Path, zone: str = "UTC") -> subprocess.CompletedProcess[str]:
    clean = {
        k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "GDAL", "PROJ", "VIRTUAL_ENV"))
    }
    clean |= {"QT_QPA_PLATFORM": "offscreen", "TZ": zone, "XDG_RUNTIME_DIR": str(out.parent)}
    return subprocess.run(
        [SYSTEM_PYTHON, str(CHECK), str(folder), "--out", str(out)],
        env=clean,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


@pytest.fixture(scope="module")
def real_qgis() -> None:
    if not Path(SYSTEM_PYTHON).exists():
        pytest.skip(f"{SYSTEM_PYTHON} is not there, so neither is Debian's python3-qgis")
    probe = subprocess.run([SYSTEM_PYTHON, "-c", "import qgis.core"], capture_output=True, check=False)
    if probe.returncode != 0:
        pytest.skip("QGIS is not installed (Debian: apt install qgis python3-qgis)")


@pytest.mark.slow
def test_a_real_qgis_opens_draws_and_plays_them(real_qgis: None, tmp_path: Path) -> None:
    region = write_region(tmp_path / "region")
    maps_project(region, region.folder / "demo.qgz")
    flight_project(region)
    flight_project(region, limit=10, name="ratio")
    # East of Greenwich, where a time read as local would be hours off.
    found = run_check(region.folder, tmp_path / "pictures", zone="Asia/Seoul")
    assert found.returncode == 0, found.stdout + found.stderr
    assert "all well" in found.stdout
    assert found.stdout.count("plays 12 frames") == 2
    names = sorted(p.name for p in (tmp_path / "pictures").iterdir())
    assert "demo.png" in names
    assert "flights-square-mask-flight-late.png" in names


@pytest.mark.slow
def test_the_check_finds_what_is_broken(real_qgis: None, region: Region, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(region.folder, broken)
    shutil.rmtree(broken / "flights", ignore_errors=True)
    maps_project(region, broken / "demo.qgz")
    (broken / "ratio.tif").unlink()
    found = run_check(broken, tmp_path / "pictures")
    assert found.returncode == 1, found.stdout + found.stderr
    assert "layer ratio_1 is not valid" in found.stdout
