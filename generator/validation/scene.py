"""One scene folder: its labels, its files, its images."""

from __future__ import annotations

from dataclasses import dataclass

from synthetless.dataset.layout import ImagePlan
from synthetless.validation.canonical import check_canonical
from synthetless.validation.coco import match_annotations
from synthetless.validation.files import check_files
from synthetless.validation.images import ImageCheck
from synthetless.validation.labels import SceneLabels, check_agreement
from synthetless.validation.poses import check_cameras, check_poses, check_specs
from synthetless.validation.records import check_records
from synthetless.validation.report import Tally
from synthetless.validation.source import Source


@dataclass(frozen=True, eq=False)
class SceneTask:
    """What a worker is given.

    Attributes:
        source: the dataset.
        scene_id: a scene folder.
        plans: the images that it should hold.
        limit: how many faults of a kind to keep.
        part, parts: which part of its images' files to look at, of how many; part 0 looks at all labels, too.
    """

    source: Source
    scene_id: int
    plans: tuple[ImagePlan, ...]
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
    """

    scene_id: int
    tally: Tally
    image_ids: tuple[int, ...] = ()
    instances: int = 0
    stale: tuple[int, ...] = ()


def check_scene(task: SceneTask) -> SceneResult:
    """Check a scene folder; one that is not there has no faults of its own. Only part 0 tells what it holds."""
    source, tally = task.source, Tally(task.limit)
    paths = source.scene(task.scene_id)
    if not paths.root.is_dir():
        return SceneResult(task.scene_id, tally)
    labels = SceneLabels.read(paths)
    sound, faults = check_poses(source.infos, labels)
    annotations = match_annotations(source, labels)
    result = SceneResult(task.scene_id, tally)
    if task.part == 0:
        tally.add(labels.findings)
        tally.add(check_agreement(labels, task.plans))
        tally.add(check_files(source, labels))
        tally.add(check_cameras(source, labels))
        tally.add(faults)
        tally.add(check_specs(source, labels, task.plans, sound))
        tally.add(check_records(source, task.scene_id, labels))
        labelling = check_canonical(source.symmetries, source.infos, labels, sound)
        tally.add(labelling.findings)
        tally.add(annotations.findings)
        instances = sum(len(gt) for gt in labels.gt.values())
        result = SceneResult(task.scene_id, tally, tuple(labels.gt), instances, labelling.stale)
    for im_id in labels.image_ids[task.part :: task.parts]:
        tally.add(ImageCheck(source, labels, im_id, annotations.by_image.get(im_id, {}), sound).run())
    return result
