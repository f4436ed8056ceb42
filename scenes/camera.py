"""The camera: where it stands, and how Blender is told exactly the pinhole model of OpenCV and BOP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.scenes.spec import Intrinsics, Pose, View

_SENSOR_WIDTH_MM = 36.0
_CV_TO_BLENDER = np.diag([1.0, -1.0, -1.0])
"""Blender's camera looks along -z with y up; OpenCV's looks along +z with y down."""


def extrinsics(view: View, centre_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pose of a camera that looks at the objects.

    Args:
        view: distance, angles and offset of the aim.
        centre_m: (3,) centre of the settled objects, world frame.

    Returns:
        R_w2c (3, 3) and t_w2c (3,) in metres: ``x_cam = R_w2c x_world + t_w2c``, OpenCV camera frame.
    """
    elevation, azimuth, roll = np.radians([view.elevation_deg, view.azimuth_deg, view.roll_deg])
    outwards = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    forward = -outwards
    down = np.cross(forward, right)
    cos, sin = math.cos(roll), math.sin(roll)
    R_w2c = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    position = np.asarray(centre_m, dtype=np.float64) + view.aim_offset_m + view.distance_m * outwards
    return R_w2c, -R_w2c @ position


def finest_pixel_m(R_w2c: NDArray[np.float64], t_w2c_m: NDArray[np.float64], intrinsics: Intrinsics) -> float:
    """Side of the smallest patch, facing the camera, that a pixel sees of the table; infinite if it sees none of it.

    The patch is z / f wide at depth z, and of all pixels that see the table one in a corner is nearest to it.
    """
    u, v = (np.array([-0.5, side - 0.5]) for side in (intrinsics.width, intrinsics.height))
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((2, 2))], axis=-1).reshape(4, 3) @ R_w2c
    height_m = float(-R_w2c[:, 2] @ t_w2c_m)
    steepest = float(-rays[:, 2].min())
    return height_m / steepest / max(intrinsics.fx, intrinsics.fy) if steepest > 0 else math.inf


def settled_centre(settled: Sequence[Pose]) -> NDArray[np.float64]:
    """(3,) mean of the positions of objects at rest, metres: the point that a view's aim is offset from."""
    mean: NDArray[np.float64] = np.array([pose.position_m for pose in settled], dtype=np.float64).mean(axis=0)
    return mean


def place(camera: Any, R_w2c: NDArray[np.float64], t_w2c_m: NDArray[np.float64]) -> None:
    """Give a bpy camera object the pose of an OpenCV camera."""
    from mathutils import Matrix

    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = R_w2c.T @ _CV_TO_BLENDER
    world_from_camera[:3, 3] = -R_w2c.T @ t_w2c_m
    camera.matrix_world = Matrix(world_from_camera.tolist())


def set_intrinsics(scene: Any, camera: Any, intrinsics: Intrinsics) -> None:
    """Set image size, focal lengths and principal point of a bpy scene and camera object.

    Blender measures the principal point from the image's border, where OpenCV measures from the centre of the
    first pixel: hence the half pixel. Different focal lengths are pixels that are not square.
    """
    render, data = scene.render, camera.data
    render.resolution_x, render.resolution_y = intrinsics.width, intrinsics.height
    render.resolution_percentage = 100
    pixel_height = intrinsics.fx / intrinsics.fy  # in units of the pixel's width
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1 / pixel_height), max(1.0, pixel_height)
    data.type = "PERSP"
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = _SENSOR_WIDTH_MM
    data.lens = intrinsics.fx * _SENSOR_WIDTH_MM / intrinsics.width
    data.shift_x = (intrinsics.width / 2 - (intrinsics.cx + 0.5)) / intrinsics.width
    data.shift_y = ((intrinsics.cy + 0.5) - intrinsics.height / 2) * pixel_height / intrinsics.width
    data.clip_start, data.clip_end = 0.01, 1000.0
