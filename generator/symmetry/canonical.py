"""Unambiguous, learnable labels: one canonical pose per appearance, one regressor per region of poses.

    from synthetless.symmetry import CanonicalMap, SymmetryGroup

    canonical = CanonicalMap(SymmetryGroup.from_name("C2", axis=(0, 0, 1), offset_mm=(-7, 0, 0)))
    labels = canonical(R_m2c, t_m2c)

Poses are BOP's: `x_cam = R_m2c x_model + t_m2c`, millimetres, OpenCV camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.errors import UserError
from synthetless.symmetry import atlas
from synthetless.symmetry.atlas import SCHEMES, Scheme
from synthetless.symmetry.charts import AxialCharts, Charts, FiniteCharts, Rule, SphereCharts
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import Z, parse_name
from synthetless.symmetry.quaternions import (
    Floats,
    conjugate,
    from_matrix,
    minimal,
    multiply,
    normalise,
    rotate,
    to_matrix,
)

FEWEST_DECIMALS, FULL_DECIMALS = 4, 15
"""Rotations with fewer decimals count as ones with 4, those in double precision as ones with 15."""

_BLOCK = 4096  # poses labelled together: the intermediate arrays stay in the cache


@dataclass(frozen=True)
class CanonicalPoses:
    """Labels of N poses of one object.

    Attributes:
        R_m2c: canonical rotations (N, 3, 3): the pose R_m2c, t_m2c looks the same as the true one.
        t_m2c: canonical translations (N, 3), mm.
        regressor_index: which regressor learns the pose, (N,), 0 to n_regressors - 1.
        n_regressors: how many regressors the object has.
        discontinuity_margin_deg: by how much the pose may turn before its label jumps while its regressor stays the
            same, (N,) degrees; 180 where it never does. Two poses of one regressor whose appearances differ by less
            than the sum of their margins have labels that differ by exactly as much (finite groups).
    """

    R_m2c: Floats
    t_m2c: Floats
    regressor_index: NDArray[np.int64]
    n_regressors: int
    discontinuity_margin_deg: Floats


@dataclass(frozen=True, eq=False)
class CanonicalMap:
    """Assigns canonical poses and regressors to the poses of one object.

    Attributes:
        group: the object's symmetries.
        scheme: `pitteri2019`, the paper's Map and Map', or `atlas`, continuous everywhere.
        reference_rotation: the rotation (3, 3) that the first regressor is centred on; the identity if None.
        allocentric: whether rotations are judged relative to the ray from the camera to the object's fixed point, as
            they appear in a crop around the object, instead of relative to the camera's axes. The canonical pose
            remains a pose in the camera frame.
        decimals: with how many decimals the rotations are stored, from 4 to 15; ties are decided above that noise, so
            that poses which look alike get the same label although they were rounded independently.

    Raises:
        UserError: an unknown scheme, a reference that is not a rotation, another number of decimals.
    """

    group: SymmetryGroup
    scheme: Scheme = "pitteri2019"
    reference_rotation: ArrayLike | None = None
    allocentric: bool = False
    decimals: int = FULL_DECIMALS

    def __post_init__(self) -> None:
        check_decimals(self.decimals)
        if self.scheme not in SCHEMES:
            raise UserError(f"unknown scheme {self.scheme!r}: use one of {', '.join(SCHEMES)}")
        _ = self._reference_wxyz

    @cached_property
    def anchors_wxyz(self) -> Floats:
        """The centres of the regressors' charts, as unit quaternions (n_regressors, 4) in the role of `R_m2c`."""
        return self.placed_wxyz(atlas.anchors(parse_name(self.group.name), self.scheme))

    def placed_wxyz(self, standard_wxyz: Floats) -> Floats:
        """Anchors (N, 4) of the group's standard frame where this map has them."""
        frame = self.group.frame_wxyz
        return multiply(self._reference_wxyz, multiply(multiply(frame, standard_wxyz), conjugate(frame)))

    @property
    def n_regressors(self) -> int:
        """How many regressors the object has under the scheme."""
        return len(self.anchors_wxyz)

    @property
    def smallest_margin_deg(self) -> float:
        """The smallest margin of any pose, degrees: 0 if the scheme tears look-alikes apart, 180 if nothing jumps."""
        return atlas.smallest_margin_deg(parse_name(self.group.name), self.scheme)

    @property
    def separation_deg(self) -> float:
        """Twice the smallest margin, at most 180: poses of one regressor that look nearer have labels as near."""
        return min(2 * self.smallest_margin_deg, atlas.NO_JUMP_DEG)

    def __call__(self, R_m2c: ArrayLike, t_m2c: ArrayLike) -> CanonicalPoses:
        """The labels of poses `R_m2c` (N, 3, 3), `t_m2c` (N, 3) mm.

        Rotations that are slightly off, by rounding in a file, are repaired.

        Raises:
            UserError: wrong shapes, numbers that are not finite, matrices that are no rotations.
        """
        R, t = _poses(R_m2c, t_m2c)
        n = len(R)
        R_c, t_c = np.empty((n, 3, 3)), np.empty((n, 3))
        index, margin = np.empty(n, np.int64), np.empty(n)
        for block in _blocks(n):
            q = from_matrix(R[block], name=_pose_name(block.start))
            R_c[block], t_c[block], index[block], margin[block] = self._label(q, self._centres(R[block], t[block]))
        return CanonicalPoses(R_c, t_c, index, self.n_regressors, margin)

    def regressor_index(self, R_m2c: ArrayLike, t_m2c: ArrayLike) -> NDArray[np.int64]:
        """Whose domain poses (N, 3, 3), (N, 3) lie in: the regressor (N,) that learns, or should predict, each."""
        return self(R_m2c, t_m2c).regressor_index

    def equivalent_poses(self, R_m2c: ArrayLike, t_m2c: ArrayLike, samples: int = 72) -> tuple[Floats, Floats]:
        """All poses that look like the given (predicted, canonical or any other) ones.

        Args:
            R_m2c: rotations (N, 3, 3).
            t_m2c: translations (N, 3), mm.
            samples: how many stand for each continuous part of the group. The farthest rotation of SO(2) and O(2)
                is then 180 / samples degrees from one of them, that of SO(3) at most 240 / samples^(1/3): 56 degrees
                for 72 samples, 22 for 1000.

        Returns:
            Rotations (N, M, 3, 3) and translations (N, M, 3), mm; the given pose is the first of each M.
        """
        R, t = _poses(R_m2c, t_m2c)
        motions = self.group.motions(samples)
        rotations = R[:, None] @ motions[None, :, :3, :3]
        return rotations, t[:, None] + np.einsum("nij,mj->nmi", R, motions[:, :3, 3])

    def to_allocentric(self, R_m2c: ArrayLike, t_m2c: ArrayLike) -> Floats:
        """Rotations (N, 3, 3) relative to the ray to the object: what a crop shows, wherever in the image it lies.

        The camera is turned by the smallest rotation that takes its axis to the ray to the object's fixed point.
        """
        R, t = _poses(R_m2c, t_m2c)
        return to_matrix(multiply(conjugate(_rays_wxyz(self._centres(R, t))), from_matrix(R)))

    @cached_property
    def _reference_wxyz(self) -> Floats:
        if self.reference_rotation is None:
            return np.array([1.0, 0.0, 0.0, 0.0])
        matrix = np.asarray(self.reference_rotation, dtype=np.float64)
        if matrix.shape != (3, 3):
            raise UserError(f"reference_rotation has shape {matrix.shape}, not (3, 3)")
        return np.asarray(from_matrix(matrix[None], name=lambda _: "reference_rotation")[0])

    @cached_property
    def _charts(self) -> Charts:
        noise = 10.0**-self.decimals
        epsilon = max(1e-6, 100 * noise)
        group = self.group
        if group.family == "SO(3)":
            return SphereCharts(self._reference_wxyz)
        axis = rotate(group.frame_wxyz, Z)
        if not group.is_finite:
            return AxialCharts(axis, self.anchors_wxyz, group.family == "O(2)", epsilon)
        rule: Rule = "nearest"
        if self.scheme == "atlas":
            rule = "hemisphere" if group.family == "C" else "margin"
        return FiniteCharts(group.elements_wxyz, self.anchors_wxyz, rule, axis, epsilon, 2 * noise)

    def _label(self, q: Floats, centres: Floats) -> tuple[Floats, Floats, NDArray[np.int64], Floats]:
        if self.allocentric:
            ray = _rays_wxyz(centres)
            seen = self._charts.label(multiply(conjugate(ray), q))
            labels = seen._replace(rotation_wxyz=multiply(ray, seen.rotation_wxyz))
        else:
            labels = self._charts.label(q)
        R_c = to_matrix(labels.rotation_wxyz)
        return R_c, centres - self._centres(R_c, np.zeros(3)), labels.chart, labels.margin_deg

    def _centres(self, R: Floats, t: Floats) -> Floats:
        """Where poses (N, 3, 3), (N, 3) have the group's fixed point, (N, 3) mm: the same for all that look alike."""
        return np.asarray(t + (R.reshape(-1, 3) @ np.array(self.group.offset_mm)).reshape(-1, 3))


