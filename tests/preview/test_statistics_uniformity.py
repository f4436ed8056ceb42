"""The tests for uniformity: they let what is uniform pass, and find what is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from synthetless.preview import statistics
from synthetless.preview.distributions import categories_p, rotations_p, uniform_p

REPEATS = 400


@pytest.mark.parametrize("what", ["range", "categories", "rotations"])
def test_what_is_uniform_has_small_p_values_no_more_often_than_they_say(what: str) -> None:
    rng = np.random.default_rng(7)
    p_values = [_uniform_draw(what, rng) for _ in range(REPEATS)]
    assert stats.kstest(p_values, "uniform", alternative="greater").pvalue > 1e-3


def _uniform_draw(what: str, rng: np.random.Generator) -> float | None:
    if what == "range":
        return uniform_p(rng.uniform(-3, 5, 200), -3, 5)
    if what == "categories":
        return categories_p(np.bincount(rng.integers(0, 30, 900), minlength=30).tolist(), [30.0] * 30)
    return rotations_p(Rotation.random(300, random_state=rng).as_quat()[:, [3, 0, 1, 2]])


def test_what_is_not_uniform_is_found() -> None:
    rng = np.random.default_rng(8)
    assert uniform_p(rng.uniform(0, 1, 400) ** 1.5, 0, 1) < 1e-6
    assert uniform_p(rng.uniform(0, 0.9, 500), 0, 1) < 1e-6
    assert categories_p([60, 30, 30, 30], [37.5] * 4) < 1e-2
    axes = rng.normal(size=(300, 3))
    angles = rng.uniform(0, np.pi, (300, 1))  # the mistake of drawing the angle uniformly
    turned = Rotation.from_rotvec(angles * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    assert rotations_p(turned.as_quat()[:, [3, 0, 1, 2]]) < 1e-6


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    q = np.random.default_rng(9).normal(size=(100, 4))
    signs = np.where(np.arange(100) % 3, 1.0, -1.0)[:, None]
    assert rotations_p(q) == pytest.approx(rotations_p(q * signs))


def test_a_value_outside_is_found_however_few_there_are() -> None:
    assert uniform_p(np.array([0.5, 1.2]), 0, 1) == 0.0
    assert categories_p([3, 1], [4.0, 0.0]) == 0.0


def test_too_few_values_are_not_judged() -> None:
    assert uniform_p(np.linspace(0, 1, 10), 0, 1) is None
    assert categories_p([3, 2], [2.5, 2.5]) is None
    assert rotations_p(np.eye(4)) is None


def test_views_counted_several_times_do_not_make_a_bias_surer() -> None:
    counts, expected = [130, 90, 95, 85], [100.0] * 4
    assert categories_p([4 * n for n in counts], [4 * n for n in expected], repeats=4) == pytest.approx(
        categories_p(counts, expected)
    )


def test_cells_have_equal_area_on_the_sphere_and_on_the_map() -> None:
    directions = np.random.default_rng(10).normal(size=(200_000, 3))
    counts = statistics.cell_counts(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert stats.chisquare(counts.ravel()).pvalue > 1e-3
    x, y = np.moveaxis(statistics.cell_outlines(points=200), -1, 0)
    areas = np.abs((x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)).sum(axis=-1)) / 2
    np.testing.assert_allclose(areas, 4 * np.pi / statistics.CELLS, rtol=2e-3)


@settings(max_examples=25)
@given(st.integers(1, 2000), st.integers(0, 2**32 - 1))
def test_every_view_is_in_one_cell(views: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(views, random_state=rng).as_matrix(), rng.normal(size=(views, 3))
    directions = statistics.viewing_directions(R, t)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, directions) * np.linalg.norm(t, axis=1)[:, None], -t)
    assert statistics.cell_counts(directions).sum() == views


def test_expected_coverage_is_that_of_uniform_views() -> None:
    rng = np.random.default_rng(11)
    found = []
    for _ in range(100):
        directions = rng.normal(size=(150, 3))
        found.append(
            statistics.coverage(statistics.cell_counts(directions / np.linalg.norm(directions, axis=1)[:, None]))
        )
    assert np.mean(found) == pytest.approx(statistics.uniform_coverage(150), abs=0.01)
