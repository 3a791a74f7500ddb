"""The DXF reader, held against documents that ezdxf writes and reads, and against shapely's areas."""

from __future__ import annotations

import math
import os
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import shapely
from ezdxf import path as ezpath
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brmgeo.codes import BUILDING_LAYERS
from brmgeo.errors import InputError, SettingsError
from brmgeo.ingest.dxf import read_dxf
from brmgeo.ingest.dxf.entities import flatten_bulges

REAL = (
    Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[2] / "../shared/data")) / "ngii"
)
VERSIONS = ["R12", "R2000", "R2004", "R2007", "R2010", "R2013", "R2018"]
# As far from zero as real sheets, so that lost digits show.
ORIGIN = np.array([227_000.0, 378_000.0])
HOUSE = "B0014112"
SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 8.0], [0.0, 8.0]])


class Sheet:
    """A drawing under construction, in any version."""

    def __init__(self, version: str) -> None:
        self.doc = ezdxf.new(version, units=0)
        self.space = self.doc.modelspace()
        self.old = version == "R12"

    def ring(self, xy, layer=HOUSE, close=True, bulges=None, space=None, **attribs):
        xy = np.asarray(xy, dtype=float) + ORIGIN
        points = [
            (x, y, b) for (x, y), b in zip(xy.tolist(), bulges if bulges is not None else [0.0] * len(xy))
        ]
        space = self.space if space is None else space
        attribs = {"layer": layer, **attribs}
        if self.old:
            return space.add_polyline2d(points, format="xyb", close=close, dxfattribs=attribs)
        return space.add_lwpolyline(points, format="xyb", close=close, dxfattribs=attribs)

    def lines(self, xy, layer=HOUSE):
        xy = np.asarray(xy, dtype=float) + ORIGIN
        for a, b in zip(xy[:-1].tolist(), xy[1:].tolist()):
            self.space.add_line(a, b, dxfattribs={"layer": layer})

    def save(self, path: Path) -> Path:
        self.doc.saveas(path)
        return path


@pytest.fixture(params=VERSIONS)
def sheet(request):
    return Sheet(request.param)


@pytest.fixture
def target(tmp_path):
    return tmp_path / "36914093.dxf"


def kinds(read):
    return sorted(repair.kind for repair in read.repairs)


def area(read):
    return float(read.footprints.area.sum())


def test_closed_by_flag_by_vertex_and_over_a_gap(sheet, target):
    sheet.ring(SQUARE)
    sheet.ring([*(SQUARE + (20, 0)), SQUARE[0] + (20, 0)], close=False)
    gap = sheet.ring([*(SQUARE + (40, 0)), (40.0, 0.05)], close=False)
    read = read_dxf(sheet.save(target))
    assert len(read.footprints) == 3
    assert area(read) == pytest.approx(240.0 - 0.25, abs=0.3)
    assert kinds(read) == ["gap"]
    repair = read.repairs[0]
    assert (repair.x, repair.y) == (pytest.approx(ORIGIN[0] + 40), pytest.approx(ORIGIN[1]))
    assert repair.handle == gap.dxf.handle
    assert set(read.footprints["kind"]) == {"house"}
    assert list(read.footprints["layer"].unique()) == [HOUSE]
    assert shapely.get_coordinates(read.footprints.geometry.iloc[0])[0].tolist() == ORIGIN.tolist()


def test_a_wide_gap_is_no_building_and_too_many_fail_the_sheet(sheet, target):
    sheet.ring([*SQUARE, (0.0, 1.0)], close=False)
    for k in range(1, 30):
        sheet.ring(SQUARE + (20 * k, 0))
    path = sheet.save(target)
    read = read_dxf(path)
    assert kinds(read) == ["open"]
    assert len(read.footprints) == 29
    assert read.dropped_share == pytest.approx(1 / 30)
    with pytest.raises(
        InputError, match=r"36914093\.dxf: 1 of 30 outlines .*open on B0014112, handle \w+, at 2270"
    ):
        read_dxf(path, max_dropped_share=0.02)
    assert len(read_dxf(path, snap_m=1.01).footprints) == 30


