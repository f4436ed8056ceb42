"""Cycles: pixels agree with poses, brightness means what the recipe says, and a render repeats to the bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh
from agreement import cycles_geometry
from numpy.typing import NDArray

from synthetless.annotation.instances import ImageAnnotation, PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.annotation.scene import container_surfaces, scene_caster
from synthetless.config import load_recipe
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.rotations import matrix
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import (
    AmbientLight,
    Coefficients,
    Intrinsics,
    Material,
    Mesh,
    ObjectSpec,
    Pose,
    SceneSpec,
    View,
)
from synthetless.scenes.textures import ProceduralTexture

pytestmark = pytest.mark.blender

CAMERAS = {
    "tless": Intrinsics(720, 540, 1075.65091572, 1073.90347929, 360.0, 270.0),
    "off-centre": Intrinsics(301, 200, 700.0, 840.0, 190.25, 60.5),
    "portrait": Intrinsics(180, 320, 520.0, 410.0, 80.0, 200.75),
}


def _meshes() -> dict[int, tuple[NDArray[np.float64], NDArray[np.int32]]]:
    shapes = {
        1: trimesh.creation.box((60, 40, 25)),
        2: trimesh.creation.cylinder(22, 50, sections=48),
        3: trimesh.creation.icosphere(subdivisions=3, radius=30),
        4: trimesh.creation.annulus(15, 32, 40),
    }
    return {
        key: (np.array(s.vertices, dtype=np.float64), np.array(s.faces, dtype=np.int32)) for key, s in shapes.items()
    }


def _session_and_caster(
    camera: Intrinsics, meshes: Mapping[int, tuple[NDArray[np.float64], NDArray[np.int32]]], folder: Path
) -> tuple[BlenderSession, RayCaster]:
    """Blender's session and our rays, of the same meshes."""
    session = BlenderSession(
        {("model", key): Mesh(vertices / 1000, faces) for key, (vertices, faces) in meshes.items()},
        camera,
        RenderSettings(),
        TableSettings(),
        log=folder / "log",
    )
    return session, RayCaster({("model", key): mesh for key, mesh in meshes.items()})


