"""What stored numbers mean, and constants that several rooms share: each is written here and nowhere else."""

from __future__ import annotations

import re

# Building masks of maps (buildings.tif): uint8.
OTHER, BUILDING, UNKNOWN = 0, 1, 255

# Labels of training tiles and masks of pictures: uint8. Masks of pictures have no unknown.
LABEL_OTHER, LABEL_BUILDING, LABEL_UNKNOWN = 0, 255, 127

# Ratios as stored: uint16 steps of RATIO_SCALE. 0 is a valid ratio, so unknown is not 0.
RATIO_SCALE, RATIO_UNKNOWN = 1e-4, 65535

#: Standard gravity, m/s2.
GRAVITY_M_S2 = 9.80665

#: NGII's building layers and what they hold. A third of all outlines are wall-less: canopies and walkways.
BUILDING_KINDS = {
    "B0014110": "unclassified",
    "B0014111": "non-residential",
    "B0014112": "house",
    "B0014113": "row-house",
    "B0014114": "under-construction",
    "B0014115": "apartment",
    "B0014116": "wall-less",
    "B0014117": "greenhouse",
    "B0014118": "temporary",
}
#: What the vector edition and map users call the kinds.
KOREAN_KINDS = {
    "unclassified": ("미분류",),
    "non-residential": ("주택외건물",),
    "house": ("주택", "일반주택", "단독주택"),
    "row-house": ("연립주택",),
    "under-construction": ("공사중건물",),
    "apartment": ("아파트",),
    "wall-less": ("무벽건물",),
    "greenhouse": ("온실",),
    "temporary": ("가건물",),
}
#: The kind of each of those words.
KIND_OF_NAME = {name: kind for kind, names in KOREAN_KINDS.items() for name in names}
#: Layers that are buildings without being asked for: all but "unclassified".
BUILDING_LAYERS = tuple(code for code in BUILDING_KINDS if code != "B0014110")
#: Bounds a group of houses, and is no building.
GROUP_BOUNDARY_LAYER = "B0014119"
#: The frame of a sheet.
NEATLINE_LAYER = "H0017334"


def layer_code(name: str) -> str:
    """The NGII code of a building layer, "B0014112" for "b0014112" and for the older "4112"; other names as they are."""
    upper = name.strip().upper()
    return f"B001{upper}" if re.fullmatch(r"411\d", upper) else upper


def disc_radii(largest: float, n: int) -> tuple[float, ...]:
    """The n radii of eq. 3, largest first: R, R (n-1)/n, ..., R/n, in the unit of ``largest``."""
    return tuple(largest * (n + 1 - k) / n for k in range(1, n + 1))
