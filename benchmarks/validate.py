"""Time the validation of a dataset: ``python -m benchmarks.validate [DATASET] [--images 2000]``.

The images of a generated dataset (a few of the paper's recipe are made if none is given) are repeated until there are
enough, each with labels and a record of its own, and the whole is validated on every core. The starting of the workers
is included, so that the extrapolation is on the safe side. The files are in the page cache; from a disk that is slower
than the cores, reading sets the pace.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from benchmarks import ROOT, keep
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
from synthetless.validation import validate

PAPERS_IMAGES = 30_000
MADE = 8


def main() -> None:
    """Measure, print, write benchmarks/results/validate.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?", help="what generate made, with at most one scene folder")
    parser.add_argument("--images", type=int, default=2000, help="how many to repeat its images to")
    given = parser.parse_args()
    cores = usable_cores()
    with tempfile.TemporaryDirectory() as folder:
        source = given.dataset or _generate(Path(folder) / "made", cores)
        root = Path(folder) / "repeated"
        _repeat(source, root, given.images)
        before, start = _cpu_s(), time.perf_counter()
        report = validate(root, workers=cores)
        wall_s, cpu_s = time.perf_counter() - start, _cpu_s() - before
    if not report.valid:
        raise SystemExit("\n".join(report.lines()))
    files = 2 + 2 * report.instances / report.images
    result = {
        "images": report.images,
        "files_per_image": round(files, 1),
        "cores": cores,
        "wall_s": round(wall_s, 1),
        "cpu_ms_per_image": round(1000 * cpu_s / report.images, 1),
        "minutes_for_30000_images_as_measured": round(PAPERS_IMAGES * wall_s / report.images / 60, 2),
        "minutes_for_30000_images_if_nothing_else_ran": round(PAPERS_IMAGES * cpu_s / cores / report.images / 60, 2),
    }
    for name, value in result.items():
        print(f"{name:46} {value}")
    keep("validate", result)


def _generate(root: Path, cores: int) -> Path:
    """A few images of the paper's recipe, but of the built-in parts and textures."""
    overrides = [f"images={MADE}", "source.models=builtin", "source.textures=builtin"]
    generate(load_recipe(ROOT / "configs" / "synthetless.yaml", overrides), root, Execution(cores))
    return root


def _repeat(source: Path, root: Path, n_images: int) -> None:
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


def _cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


if __name__ == "__main__":
    main()
