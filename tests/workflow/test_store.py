"""The store: keys, finished and unfinished work, crashes, full disks, locks, publishing."""

from __future__ import annotations

import contextlib
import enum
import fcntl
import hashlib
import json
import math
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import workflow_toys as toys
from hypothesis import given
from hypothesis import strategies as st

from brmgeo import files
from brmgeo.errors import InputError, MissingInputError, WorkflowError
from brmgeo.workflow.publish import publish
from brmgeo.workflow.schedule import serial_map
from brmgeo.workflow.stage import Json, Map, Stage, canonical, key_of, plain, unstated
from brmgeo.workflow.store import RECORD, Artifact, Store

HERE = Path(__file__).parent

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8)
)
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
settings_of_stages = st.dictionaries(st.text(max_size=5), trees, max_size=5)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def words(store: Store, source: Path, times: int = 1) -> Artifact:
    return store.build(store.step(toys.WORDS, {"text": source}, toys.Words(times)), serial_map)


def one_line(error: pytest.ExceptionInfo[Exception]) -> str:
    text = str(error.value)
    assert text
    assert "\n" not in text
    return text


# -- keys


@given(settings_of_stages)
def test_key_does_not_depend_on_the_order_of_settings(settings: dict[str, object]) -> None:
    def turned(value: object) -> object:
        if isinstance(value, dict):
            return {name: turned(item) for name, item in reversed(value.items())}
        return [turned(item) for item in value] if isinstance(value, list) else value

    again = {name: turned(item) for name, item in reversed(settings.items())}
    assert key_of(toys.WORDS, plain(settings), {}) == key_of(toys.WORDS, plain(again), {})


@given(settings_of_stages, settings_of_stages)
def test_key_differs_exactly_when_a_setting_does(a: dict[str, object], b: dict[str, object]) -> None:
    def typed(value: object) -> object:
        """Equality that keeps 1, 1.0 and True apart, and -0.0 and 0.0 together."""
        if isinstance(value, dict):
            return {name: typed(item) for name, item in value.items()}
        if isinstance(value, list):
            return [typed(item) for item in value]
        return (type(value).__name__, value)

    same = key_of(toys.WORDS, plain(a), {}) == key_of(toys.WORDS, plain(b), {})
    assert same == (typed(a) == typed(b))


@given(settings_of_stages, st.text(min_size=1, max_size=5), scalars, scalars)
def test_key_differs_with_any_one_setting(
    settings: dict[str, object], name: str, old: object, new: object
) -> None:
    keys = {
        key_of(toys.WORDS, plain(settings | {name: value}), {})
        for value in (old, new, {"in": old}, [old, new])
    }
    expected = 3 if (type(old), old) == (type(new), new) else 4
    assert len(keys) == expected


def test_key_differs_with_stage_version_and_inputs() -> None:
    base = Stage("a", 1, toys.run_words)
    keys = [
        key_of(base, {}, {}),
        key_of(Stage("b", 1, toys.run_words), {}, {}),
        key_of(Stage("a", 2, toys.run_words), {}, {}),
        key_of(base, {}, {"x": "1"}),
        key_of(base, {}, {"y": "1"}),
        key_of(base, {}, {"x": "2"}),
        key_of(base, {"x": "1"}, {}),
    ]
    assert len(set(keys)) == len(keys)
    # ... and not with the code: another function under the same name and version is the same stage.
    assert key_of(Stage("a", 1, toys.run_noise), {}, {}) == keys[0]


def test_key_is_stable_between_releases() -> None:
    # Another text here would throw away every user's store.
    text = '{"inputs":{"text":"ab"},"settings":{"crs":null,"name":"평창","radii_m":[78.8,39.4]},"stage":"words","version":1}'
    settings = plain({"radii_m": [78.8, 39.4], "name": "평창", "crs": None})
    assert key_of(toys.WORDS, settings, {"text": "ab"}) == hashlib.sha256(text.encode()).hexdigest()


