"""One COCO file for a split, read back by pycocotools."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import read_scene_json
from synthetless.errors import UserError
from synthetless.exports.coco import BoxKind, export_coco
from synthetless.io.images import decode_mask, decode_rgb

Change = Callable[[dict[str, Any]], object]


def _load(path: Path) -> COCO:
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(str(path))


def _mask(scene: ScenePaths, kind: str, im_id: int, gt_id: int) -> np.ndarray:
    path = getattr(scene, kind)(im_id, gt_id)
    return decode_mask(path.read_bytes(), path)


@pytest.fixture(scope="module")
def exported(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("coco") / "annotations" / "train.json"
    assert export_coco(dataset, path) == 6
    return path


def test_every_visible_instance_is_there_with_its_mask(dataset: Path, exported: Path) -> None:
    coco = _load(exported)
    expected, found = set(), set()
    for image in coco.imgs.values():
        scene = ScenePaths.of(dataset, image["scene_id"])
        infos = read_scene_json(scene.scene_gt_info)[image["im_id"]]
        expected |= {(image["id"], gt_id) for gt_id, info in enumerate(infos) if info["px_count_visib"]}
        for annotation in coco.imgToAnns[image["id"]]:
            found.add((image["id"], annotation["gt_id"]))
            mask = _mask(scene, "mask_visib", image["im_id"], annotation["gt_id"])
            assert np.array_equal(coco.annToMask(annotation).astype(bool), mask)
            assert annotation["area"] == mask.sum()
    assert found == expected
    assert 6 < len(expected) <= 6 * 4 + 2 - 6  # four instances an image, six in the last; one in each is hidden


def test_ids_are_unique_through_all_scenes(exported: Path) -> None:
    content = json.loads(exported.read_text())
    assert [image["id"] for image in content["images"]] == [1, 2, 3, 4, 5, 6]
    assert [a["id"] for a in content["annotations"]] == list(range(1, len(content["annotations"]) + 1))
    assert {(image["scene_id"], image["im_id"]) for image in content["images"]} == {
        (s, i) for s in (1, 2) for i in range(3)
    }


def test_images_are_found_from_the_file(exported: Path) -> None:
    for image in json.loads(exported.read_text())["images"]:
        rgb = decode_rgb((exported.parent / image["file_name"]).read_bytes())
        assert rgb.shape == (image["height"], image["width"], 3)


@pytest.mark.parametrize(("boxes", "kind"), [("visible", "mask_visib"), ("amodal", "mask")])
def test_boxes_are_of_the_visible_part_or_of_the_whole(
    dataset: Path, tmp_path: Path, boxes: BoxKind, kind: str
) -> None:
    export_coco(dataset, tmp_path / "train.json", boxes=boxes)
    coco = _load(tmp_path / "train.json")
    for annotation in coco.anns.values():
        image = coco.imgs[annotation["image_id"]]
        mask = _mask(ScenePaths.of(dataset, image["scene_id"]), kind, image["im_id"], annotation["gt_id"])
        x, y, w, h = annotation["bbox"]
        assert mask.sum() == mask[y : y + h, x : x + w].sum()
        assert mask[y].any() and mask[y + h - 1].any() and mask[:, x].any() and mask[:, x + w - 1].any()


def test_labels_are_those_of_the_scene(dataset: Path, exported: Path) -> None:
    coco = _load(exported)
    outside = 0
    for annotation in coco.anns.values():
        image, gt_id = coco.imgs[annotation["image_id"]], annotation["gt_id"]
        scene = ScenePaths.of(dataset, image["scene_id"])
        gt = read_scene_json(scene.scene_gt)[image["im_id"]][gt_id]
        canonical = read_scene_json(scene.scene_gt_canonical)[image["im_id"]][gt_id]
        assert annotation["category_id"] == gt["obj_id"] == canonical.pop("obj_id")
        assert annotation["cam_R_m2c"] == gt["cam_R_m2c"]
        keypoints = np.reshape(annotation["keypoints"], (8, 3))
        assert np.array_equal(keypoints[:, :2], canonical.pop("bbox3d_corners_2d"))
        inside = ((keypoints[:, :2] >= -0.5) & (keypoints[:, :2] < [63.5, 47.5])).all(axis=1)
        assert np.array_equal(keypoints[:, 2], np.where(inside, 2, 1))
        assert {key: annotation[key] for key in canonical} == canonical
        outside += int((~inside).sum())
    assert outside > 0


def test_the_skeleton_is_the_boxs_edges(exported: Path) -> None:
    category = _load(exported).cats[1]
    names = category["keypoints"]
    assert len(set(names)) == 8
    assert names[4] == "x+y-z-"
    edges = {tuple(edge) for edge in category["skeleton"]}
    assert len(edges) == 12
    assert all(sum(a != b for a, b in zip(names[i - 1], names[j - 1], strict=True)) == 1 for i, j in edges)


def test_the_licence_of_the_models_travels_along(exported: Path) -> None:
    content = json.loads(exported.read_text())
    assert content["licenses"] == [{"id": 1, "name": "CC0, made for the tests", "url": ""}]
    assert all(image["license"] == 1 for image in content["images"])


@pytest.mark.parametrize("kind", ["segm", "bbox", "keypoints"])
def test_the_truth_scores_one(exported: Path, kind: str) -> None:
    coco = _load(exported)
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation = COCOeval(coco, coco.loadRes([{**annotation, "score": 1.0} for annotation in coco.anns.values()]))
        evaluation.params.iouType = kind
        evaluation.params.kpt_oks_sigmas = np.full(8, 0.05)
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][..., 0, -1]  # all sizes, most detections
    assert (precision > -1).any()
    assert precision[precision > -1].min() > 1 - 1e-9


def test_the_same_dataset_gives_the_same_bytes(dataset: Path, exported: Path) -> None:
    before = exported.read_bytes()
    export_coco(dataset, exported)
    assert exported.read_bytes() == before


def test_contradictions_are_named(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    scene = ScenePaths.of(copy, 2)
    coco = json.loads(scene.scene_gt_coco.read_text())
    coco["annotations"].pop(0)
    scene.scene_gt_coco.write_text(json.dumps(coco))
    with pytest.raises(ValueError, match=r"000002/scene_gt_coco\.json: image 0 does not list the \d visible instances"):
        export_coco(copy, tmp_path / "train.json")
    scene.scene_gt_canonical.unlink()
    with pytest.raises(ValueError, match=r"scene_gt_canonical\.json: not found"):
        export_coco(copy, tmp_path / "train.json")
    assert not (tmp_path / "train.json").exists()
    with pytest.raises(ValueError, match="no such dataset folder"):
        export_coco(tmp_path / "nothing", tmp_path / "train.json")


def test_one_of_several_splits_must_be_named(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    shutil.copytree(copy / "train_synthetless", copy / "val")
    with pytest.raises(ValueError, match="has the splits train_synthetless, val; name one of them"):
        export_coco(copy, tmp_path / "train.json")
    assert export_coco(copy, tmp_path / "train.json", split="val") == 6


def _change(name: str, number: int, **changes: object) -> Change:
    def change(coco: dict[str, Any]) -> None:
        coco[name][number] |= changes

    return change


def _segmentation(**changes: object) -> Change:
    def change(coco: dict[str, Any]) -> None:
        coco["annotations"][0]["segmentation"] |= changes

    return change


DAMAGES: list[tuple[Change, str]] = [
    (lambda coco: coco.pop("images"), "images is missing"),
    (lambda coco: coco.update(annotations={}), "annotations is {}: input should be a valid list"),
    (lambda coco: coco["annotations"].append(5), r"annotations\.\d+ is 5: input should be a valid dictionary"),
    (lambda coco: coco["images"].append(None), r"images\.3 is None: input should be a valid dictionary"),
    (lambda coco: coco["categories"].append({}), r"categories\.3\.id is missing"),
    (lambda coco: coco["annotations"][0].pop("ignore"), r"annotations\.0\.ignore is missing"),
    (_change("images", 0, height=None), r"images\.0\.height is None: .* valid integer"),
    (_change("images", 0, width=0), r"images\.0\.width is 0: .* greater than or equal to 1"),
    (_change("images", 0, file_name=7), r"images\.0\.file_name is 7: .* valid string"),
    (_change("images", 0, id="0"), r"images\.0\.id"),
    (_change("images", 0, id=77), "annotates image 0, which it does not list"),
    (_change("annotations", 0, image_id=77), "annotates image 77, which it does not list"),
    (_change("annotations", 0, category_id=77), "does not list the . visible instances"),
    (_change("annotations", 0, bbox=[1, 2, 3]), r"annotations\.0\.bbox is .*: .* at least 4 items"),
    (_change("annotations", 0, bbox="1 2 3 4"), r"annotations\.0\.bbox"),
    (_change("annotations", 0, area=None), r"annotations\.0\.area"),
    (
        _change("annotations", 0, segmentation=[[1, 2, 3, 4]]),
        r"annotations\.0\.segmentation is .*: .* valid dictionary",
    ),
    (_segmentation(counts=[1, -2]), r"segmentation\.counts"),
    (_segmentation(counts=[2**40]), r"segmentation\.counts"),
    (_segmentation(counts=[1.5]), r"segmentation\.counts"),
    (_segmentation(counts=None), r"segmentation\.counts"),
    (_segmentation(size=[48]), r"segmentation\.size"),
    (_segmentation(size=[0, 0]), r"segmentation\.size"),
    (_segmentation(size=[2**40, 1]), r"segmentation\.size"),
]


@pytest.mark.parametrize("number", range(len(DAMAGES)))
def test_a_damaged_coco_file_is_one_line(damaged_copy: Path, tmp_path: Path, number: int) -> None:
    change, told = DAMAGES[number]
    scene = ScenePaths.of(damaged_copy, 1)
    content = json.loads(scene.scene_gt_coco.read_text())
    change(content)
    scene.scene_gt_coco.write_text(json.dumps(content))
    with pytest.raises(UserError, match=rf"000001/scene_gt_coco\.json: .*{told}") as raised:
        export_coco(damaged_copy, tmp_path / "train.json")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "train.json").exists()


@pytest.fixture
def damaged_copy(dataset: Path, tmp_path: Path) -> Path:
    """A copy to damage, without pictures, which are not read."""
    return shutil.copytree(dataset, tmp_path / "copy", ignore=shutil.ignore_patterns("*.png"))


def test_polygons_are_the_masks(dataset: Path, exported: Path, tmp_path: Path) -> None:
    """pycocotools makes of them what it makes of the run lengths; nothing else is different."""
    export_coco(dataset, tmp_path / "polygons.json", polygons=True)
    with_runs, with_polygons = _load(exported), _load(tmp_path / "polygons.json")
    assert len(with_polygons.anns) == len(with_runs.anns) > 12
    for number, annotation in with_polygons.anns.items():
        runs = with_runs.anns[number]
        assert isinstance(annotation["segmentation"], list)
        assert np.array_equal(with_polygons.annToMask(annotation), with_runs.annToMask(runs))
        assert {**annotation, "segmentation": runs["segmentation"]} == runs
