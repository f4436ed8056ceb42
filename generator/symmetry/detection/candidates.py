"""Where a mesh could have symmetries: axes, orders and frames worth a closer look.

Every symmetry keeps the centre of the surface's area. The axes are the local minima, over directions, of how far the
surface's points are from it after a turn, read from a coarse distance field; the principal axes join them. Every axis
is fitted to the mesh, then its orders and the frames of the groups that contain it are ranked in the same way; on
nearly a solid of revolution by exact distances of its details, which alone tell the orders apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from synthetless.symmetry.detection.distance import DistanceField, Surface
from synthetless.symmetry.detection.refine import placed, refined
from synthetless.symmetry.detection.residual import some_elements
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.point_groups import THREE_FOLD_AXIS, X, Y, Z, frame_of_axis
from synthetless.symmetry.quaternions import Floats, conjugate, from_axis_angle, multiply, to_matrix

MAX_FOLD = 60
"""The largest order of an axis that is told from a continuous one."""

_DIRECTIONS = 2500
_PRIMES = (2, 3, 5, 7)
_AXES_PER_PRIME = 4
_FAR_AXES, _UNLIKELY_AXES = 3, 2
_AXIS_STEPS = 8
_POINTS, _MANY_POINTS = 256, 1500
_ELEMENTS = 6
_DETAILS = 50
_ORDERS, _OTHER_ORDERS = 5, 2
_SCAN_ELEMENTS = 4
_SCAN_STEP = np.radians(1.5)
_SAME_AXIS = float(np.cos(np.radians(4)))
_SAME_PEAK = float(np.cos(np.radians(12)))
_NEAR = 0.015  # mean deviation in the field, as a share of the diameter, that fitting may still bring near zero
_ROUND = 0.01  # mean deviation of a solid of revolution with details that the field cannot resolve, likewise
_FIELD_TOLERANCE = 0.035  # how far the field's largest deviation may be off before the group is fitted, likewise

Deviations = Callable[[Floats], Floats]
"""From turns (..., 3, 3) to how far they move some points of a mesh off it, (..., N) mm."""


@dataclass(frozen=True)
class Candidate:
    """A group and how far the distance field says the mesh is from it.

    Attributes:
        group: roughly in its place.
        misfit_mm: the mean deviation.
        is_likely: whether fitting it may bring the largest deviation within the tolerance.
    """

    group: SymmetryGroup
    misfit_mm: float
    is_likely: bool


class CandidateSearch:
    """Finds the groups that a mesh could have."""

    def __init__(
        self,
        surface: Surface,
        diameter_mm: float,
        tolerance_mm: float,
        dense: Floats,
        has_time: Callable[[], bool] = lambda: True,
    ) -> None:
        """Take the mesh, what deviation is tolerated, densely spread surface points (N, 3), and what says whether to go
        on."""
        self._surface, self._diameter, self._tolerance = surface, diameter_mm, tolerance_mm
        self._field = DistanceField(surface.centroid, dense)
        self._points, self._many_points = surface.sampled(_POINTS), surface.sampled(_MANY_POINTS)
        self._near = max(_NEAR * diameter_mm, 1.5 * tolerance_mm)
        self._has_time = has_time

    def candidates(self) -> list[Candidate]:
        """Groups that differ, by rising misfit; where time runs out, those that were found until then."""
        found = [self._candidate(SymmetryGroup("SO(3)", offset_mm=tuple(self._surface.centroid)))]
        for axis in self._axes():
            for group in self._about(axis) if self._has_time() else ():
                found.append(self._candidate(group))
                if not self._has_time():
                    break
        found.sort(key=lambda candidate: candidate.misfit_mm)
        distinct: list[Candidate] = []
        for candidate in found:
            if not any(same(candidate.group, other.group) for other in distinct):
                distinct.append(candidate)
        return distinct

    def _candidate(self, group: SymmetryGroup) -> Candidate:
        misfit = float(self._coarse(_offset(group))(to_matrix(some_elements(group, _ELEMENTS))).mean())
        if misfit > self._near:
            return Candidate(group, misfit, is_likely=False)
        images = _images(to_matrix(some_elements(group, 2 * _ELEMENTS)), self._many_points, _offset(group))
        return Candidate(
            group, misfit, float(self._field(images).max()) < self._tolerance + _FIELD_TOLERANCE * self._diameter
        )

    def _axes(self) -> list[SymmetryGroup]:
        """The likeliest axes as fitted groups C_p, p the prime that showed them."""
        peaks = [peak for p in _PRIMES if self._has_time() for peak in self._peaks(p)]
        peaks.sort(key=lambda peak: peak[0])
        chosen: list[SymmetryGroup] = []
        unlikely = dict.fromkeys(_PRIMES, 0)
        for misfit, p, direction in peaks:
            enough = misfit > self._near and len(chosen) >= _FAR_AXES
            if enough or unlikely[p] == _UNLIKELY_AXES or _is_among(direction, chosen) or not self._has_time():
                continue
            axis = placed(f"C{p}", frame_of_axis(direction), self._surface.centroid)
            axis = refined(axis, self._surface, self._points, self._diameter, _AXIS_STEPS)
            if not _is_among(np.array(axis.axis), chosen):
                chosen.append(axis)
                unlikely[p] += not self._candidate(axis).is_likely
        return chosen

    def _peaks(self, p: int) -> list[tuple[float, int, Floats]]:
        """Directions where a turn by 2 pi / p moves the points least off the surface: (misfit, p, direction)."""
        directions = np.concatenate([self._principal_axes(), _hemisphere(_DIRECTIONS)])
        turns = to_matrix(from_axis_angle(directions, np.full(len(directions), 2 * np.pi / p)))
        misfits = self._coarse(self._surface.centroid)(turns).mean(axis=-1)
        peaks: list[tuple[float, int, Floats]] = []
        for i in np.argsort(misfits):
            if len(peaks) == _AXES_PER_PRIME:
                break
            if all(abs(directions[i] @ known) < _SAME_PEAK for _, _, known in peaks):
                peaks.append((float(misfits[i]), p, directions[i]))
        return peaks

    def _principal_axes(self) -> Floats:
        local = self._many_points - self._surface.centroid
        _, vectors = np.linalg.eigh(local.T @ local)
        return np.asarray(vectors.T)

    def _about(self, axis: SymmetryGroup) -> Iterator[SymmetryGroup]:
        """The groups that have the axis as their main axis (T, O and I: as a 3-fold axis)."""
        u, frame = np.array(axis.axis), axis.frame_wxyz
        fixed = _offset(axis) + u * float((self._surface.centroid - _offset(axis)) @ u)
        deviations = self._coarse(fixed)
        if self._candidate(placed("SO(2)", frame, fixed)).misfit_mm < _ROUND * self._diameter:
            deviations = self._of_details(u, fixed)
            worst = _worst_of_orders(u, lambda turns: deviations(turns).max(axis=-1))
            likely = [n for n in worst if worst[n] < 1.5 * self._tolerance]
            across = multiply(frame, from_axis_angle(Y, np.pi / 2))
            yield _best_turned("C2", X, across, fixed, np.pi, deviations)
        else:
            worst = _worst_of_orders(u, lambda turns: deviations(turns).mean(axis=-1))
            near = [n for n in worst if worst[n] < self._near]
            likely = [n for n in near if self._candidate(placed(f"C{n}", frame, fixed)).is_likely]
        orders = _chosen_orders(worst, likely)
        for n in orders:
            yield placed(f"C{n}", frame, fixed)
            yield _best_turned(f"D{n}", Z, frame, fixed, 2 * np.pi / n, deviations)
        yield placed("SO(2)", frame, fixed)
        yield placed("O(2)", frame, fixed)
        if 3 in orders:
            tilted = multiply(frame, conjugate(frame_of_axis(THREE_FOLD_AXIS)))
            for name in ("T", "O", "I"):
                yield _best_turned(name, THREE_FOLD_AXIS, tilted, fixed, 2 * np.pi / 3, self._coarse(fixed))

    def _coarse(self, fixed: Floats) -> Deviations:
        """Deviations in the field, of points from all over, after turns about a fixed point (3,)."""
        return lambda turns: self._field(_images(turns, self._points, fixed)).astype(np.float64)

    def _of_details(self, axis: Floats, fixed: Floats) -> Deviations:
        """Exact deviations of those points that turns about the axis move off the surface most."""

        def exact(turns: Floats, points: Floats) -> Floats:
            images = _images(turns, points, fixed)
            return self._surface.distance(images.reshape(-1, 3)).reshape(images.shape[:-1])

        some_turns = to_matrix(from_axis_angle(axis, np.array([0.9, 2.1, 3.3, 4.2, 5.6])))
        mean = exact(some_turns, self._many_points).mean(axis=0)
        details = self._many_points[np.argsort(mean)[-_DETAILS:]]
        return lambda turns: exact(turns, details)


def same(a: SymmetryGroup, b: SymmetryGroup) -> bool:
    """Whether two groups of one name have the same axes, up to what fitting may still change."""
    if a.name != b.name:
        return False
    if a.axis is None or b.axis is None:
        return True
    directions = np.array([[1, 0.2, 0.1], [0.1, 1, 0.2], [0.2, 0.1, 1]])
    images_a, images_b = (np.einsum("mij,kj->mki", to_matrix(g.sampled_wxyz(12)), directions) for g in (a, b))
    apart = np.linalg.norm(images_a[:, None] - images_b[None], axis=-1).max(axis=-1)
    return bool(apart.min(axis=1).max() < 0.15)


def _worst_of_orders(axis: Floats, misfits: Callable[[Floats], Floats]) -> dict[int, float]:
    """For each order n the worst misfit, mm, among the turns by 2 pi k / n."""
    orders = np.arange(2, MAX_FOLD + 1)
    shares = [np.arange(1, n // 2 + 1) / n for n in orders]  # a turn and its inverse are as good as each other
    distinct, index = np.unique(np.round(np.concatenate(shares), 9), return_inverse=True)
    found = misfits(to_matrix(from_axis_angle(axis, 2 * np.pi * distinct)))[index]
    starts = np.cumsum([0, *(len(share) for share in shares[:-1])])
    return dict(zip(orders.tolist(), np.maximum.reduceat(found, starts).tolist(), strict=True))


def _chosen_orders(worst: dict[int, float], likely: list[int]) -> list[int]:
    """Likely orders, rather multiples than their divisors, and the best of the others."""
    ranked = sorted(worst, key=lambda n: worst[n])
    divides = {n: any(m > n and m % n == 0 for m in likely) for n in likely}
    chosen = sorted((n for n in ranked if n in likely), key=lambda n: divides[n])  # stable: by misfit among equals
    others = [n for n in ranked if n not in likely]
    return sorted({*chosen[:_ORDERS], *others[:_OTHER_ORDERS]})


def _best_turned(
    name: str, about: Floats, frame: Floats, fixed: Floats, period: float, deviations: Deviations
) -> SymmetryGroup:
    """The group in a frame, turned about `about` (in the standard frame) so that it fits best."""
    frames = multiply(frame, from_axis_angle(about, np.arange(0, period, _SCAN_STEP)))
    elements = SymmetryGroup.from_name(name).elements_wxyz[1:]
    elements = elements[np.linalg.norm(np.cross(elements[:, 1:], about), axis=1) > 0.1]  # the others stay the same
    elements = elements[:: -(-len(elements) // _SCAN_ELEMENTS)]
    turns = multiply(multiply(frames[:, None], elements), conjugate(frames)[:, None])
    return placed(name, frames[np.argmin(deviations(to_matrix(turns)).mean(axis=(1, 2)))], fixed)


def _images(turns: Floats, points: Floats, fixed: Floats) -> Floats:
    """Points (N, 3) after turns (..., 3, 3) about a fixed point: (..., N, 3)."""
    turned = turns.reshape(-1, 3) @ (points - fixed).T  # much faster than one product a turn
    return np.asarray(turned.reshape(*turns.shape[:-1], len(points)).swapaxes(-1, -2) + fixed)


def _offset(group: SymmetryGroup) -> Floats:
    return np.array(group.offset_mm)


def _is_among(direction: Floats, axes: Iterable[SymmetryGroup]) -> bool:
    return any(abs(float(direction @ np.array(group.axis))) > _SAME_AXIS for group in axes)


def _hemisphere(n: int) -> Floats:
    """n directions (n, 3) spread evenly over the half z > 0 of the sphere."""
    i = np.arange(n) + 0.5
    z, angle = i / n, np.pi * (1 + np.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
