"""Images made again, apart from their light: what the recorded scene, the models and the symmetries say they must be.

A dataset of our own records the settled scene of every image. From it come the camera and the poses; with the models
and rays also depth, masks, counts and everything else that was measured; with symmetries.json the labels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.instances import BACKGROUND, InstanceAnnotation, image_window
from synthetless.annotation.raycast import Plane, RayCaster, Rays
from synthetless.annotation.scene import MM_PER_M, AnnotatedScene, annotate_scene, model_to_camera, scene_caster
from synthetless.config import Recipe
from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import SYMMETRIES_FILE, ImagePlan
from synthetless.dataset.records import (
    CanonicalEntry,
    CocoAnnotation,
    GtEntry,
    ImageSpec,
    ModelInfo,
    camera_matrix,
    camera_model,
    coco_annotations,
    gt_info_entry,
)
from synthetless.dataset.store import planned_depth_sensor, planned_sensor
from synthetless.extras import cv2
from synthetless.io.images import (
    COORDINATE_SCALE_MM,
    decode_depth,
    decode_normals,
    decode_object_coordinates,
    decode_rgb,
    max_depth_mm,
)
from synthetless.io.models import load_models
from synthetless.scenes.camera import extrinsics, settled_centre
from synthetless.scenes.sampling import sample_container, sample_surroundings
from synthetless.scenes.spec import ContainerSpec
from synthetless.symmetry import SymmetryTable
from synthetless.validation.images import (
    EXACT,
    Array,
    InstanceMasks,
    Mask,
    Pictures,
    Tolerance,
    can_decode_exr,
    check_annotation,
    check_info,
    check_masks,
    decode_exr,
    decode_segmentation,
    read_masks,
)
from synthetless.validation.records import ROTATION_TOLERANCE, Place, SceneRecords, rotation_error
from synthetless.validation.report import Finding
from synthetless.validation.structure import MeshSet, Source

_SAME_ROTATION, _SAME_MM = 1e-8, 1e-5
"""Poses: far above what another machine's arithmetic may differ by, far below what anything could see."""
_TOLERANCE_MM = 0.01
"""Depth and coordinates before they are rounded: what single precision and another machine's arithmetic may change."""
_NORMAL_TOLERANCE = 1e-4
_ANOTHER_MACHINE = Tolerance(share=1e-3, px=2, box_px=1)
"""So many pixels of a mask may be on the other side of its edge in another machine's single precision ..."""
_IN_AN_IMAGE = Tolerance(share=1e-4, px=2)
"""... and so many of a whole image."""
_LARGEST_M = 100.0
"""No container is larger."""


_SENSED = Tolerance(share=1e-3, px=4)
"""Of a depth camera's image, which decides about many pixels by thresholds and steps."""


# Cameras and poses: without rays


def check_specs(source: Source, scene: SceneRecords, plans: Sequence[ImagePlan]) -> Iterator[Finding]:
    """The planned drops and views; cameras and poses that follow from where the recorded objects came to rest."""
    yield from _check_cameras(source.recipe, scene)
    by_image = {plan.im_id: plan for plan in plans}
    for im_id, spec in scene.spec.items():
        plan, path = by_image.get(im_id), scene.paths.scene_spec
        if plan is not None and (spec.scene.drop, spec.view) != (plan.drop, plan.view):
            shown = f"shows drop {spec.scene.drop}, view {spec.view}"
            yield Finding("spec", path, f"{shown}; this image is of drop {plan.drop}, view {plan.view}", im_id)
        if plan is not None:
            yield from (
                Finding("spec", path, message, im_id) for message in _drawn_otherwise(source.recipe, spec, plan)
            )
        fault = incoherence(spec)
        if fault:
            yield Finding("spec", path, fault, im_id)
        elif im_id in scene.camera and im_id in scene.gt:
            yield from _check_poses(scene, spec)


