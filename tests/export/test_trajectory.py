from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from small_region import CRS, estimate, flight

from brmgeo.export.trajectory import TimedPath, write_fixes, write_trajectory, write_tum


def paths() -> tuple[TimedPath, TimedPath]:
    t = np.arange(12) * 5.0
    xy = np.array([e.mean for e in flight()])
    smoothed = TimedPath(t, xy + 0.5, np.full(12, 0.7), np.full(12, 1.5), np.full(12, 150.0))
    return smoothed, TimedPath(t[:8], xy[:8])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_fixes_has_the_contract_s_columns_and_a_place_only_where_converged(tmp_path: Path) -> None:
    estimates = flight()
    files = [f"{i:04d}.jpg" for i in range(len(estimates))]
    files[5], files[6] = 'odd, "name".jpg', "=1+1.jpg"
    path = write_fixes(tmp_path / "fixes.csv", estimates, files, CRS)
    header = path.read_text(encoding="utf-8").splitlines()[0]
    assert header == "t_s,file,status,x,y,lon,lat,sigma_m,yaw_deg,heading_deg,candidates,mass"
    rows = rows_of(path)
    assert [r["file"] for r in rows] == [*files[:6], "'=1+1.jpg", *files[7:]]
    assert [r["status"] for r in rows] == [e.status for e in estimates]
    to_lonlat = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    for row, e in zip(rows, estimates):
        place = [row[k] for k in ("x", "y", "lon", "lat")]
        if e.status != "converged":
            assert place == ["", "", "", ""]
            continue
        lon, lat = to_lonlat.transform(*e.mean)
        np.testing.assert_allclose([float(v) for v in place], [*e.mean, lon, lat], atol=6e-4, rtol=0)
        assert abs(float(row["lon"]) - lon) <= 0.6e-7
        assert abs(float(row["lat"]) - lat) <= 0.6e-7
        assert float(row["sigma_m"]) == 4.0
        assert int(row["candidates"]) == e.candidate_count
    assert rows[0]["yaw_deg"] == rows[0]["heading_deg"] == ""
    assert rows[1]["t_s"] == "5"


@given(st.floats(-50, 50))
def test_heading_is_clockwise_from_north_whatever_the_yaw(
    tmp_path_factory: pytest.TempPathFactory, yaw: float
) -> None:
    path = tmp_path_factory.getbasetemp() / "heading.csv"
    row = rows_of(write_fixes(path, [estimate(0, 2e5, 5e5, "converged", yaw=yaw)], ["a"], CRS))[0]
    heading, written = float(row["heading_deg"]), float(row["yaw_deg"])
    assert 0 <= heading < 360
    assert -180 <= written < 180
    # The nose points (sin heading, cos heading) east and north.
    nose = math.sin(math.radians(heading)), math.cos(math.radians(heading))
    np.testing.assert_allclose(nose, (math.cos(yaw), math.sin(yaw)), atol=2e-5)
    np.testing.assert_allclose((heading + written) % 360, 90, atol=1e-9)


def test_tum_turns_the_body_s_nose_into_the_map(tmp_path: Path) -> None:
    yaw = np.array([0.0, 1.2, -3.0, np.nan])
    track = TimedPath(
        np.arange(4) * 0.1,
        np.array([[352_000.12345, 565_000.0]] * 4),
        yaw,
        None,
        np.array([1, 2, np.nan, 4.0]),
    )
    tum, sidecar = write_tum(
        tmp_path / "trajectory.tum", track, CRS, path_name="smoothed", height_reference="ground"
    )
    table = np.loadtxt(tum)
    assert table.shape == (4, 8)
    np.testing.assert_allclose(table[:, 0], track.t_s)
    np.testing.assert_allclose(table[:, 1:3], track.xy, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(table[:, 4:], axis=1), 1, atol=1e-8)
    nose = Rotation.from_quat(table[:3, 4:]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        nose, np.column_stack([np.cos(yaw[:3]), np.sin(yaw[:3]), np.zeros(3)]), atol=1e-7
    )
    facts = json.loads(sidecar.read_text(encoding="utf-8"))
    assert facts["epsg"] == 5187
    assert facts["rows_without_yaw"] == [3]
    assert facts["rows_without_height"] == [2]
    assert facts["origin"] == [0.0, 0.0, 0.0]
    assert facts["height_reference"] == "ground"