@pytest.mark.parametrize(
    ("kind", "xy", "left_m2", "pieces"),
    [
        ("bow_tie", [(0, 0), (10, 10), (10, 0), (0, 10)], 50.0, 2),
        ("spike", [(0, 0), (10, 0), (10, 10), (5, 10), (5, 25), (5, 10), (0, 10)], 100.0, 1),
        ("spike", [(0, 0), (10, 0), (10, 10), (5, 10), (5.02, 25), (5.01, 10), (0, 10)], 100.0, 1),
        ("zero_area", [(0, 0), (5, 0), (10, 0), (5, 0)], 0.0, 0),
        ("zero_area", [(0, 0), (5, 5)], 0.0, 0),
        ("self_touch", [(0, 0), (10, 0), (10, 10), (5, 10), (7, 12), (3, 12), (5, 10), (0, 10)], 104.0, 2),
    ],
)
def test_faulty_rings(sheet, target, kind, xy, left_m2, pieces):
    faulty = sheet.ring(xy)
    for k in range(1, 25):
        sheet.ring(SQUARE + (20 * k, 0))
    read = read_dxf(sheet.save(target))
    assert kinds(read) == [kind]
    assert len(read.footprints) == 24 + pieces
    assert area(read) == pytest.approx(24 * 80.0 + left_m2, abs=0.1)
    assert read.footprints.is_valid.all()
    assert read.repairs[0].handle == faulty.dxf.handle
    assert read.repairs[0].source == "36914093.dxf"
    assert abs(read.repairs[0].x - ORIGIN[0]) <= 10
    assert read.counts[f"repair_{kind}"] == 1


def test_duplicates_whatever_their_start_and_rotation(sheet, target):
    sheet.ring(SQUARE)
    sheet.ring(SQUARE)
    sheet.ring(SQUARE[::-1])
    sheet.ring(np.roll(SQUARE, 2, axis=0))
    sheet.ring(SQUARE, layer="B0014116")
    read = read_dxf(sheet.save(target))
    assert kinds(read) == ["duplicate"] * 4
    assert list(read.footprints["layer"]) == [HOUSE]
    assert read.dropped_share == 0.0


def test_courtyards_are_rings_in_rings_of_their_layer(sheet, target):
    yard = [(20, 20), (80, 20), (80, 60), (20, 60)]
    sheet.ring([(0, 0), (100, 0), (100, 80), (0, 80)], layer="B0014111")
    sheet.ring(yard, layer="B0014111")
    sheet.ring([(40, 30), (60, 30), (60, 50), (40, 50)], layer="B0014111")  # a house in the courtyard
    sheet.ring(yard, layer="B0014117")  # which a greenhouse fills
    sheet.ring([(2, 2), (8, 2), (8, 8), (2, 8)], layer=HOUSE)  # another layer: no courtyard
    read = read_dxf(sheet.save(target))
    assert read.counts["courtyards"] == 1
    by_layer = read.footprints.dissolve("layer").area
    assert by_layer["B0014111"] == pytest.approx(8000 - 2400 + 400)
    assert by_layer["B0014117"] == pytest.approx(2400)
    assert by_layer[HOUSE] == pytest.approx(36)


def test_bulges_become_chords(sheet, target):
    # Two half turns: a disc of radius 5.
    sheet.ring([(0, 0), (10, 0)], bulges=[1.0, 1.0])
    # A quarter turn outwards on one side of a square (positive: counter-clockwise).
    sheet.ring(SQUARE + (40, 0), bulges=[math.tan(math.pi / 8), 0, 0, 0])
    read = read_dxf(sheet.save(target), sagitta_m=0.002)
    radius = 10 / math.sqrt(2)
    segment = radius**2 / 2 * (math.pi / 2 - 1)
    assert sorted(read.footprints.area) == pytest.approx(sorted([math.pi * 25, 80 + segment]), rel=1e-3)
    assert read.counts["bulges"] == 2