def _drawn_otherwise(recipe: Recipe, spec: ImageSpec, plan: ImagePlan) -> Iterator[str]:
    """What is recorded of an image and does not depend on the models, but differs from what the recipe draws for it."""
    scene = spec.scene
    if spec.sensor != planned_sensor(recipe, plan):
        yield "records another sensor than the recipe draws for this image"
    # Which panorama it is depends on the folder, which may be gone.
    offered = () if recipe.light.environments is None else (scene.environment.file if scene.environment else "",)
    if (scene.room, scene.environment) != sample_surroundings(recipe.light, offered, recipe.seed, plan.drop):
        yield "records other surroundings than the recipe draws for this drop"
    if scene.container != sample_container(recipe.release.container, recipe.seed, plan.drop):
        yield "records another container than the recipe draws for this drop"
    if spec.depth_sensor != planned_depth_sensor(recipe, plan):
        yield "records another depth sensor than the recipe draws for this image"


def incoherence(spec: ImageSpec) -> str | None:
    """Why a recorded image contradicts itself, if it does."""
    objects, settled, shown = spec.scene.objects, spec.settled, spec.instances
    if len(settled) != len(objects) or not objects:
        return f"has {len(settled)} settled poses of {len(objects)} objects"
    if not spec.exposure_gain > 0:
        return f"has the exposure gain {spec.exposure_gain}; a number > 0 is needed"
    if not 0 <= spec.view < len(spec.scene.views):
        return f"shows view {spec.view} of {len(spec.scene.views)}"
    if len(set(shown)) != len(shown) or not all(0 <= number < len(objects) for number in shown):
        return f"instances {list(shown)} are not different numbers of the {len(objects)} objects"
    numbers = [value for pose in settled for value in (*pose.rotation_wxyz, *pose.position_m)]
    if not np.isfinite(numbers).all() or any(not any(pose.rotation_wxyz) for pose in settled):
        return "has a settled pose that is no rotation and position of finite numbers"
    return _container_fault(spec.scene.container)


def _container_fault(container: ContainerSpec | None) -> str | None:
    if container is None:
        return None
    lengths_m = (*container.floor_m, container.height_m, container.wall_m)
    if all(0 < length < _LARGEST_M for length in lengths_m) and 0 <= container.slope_deg < 90:
        return None
    return f"has a container with the sizes {lengths_m} m and the slope {container.slope_deg} degrees"


def _check_cameras(recipe: Recipe, scene: SceneRecords) -> Iterator[Finding]:
    """scene_camera.json against the recipe; a camera is a rotation and stands above the table."""
    K, scale = camera_matrix(recipe.intrinsics).reshape(9).tolist(), recipe.encoding.depth_scale
    model, path = camera_model(recipe.intrinsics), scene.paths.scene_camera
    for im_id, entry in scene.camera.items():
        for name, value in (("cam_K", K if model is None else None), ("cam_model", model)):
            if entry.get(name) != value:
                yield Finding("camera", path, f"{name} is {entry.get(name)}; the recipe's camera has {value}", im_id)
        if entry["depth_scale"] != scale:
            yield Finding("camera", path, f"depth_scale is {entry['depth_scale']}; the recipe has {scale}", im_id)
        R = np.array(entry["cam_R_w2c"]).reshape(3, 3)
        error = rotation_error(R[None])[0]
        if not error <= ROTATION_TOLERANCE:
            yield Finding("camera", path, f"cam_R_w2c is no rotation: off by {error:.3g}", im_id)
        elif not (height := float(-R[:, 2] @ entry["cam_t_w2c"])) > 0:
            yield Finding("camera", path, f"stands {height:.1f} mm above the table; it must be above", im_id)


