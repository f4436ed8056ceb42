"""BOP's webdataset: tar shards of a split, read front to back without seeking.

Format: https://github.com/thodan/bop_toolkit/blob/master/bop_toolkit_lib/dataset/bop_webdataset.py, and beside its
members ``gt_canonical.json`` and, where there is one, ``gt_ambiguity.json``. Encoded images are copied, never decoded;
the same dataset and seed give the same bytes.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import (
    AMBIGUITY_FILE,
    CARD_FILE,
    DATASET_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_split,
    refuse_target,
    scene_ids,
)
from synthetless.dataset.reader import ImageEntries, read_entries
from synthetless.dataset.records import RunLengths, uncompressed_rle
from synthetless.errors import UserError
from synthetless.io.files import (
    atomic_file,
    atomic_folder,
    atomic_write,
    read_bytes,
    remove_drafts,
    remove_file,
    write_json,
)
from synthetless.io.images import decode_mask
from synthetless.io.parallel import processes

MAX_IMAGES_PER_SHARD = 1000
"""BOP's limit."""
KEYS_FILE = "key_to_shard.json"
_AMBIGUITY = "gt_ambiguity.json"
_COMPANIONS = (DATASET_FILE, SYMMETRIES_FILE, AMBIGUITY_FILE, CARD_FILE)
"""Files of the dataset folder that say what the labels mean, copied beside the shards."""

Members = dict[str, bytes]


@dataclass(frozen=True)
class ShardImage:
    """One image on its way into a shard: its key, where it comes from, and its encoded labels by member name."""

    key: str
    scene: ScenePaths
    im_id: int
    instances: int
    labels: Members


ShardTask = tuple[Path, list[ShardImage]]


def export_webdataset(
    dataset: Path,
    to: Path,
    split: str | None = None,
    images_per_shard: int = MAX_IMAGES_PER_SHARD,
    shuffle_seed: int | None = None,
    workers: int | None = None,
) -> dict[str, int]:
    """Write a split as shard-000000.tar, ... and key_to_shard.json.

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json in its scenes.
        to: a new or empty folder; it appears when everything is written.
        split: folder name; the only one if None.
        images_per_shard: 1 to 1000.
        shuffle_seed: seed of the images' order; scene by scene if None. In either case the image with the most
            instances comes first.
        workers: processes; one per available core if None.

    Returns:
        The number of the shard each key (``{scene:06d}_{im:06d}``) is in.

    Raises:
        UserError: an argument is out of range, the dataset is incomplete, or the folder belongs to it, holds something,
            or cannot be written.
    """
    refuse_target(dataset, to)
    if not 1 <= images_per_shard <= MAX_IMAGES_PER_SHARD:
        raise UserError(f"images_per_shard is {images_per_shard}; 1 to {MAX_IMAGES_PER_SHARD} are possible")
    refuse_half_labelled(dataset)
    images = list(_images(dataset, split or find_split(dataset)))
    if not images:
        raise UserError(f"{dataset}: holds no images to export")
    if shuffle_seed is not None:
        order = np.random.default_rng(np.random.SeedSequence(shuffle_seed)).permutation(len(images))
        images = [images[i] for i in order]
    images = _richest_first(images)
    shards = [images[start : start + images_per_shard] for start in range(0, len(images), images_per_shard)]
    with atomic_folder(to) as folder:
        tasks = [(folder / f"shard-{number:06d}.tar", shard) for number, shard in enumerate(shards)]
        _run(_write_shard, tasks, workers)
        return _finish(dataset, folder, {image.key: n for n, shard in enumerate(shards) for image in shard})


def relabel_webdataset(
    dataset: Path, shards: Path, split: str | None = None, workers: int | None = None
) -> dict[str, int]:
    """Replace the labels in exported shards after a change of symmetries; images and masks are copied as they are.

    The result equals a fresh export byte for byte. Each shard is replaced as a whole; key_to_shard.json is removed
    first and written last, so its absence shows an interrupted run, which another run completes.

    Args:
        dataset: the dataset folder, relabelled.
        shards: what ``export_webdataset`` wrote from it.
        split, workers: as in ``export_webdataset``.

    Returns:
        As ``export_webdataset``.

    Raises:
        UserError: the shards do not hold the dataset's images, are damaged, or cannot be written.
    """
    refuse_target(dataset, shards)
    paths = sorted(shards.glob("shard-*.tar"))
    if not paths:
        raise UserError(f"{shards}: holds no shards (shard-000000.tar, ...); export first")
    refuse_half_labelled(dataset)
    images = {image.key: image for image in _images(dataset, split or find_split(dataset))}
    keys = [list(dict.fromkeys(_key(name) for name in _names(path))) for path in paths]
    key_to_shard = {key: number for number, shard in enumerate(keys) for key in shard}
    if key_to_shard.keys() != images.keys():
        odd = min(key_to_shard.keys() ^ images.keys())
        place = "shards" if odd in key_to_shard else "dataset"
        raise UserError(f"{shards}: image {odd} is only in the {place}; export the dataset again")
    remove_drafts(shards)  # of a run that was killed
    _withdraw(shards / KEYS_FILE)
    tasks = [(path, [images[key] for key in shard]) for path, shard in zip(paths, keys, strict=True)]
    _run(_relabel_shard, tasks, workers)
    return _finish(dataset, shards, key_to_shard)


