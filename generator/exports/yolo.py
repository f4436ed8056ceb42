"""YOLO: the folder of images, text labels and data.yaml that ultralytics trains with.

Formats: https://docs.ultralytics.com/datasets/ (detect, segment, pose). Coordinates are shares of the image's width and
height, counted from its corner, half a pixel before the centre of the first pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from synthetless.dataset.layout import (
    DATASET_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    find_split,
    image_number,
    scene_ids,
)
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.records import amodal_box, read_scene_json
from synthetless.errors import UserError
from synthetless.exports.annotated import (
    AnnotatedImage,
    SceneAnnotation,
    annotated_images,
    compressed_rle,
    decoded_mask,
    in_image,
    licence_of,
    names_of,
    read_scene_coco,
)
from synthetless.exports.folder import Entry, FolderExport, write_export
from synthetless.exports.outlines import centre_polygon
from synthetless.io.files import read_bytes
from synthetless.io.images import decode_mask
from synthetless.io.models import INFO_FILE
from synthetless.symmetry import SymmetryTable

Task = Literal["detect", "segment", "pose"]
Classes = Literal["object", "regressor"]

DATA_FILE = "data.yaml"
_VISIBLE, _ABSENT = 2, 0
"""ultralytics' flags of a keypoint: labelled and visible; not labelled, since it is outside the image."""


@dataclass(frozen=True)
class YoloClass:
    """A class: an object, or those of its poses that one regressor learns."""

    obj_id: int
    regressor_index: int | None
    name: str


@dataclass(frozen=True)
class YoloExport(FolderExport):
    """A YOLO folder.

    Attributes:
        task: what the labels are of: boxes, polygons, or boxes with the 8 canonical box corners.
        amodal: boxes and polygons of whole silhouettes inside the image, hidden parts included.
        classes: what a class is.
        val_percent: share of the images to validate with; 0: the images that are trained with.
    """

    kind: ClassVar[str] = "yolo"
    owned: ClassVar[tuple[str, ...]] = ("images/*/*.*", "labels/*/*.txt")

    task: Task = "detect"
    amodal: bool = False
    classes: Classes = "object"
    val_percent: int = 10

    def parts(self) -> Sequence[int]:
        """The scene folders."""
        if not 0 <= self.val_percent <= 50:
            raise UserError(f"val_percent is {self.val_percent}; 0 to 50 are possible")
        ids = scene_ids(self.dataset, self.split)
        if not any(self._subset(scene_id, im_id) == "train" for scene_id in ids for im_id in self._image_ids(scene_id)):
            raise UserError(
                f"{self.dataset}: has too few images to keep {self.val_percent} % of them for validation; "
                "--val-percent 0 validates with those that are trained with"
            )
        return ids

    def entries(self, part: int) -> Iterator[Entry]:
        """Images and labels of a scene folder."""
        scene = self._scene(part)
        for image in annotated_images(scene, read_scene_coco(scene)):
            im_id = image.labels.im_id
            picture = scene.root / image.entry["file_name"]
            place = f"{self._subset(part, im_id)}/{part:06d}_{im_id:06d}"
            yield f"images/{place}{picture.suffix}", picture
            yield f"labels/{place}.txt", "".join(f"{line}\n" for line in self._lines(scene, image)).encode()

    def common(self) -> Iterator[Entry]:
        """data.yaml; what the labels were made with, and the boxes whose corners are the keypoints."""
        yield DATA_FILE, yaml.safe_dump(self._data(), sort_keys=False, allow_unicode=True).encode()
        yield SYMMETRIES_FILE, self.dataset / SYMMETRIES_FILE
        yield INFO_FILE, find_models_folder(self.dataset) / INFO_FILE

    def _data(self) -> dict[str, Any]:
        """Content of data.yaml. Without ``flip_idx``: the mirror image of a part is another part."""
        pose = {"kpt_shape": [8, 3]} if self.task == "pose" else {}
        regressors = {"regressor_indices": [each.regressor_index for each in self._classes]}
        licence = licence_of(self.dataset)
        return {
            "train": "images/train",
            "val": "images/val" if self.val_percent else "images/train",
            **pose,
            "names": {number: each.name for number, each in enumerate(self._classes)},
            "obj_ids": [each.obj_id for each in self._classes],
            **(regressors if self.classes == "regressor" else {}),
            **({} if licence is None else {"license": licence}),
        }

    @cached_property
    def _classes(self) -> tuple[YoloClass, ...]:
        """All classes of the dataset, whether they occur or not, in the order of their numbers."""
        categories: dict[int, str] = {}
        for scene_id in scene_ids(self.dataset, self.split):
            for category in read_scene_coco(self._scene(scene_id))["categories"]:
                categories[category["id"]] = str(category.get("name", category["id"]))
        categories |= {obj_id: name for obj_id, name in names_of(self.dataset).items() if obj_id in categories}
        if self.classes == "object":
            return tuple(YoloClass(obj_id, None, name) for obj_id, name in sorted(categories.items()))
        table = SymmetryTable.read(self.dataset / SYMMETRIES_FILE)
        return tuple(
            YoloClass(obj_id, index, name if count == 1 else f"{name}_r{index}")
            for obj_id, name in sorted(categories.items())
            for count in [table.canonical_map(obj_id).n_regressors]
            for index in range(count)
        )

    @cached_property
    def _numbers(self) -> dict[tuple[int, int | None], int]:
        return {(each.obj_id, each.regressor_index): number for number, each in enumerate(self._classes)}

    @cached_property
    def _views_per_drop(self) -> int | None:
        """None where ``generate`` did not make the dataset."""
        return read_recipe(self.dataset).camera.views_per_drop if (self.dataset / DATASET_FILE).exists() else None

    def _subset(self, scene_id: int, im_id: int) -> Literal["train", "val"]:
        """Views of one drop stay together; so do, in datasets of others, images of one scene folder."""
        views = self._views_per_drop
        group = scene_id if views is None else image_number(scene_id, im_id) // views
        return "val" if group * self.val_percent % 100 < self.val_percent else "train"

    def _scene(self, scene_id: int) -> ScenePaths:
        return ScenePaths.of(self.dataset, scene_id, self.split)

    def _image_ids(self, scene_id: int) -> Iterator[int]:
        return iter(read_scene_json(self._scene(scene_id).scene_gt))

    def _lines(self, scene: ScenePaths, image: AnnotatedImage) -> Iterator[str]:
        """A line for each visible instance."""
        size = np.array([image.entry["width"], image.entry["height"]])
        for gt_id, annotation in image.visible:
            label = image.labels.gt_canonical[gt_id]
            index = label["regressor_index"] if self.classes == "regressor" else None
            number = self._numbers.get((annotation["category_id"], index))
            if number is None:
                raise UserError(
                    f"{scene.scene_gt_canonical}: image {image.labels.im_id}, instance {gt_id}: regressor {index} "
                    f"of object {annotation['category_id']} is not one of {SYMMETRIES_FILE}; run relabel"
                )
            if self.task == "segment":
                numbers = _polygon(self._mask(scene, image.labels.im_id, gt_id, annotation)) / size
                yield _line(number, numbers.ravel().tolist())
                continue
            x, y, w, h = self._box(annotation)
            numbers = np.array([[x + w / 2, y + h / 2], [w, h]]) / size
            corners = _keypoints(label["bbox3d_corners_2d"], image) if self.task == "pose" else []
            yield _line(number, [*numbers.ravel().tolist(), *corners])

    def _mask(self, scene: ScenePaths, im_id: int, gt_id: int, annotation: SceneAnnotation) -> NDArray[np.bool_]:
        if self.amodal:
            path = scene.mask(im_id, gt_id)
            return decode_mask(read_bytes(path), path)
        return decoded_mask(annotation["segmentation"])

    def _box(self, annotation: SceneAnnotation) -> list[float]:
        """[x, y, w, h] along the pixels' edges."""
        if self.amodal:
            return annotation["bbox"]
        return [float(side) for side in coco_mask.toBbox(compressed_rle(annotation["segmentation"]))]


