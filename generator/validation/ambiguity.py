"""scene_gt_ambiguity.json against poses, meshes and symmetries: some images of each scene folder are judged anew."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from synthetless.config import models_folder
from synthetless.dataset.ambiguity import AmbiguitySource, see_images
from synthetless.dataset.layout import AMBIGUITY_FILE, DATASET_FILE, find_models_folder
from synthetless.dataset.reader import Scene, read_recipe
from synthetless.dataset.records import AmbiguityEntry
from synthetless.errors import UserError
from synthetless.io.files import read_json
from synthetless.validation.records import SceneRecords
from synthetless.validation.report import Finding, bare

JUDGED_ANEW = 20
"""Images of each scene folder, evenly spread."""
_SAME_POSE, _SAME_MM = 1e-7, 1e-5
_PIXELS, _SHARE = 3, 0.5
"""By how much counts may differ on another machine: at edges single precision decides, and large ones are estimates."""


def check_ambiguity(root: Path, scene: SceneRecords) -> Iterator[Finding]:
    """Whether a scene folder's file is current, and some of its images are as they are found again."""
    path = scene.paths.scene_gt_ambiguity
    if not path.exists():
        if (root / AMBIGUITY_FILE).exists():
            yield Finding("missing", path, f"not there; {AMBIGUITY_FILE} says that it is: run ambiguity again")
        return
    if not scene.is_ambiguity_current:
        message = "is of other symmetries or poses than there are now, or was interrupted: run ambiguity again"
        yield Finding("stale", path, message)
        return
    if scene.findings or not _has_models(root):  # what cannot be read is told already
        return
    try:
        source = _source(root, (root / AMBIGUITY_FILE).read_text())
        columns = Scene.read(scene.paths)
    except UserError as error:
        yield Finding("ambiguity", root / AMBIGUITY_FILE, f"cannot be checked: {error}")
        return
    for im_id in sorted(scene.gt.keys() ^ scene.ambiguity.keys()):
        yield Finding("missing", path, "image is in only one of this file and scene_gt.json", im_id)
    count = len(columns)
    numbers = sorted({round(number) for number in np.linspace(0, count - 1, min(count, JUDGED_ANEW)).tolist()})
    try:
        for number, expected in zip(numbers, see_images(source, columns, numbers), strict=True):
            im_id = int(columns.poses.image_ids[number])
            for gt_id, (entry, other) in enumerate(zip(scene.ambiguity.get(im_id, []), expected, strict=False)):
                if fault := _difference(entry, other):
                    yield Finding("ambiguity", path, fault, im_id, gt_id)
    except UserError as error:
        yield Finding("ambiguity", path, f"cannot be checked: {bare(error, path)}")


def _has_models(root: Path) -> bool:
    """Models of an adopted dataset, and distractors, may be elsewhere: what is not there cannot be cast at."""
    try:
        find_models_folder(root)
        recipe = read_recipe(root) if (root / DATASET_FILE).exists() else None
    except UserError:
        return False
    if recipe is None or recipe.source.distractors is None or recipe.objects.distractors[1] == 0:
        return True
    return models_folder(recipe.source.distractors).is_dir()


@lru_cache(maxsize=1)
def _source(root: Path, stamp: str) -> AmbiguitySource:
    """What the files were made with; read once, as long as the stamp stays the same."""
    said: Mapping[str, Any] = read_json(root / AMBIGUITY_FILE)
    source = AmbiguitySource.read(root, said.get("what", ""), said.get("eps_mm"), None, said.get("poses") is True)
    models = {str(obj_id): digest for obj_id, digest in source.digests.items()}
    if said.get("models") != models:
        raise UserError("it was made with other meshes than those of the dataset: run ambiguity again")
    return source


def _difference(entry: AmbiguityEntry | None, expected: AmbiguityEntry | None) -> str | None:
    if entry is None or expected is None:
        return None if entry == expected else "is null where the object has a quasi-symmetry group, or the reverse"
    for name, tolerance in (("cam_R_m2c_quasi", _SAME_POSE), ("cam_t_m2c_quasi", _SAME_MM), ("eps_mm", _SAME_MM)):
        off = float(np.abs(np.subtract(entry[name], expected[name])).max())  # type: ignore[literal-required]
        if off > tolerance:
            return f"{name} is off by {off:.3g}"
    for name in ("quasi_index", "n_quasi_indices", "n_cosets", "coset_true"):
        if entry[name] != expected[name]:  # type: ignore[literal-required]
            return f"{name} is {entry[name]}; {expected[name]} is recomputed"  # type: ignore[literal-required]
    found, counts = np.array(entry["pixels_apart"]), np.array(expected["pixels_apart"])
    wrong = np.flatnonzero(np.abs(found - counts) > _PIXELS + _SHARE * counts)
    if len(wrong):
        return f"pixels_apart of coset {wrong[0]} is {found[wrong[0]]}; {counts[wrong[0]]} is recomputed"
    return None
