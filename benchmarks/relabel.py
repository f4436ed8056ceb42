"""Time a change of symmetries: ``python -m benchmarks.relabel``.

The dataset is JSON only, of random poses of the parts that come with the project, in a temporary folder: 30,000 images
with 150,000 instances. Wall time and the CPU time of all processes, their start included; what other programs do in the
meantime lengthens the first.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import ROOT, keep
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import camera_entry, gt_entry, write_scene_json
from synthetless.dataset.relabel import relabel
from synthetless.io.files import write_json
from synthetless.io.models import INFO_FILE, read_models_info
from synthetless.io.parallel import usable_cores
from synthetless.symmetry import SymmetryTable

N_SCENES, N_IMAGES, N_INSTANCES = 30, 1000, 5
K = np.array([[1075.0, 0.0, 200.0], [0.0, 1075.0, 200.0], [0.0, 0.0, 1.0]])


def main() -> None:
    """Measure, print a table, write benchmarks/results/relabel.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=usable_cores(), help="processes")
    workers: int = parser.parse_args().workers
    with tempfile.TemporaryDirectory() as folder:
        root, table = Path(folder) / "dataset", Path(folder) / "table.json"
        build(root)
        table.write_text(json.dumps({"1": "C2"}), encoding="utf-8")
        times = {
            "the first labels": _time(lambda: relabel(root, workers=workers)),
            "another scheme": _time(lambda: relabel(root, scheme="atlas", workers=workers)),
            "another group of one object, dry run": _time(lambda: relabel(root, table, dry_run=True, workers=workers)),
            "another group of one object": _time(lambda: relabel(root, table, workers=workers)),
            "all labels made anew, nothing changes": _time(lambda: relabel(root, workers=workers)),
        }
    for name, (wall_s, cpu_s) in times.items():
        print(f"{name:40} {wall_s:6.1f} s   CPU {cpu_s:6.1f} s")
    result = {
        "images": N_SCENES * N_IMAGES,
        "instances": N_SCENES * N_IMAGES * N_INSTANCES,
        "workers": workers,
        "wall_s": {name: round(wall_s, 2) for name, (wall_s, _) in times.items()},
        "cpu_s": {name: round(cpu_s, 2) for name, (_, cpu_s) in times.items()},
    }
    keep("relabel", result)


def build(root: Path) -> None:
    """What relabel reads of a dataset."""
    infos = read_models_info(ROOT / "assets" / "parts")
    write_json(root / "models" / INFO_FILE, {str(obj_id): info for obj_id, info in infos.items()})
    write_json(root / "dataset.json", {"name": "benchmark"})
    SymmetryTable.from_models_info(infos).write(root / "symmetries.json")
    rng = np.random.default_rng(np.random.SeedSequence(0))
    camera = camera_entry(K, np.eye(3), np.zeros(3), 0.1)
    for scene_id in range(1, N_SCENES + 1):
        scene = ScenePaths.of(root, scene_id)
        shape = (N_IMAGES, N_INSTANCES)
        rotations = Rotation.random(N_IMAGES * N_INSTANCES, random_state=rng).as_matrix().reshape(*shape, 3, 3)
        places_mm = rng.uniform([-200, -200, 600], [200, 200, 1400], (*shape, 3))
        obj_ids = rng.choice(list(infos), shape)
        gt = {
            im_id: [gt_entry(*pose) for pose in zip(obj_ids[im_id], rotations[im_id], places_mm[im_id], strict=True)]
            for im_id in range(N_IMAGES)
        }
        write_scene_json(scene.scene_gt, gt)
        write_scene_json(scene.scene_camera, dict.fromkeys(gt, camera))


def _time(call: Callable[[], object]) -> tuple[float, float]:
    before, start = os.times(), time.perf_counter()
    call()
    after, wall_s = os.times(), time.perf_counter() - start
    return wall_s, sum(after[:4]) - sum(before[:4])


if __name__ == "__main__":
    main()
