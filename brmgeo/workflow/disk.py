"""What a disk does to a run, as WorkflowErrors of one line."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from brmgeo import files
from brmgeo.errors import BrmgeoError, WorkflowError

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
        if files.is_full(root, error):
            raise WorkflowError(f"{doing}: {root}: {files.reason_of(errno.ENOSPC)}") from error
        raise
