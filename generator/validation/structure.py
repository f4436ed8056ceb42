"""What a dataset consists of: dataset.json, camera.json, models, symmetries, scene folders and the files in them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from synthetless.config import Recipe, models_folder
from synthetless.dataset.labels import is_half_labelled
from synthetless.dataset.layout import (
    CAMERA_FILE,
    DATASET_FILE,
    MODELS_FOLDER,
    RECORDS_FOLDER,
    SYMMETRIES_FILE,
    ImagePlan,
    ScenePaths,
    plan_image,
)
from synthetless.dataset.records import CameraFile, Count, ModelEntry, ModelInfo, camera_json, schema_faults
from synthetless.io.files import read_bytes, read_json
from synthetless.io.models import INFO_FILE, NAMES_FILE, ObjectModel, load_models, read_models_info, texture_file
from synthetless.scenes.spec import Role
from synthetless.symmetry import SymmetryGroup, SymmetryTable
from synthetless.validation.records import SceneRecords
from synthetless.validation.report import Finding, bare, unusable

_TOLERANCE_MM, _TOLERANCE = 0.5, 0.01
"""BOP's boxes and diameters are rounded, some are of a simplified mesh: so much, and this share, they may be off."""
_IDS = re.compile(r"(\d{6})(?:_(\d{6}))?\.\w+")

Place = tuple[int | None, int | None]


class Counts(BaseModel):
    """Totals in dataset.json."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)
    images: Count
    instances: Count


class SymmetriesDigest(BaseModel):
    """Which symmetries the labels are of, in dataset.json."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)
    scheme: str
    sha256: Annotated[str, Field(min_length=64, max_length=64)]


class Header(BaseModel):
    """dataset.json; other keys than these may be there, too."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    name: str
    recipe: Recipe
    versions: dict[str, str]
    models_sha256: dict[int, str]
    textures_sha256: dict[int, str] = {}
    scenery_digest: str
    licence: str
    counts: Counts
    symmetries: SymmetriesDigest


@dataclass(frozen=True)
class MeshSet:
    """Meshes to cast rays at; equal sets hold equal meshes.

    Attributes:
        role: of the models in the scenes.
        folder: a models folder.
        digests: object id and SHA-256 of each PLY file.
    """

    role: Role
    folder: Path
    digests: tuple[tuple[int, str], ...]

    @classmethod
    def of(cls, role: Role, folder: Path, models: Mapping[int, ObjectModel]) -> MeshSet:
        """The set of these models of a folder."""
        return cls(role, folder, tuple((obj_id, model.digest) for obj_id, model in models.items()))


@dataclass(frozen=True, eq=False)
class Source:
    """What every scene is held against; travels to the worker processes.

    Attributes:
        root: the dataset's folder.
        recipe: what was made.
        infos: entries of models_info.json by object id, of the right form.
        obj_ids: of all its entries.
        meshes: those that the dataset was made of, as far as they can be read.
        symmetries: symmetries.json; None if it cannot be read.
    """

    root: Path
    recipe: Recipe
    infos: Mapping[int, ModelInfo]
    obj_ids: frozenset[int]
    meshes: tuple[MeshSet, ...]
    symmetries: Path | None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every picture."""
        return self.recipe.camera.height, self.recipe.camera.width

    def scene(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.recipe.split)

    def has(self, output: str) -> bool:
        """Whether the recipe asks for files of this kind."""
        return output in self.recipe.outputs


def read_header(root: Path) -> tuple[Header | None, list[Finding]]:
    """dataset.json, without which nothing else can be judged."""
    path = root / DATASET_FILE
    if not path.exists():
        return None, [Finding("missing", path, "not there; generate writes it, and nothing can be judged without it")]
    try:
        return Header.model_validate(read_json(path)), []
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, fault['loc']))}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
            for fault in error.errors(include_url=False)
        ]
        return None, [Finding("schema", path, fault) for fault in faults]
    except ValueError as error:
        return None, [Finding("unreadable", path, bare(error, path))]


