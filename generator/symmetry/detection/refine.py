"""Fitting an ideal group to a mesh: the axes and the fixed point for which the images lie nearest to the surface."""

from __future__ import annotations

import numpy as np

from synthetless.symmetry.detection.distance import Surface
from synthetless.symmetry.detection.residual import ResidualMeter, some_elements
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import parse_name
from synthetless.symmetry.quaternions import Floats, from_axis_angle, multiply, normalise, to_matrix

_ELEMENTS = 6
_IMAGES = 800  # points times elements that a step looks at
_SNAP_DEG = 1.0
_SNAP_OFFSET = 2e-3  # of the diameter
_NO_WORSE = 1e-4  # likewise
_WIDEST, _NARROWEST = 0.05, 2e-3  # deviations that count half or less, as shares of the diameter
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
    center = np.array(group.offset_mm)
    matrices = to_matrix(some_elements(group, _ELEMENTS))
    before = points[:: max(1, len(points) * len(matrices) // _IMAGES)] - center
    after = np.einsum("mij,nj->mni", matrices, before)
    images = after.reshape(-1, 3)
    found = surface.closest(images + center)
    apart = images + center - found.point
    far = found.distance > 1e-6 * diameter_mm
    gradient = np.where(far[:, None], apart / np.where(far, found.distance, 1)[:, None], found.normal)
    back = np.einsum("mji,mnj->mni", matrices, gradient.reshape(after.shape)).reshape(-1, 3)  # R^T g
    radius = diameter_mm / 2  # makes turns and shifts comparable
    turning = np.cross(images, gradient) - np.cross(np.tile(before, (len(matrices), 1)), back)
    jacobian = np.concatenate([turning / radius, gradient - back], axis=1)
    weight = 1 / (1 + (found.distance / scale) ** 2) ** 2
    normal = jacobian.T @ (weight[:, None] * jacobian)
    right = -jacobian.T @ (weight * found.distance)
    values, vectors = np.linalg.eigh(normal)
    fixed = values > 1e-7 * max(values[-1], 1e-300)  # the others move the group within itself
    step = vectors[:, fixed] @ ((vectors[:, fixed].T @ right) / values[fixed])
    step *= min(1, 0.03 * diameter_mm / max(float(np.linalg.norm(step)), 1e-300))
    return step[:3] / radius, step[3:]


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
