"""The rotation groups a rigid object can have, their names, and the standard frame each is given in.

Standard frame: main axis z, a 2-fold axis of D_n along x; T, O and I have their 2-fold (T, I) or 4-fold (O) axes along
x, y and z and a 3-fold axis along (1, 1, 1); I has a 5-fold axis along (0, 1, (1 + sqrt 5) / 2).
"""

from __future__ import annotations

import difflib
import math
import re
from typing import Literal, NamedTuple

import numpy as np

from synthetless.errors import UserError
from synthetless.symmetry.quaternions import (
    IDENTITY,
    Floats,
    from_axis_angle,
    from_matrix,
    minimal,
    multiply,
    normalise,
)

Family = Literal["C", "D", "T", "O", "I", "SO(2)", "O(2)", "SO(3)"]

MAX_ORDER = 120
X, Y, Z = np.eye(3)
FIVE_FOLD_AXIS: Floats = np.array([0.0, 1.0, (1 + np.sqrt(5)) / 2]) / np.sqrt((5 + np.sqrt(5)) / 2)
THREE_FOLD_AXIS: Floats = np.ones(3) / np.sqrt(3)


class GroupName(NamedTuple):
    """A parsed name: the family and, for C_n and D_n, the order n of the main axis (0 for the others)."""

    family: Family
    n: int

    @property
    def text(self) -> str:
        """The name as it is written."""
        return f"{self.family}{self.n}" if self.n else self.family

    @property
    def order(self) -> float:
        """The number of elements, `math.inf` of a continuous group."""
        return {"C": self.n, "D": 2 * self.n, "T": 12, "O": 24, "I": 60}.get(self.family, math.inf)


def parse_name(name: object) -> GroupName:
    """The family and order of `C1`, `C2` ..., `D2` ..., `T`, `O`, `I`, `SO(2)`, `O(2)`, `SO(3)`.

    Raises:
        UserError: any other name, an order of 0, or more than 120 elements.
    """
    text = str(name)
    match text:
        case "T" | "O" | "I" | "SO(2)" | "O(2)" | "SO(3)":
            return GroupName(text, 0)
    matched = re.fullmatch(r"([CD])(\d{1,6})", text)
    if matched is None:
        raise UserError(f"unknown symmetry group {text!r}: did you mean {_nearest_name(text)!r}?")
    n = int(matched[2])
    if n == 0:
        raise UserError(f"symmetry group {text!r} has order 0: the smallest group is 'C1', no symmetry")
    if matched[1] == "C":
        if n > MAX_ORDER:
            raise UserError(f"symmetry group {text!r} has {n} elements, at most {MAX_ORDER} are allowed: use 'SO(2)'")
        return GroupName("C", n)
    if n == 1:
        raise UserError("symmetry group 'D1' is 'C2' about its 2-fold axis: write 'C2' with that axis")
    if 2 * n > MAX_ORDER:
        raise UserError(f"symmetry group {text!r} has {2 * n} elements, at most {MAX_ORDER} are allowed: use 'O(2)'")
    return GroupName("D", n)


def _nearest_name(text: str) -> str:
    plain = re.sub(r"[\s_\-]", "", text).upper()
    synonyms = {"": "C1", "NONE": "C1", "TRIVIAL": "C1", "SO2": "SO(2)", "O2": "O(2)", "SO3": "SO(3)"}
    synonyms |= {"CYLINDER": "SO(2)", "SPHERE": "SO(3)", "CUBE": "O", "BOX": "D2"}
    if plain in synonyms:
        return synonyms[plain]
    known = ["T", "O", "I", "SO(2)", "O(2)", "SO(3)"]
    known += [f"C{n}" for n in range(1, MAX_ORDER + 1)] + [f"D{n}" for n in range(2, MAX_ORDER // 2 + 1)]
    return next(iter(difflib.get_close_matches(plain, known, n=1, cutoff=0.3)), "C1")


def standard_elements(name: GroupName) -> Floats:
    """All elements (order, 4) of a finite group in its standard frame, wxyz, the identity first.

    For SO(2) and O(2): the discrete part, {1} or {1, half turn about x}; for SO(3): {1}.
    """
    with_flip: Floats = np.stack([np.array(IDENTITY), from_axis_angle(X, np.pi)])
    match name.family:
        case "C":
            return _rotations(Z, name.n)
        case "D":
            return _products(_rotations(Z, name.n), with_flip)
        case "T" | "O" | "I" as family:
            quotient: dict[Family, Floats] = {"O": _rotations(Z, 4)[:2], "I": _rotations(FIVE_FOLD_AXIS, 5)}
            return _products(_tetrahedral(), quotient.get(family, np.array([IDENTITY])))
        case "O(2)":
            return with_flip
    return np.array([IDENTITY])


def _rotations(axis: Floats, n: int) -> Floats:
    return from_axis_angle(axis, 2 * np.pi * np.arange(n) / n)


def _products(left: Floats, right: Floats) -> Floats:
    return np.asarray(multiply(left[None, :], right[:, None]).reshape(-1, 4))


def _tetrahedral() -> Floats:
    signs = np.array([[1, x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)])
    return np.concatenate([np.eye(4), signs / 2])


def signed_axis(axis: Floats) -> Floats:
    """The axis or its opposite: the one whose last component that is not nearly zero is positive.

    Both describe the same group; one sign makes the labels independent of how somebody wrote it.
    """
    last = next((value for value in axis[::-1] if abs(value) > 1e-3), 1.0)
    return axis if last > 0 else -axis


def frame_of_axis(axis: Floats) -> Floats:
    """The smallest rotation (wxyz) that takes z to the axis, after its sign is settled."""
    return minimal(Z, signed_axis(axis))


def frame_of_axes(axis: Floats, secondary_axis: Floats) -> Floats:
    """The rotation (wxyz) that takes z to `axis` and x to the part of `secondary_axis` perpendicular to it."""
    x = normalise(secondary_axis - (secondary_axis @ axis) * axis)
    return np.asarray(from_matrix(np.stack([x, np.cross(axis, x), axis], axis=1)[None])[0])
