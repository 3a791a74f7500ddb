"""Files and folders that appear whole or not at all, JSON, what a disk says in words, digests, locks, where caches go."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import json
import os
import re
import shutil
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from brmgeo.errors import BrmgeoError, SettingsError, WorkflowError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

#: Names of scratch files and folders begin with this, beside what they become.
SCRATCH = ".brmgeo-part-"
#: The list of what was written into a folder, with digests.
WRITTEN = ".brmgeo-written.json"
_BESIDE_SQLITE = ("-wal", "-shm")
Say = Callable[[str], object]
# And those of folders that stand aside while another takes their place end with this.
_OLD = ".old"
_LEAST_FREE = 4096
# What a disk does to what is being written.
_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)

_REASONS = {
    errno.ENOSPC: "the disk is full: free some space or choose another place",
    errno.EDQUOT: "the disk quota is used up: free some space or choose another place",
    errno.EFBIG: "the file is larger than this system allows: raise the limit (ulimit -f)",
    errno.EROFS: "the file system is read-only: choose another place",
    errno.EACCES: "permission is denied: change the owner or mode, or choose another place",
    errno.EPERM: "the operation is not permitted: change the owner or mode, or choose another place",
    errno.EEXIST: "a file stands where a folder is wanted: move it away or choose another place",
    errno.ENOTDIR: "a file stands where a folder is wanted: move it away or choose another place",
    errno.EISDIR: "a folder stands where a file is wanted: move it away or choose another place",
    errno.ENOENT: "it is not there: check the name",
    errno.EIO: "the disk reports an input/output error: check the disk",
    errno.EMFILE: "too many files are open: raise the limit (ulimit -n)",
    errno.ENAMETOOLONG: "the name is too long for this file system: choose a shorter place",
}


def reason(error: OSError) -> str | None:
    """What is wrong and what to do, in words; None for an error that no user's disk or rights explain."""
    return _REASONS.get(error.errno or 0)


def told(error: OSError) -> str:
    """What is wrong, for a person: the ``reason`` where there is one, else what the system or the library says."""
    return reason(error) or error.strerror or str(error)


def reason_of(number: int) -> str:
    """The words of an errno that ``reason`` knows."""
    return _REASONS[number]


def is_full(place: Path, error: Exception | None = None) -> bool:
    """True where the disk of ``place`` has no room for another block, or ``error`` says so; False where it does not say.

    GDAL, SQLite and the like have exceptions of their own for a full disk.
    """
    if error is not None and ("No space left" in str(error) or "disk is full" in str(error)):
        return True
    try:
        return shutil.disk_usage(place).free < _LEAST_FREE
    except OSError:
        return False


@contextlib.contextmanager
def _placed(place: Path, scratch: Path) -> Iterator[None]:
    """Makes what a disk does to ``scratch`` an OSError that names ``place``, whichever library met it; others pass."""
    try:
        yield
    except BrmgeoError:
        raise
    except Exception as error:
        system = error if isinstance(error, OSError) else OSError()
        named = system.filename2 or system.filename or scratch
        if system.errno is None and is_full(place.parent, error):
            system = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if system.errno in _WRITING and os.fsdecode(named).startswith(str(scratch)):
            raise OSError(system.errno, system.strerror, str(place)) from error
        raise


# --- whole or not at all -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def whole_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A scratch path beside ``path`` (same suffix) that takes its place when the block ends without an error.

    The scratch file is removed after an error, so ``path`` holds the whole new file, or what it held before. ``durable``
    waits until the disk has its bytes, or a power cut may leave an empty file under the name.
    """
    scratch = path.with_name(f"{SCRATCH}{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        with _placed(path, scratch):
            yield scratch
            if durable:
                sync(scratch)
            os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def clear_scratch(folder: Path, *, older_than_s: float = 3600.0, deep: bool = False) -> None:
    """Removes scratch files that killed runs left in a folder (``deep``: and below it): those untouched for so long."""
    before = time.time() - older_than_s
    name = f"{SCRATCH}*"
    for path in folder.rglob(name) if deep else folder.glob(name):
        with contextlib.suppress(OSError):  # another process may clear it away just now
            if path.is_file() and path.stat().st_mtime < before:
                path.unlink()


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Writes a file whole; ``durable`` waits until the disk has it."""
    with whole_file(path, durable=durable) as scratch:
        scratch.write_bytes(data)


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Writes a file of UTF-8 text whole, line ends as they are; names that are no UTF-8 keep their bytes."""
    write_bytes(path, text.encode("utf-8", errors="surrogateescape"), durable=durable)


def write_json(path: Path, value: Any, *, durable: bool = False) -> None:
    """Writes a file of JSON whole, for people to read too."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n", durable=durable)


