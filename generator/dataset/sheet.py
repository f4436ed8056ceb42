"""A contact sheet: some images of a dataset beside the same images with their labels drawn in."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.layout import ScenePaths, scene_ids
from synthetless.dataset.palette import Color, class_color
from synthetless.dataset.reader import Image, Scene
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io import images
from synthetless.io.files import atomic_write
from synthetless.io.models import BOX_EDGES

Pixels = NDArray[np.uint8]

_TILE_PX = 320


def write_contact_sheet(dataset: Path, to: Path, split: str, limit: int = 6) -> None:
    """Write a JPEG of up to ``limit`` images: as rendered above, with visible outlines and canonical boxes below.

    Raises:
        UserError: the dataset has no images, or one cannot be read.
    """
    scene = Scene.read(ScenePaths.of(dataset, scene_ids(dataset, split)[0], split))
    every = (scene.image(number) for number in range(len(scene)))
    chosen = list(islice((image for image in every if scene.paths.find_rgb(image.im_id)), limit))
    if not chosen:
        raise UserError(f"{scene.paths.root / 'rgb'}: holds no images to show")
    plain = [image.rgb() for image in chosen]
    drawn = [_with_labels(rgb, image) for rgb, image in zip(plain, chosen, strict=True)]
    columns = min(len(chosen), 3)
    rows = []
    for start in range(0, len(chosen), columns):
        rows += [_row(plain[start : start + columns], columns), _row(drawn[start : start + columns], columns)]
    atomic_write(to, images.encode_jpeg(np.vstack(rows), quality=90))


def _with_labels(rgb: Pixels, image: Image) -> Pixels:
    drawn = rgb.copy()
    for instance in image.instances:
        color, visible = class_color(instance.obj_id), True
        if image.paths.mask_visib(image.im_id, instance.gt_id).exists():
            mask = instance.mask_visib()
            visible = bool(mask.any())
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(drawn, contours, -1, color, 1, cv2.LINE_AA)
        if visible and instance.label is not None:
            _draw_box(drawn, instance.label.corners_px, color)
    return drawn


def _draw_box(image: Pixels, corners_px: NDArray[np.float64], color: Color) -> None:
    """Draw a box whose first corner is marked, so that one sees which way the canonical pose is turned."""
    bounded = np.clip(corners_px, -4096, 4096)
    points = np.rint(bounded * 16).astype(int)  # OpenCV's fixed point, 4 fractional bits
    for a, b in BOX_EDGES:
        cv2.line(image, tuple(points[a].tolist()), tuple(points[b].tolist()), color, 1, cv2.LINE_AA, shift=4)
    cv2.circle(image, tuple(points[0].tolist()), 3 * 16, color, -1, cv2.LINE_AA, shift=4)


def _row(tiles: Sequence[Pixels], columns: int) -> Pixels:
    height = round(_TILE_PX * tiles[0].shape[0] / tiles[0].shape[1])
    resized = [cv2.resize(tile, (_TILE_PX, height), interpolation=cv2.INTER_AREA) for tile in tiles]
    blank = np.full((height, _TILE_PX, 3), 255, dtype=np.uint8)
    row: Pixels = np.hstack([*resized, *[blank] * (columns - len(tiles))]).astype(np.uint8)
    return row
