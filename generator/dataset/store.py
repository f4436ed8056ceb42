"""A dataset on disk that can be left at any moment and gone on with.

An image exists when its record does: the files of an image are written first, each beside its place and renamed, its
record last. The JSON files of a scene folder are a function of its records and of symmetries.json; ``assemble`` writes
them, at any time and as often as one likes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from synthetless.config import Recipe, dump_recipe
from synthetless.dataset import records
from synthetless.dataset.card import write_card
from synthetless.dataset.changes import complete
from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import (
    CAMERA_FILE,
    DATASET_FILE,
    MODELS_FOLDER,
    RECORDS_FOLDER,
    SYMMETRIES_FILE,
    ImagePlan,
    ScenePaths,
    image_number,
)
from synthetless.dataset.records import Entry
from synthetless.errors import UserError
from synthetless.io.files import atomic_write, in_turn, read_json, write_json, write_json_lines
from synthetless.io.models import INFO_FILE, ObjectModel
from synthetless.symmetry import SymmetryTable

_MAY_CHANGE = ("images", "name", "source")
"""Settings that a dataset may be continued under another value of: the sources are compared by their content."""


class DatasetError(UserError):
    """A folder that cannot take the dataset; the message is one line."""


@dataclass(frozen=True)
class FinishedImage:
    """An image that is made, but not yet on disk.

    Attributes:
        plan: which one it is.
        files: encoded content by the file's path inside the scene folder.
        camera, gt, gt_info, coco: BOP's entries for it.
        spec: everything needed to render it again.
    """

    plan: ImagePlan
    files: Mapping[str, bytes]
    camera: Entry
    gt: list[Entry]
    gt_info: list[Entry]
    coco: list[Entry]
    spec: Entry


@dataclass(frozen=True)
class Dataset:
    """A dataset folder and the recipe that fills it."""

    root: Path
    recipe: Recipe

    @classmethod
    def open(cls, root: Path, recipe: Recipe, models: Mapping[int, ObjectModel], scenery_digest: str) -> Dataset:
        """Begin a dataset, or go on with one that was made from the same recipe, models and photographs.

        Raises:
            UserError: the folder holds something else, or cannot be written.
        """
        known = root / DATASET_FILE
        header = _header(recipe, models, scenery_digest)
        if known.exists():
            before = read_json(known)
            _refuse_other(known, before, header)
            recipe = recipe.model_copy(update={"images": max(recipe.images, before["recipe"]["images"])})
        else:
            _refuse_foreign(root)
            write_json(known, header)
        dataset = cls(root, recipe)
        dataset._write_companions(models)
        return dataset

    def scene(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.recipe.split)

    def record(self, scene_id: int, im_id: int) -> Path:
        """The record of an image."""
        return self._records(scene_id) / f"{im_id:06d}.json"

    def done(self) -> set[int]:
        """Numbers of the images that exist."""
        return {
            image_number(int(path.parent.name), int(path.stem))
            for path in (self.root / RECORDS_FOLDER).glob("*/*.json")
        }

    def missing(self) -> list[int]:
        """Numbers of the images that the recipe asks for and that do not exist yet, ascending."""
        done = self.done()
        return [number for number in range(self.recipe.images) if number not in done]

    def commit(self, image: FinishedImage) -> None:
        """Put an image on disk; it exists from the moment this returns.

        Raises:
            DatasetError: a file cannot be written.
        """
        scene = self.scene(image.plan.scene_id)
        record = {key: getattr(image, key) for key in ("camera", "gt", "gt_info", "coco", "spec")}
        try:
            for name, content in image.files.items():
                atomic_write(scene.root / name, content)
            write_json(self.record(image.plan.scene_id, image.plan.im_id), record)
        except ValueError as error:
            raise DatasetError(str(error)) from error

    def assemble(self) -> None:
        """Bring the scene folders' JSON files and dataset.json up to date with the images that exist.

        Raises:
            UserError: a file cannot be read or written.
        """
        with in_turn(self.root):
            self._assemble()

    def finish(self) -> None:
        """Assemble, and describe the dataset in its card; errors as in ``assemble``."""
        with in_turn(self.root):
            if self._assemble():
                write_card(self.root)

    def _assemble(self) -> int:
        """Do it, and return how many images there are."""
        complete(self.root)
        table = SymmetryTable.read(self.root / SYMMETRIES_FILE)
        header = read_json(self.root / DATASET_FILE)
        symmetries = describe_symmetries(table)
        stale = header.get("symmetries") != symmetries
        infos = {int(key): info for key, info in read_json(self.root / MODELS_FOLDER / INFO_FILE).items()}
        images = instances = 0
        for folder in sorted((self.root / RECORDS_FOLDER).glob("*")):
            gt = self._assemble_scene(int(folder.name), table, infos, stale)
            images += len(gt)
            instances += sum(len(entries) for entries in gt.values())
        header["recipe"] = dump_recipe(self.recipe)
        header["counts"] = {"images": images, "instances": instances}
        header["symmetries"] = symmetries
        write_json(self.root / DATASET_FILE, header)
        return images

    def _records(self, scene_id: int) -> Path:
        return self.root / RECORDS_FOLDER / f"{scene_id:06d}"

    def _assemble_scene(
        self, scene_id: int, table: SymmetryTable, infos: Mapping[int, Entry], stale: bool
    ) -> dict[int, Any]:
        """Write the JSON files of a scene folder, unless they tell of every record already; return scene_gt.

        ``stale`` tells that the folder's labels may be of other symmetries than the table's.
        """
        scene = self.scene(scene_id)
        paths = {int(path.stem): path for path in sorted(self._records(scene_id).glob("*.json"))}
        if scene.scene_camera.exists():
            listed = records.read_scene_json(scene.scene_camera).keys()
            if listed - paths.keys():
                raise DatasetError(
                    f"{self._records(scene_id)}: lacks the records of {len(listed - paths.keys())} images; "
                    "without them the dataset cannot be continued"
                )
            if listed == paths.keys() and not stale:
                return records.read_scene_json(scene.scene_gt)
        made = {im_id: read_json(path) for im_id, path in paths.items()}
        camera = {im_id: record["camera"] for im_id, record in made.items()}
        gt = {im_id: record["gt"] for im_id, record in made.items()}
        records.write_scene_json(scene.scene_gt, gt)
        records.write_scene_json(scene.scene_gt_info, {im_id: record["gt_info"] for im_id, record in made.items()})
        records.write_scene_json(scene.scene_gt_canonical, label_scene(gt, camera, table, infos))
        write_json(scene.scene_gt_coco, self._coco(scene, made, infos))
        write_json_lines(scene.scene_spec, [made[im_id]["spec"] for im_id in sorted(made)])
        records.write_scene_json(scene.scene_camera, camera)  # last: an image listed here is in all the others
        return gt

    def _coco(self, scene: ScenePaths, made: Mapping[int, Entry], infos: Mapping[int, Entry]) -> Entry:
        camera, extension = self.recipe.camera, self.recipe.encoding.rgb_format
        return records.scene_gt_coco(
            self.recipe.name,
            infos,
            [records.coco_image(im_id, scene.rgb(im_id, extension), camera.width, camera.height) for im_id in made],
            [annotation for record in made.values() for annotation in record["coco"]],
        )

    def _write_companions(self, models: Mapping[int, ObjectModel]) -> None:
        """camera.json, the models and symmetries.json; what is there already stays as it is."""
        folder = self.root / MODELS_FOLDER
        for model in models.values():
            if not (folder / model.path.name).exists():
                atomic_write(folder / model.path.name, model.to_ply())
        infos = {str(obj_id): dict(model.info) for obj_id, model in models.items()}
        camera = records.camera_json(self.recipe.intrinsics, self.recipe.encoding.depth_scale)
        for path, content in ((folder / INFO_FILE, infos), (self.root / CAMERA_FILE, camera)):
            if not path.exists():
                write_json(path, content)
        if not (self.root / SYMMETRIES_FILE).exists():
            SymmetryTable.from_models_info(infos, self.recipe.labels.scheme).write(self.root / SYMMETRIES_FILE)


def describe_symmetries(table: SymmetryTable) -> Entry:
    """What dataset.json says of the symmetries that the labels were made with."""
    return {"scheme": table.scheme, "sha256": table.digest()}


def _header(recipe: Recipe, models: Mapping[int, ObjectModel], scenery_digest: str) -> Entry:
    """What dataset.json says before the first image."""
    return {
        "name": recipe.name,
        "recipe": dump_recipe(recipe),
        "versions": versions(),
        "models_sha256": {str(obj_id): model.digest for obj_id, model in models.items()},
        "scenery_digest": scenery_digest,
        "licence": recipe.source.licence,
        "counts": {"images": 0, "instances": 0},
    }


def versions() -> dict[str, str]:
    """What is installed here of that which pixels depend on."""
    return {name: version(name) for name in ("synthetless", "bpy")}


def _refuse_foreign(root: Path) -> None:
    try:
        root.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in root.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise DatasetError(f"{root}: cannot be used as output folder ({error.strerror})") from None
    if strangers:
        raise DatasetError(
            f"{root}: holds {strangers[0]}, but no {DATASET_FILE}; give an empty folder, or one that generate began"
        )


def _refuse_other(path: Path, before: Entry, now: Entry) -> None:
    """Continue only what would come out the same had it never been interrupted."""
    for key in ("versions", "models_sha256", "scenery_digest"):
        if before.get(key) != now[key]:
            raise DatasetError(f"{path}: was begun with other {key} than now; use another output folder")
    old, new = _flat(before.get("recipe", {})), _flat(now["recipe"])
    for key in sorted(old.keys() | new.keys()):
        if key.split(".", maxsplit=1)[0] not in _MAY_CHANGE and old.get(key) != new.get(key):
            raise DatasetError(
                f"{path}: was begun with {key} = {old.get(key)}, now it is {new.get(key)}; use another output folder"
            )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        leaves |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return leaves
