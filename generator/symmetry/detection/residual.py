"""How far a mesh is from having a symmetry group.

For a point p of the surface X and an element S of the group G the deviation is the distance from S p to X. As G holds
the inverse of each of its elements, all deviations together are the two-sided distances between X and all its images.
The orbit of a point is everywhere that the elements of the group take it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from synthetless.symmetry.detection.distance import Indices, Surface
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    conjugate,
    from_axis_angle,
    minimal,
    multiply,
    normalise,
    rotate,
    to_matrix,
)

_DENSE = 160_000  # points that the maximum is searched among; every 8th takes part from the start
_STRIDE = 8
_THIN = 3e-3  # vertices nearer than this, as a share of the diameter, count as one at the start
_FINENESS = 4e-3  # of orbits, and of steps along those of a continuous group, as a share of the diameter
_FEW_PAIRS, _PAIRS_FAR_OFF, _MOST_PAIRS = 6_000, 15_000, 200_000
_BAD_POINTS, _ELEMENTS_OF_BAD = 300, 40
_SEEDS = 40  # of the search for the maximum
_REACHES = (2e-2, 1e-2, 5e-3)  # of that search, as shares of the diameter
_GOLDEN = (np.sqrt(5) - 1) / 2
_TOWARDS = normalise([0.53, 0.29, 0.8])  # chooses the fundamental domain; in no plane of symmetry


@dataclass(frozen=True)
class Residual:
    """Deviations over all elements but the identity, mm.

    Attributes:
        max_mm: the largest over the whole surface.
        p95_mm: the 95th percentile, by area.
        rms_mm: the root mean square, by area.
        worst_mm: the surface point that deviates most, model frame.
    """

    max_mm: float
    p95_mm: float
    rms_mm: float
    worst_mm: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Points, by number (N,), the elements (N, 4) that move them, and the areas (N,) that they stand for."""

    point: Indices
    element: Floats
    weight: Floats

    def joined(self, other: _Pairs) -> _Pairs:
        point, element = np.concatenate([self.point, other.point]), np.concatenate([self.element, other.element])
        return _Pairs(point, element, np.concatenate([self.weight, other.weight]))


@dataclass(frozen=True)
class GroupFit:
    """A group fitted to a mesh, and how far the mesh is from having it."""

    group: SymmetryGroup
    residual: Residual


