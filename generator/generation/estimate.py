"""What a dataset would take, before it is made: images, drops, time and disk."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from synthetless.config import Recipe
from synthetless.dataset.layout import DATASET_FILE, IMAGES_PER_SCENE, MODELS_FOLDER, plan_image
from synthetless.dataset.store import DatasetStore
from synthetless.errors import UserError
from synthetless.generation import devices
from synthetless.generation.drop import DropRenderer
from synthetless.generation.generate import Execution, wanted
from synthetless.generation.progress import READING, STARTING, Tell, Tracker, silent
from synthetless.generation.sources import Sources, check_pictures, load_sources
from synthetless.io.files import nearest_existing

_PROBES = 2


@dataclass(frozen=True)
class Estimate:
    """The images that are missing, and what it takes to make them.

    Attributes:
        images, drops: still to be made.
        existing: images that are there already.
        scene_folders: of the whole dataset.
        views_per_drop: images of one drop.
        device: what is rendered on.
        workers: processes.
        seconds_per_image: of one worker, its share of the drop included, as measured on two images.
        hours: for all that is still to be made, if the workers do not hinder each other.
        bytes_per_image: all files of one.
        disk_bytes: for all that is still to be made, and the models.
        free_bytes: on the disk of the dataset's folder.
    """

    images: int
    drops: int
    existing: int
    scene_folders: int
    views_per_drop: int
    device: str
    workers: int
    seconds_per_image: float
    hours: float
    bytes_per_image: int
    disk_bytes: int
    free_bytes: int

    def __str__(self) -> str:
        views = f" of {self.views_per_drop} views each" if self.views_per_drop > 1 else ""
        spare = "" if self.disk_bytes < self.free_bytes else " - NOT ENOUGH"
        return "\n".join(
            [
                f"images  {self.images} to make in {self.drops} drops{views}; {self.existing} are there already",
                f"folders {self.scene_folders}, of {IMAGES_PER_SCENE} images",
                f"device  {self.device}, {self.workers} worker{'s' if self.workers > 1 else ''}",
                f"time    about {_duration(3600 * self.hours)}; "
                f"{self.seconds_per_image:.1f} s an image in each worker, as just measured on {_PROBES}",
                f"disk    about {_size(self.disk_bytes)}, {_size(self.bytes_per_image)} an image; "
                f"{_size(self.free_bytes)} are free{spare}",
            ]
        )


def estimate(recipe: Recipe, out: Path, execution: Execution, tell: Tell = silent) -> Estimate:
    """Make a few images, keep none, and estimate what all of them would take.

    Raises:
        UserError: the work is for a cluster, or the recipe's sources or the folder cannot be used.
        BlenderError: Blender cannot be used.
        DropFailed: an image could not be made.
    """
    if execution.cluster is not None:
        raise UserError("--dry-run measures this machine; leave out --executor ray")
    tracker = Tracker(tell)
    tracker.phase(READING)
    sources = load_sources(recipe)
    check_pictures(sources, tracker)
    dataset = DatasetStore(out, recipe)
    if (out / DATASET_FILE).exists():
        dataset = DatasetStore.begun(out, recipe, sources.models, sources.scenery_digest)
    done, missing = dataset.done(), wanted(dataset, execution.part)
    views = recipe.camera.views_per_drop
    drops = {plan_image(number, views).drop for number in missing}
    per_drop_s, per_image_s, image_bytes = _measure(recipe, sources, execution, sorted(drops)[:_PROBES], tracker)
    seconds = len(drops) * per_drop_s + len(missing) * per_image_s
    models = 0 if (out / MODELS_FOLDER).exists() else sum(m.path.stat().st_size for m in sources.models.values())
    return Estimate(
        images=len(missing),
        drops=len(drops),
        existing=len(done),
        scene_folders=-(-dataset.recipe.images // IMAGES_PER_SCENE),
        views_per_drop=views,
        device=execution.devices.kind,
        workers=execution.processes,
        seconds_per_image=seconds / max(len(missing), 1),
        hours=seconds / execution.processes / 3600,
        bytes_per_image=image_bytes,
        disk_bytes=len(missing) * image_bytes + models,
        free_bytes=shutil.disk_usage(nearest_existing(out)).free,
    )


def _measure(
    recipe: Recipe, sources: Sources, execution: Execution, drops: list[int], tracker: Tracker
) -> tuple[float, float, int]:
    """Seconds of a drop, seconds and bytes of an image of it; what is done only once is not counted."""
    if not drops:
        return 0.0, 0.0, 0
    tracker.phase(STARTING)
    renderer = DropRenderer(recipe, sources, execution.threads, devices.take(execution.devices))
    dropping, making, size = 0.0, 0.0, 0
    views = recipe.camera.views_per_drop
    tracker.phase("measuring")
    list(renderer.make(drops[0], [plan_image(drops[0] * views, views)]))  # so that a GPU has compiled its programs
    for number, drop in enumerate(drops, start=1):
        tracker.phase("measuring", f"{number} of {len(drops)} images")
        plan = plan_image(drop * views, views)
        renderer.drop(drop)  # the objects' colliders are made once and kept
        began = time.perf_counter()
        renderer.drop(drop)
        dropped = time.perf_counter()
        (image,) = renderer.make(drop, [plan])
        dropping += dropped - began
        making += time.perf_counter() - dropped - (dropped - began)
        size += sum(len(content) for content in image.files.values())
    return dropping / len(drops), max(making, 0.0) / len(drops), size // len(drops)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _size(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
