"""Points of a model that lie far from each other, as PVNet and GDR-Net choose them."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_FEWEST_POINTS = 4096
"""A mesh of a few large triangles has too few corners to choose from: its triangles are divided."""


def farthest_points(vertices_mm: Floats, faces: NDArray[np.integer[Any]], count: int) -> Floats:
    """(count, 3) points of a mesh, each the farthest from those before it; the first from the middle of the box.

    Eldar et al., The farthest point strategy for progressive image sampling, IEEE TIP 1997. The same mesh gives the
    same points; of points equally far the first one is taken.

    Args:
        vertices_mm: (V, 3).
        faces: (F, 3).
        count: at most 4096.
    """
    points: Floats = vertices_mm
    while len(points) < _FEWEST_POINTS:
        points, faces = trimesh.remesh.subdivide(points, faces)  # type: ignore[no-untyped-call]
    squared = ((points - (points.min(axis=0) + points.max(axis=0)) / 2) ** 2).sum(axis=1)
    squared_to_chosen = np.full(len(points), np.inf)
    chosen = [int(squared.argmax())]
    while len(chosen) < count:
        squared_to_chosen = np.minimum(squared_to_chosen, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(squared_to_chosen.argmax()))
    return points[chosen]
