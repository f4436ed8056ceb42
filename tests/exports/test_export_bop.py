"""The BOP folder under other names, read as each loader of docs/formats.md reads it, and number by number."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from trees import contents

from synthetless.dataset import Dataset
from synthetless.dataset.reader import Image
from synthetless.errors import UserError
from synthetless.exports.bop import export_bop
from synthetless.exports.keypoints import farthest_points
from synthetless.validation import validate

SCENES = 3


@dataclass(frozen=True)
class Exported:
    """An export of six images into three scene folders, and the images that they are."""

    root: Path
    dataset: Path

    def scene(self, number: int, name: str) -> Any:
        return json.loads((self.root / "train_pbr" / f"{number:06d}" / f"scene_{name}.json").read_text())

    def images(self) -> Iterator[tuple[int, str, Image]]:
        """Scene folder and image id in the export, and the dataset's image."""
        for number, image in enumerate(Dataset.open(self.dataset)):
            yield number // 2, str(number % 2), image


@pytest.fixture(scope="module")
def exported(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    to = tmp_path_factory.mktemp("bop")
    options: dict[str, Any] = {"jpg": 95, "pixel_centre": 0.5, "scenes": SCENES, "xyz_crops": True, "fps": True}
    return Exported(export_bop(valid, to, **options, workers=1), valid)


@pytest.fixture(scope="module")
def plain(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the defaults: images linked as they are, one scene folder."""
    return export_bop(valid, tmp_path_factory.mktemp("plain"), workers=1)


def _project(K: Any, pose: dict[str, Any], points_mm: np.ndarray) -> np.ndarray:
    in_camera = points_mm @ np.reshape(pose["cam_R_m2c"], (3, 3)).T + pose["cam_t_m2c"]
    pixels = in_camera @ np.reshape(K, (3, 3)).T
    return np.asarray(pixels[:, :2] / pixels[:, 2:])


# --- the files ---


def test_every_image_is_there_once_with_its_labels(exported: Exported) -> None:
    for scene, im_id, image in exported.images():
        folder = exported.root / "train_pbr" / f"{scene:06d}"
        rgb = cv2.imread(str(folder / "rgb" / f"{int(im_id):06d}.jpg"))[..., ::-1]
        assert np.abs(rgb.astype(int) - image.rgb()).mean() < 40  # noise, as JPEG keeps it
        depth = cv2.imread(str(folder / "depth" / f"{int(im_id):06d}.png"), cv2.IMREAD_UNCHANGED)
        camera = exported.scene(scene, "camera")[im_id]
        assert np.allclose(depth * camera["depth_scale"], image.depth_mm())
        assert np.allclose(np.reshape(camera["cam_K"], (3, 3)), image.K + np.outer([0.5, 0.5, 0], [0, 0, 1]))
        poses, infos = exported.scene(scene, "gt")[im_id], exported.scene(scene, "gt_info")[im_id]
        for gt_id, instance in enumerate(image.instances):
            assert poses[gt_id]["obj_id"] == instance.obj_id
            assert np.array_equal(np.reshape(poses[gt_id]["cam_R_m2c"], (3, 3)), instance.R_m2c)
            mask = cv2.imread(str(folder / "mask_visib" / f"{int(im_id):06d}_{gt_id:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(mask == 255, instance.mask_visib())
            assert infos[gt_id]["px_count_visib"] == np.count_nonzero(mask)
    assert sorted(path.name for path in (exported.root / "train_pbr").iterdir()) == [
        *(f"{number:06d}" for number in range(SCENES)),
        "xyz_crop",
    ]


def test_coco_files_are_of_the_renumbered_images(exported: Exported) -> None:
    for scene in range(SCENES):
        coco = exported.scene(scene, "gt_coco")
        assert [image["id"] for image in coco["images"]] == [0, 1]
        assert [image["file_name"] for image in coco["images"]] == ["rgb/000000.jpg", "rgb/000001.jpg"]
        assert [item["id"] for item in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))
    counts = [sum(i.mask_visib().any() for i in image.instances) for _, _, image in exported.images()]
    found = [item["image_id"] for scene in range(SCENES) for item in exported.scene(scene, "gt_coco")["annotations"]]
    assert found == [number % 2 for number, count in enumerate(counts) for _ in range(count)]


def test_canonical_corners_move_with_the_pixel_centre(exported: Exported) -> None:
    for scene, im_id, image in exported.images():
        for entry, instance in zip(exported.scene(scene, "gt_canonical")[im_id], image.instances, strict=True):
            assert instance.label is not None
            assert np.allclose(np.array(entry["bbox3d_corners_2d"]) - 0.5, instance.label.corners_px, atol=1e-9)


def test_targets_are_the_instances_that_are_visible_enough(exported: Exported) -> None:
    expected: dict[tuple[int, int, int], int] = {}
    for scene, im_id, image in exported.images():
        for instance in image.instances:
            assert instance.visibility is not None
            if instance.visibility.visib_fract >= 0.1:
                key = scene, int(im_id), instance.obj_id
                expected[key] = expected.get(key, 0) + 1
    targets = json.loads((exported.root / "test_targets_bop19.json").read_text())
    assert {(t["scene_id"], t["im_id"], t["obj_id"]): t["inst_count"] for t in targets} == expected
    images = json.loads((exported.root / "test_targets_bop24.json").read_text())
    assert [(t["scene_id"], t["im_id"]) for t in images] == sorted({key[:2] for key in expected})


def test_what_scripts_write_is_no_link_to_the_dataset(plain: Path, valid: Path) -> None:
    """bop_toolkit's calc_gt_masks.py would write through a link."""
    before = contents(valid)
    links = {path.parent.name for path in plain.rglob("*") if path.is_symlink() and valid in path.resolve().parents}
    assert links == {"rgb", "depth"}
    for path in plain.rglob("*"):
        if path.is_file() and path.parent.name not in links:
            path.write_bytes(path.read_bytes())
    assert contents(valid) == before


@pytest.mark.usefixtures("small_scene_folders")
def test_an_export_is_validated(exported: Exported, plain: Path, valid: Path, tmp_path: Path) -> None:
    copied = export_bop(valid, tmp_path, "parts", copy=True, workers=1)
    assert not any(path.is_symlink() for path in copied.rglob("*"))
    report = validate(valid, exports=[exported.root, plain, copied], workers=1)
    assert report.lines() == [f"{valid}: 6 images, 6 of them recomputed, 34 instances, 3 exports: valid"]
    (copied / "train_pbr" / "000000" / "mask" / "000003_000001.png").write_bytes(b"")
    (copied / "train_pbr" / "000000" / "rgb" / "000009.png").touch()
    (copied / "models_eval" / "obj_000002.ply").unlink()
    report = validate(valid, exports=[copied], workers=1)
    assert {finding.file.name for finding in report.findings} == {"000003_000001.png", "000009.png", "obj_000002.ply"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "../tless"}, "no plain name"),
        ({"to_split": "a/b"}, "no plain name"),
        ({"jpg": 101}, "JPEG quality 101"),
        ({"pixel_centre": 0.25}, "it is 0, as in OpenCV, or 0.5"),
        ({"scenes": 7}, "6 images do not fill 7 scene folders of 1 to 1000; give 1 to 6"),
    ],
)
def test_what_cannot_be_is_refused(valid: Path, tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        export_bop(valid, tmp_path / "bop", **options, workers=1)
    assert not (tmp_path / "bop").exists() or not any((tmp_path / "bop").iterdir())


# --- a row of the table in docs/formats.md each ---


def test_gdr_net(exported: Exported) -> None:
    """Scene folders from 0 without a gap, .jpg, and each instance's coordinates in metres, under the file's own K."""
    with (exported.root / "models" / "fps_points.pkl").open("rb") as file:
        fps = pickle.load(file)
    assert set(fps) == {"1", "2", "3"}
    assert {key: value.shape for key, value in fps["1"].items()}["fps64_and_center"] == (65, 3)
    checked = 0
    for scene in range(SCENES):
        cameras = exported.scene(scene, "camera")
        for im_id, poses in exported.scene(scene, "gt").items():
            folder = exported.root / "train_pbr" / f"{scene:06d}"
            assert (folder / "rgb" / f"{int(im_id):06d}.jpg").is_file()
            for gt_id, pose in enumerate(poses):
                name = f"{int(im_id):06d}_{gt_id:06d}"
                with (exported.root / "train_pbr" / "xyz_crop" / f"{scene:06d}" / f"{name}-xyz.pkl").open("rb") as file:
                    crop = pickle.load(file)
                x1, y1, x2, y2 = crop["xyxy"]
                xyz = np.zeros((96, 128, 3), np.float32)
                xyz[y1 : y2 + 1, x1 : x2 + 1] = crop["xyz_crop"]
                assert crop["xyz_crop"].dtype == np.float16
                mask = cv2.imread(str(folder / "mask" / f"{name}.png"), cv2.IMREAD_UNCHANGED) == 255
                assert np.array_equal(xyz.any(axis=2), mask)
                rows, columns = np.nonzero(mask)
                if len(rows):
                    pixels = _project(cameras[im_id]["cam_K"], pose, 1000 * xyz[rows, columns].astype(np.float64))
                    assert np.abs(pixels - 0.5 - np.column_stack([columns, rows])).max() < 0.05
                    checked += 1
    assert checked > 25


def test_surfemb(valid: Path, tmp_path: Path) -> None:
    """Every entry of train_pbr is a scene folder; .jpg; 0.5 is subtracted from cx, cy; models_cad by its glob."""
    root = export_bop(valid, tmp_path, jpg=90, pixel_centre=0.5, workers=1)
    numbers = sorted(int(path.name) for path in (root / "train_pbr").glob("*"))
    assert numbers == [0]
    camera = json.loads((root / "train_pbr" / "000000" / "scene_camera.json").read_text())
    for key, image in zip(camera, Dataset.open(valid), strict=True):
        K = np.reshape(camera[key]["cam_K"], (3, 3))
        K[:2, 2] -= 0.5
        assert np.allclose(K, image.K)
        assert cv2.imread(str(root / "train_pbr" / "000000" / "rgb" / f"{int(key):06d}.jpg")).shape == (96, 128, 3)
    assert sorted(int(path.name[4:10]) for path in (root / "models_cad").glob("*.ply")) == [1, 2, 3]
    assert trimesh.load_mesh(root / "models_cad" / "obj_000002.ply").bounding_sphere.primitive.radius > 20


def test_zebrapose(exported: Exported, plain: Path) -> None:
    """The camera's file by the name of the dataset, with the image size; images by .png or else .jpg; models_eval."""
    for root in (exported.root, plain):
        camera = json.loads((root / "camera_primesense.json").read_text())
        assert (camera["width"], camera["height"]) == (128, 96)
        for folder in ("models", "models_eval"):
            infos = json.loads((root / folder / "models_info.json").read_text())
            assert all((root / folder / f"obj_{int(key):06d}.ply").is_file() for key in infos)
        for scene in (path for path in (root / "train_pbr").iterdir() if (path / "scene_camera.json").exists()):
            for key in json.loads((scene / "scene_camera.json").read_text()):
                names = [scene / "rgb" / f"{int(key):06d}.{suffix}" for suffix in ("png", "jpg")]
                assert any(name.is_file() for name in names)


def test_happypose(plain: Path) -> None:
    """Every entry of the split is a scene folder; boxes and masks of all instances; axes with offset 0 and sum 1."""
    for scene in (plain / "train_pbr").iterdir():
        camera, poses, infos = (
            json.loads((scene / f"scene_{n}.json").read_text()) for n in ("camera", "gt", "gt_info")
        )
        assert camera.keys() == poses.keys() == infos.keys()
        for key, of_image in poses.items():
            assert {"cam_R_w2c", "cam_t_w2c", "depth_scale"} <= camera[key].keys()
            for gt_id in range(len(of_image)):
                assert (scene / "mask_visib" / f"{int(key):06d}_{gt_id:06d}.png").is_file()
                assert len(infos[key][gt_id]["bbox_obj"]) == len(infos[key][gt_id]["bbox_visib"]) == 4
    for info in json.loads((plain / "models_cad" / "models_info.json").read_text()).values():
        for symmetry in info.get("symmetries_continuous", ()):
            assert np.allclose(symmetry["offset"], 0)
            assert np.array(symmetry["axis"]).sum() == 1


def test_foundationpose(plain: Path, tmp_path: Path) -> None:
    """As many images in rgb/ as entries in scene_gt.json; for tless, models_cad beside the dataset's folder."""
    shutil.copytree(plain, tmp_path / "tless")
    (tmp_path / "models_cad").symlink_to("tless/models_cad")
    scene = tmp_path / "tless" / "train_pbr" / "000000"
    pictures = sorted((scene / "rgb").glob("*"))
    assert len(pictures) == len(json.loads((scene / "scene_gt.json").read_text())) == 6
    assert Path(f"{scene}/../../../models_cad/obj_000001.ply").is_file()
    assert all(Path(str(path).replace("rgb", "depth")).is_file() for path in pictures)


# --- farthest points ---


def test_farthest_points_are_far_from_each_other() -> None:
    box = trimesh.creation.box((60, 40, 20))
    points = farthest_points(box.vertices, box.faces, 64)
    assert np.abs(points[0]).tolist() == [30, 20, 10]  # the farthest from the middle
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    to_those_before = [distances[number, :number].min() for number in range(1, 64)]
    assert to_those_before == sorted(to_those_before, reverse=True)
    assert to_those_before[-1] > 5
    assert np.allclose(np.abs(points / [30, 20, 10]).max(axis=1), 1)  # on the surface
