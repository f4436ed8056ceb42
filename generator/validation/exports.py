"""Exports against the dataset they were made from: shards by members, a COCO file by ids, a folder by files."""

from __future__ import annotations

import json
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pycocotools import mask as coco_mask

from synthetless.dataset.layout import AMBIGUITY_FILE, DATASET_FILE, SYMMETRIES_FILE, ScenePaths
from synthetless.dataset.records import uncompressed_rle
from synthetless.errors import UserError
from synthetless.exports.bop import BopExport
from synthetless.exports.coco import export_coco, polygons_of
from synthetless.exports.folder import FolderExport, compare, owned_files, read_export
from synthetless.exports.webdataset import KEYS_FILE
from synthetless.exports.yolo import YoloExport
from synthetless.io.files import read_bytes, read_json
from synthetless.io.images import decode_mask
from synthetless.validation.records import SceneRecords
from synthetless.validation.report import Finding, Tally, unusable
from synthetless.validation.structure import Source

_SHARDS = f"shard-{'[0-9]' * 6}.tar"
_LISTS = ("images", "annotations", "categories")

ById = dict[str, dict[int, dict[str, Any]]]
"""Items of a COCO file's lists, by the list's name and their ids."""


# Webdataset shards


@dataclass(frozen=True)
class Member:
    """Where a member's bytes are."""

    shard: Path
    offset: int
    size: int

    def read(self) -> bytes:
        """Its content."""
        with self.shard.open("rb") as file:
            file.seek(self.offset)
            return file.read(self.size)


