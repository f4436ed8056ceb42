"""Mesh files of any folder: which there are, what they hold, and how large that is."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from synthetless.errors import UserError
from synthetless.symmetry.quaternions import Floats

SUFFIXES = (".ply", ".stl", ".obj", ".off")

_ID = re.compile(r"(?:obj(?:ect)?[ _-]?)?0*(\d+)", re.IGNORECASE)
_SMALLEST_MM, _LARGEST_MM = 2.0, 2000.0
_FLAT = 1e-6
_BLOCK = 1024


@dataclass(frozen=True)
class MeshFiles:
    """The meshes of a folder.

    Attributes:
        paths: by object id.
        are_numbered: whether the ids are only the files' places in alphabetical order, as not all names say one.
    """

    paths: Mapping[int, Path]
    are_numbered: bool


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh that encloses space.

    Attributes:
        vertices_mm: (V, 3) the vertices of faces.
        faces: (F, 3) vertex numbers.
        diameter_mm: largest distance between two vertices.
    """

    vertices_mm: Floats
    faces: NDArray[np.int64]
    diameter_mm: float

    def info(self) -> dict[str, float]:
        """BOP's diameter, min_ and size_ of `models_info.json`, mm."""
        low, size = self.vertices_mm.min(axis=0), np.ptp(self.vertices_mm, axis=0)
        entry = {"diameter": self.diameter_mm}
        entry |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        return entry | {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}


def find_meshes(folder: Path) -> MeshFiles:
    """The PLY, STL, OBJ and OFF files of a folder.

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


def read_mesh(path: Path, scale: float = 1.0) -> Mesh:
    """Read a mesh; coordinates are multiplied by `scale` to give millimetres.

    Raises:
        UserError: the file is no mesh, has no faces, coordinates that are not finite, or no extent in some direction.
    """
    vertices, faces = _triangles(path)
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise UserError(f"{path}: vertex {bad} is {vertices[bad].tolist()}; every coordinate must be finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{path}: a face names vertex {int(faces.max())}, but there are only {len(vertices)}")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used] * scale
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int64), _diameter(path, vertices))


def unit_warning(diameter_mm: float) -> str | None:
    """What is odd about a part's size, if anything: files often hold metres or micrometres."""
    if diameter_mm < _SMALLEST_MM:
        return f"is only {diameter_mm:.3g} mm across: are its units metres? (--scale 1000 turns them into millimetres)"
    if diameter_mm > _LARGEST_MM:
        return f"is {diameter_mm:.0f} mm across: are its units micrometres? (--scale 0.001 turns them into millimetres)"
    return None


def _triangles(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    load: Callable[..., Any] = trimesh.load_mesh
    try:
        mesh = load(path, process=False)
        vertices = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(mesh, "faces", ()), dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises whatever its parsers stumble over
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(f"{path}: not a readable mesh ({reason})") from None
    if len(faces) == 0:
        raise UserError(f"{path}: holds no faces; a triangle mesh is needed")
    return vertices, faces


def _diameter(path: Path, vertices: Floats) -> float:
    """The largest distance of two points of the convex hull."""
    extents = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False, compute_uv=False)
    if not extents[-1] > _FLAT * extents[0]:
        raise UserError(f"{path}: all its points lie in one plane; a part with a thickness is needed")
    try:
        hull = vertices[ConvexHull(vertices).vertices]
    except QhullError:
        hull = np.unique(vertices, axis=0)
    largest = max(float(cdist(hull[i : i + _BLOCK], hull).max()) for i in range(0, len(hull), _BLOCK))
    return largest
