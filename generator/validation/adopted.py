"""Datasets that others made and ``adopt`` labelled: what can be checked without a recipe and without records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
from pydantic import TypeAdapter

from synthetless.dataset.labels import is_half_labelled
from synthetless.dataset.layout import DATASET_FILE, SYMMETRIES_FILE, ScenePaths, scene_folders
from synthetless.dataset.layout import find_models_folder as models_folder
from synthetless.dataset.records import Entry
from synthetless.io.images import decode_depth
from synthetless.io.models import INFO_FILE
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.quaternions import MAX_DEFECT
from synthetless.validation import masks
from synthetless.validation.canonical import check_canonical
from synthetless.validation.files import Place, place_of
from synthetless.validation.geometry import Array
from synthetless.validation.labels import CANONICAL, SceneLabels, check_lists, read_entries
from synthetless.validation.models import read_infos
from synthetless.validation.pictures import Pictures, check_rgb
from synthetless.validation.poses import check_poses
from synthetless.validation.report import Finding, Tally, bare
from synthetless.validation.scene import SceneResult
from synthetless.validation.schemas import ForeignCameraEntry, ForeignGtEntry, ForeignGtInfoEntry

_CAMERA = TypeAdapter(ForeignCameraEntry)
_GT, _GT_INFO = TypeAdapter(list[ForeignGtEntry]), TypeAdapter(list[ForeignGtInfoEntry])
_PICTURES, _MASKS = ("rgb", "gray", "depth"), ("mask", "mask_visib")


@dataclass(frozen=True, eq=False)
class Adopted:
    """What every scene of an adopted dataset is held against; travels to the worker processes.

    Attributes:
        root: the dataset's folder.
        scenes: its scene folders, of all splits.
        infos: models_info.json by object id; None if it is not inside the dataset.
        labelled: whether labels can be recomputed.
        limit: how many faults of each kind to keep.
    """

    root: Path
    scenes: tuple[ScenePaths, ...]
    infos: Mapping[int, Entry] | None
    labelled: bool
    limit: int


@dataclass(frozen=True, eq=False)
class AdoptedTask:
    """What a worker is given: the dataset, and the number of a scene folder."""

    adopted: Adopted
    number: int


def is_adopted(root: Path) -> bool:
    """Whether a folder holds labels, but neither the recipe nor the records of ``generate``."""
    made_here = (root / DATASET_FILE).exists() or any(root.glob("*/*/scene_spec.jsonl"))
    return not made_here and any(root.glob("*/*/scene_gt_canonical.json"))


def read_adopted(root: Path, limit: int) -> tuple[Adopted, list[Finding]]:
    """Read and check what lies outside the scene folders."""
    findings: list[Finding] = []
    if is_half_labelled(root):
        message = "the dataset is half labelled: adopt was killed while the files took their places; run it again"
        findings.append(Finding("stale", root / SYMMETRIES_FILE, message))
    infos: Mapping[int, Entry] | None = None
    try:
        infos, faults = read_infos(models_folder(root) / INFO_FILE)
        findings += faults
    except ValueError:  # adopt was given another folder
        pass
    table = _read_table(root / SYMMETRIES_FILE, findings)
    labelled = table is not None and infos is not None and infos.keys() <= table.entries.keys()
    scenes = tuple(scene_folders(root, ("scene_gt.json", "scene_gt_canonical.json")))
    return Adopted(root, scenes, infos, labelled, limit), findings


def check_adopted_scene(task: AdoptedTask) -> SceneResult:
    """Check a scene folder."""
    adopted, paths = task.adopted, task.adopted.scenes[task.number]
    tally = Tally(adopted.limit)
    labels = _read_labels(paths)
    tally.add(labels.findings)
    tally.add(_check_agreement(labels))
    known = adopted.infos or {entry["obj_id"]: {} for gt in labels.gt.values() for entry in gt}
    sound, findings = check_poses(known, labels, MAX_DEFECT)
    tally.add(findings)
    table = adopted.root / SYMMETRIES_FILE if adopted.labelled else None
    labelling = check_canonical(table, known, labels, sound)
    tally.add(labelling.findings)
    if labelling.stale:
        objects = ", ".join(map(str, labelling.stale))
        message = f"labels of object {objects} are of other symmetries than {SYMMETRIES_FILE}, or boxes; run adopt"
        tally.add([Finding("stale", paths.scene_gt_canonical, message)])
    tally.add(_check_folders(labels))
    shape = _shape(paths)
    if shape is not None:
        for im_id in labels.gt:
            tally.add(_check_image(labels, im_id, shape))
    instances = sum(len(gt) for gt in labels.gt.values())
    return SceneResult(task.number, tally, tuple(labels.gt), instances, labelling.stale)


def left_out(adopted: Adopted) -> Iterator[str]:
    """What was not checked, and why."""
    yield (
        f"no {DATASET_FILE}: taken for a dataset that others made and adopt labelled. Not checked: models, "
        "scene_gt_coco.json, depth against poses, and what only a recipe and records tell"
    )
    if adopted.infos is None:
        yield f"labels were not recomputed: no {INFO_FILE} inside the dataset"
    for name in ("scene_gt_info.json", "mask", "mask_visib", "depth"):
        without = sum(not (scene.root / name).exists() for scene in adopted.scenes)
        if without:
            yield f"{without} of {len(adopted.scenes)} scene folders have no {name}"


def _read_table(path: Path, findings: list[Finding]) -> SymmetryTable | None:
    if not path.exists():
        findings.append(Finding("missing", path, "not there; without it nobody knows what the labels mean"))
        return None
    try:
        return SymmetryTable.read(path)
    except ValueError as error:
        findings.append(Finding("symmetries", path, bare(error, path)))
        return None


def _read_labels(paths: ScenePaths) -> SceneLabels:
    findings: list[Finding] = []
    return SceneLabels(
        paths,
        camera=read_entries(paths.scene_camera, _CAMERA, findings),
        gt=read_entries(paths.scene_gt, _GT, findings),
        gt_info=read_entries(paths.scene_gt_info, _GT_INFO, findings) if paths.scene_gt_info.exists() else {},
        canonical=read_entries(paths.scene_gt_canonical, CANONICAL, findings),
        findings=findings,
    )


def _check_agreement(labels: SceneLabels) -> Iterator[Finding]:
    """Every image of scene_gt.json is in the other files, with as many instances of the same objects."""
    paths = labels.paths
    others: list[tuple[Path, Mapping[int, object]]] = [(paths.scene_camera, labels.camera)]
    lists = [(paths.scene_gt_canonical, labels.canonical)]
    if paths.scene_gt_info.exists():
        lists.append((paths.scene_gt_info, labels.gt_info))
    for path, content in [*others, *lists]:
        if labels.is_readable(path):
            for im_id in sorted(labels.gt.keys() - content.keys() - labels.malformed(path)):
                yield Finding("missing", path, "image is missing; scene_gt.json has it", im_id)
    if labels.is_readable(paths.scene_gt):
        for im_id in sorted(labels.canonical.keys() - labels.gt.keys() - labels.malformed(paths.scene_gt)):
            yield Finding("ids", paths.scene_gt_canonical, "has this image; scene_gt.json has not", im_id)
    for path, entries in lists:
        for im_id in sorted(labels.gt.keys() & entries.keys()):
            yield from check_lists(path, im_id, labels.gt[im_id], entries[im_id])


def _check_folders(labels: SceneLabels) -> Iterator[Finding]:
    """A folder of pictures has one for each image, a folder of masks one for each instance, and no other."""
    paths = labels.paths
    images: set[Place] = {(im_id, None) for im_id in labels.gt}
    instances: set[Place] = {(im_id, gt_id) for im_id, gt in labels.gt.items() for gt_id in range(len(gt))}
    unknown = labels.malformed(paths.scene_gt)
    for name, expected in {**dict.fromkeys(_PICTURES, images), **dict.fromkeys(_MASKS, instances)}.items():
        folder = paths.root / name
        found = {place_of(path.name): path for path in folder.iterdir()} if folder.is_dir() else {}
        for place in sorted(expected - found.keys(), key=str) if found else ():
            yield Finding("missing", folder, "has no file for it", *place)
        if name in _MASKS and labels.is_readable(paths.scene_gt):
            for place in sorted((place for place in found.keys() - expected if place[0] not in unknown), key=str):
                yield Finding("stray", found[place], "belongs to no instance in scene_gt.json", *place)


def _shape(paths: ScenePaths) -> tuple[int, int] | None:
    """Rows and columns of the scene's images, by the first that can be read; None if none can."""
    for name in ("mask", "depth", "rgb", "gray"):
        for path in sorted((paths.root / name).glob("*.*"))[:3]:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if image is not None:
                return int(image.shape[0]), int(image.shape[1])
    return None


