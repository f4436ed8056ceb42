"""Faster R-CNN (Ren et al., 2015) with the paper's pose head: boxes, classes, and box corners of poses.

One feature map of stride 8 serves the proposals and the heads. Boxes are (x1, y1, x2, y2) pixels, pixel centres at
whole numbers. Class 0 is the background; object number i of the sorted ids is class i + 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from synthetless.learning.backbone import STRIDE, Backbone
from synthetless.learning.heads import PoseHead, pose_losses
from synthetless.learning.operators import decode_boxes, encode_boxes, iou, nms, nms_by_class, roi_align
from synthetless.learning.settings import Training

_POSITIVE_ANCHOR, _NEGATIVE_ANCHOR, _POSITIVE_ROI = 0.7, 0.3, 0.5
_CANDIDATES = 1000
_PROPOSAL_NMS = 0.7
_SMALLEST_PX = 2.0
_BETA = 1 / 9
"""Where smooth L1 turns from a square into a line, as torchvision has it."""


@dataclass(frozen=True, eq=False)
class Instances:
    """What is known of an image's N instances.

    Attributes:
        boxes: (N, 4).
        classes: (N,) 1 to C.
        ignored: (M, 4) boxes of what is neither learned nor background.
        corners_px: (N, 8, 2) of the label.
        index, counts: (N,) responsible regressor, and how many there are.
    """

    boxes: Tensor
    classes: Tensor
    ignored: Tensor
    corners_px: Tensor
    index: Tensor
    counts: Tensor

    def to(self, device: torch.device) -> Instances:
        """The same elsewhere."""
        parts = (self.boxes, self.classes, self.ignored, self.corners_px, self.index, self.counts)
        return Instances(*(part.to(device) for part in parts))


@dataclass(frozen=True, eq=False)
class Detections:
    """What is found in an image, the surest first.

    Attributes:
        boxes: (N, 4).
        classes: (N,) 1 to C.
        scores: (N,) 0 to 1.
        corners_px: (N, 8, 2) of the regressor that the classifier chooses.
        index: (N,) that regressor.
    """

    boxes: Tensor
    classes: Tensor
    scores: Tensor
    corners_px: Tensor
    index: Tensor


class Detector(nn.Module):
    """The network. ``losses`` in training, ``detect`` afterwards."""

    def __init__(self, settings: Training, regressors: Sequence[int]) -> None:
        """Make it; ``regressors`` are how many each object has, in the order of the classes.

        Raises:
            UserError: the backbone's weights are missing or of another network.
        """
        super().__init__()
        net, classes = settings.network, len(regressors)
        self.settings = settings
        self.backbone = Backbone(net.channels, net.weights, net.frozen_stages)
        anchors = len(net.anchor_sizes_px) * len(net.anchor_ratios)
        self.proposing = nn.Sequential(nn.Conv2d(net.channels, net.channels, 3, padding=1), nn.ReLU(inplace=True))
        self.objectness = nn.Conv2d(net.channels, anchors, 1)
        self.offsets = nn.Conv2d(net.channels, 4 * anchors, 1)
        self.box_features = _trunk(net.channels, net.roi_cells, net.hidden, convolutions=0)
        self.class_logits = nn.Linear(net.hidden, classes + 1)
        self.box_offsets = nn.Linear(net.hidden, 4 * (classes + 1))
        self.pose_features = _trunk(net.channels, net.roi_cells, net.hidden, convolutions=2)
        self.pose_head = PoseHead(net.hidden, classes, max(regressors))
        self.register_buffer("counts", torch.tensor(regressors, dtype=torch.int64))
        for layer in (self.objectness, self.offsets, self.class_logits, self.box_offsets):
            nn.init.normal_(layer.weight, std=0.01)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a quarter less time on a CPU

    def losses(self, pictures: Tensor, instances: Sequence[Instances]) -> dict[str, Tensor]:
        """Torchvision's four losses of a Faster R-CNN, and the pose head's two.

        Args:
            pictures: (B, 3, H, W), 0 to 255.
            instances: of each.
        """
        features = self.backbone(pictures)
        objectness, offsets, anchors = self._proposal_maps(features)
        proposals = self._proposals(objectness.detach(), offsets.detach(), anchors, pictures.shape[2:])
        of_anchors = [
            self._anchor_losses(objectness[i], offsets[i], anchors, known) for i, known in enumerate(instances)
        ]
        chosen = [self._choose_rois(boxes, known) for boxes, known in zip(proposals, instances, strict=True)]
        return {
            "objectness": torch.stack([a for a, _ in of_anchors]).mean(),
            "proposals": torch.stack([b for _, b in of_anchors]).mean(),
            **self._roi_losses(features, chosen, instances),
        }

    @torch.no_grad()
    def detect(self, pictures: Tensor) -> list[Detections]:
        """What is in pictures (B, 3, H, W), 0 to 255."""
        features = self.backbone(pictures)
        objectness, offsets, anchors = self._proposal_maps(features)
        proposals = self._proposals(objectness, offsets, anchors, pictures.shape[2:])
        return [self._detect(features[i : i + 1], boxes, pictures.shape[2:]) for i, boxes in enumerate(proposals)]

    def _proposal_maps(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Objectness (B, A), offsets (B, A, 4), and the anchors (A, 4)."""
        batch, _, height, width = features.shape
        shared = self.proposing(features)
        objectness = self.objectness(shared).permute(0, 2, 3, 1).reshape(batch, -1)
        offsets = self.offsets(shared).permute(0, 2, 3, 1).reshape(batch, -1, 4)
        return objectness, offsets, self._anchors(height, width, features.device)

    def _anchors(self, height: int, width: int, device: torch.device) -> Tensor:
        net = self.settings.network
        halves = [
            (size / ratio**0.5 / 2, size * ratio**0.5 / 2)
            for size in net.anchor_sizes_px
            for ratio in net.anchor_ratios
        ]
        half = torch.tensor(halves, device=device)
        y, x = ((STRIDE * (torch.arange(n, device=device) + 0.5) - 0.5) for n in (height, width))
        centres = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width)], dim=2)[:, :, None]
        return torch.cat([centres - half, centres + half], dim=3).reshape(-1, 4)

    @torch.no_grad()
    def _proposals(self, objectness: Tensor, offsets: Tensor, anchors: Tensor, size: Any) -> list[Tensor]:
        """Boxes (N, 4) of each image that may show something."""
        found = []
        for scores, own in zip(objectness.float(), offsets.float(), strict=True):
            best = torch.topk(scores, min(_CANDIDATES, len(scores))).indices
            boxes = _clipped(decode_boxes(own[best], anchors[best]), size)
            large = (boxes[:, 2:] - boxes[:, :2]).min(dim=1).values >= _SMALLEST_PX
            kept = nms(boxes[large], scores[best][large], _PROPOSAL_NMS)[: self.settings.sampling.proposals]
            found.append(boxes[large][kept])
        return found

    def _anchor_losses(
        self, objectness: Tensor, offsets: Tensor, anchors: Tensor, known: Instances
    ) -> tuple[Tensor, Tensor]:
        overlap, of = _best(anchors, known.boxes)
        positive = overlap >= _POSITIVE_ANCHOR
        if len(known.boxes):  # the best anchor of an instance counts, however little it overlaps
            of_instances = iou(known.boxes, anchors)
            best = of_instances.argmax(dim=1)
            positive[best] = True
            of = of.clone()
            of[best] = torch.arange(len(best), device=best.device)
        negative = (overlap < _NEGATIVE_ANCHOR) & ~positive & (_best(anchors, known.ignored)[0] < _NEGATIVE_ANCHOR)
        limit = self.settings.sampling.anchors_per_image
        chosen = _some(positive, limit // 2)
        others = _some(negative, limit - len(chosen))
        both = torch.cat([chosen, others])
        wanted = positive[both].to(objectness.dtype)
        of_objectness = functional.binary_cross_entropy_with_logits(objectness[both], wanted)
        if len(chosen) == 0:
            return of_objectness, offsets.sum() * 0
        targets = encode_boxes(known.boxes[of[chosen]], anchors[chosen])
        of_boxes = functional.smooth_l1_loss(offsets[chosen], targets, beta=_BETA, reduction="sum")
        return of_objectness, of_boxes / max(1, len(both))

    @torch.no_grad()
    def _choose_rois(self, proposals: Tensor, known: Instances) -> tuple[Tensor, Tensor]:
        """Boxes (R, 4) to learn from, and which instance each shows; -1 for the background."""
        boxes = torch.cat([proposals, known.boxes])
        overlap, of = _best(boxes, known.boxes)
        positive = overlap >= _POSITIVE_ROI
        negative = ~positive & (_best(boxes, known.ignored)[0] < _POSITIVE_ROI)
        limit = self.settings.sampling.rois_per_image
        chosen = _some(positive, limit // 3)
        others = _some(negative, limit - len(chosen))
        return boxes[torch.cat([chosen, others])], torch.cat([of[chosen], torch.full_like(others, -1)])

    def _roi_losses(
        self, features: Tensor, chosen: Sequence[tuple[Tensor, Tensor]], instances: Sequence[Instances]
    ) -> dict[str, Tensor]:
        boxes = torch.cat([own for own, _ in chosen])
        images = torch.cat([torch.full_like(of, i) for i, (_, of) in enumerate(chosen)])
        shows = torch.cat([of for _, of in chosen])
        with_background = [torch.cat([known.classes, known.classes.new_zeros(1)]) for known in instances]  # number -1
        classes = torch.cat([of_image[of] for (_, of), of_image in zip(chosen, with_background, strict=True)])
        pooled = roi_align(features, boxes, images, self.settings.network.roi_cells, STRIDE)
        hidden = self.box_features(pooled)
        losses = {"class": functional.cross_entropy(self.class_logits(hidden), classes)}
        rows = torch.nonzero(shows >= 0)[:, 0]
        known = [instances[int(images[row])] for row in rows]
        number = [int(shows[row]) for row in rows]
        if not known:
            nothing = pooled.sum() * 0
            return losses | {"box": nothing, "corners": nothing, "index": nothing}
        own = boxes[rows]
        offsets = self.box_offsets(hidden[rows]).reshape(len(rows), -1, 4)[torch.arange(len(rows)), classes[rows]]
        true_boxes = torch.stack([k.boxes[i] for k, i in zip(known, number, strict=True)])
        of_boxes = functional.smooth_l1_loss(offsets, encode_boxes(true_boxes, own), beta=_BETA, reduction="sum")
        output = self.pose_head(self.pose_features(pooled[rows])).of_class(classes[rows] - 1)
        corners, index, counts = (
            torch.stack([getattr(k, name)[i] for k, i in zip(known, number, strict=True)])
            for name in ("corners_px", "index", "counts")
        )
        return losses | {
            "box": of_boxes / len(boxes),
            **pose_losses(output, _to_box_units(corners, own), index, counts),
        }

    def _detect(self, features: Tensor, proposals: Tensor, size: Any) -> Detections:
        sampling, cells = self.settings.sampling, self.settings.network.roi_cells
        zeros = torch.zeros(len(proposals), dtype=torch.int64, device=proposals.device)
        hidden = self.box_features(roi_align(features, proposals, zeros, cells, STRIDE))
        scores = self.class_logits(hidden).float().softmax(dim=1)
        offsets = self.box_offsets(hidden).float().reshape(len(proposals), -1, 4)
        row, column = torch.nonzero(scores[:, 1:] >= sampling.score_threshold, as_tuple=True)
        classes, score = column + 1, scores[row, column + 1]
        boxes = _clipped(decode_boxes(offsets[row, classes], proposals[row]), size)
        large = (boxes[:, 2:] - boxes[:, :2]).min(dim=1).values >= _SMALLEST_PX
        boxes, classes, score = boxes[large], classes[large], score[large]
        kept = nms_by_class(boxes, score, classes, sampling.nms_threshold)[: sampling.detections]
        boxes, classes, score = boxes[kept], classes[kept], score[kept]
        pooled = roi_align(features, boxes, torch.zeros_like(classes), cells, STRIDE)
        output = self.pose_head(self.pose_features(pooled)).of_class(classes - 1)
        counts: Any = self.counts
        corners, index = output.chosen(counts[classes - 1])
        return Detections(boxes, classes, score, _to_pixels(corners.float(), boxes), index)


def _trunk(channels: int, cells: int, hidden: int, convolutions: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(convolutions):
        layers += [nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(channels * cells**2, hidden), nn.ReLU(inplace=True))


def _best(boxes: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) largest overlap of boxes (N, 4) with known ones (M, 4), and which it is; 0 without any."""
    if len(known) == 0:
        return boxes.new_zeros(len(boxes)), torch.zeros(len(boxes), dtype=torch.int64, device=boxes.device)
    best = iou(boxes, known).max(dim=1)
    return best.values, best.indices


def _some(mask: Tensor, limit: int) -> Tensor:
    """Numbers of at most so many true entries, drawn at random."""
    rows = torch.nonzero(mask)[:, 0]
    if len(rows) <= limit:
        return rows
    return rows[torch.randperm(len(rows))[:limit].to(rows.device)]


def _clipped(boxes: Tensor, size: Any) -> Tensor:
    height, width = size
    low = boxes.new_zeros(4)
    high = boxes.new_tensor([width - 1, height - 1, width - 1, height - 1])
    return torch.minimum(torch.maximum(boxes, low), high)


def _to_box_units(corners_px: Tensor, boxes: Tensor) -> Tensor:
    """(N, 8, 2) relative to the centres of boxes (N, 4), in their sides."""
    centre, side = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    return (corners_px - centre[:, None]) / side[:, None].clamp(min=1)


def _to_pixels(corners: Tensor, boxes: Tensor) -> Tensor:
    centre, side = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    return corners * side[:, None].clamp(min=1) + centre[:, None]
