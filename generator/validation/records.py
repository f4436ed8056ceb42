"""The JSON files of a scene folder: each against its schema, and all against the plan, the records and each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.layout import RECORDS_FOLDER, ImagePlan, ScenePaths
from synthetless.dataset.records import (
    CameraEntry,
    CanonicalEntry,
    CocoAnnotation,
    CocoFile,
    GtEntry,
    GtInfoEntry,
    ImageSpec,
    coco_image,
    read_scene_json,
    schema,
    schema_faults,
)
from synthetless.dataset.store import DatasetStore
from synthetless.io.files import read_json, read_json_lines
from synthetless.validation.report import Finding, unusable

Place = tuple[int, int]
"""Image and instance."""

ROTATION_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class SceneRecords:
    """What of a scene folder's JSON files has the right form, by image id.

    Attributes:
        paths: the files.
        camera, gt, gt_info, canonical: BOP's entries and the labels.
        coco: content of scene_gt_coco.json; None if it cannot be used. Images and annotations of the wrong form are
            left out.
        spec: the recorded images.
        spec_json: the same as JSON data.
        findings: what has the wrong form.
    """

    paths: ScenePaths
    camera: dict[int, CameraEntry] = field(default_factory=dict)
    gt: dict[int, list[GtEntry]] = field(default_factory=dict)
    gt_info: dict[int, list[GtInfoEntry]] = field(default_factory=dict)
    canonical: dict[int, list[CanonicalEntry]] = field(default_factory=dict)
    coco: CocoFile | None = None
    spec: dict[int, ImageSpec] = field(default_factory=dict)
    spec_json: dict[int, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def read(cls, paths: ScenePaths) -> SceneRecords:
        """Read all of them; nothing is raised, what is wrong is in ``findings``."""
        findings: list[Finding] = []
        spec_json: dict[int, Any] = {}
        return cls(
            paths,
            read_entries(paths.scene_camera, CameraEntry, findings),
            read_entries(paths.scene_gt, list[GtEntry], findings),
            read_entries(paths.scene_gt_info, list[GtInfoEntry], findings),
            read_entries(paths.scene_gt_canonical, list[CanonicalEntry], findings),
            _read_coco(paths.scene_gt_coco, findings),
            _read_spec(paths.scene_spec, spec_json, findings),
            spec_json,
            findings,
        )

    @property
    def json_files(self) -> set[Path]:
        """Every JSON file of a scene folder."""
        p = self.paths
        return {p.scene_camera, p.scene_gt, p.scene_gt_info, p.scene_gt_coco, p.scene_gt_canonical, p.scene_spec}

    def is_readable(self, path: Path) -> bool:
        """Whether a file, as a whole, has the right form."""
        return not any(finding.file == path and finding.image is None for finding in self.findings)

    def malformed(self, path: Path) -> set[int | None]:
        """Images whose entries in a file have the wrong form."""
        return {finding.image for finding in self.findings if finding.file == path}

    @property
    def image_ids(self) -> list[int]:
        """Images that are complete."""
        return [im_id for im_id in self.gt if self.is_complete(im_id)]

    def is_complete(self, im_id: int) -> bool:
        """Whether an image has a camera, poses and as many entries in scene_gt_info.json."""
        together = im_id in self.gt and im_id in self.camera and im_id in self.gt_info
        return together and len(self.gt_info[im_id]) == len(self.gt[im_id])


def read_entries(path: Path, form: Any, findings: list[Finding]) -> dict[int, Any]:
    """A scene file's entries of this form, by image id; ``findings`` gets what is wrong with the others."""
    try:
        content = read_scene_json(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return {}
    good = {}
    for im_id, entry in content.items():
        faults = schema_faults(form, entry)
        findings += [Finding("schema", path, fault.message, im_id, fault.instance) for fault in faults]
        if not faults:
            good[im_id] = entry
    return good


def _read_coco(path: Path, findings: list[Finding]) -> CocoFile | None:
    try:
        content = read_json(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return None
    bad: dict[str, set[int | str]] = {"annotations": set(), "images": set()}
    usable = True
    for fault in schema_faults(CocoFile, content):
        im_id = None
        if len(fault.place) > 1 and fault.place[0] in bad and isinstance(fault.place[1], int):
            name, number = str(fault.place[0]), fault.place[1]
            bad[name].add(number)
            im_id = _image_of(content[name][number], "id" if name == "images" else "image_id")
        else:
            usable = False
        findings.append(Finding("schema", path, fault.message, im_id))
    good = {
        name: [item for number, item in enumerate(content[name]) if number not in bad[name]] for name in bad if usable
    }
    return cast(CocoFile, {**content, **good}) if usable else None


def _read_spec(path: Path, spec_json: dict[int, Any], findings: list[Finding]) -> dict[int, ImageSpec]:
    try:
        lines = read_json_lines(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return {}
    recorded: dict[int, ImageSpec] = {}
    for number, line in enumerate(lines, start=1):
        place, faults = _image_of(line, "image_id"), schema_faults(ImageSpec, line)
        findings += [Finding("schema", path, f"line {number}: {fault.message}", place) for fault in faults]
        if not faults:
            image: ImageSpec = schema(ImageSpec).validate_python(line)
            if image.image_id in recorded:
                findings.append(Finding("ids", path, f"line {number} records it a second time", image.image_id))
            recorded[image.image_id], spec_json[image.image_id] = image, line
    return recorded


def _image_of(item: Any, key: str) -> int | None:
    im_id = item.get(key) if isinstance(item, dict) else None
    return im_id if isinstance(im_id, int) else None


# All files about the same images and instances


def check_agreement(scene: SceneRecords, plans: Sequence[ImagePlan]) -> Iterator[Finding]:
    """Every planned image, and no other, is in every file, with as many instances of the same objects."""
    paths, planned = scene.paths, {plan.im_id for plan in plans}
    files: list[tuple[Path, Mapping[int, object]]] = [
        (paths.scene_camera, scene.camera),
        (paths.scene_gt, scene.gt),
        (paths.scene_gt_info, scene.gt_info),
        (paths.scene_gt_canonical, scene.canonical),
        (paths.scene_spec, scene.spec),
    ]
    for path, content in files:
        if scene.is_readable(path):
            for im_id in sorted(planned - content.keys() - scene.malformed(path)):
                yield Finding("missing", path, "image is missing; the recipe asks for it", im_id)
            for im_id in sorted(content.keys() - planned):
                yield Finding("ids", path, f"has this image; the recipe asks for {_span(planned)} only", im_id)
    yield from check_instances(scene)


def check_instances(scene: SceneRecords) -> Iterator[Finding]:
    """As many instances of the same objects as in scene_gt.json."""
    lists: list[tuple[Path, Mapping[int, Sequence[Any]]]] = [
        (scene.paths.scene_gt_info, scene.gt_info),
        (scene.paths.scene_gt_canonical, scene.canonical),
    ]
    for path, content in lists:
        for im_id in sorted(scene.gt.keys() & content.keys()):
            gt, others = scene.gt[im_id], content[im_id]
            if len(gt) != len(others):
                message = f"has {len(others)} instances; scene_gt.json has {len(gt)}"
                yield Finding("ids", path, message, im_id)
                continue
            for gt_id, (pose, other) in enumerate(zip(gt, others, strict=True)):
                if other.get("obj_id", pose["obj_id"]) != pose["obj_id"]:
                    message = f"is of object {other['obj_id']}; scene_gt.json has {pose['obj_id']}"
                    yield Finding("ids", path, message, im_id, gt_id)


def check_stored(store: DatasetStore, scene_id: int, scene: SceneRecords, planned: set[int]) -> Iterator[Finding]:
    """Every image has a record that says what the JSON files say, or else the dataset cannot be extended.

    A copy without any records is a whole dataset, too: it just cannot be continued.
    """
    if not (store.root / RECORDS_FOLDER).is_dir():
        return
    paths = scene.paths
    annotations: dict[int, list[CocoAnnotation]] = {im_id: [] for im_id in scene.gt}
    for annotation in scene.coco["annotations"] if scene.coco else ():
        without_id = {key: value for key, value in annotation.items() if key != "id"}
        annotations.setdefault(annotation["image_id"], []).append(cast(CocoAnnotation, without_id))
    files: list[tuple[str, Path, Mapping[int, object]]] = [
        ("camera", paths.scene_camera, scene.camera),
        ("gt", paths.scene_gt, scene.gt),
        ("gt_info", paths.scene_gt_info, scene.gt_info),
        ("spec", paths.scene_spec, scene.spec_json),
        ("coco", paths.scene_gt_coco, annotations if scene.coco else {}),
    ]
    for im_id in scene.image_ids:
        path = store.record(scene_id, im_id)
        try:
            record = read_json(path)
        except ValueError as error:
            yield replace(unusable(path, error), image=im_id)
            continue
        for key, file, entries in files:
            if im_id in entries and record.get(key) != entries[im_id]:
                message = f"{key} is not what {file.name} has, which was assembled from it: one of them was changed"
                yield Finding("record", path, message, im_id)
    folder, names = store.record(scene_id, 0).parent, {store.record(scene_id, im_id).name for im_id in planned}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.name not in names:
            yield Finding("stray", path, "is the record of no image that the recipe asks for; move it away")


# Poses


def check_poses(
    obj_ids: Collection[int], scene: SceneRecords, tolerance: float = ROTATION_TOLERANCE
) -> tuple[set[Place], list[Finding]]:
    """Rotations are rotations, objects are in front of the camera and known.

    Args:
        obj_ids: of models_info.json.
        scene: of a scene folder.
        tolerance: by how much R R^T and det R may be off.

    Returns:
        The valid poses, and what is wrong with the others.
    """
    places = [(im_id, gt_id) for im_id, gt in scene.gt.items() for gt_id in range(len(gt))]
    entries = [scene.gt[im_id][gt_id] for im_id, gt_id in places]
    R = np.array([entry["cam_R_m2c"] for entry in entries], dtype=np.float64).reshape(-1, 3, 3)
    findings: list[Finding] = []
    valid: set[Place] = set()
    for place, entry, error in zip(places, entries, rotation_error(R), strict=True):
        faults = []
        if not error <= tolerance:
            faults.append(f"cam_R_m2c is no rotation: off by {error:.3g}; {tolerance:g} is allowed")
        if not entry["cam_t_m2c"][2] > 0:
            faults.append(f"cam_t_m2c has z = {entry['cam_t_m2c'][2]} mm; objects are in front of the camera")
        if entry["obj_id"] not in obj_ids:
            faults.append(f"obj_id {entry['obj_id']} is not in models_info.json")
        findings += [Finding("pose", scene.paths.scene_gt, fault, *place) for fault in faults]
        if not faults:
            valid.add(place)
    return valid, findings


def rotation_error(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) largest deviation of matrices (N, 3, 3) from being rotations: from R R^T = I and from det R = 1."""
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        return np.asarray(np.maximum(deviation, np.abs(np.linalg.det(R) - 1.0)))


# scene_gt_coco.json


def match_annotations(
    obj_ids: Collection[int], size: tuple[int, int], extension: str, scene: SceneRecords
) -> tuple[dict[int, dict[int, CocoAnnotation]], list[Finding]]:
    """Check categories, images and numbering, and find each annotation's instance.

    Args:
        obj_ids: of models_info.json.
        size: columns and rows of the images.
        extension: of the colour images.
        scene: of a scene folder.

    Returns:
        The annotations by image id and gt_id (BOP's annotations do not name their instance, they follow scene_gt's
        order), and what does not match.
    """
    by_image: dict[int, dict[int, CocoAnnotation]] = {}
    if scene.coco is None:
        return by_image, []
    path, annotations = scene.paths.scene_gt_coco, scene.coco["annotations"]
    findings = [*_check_images(scene, scene.coco, size, extension), *_check_numbers(scene, scene.coco)]
    categories = [category["id"] for category in scene.coco["categories"]]
    if categories != sorted(obj_ids):
        message = f"has the categories {categories}; models_info.json has the objects {sorted(obj_ids)}"
        findings.insert(0, Finding("coco", path, message))
    lists: dict[int, list[CocoAnnotation]] = {}
    for annotation in annotations:
        lists.setdefault(annotation["image_id"], []).append(annotation)
    for im_id in scene.image_ids:
        shown = [gt_id for gt_id, info in enumerate(scene.gt_info[im_id]) if info["px_count_visib"] > 0]
        found = lists.get(im_id, [])
        if len(shown) != len(found):
            message = f"has {len(found)} annotations; scene_gt_info.json has {len(shown)} visible instances"
            findings.append(Finding("coco", path, message, im_id))
        else:
            by_image[im_id] = dict(zip(shown, found, strict=True))
    return by_image, findings


def _check_images(scene: SceneRecords, coco: CocoFile, size: tuple[int, int], extension: str) -> Iterator[Finding]:
    path, counts = scene.paths.scene_gt_coco, Counter(image["id"] for image in coco["images"])
    for im_id in sorted(counts.keys() ^ scene.gt.keys()):
        message = "is listed, but not in scene_gt.json" if im_id in counts else "is not listed; scene_gt.json has it"
        yield Finding("coco", path, message, im_id)
    for im_id in sorted(im_id for im_id, count in counts.items() if count > 1):
        yield Finding("ids", path, f"is listed {counts[im_id]} times", im_id)
    for image in coco["images"]:
        expected = coco_image(image["id"], scene.paths.rgb(image["id"], extension), *size)
        found: Mapping[str, object] = image
        for name, value in expected.items():
            if found[name] != value:
                yield Finding("coco", path, f"{name} is {found[name]}; {value} is expected", image["id"])


def _check_numbers(scene: SceneRecords, coco: CocoFile) -> Iterator[Finding]:
    path, annotations = scene.paths.scene_gt_coco, coco["annotations"]
    counts = Counter(annotation["id"] for annotation in annotations)
    for annotation in annotations:
        if counts[annotation["id"]] > 1:
            message = f"annotation id {annotation['id']} occurs {counts[annotation['id']]} times; ids are unique"
            yield Finding("ids", path, message, annotation["image_id"])
    for im_id in sorted({annotation["image_id"] for annotation in annotations} - scene.gt.keys()):
        yield Finding("coco", path, "has annotations of this image, which scene_gt.json does not have", im_id)


def _span(ids: set[int]) -> str:
    return f"{min(ids)}..{max(ids)}" if ids else "none"
