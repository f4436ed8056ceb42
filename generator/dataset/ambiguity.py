"""Which nearly symmetrical poses each image cannot tell apart: scene_gt_ambiguity.json beside the labels.

Made from recorded poses and ray casting alone, of datasets that ``generate`` made and of those that ``adopt`` labelled.
AMBIGUITY_FILE says what the files of the scene folders are of. While they are made it is a hidden file: where a process
was killed meanwhile, the next call goes on with the folders that lack theirs.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import Plane, PosedSurface, RayCaster
from synthetless.annotation.scene import MM_PER_M, container_surfaces, model_to_camera, scene_caster
from synthetless.config import models_folder
from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import (
    AMBIGUITY_FILE,
    DATASET_FILE,
    PENDING_AMBIGUITY_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    scene_folders,
)
from synthetless.dataset.reader import Image, Scene, digest, intrinsics_of, read_recipe, read_specs
from synthetless.dataset.records import AmbiguityEntry, ImageSpec
from synthetless.dataset.relabel import adopt, relabel
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io.files import locked, read_bytes, read_json, remove_file, replace_file, write_json
from synthetless.io.models import ObjectModel, load_models, read_models_info
from synthetless.io.parallel import each
from synthetless.scenes.spec import Intrinsics, Role
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.ambiguity import MIN_PIXELS, Ambiguity, Cosets, Resolution, What, see
from synthetless.symmetry.table import QuasiSymmetry, SymmetryEntry

_IMAGES_A_TASK = 25
_POSE_SAMPLES = 72
_PICTURES = ("rgb", "gray", "depth")

Entries = dict[int, list[AmbiguityEntry | None]]


@dataclass(frozen=True)
class ObjectAmbiguity:
    """How often the images show that an object is not as symmetrical as its quasi-symmetry group.

    Attributes:
        obj_id: the object.
        group, quasi: names of its groups.
        instances: all of them.
        certain: those whose image shows which coset the pose is of.
        mean_view_ambiguity: mean share of the cosets that the image cannot tell from the true one.
    """

    obj_id: int
    group: str
    quasi: str
    instances: int
    certain: int
    mean_view_ambiguity: float

    def __str__(self) -> str:
        share = 100 * self.certain / self.instances
        return (
            f"object {self.obj_id}: {self.group} in {self.quasi}; the detail that separates them is visible in "
            f"{self.certain} of {self.instances} views ({share:.0f} %), mean view ambiguity "
            f"{self.mean_view_ambiguity:.2f}"
        )


@dataclass(frozen=True)
class AmbiguitySummary:
    """What ``write_ambiguity`` found.

    Attributes:
        images: looked at.
        scenes, made: scene folders, and those that were made now; the others were there.
        objects: those with a quasi-symmetry group that occur.
    """

    images: int
    scenes: int
    made: int
    objects: tuple[ObjectAmbiguity, ...]

    def __str__(self) -> str:
        head = f"{self.images} images; {self.made} of {self.scenes} scene folders made, the others were there"
        return "\n".join([head, *map(str, self.objects)])


def write_ambiguity(
    root: Path,
    what: What = "depth",
    eps_mm: float | None = None,
    models: Path | None = None,
    with_poses: bool = False,
    workers: int | None = None,
    symmetries: Path | None = None,
) -> AmbiguitySummary:
    """Put scene_gt_ambiguity.json into every scene folder of a labelled dataset.

    Args:
        root: the dataset's folder, with a symmetries.json that names a quasi-symmetry group of at least one object.
        what: what of the images is compared.
        eps_mm: depths that differ by more are told apart; None for what one pixel measures at the object.
        models: folder of the meshes, if they are not in the dataset.
        with_poses: also write the poses that look alike themselves.
        workers: processes; one per available core if None. They are spawned.
        symmetries: a symmetry table, which may lack objects, whose quasi-symmetry groups are put into symmetries.json:
            an entry's ``quasi``, or its group, where it has none. Labels stay as they are.

    Raises:
        UserError: there are no labels or no quasi-symmetry group, a mesh or an image's size cannot be found, or the
            dataset is damaged or cannot be written; the table is invalid, of other objects or of another exact group.
    """
    if symmetries is not None:
        table = _with_quasi_symmetries(root, symmetries)
        AmbiguitySource.read(root, what, eps_mm, models, with_poses, table).header(_scenes(root))  # may refuse it
        _put_symmetries(root, table, models, workers)
    source = AmbiguitySource.read(root, what, eps_mm, models, with_poses)
    scenes = _scenes(root)
    with locked(root):
        refuse_half_labelled(root)
        header = source.header(scenes)
        wanted = _unfinished(root, header, scenes)
        write_json(root / PENDING_AMBIGUITY_FILE, header)
        remove_file(root / AMBIGUITY_FILE)
        tasks = [task for paths in wanted for task in _tasks(source, paths)]
        results = zip(tasks, each(_see_images, tasks, workers, "ambiguity", "part"), strict=True)
        for paths, parts in groupby(results, key=lambda result: result[0].paths):
            entries = {im_id: of_image for _, part in parts for im_id, of_image in part.items()}
            write_json(paths.scene_gt_ambiguity, {str(im_id): entries[im_id] for im_id in sorted(entries)})
        replace_file(root / PENDING_AMBIGUITY_FILE, root / AMBIGUITY_FILE)
    return _summary(source, scenes, len(wanted))


def _with_quasi_symmetries(root: Path, symmetries: Path) -> SymmetryTable:
    """A dataset's symmetry table with the quasi-symmetry groups of another one: an entry's ``quasi``, or its group."""
    table = _symmetries(root)
    entries = dict(table.entries)
    for obj_id, given in SymmetryTable.read(symmetries).entries.items():
        if obj_id not in entries:
            known = ", ".join(map(str, entries))
            raise UserError(f"{symmetries}: object {obj_id} is none of the dataset's objects {known}")
        try:
            entries[obj_id] = _with_quasi(entries[obj_id], given)
        except UserError as error:
            raise UserError(f"{symmetries}: object {obj_id}: {error}") from None
    return replace(table, entries=entries)


def _put_symmetries(root: Path, table: SymmetryTable, models: Path | None, workers: int | None) -> None:
    """Make a table of the same exact groups the dataset's. Labels are those of the exact groups, so they stay."""
    if table.digest() == _symmetries(root).digest():
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / SYMMETRIES_FILE
        table.write(path)
        if (root / DATASET_FILE).exists():
            relabel(root, path, workers=workers)
        else:
            adopt(root, models, path, workers=workers)


