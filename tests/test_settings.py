"""Settings files: what they say becomes typed values, and whatever is wrong with one is a line with file, line and key."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field

from brmgeo.errors import BrmgeoError, FlightError, MissingInputError, SettingsError
from brmgeo.settings import Toml, build, checked, nearest, read_toml


@dataclass(frozen=True)
class Lens:
    focal_mm: Annotated[float, Field(gt=0, le=2000)]
    bend: tuple[float, float] = (0.0, 0.0)
    kind: Literal["pinhole", "fisheye"] = "pinhole"

    def __post_init__(self) -> None:
        if self.kind == "fisheye" and self.focal_mm > 50:
            raise ValueError("a fisheye is short: 50 mm at most")


class Leg(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: str
    metres: Annotated[float, Field(gt=0)] = 100.0


@dataclass(frozen=True)
class Trip:
    title: str
    lens: Lens = Lens(35.0)
    spare: Lens | None = None
    count: Annotated[int, Field(ge=1)] = 3
    share: float = 0.5
    on: bool = False
    legs: tuple[Leg, ...] = ()
    stops: tuple[Lens, ...] = ()
    _hidden: int = 0


def read(folder: Path, text: str, **kinds: Any) -> Toml:
    path = folder / "trip.toml"
    path.write_text(text, encoding="utf-8")
    return read_toml(path, **kinds)


GOOD = """title = "north"  # [lens] is no table here
count = 4
share = 1
on = true

[lens]
focal_mm = 24
bend = [
    1,
    2.5,
]

[[legs]]
name = "out"
[[legs]]
name = "back"
metres = 7

