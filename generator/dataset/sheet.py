"""A contact sheet: some images of a dataset beside the same images with their labels drawn in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset import records
from synthetless.dataset.layout import ScenePaths, scene_ids
from synthetless.dataset.records import Entry
from synthetless.errors import UserError
from synthetless.io import images
from synthetless.io.files import atomic_write, read_bytes

_TILE_PX = 320
_BOX_EDGES = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]


def write_contact_sheet(dataset: Path, to: Path, split: str, limit: int = 6) -> None:
    """Write a JPEG of up to ``limit`` images: as rendered above, with visible outlines and canonical boxes below.

    Raises:
        UserError: the dataset has no images, or one cannot be read.
    """
    scene = ScenePaths.of(dataset, scene_ids(dataset, split)[0], split)
    labels = records.read_scene_json(scene.scene_gt_canonical)
    chosen = [path for path in (_rgb(scene, im_id) for im_id in labels) if path is not None][:limit]
    if not chosen:
        raise UserError(f"{scene.root / 'rgb'}: holds no images to show")
    plain = [images.decode_rgb(read_bytes(path), path) for path in chosen]
    drawn = [
        _with_labels(rgb, scene, int(path.stem), labels[int(path.stem)])
        for rgb, path in zip(plain, chosen, strict=True)
    ]
    columns = min(len(chosen), 3)
    rows = []
    for start in range(0, len(chosen), columns):
        rows += [_row(plain[start : start + columns], columns), _row(drawn[start : start + columns], columns)]
    atomic_write(to, images.encode_jpeg(np.vstack(rows), quality=90))


def _rgb(scene: ScenePaths, im_id: int) -> Path | None:
    return next((path for path in (scene.rgb(im_id, "png"), scene.rgb(im_id, "jpg")) if path.exists()), None)


def _with_labels(rgb: NDArray[np.uint8], scene: ScenePaths, im_id: int, labels: Sequence[Entry]) -> NDArray[np.uint8]:
    drawn = rgb.copy()
    for gt_id, label in enumerate(labels):
        color = class_color(label["obj_id"])
        path = scene.mask_visib(im_id, gt_id)
        visible = not path.exists()
        if path.exists():
            mask = images.decode_mask(read_bytes(path), path)
            visible = bool(mask.any())
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(drawn, contours, -1, color, 1, cv2.LINE_AA)
        if visible:
            _draw_box(drawn, np.array(label["bbox3d_corners_2d"]), color)
    return drawn


def _draw_box(image: NDArray[np.uint8], corners: NDArray[np.float64], color: tuple[int, int, int]) -> None:
    """Draw a box whose first corner is marked, so that one sees which way the canonical pose is turned."""
    bounded = np.clip(corners, -4096, 4096)
    points = np.rint(bounded * 16).astype(int)  # OpenCV's fixed point, 4 fractional bits
    for a, b in _BOX_EDGES:
        cv2.line(image, tuple(points[a].tolist()), tuple(points[b].tolist()), color, 1, cv2.LINE_AA, shift=4)
    cv2.circle(image, tuple(points[0].tolist()), 3 * 16, color, -1, cv2.LINE_AA, shift=4)


def class_color(obj_id: int) -> tuple[int, int, int]:
    """A bright RGB colour for an object id; neighbouring ids are far apart."""
    hue = int(obj_id * 0.618034 % 1 * 180)
    pixel = cv2.cvtColor(np.array([[[hue, 200, 255]]], dtype=np.uint8), cv2.COLOR_HSV2RGB)
    red, green, blue = (int(value) for value in pixel[0, 0])
    return red, green, blue


def _row(tiles: Sequence[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    height = round(_TILE_PX * tiles[0].shape[0] / tiles[0].shape[1])
    resized = [cv2.resize(tile, (_TILE_PX, height), interpolation=cv2.INTER_AREA) for tile in tiles]
    blank = np.full((height, _TILE_PX, 3), 255, dtype=np.uint8)
    row: NDArray[np.uint8] = np.hstack([*resized, *[blank] * (columns - len(tiles))]).astype(np.uint8)
    return row
