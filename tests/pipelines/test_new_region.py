"""`brmgeo new-region`: belt, extents and sheets worked out, and what the new region still wants."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_maps import brmgeo

from brmgeo.region import Region, load_region

REGIONS = Path(__file__).resolve().parents[2] / "data" / "regions"
PAPER = (174_196.0, 562_020.0, 176_397.0, 564_797.0)
PAPER_SHEETS = ("37807029", "37807030", "37807039", "37807040")
Capture = pytest.CaptureFixture[str]


def region(data: Path, name: str) -> Region:
    return load_region(data / "regions" / f"{name}.toml")


def test_from_sheets(capsys: Capture, tmp_path: Path) -> None:
    said = brmgeo(
        capsys,
        "new-region",
        "pyeongchang",
        "--data",
        tmp_path,
        "--sheets",
        "37807039, 37807040",
        "--title",
        '평창 "군"',
    )
    assert said.status == 0, said.err
    made = region(tmp_path, "pyeongchang")
    assert made.crs == "EPSG:5187"
    assert made.sheets == ("37807039", "37807040")
    assert made.title == '평창 "군"'
    assert "2 of 2 sheets are missing: 37807039, 37807040" in said.out
    assert str(tmp_path / "source" / "pyeongchang") in said.out


def test_from_degrees_and_from_metres(capsys: Capture, tmp_path: Path) -> None:
    words = ("--data", tmp_path, "--bounds")
    assert brmgeo(capsys, "new-region", "deg", *words, "128.708,37.658,128.732,37.682").status == 0
    assert (
        brmgeo(capsys, "new-region", "met", *words, ",".join(map(str, PAPER)), "--crs", "epsg:5187").status
        == 0
    )
    for name in ("deg", "met"):
        made = region(tmp_path, name)
        assert made.crs == "EPSG:5187"
        assert made.sheets == PAPER_SHEETS
        assert made.bounds is not None
        for side, wanted in zip(made.bounds, PAPER):
            assert side == pytest.approx(wanted, abs=80 if name == "deg" else 0)


@pytest.mark.parametrize(("lon", "crs"), [(126.5, "EPSG:5186"), (125.5, "EPSG:5185"), (131.0, "EPSG:5188")])
def test_the_belt_follows_from_the_longitude(capsys: Capture, tmp_path: Path, lon: float, crs: str) -> None:
    box = f"{lon},37.4,{lon + 0.01},37.41"
    assert brmgeo(capsys, "new-region", "r", "--data", tmp_path, "--bounds", box).status == 0
    assert region(tmp_path, "r").crs == crs


def test_the_template_that_is_named_is_there(capsys: Capture, tmp_path: Path) -> None:
    words = ("new-region", "r", "--data", tmp_path)
    assert brmgeo(capsys, *words, "--sheets", "37807039").status == 0
    written = (tmp_path / "regions" / "r.toml").read_text(encoding="utf-8")
    assert f"see {REGIONS / '_template.toml'} for every key" in written
    far = ("new-region", "far", "--data", tmp_path, "--bounds", "10,50,10.1,50.1")
    assert f"copy {REGIONS / '_template.toml'} and" in brmgeo(capsys, *far).error
    own = tmp_path / "regions" / "_template.toml"
    own.touch()
    assert f"copy {own} and" in brmgeo(capsys, *far).error


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "either --sheets or --bounds"),
        (("--sheets", "37807039", "--bounds", "1,2,3,4"), "either --sheets or --bounds"),
        (("--sheets", "378"), "not a sheet number"),
        (("--sheets", "37807039,36703011"), "one belt"),
        (("--bounds", "10,50,10.1,50.1"), "outside Korea"),
        (("--bounds", "0,0,9,9", "--crs", "EPSG:32632"), "outside Korea"),
        (("--bounds", "128.8,37.6,128.7,37.7"), "left < right"),
        (("--bounds", "174196,562020,176397,564797"), "not degrees"),
        (("--bounds", "124,34,130,38"), "smaller bounds"),
        (("--bounds", "1,2,3,4", "--crs", "metres"), "METRES"),
        (("--bounds", "1,2,x,4"), "--bounds"),
    ],
)
def test_faulty_wishes(capsys: Capture, tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    said = brmgeo(capsys, "new-region", "r", "--data", tmp_path, *words)
    assert told.lower() in said.error.lower()
    assert not list(tmp_path.rglob("*.toml"))


def test_names_and_places(capsys: Capture, tmp_path: Path) -> None:
    sheets = ("--sheets", "37807039")
    assert "letters" in brmgeo(capsys, "new-region", "../r", "--data", tmp_path, *sheets).error
    assert brmgeo(capsys, "new-region", "r", "--data", tmp_path, *sheets).status == 0
    before = (tmp_path / "regions" / "r.toml").read_bytes()
    assert "exists" in brmgeo(capsys, "new-region", "r", "--data", tmp_path, *sheets).error
    assert (tmp_path / "regions" / "r.toml").read_bytes() == before
    assert "cannot be written" in brmgeo(capsys, "new-region", "r", "--data", "/proc", *sheets).error
    assert [p.name for p in (tmp_path / "regions").iterdir()] == ["r.toml"]


def test_the_papers_region_says_what_it_wants(capsys: Capture, tmp_path: Path) -> None:
    (tmp_path / "regions").mkdir()
    shutil.copy(REGIONS / "daegwallyeong.toml", tmp_path / "regions")
    for command in (
        ("maps", "daegwallyeong"),
        ("status", "daegwallyeong"),
        ("why", "daegwallyeong", "ratio"),
    ):
        error = brmgeo(capsys, *command, "--data", tmp_path).error
        assert "4 of 4 sheets are missing: " + ", ".join(PAPER_SHEETS) in error
        assert "37807029.dxf" in error
        assert str(tmp_path / "source" / "daegwallyeong") in error
        assert "map.ngii.go.kr" in error