def test_plain_takes_numpy_enums_and_tuples() -> None:
    class Method(enum.Enum):
        MASK = "mask"

    given_values = {
        "r": np.float64(1.5),
        "n": np.int32(3),
        "a": np.arange(2),
        "t": (1, 2.0),
        "m": Method.MASK,
    }
    assert canonical(plain(given_values)) == '{"a":[0,1],"m":"mask","n":3,"r":1.5,"t":[1,2.0]}'
    assert canonical(plain({"zero": -0.0, "set": {3, 1}})) == '{"set":[1,3],"zero":0.0}'


@pytest.mark.parametrize("value", [math.nan, math.inf, Path("a"), {1: 2}, object(), b"x"])
def test_plain_refuses_what_has_no_text(value: object) -> None:
    with pytest.raises(TypeError, match=r"^settings\.deep\[0\]"):
        plain({"deep": [value]})


def test_stage_name_names_a_folder() -> None:
    with pytest.raises(ValueError, match="names a folder"):
        Stage("a/b", 1, toys.run_words)


# -- sources


def test_source_counts_by_content_not_by_place_or_time(store: Store, source: Path, tmp_path: Path) -> None:
    key = store.step(toys.WORDS, {"text": source}, toys.Words()).key
    copy = tmp_path / "elsewhere" / "other-name.txt"
    copy.parent.mkdir()
    shutil.copyfile(source, copy)
    assert store.step(toys.WORDS, {"text": copy}, toys.Words()).key == key
    copy.write_text("another text")
    assert store.step(toys.WORDS, {"text": copy}, toys.Words()).key != key


def test_same_size_and_time_do_not_hide_a_change(store: Store, source: Path) -> None:
    before = store.step(toys.WORDS, {"text": source}, toys.Words()).key
    source.write_text(source.read_text().swapcase())
    os.utime(source, (1e9, 1e9))
    assert Store(store.root).step(toys.WORDS, {"text": source}, toys.Words()).key != before


def test_folder_counts_by_names_and_contents(store: Store, tmp_path: Path) -> None:
    def key() -> str:
        return store.step(toys.WORDS, {"tiles": tmp_path / "tiles"}, toys.Words()).key

    deep = tmp_path / "tiles" / "1" / "2"
    deep.mkdir(parents=True)
    (deep / "a.png").write_text("a")
    (deep / "b.png").write_text("b")
    first = key()
    (tmp_path / "tiles" / ".DS_Store").write_text("junk of a file manager")
    assert key() == first
    (deep / "b.png").rename(deep / "c.png")
    renamed = key()
    (deep / "c.png").write_text("d")
    changed = key()
    (deep / "a.png").write_text("")
    (deep / "c.png").write_text("ad")
    assert len({first, renamed, changed, key()}) == 4