def read_json(path: Path) -> Any | None:
    """The JSON in a file, or None when it is absent or damaged."""
    try:
        return json_of(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


#: Tables and lists are nested this deep at most.
DEEPEST = 32


def json_of(text: str | bytes) -> Any:
    """The value of JSON text (bytes: UTF-8, a byte order mark allowed, names that are no UTF-8 keep their bytes).

    Raises ValueError for all that cannot be read, nesting beyond ``DEEPEST`` too: what is nested 100 000 deep can be
    neither parsed nor written again.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8-sig", errors="surrogateescape")
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError(f"lists are nested more than {DEEPEST} deep") from None
    if is_deep(value):
        raise ValueError(f"lists are nested more than {DEEPEST} deep")
    return value


def is_deep(value: Any) -> bool:
    """True where dicts and lists are nested more than ``DEEPEST`` deep."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [
            v
            for group in level
            if isinstance(group, dict | list)
            for v in (group.values() if isinstance(group, dict) else group)
            if isinstance(v, dict | list)
        ]
        if not level:
            return False
    return True


@contextlib.contextmanager
def whole_files(folder: Path, names: Sequence[str], say: Say) -> Iterator[Path]:
    """An empty scratch folder in ``folder`` whose files of these names move there, in this order, when the block ends.

    After an error ``folder`` stays as it was. What a killed process left of its scratch folder goes first, so one process
    at a time may write there. Another file of such a name that is not ours, or was changed, is set aside (``set_aside``).
    """
    scratch = folder / f"{SCRATCH}files"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        with _placed(folder, scratch):
            yield scratch
            set_aside(folder, [n for n in names if not _is_same(folder / n, scratch / n)], say)
            for name in names:
                os.replace(scratch / name, folder / name)
            list_written(folder, names)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def write_listed(path: Path, data: bytes, say: Say) -> None:
    """``whole_files`` for one file whose content is at hand."""
    with whole_files(path.parent, [path.name], say) as made:
        (made / path.name).write_bytes(data)


def _is_same(one: Path, other: Path) -> bool:
    return one.is_file() and not one.is_symlink() and content_digest(one) == content_digest(other)


@contextlib.contextmanager
def whole_folder(
    out: Path, *, say: Say | None = None, ours: Callable[[Path], bool] = lambda _: False
) -> Iterator[Path]:
    """An empty scratch folder beside ``out`` that takes its place when the block ends without an error.

    It carries a list of its files with their digests (``WRITTEN``). Without ``say`` only a missing or empty folder is taken
    the place of, SettingsError else. With it, what stood at ``out`` goes, but for what is not ours (not listed, or changed
    since): that stays, under its own name, or as ``name.edited.ext`` where a new file has its name, which ``say`` is told.
    ``ours`` says which files of a folder without a list are ours.

    After an error ``out`` stays as it was. What a run killed between the two renames left aside is put back first, and
    scratch folders of this ``out`` that nobody has touched for an hour are removed.
    """
    # A link stays, and the folder that it leads to is replaced.
    out = Path(os.path.realpath(out)) if out.is_symlink() else out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    _tidy(out)
    scratch = out.with_name(f"{SCRATCH}{out.name}-{uuid.uuid4().hex[:12]}")
    old = out.with_name(f"{scratch.name}{_OLD}")
    scratch.mkdir()
    try:
        with _placed(out, scratch):
            yield scratch
            list_written(scratch, list(files_below(scratch)))
            told = _carry(out, scratch, ours) if say is not None and out.is_dir() else []
        if say is not None and out.exists():
            os.rename(out, old)
        try:
            if sys.platform == "win32" and say is None and out.is_dir():
                out.rmdir()
            os.rename(scratch, out)  # onto an empty folder at most
        except BaseException as error:
            if old.exists() and not out.exists():
                os.rename(old, out)
            if isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise SettingsError(
                    f"{out} is there by now, made by another run: choose another", needs="out"
                ) from None
            raise
        shutil.rmtree(old, ignore_errors=True)
        for line in told:
            assert say is not None
            say(line)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


