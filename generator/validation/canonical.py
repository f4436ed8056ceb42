"""scene_gt_canonical.json against what poses and symmetries.json give."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from synthetless.dataset.labels import label_scene
from synthetless.dataset.layout import SYMMETRIES_FILE
from synthetless.dataset.records import Entry
from synthetless.symmetry import SymmetryTable
from synthetless.validation.geometry import Array
from synthetless.validation.labels import SceneLabels
from synthetless.validation.poses import Place
from synthetless.validation.report import Finding

_FIELDS = {
    "cam_R_m2c_canonical": (9, 1e-7),
    "cam_t_m2c_canonical": (3, 1e-5),
    "regressor_index": (1, 0.0),
    "n_regressors": (1, 0.0),
    "discontinuity_margin_deg": (1, 1e-4),
    "bbox3d_corners_2d": (16, 1e-4),
}
"""Numbers in each field, and by how much they may be off on another machine (corners: also by that share)."""
_OF_OTHER_SYMMETRIES = 0.2
"""Share of wrong labels of one object in a scene folder from which they are taken for those of other symmetries."""


@dataclass(frozen=True)
class Labelling:
    """How the labels of a scene folder compare with recomputed ones.

    Attributes:
        findings: the labels that differ.
        stale: objects so many of whose labels differ that they are labelled by other symmetries.
    """

    findings: tuple[Finding, ...] = ()
    stale: tuple[int, ...] = ()


def check_canonical(
    symmetries: Path | None, infos: Mapping[int, Entry], labels: SceneLabels, sound: set[Place]
) -> Labelling:
    """Recompute every label of a sound pose.

    Args:
        symmetries: the table; None if there is none that can be used.
        infos: models_info.json by object id.
        labels: of a scene folder.
        sound: the poses that are poses.
    """
    places = [
        (im_id, gt_id)
        for im_id, gt in labels.gt.items()
        for gt_id in range(len(gt))
        if (im_id, gt_id) in sound and im_id in labels.camera and len(labels.canonical.get(im_id, ())) == len(gt)
    ]
    if not places or symmetries is None:
        return Labelling()
    expected = _recomputed(SymmetryTable.read(symmetries), infos, labels, places)
    stored = [labels.canonical[im_id][gt_id] for im_id, gt_id in places]
    differs = ~_agree(_rows(stored), _rows(expected))
    path = labels.paths.scene_gt_canonical
    findings = tuple(
        Finding("canonical", path, _explain(stored[i], expected[i]), *places[i]) for i in np.flatnonzero(differs)
    )
    total = Counter(entry["obj_id"] for entry in expected)
    wrong = Counter(expected[i]["obj_id"] for i in np.flatnonzero(differs))
    stale = (obj_id for obj_id, count in wrong.items() if count > 1 and count >= _OF_OTHER_SYMMETRIES * total[obj_id])
    return Labelling(findings, tuple(sorted(stale)))


def _recomputed(
    table: SymmetryTable, infos: Mapping[int, Entry], labels: SceneLabels, places: list[Place]
) -> list[Entry]:
    gt: dict[int, list[Entry]] = {}
    for im_id, gt_id in places:
        gt.setdefault(im_id, []).append(labels.gt[im_id][gt_id])
    labelled = label_scene(cast(Any, gt), cast(Any, labels.camera), table, infos)
    return [cast(Entry, entry) for im_id in gt for entry in labelled[im_id]]


def _rows(entries: list[Entry]) -> Array:
    """(N, 31) all numbers of labels."""
    rows = [np.concatenate([np.ravel(entry[name]) for name in _FIELDS]) for entry in entries]
    return np.array(rows, dtype=np.float64)


def _agree(stored: Array, expected: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(N,) whether labels are the same."""
    tolerance = np.concatenate([np.full(count, slack) for count, slack in _FIELDS.values()])
    slack = tolerance * np.maximum(1.0, np.abs(expected))
    agree: np.ndarray[tuple[int], np.dtype[np.bool_]] = (np.abs(stored - expected) <= slack).all(axis=1)
    return agree


def _explain(stored: Entry, expected: Entry) -> str:
    rows = _rows([stored])[0], _rows([expected])[0]
    start, wrong = 0, []
    for name, (count, _) in _FIELDS.items():
        off = np.abs(rows[0][start : start + count] - rows[1][start : start + count]).max()
        start += count
        if off > 0:
            wrong.append(f"{name} off by {off:.3g}")
    return f"does not follow from scene_gt.json and {SYMMETRIES_FILE}: {', '.join(wrong)}"
