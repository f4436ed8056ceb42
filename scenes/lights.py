"""The lamp and the light from everywhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from synthetless.scenes.spec import AmbientLight, PointLight


def lamp_power_w(light: PointLight) -> float:
    """Power of a Blender point light that gives a white matte surface at the aim point the wanted brightness.

    A lamp of power P shines with irradiance P / (4 pi d^2) at distance d; Lambert's white surface returns 1 / pi of
    it as radiance.
    """
    return 4 * math.pi**2 * light.distance_m**2 * light.strength


def add_lamp(bpy: Any, collection: Any, light: PointLight, centre_m: ArrayLike) -> None:
    """Add the lamp to a bpy collection; ``centre_m`` (3,) is the point it is measured from."""
    data = bpy.data.lights.new("lamp", "POINT")
    data.energy = lamp_power_w(light)
    data.color = light.color
    data.shadow_soft_size = light.radius_m
    elevation, azimuth = math.radians(light.elevation_deg), math.radians(light.azimuth_deg)
    direction = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    lamp = bpy.data.objects.new("lamp", data)
    lamp.location = (np.asarray(centre_m) + light.distance_m * direction).tolist()
    lamp.visible_camera = False
    collection.objects.link(lamp)


def add_ambient(bpy: Any, scene: Any, ambient: AmbientLight) -> None:
    """Surround a bpy scene with even light. Unit radiance from everywhere gives a white matte surface unit radiance."""
    world = bpy.data.worlds.new("ambient")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*ambient.color, 1.0)
    background.inputs["Strength"].default_value = ambient.level
    scene.world = world
