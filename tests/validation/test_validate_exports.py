"""Exports against their source: as written they are right, and each damage is found in its place."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from damage_kit import IMAGE, WHOLE, Victim
from valid_dataset import small_scene_folders

from synthetless.exports.coco import BoxKind, export_coco
from synthetless.exports.webdataset import export_webdataset
from synthetless.exports.yolo import export_yolo
from synthetless.validation import validate

KEY = f"000001_{IMAGE:06d}"
Place = tuple[str, str, int | None, int | None]


@pytest.fixture(scope="module")
def shards(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images in two shuffled shards."""
    to = tmp_path_factory.mktemp("exports") / "shards"
    export_webdataset(valid, to, images_per_shard=4, shuffle_seed=1, workers=1)
    return to


def _places(dataset: Path, export: Path) -> list[Place]:
    report = validate(dataset, exports=[export], workers=1)
    assert report.exports == (export,)
    return [(f.kind, f.file.name, f.image, f.instance) for f in report.findings]


def test_exports_as_written_are_right(valid: Path, shards: Path, tmp_path: Path) -> None:
    exports = [shards]
    for boxes in ("visible", "amodal"):
        exports.append(tmp_path / f"{boxes}.json")
        kind: BoxKind = "visible" if boxes == "visible" else "amodal"
        export_coco(valid, exports[-1], boxes=kind)
    exports.append(tmp_path / "polygons.json")
    export_coco(valid, exports[-1], polygons=True)
    report = validate(valid, exports=exports, workers=1)
    assert report.lines() == [f"{valid}: 6 images, 6 of them recomputed, 34 instances, 4 exports: valid"]


def test_workers_compare_shards_alike(valid: Path, shards: Path, tmp_path: Path) -> None:
    shutil.copytree(shards, tmp_path / "s")
    _rewrite(tmp_path / "s", lambda members: members.pop(f"{KEY}.gt.json"))
    assert validate(valid, exports=[tmp_path / "s"], workers=2) == validate(valid, exports=[tmp_path / "s"], workers=1)


# --- shards ---

Members = dict[str, bytes]


def _shard(folder: Path) -> Path:
    """The shard that has the image to be damaged."""
    return folder / f"shard-{json.loads((folder / 'key_to_shard.json').read_text())[KEY]:06d}.tar"


def _rewrite(folder: Path, change: Callable[[Members], Any]) -> None:
    path = _shard(folder)
    with tarfile.open(path) as tar:
        members = {info.name: tar.extractfile(info).read() for info in tar}  # type: ignore[union-attr]
    change(members)
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))


def _edit(members: Members, name: str, change: Callable[[Any], Any]) -> None:
    content = json.loads(members[f"{KEY}.{name}"])
    change(content)
    members[f"{KEY}.{name}"] = json.dumps(content).encode()


def _set(content: Any, key: Any, value: Any) -> None:
    content[key] = value


MEMBERS: dict[str, tuple[Callable[[Members], Any], int | None]] = {
    "missing member": (lambda m: m.pop(f"{KEY}.depth.png"), None),
    "missing labels": (lambda m: m.pop(f"{KEY}.gt_canonical.json"), None),
    "foreign member": (lambda m: _set(m, f"{KEY}.normals.png", b"?"), None),
    "another picture": (lambda m: _set(m, f"{KEY}.rgb.png", m[f"{KEY}.rgb.png"][:-1]), None),
    "pose": (lambda m: _edit(m, "gt.json", lambda gt: _set(gt[WHOLE], "obj_id", 2)), None),
    "stale label": (lambda m: _edit(m, "gt_canonical.json", lambda gt: _set(gt[5], "regressor_index", 0)), None),
    "camera": (lambda m: _edit(m, "camera.json", lambda camera: _set(camera, "depth_scale", 1.0)), None),
    "info": (lambda m: _edit(m, "gt_info.json", lambda infos: infos.pop()), None),
    "broken json": (lambda m: _set(m, f"{KEY}.gt.json", b"[{"), None),
    "swapped masks": (lambda m: _edit(m, "mask.json", lambda rles: _set(rles, str(WHOLE), rles["2"])), WHOLE),
    "visible mask": (lambda m: _edit(m, "mask_visib.json", lambda rles: _set(rles, "4", rles["3"])), 4),
    "missing mask": (lambda m: _edit(m, "mask_visib.json", lambda rles: rles.pop("0")), None),
}


@pytest.mark.parametrize(("change", "instance"), MEMBERS.values(), ids=MEMBERS.keys())
def test_damage_to_a_member_is_found(
    valid: Path, shards: Path, tmp_path: Path, change: Callable[[Members], Any], instance: int | None
) -> None:
    folder = tmp_path / "shards"
    shutil.copytree(shards, folder)
    _rewrite(folder, change)
    assert _places(valid, folder) == [("export", _shard(folder).name, IMAGE, instance)]


