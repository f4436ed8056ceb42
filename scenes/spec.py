"""What a scene consists of, as pure data: sampled once, recorded with every image, rendered again from the record.

World frame: metres, right-handed, the table is the plane z = 0 and z points up. Rotations are unit quaternions
(w, x, y, z) that take model coordinates to world coordinates. Azimuth is measured about +z from +x.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.textures import PhotoTexture, ProceduralTexture

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Role = Literal["model", "distractor"]
ContainerKind = Literal["box", "tray"]
Coefficients = tuple[float, float, float, float, float]
"""Of a lens, k1, k2, p1, p2, k3: Brown-Conrady in OpenCV's order; see ``scenes/lens.py``."""
NO_DISTORTION: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Pose:
    """A rigid pose, model to world.

    Attributes:
        rotation_wxyz: unit quaternion.
        position_m: where the model's origin is, metres.
    """

    rotation_wxyz: Quaternion
    position_m: Vector


@dataclass(frozen=True)
class Material:
    """What a surface looks like.

    Attributes:
        albedo: linear, grey or RGB.
        roughness: 0 mirror-like, 1 matte.
        specular: level of a dielectric's reflection, 0 none, 0.5 ordinary plastic.
        metallic: 0 a dielectric, 1 a metal.
        colour: whether the albedo is seen ("grey", although it may have a tint), or the colours of the model's file.
    """

    albedo: Vector
    roughness: float
    specular: float
    metallic: float = 0.0
    colour: Literal["grey", "model"] = "grey"


@dataclass(frozen=True)
class ObjectSpec:
    """One object of a drop: which model, what it is made of, and the pose it is released in.

    A distractor comes from another models folder; it is rendered and occludes, but gets no label.
    """

    role: Role
    obj_id: int
    material: Material
    release: Pose


@dataclass(frozen=True)
class ContainerSpec:
    """What the objects lie in: an open box whose middle is the world's origin. It occludes, but gets no label.

    Attributes:
        kind: what it was drawn as.
        floor_m: length and width of its floor, inside.
        height_m: of the rim above the table.
        wall_m: thickness of the floor, and of the sides, measured along the table.
        slope_deg: how far the sides lean outwards.
        rotation_deg: of its length, about +z from +x.
        material: what it is made of.
    """

    kind: ContainerKind
    floor_m: tuple[float, float]
    height_m: float
    wall_m: float
    slope_deg: float
    rotation_deg: float
    material: Material


@dataclass(frozen=True)
class PlaneSpec:
    """The table: its texture, the side of one texture tile in metres, and how the tiling lies on the table."""

    texture: ProceduralTexture | PhotoTexture
    tile_m: float
    rotation_deg: float
    shift: tuple[float, float]
    roughness: float
    specular: float


@dataclass(frozen=True)
class PointLight:
    """A lamp, seen from the point the camera aims at.

    Attributes:
        azimuth_deg, elevation_deg, distance_m: where it is.
        strength: linear brightness of a white matte surface at the aim point that faces the lamp.
        radius_m: of the glowing sphere; softens the shadows.
        color: linear RGB, largest component 1.
    """

    azimuth_deg: float
    elevation_deg: float
    distance_m: float
    strength: float
    radius_m: float
    color: Vector


@dataclass(frozen=True)
class AreaLight(PointLight):
    """A glowing disc that faces the point the camera aims at; ``radius_m`` is the disc's."""


@dataclass(frozen=True)
class RoomSpec:
    """A room around the table, which stands in its middle; ceiling, walls and floor glow and do not reflect.

    Attributes:
        side_m: of its square floor plan, parallel to the table.
        height_m: of the ceiling above the table.
        ceiling, floor: linear radiance; a white matte surface that saw nothing else would be as bright.
        walls: the same of the walls at +x, +y, -x and -y.
        lamps: soft lamps.
    """

    side_m: float
    height_m: float
    ceiling: Vector
    floor: Vector
    walls: tuple[Vector, Vector, Vector, Vector]
    lamps: tuple[AreaLight, ...]


@dataclass(frozen=True)
class EnvironmentSpec:
    """Light from all around, from a panorama.

    Attributes:
        file: the panorama, relative to its folder, with forward slashes.
        turn_deg: azimuth at which its middle column is seen.
        strength: luminance of a white matte surface that faces the zenith.
    """

    file: str
    turn_deg: float
    strength: float


@dataclass(frozen=True)
class AmbientLight:
    """Light from everywhere: ``level`` is the linear brightness of a white matte surface under it alone."""

    level: float
    color: Vector


@dataclass(frozen=True)
class View:
    """Where a camera stands, seen from the point it aims at: the centre of the settled objects plus an offset.

    ``elevation_deg`` is the angle between the viewing ray and the table, so the table's tilt to the view is
    90 - elevation. ``roll_deg`` turns the camera about its optical axis.
    """

    distance_m: float
    elevation_deg: float
    azimuth_deg: float
    roll_deg: float
    aim_offset_m: Vector


