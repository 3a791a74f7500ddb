"""The survey of training tiles: which are kept, what their ground is like, and by how much their labels are moved."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brmgeo.files import json_of
from brmgeo.geo.grid import Bounds
from brmgeo.segment.tiles import sample_empty


def sampled(found: Sequence[dict[str, Any]], empty_share: float, seed: int) -> dict[str, Any]:
    """Marks the tiles without buildings that are too many of a GSD and split; what then is kept and left out."""
    for g, split in sorted({(t["gsd_m"], t["split"]) for t in found if not t["dropped"]}):
        own = [t for t in found if t["gsd_m"] == g and t["split"] == split and not t["dropped"]]
        empty = [t["key"] for t in own if t["built"] == 0]
        kept = sample_empty(len(own) - len(empty), empty, empty_share, seed)
        for tile in own:
            if tile["built"] == 0 and tile["key"] not in kept:
                tile["dropped"] = "empty"
    dropped = Counter(t["dropped"] or "kept" for t in found)
    return {
        "candidates": len(found),
        "kept": dropped.pop("kept", 0),
        "dropped": dict(sorted(dropped.items())),
    }


def ground_facts(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the ground is like before tiles without buildings are sampled down, from the tiles with map and imagery."""
    known = [t for t in found if t["known"] > 0 and t["dropped"] in (None, "guard")]
    weight = sum(t["known"] for t in known)
    return {
        "tiles": len(known),
        "empty": sum(t["built"] == 0 for t in known),
        "building_share": round(sum(t["built"] * t["known"] for t in known) / weight, 6) if weight else None,
    }


def label_offset(folder: Path, bounds: Bounds) -> tuple[float, float]:
    """(dx, dy) in metres by which the alignment.json in a folder moves the labels of a tile."""
    from brmgeo.segment.alignment import offset_at

    blocks, whole, side = _offsets(folder)
    return offset_at(blocks, whole, side, bounds)


@functools.lru_cache(maxsize=2)
def _offsets(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(n, 4) x, y, dx, dy of the blocks that tell; the region's (dx, dy), zero where it cannot tell; side of a block."""
    text = json_of((folder / "alignment.json").read_bytes())
    told = [
        ((b["bounds"][0] + b["bounds"][2]) / 2, (b["bounds"][1] + b["bounds"][3]) / 2, b["dx_m"], b["dy_m"])
        for b in text["blocks"]
        if b["status"] == "told"
    ]
    whole = text["region"]
    own = (whole["dx_m"], whole["dy_m"]) if whole["status"] == "told" else (0.0, 0.0)
    return np.array(told, dtype=np.float64).reshape(-1, 4), np.array(own), float(whole["block_m"])
