"""What a denoiser may know of an image before it is rendered: albedo and normals of the surfaces, without noise.

Both are means over a pixel, weighed as Cycles weighs its samples. Where no edge is near, one ray tells the surface;
near an edge, several do. The table's texture is looked up on a grid finer than the pixels, whose points neighbours
share, in a copy with texels that are not much smaller than the points are apart (L. Williams, Pyramidal parametrics,
1983).
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
from synthetless.scenes.srgb import linear_of_levels

_RADIUS_PX = 1.5
"""Of Cycles' pixel filter, Blackman-Harris: half of what its width of 1.5 is in its own units."""
_SPREAD_PX = 0.36
"""Standard deviation of that filter, along each axis."""
_POINTS = 16
"""Points of a pixel near an edge that its albedo and normal are means over."""
_GRID = 2
"""Points per pixel, along each axis, at which the table's texture is looked up."""
_TEXEL_SHARE = 0.25
"""Side of a texel of the copy that is looked up, as a share of a pixel's, up to a factor of the square root of 2."""
_BAND = 64
"""Rows of pixels that are looked up at a time, so that they stay in the processor's cache."""
_SAME_COS = 0.9
"""Two neighbours with normals as near as this have no edge between them: it would be shaded as a curve."""
_HORIZON = np.float32(1e-6)
"""Below it, the third coordinate of ``_homography`` belongs to no point that is seen."""
_MM = 1000.0

