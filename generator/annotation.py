"""What is measured of one image: the exact geometry behind its pixels. Plain data, camera frame, millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Box = tuple[int, int, int, int]

BACKGROUND = -1
"""Instance id of a pixel that shows the table, a distractor or nothing."""


@dataclass(frozen=True, eq=False)
class PosedModel:
    """A model in front of the camera.

    Attributes:
        obj_id: the model's BOP id.
        R_m2c: (3, 3) float64 rotation, model to camera (OpenCV: x right, y down, z forward).
        t_m2c: (3,) float64 translation, millimetres.
    """

    obj_id: int
    R_m2c: NDArray[np.float64]
    t_m2c: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class InstanceAnnotation:
    """One instance in one image, counted as bop_toolkit counts.

    Attributes:
        mask: (H, W) bool, the whole silhouette inside the image, occluded or not (amodal).
        mask_visib: (H, W) bool, its visible part.
        px_count_all: pixels of the whole silhouette, also those up to one image size outside the border.
        px_count_valid: pixels of ``mask`` where the image has depth; see ``ImageAnnotation.where_valid``.
        px_count_visib: pixels of ``mask_visib``.
        visib_fract: px_count_visib / px_count_all, 0 where nothing is seen.
        bbox_obj: [x, y, w, h] of the whole silhouette with w = xmax - xmin; may leave the image.
        bbox_visib: the same of the visible part; both boxes are (-1, -1, -1, -1) where nothing is visible.
    """

    mask: NDArray[np.bool_]
    mask_visib: NDArray[np.bool_]
    px_count_all: int
    px_count_valid: int
    px_count_visib: int
    visib_fract: float
    bbox_obj: Box
    bbox_visib: Box


@dataclass(frozen=True, eq=False)
class ImageAnnotation:
    """One image.

    Attributes:
        depth_mm: (H, W) float64, z of the surface behind each pixel centre; 0 where the ray meets nothing.
        instance_ids: (H, W) int32, index into ``instances`` of the nearest surface, or BACKGROUND.
        instances: in the order of the posed models.
        normals: (H, W, 3) float32 geometric unit normals, camera frame, facing the camera; 0 without depth. Or None.
        object_coordinates_mm: (H, W, 3) float32, model coordinates of the surface point where
            ``instance_ids`` >= 0, else 0. Or None.
    """

    depth_mm: NDArray[np.float64]
    instance_ids: NDArray[np.int32]
    instances: tuple[InstanceAnnotation, ...]
    normals: NDArray[np.float32] | None = None
    object_coordinates_mm: NDArray[np.float32] | None = None

    def where_valid(self, has_depth: NDArray[np.bool_]) -> ImageAnnotation:
        """The same image with ``px_count_valid`` counted where a depth image holds a depth; without that, where any is.

        Args:
            has_depth: (H, W), as ``generator.formats.images.has_depth`` gives it.
        """
        instances = tuple(
            replace(instance, px_count_valid=int(np.count_nonzero(instance.mask & has_depth)))
            for instance in self.instances
        )
        return replace(self, instances=instances)

    def restricted(self, numbers: Sequence[int]) -> ImageAnnotation:
        """The same image with only these instances, renumbered in the given order.

        Args:
            numbers: indices into ``instances``; the ones left out must fill no pixel of ``instance_ids``.
        """
        renumbered = np.full(len(self.instances) + 1, BACKGROUND, dtype=np.int32)  # the last entry serves BACKGROUND
        renumbered[list(numbers)] = np.arange(len(numbers), dtype=np.int32)
        kept = tuple(self.instances[number] for number in numbers)
        return replace(self, instances=kept, instance_ids=renumbered[self.instance_ids])
