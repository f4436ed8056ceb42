"""Whether two checkouts make the same bytes: makes small datasets, relabels, adopts and exports them, prints digests.

    python -m benchmarks.digests                                  # this checkout
    python -m benchmarks.digests --command OTHER/.venv/bin/synthetless

Everything goes through the command, so that any version of the project can be compared with any other.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks import ROOT, keep, parser

Run = Callable[..., None]


def main() -> None:
    """Print a digest for each result."""
    options = parser(__doc__)
    options.add_argument("--command", nargs="+", default=[sys.executable, "-m", "synthetless"])
    options.add_argument("--images", type=int, default=4)
    arguments = options.parse_args()

    def run(*words: object) -> None:
        subprocess.run([*arguments.command, *map(str, words)], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        _make(run, root, arguments.images, arguments.models, arguments.textures)
        digests = {path.name: _digest(path) for path in sorted(root.iterdir())}
    for name, digest in digests.items():
        print(f"{digest}  {name}")
    keep("digests", digests)


def _make(run: Run, root: Path, images: int, models: str, textures: str) -> None:
    every = "outputs=[rgb, depth, masks, normals, object_coordinates, exr]"
    run("generate", "configs/demo.yaml", "--out", root / "demo", "--images", images, "--set", every)
    sources = ("--models", models, "--textures", textures)
    run("generate", "configs/synthetless.yaml", "--out", root / "paper", "--images", images, *sources)
    shutil.copytree(root / "demo", root / "relabelled")
    run("relabel", root / "relabelled", "--scheme", "atlas")
    _bare(root / "paper", root / "adopted")
    run("adopt", root / "adopted", "--scheme", "atlas")
    for name in ("demo", "paper", "relabelled", "adopted"):
        run("export", "coco", root / name, "--to", root / f"{name}.coco.json")
        run("export", "webdataset", root / name, "--to", root / f"{name}.shards", "--shuffle-seed", 5)


def _bare(dataset: Path, to: Path) -> None:
    """A copy as somebody else's BOP dataset would be: without what this project adds."""
    shutil.copytree(dataset, to, ignore=shutil.ignore_patterns(".*", "*.md", "preview.jpg", "dataset.json"))
    (to / "symmetries.json").unlink()
    for name in ("scene_gt_canonical.json", "scene_spec.jsonl"):
        for path in to.glob(f"*/*/{name}"):
            path.unlink()


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of names and contents of the files of a folder, but for logs."""
    files = [path] if path.is_file() else sorted(found for found in path.rglob("*") if found.is_file())
    total = hashlib.sha256()
    for file in files:
        if ".logs" not in file.parts:
            total.update(f"{file.relative_to(path)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return total.hexdigest()


if __name__ == "__main__":
    main()
