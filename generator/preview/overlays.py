"""Labels as lines: outlines of masks, and boxes and axes of poses, in pixels of the image.

Pixel (i, j) has its centre at (u, v) = (i, j).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Segment = list[float]

BOX_EDGES = tuple((i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit)
"""Pairs of corners that differ along one side; x varies slowest, as in ``labels.box_corners_mm``."""

_NEAR_MM = 10.0
_TOLERANCE_PX = 0.6


def outline(mask: NDArray[np.bool_]) -> str:
    """The border of a mask as an SVG path, holes included (fill-rule evenodd); "" for an empty mask.

    It runs through the centres of the border pixels, simplified by at most 0.6 pixels.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return "".join(_closed(cv2.approxPolyDP(contour, _TOLERANCE_PX, True).reshape(-1, 2)) for contour in contours)


def _closed(points: NDArray[Any]) -> str:
    return "M" + "L".join(f"{u} {v}" for u, v in points.tolist()) + "Z"


def box_lines(K: Floats, R_m2c: Floats, t_m2c: Floats, corners_mm: Floats) -> list[Segment]:
    """The twelve edges of a box in the image; parts behind the camera are cut off.

    Args:
        K: (3, 3) camera matrix, pixels.
        R_m2c, t_m2c: pose, (3, 3) and (3,) mm.
        corners_mm: (8, 3), in the order of ``labels.box_corners_mm``.

    Returns:
        [u, v, u', v'] of each edge that is at least partly before the camera.
    """
    return _lines(K, corners_mm @ R_m2c.T + t_m2c, BOX_EDGES)


def axis_lines(K: Floats, R_m2c: Floats, t_m2c: Floats, length_mm: float) -> list[Segment]:
    """The model frame's x, y and z axis in the image, each from the origin, as ``box_lines``.

    The list is empty unless the origin and all three ends are before the camera: an axis has its colour by its place.
    """
    ends = np.vstack([np.zeros(3), length_mm * np.eye(3)]) @ R_m2c.T + t_m2c
    return _lines(K, ends, ((0, 1), (0, 2), (0, 3))) if (ends[:, 2] > _NEAR_MM).all() else []


def _lines(K: Floats, points_mm: Floats, pairs: Sequence[tuple[int, int]]) -> list[Segment]:
    clipped = (_before_camera(points_mm[a], points_mm[b]) for a, b in pairs)
    return [_rounded(ends @ K.T) for ends in clipped if ends is not None]


def _before_camera(a: Floats, b: Floats) -> Floats | None:
    """The part (2, 3) of a segment that is farther than the near plane."""
    if max(a[2], b[2]) <= _NEAR_MM:
        return None
    if min(a[2], b[2]) <= _NEAR_MM:
        cut = a + (b - a) * ((_NEAR_MM - a[2]) / (b[2] - a[2]))
        a, b = (cut, b) if a[2] <= _NEAR_MM else (a, cut)
    return np.stack([a, b])


def _rounded(homogeneous: Floats) -> Segment:
    pixels: Segment = np.round(homogeneous[:, :2] / homogeneous[:, 2:], 1).ravel().tolist()
    return pixels
