"""Displayed values of linear light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
"""Weights of linear red, green and blue, Rec. 709."""


def srgb(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """Displayed value of linear light, both clipped to 0..1 (IEC 61966-2-1)."""
    value = np.clip(linear, 0.0, 1.0)
    displayed: NDArray[np.float32] = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return displayed
