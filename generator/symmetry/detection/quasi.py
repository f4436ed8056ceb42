"""The larger group that a mesh has but for a detail: within a tolerance of its own, and placed so that it contains the
exact group."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from synthetless.symmetry.detection.detect import Detected, size
from synthetless.symmetry.detection.residual import GroupFit
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, minimal, normalise, to_matrix

_SAMPLES = 7
_NEAR_DEG = 5.0
"""By how much the place of a group that was fitted by itself may miss that of the exact one."""


def quasi_fit(found: Detected, tolerance_mm: float, measure: Callable[[SymmetryGroup], GroupFit]) -> GroupFit | None:
    """The largest group within a tolerance that contains the answer; None if the answer itself is the largest.

    Args:
        found: what was measured on a mesh.
        tolerance_mm: what the largest residual may be.
        measure: measures a group on that mesh, as it stands.
    """
    exact = found.answer.group
    larger = [fit for fit in found.fits if size(fit.group) > size(exact) and fit.residual.max_mm <= tolerance_mm]
    for fit in sorted(larger, key=lambda fit: (-size(fit.group), fit.residual.max_mm)):
        group = around(fit.group, exact)
        if group is not None:
            placed = fit if group == fit.group else measure(group)
            if placed.residual.max_mm <= tolerance_mm:
                return placed
    return None


def around(larger: SymmetryGroup, exact: SymmetryGroup) -> SymmetryGroup | None:
    """A group moved so little that it contains another one; None if it would have to be moved far, or never does.

    SO(3) has no finite group in its place, so it is none of these.
    """
    if larger.family == "SO(3)":
        return None
    if exact.order == 1:
        return larger
    goals = _axes(exact)
    sources = np.array([_nearest_axis(larger, goal) for goal in goals])
    if (np.einsum("ij,ij->i", goals, sources) < np.cos(np.radians(_NEAR_DEG))).any():
        return None
    if len(goals) == 1:
        turn = to_matrix(minimal(sources[0], goals[0]))
    else:
        turn = Rotation.align_vectors(goals, sources)[0].as_matrix()
    assert larger.axis is not None
    secondary = None if larger.secondary_axis is None else turn @ np.array(larger.secondary_axis)
    c = np.array(exact.offset_mm)
    if exact.family in ("C", "SO(2)"):  # anywhere on its axis
        c = c + ((np.array(larger.offset_mm) - c) @ goals[0]) * goals[0]
    moved = SymmetryGroup.from_name(larger.name, turn @ np.array(larger.axis), secondary, c)
    return moved if moved.contains(exact) else None


def _axes(group: SymmetryGroup) -> Floats:
    """(k, 3) unit axes of a group's elements, one of each pair of opposite ones."""
    axes: list[Floats] = []
    for element in group.sampled_wxyz(_SAMPLES)[1:]:
        axis = normalise(element[1:])
        if all(abs(axis @ other) < 1 - 1e-9 for other in axes):
            axes.append(axis)
    return np.array(axes)


def _nearest_axis(group: SymmetryGroup, direction: Floats) -> Floats:
    """Of the axes of a group, either way round, the one nearest to a direction."""
    axes = _axes(group)
    if group.family == "O(2)":
        main = np.array(group.axis)
        across = direction - (direction @ main) * main
        axes = np.array([main, across / max(float(np.linalg.norm(across)), 1e-12)])
    cosines = axes @ direction
    best = int(np.argmax(np.abs(cosines)))
    return np.asarray(axes[best] * np.copysign(1.0, cosines[best]))
