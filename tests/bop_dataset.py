"""A small dataset on disk: posed meshes, measured by ray casting, with every file that the exports read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import ImageAnnotation, PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.dataset import records
from synthetless.dataset.layout import CAMERA_FILE, ScenePaths
from synthetless.dataset.records import CanonicalEntry, CocoAnnotation
from synthetless.io import images
from synthetless.io.files import atomic_write, write_json
from synthetless.scenes.spec import Intrinsics

CAMERA = Intrinsics(64, 48, 120.0, 118.0, 31.0, 24.5)
DEPTH_SCALE = 0.1
SCENES, IMAGES = 2, 3

BuildDataset = Callable[[Path, str], Path]

MESHES = {
    1: trimesh.creation.box((60.0, 40.0, 30.0)),
    2: trimesh.creation.cylinder(radius=20.0, height=50.0),
    5: trimesh.creation.icosphere(subdivisions=2, radius=25.0),
}


def _poses(generator: np.random.Generator, count: int) -> list[PosedModel]:
    """So many objects in the middle, one wholly hidden behind them and one that the border cuts."""
    x, y = generator.uniform(-70, 70, count), generator.uniform(-50, 50, count)
    middle = np.column_stack([x, y, np.full(count, 500.0)])
    places = [*middle, 11 * middle[0], [-125, 0, 480]]
    obj_ids = [*generator.choice([1, 2, 5], count), 1, 2]
    rotations = Rotation.random(len(places), random_state=generator).as_matrix()
    return [PosedModel(int(o), R, np.asarray(t)) for o, R, t in zip(obj_ids, rotations, places, strict=True)]


def _canonical(posed: PosedModel, index: int) -> CanonicalEntry:
    """A label of the right form; what is in it does not matter to the formats."""
    corners = np.array([[x, y, z] for x in (-20, 20) for y in (-15, 15) for z in (-10, 10)])
    pixels = (corners @ posed.R_m2c.T + posed.t_m2c) @ records.camera_matrix(CAMERA).T
    return {
        "obj_id": posed.obj_id,
        "cam_R_m2c_canonical": posed.R_m2c.reshape(9).tolist(),
        "cam_t_m2c_canonical": posed.t_m2c.tolist(),
        "regressor_index": index,
        "n_regressors": 2,
        "discontinuity_margin_deg": 12.5,
        "bbox3d_corners_2d": (pixels[:, :2] / pixels[:, 2:]).tolist(),
    }


def _write_image(scene: ScenePaths, im_id: int, seen: ImageAnnotation, rgb: NDArray[np.uint8], extension: str) -> None:
    encoded = images.encode_png(rgb) if extension == "png" else images.encode_jpeg(rgb, 90)
    atomic_write(scene.rgb(im_id, extension), encoded)
    atomic_write(scene.depth(im_id), images.encode_depth(seen.depth_mm, DEPTH_SCALE))
    for gt_id, instance in enumerate(seen.instances):
        atomic_write(scene.mask(im_id, gt_id), images.encode_mask(instance.mask))
        atomic_write(scene.mask_visib(im_id, gt_id), images.encode_mask(instance.mask_visib))


def _write_scene(scene: ScenePaths, caster: RayCaster, generator: np.random.Generator, extension: str) -> None:
    entries: dict[str, dict[int, Any]] = {name: {} for name in ("camera", "gt", "info", "canonical")}
    coco: list[CocoAnnotation] = []
    camera = records.camera_entry(records.camera_matrix(CAMERA), np.eye(3), np.array([0.0, 0.0, 600.0]), DEPTH_SCALE)
    for im_id in range(IMAGES):
        last = scene.root.name == f"{SCENES:06d}" and im_id == IMAGES - 1
        poses = _poses(generator, count=4 if last else 2)
        seen = caster.annotate(CAMERA, None, poses)
        rgb = generator.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        _write_image(scene, im_id, seen, rgb, extension)
        entries["camera"][im_id] = camera
        entries["gt"][im_id] = [records.gt_entry(posed.obj_id, posed.R_m2c, posed.t_m2c) for posed in poses]
        entries["info"][im_id] = [records.gt_info_entry(instance) for instance in seen.instances]
        entries["canonical"][im_id] = [_canonical(posed, number % 2) for number, posed in enumerate(poses)]
        coco += records.coco_annotations(im_id, [posed.obj_id for posed in poses], seen.instances)
    records.write_scene_json(scene.scene_camera, entries["camera"])
    records.write_scene_json(scene.scene_gt, entries["gt"])
    records.write_scene_json(scene.scene_gt_info, entries["info"])
    records.write_scene_json(scene.scene_gt_canonical, entries["canonical"])
    listed = [records.coco_image(i, scene.rgb(i, extension), CAMERA.width, CAMERA.height) for i in range(IMAGES)]
    write_json(scene.scene_gt_coco, records.scene_gt_coco("parts", MESHES, listed, coco))


@pytest.fixture(scope="session")
def build_dataset() -> BuildDataset:
    """Build the dataset into a folder, with png or jpg images; the same every time."""

    def build(root: Path, extension: str = "png") -> Path:
        generator = np.random.default_rng(7)
        caster = RayCaster({("model", obj_id): (mesh.vertices, mesh.faces) for obj_id, mesh in MESHES.items()})
        for scene_id in range(1, SCENES + 1):
            _write_scene(ScenePaths.of(root, scene_id), caster, generator, extension)
        write_json(root / CAMERA_FILE, records.camera_json(CAMERA, DEPTH_SCALE))
        write_json(root / "dataset.json", {"name": "parts", "licence": "CC0, made for the tests"})
        write_json(root / "symmetries.json", {"scheme": "pitteri2019"})
        return root

    return build


@pytest.fixture(scope="session")
def dataset(build_dataset: BuildDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset as built, for tests that only read it."""
    return build_dataset(tmp_path_factory.mktemp("bop") / "parts", "png")
