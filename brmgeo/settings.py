"""Settings from TOML files: read once, checked against a type, and every fault told in one line with file, line and key.

``read_toml`` gives a ``Toml``: the tables with the place of every key. ``build`` makes a frozen dataclass or a pydantic
model of it. Both are strict: a typing error never becomes a silently ignored setting.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from brmgeo.errors import BrmgeoError, MissingInputError, SettingsError
from brmgeo.files import DEEPEST, is_deep, told

T = TypeVar("T")
Keys = tuple[str | int, ...]

_STRICT = ConfigDict(strict=True, allow_inf_nan=False)
_TOLD = 3


def nearest(word: str, known: Sequence[str]) -> str:
    """A hint for a message: the known word nearest to ``word``, or all of them."""
    close = difflib.get_close_matches(word, known, 1)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known) or 'none'}"


def require_within(owner: Any, **ranges: tuple[float, float]) -> None:
    """SettingsError for the first number of ``owner`` that is not finite or outside its (least, most); both belong to it."""
    for name, (low, high) in ranges.items():
        value = getattr(owner, name)
        if not (math.isfinite(value) and low <= value <= high):
            kind = type(owner).__name__
            raise SettingsError(
                f"{kind}.{name} = {value!r} is outside [{low}, {high}]: choose a value inside"
            )


# --- files -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Toml:
    """A TOML file's tables, and where their keys stand.

    Attributes:
        path: the file, for messages.
        text: what it holds, line ends as \\n.
        data: the tables.
        error: the class of every fault that is found in it.
        places: file, line and column, both from 1, of every key; items of a list count as keys, by their number or, in a
            list of tables that all have a name of their own, by that name.
    """

    path: Path
    text: str
    data: dict[str, Any]
    error: type[BrmgeoError] = SettingsError
    places: Mapping[Keys, tuple[Path, int, int]] = field(default_factory=dict, repr=False)

    @property
    def lines(self) -> list[str]:
        """The file's lines."""
        return self.text.split("\n")

    def where(self, *keys: str | int) -> tuple[int, int]:
        """Line and column, from 1, of a key, or of the nearest table above it where it is missing."""
        place = self._place(keys)
        return place[1:] if place else (1, 1)

    def refuse(self, message: str, *keys: str | int) -> BrmgeoError:
        """The error ``file:line: key: message``, to be raised by the caller."""
        return _refusal(self, [(keys, message)], str(self.path))

    def over(self, below: Toml) -> Toml:
        """This file on top of another: tables are merged key by key, lists of named tables by their names, anything else
        is replaced. Places stay those of the file that says it.
        """
        places = {**below.places, **self.places}
        return dataclasses.replace(self, data=_merged(below.data, self.data), places=places)

    def _place(self, keys: Keys) -> tuple[Path, int, int] | None:
        named = _named(self.data, keys)
        found = (self.places.get(named[:n]) for n in range(len(named), 0, -1))
        return next((place for place in found if place), None)


def read_toml(
    path: Path,
    *,
    error: type[BrmgeoError] = SettingsError,
    missing: type[BrmgeoError] = MissingInputError,
) -> Toml:
    """The TOML file at ``path``.

    Args:
        error: the class of what is raised, in one line with file and line, for a file that cannot be read, is no UTF-8, no
            TOML, or nested deeper than ``DEEPEST``.
        missing: the class for a file that is not there.
    """
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        raise missing(f"{path}: there is no such file") from None
    except OSError as fault:
        raise error(f"{path}: cannot be read: {told(fault)}") from None
    try:
        text = raw.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as fault:
        line = raw.count(b"\n", 0, fault.start) + 1
        raise error(f"{path}:{line}: is not UTF-8 text, as TOML must be: save it as UTF-8") from None
    deep = f"tables and lists are nested more than {DEEPEST} deep: lay them out flat"
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        what, _, at = str(fault).rpartition(" (at ")
        numbers = re.findall(r"\d+", at)
        place = f"{numbers[0]}: column {numbers[1]}" if numbers else str(text.rstrip("\n").count("\n") + 1)
        raise error(f"{path}:{place}: not valid TOML: {what}") from None
    except ValueError:
        long = re.search(r"\d{1000,}", text)
        line = text.count("\n", 0, long.start() if long else 0) + 1
        raise error(f"{path}:{line}: not valid TOML: a number has too many digits") from None
    except RecursionError:
        raise error(f"{path}:{_line_of_depth(text)}: {deep}") from None
    if is_deep(data):
        raise error(f"{path}:{_line_of_depth(text)}: {deep}")
    places = {}
    for keys, offset in _Scan(text).places().items():
        line = text.count("\n", 0, offset) + 1
        column = offset - (text.rfind("\n", 0, offset) + 1) + 1
        places[_named(data, keys)] = (path, line, column)
    return Toml(path, text, data, error, places)


def _line_of_depth(text: str) -> int:
    """The line in which brackets or dotted keys first go deeper than they may."""
    depth = 0
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > DEEPEST:
            return number
        for mark in re.findall(r"[\[\]{}]", line):
            depth += 1 if mark in "[{" else -1
            if depth > DEEPEST:
                return number
    return 1


