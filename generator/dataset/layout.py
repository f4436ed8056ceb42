"""Where everything of a dataset lies: every file and folder name, and the place of each image.

BOP's scenewise layout: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md. Nothing here
depends on what has been made already.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from synthetless.config import SPLIT
from synthetless.errors import UserError
from synthetless.io.models import INFO_FILE
from synthetless.symmetry.table import TABLE_FILE

DATASET_FILE = "dataset.json"
SYMMETRIES_FILE = TABLE_FILE
PENDING_FILE = f".{SYMMETRIES_FILE}"
"""While labels are being replaced: the symmetry table that the new ones are of."""
CAMERA_FILE = "camera.json"
AMBIGUITY_FILE = "ambiguity.json"
"""What the scene folders' scene_gt_ambiguity.json are of."""
PENDING_AMBIGUITY_FILE = f".{AMBIGUITY_FILE}"
"""The same while they are being made."""
DRAFT_FOLDER = ".relabel.draft"
"""New labels, until all of them are made."""
CARD_FILE = "README.md"
SHEET_FILE = "preview.jpg"
MODELS_FOLDER = "models"
RECORDS_FOLDER = ".records"
FAILURES_FOLDER = ".failures"
LOGS_FOLDER = ".logs"
PREVIEW_FOLDER = "preview"
_MODELS_FOLDERS = (MODELS_FOLDER, "models_cad", "models_eval")
_RESERVED = (
    DATASET_FILE,
    SYMMETRIES_FILE,
    AMBIGUITY_FILE,
    CAMERA_FILE,
    CARD_FILE,
    SHEET_FILE,
    PREVIEW_FOLDER,
    SPLIT,
    *_MODELS_FOLDERS,
)
"""Names in a dataset's folder that nothing else may have, whether they are there or not."""

IMAGES_PER_SCENE = 1000
FIRST_SCENE = 1


@dataclass(frozen=True)
class ImagePlan:
    """One image: its number in the dataset, the drop and view that it shows, and its place on disk."""

    number: int
    drop: int
    view: int
    scene_id: int
    im_id: int


@dataclass(frozen=True)
class Part:
    """A share of a dataset's drops: every ``count``-th, beginning with the ``number``-th, counted from 1."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Part:
        """Read "3/10".

        Raises:
            UserError: it is written otherwise, or not one of the parts.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        part = cls(*map(int, match.groups())) if match else None
        if part is None or not 1 <= part.number <= part.count:
            raise UserError(f"part {text!r}: write it as 3/10, from 1/10 to 10/10")
        return part

    @property
    def name(self) -> str:
        """For file names: "3-of-10"."""
        return f"{self.number}-of-{self.count}"

    def takes(self, drop: int) -> bool:
        """Whether a drop belongs to this part."""
        return drop % self.count == self.number - 1


def plan_image(number: int, views_per_drop: int) -> ImagePlan:
    """The plan of the image with a number, counted from 0."""
    drop, view = divmod(number, views_per_drop)
    scene, im_id = divmod(number, IMAGES_PER_SCENE)
    return ImagePlan(number, drop, view, FIRST_SCENE + scene, im_id)


def image_number(scene_id: int, im_id: int) -> int:
    """The number of the image at a place on disk."""
    return (scene_id - FIRST_SCENE) * IMAGES_PER_SCENE + im_id


def by_drop(numbers: Iterable[int], views_per_drop: int) -> Iterator[tuple[int, list[ImagePlan]]]:
    """The images with these ascending numbers, together with those that show the same drop."""
    plans = (plan_image(number, views_per_drop) for number in numbers)
    for drop, images in groupby(plans, key=lambda image: image.drop):
        yield drop, list(images)


@dataclass(frozen=True)
class ScenePaths:
    """The files of one scene; ``root`` is the folder SPLIT/%06d."""

    root: Path

    @property
    def name(self) -> str:
        """SPLIT/%06d."""
        return f"{self.root.parent.name}/{self.root.name}"

    @classmethod
    def of(cls, dataset: Path, scene_id: int, split: str = SPLIT) -> ScenePaths:
        """The paths of a scene in a dataset folder."""
        return cls(dataset / split / f"{scene_id:06d}")

    def rgb(self, im_id: int, extension: str = "png") -> Path:
        return self.root / "rgb" / f"{im_id:06d}.{extension}"

    def find_rgb(self, im_id: int) -> Path | None:
        """The colour image in whichever format there is; None if there is none."""
        return next((path for path in (self.rgb(im_id, "png"), self.rgb(im_id, "jpg")) if path.exists()), None)

    def depth(self, im_id: int) -> Path:
        return self.root / "depth" / f"{im_id:06d}.png"

    def depth_sensed(self, im_id: int) -> Path:
        return self.root / "depth_sensed" / f"{im_id:06d}.png"

    def mask(self, im_id: int, gt_id: int) -> Path:
        return self.root / "mask" / f"{im_id:06d}_{gt_id:06d}.png"

    def mask_visib(self, im_id: int, gt_id: int) -> Path:
        return self.root / "mask_visib" / f"{im_id:06d}_{gt_id:06d}.png"

    def normals(self, im_id: int) -> Path:
        return self.root / "normals" / f"{im_id:06d}.png"

    def object_coordinates(self, im_id: int) -> Path:
        return self.root / "object_coordinates" / f"{im_id:06d}.png"

    def exr(self, im_id: int) -> Path:
        return self.root / "exr" / f"{im_id:06d}.exr"

    @property
    def scene_camera(self) -> Path:
        return self.root / "scene_camera.json"

    @property
    def scene_gt(self) -> Path:
        return self.root / "scene_gt.json"

    @property
    def scene_gt_info(self) -> Path:
        return self.root / "scene_gt_info.json"

    @property
    def scene_gt_coco(self) -> Path:
        return self.root / "scene_gt_coco.json"

    @property
    def scene_gt_canonical(self) -> Path:
        return self.root / "scene_gt_canonical.json"

    @property
    def scene_gt_ambiguity(self) -> Path:
        return self.root / "scene_gt_ambiguity.json"

    @property
    def scene_spec(self) -> Path:
        return self.root / "scene_spec.jsonl"