def _check_poses(scene: SceneRecords, spec: ImageSpec) -> Iterator[Finding]:
    im_id, paths = spec.image_id, scene.paths
    camera, gt = scene.camera[im_id], scene.gt[im_id]
    R_w2c, t_w2c_m = extrinsics(spec.scene.views[spec.view], settled_centre(spec.settled))
    t_w2c = t_w2c_m * MM_PER_M
    off = _difference(camera["cam_R_w2c"], camera["cam_t_w2c"], R_w2c, t_w2c)
    if off:
        yield Finding("camera", paths.scene_camera, f"is not where scene_spec.jsonl puts it: {off}", im_id)
    if len(spec.instances) != len(gt):
        message = f"has {len(spec.instances)} instances; scene_gt.json has {len(gt)}"
        yield Finding("spec", paths.scene_spec, message, im_id)
        return
    for gt_id, (entry, number) in enumerate(zip(gt, spec.instances, strict=True)):
        item = spec.scene.objects[number]
        if item.role != "model" or item.obj_id != entry["obj_id"]:
            message = f"says it is {item.role} {item.obj_id}; scene_gt.json has object {entry['obj_id']}"
            yield Finding("spec", paths.scene_spec, message, im_id, gt_id)
            continue
        off = _difference(entry["cam_R_m2c"], entry["cam_t_m2c"], *model_to_camera(spec.settled[number], R_w2c, t_w2c))
        if off:
            message = f"pose does not follow from scene_spec.jsonl: {off}"
            yield Finding("pose", paths.scene_gt, message, im_id, gt_id)


def _difference(R_entry: Sequence[float], t_entry: Sequence[float], R: Array, t: Array) -> str:
    """By how much a stored pose is off, "" if it is the same."""
    off_R = float(np.abs(np.array(R_entry).reshape(3, 3) - R).max())
    off_t = float(np.abs(np.array(t_entry) - t).max())
    return "" if off_R <= _SAME_ROTATION and off_t <= _SAME_MM else f"rotation off by {off_R:.3g}, {off_t:.3g} mm"


# Images: with rays


@lru_cache(maxsize=1)
def _caster(meshes: tuple[MeshSet, ...]) -> RayCaster:
    """The ray caster of a process; its trees are built once."""
    return scene_caster(
        {of.role: load_models(of.folder, tuple(obj_id for obj_id, _ in of.digests)) for of in meshes if of.digests}
    )


def recompute(source: Source, spec: ImageSpec | None) -> AnnotatedScene | None:
    """An image as it must be; None if its record is not sound, which is told, or a mesh cannot be found."""
    known = {(of.role, obj_id) for of in source.meshes for obj_id, _ in of.digests}
    if spec is None or incoherence(spec) or any((item.role, item.obj_id) not in known for item in spec.scene.objects):
        return None
    with np.errstate(all="ignore"):  # of absurd numbers in a damaged record
        try:
            caster, recipe = _caster(source.meshes), source.recipe
            return annotate_scene(caster, recipe, spec.scene, spec.settled, spec.view, spec.depth_sensor)
        except (ValueError, OverflowError):
            return None


@dataclass(frozen=True, eq=False)
class StoredImage:
    """The measured files of an image, decoded; None where one is missing, unusable or not asked for.

    Attributes:
        depth_mm: (H, W), 0 for none.
        sensed_mm: the same as a depth camera measures it.
        masks: by gt_id.
        normals: (H, W, 3).
        coordinates_mm: (H, W, 4), the last 1 where there is a point.
        annotations: of scene_gt_coco.json, by gt_id.
        findings: what is wrong with the files.
    """

    depth_mm: Array | None
    sensed_mm: Array | None
    masks: list[InstanceMasks]
    normals: Array | None
    coordinates_mm: Array | None
    annotations: Mapping[int, CocoAnnotation]
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def read(
        cls, source: Source, scene: SceneRecords, im_id: int, annotations: Mapping[int, CocoAnnotation]
    ) -> StoredImage:
        """Decode every file of an image, also of one whose entries in the JSON files cannot be used."""
        paths, pictures = scene.paths, Pictures(im_id, source.shape)
        scale = source.recipe.encoding.depth_scale
        recorded = scene.spec[im_id].instances if im_id in scene.spec else ()
        n_instances = len(scene.gt.get(im_id, recorded))
        if source.has("rgb"):
            pictures.read(paths.rgb(im_id, source.recipe.encoding.rgb_format), decode_rgb)
        if source.has("exr") and can_decode_exr():
            pictures.read(paths.exr(im_id), decode_exr)

        def depth(data: bytes, path: Path) -> Array:
            return decode_depth(data, scale, path)

        return cls(
            pictures.read(paths.depth(im_id), depth) if source.has("depth") else None,
            pictures.read(paths.depth_sensed(im_id), depth) if source.has("depth_sensed") else None,
            read_masks(paths, im_id, n_instances, pictures) if source.has("masks") else [InstanceMasks()] * n_instances,
            pictures.read(paths.normals(im_id), decode_normals) if source.has("normals") else None,
            pictures.read(paths.object_coordinates(im_id), _coordinates) if source.has("object_coordinates") else None,
            annotations,
            pictures.findings,
        )

    def where_depth(self, source: Source) -> Mask | None:
        """(H, W) where the image has depth: everywhere if none is asked for; None if that cannot be read."""
        if not source.has("depth"):
            return np.ones(source.shape, dtype=bool)
        return None if self.depth_mm is None else self.depth_mm > 0


