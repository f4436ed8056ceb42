"""Triangle meshes as the scenes see them: metres, in the model frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in the model frame.

    Attributes:
        vertices_m: (V, 3) float64, metres.
        faces: (F, 3) int32 indices into the vertices, counter-clockwise seen from outside.
        normals: (V, 3) float64 unit vertex normals, or None where the file has none.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64] | None = None
