"""What the sensor stage costs, and what it does: ``python -m benchmarks.sensor [--images N]``.

CPU seconds of one image of 720 x 540 pixels, all threads together, by preset, with large settings, and of the plain
tone mapping; and how far noise and edge widths are from their formulas (``scenes/sensor.py``).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks import keep
from synthetless.io.color import tonemap
from synthetless.scenes.sampling import sample_sensor
from synthetless.scenes.sensor import blurred, expose
from synthetless.scenes.settings import SensorSettings
from synthetless.scenes.spec import SensorSpec

HEIGHT, WIDTH = 540, 720
PRIMESENSE = sample_sensor(SensorSettings(preset="primesense"), 0, 0, 0)
LARGEST = replace(
    PRIMESENSE, blur_px=3.0, chroma_px=5.0, sharpen=2.0, sharpen_px=3.0, photons=1e5, vignetting=0.3, jpeg_quality=95
)


def main() -> None:
    """Measure, print, write benchmarks/results/sensor.json."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--images", type=int, default=20)
    images = options.parse_args().images
    light = blurred(np.random.default_rng(0).random((HEIGHT, WIDTH, 3), dtype=np.float32), 2.0)
    ranges = [sample_sensor(SensorSettings(), 0, number, 0) for number in range(images)]
    result = {
        "cpu_s plain": cpu_s(lambda _: tonemap(light, 1.0), images),
        "cpu_s primesense": cpu_s(lambda _: expose(light, PRIMESENSE), images),
        "cpu_s ranges": cpu_s(lambda number: expose(light, ranges[number]), images),
        "cpu_s largest": cpu_s(lambda _: expose(light, LARGEST), images),
    }
    result |= {f"noise variance / formula at {x}": noise_ratio(x) for x in (0.05, 0.1, 0.3, 0.6, 0.85)}
    result |= {f"edge width / formula at {px} px": edge_ratio(px) for px in (0.5, 0.7, 1.0, 1.5, 2.0, 3.0)}
    for name, value in result.items():
        print(f"{name:36} {value:.4f}")
    keep("sensor", result)


def cpu_s(make: Callable[[int], NDArray[np.uint8]], images: int) -> float:
    """CPU seconds of one call; the first is not counted."""
    make(0)
    began = time.process_time()
    for number in range(images):
        make(number)
    return (time.process_time() - began) / images


def noise_ratio(x: float) -> float:
    """Variance of the pixels that see green, by the formula's; noise of primesense alone."""
    drawn = _only(photons=PRIMESENSE.photons, read_noise=PRIMESENSE.read_noise)
    levels = expose(np.full((1400, 1400, 3), x, dtype=np.float32), drawn)[..., 1].astype(np.float64)
    green = np.concatenate([levels[::2, 1::2].ravel(), levels[1::2, ::2].ravel()])
    slope = 255 * 1.055 / 2.4 * x ** (1 / 2.4 - 1)
    return float(green.var() / (slope**2 * (x / drawn.photons + drawn.read_noise**2) + 1 / 12))


def edge_ratio(blur_px: float) -> float:
    """Standard deviation of an edge's rise, averaged over its places in the pixel, by the formula's."""
    i, places = np.arange(-40, 41), np.arange(64) / 64
    rows = np.clip(i[None, :] + 0.5 - places[:, None], 0, 1).astype(np.float32)
    heights = np.array([blurred(np.repeat(row[None], 3, axis=0), blur_px)[1] for row in rows]).T.ravel()
    x = (i[:, None] - places[None, :]).ravel()
    order = np.argsort(x)
    spread, middle = np.diff(heights[order].astype(np.float64)), (x[order][1:] + x[order][:-1]) / 2
    mean = float((spread * middle).sum())
    return float(np.sqrt((spread * (middle - mean) ** 2).sum() / (blur_px**2 + 1 / 12)))


def _only(photons: float, read_noise: float) -> SensorSpec:
    return SensorSpec(0.0, 0.0, 0.0, 0.0, photons, read_noise, 1.0, 1.0, 0.0, 0.0, 1.0, None, 0)


if __name__ == "__main__":
    main()
