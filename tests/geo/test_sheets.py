"""NGII sheet numbers: published corners, round trips, and the check that refuses a wrong belt or datum."""

from __future__ import annotations

import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from brmgeo.errors import CrsError, InputError
from brmgeo.geo.crs import LONLAT, transformer
from brmgeo.geo.sheets import (
    check_extent,
    is_sheet_number,
    sheet_at,
    sheet_bounds_lonlat,
    sheet_extent,
    sheet_number_in,
    sheet_polygon,
    sheets_covering,
)

SIZE_DEG = {5: 0.25, 6: 0.125, 7: 0.05, 8: 0.025, 9: 0.005}


def test_published_corners():
    assert sheet_bounds_lonlat("36914093") == (129.300, 36.000, 129.325, 36.025)


@pytest.mark.parametrize(
    ("number", "bounds"),
    [
        ("37701", (127.0, 37.75, 127.25, 38.0)),
        ("37716", (127.75, 37.0, 128.0, 37.25)),
        ("377012", (127.125, 37.875, 127.25, 38.0)),
        ("3770125", (127.2, 37.75, 127.25, 37.8)),
        ("37701100", (127.225, 37.75, 127.25, 37.775)),
        ("377010100", (127.045, 37.95, 127.05, 37.955)),
        ("37016", (130.75, 37.0, 131.0, 37.25)),
        ("37516", (125.75, 37.0, 126.0, 37.25)),
    ],
)
def test_cells_count_from_the_north_west(number, bounds):
    assert sheet_bounds_lonlat(number) == pytest.approx(bounds, abs=1e-12)


@given(
    lon=st.floats(123.0, 132.999999),
    lat=st.floats(32.000001, 43.999999),
    digits=st.sampled_from([5, 6, 7, 8, 9]),
)
def test_a_point_lies_on_the_sheet_that_is_named_for_it(lon, lat, digits):
    number = sheet_at(lon, lat, digits)
    assert len(number) == digits
    west, south, east, north = sheet_bounds_lonlat(number)
    # The edge as a binary fraction may lie a hair east of the decimal that was written.
    assert west - 1e-12 <= lon < east
    assert south <= lat <= north
    assert east - west == pytest.approx(SIZE_DEG[digits]) == pytest.approx(north - south)
    assert sheet_at((west + east) / 2, (south + north) / 2, digits) == number


@given(st.text("0123456789", min_size=0, max_size=11))
def test_numbers_are_either_possible_or_refused(text):
    if is_sheet_number(text):
        west, south, east, north = sheet_bounds_lonlat(text)
        assert sheet_at((west + east) / 2, (south + north) / 2, len(text)) == text
    else:
        with pytest.raises(InputError):
            sheet_bounds_lonlat(text)


@pytest.mark.parametrize(
    "number", ["36917093", "36900", "369140", "36914101", "36914000", "20180101", "369a4093", "3691"]
)
def test_impossible_numbers(number):
    with pytest.raises(InputError):
        sheet_bounds_lonlat(number)


def test_extent_and_polygon_are_the_sheet():
    polygon = sheet_polygon("36914093", "EPSG:5187")
    assert polygon.bounds == sheet_extent("36914093", "EPSG:5187")
    to = transformer(LONLAT, "EPSG:5187")
    corners = [to.transform(lon, lat) for lon in (129.3, 129.325) for lat in (36.0, 36.025)]
    for x, y in corners:
        assert shapely.Point(x, y).distance(polygon.exterior) < 1e-6
    # The densified edge stays within a millimetre of the parallel.
    for k in range(1, 100):
        point = shapely.Point(*to.transform(129.3 + 0.025 * k / 100, 36.0))
        assert point.distance(polygon.exterior) < 1e-3
    assert polygon.area == pytest.approx(2257 * 2774, rel=0.01)


def test_the_papers_area():
    x, y = transformer(LONLAT, "EPSG:5187").transform(128.72, 37.67)
    bounds = (x - 1100, y - 1390, x + 1100, y + 1390)
    assert sheets_covering(bounds, "EPSG:5187") == ["37807029", "37807030", "37807039", "37807040"]
    assert sheets_covering(bounds, "EPSG:5187", digits=5) == ["37807"]


