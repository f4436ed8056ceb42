"""A coarse distance field: quick answers to where a mesh's surface is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from synthetless.symmetry.quaternions import Floats

_GRID = 112


class DistanceField:
    """Distances to a surface on a grid around its centre, right to about a voxel (1 % of the diameter)."""

    def __init__(self, center: Floats, dense: Floats) -> None:
        """Take the centre (3,) and densely spread surface points (N, 3)."""
        radius = float(np.linalg.norm(dense - center, axis=1).max())
        self._center = center
        self._voxel = 2.1 * radius / (_GRID - 1)
        free = np.ones((_GRID,) * 3, dtype=bool)
        free[tuple(np.moveaxis(self._cell(dense), -1, 0))] = False
        self._values = (distance_transform_edt(free) * self._voxel).astype(np.float32)

    def __call__(self, points: Floats) -> NDArray[np.float32]:
        """Distances (...) at points (..., 3)."""
        i, j, k = np.moveaxis(self._cell(points), -1, 0)
        return np.asarray(self._values[i, j, k])

    def _cell(self, points: Floats) -> NDArray[np.int64]:
        cells = np.rint((points - self._center) / self._voxel + (_GRID - 1) / 2)
        return np.asarray(np.clip(cells, 0, _GRID - 1).astype(np.int64))
