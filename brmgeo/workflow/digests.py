"""Content hashes of source files, kept between runs, so that a plan is keyed without reading everything again."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import MutableMapping
from pathlib import Path

from brmgeo import files
from brmgeo.errors import InputError, MissingInputError
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.stage import Json

Signature = tuple[int, ...]
"""How a file looks from outside: size, times of content and inode in nanoseconds, inode."""


def signature(path: str) -> Signature | None:
    """How a file looks; None when it is not there."""
    try:
        s = os.stat(path)
    except FileNotFoundError:
        return None
    return (s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino)


class Digests:
    """Content hashes of source files, kept in the file ``path`` as long as size, times and inode stay the same."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, list[Json]] | None = None
        self._changed = False

    def of(
        self, path: Path, what: str, signatures: MutableMapping[str, Signature]
    ) -> tuple[str, dict[str, str] | None]:
        """Digest of a file, or of a folder together with the digests of its files by relative name.

        Names that begin with a dot do not count. ``signatures`` receives how each file looked. Raises MissingInputError
        and InputError, which begin with ``what``, for what is absent, unreadable or changing.
        """
        try:
            if not path.is_dir():
                return self._file(str(path), signatures), None
            found = {
                n: self._file(f"{path}/{n}", signatures)
                for n in sorted(files.files_below(path, hidden=False))
            }
        except FileNotFoundError as error:
            gone = Path(error.filename or path)
            raise MissingInputError(
                f"{what}: {gone} is not there; put it there or correct its path"
            ) from None
        except OSError as error:
            raise InputError(
                f"{what}: {error.filename or path} cannot be read: {files.told(error)}"
            ) from None
        text = "".join(f"{digest} {name}\n" for name, digest in found.items())
        return files.digest_of(b"folder\n" + text.encode(errors="surrogateescape")), found

    def _file(self, path: str, signatures: MutableMapping[str, Signature]) -> str:
        if self._known is None:
            loaded = files.read_json(self._path)
            self._known = loaded if isinstance(loaded, dict) else {}
        look = signature(path)
        if look is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        signatures[path] = look
        entry = self._known.get(path)
        if isinstance(entry, list) and tuple(entry[1:]) == look:
            return str(entry[0])
        digest = files.digest(Path(path))
        if signature(path) != look:
            raise InputError(f"{path} changed while it was read; let it come to rest and run again")
        # A file written within the clock's grain could change again without a new time: do not keep its digest.
        if time.time_ns() - max(look[1], look[2]) > 2_000_000_000:
            self._known[path] = [digest, *look]
            self._changed = True
        return digest

    def save(self) -> None:
        """Keeps what was learnt since the last time."""
        if self._changed and self._known is not None:
            with disk_errors("digests of the sources", self._path.parent):
                files.write_json(self._path, self._known, durable=True)
            self._changed = False