[[stops]]
focal_mm = 9
"""


def test_a_file_becomes_a_value(tmp_path: Path) -> None:
    trip = build(read(tmp_path, GOOD), Trip)
    assert trip == Trip(
        "north", Lens(24.0, (1.0, 2.5)), None, 4, 1.0, True,
        (Leg(name="out"), Leg(name="back", metres=7.0)), (Lens(9.0),),
    )  # fmt: skip
    assert type(trip.lens.focal_mm) is float
    assert type(trip.share) is float


def test_a_table_is_read_alone_and_over_a_base(tmp_path: Path) -> None:
    toml = read(tmp_path, GOOD)
    assert build(toml, Lens, at=["lens"]) == Lens(24.0, (1.0, 2.5))
    base = Trip("south", Lens(50.0, (3.0, 4.0), "fisheye"), count=9)
    part = build(read(tmp_path, "on = true\n[lens]\nfocal_mm = 20\n"), Trip, base)
    assert part == Trip("south", Lens(20.0, (3.0, 4.0), "fisheye"), count=9, on=True)
    with pytest.raises(SettingsError, match=r"trip.toml:1: lens: a fisheye is short"):
        build(read(tmp_path, "[lens]\nfocal_mm = 60\n"), Trip, base)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("count = 4", "cuont = 4", ":2: cuont: unknown key; did you mean 'count'?"),
        ("focal_mm = 24", "focal = 24", ":7: lens.focal: unknown key; did you mean 'focal_mm'?; "),
        ("focal_mm = 24", "focal = 24", "trip.toml:6: lens.focal_mm: missing key"),
        ("count = 4", "zzz = 4", "known are title, lens, spare, count, share, on, legs, stops"),
        ("count = 4", "_hidden = 4", ":2: _hidden: unknown key"),
        ('title = "north"', "", "trip.toml: title: missing key"),
        ("count = 4", "count = 0", ":2: count: Input should be greater than or equal to 1 (found 0)"),
        ("count = 4", "count = 4.0", ":2: count: Input should be a valid integer"),
        ("count = 4", "count = true", ":2: count: Input should be a valid integer (found true)"),
        ("share = 1", "share = true", ":3: share: Input should be a valid number (found true)"),
        ("share = 1", "share = nan", ":3: share: Input should be a finite number (found nan)"),
        ("share = 1", 'share = "1"', ":3: share: Input should be a valid number (found '1')"),
        ("on = true", "on = 1", ":4: on: Input should be a valid boolean (found 1)"),
        ("    2.5,", '    "x",', ":10: lens.bend.1: Input should be a valid number (found 'x')"),
        ("    2.5,", "", ":8: lens.bend: has too few items (found [1])"),
        ("focal_mm = 24", 'focal_mm = 60\nkind = "fisheye"', ":6: lens: a fisheye is short: 50 mm at most"),
        (
            "focal_mm = 24",
            'focal_mm = 24\nkind = "tele"',
            ":8: lens.kind: Input should be 'pinhole' or 'fisheye'",
        ),
        ("[lens]\nfocal_mm = 24\nbend", "lens = 3\nbend", ":6: lens: must be a table (found 3)"),
        ("metres = 7", "metres = -7", ":17: legs.back.metres: Input should be greater than 0 (found -7)"),
        ("metres = 7", "meters = 7", ":17: legs.back.meters: unknown key; did you mean 'metres'?"),
        ("focal_mm = 9", "focal_mm = 0", ":20: stops.0.focal_mm: Input should be greater than 0 (found 0)"),
        ("[[stops]]\nfocal_mm = 9", "[stops]\nfocal_mm = 9", ":19: stops: must be a list of tables"),
    ],
)
def test_what_does_not_fit_is_told_with_its_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in GOOD
    toml = read(tmp_path, GOOD.replace(old, new))
    with pytest.raises(SettingsError) as caught:
        build(toml, Trip)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_several_faults_are_one_line_and_no_more_than_three(tmp_path: Path) -> None:
    with pytest.raises(SettingsError) as caught:
        build(read(tmp_path, "title = 1\ncount = 0\nshare = 'a'\non = 3\n"), Trip)
    assert [f":{n}: " in str(caught.value) for n in (1, 2, 3, 4)] == [True, True, True, False]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = 1\nb = = 2\n", ":2: column 5: not valid TOML: "),
        ("a = 1\r\nb = \r\n", ":2: column "),
        ("a = 1\n\n[b\n", ":3: column 3: not valid TOML"),
        ('a = 1\nb = """never\nclosed\n', ":3: not valid TOML"),
        ("a = 1\na = 2\n", ":2: "),
        ("a = 1\nb = " + "9" * 5000, ":2: not valid TOML: a number has too many digits"),
        ("a = 1\nb = " + "[" * 100_000, ":2: tables and lists are nested more than 32 deep"),
        ("a = 1\nb = " + "[" * 40 + "]" * 40, ":2: tables and lists are nested more than 32 deep"),
        ("a = 1\nb = " + "{ c = " * 100_000, ":2: tables and lists are nested more than 32 deep"),
        ("a = 1\nb." + "c." * 400 + "d = 1", ":2: tables and lists are nested more than 32 deep"),
        ("a = 1\n[b." + "c." * 400 + "d]", ":2: tables and lists are nested more than 32 deep"),
    ],
)
def test_a_file_that_is_no_toml_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    for kind in (SettingsError, FlightError):
        with pytest.raises(kind) as caught:
            read(tmp_path, text, error=kind)
        assert str(caught.value).startswith(f"{tmp_path / 'trip.toml'}{said}")
        assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with pytest.raises(MissingInputError, match=r"a.toml: there is no such file"):
        read_toml(path)
    with pytest.raises(FlightError, match=r"a.toml: there is no such file"):
        read_toml(path, missing=FlightError)
    path.write_bytes(b"a = 1\nb = '\xb0\xa1'\n")
    with pytest.raises(SettingsError, match=r"a.toml:2: is not UTF-8"):
        read_toml(path)
    with pytest.raises(SettingsError, match="cannot be read"):
        read_toml(tmp_path)
    path.write_bytes(b"\xef\xbb\xbfa = 1\r\n[b]\r\nc = 2\r\n")
    toml = read_toml(path)
    assert (toml.data, toml.where("b", "c"), toml.lines[1]) == ({"a": 1, "b": {"c": 2}}, (3, 1), "[b]")


