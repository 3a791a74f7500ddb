"""Live equals batch, and a localizer that was saved and loaded equals one that was never interrupted, bit for bit."""

from __future__ import annotations

import csv
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brmgeo.errors import InputError, MissingInputError, SettingsError
from brmgeo.export.trajectory import fixes_rows
from brmgeo.flight.folder import Flight, read_flight
from brmgeo.flight.motion import Pose, poses_at
from brmgeo.flight.readings import Attitude
from brmgeo.flight.values import Estimate
from brmgeo.locate.flights import Located, locate_flight
from brmgeo.locate.localizer import Localizer, usual_reset_speed_m_s
from brmgeo.locate.maps import Maps, match_settings, read_maps
from brmgeo.locate.masks import FrameMasks, NetworkUse, frame_masks
from brmgeo.locate.saved import read_saved, settings_of, write_saved
from brmgeo.match import METHODS, MatchSettings, OdometrySettings
from brmgeo.region import FlightSettings
from brmgeo.segment.predict import Segmenter
from brmgeo.workflow.progress import Progress

SETTINGS = match_settings(FlightSettings())


def equal(one: Any, other: Any) -> bool:
    """The same to the last bit, NaN like NaN."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and bool(np.array_equal(one, other, equal_nan=one.dtype.kind == "f"))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    return one == other or (isinstance(one, float) and math.isnan(one) and math.isnan(other))


def same(one: Estimate, other: Estimate) -> bool:
    return all(equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Estimate))


def feed(here: Localizer, flight: Flight, first: int = 0, last: int | None = None) -> list[Estimate]:
    """A flight's own masks and readings as a program aboard would hand them in."""
    poses: list[Pose | None] = poses_at(flight.odometry, flight.times_s)
    return [
        here.step(
            frame.t_s,
            flight.mask(i),
            Attitude(frame.roll_rad, frame.pitch_rad),
            frame.agl_m,
            poses[i],
            file=frame.file,
        )
        for i, frame in list(enumerate(flight.frames))[first:last]
    ]


@pytest.fixture(scope="module")
def built(maps: Path) -> Maps:
    return read_maps(str(maps))


@pytest.fixture(scope="module")
def flight(whole: Path) -> Flight:
    return read_flight(whole)


@pytest.fixture(scope="module")
def made(built: Maps, flight: Flight) -> Callable[..., Localizer]:
    def make(method: str = "paper", **more: Any) -> Localizer:
        more = {"settings": SETTINGS} | more
        return Localizer(built, flight.camera, flight.mount, method=method, **more)

    return make


@pytest.fixture(scope="module")
def batch(built: Maps, flight: Flight) -> dict[str, Located]:
    masks = FrameMasks(flight, "")
    return {m: locate_flight(built, flight, masks, method=m, settings=SETTINGS) for m in METHODS}


# --- live equals batch -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_step_by_step_is_what_localize_wrote_of_the_folder(
    made: Callable[..., Localizer], flight: Flight, batch: dict[str, Located], results: Path, method: str
) -> None:
    here = made(method)
    assert here.last is None
    live = feed(here, flight)
    assert all(same(a, b) for a, b in zip(live, batch[method].estimates, strict=True))
    assert here.last is not None
    assert equal(here.last.motion.step_m, batch[method].motions[-1].step_m)
    with open(results / method / "fixes.csv", newline="") as handle:
        written = [tuple(row) for row in csv.reader(handle)][1:]
    assert written == fixes_rows(live, [f.file for f in flight.frames], here.maps.crs)
    assert any(e.position is not None for e in live) or method != "mask"


@pytest.mark.parametrize("answer", ["mask", "probability"])
def test_pictures_through_the_network_live_are_what_the_folder_s_masks_are(
    built: Maps, pictured: Path, weights: Path, tmp_path: Path, answer: str
) -> None:
    flight, network = read_flight(pictured), Segmenter.load(weights)
    use = NetworkUse(weights=weights, answer=answer, cache=tmp_path)
    with frame_masks(flight, "", use, Progress(quiet=True)) as masks:
        wanted = locate_flight(built, flight, masks, settings=SETTINGS).estimates
    here = Localizer(built, flight.camera, flight.mount, masks=network, settings=SETTINGS, answer=answer)
    poses = poses_at(flight.odometry, flight.times_s)
    for i, frame in enumerate(flight.frames):
        tilt = Attitude(frame.roll_rad, frame.pitch_rad)
        fix = here.step(frame.t_s, flight.image(i), tilt, frame.agl_m, poses[i])
        assert same(fix, wanted[i])
    assert fix.position is not None
    # Another height of the roofs is another view.
    assert here.last is not None
    low = Localizer(built, flight.camera, flight.mount, masks=network, answer=answer, roof_m=0.0)
    view = low.view(frame.t_s, flight.image(i), tilt, frame.agl_m)
    assert view.agl_m == pytest.approx(here.last.view.agl_m + 3.0)


