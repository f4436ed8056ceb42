"""Other pictures of the same scenes: a dataset again, as another camera sees it, made from its EXR files.

Nothing is rendered. Poses, masks, depth and labels are those of the dataset, to the byte; masks, depth and models are
shared with it by hard links where the disk allows them.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from synthetless.config import Recipe, dump_recipe, parse_recipe
from synthetless.dataset.labels import refuse_half_labelled
from synthetless.dataset.layout import (
    CAMERA_FILE,
    DATASET_FILE,
    FAILURES_FOLDER,
    MODELS_FOLDER,
    SHEET_FILE,
    SYMMETRIES_FILE,
    plan_image,
)
from synthetless.dataset.reader import read_recipe
from synthetless.dataset.sheet import write_contact_sheet
from synthetless.dataset.store import DatasetStore, encode_rgb, planned_sensor
from synthetless.errors import UserError
from synthetless.io.color import picture
from synthetless.io.files import (
    atomic_folder,
    atomic_write,
    json_bytes,
    link_or_copy,
    locked,
    read_json,
    write_json,
    write_json_lines,
)
from synthetless.io.images import read_exr
from synthetless.io.parallel import each

_LINKED = {".png", ".jpg", ".exr", ".ply"}
"""Files that nobody edits in place. The others are small, and copied."""


@dataclass(frozen=True)
class _Task:
    """An image on its way to a worker process: its number, the dataset and the new one."""

    number: int
    source: DatasetStore
    target: DatasetStore


def redevelop(root: Path, to: Path, overrides: Sequence[str], workers: int | None = None) -> int:
    """Make a dataset that differs from another one in its pictures alone. It is made whole, or not at all.

    Args:
        root: the dataset, made with ``exr`` among its outputs.
        to: the new dataset's folder.
        overrides: ``sensor=NAME`` or ``sensor.KEY=VALUE``; they say all of the sensor, whatever that of ``root`` is.
        workers: processes; one per available core if None.

    Returns:
        How many images there are. The same call gives the same bytes.

    Raises:
        UserError: the dataset has no EXR files, is damaged, half relabelled or in use; an override is wrong, or not
            about the sensor; ``to`` is not a new or empty folder outside ``root``, or cannot be written.
    """
    recipe = _with_sensor(root, read_recipe(root), overrides)
    refuse_half_labelled(root)
    if to.resolve().is_relative_to(root.resolve()):
        raise UserError(f"{to}: lies inside {root}; give a folder outside it")
    source = DatasetStore(root, recipe)
    with _undisturbed(root), atomic_folder(to) as draft:
        numbers = sorted(source.done())
        if not numbers:
            raise UserError(f"{root}: has no images yet")
        target = DatasetStore(draft, recipe)
        _share(source, target)
        write_json(draft / DATASET_FILE, {**read_json(root / DATASET_FILE), "recipe": dump_recipe(recipe)})
        tasks = [_Task(number, source, target) for number in numbers]
        specs: defaultdict[int, list[Any]] = defaultdict(list)
        for number, spec in zip(numbers, each(_develop, tasks, workers, "pictures", "image"), strict=True):
            specs[plan_image(number, recipe.camera.views_per_drop).scene_id].append(spec)
        for scene_id, lines in specs.items():
            write_json_lines(target.scene(scene_id).scene_spec, lines)
        target.finish()
        write_contact_sheet(draft, draft / SHEET_FILE, recipe.split)
    return len(numbers)


def _with_sensor(root: Path, recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """The dataset's recipe with the sensor of the overrides."""
    for override in overrides:
        if override.partition("=")[0].strip().partition(".")[0] != "sensor":
            raise UserError(f"--set {override}: redevelop changes the sensor alone; all else would have to be rendered")
    if "exr" not in recipe.outputs:
        raise UserError(f"{root}: has no EXR files to make pictures from; generate it with exr among the outputs")
    tree = dump_recipe(recipe)
    del tree["sensor"]
    tree["outputs"] = [*recipe.outputs, *({"rgb"} - set(recipe.outputs))]
    revised = parse_recipe(tree, overrides)
    if revised.sensor is None:
        raise UserError("redevelop needs a sensor; add --set sensor=primesense, for one")
    return revised


def _undisturbed(root: Path) -> AbstractContextManager[None]:
    """Keep writers out of a dataset; where nobody may write, there are none."""
    return locked(root) if os.access(root, os.W_OK) else nullcontext()


def _share(source: DatasetStore, target: DatasetStore) -> None:
    """Put everything that does not tell of the pictures into the new dataset."""
    shared = [source.root / name for name in (CAMERA_FILE, SYMMETRIES_FILE, MODELS_FOLDER, FAILURES_FOLDER)]
    for scene in sorted((source.root / source.recipe.split).iterdir()):
        shared += [path for path in scene.iterdir() if path.name not in ("rgb", "scene_spec.jsonl")]
    for path in shared:
        for file in (path, *path.rglob("*")):
            if file.is_file() and file.suffix != ".part":
                _share_file(file, target.root / file.relative_to(source.root))


def _share_file(file: Path, to: Path) -> None:
    if file.suffix in _LINKED:
        link_or_copy(file, to)
        return
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, to)


def _develop(task: _Task) -> Any:
    """Write an image's picture and record; return the record's spec."""
    recipe = task.target.recipe
    plan = plan_image(task.number, recipe.camera.views_per_drop)
    record = read_json(task.source.record(plan.scene_id, plan.im_id))
    sensor = planned_sensor(recipe, plan)
    path = task.source.scene(plan.scene_id).exr(plan.im_id)
    linear = read_exr(path)
    width, height = recipe.camera.width, recipe.camera.height
    if linear.shape[:2] != (height, width):
        raise UserError(f"{path}: has {linear.shape[1]} x {linear.shape[0]} pixels; the recipe says {width} x {height}")
    rgb = picture(linear, record["spec"]["exposure_gain"], sensor)
    record["spec"]["sensor"] = asdict(sensor) if sensor else None
    atomic_write(task.target.scene(plan.scene_id).rgb(plan.im_id, recipe.encoding.rgb_format), encode_rgb(recipe, rgb))
    to = task.target.record(plan.scene_id, plan.im_id)
    atomic_write(to, json_bytes(to, record))
    return record["spec"]
