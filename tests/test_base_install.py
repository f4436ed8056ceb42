"""What the base install does, by its commands, in a folder of its own: neither Blender nor any extra is needed for it.

`.ci/wheel` runs it, too, where nothing else is installed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from synthetless.symmetry import SymmetryGroup

POSES = 6


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    """A BOP dataset of one object in random poses, without images; its models folder is still to be written."""
    scene = tmp_path / "bop" / "train_pbr" / "000000"
    scene.mkdir(parents=True)
    (tmp_path / "cad").mkdir()
    trimesh.creation.box((60, 40, 20)).export(tmp_path / "cad" / "obj_000001.stl")
    rotations = Rotation.random(POSES, random_state=0).as_matrix()
    gt = {
        str(im_id): [{"obj_id": 1, "cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": [10.0, -20.0, 700.0]}]
        for im_id, R in enumerate(rotations)
    }
    camera = {"cam_K": [1075.0, 0.0, 199.5, 0.0, 1075.0, 199.5, 0.0, 0.0, 1.0], "depth_scale": 0.1}
    (scene / "scene_gt.json").write_text(json.dumps(gt))
    (scene / "scene_camera.json").write_text(json.dumps(dict.fromkeys(gt, camera)))
    return tmp_path / "bop"


def _run(folder: Path, *arguments: str, code: int = 0) -> str:
    command = [sys.executable, "-m", "synthetless", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_detect_adopt_validate(bop: Path, tmp_path: Path) -> None:
    found = json.loads(_run(tmp_path, "symmetries", "detect", "cad", "--models-out", "bop/models", "--json"))
    assert [each["group"] for each in found["objects"]] == ["D2"]
    adopted = json.loads(_run(tmp_path, "adopt", "bop", "--scheme", "atlas", "--json"))
    assert (adopted["instances"], adopted["written"], adopted["table"]["scheme"]) == (POSES, 1, "atlas")
    assert "D2" in _run(tmp_path, "symmetries", "show", "bop")
    report = json.loads(_run(tmp_path, "validate", "bop", "--json"))
    assert (report["valid"], report["instances"]) == (True, POSES)
    (bop / "train_pbr" / "000000" / "scene_gt_canonical.json").write_text("{}")
    _run(tmp_path, "validate", "bop", code=1)


def test_labels_of_poses() -> None:
    from synthetless.symmetry import CanonicalMap

    label = CanonicalMap(SymmetryGroup.from_name("C2", axis=(0, 0, 1)), scheme="pitteri2019")
    half_turn = np.diag([-1.0, -1.0, 1.0])
    poses = label(np.stack([np.eye(3), half_turn]), np.array([[0.0, 0.0, 500.0]] * 2))
    np.testing.assert_allclose(poses.R_m2c[0], poses.R_m2c[1], atol=1e-12)


def test_recipes_are_in_the_package(tmp_path: Path) -> None:
    assert "demo" in json.loads(_run(tmp_path, "recipes", "--json"))
    _run(tmp_path, "recipes", "--copy", "demo")
    assert (tmp_path / "demo.yaml").read_text().startswith("# ")
