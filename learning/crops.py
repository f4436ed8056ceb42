"""A small network on crops with given boxes: the proof in minutes, without detection in the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from synthetless.extras import cv2
from synthetless.learning.heads import PoseHead, PoseOutput, pose_losses
from synthetless.learning.stream import Crops
from synthetless.learning.targets import LabelMaker, rolled, turned

Floats = NDArray[np.float64]


class CropNet(nn.Module):
    """Six convolutions and a hidden layer before the pose head; 5 million multiply-adds at 48 pixels.

    Args:
        size_px: side of the crops, a multiple of 16.
        classes, regressors: of the head.
        width: channels of the first layer.
    """

    def __init__(self, size_px: int, classes: int, regressors: int, width: int = 16) -> None:
        super().__init__()
        channels = [3, width, 2 * width, 2 * width, 4 * width, 4 * width, 8 * width]
        layers: list[nn.Module] = []
        for i, stride in enumerate((2, 2, 1, 2, 1, 2)):
            layers += [
                nn.Conv2d(channels[i], channels[i + 1], 3, stride, 1, bias=False),
                nn.BatchNorm2d(channels[i + 1]),
                nn.ReLU(inplace=True),
            ]
        cells = (size_px // 16) ** 2
        self.features = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(cells * channels[-1], 512), nn.ReLU(inplace=True)
        )
        self.head = PoseHead(512, classes, regressors)

    def forward(self, pixels: Tensor) -> PoseOutput:
        """From pixels (N, 3, S, S), about -1 to 1."""
        output: PoseOutput = self.head(self.features(pixels))
        return output


@dataclass(frozen=True, eq=False)
class CropBatch:
    """N crops with their targets.

    Attributes:
        pixels: (N, 3, S, S) float32.
        classes: (N,) number of the object among the sorted ids.
        corners: (N, 8, 2) relative to the crop's centre, in its side.
        index, counts: (N,) responsible regressor, and how many there are.
        margin_deg: (N,) discontinuity margins of the labels.
    """

    pixels: Tensor
    classes: Tensor
    corners: Tensor
    index: Tensor
    counts: Tensor
    margin_deg: Tensor

    def losses(self, output: PoseOutput, full_weight_deg: float | None = None) -> dict[str, Tensor]:
        """Of the network's output; labels nearer to a jump than ``full_weight_deg`` count for less, if it is given."""
        weights = None if full_weight_deg is None else (self.margin_deg / full_weight_deg).clamp(max=1)
        return pose_losses(output.of_class(self.classes), self.corners, self.index, self.counts, weights)

    def to(self, device: torch.device) -> CropBatch:
        """The same elsewhere."""
        parts = (self.pixels, self.classes, self.corners, self.index, self.counts, self.margin_deg)
        return CropBatch(*(part.to(device) for part in parts))


class CropBatcher:
    """Makes batches of crops under one label set."""

    def __init__(self, maker: LabelMaker, boxes_mm: Mapping[int, Floats], ids: Sequence[int]) -> None:
        """Prepare.

        Args:
            maker: labels the poses.
            boxes_mm: (8, 3) box corners by object id.
            ids: the objects, sorted; their order is that of the classes.
        """
        self._maker, self._ids = maker, np.array(ids, dtype=np.int64)
        self._boxes = np.stack([boxes_mm[obj_id] for obj_id in ids])
        self.regressors = max(maker.n_regressors(obj_id) for obj_id in ids)

    def batch(self, crops: Crops) -> CropBatch:
        """The crops as they are."""
        size = crops.pixels.shape[1]
        classes = np.searchsorted(self._ids, crops.obj_ids)
        targets = self._maker(crops.obj_ids, crops.R_m2c, crops.t_m2c)
        corners = (targets.corners_px(self._boxes[classes], crops.K) - (size - 1) / 2) / size
        pixels = (torch.from_numpy(crops.pixels).permute(0, 3, 1, 2).float() - 127.5) / 127.5
        return CropBatch(
            pixels,
            torch.from_numpy(classes),
            torch.from_numpy(corners).float(),
            torch.from_numpy(targets.regressor_index),
            torch.from_numpy(targets.n_regressors),
            torch.from_numpy(targets.margin_deg).float(),
        )

    def augmented(self, crops: Crops, rng: np.random.Generator, roll_deg: float) -> CropBatch:
        """The crops turned about their axis, lighter or darker, noisy; labelled after the turn."""
        n, size = len(crops), crops.pixels.shape[1]
        angles = np.radians(rng.uniform(-roll_deg, roll_deg, n))
        pixels = np.stack([_turn(image, angle) for image, angle in zip(crops.pixels, angles, strict=True)])
        gain, offset, sigma = (
            rng.uniform(low, high, (n, 1, 1, 1)).astype(np.float32) for low, high in ((0.7, 1.3), (-20, 20), (0, 10))
        )
        noise = rng.standard_normal((n, size, size, 1), dtype=np.float32)
        pixels = np.clip(pixels * gain + (offset + sigma * noise), 0, 255).astype(np.uint8)
        R, t = turned(rolled(angles), crops.R_m2c, crops.t_m2c)
        return self.batch(Crops(pixels, crops.obj_ids, R, t, crops.K, crops.elevation_deg))


def _turn(image: NDArray[np.uint8], angle_rad: float) -> NDArray[np.uint8]:
    """The picture turned about its centre, x towards y, as a camera that rolls sees it."""
    middle = (image.shape[0] - 1) / 2
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    matrix = np.array([[c, -s, middle - c * middle + s * middle], [s, c, middle - s * middle - c * middle]])
    size = (image.shape[1], image.shape[0])
    return np.asarray(cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REFLECT_101), dtype=np.uint8)
