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
    with pytest.raises(ValueError, match=r"no dataset\.json; --deep is for datasets that generate made"):
        validate(adopted, sample=None)
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


# --- pictures of every format ---

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 1234\n"


def _as(victim: Victim, source: str, folder: str, suffix: str) -> Path:
    """Give the pictures of a folder, of every scene, another format; return image 1's."""
    for scene in (victim.root / "train_synthetless").iterdir():
        (scene / folder).mkdir(exist_ok=True)
        for path in sorted((scene / source).glob("*.png")):
            pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE if folder == "gray" else cv2.IMREAD_UNCHANGED)
            _, encoded = cv2.imencode(suffix.lower(), pixels)
            path.unlink()
            (scene / folder / path.name).with_suffix(suffix).write_bytes(encoded.tobytes())
    return victim.scene.root / folder / f"{IMAGE:06d}{suffix}"


FORMATS = [("rgb", "rgb", suffix) for suffix in (".png", ".jpg", ".jpeg", ".JPG", ".tif", ".PNG")]
FORMATS += [("rgb", "gray", suffix) for suffix in (".png", ".tif", ".tiff", ".jpg", ".TIF")]
FORMATS += [("depth", "depth", ".tif"), ("mask", "mask", ".PNG"), ("mask_visib", "mask_visib", ".tif")]


