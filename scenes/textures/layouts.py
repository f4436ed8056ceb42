"""Ways to divide the tile into cells that continue over its borders: courses, herringbone, hexagons, Voronoi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.textures.noise import Field, spectral_noise, warp_labels

Labels = NDArray[np.int32]  # (size, size)


@dataclass(frozen=True, eq=False)
class Cells:
    """A division of the tile.

    Attributes:
        labels: (size, size) the cell of every pixel, 0..count-1.
        count: number of labels.
        edge: (size, size) distance to the nearest border of the cell, in tile sides.
    """

    labels: Labels
    count: int
    edge: Field


def courses(u: Field, v: Field, rows: int, columns: int, shifts: NDArray[np.float64]) -> Cells:
    """Rows of equal rectangles, row r pushed sideways by shifts[r] of a rectangle's width."""
    row = np.floor(v * rows)
    label_row = np.mod(row, rows).astype(np.int32)
    along = u * columns + shifts.astype(np.float32)[label_row]
    column = np.floor(along)
    to_side = _to_border(along - column) / columns
    to_top = _to_border(v * rows - row) / rows
    labels = label_row * columns + np.mod(column, columns).astype(np.int32)
    return Cells(labels, rows * columns, np.minimum(to_side, to_top))


def herringbone(u: Field, v: Field, repeats: int, ratio: int) -> tuple[Cells, NDArray[np.bool_]]:
    """Blocks `ratio` times as long as wide, laid in zigzag; also where the blocks lie along u."""
    n = 2 * ratio * repeats
    x, y = u * n, v * n
    i, j = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    step = np.mod(i - j, 2 * ratio)
    lying = step < ratio
    part = np.where(lying, step, 2 * ratio - 1 - step)  # which square of the block this is
    along = part + np.where(lying, x - i, y - j)
    across = np.where(lying, y - j, x - i)
    edge = np.minimum(np.minimum(along, ratio - along), _to_border(across)) / n
    start_i, start_j = np.where(lying, i - part, i), np.where(lying, j, j - part)
    labels = np.mod(start_i, n) * n + np.mod(start_j, n)
    return Cells(labels.astype(np.int32), n * n, edge.astype(np.float32)), lying


def hexagons(u: Field, v: Field, columns: int) -> Cells:
    """Hexagons with a side along v; stretched by some percent so that a whole, even number of rows fits."""
    rows = max(2, 2 * round(columns / np.sqrt(3)))
    x, y = u * columns, v * rows

    def lattice(shift_x: float, shift_y: float) -> tuple[Field, Labels]:
        i, j = np.round(x - shift_x), 2 * np.round((y - shift_y) / 2)
        dx, dy = np.abs(x - shift_x - i), np.abs(y - shift_y - j) * np.sqrt(3) / 2
        label = np.mod(j + shift_y, rows) * columns + np.mod(i, columns)
        return np.maximum(dx, dx / 2 + dy * np.sqrt(3) / 2), label.astype(np.int32)

    distance_even, label_even = lattice(0.0, 0)
    distance_odd, label_odd = lattice(0.5, 1)
    labels = np.where(distance_even < distance_odd, label_even, label_odd)
    edge = (0.5 - np.minimum(distance_even, distance_odd)) / columns
    return Cells(labels, rows * columns, np.maximum(edge, 0).astype(np.float32))


def voronoi(rng: np.random.Generator, size: int, per_side: int, wobble: float = 0.0) -> Cells:
    """Voronoi cells of per_side**2 random points, borders made wavy by `wobble` (in cell widths)."""
    j, i = np.divmod(np.arange(per_side**2), per_side)
    points = np.mod((np.stack([i, j]) + rng.random((2, per_side**2))) / per_side + rng.random((2, 1)), 1)
    x, y = np.minimum((points * size).astype(np.int64), size - 1)
    seeds = np.zeros((size, size), np.int32)
    seeds[y, x] = 1 + np.arange(per_side**2)
    # every grid square holds a point, so that none is farther than the square's diagonal
    margin = int(1.5 * size / per_side) + 2
    padded = cv2.copyMakeBorder(seeds, margin, margin, margin, margin, cv2.BORDER_WRAP)
    _, nearest = cv2.distanceTransformWithLabels(
        (padded == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    found = padded > 0
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[found]] = padded[found] - 1
    labels = owner[nearest[margin:-margin, margin:-margin]]
    if wobble:
        bend = [spectral_noise(rng, size, slope=1.5, low=per_side / 2, high=3 * per_side) for _ in range(2)]
        labels = warp_labels(labels, bend[0] * wobble / per_side, bend[1] * wobble / per_side)
    return Cells(labels, per_side**2, border_distance(labels, margin))


def border_distance(labels: Labels, margin: int) -> Field:
    """Distance of every pixel to the nearest change of label, in tile sides, measured up to `margin` pixels."""
    inside = np.ones(labels.shape, bool)
    for axis in (0, 1):
        for step in (-1, 1):
            inside &= labels == np.roll(labels, step, axis)
    padded = cv2.copyMakeBorder(inside.astype(np.uint8), margin, margin, margin, margin, cv2.BORDER_WRAP)
    distance_px = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray((distance_px[margin:-margin, margin:-margin] + 0.5) / len(labels), np.float32)


def shuffled(rng: np.random.Generator, field: Field, cells: Cells) -> Field:
    """The field cut up: every cell shows another place of it."""
    size = len(field)
    offsets = rng.random((2, cells.count)) * size
    dy, dx = offsets.astype(np.int32)
    y, x = np.indices(field.shape, dtype=np.int32)
    return np.asarray(field[(y + dy[cells.labels]) % size, (x + dx[cells.labels]) % size])


def _to_border(fraction: Field) -> Field:
    return np.minimum(fraction, 1 - fraction)