def _scene(recipe_overrides: list[str], diameters: Mapping[int, float], drop: int) -> tuple[SceneSpec, list[Pose]]:
    """A sampled scene whose objects hover in a grid: agreement needs no physics."""
    recipe = load_recipe(None, recipe_overrides)
    spec = sample_scene(recipe, Catalogue(diameters, {}), seed=11, drop=drop)
    poses = [
        Pose(item.release.rotation_wxyz, (0.08 * (k % 3) - 0.08, 0.08 * (k // 3) - 0.08, 0.07))
        for k, item in enumerate(spec.objects)
    ]
    return spec, poses


def _annotate(
    caster: RayCaster,
    camera: Intrinsics,
    spec: SceneSpec,
    poses: list[Pose],
    extrinsics: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> ImageAnnotation:
    R, t = extrinsics[0], extrinsics[1] * 1000
    posed = [
        PosedModel(item.obj_id, R @ matrix(pose.rotation_wxyz), R @ (np.array(pose.position_m) * 1000) + t)
        for item, pose in zip(spec.objects, poses, strict=True)
    ]
    return caster.annotate(camera, Plane(R, t, 3000.0), posed, container_surfaces(caster, spec, R, t))


def _assert_agreement(
    session: BlenderSession, caster: RayCaster, camera: Intrinsics, spec: SceneSpec, poses: list[Pose], folder: Path
) -> int:
    """Compare Cycles' own object index and depth with the ray-cast ones; return how many instances were compared."""
    with session.scene(spec, poses) as scene:
        rendered = cycles_geometry(scene, 0, folder)
        annotation = _annotate(caster, camera, spec, poses, scene.extrinsics(0))
    compared = 0
    for number in range(len(poses)):
        ours, theirs = annotation.instance_ids == number, rendered.numbers == number + 1
        if ours.sum() < 500:
            continue
        compared += 1
        both = ours & theirs
        assert both.sum() / (ours | theirs).sum() >= 0.99
        offset = np.argwhere(ours).mean(axis=0) - np.argwhere(theirs).mean(axis=0)
        assert np.abs(offset).max() < 0.1
        interior = both & _eroded(both)
        errors = np.abs(annotation.depth_mm - rendered.depth_mm)[interior]
        assert np.percentile(errors, 99.9) < 0.5
        assert np.median(errors) < 0.01
    return compared


def _eroded(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    import cv2

    inner: NDArray[np.bool_] = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return inner


@pytest.mark.parametrize("name", CAMERAS)
def test_pixels_and_poses_agree_for_any_camera(name: str, tmp_path: Path) -> None:
    camera, meshes = CAMERAS[name], _meshes()
    session, caster = _session_and_caster(camera, meshes, tmp_path)
    compared = 0
    for drop in range(2):
        overrides = ["objects.count=[7, 9]", "camera.distance_m=[0.5, 0.8]", "camera.roll_deg=[-180, 180]"]
        spec, poses = _scene(overrides, dict.fromkeys(meshes, 0.06), drop)
        compared += _assert_agreement(session, caster, camera, spec, poses, tmp_path)
    assert compared >= 5


@pytest.mark.parametrize("kind", ["box", "tray"])
def test_pixels_and_poses_agree_in_a_container(kind: str, tmp_path: Path) -> None:
    """Behind its sides and over its rim; the depth of the container itself is right, too."""
    camera, meshes = CAMERAS["off-centre"], _meshes()
    session, caster = _session_and_caster(camera, meshes, tmp_path)
    overrides = ["objects.count=[7, 9]", "camera.distance_m=[0.5, 0.6]", "camera.elevation_deg=[25, 35]"]
    spec, poses = _scene([*overrides, f"release.container={kind}"], dict.fromkeys(meshes, 0.06), 0)
    assert spec.container is not None and spec.container.kind == kind
    poses = [dataclasses.replace(pose, position_m=(*pose.position_m[:2], 0.05)) for pose in poses]
    assert _assert_agreement(session, caster, camera, spec, poses, tmp_path) >= 3
    with session.scene(spec, poses) as scene:
        depth_mm, extrinsics = cycles_geometry(scene, 0, tmp_path).depth_mm, scene.extrinsics(0)
    ours = _annotate(caster, camera, spec, poses, extrinsics).depth_mm
    bare = _annotate(caster, camera, dataclasses.replace(spec, container=None), poses, extrinsics).depth_mm
    shows_it = ours != bare
    assert shows_it.mean() > 0.02
    assert np.mean(np.abs(depth_mm - ours)[shows_it] < 0.5) > 0.99


@pytest.mark.tless
def test_pixels_and_poses_agree_on_real_models(tless_models: Path, tmp_path: Path) -> None:
    camera = CAMERAS["tless"]
    _agreement_of_models(load_models(tless_models, (1, 5, 8, 10, 18, 25, 27, 30)), camera, tmp_path)


def test_pixels_and_poses_agree_on_the_builtin_parts(builtin_models: Path, tmp_path: Path) -> None:
    _agreement_of_models(load_models(builtin_models), CAMERAS["tless"], tmp_path)


def _agreement_of_models(models: dict[int, ObjectModel], camera: Intrinsics, folder: Path) -> None:
    session = BlenderSession(
        {("model", key): Mesh(model.vertices_mm / 1000, model.faces) for key, model in models.items()},
        camera,
        RenderSettings(),
        TableSettings(),
        log=folder / "log",
    )
    caster = scene_caster({"model": models})
    diameters = {key: model.diameter_mm / 1000 for key, model in models.items()}
    compared = 0
    for drop in range(3):
        spec, poses = _scene(["objects.count=[8, 9]", "camera.distance_m=[0.65, 0.94]"], diameters, drop)
        compared += _assert_agreement(session, caster, camera, spec, poses, folder)
    assert compared >= 12


def _white_card(light_strength: float, ambient: float) -> tuple[SceneSpec, list[Pose]]:
    """A white matte card at the aim point, facing the lamp, and the camera beside the lamp."""
    spec, _ = _scene(["objects.count=[1, 1]"], {1: 0.05}, drop=0)
    light = dataclasses.replace(
        spec.light, azimuth_deg=0.0, elevation_deg=90.0, distance_m=2.0, strength=light_strength, color=(1.0, 1.0, 1.0)
    )
    card = ObjectSpec("model", 1, Material((1.0, 1.0, 1.0), 1.0, 0.0), spec.objects[0].release)
    spec = dataclasses.replace(
        spec,
        objects=(card,),
        light=light,
        ambient=AmbientLight(ambient, (1.0, 1.0, 1.0)),
        views=(View(1.0, 70.0, 0.0, 0.0, (0.0, 0.0, 0.0)),),
    )
    return spec, [Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.5))]


@pytest.fixture
def card_session(tmp_path: Path) -> BlenderSession:
    card = trimesh.creation.box((0.05, 0.05, 0.0001))
    mesh = Mesh(np.array(card.vertices, dtype=np.float64), np.array(card.faces, dtype=np.int32))
    settings = RenderSettings(samples=64, denoiser="none", bounces=0)
    return BlenderSession(
        {("model", 1): mesh},
        Intrinsics(32, 32, 700, 700, 15.5, 15.5),
        settings,
        TableSettings(size_m=0.5),
        log=tmp_path / "log",
    )


@pytest.mark.parametrize(("strength", "ambient"), [(0.8, 0.0), (0.0, 0.6), (0.5, 0.25)])
def test_brightness_is_what_the_recipe_says(card_session: BlenderSession, strength: float, ambient: float) -> None:
    spec, poses = _white_card(strength, ambient)
    with card_session.scene(spec, poses) as scene:
        centre = scene.render(0)[12:20, 12:20].mean()
    assert centre == pytest.approx(strength + ambient, rel=0.02)


def test_a_render_repeats_to_the_bit(card_session: BlenderSession) -> None:
    spec, poses = _white_card(0.5, 0.2)
    other, other_poses = _white_card(1.5, 0.1)
    images = []
    for current, at in ((spec, poses), (other, other_poses), (spec, poses)):
        with card_session.scene(current, at) as scene:
            images.append(scene.render(0))
    np.testing.assert_array_equal(images[0], images[2])
    assert not np.array_equal(images[0], images[1])


def test_a_scene_shows_its_own_texture_whatever_was_rendered_before(card_session: BlenderSession) -> None:
    spec, poses = _white_card(0.5, 0.2)
    poses = [Pose(poses[0].rotation_wxyz, (0.0, 0.0, -0.5))]  # below the table, out of sight
    tables = [
        dataclasses.replace(spec, plane=dataclasses.replace(spec.plane, texture=ProceduralTexture(family, 1)))
        for family in ("checks", "marble")
    ]

    def shown(table: SceneSpec) -> NDArray[np.float32]:
        with card_session.scene(table, poses) as scene:
            return scene.render(0)

    checks, marble, checks_again = shown(tables[0]), shown(tables[1]), shown(tables[0])
    assert np.abs(checks - marble).mean() > 0.01
    np.testing.assert_array_equal(checks, checks_again)


def test_nothing_is_left_of_a_scene(card_session: BlenderSession) -> None:
    data = card_session.bpy.data
    spec, poses = _white_card(0.5, 0.2)
    with card_session.scene(spec, poses):
        assert len(data.objects) == 4  # card, table, lamp, camera
    kinds = (data.objects, data.materials, data.lights, data.worlds, data.cameras, data.images)
    assert [len(kind) for kind in kinds] == [0] * len(kinds)
    assert len(data.meshes) == 1, "the model is kept for the next scene"


def test_the_log_takes_what_blender_prints(card_session: BlenderSession, capfd: pytest.CaptureFixture[str]) -> None:
    spec, poses = _white_card(0.5, 0.2)
    with card_session.scene(spec, poses) as scene:
        scene.render(0)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""
    assert card_session.log.stat().st_size > 0


LENSES: dict[str, Coefficients] = {
    "barrel": (-0.45, 0.15, 0.0, 0.0, 0.0),
    "pincushion": (0.4, 0.1, 0.0, 0.0, 0.0),
    "tangential": (-0.1, 0.02, 0.04, -0.03, 0.01),
}


@pytest.mark.parametrize("name", LENSES)
def test_behind_a_lens_the_picture_shows_what_the_rays_meet(name: str, tmp_path: Path) -> None:
    """Black parts before a white sky, in the picture as it is stored: a pixel is dark as far as parts cover it."""
    meshes, camera = _meshes(), Intrinsics(240, 180, 230.0, 228.0, 121.3, 86.6, LENSES[name])
    settings = RenderSettings(samples=16, denoiser="none", bounces=0)
    of_blender = {("model", key): Mesh(vertices / 1000, faces) for key, (vertices, faces) in meshes.items()}
    session = BlenderSession(of_blender, camera, settings, TableSettings(), log=tmp_path / "log")
    spec, poses = _scene(
        ["objects.count=[9, 9]", "camera.distance_m=[0.3, 0.3]", "camera.elevation_deg=[70, 80]"],
        dict.fromkeys(meshes, 0.06),
        drop=0,
    )
    black = tuple(dataclasses.replace(item, material=Material((0.0, 0.0, 0.0), 1.0, 0.0)) for item in spec.objects)
    spec = dataclasses.replace(spec, objects=black, ambient=AmbientLight(1.0, (1.0, 1.0, 1.0)))
    caster = RayCaster({("model", key): mesh for key, mesh in meshes.items()})
    with session.scene(spec, poses) as scene:
        for item in session.bpy.context.scene.objects:
            item.hide_render = item.type == "MESH" and not item.name.startswith("object")
        light = scene.render(0)
        ours = _annotate(caster, camera, spec, poses, scene.extrinsics(0)).instance_ids >= 0
    theirs = light[..., 1] < 0.5
    assert light.shape == (180, 240, 3)
    assert ours[np.r_[:20, -20:0]].any(), "parts are near the border, where the lens bends most"
    iou = (ours & theirs).sum() / (ours | theirs).sum()
    assert iou >= 0.99
    offset = np.argwhere(ours).mean(axis=0) - np.argwhere(theirs).mean(axis=0)
    assert np.abs(offset).max() < 0.1
