"""How near true meshes come to one another, and how deep one reaches into another: on their triangles, no proxies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from synthetless.scenes.spec import Mesh

Array = NDArray[np.float64]

SAMPLES_PER_SIDE = 120
"""Surface samples along the longest side of a mesh: 1 mm apart on a part of 120 mm."""

_NEIGHBOURS = 6
"""Samples whose triangles are searched for the closest point."""

_STARTS, _STEPS = 32, 6
"""The gap between two meshes is searched from this many sample points, with this many projections to and fro."""

_DIRECTIONS = np.array(
    [[0.31, 0.27, 0.91], [-0.83, 0.41, 0.37], [0.22, -0.93, 0.29], [-0.35, -0.29, -0.89], [0.71, 0.53, -0.46]]
)
"""Rays that vote on whether a point is inside; none is along an axis or a diagonal, where edges of parts lie."""


class Surface:
    """The surface of a mesh, to be asked for closest points and for what is inside it. All in the model frame.

    Attributes:
        vertices_m: (V, 3) those that belong to a triangle.
        box_m: (2, 3) their smallest and largest coordinates.
        points_m: (N, 3) samples of the surface; every point of it has one within ``spacing_m``.
        spacing_m: distance of neighbouring samples.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._triangles: Array = mesh.vertices_m[mesh.faces]
        self.vertices_m: Array = mesh.vertices_m[np.unique(mesh.faces)]
        self.box_m: Array = np.array([self.vertices_m.min(axis=0), self.vertices_m.max(axis=0)])
        self._size = float(np.ptp(self.vertices_m, axis=0).max())
        self.spacing_m = self._size / SAMPLES_PER_SIDE
        points, faces = _sample(self._triangles, self.spacing_m)
        self.points_m, self._faces = _thin_out(points, faces, self.spacing_m / 2)
        self._tree = cKDTree(self.points_m)
        a, b, c = self._triangles.transpose(1, 0, 2)
        self._normals: Array = np.cross(b - a, c - a)
        self._rays = EmbreeScene()
        TriangleMesh(self._rays, self._scaled(self._triangles))

    def closest(self, points_m: Array) -> tuple[Array, Array]:
        """The closest points on the surface and the distances to them: (P, 3) and (P,) for (P, 3) points."""
        _, near = self._tree.query(points_m, k=min(_NEIGHBOURS, len(self.points_m)))
        faces = self._faces[near.reshape(len(points_m), -1)]
        repeated = np.repeat(points_m, faces.shape[1], axis=0)
        found = trimesh.triangles.closest_point(self._triangles[faces.ravel()], repeated)  # type: ignore[no-untyped-call]
        distances = np.linalg.norm(found - repeated, axis=1).reshape(faces.shape)
        best = np.arange(len(points_m)), distances.argmin(axis=1)
        return found.reshape(*faces.shape, 3)[best], distances[best]

    def near(self, points_m: Array, distance_m: float, most: int) -> Array:
        """Of the points that have a sample within a distance, the nearest ones."""
        points_m = _inside_box(points_m, self.box_m[0] - distance_m, self.box_m[1] + distance_m)
        distances, _ = self._tree.query(points_m, distance_upper_bound=distance_m)
        order = np.argsort(distances, kind="stable")[:most]
        return np.asarray(points_m[order[np.isfinite(distances[order])]])

    def contains(self, points_m: Array) -> NDArray[np.bool_]:
        """Whether points are inside: most rays from there first meet the surface from behind."""
        votes = np.zeros(len(points_m), dtype=int)
        origins = self._scaled(points_m)
        for direction in _DIRECTIONS if len(points_m) else ():
            hit = self._rays.run(origins, np.tile(direction.astype(np.float32), (len(points_m), 1)))
            votes += (hit >= 0) & (self._normals[hit] @ direction > 0)
        return np.asarray(votes > len(_DIRECTIONS) // 2)

    def _scaled(self, points: Array) -> NDArray[np.float32]:
        """Embree computes in single precision, best near unit size."""
        return (points / self._size).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Posed:
    """A surface in the world: x_world = rotation @ x_model + position_m."""

    surface: Surface
    rotation: Array
    position_m: Array

    def to_world(self, points_m: Array) -> Array:
        """(P, 3) from model to world."""
        return points_m @ self.rotation.T + self.position_m

    def to_model(self, points_m: Array) -> Array:
        """(P, 3) from world to model."""
        return (points_m - self.position_m) @ self.rotation


@dataclass(frozen=True, eq=False)
class Contacts:
    """Distances between n objects and the plane z = 0, metres.

    Attributes:
        gap_m: (n + 1, n + 1) symmetric; shortest distance of two surfaces, inf where it is larger than asked for, 0
            where one reaches into the other. The last row and column are the plane.
        penetration_m: likewise; the largest distance of a surface point of one that is inside the other to that
            other's surface. For the plane: how far below it the object reaches.
    """

    gap_m: Array
    penetration_m: Array


def measure(posed: Sequence[Posed], reach_m: float) -> Contacts:
    """Gaps up to ``reach_m`` and penetrations of objects among each other and with the plane z = 0."""
    n = len(posed)
    gap, penetration = np.full((n + 1, n + 1), np.inf), np.zeros((n + 1, n + 1))
    corners = [item.to_world(item.surface.vertices_m) for item in posed]
    samples = [item.to_world(item.surface.points_m) for item in posed]
    boxes = np.array([[c.min(axis=0), c.max(axis=0)] for c in corners]).reshape(n, 2, 3)
    for i in range(n):
        gap[i, n] = gap[n, i] = _or_inf(max(boxes[i, 0, 2], 0.0), reach_m)
        penetration[i, n] = penetration[n, i] = max(-boxes[i, 0, 2], 0.0)
        for j in range(i):
            low, high = np.maximum(boxes[i, 0], boxes[j, 0]), np.minimum(boxes[i, 1], boxes[j, 1])
            if (high - low < -reach_m).any():
                continue
            points = [_inside_box(samples[k], low - reach_m, high + reach_m) for k in (i, j)]
            depth = max(_depth(points[0], posed[j]), _depth(points[1], posed[i]))
            penetration[i, j] = penetration[j, i] = depth
            distance = (
                0.0
                if depth
                else min(_gap(points[0], posed[i], posed[j], reach_m), _gap(points[1], posed[j], posed[i], reach_m))
            )
            gap[i, j] = gap[j, i] = _or_inf(distance, reach_m)
    return Contacts(gap, penetration)


def _or_inf(distance: float, reach: float) -> float:
    return distance if distance <= reach else np.inf


def _inside_box(points: Array, low: Array, high: Array) -> Array:
    for axis in range(3):  # one by one, since few are left after the first
        points = points[(points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])]
    return points


