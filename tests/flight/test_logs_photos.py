"""Geotagged photos: places, heights, gimbals, focal lengths, lists beside them, and what stands in the way."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from log_writers import LAT0, LON0, dji, photo
from PIL import Image

from brmgeo.errors import FlightError, MissingInputError
from brmgeo.flight import frames
from brmgeo.flight.camera import ground_from_pixel, world_from_camera
from brmgeo.flight.logs import Log, read_log
from brmgeo.flight.readings import Attitude, Camera

DATA = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2] / "../shared/data"))


def shots(folder: Path, count: int = 4, **fields: object) -> Path:
    for i in range(count):
        photo(
            folder / f"DJI_{i + 1:04d}.JPG",
            time=f"2024:05:06 10:20:{30 + 2 * i}",
            lat=LAT0 + i * 1e-4,
            **fields,  # type: ignore[arg-type]
        )
    return folder


def angles(log: Log) -> tuple[float, float, float]:
    assert log.attitude is not None
    roll, pitch, _ = (float(np.degrees(a[0])) for a in frames.euler_from_quaternion(log.attitude.wxyz))
    return roll, pitch, float(frames.heading_deg(log.attitude.wxyz)[0])


def test_dji_photos_tell_place_height_gimbal_and_camera(tmp_path: Path) -> None:
    log = read_log(shots(tmp_path, xmp=dji((0.0, -90.0, 46.0))))
    assert log.gnss is not None
    assert np.allclose(log.gnss.lat_deg, LAT0 + np.arange(4) * 1e-4, atol=1e-8)
    assert np.allclose(log.gnss.lon_deg, LON0, atol=1e-8)
    assert log.frames is not None
    assert log.frames.t_s.tolist() == [0.0, 2.0, 4.0, 6.0]
    assert log.height is not None
    assert (log.height.agl_m.tolist(), log.height.above) == ([60.0] * 4, "take-off")
    assert angles(log) == pytest.approx((0.0, 0.0, 46.0), abs=1e-6)
    assert log.camera is not None
    assert log.camera.fx == pytest.approx(20 / 43.2666 * 100.0)
    assert "2024-05-06 10:20:30" in log.clock


@pytest.mark.parametrize("heading", [0.0, 46.0, 200.0])
@pytest.mark.parametrize("pitch", [-90.0, -74.16, -60.0])
def test_a_gimbal_that_looks_ahead_sees_the_ground_ahead(
    tmp_path: Path, heading: float, pitch: float
) -> None:
    # The oracle is plain geometry: the optical axis meets the ground h / tan(depression) ahead, along the heading.
    log = read_log(shots(tmp_path, 1, xmp=dji((0.0, pitch, heading), 50.0)))
    assert log.attitude is not None
    roll, tilt, yaw = (float(a[0]) for a in frames.euler_from_quaternion(log.attitude.wxyz))
    camera = Camera(801, 601, 470.0, 470.0, 400.0, 300.0)
    rotation = world_from_camera(Attitude(), roll, tilt, yaw)
    centre = ground_from_pixel(camera, rotation, np.array([0.0, 0.0, 50.0]), np.array([400.0, 300.0]))
    ahead = 50.0 / np.tan(np.radians(-pitch))
    east, north = ahead * np.sin(np.radians(heading)), ahead * np.cos(np.radians(heading))
    assert centre == pytest.approx([east, north], abs=1e-3)
    # The top of the picture lies farther ahead, its right to the right of the heading.
    top = ground_from_pixel(camera, rotation, np.array([0.0, 0.0, 50.0]), np.array([400.0, 200.0])) - centre
    right = ground_from_pixel(camera, rotation, np.array([0.0, 0.0, 50.0]), np.array([500.0, 300.0])) - centre
    nose = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
    assert top @ nose > 0.9 * np.linalg.norm(top)
    assert right @ [nose[1], -nose[0]] > 0.9 * np.linalg.norm(right)


def test_a_gimbal_turned_over_its_top_is_the_same_view(tmp_path: Path) -> None:
    # DJI writes a camera past straight down as rolled by 180 with the heading turned round.
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plain = angles(read_log(shots(tmp_path / "a", 1, xmp=dji((0.0, -90.0, 30.0)))))
    over = angles(read_log(shots(tmp_path / "b", 1, xmp=dji((180.0, -90.0, -150.0)))))
    assert over == pytest.approx(plain, abs=1e-6)


def test_sensefly_and_parrot_conventions(tmp_path: Path) -> None:
    for name, text in {
        "sensefly": "<Camera:Yaw>75.0</Camera:Yaw><Camera:Pitch>4.0</Camera:Pitch><Camera:Roll>-3.0</Camera:Roll>"
        "<Camera:GPSXYAccuracy>0.03</Camera:GPSXYAccuracy><Camera:AboveGroundAltitude>118.5</Camera:AboveGroundAltitude>",
        "parrot": '<x drone-parrot:CameraRollDegree="0" drone-parrot:CameraPitchDegree="-86" '
        'drone-parrot:CameraYawDegree="75"/>',
    }.items():
        folder = tmp_path / name
        folder.mkdir()
        log = read_log(shots(folder, xmp=f"<x:xmpmeta>{text}</x:xmpmeta>", make=name))
        roll, pitch, heading = angles(log)
        # Nose up by 4 degrees in both: FLU's pitch is positive nose down.
        assert (pitch, heading) == pytest.approx((-4.0, 75.0), abs=0.3)
        if name == "sensefly":
            assert roll == pytest.approx(-3.0, abs=0.05)
            assert log.height is not None
            assert (log.height.agl_m[0], log.height.above) == (118.5, "ground")
            assert log.gnss is not None
            assert log.gnss.sigma_m[0] == 0.03


def test_optics_from_the_best_tag(tmp_path: Path) -> None:
    dewarp = 'drone-dji:DewarpData="2020-01-01;3700.1,3690.2,1.5,-2.5,-0.27,0.11,0.001,0.0002,-0.03" drone-dji:RtkFlag="50" '
    rtk = 'drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015"'
    folder = shots(tmp_path, 2, xmp=dji((0.0, -90.0, 0.0), more=dewarp + rtk))
    log = read_log(folder)
    assert log.camera is not None
    assert (log.camera.fx, log.camera.fy, log.camera.cx, log.camera.cy) == pytest.approx(
        (3700.1, 3690.2, 41.0, 27.0)
    )
    assert log.camera.distortion == pytest.approx((-0.27, 0.11, 0.001, 0.0002, -0.03))
    assert log.gnss is not None
    assert log.gnss.sigma_m[0] == 0.015
    calibrated = tmp_path / "calibrated"
    calibrated.mkdir()
    more = 'drone-dji:CalibratedFocalLength="66.6"'
    camera = read_log(shots(calibrated, 1, xmp=dji((0.0, -90.0, 0.0), more=more))).camera
    assert camera is not None
    assert camera.fx == 66.6
    # The same photo made half as large keeps its tags, which tell the size that they are of.
    more += ' drone-dji:CalibratedOpticalCenterX="80.0"'
    camera = read_log(shots(calibrated, 1, xmp=dji((0.0, -90.0, 0.0), more=more))).camera
    assert camera is not None
    assert camera.fx == 33.3


def test_a_wide_photo_is_a_cut_of_the_whole_sensor(tmp_path: Path) -> None:
    camera = read_log(shots(tmp_path, 1, size=(160, 90))).camera
    assert camera is not None
    assert camera.fx == pytest.approx(20 / 43.2666 * 200.0)  # 160 x 120 has a diagonal of 200


def test_time_marks_of_dji(tmp_path: Path) -> None:
    shots(tmp_path, 3)
    rows = [
        f"{i + 1}\t{100000 + 2.5 * i:.6f}\t[2300]\t    0,N\t    0,E\t   90,V\t{LAT0 + i * 1e-4:.8f},Lat\t{LON0:.8f},Lon\t"
        f"{180.5:.3f},Ellh\t0.011, 0.013, 0.030\t50,Q"
        for i in range(3)
    ]
    (tmp_path / "flight_Timestamp.MRK").write_text("\n".join(rows))
    log = read_log(tmp_path)
    assert log.frames is not None
    assert log.frames.t_s == pytest.approx([0.0, 2.5, 5.0])
    assert log.gnss is not None
    assert log.gnss.sigma_m == pytest.approx([0.013] * 3)
    assert log.gnss.alt_m == pytest.approx([180.5] * 3)
    (tmp_path / "flight_Timestamp.MRK").write_text("\n".join(rows[:2]))
    with pytest.raises(FlightError, match="time marks for 2 of 3 photos"):
        read_log(tmp_path)
    (tmp_path / "flight_Timestamp.MRK").write_text("nothing of the kind\n")
    with pytest.raises(FlightError, match=r"MRK:1: no line of a DJI time mark"):
        read_log(tmp_path)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("name,lat,lon,alt,roll,pitch,yaw,t_s", "{n},{lat},{lon},140,1,2,80,{t}"),
        ("#name longitude/X latitude/Y height/Z yaw pitch roll SAlt", "{n} {lon} {lat} 140 80 2 1 60"),
        ("File;Latitude;Longitude;Altitude;Yaw;Pitch;Roll", "{n};{lat};{lon};140;80;2;1"),
    ],
)
def test_lists_of_autopilots(tmp_path: Path, head: str, row: str) -> None:
    shots(tmp_path, 3, make="SONY")
    lines = [
        row.format(n=f"DJI_{i + 1:04d}.JPG", lat=36.5 + i * 1e-3, lon=128.5, t=10.5 * i) for i in range(3)
    ]
    (tmp_path / "location.txt").write_text("\n".join([head, *lines]))
    log = read_log(tmp_path)
    assert log.gnss is not None
    assert log.gnss.lat_deg == pytest.approx([36.5, 36.501, 36.502])
    assert log.gnss.alt_m == pytest.approx([140.0] * 3)
    assert angles(log) == pytest.approx((1.0, -2.0, 80.0), abs=0.05)
    assert any("3 of 3 photos taken from this list" in note for note in log.notes)
    (tmp_path / "location.txt").write_text("name,lat,lon\nDJI_0001.JPG,354321.1,128.1\n")
    with pytest.raises(FlightError, match=r"location.txt:2: .* is no place"):
        read_log(tmp_path)


def test_photos_that_cannot_be_a_flight(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="no photos"):
        read_log(tmp_path)
    photo(tmp_path / "b.jpg", time="2024:05:06 10:20:30")
    photo(tmp_path / "a.jpg", time="2024:05:06 10:20:32")
    log = read_log(tmp_path)
    assert log.frames is not None
    assert log.frames.names == ("b.jpg", "a.jpg")
    assert any("not in order of time" in note for note in log.notes)
    photo(tmp_path / "c.jpg", time="2024:05:06 10:20:32")
    with pytest.raises(FlightError, match=r"c.jpg: the same time as a.jpg"):
        read_log(tmp_path)
    photo(tmp_path / "c.jpg", time="2024:05:06 10:20:32", sub="50")
    assert read_log(tmp_path).frames.t_s.tolist() == [0.0, 2.0, 2.5]  # type: ignore[union-attr]
    photo(tmp_path / "c.jpg", time="2024:05:06 10:20:34", size=(60, 80))
    with pytest.raises(FlightError, match=r"c.jpg: 60 x 80 pixels, but a.jpg has 80 x 60"):
        read_log(tmp_path)
    Image.new("RGB", (80, 60)).save(tmp_path / "c.jpg")
    with pytest.raises(FlightError, match=r"c.jpg: no time of exposure"):
        read_log(tmp_path)
    (tmp_path / "c.jpg").write_bytes(b"\xff\xd8 broken")
    with pytest.raises(FlightError, match=r"c.jpg: no readable photo"):
        read_log(tmp_path)
    (tmp_path / "c.jpg").unlink()
    photo(tmp_path / "c.jpg", time="2024:05:06 10:20:40", lat=None)
    assert any("1 photos have no place, the first is c.jpg" in note for note in read_log(tmp_path).notes)
    for name in "abc":
        photo(tmp_path / f"{name}.jpg", time=f"2024:05:06 10:2{ord(name) % 10}:00", lat=None)
    assert read_log(tmp_path).faults == ("no photo has a place in its tags",)
    with pytest.raises(MissingInputError, match="no such file"):
        read_log(tmp_path / "nowhere")


def test_a_gimbal_of_zeros_tells_no_attitude(tmp_path: Path) -> None:
    log = read_log(shots(tmp_path, xmp=dji((0.0, 0.0, 0.0))))
    assert log.attitude is None
    assert any("0, 0, 0 in 4 of 4 photos: not told" in note for note in log.notes)


def test_a_photo_that_is_dewarped_already_has_no_distortion(tmp_path: Path) -> None:
    dewarp = 'drone-dji:DewarpData="2020-01-01;70.1,70.2,1.5,-2.5,-0.27,0.11,0.001,0.0002,-0.03" drone-dji:DewarpFlag="1"'
    log = read_log(shots(tmp_path, 1, xmp=dji((0.0, -90.0, 5.0), more=dewarp)))
    assert log.camera is not None
    assert (log.camera.fx, log.camera.is_distorted) == (70.1, False)
    assert any("DewarpFlag 1" in note for note in log.notes)


def _marks(folder: Path, start_s: float, lat: float) -> None:
    shots(folder, 2)
    rows = [
        f"{i + 1}\t{start_s + 2 * i:.6f}\t[2300]\t0,N\t0,E\t90,V\t{lat + i * 1e-4:.8f},Lat\t{LON0:.8f},Lon\t"
        "180.5,Ellh\t0.011, 0.013, 0.030\t50,Q"
        for i in range(2)
    ]
    (folder / "flight_Timestamp.MRK").write_text("\n".join(rows))


def test_each_folder_has_its_own_time_marks(tmp_path: Path) -> None:
    for name, start_s, lat in (("a", 100.0, 36.0), ("b", 200.0, 37.0)):
        (tmp_path / name).mkdir()
        _marks(tmp_path / name, start_s, lat)
    log = read_log(tmp_path)
    assert log.frames is not None
    assert log.gnss is not None
    assert log.frames.t_s == pytest.approx([0.0, 2.0, 100.0, 102.0])
    assert log.gnss.lat_deg == pytest.approx([36.0, 36.0001, 37.0, 37.0001])
    shots(tmp_path, 1)
    with pytest.raises(FlightError, match=r"DJI_0001.JPG: no time mark file in its folder"):
        read_log(tmp_path)
    (tmp_path / "a" / "more.MRK").write_bytes((tmp_path / "a" / "flight_Timestamp.MRK").read_bytes())
    with pytest.raises(FlightError, match="2 time mark files in one folder"):
        read_log(tmp_path)


@pytest.mark.parametrize(
    ("crs", "x", "y"), [("EPSG:4326", 127.0, 37.5), ("EPSG:32652", 323_218.5, 4_152_176.6)]
)
def test_lists_of_opendronemap(tmp_path: Path, crs: str, x: float, y: float) -> None:
    shots(tmp_path, 2)
    rows = [f"DJI_{i + 1:04d}.JPG {x} {y} 150.0 30.0 0.0 0.0 0.05 0.1" for i in range(2)]
    (tmp_path / "geo.txt").write_text("\n".join([crs, *rows]))
    (tmp_path / "notes.txt").write_text("windy\nday\n")
    (tmp_path / "base.obs").write_text("x")
    log = read_log(tmp_path)
    assert log.gnss is not None
    assert log.gnss.lat_deg == pytest.approx([37.5, 37.5], abs=1e-3)
    assert log.gnss.lon_deg == pytest.approx([127.0, 127.0], abs=1e-3)
    assert log.gnss.sigma_m == pytest.approx([0.05, 0.05])
    assert angles(log) == pytest.approx((0.0, 0.0, 30.0), abs=1e-6)
    assert any("not read: notes.txt" in note for note in log.notes)
    assert any("not read: 1 .obs" in note for note in log.notes)


def test_a_list_that_names_photos_of_two_folders_alike_is_refused(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        shots(tmp_path / name, 1)
    (tmp_path / "places.csv").write_text("name,lat,lon,t_s\nDJI_0001.JPG,36.5,128.5,1\n")
    with pytest.raises(FlightError, match=r"places.csv:2: 2 photos are named dji_0001.jpg"):
        read_log(tmp_path)
    rows = ["name,lat,lon,t_s", "a/DJI_0001.JPG,36.5,128.5,1", "b/DJI_0001.JPG,36.6,128.5,2"]
    (tmp_path / "places.csv").write_text("\n".join(rows))
    gnss = read_log(tmp_path).gnss
    assert gnss is not None
    assert gnss.lat_deg == pytest.approx([36.5, 36.6])


@pytest.mark.skipif(not (DATA / "photos-dji").is_dir(), reason="real photos are not here (BRMGEO_REAL_DATA)")
def test_real_dji_photos_and_their_list_agree(tmp_path: Path) -> None:
    listed = read_log(DATA / "photos-dji")
    for name in ("DJI_0018.JPG", "DJI_0019.JPG", "DJI_0020.JPG"):
        (tmp_path / name).symlink_to((DATA / "photos-dji" / name).resolve())
    own = read_log(tmp_path)  # without the list: EXIF and XMP only
    assert own.gnss is not None
    assert listed.gnss is not None
    assert own.height is not None
    assert np.abs(own.gnss.lat_deg - listed.gnss.lat_deg).max() < 1e-8
    assert np.abs(own.gnss.lon_deg - listed.gnss.lon_deg).max() < 1e-8
    assert own.height.agl_m.tolist() == [39.8, 40.1, 40.1]
    assert angles(own) == pytest.approx((0.0, -0.1, 45.0), abs=0.01)
    assert own.frames is not None
    assert own.frames.t_s.tolist() == [0.0, 7.0, 14.0]


@pytest.mark.skipif(
    not (DATA / "flight-sheffield").is_dir(), reason="real photos are not here (BRMGEO_REAL_DATA)"
)
def test_real_photos_agree_with_the_flight_made_of_them() -> None:
    # The focal length by EXIF against the bundle adjustment's: within the 2 % that makers round 35 mm equivalents by.
    from brmgeo.flight.folder import read_flight

    flight = read_flight(DATA / "flight-sheffield")
    log = read_log(DATA / "flight-sheffield" / "frames")
    assert log.camera is not None
    assert log.camera.fx == pytest.approx(flight.camera.fx, rel=0.025)
    reference = flight.reference("EPSG:32617")
    assert reference is not None
    assert log.gnss is not None
    assert log.frames is not None
    named = {f.file: f for f in flight.frames}
    assert set(log.frames.names) == set(named)
    mine = flight.times_s
    assert np.abs(np.array([named[n].t_s for n in log.frames.names]) - mine).max() == 0.0
    assert np.allclose(log.frames.t_s - log.frames.t_s[0], mine - mine[0], atol=1.01)