def test_only_a_history_can_be_smoothed(made: Callable[..., Localizer]) -> None:
    with pytest.raises(SettingsError, match="history"):
        made("mask").smooth()


def test_a_history_is_smoothed(
    made: Callable[..., Localizer], flight: Flight, batch: dict[str, Located]
) -> None:
    here = made("paper", history=True)
    feed(here, flight)
    for name in ("t_s", "xy", "yaw_rad", "sigma_m"):
        assert equal(getattr(here.smooth(), name), getattr(batch["paper"].smoothed, name))


# --- what is refused ---------------------------------------------------------------------------------------------


def test_a_frame_that_is_refused_changes_nothing(
    made: Callable[..., Localizer], flight: Flight, batch: dict[str, Located]
) -> None:
    here = made("paper")
    mask, frame, level = flight.mask(0), flight.frames[0], Attitude()
    bad = mask.copy()
    bad[3, 4] = 7
    t = frame.t_s
    nowhere = Pose(t, np.array([math.nan, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    cases: list[tuple[tuple[Any, ...], type[Exception], str]] = [
        ((math.nan, mask, level, 100.0), InputError, "times must increase"),
        ((t, mask[1:], level, 100.0), InputError, "the camera's frames are"),
        ((t, mask[None], level, 100.0), InputError, "the camera's frames are"),
        ((t, bad, level, 100.0), InputError, r"pixel \(row 3, column 4\) is 7"),
        ((t, mask.astype(np.int32), level, 100.0), InputError, "int32 values"),
        ((t, mask.astype(np.float32), level, 100.0), InputError, r"probability in \[0, 1\]"),
        ((t, mask, Attitude(math.nan), 100.0), InputError, "must be numbers"),
        ((t, mask, level, 100.0, nowhere), InputError, "hand in None"),
        ((t, mask, level, 0.0), InputError, "above 0"),
        ((t, np.repeat(mask[:, :, None], 3, axis=2), level, 100.0), SettingsError, "no network"),
    ]
    for words, kind, told in cases:
        with pytest.raises(kind, match=told):
            here.step(*words)
    live = feed(here, flight, 0, 2)
    with pytest.raises(InputError, match="times must increase"):
        feed(here, flight, 1, 2)
    live += feed(here, flight, 2)
    assert all(same(a, b) for a, b in zip(live, batch["paper"].estimates, strict=True))


@pytest.mark.parametrize(
    "words",
    [{"method": "guess"}, {"answer": "no"}, {"roof_m": -1.0}, {"reset_speed_m_s": 0.0}, {"roof_m": math.nan}],
)
def test_values_out_of_range_are_refused(made: Callable[..., Localizer], words: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        made(**words)


def test_a_jump_of_the_odometry_is_no_motion(made: Callable[..., Localizer], flight: Flight) -> None:
    def step_after(speed_m_s: float, **more: Any) -> Any:
        here = made("paper", **more)
        for t in (0.0, 1.0):
            pose = Pose(t, np.array([speed_m_s * t, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
            here.step(t, flight.mask(0), Attitude(), 150.0, pose)
        assert here.last is not None
        return here.last.motion.step_m

    assert step_after(50.0) is not None
    assert step_after(90.0) is None
    fast = MatchSettings(odometry=OdometrySettings(max_speed_m_s=100.0))
    assert usual_reset_speed_m_s(fast) == 100.0
    assert step_after(90.0, settings=fast) is not None
    assert step_after(900.0, reset_speed_m_s=math.inf) is not None


# --- saved and loaded --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("history", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_after_loading_all_goes_on_as_if_nothing_had_been(
    made: Callable[..., Localizer],
    built: Maps,
    flight: Flight,
    batch: dict[str, Located],
    tmp_path: Path,
    method: str,
    history: bool,
) -> None:
    path, wanted = tmp_path / "state.brm", batch[method].estimates
    here = made(method, history=history)
    for at in (0, 1, 5):
        done = {0: 0, 1: 0, 5: 1}[at]
        feed(here, flight, done, at)
        here.save(str(path))
        here = Localizer.load(str(path), built)
    rest = feed(here, flight, 5)
    assert all(same(a, b) for a, b in zip(rest, wanted[5:], strict=True))
    assert [p.name for p in tmp_path.iterdir()] == ["state.brm"]
    if history:
        assert equal(here.smooth().xy, batch[method].smoothed.xy)
    # Only arrays and text: nothing in it can be run.
    with np.load(path, allow_pickle=False) as stored:
        assert all(stored[name].dtype != object for name in stored.files)
        assert json.loads(stored["header"].tobytes())["ways"]["method"] == method


@pytest.fixture
def saved(made: Callable[..., Localizer], flight: Flight, tmp_path: Path) -> Path:
    here = made("paper")
    feed(here, flight, 0, 3)
    here.save(tmp_path / "state.brm")
    return tmp_path / "state.brm"


def refused(path: Path, maps: Maps, masks: Segmenter | None = None) -> str:
    with pytest.raises(InputError) as told:
        Localizer.load(path, maps, masks=masks)
    text = str(told.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text


def test_a_file_that_is_not_whole_is_refused_in_one_line(
    saved: Path, built: Maps, flight: Flight, batch: dict[str, Located]
) -> None:
    with pytest.raises(MissingInputError, match="no such saved state"):
        Localizer.load(saved.with_name("none"), built)
    whole = saved.read_bytes()
    rng = np.random.default_rng(5)
    for size in [0, 1, 100, len(whole) // 2, len(whole) - 1]:
        saved.write_bytes(whole[:size])
        assert "start anew" in refused(saved, built)
    taken = 0
    for at in rng.integers(0, len(whole), 60).tolist():
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        saved.write_bytes(damaged)
        try:
            here = Localizer.load(saved, built)
        except InputError:
            refused(saved, built)
            continue
        # What no checksum covers, such as the time of a part, says nothing of the state.
        taken += 1
        assert same(feed(here, flight, 3, 4)[0], batch["paper"].estimates[3])
    assert taken < 20
    saved.write_bytes(b"t_s,file\n")
    assert "no saved state" in refused(saved, built)


def test_a_packed_part_is_not_unpacked(saved: Path, built: Maps) -> None:
    with zipfile.ZipFile(saved) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in parts.items():
            new.writestr(name, data)
    assert "no saved state" in refused(saved, built)


def test_a_file_of_other_maps_is_refused(saved: Path, built: Maps) -> None:
    ground = built.ground
    other = ground.building.copy()
    other[0, 0] ^= 1
    for name, maps in {
        "content": replace(built, ground=replace(ground, building=other)),
        "left": replace(built, ground=replace(ground, left=ground.left + 0.5)),
        "shape": replace(built, ground=replace(ground, building=ground.building[:-1])),
        "crs": replace(built, crs="EPSG:5186"),
    }.items():
        assert f"saved with maps of another {name}" in refused(saved, maps)


def test_a_file_of_another_network_is_refused(
    built: Maps, pictured: Path, weights: Path, saved: Path, tmp_path: Path
) -> None:
    network, flight = Segmenter.load(weights), read_flight(pictured)
    assert "saved with network of another weights" in refused(saved, built, network)
    here = Localizer(built, flight.camera, flight.mount, masks=network, method="paper")
    here.save(tmp_path / "b.brm")
    Localizer.load(tmp_path / "b.brm", built, masks=network)
    assert "another weights" in refused(tmp_path / "b.brm", built)
    assert "another looks" in refused(tmp_path / "b.brm", built, replace(network, looks=2))


def test_a_file_of_another_version_is_refused(saved: Path, built: Maps) -> None:
    def change(edit: Callable[[dict[str, Any]], object]) -> str:
        header, arrays = read_saved(saved, 2)
        before = saved.read_bytes()
        edit(header)
        write_saved(saved, header, arrays)
        told = refused(saved, built)
        saved.write_bytes(before)
        return told

    assert "format 1" in change(lambda h: h.update(format=1))
    assert "another version" in change(lambda h: h.pop("maps"))
    assert "another version" in change(lambda h: h["ways"].update(luck=1))
    assert "another version" in change(lambda h: h["ways"]["settings"]["paper"].pop("radii"))
    assert "another version" in change(lambda h: h["ways"]["settings"]["paper"].update(radii=-1))
    assert "another version" in change(lambda h: h.update(camera=None))
    change(lambda h: h["ways"]["settings"]["paper"].update(e1=0.4))


def test_settings_come_back_as_they_were() -> None:
    from dataclasses import asdict

    own = MatchSettings(odometry=OdometrySettings(max_speed_m_s=8.1))
    assert settings_of(json.loads(json.dumps(asdict(own)))) == own
