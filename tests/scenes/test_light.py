"""What stands around the table against closed forms: how bright it makes things, and what a mirror sees of it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from agreement import cycles_geometry
from numpy.typing import NDArray
from pydantic import TypeAdapter

from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.annotation.scene import PosedModel
from synthetless.config import RecipeError, load_recipe
from synthetless.errors import UserError
from synthetless.generation.progress import Tracker, silent
from synthetless.generation.sources import check_pictures, load_sources
from synthetless.io.images import encode_exr
from synthetless.scenes.environments import sky_brightness
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.sampling import Catalogue, ceiling_share, sample_scene
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import (
    AmbientLight,
    AreaLight,
    EnvironmentSpec,
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
from synthetless.scenes.spec import plain as plain_spec
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS

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
    settings = RenderSettings(samples=32, denoiser="none", bounces=1)
    return BlenderSession(meshes, CAMERA, settings, TableSettings(size_m=0.5), log=log)


def scene_of(
    obj_id: int, material: Material, room: RoomSpec | None, ambient: float = 0.0
) -> tuple[SceneSpec, list[Pose]]:
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


def test_the_ceiling_shines_also_where_light_does_not_bounce(session: BlenderSession) -> None:
    kept = session.settings
    try:
        session.settings = kept.model_copy(update={"bounces": 0})
        session.configure(session.settings)
        share = ceiling_share(6.0, 3.0 - CENTRE_M[2])
        found = brightness(session, dark_room(ceiling=(0.6 / share, 0.4 / share, 0.2 / share)))
    finally:
        session.settings = kept
        session.configure(kept)
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


def mirrored_rays(R_w2c: Floats, t_w2c: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """(H, W, 3) points of the ball, metres, the directions in which it mirrors there, and (H, W) where it is seen."""
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
    return points, rays - 2 * (rays * normals).sum(axis=-1, keepdims=True) * normals, hit


def room_in_ball(room: RoomSpec, R_w2c: Floats, t_w2c: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """(H, W, 3) colours of the room that a perfect mirror ball shows, and (H, W) where it shows ceiling or walls."""
    points, mirrored, hit = mirrored_rays(R_w2c, t_w2c)
    half, height = room.side_m / 2, room.height_m
    with np.errstate(divide="ignore"):
        ways = np.stack(
            [(sign * half - points[..., axis]) / mirrored[..., axis] for sign in (1, -1) for axis in (0, 1)]
            + [(height - points[..., 2]) / mirrored[..., 2]],
            axis=-1,
        )
    nearest = np.where(ways > 0, ways, np.inf).argmin(axis=-1)
    colours = np.array([*room.walls, room.ceiling])
    return colours[nearest], hit & (mirrored[..., 2] > 0.02)


def test_a_mirror_ball_sees_the_room(session: BlenderSession) -> None:
    spec, settled = scene_of(BALL, MIRROR, ROOM)
    with session.scene(spec, settled) as scene:
        seen = scene.render(0)
        expected, shown = room_in_ball(ROOM, *scene.extrinsics(0))
    sure = shown.copy()  # neighbours that show the same side of the room
    for axis in (0, 1):
        for step in (1, -1):
            sure &= shown & (np.roll(expected, step, axis=axis) == expected).all(axis=-1)
            sure &= np.roll(shown, step, axis=axis)
    assert sure.sum() > 300
    assert len(np.unique(expected[sure], axis=0)) == 5, "ceiling and all walls"
    errors = np.abs(seen - expected)[sure].max(axis=-1)
    assert np.percentile(errors, 95) < 0.02


def shining(directions: Floats, turn_deg: float) -> NDArray[np.float32]:
    """Light that differs from everywhere, turned about the vertical; (..., 3) for unit vectors (..., 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    levels = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)
    return (0.5 + 0.4 * levels).astype(np.float32)


def panorama(height: int = 256) -> NDArray[np.float32]:
    """It, as seen from its middle: the azimuth 0 in the middle column, greater ones to the left."""
    elevation = np.pi / 2 - np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.pi - np.pi * (np.arange(2 * height) + 0.5)[None] / height
    parts = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth)
    return shining(np.stack(parts, axis=-1), 0.0)


