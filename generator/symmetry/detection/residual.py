"""How far a mesh is from having a symmetry group.

For a point p of the surface X and an element S of the group G the deviation is the distance from S p to X. As G holds
the inverse of each of its elements, all deviations together are the two-sided distance between X and all its images.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from generator.symmetry.detection.distance import Indices, Surface
from generator.symmetry.groups import SymmetryGroup
from generator.symmetry.quaternions import Floats, from_axis_angle, minimal, multiply, normalise, rotate, to_matrix

_SAMPLES = 160_000  # points that the maximum is searched among; every 8th takes part from the start
_STRIDE = 8
_QUICK_PAIRS = 12_000
_STEP = 5e-3  # along the circles of a continuous group, as a share of the diameter
_CELL = 2.5e-3  # orbits this near to each other are judged by one of them
_LARGE = 60_000  # pairs that are judged even when the group is out of the question
_SEEDS = 48  # pairs from which the maximum is searched further
_EXACT = 400


@dataclass(frozen=True)
class Residual:
    """Deviations over all elements but the identity: the largest over the whole surface, and by area the 95th
    percentile and the root mean square, mm."""

    max_mm: float
    p95_mm: float
    rms_mm: float


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Points, by number, and elements that move them, (N,) and (N, 4) wxyz, with the area weights (N,) of the pairs."""

    index: Indices
    element: Floats
    weight: Floats


