"""A localizer's state as one safe file: arrays without Python objects and a JSON header, in a zip that numpy opens too.

Every part carries a checksum that is tested before the part is looked at, so a damaged file is never half believed.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from brmgeo.errors import InputError, MissingInputError, WorkflowError
from brmgeo.files import json_of, told, whole_file
from brmgeo.match import MatchSettings

_HEADER = "header"


def write_saved(path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Writes a header of plain values and named arrays, whole or not at all, and waits until the disk has them.

    Raises WorkflowError where the disk does not take it.
    """
    text = np.frombuffer(json.dumps(header, allow_nan=True).encode(), np.uint8)
    try:
        with whole_file(path, durable=True) as scratch, zipfile.ZipFile(scratch, "w") as out:
            for name, array in {_HEADER: text, **arrays}.items():
                with out.open(f"{name}.npy", "w", force_zip64=True) as part:
                    np.lib.format.write_array(part, np.asarray(array), allow_pickle=False)
    except OSError as error:
        raise WorkflowError(f"{path}: cannot be written: {told(error)}") from error


def read_saved(path: Path, version: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The header and the arrays of ``write_saved``; ``version`` is the ``format`` that the header must state.

    Raises MissingInputError where there is no such file, InputError for one that is damaged, cut short, or of another
    version.
    """
    try:
        with zipfile.ZipFile(path) as stored:
            parts = {info.filename.removesuffix(".npy"): _array(stored, info) for info in stored.infolist()}
        header = json_of(parts.pop(_HEADER).tobytes())
        found = header["format"]
    except (FileNotFoundError, NotADirectoryError):
        raise MissingInputError(f"{path}: there is no such saved state") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {told(error)}") from None
    except (
        zipfile.BadZipFile,
        ValueError,
        LookupError,
        TypeError,
        EOFError,
        MemoryError,
        NotImplementedError,
    ):
        raise InputError(f"{path}: no saved state, or damaged or cut short: start anew") from None
    if found != version:
        raise InputError(
            f"{path}: saved in format {found!r}, and this version of brmgeo reads {version}: start anew"
        )
    return header, parts


def _array(stored: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    # Packed parts are none of ours, and may unpack to anything.
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise ValueError("packed")
    array: NDArray[Any] = np.lib.format.read_array(io.BytesIO(stored.read(info)), allow_pickle=False)
    return array


def settings_of(values: Mapping[str, Mapping[str, Any]]) -> MatchSettings:
    """The settings that ``dataclasses.asdict`` turned into plain values.

    Raises SettingsError for a value out of range, ValueError where names are missing or unknown.
    """
    hints = get_type_hints(MatchSettings)
    groups = {}
    for name, kind in hints.items():
        known, given = {f.name for f in fields(kind)}, set(values[name])
        if known != given:
            raise ValueError(f"settings of {name} differ in {', '.join(sorted(known ^ given))}")
        groups[name] = kind(**values[name])
    if unknown := set(values) - set(hints):
        raise ValueError(f"unknown settings {', '.join(sorted(unknown))}")
    return MatchSettings(**groups)


def differs(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The first name whose values differ, with both of them, cut short; empty where all are equal."""
    for name, own in here.items():
        if there[name] != own:
            return f"another {name} ({str(there[name])[:16]} there, {str(own)[:16]} here)"
    return ""
