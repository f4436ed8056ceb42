"""The recipe: files, overrides, and the one line that a wrong one is answered with."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from synthetless.config import Recipe, RecipeError, dump_recipe, load_recipe, settings

ROOT = Path(__file__).resolve().parents[1]
RECIPES = sorted((ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_the_recipes_of_the_project_load(path: Path) -> None:
    recipe = load_recipe(path)
    assert recipe.images > 0
    assert Recipe.model_validate(json.loads(json.dumps(dump_recipe(recipe)))) == recipe


def test_the_papers_recipe_has_the_papers_numbers() -> None:
    recipe = load_recipe(ROOT / "configs" / "synthetless.yaml")
    assert (recipe.images, recipe.camera.width, recipe.camera.height, recipe.camera.fx) == (30000, 400, 400, 1075)
    assert recipe.objects.count == (1, 9)
    assert recipe.camera.distance_m == (0.6, 1.4)
    assert recipe.camera.elevation_deg == (10, 89)
    assert recipe.light.elevation_deg == (30, 80)


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("seed: 3\ncamera: {distance_m: [1, 2]}\n")
    recipe = load_recipe(path, ["camera.distance_m=[0.5, 0.75]", "objects.ids=[1, 2]", "source.distractors=null"])
    assert recipe.seed == 3
    assert recipe.camera.distance_m == (0.5, 0.75)
    assert recipe.objects.ids == (1, 2)


def test_an_empty_file_is_the_default_recipe(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("")
    assert load_recipe(path) == Recipe()


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("camera.distanc_m=[1, 2]", ["camera.distanc_m", "did you mean camera.distance_m"]),
        ("distance_m=[1, 2]", ["distance_m", "did you mean camera.distance_m"]),
        ("imges=3", ["imges", "did you mean images"]),
        ("object.count=[1, 2]", ["did you mean objects"]),
        ("camera.distance_m=[3, 1]", ["camera.distance_m", "min 3.0", "max 1.0"]),
        ("camera.distance_m=[-1, 1]", ["-1.0", "0.05..20 m"]),
        ("camera.distance_m=7", ["camera.distance_m", "[min, max]"]),
        ("camera.distance_m=[1, .nan]", ["camera.distance_m", "finite"]),
        ("render.samples=.inf", ["render.samples", "finite"]),
        ("images=0", ["images", "1..100000000"]),
        ("images=1.5", ["images", "integer"]),
        ("camera=3", ["camera", "mapping"]),
        ("camera.distortion=[0.1, 0.2]", ["camera.distortion = [0.1, 0.2]", "expected 5 values, not 2"]),
        ("camera.distortion=[0, 0, 0, 0, 0, 0]", ["camera.distortion", "expected 5 values, not 6"]),
        ("light.room=yes", ["light.room = True", "none, ranges, or a mapping"]),
        ("sensor=yes", ["sensor = True", "none, ranges, primesense"]),
        ("labels.scheme=pitteri", ["labels.scheme", "pitteri2019", "atlas"]),
        ("outputs=[rgb, dpeth]", ["outputs", "dpeth", "depth"]),
        ("split=../else", ["split"]),
        ("images", ["images", "key.path=value"]),
        ("images=[", ["--set images", "neither JSON nor YAML"]),
        ("images.x=1", ["images"]),
    ],
)
def test_a_wrong_override_is_told_in_one_line(override: str, expected: list[str]) -> None:
    with pytest.raises(RecipeError) as error:
        load_recipe(None, [override])
    message = str(error.value)
    assert "\n" not in message
    for part in expected:
        assert part in message


@pytest.mark.parametrize("content", ["- a\n- b\n", "images: [\n", "\x00", "images: 3\nimages_: 4\n"])
def test_a_wrong_file_is_told_in_one_line_with_its_name(tmp_path: Path, content: str) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(content)
    with pytest.raises(RecipeError) as error:
        load_recipe(path)
    assert "\n" not in str(error.value)
    assert "wrong.yaml" in str(error.value)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no such recipe file"):
        load_recipe(tmp_path / "none.yaml")


def test_every_setting_is_described_with_its_range() -> None:
    for setting in settings():
        assert setting.description.endswith("."), setting.key
        assert setting.kind, setting.key


@given(st.sampled_from([s.key for s in settings()]))
def test_every_default_survives_being_set(key: str) -> None:
    default = next(setting.default for setting in settings() if setting.key == key)
    names = {"sensor": "ranges", "depth_sensor": "structured_light", "light.room": "ranges"}
    group = next((group for group in names if key.startswith(f"{group}.")), None)
    expected = load_recipe(None, [f"{group}={names[group]}"]) if group else Recipe()
    assert load_recipe(None, [f"{key}={json.dumps(default)}"]) == expected


def test_the_reference_page_is_up_to_date() -> None:
    page = (ROOT / "docs" / "recipe.md").read_text(encoding="utf-8")
    from synthetless.config import recipe_page

    assert page == recipe_page(), "run `make docs`"


def test_recipes_are_yaml_of_known_keys_only() -> None:
    keys = {setting.key for setting in settings()}
    for path in RECIPES:
        for key in _leaves(yaml.safe_load(path.read_text())):
            assert key in keys, (path.name, key)


def _leaves(tree: dict[str, object], prefix: str = "") -> list[str]:
    leaves = []
    for key, value in tree.items():
        leaves += _leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else [f"{prefix}{key}"]
    return leaves


def test_a_container_is_named_or_drawn_by_share() -> None:
    def shares(*overrides: str) -> tuple[float, float]:
        container = load_recipe(None, overrides).release.container
        return container.box.share, container.tray.share

    assert shares() == shares("release.container=none") == (0, 0)
    assert shares("release.container=box") == (1, 0)
    assert shares("release.container=box", "release.container.box.share=0.3", "release.container.tray.share=0.7") == (
        0.3,
        0.7,
    )
    assert shares("release.container=tray") == (0, 1), "what was set before is not kept"
    recipe = load_recipe(None, ["release.container=tray"])
    assert Recipe.model_validate(dump_recipe(recipe)) == recipe


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["release.container=crate"], "release.container = 'crate': unknown container; give none, box, tray"),
        (
            ["release.container.crate.share=1"],
            "unknown setting release.container.crate; did you mean release.container",
        ),
        (
            ["release.container=tray", "release.container.box.share=0.5"],
            "shares of box and tray add up to 1.5; at most 1",
        ),
        (["release.container.box.sides_m=[0.3, 0.2]"], "min 0.3 is greater than max 0.2; write [min, max]"),
        (["release.container.box.height_m=[0.01, 0.2]"], "0.01 m (wall_m) fills a container that is 0.01 m high"),
        (["release.container=yes"], "release.container = True: unknown container; give none, box, tray"),
        (["release.upright=[0, 1]"], "release.upright = [0, 1]"),
        (["release.crowding=0"], "release.crowding = 0: 0.0 is outside 0.1..10"),
    ],
)
def test_a_wrong_release_is_told_in_one_line(overrides: list[str], expected: str) -> None:
    with pytest.raises(RecipeError) as error:
        load_recipe(None, overrides)
    assert expected in str(error.value) and "\n" not in str(error.value)


def test_a_folder_of_distractors_alone_asks_for_some() -> None:
    assert load_recipe(None, ["source.distractors=others"]).objects.distractors == (2, 6)
    assert load_recipe(None, ["source.distractors=others", "objects.count=[1, 2]"]).objects.distractors == (2, 6)
    assert load_recipe(None, ["source.distractors=others", "objects.distractors=[1, 1]"]).objects.distractors == (1, 1)
    assert load_recipe(None).objects.distractors == (0, 0)
    stored = dump_recipe(Recipe()) | {"source": {"distractors": "others"}}
    assert Recipe.model_validate(stored).objects.distractors == (0, 0), "a stored recipe keeps its meaning"


def test_a_quality_sets_what_is_not_given() -> None:
    draft, standard = load_recipe(None, ["render.quality=draft"]).render, load_recipe(None).render
    assert draft.samples < standard.samples < load_recipe(None, ["render.quality=reference"]).render.samples
    assert draft.denoiser == "guided"
    mixed = load_recipe(None, ["render.quality=draft", "render.samples=77"]).render
    assert (mixed.samples, mixed.detail_samples, mixed.denoiser) == (77, 0, "guided")
    assert load_recipe(None, ["render.samples=5"]).render.detail_samples == standard.detail_samples
    unguided = load_recipe(None, ["render.denoiser=fast"]).render
    assert (unguided.samples, unguided.detail_samples) == (12, 0), "as many as it takes without guides"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["render.samples=8", "render.detail_samples=8"], "detail_samples = 8 must be more than samples = 8, or 0"),
        (["render.denoiser=fast", "render.detail_samples=20"], "needs the guided denoiser, not fast; give 0"),
    ],
)
def test_samples_that_could_not_be_spent_are_refused(given: list[str], told: str) -> None:
    with pytest.raises(RecipeError, match=re.escape(told)):
        load_recipe(None, given)


@pytest.mark.parametrize("quality", ["draft", "standard", "reference"])
def test_a_stored_recipe_says_what_its_quality_stood_for(quality: str) -> None:
    stored = dump_recipe(load_recipe(None, [f"render.quality={quality}"]))
    assert stored["render"]["samples"] > 0
    assert Recipe.model_validate(stored).render == load_recipe(None, [f"render.quality={quality}"]).render


def test_an_unknown_quality_is_told() -> None:
    for value in ("best", "[draft]", "3"):
        with pytest.raises(RecipeError, match=r"render\.quality"):
            load_recipe(None, [f"render.quality={value}"])
