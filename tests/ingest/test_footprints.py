"""Vector footprints: one town through every format and CRS, the CRS check, merging at sheet edges, and the GeoPackage."""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
from pathlib import Path

import ezdxf
import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from shapely import affinity

from brmgeo.errors import CrsError, InputError, MissingInputError, WorkflowError
from brmgeo.export.footprints import write_footprints_gpkg
from brmgeo.geo.sheets import sheet_extent, sheet_polygon
from brmgeo.ingest.footprints import COLUMNS, combine, merge_at_edges, read_footprints
from brmgeo.ingest.repair import Repair

REAL = (
    Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / "../shared/data")) / "ngii"
)
CRS = "EPSG:5187"
NUMBER, EAST_OF_IT = "36914093", "36914094"


def town(n: int = 40, seed: int = 3) -> gpd.GeoDataFrame:
    """Turned rectangles, some with a courtyard, none touching, inside sheet 36914093."""
    rng = np.random.default_rng(seed)
    left, bottom, *_ = sheet_extent(NUMBER, CRS)
    shapes = []
    for k in range(n):
        x, y = left + 200 + 60 * (k % 20), bottom + 200 + 60 * (k // 20)
        w, h = rng.uniform(6, 20, 2)
        shape = shapely.box(x, y, x + w, y + h)
        if k % 7 == 0:
            shape = shape.difference(shapely.box(x + 2, y + 2, x + w - 2, y + h - 2))
        shapes.append(affinity.rotate(shape, rng.uniform(0, 90)))
    kinds = ["아파트", "일반주택", "무벽건물", "온실"]
    return gpd.GeoDataFrame(
        {"종류": [kinds[k % 4] for k in range(n)], "층수": [k % 5 for k in range(n)]},
        geometry=shapes,
        crs=CRS,
    )


def write(frame: gpd.GeoDataFrame, path: Path) -> Path:
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    elif path.suffix == ".shp":
        pyogrio.write_dataframe(frame, path, encoding="EUC-KR")
    else:
        pyogrio.write_dataframe(frame, path)
    return path


@pytest.mark.parametrize("name", ["t.gpkg", "t.geojson", "t.shp", "t.parquet", "t.fgb"])
@pytest.mark.parametrize("crs", [CRS, "EPSG:4326", "EPSG:5181", "EPSG:32652"])
def test_one_town_through_every_format_and_crs(tmp_path, name, crs):
    frame = town()
    if name == "t.geojson" and crs != "EPSG:4326":
        crs = "EPSG:4326"
    kwargs = {"COORDINATE_PRECISION": "10"} if name == "t.geojson" else {}
    path = tmp_path / name
    if kwargs:
        pyogrio.write_dataframe(frame.to_crs(crs), path, **kwargs)
    else:
        write(frame.to_crs(crs), path)
    read = read_footprints(path, CRS)
    assert list(read.frame.columns) == list(COLUMNS)
    assert read.frame.crs == CRS
    assert read.counts["footprints"] == len(frame)
    # FlatGeobuf orders features along a curve of its own.
    order = np.array([int(h) for h in read.frame.handle]) - 1 if name != "t.fgb" else None
    if order is not None:
        far = shapely.hausdorff_distance(read.frame.geometry.values, frame.geometry.values[order])
        assert far.max() < (1e-9 if crs == CRS else 2e-3)
        assert [len(shape.interiors) for shape in read.frame.geometry] == [
            len(s.interiors) for s in frame.geometry
        ]
        assert list(read.frame.kind[:4]) == ["apartment", "house", "wall-less", "greenhouse"]
        assert read.frame.floors[1:5].tolist() == [1, 2, 3, 4]
        assert read.frame.floors.isna().sum() == 8
    assert read.frame.area.sum() == pytest.approx(frame.area.sum(), rel=1e-6)


def test_a_flatgeobuf_that_was_cut_is_refused(tmp_path):
    path = write(town(), tmp_path / "t.fgb")
    data = path.read_bytes()
    told = []
    for cut in range(4, 324, 4):
        path.write_bytes(data[:-cut])
        with pytest.raises(InputError, match=r"t.fgb: ") as caught:
            read_footprints(path, CRS)
        told.append(str(caught.value))
    assert "t.fgb: cut short or damaged: 39 of its 40 features are there: fetch the file again" in told


def osm(rows, **columns):
    """Squares with attributes as an OpenStreetMap extract has them."""
    left, bottom, *_ = sheet_extent(NUMBER, CRS)
    squares = [shapely.box(x, bottom + 300, x + 10, bottom + 310) for x in left + 300 + 30 * np.arange(rows)]
    return gpd.GeoDataFrame(columns, geometry=squares, crs=CRS)


@pytest.mark.parametrize(
    ("by", "columns"),
    [
        ("building=*", {"osm_id": ["1", "2", "3", "4"], "building": ["yes", None, "no", "house"]}),
        ("building=*", {"@id": ["w1", "w2", "w3", "w4"], "Building": ["yes", "", None, "roof"], "landuse": [None] * 4}),
        ("building=*", {"osm_id": ["1", "2", "3", "4"],
                        "other_tags": ['"building"=>"yes"', '"landuse"=>"forest"', None, '"a"=>"b","building"=>"x"']}),
        ("fclass=building", {"osm_id": ["1", "2", "3", "4"], "fclass": ["building", "forest", "park", "building"]}),
        ("building=*", {"@id": ["1", "2", "3", "4"],
                        "tags": ['{"building": "yes"}', '{"leisure": "park"}', "{}", '{ "building": "x" }']}),
    ],
)  # fmt: skip
def test_of_an_openstreetmap_extract_only_buildings_are_buildings(tmp_path, by, columns):
    read = read_footprints(write(osm(4, **columns), tmp_path / "t.gpkg"), CRS)
    assert list(read.frame.handle) == ["1", "4"]
    assert read.notes == [f"4 features of OpenStreetMap, 2 of them buildings by {by}"]
    for n, other in enumerate(
        (town(4), osm(4, osm_id=["1", "2", "3", "4"]), osm(4, building=["a", None, "b", "c"]))
    ):
        plain = read_footprints(write(other, tmp_path / f"other{n}.gpkg"), CRS)
        assert (len(plain.frame), plain.notes) == (4, [])


@pytest.mark.parametrize(
    "columns",
    [{"osm_id": ["1", "2"], "landuse": ["forest", "park"]}, {"osm_id": ["1", "2"], "building": [None, "no"]},
     {"osm_id": ["1", "2"], "fclass": ["forest", "park"]}],
)  # fmt: skip
def test_an_extract_that_says_nothing_of_buildings_is_refused(tmp_path, columns):
    with pytest.raises(InputError, match=r"t.gpkg: of an OpenStreetMap extract \(2 features\)"):
        read_footprints(write(osm(2, **columns), tmp_path / "t.gpkg"), CRS)


def drawing(path, unit, scale, place):
    """Four houses of 10 x 8 m at ``place``, drawn ``scale`` times as large, in $INSUNITS ``unit``."""
    document = ezdxf.new("R2010", units=unit)
    for k in range(4):
        x, y = place[0] + 20 * k, place[1]
        ring = [(x, y), (x + 10, y), (x + 10, y + 8), (x, y + 8)]
        document.modelspace().add_lwpolyline(
            [(scale * a, scale * b) for a, b in ring], close=True, dxfattribs={"layer": "B0014112"}
        )
    document.modelspace().add_circle(
        (scale * (place[0] + 100), scale * place[1]), scale * 5, dxfattribs={"layer": "B0014112"}
    )
    document.saveas(path)
    return path


def test_a_drawing_in_millimetres_is_read_as_metres_where_that_fits(tmp_path):
    left, bottom, *_ = sheet_extent(NUMBER, CRS)
    place = (left + 300, bottom + 300)
    metres = read_footprints(drawing(tmp_path / "a.dxf", 6, 1, place), CRS)
    for unit, scale, name in ((4, 1000, "millimetres"), (5, 100, "centimetres"), (2, 1 / 0.3048, "feet")):
        read = read_footprints(drawing(tmp_path / f"{NUMBER}_{unit}.dxf", unit, scale, place), CRS)
        assert read.notes == [f"drawn in {name} ($INSUNITS), read as metres"]
        assert read.frame.area.to_numpy() == pytest.approx(metres.frame.area.to_numpy(), rel=1e-6)
        assert read.frame.total_bounds == pytest.approx(metres.frame.total_bounds, abs=1e-3)
    # Templates say millimetres, and surveyors draw in metres all the same.
    read = read_footprints(drawing(tmp_path / "template.dxf", 4, 1, place), CRS)
    assert read.notes == []
    assert read.frame.total_bounds == pytest.approx(metres.frame.total_bounds, abs=1e-6)


def test_a_drawing_that_fits_in_no_unit_names_its_own(tmp_path):
    path = drawing(tmp_path / f"{NUMBER}.dxf", 4, 1000, (0.0, 0.0))
    with pytest.raises(CrsError, match=r"nor do they fit in millimetres, which \$INSUNITS says"):
        read_footprints(path, CRS)


def test_walls_lines_points_and_empty_rows_are_no_lost_outlines(tmp_path):
    floors = list(town(6).geometry)
    faces = []
    for floor in floors:
        xy = shapely.get_coordinates(floor.exterior)
        faces.append(shapely.force_3d(floor, 5.0))
        faces += [shapely.Polygon([(*a, 0), (*b, 0), (*b, 5), (*a, 5)]) for a, b in itertools.pairwise(xy)]
    wall = shapely.Polygon(shapely.get_coordinates(floors[1].exterior)[[0, 1, 0]])
    shell = shapely.force_3d(shapely.MultiPolygon([floors[0], wall]), 0.0)
    line, point = shapely.LineString([(0, 0), (9, 9), (9, 0)]), shapely.Point(0, 0)
    for n, (shapes, told) in enumerate([
        (faces, "24 upright faces (walls)"),
        ([shapely.force_2d(shell), *floors[1:]], "1 upright faces (walls)"),
        ([*floors, line, None, shapely.Polygon(), point], "1 open lines, 2 features without geometry, 1 points"),
    ]):  # fmt: skip
        path = write(gpd.GeoDataFrame(geometry=shapes, crs=CRS), tmp_path / f"{n}.gpkg")
        read = read_footprints(path, CRS)
        assert read.frame.area.sum() == pytest.approx(sum(floor.area for floor in floors))
        assert read.notes == [f"left out, as they have no area from above: {told}"]
        assert (read.counts["outlines"], read.sheets["dropped_share"].iat[0]) == (len(read.frame), 0.0)


def test_flat_outlines_without_area_and_outlines_of_open_lines_are_lost(tmp_path):
    floors = list(town(6).geometry)
    flat = shapely.Polygon(shapely.get_coordinates(floors[1].exterior)[[0, 1, 0]])
    lines = [floor.exterior for floor in floors[1:]]
    for n, shapes in enumerate(([*floors, flat], [*lines, shapely.LineString([(0, 0), (9, 9), (9, 0)])])):
        with pytest.raises(InputError, match=r"1 of . outlines .* are not usable"):
            read_footprints(write(gpd.GeoDataFrame(geometry=shapes, crs=CRS), tmp_path / f"{n}.gpkg"), CRS)


def test_a_crs_without_a_place_on_earth_is_mended_by_the_source_crs(tmp_path):
    path = write(town(4).set_crs(CRS, allow_override=True), tmp_path / "t.shp")
    path.with_suffix(".prj").write_text('LOCAL_CS["Nonearth",UNIT["Meter",1.0]]')
    with pytest.raises(CrsError, match=r"t\.shp: no transformation leads from Nonearth") as raised:
        read_footprints(path, CRS)
    assert raised.value.needs == "source_crs"
    assert len(read_footprints(path, CRS, source_crs=CRS).frame) == 4


def test_what_a_drawing_has_and_is_not_read_is_told(tmp_path):
    left, bottom, *_ = sheet_extent(NUMBER, CRS)
    ring = [
        (left + 300, bottom + 300),
        (left + 310, bottom + 300),
        (left + 310, bottom + 308),
        (left + 300, bottom + 308),
    ]
    document = ezdxf.new("R2010", units=6)
    space, site = document.modelspace(), document.blocks.new("SITE")
    site.add_lwpolyline(ring, close=True, dxfattribs={"layer": "HOUSE"})
    space.add_lwpolyline(ring, close=True, dxfattribs={"layer": "Plot"})
    space.add_spline([(*p, 0) for p in ring], dxfattribs={"layer": "HOUSE"})
    space.add_hatch(dxfattribs={"layer": "HOUSE"})
    document.saveas(tmp_path / "a.dxf")
    read = read_footprints(tmp_path / "a.dxf", CRS, layers=["HOUSE"])
    assert read.notes == [
        "on HOUSE left out, as they are no outlines: 1 HATCH, 1 SPLINE",
        "no outline is on HOUSE; lines are on PLOT",
    ]
    space.add_blockref("SITE", (0, 0))
    document.saveas(tmp_path / "b.dxf")
    assert read_footprints(tmp_path / "b.dxf", CRS, layers=["HOUSE"]).notes[1] == (
        "no outline is on HOUSE but in blocks that are put on other layers, 1 in SITE: explode the blocks"
    )
    assert read_footprints(tmp_path / "a.dxf", CRS, layers=["PLOT"]).notes == []
    # A symbol on another layer of a drawing that has its outlines is no building.
    space.add_lwpolyline(ring, close=True, dxfattribs={"layer": "HOUSE"})
    document.saveas(tmp_path / "c.dxf")
    assert len(read_footprints(tmp_path / "c.dxf", CRS, layers=["HOUSE"]).notes) == 1


def test_floors_are_read_out_of_text(tmp_path):
    frame = town(4).rename(columns={"종류": "Kind"})
    frame["층수"] = ["3층", None, "x", "12"]
    read = read_footprints(write(frame, tmp_path / "t.gpkg"), CRS)
    assert list(read.frame.kind) == ["apartment", "house", "wall-less", "greenhouse"]
    assert read.frame.floors.fillna(-1).tolist() == [3, -1, -1, 12]


def test_faults_are_repaired_and_told(tmp_path):
    shapes = list(town(30).geometry)
    bow = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])
    x, y, *_ = shapes[0].bounds
    shapes += [affinity.translate(bow, x, y + 500), shapes[3], shapes[3].reverse(), None]
    path = write(gpd.GeoDataFrame(geometry=shapes, crs=CRS), tmp_path / "t.gpkg")
    read = read_footprints(path, CRS)
    assert {k: v for k, v in read.counts.items() if k.startswith("repair")} == {
        "repair_bow_tie": 1,
        "repair_duplicate": 2,
        "repair_unreadable": 1,
    }
    assert [r.handle for r in read.repairs if r.kind == "bow_tie"] == ["31"]
    assert len(read.frame) == 32
    flat = shapely.Polygon([(x, y), (x + 5, y), (x, y)])
    path = write(gpd.GeoDataFrame(geometry=[*shapes[:-1], flat], crs=CRS), tmp_path / "t.gpkg")
    with pytest.raises(InputError, match="1 of 34 outlines"):
        read_footprints(path, CRS, max_dropped_share=0.01)


