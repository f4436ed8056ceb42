"""Fitting an ideal group to a mesh: the axes and the fixed point for which the images lie nearest to the surface."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from synthetless.symmetry.detection.distance import Surface
from synthetless.symmetry.detection.residual import GroupFit, ResidualMeter, some_elements
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import parse_name
from synthetless.symmetry.quaternions import (
    Floats,
    conjugate,
    cross,
    from_axis_angle,
    multiply,
    normalise,
    to_matrix,
)

_ELEMENTS = 6
_IMAGES = 800  # points times elements that a step looks at
_SNAP_DEG = 1.0
_SNAP_OFFSET = 2e-3  # of the diameter
_NO_WORSE = 1e-4  # likewise
_WIDEST, _NARROWEST = 0.05, 2e-3  # deviations that count half or less, as shares of the diameter
_SPREAD_PAIRS = 1500  # that the largest residual is minimised over
_ROUNDS, _LINEAR_STEPS = 4, 15
_WORTH = 0.02  # a gain below this share of the residual ends that search
_CONVERGED = 1e-5  # a step this small, as a share of the diameter, is the last


def refined(
    group: SymmetryGroup, surface: Surface, points: Floats, diameter_mm: float, steps: int = 12
) -> SymmetryGroup:
    """The group moved so that it fits the mesh near it best, by Gauss-Newton on a robust sum over `points` (N, 3).

    With the frame moved by x -> x + w x (x - c) + v an element S p = R (p - c) + c moves by
    w x R (p - c) - R (w x (p - c)) + v - R v; only the part along the distance's gradient counts. Parts that deviate
    much (a notch, a missing screw) count little, so that they do not pull the axis aside.
    """
    scale = _WIDEST * diameter_mm
    for _ in range(steps):
        turn, shift = _step(group, surface, points, scale, diameter_mm)
        group = _moved(group, turn, shift)
        step = float(np.linalg.norm(turn)) * diameter_mm / 2 + float(np.linalg.norm(shift))
        if scale == _NARROWEST * diameter_mm and step < _CONVERGED * diameter_mm:
            break
        if step < scale / 4:
            scale = max(scale / 3, _NARROWEST * diameter_mm)
    return group


def _step(
    group: SymmetryGroup, surface: Surface, points: Floats, scale: float, diameter_mm: float
) -> tuple[Floats, Floats]:
    """The turn (3,) in rad about the fixed point, the shift (3,) in mm."""
    elements = some_elements(group, _ELEMENTS)
    chosen = points[:: max(1, len(points) * len(elements) // _IMAGES)]
    pairs = np.tile(chosen, (len(elements), 1)), np.repeat(elements, len(chosen), axis=0)
    distance, jacobian = _linearised(group, surface, *pairs, diameter_mm)
    weight = 1 / (1 + (distance / scale) ** 2) ** 2
    normal = jacobian.T @ (weight[:, None] * jacobian)
    right = -jacobian.T @ (weight * distance)
    values, vectors = np.linalg.eigh(normal)
    fixed = values > 1e-7 * max(values[-1], 1e-300)  # the others move the group within itself
    step = vectors[:, fixed] @ ((vectors[:, fixed].T @ right) / values[fixed])
    step *= min(1, 0.03 * diameter_mm / max(float(np.linalg.norm(step)), 1e-300))
    return step[:3] / (diameter_mm / 2), step[3:]


def _linearised(
    group: SymmetryGroup,
    surface: Surface,
    points: Floats,
    elements: Floats,
    diameter_mm: float,
    surely: bool = False,
) -> tuple[Floats, Floats]:
    """How far points (N, 3) are off the surface after elements (N, 4), mm, and how that changes, (N, 6), with a turn of
    the group (in rad times half the diameter, so that turns and shifts are comparable) and a shift (mm); `surely` as
    in `Surface.closest`."""
    center = np.array(group.offset_mm)
    matrices, before = to_matrix(elements), points - center
    images = np.einsum("nij,nj->ni", matrices, before)
    found = surface.closest(images + center, surely)
    apart = images + center - found.point
    far = found.distance > 1e-6 * diameter_mm
    gradient = np.where(far[:, None], apart / np.where(far, found.distance, 1)[:, None], found.normal)
    back = np.einsum("nji,nj->ni", matrices, gradient)  # R^T g
    turning = cross(images, gradient) - cross(before, back)
    return found.distance, np.concatenate([turning / (diameter_mm / 2), gradient - back], axis=1)


def tightened(fit: GroupFit, surface: Surface, meter: ResidualMeter, enough_mm: float) -> GroupFit:
    """The group moved so that its largest residual, not the sum of squares, is as small as can be near where it is.

    The largest of many deviations that change nearly linearly with the placement is minimised by linear programming
    within a shrinking reach, over pairs from all over the surface and those that were found to be the worst.
    """
    points, local = meter.worst_pairs(fit.group, _SPREAD_PAIRS)
    reach = fit.residual.max_mm / 2
    for _ in range(_ROUNDS):
        group, reach = _with_smallest_maximum(fit.group, surface, points, local, reach, meter.diameter_mm)
        found = GroupFit(group, meter.measure(group, enough_mm))
        if found.residual.max_mm < fit.residual.max_mm:
            gain, fit = fit.residual.max_mm - found.residual.max_mm, found
            if gain < _WORTH * fit.residual.max_mm:
                break
        worse_points, worse_local = meter.worst_pairs(group, _SPREAD_PAIRS)
        points, local = np.concatenate([points, worse_points]), np.concatenate([local, worse_local])
    return fit


def _with_smallest_maximum(
    group: SymmetryGroup, surface: Surface, points: Floats, local: Floats, reach: float, diameter_mm: float
) -> tuple[SymmetryGroup, float]:
    """The placement with the smallest largest deviation of some points (N, 3) after elements (N, 4), which are given in
    the group's standard frame, and the reach of the last steps."""
    distance, jacobian = _linearised(group, surface, points, _in_model_frame(group, local), diameter_mm, surely=True)
    for _ in range(_LINEAR_STEPS):
        near = distance > distance.max() - 4 * reach
        limits = np.column_stack([jacobian[near], np.full(int(near.sum()), -1.0)])
        bounds = [(-reach, reach)] * 6 + [(0, None)]
        solved = linprog([0.0] * 6 + [1.0], A_ub=limits, b_ub=-distance[near], bounds=bounds)
        if solved.x is None:
            break
        trial = _moved(group, solved.x[:3] / (diameter_mm / 2), solved.x[3:6])
        tried = _linearised(trial, surface, points, _in_model_frame(trial, local), diameter_mm, surely=True)
        if tried[0].max() < distance.max() - 1e-3 * reach:
            group, (distance, jacobian) = trial, tried
        else:
            reach /= 3
        if reach < _CONVERGED * diameter_mm:
            break
    return group, max(reach, 10 * _CONVERGED * diameter_mm)


