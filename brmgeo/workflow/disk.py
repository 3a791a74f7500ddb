"""What a disk does to a run, as WorkflowErrors of one line."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from brmgeo import files
from brmgeo.errors import BrmgeoError, WorkflowError

_LEAST_FREE = 4096
# A file that a stage looks for and that is not there is a defect of the stage, not of the disk.
_DEFECTS = (errno.ENOENT, errno.EISDIR)


@contextlib.contextmanager
def disk_errors(doing: str, root: Path) -> Iterator[None]:
    """Turns what the disk below ``root`` does to us into a WorkflowError of one line; other exceptions pass."""
    try:
        yield
    except BrmgeoError:
        raise
    except MemoryError:
        raise WorkflowError(
            f"{doing}: memory is used up; close other programs or use fewer workers, and run again"
        ) from None
    except OSError as error:
        reason = None if error.errno in _DEFECTS else files.reason(error)
        if reason is None:
            raise
        where = error.filename2 or error.filename or root
        raise WorkflowError(f"{doing}: {os.fsdecode(where)}: {reason}") from error
    except Exception as error:
        # GDAL and SQLite have exceptions of their own for a full disk.
        if is_full(root) or "No space left" in str(error) or "disk is full" in str(error):
            raise WorkflowError(f"{doing}: {root}: {files.reason_of(errno.ENOSPC)}") from error
        raise


def is_full(root: Path) -> bool:
    """True where the disk below ``root`` has no room for another block; False where it does not say."""
    try:
        return shutil.disk_usage(root).free < _LEAST_FREE
    except OSError:
        return False
