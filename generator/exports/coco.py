"""COCO: one JSON file for a whole split, which pycocotools, torchvision and FiftyOne load as it is.

Every annotation names its instance (``gt_id``) and carries the true pose, the canonical pose and the regressor index;
its keypoints are the 8 projected box corners of the canonical pose, the targets of Pitteri et al. (3DV 2019).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

from pycocotools import mask as coco_mask
from pydantic import ConfigDict, Field, with_config
from tqdm import tqdm
from typing_extensions import TypedDict

from synthetless.dataset.labels import BOX_EDGES, refuse_half_labelled
from synthetless.dataset.layout import DATASET_FILE, ScenePaths, find_split, refuse_target, scene_ids
from synthetless.dataset.reader import ImageEntries, read_entries
from synthetless.dataset.records import Count, validated
from synthetless.errors import UserError
from synthetless.io.files import atomic_file, read_json, remove_drafts

BoxKind = Literal["visible", "amodal"]

_OPEN = ConfigDict(extra="ignore", strict=True)
_Side = Annotated[int, Field(ge=1, le=2**20)]
_Run = Annotated[int, Field(ge=0, le=2**31)]


@with_config(_OPEN)
class _Segmentation(TypedDict):
    """Run lengths of a mask, plain or as pycocotools compresses them; ``size`` is [rows, columns]."""

    counts: list[_Run] | str
    size: Annotated[list[_Side], Field(min_length=2, max_length=2)]


@with_config(_OPEN)
class _SceneImage(TypedDict):
    """An image in a scene folder's scene_gt_coco.json; BOP's scripts write more."""

    id: Count
    file_name: str
    width: _Side
    height: _Side


@with_config(_OPEN)
class _SceneAnnotation(TypedDict):
    """A visible instance in it."""

    image_id: Count
    category_id: Count
    area: Count
    bbox: Annotated[list[float], Field(min_length=4, max_length=4)]
    segmentation: _Segmentation
    ignore: bool


@with_config(_OPEN)
class _SceneCategory(TypedDict):
    """An object in it."""

    id: Count


@with_config(_OPEN)
class _SceneFile(TypedDict):
    """What is needed of scene_gt_coco.json."""

    images: list[_SceneImage]
    annotations: list[_SceneAnnotation]
    categories: list[_SceneCategory]


class ExportedImage(TypedDict):
    """An image in the file of the whole split: what COCO asks for, and which image of the dataset it is."""

    id: int
    file_name: str
    width: int
    height: int
    scene_id: int
    im_id: int
    cam_K: list[float]
    license: NotRequired[int]


class ExportedAnnotation(TypedDict):
    """A visible instance in it: what COCO asks for, which instance it is, its true pose and its label."""

    id: int
    image_id: int
    category_id: int
    iscrowd: int
    ignore: bool
    area: int
    bbox: list[float]
    segmentation: _Segmentation
    keypoints: list[float]
    num_keypoints: int
    gt_id: int
    visib_fract: float
    cam_R_m2c: list[float]
    cam_t_m2c: list[float]
    cam_R_m2c_canonical: list[float]
    cam_t_m2c_canonical: list[float]
    discontinuity_margin_deg: float
    n_regressors: int
    regressor_index: int


_CORNER_NAMES = [f"x{'-+'[i >> 2 & 1]}y{'-+'[i >> 1 & 1]}z{'-+'[i & 1]}" for i in range(8)]
_SKELETON = [[a + 1, b + 1] for a, b in BOX_EDGES]
"""The box's edges as pairs of keypoint numbers, which COCO counts from 1."""

_IN_IMAGE, _OUTSIDE = 2, 1
"""COCO's visibility flags: a corner outside the image is labelled, but cannot be seen."""
_BEGINNING = re.compile(rb'\{\n"info": \{"description": ".*", "version": "1\.0"\},\n"licenses": \[')
"""How every file of ``export_coco`` begins."""


