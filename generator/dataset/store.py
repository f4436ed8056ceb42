"""A dataset on disk that can be left at any moment and continued.

An image exists when its record does: the files of an image are written first, each beside its place and renamed, its
record last. The JSON files of a scene folder are a function of its records and of symmetries.json; ``assemble`` writes
them, at any time and as often as one likes.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.scene import AnnotatedScene
from synthetless.config import Recipe, dump_recipe
from synthetless.dataset import records
from synthetless.dataset.card import write_card
from synthetless.dataset.labels import LabelState, describe_symmetries, is_half_labelled, label_scene
from synthetless.dataset.layout import (
    CAMERA_FILE,
    DATASET_FILE,
    DRAFT_FOLDER,
    MODELS_FOLDER,
    PENDING_FILE,
    RECORDS_FOLDER,
    SYMMETRIES_FILE,
    ImagePlan,
    ScenePaths,
    image_number,
)
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.records import CocoFile, GtEntry, ImageRecord, ImageSpec, ModelInfo
from synthetless.errors import UserError
from synthetless.io import images
from synthetless.io.color import exposure_gain, picture
from synthetless.io.files import (
    atomic_write,
    in_turn,
    read_json,
    remove_drafts,
    replace_file,
    write_json,
    write_json_lines,
)
from synthetless.io.models import INFO_FILE, ObjectModel, object_names, read_models_info, texture_file
from synthetless.scenes.sampling import sample_depth_sensor, sample_sensor
from synthetless.scenes.spec import DepthSensorSpec, Pose, SceneSpec, SensorSpec
from synthetless.symmetry import SymmetryTable

_SIX_DIGITS = re.compile(r"\d{6}")
_MAY_CHANGE = ("images", "name", "source")
"""Settings that a dataset may be continued under another value of: the sources are compared by their content."""


_TOLD = 3
"""Settings that a refusal tells of; all that a quality sets are among them, if nothing else differs."""


class DatasetError(UserError):
    """A folder that cannot take the dataset; the message is one line."""


@dataclass(frozen=True)
class FinishedImage:
    """An image that is made, but not yet on disk.

    Attributes:
        plan: which one it is.
        files: encoded content by the file's path inside the scene folder.
        record: what the scene folder's JSON files are assembled from.
    """

    plan: ImagePlan
    files: Mapping[str, bytes]
    record: ImageRecord

    @classmethod
    def of(
        cls,
        recipe: Recipe,
        plan: ImagePlan,
        scene: SceneSpec,
        settled: Sequence[Pose],
        annotated: AnnotatedScene,
        linear: NDArray[np.float32] | None,
    ) -> FinishedImage:
        """Encode what was measured and rendered.

        Args:
            recipe: which files are written, and how.
            plan: which image it is.
            scene, settled: what was built, and the pose at rest of each of its objects.
            annotated: the planned view of it.
            linear: (H, W, 3) rendered light, Rec. 709 primaries; None if nothing was rendered.
        """
        gain = 1.0 if linear is None else exposure_gain(linear, recipe.render.exposure)
        rgb = None if linear is None else picture(linear, gain, planned_sensor(recipe, plan), recipe.render.shoulder)
        files = _encode(recipe, plan.im_id, annotated, rgb, linear)
        return cls(plan, files, image_record(recipe, plan, scene, settled, annotated, gain))


def planned_sensor(recipe: Recipe, plan: ImagePlan) -> SensorSpec | None:
    """The camera of an image; None if the recipe has none."""
    return None if recipe.sensor is None else sample_sensor(recipe.sensor, recipe.seed, plan.drop, plan.view)


def planned_depth_sensor(recipe: Recipe, plan: ImagePlan) -> DepthSensorSpec | None:
    """The depth camera of an image; None if its output is not asked for."""
    if recipe.depth_sensor is None or "depth_sensed" not in recipe.outputs:
        return None
    return sample_depth_sensor(recipe.depth_sensor, recipe.seed, plan.drop, plan.view)


def image_record(
    recipe: Recipe,
    plan: ImagePlan,
    scene: SceneSpec,
    settled: Sequence[Pose],
    annotated: AnnotatedScene,
    exposure_gain: float,
) -> ImageRecord:
    """The record of an image; arguments as for ``FinishedImage.of``."""
    camera, scale = recipe.intrinsics, recipe.encoding.depth_scale
    K, model = records.camera_matrix(camera), records.camera_model(camera)
    instances = annotated.image.instances
    sensors = planned_sensor(recipe, plan), planned_depth_sensor(recipe, plan)
    spec = ImageSpec(plan.im_id, plan.view, exposure_gain, annotated.numbers, scene, tuple(settled), *sensors)
    return {
        "camera": records.camera_entry(K, annotated.R_w2c, annotated.t_w2c, scale, model),
        "gt": [records.gt_entry(model.obj_id, model.R_m2c, model.t_m2c) for model in annotated.models],
        "gt_info": [records.gt_info_entry(instance) for instance in instances],
        "coco": records.coco_annotations(plan.im_id, [model.obj_id for model in annotated.models], instances),
        "spec": records.spec_entry(spec),
    }


@dataclass(frozen=True)
class _Assembled:
    """A scene folder whose JSON files tell of every record that its folder of records, last changed then, holds."""

    records_changed_ns: int
    images: int
    instances: int


@dataclass(frozen=True)
class DatasetStore:
    """A dataset folder and the recipe that fills it."""

    root: Path
    recipe: Recipe
    _assembled: dict[int, _Assembled] = field(default_factory=dict, init=False, compare=False, repr=False)
    """What this process knows to be assembled: the cost of assembling does not grow with what is finished."""

    @classmethod
    def open(cls, root: Path, recipe: Recipe, models: Mapping[int, ObjectModel], scenery_digest: str) -> DatasetStore:
        """Begin a dataset, or continue one that was made from the same recipe, models and photographs.

        Raises:
            UserError: the folder holds something else, or cannot be written.
        """
        if not (root / DATASET_FILE).exists():
            make_folder(root)
            write_json(root / DATASET_FILE, _header(recipe, models, scenery_digest))
        dataset = cls.begun(root, recipe, models, scenery_digest)
        dataset._write_companions(models)
        return dataset

    @classmethod
    def begun(cls, root: Path, recipe: Recipe, models: Mapping[int, ObjectModel], scenery_digest: str) -> DatasetStore:
        """A dataset that was begun before, from the same recipe, models and photographs; nothing is written.

        Raises:
            UserError: it was begun from others, or dataset.json is missing or damaged.
        """
        begun_with = read_recipe(root)  # with today's defaults for settings that it did not know
        header = read_json(root / DATASET_FILE)
        refuse_former_denoiser(root / DATASET_FILE, header)
        before = {**header, "recipe": dump_recipe(begun_with)}
        _refuse_other(root / DATASET_FILE, before, _header(recipe, models, scenery_digest))
        return cls(root, recipe.model_copy(update={"images": max(recipe.images, begun_with.images)}))

    def scene(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.recipe.split)

    def record(self, scene_id: int, im_id: int) -> Path:
        """The record of an image."""
        return self._records(scene_id) / f"{im_id:06d}.json"

    def done(self) -> set[int]:
        """Numbers of the images that exist."""
        return {image_number(scene_id, im_id) for scene_id in self._recorded() for im_id in self._record_ids(scene_id)}

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
        try:
            for name, content in image.files.items():
                atomic_write(scene.root / name, content)
            write_json(self.record(image.plan.scene_id, image.plan.im_id), image.record)
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
            self._assembled.clear()
            if self._assemble():
                write_card(self.root)

    def _assemble(self) -> int:
        """Do it, and return how many images there are."""
        shutil.rmtree(self.root / DRAFT_FOLDER, ignore_errors=True)  # of a relabelling that was killed
        header = read_json(self.root / DATASET_FILE)
        state = LabelState.read(self.root, header)
        infos = read_models_info(self.root / MODELS_FOLDER)
        for scene_id in self._recorded():
            changed_ns = self._records(scene_id).stat().st_mtime_ns
            known = self._assembled.get(scene_id)
            if known is None or known.records_changed_ns != changed_ns or not state.trusted:
                gt = self._assemble_scene(scene_id, state, infos)
                instances = sum(len(entries) for entries in gt.values())
                self._assembled[scene_id] = _Assembled(changed_ns, len(gt), instances)
        images = sum(known.images for known in self._assembled.values())
        header["recipe"] = dump_recipe(self.recipe)
        header["counts"] = {
            "images": images,
            "instances": sum(known.instances for known in self._assembled.values()),
        }
        header["symmetries"] = describe_symmetries(state.table)
        write_json(self.root / DATASET_FILE, header)
        if is_half_labelled(self.root):
            replace_file(self.root / PENDING_FILE, self.root / SYMMETRIES_FILE)
        return images

    def _recorded(self) -> list[int]:
        """Numbers of the scene folders that have records."""
        folder = self.root / RECORDS_FOLDER
        found = folder.iterdir() if folder.is_dir() else ()
        return sorted(int(path.name) for path in found if _SIX_DIGITS.fullmatch(path.name))

    def _record_ids(self, scene_id: int) -> list[int]:
        """Ids of the images of a scene folder that have a record, ascending; files of other names are no records."""
        found = self._records(scene_id).iterdir()
        return sorted(int(path.stem) for path in found if path.suffix == ".json" and _SIX_DIGITS.fullmatch(path.stem))

    def _records(self, scene_id: int) -> Path:
        return self.root / RECORDS_FOLDER / f"{scene_id:06d}"

    def _assemble_scene(
        self, scene_id: int, state: LabelState, infos: Mapping[int, ModelInfo]
    ) -> dict[int, list[GtEntry]]:
        """Write the JSON files of a scene folder, unless they tell of every record already; return scene_gt."""
        scene = self.scene(scene_id)
        for folder in (scene.root, self._records(scene_id)):
            remove_drafts(folder)  # of a run that could not
        paths = {im_id: self.record(scene_id, im_id) for im_id in self._record_ids(scene_id)}
        if scene.scene_camera.exists():
            listed = records.read_scene_json(scene.scene_camera).keys()
            if listed - paths.keys():
                raise DatasetError(
                    f"{self._records(scene_id)}: lacks the records of {len(listed - paths.keys())} images; "
                    "without them the dataset cannot be continued"
                )
            if listed == paths.keys() and state.trusted:
                return records.read_scene_json(scene.scene_gt)
        made = {im_id: cast(ImageRecord, read_json(path)) for im_id, path in paths.items()}
        camera = {im_id: record["camera"] for im_id, record in made.items()}
        gt = {im_id: record["gt"] for im_id, record in made.items()}
        records.write_scene_json(scene.scene_gt, gt)
        records.write_scene_json(scene.scene_gt_info, {im_id: record["gt_info"] for im_id, record in made.items()})
        records.write_scene_json(scene.scene_gt_canonical, label_scene(gt, camera, state.table, infos))
        write_json(scene.scene_gt_coco, self._coco(scene, made, infos))
        write_json_lines(scene.scene_spec, [made[im_id]["spec"] for im_id in sorted(made)])
        records.write_scene_json(scene.scene_camera, camera)  # last: an image listed here is in all the others
        return gt

    def _coco(self, scene: ScenePaths, made: Mapping[int, ImageRecord], infos: Mapping[int, ModelInfo]) -> CocoFile:
        camera, extension = self.recipe.camera, self.recipe.encoding.rgb_format
        return records.scene_gt_coco(
            self.recipe.name,
            infos,
            [records.coco_image(im_id, scene.rgb(im_id, extension), camera.width, camera.height) for im_id in made],
            [annotation for record in made.values() for annotation in record["coco"]],
            object_names(infos),
        )

    def _write_companions(self, models: Mapping[int, ObjectModel]) -> None:
        """camera.json, the models and symmetries.json; what is there already stays as it is."""
        folder = self.root / MODELS_FOLDER
        for model in models.values():
            files = {model.path.name: model.to_ply, texture_file(model.obj_id): model.to_png}
            for name, encode in files.items():
                encoded = None if (folder / name).exists() else encode()
                if encoded is not None:
                    atomic_write(folder / name, encoded)
        infos = {str(obj_id): dict(model.info) for obj_id, model in models.items()}
        camera = records.camera_json(self.recipe.intrinsics, self.recipe.encoding.depth_scale)
        for path, content in ((folder / INFO_FILE, infos), (self.root / CAMERA_FILE, camera)):
            if not path.exists():
                write_json(path, content)
        if not (self.root / SYMMETRIES_FILE).exists():
            SymmetryTable.from_models_info(infos, self.recipe.labels.scheme).write(self.root / SYMMETRIES_FILE)


def encode_rgb(recipe: Recipe, rgb: NDArray[np.uint8]) -> bytes:
    """The file of an (H, W, 3) sRGB image."""
    encoding = recipe.encoding
    return images.encode_png(rgb) if encoding.rgb_format == "png" else images.encode_jpeg(rgb, encoding.jpeg_quality)


def _encode(
    recipe: Recipe,
    im_id: int,
    annotated: AnnotatedScene,
    rgb: NDArray[np.uint8] | None,
    linear: NDArray[np.float32] | None,
) -> dict[str, bytes]:
    """The files of one image, by their paths inside the scene folder."""
    paths, encoding, annotation = ScenePaths(Path()), recipe.encoding, annotated.image
    files: dict[Path, bytes] = {}
    wanted = set(recipe.outputs)
    if "rgb" in wanted and rgb is not None:
        files[paths.rgb(im_id, encoding.rgb_format)] = encode_rgb(recipe, rgb)
    if "exr" in wanted and linear is not None:
        files[paths.exr(im_id)] = images.encode_exr(linear)
    if "depth" in wanted:
        files[paths.depth(im_id)] = images.encode_depth(annotation.depth_mm, encoding.depth_scale)
    if annotated.sensed_mm is not None:
        files[paths.depth_sensed(im_id)] = images.encode_depth(annotated.sensed_mm, encoding.depth_scale)
    if "masks" in wanted:
        for gt_id, instance in enumerate(annotation.instances):
            files[paths.mask(im_id, gt_id)] = images.encode_mask(instance.mask)
            files[paths.mask_visib(im_id, gt_id)] = images.encode_mask(instance.mask_visib)
    if annotation.normals is not None:
        files[paths.normals(im_id)] = images.encode_normals(annotation.normals)
    if annotation.object_coordinates_mm is not None:
        files[paths.object_coordinates(im_id)] = images.encode_object_coordinates(
            annotation.object_coordinates_mm, annotation.instance_ids >= 0
        )
    return {str(path): content for path, content in files.items()}


def _header(recipe: Recipe, models: Mapping[int, ObjectModel], scenery_digest: str) -> dict[str, Any]:
    """What dataset.json says before the first image."""
    return {
        "name": recipe.name,
        "recipe": dump_recipe(recipe),
        "versions": versions(),
        "models_sha256": {str(obj_id): model.digest for obj_id, model in models.items()},
        **_textures(models),
        "scenery_digest": scenery_digest,
        "licence": recipe.source.licence,
        "counts": {"images": 0, "instances": 0},
    }


def _textures(models: Mapping[int, ObjectModel]) -> dict[str, dict[str, str]]:
    """What dataset.json says of the models' textures, if there are any."""
    textures = {str(obj_id): png for obj_id, model in models.items() if (png := model.to_png()) is not None}
    digests = {obj_id: hashlib.sha256(png).hexdigest() for obj_id, png in textures.items()}
    return {"textures_sha256": digests} if digests else {}


