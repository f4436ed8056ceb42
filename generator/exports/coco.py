"""COCO: one JSON file for a whole split, which pycocotools, torchvision and FiftyOne load as it is.

Every annotation names its instance (``gt_id``) and carries the true pose, the canonical pose and the regressor index;
its keypoints are the 8 projected box corners of the canonical pose, the targets of Pitteri et al. (3DV 2019).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from pycocotools import mask as coco_mask
from tqdm import tqdm
from typing_extensions import NotRequired, TypedDict

from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import ScenePaths, find_split, refuse_target, scene_ids
from synthetless.dataset.records import CameraModelEntry
from synthetless.errors import UserError
from synthetless.exports.annotated import (
    AnnotatedImage,
    SceneAnnotation,
    SceneCategory,
    Segmentation,
    annotated_images,
    compressed_rle,
    decoded_mask,
    in_image,
    licence_of,
    names_of,
    read_scene_coco,
)
from synthetless.exports.outlines import border_polygons
from synthetless.io.files import atomic_file, remove_drafts
from synthetless.io.models import BOX_EDGES

BoxKind = Literal["visible", "amodal"]


class ExportedImage(TypedDict):
    """An image in the file of the whole split: what COCO asks for, and which image of the dataset it is."""

    id: int
    file_name: str
    width: int
    height: int
    scene_id: int
    im_id: int
    cam_K: NotRequired[list[float]]
    cam_model: NotRequired[CameraModelEntry]
    license: NotRequired[int]


class _QuasiFields(TypedDict, total=False):
    """Of scene_gt_ambiguity.json, where the object has a quasi-symmetry group and ``ambiguity`` judged the image."""

    cam_R_m2c_quasi: list[float]
    cam_t_m2c_quasi: list[float]
    quasi_index: int
    n_quasi_indices: int
    n_cosets: int
    coset_true: int
    cosets_alike: list[int]
    pixels_apart: list[int]
    view_ambiguity: float


class ExportedAnnotation(_QuasiFields):
    """A visible instance in it: what COCO asks for, which instance it is, its true pose and its label."""

    id: int
    image_id: int
    category_id: int
    iscrowd: int
    ignore: bool
    area: int
    bbox: list[float]
    segmentation: Segmentation | list[list[int]]
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


def export_coco(
    dataset: Path, to: Path, split: str | None = None, boxes: BoxKind = "visible", polygons: bool = False
) -> int:
    """Write a split as one COCO file; images stay where they are and are named relative to it.

    Images are numbered from 1 through all scenes, annotations likewise. Instances of which nothing is visible are
    left out, as in scene_gt_coco.json. No image is decoded.

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json in its scenes.
        to: the JSON file to write; one that an earlier export wrote is replaced.
        split: folder name; the only one if None.
        boxes: of the visible part, or of the whole silhouette inside the image.
        polygons: write masks as polygons, for readers that know no run lengths.

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
    licence, names = licence_of(dataset), names_of(dataset)
    categories: dict[int, Any] = {}
    images: list[str] = []
    annotations: list[str] = []
    for scene_id in tqdm(scene_ids(dataset, split), desc="COCO", unit="scene", disable=None):
        scene = ScenePaths.of(dataset, scene_id, split)
        coco = read_scene_coco(scene)
        categories |= {category["id"]: _with_corners(category, names) for category in coco["categories"]}
        for image in annotated_images(scene, coco):
            image_id = len(images) + 1
            exported = _image(image, image_id, scene_id, scene, to)
            images.append(json.dumps(exported if licence is None else exported | {"license": 1}))
            for gt_id, annotation in image.visible:
                number = len(annotations) + 1
                item = _annotation(number, image_id, image, gt_id, annotation, boxes, polygons)
                annotations.append(json.dumps(item))
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


def _image(image: AnnotatedImage, image_id: int, scene_id: int, scene: ScenePaths, to: Path) -> ExportedImage:
    path = os.path.relpath(scene.root / image.entry["file_name"], to.parent)
    exported: ExportedImage = {
        "id": image_id,
        "file_name": Path(path).as_posix(),
        "width": image.entry["width"],
        "height": image.entry["height"],
        "scene_id": scene_id,
        "im_id": image.labels.im_id,
    }
    camera = image.labels.camera
    if "cam_K" in camera:
        exported["cam_K"] = camera["cam_K"]
    else:
        exported["cam_model"] = camera["cam_model"]
    return exported


def _annotation(
    number: int,
    image_id: int,
    image: AnnotatedImage,
    gt_id: int,
    annotation: SceneAnnotation,
    boxes: BoxKind,
    polygons: bool,
) -> ExportedAnnotation:
    labels = image.labels
    gt, label = labels.gt[gt_id], labels.gt_canonical[gt_id]
    corners = label["bbox3d_corners_2d"]
    rle = compressed_rle(annotation["segmentation"])
    ambiguity: Any = (labels.gt_ambiguity[gt_id] if labels.gt_ambiguity else None) or {}
    exported: ExportedAnnotation = {
        "id": number,
        "image_id": image_id,
        "category_id": annotation["category_id"],
        "iscrowd": 0,
        "ignore": annotation["ignore"],
        "area": annotation["area"],
        "bbox": annotation["bbox"] if boxes == "amodal" else [int(side) for side in coco_mask.toBbox(rle)],
        "segmentation": polygons_of(rle) if polygons else rle,
        "keypoints": _keypoints(corners, image.entry["width"], image.entry["height"]),
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
    quasi: Any = {key: value for key, value in ambiguity.items() if key in _QuasiFields.__annotations__}
    return exported | quasi  # type: ignore[no-any-return]


def polygons_of(segmentation: Segmentation) -> list[list[int]]:
    """COCO's polygons [[x, y, x, y, ...], ...] of run lengths; pycocotools makes the same mask of them.

    Each connected piece is one polygon, holes included.
    """
    return [ring.ravel().tolist() for ring in border_polygons(decoded_mask(segmentation))]


def _keypoints(corners: list[list[float]], width: int, height: int) -> list[float]:
    """COCO's flat [u, v, flag, ...]."""
    flat: list[float] = []
    for u, v in corners:
        flat += [u, v, _IN_IMAGE if in_image(u, v, width, height) else _OUTSIDE]
    return flat


def _with_corners(category: SceneCategory, names: Mapping[int, str]) -> dict[str, Any]:
    name = {"name": names[category["id"]]} if category["id"] in names else {}
    return {**category, **name, "keypoints": _CORNER_NAMES, "skeleton": _SKELETON}


def _json_parts(head: dict[str, Any], lists: dict[str, list[str]]) -> Iterator[str]:
    """A JSON object of ``head`` and of lists whose items are JSON already, one item per line."""
    yield "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    for key, items in lists.items():
        yield f",\n{json.dumps(key)}: ["
        for number, item in enumerate(items):
            yield f"{',' if number else ''}\n{item}"
        yield "\n]"
    yield "\n}\n"
