"""Commit, resume and refuse: what is on disk after a good run, an interrupted one, and a wrong request."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trees import contents

from synthetless.config import Recipe, load_recipe
from synthetless.dataset import records
from synthetless.dataset.layout import Part, by_drop, image_number, plan_image
from synthetless.dataset.store import DatasetError, DatasetStore, FinishedImage
from synthetless.errors import UserError
from synthetless.io import images
from synthetless.io.files import LockedError, in_turn, locked, read_json
from synthetless.io.models import ObjectModel, load_models
from synthetless.symmetry import SymmetryTable


@pytest.fixture
def models(tmp_path: Path) -> dict[int, ObjectModel]:
    folder = tmp_path / "models"
    folder.mkdir()
    trimesh.creation.box((30, 20, 10)).export(folder / "obj_000001.ply")
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    info = {"diameter": float(np.sqrt(1400)), "symmetries_discrete": [half_turn]}
    for axis, side in zip("xyz", (30.0, 20.0, 10.0), strict=True):
        info |= {f"min_{axis}": -side / 2, f"size_{axis}": side}
    (folder / "models_info.json").write_text(json.dumps({"1": info}))
    return load_models(folder)


@pytest.fixture
def recipe() -> Recipe:
    return load_recipe(None, ["images=4", "camera.width=16", "camera.height=16", "outputs=[rgb]"])


def _image(number: int) -> FinishedImage:
    """An image whose every byte follows from its number."""
    rng = np.random.default_rng(number)
    plan = plan_image(number, 1)
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    pixels = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    box = [1, 1, 3, 3]
    info = {"bbox_obj": box, "bbox_visib": box, "px_count_all": 9, "px_count_valid": 9, "px_count_visib": 9}
    return FinishedImage(
        plan,
        {f"rgb/{plan.im_id:06d}.png": images.encode_png(pixels)},
        {
            "camera": records.camera_entry(np.diag([50.0, 50.0, 1.0]), np.eye(3), np.array([0.0, 0.0, 600.0]), 0.1),
            "gt": [records.gt_entry(1, rotation, np.array([0.0, 0.0, 600.0]))],
            "gt_info": [{**info, "visib_fract": 1.0}],
            "coco": [],
            "spec": {"image_id": plan.im_id, "drop": plan.drop},
        },
    )


def test_an_interrupted_dataset_ends_like_an_uninterrupted_one(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]
) -> None:
    whole = DatasetStore.open(tmp_path / "whole", recipe, models, "")
    for number in range(4):
        whole.commit(_image(number))
    whole.assemble()

    root = tmp_path / "pieces"
    for order in ([2], [0, 3], [1]):
        pieces = DatasetStore.open(root, recipe, models, "")
        for number in order:
            assert number in pieces.missing()
            pieces.commit(_image(number))
        pieces.assemble()
    assert pieces.missing() == []
    assert contents(root) == contents(tmp_path / "whole")


def test_assembling_twice_changes_nothing(tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    before = contents(tmp_path / "d")
    dataset.assemble()
    assert contents(tmp_path / "d") == before


@pytest.mark.parametrize("lost", ["scene_camera.json", "scene_gt.json", "scene_gt_canonical.json", "scene_spec.jsonl"])
def test_an_interrupted_assembly_is_made_good(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], lost: str
) -> None:
    """Assembly writes scene_camera.json last: whatever was cut off before is written again."""
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    complete = contents(tmp_path / "d")
    scene = dataset.scene(1)
    (scene.root / lost).unlink()
    scene.scene_camera.unlink(missing_ok=True)
    DatasetStore(tmp_path / "d", recipe).assemble()
    assert contents(tmp_path / "d") == complete


def test_drafts_of_a_run_that_could_not_remove_them_are_removed(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]
) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    complete = contents(tmp_path / "d")
    nobody = 2**22 + 1  # a larger number than any process has
    left = dataset.scene(1).root / f".scene_gt_info.json.{socket.gethostname()}.{nobody}.part"
    left.write_text("{")
    DatasetStore(tmp_path / "d", recipe).assemble()
    assert contents(tmp_path / "d") == complete


def test_assembling_does_not_read_again_what_is_finished(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = recipe.model_copy(update={"images": 3000})
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    for number in (0, 1000, 2000):
        dataset.commit(_image(number))
    dataset.assemble()
    read: list[Path] = []
    monkeypatch.setattr("synthetless.dataset.store.read_json", lambda path: read.append(path) or read_json(path))
    dataset.commit(_image(2001))
    dataset.assemble()
    assert {path.parent.name for path in read if path.parent.parent.name == ".records"} == {"000003"}
    header = read_json(tmp_path / "d" / "dataset.json")
    assert header["counts"] == {"images": 4, "instances": 4}
    shutil.rmtree(tmp_path / "d" / "train_synthetless" / "000001")
    dataset.finish()
    assert len(records.read_scene_json(dataset.scene(1).scene_gt)) == 1, "in the end everything is looked at"


@pytest.mark.parametrize("name", [".DS_Store", "000003 copy.json", "Thumbs.db", "3.json", "000003.json.bak"])
def test_stray_files_beside_the_records_are_no_images(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], name: str
) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    for folder in (".records", ".records/000001"):
        (tmp_path / "d" / folder / name).write_text("{}")
    dataset.finish()
    assert dataset.done() == {0}
    assert read_json(tmp_path / "d" / "dataset.json")["counts"] == {"images": 1, "instances": 1}


def test_labels_follow_from_poses_and_symmetries(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]
) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    scene = dataset.scene(1)
    label = records.read_scene_json(scene.scene_gt_canonical)[0][0]
    pose = records.read_scene_json(scene.scene_gt)[0][0]
    table = SymmetryTable.read(tmp_path / "d" / "symmetries.json")
    assert table.entries[1].group.name == "C2"
    R, t = np.array(pose["cam_R_m2c"]).reshape(1, 3, 3), np.array([pose["cam_t_m2c"]])
    expected = table.canonical_map(1)(R, t)
    np.testing.assert_array_equal(np.array(label["cam_R_m2c_canonical"]).reshape(3, 3), expected.R_m2c[0])
    assert label["regressor_index"] == expected.regressor_index[0]
    assert label["n_regressors"] == 2
    assert len(label["bbox3d_corners_2d"]) == 8
    header = read_json(tmp_path / "d" / "dataset.json")
    assert header["counts"] == {"images": 1, "instances": 1}
    assert header["symmetries"]["sha256"] == table.digest()


def test_more_images_extend_a_dataset(tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    more = DatasetStore.open(tmp_path / "d", recipe.model_copy(update={"images": 6}), models, "")
    assert more.missing() == [1, 2, 3, 4, 5]
    fewer = DatasetStore.open(tmp_path / "d", recipe.model_copy(update={"images": 1}), models, "")
    assert fewer.missing() == [1, 2, 3], "a smaller number takes nothing away"


@pytest.mark.parametrize(("key", "value"), [("seed", 9), ("split", "other"), ("outputs", ("rgb", "depth"))])
def test_another_recipe_is_refused(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], key: str, value: object
) -> None:
    DatasetStore.open(tmp_path / "d", recipe, models, "")
    before = contents(tmp_path / "d")
    with pytest.raises(DatasetError, match=key):
        DatasetStore.open(tmp_path / "d", recipe.model_copy(update={key: value}), models, "")
    assert contents(tmp_path / "d") == before


def test_other_models_or_photographs_are_refused(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]
) -> None:
    DatasetStore.open(tmp_path / "d", recipe, models, "")
    with pytest.raises(DatasetError, match="scenery_digest"):
        DatasetStore.open(tmp_path / "d", recipe, models, "other")
    models[1].path.write_bytes(models[1].path.read_bytes() + b"\n")
    with pytest.raises(DatasetError, match="models_sha256"):
        DatasetStore.open(tmp_path / "d", recipe, models, "")


def test_a_foreign_folder_is_left_alone(tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]) -> None:
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("dear")
    with pytest.raises(DatasetError, match=r"thesis\.tex"):
        DatasetStore.open(foreign, recipe, models, "")
    assert contents(foreign) == {"thesis.tex": b"dear"}
    with pytest.raises(DatasetError, match="cannot be used"):
        DatasetStore.open(foreign / "thesis.tex" / "d", recipe, models, "")


def test_two_generators_in_one_folder_are_told(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path), pytest.raises(LockedError, match="another synthetless"), locked(tmp_path):
            pass
    assert not list(tmp_path.iterdir()), "nothing of the lock remains"


def test_parts_work_side_by_side_and_the_same_part_does_not(tmp_path: Path) -> None:
    with locked(tmp_path, Part(1, 3)), locked(tmp_path, Part(2, 3)):
        for part in (Part(1, 3), None):
            with pytest.raises(LockedError, match="another synthetless"), locked(tmp_path, part):
                pass
        with in_turn(tmp_path):
            pass
    with locked(tmp_path), pytest.raises(LockedError), locked(tmp_path, Part(3, 3)):
        pass


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "a/b", "1/0", "-1/2", "1/2/3"])
def test_a_wrong_part_is_told(text: str) -> None:
    with pytest.raises(ValueError, match="write it as 3/10"):
        Part.parse(text)


def test_parts_share_every_drop_once() -> None:
    for drop in range(50):
        assert sum(Part(k, 7).takes(drop) for k in range(1, 8)) == 1


def test_lost_records_are_told(tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]) -> None:
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    dataset.commit(_image(0))
    dataset.assemble()
    next((tmp_path / "d" / ".records").rglob("*.json")).unlink()
    with pytest.raises(DatasetError, match="lacks the records of 1 images"):
        dataset.assemble()


def test_a_full_disk_leaves_no_image_behind(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """/dev/full refuses every byte, as a full disk does."""
    dataset = DatasetStore.open(tmp_path / "d", recipe, models, "")
    rgb = dataset.scene(1).root / "rgb"
    rgb.mkdir(parents=True)
    image = _image(0)
    monkeypatch.setattr("os.getpid", lambda: "full")
    (rgb / f".{plan_image(0, 1).im_id:06d}.png.{socket.gethostname()}.full.part").symlink_to("/dev/full")
    with pytest.raises(DatasetError, match="No space left on device"):
        dataset.commit(image)
    assert 0 in dataset.missing()
    assert list(rgb.iterdir()) == []


def test_the_plan_is_a_bijection() -> None:
    for views in (1, 3, 4):
        plans = [image for _, images in by_drop(range(2500), views) for image in images]
        assert [image_number(p.scene_id, p.im_id) for p in plans] == list(range(2500))
        assert len({(p.drop, p.view) for p in plans}) == 2500
        assert len({(p.scene_id, p.im_id) for p in plans}) == 2500
        assert all(p.view < views and p.im_id < 1000 and p.scene_id >= 1 for p in plans)


def test_a_dataset_begun_before_a_setting_existed_is_continued(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel]
) -> None:
    DatasetStore.open(tmp_path / "d", recipe, models, "")
    path = tmp_path / "d" / "dataset.json"
    header = json.loads(path.read_text())
    del header["recipe"]["labels"]["visibility_delta_mm"]
    path.write_text(json.dumps(header))
    assert DatasetStore.open(tmp_path / "d", recipe, models, "").recipe == recipe


@pytest.mark.parametrize("damaged", [None, {}, {"images": "many"}, {"imagse": 3}])
def test_a_damaged_recipe_is_told(
    tmp_path: Path, recipe: Recipe, models: dict[int, ObjectModel], damaged: object
) -> None:
    DatasetStore.open(tmp_path / "d", recipe, models, "")
    path = tmp_path / "d" / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "recipe": damaged}))
    with pytest.raises(DatasetError if damaged == {} else UserError, match=r"dataset\.json: "):
        DatasetStore.open(tmp_path / "d", recipe, models, "")
