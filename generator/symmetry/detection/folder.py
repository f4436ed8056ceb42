"""Detection on a folder of meshes, several at a time, and what is written of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synthetless.errors import UserError
from synthetless.io.files import atomic_write, write_json
from synthetless.io.meshes import read_mesh
from synthetless.io.models import find_meshes
from synthetless.io.parallel import each
from synthetless.symmetry.atlas import SCHEMES, Scheme
from synthetless.symmetry.detection.detect import Detected, GroupFit, detect
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.table import MODELS_INFO_FILE, SymmetryEntry, SymmetryTable

_SMALLEST_MM, _LARGEST_MM = 2.0, 2000.0


@dataclass(frozen=True)
class DetectedObject:
    """What was found on one object.

    Attributes:
        obj_id: BOP id.
        path: its mesh.
        info: BOP's diameter, min_ and size_, mm.
        detected: its groups and their residuals.
    """

    obj_id: int
    path: Path
    info: Mapping[str, float]
    detected: Detected

    @property
    def warning(self) -> str | None:
        """What is odd about its size, if anything."""
        diameter_mm, ask = self.detected.diameter_mm, "are its units"
        if diameter_mm < _SMALLEST_MM:
            return f"is only {diameter_mm:.3g} mm across: {ask} metres? (--scale 1000 turns them into millimetres)"
        if diameter_mm > _LARGEST_MM:
            return f"is {diameter_mm:.0f} mm across: {ask} micrometres? (--scale 0.001 turns them into millimetres)"
        return None


@dataclass(frozen=True)
class DetectedFolder:
    """What was found on a folder of meshes.

    Attributes:
        folder: where they are.
        objects: by rising id.
        are_numbered: whether the ids are only the files' places in alphabetical order.
        tolerance_percent: what the largest residual may be, as a share of the diameter.
        scale: what the files' coordinates were multiplied by to get millimetres.
    """

    folder: Path
    objects: tuple[DetectedObject, ...]
    are_numbered: bool
    tolerance_percent: float
    scale: float

    def table(self, scheme: Scheme = SCHEMES[0]) -> SymmetryTable:
        """The detected groups as a symmetry table."""
        return SymmetryTable({o.obj_id: SymmetryEntry(o.detected.answer.group) for o in self.objects}, scheme)

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain dicts, lists and numbers."""
        return {
            "folder": str(self.folder),
            "tolerance_percent": self.tolerance_percent,
            "scale": self.scale,
            "objects": [_object_json(o) for o in self.objects],
        }

    def write_models(self, to: Path) -> None:
        """Make a BOP models folder: `obj_%06d.ply`, in millimetres, and `models_info.json` with the detected groups.

        A PLY file that is already there under its name stays as it is.

        Raises:
            UserError: a file cannot be written, or the folder holds other meshes.
        """
        targets = {to / f"obj_{o.obj_id:06d}.ply": o for o in self.objects}
        for target, o in targets.items():
            stays = target.exists() and target.samefile(o.path) and self.scale == 1
            if not stays and (target.exists() or to.resolve() == self.folder.resolve()):
                raise UserError(f"{target}: would stand beside other meshes; give a new folder")
        for target, o in targets.items():
            if not target.exists():
                atomic_write(target, self._ply(o))
        write_json(to / MODELS_INFO_FILE, {str(o.obj_id): _models_info(o) for o in self.objects})

    def _ply(self, o: DetectedObject) -> bytes:
        mesh = read_mesh(o.path, self.scale)
        return o.path.read_bytes() if mesh.is_verbatim else mesh.to_ply()


def detect_folder(
    folder: Path,
    tolerance_percent: float = 1.0,
    scale: float = 1.0,
    workers: int | None = None,
) -> DetectedFolder:
    """Detect the symmetry group of every mesh in a folder.

    Groups that a `models_info.json` in it declares are measured as well.

    Args:
        folder: holds PLY, STL, OBJ or OFF files.
        tolerance_percent: what the largest residual may be, as a share of the diameter.
        scale: what the files' coordinates are to be multiplied by to give millimetres.
        workers: processes; one per available core if None. They are spawned: a script that calls this needs
            ``if __name__ == "__main__"``.

    Raises:
        UserError: wrong numbers, a folder without meshes, a mesh that is unusable; with the file's name.
    """
    for name, value in (("tolerance_percent", tolerance_percent), ("scale", scale)):
        if not (np.isfinite(value) and value > 0):
            raise UserError(f"{name} is {value}; a number above 0 is needed")
    files = find_meshes(folder)
    declared = _declared(folder)
    tasks = [
        _Task(obj_id, path, tolerance_percent, scale, declared.get(obj_id)) for obj_id, path in files.paths.items()
    ]
    tasks.sort(key=lambda task: -task.path.stat().st_size)  # the longest first, so that no core ends up alone
    objects = sorted(each(_detect_file, tasks, workers, "symmetries", "mesh"), key=lambda o: o.obj_id)
    return DetectedFolder(folder, tuple(objects), files.are_numbered, tolerance_percent, scale)


@dataclass(frozen=True)
class _Task:
    obj_id: int
    path: Path
    tolerance_percent: float
    scale: float
    declared: SymmetryGroup | None


def _detect_file(task: _Task) -> DetectedObject:
    mesh = read_mesh(task.path, task.scale)
    if mesh.is_flat:
        raise UserError(f"{task.path}: all its points lie in one plane; a part with a thickness is needed")
    try:
        detected = detect(mesh.vertices_mm, mesh.faces, mesh.diameter_mm, task.tolerance_percent, task.declared)
    except ValueError as error:
        raise UserError(f"{task.path}: {error}") from error
    return DetectedObject(task.obj_id, task.path, mesh.bop_info(), detected)


def _declared(folder: Path) -> dict[int, SymmetryGroup]:
    path = folder / MODELS_INFO_FILE
    if not path.exists():
        return {}
    table = SymmetryTable.read(path)
    return {obj_id: entry.group for obj_id, entry in table.entries.items()}


def _models_info(o: DetectedObject) -> dict[str, Any]:
    return dict(o.info) | o.detected.answer.group.to_bop()


def _object_json(o: DetectedObject) -> dict[str, Any]:
    found = o.detected
    group = found.answer.group
    return {
        "obj_id": o.obj_id,
        "file": o.path.name,
        **_group_json(group),
        "diameter_mm": found.diameter_mm,
        "tolerance_mm": found.tolerance_mm,
        "warning": o.warning,
        "residuals": [_fit_json(f, found) for f in found.fits],
    }


def _fit_json(fit: GroupFit, found: Detected) -> dict[str, Any]:
    residual = fit.residual
    return {
        **_group_json(fit.group),
        "max_mm": residual.max_mm,
        "p95_mm": residual.p95_mm,
        "rms_mm": residual.rms_mm,
        "worst_mm": None if residual.worst_mm is None else list(residual.worst_mm),
        "max_percent": 100 * residual.max_mm / found.diameter_mm,
        "is_answer": fit == found.answer,
        "is_next_larger": fit == found.next_larger,
        "is_declared": fit == found.declared,
    }


def _group_json(group: SymmetryGroup) -> dict[str, Any]:
    return {
        "group": group.name,
        "axis": None if group.axis is None else list(group.axis),
        "secondary_axis": None if group.secondary_axis is None else list(group.secondary_axis),
        "offset_mm": list(group.offset_mm),
    }
