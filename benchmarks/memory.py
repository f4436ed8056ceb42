"""Whether a worker swells or slows down: ``python -m benchmarks.memory [--models DIR] [--textures DIR] [--drops 200]``.

One process makes drop after drop, small images, so that what could leak (meshes, textures, materials) comes often.
Prints the growth after the 20th drop and the processor time per drop, and writes benchmarks/results/memory.json.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import psutil

from generator.config import load_recipe
from generator.plan import plan_image
from generator.sources import load_sources
from generator.studio import Studio

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "memory.json"
WARM = 20
"""After so many drops every mesh has been seen."""


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", default="builtin", help="BOP models folder")
    parser.add_argument("--textures", default="builtin", help="folder of photographs")
    parser.add_argument("--drops", type=int, default=200)
    arguments = parser.parse_args()
    sources = [f"source.{name}={json.dumps(getattr(arguments, name))}" for name in ("models", "textures")]
    small = ["camera.width=180", "camera.height=135", "render.samples=1", "camera.views_per_drop=1"]
    recipe = load_recipe(ROOT / "configs" / "tless_bop.yaml", [*sources, *small, "objects.count=[10, 10]"])
    studio = Studio(recipe, load_sources(recipe), threads=1)
    megabytes, seconds = [], []
    for drop in range(arguments.drops):
        began = time.process_time()
        list(studio.make(drop, [plan_image(drop, 1)]))
        seconds.append(time.process_time() - began)
        megabytes.append(psutil.Process().memory_info().rss / 1e6)
    growth = max(megabytes[WARM:]) / megabytes[WARM - 1] - 1
    early, late = (float(np.median(part)) for part in np.array_split(seconds[WARM:], 2))
    print(
        f"memory after drop {WARM}: {megabytes[WARM - 1]:.0f} MB; at most {growth:+.1%} of it until drop {len(seconds)}"
    )
    print(f"CPU per drop: {early:.2f} s in the first half after drop {WARM}, {late:.2f} s in the second")
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps({"megabytes": megabytes, "cpu_s": seconds, "growth": growth}) + "\n")


if __name__ == "__main__":
    main()
