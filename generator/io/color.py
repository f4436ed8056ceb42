"""From the renderer's linear light to the 8-bit image that is stored, and how bright that is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.sensor import expose, rolled_off
from synthetless.scenes.spec import SensorSpec
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS, linear_of_levels, srgb_from_linear

_GAIN_STEPS = 24


def exposure_gain(linear: NDArray[np.float32], bounds: tuple[float, float]) -> float:
    """The gain nearest to 1 that brings an image's mean displayed luminance within bounds.

    Args:
        linear: (H, W, 3) linear light, Rec. 709 primaries.
        bounds: smallest and largest mean, of displayed values in 0..1.

    Returns:
        1 where the image is within bounds as it is, or where it is black.
    """
    luminance = np.maximum(linear @ LUMINANCE_WEIGHTS, 0.0)
    mean = float(srgb_from_linear(luminance).mean())
    target = min(max(mean, bounds[0]), bounds[1])
    if mean in (target, 0.0):
        return 1.0
    low, high = (-20.0, 0.0) if mean > target else (0.0, 20.0)  # in stops; the mean rises with the gain
    for _ in range(_GAIN_STEPS):
        middle = (low + high) / 2
        if float(srgb_from_linear(luminance * np.float32(2.0**middle)).mean()) < target:
            low = middle
        else:
            high = middle
    return float(2.0**high)


def tonemap(linear: NDArray[np.float32], gain: float) -> NDArray[np.uint8]:
    """(H, W, 3) linear light, times a gain, as 8-bit sRGB."""
    displayed: NDArray[np.uint8] = np.rint(srgb_from_linear(linear * np.float32(gain)) * 255).astype(np.uint8)
    return displayed


def picture(
    linear: NDArray[np.float32], gain: float, sensor: SensorSpec | None, shoulder: float = 0.0
) -> NDArray[np.uint8]:
    """The image that is stored: as a camera takes it, or, without one, the plain tone mapping, after a shoulder."""
    if sensor is not None:
        return expose(linear, sensor, gain)
    return tonemap(rolled_off(linear * np.float32(gain), shoulder), 1.0) if shoulder else tonemap(linear, gain)


def mean_luminance(rgb: NDArray[np.uint8]) -> float:
    """Mean displayed luminance, 0..1, of an (H, W, 3) sRGB image: what a recipe's render.exposure bounds."""
    return float(srgb_from_linear(linear_of_levels()[rgb] @ LUMINANCE_WEIGHTS).mean())
