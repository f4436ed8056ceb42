"""Makes a dataset: its missing images, drop by drop, until it is complete."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from synthetless.config import Recipe
from synthetless.dataset import records
from synthetless.dataset.layout import DATASET_FILE, FAILURES_FOLDER, SHEET_FILE, Part, by_drop, plan_image, scene_ids
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.sheet import write_contact_sheet
from synthetless.dataset.store import DatasetStore, make_folder
from synthetless.errors import UserError
from synthetless.generation import executors, ray_executor
from synthetless.generation.devices import CPU, Devices
from synthetless.generation.drop import DropRenderer
from synthetless.generation.executors import DropResult, DropTask, WorkerConfig
from synthetless.generation.progress import DONE, FINISHING, READING, Tell, Tracker, silent
from synthetless.generation.sources import Sources, check_pictures, load_sources
from synthetless.io.files import in_turn, locked, remove_file, write_json
from synthetless.io.parallel import usable_cores
from synthetless.scenes.sampling import sample_scene
from synthetless.scenes.spec import plain

_BETWEEN_ASSEMBLIES_S = 60.0


@dataclass(frozen=True)
class Summary:
    """The dataset after a run.

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
    """How the work is done; the files do not depend on it.

    Attributes:
        workers: processes that make drops side by side; None for as many as there are cores, or GPUs.
        threads: of the renderer in each of them; 0 uses every core.
        drop_limit_s: a drop that takes longer is given up.
        part: the share of the drops to make; None for all of them. Other machines may make the others meanwhile.
        devices: what to render on. The same images come from any CPU; those of a GPU differ by some noise.
        preview_every: after the first drop, and whenever so many more images are made, the contact sheet is drawn; 0
            for only in the end.
        cluster: address of the Ray cluster to make them on ("auto" for the one that runs here); None for processes of
            this machine.
    """

    workers: int | None = None
    threads: int = 1
    drop_limit_s: float = 1800.0
    part: Part | None = None
    devices: Devices = CPU
    preview_every: int = 0
    cluster: str | None = None

    @property
    def processes(self) -> int:
        """Number of workers on this machine: one per core, or per GPU, unless given."""
        of_machine = usable_cores() if self.devices.kind == "cpu" else self.devices.count
        return self.workers or of_machine


def generate(recipe: Recipe, out: Path, execution: Execution, tell: Tell = silent) -> Summary:
    """Make the images that the dataset in ``out`` lacks; an interrupted run is continued.

    Args:
        recipe: what to make.
        out: the dataset's folder.
        execution: how.
        tell: is called with where it stands.

    Raises:
        UserError: the recipe's sources or the folder cannot be used, or a file cannot be written.
        BlenderError: Blender cannot be used.
    """
    tracker = Tracker(tell)
    tracker.phase(READING)
    sources = load_sources(recipe, tracker)
    if not (out / DATASET_FILE).exists():
        check_pictures(sources, tracker)
        make_folder(out)
    with locked(out, execution.part.name if execution.part else None):
        with in_turn(out):  # parts that begin at the same moment must be parts of one recipe
            dataset = DatasetStore.open(out, recipe, sources.models, sources.scenery_digest)
        missing = wanted(dataset, execution.part)
        failures = list[DropResult]()
        try:
            if missing:
                failures = _make(dataset, sources, missing, execution, tracker)
        except BaseException:
            with suppress(UserError):  # an interrupted dataset can be looked at, too; the first error is told
                dataset.assemble()
            raise
        tracker.phase(FINISHING)
        dataset.finish()
        summary = _summarise(dataset, len(missing) - len(wanted(dataset, execution.part)), failures)
        if summary.images:
            _draw_sheet(dataset)
    tracker.phase(DONE)
    return summary


def wanted(dataset: DatasetStore, part: Part | None) -> list[int]:
    """Numbers of the images that do not exist yet and belong to this run, ascending."""
    views = dataset.recipe.camera.views_per_drop
    return [number for number in dataset.missing() if part is None or part.takes(plan_image(number, views).drop)]


