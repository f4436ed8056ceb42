"""Distances to a triangle mesh: exact ones from a tree over small pieces of its triangles, quick ones from a grid."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from synthetless.errors import UserError
from synthetless.symmetry.quaternions import Floats, normalise

Indices = NDArray[np.int64]

PIECE = 0.03
"""A good length for a surface's pieces, as a share of the diameter."""

_NEIGHBOURS, _MOST_NEIGHBOURS = 8, 128
_FAR = 0.9  # of the largest distance: what decides about it
_BLOCK = 8192
_MOST_PIECES = 100_000  # about as many pieces as a surface is cut into beyond its triangles: no part needs as many
_GRID = 112
_NO_HEIGHT = 1e-9  # a triangle this flat, as a share of its longest edge, is a line: its neighbours cover it


class Closest(NamedTuple):
    """What the surface has nearest to N points: the distances (N,), the points (N, 3) and their triangles' unit
    normals (N, 3)."""

    distance: Floats
    point: Floats
    normal: Floats


class Surface:
    """A mesh that tells its distance to points.

    Every triangle is cut into pieces whose edges are at most `piece` long. The nearest triangle of a point is almost
    always the parent of one of the nearest few centres of pieces; `exact` makes sure.

    Attributes:
        corners: (F, 3, 3) the triangles that have an area.
        areas: (F,)
        centroid: (3,) centre of the surface's area: every symmetry keeps it.
    """

    def __init__(self, vertices: Floats, faces: NDArray[np.integer[Any]], piece: float) -> None:
        """Take vertices (V, 3) and faces (F, 3).

        Raises:
            UserError: no triangle has an area.
        """
        corners = _longest_edge_first(vertices[faces])
        first, side = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        longest = np.linalg.norm(first, axis=1)
        doubled = np.linalg.norm(np.cross(first, side), axis=1)
        solid = doubled > _NO_HEIGHT * longest**2
        if not solid.any():
            raise UserError(f"none of its {len(faces)} triangles has an area; a surface is needed")
        self.corners, self.areas = corners[solid], doubled[solid] / 2
        self.centroid: Floats = self.areas @ self.corners.mean(axis=1) / self.areas.sum()
        self._planar = _planar_form(self.corners)
        pieces, self._parent = _cut(self.corners, max(piece, float(np.sqrt(self.areas.sum() / _MOST_PIECES))))
        centres = pieces.mean(axis=1)
        self._radius = float(np.linalg.norm(pieces - centres[:, None], axis=2).max())
        self._tree = cKDTree(centres, leafsize=32, balanced_tree=False, compact_nodes=False)  # the fastest queries

    def distance(self, points: Floats) -> Floats:
        """Distances (N,) of points (N, 3): exact but where fine triangles crowd, and never too small."""
        found = np.empty(len(points))
        for start in range(0, len(points), _BLOCK):
            block = slice(start, start + _BLOCK)
            found[block] = self._nearest(points[block])[0]
        return found

    def closest(self, points: Floats, surely: bool = False) -> Closest:
        """The nearest surface points, with the accuracy of `distance`. `surely`: among many more pieces where the
        distance is near the largest, since one point that is said to be too far off spoils a maximum."""
        distance, triangle = self._nearest(points)
        if surely:
            far = np.flatnonzero(distance > _FAR * distance.max())
            distance[far], triangle[far] = self._surely_nearest(points[far])
        a, e1, e2, normal = (self._planar[triangle, k : k + 3] for k in (0, 3, 6, 9))
        _, x, y = _in_plane(points, self._planar[triangle])
        return Closest(distance, a + x[:, None] * e1 + y[:, None] * e2, normal)

    def exact(self, points: Floats, distances: Floats) -> Floats:
        """Exact distances (N,) of a few points (N, 3), given what `distance` says of them."""
        result = distances.copy()
        for i, (point, distance) in enumerate(zip(points, distances, strict=True)):
            near = self._tree.query_ball_point(point, distance + self._radius)
            triangles = np.unique(self._parent[near])
            if len(triangles):
                squared, _, _ = _in_plane(np.broadcast_to(point, (len(triangles), 3)), self._planar[triangles])
                result[i] = min(distance, float(np.sqrt(squared.min())))
        return result

    def sampled(self, n: int) -> Floats:
        """n points (n, 3) spread evenly over the area, always the same; every k-th of them is spread evenly too."""
        cumulated = np.cumsum(self.areas) / self.areas.sum()
        triangle = np.minimum(np.searchsorted(cumulated, (np.arange(n) + 0.5) / n), len(self.areas) - 1)
        u, v = _low_discrepancy(n)
        beyond = u + v > 1
        u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
        a, b, c = np.moveaxis(self.corners[triangle], 1, 0)
        return np.asarray(a + u[:, None] * (b - a) + v[:, None] * (c - a))

    def _nearest(self, points: Floats) -> tuple[Floats, Indices]:
        distance, triangle, _ = self._nearest_of(points, _NEIGHBOURS)
        return distance, triangle

    def _surely_nearest(self, points: Floats) -> tuple[Floats, Indices]:
        """The same among ever more pieces, until no other one can be nearer, or they are too many."""
        distance, triangle = np.empty(len(points)), np.empty(len(points), np.int64)
        rest, neighbours = np.arange(len(points)), _NEIGHBOURS
        while len(rest):
            distance[rest], triangle[rest], farthest = self._nearest_of(points[rest], neighbours)
            rest = rest[farthest - self._radius < distance[rest]]
            if neighbours >= min(_MOST_NEIGHBOURS, len(self._parent)):
                break
            neighbours *= 4
        return distance, triangle

    def _nearest_of(self, points: Floats, neighbours: int) -> tuple[Floats, Indices, Floats]:
        """Distances (N,), triangles (N,), and how far the farthest centre of so many pieces is, (N,)."""
        away, pieces = self._tree.query(points, k=min(neighbours, len(self._parent)))
        triangles = self._parent[pieces.reshape(len(points), -1)]
        squared, _, _ = _in_plane(points[:, None], self._planar[triangles])
        best = np.argmin(squared, axis=1)
        rows = np.arange(len(points))
        return np.sqrt(squared[rows, best]), triangles[rows, best], away.reshape(len(points), -1)[:, -1]


