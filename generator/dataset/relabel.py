"""Other symmetries or another scheme for datasets that are made already: new labels, the images untouched.

``relabel`` is for datasets that ``generate`` made, ``adopt`` for BOP datasets that others made. Both compute every
label before the first file is replaced. While files are replaced, PENDING_FILE holds the table that the labels are
changing to; renamed to symmetries.json, last of all, it says that they are of it. Where a process was killed meanwhile,
readers refuse the folder, and the next call labels all of it again from its poses.
"""

from __future__ import annotations

import gc
import json
import os
import shutil
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.labels import (
    LabelState,
    describe_symmetries,
    is_half_labelled,
    label_scene,
    refuse_half_labelled,
)
from synthetless.dataset.layout import (
    DATASET_FILE,
    DRAFT_FOLDER,
    MODELS_FOLDER,
    PENDING_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    other_sensors,
    scene_folders,
)
from synthetless.dataset.reader import as_floats, read_recipe
from synthetless.dataset.records import (
    CanonicalEntry,
    ForeignCameraEntry,
    ForeignGtEntry,
    GtEntry,
    ModelEntry,
    ModelInfo,
    read_scene_json,
    schema_faults,
)
from synthetless.errors import UserError
from synthetless.io.documents import read_document
from synthetless.io.files import atomic_write, json_bytes, locked, read_bytes, read_json, replace_file, write_json
from synthetless.io.models import INFO_FILE, read_models_info
from synthetless.io.parallel import each
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.atlas import Scheme
from synthetless.symmetry.canonical import FULL_DECIMALS, stored_decimals
from synthetless.symmetry.table import TABLE_KEYS

_SCENE_FILES = ("scene_camera.json", "scene_gt.json", "scene_gt_canonical.json")
Labels = dict[int, list[CanonicalEntry]]


@dataclass(frozen=True)
class LabelDiff:
    """How labels of one object differ from those there were.

    Attributes:
        instances: all of them.
        changed: those whose label differs, or that had none.
        index_changed: those that another regressor learns.
        max_rotation_deg: the largest angle between canonical rotations before and after.
    """

    instances: int = 0
    changed: int = 0
    index_changed: int = 0
    max_rotation_deg: float = 0.0

    def __add__(self, other: LabelDiff) -> LabelDiff:
        return LabelDiff(
            self.instances + other.instances,
            self.changed + other.changed,
            self.index_changed + other.index_changed,
            max(self.max_rotation_deg, other.max_rotation_deg),
        )


@dataclass(frozen=True)
class ObjectChange:
    """What becomes of an object's labels.

    Attributes:
        obj_id: the object.
        group_before, group_after: names of its symmetry group.
        n_regressors_before, n_regressors_after: under the scheme before and after.
        tally: how many of its labels change, and by how much.
    """

    obj_id: int
    group_before: str
    group_after: str
    n_regressors_before: int
    n_regressors_after: int
    tally: LabelDiff

    def __str__(self) -> str:
        return (
            f"object {self.obj_id}: {_arrow(self.group_before, self.group_after)}, "
            f"regressors {_arrow(self.n_regressors_before, self.n_regressors_after)}; "
            f"{self.tally.changed} of {self.tally.instances} instances change, "
            f"{self.tally.index_changed} their regressor, by {self.tally.max_rotation_deg:.1f} degrees at most"
        )


@dataclass(frozen=True)
class Relabelling:
    """What a change of symmetries does to a dataset.

    Attributes:
        scheme_before, scheme_after: how the labels are made.
        scenes, images: in the dataset.
        objects: those whose labels were made anew and that occur in it, by id.
    """

    scheme_before: Scheme
    scheme_after: Scheme
    scenes: int
    images: int
    objects: tuple[ObjectChange, ...]

    def __str__(self) -> str:
        head = f"scheme {_arrow(self.scheme_before, self.scheme_after)}, {self.images} images"
        return "\n".join([head, *map(str, self.objects)])


