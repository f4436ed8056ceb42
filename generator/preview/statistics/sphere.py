"""From where an object is seen: the viewing sphere of a model in cells of equal area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BANDS, SECTORS = 8, 16
CELLS = BANDS * SECTORS


def viewing_directions(R_m2c: Floats, t_m2c: Floats) -> Floats:
    """(N, 3) unit vectors from the model's origin to the camera, model frame, of poses (N, 3, 3), (N, 3)."""
    towards = -np.einsum("nji,nj->ni", R_m2c, t_m2c)
    directions: Floats = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return directions


def cell_counts(directions: Floats) -> NDArray[np.int64]:
    """(BANDS, SECTORS) directions in each cell: bands of equal height along z, which have equal area (Archimedes),
    from -z to z, cut into sectors of longitude from -180 degrees on."""
    band = np.clip(((directions[:, 2] + 1) / 2 * BANDS).astype(np.int64), 0, BANDS - 1)
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    sector = np.clip(((longitude + np.pi) / (2 * np.pi) * SECTORS).astype(np.int64), 0, SECTORS - 1)
    return np.bincount(band * SECTORS + sector, minlength=CELLS).reshape(BANDS, SECTORS)


def coverage(counts: NDArray[np.int64]) -> float:
    """Share of the cells from which the object is seen at least once."""
    return float((counts > 0).mean())


def uniform_coverage(views: int) -> float:
    """The coverage that as many views, uniform on the sphere, are expected to have."""
    return float(1 - (1 - 1 / CELLS) ** views)


def cell_outlines(points: int = 6) -> Floats:
    """(BANDS, SECTORS, 4 * points, 2) outlines of the cells in Hammer's equal-area projection, within an ellipse of
    half axes 2 sqrt(2) and sqrt(2)."""
    steps = np.linspace(0, 1, points, endpoint=False)
    right = np.concatenate([steps, np.ones(points), 1 - steps, np.zeros(points)])
    up = np.concatenate([np.zeros(points), steps, np.ones(points), 1 - steps])
    longitude = (np.arange(SECTORS)[None, :, None] + right) / SECTORS * 2 * np.pi - np.pi
    height = (np.arange(BANDS)[:, None, None] + up) / BANDS * 2 - 1
    longitude, height = np.broadcast_arrays(longitude, height)
    cosine = np.sqrt(np.clip(1 - height**2, 0, None))
    scale = np.sqrt(1 + cosine * np.cos(longitude / 2))
    x, y = 2 * np.sqrt(2) * cosine * np.sin(longitude / 2) / scale, np.sqrt(2) * height / scale
    return np.stack([x, y], axis=-1)
