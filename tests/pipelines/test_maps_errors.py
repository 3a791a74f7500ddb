"""What people and machines do to `brmgeo maps`: each ends in one line that says what, where and what to do."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import ezdxf
import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from PIL import Image
from small_maps import BOUNDS, CRS, LEVEL, SHEETS, Answer, SmallRegion, brmgeo, rasters_of

from brmgeo.workflow.store import Store
from pipelines.maps import maps_of_files

FIRST, SECOND = SHEETS
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def region(built: SmallRegion, tmp_path: Path) -> SmallRegion:
    """A copy of the built region to be spoilt."""
    return built.copied_to(tmp_path / "data")


@pytest.fixture
def maps(region: SmallRegion, built: SmallRegion, capsys: Capture) -> Iterator[Callable[[], Answer]]:
    """Runs `brmgeo maps` on the spoilt copy; afterwards what was published before must be there as it was."""
    yield lambda: brmgeo(capsys, "maps", "small", "--data", region.data)
    assert rasters_of(region.out) == rasters_of(built.out)
    assert not list((region.data / "work" / "tmp").iterdir())


def says(answer: Answer, *words: str) -> None:
    for word in words:
        assert word in answer.error, answer.error


def empty_dxf(path: Path) -> None:
    drawing = ezdxf.new("R2013", units=6)
    drawing.modelspace().add_line((0, 0), (1, 1), dxfattribs={"layer": "A0013112"})
    drawing.saveas(path)


# --- sheets ---------------------------------------------------------------------------------------------------


def test_footprints_beside_the_bounds(built: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    left, bottom, right, top = BOUNDS
    words = ("--crs", CRS, "--gsd", "2", "--bounds", f"{left + 9e4},{bottom},{right + 9e4},{top}")
    answer = brmgeo(
        capsys, "maps", "--footprints", built.out / "footprints.gpkg", *words, "--out", tmp_path / "out"
    )
    says(answer, "no building outline lies on the region's bounds", "km away in EPSG:5187; check its crs")
    assert not (tmp_path / "out" / "buildings.tif").exists()


def test_truncated_sheet(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    sheet = region.sheets / f"{SECOND}.dxf"
    whole = sheet.read_bytes()
    sheet.write_bytes(whole[: len(whole) * 2 // 3])
    says(maps(), f"{SECOND}.dxf", "fetch")


@pytest.mark.parametrize(
    "junk", [b"\x00\xff\x13" * 5000, b"", b"%PDF-1.7\n" + b"x" * 999, "건물".encode("utf-16") * 99]
)
def test_junk_for_a_sheet(region: SmallRegion, maps: Callable[[], Answer], junk: bytes) -> None:
    (region.sheets / f"{FIRST}.dxf").write_bytes(junk)
    says(maps(), f"{FIRST}.dxf")


def test_bad_sheets_are_counted_and_the_good_ones_kept(
    region: SmallRegion, maps: Callable[[], Answer], capsys: Capture
) -> None:
    for number in SHEETS:
        (region.sheets / f"{number}.dxf").write_bytes(b"junk")
    says(maps(), f"{FIRST}.dxf", "1 more of 2 outlines failed")


def test_one_bad_sheet_costs_only_itself(
    region: SmallRegion, maps: Callable[[], Answer], capsys: Capture
) -> None:
    shutil.rmtree(region.data / "work")
    (region.sheets / f"{FIRST}.dxf").write_bytes(b"junk")
    says(maps(), f"{FIRST}.dxf")
    told = brmgeo(capsys, "status", "small", "--data", region.data).out
    assert f"outlines {FIRST}        missing" in told
    assert f"outlines {SECOND}        fresh" in told


def test_a_sheet_without_buildings_is_a_sheet(region: SmallRegion, capsys: Capture) -> None:
    empty_dxf(region.sheets / f"{FIRST}.dxf")
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert said.status == 0, said.err
    with rasterio.open(region.out / "buildings.tif") as src:
        mask = src.read(1)
    assert (mask[:, : mask.shape[1] // 3] != 1).all()
    assert (mask == 1).any()


def test_sheets_all_without_buildings(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    for number in SHEETS:
        empty_dxf(region.sheets / f"{number}.dxf")
    says(maps(), "no building outline", "layers")


@pytest.mark.parametrize("crs", ["EPSG:5186", "EPSG:5174", "EPSG:2097", "EPSG:5181", "EPSG:32652"])
def test_wrong_crs_is_refused_with_what_it_would_cost(
    region: SmallRegion, maps: Callable[[], Answer], crs: str
) -> None:
    region.edit(f"bounds = {list(BOUNDS)}\n", "")
    region.edit('kind = "tiles"', 'missing_share = 1.0\nkind = "tiles"')
    region.edit(f'crs = "{CRS}"', f'crs = "{crs}"')
    said = maps()
    if "outlines" not in said.err:  # in some CRSs not even the tiles can be meant
        says(said, "tiles")
    else:
        says(said, crs, f'set crs = "{CRS}"', " off")


def test_geographic_or_unknown_crs(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    region.edit(f'crs = "{CRS}"', 'crs = "EPSG:4326"')
    says(maps(), "EPSG:4326", "degrees", "projected")
    region.edit('crs = "EPSG:4326"', 'crs = "EPSG:99999"')
    says(maps(), "99999")


def test_missing_sheets_are_listed(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    (region.sheets / f"{SECOND}.dxf").unlink()
    says(maps(), "1 of 2 sheets", SECOND, str(region.data / "source" / "small"), "map.ngii.go.kr")
    shutil.rmtree(region.sheets)
    says(maps(), "2 of 2 sheets", FIRST, SECOND)


def test_sheets_elsewhere_than_the_bounds(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    left, bottom, right, top = BOUNDS
    region.edit(str(list(BOUNDS)), str([left, bottom - 20_000, right, top - 20_000]))
    region.edit('kind = "tiles"', 'missing_share = 0.99\nkind = "tiles"')
    assert maps().error


def test_layers_that_a_drawing_does_not_have(tmp_path: Path, capsys: Capture) -> None:
    empty_dxf(tmp_path / "a.dxf")
    words = ("--crs", CRS, "--bounds", ",".join(map(str, BOUNDS)), "--out", tmp_path / "out")
    answer = brmgeo(capsys, "maps", "--footprints", tmp_path / "a.dxf", *words)
    says(
        answer,
        "no building outline in any of them",
        "a.dxf: no outline is on B0014111",
        "lines are on A0013112",
    )


# --- imagery --------------------------------------------------------------------------------------------------


def test_no_tiles(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    tiles = [p.relative_to(region.tiles) for p in region.tiles.rglob("*.png")]
    rows = {int(p.parts[1]) for p in tiles}
    shutil.rmtree(region.tiles)
    says(maps(), str(region.tiles), f"level {LEVEL}", "kakao")
    region.tiles.mkdir()
    says(maps(), str(region.tiles), f"level {LEVEL}", "tiles", f"{min(rows)}-{max(rows)}", ".png")


def test_one_missing_tile_is_named(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    victim = sorted(region.tiles.rglob("*.png"))[len(list(region.tiles.rglob("*.png"))) // 2]
    victim.unlink()
    says(maps(), str(victim.relative_to(region.tiles).with_suffix("")), "1 of ")


@pytest.mark.parametrize("fault", ["cut", "text", "small"])
def test_corrupt_tile(region: SmallRegion, maps: Callable[[], Answer], fault: str) -> None:
    victim = sorted(region.tiles.rglob("*.png"))[0]
    if fault == "cut":
        victim.write_bytes(victim.read_bytes()[:900])
    elif fault == "text":
        victim.write_text("<html>quota exceeded</html>")
    else:
        Image.new("RGB", (100, 100)).save(victim)
    says(maps(), str(victim), "replace")


def test_imagery_of_another_place(region: SmallRegion, maps: Callable[[], Answer], tmp_path: Path) -> None:
    image = region.data / "source" / "small" / "ortho.tif"
    with rasterio.open(
        image, "w", "GTiff", 64, 64, 3, "EPSG:5187", rasterio.Affine(1, 0, 300_000, 0, -1, 500_000), "uint8"
    ) as dst:
        dst.write(np.full((3, 64, 64), 90, np.uint8))
    tiles = f'kind = "tiles"\npath = "tiles"\ngrid = "kakao"\nlevel = {LEVEL}'
    region.edit(tiles, 'kind = "raster"\npath = "ortho.tif"')
    says(maps(), "ortho.tif", "km away")
    image.write_bytes(b"II*\0junk")
    says(maps(), "ortho.tif", "not a readable image")
    image.unlink()
    says(maps(), "ortho.tif", "missing")


def test_a_service_is_asked_by_maps_alone(
    region: SmallRegion, maps: Callable[[], Answer], capsys: Capture
) -> None:
    url = "http://127.0.0.1:9/{z}/{x}/{y}.png"
    region.edit('kind = "tiles"\npath = "tiles"', f'kind = "service"\nurl = "{url}"\nretries = 0')
    for command in (("status", "small"), ("why", "small", "ratio")):
        says(
            brmgeo(capsys, *command, "--data", region.data),
            url,
            "has been fetched yet",
            "`brmgeo maps small`",
        )
    says(maps(), "127.0.0.1:9", "tiles")
    region.edit('terms = "free for all"', "")
    says(maps(), "imagery", "terms")


# --- region files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("radii_m", "radius_m", ("ratio.radius_m", "radii_m")),
        ("gsd_m = 0.5", "gsd = 0.5", ("gsd", "gsd_m")),
        ("gsd_m = 0.5", "gsd_m = 0", ("gsd_m",)),
        ("gsd_m = 0.5", 'gsd_m = "half"', ("gsd_m",)),
        (f"'{FIRST}'", '"3680"', ("sheets", "3680")),
        ('"sheets/*.dxf"', '""', ("paths",)),
        ("[ratio]", "[ratio", ("TOML",)),
        ('name = "small"', 'name = "other"', ("other",)),
        ("level = 3", "level = 15", ("level",)),
        ('grid = "kakao"', 'grid = "kakoa"', ("grid", "kakao")),
        (str(list(BOUNDS)), "[1.0, 1.0, 0.0, 2.0]", ("bounds",)),
        ("[40.0, 17.3]", "[40.0, -1.0]", ("radii_m",)),
        ("[40.0, 17.3]", "[40.0, nan]", ("radii_m",)),
        ("[40.0, 17.3]", "[40.0, 1e9]", ("radius",)),
        (f"'{FIRST}'", '"99999999"', ("99999999", "not an NGII sheet")),
    ],
)
def test_faulty_region_files(
    region: SmallRegion, maps: Callable[[], Answer], before: str, after: str, words: tuple[str, ...]
) -> None:
    region.edit(before, after)
    says(maps(), *words)


def test_region_file_that_is_not_utf8(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    region.toml.write_bytes('name = "small"\ntitle = "평창"\n'.encode("cp949"))
    says(maps(), "small.toml", "TOML")


def test_unknown_region(region: SmallRegion, capsys: Capture) -> None:
    says(brmgeo(capsys, "maps", "smal", "--data", region.data), "did you mean 'small'")
    says(brmgeo(capsys, "maps", "x/y.toml", "--data", region.data), "y.toml")
    says(brmgeo(capsys, "status", "nowhere", "--data", region.data), "nowhere")


# --- places to write to ---------------------------------------------------------------------------------------


def test_output_is_a_file(
    region: SmallRegion, maps: Callable[[], Answer], capsys: Capture, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("in the way")
    words = ("maps", "small", "--data", region.data, "--out")
    says(brmgeo(capsys, *words, tmp_path / "file" / "below"), "file", "choose another place")
    answer = brmgeo(capsys, *words, tmp_path / "file")
    assert answer.status == 2
    assert "file" in answer.err
    says(brmgeo(capsys, *words, "/proc/here"), "/proc/here", "cannot be written", "check the name")


def test_store_is_a_file(region: SmallRegion, capsys: Capture) -> None:
    shutil.rmtree(region.data / "work")
    (region.data / "work").write_text("in the way")
    says(brmgeo(capsys, "maps", "small", "--data", region.data), "work", "choose another")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_output(region: SmallRegion, capsys: Capture, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    says(
        brmgeo(capsys, "maps", "small", "--data", region.data, "--out", tmp_path / "locked" / "x"),
        "ermission",
    )


def test_two_runs_at_once(region: SmallRegion, maps: Callable[[], Answer]) -> None:
    with Store(region.data / "work").lock("small"):
        says(maps(), "small is being worked on by process", str(os.getpid()))
    assert maps().status == 0


def test_full_disk_under_the_store(
    region: SmallRegion, built: SmallRegion, capsys: Capture, small_disk: Path
) -> None:
    shutil.rmtree(region.data / "work")
    (region.data / "work").symlink_to(small_disk)
    says(brmgeo(capsys, "maps", "small", "--data", region.data), "free some space")
    assert not list((small_disk / "tmp").iterdir())
    (region.data / "work").unlink()
    assert brmgeo(capsys, "maps", "small", "--data", region.data).status == 0
    assert rasters_of(region.out) == rasters_of(built.out)


def test_full_disk_under_the_results(region: SmallRegion, capsys: Capture, small_disk: Path) -> None:
    said = brmgeo(capsys, "maps", "small", "--data", region.data, "--out", small_disk / "out")
    says(said, "the disk is full", str(small_disk))
    for path in (small_disk / "out").glob("*.*"):
        if not path.name.startswith("."):
            assert path.read_bytes() == (region.out / path.name).read_bytes()


# --- footprints without a region file -------------------------------------------------------------------------


@pytest.fixture
def shapefile(tmp_path: Path) -> Path:
    boxes = shapely.box([194_500, 194_600], [445_000, 445_050], [194_530, 194_620], [445_020, 445_080])
    path = tmp_path / "town" / "buildings.shp"
    path.parent.mkdir()
    gpd.GeoDataFrame({"use": ["a", "b"]}, geometry=boxes, crs=CRS).to_file(path)
    return path


def test_shapefile_without_prj(shapefile: Path, capsys: Capture, tmp_path: Path) -> None:
    shapefile.with_suffix(".prj").unlink()
    said = brmgeo(capsys, "maps", "--footprints", shapefile, "--crs", CRS, "--out", tmp_path / "out")
    says(said, "buildings.shp", ".prj", "CRS", "--source-crs")
    assert not (tmp_path / "out" / "buildings.tif").exists()
    words = (
        "maps",
        "--footprints",
        shapefile,
        "--crs",
        "EPSG:5186",
        "--source-crs",
        CRS,
        "--out",
        tmp_path / "out",
    )
    assert brmgeo(capsys, *words).status == 0
    with rasterio.open(tmp_path / "out" / "buildings.tif") as src:
        assert (src.read(1) == 1).sum() * 0.25 == pytest.approx(30 * 20 + 20 * 30, rel=0.05)


def test_shapefile_without_shx_is_read_and_left_alone(
    shapefile: Path, capsys: Capture, tmp_path: Path
) -> None:
    shapefile.with_suffix(".shx").unlink()
    before = sorted(shapefile.parent.iterdir())
    words = ("maps", "--footprints", shapefile, "--crs", CRS, "--out", tmp_path / "out")
    assert brmgeo(capsys, *words).status == 0
    assert sorted(shapefile.parent.iterdir()) == before
    assert "nothing to do" in brmgeo(capsys, *words).err


def test_files_of_one_name_and_awkward_names(shapefile: Path, capsys: Capture, tmp_path: Path) -> None:
    places = [tmp_path / "a [1]", tmp_path / "b 한글"]
    for k, place in enumerate(places):
        shutil.copytree(shapefile.parent, place)
        frame = gpd.read_file(place / "buildings.shp")
        frame.geometry = frame.translate(40.0 * k)
        frame.to_file(place / "buildings.shp")
    out = tmp_path / "out dir"
    files = [word for place in places for word in ("--footprints", place / "buildings.shp")]
    said = brmgeo(capsys, "maps", *files, "--crs", "epsg:5187", "--out", out)
    assert said.status == 0, said.err
    found = gpd.read_file(out / "footprints.gpkg", layer="footprints")
    assert len(found) == 4
    assert set(found["source"]) == {"a [1]/buildings.shp", "b 한글/buildings.shp"}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--out", "OUT"), ("--crs",)),
        (("--crs", CRS), ("--out",)),
        (("--crs", "EPSG:4326", "--out", "OUT"), ("EPSG:4326", "projected")),
        (("--crs", "nonsense", "--out", "OUT"), ("NONSENSE", "EPSG:5187")),
        (("--crs", CRS, "--out", "OUT", "--sheets", "36914093"), ("36914093", "buildings.shp")),
        (("--crs", CRS, "--out", "OUT", "--sheets", "12"), ("12", "sheet number")),
        (("--crs", CRS, "--out", "OUT", "--bounds", "1,2,3"), ("--bounds", "4")),
        (("--crs", CRS, "--out", "OUT", "--bounds", "9,9,1,1"), ("bounds",)),
        (("--crs", CRS, "--out", "OUT", "--bounds", "1,1,nan,9"), ("bounds",)),
        (("--crs", CRS, "--out", "OUT", "--bounds", "0,0,900000,900000"), ("900", "bounds")),
        (("--crs", CRS, "--out", "OUT", "--gsd", "-1"), ("gsd",)),
        (("--crs", CRS, "--out", "OUT", "--gsd", "nan"), ("gsd",)),
        (("--crs", CRS, "--out", "OUT", "--radii", "0"), ("radii",)),
        (("--crs", CRS, "--out", "OUT", "--radii", "a,b"), ("--radii",)),
        (("--crs", CRS, "--out", "OUT", "--layer", "roads"), ("buildings.shp",)),
        (("--crs", CRS, "--out", "OUT", "--imagery", "/nowhere.tif"), ("/nowhere.tif",)),
        (("--crs", CRS, "--out", "OUT", "--imagery-crs", CRS), ("no imagery", "(--imagery ")),
        (("--crs", CRS, "--out", "OUT", "--footprints", "/nowhere.shp"), ("/nowhere.shp",)),
        (("--crs", CRS, "--out", "OUT", "--footprints", "/nowhere/*.shp"), ("/nowhere/*.shp", "the pattern")),
        (("small", "--crs", CRS, "--out", "OUT"), ("not both",)),
        (("--crs", CRS, "--out", "OUT", "--scheduler", "dask"), ("dask", "tcp://")),
        (
            ("--crs", CRS, "--out", "OUT", "--scheduler", "tcp://127.0.0.1:1"),
            ("127.0.0.1:1", "dask scheduler"),
        ),
    ],
)
def test_faulty_options(
    shapefile: Path, capsys: Capture, tmp_path: Path, words: tuple[str, ...], told: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    given = [str(out) if word == "OUT" else word for word in words]
    says(brmgeo(capsys, "maps", "--footprints", shapefile, *given), *told)
    assert not list(out.glob("*.tif"))


def test_a_stray_outline_does_not_make_a_giant(capsys: Capture, tmp_path: Path) -> None:
    boxes = shapely.box([0, 5e8], [445_000, 5e8], [30, 5e8 + 9], [445_020, 5e8 + 9])
    path = tmp_path / "stray.gpkg"
    gpd.GeoDataFrame(geometry=boxes, crs="EPSG:32652").to_file(path)
    assert brmgeo(
        capsys, "maps", "--footprints", path, "--crs", "EPSG:32652", "--out", tmp_path / "out"
    ).error


def test_footprint_files_that_are_no_footprints(shapefile: Path, capsys: Capture, tmp_path: Path) -> None:
    def refused(path: Path) -> Answer:
        return brmgeo(capsys, "maps", "--footprints", path, "--crs", CRS, "--out", tmp_path / "out")

    (tmp_path / "empty").mkdir()
    says(refused(tmp_path / "empty"), "empty", "no footprints")
    (tmp_path / "notes.txt").write_text("hello")
    says(refused(tmp_path / "notes.txt"), "notes.txt")
    (tmp_path / "x.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    says(refused(tmp_path / "x.geojson"), "no building outline")
    (tmp_path / "x.geojson").write_text('{"type": "FeatureColl')
    says(refused(tmp_path / "x.geojson"), "x.geojson")
    shapefile.write_bytes(shapefile.read_bytes()[:150])
    says(refused(shapefile), "buildings.shp", "cut short")


def test_interrupted_runs_say_so(
    region: SmallRegion, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.maps.plan_maps", interrupt)
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert said.status == 130
    assert "the next run goes on from there" in said.err
    with open(region.data / "work" / "locks" / "small.lock", "rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


@pytest.mark.parametrize(
    "option", [["--gsd", "0.25"], ["--layer", "x"], ["--encoding", "cp949"], ["--source-crs", "EPSG:5187"]]
)
def test_options_of_files_are_refused_beside_a_region(
    option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    said = brmgeo(capsys, "maps", "demo", *option)
    assert said.status == 2
    assert option[0] in said.error
    assert "--footprints" in said.error


def test_a_pattern_of_footprints_names_the_files_that_it_fits(tmp_path: Path) -> None:
    for name in ("east.gpkg", "west.gpkg", "west.dbf", "old[1].gpkg"):
        (tmp_path / name).touch()

    def found(*patterns: str) -> list[str]:
        spec = maps_of_files(tmp_path / "out", [tmp_path / p for p in patterns], crs=CRS)
        assert spec.footprints is not None
        return [Path(p).name for p in spec.footprints.paths]

    assert found("*st.*") == ["east.gpkg", "west.gpkg"]
    assert found("east.gpkg", "*.gpkg") == ["east.gpkg", "old[[]1].gpkg", "west.gpkg"]
    # A file that is called like a pattern is that file.
    assert found("old[1].gpkg") == ["old[[]1].gpkg"]