def test_a_cut_shard_is_found(valid: Path, shards: Path, tmp_path: Path) -> None:
    shutil.copytree(shards, tmp_path / "s")
    shard = _shard(tmp_path / "s")
    shard.write_bytes(shard.read_bytes()[:-5000])
    assert ("unreadable", shard.name, None, None) in _places(valid, tmp_path / "s")


def test_a_missing_shard_is_found(valid: Path, shards: Path, tmp_path: Path) -> None:
    shutil.copytree(shards, tmp_path / "s")
    _shard(tmp_path / "s").unlink()
    found = _places(valid, tmp_path / "s")
    assert ("export", "s", IMAGE, None) in found
    assert ("export", "key_to_shard.json", None, None) in found


def test_companions_of_shards_are_compared(valid: Path, shards: Path, tmp_path: Path) -> None:
    shutil.copytree(shards, tmp_path / "s")
    with Victim(valid).json(tmp_path / "s" / "key_to_shard.json") as keys:
        keys[KEY] = 1 - keys[KEY]
    with Victim(valid).json(tmp_path / "s" / "symmetries.json") as table:
        table["objects"]["3"] = {"group": "C1"}
    (tmp_path / "s" / "dataset.json").unlink()
    assert sorted(_places(valid, tmp_path / "s")) == [
        ("export", "dataset.json", None, None),
        ("export", "key_to_shard.json", None, None),
        ("export", "symmetries.json", None, None),
    ]


def test_an_image_of_no_scene_is_found(valid: Path, shards: Path, tmp_path: Path) -> None:
    shutil.copytree(shards, tmp_path / "s")
    _rewrite(tmp_path / "s", lambda members: _set(members, "000009_000000.gt.json", b"[]"))
    assert ("export", _shard(tmp_path / "s").name, None, None) in _places(valid, tmp_path / "s")


# --- COCO ---

COCO: dict[str, tuple[Callable[[Any], Any], Place]] = {
    "missing annotation": (lambda c: c["annotations"].pop(7), ("export", "coco.json", 2, 1)),
    "box off by one": (lambda c: _set(c["annotations"][7]["bbox"], 2, 1), ("export", "coco.json", 2, 1)),
    "first box off by one": (lambda c: _set(c["annotations"][0]["bbox"], 2, 1), ("export", "coco.json", 1, 0)),
    "segmentation": (
        lambda c: _set(c["annotations"][7], "segmentation", c["annotations"][8]["segmentation"]),
        ("export", "coco.json", 2, 1),
    ),
    "stale label": (lambda c: _set(c["annotations"][7], "regressor_index", 5), ("export", "coco.json", 2, 1)),
    "keypoint": (lambda c: _set(c["annotations"][7]["keypoints"], 0, 0.5), ("export", "coco.json", 2, 1)),
    "another image": (lambda c: _set(c["annotations"][7], "image_id", 3), ("export", "coco.json", 2, 1)),
    "missing image": (lambda c: c["images"].pop(1), ("export", "coco.json", 2, None)),
    "moved image": (
        lambda c: _set(c["images"][1], "file_name", "nowhere/000001.png"),
        ("export", "coco.json", 2, None),
    ),
    "category": (lambda c: _set(c["categories"][1], "name", "fuse"), ("export", "coco.json", None, None)),
    "duplicated id": (lambda c: _set(c["annotations"][7], "id", 9), ("export", "coco.json", 2, 1)),
    "no lists": (lambda c: c.pop("images"), ("schema", "coco.json", None, None)),
    "a list that is none": (lambda c: _set(c, "annotations", 7), ("schema", "coco.json", None, None)),
    "an annotation that is no object": (lambda c: _set(c["annotations"], 7, 5), ("schema", "coco.json", None, None)),
    "an annotation that is null": (lambda c: _set(c["annotations"], 7, None), ("schema", "coco.json", None, None)),
    "an annotation that is a list": (
        lambda c: _set(c["annotations"], 7, [8]),
        ("schema", "coco.json", None, None),
    ),
    "an image that is text": (lambda c: _set(c["images"], 1, "id"), ("schema", "coco.json", None, None)),
    "an id that is a list": (lambda c: _set(c["images"][1], "id", [2]), ("schema", "coco.json", None, None)),
    "an id that is text": (lambda c: _set(c["annotations"][7], "id", "8"), ("export", "coco.json", 2, 1)),
    "an id that is null": (lambda c: _set(c["images"][1], "id", None), ("export", "coco.json", 2, None)),
    "no height": (lambda c: _set(c["images"][1], "height", None), ("export", "coco.json", 2, None)),
    "height as text": (lambda c: _set(c["images"][1], "height", "96"), ("export", "coco.json", 2, None)),
    "a file name that is a number": (lambda c: _set(c["images"][1], "file_name", 3), ("export", "coco.json", 2, None)),
    "a box that is null": (lambda c: _set(c["annotations"][7], "bbox", None), ("export", "coco.json", 2, 1)),
    "no segmentation": (lambda c: _set(c["annotations"][7], "segmentation", None), ("export", "coco.json", 2, 1)),
    "a category that is a number": (lambda c: _set(c["categories"], 1, 2), ("schema", "coco.json", None, None)),
}


