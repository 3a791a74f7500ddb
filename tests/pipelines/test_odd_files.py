"""Every file and folder that a command takes, in place of it what is none: one line, and no traceback."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_flights import CRS, Said

# ODD is what the odd thing stands for, with the suffix that makes a reader look at it.
COMMANDS = {
    "maps": "maps ODD.toml --data NEW",
    "footprints": f"maps --footprints ODD --crs {CRS} --out NEW --scheduler serial",
    "footprints.dxf": f"maps --footprints ODD.dxf --crs {CRS} --out NEW --scheduler serial",
    "footprints.shp": f"maps --footprints ODD.shp --crs {CRS} --out NEW --scheduler serial",
    "footprints.geojson": f"maps --footprints ODD.geojson --crs {CRS} --out NEW --scheduler serial",
    "footprints.parquet": f"maps --footprints ODD.parquet --crs {CRS} --out NEW --scheduler serial",
    "imagery": f"maps --footprints MAPS/footprints.gpkg --crs {CRS} --imagery ODD.tif --out NEW --scheduler serial",
    "pairs": "tiles --pairs ODD ODD --gsd 0.3 --attribution a --out NEW --scheduler serial",
    "recipe": "train --recipe ODD.toml --out NEW",
    "start": "train --start ODD.safetensors --out NEW",
    "source": "train --recipe shipped --source kampala=ODD --out NEW",
    "segment": "segment ODD --out NEW",
    "segment.tif": "segment ODD.tif --out NEW.tif",
    "weights": "segment FLIGHT --weights ODD.onnx --out NEW",
    "tensors": "segment FLIGHT --weights ODD.safetensors --out NEW",
    "export-onnx": "export-onnx ODD.safetensors --out NEW.onnx",
    "simulate path": "simulate --maps MAPS --path ODD.geojson --mode masks --out NEW",
    "simulate maps": "simulate --maps ODD --mode masks --out NEW",
    "simulate settings": "simulate --maps MAPS --settings ODD.toml --mode masks --out NEW",
    "localize maps": "localize --maps ODD --flight FLIGHT --out NEW",
    "localize flight": "localize --maps MAPS --flight ODD --out NEW",
    "localize weights": "localize --maps MAPS --flight FLIGHT --weights ODD.onnx --out NEW",
    "evaluate": "evaluate --maps ODD --flights 1 --out NEW",
    "evaluate results": "evaluate --results ODD --out NEW",
    "export": "export ODD --path online --out NEW.geojson",
    "import": "import ODD --out NEW",
    "import.bin": "import ODD.bin --out NEW",
    "import.ulg": "import ODD.ulg --out NEW",
    "import.bag": "import ODD.bag --out NEW",
    "import.tlog": "import ODD.tlog --out NEW",
    "import.csv": "import ODD.csv --out NEW",
    "import.mp4": "import FLIGHT/odometry.tum --video ODD.mp4 --fov 50 --agl 100 --out NEW",
    "inspect": "inspect ODD",
    "inspect.mcap": "inspect ODD.mcap",
    "odometry": "odometry ODD",
    "status": "status ODD.toml",
    "why": "why ODD.toml mask",
}  # fmt: skip
# Settings may be none at all.
NONE_WRONG = {("simulate settings", "empty"), ("simulate settings", "device")}
KINDS = ("missing", "folder", "empty", "device", "noise", "loop", "odd name")


def _odd(kind: str, path: Path) -> Path:
    """Something at ``path`` that is none of what any command takes."""
    if kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.touch()
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "loop":
        path.symlink_to(path)
    elif kind != "missing":
        if kind == "odd name":
            path = path.with_name(os.fsdecode(b"a\nb\xff") + "가" + path.name)
        path.write_bytes(np.random.default_rng(5).bytes(20_000))
    return path


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_no_file_of_the_kind_is_a_line(
    name: str, say: Callable[..., Said], maps: Path, whole: Path, tmp_path: Path
) -> None:
    for kind in KINDS:
        place = tmp_path / kind
        place.mkdir()
        suffix = re.search(r"ODD(\S*)", COMMANDS[name])
        assert suffix is not None
        odd = _odd(kind, place / f"odd{suffix[1]}")
        stands_for = {f"ODD{suffix[1]}": odd, "NEW": place / "new", "MAPS": maps, "FLIGHT": whole}
        words = COMMANDS[name].split()
        for mark, path in stands_for.items():
            words = [word.replace(mark, str(path)) for word in words]
        told = say(*words)
        if (name, kind) in NONE_WRONG:
            assert told.code == 0, (kind, told)
            continue
        assert told.code == 2, (kind, told)
        last = told.err.splitlines()[-1]
        assert last.startswith("brmgeo: ") or "; see " in last, (kind, told.err)
