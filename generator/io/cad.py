"""CAD files: STEP and IGES, cut into triangles by Open CASCADE, which the package cascadio brings (extra `cad`).

The same file gives the same triangles. Lengths come in the file's own unit and are turned into millimetres.
"""

from __future__ import annotations

import ctypes
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.extras import has, remedy

CAD_SUFFIXES = (".step", ".stp", ".iges", ".igs")
TESSELLATION_MM = 0.05
"""How far triangles may be from the surface, unless another tolerance is asked for."""

_ANGLE_RAD = 0.5
"""How far neighbouring triangles may be turned: small roundings stay round, whatever the tolerance."""
_MM = {"step": 1000.0, "iges": 1.0}
"""cascadio 0.1 gives metres of a STEP file, millimetres of an IGES file."""


def read_cad(data: bytes, suffix: str, tolerance_mm: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surfaces of a CAD file; those of all its solids together.

    Args:
        data: content of the file.
        suffix: of its name, one of ``CAD_SUFFIXES``.
        tolerance_mm: how far a triangle may be from the surface.

    Returns:
        (V, 3) vertices, mm, each where it is once, and (F, 3) their numbers.

    Raises:
        UserError: cascadio is not installed, or the file is damaged or holds no surface; without the file's name.
    """
    if not has("cascadio"):
        raise UserError(
            f"CAD files need the package cascadio; {remedy('cad')}, or convert the file to PLY, STL, OBJ or OFF"
        )
    import cascadio
    import trimesh

    kind: Literal["step", "iges"] = "step" if suffix.lower() in (".step", ".stp") else "iges"
    with _silenced():
        options: dict[str, Any] = {"tol_linear": tolerance_mm, "tol_angular": _ANGLE_RAD, "use_parallel": False}
        glb: bytes = cascadio.load(data, file_type=kind, **options)
    if not glb:
        raise UserError(f"is no {kind.upper()} file that Open CASCADE can read")
    scene: Any = trimesh.load_scene(io.BytesIO(glb), file_type="glb")
    mesh = scene.to_geometry() if scene.geometry else None
    if mesh is None or not len(mesh.faces):
        raise UserError("holds no surface")
    vertices, numbers = np.unique(np.asarray(mesh.vertices, dtype=np.float64), axis=0, return_inverse=True)
    faces = numbers.reshape(-1)[np.asarray(mesh.faces)].astype(np.int64)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)  # a pole of a sphere is a point, not an edge
    return vertices * _MM[kind], faces[distinct]


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep what Open CASCADE prints, past Python, away from a command's answers."""
    c_library = ctypes.CDLL(None)
    sys.stdout.flush()
    c_library.fflush(None)
    kept = [os.dup(number) for number in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for number in (1, 2):
            os.dup2(nowhere, number)
        yield
    finally:
        c_library.fflush(None)
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)
