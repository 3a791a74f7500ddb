"""The documentation says what the program does: its commands parse, its links lead somewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from pipelines.cli import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"])
PAGES = [page for page in PAGES if "_build" not in page.parts and "api" not in page.parts]


def commands() -> list[tuple[str, str]]:
    """(page, command) of every line that a reader could type."""
    found = []
    for page in PAGES:
        for line in page.read_text(encoding="utf-8").splitlines():
            typed = re.match(r"(?:\$ |\.venv/bin/)(brmgeo .*)", line)
            if typed:
                found.append((page.name, typed[1].split("   #")[0].strip()))
    return found


@pytest.mark.parametrize(("page", "typed"), commands())
def test_every_command_that_is_shown_parses(page: str, typed: str) -> None:
    _, name, *arguments = shlex.split(typed.replace("[--imagery ortho.tif]", "--imagery ortho.tif"))
    command = cli.commands[name]
    try:
        command.make_context(name, arguments)
    except click.ClickException as error:
        pytest.fail(f"{page}: {typed}: {error.format_message()}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
