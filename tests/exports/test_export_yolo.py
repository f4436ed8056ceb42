"""The folder that ultralytics trains with: every number traced back to the dataset."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from synthetless.dataset import Dataset
from synthetless.dataset.reader import Instance
from synthetless.errors import UserError
from synthetless.exports.yolo import Classes, Task, export_yolo

SIZE = np.array([128, 96])


def _export(
    valid: Path, to: Path, task: Task = "detect", *, amodal: bool = False, classes: Classes | None = None
) -> Path:
    export_yolo(valid, to, task, amodal=amodal, classes=classes, workers=1)
    return to


def _rows(folder: Path, key: str) -> list[list[float]]:
    (path,) = folder.glob(f"labels/*/{key}.txt")
    return [[float(word) for word in line.split()] for line in path.read_text().splitlines()]


def _seen(valid: Path) -> list[tuple[str, list[Instance]]]:
    return [(image.key, [i for i in image.instances if i.mask_visib().any()]) for image in Dataset.open(valid)]


def _box(mask: np.ndarray) -> Sequence[float]:
    """Centre and size along the pixels' edges, as shares."""
    rows, columns = np.nonzero(mask)
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max() + 1, rows.max() + 1])
    return [*((low + high) / 2 / SIZE), *((high - low) / SIZE)]


@pytest.mark.parametrize("amodal", [False, True])
def test_boxes_are_those_of_the_masks(valid: Path, tmp_path: Path, amodal: bool) -> None:
    folder = _export(valid, tmp_path / "y", amodal=amodal)
    for key, instances in _seen(valid):
        rows = _rows(folder, key)
        masks = [instance.mask() if amodal else instance.mask_visib() for instance in instances]
        assert [row[0] for row in rows] == [instance.obj_id - 1 for instance in instances]
        assert np.allclose([row[1:] for row in rows], [_box(mask) for mask in masks], atol=1e-6)


@pytest.mark.parametrize("amodal", [False, True])
def test_polygons_drawn_by_opencv_are_the_masks(valid: Path, tmp_path: Path, amodal: bool) -> None:
    folder = _export(valid, tmp_path / "y", "segment", amodal=amodal)
    joined = 0
    for key, instances in _seen(valid):
        for row, instance in zip(_rows(folder, key), instances, strict=True):
            mask = instance.mask() if amodal else instance.mask_visib()
            points = np.reshape(row[1:], (-1, 2)) * SIZE
            assert len(points) >= 3
            drawn = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(drawn, [points.astype(np.int32)], 1)
            pieces = cv2.connectedComponents(mask.astype(np.uint8))[0] - 1
            joined += pieces > 1
            assert np.array_equal(drawn.astype(bool), mask) if pieces == 1 else (drawn >= mask).all()
    assert amodal or joined  # an instance that another one divides


def test_keypoints_are_the_canonical_corners(valid: Path, tmp_path: Path) -> None:
    folder = _export(valid, tmp_path / "y", "pose")
    data = yaml.safe_load((folder / "data.yaml").read_text())
    assert data["kpt_shape"] == [8, 3]
    assert "flip_idx" not in data
    inside = outside = 0
    for key, instances in _seen(valid):
        for row, instance in zip(_rows(folder, key), instances, strict=True):
            assert instance.label is not None
            number = int(row[0])
            assert data["obj_ids"][number] == instance.obj_id
            assert data["regressor_indices"][number] == instance.label.regressor_index
            points = np.reshape(row[5:], (8, 3))
            seen = points[:, 2] == 2
            assert np.allclose(points[seen, :2] * SIZE - 0.5, instance.label.corners_px[seen], atol=1e-3)
            away = instance.label.corners_px[~seen]
            assert ((away < -0.5) | (away >= SIZE - 0.5)).any(axis=1).all()
            assert not points[~seen].any()
            inside, outside = inside + seen.sum(), outside + (~seen).sum()
    assert inside > 100
    assert outside > 5


def test_classes_are_objects_or_their_regressors(valid: Path, tmp_path: Path) -> None:
    of: dict[str, list[str]] = {}
    for classes in ("object", "regressor"):
        folder = _export(valid, tmp_path / classes, classes="object" if classes == "object" else "regressor")
        of[classes] = list(yaml.safe_load((folder / "data.yaml").read_text())["names"].values())
    assert of["object"] == ["1", "2", "3"]
    assert of["regressor"] == ["1", "2_r0", "2_r1", "3_r0", "3_r1"]


def test_whole_drops_are_kept_for_validation(valid: Path, tmp_path: Path) -> None:
    export_yolo(valid, tmp_path / "y", val_percent=50, workers=1)
    subsets = {path.stem: path.parent.name for path in tmp_path.glob("y/labels/*/*.txt")}
    assert len(subsets) == 6
    assert subsets["000001_000000"] == subsets["000001_000001"] == "val"
    assert subsets["000001_000002"] == "train"
    assert {path.stem: path.parent.name for path in tmp_path.glob("y/images/*/*.png")} == subsets


def test_images_are_links_or_copies(valid: Path, tmp_path: Path) -> None:
    for copy in (False, True):
        export_yolo(valid, tmp_path / str(copy), copy=copy, val_percent=0, workers=1)
        pictures = sorted((tmp_path / str(copy) / "images" / "train").iterdir())
        assert len(pictures) == 6
        for path in pictures:
            scene, image = path.stem.split("_")
            original = valid / "train_synthetless" / scene / "rgb" / f"{image}.png"
            assert path.is_symlink() is not copy
            assert path.read_bytes() == original.read_bytes()
            assert copy or not path.readlink().is_absolute()


def test_workers_write_the_same_folder(valid: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        export_yolo(valid, tmp_path / str(workers), "pose", workers=workers)
    first, second = (
        {p.relative_to(tmp_path / str(w)): p.read_bytes() for p in (tmp_path / str(w)).rglob("*") if p.is_file()}
        for w in (1, 2)
    )
    assert first == second


def test_all_images_for_validation_are_refused(dataset: Path, tmp_path: Path) -> None:
    """A dataset of others: two scene folders, of which the percentage takes both or none."""
    copy = shutil.copytree(dataset, tmp_path / "d")
    (copy / "dataset.json").unlink()
    shutil.rmtree(copy / "train_synthetless" / "000001")
    scene = copy / "train_synthetless" / "000002"
    scene.rename(scene.with_name("000010"))
    with pytest.raises(UserError, match=r"too few images to keep 10 % .* --val-percent 0"):
        export_yolo(copy, tmp_path / "y", workers=1)
    assert not (tmp_path / "y").exists()


def test_a_label_of_other_symmetries_is_named(valid: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(valid, tmp_path / "d")
    path = copy / "train_synthetless" / "000001" / "scene_gt_canonical.json"
    path.write_text(path.read_text().replace('"regressor_index": 0', '"regressor_index": 7', 1))
    with pytest.raises(UserError, match=r"regressor 7 of object . is not one of symmetries.json; run relabel"):
        export_yolo(copy, tmp_path / "y", "pose", workers=1)
    assert not (tmp_path / "y").exists()


def test_a_dataset_of_others_is_told_what_it_lacks(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "d")
    (copy / "dataset.json").unlink()
    (copy / "train_synthetless" / "000002" / "scene_gt_coco.json").unlink()
    with pytest.raises(UserError, match=r"000002/scene_gt_coco\.json: not found; bop_toolkit's calc_gt_coco\.py"):
        export_yolo(copy, tmp_path / "y", workers=1)
    assert not (tmp_path / "y").exists()