def _with_quasi(entry: SymmetryEntry, given: SymmetryEntry) -> SymmetryEntry:
    is_same = entry.group.contains(given.group) and given.group.contains(entry.group)
    if given.quasi is None:
        return entry if is_same else replace(entry, quasi=QuasiSymmetry(given.group))
    if not is_same:
        raise UserError(
            f"the group is {given.group.name}, but the labels are of {entry.group.name}: relabel first, or leave the "
            "group as it is"
        )
    return replace(entry, quasi=given.quasi)


def _symmetries(root: Path) -> SymmetryTable:
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; give that of a dataset")
    if not (root / SYMMETRIES_FILE).exists():
        raise UserError(f"{root}: holds no {SYMMETRIES_FILE}; adopt labels a BOP dataset and writes it")
    return SymmetryTable.read(root / SYMMETRIES_FILE)


@dataclass(frozen=True, eq=False)
class AmbiguitySource:
    """What all images are judged by; travels to the worker processes.

    Attributes:
        root: the dataset's folder.
        table: symmetries.json.
        resolution: what is compared.
        with_poses: whether the poses are written, too.
        meshes: folder and object ids of the meshes, by role.
        digests: SHA-256 of the labelled meshes by object id.
        size: columns and rows of all images; None where each scene folder says so.
        table_half_mm: half the side of the table; None where there is none.
    """

    root: Path
    table: SymmetryTable
    resolution: Resolution
    with_poses: bool
    meshes: tuple[tuple[Role, Path, tuple[int, ...]], ...]
    digests: Mapping[int, str] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    table_half_mm: float | None = None

    @classmethod
    def read(
        cls,
        root: Path,
        what: What = "depth",
        eps_mm: float | None = None,
        models: Path | None = None,
        with_poses: bool = False,
        table: SymmetryTable | None = None,
    ) -> AmbiguitySource:
        """Find everything that a dataset's images are judged by; errors as in ``write_ambiguity``."""
        table = table or _symmetries(root)
        if not any(entry.quasi for entry in table.entries.values()):
            raise UserError(
                f"{root / SYMMETRIES_FILE}: no object has a quasi-symmetry group; give a table that names one by "
                "--symmetries, such as 'object 14: {group: C1, quasi: {group: SO(2), axis: [0, 0, 1]}}'"
            )
        resolution = Resolution(what, eps_mm)
        folder = models or find_models_folder(root)
        obj_ids = _occurring(root)
        if missing := sorted(set(obj_ids) - read_models_info(folder).keys()):
            raise UserError(f"{folder}: has no object {missing[0]}, which occurs in the dataset")
        digests = {obj_id: model.digest for obj_id, model in load_models(folder, obj_ids).items()}
        meshes: list[tuple[Role, Path, tuple[int, ...]]] = [("model", folder, obj_ids)]
        if not (root / DATASET_FILE).exists():
            return cls(root, table, resolution, with_poses, tuple(meshes), digests)
        recipe = read_recipe(root)
        if recipe.source.distractors is not None and recipe.objects.distractors[1] > 0:
            others = models_folder(recipe.source.distractors)
            meshes.append(("distractor", others, tuple(read_models_info(others))))
        size = recipe.camera.width, recipe.camera.height
        half_mm = recipe.table.size_m * MM_PER_M / 2
        return cls(root, table, resolution, with_poses, tuple(meshes), digests, size, half_mm)

    def header(self, scenes: Sequence[ScenePaths]) -> dict[str, Any]:
        """Content of AMBIGUITY_FILE for these scene folders."""
        objects = {}
        for obj_id, entry in self.table.entries.items():
            if entry.quasi is not None and obj_id in self.digests:
                cosets = self.cosets(obj_id)
                objects[str(obj_id)] = {
                    "group": entry.group.name,
                    "quasi": entry.quasi.group.name,
                    "offset_mm": list(entry.quasi.group.offset_mm),
                    "cosets_wxyz": cosets.representatives_wxyz.tolist(),
                }
        return {
            "what": self.resolution.what,
            "eps_mm": self.resolution.eps_mm,
            "min_pixels": MIN_PIXELS,
            "poses": self.with_poses,
            "depth_images": self.size is None and any(map(_has_depth, scenes)),
            "symmetries": self.table.digest(),
            "models": {str(obj_id): digest for obj_id, digest in self.digests.items()},
            "objects": objects,
            "scenes": {paths.name: digest(paths) for paths in scenes},
        }

    def cosets(self, obj_id: int) -> Cosets:
        """Of an object with a quasi-symmetry group.

        Raises:
            UserError: it cannot be sampled; with the object.
        """
        entry = self.table.entries[obj_id]
        assert entry.quasi is not None
        try:
            return Cosets.of(entry.quasi.group, entry.group)
        except UserError as error:
            raise UserError(f"{self.root / SYMMETRIES_FILE}: object {obj_id}: {error}") from None


