"""Runs of `brmgeo maps` after the first: nothing to do, what changed, other schedulers, and runs that were killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image
from small_maps import SHEETS, SmallRegion, brmgeo, rasters_of

from pipelines import map_stages

STAGES = (
    *(f"outlines {s}" for s in SHEETS),
    "lattice",
    "footprints",
    "imagery",
    "buildings",
    "ratio",
    "overview",
)
Capture = pytest.CaptureFixture[str]


def states(region: SmallRegion, capsys: Capture) -> dict[str, str]:
    """State of each stage as `brmgeo status` tells it."""
    said = brmgeo(capsys, "status", "small", "--data", region.data)
    assert said.status == 0, said.err
    lines = [line for line in said.out.splitlines() if not line.startswith(" ")]
    return {m[1].strip(): m[2] for line in lines if (m := re.match(r"(.+?) +(\w+) +\w{12}$", line))}


def looks(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_mtime_ns, p.stat().st_ino) for p in folder.rglob("*")}


def test_warm_run_computes_nothing_and_says_so(built: SmallRegion, capsys: Capture) -> None:
    before = looks(built.out), looks(built.data / "work" / "artifacts")
    said = brmgeo(capsys, "maps", "small", "--data", built.data)
    assert said.status == 0
    assert said.err.strip() == (
        f"small: nothing to do, all {len(STAGES)} stages are fresh; results are in {built.out}"
    )
    assert before == (looks(built.out), looks(built.data / "work" / "artifacts"))
    assert states(built, capsys) == dict.fromkeys(STAGES, "fresh")


def test_a_changed_radius_makes_only_the_ratio_maps_again(
    built: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = built.copied_to(tmp_path / "data")
    region.edit("radii_m = [40.0, 17.3]", "radii_m = [40.0, 12]")
    stale = {stage for stage, state in states(region, capsys).items() if state != "fresh"}
    assert stale == {"ratio", "overview"}
    why = brmgeo(capsys, "why", "small", "ratio", "--data", region.data).out
    assert "ratio is stale" in why
    assert "[40.0, 17.3] -> [40.0, 12.0]" in why
    assert (
        "ratio gives another result" in brmgeo(capsys, "why", "small", "overview", "--data", region.data).out
    )
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert "small: made ratio, overview;" in said.err
    assert "buildings: start" not in said.err
    assert rasters_of(region.out)["buildings.tif"] == rasters_of(built.out)["buildings.tif"]
    assert rasters_of(region.out)["ratio.tif"] != rasters_of(built.out)["ratio.tif"]


def test_changed_sheets_and_tiles_are_noticed_by_content(
    built: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = built.copied_to(tmp_path / "data")
    sheet, tile = region.sheets / f"{SHEETS[1]}.dxf", sorted(region.tiles.rglob("*.png"))[0]
    os.utime(sheet)
    assert set(states(region, capsys).values()) == {"fresh"}
    sheet.write_bytes(b"999\na comment\n" + sheet.read_bytes())
    found = states(region, capsys)
    assert found[f"outlines {SHEETS[1]}"] == "stale"
    assert found[f"outlines {SHEETS[0]}"] == found["lattice"] == found["imagery"] == "fresh"
    assert found["footprints"] == found["buildings"] == "stale"
    why = brmgeo(capsys, "why", "small", f"outlines {SHEETS[1]}", "--data", region.data).out
    assert f"content changed ({sheet})" in why
    tile.write_bytes(sorted(region.tiles.rglob("*.png"))[1].read_bytes())
    why = brmgeo(capsys, "why", "small", "imagery", "--data", region.data).out
    assert f"1 changed ({tile.relative_to(region.tiles)})" in why
    assert (
        "has no stage 'nonsense'" in brmgeo(capsys, "why", "small", "nonsense", "--data", region.data).error
    )


def test_tiles_of_twice_the_pixels_are_taken_where_the_region_says_so(
    built: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = built.copied_to(tmp_path / "data")
    for path in region.tiles.rglob("*.png"):
        with Image.open(path) as tile:
            tile.resize((512, 512), Image.Resampling.NEAREST).save(path)
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert "512 x 512 px, wanted 256 x 256: state pixel_ratio = 2" in said.error
    region.edit("level =", "pixel_ratio = 2\nlevel =")
    assert brmgeo(capsys, "maps", "small", "--data", region.data).status == 0
    pictures = []
    for out in (built.out, region.out):
        with rasterio.open(out / "imagery.tif") as src:
            pictures.append(src.read().astype(float))
    assert np.abs(pictures[0] - pictures[1]).mean() < 2.0


def test_damage_in_the_store_is_found_and_mended(built: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    region = built.copied_to(tmp_path / "data")
    victim = next((region.data / "work" / "artifacts" / "buildings").rglob("buildings.tif"))
    victim.write_bytes(victim.read_bytes()[:1000])
    assert states(region, capsys)["buildings"] == "damaged"
    assert brmgeo(capsys, "maps", "small", "--data", region.data).status == 0
    assert rasters_of(region.out) == rasters_of(built.out)
    assert states(region, capsys) == dict.fromkeys(STAGES, "fresh")


def test_results_that_were_removed_come_back_and_those_that_were_edited_stay(
    built: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = built.copied_to(tmp_path / "data")
    (region.out / "ratio.tif").unlink()
    (region.out / "maps.json").unlink()
    project = region.out / "small.qgz"
    project.write_bytes(b"edited")
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert said.status == 0
    assert f"{project}: changed since brmgeo wrote it, and left as it is" in said.err
    assert project.read_bytes() == b"edited"
    assert rasters_of(region.out) == rasters_of(built.out)
    assert (region.out / "maps.json").is_file()


@pytest.mark.slow
def test_two_workers_and_small_blocks_give_the_same_bytes(
    built: SmallRegion, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    region = built.copied_to(tmp_path / "data", store=False)
    monkeypatch.setattr(map_stages, "BLOCK_PX", 256)
    monkeypatch.setenv("SCHEDULER", "local")
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert said.status == 0, said.err
    assert "workers of" in said.err
    assert "ratio: done, 12 items" in said.err
    assert rasters_of(region.out) == rasters_of(built.out)


def killed_at(region: SmallRegion, marker: str, after_s: float) -> None:
    """Starts a run, waits for a line of its progress and a little longer, and kills it and its workers' parent."""
    run = subprocess.Popen(
        [sys.executable, "-m", "pipelines.cli", "maps", "small", "--data", str(region.data)],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stderr is not None
    for line in run.stderr:
        assert "nothing to do" not in line
        if line.startswith(marker):
            break
    time.sleep(after_s)
    run.send_signal(signal.SIGKILL)
    run.stderr.close()
    assert run.wait() == -signal.SIGKILL


def finished_alike(region: SmallRegion, built: SmallRegion, capsys: Capture) -> None:
    said = brmgeo(capsys, "maps", "small", "--data", region.data)
    assert said.status == 0, said.err
    assert rasters_of(region.out) == rasters_of(built.out)
    assert not list((region.data / "work" / "tmp").iterdir())
    assert set(states(region, capsys).values()) == {"fresh"}


def test_a_killed_run_is_finished_by_the_next(built: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    region = built.copied_to(tmp_path / "data", store=False)
    killed_at(region, "imagery: start", 0.1)
    assert states(region, capsys)["footprints"] == "fresh"
    assert states(region, capsys)["ratio"] == "missing"
    finished_alike(region, built, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("scheduler", ["serial", "local"])
def test_runs_killed_at_many_moments_end_alike(
    built: SmallRegion, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, scheduler: str
) -> None:
    region = built.copied_to(tmp_path / "data", store=False)
    monkeypatch.setenv("SCHEDULER", scheduler)
    for marker in (
        "outlines: start",
        "lattice",
        "footprints: start",
        "imagery: start",
        "buildings: start",
        "ratio: start",
    ):
        killed_at(region, marker, 0.15)
    for after_s in (0.0, 0.5):
        killed_at(region, "overview: start", after_s)
    time.sleep(3.0)  # a cluster whose owner was killed needs a moment to notice
    finished_alike(region, built, capsys)