# --- what we wrote, and what is not ours ---------------------------------------------------------------------------


def list_written(folder: Path, names: Sequence[str]) -> None:
    """Notes the digests of files in a folder, by names with forward slashes, in its list of what was written."""
    known = read_json(folder / WRITTEN)
    known = known if isinstance(known, dict) else {}
    write_json(folder / WRITTEN, known | {name: content_digest(folder / name) for name in names})


def foreign_in(folder: Path) -> list[str] | None:
    """Names below a folder of files that its list does not have, or has otherwise; None where there is no list."""
    known = read_json(folder / WRITTEN)
    if not isinstance(known, dict):
        return None
    return [n for n in sorted(_entries(folder)) if n != WRITTEN and not _is_as_written(folder, n, known)]


def set_aside(folder: Path, names: Sequence[str], say: Say) -> None:
    """Renames the files of these names that are not ours, or were changed, to ``name.edited.ext``, and says so."""
    known = read_json(folder / WRITTEN)
    known = known if isinstance(known, dict) else {}
    for name in names:
        path = folder / name
        if os.path.lexists(path) and not _is_as_written(folder, name, known):
            kept = _edited(path)
            os.rename(path, kept)
            say(_kept_line(path, kept))


def _carry(old: Path, new: Path, ours: Callable[[Path], bool]) -> list[str]:
    """What is not ours in a folder also in the one that takes its place; a line for each that lost its name."""
    foreign = foreign_in(old)
    if foreign is None:
        foreign = [name for name in sorted(_entries(old)) if not ours(old / name)]
    told = []
    for name in foreign:
        source, target = old / name, new / name
        if os.path.lexists(target):
            if target.is_file() and source.is_file() and content_digest(source) == content_digest(target):
                continue
            target = _edited(target)
            told.append(_kept_line(source, target))
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            os.symlink(os.readlink(source), target)
        elif source.is_dir():
            target.mkdir(exist_ok=True)
        else:
            try:
                os.link(source, target)
            except OSError:  # a file system without links
                shutil.copy2(source, target)
    return told


def _kept_line(path: Path, kept: Path) -> str:
    return f"{path}: not as brmgeo wrote it, so it is kept as {kept.name}"


def _edited(path: Path) -> Path:
    """The first free name of ``name.edited.ext``, ``name.edited-2.ext`` and so on."""
    for number in itertools.count(1):
        free = path.with_name(f"{path.stem}.edited{f'-{number}' if number > 1 else ''}{path.suffix}")
        if not os.path.lexists(free):
            return free
    raise AssertionError


def _entries(folder: Path) -> Iterator[str]:
    """Names below a folder of files, of links (which are not followed) and of empty folders; no scratch of ours."""
    for top, folders, names in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(top, name))]
        here = [*names, *links]
        if not here and not folders and Path(top) != folder:
            yield Path(top).relative_to(folder).as_posix()
        for name in here:
            if not name.startswith(SCRATCH):
                yield (Path(top) / name).relative_to(folder).as_posix()


def _is_as_written(folder: Path, name: str, known: Mapping[str, object]) -> bool:
    """Whether a file is the one that was listed; what SQLite keeps beside a listed database goes with it."""
    path = folder / name
    if path.is_symlink() or not path.is_file():
        return False
    if name.endswith(_BESIDE_SQLITE) and name not in known:
        database = name[: -len("-wal")]
        # Of a database that somebody works on; alone, or without a word in it, nothing is lost.
        return database in known and (path.stat().st_size == 0 or not (folder / database).is_file())
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        return False
    return known.get(name) == content_digest(path)


