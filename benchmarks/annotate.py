"""Time the exact geometry of an image: ``python -m benchmarks.annotate [MODELS_DIR]``.

Without a folder it takes the one that SYNTHETLESS_TLESS_MODELS names, or else the parts that come with the project.
CPU time of this process; of each scene the fastest of a few rounds, since other programs only ever slow one down.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import default_models, keep
from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.annotation.scene import scene_caster
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.camera import extrinsics
from synthetless.scenes.spec import Intrinsics, View

CAMERA = Intrinsics(width=720, height=540, fx=1075.65091572, fy=1073.90347929, cx=360.0, cy=270.0)
HALF_TABLE_MM = 3000.0
N_OBJECTS, N_SCENES, N_ROUNDS = 10, 20, 8
CASES: dict[str, dict[str, bool | float]] = {
    "depth, ids, masks and boxes": {},
    "the same, visible within 5 mm": {"visibility_delta_mm": 5.0},
    "and normals": {"normals": True},
    "and object coordinates": {"normals": True, "object_coordinates": True},
}

Scene = tuple[Plane, list[PosedModel]]


def main() -> None:
    """Measure, print a table, write benchmarks/results/annotate.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", type=Path, nargs="?", default=default_models(), help="a BOP models folder")
    models = load_models(parser.parse_args().models)

    caster = scene_caster({"model": models})
    build_ms = _time_building(caster, models)
    scenes = [_random_scene(np.random.default_rng(seed), list(models)) for seed in range(N_SCENES)]
    seconds = [[[_time(caster, scene, case) for scene in scenes] for case in CASES.values()] for _ in range(N_ROUNDS)]
    times_ms = dict(zip(CASES, 1000 * np.median(np.min(seconds, axis=0), axis=1), strict=True))
    counts = [sum(i.px_count_all for i in caster.annotate(CAMERA, *scene).instances) for scene in scenes]
    triangles = [sum(len(models[posed.obj_id].faces) for posed in instances) for _, instances in scenes]

    for name, value in times_ms.items():
        print(f"{name:32} {value:7.1f} ms an image")
    print(f"{'building the tree, once':32} {build_ms:7.1f} ms a model")
    result = {
        "image_px": [CAMERA.width, CAMERA.height],
        "objects": N_OBJECTS,
        "triangles_median": int(np.median(triangles)),
        "silhouettes_px_median": int(np.median(counts)),
        "cpu_ms_per_image_median": {name: round(float(value), 1) for name, value in times_ms.items()},
        "cpu_ms_per_model_once_mean": round(build_ms, 1),
    }
    keep("annotate", result)


def _random_scene(rng: np.random.Generator, obj_ids: list[int]) -> Scene:
    """Objects scattered over a table, seen from 0.65 to 0.94 m as in T-LESS."""
    view = View(rng.uniform(0.65, 0.94), rng.uniform(20, 89), rng.uniform(0, 360), 0.0, (0.0, 0.0, 0.0))
    R_w2c, t_w2c_m = extrinsics(view, (0.0, 0.0, 0.03))
    t_w2c = 1000 * t_w2c_m
    instances = []
    for obj_id in rng.choice(obj_ids, N_OBJECTS):
        position_mm = rng.uniform([-120, -120, 20], [120, 120, 60])
        R_m2w = Rotation.random(random_state=rng).as_matrix()
        instances.append(PosedModel(int(obj_id), R_w2c @ R_m2w, R_w2c @ position_mm + t_w2c))
    return Plane(R_w2c, t_w2c, HALF_TABLE_MM), instances


def _time(caster: RayCaster, scene: Scene, options: Mapping[str, bool | float]) -> float:
    start = time.process_time()
    caster.annotate(CAMERA, *scene, **options)  # type: ignore[arg-type]  # options are named in CASES
    return time.process_time() - start


def _time_building(caster: RayCaster, models: Mapping[int, ObjectModel]) -> float:
    one_of_each = [PosedModel(obj_id, np.eye(3), np.array([0.0, 0.0, 500.0])) for obj_id in models]
    start = time.process_time()
    caster.annotate(Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0), None, one_of_each)
    return 1000 * (time.process_time() - start) / len(models)


if __name__ == "__main__":
    main()