def export_yolo(
    dataset: Path,
    to: Path,
    task: Task = "detect",
    split: str | None = None,
    amodal: bool = False,
    classes: Classes | None = None,
    val_percent: int = 10,
    copy: bool = False,
    workers: int | None = None,
) -> YoloExport:
    """Write a split as the folder that ultralytics trains with: images/, labels/, data.yaml.

    Instances of which nothing is visible are left out. Of a keypoint outside the image nothing is said: the format has
    no place for it.

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json in its scenes.
        to: a new or empty folder; it appears when everything is written.
        task: boxes, polygons of masks, or boxes and the 8 corners of the canonical pose.
        split: folder name; the only one if None.
        amodal: boxes and polygons of whole silhouettes inside the image, not of their visible parts.
        classes: one for each object, or for each of its regressors; None: regressors for ``pose``, whose corners are
            unambiguous within one regressor only, else objects.
        val_percent: 0 to 50; whole drops are kept for validation. 0: data.yaml names the training images again.
        copy: copy the images, for a folder that is to be sent; else link them.
        workers: processes; one per available core if None.

    Raises:
        UserError: the dataset is incomplete or too small, an argument is out of range, or the folder belongs to the
            dataset, holds something, or cannot be written.
    """
    of = classes or ("regressor" if task == "pose" else "object")
    export = YoloExport(dataset, split or find_split(dataset), copy, task, amodal, of, val_percent)
    write_export(export, to, workers)
    return export


def _polygon(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(N, 2) points (u, v) counted from the image's corner.

    Through the centres of the border pixels, from which ultralytics draws the mask again. A mask one pixel wide or high
    would have no area between centres: it becomes a rectangle inside its pixels.
    """
    ring = centre_polygon(mask)
    if (np.ptp(ring, axis=0) > 0).all():
        return ring + 0.5
    x, y, w, h = amodal_box(mask)
    left, top, right, bottom = x + 0.25, y + 0.25, x + w - 0.25, y + h - 0.25
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def _keypoints(corners: Sequence[Sequence[float]], image: AnnotatedImage) -> Iterator[float]:
    width, height = image.entry["width"], image.entry["height"]
    for u, v in corners:
        if in_image(u, v, width, height):
            yield from ((u + 0.5) / width, (v + 0.5) / height, _VISIBLE)
        else:
            yield from (0, 0, _ABSENT)


def _line(number: int, values: Sequence[float]) -> str:
    return " ".join([str(number), *(f"{value:.6f}".rstrip("0").rstrip(".") for value in values)])
