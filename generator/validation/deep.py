"""Rays cast again: what a sample of images must look like, from the models, the poses and the recorded scene alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.instances import ImageAnnotation, InstanceAnnotation, PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.dataset.layout import MODELS_FOLDER
from synthetless.generation.sources import models_folder
from synthetless.io.images import decode_depth, decode_mask, has_depth
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.spec import Role
from synthetless.validation.depth import stored_depth
from synthetless.validation.geometry import Array, model_to_camera
from synthetless.validation.labels import SceneLabels
from synthetless.validation.pictures import Pictures
from synthetless.validation.poses import check_poses, incoherence
from synthetless.validation.report import Finding, Tally
from synthetless.validation.source import Source

Meshes = dict[Any, tuple[Array, NDArray[np.int32]]]

_SLACK_MM = 0.01
_ODD_PIXELS, _ODD_SHARE, _ODD_SHARE_OF_IMAGE = 2, 1e-3, 1e-4
"""So many pixels, and this share, another machine's single precision may put on the other side of an edge."""


@dataclass(frozen=True, eq=False)
class DeepTask:
    """What a worker is given: the dataset, image ids by scene folder, and how many faults to keep."""

    source: Source
    images: Mapping[int, tuple[int, ...]]
    limit: int


@dataclass(frozen=True, eq=False)
class DeepResult:
    """What a worker gives back: the faults, and how many images could be compared or could not."""

    tally: Tally
    compared: int
    skipped: int


def sample(images: Mapping[int, Sequence[int]], count: int) -> list[tuple[int, int]]:
    """Scene folder and id of ``count`` images, evenly spread over a dataset."""
    places = [(scene_id, im_id) for scene_id in sorted(images) for im_id in images[scene_id]]
    if not places:
        return []
    chosen = np.linspace(0, len(places) - 1, min(count, len(places))).round().astype(int)
    return [places[i] for i in chosen]


def check_deep(task: DeepTask) -> DeepResult:
    """Cast the rays of images again and compare. Images whose labels are unsound, which was told, are skipped."""
    tally, compared, skipped = Tally(task.limit), 0, 0
    meshes = _meshes(task.source)
    caster = RayCaster(meshes)
    for scene_id, im_ids in task.images.items():
        labels = SceneLabels.read(task.source.scene(scene_id))
        sound, _ = check_poses(task.source.infos, labels)
        for im_id in im_ids:
            unsound = im_id not in labels.image_ids or any(
                (im_id, gt_id) not in sound for gt_id in range(len(labels.gt[im_id]))
            )
            if unsound or not _can_be_cast(labels, im_id, meshes):
                skipped += 1
                continue
            expected = _cast(task.source, labels, im_id, caster)
            tally.add(_compare(task.source, labels, im_id, expected))
            compared += 1
    return DeepResult(tally, compared, skipped)


def _meshes(source: Source) -> Meshes:
    """Every mesh that can be had, in millimetres."""
    by_role: dict[Role, Mapping[int, ObjectModel]] = {
        "model": load_models(source.root / MODELS_FOLDER, tuple(source.shapes)) if source.shapes else {}
    }
    distractors = source.recipe.source.distractors
    if source.recipe.objects.distractors[1] > 0 and distractors is not None and models_folder(distractors).is_dir():
        by_role["distractor"] = load_models(models_folder(distractors))
    return {
        _key(role, obj_id): (model.vertices_mm, model.faces)
        for role, models in by_role.items()
        for obj_id, model in models.items()
    }


def _key(role: Role, obj_id: int) -> Any:
    return (role, obj_id)


def _can_be_cast(labels: SceneLabels, im_id: int, meshes: Meshes) -> bool:
    """Whether the image is recorded coherently and every mesh is to be had."""
    recorded = labels.spec.get(im_id)
    if recorded is None or incoherence(recorded, len(labels.gt[im_id])):
        return False
    return all(_key(item.role, item.obj_id) in meshes for item in recorded.scene.objects)