def _coordinates(data: bytes, path: Path) -> Array:
    points_mm, present = decode_object_coordinates(data, path)
    return np.dstack([points_mm, present])


def check_image(
    source: Source,
    scene: SceneRecords,
    im_id: int,
    annotations: Mapping[int, CocoAnnotation],
    expected: AnnotatedScene | None,
) -> Iterator[Finding]:
    """All files of an image: whether they can be read, agree with each other, and are what was recomputed.

    Args:
        source: the dataset.
        scene: what the JSON files of the image's folder say.
        im_id: the image.
        annotations: of scene_gt_coco.json, by gt_id.
        expected: the image made again; None if only the files are compared with each other.
    """
    stored = StoredImage.read(source, scene, im_id, annotations)
    yield from stored.findings
    if not scene.is_complete(im_id):
        return
    yield from check_masks(scene.paths, im_id, stored.masks, source.recipe.labels.visibility_delta_mm == 0)
    instances: Sequence[InstanceAnnotation | None] = [None] * len(stored.masks)
    if expected is not None:
        yield from _compare_images(source, scene, im_id, stored, expected)
        if len(expected.models) == len(stored.masks):
            instances = expected.image.instances
            yield from _compare_numbers(scene, im_id, expected.numbers)
        else:
            shown = ", ".join(str(model.obj_id) for model in expected.models)
            message = f"has {len(stored.masks)} instances; the recorded scene shows {len(expected.models)}: {shown}"
            yield Finding("ids", scene.paths.scene_gt, message, im_id)
    for gt_id, instance in enumerate(instances):
        yield from _check_instance(source, scene, (im_id, gt_id), stored, instance)


def _compare_numbers(scene: SceneRecords, im_id: int, numbers: Sequence[int]) -> Iterator[Finding]:
    for gt_id, (found, number) in enumerate(zip(scene.spec[im_id].instances, numbers, strict=False)):
        if found != number:
            message = f"says it is number {found} of the scene; number {number} is expected"
            yield Finding("spec", scene.paths.scene_spec, message, im_id, gt_id)


def _check_instance(
    source: Source, scene: SceneRecords, place: Place, stored: StoredImage, expected: InstanceAnnotation | None
) -> Iterator[Finding]:
    """Masks, counts, boxes and annotation of one instance."""
    im_id, gt_id = place
    paths, info, obj_id = scene.paths, scene.gt_info[im_id][gt_id], scene.gt[im_id][gt_id]["obj_id"]
    masks, annotation = stored.masks[gt_id], stored.annotations.get(gt_id)
    inside = False
    if expected is not None:
        yield from _compare_masks(scene, place, masks, annotation, expected)
        faults = _compare_info(info, expected)
        yield from (Finding("gt_info", paths.scene_gt_info, fault, im_id, gt_id) for fault in faults)
        if _is_exactly(masks, expected) and info == gt_info_entry(expected):
            recounted = coco_annotations(im_id, [obj_id], [expected])
            if annotation is None or [{**annotation, "id": 0}] == [{**entry, "id": 0} for entry in recounted]:
                return
        inside = expected.px_count_all == np.count_nonzero(expected.mask)
    faults = check_info(info, masks, stored.where_depth(source), source.shape, inside, EXACT)
    yield from (Finding("gt_info", paths.scene_gt_info, fault, im_id, gt_id) for fault in faults)
    if annotation is not None:
        faults = check_annotation(annotation, obj_id, info, masks, source.shape)
        yield from (Finding("coco", paths.scene_gt_coco, fault, im_id, gt_id) for fault in faults)