@dataclass(frozen=True)
class Adoption:
    """What an adopted dataset holds.

    Attributes:
        models: the folder whose models_info.json the boxes, and by default the symmetries, are from.
        table: what the labels were made with.
        splits: names of the folders that were labelled.
        scenes, images, instances: in them.
        written: scene folders whose labels are other than before.
    """

    models: Path
    table: SymmetryTable
    splits: tuple[str, ...]
    scenes: int
    images: int
    instances: int
    written: int

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        counts = {"scenes": self.scenes, "images": self.images, "instances": self.instances, "written": self.written}
        return {"models": str(self.models), "table": self.table.to_dict(), "splits": list(self.splits), **counts}

    def __str__(self) -> str:
        return (
            f"{self.instances} instances in {self.images} images of {', '.join(self.splits)}, scheme "
            f"{self.table.scheme}, models of {self.models}; {self.written} of {self.scenes} scene folders changed"
        )


def relabel(
    root: Path,
    symmetries: Path | None = None,
    scheme: Scheme | None = None,
    dry_run: bool = False,
    workers: int | None = None,
) -> Relabelling:
    """Make a dataset's labels those of other symmetries, or make them again.

    Only scene_gt_canonical.json, symmetries.json and dataset.json are written: all of them, or after a mistake none.
    Labels of objects whose symmetries stay the same are kept to the bit; called without symmetries and scheme, it
    makes all of them again.

    Args:
        root: the dataset's folder.
        symmetries: a symmetry table, or a models_info.json; objects that it does not name keep their symmetries.
            None for those of symmetries.json, which may have been edited.
        scheme: None for what the table states, and else for the one there is.
        dry_run: write nothing, only tell what would change.
        workers: processes; one per available core if None.

    Raises:
        UserError: the symmetries are invalid, or of other objects; the dataset is damaged or cannot be written.
    """
    if not (root / DATASET_FILE).is_file():
        raise UserError(f"{root}: holds no {DATASET_FILE}; give the folder of a dataset that generate made")
    with nullcontext() if dry_run else locked(root):
        if dry_run:
            refuse_half_labelled(root)
        header = read_json(root / DATASET_FILE)
        read_recipe(root)  # what describes the dataset afterwards must be readable before
        state = LabelState.read(root, header)
        models_info = read_models_info(root / MODELS_FOLDER)
        after = revised(state.table, symmetries, scheme, models_info)
        anew = symmetries is None and scheme is None
        only = _differing(state.table, after) if state.trusted and not anew else None
        labelled = _label_folders(scene_folders(root, _SCENE_FILES), after, models_info, only, workers)
        if dry_run:
            return _summary(state.table, after, labelled)
        with _draft(root) as draft:
            summary = _summary(state.table, after, _laid_out(labelled, root, draft))
            write_json(draft / DATASET_FILE, {**header, "symmetries": describe_symmetries(after)})
            _replace_labels(root, draft, after)
        return summary


def adopt(
    root: Path,
    models: Path | None = None,
    symmetries: Path | None = None,
    scheme: Scheme | None = None,
    workers: int | None = None,
) -> Adoption:
    """Put scene_gt_canonical.json into every scene folder that has a scene_gt.json, and symmetries.json into ``root``.

    No other file is written, and images are not looked at. All of it is written, or after a mistake nothing; the
    result depends on the arguments alone, so that the same call again changes nothing and another one relabels.

    Args:
        root: folder of a BOP dataset, which holds SPLIT/%06d.
        models: folder with the models_info.json to use; by default models, models_cad or models_eval in ``root``.
        symmetries: a symmetry table, or a models_info.json; objects that it does not name have the symmetries that
            the models_info.json of ``models`` declares.
        scheme: None for what ``symmetries`` states, and else pitteri2019.
        workers: as in ``relabel``.

    Raises:
        UserError: this is no BOP dataset, or one that is damaged; the symmetries are invalid, or of other objects; a
            file that is to be written exists and is somebody else's.
    """
    scenes = _adoptable_scenes(root)
    models = models or find_models_folder(root)
    models_info = read_models_info(models)
    for obj_id, info in models_info.items():
        for fault in schema_faults(ModelEntry, info):
            raise UserError(f"{models / INFO_FILE}: object {obj_id}: {fault.message}")
    table = revised(_declared(scenes, models, models_info, symmetries, workers), symmetries, scheme, models_info)
    with locked(root):
        _refuse_foreign(root, scenes)
        with _draft(root) as draft:
            labelled = _label_folders(scenes, table, models_info, None, workers, foreign=True)
            counts = [_counted(scene) for scene in _laid_out(labelled, root, draft)]
            _replace_labels(root, draft, table)
    splits = tuple(sorted({scene.root.parent.name for scene in scenes}))
    images, instances, written = map(sum, zip(*counts, strict=True))
    return Adoption(models, table, splits, len(scenes), images, instances, written)