@pytest.mark.parametrize(("source", "folder", "suffix"), FORMATS, ids=["".join(f[1:]) for f in FORMATS])
def test_pictures_of_every_format_are_opened(adopted: Path, source: str, folder: str, suffix: str) -> None:
    victim = Victim(adopted)
    masks = folder.startswith("mask")
    path = _as(victim, source, folder, suffix)
    path = path.with_name(f"{IMAGE:06d}_{WHOLE:06d}{suffix}") if masks else path
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()
    place = (str(path.relative_to(adopted)), IMAGE, WHOLE if masks else None)
    whole = path.read_bytes()
    for damaged in (POINTER, whole[: len(whole) // 2], whole[: -max(3, len(whole) // 20)]):
        path.write_bytes(damaged)
        assert ("unreadable", *place) in _places(adopted), len(damaged)
    pixels = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_UNCHANGED)
    path.write_bytes(cv2.imencode(suffix.lower(), pixels[:-1])[1].tobytes())
    assert ("picture", *place) in _places(adopted)


def test_a_dataset_without_a_readable_picture_is_not_valid(adopted: Path) -> None:
    """As after a git clone without LFS: no size is known, and yet every file is looked at."""
    pictures = sorted(path for path in adopted.glob("*/*/*/*.*") if not path.parts[-4].startswith("."))
    for path in pictures:
        path.write_bytes(POINTER)
    report = validate(adopted, limit=10_000, workers=1)
    assert {f.file for f in report.findings if f.kind == "unreadable"} == set(pictures)
    with Victim(adopted).entry("gt_info", WHOLE) as info:
        info["px_count_visib"] += 1000
    assert ("gt_info", f"{SCENE}/scene_gt_info.json", *HERE) in _places(adopted)


def test_files_that_git_lfs_did_not_fetch_are_named(tmp_path: Path) -> None:
    """A BOP dataset of one image, as somebody had it."""
    case = Path(__file__).resolve().parents[3] / "shared/cases/unreadable_pictures/bop"
    if not case.is_dir():
        pytest.skip(f"{case} is not here")
    root = tmp_path / "bop"
    shutil.copytree(case, root)
    adopt(root, workers=1)
    report = validate(root, workers=1)
    names = sorted(str(f.file.relative_to(root / "test/000001")) for f in report.findings if f.kind == "unreadable")
    assert names == [
        "depth/000000.png",
        "mask/000000_000000.png",
        "mask_visib/000000_000000.png",
        "rgb/000000.png",
    ]


def test_files_of_other_names_are_named_as_not_checked(adopted: Path) -> None:
    scene = Victim(adopted).scene.root
    for name in ("rgb/000001.npy", "rgb/.DS_Store", "gray_cam1/000001.png", "notes.txt"):
        (scene / name).parent.mkdir(exist_ok=True)
        (scene / name).write_bytes(b"?")
    (adopted / "test_targets_bop19.json").write_text("[]")
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()
    for name in ("rgb/000001.npy", "rgb/.DS_Store", "gray_cam1", "notes.txt", "test_targets_bop19.json", "camera.json"):
        assert name in report.notes[0]


# --- layouts of BOP 2024 ---


def _cameras_without_K(root: Path, scene_id: int = 1) -> None:
    path = root / f"train_synthetless/{scene_id:06d}/scene_camera.json"
    cameras = read_scene_json(path)
    for camera in cameras.values():
        del camera["cam_K"]
        camera["cam_model"] = {"projection_model_type": "CameraModelType.FISHEYE624", "image_width": 128}
    write_scene_json(path, cameras)


def test_camera_models_are_named_as_unsupported(adopted: Path) -> None:
    _cameras_without_K(adopted)
    with pytest.raises(ValueError, match=r"scene_camera\.json: image 0: cam_model is CameraModelType\.FISHEYE624"):
        adopt(adopted, workers=1)
    report = validate(adopted, workers=1)
    assert [f.message for f in report.findings] == [
        "3 images have a cam_model that is not supported; PinholePlane and OpenCV, with their parameters, are"
    ]


@pytest.mark.parametrize("beside", [True, False])
def test_several_sensors_in_a_scene_are_named_as_unsupported(adopted: Path, beside: bool) -> None:
    scene = Victim(adopted).scene.root
    for name in ("scene_gt", "scene_camera", "scene_gt_info"):
        path = scene / f"{name}.json"
        shutil.copy(path, scene / f"{name}_cam1.json")
        if not beside:
            path.unlink()
    with pytest.raises(ValueError, match=r"000001: has scene_gt_cam1\.json, several sensors in one scene folder"):
        adopt(adopted, workers=1)
    report = validate(adopted, workers=1)
    assert report.valid == beside
    assert any("several sensors in one scene folder (scene_gt_cam1.json) are not supp" in note for note in report.notes)


def test_symmetries_that_adopt_was_told_otherwise_are_no_fault(adopted: Path, tmp_path: Path) -> None:
    """models_info.json declares what is no group, and a table said it instead."""
    with Victim(adopted).json(adopted / "models/models_info.json") as infos:
        infos["3"]["symmetries_discrete"][0][0] = 0.5
    table = tmp_path / "table.json"
    table.write_text('{"3": "C1"}')
    with pytest.raises(ValueError, match=r"models_info\.json: object 3"):
        adopt(adopted, workers=1)
    adopt(adopted, symmetries=table, workers=1)
    report = validate(adopted, workers=1)
    assert report.valid, report.lines()


# --- what adopt refuses, and validate tells while it goes on ---


def _info(victim: Victim, **changes: Any) -> None:
    with victim.json(victim.root / "models/models_info.json") as infos:
        infos["2"] |= changes
        infos["2"] = {key: value for key, value in infos["2"].items() if value != "gone"}


WRONG_INPUT: dict[str, tuple[Callable[[Victim], Any], str, str]] = {
    "no diameter": (lambda v: _info(v, diameter="gone"), "models/models_info.json", "object 2: diameter"),
    "diameter NaN": (lambda v: _info(v, diameter=float("nan")), "models/models_info.json", "object 2: diameter"),
    "diameter 0": (lambda v: _info(v, diameter=0), "models/models_info.json", "object 2: diameter"),
    "diameter as text": (lambda v: _info(v, diameter="40"), "models/models_info.json", "object 2: diameter"),
    "box as list": (lambda v: _info(v, size_x=[30]), "models/models_info.json", "object 2: size_x"),
    "box null": (lambda v: _info(v, min_z=None), "models/models_info.json", "object 2: min_z"),
    "box infinite": (lambda v: _info(v, size_y=float("inf")), "models/models_info.json", "object 2: size_y"),
    "pose as text": (
        _edit("gt", lambda pose: pose.update(cam_t_m2c=[str(x) for x in pose["cam_t_m2c"]])),
        f"{SCENE}/scene_gt.json",
        "cam_t_m2c.0",
    ),
    "pose NaN": (
        _edit("gt", lambda pose: pose["cam_t_m2c"].__setitem__(1, float("nan"))),
        f"{SCENE}/scene_gt.json",
        "cam_t_m2c",
    ),
    "object true": (_edit("gt", lambda pose: pose.update(obj_id=True)), f"{SCENE}/scene_gt.json", "obj_id"),
    "camera as text": (
        lambda v: _camera(v, cam_K=["300", 0, 63.2, 0, 298, 47.7, 0, 0, 1]),
        f"{SCENE}/scene_camera.json",
        "cam_K",
    ),
    "depth scale 0": (lambda v: _camera(v, depth_scale=0), f"{SCENE}/scene_camera.json", "depth_scale"),
    "depth scale as text": (lambda v: _camera(v, depth_scale="1"), f"{SCENE}/scene_camera.json", "depth_scale"),
}


def _camera(victim: Victim, **changes: Any) -> None:
    with victim.entry("camera") as camera:
        camera.update(changes)


@pytest.mark.parametrize("name", WRONG_INPUT)
def test_adopt_refuses_what_validate_refuses_and_validate_goes_on(adopted: Path, name: str) -> None:
    act, file, key = WRONG_INPUT[name]
    victim = Victim(adopted)
    act(victim)
    victim.visible().write_bytes(POINTER)
    with Victim(adopted).json(victim.scene.scene_gt_canonical) as labels:
        labels["2"][0]["regressor_index"] += 7
    report = validate(adopted, workers=1)
    found = [(str(f.file.relative_to(adopted)), f.message) for f in report.findings]
    assert any(path == file and key in message for path, message in found), found
    kinds = {(f.kind, f.image) for f in report.findings}
    assert {("unreadable", IMAGE), ("canonical", 2)} <= kinds, report.lines()
    assert not any(f.kind == "pose" for f in report.findings), report.lines()
    with pytest.raises(ValueError, match=key.removeprefix("object 2: ").split(".")[0]) as refused:
        adopt(adopted, workers=1)
    assert Path(file).name in str(refused.value) and "\n" not in str(refused.value)