def test_digests_are_kept_between_runs(
    store: Store, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = store.step(toys.WORDS, {"text": source}, toys.Words()).key
    _settle(store, source)
    monkeypatch.setattr("brmgeo.files.digest", lambda path: pytest.fail(f"{path} was read again"))
    assert Store(store.root).step(toys.WORDS, {"text": source}, toys.Words()).key == key


def _settle(store: Store, source: Path) -> None:
    """Waits until the store trusts the time of a file that was just written."""
    deadline = time.monotonic() + 10
    kept = store.root / "digests.json"
    while not kept.exists() or str(source) not in json.loads(kept.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.2)
        Store(store.root).step(toys.WORDS, {"text": source}, toys.Words())


def test_damaged_digests_are_only_forgotten(store: Store, source: Path) -> None:
    key = store.step(toys.WORDS, {"text": source}, toys.Words()).key
    (store.root / "digests.json").write_text('{"half a fi')
    assert Store(store.root).step(toys.WORDS, {"text": source}, toys.Words()).key == key


def test_missing_source_is_named(store: Store, tmp_path: Path) -> None:
    with pytest.raises(MissingInputError) as error:
        store.step(toys.WORDS, {"text": tmp_path / "no.txt"}, toys.Words())
    assert "input text of stage words" in one_line(error)
    assert str(tmp_path / "no.txt") in one_line(error)


def test_source_that_changes_during_a_stage_is_refused(store: Store, source: Path) -> None:
    def run(inputs: object, out: Path, settings: object, map: object) -> dict[str, int]:
        source.write_text("changed meanwhile")
        (out / "a.txt").write_text("a")
        return {}

    step = store.step(Stage("meddling", 1, run), {"text": source}, toys.Nothing())
    with pytest.raises(WorkflowError, match="changed while it was in use") as error:
        store.build(step, serial_map)
    assert str(source) in one_line(error)
    assert store.find(step) is None


# -- building


def test_second_build_runs_nothing(store: Store, source: Path) -> None:
    first = words(store, source)
    again = words(Store(store.root), source)
    assert toys.CALLS == ["words"]
    assert first.fresh
    assert not again.fresh
    assert (again.path, again.key, again.facts) == (first.path, first.key, first.facts)
    assert again.facts == {"words": 5}
    assert first.path == store.root / "artifacts" / "words" / first.key
    assert not list((store.root / "tmp").iterdir())


def test_record_tells_where_the_outputs_come_from(store: Store, source: Path) -> None:
    first = words(store, source, times=2)
    step = store.step(toys.SQUARES, {"words": first}, toys.Nothing())
    second = store.build(step, serial_map)
    record = json.loads((second.path / RECORD).read_text())
    assert record == second.record
    assert record["inputs"]["words"] == {"stage": "words", "label": "words", "key": first.key}
    assert set(record["outputs"]) == {"squares.txt"}
    assert record["outputs"]["squares.txt"]["size"] == (second.path / "squares.txt").stat().st_size
    assert first.record["settings"] == {"times": 2}
    assert first.record["inputs"]["text"]["path"] == str(source)
    assert {"start", "end", "host", "libraries", "facts", "version", "seconds"} <= record.keys()
    assert "numpy" in record["libraries"]


def test_inputs_are_built_on_demand(store: Store, source: Path) -> None:
    first = store.step(toys.WORDS, {"text": source}, toys.Words())
    second = store.step(toys.SQUARES, {"words": first}, toys.Nothing())
    assert not toys.CALLS
    store.build(second, serial_map)
    assert toys.CALLS == ["words", "squares"]
    assert store.find(first) is not None


def test_a_stage_gets_the_value_that_was_keyed(store: Store) -> None:
    @dataclass(frozen=True)
    class Own:
        radii_m: tuple[float, ...]
        style: int | None = unstated(None)

    given = []

    def run(inputs: object, out: Path, settings: Own, map: object) -> dict[str, Json]:
        given.append(settings)
        return {"radii_m": settings.radii_m}

    own = Own((40.0, 17.3))
    made = store.build(store.step(Stage("typed", 1, run), {}, own), serial_map)
    assert given == [own]
    assert made.facts == made.record["settings"] == {"radii_m": [40.0, 17.3]}


def test_settings_that_can_change_are_a_defect(store: Store) -> None:
    @dataclass
    class Loose:
        times: int = 1

    for settings in ({"times": 1}, Loose(), toys.Words):
        with pytest.raises(TypeError, match=r"settings of stage words: .* is no frozen dataclass"):
            store.step(toys.WORDS, {}, settings)  # type: ignore[arg-type]


def test_a_setting_at_its_default_may_stay_out_of_the_key() -> None:
    @dataclass(frozen=True)
    class Older:
        level: int

    @dataclass(frozen=True)
    class Newer:
        level: int
        pixel_ratio: int = unstated(1)
        style: int | None = unstated(None)
        scale: float = 1.0

    assert canonical(plain(Newer(3))) == '{"level":3,"scale":1.0}'
    assert canonical(plain(Newer(3, 2, 0))) == '{"level":3,"pixel_ratio":2,"scale":1.0,"style":0}'
    assert plain({"own": [Newer(3)]}) == {"own": [{"level": 3, "scale": 1.0}]}
    assert plain(Older(3)) == {"level": 3}


def test_failing_stage_leaves_nothing(store: Store) -> None:
    step = store.step(toys.REFUSE, {}, toys.Nothing())
    with pytest.raises(InputError, match="cut off at line 3"):
        store.build(step, serial_map)
    assert not step.path.exists()
    assert not list((store.root / "tmp").iterdir())


def test_facts_that_are_no_json_are_a_defect(store: Store) -> None:
    step = store.step(Stage("odd", 1, lambda i, o, s, m: {"rmse": math.nan}), {}, toys.Nothing())
    with pytest.raises(TypeError, match=r"facts\.rmse"):
        store.build(step, serial_map)
    assert store.find(step) is None


def test_record_name_belongs_to_the_store(store: Store) -> None:
    def run(inputs: object, out: Path, settings: object, map: object) -> dict[str, int]:
        (out / RECORD).write_text("{}")
        return {}

    with pytest.raises(ValueError, match="belongs to the store"):
        store.build(store.step(Stage("odd", 1, run), {}, toys.Nothing()), serial_map)


@pytest.mark.parametrize("harm", ["truncate", "remove", "record"])
def test_damaged_artifact_is_made_again(store: Store, source: Path, harm: str) -> None:
    made = words(store, source)
    target = made.path / (RECORD if harm == "record" else "words.txt")
    target.unlink() if harm == "remove" else target.write_text("{")
    assert store.damage(made.step)
    assert store.find(made.step) is None
    again = words(store, source)
    assert again.fresh
    assert store.verify(again) == []
    assert (again.path / "words.txt").read_text() == "A BRIDGE OVER THE RIVER\n"


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ('"outputs"', '"outpuus"'),
        ('"words": 5', '"words": 4'),
        ('"words": 5', '"words": NaN'),
        ('"words": 5', '"words": "\\ud800"'),
    ],
)
def test_a_record_that_is_not_as_it_was_written_is_damage(
    store: Store, source: Path, right: str, wrong: str
) -> None:
    made = words(store, source)
    text = (made.path / RECORD).read_text()
    assert right in text
    (made.path / RECORD).write_text(text.replace(right, wrong, 1))
    assert store.damage(made.step) == f"{RECORD} is unreadable"
    assert words(store, source).facts == {"words": 5}


