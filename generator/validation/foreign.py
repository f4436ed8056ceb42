"""Datasets that others made and ``adopt`` labelled: what can be checked without a recipe and without records."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.labels import is_half_labelled
from synthetless.dataset.layout import (
    AMBIGUITY_FILE,
    DATASET_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    other_sensors,
    scene_folders,
)
from synthetless.dataset.records import (
    CameraEntry,
    CanonicalEntry,
    ForeignCameraEntry,
    ForeignGtEntry,
    ForeignGtInfoEntry,
    ModelInfo,
)
from synthetless.extras import cv2
from synthetless.io.files import read_bytes
from synthetless.io.images import DamagedImageError, decode_depth, decode_mask, decode_rgb
from synthetless.io.models import INFO_FILE
from synthetless.symmetry.quaternions import MAX_DEFECT
from synthetless.validation.ambiguity import check_ambiguity
from synthetless.validation.images import (
    AS_RENDERED,
    InstanceMasks,
    Mask,
    Pictures,
    can_see,
    check_info,
    check_masks,
    container_fault,
    not_seen,
)
from synthetless.validation.recompute import check_labels
from synthetless.validation.records import Place, SceneRecords, check_instances, check_poses, read_entries, read_judged
from synthetless.validation.report import Finding, Tally
from synthetless.validation.structure import read_infos, read_table

_PICTURES, _MASKS = ("rgb", "gray", "depth"), ("mask", "mask_visib")
_IMAGE_NAME = re.compile(r"(\d{6})\.(?:png|jpe?g|tiff?)", re.IGNORECASE)
_MASK_NAME = re.compile(r"(\d{6})_(\d{6})\.(?:png|jpe?g|tiff?)", re.IGNORECASE)
_ENOUGH_TO_KNOW_THE_SIZE = 3
_NAMES_SHOWN = 8


@dataclass(frozen=True, eq=False)
class Foreign:
    """What every scene of an adopted dataset is held against; travels to the worker processes.

    Attributes:
        root: the dataset's folder.
        scenes: its scene folders, of all splits.
        infos: entries of models_info.json by object id, of the right form; None if it is not inside the dataset.
        obj_ids: of all its entries.
        symmetries: symmetries.json; None if it cannot be read.
        limit: how many faults of each kind to keep.
    """

    root: Path
    scenes: tuple[ScenePaths, ...]
    infos: Mapping[int, ModelInfo] | None
    obj_ids: frozenset[int]
    symmetries: Path | None
    limit: int


@dataclass(frozen=True, eq=False)
class ForeignTask:
    """What a worker is given: the dataset, and the number of a scene folder."""

    foreign: Foreign
    number: int


@dataclass(frozen=True, eq=False)
class ForeignResult:
    """What a worker gives back: the faults, how many images and instances there are, and names of unchecked files."""

    tally: Tally
    images: int
    instances: int
    unchecked: frozenset[str]


def is_adopted(root: Path) -> bool:
    """Whether a folder holds labels, but neither the recipe nor the records of ``generate``."""
    made_here = (root / DATASET_FILE).exists() or any(root.glob("*/*/scene_spec.jsonl"))
    return not made_here and any(root.glob("*/*/scene_gt_canonical.json"))


def read_foreign(root: Path, limit: int) -> tuple[Foreign, list[Finding]]:
    """Read and check what lies outside the scene folders."""
    findings: list[Finding] = []
    if is_half_labelled(root):
        message = "the dataset is half labelled: adopt was killed while the files took their places; run it again"
        findings.append(Finding("stale", root / SYMMETRIES_FILE, message))
    infos: Mapping[int, ModelInfo] | None = None
    obj_ids: frozenset[int] = frozenset()
    try:
        path = find_models_folder(root) / INFO_FILE
    except ValueError:  # adopt was given another folder
        pass
    else:
        infos, obj_ids, faults = read_infos(path, declared=False)
        findings += faults
    table = read_table(root, infos or (), findings)
    scenes = tuple(scene_folders(root, ("scene_gt.json", "scene_gt_canonical.json")))
    symmetries = root / SYMMETRIES_FILE if table else None
    return Foreign(root, scenes, infos, obj_ids, symmetries, limit), findings


def check_foreign_scene(task: ForeignTask) -> ForeignResult:
    """Check a scene folder."""
    foreign, paths = task.foreign, task.foreign.scenes[task.number]
    tally = Tally(foreign.limit)
    scene = _read_records(paths)
    tally.add(scene.findings)
    tally.add(_check_agreement(scene))
    known = foreign.obj_ids or {entry["obj_id"] for gt in scene.gt.values() for entry in gt}
    valid, findings = check_poses(known, scene, MAX_DEFECT)
    tally.add(findings)
    findings, stale = check_labels(foreign.symmetries, foreign.infos or {}, scene, valid)
    tally.add(findings)
    if stale:
        objects = ", ".join(map(str, stale))
        message = f"labels of object {objects} are of other symmetries than {SYMMETRIES_FILE}, or boxes; run adopt"
        tally.add([Finding("stale", paths.scene_gt_canonical, message)])
    tally.add(check_ambiguity(foreign.root, scene))
    files = SceneFiles.list(scene)
    tally.add(files.check_folders(scene))
    for im_id in sorted(scene.gt.keys() | files.image_ids) if can_see() else ():
        tally.add(_check_image(scene, files, im_id))
    instances = sum(len(gt) for gt in scene.gt.values())
    return ForeignResult(tally, len(scene.gt), instances, files.unchecked)


def notes_on(foreign: Foreign, results: Sequence[ForeignResult]) -> Iterator[str]:
    """What was not checked, and why."""
    splits = {scene.root.parent.name for scene in foreign.scenes}
    beside = {path.name for path in foreign.root.iterdir()} - splits - {SYMMETRIES_FILE, AMBIGUITY_FILE, "models"}
    names = sorted(name for name in beside if not name.startswith("."))
    names += sorted(set[str]().union(*(result.unchecked for result in results)))
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    yield (
        f"no {DATASET_FILE}: taken for a dataset that others made and adopt labelled. Not checked: models, depth "
        "against poses, what only a recipe and records tell" + ", ".join(["", *names[:_NAMES_SHOWN]]) + more
    )
    if sensors := {name for scene in foreign.scenes for name in other_sensors(scene.root)}:
        yield f"several sensors in one scene folder ({', '.join(sorted(sensors))}) are not supported, and not checked"
    if not can_see():
        yield not_seen()
    if foreign.infos is None:
        yield f"labels were not recomputed: no {INFO_FILE} inside the dataset"
    for what in (("scene_gt_info.json",), ("mask",), ("mask_visib",), ("depth",), ("rgb", "gray")):
        without = sum(not any((scene.root / name).exists() for name in what) for scene in foreign.scenes)
        if without:
            yield f"{without} of {len(foreign.scenes)} scene folders have no {' and no '.join(what)}"


# Records


def _read_records(paths: ScenePaths) -> SceneRecords:
    findings: list[Finding] = []
    ambiguity, is_current = read_judged(paths, findings)
    return SceneRecords(
        paths,
        camera=_read_cameras(paths.scene_camera, findings),
        gt=read_entries(paths.scene_gt, list[ForeignGtEntry], findings),
        gt_info=read_entries(paths.scene_gt_info, list[ForeignGtInfoEntry], findings)
        if paths.scene_gt_info.exists()
        else {},
        canonical=read_entries(paths.scene_gt_canonical, list[CanonicalEntry], findings),
        ambiguity=ambiguity,
        is_ambiguity_current=is_current,
        findings=findings,
    )


def _read_cameras(path: Path, findings: list[Finding]) -> dict[int, CameraEntry]:
    faults: list[Finding] = []
    cameras = read_entries(path, ForeignCameraEntry, faults)
    modelled = {finding.image for finding in faults if finding.message.startswith("cam_model")} - {None}
    if modelled:
        what = f"{len(modelled)} images have a cam_model that is not supported"
        findings.append(Finding("schema", path, f"{what}; PinholePlane and OpenCV, with their parameters, are"))
    findings += [finding for finding in faults if finding.image not in modelled]
    return cameras


def _check_agreement(scene: SceneRecords) -> Iterator[Finding]:
    """Every image of scene_gt.json is in the other files, with as many instances of the same objects."""
    paths = scene.paths
    others: list[tuple[Path, Mapping[int, object]]] = [
        (paths.scene_camera, scene.camera),
        (paths.scene_gt_canonical, scene.canonical),
    ]
    if paths.scene_gt_info.exists():
        others.append((paths.scene_gt_info, scene.gt_info))
    for path, content in others:
        if scene.is_readable(path):
            for im_id in sorted(scene.gt.keys() - content.keys() - scene.malformed(path)):
                yield Finding("missing", path, "image is missing; scene_gt.json has it", im_id)
    if scene.is_readable(paths.scene_gt):
        for im_id in sorted(scene.canonical.keys() - scene.gt.keys() - scene.malformed(paths.scene_gt)):
            yield Finding("ids", paths.scene_gt_canonical, "has this image; scene_gt.json has not", im_id)
    yield from check_instances(scene)


# Pictures


@dataclass(frozen=True, eq=False)
class SceneFiles:
    """The pictures of a scene folder, whatever their format.

    Attributes:
        pictures: files of rgb/, gray/ and depth/ by folder and image; there may be several of an image.
        masks: files of mask/ and mask_visib/ by folder, image and instance.
        shape: rows and columns that most pictures have, by the first of each folder; None if none can be read.
        unchecked: names in the scene folder that BOP's layout of one sensor does not have.
    """

    pictures: Mapping[tuple[str, int], list[Path]]
    masks: Mapping[tuple[str, Place], list[Path]]
    shape: tuple[int, int] | None
    unchecked: frozenset[str]

    @classmethod
    def list(cls, scene: SceneRecords) -> SceneFiles:
        """List what there is, and open as much of it as it takes to know the size."""
        root = scene.paths.root
        pictures: dict[tuple[str, int], list[Path]] = {}
        masks: dict[tuple[str, Place], list[Path]] = {}
        unchecked = {path.name for path in root.iterdir() if path not in scene.json_files - {scene.paths.scene_gt_coco}}
        unchecked -= {*_PICTURES, *_MASKS}
        sizes: Counter[tuple[int, int]] = Counter()
        for folder in (*_PICTURES, *_MASKS):
            of_folder = 0
            for path in sorted((root / folder).iterdir()) if (root / folder).is_dir() else ():
                if (name := _IMAGE_NAME.fullmatch(path.name)) and folder in _PICTURES:
                    pictures.setdefault((folder, int(name[1])), []).append(path)
                elif (name := _MASK_NAME.fullmatch(path.name)) and folder in _MASKS:
                    masks.setdefault((folder, (int(name[1]), int(name[2]))), []).append(path)
                else:
                    unchecked.add(f"{folder}/{path.name}")
                    continue
                if of_folder < _ENOUGH_TO_KNOW_THE_SIZE and (size := _size(path)):
                    sizes[size] += 1
                    of_folder += 1
        shape = max(sizes, key=sizes.__getitem__) if sizes else None
        return cls(pictures, masks, shape, frozenset(unchecked))

    @property
    def image_ids(self) -> set[int]:
        """Images that have a file."""
        return {im_id for _, im_id in self.pictures} | {im_id for _, (im_id, _) in self.masks}

    def n_instances(self, im_id: int) -> int:
        """Of how many instances of an image there may be masks."""
        return 1 + max((gt_id for _, (of, gt_id) in self.masks if of == im_id), default=-1)

    def check_folders(self, scene: SceneRecords) -> Iterator[Finding]:
        """A folder of pictures has one for each image, a folder of masks one for each instance, and no other."""
        root = scene.paths.root
        instances = {(im_id, gt_id) for im_id, gt in scene.gt.items() for gt_id in range(len(gt))}
        for folder in _PICTURES:
            found = {im_id for of, im_id in self.pictures if of == folder}
            for im_id in sorted(scene.gt.keys() - found) if found else ():
                yield Finding("missing", root / folder, "has no file for it", im_id)
        unknown = scene.malformed(scene.paths.scene_gt)
        for folder in _MASKS:
            places = {place for of, place in self.masks if of == folder}
            for place in sorted(instances - places) if places else ():
                yield Finding("missing", root / folder, "has no file for it", *place)
            for place in sorted(places - instances) if scene.is_readable(scene.paths.scene_gt) else ():
                if place[0] not in unknown:
                    path = self.masks[folder, place][0]
                    yield Finding("stray", path, "belongs to no instance in scene_gt.json", *place)

    def read_mask(self, folder: str, place: Place, pictures: Pictures) -> Mask | None:
        """The first mask file of an instance that can be used; every one is opened."""
        read = [pictures.read(path, decode_mask, place[1]) for path in self.masks.get((folder, place), ())]
        return next((mask for mask in read if mask is not None), None)


def _check_image(scene: SceneRecords, files: SceneFiles, im_id: int) -> Iterator[Finding]:
    """Every picture can be read and has the size of the others; masks, counts and boxes fit each other."""
    pictures = Pictures(im_id, files.shape)
    scale = scene.camera[im_id].get("depth_scale", 1.0) if im_id in scene.camera else 1.0
    decoders: dict[str, Any] = {"rgb": decode_rgb, "gray": _decode_any, "depth": partial(_decode_depth, scale)}
    read = {
        folder: [pictures.read(path, decoder) for path in files.pictures.get((folder, im_id), ())]
        for folder, decoder in decoders.items()
    }
    gt, infos = scene.gt.get(im_id, []), scene.gt_info.get(im_id, [])
    masks = [
        InstanceMasks(*(files.read_mask(folder, (im_id, gt_id), pictures) for folder in _MASKS))
        for gt_id in range(max(len(gt), files.n_instances(im_id)))
    ]
    yield from pictures.findings
    masks = masks[: len(gt)]
    yield from check_masks(scene.paths, im_id, masks, exact=False)
    where_depth: Mask | None = None
    if not (scene.paths.root / "depth").exists() and files.shape is not None:
        where_depth = np.ones(files.shape, dtype=bool)
    elif read["depth"] and read["depth"][0] is not None:
        where_depth = read["depth"][0] > 0
    if len(infos) == len(masks):
        for gt_id, (info, of_instance) in enumerate(zip(infos, masks, strict=True)):
            for fault in check_info(info, of_instance, where_depth, files.shape, False, AS_RENDERED):
                yield Finding("gt_info", scene.paths.scene_gt_info, fault, im_id, gt_id)


def _size(path: Path) -> tuple[int, int] | None:
    """Rows and columns of a picture; None if it cannot be read."""
    try:
        data = read_bytes(path)
        shape = () if container_fault(data) else _decode_any(data, path).shape
    except ValueError:
        return None
    return (shape[0], shape[1]) if shape else None


def _decode_any(data: bytes, path: Path) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DamagedImageError(f"{path}: cannot be decoded, cut off or damaged")
    return image


def _decode_depth(scale: float, data: bytes, path: Path) -> NDArray[np.float64]:
    return decode_depth(data, scale, path)