def versions() -> dict[str, str]:
    """What is installed here of that which pixels depend on."""
    return {name: version(name) for name in ("synthetless", "bpy")}


def refuse_former_denoiser(path: Path, header: Mapping[str, Any]) -> None:
    """Refuse to make images of a dataset whose ``dataset.json``, at ``path``, records a denoiser that is gone.

    Raises:
        DatasetError: it does.
    """
    rendered = header["recipe"].get("render", {})
    if rendered.get("denoiser") == "guided" and "detail_share" not in rendered:
        raise DatasetError(
            f"{path}: was begun with an earlier guided denoiser, which is gone: none of its images can be rendered "
            "again, or added to; use another output folder"
        )


def make_folder(root: Path) -> None:
    """Make the folder of a dataset that is to be begun.

    Raises:
        DatasetError: it cannot be made, or holds files of something else.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        strangers = sorted(path.name for path in root.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise DatasetError(f"{root}: cannot be used as output folder ({error.strerror})") from None
    if strangers:
        raise DatasetError(
            f"{root}: holds {strangers[0]}, but no {DATASET_FILE}; give an empty folder, or one that generate began"
        )


def _refuse_other(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Continue only what would come out the same had it never been interrupted."""
    for key in ("versions", "models_sha256", "textures_sha256", "scenery_digest"):
        if before.get(key) != now.get(key):
            raise DatasetError(f"{path}: was begun with other {key} than now; use another output folder")
    old, new = _flat(before["recipe"]), _flat(now["recipe"])
    changed = [
        key
        for key in sorted(old.keys() | new.keys())
        if key.split(".", maxsplit=1)[0] not in _MAY_CHANGE and old.get(key) != new.get(key)
    ]
    if changed:
        told = ", ".join(f"{key} = {old.get(key)}, now it is {new.get(key)}" for key in changed[:_TOLD])
        more = f" (and {len(changed) - _TOLD} more)" if len(changed) > _TOLD else ""
        raise DatasetError(f"{path}: was begun with {told}{more}; use another output folder, or what it was begun with")


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        leaves |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return leaves
