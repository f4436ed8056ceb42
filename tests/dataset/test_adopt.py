"""Adoption: labels beside somebody else's files, and not a byte of theirs changed."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from posed import random_camera, random_poses
from scipy.spatial.transform import Rotation
from trees import contents

from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import read_scene_json, write_scene_json
from synthetless.dataset.relabel import adopt
from synthetless.errors import UserError
from synthetless.io.models import read_models_info
from synthetless.symmetry import SymmetryGroup, SymmetryTable

SCENES = {"train_primesense": (5, 26), "test_primesense": (1,), "train_pbr": (0, 1)}
LABELS = {f"{split}/{scene:06d}/scene_gt_canonical.json" for split, scenes in SCENES.items() for scene in scenes}
OBJECTS = (2, 5, 18, 25, 26, 27, 30)


@pytest.fixture
def bop(tless_models: Path, tmp_path: Path) -> Path:
    """T-LESS as BOP lays it out, with random poses; training images of one object each, the others of many."""
    root, rng = tmp_path / "tless", np.random.default_rng(0)
    for split, scenes in SCENES.items():
        for scene_id in scenes:
            scene = ScenePaths.of(root, scene_id, split)
            objects = [scene_id] if split == "train_primesense" else list(OBJECTS)
            gt = {im_id: random_poses(rng, objects, 1 if len(objects) == 1 else 6) for im_id in range(4)}
            write_scene_json(scene.scene_gt, gt)
            write_scene_json(scene.scene_camera, {im_id: {"cam_K": random_camera(rng)["cam_K"]} for im_id in gt})
            scene.rgb(0).parent.mkdir()
            scene.rgb(0).write_bytes(b"a picture")
    (root / "test_primesense" / "000002").mkdir()
    (root / "test_primesense" / "000002" / "scene_camera.json").write_text("{}")
    (root / "models_cad").mkdir()
    for name in ("models_info.json", "obj_000026.ply"):
        shutil.copy(tless_models / name, root / "models_cad" / name)
    (root / "dataset_info.md").write_text("T-LESS")
    return root


@pytest.mark.tless
def test_labels_lie_beside_files_that_stay_as_they_are(bop: Path) -> None:
    before = contents(bop)
    adoption = adopt(bop, workers=1)
    after = contents(bop)
    assert after.keys() - before.keys() == {*LABELS, "symmetries.json"}
    assert {name: after[name] for name in before} == before
    assert adoption.models == bop / "models_cad"
    assert adoption.splits == ("test_primesense", "train_pbr", "train_primesense")
    assert str(adoption).startswith("80 instances in 20 images of test_primesense, train_pbr, train_primesense, scheme")
    assert (adoption.scenes, adoption.images, adoption.instances, adoption.written) == (5, 20, 2 * 4 + 3 * 4 * 6, 5)


@pytest.mark.tless
def test_labels_follow_from_the_declared_symmetries(bop: Path, tless_models: Path) -> None:
    adopt(bop, workers=1)
    infos = read_models_info(tless_models)
    table = SymmetryTable.from_models_info(infos)
    assert SymmetryTable.read(bop / "symmetries.json").digest() == table.digest()
    for scene in _scenes(bop):
        gt, camera = read_scene_json(scene.scene_gt), read_scene_json(scene.scene_camera)
        assert read_scene_json(scene.scene_gt_canonical) == label_scene(gt, camera, table, infos)


@pytest.mark.tless
def test_look_alikes_share_a_label(bop: Path) -> None:
    """T-LESS 26 looks the same after a half turn about its axis through (-7, 0, 0), so it is labelled the same."""
    adopt(bop, workers=1)
    scene = ScenePaths.of(bop, 26, "train_primesense")
    labels = read_scene_json(scene.scene_gt_canonical)
    gt = read_scene_json(scene.scene_gt)
    half_turn, shift = np.diag([-1.0, -1.0, 1.0]), np.array([-14.0, 0.0, 0.0])
    for entries in gt.values():
        for pose in entries:
            R, t = np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"])
            pose |= {"cam_R_m2c": (R @ half_turn).ravel().tolist(), "cam_t_m2c": (R @ shift + t).tolist()}
    write_scene_json(scene.scene_gt, gt)
    adopt(bop, workers=1)
    for im_id, entries in read_scene_json(scene.scene_gt_canonical).items():
        for label, before in zip(entries, labels[im_id], strict=True):
            assert label["regressor_index"] == before["regressor_index"]
            for name in ("cam_R_m2c_canonical", "cam_t_m2c_canonical", "bbox3d_corners_2d"):
                assert_allclose(label[name], before[name], atol=1e-6)


@pytest.mark.tless
def test_the_same_again_changes_nothing_and_another_table_relabels(bop: Path, tmp_path: Path) -> None:
    adopt(bop, workers=1)
    first = contents(bop)
    times = {path: path.stat().st_mtime_ns for path in bop.rglob("scene_*.json")}
    assert adopt(bop, workers=2).written == 0
    assert contents(bop) == first
    assert times == {path: path.stat().st_mtime_ns for path in times}

    table = tmp_path / "table.yaml"
    table.write_text("scheme: atlas\n26: C1")
    adoption = adopt(bop, symmetries=table, workers=1)
    assert (adoption.table.scheme, adoption.table.entries[26].group.name) == ("atlas", "C1")
    assert adoption.table.entries[27].group.name == "C4", "what the table does not name stays as declared"
    second = contents(bop)
    assert {name for name in first if first[name] != second[name]} == {*LABELS, "symmetries.json"}
    labels = read_scene_json(ScenePaths.of(bop, 26, "train_primesense").scene_gt_canonical)
    assert {label["n_regressors"] for entries in labels.values() for label in entries} == {1}

    adopt(bop, workers=1)
    assert contents(bop) == first


@pytest.mark.tless
def test_a_link_to_another_disk_is_followed(bop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Renaming does not reach across disks; whole files must arrive all the same."""
    adopt(bop, workers=1)
    expected = contents(bop)
    for name in LABELS:
        (bop / name).unlink()
    rename = Path.replace

    def within_one_disk(path: Path, target: Path) -> Path:
        if path.name == target.name == "scene_gt_canonical.json":
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", within_one_disk)
    adopt(bop, workers=1)
    assert contents(bop) == expected


