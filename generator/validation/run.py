"""Validates a dataset: hands the scene folders to workers and puts together what they find."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synthetless.dataset.labels import undisturbed
from synthetless.dataset.layout import DATASET_FILE, ImagePlan
from synthetless.dataset.store import DatasetStore
from synthetless.errors import UserError
from synthetless.exports.folder import EXPORT_FILE, is_export
from synthetless.io.parallel import Map, processes, watched
from synthetless.validation.ambiguity import check_ambiguity
from synthetless.validation.exports import (
    Shards,
    ShardsTask,
    by_scene,
    check_coco_export,
    check_companions,
    check_folder,
    check_owned,
    check_shards,
    folder_tasks,
)
from synthetless.validation.foreign import ForeignTask, check_foreign_scene, is_adopted, notes_on, read_foreign
from synthetless.validation.images import can_decode_exr, can_see, not_seen, see
from synthetless.validation.recompute import check_image, check_labels, check_specs, recompute
from synthetless.validation.records import (
    SceneRecords,
    check_agreement,
    check_poses,
    check_stored,
    match_annotations,
)
from synthetless.validation.report import KINDS, Finding, Report, Tally, bare
from synthetless.validation.structure import (
    Source,
    check_counts,
    check_files,
    check_folders,
    plans_by_scene,
    read_header,
    read_source,
)

SAMPLE = 30_000
"""Images of a larger dataset are recomputed in part by default, so that it takes minutes, not hours."""
_TASKS_ENOUGH, _IMAGES_WORTH_A_TASK = 4, 100
"""Whatever the number of processes, so that the same faults are told: each task reads all records of its folder."""


def validate(
    dataset: Path,
    sample: int | None = SAMPLE,
    exports: Sequence[Path] = (),
    limit: int = 20,
    workers: int | None = None,
) -> Report:
    """Check a dataset, and exports made from it; or what can be checked of a dataset that ``adopt`` labelled.

    Every file of every image is read and compared with the others. Images that ``generate`` made are also recomputed:
    measured again, from their recorded scenes and the models, and compared with what the files say.

    Args:
        dataset: its folder, as ``generate`` fills it, or as ``adopt`` leaves it.
        sample: how many images to recompute, evenly spread; None for every one.
        exports: COCO files, folders of shards and other exports that were made from the dataset.
        limit: how many faults of each kind to report in full; all are counted.
        workers: processes; one per available core if None.

    Raises:
        UserError: there is no dataset, or an export is not there or of no known kind, or an adopted
            dataset is to be recomputed or compared with exports; or another process changes the dataset meanwhile.
    """
    root, exports = dataset.resolve(), tuple(path.resolve() for path in exports)
    _require(root, exports, limit)
    if sample is None or any(path.is_dir() for path in exports):
        see()
    with undisturbed(root):
        if is_adopted(root):
            if exports or sample is None:
                what = "--export" if exports else "--deep"
                raise UserError(
                    f"{root}: no {DATASET_FILE}; {what} is for datasets that generate made, not for adopted ones"
                )
            return _validate_adopted(root, limit, workers)
        return _validate_own(root, sample, exports, limit, workers)


def _validate_own(root: Path, sample: int | None, exports: tuple[Path, ...], limit: int, workers: int | None) -> Report:
    header, findings = read_header(root)
    tally = Tally(limit)
    tally.add(findings)
    if header is None:
        return _report(root, tally, exports=exports)
    source, findings = read_source(root, header)
    tally.add(findings)
    plans = plans_by_scene(source.recipe)
    tally.add(check_folders(root, source.recipe, list(plans)))
    tasks = list(_tasks(source, plans, _spread(source.recipe.images, sample), limit))
    with processes(workers, len(tasks)) as run:
        results = list(watched(run, check_scene, tasks, "validating", "part"))
        for result in results:
            tally.merge(result.tally)
        scenes = [result for task, result in zip(tasks, results, strict=True) if task.part == 0]
        tally.add(_check_staleness(source, scenes))
        images, instances = sum(len(s.image_ids) for s in scenes), sum(s.instances for s in scenes)
        tally.add(check_counts(root, header, images, instances))
        for export in exports:
            if is_export(export):
                _check_folder(source, export, run, tally)
            elif export.is_dir():
                _check_shards(source, scenes, export, run, tally)
            else:
                tally.add(check_coco_export(source, export))
    recomputed, skipped = sum(result.recomputed for result in results), sum(result.skipped for result in results)
    return _report(
        root, tally, images, instances, recomputed, exports, tuple(_notes(source, images, recomputed, skipped))
    )


def _validate_adopted(root: Path, limit: int, workers: int | None) -> Report:
    foreign, findings = read_foreign(root, limit)
    tally = Tally(limit)
    tally.add(findings)
    with processes(workers, len(foreign.scenes)) as run:
        tasks = [ForeignTask(foreign, number) for number in range(len(foreign.scenes))]
        scenes = list(watched(run, check_foreign_scene, tasks, "validating", "part"))
    for scene in scenes:
        tally.merge(scene.tally)
    images, instances = sum(scene.images for scene in scenes), sum(scene.instances for scene in scenes)
    return _report(root, tally, images, instances, notes=tuple(notes_on(foreign, scenes)))


def _require(root: Path, exports: Sequence[Path], limit: int) -> None:
    if limit < 0:
        raise UserError(f"limit is {limit}; a number of faults >= 0 is needed")
    if not root.is_dir():
        raise UserError(f"{root}: no such dataset folder")
    if not (root / DATASET_FILE).exists() and not any(root.glob("*/*/scene_spec.jsonl")) and not is_adopted(root):
        raise UserError(f"{root}: no {DATASET_FILE}; give a folder that generate filled, or that adopt labelled")
    for path in exports:
        if not path.exists():
            raise UserError(f"{path}: no such export; give a COCO file or the folder of another export")
        if path.is_dir() and not is_export(path) and not any(path.glob("shard-*.tar")):
            raise UserError(f"{path}: is no export; it holds neither {EXPORT_FILE} nor shards (shard-000000.tar, ...)")


# Scene folders


@dataclass(frozen=True, eq=False)
class SceneTask:
    """What a worker is given.

    Attributes:
        source: the dataset.
        scene_id: a scene folder.
        plans: the images that it should hold.
        recomputed: ids of those to recompute.
        limit: how many faults of a kind to keep.
        part, parts: which part of its images' files to look at, of how many; part 0 looks at all records, too.
    """

    source: Source
    scene_id: int
    plans: tuple[ImagePlan, ...]
    recomputed: frozenset[int]
    limit: int
    part: int = 0
    parts: int = 1


@dataclass(frozen=True, eq=False)
class SceneResult:
    """What a worker gives back.

    Attributes:
        scene_id: the scene folder.
        tally: its faults.
        image_ids: of the images it holds.
        instances: how many there are in them.
        stale: objects that are labelled by other symmetries.
        recomputed, skipped: how many images were recomputed, and how many should have been, but could not.
    """

    scene_id: int
    tally: Tally
    image_ids: tuple[int, ...] = ()
    instances: int = 0
    stale: tuple[int, ...] = ()
    recomputed: int = 0
    skipped: int = 0


def _spread(count: int, sample: int | None) -> set[int]:
    """Numbers of images that are evenly spread over a dataset."""
    chosen = min(count, count if sample is None else sample)
    return {round(number) for number in np.linspace(0, count - 1, chosen).tolist()}


def _tasks(
    source: Source, plans: Mapping[int, Sequence[ImagePlan]], chosen: set[int], limit: int
) -> Iterator[SceneTask]:
    """One for a scene folder, or several where there are too few folders to keep a few cores busy."""
    for scene_id, of_scene in plans.items():
        parts = max(1, min(_TASKS_ENOUGH // len(plans), len(of_scene) // _IMAGES_WORTH_A_TASK))
        recomputed = frozenset(plan.im_id for plan in of_scene if plan.number in chosen)
        for part in range(parts):
            yield SceneTask(source, scene_id, tuple(of_scene), recomputed, limit, part, parts)


def check_scene(task: SceneTask) -> SceneResult:
    """Check a scene folder; one that is not there has no faults of its own. Only part 0 tells what it holds."""
    source, tally = task.source, Tally(task.limit)
    paths = source.scene(task.scene_id)
    if not paths.root.is_dir():
        return SceneResult(task.scene_id, tally)
    scene = SceneRecords.read(paths)
    camera, extension = source.recipe.camera, source.recipe.encoding.rgb_format
    annotations, unmatched = match_annotations(source.obj_ids, (camera.width, camera.height), extension, scene)
    image_ids: tuple[int, ...] = ()
    stale: tuple[int, ...] = ()
    instances = 0
    if task.part == 0:
        tally.add(scene.findings)
        tally.add(check_agreement(scene, task.plans))
        tally.add(check_files(source, scene))
        valid, faults = check_poses(source.obj_ids, scene)
        tally.add(faults)
        tally.add(check_specs(source, scene, task.plans))
        store = DatasetStore(source.root, source.recipe)
        tally.add(check_stored(store, task.scene_id, scene, {plan.im_id for plan in task.plans}))
        faults, stale = check_labels(source.symmetries, source.infos, scene, valid)
        tally.add(faults)
        tally.add(check_ambiguity(source.root, scene))
        tally.add(unmatched)
        image_ids, instances = tuple(scene.gt), sum(len(gt) for gt in scene.gt.values())
    recomputed = skipped = 0
    seen = [plan.im_id for plan in task.plans][task.part :: task.parts] if can_see() else []
    for im_id in seen:
        wanted = im_id in task.recomputed and im_id in scene.gt
        expected = recompute(source, scene.spec.get(im_id)) if wanted and scene.is_complete(im_id) else None
        recomputed += expected is not None
        skipped += wanted and expected is None
        tally.add(check_image(source, scene, im_id, annotations.get(im_id, {}), expected))
    return SceneResult(task.scene_id, tally, image_ids, instances, stale, recomputed, skipped)


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


def _check_shards(source: Source, scenes: Sequence[SceneResult], folder: Path, run: Map, tally: Tally) -> None:
    shards = Shards.read(folder)
    members, strangers = by_scene(shards, {scene.scene_id for scene in scenes if scene.image_ids})
    tally.add([*shards.findings, *check_companions(source, folder), *strangers])
    tasks = [ShardsTask(source, scene_id, folder, of, tally.limit) for scene_id, of in members.items()]
    for result in watched(run, check_shards, tasks, folder.name, "part"):
        tally.merge(result)


def _check_folder(source: Source, folder: Path, run: Map, tally: Tally) -> None:
    try:
        tasks = folder_tasks(source, folder, tally.limit)
    except UserError as error:
        tally.add([Finding("export", folder / EXPORT_FILE, bare(error, folder / EXPORT_FILE))])
        return
    names: set[str] = set()
    for result in watched(run, check_folder, tasks, folder.name, "part"):
        tally.merge(result.tally)
        names |= result.names
    tally.add(check_owned(tasks[-1], names))


# The report


def _notes(source: Source, images: int, recomputed: int, skipped: int) -> Iterator[str]:
    if source.has("exr") and not can_decode_exr():
        yield "exr/ was not decoded: the OpenEXR package is not installed"
    if not can_see():
        yield not_seen()
        return
    if skipped:
        yield (
            f"{skipped} images could not be recomputed, their files were only compared with each other: their records "
            "are not sound, or a model, or the distractors' models, cannot be found"
        )
    if recomputed + skipped < images:
        yield f"{recomputed} of {images} images were recomputed, evenly spread; --deep recomputes every one"


def _report(
    root: Path,
    tally: Tally,
    images: int = 0,
    instances: int = 0,
    recomputed: int = 0,
    exports: tuple[Path, ...] = (),
    notes: tuple[str, ...] = (),
) -> Report:
    counts: dict[str, int] = {kind: tally.counts[kind] for kind in KINDS if tally.counts[kind]}
    findings = tuple(finding for kind in KINDS for finding in tally.kept if finding.kind == kind)
    return Report(root, images, instances, recomputed, exports, findings, counts, notes)
