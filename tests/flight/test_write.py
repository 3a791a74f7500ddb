"""A flight folder that was written is read back: read(write(x)) == x, and numbers have the decimals of their kind."""

from __future__ import annotations

import string
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from brmgeo.errors import FlightError
from brmgeo.flight.folder import Flight, may_be_remade, read_flight
from brmgeo.flight.frames import likely_order, quaternion_from_euler
from brmgeo.flight.readings import Altimeter, Attitude, Camera, FloatArray, Frame, Imu, Odometry, Reference
from brmgeo.flight.tables import read_table
from brmgeo.flight.write import (
    FlightParts,
    name_track,
    rounded,
    write_flight,
    write_mask,
    write_picture,
    write_track,
)

SIZE = (16, 12)


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def arrays(n: int, k: int, low: float, high: float) -> st.SearchStrategy[FloatArray]:
    shape = (n, k) if k > 1 else (n,)
    return hnp.arrays(np.float64, shape, elements=numbers(low, high))


@st.composite
def times(draw: st.DrawFn, n: int) -> FloatArray:
    """Increasing, over the flight's five to ten seconds, whole hundredths, microseconds or any."""
    steps = draw(arrays(n, 1, 0.1, 1.0))
    t = 1.0 + np.cumsum(np.asarray(steps)) * 5.0 / n
    decimals = draw(st.sampled_from([2, 6, 17]))
    t = np.round(t, decimals) if decimals < 17 else t
    t = t + draw(st.sampled_from([0.0, 1.7e9]) if decimals < 17 else st.just(0.0))
    return np.asarray(t)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    fx, fy = draw(numbers(10.0, 100.0)), draw(numbers(10.0, 100.0))
    cx, cy = draw(numbers(5.0, 10.0)), draw(numbers(4.0, 8.0))
    bend = draw(st.sampled_from([(0.0,) * 5, (-0.01, 0.001, 1e-4, -3.3e-5, 0.0)]))
    return Camera(*SIZE, fx, fy, cx, cy, bend)  # type: ignore[arg-type]


def attitudes(k: int) -> st.SearchStrategy[FloatArray]:
    # Angles as instruments tell them, in degrees.
    return arrays(1, k, -60.0, 60.0).map(lambda v: np.radians(np.asarray(v).ravel()))


@st.composite
def odometries(draw: st.DrawFn, t: FloatArray) -> Odometry:
    n = len(t)
    roll, pitch = (np.asarray(draw(arrays(n, 1, -0.3, 0.3))) for _ in range(2))
    yaw = np.cumsum(np.asarray(draw(arrays(n, 1, -0.2, 0.2))))
    q = quaternion_from_euler(roll, pitch, yaw)
    # The reader refuses turns that are steadier in the other order of the columns.
    assume(likely_order(q[:, [1, 2, 3, 0]]) != "wxyz")
    segment = np.cumsum(draw(hnp.arrays(np.int64, n, elements=st.integers(0, 1))))
    walk = np.cumsum(np.asarray(draw(arrays(n, 1, 0.0, 3.0))))
    return Odometry(
        t,
        np.asarray(draw(arrays(n, 3, -1e6, 1e6))),
        q,
        "odometry",
        draw(st.sampled_from([None, segment])),
        draw(st.sampled_from([None, walk])),
    )


@st.composite
def flights(draw: st.DrawFn) -> FlightParts:
    n = draw(st.integers(1, 6))
    t = draw(times(n))
    agl = np.asarray(draw(arrays(n, 1, 1.0, 5000.0)))
    words = st.text(string.ascii_letters + string.digits + " ,\"'&한é-_", min_size=1, max_size=8)
    stems = draw(st.lists(words.map(str.strip).filter(bool), min_size=n, max_size=n, unique=True))
    compass = draw(st.booleans())
    frames = []
    for i in range(n):
        roll, pitch = draw(attitudes(2)).tolist()
        heading = draw(numbers(0.0, 359.9)) if compass else None
        frames.append(Frame(float(t[i]), f"{stems[i]}.jpg", float(agl[i]), roll, pitch, heading))
    m = draw(st.integers(2, 5))
    track = draw(odometries(np.linspace(t[0], t[-1] + 0.5, m))) if draw(st.booleans()) else None
    plain = track is not None and (track.segment is None or track.walk_m2 is not None)
    lonlat = draw(st.booleans())
    place = np.asarray(draw(arrays(m, 2, -0.1, 0.1)))
    about = [129.3, 36.0] if lonlat else [229_000.0, 379_000.0]
    reference = Reference(
        np.linspace(t[0], t[-1] + 0.5, m),
        place * (1.0 if lonlat else 1e4) + about,
        draw(st.sampled_from([None, np.asarray(draw(arrays(m, 1, -10.0, 900.0)))])),
        draw(st.sampled_from([None, np.asarray(draw(arrays(m, 1, 0.0, 9.0)))])),
    )
    imu = Imu(
        np.linspace(t[0], t[-1] + 0.5, m),
        np.asarray(draw(arrays(m, 3, -40.0, 40.0))),
        np.asarray(draw(arrays(m, 3, -200.0, 200.0))),
    )
    name = draw(st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12))
    return FlightParts(
        name=name if name.strip() else "flight",
        simulated=draw(st.booleans()),
        camera=draw(cameras()),
        mount=Attitude(*draw(attitudes(3)).tolist()),
        frames=tuple(frames),
        odometry=track,
        odometry_format=draw(st.sampled_from(["tum", "csv"])) if plain else "csv",
        imu=draw(st.sampled_from([None, imu])),
        altimeter=draw(st.sampled_from([None, Altimeter(t, agl)])),
        reference=draw(st.sampled_from([None, reference])),
        reference_crs="EPSG:4326" if lonlat else "EPSG:5187",
    )


