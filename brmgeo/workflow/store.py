"""The content-addressed store: finished stages on disk, under paths made from their keys.

Layout below the root::

    artifacts/STAGE/KEY/    a finished stage: its outputs and provenance.json; never changed once there
    tmp/ID/                 work in progress: lock (held while its owner lives) and KEY/ (becomes the artifact)
    latest/REGION/LABEL.json   the most recent record of each step of a region, for ``status`` and ``why``
    locks/REGION.lock       held by the run that works on a region
    digests.json            content hashes of source files by path, size, times and inode

An artifact appears by one rename after its outputs and, last, its record have reached the disk. Whatever lies in
tmp/ without a living owner is litter of a killed run and is removed by the next one. Locks are ``flock``
locks: the kernel drops them when the process dies, however it dies.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import importlib.metadata
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from brmgeo.errors import BrmgeoError, InputError, MissingInputError, WorkflowError
from brmgeo.workflow.stage import Json, Map, Stage, key_of, plain

RECORD = "provenance.json"
PUBLISHED = ".brmgeo-published.json"
_PART = ".brmgeo-part-"

_DISK_ERRORS = {
    errno.ENOSPC: "the disk is full: free some space, or put the store on another disk, and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again",
    errno.EFBIG: "the file is larger than this system allows: raise the limit (ulimit -f) and run again",
    errno.EROFS: "the file system is read-only: choose another place",
    errno.EACCES: "permission is denied: change the owner or mode, or choose another place",
    errno.EPERM: "the operation is not permitted: change the owner or mode, or choose another place",
    errno.EEXIST: "a file stands where a folder is wanted: move it away or choose another place",
    errno.ENOTDIR: "a file stands where a folder is wanted: move it away or choose another place",
    errno.EIO: "the disk reports an input/output error: check the disk",
    errno.EMFILE: "too many files are open: raise the limit (ulimit -n) and run again",
    errno.ENAMETOOLONG: "the name is too long for this file system: choose a shorter place",
}


@dataclass(frozen=True, slots=True)
class Step:
    """A stage with its inputs and settings, keyed but not necessarily built.

    Attributes:
        stage: what runs.
        label: its name in a region's plan; the stage's name unless several steps share a stage.
        inputs: by name, source paths or upstream steps.
        settings: plain JSON values, exactly what the stage will get.
        key: 64 hexadecimal digits.
        path: where the store keeps, or will keep, the outputs.
        origin: what the key was made from, as it goes into the record: see ``Store.step``.
        signatures: how the source files looked when they were hashed, to notice a change while the stage runs.
    """

    stage: Stage
    label: str
    inputs: Mapping[str, Path | Step]
    settings: Json
    key: str
    path: Path
    origin: Json = field(repr=False)
    signatures: Mapping[str, tuple[int, ...]] = field(repr=False)


@dataclass(frozen=True, slots=True)
class Artifact:
    """A finished step.

    Attributes:
        step: what it is.
        path: folder of its outputs.
        facts: what the stage reported.
        record: the whole of its provenance.json.
        fresh: True when it was made by this call, False when it was there already.
    """

    step: Step
    path: Path
    facts: Json
    record: Json = field(repr=False)
    fresh: bool

    @property
    def key(self) -> str:
        """64 hexadecimal digits."""
        return self.step.key


Input = str | Path | Step | Artifact


class Store:
    """The store below ``root``, which is made when missing. Raises WorkflowError when it cannot be written."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root).absolute()
        with _disk(f"store {self.root}", self.root):
            for name in ("artifacts", "tmp", "latest", "locks"):
                (self.root / name).mkdir(parents=True, exist_ok=True)
        self._digests = _Digests(self.root / "digests.json")

    # -- keys

    def step(
        self,
        stage: Stage,
        inputs: Mapping[str, Input],
        settings: Mapping[str, object],
        label: str | None = None,
    ) -> Step:
        """Keys a stage without running it: sources are hashed (once: digests are kept), upstream steps need not be built.

        Source files and folders are read now; a later change is noticed when the step is built. Raises
        MissingInputError or InputError for sources that are absent or unreadable, TypeError for settings that JSON
        cannot hold.
        """
        label = label or stage.name
        own: dict[str, Path | Step] = {}
        keys: dict[str, str] = {}
        origins: dict[str, Json] = {}
        signatures: dict[str, tuple[int, ...]] = {}
        for name, given in sorted(inputs.items()):
            item = given.step if isinstance(given, Artifact) else given
            if isinstance(item, Step):
                own[name] = item
                keys[name] = item.key
                origins[name] = {"stage": item.stage.name, "label": item.label, "key": item.key}
            else:
                own[name] = path = Path(item).absolute()
                digest, files = self._digests.of(path, f"input {name} of stage {label}", signatures)
                keys[name] = digest
                origins[name] = {"path": str(path), "sha256": digest}
                if files is not None:
                    origins[name]["files"] = files
        self._digests.save()
        values = plain(settings, f"settings of stage {label}")
        key = key_of(stage, values, keys)
        origin = {
            "stage": stage.name,
            "version": stage.version,
            "key": key,
            "settings": values,
            "inputs": origins,
        }
        path = self.root / "artifacts" / stage.name / key
        return Step(stage, label, own, values, key, path, origin, signatures)

    # -- artifacts

    def find(self, step: Step) -> Artifact | None:
        """The finished artifact of a step, or None when it is absent or its files are not those of its record."""
        record = self._record(step)
        if record is None or self._damage(step, record) is not None:
            return None
        return Artifact(step, step.path, record["facts"], record, fresh=False)

    def damage(self, step: Step) -> str | None:
        """What is wrong with a step's artifact by names and sizes; None when nothing is, or it is not there at all."""
        if not step.path.exists():
            return None
        record = self._record(step)
        return f"{RECORD} is unreadable" if record is None else self._damage(step, record)

    def verify(self, artifact: Artifact) -> list[str]:
        """One line for each output that differs in content from its record; an empty list when all is well."""
        wrong = []
        for name, entry in artifact.record["outputs"].items():
            path = artifact.path / name
            if not path.is_file():
                wrong.append(f"{path}: missing")
            elif path.stat().st_size != entry["size"]:
                wrong.append(f"{path}: {path.stat().st_size} bytes, {entry['size']} were recorded")
            elif _hash_file(path) != entry["sha256"]:
                wrong.append(f"{path}: content differs from the record")
        for name in _files_below(artifact.path):
            if name != RECORD and name not in artifact.record["outputs"]:
                wrong.append(f"{artifact.path / name}: not in the record")
        return wrong

    def remove(self, artifact: Artifact) -> None:
        """Takes an artifact out of the store, so that the next run makes it again."""
        with self._workdir() as work, _disk(f"removing {artifact.path}", self.root):
            os.rename(artifact.path, work / "old")

    def build(self, step: Step, map: Map) -> Artifact:
        """The artifact of a step: the finished one at once, otherwise its inputs are built and then its stage runs.

        Raises what the stage raises; WorkflowError when the disk, a limit or a source that changes meanwhile is in the way.
        Nothing that looks finished stays behind then.
        """
        found = self.find(step)
        if found is not None:
            return found
        inputs: dict[str, Path] = {}
        for name, item in step.inputs.items():
            inputs[name] = self.build(item, map).path if isinstance(item, Step) else item
        doing = f"stage {step.label}"
        with self._workdir() as work:
            out = work / step.key  # a stage may write its own key into what it makes
            with _disk(doing, self.root):
                out.mkdir()
                start = time.time()
                facts = plain(
                    step.stage.run(inputs, out, json.loads(json.dumps(step.settings)), map), "facts"
                )
                self._require_unchanged(step)
                record = self._make_record(step, out, facts, start)
                _write_json(out / RECORD, record)
                for folder in [*_folders_below(out), out]:
                    _sync_folder(folder)
                self._publish(step, work)
        return Artifact(step, step.path, facts, record, fresh=True)

    def _record(self, step: Step) -> Json | None:
        record = _read_json(step.path / RECORD)
        return record if isinstance(record, dict) and record.get("key") == step.key else None

    def _damage(self, step: Step, record: Json) -> str | None:
        for name, entry in record["outputs"].items():
            try:
                size = os.stat(step.path / name).st_size
            except OSError:
                return f"{name} is missing"
            if size != entry["size"]:
                return f"{name} has {size} bytes, {entry['size']} were recorded"
        return None

    def _require_unchanged(self, step: Step) -> None:
        for path, signature in step.signatures.items():
            if _signature(path) != signature:
                raise WorkflowError(
                    f"stage {step.label}: source {path} changed while it was in use; let it come to rest and run again"
                )

    def _make_record(self, step: Step, out: Path, facts: Json, start: float) -> Json:
        outputs = {}
        for name in sorted(_files_below(out)):
            if name == RECORD:
                raise ValueError(f"stage {step.stage.name} wrote {RECORD}: that name belongs to the store")
            _sync_file(out / name)
            outputs[name] = {"sha256": _hash_file(out / name), "size": (out / name).stat().st_size}
        # GDAL can lose the last blocks on a full disk without an exception: no room at all is reason enough.
        if shutil.disk_usage(self.root).free < 4096:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out))
        return step.origin | {
            "label": step.label,
            "outputs": outputs,
            "facts": facts,
            "libraries": _libraries(),
            "start": _iso(start),
            "end": _iso(time.time()),
            "seconds": round(time.time() - start, 3),
            "host": socket.gethostname(),
        }

    def _publish(self, step: Step, work: Path) -> None:
        step.path.parent.mkdir(parents=True, exist_ok=True)
        if step.path.exists():
            if self.find(step) is not None:
                return  # another run made the same artifact meanwhile; equal keys mean equal contents
            os.rename(step.path, work / "old")
        try:
            os.rename(work / step.key, step.path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST) or self.find(step) is None:
                raise
        _sync_folder(step.path.parent)

    # -- work in progress

    @contextlib.contextmanager
    def _workdir(self) -> Iterator[Path]:
        """A fresh folder below tmp/ whose lock tells other runs that its owner lives; removed at the end."""
        with _disk("store", self.root), self._tmp_lock():
            work = self.root / "tmp" / uuid.uuid4().hex
            work.mkdir()
            lock = os.open(work / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield work
        finally:
            shutil.rmtree(work, ignore_errors=True)
            os.close(lock)

    @contextlib.contextmanager
    def _tmp_lock(self) -> Iterator[None]:
        # Between making a work folder and locking it, a cleaner must not take it for litter.
        fd = os.open(self.root / "locks" / ".tmp", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX)
            yield
        finally:
            os.close(fd)

    def clean(self) -> int:
        """Removes what killed runs left in tmp/; the number of folders removed. Work of living runs stays."""
        removed = 0
        with _disk("cleaning the store", self.root), self._tmp_lock():
            for work in (self.root / "tmp").iterdir():
                try:
                    fd = os.open(work / "lock", os.O_RDWR | os.O_CLOEXEC)
                except FileNotFoundError:
                    fd = -1
                except NotADirectoryError:
                    work.unlink()
                    continue
                try:
                    if fd >= 0:
                        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                else:
                    shutil.rmtree(work, ignore_errors=True)
                    removed += 1
                finally:
                    if fd >= 0:
                        os.close(fd)
        return removed

    @contextlib.contextmanager
    def lock(self, region: str, wait: bool = False) -> Iterator[None]:
        """Holds a region for this process, after removing litter of killed runs.

        Raises WorkflowError that names the holder when another process has the region, unless ``wait``: then it waits.
        """
        path = self.root / "locks" / f"{_file_name(region)}.lock"
        with _disk(f"lock of region {region}", self.root):
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            with _disk(f"lock of region {region}", self.root):
                try:
                    fcntl.flock(fd, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                except BlockingIOError:
                    raise WorkflowError(
                        f"region {region} is being worked on by {_holder(path)}: "
                        "wait for it to end, or stop it, and run again"
                    ) from None
                os.ftruncate(fd, 0)
                me = {"pid": os.getpid(), "host": socket.gethostname(), "since": _iso(time.time())}
                os.pwrite(fd, json.dumps(me).encode(), 0)
            self.clean()
            yield
        finally:
            with contextlib.suppress(OSError):
                os.ftruncate(fd, 0)
            os.close(fd)

    # -- the most recent record of each step of a region

    def latest(self, region: str, label: str) -> Json | None:
        """The origin (stage, version, settings, inputs, key) last built for a step of a region, or None."""
        record = _read_json(self._latest_path(region, label))
        return record if isinstance(record, dict) and "inputs" in record else None

    def remember(self, region: str, step: Step) -> None:
        """Notes a built step as the most recent of its label in a region."""
        before = self.latest(region, step.label)
        if before is not None and before["key"] == step.key:
            return
        path = self._latest_path(region, step.label)
        with _disk(f"record of stage {step.label}", self.root):
            path.parent.mkdir(parents=True, exist_ok=True)
            _replace_json(path, step.origin)

    def _latest_path(self, region: str, label: str) -> Path:
        return self.root / "latest" / _file_name(region) / f"{_file_name(label)}.json"


def publish(artifact: Artifact, out_dir: Path | str, names: Mapping[str, str] | Iterable[str]) -> list[str]:
    """Copies outputs (files, or folders with all in them) to ``out_dir`` under stable names; the names that were written.

    ``names`` maps names in the artifact to names in ``out_dir``, or lists names that stay the same. Each file
    is replaced at once, never half written, and only when it is not the one published before: files that an earlier
    artifact put into a published folder and this one lacks are removed. The copies are no links, since programs like
    QGIS write into the files that they open. Raises WorkflowError when ``out_dir`` cannot be written,
    KeyError when the artifact has no such output.
    """
    out = Path(out_dir).absolute()
    wanted: dict[str, tuple[str, Json]] = {}
    roots = []
    outputs = artifact.record["outputs"]
    for name, target in (names if isinstance(names, Mapping) else {n: n for n in names}).items():
        inside = {n: target + n[len(name) :] for n in outputs if n == name or n.startswith(f"{name}/")}
        if not inside and not (artifact.path / name).is_dir():
            raise KeyError(
                f"stage {artifact.step.label} has no output {name}; it has {', '.join(sorted(outputs))}"
            )
        roots.append(target)
        wanted |= {goal: (source, outputs[source]) for source, goal in inside.items()}
    written = []
    with _disk(f"results in {out}", out):
        out.mkdir(parents=True, exist_ok=True)
        for litter in out.glob(f"{_PART}*"):
            litter.unlink(missing_ok=True)
        known = _read_json(out / PUBLISHED)
        known = known if isinstance(known, dict) else {}
        before = dict(known)
        try:
            for goal, (source, entry) in sorted(wanted.items()):
                if goal in known and known[goal] == [entry["sha256"], *_look(out / goal)]:
                    continue
                part = out / f"{_PART}{uuid.uuid4().hex}"
                try:
                    _copy(artifact.path / source, part)
                    (out / goal).parent.mkdir(parents=True, exist_ok=True)
                    os.replace(part, out / goal)
                finally:
                    part.unlink(missing_ok=True)
                known[goal] = [entry["sha256"], *_look(out / goal)]
                written.append(goal)
            for goal in [g for g in known if g not in wanted and any(g.startswith(f"{r}/") for r in roots)]:
                (out / goal).unlink(missing_ok=True)
                del known[goal]
        finally:
            if known != before:
                _replace_json(out / PUBLISHED, known)
        _sync_folder(out)
    return written


class _Digests:
    """Content hashes of source files, kept by path as long as size, times and inode stay the same."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, list[Json]] | None = None
        self._changed = False

    def of(
        self, path: Path, what: str, signatures: dict[str, tuple[int, ...]]
    ) -> tuple[str, dict[str, str] | None]:
        """Digest of a file, or of a folder together with the digests of its files by relative name.

        Names that begin with a dot do not count. ``signatures`` receives how each file looked.
        """
        try:
            if not path.is_dir():
                return self._file(str(path), signatures), None
            files = {
                n: self._file(f"{path}/{n}", signatures) for n in sorted(_files_below(path, hidden=False))
            }
        except FileNotFoundError as error:
            gone = Path(error.filename or path)
            raise MissingInputError(
                f"{what}: {gone} is not there; put it there or correct its path"
            ) from None
        except OSError as error:
            raise InputError(f"{what}: {error.filename or path} cannot be read: {error.strerror}") from None
        text = "".join(f"{digest} {name}\n" for name, digest in files.items())
        return hashlib.sha256(b"folder\n" + text.encode(errors="surrogateescape")).hexdigest(), files

    def _file(self, path: str, signatures: dict[str, tuple[int, ...]]) -> str:
        if self._known is None:
            loaded = _read_json(self._path)
            self._known = loaded if isinstance(loaded, dict) else {}
        signature = _signature(path)
        if signature is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        signatures[path] = signature
        entry = self._known.get(path)
        if entry is not None and tuple(entry[1:]) == signature:
            return str(entry[0])
        digest = _hash_file(Path(path))
        if _signature(path) != signature:
            raise InputError(f"{path} changed while it was read; let it come to rest and run again")
        # A file written within the clock's grain could change again without a new time: do not keep its digest.
        if time.time_ns() - max(signature[1], signature[2]) > 2_000_000_000:
            self._known[path] = [digest, *signature]
            self._changed = True
        return digest

    def save(self) -> None:
        if self._changed and self._known is not None:
            with _disk("digests of the sources", self._path.parent):
                _replace_json(self._path, self._known)
            self._changed = False


def _signature(path: str) -> tuple[int, ...] | None:
    try:
        s = os.stat(path)
    except FileNotFoundError:
        return None
    return (s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino)


def _look(path: Path) -> tuple[int, ...]:
    """Size and time of a published file, (-1, -1) when absent: copies of the results keep them, unlike inodes."""
    try:
        s = path.stat()
    except FileNotFoundError:
        return (-1, -1)
    return (s.st_size, s.st_mtime_ns)


def _hash_file(path: Path) -> str:
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _files_below(folder: Path, hidden: bool = True) -> Iterator[str]:
    """Relative names, with forward slashes, of all files below a folder."""

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


def _folders_below(folder: Path) -> list[Path]:
    return [Path(top) / name for top, names, _ in os.walk(folder, topdown=False) for name in names]


def _sync_file(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


_sync_folder = _sync_file


def _write_json(path: Path, value: Json) -> None:
    with open(path, "w", encoding="utf-8", errors="surrogateescape") as handle:
        json.dump(value, handle, indent=1, ensure_ascii=False)
        handle.write("\n")
        handle.flush()
        os.fsync(handle.fileno())


def _replace_json(path: Path, value: Json) -> None:
    part = path.with_name(f"{_PART}{uuid.uuid4().hex}")
    try:
        _write_json(part, value)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _read_json(path: Path) -> Json | None:
    """The JSON in a file, or None when it is absent or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8", errors="surrogateescape"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


_FICLONE = 0x40049409


def _copy(source: Path, target: Path) -> None:
    """A durable copy; shares blocks with its source on file systems that can (copy on write)."""
    with open(source, "rb") as reader, open(target, "xb") as writer:
        try:
            fcntl.ioctl(writer.fileno(), _FICLONE, reader.fileno())
        except OSError:
            shutil.copyfileobj(reader, writer, 1 << 20)
        writer.flush()
        os.fsync(writer.fileno())


def _holder(path: Path) -> str:
    held = _read_json(path)
    if not isinstance(held, dict) or "pid" not in held:
        return "another run"
    return f"process {held['pid']} on {held['host']} since {held['since']}"


def _file_name(text: str) -> str:
    name = quote(text, safe=" ()+,=@")
    return name if len(name) <= 120 and name[:1] != "." else hashlib.sha256(text.encode()).hexdigest()


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _libraries() -> dict[str, str]:
    """Versions of brmgeo and of what it requires, as installed here."""
    try:
        needs = importlib.metadata.requires("brmgeo") or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    names = {
        need.split(";")[0].rstrip("0123456789.,<>=!~* ").strip() for need in needs if "extra ==" not in need
    }
    found = {}
    for name in sorted(names | {"brmgeo"}):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


@contextlib.contextmanager
def _disk(doing: str, root: Path) -> Iterator[None]:
    """Turns what the disk does to us into a WorkflowError of one line; other exceptions pass."""
    try:
        yield
    except BrmgeoError:
        raise
    except MemoryError:
        raise WorkflowError(
            f"{doing}: memory is used up; close other programs or use fewer workers, and run again"
        ) from None
    except OSError as error:
        hint = _DISK_ERRORS.get(error.errno or 0)
        if hint is None:
            raise
        where = error.filename2 or error.filename or root
        raise WorkflowError(f"{doing}: {os.fsdecode(where)}: {hint}") from error
    except Exception as error:
        # GDAL and SQLite have exceptions of their own for a full disk.
        if _is_full(root) or "No space left" in str(error) or "disk is full" in str(error):
            raise WorkflowError(f"{doing}: {root}: {_DISK_ERRORS[errno.ENOSPC]}") from error
        raise


def _is_full(root: Path) -> bool:
    try:
        return shutil.disk_usage(root).free < 4096
    except OSError:
        return False
