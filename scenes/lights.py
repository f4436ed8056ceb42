"""The lamp, the light from everywhere, and what stands around the table: a room, or a panorama."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.scenes.materials import glowing, new_light_image
from synthetless.scenes.spec import AmbientLight, AreaLight, PointLight, RoomSpec, SceneSpec, Vector

_SAMPLING_MAP_PX = 1024
"""Width of the map by which Cycles aims at the bright parts of a panorama; the sun is wider than its pixels."""
_FEW_LAMPS = 6
_FLOOR_M = 0.75
"""How far a room's floor lies below the table."""


def lamp_power_w(light: PointLight) -> float:
    """Power of a Blender point light that gives a white matte surface at the aim point the wanted brightness.

    A lamp of power P shines with irradiance P / (4 pi d^2) at distance d; Lambert's white surface returns 1 / pi of
    it as radiance.
    """
    return 4 * math.pi**2 * light.distance_m**2 * light.strength


def disc_power_w(light: AreaLight) -> float:
    """Power of a Blender disc light that gives a white matte surface at the aim point the wanted brightness.

    A disc of radius r and radiance L shines with irradiance pi L r^2 / (r^2 + d^2) on a surface that faces it at
    distance d on its axis; its power is pi^2 r^2 L.
    """
    return math.pi**2 * (light.radius_m**2 + light.distance_m**2) * light.strength


def add_lamp(bpy: Any, collection: Any, light: PointLight, centre_m: ArrayLike) -> None:
    """Add the lamp to a bpy collection; ``centre_m`` (3,) is the point it is measured from."""
    data = bpy.data.lights.new("lamp", "POINT")
    data.energy = lamp_power_w(light)
    data.color = light.color
    data.shadow_soft_size = light.radius_m
    lamp = bpy.data.objects.new("lamp", data)
    lamp.location = (np.asarray(centre_m) + light.distance_m * _direction(light)).tolist()
    lamp.visible_camera = False
    collection.objects.link(lamp)


def uses_tree(spec: SceneSpec) -> bool:
    """Whether Cycles chooses among the lamps by a tree.

    Of a few lamps, it does as well without, in 3/4 of the time; scenes that have but the one keep it, since pixels
    depend on it.
    """
    return spec.room is None or len(spec.room.lamps) > _FEW_LAMPS


def add_room(
    bpy: Any, collection: Any, room: RoomSpec, ambient: AmbientLight, centre_m: ArrayLike, bounces: int
) -> None:
    """Put a room around the table.

    Args:
        bpy, collection: where to.
        room: its walls stand round the world's origin, its lamps are measured from ``centre_m``.
        ambient: comes from the walls, too, since they hide what is behind them.
        centre_m: (3,) centre of the objects.
        bounces: of the renderer. Paths find surfaces this large by bouncing, with less noise and in 4/5 of the time
            that it takes to aim at them, too.
    """
    half, low, high = room.side_m / 2, -_FLOOR_M, room.height_m
    x, y, z = (np.array(signs) for signs in np.meshgrid([-half, half], [-half, half], [low, high], indexing="ij"))
    corners = np.stack([x, y, z], axis=-1)
    east, north, west, south = corners[1], corners[:, 1], corners[0], corners[:, 0]
    for side, radiance in zip((east, north, west, south), room.walls, strict=True):
        _add_side(bpy, collection, side, _both(radiance, ambient), bounces == 0)
    _add_side(bpy, collection, corners[:, :, 1], _both(room.ceiling, ambient), bounces == 0)
    _add_side(bpy, collection, corners[:, :, 0], _both(room.floor, ambient), bounces == 0)
    for light in room.lamps:
        _add_disc(bpy, collection, light, centre_m)


def _both(radiance: Vector, ambient: AmbientLight) -> Vector:
    red, green, blue = (own + ambient.level * share for own, share in zip(radiance, ambient.color, strict=True))
    return (red, green, blue)


def _add_side(bpy: Any, collection: Any, corners: NDArray[np.float64], radiance: Vector, is_aimed_at: bool) -> None:
    """Add a rectangle with these corners (2, 2, 3); it glows."""
    mesh = bpy.data.meshes.new("side")
    mesh.from_pydata(corners.reshape(4, 3).tolist(), [], [(0, 1, 3, 2)])
    mesh.materials.append(glowing(bpy, radiance, is_aimed_at))
    collection.objects.link(bpy.data.objects.new("side", mesh))


def _add_disc(bpy: Any, collection: Any, light: AreaLight, centre_m: ArrayLike) -> None:
    from mathutils import Vector as BlenderVector

    data = bpy.data.lights.new("disc", "AREA")
    data.shape, data.size = "DISK", 2 * light.radius_m
    data.energy = disc_power_w(light)
    data.color = light.color
    disc = bpy.data.objects.new("disc", data)
    direction = _direction(light)
    disc.rotation_euler = BlenderVector(direction.tolist()).to_track_quat("Z", "Y").to_euler()  # it shines along -z
    disc.location = (np.asarray(centre_m) + light.distance_m * direction).tolist()
    disc.visible_camera = False
    collection.objects.link(disc)


def _direction(light: PointLight) -> NDArray[np.float64]:
    """(3,) unit vector towards a lamp."""
    elevation, azimuth = math.radians(light.elevation_deg), math.radians(light.azimuth_deg)
    return np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )


def add_panorama(bpy: Any, world: Any, light: NDArray[np.float32], turn_deg: float) -> None:
    """Let a bpy world shine with a panorama.

    Args:
        bpy, world: where to; what else the world shines with is replaced.
        light: (H, 2 H, 3) linear radiance, zenith on top.
        turn_deg: azimuth at which its middle column is seen.
    """
    nodes, links = world.node_tree.nodes, world.node_tree.links
    direction, turned, texture = (nodes.new(f"ShaderNode{name}") for name in ("TexCoord", "Mapping", "TexEnvironment"))
    turned.inputs["Rotation"].default_value = (0.0, 0.0, -math.radians(turn_deg))
    texture.image = new_light_image(bpy, light)
    links.new(direction.outputs["Generated"], turned.inputs["Vector"])
    links.new(turned.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = 1.0
    world.cycles.sampling_method = "MANUAL"  # by itself, Cycles takes a second and a half of every image for its map
    world.cycles.sample_map_resolution = _SAMPLING_MAP_PX


def add_ambient(bpy: Any, scene: Any, ambient: AmbientLight) -> None:
    """Surround a bpy scene with even light. Unit radiance from everywhere gives a white matte surface unit radiance."""
    world = bpy.data.worlds.new("ambient")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*ambient.color, 1.0)
    background.inputs["Strength"].default_value = ambient.level
    scene.world = world
