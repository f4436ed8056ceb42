"""sRGB: displayed values, linear light, and luminance (IEC 61966-2-1; ITU-R BT.709 primaries)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Real = TypeVar("Real", np.float32, np.float64)

LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
"""Weights of red, green and blue."""


def srgb_from_linear(linear: NDArray[Real]) -> NDArray[Real]:
    """Displayed value of linear light, both clipped to 0..1, element by element."""
    value = np.clip(linear, 0.0, 1.0)
    result: NDArray[Real] = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return result


def linear_of_levels() -> NDArray[np.float32]:
    """(256,) linear light of the levels of an 8-bit image."""
    return np.array([linear_from_srgb(level / 255) for level in range(256)], dtype=np.float32)


def linear_from_srgb(displayed: float) -> float:
    """Linear light of a displayed value in 0..1."""
    return displayed / 12.92 if displayed <= 0.04045 else ((displayed + 0.055) / 1.055) ** 2.4
