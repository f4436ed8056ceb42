"""The entries of BOP's scene files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import InstanceAnnotation
from synthetless.dataset import records
from synthetless.dataset.layout import ScenePaths, scene_ids
from synthetless.io.files import write_json
from synthetless.scenes.spec import Intrinsics

masks = arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=12))
TLESS = Intrinsics(720, 540, 1075.65091572, 1073.90347929, 360.0, 270.0)


def _instance(mask: NDArray[np.bool_], mask_visib: NDArray[np.bool_]) -> InstanceAnnotation:
    count, visible = int(mask.sum()), int(mask_visib.sum())
    fraction = visible / count if count else 0.0
    return InstanceAnnotation(mask, mask_visib, count, count, visible, fraction, (0, 0, 1, 1), (0, 0, 1, 1))


def test_paths_are_bops(tmp_path: Path) -> None:
    scene = ScenePaths.of(tmp_path, 1)
    assert scene.root == tmp_path / "train_synthetless" / "000001"
    assert scene.rgb(7, "jpg") == scene.root / "rgb" / "000007.jpg"
    assert scene.mask_visib(12, 3) == scene.root / "mask_visib" / "000012_000003.png"
    assert scene.scene_gt_canonical == scene.root / "scene_gt_canonical.json"


def test_scenes_are_found_in_order(tmp_path: Path) -> None:
    for name in ("000010", "000002", ".partial"):
        (tmp_path / "train_synthetless" / name).mkdir(parents=True)
    assert scene_ids(tmp_path) == [2, 10]
    with pytest.raises(ValueError, match="no such split"):
        scene_ids(tmp_path, "test_primesense")


def test_scene_files_have_one_image_a_line_in_numeric_order(tmp_path: Path) -> None:
    path = tmp_path / "scene_gt.json"
    records.write_scene_json(path, {10: [{"b": 1, "a": 2}], 2: []})
    assert path.read_text() == '{\n  "2": [],\n  "10": [{"a": 2, "b": 1}]\n}\n'
    assert list(records.read_scene_json(path)) == [2, 10]


def test_a_key_that_is_no_image_id_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "scene_gt.json", {"0": [], "images": []})
    with pytest.raises(ValueError, match=r'scene_gt\.json: has the key "images"; image ids are needed'):
        records.read_scene_json(tmp_path / "scene_gt.json")


@given(st.integers(0, 2**32 - 1))
def test_poses_survive_the_file_bit_for_bit(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    generator = np.random.default_rng(seed)
    R, t = Rotation.random(random_state=generator).as_matrix(), generator.normal(0, 500, 3)
    K = records.camera_matrix(TLESS)
    path = tmp_path_factory.mktemp("scene") / "scene_camera.json"
    records.write_scene_json(path, {0: {**records.camera_entry(K, R, t, 0.1), **records.gt_entry(5, R, t)}})
    entry = records.read_scene_json(path)[0]
    assert np.array_equal(np.reshape(entry["cam_R_w2c"], (3, 3)), R)
    assert np.array_equal(np.reshape(entry["cam_R_m2c"], (3, 3)), R)
    assert np.array_equal(entry["cam_t_m2c"], t)
    assert np.array_equal(np.reshape(entry["cam_K"], (3, 3)), K)
    assert entry["depth_scale"] == 0.1


def test_camera_json_has_bops_keys() -> None:
    content = records.camera_json(TLESS, 0.1)
    assert (content["width"], content["height"], content["fx"], content["cy"]) == (720, 540, 1075.65091572, 270.0)
    assert set(content) == {"width", "height", "fx", "fy", "cx", "cy", "depth_scale"}


def test_gt_info_takes_numpy_numbers_to_json() -> None:
    mask = np.ones((2, 3), bool)
    box = tuple(np.arange(4, dtype=np.int64))
    instance = InstanceAnnotation(mask, mask, np.int64(6), np.int64(5), np.int64(3), np.float64(0.5), box, box)  # type: ignore[arg-type]
    assert json.loads(json.dumps(records.gt_info_entry(instance))) == {
        "bbox_obj": [0, 1, 2, 3],
        "bbox_visib": [0, 1, 2, 3],
        "px_count_all": 6,
        "px_count_valid": 5,
        "px_count_visib": 3,
        "visib_fract": 0.5,
    }


@given(masks)
def test_run_lengths_are_pycocotools(mask: NDArray[np.bool_]) -> None:
    rle = records.uncompressed_rle(mask)
    assert coco_mask.frPyObjects(rle, *mask.shape) == coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    assert rle["counts"][0] == 0 or not mask[0, 0]


@given(masks.filter(lambda mask: bool(mask.any())))
def test_boxes_are_pycocotools(mask: NDArray[np.bool_]) -> None:
    rle = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    assert records.amodal_box(mask) == coco_mask.toBbox(rle).tolist()


def test_coco_leaves_out_what_is_hidden_and_ignores_what_hardly_shows() -> None:
    whole = np.zeros((6, 8), bool)
    whole[1:5, 2:7] = True
    hidden, corner = np.zeros_like(whole), np.zeros_like(whole)
    corner[1, 2] = True
    annotations = records.coco_annotations(
        4, [7, 7, 9], [_instance(whole, hidden), _instance(whole, corner), _instance(whole, whole)]
    )
    content = records.scene_gt_coco(
        "tless", [9, 7, 8], [records.coco_image(4, Path("a/rgb/000004.jpg"), 8, 6)], annotations
    )
    assert [(a["id"], a["category_id"], a["ignore"], a["area"]) for a in content["annotations"]] == [
        (1, 7, True, 1),
        (2, 9, False, 20),
    ]
    assert all(a["bbox"] == [2, 1, 5, 4] and a["image_id"] == 4 for a in content["annotations"])
    assert [category["id"] for category in content["categories"]] == [7, 8, 9]
    assert content["categories"][0]["supercategory"] == "tless"
    assert content["images"][0]["file_name"] == "rgb/000004.jpg"
    assert "id" not in annotations[0]