@given(
    bulge=st.one_of(st.floats(-3, -1e-3), st.floats(1e-3, 3)),
    sagitta=st.floats(0.001, 0.5),
    length=st.floats(0.1, 100),
)
def test_chords_stay_within_the_sagitta(bulge, sagitta, length):
    xy = flatten_bulges(np.array([[0.0, 0.0], [length, 0.0]]), np.array([bulge, 0.0]), False, sagitta)
    assert xy[0].tolist() == [0.0, 0.0]
    assert xy[-1].tolist() == [length, 0.0]
    # The arc's middle lies bulge * chord / 2 to the right of the chord.
    centre, radius = (
        ezdxf.math.bulge_center((0, 0), (length, 0), bulge),
        ezdxf.math.bulge_radius((0, 0), (length, 0), bulge),
    )
    assert np.hypot(*(xy - (centre.x, centre.y)).T) == pytest.approx(np.full(len(xy), radius), rel=1e-6)
    middle = (xy[1:] + xy[:-1]) / 2
    assert (radius - np.hypot(*(middle - (centre.x, centre.y)).T)).max() <= sagitta * (1 + 1e-6)
    top = xy[np.argmax(np.abs(xy[:, 1]))]
    assert top[1] * bulge <= 1e-12


@given(bulge=st.floats(-1e-3, 1e-3), sagitta=st.floats(0.001, 0.5), length=st.floats(0.1, 100))
def test_an_all_but_flat_arc_keeps_its_ends_and_stays_near_its_chord(bulge, sagitta, length):
    xy = flatten_bulges(np.array([[0.0, 0.0], [length, 0.0]]), np.array([bulge, 0.0]), False, sagitta)
    assert xy[0].tolist() == [0.0, 0.0]
    assert xy[-1].tolist() == [length, 0.0]
    assert np.abs(xy[:, 1]).max() <= abs(bulge) * length / 2 + 1e-6


def test_lines_and_open_polylines_are_chained(sheet, target):
    sheet.lines([*SQUARE, SQUARE[0]])
    sheet.ring([(20, 0), (30, 0), (30, 8)], close=False)
    sheet.ring([(30, 8.004), (20, 8), (20, 0.003)], close=False)
    sheet.space.add_arc(ORIGIN + (45, 0), 5, 0, 180, dxfattribs={"layer": HOUSE})
    sheet.lines([(40, 0), (50, 0)])
    sheet.lines([(60, 0), (70, 0)], layer="B0014119")
    sheet.lines([(60, 0), (70, 0), (70, 10)], layer="A0013111")
    sheet.space.add_circle(ORIGIN + (100, 0), 4, dxfattribs={"layer": "B0014111"})
    read = read_dxf(sheet.save(target))
    assert sorted(read.footprints.area) == pytest.approx(
        sorted([80, 80, math.pi * 12.5, math.pi * 16]), rel=5e-3
    )
    assert read.counts["chained"] == 3
    assert kinds(read) == ["gap"]


def test_a_chain_that_does_not_close_is_one_outline_dropped(sheet, target):
    sheet.lines([(0, 0), (10, 0), (10, 10), (0, 10)])
    for k in range(1, 25):
        sheet.ring(SQUARE + (20 * k, 0))
    read = read_dxf(sheet.save(target))
    assert kinds(read) == ["open"]
    assert "3 lines of 30.0 m" in read.repairs[0].detail
    assert len(read.footprints) == 24


def test_heights_are_dropped(sheet, target):
    sheet.ring(SQUARE, elevation=(0, 0, 33.0) if sheet.old else 33.0)
    sheet.space.add_polyline3d(
        [(*(p + ORIGIN), 25.0) for p in SQUARE + (20, 0)], close=True, dxfattribs={"layer": HOUSE}
    )
    read = read_dxf(sheet.save(target))
    assert area(read) == pytest.approx(160.0)
    assert not read.footprints.has_z.any()
    assert read.counts["z_dropped"] >= 1


