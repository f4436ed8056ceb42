"""Residuals against what geometry says."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from detect_shapes import as_stl, box, moved, notched_cylinder, of, prism
from manifold3d import Manifold

from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.detection import Residual
from synthetless.symmetry.detection.detect import measure

DEEP, WIDE = 12.0, 3.0


def residual(mesh: trimesh.Trimesh, group: SymmetryGroup) -> Residual:
    diameter = float(np.linalg.norm(mesh.extents))
    return measure(np.asarray(mesh.vertices), np.asarray(mesh.faces), diameter, group).residual


@pytest.mark.parametrize("depth", [0.3, 1.0, 4.0])
def test_a_notch_costs_its_depth(depth: float) -> None:
    found = residual(notched_cylinder(depth), SymmetryGroup.from_name("O(2)"))
    assert found.max_mm == pytest.approx(depth, rel=0.02)
    assert found.rms_mm < found.p95_mm < found.max_mm or found.p95_mm < 0.1 * depth


@pytest.mark.parametrize("n", [6, 16])
def test_a_prism_is_a_cylinder_up_to_its_sagitta(n: int) -> None:
    sagitta = 25 * (1 - np.cos(np.pi / n))
    assert residual(prism(n), SymmetryGroup.from_name("O(2)")).max_mm == pytest.approx(sagitta, rel=0.02)
    assert residual(prism(n), SymmetryGroup.from_name(f"D{n}")).max_mm < 1e-4


def test_a_misplaced_fixed_point_costs_twice_its_distance() -> None:
    group = SymmetryGroup.from_name("D6", offset_mm=(0, 0, 3))
    assert residual(prism(6), group).max_mm == pytest.approx(6, rel=1e-3)


def test_a_box_is_no_square_prism() -> None:
    """A quarter turn lifts the ends of the longer side off the surface by half the difference."""
    found = residual(box(30, 50, 80), SymmetryGroup.from_name("D4"))
    assert found.max_mm == pytest.approx(10, rel=1e-6)
    assert residual(box(30, 50, 80), SymmetryGroup.from_name("D2")).max_mm < 1e-9


def test_all_elements_count_not_the_generators() -> None:
    """Two pegs a half turn apart: the half turn is exact, the quarter turn is not, whichever generates the group."""
    plate = Manifold.cube((60, 60, 6), True)
    pegs = Manifold.cylinder(DEEP, WIDE, WIDE, 48)
    solid = plate + pegs.translate((20, 0, 3)) + pegs.translate((-20, 0, 3))
    assert residual(of(solid), SymmetryGroup.from_name("C2")).max_mm < 1e-4
    assert residual(of(solid), SymmetryGroup.from_name("C4")).max_mm == pytest.approx(DEEP, rel=1e-3)


def test_both_directions_count_in_a_thin_plate() -> None:
    """A hole has no surface that could be off: what misses it is the plate on the other side, by the hole's radius."""
    plate = of(Manifold.cube((80, 50, 0.4), True) - Manifold.cylinder(2, 6, 6, 64, True).translate((20, 10, 0)))
    found = residual(plate, SymmetryGroup.from_name("C2"))
    assert found.max_mm == pytest.approx(6, rel=0.03)


def test_the_whole_sphere_counts() -> None:
    assert residual(trimesh.creation.icosphere(4, 30), SymmetryGroup.from_name("SO(3)")).max_mm < 0.1
    dented = of(Manifold.sphere(30, 128) - Manifold.cylinder(10, 4, 4, 32).translate((0, 0, 25)))
    assert residual(dented, SymmetryGroup.from_name("SO(3)")).max_mm == pytest.approx(5, rel=0.05)


def test_a_residual_does_not_depend_on_the_pose_or_the_triangles() -> None:
    mesh = notched_cylinder(2.0)
    expected = residual(mesh, SymmetryGroup.from_name("O(2)"))
    rng = np.random.default_rng(1)
    for k in range(2):
        other, pose = moved(mesh, rng)
        group = SymmetryGroup.from_name("O(2)", axis=pose[:3, 2], offset_mm=pose[:3, 3])
        found = residual(as_stl(other) if k else other, group)
        assert found.max_mm == pytest.approx(expected.max_mm, rel=0.01)
        assert found.rms_mm == pytest.approx(expected.rms_mm, rel=0.1)
