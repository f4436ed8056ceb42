"""What more workers bring: ``python -m benchmarks.scaling [--models DIR] [--textures DIR] [--workers 1 2 4]``.

Each number of workers makes the same images of the T-LESS recipe, of six models. The rate is that between the second
image of every worker and the last image of all, so that what each worker does once, which a night hardly notices, does
not count. The numbers take turns, since a machine is seldom equally fast for long. Run it on a machine with nothing
else to do: it prints a table and writes benchmarks/results/scaling.json.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from generator.config import Recipe, load_recipe
from generator.dataset import RECORDS_FOLDER
from generator.generate import Execution, generate

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "scaling.json"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", default="builtin", help="BOP models folder")
    parser.add_argument("--textures", default="builtin", help="folder of photographs")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--images", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    sources = [f"source.{name}={json.dumps(getattr(arguments, name))}" for name in ("models", "textures")]
    overrides = [*sources, "objects.count=[10, 10]", "camera.views_per_drop=1", f"images={arguments.images}"]
    overrides.append("objects.ids=[1, 2, 3, 4, 5, 6]")
    recipe = load_recipe(ROOT / "configs" / "tless_bop.yaml", overrides)
    rates: dict[int, list[float]] = {workers: [] for workers in arguments.workers}
    for _ in range(arguments.rounds):
        for workers, measured in rates.items():
            measured.append(images_per_hour(recipe, workers))
    best = {workers: max(measured) for workers, measured in rates.items()}
    for workers, rate in best.items():
        print(f"{workers} workers: {rate:6.0f} images an hour, {rate / best[arguments.workers[0]]:.2f} times the first")
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps({"images_per_hour": rates}, indent=1) + "\n")


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
