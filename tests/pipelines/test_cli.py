"""The command line: what the library needs is said as an option, and what a disk says in words."""

from __future__ import annotations

import ast
import errno
import re
from collections.abc import Callable
from pathlib import Path

import click
import pytest

from brmgeo.errors import InputError
from brmgeo.match import METHODS
from pipelines.cli import METHODS as OFFERED
from pipelines.cli import _Command, cli, run

ROOT = Path(__file__).resolve().parents[2]


def _command(raises: Callable[[], object]) -> click.Command:
    option = click.Option(["--source-crs", "source_crs"], help="CRS of the file.")
    return _Command("read", params=[option], callback=lambda source_crs: raises())


def _fail(error: Exception) -> Callable[[], object]:
    def raises() -> object:
        raise error

    return raises


def _told(capsys: pytest.CaptureFixture[str], raises: Callable[[], object]) -> str:
    assert run(lambda: _command(raises).main([], standalone_mode=False)) == 2
    return capsys.readouterr().err


def test_what_is_needed_is_named_as_the_option(capsys: pytest.CaptureFixture[str]) -> None:
    told = _told(capsys, _fail(InputError("a.dxf: states no CRS: give it", needs="source_crs")))
    assert told == "brmgeo: a.dxf: states no CRS: give it (--source-crs TEXT)\n"


def test_a_need_that_this_command_has_no_option_for_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert _told(capsys, _fail(InputError("a.dxf: odd", needs="levels"))) == "brmgeo: a.dxf: odd\n"


def test_a_full_disk_is_a_line_with_the_place(capsys: pytest.CaptureFixture[str]) -> None:
    told = _told(capsys, _fail(OSError(errno.ENOSPC, "No space left on device", "/mnt/a.tif")))
    assert told.startswith("brmgeo: /mnt/a.tif cannot be read or written: the disk is full")


def test_the_methods_offered_are_those_that_there_are() -> None:
    # The command line starts without the kernels, so it has a list of its own.
    assert sorted(OFFERED) == sorted(METHODS)


def test_every_need_of_the_library_is_a_parameter_of_some_command() -> None:
    known: set[str | None] = {param.name for command in cli.commands.values() for param in command.params}
    # What a program aboard alone can give.
    known |= {"reset_speed_m_s", "masks", "answer"}
    found = {}
    for path in sorted((ROOT / "brmgeo").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "needs" and isinstance(node.value, ast.Constant):
                found[node.value.value] = path
    assert {need: path for need, path in found.items() if need not in known} == {}


def test_the_library_names_no_option_and_no_command() -> None:
    """What to type is said by the command line alone: the library is also called by programs."""
    commands = "|".join(map(re.escape, cli.commands))
    mark = re.compile(
        rf"(?<![\w-])--\w|`make |\(make |`brmgeo|\brun brmgeo\b|\bbrmgeo ({commands})\b|\brun ({commands}) again\b"
    )
    named = []
    for path in sorted((ROOT / "brmgeo").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Raise) and node.exc is not None:
                named += [
                    f"{path.relative_to(ROOT)}: {text}" for text in _texts(node.exc) if mark.search(text)
                ]
    assert named == []


def _texts(tree: ast.AST) -> list[str]:
    """The strings of an expression, each whole: an f-string with braces for its values."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            found.append("".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return found