def _depth(points_m: Array, other: Posed) -> float:
    """How far inside the other the deepest of some points (world) is."""
    local = other.to_model(points_m)
    local = _inside_box(local, *other.surface.box_m)
    local = local[other.surface.contains(local)]
    return float(other.surface.closest(local)[1].max()) if len(local) else 0.0


def _gap(points_m: Array, of: Posed, other: Posed, reach_m: float) -> float:
    """Distance of two surfaces, by projecting the nearest samples (world) to and fro until they stay."""
    surface = other.surface
    points = of.to_world(of.to_model(points_m))
    points = other.to_world(surface.near(other.to_model(points), reach_m + 2 * surface.spacing_m, _STARTS))
    if not len(points):
        return np.inf
    for _ in range(_STEPS):
        opposite, distances = surface.closest(other.to_model(points))
        points = of.to_world(of.surface.closest(of.to_model(other.to_world(opposite)))[0])
    return float(distances.min())


def _sample(triangles: Array, spacing: float) -> tuple[Array, NDArray[np.intp]]:
    """All corners, and points in rows parallel to the longest edge of each triangle larger than ``spacing``.

    Every point of a triangle has a sample within ``spacing``. Returns (N, 3) points and (N,) triangle numbers.
    """
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    large = np.flatnonzero(edges.max(axis=1) > spacing)
    first, length = edges[large].argmax(axis=1), edges[large].max(axis=1)
    start, end, apex = (triangles[large, (first + k) % 3] for k in range(3))
    height = np.linalg.norm(np.cross(end - start, apex - start), axis=1) / length

    triangle, v = _spread(np.ceil(height / spacing).astype(int) + 1)
    row, u = _spread(np.ceil((1 - v) * length[triangle] / spacing).astype(int) + 1)
    t, v = triangle[row], v[row]
    inner = start[t] + (u * (1 - v))[:, None] * (end - start)[t] + v[:, None] * (apex - start)[t]
    corners = np.repeat(np.arange(len(triangles)), 3)
    return np.concatenate([triangles.reshape(-1, 3), inner]), np.concatenate([corners, large[t]])


def _spread(counts: NDArray[np.int_]) -> tuple[NDArray[np.intp], Array]:
    """For counts (2, 3): whose it is (0, 0, 1, 1, 1) and a share that runs from 0 to 1 (0, 1, 0, 0.5, 1)."""
    which = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return which, number / np.maximum(counts - 1, 1)[which]


def _thin_out(points: Array, faces: NDArray[np.intp], cell: float) -> tuple[Array, NDArray[np.intp]]:
    """The first point in each cubic cell."""
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_index=True)
    first.sort()
    return points[first], faces[first]
