"""From eight predicted box corners to a pose, by PnP; what is no pose is a miss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.learning.pose_error import RigidPose
from synthetless.scenes.lens import undistorted_pixels

Floats = NDArray[np.float64]

_SMALLEST_SPREAD_PX = 1.0
"""Corners that all lie within this standard deviation have collapsed to a point."""


def solve_pose(corners_px: Floats, box_mm: Floats, K: Floats, distortion: Floats | None = None) -> RigidPose | None:
    """The pose whose projected box corners come nearest to the given ones; None if there is none.

    Args:
        corners_px: (8, 2) predicted pixels.
        box_mm: (8, 3) the model's box corners, in the same order.
        K: (3, 3) camera matrix.
        distortion: (5,) of the lens; None for a pinhole. Corners at which it shows nothing have no pose.

    Corners that have collapsed, which is what true poses of symmetric parts teach a network, have no pose: OpenCV's
    SQPNP raises, or answers with numbers that are not finite, or with a pose behind the camera.
    """
    if not np.isfinite(corners_px).all() or corners_px.std(axis=0).max() < _SMALLEST_SPREAD_PX:
        return None
    straight_px = undistorted_pixels(corners_px, K, distortion)
    if not np.isfinite(straight_px).all():
        return None
    try:
        found, turn, t = cv2.solvePnP(
            np.ascontiguousarray(box_mm, dtype=np.float64),
            np.ascontiguousarray(straight_px, dtype=np.float64),
            np.ascontiguousarray(K, dtype=np.float64),
            np.zeros(4),
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        return None
    t_mm = t.ravel()
    if not found or not (np.isfinite(turn).all() and np.isfinite(t_mm).all()) or t_mm[2] <= 0:
        return None
    return RigidPose(np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64), np.asarray(t_mm, dtype=np.float64))