def test_mirrored_planes(sheet, target):
    sheet.ring(SQUARE - 2 * ORIGIN * (1, 0), extrusion=(0, 0, -1))
    read = read_dxf(sheet.save(target))
    assert read.footprints.total_bounds.tolist() == pytest.approx(
        [ORIGIN[0] - 10, ORIGIN[1], ORIGIN[0], ORIGIN[1] + 8]
    )


def test_only_modelspace_and_chosen_layers_count(sheet, target):
    sheet.ring(SQUARE)
    sheet.ring(SQUARE + (20, 0), layer="b0014116")
    sheet.ring(SQUARE + (40, 0), layer="4111")
    sheet.ring(SQUARE * 20 + (60, 0), layer="B0014119")
    sheet.ring(SQUARE * 20 + (60, 0), layer="4119")
    sheet.ring(SQUARE + (300, 0), layer="C0023333")
    sheet.ring(SQUARE + (320, 0), layer="건물")
    sheet.ring(
        SQUARE, space=sheet.doc.layout("Layout1") if not sheet.old else sheet.doc.layouts.get("Layout1")
    )
    path = sheet.save(target)
    read = read_dxf(path)
    assert sorted(read.footprints["layer"]) == ["B0014111", HOUSE, "B0014116"]
    assert len(read_dxf(path, ["4111"]).footprints) == 1
    own = read_dxf(path, ["건물"])
    assert list(own.footprints.kind) == ["other"]
    for name in ("B0014119", "4119", "b0014119"):
        with pytest.raises(SettingsError, match="groups of houses"):
            read_dxf(path, [HOUSE, name])


def test_symbols_do_not_count_and_buildings_drawn_as_blocks_do(sheet, target):
    symbol = sheet.doc.blocks.new("SCHOOL")
    symbol.add_circle((0, 0), 6, dxfattribs={"layer": "B0014111"})
    for k in range(5):
        sheet.space.add_blockref("SCHOOL", ORIGIN + (20 * k, 0), dxfattribs={"layer": HOUSE})
    sheet.space.add_blockref("SCHOOL", ORIGIN, dxfattribs={"layer": "B0014231"})
    house = sheet.doc.blocks.new("HOUSE-1", base_point=(1, 1))
    for layer, shift in (("0", 0), ("B0014116", 10), ("A0013111", 20)):
        xy = [(1 + shift, 1), (5 + shift, 1), (5 + shift, 4), (1 + shift, 4)]
        if sheet.old:
            house.add_polyline2d(xy, close=True, dxfattribs={"layer": layer})
        else:
            house.add_lwpolyline(xy, close=True, dxfattribs={"layer": layer})
    sheet.space.add_blockref(
        "HOUSE-1", ORIGIN + (100, 50), dxfattribs={"layer": HOUSE, "xscale": 2, "yscale": 2, "rotation": 90}
    )
    small = sheet.doc.blocks.new("MARK")
    small.add_circle((0, 0), 0.5, dxfattribs={"layer": "0"})
    sheet.space.add_blockref("MARK", ORIGIN, dxfattribs={"layer": HOUSE})
    read = read_dxf(sheet.save(target))
    assert (read.counts["blocks_as_buildings"], read.counts["symbols_ignored"]) == (1, 7)
    assert dict(zip(read.footprints["layer"], read.footprints.area)) == pytest.approx(
        {HOUSE: 48.0, "B0014116": 48.0}
    )
    own = read.footprints[read.footprints["layer"] == HOUSE].total_bounds
    assert own.tolist() == pytest.approx([*(ORIGIN + (94, 50)), *(ORIGIN + (100, 58))])