def test_records_of_older_versions_have_no_digest(store: Store, source: Path) -> None:
    made = words(store, source)
    record = json.loads((made.path / RECORD).read_text())
    del record["digest"]
    (made.path / RECORD).write_text(json.dumps(record))
    assert not words(store, source).fresh
    del record["facts"]
    (made.path / RECORD).write_text(json.dumps(record))
    assert words(store, source).fresh


@pytest.mark.parametrize("text", ['{"inputs": {}}', '{"inputs": [], "settings": 1}', "[]"])
def test_a_damaged_note_of_what_was_built_last_is_none(store: Store, source: Path, text: str) -> None:
    made = words(store, source)
    store.remember("here", made.step)
    (note,) = (store.root / "latest").rglob("*.json")
    note.write_text(text)
    assert store.latest("here", made.step.label) is None
    store.remember("here", made.step)
    assert store.latest("here", made.step.label) == made.step.origin


def test_verify_sees_a_flipped_bit_and_a_stray_file(store: Store, source: Path) -> None:
    made = words(store, source)
    assert store.verify(made) == []
    (made.path / "words.txt").write_text("B BRIDGE OVER THE RIVER\n")
    (made.path / "stray.txt").write_text("")
    (made.path / "parts" / "0.txt").unlink()
    wrong = store.verify(made)
    assert len(wrong) == 3
    for name, complaint in [
        ("words.txt", "content differs"),
        ("stray.txt", "not in the record"),
        ("0.txt", "missing"),
    ]:
        assert any(name in line and complaint in line for line in wrong)


