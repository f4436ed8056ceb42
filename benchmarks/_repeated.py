"""Large datasets without rendering them: the images of a small one, repeated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks import ROOT
from synthetless.config import Recipe, load_recipe
from synthetless.dataset import records
from synthetless.dataset.layout import MODELS_FOLDER, ImagePlan, ScenePaths, plan_image
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.records import ImageRecord
from synthetless.dataset.store import DatasetStore, FinishedImage
from synthetless.generation.generate import Execution, generate
from synthetless.io.files import read_json, read_json_lines
from synthetless.io.models import load_models
from synthetless.io.parallel import usable_cores

_MADE = 8


def generated(root: Path) -> Path:
    """Generate a few images of the paper's recipe, but of the built-in parts and textures."""
    overrides = [f"images={_MADE}", "source.models=builtin", "source.textures=builtin"]
    generate(load_recipe(ROOT / "configs" / "synthetless.yaml", overrides), root, Execution(usable_cores()))
    return root


def repeat(source: Path, root: Path, n_images: int) -> None:
    """Write a dataset of ``n_images``: those of a generated one with at most one scene folder, again and again."""
    recipe = read_recipe(source)
    originals = _images(source, recipe)
    recipe = recipe.model_copy(update={"images": n_images})
    dataset = DatasetStore.open(root, recipe, load_models(source / MODELS_FOLDER), "")
    for number in range(n_images):
        plan = plan_image(number, recipe.camera.views_per_drop)
        dataset.commit(_renumbered(originals[number % len(originals)], plan))
    dataset.assemble()


def _images(dataset: Path, recipe: Recipe) -> list[FinishedImage]:
    scene = ScenePaths.of(dataset, 1, recipe.split)
    cameras, gts = records.read_scene_json(scene.scene_camera), records.read_scene_json(scene.scene_gt)
    infos, specs = records.read_scene_json(scene.scene_gt_info), read_json_lines(scene.scene_spec)
    annotations = read_json(scene.scene_gt_coco)["annotations"]
    for annotation in annotations:
        del annotation["id"]
    return [
        FinishedImage(
            plan_image(im_id, recipe.camera.views_per_drop),
            _files(scene, im_id),
            {
                "camera": cameras[im_id],
                "gt": gts[im_id],
                "gt_info": infos[im_id],
                "coco": [annotation for annotation in annotations if annotation["image_id"] == im_id],
                "spec": next(spec for spec in specs if spec["image_id"] == im_id),
            },
        )
        for im_id in gts
    ]


def _files(scene: ScenePaths, im_id: int) -> Mapping[str, bytes]:
    return {str(path.relative_to(scene.root)): path.read_bytes() for path in scene.root.glob(f"*/{im_id:06d}*")}


def _renumbered(image: FinishedImage, plan: ImagePlan) -> FinishedImage:
    """The same image in another place of the dataset, as if another drop had come to rest the same way."""
    old, new = f"{image.plan.im_id:06d}", f"{plan.im_id:06d}"
    spec = image.record["spec"]
    record: ImageRecord = {
        **image.record,
        "coco": [{**annotation, "image_id": plan.im_id} for annotation in image.record["coco"]],
        "spec": {**spec, "image_id": plan.im_id, "scene": {**spec["scene"], "drop": plan.drop}},
    }
    files = {name.replace(f"/{old}", f"/{new}"): content for name, content in image.files.items()}
    return FinishedImage(plan, files, record)
