"""Labels of whole scene folders, side by side: what relabel and adopt have in common."""

from __future__ import annotations

import gc
import json
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import Entry, read_scene_json
from synthetless.errors import UserError
from synthetless.io.files import atomic_write, json_bytes, read_bytes
from synthetless.io.parallel import each
from synthetless.symmetry import SymmetryTable

Labels = dict[int, list[Entry]]

_KEYS = {
    "obj_id",
    "cam_R_m2c_canonical",
    "cam_t_m2c_canonical",
    "regressor_index",
    "n_regressors",
    "discontinuity_margin_deg",
    "bbox3d_corners_2d",
}


@dataclass(frozen=True)
class Tally:
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

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.instances + other.instances,
            self.changed + other.changed,
            self.index_changed + other.index_changed,
            max(self.max_rotation_deg, other.max_rotation_deg),
        )


@dataclass(frozen=True)
class LabelledScene:
    """A scene folder's labels.

    Attributes:
        scene: its files.
        content: of scene_gt_canonical.json; None if the file has it already.
        images: number of them.
        tallies: of the objects that were labelled, by id.
    """

    scene: ScenePaths
    content: bytes | None
    images: int
    tallies: Mapping[int, Tally]


@dataclass(frozen=True)
class _Task:
    """A scene folder to label, on its way to a worker process; ``table`` is JSON."""

    scene: ScenePaths
    table: str
    models_info: Mapping[int, Entry]
    only: frozenset[int] | None


def scene_folders(root: Path, having: Iterable[str]) -> list[ScenePaths]:
    """The scene folders SPLIT/%06d of all splits that have one of these files, in order."""
    folders = {path.parent for name in having for path in root.glob(f"*/*/{name}")}
    return [ScenePaths(folder) for folder in sorted(folders) if folder.name.isdecimal()]


def label_folders(
    scenes: Sequence[ScenePaths],
    table: SymmetryTable,
    models_info: Mapping[int, Entry],
    only: frozenset[int] | None = None,
    workers: int | None = None,
) -> Iterator[LabelledScene]:
    """Label scene folders side by side, and tell of each in turn; nothing is written.

    Args:
        scenes: the folders.
        table: symmetries and scheme.
        models_info: BOP's entry of each object.
        only: the objects to label, where the labels of the others can be read; None for all.
        workers: processes; one per available core if None.

    Raises:
        UserError: a scene folder is damaged; with the file, the image and the instance.
    """
    tasks = [_Task(scene, json.dumps(table.to_dict()), models_info, only) for scene in scenes]
    return each(_label_folder, tasks, workers, "labels", "scene")


def laid_out(labelled: Iterable[LabelledScene], root: Path, draft: Path) -> Iterator[LabelledScene]:
    """Write each scene's labels into ``draft``, a folder of ``synthetless.dataset.changes``, as they come by.

    Only this process writes: workers that outlive it when it is killed can do no harm.

    Raises:
        UserError: a file cannot be written, or will not be when it is to take its place.
    """
    for scene in labelled:
        if scene.content is not None:
            path = scene.scene.scene_gt_canonical
            if not os.access(path.parent, os.W_OK):
                raise UserError(f"{path.parent}: is read-only; the labels belong there")
            atomic_write(draft / path.relative_to(root), scene.content)
        yield scene


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
def _label_folder(task: _Task) -> LabelledScene:
    scene = task.scene
    gt, camera = read_scene_json(scene.scene_gt), read_scene_json(scene.scene_camera)
    stored = _stored_labels(scene, gt)
    only = None if stored is None else task.only
    try:
        labels = label_scene(gt, camera, _table(task.table), task.models_info, only)
    except ValueError as error:
        raise UserError(f"{scene.root}: {error}") from None
    if stored is not None:
        labels = {
            im_id: [new or old for new, old in zip(labels[im_id], stored[im_id], strict=True)] for im_id in labels
        }
    path = scene.scene_gt_canonical
    content = json_bytes(path, {str(im_id): entries for im_id, entries in labels.items()})
    unchanged = path.exists() and content == read_bytes(path)
    return LabelledScene(scene, None if unchanged else content, len(gt), _tallies(labels, stored, only))


@lru_cache(maxsize=1)
def _table(text: str) -> SymmetryTable:
    return SymmetryTable.from_dict(json.loads(text))


def _stored_labels(scene: ScenePaths, gt: Mapping[int, Sequence[Entry]]) -> Labels | None:
    """The labels there are; None if they are missing, damaged or of other instances: then all are needed anew."""
    try:
        labels: Labels = read_scene_json(scene.scene_gt_canonical)
        fits = labels.keys() == gt.keys() and all(
            [label["obj_id"] for label in labels[im_id]] == [entry["obj_id"] for entry in entries]
            and all(label.keys() == _KEYS for label in labels[im_id])
            for im_id, entries in gt.items()
        )
        _rotations([label for entries in labels.values() for label in entries])
    except (ValueError, LookupError, TypeError, AttributeError):
        return None
    return labels if fits else None


def _tallies(labels: Labels, stored: Labels | None, only: frozenset[int] | None) -> dict[int, Tally]:
    """What became of the labels of each object that was labelled."""
    new = [label for entries in labels.values() for label in entries]
    old: list[Entry | None] = [None] * len(new)
    if stored is not None:
        old = [label for im_id in labels for label in stored[im_id]]
    pairs: defaultdict[int, list[tuple[Entry, Entry | None]]] = defaultdict(list)
    for after, before in zip(new, old, strict=True):
        if only is None or after["obj_id"] in only:
            pairs[after["obj_id"]].append((after, before))
    return {obj_id: _tally(pairs[obj_id]) for obj_id in sorted(pairs)}


def _tally(pairs: Sequence[tuple[Entry, Entry | None]]) -> Tally:
    changed = [(after, before) for after, before in pairs if after != before]
    known = [(after, before) for after, before in changed if before is not None]
    index_changed = sum(after["regressor_index"] != before["regressor_index"] for after, before in known)
    apart = _rotations([after for after, _ in known]) - _rotations([before for _, before in known])
    chord = np.linalg.norm(apart, axis=1).max(initial=0.0) / np.sqrt(8)  # |R - R'| = sqrt(8) sin(angle / 2)
    return Tally(len(pairs), len(changed), index_changed, float(np.degrees(2 * np.arcsin(min(1.0, chord)))))


def _rotations(labels: Sequence[Entry]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(N, 9) canonical rotations."""
    return np.array([label["cam_R_m2c_canonical"] for label in labels], dtype=np.float64).reshape(len(labels), 9)