def test_lines_heights_multipolygons_and_points(tmp_path):
    a, b, c = list(town(3, seed=5).geometry[[1, 2]]), *town(12).geometry[[8, 9]]
    shapes = [
        shapely.MultiPolygon(a),
        shapely.force_3d(b, 12.0),
        shapely.LineString(c.exterior.coords),
        shapely.Point(c.centroid),
    ]
    path = tmp_path / "t.geojson"
    gpd.GeoDataFrame(geometry=shapes, crs=CRS).to_crs(4326).to_file(path, COORDINATE_PRECISION=10)
    read = read_footprints(path, CRS)
    assert len(read.frame) == 4
    assert read.counts["other_entities"] == 1
    assert not read.frame.has_z.any()
    assert list(read.frame.handle) == ["1", "1", "2", "3"]


def test_a_shapefile_without_prj_wants_a_crs(tmp_path):
    path = write(town(), tmp_path / "t.shp")
    path.with_suffix(".prj").unlink()
    with pytest.raises(CrsError, match=r"t\.shp: .*no t\.prj beside it.*such as EPSG:5187") as caught:
        read_footprints(path, CRS)
    assert caught.value.needs == "source_crs"
    assert len(read_footprints(path, CRS, source_crs=CRS).frame) == 40


def test_a_shapefile_without_dbf_and_shx(tmp_path):
    path = write(town(), tmp_path / "t.shp")
    path.with_suffix(".dbf").unlink()
    beside = path.with_suffix(".shx").read_bytes(), path.with_suffix(".shx").stat().st_mtime_ns
    assert read_footprints(path, CRS).frame.area.sum() == pytest.approx(town().area.sum())
    assert beside == (path.with_suffix(".shx").read_bytes(), path.with_suffix(".shx").stat().st_mtime_ns)
    path.with_suffix(".shx").unlink()
    before = sorted(p.name for p in tmp_path.iterdir())
    assert read_footprints(path, CRS).frame.area.sum() == pytest.approx(town().area.sum())
    assert sorted(p.name for p in tmp_path.iterdir()) == before, "nothing is written beside a source"


