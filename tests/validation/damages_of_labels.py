"""Damages to labels, symmetries, dataset.json and models."""

from __future__ import annotations

import shutil

import numpy as np
from damage_kit import IMAGE, Victim, damage

CANONICAL = "scene_gt_canonical.json"


# --- labels and symmetries ---


@damage("canonical", CANONICAL, IMAGE, 5)
def stale_canonical_label(victim: Victim) -> None:
    """The other of the two poses that look alike."""
    with victim.entry("gt_canonical", 5) as label:
        R = np.reshape(label["cam_R_m2c_canonical"], (3, 3)) @ np.diag([-1, -1, 1])
        label["cam_R_m2c_canonical"] = R.ravel().tolist()


@damage("canonical", CANONICAL, IMAGE, 5)
def wrong_regressor(victim: Victim) -> None:
    with victim.entry("gt_canonical", 5) as label:
        label["regressor_index"] = 1 - label["regressor_index"]


@damage("canonical", CANONICAL, IMAGE, 5)
def wrong_number_of_regressors(victim: Victim) -> None:
    with victim.entry("gt_canonical", 5) as label:
        label["n_regressors"] = 4


@damage("canonical", CANONICAL, IMAGE, 5)
def wrong_margin(victim: Victim) -> None:
    with victim.entry("gt_canonical", 5) as label:
        label["discontinuity_margin_deg"] += 1


@damage("canonical", CANONICAL, IMAGE, 5)
def corner_off_by_half_a_pixel(victim: Victim) -> None:
    with victim.entry("gt_canonical", 5) as label:
        label["bbox3d_corners_2d"][3][0] += 0.5


@damage("canonical", CANONICAL, IMAGE, 5)
def canonical_translation_off(victim: Victim) -> None:
    with victim.entry("gt_canonical", 5) as label:
        label["cam_t_m2c_canonical"][2] += 0.01


@damage("missing", CANONICAL)
def missing_labels(victim: Victim) -> None:
    victim.scene.scene_gt_canonical.unlink()


def _regroup(victim: Victim, **changes: object) -> None:
    with victim.json(victim.root / "symmetries.json") as table:
        table["objects"]["3"] = {"group": "C4", "axis": [0, 0, 1], **changes}


@damage("stale", "/symmetries.json")
def edited_symmetries(victim: Victim) -> None:
    _regroup(victim)


@damage("stale", CANONICAL)
def edited_symmetries_of_labels(victim: Victim) -> None:
    _regroup(victim)


@damage("symmetries", "/symmetries.json")
def symmetries_that_contradict_themselves(victim: Victim) -> None:
    _regroup(victim, order=2)


@damage("symmetries", "/symmetries.json")
def object_without_symmetries(victim: Victim) -> None:
    with victim.json(victim.root / "symmetries.json") as table:
        del table["objects"]["2"]


@damage("missing", "/symmetries.json")
def missing_symmetries(victim: Victim) -> None:
    (victim.root / "symmetries.json").unlink()


@damage("stale", "/symmetries.json")
def digest_of_other_symmetries(victim: Victim) -> None:
    with victim.json(victim.root / "dataset.json") as header:
        header["symmetries"]["sha256"] = "0" * 64


@damage("stale", "/symmetries.json")
def interrupted_relabelling(victim: Victim) -> None:
    """Killed while files took their places (see synthetless.dataset.relabel)."""
    shutil.copy(victim.root / "symmetries.json", victim.root / ".symmetries.json")


# --- dataset.json and models ---


@damage("counts", "/dataset.json")
def wrong_counts(victim: Victim) -> None:
    with victim.json(victim.root / "dataset.json") as header:
        header["counts"]["instances"] += 1


@damage("missing", "/train_synthetless/000003")
def images_that_were_never_made(victim: Victim) -> None:
    with victim.json(victim.root / "dataset.json") as header:
        header["recipe"]["images"] += 1


@damage("schema", "/dataset.json")
def recipe_of_another_version(victim: Victim) -> None:
    with victim.json(victim.root / "dataset.json") as header:
        header["recipe"]["camera"]["zoom"] = 2


@damage("missing", "/dataset.json")
def missing_header(victim: Victim) -> None:
    (victim.root / "dataset.json").unlink()


@damage("models", "/models/obj_000002.ply")
def another_model(victim: Victim) -> None:
    shutil.copy(victim.root / "models/obj_000003.ply", victim.root / "models/obj_000002.ply")


@damage("missing", "/models/obj_000002.ply")
def missing_model(victim: Victim) -> None:
    (victim.root / "models/obj_000002.ply").unlink()


@damage("models", "/models/models_info.json")
def diameter_in_metres(victim: Victim) -> None:
    with victim.json(victim.root / "models/models_info.json") as infos:
        infos["2"]["diameter"] /= 1000


@damage("models", "/models/models_info.json")
def model_without_info(victim: Victim) -> None:
    with victim.json(victim.root / "models/models_info.json") as infos:
        del infos["2"]


@damage("schema", "/models/models_info.json")
def model_without_box(victim: Victim) -> None:
    with victim.json(victim.root / "models/models_info.json") as infos:
        del infos["2"]["min_x"]


@damage("models", "/models/models_info.json")
def symmetries_that_are_no_group(victim: Victim) -> None:
    with victim.json(victim.root / "models/models_info.json") as infos:
        infos["3"]["symmetries_discrete"][0][0] = 0.5


@damage("models", "/models/obj_000002.ply")
def model_that_is_no_mesh(victim: Victim) -> None:
    (victim.root / "models/obj_000002.ply").write_bytes(b"ply\n")


@damage("stray", "/models/obj_000009.ply")
def stray_model(victim: Victim) -> None:
    shutil.copy(victim.root / "models/obj_000003.ply", victim.root / "models/obj_000009.ply")