class ResidualMeter:
    """Measures the residuals of groups on one mesh.

    Attributes:
        diameter_mm: the largest distance in the mesh; lengths are judged by it.
        dense: (D, 3) evenly spread surface points, then all vertices.
    """

    def __init__(self, surface: Surface, vertices_mm: Floats, diameter_mm: float) -> None:
        self._surface, self.diameter_mm = surface, diameter_mm
        samples = surface.sampled(_DENSE)
        self.dense: Floats = np.concatenate([samples, vertices_mm])
        self._dense_tree = cKDTree(self.dense)
        self._n_samples = len(samples[::_STRIDE])
        self._points = np.concatenate([samples[::_STRIDE], _thinned(vertices_mm, _THIN * diameter_mm)])

    def measure(self, group: SymmetryGroup, enough_mm: float) -> Residual:
        """The residual of a group; from fewer pairs where it exceeds `enough_mm` anyway."""
        if group.name == "C1":
            return Residual(0.0, 0.0, 0.0)
        estimate = self.estimate(group)
        if estimate > enough_mm:
            pairs = self._some_pairs(group, _PAIRS_FAR_OFF if estimate > 5 * enough_mm else len(self._points))
            found = self._deviations(group, pairs)
            worse = self._pairs_of_bad_points(group, pairs, found)
            pairs, found = worse.joined(pairs), np.concatenate([self._deviations(group, worse), found])
        else:
            pairs = self._all_pairs(group)
            found = self._deviations(group, pairs)
        largest, worst = self._maximum(group, pairs, found)
        p95, rms = _statistics(np.minimum(found, largest), pairs.weight)
        return Residual(largest, p95, rms, worst)

    def estimate(self, group: SymmetryGroup) -> float:
        """The largest deviation among few pairs, mm."""
        pairs = self._some_pairs(group, _FEW_PAIRS)
        places = moved(group, self._points[pairs.point], pairs.element)
        return float(self._settled(self._surface.distance(places), places).max())

    def worst_pairs(self, group: SymmetryGroup, n: int) -> tuple[Floats, Floats]:
        """Points (k, 3) and elements (k, 4), in the group's standard frame: n spread ones and the worst."""
        pairs = self._some_pairs(group, n).joined(self._worst(group))
        frame = group.frame_wxyz
        return self._points[pairs.point], multiply(multiply(conjugate(frame), pairs.element), frame)

    def _worst(self, group: SymmetryGroup) -> _Pairs:
        """The worst of many pairs, by deviation."""
        pairs = self._some_pairs(group, len(self._points))
        worse = self._pairs_of_bad_points(group, pairs, self._deviations(group, pairs))
        worst = np.argsort(self._deviations(group, worse))[-_BAD_POINTS:]
        return _Pairs(worse.point[worst], worse.element[worst], worse.weight[worst])

    def _deviations(self, group: SymmetryGroup, pairs: _Pairs) -> Floats:
        return self._surface.distance(moved(group, self._points[pairs.point], pairs.element))

    def _some_pairs(self, group: SymmetryGroup, n: int) -> _Pairs:
        """n pairs of evenly chosen points, each with an element of its own."""
        point = np.arange(n) * len(self._points) // n
        return _Pairs(point, spread_elements(group, n), (point < self._n_samples).astype(np.float64))

    def _pairs_of_bad_points(self, group: SymmetryGroup, pairs: _Pairs, found: Floats) -> _Pairs:
        """The points that deviate most, with more elements."""
        bad = pairs.point[np.argsort(found)[-_BAD_POINTS:]]
        elements = some_elements(group, _ELEMENTS_OF_BAD)
        n = len(bad) * len(elements)
        return _Pairs(np.repeat(bad, len(elements)), np.tile(elements, (len(bad), 1)), np.zeros(n))

    def _all_pairs(self, group: SymmetryGroup) -> _Pairs:
        """One point of every orbit, with elements all along it."""
        fineness = _FINENESS * self.diameter_mm
        while True:
            point, weight = self._orbits(group, fineness)
            counts, elements = elements_along_orbits(group, self._points[point], fineness)
            if len(elements) <= _MOST_PAIRS:
                return _Pairs(np.repeat(point, counts), elements, np.repeat(weight / counts, counts))
            fineness *= 1.4

    def _orbits(self, group: SymmetryGroup, fineness_mm: float) -> tuple[Indices, Floats]:
        """A point, by number, of every orbit that is farther than this from the others, and the samples near it."""
        cells = np.floor(orbit_coordinates(group, self._points) / fineness_mm).astype(np.int64)
        _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        return first, np.bincount(cell.ravel()[: self._n_samples], minlength=len(first)).astype(np.float64)

    def _maximum(self, group: SymmetryGroup, pairs: _Pairs, found: Floats) -> tuple[float, tuple[float, float, float]]:
        """The largest deviation, exactly, and its point: of the pairs, then of what is ever nearer to the worst."""
        points, elements = self._points[pairs.point], pairs.element
        places = moved(group, points, elements)
        for share in _REACHES:
            found = self._settled(found, places)
            worst = np.argpartition(found, -min(_SEEDS, len(found)))[-_SEEDS:]
            near = self._dense_tree.query_ball_point(points[worst], share * self.diameter_mm)
            counts = [len(numbers) for numbers in near]
            turns = turns_beside(group, 2 * share)
            n = len(turns)
            turned = multiply(turns, elements[worst, None]).reshape(-1, 4)
            elements = np.concatenate([elements[worst], np.repeat(elements[worst], counts, axis=0), turned])
            beside = self.dense[np.concatenate(near).astype(np.int64)]
            points = np.concatenate([points[worst], beside, np.repeat(points[worst], n, axis=0)])
            places = moved(group, points, elements)
            found = np.concatenate([found[worst], self._surface.distance(places[len(worst) :])])
        found = self._settled(found, places)
        worst_of_all = int(np.argmax(found))
        x, y, z = points[worst_of_all].tolist()
        return float(found[worst_of_all]), (x, y, z)

    def _settled(self, distances: Floats, places: Floats) -> Floats:
        """The distances (N,) of places (N, 3), the largest ones made exact until the largest is certain."""
        settled = distances.copy()
        best = 0.0
        for i in np.argsort(distances)[::-1]:
            if distances[i] <= best:
                break
            settled[i] = self._surface.exact(places[[i]], distances[[i]])[0]
            best = max(best, float(settled[i]))
        return settled


def _thinned(points: Floats, distance_mm: float) -> Floats:
    """One of the points (N, 3) of every cell of a grid."""
    _, first = np.unique(np.floor(points / distance_mm).astype(np.int64), axis=0, return_index=True)
    return points[first]


