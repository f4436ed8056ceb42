"""What poses and models alone say of an image, without a ray: where a model's points are and where they project to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from synthetless.annotation.instances import Box, Window
from synthetless.annotation.raycast import NEAR_CLIP_MM
from synthetless.scenes.rotations import matrix
from synthetless.scenes.spec import Intrinsics, Pose

Array = NDArray[np.float64]

ROTATION_TOLERANCE = 1e-9
_SILHOUETTE_SLACK_PX = 0.01
"""How far single precision may move a silhouette."""


@dataclass(frozen=True, eq=False)
class Shape:
    """The outside of a model, millimetres, model frame.

    Attributes:
        low_mm, high_mm: (3,) corners of its box.
        hull_mm: (P, 3) points whose convex hull holds it.
    """

    low_mm: Array
    high_mm: Array
    hull_mm: Array

    @classmethod
    def of(cls, vertices_mm: Array) -> Self:
        """The shape of a mesh with these vertices (V, 3)."""
        try:
            hull = vertices_mm[ConvexHull(vertices_mm).vertices]
        except QhullError:  # a flat mesh
            hull = vertices_mm
        return cls(vertices_mm.min(axis=0), vertices_mm.max(axis=0), hull)


def rotation_error(R: Array) -> Array:
    """(N,) largest deviation of matrices (N, 3, 3) from being rotations: from R R^T = I and from det R = 1."""
    deviation = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray(np.maximum(deviation, np.abs(np.linalg.det(R) - 1.0)))


def model_to_camera(pose: Pose, R_w2c: Array, t_w2c: Array) -> tuple[Array, Array]:
    """R_m2c (3, 3) and t_m2c (3,) mm of a pose in the world (metres), under a camera in millimetres."""
    return R_w2c @ matrix(pose.rotation_wxyz), R_w2c @ (1000 * np.array(pose.position_m)) + t_w2c


def silhouette_limits(camera: Intrinsics, shape: Shape, R_m2c: Array, t_m2c: Array) -> Box | None:
    """[x, y, w, h] with w = xmax - xmin of the pixels that can show a model at all; may leave the image.

    None where a part of the model is too near to the camera or behind it.
    """
    points = shape.hull_mm @ R_m2c.T + t_m2c
    if points[:, 2].min() < NEAR_CLIP_MM:
        return None
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    left, top = (int(np.ceil(low - _SILHOUETTE_SLACK_PX)) for low in (u.min(), v.min()))
    right, bottom = (int(np.floor(high + _SILHOUETTE_SLACK_PX)) for high in (u.max(), v.max()))
    return left, top, right - left, bottom - top


def contains(outer: Box, inner: Box) -> bool:
    """Whether a box [x, y, w, h] with w = xmax - xmin is inside another."""
    return (
        outer[0] <= inner[0]
        and outer[1] <= inner[1]
        and inner[0] + inner[2] <= outer[0] + outer[2]
        and inner[1] + inner[3] <= outer[1] + outer[3]
    )


def window_box(window: Window) -> Box:
    """The box of all pixels of a window that is not empty."""
    return window.left, window.top, window.right - window.left - 1, window.bottom - window.top - 1