@pytest.mark.tless
def test_models_may_lie_elsewhere(bop: Path, tmp_path: Path) -> None:
    (bop / "models_cad").rename(tmp_path / "elsewhere")
    _assert_refused(
        bop, lambda: adopt(bop, workers=1), r"holds no models_info\.json in models, models_cad, models_eval"
    )
    assert adopt(bop, models=tmp_path / "elsewhere", workers=1).scenes == 5
    (tmp_path / "elsewhere").rename(bop / "models_eval")
    assert adopt(bop, workers=1).written == 0


LINEMOD_HALF_TURN = [
    *(-0.999633, 0.026679, 0.00479336, -0.262139, -0.0266744, -0.999644, 0.00100504, -0.197966),
    *(0.00481847, 0.000876831, 0.999988, 0.0321652, 0, 0, 0, 1),
]


def _euler_grid(step_deg: int) -> np.ndarray:
    """(N, 3, 3) rotations at which labels are tied."""
    angles = np.stack(np.meshgrid(*[np.arange(0, 360, step_deg)] * 3), axis=-1).reshape(-1, 3)
    return Rotation.from_euler("ZXZ", angles, degrees=True).as_matrix()


def _lay_out(root: Path, models_info: dict[str, object], rotations: np.ndarray, obj_id: int = 10) -> ScenePaths:
    """A dataset of one scene folder, an image for each rotation."""
    scene = ScenePaths.of(root, 2, "test")
    camera = random_camera(np.random.default_rng(0))
    gt = {
        im_id: [{"obj_id": obj_id, "cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": [0.0, 0.0, 700.0]}]
        for im_id, R in enumerate(rotations)
    }
    write_scene_json(scene.scene_gt, gt)
    write_scene_json(scene.scene_camera, {im_id: {"cam_K": camera["cam_K"]} for im_id in gt})
    (root / "models").mkdir()
    (root / "models" / "models_info.json").write_text(json.dumps(models_info))
    return scene


def _info(**fields: object) -> dict[str, object]:
    box = {f"{what}_{axis}": {"min": -30, "size": 60}[what] for what in ("min", "size") for axis in "xyz"}
    return {"diameter": 100.0, **box, **fields}


def test_linemod_is_adopted_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    infos = {"10": _info(symmetries_discrete=[LINEMOD_HALF_TURN])}
    _lay_out(tmp_path, infos, _euler_grid(60))
    assert adopt(tmp_path, workers=1).table.entries[10].group.name == "C2"
    assert "object 10: symmetries_discrete are up to 1.53 degrees off C2" in caplog.text


