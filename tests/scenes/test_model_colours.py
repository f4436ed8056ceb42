"""The colours of a model's own file, as Cycles shows them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from synthetless.config import RecipeError, load_recipe
from synthetless.generation.sources import load_sources
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import (
    AmbientLight,
    Intrinsics,
    Material,
    Mesh,
    ObjectSpec,
    Pose,
    SceneSpec,
    SurfaceColours,
    View,
)
from synthetless.scenes.srgb import linear_of_levels

CORNERS = np.array([[-0.02, -0.02, 0], [0.02, -0.02, 0], [0.02, 0.02, 0], [-0.02, 0.02, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
RGB = np.array([[[200, 30, 20], [40, 180, 60]], [[30, 60, 190], [220, 210, 50]]], dtype=np.uint8)
"""Quarters of the card: far left, far right, near left, near right, if the camera looks along its y."""
PAINTED, TEXTURED, BARE = 1, 2, 3


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> BlenderSession:
    """A card with one colour at all its vertices, one with a texture of four quarters, and one without colours."""
    uv = ((CORNERS[FACES][..., :2] + 0.02) / 0.04).astype(np.float32)
    colours = {
        PAINTED: SurfaceColours(vertex_rgb=np.repeat(RGB[0, :1], 4, axis=0)),
        TEXTURED: SurfaceColours(texture=RGB.repeat(32, axis=0).repeat(32, axis=1), corner_uv=uv),
        BARE: None,
    }
    meshes = {("model", key): Mesh(CORNERS, FACES, colours=of) for key, of in colours.items()}
    log = tmp_path_factory.mktemp("colours") / "log"
    settings = RenderSettings(samples=16, denoiser="none", bounces=0)
    camera = Intrinsics(32, 32, 300, 300, 15.5, 15.5)
    return BlenderSession(meshes, camera, settings, TableSettings(size_m=0.5), log=log)


def shown(session: BlenderSession, obj_id: int, colour: str) -> NDArray[np.float32]:
    """(2, 2, 3) linear colours of the quarters of a card in even light, seen from above with its y upwards."""
    spec = sample_scene(load_recipe(None, ["objects.count=[1, 1]"]), Catalogue({obj_id: 0.06}, {}), 11, 0)
    material = Material((0.5, 0.5, 0.5), 1.0, 0.0, colour=colour)  # type: ignore[arg-type]
    spec = dataclasses.replace(
        spec,
        objects=(ObjectSpec("model", obj_id, material, spec.objects[0].release),),
        light=dataclasses.replace(spec.light, strength=0.0),
        ambient=AmbientLight(1.0, (1.0, 1.0, 1.0)),
        views=(View(0.3, 90.0, -90.0, 0.0, (0.0, 0.0, 0.0)),),
    )
    with session.scene(spec, [Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.5))]) as scene:
        image = scene.render(0)
    return image[[4, 4, 27, 27], [4, 27, 4, 27]].reshape(2, 2, 3)


@pytest.mark.blender
def test_a_texture_is_seen_where_it_belongs(session: BlenderSession) -> None:
    for _ in range(2):  # also when another scene has been taken apart
        np.testing.assert_allclose(shown(session, TEXTURED, "model"), linear_of_levels()[RGB], atol=0.01)


@pytest.mark.blender
def test_vertex_colours_are_seen_as_the_file_has_them(session: BlenderSession) -> None:
    expected = np.broadcast_to(linear_of_levels()[RGB[0, 0]], (2, 2, 3))
    np.testing.assert_allclose(shown(session, PAINTED, "model"), expected, atol=0.01)


@pytest.mark.blender
def test_a_grey_object_does_not_show_the_colours_of_its_file(session: BlenderSession) -> None:
    for obj_id in (PAINTED, TEXTURED, BARE):
        np.testing.assert_allclose(shown(session, obj_id, "grey"), 0.5, atol=0.01)


def drawn(colour: str) -> list[SceneSpec]:
    recipe = load_recipe(None, [f"objects.colour={colour}"])
    catalogue = Catalogue({PAINTED: 0.05, BARE: 0.05}, {}, coloured=[("model", PAINTED)])
    return [sample_scene(recipe, catalogue, 3, drop) for drop in range(40)]


def test_colours_are_drawn_from_a_stream_of_their_own() -> None:
    def colourless(scene: SceneSpec) -> SceneSpec:
        grey = (dataclasses.replace(i, material=dataclasses.replace(i.material, colour="grey")) for i in scene.objects)
        return dataclasses.replace(scene, objects=tuple(grey))

    grey, model, mixed = drawn("grey"), drawn("model"), drawn("mixed")
    assert [colourless(scene) for scene in model] == [colourless(scene) for scene in mixed] == grey
    seen = {
        name: [item.material.colour for scene in scenes for item in scene.objects if item.obj_id == PAINTED]
        for name, scenes in (("grey", grey), ("model", model), ("mixed", mixed))
    }
    assert set(seen["grey"]) == {"grey"} and set(seen["model"]) == {"model"}
    assert 0.3 < seen["mixed"].count("model") / len(seen["mixed"]) < 0.7
    assert {i.material.colour for scene in model for i in scene.objects if i.obj_id == BARE} == {"grey"}


def test_models_without_colours_are_refused_where_colours_are_asked_for(parts: Path) -> None:
    overrides = [f"source.models={parts}", "objects.ids=[1]"]
    with pytest.raises(RecipeError, match=r"^[^\n]*obj_000001\.ply has neither vertex colours nor a texture[^\n]*$"):
        load_sources(load_recipe(None, [*overrides, "objects.colour=model"]))
    assert load_sources(load_recipe(None, [*overrides, "objects.colour=mixed"])).catalogue.coloured == frozenset()