Image = NDArray[np.float32]
Texels = NDArray[np.uint8] | Image


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
    textured = (owner == len(bodies)) & ~near_edge & (texture.plane.specular == 0)
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
    """(H, W) whether a pixel or one of its four neighbours shows another surface, or the same one bent."""
    edge = np.zeros(owner.shape, dtype=bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        bent = np.einsum("ijk,ijk->ij", normals[one], normals[other]) < _SAME_COS
        between = bent | (owner[one] != owner[other])
        edge[one] |= between
        edge[other] |= between
    return edge


def _points_px() -> NDArray[np.float64]:
    """(K, 2) points spread as the pixel filter weighs them: Roberts' sequence through the quantiles of a Gaussian."""
    ratio = 1.32471795724474602596  # the real root of x^3 = x + 1
    even = (0.5 + np.outer(np.arange(1, _POINTS + 1), [1 / ratio, 1 / ratio**2])) % 1
    points = ndtri(even)
    offsets: NDArray[np.float64] = _SPREAD_PX * (points - points.mean(axis=0)) / points.std(axis=0)
    return offsets


def table_albedo(camera: Intrinsics, plane: Plane, texture: TableTexture, wanted: NDArray[np.bool_]) -> Image:
    """(H, W, 3) linear albedo of the table, averaged over each pixel that is wanted; 0 elsewhere."""
    to_texels = _homography(camera, plane, texture)
    texels_per_pixel = abs(np.linalg.det(to_texels))  # where the third coordinate is 1
    linear = linear_of_levels()
    levels = _pyramid(texture.pixels, linear)
    result = np.zeros((*wanted.shape, 3), dtype=np.float32)
    u = _grid(0, wanted.shape[1])
    for top in range(0, wanted.shape[0], _BAND):
        band = wanted[top : top + _BAND]
        v = _grid(top, len(band))
        x, y, scale = (
            (row[0] * u).astype(np.float32) + (row[1] * v + row[2]).astype(np.float32)[:, None] for row in to_texels
        )
        np.maximum(scale, _HORIZON, out=scale)
        x, y = x / scale, y / scale
        at_pixels = scale[_GRID:-_GRID:_GRID, _GRID:-_GRID:_GRID]
        side = np.sqrt(texels_per_pixel / at_pixels**3)  # in texels: of the square of the same area
        level = np.minimum(np.rint(np.log2(np.maximum(_TEXEL_SHARE * side, 1.0))), len(levels) - 1)
        for number in np.unique(level[band]):
            seen = _looked_up(levels[int(number)], x, y, texture)
            # Like Cycles, which interpolates what an image file says, and makes light of it then.
            light = np.asarray(cv2.LUT(seen, linear) if seen.dtype == np.uint8 else seen, dtype=np.float32)
            np.copyto(result[top : top + _BAND], _averaged(light), where=(band & (level == number))[..., None])
    return result


def _grid(first: int, count: int) -> NDArray[np.float64]:
    """The points along an axis that some pixels are averaged over: those of one pixel more on either side."""
    return first - 1 + (np.arange(_GRID * (count + 2)) - (_GRID - 1) / 2) / _GRID


def _averaged(seen: Image) -> Image:
    """(H, W, 3) means by the pixel filter of what is seen at the points of ``_grid``."""
    offsets = (np.arange(3 * _GRID) - (3 * _GRID - 1) / 2) / _GRID
    terms = (0.35875, 0.48829, 0.14128, 0.01168)  # F. J. Harris, On the use of windows for harmonic analysis, 1978
    weights = sum(term * np.cos(np.pi * order * offsets / _RADIUS_PX) for order, term in enumerate(terms))
    kernel = (weights / np.sum(weights)).astype(np.float32)
    rows, columns = (side - 2 * _GRID for side in seen.shape[:2])
    across = cv2.filter2D(seen, -1, kernel[None], anchor=(0, 0))[:, :columns:_GRID]
    down = cv2.filter2D(np.ascontiguousarray(across), -1, kernel[:, None], anchor=(0, 0))[:rows:_GRID]
    return np.asarray(down, dtype=np.float32)


def _homography(camera: Intrinsics, plane: Plane, texture: TableTexture) -> NDArray[np.float64]:
    """(3, 3) from a pixel (u, v, 1) to what it sees of the table: column and row in the texture, tiles counted on.

    The third of what comes out is positive where the table is seen, and 0 at its horizon.
    """
    height, width = texture.pixels.shape[:2]
    corners = table_uv(texture.plane, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), width / height)
    to_uv = np.column_stack([corners[1] - corners[0], corners[2] - corners[0], corners[0]])
    to_texture = np.array([[width, 0.0, 0.0], [0.0, -height, height], [0.0, 0.0, 1.0]])  # the first row is on top
    origin_m = -plane.t_w2c @ plane.R_w2c / _MM
    rays = np.linalg.inv([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    to_plane = -np.sign(origin_m[2]) * np.array(
        [[-origin_m[2], 0, origin_m[0]], [0, -origin_m[2], origin_m[1]], [0, 0, 1]]
    )
    homography: NDArray[np.float64] = to_texture @ np.vstack([to_uv, [0.0, 0.0, 1.0]]) @ to_plane @ plane.R_w2c.T @ rays
    return homography


def _pyramid(pixels: NDArray[np.uint8], linear: NDArray[np.float32]) -> list[Texels]:
    """The texture as it is stored, and copies in linear light of half the size of the one before."""
    levels: list[Texels] = [pixels]
    smaller = np.asarray(cv2.LUT(pixels, linear), dtype=np.float32)
    while min(smaller.shape[:2]) > 1:
        height, width = smaller.shape[:2]
        size = max(1, width // 2), max(1, height // 2)
        smaller = np.asarray(cv2.resize(smaller, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        levels.append(smaller)
    return levels


def _looked_up(level: Texels, x: NDArray[np.float32], y: NDArray[np.float32], texture: TableTexture) -> Texels:
    """(H, W, 3) of a level of the pyramid, interpolated at texels (H, W) of the full texture."""
    repeated = texture.seamless

    def folded(texels: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
        side = np.float32(level.shape[axis])
        place = texels * np.float32(side / texture.pixels.shape[axis])
        period = side if repeated else 2 * side
        place -= period * np.floor(place / period)
        return (place if repeated else np.minimum(place, period - place)) - np.float32(0.5)

    border = cv2.BORDER_WRAP if repeated else cv2.BORDER_REPLICATE
    found: NDArray[Any] = cv2.remap(level, folded(x, 1), folded(y, 0), cv2.INTER_LINEAR, borderMode=border)
    return found
