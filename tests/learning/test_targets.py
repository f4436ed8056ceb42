"""Labels of every set are learnable or not as they claim, and exact when the camera turns."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synthetless.errors import UserError
from synthetless.learning.targets import (
    LABEL_SETS,
    LabelMaker,
    LabelSet,
    looking_at,
    rolled,
    turned,
    turning_homography,
)
from synthetless.symmetry import SymmetryTable

TABLE = SymmetryTable.from_dict(
    {
        1: {"group": "C1"},
        2: {"group": "C2", "axis": [0, 0, 1], "offset": [-7, 0, 0]},
        3: {"group": "C4"},
        4: {"group": "SO(2)"},
        5: {"group": "O(2)"},
        6: {"group": "D3", "axis": [0, 0, 1], "secondary_axis": [1, 0, 0]},
    }
)
BOX = np.array([[x, y, z] for x in (-20, 20) for y in (-15, 15) for z in (-10, 10)], dtype=np.float64)


def _poses(n: int, seed: int = 0) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    t = rng.uniform(-90, 90, (n, 3)) + np.array([0, 0, 600])
    return rng.integers(1, 7, n), Rotation.random(n, random_state=rng).as_matrix(), t


@pytest.mark.parametrize("labels", LABEL_SETS)
def test_a_label_is_a_pose_that_looks_the_same(labels: LabelSet) -> None:
    ids, R, t = _poses(300)
    made = LabelMaker(labels, TABLE)(ids, R, t)
    for obj_id, entry in TABLE.entries.items():
        rows = ids == obj_id
        assert entry.group.appearance_distance_deg(R[rows], made.R_m2c[rows]).max() < 1e-6
        centre = np.array(entry.group.offset_mm)
        assert np.allclose(R[rows] @ centre + t[rows], made.R_m2c[rows] @ centre + made.t_m2c[rows], atol=1e-9)
    assert (made.regressor_index < made.n_regressors).all()


def test_true_labels_are_the_poses() -> None:
    ids, R, t = _poses(20)
    made = LabelMaker("true", TABLE)(ids, R, t)
    assert (made.R_m2c == R).all()
    assert (made.t_m2c == t).all()
    assert not made.regressor_index.any()


@pytest.mark.parametrize("labels", ["map", "pitteri2019", "pitteri2019-top", "atlas"])
def test_poses_that_look_the_same_have_one_label(labels: LabelSet) -> None:
    rng = np.random.default_rng(4)
    ids, R, t = _poses(200, 4)
    maker = LabelMaker(labels, TABLE)
    other_R, other_t = R.copy(), t.copy()
    for i, obj_id in enumerate(ids):
        motions = TABLE.entries[int(obj_id)].group.motions(17)
        motion = motions[rng.integers(len(motions))]
        other_R[i], other_t[i] = R[i] @ motion[:3, :3], R[i] @ motion[:3, 3] + t[i]
    a, b = maker(ids, R, t), maker(ids, other_R, other_t)
    assert (a.regressor_index == b.regressor_index).all()
    assert np.abs(a.R_m2c - b.R_m2c).max() < 1e-6
    assert np.abs(a.t_m2c - b.t_m2c).max() < 1e-6


def test_map_is_the_nearest_member_and_has_one_regressor() -> None:
    ids, R, t = _poses(200, 2)
    maker = LabelMaker("map", TABLE)
    made = maker(ids, R, t)
    assert {maker.n_regressors(obj_id) for obj_id in TABLE.entries} == {1}
    for i, obj_id in enumerate(ids):
        group = TABLE.entries[int(obj_id)].group
        members = R[i] @ group.motions(360)[:, :3, :3]
        nearest = np.trace(members, axis1=1, axis2=2).max()  # the largest trace is the smallest angle
        assert np.trace(made.R_m2c[i]) > nearest - 1e-6


def test_seen_from_above_the_top_reference_is_far_from_its_jumps() -> None:
    """An upright C4 part under a camera that looks straight down, turned about the vertical by any angle."""
    down = np.diag([1.0, -1, -1])
    R = down @ rolled(np.linspace(0, 2 * np.pi, 60))
    ids, t = np.full(60, 3), np.tile([0.0, 0, 500], (60, 1))
    margins = {labels: LabelMaker(labels, TABLE)(ids, R, t).margin_deg.min() for labels in LABEL_SETS[2:]}
    assert margins["pitteri2019"] < 1
    assert margins["pitteri2019-top"] > 20
    assert margins["atlas"] > 10


@pytest.mark.parametrize("labels", LABEL_SETS)
def test_a_virtual_camera_sees_the_corners_where_the_homography_puts_them(labels: LabelSet) -> None:
    """Look straight at the part and roll: corners of labels made anew are the moved corners of the same pose."""
    ids, R, t = _poses(50, 7)
    K = np.array([[500.0, 0, 300], [0, 480, 220], [0, 0, 1]])
    K_new = np.array([[700.0, 0, 31.5], [0, 700, 31.5], [0, 0, 1]])
    centre = t @ K.T
    Q = rolled(np.linspace(0, 6, 50)) @ looking_at(centre[:, :2] / centre[:, 2:], K)
    R_new, t_new = turned(Q, R, t)
    assert np.abs(t_new[:, :2]).max() < 1e-9  # straight at it
    made = LabelMaker(labels, TABLE)(ids, R_new, t_new)
    corners = made.corners_px(BOX, K_new)
    for i in range(50):
        back_R, back_t = Q[i].T @ made.R_m2c[i], Q[i].T @ made.t_m2c[i]
        seen = (BOX @ back_R.T + back_t) @ K.T
        there = (seen[:, :2] / seen[:, 2:])[None]
        assert np.allclose(cv2.perspectiveTransform(there, turning_homography(Q[i], K, K_new))[0], corners[i])


def test_labels_of_a_turned_pose_are_not_the_turned_labels() -> None:
    """The trap: with egocentric labels, crops that are merely cut out would be labelled for another view."""
    ids, R, t = _poses(400, 9)
    Q = np.tile(Rotation.from_euler("y", 10, degrees=True).as_matrix(), (400, 1, 1))
    maker = LabelMaker("pitteri2019", TABLE)
    here, there = maker(ids, R, t), maker(ids, *turned(Q, R, t))
    assert 0 < (here.regressor_index != there.regressor_index).mean() < 0.5
    assert np.abs(Q @ here.R_m2c - there.R_m2c).max() > 0.5


def test_allocentric_labels_do_not_depend_on_where_in_the_image_a_part_is() -> None:
    ids, R, t = _poses(100, 3)
    maker = LabelMaker("atlas", TABLE, allocentric=True)
    K = np.eye(3)
    straight = turned(looking_at(t[:, :2] / t[:, 2:], K), R, t)
    simple = ids != 2  # its fixed point is not its origin
    a, b = maker(ids[simple], R[simple], t[simple]), maker(ids[simple], *(x[simple] for x in straight))
    assert (a.regressor_index == b.regressor_index).all()
    assert np.abs(a.margin_deg - b.margin_deg).max() < 1e-6


def test_wrong_requests_are_one_line() -> None:
    with pytest.raises(UserError, match="unknown label set 'pitteri': use one of true, map"):
        LabelMaker("pitteri", TABLE)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="object 9 is not in the symmetry table"):
        LabelMaker("atlas", TABLE)([9], [np.eye(3)], [[0, 0, 500]])
