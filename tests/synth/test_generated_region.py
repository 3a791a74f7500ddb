"""The files of a generated region do not depend on who paints them."""

from __future__ import annotations

import hashlib
import json
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


def test_a_region_that_cannot_be_drawn_leaves_no_scratch_file(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="36808001"):
        write_region(tmp_path, BOUNDS, 3, ("36808001",), level=3)
    assert digests(tmp_path) == {}
