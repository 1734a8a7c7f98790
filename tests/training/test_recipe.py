"""Recipes: what is written can be read back, what cannot be run is said on one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmr_cli.training.recipe import LocalRecipe, Recipe, RecipeError, ScanRecipe, read_recipe


def test_a_recipe_survives_its_file(tmp_path):
    recipe = Recipe().changed(hidden=(32, 64), learning_rate=0.5, overlap=0.7, start='my "own" weights.safetensors')
    (tmp_path / "r.toml").write_text(recipe.toml())
    assert read_recipe(tmp_path / "r.toml") == recipe


def test_missing_keys_keep_their_defaults(tmp_path):
    (tmp_path / "r.toml").write_text("steps = 7\nlearning_rate = 1\n[augment]\nnoise = 0\n")
    assert read_recipe(tmp_path / "r.toml") == Recipe(steps=7, learning_rate=1.0).changed(noise=0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stepps = 7", "unknown key 'stepps'"),
        ("[augment]\nspin = 1", "unknown key 'spin'"),
        ("steps = 'many'", "steps must be a whole number"),
        ("[augment]\ncentre = 1", "centre must be true or false"),
        ("hidden = [64, -1]", "hidden must be a list of whole numbers"),
        ("steps = 0", "steps = 0"),
        ("plain = 1.5", "plain of 1 at most"),
        ("held_out = 1.0", "held_out between 0 and 1"),
        ("chamfer_weight = 0", "no loss"),
        ("anchor_steps = 5000", "5000 anchor_steps of 3000 steps"),
        ("anchor_steps = 5\nanchor_width = 0", "anchor_width = 0"),
        ("steps =", "not valid TOML"),
        ("augment = 3", "must be a table"),
        ("kind = 'other'", "kind must be 'scans', 'global' or 'local'"),
        ("kind = 'local'\npoints = 3", "unknown key 'points'"),
        ("kind = 'local'\npairs = 2", "2 pairs; a batch of 4 needs more"),
        ("kind = 'local'\ntemperature = 0", "temperature = 0"),
    ],
)
def test_what_cannot_be_run_is_said_on_one_line(tmp_path, text, said):
    (tmp_path / "r.toml").write_text(text)
    with pytest.raises(RecipeError, match=said) as error:
        read_recipe(tmp_path / "r.toml")
    assert str(error.value).startswith(str(tmp_path / "r.toml"))
    assert "\n" not in str(error.value)


def test_a_local_recipe_survives_its_file_and_has_no_settings_of_the_global_one(tmp_path):
    recipe = LocalRecipe().changed(steps=7, rotation=None)
    (tmp_path / "r.toml").write_text(recipe.toml())
    assert read_recipe(tmp_path / "r.toml") == recipe
    with pytest.raises(RecipeError, match='"local" has no rotation'):
        recipe.changed(rotation=10.0)


@pytest.mark.parametrize("name", ["base", "local", "pointnetlk"])
def test_the_bundled_recipes_can_be_read(name):
    recipe = read_recipe(Path(__file__).parents[2] / f"models/{name}.toml")
    assert (recipe.kind, recipe.start) == ("local" if name == "local" else "global", "scratch")


def test_longer_runs_have_more_material_and_short_ones_no_share_for_the_global_encoder():
    one, ten = ScanRecipe().within(1), ScanRecipe().within(10)
    assert one.scans < ten.scans <= 40  # every two of them may be registered, which a minute has no time for
    assert one.pairs < ten.pairs
    assert one.made_up < ten.made_up
    assert one.whole_every == 0 < ten.whole_every
