"""What the base install does, by its commands, in a folder of its own: neither Blender nor any extra is needed for it.

`.ci/wheel` runs it, too, where nothing else is installed.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from synthetless.config import BUILTIN_MODELS
from synthetless.symmetry import SymmetryGroup

OBJECTS = (5, 21)


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    """A BOP dataset of two built-in parts in random poses, without images."""
    scene, models = tmp_path / "bop" / "train_pbr" / "000000", tmp_path / "bop" / "models"
    scene.mkdir(parents=True)
    models.mkdir()
    infos = json.loads((BUILTIN_MODELS / "models_info.json").read_text())
    (models / "models_info.json").write_text(json.dumps({str(obj_id): infos[str(obj_id)] for obj_id in OBJECTS}))
    for obj_id in OBJECTS:
        shutil.copy(BUILTIN_MODELS / f"obj_{obj_id:06d}.ply", models)
    rng = np.random.default_rng(0)
    poses = {
        str(im_id): [
            {
                "obj_id": obj_id,
                "cam_R_m2c": np.linalg.qr(rng.normal(size=(3, 3)))[0].ravel().tolist(),
                "cam_t_m2c": [*rng.uniform(-50, 50, 2).tolist(), 700.0],
            }
            for obj_id in OBJECTS
        ]
        for im_id in range(3)
    }
    for entry in (entry for entries in poses.values() for entry in entries):
        R = np.reshape(entry["cam_R_m2c"], (3, 3))
        entry["cam_R_m2c"] = (R * np.sign(np.linalg.det(R))).ravel().tolist()
    camera = {"cam_K": [1075.0, 0.0, 199.5, 0.0, 1075.0, 199.5, 0.0, 0.0, 1.0], "depth_scale": 0.1}
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    (scene / "scene_camera.json").write_text(json.dumps(dict.fromkeys(poses, camera)))
    return tmp_path / "bop"


def _run(folder: Path, *arguments: str, code: int = 0) -> str:
    command = [sys.executable, "-m", "synthetless", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout


def test_detect_adopt_validate_relabel(bop: Path, tmp_path: Path) -> None:
    found = json.loads(_run(tmp_path, "symmetries", "detect", "bop/models", "--out", "table.yaml", "--json"))
    assert [each["group"] for each in found["objects"]] == ["C2", "C1"]
    adopted = json.loads(_run(tmp_path, "adopt", "bop", "--symmetries", "table.yaml", "--json"))
    assert (adopted["instances"], adopted["written"], adopted["table"]["scheme"]) == (6, 1, "pitteri2019")
    report = json.loads(_run(tmp_path, "validate", "bop", "--json"))
    assert (report["valid"], report["instances"]) == (True, 6)
    assert "regressor" in _run(tmp_path, "symmetries", "show", "bop")
    again = json.loads(_run(tmp_path, "adopt", "bop", "--scheme", "atlas", "--json"))
    assert again["table"]["objects"]["5"]["n_regressors"] == 4
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
