"""Object models: BOP's folder of PLY files and models_info.json, read once and checked thoroughly."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.io.documents import read_document, shown
from synthetless.io.files import read_json
from synthetless.io.images import encode_png
from synthetless.io.meshes import SUFFIXES, TriangleMesh, read_mesh
from synthetless.scenes.spec import SurfaceColours

INFO_FILE = "models_info.json"
NAMES_FILE = "names.yaml"
"""What the objects of a models folder are called: `1: bracket`, ..."""
_PLY_NAME = re.compile(r"obj_(\d{6})\.ply")
_ID = re.compile(r"(?:obj(?:ect)?[ _-]?)?0*(\d+)", re.IGNORECASE)
_REPORTED_BOX_TOLERANCE_MM = 0.5
_LARGEST_MM = 1e9


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object model, millimetres, in its BOP model frame.

    Attributes:
        obj_id: BOP object id.
        path: the PLY file.
        vertices_mm: (V, 3) float64, each used by a face.
        faces: (F, 3) int32.
        info: the object's entry in models_info.json: diameter, box and symmetries.
        is_verbatim: whether the file holds exactly these vertices and triangles.
        colours: of its surface, if they were asked for and the file has any.
    """

    obj_id: int
    path: Path
    vertices_mm: NDArray[np.float64]
    faces: NDArray[np.int32]
    info: Mapping[str, Any]
    is_verbatim: bool = True
    colours: SurfaceColours | None = None

    @property
    def diameter_mm(self) -> float:
        """Largest distance between two vertices, as models_info.json gives it."""
        return float(self.info["diameter"])

    @property
    def box_corners_mm(self) -> NDArray[np.float64]:
        """(8, 3) corners of the axis-aligned box of the vertices, in ``box_corners``' order."""
        return box_corners(self.vertices_mm.min(axis=0), self.vertices_mm.max(axis=0))

    @property
    def digest(self) -> str:
        """SHA-256 of the PLY file that a dataset carries."""
        return hashlib.sha256(self.to_ply()).hexdigest()

    def to_ply(self) -> bytes:
        """The PLY file that a dataset carries: the model's own where that is this mesh, else one written of it."""
        if self.is_verbatim:
            return self.path.read_bytes()
        mesh = TriangleMesh(self.vertices_mm, self.faces.astype(np.int64), self.is_verbatim, self.colours)
        return mesh.to_ply(texture_file(self.obj_id))

    def to_png(self) -> bytes | None:
        """The texture that a dataset carries beside the PLY file; None if there is none."""
        return None if self.colours is None or self.colours.texture is None else encode_png(self.colours.texture)


def texture_file(obj_id: int) -> str:
    """The name of a model's texture, as BOP has it."""
    return f"obj_{obj_id:06d}.png"


def box_corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """(8, 3) corners of the box between two points (3,); x varies slowest, z fastest."""
    is_high = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=bool)
    return np.where(is_high, high, low)


