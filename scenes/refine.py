"""Where an image is worth more light paths, and how Cycles is made to spend them only there.

Most of an image is a table in even light, which few paths render well; edges, shadows and gaps take many. Blender's
adaptive sampling begins at sixteen paths per pixel, more than all that are spent here, and takes a texture for noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.materials import glowing
from synthetless.scenes.spec import Intrinsics
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS

CELL_PX = 4
"""Side of the squares of pixels that are refined or not: smaller ones cost more to cover than they save."""
_AROUND_PX = 3
"""Side of the squares of pixels that noise is measured in."""
_SMOOTH = 0.3
"""Weight of noise where the denoiser has light alone to smooth, and no texture or edge to keep."""
_REACH_PX = 1.0
"""How far beyond its pixel Cycles' pixel filter looks: its radius is 1.5."""
_DISTANCE_M = 0.1
"""Of the stencil from the camera."""
_GAMMA = 2.2
_DARK = 0.02
"""Added to an albedo that is divided by."""
_LARGEST = 64

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


def noisy_cells(light: Image, albedo: Image, smooth: Mask, share: float) -> Mask:
    """The cells (ceil(H / CELL_PX), ceil(W / CELL_PX)) of an image that look noisiest: so large a share.

    Noise is told from texture by the albedo; an edge in the light counts as noise, since pixels of it are noisy.

    Args:
        light: (H, W, 3) of few paths per pixel, linear.
        albedo: (H, W, 3) of what is seen there, with as little noise as can be.
        smooth: (H, W) where noise is removed best.
        share: of the cells, more than 0.
    """
    luminance: NDArray[np.float32] = light @ LUMINANCE_WEIGHTS
    irradiance: NDArray[np.float32] = luminance / (albedo @ LUMINANCE_WEIGHTS + np.float32(_DARK))
    mean, bright = _blurred(irradiance), _blurred(luminance)
    variance = np.maximum(_blurred(irradiance * irradiance) - mean * mean, 0)
    # As displayed: a relative change counts for more where an image is bright.
    seen = variance / (mean * mean + np.float32(1e-6)) * bright ** np.float32(2 / _GAMMA)
    seen[smooth] *= np.float32(_SMOOTH)
    height, width = seen.shape
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    padded = np.pad(seen, ((0, rows * CELL_PX - height), (0, columns * CELL_PX - width)), mode="edge")
    cells = padded.reshape(rows, CELL_PX, columns, CELL_PX).mean(axis=(1, 3))
    chosen = max(1, round(share * cells.size))
    noisy = np.zeros(cells.size, dtype=bool)
    noisy[np.argsort(cells, axis=None, kind="stable")[-chosen:]] = True
    return noisy.reshape(cells.shape)


def _blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.blur(values, (_AROUND_PX, _AROUND_PX)), dtype=np.float32)


def pixels_of(cells: Mask, height: int, width: int) -> Mask:
    """(height, width) where the pixels of cells are."""
    return np.repeat(np.repeat(cells, CELL_PX, axis=0), CELL_PX, axis=1)[:height, :width]


@contextmanager
def stencil(bpy: Any, camera: Any, pinhole: Intrinsics, opened: Mask) -> Iterator[tuple[slice, slice]]:
    """Have bpy render some cells only, which look as they do without.

    A black sheet stands before the camera where they are not: only rays from the camera meet it, and end there. What
    is rendered is the smallest window of the image that all of them are in; its rows and columns are given.

    Args:
        bpy: where to.
        camera: the camera object; it is placed, and stays there.
        pinhole: what it is.
        opened: the cells, as of ``noisy_cells``.
    """
    mesh = bpy.data.meshes.new("stencil")
    corners = _sheet(opened, pinhole)
    count = len(corners)
    mesh.vertices.add(4 * count)
    mesh.vertices.foreach_set("co", corners.astype(np.float32).ravel())
    mesh.loops.add(4 * count)
    mesh.loops.foreach_set("vertex_index", np.arange(4 * count, dtype=np.int32))
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 4 * count, 4, dtype=np.int32))
    mesh.update()
    material = glowing(bpy, (0.0, 0.0, 0.0), is_aimed_at=False)
    mesh.materials.append(material)
    sheet = bpy.data.objects.new("stencil", mesh)
    sheet.matrix_world = camera.matrix_world
    for rays in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(sheet, f"visible_{rays}", False)
    scene = bpy.context.scene
    scene.collection.objects.link(sheet)
    rows, columns = (_extent(opened.any(axis=axis), side) for axis, side in ((1, pinhole.height), (0, pinhole.width)))
    render = scene.render
    render.use_border = render.use_crop_to_border = True
    left, right, bottom, top = columns.start, columns.stop, pinhole.height - rows.stop, pinhole.height - rows.start
    render.border_min_x, render.border_max_x = _inside(left, pinhole.width), _inside(right, pinhole.width)
    render.border_min_y, render.border_max_y = _inside(bottom, pinhole.height), _inside(top, pinhole.height)
    try:
        yield rows, columns
    finally:
        render.use_border = render.use_crop_to_border = False
        bpy.data.batch_remove([sheet, mesh, material])


