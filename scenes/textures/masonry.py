"""Painters of laid surfaces: tiles, bricks, hexagons, mosaic.

A painter takes a random generator and a size in pixels and returns a seamless (size, size, 3) sRGB image in 0..1.
"""

from __future__ import annotations

import numpy as np

from synthetless.scenes.textures.colour import Image, from_lch, lit, mix, palette, ramp, tones
from synthetless.scenes.textures.layouts import Cells, courses, herringbone, hexagons, shuffled, voronoi
from synthetless.scenes.textures.noise import Field, blur, coordinates, normalised, smoothstep, spectral_noise


def tiles(rng: np.random.Generator, size: int) -> Image:
    """Square or oblong ceramic tiles: one colour, chequered or mixed."""
    u, v = coordinates(rng, size)
    rows = 2 * int(rng.integers(1, 7))
    columns = int(rng.choice([rows, rows, max(2, rows // 2)]))
    shift = rng.choice([0, 0, 0.5])
    cells = courses(u, v, rows, columns, np.arange(rows) % 2 * shift)
    colours = palette(rng, int(rng.integers(2, 6)), lightness=(20, 94), chroma=60)
    cell = np.arange(cells.count)
    style = rng.choice(["plain", "chequered", "mixed"], p=[0.4, 0.3, 0.3])
    if style == "plain":
        picked = np.zeros(cells.count, int)
    elif style == "chequered":
        picked = (cell // columns + (cell % columns if shift == 0 and columns % 2 == 0 else 0)) % 2
    else:
        picked = rng.integers(len(colours), size=cells.count)
    glazed = colours[picked][cells.labels] * _glaze(rng, size, cells)[..., None]
    return _grouted(rng, size, cells, glazed, rng.uniform(0.003, 0.012))


def bricks(rng: np.random.Generator, size: int) -> Image:
    """Fired bricks or pavers in running bond, stacked or in herringbone, rough and uneven."""
    u, v = coordinates(rng, size)
    wave = [0.0015 * spectral_noise(rng, size, slope=1, low=5, high=80) for _ in range(2)]
    u, v = u + wave[0], v + wave[1]
    if rng.random() < 0.25:
        cells, _ = herringbone(u, v, int(rng.integers(1, 4)), 2)
    else:
        rows = 2 * int(rng.integers(3, 9))
        cells = courses(
            u, v, rows, max(2, round(rows / rng.uniform(2, 4))), np.arange(rows) % 2 * rng.choice([0.5, 0.25, 0])
        )
    clay = tones(rng, 4, lightness=(22, 75), chroma=(15, 48), hue_deg=(35, 65))
    rough = shuffled(rng, spectral_noise(rng, size, slope=0.9, low=4), cells)
    brick = rng.normal(0.5, rng.uniform(0.08, 0.3), cells.count).astype(np.float32)[cells.labels]
    laid = _grouted(rng, size, cells, ramp(np.clip(brick + 0.1 * rough, 0, 1), clay), rng.uniform(0.006, 0.018))
    return lit(laid, blur(rough, 0.001), 0.0015, rng)


def hexagon_tiles(rng: np.random.Generator, size: int) -> Image:
    """Hexagonal tiles in a random mix, sometimes with an inlaid ring."""
    cells = hexagons(*coordinates(rng, size), int(rng.integers(4, 20)))
    colours = palette(rng, int(rng.integers(2, 6)), lightness=(18, 94))
    share = rng.dirichlet(np.full(len(colours), 0.8))
    image = colours[rng.choice(len(colours), cells.count, p=share)][cells.labels]
    if rng.random() < 0.4:
        radius, width = rng.uniform(0.3, 0.7), rng.uniform(0.05, 0.25)
        depth = cells.edge / cells.edge.max()
        ring = smoothstep(width, width - 0.04, np.abs(depth - radius))
        image = mix(image, colours[0], ring)
    glazed = image * _glaze(rng, size, cells)[..., None]
    return _grouted(rng, size, cells, glazed, rng.uniform(0.002, 0.01))


def mosaic(rng: np.random.Generator, size: int) -> Image:
    """Broken pieces set in patches of colour."""
    cells = voronoi(rng, size, int(rng.integers(8, 36)))
    colours = palette(rng, int(rng.integers(3, 8)))
    patches = normalised(spectral_noise(rng, size, slope=2, high=rng.uniform(2, 12)))
    wanted = np.zeros(cells.count, np.float32)
    wanted[cells.labels.ravel()] = patches.ravel()  # any pixel of a piece decides for the piece
    picked = (wanted + rng.normal(0, 0.15, cells.count)).clip(0, 0.999) * len(colours)
    pieces = colours[picked.astype(int)][cells.labels] * _glaze(rng, size, cells)[..., None]
    return _grouted(rng, size, cells, pieces, rng.uniform(0.004, 0.012))


def _grouted(rng: np.random.Generator, size: int, cells: Cells, pieces: Image, gap: float) -> Image:
    """Pieces with a grout of random grey between them and rounded, lit edges; gap in tile sides."""
    grout = from_lch(rng.uniform(10, 85), rng.uniform(0, 12), rng.uniform(40, 110))
    sand = 1 + 0.08 * spectral_noise(rng, size, slope=0.3, low=30)
    cover = smoothstep(gap / 2 - 0.7 / size, gap / 2 + 0.7 / size, cells.edge)
    rounded = smoothstep(gap / 2, gap / 2 + rng.uniform(0.002, 0.008), cells.edge)
    return lit(mix(grout * sand[..., None], pieces, cover), rounded, 0.003, rng)


def _glaze(rng: np.random.Generator, size: int, cells: Cells) -> Field:
    """Brightness of fired or cut pieces: each its own tone, plain, cloudy or veined inside."""
    tone = rng.normal(1, rng.uniform(0.01, 0.1), cells.count).astype(np.float32)[cells.labels]
    clouds = shuffled(rng, spectral_noise(rng, size, slope=rng.uniform(0.8, 1.8)), cells)
    return np.asarray(tone + rng.choice([0.015, 0.06, 0.12]) * clouds, np.float32)
