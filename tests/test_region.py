"""A region file is strict: what it misspells or leaves out is named with file, key and the nearest valid key."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.region import MapSettings, Region, load_region
from brmgeo.settings import checked

GOOD = """
name = "town"
crs = "EPSG:5187"
bounds = [228000, 380000, 230000, 383000]

[footprints]
paths = ["sheets/*.dxf"]

[imagery]
kind = "tiles"
level = 1

[ratio]
n = 3
agl_m = 150
fov_deg = 43
"""


def write(folder: Path, text: str, name: str = "town") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_good_file_gives_a_frozen_region_with_whole_numbers_taken_as_metres(tmp_path: Path) -> None:
    region = load_region(write(tmp_path, GOOD))
    assert region.bounds == (228000.0, 380000.0, 230000.0, 383000.0)
    assert region.gsd_m == 0.5
    with pytest.raises(Exception, match="frozen"):
        region.gsd_m = 1.0  # type: ignore[misc]


def test_radii_follow_equation_3(tmp_path: Path) -> None:
    radii = load_region(write(tmp_path, GOOD)).ratio.radii()
    widest = 150 * math.tan(math.radians(21.5))
    assert radii == pytest.approx([widest, widest * 2 / 3, widest / 3])
    given = GOOD.replace("n = 3\nagl_m = 150\nfov_deg = 43", "radii_m = [20, 59.1]")
    assert load_region(write(tmp_path, given)).ratio.radii() == (59.1, 20.0)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("agl_m = 150", "agl = 150", ["ratio.agl: unknown key", "'agl_m'"]),
        ("level = 1", "levle = 1", ["imagery.levle", "'level'"]),
        ('crs = "EPSG:5187"', "", ["crs: missing key"]),
        ('crs = "EPSG:5187"', 'crs = "5187"', ["crs", "EPSG:5187"]),
        ("[ratio]", "gsd_mm = 1\n[ratio]", ["imagery.gsd_mm: unknown key"]),
        ('name = "town"', 'name = "twon"', ["name", "'twon'", "'town'"]),
        ("fov_deg = 43", "fov_deg = 190", ["ratio.fov_deg", "less than 180", "190"]),
        ("n = 3\n", "n = 3\nradii_m = [20]\n", ["either 'radii_m'"]),
        ("bounds = [228000, 380000, 230000, 383000]", "", ["'bounds' or 'sheets'"]),
        ("228000, 380000, 230000", "230000, 380000, 228000", ["left < right"]),
        ("228000, 380000,", "nan, 380000,", ["bounds"]),
        ('paths = ["sheets/*.dxf"]', 'layers = ["B0014119"]', ["B0014119", "not a building"]),
        ('kind = "tiles"', 'kind = "service"', ["'url'"]),
        ('name = "town"', 'name = "town"\nsheets = ["36914093", "369"]', ["'369'", "sheet number"]),
        ('name = "town"', "name = town", ["not valid TOML"]),
    ],
)
def test_a_fault_is_one_line_with_file_key_and_remedy(
    tmp_path: Path, old: str, new: str, said: list[str]
) -> None:
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(SettingsError) as caught:
        load_region(path)
    message = str(caught.value)
    assert "\n" not in message
    assert "town.toml" in message
    for part in said:
        assert part in message


def test_an_unknown_region_names_the_nearest_one(tmp_path: Path) -> None:
    write(tmp_path, GOOD)
    with pytest.raises(MissingInputError, match="did you mean 'town'"):
        load_region(tmp_path / "tonw.toml")


def test_embedded_regions_load() -> None:
    folder = Path(__file__).resolve().parents[1] / "data" / "regions"
    regions: list[Region] = [
        load_region(p) for p in sorted(folder.glob("*.toml")) if not p.stem.startswith("_")
    ]
    assert {"demo", "daegwallyeong"} <= {r.name for r in regions}


def test_a_region_has_a_place_where_maps_alone_may_leave_it_to_the_footprints() -> None:
    asked = {"name": "town", "crs": "EPSG:5187"}
    assert checked(MapSettings, asked, "maps").bounds is None
    with pytest.raises(SettingsError, match=r"^region: give 'bounds' or 'sheets'"):
        checked(Region, asked, "region")
    for kind in (MapSettings, Region):
        with pytest.raises(SettingsError, match="left < right and bottom < top"):
            checked(kind, asked | {"bounds": (9.0, 9.0, 1.0, 1.0)}, "maps")


@pytest.mark.parametrize(
    ("kind", "key", "said"),
    [
        ("mbtiles", 'grid = "kakao"', "an MBTiles file is in grid 'webmercator'"),
        ("mbtiles", 'template = "{z}/{x}"', "'template' does not go with kind 'mbtiles'"),
        ("raster", "pixel_ratio = 2", "'level' does not go with kind 'raster'"),
        ("tiles", 'key_env = "K"', "'key_env' does not go with kind 'tiles'"),
        ("tiles", 'crs = "EPSG:5187"', "'crs' does not go with kind 'tiles'"),
    ],
)
def test_a_key_of_imagery_that_would_be_ignored_is_refused(
    tmp_path: Path, kind: str, key: str, said: str
) -> None:
    text = GOOD.replace('kind = "tiles"', f'kind = "{kind}"\n{key}')
    with pytest.raises(SettingsError, match=said):
        load_region(write(tmp_path, text))
