"""The paper's head: for each class K regressors of eight box corners, and a classifier of the regressor."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

INDEX_WEIGHT = 0.1
"""Weight of the classifier's loss beside the corners', which are in units of the box."""


class PoseOutput(NamedTuple):
    """What the head says of N boxes.

    Attributes:
        corners: (N, C, K, 8, 2), relative to the box's centre in units of its side.
        logits: (N, C, K) of the regressors.
    """

    corners: Tensor
    logits: Tensor

    def of_class(self, classes: Tensor) -> PoseOutput:
        """The parts (N, K, 8, 2) and (N, K) of one class (N,) each."""
        rows = torch.arange(len(classes), device=classes.device)
        return PoseOutput(self.corners[rows, classes], self.logits[rows, classes])

    def chosen(self, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 8, 2) of the regressors (N,) that the classifier chooses, of outputs of one class.

        Args:
            counts: (N,) how many regressors each object has; the others do not exist.
        """
        index = existing(self.logits, counts).argmax(dim=1)
        return self.corners[torch.arange(len(index), device=index.device), index], index


class PoseHead(nn.Module):
    """Two linear maps of a box's features."""

    def __init__(self, features: int, classes: int, regressors: int) -> None:
        super().__init__()
        self.classes, self.regressors = classes, regressors
        self.corners = nn.Linear(features, classes * regressors * 16)
        self.logits = nn.Linear(features, classes * regressors)

    def forward(self, features: Tensor) -> PoseOutput:
        """From features (N, F)."""
        shape = (len(features), self.classes, self.regressors)
        return PoseOutput(self.corners(features).reshape(*shape, 8, 2), self.logits(features).reshape(shape))


def existing(logits: Tensor, counts: Tensor) -> Tensor:
    """Logits (N, K) with those of regressors that an object (N,) does not have at -inf."""
    beyond = torch.arange(logits.shape[1], device=logits.device) >= counts[:, None]
    return logits.masked_fill(beyond, -torch.inf)


def coset_loss(logits: Tensor, alike: Tensor, counts: Tensor) -> Tensor:
    """Mean of -log of the probability of all cosets that the image leaves open: none of them is punished.

    Args:
        logits: (N, k) of the cosets; with ``targets.coset_targets``.
        alike: (N, k) whether each is right.
        counts: (N,) how many cosets each object has.
    """
    if len(counts) == 0:
        return logits.sum() * 0
    log_p = functional.log_softmax(existing(logits, counts), dim=1)
    return -log_p.masked_fill(~alike, -torch.inf).logsumexp(dim=1).mean()


def pose_losses(
    output: PoseOutput, corners: Tensor, index: Tensor, counts: Tensor, weights: Tensor | None = None
) -> dict[str, Tensor]:
    """Losses of outputs of one class: L1 of the responsible regressors, and the classifier's.

    Args:
        output: (N, K, 8, 2) and (N, K).
        corners: (N, 8, 2) true corners, in box units.
        index: (N,) responsible regressors; the others get no gradient.
        counts: (N,) how many regressors each object has.
        weights: (N,) of the corners' losses; equal if None.
    """
    if len(index) == 0:  # of an image without instances: no gradient, and no NaN
        nothing = output.corners.sum() * 0
        return {"corners": nothing, "index": nothing}
    responsible = output.corners[torch.arange(len(index), device=index.device), index]
    distances = (responsible - corners).abs().mean(dim=(1, 2))
    share = torch.ones_like(distances) if weights is None else weights
    return {
        "corners": (share * distances).sum() / share.sum().clamp(min=1e-6),
        "index": INDEX_WEIGHT * functional.cross_entropy(existing(output.logits, counts), index),
    }