def read_source(root: Path, header: Header) -> tuple[Source, list[Finding]]:
    """Read and check everything outside the scene folders."""
    findings: list[Finding] = []
    folder = root / MODELS_FOLDER
    infos, obj_ids, faults = read_infos(folder / INFO_FILE, declared=True)
    findings += faults
    models = _read_models(folder, infos, header.models_sha256, header.textures_sha256, findings)
    for obj_id in sorted(obj_ids ^ header.models_sha256.keys()) if obj_ids else ():
        there = "an entry" if obj_id in obj_ids else "no entry"
        message = f"has {there} for object {obj_id}; {DATASET_FILE} says otherwise"
        findings.append(Finding("models", folder / INFO_FILE, message))
    findings += _check_camera_file(root / CAMERA_FILE, header.recipe)
    table = read_table(root, infos, findings)
    if table is not None:
        findings += _check_digest(root / SYMMETRIES_FILE, table, header.symmetries)
    meshes = (MeshSet.of("model", folder, models), *_distractors(header.recipe))
    symmetries = root / SYMMETRIES_FILE if table else None
    return Source(root, header.recipe, infos, obj_ids, meshes, symmetries), findings


def plans_by_scene(recipe: Recipe) -> dict[int, list[ImagePlan]]:
    """Every image that the recipe asks for, by scene folder."""
    plans: dict[int, list[ImagePlan]] = {}
    for number in range(recipe.images):
        plan = plan_image(number, recipe.camera.views_per_drop)
        plans.setdefault(plan.scene_id, []).append(plan)
    return plans


def check_folders(root: Path, recipe: Recipe, scenes: Sequence[int]) -> Iterator[Finding]:
    """Scene folders that are missing or foreign, leftovers of interrupted writing, and the marker of a relabelling."""
    if is_half_labelled(root):
        message = "the dataset is half relabelled: relabel was killed while the files took their places; run it again"
        yield Finding("stale", root / SYMMETRIES_FILE, message)
    for path in sorted(root.glob(".*.part")):
        yield Finding("stray", path, "left over from an interrupted write; it can be deleted")
    expected = {f"{scene_id:06d}" for scene_id in scenes}
    split, recorded = _names(root / recipe.split), _names(root / RECORDS_FOLDER)
    for name in sorted(expected - split):
        path = root / recipe.split / name
        yield Finding("missing", path, f"no such scene folder; the recipe's {recipe.images} images need it")
    for folder, found in ((recipe.split, split), (RECORDS_FOLDER, recorded)):
        for name in sorted(found - expected):
            yield Finding("stray", root / folder / name, f"belongs to none of the recipe's {recipe.images} images")


def check_counts(root: Path, header: Header, images: int, instances: int) -> Iterator[Finding]:
    """dataset.json's totals against what the scene folders hold."""
    for name, stated, found in (
        ("images", header.counts.images, images),
        ("instances", header.counts.instances, instances),
    ):
        if stated != found:
            yield Finding("counts", root / DATASET_FILE, f"counts {stated} {name}; the scene folders hold {found}")


# Models


def read_infos(path: Path, declared: bool) -> tuple[dict[int, ModelInfo], frozenset[int], list[Finding]]:
    """models_info.json: its entries of the right form, the ids of all its entries, and what is wrong with it.

    Args:
        path: of the file.
        declared: whether the symmetries that it declares must be groups; adopt may have been told others.
    """
    try:
        infos = read_models_info(path.parent)
    except ValueError as error:
        return {}, frozenset(), [unusable(path, error)]
    good: dict[int, ModelInfo] = {}
    findings: list[Finding] = []
    for obj_id, info in infos.items():
        bad = [
            Finding("schema", path, f"object {obj_id}: {fault.message}") for fault in schema_faults(ModelEntry, info)
        ]
        findings += bad or (_check_declared(path, obj_id, info) if declared else [])
        if not bad:
            good[obj_id] = info
    return good, frozenset(infos), findings


