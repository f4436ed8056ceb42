"""The invariants of canonical labels, for every group and both schemes."""

from __future__ import annotations

import json

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

from synthetless.symmetry import CanonicalMap, CanonicalPoses, SymmetryGroup
from synthetless.symmetry.canonical import FEWEST_DECIMALS, FULL_DECIMALS, stored_decimals
from synthetless.symmetry.quaternions import Floats, angle_deg, from_matrix, to_matrix

N_REGRESSORS = {
    "pitteri2019": {"C1": 1, "T": 4, "O": 4, "I": 4, "SO(2)": 1, "O(2)": 2, "SO(3)": 1},
    "atlas": {"C1": 1, "T": 6, "O": 8, "I": 8, "SO(2)": 2, "O(2)": 3, "SO(3)": 1},
}


def poses(R: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    return R, rng.normal(size=(len(R), 3)) * 100 + (0, 0, 800)


def assert_same_labels(a: CanonicalPoses, b: CanonicalPoses) -> None:
    np.testing.assert_array_equal(a.regressor_index, b.regressor_index)
    np.testing.assert_allclose(a.R_m2c, b.R_m2c, atol=1e-9, rtol=0)
    np.testing.assert_allclose(a.t_m2c, b.t_m2c, atol=1e-6, rtol=0)
    np.testing.assert_allclose(a.discontinuity_margin_deg, b.discontinuity_margin_deg, atol=1e-6, rtol=0)


def assert_unchanged(a: CanonicalPoses, b: CanonicalPoses) -> None:
    np.testing.assert_array_equal(a.regressor_index, b.regressor_index)
    np.testing.assert_allclose(a.R_m2c, b.R_m2c, atol=1e-12, rtol=0)
    np.testing.assert_allclose(a.t_m2c, b.t_m2c, atol=1e-12 * 1e3, rtol=0)  # of coordinates near 1000 mm


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
    for motion in rng.permutation(some_motions(group, rng))[:8]:
        assert_same_labels(labels, canonical(*moved(R, t, motion)))
    assert_unchanged(labels, canonical(labels.R_m2c, labels.t_m2c))


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
            assert_same_labels(labels, canonical(*moved(R, t, motion)))
        assert_unchanged(labels, canonical(labels.R_m2c, labels.t_m2c))


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
        near = [
            flip @ to_matrix(np.array([np.cos(a / 2), *(np.sin(a / 2) * across)]))
            for a in (0.3, 1e-2, 1e-3, 1e-5, 1.1e-6, 9e-7, 1e-7, 1e-9, 1e-16)
        ]
        R, t = poses(np.stack([flip, *near, *random_rotations(rng, 50)]), rng)
        labels = CanonicalMap(group, scheme)(R, t)
        np.testing.assert_allclose(labels.R_m2c @ u, R @ u, atol=1e-12, rtol=0)
        for spin in some_motions(group, rng):
            assert_same_labels(labels, CanonicalMap(group, scheme)(*moved(R, t, spin)))


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


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ALL)
def test_look_alikes_that_were_rounded_independently_share_a_label(name: str, scheme: str) -> None:
    """R and R S, each with as many decimals as a file has: the same regressor, and labels no farther apart than 10
    units of the last decimal (for a cylinder near its flip, where labels stretch; else one)."""
    rng = np.random.default_rng(2)
    group = SymmetryGroup.from_name(name, offset_mm=(-7, 3, 2))
    grid, t = poses(np.concatenate([axis_aligned_rotations(), euler_grid(15)]), rng)
    for decimals in (4, 5, 6, 7, 8, 9, 12):
        canonical = CanonicalMap(group, scheme, decimals=decimals)
        expected = canonical(grid.round(decimals), t.round(decimals))
        for motion in rng.permutation(some_motions(group, rng))[:2]:
            R_moved, t_moved = moved(grid, t, motion)
            found = canonical(R_moved.round(decimals), t_moved.round(decimals))
            np.testing.assert_array_equal(found.regressor_index, expected.regressor_index)
            np.testing.assert_allclose(found.R_m2c, expected.R_m2c, rtol=0, atol=10 * 10.0**-decimals)


def test_without_being_told_rounded_look_alikes_do_not_share_labels() -> None:
    """Of C_3 a tenth of all poses of the grid at 4 decimals, some at 6: what telling the decimals is for."""
    group, grid = SymmetryGroup.from_name("C3"), euler_grid(15)
    canonical, t = CanonicalMap(group), np.zeros((len(grid), 3))
    motion = group.motions()[1]
    for decimals, least, most in ((4, 0.1, 0.5), (6, 0.01, 0.1), (12, 0.0, 0.0)):
        one, other = (canonical(R.round(decimals), t) for R in (grid, grid @ motion[:3, :3]))
        differ = np.abs(one.R_m2c - other.R_m2c).max(axis=(1, 2)) > 10 * 10.0**-decimals
        differ |= one.regressor_index != other.regressor_index
        assert least <= differ.mean() <= most