def put(folder: Path, parts: FlightParts) -> Flight:
    """The flight of ``parts`` with masks, written and read."""
    (folder / "masks").mkdir()
    for frame in parts.frames or ():
        write_mask(folder, frame.file, np.zeros(SIZE[::-1], np.uint8))
    write_flight(folder, parts)
    return read_flight(folder)


def same(first: object, second: object) -> bool:
    return (first is None and second is None) or bool(
        first is not None and second is not None and np.array_equal(np.asarray(first), np.asarray(second))
    )


def near(first: float, second: float) -> bool:
    return abs(first - second) <= np.spacing(abs(second))


@settings(max_examples=60, deadline=None)
@given(flights())
def test_what_was_written_is_read(parts: FlightParts) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        check(Path(scratch), parts)


@settings(max_examples=30, deadline=None)
@given(flights())
def test_what_was_rounded_is_read_too_and_rounding_it_again_changes_nothing(parts: FlightParts) -> None:
    parts = replace(parts, odometry=None)  # its times may fall together with those of the next pose
    once = rounded(parts)
    with tempfile.TemporaryDirectory() as scratch:
        check(Path(scratch), once)
        assert "e" not in (Path(scratch) / "frames.csv").read_text().split("\n")[1].split(",")[0]
    twice = rounded(once)
    assert once.frames == twice.frames
    if once.imu is not None:
        assert twice.imu is not None
        assert same(once.imu.accel_m_s2, twice.imu.accel_m_s2)


def check(folder: Path, parts: FlightParts) -> None:
    flight = put(folder, parts)
    assert flight.name == parts.name
    assert flight.simulated == may_be_remade(folder) == parts.simulated
    assert flight.camera == parts.camera
    assert parts.frames is not None
    for got, mount in zip(
        (flight.mount.roll_rad, flight.mount.pitch_rad, flight.mount.yaw_rad),
        (parts.mount.roll_rad, parts.mount.pitch_rad, parts.mount.yaw_rad),
    ):
        assert near(got, mount)
    for frame, want in zip(flight.frames, parts.frames, strict=True):
        assert replace(frame, roll_rad=0.0, pitch_rad=0.0) == replace(want, roll_rad=0.0, pitch_rad=0.0)
        assert near(frame.roll_rad, want.roll_rad)
        assert near(frame.pitch_rad, want.pitch_rad)
    track, wanted = flight.odometry, parts.odometry
    assert (track is None) == (wanted is None)
    if track is not None and wanted is not None:
        for name in ("t_s", "xyz_m", "segment", "walk_m2"):
            assert same(getattr(track, name), getattr(wanted, name)), name
        # The reader gives quaternions their length again.
        assert np.abs(track.wxyz - wanted.wxyz).max() < 4e-16
    imu = flight.imu()
    for name in ("t_s", "gyro_rad_s", "accel_m_s2"):
        assert same(getattr(imu, name, None), getattr(parts.imu, name, None)), name
    if parts.altimeter is not None:
        table = read_table(folder / "altimeter.csv", [("t_s", "agl_m")])
        assert same(table.numbers["t_s"], parts.altimeter.t_s)
        assert same(table.numbers["agl_m"], parts.altimeter.agl_m)
    reference = flight.reference(parts.reference_crs)
    for name in ("t_s", "xy_m", "alt_m", "sigma_m"):
        assert same(getattr(reference, name, None), getattr(parts.reference, name, None)), name


FRAMES = (Frame(0.0, "a.jpg", 150.0), Frame(5.0, "b.jpg", 150.5))
SMALL = FlightParts("small", camera=Camera.from_fov(*SIZE, 43.0), frames=FRAMES)


