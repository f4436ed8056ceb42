"""What scene_gt_coco.json says of each image, together with its poses and labels: what the exports are made from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from pydantic import ConfigDict, Field, with_config
from typing_extensions import NotRequired, TypedDict

from synthetless.dataset.layout import DATASET_FILE, ScenePaths, find_models_folder
from synthetless.dataset.reader import ImageEntries, read_entries
from synthetless.dataset.records import Count, validated
from synthetless.errors import UserError
from synthetless.io.files import read_json
from synthetless.io.models import object_names, read_models_info

_OPEN = ConfigDict(extra="ignore", strict=True)
_Side = Annotated[int, Field(ge=1, le=2**20)]
_Run = Annotated[int, Field(ge=0, le=2**31)]


@with_config(_OPEN)
class Segmentation(TypedDict):
    """Run lengths of a mask, plain or as pycocotools compresses them; ``size`` is [rows, columns]."""

    counts: list[_Run] | str
    size: Annotated[list[_Side], Field(min_length=2, max_length=2)]


@with_config(_OPEN)
class SceneImage(TypedDict):
    """An image in a scene folder's scene_gt_coco.json; BOP's scripts write more."""

    id: Count
    file_name: str
    width: _Side
    height: _Side


@with_config(_OPEN)
class SceneAnnotation(TypedDict):
    """A visible instance in it."""

    image_id: Count
    category_id: Count
    area: Count
    bbox: Annotated[list[float], Field(min_length=4, max_length=4)]
    segmentation: Segmentation
    ignore: bool


@with_config(_OPEN)
class SceneCategory(TypedDict):
    """An object in it."""

    id: Count
    name: NotRequired[str]


@with_config(_OPEN)
class SceneFile(TypedDict):
    """What is needed of scene_gt_coco.json."""

    images: list[SceneImage]
    annotations: list[SceneAnnotation]
    categories: list[SceneCategory]


@dataclass(frozen=True)
class AnnotatedImage:
    """An image with everything that a scene folder's JSON files say of it.

    Attributes:
        entry: its entry in scene_gt_coco.json.
        labels: its entries in the other files.
        visible: gt_id and annotation of each instance of which something is visible, in scene_gt's order.
    """

    entry: SceneImage
    labels: ImageEntries
    visible: tuple[tuple[int, SceneAnnotation], ...]


def read_scene_coco(scene: ScenePaths) -> dict[str, Any]:
    """scene_gt_coco.json as it stands there: its items may say more than ``SceneFile`` asks for.

    Raises:
        UserError: it is missing or damaged.
    """
    if not scene.scene_gt_coco.exists():
        raise UserError(f"{scene.scene_gt_coco}: not found; bop_toolkit's calc_gt_coco.py writes it")
    coco = read_json(scene.scene_gt_coco)
    validated(SceneFile, coco, scene.scene_gt_coco)
    return coco


def annotated_images(scene: ScenePaths, coco: dict[str, Any]) -> Iterator[AnnotatedImage]:
    """The images of a scene folder, in scene_gt's order.

    BOP's annotations do not say which instance they belong to: they are in scene_gt's order, less the hidden ones.

    Raises:
        UserError: a file is missing or damaged, or they disagree about the images or their instances.
    """
    images = {image["id"]: image for image in coco["images"]}
    annotations: dict[int, list[SceneAnnotation]] = {im_id: [] for im_id in images}
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
        yield AnnotatedImage(images[labels.im_id], labels, tuple(zip(visible, found, strict=True)))


def compressed_rle(segmentation: Segmentation) -> Segmentation:
    """COCO's compressed run lengths, as text, of a segmentation in either form; by pycocotools."""
    if isinstance(segmentation["counts"], str):
        return segmentation
    rle = coco_mask.frPyObjects(segmentation, *segmentation["size"])
    return {"counts": rle["counts"].decode("ascii"), "size": [int(side) for side in rle["size"]]}


def decoded_mask(segmentation: Segmentation) -> NDArray[np.bool_]:
    """(H, W) mask of run lengths in either form."""
    mask: NDArray[np.bool_] = coco_mask.decode(compressed_rle(segmentation)).astype(bool)
    return mask


def names_of(dataset: Path) -> dict[int, str]:
    """What models_info.json or names.yaml calls the objects of a dataset, where its models are in its folder."""
    try:
        folder = find_models_folder(dataset)
    except UserError:
        return {}
    return object_names(read_models_info(folder))


def in_image(u: float, v: float, width: int, height: int) -> bool:
    """Whether a point is in an image; pixel (i, j) is centred at (i, j), so the image begins at -0.5."""
    return -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5


def licence_of(dataset: Path) -> str | None:
    """What dataset.json says of the models' licence, if anything."""
    path = dataset / DATASET_FILE
    return (read_json(path).get("licence") or None) if path.exists() else None
