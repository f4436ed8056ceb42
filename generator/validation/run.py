"""Validates a dataset: hands the scene folders to workers and puts together what they find."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from synthetless.dataset.layout import DATASET_FILE, ImagePlan
from synthetless.errors import UserError
from synthetless.io.parallel import Map, processes, watched
from synthetless.validation.adopted import AdoptedTask, check_adopted_scene, is_adopted, left_out, read_adopted
from synthetless.validation.coco_export import check_coco_export
from synthetless.validation.deep import DeepTask, check_deep, sample
from synthetless.validation.report import KINDS, Finding, Report, Tally
from synthetless.validation.scene import SceneResult, SceneTask, check_scene
from synthetless.validation.source import (
    Source,
    check_counts,
    check_folders,
    plans_by_scene,
    read_header,
    read_source,
)
from synthetless.validation.webdataset import Shards, ShardsTask, by_scene, check_companions, check_shards

_DEEP_IMAGES_PER_TASK = 25
_TASKS_ENOUGH, _IMAGES_WORTH_A_TASK = 4, 100
"""Whatever the number of processes, so that the same faults are told: each task reads all labels of its folder."""


def validate(
    dataset: Path,
    deep: bool = False,
    exports: Sequence[Path] = (),
    limit: int = 20,
    workers: int | None = None,
    deep_images: int = 100,
) -> Report:
    """Check a dataset, and exports made from it; or what can be checked of a dataset that ``adopt`` labelled.

    Args:
        dataset: its folder, as ``generate`` fills it, or as ``adopt`` leaves it.
        deep: also cast the rays of some images again.
        exports: COCO files and folders of shards that were made from the dataset.
        limit: how many faults of each kind to report in full; all are counted.
        workers: processes; one per available core if None.
        deep_images: how many images to cast again, evenly spread.

    Raises:
        UserError: there is no dataset, or an export is not there or of no known kind, or rays or exports of an
            adopted dataset are to be compared.
    """
    root, exports = dataset.resolve(), tuple(path.resolve() for path in exports)
    _require(root, exports, limit)
    if is_adopted(root):
        return _validate_adopted(root, deep, exports, limit, workers)
    header, findings = read_header(root)
    tally = Tally(limit)
    tally.add(findings)
    if header is None:
        return _report(root, tally, exports=exports)
    source, findings = read_source(root, header)
    tally.add(findings)
    plans = plans_by_scene(source.recipe)
    tally.add(check_folders(root, source.recipe, list(plans)))
    n_deep_tasks = math.ceil(min(deep_images, source.recipe.images) / _DEEP_IMAGES_PER_TASK) if deep else 0
    tasks = list(_tasks(source, plans, limit))
    with processes(workers, max(len(tasks), n_deep_tasks)) as run:
        results = list(watched(run, check_scene, tasks, "validating", "part"))
        for result in results:
            tally.merge(result.tally)
        scenes = [result for task, result in zip(tasks, results, strict=True) if task.part == 0]
        tally.add(_check_staleness(source, scenes))
        images, instances = sum(len(s.image_ids) for s in scenes), sum(s.instances for s in scenes)
        tally.add(check_counts(root, header, images, instances))
        compared, skipped = _check_deep(source, scenes, deep_images, run, tally) if deep else (0, 0)
        for export in exports:
            if export.is_dir():
                _check_shards(source, scenes, export, run, tally)
            else:
                tally.add(check_coco_export(source, export))
    return _report(root, tally, images, instances, compared, exports, tuple(_notes(source, skipped)))


def _validate_adopted(root: Path, deep: bool, exports: tuple[Path, ...], limit: int, workers: int | None) -> Report:
    if deep or exports:
        what = "--deep" if deep else "--export"
        raise UserError(f"{root}: no {DATASET_FILE}; {what} is for datasets that generate made, not for adopted ones")
    adopted, findings = read_adopted(root, limit)
    tally = Tally(limit)
    tally.add(findings)
    with processes(workers, len(adopted.scenes)) as run:
        tasks = [AdoptedTask(adopted, number) for number in range(len(adopted.scenes))]
        scenes = list(watched(run, check_adopted_scene, tasks, "validating", "part"))
    for scene in scenes:
        tally.merge(scene.tally)
    images, instances = sum(len(s.image_ids) for s in scenes), sum(s.instances for s in scenes)
    return _report(root, tally, images, instances, notes=tuple(left_out(adopted)))


def _tasks(source: Source, plans: Mapping[int, Sequence[ImagePlan]], limit: int) -> Iterator[SceneTask]:
    """One for a scene folder, or several where there are too few folders to keep a few cores busy."""
    for scene_id, of_scene in plans.items():
        parts = max(1, min(_TASKS_ENOUGH // len(plans), len(of_scene) // _IMAGES_WORTH_A_TASK))
        for part in range(parts):
            yield SceneTask(source, scene_id, tuple(of_scene), limit, part, parts)


def _require(root: Path, exports: Sequence[Path], limit: int) -> None:
    if limit < 0:
        raise UserError(f"limit is {limit}; a number of faults >= 0 is needed")
    if not root.is_dir():
        raise UserError(f"{root}: no such dataset folder")
    if not (root / DATASET_FILE).exists() and not any(root.glob("*/*/scene_spec.jsonl")) and not is_adopted(root):
        raise UserError(f"{root}: no {DATASET_FILE}; give a folder that generate filled, or that adopt labelled")
    for path in exports:
        if not path.exists():
            raise UserError(f"{path}: no such export; give a COCO file or a folder of shards")
        if path.is_dir() and not any(path.glob("shard-*.tar")):
            raise UserError(f"{path}: holds no shards (shard-000000.tar, ...)")


def _check_staleness(source: Source, scenes: Sequence[SceneResult]) -> Iterator[Finding]:
    """Name the scene folders whose labels are of other symmetries than symmetries.json."""
    stale = [scene for scene in scenes if scene.stale]
    half = len(stale) < sum(1 for scene in scenes if scene.image_ids)
    for scene in stale:
        objects = ", ".join(map(str, scene.stale))
        yield Finding(
            "stale",
            source.scene(scene.scene_id).scene_gt_canonical,
            f"labels of object {objects} are of other symmetries than symmetries.json; "
            + ("other scene folders have them, the dataset is half relabelled: run relabel" if half else "run relabel"),
        )


def _check_deep(source: Source, scenes: Sequence[SceneResult], count: int, run: Map, tally: Tally) -> tuple[int, int]:
    """Cast rays again; returns how many images were compared, and how many could not be."""
    places = sample({scene.scene_id: scene.image_ids for scene in scenes}, count)
    tasks = []
    for start in range(0, len(places), _DEEP_IMAGES_PER_TASK):
        chunk = places[start : start + _DEEP_IMAGES_PER_TASK]
        images = {scene_id: tuple(im_id for of, im_id in chunk if of == scene_id) for scene_id, _ in chunk}
        tasks.append(DeepTask(source, images, tally.limit))
    results = list(watched(run, check_deep, tasks, "casting rays", "part"))
    for result in results:
        tally.merge(result.tally)
    return sum(result.compared for result in results), sum(result.skipped for result in results)


def _check_shards(source: Source, scenes: Sequence[SceneResult], folder: Path, run: Map, tally: Tally) -> None:
    shards = Shards.read(folder)
    members, strangers = by_scene(shards, {scene.scene_id for scene in scenes if scene.image_ids})
    tally.add([*shards.findings, *check_companions(source, folder), *strangers])
    tasks = [ShardsTask(source, scene_id, folder, of, tally.limit) for scene_id, of in members.items()]
    for result in watched(run, check_shards, tasks, folder.name, "part"):
        tally.merge(result)


def _notes(source: Source, skipped: int) -> Iterator[str]:
    if source.has("exr") and find_spec("OpenEXR") is None:
        yield "exr/ was not decoded: the OpenEXR package is not installed"
    if skipped:
        yield (
            f"the rays of {skipped} images were not cast again: their labels are unsound, "
            "or the distractors' models are not where the recipe has them"
        )


def _report(
    root: Path,
    tally: Tally,
    images: int = 0,
    instances: int = 0,
    compared: int = 0,
    exports: tuple[Path, ...] = (),
    notes: tuple[str, ...] = (),
) -> Report:
    counts: dict[str, int] = {kind: tally.counts[kind] for kind in KINDS if tally.counts[kind]}
    findings = tuple(finding for kind in KINDS for finding in tally.kept if finding.kind == kind)
    return Report(root, images, instances, compared, exports, findings, counts, notes)
