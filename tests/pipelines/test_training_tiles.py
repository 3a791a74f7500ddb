"""`brmgeo tiles` over the small region and over foreign pairs: labels, splits, counts, refusals, resuming."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
import small_maps
from affine import Affine
from numpy.typing import NDArray
from pyproj import Transformer
from small_maps import BOUNDS, CRS, SHEETS, Answer, SmallRegion, brmgeo, painted

from brmgeo.codes import LABEL_BUILDING as BUILDING
from brmgeo.codes import LABEL_OTHER as OTHER
from brmgeo.codes import LABEL_UNKNOWN as UNKNOWN
from brmgeo.errors import SettingsError
from brmgeo.geo.grid import bounds_of, lattice
from brmgeo.geo.sheets import sheet_extent, sheet_polygon
from brmgeo.region import load_region
from brmgeo.segment.shards import TileSet, read_tiles
from brmgeo.synth.imagery import render_imagery
from brmgeo.synth.town import generate_town
from brmgeo.workflow.store import Store
from pipelines.cli import cli, run
from pipelines.trainable import held_ground, require_trainable
from pipelines.training_plan import plan_tiles
from pipelines.training_stages import none_left

Capture = pytest.CaptureFixture[str]
REAL = Path(os.environ.get("BRMGEO_REAL_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
REGIONS = Path(__file__).resolve().parents[2] / "data" / "regions"
TRAINING = """
[training]
tile_px = 64
overlap_px = 16
gsd_m = [0.8, 1.7]
empty_share = 0.05
block_m = 130
guard_m = 12
shard_tiles = 20
image_format = "png"
"""


def tiles_of(region: SmallRegion) -> TileSet:
    return read_tiles(region.out / "tiles")


def cut(capsys: Capture, region: SmallRegion, *words: object) -> Answer:
    return brmgeo(capsys, "tiles", "small", "--data", region.data, *words)


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> SmallRegion:
    """The small region with its training tiles; never change it, take a copy."""
    region = small_maps.make_source(tmp_path_factory.mktemp("tiled"))
    with region.toml.open("a", encoding="utf-8") as file:
        file.write(TRAINING)
    words = ["tiles", "small", "--data", str(region.data), "--scheduler", "serial"]
    assert run(lambda: cli(words, standalone_mode=False)) == 0
    return region


def centres(
    bounds: tuple[float, float, float, float], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    left, bottom, right, top = bounds
    at = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(left + at * (right - left), top - at * (top - bottom))
    return x, y


def test_labels_are_drawn_at_the_tiles_own_gsd(tiled: SmallRegion) -> None:
    tiles = tiles_of(tiled)
    assert {info.gsd_m for info in tiles.infos} == {0.8, 1.7}
    known_area = shapely.union_all([sheet_polygon(s, CRS) for s in SHEETS])
    differing = total = 0
    for i, info in enumerate(tiles.infos):
        image, label = tiles.read(i)
        assert image.shape == (64, 64, 3)
        assert info.bounds[2] - info.bounds[0] == pytest.approx(64 * info.gsd_m)
        assert np.rint(np.array(info.bounds) / info.gsd_m) == pytest.approx(
            np.array(info.bounds) / info.gsd_m
        )
        x, y = centres(info.bounds, 64)
        known = shapely.contains_xy(known_area, x, y)
        assert ((label == UNKNOWN) == ~known).mean() > 0.999
        truth = shapely.contains_xy(tiled.truth, x, y)
        both = known & (label != UNKNOWN)
        differing += int(((label == BUILDING) != truth)[both].sum())
        total += int(truth[both].sum())
        assert set(np.unique(label)) <= {OTHER, UNKNOWN, BUILDING}
        assert info.known_share == pytest.approx((label != UNKNOWN).mean(), abs=1e-6)
    # The sheets carry a few faults on purpose: repaired outlines differ by slivers.
    assert total > 2000
    assert differing < 0.02 * total
    assert any((tiles.read(i)[1] == UNKNOWN).any() for i in range(len(tiles)))


def test_images_are_resampled_from_the_source_tiles(tiled: SmallRegion) -> None:
    tiles = tiles_of(tiled)
    to_tiles = Transformer.from_crs(CRS, "EPSG:5181", always_xy=True)
    for i in range(0, len(tiles), 7):
        image, _ = tiles.read(i)
        x, y = centres(tiles.infos[i].bounds, 64)
        expected = painted(*to_tiles.transform(x, y))
        assert np.abs(image - expected).max() < 2.5


def test_splits_keep_their_distance_in_the_map(tiled: SmallRegion) -> None:
    frame = gpd.read_file(tiled.out / "tiles" / "index.gpkg", layer="tiles")
    tiles = tiles_of(tiled)
    assert list(frame["key"]) == [info.key for info in tiles.infos]
    assert list(frame["building_share"]) == [info.building_share for info in tiles.infos]
    assert set(frame["split"]) == {"train", "validation", "test"}
    assert frame.crs.to_epsg() == 5187
    assert set(frame["source"]) == {"Generated footprints; Painted tiles"}
    grounds = {name: own.geometry.union_all() for name, own in frame.groupby("split")}
    assert grounds["train"].distance(grounds["test"]) >= 12
    assert grounds["train"].distance(grounds["validation"]) >= 12
    assert grounds["validation"].distance(grounds["test"]) >= 12
    styles = gpd.read_file(tiled.out / "tiles" / "index.gpkg", layer="layer_styles")
    assert "categorizedSymbol" in styles["styleQML"].iat[0]


def test_tiles_json_counts_what_is_there(tiled: SmallRegion) -> None:
    tiles = tiles_of(tiled)
    facts = tiles.facts
    assert facts["tiles"] == len(tiles)
    assert sum(facts["by_gsd_m"].values()) == len(tiles)
    for split, own in facts["splits"].items():
        found = [tiles.infos[i].gsd_m for i in tiles.of_split(split)]
        assert own["by_gsd_m"] == {str(gsd): found.count(gsd) for gsd in sorted(set(found))}
    assert facts["survey"]["kept"] == len(tiles)
    assert facts["survey"]["kept"] + sum(facts["survey"]["dropped"].values()) == facts["survey"]["candidates"]
    for split, told in facts["splits"].items():
        labels = [tiles.read(i) for i in tiles.of_split(split)]
        whole = np.stack([label for _, label in labels])
        colours = np.stack([image for image, _ in labels])[whole != UNKNOWN] / 255
        assert told["tiles"] == len(labels)
        assert told["pixels"]["building"] == (whole == BUILDING).sum()
        assert told["pixels"]["unknown"] == (whole == UNKNOWN).sum()
        np.testing.assert_allclose(told["mean"], colours.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(told["std"], colours.std(axis=0), atol=1e-6)
    assert facts["survey"]["dropped"]["guard"] > 0
    assert facts["sources"][0] == {"what": "imagery", "attribution": "Painted tiles", "terms": "free for all"}
    assert facts["alignment"]["status"] == "cannot tell"


def test_tiles_without_buildings_are_sampled_down(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data", store=False)
    # Apartments alone leave most of the ground empty.
    region.edit('paths = ["sheets/*.dxf"]', 'paths = ["sheets/*.dxf"]\nlayers = ["B0014115", "B0014113"]')
    region.edit("empty_share = 0.05", "empty_share = 0.3")
    assert cut(capsys, region, "--gsd", "0.8", "--split", "train").status == 0
    tiles = tiles_of(region)
    empty = sum(info.building_share == 0 for info in tiles.infos)
    survey = tiles.facts["survey"]
    assert survey["dropped"]["empty"] > 0
    assert survey["dropped"]["empty"] + empty >= survey["ground"]["empty"] > 0.5 * survey["ground"]["tiles"]
    assert 0.3 * len(tiles) - 1 < empty <= 0.3 * len(tiles)
    assert tiles.facts["splits"]["train"]["empty_tiles"] == empty


def test_a_second_run_computes_nothing_and_a_lost_shard_is_made_alone(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    assert "start" not in cut(capsys, region).err
    assert "tile-survey              fresh" in brmgeo(capsys, "status", "small", "--data", region.data).out
    before = {p.name: p.read_bytes() for p in (region.out / "tiles").glob("*.tar")}
    artifacts = sorted((region.data / "work" / "artifacts" / "tiles").iterdir())
    assert len(artifacts) > 3
    stamps = {a: a.stat().st_mtime_ns for a in artifacts[1:]}
    shutil.rmtree(artifacts[0])
    shutil.rmtree(region.out / "tiles")
    said = cut(capsys, region).err
    assert said.count(": start") == 1
    assert stamps == {a: a.stat().st_mtime_ns for a in artifacts[1:]}
    assert before == {p.name: p.read_bytes() for p in (region.out / "tiles").glob("*.tar")}


def test_other_settings_leave_no_shard_of_the_old_ones(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    region.edit("guard_m = 12", "guard_m = 15")
    why = brmgeo(capsys, "why", "small", "tile-survey", "--data", region.data).out
    assert "guard_m: 12.0 -> 15.0" in why
    assert cut(capsys, region, "--gsd", "1.7", "--split", "test").status == 0
    tiles = tiles_of(region)
    assert {info.split for info in tiles.infos} == {"test"}
    assert {info.gsd_m for info in tiles.infos} == {1.7}
    assert {p.name for p in (region.out / "tiles").glob("*.tar")} == {
        s["file"] for s in tiles.facts["shards"]
    }


def test_files_of_the_users_own_stay_beside_the_tiles(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    own = {"small-backup.tar", "small-0800-777.tar", "small-0800-000.tar.part"}
    for name in own:
        (region.out / "tiles" / name).write_bytes(b"mine")
    edited = tiles_of(region).facts["shards"][0]["file"]
    (region.out / "tiles" / edited).write_bytes(b"mine too")
    said = cut(capsys, region, "--gsd", "1.7", "--split", "test")
    assert said.status == 0
    shards = {s["file"] for s in tiles_of(region).facts["shards"]}
    assert edited not in shards
    assert f"{edited}: not as brmgeo wrote it, so it is kept" in said.out + said.err
    own.add(edited)
    assert {p.name for p in (region.out / "tiles").glob("*.tar*")} == shards | own


def test_gsds_equal_to_the_millimetre_are_refused(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    assert (
        "[0.8001, 0.8004] are the same to the millimetre"
        in cut(capsys, tiled, "--gsd", "0.8001,0.8004").error
    )
    region = tiled.copied_to(tmp_path / "data", store=False)
    region.edit("gsd_m = [0.8, 1.7]", "gsd_m = [0.8001, 1.7, 0.8004]")
    assert "small.toml:24: training: two of 'gsd_m'" in cut(capsys, region).error


@pytest.mark.slow
def test_workers_give_the_same_bytes(tiled: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    region = tiled.copied_to(tmp_path / "data", store=False)
    assert cut(capsys, region, "--scheduler", "local").status == 0
    for path in sorted((tiled.out / "tiles").iterdir()):
        if not path.name.startswith("."):
            assert path.read_bytes() == (region.out / "tiles" / path.name).read_bytes(), path.name


def test_flights_with_results_elsewhere_are_remembered(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    monkeypatch.setattr("pipelines.localize.localize", lambda *args, **kw: None)
    monkeypatch.setattr("brmgeo.flight.folder.read_flight", lambda folder: SimpleNamespace(name="f"))
    words = ("localize", "small", "--data", region.data, "--flight", tmp_path)
    assert brmgeo(capsys, *words).status == 0
    require_trainable(load_region(region.toml), region.data)
    assert brmgeo(capsys, *words, "--out", tmp_path / "elsewhere").status == 0
    with pytest.raises(
        Exception, match=r"flown over by flights with results elsewhere \(.*small/flown says so\)"
    ):
        require_trainable(load_region(region.toml), region.data)


def test_held_out_and_flown_regions_are_for_testing_only(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    flight = region.data / "source" / "small" / "flights" / "north"
    flight.mkdir(parents=True)
    (flight / "flight.toml").write_text('name = "north"\n')
    evaluated = region.out / "evaluation"
    evaluated.mkdir()
    with pytest.raises(Exception, match="flown over by north, the simulated flights of brmgeo evaluate"):
        require_trainable(load_region(region.toml), region.data)
    evaluated.rmdir()
    assert "flown over by north" in cut(capsys, region).error
    with pytest.raises(Exception, match="flown over by north"):
        require_trainable(load_region(region.toml), region.data)
    region.edit("shard_tiles = 20", "shard_tiles = 20\nhold_out = true")
    for split in ("train", "validation", "blocks"):
        assert "is held out" in cut(capsys, region, "--split", split).error
    assert cut(capsys, region).status == 0
    tiles = tiles_of(region)
    assert {info.split for info in tiles.infos} == {"test"}
    assert tiles.facts["hold_out"] is True
    region.edit("hold_out = true", 'hold_out = true\nsplit = "train"')
    assert "never trained on" in cut(capsys, region).error


def test_real_ground_that_is_held_out_is_kept_out_of_neighbours(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    _, bottom, right, top = BOUNDS
    own = load_region(region.toml)
    assert held_ground(own, region.data) == []
    text = region.toml.read_text(encoding="utf-8").replace('name = "small"', 'name = "other"')
    text = text.replace(
        f"bounds = {list(BOUNDS)}", f"bounds = [{right - 60}, {bottom}, {right + 500}, {top}]"
    )
    (region.data / "regions" / "other.toml").write_text(text + "hold_out = true\n", encoding="utf-8")
    held = held_ground(own, region.data)
    assert [name for name, _ in held] == ["other"]
    assert held[0][1][0] == pytest.approx(right - 60 - 12)
    plan, _ = plan_tiles(own, Store(tmp_path / "work"), region.data)
    assert plan.steps["tile-survey"].settings.held[0][0] == "other"
    assert cut(capsys, region, "--gsd", "1.7", "--split", "train").status == 0
    tiles = tiles_of(region)
    assert tiles.facts["survey"]["dropped"]["held-out ground"] > 0
    assert max(info.bounds[2] for info in tiles.infos) <= right - 60 - 12


def test_where_all_tiles_are_left_out_the_reasons_are_told(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    text = region.toml.read_text(encoding="utf-8").replace('name = "small"', 'name = "other"')
    (region.data / "regions" / "other.toml").write_text(text + "hold_out = true\n", encoding="utf-8")
    error = cut(capsys, region, "--split", "train", "--gsd", "1.7").error
    assert "no tile is left: 20 on held-out ground; that of other: give other bounds" in error
    said = none_left("r", {"empty": 3, "unknown": 12}, {"unknown": "look there"})
    assert said == "r: no tile is left: 12 unknown, 3 without building; look there"


def test_imagery_beside_the_region_is_told(tiled: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    region = tiled.copied_to(tmp_path / "data", store=False)
    text = region.toml.read_text(encoding="utf-8")
    start, end = text.index("[imagery]"), text.index("[ratio]")
    text = text[:start] + '[imagery]\nkind = "raster"\npath = "far.tif"\n' + text[end:]
    region.toml.write_text(text.replace("gsd_m = [0.8, 1.7]", "gsd_m = [1.7]"), encoding="utf-8")
    far = Affine(1.0, 0.0, BOUNDS[0] + 5000, 0.0, -1.0, BOUNDS[3])
    shape = {"width": 64, "height": 64, "count": 3, "dtype": "uint8", "crs": CRS, "transform": far}
    with rasterio.open(region.tiles.parent / "far.tif", "w", driver="GTiff", **shape) as out:
        out.write(np.full((3, 64, 64), 90, np.uint8))
    assert "no image lies on the region's bounds: the nearest" in cut(capsys, region).error


def test_a_held_out_region_far_away_stops_none(tiled: SmallRegion, tmp_path: Path) -> None:
    region = tiled.copied_to(tmp_path / "data", store=False)
    text = 'name = "far"\ncrs = "EPSG:32636"\nbounds = [454330, 38480, 455017, 38859]\n[training]\nhold_out = true\n'
    (region.data / "regions" / "far.toml").write_text(text, encoding="utf-8")
    assert held_ground(load_region(region.toml), region.data) == []


def test_a_copy_of_a_held_out_town_is_not_trained_on(tmp_path: Path) -> None:
    (tmp_path / "regions").mkdir()
    text = (REGIONS / "town-a.toml").read_text(encoding="utf-8")

    def town(name: str, *changes: tuple[str, str]) -> None:
        new = text.replace('name = "town-a"', f'name = "{name}"')
        for before, after in changes:
            assert before in new
            new = new.replace(before, after)
        path = tmp_path / "regions" / f"{name}.toml"
        path.write_text(new, encoding="utf-8")
        require_trainable(load_region(path), tmp_path)

    town("first")
    (tmp_path / "source" / "first" / "flights" / "x").mkdir(parents=True)
    (tmp_path / "source" / "first" / "flights" / "x" / "flight.toml").touch()
    copies = (
        (),
        (("style = 28", 'style = 28\nseason = "winter"'),),
        (("EPSG:5187", "EPSG:5186"),),
        (("[180460.0", "[180463.0"),),
    )
    for number, changes in enumerate(copies):
        with pytest.raises(SettingsError, match="the same generated town as first, which is held out or"):
            town(f"copy-{number}", *changes)
    town("other", ("seed = 101", "seed = 109"))
    town("moved", ("[180460.0, 456580.0", "[180360.0, 456580.0"))
    town(
        "elsewhere", ("[180460.0, 456580.0, 181560.0, 457680.0]", "[181600.0, 456580.0, 182700.0, 457680.0]")
    )


def test_gsds_much_finer_than_the_imagery_are_left_out(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data")
    said = cut(capsys, region, "--gsd", "0.5,1.7", "--split", "test")
    assert said.status == 0
    assert "nothing cut at 0.5 m: much finer than the imagery's 1 m per pixel" in said.err
    assert tiles_of(region).facts["survey"]["gsd_too_fine_m"] == [0.5]
    error = cut(capsys, region, "--gsd", "0.25,0.5").error
    assert "much coarser than all of the training.gsd_m 0.25, 0.5" in error


def test_blank_and_missing_imagery_is_dropped_and_counted(
    tiled: SmallRegion, tmp_path: Path, capsys: Capture
) -> None:
    region = tiled.copied_to(tmp_path / "data", store=False)
    pictures = sorted(region.tiles.rglob("*.png"))
    blank = np.full((256, 256, 3), 229, np.uint8)
    for path in pictures[: len(pictures) // 2]:
        cv2.imwrite(str(path), blank)
    pictures[-1].unlink()
    region.edit('terms = "free for all"', 'terms = "free for all"\nmissing_share = 0.3')
    assert cut(capsys, region).status == 0
    dropped = tiles_of(region).facts["survey"]["dropped"]
    assert dropped["blank"] > 0
    assert dropped["unknown"] > 0
    for path in pictures[:-1]:
        cv2.imwrite(str(path), blank)
    assert " blank, " in (error := cut(capsys, region).error)
    assert "no tile is left" in error
    assert error.endswith("see that the imagery is not of one colour there")


def test_filler_is_no_ground(tiled: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    """Imagery filled up with black or white where it ends says nothing of the ground there."""
    region = tiled.copied_to(tmp_path / "data", store=False)
    for path in region.tiles.rglob("*.png"):
        picture = cv2.imread(str(path))
        picture[:, :128] = 0
        picture[:, 192:] = 255
        cv2.imwrite(str(path), picture)
    assert cut(capsys, region, "--gsd", "0.8", "--split", "train").status == 0
    tiles = tiles_of(region)
    filled = 0
    for i in range(len(tiles)):
        image, label = tiles.read(i)
        plain = (image == 0).all(-1) | (image == 255).all(-1)
        inner = cv2.erode(plain.astype(np.uint8), np.ones((15, 15))) > 0
        assert (label[inner] == UNKNOWN).all()
        filled += int(inner.sum())
    assert filled > 1000


def test_options_are_refused_in_one_line(tiled: SmallRegion, tmp_path: Path, capsys: Capture) -> None:
    data = tiled.data
    assert "give a REGION" in brmgeo(capsys, "tiles", "--data", data).error
    assert "there is no region 'smal'" in brmgeo(capsys, "tiles", "smal", "--data", data).error
    assert (
        "--out takes one REGION" in brmgeo(capsys, "tiles", "a", "b", "--out", tmp_path, "--data", data).error
    )
    assert "goes with --pairs" in brmgeo(capsys, "tiles", "small", "--name", "x", "--data", data).error
    assert "greater than or equal to 0.02" in cut(capsys, tiled, "--gsd", "0.001").error
    plain = tiled.copied_to(tmp_path / "data", store=False)
    text = plain.toml.read_text(encoding="utf-8")
    start, end = text.index("[imagery]"), text.index("[ratio]")
    plain.toml.write_text(text[:start] + text[end:], encoding="utf-8")
    assert "has no imagery" in cut(capsys, plain).error
    assert not plain.out.exists()


# --- labels beside the imagery -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_labels_are_moved_onto_the_imagery_when_asked(tmp_path: Path, capsys: Capture) -> None:
    bounds, shift = (184_900.0, 451_000.0, 185_340.0, 451_440.0), (2.4, -1.6)
    town = generate_town(bounds, 31)
    image = render_imagery(town, lattice(bounds, CRS, 0.4))
    source = tmp_path / "source" / "off"
    source.mkdir(parents=True)
    town.footprints().to_file(source / "map.gpkg", layer="buildings")
    place = Affine(0.4, 0.0, bounds[0] + shift[0], 0.0, -0.4, bounds[3] + shift[1])
    with rasterio.open(
        source / "ortho.tif",
        "w",
        driver="GTiff",
        width=1100,
        height=1100,
        count=3,
        dtype="uint8",
        crs=CRS,
        transform=place,
    ) as out:
        out.write(np.moveaxis(image, -1, 0))
    (tmp_path / "regions").mkdir()
    (tmp_path / "regions" / "off.toml").write_text(
        f'name = "off"\ncrs = "{CRS}"\nbounds = {list(bounds)}\n[footprints]\npaths = ["map.gpkg"]\n'
        '[imagery]\nkind = "raster"\npath = "ortho.tif"\n[ratio]\nradii_m = [40.0]\n'
        '[training]\ntile_px = 256\ngsd_m = [0.5]\nsplit = "train"\nmin_known_share = 0.2\n',
        encoding="utf-8",
    )
    said = brmgeo(capsys, "tiles", "off", "--data", tmp_path)
    assert said.status == 0, said.err
    assert "--align moves the labels by it" in said.err
    plain = read_tiles(tmp_path / "out" / "off" / "tiles")
    told = plain.facts["alignment"]
    assert (told["dx_m"], told["dy_m"]) == pytest.approx(shift, abs=0.2)
    assert told["corrected"] is False
    truth = shapely.transform(
        shapely.union_all([b.polygon for b in town.buildings]), lambda xy: xy + np.array(shift)
    )

    def agreement(tiles: TileSet) -> float:
        both = either = 0
        for i, info in enumerate(tiles.infos):
            label = tiles.read(i)[1]
            x, y = centres(info.bounds, 256)
            own, real = label == BUILDING, shapely.contains_xy(truth, x, y) & (label != UNKNOWN)
            both, either = both + int((own & real).sum()), either + int((own | real).sum())
        return both / either

    assert agreement(plain) < 0.8
    assert brmgeo(capsys, "tiles", "off", "--data", tmp_path, "--align").status == 0
    aligned = read_tiles(tmp_path / "out" / "off" / "tiles")
    assert aligned.facts["alignment"]["corrected"] is True
    assert agreement(aligned) > 0.93
    layers = gpd.list_layers(tmp_path / "out" / "off" / "tiles" / "index.gpkg")["name"]
    assert {"tiles", "alignment"} <= set(layers)


# --- foreign pairs ---------------------------------------------------------------------------------------------------


@pytest.fixture
def pairs(tmp_path: Path) -> tuple[Path, Path]:
    rng = np.random.default_rng(6)
    folders = (tmp_path / "images", tmp_path / "masks")
    for folder in folders:
        folder.mkdir()
    for i in range(5):
        image = rng.integers(0, 256, (48, 64, 4 if i == 2 else 3), dtype=np.uint8)
        if i == 2:
            image[..., 3] = 255
            image[:, :32, 3] = 0
        if i == 4:
            image[:] = 255
        mask = np.zeros((48, 64), np.uint8)
        mask[8 : 20 + i, 10:40] = 255 if i else 1
        cv2.imwrite(str(folders[0] / f"p {i}.png"), image)
        cv2.imwrite(str(folders[1] / f"p {i}.png"), mask)
    return folders


def make(capsys: Capture, pairs: tuple[Path, Path], *words: object) -> Answer:
    out = pairs[0].parent / "out"
    given = ["--gsd", "0.075", "--out", out, "--attribution", "Those who flew", *words]
    return brmgeo(capsys, "tiles", "--pairs", *pairs, *given)


def test_pairs_become_tiles_as_they_are(pairs: tuple[Path, Path], capsys: Capture) -> None:
    said = make(capsys, pairs, "--terms", "CC BY 4.0", "--name", "city")
    assert said.status == 0, said.err
    assert "4 tiles (train), 1 left out" in said.err
    tiles = read_tiles(pairs[0].parent / "out")
    assert [info.key for info in tiles.infos] == ["city-p-0", "city-p-1", "city-p-2", "city-p-3"]
    for i, info in enumerate(tiles.infos):
        image, label = tiles.read(i)
        original = cv2.imread(str(pairs[0] / f"p {i}.png"), -1)
        seen = original[..., 3] >= 128 if original.shape[-1] == 4 else np.ones((48, 64), bool)
        np.testing.assert_array_equal(image[seen], original[..., 2::-1][seen])
        assert (label[~seen] == UNKNOWN).all()
        assert (label[8 : 20 + i, 34:40] == BUILDING).all()
        assert (info.split, info.gsd_m, info.crs) == ("train", 0.075, "")
        assert np.isnan(info.bounds).all()
    assert tiles.facts["sources"][0]["attribution"] == "Those who flew"
    assert not (pairs[0].parent / "out" / "index.gpkg").exists()
    assert "start" not in make(capsys, pairs, "--terms", "CC BY 4.0", "--name", "city").err


def test_pairs_left_out_are_counted_by_reason(pairs: tuple[Path, Path], capsys: Capture) -> None:
    rng = np.random.default_rng(7)
    cloud = rng.integers(232, 239, (48, 64, 1), dtype=np.uint8).repeat(3, axis=2)
    cloud[8:21, 10:40] = rng.integers(0, 256, (13, 30, 3))
    cv2.imwrite(str(pairs[0] / "p 1.png"), cloud)
    for name in ("e 0.png", "e 1.png", "e 2.png"):
        shutil.copy(pairs[0] / "p 3.png", pairs[0] / name)
        cv2.imwrite(str(pairs[1] / name), np.zeros((48, 64), np.uint8))
    said = make(capsys, pairs)
    assert "3 tiles (train), 5 left out (3 without building, 1 cloudy, 1 unknown)" in said.err
    survey = read_tiles(pairs[0].parent / "out").facts["survey"]
    assert (survey["candidates"], survey["kept"]) == (8, 3)
    assert survey["dropped"] == {"cloudy": 1, "empty": 3, "unknown": 1}
    assert survey["ground"]["empty"] == 3
    assert make(capsys, pairs, "--empty-share", "0.5").status == 0
    tiles = read_tiles(pairs[0].parent / "out")
    assert sorted(info.building_share == 0 for info in tiles.infos) == [False] * 3 + [True] * 3
    for path in pairs[1].iterdir():
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    error = make(capsys, pairs).error
    assert "no tile is left: 7 without building, 1 unknown; --empty-share 1 keeps them" in error
    assert make(capsys, pairs, "--empty-share", "1").status == 0
    assert len(read_tiles(pairs[0].parent / "out")) == 7
    assert "give finite numbers" in make(capsys, pairs, "--empty-share", "nan").error


def test_pictures_of_a_flight_are_for_testing_only(pairs: tuple[Path, Path], capsys: Capture) -> None:
    (pairs[0].parent / "flight.toml").touch()
    for split in ("train", "validation"):
        error = make(capsys, pairs, "--split", split).error
        assert f"{pairs[0]} is of a flight" in error
    assert not (pairs[0].parent / "out").exists()
    assert make(capsys, pairs, "--split", "test").status == 0


def test_tiles_of_something_else_are_not_mixed_with(
    tiled: SmallRegion, tmp_path: Path, pairs: tuple[Path, Path], capsys: Capture
) -> None:
    out = tmp_path / "there"
    shutil.copytree(tiled.out / "tiles", out)
    before = sorted(p.name for p in out.iterdir())
    assert "holds tiles of small, which those of pairs would" in make(capsys, pairs, "--out", out).error
    assert sorted(p.name for p in out.iterdir()) == before
    assert make(capsys, pairs, "--out", out, "--name", "small").status == 0
    assert {p.name for p in out.iterdir() if not p.name.startswith(".")} == {
        "index.csv", "tiles.json", "small-000.tar",
    }  # fmt: skip
    (out / "tiles.json").write_text('{"mine": 1}')
    assert "holds another tiles.json" in make(capsys, pairs, "--out", out).error


def test_names_that_a_key_cannot_tell_apart_get_numbers(pairs: tuple[Path, Path], capsys: Capture) -> None:
    for folder in pairs:
        shutil.copy(folder / "p 1.png", folder / "p-1.png")
    assert make(capsys, pairs).status == 0
    keys = [info.key for info in read_tiles(pairs[0].parent / "out").infos]
    assert len(set(keys)) == len(keys) == 5


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("no mask", "1 pictures have no partner, such as p 3"),
        ("no folder", "is not a folder"),
        ("empty folder", "holds no picture"),
        ("odd value", "masks/p 3.png: holds the value 9"),
        ("coloured mask", "masks/p 3.png: a mask has one band"),
        ("other size", "64 x 40 px, its image"),
        ("16 bit", "holds uint16 values"),
        ("damaged", "damaged or cut short"),
        ("no picture", "no picture that can be decoded"),
        ("cut short", "damaged or cut short"),
        ("same name", "several pictures named p 3"),
        ("tiny", "training tiles have 32 to 8192 px"),
    ],
)
def test_bad_pairs_are_refused_in_one_line(
    pairs: tuple[Path, Path], capsys: Capture, fault: str, said: str
) -> None:
    images, masks = pairs
    file = masks / "p 3.png"
    mask = cv2.imread(str(file), -1)
    if fault == "no mask":
        file.unlink()
    elif fault == "no folder":
        shutil.rmtree(masks)
    elif fault == "empty folder":
        shutil.rmtree(images)
        images.mkdir()
    elif fault == "odd value":
        cv2.imwrite(str(file), np.where(mask == 255, 9, 0).astype(np.uint8))
    elif fault == "coloured mask":
        cv2.imwrite(str(file), np.dstack([mask, mask, 255 - mask]))
    elif fault == "other size":
        cv2.imwrite(str(file), mask[:40])
    elif fault == "16 bit":
        cv2.imwrite(str(images / "p 3.png"), np.zeros((48, 64, 3), np.uint16))
    elif fault == "damaged":
        (images / "p 3.png").write_bytes((images / "p 3.png").read_bytes()[:60])
    elif fault == "no picture":
        (images / "p 3.png").write_bytes(b"no picture")
    elif fault == "cut short":
        whole = cv2.imencode(".jpg", cv2.imread(str(images / "p 3.png")))[1].tobytes()
        (images / "p 3.png").unlink()
        (images / "p 3.jpg").write_bytes(whole[: len(whole) // 2])
    elif fault == "same name":
        shutil.copy(images / "p 3.png", images / "p 3.jpg")
    elif fault == "tiny":
        for folder in pairs:
            cv2.imwrite(str(folder / "p 3.png"), mask[:20, :20])
    assert said in make(capsys, pairs).error
    assert not list((images.parent / "out").glob("*.tar"))


def test_pairs_want_their_options(pairs: tuple[Path, Path], capsys: Capture, tmp_path: Path) -> None:
    assert "give --out" in brmgeo(capsys, "tiles", "--pairs", *pairs).error
    assert "have neither map nor place" in brmgeo(capsys, "tiles", "demo", "--pairs", *pairs).error
    assert "no place to make blocks of" in make(capsys, pairs, "--split", "blocks").error


# --- real data and the regions that come along -----------------------------------------------------------------------


@pytest.mark.skipif(
    not (REAL / "training-kampala").is_dir(), reason="no real training data here (BRMGEO_REAL_DATA)"
)
def test_kampala_goes_in_as_a_region(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "regions").mkdir()
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "kampala").symlink_to(REAL / "training-kampala")
    text = (REGIONS / "kampala.toml").read_text(encoding="utf-8")
    text = text.replace("gsd_m = [0.075, 0.12, 0.2]", "gsd_m = [0.2]")
    text = text.replace("454329.8, 38479.5, 455017.4, 38859.0", "454788.0, 38707.0, 455017.5, 38859.0")
    text = text.replace("missing_share = 0.9", "missing_share = 0.45")
    (tmp_path / "regions" / "kampala.toml").write_text(text, encoding="utf-8")
    said = brmgeo(capsys, "tiles", "kampala", "--data", tmp_path)
    assert said.status == 0, said.err
    tiles = read_tiles(tmp_path / "out" / "kampala" / "tiles")
    assert len(tiles) >= 15
    assert tiles.facts["splits"]["train"]["building_share"] == pytest.approx(0.3, abs=0.06)
    told = tiles.facts["alignment"]
    assert told["status"] == "told"  # OpenStreetMap's outlines were traced on this very imagery
    assert np.hypot(told["dx_m"], told["dy_m"]) < 0.3


@pytest.mark.skipif(
    not (REAL / "training-christchurch").is_dir(), reason="no real training data here (BRMGEO_REAL_DATA)"
)
def test_christchurch_goes_in_as_pairs(tmp_path: Path, capsys: Capture) -> None:
    folders = (tmp_path / "images", tmp_path / "masks")
    for folder in folders:
        folder.mkdir()
        for path in sorted((REAL / "training-christchurch" / folder.name).iterdir())[:12]:
            shutil.copy(path, folder)
    assert make(capsys, folders, "--name", "christchurch").status == 0
    tiles = read_tiles(tmp_path / "out")
    assert len(tiles) == 11  # one of them is plain white
    assert all(tiles.read(i)[0].shape == (224, 224, 3) for i in range(11))


def test_the_generated_towns_are_sound_and_none_is_the_demo() -> None:
    demo = load_region(REGIONS / "demo.toml")
    assert demo.training.hold_out
    towns = [load_region(path) for path in sorted(REGIONS.glob("town-*.toml"))]
    assert len(towns) == 8
    assert sum(town.training.hold_out for town in towns) == 2
    recipes = [town.generate for town in (demo, *towns)]
    assert len({recipe.seed for recipe in recipes if recipe}) == 9
    assert len({recipe.style for recipe in recipes if recipe}) == 9
    for town in towns:
        assert town.bounds is not None
        assert shapely.box(*sheet_extent(town.sheets[0], town.crs)).contains(shapely.box(*town.bounds))


def test_a_style_changes_only_the_regions_that_name_one(tmp_path: Path) -> None:
    store = Store(tmp_path / "work")
    demo, _ = plan_tiles(load_region(REGIONS / "demo.toml"), store, tmp_path)
    town, names = plan_tiles(load_region(REGIONS / "town-a.toml"), store, tmp_path)
    keyed = demo.steps["source"].origin["settings"]
    assert keyed.keys() == {"seed", "sheets", "bounds", "crs", "level"}
    assert town.steps["source"].origin["settings"]["style"] == town.steps["source"].settings.style == 28
    assert demo.steps["tile-survey"].settings.split == "test"
    assert set(names) <= set(town.steps)
    assert bounds_of(lattice(BOUNDS, CRS, 0.5)) == BOUNDS
    assert json.dumps(town.steps["tile-index"].origin["settings"])
