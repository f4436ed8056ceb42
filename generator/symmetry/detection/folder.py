"""Detection on a folder of meshes, several at a time, and what is written of it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from typing_extensions import Self

from synthetless.errors import UserError
from synthetless.io.cad import TESSELLATION_MM
from synthetless.io.documents import read_document, shown
from synthetless.io.files import atomic_write, write_json
from synthetless.io.images import encode_png
from synthetless.io.meshes import TriangleMesh, read_mesh
from synthetless.io.models import (
    INFO_FILE,
    NAMES_FILE,
    MeshFiles,
    find_meshes,
    object_names,
    read_models_info,
    read_names,
    texture_file,
)
from synthetless.io.parallel import each
from synthetless.symmetry.atlas import SCHEMES, Scheme
from synthetless.symmetry.detection.detect import Detected, detect, measure
from synthetless.symmetry.detection.quasi import quasi_fit
from synthetless.symmetry.detection.residual import GroupFit
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.recentring import Recentring, write_recentrings
from synthetless.symmetry.table import QuasiSymmetry, SymmetryEntry, SymmetryTable, object_id

_TOLERANCE = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|%)\s*")
_SMALL_FOLDER_MM = 20.0  # of a folder whose largest part is smaller than this the units are asked about


@dataclass(frozen=True)
class Tolerance:
    """What an object's largest residual may be.

    Attributes:
        value: a number above 0.
        unit: millimetres, or % of the object's diameter.
    """

    value: float
    unit: Literal["mm", "%"] = "%"

    @classmethod
    def parse(cls, text: object) -> Self:
        """A tolerance such as `0.5mm` or `2%`.

        Raises:
            UserError: any other text, or nothing that is above 0.
        """
        matched = _TOLERANCE.fullmatch(str(text))
        if matched is None or float(matched[1]) == 0:
            raise UserError(f"the tolerance {shown(text)} is not a number above 0 with its unit, such as 0.5mm or 2%")
        return cls(float(matched[1]), "mm" if matched[2] == "mm" else "%")

    def percent_of(self, diameter_mm: float) -> float:
        """As a share of the diameter, in %."""
        return 100 * self.value / diameter_mm if self.unit == "mm" else self.value

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


def parse_tolerances(texts: Iterable[str]) -> dict[int, Tolerance]:
    """Tolerances of single objects, each written as `26=0.5mm` or as a YAML or JSON file that maps ids to tolerances.

    Raises:
        UserError: another form, an object twice, a file that cannot be read.
    """
    tolerances: dict[int, Tolerance] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        given: object = {key: value} if equals else read_document(Path(text))
        if not isinstance(given, Mapping):
            raise UserError(f"{text}: holds no tolerances; a mapping of object ids is needed, such as 26: 0.5mm")
        for name, tolerance in given.items():
            try:
                obj_id = object_id(name)
                parsed = Tolerance.parse(tolerance)
            except UserError as error:
                raise UserError(f"{text}: {error}") from None
            if obj_id in tolerances:
                raise UserError(f"{text}: object {obj_id} has two tolerances")
            tolerances[obj_id] = parsed
    return tolerances


_SMALLEST_MM, _LARGEST_MM = 2.0, 2000.0


@dataclass(frozen=True)
class DetectedObject:
    """What was found on one object.

    Attributes:
        obj_id: BOP id.
        path: its mesh.
        info: BOP's diameter, min_ and size_, mm.
        detected: its groups and their residuals.
        quasi: the larger group within the tolerance for those, if one was asked for and there is one.
        quasi_tolerance_mm: that tolerance; None if none was asked for.
        name: what it is called; None if nothing says so.
    """

    obj_id: int
    path: Path
    info: Mapping[str, float]
    detected: Detected
    quasi: GroupFit | None = None
    quasi_tolerance_mm: float | None = None
    name: str | None = None

    @property
    def entry(self) -> SymmetryEntry:
        """The object in a symmetry table."""
        quasi = None if self.quasi is None else QuasiSymmetry(self.quasi.group, self.quasi_tolerance_mm)
        return SymmetryEntry(self.detected.answer.group, None, quasi)

    @property
    def recentring(self) -> Recentring:
        """What brings its main axis to z and its fixed point to the origin."""
        return Recentring.of(self.detected.answer.group)

    @property
    def recentred_entry(self) -> SymmetryEntry:
        """The object in the symmetry table of the recentred models."""
        quasi = self.entry.quasi
        moved = None if quasi is None else replace(quasi, group=self.recentring.group(quasi.group))
        return SymmetryEntry(SymmetryGroup(self.detected.answer.group.name), None, moved)

    @property
    def warning(self) -> str | None:
        """What is odd about its size, if anything, or that time ran out."""
        if not self.detected.is_complete:
            return "took too long: not every group was looked at, and a larger one may fit; a simpler mesh takes less"
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
        tolerances: of objects that have another one.
        tessellation_mm: how far triangles may be from the surfaces of CAD files.
    """

    folder: Path
    objects: tuple[DetectedObject, ...]
    are_numbered: bool
    tolerance_percent: float
    scale: float
    tolerances: Mapping[int, Tolerance] = field(default_factory=dict)
    tessellation_mm: float = TESSELLATION_MM

    @property
    def unit_warning(self) -> str | None:
        """What is odd about all parts together, if anything: parts in inches or centimetres look like small ones."""
        largest = max(o.detected.diameter_mm for o in self.objects)
        if largest >= _SMALL_FOLDER_MM or any(o.warning for o in self.objects):
            return None
        return (
            f"no part is larger than {largest:.3g} mm: are the units inches (--scale 25.4 turns them into millimetres) "
            "or centimetres (--scale 10)?"
        )

    @property
    def off_axis(self) -> tuple[int, ...]:
        """The objects whose continuous symmetries are not about x, y or z through the origin."""
        return tuple(o.obj_id for o in self.objects if _is_off_axis(o.detected.answer.group))

    def table(self, scheme: Scheme = SCHEMES[0], recentred: bool = False) -> SymmetryTable:
        """The detected groups as a symmetry table; ``recentred``: of the models that are written so."""
        return SymmetryTable({o.obj_id: o.recentred_entry if recentred else o.entry for o in self.objects}, scheme)

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain dicts, lists and numbers."""
        return {
            "folder": str(self.folder),
            "tolerance_percent": self.tolerance_percent,
            "scale": self.scale,
            "warning": self.unit_warning,
            "off_axis": list(self.off_axis),
            "objects": [_object_json(o) for o in self.objects],
        }

    def write_models(self, to: Path, recentred: bool = False, colours: bool = False) -> None:
        """Make a BOP models folder: `obj_%06d.ply`, in millimetres, and `models_info.json` with the detected groups.

        A PLY file that is already there under its name stays as it is.

        Args:
            to: the folder.
            recentred: move each model so that its main axis is z and its fixed point the origin; `recentred.json`
                says how.
            colours: whether to carry along colours and textures of the meshes.

        Raises:
            UserError: a texture is missing or unusable, a file cannot be written, or the folder holds other meshes.
        """
        targets = {to / f"obj_{o.obj_id:06d}.ply": o for o in self.objects}
        for target, o in targets.items():
            stays = target.exists() and target.samefile(o.path) and self.scale == 1 and not recentred
            if not stays and (target.exists() or to.resolve() == self.folder.resolve()):
                raise UserError(f"{target}: would stand beside other meshes; give a new folder")
        infos: dict[str, Any] = {}
        for target, o in targets.items():
            moved = self._recentred(o, colours) if recentred and not o.recentring.is_none else None
            if not target.exists():
                for name, content in self._files(o, moved or self._read(o, colours)).items():
                    atomic_write(to / name, content)
            group = o.recentred_entry.group if recentred else o.detected.answer.group
            infos[str(o.obj_id)] = _models_info(o, o.info if moved is None else moved.bop_info(), group)
        write_json(to / INFO_FILE, infos)
        if recentred:
            write_recentrings(to, {o.obj_id: o.recentring for o in self.objects})

    def _files(self, o: DetectedObject, mesh: TriangleMesh) -> dict[str, bytes]:
        """The PLY file of an object's mesh, and its texture, by their names."""
        texture = texture_file(o.obj_id)
        is_verbatim = mesh.is_verbatim and mesh.texture_file in (None, texture)
        files = {f"obj_{o.obj_id:06d}.ply": o.path.read_bytes() if is_verbatim else mesh.to_ply(texture)}
        if mesh.colours is not None and mesh.colours.texture is not None:
            files[texture] = encode_png(mesh.colours.texture)
        return files

    def _read(self, o: DetectedObject, colours: bool) -> TriangleMesh:
        return read_mesh(o.path, self.scale, colours, self.tessellation_mm)

    def _recentred(self, o: DetectedObject, colours: bool) -> TriangleMesh:
        mesh = self._read(o, colours)
        return replace(mesh, vertices_mm=o.recentring.points(mesh.vertices_mm), is_verbatim=False)