def _check_declared(path: Path, obj_id: int, info: ModelInfo) -> list[Finding]:
    """BOP's readers take an object's symmetries from models_info.json."""
    try:
        SymmetryGroup.from_bop(info)
    except (ValueError, TypeError, KeyError) as error:
        return [Finding("models", path, f"object {obj_id}: its symmetries are no rotation group ({error})")]
    return []


def _read_models(
    folder: Path,
    infos: Mapping[int, ModelInfo],
    digests: Mapping[int, str],
    textures: Mapping[int, str],
    findings: list[Finding],
) -> dict[int, ObjectModel]:
    """The models that the dataset was made of.

    Args:
        folder: to read and check.
        infos: the good entries of its models_info.json.
        digests: SHA-256 of the PLY files that the dataset was made of.
        textures: SHA-256 of their textures.
        findings: gets what is wrong.
    """
    path = folder / INFO_FILE
    models: dict[int, ObjectModel] = {}
    known = {path, folder / NAMES_FILE}
    for obj_id, digest in sorted(textures.items()):
        texture = folder / texture_file(obj_id)
        known.add(texture)
        if not texture.exists():
            findings.append(Finding("missing", texture, "not there; dataset.json names it"))
        elif hashlib.sha256(read_bytes(texture)).hexdigest() != digest:
            findings.append(Finding("models", texture, "is not the texture that the dataset was made of"))
    for obj_id, digest in sorted(digests.items()):
        mesh = folder / f"obj_{obj_id:06d}.ply"
        known.add(mesh)
        if not mesh.exists():
            findings.append(Finding("missing", mesh, "not there; dataset.json names it"))
            continue
        found = hashlib.sha256(read_bytes(mesh)).hexdigest()
        if found != digest:
            message = f"has SHA-256 {found[:12]}...; the dataset was made of {digest[:12]}..."
            findings.append(Finding("models", mesh, message))
        if obj_id in infos:
            try:
                model = load_models(folder, (obj_id,))[obj_id]
            except ValueError as error:
                findings.append(Finding("models", mesh, bare(error, mesh)))
                continue
            findings += _check_info(path, model)
            if found == digest:
                models[obj_id] = model
    for stray in sorted(set(folder.iterdir()) - known) if folder.is_dir() else ():
        findings.append(Finding("stray", stray, "is none of the models that dataset.json names"))
    return models


def _check_info(path: Path, model: ObjectModel) -> Iterator[Finding]:
    """Box and diameter of an object against its mesh."""
    low_mm, size = model.vertices_mm.min(axis=0), np.ptp(model.vertices_mm, axis=0)
    tolerance = _TOLERANCE_MM + _TOLERANCE * size.max()
    measured = {f"min_{axis}": value for axis, value in zip("xyz", low_mm, strict=True)}
    measured |= {f"size_{axis}": value for axis, value in zip("xyz", size, strict=True)}
    for key, value in measured.items():
        if not abs(model.info[key] - value) <= tolerance:
            message = f"object {model.obj_id} has {key} {model.info[key]}; its mesh has {value:.3f} mm"
            yield Finding("models", path, message)
    smallest, largest = float(size.max()), float(np.linalg.norm(size))
    if not smallest - tolerance <= model.diameter_mm <= largest + tolerance:
        allowed = f"its mesh allows {smallest:.3f} to {largest:.3f} mm"
        yield Finding("models", path, f"object {model.obj_id} has diameter {model.diameter_mm}; {allowed}")


def _distractors(recipe: Recipe) -> list[MeshSet]:
    """The distractors' meshes, if they are still where the recipe has them."""
    source = recipe.source.distractors
    if source is None or recipe.objects.distractors[1] == 0:
        return []
    try:
        return [MeshSet.of("distractor", models_folder(source), load_models(models_folder(source)))]
    except ValueError:  # that images cannot be recomputed is told
        return []


# camera.json and symmetries.json