def test_the_neatline(sheet, target):
    sheet.ring(SQUARE)
    sheet.lines([(-5, -5), (100, -5), (100, 90), (-5, 90), (-5, -5)], layer="H0017334")
    read = read_dxf(sheet.save(target))
    assert read.neatline.bounds == pytest.approx((*(ORIGIN - 5), *(ORIGIN + (100, 90))))
    assert len(read.footprints) == 1


def test_a_sheet_without_buildings_is_no_error(sheet, target):
    sheet.ring(SQUARE, layer="F0017111")
    read = read_dxf(sheet.save(target))
    assert len(read.footprints) == 0
    assert read.counts["outlines"] == 0
    assert read.neatline is None
    assert list(read.footprints.columns) == ["geometry", "layer", "kind", "handle", "source"]


@pytest.mark.parametrize("page", [b"ANSI_949", b"NONSENSE", b""])
def test_texts_never_fail_a_sheet(sheet, target, page):
    sheet.ring(SQUARE)
    sheet.space.add_text("건물", dxfattribs={"layer": "H0049140"})
    data = sheet.save(target).read_bytes()
    data = data.replace(b"ANSI_1252", page).replace(b"H0049140", b"H\xb0\xc7\xb9\xb0\xff")
    target.write_bytes(data)
    assert len(read_dxf(target).footprints) == 1


def test_line_ends_do_not_matter(sheet, target):
    sheet.ring(SQUARE)
    data = sheet.save(target).read_bytes().replace(b"\r\n", b"\n")
    for text in (
        data,
        data.replace(b"\n", b"\r\n"),
        data.rstrip(),
        data + b"\n\n \n",
        b"\xef\xbb\xbf" + data,
    ):
        target.write_bytes(text)
        assert area(read_dxf(target)) == pytest.approx(80.0)


def test_binary_dxf_is_read(sheet, target):
    sheet.ring(SQUARE)
    sheet.doc.saveas(target, fmt="bin")
    assert target.read_bytes().startswith(b"AutoCAD Binary DXF")
    assert area(read_dxf(target)) == pytest.approx(80.0)
    target.write_bytes(target.read_bytes()[:-600])
    with pytest.raises(InputError, match="damaged or cut short"):
        read_dxf(target)


def test_a_sheet_cut_short_anywhere_is_refused(target):
    sheet = Sheet("R12")
    for k in range(20):
        sheet.ring(SQUARE + (20 * k, 0))
    data = sheet.save(target).read_bytes()
    for share in np.linspace(0.02, 0.999, 60):
        target.write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError) as caught:
            read_dxf(target)
        assert "36914093.dxf" in str(caught.value)
        assert "\n" not in str(caught.value)
    inside = data.rindex(b"VERTEX") + 8
    target.write_bytes(data[:inside])
    with pytest.raises(
        InputError, match=r"cut short: it ends at line \d+ inside section ENTITIES, entity VERTEX"
    ):
        read_dxf(target)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty"),
        (b" \n\n", "empty"),
        (b"AC1032\x00\x00\x00" + bytes(300), "DWG"),
        (b"PK\x03\x04" + bytes(300), "zip archive"),
        (bytes(range(256)) * 40, "not a DXF"),
        (b"\x00" * 5000, "not a DXF"),
        (b"<html>\n<body>404</body>\n</html>\n", "not a DXF"),
        (b"  0\nSECTION\n  2\nHEADER\n  0\nENDSEC\n  0\nEOF\n", "no ENTITIES"),
        (
            b"  0\nSECTION\n  2\nENTITIES\n  0\nLINE\nnonsense\n1\n  0\nENDSEC\n  0\nEOF\n",
            "damaged at line 7",
        ),
    ],
    ids=["empty", "blank", "dwg", "zip", "junk", "zeros", "html", "no entities", "bad code"],
)
def test_what_is_no_sheet_is_refused_in_one_line(target, data, message):
    target.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_dxf(target)
    assert str(caught.value).startswith("36914093.dxf: ")
    assert "\n" not in str(caught.value)


