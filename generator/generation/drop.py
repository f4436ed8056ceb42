"""Makes the images of a drop: draw it, let it fall, render it, measure it, encode it.

One DropRenderer per process: it holds the Blender session, the meshes and their ray-casting trees, all loaded once.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.instances import ImageAnnotation, PosedModel
from synthetless.annotation.raycast import Occluder, Plane, RayCaster
from synthetless.config import Recipe
from synthetless.dataset import records
from synthetless.dataset.layout import ImagePlan, ScenePaths
from synthetless.dataset.store import FinishedImage
from synthetless.generation.sources import Sources
from synthetless.io import images
from synthetless.io.color import develop, exposure_gain
from synthetless.io.images import encode_exr
from synthetless.io.models import ObjectModel
from synthetless.scenes.blender import CPU, RenderDevice
from synthetless.scenes.physics import Collider, NotSettled, PhysicsSettings, collider, settle
from synthetless.scenes.render import BlenderScene, BlenderSession
from synthetless.scenes.rotations import matrix
from synthetless.scenes.sampling import sample_scene
from synthetless.scenes.spec import Mesh, Pose, Role, SceneSpec

_MM = 1000.0
ModelKey = tuple[Role, int]


class DropFailed(Exception):
    """A drop did not come to rest however often it was thrown; the message says why the last throw did not."""


class DropRenderer:
    """Turns drops into images.

    Attributes:
        session: the Blender session.
    """

    def __init__(
        self,
        recipe: Recipe,
        sources: Sources,
        threads: int = 0,
        device: RenderDevice = CPU,
        log: Path = Path(os.devnull),
    ) -> None:
        """Load everything that drops share.

        Args:
            recipe: what to make.
            sources: from what.
            threads: of the renderer; 0 uses every core.
            device: what to render on.
            log: file that takes Blender's console output.
        """
        by_role: dict[Role, Mapping[int, ObjectModel]] = {"model": sources.models, "distractor": sources.distractors}
        models = {(role, obj_id): model for role, of in by_role.items() for obj_id, model in of.items()}
        self._recipe = recipe
        self._catalogue = sources.catalogue
        self._intrinsics = recipe.intrinsics
        self._meshes = {key: Mesh(model.vertices_mm / _MM, model.faces) for key, model in models.items()}
        self._colliders: dict[ModelKey, Collider] = {}
        self._caster = RayCaster({_caster_key(*key): (model.vertices_mm, model.faces) for key, model in models.items()})
        self.session = BlenderSession(
            self._meshes,
            self._intrinsics,
            recipe.render,
            recipe.table.size_m,
            sources.photos_folder,
            threads,
            device,
            log,
        )

    def make(self, drop: int, plans: Sequence[ImagePlan]) -> Iterator[FinishedImage]:
        """Make images of one drop, one after the other.

        Args:
            drop: its number.
            plans: the images wanted of it.

        Raises:
            DropFailed: it never came to rest.
            UserError: an input file became unreadable.
        """
        spec, settled = self.drop(drop)
        with self.session.scene(spec, settled) as scene:
            for plan in plans:
                yield self._image(plan, scene, settled)

    def drop(self, drop: int) -> tuple[SceneSpec, tuple[Pose, ...]]:
        """Throw until the objects come to rest.

        Returns:
            The scene and each object's pose at rest.

        Raises:
            DropFailed: not within the recipe's number of throws.
        """
        throws = self._recipe.release.max_throws
        reason = ""
        for attempt in range(throws):
            spec = sample_scene(self._recipe, self._catalogue, self._recipe.seed, drop, attempt)
            try:
                colliders = [self._collider((item.role, item.obj_id)) for item in spec.objects]
                return spec, settle(colliders, [item.release for item in spec.objects], PhysicsSettings()).poses
            except NotSettled as failure:
                reason = str(failure)
        raise DropFailed(f"did not come to rest in {throws} throws; the last time, {reason}")

    def _collider(self, key: ModelKey) -> Collider:
        if key not in self._colliders:
            self._colliders[key] = collider(self._meshes[key])
        return self._colliders[key]

    def _image(self, plan: ImagePlan, scene: BlenderScene, settled: Sequence[Pose]) -> FinishedImage:
        recipe = self._recipe
        R_w2c, t_w2c_m = scene.extrinsics(plan.view)
        t_w2c = t_w2c_m * _MM
        posed, shown, annotation = self._measure(scene.spec, settled, R_w2c, t_w2c)
        rgb: NDArray[np.uint8] | None = None
        gain, linear = 1.0, None
        if {"rgb", "exr"} & set(recipe.outputs):
            linear = scene.render(plan.view)
            gain = exposure_gain(linear, recipe.render.exposure)
            rgb = develop(linear, gain)
        obj_ids = [model.obj_id for model in posed]
        return FinishedImage(
            plan=plan,
            files=encode(recipe, plan, annotation, rgb, linear),
            camera=records.camera_entry(
                records.camera_matrix(self._intrinsics), R_w2c, t_w2c, recipe.encoding.depth_scale
            ),
            gt=[records.gt_entry(model.obj_id, model.R_m2c, model.t_m2c) for model in posed],
            gt_info=[records.gt_info_entry(instance) for instance in annotation.instances],
            coco=records.coco_annotations(plan.im_id, obj_ids, annotation.instances),
            spec={
                "image_id": plan.im_id,
                "view": plan.view,
                "exposure_gain": gain,
                "instances": shown,
                "scene": asdict(scene.spec),
                "settled": [asdict(pose) for pose in settled],
            },
        )

    def _measure(
        self, spec: SceneSpec, settled: Sequence[Pose], R_w2c: NDArray[np.float64], t_w2c: NDArray[np.float64]
    ) -> tuple[list[PosedModel], list[int], ImageAnnotation]:
        """The labelled models of which a pixel could be in the image, their numbers in the scene, the annotation."""
        recipe = self._recipe
        poses = [_model_to_camera(pose, R_w2c, t_w2c) for pose in settled]
        models = {
            number: PosedModel(item.obj_id, *pose)
            for number, (item, pose) in enumerate(zip(spec.objects, poses, strict=True))
            if item.role == "model"
        }
        occluders = [
            Occluder(_caster_key(item.role, item.obj_id), *pose)
            for item, pose in zip(spec.objects, poses, strict=True)
            if item.role != "model"
        ]
        annotation = self._caster.annotate(
            self._intrinsics,
            Plane(R_w2c, t_w2c, recipe.table.size_m * _MM / 2),
            list(models.values()),
            occluders,
            recipe.labels.visibility_delta_mm,
            "normals" in recipe.outputs,
            "object_coordinates" in recipe.outputs,
        )
        if "depth" in recipe.outputs:
            annotation = annotation.where_valid(images.has_depth(annotation.depth_mm, recipe.encoding.depth_scale))
        inside = [n for n, instance in enumerate(annotation.instances) if instance.mask.any()]
        shown = [list(models)[n] for n in inside]
        return [models[number] for number in shown], shown, annotation.restricted(inside)


def encode(
    recipe: Recipe,
    plan: ImagePlan,
    annotation: ImageAnnotation,
    rgb: NDArray[np.uint8] | None,
    linear: NDArray[np.float32] | None,
) -> dict[str, bytes]:
    """The files of one image, by their paths inside the scene folder."""
    paths, im_id, encoding = ScenePaths(Path()), plan.im_id, recipe.encoding
    files: dict[Path, bytes] = {}
    wanted = set(recipe.outputs)
    if "rgb" in wanted and rgb is not None:
        png = encoding.rgb_format == "png"
        content = images.encode_png(rgb) if png else images.encode_jpeg(rgb, encoding.jpeg_quality)
        files[paths.rgb(im_id, encoding.rgb_format)] = content
    if "exr" in wanted and linear is not None:
        files[paths.exr(im_id)] = encode_exr(linear)
    if "depth" in wanted:
        files[paths.depth(im_id)] = images.encode_depth(annotation.depth_mm, encoding.depth_scale)
    if "masks" in wanted:
        for gt_id, instance in enumerate(annotation.instances):
            files[paths.mask(im_id, gt_id)] = images.encode_mask(instance.mask)
            files[paths.mask_visib(im_id, gt_id)] = images.encode_mask(instance.mask_visib)
    if annotation.normals is not None:
        files[paths.normals(im_id)] = images.encode_normals(annotation.normals)
    if annotation.object_coordinates_mm is not None:
        files[paths.object_coordinates(im_id)] = images.encode_object_coordinates(
            annotation.object_coordinates_mm, annotation.instance_ids >= 0
        )
    return {str(path): content for path, content in files.items()}


def _model_to_camera(
    pose: Pose, R_w2c: NDArray[np.float64], t_w2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R_m2c (3, 3) and t_m2c (3,) in millimetres of a pose in the world."""
    return R_w2c @ matrix(pose.rotation_wxyz), R_w2c @ (np.array(pose.position_m) * _MM) + t_w2c


def _caster_key(role: Role, obj_id: int) -> Any:
    """The ray caster knows labelled models by their BOP id alone."""
    return obj_id if role == "model" else (role, obj_id)
