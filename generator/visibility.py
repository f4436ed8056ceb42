"""What of an object is in the picture: windows of pixels, and bop_toolkit's counts and boxes over them.

The rules are those of bop_toolkit's calc_gt_info.py and visibility.py (https://github.com/thodan/bop_toolkit).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from generator.annotation import Box, InstanceAnnotation
from scenes.spec import Intrinsics

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
