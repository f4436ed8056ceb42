"""Where a group is judged, what the next larger one is, and what becomes of meshes that take too long."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from detect_shapes import box, of
from manifold3d import CrossSection, Manifold

from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.detection import Detected, GroupFit, detect, detect_folder, report
from synthetless.symmetry.detection import folder as folder_module
from synthetless.symmetry.detection.candidates import CandidateSearch
from synthetless.symmetry.detection.distance import PIECE, Surface
from synthetless.symmetry.detection.refine import tightened
from synthetless.symmetry.detection.residual import ResidualMeter

SHIFT = 4.0


def plate_with_pegs() -> trimesh.Trimesh:
    """An outline with C2, and a peg that is 4 mm from where a half turn takes the other one."""
    plate = Manifold.cube((100, 60, 6), True)
    for x, y in ((30, 10), (-30 + SHIFT, -10)):
        plate += Manifold.cylinder(12, 7, 7, 64).translate((x, y, 3))
    return of(plate)


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray, float]:
    vertices = np.asarray(mesh.vertices)
    return vertices, np.asarray(mesh.faces), float(np.linalg.norm(mesh.extents))


def detected(mesh: trimesh.Trimesh, tolerance_percent: float = 1.0) -> Detected:
    return detect(*arrays(mesh), tolerance_percent)


def test_the_largest_residual_is_made_as_small_as_can_be() -> None:
    """Squares leave the axis in the outline's middle and the peg 4 mm off; half-way to the pegs' it costs 2 mm."""
    vertices, faces, diameter = arrays(plate_with_pegs())
    surface = Surface(vertices, faces, PIECE * diameter)
    meter = ResidualMeter(surface, vertices, diameter)
    group = SymmetryGroup.from_name("C2")
    fit = GroupFit(group, meter.measure(group, 5.0))
    assert fit.residual.max_mm == pytest.approx(SHIFT, rel=0.02)
    tight = tightened(fit, surface, meter, 5.0)
    assert tight.group.name == "C2"
    assert tight.residual.max_mm == pytest.approx(SHIFT / 2, rel=0.01)
    assert abs(tight.group.offset_mm[0] - SHIFT / 4) < 0.05


def test_a_group_near_the_tolerance_is_judged_where_it_fits_best() -> None:
    found = detected(plate_with_pegs(), 100 * 0.6 * SHIFT / 117)
    assert found.answer.group.name == "C2"
    assert found.answer.residual.max_mm <= 0.51 * SHIFT


def test_the_next_larger_group_is_the_one_that_costs_least() -> None:
    """Six waves and eight: a six-fold axis costs 1.73 amplitudes of the eight, an eight-fold one 1.41 of the six."""
    angle = np.linspace(0, 2 * np.pi, 480, endpoint=False)
    radius = 40 + 2.6 * np.cos(6 * angle) + 2.0 * np.cos(8 * angle)
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    found = detected(of(Manifold.extrude(CrossSection([outline]), 12)))
    assert found.answer.group.name == "D2"
    assert found.next_larger is not None
    assert found.next_larger.group.name in ("C6", "D6")
    assert found.next_larger.residual.max_mm < np.sqrt(3) * 2.0 + 0.1


def test_time_that_runs_out_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = box(30, 50, 80)
    in_no_time = detect(*arrays(mesh), time_limit_s=0.0)
    assert in_no_time.answer.group.name == "C1"
    assert not in_no_time.is_complete
    assert detected(mesh).is_complete
    mesh.export(tmp_path / "obj_000001.ply")
    monkeypatch.setattr(folder_module, "detect", lambda *_: in_no_time)
    text = " ".join(report(detect_folder(tmp_path, workers=1)).split())
    assert "object 1 (obj_000001.ply) took too long: not every group was looked at" in text


def test_the_search_for_candidates_ends_with_the_time_too() -> None:
    vertices, faces, diameter = arrays(box(30, 50, 80))
    surface = Surface(vertices, faces, PIECE * diameter)
    dense = ResidualMeter(surface, vertices, diameter).dense
    whole = CandidateSearch(surface, diameter, 1.0, dense)
    everything, asked = whole.candidates(), 0
    for limit in (0, 1, 5, 9, 20):
        left = limit

        def has_time() -> bool:
            nonlocal left, asked
            asked, left = asked + 1, left - 1
            return left >= 0

        found = CandidateSearch(surface, diameter, 1.0, dense, has_time).candidates()
        assert "SO(3)" in [each.group.name for each in found]
        assert len(found) <= min(limit + 1, len(everything))
    assert asked > 40


def test_triangles_without_a_shape_end_in_an_answer() -> None:
    """Large ones that cross each other were cut into millions of pieces."""
    rng = np.random.default_rng(0)
    soup = trimesh.Trimesh(30 * rng.normal(size=(6000, 3)), np.arange(6000).reshape(-1, 3), process=False)
    found = detect(*arrays(soup), time_limit_s=1.0)
    assert found.answer.group.name == "C1"
