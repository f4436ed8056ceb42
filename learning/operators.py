"""The operators of a detector in plain torch: overlap, non-maximum suppression, RoIAlign, boxes as offsets.

torchvision has them, but its wheel does not import beside a CPU build of torch. Boxes are (x1, y1, x2, y2) in pixels,
with the centre of pixel (column i, row j) at (i, j).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_LARGEST_LOG_SCALE = 4.0
"""A box grows by e^4 at most: an untrained net may ask for infinitely more."""


def area(boxes: Tensor) -> Tensor:
    """(N,) areas of boxes (N, 4); 0 of those that are empty."""
    return (boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(dim=1)


def iou(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4); 0 where both are empty."""
    low, high = torch.maximum(a[:, None, :2], b[None, :, :2]), torch.minimum(a[:, None, 2:], b[None, :, 2:])
    intersection = (high - low).clamp(min=0).prod(dim=2)
    union = area(a)[:, None] + area(b)[None] - intersection
    return intersection / union.clamp(min=1e-9)


def nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Numbers of the boxes that remain, the highest score first, when each removes those that overlap it by more.

    Args:
        boxes: (N, 4).
        scores: (N,).
        threshold: of the intersection over union.
    """
    order = torch.argsort(scores, descending=True, stable=True)
    overlaps = iou(boxes[order], boxes[order]) > threshold
    alive = torch.ones(len(order), dtype=torch.bool)
    rows = overlaps.cpu()
    for i in range(len(order)):
        if alive[i]:
            alive[i + 1 :] &= ~rows[i, i + 1 :]
    return order[alive.to(order.device)]


def nms_by_class(boxes: Tensor, scores: Tensor, classes: Tensor, threshold: float) -> Tensor:
    """``nms`` in which only boxes of the same class (N,) remove each other."""
    if len(boxes) == 0:
        return torch.zeros(0, dtype=torch.int64, device=boxes.device)
    apart = (boxes.max() - boxes.min() + 1) * classes.to(boxes.dtype)
    return nms(boxes + apart[:, None], scores, threshold)


def roi_align(features: Tensor, boxes: Tensor, images: Tensor, size: int, stride: int, samples: int = 2) -> Tensor:
    """(N, C, size, size) features in a regular grid over each box (He et al., Mask R-CNN, 2017), typed as the boxes.

    Args:
        features: (B, C, H, W); the centre of cell (column i, row j) is at pixel (stride (i + 1/2) - 1/2, ...).
        boxes: (N, 4) pixels.
        images: (N,) which of the B images each box is of.
        size: cells of the grid along each side.
        stride: pixels per feature cell.
        samples: bilinear samples along each side of a cell, of which the mean is taken.
    """
    n, (_, channels, height, width) = size * samples, features.shape
    steps = (torch.arange(n, device=boxes.device, dtype=boxes.dtype) + 0.5) / n
    x = boxes[:, 0, None] + steps * (boxes[:, 2] - boxes[:, 0])[:, None]
    y = boxes[:, 1, None] + steps * (boxes[:, 3] - boxes[:, 1])[:, None]
    # grid_sample without aligned corners: -1 and 1 are the outer edges of the first and last cell.
    u, v = ((2 * (axis + 0.5) / (stride * cells) - 1) for axis, cells in ((x, width), (y, height)))
    grid = torch.stack([u[:, None, :].expand(-1, n, -1), v[:, :, None].expand(-1, -1, n)], dim=3)
    features = features.to(boxes.dtype)  # grid_sample wants one type; under autocast boxes are float32, features not
    pooled = features.new_zeros(len(boxes), channels, size, size)
    for image in sorted(set(images.tolist())):
        rows = images == image
        own = grid[rows].reshape(1, -1, n, 2)
        sampled = functional.grid_sample(features[image : image + 1], own, align_corners=False, padding_mode="border")
        cells = sampled.reshape(channels, -1, size, samples, size, samples).mean(dim=(3, 5))
        pooled[rows] = cells.transpose(0, 1)
    return pooled


def encode_boxes(boxes: Tensor, references: Tensor) -> Tensor:
    """(N, 4) offsets that take reference boxes (N, 4) to boxes (N, 4): shifts in sides, logarithms of scales."""
    centre, side = _centre_side(boxes)
    reference_centre, reference_side = _centre_side(references)
    return torch.cat([(centre - reference_centre) / reference_side, torch.log(side / reference_side)], dim=1)


def decode_boxes(offsets: Tensor, references: Tensor) -> Tensor:
    """The inverse of ``encode_boxes``."""
    reference_centre, reference_side = _centre_side(references)
    centre = reference_centre + offsets[:, :2] * reference_side
    half = reference_side * torch.exp(offsets[:, 2:].clamp(max=_LARGEST_LOG_SCALE)) / 2
    return torch.cat([centre - half, centre + half], dim=1)


def _centre_side(boxes: Tensor) -> tuple[Tensor, Tensor]:
    return (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)
