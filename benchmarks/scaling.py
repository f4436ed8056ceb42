"""What more workers bring: ``python -m benchmarks.scaling [--models DIR] [--textures DIR] [--workers 1 2 4]``.

Each number of workers makes the same images of the T-LESS recipe, of six models. The rate is that between the second
image of every worker and the last image of all, so that what each worker does once, which a night hardly notices, does
not count. The numbers take turns, since a machine is seldom equally fast for long. Run it on a machine with nothing
else to do: it prints a table and writes benchmarks/results/scaling.json.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks import keep, parser, tless_recipe
from synthetless.config import Recipe
from synthetless.dataset.layout import RECORDS_FOLDER
from synthetless.generation.generate import Execution, generate


def main() -> None:
    """Measure, print, write."""
    options = parser(__doc__)
    options.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    options.add_argument("--images", type=int, default=24)
    options.add_argument("--rounds", type=int, default=2)
    arguments = options.parse_args()
    few_models = "objects.ids=[1, 2, 3, 4, 5, 6]"
    recipe = tless_recipe(arguments, few_models, "camera.views_per_drop=1", f"images={arguments.images}")
    rates: dict[int, list[float]] = {workers: [] for workers in arguments.workers}
    for _ in range(arguments.rounds):
        for workers, measured in rates.items():
            measured.append(images_per_hour(recipe, workers))
    best = {workers: max(measured) for workers, measured in rates.items()}
    for workers, rate in best.items():
        print(f"{workers} workers: {rate:6.0f} images an hour, {rate / best[arguments.workers[0]]:.2f} times the first")
    keep("scaling", {"images_per_hour": rates})


def images_per_hour(recipe: Recipe, workers: int) -> float:
    """Of all workers together, once each has made its second image."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        generate(recipe, out, Execution(workers))
        times = np.sort([path.stat().st_mtime for path in (out / RECORDS_FOLDER).glob("*/*.json")])
    begun = 2 * workers
    return float(3600 * (len(times) - begun) / (times[-1] - times[begun - 1]))


if __name__ == "__main__":
    main()
