from __future__ import annotations

import itertools
import json
import sqlite3
import xml.etree.ElementTree as ET
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyogrio
import pytest
from pyproj import Transformer

from brmgeo.errors import CrsError
from brmgeo.export.candidates import GEOJSON_LIMIT, CandidateFrame, write_candidates

CRS = "EPSG:5187"
START = datetime(2026, 5, 1, 3, 0, 0, 250_000, tzinfo=UTC)


def frames(sizes: list[int], step_s: float = 5.0) -> list[CandidateFrame]:
    rng = np.random.default_rng(3)
    out = []
    for i, n in enumerate(sizes):
        xy = np.column_stack([rng.uniform(352_000, 354_000, n), rng.uniform(562_000, 564_000, n)])
        mass = rng.uniform(0, 1, n)
        status = "converged" if n < 3 else "ambiguous" if n else "lost"
        out.append(CandidateFrame(i * step_s, xy, mass / max(mass.sum(), 1e-9), status))
    return out


def test_geojson_holds_every_candidate_where_pyproj_puts_it(tmp_path: Path) -> None:
    given = frames([7, 0, 4, 2])
    path = write_candidates(tmp_path, given, CRS, start_utc=START)
    assert path == tmp_path / "candidates.geojson"
    collection = json.loads(path.read_text(encoding="utf-8"))
    assert "crs" not in collection
    features = collection["features"]
    assert [f["properties"]["frame"] for f in features] == [0] * 7 + [2] * 4 + [3] * 2

    xy = np.concatenate([f.xy for f in given])
    lon, lat = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(xy[:, 0], xy[:, 1])
    found = np.array([f["geometry"]["coordinates"] for f in features])
    np.testing.assert_allclose(found, np.column_stack([lon, lat]), atol=0.6e-7, rtol=0)
    np.testing.assert_allclose(
        [[f["properties"]["x"], f["properties"]["y"]] for f in features], xy, atol=0.6e-3, rtol=0
    )
    mass = np.concatenate([f.mass for f in given])
    np.testing.assert_allclose([f["properties"]["mass"] for f in features], mass, rtol=1e-5)
    assert {f["properties"]["epsg"] for f in features} == {5187}


def test_a_frame_ends_one_millisecond_before_the_next_begins(tmp_path: Path) -> None:
    given = frames([1, 1, 1])
    features = json.loads(write_candidates(tmp_path, given, CRS, start_utc=START).read_text())["features"]
    spans = [[datetime.fromisoformat(f["properties"][k]) for k in ("start", "end")] for f in features]
    assert all(f["properties"][k].endswith("Z") for f in features for k in ("start", "end"))
    assert [s for s, _ in spans] == [START + timedelta(seconds=5 * i) for i in range(3)]
    for (_, end), (begin, _) in itertools.pairwise(spans):
        assert begin - end == timedelta(milliseconds=1)
    assert spans[-1][1] - spans[-1][0] == timedelta(milliseconds=4999)


def test_above_the_limit_a_geopackage_in_the_native_crs(tmp_path: Path) -> None:
    given = frames([30, 20, 0, 5])
    write_candidates(tmp_path, given, CRS, start_utc=START)
    path = write_candidates(tmp_path, given, CRS, start_utc=START, geojson_limit=54)
    assert path == tmp_path / "candidates.gpkg"
    assert not (tmp_path / "candidates.geojson").exists(), "an earlier run's file must not tell another story"
    assert not (tmp_path / "candidates.qml").exists()
    assert pyogrio.read_info(path, layer="candidates")["crs"] == CRS
    table = pyogrio.read_dataframe(path, layer="candidates")
    xy = np.concatenate([f.xy for f in given])
    np.testing.assert_array_equal(np.column_stack([table.geometry.x, table.geometry.y]), xy)
    np.testing.assert_array_equal(table[["x", "y"]].to_numpy(), xy)
    np.testing.assert_array_equal(table["frame"], np.repeat([0, 1, 3], [30, 20, 5]))
    assert str(table["start"].dt.tz) == "UTC"
    assert table["start"].iloc[30].to_pydatetime() == START + timedelta(seconds=5)
    assert table["end"].iloc[0].to_pydatetime() == START + timedelta(milliseconds=4999)

    with sqlite3.connect(path) as db:
        rows = db.execute(
            "SELECT f_table_name, f_geometry_column, useAsDefault, styleQML FROM layer_styles"
        ).fetchall()
    assert [row[:3] for row in rows] == [("candidates", "geom", 1)]
    assert_plays(rows[0][3])


def assert_plays(text: str) -> None:
    temporal = ET.fromstring(text.split("\n", 1)[1]).find("temporal")
    assert temporal is not None
    found = {k: temporal.get(k) for k in ("enabled", "mode", "startField", "endField")}
    assert found == {"enabled": "1", "mode": "2", "startField": "start", "endField": "end"}


def test_the_style_beside_the_geojson_plays(tmp_path: Path) -> None:
    write_candidates(tmp_path, frames([3]), CRS)
    assert_plays((tmp_path / "candidates.qml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("limit", [GEOJSON_LIMIT, 10])
def test_the_same_values_give_the_same_bytes(tmp_path: Path, limit: int) -> None:
    once, twice = tmp_path / "a", tmp_path / "b"
    for folder in (once, twice):
        folder.mkdir()
        write_candidates(folder, frames([9, 8]), CRS, start_utc=START, geojson_limit=limit)
    names = sorted(p.name for p in once.iterdir())
    assert names == sorted(p.name for p in twice.iterdir())
    for name in names:
        assert (once / name).read_bytes() == (twice / name).read_bytes(), name


def test_a_hundred_thousand_stay_geojson_and_one_more_does_not(tmp_path: Path) -> None:
    path = write_candidates(tmp_path, frames([60_000, 40_000]), CRS)
    assert path.suffix == ".geojson"
    assert pyogrio.read_info(path)["features"] == 100_000
    path = write_candidates(tmp_path, frames([60_000, 40_001]), CRS)
    assert path.suffix == ".gpkg"
    assert pyogrio.read_info(path, layer="candidates")["features"] == 100_001


def test_a_failure_leaves_the_old_file_whole_and_nothing_else(tmp_path: Path) -> None:
    path = write_candidates(tmp_path, frames([3]), CRS)
    before = path.read_bytes()
    bad = frames([3, 3])
    bad[1].xy[1] = np.inf
    with pytest.raises(CrsError, match="check the CRS"):
        write_candidates(tmp_path, bad, CRS)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["candidates.geojson", "candidates.qml"]


def test_times_without_a_start_count_from_1970_and_no_candidates_are_no_error(tmp_path: Path) -> None:
    features = json.loads(write_candidates(tmp_path, frames([1]), CRS).read_text())["features"]
    assert features[0]["properties"]["start"] == "1970-01-01T00:00:00.000Z"
    assert features[0]["properties"]["end"] == "1970-01-01T00:00:00.999Z"
    assert json.loads(write_candidates(tmp_path, [], CRS).read_text())["features"] == []


def test_frames_out_of_order_or_of_two_lengths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="order of time"):
        write_candidates(tmp_path, frames([1, 1])[::-1], CRS)
    with pytest.raises(ValueError, match="frame 0"):
        write_candidates(tmp_path, [(0.0, np.zeros((2, 2)), np.zeros(3), "lost")], CRS)
