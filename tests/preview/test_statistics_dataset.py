"""The statistics of datasets: they add up, they say nothing of a true recipe, and they find a false one."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from synthetless.config import Recipe, load_recipe
from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import SYMMETRIES_FILE
from synthetless.io.color import mean_luminance
from synthetless.io.files import read_bytes
from synthetless.io.images import decode_rgb
from synthetless.preview.distributions import Distribution, Observations, distributions, labelled_classes
from synthetless.preview.statistics import NEAR_JUMP_DEG, statistics
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.spec import Standing
from synthetless.symmetry import SymmetryTable
from tests.preview.conftest import images_of

DROPS = 1200
IDS = tuple(range(1, 11))
MATPLOTLIB = "matplotlib is not installed"


def _seen(recipe: Recipe, drops: int = DROPS, seed: int = 4) -> Observations:
    """What a dataset of a recipe would say, if every object were seen in the pose it is released in."""
    ids = recipe.objects.ids or IDS
    stands = dict.fromkeys(ids, Standing(False, 0.02, 0.04, 0.03))
    catalogue = Catalogue(dict.fromkeys(ids, 0.06), {}, standing=stands)
    scenes = [sample_scene(recipe, catalogue, seed, drop) for drop in range(drops)]
    seen = np.array([item.obj_id for scene in scenes for item in scene.objects])
    return Observations(
        obj_id=seen,
        visib_fract=np.zeros(len(seen)),
        distance_mm=np.full(len(seen), 700.0),
        objects_per_image=np.array([len(scene.objects) for scene in scenes]),
        views=[scene.views[0] for scene in scenes],
        exposure_gains=np.ones(drops),
        drops=scenes,
        luminance=np.full(9, 0.4),
    )


def _verdicts(seen: Observations, recipe: Recipe) -> dict[str, Distribution]:
    return {each.key: each for each in (labelled_classes(seen, IDS, recipe), *distributions(seen, recipe))}


@pytest.fixture(scope="module")
def by_default() -> Observations:
    return _seen(Recipe())


def test_what_the_recipe_draws_is_what_it_asked_for(by_default: Observations) -> None:
    found = _verdicts(by_default, Recipe())
    assert {key for key, each in found.items() if each.verdict == "differs"} == set()
    silent = {"labels_per_image", "visib_fract", "object_distance", "exposure_gain"}
    assert {key for key, each in found.items() if each.verdict != "as asked"} == silent


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("objects.ids=[1, 2, 3, 4, 5, 6, 7, 8, 9]", "classes"),
        ("objects.count=[1, 8]", "objects_per_drop"),
        ("objects.grey=[0.12, 0.8]", "grey"),
        ("objects.roughness=[0.4, 0.9]", "object_roughness"),
        ("camera.distance_m=[0.6, 1.3]", "camera_distance_m"),
        ("camera.elevation_deg=[10, 80]", "camera_elevation_deg"),
        ("camera.azimuth_deg=[0, 330]", "camera_azimuth_deg"),
        ("camera.roll_deg=[-12, 12]", "camera_roll_deg"),
        ("light.elevation_deg=[40, 80]", "light_elevation_deg"),
        ("light.strength=[0.3, 1.4]", "light_strength"),
        ("light.warmth=[0.1, 0.5]", "light_warmth"),
        ("light.ambient=[0.08, 0.4]", "ambient"),
        ("release.container.tray.share=0.1", "containers"),
        ("table.tile_m=[0.3, 1.0]", "tile"),
        ("table.specular=[0.0, 0.1]", "table_specular"),
    ],
)
def test_a_dataset_of_another_recipe_differs_there_and_nowhere_else(override: str, key: str) -> None:
    found = _verdicts(_seen(load_recipe(None, [override]), drops=500), Recipe())
    assert {name for name, each in found.items() if each.verdict == "differs"} == {key}


def test_containers_come_by_their_shares_and_what_is_set_down_is_not_taken_for_dropped() -> None:
    recipe = load_recipe(None, ["release.container.box.share=0.3", "release.container.tray.share=0.1"])
    upright = recipe.model_copy(update={"release": recipe.release.model_copy(update={"upright": 0.5})})
    for asked in (recipe, upright):
        found = _verdicts(_seen(asked, drops=500), asked)
        assert {key for key, each in found.items() if each.verdict == "differs"} == set()
        assert found["containers"].verdict == "as asked" and found["containers"].counts[0] > 200
    assert found["release"].values < 0.7 * sum(found["classes"].counts)


def test_rooms_and_materials_are_held_against_what_was_asked() -> None:
    overrides = ["light.room=ranges", "objects.metallic=[0, 0.5]", "objects.grey_scale=linear", "sensor=ranges"]
    recipe = load_recipe(None, overrides)
    found = _verdicts(_seen(recipe, drops=500), recipe)
    assert {key for key, each in found.items() if each.verdict == "differs"} == set()
    asked = {
        "room_side_m",
        "room_height_m",
        "soft_strength",
        "soft_azimuth_deg",
        "soft_lamps",
        "object_metallic",
        "grey",
    }
    assert {found[key].verdict for key in asked} == {"as asked"}
    assert found["luminance"].verdict == "not prescribed", "the sensor may over-expose"
    other = load_recipe(None, [*overrides, "light.room.lamp_strength=[0.1, 0.4]", "objects.metallic=[0.1, 0.5]"])
    found = _verdicts(_seen(other, drops=500), recipe)
    assert {key for key, each in found.items() if each.verdict == "differs"} == {"soft_strength", "object_metallic"}


def test_release_rotations_that_are_not_uniform_are_found(by_default: Observations) -> None:
    upright = [s for s in by_default.drops if abs(s.objects[0].release.rotation_wxyz[0]) < 0.5]
    assert _verdicts(replace(by_default, drops=upright), Recipe())["release"].verdict == "differs"


def test_expected_and_counts_have_the_same_sum(by_default: Observations) -> None:
    for each in _verdicts(by_default, Recipe()).values():
        assert sum(each.counts) == each.values
        if each.expected is not None:
            assert sum(each.expected) == pytest.approx(each.values)
        assert len(each.counts) == (len(each.categories) or len(each.edges) - 1)


def test_the_statistics_of_a_dataset_add_up(small_dataset: Path) -> None:
    labels = [label for image in images_of(small_dataset) for label in image.labels.gt_canonical]
    found = statistics(small_dataset)
    assert (found.images, found.instances, found.drops) == (6, len(labels), 3)
    assert {c.obj_id: c.instances for c in found.classes} == Counter(label["obj_id"] for label in labels)
    for each in found.classes:
        own = [label for label in labels if label["obj_id"] == each.obj_id]
        assert each.regressors == tuple(
            sum(label["regressor_index"] == i for label in own) for i in range(own[0]["n_regressors"])
        )
        near = np.mean([label["discontinuity_margin_deg"] < NEAR_JUMP_DEG for label in own])
        assert each.near_jump["pitteri2019"].share == pytest.approx(near)
        assert sum(map(sum, each.views)) == sum(map(sum, each.views_canonical)) == each.instances
        assert sum(each.regressors_random) == pytest.approx(each.instances)
    json.dumps(found.to_json(), allow_nan=False)


def test_the_other_scheme_is_counted_as_if_the_dataset_were_labelled_by_it(small_dataset: Path) -> None:
    stored = SymmetryTable.read(small_dataset / SYMMETRIES_FILE)
    atlas = SymmetryTable(stored.entries, "atlas")
    infos = {int(k): v for k, v in json.loads((small_dataset / "models/models_info.json").read_text()).items()}
    labels = {n: image.labels for n, image in enumerate(images_of(small_dataset))}
    gt, cameras = {n: each.gt for n, each in labels.items()}, {n: each.camera for n, each in labels.items()}
    relabelled = label_scene(gt, cameras, atlas, infos)
    for each in statistics(small_dataset, luminance_images=0).classes:
        own = [e for entries in relabelled.values() for e in entries if e["obj_id"] == each.obj_id]
        expected = np.mean([e["discontinuity_margin_deg"] < NEAR_JUMP_DEG for e in own])
        assert each.near_jump["atlas"].share == pytest.approx(expected)


def test_luminance_is_read_from_an_even_sample(small_dataset: Path) -> None:
    rgb = images_of(small_dataset)[0].scene.rgb(0)
    found = {each.key: each for each in statistics(small_dataset, luminance_images=4).distributions}
    assert found["luminance"].values == 4
    assert mean_luminance(decode_rgb(read_bytes(rgb))) == pytest.approx(0.70, abs=0.03)  # light that is uniform noise


@pytest.mark.parametrize(("level", "expected"), [(0, 0.0), (255, 1.0), (128, 128 / 255)])
def test_luminance_of_a_grey_image_is_its_displayed_value(level: int, expected: float) -> None:
    assert mean_luminance(np.full((3, 4, 3), level, np.uint8)) == pytest.approx(expected, abs=1e-6)


def test_plots_are_the_same_each_time_and_hold_no_live_text(by_default: Observations) -> None:
    pytest.importorskip("matplotlib", reason=MATPLOTLIB)
    from matplotlib import rc_context

    from synthetless.preview import plots

    hostile = Distribution(
        "k", "g", "t", "", 3, (), ("<script>$a$</script>", "$\\frac", "b&'\""), (1, 2, 0), None, None, None
    )
    with rc_context(plots._STYLE):
        first, again = plots.distribution_plot(hostile), plots.distribution_plot(hostile)
    assert first == again
    assert b"<script" not in first and b"&lt;script&gt;$a$" in first


@pytest.mark.filterwarnings("error")
def test_long_names_of_photographs_leave_room_for_the_bars() -> None:
    pytest.importorskip("matplotlib", reason=MATPLOTLIB)
    from synthetless.preview.plots import distribution_plot

    names = tuple(f"polyhaven_exterior_concrete_tile_facade_{number:02}_diff_1k.jpg" for number in range(30))
    svg = distribution_plot(Distribution("k", "g", "t", "", 30, (), names, (1,) * 30, None, None, None)).decode()
    shown = ["polyhaven_ext…29_diff_1k.jpg", "polyhaven_ext…08_diff_1k.jpg"]
    assert all(name in svg for name in shown)


def test_without_records_there_is_nothing_to_compare_with(small_dataset: Path, tmp_path: Path) -> None:
    adopted = _copy_without_recipe(small_dataset, tmp_path / "adopted")
    found = statistics(adopted)
    assert found.drops == 0 and not found.biased
    assert {each.verdict for each in found.distributions} == {"not prescribed"}


def _copy_without_recipe(source: Path, to: Path) -> Path:
    left_out: Any = shutil.ignore_patterns("dataset.json", "scene_spec.jsonl", ".records")
    shutil.copytree(source, to, ignore=left_out)
    return to
