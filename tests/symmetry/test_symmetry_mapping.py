"""The invariants of canonical labels, for every group and both schemes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial import cKDTree
from symmetry_cases import (
    ALL,
    CYCLIC,
    FINITE,
    SCHEMES,
    axis_aligned_rotations,
    euler_grid,
    in_random_frame,
    moved,
    random_rotations,
    seeds,
    some_motions,
    symmetric_vertices,
)

from generator.symmetry import CanonicalMap, SymmetryGroup
from generator.symmetry.quaternions import Floats, angle_deg, from_matrix, to_matrix

N_REGRESSORS = {
    "pitteri2019": {"C1": 1, "T": 4, "O": 4, "I": 4, "SO(2)": 1, "O(2)": 2, "SO(3)": 1},
    "atlas": {"C1": 1, "T": 6, "O": 8, "I": 8, "SO(2)": 2, "O(2)": 3, "SO(3)": 1},
}


def poses(R: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    return R, rng.normal(size=(len(R), 3)) * 100 + (0, 0, 800)


def assert_same_label(canonical: CanonicalMap, R: Floats, t: Floats, motion: Floats) -> None:
    a, b = canonical(R, t), canonical(*moved(R, t, motion))
    np.testing.assert_array_equal(a.regressor_index, b.regressor_index)
    np.testing.assert_allclose(a.R_m2c, b.R_m2c, atol=1e-9, rtol=0)
    np.testing.assert_allclose(a.t_m2c, b.t_m2c, atol=1e-6, rtol=0)
    np.testing.assert_allclose(a.discontinuity_margin_deg, b.discontinuity_margin_deg, atol=1e-6, rtol=0)


def assert_same_appearance(group: SymmetryGroup, R: Floats, t: Floats, R_c: Floats, t_c: Floats) -> None:
    assert group.appearance_distance_deg(R, R_c).max() < np.degrees(1e-9)
    c = np.array(group.offset_mm)
    np.testing.assert_allclose(R @ c + t, R_c @ c + t_c, atol=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ALL)
@settings(max_examples=8, deadline=None)
@given(seed=seeds)
def test_random_poses_in_random_frames(name: str, scheme: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    group = in_random_frame(name, rng)
    reference = random_rotations(rng, 1)[0] if seed % 2 else None
    canonical = CanonicalMap(group, scheme, reference)
    R, t = poses(random_rotations(rng, 200), rng)
    labels = canonical(R, t)
    assert_same_appearance(group, R, t, labels.R_m2c, labels.t_m2c)
    for motion in some_motions(group, rng)[:12]:
        assert_same_label(canonical, R, t, motion)
    again = canonical(labels.R_m2c, labels.t_m2c)
    np.testing.assert_array_equal(again.regressor_index, labels.regressor_index)
    np.testing.assert_allclose(again.R_m2c, labels.R_m2c, atol=1e-12, rtol=0)
    np.testing.assert_allclose(again.t_m2c, labels.t_m2c, atol=1e-12 * 1e3, rtol=0)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ALL)
def test_ties_of_structured_poses_are_decided_alike(name: str, scheme: str) -> None:
    rng = np.random.default_rng(0)
    group = SymmetryGroup.from_name(name, offset_mm=(-7, 3, 2))
    canonical = CanonicalMap(group, scheme)
    for rotations in (axis_aligned_rotations(), euler_grid()):
        R, t = poses(rotations, rng)
        labels = canonical(R, t)
        assert_same_appearance(group, R, t, labels.R_m2c, labels.t_m2c)
        for motion in some_motions(group, rng):
            assert_same_label(canonical, R, t, motion)
        again = canonical(labels.R_m2c, labels.t_m2c)
        np.testing.assert_array_equal(again.regressor_index, labels.regressor_index)
        np.testing.assert_allclose(again.R_m2c, labels.R_m2c, atol=1e-12, rtol=0)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", FINITE)
def test_vertices_of_a_symmetric_mesh_coincide(name: str, scheme: str) -> None:
    rng = np.random.default_rng(7)
    group = in_random_frame(name, rng)
    vertices = symmetric_vertices(group, rng)
    R, t = poses(random_rotations(rng, 10), rng)
    labels = CanonicalMap(group, scheme)(R, t)
    for i in range(len(R)):
        true, canonical = vertices @ R[i].T + t[i], vertices @ labels.R_m2c[i].T + labels.t_m2c[i]
        assert cKDTree(true).query(canonical)[0].max() < 1e-6
        assert cKDTree(canonical).query(true)[0].max() < 1e-6


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ALL)
def test_number_of_regressors(name: str, scheme: str) -> None:
    expected = N_REGRESSORS[scheme].get(
        name, {"pitteri2019": {"C": 2, "D": 4}, "atlas": {"C": 4, "D": 6}}[scheme].get(name[0])
    )
    canonical = CanonicalMap(SymmetryGroup.from_name(name), scheme)
    labels = canonical(*poses(random_rotations(np.random.default_rng(0), 5000), np.random.default_rng(1)))
    assert canonical.n_regressors == labels.n_regressors == expected
    assert sorted(set(labels.regressor_index)) == list(range(expected))


@pytest.mark.parametrize("name", CYCLIC)
@settings(max_examples=5, deadline=None)
@given(seed=seeds)
def test_the_schemes_agree_while_the_axis_is_tilted_by_less_than_90(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    group = in_random_frame(name, rng)
    R, t = poses(random_rotations(rng, 500), rng)
    axis = np.array(group.axis)
    upper = (R @ axis) @ axis > 1e-5
    paper, atlas = (CanonicalMap(group, scheme)(R[upper], t[upper]) for scheme in SCHEMES)
    np.testing.assert_array_equal(paper.regressor_index, atlas.regressor_index)
    np.testing.assert_array_equal(paper.R_m2c, atlas.R_m2c)
    np.testing.assert_allclose(paper.discontinuity_margin_deg, atlas.discontinuity_margin_deg, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_cylinders_axis_stays_where_it_is_also_at_exact_flips(scheme: str) -> None:
    rng = np.random.default_rng(3)
    for axis in (np.array([0, 0, 1.0]), rng.normal(size=3)):
        group = SymmetryGroup.from_name("SO(2)", axis=axis)
        u = np.array(group.axis)
        across = np.linalg.svd(u[None])[2][1]
        flip = to_matrix(np.array([0.0, *across]))
        near = [flip @ to_matrix(np.array([np.cos(a), *(np.sin(a) * across)])) for a in (1e-3, 1e-7, 1e-9, 1e-16)]
        spins = some_motions(group, rng)
        R, t = poses(np.stack([flip, *near, *random_rotations(rng, 50)]), rng)
        labels = CanonicalMap(group, scheme)(R, t)
        np.testing.assert_allclose(labels.R_m2c @ u, R @ u, atol=1e-12, rtol=0)
        for spin in spins:
            assert_same_label(CanonicalMap(group, scheme), R, t, spin)


def test_vector_of_two_look_alikes_that_the_paper_tears_apart() -> None:
    R = np.array(
        [
            [[0.999982, -0.000049, 0.005969], [0.000049, -0.999866, -0.016400], [0.005969, 0.016400, -0.999848]],
            [[-0.999866, 0.000049, 0.016400], [-0.000049, 0.999982, -0.005969], [-0.016400, -0.005969, -0.999848]],
        ]
    )
    group = SymmetryGroup.from_name("C2", axis=(0, 0, 1))
    t = np.zeros((2, 3))
    assert group.appearance_distance_deg(R[:1], R[1:])[0] == pytest.approx(0.845, abs=1e-3)
    paper, atlas = CanonicalMap(group)(R, t), CanonicalMap(group, "atlas")(R, t)
    assert paper.regressor_index[0] == paper.regressor_index[1]
    assert label_distance_deg(paper.R_m2c)[0] == pytest.approx(179.99, abs=5e-3)
    assert atlas.regressor_index.tolist() == [2, 2]
    assert label_distance_deg(atlas.R_m2c)[0] == pytest.approx(0.845, abs=1e-3)
    assert atlas.discontinuity_margin_deg == pytest.approx([90.0, 90.0], abs=0.05)


def label_distance_deg(R: Floats) -> Floats:
    q = from_matrix(R)
    return angle_deg(q[:-1], q[1:])
