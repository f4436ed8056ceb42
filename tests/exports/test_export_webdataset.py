"""BOP's shards: every field of the scenewise source, byte for byte where it is an image."""

from __future__ import annotations

import json
import shutil
import tarfile
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import read_scene_json, write_scene_json
from synthetless.exports.webdataset import export_webdataset, relabel_webdataset
from synthetless.io.images import decode_depth, decode_mask, decode_rgb

Sample = dict[str, bytes]
LABELS = {"camera.json", "gt.json", "gt_canonical.json", "gt_info.json"}
MEMBERS = LABELS | {"rgb.png", "depth.png", "mask.json", "mask_visib.json"}


def _samples(folder: Path) -> dict[str, Sample]:
    samples: dict[str, Sample] = {}
    for path in sorted(folder.glob("shard-*.tar")):
        with tarfile.open(path) as tar:
            for member in tar:
                key, name = member.name.split(".", maxsplit=1)
                file = tar.extractfile(member)
                assert file is not None
                samples.setdefault(key, {})[name] = file.read()
    return samples


def _bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _assert_equal_to_source(dataset: Path, key: str, sample: Sample) -> None:
    scene_id, im_id = map(int, key.split("_"))
    scene = ScenePaths.of(dataset, scene_id)
    assert set(sample) == MEMBERS
    assert sample["rgb.png"] == scene.rgb(im_id).read_bytes()
    assert sample["depth.png"] == scene.depth(im_id).read_bytes()
    sources = (scene.scene_camera, scene.scene_gt, scene.scene_gt_canonical, scene.scene_gt_info)
    for name, path in zip(sorted(LABELS), sources, strict=True):
        assert json.loads(sample[name]) == read_scene_json(path)[im_id]
    for name, mask_path in (("mask.json", scene.mask), ("mask_visib.json", scene.mask_visib)):
        masks = json.loads(sample[name])
        assert list(masks) == [str(gt_id) for gt_id in range(len(json.loads(sample["gt.json"])))]
        for gt_id, rle in masks.items():
            decoded = coco_mask.decode(coco_mask.frPyObjects(rle, *rle["size"])).astype(bool)
            assert np.array_equal(decoded, decode_mask(mask_path(im_id, int(gt_id)).read_bytes()))


def test_shards_hold_the_source_field_by_field(dataset: Path, tmp_path: Path) -> None:
    key_to_shard = export_webdataset(dataset, tmp_path / "web", images_per_shard=4, workers=1)
    samples = _samples(tmp_path / "web")
    assert list(samples) == ["000002_000002", *(f"{s:06d}_{i:06d}" for s, i in product((1, 2), range(3)))][:6]
    for key, sample in samples.items():
        _assert_equal_to_source(dataset, key, sample)
    assert json.loads((tmp_path / "web" / "key_to_shard.json").read_text()) == key_to_shard
    assert list(key_to_shard.values()) == [0, 0, 0, 0, 1, 1]
    assert {path.name for path in (tmp_path / "web").iterdir()} == {
        "shard-000000.tar",
        "shard-000001.tar",
        "key_to_shard.json",
        "dataset.json",
        "symmetries.json",
    }


def test_jpeg_images_are_copied_as_they_are(build_dataset: Callable[[Path, str], Path], tmp_path: Path) -> None:
    dataset = build_dataset(tmp_path / "parts", "jpg")
    export_webdataset(dataset, tmp_path / "web", workers=1)
    sample = _samples(tmp_path / "web")["000002_000001"]
    assert sample["rgb.jpg"] == ScenePaths.of(dataset, 2).rgb(1, "jpg").read_bytes()
    assert "rgb.png" not in sample


def test_bytes_depend_on_nothing_but_dataset_and_seed(dataset: Path, tmp_path: Path) -> None:
    for name, seed, workers in (("a", 3, 1), ("b", 3, 2), ("c", 4, 1), ("d", None, 1)):
        export_webdataset(dataset, tmp_path / name, images_per_shard=2, shuffle_seed=seed, workers=workers)
    a, b, c, d = (_bytes(tmp_path / name) for name in "abcd")
    assert a == b
    assert a != c != d != a
    assert _samples(tmp_path / "a") == _samples(tmp_path / "c") == _samples(tmp_path / "d")