def retry(out: Path, drop: int, textures: str | None = None) -> int:
    """Make the images of one drop again in this process, with all cores, and put them where they are missing.

    Args:
        out: the dataset's folder.
        drop: number of the drop.
        textures: folder of the photographs, if it has moved since.

    Returns:
        How many images were made.

    Raises:
        DropFailed: it does not come to rest.
        UserError: the dataset, or what it was made from, cannot be used.
    """
    recipe = read_recipe(out)
    if textures is not None:
        recipe = recipe.model_copy(update={"source": recipe.source.model_copy(update={"textures": textures})})
    sources = load_sources(recipe)
    with locked(out):
        dataset = DatasetStore.open(out, recipe, sources.models, sources.scenery_digest)
        views, images = recipe.camera.views_per_drop, dataset.recipe.images
        plans = [plan_image(number, views) for number in range(drop * views, min((drop + 1) * views, images))]
        if not plans:
            raise UserError(f"{out}: has no drop {drop}; its {images} images show the drops from 0 on")
        for image in DropRenderer(recipe, sources).make(drop, plans):
            dataset.commit(image)
        remove_file(_failure_note(out, drop))
        dataset.finish()
    return len(plans)


def _make(
    dataset: DatasetStore, sources: Sources, missing: list[int], execution: Execution, tracker: Tracker
) -> list[DropResult]:
    """Make the missing images; return the drops that failed, in their order."""
    failures: list[DropResult] = []
    views = dataset.recipe.camera.views_per_drop
    tasks = (DropTask(drop, tuple(images)) for drop, images in by_drop(missing, views))
    next_sheet: float = 1 if execution.preview_every else math.inf
    made = 0
    tracker.want(len(missing))
    with closing(_results(dataset, tasks, execution, tracker)) as results:  # closed: no worker continues after an error
        assembled = time.monotonic()
        for result in results:
            made += result.made
            tracker.ended(len(result.task.images), result.made, bool(result.failure))
            _note_failure(dataset, sources, result)
            if result.failure:
                failures.append(result)
            if made >= next_sheet or time.monotonic() - assembled > _BETWEEN_ASSEMBLIES_S:
                dataset.assemble()
                assembled = time.monotonic()
            if made >= next_sheet:
                _draw_sheet(dataset)
                next_sheet = made + execution.preview_every
    return sorted(failures, key=lambda result: result.task.drop)


def _results(
    dataset: DatasetStore, tasks: Iterable[DropTask], execution: Execution, tracker: Tracker
) -> Generator[DropResult, None, None]:
    config = WorkerConfig(dataset.recipe, dataset.root, execution.threads, execution.drop_limit_s, execution.devices)
    if execution.cluster is not None:
        return ray_executor.run(tasks, config, execution.cluster, execution.workers, tracker.watch)
    return executors.run(tasks, config, execution.processes, tracker.watch)


def _draw_sheet(dataset: DatasetStore) -> None:
    if "rgb" in dataset.recipe.outputs:
        with in_turn(dataset.root):  # or the sheet of another part, drawn of fewer images, might come last
            write_contact_sheet(dataset.root, dataset.root / SHEET_FILE, dataset.recipe.split)


def _note_failure(dataset: DatasetStore, sources: Sources, result: DropResult) -> None:
    """Write a note of a failed drop, with the scene that it began with; remove that of one that has been made."""
    drop, recipe = result.task.drop, dataset.recipe
    path = _failure_note(dataset.root, drop)
    if result.failure:
        scene = sample_scene(recipe, sources.catalogue, recipe.seed, drop)
        write_json(path, {"drop": drop, "failure": result.failure, "scene": plain(scene)})
    else:
        remove_file(path)


def _failure_note(root: Path, drop: int) -> Path:
    return root / FAILURES_FOLDER / f"{drop:08d}.json"


def _summarise(dataset: DatasetStore, made: int, failures: list[DropResult]) -> Summary:
    images, fractions = 0, []
    made_any = (dataset.root / dataset.recipe.split).is_dir()
    for scene_id in scene_ids(dataset.root, dataset.recipe.split) if made_any else []:
        infos = records.read_scene_json(dataset.scene(scene_id).scene_gt_info)
        images += len(infos)
        fractions += [entry["visib_fract"] for entries in infos.values() for entry in entries]
    mean = sum(fractions) / len(fractions) if fractions else 0.0
    told = tuple(
        f"drop {result.task.drop}: {result.failure}; try it alone: synthetless redo {dataset.root} {result.task.drop}"
        for result in failures
    )
    return Summary(images, len(fractions), made, mean, told)
