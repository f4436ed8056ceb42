"""What a denoiser may know of an image before it is rendered: albedo and normals of the surfaces, without noise.

Both are means over the same points of a pixel, weighed as Cycles weighs its samples. Where no edge is near one ray is
enough. The table's texture is looked up at every point, in a copy whose texels are about as large as the points are
apart (L. Williams, Pyramidal parametrics, 1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import Plane, PosedSurface, RayCaster, pixels_where
from synthetless.extras import cv2
from synthetless.scenes.denoise import Guides
from synthetless.scenes.materials import TableTexture, table_uv
from synthetless.scenes.spec import Intrinsics, Vector
from synthetless.scenes.srgb import linear_from_srgb

_SPREAD_PX = 0.36
"""Standard deviation of Cycles' pixel filter, along each axis: Blackman-Harris, whose width is 1.5 in its units."""
_POINTS = 16
"""Points of a pixel that its albedo and normal are means over."""
_TEXEL_SHARE = 0.5
"""Side of a texel of the copy that is looked up, as a share of a pixel's: several points of a pixel share a texel."""
_SAME_COS = 0.98
"""Two neighbours with normals as near as this have no edge between them."""
_MM = 1000.0

Image = NDArray[np.float32]


def make_guides(
    caster: RayCaster,
    camera: Intrinsics,
    plane: Plane,
    bodies: Sequence[PosedModel | PosedSurface],
    albedos: Sequence[Vector | None],
    texture: TableTexture,
) -> Guides:
    """The guides of one image.

    Args:
        caster: of every mesh.
        camera: the pinhole.
        plane: the table.
        bodies: all that lies on it.
        albedos: linear albedo of each of them; None where it is not the same everywhere.
        texture: the table's.
    """
    # The table and what is beyond it come last: the one is looked up below, of the other nothing is known.
    colours = np.array([albedo or (0.0, 0.0, 0.0) for albedo in [*albedos, None, None]], dtype=np.float32)
    told = np.array([*(albedo is not None for albedo in albedos), True, False])
    owner, normals = caster.surfaces(camera, plane, bodies)
    albedo = colours.take(owner, axis=0, mode="wrap")
    known = told.take(owner, mode="wrap")
    on_table = (owner == len(bodies)).astype(np.float32)
    near_edge = _has_edge(owner, normals)
    textured = (owner == len(bodies)) & ~near_edge
    rows, columns = pixels_where(near_edge)
    finer = caster.surfaces_between(camera, plane, bodies, np.stack([columns, rows], axis=1), _points_px())
    albedo[rows, columns] = colours.take(finer[0], axis=0, mode="wrap").mean(axis=1)
    known[rows, columns] = told.take(finer[0], mode="wrap").all(axis=1)
    normals[rows, columns] = finer[1].mean(axis=1)
    on_table[rows, columns] = (finer[0] == len(bodies)).mean(axis=1)
    if on_table.any():
        albedo += on_table[..., None] * table_albedo(camera, plane, texture, on_table > 0)
    return Guides(albedo, normals, known, textured)


