"""The room around the table against closed forms: how bright it makes things, and what a mirror sees of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from agreement import cycles_geometry
from numpy.typing import NDArray

from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.annotation.scene import PosedModel
from synthetless.config import RecipeError, load_recipe
from synthetless.generation.sources import load_sources
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.sampling import Catalogue, ceiling_share, sample_scene
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import (
    AmbientLight,
    AreaLight,
    Intrinsics,
    Material,
    Mesh,
    ObjectSpec,
    Pose,
    RoomSpec,
    SceneSpec,
    Vector,
    View,
)

pytestmark = pytest.mark.blender

Floats = NDArray[np.float64]

CAMERA = Intrinsics(96, 80, 300.0, 300.0, 47.5, 39.5)
WHITE, MIRROR = Material((1.0, 1.0, 1.0), 1.0, 0.0), Material((1.0, 1.0, 1.0), 0.0, 0.5, 1.0)
BLACK: Vector = (0.0, 0.0, 0.0)
CARD, BALL = 1, 2
RADIUS_M = 0.03
CENTRE_M = (0.0, 0.0, 0.5)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> BlenderSession:
    """A card and a ball."""
    shapes = {CARD: trimesh.creation.box((0.2, 0.2, 0.0001)), BALL: trimesh.creation.icosphere(4, RADIUS_M)}
    meshes = {
        ("model", key): Mesh(np.array(shape.vertices, dtype=np.float64), np.array(shape.faces, dtype=np.int32))
        for key, shape in shapes.items()
    }
    log = tmp_path_factory.mktemp("light") / "log"
    settings = RenderSettings(samples=64, denoiser="none", bounces=1)
    return BlenderSession(meshes, CAMERA, settings, TableSettings(size_m=0.5), log=log)


def scene_of(obj_id: int, material: Material, room: RoomSpec, ambient: float = 0.0) -> tuple[SceneSpec, list[Pose]]:
    """One object half a metre above the table, without the lamp."""
    spec = sample_scene(load_recipe(None, ["objects.count=[1, 1]"]), Catalogue({obj_id: 0.06}, {}), 11, 0)
    spec = dataclasses.replace(
        spec,
        objects=(ObjectSpec("model", obj_id, material, spec.objects[0].release),),
        light=dataclasses.replace(spec.light, strength=0.0),
        ambient=AmbientLight(ambient, (1.0, 1.0, 1.0)),
        views=(View(0.5, 70.0, 20.0, 10.0, (0.0, 0.0, 0.0)),),
        room=room,
    )
    return spec, [Pose((1.0, 0.0, 0.0, 0.0), CENTRE_M)]


def brightness(session: BlenderSession, room: RoomSpec, ambient: float = 0.0) -> Floats:
    """(3,) linear colour of the card."""
    with session.scene(*scene_of(CARD, WHITE, room, ambient)) as scene:
        return scene.render(0)[30:50, 38:58].mean(axis=(0, 1)).astype(np.float64)


def dark_room(**changes: object) -> RoomSpec:
    return dataclasses.replace(RoomSpec(6.0, 3.0, BLACK, BLACK, (BLACK,) * 4, ()), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("radius_m", [0.02, 1.5])
def test_a_soft_lamp_is_as_bright_as_the_recipe_says(session: BlenderSession, radius_m: float) -> None:
    lamp = AreaLight(0.0, 90.0, 2.0, 0.7, radius_m, (1.0, 0.5, 0.25))
    found = brightness(session, dark_room(lamps=(lamp,)))
    np.testing.assert_allclose(found, 0.7 * np.array(lamp.color), rtol=0.02)


def test_the_ceiling_is_as_bright_as_the_recipe_says(session: BlenderSession) -> None:
    share = ceiling_share(6.0, 3.0 - CENTRE_M[2])
    found = brightness(session, dark_room(ceiling=(0.6 / share, 0.4 / share, 0.2 / share)))
    np.testing.assert_allclose(found, [0.6, 0.4, 0.2], rtol=0.03)


def test_ambient_light_is_the_same_inside_a_room(session: BlenderSession) -> None:
    np.testing.assert_allclose(brightness(session, dark_room(), ambient=0.35), 0.35, rtol=0.02)


def test_an_endless_ceiling_is_all_there_is_above() -> None:
    assert ceiling_share(1e6, 1.0) == pytest.approx(1.0, abs=1e-5)
    rng = np.random.default_rng(1)
    sine, angle = np.sqrt(rng.random(400_000)), rng.uniform(0, 2 * np.pi, 400_000)  # cosine-weighted directions
    reach = 2.0 * sine / np.sqrt(1 - sine**2)
    hits = (np.abs(reach * np.cos(angle)) < 1.5) & (np.abs(reach * np.sin(angle)) < 1.5)
    assert ceiling_share(3.0, 2.0) == pytest.approx(hits.mean(), abs=0.005)


ROOM = RoomSpec(
    side_m=4.0,
    height_m=2.5,
    ceiling=(0.9, 0.9, 1.0),
    floor=(0.1, 0.05, 0.02),
    walls=((0.6, 0.1, 0.1), (0.1, 0.6, 0.1), (0.1, 0.1, 0.6), (0.5, 0.5, 0.1)),
    lamps=(),
)


def seen_in_ball(spec: SceneSpec, R_w2c: Floats, t_w2c: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """(H, W, 3) colours of the room that a perfect mirror ball shows, and (H, W) where it shows ceiling or walls."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones_like(rows)], axis=-1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ R_w2c
    eye = -R_w2c.T @ t_w2c
    towards = np.array(CENTRE_M) - eye
    along = rays @ towards
    inside = RADIUS_M**2 - (towards @ towards - along**2)
    hit = inside > 0
    points = eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    normals = (points - CENTRE_M) / RADIUS_M
    mirrored = rays - 2 * (rays * normals).sum(axis=-1, keepdims=True) * normals
    assert spec.room is not None
    half, height = spec.room.side_m / 2, spec.room.height_m
    with np.errstate(divide="ignore"):
        ways = np.stack(
            [(sign * half - points[..., axis]) / mirrored[..., axis] for sign in (1, -1) for axis in (0, 1)]
            + [(height - points[..., 2]) / mirrored[..., 2]],
            axis=-1,
        )
    nearest = np.where(ways > 0, ways, np.inf).argmin(axis=-1)
    colours = np.array([*spec.room.walls, spec.room.ceiling])
    return colours[nearest], hit & (mirrored[..., 2] > 0.02)