@pytest.mark.parametrize("name", ["t.gpkg", "t.geojson", "t.shp", "t.parquet"])
def test_damaged_files_are_refused_in_one_line(tmp_path, name):
    path = write(town(), tmp_path / name)
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"", bytes(range(256)) * 20):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=name.replace(".", r"\.")) as caught:
            read_footprints(path, CRS)
        assert "\n" not in str(caught.value)
    with pytest.raises(MissingInputError, match="no such file"):
        read_footprints(tmp_path / "nowhere.gpkg", CRS)


def test_a_file_with_several_layers_wants_one_named(tmp_path):
    path = tmp_path / "t.gpkg"
    pyogrio.write_dataframe(town(), path, layer="a")
    pyogrio.write_dataframe(town(5), path, layer="b", append=True)
    with pytest.raises(InputError, match="layers a, b: say which"):
        read_footprints(path, CRS)
    assert len(read_footprints(path, CRS, layer="b").frame) == 5


def test_a_wrong_crs_is_refused(tmp_path):
    frame = town()
    wrong = frame.set_crs("EPSG:5186", allow_override=True)
    path = write(wrong, tmp_path / f"{NUMBER}.gpkg")
    with pytest.raises(CrsError, match=r"EPSG:5187 fits \(the stated one would put them 180\.\d km off\)"):
        read_footprints(path)
    assert len(read_footprints(path, source_crs=CRS, crs=CRS).frame) == 40
    with pytest.raises(CrsError, match="needs a projected CRS"):
        read_footprints(write(frame, tmp_path / "t.gpkg"), "EPSG:4326")