def write_hdr(path: Path, light: NDArray[np.float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = cv2.imencode(".hdr", light[..., ::-1])[1]
    path.write_bytes(encoded.tobytes())


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_a_mirror_ball_sees_the_panorama(session: BlenderSession, tmp_path: Path, suffix: str) -> None:
    light = panorama()
    if suffix == ".hdr":
        write_hdr(tmp_path / "sky.hdr", light)
    else:
        (tmp_path / "sky.exr").write_bytes(encode_exr(light))
    spec, settled = scene_of(BALL, MIRROR, None, ambient=0.1)
    spec = dataclasses.replace(spec, environment=EnvironmentSpec(f"sky{suffix}", 130.0, 2.0))
    session.panoramas = tmp_path
    with session.scene(spec, settled) as scene:
        seen = scene.render(0)
        _, mirrored, hit = mirrored_rays(*scene.extrinsics(0))
    expected = 0.1 + 2.0 / sky_brightness(light) * shining(mirrored, 130.0)
    shown = cv2.erode((hit & (mirrored[..., 2] > 0.02)).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert shown.sum() > 300
    assert np.percentile(np.abs(seen - expected)[shown].max(axis=-1), 95) < 0.03


def test_a_panorama_is_as_bright_as_the_recipe_says(session: BlenderSession, tmp_path: Path) -> None:
    light = panorama()
    assert sky_brightness(light) == pytest.approx(0.5 + 0.4 * 0.0722 * 2 / 3, abs=1e-4)  # of the blue, z grows by 2/3
    assert sky_brightness(np.ones((64, 128, 3), dtype=np.float32)) == pytest.approx(1.0, abs=1e-6)
    write_hdr(tmp_path / "sky.hdr", 7 * light)
    spec, settled = scene_of(CARD, WHITE, None)
    spec = dataclasses.replace(spec, environment=EnvironmentSpec("sky.hdr", 10.0, 0.6))
    session.panoramas = tmp_path
    with session.scene(spec, settled) as scene:
        card = scene.render(0)[30:50, 38:58].mean(axis=(0, 1))
    assert card @ LUMINANCE_WEIGHTS == pytest.approx(0.6, rel=0.02)


@pytest.mark.parametrize("around", ["room", "panorama"])
def test_surroundings_hide_and_move_nothing(session: BlenderSession, tmp_path: Path, around: str) -> None:
    write_hdr(tmp_path / "sky.hdr", panorama(64))
    environment = EnvironmentSpec("sky.hdr", 10.0, 0.6) if around == "panorama" else None
    spec, settled = scene_of(BALL, MIRROR, ROOM if around == "room" else None)
    spec = dataclasses.replace(spec, environment=environment)
    session.panoramas = tmp_path
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
    ("name", "told"),
    [
        ("empty", "cannot be decoded as a Radiance file"),
        ("cut", "cannot be decoded as a Radiance file"),
        ("png", "holds an ordinary picture of 8 bits"),
        ("png.exr", "cannot be decoded as an OpenEXR file"),
        ("square", "has 32 x 32 pixels; one that is twice as wide as high"),
        ("nan.exr", "negative or no finite numbers"),
        ("black", "is black above the horizon"),
        ("depth.exr", "R, G and B are needed"),
        ("none", "no .hdr or .exr file"),
        ("missing", "not a folder"),
    ],
)
def test_a_panorama_that_is_none_is_told_in_one_line(tmp_path: Path, name: str, told: str) -> None:
    import OpenEXR

    folder, light = tmp_path / "panoramas", panorama(32)
    if name != "missing":
        write_hdr(folder / "a.hdr", light)
    target = folder / (name if "." in name else f"{name}.hdr")
    whole = (folder / "a.hdr").read_bytes() if name != "missing" else b""
    _, png = cv2.imencode(".png", np.full((32, 64, 3), 90, dtype=np.uint8))
    if name == "none":
        (folder / "a.hdr").rename(folder / "a.txt")
    elif name in ("nan.exr", "depth.exr"):
        light[3, 3] = np.nan
        content = {"RGB": light} if name == "nan.exr" else {"Z": light[..., 0].copy()}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, content).write(str(target))
    elif name in ("square", "black"):
        write_hdr(target, light[:, :32] if name == "square" else 0 * light)
    elif name != "missing":
        target.write_bytes({"empty": b"", "cut": whole[:-1]}.get(name, png.tobytes()))
    with pytest.raises(UserError, match=r"^[^\n]*$") as error:
        sources = load_sources(load_recipe(None, [f"light.environments={json.dumps(str(folder))}"]))
        check_pictures(sources, Tracker(silent))
    assert told in str(error.value)


def test_panoramas_and_rooms_share_the_drops() -> None:
    recipe = load_recipe(None, ["light.environment_share=0.5", "light.room=ranges", "light.environments=any"])
    catalogue = Catalogue({1: 0.05}, {}, panoramas=("a.hdr", "b.exr"))
    scenes = [sample_scene(recipe, catalogue, 3, drop) for drop in range(60)]
    files = [scene.environment.file for scene in scenes if scene.environment]
    assert 15 < len(files) < 45 and {"a.hdr", "b.exr"} == set(files)
    assert all((scene.room is None) == (scene.environment is not None) for scene in scenes)
    assert all(scene == TypeAdapter(SceneSpec).validate_json(json.dumps(plain_spec(scene))) for scene in scenes), (
        "survives being recorded"
    )


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("light.environment_strength=[2, 1]", "min 2.0 is greater than max 1.0"),
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
