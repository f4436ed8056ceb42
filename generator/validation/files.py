"""The files of a scene folder: all that should be there, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from synthetless.validation.labels import SceneLabels
from synthetless.validation.report import Finding
from synthetless.validation.source import Source

_IDS = re.compile(r"(\d{6})(?:_(\d{6}))?\.\w+")

Place = tuple[int | None, int | None]


def check_files(source: Source, labels: SceneLabels) -> Iterator[Finding]:
    """Images and masks that are missing, and files that belong to no image."""
    paths = labels.paths
    folders = _expected(source, labels)
    scene_files = {
        path.name
        for path in (
            paths.scene_camera,
            paths.scene_gt,
            paths.scene_gt_info,
            paths.scene_gt_coco,
            paths.scene_gt_canonical,
            paths.scene_spec,
        )
    }
    for path in sorted(paths.root.iterdir()):
        if path.name not in scene_files and path not in folders:
            yield Finding("stray", path, f"the recipe's outputs ({', '.join(source.recipe.outputs)}) have no such file")
    if not labels.is_readable(paths.scene_gt):  # told already, and nobody knows what should be there
        return
    malformed = labels.malformed(paths.scene_gt)
    for folder, expected in folders.items():
        found = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        for name in sorted(expected.keys() - found):
            yield Finding("missing", folder / name, "not there", *expected[name])
        for name in sorted(found - expected.keys()):
            place = place_of(name)
            if place[0] is None or place[0] not in malformed:
                yield Finding("stray", folder / name, "belongs to no instance in scene_gt.json", *place)


def _expected(source: Source, labels: SceneLabels) -> dict[Path, dict[str, Place]]:
    """Names, images and instances of the files that each folder should hold."""
    paths = labels.paths
    extension = source.recipe.encoding.rgb_format
    per_image = {
        "rgb": lambda im_id: paths.rgb(im_id, extension),
        "depth": paths.depth,
        "normals": paths.normals,
        "object_coordinates": paths.object_coordinates,
        "exr": paths.exr,
    }
    folders: dict[Path, dict[str, Place]] = {}
    for output, path_of in per_image.items():
        if source.has(output):
            files = {im_id: path_of(im_id) for im_id in labels.gt}
            folders[paths.root / output] = {path.name: (im_id, None) for im_id, path in files.items()}
    if source.has("masks"):
        for name, mask in (("mask", paths.mask), ("mask_visib", paths.mask_visib)):
            folders[paths.root / name] = {
                mask(im_id, gt_id).name: (im_id, gt_id) for im_id, gt in labels.gt.items() for gt_id in range(len(gt))
            }
    return folders


def place_of(name: str) -> Place:
    """Image and instance that a file name speaks of."""
    matched = _IDS.fullmatch(name)
    if matched is None:
        return None, None
    return int(matched[1]), None if matched[2] is None else int(matched[2])
