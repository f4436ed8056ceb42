"""A small valid dataset without Blender: objects laid on the table, measured by ray casting, noise for colours."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import ImageAnnotation, PosedModel
from synthetless.annotation.raycast import Plane
from synthetless.annotation.scene import annotate_scene, scene_caster
from synthetless.config import Recipe, load_recipe
from synthetless.dataset import records
from synthetless.dataset.layout import ImagePlan, ScenePaths, by_drop, scene_ids
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.store import DatasetStore, FinishedImage, planned_depth_sensor
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.rotations import matrix
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.spec import Pose, Role, SceneSpec

IMAGES, IMAGES_PER_SCENE = 6, 3
RECIPE = (
    f"images={IMAGES}",
    "camera.width=128",
    "camera.height=96",
    "camera.fx=300",
    "camera.fy=298",
    "camera.cx=63.2",
    "camera.cy=47.7",
    "camera.distance_m=[0.35, 0.5]",
    "camera.elevation_deg=[35, 80]",
    "camera.views_per_drop=2",
    "objects.count=[4, 6]",
    "labels.visibility_delta_mm=0",
    "source.licence=CC0 1.0, made for the tests",
)
TURNS = {1: [], 2: [np.diag([1, -1, -1])], 3: [np.diag([-1, -1, 1])]}


def write_models(folder: Path) -> Path:
    """An angle without symmetries, a cylinder (O(2)) and a box that is declared C2."""
    folder.mkdir(parents=True)
    foot = trimesh.creation.box((50, 20, 10))
    arm = trimesh.creation.box((12, 16, 30)).apply_translation((-19, 2, 20))
    meshes = {
        1: trimesh.util.concatenate([foot, arm]),
        2: trimesh.creation.cylinder(radius=16, height=42, sections=48),
        3: trimesh.creation.box((44, 30, 18)),
    }
    infos: dict[str, Any] = {}
    for obj_id, mesh in meshes.items():
        mesh.export(folder / f"obj_{obj_id:06d}.ply")
        corners = mesh.vertices.astype(np.float32).astype(np.float64)  # as the file has them
        info: dict[str, Any] = {"diameter": float(max(np.linalg.norm(a - corners, axis=1).max() for a in corners))}
        for axis, low, size in zip("xyz", corners.min(axis=0), np.ptp(corners, axis=0), strict=True):
            info |= {f"min_{axis}": float(low), f"size_{axis}": float(size)}
        if TURNS[obj_id]:
            motions = [np.block([[R, np.zeros((3, 1))], [np.eye(4)[3:]]]) for R in TURNS[obj_id]]
            info["symmetries_discrete"] = [motion.ravel().tolist() for motion in motions]
        if obj_id == 2:
            info["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
        infos[str(obj_id)] = info
    (folder / "models_info.json").write_text(json.dumps(infos))
    return folder


def write_distractors(folder: Path) -> Path:
    """One ball."""
    folder.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=2, radius=14).export(folder / "obj_000001.ply")
    box = {f"min_{axis}": -14.0 for axis in "xyz"} | {f"size_{axis}": 28.0 for axis in "xyz"}
    (folder / "models_info.json").write_text(json.dumps({"1": {"diameter": 28.0, **box}}))
    return folder


@contextmanager
def small_scene_folders() -> Iterator[None]:
    """Plan so few images a scene folder that a few fill several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("synthetless.dataset.layout.IMAGES_PER_SCENE", IMAGES_PER_SCENE)
        yield


@small_scene_folders()
def write_dataset(root: Path, models_folder: Path, overrides: Sequence[str] = (), seed: int = 5) -> DatasetStore:
    """A complete dataset of random colours and true everything else."""
    recipe = load_recipe(None, [*RECIPE, f"seed={seed}", *overrides])
    maker = _Maker(recipe, load_models(models_folder, colours=recipe.objects.colour != "grey"))
    dataset = DatasetStore.open(root, recipe, maker.models, "")
    for drop, plans in by_drop(range(recipe.images), recipe.camera.views_per_drop):
        for image in maker.make(drop, plans):
            dataset.commit(image)
    dataset.assemble()
    return dataset


def ray_cast(root: Path, models_folder: Path) -> dict[tuple[int, int], ImageAnnotation]:
    """What ray casting says of each image, by scene folder and image id, from its camera and poses."""
    models = load_models(models_folder)
    caster = scene_caster({"model": models})
    recipe = read_recipe(root)
    seen = {}
    for scene_id in scene_ids(root):
        scene = ScenePaths.of(root, scene_id)
        cameras = records.read_scene_json(scene.scene_camera)
        for im_id, gt in records.read_scene_json(scene.scene_gt).items():
            R_w2c, t_w2c = np.reshape(cameras[im_id]["cam_R_w2c"], (3, 3)), np.array(cameras[im_id]["cam_t_w2c"])
            posed = [
                PosedModel(pose["obj_id"], np.reshape(pose["cam_R_m2c"], (3, 3)), np.array(pose["cam_t_m2c"]))
                for pose in gt
            ]
            table = Plane(R_w2c, t_w2c, 500 * recipe.table.size_m)
            seen[scene_id, im_id] = caster.annotate(recipe.intrinsics, table, posed)
    return seen


class _Maker:
    """Does what a DropRenderer does, with a draw in place of physics and noise in place of light."""

    def __init__(self, recipe: Recipe, models: Mapping[int, ObjectModel]) -> None:
        self._recipe, self.models = recipe, models
        distractors: Mapping[int, ObjectModel] = {}
        if recipe.source.distractors is not None:
            distractors = load_models(Path(recipe.source.distractors))
        self._of_role: dict[Role, Mapping[int, ObjectModel]] = {"model": models, "distractor": distractors}
        self._caster = scene_caster(self._of_role)

    def make(self, drop: int, plans: Sequence[ImagePlan]) -> list[FinishedImage]:
        models, distractors = ({i: m.diameter_mm / 1000 for i, m in of.items()} for of in self._of_role.values())
        spec = sample_scene(self._recipe, Catalogue(models, distractors), self._recipe.seed, drop)
        settled = self._lay_down(spec, np.random.default_rng([self._recipe.seed, drop]))
        return [self._image(plan, spec, settled) for plan in plans]

    def _lay_down(self, spec: SceneSpec, rng: np.random.Generator) -> tuple[Pose, ...]:
        """Anywhere, in any pose that touches the table."""
        poses = []
        for item in spec.objects:
            x, y, z, w = Rotation.random(random_state=rng).as_quat()
            wxyz = (float(w), float(x), float(y), float(z))
            low = (self._of_role[item.role][item.obj_id].vertices_mm @ matrix(wxyz)[2]).min()
            u, v = rng.uniform(-0.07, 0.07, 2)
            poses.append(Pose(wxyz, (float(u), float(v), float(-low / 1000))))
        return tuple(poses)

    def _image(self, plan: ImagePlan, spec: SceneSpec, settled: tuple[Pose, ...]) -> FinishedImage:
        camera = self._recipe.camera
        light = np.random.default_rng([plan.number, 1]).random((camera.height, camera.width, 3)).astype(np.float32)
        depth_sensor = planned_depth_sensor(self._recipe, plan)
        annotated = annotate_scene(self._caster, self._recipe, spec, settled, plan.view, depth_sensor)
        return FinishedImage.of(self._recipe, plan, spec, settled, annotated, light)