def _statistics(deviations: Floats, weights: Floats) -> tuple[float, float]:
    """The 95th percentile and the root mean square."""
    order = np.argsort(deviations)
    cumulated = np.cumsum(weights[order])
    p95 = deviations[order[np.searchsorted(cumulated, 0.95 * cumulated[-1])]]
    return float(p95), float(np.sqrt(weights @ deviations**2 / cumulated[-1]))


def moved(group: SymmetryGroup, points: Floats, elements: Floats) -> Floats:
    """Points (N, 3), each moved by its own element (N, 4) of the group, about its fixed point."""
    offset = np.array(group.offset_mm)
    return np.asarray(np.einsum("nij,nj->ni", to_matrix(elements), points - offset) + offset)


def some_elements(group: SymmetryGroup, n: int) -> Floats:
    """At most about n elements (k, 4) but the identity, that pin the group down."""
    if not group.is_finite:
        return spread_elements(group, n)
    elements = group.elements_wxyz[1:]
    return np.asarray(elements[:: -(-len(elements) // n)])


def spread_elements(group: SymmetryGroup, n: int) -> Floats:
    """n elements (n, 4) but the identity, evenly chosen in an order without a period; repeated if there are fewer."""
    i = np.arange(1, n + 1)
    if group.is_finite:
        elements = group.elements_wxyz[1:]
        return np.asarray(elements[(i * _GOLDEN % 1 * len(elements)).astype(np.int64)])
    if group.family == "SO(3)":
        return np.asarray(group.sampled_wxyz(n + 1)[1 + np.argsort(i * _GOLDEN % 1)])
    discrete = group.sampled_wxyz(1)
    turns = from_axis_angle(np.array(group.axis), 2 * np.pi * (i * _GOLDEN % 1))
    return multiply(turns, discrete[i % len(discrete)])


def orbit_coordinates(group: SymmetryGroup, points: Floats) -> Floats:
    """Coordinates (N, k), in mm, that points (N, 3) of one orbit share."""
    local = points - np.array(group.offset_mm)
    if group.family == "SO(3)":
        return np.asarray(np.linalg.norm(local, axis=1, keepdims=True))
    if not group.is_finite:
        axis = np.array(group.axis)
        along = local @ axis
        across = np.linalg.norm(local - along[:, None] * axis, axis=1)
        return np.stack([across, np.abs(along) if group.family == "O(2)" else along], axis=1)
    towards = rotate(group.frame_wxyz, _TOWARDS)
    matrices = to_matrix(group.elements_wxyz)
    chosen = matrices[np.argmax(local @ (towards @ matrices).T, axis=1)]
    return np.asarray(np.einsum("nij,nj->ni", chosen, local))


def elements_along_orbits(group: SymmetryGroup, points: Floats, step_mm: float) -> tuple[Indices, Floats]:
    """What takes points (N, 3) all along their orbits: how many elements for each, (N,), and all of them (M, 4).

    All but the identity of a finite group; of a continuous one as many as move the point in steps of `step_mm`.
    """
    if group.is_finite:
        elements = group.elements_wxyz[1:]
        return np.full(len(points), len(elements)), np.tile(elements, (len(points), 1))
    local = points - np.array(group.offset_mm)
    if group.family == "SO(3)":
        counts = np.clip(4 * np.pi * np.sum(local**2, axis=1) / (2 * step_mm) ** 2, 24, 4000).astype(np.int64)
        spheres = [minimal(normalise(point), directions(n)) for point, n in zip(local, counts, strict=True)]
        return counts, np.concatenate(spheres)
    axis = np.array(group.axis)
    radii = np.linalg.norm(np.cross(axis, local), axis=1)
    turns = np.clip(np.ceil(2 * np.pi * radii / step_mm), 12, 720).astype(np.int64)
    discrete = group.sampled_wxyz(1)
    angles = np.concatenate([np.arange(k) * (2 * np.pi / k) for k in turns])
    elements = multiply(from_axis_angle(axis, angles)[:, None], discrete[None]).reshape(-1, 4)
    return turns * len(discrete), elements


def turns_beside(group: SymmetryGroup, angle_rad: float) -> Floats:
    """Elements (k, 4) of a continuous group that turn by at most an angle; of a finite one only the identity."""
    if group.is_finite:
        return np.array([IDENTITY])
    axes = np.eye(3) if group.axis is None else np.array([group.axis])
    angles = angle_rad * np.linspace(-1, 1, 17)
    return np.concatenate([from_axis_angle(axis, angles) for axis in axes])


def directions(n: int) -> Floats:
    """n directions (n, 3) spread evenly over the sphere (a Fibonacci spiral)."""
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + np.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
