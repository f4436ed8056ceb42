"""Detection finds the group that a shape was made with, wherever it stands and however it is triangulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from detect_shapes import KNOWN, apart_deg, as_stl, chiral_gear, moved, noisy, notched_cylinder, remeshed
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from synthetless.io.models import read_models_info
from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.detection import Detected, detect

PARTS = [18, 26, 33, 34, 35, 36]


def detected(mesh: trimesh.Trimesh) -> Detected:
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    diameter = float(pdist(vertices[ConvexHull(vertices).vertices]).max())
    return detect(vertices, np.asarray(mesh.faces), diameter)


@pytest.mark.parametrize("name", KNOWN)
def test_the_group_a_shape_was_made_with(name: str) -> None:
    """Each in a random pose; in turn also remeshed, with noise of 0.1 % of the diameter, and as STL."""
    make, expected = KNOWN[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    disguise = [lambda m: m, remeshed, lambda m: noisy(m, rng), as_stl][list(KNOWN).index(name) % 4]
    mesh, _ = moved(make(), rng)
    found = detected(disguise(mesh))
    assert found.answer.group.name == expected
    assert found.answer.residual.max_mm <= found.tolerance_mm


def test_the_frame_of_a_group_in_any_pose() -> None:
    for name, in_place in {
        "box": SymmetryGroup.from_name("D2"),
        "L bracket": SymmetryGroup.from_name("C2", axis=(1, 0, 1), offset_mm=(0, 10, 0)),
    }.items():
        mesh, pose = moved(KNOWN[name][0](), np.random.default_rng(3))
        found = detected(mesh).answer.group
        motions = pose @ in_place.motions() @ np.linalg.inv(pose)
        expected = SymmetryGroup.from_bop({"symmetries_discrete": motions[1:].reshape(-1, 16).tolist()})
        assert apart_deg(found, expected) < 0.01
        fixed = np.array(found.offset_mm)
        np.testing.assert_allclose(
            motions[:, :3, :3] @ fixed + motions[:, :3, 3], np.tile(fixed, (len(motions), 1)), atol=0.01
        )


def test_coordinate_axes_come_out_exactly() -> None:
    found = detected(chiral_gear(5)).answer.group
    assert found.axis == (0.0, 0.0, 1.0)
    assert found.offset_mm == (0.0, 0.0, 0.0)
    box = KNOWN["box"][0]()
    box.apply_translation((0, 12.5, 0))
    found = detected(box).answer.group
    assert (found.axis, found.secondary_axis, found.offset_mm) == ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 12.5, 0.0))


def test_the_tolerance_decides_and_the_costs_are_told() -> None:
    """A keyway 2 % of the diameter deep: a cylinder for whoever tolerates it."""
    found = detected(notched_cylinder(0.02 * np.hypot(50, 60)))
    assert found.answer.group.name == "C2"
    assert found.next_larger is not None
    assert found.next_larger.group.name == "O(2)"
    assert 100 * found.next_larger.residual.max_mm / found.diameter_mm == pytest.approx(2, abs=0.05)
    assert found.answer_at(0.021 * found.diameter_mm) == found.next_larger
    maxima = [fit.residual.max_mm for fit in found.staircase]
    assert maxima == sorted(maxima)


@pytest.mark.parametrize("obj_id", PARTS)
def test_built_in_parts(builtin_models: Path, obj_id: int) -> None:
    """The declared group, and its axis and fixed point, of the file and of an STL file of the part moved."""
    declared = SymmetryGroup.from_bop(read_models_info(builtin_models)[obj_id])
    mesh = trimesh.load(builtin_models / f"obj_{obj_id:06d}.ply", process=False)
    if obj_id % 2:
        mesh = as_stl(moved(mesh, np.random.default_rng(obj_id))[0])
    found = detected(mesh).answer
    assert found.group.name == declared.name
    if obj_id % 2 == 0:
        assert found.group == declared
