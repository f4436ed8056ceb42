"""Other symmetries or another scheme for a dataset that is made already: new labels, the images untouched."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import yaml

from synthetless.dataset.changes import changes, complete, refuse_half_changed
from synthetless.dataset.labelling import LabelledScene, Tally, label_folders, laid_out, scene_folders
from synthetless.dataset.layout import DATASET_FILE, MODELS_FOLDER, SYMMETRIES_FILE
from synthetless.dataset.store import describe_symmetries
from synthetless.errors import UserError
from synthetless.io.files import locked, read_bytes, read_json, write_json
from synthetless.io.models import read_models_info
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.atlas import Scheme

_SCENE_FILES = ("scene_camera.json", "scene_gt.json", "scene_gt_canonical.json")


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
    tally: Tally

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


def relabel(
    root: Path,
    symmetries: Path | None = None,
    scheme: Scheme | None = None,
    dry_run: bool = False,
    workers: int | None = None,
) -> Relabelling:
    """Make a dataset's labels those of other symmetries, or make them again.

    Only scene_gt_canonical.json, symmetries.json and dataset.json are written: all of them, or after a mistake none.
    If the process is killed while they take their places, the next call first does the rest. Labels of objects whose
    symmetries stay the same are kept to the bit; called without symmetries and scheme, it makes all of them again.

    Args:
        root: the dataset's folder.
        symmetries: a symmetry table, or a models_info.json; objects that it does not name keep their symmetries.
            None for those of symmetries.json, which may have been edited.
        scheme: None for what the table states, and else for the one there is.
        dry_run: write nothing, only tell what would change.
        workers: processes; one per available core if None. They are spawned: a script that calls this needs
            ``if __name__ == "__main__"``.

    Raises:
        UserError: the symmetries are none, or of other objects; the dataset is damaged or cannot be written.
    """
    if not (root / DATASET_FILE).is_file():
        raise UserError(f"{root}: holds no {DATASET_FILE}; give the folder of a dataset that generate made")
    with nullcontext() if dry_run else locked(root):
        if dry_run:
            refuse_half_changed(root)
        else:
            complete(root)
        header, before = read_json(root / DATASET_FILE), SymmetryTable.read(root / SYMMETRIES_FILE)
        models_info = read_models_info(root / MODELS_FOLDER)
        after = revised(before, symmetries, scheme, models_info)
        trusted = header.get("symmetries") == describe_symmetries(before)
        anew = symmetries is None and scheme is None
        only = _differing(before, after) if trusted and not anew else None
        labelled = label_folders(scene_folders(root, _SCENE_FILES), after, models_info, only, workers)
        if dry_run:
            return _summary(before, after, labelled)
        with changes(root) as draft:
            summary = _summary(before, after, laid_out(labelled, root, draft))
            after.write(draft / SYMMETRIES_FILE)
            write_json(draft / DATASET_FILE, {**header, "symmetries": describe_symmetries(after)})
        return summary


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
        return SymmetryTable(table.entries, scheme or table.scheme, table.allocentric)
    other = SymmetryTable.read(symmetries)
    if strangers := sorted(other.entries.keys() - set(obj_ids)):
        raise UserError(
            f"{symmetries}: object {strangers[0]} is none of the dataset's objects {', '.join(map(str, obj_ids))}"
        )
    stated = _keys(symmetries)
    return SymmetryTable(
        {**table.entries, **other.entries},
        scheme or (other if "scheme" in stated else table).scheme,
        (other if "allocentric" in stated else table).allocentric,
    )


def _arrow(before: object, after: object) -> str:
    return f"{before}" if before == after else f"{before} -> {after}"


def _keys(path: Path) -> set[str]:
    """What a symmetry table states at its top level."""
    text = read_bytes(path)
    try:
        return set(json.loads(text))
    except ValueError:
        return set(yaml.safe_load(text))


def _differing(before: SymmetryTable, after: SymmetryTable) -> frozenset[int]:
    """The objects whose labels may differ between two tables."""
    if (before.scheme, before.allocentric) != (after.scheme, after.allocentric):
        return frozenset(after.entries)
    return frozenset(obj_id for obj_id, entry in after.entries.items() if before.entries.get(obj_id) != entry)


def _summary(before: SymmetryTable, after: SymmetryTable, labelled: Iterable[LabelledScene]) -> Relabelling:
    scenes = images = 0
    tallies: defaultdict[int, Tally] = defaultdict(Tally)
    for scene in labelled:
        scenes += 1
        images += scene.images
        for obj_id, tally in scene.tallies.items():
            tallies[obj_id] += tally
    objects = tuple(_object_change(obj_id, before, after, tallies[obj_id]) for obj_id in sorted(tallies))
    return Relabelling(before.scheme, after.scheme, scenes, images, objects)


def _object_change(obj_id: int, before: SymmetryTable, after: SymmetryTable, tally: Tally) -> ObjectChange:
    had, has = before.entries.get(obj_id, after.entries[obj_id]), after.entries[obj_id]
    return ObjectChange(
        obj_id,
        had.group.name,
        has.group.name,
        had.canonical_map(before.scheme).n_regressors,
        has.canonical_map(after.scheme).n_regressors,
        tally,
    )
