"""What a large dataset costs beside its images: ``python -m benchmarks.resume [--images 1000000] [--to DIR]``.

Half of the records exist (as links to one, so that making them is quick). Measured are the scan for what is missing
with the planning of its drops, and one periodic assembly after one more image, with few and with many folders finished.
Prints seconds and the largest memory, and writes benchmarks/results/resume.json.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import ROOT, keep
from synthetless.annotation.scene import annotate_scene, scene_caster
from synthetless.config import Recipe, load_recipe
from synthetless.dataset.layout import IMAGES_PER_SCENE, by_drop, plan_image
from synthetless.dataset.store import DatasetStore, FinishedImage
from synthetless.generation.executors import DropTask
from synthetless.generation.generate import wanted
from synthetless.generation.sources import Sources, load_sources
from synthetless.scenes.sampling import sample_scene

FINISHED = (1, 10, 100)
"""Scene folders that are finished while an assembly is measured."""


def main() -> None:
    """Measure, print, write."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--images", type=int, default=1_000_000)
    options.add_argument("--to", help="folder for the files; default: the system's for temporary ones")
    arguments = options.parse_args()
    recipe = load_recipe(ROOT / "configs" / "demo.yaml", [f"images={arguments.images}", "outputs=[depth]"])
    with tempfile.TemporaryDirectory(dir=arguments.to) as folder:
        sources = load_sources(recipe)
        dataset = DatasetStore.open(Path(folder) / "d", recipe, sources.models, sources.scenery_digest)
        record = _record(dataset, recipe, sources)
        scenes = arguments.images // IMAGES_PER_SCENE
        assemblies = {}
        made = 0
        for finished in (count for count in FINISHED if count < scenes):
            _fill(dataset, record, range(made, finished))
            made = finished
            dataset.assemble()
            _link(record, dataset.record(finished + 1, 0))
            assemblies[finished * IMAGES_PER_SCENE] = _seconds(dataset.assemble)
            print(f"assembly after one more image: {assemblies[finished * IMAGES_PER_SCENE]:.3f} s, {finished} folders")
        _fill(dataset, record, range(made, scenes // 2))
        planned = 0

        def plan() -> None:
            nonlocal planned
            missing = wanted(dataset, None)
            tasks = (DropTask(drop, tuple(images)) for drop, images in by_drop(missing, recipe.camera.views_per_drop))
            planned = sum(len(task.images) for task in tasks)

        seconds = _seconds(plan)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{planned} of {arguments.images} images found missing and planned in {seconds:.1f} s, {peak_mb:.0f} MB")
        keep("resume", {"images": arguments.images, "plan_s": seconds, "peak_mb": peak_mb, "assembly_s": assemblies})


def _record(dataset: DatasetStore, recipe: Recipe, sources: Sources) -> Path:
    """Commit image 0 as a scene that has not been dropped; its record."""
    plan = plan_image(0, recipe.camera.views_per_drop)
    spec = sample_scene(recipe, sources.catalogue, recipe.seed, 0)
    settled = [item.release for item in spec.objects]
    annotated = annotate_scene(scene_caster({"model": sources.models}), recipe, spec, settled, plan.view)
    linear = np.zeros((recipe.camera.height, recipe.camera.width, 3), dtype=np.float32)
    dataset.commit(FinishedImage.of(recipe, plan, spec, settled, annotated, linear))
    return dataset.record(plan.scene_id, plan.im_id)


def _fill(dataset: DatasetStore, record: Path, scenes: range) -> None:
    for scene in scenes:
        for im_id in range(IMAGES_PER_SCENE):
            _link(record, dataset.record(scene + 1, im_id))


def _link(record: Path, to: Path) -> None:
    """A link where there is none yet; a copy now and then, since a file cannot have more than some thousand links."""
    if to.exists():
        return
    to.parent.mkdir(parents=True, exist_ok=True)
    first = to.with_name("000000.json")
    if to == first:
        to.write_bytes(record.read_bytes())
    else:
        os.link(first, to)


def _seconds(function: object) -> float:
    began = time.perf_counter()
    assert callable(function)
    function()
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