def _check_image(labels: SceneLabels, im_id: int, shape: tuple[int, int]) -> Iterator[Finding]:
    """Pictures can be read, and masks, counts and boxes fit each other."""
    paths, pictures = labels.paths, Pictures(im_id, shape)
    for extension in ("png", "jpg"):
        yield from check_rgb(paths.rgb(im_id, extension), im_id, shape)
    depth = _read_depth(labels, im_id, pictures)
    files = masks.read_masks(paths, im_id, len(labels.gt[im_id]), pictures)
    yield from masks.check_masks(paths, im_id, files, shape, exact=False)
    camera = Intrinsics(shape[1], shape[0], 1.0, 1.0, 0.0, 0.0)  # its size is all that is asked for
    infos = labels.gt_info.get(im_id, [])
    if len(infos) == len(files):
        for gt_id, (info, of_instance) in enumerate(zip(infos, files, strict=True)):
            yield from masks.check_info(camera, None, paths, im_id, gt_id, info, of_instance, depth, masks.AS_RENDERED)
    yield from pictures.findings


def _read_depth(labels: SceneLabels, im_id: int, pictures: Pictures) -> Array | None:
    if im_id not in labels.camera:
        return None
    scale = labels.camera[im_id].get("depth_scale", 1.0)
    return pictures.read(labels.paths.depth(im_id), lambda data, path: decode_depth(data, scale, path))
