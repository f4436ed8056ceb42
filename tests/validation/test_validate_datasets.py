"""Datasets of every make are valid as they are, and the report says what was looked at."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import valid_dataset
from damage_kit import IMAGE, WHOLE, Victim

from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import read_scene_json, write_scene_json
from synthetless.dataset.relabel import relabel
from synthetless.io.files import locked
from synthetless.io.images import encode_normals, encode_object_coordinates, encode_png
from synthetless.io.meshes import read_mesh
from synthetless.io.models import load_models
from synthetless.scenes.spec import SurfaceColours
from synthetless.symmetry import SymmetryTable
from synthetless.validation import Report, validate
from synthetless.validation.run import SceneResult, SceneTask, check_scene

EVERYTHING = "outputs=[rgb, depth, masks, normals, object_coordinates, exr]"
MAKES = {
    "labels alone": ("outputs=[]",),
    "colour alone": ("outputs=[rgb]",),
    "depth without masks": ("outputs=[depth]",),
    "everything": (EVERYTHING,),
    "jpeg": ("encoding.rgb_format=jpg",),
    "visible within a tolerance": ("labels.visibility_delta_mm=5", EVERYTHING),
    "a small table, fine depth": ("table.size_m=0.5", "encoding.depth_scale=0.01"),
    "much beyond the depth's range": ("encoding.depth_scale=0.0065",),
    "objects in boxes": ("release.container=box", "release.container.box.height_m=[0.03, 0.2]", EVERYTHING),
    "a lit room": ("light.room=ranges", "objects.metallic=[0, 0.5]", "objects.grey_scale=linear"),
    "a low camera": ("camera.elevation_deg=[3, 8]",),
    "other labels": ("labels.scheme=atlas",),
}


@pytest.mark.parametrize("overrides", MAKES.values(), ids=MAKES.keys())
def test_every_make_of_dataset_is_valid(tmp_path: Path, parts: Path, overrides: tuple[str, ...]) -> None:
    valid_dataset.write_dataset(tmp_path / "d", parts, overrides)
    report = validate(tmp_path / "d", workers=1)
    assert report.lines() == [f"{tmp_path / 'd'}: 6 images, 6 of them recomputed, 34 instances: valid"]


@pytest.fixture(scope="module")
def cluttered(tmp_path_factory: pytest.TempPathFactory, parts: Path) -> tuple[Path, Path]:
    """A dataset with distractors, and their models."""
    folder = tmp_path_factory.mktemp("cluttered")
    balls = valid_dataset.write_distractors(folder / "balls")
    overrides = ("objects.distractors=[2, 3]", f"source.distractors={balls}")
    valid_dataset.write_dataset(folder / "d", parts, overrides)
    return folder / "d", balls


def test_distractors_hide_but_need_no_labels(cluttered: tuple[Path, Path]) -> None:
    report = validate(cluttered[0], workers=1)
    assert report.valid, report.lines()
    assert report.recomputed_images == 6
    hidden = [
        info["visib_fract"]
        for entries in read_scene_json(ScenePaths.of(cluttered[0], 1).scene_gt_info).values()
        for info in entries
    ]
    assert min(hidden) < 0.9


def test_a_box_hides_and_is_checked(valid: Path, tmp_path: Path, parts: Path) -> None:
    """What the record says of it is what the recipe draws, and what the files show."""
    root = tmp_path / "d"
    narrow = ("release.container.box.sides_m=[0.13, 0.14]", "release.container.box.height_m=[0.1, 0.15]")
    valid_dataset.write_dataset(root, parts, ("release.container=box", *narrow))
    shares = [
        np.mean([info["visib_fract"] for image in read_scene_json(of.scene_gt_info).values() for info in image])
        for of in (ScenePaths.of(folder, 1) for folder in (root, valid))
    ]
    assert shares[0] < shares[1] - 0.1

    def found(change: str, value: float) -> set[tuple[str, str]]:
        damaged = tmp_path / change
        shutil.copytree(root, damaged, ignore=shutil.ignore_patterns(".records"))
        with Victim(damaged).specs() as lines:
            lines[IMAGE]["scene"]["container"][change] = value
        report = validate(damaged, workers=1)
        return {(f.kind, f.file.name) for f in report.findings if f.image == IMAGE}

    assert {("spec", "scene_spec.jsonl"), ("depth", "000001.png")} <= found("height_m", 0.05)
    assert found("rotation_deg", 1e300) >= {("spec", "scene_spec.jsonl")}
    assert found("wall_m", -1.0) == {("spec", "scene_spec.jsonl")}, "nothing to cast at"


def test_surroundings_are_checked(tmp_path: Path, parts: Path) -> None:
    root = tmp_path / "d"
    valid_dataset.write_dataset(root, parts, ("light.room=ranges",))
    assert not validate(root, workers=1).findings
    for key, value in (("walls", [[9.0, 9.0, 9.0]] * 4), ("lamps", [])):
        with Victim(root).specs() as lines:
            kept, lines[IMAGE]["scene"]["room"][key] = lines[IMAGE]["scene"]["room"][key], value
        found = {(f.kind, f.file.name) for f in validate(root, workers=1).findings if f.image == IMAGE}
        assert ("spec", "scene_spec.jsonl") in found
        with Victim(root).specs() as lines:
            lines[IMAGE]["scene"]["room"][key] = kept


@pytest.mark.parametrize("asked", [(), ("light.room=ranges", "release.container=box")])
def test_a_drop_that_is_none_is_told(tmp_path: Path, parts: Path, asked: tuple[str, ...]) -> None:
    root = tmp_path / "d"
    valid_dataset.write_dataset(root, parts, (*asked, "outputs=[]"))
    with Victim(root).specs() as lines:
        lines[IMAGE]["scene"]["drop"] = -1
    found = {(f.kind, f.file.name) for f in validate(root, workers=1).findings if f.image == IMAGE}
    assert ("spec", "scene_spec.jsonl") in found


def test_textures_are_carried_along_and_checked(tmp_path: Path, parts: Path) -> None:
    models, root = tmp_path / "models", tmp_path / "d"
    shutil.copytree(parts, models)
    mesh = read_mesh(models / "obj_000001.ply")
    uv = np.zeros((len(mesh.faces), 3, 2), dtype=np.float32)
    picture = encode_png(np.full((8, 8, 3), 90, dtype=np.uint8))
    colours = SurfaceColours(texture=np.full((8, 8, 3), 90, dtype=np.uint8), corner_uv=uv)
    (models / "obj_000001.ply").write_bytes(replace(mesh, colours=colours).to_ply("skin.png"))
    (models / "skin.png").write_bytes(picture)
    valid_dataset.write_dataset(root, models, ("objects.colour=mixed",))
    assert not validate(root, workers=1).findings
    assert load_models(root / "models", (1,), colours=True)[1].colours is not None
    texture = root / "models" / "obj_000001.png"
    texture.write_bytes(encode_png(np.full((8, 8, 3), 91, dtype=np.uint8)))
    assert [(f.kind, f.file.name) for f in validate(root, workers=1).findings] == [("models", texture.name)]
    texture.unlink()
    assert [(f.kind, f.file.name) for f in validate(root, workers=1).findings] == [("missing", texture.name)]


def test_rays_that_cannot_be_cast_are_noted(cluttered: tuple[Path, Path]) -> None:
    dataset, balls = cluttered
    balls.rename(balls.with_name("elsewhere"))
    try:
        report = validate(dataset, workers=1)
    finally:
        balls.with_name("elsewhere").rename(balls)
    assert report.valid
    assert report.recomputed_images == 0
    assert "6 images could not be recomputed" in report.notes[0]


def test_a_sample_is_spread_evenly_and_noted(valid: Path) -> None:
    report = validate(valid, sample=2, workers=1)
    assert report.valid and report.recomputed_images == 2
    assert report.notes == ("2 of 6 images were recomputed, evenly spread; --deep recomputes every one",)
    assert validate(valid, sample=None, workers=1).recomputed_images == 6


def test_a_dataset_that_is_being_written_is_not_judged(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    with locked(root), pytest.raises(ValueError, match="another synthetless is writing here, or was meanwhile"):
        validate(root, workers=1)
    assert validate(root, workers=1).valid


def test_a_dataset_that_was_relabelled_meanwhile_is_not_judged(
    valid: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the reading of symmetries.json and that of the labels."""
    root = tmp_path / "d"
    shutil.copytree(valid, root)

    def relabel_first(task: SceneTask) -> SceneResult:
        relabel(root, scheme="atlas", workers=1)
        return check_scene(task)

    monkeypatch.setattr("synthetless.validation.run.check_scene", relabel_first)
    with pytest.raises(ValueError, match="another synthetless is writing here, or was meanwhile"):
        validate(root, workers=1)
    monkeypatch.undo()
    with valid_dataset.small_scene_folders():
        assert validate(root, workers=1).valid


