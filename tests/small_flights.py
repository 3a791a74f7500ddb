"""A small town of houses on maps of its own, flights over it, and what the command says of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import click
from click.testing import CliRunner

from brmgeo.synth.flight import MaskErrors, OdometryErrors, SimulationSettings
from pipelines.cli import cli, run

CRS, LEFT, TOP, GSD, ROWS, COLS = "EPSG:5187", 195_000.0, 446_000.0, 0.5, 1000, 1200
REAL = (
    Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "flight-sheffield"
)


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The one line on stderr that a refusal is; progress goes there too, and does not count."""
        lines = [line for line in self.err.splitlines() if line.startswith("brmgeo")]
        assert self.code == 2, self.err
        assert len(lines) == 1, self.err
        return lines[0]


def make_flight(maps: Path, waypoints: Path, out: Path, *words: object) -> Path:
    given = ["simulate", "--maps", maps, "--out", out, "--path", waypoints, "--mode", "masks", *words]
    assert run(lambda: cli([str(w) for w in given], standalone_mode=False)) == 0
    return out


def exact(settings: SimulationSettings) -> SimulationSettings:
    """The same flight with perfect instruments and masks."""
    odometry = None if settings.odometry is None else OdometryErrors.none()
    return replace(
        settings, attitude_error_deg=0.0, agl_error_m=0.0, masks=MaskErrors.none(), odometry=odometry
    )


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, (path, old)
    path.write_text(text.replace(old, new, 1))


def command(*arguments: object) -> tuple[int, str]:
    """Exit status and what was printed, as the command ``brmgeo`` would have it."""
    status = -1

    def whole() -> None:
        nonlocal status
        status = run(lambda: cli([str(a) for a in arguments], standalone_mode=False))

    result = CliRunner().invoke(click.Command("brmgeo", callback=whole))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return status, result.output