def detect_folder(
    folder: Path,
    tolerance_percent: float = 1.0,
    scale: float = 1.0,
    workers: int | None = None,
    tolerances: Mapping[int, Tolerance] | None = None,
    quasi: Tolerance | None = None,
    tessellation_mm: float = TESSELLATION_MM,
) -> DetectedFolder:
    """Detect the symmetry group of every mesh in a folder.

    Groups that a `models_info.json` in it declares are measured as well.

    Args:
        folder: holds PLY, STL, OBJ, OFF, GLB, STEP or IGES files.
        tolerance_percent: what the largest residual may be, as a share of the diameter.
        scale: what the files' coordinates are to be multiplied by to give millimetres.
        workers: processes; one per available core if None.
        tolerances: of objects that have another one.
        quasi: what the largest residual of a larger group may be that an object has but for a detail; None for none.
        tessellation_mm: how far triangles may be from the surfaces of STEP and IGES files.

    Raises:
        UserError: wrong numbers, a tolerance of an object that is not there, a folder without meshes, a mesh that is
            unusable; with the file's name.
    """
    for name, value in (
        ("tolerance_percent", tolerance_percent),
        ("scale", scale),
        ("tessellation_mm", tessellation_mm),
    ):
        if not (np.isfinite(value) and value > 0):
            raise UserError(f"{name} is {value}; a number above 0 is needed")
    files = find_meshes(folder)
    declared, others, names = _declared(folder), dict(tolerances or {}), _names(files, folder)
    if strangers := sorted(others.keys() - files.paths.keys()):
        known = ", ".join(map(str, files.paths))
        raise UserError(f"object {strangers[0]} has a tolerance, but {folder} holds objects {known}")
    tasks = [
        _Task(
            obj_id,
            path,
            others.get(obj_id, Tolerance(tolerance_percent)),
            scale,
            declared.get(obj_id),
            quasi,
            tessellation_mm,
        )
        for obj_id, path in files.paths.items()
    ]
    tasks.sort(key=lambda task: -task.path.stat().st_size)  # the longest first, so that no core ends up alone
    found = sorted(each(_detect_file, tasks, workers, "symmetries", "mesh"), key=lambda o: o.obj_id)
    objects = tuple(replace(o, name=names.get(o.obj_id)) for o in found)
    return DetectedFolder(folder, objects, files.are_numbered, tolerance_percent, scale, others, tessellation_mm)