def test_a_mirror_ball_sees_the_room(session: BlenderSession) -> None:
    spec, settled = scene_of(BALL, MIRROR, ROOM)
    with session.scene(spec, settled) as scene:
        seen = scene.render(0)
        expected, shown = seen_in_ball(spec, *scene.extrinsics(0))
    sure = shown.copy()  # neighbours that show the same side of the room
    for axis in (0, 1):
        for step in (1, -1):
            sure &= shown & (np.roll(expected, step, axis=axis) == expected).all(axis=-1)
            sure &= np.roll(shown, step, axis=axis)
    assert sure.sum() > 300
    assert len(np.unique(expected[sure], axis=0)) == 5, "ceiling and all walls"
    errors = np.abs(seen - expected)[sure].max(axis=-1)
    assert np.percentile(errors, 95) < 0.02


def test_a_room_hides_and_moves_nothing(session: BlenderSession, tmp_path: Path) -> None:
    spec, settled = scene_of(BALL, MIRROR, ROOM)
    with session.scene(spec, settled) as scene:
        rendered = cycles_geometry(scene, 0, tmp_path)
        R, t = scene.extrinsics(0)
    ball = session.meshes["model", BALL]
    caster = RayCaster({("model", BALL): (ball.vertices_m * 1000, ball.faces)})
    posed = PosedModel(BALL, R, R @ (np.array(CENTRE_M) * 1000) + t * 1000)
    ours = caster.annotate(CAMERA, Plane(R, t * 1000, 250.0), [posed]).instance_ids == 0
    theirs = rendered.numbers == 1
    assert (ours & theirs).sum() / (ours | theirs).sum() >= 0.99


def test_a_room_is_drawn_from_a_stream_of_its_own() -> None:
    catalogue = Catalogue({1: 0.05}, {})
    plain, roomy, again = (
        sample_scene(load_recipe(None, overrides), catalogue, 3, 4)
        for overrides in ([], ["light.room=ranges"], ["light.room={}"])
    )
    assert plain.room is None
    assert roomy == again
    assert dataclasses.replace(roomy, room=None) == plain
    other = sample_scene(load_recipe(None, ["light.room.lamps=[2, 2]"]), catalogue, 3, 4)
    assert other.room is not None and roomy.room is not None
    assert other.room.walls == roomy.room.walls and len(other.room.lamps) == 2


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("light.room=hall", "light.room"),
        ("light.room.walls=[0.4, 0.1]", "min 0.4 is greater than max 0.1"),
        ("light.room.side_m=[2, 3]", "the table, 6 m wide"),
        ("light.room.lamp_distance_m=[1, 9]", "light.room.lamp_distance_m reaches 9 m"),
        ("light.room.height_m=[1, 2]", "may be outside the room"),
    ],
)
def test_a_wrong_room_is_told_in_one_line(override: str, told: str) -> None:
    with pytest.raises(RecipeError, match=r"^[^\n]*$") as error:
        load_sources(load_recipe(None, [override]))
    assert told in str(error.value)
