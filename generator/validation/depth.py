"""Depth of one image against its poses, its visible masks and the table, without casting a ray."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from synthetless.annotation.instances import image_window
from synthetless.annotation.raycast import Plane, Rays, pixels_where
from synthetless.dataset.records import Entry
from synthetless.io.images import max_depth_mm
from synthetless.validation.geometry import Array
from synthetless.validation.regions import Mask, Region
from synthetless.validation.report import Finding
from synthetless.validation.source import Source

_SLACK_MM = 0.01
"""Of a depth before it is rounded: what single precision and another machine's arithmetic may change."""


def check_instance_depth(
    source: Source, path: Path, im_id: int, gt_id: int, pose: Entry, visible: Region, depth: Array
) -> Iterator[Finding]:
    """What is seen of an instance has depth and lies, under its pose, inside the model's box."""
    shape = source.shapes.get(pose["obj_id"])
    if shape is None or visible.count == 0:
        return
    recipe = source.recipe
    R, t = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"], dtype=np.float64)
    z = depth[visible.crop][visible.inside]
    missing = int(np.count_nonzero(z == 0))
    if missing and (shape.hull_mm @ R[2] + t[2]).max() < max_depth_mm(recipe.encoding.depth_scale):
        yield Finding("depth", path, f"{missing} of {len(z)} visible pixels have no depth", im_id, gt_id)
    rays = Rays.through(recipe.intrinsics, visible.window)
    rows, columns = pixels_where(visible.inside)
    points = R.T @ (np.stack([rays.x[columns] * z, rays.y[rows] * z, z]) - t[:, None])
    off = np.maximum(shape.low_mm[:, None] - points, points - shape.high_mm[:, None]).max(axis=0)
    stretch = float(np.sqrt(1 + np.square(rays.x).max() + np.square(rays.y).max()))
    slack = stretch * (_SLACK_MM + recipe.encoding.depth_scale / 2) + recipe.labels.visibility_delta_mm
    outside = (off > slack) & (z > 0)
    if outside.any():
        message = (
            f"{int(outside.sum())} of {len(z)} visible pixels lie, under the pose, outside the model's box, "
            f"by up to {float(off[outside].max()):.2f} mm"
        )
        yield Finding("depth", path, message, im_id, gt_id)


def check_table_depth(
    source: Source, path: Path, im_id: int, camera_entry: Entry, seen: Mask, distractors: bool, depth: Array
) -> Iterator[Finding]:
    """Beside the instances there is the table's depth; nowhere is anything below the table.

    Args:
        source: the dataset.
        path: of the depth image.
        im_id: the image.
        camera_entry: its entry in scene_camera.json.
        seen: pixels where an instance is visible.
        distractors: whether something without a label may hide the table.
        depth: millimetres, 0 for none.
    """
    scale = source.recipe.encoding.depth_scale
    table = stored_depth(_table_depth_mm(source, camera_entry), scale)
    slack = scale / 2 * (1 + 1e-6) + _SLACK_MM
    behind = depth - table
    if ((np.abs(behind) <= slack) | (seen & (behind < 0))).all():
        return
    below = (behind > slack) & (table > 0)
    other = (depth == 0) & (table > 0) if distractors else np.abs(behind) > slack
    other &= ~seen & ~below
    what_else = "have no depth" if distractors else "show neither an instance nor the table"
    for where, what in ((below, "are below the table"), (other, what_else)):
        if where.any():
            row, column = (int(place[0]) for place in np.nonzero(where))
            message = (
                f"{int(where.sum())} pixels {what}; the first, column {column}, row {row}, has "
                f"{depth[row, column]:.3f} mm, the table {table[row, column]:.3f}"
            )
            yield Finding("depth", path, message, im_id)


def stored_depth(depth_mm: Array, scale: float) -> Array:
    """What a depth image says of a depth (inf for none), apart from rounding: 0 for none or beyond its range."""
    return np.where(depth_mm < max_depth_mm(scale) + scale / 2, depth_mm, 0.0)


def _table_depth_mm(source: Source, camera_entry: Entry) -> Array:
    """(H, W) z where the pixels' rays meet the table, inf where they do not."""
    R, t = np.array(camera_entry["cam_R_w2c"]).reshape(3, 3), np.array(camera_entry["cam_t_w2c"], dtype=np.float64)
    camera = source.recipe.intrinsics
    return Plane(R, t, 500 * source.recipe.table.size_m).depth_mm(Rays.through(camera, image_window(camera)))