def revised(
    table: SymmetryTable, symmetries: Path | None, scheme: Scheme | None, obj_ids: Collection[int]
) -> SymmetryTable:
    """A table with the entries of another one, and its scheme if it states one.

    Args:
        table: what there is.
        symmetries: file of the other table, which may lack objects; None for none.
        scheme: if given, it wins over both tables'.
        obj_ids: the objects of the dataset.

    Raises:
        UserError: what ``SymmetryTable.read`` refuses, an object that the dataset lacks, an unknown scheme.
    """
    if symmetries is None:
        return replace(table, scheme=scheme or table.scheme)
    other = SymmetryTable.read(symmetries)
    if strangers := sorted(other.entries.keys() - set(obj_ids)):
        raise UserError(
            f"{symmetries}: object {strangers[0]} is none of the dataset's objects {', '.join(map(str, obj_ids))}"
        )
    stated = read_document(symmetries)
    return SymmetryTable(
        {**table.entries, **other.entries},
        scheme or (other if "scheme" in stated else table).scheme,
        (other if "allocentric" in stated else table).allocentric,
        (other if "decimals" in stated else table).decimals,
    )


def _declared(
    scenes: Sequence[ScenePaths],
    models: Path,
    models_info: Mapping[int, ModelInfo],
    symmetries: Path | None,
    workers: int | None,
) -> SymmetryTable:
    """The symmetries that a models_info.json declares of the objects that ``symmetries`` does not name.

    What is wrong with the entry of an object that does not occur does not matter.
    """
    named = () if symmetries is None else SymmetryTable.read(symmetries).entries
    declared, faults = SymmetryTable.declared(models_info, but=named)
    surveys = list(each(_survey, scenes, workers, "poses", "scene"))
    if wrong := sorted(obj_id for obj_id in faults if any(obj_id in survey.obj_ids for survey in surveys)):
        raise UserError(
            f"{models / INFO_FILE}: {faults[wrong[0]]} (a table that --symmetries names may say it instead)"
        )
    found = [survey.decimals for survey in surveys if survey.decimals is not None]
    return replace(declared, decimals=min(found, default=FULL_DECIMALS))


@dataclass(frozen=True)
class _Survey:
    """What is in a scene_gt.json: its objects, and with how many decimals the rotations were written, if they tell."""

    obj_ids: frozenset[int]
    decimals: int | None


def _survey(paths: ScenePaths) -> _Survey:
    images = [image for image in read_scene_json(paths.scene_gt).values() if isinstance(image, list)]
    entries = [entry for image in images for entry in image if isinstance(entry, dict)]
    rotations = as_floats([entry.get("cam_R_m2c") for entry in entries])
    obj_ids = frozenset(entry["obj_id"] for entry in entries if isinstance(entry.get("obj_id"), int))
    return _Survey(obj_ids, stored_decimals(rotations) if rotations.ndim == 2 else None)


# Files that change together


