"""The YOLO folder in ultralytics' own hands: its check of a dataset, its loader, one step of its training on the CPU.

``make interop`` installs it without what it depends on, which is here already: its OpenCV would take the place of
opencv-python-headless. torchvision, which it needs only to suppress doubled detections, is not imported here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from packages import package_or_skip

from synthetless.dataset import Dataset
from synthetless.exports.yolo import Task, export_yolo

WHERE = "make interop installs it"
MODELS = {"detect": "DetectionModel", "segment": "SegmentationModel", "pose": "PoseModel"}
SUFFIX = {"detect": "", "segment": "-seg", "pose": "-pose"}


@pytest.fixture(scope="module", autouse=True)
def _quiet(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Its settings in a folder of the tests, and no look at the network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("YOLO_CONFIG_DIR", str(tmp_path_factory.mktemp("ultralytics")))
        patch.setenv("YOLO_OFFLINE", "true")
        patch.setenv("YOLO_VERBOSE", "false")
        yield


def _loaded(folder: Path, task: Task) -> tuple[Any, Any]:
    """data.yaml as its check reads it, and the training images with what their labels say."""
    utils, build = package_or_skip("ultralytics.data.utils", WHERE), package_or_skip("ultralytics.data.build", WHERE)
    get_cfg = package_or_skip("ultralytics.cfg", WHERE).get_cfg
    data = utils.check_det_dataset(folder / "data.yaml", autodownload=False)
    cfg = get_cfg(overrides={"task": task, "imgsz": 128, "cache": False, "mosaic": 0.0})
    return data, build.build_yolo_dataset(cfg, data["train"], 2, data, mode="train", rect=False, stride=32)


@pytest.mark.parametrize("task", ["detect", "segment", "pose"])
def test_its_check_finds_every_label_and_its_training_takes_a_step(valid: Path, tmp_path: Path, task: Task) -> None:
    torch = package_or_skip("torch", WHERE)
    tasks = package_or_skip("ultralytics.nn.tasks", WHERE)
    get_cfg = package_or_skip("ultralytics.cfg", WHERE).get_cfg
    export_yolo(valid, tmp_path / "y", task, val_percent=0, workers=1)
    data, dataset = _loaded(tmp_path / "y", task)
    assert len(dataset) == 6
    visible = [sum(i.mask_visib().any() for i in image.instances) for image in Dataset.open(valid)]
    assert [len(label["cls"]) for label in dataset.labels] == visible

    torch.manual_seed(0)
    pose = {"data_kpt_shape": data["kpt_shape"]} if task == "pose" else {}
    model = getattr(tasks, MODELS[task])(f"yolo11n{SUFFIX[task]}.yaml", nc=data["nc"], verbose=False, **pose)
    model.args = get_cfg(overrides={"task": task})
    before = [parameter.detach().clone() for parameter in model.parameters()]
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-3)
    batch = dataset.collate_fn([dataset[number] for number in range(2)])
    batch["img"] = batch["img"].float() / 255
    losses, _ = model(batch)
    losses.sum().backward()
    optimizer.step()
    assert torch.isfinite(losses).all()
    assert losses[0] > 0  # of the boxes
    assert any(not torch.equal(old, new) for old, new in zip(before, model.parameters(), strict=True))


def test_it_draws_the_masks_from_the_polygons(valid: Path, tmp_path: Path) -> None:
    utils = package_or_skip("ultralytics.data.utils", WHERE)
    export_yolo(valid, tmp_path / "y", "segment", val_percent=0, workers=1)
    _, dataset = _loaded(tmp_path / "y", "segment")
    exact = 0
    for label, image in zip(dataset.labels, Dataset.open(valid), strict=True):
        masks = [instance.mask_visib() for instance in image.instances if instance.mask_visib().any()]
        for segment, mask in zip(label["segments"], masks, strict=True):
            size = np.array(mask.shape[::-1])
            drawn = utils.polygon2mask(mask.shape, [(segment * size).ravel()]).astype(bool)
            if cv2.connectedComponents(mask.astype(np.uint8))[0] == 2:
                assert np.array_equal(drawn, mask)
                exact += 1
    assert exact > 20


def test_its_keypoints_are_the_canonical_corners(valid: Path, tmp_path: Path) -> None:
    export_yolo(valid, tmp_path / "y", "pose", val_percent=0, workers=1)
    _, dataset = _loaded(tmp_path / "y", "pose")
    for label, image in zip(dataset.labels, Dataset.open(valid), strict=True):
        instances = [instance for instance in image.instances if instance.mask_visib().any()]
        for keypoints, instance in zip(label["keypoints"], instances, strict=True):
            assert instance.label is not None
            seen = keypoints[:, 2] == 2
            pixels = keypoints[seen, :2] * [128, 96] - 0.5
            assert np.allclose(pixels, instance.label.corners_px[seen], atol=1e-3)