def test_files_have_the_decimals_of_their_kind(tmp_path: Path) -> None:
    put(tmp_path, replace(SMALL, altimeter=Altimeter(np.array([0.0, 0.25]), np.array([1.0 / 3.0, 2.0]))))
    assert (tmp_path / "frames.csv").read_text() == "t_s,file,agl_m\n0.00,a.jpg,150.000\n5.00,b.jpg,150.500\n"
    assert (tmp_path / "altimeter.csv").read_text().split("\n")[1] == "0.00,0.33333333333333331"
    short = rounded(replace(SMALL, altimeter=Altimeter(np.array([1 / 3]), np.array([1 / 3]))))
    write_flight(tmp_path, short)
    assert (tmp_path / "altimeter.csv").read_text().split("\n")[1] == "0.333333,0.333"


@pytest.mark.parametrize("value", [0.5, 1.5, 2.5, 0.00005, 1.00015, 446174.26095, 1e9 + 0.12345])
def test_numbers_are_rounded_as_printing_rounds_them(value: float) -> None:
    track = rounded(
        replace(SMALL, reference=Reference(np.zeros(1), np.full((1, 2), value)), reference_crs="EPSG:5187")
    )
    assert track.reference is not None
    assert track.reference.xy_m[0, 0] == float(f"{value:.4f}")


def test_pictures_and_videos(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    rng = np.random.default_rng(1)
    pictures = [rng.integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8) for _ in FRAMES]
    for frame, picture in zip(FRAMES, pictures):
        write_picture(tmp_path, f"{frame.file}.png", picture)
    write_flight(tmp_path, replace(SMALL, frames=tuple(replace(f, file=f"{f.file}.png") for f in FRAMES)))
    flight = read_flight(tmp_path)
    assert np.array_equal(flight.image(1), pictures[1])
    mask = (rng.random(SIZE[::-1]) < 0.5).astype(np.uint8) * 255
    (tmp_path / "masks").mkdir()
    write_mask(tmp_path, "a.jpg.png", mask)
    assert np.array_equal(cv2.imread(str(tmp_path / "masks" / "a.jpg.png"), 0), mask)
    write_flight(tmp_path, replace(SMALL, video=('my "film".mp4', 3.25)))
    assert 'video = "my \\"film\\".mp4"\nstart_s = 3.25\n' in (tmp_path / "flight.toml").read_text()


def test_names_that_no_row_holds_and_segments_that_no_tum_holds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="cannot be the name of a frame"):
        write_flight(tmp_path, replace(SMALL, frames=(Frame(0.0, "a\nb.jpg", 9.0),)))
    half = (replace(FRAMES[0], true_heading_deg=1.0), FRAMES[1])
    with pytest.raises(FlightError, match="compass"):
        write_flight(tmp_path, replace(SMALL, frames=half))
    track = Odometry(np.zeros(1), np.zeros((1, 3)), np.eye(4)[:1], segment=np.zeros(1, np.int64))
    with pytest.raises(ValueError, match="segments"):
        write_track(tmp_path, track)
    assert not (tmp_path / "flight.toml").exists()


def test_a_track_is_named_where_none_is(tmp_path: Path) -> None:
    put(tmp_path, SMALL)
    before = (tmp_path / "flight.toml").read_text()
    track = Odometry(
        np.array([0.0, 5.0]),
        np.zeros((2, 3)),
        np.repeat(np.eye(4)[:1], 2, axis=0),
        walk_m2=np.array([0.0, 1.5]),
    )
    columns = {
        "yaw_sigma_deg": np.array([0.0, 0.25]),
        "tracks": np.array([0, 90]),
        "blind": np.array([False, True]),
    }
    section = write_track(tmp_path, track, columns=columns)
    assert read_flight(tmp_path.absolute(), with_odometry=False).odometry is None
    name_track(tmp_path, section, "brmgeo odometry")
    told = (tmp_path / "flight.toml").read_text()
    assert told.startswith(before)
    assert "[odometry]  # made by `brmgeo odometry`\n" in told
    name_track(tmp_path, section, "somebody else")
    assert (tmp_path / "flight.toml").read_text() == told
    odometry = read_flight(tmp_path).odometry
    assert odometry is not None
    assert same(odometry.walk_m2, track.walk_m2)
    assert (tmp_path / "odometry.covariance.csv").read_text() == (
        "t_s,walk_m2,yaw_sigma_deg,tracks,blind\n0.000000,0.000000,0.0000,0,0\n5.000000,1.500000,0.2500,90,1\n"
    )


def test_a_flight_toml_that_is_none_is_not_taken_for_a_simulated_flight(tmp_path: Path) -> None:
    assert not may_be_remade(tmp_path)
    for text in ("simulated = ", "simulated = true\na = " + "[" * 100_000, 'simulated = "true"'):
        (tmp_path / "flight.toml").write_text(text, encoding="utf-8")
        assert not may_be_remade(tmp_path)
    (tmp_path / "flight.toml").write_bytes(b"\xef\xbb\xbfsimulated = true\r\n")
    assert may_be_remade(tmp_path)