class Meter:
    """Measures the residuals of groups on one mesh.

    Attributes:
        surface: the mesh.
        diameter_mm: its largest extent: what accuracy is relative to.
        points: (P, 3) vertices and evenly spread samples, of which those before `n_samples` are the latter.
    """

    def __init__(self, surface: Surface, vertices_mm: Floats, diameter_mm: float) -> None:
        self.surface, self.diameter_mm = surface, diameter_mm
        self._dense = surface.sampled(_SAMPLES)
        self._dense_tree = cKDTree(self._dense)
        samples = self._dense[::_STRIDE]
        self.n_samples = len(samples)
        self.points: Floats = np.concatenate([samples, np.unique(vertices_mm, axis=0)])

    def measure(self, group: SymmetryGroup, enough_mm: float) -> Residual:
        """The residual of a group; where it exceeds `enough_mm` by far, percentiles from fewer points."""
        if group.name == "C1":
            return Residual(0.0, 0.0, 0.0)
        pairs = self._some_pairs(group, _QUICK_PAIRS)
        found = self._deviations(group, pairs)
        if found.max() <= 2 * enough_mm:
            pairs = self._all_pairs(group)
        else:
            pairs = self._some_pairs(group, _LARGE)
        found = self._deviations(group, pairs)
        return Residual(self._maximum(group, pairs, found), *_statistics(found, pairs.weight))

    def _deviations(self, group: SymmetryGroup, pairs: _Pairs) -> Floats:
        return self.surface.distance(_moved(group, self.points[pairs.index], pairs.element))

    def _some_pairs(self, group: SymmetryGroup, n: int) -> _Pairs:
        """About n pairs: evenly chosen points, each with all elements of a finite group or with a few."""
        elements = _nontrivial(group) if group.is_finite else group.sampled_wxyz(24)[1:]
        stride = max(1, len(self.points) * len(elements) // n)
        index = np.arange(0, len(self.points), stride)
        weight = (index < self.n_samples).astype(np.float64)
        return _Pairs(np.repeat(index, len(elements)), np.tile(elements, (len(index), 1)), np.repeat(weight, len(elements)))

    def _all_pairs(self, group: SymmetryGroup) -> _Pairs:
        """One point of every orbit, with all elements of a finite group, or with elements as dense as `_STEP`."""
        index, weight = self._orbits(group)
        if group.is_finite:
            elements = _nontrivial(group)
            n = len(elements)
            return _Pairs(np.repeat(index, n), np.tile(elements, (len(index), 1)), np.repeat(weight, n))
        counts, elements = _dense_elements(group, self.points[index], _STEP * self.diameter_mm)
        return _Pairs(np.repeat(index, counts), elements, np.repeat(weight / counts, counts))

    def _orbits(self, group: SymmetryGroup) -> tuple[Indices, Floats]:
        """The number of one point of each orbit of the group, and how many samples lie on it."""
        places = _in_fundamental_domain(group, self.points - np.array(group.offset_mm))
        cells = np.floor(places / (_CELL * self.diameter_mm)).astype(np.int64)
        _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        counts = np.bincount(cell.ravel()[: self.n_samples], minlength=len(first))
        return first, counts.astype(np.float64)

    def _maximum(self, group: SymmetryGroup, pairs: _Pairs, found: Floats) -> float:
        """The largest deviation: from the worst pairs on to the points and elements beside them, exactly."""
        worst = np.argsort(found)[::-1][:_SEEDS]
        seeds, elements = self.points[pairs.index[worst]], pairs.element[worst]
        near = self._dense_tree.query_ball_point(seeds, 1e-2 * self.diameter_mm)
        counts = np.array([len(n) for n in near])
        beside = self._dense[np.concatenate(near).astype(np.int64)] if counts.any() else self._dense[:0]
        points = [self.points[pairs.index], beside]
        turns = [pairs.element, np.repeat(elements, counts, axis=0)]
        if not group.is_finite:
            steps = _small_turns(group, _STEP)
            points.append(np.repeat(seeds, len(steps), axis=0))
            turns.append(multiply(steps[None], elements[:, None]).reshape(-1, 4))
        images = [_moved(group, p, q) for p, q in zip(points, turns, strict=True)]
        places = np.concatenate(images)
        distances = np.concatenate([found, self.surface.distance(np.concatenate(images[1:]))])
        order = np.argsort(distances)[::-1][:_EXACT]
        best = 0.0
        for i in order:
            if distances[i] <= best:
                break
            best = max(best, float(self.surface.exact(places[i : i + 1], distances[i : i + 1])[0]))
        return best


def _nontrivial(group: SymmetryGroup) -> Floats:
    return np.asarray(group.elements_wxyz[1:])


def _moved(group: SymmetryGroup, points: Floats, elements: Floats) -> Floats:
    offset = np.array(group.offset_mm)
    return np.einsum("nij,nj->ni", to_matrix(elements), points - offset) + offset


def _in_fundamental_domain(group: SymmetryGroup, points: Floats) -> Floats:
    """Coordinates that are the same for all points of an orbit."""
    if group.family == "SO(3)":
        return np.linalg.norm(points, axis=1, keepdims=True)
    if not group.is_finite:
        along = points @ np.array(group.axis)
        across = np.linalg.norm(points - along[:, None] * np.array(group.axis), axis=1)
        return np.stack([across, np.abs(along) if group.family == "O(2)" else along], axis=1)
    towards = rotate(group.frame_wxyz, normalise([0.53, 0.29, 0.8]))
    matrices = to_matrix(group.elements_wxyz)
    chosen = matrices[np.argmax(points @ (towards @ matrices).T, axis=1)]
    return np.einsum("nij,nj->ni", chosen, points)


def _dense_elements(group: SymmetryGroup, points: Floats, step_mm: float) -> tuple[Indices, Floats]:
    """For each point (N, 3) how many elements move it in steps of about `step_mm` over its orbit, and all of them."""
    local = points - np.array(group.offset_mm)
    if group.family == "SO(3)":
        radii = np.linalg.norm(local, axis=1)
        counts = np.clip(4 * np.pi * radii**2 / (2 * step_mm) ** 2, 24, 4000).astype(np.int64)
        spheres = [minimal(normalise(p), _fibonacci(n)) for p, n in zip(local, counts, strict=True)]
        return counts, np.concatenate(spheres)
    axis = np.array(group.axis)
    radii = np.linalg.norm(np.cross(axis, local), axis=1)
    turns = np.clip(np.ceil(2 * np.pi * radii / step_mm), 12, 720).astype(np.int64)
    discrete = group.sampled_wxyz(1)
    counts = turns * len(discrete)
    angles = np.concatenate([np.arange(k * len(discrete)) // len(discrete) * (2 * np.pi / k) for k in turns])
    flips = discrete[np.concatenate([np.arange(n) % len(discrete) for n in counts])]
    return counts, multiply(from_axis_angle(axis, angles), flips)


def _small_turns(group: SymmetryGroup, step: float) -> Floats:
    """Turns of a continuous group by less than a step, whose length on the rim is a share `step` of the diameter."""
    angles = 2 * step * np.linspace(-1, 1, 9)
    axes = np.eye(3) if group.axis is None else np.array([group.axis])
    return np.concatenate([from_axis_angle(axis, angles) for axis in axes])


def _fibonacci(n: int) -> Floats:
    """n directions (n, 3) spread evenly over the sphere."""
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + np.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _statistics(deviations: Floats, weights: Floats) -> tuple[float, float]:
    """The 95th percentile and the root mean square."""
    order = np.argsort(deviations)
    cumulated = np.cumsum(weights[order])
    p95 = deviations[order[np.searchsorted(cumulated, 0.95 * cumulated[-1])]]
    return float(p95), float(np.sqrt(weights @ deviations**2 / cumulated[-1]))
