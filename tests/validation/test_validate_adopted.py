"""Datasets of others, labelled by adopt: checked as far as that goes without a recipe and records."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from damage_kit import IMAGE, WHOLE, Victim

from synthetless.dataset.records import read_scene_json, write_scene_json
from synthetless.dataset.relabel import adopt
from synthetless.validation import validate

OURS = ("dataset.json", "symmetries.json", "scene_gt_canonical.json", "scene_spec.jsonl")
SCENE = "train_synthetless/000001"
Place = tuple[str, str, int | None, int | None]


@pytest.fixture
def adopted(valid: Path, tmp_path: Path) -> Path:
    """The valid dataset as somebody else would have it: rounded poses, fields of their own; then adopted."""
    root = tmp_path / "theirs"
    shutil.copytree(valid, root, ignore=shutil.ignore_patterns(*OURS))
    for scene in sorted((root / "train_synthetless").iterdir()):
        cameras = read_scene_json(scene / "scene_camera.json")
        for camera in cameras.values():
            del camera["cam_R_w2c"], camera["cam_t_w2c"]
            camera["elev"] = 15
        write_scene_json(scene / "scene_camera.json", cameras)
        poses = read_scene_json(scene / "scene_gt.json")
        for pose in (pose for entries in poses.values() for pose in entries):
            pose |= {name: np.round(pose[name], 8).tolist() for name in ("cam_R_m2c", "cam_t_m2c")}
            pose["difficult"] = False
        write_scene_json(scene / "scene_gt.json", poses)
    adopt(root, workers=1)
    return root


def _places(root: Path) -> list[Place]:
    return [
        (finding.kind, str(finding.file.relative_to(root)), finding.image, finding.instance)
        for finding in validate(root, workers=1).findings
    ]


def test_an_adopted_dataset_is_valid_and_what_was_left_out_is_said(adopted: Path) -> None:
    report = validate(adopted, workers=2)
    assert report.valid, report.lines()
    assert (report.images, report.instances) == (6, 34)
    assert len(report.notes) == 1 and "no dataset.json" in report.notes[0] and "Not checked: models" in report.notes[0]


def test_a_few_pixels_of_rounding_are_no_fault(adopted: Path) -> None:
    """bop_toolkit renders masks and counts apart from each other."""
    with Victim(adopted).entry("gt_info", WHOLE) as info:
        info["px_count_valid"] -= 2
        info["px_count_visib"] -= 1
        info["visib_fract"] = round(info["px_count_visib"] / info["px_count_all"], 6)
        info["bbox_visib"][2] -= 1
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()


def test_labels_alone_can_be_checked(adopted: Path) -> None:
    for scene in (adopted / "train_synthetless").iterdir():
        for folder in ("rgb", "depth", "mask", "mask_visib"):
            shutil.rmtree(scene / folder)
        (scene / "scene_gt_info.json").unlink()
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()
    assert [note for note in report.notes if note.startswith("2 of 2 scene folders have no ")] == list(report.notes[1:])
    assert len(report.notes) == 6


def test_every_split_is_looked_at(adopted: Path) -> None:
    shutil.copytree(adopted / "train_synthetless", adopted / "test")
    assert validate(adopted, workers=1).images == 12
    (adopted / "test/000002/scene_gt_canonical.json").unlink()
    assert _places(adopted) == [("missing", "test/000002/scene_gt_canonical.json", None, None)]


def test_without_models_labels_are_not_recomputed(adopted: Path) -> None:
    (adopted / "models").rename(adopted / "elsewhere")
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()
    assert "labels were not recomputed" in report.notes[1]


def _pixel(path: Path, value: int) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[0, 0] = value
    cv2.imwrite(str(path), image)


def _edit(name: str, change: Callable[[Any], object]) -> Callable[[Victim], None]:
    def act(victim: Victim) -> None:
        with victim.entry(name, WHOLE) as entry:
            change(entry)

    return act


def _other_symmetries(victim: Victim) -> None:
    labels = {path: path.read_bytes() for path in victim.root.glob("*/*/scene_gt_canonical.json")}
    adopt(victim.root, scheme="atlas", workers=1)
    for path, content in labels.items():
        path.write_bytes(content)


def _one_instance_less(victim: Victim) -> None:
    with victim.entry("gt_canonical") as labels:
        labels.pop()


def _image_without_camera(victim: Victim) -> None:
    with victim.json(victim.scene.scene_camera) as cameras:
        del cameras[str(IMAGE)]


HERE = (IMAGE, WHOLE)
DAMAGES: dict[str, tuple[Callable[[Victim], object], Place]] = {
    "transposed rotation": (
        _edit("gt", lambda pose: pose.update(cam_R_m2c=np.reshape(pose["cam_R_m2c"], (3, 3)).T.ravel().tolist())),
        ("canonical", f"{SCENE}/scene_gt_canonical.json", *HERE),
    ),
    "reflection": (
        _edit("gt", lambda pose: pose.update(cam_R_m2c=[-x for x in pose["cam_R_m2c"]])),
        ("pose", f"{SCENE}/scene_gt.json", *HERE),
    ),
    "unknown object": (_edit("gt", lambda pose: pose.update(obj_id=9)), ("pose", f"{SCENE}/scene_gt.json", *HERE)),
    "behind the camera": (
        _edit("gt", lambda pose: pose.update(cam_t_m2c=[0.0, 0.0, -500.0])),
        ("pose", f"{SCENE}/scene_gt.json", *HERE),
    ),
    "no rotation at all": (
        _edit("gt", lambda pose: pose.pop("cam_R_m2c")),
        ("schema", f"{SCENE}/scene_gt.json", *HERE),
    ),
    "another regressor": (
        _edit("gt_canonical", lambda label: label.update(regressor_index=label["regressor_index"] + 1)),
        ("canonical", f"{SCENE}/scene_gt_canonical.json", *HERE),
    ),
    "a label less": (_one_instance_less, ("ids", f"{SCENE}/scene_gt_canonical.json", IMAGE, None)),
    "other symmetries": (_other_symmetries, ("stale", f"{SCENE}/scene_gt_canonical.json", None, None)),
    "no table": (
        lambda victim: (victim.root / "symmetries.json").unlink(),
        ("missing", "symmetries.json", None, None),
    ),
    "a cut table": (
        lambda victim: (victim.root / "symmetries.json").write_text("{"),
        ("symmetries", "symmetries.json", None, None),
    ),
    "no camera": (_image_without_camera, ("missing", f"{SCENE}/scene_camera.json", IMAGE, None)),
    "no poses": (
        lambda victim: victim.scene.scene_gt.unlink(),
        ("missing", f"{SCENE}/scene_gt.json", None, None),
    ),
    "a count": (
        _edit("gt_info", lambda info: info.update(px_count_valid=int(0.97 * info["px_count_valid"]))),
        ("gt_info", f"{SCENE}/scene_gt_info.json", *HERE),
    ),
    "a box": (
        _edit("gt_info", lambda info: info["bbox_visib"].__setitem__(2, info["bbox_visib"][2] + 2)),
        ("gt_info", f"{SCENE}/scene_gt_info.json", *HERE),
    ),
    "a pixel more": (
        lambda victim: _pixel(victim.visible(), 255),
        ("mask", f"{SCENE}/mask_visib/000001_000001.png", *HERE),
    ),
    "a grey pixel": (
        lambda victim: _pixel(victim.mask(), 7),
        ("picture", f"{SCENE}/mask/000001_000001.png", *HERE),
    ),
    "a missing mask": (lambda victim: victim.mask().unlink(), ("missing", f"{SCENE}/mask", *HERE)),
    "a mask too many": (
        lambda victim: shutil.copy(victim.mask(), victim.scene.mask(IMAGE, 99)),
        ("stray", f"{SCENE}/mask/000001_000099.png", IMAGE, 99),
    ),
    "a missing picture": (lambda victim: victim.rgb.unlink(), ("missing", f"{SCENE}/rgb", IMAGE, None)),
    "a cut picture": (
        lambda victim: victim.rgb.write_bytes(victim.rgb.read_bytes()[:-9]),
        ("unreadable", f"{SCENE}/rgb/000001.png", IMAGE, None),
    ),
    "depth of another size": (
        lambda victim: cv2.imwrite(str(victim.depth), np.ones((9, 9), np.uint16)),
        ("picture", f"{SCENE}/depth/000001.png", IMAGE, None),
    ),
    "no depth where it was counted": (
        lambda victim: cv2.imwrite(str(victim.depth), np.zeros((96, 128), np.uint16)),
        ("gt_info", f"{SCENE}/scene_gt_info.json", *HERE),
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_found_in_its_place(adopted: Path, name: str) -> None:
    act, place = DAMAGES[name]
    act(Victim(adopted))
    assert place in _places(adopted)


def test_what_needs_records_is_refused(adopted: Path, tmp_path: Path) -> None:
    export = tmp_path / "coco.json"
    export.write_text("{}")
    with pytest.raises(ValueError, match="--export is for datasets that generate made"):
        validate(adopted, exports=[export])


def test_a_folder_without_labels_is_no_dataset_of_ours(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "theirs"
    shutil.copytree(valid, root, ignore=shutil.ignore_patterns(*OURS))
    with pytest.raises(ValueError, match="give a folder that generate filled, or that adopt labelled"):
        validate(root)


def test_a_dataset_that_lost_its_header_is_not_taken_for_an_adopted_one(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "ours"
    shutil.copytree(valid, root)
    (root / "dataset.json").unlink()
    report = validate(root, workers=1)
    assert [(finding.kind, finding.file.name) for finding in report.findings] == [("missing", "dataset.json")]
    assert json.loads(json.dumps(report.to_json()))["valid"] is False
