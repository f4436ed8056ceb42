"""Models moved to where every reader finds their axis, and poses carried between both frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from synthetless.cli.commands import app
from synthetless.errors import UserError
from synthetless.io.meshes import read_mesh
from synthetless.learning.results import Estimate, read_results, write_results
from synthetless.symmetry import SymmetryGroup, SymmetryTable
from synthetless.symmetry.detection import DetectedFolder, detect_folder
from synthetless.symmetry.recentring import Recentring, read_recentrings

NAMES = ("C1", "C2", "C5", "D2", "D3", "T", "O", "I", "SO(2)", "O(2)", "SO(3)")
PLACED = trimesh.transformations.euler_matrix(0.4, 1.0, -0.3)
PLACED[:3, 3] = (12, -7, 30)

seeds = st.integers(0, 2**32 - 1)


def _placed(name: str, rng: np.random.Generator) -> SymmetryGroup:
    """A group anywhere."""
    frame = Rotation.random(random_state=rng).as_matrix()
    return SymmetryGroup.from_name(name, frame=frame, offset_mm=rng.uniform(-50, 50, 3))


@given(st.sampled_from(NAMES), seeds)
def test_a_group_comes_to_stand_in_the_standard_frame(name: str, seed: int) -> None:
    group = _placed(name, np.random.default_rng(seed))
    motion = Recentring.of(group)
    standard = SymmetryGroup(name)
    assert standard.contains(motion.group(group), 1e-5, 1e-9)
    moved = motion.group(group)
    assert np.allclose(moved.offset_mm, 0, atol=1e-12)
    if moved.axis is not None:
        assert np.allclose(moved.axis, [0, 0, 1], atol=1e-14)


@given(st.sampled_from(NAMES), seeds)
def test_poses_come_back(name: str, seed: int) -> None:
    """To float precision; and both poses put the same point of the part at the same place."""
    rng = np.random.default_rng(seed)
    motion = Recentring.of(_placed(name, rng))
    R, t, points = (
        Rotation.random(random_state=rng).as_matrix(),
        rng.uniform(-900, 900, 3),
        rng.uniform(-60, 60, (9, 3)),
    )
    R_new, t_new = motion.pose_recentred(R, t)
    assert np.allclose(points @ R.T + t, motion.points(points) @ R_new.T + t_new, atol=1e-11)
    R_back, t_back = motion.pose_back(R_new, t_new)
    assert np.abs(R_back - R).max() < 2e-15
    assert np.abs(t_back - t).max() < 1e-12


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory) -> DetectedFolder:
    """A cone anywhere."""
    folder = tmp_path_factory.mktemp("cad")
    trimesh.creation.cone(radius=15, height=40, sections=32).apply_transform(PLACED).export(folder / "obj_000001.ply")
    return detect_folder(folder, workers=1)


def test_recentred_models_have_their_axes_at_z(detected: DetectedFolder, tmp_path: Path) -> None:
    detected.write_models(tmp_path / "models", recentred=True)
    infos = json.loads((tmp_path / "models" / "models_info.json").read_text())
    assert infos["1"]["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    motions = read_recentrings(tmp_path / "models")
    for o in detected.objects:
        given, written = read_mesh(o.path), read_mesh(tmp_path / "models" / f"obj_{o.obj_id:06d}.ply")
        assert np.array_equal(motions[o.obj_id].points(given.vertices_mm), written.vertices_mm)
        assert np.allclose(infos[str(o.obj_id)]["diameter"], given.diameter_mm)
        turned = written.vertices_mm @ Rotation.from_euler("z", 360 / 32, degrees=True).as_matrix().T
        assert cKDTree(written.vertices_mm).query(turned)[0].max() < 1e-2  # as well as the axis was found
    assert detected.off_axis == (1,)
    table = detected.table(recentred=True)
    assert table.entries[1].group == SymmetryTable.read(tmp_path / "models" / "models_info.json").entries[1].group


def test_a_model_without_symmetry_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "cad").mkdir()
    wedge = trimesh.Trimesh(
        [[0, 0, 0], [30, 0, 0], [0, 20, 0], [0, 0, 10]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    wedge.export(tmp_path / "cad" / "b.ply")
    detect_folder(tmp_path / "cad", workers=1).write_models(tmp_path / "m", recentred=True)
    assert (tmp_path / "m" / "obj_000001.ply").read_bytes() == (tmp_path / "cad" / "b.ply").read_bytes()
    assert read_recentrings(tmp_path / "m")[1].is_none


def test_the_command_says_who_refuses_and_carries_poses_back(
    detected: DetectedFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("synthetless.symmetry.detection.detect_folder", lambda *_: detected)  # it takes seconds
    run = CliRunner().invoke
    detect = ["symmetries", "detect", str(detected.folder), "--workers", "1", "--models-out"]
    told = run(app, [*detect, str(tmp_path / "plain")])
    assert told.exit_code == 0
    assert "object 1. happypose refuses this models_info.json" in " ".join(told.output.split())
    told = run(app, [*detect, str(tmp_path / "models"), "--recentre", "--out", str(tmp_path / "table.yaml")])
    assert told.exit_code == 0
    assert "happypose" not in told.output
    assert SymmetryTable.read(tmp_path / "table.yaml").entries[1].group == SymmetryGroup("SO(2)")

    motion = read_recentrings(tmp_path / "models")[1]
    R, t = Rotation.from_euler("xyz", [0.2, -1, 2]).as_matrix(), np.array([10.0, -20, 700])
    write_results(tmp_path / "poses.csv", [Estimate(1, 2, 1, 0.5, *motion.pose_recentred(R, t))])
    back = ["symmetries", "carry-back", str(tmp_path / "poses.csv"), "--models", str(tmp_path / "models")]
    assert run(app, [*back, "--to", str(tmp_path / "back.csv")]).exit_code == 0
    (pose,) = read_results(tmp_path / "back.csv")
    assert (pose.scene_id, pose.im_id, pose.obj_id, pose.score) == (1, 2, 1, 0.5)
    assert np.allclose(pose.R_m2c, R, atol=1e-14)
    assert np.allclose(pose.t_m2c, t, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "not a mapping of object ids"),
        ('{"1": 5}', "object 1: is 5; R with 9 numbers and t_mm with 3 are needed"),
        ('{"1": {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t_mm": [0, 0]}}', "R with 9 numbers and t_mm with 3"),
        ('{"1": {"R": [1, 0, 0, 0, 1, 0, 0, 0, -1], "t_mm": [0, 0, 0]}}', "object 1: R"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "recentred.json").write_text(text)
    with pytest.raises(UserError, match=message):
        read_recentrings(tmp_path)
    with pytest.raises(UserError, match="not found; symmetries detect --recentre writes it"):
        read_recentrings(tmp_path / "elsewhere")


def test_recentring_needs_models_to_write(detected: DetectedFolder) -> None:
    told = CliRunner().invoke(app, ["symmetries", "detect", str(detected.folder), "--recentre"])
    assert isinstance(told.exception, SystemExit)
    assert told.exit_code == 2