@pytest.mark.parametrize(("change", "place"), COCO.values(), ids=COCO.keys())
def test_damage_to_a_coco_file_is_found(
    valid: Path, tmp_path: Path, change: Callable[[Any], Any], place: Place
) -> None:
    path = tmp_path / "coco.json"
    export_coco(valid, path)
    with Victim(valid).json(path) as content:
        change(content)
    assert place in _places(valid, path)


def test_a_cut_coco_file_is_found(valid: Path, tmp_path: Path) -> None:
    path = tmp_path / "coco.json"
    export_coco(valid, path)
    path.write_bytes(path.read_bytes()[:-100])
    assert _places(valid, path) == [("unreadable", "coco.json", None, None)]


def test_damage_to_polygons_is_found(valid: Path, tmp_path: Path) -> None:
    path = tmp_path / "coco.json"
    export_coco(valid, path, polygons=True)
    with Victim(valid).json(path) as content:
        content["annotations"][7]["segmentation"][0][0] += 1
        content["annotations"][8]["segmentation"] = {"counts": [0, 96 * 128], "size": [96, 128]}
    assert _places(valid, path) == [("export", "coco.json", 2, 1), ("export", "coco.json", 2, 2)]


# --- folders ---


@pytest.fixture(scope="module")
def yolo(valid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    to = tmp_path_factory.mktemp("exports") / "yolo"
    with small_scene_folders():
        export_yolo(valid, to, "pose", workers=1)
    return to


def test_a_folder_as_written_is_right(valid: Path, yolo: Path, tmp_path: Path) -> None:
    """Also a copied one, one that is moved, and one into which ultralytics has put its cache."""
    export_yolo(valid, tmp_path / "copied", "segment", amodal=True, copy=True, workers=1)
    (tmp_path / "copied").rename(tmp_path / "moved")
    (tmp_path / "moved" / "labels" / "train.cache").touch()
    report = validate(valid, exports=[yolo, tmp_path / "moved"], workers=1)
    assert report.lines() == [f"{valid}: 6 images, 6 of them recomputed, 34 instances, 2 exports: valid"]


def _set_text(path: Path, text: str) -> None:
    path.unlink()
    path.write_text(text)


FOLDER: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing label": (lambda f: (f / "labels/train/000001_000002.txt").unlink(), "000001_000002.txt"),
    "stale label": (lambda f: _set_text(f / "labels/train/000001_000002.txt", "0 0.5 0.5 1 1"), "000001_000002.txt"),
    "foreign label": (lambda f: (f / "labels/train/000009_000000.txt").touch(), "000009_000000.txt"),
    "moved label": (
        lambda f: (f / "labels/train/000001_000002.txt").rename(f / "labels/val/000001_000002.txt"),
        "000001_000002.txt",
    ),
    "another picture": (lambda f: _set_text(f / "images/train/000001_000002.png", "?"), "000001_000002.png"),
    "a link to nowhere": (
        lambda f: (
            _set_text(f / "images/train/000001_000002.png", "") or (f / "images/train/000001_000002.png").unlink()
        ),
        "000001_000002.png",
    ),
    "data.yaml": (lambda f: _set_text(f / "data.yaml", "names: [1]"), "data.yaml"),
    "symmetries": (lambda f: _set_text(f / "symmetries.json", "{}"), "symmetries.json"),
    "another request": (lambda f: _set_text(f / "export.json", '{"kind": "yolo"}'), "export.json"),
    "a damaged request": (
        lambda f: _set_text(f / "export.json", '{"kind": "yolo", "options": {"split": "s", "task": "fly"}}'),
        "export.json",
    ),
}


@pytest.mark.parametrize(("change", "file"), FOLDER.values(), ids=FOLDER.keys())
def test_damage_to_a_folder_is_found(
    valid: Path, yolo: Path, tmp_path: Path, change: Callable[[Path], Any], file: str
) -> None:
    folder = tmp_path / "yolo"
    shutil.copytree(yolo, folder)
    change(folder)
    assert {("export", file, None, None)} == set(_places(valid, folder))


def test_an_export_from_before_a_relabelling_is_found(valid: Path, shards: Path, tmp_path: Path) -> None:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    with Victim(root).entry("gt_canonical", 5) as label:
        label["regressor_index"] = 1 - label["regressor_index"]
    found = _places(root, shards)
    assert ("export", _shard(shards).name, IMAGE, None) in found
