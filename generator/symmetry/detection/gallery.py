"""Pictures of many parts at a time: `obj_%06d.png` for each object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from synthetless.errors import UserError
from synthetless.io.meshes import read_mesh
from synthetless.io.models import find_meshes
from synthetless.io.parallel import each
from synthetless.symmetry.detection.detect import Finding, measure
from synthetless.symmetry.detection.folder import DetectedFolder
from synthetless.symmetry.detection.pictures import picture, write_picture
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.table import SymmetryTable

_TOLERANCE_PERCENT = 1.0  # of the diameter: the scale of a table's picture does not end below it


def draw_detected(detected: DetectedFolder, to: Path, workers: int | None = None) -> None:
    """Draw every object with its group and, below, the next larger one.

    Args:
        detected: what `detect_folder` found.
        to: folder of the pictures; made if it is missing.
        workers: processes; one per available core if None.

    Raises:
        UserError: a mesh cannot be read any more, or a picture not be written.
    """
    tasks = [
        _Task(
            path=o.path,
            scale=detected.scale,
            target=to / f"obj_{o.obj_id:06d}.png",
            title=f"object {o.obj_id}",
            tolerance_percent=detected.tolerance_percent,
            shown=tuple(f for f in (o.detected.answer, o.detected.next_larger) if f is not None),
        )
        for o in detected.objects
    ]
    _draw_all(tasks, workers)


def draw_table(table: SymmetryTable, models: Path, to: Path, workers: int | None = None) -> None:
    """Draw the objects of a symmetry table whose meshes a folder holds; arguments and errors as in `draw_detected`.

    Raises:
        UserError: the folder holds none of the table's objects.
    """
    paths = {obj_id: path for obj_id, path in find_meshes(models).paths.items() if obj_id in table.entries}
    if not paths:
        raise UserError(f"{models}: holds none of the table's objects, {', '.join(map(str, table.entries))}")
    tasks = [
        _Task(
            path,
            1.0,
            to / f"obj_{obj_id:06d}.png",
            f"object {obj_id}",
            _TOLERANCE_PERCENT,
            (table.entries[obj_id].group,),
        )
        for obj_id, path in paths.items()
    ]
    _draw_all(tasks, workers)


@dataclass(frozen=True)
class _Task:
    path: Path
    scale: float
    target: Path
    title: str
    tolerance_percent: float
    shown: tuple[Finding | SymmetryGroup, ...]


def _draw_all(tasks: list[_Task], workers: int | None) -> None:
    for _ in each(_draw, tasks, workers, "pictures", "mesh"):
        pass


def _draw(task: _Task) -> None:
    mesh = read_mesh(task.path, task.scale)
    tolerance_mm = task.tolerance_percent / 100 * mesh.diameter_mm
    findings = [
        shown if isinstance(shown, Finding) else measure(mesh.vertices_mm, mesh.faces, mesh.diameter_mm, shown)
        for shown in task.shown
    ]
    write_picture(task.target, picture(task.title, mesh, findings, tolerance_mm))
