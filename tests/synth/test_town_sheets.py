"""Sheets of a generated town, held against what plain ezdxf reads."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import shapely

from brmgeo.codes import BUILDING_LAYERS, GROUP_BOUNDARY_LAYER, NEATLINE_LAYER
from brmgeo.errors import SettingsError
from brmgeo.geo.sheets import sheet_polygon
from brmgeo.synth.scene import Town
from brmgeo.synth.sheets import FAULTS, write_sheets
from brmgeo.synth.town import generate_town

NUMBERS = ("36808058", "36808059")


@lru_cache(maxsize=1)
def town() -> Town:
    return generate_town((195230.0, 446000.0, 195830.0, 446600.0), 3)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("sheets")
    logging.getLogger("ezdxf").setLevel(logging.ERROR)
    return folder, write_sheets(town(), folder, NUMBERS)


def ring_of(entity: object) -> np.ndarray:
    if entity.dxftype() == "LWPOLYLINE":
        return np.array([p[:2] for p in entity.get_points("xy")])
    return np.array([(v.dxf.location.x, v.dxf.location.y) for v in entity.vertices])


def test_versions_and_layers(written: tuple[Path, dict]) -> None:
    folder, manifest = written
    kinds = {"36808058": ("AC1009", "POLYLINE"), "36808059": ("AC1027", "LWPOLYLINE")}
    for number, facts in manifest["sheets"].items():
        doc = ezdxf.readfile(folder / facts["file"])
        assert (doc.dxfversion, facts["version"]) == (kinds[number][0], kinds[number][0])
        space = doc.modelspace()
        assert len(space) == facts["entities"]
        outlines = [e for e in space if e.dxf.layer in BUILDING_LAYERS]
        assert {e.dxftype() for e in outlines} == {kinds[number][1], "LINE"}
        assert len(space.query(f'*[layer=="{GROUP_BOUNDARY_LAYER}"]')) == facts["group_boundaries"]
        assert len(space.query("INSERT")) == facts["symbols"] > 0
        assert any("가" <= c <= "힣" for t in space.query("TEXT") for c in t.dxf.text)
        (frame,) = space.query(f'*[layer=="{NEATLINE_LAYER}"]')
        assert (
            shapely.Polygon(ring_of(frame)).symmetric_difference(sheet_polygon(number, town().crs)).area < 10
        )
    raw = (folder / "36808058.dxf").read_bytes()
    assert b"ANSI_949" in raw
    assert "경로당".encode("cp949") in raw or "창고".encode("cp949") in raw


def test_faults_are_in_the_file_as_the_manifest_says(written: tuple[Path, dict]) -> None:
    folder, manifest = written
    for facts in manifest["sheets"].values():
        assert facts["faults"] == dict(FAULTS)
        doc = ezdxf.readfile(folder / facts["file"])
        found = {kind: [doc.entitydb[h] for h in handles] for kind, handles in facts["handles"].items()}
        rings = {kind: [ring_of(e) for e in es] for kind, es in found.items() if kind != "line_chain"}
        assert all(np.allclose(r[0], r[-1]) for r in rings["open_repeated_vertex"])
        assert not any(e.is_closed for e in found["open_repeated_vertex"] + found["gap_5cm"])
        assert all(0.045 < np.hypot(*(r[0] - r[-1])) < 0.055 for r in rings["gap_5cm"])
        assert all(shapely.Polygon(r).area < 1e-6 for r in rings["zero_area"])
        assert not any(shapely.Polygon(r).is_valid for r in rings["bow_tie"] + rings["spike"])
        assert all(any(b != 0 for b in bulges(e)) for e in found["bulge"])
        assert all(height(e) > 1 for e in found["z_values"])
        assert {e.dxftype() for e in found["line_chain"]} == {"LINE"}
        everything = [
            shapely.Polygon(ring_of(e))
            for e in doc.modelspace()
            if e.dxftype() != "LINE" and e.dxf.layer in BUILDING_LAYERS
        ]
        for r in rings["duplicate"]:
            assert sum(shapely.Polygon(r).equals(p) for p in everything) == 2


def bulges(entity: object) -> list[float]:
    if entity.dxftype() == "LWPOLYLINE":
        return [p[0] for p in entity.get_points("b")]
    return [v.dxf.bulge for v in entity.vertices]


def height(entity: object) -> float:
    return entity.dxf.elevation if entity.dxftype() == "LWPOLYLINE" else entity.vertices[0].dxf.location.z


def test_area_is_exact(written: tuple[Path, dict]) -> None:
    """Even-odd polygons of all rings as ezdxf gives them, arcs flattened, cover the manifest's area."""
    folder, manifest = written
    for number, facts in manifest["sheets"].items():
        shapes, holes, edges = [], [], []
        for e in ezdxf.readfile(folder / facts["file"]).modelspace():
            if e.dxf.layer not in BUILDING_LAYERS:
                continue
            if e.dxftype() == "INSERT":
                continue
            if e.dxftype() == "LINE":
                edges.append(shapely.LineString([e.dxf.start.vec2, e.dxf.end.vec2]))
                continue
            points = [(p.x, p.y) for p in ezdxf.path.make_path(e).flattening(0.001)]
            # Of an outline that was drawn flat, lines may be left, which are no courtyards.
            if len(points) > 3 and (shape := shapely.make_valid(shapely.Polygon(points))).area > 0:
                shapes.append(shape)
        shapes += list(shapely.get_parts(shapely.polygonize(edges)))
        # A courtyard is a ring inside a ring.
        tree = shapely.STRtree(shapes)
        for i, s in enumerate(shapes):
            if any(j != i and shapes[j].area > s.area + 1 and shapes[j].covers(s) for j in tree.query(s)):
                holes.append(s)
        union = shapely.union_all(shapes).difference(shapely.union_all(holes))
        assert len(holes) == facts["courtyards"]
        assert union.area == pytest.approx(facts["area_m2"], abs=0.2)
        assert sheet_polygon(number, town().crs).buffer(2.1).covers(union)


def test_halves_meet_at_the_neatline(written: tuple[Path, dict]) -> None:
    _, manifest = written
    assert min(s["cut"] for s in manifest["sheets"].values()) >= 1
    clean = sum(s["area_m2"] for s in manifest["sheets"].values())
    whole = shapely.union_all([b.polygon for b in town().buildings]).area
    assert clean == pytest.approx(whole, abs=40)  # but for the bends of a few arcs


def test_same_town_gives_the_same_bytes(written: tuple[Path, dict], tmp_path: Path) -> None:
    folder, manifest = written
    assert write_sheets(town(), tmp_path, NUMBERS) == manifest
    for number in NUMBERS:
        assert (tmp_path / f"{number}.dxf").read_bytes() == (folder / f"{number}.dxf").read_bytes()


def test_a_sheet_without_buildings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="36808001"):
        write_sheets(town(), tmp_path, ["36808001"])
