"""The JSON files of a scene folder: each against its schema, and all against each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from synthetless.dataset.layout import ImagePlan, ScenePaths
from synthetless.dataset.records import Entry, ImageSpec, read_scene_json
from synthetless.io.files import read_json, read_json_lines
from synthetless.validation.report import Finding, unusable
from synthetless.validation.schemas import (
    CameraEntry,
    CanonicalEntry,
    CocoAnnotation,
    CocoFile,
    CocoImage,
    GtEntry,
    GtInfoEntry,
    faults,
)

_CAMERA = TypeAdapter(CameraEntry)
_GT = TypeAdapter(list[GtEntry])
_GT_INFO = TypeAdapter(list[GtInfoEntry])
CANONICAL = TypeAdapter(list[CanonicalEntry])
_COCO, _COCO_IMAGE, _COCO_ANNOTATION = TypeAdapter(CocoFile), TypeAdapter(CocoImage), TypeAdapter(CocoAnnotation)
_SPEC = TypeAdapter(ImageSpec)


@dataclass(frozen=True, eq=False)
class SceneLabels:
    """What of a scene folder's JSON files has the right form, by image id.

    Attributes:
        paths: the files.
        camera, gt, gt_info, canonical: BOP's entries and the labels.
        coco: content of scene_gt_coco.json; None if it cannot be used. Images and annotations of the wrong form are
            left out.
        spec: the recorded images.
        findings: what has the wrong form.
    """

    paths: ScenePaths
    camera: dict[int, Entry] = field(default_factory=dict)
    gt: dict[int, list[Entry]] = field(default_factory=dict)
    gt_info: dict[int, list[Entry]] = field(default_factory=dict)
    canonical: dict[int, list[Entry]] = field(default_factory=dict)
    coco: Entry | None = None
    spec: dict[int, ImageSpec] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def read(cls, paths: ScenePaths) -> SceneLabels:
        """Read all of them; nothing is raised, what is wrong is in ``findings``."""
        findings: list[Finding] = []
        return cls(
            paths,
            read_entries(paths.scene_camera, _CAMERA, findings),
            read_entries(paths.scene_gt, _GT, findings),
            read_entries(paths.scene_gt_info, _GT_INFO, findings),
            read_entries(paths.scene_gt_canonical, CANONICAL, findings),
            _read_coco(paths.scene_gt_coco, findings),
            _read_spec(paths.scene_spec, findings),
            findings,
        )

    def is_readable(self, path: Path) -> bool:
        """Whether a file, as a whole, has the right form."""
        return not any(finding.file == path and finding.image is None for finding in self.findings)

    def malformed(self, path: Path) -> set[int | None]:
        """Images whose entries in a file have the wrong form."""
        return {finding.image for finding in self.findings if finding.file == path}

    @property
    def image_ids(self) -> list[int]:
        """Images with a camera, poses and as many entries in scene_gt_info.json."""
        return [
            im_id
            for im_id, gt in self.gt.items()
            if im_id in self.camera and len(self.gt_info.get(im_id, ())) == len(gt) and im_id in self.gt_info
        ]


def check_agreement(labels: SceneLabels, plans: Sequence[ImagePlan]) -> Iterator[Finding]:
    """Every planned image, and no other, is in every file, with as many instances of the same objects."""
    paths, planned = labels.paths, {plan.im_id for plan in plans}
    spec: Mapping[int, object] = labels.spec
    for path, content in (
        (paths.scene_camera, labels.camera),
        (paths.scene_gt, labels.gt),
        (paths.scene_gt_info, labels.gt_info),
        (paths.scene_gt_canonical, labels.canonical),
        (paths.scene_spec, spec),
    ):
        if not labels.is_readable(path):
            continue
        for im_id in sorted(planned - content.keys() - labels.malformed(path)):
            yield Finding("missing", path, "image is missing; the recipe asks for it", im_id)
        for im_id in sorted(content.keys() - planned):
            yield Finding("ids", path, f"has this image; the recipe asks for {_span(planned)} only", im_id)
    for path, lists in ((paths.scene_gt_info, labels.gt_info), (paths.scene_gt_canonical, labels.canonical)):
        for im_id in sorted(labels.gt.keys() & lists.keys()):
            yield from check_lists(path, im_id, labels.gt[im_id], lists[im_id])


def check_lists(path: Path, im_id: int, gt: list[Entry], others: list[Entry]) -> Iterator[Finding]:
    """As many instances of the same objects as in scene_gt.json."""
    if len(gt) != len(others):
        yield Finding("ids", path, f"has {len(others)} instances; scene_gt.json has {len(gt)}", im_id)
        return
    for gt_id, (pose, other) in enumerate(zip(gt, others, strict=True)):
        if other.get("obj_id", pose["obj_id"]) != pose["obj_id"]:
            yield Finding(
                "ids", path, f"is of object {other['obj_id']}; scene_gt.json has {pose['obj_id']}", im_id, gt_id
            )


def read_entries(path: Path, adapter: TypeAdapter[Any], findings: list[Finding]) -> dict[int, Any]:
    """A scene file's entries of the right form, by image id; ``findings`` gets what is wrong with the others."""
    try:
        content = read_scene_json(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return {}
    good = {}
    for im_id, entry in content.items():
        bad = [Finding("schema", path, fault.message, im_id, fault.instance) for fault in faults(adapter, entry)]
        findings += bad
        if not bad:
            good[im_id] = entry
    return good


def _read_coco(path: Path, findings: list[Finding]) -> Entry | None:
    try:
        content = read_json(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return None
    bad = [Finding("schema", path, fault.message) for fault in faults(_COCO, content)]
    findings += bad
    if bad:
        return None
    return {
        **content,
        "images": _good_items(path, "images", content["images"], _COCO_IMAGE, findings),
        "annotations": _good_items(path, "annotations", content["annotations"], _COCO_ANNOTATION, findings),
    }


def _good_items(
    path: Path, name: str, items: list[Any], adapter: TypeAdapter[Any], findings: list[Finding]
) -> list[Entry]:
    good = []
    for number, item in enumerate(items):
        bad = [f"{name}.{number}.{fault.message}" for fault in faults(adapter, item)]
        im_id = item.get("id" if name == "images" else "image_id") if isinstance(item, dict) else None
        findings += [Finding("schema", path, message, im_id if isinstance(im_id, int) else None) for message in bad]
        if not bad:
            good.append(item)
    return good


def _read_spec(path: Path, findings: list[Finding]) -> dict[int, ImageSpec]:
    try:
        lines = read_json_lines(path)
    except ValueError as error:
        findings.append(unusable(path, error))
        return {}
    recorded: dict[int, ImageSpec] = {}
    for number, line in enumerate(lines, start=1):
        im_id = line.get("image_id") if isinstance(line, dict) else None
        place = im_id if isinstance(im_id, int) else None
        bad = [Finding("schema", path, f"line {number}: {fault.message}", place) for fault in faults(_SPEC, line)]
        findings += bad
        if not bad:
            image = _SPEC.validate_python(line)
            if image.image_id in recorded:
                findings.append(Finding("ids", path, f"line {number} records it a second time", image.image_id))
            recorded[image.image_id] = image
    return recorded


def _span(ids: set[int]) -> str:
    return f"{min(ids)}..{max(ids)}" if ids else "none"
