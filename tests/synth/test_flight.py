"""Simulated flights: drawn where the geometry says, the same in memory and as a folder, the same for the same seed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from small_flights import exact

from brmgeo.errors import InputError, SettingsError
from brmgeo.flight.camera import pixel_from_point, world_from_camera
from brmgeo.flight.folder import read_flight
from brmgeo.flight.motion import motions, yaw_of
from brmgeo.flight.readings import Attitude, Camera
from brmgeo.flight.values import View
from brmgeo.geo.crs import transformer
from brmgeo.synth.flight import (
    RATE_HZ,
    Imagery,
    MaskErrors,
    OdometryErrors,
    RaisedFootprints,
    SimulationSettings,
    Simulator,
    fly,
    frame_name,
    imu_of,
    lawnmower,
    odometry_of,
    path_from_geojson,
    place,
    random_mission,
    rectangle,
    simulate,
    simulate_views,
)

CRS = "EPSG:5187"
LEFT, BOTTOM, SIZE = 229000.0, 379000.0, 900.0
BOUNDS = (LEFT, BOTTOM, LEFT + SIZE, BOTTOM + SIZE)
PATH = np.array([[200.0, 300.0], [500.0, 300.0], [500.0, 600.0]]) + [LEFT, BOTTOM]
SHORT = SimulationSettings(frame_interval_s=15.0)


def polygons() -> list[shapely.Polygon]:
    rng = np.random.default_rng(7)
    out = []
    for x in np.arange(20.0, SIZE, 45.0):
        for y in np.arange(20.0, SIZE, 45.0):
            w, h = rng.uniform(6.0, 30.0, 2)
            shape = shapely.box(-w / 2, -h / 2, w / 2, h / 2)
            if w > 22 and h > 22:  # a courtyard
                shape = shape.difference(shapely.box(-5, -4, 6, 5))
            shape = shapely.affinity.rotate(shape, rng.uniform(0, 90), origin=(0, 0))
            out.append(shapely.affinity.translate(shape, x + LEFT, y + BOTTOM))
    return out


POLYGONS = polygons()
GROUND = RaisedFootprints.from_polygons(POLYGONS, [3.0 * (1 + i % 7) for i in range(len(POLYGONS))])


def overlap(view: View, xy: np.ndarray, yaw: float) -> float:
    """Intersection over union of a view, laid at a pose, with the polygons."""
    rows, cols = np.nonzero(view.known)
    ahead = (view.nadir_px[0] - rows - 0.5) * view.gsd_m
    left = (view.nadir_px[1] - cols - 0.5) * view.gsd_m
    x = xy[0] + ahead * math.cos(yaw) - left * math.sin(yaw)
    y = xy[1] + ahead * math.sin(yaw) + left * math.cos(yaw)
    union = shapely.union_all(np.array(POLYGONS, dtype=object))
    shapely.prepare(union)
    mapped = shapely.contains_xy(union, x, y)
    seen = view.building[rows, cols] > 0.5
    return float((mapped & seen).sum() / (mapped | seen).sum())


@pytest.mark.parametrize(
    "settings",
    [
        SHORT,
        replace(
            SHORT,
            camera=Camera(640, 480, 600.0, 605.0, 322.0, 236.0, (-0.12, 0.02, 0.001, -0.0005, 0.0)),
            mount=Attitude(0.02, -0.25, 0.5),
            wobble_deg=6.0,
        ),
    ],
    ids=["nadir", "tilted and distorted"],
)
def test_true_poses_lay_views_onto_the_map(settings: SimulationSettings) -> None:
    flight = simulate_views(GROUND, PATH, exact(settings), seed=1)
    assert len(flight.views) == 8
    for view, xy, yaw in zip(flight.views, flight.reference.xy_m, flight.yaw_rad):
        assert overlap(view, xy, float(yaw)) > 0.95
    off = flight.reference.xy_m[2] + [6.0, 0.0]
    assert overlap(flight.views[2], off, float(flight.yaw_rad[2])) < 0.8


def test_masks_follow_the_pixel_centre_rule() -> None:
    course = fly(PATH, SHORT, 2)
    simulator = Simulator(GROUND, exact(SHORT), course, 2)
    mask = simulator.mask(3)
    row = course.frame_index[3]
    rotation = world_from_camera(Attitude(), *course.roll_pitch_yaw[row])
    expected = np.zeros(mask.shape, bool)
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    for polygon in POLYGONS:
        rings = [polygon.exterior, *polygon.interiors]
        if np.hypot(*(np.array(polygon.centroid.coords[0]) - course.xyz_m[row, :2])) > 200:
            continue
        drawn = []
        for ring in rings:
            xy = np.asarray(ring.coords)
            drawn.append(
                pixel_from_point(SHORT.camera, rotation, course.xyz_m[row], np.c_[xy, np.zeros(len(xy))])
            )
        image = shapely.Polygon(drawn[0], drawn[1:])
        expected |= shapely.contains_xy(image, u, v)
    assert expected.mean() > 0.05
    assert (expected != (mask == 255)).sum() <= 3  # centres on an edge to the last bit


def test_memory_and_folder_are_the_same_flight(tmp_path: Path) -> None:
    settings = replace(SHORT, compass_error_deg=2.0)
    flight = read_flight(simulate(tmp_path / "f", GROUND, PATH, CRS, settings, 5))
    memory = simulate_views(GROUND, PATH, settings, 5)
    simulator = Simulator(GROUND, settings, fly(PATH, settings, 5), 5)
    assert len(flight.frames) == len(memory.views)
    assert flight.has_masks
    assert not flight.has_images
    for i, (frame, view) in enumerate(zip(flight.frames, memory.views)):
        assert (frame.t_s, frame.file) == (view.t_s, view.file)
        assert frame.agl_m == view.agl_m
        assert (flight.mask(i) == simulator.mask(i)).all()
    compass = flight.compass_yaw_rad(CRS, *memory.reference.xy_m[0])
    for a, b, yaw in zip(motions(flight.odometry, flight.times_s), memory.motions, compass):
        assert a.yaw_rad == pytest.approx(b.yaw_rad, abs=1e-12)
        assert (a.step_m is None) == (b.step_m is None)
        if a.step_m is not None:
            assert a.step_m == pytest.approx(b.step_m, abs=1e-9)
        assert b.compass_yaw_rad is not None
        assert yaw is not None
        assert math.remainder(yaw - b.compass_yaw_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    reference = flight.reference(CRS)
    assert reference is not None
    assert np.allclose(reference.at(flight.times_s), memory.reference.xy_m, atol=1e-3)


def digest(folder: Path) -> str:
    total = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        total.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return total.hexdigest()


def picture_of_the_ground() -> Imagery:
    gsd = 0.5
    size = int(SIZE / gsd)
    rng = np.random.default_rng(8)
    rgb = np.repeat(
        np.repeat(rng.integers(60, 160, (size // 20, size // 20, 3), dtype=np.uint8), 20, 0), 20, 1
    )
    return Imagery(rgb, LEFT, BOTTOM + SIZE, gsd)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    settings = replace(SHORT, frame_interval_s=50.0)
    imagery = picture_of_the_ground()
    made = [
        digest(
            simulate(
                tmp_path / str(i), GROUND, PATH, CRS, settings, seed, mode="both", imagery=imagery, name="x"
            )
        )
        for i, seed in enumerate([3, 3, 4])
    ]
    assert made[0] == made[1] != made[2]


def test_a_rendered_flight_has_everything(tmp_path: Path) -> None:
    settings = replace(SHORT, frame_interval_s=40.0)
    imagery = picture_of_the_ground()
    folder = simulate(
        tmp_path / "f", GROUND, PATH, CRS, settings, 3, mode="frames", imagery=imagery, lonlat=True
    )
    flight = read_flight(folder)
    assert flight.has_images
    assert not flight.has_masks
    assert flight.image(1).std() > 10
    imu = flight.imu()
    assert imu is not None
    assert np.linalg.norm(imu.accel_m_s2.mean(axis=0)) == pytest.approx(9.8, abs=0.1)
    text = (folder / "flight.toml").read_text().replace('source = "frames"', 'source = "altimeter"')
    (folder / "flight.toml").write_text(text)
    assert read_flight(folder).frames[1].agl_m == pytest.approx(flight.frames[1].agl_m, abs=4.0)
    reference = flight.reference(CRS)
    assert reference is not None
    assert np.hypot(*(reference.xy_m[0] - PATH[0])) < 1e-2


def test_pictures_show_the_imagery_where_the_geometry_says() -> None:
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 119.0, (-0.1, 0.01, 0.0, 0.0, 0.0))
    settings = replace(
        SHORT, camera=camera, noise_levels=0.0, vignette=0.0, exposure_sigma=0.0, exposure_s=0.0
    )
    x, y = np.meshgrid(np.arange(1800) + 0.5, np.arange(1800) + 0.5)
    plane = np.stack([x / 1800 * 255, y / 1800 * 255, np.full_like(x, 90)], -1).astype(np.uint8)
    imagery = Imagery(plane, LEFT, BOTTOM + SIZE, 0.5)
    course = fly(PATH, settings, 4)
    flat = RaisedFootprints.from_polygons(POLYGONS)
    image = Simulator(flat, settings, course, 4).picture(2, imagery).astype(float)
    row = course.frame_index[2]
    rotation = world_from_camera(settings.mount, *course.roll_pitch_yaw[row])
    for dx, dy in [(0, 0), (30, 10), (-25, -20), (5, 30)]:
        point = course.xyz_m[row] * [1, 1, 0] + [dx, dy, 0]
        u, v = np.round(pixel_from_point(camera, rotation, course.xyz_m[row], point)).astype(int)
        assert image[v, u, 0] == pytest.approx((point[0] - LEFT) / SIZE * 255, abs=2)
        assert image[v, u, 1] == pytest.approx((BOTTOM + SIZE - point[1]) / SIZE * 255, abs=2)


def test_roofs_lean_outwards_by_their_height() -> None:
    tower = [shapely.box(LEFT + 340, BOTTOM + 290, LEFT + 360, BOTTOM + 310)]
    path = np.array(
        [[LEFT + 200, BOTTOM + 340], [LEFT + 600, BOTTOM + 340]]
    )  # eastwards, the tower to the right
    settings = exact(
        SimulationSettings(wobble_deg=0.0, cruise_pitch_deg=0.0, crab_sigma_deg=0.0, agl_sigma_m=0.0)
    )
    course = fly(path, settings, 1)
    simulator = Simulator(RaisedFootprints.from_polygons(tower, [30.0]), settings, course, 1)
    frame = 6  # 150 m on, beside the tower
    low, high = simulator.mask(frame), simulator.mask(frame, relief=True)
    middle = [np.argwhere(m == 255)[:, 1].mean() - 319.5 for m in (low, high)]
    # Nose east, image right is south: 40 m at 150 m, then 120 m below the camera.
    assert middle[0] == pytest.approx(settings.camera.fx * 40 / 150, abs=1)
    size = [math.sqrt((m == 255).sum()) for m in (low, high)]
    assert middle[1] == pytest.approx(settings.camera.fx * 40 / 120, abs=1)
    assert size[1] / size[0] == pytest.approx(150 / 120, rel=0.02)


def test_mask_errors_are_as_many_as_asked_for() -> None:
    settings = replace(SHORT, frame_interval_s=5.0, wobble_deg=0.0)
    course = fly(PATH, settings, 6)

    def masks(errors: MaskErrors) -> np.ndarray:
        simulator = Simulator(GROUND, replace(settings, masks=errors), course, 6)
        return np.array([simulator.mask(i) for i in range(len(course.frame_index))]) == 255

    clean = masks(MaskErrors.none())
    missed = masks(replace(MaskErrors.none(), missed=0.3, missed_always=0.0))
    assert not (missed & ~clean).any()
    assert (clean & ~missed).sum() / clean.sum() == pytest.approx(0.3, abs=0.05)
    blobs = masks(replace(MaskErrors.none(), false_blobs=3.0))
    assert not (clean & ~blobs).any()
    assert 0.0 < (blobs & ~clean).mean() < 0.03
    wobbly = masks(replace(MaskErrors.none(), edge_sigma_m=0.5))
    assert wobbly.mean() == pytest.approx(clean.mean(), rel=0.03)
    assert 0.005 < (wobbly != clean).mean() < 0.05
    degraded = masks(MaskErrors.degraded(0.916))
    assert (degraded == clean).mean() == pytest.approx(0.916, abs=1e-4)


def test_buildings_can_be_missed_in_every_frame() -> None:
    course = fly(PATH, SHORT, 6)
    errors = replace(MaskErrors.none(), missed=0.3, missed_always=1.0)
    always = Simulator(GROUND, replace(SHORT, masks=errors), course, 6)
    clean = Simulator(GROUND, replace(SHORT, masks=MaskErrors.none()), course, 6)
    gone: dict[int, set[bool]] = {}
    for frame in range(len(course.frame_index)):
        a, b = always.mask(frame), clean.mask(frame)
        row = course.frame_index[frame]
        rotation = world_from_camera(Attitude(), *course.roll_pitch_yaw[row])
        for i, polygon in enumerate(POLYGONS):
            inside = polygon.representative_point()
            uv = pixel_from_point(
                SHORT.camera, rotation, course.xyz_m[row], np.array([inside.x, inside.y, 0.0])
            )
            if np.isfinite(uv).all() and (uv >= 0).all() and (uv <= [639, 479]).all():
                u, v = np.round(uv).astype(int)
                if not b[v, u]:
                    continue
                gone.setdefault(i, set()).add(not a[v, u])
    assert all(len(states) == 1 for states in gone.values())
    assert 0.15 < np.mean([True in states for states in gone.values()]) < 0.45


def test_odometry_errors() -> None:
    course = fly(rectangle((LEFT + 450, BOTTOM + 450), 20.0), SimulationSettings(), 3)
    truth = course.xyz_m[:, :2]
    exact = odometry_of(course, OdometryErrors.none(), 3)
    at = np.round(exact.t_s * RATE_HZ).astype(int)
    length = np.linalg.norm(np.diff(truth[at], axis=0), axis=1).sum()
    assert np.linalg.norm(np.diff(exact.xyz_m[:, :2], axis=0), axis=1).sum() == pytest.approx(
        length, rel=1e-3
    )
    # Exact odometry is the truth up to one turn and shift.
    turn = yaw_of(exact.wxyz) - course.roll_pitch_yaw[at, 2]
    assert np.abs(np.exp(1j * turn) - np.exp(1j * turn[0])).max() < 1e-6
    scaled = odometry_of(course, replace(OdometryErrors.none(), scale_bias=0.05), 3)
    assert np.linalg.norm(np.diff(scaled.xyz_m, axis=0), axis=1).sum() == pytest.approx(
        1.05 * np.linalg.norm(np.diff(exact.xyz_m, axis=0), axis=1).sum(), rel=1e-3
    )
    drifts = []
    for seed in range(40):
        track = odometry_of(course, replace(OdometryErrors.none(), drift_deg_sqrt_min=0.75), seed)
        turn = np.unwrap(yaw_of(track.wxyz) - course.roll_pitch_yaw[at, 2])
        drifts.append(math.degrees(turn[-1] - turn[0]))
    assert np.std(drifts) == pytest.approx(0.75 * math.sqrt(exact.t_s[-1] / 60.0), rel=0.35)


def test_an_odometry_reset_shows_as_a_step_unknown() -> None:
    settings = replace(SimulationSettings(), odometry=OdometryErrors(reset_times_s=(52.0,)))
    steps = simulate_views(GROUND, PATH, settings, 2).motions
    assert [i for i, m in enumerate(steps) if m.step_m is None] == [0, 11]
    without = simulate_views(GROUND, PATH, replace(settings, odometry=None), 2).motions
    assert all(m.step_m is None for m in without)


def test_imu_readings_integrate_to_the_course() -> None:
    course = fly(PATH, SimulationSettings(), 3)
    imu = imu_of(course, 3)
    gyro, accel = imu.gyro_rad_s, imu.accel_m_s2
    n = 10 * RATE_HZ
    turned = gyro[:n, 2].sum() / RATE_HZ
    assert turned == pytest.approx(course.roll_pitch_yaw[n, 2] - course.roll_pitch_yaw[0, 2], abs=0.05)
    assert np.linalg.norm(accel, axis=1).mean() == pytest.approx(9.81, abs=0.2)


def test_the_course_keeps_speed_height_and_path() -> None:
    course = fly(PATH, SimulationSettings(agl_sigma_m=2.0), 9)
    speed = np.linalg.norm(np.diff(course.xyz_m[:, :2], axis=0), axis=1) * RATE_HZ
    assert speed.mean() == pytest.approx(5.0, rel=0.02)
    assert speed.min() > 4.0
    line = shapely.LineString(PATH)
    assert shapely.distance(line, shapely.points(course.xyz_m[::50, :2])).max() < 5.0
    assert 0.5 < course.xyz_m[:, 2].std() < 4.0
    assert course.frame_times_s[:3].tolist() == [0.0, 5.0, 10.0]
    assert np.abs(np.degrees(course.roll_pitch_yaw[:, :2])).max() < 30


def test_paths(tmp_path: Path) -> None:
    path = rectangle((10.0, 20.0), 30.0)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(1075.0)
    assert path.mean(axis=0) != pytest.approx(path[0])
    side = path[1] - path[0]
    assert math.degrees(math.atan2(side[0], side[1])) == pytest.approx(30.0)
    turn = np.cross([*(path[1] - path[0]), 0], [*(path[2] - path[1]), 0])[2]
    assert turn < 0  # to the right
    lines = lawnmower((0.0, 0.0, 300.0, 200.0), 50.0)
    assert len(lines) == 10
    assert shapely.LineString(lines).buffer(25.01, cap_style="flat").area >= 300 * 200
    mission = random_mission(BOUNDS, 4, 1500.0)
    assert (mission == random_mission(BOUNDS, 4, 1500.0)).all()
    assert (mission >= BOUNDS[:2]).all()
    assert (mission <= BOUNDS[2:]).all()
    assert 1400 < np.linalg.norm(np.diff(mission, axis=0), axis=1).sum() <= 1501
    lonlat = [[129.31, 36.0], [129.32, 36.0], [129.32, 36.01]]
    file = tmp_path / "way.geojson"
    file.write_text(
        json.dumps({"type": "Feature", "geometry": {"type": "LineString", "coordinates": lonlat}})
    )
    assert path_from_geojson(file, CRS)[2] == pytest.approx(
        transformer("EPSG:4326", CRS).transform(129.32, 36.01)
    )
    for bad in (
        "{",
        "{}",
        '{"type": "Point", "coordinates": [1, 2]}',
        '{"type": "Point", "coordinates": [1e6, 2]}',
    ):
        file.write_text(bad)
        with pytest.raises(InputError, match=r"way\.geojson"):
            path_from_geojson(file, CRS)


def test_placing_finds_built_up_ground_inside_the_map() -> None:
    half = RaisedFootprints.from_polygons([p for p in POLYGONS if p.centroid.x > LEFT + SIZE / 2])
    for seed in range(5):
        path = place(rectangle((0, 0), 0.0, 500.0), half, seed, BOUNDS, margin_m=60.0)
        assert (path >= np.array(BOUNDS[:2]) + 60.0 - 1e-6).all()
        assert (path <= np.array(BOUNDS[2:]) - 60.0 + 1e-6).all()
        assert path[:, 0].min() > LEFT + SIZE / 2 - 80
    with pytest.raises(InputError, match="does not fit"):
        place(rectangle((0, 0), 0.0, 9000.0), half, 0, BOUNDS)


def test_ground_without_buildings_gives_blank_masks() -> None:
    blank = simulate_views(
        RaisedFootprints.from_polygons([]), PATH, replace(SHORT, masks=MaskErrors.none()), 1
    )
    assert all(view.building.max() == 0 and view.known.any() for view in blank.views)


def test_what_cannot_be_flown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two different points"):
        fly(PATH[:1], SHORT, 0)
    for name, value in (("agl_m", 0.0), ("speed_m_s", math.nan), ("frame_interval_s", math.inf)):
        with pytest.raises(SettingsError, match=f"the simulated flight: {name}: .* \\(found"):
            fly(PATH, replace(SHORT, **{name: value}), 0)
    with pytest.raises(InputError, match="needs imagery"):
        simulate(tmp_path / "a", GROUND, PATH, CRS, SHORT, mode="frames")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine").write_text("")
    with pytest.raises(InputError, match="new or empty folder"):
        simulate(tmp_path / "b", GROUND, PATH, CRS, SHORT)
    assert frame_name(3) == "frame_00003.jpg"


NUMBERS = [
    (part, field.name)
    for part, model in (("", SimulationSettings), ("odometry", OdometryErrors))
    for field in fields(model)
    if field.name not in ("camera", "mount", "masks", "odometry", "jpeg_quality", "reset_times_s")
]


@settings(max_examples=25, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(NUMBERS),
        st.floats(-1.0, 10.0) | st.floats(0.0, 1e6) | st.sampled_from([math.nan, math.inf, 5000.0, 1e300]),
        min_size=1,
        max_size=2,
    )
)
def test_a_simulated_flight_can_be_read_or_is_refused(given: dict[tuple[str, str], float]) -> None:
    made = SimulationSettings(camera=Camera.from_fov(64, 48, 43.0))
    own, odometry = ({name: v for (of, name), v in given.items() if of == part} for part in ("", "odometry"))
    made = replace(made, **own, odometry=replace(OdometryErrors(), **odometry))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "flight"
        with contextlib.suppress(SettingsError):
            simulate(out, GROUND, PATH[:1] + [[0.0, 0.0], [40.0, 0.0]], CRS, made, 1)
        if out.exists():
            read_flight(out)
