"""What more workers bring: ``python -m benchmarks.scaling [--models DIR] [--textures DIR] [--workers 1 2 4]``.

Each number of workers makes the same images of the T-LESS recipe, of six models. The first rate is that of the whole
command, start included; the second that between the second image of every worker and the last image of all, so that
what each worker does once, which a night hardly notices, does not count. The numbers take turns, since a machine is
seldom equally fast for long. Run it on a machine with nothing else to do: it prints a table and writes
benchmarks/results/scaling.json.
"""

from __future__ import annotations

import tempfile
import time
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
    rates: dict[int, list[tuple[float, float]]] = {workers: [] for workers in arguments.workers}
    for _ in range(arguments.rounds):
        for workers, measured in rates.items():
            measured.append(images_per_hour(recipe, workers))
    best = {workers: np.max(measured, axis=0) for workers, measured in rates.items()}
    for workers, (whole, later) in best.items():
        first = best[arguments.workers[0]]
        print(
            f"{workers} workers: {whole:6.0f} images an hour with the start, {whole / first[0]:.2f} times the first; "
            f"{later:6.0f} without, {later / first[1]:.2f} times"
        )
    keep("scaling", {"images_per_hour": rates})


def images_per_hour(recipe: Recipe, workers: int) -> tuple[float, float]:
    """Of all workers together: from the beginning, and once each has made its second image."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        began = time.monotonic()
        generate(recipe, out, Execution(workers))
        whole = time.monotonic() - began
        times = np.sort([path.stat().st_mtime for path in (out / RECORDS_FOLDER).glob("*/*.json")])
    begun = 2 * workers
    return 3600 * len(times) / whole, float(3600 * (len(times) - begun) / (times[-1] - times[begun - 1]))


if __name__ == "__main__":
    main()
