"""Normals and object coordinates of one image against its depth, its poses and its visible masks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from synthetless.annotation.instances import image_window
from synthetless.annotation.raycast import Rays
from synthetless.dataset.records import Entry
from synthetless.io.images import COORDINATE_SCALE_MM
from synthetless.validation.geometry import Array
from synthetless.validation.regions import Region, union
from synthetless.validation.report import Finding
from synthetless.validation.source import Source

_UNIT_SLACK = 1e-4
_SLACK_MM = 0.01


def check_normals(path: Path, im_id: int, normals: Array, depth: Array | None) -> Iterator[Finding]:
    """Normals have unit length, and there are some wherever there is depth."""
    length = np.linalg.norm(normals, axis=2)
    bad = int(np.count_nonzero((length > 0) & (np.abs(length - 1) > _UNIT_SLACK)))
    if bad:
        yield Finding("geometry", path, f"{bad} normals are not of unit length", im_id)
    lacking = 0 if depth is None else int(np.count_nonzero((length == 0) & (depth > 0)))
    if lacking:
        yield Finding("geometry", path, f"{lacking} pixels have depth, but no normal", im_id)


def check_coordinates(
    source: Source,
    path: Path,
    im_id: int,
    gt: Sequence[Entry],
    visible: Mapping[int, Region],
    coordinates: Array,
    depth: Array | None,
) -> Iterator[Finding]:
    """Object coordinates are where instances are seen, and under the pose each lies on its pixel's ray, in its depth.

    Args:
        source: the dataset; its visibility is exact.
        path: of the object coordinates.
        im_id: the image.
        gt: its poses.
        visible: visible regions by gt_id.
        coordinates: (H, W, 4) millimetres, and 1 where there is a point.
        depth: millimetres, or None.
    """
    points_mm, present = coordinates[..., :3], coordinates[..., 3] > 0
    camera = source.recipe.camera
    if len(visible) == len(gt):
        odd = int(np.count_nonzero(present != union(visible.values(), (camera.height, camera.width))))
        if odd:
            yield Finding("geometry", path, f"{odd} pixels have coordinates and no instance, or the reverse", im_id)
    rays = Rays.through(source.recipe.intrinsics, image_window(source.recipe.intrinsics))
    for gt_id, region in visible.items():
        rows, columns = np.nonzero(region.pixels & present)
        pose = gt[gt_id]
        R, t = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"])
        in_camera = points_mm[rows, columns] @ R.T + t
        off = np.abs(in_camera - rays.at(rows, columns) * in_camera[:, 2:]).max(axis=1, initial=0.0)
        slack = 2 * COORDINATE_SCALE_MM + _SLACK_MM
        if depth is not None:
            off = np.maximum(off, np.abs(in_camera[:, 2] - depth[rows, columns]))
            slack += source.recipe.encoding.depth_scale / 2
        wrong = off > slack
        if wrong.any():
            message = f"{int(wrong.sum())} points are, under the pose, up to {off.max():.2f} mm away from their pixel"
            yield Finding("geometry", path, message, im_id, gt_id)
