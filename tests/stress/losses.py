"""Records damaged in place: what a reader could not take of an accepted file, it says with how many."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from arena import Arena
from cases import cases, counted
from conftest import out
from damage import flip, overwrite
from formats import FORMATS, seed_of

COUNTED = [
    name for name in FORMATS
    if name.startswith(("ULog", "Ardu", "MAV", "ROS", "video", "geotagged", "odometry,", "Geo", "shape", "Flat", "DXF"))
    and not name.startswith("GeoTIFF")
]  # fmt: skip


@pytest.mark.parametrize("name", COUNTED)
def test_what_is_not_taken_is_told(
    name: str,
    tmp_path: Path,
    arena: Arena,
    request: pytest.FixtureRequest,
    seed: int,
    size: int,
    tally: Callable[..., None],
) -> None:
    made = seed_of(name, tmp_path / "seed", request)
    rng = np.random.default_rng([seed, 1, zlib.crc32(name.encode())])

    def damage(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
        way = flip if rng.random() < 0.7 else overwrite
        return way.__name__, way(data, rng, made.head)

    found = cases(made, arena, tmp_path, rng, size, damage)
    counts, faults = counted("records", name, made, found, out())
    tally("records", name, **counts)
    assert not faults, "\n".join([f"STRESS_SEED={seed}", *faults])


@pytest.mark.parametrize("name", ["frames, JPEG", "frames, PNG"])
def test_a_picture_that_its_decoder_warns_of_is_not_taken_in_silence(
    name: str,
    tmp_path: Path,
    arena: Arena,
    request: pytest.FixtureRequest,
    seed: int,
    size: int,
    tally: Callable[..., None],
) -> None:
    made = seed_of(name, tmp_path / "seed", request)
    rng = np.random.default_rng([seed, 2, zlib.crc32(name.encode())])
    sound = {path: cv2.imread(str(path)) for path in made.files}
    damaged, seen, faults = tmp_path / f"d{made.files[0].suffix}", Counter[str](), []
    found = cases(made, arena, tmp_path, rng, 4 * size, lambda data, rng: ("flip", flip(data, rng)))
    for case in found:
        seen["tried"] += 1
        seen[case.outcome.kind] += 1
        if case.outcome.kind != "accepted" or "damaged" in case.outcome.said:
            continue
        damaged.write_bytes(case.data)
        warned = arena.run("decode", damaged)
        picture, whole = cv2.imread(str(damaged)), sound[case.file]
        if "orrupt" in warned.said or picture is None or picture.shape != whole.shape:
            seen["lost"] += 1
            kept = out() / f"pictures-{case.file.suffix[1:]}-{seen['tried']:03d}{case.file.suffix}"
            kept.write_bytes(case.data)
            faults.append(f"{kept}: {' '.join(warned.said.split())[:200]}")
        else:
            seen["unseen"] += bool(np.mean(np.abs(picture.astype(int) - whole).max(axis=2) > 16) > 0.02)
    tally("records", f"{name}, warnings of the decoder", **seen)
    assert not faults, "\n".join([f"STRESS_SEED={seed}", *faults])
