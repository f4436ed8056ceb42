"""What a lens makes of a rendered picture: a pinhole's render, larger than the frame, is resampled to bent pixels.

The render has the focal length at which it is nowhere coarser than the picture; where the lens shrinks, it is finer.
Taken through the lens by the renderer itself, a picture would have the renderer's pixel filter everywhere, of the
variance s^2. The render has had that filter, but in its own, smaller pixels: s^2 J J^T / f^2 in those of the picture,
with the lens's Jacobian J and the render's focal length f over the picture's. What is lacking is averaged here, over
nine samples at the places of a Gaussian quadrature, and no more: where both are equally fine, nothing is blurred.

Needs NumPy and OpenCV only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.lens import jacobian, pinhole_around, straight_points
from synthetless.scenes.spec import Intrinsics

Light = NDArray[np.float32]

_FILTER_VARIANCE_PX2 = 0.0432
"""Of Cycles' pixel filter, a Blackman-Harris window 1.5 pixels wide."""
_NODES = ((-math.sqrt(3), 1 / 6), (0.0, 2 / 3), (math.sqrt(3), 1 / 6))
"""Gauss and Hermite's quadrature of three nodes: exact for the first five moments of a normal distribution."""


def warped(render: Light, camera: Intrinsics) -> Light:
    """The picture that a camera takes.

    Args:
        render: (h, w, 3) linear light, as ``pinhole_around(camera)`` sees it.
        camera: with a lens.

    Returns:
        (H, W, 3), nowhere brighter or darker than the pixels around.
    """
    samples = _samples(camera)
    picture = np.zeros((camera.height, camera.width, render.shape[2]), dtype=np.float32)
    for i, weight_i in _NODES:
        for j, weight_j in _NODES:
            x, y = samples.centre + np.float32(i) * samples.first + np.float32(j) * samples.second
            sample = cv2.remap(render, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            picture += np.float32(weight_i * weight_j) * sample
    around = np.ones((samples.around_px, samples.around_px), np.uint8)
    x, y = samples.centre
    low, high = (
        cv2.remap(of(render, around), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        for of in (cv2.erode, cv2.dilate)
    )
    limited: Light = np.clip(picture, low, high)
    return limited


@dataclass(frozen=True, eq=False)
class _Samples:
    """Where in the render the pixels of the picture are sampled.

    Attributes:
        centre: (2, H, W) columns and rows of the pixels' centres.
        first, second: (2, H, W) from there to samples one standard deviation away.
        around_px: side of a square of the render that holds a pixel's samples and what they are interpolated from.
    """

    centre: Light
    first: Light
    second: Light
    around_px: int


@lru_cache(maxsize=1)
def _samples(camera: Intrinsics) -> _Samples:
    pinhole, straight = pinhole_around(camera), straight_points(camera)
    centre = straight * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    # In pixels of the render: the picture's filter is s^2 A A^T there, with A the inverse Jacobian times the focal
    # lengths' ratio f; the render's own is s^2. Both are isotropic up to fx / fy, which is 1 in all but odd cameras.
    a, b, c = jacobian(straight, camera.distortion)
    scale = pinhole.fx / camera.fx
    inverse = scale * np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2) / (a * c - b * b)[..., None, None]
    values, vectors = np.linalg.eigh(inverse)
    lacking = np.sqrt(np.maximum(_FILTER_VARIANCE_PX2 * (values * values - 1), 0))
    first, second = np.moveaxis(vectors * lacking[..., None, :], -1, 0)
    reach_px = 1 + math.ceil(_NODES[-1][0] * float(lacking.max()) * math.sqrt(2))
    return _Samples(_planes(centre), _planes(first), _planes(second), 2 * reach_px + 1)


def _planes(places: NDArray[np.float64]) -> Light:
    """(2, H, W) of (H, W, 2)."""
    return np.ascontiguousarray(np.moveaxis(places, -1, 0), dtype=np.float32)