def test_relabelled_shards_equal_a_fresh_export(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    export_webdataset(copy, tmp_path / "web", images_per_shard=4, shuffle_seed=1, workers=1)
    stale = _bytes(tmp_path / "web")
    for scene_id in (1, 2):
        path = ScenePaths.of(copy, scene_id).scene_gt_canonical
        labels = read_scene_json(path)
        for entry in (entry for entries in labels.values() for entry in entries):
            entry["regressor_index"] = 1 - entry["regressor_index"]
        write_scene_json(path, labels)
    (copy / "symmetries.json").write_text('{"scheme": "atlas"}')
    relabel_webdataset(copy, tmp_path / "web", workers=2)
    export_webdataset(copy, tmp_path / "fresh", images_per_shard=4, shuffle_seed=1, workers=1)
    assert _bytes(tmp_path / "web") == _bytes(tmp_path / "fresh") != stale


def test_relabelling_reads_no_image(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    export_webdataset(copy, tmp_path / "web", workers=1)
    before = _bytes(tmp_path / "web")
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        for scene_id in (1, 2):
            shutil.rmtree(ScenePaths.of(copy, scene_id).root / folder)
    relabel_webdataset(copy, tmp_path / "web", workers=1)
    assert _bytes(tmp_path / "web") == before


def test_relabelling_refuses_shards_of_another_dataset(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    export_webdataset(copy, tmp_path / "web", workers=1)
    before = _bytes(tmp_path / "web")
    shutil.rmtree(ScenePaths.of(copy, 2).root)
    with pytest.raises(ValueError, match="image 000002_000000 is only in the shards; export the dataset again"):
        relabel_webdataset(copy, tmp_path / "web")
    assert _bytes(tmp_path / "web") == before
    shard = tmp_path / "web" / "shard-000000.tar"
    shard.write_bytes(shard.read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"shard-000000\.tar: not a readable shard"):
        relabel_webdataset(dataset, tmp_path / "web")
    with pytest.raises(ValueError, match="holds no shards"):
        relabel_webdataset(dataset, tmp_path)


def test_a_failing_export_leaves_nothing(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    damaged = ScenePaths.of(copy, 2).mask(1, 3)
    damaged.write_bytes(damaged.read_bytes()[:40])
    with pytest.raises(ValueError, match=r"mask/000001_000003\.png: not a readable image"):
        export_webdataset(copy, tmp_path / "web", images_per_shard=1, workers=2)
    damaged.unlink()
    with pytest.raises(ValueError, match=r"mask/000001_000003\.png: not found"):
        export_webdataset(copy, tmp_path / "web", workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_a_folder_in_use_and_impossible_sizes_are_refused(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "mine.txt").write_text("keep")
    with pytest.raises(ValueError, match="web: exists already; give a new or an empty folder"):
        export_webdataset(dataset, tmp_path / "web", workers=1)
    for size in (0, 1001):
        with pytest.raises(ValueError, match=f"images_per_shard is {size}; 1 to 1000 are possible"):
            export_webdataset(dataset, tmp_path / "new", images_per_shard=size)
    assert [path.name for path in tmp_path.rglob("*")] == ["web", "mine.txt"]


def test_what_was_not_generated_is_left_out(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    for scene_id in (1, 2):
        shutil.rmtree(ScenePaths.of(copy, scene_id).root / "depth")
        shutil.rmtree(ScenePaths.of(copy, scene_id).root / "mask")
    export_webdataset(copy, tmp_path / "web", workers=1)
    assert set(_samples(tmp_path / "web")["000001_000000"]) == MEMBERS - {"depth.png", "mask.json"}


@pytest.mark.parametrize("name", ["depth", "depth_sensed"])
def test_each_kind_of_depth_is_there_if_the_dataset_has_it(dataset: Path, tmp_path: Path, name: str) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy")
    for scene_id in (1, 2):
        folder = ScenePaths.of(copy, scene_id).root
        (folder / "depth").rename(folder / name)
    export_webdataset(copy, tmp_path / "web", workers=1)
    sample = _samples(tmp_path / "web")["000001_000000"]
    assert set(sample) == MEMBERS - {"depth.png"} | {f"{name}.png"}
    assert sample[f"{name}.png"] == (ScenePaths.of(copy, 1).root / name / "000000.png").read_bytes()


def test_the_webdataset_package_reads_the_shards(dataset: Path, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset")
    export_webdataset(dataset, tmp_path / "web", images_per_shard=4, shuffle_seed=0, workers=1)
    urls = sorted(str(path) for path in (tmp_path / "web").glob("shard-*.tar"))
    seen = set()
    for sample in webdataset.WebDataset(urls, shardshuffle=False, empty_check=False):
        key = sample["__key__"]
        fields = {name: data for name, data in sample.items() if not name.startswith("__")}
        _assert_equal_to_source(dataset, key, fields)
        camera = json.loads(sample["camera.json"])
        assert decode_depth(sample["depth.png"], camera["depth_scale"]).max() > 400
        seen.add(key)
    assert len(seen) == 6
    decoded = next(iter(webdataset.WebDataset(urls, shardshuffle=False, empty_check=False).decode()))
    assert decoded["gt_canonical.json"][0]["n_regressors"] == 2


def test_hugging_face_datasets_reads_every_field(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets = pytest.importorskip("datasets")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    export_webdataset(dataset, tmp_path / "web", images_per_shard=4, workers=1)
    loaded = datasets.load_dataset(
        "webdataset",
        data_files={"train": str(tmp_path / "web" / "shard-*.tar")},
        split="train",
        cache_dir=str(tmp_path / "cache"),
    )
    assert len(loaded) == 6
    for row in loaded:
        scene_id, im_id = map(int, row["__key__"].split("_"))
        scene = ScenePaths.of(dataset, scene_id)
        gt, canonical = (read_scene_json(path)[im_id] for path in (scene.scene_gt, scene.scene_gt_canonical))
        assert row["gt.json"] == gt
        assert row["gt_canonical.json"] == canonical
        assert row["camera.json"] == read_scene_json(scene.scene_camera)[im_id]
        assert np.array_equal(np.asarray(row["rgb.png"]), decode_rgb(scene.rgb(im_id).read_bytes()))
        for gt_id in range(len(gt)):
            rle = row["mask.json"][str(gt_id)]
            assert (
                coco_mask.area(coco_mask.frPyObjects(rle, *rle["size"]))
                == decode_mask(scene.mask(im_id, gt_id).read_bytes()).sum()
            )


def test_a_dataset_without_images_is_refused(dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(dataset, tmp_path / "copy", ignore=shutil.ignore_patterns("*.png"))
    for path in copy.rglob("scene_*.json"):
        path.write_text("{}")
    with pytest.raises(ValueError, match="copy: holds no images to export"):
        export_webdataset(copy, tmp_path / "web", workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]
