"""Object models: BOP's folder of PLY files and models_info.json, read once and checked thoroughly."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.io.documents import shown
from synthetless.io.files import read_json

INFO_FILE = "models_info.json"
_PLY_NAME = re.compile(r"obj_(\d{6})\.ply")
_REPORTED_BOX_TOLERANCE_MM = 0.5


class ModelError(UserError):
    """A models folder, a mesh or models_info.json that cannot be used; the message is one line."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object model, millimetres, in its BOP model frame.

    Attributes:
        obj_id: BOP object id.
        path: the PLY file.
        vertices_mm: (V, 3) float64.
        faces: (F, 3) int32.
        info: the object's entry in models_info.json: diameter, box and symmetries.
    """

    obj_id: int
    path: Path
    vertices_mm: NDArray[np.float64]
    faces: NDArray[np.int32]
    info: Mapping[str, Any]

    @property
    def diameter_mm(self) -> float:
        """Largest distance between two vertices, as models_info.json gives it."""
        return float(self.info["diameter"])

    @property
    def box_corners_mm(self) -> NDArray[np.float64]:
        """(8, 3) corners of the axis-aligned box of the vertices; x varies slowest, z fastest."""
        low, high = self.vertices_mm.min(axis=0), self.vertices_mm.max(axis=0)
        choice = np.array([[(i >> 2) & 1, (i >> 1) & 1, i & 1] for i in range(8)], dtype=bool)
        return np.where(choice, high, low)

    @property
    def digest(self) -> str:
        """SHA-256 of the PLY file."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()


def load_models(folder: Path, obj_ids: tuple[int, ...] | None = None) -> dict[int, ObjectModel]:
    """Read a BOP models folder.

    Args:
        folder: holds obj_%06d.ply and models_info.json.
        obj_ids: read only these; all of them if None.

    Returns:
        Models by id, in ascending order.

    Raises:
        ModelError: the folder, a mesh or models_info.json is missing or unusable.
    """
    files = _find_meshes(folder)
    info = read_models_info(folder)
    wanted = sorted(files) if obj_ids is None else sorted(set(obj_ids))
    for obj_id in wanted:
        if obj_id not in files:
            known = ", ".join(str(i) for i in sorted(files))
            raise ModelError(f"{folder}: no mesh for object {obj_id}; the folder holds objects {known}")
        if obj_id not in info:
            raise ModelError(
                f"{folder / INFO_FILE}: no entry for object {obj_id} ({files[obj_id].name}); "
                "add its diameter, box and symmetries, or leave it out with objects.ids"
            )
    return {obj_id: _load_model(obj_id, files[obj_id], info[obj_id]) for obj_id in wanted}


def read_models_info(folder: Path) -> dict[int, dict[str, Any]]:
    """models_info.json by object id.

    Raises:
        ModelError: it is missing, not JSON, names a key twice, or is not a mapping of ids to entries.
    """
    path = folder / INFO_FILE
    if not path.exists():
        raise ModelError(f"{path}: not found; a BOP models folder needs it")
    try:
        content = read_json(path)
    except UserError as error:
        raise ModelError(str(error)) from None
    entries: dict[int, dict[str, Any]] = {}
    for key, entry in content.items():
        if not (key.strip().isascii() and key.strip().isdecimal()):
            raise ModelError(f'{path}: the key {shown(key)} is not an object id, such as "1"')
        if not isinstance(entry, dict):
            raise ModelError(f"{path}: object {key} is {shown(entry)}, not a mapping of diameter, box and symmetries")
        if int(key) in entries:
            raise ModelError(f"{path}: object {int(key)} is listed twice, once as {shown(key)}")
        entries[int(key)] = entry
    return entries


def _find_meshes(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise ModelError(f"{folder}: no such models folder; give one that holds obj_000001.ply, ...")
    files = {
        int(match.group(1)): path for path in sorted(folder.iterdir()) if (match := _PLY_NAME.fullmatch(path.name))
    }
    if not files:
        raise ModelError(f"{folder}: holds no models; expected files named obj_000001.ply, ...")
    return files


def _load_model(obj_id: int, path: Path, info: Mapping[str, Any]) -> ObjectModel:
    vertices, faces = _read_mesh(path)
    diameter = info.get("diameter")
    if not isinstance(diameter, int | float) or not np.isfinite(diameter) or diameter <= 0:
        raise ModelError(
            f"{path.parent / INFO_FILE}: object {obj_id} has diameter {diameter!r}; a positive number of mm is needed"
        )
    _check_box(path, vertices, info)
    return ObjectModel(obj_id, path, vertices, faces, info)


def _read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    try:
        mesh = trimesh.load(path, process=False)
    except Exception as error:  # trimesh raises whatever its parser stumbles over
        raise ModelError(f"{path}: not a readable PLY file ({_first_line(error)})") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ModelError(f"{path}: holds no faces; a triangle mesh is needed")
    faces = np.asarray(mesh.faces)
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise ModelError(f"{path}: vertex {bad} is {vertices[bad].tolist()}; every coordinate must be finite")
    if np.min(faces) < 0 or np.max(faces) >= len(vertices):
        raise ModelError(f"{path}: a face names vertex {int(np.max(faces))}, but there are only {len(vertices)}")
    return vertices, np.ascontiguousarray(faces, dtype=np.int32)


def _check_box(path: Path, vertices_mm: NDArray[np.float64], info: Mapping[str, Any]) -> None:
    """A box that contradicts the mesh means wrong units or another mesh: every label would be wrong."""
    size = np.ptp(vertices_mm, axis=0)
    for axis, measured in zip("xyz", size, strict=True):
        stated = info.get(f"size_{axis}")
        if stated is not None and abs(float(stated) - measured) > _REPORTED_BOX_TOLERANCE_MM + 0.01 * measured:
            raise ModelError(
                f"{path}: is {measured:.3f} mm along {axis}, but {INFO_FILE} says {float(stated):.3f}; "
                "are its units millimetres, and is it the right mesh?"
            )


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
