"""What the pages show of an image file: small JPEGs, and depth and normals as colours."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.layout import ScenePaths
from synthetless.io import images
from synthetless.io.files import read_bytes

Pixels = NDArray[np.uint8]

THUMBNAIL_PX = 256
_LARGEST_PX = 1280
_QUALITY = 90


def rgb(scene: ScenePaths, im_id: int) -> Pixels | None:
    """(H, W, 3) of the image, None if the dataset has none.

    Raises:
        UserError: the file is damaged.
    """
    path = next((path for path in (scene.rgb(im_id, "png"), scene.rgb(im_id, "jpg")) if path.exists()), None)
    return None if path is None else images.decode_rgb(read_bytes(path), path)


def depth(scene: ScenePaths, im_id: int, depth_scale: float) -> tuple[Pixels | None, list[float]]:
    """Depth as colours, near ones bright, black where there is none; and its range [near, far] in mm.

    The farthest fiftieth of the pixels, often a table's horizon, has one colour.

    Raises:
        UserError: the file is damaged.
    """
    path = scene.depth(im_id)
    if not path.exists():
        return None, []
    depth_mm = images.decode_depth(read_bytes(path), depth_scale, path)
    present = depth_mm > 0
    if not present.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8), []
    near, far = np.percentile(depth_mm[present], [0.0, 98.0]).tolist()
    level = np.clip((far - depth_mm) / max(far - near, 1e-6), 0, 1)
    colours = cv2.applyColorMap(np.rint(255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(present[..., None], colours, 0).astype(np.uint8), [round(near, 1), round(far, 1)]


def normals(scene: ScenePaths, im_id: int) -> Pixels | None:
    """Unit normals as colours: x red, y green, z blue, each 0 at -1 and 255 at 1; black where there is none.

    Raises:
        UserError: the file is damaged.
    """
    path = scene.normals(im_id)
    if not path.exists():
        return None
    vectors = images.decode_normals(read_bytes(path), path)
    colours = np.where(vectors.any(axis=2)[..., None], 127.5 + 127.5 * vectors, 0)
    pixels: Pixels = np.rint(colours).astype(np.uint8)
    return pixels


def encode(pixels: Pixels, largest_px: int = _LARGEST_PX) -> bytes:
    """A JPEG of which no side is longer than ``largest_px``."""
    height, width = pixels.shape[:2]
    scale = min(1.0, largest_px / max(height, width))
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return images.encode_jpeg(np.ascontiguousarray(pixels), _QUALITY)


def mask(path: Path) -> NDArray[np.bool_] | None:
    """A mask, None if the dataset has none.

    Raises:
        UserError: the file is damaged.
    """
    return images.decode_mask(read_bytes(path), path) if path.exists() else None
