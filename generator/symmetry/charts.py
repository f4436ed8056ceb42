"""Charts: canonical rotation, chart number and margin of many rotations at once.

A chart around an anchor A_i assigns to R the member of R G nearest to A_i. Its label jumps where two members are
equally near, which is at the faces of the Dirichlet cell of G around A_i; the margin is the rotation angle to the
nearest face.

Structured poses (an upright part seen from the side) lie exactly on such faces, where rounding would choose,
differently for poses that look the same. All distances are therefore measured as if the reference were turned by a
generic rotation of about `tie_epsilon`. It is the same for all anchors, so the whole atlas, margins included, is
merely seen in a camera frame that is turned by as much.

By chance two charts may be equally wide there, too. Of charts whose clearances differ by less than `noise`, which is
what the rounding of the poses explains, the first is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from synthetless.symmetry.atlas import NO_JUMP_DEG
from synthetless.symmetry.quaternions import Floats, conjugate, minimal, multiply, normalise, rotate

Rule = Literal["nearest", "hemisphere", "margin"]
Indices = NDArray[np.int64]

_GENERIC = normalise([0.8251, 0.2917, -0.4233, 0.2374])


class Labels(NamedTuple):
    """Canonical rotations (N, 4), chart numbers (N,) and margins in degrees (N,)."""

    rotation_wxyz: Floats
    chart: Indices
    margin_deg: Floats


class Charts(Protocol):
    """What assigns a label to each rotation (N, 4)."""

    def label(self, q: Floats) -> Labels:
        """The labels of unit quaternions (N, 4)."""
        ...


def tie_breaker(tie_epsilon: float) -> Floats:
    """The generic rotation (4,) that decides ties: the identity moved by `tie_epsilon`."""
    return normalise(np.array([1.0, 0.0, 0.0, 0.0]) + tie_epsilon * _GENERIC)


class SphereCharts:
    """SO(3): every rotation has the reference as its label."""

    def __init__(self, reference_wxyz: Floats) -> None:
        self._reference = reference_wxyz

    def label(self, q: Floats) -> Labels:
        """The reference, chart 0, no jump."""
        n = len(q)
        return Labels(np.tile(self._reference, (n, 1)), np.zeros(n, np.int64), np.full(n, NO_JUMP_DEG))


class AxialCharts:
    """SO(2) and O(2): the label depends on v = R u only, the direction in which the axis points.

    Chart i labels v with the smallest rotation that takes its anchor's axis A_i u to v, times A_i; for O(2), whose
    axis has no sign, to v or -v, whichever is nearer. With one chart SO(2) jumps at the flip v = -A_0 u.
    """

    def __init__(self, axis: Floats, anchors_wxyz: Floats, both_ways: bool, tie_epsilon: float) -> None:
        self._axis = axis
        self._anchors = anchors_wxyz
        self._references = rotate(anchors_wxyz, axis)
        self._deciding = rotate(tie_breaker(tie_epsilon), self._references)
        self._both_ways = both_ways
        self._epsilon = tie_epsilon

    def label(self, q: Floats) -> Labels:
        """The labels of unit quaternions (N, 4)."""
        v = rotate(q, self._axis)
        cosines = v @ self._deciding.T
        index = np.argmax(np.abs(cosines) if self._both_ways else cosines, axis=1)
        if self._both_ways:
            v = np.where(cosines[np.arange(len(q)), index] < 0, -1.0, 1.0)[:, None] * v
        canonical = multiply(self._smallest_rotations(self._references[index], v), self._anchors[index])
        apart, together = (np.linalg.norm(v + sign * self._deciding[index], axis=1) for sign in (-1, 1))
        to_flip_deg = np.degrees(2 * np.arctan2(together, apart))
        return Labels(canonical, index, np.maximum(to_flip_deg - (90 if self._both_ways else 0), 0))

    def _smallest_rotations(self, u: Floats, v: Floats) -> Floats:
        """Smallest rotations (N, 4) from u to v; within `tie_epsilon` of v = -u by way of a fixed half turn."""
        flipped = np.linalg.norm(u + v, axis=1) < self._epsilon
        rotations = minimal(np.where(flipped[:, None], v, u), v)
        if flipped.any():
            u, v = u[flipped], v[flipped]
            across = np.eye(3)[np.argmin(np.abs(u), axis=1)]
            across = normalise(across - np.sum(across * u, axis=1, keepdims=True) * u)
            half_turn = np.concatenate([np.zeros((len(u), 1)), across], axis=1)
            rotations[flipped] = multiply(minimal(-u, v), half_turn)
        return rotations


@dataclass(frozen=True)
class FiniteCharts:
    """A finite group's charts.

    Attributes:
        elements_wxyz: the group (n, 4), the identity first.
        anchors_wxyz: the charts' centres (K, 4).
        rule: how the chart is chosen. `nearest`: the one whose anchor is nearest. `margin`: the one with the largest
            margin, which therefore never jumps. `hemisphere`: the nearest of the first half of the anchors while the
            axis is tilted from the reference by at most 90 degrees, else of the second half; the margin steps there.
        axis: the main axis, for the rule `hemisphere`.
        tie_epsilon, noise: see the module.
    """

    elements_wxyz: Floats
    anchors_wxyz: Floats
    rule: Rule
    axis: Floats
    tie_epsilon: float
    noise: float

    @cached_property
    def _deciding(self) -> Floats:
        """The anchors (K, 4) that distances are measured to."""
        return multiply(tie_breaker(self.tie_epsilon), self.anchors_wxyz)

    @cached_property
    def _targets(self) -> Floats:
        """(4, K n): as <q s, a> = <q, a s^-1>, one matrix product compares all members of R G with all anchors."""
        targets = multiply(self._deciding[:, None], conjugate(self.elements_wxyz)[None])
        return np.ascontiguousarray(targets.reshape(-1, 4).T)

    @cached_property
    def _faces(self) -> Floats:
        """(F, 4): normals (1 - s) / |1 - s| of the Dirichlet cell around 1, s in the binary group.

        Only those s whose midpoint with 1 has no other member as near are neighbours; the rest cut nothing off.
        """
        others = np.concatenate([self.elements_wxyz[1:], -self.elements_wxyz[1:]])
        one = np.array([1.0, 0.0, 0.0, 0.0])
        nearness = normalise(one + others) @ others.T
        is_neighbour = (nearness > nearness.diagonal()[:, None] - 1e-9).sum(axis=1) == 1
        return normalise(one - others[is_neighbour])

    def label(self, q: Floats) -> Labels:
        """The labels of unit quaternions (N, 4)."""
        closeness = q @ self._targets  # (N, K n)
        np.abs(closeness, out=closeness)
        n = len(self.elements_wxyz)
        if self.rule == "margin":
            return self._widest(q, closeness.reshape(len(q), -1, n))
        if self.rule == "hemisphere":
            half = closeness.shape[1] // 2
            upper = rotate(q, self.axis) @ rotate(self._deciding[0], self.axis) >= 0
            closeness[upper, half:] = -1
            closeness[~upper, :half] = -1
        index, element = np.divmod(np.argmax(closeness, axis=1), n)
        canonical = multiply(q, self.elements_wxyz[element])
        return Labels(canonical, index, self._margin_deg(self._clearance(canonical, self._deciding[index])))

    def _widest(self, q: Floats, closeness: Floats) -> Labels:
        """The chart with the largest margin."""
        elements = np.argmax(closeness, axis=2)
        clearances = np.stack(
            [
                self._clearance(multiply(q, self.elements_wxyz[elements[:, i]]), anchor)
                for i, anchor in enumerate(self._deciding)
            ],
            axis=1,
        )
        rows = np.arange(len(q))
        index = np.argmax(clearances >= clearances.max(axis=1, keepdims=True) - self.noise, axis=1)
        canonical = multiply(q, self.elements_wxyz[elements[rows, index]])
        return Labels(canonical, index, self._margin_deg(clearances[rows, index]))

    def _clearance(self, canonical: Floats, anchor: Floats) -> Floats:
        """Sine of half the rotation angle (N,) from canonical rotations in a chart to the cell's nearest face."""
        local = multiply(conjugate(anchor), canonical)
        local *= np.where(local[:, :1] < 0, -1.0, 1.0)
        return np.asarray((self._faces @ local.T).min(axis=0, initial=1.0))

    @staticmethod
    def _margin_deg(clearance: Floats) -> Floats:
        return np.asarray(np.degrees(2 * np.arcsin(np.clip(clearance, 0, 1))))
