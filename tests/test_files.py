"""Whole files and folders, words for what a disk says, digests and locks."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from brmgeo import files
from brmgeo.errors import SettingsError, WorkflowError


def test_a_file_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    files.write_text(path, "old")

    def half() -> None:
        with files.whole_file(path) as scratch:
            scratch.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    files.write_text(path, "new\n")
    assert path.read_bytes() == b"new\n"


def test_a_folder_is_replaced_only_where_all_in_it_is_ours(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def require() -> None:
        files.require_replaceable(out, "sign.txt", "results", lambda p: p.name in ("sign.txt", "more.txt"))

    require()
    out.mkdir()
    require()
    (out / "more.txt").write_text("ours by its name only")
    with pytest.raises(SettingsError, match=r"other files than results \(more.txt\)") as told:
        require()
    assert told.value.needs == "out"
    (out / "sign.txt").write_text("")
    require()
    (out / "thesis.txt").write_text("years of work")
    with pytest.raises(SettingsError, match=r"thesis\.txt"):
        require()
    out = out / "sign.txt"
    with pytest.raises(SettingsError, match=r"sign\.txt"):
        require()


def test_what_killed_runs_left_long_ago_is_cleared_away(tmp_path: Path) -> None:
    deep = tmp_path / "deep"
    deep.mkdir()
    old, young, foreign, below = (
        tmp_path / f"{files.SCRATCH}aa.tif",
        tmp_path / f"{files.SCRATCH}bb.tif.ovr.tmp",
        tmp_path / ".other-part-cc.tif",
        deep / f"{files.SCRATCH}dd",
    )
    for path in (old, young, foreign, below):
        path.touch()
        if path != young:
            os.utime(path, (1e9, 1e9))
    files.clear_scratch(tmp_path)
    assert {*tmp_path.rglob("*")} == {deep, young, foreign, below}
    files.clear_scratch(tmp_path, deep=True)
    assert {*tmp_path.rglob("*")} == {deep, young, foreign}


def test_a_name_for_people_becomes_one_for_files() -> None:
    assert files.plain_name("대전 flight 3/4", "flight") == "대전-flight-3-4"
    assert files.plain_name("../..", "flight") == "flight"


def test_json_is_read_back_and_damage_is_none(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    files.write_json(path, {"가": [1, 2.5, None]}, durable=True)
    assert files.read_json(path) == {"가": [1, 2.5, None]}
    path.write_text("{")
    assert files.read_json(path) is None
    assert files.read_json(tmp_path / "gone.json") is None


def replaced(out: Path) -> AbstractContextManager[Path]:
    """A folder whose files may all go."""
    return files.whole_folder(out, say=print, ours=lambda _: True)


def names_in(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name != files.WRITTEN)


def test_a_folder_comes_whole_or_the_old_one_stays(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with replaced(out) as scratch:
        (scratch / "a").write_text("1")

    def half() -> None:
        with replaced(out) as scratch:
            (scratch / "b").write_text("2")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        half()
    assert names_in(out) == ["a"]
    with replaced(out) as scratch:
        (scratch / "b").write_text("2")
    assert names_in(out) == ["b"]
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def killed_between_renames(out: Path) -> None:
    """What a process leaves that dies when the old folder is aside and the new one not yet in its place."""
    code = f"""
import os, pathlib
from brmgeo import files
rename = os.rename
def die(source, target):
    rename(source, target)
    os._exit(9)
files.os.rename = die
with files.whole_folder(pathlib.Path({str(out)!r}), say=print, ours=lambda _: True) as scratch:
    (scratch / "new").touch()
