"""The exports in the hands of those who read them: torch, torchvision, FiftyOne and bop_toolkit's own reader.

Each of these packages is large, so that a test is skipped where its package is not installed.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from packages import package_or_skip, torchvision_or_skip

from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import read_scene_json
from synthetless.exports.coco import export_coco
from synthetless.exports.webdataset import export_webdataset
from synthetless.io.images import decode_depth, decode_mask, decode_rgb


def _scene_of(dataset: Path, key: str) -> tuple[ScenePaths, int]:
    scene_id, im_id = map(int, key.split("_"))
    return ScenePaths.of(dataset, scene_id), im_id


@pytest.fixture(scope="module")
def coco_file(dataset: Path) -> Iterator[Path]:
    """Beside the split, as FiftyOne wants it."""
    path = dataset / "coco.json"
    export_coco(dataset, path)
    yield path
    path.unlink()


@pytest.fixture(scope="module")
def shards(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("shards") / "web"
    export_webdataset(dataset, folder, images_per_shard=2, shuffle_seed=0, workers=1)
    return sorted(map(str, folder.glob("shard-*.tar")))


def test_torchvision_loads_the_coco_file(dataset: Path, coco_file: Path) -> None:
    torchvision = torchvision_or_skip()
    loaded = torchvision.datasets.CocoDetection(str(coco_file.parent), str(coco_file))
    assert len(loaded) == 6
    instances = 0
    for number, (picture, listed) in zip(loaded.ids, loaded, strict=True):
        image = loaded.coco.imgs[number]
        scene = ScenePaths.of(dataset, image["scene_id"])
        assert np.array_equal(np.asarray(picture), decode_rgb(scene.rgb(image["im_id"]).read_bytes()))
        for annotation in listed:
            mask = decode_mask(scene.mask_visib(image["im_id"], annotation["gt_id"]).read_bytes())
            assert np.array_equal(loaded.coco.annToMask(annotation), mask)
            instances += 1
    assert instances > 12


def test_torchvision_makes_targets_of_the_coco_file(coco_file: Path) -> None:
    """Its transforms take boxes, masks and categories, the targets of its own detectors."""
    torchvision = torchvision_or_skip()
    plain = torchvision.datasets.CocoDetection(str(coco_file.parent), str(coco_file))
    wrapped = torchvision.datasets.wrap_dataset_for_transforms_v2(plain, target_keys=["boxes", "masks", "labels"])
    for (_, target), (_, listed) in zip(wrapped, plain, strict=True):
        assert target["labels"].tolist() == [annotation["category_id"] for annotation in listed]
        assert target["masks"].sum(dim=(1, 2)).tolist() == [annotation["area"] for annotation in listed]
        x, y, w, h = np.transpose([annotation["bbox"] for annotation in listed])
        assert np.array_equal(target["boxes"].numpy(), np.transpose([x, y, x + w, y + h]))


def _tensors(sample: dict[str, Any]) -> tuple[str, Any, Any, Any]:
    """What a training loop takes from a sample: key, colours, depth in millimetres, canonical rotations."""
    import torch

    colours = torch.from_numpy(decode_rgb(sample["rgb.png"]))
    camera, labels = json.loads(sample["camera.json"]), json.loads(sample["gt_canonical.json"])
    depth = torch.from_numpy(decode_depth(sample["depth.png"], camera["depth_scale"]))
    rotations = torch.tensor([label["cam_R_m2c_canonical"] for label in labels], dtype=torch.float64)
    return sample["__key__"], colours, depth, rotations


def _as_they_are(batch: list[Any]) -> list[Any]:
    return batch


@pytest.mark.parametrize("workers", [0, 2])
def test_torch_loads_every_image_once(dataset: Path, shards: list[str], workers: int) -> None:
    torch, webdataset = package_or_skip("torch"), package_or_skip("webdataset")
    samples = webdataset.WebDataset(shards, shardshuffle=False).map(_tensors)
    loader = torch.utils.data.DataLoader(samples, batch_size=2, num_workers=workers, collate_fn=_as_they_are)
    seen: Counter[str] = Counter()
    for key, colours, depth, rotations in (sample for batch in loader for sample in batch):
        scene, im_id = _scene_of(dataset, key)
        assert np.array_equal(colours.numpy(), decode_rgb(scene.rgb(im_id).read_bytes()))
        assert np.array_equal(depth.numpy(), decode_depth(scene.depth(im_id).read_bytes(), 0.1))
        stored = [label["cam_R_m2c_canonical"] for label in read_scene_json(scene.scene_gt_canonical)[im_id]]
        assert rotations.tolist() == stored
        seen[key] += 1
    assert seen == Counter(f"{scene_id:06d}_{im_id:06d}" for scene_id in (1, 2) for im_id in range(3))


def test_hugging_face_streams_the_shards(
    dataset: Path, shards: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = package_or_skip("datasets")
    stream = datasets.load_dataset(
        "webdataset", data_files={"train": shards}, split="train", streaming=True, cache_dir=str(tmp_path)
    )
    rows = {row["__key__"]: row for row in stream}
    assert len(rows) == 6
    for key, row in rows.items():
        scene, im_id = _scene_of(dataset, key)
        assert row["gt.json"] == read_scene_json(scene.scene_gt)[im_id]
        assert row["gt_canonical.json"] == read_scene_json(scene.scene_gt_canonical)[im_id]


def test_fiftyone_imports_the_coco_file(dataset: Path, coco_file: Path) -> None:
    """Its importer alone, which fills its database: the database itself is a server, which is seldom at hand."""
    os.environ.setdefault("FIFTYONE_DO_NOT_TRACK", "true")
    coco = package_or_skip("fiftyone.utils.coco", "pip install fiftyone")
    labels = json.loads(coco_file.read_text())
    images = {image["file_name"]: image for image in labels["images"]}
    importer = coco.COCODetectionDatasetImporter(
        data_path=str(dataset), labels_path=str(coco_file), label_types=["segmentations", "keypoints"]
    )
    with importer:
        imported = list(importer)
    assert {path for path, _, _ in imported} == {str(dataset / name) for name in images}
    for path, metadata, found in imported:
        image = images[str(Path(path).relative_to(dataset))]
        annotations = [a for a in labels["annotations"] if a["image_id"] == image["id"]]
        assert (metadata.width, metadata.height) == (image["width"], image["height"])
        size = np.array([image["width"], image["height"]])
        segmentations, keypoints = found["segmentations"].detections, found["keypoints"].keypoints
        assert len(segmentations) == len(keypoints) == len(annotations)
        for annotation, segmentation, corners in zip(annotations, segmentations, keypoints, strict=True):
            assert segmentation["gt_id"] == annotation["gt_id"]
            assert segmentation["regressor_index"] == annotation["regressor_index"]
            assert np.count_nonzero(segmentation.mask) == annotation["area"]
            expected = np.reshape(annotation["keypoints"], (8, 3))[:, :2]
            assert np.allclose(np.array(corners.points) * size, expected)


def test_opencv_alone_reads_the_files(dataset: Path) -> None:
    """As a loader in another language would: no function of ours between the bytes and the numbers."""
    scene = ScenePaths.of(dataset, 1)
    for im_id, camera in read_scene_json(scene.scene_camera).items():
        depth = cv2.imread(str(scene.depth(im_id)), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        assert 400 < (depth * camera["depth_scale"]).max() < 700
        for gt_id, info in enumerate(read_scene_json(scene.scene_gt_info)[im_id]):
            mask = cv2.imread(str(scene.mask_visib(im_id, gt_id)), cv2.IMREAD_UNCHANGED)
            assert set(np.unique(mask)) <= {0, 255}
            assert np.count_nonzero(mask) == info["px_count_visib"]
