"""The files of a generated region do not depend on who paints them."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from brmgeo.errors import SettingsError
from brmgeo.geo.tilegrid import KakaoGrid
from brmgeo.synth.region import write_region

BOUNDS = (195330.0, 446100.0, 195730.0, 446500.0)
SHEETS = ("36808058", "36808059")


def digests(folder: Path) -> dict[str, str]:
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.mark.slow
def test_files_are_the_same_from_one_process_and_from_two(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.mkdir()
    two.mkdir()
    manifest = write_region(one, BOUNDS, 3, SHEETS, level=2)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:

        def over_two(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
            return reversed(list(pool.map(function, list(items)[::-1])))

        assert write_region(two, BOUNDS, 3, SHEETS, level=2, map=over_two) == manifest
    files = digests(one)
    assert digests(two) == files
    tiles = list(KakaoGrid().covering(BOUNDS, "EPSG:5187", 2, margin_px=4.0))
    expected = {f"tiles/{KakaoGrid().path(t, 2, 'jpg')}" for t in tiles}
    # Nothing but outputs is left.
    assert set(files) == expected | {f"sheets/{s}.dxf" for s in SHEETS} | {"manifest.json"}
    assert manifest["tiles"] == len(expected)
    assert json.loads((one / "manifest.json").read_text(encoding="utf-8")) == manifest
    assert list(manifest["sheets"]) == list(SHEETS)


@pytest.mark.slow
def test_sheets_do_not_depend_on_the_order_of_sets(tmp_path: Path) -> None:
    # Python draws the order of sets of text anew in every process: these two seeds order DXF classes differently.
    script = (
        "import sys; from pathlib import Path; from brmgeo.synth.sheets import write_sheets; "
        "from brmgeo.synth.town import generate_town; "
        f"write_sheets(generate_town({BOUNDS!r}, 3), Path(sys.argv[1]), {SHEETS!r})"
    )
    found = []
    for seed in ("1", "4"):
        out = tmp_path / seed
        subprocess.run(
            [sys.executable, "-c", script, str(out)],
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        )
        found.append(digests(out))
    assert set(found[0]) == {f"{s}.dxf" for s in SHEETS}
    assert found[0] == found[1]


def test_a_region_that_cannot_be_drawn_leaves_no_scratch_file(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="36808001"):
        write_region(tmp_path, BOUNDS, 3, ("36808001",), level=3)
    assert digests(tmp_path) == {}
