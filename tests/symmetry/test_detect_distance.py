"""Distances to a mesh against the plain way: every triangle for every point."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from synthetless.symmetry.detection.distance import Surface
from synthetless.symmetry.quaternions import Floats


def plain_distances(corners: Floats, points: Floats) -> Floats:
    """(N,) to the nearest of all triangles: to its inside where the foot of the perpendicular is, else to its edges."""
    return np.array([min(_to_triangle(triangle, point) for triangle in corners) for point in points])


def _to_triangle(triangle: Floats, point: Floats) -> float:
    edges = np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0]], axis=1)
    u, v = np.linalg.lstsq(edges, point - triangle[0], rcond=None)[0]
    if u >= 0 and v >= 0 and u + v <= 1:
        return float(np.linalg.norm(triangle[0] + edges @ [u, v] - point))
    return min(_to_segment(triangle[i], triangle[i - 1], point) for i in range(3))


def _to_segment(a: Floats, b: Floats, point: Floats) -> float:
    share = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return float(np.linalg.norm(a + share * (b - a) - point))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_distances_to_any_triangles(seed: int) -> None:
    """Slivers among large triangles, points near and far: `exact` is exact, `distance` never too small nor far off."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-10, 10, (40, 1, 3)) + rng.normal(size=(40, 3, 3)) * rng.choice([0.05, 1, 8], (40, 1, 1))
    corners[:10, 2] = corners[:10, 1] + 1e-3 * rng.normal(size=(10, 3))
    surface = Surface(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3), piece=1.0)
    points = rng.uniform(-15, 15, (50, 3))
    expected = plain_distances(corners, points)
    found = surface.distance(points)
    assert (found >= expected - 1e-9).all()
    assert (found <= expected + 1.0).all()
    np.testing.assert_allclose(surface.exact(points, found), expected, atol=1e-9)
    closest = surface.closest(points)
    np.testing.assert_allclose(np.linalg.norm(closest.point - points, axis=1), closest.distance, atol=1e-9)
    np.testing.assert_allclose(plain_distances(corners, closest.point), 0, atol=1e-9)


def test_a_thin_wall_has_two_sides() -> None:
    wall = trimesh.creation.box((100, 100, 0.2))
    surface = Surface(np.asarray(wall.vertices), np.asarray(wall.faces), piece=2.0)
    heights = np.array([0.0, 0.06, -0.06, 0.3, -1.0])
    found = surface.distance(np.stack([np.full(5, 3.0), np.full(5, 7.0), heights], axis=1))
    np.testing.assert_allclose(found, np.abs(np.abs(heights) - 0.1), atol=1e-12)


def test_samples_are_spread_by_area_and_always_the_same() -> None:
    corners = np.array([[[0, 0, 0], [4, 0, 0], [0, 3, 0]], [[9, 0, 0], [11, 0, 0], [9, 2, 0]]], dtype=float)
    surface = Surface(corners.reshape(-1, 3), np.arange(6).reshape(-1, 3), piece=0.5)
    points = surface.sampled(4000)
    assert (points[:, 0] < 5).sum() == 3000  # areas 6 and 2
    np.testing.assert_allclose(points.mean(axis=0), surface.centroid, atol=0.02)
    np.testing.assert_array_equal(points, surface.sampled(4000))
    np.testing.assert_allclose(surface.distance(points), 0, atol=1e-9)


def test_lines_are_no_surface() -> None:
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=float)
    with pytest.raises(ValueError, match="none of its 1 triangles has an area"):
        Surface(line, np.array([[0, 1, 2]]), piece=1.0)
