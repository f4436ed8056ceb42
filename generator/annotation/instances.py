"""What is measured of one image, and how: windows of pixels, and bop_toolkit's counts and boxes over them.

Plain data, camera frame, millimetres. The rules are those of bop_toolkit's calc_gt_info.py and visibility.py
(https://github.com/thodan/bop_toolkit).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.spec import Intrinsics, Role

Box = tuple[int, int, int, int]
MeshKey = tuple[Role, int]
"""A mesh among those of a scene: the role of its models folder, and its object id there."""

BACKGROUND = -1
"""Instance id of a pixel that shows the table, a distractor or nothing."""


@dataclass(frozen=True, eq=False)
class PosedModel:
    """A model in front of the camera.

    Attributes:
        obj_id: the model's BOP id.
        R_m2c: (3, 3) float64 rotation, model to camera (OpenCV: x right, y down, z forward).
        t_m2c: (3,) float64 translation, millimetres.
        role: "model" if it may get labels; a distractor is of another models folder.
    """

    obj_id: int
    R_m2c: NDArray[np.float64]
    t_m2c: NDArray[np.float64]
    role: Role = "model"

    @property
    def key(self) -> MeshKey:
        """Of its mesh."""
        return self.role, self.obj_id


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
class Illumination:
    """How the projector of a depth camera reaches what an image shows.

    Attributes:
        lit: (H, W) bool, whether nothing is between the surface and the projector.
        cosine: (H, W) float32, of the angle between the viewing ray and the surface's normal; 0 without depth.
        owner: (H, W) int32, the body that is seen: number among instances and, after them, occluders; the table comes
            last, -1 is nothing.
    """

    lit: NDArray[np.bool_]
    cosine: NDArray[np.float32]
    owner: NDArray[np.int32]


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
        illumination: of all instances and occluders that were posed, however ``restricted``. Or None.
    """

    depth_mm: NDArray[np.float64]
    instance_ids: NDArray[np.int32]
    instances: tuple[InstanceAnnotation, ...]
    normals: NDArray[np.float32] | None = None
    object_coordinates_mm: NDArray[np.float32] | None = None
    illumination: Illumination | None = None

    def where_valid(self, has_depth: NDArray[np.bool_]) -> ImageAnnotation:
        """The same image with ``px_count_valid`` counted where a depth image holds a depth; without that, where any is.

        Args:
            has_depth: (H, W), as ``synthetless.io.images.has_depth`` gives it.
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


NO_BOX: Box = (-1, -1, -1, -1)


@dataclass(frozen=True)
class Window:
    """The pixels with left <= i < right and top <= j < bottom; it may leave the image, and it may be empty."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of an array over this window."""
        return max(0, self.bottom - self.top), max(0, self.right - self.left)

    def intersection(self, other: Window) -> Window:
        """The pixels of both windows; where there are none, an empty window inside this one."""
        left, top = _clamp(other.left, self.left, self.right), _clamp(other.top, self.top, self.bottom)
        right, bottom = _clamp(other.right, left, self.right), _clamp(other.bottom, top, self.bottom)
        return Window(left, top, max(left, right), max(top, bottom))

    def slices_in(self, outer: Window) -> tuple[slice, slice]:
        """Where this window's pixels are in an array over ``outer``; ``outer`` contains it, or it is empty."""
        rows = slice(self.top - outer.top, self.bottom - outer.top)
        return rows, slice(self.left - outer.left, self.right - outer.left)


def image_window(camera: Intrinsics) -> Window:
    """All pixels of the image."""
    return Window(0, 0, camera.width, camera.height)


def canvas_window(camera: Intrinsics) -> Window:
    """bop_toolkit's canvas for truncated objects: the image and as much again on every side."""
    return Window(-camera.width, -camera.height, 2 * camera.width, 2 * camera.height)


def bounding_box(mask: NDArray[np.bool_], window: Window) -> Box:
    """[x, y, w, h] of a mask over a window, with w = xmax - xmin; NO_BOX if it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return NO_BOX
    x, y = window.left + int(columns[0]), window.top + int(rows[0])
    return x, y, int(columns[-1] - columns[0]), int(rows[-1] - rows[0])


def visible_within(
    depth_mm: NDArray[np.float64],
    scene_depth_mm: NDArray[np.float64],
    ray_length: NDArray[np.float64],
    delta_mm: float,
) -> NDArray[np.bool_]:
    """Where a surface is at most ``delta_mm`` behind the nearest one, measured along the ray (BOP's visibility).

    Args:
        depth_mm: z of the object's surface, inf beside it.
        scene_depth_mm: z of the nearest surface, of the same shape; inf where there is none.
        ray_length: length of each pixel's ray up to z = 1.
        delta_mm: the tolerance.
    """
    hit = np.isfinite(depth_mm)
    visible = np.zeros(depth_mm.shape, dtype=bool)
    visible[hit] = (depth_mm[hit] - scene_depth_mm[hit]) * ray_length[hit] <= delta_mm
    return visible


def measure_instance(
    silhouette: NDArray[np.bool_],
    window: Window,
    visible: NDArray[np.bool_],
    image: Window,
) -> InstanceAnnotation:
    """Count one instance's pixels.

    Args:
        silhouette: over ``window``, a part of the canvas that holds the whole silhouette.
        window: see above.
        visible: over the part of ``window`` that is inside the image.
        image: the whole image.
    """
    inside = image.intersection(window)
    mask, mask_visib = np.zeros(image.shape, dtype=bool), np.zeros(image.shape, dtype=bool)
    mask[inside.slices_in(image)] = silhouette[inside.slices_in(window)]
    mask_visib[inside.slices_in(image)] = visible
    px_count_all, px_count_visib = int(np.count_nonzero(silhouette)), int(np.count_nonzero(visible))
    return InstanceAnnotation(
        mask=mask,
        mask_visib=mask_visib,
        px_count_all=px_count_all,
        px_count_valid=int(np.count_nonzero(mask)),
        px_count_visib=px_count_visib,
        visib_fract=px_count_visib / px_count_all if px_count_all else 0.0,
        bbox_obj=bounding_box(silhouette, window) if px_count_visib else NO_BOX,
        bbox_visib=bounding_box(visible, inside),
    )


def _clamp(value: int, low: int, high: int) -> int:
    return min(max(value, low), high)
