"""Random colours, and painting with them. Images are (size, size, 3) float32, sRGB in 0..1."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.extras import cv2
from synthetless.scenes.textures.noise import Field

Image = NDArray[np.float32]  # (size, size, 3)
Colours = NDArray[np.float32]  # (n, 3)
Range = tuple[float, float]


def from_lch(lightness: ArrayLike, chroma: ArrayLike, hue_deg: ArrayLike) -> Colours:
    """(n, 3) sRGB of CIE LCh colours: lightness 0..100, chroma 0 (grey) to about 100, hue in degrees."""
    lightness, chroma, hue = np.broadcast_arrays(lightness, chroma, np.deg2rad(hue_deg))
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    rgb = cv2.cvtColor(lab.reshape(1, -1, 3).astype(np.float32), cv2.COLOR_Lab2RGB)
    return np.asarray(np.clip(rgb[0], 0, 1), np.float32)


def palette(rng: np.random.Generator, n: int, lightness: Range = (12, 92), chroma: float = 95) -> Colours:
    """n colours that differ in lightness, of a random harmony (few hues or many) and a random vividness."""
    # equal steps of hue hold few reds and yellows, which most surfaces around us have
    first = rng.uniform(10, 100) if rng.random() < 0.45 else rng.uniform(0, 360)
    centres = first + np.array([0, rng.choice([25, 120, 180]), rng.choice([-25, 150, 240])])
    hues = rng.choice(centres, n) + rng.normal(0, rng.choice([6, 20, 90]), n)
    steps = (rng.permutation(n) + rng.uniform(0, 1, n)) / n
    lightnesses = lightness[0] + (lightness[1] - lightness[0]) * steps
    return from_lch(lightnesses, chroma * rng.uniform(0.1, 1) * rng.uniform(0.5, 1, n), hues)


def tones(
    rng: np.random.Generator, n: int, lightness: Range, chroma: Range, hue_deg: Range, dyed: float = 0.2
) -> Colours:
    """n colours of one material, dark to light; with probability `dyed` the hue is any and the chroma higher."""
    hue, strength = rng.uniform(*hue_deg), rng.uniform(*chroma)
    if rng.random() < dyed:
        hue, strength = rng.uniform(0, 360), rng.uniform(10, 60)
    ends = np.sort(rng.uniform(*lightness, 2))
    spread = max(ends[1] - ends[0], 0.5 * (lightness[1] - lightness[0]))
    start = min(ends[0], lightness[1] - spread)
    return from_lch(
        start + spread * np.linspace(0, 1, n),
        strength * rng.uniform(0.8, 1.2, n),
        hue + rng.normal(0, 5, n),
    )


def ramp(values: Field, colours: Colours) -> Image:
    """The colour gradient through `colours`, looked up with values in 0..1."""
    steps = 1023
    position = np.linspace(0, len(colours) - 1, steps + 1)
    table = np.stack([np.interp(position, np.arange(len(colours)), channel) for channel in colours.T], axis=-1)
    index = np.clip(values * steps, 0, steps).astype(np.int32)
    return np.asarray(table.astype(np.float32)[index])


def mix(below: ArrayLike, above: ArrayLike, cover: Field) -> Image:
    """`above` painted over `below` (images or single colours) where cover is 1."""
    below, above = np.asarray(below, np.float32), np.asarray(above, np.float32)
    return np.asarray(below + (above - below) * cover[..., None], np.float32)


def lit(image: Image, height: Field, depth: float, rng: np.random.Generator) -> Image:
    """The image with the light and shade that a relief would have under one lamp, as photographs do.

    height in tile sides times `depth`; the lamp's direction is random.
    """
    size = len(height)
    angle = rng.uniform(0, 2 * np.pi)
    du = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) * (size / 2)
    dv = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) * (size / 2)
    slope = depth * (du * np.cos(angle) + dv * np.sin(angle))
    return np.asarray(image * (1 + 0.55 * np.tanh(slope))[..., None], np.float32)
