"""How near each quality comes to a converged render: ``python -m benchmarks.quality [--models DIR] [--textures DIR]``.

Scenes of the T-LESS recipe with 10 objects, three of the built-in parts and, if a folder is given, three of its models.
They are rendered at half the width and height (finer detail per pixel, so harder, and four times as fast), or with
``--full`` at 720x540. Each image is compared as it is written, PNG or JPEG file included, with the same scene at many
samples, without a denoiser. Of those there are two, with noise that is independent, so that their noise drops out: the
error's mean square is the mean product of the errors against the one and the other, and likewise for the variances of
SSIM. PSNR in dB and SSIM on sRGB values; CPU seconds are of rendering alone, guides included. The converged renders are
kept in benchmarks/results and used again; ``--pictures DIR`` writes what was compared.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import RESULTS, keep, parser, tless_recipe
from synthetless.config import Recipe
from synthetless.generation.drop import DropRenderer
from synthetless.generation.sources import load_sources
from synthetless.io.color import exposure_gain, tonemap
from synthetless.io.files import atomic_write
from synthetless.io.images import decode_rgb, encode_jpeg, encode_png
from synthetless.scenes.settings import RenderSettings
from synthetless.scenes.spec import Pose, SceneSpec

Image = NDArray[np.uint8]
Encoder = Callable[[Image], bytes]

CANDIDATES: dict[str, tuple[RenderSettings, Encoder]] = {
    "draft": (RenderSettings(quality="draft"), encode_png),
    "standard": (RenderSettings(quality="standard"), encode_png),
    "standard, JPEG 98": (RenderSettings(quality="standard"), lambda rgb: encode_jpeg(rgb, 98)),
    "4 fast": (RenderSettings(samples=4, denoiser="fast"), encode_png),
    "12 fast": (RenderSettings(samples=12, denoiser="fast"), encode_png),
    "50 accurate, JPEG 95": (RenderSettings(samples=50, denoiser="accurate"), lambda rgb: encode_jpeg(rgb, 95)),
    "reference": (RenderSettings(quality="reference"), encode_png),
}
_OTHER_NOISE = 10**6
"""Added to a drop's number, from which Cycles' noise follows."""


def main() -> None:
    """Render, compare, print a table, write benchmarks/results/quality.json."""
    options = parser(__doc__)
    options.add_argument("--scenes", type=int, default=3, help="of each set of models")
    options.add_argument("--samples", type=int, default=512, help="of each of the two converged renders")
    options.add_argument("--full", action="store_true", help="at 720x540")
    options.add_argument("--candidates", nargs="+", choices=CANDIDATES, default=list(CANDIDATES))
    options.add_argument("--pictures", type=Path, help="folder for what was compared")
    arguments = options.parse_args()
    rows: dict[str, dict[str, list[tuple[float, ...]]]] = {}
    for models, textures in dict.fromkeys([("builtin", "builtin"), (arguments.models, arguments.textures)]):
        recipe = bench_recipe(argparse.Namespace(models=models, textures=textures), arguments.full)
        renderer = DropRenderer(recipe, load_sources(recipe), threads=1)
        for drop in range(arguments.scenes):
            name = f"{Path(models).name}_{drop}"
            for candidate, row in compare(renderer, recipe, drop, name, arguments).items():
                rows.setdefault(Path(models).name, {}).setdefault(candidate, []).append(row)
                print(name, candidate, *(f"{value:.4f}" for value in row), flush=True)
    rows["all"] = {name: [row for found in rows.values() for row in found[name]] for name in arguments.candidates}
    columns = ("psnr_db", "ssim", "cpu_s", "kilobytes")
    table = {
        of: {
            name: dict(zip(columns, np.mean(row, axis=0).round(4).tolist(), strict=True)) for name, row in found.items()
        }
        for of, found in rows.items()
    }
    for of, found in table.items():
        for name, measured in found.items():
            print(f"{of:12} {name:24}" + "".join(f"{column} {measured[column]:8.4f}   " for column in columns))
    keep("quality_full" if arguments.full else "quality", table)


def compare(
    renderer: DropRenderer, recipe: Recipe, drop: int, name: str, arguments: argparse.Namespace
) -> dict[str, tuple[float, ...]]:
    """PSNR, SSIM, CPU seconds and kilobytes of each candidate for one scene."""
    spec, settled = renderer.drop(drop)
    truth = [converged(renderer, spec, settled, name, half, arguments) for half in (0, 1)]
    gain = exposure_gain((truth[0] + truth[1]) / 2, recipe.render.exposure)
    halves = [tonemap(half, gain) for half in truth]
    found: dict[str, tuple[float, ...]] = {}
    with renderer.session.scene(spec, settled) as scene:
        for candidate in arguments.candidates:
            settings, encode = CANDIDATES[candidate]
            renderer.session.configure(settings)
            began = time.process_time()
            linear = renderer.render(scene, settled, 0)
            spent = time.process_time() - began
            content = encode(tonemap(linear, gain))
            image = decode_rgb(content)
            found[candidate] = psnr(image, halves), ssim(image, halves), spent, len(content) / 1000
            if arguments.pictures:
                file = arguments.pictures / f"{name}_{candidate.replace(' ', '_').replace(',', '')}.png"
                atomic_write(file, encode_png(image))
    if arguments.pictures:
        mean = tonemap((truth[0] + truth[1]) / 2, gain)
        atomic_write(arguments.pictures / f"{name}_converged.png", encode_png(mean))
    return found


def bench_recipe(arguments: argparse.Namespace, full: bool = False) -> Recipe:
    """The T-LESS recipe with 10 objects, one view a drop, at half the size if not the full one."""
    camera = tless_recipe(arguments).camera
    shrink = 1 if full else 2
    smaller = {"width": camera.width // shrink, "height": camera.height // shrink} | {
        name: getattr(camera, name) / shrink for name in ("fx", "fy", "cx", "cy")
    }
    overrides = [f"camera.{name}={value}" for name, value in smaller.items()]
    return tless_recipe(arguments, *overrides, "camera.views_per_drop=1")


def converged(
    renderer: DropRenderer,
    spec: SceneSpec,
    settled: Sequence[Pose],
    name: str,
    half: int,
    arguments: argparse.Namespace,
) -> NDArray[np.float32]:
    """The scene with little noise, rendered once and kept; each half with noise of its own."""
    size = f"{renderer.session.intrinsics.width}x{renderer.session.intrinsics.height}"
    path = RESULTS / f"converged_{name}_{size}_{arguments.samples}_{'ab'[half]}.npy"
    if not path.exists():
        renderer.session.configure(RenderSettings(samples=arguments.samples, denoiser="none"))
        RESULTS.mkdir(exist_ok=True)
        other = dataclasses.replace(spec, drop=spec.drop + _OTHER_NOISE * (1 + half))
        with renderer.session.scene(other, settled) as scene:
            np.save(path, scene.render(0))
    image: NDArray[np.float32] = np.load(path)
    return image


def psnr(image: Image, halves: Sequence[Image]) -> float:
    """Peak signal to noise ratio of an 8-bit image, dB, against what two noisy ones show."""
    errors = [image.astype(np.float64) - half for half in halves]
    return float(10 * np.log10(255**2 / (errors[0] * errors[1]).mean()))


def ssim(image: Image, halves: Sequence[Image]) -> float:
    """Mean structural similarity over pixels and channels: Wang et al. 2004, Gaussian window of sigma 1.5.

    The variance of the truth is the covariance of two noisy images of it.
    """
    x, a, b = (values.astype(np.float64) for values in (image, *halves))
    y = (a + b) / 2

    def blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5))

    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(a * b) - blur(a) * blur(b)
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return float(similarity.mean())


if __name__ == "__main__":
    main()
