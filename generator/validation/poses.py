"""Poses and cameras: whether they are any, and whether the recorded scene puts everything where the labels say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from synthetless.annotation.instances import image_window
from synthetless.dataset.layout import ImagePlan
from synthetless.dataset.records import Entry, ImageSpec, camera_matrix
from synthetless.dataset.store import planned_sensor
from synthetless.scenes.camera import extrinsics, settled_centre
from synthetless.validation.geometry import (
    ROTATION_TOLERANCE,
    Array,
    contains,
    model_to_camera,
    rotation_error,
    silhouette_limits,
    window_box,
)
from synthetless.validation.labels import SceneLabels
from synthetless.validation.report import Finding
from synthetless.validation.source import Source

Place = tuple[int, int]

_SAME_ROTATION, _SAME_MM = 1e-8, 1e-5
"""Far above what another machine's arithmetic may differ by, far below what anything could see."""
_SURELY_SEEN_PX = 3


def check_cameras(source: Source, labels: SceneLabels) -> Iterator[Finding]:
    """scene_camera.json against the recipe; a camera is a rotation and stands above the table."""
    K = camera_matrix(source.recipe.intrinsics).reshape(9).tolist()
    path, scale = labels.paths.scene_camera, source.recipe.encoding.depth_scale
    for im_id, entry in labels.camera.items():
        if entry["cam_K"] != K:
            yield Finding("camera", path, f"cam_K is {entry['cam_K']}; the recipe's camera has {K}", im_id)
        if entry["depth_scale"] != scale:
            yield Finding("camera", path, f"depth_scale is {entry['depth_scale']}; the recipe has {scale}", im_id)
        R = np.array(entry["cam_R_w2c"]).reshape(3, 3)
        error = rotation_error(R[None])[0]
        if not error <= ROTATION_TOLERANCE:
            yield Finding("camera", path, f"cam_R_w2c is no rotation: off by {error:.3g}", im_id)
        elif not (height := float(-R[:, 2] @ entry["cam_t_w2c"])) > 0:
            yield Finding("camera", path, f"stands {height:.1f} mm above the table; it must be above", im_id)


def check_poses(
    infos: Mapping[int, Entry], labels: SceneLabels, tolerance: float = ROTATION_TOLERANCE
) -> tuple[set[Place], list[Finding]]:
    """Rotations are rotations, objects are in front of the camera and known.

    Args:
        infos: models_info.json by object id.
        labels: of a scene folder.
        tolerance: by how much R R^T and det R may be off.

    Returns:
        Image and instance of the poses that are sound, and what is wrong with the others.
    """
    places = [(im_id, gt_id) for im_id, gt in labels.gt.items() for gt_id in range(len(gt))]
    entries = [labels.gt[im_id][gt_id] for im_id, gt_id in places]
    R = np.array([entry["cam_R_m2c"] for entry in entries], dtype=np.float64).reshape(-1, 3, 3)
    findings: list[Finding] = []
    sound: set[Place] = set()
    for place, entry, error in zip(places, entries, rotation_error(R), strict=True):
        faults = []
        if not error <= tolerance:
            faults.append(f"cam_R_m2c is no rotation: off by {error:.3g}; {tolerance:g} is allowed")
        if not entry["cam_t_m2c"][2] > 0:
            faults.append(f"cam_t_m2c has z = {entry['cam_t_m2c'][2]} mm; objects are in front of the camera")
        if entry["obj_id"] not in infos:
            faults.append(f"obj_id {entry['obj_id']} is not in models_info.json")
        findings += [Finding("pose", labels.paths.scene_gt, fault, *place) for fault in faults]
        if not faults:
            sound.add(place)
    return sound, findings


def check_specs(
    source: Source, labels: SceneLabels, plans: Sequence[ImagePlan], sound: set[Place]
) -> Iterator[Finding]:
    """scene_spec.jsonl: the planned drops and views, and poses that follow from where the objects came to rest."""
    by_image = {plan.im_id: plan for plan in plans}
    for im_id, recorded in labels.spec.items():
        if im_id in by_image:
            yield from _check_plan(source, labels, recorded, by_image[im_id])
        if im_id in labels.camera and im_id in labels.gt:
            fault = incoherence(recorded, len(labels.gt[im_id]))
            if fault:
                yield Finding("spec", labels.paths.scene_spec, fault, im_id)
            else:
                yield from _check_camera_pose(labels, recorded)
                yield from _check_settled(labels, recorded, sound)
                yield from _check_unlabelled(source, labels, recorded)


