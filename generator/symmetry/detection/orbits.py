"""Orbits: everywhere that the elements of a group take a point."""

from __future__ import annotations

import numpy as np

from synthetless.symmetry.detection.distance import Indices
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    from_axis_angle,
    minimal,
    multiply,
    normalise,
    rotate,
    to_matrix,
)

_GOLDEN = (np.sqrt(5) - 1) / 2
_TOWARDS = normalise([0.53, 0.29, 0.8])  # chooses the fundamental domain; in no plane of symmetry


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
    """n elements (n, 4) but the identity, evenly chosen in an order that has no period; repeated if there are less."""
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
        spheres = [minimal(normalise(point), _directions(n)) for point, n in zip(local, counts, strict=True)]
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


def _directions(n: int) -> Floats:
    """n directions (n, 3) spread evenly over the sphere (a Fibonacci spiral)."""
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + np.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