def test_workers_find_the_same(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    for scene_id in (1, 2):
        with Victim(root).entry("gt", WHOLE, scene_id) as pose:
            pose["cam_t_m2c"][0] += 1
    alone = validate(root, workers=1)
    assert not alone.valid
    assert validate(root, workers=2) == alone


def test_folders_in_parts_are_found_the_same(valid: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    for im_id in range(3):
        (root / f"train_synthetless/000001/rgb/{im_id:06d}.png").write_bytes(b"")
    with Victim(root).entry("gt", WHOLE, 1) as pose:
        pose["cam_t_m2c"][0] += 1
    whole = validate(root, workers=1)
    monkeypatch.setattr("synthetless.validation.run._IMAGES_WORTH_A_TASK", 1)
    tasks: list[SceneTask] = []
    monkeypatch.setattr("synthetless.validation.run.check_scene", lambda task: tasks.append(task) or check_scene(task))
    parts = validate(root, workers=1)
    assert [(task.scene_id, task.part, task.parts) for task in tasks] == [(1, 0, 2), (1, 1, 2), (2, 0, 2), (2, 1, 2)]
    assert set(parts.findings) == set(whole.findings) and len(parts.findings) == len(whole.findings) > 3
    assert (parts.images, parts.instances, parts.recomputed_images) == (
        whole.images,
        whole.instances,
        whole.recomputed_images,
    )


def test_a_report_keeps_a_few_faults_of_each_kind_and_counts_all(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    shutil.rmtree(root / "train_synthetless/000001/mask")
    (root / "train_synthetless/000002/rgb/000000.png").write_bytes(b"")
    report = validate(root, limit=3, workers=1)
    n_masks = len(list((valid / "train_synthetless/000001/mask").iterdir()))
    assert report.counts == {"missing": n_masks, "unreadable": 1}
    assert [finding.kind for finding in report.findings] == ["missing"] * 3 + ["unreadable"]
    lines = report.lines()
    assert f"missing: ... and {n_masks - 3} more" in lines
    assert "unreadable: train_synthetless/000002/rgb/000000.png, image 0: is empty: zero bytes" in lines
    assert lines[-1].endswith(f"6 images, 6 of them recomputed, 34 instances: {n_masks + 1} faults")
    content = json.loads(json.dumps(report.to_json()))
    assert (content["valid"], content["counts"]["missing"]) == (False, n_masks)
    assert content["findings"][0] == {
        "kind": "missing",
        "file": "train_synthetless/000001/mask/000000_000000.png",
        "image": 0,
        "instance": 0,
        "message": "not there",
    }


@pytest.mark.parametrize(
    ("path", "export", "message"),
    [
        ("nowhere", None, "no such dataset folder"),
        ("", None, r"no dataset\.json; give a folder that generate filled"),
        ("d", "coco.json", r"coco\.json: no such export"),
        ("d", "models", "is no export"),
    ],
)
def test_a_wrong_request_is_refused(valid: Path, path: str, export: str | None, message: str) -> None:
    dataset = valid if path == "d" else valid.parent / path
    with pytest.raises(ValueError, match=message):
        validate(dataset, exports=[] if export is None else [valid / export], workers=1)


def _relabel_scene(root: Path, scene_id: int) -> None:
    """What a relabelling writes into one scene folder."""
    scene = ScenePaths.of(root, scene_id)
    infos = {int(key): info for key, info in json.loads((root / "models/models_info.json").read_text()).items()}
    gt, camera = read_scene_json(scene.scene_gt), read_scene_json(scene.scene_camera)
    labels = label_scene(gt, camera, SymmetryTable.read(root / "symmetries.json"), infos)
    write_scene_json(scene.scene_gt_canonical, labels)


def _edit_symmetries(root: Path) -> None:
    with Victim(root).json(root / "symmetries.json") as table:
        table["objects"]["3"] = {"group": "D2", "axis": [0, 0, 1], "secondary_axis": [1, 0, 0]}
    with Victim(root).json(root / "dataset.json") as header:
        header["symmetries"]["sha256"] = SymmetryTable.read(root / "symmetries.json").digest()


def _stale(report: Report) -> list[tuple[str, str]]:
    return [(f.file.parent.name, f.message) for f in report.findings if f.kind == "stale"]


def test_a_stale_and_a_half_relabelled_dataset_are_told_apart(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    _edit_symmetries(root)
    of_object = "labels of object 3 are of other symmetries than symmetries.json; "
    stale = _stale(validate(root, workers=1))
    assert stale == [("000001", of_object + "run relabel"), ("000002", of_object + "run relabel")]
    _relabel_scene(root, 1)
    half = "other scene folders have them, the dataset is half relabelled: run relabel"
    assert _stale(validate(root, workers=1)) == [("000002", of_object + half)]
    _relabel_scene(root, 2)
    assert validate(root, workers=1).valid


@pytest.fixture
def complete(tmp_path: Path, parts: Path) -> Victim:
    """A dataset of every output, to be damaged."""
    valid_dataset.write_dataset(tmp_path / "d", parts, (EVERYTHING, "encoding.rgb_format=jpg"))
    return Victim(tmp_path / "d")


def _found(victim: Victim) -> list[tuple[str, str, int | None, int | None]]:
    report = validate(victim.root, workers=1)
    return [(f.kind, f"{f.file.parent.name}/{f.file.name}", f.image, f.instance) for f in report.findings]


def test_damage_to_the_other_outputs_is_found(complete: Victim) -> None:
    scene = complete.scene
    for path in (scene.rgb(IMAGE, "jpg"), scene.exr(IMAGE)):
        path.write_bytes(path.read_bytes()[:-400])
    complete.repaint(scene.normals(IMAGE), lambda pixels: np.where(pixels > 0, 40000, 0).astype(np.uint16))
    scene.normals(0).write_bytes(encode_normals(np.zeros((96, 128, 3))))
    nothing = np.zeros((96, 128, 3)), np.zeros((96, 128), dtype=bool)
    scene.object_coordinates(0).write_bytes(encode_object_coordinates(*nothing))
    visible = cv2.imread(str(complete.visible()), cv2.IMREAD_UNCHANGED)[..., None] > 0
    complete.repaint(scene.object_coordinates(IMAGE), lambda pixels: np.where(visible, pixels[..., ::-1], pixels))
    assert _found(complete) == [
        ("unreadable", "rgb/000001.jpg", IMAGE, None),
        ("unreadable", "exr/000001.exr", IMAGE, None),
        ("geometry", "normals/000000.png", 0, None),
        ("geometry", "object_coordinates/000000.png", 0, None),
        ("geometry", "normals/000001.png", IMAGE, None),
        ("geometry", "object_coordinates/000001.png", IMAGE, WHOLE),
    ]


def test_a_depth_file_times_its_scale_is_the_ray_cast_depth(valid: Path, parts: Path) -> None:
    """To half a unit, 0.05 mm where the scale is 0.1."""
    seen = valid_dataset.ray_cast(valid, parts)
    for (scene_id, im_id), annotation in seen.items():
        scene = ScenePaths.of(valid, scene_id)
        scale = read_scene_json(scene.scene_camera)[im_id]["depth_scale"]
        assert scale == 0.1
        stored = cv2.imread(str(scene.depth(im_id)), cv2.IMREAD_UNCHANGED).astype(np.float64) * scale
        assert np.abs(stored - annotation.depth_mm).max() <= 0.05 + 1e-9
        assert annotation.depth_mm.min() > 300
    assert len(seen) == valid_dataset.IMAGES
