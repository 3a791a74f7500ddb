"""How commands end: told to by a signal they tidy up, and what is no number ends them before they begin."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import psutil
import pytest

from pipelines import cli

ROOT = Path(__file__).resolve().parents[2]
WORKING = """
import sys, time
from brmgeo import files
from brmgeo.workflow.schedule import scheduler
from pipelines import cli

def work():
    with files.scratch_folder("test") as folder, scheduler(sys.argv[1], workers=2, shared=folder) as map:
        for i in map(slow, range(1000)):
            if i == 0:
                print(folder, flush=True)

def slow(i):
    time.sleep(0.05)
    return i

if __name__ == "__main__":
    cli.clean_up_when_told_to_end()
    sys.exit(cli.run(lambda: cli.click.Command("work", callback=work).main([], standalone_mode=False)))
"""


def working(tmp_path: Path, spec: str) -> tuple[subprocess.Popen[str], Path]:
    """A command in the middle of its work, and its scratch folder."""
    script = tmp_path / "work.py"
    script.write_text(WORKING)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    run = subprocess.Popen(
        [sys.executable, str(script), spec],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {"TMPDIR": str(scratch), "PYTHONPATH": str(ROOT)},
        start_new_session=True,
        # The tests themselves may run under nohup, which a command inherits.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    assert run.stdout is not None
    line = run.stdout.readline()
    assert line, run.communicate()[1]
    return run, Path(line.strip())


@pytest.mark.parametrize(
    ("number", "spec"),
    [
        (signal.SIGTERM, "serial"),
        (signal.SIGHUP, "serial"),
        pytest.param(signal.SIGTERM, "local", marks=pytest.mark.slow),
    ],
)
def test_a_run_that_is_told_to_end_leaves_no_scratch_and_no_workers(
    number: signal.Signals, spec: str, tmp_path: Path
) -> None:
    run, folder = working(tmp_path, spec)
    assert folder.is_dir()
    family = psutil.Process(run.pid).children(recursive=True)
    assert (len(family) >= 2) == (spec == "local")
    run.send_signal(number)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    told = "brmgeo: interrupted; what was finished is kept, the next run goes on from there\n"
    assert errors == ("" if number == signal.SIGHUP else told)
    assert not list(folder.parent.iterdir())
    _, alive = psutil.wait_procs(family, timeout=20)
    assert alive == [], "workers outlived their run"


def numbers() -> Iterator[tuple[str, click.Option, str]]:
    """Every option of every command that takes numbers, with words that are floats to Python but no numbers."""
    for name, command in cli.cli.commands.items():
        for option in command.params:
            if not isinstance(option, click.Option):
                continue
            if isinstance(option.type, click.types.FloatParamType):
                count = 1
            elif isinstance(option.type, cli._Numbers):
                count = option.type.count or 1
            else:
                continue
            for word in ("nan", "inf", "-inf"):
                yield name, option, ",".join([word] * count)


@pytest.mark.parametrize(
    ("name", "option", "text"),
    list(numbers()),
    ids=lambda v: v.opts[0] if isinstance(v, click.Option) else str(v),
)
def test_numbers_are_finite(
    name: str, option: click.Option, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = cli.cli.commands[name]
    words = ["x" for p in command.params if isinstance(p, click.Argument) and p.required]
    for other in command.params:
        if isinstance(other, click.Option) and other.required:
            words += [other.opts[0], "out.tif"]
    status = cli.run(lambda: cli.cli.main([name, *words, f"{option.opts[0]}={text}"], standalone_mode=False))
    told = capsys.readouterr().err
    assert status == 2
    assert told.count("\n") == 1
    assert option.opts[0] in told
    assert "finite numbers" in told or "is not in the range" in told