def test_an_object_that_is_named_or_does_not_occur_is_not_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    reflection = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]]
    broken, snapped = _info(symmetries_discrete=reflection), _info(symmetries_discrete=[LINEMOD_HALF_TURN])
    scene = _lay_out(tmp_path, {"10": snapped, "11": broken, "12": broken}, _euler_grid(60), obj_id=11)
    with pytest.raises(UserError, match=r"models_info\.json: object 11: .*reflection.*--symmetries"):
        adopt(tmp_path, workers=1)
    assert not scene.scene_gt_canonical.exists()
    caplog.clear()
    table = tmp_path / "table.yaml"
    table.write_text("10: C1\n11: {group: C3}")
    adoption = adopt(tmp_path, symmetries=table, workers=1)
    assert {obj_id: entry.group.name for obj_id, entry in adoption.table.entries.items()} == {10: "C1", 11: "C3"}
    assert not caplog.messages


@pytest.mark.parametrize("decimals", [4, 6, 8])
def test_look_alikes_of_a_file_with_few_decimals_share_labels(tmp_path: Path, decimals: int) -> None:
    """The precision is found in the poses, recorded beside the labels, and used by whoever recomputes them."""
    group = SymmetryGroup.from_name("C3")
    grid = _euler_grid(45)
    rotations = np.concatenate([grid, grid @ group.motions()[1][:3, :3]]).round(decimals)
    infos = {"10": _info(**group.to_bop())}
    scene = _lay_out(tmp_path, infos, rotations)
    adopt(tmp_path, workers=1)
    assert json.loads((tmp_path / "symmetries.json").read_text())["decimals"] == decimals
    labels = [entries[0] for entries in read_scene_json(scene.scene_gt_canonical).values()]
    for one, other in zip(labels[: len(grid)], labels[len(grid) :], strict=True):
        assert one["regressor_index"] == other["regressor_index"]
        assert_allclose(one["cam_R_m2c_canonical"], other["cam_R_m2c_canonical"], atol=10 * 10.0**-decimals)
    assert adopt(tmp_path, workers=1).written == 0


def _cut(bop: Path, name: str) -> None:
    (bop / name).write_bytes((bop / name).read_bytes()[:-30])


def _unknown_object(bop: Path) -> None:
    path = bop / "train_pbr" / "000001" / "scene_gt.json"
    path.write_text(path.read_text().replace('"obj_id": 25', '"obj_id": 31', 1))


def _reflection(bop: Path) -> None:
    path = bop / "models_cad" / "models_info.json"
    infos = json.loads(path.read_text())
    infos["26"]["symmetries_discrete"] = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]]
    path.write_text(json.dumps(infos))


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated ground truth": (
        lambda bop: _cut(bop, "train_pbr/000001/scene_gt.json"),
        r"000001/scene_gt\.json: not valid",
    ),
    "truncated camera": (
        lambda bop: _cut(bop, "train_pbr/000000/scene_camera.json"),
        r"000000/scene_camera\.json: not",
    ),
    "no camera": (
        lambda bop: (bop / "test_primesense/000001/scene_camera.json").unlink(),
        r"test_primesense/000001/scene_camera\.json: not found",
    ),
    "an object without a model": (_unknown_object, r"000001: models_info\.json: no entry for object 31"),
    "a reflection": (_reflection, r"models_cad/models_info\.json: object 26: .*reflection"),
    "foreign labels": (
        lambda bop: (bop / "train_pbr/000000/scene_gt_canonical.json").write_text("{}"),
        r"000000/scene_gt_canonical\.json: exists, but no symmetries\.json",
    ),
    "a foreign table": (
        lambda bop: (bop / "symmetries.json").write_text('{"1": "mine"}'),
        r"symmetries\.json: not a symmetry table of synthetless",
    ),
    "a dataset of our own": (lambda bop: (bop / "dataset.json").write_text("{}"), "so use relabel"),
}


@pytest.mark.tless
@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_is_told_before_anything_is_written(bop: Path, name: str) -> None:
    damage, message = WRONG[name]
    damage(bop)
    _assert_refused(bop, lambda: adopt(bop, workers=1), message)


@pytest.mark.tless
def test_symmetries_of_other_objects_are_refused(bop: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text("31: C2")
    _assert_refused(
        bop, lambda: adopt(bop, symmetries=table, workers=1), r"object 31 is none of the dataset's objects 1, 2"
    )


def test_what_is_no_bop_dataset_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("dear")
    _assert_refused(tmp_path, lambda: adopt(tmp_path), "holds no ground truth of a BOP dataset")
    _assert_refused(tmp_path, lambda: adopt(tmp_path / "no"), "no such folder")


def _assert_refused(root: Path, call: Callable[[], object], message: str) -> None:
    before = contents(root)
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)
    assert contents(root) == before


def _scenes(root: Path) -> list[ScenePaths]:
    return [ScenePaths((root / name).parent) for name in LABELS]