"""
    run = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=Path(__file__).resolve().parents[1], timeout=60
    )
    assert run.returncode == 9


@pytest.mark.parametrize("asked", [False, True])
def test_a_run_killed_between_the_renames_loses_nothing(tmp_path: Path, asked: bool) -> None:
    out, other = tmp_path / "out", tmp_path / "out-2"
    for folder in (out, other):
        folder.mkdir()
        (folder / "old").write_text(folder.name)
        killed_between_renames(folder)
        assert not folder.exists()
    assert len([p for p in tmp_path.iterdir() if p.name.startswith(f"{files.SCRATCH}out-")]) == 4
    if asked:
        files.require_writable(out)

    def fails() -> None:
        with replaced(out):
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fails()
    assert (out / "old").read_text() == "out"
    # That of a folder with a longer name stays for whoever writes there.
    assert not other.exists()
    with replaced(other) as scratch:
        assert (other / "old").read_text() == "out-2"
        (scratch / "new").touch()
    assert names_in(other) == ["new"]


def test_scratch_folders_of_killed_runs_are_cleared_after_an_hour(tmp_path: Path) -> None:
    names = ("out-0123456789ab", "out-0123456789ac.old", "out-2-0123456789ab", "out-0123456789ad")
    dead, aside, other, alive = [tmp_path / f"{files.SCRATCH}{name}" for name in names]
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").touch()
    for folder in (dead, aside, other, alive):
        (folder / "frames").mkdir(parents=True)
        (folder / "frames" / "1.png").touch()
        for path in (folder / "frames" / "1.png", folder / "frames", folder):
            # A long run writes deep in its folder only.
            if path.suffix != ".png" or folder != alive:
                os.utime(path, (1e9, 1e9))
    with replaced(out) as scratch:
        (scratch / "b").touch()
    assert {*tmp_path.iterdir()} == {out, other, alive}
    assert names_in(out) == ["b"]


def test_several_files_come_together_or_none_does(tmp_path: Path) -> None:
    def write(text: str, *, fails: bool = False) -> None:
        with files.whole_files(tmp_path, ("a", "b"), print) as scratch:
            for name in ("b", "a", "of the work"):
                (scratch / name).write_text(text)
            if fails:
                raise ValueError("on the way")

    def there() -> dict[str, str]:
        return {name: (tmp_path / name).read_text() for name in names_in(tmp_path)}

    (tmp_path / "other").write_text("stays")
    write("one")
    assert there() == {"a": "one", "b": "one", "other": "stays"}
    with pytest.raises(ValueError, match="on the way"):
        write("two", fails=True)
    assert there() == {"a": "one", "b": "one", "other": "stays"}
    left = tmp_path / f"{files.SCRATCH}files"
    left.mkdir()
    (left / "a").write_text("of a killed run")
    write("three")
    assert there() == {"a": "three", "b": "three", "other": "stays"}


FULL = (
    OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    OSError("[Errno 28] Error writing bytes to file. Detail: No space left on device"),
    RuntimeError("sqlite3_step failed: database or disk is full"),
)


@pytest.mark.parametrize("error", FULL, ids=["the system", "an OSError of a library", "a library"])
def test_a_full_disk_is_named_by_the_result_whichever_library_met_it(
    tmp_path: Path, error: Exception
) -> None:
    doors: dict[str, AbstractContextManager[Path]] = {
        "a.txt": files.whole_file(tmp_path / "a.txt"),
        "out": files.whole_folder(tmp_path / "out"),
        "": files.whole_files(tmp_path, ["b.txt"], print),
    }
    for name, door in doors.items():
        with pytest.raises(OSError) as told, door:
            raise error
        assert (told.value.errno, told.value.filename) == (errno.ENOSPC, str(tmp_path / name))
    inner = tmp_path / "inner" / "c.txt"
    inner.parent.mkdir()
    with pytest.raises(OSError) as told, files.whole_folder(tmp_path / "out"), files.whole_file(inner):
        raise error
    assert told.value.filename == str(inner), "the nearest place is told"
    with pytest.raises(OSError) as told, files.whole_folder(tmp_path / "out") as work:
        _fill(work / "d.txt", error)
    assert told.value.filename == str(tmp_path / "out"), "scratch has no name that people know"
    assert names_in(tmp_path) == ["inner"]


def _fill(path: Path, error: Exception) -> None:
    with files.whole_file(path):
        raise error


def test_a_full_temporary_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(OSError) as told, files.scratch_folder("work"):
        raise FULL[0]
    assert str(told.value.filename).startswith(str(tmp_path / "brmgeo-work-"))


def test_a_defect_is_no_disk(tmp_path: Path) -> None:
    for error in (KeyError("a"), FileNotFoundError(errno.ENOENT, "x", "b"), WorkflowError("disk is full")):
        with pytest.raises(type(error)) as told, files.whole_file(tmp_path / "a"):
            raise error
        assert told.value is error


def test_a_cell_is_no_formula_and_reads_back() -> None:
    for text in ("=1+1", "+a", "-2+3", "@SUM(1)", "\tx", "\rx", "'=1", "''@"):
        assert files.plain_cell(text) == f"'{text}"
    for text in ("", "a=1.jpg", "frame_00001.jpg", "'quoted'", "3-4"):
        assert files.plain_cell(text) == text


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX's")
def test_folders_have_the_mode_that_the_umask_asks_for(tmp_path: Path) -> None:
    # In a process of its own: the umask belongs to the whole process.
    code = f"""
