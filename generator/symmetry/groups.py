"""The proper symmetry group of a rigid object, in the object's model frame.

Two poses of the object look the same exactly if they differ by an element S of its group: R_2 = R_1 S, so that
symmetries act on the right of `R_m2c`. Every element is a rotation about a line through one fixed point c: as a rigid
motion of the model it is x -> S x + (1 - S) c.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Self

from synthetless.errors import UserError
from synthetless.symmetry.from_bop import recognise
from synthetless.symmetry.point_groups import (
    Family,
    GroupName,
    X,
    Z,
    frame_of_axes,
    frame_of_axis,
    parse_name,
    signed_axis,
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

_log = logging.getLogger(__name__)

Vector = tuple[float, float, float]

_ORIGIN: Vector = (0.0, 0.0, 0.0)
_SAMPLES = 7
"""Of a continuous group, to find out whether another one contains it: sevenths of a turn are in none by chance."""
_WITH_ONE_AXIS = ("SO(2)", "O(2)")
_WITH_TWO_AXES = ("D", "T", "O", "I")


@dataclass(frozen=True)
class SymmetryGroup:
    """A rotation group placed in a model frame.

    Attributes:
        name: `C1` (no symmetry), `C2` ..., `D2` ..., `T`, `O`, `I`, `SO(2)`, `O(2)`, `SO(3)`.
        axis: the main axis, a unit vector, that the standard frame has along z; None for `C1` and `SO(3)`. For groups
            with one axis (`C_n`, `SO(2)`, `O(2)`) its sign is settled: u and -u are the same group and get the same
            labels.
        secondary_axis: what the standard frame has along x (see `point_groups`), for `D_n` a 2-fold axis; None for
            groups that one axis settles.
        offset_mm: a point that every element fixes, the one nearest to the origin.

    Raises:
        UserError: an unknown name, a zero or missing axis, axes that are not perpendicular, numbers that are not
            finite.
    """

    name: str
    axis: Vector | None = None
    secondary_axis: Vector | None = None
    offset_mm: Vector = _ORIGIN

    def __post_init__(self) -> None:
        parsed = parse_name(self.name)
        axis, secondary = _settled_axes(self.name, parsed, self.axis, self.secondary_axis)
        offset = _vector(self.offset_mm, f"{self.name}: offset_mm")
        if parsed == GroupName("C", 1):
            offset = np.zeros(3)
        elif axis is not None and parsed.family in ("C", "SO(2)"):
            along = float(offset @ axis)
            offset = offset - along * axis if abs(along) > 1e-9 * (1 + np.abs(offset).max()) else offset
        object.__setattr__(self, "axis", None if axis is None else _tuple(axis))
        object.__setattr__(self, "secondary_axis", None if secondary is None else _tuple(secondary))
        object.__setattr__(self, "offset_mm", _tuple(offset))

    @classmethod
    def trivial(cls) -> Self:
        """No symmetry: the identity only."""
        return cls("C1")

    @classmethod
    def from_name(
        cls,
        name: str,
        axis: ArrayLike | None = None,
        secondary_axis: ArrayLike | None = None,
        offset_mm: ArrayLike = _ORIGIN,
        frame: ArrayLike | None = None,
    ) -> Self:
        """A group by its name.

        Without axes the group stands in the standard frame. `axis` alone settles `C_n`, `SO(2)` and `O(2)`; `D_n`,
        `T`, `O` and `I` need `secondary_axis` too. `frame` (3, 3), the rotation from the standard frame, gives both at
        once.
        """
        if frame is not None:
            if axis is not None or secondary_axis is not None:
                raise UserError(f"{name}: give either a frame or axes, not both")
            columns = to_matrix(from_matrix(_matrix(frame, f"{name}: frame")[None], name=lambda _: f"{name}: frame")[0])
            family, n = parse_name(name)
            has_axis = family != "SO(3)" and (family, n) != ("C", 1)
            axis = columns[:, 2] if has_axis else None
            secondary_axis = columns[:, 0] if family in _WITH_TWO_AXES else None
        return cls(
            name,
            None if axis is None else _tuple(_vector(axis, f"{name}: axis")),
            None if secondary_axis is None else _tuple(_vector(secondary_axis, f"{name}: secondary_axis")),
            _tuple(_vector(offset_mm, f"{name}: offset_mm")),
        )

    @classmethod
    def from_bop(cls, info: Mapping[str, Any], what: str = "models_info.json") -> Self:
        """The closed group of an entry of BOP's `models_info.json`; without symmetry fields the trivial one.

        Its frame is the one nearest to the model frame, whatever generators the file lists, in whatever order.
        Rotations of low orders that are off by more than rounding are snapped, with a warning in the log that begins
        with `what`.

        Raises:
            UserError: a reflection or another non-rotation, numbers that are not finite, a zero axis, rotations that
                fit no group of at most 120 elements or more than one, motions without a common fixed point, or a
                misspelt field.
        """
        name, frame, offset, remarks = recognise(info)
        for remark in remarks:
            _log.warning("%s: %s", what, remark)
        text = name.text
        if text in ("C1", "SO(3)"):
            return cls(text, offset_mm=_tuple(np.round(offset, 9)))
        axes = np.round(rotate(frame, np.stack([Z, X])), 12)  # a file says 4e-14 where it means 0
        secondary = _tuple(axes[1]) if name.family in _WITH_TWO_AXES else None
        return cls(text, _tuple(axes[0]), secondary, _tuple(np.round(offset, 9)))

    def to_bop(self) -> dict[str, list[Any]]:
        """BOP's fields: `symmetries_discrete` closed, without the identity, and `symmetries_continuous`, where not
        empty."""
        fields: dict[str, list[Any]] = {}
        if len(self._discrete_wxyz) > 1:
            fields["symmetries_discrete"] = [m.ravel().tolist() for m in self._motions(self._discrete_wxyz[1:])]
        if not self.is_finite:
            axes = [X, Z] if self.axis is None else [np.array(self.axis)]
            offset = list(self.offset_mm)
            fields["symmetries_continuous"] = [{"axis": axis.tolist(), "offset": offset} for axis in axes]
        return fields

    @property
    def family(self) -> Family:
        """The name without the order."""
        return parse_name(self.name).family

    @property
    def main_order(self) -> int:
        """n of `C_n` and `D_n`, 0 for the other families."""
        return parse_name(self.name).n

    @property
    def is_finite(self) -> bool:
        """Whether the group has finitely many elements."""
        return self.family not in ("SO(2)", "O(2)", "SO(3)")

    @property
    def order(self) -> float:
        """The number of elements: a whole number, or `math.inf`."""
        return parse_name(self.name).order

    @cached_property
    def frame_wxyz(self) -> Floats:
        """The rotation (4,) from the standard frame (main axis z, secondary axis x) to the model frame."""
        if self.axis is None:
            return np.array([1.0, 0.0, 0.0, 0.0])
        if self.secondary_axis is None:
            return frame_of_axis(np.array(self.axis))
        return frame_of_axes(np.array(self.axis), np.array(self.secondary_axis))

    @property
    def elements_wxyz(self) -> Floats:
        """All elements (order, 4) as unit quaternions in the model frame, the identity first.

        Raises:
            UserError: the group is continuous; see `sampled_wxyz`.
        """
        if not self.is_finite:
            raise UserError(f"{self.name} has infinitely many elements: use sampled_wxyz")
        return self._discrete_wxyz

    def sampled_wxyz(self, samples: int = 72) -> Floats:
        """Elements as unit quaternions (n, 4): all of a finite group, else `samples` of each continuous part.

        For SO(3) the super-Fibonacci spiral (Alexa, CVPR 2022), turned so that it starts at the identity.
        """
        if self.is_finite:
            return self.elements_wxyz
        if self.family == "SO(3)":
            return _super_fibonacci(samples)
        turns = from_axis_angle(np.array(self.axis), 2 * np.pi * np.arange(samples) / samples)
        return multiply(turns[None, :], self._discrete_wxyz[:, None]).reshape(-1, 4)

    def motions(self, samples: int = 72) -> Floats:
        """The elements of `sampled_wxyz` as rigid motions of the model, (n, 4, 4), millimetres."""
        return self._motions(self.sampled_wxyz(samples))

    def appearance_distance_deg(self, R_a: ArrayLike, R_b: ArrayLike) -> Floats:
        """min over S of the rotation angle between `R_a` S and `R_b`, both (N, 3, 3), in degrees (N,)."""
        a, b = from_matrix(R_a), from_matrix(R_b)
        if self.family == "SO(3)":
            return np.zeros(max(len(a), len(b)))
        if self.is_finite:
            images = multiply(a[:, None], self.elements_wxyz)
            return np.asarray(angle_deg(images, b[:, None]).min(axis=1))
        u, v = rotate(a, np.array(self.axis)), rotate(b, np.array(self.axis))
        apart, together = np.linalg.norm(u - v, axis=1), np.linalg.norm(u + v, axis=1)
        angle = np.asarray(np.degrees(2 * np.arctan2(apart, together)))
        return np.minimum(angle, 180 - angle) if self.family == "O(2)" else angle

    def contains(self, other: SymmetryGroup, apart_deg: float = 0.05, apart_mm: float = 0.01) -> bool:
        """Whether every motion of another group is one of this group.

        Args:
            other: the group that may be smaller.
            apart_deg: by how much a rotation of it may miss the nearest one of this group.
            apart_mm: by how much its motions may move this group's fixed point.
        """
        if other.order > self.order:
            return False
        motions = other.motions(_SAMPLES)
        identity = np.broadcast_to(np.eye(3), (len(motions), 3, 3))
        c = np.array(self.offset_mm)
        moved_mm = np.linalg.norm(motions[:, :3, :3] @ c + motions[:, :3, 3] - c, axis=1)
        turned_deg = self.appearance_distance_deg(identity, motions[:, :3, :3])
        return bool(turned_deg.max() <= apart_deg and moved_mm.max() <= apart_mm)

    @cached_property
    def _discrete_wxyz(self) -> Floats:
        """The elements of a finite group; for O(2) the identity and one half turn, else the identity."""
        elements = standard_elements(parse_name(self.name))
        placed = multiply(multiply(self.frame_wxyz, elements), conjugate(self.frame_wxyz))
        placed[0] = IDENTITY  # to the last bit
        placed.flags.writeable = False
        return placed

    def _motions(self, elements: Floats) -> Floats:
        motions = np.tile(np.eye(4), (len(elements), 1, 1))
        motions[:, :3, :3] = to_matrix(elements)
        motions[:, :3, 3] = np.array(self.offset_mm) - motions[:, :3, :3] @ np.array(self.offset_mm)
        return motions


def _settled_axes(
    name: str, parsed: GroupName, axis: Sequence[float] | None, secondary: Sequence[float] | None
) -> tuple[Floats | None, Floats | None]:
    """Unit axes, perpendicular where there are two, defaults filled in; exact ones stay as they are, bit for bit."""
    if parsed == GroupName("C", 1) or parsed.family == "SO(3)":
        if axis is not None or secondary is not None:
            raise UserError(f"{name} has no axis of its own: leave axis and secondary_axis out")
        return None, None
    if parsed.family in _WITH_TWO_AXES:
        if axis is None and secondary is None:
            return Z, X
        if axis is None or secondary is None:
            raise UserError(f"{name} needs both axis and secondary_axis (for D_n a 2-fold axis), or neither")
        z, x = _unit(axis, f"{name}: axis"), _unit(secondary, f"{name}: secondary_axis")
        if abs(z @ x) > np.sin(np.radians(1)):
            raise UserError(f"{name}: axis {_tuple(z)} and secondary_axis {_tuple(x)} must be perpendicular")
        return z, x if abs(z @ x) < 1e-14 else normalise(x - (x @ z) * z)
    if secondary is not None:
        raise UserError(f"{name} has one axis: leave secondary_axis out")
    return signed_axis(Z if axis is None else _unit(axis, f"{name}: axis")), None


def _unit(value: ArrayLike, what: str) -> Floats:
    vector = _vector(value, what)
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise UserError(f"{what} is zero: it needs a direction, such as [0, 0, 1]")
    return vector if abs(length - 1) < 1e-14 else vector / length


def _vector(value: ArrayLike, what: str) -> Floats:
    return _array(value, (3,), what)


def _matrix(value: ArrayLike, what: str) -> Floats:
    return _array(value, (3, 3), what)


def _array(value: ArrayLike, shape: tuple[int, ...], what: str) -> Floats:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != math.prod(shape) or not np.isfinite(array).all():
        raise UserError(f"{what} is {value!r}, not {math.prod(shape)} finite numbers")
    return array.reshape(shape)


def _tuple(vector: Floats) -> Vector:
    x, y, z = (float(value) + 0.0 for value in vector)  # + 0.0 turns -0.0 into 0.0
    return x, y, z


def _super_fibonacci(n: int) -> Floats:
    i = np.arange(n) + 0.5
    inner, outer = np.sqrt(i / n), np.sqrt(1 - i / n)
    alpha, beta = 2 * np.pi * i / np.sqrt(2), 2 * np.pi * i / 1.533751168755204288118041
    spiral = np.stack(
        [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)], axis=1
    )
    return multiply(conjugate(spiral[0]), spiral)
