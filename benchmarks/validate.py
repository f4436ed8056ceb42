"""Time the validation of a dataset: ``python -m benchmarks.validate [DATASET] [--images 2000]``.

The images of a generated dataset (a few of the paper's recipe are made if none is given) are repeated until there are
enough, each with labels and a record of its own, and the whole is validated on every core. The starting of the workers
is included, so that the extrapolation is on the safe side. The files are in the page cache; from a disk that is slower
than the cores, reading sets the pace.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from benchmarks import cpu_s, keep
from benchmarks._repeated import generated, repeat
from synthetless.io.parallel import usable_cores
from synthetless.validation import validate

PAPERS_IMAGES = 30_000


def main() -> None:
    """Measure, print, write benchmarks/results/validate.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?", help="what generate made, with at most one scene folder")
    parser.add_argument("--images", type=int, default=2000, help="how many to repeat its images to")
    given = parser.parse_args()
    cores = usable_cores()
    with tempfile.TemporaryDirectory() as folder:
        source = given.dataset or generated(Path(folder) / "made")
        root = Path(folder) / "repeated"
        repeat(source, root, given.images)
        before, start = cpu_s(), time.perf_counter()
        report = validate(root, workers=cores)
        wall_s, spent_s = time.perf_counter() - start, cpu_s() - before
    if not report.valid:
        raise SystemExit("\n".join(report.lines()))
    files = 2 + 2 * report.instances / report.images
    result = {
        "images": report.images,
        "files_per_image": round(files, 1),
        "cores": cores,
        "wall_s": round(wall_s, 1),
        "cpu_ms_per_image": round(1000 * spent_s / report.images, 1),
        "minutes_for_30000_images_as_measured": round(PAPERS_IMAGES * wall_s / report.images / 60, 2),
        "minutes_for_30000_images_if_nothing_else_ran": round(PAPERS_IMAGES * spent_s / cores / report.images / 60, 2),
    }
    for name, value in result.items():
        print(f"{name:46} {value}")
    keep("validate", result)


if __name__ == "__main__":
    main()
