"""Seed, size, scratch and the table of a run by force.

STRESS_SEED repeats a run, STRESS_N sets the damaged files a format, STRESS_KILLS the kills a command, STRESS_OUT the folder
for what fails and for the table.
"""

from __future__ import annotations

import json
import os
import platform
import secrets
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
for room in ("flight", "pipelines", "workflow", "stress"):
    sys.path.insert(0, str(TESTS / room))
from arena import Arena  # noqa: E402

COLUMNS = (
    "tried",
    "accepted",
    "refused",
    "untidy",
    "traceback",
    "long",
    "hang",
    "memory",
    "crash",
    "lost",
    "unseen",
)


def pytest_configure(config: pytest.Config) -> None:
    # Set before workers are started, so that all know the same.
    os.environ.setdefault("STRESS_SEED", str(secrets.randbelow(10**6)))
    if "STRESS_OUT" not in os.environ:
        os.environ["STRESS_OUT"] = tempfile.mkdtemp(prefix="brmgeo-stress-")
    out().mkdir(parents=True, exist_ok=True)


def out() -> Path:
    return Path(os.environ["STRESS_OUT"]).absolute()


def pytest_report_header(config: pytest.Config) -> str:
    return f"STRESS_SEED={os.environ['STRESS_SEED']} STRESS_OUT={out()}"


@pytest.fixture(scope="session")
def seed() -> int:
    return int(os.environ["STRESS_SEED"])


@pytest.fixture(scope="session")
def size() -> int:
    """Damaged files a format."""
    return int(os.environ.get("STRESS_N", "25"))


@pytest.fixture(scope="session")
def kills() -> int:
    """Kills a command."""
    return int(os.environ.get("STRESS_KILLS", "4"))


@pytest.fixture(scope="session")
def located(maps: Path, whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What localize wrote of a flight by the two quick methods; never change it."""
    found = tmp_path_factory.mktemp("located")
    with Arena(found / "scratch") as made:
        for method in ("ratio", "paper"):
            words = (
                "localize",
                "--maps",
                maps,
                "--flight",
                whole,
                "--method",
                method,
                "--out",
                found / "r" / method,
            )
            assert made.run("brmgeo", *words).kind == "accepted"
    return found / "r"


@pytest.fixture
def arena(tmp_path: Path) -> Iterator[Arena]:
    with Arena(tmp_path / "scratch") as made:
        yield made


Tally = Callable[..., None]


@pytest.fixture
def tally() -> Tally:
    """Writes one row of the table: part, name, and counts by column."""

    def write(part: str, name: str, **counts: int) -> None:
        with open(out() / "rows.jsonl", "a") as file:
            file.write(json.dumps({"part": part, "name": name, **counts}) + "\n")

    return write


def rows() -> Iterator[dict[str, str | int]]:
    path = out() / "rows.jsonl"
    if path.is_file():
        # What was run again counts once.
        found = {(r["part"], r["name"]): r for r in map(json.loads, path.read_text().splitlines())}
        yield from (found[key] for key in sorted(found))


def table() -> str:
    """All rows as Markdown, a sum a part, and what they were measured on."""
    commit = subprocess.run(
        ["git", "-C", str(TESTS), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    titles = [{"lost": "silent loss"}.get(c, c) for c in COLUMNS]
    lines = [f"| part | {' | '.join(titles)} |", f"|---|{'--:|' * len(COLUMNS)}"]
    sums: dict[str, Counter[str]] = {}
    for row in rows():
        counts = {c: int(row.get(c, 0)) for c in COLUMNS}
        sums.setdefault(str(row["part"]), Counter()).update(counts)
        lines.append(f"| {row['part']}: {row['name']} | {' | '.join(str(v) for v in counts.values())} |")
    for part, total in sums.items():
        lines.append(f"| **{part}, all** | {' | '.join(str(total[c]) for c in COLUMNS)} |")
    return "\n".join(
        [
            *lines,
            "",
            f"Seed {os.environ['STRESS_SEED']}, commit {commit or 'unknown'}, {os.cpu_count()} cores, "
            f"{platform.system()} {platform.machine()}, Python {platform.python_version()}.",
        ]
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    text = table()
    (out() / "table.md").write_text(text + "\n")
    terminalreporter.write_line(text)
    terminalreporter.write_line(f"faults and table: {out()}")