def sheet_dxf(
    path: Path, shapes, number: str, crs: str = CRS, neatline: bool = True, shift=(0.0, 0.0)
) -> Path:
    """The part of the shapes that lies on a sheet, cut at its neatline and rounded to millimetres."""
    doc = ezdxf.new("R2010", units=0)
    cell = sheet_polygon(number, crs)
    for shape in shapes:
        for part in shapely.get_parts(shape.intersection(cell)):
            for ring in (part.exterior, *part.interiors):
                xy = np.round(np.array(ring.coords)[:-1], 3) + shift
                doc.modelspace().add_lwpolyline(xy.tolist(), close=True, dxfattribs={"layer": "B0014112"})
    if neatline:
        xy = np.array(cell.exterior.coords)[:-1] + shift
        doc.modelspace().add_lwpolyline(xy.tolist(), close=True, dxfattribs={"layer": "H0017334"})
    doc.saveas(path)
    return path


def test_dxf_sheets_go_through_the_same_door(tmp_path):
    path = sheet_dxf(tmp_path / f"{NUMBER}.dxf", town().geometry, NUMBER)
    read = read_footprints(path, CRS)
    assert read.frame.area.sum() == pytest.approx(town().area.sum(), rel=1e-4)
    assert read.sheets.loc[0, ["sheet", "outline", "footprints"]].tolist() == [NUMBER, "neatline", 40]
    assert read.sheets.geometry[0].equals_exact(sheet_polygon(NUMBER, CRS), 1e-3, normalize=True)
    with pytest.raises(CrsError, match="a DXF does not say its CRS") as caught:
        read_footprints(path)
    assert caught.value.needs == "crs"
    with pytest.raises(CrsError, match=r"neatline.*EPSG:5187 fits"):
        read_footprints(path, "EPSG:5183")
    moved = read_footprints(path, "EPSG:5186", source_crs=CRS)
    assert moved.frame.crs == "EPSG:5186"
    back = moved.frame.to_crs(CRS).geometry.values
    assert shapely.hausdorff_distance(back, read.frame.geometry.values).max() < 1e-6


