"""Sampling: the same scene for the same numbers, within the recipe's ranges, each purpose on its own stream."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from scipy import stats

from synthetless.config import load_recipe
from synthetless.scenes.container import turn
from synthetless.scenes.rotations import matrix, random_rotation
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import SceneSettings
from synthetless.scenes.spec import SceneSpec, Standing

DIAMETERS = {1: 0.06, 5: 0.11, 8: 0.217}
CATALOGUE = Catalogue(DIAMETERS, {3: 0.09}, ("a.jpg", "b.jpg"))
MANY = 400


@pytest.fixture(scope="module")
def scenes() -> list[SceneSpec]:
    return [sample_scene(SceneSettings(), CATALOGUE, seed=7, drop=drop) for drop in range(MANY)]


def test_the_same_numbers_give_the_same_scene(scenes: list[SceneSpec]) -> None:
    assert sample_scene(SceneSettings(), CATALOGUE, seed=7, drop=3) == scenes[3]
    assert sample_scene(SceneSettings(), CATALOGUE, seed=8, drop=3) != scenes[3]
    assert scenes[2] != scenes[3]


def test_another_throw_changes_the_release_alone(scenes: list[SceneSpec]) -> None:
    again = sample_scene(SceneSettings(), CATALOGUE, seed=7, drop=3, attempt=1)
    before = scenes[3]
    releases = [(a.release, b.release) for a, b in zip(before.objects, again.objects, strict=True)]
    assert all(a != b for a, b in releases)
    unreleased = tuple(
        dataclasses.replace(b, release=a.release) for a, b in zip(before.objects, again.objects, strict=True)
    )
    assert dataclasses.replace(again, attempt=0, objects=unreleased) == before


def test_a_change_of_the_lamp_leaves_all_else(scenes: list[SceneSpec]) -> None:
    settings = load_recipe(None, ["light.strength=[2, 3]", "light.warmth=[0, 0]"])
    changed = sample_scene(settings, CATALOGUE, seed=7, drop=5)
    before = scenes[5]
    assert changed.light != before.light
    assert dataclasses.replace(changed, light=before.light) == before


def test_everything_stays_within_the_recipe(scenes: list[SceneSpec]) -> None:
    settings = SceneSettings()
    for scene in scenes:
        assert 1 <= len(scene.objects) <= 9
        view, light = scene.views[0], scene.light
        for value, (low, high) in (
            (view.distance_m, settings.camera.distance_m),
            (view.elevation_deg, settings.camera.elevation_deg),
            (light.elevation_deg, settings.light.elevation_deg),
            (light.strength, settings.light.strength),
            (scene.ambient.level, settings.light.ambient),
            (scene.plane.tile_m, settings.table.tile_m),
        ):
            assert low <= value <= high
        assert np.hypot(*view.aim_offset_m[:2]) <= settings.camera.aim_offset_m
        assert max(light.color) == 1.0
        for item in scene.objects:
            assert len(set(item.material.albedo)) == 1, "grey"


def test_objects_are_released_one_above_the_other(scenes: list[SceneSpec]) -> None:
    diameters = CATALOGUE.models
    for scene in scenes:
        for below, above in zip(scene.objects, scene.objects[1:], strict=False):
            apart = above.release.position_m[2] - below.release.position_m[2]
            assert apart > (diameters[below.obj_id] + diameters[above.obj_id]) / 2
        first = scene.objects[0]
        assert first.release.position_m[2] > diameters[first.obj_id] / 2


def test_every_object_and_count_is_equally_likely(scenes: list[SceneSpec]) -> None:
    ids = [item.obj_id for scene in scenes for item in scene.objects]
    assert stats.chisquare([ids.count(i) for i in CATALOGUE.models]).pvalue > 1e-4
    counts = [len(scene.objects) for scene in scenes]
    assert stats.chisquare([counts.count(n) for n in range(1, 10)]).pvalue > 1e-4
    assert any(len({i.obj_id for i in scene.objects}) < len(scene.objects) for scene in scenes), "with replacement"


def test_release_rotations_are_uniform_on_so3(scenes: list[SceneSpec]) -> None:
    rotations = [matrix(item.release.rotation_wxyz) for scene in scenes for item in scene.objects]
    for rotation in rotations[:100]:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    # Under the Haar measure every matrix entry is uniform on [-1, 1], and the angle has density (1 - cos a) / pi.
    entries = np.array(rotations).reshape(len(rotations), 9)
    for column in entries.T:
        assert stats.kstest(column, stats.uniform(-1, 2).cdf).pvalue > 1e-4
    angles = np.arccos(np.clip((entries[:, [0, 4, 8]].sum(axis=1) - 1) / 2, -1, 1))
    assert stats.kstest(angles, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-4


def test_distractors_are_mixed_in() -> None:
    settings = load_recipe(None, ["objects.count=[2, 2]", "objects.distractors=[3, 3]"])
    scenes = [sample_scene(settings, CATALOGUE, seed=1, drop=drop) for drop in range(20)]
    for scene in scenes:
        roles = [item.role for item in scene.objects]
        assert (roles.count("model"), roles.count("distractor")) == (2, 3)
        assert all(item.obj_id == 3 for item in scene.objects if item.role == "distractor")
    assert len({tuple(item.role for item in scene.objects) for scene in scenes}) > 1


def test_containers_are_drawn_by_their_shares_and_change_the_release_alone(scenes: list[SceneSpec]) -> None:
    settings = load_recipe(None, ["release.container.box.share=0.4", "release.container.tray.share=0.2"])
    boxed = [sample_scene(settings, CATALOGUE, seed=7, drop=drop) for drop in range(MANY)]
    kinds = Counter("none" if scene.container is None else scene.container.kind for scene in boxed)
    assert stats.chisquare([kinds[kind] for kind in ("none", "box", "tray")], [160, 160, 80]).pvalue > 1e-4
    for scene, before in zip(boxed, scenes, strict=True):
        if scene.container is None:
            assert scene == before
            continue
        within = settings.release.container.box if scene.container.kind == "box" else settings.release.container.tray
        for name in ("height_m", "wall_m", "slope_deg"):
            low, high = getattr(within, name)
            assert low <= getattr(scene.container, name) <= high
        assert all(within.sides_m[0] <= side <= within.sides_m[1] for side in scene.container.floor_m)
        released = [
            dataclasses.replace(a, release=b.release) for a, b in zip(scene.objects, before.objects, strict=True)
        ]
        assert dataclasses.replace(scene, container=None, objects=tuple(released)) == before
        assert [a.release.rotation_wxyz for a in scene.objects] == [b.release.rotation_wxyz for b in before.objects]
        again = sample_scene(settings, CATALOGUE, seed=7, drop=scene.drop, attempt=1)
        assert again.container == scene.container
        for item in scene.objects:
            reach = np.array(item.release.position_m) @ turn(scene.container)
            room = np.maximum(np.array(scene.container.floor_m) - DIAMETERS[item.obj_id], 0) / 2
            assert (np.abs(reach[:2]) <= room + 1e-9).all()
            assert item.release.position_m[2] > scene.container.wall_m + DIAMETERS[item.obj_id] / 2


@pytest.mark.parametrize("name", ["none", "box"])
def test_upright_objects_are_apart_and_the_others_are_poured_over_them(name: str) -> None:
    settings = load_recipe(None, ["release.upright=0.5", f"release.container={name}", "objects.count=[9, 9]"])
    stands = {i: Standing(i == 5, 0.4 * d, 0.8 * d, 0.3 * d) for i, d in DIAMETERS.items()}
    catalogue = dataclasses.replace(CATALOGUE, standing=stands)
    share = []
    for drop in range(60):
        scene = sample_scene(settings, catalogue, seed=3, drop=drop)
        ground = 0.0 if scene.container is None else scene.container.wall_m
        down = [item for item in scene.objects if abs(matrix(item.release.rotation_wxyz)[2, 2]) > 1 - 1e-12]
        share.append(len(down) / 9)
        for item in down:
            assert np.sign(matrix(item.release.rotation_wxyz)[2, 2]) == (-1 if item.obj_id == 5 else 1)
            foot = item.release.position_m[2] - stands[item.obj_id].origin_m
            assert foot == pytest.approx(ground + 0.001)
        for a, b in itertools.combinations(down, 2):
            apart = math.dist(a.release.position_m[:2], b.release.position_m[:2])
            assert apart >= stands[a.obj_id].radius_m + stands[b.obj_id].radius_m + 0.005
        highest = max((ground + 0.001 + stands[item.obj_id].height_m for item in down), default=ground)
        poured = [item for item in scene.objects if item not in down]
        assert all(item.release.position_m[2] - DIAMETERS[item.obj_id] / 2 > highest for item in poured)
    assert np.mean(share) == pytest.approx(0.5, abs=0.1) if name == "none" else np.mean(share) > 0.2


def test_several_views_share_the_scene_and_differ() -> None:
    settings = load_recipe(None, ["camera.views_per_drop=3"])
    scene = sample_scene(settings, CATALOGUE, seed=1, drop=0)
    assert len(set(scene.views)) == 3
    assert scene.views[0] == sample_scene(SceneSettings(), CATALOGUE, seed=1, drop=0).views[0]


@given(st.integers(0, 2**63 - 1), st.integers(0, 10**8))
@hypothesis_settings(max_examples=30)
def test_a_scene_survives_json(seed: int, drop: int) -> None:
    scene = sample_scene(load_recipe(None, ["release.container.box.share=0.5"]), CATALOGUE, seed, drop)
    text = json.dumps(dataclasses.asdict(scene))
    assert TypeAdapter(SceneSpec).validate_json(text) == scene


@given(st.integers(0, 2**32))
def test_a_quaternion_and_its_matrix_agree(seed: int) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    angle = 2 * np.arccos(min(1.0, abs(rotation[0])))
    assert np.trace(matrix(rotation)) == pytest.approx(1 + 2 * np.cos(angle), abs=1e-9)
    axis = np.array(rotation[1:])
    np.testing.assert_allclose(matrix(rotation) @ axis, axis, atol=1e-12)
