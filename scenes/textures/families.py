"""The built-in texture families by name, and the one way to an image of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS
from synthetless.scenes.textures import masonry, natural, prints, textiles
from synthetless.scenes.textures.colour import Image

Painter = Callable[[np.random.Generator, int], Image]

PAINTERS: dict[str, Painter] = {
    painter.__name__: painter
    for painter in (
        natural.wood_grain,
        natural.wood_planks,
        natural.cork,
        natural.cardboard,
        natural.leather,
        natural.marble,
        natural.granite,
        natural.terrazzo,
        natural.concrete,
        natural.gravel,
        natural.brushed_metal,
        natural.tread_plate,
        natural.peeling_paint,
        masonry.tiles,
        masonry.bricks,
        masonry.hexagon_tiles,
        masonry.mosaic,
        textiles.woven_fabric,
        textiles.carpet,
        prints.clouds,
        prints.contours,
        prints.camouflage,
        prints.stripes,
        prints.checks,
        prints.shapes,
        prints.scribbles,
        prints.lettering,
    )
}

FAMILIES: tuple[str, ...] = tuple(PAINTERS)

LUMINANCE = (0.12, 0.8)  # of the mean colour, sRGB in 0..1: no plane swallows or drowns the light
CONTRAST = 0.045  # least root mean square deviation from the mean colour


def paint(family: str, seed: int, size_px: int) -> NDArray[np.uint8]:
    """(size_px, size_px, 3) sRGB image of a family, a function of the arguments alone."""
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    image = _graded(PAINTERS[family](rng, size_px))
    return np.ascontiguousarray(np.round(255 * image), np.uint8)


def _graded(image: Image) -> Image:
    """The image in 0..1, with mean luminance and contrast brought into range where they are outside."""
    image = np.asarray(np.clip(image, 0, 1), np.float32)
    luminance = float(LUMINANCE_WEIGHTS @ cv2.mean(image)[:3])
    wanted = min(max(luminance, LUMINANCE[0]), LUMINANCE[1])
    if wanted != luminance:
        image = image ** np.float32(np.log(wanted) / np.log(np.clip(luminance, 1e-3, 0.999)))
    mean, deviation = (statistic.ravel() for statistic in cv2.meanStdDev(image))
    contrast = max(float(np.sqrt(np.mean(deviation**2))), 1e-3)
    if contrast < CONTRAST:
        image = np.clip(mean + (image - mean) * (CONTRAST / contrast), 0, 1)
    return np.asarray(image, np.float32)