def _is_exactly(masks: InstanceMasks, expected: InstanceAnnotation) -> bool:
    return np.array_equal(masks.whole, expected.mask) and np.array_equal(masks.visible, expected.mask_visib)  # type: ignore[arg-type]


def _compare_masks(
    scene: SceneRecords,
    place: Place,
    masks: InstanceMasks,
    annotation: CocoAnnotation | None,
    expected: InstanceAnnotation,
) -> Iterator[Finding]:
    """Each mask against the recomputed one; the annotation's, where there are no mask files."""
    compared: list[tuple[str, Path, Mask | None, Mask]] = [
        ("mask", scene.paths.mask(*place), masks.whole, expected.mask),
        ("mask", scene.paths.mask_visib(*place), masks.visible, expected.mask_visib),
    ]
    if masks.visible is None and annotation is not None:
        decoded = decode_segmentation(annotation, expected.mask.shape)  # type: ignore[arg-type]
        compared.append(("coco", scene.paths.scene_gt_coco, decoded, expected.mask_visib))
    for kind, path, stored, mask in compared:
        off = 0 if stored is None or stored is mask else int(np.count_nonzero(stored != mask))
        if off and off > _ANOTHER_MACHINE.allowed(np.count_nonzero(mask)):
            message = f"{off} pixels differ from the recomputed mask of {np.count_nonzero(mask)} pixels"
            yield Finding("coco" if kind == "coco" else "mask", path, message, *place)


def _compare_info(info: Mapping[str, object], expected: InstanceAnnotation) -> Iterator[str]:
    for name in ("px_count_all", "px_count_valid", "px_count_visib"):
        if not _ANOTHER_MACHINE.allows(info[name], count := getattr(expected, name)):  # type: ignore[arg-type]
            yield f"{name} is {info[name]}; {count} is recomputed"
    for name in ("bbox_obj", "bbox_visib"):
        if not _ANOTHER_MACHINE.allows_box(info[name], box := getattr(expected, name)):  # type: ignore[arg-type]
            yield f"{name} is {info[name]}; {list(box)} is recomputed"


def _compare_images(
    source: Source, scene: SceneRecords, im_id: int, stored: StoredImage, expected: AnnotatedScene
) -> Iterator[Finding]:
    """Depth, normals and object coordinates."""
    paths, image = scene.paths, expected.image
    if stored.depth_mm is not None:
        yield from _compare_depth(source.recipe, paths.depth(im_id), im_id, stored.depth_mm, expected)
    if stored.sensed_mm is not None and expected.sensed_mm is not None:
        yield from _compare_sensed(
            source.recipe, paths.depth_sensed(im_id), im_id, stored.sensed_mm, expected.sensed_mm
        )
    if stored.normals is not None and image.normals is not None:
        wrong = (np.abs(stored.normals - image.normals) > _NORMAL_TOLERANCE).any(axis=2)
        if (count := int(np.count_nonzero(wrong))) > _IN_AN_IMAGE.allowed(wrong.size):
            message = f"{count} normals are not the recomputed ones"
            yield Finding("geometry", paths.normals(im_id), message, im_id)
    if stored.coordinates_mm is not None and image.object_coordinates_mm is not None:
        path, owner = paths.object_coordinates(im_id), image.instance_ids
        yield from _compare_coordinates(path, im_id, stored.coordinates_mm, image.object_coordinates_mm, owner)


