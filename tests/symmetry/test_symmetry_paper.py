"""The paper's Map and Map' written down once more, loops and all, and nothing shared with the code.

Its rotations are Q = R_m2c transposed: a symmetry S of the object acts on the left, S^-1 Q (sections 3.2 and 3.3).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from symmetry_cases import random_rotations

from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.atlas import former_anchors
from synthetless.symmetry.charts import FiniteCharts
from synthetless.symmetry.point_groups import Z, parse_name
from synthetless.symmetry.quaternions import from_matrix

Matrix = NDArray[np.float64]
N_POSES = 300


def turn(axis: str, angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    if axis == "z":
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def distance(a: Matrix, b: Matrix) -> float:
    return math.sqrt(sum((a[i, j] - b[i, j]) ** 2 for i in range(3) for j in range(3)))


def generated(*generators: Matrix) -> list[Matrix]:
    elements = [np.eye(3)]
    for element in elements:
        for generator in generators:
            product = generator @ element
            if all(distance(product, other) > 1e-6 for other in elements):
                elements.append(product)
    return elements


def nearest_in(symmetries: list[Matrix], Q: Matrix, target: Matrix) -> Matrix:
    """S^-1 Q with S = argmin ||S^-1 Q - target||."""
    return min((S.T @ Q for S in symmetries), key=lambda moved: distance(moved, target))


def one_axis_index(order: int, Q: Matrix) -> int:
    """delta - 1: 0 if Map over the group of half steps takes Q into the class of the identity."""
    step = math.pi / order
    S_hat = min(range(2 * order), key=lambda k: distance(turn("z", k * step).T @ Q, np.eye(3)))
    return S_hat % 2


def two_axes_index(symmetries: list[Matrix], half_u: Matrix, half_v: Matrix, Q: Matrix) -> int:
    """2 (delta_1 - 1) + (delta_2 - 1): whose class M u^((delta_1 - 1) / 2) v^((delta_2 - 1) / 2) has the nearest."""
    best, index = math.inf, -1
    for delta_1 in (1, 2):
        for delta_2 in (1, 2):
            region = np.linalg.matrix_power(half_u, delta_1 - 1) @ np.linalg.matrix_power(half_v, delta_2 - 1)
            for S in symmetries:
                if distance(S @ region, Q) < best:
                    best, index = distance(S @ region, Q), 2 * (delta_1 - 1) + (delta_2 - 1)
    return index


def labels_of(name: str) -> tuple[Matrix, Matrix, NDArray[np.int64]]:
    """Poses' rotations and what the code makes of them."""
    R = random_rotations(np.random.default_rng(7), N_POSES)
    found = CanonicalMap(SymmetryGroup.from_name(name), "pitteri2019")(R, np.zeros((N_POSES, 3)))
    return R, found.R_m2c, found.regressor_index


@pytest.mark.parametrize("order", [2, 3, 4, 5, 6, 12])
def test_one_axis(order: int) -> None:
    R, R_c, index = labels_of(f"C{order}")
    symmetries = generated(turn("z", 2 * math.pi / order))
    for k in range(N_POSES):
        assert index[k] == one_axis_index(order, R[k].T)
        anchor = turn("z", index[k] * math.pi / order)
        nearest = min((R[k] @ S for S in symmetries), key=lambda moved, anchor=anchor: distance(moved, anchor))
        np.testing.assert_allclose(R_c[k], nearest, atol=1e-12)


@pytest.mark.parametrize("order", [2, 3, 4, 5, 6])
def test_two_axes(order: int) -> None:
    R, R_c, index = labels_of(f"D{order}")
    symmetries = generated(turn("z", 2 * math.pi / order), turn("x", math.pi))
    half_u, half_v = turn("z", math.pi / order), turn("x", math.pi / 2)
    assert len(symmetries) == 2 * order
    for k in range(N_POSES):
        assert index[k] == two_axes_index(symmetries, half_u, half_v, R[k].T)
        if index[k] in (0, 3):
            anchor = np.eye(3) if index[k] == 0 else half_u @ half_v
            np.testing.assert_allclose(R_c[k].T, nearest_in(symmetries, R[k].T, anchor), atol=1e-12)
    assert sorted(set(index.tolist())) == [0, 1, 2, 3]


@pytest.mark.parametrize("order", [2, 3, 4, 5, 6])
def test_with_the_product_in_the_other_order_a_third_of_the_indices_would_differ(order: int) -> None:
    group = SymmetryGroup.from_name(f"D{order}")
    R = random_rotations(np.random.default_rng(0), 1500)
    index = CanonicalMap(group).regressor_index(R, np.zeros((len(R), 3)))
    former = FiniteCharts(group.elements_wxyz, former_anchors(parse_name(group.name)), "nearest", Z, 1e-6, 0.0)
    assert 440 < (former.label(from_matrix(R)).chart != index).sum() < 620


def test_cylinder() -> None:
    """The turn about the axis that is nearest is removed: alpha = atan2(Q12 - Q21, Q11 + Q22) of Q transposed."""
    R, R_c, index = labels_of("SO(2)")
    for k in range(N_POSES):
        alpha = math.atan2(R[k][1, 0] - R[k][0, 1], R[k][0, 0] + R[k][1, 1])
        np.testing.assert_allclose(R_c[k].T, turn("z", alpha) @ R[k].T, atol=1e-9)
        others = [turn("z", alpha + offset) @ R[k].T for offset in np.linspace(0.1, 6.2, 30)]
        assert all(distance(R_c[k].T, np.eye(3)) < distance(other, np.eye(3)) for other in others)
    assert set(index.tolist()) == {0}


def test_sphere() -> None:
    _, R_c, index = labels_of("SO(3)")
    np.testing.assert_allclose(R_c, np.tile(np.eye(3), (N_POSES, 1, 1)), atol=1e-12)
    assert set(index.tolist()) == {0}


@pytest.mark.parametrize("order", [2, 3, 5])
def test_the_norm_of_the_papers_difference_is_a_trace(order: int) -> None:
    """||S^-1 Q - I||^2 = 6 - 2 trace(S^T Q)."""
    Q = random_rotations(np.random.default_rng(order), 1)[0]
    for S in generated(turn("z", 2 * math.pi / order)):
        assert distance(S.T @ Q, np.eye(3)) ** 2 == pytest.approx(6 - 2 * float(np.trace(S.T @ Q)))
