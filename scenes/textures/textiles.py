"""Painters of fabric and carpet.

A painter takes a random generator and a size in pixels and returns a seamless (size, size, 3) sRGB image in 0..1.
"""

from __future__ import annotations

import numpy as np

from synthetless.scenes.textures.colour import Colours, Image, lit, palette
from synthetless.scenes.textures.layouts import voronoi
from synthetless.scenes.textures.noise import blur, coordinates, spectral_noise
from synthetless.scenes.textures.prints import camouflage, checks, clouds, contours, stripes


def woven_fabric(rng: np.random.Generator, size: int) -> Image:
    """Plain, twill or basket weave of coloured yarn: canvas, denim, tartan."""
    u, v = coordinates(rng, size)
    threads = int(rng.choice([48, 64, 96, 128]))
    slub = [0.12 / threads * spectral_noise(rng, size, slope=1, low=3, high=60) for _ in range(2)]
    x, y = (u + slub[0]) * threads, (v + slub[1]) * threads
    i, j = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    over_rules = {
        "plain": (i + j) % 2 == 0,
        "twill": (i + j) % 4 < 2,
        "satin": (i + 3 * j) % 8 < 6,
        "basket": (i // 2 + j // 2) % 2 == 0,
    }
    over = over_rules[str(rng.choice(list(over_rules)))]
    yarns = palette(rng, int(rng.integers(2, 5)))
    warp_yarn = _thread_colours(rng, threads, yarns)[i % threads]
    weft_yarn = _thread_colours(rng, threads, yarns)[j % threads]
    across = np.where(over, x - i, y - j)
    profile = np.sin(np.pi * across) ** rng.uniform(0.4, 1)
    fuzz = spectral_noise(rng, size, slope=0.4, low=20)
    shade = (1 - rng.uniform(0.25, 0.6) * (1 - profile)) * (1 + 0.08 * fuzz)
    return np.asarray(np.where(over[..., None], warp_yarn, weft_yarn) * shade[..., None], np.float32)


def carpet(rng: np.random.Generator, size: int) -> Image:
    """Tufts of pile, dyed plain or after a printed design."""
    cells = voronoi(rng, size, int(rng.integers(60, 110)), wobble=0.3)
    designs = (clouds, stripes, checks, contours, camouflage)
    yarns = palette(rng, 3)
    if rng.random() < 0.5:
        tufts = yarns[rng.choice(3, cells.count, p=rng.dirichlet(np.full(3, 0.7)))]
    else:
        tufts = np.zeros((cells.count, 3), np.float32)
        tufts[cells.labels.ravel()] = designs[rng.integers(len(designs))](rng, size).reshape(-1, 3)
    tufts = tufts * rng.uniform(0.75, 1.15, (cells.count, 1))
    pile = np.minimum(cells.edge * np.sqrt(cells.count), 0.4) / 0.4
    hair = spectral_noise(rng, size, slope=0.3, low=40)
    nap = spectral_noise(rng, size, slope=1.6, high=8)
    image = tufts[cells.labels] * (0.55 + 0.45 * pile + 0.1 * hair + 0.05 * nap)[..., None]
    return lit(image.astype(np.float32), blur(pile, 0.001), 0.3 / np.sqrt(cells.count), rng)


def _thread_colours(rng: np.random.Generator, threads: int, yarns: Colours) -> Colours:
    """Colour of every thread: solid, or a sequence of bands that repeats (stripes; crossed, a tartan)."""
    repeat = threads // int(rng.choice([1, 2, 4]))
    bands = np.sort(rng.choice(np.arange(1, repeat), int(rng.choice([0, 2, 5])), replace=False))
    sequence = yarns[rng.integers(len(yarns), size=len(bands) + 1)]
    one = sequence[np.searchsorted(bands, np.arange(repeat), side="right")]
    return np.resize(one, (threads, 3))
