"""What a stage is, and the canonical text from which its key is made.

A key must not change unless the result may: it is the SHA-256 of the stage's name and version, its settings and the keys of
its inputs, written as canonical JSON. Time, host, number of workers and the text of the code are not in it;
whoever changes what a stage computes raises its ``version`` by hand.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from brmgeo.files import digest_of

T = TypeVar("T")
R = TypeVar("R")
S = TypeVar("S")

Json = Any
"""What ``json.loads`` returns: dict, list, str, int, float, bool or None."""


class Map(Protocol):
    """``map`` as a stage gets it: fans a function out over items, wherever the scheduler runs."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T], /) -> Iterator[R]:
        """Results of ``function(item)`` in the order of ``items``, with a bounded number in flight.

        ``function`` stands at module level (or is a ``functools.partial`` of one that does); items and results can be
        pickled. An exception that ``function`` raises is raised here with its type and text.
        """
        ...  # pragma: no cover


Run = Callable[[Mapping[str, Path], Path, S, Map], Mapping[str, Json]]
"""``run(inputs, out, settings, map) -> facts``: see ``Stage``."""

_UNSTATED = "unstated"


def unstated(default: T) -> T:
    """A field of a stage's settings that has no place in the key while it has its default.

    So a setting can be added and what was made before there was a choice stays fresh.
    """
    field: Any = dataclasses.field(default=default, metadata={_UNSTATED: True})
    return field  # type: ignore[no-any-return]


@dataclasses.dataclass(frozen=True, slots=True)
class Stage(Generic[S]):
    """One kind of step.

    Attributes:
        name: lower-case word; the folder of its artifacts in the store.
        version: raised by hand whenever the same inputs and settings would give another result.
        run: ``run(inputs, out, settings, map) -> facts``. ``inputs`` maps names to paths (folders of upstream
            artifacts, source files or folders), ``out`` is an empty folder, named by the artifact's key, that takes
            the outputs, ``settings`` is the stage's own frozen dataclass, which can be pickled, ``map`` fans out over
            workers (who get paths and windows, and open their own handles). The returned facts are JSON-able and go into
            the record.
    """

    name: str
    version: int
    run: Run[S]

    def __post_init__(self) -> None:
        if not self.name or not all(c.isalnum() or c in "-_" for c in self.name):
            raise ValueError(f"stage name {self.name!r}: letters, digits, - and _ only, it names a folder")


def plain(value: object, where: str = "settings") -> Json:
    """``value`` as JSON values: mappings and dataclasses to dict, sequences and sets to list, NumPy scalars to numbers,
    enums to values.

    Fields that are ``unstated`` and at their default are left out; 1 and 1.0 stay different, -0.0 becomes 0.0. Raises
    TypeError for what has no unambiguous text (NaN, infinity, paths, keys that are not strings, other objects): that is
    a defect of the caller.
    """
    if isinstance(value, enum.Enum):
        return plain(value.value, where)
    if value is None or isinstance(value, (str, bool)):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise TypeError(f"{where}: {value} has no place in a key or record; leave it out or use None")
        return float(value) + 0.0
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(
            {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if _is_stated(value, f)}, where
        )
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str):
                raise TypeError(f"{where}: key {name!r} is not a string")
        return {name: plain(item, f"{where}.{name}") for name, item in value.items()}
    if isinstance(value, Set):
        return sorted((plain(item, where) for item in value), key=canonical)
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return [plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy
        return plain(value.tolist(), where)
    raise TypeError(f"{where}: {type(value).__name__} cannot be written as JSON: {value!r}")


def _is_stated(value: object, field: dataclasses.Field[Any]) -> bool:
    return not field.metadata.get(_UNSTATED) or getattr(value, field.name) != field.default


def canonical(value: Json) -> str:
    """The one JSON text of a plain value: sorted keys, no spaces, shortest floats."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def key_of(stage: Stage[Any], settings: Json, input_keys: Mapping[str, str]) -> str:
    """64 hexadecimal digits: the key of a stage with plain ``settings`` and the keys of its inputs by name."""
    text = canonical(
        {"stage": stage.name, "version": stage.version, "settings": settings, "inputs": dict(input_keys)}
    )
    return digest_of(text)
