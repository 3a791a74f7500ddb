"""CRS helpers: held against pyproj's own database, finite differences and published check values."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from brmgeo.errors import CrsError
from brmgeo.geo.crs import (
    BELTS,
    LONLAT,
    apart,
    belt_for_lon,
    belt_for_sheet,
    convergence_rad,
    crs_name,
    on_old_datum,
    require_meeting,
    require_projected_metres,
    same_crs,
    transform_bounds,
    transformer,
)


@pytest.mark.parametrize("code", BELTS)
def test_the_belts_are_korean_and_lie_on_the_datum_that_they_are_said_to(code):
    crs = CRS(code)
    assert crs.name.startswith(("KGD2002 / ", "Korea 2000 / ", "Korean 1985 / "))
    assert on_old_datum(code) == crs.name.startswith("Korean 1985")
    assert on_old_datum(code) == (crs.geodetic_crs.name == "Korean 1985")
    lon0 = next(p.value for p in crs.coordinate_operation.params if p.name == "Longitude of natural origin")
    assert 125.0 <= lon0 <= 131.1
    if BELTS.index(code) < 4:
        assert belt_for_lon(lon0) == code


def test_kakao_check_value():
    e, n = transformer(LONLAT, "EPSG:5181").transform(128.72, 37.67)
    assert (e, n) == (pytest.approx(351752.11, abs=0.01), pytest.approx(464764.41, abs=0.01))


def test_old_datum_read_as_new_is_313_m_off():
    x, y = transformer("EPSG:5174", "EPSG:5181").transform(200_000.0, 500_000.0)
    assert math.hypot(x - 200_000.0, y - 500_000.0) == pytest.approx(313, abs=1)


def test_transformers_are_kept():
    assert transformer("EPSG:5187", LONLAT) is transformer("EPSG:5187", LONLAT)


def test_bounds_hold_the_bent_edges():
    west, south, east, north = transform_bounds(
        "EPSG:5187", LONLAT, (100_000.0, 300_000.0, 300_000.0, 500_000.0)
    )
    back = transformer("EPSG:5187", LONLAT)
    for x, y in (
        (100_000, 300_000),
        (200_000, 300_000),
        (300_000, 500_000),
        (200_000, 500_000),
        (100_000, 400_000),
    ):
        lon, lat = back.transform(x, y)
        assert west - 1e-9 <= lon <= east + 1e-9
        assert south - 1e-9 <= lat <= north + 1e-9


@given(x=st.floats(100_000, 300_000), y=st.floats(150_000, 650_000))
def test_convergence_is_the_angle_between_meridian_and_grid_north(x, y):
    there, back = transformer("EPSG:5187", "EPSG:4737"), transformer("EPSG:4737", "EPSG:5187")
    lon, lat = there.transform(x, y)
    ax, ay = back.transform(lon, lat - 1e-4)
    bx, by = back.transform(lon, lat + 1e-4)
    true_north_clockwise_from_grid = math.atan2(bx - ax, by - ay)
    assert convergence_rad("EPSG:5187", x, y) == pytest.approx(-true_north_clockwise_from_grid, abs=1e-6)


def test_convergence_grows_eastward():
    assert convergence_rad("EPSG:5187", 200_000.0, 400_000.0) == pytest.approx(0.0, abs=1e-9)
    assert convergence_rad("EPSG:5187", 250_000.0, 400_000.0) > 0.0


@pytest.mark.parametrize(
    ("number", "crs"),
    [("35512001", "EPSG:5185"), ("37612", "EPSG:5186"), ("377050391", "EPSG:5186"), ("36914093", "EPSG:5187")]
    + [("37807039", "EPSG:5187"), ("37016", "EPSG:5188"), ("37116", "EPSG:5188")],
)
def test_the_third_digit_names_the_belt(number, crs):
    assert belt_for_sheet(number) == crs


def test_belts_by_longitude():
    assert [belt_for_lon(lon) for lon in (125.0, 126.0, 127.9, 128.72, 131.0)] == [
        f"EPSG:{code}" for code in (5185, 5186, 5186, 5187, 5188)
    ]
    with pytest.raises(CrsError, match="outside the Korean belts"):
        belt_for_lon(140.0)


def test_a_region_needs_metres():
    require_projected_metres("EPSG:5187")
    require_projected_metres("EPSG:32617")
    for crs in ("EPSG:4326", "EPSG:2236"):  # degrees; US survey feet
        with pytest.raises(CrsError, match="needs a projected CRS in metres"):
            require_projected_metres(crs)


def test_names_and_equality():
    assert crs_name(CRS("EPSG:5187").to_wkt()) == "EPSG:5187"
    assert same_crs("EPSG:5187", CRS("EPSG:5187").to_wkt())
    assert not same_crs("EPSG:5187", "EPSG:5186")
    with pytest.raises(CrsError, match="is not known"):
        transformer("EPSG:99999999", LONLAT)


def test_no_way_between_two_crs_is_one_line():
    here = 'LOCAL_CS["site grid",UNIT["metre",1]]'
    with pytest.raises(CrsError, match="no transformation leads from site grid to EPSG:5187: state the crs"):
        transformer(here, "EPSG:5187")


def test_what_does_not_meet_is_told_with_the_nearest_and_its_distance():
    ground = (0.0, 0.0, 1000.0, 1000.0)
    near, far = (4000.0, 5000.0, 5000.0, 6000.0), (-90_000.0, 0.0, -80_000.0, 1000.0)
    line = apart("image", {"a.tif": far, "b.tif": near}, "the region", ground, "EPSG:5187")
    assert line == (
        "no image lies on the region: the nearest, b.tif, is 5.0 km away in EPSG:5187; check its crs and the region"
    )
    assert (
        apart("image", {"a.tif": far, "b.tif": (900.0, 900.0, 2000.0, 2000.0)}, "x", ground, "EPSG:5187")
        is None
    )
    assert apart("image", {}, "x", ground, "EPSG:5187") is None
    with pytest.raises(CrsError, match=r"the nearest, a\.tif, is 80\.0 km away"):
        require_meeting("image", {"a.tif": far}, "x", ground, "EPSG:5187")
