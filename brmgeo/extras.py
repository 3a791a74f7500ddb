"""Libraries that a bare installation leaves out: what needs one of them says so in one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from brmgeo.errors import MissingExtraError


@contextlib.contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """For a block of imports: MissingExtraError, naming the extra that brings them, in place of an ImportError.

    Args:
        name: the extra of pyproject.toml (``maps``, ``train``, ``logs``).
        what: that is asked for, such as "reading ROS bags".
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("brmgeo", "pipelines"):
            raise
        raise MissingExtraError(
            f"{what} needs {error.name.split('.')[0]}, which is not installed: pip install 'brmgeo[{name}]'"
        ) from None
