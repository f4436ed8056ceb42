"""How many poses per second and core the canonical labels of each group and scheme take.

    python -m benchmarks.symmetry [--poses 300000]

Prints a table and writes benchmarks/results/symmetry.json. Counted is processor time, all threads together, so that the
numbers hold per core on a busy machine too; the best of some repetitions.
"""

from __future__ import annotations

import argparse
import platform
import time

import numpy as np

from benchmarks import keep
from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.atlas import SCHEMES
from synthetless.symmetry.quaternions import normalise, to_matrix

GROUPS = ("C1", "C2", "C4", "C6", "C12", "D2", "D3", "D6", "T", "O", "I", "SO(2)", "O(2)", "SO(3)")
REPETITIONS = 5


def poses_per_second(canonical: CanonicalMap, n: int) -> float:
    """Poses labelled per second of processor time."""
    rng = np.random.default_rng(0)
    R, t = to_matrix(normalise(rng.normal(size=(n, 4)))), rng.normal(size=(n, 3)) * 100
    canonical(R[:10], t[:10])
    times = []
    for _ in range(REPETITIONS):
        start = time.process_time()
        canonical(R, t)
        times.append(time.process_time() - start)
    return n / min(times)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--poses", type=int, default=300_000, help="poses per call")
    n = parser.parse_args().poses
    results: dict[str, dict[str, float]] = {}
    print(f"{'group':>7} {'order':>6}  " + "  ".join(f"{scheme:>20}" for scheme in SCHEMES))
    for name in GROUPS:
        group = SymmetryGroup.from_name(name, offset_mm=(1, 2, 3))
        results[name] = {scheme: poses_per_second(CanonicalMap(group, scheme), n) for scheme in SCHEMES}
        rates = "  ".join(f"{results[name][scheme] / 1e6:>11.2f} M poses/s" for scheme in SCHEMES)
        print(f"{name:>7} {group.order:>6}  {rates}")
    record = {"poses": n, "machine": platform.machine(), "numpy": np.__version__, "poses_per_second": results}
    keep("symmetry", record)


if __name__ == "__main__":
    main()