# Files


def _scenes(root: Path) -> list[ScenePaths]:
    scenes = scene_folders(root, ("scene_gt.json",))
    if not scenes:
        raise UserError(f"{root}: holds no ground truth of a BOP dataset, such as test_primesense/000001/scene_gt.json")
    return scenes


def _occurring(root: Path) -> tuple[int, ...]:
    found = [np.unique(Scene.read(paths).poses.obj_ids).tolist() for paths in _scenes(root)]
    return tuple(sorted({obj_id for of_scene in found for obj_id in of_scene}))


def _unfinished(root: Path, header: Mapping[str, Any], scenes: Sequence[ScenePaths]) -> list[ScenePaths]:
    """The scene folders that lack their file; those of files that are of something else are removed first."""
    before: Mapping[str, Any] = {}
    for name in (PENDING_AMBIGUITY_FILE, AMBIGUITY_FILE):
        if (root / name).exists():
            before = read_json(root / name)
            break
    same = {**before, "scenes": None} == {**json.loads(json.dumps(header)), "scenes": None}
    stated = before.get("scenes", {}) if same else {}
    for paths in scenes:
        if stated.get(paths.name) != header["scenes"][paths.name]:
            remove_file(paths.scene_gt_ambiguity)
    return [paths for paths in scenes if not paths.scene_gt_ambiguity.exists()]