def stored_decimals(R_m2c: ArrayLike) -> int | None:
    """With how many decimals rotations (N, 3, 3) that were read from a file were written, `FEWEST_DECIMALS` at least.

    That is the fewest that give every number back. None if all numbers are whole: those tell nothing.
    """
    numbers = np.ravel(np.asarray(R_m2c, dtype=np.float64))
    numbers = numbers[numbers != np.rint(numbers)]
    if not len(numbers):
        return None
    for decimals in range(FEWEST_DECIMALS, FULL_DECIMALS):
        if (np.rint(numbers * 10.0**decimals) / 10.0**decimals == numbers).all():
            return decimals
    return FULL_DECIMALS


def check_decimals(decimals: Any) -> None:
    """Refuse what is not a number of decimals.

    Raises:
        UserError: with the value.
    """
    is_whole = isinstance(decimals, int) and not isinstance(decimals, bool)
    if not is_whole or not FEWEST_DECIMALS <= decimals <= FULL_DECIMALS:
        raise UserError(f"decimals is {decimals!r}, not a whole number from {FEWEST_DECIMALS} to {FULL_DECIMALS}")


def _rays_wxyz(points_mm: Floats) -> Floats:
    """Smallest rotations (N, 4) from the camera's axis to the rays to points (N, 3)."""
    behind = ~(points_mm[:, 2] > 0)
    if behind.any():
        i = int(np.argmax(behind))
        raise UserError(
            f"pose {i}: the object, at {points_mm[i].tolist()} mm, is not in front of the camera: no ray to it"
        )
    return minimal(Z, normalise(points_mm))


def _poses(R_m2c: ArrayLike, t_m2c: ArrayLike) -> tuple[Floats, Floats]:
    R, t = np.asarray(R_m2c, dtype=np.float64), np.asarray(t_m2c, dtype=np.float64)
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (len(R), 3):
        raise UserError(f"poses have shapes {R.shape} and {t.shape}, not (N, 3, 3) and (N, 3)")
    bad = ~np.isfinite(t).all(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        raise UserError(f"pose {i}: t_m2c {t[i].tolist()} has a number that is not finite")
    return R, t


def _pose_name(first: int) -> Callable[[int], str]:
    return lambda i: f"pose {first + i}: R_m2c"


def _blocks(n: int) -> Iterator[slice]:
    return (slice(start, min(start + _BLOCK, n)) for start in range(0, n, _BLOCK))
