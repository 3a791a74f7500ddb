"""What the commands make of awkward flights, logs and paths: each is taken right or told in one line."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from small_flights import command

from brmgeo import files
from brmgeo.errors import WorkflowError
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.motion import motions
from brmgeo.flight.own import Embedded
from brmgeo.flight.readings import Odometry
from brmgeo.flight.values import Motion
from brmgeo.geo.crs import transformer
from brmgeo.locate.localizer import usual_reset_speed_m_s
from brmgeo.match import MatchSettings, OdometrySettings
from pipelines import odometry

TOML = """name = "small"
[camera]
width = 32
height = 24
fov_deg = 43.0
[height]
source = "frames"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A flight folder of four frames, without odometry."""
    root = tmp_path / "flight"
    (root / "frames").mkdir(parents=True)
    for i in range(4):
        cv2.imwrite(str(root / "frames" / f"f{i}.png"), np.full((24, 32, 3), 40 * i, np.uint8))
    rows = [f"{i},f{i}.png,100" for i in range(4)]
    (root / "frames.csv").write_text("\n".join(["t_s,file,agl_m", *rows]) + "\n")
    (root / "flight.toml").write_text(TOML)
    return root


def track(speed_m_s: float) -> Odometry:
    """A straight track of 3 s at ten poses a second."""
    t = np.arange(31) / 10.0
    xyz = np.stack([speed_m_s * t, 0 * t, 0 * t], axis=-1)
    return Odometry(t, xyz, np.tile([1.0, 0.0, 0.0, 0.0], (31, 1)), "straight")


def motions_of(flight: Flight, max_speed_m_s: float = 20.0) -> list[Motion]:
    fastest = usual_reset_speed_m_s(MatchSettings(odometry=OdometrySettings(max_speed_m_s=max_speed_m_s)))
    return motions(flight.odometry, flight.times_s, max_speed_m_s=fastest)


def test_a_fast_aircraft_is_no_reset_where_its_speed_is_allowed(folder: Path) -> None:
    flight = replace(read_flight(folder), odometry=track(90.0))
    assert [m.step_m is None for m in motions_of(flight)] == [True] * 4
    steps = motions_of(flight, 100.0)
    assert [m.step_m is None for m in steps] == [True, False, False, False]
    slow = replace(flight, odometry=track(30.0))
    # A low bound is of movement without odometry: the track itself is believed up to what aircraft fly.
    assert all(m.step_m is not None for m in motions_of(slow, 8.0)[1:])


def poses(path: Path, topic: float = 1.0) -> Path:
    rows = [f"{100 + i / 10} {topic * i} 0 1 0 0 0 1" for i in range(200)]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_no_frames_a_second_is_no_rate(tmp_path: Path) -> None:
    for rate in ("0", "-1"):
        status, said = command("import", poses(tmp_path / "a.tum"), "--rate", rate, "--out", tmp_path / "out")
        assert (status, said.count("\n")) == (2, 1)
        assert "--rate" in said


def test_a_place_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    log = poses(tmp_path / "a.tum")
    for out in (log / "sub", log / "sub" / "deep", tmp_path / ("n" * 300)):
        status, said = command("import", log, "--out", out)
        assert (status, said.count("\n")) == (2, 1), said
        assert "Traceback" not in said
        assert str(log if out.parent != tmp_path else out) in said
    status, said = command("inspect", log, "--write", tmp_path)
    assert (status, said.count("\n")) == (2, 1)


def test_inspect_writes_what_it_tells(tmp_path: Path) -> None:
    kitti = tmp_path / "poses.txt"
    kitti.write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(30)))
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{i / 10}\n" for i in range(30)))
    out = tmp_path / "logs.md"
    words = ("inspect", kitti, "--times", times)
    status, told = command(*words)
    assert status == 0
    assert command(*words, "--write", out) == (0, f"wrote {out}\n")
    assert told.strip() in out.read_text()
    assert ".." not in out.read_text().split("## ")[0].replace("...", "")
    # What cannot be read is told in the file, and by the exit status.
    assert command("inspect", kitti, "--write", out)[0] == 2
    assert "## Not read" in out.read_text()


def test_inspect_says_where_a_flight_was(folder: Path) -> None:
    assert "nothing here says where it was flown" in command("inspect", folder)[1]
    rows = [f"{i},{129.35 + i * 1e-5},36.02,1.5" for i in range(4)]
    (folder / "reference.csv").write_text("\n".join(["t_s,lon,lat,sigma_m", *rows]) + "\n")
    status, said = command("inspect", folder)
    assert status == 0
    assert "about 36.02000 N 129.35001 E, accuracy 1.50 m" in said or "129.35002 E" in said
    # Metres of a map tell the same place.
    (folder / "flight.toml").write_text(TOML + '[reference]\nfile = "reference.csv"\ncrs = "EPSG:5187"\n')
    x, y = transformer("EPSG:4326", "EPSG:5187").transform(129.35, 36.02)
    rows = [f"{i},{x},{y}" for i in range(4)]
    (folder / "reference.csv").write_text("\n".join(["t_s,x,y", *rows]) + "\n")
    assert "about 36.02000 N 129.35000 E" in command("inspect", folder)[1]
    (folder / "reference.csv").write_text("t_s,x,y\n0,1e9,1e9\n1,1e9,1e9\n")
    status, said = command("inspect", folder)
    assert status == 0
    assert "reference  cannot be used: " in said


def test_import_says_what_it_leaves_out(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        image = Image.fromarray(np.full((60, 80, 3), 50 * i, np.uint8))
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[36867] = f"2024:05:06 10:20:{10 + 3 * i}"
        xmp = (
            '<x:xmpmeta><x drone-dji:RelativeAltitude="+60.0" drone-dji:GimbalRollDegree="0" '
            'drone-dji:GimbalPitchDegree="-90" drone-dji:GimbalYawDegree="10"/></x:xmpmeta>'
        )
        image.save(photos / f"a{i}.jpg", exif=exif, xmp=xmp.encode())
    status, said = command("import", photos, "--fov", 43, "--mount", "1,2,3", "--out", tmp_path / "flight")
    assert status == 0, said
    assert "--mount was left out" in said
    assert "no photo has a place in its tags" in said
    assert read_flight(tmp_path / "flight").mount.roll_rad == 0.0

    video = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (64, 48))
    for i in range(10):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    words = (
        "import",
        poses(tmp_path / "a.tum"),
        "--video",
        video,
        "--video-start",
        101,
        "--fov",
        43,
        "--agl",
        60,
    )
    status, said = command(*words, "--shift-frames", 2, "--out", tmp_path / "filmed")
    assert status == 0, said
    assert "--shift-frames was left out" in said
    assert read_flight(tmp_path / "filmed").times_s[0] == 101.0


# ---------------------------------------------------------------- odometry of the flight's own


def made(flight: Flight, method: str = "auto") -> Embedded:
    """What the filter might have made of a flight."""
    n = len(flight.frames)
    facts = {
        "made_by": "brmgeo odometry", "method": "vio", "length_m": 30.0, "seconds": 3.0, "blind_frames": 0, "poses": n,
        "segments": 1, "warnings": ["the camera's times differ from the IMU's by +80 ms"],
    }  # fmt: skip
    t = flight.times_s
    track = Odometry(t, np.stack([10.0 * t, 0 * t, 0 * t], -1), np.tile([1.0, 0, 0, 0], (n, 1)), "embedded")
    track = replace(track, walk_m2=0.01 * t)
    return Embedded(track, 0 * t, np.ones(n, np.int64), np.zeros(n, np.bool_), facts)


def test_a_killed_run_is_mended_by_the_next(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(odometry, "estimate", made)
    replaced = files.write_bytes
    before = (folder / "flight.toml").read_text()
    for again in (False, True):  # a first run, and one over a track that is there
        for killed in range(4):
            left = killed

            def replace_some(path: Path, data: bytes, *, durable: bool = False) -> None:
                nonlocal left
                if not left:
                    raise KeyboardInterrupt
                left -= 1
                replaced(path, data, durable=durable)

            if again:
                odometry.make_odometry(folder)
                (folder / "odometry.tum").write_text("0 0 0 0 0 0 0 1\n")  # of another number of poses
            else:
                for path in folder.glob("odometry.*"):
                    path.unlink()
                (folder / "flight.toml").write_text(before)
            with monkeypatch.context() as context:
                context.setattr(files, "write_bytes", replace_some)
                if not (again and killed == 3):  # flight.toml is not written again
                    with pytest.raises(KeyboardInterrupt):
                        odometry.make_odometry(folder)
            if not again:
                assert read_flight(folder).odometry is None
            odometry.make_odometry(folder)
            found = read_flight(folder).odometry
            assert found is not None
            assert found.walk_m2 == pytest.approx([0.0, 0.01, 0.02, 0.03])
            assert (folder / "flight.toml").read_text().count("[odometry]") == 1


def test_a_thinned_flight_is_there_whole_or_not_at_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = folder.parent / "thin"

    def full(source: Path, target: Path) -> None:
        if str(target).endswith("f2.png"):
            raise OSError(28, "No space left on device", str(target))
        copyfile(source, target)

    copyfile = shutil.copyfile
    with monkeypatch.context() as context:
        context.setattr(shutil, "copyfile", full)
        with pytest.raises(WorkflowError, match="the disk is full"):
            odometry.thin_flight(folder, out, 2.0)
    assert sorted(p.name for p in folder.parent.iterdir()) == ["flight"]
    odometry.thin_flight(folder, out, 2.0)
    assert [f.t_s for f in read_flight(out).frames] == [0.0, 2.0]
    assert out.stat().st_mode & 0o777 == folder.stat().st_mode & 0o777