def _longest_edge_first(corners: Floats) -> Floats:
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    start = np.argmax(lengths, axis=1)
    rows = np.arange(len(corners))[:, None]
    return np.asarray(corners[rows, (start[:, None] + np.arange(3)) % 3])


def _planar_form(corners: Floats) -> Floats:
    """Per triangle (F, 15): corner a, axes e1 (along a b, the longest edge), e2, normal; b = (l, 0), c = (x, y) in
    them."""
    a, b, c = np.moveaxis(corners, 1, 0)
    e1 = normalise(b - a)
    normal = normalise(np.cross(b - a, c - a))
    e2 = np.cross(normal, e1)
    lengths = np.stack(
        [np.sum((b - a) * e1, axis=1), np.sum((c - a) * e1, axis=1), np.sum((c - a) * e2, axis=1)], axis=1
    )
    return np.concatenate([a, e1, e2, normal, lengths], axis=1)


def _in_plane(points: Floats, planar: Floats) -> tuple[Floats, Floats, Floats]:
    """Squared distances (...) from points (..., 3) to triangles (..., 15), and the nearest points' coordinates."""
    offset = points - planar[..., 0:3]
    x = np.einsum("...i,...i->...", offset, planar[..., 3:6])
    y = np.einsum("...i,...i->...", offset, planar[..., 6:9])
    z = np.einsum("...i,...i->...", offset, planar[..., 9:12])
    length, cx, cy = planar[..., 12], planar[..., 13], planar[..., 14]
    inside = (y >= 0) & (cx * y <= cy * x) & ((length - cx) * y <= cy * (length - x))
    best_x, best_y = np.clip(x, 0, length), np.zeros_like(x)
    squared = (x - best_x) ** 2 + y**2
    for start, dx in ((np.zeros_like(length), cx), (length, cx - length)):  # the edges from a and from b to c
        t = np.clip(((x - start) * dx + y * cy) / (dx**2 + cy**2), 0, 1)
        edge_x, edge_y = start + t * dx, t * cy
        other = (x - edge_x) ** 2 + (y - edge_y) ** 2
        nearer = other < squared
        squared = np.where(nearer, other, squared)
        best_x, best_y = np.where(nearer, edge_x, best_x), np.where(nearer, edge_y, best_y)
    squared = np.where(inside, 0, squared) + z**2
    return squared, np.where(inside, x, best_x), np.where(inside, y, best_y)


def _cut(corners: Floats, longest: float) -> tuple[Floats, Indices]:
    """Pieces (P, 3, 3) with no edge longer than `longest`, by halving longest edges, and their triangles (P,)."""
    pieces: list[Floats] = []
    parents: list[Indices] = []
    parent = np.arange(len(corners))
    while len(corners):
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        done = lengths.max(axis=1) <= longest
        pieces.append(corners[done])
        parents.append(parent[done])
        corners, parent, lengths = corners[~done], parent[~done], lengths[~done]
        start, rows = np.argmax(lengths, axis=1), np.arange(len(corners))
        a, b, c = (corners[rows, (start + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        parent = np.concatenate([parent, parent])
    return np.concatenate(pieces), np.concatenate(parents)


def _low_discrepancy(n: int) -> tuple[Floats, Floats]:
    """The R2 sequence in the unit square (Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018)."""
    plastic = 1.324717957244746
    i = np.arange(1, n + 1)
    return (0.5 + i / plastic) % 1, (0.5 + i / plastic**2) % 1


class DistanceField:
    """Distances to a surface on a grid around its centre, right to about a voxel (1 % of the diameter)."""

    def __init__(self, center: Floats, dense: Floats) -> None:
        """Take the centre (3,) and densely spread surface points (N, 3)."""
        radius = float(np.linalg.norm(dense - center, axis=1).max())
        self._center = center
        self._voxel = 2.1 * radius / (_GRID - 1)
        free = np.ones((_GRID,) * 3, dtype=bool)
        free[tuple(np.moveaxis(self._cell(dense), -1, 0))] = False
        self._values = (distance_transform_edt(free) * self._voxel).astype(np.float32)

    def __call__(self, points: Floats) -> NDArray[np.float32]:
        """Distances (...) at points (..., 3)."""
        i, j, k = np.moveaxis(self._cell(points), -1, 0)
        return np.asarray(self._values[i, j, k])

    def _cell(self, points: Floats) -> NDArray[np.int64]:
        cells = np.rint((points - self._center) / self._voxel + (_GRID - 1) / 2)
        return np.asarray(np.clip(cells, 0, _GRID - 1).astype(np.int64))