def _tidy(out: Path, older_than_s: float = 3600.0) -> None:
    """Puts back what a killed ``whole_folder(out)`` had moved aside where ``out`` is missing, and removes its old litter."""
    ours = re.compile(rf"{re.escape(f'{SCRATCH}{out.name}-')}[0-9a-f]{{12}}({re.escape(_OLD)})?")
    found = sorted((p for p in out.parent.iterdir() if ours.fullmatch(p.name)), key=_last_touched)
    aside = [p for p in found if p.name.endswith(_OLD)]
    # Who asks whether a folder can be written makes it: an empty one holds nothing that could be lost.
    if aside and (not out.exists() or (out.is_dir() and not any(out.iterdir()))):
        with contextlib.suppress(FileNotFoundError):
            out.rmdir()
        os.rename(aside[-1], out)
        found.remove(aside[-1])
    before = time.time() - older_than_s
    for path in found:
        if _last_touched(path) < before:
            shutil.rmtree(path, ignore_errors=True)


def _last_touched(folder: Path) -> float:
    """When a folder or anything in it was last written, seconds since 1970; 0 for one that is gone."""
    newest = 0.0
    for path in (folder, *folder.rglob("*")):
        with contextlib.suppress(OSError):  # its owner may clear it away just now
            newest = max(newest, path.lstat().st_mtime)
    return newest


def require_replaceable(
    out: Path, sign: str, what: str, ours: Callable[[Path], bool], *, keeps: bool = False
) -> None:
    """Raises SettingsError where ``whole_folder(out)`` would lose what is not ours, or ``out`` is none of our folders.

    Args:
        out: the folder; one that is not there, or is empty, may be replaced.
        sign: name of the file without which the folder is none of ours.
        what: what ours is called, for the message.
        ours: True for a path in it that may be lost, where the folder has no list of what was written.
        keeps: what is not ours in a folder with a list is kept, so it is no hindrance.
    """
    there = sorted(out.iterdir()) if out.is_dir() else []
    listed = foreign_in(out) if there else None
    if keeps and listed is not None and (out / sign).is_file():
        return
    foreign = [out / n for n in listed] if listed is not None else [p for p in there if not ours(p)]
    foreign = foreign or ([] if not there or (out / sign).is_file() else there)
    if foreign or out.is_file():
        raise SettingsError(
            f"{out}: there are other files than {what} ({(foreign or [out])[0].name}), or changed ones, and the folder is "
            "replaced as a whole: give a new folder or an empty one",
            needs="out",
        )