def _inside(pixel: int, pixels: int) -> float:
    """A share of so many pixels that Blender, which cuts fractions in single precision, takes for this one."""
    return min((pixel + 0.25) / pixels, 1.0)


def _extent(opened: Mask, pixels: int) -> slice:
    """From the first to the last pixel of opened cells along an axis of so many pixels."""
    numbers = np.flatnonzero(opened)
    return slice(int(numbers[0]) * CELL_PX, min((int(numbers[-1]) + 1) * CELL_PX, pixels))


def _sheet(opened: Mask, pinhole: Intrinsics) -> NDArray[np.float64]:
    """(N, 4, 3) corners of squares in Blender's camera frame, metres, that cover all but the opened cells."""
    top, left, size = _squares(~opened)
    sums = np.asarray(cv2.integral(opened.astype(np.uint8)), dtype=np.int32)
    above, below = (_any_open(sums, row, left - 1, 1, size + 2) for row in (top - 1, top + size))
    before, after = (_any_open(sums, top - 1, column, size + 2, 1) for column in (left - 1, left + size))
    # The middle of the first pixel is at 0; an opened cell's pixels are seen from a little beyond its border.
    v0, v1 = top * CELL_PX - 0.5 + _REACH_PX * above, (top + size) * CELL_PX - 0.5 - _REACH_PX * below
    u0, u1 = left * CELL_PX - 0.5 + _REACH_PX * before, (left + size) * CELL_PX - 0.5 - _REACH_PX * after
    u, v = np.stack([u0, u1, u1, u0], axis=1), np.stack([v1, v1, v0, v0], axis=1)
    x, y = (u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy
    corners: NDArray[np.float64] = _DISTANCE_M * np.stack([x, -y, np.full_like(x, -1.0)], axis=-1)
    return corners


def _squares(closed: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Row, column and side of the squares of a quadtree that together are the closed cells, and more beyond them."""
    rows, columns = (-(-side // _LARGEST) * _LARGEST for side in closed.shape)
    left = np.ones((rows, columns), dtype=bool)
    left[: closed.shape[0], : closed.shape[1]] = closed
    found = []
    size = _LARGEST
    while size:
        whole = left.reshape(rows // size, size, columns // size, size).all(axis=(1, 3))
        row, column = np.nonzero(whole)
        found.append((row * size, column * size, np.full(len(row), size)))
        left &= ~np.repeat(np.repeat(whole, size, axis=0), size, axis=1)
        size //= 2
    top, across, sides = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return top, across, sides


def _any_open(
    sums: NDArray[np.int32],
    top: NDArray[np.intp],
    left: NDArray[np.intp],
    height: NDArray[np.intp] | int,
    width: NDArray[np.intp] | int,
) -> Mask:
    """Whether any cell of each rectangle is open, by the sums of the cells above and left; none is beyond the image."""
    r0, r1 = (np.clip(row, 0, sums.shape[0] - 1) for row in (top, top + height))
    c0, c1 = (np.clip(column, 0, sums.shape[1] - 1) for column in (left, left + width))
    return np.asarray(sums[r1, c1] - sums[r0, c1] - sums[r1, c0] + sums[r0, c0] > 0)