BOX_EDGES = tuple((i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit)
"""The 12 edges of ``box_corners``, as pairs of corners that differ along one axis."""


@dataclass(frozen=True)
class MeshFiles:
    """The meshes of a folder.

    Attributes:
        paths: by object id.
        are_numbered: whether the ids are only the files' places in alphabetical order, as not all names say one.
    """

    paths: Mapping[int, Path]
    are_numbered: bool


def find_meshes(folder: Path) -> MeshFiles:
    """The PLY, STL, OBJ, OFF and GLB files of any folder.

    Ids come from the names (`obj_000012.ply`, `12.stl`) if all of them say one, else from alphabetical order.

    Raises:
        UserError: no such folder, no mesh in it, or two of one id.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give one that holds meshes ({', '.join(SUFFIXES)})")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    if not files:
        raise UserError(f"{folder}: holds no meshes; files that end in {', '.join(SUFFIXES)} are looked for")
    matches = [_ID.fullmatch(path.stem) for path in files]
    if not all(matches):
        return MeshFiles(dict(enumerate(files, start=1)), are_numbered=True)
    paths: dict[int, Path] = {}
    for path, match in zip(files, matches, strict=True):
        obj_id = int(match[1]) if match else 0
        if obj_id in paths:
            raise UserError(f"{folder}: {paths[obj_id].name} and {path.name} are both object {obj_id}; remove one")
        paths[obj_id] = path
    return MeshFiles(dict(sorted(paths.items())), are_numbered=False)


def load_models(folder: Path, obj_ids: tuple[int, ...] | None = None, colours: bool = False) -> dict[int, ObjectModel]:
    """Read a BOP models folder.

    Args:
        folder: holds obj_%06d.ply and models_info.json.
        obj_ids: read only these; all of them if None.
        colours: whether to read the colours of their surfaces, too.

    Returns:
        Models by id, in ascending order.

    Raises:
        UserError: the folder, a mesh, its texture or models_info.json is missing or unusable.
    """
    files = _find_meshes(folder)
    info = read_models_info(folder)
    wanted = sorted(files) if obj_ids is None else sorted(set(obj_ids))
    for obj_id in wanted:
        if obj_id not in files:
            known = ", ".join(str(i) for i in sorted(files))
            raise UserError(f"{folder}: no mesh for object {obj_id}; the folder holds objects {known}")
        if obj_id not in info:
            raise UserError(
                f"{folder / INFO_FILE}: no entry for object {obj_id} ({files[obj_id].name}); "
                "add its diameter, box and symmetries, or leave it out with objects.ids"
            )
    return {obj_id: _load_model(obj_id, files[obj_id], info[obj_id], colours) for obj_id in wanted}


def read_models_info(folder: Path) -> dict[int, dict[str, Any]]:
    """models_info.json by object id, with the names that names.yaml beside it gives to objects.

    Raises:
        UserError: it is missing, not JSON, names a key twice, or is not a mapping of ids to entries; or names.yaml is
            unusable, or names an object that is not there.
    """
    path = folder / INFO_FILE
    if not path.exists():
        raise UserError(f"{path}: not found; a BOP models folder needs it")
    content = read_json(path)
    entries: dict[int, dict[str, Any]] = {}
    for key, entry in content.items():
        if not (key.strip().isascii() and key.strip().isdecimal()):
            raise UserError(f'{path}: the key {shown(key)} is not an object id, such as "1"')
        if not isinstance(entry, dict):
            raise UserError(f"{path}: object {key} is {shown(entry)}, not a mapping of diameter, box and symmetries")
        if int(key) in entries:
            raise UserError(f"{path}: object {int(key)} is listed twice, once as {shown(key)}")
        entries[int(key)] = entry
    for obj_id, name in read_names(folder).items():
        if obj_id not in entries:
            raise UserError(f"{folder / NAMES_FILE}: object {obj_id} has a name, but no entry in {INFO_FILE}")
        entries[obj_id] = entries[obj_id] | {"name": name}
    return entries


def read_names(folder: Path) -> dict[int, str]:
    """names.yaml by object id; empty if there is none.

    Raises:
        UserError: it is no mapping of object ids to names of one line, or two objects have the same one.
    """
    path = folder / NAMES_FILE
    content = read_document(path) if path.exists() else None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise UserError(f"{path}: is {shown(content)}; object ids and names are needed, as `1: bracket`")
    names: dict[int, str] = {}
    for key, name in content.items():
        text = str(key).strip()
        if not (text.isascii() and text.isdecimal()):
            raise UserError(f"{path}: the key {shown(key)} is no object id, such as 1")
        if not (isinstance(name, str) and name.strip() and name.isprintable()):
            raise UserError(f"{path}: object {text} is called {shown(name)}; a name of one line is needed")
        if name.strip() in names.values():
            raise UserError(f"{path}: {shown(name)} is the name of two objects; give each one of its own")
        names[int(text)] = name.strip()
    return names


def object_names(infos: Mapping[int, Mapping[str, Any]]) -> dict[int, str]:
    """The names of those objects whose entries in models_info.json have one."""
    names = {obj_id: info.get("name") for obj_id, info in infos.items()}
    return {obj_id: name for obj_id, name in names.items() if isinstance(name, str) and name}


def _find_meshes(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such models folder; give one that holds obj_000001.ply, ...")
    files = {
        int(match.group(1)): path for path in sorted(folder.iterdir()) if (match := _PLY_NAME.fullmatch(path.name))
    }
    if not files:
        raise UserError(f"{folder}: holds no models; expected files named obj_000001.ply, ...")
    return files


def _load_model(obj_id: int, path: Path, info: Mapping[str, Any], colours: bool) -> ObjectModel:
    mesh = read_mesh(path, colours=colours)
    if _length_mm(path, obj_id, info, "diameter") == 0:
        raise UserError(f"{path.parent / INFO_FILE}: object {obj_id} has diameter 0; a positive number of mm is needed")
    _check_box(path, obj_id, mesh.vertices_mm, info)
    is_verbatim = mesh.is_verbatim and mesh.texture_file in (None, texture_file(obj_id))
    return ObjectModel(obj_id, path, mesh.vertices_mm, mesh.faces.astype(np.int32), info, is_verbatim, mesh.colours)


def _check_box(path: Path, obj_id: int, vertices_mm: NDArray[np.float64], info: Mapping[str, Any]) -> None:
    """A box that contradicts the mesh means wrong units or another mesh: every label would be wrong."""
    size = np.ptp(vertices_mm, axis=0)
    for axis, measured in zip("xyz", size, strict=True):
        if info.get(f"size_{axis}") is None:
            continue
        stated = _length_mm(path, obj_id, info, f"size_{axis}")
        if abs(stated - measured) > _REPORTED_BOX_TOLERANCE_MM + 0.01 * measured:
            raise UserError(
                f"{path}: is {measured:.3f} mm along {axis}, but {INFO_FILE} says {stated:.3f}; "
                "are its units millimetres, and is it the right mesh?"
            )


def _length_mm(path: Path, obj_id: int, info: Mapping[str, Any], key: str) -> float:
    """A length that models_info.json states."""
    value = info.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < _LARGEST_MM:
        return value
    raise UserError(
        f"{path.parent / INFO_FILE}: object {obj_id} has {key} {shown(value)}; a positive number of mm is needed"
    )