@dataclass(frozen=True)
class _Task:
    obj_id: int
    path: Path
    tolerance: Tolerance
    scale: float
    declared: SymmetryGroup | None
    quasi: Tolerance | None
    tessellation_mm: float


def _detect_file(task: _Task) -> DetectedObject:
    mesh = read_mesh(task.path, task.scale, tessellation_mm=task.tessellation_mm)
    if mesh.is_flat:
        raise UserError(f"{task.path}: all its points lie in one plane; a part with a thickness is needed")
    try:
        percent = task.tolerance.percent_of(mesh.diameter_mm)
        detected = detect(mesh.vertices_mm, mesh.faces, mesh.diameter_mm, percent, task.declared)
    except ValueError as error:
        raise UserError(f"{task.path}: {error}") from error
    if task.quasi is None:
        return DetectedObject(task.obj_id, task.path, mesh.bop_info(), detected)
    most_mm = task.quasi.percent_of(mesh.diameter_mm) / 100 * mesh.diameter_mm
    larger = quasi_fit(detected, most_mm, partial(measure, mesh.vertices_mm, mesh.faces, mesh.diameter_mm))
    return DetectedObject(task.obj_id, task.path, mesh.bop_info(), detected, larger, most_mm)


def _declared(folder: Path) -> dict[int, SymmetryGroup]:
    path = folder / INFO_FILE
    if not path.exists():
        return {}
    table = SymmetryTable.read(path)
    return {obj_id: entry.group for obj_id, entry in table.entries.items()}


def _names(files: MeshFiles, folder: Path) -> dict[int, str]:
    """What names.yaml calls the objects, or models_info.json, or else the files whose names are no ids."""
    given = read_names(folder)
    if strangers := sorted(given.keys() - files.paths.keys()):
        raise UserError(f"{folder / NAMES_FILE}: names object {strangers[0]}, but there is no mesh of it")
    stems = {obj_id: path.stem for obj_id, path in files.paths.items() if path.stem.isprintable()}
    known = object_names(read_models_info(folder)) if (folder / INFO_FILE).exists() else {}
    return (stems if files.are_numbered else {}) | known | given


def _models_info(o: DetectedObject, sizes: Mapping[str, float], group: SymmetryGroup) -> dict[str, Any]:
    return {**sizes, **({} if o.name is None else {"name": o.name}), **group.to_bop()}


def _is_off_axis(group: SymmetryGroup) -> bool:
    """Whether a reader that knows only coordinate axes through the origin takes the group for another one."""
    return any(
        any(symmetry["offset"]) or sorted(symmetry["axis"]) != [0, 0, 1]
        for symmetry in group.to_bop().get("symmetries_continuous", ())
    )


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
        "is_complete": found.is_complete,
        "residuals": [_fit_json(f, found) for f in found.fits],
        **({} if o.quasi is None else {"quasi": _group_json(o.quasi.group) | {"max_mm": o.quasi.residual.max_mm}}),
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