import os, pathlib
from brmgeo import files
from brmgeo.errors import SettingsError, WorkflowError
os.umask(0o077)
with files.whole_folder(pathlib.Path({str(tmp_path / "out")!r})) as scratch:
    files.write_text(scratch / "a", "x")
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[1])
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "out" / "a").stat().st_mode) == 0o600


def test_words_of_the_disk() -> None:
    assert "disk is full" in str(files.reason(OSError(errno.ENOSPC, "x")))
    assert files.reason(OSError(errno.ECHILD, "x")) is None
    assert "disk is full" in files.told(OSError(errno.ENOSPC, "x"))
    assert files.told(OSError(errno.ECHILD, "No child processes")) == "No child processes"
    assert files.told(OSError("the library's own words")) == "the library's own words"


def test_digest_and_copy(tmp_path: Path) -> None:
    source = tmp_path / "a"
    source.write_bytes(b"abc" * 100_000)
    files.copy(source, tmp_path / "b")
    wanted = hashlib.sha256(b"abc" * 100_000).hexdigest()
    assert files.digest(tmp_path / "b") == files.digest_of(b"abc" * 100_000) == wanted
    files.write_text(source, "other")
    files.copy(source, tmp_path / "b")
    assert (tmp_path / "b").read_text() == "other"
    with pytest.raises(FileNotFoundError):
        files.copy(tmp_path / "no", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "other"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_a_lock_is_held_against_another_process(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    held = files.open_lock(path)
    assert files.take_lock(held, wait=False)
    code = f"""
import pathlib
from brmgeo import files
from brmgeo.errors import SettingsError, WorkflowError
d = files.open_lock(pathlib.Path({str(path)!r}))
print(files.take_lock(d, wait=False))
"""
    run = [sys.executable, "-c", code]
    root = Path(__file__).resolve().parents[1]
    assert subprocess.run(run, capture_output=True, text=True, cwd=root).stdout.strip() == "False"
    os.close(held)
    assert subprocess.run(run, capture_output=True, text=True, cwd=root).stdout.strip() == "True"


KILLED_WITH_SCRATCH = """
import sys, time
from brmgeo import files
with files.scratch_folder("test") as folder:
    (folder / "big").write_text("x")
    print(folder, flush=True)
    time.sleep(60)
"""


def test_scratch_of_killed_runs_goes_with_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED_WITH_SCRATCH],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).resolve().parents[1],
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert run.stdout is not None
    theirs = Path(run.stdout.readline().strip())
    mine = tmp_path / "brmgeo-results"
    mine.mkdir()  # not every folder of that name is scratch
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".brmgeo-scratch").touch()
    (tmp_path / "brmgeo-link").symlink_to(elsewhere)
    with files.scratch_folder("test") as own:
        assert stat.S_IMODE(own.stat().st_mode) == 0o700
        assert theirs.is_dir(), "its owner lives"
        run.kill()
        run.communicate()
        with files.scratch_folder("test"):
            assert not theirs.exists()
        assert own.is_dir()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["brmgeo-link", "brmgeo-results", "elsewhere"]
    assert (elsewhere / ".brmgeo-scratch").exists()