def _compare_depth(
    recipe: Recipe, path: Path, im_id: int, stored_mm: Array, expected: AnnotatedScene
) -> Iterator[Finding]:
    """Depth that is not the recomputed one, of each instance and of the rest.

    At edges single precision decides; the table alone is computed in double precision, and must be right to the pixel.
    """
    scale = recipe.encoding.depth_scale
    depth_mm = expected.image.depth_mm
    within = np.where(depth_mm < max_depth_mm(scale) + scale / 2, depth_mm, 0.0)  # else stored as none
    off = np.abs(stored_mm - within)
    wrong = off > scale / 2 * (1 + 1e-6) + _TOLERANCE_MM
    count = int(np.count_nonzero(wrong))
    if count == 0:
        return
    if count <= _IN_AN_IMAGE.allowed(wrong.size) and not (wrong & _only_table(recipe, expected)).any():
        return
    owner = expected.image.instance_ids
    for gt_id in np.unique(owner[wrong]).tolist():
        at = wrong & (owner == gt_id)
        row, column = (int(place[0]) for place in np.nonzero(at))
        message = (
            f"{np.count_nonzero(at)} pixels differ from the recomputed depth, by up to {off[at].max():.2f} mm; the "
            f"first, column {column}, row {row}, has {stored_mm[row, column]:.3f} mm, not {within[row, column]:.3f}"
        )
        yield Finding("depth", path, message, im_id, None if gt_id == BACKGROUND else gt_id)


def _compare_sensed(recipe: Recipe, path: Path, im_id: int, stored_mm: Array, expected_mm: Array) -> Iterator[Finding]:
    """A depth camera's depth that is not the recomputed one."""
    scale = recipe.encoding.depth_scale
    within = np.where(expected_mm < max_depth_mm(scale) + scale / 2, expected_mm, 0.0)
    off = np.abs(stored_mm - within)
    wrong = off > scale / 2 * (1 + 1e-6) + _TOLERANCE_MM
    if (count := int(np.count_nonzero(wrong))) > _SENSED.allowed(wrong.size):
        message = f"{count} pixels differ from the recomputed depth of the depth camera, by up to {off.max():.2f} mm"
        yield Finding("depth", path, message, im_id)


