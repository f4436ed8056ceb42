"""From the symmetry fields of BOP's `models_info.json` to an exact group.

`symmetries_discrete` are 4x4 matrices (16 numbers, row-major, or nested) without the identity, not necessarily closed
and sometimes noisy; `symmetries_continuous` are {axis, offset}.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from synthetless.errors import UserError
from synthetless.symmetry.frames import frame_of_axis
from synthetless.symmetry.point_groups import Family, GroupName, Z, standard_elements
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    angle_deg,
    conjugate,
    from_matrix,
    multiply,
    normalise,
    rotate,
    to_matrix,
)
from synthetless.symmetry.recognition import FIT_DEG, recognise_finite


class Recognised(NamedTuple):
    """A group: its name, its frame (rotation from the standard frame, wxyz) and a point every element fixes, mm."""

    name: GroupName
    frame_wxyz: Floats
    offset_mm: Floats


class Motion(NamedTuple):
    """A rigid motion of the model that is said to leave it unchanged."""

    rotation_wxyz: Floats
    translation_mm: Floats


class Line(NamedTuple):
    """A continuous symmetry's axis: unit direction and a point on it, mm."""

    axis: Floats
    point_mm: Floats


def recognise(info: Mapping[str, Any]) -> Recognised:
    """The closed group of a `models_info.json` entry.

    Raises:
        UserError: no rotation (reflection, scaling, NaN), a zero axis, more than 120 elements, no common fixed point.
    """
    if not isinstance(info, Mapping):
        raise UserError(f"{info!r} is no entry of models_info.json, which maps field names to values")
    lines = [_line(item, i) for i, item in enumerate(_listed(info, "symmetries_continuous"))]
    motions = [_motion(item, i) for i, item in enumerate(_listed(info, "symmetries_discrete"))]
    tolerance_mm = 0.1 + 1e-3 * max((float(np.abs(m.translation_mm).max()) for m in motions), default=0.0)
    name, frame = _continuous(lines, motions) if lines else recognise_finite([m.rotation_wxyz for m in motions])
    return Recognised(name, frame, _fixed_point(name, frame, lines, motions, tolerance_mm))


def _listed(info: Mapping[str, Any], key: str) -> Sequence[Any]:
    value = info.get(key) or []
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
        raise UserError(f"{key} is {value!r}, not a list")
    return value


def _numbers(value: object, size: int, what: str) -> Floats:
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if len(numbers) != size or not np.isfinite(numbers).all():
        raise UserError(f"{what} is {value!r}, not {size} finite numbers")
    return numbers


def _line(item: object, i: int) -> Line:
    what = f"symmetries_continuous[{i}]"
    if not isinstance(item, Mapping) or "axis" not in item:
        raise UserError(f"{what} is {item!r}, not an {{axis, offset}} pair")
    axis = _numbers(item["axis"], 3, f"{what}: axis")
    if np.linalg.norm(axis) < 1e-9:
        raise UserError(f"{what}: axis is zero; a symmetry axis needs a direction, such as [0, 0, 1]")
    return Line(normalise(axis), _numbers(item.get("offset", (0, 0, 0)), 3, f"{what}: offset"))


def _motion(item: object, i: int) -> Motion:
    what = f"symmetries_discrete[{i}]"
    matrix = _numbers(item, 16, what).reshape(4, 4)
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise UserError(f"{what} has the last row {matrix[3].tolist()}, not [0, 0, 0, 1]: it is no rigid motion")
    return Motion(from_matrix(matrix[None, :3, :3], name=lambda _: what)[0], matrix[:3, 3])


def _continuous(lines: Sequence[Line], motions: Sequence[Motion]) -> tuple[GroupName, Floats]:
    cosines = [abs(float(line.axis @ lines[0].axis)) for line in lines]
    if min(cosines) < np.cos(np.radians(FIT_DEG)):
        return GroupName("SO(3)", 0), np.array(IDENTITY)
    axis = lines[0].axis
    family: Family = "SO(2)"
    for i, motion in enumerate(motions):
        cosine = float(rotate(motion.rotation_wxyz, axis) @ axis)
        if abs(cosine) < np.cos(np.radians(2 * FIT_DEG)):
            raise UserError(
                f"symmetries_discrete[{i}] tilts the continuous axis by {np.degrees(np.arccos(cosine)):.1f} degrees: "
                "it must keep or reverse it (give a second continuous axis for a sphere)"
            )
        family = "O(2)" if cosine < 0 else family
    return GroupName(family, 0), frame_of_axis(axis)


def _fixed_point(
    name: GroupName, frame: Floats, lines: Sequence[Line], motions: Sequence[Motion], tolerance_mm: float
) -> Floats:
    """The point nearest the origin that all given motions keep, by least squares."""
    axis = rotate(frame, Z)
    rows: list[Floats] = []
    sides: list[Floats] = []
    for line in lines:
        direction = line.axis if name.family == "SO(3)" else axis
        across = np.eye(3) - np.outer(direction, direction)
        rows.append(across)
        sides.append(across @ line.point_mm)
    for motion in motions:
        rows.append(np.eye(3) - to_matrix(_ideal_rotation(name, frame, motion.rotation_wxyz)))
        sides.append(motion.translation_mm)
    if not rows:
        return np.zeros(3)
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    point = np.linalg.lstsq(matrix, side, rcond=1e-6)[0]
    residual = float(np.abs(matrix @ point - side).max())
    if residual > tolerance_mm:
        raise UserError(
            f"the symmetries have no common fixed point (they miss one by {residual:.3g} mm): rotations about "
            "axes that meet are needed, without a shift along the axis"
        )
    return np.asarray(point)


def _ideal_rotation(name: GroupName, frame: Floats, q: Floats) -> Floats:
    """The element of the group nearest to a noisy one."""
    if name.family == "SO(3)":
        return q
    standard = multiply(multiply(conjugate(frame), q), frame)
    if name.family in ("SO(2)", "O(2)"):
        # Keep the part that is a turn about z, or a half turn about an axis across z.
        part = [standard[0], 0, 0, standard[3]] if abs(standard[0]) + abs(standard[3]) > 0.5 else [0, *standard[1:3], 0]
        ideal = normalise(np.array(part))
    else:
        elements = standard_elements(name)
        ideal = elements[np.argmin(angle_deg(elements, standard))]
    return multiply(multiply(frame, ideal), conjugate(frame))
