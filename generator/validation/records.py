"""The record of every image, which the JSON files of its scene folder are assembled from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from synthetless.dataset.layout import RECORDS_FOLDER
from synthetless.dataset.store import DatasetStore
from synthetless.io.files import read_json
from synthetless.validation.labels import SceneLabels
from synthetless.validation.report import Finding, unusable
from synthetless.validation.source import Source


def check_records(source: Source, scene_id: int, labels: SceneLabels) -> Iterator[Finding]:
    """Every image has a record that says what the JSON files say, or else the dataset cannot be extended.

    A copy without any records is a whole dataset, too: it is only never gone on with.
    """
    if not (source.root / RECORDS_FOLDER).is_dir():
        return
    dataset = DatasetStore(source.root, source.recipe)
    files = (
        ("camera", labels.paths.scene_camera, labels.camera),
        ("gt", labels.paths.scene_gt, labels.gt),
        ("gt_info", labels.paths.scene_gt_info, labels.gt_info),
    )
    for im_id in labels.image_ids:
        path = dataset.record(scene_id, im_id)
        try:
            record = read_json(path)
        except ValueError as error:
            yield replace(unusable(path, error), image=im_id)
            continue
        for key, file, entries in files:
            if record.get(key) != entries[im_id]:
                message = f"{key} is not what {file.name} has, which was assembled from it: one of them was changed"
                yield Finding("record", path, message, im_id)
