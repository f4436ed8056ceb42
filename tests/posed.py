"""Datasets of random poses, for what is done to labels: the pictures in them are a few bytes that nobody looks at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from synthetless.config import load_recipe
from synthetless.dataset import records
from synthetless.dataset.layout import plan_image
from synthetless.dataset.records import Entry
from synthetless.dataset.store import DatasetStore, FinishedImage
from synthetless.io.models import ObjectModel

K = np.array([[1075.65, 0.0, 360.0], [0.0, 1073.9, 270.0], [0.0, 0.0, 1.0]])
NUMBERS = (0, 1, 2, 1000, 1001, 2000)
"""Of images that lie in three scene folders."""


def random_poses(rng: np.random.Generator, obj_ids: Sequence[int], count: int) -> list[Entry]:
    """``count`` entries of scene_gt.json."""
    rotations = Rotation.random(count, random_state=rng).as_matrix()
    places_mm = rng.uniform([-150, -150, 650], [150, 150, 900], (count, 3))
    chosen = rng.choice(obj_ids, count)
    return [records.gt_entry(int(obj_id), R, t) for obj_id, R, t in zip(chosen, rotations, places_mm, strict=True)]


def random_camera(rng: np.random.Generator) -> Entry:
    """An entry of scene_camera.json; the focal length varies, so that a camera mixed up is noticed."""
    focal = np.diag([rng.uniform(0.9, 1.1), rng.uniform(0.9, 1.1), 1.0])
    return records.camera_entry(K @ focal, np.eye(3), np.array([0.0, 0.0, 700.0]), 0.1)


def open_dataset(root: Path, models: Mapping[int, ObjectModel], images: int = 2001) -> DatasetStore:
    """Begin a dataset, or go on with one."""
    return DatasetStore.open(root, load_recipe(None, [f"images={images}", "outputs=[rgb]"]), models, "")


def commit(
    dataset: DatasetStore, obj_ids: Sequence[int], numbers: Iterable[int] = NUMBERS, instances: int = 12
) -> None:
    """Put images on disk; each follows from its number."""
    info: Entry = {"px_count_all": 9, "px_count_valid": 9, "px_count_visib": 9, "visib_fract": 1.0}
    info |= {"bbox_obj": [1, 1, 3, 3], "bbox_visib": [1, 1, 3, 3]}
    for number in numbers:
        rng, plan = np.random.default_rng(number), plan_image(number, 1)
        files = {f"rgb/{plan.im_id:06d}.png": f"picture {number}".encode()}
        gt = random_poses(rng, obj_ids, instances)
        spec = {"image_id": plan.im_id}
        record = {"camera": random_camera(rng), "gt": gt, "gt_info": [info] * instances, "coco": [], "spec": spec}
        dataset.commit(FinishedImage(plan, files, record))
