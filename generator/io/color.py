"""From the renderer's linear light to the 8-bit image that is stored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.color import LUMINANCE, srgb
from synthetless.scenes.sensor import expose
from synthetless.scenes.spec import SensorSpec

_GAIN_STEPS = 24


def exposure_gain(linear: NDArray[np.float32], bounds: tuple[float, float]) -> float:
    """The gain nearest to 1 that brings an image's mean displayed luminance within bounds.

    Args:
        linear: (H, W, 3) linear light, Rec. 709 primaries.
        bounds: smallest and largest mean, of displayed values in 0..1.

    Returns:
        1 where the image is within bounds as it is, or where it is black.
    """
    luminance = np.maximum(linear @ LUMINANCE, 0.0)
    mean = float(srgb(luminance).mean())
    target = min(max(mean, bounds[0]), bounds[1])
    if mean in (target, 0.0):
        return 1.0
    low, high = (-20.0, 0.0) if mean > target else (0.0, 20.0)  # in stops; the mean rises with the gain
    for _ in range(_GAIN_STEPS):
        middle = (low + high) / 2
        if float(srgb(luminance * np.float32(2.0**middle)).mean()) < target:
            low = middle
        else:
            high = middle
    return float(2.0**high)


def tonemap(linear: NDArray[np.float32], gain: float) -> NDArray[np.uint8]:
    """(H, W, 3) linear light, times a gain, as 8-bit sRGB."""
    displayed: NDArray[np.uint8] = np.rint(srgb(linear * np.float32(gain)) * 255).astype(np.uint8)
    return displayed


def picture(linear: NDArray[np.float32], gain: float, sensor: SensorSpec | None) -> NDArray[np.uint8]:
    """The image that is stored: as a camera takes it, or, without one, the plain tone mapping."""
    return tonemap(linear, gain) if sensor is None else expose(linear, sensor, gain)