@pytest.mark.parametrize("decimals", [4, 6, 8, 9, 14])
def test_the_decimals_of_a_file_are_found_in_its_numbers(decimals: int) -> None:
    R = random_rotations(np.random.default_rng(decimals), 500)
    read = np.array(json.loads(json.dumps(R.round(decimals).tolist())))
    assert stored_decimals(read) == decimals
    assert stored_decimals(R) == FULL_DECIMALS
    assert stored_decimals(np.concatenate([read, R])) == FULL_DECIMALS
    assert stored_decimals(R.round(2)) == FEWEST_DECIMALS
    assert stored_decimals(axis_aligned_rotations()) is None
    assert stored_decimals(np.empty((0, 3, 3))) is None


@pytest.mark.parametrize("decimals", [3, 16, -1, 4.0, True, "6", None])
def test_other_numbers_of_decimals_are_refused(decimals: object) -> None:
    with pytest.raises(ValueError, match=r"decimals is .*, not a whole number from 4 to 15"):
        CanonicalMap(SymmetryGroup.trivial(), decimals=decimals)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ["C3", "D3", "T", "SO(2)", "O(2)", "SO(3)"])
def test_each_regressor_is_centred_on_its_anchor(name: str, scheme: str) -> None:
    rng = np.random.default_rng(8)
    reference = random_rotations(rng, 1)[0]
    canonical = CanonicalMap(in_random_frame(name, rng), scheme, reference)
    anchors = to_matrix(canonical.anchors_wxyz)
    np.testing.assert_allclose(anchors[0], reference, atol=1e-12)
    labels = canonical(anchors, np.zeros((len(anchors), 3)))
    np.testing.assert_array_equal(labels.regressor_index, range(canonical.n_regressors))
    np.testing.assert_allclose(labels.R_m2c, anchors, atol=1e-12)


@pytest.mark.parametrize("name", ["C1", "C2", "D3", "O", "SO(2)", "O(2)", "SO(3)"])
def test_equivalent_poses_of_a_prediction(name: str) -> None:
    rng = np.random.default_rng(4)
    group = in_random_frame(name, rng)
    canonical = CanonicalMap(group, "atlas")
    R, t = poses(random_rotations(rng, 3), rng)
    R_all, t_all = canonical.equivalent_poses(R, t, samples=10)
    m = R_all.shape[1]
    assert m == (group.order if group.is_finite else {"O(2)": 20}.get(name, 10))
    np.testing.assert_allclose(R_all[:, 0], R, atol=1e-12)
    np.testing.assert_allclose(t_all[:, 0], t, atol=1e-9)
    labels = canonical(R, t)
    for i in range(len(R)):
        images = canonical(R_all[i], t_all[i])
        np.testing.assert_allclose(images.R_m2c, np.tile(labels.R_m2c[i], (m, 1, 1)), atol=1e-9)
        np.testing.assert_allclose(images.t_m2c, np.tile(labels.t_m2c[i], (m, 1)), atol=1e-6)
    np.testing.assert_array_equal(canonical.regressor_index(R, t), labels.regressor_index)


@pytest.mark.parametrize("samples", [24, 72, 300, 1000])
def test_equivalent_poses_of_a_ball_cover_all_rotations(samples: int) -> None:
    """With no gap larger than the docstring says, and therefore on no great circle or other part of the group."""
    rng = np.random.default_rng(1)
    ball = SymmetryGroup.from_name("SO(3)", offset_mm=(1, 2, 3))
    R, t = poses(random_rotations(rng, 1), rng)
    R_all, t_all = CanonicalMap(ball).equivalent_poses(R, t, samples)
    np.testing.assert_allclose(
        R_all[0] @ (1, 2, 3) + t_all[0], np.tile(R[0] @ (1, 2, 3) + t[0], (samples, 1)), atol=1e-9
    )
    wanted, there = from_matrix(random_rotations(rng, 20_000)), from_matrix(R_all[0])
    largest_gap_deg = np.degrees(2 * np.arccos(np.abs(wanted @ there.T).max(axis=1).min()))
    assert 150 / np.cbrt(samples) < largest_gap_deg < 240 / np.cbrt(samples)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ["C1", "C2", "D3", "SO(2)", "SO(3)"])