def _in_model_frame(group: SymmetryGroup, local: Floats) -> Floats:
    """Elements (N, 4) of the standard frame where the group is."""
    return multiply(multiply(group.frame_wxyz, local), conjugate(group.frame_wxyz))


def _moved(group: SymmetryGroup, turn: Floats, shift: Floats) -> SymmetryGroup:
    angle = float(np.linalg.norm(turn))
    by = from_axis_angle(turn / angle if angle > 0 else turn, angle)
    offset = np.array(group.offset_mm) + shift
    return placed(group.name, normalise(multiply(by, group.frame_wxyz)), offset)


def placed(name: str, frame_wxyz: Floats, offset_mm: Floats) -> SymmetryGroup:
    """The group `name` in a frame (rotation from the standard frame) with a fixed point."""
    matrix = to_matrix(frame_wxyz)
    family, n = parse_name(name)
    if family == "SO(3)" or (family, n) == ("C", 1):
        return SymmetryGroup.from_name(name, offset_mm=offset_mm)
    return SymmetryGroup.from_name(name, frame=matrix, offset_mm=offset_mm)


def simplified(group: SymmetryGroup, meter: ResidualMeter) -> SymmetryGroup:
    """The group in the place that is easiest to read and fits as well: the frame nearest to the model's, axes along
    the coordinate axes, a fixed point of few digits."""
    if group.name == "C1":
        return group
    group = SymmetryGroup.from_bop(group.to_bop())
    snapped = _on_coordinate_axes(group, meter.diameter_mm)
    worse = meter.estimate(snapped) - meter.estimate(group)
    return snapped if worse <= _NO_WORSE * meter.diameter_mm else group


def _on_coordinate_axes(group: SymmetryGroup, diameter_mm: float) -> SymmetryGroup:
    digits = 4 - int(np.floor(np.log10(diameter_mm)))  # of a part of 100 mm: hundredths
    offset = np.round(np.array(group.offset_mm), digits)
    offset[np.abs(offset) < _SNAP_OFFSET * diameter_mm] = 0
    if group.axis is None:
        return SymmetryGroup.from_name(group.name, offset_mm=offset)
    axis = _snapped(np.array(group.axis))
    if group.secondary_axis is None:
        return SymmetryGroup.from_name(group.name, axis=axis, offset_mm=offset)
    across = _snapped(np.array(group.secondary_axis))
    return SymmetryGroup.from_name(group.name, axis, across - (across @ axis) * axis, offset)


def _snapped(axis: Floats) -> Floats:
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) < np.cos(np.radians(_SNAP_DEG)):
        return axis
    return np.asarray(np.sign(axis[nearest]) * np.eye(3)[nearest])
