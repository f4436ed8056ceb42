"""Makes a dataset: what is missing of it, drop by drop, until it is complete."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from generator.config import Recipe
from generator.dataset import DATASET_FILE, Dataset
from generator.formats import bop
from generator.locks import locked
from generator.plan import Part, by_drop, plan_image
from generator.sources import check_photos, load_sources
from generator.workers import Job, Outcome, Workplace, run

_DROPS_BETWEEN_ASSEMBLIES = 50


@dataclass(frozen=True)
class Summary:
    """What there is after a run.

    Attributes:
        images, instances: in the whole dataset.
        made: images made by this run.
        mean_visib_fract: over all instances, 0 if there are none.
        failures: one line for each drop that failed.
    """

    images: int
    instances: int
    made: int
    mean_visib_fract: float
    failures: tuple[str, ...]


@dataclass(frozen=True)
class Execution:
    """How the work is done; nothing of it changes what is made.

    Attributes:
        workers: processes that make drops side by side.
        threads: of the renderer in each of them; 0 uses every core.
        drop_limit_s: a drop that takes longer is given up.
        part: the share of the drops to make; None for all of them. Other machines may make the others meanwhile.
    """

    workers: int = 1
    threads: int = 1
    drop_limit_s: float = 1800.0
    part: Part | None = None


def generate(recipe: Recipe, out: Path, execution: Execution) -> Summary:
    """Make the images that the dataset in ``out`` lacks; an interrupted run is gone on with.

    Args:
        recipe: what to make.
        out: the dataset's folder.
        execution: how.

    Raises:
        ValueError: the recipe's sources or the folder cannot be used, or a file cannot be written.
        BlenderError: Blender cannot be used.
    """
    sources = load_sources(recipe)
    if not (out / DATASET_FILE).exists():
        check_photos(sources)
    dataset = Dataset.open(out, recipe, sources.models, sources.photos_digest)
    with locked(out, execution.part):
        missing = _wanted(dataset, execution.part)
        failures: list[Outcome] = []
        try:
            if missing:
                failures = _make(dataset, missing, execution)
        finally:  # an interrupted dataset can be looked at, too
            dataset.assemble()
    return _summarise(dataset, len(missing) - len(_wanted(dataset, execution.part)), failures)


def _wanted(dataset: Dataset, part: Part | None) -> list[int]:
    """Numbers of the images that do not exist yet and are this run's to make."""
    views = dataset.recipe.camera.views_per_drop
    return [number for number in dataset.missing() if part is None or part.takes(plan_image(number, views).drop)]


def _make(dataset: Dataset, missing: list[int], execution: Execution) -> list[Outcome]:
    """Make the missing images; return the drops that failed, in their order."""
    failures: list[Outcome] = []
    jobs = [Job(drop, tuple(images)) for drop, images in by_drop(missing, dataset.recipe.camera.views_per_drop)]
    place = Workplace(dataset.recipe, dataset.root, execution.threads, execution.drop_limit_s)
    with tqdm(total=len(missing), unit="image", mininterval=0.5, smoothing=0.05) as bar:
        for count, outcome in enumerate(run(jobs, place, min(execution.workers, len(jobs))), start=1):
            bar.update(outcome.made)
            if outcome.failure:
                failures.append(outcome)
                bar.set_postfix(failed=len(failures))
            if count % _DROPS_BETWEEN_ASSEMBLIES == 0:
                dataset.assemble()
    return sorted(failures, key=lambda outcome: outcome.job.drop)


def _summarise(dataset: Dataset, made: int, failures: list[Outcome]) -> Summary:
    images, fractions = 0, []
    for scene_id in bop.scene_ids(dataset.root, dataset.recipe.split):
        infos = bop.read_scene_json(dataset.scene(scene_id).scene_gt_info)
        images += len(infos)
        fractions += [entry["visib_fract"] for entries in infos.values() for entry in entries]
    mean = sum(fractions) / len(fractions) if fractions else 0.0
    return Summary(images, len(fractions), made, mean, tuple(f"drop {o.job.drop}: {o.failure}" for o in failures))
