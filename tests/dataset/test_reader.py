"""The public reader: arrays are what the JSON files say, pictures what their files hold, and errors are one line."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import valid_dataset

from synthetless.dataset import Dataset, Image, Instance, Label, Visibility
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.reader import Scene, read_entries
from synthetless.dataset.relabel import adopt
from synthetless.errors import UserError

pytestmark = pytest.mark.usefixtures("small_scene_folders")

SPLIT = "train_synthetless"
LABEL_FILES = ("scene_gt.json", "scene_gt_info.json", "scene_gt_canonical.json")


def _json(root: Path, scene_id: int, name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((root / SPLIT / f"{scene_id:06d}" / f"scene_{name}.json").read_text())
    return content


@pytest.fixture
def copy(valid: Path, tmp_path: Path) -> Path:
    return shutil.copytree(valid, tmp_path / "d")


@pytest.fixture(scope="module")
def foreign(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A BOP dataset of somebody else: poses, cameras and pictures only."""
    root = tmp_path_factory.mktemp("foreign") / "theirs"
    kept = shutil.ignore_patterns("*.jsonl", "dataset.json", "symmetries.json", ".*", *LABEL_FILES[1:])
    shutil.copytree(valid, root, ignore=kept)
    for path in root.glob(f"{SPLIT}/*/scene_camera.json"):
        cameras = json.loads(path.read_text())
        for camera in cameras.values():
            del camera["cam_R_w2c"], camera["cam_t_w2c"]
            camera["elev"] = 45  # BOP's T-LESS says more
        path.write_text(json.dumps(cameras))
    return root


