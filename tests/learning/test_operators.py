"""The detector's operators agree with slow loops that follow their definitions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from packages import package_or_skip

torch = package_or_skip("torch", "extra 'learn' has it")

from synthetless.learning import operators  # noqa: E402


def _boxes(n: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 80, (n, 2))
    return torch.from_numpy(np.concatenate([low, low + rng.uniform(1, 40, (n, 2))], axis=1)).float()


def _slow_iou(a: Any, b: Any) -> float:
    w = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    h = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - w * h
    return float(w * h / union)


def test_iou() -> None:
    a, b = _boxes(20, 0), _boxes(30, 1)
    slow = torch.tensor([[_slow_iou(p, q) for q in b] for p in a])
    assert torch.allclose(operators.iou(a, b), slow, atol=1e-6)
    assert operators.iou(a[:0], b).shape == (0, 30)


@pytest.mark.parametrize("threshold", [0.1, 0.3, 0.7])
def test_nms(threshold: float) -> None:
    boxes = _boxes(60, 2)
    scores = torch.from_numpy(np.random.default_rng(3).permutation(60) / 60)
    left, kept = sorted(range(60), key=lambda i: -scores[i]), []
    while left:
        best = left.pop(0)
        kept.append(best)
        left = [i for i in left if _slow_iou(boxes[best], boxes[i]) <= threshold]
    assert operators.nms(boxes, scores, threshold).tolist() == kept
    assert 1 < len(kept) < 60


def test_nms_by_class_keeps_what_another_class_covers() -> None:
    boxes, scores = torch.tensor([[0.0, 0, 10, 10]] * 3), torch.tensor([0.5, 0.9, 0.7])
    assert operators.nms_by_class(boxes, scores, torch.tensor([0, 1, 0]), 0.5).tolist() == [1, 2]
    assert operators.nms_by_class(boxes[:0], scores[:0], torch.zeros(0), 0.5).tolist() == []


def _slow_roi_align(features: Any, box: Any, size: int, stride: int, samples: int) -> Any:
    """Sample by sample, with plain bilinear interpolation between the centres of cells."""
    _, height, width = features.shape
    result = np.zeros((features.shape[0], size, size))
    for row in range(size):
        for column in range(size):
            for k in range(samples * samples):
                fy, fx = (row + (k // samples + 0.5) / samples) / size, (column + (k % samples + 0.5) / samples) / size
                x = (box[0] + fx * (box[2] - box[0]) + 0.5) / stride - 0.5
                y = (box[1] + fy * (box[3] - box[1]) + 0.5) / stride - 0.5
                x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
                i, j = min(int(x), width - 2), min(int(y), height - 2)
                u, v = x - i, y - j
                cell = (1 - v) * ((1 - u) * features[:, j, i] + u * features[:, j, i + 1])
                cell += v * ((1 - u) * features[:, j + 1, i] + u * features[:, j + 1, i + 1])
                result[:, row, column] += cell / samples**2
    return result


@pytest.mark.parametrize(("size", "samples"), [(1, 1), (3, 2), (7, 2)])
def test_roi_align(size: int, samples: int) -> None:
    rng = np.random.default_rng(5)
    features = rng.standard_normal((2, 5, 9, 12))
    boxes = torch.tensor([[3.0, 5, 60, 40], [-9, -9, 20, 30], [50, 40, 120, 90], [8, 8, 9, 9]], dtype=torch.float64)
    images = torch.tensor([0, 1, 1, 0])
    pooled = operators.roi_align(torch.from_numpy(features), boxes, images, size, 8, samples).numpy()
    for i in range(4):
        slow = _slow_roi_align(features[images[i]], boxes[i].tolist(), size, 8, samples)
        assert np.allclose(pooled[i], slow, atol=1e-9)


def test_roi_align_lets_gradients_through() -> None:
    features = torch.randn(1, 2, 6, 6, dtype=torch.float64, requires_grad=True)
    boxes, images = torch.tensor([[4.0, 4, 30, 30]], dtype=torch.float64), torch.tensor([0])
    assert torch.autograd.gradcheck(lambda f: operators.roi_align(f, boxes, images, 2, 8), (features,))


def test_boxes_survive_being_coded() -> None:
    boxes, references = _boxes(40, 6), _boxes(40, 7)
    back = operators.decode_boxes(operators.encode_boxes(boxes, references), references)
    assert torch.allclose(back, boxes, atol=1e-3)
    assert torch.isfinite(operators.decode_boxes(torch.full((1, 4), 1e6), references[:1])[:, :2]).all()