def _are_named(tables: Any) -> TypeGuard[list[dict[str, Any]]]:
    if not (isinstance(tables, list) and all(isinstance(table, dict) for table in tables)):
        return False
    names = [table.get("name") for table in tables]
    return all(isinstance(name, str) for name in names) and len(set(names)) == len(names)


def _named(data: Any, keys: Keys) -> Keys:
    """``keys`` with names in place of numbers in lists of named tables."""
    found: list[str | int] = []
    for key in keys:
        named = isinstance(key, int) and _are_named(data) and key < len(data)
        found.append(data[key]["name"] if named else key)
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            data = None
    return tuple(found)


def _merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in own.items():
        before = base.get(key)
        if isinstance(before, dict) and isinstance(value, dict):
            merged[key] = _merged(before, value)
        elif _are_named(before) and _are_named(value):
            tables = {table["name"]: table for table in before}
            for table in value:
                tables[table["name"]] = _merged(tables.get(table["name"], {}), table)
            merged[key] = list(tables.values())
        else:
            merged[key] = value
    return merged


class _Scan:
    """Offsets of the keys of a text that is known to be TOML."""

    _TOKEN = re.compile(
        r'"{3}(?:[^\\]|\\.)*?"{3,5}' r"|'{3}.*?'{3,5}" r'|"(?:[^"\\]|\\.)*"' r"|'[^']*'"
        r"|\#[^\n]*" r"|[\[\]{}=,.\n]" r"""|[^\s\[\]{}=,.\#"']+""",
        re.DOTALL,
    )  # fmt: skip

    def __init__(self, text: str) -> None:
        found = [(m[0], m.start()) for m in self._TOKEN.finditer(text) if m[0][0] != "#"]
        self.tokens = [*found, ("\n", len(text))]
        self.at = 0
        self.found: dict[Keys, int] = {}

    def places(self) -> dict[Keys, int]:
        table: Keys = ()
        tables: dict[Keys, int] = {}  # of each array of tables, how many there were
        while self.at < len(self.tokens):
            if self._is("\n"):
                self.at += 1
            elif self._is("["):
                offset = self.tokens[self.at][1]
                self.at += 1
                array = self._is("[")
                self.at += array
                table = ()
                names = self._dotted()
                for i, (name, _) in enumerate(names):
                    table += (name,)
                    last = i == len(names) - 1
                    self.found.setdefault(table, offset)
                    if array and last:
                        tables[table] = tables.get(table, 0) + 1
                    if table in tables:
                        table += (tables[table] - 1,)
                        self.found.setdefault(table, offset)
                self.at += 1 + array
            else:
                self._pair(table)
        return self.found

    def _is(self, mark: str) -> bool:
        return self.tokens[self.at][0] == mark

    def _dotted(self) -> list[tuple[str, int]]:
        names = []
        while True:
            token, offset = self.tokens[self.at]
            # TOML's own reader takes the quotes off.
            names.append(
                (token if token[0] not in "\"'" else next(iter(tomllib.loads(f"{token} = 0"))), offset)
            )
            self.at += 1
            if not self._is("."):
                return names
            self.at += 1

    def _pair(self, table: Keys) -> None:
        for name, offset in self._dotted():
            table += (name,)
            self.found.setdefault(table, offset)
        self.at += 1
        self._value(table)

    def _value(self, keys: Keys) -> None:
        if self._is("["):
            for k, _ in enumerate(self._items("]")):
                self.found.setdefault((*keys, k), self.tokens[self.at][1])
                self._value((*keys, k))
        elif self._is("{"):
            for _ in self._items("}"):
                self._pair(keys)
        else:
            while self.tokens[self.at][0] not in (",", "]", "}", "\n"):
                self.at += 1

    def _items(self, end: str) -> Iterator[None]:
        self.at += 1
        while not self._is(end):
            if self.tokens[self.at][0] in ("\n", ","):
                self.at += 1
            else:
                yield
        self.at += 1


# --- values ------------------------------------------------------------------------------------------------------


def build(toml: Toml, model: type[T], base: T | None = None, *, at: Sequence[str] = ()) -> T:
    """The value that a file, or its table ``at``, describes; ``toml.error``, in one line, for what does not fit.

    Args:
        model: a dataclass, whose fields may be of any type that pydantic knows, with constraints as Annotated, and hold
            further dataclasses; or a pydantic model, checked by its own rules. Numbers must be finite, whole numbers are
            welcome where floats are asked for, lists become tuples. A ValueError or SettingsError from
            ``__post_init__`` is told too.
        base: of a dataclass, where what the file leaves out is taken from; None takes the fields' defaults.
    """
    table: Any = toml.data
    for key in at:
        table = table.get(key, {}) if isinstance(table, dict) else {}
    faults: list[_Fault] = []
    value = _made(table, model, base, tuple(at), faults)
    if faults:
        raise _refusal(toml, faults, str(toml.path))
    return typing.cast(T, value)