def _check_camera_file(path: Path, recipe: Recipe) -> Iterator[Finding]:
    if not path.exists():
        yield Finding("missing", path, "not there; BOP's readers need it")
        return
    try:
        content = read_json(path)
    except ValueError as error:
        yield Finding("unreadable", path, bare(error, path))
        return
    bad = [Finding("schema", path, fault.message) for fault in schema_faults(CameraFile, content)]
    yield from bad
    if not bad:
        for key, value in camera_json(recipe.intrinsics, recipe.encoding.depth_scale).items():
            if content.get(key) != value:
                yield Finding("camera", path, f"{key} is {content.get(key)}; the recipe has {value}")


def read_table(root: Path, obj_ids: Collection[int], findings: list[Finding]) -> SymmetryTable | None:
    """symmetries.json; None if it cannot be used. ``findings`` gets why, and which of these objects it lacks."""
    path = root / SYMMETRIES_FILE
    if not path.exists():
        findings.append(Finding("missing", path, "not there; without it the labels have no meaning"))
        return None
    try:
        table = SymmetryTable.read(path)
    except ValueError as error:
        findings.append(Finding("symmetries", path, bare(error, path)))
        return None
    missing = sorted(set(obj_ids) - table.entries.keys())
    if missing:
        findings.append(Finding("symmetries", path, f"has no entry for object {', '.join(map(str, missing))}"))
    return table


def _check_digest(path: Path, table: SymmetryTable, stated: SymmetriesDigest) -> Iterator[Finding]:
    if table.digest() != stated.sha256:
        message = (
            f"is not what {DATASET_FILE} says the labels were made with (SHA-256 {table.digest()[:12]}..., "
            f"there {stated.sha256[:12]}...): it was edited since; run relabel"
        )
        yield Finding("stale", path, message)
    if table.scheme != stated.scheme:
        yield Finding("stale", path, f"has the scheme {table.scheme}, {DATASET_FILE} {stated.scheme}")


# The files of a scene folder


def check_files(source: Source, scene: SceneRecords) -> Iterator[Finding]:
    """Images and masks that are missing, and files that belong to no image."""
    paths, folders = scene.paths, _expected_files(source, scene)
    for path in sorted(paths.root.iterdir()):
        if path not in scene.json_files and path not in folders:
            yield Finding("stray", path, f"the recipe's outputs ({', '.join(source.recipe.outputs)}) have no such file")
    if not scene.is_readable(paths.scene_gt):  # told already, and what should be there is unknown
        return
    malformed = scene.malformed(paths.scene_gt)
    for folder, expected in folders.items():
        found = _names(folder)
        for name in sorted(expected.keys() - found):
            yield Finding("missing", folder / name, "not there", *expected[name])
        for name in sorted(found - expected.keys()):
            place = place_of(name)
            if place[0] is None or place[0] not in malformed:
                yield Finding("stray", folder / name, "belongs to no instance in scene_gt.json", *place)


def _expected_files(source: Source, scene: SceneRecords) -> dict[Path, dict[str, Place]]:
    """Names, images and instances of the files that each folder should hold."""
    paths, extension = scene.paths, source.recipe.encoding.rgb_format
    per_image = {
        "rgb": lambda im_id: paths.rgb(im_id, extension),
        "depth": paths.depth,
        "depth_sensed": paths.depth_sensed,
        "normals": paths.normals,
        "object_coordinates": paths.object_coordinates,
        "exr": paths.exr,
    }
    folders: dict[Path, dict[str, Place]] = {
        paths.root / output: {path_of(im_id).name: (im_id, None) for im_id in scene.gt}
        for output, path_of in per_image.items()
        if source.has(output)
    }
    for path_of_mask in (paths.mask, paths.mask_visib) if source.has("masks") else ():
        folders[path_of_mask(0, 0).parent] = {
            path_of_mask(im_id, gt_id).name: (im_id, gt_id)
            for im_id, gt in scene.gt.items()
            for gt_id in range(len(gt))
        }
    return folders


def place_of(name: str) -> Place:
    """Image and instance that a file name speaks of."""
    matched = _IDS.fullmatch(name)
    if matched is None:
        return None, None
    return int(matched[1]), None if matched[2] is None else int(matched[2])


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()