# Images


@dataclass(frozen=True, eq=False)
class _Task:
    """Some images of a scene folder, on their way to a worker process."""

    source: AmbiguitySource
    paths: ScenePaths
    numbers: tuple[int, ...]


def _tasks(source: AmbiguitySource, paths: ScenePaths) -> list[_Task]:
    numbers = range(len(Scene.read(paths)))
    starts = range(0, max(1, len(numbers)), _IMAGES_A_TASK)
    return [_Task(source, paths, tuple(numbers[start : start + _IMAGES_A_TASK])) for start in starts]


def _see_images(task: _Task) -> Entries:
    scene = Scene.read(task.paths)
    return dict(
        zip(
            [int(scene.poses.image_ids[number]) for number in task.numbers],
            see_images(task.source, scene, task.numbers),
            strict=True,
        )
    )


def see_images(source: AmbiguitySource, scene: Scene, numbers: Sequence[int]) -> Iterator[list[AmbiguityEntry | None]]:
    """The entries of scene_gt_ambiguity.json of some images of a scene folder.

    Args:
        source: of the dataset.
        scene: the folder.
        numbers: of the images in it, counted from 0.

    Raises:
        UserError: a pose is damaged, or the image's size or a mesh cannot be found.
    """
    specs = read_specs(scene.paths)
    size = source.size or _picture_size(source.root, scene.paths)
    poses = scene.poses
    for number in numbers:
        first, end = int(poses.first[number]), int(poses.first[number + 1])
        bodies = [PosedModel(int(poses.obj_ids[i]), poses.R_m2c[i], poses.t_m2c[i]) for i in range(first, end)]
        quasi = [source.table.entries[body.obj_id].quasi is not None for body in bodies]
        if not any(quasi):
            yield [None] * len(bodies)
            continue
        camera = intrinsics_of(poses.cameras[number], poses.lenses[number], *size)
        plane, unlabelled = _surroundings(source, scene, number, specs.get(int(poses.image_ids[number])))
        depth_mm = _depth_image(source, scene.image(number), size)
        yield [
            _entry(source, camera, body, [*bodies[:i], *bodies[i + 1 :], *unlabelled], plane, depth_mm)
            if quasi[i]
            else None
            for i, body in enumerate(bodies)
        ]


def _has_depth(paths: ScenePaths) -> bool:
    return next((paths.root / "depth").glob("*.png"), None) is not None


def _depth_image(source: AmbiguitySource, image: Image, size: tuple[int, int]) -> np.ndarray[Any, Any] | None:
    """What hides in an image of others, if it has depth; of ours everything is recorded."""
    if source.size is not None or not image.paths.depth(image.im_id).exists():
        return None
    depth_mm = image.depth_mm()
    if depth_mm.shape != size[::-1]:
        path, (rows, columns) = image.paths.depth(image.im_id), depth_mm.shape
        raise UserError(f"{path}: is {columns} x {rows} pixels large; the images are {size[0]} x {size[1]}")
    return depth_mm


def _surroundings(
    source: AmbiguitySource, scene: Scene, number: int, spec: ImageSpec | None
) -> tuple[Plane | None, list[PosedModel | PosedSurface]]:
    """The table, the distractors and the container of an image of ours; of other images none is known."""
    if source.table_half_mm is None or scene.R_w2c is None or scene.t_w2c is None:
        return None, []
    R_w2c, t_w2c = scene.R_w2c[number], scene.t_w2c[number]
    unlabelled: list[PosedModel | PosedSurface] = []
    if spec is not None:
        unlabelled = [
            PosedModel(item.obj_id, *model_to_camera(pose, R_w2c, t_w2c), item.role)
            for item, pose in zip(spec.scene.objects, spec.settled, strict=True)
            if item.role != "model"
        ]
        unlabelled += container_surfaces(_caster(source.meshes), spec.scene, R_w2c, t_w2c)
    return Plane(R_w2c, t_w2c, source.table_half_mm), unlabelled