def test_the_neatline_tells_the_old_datum(tmp_path):
    number = "37705039"
    old = sheet_dxf(
        tmp_path / f"{number}.dxf", [sheet_polygon(number, "EPSG:5174").buffer(-900)], number, "EPSG:5174"
    )
    assert len(read_footprints(old, "EPSG:5174").frame) == 1
    # Its few outlines lie inside the sheet either way: only the neatline shows the 313 m.
    with pytest.raises(CrsError, match=r"neatline.*EPSG:5174 fits.*313 m off"):
        read_footprints(old, "EPSG:5181")


def crossing_town(n: int = 100) -> list[shapely.Polygon]:
    """Buildings astride the edge between two sheets, no two of them near each other."""
    rng = np.random.default_rng(8)
    edge = shapely.get_coordinates(sheet_polygon(NUMBER, CRS).exterior)[16:33]
    shapes = []
    for k in range(n):
        at = edge[0] + (edge[-1] - edge[0]) * (k + 0.5) / n
        shape = shapely.box(-rng.uniform(2, 9), -rng.uniform(2, 9), rng.uniform(2, 9), rng.uniform(2, 9))
        shapes.append(affinity.translate(affinity.rotate(shape, rng.uniform(0, 90), origin=(0, 0)), *at))
    return shapes


