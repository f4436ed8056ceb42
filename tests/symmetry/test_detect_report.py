"""What is said of a table is true of the labels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from symmetry_cases import random_rotations

from synthetless.symmetry import CanonicalMap, SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection.report import DANGEROUS_DEG, dangerous_views, describe, direction_text
from synthetless.symmetry.table import SymmetryEntry

UPRIGHT_FROM_THE_SIDE = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))


def dangerous_poses(entry: SymmetryEntry, n: int = 40_000) -> np.ndarray:
    R = random_rotations(np.random.default_rng(0), n)
    margins = entry.canonical_map("pitteri2019")(R, np.tile([0.0, 0.0, 500.0], (n, 1))).discontinuity_margin_deg
    return R[margins < DANGEROUS_DEG]


@pytest.mark.parametrize("n", [2, 3, 6])
def test_cyclic_groups_are_dangerous_near_the_named_view_only(n: int) -> None:
    entry = SymmetryEntry(SymmetryGroup.from_name(f"C{n}"))
    text = dangerous_views(entry)
    assert text.startswith("where +z points towards the camera, the part seen straight onto its +z end; within ")
    said_deg = float(text.split("within ")[1].split()[0])
    away_deg = np.degrees(np.arccos(np.clip(-dangerous_poses(entry)[:, 2, 2], -1, 1)))
    assert said_deg - 3 < away_deg.max() < said_deg + 0.6


def test_many_fold_axes_are_dangerous_everywhere() -> None:
    assert "every other view too" in dangerous_views(SymmetryEntry(SymmetryGroup.from_name("C24")))


def test_a_reference_rotation_moves_the_dangerous_view() -> None:
    entry = SymmetryEntry(SymmetryGroup.from_name("SO(2)"), UPRIGHT_FROM_THE_SIDE)
    assert "where +z points down in the image; within 5 degrees" in dangerous_views(entry)
    axes = dangerous_poses(entry)[:, :, 2]
    assert (axes[:, 1] > np.cos(np.radians(DANGEROUS_DEG + 0.1))).all()


def test_o2_is_dangerous_across_both_of_its_references() -> None:
    entry = SymmetryEntry(SymmetryGroup.from_name("O(2)"))
    assert dangerous_views(entry).startswith("where +z points to the right in the image or opposite")
    axes = dangerous_poses(entry)[:, :, 2]
    assert (np.abs(axes[:, 0]) > np.cos(np.radians(1.5 * DANGEROUS_DEG))).all()


@pytest.mark.parametrize("n", [2, 3, 6])
def test_dihedral_groups_name_the_tilts(n: int) -> None:
    entry = SymmetryEntry(SymmetryGroup.from_name(f"D{n}"))
    text = dangerous_views(entry)
    low, high = (float(part.split()[k]) for part, k in zip(text.split(" to ")[:2], (-1, 0), strict=True))
    tilts = np.degrees(np.arccos(dangerous_poses(entry)[:, 2, 2]))
    assert low - 3 < tilts.min() < low + 3
    assert high - 3 < tilts.max() < high + 3


@pytest.mark.parametrize("name", ["C1", "SO(3)", "T"])
def test_groups_without_danger(name: str) -> None:
    assert dangerous_views(SymmetryEntry(SymmetryGroup.from_name(name))) == "none"
    R = random_rotations(np.random.default_rng(1), 5000)
    margins = CanonicalMap(SymmetryGroup.from_name(name))(R, np.tile([0, 0, 500.0], (len(R), 1)))
    assert margins.discontinuity_margin_deg.min() > DANGEROUS_DEG


def test_directions_in_words() -> None:
    assert direction_text(np.array([0.0, 0.0, -1.0])) == "towards the camera"
    assert direction_text(np.array([0.0, -1.0, 0.0])) == "up in the image"
    assert direction_text(np.array([0.6, 0.0, 0.8])) == "along (0.60 0.00 0.80) (x right, y down, z forward)"


def test_a_table_in_lines(builtin_models: Path) -> None:
    text = describe(SymmetryTable.read(builtin_models))
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert rows["27"] == ["27", "C4", "4", "z", "origin", "2", "0.00", "4", "15.86"]
    assert rows["26"][4:7] == ["(-7", "0", "0)"]
    assert "objects 18, 21-22, C1: none" in text
    assert max(map(len, text.splitlines())) <= 100


def test_tables_are_found_where_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds neither symmetries\.json nor models_info\.json"):
        SymmetryTable.read(tmp_path)
    fields = SymmetryGroup.from_name("C2").to_bop()
    (tmp_path / "models_info.json").write_text(json.dumps({"5": {"diameter": 10.0, "name": "knob", **fields}}))
    assert SymmetryTable.read(tmp_path).entries[5].group.name == "C2"
    SymmetryTable({1: SymmetryEntry(SymmetryGroup.from_name("O"))}).write(tmp_path / "symmetries.json")
    assert list(SymmetryTable.read(tmp_path).entries) == [1]
    (tmp_path / "hand.yaml").write_text("object 3: {group: C3, axis: [0, 0, 0]}")
    with pytest.raises(ValueError, match=r"hand\.yaml: object 3: .*axis is zero"):
        SymmetryTable.read(tmp_path / "hand.yaml")