def _only_table(recipe: Recipe, expected: AnnotatedScene) -> Mask:
    """(H, W) pixels that show the table, and whose neighbours do."""
    table = Plane(expected.R_w2c, expected.t_w2c, recipe.table.size_m * MM_PER_M / 2)
    plane_mm = table.depth_mm(Rays.through(recipe.intrinsics, image_window(recipe.intrinsics)))
    shows = (expected.image.depth_mm == plane_mm) & (expected.image.instance_ids == BACKGROUND)
    return np.asarray(cv2.erode(shows.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _compare_coordinates(
    path: Path, im_id: int, stored: Array, expected_mm: NDArray[np.float32], owner: NDArray[np.int32]
) -> Iterator[Finding]:
    points_mm, present = stored[..., :3], stored[..., 3] > 0
    odd = int(np.count_nonzero(present != (owner != BACKGROUND)))
    if odd > _IN_AN_IMAGE.allowed(owner.size):
        yield Finding("geometry", path, f"{odd} pixels have coordinates and no instance, or the reverse", im_id)
    off = np.abs(points_mm - expected_mm).max(axis=2)
    wrong = present & (off > COORDINATE_SCALE_MM / 2 + _TOLERANCE_MM)
    if np.count_nonzero(wrong) > _IN_AN_IMAGE.allowed(owner.size):
        for gt_id in np.unique(owner[wrong & (owner != BACKGROUND)]).tolist():
            at = wrong & (owner == gt_id)
            message = f"{np.count_nonzero(at)} points are up to {off[at].max():.2f} mm away from the recomputed ones"
            yield Finding("geometry", path, message, im_id, gt_id)


# Labels

_LABEL_FIELDS = {
    "cam_R_m2c_canonical": (9, 1e-7),
    "cam_t_m2c_canonical": (3, 1e-5),
    "regressor_index": (1, 0.0),
    "n_regressors": (1, 0.0),
    "discontinuity_margin_deg": (1, 1e-4),
    "bbox3d_corners_2d": (16, 1e-4),
}
"""Numbers in each field, and by how much they may be off on another machine, also as a share."""
_OF_OTHER_SYMMETRIES = 0.2
"""Share of wrong labels of one object in a scene folder from which they are taken for those of other symmetries."""


def check_labels(
    symmetries: Path | None, infos: Mapping[int, ModelInfo], scene: SceneRecords, valid: set[Place]
) -> tuple[list[Finding], tuple[int, ...]]:
    """Recompute every label of a valid pose, as far as its object is described.

    Args:
        symmetries: symmetries.json; None if it cannot be read.
        infos: models_info.json by object id.
        scene: what the JSON files of a scene folder say.
        valid: the poses that are poses.

    Returns:
        The labels that differ; and the objects so many of whose labels differ that they are of other symmetries.
    """
    if symmetries is None:
        return [], ()
    table = SymmetryTable.read(symmetries)
    described = infos.keys() & table.entries.keys()
    places = [
        (im_id, gt_id)
        for im_id, gt in scene.gt.items()
        for gt_id, entry in enumerate(gt)
        if (im_id, gt_id) in valid
        and entry["obj_id"] in described
        and im_id in scene.camera
        and len(scene.canonical.get(im_id, ())) == len(gt)
    ]
    if not places:
        return [], ()
    gt_of: dict[int, list[GtEntry]] = {}
    for im_id, gt_id in places:
        gt_of.setdefault(im_id, []).append(scene.gt[im_id][gt_id])
    labels = label_scene(gt_of, scene.camera, table, infos)
    expected = [label for im_id in gt_of for label in labels[im_id]]
    stored = [scene.canonical[im_id][gt_id] for im_id, gt_id in places]
    differs = np.flatnonzero(~_agree(_label_rows(stored), _label_rows(expected)))
    path = scene.paths.scene_gt_canonical
    findings = [Finding("canonical", path, _explain(stored[i], expected[i]), *places[i]) for i in differs]
    total = Counter(entry["obj_id"] for entry in expected)
    wrong = Counter(expected[i]["obj_id"] for i in differs)
    stale = [obj_id for obj_id, count in wrong.items() if count > 1 and count >= _OF_OTHER_SYMMETRIES * total[obj_id]]
    return findings, tuple(sorted(stale))


def _label_rows(entries: Sequence[CanonicalEntry]) -> Array:
    """(N, 31) all numbers of labels."""
    columns = [np.array([entry[name] for entry in entries], dtype=np.float64) for name in _LABEL_FIELDS]  # type: ignore[literal-required]
    return np.concatenate([column.reshape(len(entries), -1) for column in columns], axis=1)


def _agree(stored: Array, expected: Array) -> Mask:
    """(N,) whether labels are the same."""
    tolerance = np.concatenate([np.full(count, tolerance) for count, tolerance in _LABEL_FIELDS.values()])
    agree: Mask = (np.abs(stored - expected) <= tolerance * np.maximum(1.0, np.abs(expected))).all(axis=1)
    return agree


def _explain(stored: CanonicalEntry, expected: CanonicalEntry) -> str:
    off = np.abs(_label_rows([stored])[0] - _label_rows([expected])[0])
    ends = np.cumsum([count for count, _ in _LABEL_FIELDS.values()])
    parts = zip(_LABEL_FIELDS, np.split(off, ends[:-1]), strict=True)
    wrong = [f"{name} off by {part.max():.3g}" for name, part in parts if part.max() > 0]
    return f"does not follow from scene_gt.json and {SYMMETRIES_FILE}: {', '.join(wrong)}"
