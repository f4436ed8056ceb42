"""A dataset of a camera with a lens: BOP's cam_model, labels in bent pixels, and every place that projects agrees."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from valid_dataset import small_scene_folders, write_dataset, write_models

from synthetless.dataset import Dataset
from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.records import read_scene_json, write_scene_json
from synthetless.dataset.relabel import adopt
from synthetless.errors import UserError
from synthetless.exports.bop import export_bop
from synthetless.exports.coco import export_coco
from synthetless.exports.webdataset import export_webdataset
from synthetless.learning.pose_error import ModelPoints, RigidPose
from synthetless.learning.solve import solve_pose
from synthetless.preview.image import box_lines
from synthetless.validation import validate

DISTORTION = (-0.6, 0.9, 0.01, -0.02, 0.3)
K = np.array([[300.0, 0, 63.2], [0, 298.0, 47.7], [0, 0, 1]])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lens")
    write_dataset(folder / "dataset", write_models(folder / "models"), [f"camera.distortion={list(DISTORTION)}"])
    return folder / "dataset"


@pytest.fixture(autouse=True)
def _small_scene_folders() -> Iterator[None]:
    with small_scene_folders():
        yield


@pytest.fixture
def dataset(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "dataset"))


def _projected(points_mm: NDArray[np.float64], R: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    pixels, _ = cv2.projectPoints(points_mm, cv2.Rodrigues(R)[0], t, K, np.array(DISTORTION))
    return np.asarray(pixels.reshape(-1, 2), dtype=np.float64)


def test_the_camera_is_written_as_bop_has_it(made: Path) -> None:
    entry = read_scene_json(made / "train_synthetless/000001/scene_camera.json")[0]
    assert "cam_K" not in entry
    k1, k2, p1, p2, k3 = DISTORTION
    assert entry["cam_model"] == {
        "image_height": 96,
        "image_width": 128,
        "projection_model_type": "OpenCV",
        "projection_params": [300.0, 298.0, 63.2, 47.7, k1, k2, k3, p1, p2],
    }
    assert json.loads((made / "camera.json").read_text())["distortion"] == list(DISTORTION)
    image = Dataset.open(made)[0]
    np.testing.assert_array_equal(image.K, K)
    assert tuple(image.distortion) == DISTORTION


def test_it_is_valid_and_a_wrong_lens_is_not(dataset: Path) -> None:
    assert validate(dataset, workers=1).valid
    path = dataset / "train_synthetless/000001/scene_camera.json"
    cameras = read_scene_json(path)
    cameras[1]["cam_model"]["projection_params"][4] += 0.01
    write_scene_json(path, cameras)
    found = validate(dataset, workers=1).findings
    assert any(f.kind == "camera" and f.image == 1 and "cam_model" in f.message for f in found)
    assert any(f.kind == "canonical" and f.image == 1 for f in found), "corners do not follow from another lens"
    cameras[1]["cam_model"]["projection_params"].pop()
    write_scene_json(path, cameras)
    assert any(
        "cam_model has 8 projection_params; OpenCV has 9" in f.message for f in validate(dataset, workers=1).findings
    )


def test_all_that_is_projected_is_where_opencv_puts_it(made: Path) -> None:
    data = Dataset.open(made)
    for image in data:
        for instance in image.instances:
            assert instance.label is not None
            box = box_corners_mm(data.models_info[instance.obj_id])
            corners = _projected(box, instance.label.R_m2c, instance.label.t_m2c)
            np.testing.assert_allclose(instance.label.corners_px, corners, atol=1e-6)
            lines = box_lines(image.K, instance.label.R_m2c, instance.label.t_m2c, box, image.distortion)
            np.testing.assert_allclose(lines[0], corners[:2].ravel(), atol=0.051)


def test_masks_are_where_the_corners_say(made: Path) -> None:
    """Vertices of a part that is whole in the image and hidden by nothing bound its mask, within a pixel or two."""
    data, compared = Dataset.open(made), 0
    for image in data:
        for instance in image.instances:
            seen = instance.visibility
            if instance.obj_id != 3 or seen is None or seen.px_count_all != np.count_nonzero(instance.mask()):
                continue
            corners = _projected(box_corners_mm(data.models_info[3]), instance.R_m2c, instance.t_m2c)
            x, y, w, h = seen.bbox_obj
            np.testing.assert_allclose(corners.min(axis=0), (x, y), atol=2)
            np.testing.assert_allclose(corners.max(axis=0), (x + w, y + h), atol=2)
            compared += 1
    assert compared >= 3


def test_poses_are_solved_and_scored_in_bent_pixels(made: Path) -> None:
    data = Dataset.open(made)
    image = data[0]
    instance = image.instances[0]
    box = box_corners_mm(data.models_info[instance.obj_id])
    truth = RigidPose(instance.R_m2c, instance.t_m2c)
    found = solve_pose(_projected(box, *truth), box, image.K, image.distortion)
    assert found is not None
    np.testing.assert_allclose(found.t_m2c, truth.t_m2c, rtol=1e-4)
    moved = RigidPose(truth.R_m2c, truth.t_m2c + np.array([4.0, -2.0, 10.0]))
    error = ModelPoints(box, np.eye(4)[None]).mspd(moved, truth, image.K, image.distortion)
    expected = np.linalg.norm(_projected(box, *moved) - _projected(box, *truth), axis=1).max()
    assert error == pytest.approx(expected, abs=1e-9)


def test_exports_say_which_lens(dataset: Path, tmp_path: Path) -> None:
    export_coco(dataset, dataset / "coco.json")
    images = json.loads((dataset / "coco.json").read_text())["images"]
    assert all("cam_K" not in image and image["cam_model"]["projection_params"][4] == -0.6 for image in images)
    export_webdataset(dataset, tmp_path / "shards")
    assert validate(dataset, exports=[dataset / "coco.json", tmp_path / "shards"], workers=1).valid


def test_loaders_that_know_pinholes_alone_get_no_lens(made: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"image 0 was taken through a lens \(cam_model\)"):
        export_bop(made, tmp_path, workers=1)
    assert not (tmp_path / "tless").exists()


def test_others_datasets_with_a_lens_are_adopted(dataset: Path) -> None:
    expected = [[i.label for i in image.instances] for image in Dataset.open(dataset)]
    for name in ("dataset.json", "symmetries.json", ".records"):
        path = dataset / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name in ("scene_gt_canonical.json", "scene_spec.jsonl"):
        for path in dataset.glob(f"*/*/{name}"):
            path.unlink()
    adopt(dataset, workers=1)
    for image, labels in zip(Dataset.open(dataset), expected, strict=True):
        for instance, label in zip(image.instances, labels, strict=True):
            assert instance.label is not None
            assert label is not None
            np.testing.assert_allclose(instance.label.corners_px, label.corners_px, atol=1e-6)
    assert validate(dataset, workers=1).valid