def _check_plan(source: Source, labels: SceneLabels, recorded: ImageSpec, plan: ImagePlan) -> Iterator[Finding]:
    found, expected = (recorded.scene.drop, recorded.view), (plan.drop, plan.view)
    if found != expected:
        yield Finding(
            "spec",
            labels.paths.scene_spec,
            f"shows drop {found[0]}, view {found[1]}; this image is of drop {expected[0]}, view {expected[1]}",
            plan.im_id,
        )
    if recorded.sensor != planned_sensor(source.recipe, plan):
        message = "records another sensor than the recipe draws for this image"
        yield Finding("spec", labels.paths.scene_spec, message, plan.im_id)


def incoherence(recorded: ImageSpec, n_labelled: int) -> str | None:
    """Why a record contradicts itself or the number of labels, if it does."""
    objects, settled, shown = recorded.scene.objects, recorded.settled, recorded.instances
    if len(settled) != len(objects):
        return f"has {len(settled)} settled poses of {len(objects)} objects"
    if not recorded.exposure_gain > 0:
        return f"has the exposure gain {recorded.exposure_gain}; a number > 0 is needed"
    if not 0 <= recorded.view < len(recorded.scene.views):
        return f"shows view {recorded.view} of {len(recorded.scene.views)}"
    if len(set(shown)) != len(shown) or not all(0 <= number < len(objects) for number in shown):
        return f"instances {list(shown)} are not different numbers of the {len(objects)} objects"
    if len(shown) != n_labelled:
        return f"has {len(shown)} instances; scene_gt.json has {n_labelled}"
    return None


def _check_camera_pose(labels: SceneLabels, recorded: ImageSpec) -> Iterator[Finding]:
    camera = labels.camera[recorded.image_id]
    R, t_m = extrinsics(recorded.scene.views[recorded.view], settled_centre(recorded.settled))
    off = _difference(camera["cam_R_w2c"], camera["cam_t_w2c"], R, 1000 * t_m)
    if off:
        yield Finding(
            "camera", labels.paths.scene_camera, f"is not where scene_spec.jsonl puts it: {off}", recorded.image_id
        )


def _check_settled(labels: SceneLabels, recorded: ImageSpec, sound: set[Place]) -> Iterator[Finding]:
    im_id = recorded.image_id
    R_w2c, t_w2c = _world_to_camera(labels, im_id)
    for gt_id, (entry, number) in enumerate(zip(labels.gt[im_id], recorded.instances, strict=True)):
        item = recorded.scene.objects[number]
        if item.role != "model" or item.obj_id != entry["obj_id"]:
            yield Finding(
                "spec",
                labels.paths.scene_spec,
                f"says it is {item.role} {item.obj_id}; scene_gt.json has object {entry['obj_id']}",
                im_id,
                gt_id,
            )
        elif (im_id, gt_id) in sound:
            pose = model_to_camera(recorded.settled[number], R_w2c, t_w2c)
            off = _difference(entry["cam_R_m2c"], entry["cam_t_m2c"], *pose)
            if off:
                message = f"pose does not follow from scene_spec.jsonl: {off}"
                yield Finding("pose", labels.paths.scene_gt, message, im_id, gt_id)


def _check_unlabelled(source: Source, labels: SceneLabels, recorded: ImageSpec) -> Iterator[Finding]:
    """A model that is wholly inside the image must have a label, even if it is hidden."""
    im_id, camera = recorded.image_id, source.recipe.intrinsics
    R_w2c, t_w2c = _world_to_camera(labels, im_id)
    for number, (item, pose) in enumerate(zip(recorded.scene.objects, recorded.settled, strict=True)):
        if item.role == "model" and number not in recorded.instances and item.obj_id in source.shapes:
            limits = silhouette_limits(camera, source.shapes[item.obj_id], *model_to_camera(pose, R_w2c, t_w2c))
            if limits and contains(window_box(image_window(camera)), limits) and min(limits[2:]) >= _SURELY_SEEN_PX:
                message = f"object {item.obj_id} (number {number} of the scene) is in the image, but has no label"
                yield Finding("ids", labels.paths.scene_gt, message, im_id)


def _world_to_camera(labels: SceneLabels, im_id: int) -> tuple[Array, Array]:
    camera = labels.camera[im_id]
    return np.array(camera["cam_R_w2c"]).reshape(3, 3), np.array(camera["cam_t_w2c"], dtype=np.float64)


def _difference(R_entry: Sequence[float], t_entry: Sequence[float], R: Array, t: Array) -> str:
    """By how much a stored pose is off, "" if it is the same."""
    off_R = float(np.abs(np.array(R_entry).reshape(3, 3) - R).max())
    off_t = float(np.abs(np.array(t_entry) - t).max())
    return "" if off_R <= _SAME_ROTATION and off_t <= _SAME_MM else f"rotation off by {off_R:.3g}, {off_t:.3g} mm"
