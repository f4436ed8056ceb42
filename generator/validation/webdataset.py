"""Shards against the dataset they were made from, member by member."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from synthetless.dataset.layout import DATASET_FILE, SYMMETRIES_FILE, ScenePaths
from synthetless.dataset.records import uncompressed_rle
from synthetless.exports.webdataset import KEYS_FILE
from synthetless.io.files import read_bytes, read_json
from synthetless.io.images import decode_mask
from synthetless.validation.labels import SceneLabels
from synthetless.validation.report import Finding, Tally, unusable
from synthetless.validation.source import Source

_SHARDS = f"shard-{'[0-9]' * 6}.tar"


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
    for name in (DATASET_FILE, SYMMETRIES_FILE):
        path, original = folder / name, source.root / name
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
            shard = next(iter(members.values())).shard
            findings.append(Finding("export", shard, f"has the image {key}, which the dataset does not have"))
    return result, findings


def check_shards(task: ShardsTask) -> Tally:
    """Compare the images of one scene folder."""
    tally = Tally(task.limit)
    labels = SceneLabels.read(task.source.scene(task.scene_id))
    keys = {f"{task.scene_id:06d}_{im_id:06d}": im_id for im_id in labels.gt}
    for key in sorted(task.members.keys() - keys.keys()):
        shard = next(iter(task.members[key].values())).shard
        tally.add([Finding("export", shard, f"has the image {key}, which the dataset does not have")])
    for key, im_id in keys.items():
        tally.add(_check_image(task, labels, key, im_id))
    return tally


def _check_image(task: ShardsTask, labels: SceneLabels, key: str, im_id: int) -> Iterator[Finding]:
    members = task.members.get(key)
    if members is None:
        yield Finding("export", task.folder, f"no shard has the image {key}", im_id)
        return
    shard = next(iter(members.values())).shard
    contents = _labels(labels, im_id)
    files = _files(task.source, labels.paths, im_id)
    masks = _masks(labels.paths, im_id, len(labels.gt[im_id])) if task.source.has("masks") else {}
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


def _labels(labels: SceneLabels, im_id: int) -> dict[str, Any]:
    sources: dict[str, Mapping[int, Any]] = {
        "camera.json": labels.camera,
        "gt.json": labels.gt,
        "gt_canonical.json": labels.canonical,
        "gt_info.json": labels.gt_info,
    }
    return {name: content[im_id] for name, content in sources.items() if im_id in content}


def _files(source: Source, paths: ScenePaths, im_id: int) -> dict[str, Path]:
    extension = source.recipe.encoding.rgb_format
    files = {f"rgb.{extension}": paths.rgb(im_id, extension), "depth.png": paths.depth(im_id)}
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
    except ValueError:
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
