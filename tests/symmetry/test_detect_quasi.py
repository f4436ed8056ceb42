"""Larger groups that a mesh has but for a detail: found, placed around the exact group, told and written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from notch import Notched
from symmetry_cases import random_rotations, seeds
from typer.testing import CliRunner

from synthetless.cli.commands import app
from synthetless.symmetry import SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection import Tolerance, detect_folder, report
from synthetless.symmetry.detection.quasi import around
from synthetless.symmetry.quaternions import from_axis_angle, to_matrix

CONTAINED = [
    ("C1", "C4"), ("C2", "C4"), ("C3", "SO(2)"), ("C2", "O(2)"), ("D3", "O(2)"), ("SO(2)", "O(2)"), ("C2", "D2"),
    ("C3", "D6"), ("D2", "D4"), ("D2", "O"), ("T", "O"), ("C4", "O"), ("T", "T"),
]  # fmt: skip


def placed(name: str, frame: np.ndarray, offset: np.ndarray) -> SymmetryGroup:
    return SymmetryGroup.from_name(name, frame=frame, offset_mm=offset)


@settings(max_examples=60)
@given(seed=seeds, names=st.sampled_from(CONTAINED))
def test_a_group_that_was_fitted_by_itself_is_moved_around_the_exact_one(seed: int, names: tuple[str, str]) -> None:
    rng = np.random.default_rng(seed)
    frame, offset = random_rotations(rng, 1)[0], rng.uniform(-20, 20, 3)
    exact = placed(names[0], frame, offset)
    axis = rng.normal(size=3)
    slightly = to_matrix(from_axis_angle(axis / np.linalg.norm(axis), np.radians(1.0)))
    larger = placed(names[1], slightly @ frame, offset + rng.uniform(-0.3, 0.3, 3))
    moved = around(larger, exact)
    assert moved is not None and moved.name == larger.name
    assert moved.contains(exact, apart_deg=1e-5, apart_mm=1e-6)
    assert np.linalg.norm(np.subtract(moved.offset_mm, larger.offset_mm)) < 1.5


def test_groups_that_do_not_contain_the_exact_one_are_none_of_these() -> None:
    named = SymmetryGroup.from_name
    for larger, exact in (
        (named("C4"), named("C3")),
        (named("SO(2)"), named("C2", axis=(1, 0, 0))),
        (named("D4"), named("C2", axis=(1, 0.3, 0))),
        (named("O"), named("C6")),
        (named("O(2)"), named("C3", axis=(1, 0, 0))),
        (named("SO(3)"), named("C2")),
    ):
        assert around(larger, exact) is None, (larger.name, exact.name)


@pytest.fixture(scope="module")
def notched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A cylinder with a notch 2.5 mm deep, in any frame: C2 about the notch, O(2) but for it."""
    folder = tmp_path_factory.mktemp("notched")
    turned = random_rotations(np.random.default_rng(4), 1)[0]
    vertices, faces = Notched(depth_mm=2.5).mesh(3.0)
    trimesh.Trimesh(vertices @ turned.T + [5, -3, 8], faces, process=False).export(folder / "obj_000014.ply")
    return folder, turned


def test_the_notch_is_found_and_written(notched: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, turned = notched
    found = detect_folder(folder, workers=1, quasi=Tolerance.parse("3mm"))
    (o,) = found.objects
    assert o.detected.answer.group.name == "C2"
    assert o.quasi is not None and o.quasi.group.name == "O(2)"
    assert abs(float(turned[:, 2] @ np.array(o.quasi.group.axis))) > np.cos(np.radians(1))
    assert 2.3 < o.quasi.residual.max_mm < 3.0
    assert "object 14: O(2), axis" in report(found)
    found.table().write(tmp_path / "table.json")
    entry = SymmetryTable.read(tmp_path / "table.json").entries[14]
    assert entry.quasi is not None and entry.quasi.tolerance_mm == pytest.approx(3.0)
    assert entry.quasi.group.contains(entry.group)
    assert found.to_json()["objects"][0]["quasi"]["group"] == "O(2)"


def test_a_tolerance_below_the_notch_finds_none(notched: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    out = tmp_path / "table.yaml"
    arguments = ["symmetries", "detect", str(notched[0]), "--out", str(out), "--workers", "1"]
    done = CliRunner().invoke(app, [*arguments, "--quasi", "1mm"])
    assert done.exit_code == 0, done.output
    assert "object 14: no larger group within 1.000 mm" in done.output
    assert SymmetryTable.read(out).entries[14].quasi is None
    wrong = CliRunner().invoke(app, [*arguments, "--quasi", "2"])
    assert wrong.exit_code != 0