@pytest.fixture(scope="module")
def adopted(foreign: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = shutil.copytree(foreign, tmp_path_factory.mktemp("adopted") / "theirs")
    adopt(root)
    return root


def _every(dataset: Dataset, root: Path) -> Iterator[tuple[Image, dict[str, Any], list[dict[str, Any]]]]:
    """Each image with its entries in scene_camera.json and scene_gt.json."""
    ids = [(scene_id, im_id) for scene_id in (1, 2) for im_id in sorted(map(int, _json(root, scene_id, "gt")))]
    for (scene_id, im_id), image in zip(ids, dataset, strict=True):
        assert (image.scene_id, image.im_id, image.key) == (scene_id, im_id, f"{scene_id:06d}_{im_id:06d}")
        yield image, _json(root, scene_id, "camera")[str(im_id)], _json(root, scene_id, "gt")[str(im_id)]


@pytest.mark.parametrize("kind", ["valid", "adopted", "foreign"])
def test_poses_and_cameras_are_those_of_the_files(request: pytest.FixtureRequest, kind: str) -> None:
    root = request.getfixturevalue(kind)
    for image, camera, gt in _every(Dataset.open(root), root):
        np.testing.assert_array_equal(image.K, np.reshape(camera["cam_K"], (3, 3)))
        assert image.depth_scale == camera["depth_scale"]
        if kind == "valid":
            np.testing.assert_array_equal(image.R_w2c, np.reshape(camera["cam_R_w2c"], (3, 3)))
            np.testing.assert_array_equal(image.t_w2c, camera["cam_t_w2c"])
        else:
            assert image.R_w2c is None and image.t_w2c is None
        for gt_id, (instance, entry) in enumerate(zip(image.instances, gt, strict=True)):
            assert (instance.im_id, instance.gt_id, instance.obj_id) == (image.im_id, gt_id, entry["obj_id"])
            np.testing.assert_array_equal(instance.R_m2c, np.reshape(entry["cam_R_m2c"], (3, 3)))
            np.testing.assert_array_equal(instance.t_m2c, entry["cam_t_m2c"])


@pytest.mark.parametrize("kind", ["valid", "adopted"])
def test_labels_are_those_of_the_file(request: pytest.FixtureRequest, kind: str) -> None:
    root = request.getfixturevalue(kind)
    for image, _, _ in _every(Dataset.open(root), root):
        entries = _json(root, image.scene_id, "gt_canonical")[str(image.im_id)]
        for instance, entry in zip(image.instances, entries, strict=True):
            label = instance.label
            assert label is not None
            np.testing.assert_array_equal(label.R_m2c, np.reshape(entry["cam_R_m2c_canonical"], (3, 3)))
            np.testing.assert_array_equal(label.t_m2c, entry["cam_t_m2c_canonical"])
            np.testing.assert_array_equal(label.corners_px, entry["bbox3d_corners_2d"])
            assert (label.regressor_index, label.n_regressors, label.discontinuity_margin_deg) == (
                entry["regressor_index"],
                entry["n_regressors"],
                entry["discontinuity_margin_deg"],
            )


def test_visibility_is_that_of_the_file(valid: Path) -> None:
    for image, _, _ in _every(Dataset.open(valid), valid):
        entries = _json(valid, image.scene_id, "gt_info")[str(image.im_id)]
        for instance, entry in zip(image.instances, entries, strict=True):
            boxes = {key: tuple(entry[key]) for key in ("bbox_obj", "bbox_visib")}
            assert vars(instance.visibility) == entry | boxes


def test_pictures_are_those_of_the_files(valid: Path) -> None:
    for image, camera, _ in _every(Dataset.open(valid), valid):
        scene = ScenePaths.of(valid, image.scene_id)
        read = {path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in scene.root.rglob(f"{image.im_id:06d}*")}
        rgb, depth_mm = image.rgb(), image.depth_mm()
        assert (rgb.dtype, rgb.shape, depth_mm.dtype) == (np.uint8, (96, 128, 3), np.float64)
        np.testing.assert_array_equal(rgb, read[scene.rgb(image.im_id)][..., ::-1])
        np.testing.assert_array_equal(depth_mm, read[scene.depth(image.im_id)] * camera["depth_scale"])
        for instance in image.instances:
            for mask, path in ((instance.mask(), scene.mask), (instance.mask_visib(), scene.mask_visib)):
                assert mask.dtype == np.bool_
                np.testing.assert_array_equal(mask, read[path(image.im_id, instance.gt_id)] == 255)


def test_normals_and_object_coordinates_are_read(parts: Path, tmp_path: Path) -> None:

    outputs = "outputs=[depth, masks, normals, object_coordinates]"
    valid_dataset.write_dataset(tmp_path / "d", parts, [outputs, "images=1"])
    (image,) = Dataset.open(tmp_path / "d")
    normals, (points_mm, present) = image.normals(), image.object_coordinates_mm()
    np.testing.assert_allclose(np.linalg.norm(normals[present], axis=1), 1, atol=1e-3)
    for instance in image.instances:
        seen = instance.mask_visib()
        assert present[seen].all()
        z = (points_mm[seen] @ instance.R_m2c.T + instance.t_m2c)[:, 2]
        np.testing.assert_allclose(z, image.depth_mm()[seen], atol=0.15)


def test_what_a_foreign_dataset_does_not_say_is_none(foreign: Path) -> None:
    dataset = Dataset.open(foreign)
    assert dataset.header is None
    for image in dataset:
        assert all(instance.label is None and instance.visibility is None for instance in image.instances)
        assert image.rgb().shape == (96, 128, 3)
    with pytest.raises(UserError, match=r"symmetries\.json"):
        _ = dataset.symmetries


def test_a_dataset_of_ours_says_what_it_was_made_with(valid: Path) -> None:
    dataset = Dataset.open(valid)
    assert dataset.header is not None and dataset.header["counts"]["images"] == len(dataset) == 6
    assert set(dataset.symmetries.entries) == set(dataset.models_info) == {1, 2, 3}
    assert repr(dataset) == f"Dataset({str(valid)!r}, split 'train_synthetless', 2 scene folders)"


def test_numbers_may_be_whole_and_the_depth_scale_may_be_missing(copy: Path) -> None:
    path = ScenePaths.of(copy, 1).scene_camera
    cameras = json.loads(path.read_text())
    for camera in cameras.values():
        camera["cam_K"] = [300, 0, 64, 0, 300, 48, 0, 0, 1]
        del camera["depth_scale"]
    path.write_text(json.dumps(cameras))
    image = Dataset.open(copy)[0]
    assert image.K.dtype == np.float64 and image.K[0].tolist() == [300, 0, 64]
    assert image.depth_scale == 1.0
    np.testing.assert_array_equal(image.depth_mm(), cv2.imread(str(image.paths.depth(0)), cv2.IMREAD_UNCHANGED))


def test_jpeg_images_are_found(copy: Path) -> None:
    path = ScenePaths.of(copy, 1).rgb(0)
    path.with_suffix(".jpg").write_bytes(cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes())
    path.unlink()
    assert Dataset.open(copy)[0].rgb().shape == (96, 128, 3)


def test_columns_are_the_rows_of_all_images(valid: Path) -> None:
    dataset = Dataset.open(valid)
    for scene in dataset.scenes():
        poses, labels, visibility = scene.labelled()
        instances = [instance for number in range(len(scene)) for instance in scene.image(number).instances]
        assert poses.first.tolist()[-1] == len(instances) == len(poses.obj_ids)
        assert [b - a for a, b in pairwise(poses.first.tolist())] == [
            len(scene.image(number).instances) for number in range(len(scene))
        ]
        np.testing.assert_array_equal(poses.R_m2c, [instance.R_m2c for instance in instances])
        np.testing.assert_array_equal(labels.corners_px, [instance.label.corners_px for instance in instances])
        np.testing.assert_array_equal(visibility.bbox_obj, [instance.visibility.bbox_obj for instance in instances])
        assert poses.K.shape == (len(instances), 3, 3)


def test_a_change_of_an_image_s_arrays_changes_nothing_else(valid: Path) -> None:
    dataset = Dataset.open(valid)
    before = dataset[0].instances[0].R_m2c
    image = dataset[0]
    image.instances[0].R_m2c[:] = 0
    image.instances[0].label.corners_px[:] = 0
    image.K[:] = 0
    np.testing.assert_array_equal(dataset[0].instances[0].R_m2c, before)
    assert dataset[0].K.any() and dataset[0].instances[0].label.corners_px.any()
    with pytest.raises(ValueError, match="read-only"):
        dataset.scene(1).poses.R_m2c[:] = 0


# Access by number and by id


def test_images_are_a_sequence(valid: Path) -> None:
    dataset = Dataset.open(valid)
    keys = [f"{scene:06d}_{im_id:06d}" for scene in (1, 2) for im_id in range(3)]
    assert [image.key for image in dataset] == [dataset[number].key for number in range(len(dataset))] == keys
    assert [dataset[-number].key for number in range(1, 7)] == keys[::-1]
    assert [image.key for image in dataset[1:5:2]] == keys[1:5:2]
    assert [image.key for image in dataset[::-1]] == [image.key for image in reversed(dataset)] == keys[::-1]
    assert dataset[10:] == []
    assert dataset[np.int64(4)].key == dataset[True + 3].key == keys[4]
    assert dataset.image(2, 1).key == keys[4]


@pytest.mark.parametrize("number", [6, -7, 10**20])
def test_an_image_out_of_range_is_refused(valid: Path, number: int) -> None:
    with pytest.raises(IndexError, match=f"image {number} of 6; 0 to 5 are possible"):
        Dataset.open(valid)[number]


@pytest.mark.parametrize("number", ["0", 1.5, None, (0, 1)])
def test_what_is_no_number_is_a_mistake_of_the_caller(valid: Path, number: Any) -> None:
    with pytest.raises(TypeError):
        Dataset.open(valid)[number]


@pytest.mark.parametrize("ids", [(1, 3), (3, 0), (1, -1), (0, 0)])
def test_an_image_that_is_not_there_is_refused(valid: Path, ids: tuple[int, int]) -> None:
    with pytest.raises(UserError, match=rf"{ids[0]:06d}: no image {ids[1]}$"):
        Dataset.open(valid).image(*ids)


# Errors


def test_folders_that_are_no_dataset_are_refused(valid: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    for place, told in (
        (tmp_path / "nowhere", "no such dataset folder"),
        (tmp_path / "file", "no such dataset folder"),
        (tmp_path / "empty", "no BOP dataset"),
        (valid / SPLIT, "no BOP dataset"),
    ):
        with pytest.raises(UserError, match=told):
            Dataset.open(place)
    with pytest.raises(UserError, match=rf"val: no such split; there are {SPLIT}"):
        Dataset.open(valid, "val")
    with pytest.raises(UserError, match="train: no such split; this is not a BOP dataset"):
        Dataset.open(tmp_path / "empty", "train")


def test_one_of_several_splits_must_be_named(copy: Path) -> None:
    shutil.copytree(copy / SPLIT / "000001", copy / "val" / "000007")
    with pytest.raises(UserError, match=f"has the splits {SPLIT}, val; name one of them"):
        Dataset.open(copy)
    assert [image.key for image in Dataset.open(str(copy), "val")] == [f"000007_{im_id:06d}" for im_id in range(3)]


Change = Callable[[dict[str, Any]], object]


def _first(key: str, value: Any) -> Change:
    """Gives the first image's entry, or its first instance's, another value; removes it if that is ``del``."""

    def change(content: dict[str, Any]) -> None:
        entry = content["0"][0] if isinstance(content["0"], list) else content["0"]
        if value == "del":
            del entry[key]
        else:
            entry[key] = value

    return change


INSTANCE = "image 0, instance 0"
DAMAGES: list[tuple[str, Change, str]] = [
    ("camera", _first("cam_K", [1.0] * 8), r"scene_camera\.json: image 0: cam_K is \[1\.0, .*, not 9 finite numbers"),
    ("camera", _first("cam_K", "del"), "image 0: cam_K is None, not 9 finite numbers"),
    ("camera", _first("cam_K", ["300"] * 9), "image 0: cam_K is .*, not 9 finite numbers"),
    ("camera", _first("depth_scale", "0.1"), "image 0: depth_scale is '0.1', not a finite number"),
    ("camera", _first("depth_scale", [0.1]), r"image 0: depth_scale is \[0.1\], not a finite number"),
    ("camera", _first("depth_scale", None), "image 0: depth_scale is None, not a finite number"),
    ("camera", _first("cam_t_w2c", [1, 2]), r"image 0: cam_t_w2c is \[1, 2\], not 3 finite numbers"),
    ("camera", lambda c: c.update({"0": []}), "image 0 of scene_gt.json has no entry"),
    ("camera", lambda c: c.pop("1"), "image 1 is in only one of scene_camera.json and scene_gt.json"),
    ("camera", lambda c: c.update({"9": c["0"]}), "image 9 is in only one of"),
    ("camera", lambda c: c.update({"one": c["0"]}), 'has the key "one"; image ids are needed'),
    ("gt", _first("obj_id", "1"), rf"scene_gt\.json: {INSTANCE}: obj_id is '1', not a finite number"),
    ("gt", _first("obj_id", 1.5), rf"{INSTANCE}: obj_id is 1\.5; whole numbers are needed"),
    ("gt", _first("cam_R_m2c", [[1.0, 0, 0]] * 3), f"{INSTANCE}: cam_R_m2c is .*, not 9 finite numbers"),
    ("gt", _first("cam_R_m2c", [1.0] * 10), f"{INSTANCE}: cam_R_m2c is .*, not 9 finite numbers"),
    ("gt", _first("cam_t_m2c", [0, 0, None]), rf"{INSTANCE}: cam_t_m2c is \[0, 0, None\], not 3 finite numbers"),
    ("gt", _first("cam_t_m2c", [0, 0, float("inf")]), f"{INSTANCE}: cam_t_m2c is .*inf.*, not 3 finite numbers"),
    ("gt", _first("cam_t_m2c", [0, 0, float("nan")]), f"{INSTANCE}: cam_t_m2c is .*nan.*, not 3 finite numbers"),
    ("gt", _first("cam_t_m2c", [0, 0, 10**400]), f"{INSTANCE}: cam_t_m2c is .*, not 3 finite numbers"),
    ("gt", lambda c: c["0"].__setitem__(0, 5), "image 0 has no list of instances"),
    ("gt_info", _first("visib_fract", "del"), rf"scene_gt_info\.json: {INSTANCE}: visib_fract is None"),
    ("gt_info", _first("px_count_visib", 1.5), rf"{INSTANCE}: px_count_visib is 1\.5; whole numbers"),
    ("gt_info", _first("bbox_obj", [1, 2, 3]), f"{INSTANCE}: bbox_obj is .*, not 4 finite numbers"),
    ("gt_info", lambda c: c["0"].pop(), "image 0 has . entries, but . in scene_gt.json"),
    ("gt_info", lambda c: c.pop("2"), r"scene_gt_info\.json: image 2 has 0 entries, but"),
    ("gt_info", lambda c: c["0"].__setitem__(0, "x"), f"{INSTANCE}: px_count_all is None"),
    ("gt_canonical", _first("cam_R_m2c_canonical", None), rf"scene_gt_canonical\.json: {INSTANCE}: cam_R_m2c_canon"),
    ("gt_canonical", _first("regressor_index", 0.5), rf"{INSTANCE}: regressor_index is 0\.5; whole numbers"),
    ("gt_canonical", _first("discontinuity_margin_deg", float("nan")), f"{INSTANCE}: discontinuity_margin_deg is nan"),
    ("gt_canonical", _first("bbox3d_corners_2d", [[0, 0]] * 7), f"{INSTANCE}: bbox3d_corners_2d is .*, not 8 x 2"),
    ("gt_canonical", _first("bbox3d_corners_2d", [[0, 0], [1]]), f"{INSTANCE}: bbox3d_corners_2d is .*, not 8 x 2"),
    ("gt_canonical", lambda c: c.update({"0": {}}), "image 0 has 0 entries"),
]


@pytest.mark.parametrize("number", range(len(DAMAGES)))
def test_a_damaged_entry_is_named(copy: Path, number: int) -> None:
    name, change, told = DAMAGES[number]
    path = ScenePaths.of(copy, 1).root / f"scene_{name}.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=told) as raised:
        list(Dataset.open(copy))
    assert "000001" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < len(str(copy)) + 300
    with pytest.raises(UserError):  # nor do the exports take it, with one exception
        _ = read_entries(ScenePaths.of(copy, 1)) if "w2c" not in told else list(Dataset.open(copy))


@pytest.mark.parametrize("content", [b"", b"[]", b"null", b"{", b'{"0": ', b"\xff\xfe", b'{"0": [], "0": []}'])
@pytest.mark.parametrize("name", ["scene_camera.json", *LABEL_FILES])
def test_a_file_that_is_no_json_object_is_named(copy: Path, name: str, content: bytes) -> None:
    (ScenePaths.of(copy, 2).root / name).write_bytes(content)
    dataset = Dataset.open(copy)
    assert dataset.scene(1)
    with pytest.raises(UserError, match=rf"000002/{name}: "):
        len(dataset)


@pytest.mark.parametrize("name", ["scene_camera.json", "scene_gt.json"])
def test_a_missing_file_is_named(copy: Path, name: str) -> None:
    (ScenePaths.of(copy, 2).root / name).unlink()
    with pytest.raises(UserError, match=rf"000002/{name}: not found"):
        list(Dataset.open(copy))


@pytest.mark.parametrize("damage", ["missing", "cut off", "empty", "other channels"])
def test_a_picture_that_cannot_be_read_is_named(copy: Path, damage: str) -> None:
    image = Dataset.open(copy)[0]
    readers: dict[str, tuple[Path, Callable[[], object]]] = {
        "rgb": (image.paths.rgb(0), image.rgb),
        "depth": (image.paths.depth(0), image.depth_mm),
        "mask": (image.paths.mask(0, 0), image.instances[0].mask),
        "mask_visib": (image.paths.mask_visib(0, 0), image.instances[0].mask_visib),
    }
    other = cv2.imencode(".png", np.zeros((96, 128, 4), np.uint8))[1].tobytes()
    for folder, (path, read) in readers.items():
        content = path.read_bytes()
        if damage == "missing":
            path.unlink()
        else:
            path.write_bytes({"cut off": content[:50], "empty": b"", "other channels": other}[damage])
        with pytest.raises(UserError, match=rf"{folder}/{path.name}: (not found|not a readable|has 4 channel)"):
            read()
    for missing in (image.normals, image.object_coordinates_mm):
        with pytest.raises(UserError, match=r"000000\.png: not found"):
            missing()


# Threads and processes


def _digest(image: Image) -> tuple[Any, ...]:
    labels = [instance.label.R_m2c.sum() for instance in image.instances if instance.label]
    return image.key, int(image.rgb().sum()), float(image.depth_mm().sum()), labels


def _digest_of(dataset: Dataset, number: int) -> tuple[Any, ...]:
    return _digest(dataset[number])


def test_threads_share_one_dataset(valid: Path) -> None:
    expected = [_digest(image) for image in Dataset.open(valid)]
    for _ in range(10):
        dataset = Dataset.open(valid)
        with ThreadPoolExecutor(8) as pool:
            assert list(pool.map(lambda n: _digest_of(dataset, n % 6), range(48))) == expected * 8  # noqa: B023


def test_spawned_processes_read_for_themselves(valid: Path) -> None:
    dataset = Dataset.open(valid)
    expected = [_digest(image) for image in dataset]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert [pool.submit(_digest_of, dataset, number).result() for number in range(6)] == expected
        assert pool.submit(_digest, dataset[3]).result() == expected[3]


def test_a_dataset_is_pickled_as_its_path(valid: Path) -> None:
    dataset = Dataset.open(valid)
    expected = [_digest(image) for image in dataset]
    content = pickle.dumps(dataset)
    assert len(content) < 1000
    assert [_digest(image) for image in pickle.loads(content)] == expected


def test_reading_needs_neither_blender_nor_torch(valid: Path, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "for name in ('bpy', 'mathutils', 'OpenEXR', 'torch', 'matplotlib', 'ray'):\n"
        "    sys.modules[name] = None\n"
        "from synthetless.dataset import Dataset\n"
        "for image in Dataset.open(sys.argv[1]):\n"
        "    image.rgb(), image.depth_mm(), [each.mask() for each in image.instances]\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(valid)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_nothing_is_written_and_no_file_stays_open(copy: Path) -> None:
    before = sorted(copy.rglob("*"))
    images = list(Dataset.open(copy))
    assert all(image.rgb().any() for image in images)
    assert sorted(copy.rglob("*")) == before
    open_files = [path.resolve() for path in Path("/proc/self/fd").iterdir() if path.exists()]
    assert not [path for path in open_files if path.is_relative_to(copy)]


def test_the_types_are_exported(valid: Path) -> None:
    instance = Dataset.open(valid)[0].instances[0]
    assert isinstance(instance, Instance)
    assert isinstance(instance.label, Label)
    assert isinstance(instance.visibility, Visibility)
    assert isinstance(Dataset.open(valid).scene(1), Scene)