def require_writable(folder: Path) -> None:
    """Makes a folder for results; raises WorkflowError where nothing can be written there, before any work is done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise WorkflowError(f"results cannot be written to {folder}: {told(error)}") from None


def user_cache() -> Path:
    """The folder ``brmgeo`` where this system keeps a user's caches; RuntimeError for a user without a home.

    It is for what libraries would else keep in a place of their own, is made when they first write there, and may be
    deleted at any time.
    """
    if sys.platform == "win32":
        place = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        place = Path.home() / "Library" / "Caches"
    else:
        stated = os.environ.get("XDG_CACHE_HOME", "")
        place = stated if os.path.isabs(stated) else Path.home() / ".cache"
    return Path(place) / "brmgeo"


def sync(path: Path) -> None:
    """Waits until the disk has a file, or the names in a folder; Windows knows no such thing of folders."""
    if sys.platform == "win32" and path.is_dir():
        return
    # Windows syncs only what is open for writing.
    fd = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def plain_name(text: str, otherwise: str) -> str:
    """A text as the name of a file or folder: letters and digits of any script, - _ .; ``otherwise`` where none is left."""
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in text).strip(".-") or otherwise


def plain_cell(text: str) -> str:
    """A text as a cell of a CSV that people open: one that a spreadsheet would take for a formula gets an apostrophe.

    These begin with = + - @, a tab or a carriage return. An apostrophe before those is doubled, so taking one away gives the
    text back.
    """
    return f"'{text}" if _FORMULA.match(text) else text


_FORMULA = re.compile(r"'*[=+\-@\t\r]")


# --- scratch in the temporary folder -----------------------------------------------------------------------------

_HELD = ".brmgeo-scratch"


@contextlib.contextmanager
def scratch_folder(what: str) -> Iterator[Path]:
    """A folder of this process's own in the system's temporary folder, ``brmgeo-WHAT-...``; removed at the end.

    Folders of the same user's runs that were killed are removed before and after: nobody holds the lock in them any more.
    """
    sweep_scratch()
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"brmgeo-{what}-"))
        lock = open_lock(folder / _HELD)
        # Between these lines another run may have taken the folder for litter.
        if take_lock(lock, wait=False) and (folder / _HELD).exists():
            break
        os.close(lock)
    try:
        with _placed(folder, folder):
            yield folder
    finally:
        _clear(folder)
        os.close(lock)
        _clear(folder)  # Windows keeps a lock file as long as it is open
        # Workers of a killed run may have outlived it when this one began.
        sweep_scratch()


def sweep_scratch() -> None:
    """Removes this user's scratch folders in the temporary one whose processes are gone; a link is never followed."""
    for folder in Path(tempfile.gettempdir()).glob("brmgeo-*"):
        with contextlib.suppress(OSError):  # its owner may clear it away just now
            if folder.is_symlink() or (hasattr(os, "getuid") and folder.lstat().st_uid != os.getuid()):
                continue
            lock = os.open(folder / _HELD, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if take_lock(lock, wait=False):
                    _clear(folder)
            finally:
                os.close(lock)


def _clear(folder: Path) -> None:
    """Removes a scratch folder, its lock last: one that a process still writes into is swept again another time."""
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if path.name != _HELD:
                shutil.rmtree(
                    path, ignore_errors=True
                ) if path.is_dir() and not path.is_symlink() else path.unlink()
        if [path.name for path in folder.iterdir()] in ([_HELD], []):
            (folder / _HELD).unlink(missing_ok=True)
            folder.rmdir()


# --- contents ----------------------------------------------------------------------------------------------------


def digest(path: Path) -> str:
    """SHA-256 of a file's content, 64 hexadecimal digits."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def content_digest(path: Path) -> str:
    """SHA-256 of what a file says: its ``digest``, but of an SQLite file (GeoPackage) without the counters and modes in its
    header, which programs change by opening it."""
    with open(path, "rb") as handle:
        head = bytearray(handle.read(100))
        if not head.startswith(b"SQLite format 3\0"):
            return digest(path)
        for at, length in ((18, 2), (24, 4), (92, 8)):
            head[at : at + length] = bytes(length)
        state = hashlib.sha256(head)
        while block := handle.read(1 << 20):
            state.update(block)
    return state.hexdigest()


def digest_of(text: str | bytes | memoryview) -> str:
    """SHA-256 of a text (its UTF-8) or of bytes, such as ``array.data`` of a contiguous array, 64 hexadecimal digits."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


_FICLONE = 0x40049409


def copy(source: Path, target: Path) -> None:
    """A durable copy that appears whole; shares blocks with its source on file systems that can (copy on write)."""
    with (
        whole_file(target, durable=True) as scratch,
        open(source, "rb") as reader,
        open(scratch, "xb") as writer,
    ):
        shared = False
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                fcntl.ioctl(writer.fileno(), _FICLONE, reader.fileno())
                shared = True
        if not shared:
            shutil.copyfileobj(reader, writer, 1 << 20)


# --- what is there -----------------------------------------------------------------------------------------------


def files_below(folder: Path, hidden: bool = True) -> Iterator[str]:
    """Relative names, with forward slashes, of all files below a folder; without ``hidden`` none that begins with a dot."""

    def walk(path: str, prefix: str) -> Iterator[str]:
        with os.scandir(path) as entries:
            for entry in entries:
                if not hidden and entry.name.startswith("."):
                    continue
                if entry.is_dir():
                    yield from walk(entry.path, f"{prefix}{entry.name}/")
                else:
                    yield f"{prefix}{entry.name}"

    return walk(str(folder), "")


def folders_below(folder: Path) -> list[Path]:
    """All folders below a folder, the innermost first."""
    return [Path(top) / name for top, names, _ in os.walk(folder, topdown=False) for name in names]


# --- locks -------------------------------------------------------------------------------------------------------


def open_lock(path: Path) -> int:
    """A descriptor of a lock file, made where it is not there; no child process inherits it. Close it with os.close."""
    return os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)


def take_lock(descriptor: int, *, wait: bool) -> bool:
    """Locks an open file against other processes until it is closed; False when another has it and ``wait`` is not set."""
    if sys.platform == "win32":
        # One byte far beyond what is written: the holder's name stays readable.
        os.lseek(descriptor, 1 << 30, os.SEEK_SET)
        while True:
            try:
                msvcrt.locking(descriptor, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
                return True
            except OSError:
                if not wait:
                    return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    return True
