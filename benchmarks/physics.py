"""How often a throw comes to rest, and the processor time of a drop: ``python -m benchmarks.physics [MODELS_DIR]``.

Without a folder it takes the one that SYNTHETLESS_TLESS_MODELS names, or else the parts that come with the project.
Prints a table and writes benchmarks/results/physics.json. Needs Blender.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import default_models, keep
from synthetless.io.models import load_models
from synthetless.scenes.physics import Collider, NotSettled, PhysicsSettings, collider, settle
from synthetless.scenes.rotations import random_rotation
from synthetless.scenes.spec import Mesh, Pose


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="?", default=default_models())
    parser.add_argument("--throws", type=int, default=30, help="per number of objects")
    parser.add_argument("--objects", type=int, nargs="+", default=[1, 3, 6, 10])
    arguments = parser.parse_args()
    models = load_models(arguments.models)
    start = time.process_time()
    colliders = [collider(Mesh(model.vertices_mm / 1000, model.faces)) for model in models.values()]
    rows: list[dict[str, object]] = [{"collider_cpu_s": round((time.process_time() - start) / len(colliders), 2)}]
    print(f"{len(colliders)} models from {arguments.models}; a collider takes {rows[0]['collider_cpu_s']} CPU s")
    for count in arguments.objects:
        rows.append(measure(colliders, count, arguments.throws))
        print(", ".join(f"{key} {value}" for key, value in rows[-1].items()))
    keep("physics", rows)


def measure(colliders: Sequence[Collider], count: int, throws: int) -> dict[str, object]:
    """Throw so many objects, drawn with replacement, so many times."""
    reasons: Counter[str] = Counter()
    gaps, depths, times = [0.0], [0.0], []
    for number in range(throws):
        rng = np.random.default_rng((number, count))
        chosen = [colliders[i] for i in rng.integers(0, len(colliders), count)]
        poses = release(chosen, rng)
        start = time.process_time()
        try:
            settled = settle(chosen, poses, PhysicsSettings())
            gaps.extend(settled.gaps_m)
            depths.extend(settled.penetrations_m)
        except NotSettled as failure:
            reasons[" ".join(str(failure).split()[2:4])] += 1
        times.append(time.process_time() - start)
    return {
        "objects": count,
        "accepted": f"{throws - sum(reasons.values())}/{throws}",
        "cpu_s": round(float(np.mean(times)), 2),
        "max_gap_mm": round(1000 * max(gaps), 2),
        "max_penetration_mm": round(1000 * max(depths), 2),
        "refused": dict(reasons),
    }


def release(colliders: Sequence[Collider], rng: np.random.Generator) -> list[Pose]:
    """One above the other, bounding spheres a little apart, over a disc of 6 cm."""
    poses, floor = [], 0.0
    for item in colliders:
        reach = float(np.linalg.norm(item.surface.vertices_m, axis=1).max())
        radius, angle = 0.06 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        height = floor + reach + float(rng.uniform(0.005, 0.03))
        poses.append(Pose(random_rotation(rng), (float(radius * np.cos(angle)), float(radius * np.sin(angle)), height)))
        floor = height + reach
    return poses


if __name__ == "__main__":
    main()