@dataclass(frozen=True)
class SceneSpec:
    """One drop: everything that is decided before physics and rendering begin.

    ``attempt`` counts the throws that did not come to rest before this one; only the release poses differ
    between attempts. A record leaves ``container`` out where there is none.
    """

    drop: int
    attempt: int
    objects: tuple[ObjectSpec, ...]
    plane: PlaneSpec
    light: PointLight
    ambient: AmbientLight
    views: tuple[View, ...]
    room: RoomSpec | None = None
    container: ContainerSpec | None = None
    environment: EnvironmentSpec | None = None


def plain(spec: Any) -> Any:
    """A description as JSON data, without the fields that are at their defaults.

    So the record of a scene does not change when the description learns of something that the scene does not have.
    """
    if is_dataclass(spec):
        values = ((field, getattr(spec, field.name)) for field in fields(spec))
        return {f.name: plain(value) for f, value in values if f.default is MISSING or value != f.default}
    return [plain(item) for item in spec] if isinstance(spec, tuple) else spec


@dataclass(frozen=True)
class SensorSpec:
    """A colour camera, as it was for one image; what each value does is in ``scenes/sensor.py``.

    Attributes:
        blur_px: standard deviation of the point spread.
        vignetting: share of the light that the corners lose.
        exposure_ev: stops that the image is over-exposed by.
        shoulder: upper part of the range over which highlights roll off.
        photons: that a pixel counts at full scale.
        read_noise: standard deviation, of full scale.
        red_gain, blue_gain: of the white balance, relative to green.
        chroma_px: standard deviation of the blur of the colour differences.
        sharpen, sharpen_px: amount of the unsharp masking, and standard deviation of its blur.
        jpeg_quality: of the compression inside the camera; None if there is none.
        noise_seed: of the photon and read noise.
    """

    blur_px: float
    vignetting: float
    exposure_ev: float
    shoulder: float
    photons: float
    read_noise: float
    red_gain: float
    blue_gain: float
    chroma_px: float
    sharpen: float
    sharpen_px: float
    jpeg_quality: int | None
    noise_seed: int


@dataclass(frozen=True)
class DepthSensorSpec:
    """A depth camera, as it was for one image; what each value does is in ``scenes/depth_sensor.py``.

    Attributes:
        baseline_m: how far to the right of the camera its projector is.
        noise_mm, noise_growth_mm, noise_from_m, noise_order, noise_tilt_mm: of the axial noise.
        lateral_px: standard deviation of the lateral noise.
        edges: "sharp" or "mixed".
        disparity_step_px, step_mm: of the disparity, or, where that is 0 or there is no baseline, of the depth; 0 for
            no steps.
        grazing_deg: angle between ray and normal from which on nothing returns.
        dark: albedo, seen straight on, below which nothing returns.
        speckle: relative standard deviation of the returned light.
        range_m: nearest and farthest depth that is measured.
        noise_seed: of everything random.
    """

    baseline_m: float
    noise_mm: float
    noise_growth_mm: float
    noise_from_m: float
    noise_order: int
    noise_tilt_mm: float
    lateral_px: float
    edges: Literal["sharp", "mixed"]
    disparity_step_px: float
    step_mm: float
    grazing_deg: float
    dark: float
    speckle: float
    range_m: tuple[float, float]
    noise_seed: int


@dataclass(frozen=True)
class Intrinsics:
    """A camera without skew: image size, focal lengths and principal point, all in pixels, and its lens.

    The centre of the pixel in column i and row j is (u, v) = (i, j), as in OpenCV and BOP. Without distortion it is a
    pinhole.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Coefficients = NO_DISTORTION


@dataclass(frozen=True)
class Standing:
    """A model that stands upright: with its z axis up, or down.

    Attributes:
        upside_down: whether z points down.
        origin_m: height of the model's origin above what it stands on.
        height_m: of the model.
        radius_m: of the circle about its origin, seen from above, that holds it.
    """

    upside_down: bool
    origin_m: float
    height_m: float
    radius_m: float


@dataclass(frozen=True, eq=False)
class SurfaceColours:
    """The colours that a model's file gives its surface: those of the vertices, or a texture.

    Attributes:
        vertex_rgb: (V, 3) sRGB; None if there is a texture.
        texture: (H, W, 3) sRGB, first row on top; None if the vertices have colours.
        corner_uv: (F, 3, 2) float32 place in the texture of each corner of each face: u to the right, v upwards, 0..1,
            repeated beyond; None without a texture.
    """

    vertex_rgb: NDArray[np.uint8] | None = None
    texture: NDArray[np.uint8] | None = None
    corner_uv: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in the model frame, as the renderer and the physics see it.

    Attributes:
        vertices_m: (V, 3) float64, metres.
        faces: (F, 3) int32 indices into the vertices, counter-clockwise seen from outside.
        normals: (V, 3) float64 unit vertex normals, or None where the file has none.
        colours: of its surface, or None where they are not needed or the file has none.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64] | None = None
    colours: SurfaceColours | None = None
