"""The score is bop_toolkit's: errors, matching, recalls."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import golden
import numpy as np
import pytest
from embreex.rtcore import EmbreeDevice
from perturbed import CAMERA, Perturbed, build
from scipy.spatial.transform import Rotation

from synthetless.annotation.raycast import Surface
from synthetless.dataset import Dataset
from synthetless.dataset.reader import Instance
from synthetless.errors import UserError
from synthetless.io.models import load_models
from synthetless.learning.pose_error import (
    ModelPoints,
    ObjectDepth,
    RigidPose,
    bop_motions,
    silhouettes_may_overlap,
    vsd,
)
from synthetless.learning.results import Estimate, read_results, write_results
from synthetless.learning.score import SHARES, Judge, Score, match, score
from synthetless.learning.score_report import to_text, write_score_page
from synthetless.symmetry import SymmetryGroup, SymmetryTable


@pytest.fixture(scope="module")
def perturbed(tmp_path_factory: pytest.TempPathFactory, builtin_models: Path) -> Perturbed:
    return build(tmp_path_factory.mktemp("perturbed"), builtin_models)


@pytest.fixture(scope="module")
def judged(perturbed: Perturbed) -> Score:
    return score(Judge(perturbed.root), perturbed.results, workers=1)


@pytest.fixture(scope="module")
def kept() -> Any:
    return json.loads(golden.GOLDEN.read_text())


def _our_errors(perturbed: Perturbed) -> list[dict[str, Any]]:
    device = EmbreeDevice()
    surfaces = {i: Surface(device, model.vertices_mm, model.faces) for i, model in perturbed.models.items()}
    points = {i: ModelPoints(m.vertices_mm, bop_motions(m.info)) for i, m in perturbed.models.items()}
    pairs = []
    for image in Dataset.open(perturbed.root):
        depth = image.depth_mm()
        for number, estimate in enumerate(perturbed.estimates):
            for truth in image.instances:
                if (estimate.im_id, estimate.obj_id) != (image.im_id, truth.obj_id):
                    continue
                poses = RigidPose(estimate.R_m2c, estimate.t_m2c), RigidPose(truth.R_m2c, truth.t_m2c)
                diameter = perturbed.models[truth.obj_id].diameter_mm
                seen = [ObjectDepth.cast(surfaces[truth.obj_id], pose, CAMERA) for pose in poses]
                found = vsd(seen[0], seen[1], depth, CAMERA, np.append(SHARES * diameter, 20.0))
                if not silhouettes_may_overlap(diameter / 2, poses[0].t_m2c, poses[1].t_m2c):
                    found = np.ones(11)
                pairs.append(
                    {
                        "estimate": number,
                        "gt_id": truth.gt_id,
                        "vsd": found[:10].tolist(),
                        "vsd_20mm": float(found[10]),
                        "mssd": points[truth.obj_id].mssd(*poses),
                        "mspd": points[truth.obj_id].mspd(*poses, image.K),
                    }
                )
    return pairs


def _assert_equal(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> None:
    assert len(ours) == len(theirs) > 50
    for a, b in zip(ours, theirs, strict=True):
        assert (a["estimate"], a["gt_id"]) == (b["estimate"], b["gt_id"])
        assert a["vsd"] == b["vsd"]
        assert a["vsd_20mm"] == b["vsd_20mm"]
        assert a["mssd"] == pytest.approx(b["mssd"], abs=1e-9)
        assert a["mspd"] == pytest.approx(b["mspd"], abs=1e-9)


def test_errors_are_those_of_bop_toolkit(perturbed: Perturbed, kept: Any) -> None:
    _assert_equal(_our_errors(perturbed), kept["pairs"])


def test_recalls_are_those_of_bop_toolkit(judged: Score, kept: Any) -> None:
    assert judged.average_recalls == pytest.approx(kept["recalls"], abs=1e-12)
    assert 0.2 < judged.average_recall < 0.8  # near and far poses: the thresholds matter


def test_the_golden_numbers_are_still_those_of_a_checkout(perturbed: Perturbed, kept: Any) -> None:
    if golden.CHECKOUT not in os.environ:
        pytest.skip(f"no bop_toolkit: set {golden.CHECKOUT} to a checkout of https://github.com/thodan/bop_toolkit")
    said = golden.ask_toolkit(Path(os.environ[golden.CHECKOUT]), perturbed)
    _assert_equal(said["pairs"], kept["pairs"])
    assert said["recalls"] == pytest.approx(kept["recalls"], abs=1e-12)


def _visible(instance: Instance) -> float:
    """As the score of an estimate: one of a hidden instance must not stand before one that is asked for."""
    assert instance.visibility is not None
    return instance.visibility.visib_fract


@pytest.mark.parametrize("symmetries", ["models_info", "table"])
def test_the_truth_scores_one(perturbed: Perturbed, tmp_path: Path, symmetries: Any) -> None:
    truth = [
        Estimate(image.scene_id, image.im_id, n.obj_id, _visible(n), n.R_m2c, n.t_m2c)
        for image in Dataset.open(perturbed.root)
        for n in image.instances
    ]
    write_results(tmp_path / "truth.csv", truth)
    SymmetryTable.from_models_info({i: model.info for i, model in perturbed.models.items()}).write(
        perturbed.root / "symmetries.json"
    )
    found = score(Judge(perturbed.root, symmetries=symmetries), tmp_path / "truth.csv", workers=1)
    assert found.average_recalls == {"vsd": 1, "mssd": 1, "mspd": 1, "paper": 1}
    assert all(set(row.recalls.values()) == {1.0} for row in found.rows())


def test_canonical_poses_score_as_the_truth(valid: Path, tmp_path: Path) -> None:
    estimates = [
        Estimate(image.scene_id, image.im_id, n.obj_id, 1.0, n.label.R_m2c, n.label.t_m2c)
        for image in Dataset.open(valid)
        for n in image.instances
        if n.label is not None
    ]
    write_results(tmp_path / "labels.csv", estimates)
    found = score(Judge(valid), tmp_path / "labels.csv", workers=1)
    assert found.average_recall > 0.99
    groups = {row.group for row in found.rows()}
    assert groups == {"object", "margin", "elevation", "visible"}
    assert sum(row.targets for row in found.rows() if row.group == "elevation") == len(found.targets)


def test_a_true_z_heals_a_wrong_distance_alone(perturbed: Perturbed, tmp_path: Path) -> None:
    far = [
        Estimate(image.scene_id, image.im_id, n.obj_id, _visible(n), n.R_m2c, 1.3 * n.t_m2c)
        for image in Dataset.open(perturbed.root)
        for n in image.instances
    ]
    write_results(tmp_path / "far.csv", far)
    as_is, moved = (
        score(Judge(perturbed.root, errors=("vsd", "mssd"), true_z=z), tmp_path / "far.csv", 1) for z in (False, True)
    )
    assert as_is.average_recall < 0.1
    assert moved.average_recall == 1.0


def test_without_a_depth_image_the_models_stand_for_the_scene(perturbed: Perturbed, judged: Score) -> None:
    found = score(Judge(perturbed.root, errors=("vsd",), depth="models"), perturbed.results, workers=1)
    assert found.average_recalls["vsd"] == pytest.approx(judged.average_recalls["vsd"], abs=0.02)


def test_several_processes_come_to_the_same_score(perturbed: Perturbed, judged: Score, monkeypatch: Any) -> None:
    monkeypatch.setattr("synthetless.learning.score._IMAGES_PER_TASK", 1)
    assert score(Judge(perturbed.root), perturbed.results, workers=2).to_json() == judged.to_json()


def test_each_estimate_takes_one_pose_the_surest_first() -> None:
    errors = np.array([[0.2, 0.1], [0.15, 0.05], [0.01, 0.3]])
    assert match(errors, np.array([0.12, 0.16, 0.005])).tolist() == [[True, True, False], [True, True, False]]
    assert match(errors[:2], np.array([0.12])).tolist() == [[False], [True]]
    assert match(np.empty((0, 3)), np.array([0.5])).tolist() == [[False]] * 3
    assert not match(np.array([[0.3]]), np.array([0.3])).any()  # below, not at


@pytest.mark.parametrize("name", ["C1", "C4", "D3", "SO(2)"])
def test_all_symmetries_and_all_vertices_give_the_same_errors(name: str) -> None:
    """Against the definitions, symmetry by symmetry and vertex by vertex."""
    rng = np.random.default_rng(3)
    motions = SymmetryGroup.from_name(name, offset_mm=(3, -2, 5)).motions(40)
    points = ModelPoints(rng.uniform(-40, 40, (300, 3)), motions)
    K = np.array([[600.0, 0, 320], [0, 590, 240], [0, 0, 1]])
    for _ in range(5):
        a, b = (
            RigidPose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-9, 9, 3) + np.array([0, 0, 500]))
            for _ in "ab"
        )
        slow_mssd, slow_mspd = np.inf, np.inf
        for motion in motions:
            moved = points.vertices_mm @ motion[:3, :3].T + motion[:3, 3]
            p, q = points.vertices_mm @ a.R_m2c.T + a.t_m2c, moved @ b.R_m2c.T + b.t_m2c
            slow_mssd = min(slow_mssd, np.linalg.norm(p - q, axis=1).max())
            p, q = p @ K.T, q @ K.T
            slow_mspd = min(slow_mspd, np.linalg.norm(p[:, :2] / p[:, 2:] - q[:, :2] / q[:, 2:], axis=1).max())
        assert points.mssd(a, b) == pytest.approx(slow_mssd, abs=1e-9)
        assert points.mspd(a, b, K) == pytest.approx(slow_mspd, abs=1e-9)


def test_a_pose_at_or_behind_the_camera_is_a_miss(perturbed: Perturbed, tmp_path: Path) -> None:
    first = perturbed.estimates[0]
    poses = [replace(first, t_m2c=np.array(t)) for t in ([0.0, 0, 0], [0.0, 0, -500], [1e7, 0, 1])]
    write_results(tmp_path / "behind.csv", poses)
    assert score(Judge(perturbed.root), tmp_path / "behind.csv", 1).average_recall == 0


def test_the_page_and_the_table_say_the_same(judged: Score, tmp_path: Path) -> None:
    write_score_page(judged, tmp_path / "score.html")
    page, table = (tmp_path / "score.html").read_text(), to_text(judged)
    for number in (f"{judged.average_recall:.1%}", f"{judged.average_recalls['paper']:.1%}"):
        assert number in page
        assert number in table
    assert page.count("<svg") == 3
    write_score_page(judged, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == (tmp_path / "score.html").read_bytes()


def test_results_are_read_back_to_the_last_bit(perturbed: Perturbed) -> None:
    for a, b in zip(read_results(perturbed.results), perturbed.estimates, strict=True):
        assert (a.scene_id, a.im_id, a.obj_id, a.score, a.time_s) == (b.scene_id, b.im_id, b.obj_id, b.score, b.time_s)
        assert (a.R_m2c == b.R_m2c).all()
        assert (a.t_m2c == b.t_m2c).all()


ROW = "1,0,5,0.5,1 0 0 0 1 0 0 0 1,0 0 500,-1"
DAMAGES: list[tuple[str, Callable[[str], str], str]] = [
    ("a field is missing", lambda _: "1,0,5,0.5,1 0 0 0 1 0 0 0 1,0 0 500", "row 3: has 6 fields"),
    ("cut off", lambda _: ROW[:24], "row 3: has 5 fields"),
    ("a word for a number", lambda _: ROW.replace("0.5", "high"), "row 3: score is 'high'"),
    ("no whole number", lambda _: ROW.replace("1,0,5", "1,0.5,5"), "row 3: im_id is '0.5', not a whole number"),
    ("not finite", lambda _: ROW.replace("500", "nan"), "row 3: t is 'nan', not a finite number"),
    ("eight numbers", lambda _: ROW.replace("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0"), "row 3: R has 8 numbers, not 9"),
    ("a reflection", lambda _: ROW.replace("0 0 1,", "0 0 -1,"), "row 3: R is no rotation"),
    ("an unknown scene", lambda _: ROW.replace("1,0,5", "7,0,5"), "row 3: image 0 of scene 7 is not in"),
    ("an unknown image", lambda _: ROW.replace("1,0,5", "1,99,5"), "row 3: image 99 of scene 1 is not in"),
    ("an unknown object", lambda _: ROW.replace("1,0,5", "1,0,6"), "row 3: object 6 is not among the models"),
    (
        "two times",
        lambda _: ROW.replace(",-1", ",0.5") + "\n" + ROW.replace(",-1", ",0.9"),
        "row 4: time is 0.9, but 0.5",
    ),
]


@pytest.mark.parametrize(("change", "said"), [d[1:] for d in DAMAGES], ids=[d[0] for d in DAMAGES])
def test_damage_is_named_by_its_row(
    perturbed: Perturbed, tmp_path: Path, change: Callable[[str], str], said: str
) -> None:
    path = tmp_path / "damaged.csv"
    path.write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{ROW}\n{change(ROW)}\n")
    with pytest.raises(UserError) as caught:
        score(Judge(perturbed.root), path, workers=1)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none(perturbed: Perturbed, tmp_path: Path) -> None:
    for content, said in ((b"", "is empty"), (b"\xff\xfe\x00", "is no text"), (b"hello\n", "row 1: has 1 fields")):
        (tmp_path / "none.csv").write_bytes(content)
        with pytest.raises(UserError, match=said):
            score(Judge(perturbed.root), tmp_path / "none.csv")
    with pytest.raises(UserError, match="not found"):
        score(Judge(perturbed.root), tmp_path / "absent.csv")


def test_nothing_found_scores_nothing(perturbed: Perturbed, tmp_path: Path) -> None:
    write_results(tmp_path / "nothing.csv", [])
    found = score(Judge(perturbed.root), tmp_path / "nothing.csv", workers=1)
    assert found.average_recall == 0
    assert len(found.targets) > 20


def test_the_score_runs_without_torch(perturbed: Perturbed) -> None:
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] == 'torch': raise ImportError(name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from synthetless.cli.app import main\n"
        f"sys.argv = ['synthetless', 'score', {str(perturbed.root)!r}, {str(perturbed.results)!r}, '--json', "
        "'--errors', 'mssd', '--workers', '1']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["average_recalls"].keys() == {"mssd"}


def test_models_of_many_vertices_are_judged_in_time_as_well(tless_models: Path) -> None:
    """Object 1 has 42,134 vertices and 315 symmetries: only a few of them may be projected in full."""
    model = load_models(tless_models, (1,))[1]
    points = ModelPoints(model.vertices_mm, bop_motions(model.info))
    assert len(points.motions) == 315
    rng = np.random.default_rng(0)
    truth = RigidPose(Rotation.random(random_state=rng).as_matrix(), np.array([20.0, 10.0, 700.0]))
    near = RigidPose(truth.R_m2c @ Rotation.from_rotvec([0.1, 0.05, 2]).as_matrix(), truth.t_m2c + np.array([2, -1, 9]))
    K = np.array([[1076.0, 0, 360], [0, 1075, 270], [0, 0, 1]])
    few = ModelPoints(model.vertices_mm[::50], points.motions)
    assert few.mspd(near, truth, K) <= points.mspd(near, truth, K) + 1e-12
    assert few.mssd(near, truth) <= points.mssd(near, truth) + 1e-12
