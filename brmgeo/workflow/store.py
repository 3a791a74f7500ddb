"""The content-addressed store: finished stages on disk, under paths made from their keys.

Layout below the root::

    artifacts/STAGE/KEY/    a finished stage: its outputs and provenance.json; never changed once there
    tmp/ID/                 work in progress: lock (held while its owner lives) and KEY/ (becomes the artifact)
    latest/REGION/LABEL.json   the most recent record of each step of a region, for ``status`` and ``why``
    locks/REGION.lock       held by the run that works on a region
    digests.json            content hashes of source files by path, size, times and inode

An artifact appears by one rename after its outputs and, last, its record have reached the disk. Whatever lies in
tmp/ without a living owner is litter of a killed run and is removed by the next one. Locks are ``flock``
locks (Windows has its own): the system drops them when the process dies, however it dies.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.metadata
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic
from urllib.parse import quote

from brmgeo import files
from brmgeo.errors import WorkflowError
from brmgeo.workflow.digests import Digests, Signature, signature
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.stage import Json, Map, S, Stage, canonical, key_of, plain

RECORD = "provenance.json"
_ORIGIN = {"stage", "version", "settings", "inputs", "key"}


@dataclass(frozen=True, slots=True)
class Step(Generic[S]):
    """A stage with its inputs and settings, keyed but not necessarily built.

    Attributes:
        stage: what runs.
        label: its name in a region's plan; the stage's name unless several steps share a stage.
        inputs: by name, source paths or upstream steps.
        settings: the frozen dataclass that the stage will get.
        key: 64 hexadecimal digits.
        path: where the store keeps, or will keep, the outputs.
        origin: what the key was made from, as it goes into the record: see ``Store.step``.
        signatures: how the source files looked when they were hashed, to notice a change while the stage runs.
    """

    stage: Stage[S]
    label: str
    inputs: Mapping[str, Path | Step[Any]]
    settings: S
    key: str
    path: Path
    origin: Json = field(repr=False)
    signatures: Mapping[str, Signature] = field(repr=False)


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

    step: Step[Any]
    path: Path
    facts: Json
    record: Json = field(repr=False)
    fresh: bool

    @property
    def key(self) -> str:
        """64 hexadecimal digits."""
        return self.step.key


#: How long a run may keep others from the folder of work in progress, seconds.
_CLEANING_S = 60.0

Input = str | Path | Step[Any] | Artifact


class Store:
    """The store below ``root``, which is made when missing. Raises WorkflowError when it cannot be written."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root).absolute()
        with disk_errors(f"store {self.root}", self.root):
            for name in ("artifacts", "tmp", "latest", "locks"):
                (self.root / name).mkdir(parents=True, exist_ok=True)
        self._digests = Digests(self.root / "digests.json")

    # -- keys

    def step(
        self,
        stage: Stage[S],
        inputs: Mapping[str, Input],
        settings: S,
        label: str | None = None,
    ) -> Step[S]:
        """Keys a stage without running it: sources are hashed (once: digests are kept), upstream steps need not be built.

        Source files and folders are read now; a later change is noticed when the step is built. Raises
        MissingInputError or InputError for sources that are absent or unreadable, TypeError for settings that are no
        frozen dataclass or that JSON cannot hold.
        """
        label = label or stage.name
        _require_frozen(settings, label)
        own: dict[str, Path | Step[Any]] = {}
        keys: dict[str, str] = {}
        origins: dict[str, Json] = {}
        signatures: dict[str, Signature] = {}
        for name, given in sorted(inputs.items()):
            item = given.step if isinstance(given, Artifact) else given
            if isinstance(item, Step):
                own[name] = item
                keys[name] = item.key
                origins[name] = {"stage": item.stage.name, "label": item.label, "key": item.key}
            else:
                own[name] = path = Path(item).absolute()
                digest, inside = self._digests.of(path, f"input {name} of stage {label}", signatures)
                keys[name] = digest
                origins[name] = {"path": str(path), "sha256": digest}
                if inside is not None:
                    origins[name]["files"] = inside
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
        return Step(
            stage=stage,
            label=label,
            inputs=own,
            settings=settings,
            key=key,
            path=path,
            origin=origin,
            signatures=signatures,
        )

    # -- artifacts

    def find(self, step: Step[Any]) -> Artifact | None:
        """The finished artifact of a step, or None when it is absent or its files are not those of its record."""
        record = self._record(step)
        if record is None or self._damage(step, record) is not None:
            return None
        return Artifact(step, step.path, record["facts"], record, fresh=False)

    def damage(self, step: Step[Any]) -> str | None:
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
            elif files.digest(path) != entry["sha256"]:
                wrong.append(f"{path}: content differs from the record")
        for name in files.files_below(artifact.path):
            if name != RECORD and name not in artifact.record["outputs"]:
                wrong.append(f"{artifact.path / name}: not in the record")
        return wrong

    def build(self, step: Step[Any], map: Map) -> Artifact:
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
            with disk_errors(doing, self.root):
                out.mkdir()
                start = time.time()
                facts = plain(step.stage.run(inputs, out, step.settings, map), "facts")
                self._require_unchanged(step)
                record = self._make_record(step, out, facts, start)
                files.write_json(out / RECORD, record, durable=True)
                for folder in [*files.folders_below(out), out]:
                    files.sync(folder)
                self._publish(step, work)
        return Artifact(step, step.path, facts, record, fresh=True)

    def _record(self, step: Step[Any]) -> Json | None:
        record: Json = files.read_json(step.path / RECORD)
        return record if _is_whole(record) and record["key"] == step.key else None

    def _damage(self, step: Step[Any], record: Json) -> str | None:
        for name, entry in record["outputs"].items():
            try:
                size = os.stat(step.path / name).st_size
            except OSError:
                return f"{name} is missing"
            if size != entry["size"]:
                return f"{name} has {size} bytes, {entry['size']} were recorded"
        return None

    def _require_unchanged(self, step: Step[Any]) -> None:
        for path, look in step.signatures.items():
            if signature(path) != look:
                raise WorkflowError(
                    f"stage {step.label}: source {path} changed while it was in use; let it come to rest and run again"
                )

    def _make_record(self, step: Step[Any], out: Path, facts: Json, start: float) -> Json:
        outputs = {}
        for name in sorted(files.files_below(out)):
            if name == RECORD:
                raise ValueError(f"stage {step.stage.name} wrote {RECORD}: that name belongs to the store")
            files.sync(out / name)
            outputs[name] = {"sha256": files.digest(out / name), "size": (out / name).stat().st_size}
        # GDAL can lose the last blocks on a full disk without an exception: no room at all is reason enough.
        if files.is_full(self.root):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out))
        record: Json = step.origin | {
            "label": step.label,
            "outputs": outputs,
            "facts": facts,
            "libraries": _libraries(),
            "start": _iso(start),
            "end": _iso(time.time()),
            "seconds": round(time.time() - start, 3),
            "host": socket.gethostname(),
        }
        return record | {"digest": _digest(record)}

    def _publish(self, step: Step[Any], work: Path) -> None:
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
        files.sync(step.path.parent)

    # -- work in progress

    @contextlib.contextmanager
    def _workdir(self) -> Iterator[Path]:
        """A fresh folder below tmp/ whose lock tells other runs that its owner lives; removed at the end."""
        with disk_errors("store", self.root), self._tmp_lock():
            work = self.root / "tmp" / uuid.uuid4().hex
            work.mkdir()
            lock = files.open_lock(work / "lock")
            files.take_lock(lock, wait=True)
        try:
            yield work
        finally:
            shutil.rmtree(work, ignore_errors=True)
            os.close(lock)
            shutil.rmtree(work, ignore_errors=True)  # Windows keeps a lock file as long as it is open

    @contextlib.contextmanager
    def _tmp_lock(self) -> Iterator[None]:
        # Between making a work folder and locking it, a cleaner must not take it for litter.
        path = self.root / "locks" / ".tmp"
        fd = files.open_lock(path)
        end = time.monotonic() + _CLEANING_S
        try:
            while not files.take_lock(fd, wait=False):
                if time.monotonic() > end:
                    raise WorkflowError(
                        f"store {self.root}: another run has held {path} for {_CLEANING_S:g} s, to clean up or "
                        "because it hangs: let it end, or kill it, and run again"
                    )
                time.sleep(0.02)
            yield
        finally:
            os.close(fd)

    def clean(self) -> int:
        """Removes what killed runs left in tmp/; the number of folders removed. Work of living runs stays."""
        removed = 0
        with disk_errors("cleaning the store", self.root), self._tmp_lock():
            for work in (self.root / "tmp").iterdir():
                if not work.is_dir():
                    work.unlink()
                    continue
                if _is_held(work / "lock"):
                    continue
                shutil.rmtree(work, ignore_errors=True)
                removed += 1
        return removed

    @contextlib.contextmanager
    def lock(self, region: str, wait: bool = False) -> Iterator[None]:
        """Holds a region for this process, after removing litter of killed runs.

        Raises WorkflowError that names the holder when another process has the region, unless ``wait``: then it waits.
        """
        path = self.root / "locks" / f"{_file_name(region)}.lock"
        with disk_errors(f"lock of region {region}", self.root):
            fd = files.open_lock(path)
        try:
            with disk_errors(f"lock of region {region}", self.root):
                if not files.take_lock(fd, wait=wait):
                    raise WorkflowError(
                        f"region {region} is being worked on by {_holder(path)}: "
                        "wait for it to end, or stop it, and run again"
                    )
                me = {"pid": os.getpid(), "host": socket.gethostname(), "since": _iso(time.time())}
                os.ftruncate(fd, 0)
                os.lseek(fd, 0, os.SEEK_SET)
                os.write(fd, json.dumps(me).encode())
            self.clean()
            yield
        finally:
            with contextlib.suppress(OSError):
                os.ftruncate(fd, 0)
            os.close(fd)

    # -- the most recent record of each step of a region

    def latest(self, region: str, label: str) -> Json | None:
        """The origin (stage, version, settings, inputs, key) last built for a step of a region, or None."""
        record = files.read_json(self._latest_path(region, label))
        if not isinstance(record, dict) or not record.keys() >= _ORIGIN:
            return None
        fields = (record["settings"], record["inputs"], *_values(record["inputs"]))
        return record if all(isinstance(f, dict) for f in fields) else None

    def remember(self, region: str, step: Step[Any]) -> None:
        """Notes a built step as the most recent of its label in a region."""
        before = self.latest(region, step.label)
        if before is not None and before["key"] == step.key:
            return
        path = self._latest_path(region, step.label)
        with disk_errors(f"record of stage {step.label}", self.root):
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write_json(path, step.origin, durable=True)

    def _latest_path(self, region: str, label: str) -> Path:
        return self.root / "latest" / _file_name(region) / f"{_file_name(label)}.json"


