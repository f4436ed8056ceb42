"""Painters of paint and ink: flat colour, strong contrast.

A painter takes a random generator and a size in pixels and returns a seamless (size, size, 3) sRGB image in 0..1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synthetless.extras import cv2
from synthetless.scenes.textures.colour import Colours, Image, mix, palette, ramp
from synthetless.scenes.textures.noise import blur, coordinates, normalised, smoothstep, spectral_noise

Canvas = NDArray[np.uint8]  # (size + 2 BLEED_PX, size + 2 BLEED_PX, 3)

BLEED_PX = 8  # printed beyond the tile and cut off: OpenCV smooths no outline on an image's last pixels


def clouds(rng: np.random.Generator, size: int) -> Image:
    """A colour gradient over fractal noise."""
    noise = spectral_noise(rng, size, slope=rng.uniform(1.1, 2), low=int(rng.integers(1, 6)))
    return ramp(normalised(noise), palette(rng, int(rng.integers(2, 6))))


def contours(rng: np.random.Generator, size: int) -> Image:
    """Bands between the level lines of a smooth landscape: zebra, agate, map."""
    hills = spectral_noise(rng, size, slope=2, high=rng.uniform(4, 14), stretch=rng.choice([1, 1, 3]))
    levels = int(rng.integers(4, 16))
    colours = palette(rng, int(rng.integers(2, 6)))
    height = normalised(hills, 0) * levels
    index = np.minimum(np.floor(height), levels - 1).astype(int)
    return blur(rng.choice(colours, levels + 1)[index] if rng.random() < 0.4 else colours[index % len(colours)], 0.0006)


def camouflage(rng: np.random.Generator, size: int) -> Image:
    """Overlapping blots of flat colour."""
    colours = palette(rng, int(rng.integers(3, 6)), chroma=rng.choice([25, 80]))
    image: Image = np.broadcast_to(colours[0], (size, size, 3))
    slope, low = rng.uniform(1.3, 1.9), int(rng.integers(2, 7))
    for colour in colours[1:]:
        blot = spectral_noise(rng, size, slope=slope, low=low, high=120, stretch=rng.choice([1, 2]))
        level = rng.uniform(0.1, 0.8)
        image = mix(image, colour, smoothstep(level, level + 0.04, blot))
    return image


def stripes(rng: np.random.Generator, size: int) -> Image:
    """Bands of random widths in any direction that closes on itself, straight or wavy."""
    u, v = coordinates(rng, size)
    steps = np.array([(0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, -1)])[rng.integers(6)]
    phase = steps[0] * u + steps[1] * v
    if rng.random() < 0.35:
        phase = phase + rng.uniform(0.005, 0.04) * spectral_noise(rng, size, slope=2, high=10)
    borders = np.sort(rng.random(int(rng.integers(3, 9)))).astype(np.float32)
    colours = palette(rng, int(rng.integers(2, 5)))
    bands = rng.integers(len(colours), size=len(borders) + 1)
    bands[-1] = bands[0]  # the last band runs on into the first
    repeats = int(rng.choice([1, 2, 3, 6, 12]))
    position = np.mod(phase * repeats, 1)
    image = colours[bands][np.searchsorted(borders, position)]
    worn = 1 + 0.05 * spectral_noise(rng, size, slope=1)
    return blur(image * worn[..., None], 0.0006)


def checks(rng: np.random.Generator, size: int) -> Image:
    """Chessboard, harlequin, or gingham."""
    u, v = coordinates(rng, size)
    n = int(rng.integers(1, 13))
    x, y = (u + v, u - v) if rng.random() < 0.4 else (u, v)
    odd_x, odd_y = np.floor(2 * n * x) % 2, np.floor(2 * n * y) % 2
    first, second = palette(rng, 2)
    value = (odd_x + odd_y) / 2 if rng.random() < 0.4 else (odd_x + odd_y) % 2
    worn = 1 + 0.04 * spectral_noise(rng, size, slope=1)
    return blur(mix(first, second, value.astype(np.float32)) * worn[..., None], 0.0006)


def shapes(rng: np.random.Generator, size: int) -> Image:
    """A print of dots, triangles, squares and hexagons, full or hollow, on a grid or scattered."""
    colours = palette(rng, int(rng.integers(2, 7)))
    canvas = _paper(colours[0], size)
    n = int(rng.integers(3, 15))
    j, i = np.divmod(np.arange(n * n), n)
    scatter = rng.choice([0.0, 1.0])
    centres = (np.stack([i, j], axis=-1) + 0.5 + scatter * rng.uniform(-0.5, 0.5, (n * n, 2))) / n
    radii = rng.uniform(0.2, 0.5) * (1 + scatter * rng.uniform(-0.5, 0.8, n * n)) / n
    corners = rng.choice([3, 4, 6, 40], n * n if scatter else 1)
    turns = rng.uniform(0, 2 * np.pi, n * n if scatter else 1)
    for k in range(n * n):
        sides = corners[k % len(corners)]
        angles = turns[k % len(turns)] + 2 * np.pi * np.arange(sides) / sides
        outline = centres[k] + radii[k] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        thickness = rng.choice([0.0, 0.0, 0.25]) * radii[k]
        _draw(canvas, outline, colours[rng.integers(1, len(colours))], thickness, closed=True)
    return _printed(rng, canvas)


def scribbles(rng: np.random.Generator, size: int) -> Image:
    """Pen and brush strokes that wander over paper."""
    colours = palette(rng, int(rng.integers(2, 7)))
    canvas = _paper(colours[0], size)
    curl, width = rng.uniform(0.05, 0.6), rng.uniform(0.002, 0.02)
    for _ in range(int(rng.integers(10, 50))):
        turning = np.cumsum(rng.normal(0, curl, 120)) * 0.5 + rng.uniform(0, 2 * np.pi)
        steps = 0.008 * np.stack([np.cos(turning), np.sin(turning)], axis=-1)
        path = rng.random(2) + np.cumsum(steps, axis=0)
        _draw(canvas, path, colours[rng.integers(1, len(colours))], width * rng.uniform(0.4, 2), closed=False)
    return _printed(rng, canvas)


def lettering(rng: np.random.Generator, size: int) -> Image:
    """Lines of nonsense words, from newsprint to poster, level or upright."""
    colours = palette(rng, int(rng.integers(2, 4)))
    canvas = _paper(colours[0], size)
    letters = list("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789")
    fonts = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX)
    font = fonts[rng.integers(3)]
    lines = int(rng.choice([5, 8, 12, 18, 26]))
    scale = 0.6 * size / lines / 22  # the fonts' capitals are 22 pixels high at scale 1
    stroke = max(1, round(scale * rng.uniform(1.5, 5)))
    for line in range(lines):
        x, y = rng.random() * size, (line + 0.5) * size / lines
        end = x + size
        while True:
            word = "".join(rng.choice(letters, rng.integers(1, 9)))
            (width, _), _ = cv2.getTextSize(word, font, scale, stroke)
            if x + width > end:
                break
            ink = 255 * colours[rng.integers(1, len(colours))]
            for dx in (-size, 0, size):
                for dy in (0, -size, size):
                    start = (round(x) + dx + BLEED_PX, round(y) + dy + BLEED_PX)
                    cv2.putText(canvas, word, start, font, scale, ink.tolist(), stroke, cv2.LINE_AA)
            x += width + 14 * scale
    image = _printed(rng, canvas)
    return np.rot90(image) if rng.random() < 0.5 else image


def _paper(colour: Colours, size: int) -> Canvas:
    """A blank sheet of 8 bits, because OpenCV smooths the outlines of nothing else."""
    side = size + 2 * BLEED_PX
    return np.full((side, side, 3), np.round(255 * colour), np.uint8)


def _printed(rng: np.random.Generator, canvas: Canvas) -> Image:
    """The sheet cut to the tile and a little worn."""
    tile = canvas[BLEED_PX:-BLEED_PX, BLEED_PX:-BLEED_PX]
    worn = 1 + rng.uniform(0.02, 0.08) * spectral_noise(rng, len(tile), slope=0.9)
    return (tile / np.float32(255)) * worn[..., None]


def _draw(canvas: Canvas, points: NDArray[np.float64], colour: Colours, thickness: float, closed: bool) -> None:
    """Draw the polyline, or with thickness 0 fill the polygon, wherever a copy of it meets the tile (in place)."""
    size, bits = len(canvas) - 2 * BLEED_PX, 4
    ink, width_px = (255 * colour).tolist(), max(1, round(thickness * size))
    reach = thickness + BLEED_PX / size
    first = -np.floor(points.max(axis=0) + reach).astype(int)
    last = -np.floor(points.min(axis=0) - reach).astype(int)
    for dx in range(first[0], last[0] + 1):
        for dy in range(first[1], last[1] + 1):
            fixed_point = np.round(((points + np.array([dx, dy])) * size + BLEED_PX) * 2**bits).astype(np.int32)
            if thickness:
                cv2.polylines(canvas, [fixed_point], closed, ink, width_px, cv2.LINE_AA, bits)
            else:
                cv2.fillPoly(canvas, [fixed_point], ink, cv2.LINE_AA, bits)
