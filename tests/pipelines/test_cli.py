"""The command line: what the library needs is said as an option, and what a disk says in words."""

from __future__ import annotations

import ast
import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from small_flights import Said

from brmgeo.errors import InputError
from brmgeo.match import METHODS
from pipelines.cli import METHODS as OFFERED
from pipelines.cli import _Command, cli, last_door, run

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


def test_too_little_memory_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    told = _told(capsys, _fail(MemoryError("Unable to allocate 2.00 TiB for an array")))
    assert told.startswith("brmgeo: the memory of this machine is not enough (Unable to allocate 2.00 TiB")


def test_a_defect_is_a_line_that_says_how_to_report_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert last_door(_fail(ZeroDivisionError("division\nby zero")), ["maps", "demo"]) == 70
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "ZeroDivisionError: division by zero" in told
    assert "test_cli.py" in told
    assert "--traceback" in told


def test_the_traceback_of_a_defect_is_shown_on_demand(capsys: pytest.CaptureFixture[str]) -> None:
    assert last_door(_fail(ZeroDivisionError("division by zero")), ["maps", "--traceback"]) == 70
    told = capsys.readouterr().err
    assert told.startswith("Traceback (most recent call last)")
    assert told.endswith("to its maintainers\n")


@pytest.mark.parametrize("words", [["--traceback", "maps"], ["maps", "--traceback"]])
def test_the_traceback_can_be_asked_for_before_and_after_the_command(words: list[str]) -> None:
    assert run(lambda: cli(words, standalone_mode=False)) == 2


def test_a_defect_passes_where_tests_would_see_it() -> None:
    with pytest.raises(ZeroDivisionError):
        run(_fail(ZeroDivisionError()))


def test_a_name_that_the_terminal_cannot_write_is_escaped(tmp_path: Path) -> None:
    odd = os.fsencode(tmp_path) + b"/\xeb\xb0\xff.toml"
    got = subprocess.run(
        [sys.executable, "-m", "brmgeo", "maps", os.fsdecode(odd)], capture_output=True, cwd=ROOT,
        env={**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0"},
    )  # fmt: skip
    assert got.returncode == 2
    assert got.stderr.startswith(b"brmgeo: ")
    assert got.stderr.count(b"\n") == 1


def test_the_methods_offered_are_those_that_there_are() -> None:
    # The command line starts without the kernels, so it has a list of its own.
    assert sorted(OFFERED) == sorted(METHODS)


def test_every_need_of_the_library_is_a_parameter_of_some_command() -> None:
    known: set[str | None] = {param.name for command in cli.commands.values() for param in command.params}
    # What a program aboard alone can give.
    known |= {"reset_speed_m_s", "masks", "answer", "mount_sigma_rad"}
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


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("localize --maps MAPS --flight FLIGHT --seed 3 --out OUT", "--seed"),
        ("simulate --maps MAPS --no-odometry --scale-bias 0.1 --out OUT", "--scale-bias"),
        ("evaluate --results OUT --methods mask", "--methods"),
        ("evaluate town --results OUT", r"\[REGION\]"),
        ("odometry FLIGHT --every 3", "--every"),
    ],
)
def test_an_option_that_another_one_shadows_is_refused(
    words: str, option: str, say: Callable[..., Said], tmp_path: Path
) -> None:
    told = say(*(str(tmp_path) if w.isupper() else w for w in words.split()))
    assert told.code == 2
    assert re.match(rf"brmgeo: {words.split()[0]}: {option} .*leave one out|.*both or none", told.line)
    assert say("evaluate", "--results", tmp_path, "--traceback").line.startswith(f"brmgeo: {tmp_path}")


@pytest.mark.parametrize(
    "words", ["simulate --maps OUT --out OUT --count", "evaluate --maps OUT --out OUT --flights"]
)
def test_flights_without_end_are_refused(words: str, say: Callable[..., Said], tmp_path: Path) -> None:
    told = say(*(tmp_path if w == "OUT" else w for w in words.split()), 10**9)
    assert told.code == 2
    assert "is not in the range 1<=x<=100000" in told.err