@contextmanager
def _draft(root: Path) -> Iterator[Path]:
    """A folder for new files until all of them are there; what an earlier process left of one is removed."""
    draft = root / DRAFT_FOLDER
    shutil.rmtree(draft, ignore_errors=True)
    try:
        draft.mkdir()
        yield draft
    except OSError as error:
        raise UserError(f"{error.filename or draft}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _laid_out(labelled: Iterable[_LabelledScene], root: Path, draft: Path) -> Iterator[_LabelledScene]:
    """Write each scene's labels into the draft as they come by.

    Only this process writes: workers that outlive it when it is killed can do no harm.
    """
    for scene in labelled:
        if scene.content is not None:
            path = scene.paths.scene_gt_canonical
            if not os.access(path.parent, os.W_OK):
                raise UserError(f"{path.parent}: is read-only; the labels belong there")
            atomic_write(draft / path.relative_to(root), scene.content, durable=True)
        yield scene


def _replace_labels(root: Path, draft: Path, table: SymmetryTable) -> None:
    """Move the draft's files to their places; meanwhile, and after a kill, ``labels.is_half_labelled`` is true.

    Raises:
        UserError: a file cannot be written.
    """
    table.write(draft / PENDING_FILE)
    replace_file(draft / PENDING_FILE, root / PENDING_FILE)
    for path in sorted(draft.rglob("*.json")):
        replace_file(path, root / path.relative_to(draft))
    replace_file(root / PENDING_FILE, root / SYMMETRIES_FILE)


# Labels of whole scene folders, side by side


@dataclass(frozen=True)
class _LabelledScene:
    """A scene folder's labels.

    Attributes:
        paths: its files.
        content: of scene_gt_canonical.json; None if the file has it already.
        images: number of them.
        diffs: of the objects that were labelled, by id.
    """

    paths: ScenePaths
    content: bytes | None
    images: int
    diffs: Mapping[int, LabelDiff]


@dataclass(frozen=True)
class _Task:
    """A scene folder to label, on its way to a worker process; ``table`` is JSON."""

    paths: ScenePaths
    table: str
    models_info: Mapping[int, ModelInfo]
    only: frozenset[int] | None
    foreign: bool


def _label_folders(
    scenes: Sequence[ScenePaths],
    table: SymmetryTable,
    models_info: Mapping[int, ModelInfo],
    only: frozenset[int] | None,
    workers: int | None,
    foreign: bool = False,
) -> Iterator[_LabelledScene]:
    """Label scene folders side by side, and tell of each in turn; nothing is written.

    ``only`` names the objects to label, where the labels of the others can be read; None for all. The entries of
    ``foreign`` datasets are held against their schemas.
    """
    tasks = [_Task(scene, json.dumps(table.to_dict()), models_info, only, foreign) for scene in scenes]
    return each(_label_folder, tasks, workers, "labels", "scene")


@contextmanager
def _without_gc() -> Iterator[None]:
    """Labels hold no reference cycles, and looking for some takes half the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@_without_gc()
def _label_folder(task: _Task) -> _LabelledScene:
    paths = task.paths
    gt, camera = read_scene_json(paths.scene_gt), read_scene_json(paths.scene_camera)
    stored = _stored_labels(paths, gt)
    only = None if stored is None else task.only
    try:
        labels = label_scene(gt, camera, _table(task.table), task.models_info, only, stored)
        if task.foreign:
            _refuse_invalid(gt, camera)
    except UserError as error:
        raise UserError(f"{paths.root}: {error}") from None
    path = paths.scene_gt_canonical
    content = json_bytes(path, {str(im_id): entries for im_id, entries in labels.items()})
    unchanged = path.exists() and content == read_bytes(path)
    return _LabelledScene(paths, None if unchanged else content, len(gt), _diffs(labels, stored, only))


def _refuse_invalid(scene_gt: Mapping[int, object], scene_camera: Mapping[int, object]) -> None:
    """What can be labelled, but is not what the reader and ``validate`` take: numbers as text, say."""
    for name, form, content in (
        ("scene_gt.json", list[ForeignGtEntry], scene_gt),
        ("scene_camera.json", ForeignCameraEntry, scene_camera),
    ):
        for im_id, entry in content.items():
            for fault in schema_faults(form, entry):
                raise UserError(f"{name}: image {im_id}: {fault.message}")


@lru_cache(maxsize=1)
def _table(text: str) -> SymmetryTable:
    return SymmetryTable.from_dict(json.loads(text))


def _stored_labels(paths: ScenePaths, gt: Mapping[int, Sequence[GtEntry]]) -> Labels | None:
    """The labels there are; None if they are missing, damaged or of other instances: then all are needed anew."""
    try:
        labels: Labels = read_scene_json(paths.scene_gt_canonical)
        fits = labels.keys() == gt.keys() and all(
            [label["obj_id"] for label in labels[im_id]] == [entry["obj_id"] for entry in entries]
            and all(label.keys() == CanonicalEntry.__required_keys__ for label in labels[im_id])
            for im_id, entries in gt.items()
        )
        _rotations([label for entries in labels.values() for label in entries])
    except (ValueError, LookupError, TypeError, AttributeError):
        return None
    return labels if fits else None


def _diffs(labels: Labels, stored: Labels | None, only: frozenset[int] | None) -> dict[int, LabelDiff]:
    """What became of the labels of each object that was labelled."""
    new = [label for entries in labels.values() for label in entries]
    old: list[CanonicalEntry | None] = [None] * len(new)
    if stored is not None:
        old = [label for im_id in labels for label in stored[im_id]]
    pairs: defaultdict[int, list[tuple[CanonicalEntry, CanonicalEntry | None]]] = defaultdict(list)
    for after, before in zip(new, old, strict=True):
        if only is None or after["obj_id"] in only:
            pairs[after["obj_id"]].append((after, before))
    return {obj_id: _diff(pairs[obj_id]) for obj_id in sorted(pairs)}


def _diff(pairs: Sequence[tuple[CanonicalEntry, CanonicalEntry | None]]) -> LabelDiff:
    changed = [(after, before) for after, before in pairs if after != before]
    known = [(after, before) for after, before in changed if before is not None]
    index_changed = sum(after["regressor_index"] != before["regressor_index"] for after, before in known)
    apart = _rotations([after for after, _ in known]) - _rotations([before for _, before in known])
    chord = np.linalg.norm(apart, axis=1).max(initial=0.0) / np.sqrt(8)  # |R - R'| = sqrt(8) sin(angle / 2)
    return LabelDiff(len(pairs), len(changed), index_changed, float(np.degrees(2 * np.arcsin(min(1.0, chord)))))


def _rotations(labels: Sequence[CanonicalEntry]) -> NDArray[np.float64]:
    """(N, 9) canonical rotations."""
    return np.array([label["cam_R_m2c_canonical"] for label in labels], dtype=np.float64).reshape(len(labels), 9)


# Reports


def _arrow(before: object, after: object) -> str:
    return f"{before}" if before == after else f"{before} -> {after}"


def _differing(before: SymmetryTable, after: SymmetryTable) -> frozenset[int]:
    """The objects whose labels may differ between two tables."""
    if replace(before, entries={}) != replace(after, entries={}):
        return frozenset(after.entries)
    return frozenset(obj_id for obj_id, entry in after.entries.items() if before.entries.get(obj_id) != entry)


def _summary(before: SymmetryTable, after: SymmetryTable, labelled: Iterable[_LabelledScene]) -> Relabelling:
    scenes = images = 0
    diffs: defaultdict[int, LabelDiff] = defaultdict(LabelDiff)
    for scene in labelled:
        scenes += 1
        images += scene.images
        for obj_id, diff in scene.diffs.items():
            diffs[obj_id] += diff
    objects = tuple(_object_change(obj_id, before, after, diffs[obj_id]) for obj_id in sorted(diffs))
    return Relabelling(before.scheme, after.scheme, scenes, images, objects)


def _object_change(obj_id: int, before: SymmetryTable, after: SymmetryTable, diff: LabelDiff) -> ObjectChange:
    had, has = before.entries.get(obj_id, after.entries[obj_id]), after.entries[obj_id]
    return ObjectChange(
        obj_id,
        had.group.name,
        has.group.name,
        had.canonical_map(before.scheme).n_regressors,
        has.canonical_map(after.scheme).n_regressors,
        diff,
    )


def _counted(scene: _LabelledScene) -> tuple[int, int, int]:
    return scene.images, sum(diff.instances for diff in scene.diffs.values()), int(scene.content is not None)


def _adoptable_scenes(root: Path) -> list[ScenePaths]:
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; give that of a BOP dataset")
    if (root / DATASET_FILE).exists():
        raise UserError(f"{root}: holds a {DATASET_FILE}: synthetless made it, so use relabel")
    for folder in sorted({path.parent for path in root.glob("*/*/scene_gt_*.json")}):
        if sensors := other_sensors(folder):
            raise UserError(
                f"{folder}: has {sensors[0]}, several sensors in one scene folder, as BOP allows since 2024; this is "
                "not supported: give the images of each sensor a scene folder with a scene_gt.json of its own"
            )
    scenes = scene_folders(root, ("scene_gt.json",))
    if not scenes:
        raise UserError(f"{root}: holds no ground truth of a BOP dataset, such as test_primesense/000001/scene_gt.json")
    return scenes


def _refuse_foreign(root: Path, scenes: list[ScenePaths]) -> None:
    """A file of ours is replaced, one of somebody else's is not. Labels are ours if there is a table beside them."""
    path = root / SYMMETRIES_FILE
    if path.exists():
        if not {"scheme", "objects"} <= read_json(path).keys() <= set(TABLE_KEYS):
            raise UserError(f"{path}: not a symmetry table of synthetless, and would be overwritten; move it away")
        return
    for scene in scenes:
        if scene.scene_gt_canonical.exists() and not is_half_labelled(root):
            raise UserError(
                f"{scene.scene_gt_canonical}: exists, but no {SYMMETRIES_FILE} that tells what it means, and would be "
                "overwritten; move it away"
            )
