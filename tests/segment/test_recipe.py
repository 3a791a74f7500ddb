"""Recipes of training: what they say, what they are based on, and what is refused with file, line and key."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from small_recipes import TINY

from brmgeo.errors import MissingInputError, SettingsError
from brmgeo.region import load_region
from brmgeo.segment.recipe import read_recipe

ROOT = Path(__file__).resolve().parents[2]
RECIPES = ROOT / "data" / "recipes"


def test_the_projects_recipes_hold_and_never_train_on_what_is_for_testing() -> None:
    held = {
        region.generate.seed
        for path in (ROOT / "data" / "regions").glob("[a-z]*.toml")
        if (region := load_region(path)).generate and region.training.hold_out
    }
    assert 1 in held
    for path in RECIPES.glob("*.toml"):
        recipe = read_recipe(path)
        for source in recipe.source:
            if source.split != "test":
                assert not held & set(source.seeds), path
                assert source.kind != "flight"
                assert "sheffield" not in source.name


def test_a_recipe_says_only_what_differs_from_its_base(tmp_path: Path) -> None:
    whole, again = tmp_path / "whole.toml", tmp_path / "again.toml"
    whole.write_text(TINY)
    again.write_text(
        'base = "whole"\ntitle = "again"\n[training]\nsteps = 5\n'
        '[[source]]\nname = "towns"\nweight = 3.0\n[[source]]\nname = "more"\nkind = "pairs"\ngsd_m = 0.1\n'
    )
    base, recipe = read_recipe(whole), read_recipe(again)
    assert (recipe.title, recipe.training) == ("again", replace(base.training, steps=5))
    assert (recipe.unet, recipe.augment, recipe.work_gsd_m) == (base.unet, base.augment, base.work_gsd_m)
    first, *others, last = recipe.source
    assert first == base.source[0].model_copy(update={"weight": 3.0})
    assert (tuple(others), last.name) == (base.source[1:], "more")

    for text, said in {
        'base = "none"': r"no such recipe \(the base of again.toml\); there are: again, whole",
        "base = 3": "again.toml:1: base: give the name",
        'base = "../whole"': "give the name of a recipe in the same folder",
        'base = "again"': "again.toml:1: base: 'again' leads back to this recipe",
        'base = "whole"\n[training]\n[[source]]\nweight = 2.0': "again.toml:3: source.0.name: missing key",
        'base = "whole"\n[[source]]\nname = []': r"again.toml:3: source.0.name: .*string \(found \[\]\)",
        'base = "whole"\n[[source]]\nname = "towns"\nweight = 0': "again.toml:4: source.towns.weight: .*greater than 0",
    }.items():
        again.write_text(text)
        with pytest.raises((SettingsError, MissingInputError), match=said):
            read_recipe(again)
    again.write_text(
        'base = "whole"\n' + 2 * '[[source]]\nname = "towns"\nkind = "generated"\nseeds = [901]\n'
    )
    with pytest.raises(SettingsError, match="two sources have this name"):
        read_recipe(again)
    whole.write_text('base = "again"\n' + TINY)
    again.write_text('base = "whole"')
    with pytest.raises(SettingsError, match=r"whole.toml:1: base: 'again' leads back"):
        read_recipe(again)


def test_recipes_that_are_wrong_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "tiny.toml"
    with pytest.raises(MissingInputError, match="no such recipe"):
        read_recipe(path)
    path.write_text(TINY.replace("seeds = [901]", "seed = 901"))
    with pytest.raises(
        SettingsError, match=r"tiny.toml:19: source.towns.seed: unknown key; did you mean 'seeds'"
    ):
        read_recipe(path)
    path.write_text("title = ")
    with pytest.raises(SettingsError, match="not valid TOML"):
        read_recipe(path)
    for wrong, said in {
        "stepz = 4": r"tiny.toml:8: training.stepz: unknown key; did you mean 'steps'\?",
        "steps = 4.5": r"tiny.toml:8: training.steps: .*integer.*4\.5",
        "steps = 4\nseed = -1": r"tiny.toml:7: training: TrainSettings.seed = -1 is outside",
        'steps = 4\nlr = "high"': r"tiny.toml:9: training.lr: .*'high'",
        'steps = 4\ndevice = "tpu"': "training.device: .*cuda",
    }.items():
        path.write_text(TINY.replace('device = "cpu"\n', "").replace("steps = 4", wrong))
        with pytest.raises(SettingsError, match=said):
            read_recipe(path)
    for right, wrong, said in (
        (
            "gsd_m = [0.2, 0.4]",
            "gsd_m = [0.2]",
            r"tiny.toml:15: augment.gsd_m: has too few items \(found \[0.2\]\)",
        ),
        ("gsd_m = [0.2, 0.4]", "gsd_m = [0.3, 0.4]", "tiny.toml: work_gsd_m 0.25 lies outside"),
        ("widths = [8, 16]", "widths = [8, 16]\nin_channels = 4", "pictures have 3"),
        (
            "seeds = [903]",
            "seeds = [903]\nroof_m = 3.0",
            "tiny.toml:27: source.far: roof_m is of flights only",
        ),
        ("seeds = [903]", "", "tiny.toml:27: source.far: is of kind generated and names no seeds"),
        (
            'kind = "flight"\nsplit = "test"',
            'kind = "flight"',
            "tiny.toml:33: source.flown: a flight is for tests only",
        ),
        ('name = "far"', 'name = "held"', "tiny.toml: source held: two sources have this name"),
    ):
        path.write_text(TINY.replace(right, wrong))
        with pytest.raises(SettingsError, match=said):
            read_recipe(path)
    path.write_text(TINY + '[[source]]\nname = "own"\nkind = "tiles"\nregions = ["a", "a"]\n')
    with pytest.raises(SettingsError, match="region a is named twice"):
        read_recipe(path)
    path.write_text(TINY + '[[source]]\nname = "abroad"\nkind = "pairs"\n')
    with pytest.raises(SettingsError, match=r"source\.abroad: pairs are for training, and need their gsd_m"):
        read_recipe(path)
