"""From linear light to the 8-bit image of a real colour camera: optics, sensor, and what happens inside the camera.

In this order: point spread, vignetting, exposure, highlight shoulder, photon and read noise on a Bayer mosaic,
demosaicing, white balance, chroma smoothing, tone curve, sharpening, 8 bits, JPEG. No pixel is shifted: what is true of
the rendered image's geometry stays true.

With light x (1 is full scale) after the shoulder, a pixel of the mosaic has the variance x / photons + read_noise^2; in
the 8-bit image it is slope^2 (x / photons + read_noise^2) + 1/12, the slope being that of the tone curve (EMVA 1288;
Foi et al., Practical Poissonian-Gaussian noise modeling and fitting, 2008). An edge, sharp in the scene and averaged
over the pixel by the renderer, rises from 10 to 90 % over 2.563 sqrt(blur_px^2 + 1/12) pixels.

Needs NumPy and OpenCV only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.sampling import draw_sensor
from synthetless.scenes.settings import SensorSettings
from synthetless.scenes.spec import SensorSpec
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS, srgb_from_linear

Light = NDArray[np.float32]

_MAX_LIGHT = float(np.finfo(np.float16).max)
_LARGEST_STEP_PX2 = 2 / 3
"""Largest variance of a five-tap kernel; two of half of it have no negative tap either."""


def capture(
    linear: Light,
    settings: SensorSettings,
    rng: np.random.Generator,
    gain: float = 1.0,
    corner_px: tuple[int, int] = (0, 0),
    frame_px: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """Another photograph of the same light, for augmentation: ``expose`` with values drawn from the settings' ranges.

    Args:
        linear: as for ``expose``.
        settings: the ranges.
        rng: everything random follows from it.
        gain, corner_px, frame_px: as for ``expose``.
    """
    return expose(linear, draw_sensor(settings, rng), gain, corner_px, frame_px)


def expose(
    linear: Light,
    drawn: SensorSpec,
    gain: float = 1.0,
    corner_px: tuple[int, int] = (0, 0),
    frame_px: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """What a camera makes of linear light.

    Args:
        linear: (H, W, 3) linear light, Rec. 709 primaries, an image or a crop of one, at least 3 by 3 pixels. Rounded
            to half floats first, so that a stored EXR file gives the same picture.
        drawn: what the camera is like.
        gain: that the light is multiplied by before anything else.
        corner_px: column and row of a crop's first pixel in the whole image, for the vignetting.
        frame_px: width and height of the whole image; None if ``linear`` is all of it.

    Returns:
        (H, W, 3) sRGB. The same arguments give the same bytes.
    """
    light = np.minimum(np.fmax(linear, 0), _MAX_LIGHT).astype(np.float16).astype(np.float32)  # what is no number is 0
    light = blurred(light, drawn.blur_px)
    light *= _falloff(light.shape, drawn.vignetting, corner_px, frame_px) * (gain * 2.0**drawn.exposure_ev)
    rgb = demosaicked(_photographed(rolled_off(light, drawn.shoulder), drawn))
    rgb *= np.array([drawn.red_gain, 1.0, drawn.blue_gain], dtype=np.float32)
    displayed = srgb_from_linear(_chroma_smoothed(rgb, drawn.chroma_px))
    levels = np.rint(255 * np.clip(_sharpened(displayed, drawn.sharpen, drawn.sharpen_px), 0, 1)).astype(np.uint8)
    return levels if drawn.jpeg_quality is None else _through_jpeg(levels, drawn.jpeg_quality)


def gaussian_kernel(sigma_px: float) -> Light:
    """(2n + 1,) weights that blur an image of pixels, each the mean over its area, by a Gaussian.

    Sampled at the pixels, a narrow Gaussian is narrower than it says; averaged over them, wider, since the image's
    pixels are averages already. These weights have the Gaussian's mean, variance, third, fourth and fifth moment, so
    that an edge becomes as wide as it would in the scene, averaged over the pixels afterwards. Wide ones are several
    narrow ones, one after the other: moments of that order add up.
    """
    variance = sigma_px * sigma_px
    steps = max(1, math.ceil(variance / _LARGEST_STEP_PX2))
    each = variance / steps
    second = (3 * each * each - each) / 24  # sums over the taps: w k^2 = s^2, w k^4 = 3 s^4
    first = each / 2 - 4 * second
    kernel = step = np.array([second, first, 1 - 2 * (first + second), first, second])
    for _ in range(steps - 1):
        kernel = np.convolve(kernel, step)
    outside = int((np.cumsum(kernel) < 1e-6).sum()) if steps > 1 else 0
    kernel = kernel[outside : len(kernel) - outside]
    normalised: Light = (kernel / kernel.sum()).astype(np.float32)
    return normalised


def blurred(image: Light, sigma_px: float) -> Light:
    """An image (H, W) or (H, W, C), blurred by a Gaussian; at the border it goes on as the last pixel is."""
    if sigma_px == 0:
        return image
    kernel = gaussian_kernel(sigma_px)
    smooth: Light = np.asarray(cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE))
    return smooth


def _falloff(
    shape: tuple[int, ...], vignetting: float, corner_px: tuple[int, int], frame_px: tuple[int, int] | None
) -> Light:
    """(H, W, 1) share of the light that reaches each pixel: less with the square of the distance from the centre."""
    height, width = shape[:2]
    across, down = frame_px or (width, height)
    x = (np.arange(width) + corner_px[0] - (across - 1) / 2) ** 2
    y = (np.arange(height) + corner_px[1] - (down - 1) / 2) ** 2
    farthest = ((across - 1) ** 2 + (down - 1) ** 2) / 4
    left: Light = (1 - vignetting / farthest * (x[None, :] + y[:, None]))[..., None].astype(np.float32)
    return left


def rolled_off(light: Light, shoulder: float) -> Light:
    """Highlights above 1 - shoulder bent, without a kink, so that they near full scale but do not reach it.

    A shoulder of 0 cuts them off at full scale, 1.
    """
    bent: Light = np.minimum(light, 1 - shoulder)
    if shoulder > 0:
        bent = bent + shoulder * (1 - np.exp((bent - light) / shoulder))
    return bent


def _photographed(light: Light, drawn: SensorSpec) -> Light:
    """(H, W) signal of a sensor whose pixels see one colour each: red and green, below them green and blue."""
    rng = np.random.default_rng(drawn.noise_seed)
    mosaic = light[..., 1].copy()
    mosaic[::2, ::2] = light[::2, ::2, 0]
    mosaic[1::2, 1::2] = light[1::2, 1::2, 2]
    expected = np.maximum(mosaic, 0).astype(np.float64) * drawn.photons  # beside a glare, narrow blurs fall below 0
    counted = rng.poisson(expected) / drawn.photons
    read = np.float32(drawn.read_noise) * rng.standard_normal(mosaic.shape, dtype=np.float32)
    signal: Light = np.minimum(counted.astype(np.float32) + read, 1)
    return signal


def _kernel(neighbours: list[list[float]], curvature: list[list[float]], gain: float) -> Light:
    """(5, 5) mean of the neighbours that see a colour, plus a gain times the curvature of the one the pixel sees."""
    kernel: Light = (np.array(neighbours) / np.sum(neighbours) + gain * np.array(curvature)).astype(np.float32)
    return kernel


# Malvar, He and Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images, ICASSP 2004.
# Their gains, 1/2, 5/8 and 3/4, sharpen grey edges; with 1/4, 5/12 and 1/2, second moments would stay as they are, but
# narrow edges be widened. With these, edges blurred by 1 px or more are as wide as they should be, to 1 %.
_CROSS = _kernel(
    [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]],
    [[0, 0, -0.25, 0, 0], [0, 0, 0, 0, 0], [-0.25, 0, 1, 0, -0.25], [0, 0, 0, 0, 0], [0, 0, -0.25, 0, 0]],
    gain=0.35,
)
_ALONG = _kernel(
    [[0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 0]],
    [[0, 0, 0.1, 0, 0], [0, -0.2, 0, -0.2, 0], [-0.2, 0, 1, 0, -0.2], [0, -0.2, 0, -0.2, 0], [0, 0, 0.1, 0, 0]],
    gain=0.5,
)
_DIAGONAL = _kernel(
    [[0, 0, 0, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 0]],
    [[0, 0, -0.25, 0, 0], [0, 0, 0, 0, 0], [-0.25, 0, 1, 0, -0.25], [0, 0, 0, 0, 0], [0, 0, -0.25, 0, 0]],
    gain=0.6,
)


def demosaicked(mosaic: Light) -> Light:
    """(H, W, 3) of a mosaic (H, W) that begins with red and green, below them green and blue."""
    cross, along, across, diagonal = (
        np.asarray(cv2.filter2D(mosaic, -1, kernel, borderType=cv2.BORDER_REFLECT_101))
        for kernel in (_CROSS, _ALONG, _ALONG.T, _DIAGONAL)
    )
    rgb = np.empty((*mosaic.shape, 3), dtype=np.float32)
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    red[...] = green[...] = blue[...] = mosaic
    green[::2, ::2], green[1::2, 1::2] = cross[::2, ::2], cross[1::2, 1::2]
    red[::2, 1::2], red[1::2, ::2], red[1::2, 1::2] = along[::2, 1::2], across[1::2, ::2], diagonal[1::2, 1::2]
    blue[::2, 1::2], blue[1::2, ::2], blue[::2, ::2] = across[::2, 1::2], along[1::2, ::2], diagonal[::2, ::2]
    return rgb


def _chroma_smoothed(rgb: Light, sigma_px: float) -> Light:
    """Colour differences from the luminance, blurred; the luminance stays as sharp as it is."""
    if sigma_px == 0:
        return rgb
    luminance: Light = (rgb @ LUMINANCE_WEIGHTS)[..., None]
    return luminance + blurred(rgb - luminance, sigma_px)


def _sharpened(displayed: Light, amount: float, sigma_px: float) -> Light:
    """Unsharp masking of the luminance, as cameras do it, on displayed values."""
    if amount == 0:
        return displayed
    luminance = displayed @ LUMINANCE_WEIGHTS
    sharp: Light = displayed + amount * (luminance - blurred(luminance, sigma_px))[..., None]
    return sharp


def _through_jpeg(rgb: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    _, encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1], dtype=np.uint8)