def test_allocentric_labels_do_not_depend_on_where_in_the_image_the_object_lies(name: str, scheme: str) -> None:
    rng = np.random.default_rng(6)
    group = in_random_frame(name, rng)
    canonical = CanonicalMap(group, scheme, allocentric=True)
    R, t = poses(random_rotations(rng, 300), rng)
    labels = canonical(R, t)
    assert_same_appearance(group, R, t, labels.R_m2c, labels.t_m2c)
    for motion in some_motions(group, rng):
        assert_same_labels(labels, canonical(*moved(R, t, motion)))
    assert_unchanged(labels, canonical(labels.R_m2c, labels.t_m2c))

    c = np.array(group.offset_mm)
    ahead = canonical.to_allocentric(R, t)  # the same views, with the object on the camera's axis
    on_axis = canonical(ahead, (0, 0, 700) - ahead @ c)
    np.testing.assert_array_equal(on_axis.regressor_index, labels.regressor_index)
    np.testing.assert_allclose(on_axis.R_m2c, canonical.to_allocentric(labels.R_m2c, labels.t_m2c), atol=1e-9)
    np.testing.assert_allclose(on_axis.R_m2c, CanonicalMap(group, scheme)(ahead, t).R_m2c, atol=1e-9)
    with pytest.raises(ValueError, match=r"pose 0: the object, .* is not in front of the camera"):
        canonical(R[:1], t[:1] - (0, 0, 2000))


def test_slightly_wrong_rotations_are_repaired() -> None:
    rng = np.random.default_rng(9)
    canonical = CanonicalMap(SymmetryGroup.from_name("C2"))
    R, t = poses(random_rotations(rng, 100), rng)
    U, _, Vt = np.linalg.svd(R + rng.normal(size=R.shape) * 1e-5)
    labels = canonical(U @ np.diag([1 + 1e-5, 1, 1 - 2e-5]) @ Vt, t)
    products = labels.R_m2c @ labels.R_m2c.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (100, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(labels.R_m2c, canonical(U @ Vt, t).R_m2c, atol=1e-9)


def test_no_poses_have_no_labels() -> None:
    labels = CanonicalMap(SymmetryGroup.from_name("C2"))(np.empty((0, 3, 3)), np.empty((0, 3)))
    assert labels.R_m2c.shape == (0, 3, 3)
    assert labels.regressor_index.shape == labels.discontinuity_margin_deg.shape == (0,)


@pytest.mark.parametrize(
    ("R", "t", "message"),
    [
        (np.eye(3), np.zeros(3), "not \\(N, 3, 3\\) and \\(N, 3\\)"),
        (np.eye(3)[None], np.zeros((2, 3)), "not \\(N, 3, 3\\) and \\(N, 3\\)"),
        (np.stack([np.eye(3), np.diag([1, 1, -1])]), np.zeros((2, 3)), "pose 1: R_m2c is no rotation: .*reflection"),
        (np.full((1, 3, 3), np.nan), np.zeros((1, 3)), "pose 0: R_m2c is no rotation: .*not finite"),
        (np.zeros((1, 3, 3)), np.zeros((1, 3)), "pose 0: R_m2c is no rotation"),
        (2 * np.eye(3)[None], np.zeros((1, 3)), "not orthonormal"),
        (np.eye(3)[None], [[0, 0, np.inf]], "pose 0: t_m2c .* not finite"),
    ],
)
def test_what_is_no_pose_is_refused_in_one_line(R: Floats, t: Floats, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        CanonicalMap(SymmetryGroup.from_name("C2"))(R, t)
    assert "\n" not in str(caught.value)


def test_wrong_schemes_and_references_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown scheme 'paper': use one of pitteri2019, atlas"):
        CanonicalMap(SymmetryGroup.trivial(), "paper")
    with pytest.raises(ValueError, match=r"reference_rotation is no rotation: .*reflection"):
        CanonicalMap(SymmetryGroup.trivial(), "atlas", -np.eye(3))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ["C2", "C6", "D2", "D3", "T", "O", "I", "O(2)"])
def test_a_noisy_bop_entry_gives_labels_as_exact_as_any(name: str, scheme: str) -> None:
    rng = np.random.default_rng(3)
    fields = in_random_frame(name, rng).to_bop()
    matrices = np.array(fields["symmetries_discrete"])
    matrices[:, :12] += rng.normal(size=(len(matrices), 12)) * 5e-5
    group = SymmetryGroup.from_bop(fields | {"symmetries_discrete": matrices.tolist()})
    assert group.name == name
    canonical = CanonicalMap(group, scheme)
    R, t = poses(np.concatenate([axis_aligned_rotations(), random_rotations(rng, 200)]), rng)
    labels = canonical(R, t)
    assert_same_appearance(group, R, t, labels.R_m2c, labels.t_m2c)
    for motion in some_motions(group, rng):
        assert_same_labels(labels, canonical(*moved(R, t, motion)))
    assert_unchanged(labels, canonical(labels.R_m2c, labels.t_m2c))
