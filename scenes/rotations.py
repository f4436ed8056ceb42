"""Unit quaternions (w, x, y, z) and rotation matrices, as the scenes need them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.spec import Quaternion


def random_rotation(rng: np.random.Generator) -> Quaternion:
    """A rotation uniform on SO(3): a normalised Gaussian 4-vector (Shoemake, Graphics Gems III, 1992)."""
    q = rng.standard_normal(4)
    w, x, y, z = (q / np.linalg.norm(q)).tolist()
    return (w, x, y, z)


def matrix(rotation_wxyz: Quaternion) -> NDArray[np.float64]:
    """(3, 3) rotation matrix of a quaternion, which need not be exactly of unit length."""
    w, x, y, z = np.asarray(rotation_wxyz, dtype=np.float64) / math.hypot(*rotation_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