def test_buildings_cut_at_a_sheet_edge_are_one_again(tmp_path):
    shapes = crossing_town()
    parts = [
        read_footprints(sheet_dxf(tmp_path / f"{number}.dxf", shapes, number), CRS)
        for number in (NUMBER, EAST_OF_IT)
    ]
    assert [len(part.frame) for part in parts] == [100, 100]
    whole = combine(parts)
    assert (len(whole.frame), whole.counts["merged_at_edges"]) == (100, 100)
    assert whole.frame.is_valid.all()
    assert whole.frame.area.sum() == pytest.approx(sum(part.frame.area.sum() for part in parts), rel=1e-5)
    order = shapely.STRtree(whole.frame.geometry.values).nearest(shapely.centroid(np.array(shapes)))
    assert shapely.hausdorff_distance(whole.frame.geometry.values[order], np.array(shapes)).max() < 5e-3
    assert set(whole.frame.geom_type) == {"Polygon"}
    assert len(whole.sheets) == 2


def test_merging_bears_centimetres_and_no_more(tmp_path):
    shapes = crossing_town(20)
    for shift, expected in (((0.03, 0.02), 20), ((0.5, 0.0), 40)):
        parts = [
            read_footprints(sheet_dxf(tmp_path / f"{NUMBER}.dxf", shapes, NUMBER), CRS),
            read_footprints(sheet_dxf(tmp_path / f"{EAST_OF_IT}.dxf", shapes, EAST_OF_IT, shift=shift), CRS),
        ]
        whole = combine(parts)
        assert len(whole.frame) == expected
        assert whole.frame.area.sum() == pytest.approx(sum(s.area for s in shapes), rel=0.01)