def test_every_key_has_its_place(tmp_path: Path) -> None:
    toml = read(
        tmp_path,
        "# [a]\n"
        'a.b = "x = 1"\n'
        'text = """\n[fake]\nc = 3 \\""" \n"""\n'
        "lit = '''\n[fake]'''\n"
        "\"quoted key\".'in' = 1979-05-27 07:32:00\n"
        "inline = { p = 1, q = [ { r = 2 }, # }\n  { r = 3 } ] }\n"
        "  [ table . sub ]\n  deep=-1.5e3\n"
        '[[many]]\nname = "one"\n[many.more]\nx = 1\n[[many]]\nx = 2\n[[many]]\nx = 3\n',
    )
    found = {
        keys: toml.where(*keys)
        for keys in (
            ("a", "b"), ("text",), ("lit",), ("quoted key", "in"), ("inline", "q", 1, "r"), ("table", "sub"),
            ("table", "sub", "deep"), ("many", 0, "more", "x"), ("many", 2, "x"), ("many", 1), ("table", "none"), ("none",),
        )
    }  # fmt: skip
    assert found == {
        ("a", "b"): (2, 3),
        ("text",): (3, 1),
        ("lit",): (7, 1),
        ("quoted key", "in"): (9, 14),
        ("inline", "q", 1, "r"): (11, 5),
        ("table", "sub"): (12, 3),
        ("table", "sub", "deep"): (13, 3),
        ("many", 0, "more", "x"): (17, 1),
        ("many", 2, "x"): (21, 1),
        ("many", 1): (18, 1),
        ("table", "none"): (12, 3),
        ("none",): (1, 1),
    }


_WORDS = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=6)


def _quoted(word: str) -> str:
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(_WORDS, st.dictionaries(_WORDS, _WORDS, max_size=4)), unique_by=lambda t: t[0], max_size=4
    )
)
def test_places_are_those_of_the_lines_whatever_keys_and_texts_hold(
    tmp_path_factory: pytest.TempPathFactory, tables: list[tuple[str, dict[str, str]]]
) -> None:
    lines, wanted = [], {}
    for table, values in tables:
        lines.append(f"[{_quoted(table)}]")
        wanted[table,] = (len(lines), 1)
        for key, value in values.items():
            lines.append(f" {_quoted(key)} = {_quoted(value)}")
            wanted[table, key] = (len(lines), 2)
    toml = read(tmp_path_factory.mktemp("toml"), "\n".join(lines))
    assert toml.data == tomllib.loads("\n".join(lines)) == dict(tables)
    assert {keys: toml.where(*keys) for keys in wanted} == wanted


def test_a_file_over_another_keeps_the_places_of_both(tmp_path: Path) -> None:
    below = tmp_path / "below.toml"
    below.write_text(GOOD + '[[legs]]\nname = "more"\nmetres = 3\n')
    above = read(tmp_path, 'count = 8\n[lens]\nfocal_mm = 30\n[[legs]]\nname = "more"\nmetres = 9\n')
    both = above.over(read_toml(below))
    trip = build(both, Trip)
    assert (trip.title, trip.count, trip.lens) == ("north", 8, Lens(30.0, (1.0, 2.5)))
    assert [(leg.name, leg.metres) for leg in trip.legs] == [("out", 100.0), ("back", 7.0), ("more", 9.0)]
    below.write_text(GOOD.replace("metres = 7", "metres = 0"))
    with pytest.raises(SettingsError, match=r"below.toml:17: legs.back.metres: "):
        build(above.over(read_toml(below)), Trip)
    above = read(tmp_path, '[[legs]]\nname = "back"\n\nmetres = 0\n')
    with pytest.raises(SettingsError, match=r"trip.toml:4: legs.back.metres: "):
        build(above.over(read_toml(below)), Trip)


def test_values_of_a_program_are_checked_alike() -> None:
    assert checked(Leg, {"name": "a", "metres": 2}, "plan") == Leg(name="a", metres=2.0)
    assert checked(Lens, {"focal_mm": 2}, "plan") == Lens(2.0)
    with pytest.raises(SettingsError, match=r"^plan: metre: unknown key; did you mean 'metres'\?$"):
        checked(Leg, {"name": "a", "metre": 2}, "plan")


def test_the_nearest_word_or_all_of_them() -> None:
    assert nearest("mvision", ["mission", "camera"]) == "did you mean 'mission'?"
    assert nearest("x", ["mission", "camera"]) == "known are mission, camera"
    assert nearest("x", []) == "known are none"


def test_a_caller_says_its_own_faults_alike(tmp_path: Path) -> None:
    toml = read(tmp_path, GOOD, error=FlightError)
    fault = toml.refuse("both are given: keep one", "lens", "focal_mm")
    assert isinstance(fault, FlightError)
    assert isinstance(fault, BrmgeoError)
    assert str(fault) == f"{toml.path}:7: lens.focal_mm: both are given: keep one"
