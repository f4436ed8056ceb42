"""Labels of a scene folder: each instance gets its own, under its own camera, and damage is named by its place."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from posed import random_camera, random_poses

from synthetless.dataset.labels import box_corners_mm, label_scene, undisturbed
from synthetless.dataset.records import Entry
from synthetless.errors import UserError
from synthetless.io.files import atomic_write, locked
from synthetless.symmetry import SymmetryTable

BOX = {"min_x": -20, "min_y": -15, "min_z": -10, "size_x": 40, "size_y": 25, "size_z": 20.0, "diameter": 55.0}
INFOS = dict.fromkeys((1, 2, 26, 30), BOX)
TABLE = SymmetryTable.from_dict(
    {1: "C1", 2: "C4", 26: {"group": "C2", "axis": [0, 0, 1], "offset": [-7, 0, 0]}, 30: "SO(2)"}
)
Scene = tuple[dict[int, list[Entry]], dict[int, Entry]]


def _scene(seed: int, counts: list[int]) -> Scene:
    rng = np.random.default_rng(seed)
    gt = {3 * i: random_poses(rng, list(INFOS), count) for i, count in enumerate(counts)}
    return gt, {im_id: random_camera(rng) for im_id in gt}


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 6), max_size=5), st.sampled_from(["pitteri2019", "atlas"]))
def test_every_instance_gets_the_label_it_would_get_alone(seed: int, counts: list[int], scheme: Any) -> None:
    gt, camera = _scene(seed, counts)
    table = SymmetryTable(TABLE.entries, scheme)
    labels = label_scene(gt, camera, table, INFOS)
    assert list(labels) == list(gt)
    for im_id, entries in gt.items():
        assert len(labels[im_id]) == len(entries)
        for pose, label in zip(entries, labels[im_id], strict=True):
            R, t = np.reshape(pose["cam_R_m2c"], (1, 3, 3)), np.reshape(pose["cam_t_m2c"], (1, 3))
            alone = table.canonical_map(pose["obj_id"])(R, t)
            assert label["obj_id"] == pose["obj_id"]
            assert label["regressor_index"] == alone.regressor_index[0]
            assert label["n_regressors"] == alone.n_regressors
            assert_allclose(np.reshape(label["cam_R_m2c_canonical"], (3, 3)), alone.R_m2c[0], atol=1e-14)
            assert_allclose(label["cam_t_m2c_canonical"], alone.t_m2c[0], atol=1e-9)
            assert_allclose(label["discontinuity_margin_deg"], alone.discontinuity_margin_deg[0], atol=1e-6)
            seen = (box_corners_mm(BOX) @ alone.R_m2c[0].T + alone.t_m2c[0]) @ np.reshape(
                camera[im_id]["cam_K"], (3, 3)
            ).T
            assert_allclose(label["bbox3d_corners_2d"], seen[:, :2] / seen[:, 2:], atol=1e-6)


def test_only_some_objects_are_labelled_on_request() -> None:
    gt, camera = _scene(0, [8, 8])
    whole = label_scene(gt, camera, TABLE, INFOS)
    stored = label_scene(gt, camera, SymmetryTable(TABLE.entries, "atlas"), INFOS)
    some = label_scene(gt, camera, TABLE, INFOS, {26}, stored)
    for im_id, entries in whole.items():
        mixed = zip(entries, stored[im_id], strict=True)
        assert some[im_id] == [entry if entry["obj_id"] == 26 else before for entry, before in mixed]
    assert some not in (whole, stored)


def test_labels_that_nobody_has_cannot_be_kept() -> None:
    gt, camera = _scene(0, [8, 8])
    with pytest.raises(ValueError, match="no stored labels"):
        label_scene(gt, camera, TABLE, INFOS, only={26})


def _damage(gt: dict[int, Any], camera: dict[int, Any], infos: dict[int, Any], kind: str) -> None:
    second = gt[3][1]
    match kind:
        case "reflection":
            second["cam_R_m2c"] = [-value for value in second["cam_R_m2c"]]
        case "short":
            second["cam_R_m2c"] = second["cam_R_m2c"][:8]
        case "nan":
            second["cam_t_m2c"][2] = float("nan")
        case "no obj_id":
            del second["obj_id"]
        case "no list":
            gt[3] = {"obj_id": 1}
        case "no camera":
            del camera[3]
        case "no K":
            del camera[3]["cam_K"]
        case "no model":
            del infos[second["obj_id"]]
        case "no box":
            infos[second["obj_id"]] = {"diameter": 55.0}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("reflection", r"scene_gt\.json: image 3, instance 1: R_m2c is no rotation: .* is a reflection"),
        ("short", r"scene_gt\.json: image 3, instance 1: cam_R_m2c is \[.*\], not 9 finite numbers"),
        ("nan", r"scene_gt\.json: image 3, instance 1: cam_t_m2c is \[.*nan\], not 3 finite numbers"),
        ("no obj_id", r"scene_gt\.json: image 3, instance 1: obj_id is None"),
        ("no list", r"scene_gt\.json: image 3 has no list of instances"),
        ("no camera", r"scene_camera\.json: image 3 of scene_gt\.json has no entry"),
        ("no K", r"scene_camera\.json: image 3: cam_K is None, not 9 finite numbers"),
        ("no model", r"models_info\.json: no entry for object \d+, which scene_gt\.json names"),
        ("no box", r"models_info\.json: object \d+: the box needs the numbers min_x"),
    ],
)
def test_damage_is_named_by_its_place(kind: str, message: str) -> None:
    gt, camera = _scene(1, [2, 4])
    infos = copy.deepcopy(INFOS)
    _damage(gt, camera, infos, kind)
    with pytest.raises(ValueError, match=message) as error:
        label_scene(gt, camera, TABLE, infos)
    assert "\n" not in str(error.value)


def test_an_object_without_symmetries_is_told() -> None:
    gt, camera = _scene(1, [4])
    with pytest.raises(ValueError, match="is not in the symmetry table, which has objects 26"):
        label_scene(gt, camera, SymmetryTable({26: TABLE.entries[26]}), INFOS)


def _rewrite(path: Path) -> None:
    atomic_write(path, path.read_bytes())


@pytest.mark.parametrize(
    ("name", "may_grow", "refused"),
    [
        ("symmetries.json", False, True),
        ("symmetries.json", True, True),
        ("dataset.json", False, True),
        ("dataset.json", True, False),
        ("camera.json", False, False),
    ],
)
def test_readers_notice_what_changes_under_them(tmp_path: Path, name: str, may_grow: bool, refused: bool) -> None:
    for file in ("symmetries.json", "dataset.json", "camera.json"):
        (tmp_path / file).write_text("{}")
    expected = pytest.raises(UserError, match="is writing here, or was meanwhile") if refused else nullcontext()
    with expected, undisturbed(tmp_path, may_grow):
        _rewrite(tmp_path / name)


def test_a_fault_that_a_writer_caused_is_not_told(tmp_path: Path) -> None:
    """Not even to those who do not mind new images; a fault of the dataset's own is."""
    with pytest.raises(UserError, match="is writing here"), locked(tmp_path), undisturbed(tmp_path, may_grow=True):
        raise UserError("image 3 has no entry")
    with pytest.raises(UserError, match="image 3 has no entry"), undisturbed(tmp_path):
        raise UserError("image 3 has no entry")
    with pytest.raises(UserError, match="is writing here"), locked(tmp_path, "1-of-2"), undisturbed(tmp_path):
        pass