@given(
    lon=st.floats(126.5, 129.5),
    lat=st.floats(34.5, 38.0),
    w=st.floats(10.0, 9000.0),
    h=st.floats(10.0, 9000.0),
)
def test_covering_sheets_cover(lon, lat, w, h):
    x, y = transformer(LONLAT, "EPSG:5186").transform(lon, lat)
    box = shapely.box(x, y, x + w, y + h)
    numbers = sheets_covering(box.bounds, "EPSG:5186")
    assert len(set(numbers)) == len(numbers)
    parts = [sheet_polygon(number, "EPSG:5186").intersection(box).area for number in numbers]
    assert sum(parts) == pytest.approx(box.area, rel=1e-4)
    assert min(parts) > 0.0


def test_covering_outside_korea():
    with pytest.raises(InputError, match="outside NGII"):
        sheets_covering((400_000, 3_000_000, 410_000, 3_010_000), "EPSG:32617")


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("36914093_r2018.dxf", "36914093"),
        ("/a/37807039/(B010)수치지도_36914093_2024_00000634112839", "36914093"),
        ("N3A_B0010000.shp", None),
        ("20230415.dxf", None),
        ("C:\\maps\\37705.dxf", "37705"),
        ("town.dxf", None),
    ],
)
def test_numbers_in_file_names(name, number):
    assert sheet_number_in(name) == number


class TestCheckExtent:
    def test_the_right_crs_passes(self):
        extent = sheet_extent("36914093", "EPSG:5187")
        assert check_extent(extent, "EPSG:5187", ["36914093"], neatline=True) == 0.0

    @pytest.mark.parametrize(
        "wrong", ["EPSG:5185", "EPSG:5186", "EPSG:5188", "EPSG:5183", "EPSG:5179", "EPSG:5176"]
    )
    def test_a_wrong_belt_names_the_right_one(self, wrong):
        extent = sheet_extent("36914093", "EPSG:5187")
        with pytest.raises(CrsError, match=r'36914093\.dxf.* km .*set crs = "EPSG:5187"') as caught:
            check_extent(extent, wrong, ["36914093"], "36914093.dxf")
        assert "\n" not in str(caught.value)

    def test_the_false_northing_costs_100_km(self):
        extent = sheet_extent("36914093", "EPSG:5187")
        with pytest.raises(CrsError, match=r"100\.0 km off"):
            check_extent(extent, "EPSG:5183", ["36914093"])

    @pytest.mark.parametrize("bessel", [True, False], ids=["cut then", "cut now"])
    def test_the_old_datum_costs_313_m(self, bessel):
        extent = sheet_extent("37705039", "EPSG:5174", bessel=bessel)
        assert check_extent(extent, "EPSG:5174", ["37705039"]) <= 1e-6
        with pytest.raises(CrsError, match=r"EPSG:5174 fits.*313 m off"):
            check_extent(extent, "EPSG:5181", ["37705039"])

    def test_outlines_inside_the_sheet_pass_and_a_neatline_must_match(self):
        left, bottom, right, top = sheet_extent("36914093", "EPSG:5187")
        inside = (left + 300, bottom + 300, right - 300, top - 300)
        assert check_extent(inside, "EPSG:5187", ["36914093"]) == 0.0
        with pytest.raises(CrsError, match="no Korean belt fits"):
            check_extent(inside, "EPSG:5187", ["36914093"], neatline=True)

    def test_without_a_number_only_the_neighbourhood_is_checked(self):
        extent = sheet_extent("36914093", "EPSG:5187")
        assert check_extent(extent, "EPSG:5187", []) == 0.0
        with pytest.raises(CrsError, match="state the crs"):
            check_extent((340_000, 3_100_000, 341_000, 3_101_000), "EPSG:5187", [], "town.gpkg")

    def test_degrees_are_refused(self):
        with pytest.raises(CrsError, match="metres"):
            check_extent((129.3, 36.0, 129.325, 36.025), LONLAT, ["36914093"])