def _require_frozen(settings: object, label: str) -> None:
    """A stage whose settings could change on the way would not be what its key says."""
    if not is_dataclass(settings) or isinstance(settings, type) or not settings.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise TypeError(f"settings of stage {label}: {type(settings).__name__} is no frozen dataclass")


def _values(field: Json) -> list[Json]:
    return list(field.values()) if isinstance(field, dict) else []


def _is_whole(record: Json) -> bool:
    """Whether a record is as it was written: by its digest, or, in stores of older versions, by its fields."""
    if not isinstance(record, dict):
        return False
    if "digest" not in record:
        return _ORIGIN | {"outputs", "facts", "end"} <= record.keys()
    try:
        return bool(record["digest"] == _digest({n: v for n, v in record.items() if n != "digest"}))
    except ValueError:  # numbers and letters that no record has
        return False


def _digest(record: Json) -> str:
    return files.digest_of(canonical(record).encode(errors="surrogateescape"))


def _is_held(lock: Path) -> bool:
    """True where the owner of a work folder lives; nobody owns one that has no lock yet, since making both is one act."""
    try:
        fd = os.open(lock, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        return not files.take_lock(fd, wait=False)
    finally:
        os.close(fd)


def _holder(path: Path) -> str:
    held = files.read_json(path)
    if not isinstance(held, dict) or not {"pid", "host", "since"} <= held.keys():
        return "another run"
    return f"process {held['pid']} on {held['host']} since {held['since']}"


def _file_name(text: str) -> str:
    name = quote(text, safe=" ()+,=@")
    return name if len(name) <= 120 and name[:1] != "." else files.digest_of(text)


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _libraries() -> dict[str, str]:
    """Versions of brmgeo and of what it and its extras require, as installed here."""
    try:
        needs = importlib.metadata.requires("brmgeo") or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    # What stages compute with: not the tools of whoever works on brmgeo itself.
    tools = ("bench", "dev", "docs")
    own = [
        need for need in needs if not any(f"extra == '{name}'" in need.replace('"', "'") for name in tools)
    ]
    names = {need.split(";")[0].split("[")[0].rstrip("0123456789.,<>=!~* ").strip() for need in own}
    found = {}
    for name in sorted(names | {"brmgeo"}):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found