def test_a_bad_number_names_its_line(target):
    sheet = Sheet("R2000")
    sheet.ring(SQUARE)
    data = sheet.save(target).read_bytes()
    bad = data.replace(b"227010.0", b"22701O.0", 1)
    target.write_bytes(bad)
    line = bad[: bad.index(b"22701O")].count(b"\n") + 1
    with pytest.raises(InputError, match=f"damaged at line {line}: a number was expected, found '22701O.0'"):
        read_dxf(target)


def with_ezdxf(path: Path) -> list[np.ndarray]:
    """Closed outlines as plain ezdxf reads them, arcs flattened finely."""
    rings = []
    for entity in ezdxf.readfile(path).modelspace():
        if entity.dxf.layer not in BUILDING_LAYERS or entity.dxftype() not in ("POLYLINE", "LWPOLYLINE"):
            continue
        rings.append(np.array([(v.x, v.y) for v in ezpath.make_path(entity).flattening(1e-4)]))
    return rings


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), version=st.sampled_from(["R12", "R2000", "R2018"]))
def test_agrees_with_ezdxf(tmp_path, data, version):
    sheet = Sheet(version)
    for k in range(data.draw(st.integers(1, 6))):
        n = data.draw(st.integers(3, 9))
        radius = np.array(data.draw(st.lists(st.floats(2, 8), min_size=n, max_size=n)))
        phi = np.arange(n) / n * math.tau
        bulges = data.draw(st.lists(st.sampled_from([0.0, 0.0, 0.1, -0.05]), min_size=n, max_size=n))
        xy = np.round(np.stack([radius * np.cos(phi), radius * np.sin(phi)], axis=1) + (40 * k, 0), 3)
        sheet.ring(xy, layer=BUILDING_LAYERS[data.draw(st.integers(0, 7))], bulges=bulges)
        sheet.ring(xy, layer="A0013111")
    path = sheet.save(tmp_path / "s.dxf")
    ours = read_dxf(path, sagitta_m=1e-4).footprints
    theirs = [shapely.Polygon(ring).buffer(0) for ring in with_ezdxf(path)]
    assert shapely.union_all(theirs).symmetric_difference(ours.union_all()).area < 0.05
    assert area_of(ours) == pytest.approx(sum(p.area for p in theirs), rel=1e-3)


def area_of(frame):
    return float(frame.area.sum())


def real(name: str) -> Path:
    if not (REAL / name).exists():
        pytest.skip(f"real data {name} is not there (BRMGEO_REAL_DATA)")
    return REAL / name


@pytest.mark.parametrize(
    "name",
    [pytest.param("36914093_r12.dxf", marks=pytest.mark.slow), "36914093_r2018.dxf"],
    ids=["R12", "R2018"],
)
def test_a_real_sheet_agrees_with_ezdxf_vertex_by_vertex(name):
    path = real(name)
    read = read_dxf(path)
    assert (len(read.footprints), read.counts["courtyards"], read.dropped_share) == (2536, 4, 0.0)
    assert area(read) == pytest.approx(354_361, abs=0.5)
    rings = sorted(tuple(map(tuple, ring.tolist())) for ring in with_ezdxf(path))
    ours = []
    for polygon in read.footprints.geometry:
        ours += [tuple(polygon.exterior.coords), *(tuple(hole.coords) for hole in polygon.interiors)]
    assert len(ours) == len(rings)
    assert {frozenset(ring) for ring in ours} == {frozenset(ring) for ring in rings}


def test_a_real_sheet_without_buildings():
    read = read_dxf(real("35812062_contours_only.dxf"))
    assert (len(read.footprints), read.counts["outlines"]) == (0, 0)


def test_a_drawing_larger_than_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "big.dxf").open("wb") as file:
        file.truncate(10_000_000)
    monkeypatch.setattr("brmgeo.memory.free_bytes", lambda: 50_000_000)
    with pytest.raises(InputError, match=r"big\.dxf of 10 MB takes about 0\.3 GB of memory"):
        read_dxf(tmp_path / "big.dxf")