def test_removed_artifact_is_made_again(store: Store, source: Path) -> None:
    made = words(store, source)
    shutil.rmtree(made.path)
    assert not made.path.exists()
    assert words(store, source).fresh


# -- crashes


@pytest.mark.parametrize("stride", [67, pytest.param(7, marks=pytest.mark.slow)])
def test_kill_at_any_file_system_call(stride: int, tmp_path: Path) -> None:
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else str(tmp_path)
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        ran = subprocess.run(
            [sys.executable, "-W", "error", str(HERE / "workflow_crashes.py"), folder, str(stride)],
            capture_output=True,
            text=True,
            timeout=600,
        )
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""
    assert int(ran.stdout) >= 600 // stride


def test_litter_of_the_dead_goes_and_work_of_the_living_stays(store: Store) -> None:
    tmp = store.root / "tmp"
    for name in ("dead", "alive", "older"):
        (tmp / name / "out").mkdir(parents=True)
        (tmp / name / "out" / "half.bin").write_text("half")
    (tmp / "dead" / "lock").touch()
    (tmp / "stray.txt").touch()
    held = os.open(tmp / "alive" / "lock", os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        with store.lock("toy"):
            assert [p.name for p in tmp.iterdir()] == ["alive"]
    finally:
        os.close(held)
    assert store.clean() == 1
    assert not list(tmp.iterdir())


# -- the disk


def test_full_disk_is_one_line_and_leaves_nothing(small_disk: Path) -> None:
    store = Store(small_disk / "store")
    step = store.step(toys.FILL, {}, toys.Fill(64))
    with pytest.raises(WorkflowError, match=r"stage fill: .*the disk is full") as error:
        store.build(step, serial_map)
    assert str(small_disk) in one_line(error)
    assert not step.path.exists()
    assert not list((store.root / "tmp").iterdir())
    assert store.build(store.step(toys.FILL, {}, toys.Fill(8)), serial_map).fresh  # it works again


def test_full_disk_as_gdal_and_sqlite_tell_it(small_disk: Path) -> None:
    def run(inputs: object, out: Path, settings: object, map: object) -> dict[str, int]:
        try:
            toys.run_fill({}, out, toys.Fill(64), serial_map)
        except OSError:
            raise RuntimeError("CPLE_AppError: write error") from None
        return {}

    store = Store(small_disk / "store")
    with pytest.raises(WorkflowError, match="the disk is full") as error:
        store.build(store.step(Stage("gdal", 1, run), {}, toys.Nothing()), serial_map)
    one_line(error)


def test_outputs_silently_cut_on_a_full_disk_are_refused(small_disk: Path) -> None:
    def run(inputs: object, out: Path, settings: object, map: object) -> dict[str, int]:
        with contextlib.suppress(OSError):  # GDAL's habit
            toys.run_fill({}, out, toys.Fill(64), serial_map)
        return {}

    store = Store(small_disk / "store")
    with pytest.raises(WorkflowError, match="the disk is full"):
        store.build(store.step(Stage("gdal", 1, run), {}, toys.Nothing()), serial_map)


def test_publishing_to_a_full_disk_keeps_the_old_result(small_disk: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    small = store.build(store.step(toys.FILL, {}, toys.Fill(4)), serial_map)
    large = store.build(store.step(toys.FILL, {}, toys.Fill(64)), serial_map)
    publish(small, small_disk / "out", ["big.bin"], print)
    with pytest.raises(WorkflowError, match="the disk is full") as error:
        publish(large, small_disk / "out", ["big.bin"], print)
    one_line(error)
    assert (small_disk / "out" / "big.bin").read_bytes() == (small.path / "big.bin").read_bytes()
    assert sorted(p.name for p in (small_disk / "out").iterdir()) == [".brmgeo-published.json", "big.bin"]


def test_limit_on_the_size_of_files(store: Store) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    step = store.step(toys.FILL, {}, toys.Fill(64))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, limits[1]))
        with pytest.raises(WorkflowError, match="larger than this system allows") as error:
            store.build(step, serial_map)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    one_line(error)
    assert not step.path.exists()


