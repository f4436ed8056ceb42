"""How near each quality comes to a converged render: ``python -m benchmarks.quality [--models DIR] [--textures DIR]``.

Scenes of the T-LESS recipe with 10 objects, at half the width and height (finer detail per pixel, so harder, and four
times as fast). Each image is compared as it is written, PNG or JPEG file included, with the same scene at so many
samples that its noise no longer counts; PSNR in dB and SSIM on sRGB values, the mean over the scenes. CPU seconds are
of rendering alone. The converged renders are kept in benchmarks/results and used again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import RESULTS, keep, parser, tless_recipe
from synthetless.config import Recipe
from synthetless.generation.drop import DropRenderer
from synthetless.generation.sources import load_sources
from synthetless.io.color import exposure_gain, tonemap
from synthetless.io.images import decode_rgb, encode_jpeg, encode_png
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.settings import RenderSettings

SHRINK = 2

Encoder = Callable[[NDArray[np.uint8]], bytes]

CANDIDATES: dict[str, tuple[RenderSettings, Encoder]] = {
    "draft": (RenderSettings(quality="draft"), encode_png),
    "standard": (RenderSettings(quality="standard"), encode_png),
    "standard, JPEG 98": (RenderSettings(quality="standard"), lambda rgb: encode_jpeg(rgb, 98)),
    "reference": (RenderSettings(quality="reference"), encode_png),
    "50 samples, accurate, JPEG 95": (RenderSettings(samples=50), lambda rgb: encode_jpeg(rgb, 95)),
    "250 samples, no denoiser": (RenderSettings(samples=250, denoiser="none"), encode_png),
}


def main() -> None:
    """Render, compare, print a table, write benchmarks/results/quality.json."""
    options = parser(__doc__)
    options.add_argument("--scenes", type=int, default=3)
    options.add_argument("--samples", type=int, default=4096, help="of the converged renders")
    arguments = options.parse_args()
    recipe = bench_recipe(arguments)
    renderer = DropRenderer(recipe, load_sources(recipe), threads=1)
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in CANDIDATES}
    for drop in range(arguments.scenes):
        spec, settled = renderer.drop(drop)
        with renderer.session.scene(spec, settled) as scene:
            reference = converged(renderer.session, lambda: scene.render(0), recipe, drop, arguments.samples)
            for name, (settings, encode) in CANDIDATES.items():
                renderer.session.configure(settings)
                began = time.process_time()
                linear = renderer.render(scene, settled, 0)
                spent = time.process_time() - began
                gain = exposure_gain(linear, recipe.render.exposure)
                content = encode(tonemap(linear, gain))
                pair = decode_rgb(content), tonemap(reference, gain)
                rows[name].append((psnr(*pair), ssim(*pair), spent, len(content) / 1000))
                print(drop, name, *(f"{value:.3f}" for value in rows[name][-1]), flush=True)
    columns = ("psnr_db", "ssim", "cpu_s", "kilobytes")
    table = {name: dict(zip(columns, np.mean(row, axis=0).round(4), strict=True)) for name, row in rows.items()}
    for name, row in table.items():
        print(f"{name:32}" + "".join(f"{column} {row[column]:8.3f}   " for column in columns))
    keep("quality", table)


def bench_recipe(arguments: argparse.Namespace) -> Recipe:
    """The T-LESS recipe with 10 objects, one view a drop, at a smaller size."""
    camera = tless_recipe(arguments).camera
    smaller = {"width": camera.width // SHRINK, "height": camera.height // SHRINK} | {
        name: getattr(camera, name) / SHRINK for name in ("fx", "fy", "cx", "cy")
    }
    overrides = [f"camera.{name}={value}" for name, value in smaller.items()]
    return tless_recipe(arguments, *overrides, "camera.views_per_drop=1")


def converged(
    session: BlenderSession, render: Callable[[], NDArray[np.float32]], recipe: Recipe, drop: int, samples: int
) -> NDArray[np.float32]:
    """The scene without noise, rendered once and kept."""
    name = f"converged_{Path(recipe.source.models).name}_{drop}_{samples}.npy"
    path = RESULTS / name
    if not path.exists():
        session.configure(RenderSettings(samples=samples, denoiser="none"))
        RESULTS.mkdir(exist_ok=True)
        np.save(path, render())
    image: NDArray[np.float32] = np.load(path)
    return image


def psnr(image: NDArray[np.uint8], reference: NDArray[np.uint8]) -> float:
    """Peak signal to noise ratio of two 8-bit images, dB."""
    return float(cv2.PSNR(image, reference))


def ssim(image: NDArray[np.uint8], reference: NDArray[np.uint8]) -> float:
    """Mean structural similarity over pixels and channels: Wang et al. 2004, Gaussian window of sigma 1.5."""
    x, y = image.astype(np.float64), reference.astype(np.float64)

    def blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5))

    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return float(similarity.mean())


if __name__ == "__main__":
    main()