def export_coco(dataset: Path, to: Path, split: str | None = None, boxes: BoxKind = "visible") -> int:
    """Write a split as one COCO file; images stay where they are and are named relative to it.

    Images are numbered from 1 through all scenes, annotations likewise. Instances of which nothing is visible are
    left out, as in scene_gt_coco.json. No image is decoded.

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json in its scenes.
        to: the JSON file to write; one that an earlier export wrote is replaced.
        split: folder name; the only one if None.
        boxes: of the visible part, or of the whole silhouette inside the image.

    Returns:
        The number of images.

    Raises:
        UserError: the dataset is incomplete or contradicts itself, or the file belongs to it, is something else than
            an export, or cannot be written.
    """
    refuse_half_labelled(dataset)
    split = split or find_split(dataset)
    refuse_target(dataset, to)
    _refuse_others(to)
    to = to.resolve()
    licence = _licence(dataset)
    categories: dict[int, Any] = {}
    images: list[str] = []
    annotations: list[str] = []
    for scene_id in tqdm(scene_ids(dataset, split), desc="COCO", unit="scene", disable=None):
        scene = ScenePaths.of(dataset, scene_id, split)
        coco: Any = read_json(scene.scene_gt_coco)  # as it stands there: categories may say more than is asked for
        validated(_SceneFile, coco, scene.scene_gt_coco)
        categories |= {category["id"]: _with_corners(category) for category in coco["categories"]}
        for labels, image, visible in _by_image(scene, coco):
            image_id = len(images) + 1
            exported = _image(image, image_id, scene_id, scene, labels, to)
            images.append(json.dumps(exported if licence is None else exported | {"license": 1}))
            for gt_id, annotation in visible:
                number = len(annotations) + 1
                annotations.append(json.dumps(_annotation(number, image_id, image, labels, gt_id, annotation, boxes)))
    head = {
        "info": {"description": f"{dataset.resolve().name} {split}", "version": "1.0"},
        "licenses": [] if licence is None else [{"id": 1, "name": licence, "url": ""}],
        "categories": [categories[obj_id] for obj_id in sorted(categories)],
    }
    remove_drafts(to.parent, to.name)
    with atomic_file(to, durable=True) as file:
        file.writelines(part.encode() for part in _json_parts(head, {"images": images, "annotations": annotations}))
    return len(images)


def _refuse_others(to: Path) -> None:
    """Keep an export from replacing anything but a former one."""
    if not to.exists():
        return
    if to.is_file():
        with to.open("rb") as file:
            if _BEGINNING.match(file.read(4096)):
                return
    raise UserError(f"{to}: exists already and is not a COCO export; give a new name")


def _by_image(
    scene: ScenePaths, coco: _SceneFile
) -> Iterator[tuple[ImageEntries, _SceneImage, list[tuple[int, _SceneAnnotation]]]]:
    """Each image's labels, its entry in scene_gt_coco.json, and gt_id and annotation of its visible instances.

    BOP's annotations do not say which instance they belong to: they are in scene_gt's order, less the hidden ones.
    """
    images = {image["id"]: image for image in coco["images"]}
    annotations: dict[int, list[_SceneAnnotation]] = {im_id: [] for im_id in images}
    for annotation in coco["annotations"]:
        if annotation["image_id"] not in images:
            raise UserError(f"{scene.scene_gt_coco}: annotates image {annotation['image_id']}, which it does not list")
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
    image: _SceneImage, image_id: int, scene_id: int, scene: ScenePaths, labels: ImageEntries, to: Path
) -> ExportedImage:
    path = os.path.relpath(scene.root / image["file_name"], to.parent)
    return {
        "id": image_id,
        "file_name": Path(path).as_posix(),
        "width": image["width"],
        "height": image["height"],
        "scene_id": scene_id,
        "im_id": labels.im_id,
        "cam_K": labels.camera["cam_K"],
    }


def _annotation(
    number: int,
    image_id: int,
    image: _SceneImage,
    labels: ImageEntries,
    gt_id: int,
    annotation: _SceneAnnotation,
    boxes: BoxKind,
) -> ExportedAnnotation:
    gt, label = labels.gt[gt_id], labels.gt_canonical[gt_id]
    corners = label["bbox3d_corners_2d"]
    rle = compressed_rle(annotation["segmentation"])
    return {
        "id": number,
        "image_id": image_id,
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
        "cam_R_m2c": gt["cam_R_m2c"],
        "cam_t_m2c": gt["cam_t_m2c"],
        "cam_R_m2c_canonical": label["cam_R_m2c_canonical"],
        "cam_t_m2c_canonical": label["cam_t_m2c_canonical"],
        "discontinuity_margin_deg": label["discontinuity_margin_deg"],
        "n_regressors": label["n_regressors"],
        "regressor_index": label["regressor_index"],
    }


def compressed_rle(segmentation: _Segmentation) -> _Segmentation:
    """COCO's compressed run lengths, as text, of a segmentation in either form; by pycocotools."""
    if isinstance(segmentation["counts"], str):
        return segmentation
    rle = coco_mask.frPyObjects(segmentation, *segmentation["size"])
    return {"counts": rle["counts"].decode("ascii"), "size": [int(side) for side in rle["size"]]}


def _keypoints(corners: list[list[float]], width: int, height: int) -> list[float]:
    """COCO's flat [u, v, flag, ...]; pixel (i, j) is centred at (i, j), so the image begins at -0.5."""
    flat: list[float] = []
    for u, v in corners:
        inside = -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5
        flat += [u, v, _IN_IMAGE if inside else _OUTSIDE]
    return flat


def _with_corners(category: _SceneCategory) -> dict[str, Any]:
    return {**category, "keypoints": _CORNER_NAMES, "skeleton": _SKELETON}


def _licence(dataset: Path) -> str | None:
    """What dataset.json says of the models' licence, if anything."""
    path = dataset / DATASET_FILE
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