def test_read_only_store_is_one_line(small_disk: Path, source: Path) -> None:
    store = Store(small_disk / "store")
    made = words(store, source)
    step = store.step(toys.WORDS, {"text": source}, toys.Words(2))
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for attempt in (
        lambda: store.build(step, serial_map),
        lambda: Store(small_disk / "another"),
        lambda: publish(made, small_disk / "out", ["words.txt"], print),
        lambda: store.lock("toy").__enter__(),
    ):
        with pytest.raises(WorkflowError, match="read-only") as error:
            attempt()
        assert str(small_disk) in one_line(error)


def test_store_under_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkflowError, match="a file stands where a folder is wanted") as error:
        Store(tmp_path / "file" / "store")
    assert str(tmp_path / "file") in one_line(error)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_forbidden_store_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(WorkflowError, match="permission is denied") as error:
        Store(tmp_path / "store")
    one_line(error)


# -- two runs at once

HOLDER = """
import sys, time
from brmgeo.workflow.store import Store
with Store(sys.argv[1]).lock("busan"):
    print("held", flush=True)
    time.sleep(60)
"""


def test_second_run_of_a_region_is_told_who_works_on_it(store: Store) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(store.root)], stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(WorkflowError) as error, store.lock("busan"):
            pass
        line = one_line(error)
        assert "region busan" in line
        assert f"process {holder.pid} on " in line
        assert "since 20" in line
        with store.lock("daegu"):  # another region of the same store
            pass
        holder.kill()
        holder.wait()
        with store.lock("busan"):  # no stale lock stays behind a killed run
            pass


