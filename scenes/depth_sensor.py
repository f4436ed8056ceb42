"""From exact depth to that of a depth camera: what its projector reaches, its noise, its steps.

In this order: pixels without a return, lateral noise, axial noise, quantisation, range.

* A pixel has a return if nothing is between its surface and the projector, if the surface is not seen at more than
  ``grazing_deg`` from its normal, and if it is bright enough: its albedo times the cosine of that angle, times a
  speckle of the standard deviation ``speckle``, must reach ``dark``.
* Lateral noise: a pixel has the depth of a place ``lateral_px`` (standard deviation) beside it: of the nearest pixel,
  or, if edges are ``mixed``, interpolated, so that there are points between an edge and what is behind it.
* Axial noise, with the depth z in metres and the angle a between ray and normal in radians, in millimetres:
  noise + growth max(z - from, 0)^order + tilt / sqrt(z) (a / (pi/2 - a))^2.
  For structured light this is Nguyen, Izadi and Lovell, Modeling Kinect sensor noise for improved 3D reconstruction and
  tracking, 3DIMPVT 2012: 1.2 + 1.9 (z - 0.4)^2 and 0.1 of tilt, and 0.8 pixels beside. The preset for time of flight
  grows linearly, by 1 mm a metre from 0.5 m on, with 0.25 pixels beside, as BlenderProc has it for the Azure Kinect.
* Quantisation: structured light measures the disparity d = f b / z, with the baseline b of the projector, in steps;
  z has steps of z^2 step / (f b). Over a step the variance of the rounded depth is that of the noise plus 1/12 of the
  step's square.

Needs NumPy and OpenCV only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.spec import DepthSensorSpec, Intrinsics

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_MM = 1000.0
_MOST_TILT_RAD = math.radians(89.0)


@dataclass(frozen=True, eq=False)
class Returns:
    """What a depth camera looks at.

    Attributes:
        depth_mm: (H, W) exact z, 0 where there is no surface.
        lit: (H, W) whether nothing is between the surface and the projector.
        cosine: (H, W) of the angle between the viewing ray and the surface's normal.
        albedo: (H, W) share of the light that the surface scatters.
    """

    depth_mm: Floats
    lit: NDArray[np.bool_]
    cosine: Image
    albedo: Image


def sense(seen: Returns, camera: Intrinsics, drawn: DepthSensorSpec) -> Floats:
    """What a depth camera measures.

    Args:
        seen: what it looks at.
        camera: its intrinsics.
        drawn: what it is like.

    Returns:
        (H, W) z in millimetres, 0 where it has no depth. The same arguments give the same numbers.
    """
    shape = seen.depth_mm.shape
    noise = [np.random.default_rng([drawn.noise_seed, purpose]) for purpose in range(3)]
    tilt = np.arccos(np.clip(seen.cosine, 0, 1))
    returned = seen.lit & (seen.depth_mm > 0) & (tilt <= math.radians(drawn.grazing_deg))
    speckle = 1 + drawn.speckle * noise[0].standard_normal(shape, dtype=np.float32)
    returned &= seen.albedo * seen.cosine * speckle >= drawn.dark
    z, tilt = _beside(np.where(returned, seen.depth_mm, 0).astype(np.float32), tilt, drawn, noise[1])
    there = z > 0
    measured = np.zeros(shape)
    sigma = axial_noise_mm(z[there], tilt[there], drawn)
    measured[there] = z[there] + sigma * noise[2].standard_normal(sigma.shape, dtype=np.float32)
    measured = _in_steps(measured, camera, drawn)
    low, high = drawn.range_m[0] * _MM, drawn.range_m[1] * _MM
    return np.where((measured >= low) & (measured <= high), measured, 0.0)


def axial_noise_mm(z_mm: Image, tilt_rad: Image, drawn: DepthSensorSpec) -> Image:
    """Standard deviation of the axial noise, at depths z > 0 of surfaces that are tilted by an angle to the ray."""
    z = z_mm / np.float32(_MM)
    tilt = np.minimum(tilt_rad, np.float32(_MOST_TILT_RAD))
    turned = (tilt / (np.float32(np.pi / 2) - tilt)) ** 2
    growth = np.maximum(z - np.float32(drawn.noise_from_m), 0) ** drawn.noise_order
    sigma: Image = drawn.noise_mm + drawn.noise_growth_mm * growth + drawn.noise_tilt_mm / np.sqrt(z) * turned
    return sigma.astype(np.float32)


def step_mm(z_mm: Floats, camera: Intrinsics, drawn: DepthSensorSpec) -> Floats:
    """By how much a measured depth differs from the next one that is possible."""
    if drawn.disparity_step_px == 0 or drawn.baseline_m == 0:
        return np.full_like(z_mm, drawn.step_mm)
    return z_mm * z_mm * drawn.disparity_step_px / (camera.fx * abs(drawn.baseline_m) * _MM)


def _beside(depth: Image, tilt: Image, drawn: DepthSensorSpec, rng: np.random.Generator) -> tuple[Image, Image]:
    """Depth and tilt of places beside the pixels."""
    if drawn.lateral_px == 0:
        return depth, tilt
    height, width = depth.shape
    x, y = np.float32(drawn.lateral_px) * rng.standard_normal((2, height, width), dtype=np.float32)
    x += np.arange(width, dtype=np.float32)
    y += np.arange(height, dtype=np.float32)[:, None]
    nearest = [cv2.remap(image, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) for image in (depth, tilt)]
    if drawn.edges == "mixed":
        between = cv2.remap(depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        whole = cv2.remap((depth > 0).astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        nearest[0] = np.where(whole > 0.999, between, nearest[0])
    return np.asarray(nearest[0]), np.asarray(nearest[1])


def _in_steps(depth_mm: Floats, camera: Intrinsics, drawn: DepthSensorSpec) -> Floats:
    there = depth_mm > 0
    if drawn.disparity_step_px > 0 and drawn.baseline_m != 0:
        scale = camera.fx * abs(drawn.baseline_m) * _MM / drawn.disparity_step_px
        steps = np.maximum(np.rint(scale / np.where(there, depth_mm, 1.0)), 1.0)
        return np.where(there, scale / steps, 0.0)
    return depth_mm if drawn.step_mm == 0 else np.rint(depth_mm / drawn.step_mm) * drawn.step_mm
