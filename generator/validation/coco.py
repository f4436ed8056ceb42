"""scene_gt_coco.json against scene_gt.json, scene_gt_info.json and the masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from pycocotools import mask as coco_mask

from synthetless.dataset.records import MIN_VISIB_FRACT, Entry, uncompressed_rle
from synthetless.validation.labels import SceneLabels
from synthetless.validation.masks import InstanceMasks
from synthetless.validation.regions import Mask, Region
from synthetless.validation.report import Finding
from synthetless.validation.source import Source


@dataclass(frozen=True, eq=False)
class SceneAnnotations:
    """The annotations of a scene folder, matched with its instances.

    Attributes:
        by_image: by image id and gt_id; BOP's annotations do not name their instance, they follow scene_gt's order.
        findings: what does not match.
    """

    by_image: Mapping[int, Mapping[int, Entry]] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


def match_annotations(source: Source, labels: SceneLabels) -> SceneAnnotations:
    """Check categories, images and numbering, and find each annotation's instance."""
    if labels.coco is None:
        return SceneAnnotations()
    findings = [*_check_categories(source, labels), *_check_images(source, labels), *_check_numbers(labels)]
    lists: dict[int, list[Entry]] = {}
    for annotation in labels.coco["annotations"]:
        lists.setdefault(annotation["image_id"], []).append(annotation)
    by_image: dict[int, Mapping[int, Entry]] = {}
    for im_id in labels.image_ids:
        shown = [gt_id for gt_id, info in enumerate(labels.gt_info[im_id]) if info["px_count_visib"] > 0]
        found = lists.get(im_id, [])
        if len(shown) != len(found):
            message = f"has {len(found)} annotations; scene_gt_info.json has {len(shown)} visible instances"
            findings.append(Finding("coco", labels.paths.scene_gt_coco, message, im_id))
        else:
            by_image[im_id] = dict(zip(shown, found, strict=True))
    return SceneAnnotations(by_image, tuple(findings))


def decode(annotation: Entry, shape: tuple[int, int]) -> Mask | None:
    """The mask of an annotation; None if its run lengths do not fill the image."""
    rle = annotation["segmentation"]
    if tuple(rle["size"]) != shape or sum(rle["counts"]) != shape[0] * shape[1]:
        return None
    decoded: Mask = coco_mask.decode(coco_mask.frPyObjects(rle, *shape)).astype(bool)
    return decoded


def check_annotation(
    labels: SceneLabels, im_id: int, gt_id: int, annotation: Entry, masks: InstanceMasks, shape: tuple[int, int]
) -> Iterator[Finding]:
    """One annotation against its instance.

    Args:
        labels: of its scene folder.
        im_id, gt_id: its image and instance.
        annotation: as in scene_gt_coco.json.
        masks: the instance's mask files, as far as there are any.
        shape: rows and columns of the image.
    """
    info, obj_id = labels.gt_info[im_id][gt_id], labels.gt[im_id][gt_id]["obj_id"]
    expected = {
        "category_id": obj_id,
        "area": info["px_count_visib"],
        "ignore": info["visib_fract"] < MIN_VISIB_FRACT,
        "iscrowd": 0,
        "height": shape[0],
        "width": shape[1],
    }
    if masks.whole is not None and masks.whole.count:
        x, y, w, h = masks.whole.box
        expected["bbox"] = [x, y, w + 1, h + 1]
    faults = [
        f"{name} is {annotation[name]}; {value} is expected"
        for name, value in expected.items()
        if annotation[name] != value
    ]
    faults += _check_segmentation(annotation, info, masks.visible, shape)
    yield from (Finding("coco", labels.paths.scene_gt_coco, fault, im_id, gt_id) for fault in faults)


def _check_segmentation(
    annotation: Entry, info: Entry, visible: Region | None, shape: tuple[int, int]
) -> Iterator[str]:
    rle = annotation["segmentation"]
    if visible is not None and rle == uncompressed_rle(visible.pixels):
        return
    mask = decode(annotation, shape)
    if mask is None:
        yield f"its run lengths do not fill an image of {list(shape)}, but {sum(rle['counts'])} pixels of {rle['size']}"
    elif visible is not None and (mask != visible.pixels).any():
        yield f"its segmentation differs from mask_visib/ in {np.count_nonzero(mask != visible.pixels)} pixels"
    elif np.count_nonzero(mask) != info["px_count_visib"]:
        yield f"its segmentation has {np.count_nonzero(mask)} pixels; {info['px_count_visib']} are visible"


def _check_categories(source: Source, labels: SceneLabels) -> Iterator[Finding]:
    found = [category["id"] for category in (labels.coco or {})["categories"]]
    if found != sorted(source.infos):
        message = f"has the categories {found}; models_info.json has the objects {sorted(source.infos)}"
        yield Finding("coco", labels.paths.scene_gt_coco, message)


def _check_images(source: Source, labels: SceneLabels) -> Iterator[Finding]:
    camera, path = source.recipe.camera, labels.paths.scene_gt_coco
    images = (labels.coco or {})["images"]
    counts = Counter(image["id"] for image in images)
    for im_id in sorted(counts.keys() ^ labels.gt.keys()):
        message = "is listed, but not in scene_gt.json" if im_id in counts else "is not listed; scene_gt.json has it"
        yield Finding("coco", path, message, im_id)
    for im_id in sorted(im_id for im_id, count in counts.items() if count > 1):
        yield Finding("ids", path, f"is listed {counts[im_id]} times", im_id)
    for image in images:
        rgb = labels.paths.rgb(image["id"], source.recipe.encoding.rgb_format)
        expected = {"file_name": f"rgb/{rgb.name}", "width": camera.width, "height": camera.height}
        for name, value in expected.items():
            if image[name] != value:
                yield Finding("coco", path, f"{name} is {image[name]}; {value} is expected", image["id"])


def _check_numbers(labels: SceneLabels) -> Iterator[Finding]:
    path, annotations = labels.paths.scene_gt_coco, (labels.coco or {})["annotations"]
    counts = Counter(annotation["id"] for annotation in annotations)
    for annotation in annotations:
        if counts[annotation["id"]] > 1:
            message = f"annotation id {annotation['id']} occurs {counts[annotation['id']]} times; ids are unique"
            yield Finding("ids", path, message, annotation["image_id"])
    for im_id in sorted({annotation["image_id"] for annotation in annotations} - labels.gt.keys()):
        yield Finding("coco", path, "has annotations of this image, which scene_gt.json does not have", im_id)
