"""A photograph made seamless: it can be repeated without mirroring it, and without a border that is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2

_OVERLAP = 0.2
"""Share of each side that lies on the opposite border."""
_FEATHER = 0.04
"""Width of the transition across the cut, as a share of the overlap."""

Floats = NDArray[np.float32]


def seamless(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A tile that can be repeated in both directions.

    The photograph's opposite borders are laid over each other and cut along the path on which they differ least (Efros
    and Freeman, Image quilting for texture synthesis and transfer, 2001); what is darker or brighter at large is evened
    out over the whole overlap.

    Args:
        pixels: (H, W, 3) sRGB.

    Returns:
        (h, w, 3) sRGB, a fifth smaller each way. Photographs below 16 pixels come back as they are.
    """
    if min(pixels.shape[:2]) < 16:
        return pixels
    tile = _joined(pixels.astype(np.float32), is_closed=False)
    tile = _joined(tile.transpose(1, 0, 2), is_closed=True).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(np.clip(tile, 0, 255)).astype(np.uint8))


def _joined(image: Floats, is_closed: bool) -> Floats:
    """(H, w, 3) of (H, W, 3), seamless from the last column to the first; ``is_closed`` if it is so from row to row."""
    width = image.shape[1]
    overlap = round(_OVERLAP * width)
    begin, end = image[:, :overlap], image[:, width - overlap :]
    cut = _cheapest_path(((begin - end) ** 2).sum(axis=2), is_closed)
    across = np.arange(overlap) + 0.5
    feather = max(1.0, _FEATHER * overlap)
    sharp = np.clip((across[None, :] - cut[:, None]) / feather + 0.5, 0, 1)[..., None].astype(np.float32)
    gradual = (across / overlap)[None, :, None].astype(np.float32)
    smooth_begin, smooth_end = (_smoothed(side, overlap / 6, is_closed) for side in (begin, end))
    joined = image[:, : width - overlap].copy()
    joined[:, :overlap] = (
        gradual * smooth_begin
        + (1 - gradual) * smooth_end
        + sharp * (begin - smooth_begin)
        + (1 - sharp) * (end - smooth_end)
    )
    return joined


def _smoothed(side: Floats, sigma_px: float, is_closed: bool) -> Floats:
    margin = min(round(3 * sigma_px), side.shape[0]) if is_closed else 0
    wrapped = np.concatenate([side[side.shape[0] - margin :], side, side[:margin]])
    smooth = cv2.GaussianBlur(wrapped, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth[margin : margin + side.shape[0]], dtype=np.float32)


def _cheapest_path(cost: Floats, is_closed: bool) -> NDArray[np.int64]:
    """(H,) column in each row of the path of least cost, a column aside at most from row to row.

    It keeps clear of both sides, so that the transition across it has room; a closed one ends where it begins.
    """
    height, width = cost.shape
    margin = max(1, width // 8)
    cost = cost.copy()
    cost[:, :margin] = cost[:, width - margin :] = np.inf
    if is_closed:
        start = int(_path(np.roll(cost, height // 2, axis=0))[height // 2])  # where the first row is not an end
        elsewhere = np.arange(width) != start
        cost[0, elsewhere] = cost[-1, elsewhere] = np.inf
    return _path(cost)


def _path(cost: Floats) -> NDArray[np.int64]:
    height, width = cost.shape
    total = np.empty((height, width), dtype=np.float64)
    total[0] = cost[0]
    padded = np.full(width + 2, np.inf)
    for row in range(1, height):
        padded[1:-1] = total[row - 1]
        total[row] = cost[row] + np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    path = np.empty(height, dtype=np.int64)
    path[-1] = total[-1].argmin()
    for row in range(height - 2, -1, -1):
        low = max(0, path[row + 1] - 1)
        path[row] = low + total[row, low : path[row + 1] + 2].argmin()
    return path