def checked(model: type[T], values: Mapping[str, Any], what: str) -> T:
    """A dataclass or pydantic model of values that no file holds; SettingsError, beginning with ``what``, as ``build``."""
    faults: list[_Fault] = []
    value = _made(dict(values), model, None, (), faults)
    if faults:
        raise _refusal(None, faults, what)
    return typing.cast(T, value)


_Fault = tuple[Keys, str]


def _refusal(toml: Toml | None, faults: Sequence[_Fault], what: str) -> BrmgeoError:
    """One error of the first faults, each with the line it stands in."""
    parts = []
    for keys, message in faults[:_TOLD]:
        place = toml._place(keys) if toml else None
        named = _named(toml.data, keys) if toml else keys
        key = ".".join(map(str, named))
        start = f"{place[0]}:{place[1]}: " if place else f"{what}: "
        parts.append(f"{start}{key + ': ' if key else ''}{message}")
    return (toml.error if toml else SettingsError)("; ".join(parts))


def _made(values: Any, model: Any, base: Any, at: Keys, faults: list[_Fault]) -> Any:
    inner = _model_in(model)
    if not dataclasses.is_dataclass(inner):
        return _by_pydantic(values, model, at, faults)
    if typing.get_origin(model) is tuple:
        if not isinstance(values, list | tuple):
            faults.append((at, f"must be a list of tables{_shown(values)}"))
            return ()
        return tuple(_made(v, inner, None, (*at, k), faults) for k, v in enumerate(values))
    if values is None and model is not inner:
        return None
    if not isinstance(values, dict):
        faults.append((at, f"must be a table{_shown(values)}"))
        return None
    before = len(faults)
    hints = _hints(inner)
    given = {}
    for key, value in values.items():
        if key not in hints:
            faults.append(((*at, key), f"unknown key; {nearest(key, list(hints))}"))
        else:
            own = getattr(base, key) if base is not None else None
            given[key] = _made(value, hints[key], own, (*at, key), faults)
    if base is None:
        faults += [((*at, key), _MISSING) for key in _required(inner) if key not in values]
    if len(faults) > before:
        return None
    try:
        return inner(**given) if base is None else dataclasses.replace(base, **given)
    except (ValueError, SettingsError) as error:
        faults.append((at, str(error)))
        return None


_MISSING = "missing key; it is required"


def _by_pydantic(values: Any, model: Any, at: Keys, faults: list[_Fault]) -> Any:
    try:
        return _adapter(model).validate_python(_tuples(values))
    except ValidationError as error:
        for fault in error.errors():
            keys = (*at, *fault["loc"])
            if fault["type"] == "extra_forbidden":
                message = f"unknown key; {nearest(str(keys[-1]), _siblings(model, fault['loc']))}"
            elif fault["type"] == "missing" and isinstance(keys[-1], int):
                keys, message = keys[:-1], "has too few items" + _shown(fault["input"])
            elif fault["type"] == "missing":
                message = _MISSING
            else:
                message = fault["msg"].removeprefix("Value error, ") + _shown(fault["input"])
            faults.append((keys, message))
        return None


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    own = isinstance(_model_in(model), type)
    return TypeAdapter(model, config=None if own else _STRICT)


@cache
def _hints(model: Any) -> dict[str, Any]:
    """The types of a dataclass's settings; names that begin with _ are none."""
    hints = typing.get_type_hints(model, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(model) if f.init and f.name[0] != "_"}


def _required(model: Any) -> list[str]:
    absent = dataclasses.MISSING
    return [
        f.name
        for f in dataclasses.fields(model)
        if f.name in _hints(model) and f.default is absent and f.default_factory is absent
    ]


def _model_in(hint: Any) -> type | None:
    """The dataclass or pydantic model that a type is, or is a tuple of, or of which it may be None."""
    if isinstance(hint, type) and (dataclasses.is_dataclass(hint) or issubclass(hint, BaseModel)):
        return hint
    if typing.get_origin(hint) in (tuple, typing.Union, types.UnionType, typing.Annotated):
        return next((found for part in typing.get_args(hint) if (found := _model_in(part))), None)
    return None


def _siblings(model: Any, keys: Keys) -> list[str]:
    """The keys that a pydantic model knows at the table of ``keys``."""
    for key in keys[:-1]:
        inner = _model_in(model)
        if isinstance(key, str) and inner is not None and issubclass(inner, BaseModel):
            field_info = inner.model_fields.get(key)
            model = field_info.annotation if field_info else None
    inner = _model_in(model)
    return list(inner.model_fields) if inner is not None and issubclass(inner, BaseModel) else []


def _tuples(value: Any) -> Any:
    """Lists as tuples: settings are frozen."""
    if isinstance(value, dict):
        return {key: _tuples(v) for key, v in value.items()}
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def _lists(value: Any) -> Any:
    return [_lists(v) for v in value] if isinstance(value, list | tuple) else value


def _shown(value: Any) -> str:
    """What was found, as a person wrote it; a table is not shown."""
    if isinstance(value, dict | BaseModel):
        return ""
    told = str(value).lower() if isinstance(value, bool) else repr(_lists(value))
    return f" (found {told if len(told) <= 80 else told[:77] + '...'})"
