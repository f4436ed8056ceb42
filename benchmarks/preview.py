"""Time the preview of many images: ``python -m benchmarks.preview [DATASET] [--images 5000]``.

The images of a generated dataset (a few of the paper's recipe are made if none is given) are repeated until there are
enough. Measured: until the gallery's first page opens, all of it, and once more with nothing changed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from benchmarks import cpu_s, keep
from benchmarks._repeated import generated, repeat
from synthetless.dataset.layout import PREVIEW_FOLDER
from synthetless.io.parallel import usable_cores
from synthetless.preview import write_preview


def main() -> None:
    """Measure, print, write benchmarks/results/preview.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?", help="what generate made, with at most one scene folder")
    parser.add_argument("--images", type=int, default=5000, help="how many to repeat its images to")
    parser.add_argument("--copy", action="store_true", help="copy the pictures instead of linking them")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "repeated"
        repeat(given.dataset or generated(Path(folder) / "made"), root, given.images)
        opened: list[float] = []
        start, before = time.perf_counter(), cpu_s()
        write_preview(root, copy=given.copy, opens=lambda page: opened.append(time.perf_counter() - start))
        whole_s, cpu = time.perf_counter() - start, cpu_s() - before
        size = sum(path.stat().st_size for path in (root / PREVIEW_FOLDER).rglob("*") if path.is_file())
        start, before = time.perf_counter(), cpu_s()
        write_preview(root, copy=given.copy)
        again_s, cpu_again = time.perf_counter() - start, cpu_s() - before
    result = {
        "images": given.images,
        "cores": usable_cores(),
        "copies": given.copy,
        "first_page_s": [round(seconds, 1) for seconds in opened],
        "whole_s": round(whole_s, 1),
        "cpu_ms_per_image": round(1000 * cpu / given.images, 1),
        "kb_per_image": round(size / given.images / 1000, 1),
        "unchanged_s": round(again_s, 1),
        "unchanged_cpu_ms_per_image": round(1000 * cpu_again / given.images, 1),
    }
    for name, value in result.items():
        print(f"{name:30} {value}")
    keep("preview", result)


if __name__ == "__main__":
    main()