def _images(dataset: Path, split: str) -> Iterator[ShardImage]:
    for scene_id in tqdm(scene_ids(dataset, split), desc="labels", unit="scene", disable=None):
        scene = ScenePaths.of(dataset, scene_id, split)
        for labels in read_entries(scene):
            key = f"{scene_id:06d}_{labels.im_id:06d}"
            yield ShardImage(key, scene, labels.im_id, len(labels.gt), _label_members(labels))


def _richest_first(images: list[ShardImage]) -> list[ShardImage]:
    """Move the image with the most instances to the front.

    Hugging Face's loader infers the columns from the first five images and silently drops the masks of
    every later image that has more instances than those.
    """
    richest = max(range(len(images)), key=lambda i: images[i].instances)
    return [images[richest], *images[:richest], *images[richest + 1 :]]


def _label_members(labels: ImageEntries) -> Members:
    members = {
        "camera.json": _json(labels.camera),
        "gt.json": _json(labels.gt),
        "gt_canonical.json": _json(labels.gt_canonical),
        "gt_info.json": _json(labels.gt_info),
    }
    return members | ({_AMBIGUITY: _json(labels.gt_ambiguity)} if labels.gt_ambiguity else {})


def _run(function: Callable[[ShardTask], int], tasks: Sequence[ShardTask], workers: int | None) -> None:
    total = sum(len(images) for _, images in tasks)
    with (
        processes(workers, len(tasks)) as run,
        tqdm(total=total, desc="shards", unit="image", disable=None) as bar,
    ):
        for count in run(function, tasks):
            bar.update(count)


def _write_shard(task: ShardTask) -> int:
    path, images = task
    _write_tar(path, ((image.key, {**image.labels, **_image_members(image)}) for image in images))
    return len(images)


def _relabel_shard(task: ShardTask) -> int:
    path, images = task
    labels = {image.key: image.labels for image in images}
    kept = ((key, {name: data for name, data in of.items() if name != _AMBIGUITY}) for key, of in _read_tar(path))
    _write_tar(path, ((key, {**members, **labels[key]}) for key, members in kept))
    return len(images)


def _image_members(image: ShardImage) -> Members:
    """What there is of the image's files: colour and depths as they are, masks as run lengths."""
    scene, members = image.scene, {}
    for extension in ("png", "jpg"):
        if (path := scene.rgb(image.im_id, extension)).exists():
            members[f"rgb.{extension}"] = read_bytes(path)
    for name, path in (("depth", scene.depth(image.im_id)), ("depth_sensed", scene.depth_sensed(image.im_id))):
        if path.parent.is_dir():
            members[f"{name}.png"] = read_bytes(path)
    known: dict[bytes, RunLengths] = {}
    for name, mask in (("mask", scene.mask), ("mask_visib", scene.mask_visib)):
        if (scene.root / name).is_dir():
            rles = {str(gt_id): _rle(mask(image.im_id, gt_id), known) for gt_id in range(image.instances)}
            members[f"{name}.json"] = _json(rles)
    return members


def _rle(path: Path, known: dict[bytes, RunLengths]) -> RunLengths:
    """Run lengths of a mask file; ``known`` spares decoding the two masks of an unoccluded instance twice."""
    data = read_bytes(path)
    if data not in known:
        known[data] = uncompressed_rle(decode_mask(data, path))
    return known[data]


def _json(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True).encode()


def _write_tar(path: Path, images: Iterable[tuple[str, Mapping[str, bytes]]]) -> None:
    """Members in alphabetical order, as the webdataset package writes them; no times, no owners."""
    with atomic_file(path) as file, tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for key, members in images:
            for name in sorted(members):
                info = tarfile.TarInfo(f"{key}.{name}")
                info.size = len(members[name])
                info.mode = 0o644
                tar.addfile(info, io.BytesIO(members[name]))


def _read_tar(path: Path) -> Iterator[tuple[str, Members]]:
    with tarfile.open(path, "r:") as tar:
        for key, group in groupby(tar, key=lambda member: _key(member.name)):
            yield key, {member.name.removeprefix(f"{key}."): _content(tar, member) for member in group}


def _content(tar: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    file = tar.extractfile(member)
    return b"" if file is None else file.read()


def _withdraw(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be replaced ({error.strerror})") from error


def _names(path: Path) -> list[str]:
    """Names of a shard's members; tarfile alone takes an archive cut inside a header for a whole one."""
    try:
        if path.stat().st_size % tarfile.RECORDSIZE:
            raise tarfile.ReadError("cut off")
        with tarfile.open(path, "r:") as tar:
            return tar.getnames()
    except (tarfile.TarError, OSError) as error:
        raise UserError(f"{path}: not a readable shard ({error}); export the dataset again") from None


def _key(member_name: str) -> str:
    return member_name.split(".", maxsplit=1)[0]


def _finish(dataset: Path, folder: Path, key_to_shard: dict[str, int]) -> dict[str, int]:
    for name in _COMPANIONS:
        if not (dataset / name).exists():
            remove_file(folder / name)
        else:
            atomic_write(folder / name, read_bytes(dataset / name))
    write_json(folder / KEYS_FILE, dict(sorted(key_to_shard.items())))
    return key_to_shard