def test_geopackage_has_each_path_as_points_and_lines(tmp_path: Path) -> None:
    estimates = flight()
    smoothed, reference = paths()
    files = [f"{i}.png" for i in range(12)]
    write_trajectory(tmp_path, estimates, files, CRS, smoothed=smoothed, reference=reference)
    path = tmp_path / "trajectory.gpkg"
    names = {n for n, kind in pyogrio.list_layers(path) if kind is not None}
    assert names == {"online", "online_path", "smoothed", "smoothed_path", "reference", "reference_path"}
    online = pyogrio.read_dataframe(path, layer="online")
    assert online.crs == CRS
    assert list(online["frame"]) == [4, 5, 7, 8, 9, 10, 11]
    assert list(online["file"]) == [files[i] for i in online["frame"]]
    # The fix of frame 5 ends when frame 6, which is lost, begins.
    assert online["end"].iloc[1].timestamp() == pytest.approx(29.999)
    lines = pyogrio.read_dataframe(path, layer="online_path")
    assert [len(g.coords) for g in lines.geometry] == [2, 5], "the line is cut where a frame did not converge"
    smooth = pyogrio.read_dataframe(path, layer="smoothed_path").geometry[0]
    assert smooth.length == pytest.approx(np.hypot(*np.diff(smoothed.xy, axis=0).T).sum())
    assert pyogrio.read_dataframe(path, layer="reference")["sigma_m"].isna().all()
    styles = pyogrio.read_dataframe(path, layer="layer_styles", read_geometry=False)
    assert set(styles["f_table_name"]) == names
    assert styles["useAsDefault"].astype(bool).all()


def test_geojson_is_rfc_7946_with_lines_then_points(tmp_path: Path) -> None:
    smoothed, reference = paths()
    write_trajectory(tmp_path, flight(), ["a"] * 12, CRS, smoothed=smoothed, reference=reference)
    collection = json.loads((tmp_path / "trajectory.geojson").read_text(encoding="utf-8"))
    assert "crs" not in collection
    kinds = [(f["geometry"]["type"], f["properties"]["path"]) for f in collection["features"]]
    lines = [("LineString", p) for p in ("online", "online", "smoothed", "reference")]
    assert kinds == lines + [("Point", "online")] * 7 + [("Point", "smoothed")] * 12
    line = collection["features"][2]["geometry"]["coordinates"]
    back = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(*np.array(line).T)
    np.testing.assert_allclose(np.column_stack(back), smoothed.xy, atol=0.01)
    first = collection["features"][4]["properties"]
    assert (first["status"], first["sigma_m"], first["t_s"]) == ("converged", 4.0, 20.0)


def test_a_flight_without_any_fix_gives_files_without_places(tmp_path: Path) -> None:
    estimates = [estimate(float(i), 3e5, 5e5, "ambiguous", yaw=math.nan) for i in range(3)]
    write_trajectory(tmp_path, estimates, ["a", "b", "c"], CRS)
    assert json.loads((tmp_path / "trajectory.geojson").read_text())["features"] == []
    assert pyogrio.read_info(tmp_path / "trajectory.gpkg", layer="online")["features"] == 0
    assert (tmp_path / "trajectory.tum").read_text() == ""
    assert all(r["x"] == "" for r in rows_of(tmp_path / "fixes.csv"))


def test_the_same_values_give_the_same_bytes(tmp_path: Path) -> None:
    smoothed, reference = paths()
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_trajectory(tmp_path / name, flight(), ["f"] * 12, CRS, smoothed=smoothed, reference=reference)
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == [
        "fixes.csv",
        "trajectory.geojson",
        "trajectory.gpkg",
        "trajectory.json",
        "trajectory.tum",
    ]
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_lengths_that_differ_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="file names"):
        write_trajectory(tmp_path, flight(), ["a"], CRS)
    with pytest.raises(ValueError, match="a track of 2"):
        TimedPath(np.zeros(2), np.zeros((2, 2)), np.zeros(3))
    with pytest.raises(ValueError, match="decrease"):
        TimedPath(np.array([1.0, 0.0]), np.zeros((2, 2)))


def test_no_line_is_drawn_across_a_gap_of_the_smoothed_path(tmp_path: Path) -> None:
    whole, _ = paths()
    cut = replace(whole, segment=np.repeat([0, 3, 7], [5, 1, 6]))
    assert [(p.start, p.stop) for p in cut.pieces] == [(0, 5), (5, 6), (6, 12)]
    assert [(p.start, p.stop) for p in whole.pieces] == [(0, 12)]
    write_trajectory(tmp_path, flight(), [f"{i}.jpg" for i in range(12)], CRS, smoothed=cut)
    features = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    lines = [
        len(f["geometry"]["coordinates"])
        for f in features
        if f["geometry"]["type"] == "LineString" and f["properties"]["path"] == "smoothed"
    ]
    assert lines == [5, 6]
    drawn = pyogrio.read_dataframe(tmp_path / "trajectory.gpkg", layer="smoothed_path")
    assert [len(line.coords) for line in drawn.geometry] == [5, 6]
    assert len(pyogrio.read_dataframe(tmp_path / "trajectory.gpkg", layer="smoothed")) == 12
