"""From the symmetry fields of BOP's `models_info.json` to an exact group.

`symmetries_discrete` are 4x4 matrices (16 numbers, row-major, or nested) without the identity, not necessarily closed
and sometimes noisy; `symmetries_continuous` are {axis, offset}. Each discrete rotation is snapped to an exact one about
its axis, the snapped ones are multiplied out, the group is recognised by the orders of its axes, and the ideal group is
fitted to the given axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from synthetless.errors import UserError
from synthetless.symmetry.point_groups import (
    MAX_ORDER,
    Family,
    GroupName,
    Z,
    frame_of_axes,
    frame_of_axis,
    standard_elements,
)
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    angle_deg,
    conjugate,
    from_axis_angle,
    from_matrix,
    multiply,
    normalise,
    rotate,
    to_matrix,
)

SAME_DEG = 0.5  # rotations nearer than this are one, blurred by the file's noise
FIT_DEG = 1.0  # an element farther than this from the ideal group's is none of its elements
_AMONG_EQUALS = normalise([1.0, 3.1e-3, 4.7e-3, 2.3e-3])  # chooses between frames that are equally near the identity


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


def recognise_finite(rotations: Sequence[Floats]) -> tuple[GroupName, Floats]:
    """The group that unit quaternions (4,) generate, and its frame (rotation from the standard frame, wxyz).

    Of the frames that describe the same group the one nearest to the identity is taken.

    Raises:
        UserError: they generate more than 120 elements, or are too inaccurate to tell what they generate.
    """
    generators = [q for q in (_snapped(q) for q in rotations) if angle_deg(q, np.array(IDENTITY)) > SAME_DEG]
    elements = _closure(generators)
    if len(elements) == 1:
        return GroupName("C", 1), np.array(IDENTITY)
    axes, orders = _axes_and_orders(elements)
    name = _name_of(len(elements), sorted(orders, reverse=True))
    if name.family == "C":
        return name, frame_of_axis(_mean_axis(generators))
    return name, _fitted_frame(name, _first_frame(name, axes, orders), elements, generators)


def _snapped(q: Floats) -> Floats:
    """The rotation about the same axis by the nearest 2 pi k / n that the noise can explain.

    A fraction with a large n is near every angle, so the allowed difference shrinks with n^2.
    """
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    angle = 2 * np.arctan2(sine, q[0])
    n = np.arange(1, MAX_ORDER + 1)
    nearest = 2 * np.pi * np.round(angle * n / (2 * np.pi)) / n
    misfit = np.abs(nearest - angle) * n**2
    best = int(np.argmax(misfit <= misfit.min() + 1e-9))
    if misfit[best] > 0.1 or abs(nearest[best] - angle) > 5e-3:
        raise UserError(
            f"a rotation by {np.degrees(angle):.4f} degrees generates more than {MAX_ORDER} rotations: "
            "it is no finite symmetry (a full turn divided by a whole number); use a continuous one"
        )
    if nearest[best] == 0:
        return np.array(IDENTITY)
    return from_axis_angle(q[1:] / sine, nearest[best])


def _closure(generators: Sequence[Floats]) -> Floats:
    elements = [np.array(IDENTITY)]
    for element in elements:  # grows while it is walked: breadth first, so that every word is as short as possible
        products = multiply(element, np.reshape(generators, (-1, 4)))
        is_new = angle_deg(products[:, None], np.stack(elements)).min(axis=1) > SAME_DEG
        for product in products[is_new]:
            if angle_deg(np.stack(elements), product).min() > SAME_DEG:  # two generators may give the same
                elements.append(product)
        if len(elements) > MAX_ORDER:
            raise UserError(
                f"symmetries_discrete generate more than {MAX_ORDER} rotations: "
                "they belong to no finite rotation group (axes or angles are wrong, or the part is continuous)"
            )
    return np.stack(elements)


def _axes_and_orders(elements: Floats) -> tuple[list[Floats], list[int]]:
    """The distinct axes of a closed set, and for each how many of the rotations (with the identity) turn about it."""
    axes: list[Floats] = []
    orders: list[int] = []
    for axis in normalise(elements[1:, 1:]):
        for i, known in enumerate(axes):
            if abs(axis @ known) > np.cos(np.radians(FIT_DEG)):
                orders[i] += 1
                break
        else:
            axes.append(axis)
            orders.append(2)
    return axes, orders


def _name_of(size: int, orders: list[int]) -> GroupName:
    candidates: dict[Family, list[int]] = {
        "C": [size],
        "D": sorted([size // 2] + [2] * (size // 2), reverse=True),
        "T": [3] * 4 + [2] * 3,
        "O": [4] * 3 + [3] * 4 + [2] * 6,
        "I": [5] * 6 + [3] * 10 + [2] * 15,
    }
    for family, expected in candidates.items():
        if orders == expected:
            return GroupName(family, {"C": size, "D": size // 2}.get(family, 0))
    raise UserError(
        f"symmetries_discrete generate {size} rotations with axes of orders {orders}: "
        "they are too inaccurate to tell the group"
    )


def _mean_axis(rotations: Sequence[Floats]) -> Floats:
    axes = normalise(np.stack(rotations)[:, 1:])
    _, vectors = np.linalg.eigh(axes.T @ axes)
    return np.asarray(vectors[:, -1])


def _first_frame(name: GroupName, axes: list[Floats], orders: list[int]) -> Floats:
    """A frame from two perpendicular axes of the kind that the standard frame has along z and x."""
    z_order = {"D": name.n, "O": 4}.get(name.family, 2)
    x_order = {"O": 4}.get(name.family, 2)
    z_index = orders.index(z_order)
    across = [i for i in range(len(axes)) if i != z_index and orders[i] == x_order]
    x_index = min(across, key=lambda i: abs(float(axes[i] @ axes[z_index])))
    return frame_of_axes(axes[z_index], axes[x_index])


def _fitted_frame(name: GroupName, first: Floats, elements: Floats, generators: Sequence[Floats]) -> Floats:
    ideal = standard_elements(name)
    # The three 2-fold axes of I that are perpendicular fit its standard frame in two ways, a quarter turn apart.
    starts = [first, multiply(first, from_axis_angle(Z, np.pi / 2))]
    frame = min(starts, key=lambda start: _misfit_deg(start, ideal, elements))
    frame = _best_rotation(frame, ideal, generators)
    if _misfit_deg(frame, ideal, elements) > FIT_DEG:
        raise UserError(
            "symmetries_discrete are too inaccurate to tell the group: write it into a symmetry table instead"
        )
    equal_frames = multiply(frame, standard_elements(_normaliser(name)))
    return np.asarray(equal_frames[np.argmax(np.abs(equal_frames @ _AMONG_EQUALS))])


def _misfit_deg(frame: Floats, ideal: Floats, elements: Floats) -> float:
    placed = multiply(multiply(frame, ideal), conjugate(frame))
    return float(angle_deg(elements[:, None], placed[None]).min(axis=1).max())


def _best_rotation(frame: Floats, ideal: Floats, generators: Sequence[Floats]) -> Floats:
    """Kabsch's rotation of the ideal axes onto the given ones, matched in a frame that is nearly right."""
    given = normalise(np.stack(generators)[:, 1:])
    in_frame = multiply(multiply(conjugate(frame), np.stack(generators)), frame)
    matched = ideal[np.argmin(angle_deg(in_frame[:, None], ideal[None]), axis=1)]
    standard = normalise(matched[:, 1:])
    standard *= np.where(np.sum(standard * in_frame[:, 1:], axis=1, keepdims=True) < 0, -1.0, 1.0)
    U, _, Vt = np.linalg.svd(given.T @ standard)
    turn = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return np.asarray(from_matrix(turn[None])[0])


def _normaliser(name: GroupName) -> GroupName:
    """The rotations that map the group onto itself: frames that differ by one of them describe the same group."""
    if name.family == "D":
        return GroupName("D", 2 * name.n) if name.n > 2 else GroupName("O", 0)
    return GroupName("I" if name.family == "I" else "O", 0)