def _entry(
    source: AmbiguitySource,
    camera: Intrinsics,
    body: PosedModel,
    others: list[PosedModel | PosedSurface],
    plane: Plane | None,
    depth_mm: np.ndarray[Any, Any] | None,
) -> AmbiguityEntry:
    table, entry = source.table, source.table.entries[body.obj_id]
    canonical_map = table.quasi_map(body.obj_id)
    canonical = canonical_map(body.R_m2c[None], body.t_m2c[None])
    cosets = source.cosets(body.obj_id)
    R_canonical = canonical.R_m2c[0]
    caster, resolution = _caster(source.meshes), source.resolution
    seen = see(caster, camera, body, R_canonical, cosets, others, plane, resolution, depth_mm)
    result: AmbiguityEntry = {
        "obj_id": body.obj_id,
        "cam_R_m2c_quasi": R_canonical.reshape(9).tolist(),
        "cam_t_m2c_quasi": canonical.t_m2c[0].tolist(),
        "quasi_index": int(canonical.regressor_index[0]),
        "n_quasi_indices": canonical.n_regressors,
        "n_cosets": len(cosets),
        "coset_true": seen.coset_true,
        "cosets_alike": seen.alike.tolist(),
        "pixels_apart": seen.pixels_apart.tolist(),
        "view_ambiguity": seen.view_ambiguity,
        "eps_mm": seen.eps_mm,
    }
    if source.with_poses:
        result["poses_alike"] = _poses(seen, entry.group.motions(_POSE_SAMPLES))
    return result


def _poses(seen: Ambiguity, motions: np.ndarray[Any, np.dtype[np.float64]]) -> list[list[float]]:
    """The poses of A(P), each as 9 and 3 numbers: of each coset one, turned by every element of the exact group."""
    R, t = seen.R_m2c[seen.alike], seen.t_m2c[seen.alike]
    rotations = R[:, None] @ motions[None, :, :3, :3]
    translations = t[:, None] + np.einsum("nij,mj->nmi", R, motions[:, :3, 3])
    rows: list[list[float]] = np.concatenate([rotations.reshape(-1, 9), translations.reshape(-1, 3)], axis=1).tolist()
    return rows


@lru_cache(maxsize=1)
def _caster(meshes: tuple[tuple[Role, Path, tuple[int, ...]], ...]) -> RayCaster:
    """The ray caster of a process; its trees are built once."""
    models: dict[Role, Mapping[int, ObjectModel]] = {role: load_models(folder, ids) for role, folder, ids in meshes}
    return scene_caster(models)


def _picture_size(root: Path, paths: ScenePaths) -> tuple[int, int]:
    """Columns and rows of the images of a scene folder, from its first picture or camera.json."""
    for folder in _PICTURES:
        for path in sorted((paths.root / folder).glob("*.*"))[:1]:
            picture = cv2.imdecode(np.frombuffer(read_bytes(path) or b"0", np.uint8), cv2.IMREAD_UNCHANGED)
            if picture is None:
                raise UserError(f"{path}: cannot be read, so the images' size is not known")
            return picture.shape[1], picture.shape[0]
    for path in sorted(root.glob("camera*.json")):
        content = read_json(path)
        if isinstance(content.get("width"), int) and isinstance(content.get("height"), int):
            return content["width"], content["height"]
    raise UserError(
        f"{paths.root}: holds no picture, and {root} no camera.json that tells the images' width and height"
    )


# The summary


def _summary(source: AmbiguitySource, scenes: Sequence[ScenePaths], made: int) -> AmbiguitySummary:
    instances: Counter[int] = Counter()
    certain: Counter[int] = Counter()
    ambiguity: Counter[int] = Counter()
    images = 0
    for paths in scenes:
        content = read_json(paths.scene_gt_ambiguity)
        images += len(content)
        for entry in (entry for entries in content.values() for entry in entries if entry is not None):
            obj_id = entry["obj_id"]
            instances[obj_id] += 1
            certain[obj_id] += len(entry["cosets_alike"]) == 1
            ambiguity[obj_id] += entry["view_ambiguity"]
    objects = []
    for obj_id, count in sorted(instances.items()):
        entry = source.table.entries[obj_id]
        assert entry.quasi is not None
        names = entry.group.name, entry.quasi.group.name
        objects.append(ObjectAmbiguity(obj_id, *names, count, certain[obj_id], ambiguity[obj_id] / count))
    return AmbiguitySummary(images, len(scenes), made, tuple(objects))