def test_a_store_that_another_run_keeps_closed_is_told(
    store: Store, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brmgeo.workflow.store._CLEANING_S", 0.1)
    step = store.step(toys.WORDS, {"text": source}, toys.Words())
    with store._tmp_lock(), pytest.raises(WorkflowError, match=r"another run has held \S+\.tmp for 0\.1 s"):
        store.build(step, serial_map)
    store.build(step, serial_map)


def test_a_run_may_wait_for_the_region(store: Store) -> None:
    code = HOLDER.replace('"busan"', '"toy", wait=True').replace("time.sleep(60)", "")
    with store.lock("toy"):
        waiter = subprocess.Popen(
            [sys.executable, "-c", code, str(store.root)], stdout=subprocess.PIPE, text=True
        )
        with pytest.raises(subprocess.TimeoutExpired):
            waiter.wait(timeout=1.5)
    output, _ = waiter.communicate(timeout=20)
    assert output == "held\n"


def test_two_regions_may_make_the_same_artifact(store: Store, source: Path) -> None:
    """The slower of two runs with the same key keeps the artifact of the faster."""
    step = store.step(toys.WORDS, {"text": source}, toys.Words())

    def run(inputs: Mapping[str, Path], out: Path, settings: toys.Words, map: Map) -> dict[str, Json]:
        if not step.path.exists():
            Store(store.root).build(step, serial_map)
        return toys.run_words(inputs, out, settings, serial_map)

    slower = Stage("words", 1, run)
    made = store.build(store.step(slower, {"text": source}, toys.Words()), serial_map)
    assert made.path == step.path
    assert toys.CALLS == ["words", "words"]
    assert store.verify(made) == []
    assert not list((store.root / "tmp").iterdir())


def test_region_names_cannot_leave_the_store(store: Store, source: Path) -> None:
    made = words(store, source)
    for region in ("../../evil", "평창", "/a/b", ".", "x" * 300):
        with store.lock(region):
            store.remember(region, made.step)
        latest = store.latest(region, "words")
        assert latest is not None
        assert latest["key"] == made.key
    assert sorted(p.name for p in store.root.parent.iterdir()) == ["source.txt", "store"]


# -- publishing


def test_publish_follows_the_store(store: Store, source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = words(store, source, times=2)
    names = {"words.txt": "results/all words.txt", "parts": "parts"}
    assert len(publish(first, out, names, print)) == 1 + 10
    assert publish(first, out, names, print) == []
    second = words(store, source)
    assert publish(second, out, names, print) == [
        "results/all words.txt"
    ]  # the parts that stay have the same bytes
    assert (out / "results" / "all words.txt").read_text() == "A BRIDGE OVER THE RIVER\n"
    assert sorted(p.name for p in (out / "parts").iterdir()) == [f"{i}.txt" for i in range(5)]


def test_publish_puts_back_what_is_gone_and_keeps_what_somebody_changed(
    store: Store, source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    told: list[str] = []
    made = words(store, source)
    publish(made, out, ["words.txt", "parts"], told.append)
    (out / "mine.txt").write_text("a user's own file")
    (out / "parts" / "mine.txt").write_text("a user's own file")
    (out / "words.txt").write_text("edited")
    (out / "parts" / "2.txt").unlink()
    assert told == []
    assert publish(made, out, ["words.txt", "parts"], told.append) == ["parts/2.txt"]
    assert told == [
        f"{out / 'words.txt'}: changed since brmgeo wrote it, and left as it is: remove it to have it anew"
    ]
    newer = words(store, source, times=2)
    assert "words.txt" in publish(newer, out, ["words.txt", "parts"], told.append)
    assert told[1:] == [f"{out / 'words.txt'}: not as brmgeo wrote it, so it is kept as words.edited.txt"]
    assert (out / "words.txt").read_bytes() == (newer.path / "words.txt").read_bytes()
    assert (out / "words.edited.txt").read_text() == "edited"
    assert (out / "mine.txt").exists()
    assert (out / "parts" / "mine.txt").exists()
    assert store.verify(made) == []


def test_publish_sets_aside_what_it_never_wrote(store: Store, source: Path, tmp_path: Path) -> None:
    (tmp_path / "words.txt").write_text("mine")
    told: list[str] = []
    assert publish(words(store, source), tmp_path, ["words.txt"], told.append) == ["words.txt"]
    assert (tmp_path / "words.edited.txt").read_text() == "mine"
    assert len(told) == 1


def test_a_geopackage_that_was_only_opened_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE t (x)")
    before, whole = files.content_digest(path), files.digest(path)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA journal_mode = wal")
        db.execute("PRAGMA journal_mode = delete")
    assert files.digest(path) != whole
    assert files.content_digest(path) == before
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("INSERT INTO t VALUES (1)")
    assert files.content_digest(path) != before


@pytest.mark.parametrize(
    "memory", ["{broken", '{"words.txt": 5, "parts/x": null}', '{"words.txt": {"sha256": 1}, "parts/x": []}']
)
def test_publish_without_its_memory_writes_again(
    memory: str, store: Store, source: Path, tmp_path: Path
) -> None:
    made = words(store, source)
    publish(made, tmp_path / "out", ["words.txt", "parts"], print)
    (tmp_path / "out" / ".brmgeo-published.json").write_text(memory)
    (tmp_path / "out" / "words.txt").write_text("edited")
    assert publish(made, tmp_path / "out", ["words.txt"], print) == ["words.txt"]


def test_publish_of_an_unknown_output_is_a_defect(store: Store, source: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyError, match=r"no output word\.txt"):
        publish(words(store, source), tmp_path, ["word.txt"], print)


def test_publish_under_a_file_is_one_line(store: Store, source: Path, tmp_path: Path) -> None:
    made = words(store, source)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkflowError, match="a file stands where a folder is wanted") as error:
        publish(made, tmp_path / "file", ["words.txt"], print)
    one_line(error)