def test_only_cut_pieces_are_merged():
    edge = shapely.box(0, 0, 100, 100), shapely.box(100, 0, 200, 100)
    boxes = {
        "left half": (shapely.box(90, 10, 100, 20), "a", "house"),
        "right half": (shapely.box(100, 10, 110, 20), "b", "house"),
        "other kind": (shapely.box(100, 20, 110, 30), "b", "greenhouse"),
        "corner only": (shapely.box(100, 30, 110, 40), "b", "house"),
        "neighbour, same sheet": (shapely.box(90, 20, 100, 30), "a", "house"),
        "near the edge": (shapely.box(101, 50, 110, 60), "b", "house"),
        "opposite it": (shapely.box(90, 50, 99, 60), "a", "house"),
    }
    frame = gpd.GeoDataFrame(
        {
            "source": [b[1] for b in boxes.values()],
            "kind": [b[2] for b in boxes.values()],
            "name": list(boxes),
        },
        geometry=[b[0] for b in boxes.values()],
        crs=CRS,
    )
    merged, fewer = merge_at_edges(frame, edge)
    assert fewer == 1
    assert list(merged["name"]) == [name for name in boxes if name != "right half"]
    assert merged.geometry[0].equals(shapely.box(90, 10, 110, 20))


def test_a_building_at_the_corner_of_four_sheets():
    sheets = [shapely.box(x, y, x + 100, y + 100) for x in (0, 100) for y in (0, 100)]
    house = affinity.rotate(shapely.box(80, 85, 120, 115), 20)
    frame = gpd.GeoDataFrame(
        {"source": list("abcd"), "kind": "house"}, geometry=[house.intersection(s) for s in sheets], crs=CRS
    )
    merged, fewer = merge_at_edges(frame, sheets)
    assert (len(merged), fewer) == (1, 3)
    assert merged.geometry[0].symmetric_difference(house).area < 1e-6


def test_what_two_sheets_hold_is_kept_once(tmp_path):
    frame = town()
    one = read_footprints(write(frame.iloc[:30], tmp_path / "one.gpkg"), CRS)
    two = read_footprints(write(frame.iloc[20:], tmp_path / "two.gpkg"), CRS)
    whole = combine([one, two])
    assert len(whole.frame) == 40
    assert whole.counts["duplicates_across_sheets"] == 10
    assert whole.frame.area.sum() == pytest.approx(frame.area.sum())
    with pytest.raises(CrsError, match="read all into one crs"):
        combine([one, read_footprints(tmp_path / "two.gpkg", "EPSG:5186")])


