"""Where a simulated flight goes, and what its camera would have stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

from brmgeo.errors import InputError, MissingInputError
from brmgeo.locate.maps import read_maps
from brmgeo.region import FlightSettings
from brmgeo.synth.flight import RaisedFootprints
from brmgeo.synth.mission import (
    PATHS,
    flight_path,
    imagery_along,
    inset,
    path_name,
    read_ground,
    simulator_settings,
)

TOWN = (0.0, 0.0, 1200.0, 1000.0)
LENGTH_M = {"rectangle": 1075.0, "lawnmower": 2300.0, "random": 1500.0}


@pytest.fixture(scope="module")
def ground() -> RaisedFootprints:
    """Houses of 10 m, 40 m apart, all over the town."""
    places = [(x, y) for x in range(20, 1200, 40) for y in range(20, 1000, 40)]
    return RaisedFootprints.from_polygons([shapely.box(x, y, x + 10, y + 10) for x, y in places])


@pytest.mark.parametrize("path", PATHS)
def test_named_paths_stay_on_the_map(ground: RaisedFootprints, path: str) -> None:
    routes = [flight_path(path, ground, seed, TOWN, "EPSG:5187") for seed in range(5)]
    for route in routes:
        assert ((route >= TOWN[:2]) & (route <= TOWN[2:])).all()
        legs = np.linalg.norm(np.diff(route, axis=0), axis=1)
        assert legs.sum() == pytest.approx(LENGTH_M[path], rel=0.02)
    assert len({route.tobytes() for route in routes}) == len(routes)
    assert (flight_path(path, ground, 3, TOWN, "EPSG:5187") == routes[3]).all()


@pytest.mark.parametrize("path", ["rectangle", "lawnmower"])
def test_a_path_that_does_not_fit_is_told(ground: RaisedFootprints, path: str) -> None:
    with pytest.raises(InputError, match="does not fit"):
        flight_path(path, ground, 1, (0.0, 0.0, 300.0, 300.0), "EPSG:5187")


def test_a_path_that_nobody_knows_names_its_parameter(ground: RaisedFootprints) -> None:
    with pytest.raises(MissingInputError, match="rectangel: give rectangle, lawnmower, random") as caught:
        flight_path("rectangel", ground, 1, TOWN, "EPSG:5187")
    assert caught.value.needs == "path"
    assert "--" not in str(caught.value)
    assert (path_name("random"), path_name("a/line.geojson")) == ("random", "line")


def test_a_waypoint_far_off_the_maps_is_told(ground: RaisedFootprints, tmp_path: Path) -> None:
    line = tmp_path / "line.geojson"
    line.write_text('{"type": "LineString", "coordinates": [[129.0, 38.0], [129.001, 38.0], [29.0, 38.0]]}')
    bounds = (199_000.0, 599_000.0, 201_000.0, 601_000.0)
    with pytest.raises(InputError, match=r"line.geojson: waypoint 3 lies \d+ km off the maps: correct it"):
        flight_path(str(line), ground, 1, bounds, "EPSG:5187")


def test_bounds_are_never_drawn_in_to_nothing() -> None:
    assert inset((0.0, 0.0, 1000.0, 800.0), 100.0) == (100.0, 100.0, 900.0, 700.0)
    assert inset((0.0, 0.0, 200.0, 1000.0), 100.0) == (50.0, 50.0, 150.0, 950.0)


def test_ground_and_imagery_of_maps_lie_where_the_maps_do(maps: Path) -> None:
    built = read_maps(maps)
    assert built.footprints is not None
    assert built.imagery is not None
    left, bottom, right, top = built.bounds
    ground = read_ground(built.footprints)
    west, south, east, north = ground.extent
    # Houses stand from 10 m within the maps on, and are 25 m long at most.
    assert np.abs(np.array([west - left, south - bottom, east - right, north - top])).max() < 25
    assert set(ground.height_m) == {3.0, 6.0, 9.0, 12.0}
    drawn = imagery_along(
        np.array([[left, bottom], [right, top]]), simulator_settings(FlightSettings()), built.imagery
    )
    assert (drawn.left, drawn.top, drawn.gsd_m) == (left, top, 0.5)
    assert drawn.rgb.shape == (*built.ground.building.shape, 3)


def test_finer_imagery_is_cut_out_around_the_route(maps: Path) -> None:
    asked: list[tuple[float, ...]] = []

    class Fine:
        gsd_m = 0.1

        def around(self, bounds: tuple[float, float, float, float]) -> tuple[np.ndarray, float, float]:
            asked.append(bounds)
            return np.zeros((4, 5, 3), np.uint8), bounds[0], bounds[3]

    own = FlightSettings()
    route = np.array([[1000.0, 2000.0], [1100.0, 2050.0]])
    drawn = imagery_along(route, simulator_settings(own), maps / "imagery.tif", Fine())
    assert drawn.gsd_m == 0.1
    reach = own.agl_m * np.tan(np.radians(own.fov_deg) / 2) * 2.5 + 60.0
    assert asked == [pytest.approx((1000 - reach, 2000 - reach, 1100 + reach, 2050 + reach))]