@dataclass(frozen=True, eq=False)
class Shards:
    """The members of all shards of an export.

    Attributes:
        folder: the export.
        members: by image key and member name.
        findings: what is wrong with the shards themselves.
    """

    folder: Path
    members: dict[str, dict[str, Member]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Shards:
        """Read the tar headers of every shard, and key_to_shard.json."""
        shards = cls(folder)
        numbers: dict[str, int] = {}
        for path in sorted(folder.glob(_SHARDS)):
            for key, name, member in shards._list(path):
                if name in shards.members.setdefault(key, {}):
                    shards.findings.append(Finding("export", path, f"has {key}.{name}, as {member.shard.name} has"))
                shards.members[key][name] = member
                numbers[key] = int(path.stem.rpartition("-")[2])
        shards.findings.extend(_check_keys(folder / KEYS_FILE, numbers))
        return shards

    def _list(self, path: Path) -> Iterator[tuple[str, str, Member]]:
        try:
            if path.stat().st_size % tarfile.RECORDSIZE or path.stat().st_size == 0:
                raise tarfile.ReadError(f"cut off after {path.stat().st_size} bytes")
            with tarfile.open(path, "r:") as tar:
                for info in tar:
                    key, _, name = info.name.partition(".")
                    yield key, name, Member(path, info.offset_data, info.size)
        except (tarfile.TarError, OSError) as error:
            self.findings.append(Finding("unreadable", path, f"not a readable shard ({error}); export anew"))


@dataclass(frozen=True, eq=False)
class ShardsTask:
    """What a worker is given: the dataset, a scene folder and where its images are in the shards."""

    source: Source
    scene_id: int
    folder: Path
    members: Mapping[str, Mapping[str, Member]]
    limit: int


def check_companions(source: Source, folder: Path) -> Iterator[Finding]:
    """The copies of dataset.json and symmetries.json."""
    for name in (DATASET_FILE, SYMMETRIES_FILE, AMBIGUITY_FILE):
        path, original = folder / name, source.root / name
        if name == AMBIGUITY_FILE and not path.exists() and not original.exists():
            continue
        if not path.exists():
            yield Finding("export", path, "not there; export writes it beside the shards")
        elif original.exists() and read_bytes(path) != read_bytes(original):
            yield Finding("export", path, f"is not the dataset's {name}: the export is older or newer; export anew")


def by_scene(shards: Shards, scenes: set[int]) -> tuple[dict[int, dict[str, dict[str, Member]]], list[Finding]]:
    """The images of the shards by scene folder, and those of no scene folder."""
    result: dict[int, dict[str, dict[str, Member]]] = {scene_id: {} for scene_id in sorted(scenes)}
    findings = []
    for key, members in shards.members.items():
        scene, _, image = key.partition("_")
        if scene.isdecimal() and image.isdecimal() and int(scene) in result:
            result[int(scene)][key] = members
        else:
            findings.append(_stranger(key, members))
    return result, findings


def check_shards(task: ShardsTask) -> Tally:
    """Compare the images of one scene folder."""
    tally = Tally(task.limit)
    scene = SceneRecords.read(task.source.scene(task.scene_id))
    keys = {f"{task.scene_id:06d}_{im_id:06d}": im_id for im_id in scene.gt}
    tally.add(_stranger(key, task.members[key]) for key in sorted(task.members.keys() - keys.keys()))
    for key, im_id in keys.items():
        tally.add(_check_image(task, scene, key, im_id))
    return tally


def _stranger(key: str, members: Mapping[str, Member]) -> Finding:
    shard = next(iter(members.values())).shard
    return Finding("export", shard, f"has the image {key}, which the dataset does not have")


def _check_image(task: ShardsTask, scene: SceneRecords, key: str, im_id: int) -> Iterator[Finding]:
    members = task.members.get(key)
    if members is None:
        yield Finding("export", task.folder, f"no shard has the image {key}", im_id)
        return
    shard = next(iter(members.values())).shard
    contents = _contents(scene, im_id)
    files = _files(task.source, scene.paths, im_id)
    masks = _masks(scene.paths, im_id, len(scene.gt[im_id])) if task.source.has("masks") else {}
    expected = contents.keys() | files.keys() | masks.keys()
    for name in sorted(expected ^ members.keys()):
        state = "is missing" if name in expected else "has no source in the dataset"
        yield Finding("export", shard, f"the member {key}.{name} {state}", im_id)
    for name in sorted(expected & members.keys()):
        data = members[name].read()
        if name in files:
            if data != read_bytes(files[name]):
                message = f"{key}.{name} is not, byte for byte, {files[name].parent.name}/{files[name].name}"
                yield Finding("export", shard, message, im_id)
        elif name in contents:
            if _parsed(data) != contents[name]:
                yield Finding("export", shard, f"{key}.{name} differs from the scene folder's labels", im_id)
        else:
            yield from _compare_masks(shard, f"{key}.{name}", im_id, _parsed(data), masks[name])


def _contents(scene: SceneRecords, im_id: int) -> dict[str, Any]:
    sources: dict[str, Mapping[int, Any]] = {
        "camera.json": scene.camera,
        "gt.json": scene.gt,
        "gt_canonical.json": scene.canonical,
        "gt_info.json": scene.gt_info,
        "gt_ambiguity.json": scene.ambiguity if scene.is_ambiguity_current else {},
    }
    return {name: content[im_id] for name, content in sources.items() if im_id in content}


def _files(source: Source, paths: ScenePaths, im_id: int) -> dict[str, Path]:
    extension = source.recipe.encoding.rgb_format
    depths = {"depth.png": paths.depth(im_id), "depth_sensed.png": paths.depth_sensed(im_id)}
    files = {f"rgb.{extension}": paths.rgb(im_id, extension), **depths}
    return {name: path for name, path in files.items() if path.exists()}


def _masks(paths: ScenePaths, im_id: int, n_instances: int) -> dict[str, list[Path]]:
    return {
        f"{name}.json": [mask(im_id, gt_id) for gt_id in range(n_instances)]
        for name, mask in (("mask", paths.mask), ("mask_visib", paths.mask_visib))
    }


def _compare_masks(shard: Path, name: str, im_id: int, content: Any, files: list[Path]) -> Iterator[Finding]:
    if not isinstance(content, dict) or list(content) != [str(gt_id) for gt_id in range(len(files))]:
        yield Finding("export", shard, f"{name} does not hold the {len(files)} instances of the image", im_id)
        return
    for gt_id, path in enumerate(files):
        try:
            same = content[str(gt_id)] == uncompressed_rle(decode_mask(read_bytes(path)))
        except ValueError:  # told already
            continue
        if not same:
            yield Finding("export", shard, f"{name} differs from {path.parent.name}/{path.name}", im_id, gt_id)


def _parsed(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def _check_keys(path: Path, numbers: Mapping[str, int]) -> Iterator[Finding]:
    """key_to_shard.json against where the images are."""
    try:
        listed = read_json(path)
    except ValueError as error:
        yield unusable(path, error)
        return
    for key in sorted(listed.keys() | numbers.keys()):
        if listed.get(key) != numbers.get(key):
            message = f"has {key} in shard {listed.get(key)}; it is in shard {numbers.get(key)}"
            yield Finding("export", path, message)


# Folders

FOLDER_EXPORTS: tuple[type[FolderExport], ...] = (BopExport, YoloExport)
_FAULTS = {
    "missing": "not there; export anew",
    "differs": "is not what the dataset gives now: the export is older, or damaged; export anew",
}


@dataclass(frozen=True, eq=False)
class FolderTask:
    """What a worker is given: an export, its folder, and the part to compare; None for the files of the whole."""

    export: FolderExport
    folder: Path
    part: Any
    limit: int


@dataclass(frozen=True, eq=False)
class FolderPart:
    """What a worker gives back: faults, and the names of the files that there should be."""

    tally: Tally
    names: frozenset[str]


def folder_tasks(source: Source, folder: Path, limit: int) -> list[FolderTask]:
    """The parts of an export that is a folder.

    Raises:
        UserError: it does not say what it was asked for, or the dataset cannot be exported.
    """
    export = read_export(folder, source.root, FOLDER_EXPORTS)
    return [FolderTask(export, folder, part, limit) for part in (*export.parts(), None)]


def check_folder(task: FolderTask) -> FolderPart:
    """Compare the files of a part."""
    tally = Tally(task.limit)
    entries = task.export.common() if task.part is None else task.export.entries(task.part)
    names = set()
    try:
        for name, fault in compare(task.folder, entries):
            names.add(name)
            if fault is not None:
                tally.add([Finding("export", task.folder / name, _FAULTS[fault])])
    except UserError as error:
        tally.add([Finding("export", task.folder, f"cannot be compared, the dataset cannot be exported: {error}")])
    return FolderPart(tally, frozenset(names))


def check_owned(task: FolderTask, names: Set[str]) -> Iterator[Finding]:
    """Files that are in no part of the dataset."""
    for name in owned_files(task.export, task.folder):
        if name not in names:
            yield Finding("export", task.folder / name, "is of no image of the dataset; export anew")


# COCO files


def check_coco_export(source: Source, path: Path) -> Iterator[Finding]:
    """Export anew, and compare."""
    try:
        content = read_json(path)
        found: ById = {name: {item["id"]: dict(item) for item in content[name]} for name in _LISTS}
    except (KeyError, TypeError):
        yield Finding("schema", path, f"is no COCO file: it needs the lists {', '.join(_LISTS)}, of objects with ids")
        return
    except ValueError as error:
        yield unusable(path, error)
        return
    for name in _LISTS:
        if len(content[name]) != len(found[name]):
            yield Finding("export", path, f"{len(content[name]) - len(found[name])} ids of its {name} occur twice")
    try:
        expected = _export(source)
    except ValueError as error:
        yield Finding("export", path, f"cannot be compared, the dataset cannot be exported: {error}")
        return
    _resolve(found["images"], path.parent)
    _choose_boxes(found["annotations"], expected["annotations"])
    _choose_outlines(found["annotations"], expected["annotations"])
    for name in _LISTS:
        yield from _compare(path, name, found[name], expected[name])


def _export(source: Source) -> ById:
    """What an export with amodal boxes says now, by id; files by their absolute paths."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "coco.json"
        export_coco(source.root.resolve(), path, source.recipe.split, "amodal")
        content = json.loads(path.read_bytes())
        by_id: ById = {name: {item["id"]: item for item in content[name]} for name in _LISTS}
        _resolve(by_id["images"], path.parent)
    return by_id


def _choose_boxes(found: Mapping[int, Any], expected: Mapping[int, Any]) -> None:
    """Expect boxes of the visible parts instead, if more of the boxes found are those."""
    visible = {number: coco_mask.toBbox(item["segmentation"]).tolist() for number, item in expected.items()}
    boxes = {number: item.get("bbox") for number, item in found.items() if number in expected}
    n_amodal = sum(box == expected[number]["bbox"] for number, box in boxes.items())
    n_visible = sum(box == visible[number] for number, box in boxes.items())
    if n_visible > n_amodal:
        for number, item in expected.items():
            item["bbox"] = visible[number]


def _choose_outlines(found: Mapping[int, Any], expected: Mapping[int, Any]) -> None:
    """Expect polygons instead of run lengths, if more of the masks found are polygons."""
    if 2 * sum(isinstance(item.get("segmentation"), list) for item in found.values()) > len(found):
        for item in expected.values():
            item["segmentation"] = polygons_of(item["segmentation"])


def _resolve(images: Mapping[int, dict[str, Any]], folder: Path) -> None:
    for image in images.values():
        image["file_name"] = str((folder / str(image.get("file_name"))).resolve())


def _compare(path: Path, name: str, found: Mapping[int, Any], expected: Mapping[int, Any]) -> Iterator[Finding]:
    for number in sorted(expected.keys() | found.keys(), key=str):
        if number not in found:
            yield Finding("export", path, f"{name}: id {number} is missing", *_place(name, expected[number]))
        elif number not in expected:
            yield Finding("export", path, f"{name}: id {number} is not in the dataset", *_place(name, found[number]))
        else:
            keys = [
                key
                for key in sorted(expected[number].keys() | found[number].keys())
                if found[number].get(key) != expected[number].get(key)
            ]
            if keys:
                message = f"{name}: id {number} differs from the dataset in {', '.join(keys)}"
                yield Finding("export", path, message, *_place(name, expected[number]))


def _place(name: str, item: Mapping[str, Any]) -> tuple[Any, ...]:
    """Image and instance of an item, numbered as in the file."""
    if name == "images":
        return (item["id"],)
    return (item.get("image_id"), item.get("gt_id")) if name == "annotations" else ()
