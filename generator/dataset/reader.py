"""A scene folder's labels, read together and checked against each other: what the exports start from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import Entry, read_scene_json
from synthetless.errors import UserError


@dataclass(frozen=True)
class ImageLabels:
    """One image's entries in BOP's scene files; the lists are in scene_gt's order.

    Attributes:
        im_id: the image.
        camera: its entry in scene_camera.json.
        gt, gt_info, gt_canonical: its entries in scene_gt.json, scene_gt_info.json and scene_gt_canonical.json.
    """

    im_id: int
    camera: Entry
    gt: list[Entry]
    gt_info: list[Entry]
    gt_canonical: list[Entry]


def read_scene(scene: ScenePaths) -> Iterator[ImageLabels]:
    """The labels of a scene's images, in ascending order.

    Raises:
        UserError: a file is missing or damaged, or the files disagree about the images or their instances.
    """
    cameras = read_scene_json(scene.scene_camera)
    gts = read_scene_json(scene.scene_gt)
    others = [_matching(path, scene.scene_gt, gts) for path in (scene.scene_gt_info, scene.scene_gt_canonical)]
    if cameras.keys() != gts.keys():
        image = min(cameras.keys() ^ gts.keys())
        raise UserError(f"{scene.root}: image {image} is in only one of scene_camera.json and scene_gt.json")
    for im_id, gt in gts.items():
        yield ImageLabels(im_id, cameras[im_id], gt, *(other[im_id] for other in others))


def _matching(path: Path, gt_path: Path, gts: dict[int, Any]) -> dict[int, Any]:
    content = read_scene_json(path)
    for im_id in sorted(content.keys() | gts.keys()):
        expected, found = len(gts.get(im_id, [])), len(content.get(im_id, []))
        if im_id not in content or expected != found:
            raise UserError(f"{path}: image {im_id} has {found} entries, but {expected} in {gt_path.name}")
    return content