def test_scratch_that_workers_still_wrote_into_goes_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / "brmgeo-dask-abc"
    sweep = shutil.rmtree

    def written_meanwhile(path: Path, **options: bool) -> None:
        sweep(path, **options)  # type: ignore[call-overload]
        if path.parent == left and not (left / "late").exists():
            (left / "late").touch()

    (left / "worker").mkdir(parents=True)
    (left / ".brmgeo-scratch").touch()
    monkeypatch.setattr(shutil, "rmtree", written_meanwhile)
    with files.scratch_folder("test"):
        assert sorted(p.name for p in left.iterdir()) == [".brmgeo-scratch", "late"], (
            "its lock stays, to be found"
        )
    assert list(tmp_path.iterdir()) == []


def test_files_below_a_folder_are_named_from_it(tmp_path: Path) -> None:
    for name in ("b.txt", "a/c.txt", "a/.d/e.txt", ".f.txt"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert sorted(files.files_below(tmp_path)) == [".f.txt", "a/.d/e.txt", "a/c.txt", "b.txt"]
    assert sorted(files.files_below(tmp_path, hidden=False)) == ["a/c.txt", "b.txt"]
    assert files.folders_below(tmp_path) == [tmp_path / "a" / ".d", tmp_path / "a"]
    for path in (tmp_path, tmp_path / "b.txt"):
        files.sync(path)
    with pytest.raises(FileNotFoundError):
        files.sync(tmp_path / "no.txt")


def test_a_place_that_cannot_be_written_is_told_before_any_work(tmp_path: Path) -> None:
    files.require_writable(tmp_path / "new" / "folder")
    assert not list((tmp_path / "new" / "folder").iterdir())
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(WorkflowError, match="a file stands where a folder is wanted"):
            files.require_writable(place)


@pytest.mark.parametrize("opening", ["[", '{"a":'])
def test_json_that_is_nested_without_end_is_no_json(tmp_path: Path, opening: str) -> None:
    for depth in (40, 100_000):
        (tmp_path / "deep.json").write_text(opening * depth)
        assert files.read_json(tmp_path / "deep.json") is None
        with pytest.raises(ValueError, match=r"nested|Expecting"):
            files.json_of(opening * depth)
    whole = "[" * 40 + "]" * 40
    with pytest.raises(ValueError, match="nested more than 32 deep"):
        files.json_of(whole)


def test_json_may_begin_with_a_byte_order_mark() -> None:
    assert files.json_of("\ufeff[1, {}]".encode()) == [1, {}]
    with pytest.raises(ValueError, match="digits"):
        files.json_of("9" * 5000)


def _results(out: Path, text: str, say: files.Say) -> None:
    with files.whole_folder(out, say=say, ours=lambda p: p.name in ("a.csv", "map.qgz")) as work:
        (work / "a.csv").write_text(text)
        (work / "map.qgz").write_text(text)


def test_a_folder_that_is_replaced_keeps_what_is_not_ours(tmp_path: Path) -> None:
    out, told = tmp_path / "out", list[str]()
    _results(out, "first", told.append)
    (out / "map.qgz").write_text("edited")
    (out / "my own.qgz").write_text("mine")
    (out / "notes").mkdir()
    (out / "notes" / "a.txt").write_text("mine too")
    (out / "link").symlink_to("notes")
    (out / "empty").mkdir()
    _results(out, "second", told.append)
    assert told == [f"{out / 'map.qgz'}: not as brmgeo wrote it, so it is kept as map.edited.qgz"]
    assert (out / "a.csv").read_text() == (out / "map.qgz").read_text() == "second"
    assert (out / "map.edited.qgz").read_text() == "edited"
    assert (out / "my own.qgz").read_text() == "mine"
    assert (out / "notes" / "a.txt").read_text() == "mine too"
    assert os.readlink(out / "link") == "notes"
    assert (out / "empty").is_dir()
    (out / "map.qgz").write_text("edited again")
    _results(out, "third", told.append)
    assert (out / "map.edited.qgz").read_text() == "edited"
    assert (out / "map.edited-2.qgz").read_text() == "edited again"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_file_that_only_sounds_like_one_of_sqlite_is_the_user_s(tmp_path: Path) -> None:
    out, told = tmp_path / "out", list[str]()
    _results(out, "first", told.append)
    (out / "notes-wal").write_text("mine")
    (out / "empty-shm").touch()
    (out / "a.csv-wal").touch()  # beside a file of ours, without a word in it
    _results(out, "second", told.append)
    assert names_in(out) == ["a.csv", "empty-shm", "map.qgz", "notes-wal"]
    assert (out / "notes-wal").read_text() == "mine"


def test_a_link_to_a_folder_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to("real")
    told = list[str]()
    for text in ("first", "second"):
        _results(tmp_path / "out", text, told.append)
    assert os.readlink(tmp_path / "out") == "real"
    assert (tmp_path / "real" / "a.csv").read_text() == "second"
    assert names_in(tmp_path) == ["out", "real"]
    with pytest.raises(SettingsError, match="made by another run"), files.whole_folder(tmp_path / "out"):
        pass
    (tmp_path / "new").mkdir()
    (tmp_path / "link").symlink_to("new")
    with files.whole_folder(tmp_path / "link") as work:
        (work / "a").touch()
    assert names_in(tmp_path / "new") == ["a"]


def test_a_folder_of_before_there_were_lists_is_ours_by_names(tmp_path: Path) -> None:
    out, told = tmp_path / "out", list[str]()
    out.mkdir()
    for name in ("a.csv", "b.csv"):
        (out / name).write_text("old")
    _results(out, "new", told.append)
    assert (out / "a.csv").read_text() == "new"
    assert (out / "b.csv").read_text() == "old"
    assert told == []


def test_a_folder_that_must_be_new_is_never_taken_from_another_run(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def twice() -> None:
        with files.whole_folder(out) as work:
            (work / "a").touch()
            with files.whole_folder(out) as other:
                (other / "b").touch()

    with pytest.raises(SettingsError, match="made by another run"):
        twice()
    assert names_in(out) == ["b"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_files_that_are_replaced_are_set_aside_where_they_are_not_ours(tmp_path: Path) -> None:
    told = list[str]()
    for text in ("first", "second"):
        with files.whole_files(tmp_path, ["a.txt"], told.append) as work:
            (work / "a.txt").write_text(text)
    assert told == []
    (tmp_path / "a.txt").write_text("edited")
    with files.whole_files(tmp_path, ["a.txt"], told.append) as work:
        (work / "a.txt").write_text("third")
    assert (tmp_path / "a.txt").read_text() == "third"
    assert (tmp_path / "a.edited.txt").read_text() == "edited"
    assert len(told) == 1
    # What is already there, by a run that was killed before it was listed, is nothing that could be lost.
    (tmp_path / "b.txt").write_text("same")
    files.write_listed(tmp_path / "b.txt", b"same", told.append)
    files.write_listed(tmp_path / "b.txt", b"newer", told.append)
    assert len(told) == 1


def test_a_write_that_the_disk_does_not_take_is_told_with_its_file(small_disk: Path) -> None:
    with pytest.raises(OSError) as told:
        files.write_bytes(small_disk / "a.png", bytes(2 << 20))
    assert told.value.filename == str(small_disk / "a.png")
    assert list(small_disk.iterdir()) == []
