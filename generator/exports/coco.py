"""COCO: one JSON file for a whole split, which pycocotools, torchvision and FiftyOne load as it is.

Every annotation names its instance (``gt_id``) and carries the true pose, the canonical pose and the regressor index;
its keypoints are the 8 projected box corners of the canonical pose, the targets of Pitteri et al. (3DV 2019).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

from pycocotools import mask as coco_mask
from tqdm import tqdm

from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import ScenePaths, find_split, scene_ids
from synthetless.dataset.reader import ImageEntries, read_entries
from synthetless.dataset.records import Entry
from synthetless.errors import UserError
from synthetless.io.files import atomic_file, read_json

BoxKind = Literal["visible", "amodal"]

CORNER_NAMES = [f"x{'-+'[i >> 2 & 1]}y{'-+'[i >> 1 & 1]}z{'-+'[i & 1]}" for i in range(8)]
BOX_EDGES = [[i + 1, i + step + 1] for i in range(8) for step in (1, 2, 4) if not i & step]
"""The box's 12 edges as pairs of keypoint numbers, which COCO counts from 1."""

_IN_IMAGE, _OUTSIDE = 2, 1
"""COCO's visibility flags: a corner outside the image is labelled, but cannot be seen."""


def export_coco(dataset: Path, to: Path, split: str | None = None, boxes: BoxKind = "visible") -> int:
    """Write a split as one COCO file; images stay where they are and are named relative to it.

    Images are numbered from 1 through all scenes, annotations likewise. Instances of which nothing is visible are
    left out, as in scene_gt_coco.json. No image is decoded.

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json in its scenes.
        to: the JSON file to write; replaced if it exists.
        split: folder name; the only one if None.
        boxes: of the visible part, or of the whole silhouette inside the image.

    Returns:
        The number of images.

    Raises:
        UserError: the dataset is incomplete or contradicts itself, or the file cannot be written.
    """
    refuse_half_labelled(dataset)
    split = split or find_split(dataset)
    licence = _licence(dataset)
    categories: dict[int, Entry] = {}
    images: list[str] = []
    annotations: list[str] = []
    for scene_id in tqdm(scene_ids(dataset, split), desc="COCO", unit="scene", disable=None):
        scene = ScenePaths.of(dataset, scene_id, split)
        coco = read_json(scene.scene_gt_coco)
        categories |= {category["id"]: _with_corners(category) for category in coco["categories"]}
        for labels, image, visible in _by_image(scene, coco):
            image_id = len(images) + 1
            images.append(json.dumps(_image(image, image_id, scene_id, scene, labels, to, licence is not None)))
            for annotation in _annotations(labels, image, visible, boxes):
                numbers = {"id": len(annotations) + 1, "image_id": image_id}
                annotations.append(json.dumps(numbers | annotation))
    head = {
        "info": {"description": f"{dataset.resolve().name} {split}", "version": "1.0"},
        "licenses": [] if licence is None else [{"id": 1, "name": licence, "url": ""}],
        "categories": [categories[obj_id] for obj_id in sorted(categories)],
    }
    with atomic_file(to, durable=True) as file:
        file.writelines(part.encode() for part in _json_parts(head, {"images": images, "annotations": annotations}))
    return len(images)


def compressed_rle(segmentation: Entry) -> Entry:
    """COCO's compressed run lengths, as text, of a segmentation in either form; by pycocotools."""
    if isinstance(segmentation["counts"], str):
        return segmentation
    rle = coco_mask.frPyObjects(segmentation, *segmentation["size"])
    return {"counts": rle["counts"].decode("ascii"), "size": [int(side) for side in rle["size"]]}


def _by_image(scene: ScenePaths, coco: Entry) -> Iterator[tuple[ImageEntries, Entry, list[tuple[int, Entry]]]]:
    """Each image's labels, its entry in scene_gt_coco.json, and gt_id and annotation of its visible instances.

    BOP's annotations do not say which instance they belong to: they are in scene_gt's order, less the hidden ones.
    """
    images = {image["id"]: image for image in coco["images"]}
    annotations: dict[int, list[Entry]] = {im_id: [] for im_id in images}
    for annotation in coco["annotations"]:
        annotations[annotation["image_id"]].append(annotation)
    for labels in read_entries(scene):
        visible = [gt_id for gt_id, info in enumerate(labels.gt_info) if info["px_count_visib"] > 0]
        found = annotations.get(labels.im_id, [])
        if labels.im_id not in images or [a["category_id"] for a in found] != [
            labels.gt[gt_id]["obj_id"] for gt_id in visible
        ]:
            raise UserError(
                f"{scene.scene_gt_coco}: image {labels.im_id} does not list the {len(visible)} visible instances "
                "of scene_gt.json in their order"
            )
        yield labels, images[labels.im_id], list(zip(visible, found, strict=True))


def _image(
    image: Entry, image_id: int, scene_id: int, scene: ScenePaths, labels: ImageEntries, to: Path, licensed: bool
) -> Entry:
    path = os.path.relpath(scene.root / image["file_name"], to.parent)
    return {
        "id": image_id,
        "file_name": Path(path).as_posix(),
        "width": image["width"],
        "height": image["height"],
        "scene_id": scene_id,
        "im_id": labels.im_id,
        "cam_K": labels.camera["cam_K"],
    } | ({"license": 1} if licensed else {})


def _annotations(
    labels: ImageEntries, image: Entry, visible: Iterable[tuple[int, Entry]], boxes: BoxKind
) -> Iterator[Entry]:
    for gt_id, annotation in visible:
        label = labels.gt_canonical[gt_id]
        corners = label["bbox3d_corners_2d"]
        canonical = {key: value for key, value in label.items() if key not in ("obj_id", "bbox3d_corners_2d")}
        rle = compressed_rle(annotation["segmentation"])
        yield {
            "category_id": annotation["category_id"],
            "iscrowd": 0,
            "ignore": annotation["ignore"],
            "area": annotation["area"],
            "bbox": annotation["bbox"] if boxes == "amodal" else [int(side) for side in coco_mask.toBbox(rle)],
            "segmentation": rle,
            "keypoints": _keypoints(corners, image["width"], image["height"]),
            "num_keypoints": len(corners),
            "gt_id": gt_id,
            "visib_fract": labels.gt_info[gt_id]["visib_fract"],
            "cam_R_m2c": labels.gt[gt_id]["cam_R_m2c"],
            "cam_t_m2c": labels.gt[gt_id]["cam_t_m2c"],
            **canonical,
        }


def _keypoints(corners: list[list[float]], width: int, height: int) -> list[float]:
    """COCO's flat [u, v, flag, ...]; pixel (i, j) is centred at (i, j), so the image begins at -0.5."""
    flat: list[float] = []
    for u, v in corners:
        inside = -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5
        flat += [u, v, _IN_IMAGE if inside else _OUTSIDE]
    return flat


def _with_corners(category: Entry) -> Entry:
    return {**category, "keypoints": CORNER_NAMES, "skeleton": BOX_EDGES}


def _licence(dataset: Path) -> str | None:
    """What dataset.json says of the models' licence, if anything."""
    path = dataset / "dataset.json"
    return (read_json(path).get("licence") or None) if path.exists() else None


def _json_parts(head: dict[str, Any], lists: dict[str, list[str]]) -> Iterator[str]:
    """A JSON object of ``head`` and of lists whose items are JSON already, one item per line."""
    yield "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    for key, items in lists.items():
        yield f",\n{json.dumps(key)}: ["
        for number, item in enumerate(items):
            yield f"{',' if number else ''}\n{item}"
        yield "\n]"
    yield "\n}\n"