def find_split(dataset: Path) -> str:
    """The split of a dataset that has only one.

    Raises:
        UserError: the folder is no BOP dataset, or has several splits.
    """
    if not dataset.is_dir():
        raise UserError(f"{dataset}: no such dataset folder")
    splits = sorted({path.parent.parent.name for path in dataset.glob("*/*/scene_camera.json")})
    if not splits:
        raise UserError(f"{dataset}: no BOP dataset; {SPLIT}/000001/scene_camera.json or the like is needed")
    if len(splits) > 1:
        raise UserError(f"{dataset}: has the splits {', '.join(splits)}; name one of them")
    return splits[0]


def scene_ids(dataset: Path, split: str = SPLIT) -> list[int]:
    """The scenes of a split, ascending.

    Raises:
        UserError: there is no such split, or it holds no scene folders.
    """
    folder = dataset / split
    if not folder.is_dir():
        known = ", ".join(sorted({paths.root.parent.name for paths in scene_folders(dataset, ["scene_camera.json"])}))
        raise UserError(f"{folder}: no such split; {f'there are {known}' if known else 'this is not a BOP dataset'}")
    ids = sorted(int(entry.name) for entry in folder.iterdir() if entry.name.isdecimal() and entry.is_dir())
    if not ids:
        raise UserError(f"{folder}: holds no scene folders (000001, ...)")
    return ids


def scene_folders(root: Path, having: Iterable[str]) -> list[ScenePaths]:
    """The scene folders SPLIT/%06d of all splits that have one of these files, in order."""
    folders = {path.parent for name in having for path in root.glob(f"*/*/{name}")}
    return [ScenePaths(folder) for folder in sorted(folders) if folder.name.isdecimal()]


def other_sensors(folder: Path) -> list[str]:
    """Ground truth of further sensors in a scene folder, such as scene_gt_cam1.json: BOP 2024 allows several."""
    own = {f"scene_gt_{what}.json" for what in ("info", "coco", "canonical", "ambiguity")}
    names = sorted(path.name for path in folder.glob("scene_gt_*.json") if path.name not in own)
    return [name for name in names if not name.startswith(("scene_gt_info_", "scene_gt_coco_"))]


def refuse_target(root: Path, to: Path, own: str | None = None) -> None:
    """Keep an answer about a dataset from taking the place of what the dataset consists of.

    An answer may lie outside the dataset's folder, or in it under a name that is free.

    Args:
        root: the dataset's folder.
        to: the file or folder that is to be written; links in both are followed.
        own: name of a folder that is reserved for this kind of answer.

    Raises:
        UserError: the target is the dataset's folder, holds it, or belongs to it.
    """
    target, folder = _without_links(to), _without_links(root)
    if folder.is_relative_to(target):
        raise UserError(f"{to}: holds the dataset {root}; give another target")
    reserved = {folder / name for name in _RESERVED if name != own}
    for path in folder.iterdir() if folder.is_dir() else ():
        scenes = [child for child in path.iterdir() if child.name.isdecimal()] if path.is_dir() else []
        if scenes or path.name.startswith(".") or path in reserved:
            reserved |= {path, *map(_without_links, (path, *scenes))}
    inside = target.relative_to(folder).parts[0] if target.is_relative_to(folder) else ""
    if inside.startswith(".") or any(target.is_relative_to(path) for path in reserved):
        raise UserError(f"{to}: belongs to the dataset {root}; give a target outside, or a new name in its folder")


def _without_links(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError) as error:  # a link that leads to itself
        raise UserError(f"{path}: cannot be followed ({error})") from None


def find_models_folder(root: Path) -> Path:
    """The folder with the models_info.json of a BOP dataset.

    Raises:
        UserError: there is none in any of the places where BOP has it.
    """
    for name in _MODELS_FOLDERS:
        if (root / name / INFO_FILE).exists():
            return root / name
    raise UserError(f"{root}: holds no {INFO_FILE} in {', '.join(_MODELS_FOLDERS)}; name the models folder")
