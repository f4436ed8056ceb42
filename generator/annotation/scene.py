"""From a settled scene and a camera to what is seen: the one way in which images are annotated and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.guides import make_guides
from synthetless.annotation.instances import ImageAnnotation, MeshKey, PosedModel
from synthetless.annotation.raycast import Plane, PosedSurface, RayCaster
from synthetless.config import Recipe
from synthetless.io.images import has_depth
from synthetless.io.models import ObjectModel
from synthetless.scenes.camera import extrinsics, settled_centre
from synthetless.scenes.container import container_mesh
from synthetless.scenes.denoise import Guides
from synthetless.scenes.depth_sensor import Returns, sense
from synthetless.scenes.lens import pinhole_around
from synthetless.scenes.materials import TableTexture
from synthetless.scenes.rotations import matrix
from synthetless.scenes.spec import DepthSensorSpec, Pose, Role, SceneSpec
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS

MM_PER_M = 1000.0
_TABLE_ALBEDO = 0.4
"""The table's texture is not known to the rays: for a depth camera it is as bright everywhere."""


@dataclass(frozen=True, eq=False)
class AnnotatedScene:
    """One view of a settled scene, measured.

    Attributes:
        R_w2c: (3, 3) rotation, world to camera (OpenCV).
        t_w2c: (3,) translation, millimetres.
        models: the labelled models of which a pixel could be in the image, hidden or not.
        numbers: their numbers in the scene's objects.
        image: what is seen; its instances are those of ``models``.
        sensed_mm: (H, W) z as a depth camera measures it, 0 where it has none; None without one.
    """

    R_w2c: NDArray[np.float64]
    t_w2c: NDArray[np.float64]
    models: tuple[PosedModel, ...]
    numbers: tuple[int, ...]
    image: ImageAnnotation
    sensed_mm: NDArray[np.float64] | None = None


def scene_caster(models: Mapping[Role, Mapping[int, ObjectModel]]) -> RayCaster:
    """A ray caster of the models of each role."""
    meshes: dict[MeshKey, ObjectModel] = {(role, i): model for role, of in models.items() for i, model in of.items()}
    return RayCaster({key: (model.vertices_mm, model.faces) for key, model in meshes.items()})


def annotate_scene(
    caster: RayCaster,
    recipe: Recipe,
    scene: SceneSpec,
    settled: Sequence[Pose],
    view: int,
    depth_sensor: DepthSensorSpec | None = None,
) -> AnnotatedScene:
    """Measure one view of a scene: poses, depth, masks, visibility.

    A model that no pixel of the image could show, were it alone, gets no label.

    Args:
        caster: of every mesh in the scene, by role and object id.
        recipe: the camera, the table's size, and what is measured.
        scene: what was built.
        settled: pose at rest of each of its objects, world frame, metres.
        view: which of its views.
        depth_sensor: the depth camera, if one measures the view, too.

    Raises:
        ValueError: a mesh is not among the caster's.
    """
    plane, posed = _in_view(recipe, scene, settled, view)
    labelled = [number for number, model in enumerate(posed) if model.role == "model"]
    distractors = [model for model in posed if model.role != "model"]
    image = caster.annotate(
        recipe.intrinsics,
        plane,
        [posed[number] for number in labelled],
        [*distractors, *container_surfaces(caster, scene, plane.R_w2c, plane.t_w2c)],
        recipe.labels.visibility_delta_mm,
        "normals" in recipe.outputs,
        "object_coordinates" in recipe.outputs,
        None if depth_sensor is None else (depth_sensor.baseline_m * MM_PER_M, 0.0, 0.0),
    )
    sensed_mm = None
    if depth_sensor is not None and image.illumination is not None:
        seen = image.illumination
        returns = Returns(image.depth_mm, seen.lit, seen.cosine, _albedo(scene).take(seen.owner))
        sensed_mm = sense(returns, recipe.intrinsics, depth_sensor)
    if "depth" in recipe.outputs:
        image = image.where_valid(has_depth(image.depth_mm, recipe.encoding.depth_scale))
    inside = [n for n, instance in enumerate(image.instances) if instance.mask.any()]
    numbers = tuple(labelled[n] for n in inside)
    shown = tuple(posed[n] for n in numbers)
    return AnnotatedScene(plane.R_w2c, plane.t_w2c, shown, numbers, image.restricted(inside), sensed_mm)


def _albedo(scene: SceneSpec) -> NDArray[np.float32]:
    """What the materials of a scene scatter, in the order of ``Illumination.owner``, whose -1 is nothing."""
    of_roles = [[item.material for item in scene.objects if (item.role == "model") is named] for named in (True, False)]
    materials = [*of_roles[0], *of_roles[1], *([] if scene.container is None else [scene.container.material])]
    scattered = [float(np.dot(made_of.albedo, LUMINANCE_WEIGHTS)) * (1 - made_of.metallic) for made_of in materials]
    return np.array([*scattered, _TABLE_ALBEDO, 0.0], dtype=np.float32)


def scene_guides(
    caster: RayCaster, recipe: Recipe, scene: SceneSpec, settled: Sequence[Pose], view: int, texture: TableTexture
) -> Guides:
    """What a denoiser may know of one view of a scene before it is rendered.

    Args:
        caster, recipe, scene, settled, view: as for ``annotate_scene``.
        texture: what covers the table.
    """
    plane, posed = _in_view(recipe, scene, settled, view)
    known = [item.material.albedo if item.material.colour == "grey" else None for item in scene.objects]
    held = container_surfaces(caster, scene, plane.R_w2c, plane.t_w2c)
    if scene.container is not None:
        known.append(scene.container.material.albedo)
    return make_guides(caster, pinhole_around(recipe.intrinsics), plane, [*posed, *held], known, texture)


def _in_view(recipe: Recipe, scene: SceneSpec, settled: Sequence[Pose], view: int) -> tuple[Plane, list[PosedModel]]:
    """The table and every object in front of a camera."""
    R_w2c, t_w2c_m = extrinsics(scene.views[view], settled_centre(settled))
    t_w2c = t_w2c_m * MM_PER_M
    posed = [
        PosedModel(item.obj_id, *model_to_camera(pose, R_w2c, t_w2c), item.role)
        for item, pose in zip(scene.objects, settled, strict=True)
    ]
    return Plane(R_w2c, t_w2c, recipe.table.size_m * MM_PER_M / 2), posed


def container_surfaces(
    caster: RayCaster, scene: SceneSpec, R_w2c: NDArray[np.float64], t_w2c: NDArray[np.float64]
) -> list[PosedSurface]:
    """What a scene's objects lie in, if anything, in front of a camera (mm); it hides, but is not labelled."""
    if scene.container is None:
        return []
    mesh = container_mesh(scene.container)
    return [PosedSurface.of(caster.unnamed(mesh.vertices_m * MM_PER_M, mesh.faces), R_w2c, t_w2c)]


def model_to_camera(
    pose: Pose, R_w2c: NDArray[np.float64], t_w2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R_m2c (3, 3) and t_m2c (3,) in millimetres of a pose in the world (metres), under a camera in millimetres."""
    return R_w2c @ matrix(pose.rotation_wxyz), R_w2c @ (np.array(pose.position_m) * MM_PER_M) + t_w2c
