"""Whether a worker swells or slows down: ``python -m benchmarks.memory [--models DIR] [--textures DIR] [--drops 200]``.

One process makes drop after drop, small images, so that what could leak (meshes, textures, materials) comes often.
Prints the growth after the 20th drop and the processor time per drop, and writes benchmarks/results/memory.json.
"""

from __future__ import annotations

import time

import numpy as np
import psutil

from benchmarks import keep, parser, tless_recipe
from synthetless.dataset.layout import plan_image
from synthetless.generation.drop import DropRenderer
from synthetless.generation.sources import load_sources

WARM = 20
"""After so many drops every mesh has been seen."""


def main() -> None:
    """Measure, print, write."""
    options = parser(__doc__)
    options.add_argument("--drops", type=int, default=200)
    arguments = options.parse_args()
    small = ["camera.width=180", "camera.height=135", "render.samples=1", "camera.views_per_drop=1"]
    recipe = tless_recipe(arguments, *small)
    renderer = DropRenderer(recipe, load_sources(recipe), threads=1)
    megabytes, seconds = [], []
    for drop in range(arguments.drops):
        began = time.process_time()
        list(renderer.make(drop, [plan_image(drop, 1)]))
        seconds.append(time.process_time() - began)
        megabytes.append(psutil.Process().memory_info().rss / 1e6)
    growth = max(megabytes[WARM:]) / megabytes[WARM - 1] - 1
    early, late = (float(np.median(part)) for part in np.array_split(seconds[WARM:], 2))
    print(
        f"memory after drop {WARM}: {megabytes[WARM - 1]:.0f} MB; at most {growth:+.1%} of it until drop {len(seconds)}"
    )
    print(f"CPU per drop: {early:.2f} s in the first half after drop {WARM}, {late:.2f} s in the second")
    keep("memory", {"megabytes": megabytes, "cpu_s": seconds, "growth": growth})


if __name__ == "__main__":
    main()