def test_the_geopackage_has_its_layers_and_the_same_bytes(tmp_path):
    whole = combine([read_footprints(write(town(), tmp_path / f"{NUMBER}.gpkg"), CRS)])
    repairs = [Repair("gap", "1F", "B0014112", 227_100.0, 378_200.0, "ends 0.05 m apart", "a.dxf")]
    repairs += [Repair("unreadable", "", "x", float("nan"), float("nan"))]
    paths = [tmp_path / "a.gpkg", tmp_path / "b.gpkg"]
    for path in paths:
        write_footprints_gpkg(path, whole.frame, whole.sheets, repairs)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert [name for name, _ in pyogrio.list_layers(paths[0])] == ["footprints", "sheets", "repairs"]
    back = pyogrio.read_dataframe(paths[0], layer="footprints")
    assert shapely.equals_exact(back.geometry.values, whole.frame.geometry.values).all()
    assert back.crs == CRS
    assert pyogrio.read_dataframe(paths[0], layer="repairs").kind.tolist() == ["gap"]
    assert pyogrio.read_dataframe(paths[0], layer="sheets").sheet.tolist() == [NUMBER]
    with sqlite3.connect(paths[0]) as database:
        assert database.execute("pragma integrity_check").fetchone() == ("ok",)
    database.close()
    # A second read of what was written gives the same footprints.
    assert len(read_footprints(paths[0], CRS).frame) == 40
    with pytest.raises(WorkflowError, match="cannot be written"):
        write_footprints_gpkg(tmp_path / "no" / "a.gpkg", whole.frame, whole.sheets)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{NUMBER}.gpkg", "a.gpkg", "b.gpkg"]


def test_no_footprints_at_all(tmp_path):
    doc = ezdxf.new("R2010")
    doc.saveas(tmp_path / f"{NUMBER}.dxf")
    whole = combine([read_footprints(tmp_path / f"{NUMBER}.dxf", CRS)])
    assert (len(whole.frame), len(whole.sheets)) == (0, 1)
    write_footprints_gpkg(tmp_path / "e.gpkg", whole.frame, whole.sheets, whole.repairs)
    back = read_footprints(tmp_path / "e.gpkg", CRS, layer="footprints")
    assert len(back.frame) == 0


def test_the_real_sheet_is_one_in_all_its_formats(tmp_path):
    if not REAL.is_dir():
        pytest.skip("real data ../shared/data/ngii is not there (BRMGEO_REAL_DATA)")
    for part in REAL.glob("N3A_B0010000.*"):
        shutil.copy(part, tmp_path)
    files = [REAL / "36914093_buildings.gpkg", REAL / "36914093_r12.dxf", REAL / "36914093_r2018.dxf"]
    reads = [read_footprints(path, CRS) for path in (*files, tmp_path / "N3A_B0010000.shp")]
    keys = [sorted(shapely.to_wkb(shapely.normalize(read.frame.geometry.values))) for read in reads]
    assert keys[0] == keys[1] == keys[2] == keys[3]
    for read in reads:
        assert len(read.frame) == 2536
        assert read.frame.area.sum() == pytest.approx(354_361, abs=0.5)
        assert read.sheets.loc[0, ["sheet", "outline"]].tolist() == [NUMBER, "number"]
    kinds = reads[0].frame.kind.value_counts()
    assert kinds.equals(reads[1].frame.kind.value_counts())
    assert kinds["house"] == 551


def test_a_row_without_geometry_is_counted_as_lost_and_lies_nowhere(tmp_path: Path) -> None:
    frame = town()
    n = len(frame)
    many = gpd.GeoDataFrame(geometry=[*frame.geometry] * 4 + [None, shapely.Polygon()], crs=frame.crs)
    pyogrio.write_dataframe(many, tmp_path / "t.gpkg")
    read = read_footprints(tmp_path / "t.gpkg", CRS, max_dropped_share=0.5)
    lost = [r for r in read.repairs if r.kind == "unreadable"]
    assert [r.handle for r in lost] == [str(4 * n + 1), str(4 * n + 2)]
    assert not np.isfinite([r.x for r in lost]).any()


def test_a_parquet_that_unpacks_beyond_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = town()
    many = gpd.GeoDataFrame(geometry=[frame.geometry.iloc[0]] * 200_000, crs=frame.crs)
    many.to_parquet(tmp_path / "t.parquet")
    assert (tmp_path / "t.parquet").stat().st_size < 100_000
    monkeypatch.setattr("brmgeo.memory.free_bytes", lambda: 50_000_000)
    with pytest.raises(
        InputError, match=r"t\.parquet of 200000 rows takes about 0\.3 GB of memory, and 0\.1 GB are free"
    ):
        read_footprints(tmp_path / "t.parquet", CRS)
