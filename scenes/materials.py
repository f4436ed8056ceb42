"""What things are made of: objects of one colour, and a textured table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.spec import Material, PlaneSpec, SurfaceColours, Vector
from synthetless.scenes.srgb import linear_of_levels

_COLOURS = "colours"
"""Name of the attribute that holds the colours of a mesh's vertices."""


@dataclass(frozen=True, eq=False)
class TableTexture:
    """What covers a table, as it is rendered.

    Attributes:
        plane: how it lies there.
        pixels: (H, W, 3) of a tile, sRGB, first row on top.
        seamless: whether tiles are repeated as they are, or else mirrored.
    """

    plane: PlaneSpec
    pixels: NDArray[np.uint8]
    seamless: bool


def plastic(bpy: Any, material: Material, texture: Any = None) -> Any:
    """A bpy material of one colour, or of the colours of the model's file; ``texture`` is its bpy image, if any."""
    made, nodes, links = _empty_material(bpy, "plastic")
    shader = _surface(nodes, links, material.roughness, material.specular, material.metallic)
    shader.inputs[0].default_value = (*material.albedo, 1.0)
    if material.colour == "model":
        colours = nodes.new("ShaderNodeAttribute" if texture is None else "ShaderNodeTexImage")
        if texture is None:
            colours.attribute_name = _COLOURS
        else:
            colours.image = texture
        links.new(colours.outputs["Color"], shader.inputs[0])
    return made


def add_colours(mesh: Any, colours: SurfaceColours) -> None:
    """Give a bpy mesh of triangles the colours of its vertices, or the places of its corners in a texture."""
    if colours.vertex_rgb is not None:
        rgba = np.ones((len(colours.vertex_rgb), 4), dtype=np.float32)
        rgba[:, :3] = linear_of_levels()[colours.vertex_rgb]
        mesh.color_attributes.new(_COLOURS, "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.ravel())
    if colours.corner_uv is not None:
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", colours.corner_uv.ravel())


def textured(bpy: Any, texture: TableTexture) -> Any:
    """A bpy material that repeats an image over the surface; one that is not seamless is mirrored at its borders."""
    made, nodes, links = _empty_material(bpy, "table")
    shader = _surface(nodes, links, texture.plane.roughness, texture.plane.specular)
    node = nodes.new("ShaderNodeTexImage")
    node.image = new_image(bpy, texture.pixels)
    node.extension = "REPEAT" if texture.seamless else "MIRROR"
    links.new(node.outputs["Color"], shader.inputs[0])
    return made


def add_table(bpy: Any, collection: Any, texture: TableTexture, size_m: float) -> Any:
    """Add the square table in z = 0 to a bpy collection."""
    half = size_m / 2
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    mesh = bpy.data.meshes.new("table")
    mesh.from_pydata([(x, y, 0.0) for x, y in corners], [], [(0, 1, 2, 3)])
    uv = mesh.uv_layers.new(name="uv")
    aspect = texture.pixels.shape[1] / texture.pixels.shape[0]
    uv.data.foreach_set("uv", table_uv(texture.plane, corners, aspect).astype(np.float32).ravel())
    mesh.materials.append(textured(bpy, texture))
    table = bpy.data.objects.new("table", mesh)
    collection.objects.link(table)
    return table


def table_uv(plane: PlaneSpec, points_m: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    """(N, 2) texture coordinates of (N, 2) points of the table: turned, scaled to tiles, and shifted.

    ``aspect`` is the texture's width over its height.
    """
    angle = math.radians(plane.rotation_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    uv: NDArray[np.float64] = points_m @ turn.T / (plane.tile_m * np.array([aspect, 1.0])) + plane.shift
    return uv


def new_image(bpy: Any, pixels: NDArray[np.uint8]) -> Any:
    """A bpy image of (H, W, 3) sRGB pixels, first row on top."""
    height, width, _ = pixels.shape
    image = bpy.data.images.new("texture", width, height, alpha=False)
    rgba = np.ones((height, width, 4), dtype=np.float32)
    np.divide(pixels[::-1], np.float32(255), out=rgba[..., :3])
    image.pixels.foreach_set(rgba.ravel())
    return image


def new_light_image(bpy: Any, light: NDArray[np.float32]) -> Any:
    """A bpy image of (H, W, 3) linear light, first row on top."""
    height, width, _ = light.shape
    image = bpy.data.images.new("light", width, height, alpha=False, float_buffer=True)
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :3] = light[::-1]
    image.pixels.foreach_set(rgba.ravel())
    return image


def _empty_material(bpy: Any, name: str) -> tuple[Any, Any, Any]:
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    return made, tree.nodes, tree.links


def glowing(bpy: Any, radiance: Vector, is_aimed_at: bool) -> Any:
    """A bpy material that emits light, equally in all directions, and reflects none.

    Args:
        bpy: where to.
        radiance: linear RGB.
        is_aimed_at: whether paths of light are led to it, as to a lamp, or find it when they bounce.
    """
    made, nodes, links = _empty_material(bpy, "glowing")
    made.cycles.emission_sampling = "AUTO" if is_aimed_at else "NONE"
    shader = nodes.new("ShaderNodeEmission")
    shader.inputs["Color"].default_value = (*radiance, 1.0)
    links.new(shader.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return made


def _surface(nodes: Any, links: Any, roughness: float, specular: float, metallic: float = 0.0) -> Any:
    """The surface shader, colour as its first input: purely diffuse where nothing shines, since that renders faster."""
    shines = specular > 0 or metallic > 0
    shader = nodes.new("ShaderNodeBsdfPrincipled" if shines else "ShaderNodeBsdfDiffuse")
    if shines:
        shader.inputs["Roughness"].default_value = roughness
        shader.inputs["Specular IOR Level"].default_value = specular
        shader.inputs["Metallic"].default_value = metallic
        # Nothing here is brushed, so no tangent counts; one that is not given is computed wherever a path bounces.
        links.new(nodes.new("ShaderNodeNewGeometry").outputs["True Normal"], shader.inputs["Tangent"])
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(shader.outputs[0], output.inputs["Surface"])
    return shader