def _has_edge(owner: NDArray[np.int32], normals: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel or one of its eight neighbours shows another surface, or the same one bent."""
    edge = np.zeros(owner.shape, dtype=np.uint8)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        bent = np.einsum("ijk,ijk->ij", normals[one], normals[other]) < _SAME_COS
        edge[one] |= bent | (owner[one] != owner[other])
    return np.asarray(cv2.dilate(edge, np.ones((3, 3), np.uint8)), dtype=bool)


def _points_px() -> NDArray[np.float64]:
    """(K, 2) points spread as the pixel filter weighs them: Roberts' sequence through the quantiles of a Gaussian."""
    ratio = 1.32471795724474602596  # the real root of x^3 = x + 1
    even = (0.5 + np.outer(np.arange(1, _POINTS + 1), [1 / ratio, 1 / ratio**2])) % 1
    points = ndtri(even)
    offsets: NDArray[np.float64] = _SPREAD_PX * (points - points.mean(axis=0)) / points.std(axis=0)
    return offsets


def table_albedo(camera: Intrinsics, plane: Plane, texture: TableTexture, wanted: NDArray[np.bool_]) -> Image:
    """(H, W, 3) linear albedo of the table, averaged over each pixel that is wanted; 0 elsewhere."""
    rows, columns = pixels_where(wanted)
    to_texels = _homography(camera, plane, texture)
    at, right, below = (_mapped(to_texels, columns + u, rows + v) for u, v in ((0, 0), (1, 0), (0, 1)))
    pixel_side = np.sqrt(np.hypot(*(right - at)) * np.hypot(*(below - at)))  # in texels, the mean of a long and a short
    pyramid = _pyramid(texture.pixels)
    level = np.minimum(np.rint(np.log2(np.maximum(_TEXEL_SHARE * pixel_side, 1.0))), len(pyramid) - 1)
    result = np.zeros((*wanted.shape, 3), dtype=np.float32)
    for number in np.unique(level):
        chosen = np.flatnonzero(level == number)
        row, column = rows[chosen], columns[chosen]
        seen = (_mapped(to_texels, column + u, row + v) for u, v in _points_px())
        copy = pyramid[int(number)]
        result[row, column] = sum(_looked_up(copy, place, texture) for place in seen) / np.float32(_POINTS)
    return result


def _mapped(homography: NDArray[np.float64], u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """(2, N) images of points."""
    x, y, scale = (row[0] * u + (row[1] * v + row[2]) for row in homography)
    return np.stack([x / scale, y / scale])


def _homography(camera: Intrinsics, plane: Plane, texture: TableTexture) -> NDArray[np.float64]:
    """(3, 3) from a pixel (u, v, 1) to what it sees of the table: column and row in the texture, tiles counted on."""
    height, width = texture.pixels.shape[:2]
    corners = table_uv(texture.plane, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), width / height)
    to_uv = np.column_stack([corners[1] - corners[0], corners[2] - corners[0], corners[0]])
    to_texture = np.array([[width, 0.0, 0.0], [0.0, -height, height], [0.0, 0.0, 1.0]])  # the first row is on top
    origin_m = -plane.t_w2c @ plane.R_w2c / _MM
    rays = np.linalg.inv([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    to_plane = np.array([[-origin_m[2], 0.0, origin_m[0]], [0.0, -origin_m[2], origin_m[1]], [0.0, 0.0, 1.0]])
    homography: NDArray[np.float64] = to_texture @ np.vstack([to_uv, [0.0, 0.0, 1.0]]) @ to_plane @ plane.R_w2c.T @ rays
    return homography


def _pyramid(pixels: NDArray[np.uint8]) -> list[Image]:
    """The texture in linear light, and copies of half the size of the one before."""
    linear = np.array([linear_from_srgb(value / 255) for value in range(256)], dtype=np.float32)
    levels: list[Image] = [np.asarray(cv2.LUT(pixels, linear), dtype=np.float32)]
    while min(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        smaller = cv2.resize(levels[-1], (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, dtype=np.float32))
    return levels


_ROW = 1024
"""OpenCV looks up images of at most 32767 pixels a side: a list of pixels is made an image of this width."""


def _looked_up(level: Image, texels: NDArray[np.float64], texture: TableTexture) -> Image:
    """(N, 3) of a level of the pyramid, interpolated at texels (2, N) of the full texture."""
    padded = np.zeros((2, -(-texels.shape[1] // _ROW), _ROW), dtype=np.float32)
    for axis, side in enumerate(level.shape[1::-1]):
        at = texels[axis] * (side / texture.pixels.shape[1 - axis])
        if texture.seamless:
            at = np.mod(at, side)
        else:
            at = np.mod(at, 2 * side)
            at = np.minimum(at, 2 * side - at)
        padded[axis].ravel()[: len(at)] = at - 0.5
    border = cv2.BORDER_WRAP if texture.seamless else cv2.BORDER_REPLICATE
    found = cv2.remap(level, padded[0], padded[1], cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(found, dtype=np.float32).reshape(-1, 3)[: texels.shape[1]]