def _cast(source: Source, labels: SceneLabels, im_id: int, caster: RayCaster) -> ImageAnnotation:
    """The image as its labels have it; what has no label, models outside the image included, may hide it."""
    camera, recorded = labels.camera[im_id], labels.spec[im_id]
    R_w2c, t_w2c = np.array(camera["cam_R_w2c"]).reshape(3, 3), np.array(camera["cam_t_w2c"], dtype=np.float64)
    posed = [
        PosedModel(entry["obj_id"], np.array(entry["cam_R_m2c"]).reshape(3, 3), np.array(entry["cam_t_m2c"]))
        for entry in labels.gt[im_id]
    ]
    unlabelled = [
        PosedModel(item.obj_id, *model_to_camera(pose, R_w2c, t_w2c), item.role)
        for number, (item, pose) in enumerate(zip(recorded.scene.objects, recorded.settled, strict=True))
        if number not in recorded.instances
    ]
    table = Plane(R_w2c, t_w2c, 500 * source.recipe.table.size_m)
    delta = source.recipe.labels.visibility_delta_mm
    cast = caster.annotate(source.recipe.intrinsics, table, posed, unlabelled, delta)
    if not source.has("depth"):
        return cast
    return cast.where_valid(has_depth(cast.depth_mm, source.recipe.encoding.depth_scale))


def _compare(source: Source, labels: SceneLabels, im_id: int, expected: ImageAnnotation) -> Iterator[Finding]:
    recipe, paths = source.recipe, labels.paths
    pictures = Pictures(im_id, (recipe.camera.height, recipe.camera.width))
    if source.has("depth"):
        path, scale = paths.depth(im_id), recipe.encoding.depth_scale
        stored = pictures.read(path, lambda data, name: decode_depth(data, scale, name))
        if stored is not None:
            yield from _compare_depth(path, im_id, stored, expected.depth_mm, scale)
    for gt_id, instance in enumerate(expected.instances):
        if source.has("masks"):
            for path, mask in (
                (paths.mask(im_id, gt_id), instance.mask),
                (paths.mask_visib(im_id, gt_id), instance.mask_visib),
            ):
                stored = pictures.read(path, decode_mask, gt_id)
                off = 0 if stored is None else int(np.count_nonzero(stored != mask))
                if off > _allowed(np.count_nonzero(mask)):
                    message = f"{off} pixels differ from the ray-cast mask of {np.count_nonzero(mask)} pixels"
                    yield Finding("deep", path, message, im_id, gt_id)
        for message in _compare_info(labels.gt_info[im_id][gt_id], instance):
            yield Finding("deep", paths.scene_gt_info, message, im_id, gt_id)


def _compare_depth(path: Path, im_id: int, stored: Array, cast: Array, scale: float) -> Iterator[Finding]:
    off = np.abs(stored - stored_depth(np.where(cast > 0, cast, np.inf), scale))
    wrong = off > scale / 2 * (1 + 1e-6) + _SLACK_MM
    if np.count_nonzero(wrong) > _ODD_PIXELS + _ODD_SHARE_OF_IMAGE * stored.size:
        message = f"{np.count_nonzero(wrong)} pixels differ from the ray-cast depth, by up to {off.max():.2f} mm"
        yield Finding("deep", path, message, im_id)


def _compare_info(info: Mapping[str, Any], cast: InstanceAnnotation) -> Iterator[str]:
    for name in ("px_count_all", "px_count_valid", "px_count_visib"):
        count = getattr(cast, name)
        if abs(info[name] - count) > _allowed(count):
            yield f"{name} is {info[name]}; ray casting gives {count}"
    for name in ("bbox_obj", "bbox_visib"):
        box = getattr(cast, name)
        if np.abs(np.subtract(info[name], box)).max() > 1:
            yield f"{name} is {info[name]}; ray casting gives {list(box)}"


def _allowed(count: int) -> float:
    return _ODD_PIXELS + _ODD_SHARE * count
