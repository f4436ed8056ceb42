"""A small BOP dataset of built-in parts in random poses, and results of which some are near the truth and some are not.

Everything follows from one seed; depth and visibility are measured by ray casting.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.dataset import records
from synthetless.dataset.layout import ScenePaths
from synthetless.io import images
from synthetless.io.files import atomic_write
from synthetless.io.models import ObjectModel, load_models
from synthetless.learning.results import Estimate, write_results
from synthetless.scenes.spec import Intrinsics

CAMERA = Intrinsics(320, 240, 540.0, 535.0, 158.5, 121.25)
PARTS = (1, 5, 18, 27)
"""SO(2), C2, C1 and C4."""
SPLIT, IMAGES, DEPTH_SCALE = "test", 4, 0.1


@dataclass(frozen=True)
class Perturbed:
    """The dataset's folder, the result file, and what is in it."""

    root: Path
    results: Path
    estimates: list[Estimate]
    models: dict[int, ObjectModel]


def build(root: Path, parts: Path) -> Perturbed:
    """Write both below a folder; ``parts`` is the folder of the built-in parts."""
    rng = np.random.default_rng(13)
    dataset = root / "dataset"
    (dataset / "models").mkdir(parents=True)
    for obj_id in PARTS:
        shutil.copy(parts / f"obj_{obj_id:06d}.ply", dataset / "models")
    infos = json.loads((parts / "models_info.json").read_text())
    (dataset / "models" / "models_info.json").write_text(json.dumps({str(i): infos[str(i)] for i in PARTS}))
    models = load_models(dataset / "models")
    caster = RayCaster({("model", i): (model.vertices_mm, model.faces) for i, model in models.items()})
    scene = ScenePaths.of(dataset, 1, SPLIT)
    entries: dict[str, dict[int, Any]] = {"camera": {}, "gt": {}, "gt_info": {}}
    estimates: list[Estimate] = []
    K = records.camera_matrix(CAMERA)
    for im_id in range(IMAGES):
        posed = [_posed(rng, obj_id) for obj_id in (*PARTS, *rng.choice(PARTS, 3))]
        seen = caster.annotate(CAMERA, None, posed)
        atomic_write(scene.depth(im_id), images.encode_depth(seen.depth_mm, DEPTH_SCALE))
        entries["camera"][im_id] = records.camera_entry(K, np.eye(3), np.array([0.0, 0.0, 600.0]), DEPTH_SCALE)
        entries["gt"][im_id] = [records.gt_entry(p.obj_id, p.R_m2c, p.t_m2c) for p in posed]
        entries["gt_info"][im_id] = [records.gt_info_entry(instance) for instance in seen.instances]
        for truth in posed:
            estimates += [_near(rng, im_id, truth) for _ in range(rng.integers(0, 3))]
    for name, content in entries.items():
        records.write_scene_json(scene.root / f"scene_{name}.json", content)
    results = root / "method_parts-test.csv"
    write_results(results, estimates)
    return Perturbed(dataset, results, estimates, models)


def _posed(rng: np.random.Generator, obj_id: int) -> PosedModel:
    place = np.array([*rng.uniform(-110, 110, 1), *rng.uniform(-80, 80, 1), rng.uniform(450, 600)])
    return PosedModel(int(obj_id), Rotation.random(random_state=rng).as_matrix(), place)


def _near(rng: np.random.Generator, im_id: int, truth: PosedModel) -> Estimate:
    """Off by anything between almost nothing and much."""
    size = 10.0 ** rng.uniform(-2, 1.5)
    turn = Rotation.from_rotvec(np.radians(size) * rng.standard_normal(3)).as_matrix()
    t = truth.t_m2c + size * rng.standard_normal(3)
    return Estimate(1, im_id, truth.obj_id, float(np.round(rng.uniform(), 2)), turn @ truth.R_m2c, t)
