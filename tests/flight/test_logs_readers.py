"""Every binary format tells the same flight: position, attitude, rates, height, GNSS, pictures."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_writers import (
    ACCEL,
    GYRO,
    LAT,
    LON,
    WXYZ,
    XYZ,
    T,
    as_text,
    bag,
    dataflash,
    photo,
    picture,
    px4,
    telemetry,
    turn_between,
)

from brmgeo.errors import FlightError, InputError, MissingExtraError, MissingInputError
from brmgeo.flight.logs import Log, LogOptions, kind_of, read_log, rosbag
from brmgeo.flight.logs.values import in_order, looking_down
from brmgeo.flight.odometry import OdometryOptions, read_odometry

pytest.importorskip("rosbags")
pytest.importorskip("pyulog")
pytest.importorskip("pymavlink")


def check_track(log: Log, *, xyz_m: float = 1e-3, turn_rad: float = 1e-3, skip: int = 0) -> None:
    assert log.odometry is not None
    o = log.odometry
    assert len(o.t_s) == len(T) - skip
    assert np.allclose(o.t_s, T[skip:], atol=1e-6)
    assert np.abs(o.xyz_m - XYZ[skip:]).max() < xyz_m
    assert turn_between(o.wxyz, WXYZ[skip:]) < turn_rad


def check_imu(log: Log, gyro: float = 1e-5, accel: float = 1e-4) -> None:
    assert log.imu is not None
    assert np.abs(log.imu.gyro_rad_s - GYRO).max() < gyro
    assert np.abs(log.imu.accel_m_s2 - ACCEL).max() < accel


def check_gnss(log: Log, sigma: float) -> None:
    assert log.gnss is not None
    at = np.searchsorted(T, log.gnss.t_s - 1e-6)
    assert np.abs(log.gnss.lon_deg - LON[at]).max() < 1e-7
    assert np.abs(log.gnss.lat_deg - LAT[at]).max() < 1e-7
    if np.isfinite(sigma):
        assert log.gnss.sigma_m == pytest.approx(np.full(len(at), sigma), rel=1e-5)
    else:
        assert np.isnan(log.gnss.sigma_m).all()


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_bags_tell_the_flight_by_their_stamps(tmp_path: Path, kind: str) -> None:
    path = bag(tmp_path / "flight", kind)
    assert kind_of(path) == "rosbag"
    log = read_log(path)
    check_track(log, xyz_m=1e-9, turn_rad=1e-7)
    check_imu(log, 1e-9, 1e-9)
    check_gnss(log, 0.8)
    assert log.height is not None
    assert np.allclose(log.height.agl_m, XYZ[::2, 2], atol=1e-4)
    assert log.camera is not None
    assert (log.camera.fx, log.camera.fy, log.camera.distortion[0]) == (50.0, 51.0, 0.01)
    assert log.frames is not None
    assert np.allclose(log.frames.t_s, T[::20], atol=1e-6)
    images = dict(log.frames.images())
    assert all(np.array_equal(images[i], picture(i)) for i in range(len(log.frames.names)))
    # Recording lags the stamps; the stamps are what counts.
    assert all(offset == pytest.approx(-0.25, abs=1e-3) for _, offset in log.stamp_offset_s)


def test_a_bag_file_inside_its_folder_is_the_bag(tmp_path: Path) -> None:
    folder = bag(tmp_path / "flight", "db3", topics=("odom",))
    check_track(read_log(next(folder.glob("*.db3"))))
    folder = bag(tmp_path / "other", "mcap", topics=("pose",))
    check_track(read_log(next(folder.glob("*.mcap"))))
    assert np.array_equal(read_odometry(folder, "rosbag").t_s, read_log(folder).odometry.t_s)  # type: ignore[union-attr]


def test_messages_that_a_bag_counts_and_does_not_hold_are_told(tmp_path: Path) -> None:
    folder = bag(tmp_path / "flight", "mcap", topics=("odom", "imu"))
    file = next(folder.glob("*.mcap"))
    whole = read_log(file)
    assert not [note for note in whole.notes if "left out" in note]
    data = file.read_bytes()
    # The count of one topic in the bag's statistics: a channel's number, then its messages.
    count = struct.pack("<Q", len(T))
    at = data.rindex(count)
    file.write_bytes(data[:at] + struct.pack("<Q", 4 * len(T)) + data[at + 8 :])
    told = [note for note in read_log(file).notes if "left out" in note]
    assert len(told) == 1
    assert f"{3 * len(T)} of {4 * len(T)} rows (75.0%) are counted by the bag but not found in it" in told[0]


@pytest.mark.parametrize("encoding", ["rgb8", "mono8", "jpeg"])
def test_pictures_in_other_encodings(tmp_path: Path, encoding: str) -> None:
    frames = read_log(bag(tmp_path / "flight", "mcap", topics=("odom", "image"), encoding=encoding)).frames
    assert frames is not None
    for i, image in frames.images():
        if encoding == "rgb8":
            assert np.array_equal(image, picture(i))
        elif encoding == "mono8":
            assert np.array_equal(image, cv2.cvtColor(picture(i), cv2.COLOR_BGR2GRAY))
        else:
            assert isinstance(image, bytes)
            assert frames.names[i].endswith(".jpg")
            decoded = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
            assert np.abs(decoded.astype(int) - picture(i)).mean() < 6


def test_an_imus_orientation_counts_only_where_it_is_told(tmp_path: Path) -> None:
    log = read_log(bag(tmp_path / "told", "mcap", topics=("imu",), imu_turns=True))
    assert log.attitude is not None
    assert turn_between(log.attitude.wxyz, WXYZ) < 1e-6
    assert not log.attitude.north
    assert read_log(bag(tmp_path / "untold", "mcap", topics=("imu",), imu_turns=False)).attitude is None
    assert read_log(bag(tmp_path / "empty", "mcap", topics=("imu",))).attitude is None


def test_a_bag_with_several_odometries_lists_them(tmp_path: Path) -> None:
    path = bag(tmp_path / "flight", "mcap", topics=("odom", "pose"), twice=True)
    with pytest.raises(
        FlightError, match=r"choose one of /vins/odometry \(400\), /other/odometry \(400\)$"
    ) as several:
        read_log(path)
    assert several.value.needs == "topic"
    with pytest.raises(FlightError, match=r"no odometry named '/nothing': there is /vins"):
        read_log(path, LogOptions("/nothing"))
    for topic in ("/other/odometry", "/pose"):
        check_track(read_log(path, LogOptions(topic)))
        assert read_odometry(path, "rosbag", OdometryOptions(topic=topic)).source == topic


def test_stamps_that_jump_back_are_refused_and_overtaking_ones_sorted(tmp_path: Path) -> None:
    jumped = T.copy()
    jumped[200:] -= 5.0
    with pytest.raises(
        FlightError, match=r"/vins/odometry: out of order: message 201 is stamped .* 4.950 s before"
    ):
        read_log(bag(tmp_path / "jumped", "mcap", topics=("odom",), stamps=jumped))
    with pytest.raises(FlightError, match=r"/camera/image_raw: out of order: message 11"):
        read_log(bag(tmp_path / "images", "mcap", topics=("image",), stamps=jumped))
    with pytest.raises(FlightError, match=r"every header.stamp is zero"):
        read_log(bag(tmp_path / "zero", "mcap", topics=("odom",), stamps=T * 0))
    swapped = T.copy()
    swapped[[100, 101]] = swapped[[101, 100]]
    log = read_log(bag(tmp_path / "swapped", "mcap", topics=("odom",), stamps=swapped))
    assert log.odometry is not None
    assert np.allclose(log.odometry.t_s, T)
    assert log.odometry.xyz_m[100] == pytest.approx(XYZ[101])
    assert any("1 messages overtook" in note for note in log.notes)


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_a_truncated_bag_is_one_clear_line(tmp_path: Path, kind: str) -> None:
    path = bag(tmp_path / "flight", kind, topics=("odom", "imu"))
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    whole = file.read_bytes()
    for share in (0.0, 0.5, 0.97):
        file.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(FlightError, match="damaged, cut short or not indexed") as caught:
            read_log(path, LogOptions())
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", ["local", "old", "new", "vision"])
def test_px4_logs_of_all_versions_tell_the_flight(tmp_path: Path, version: str) -> None:
    log = read_log(px4(tmp_path / "log.ulg", version=version))
    check_track(log, skip=6 if version == "local" else 0)
    check_imu(log)
    assert log.odometry is not None
    segment = log.odometry.segment
    assert segment is not None
    if version in ("local", "new"):
        check_gnss(log, 0.9)
        assert log.uses_gnss
        assert [t for t, _ in log.resets] == pytest.approx([T[200]])
        assert int(np.diff(segment).argmax()) + 1 == 200 - (6 if version == "local" else 0)
    else:
        assert not segment.any()
    if version == "vision":
        assert log.uses_gnss is None
    assert log.attitude is not None
    assert turn_between(log.attitude.wxyz, WXYZ) < 1e-3
    assert log.height is not None
    assert (log.height.source, log.height.above) == ("distance_sensor", "ground")
    assert np.allclose(log.height.agl_m, XYZ[::4, 2], atol=1e-4)
    assert log.triggers_s is not None
    assert np.allclose(log.triggers_s, T[::60])


def test_px4_dropouts_are_told_and_damage_is_noted_or_refused(tmp_path: Path) -> None:
    log = read_log(px4(tmp_path / "log.ulg", dropout_ms=480))
    assert [d for _, d in log.lost] == [0.48]
    whole = (tmp_path / "log.ulg").read_bytes()
    cut = tmp_path / "cut.ulg"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    part = read_log(cut)
    assert part.odometry is not None
    assert 200 < len(part.odometry.t_s) < 350
    assert any("cut short" in note for note in part.notes)
    assert not any("cut short" in note for note in log.notes)
    cut.write_bytes(whole[:450])
    with pytest.raises(FlightError, match=r"breaks off before its first data|no readable ULog"):
        read_log(cut)
    cut.write_bytes(b"not a log at all" * 20)
    with pytest.raises(FlightError, match="no readable ULog"):
        read_log(cut)


@pytest.mark.parametrize("era", ["TimeUS", "TimeMS"])
def test_ardupilot_logs_of_both_eras_tell_the_flight(tmp_path: Path, era: str) -> None:
    log = read_log(dataflash(tmp_path / "log.bin", era=era))
    check_track(log, skip=4)
    check_imu(log)
    check_gnss(log, np.nan)
    assert log.height is not None
    assert log.height.source == "RFND"
    assert np.allclose(log.height.agl_m, XYZ[::2, 2], atol=1e-4)
    assert log.triggers_s is not None
    assert np.allclose(log.triggers_s, T[::60])
    assert log.uses_gnss


def test_a_dataflash_log_as_text_is_the_same_log(tmp_path: Path) -> None:
    binary = dataflash(tmp_path / "log.bin")
    first, second = read_log(binary), read_log(as_text(binary))
    assert first.odometry is not None
    assert second.odometry is not None
    assert np.array_equal(first.odometry.t_s, second.odometry.t_s)
    assert np.abs(first.odometry.xyz_m - second.odometry.xyz_m).max() < 1e-5
    assert second.gnss is not None
    check_imu(second)


def test_a_dataflash_log_without_position_and_one_cut_short(tmp_path: Path) -> None:
    path = dataflash(tmp_path / "log.bin", position=False)
    assert read_log(path).odometry is None
    with pytest.raises(FlightError, match="holds no odometry"):
        read_odometry(path, "ardupilot")
    path = dataflash(tmp_path / "log.bin")
    path.write_bytes(path.read_bytes()[:20_000])
    part = read_log(path).odometry
    assert part is not None
    assert 20 < len(part.t_s) < len(T)
    path.write_bytes(b"\x00" * 4000)
    with pytest.raises(FlightError, match="no ArduPilot dataflash log"):
        read_log(path)


def test_telemetry_tells_the_flight_of_the_vehicle_that_speaks_most(tmp_path: Path) -> None:
    log = read_log(telemetry(tmp_path / "log.tlog"))
    check_track(log)
    check_imu(log, 6e-4, 6e-3)
    check_gnss(log, 0.8)
    assert "MAVLink system 1" in log.notes[0]
    assert log.height is not None
    assert np.abs(log.height.agl_m - XYZ[::4, 2]).max() < 0.011


@pytest.mark.parametrize("make", ["ulg", "bin", "tlog", "bag", "jpg"])
def test_damaged_bytes_are_read_past_or_refused_in_one_line(tmp_path: Path, make: str) -> None:
    files = {
        "ulg": lambda: px4(tmp_path / "a.ulg", version="new"),
        "bin": lambda: dataflash(tmp_path / "a.bin"),
        "tlog": lambda: telemetry(tmp_path / "a.tlog"),
        "bag": lambda: bag(tmp_path / "a", "ros1", topics=("odom",)),
        "jpg": lambda: photo(tmp_path / "photos" / "a.jpg"),
    }
    (tmp_path / "photos").mkdir()
    path = files[make]()
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(11)
    for count in (1, 10, 200) * 2:
        broken = whole.copy()
        broken[rng.integers(0, len(whole), count)] = rng.integers(0, 256, count)
        path.write_bytes(broken.tobytes())
        said = ""
        try:
            read_log(path.parent if make == "jpg" else path)
        except InputError as error:
            said = str(error)
        assert "\n" not in said


def test_kinds_are_told_by_content(tmp_path: Path) -> None:
    assert kind_of(px4(tmp_path / "renamed.dat")) == "ulog"
    assert kind_of(dataflash(tmp_path / "renamed.txt")) == "ardupilot"
    with pytest.raises(MissingInputError, match="no such file"):
        kind_of(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FlightError, match=r"no flight.toml, no metadata.yaml"):
        read_log(tmp_path / "empty")
    (tmp_path / "words.txt").write_text("once upon a time\nthere was a log\n")
    with pytest.raises(FlightError, match="no poses in a known format"):
        read_log(tmp_path / "words.txt")


@pytest.mark.parametrize(
    ("library", "name"), [("rosbags", "x.bag"), ("pyulog", "x.ulg"), ("pymavlink", "x.bin")]
)
def test_a_missing_library_names_the_pip_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, name: str
) -> None:
    import sys

    for loaded in [m for m in sys.modules if m.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, library, None)
    heads = {
        "rosbags": b"#ROSBAG V2.0\n",
        "pyulog": b"ULog\x01\x12\x35\x01",
        "pymavlink": b"\xa3\x95 whatever",
    }
    (tmp_path / name).write_bytes(heads[library])
    with pytest.raises(
        MissingExtraError, match=rf"needs {library}, which is not installed: pip install 'brmgeo\[logs\]'"
    ):
        read_log(tmp_path / name)


@pytest.mark.parametrize("wrong", ["1,5", "²", "=cmd", "9" * 5000])
def test_a_row_of_a_text_log_that_is_no_number_is_left_out(tmp_path: Path, wrong: str) -> None:
    path = as_text(dataflash(tmp_path / "a.bin"))
    rows = path.read_text().splitlines()
    k = [i for i, row in enumerate(rows) if row.startswith("IMU, ")][9]
    rows[k] = ", ".join([*rows[k].split(", ")[:3], wrong, *rows[k].split(", ")[4:]])
    path.write_text("\n".join(rows))
    imu = read_log(path).imu
    assert imu is not None
    assert len(imu.t_s) in (399, 400)  # a comma splits it into two numbers


def test_a_wrong_length_in_a_ulog_costs_the_messages_beside_it_and_is_told() -> None:
    from brmgeo.flight.logs.ulog import _whole_messages

    message = b"\x04\x00D\x01\x00ab"
    data = bytearray(b"\0" * 16 + message * 50)
    assert _whole_messages(bytes(data)) == (bytes(data), [])
    data[16 + 20 * 7 + 1] ^= 0x80
    whole, unread = _whole_messages(bytes(data))
    assert unread == [(16 + 20 * 7, 16 + 21 * 7)]
    assert whole == b"\0" * 16 + message * 49


def _rows(log: Log) -> dict[str, int]:
    streams = {"odometry": log.odometry, "imu": log.imu, "height": log.height, "attitude": log.attitude}
    return {name: 0 if stream is None else len(stream.t_s) for name, stream in streams.items()}


@pytest.mark.parametrize("make", [px4, dataflash])
def test_one_flipped_bit_costs_a_row_or_two_and_whatever_it_costs_is_told(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    """Behind the definitions, which stand first."""
    path = make(tmp_path / ("a.ulg" if make is px4 else "a.bin"))
    data, whole = path.read_bytes(), read_log(path)
    rng = np.random.default_rng(7)
    for _ in range(40):
        damaged = bytearray(data)
        damaged[rng.integers(len(data) // 3, len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        got = read_log(path)
        lost = {name: n - _rows(got)[name] for name, n in _rows(whole).items() if _rows(got)[name] != n}
        assert all(n <= 3 for n in lost.values()), lost
        assert not lost or set(got.notes) - set(whole.notes), lost


def test_a_wrong_time_costs_its_own_row() -> None:
    t = np.arange(20.0)
    assert in_order(t).all()
    for wrong in (1e9, -5.0, math.nan):
        t[3] = wrong
        assert in_order(t).tolist() == [i != 3 for i in range(20)]
    assert in_order(np.array([0.0, 1.0, 1.0, 2.0])).tolist() == [True, True, False, True]
    assert not in_order(np.array([math.nan])).any()


@given(st.lists(st.integers(0, 12), max_size=14))
def test_no_longer_chain_of_times_is_there(times: list[int]) -> None:
    kept = in_order(np.array(times, np.float64))
    assert (np.diff(np.array(times)[kept]) > 0).all()
    longest = [0] * len(times)
    for i, t in enumerate(times):
        longest[i] = 1 + max((longest[k] for k in range(i) if times[k] < t), default=0)
    assert kept.sum() == max(longest, default=0)


@pytest.mark.parametrize("make", ["px4", "dataflash"])
def test_a_rangefinder_that_looks_forward_is_no_height(tmp_path: Path, make: str) -> None:
    log = read_log(
        px4(tmp_path / "log.ulg", ahead=True)
        if make == "px4"
        else dataflash(tmp_path / "log.bin", switch=200)
    )
    assert log.height is not None
    assert log.height.above == "ground"
    assert np.allclose(log.height.agl_m, np.interp(log.height.t_s, T, XYZ[:, 2]), atol=0.05)
    assert any("not taken as height: it looks forward (orientation 0)" in note for note in log.notes)


def test_one_rangefinder_of_several_is_taken_by_what_it_tells() -> None:
    notes: list[str] = []
    assert looking_down(notes, {"a": None, "b": None}) is None
    assert looking_down(notes, {"a": 0}) is None
    assert len(notes) == 3
    assert looking_down(notes, {"a": None}) == "a"
    assert "no orientation is told" in notes[-1]
    assert looking_down(notes, {"a": 24, "b": 25, "c": 25}) == "b"
    assert [n.split(" ")[0] for n in notes[-2:]] == ["a", "c"]


def test_the_track_is_that_of_the_primary_core_and_begins_anew_at_a_switch(tmp_path: Path) -> None:
    log = read_log(dataflash(tmp_path / "log.bin", switch=200))
    check_track(log, xyz_m=1e-2, skip=4)
    assert log.odometry is not None
    assert log.odometry.segment is not None
    assert np.flatnonzero(np.diff(log.odometry.segment)).tolist() == [195]
    assert any("primary core changes 1 times, first from 0 to 1" in note for note in log.notes)


def test_topics_that_nothing_is_taken_of_are_told() -> None:
    class Connection:
        topic, msgtype, msgcount = "/fmu/out/vehicle_odometry", "px4_msgs/msg/VehicleOdometry", 300

    class Reader:
        connections = (Connection(),)

    notes: list[str] = []
    rosbag._tell_left(Reader(), {"/imu"}, notes)
    assert notes == [
        "1 topics were not read, with messages: /fmu/out/vehicle_odometry (px4_msgs/msg/VehicleOdometry): 300"
    ]
