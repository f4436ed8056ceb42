"""What a network learns of an instance, under each label set: eight corners, and the regressor that is responsible.

Labels are computed for a batch from poses and the symmetry table, never by moving older labels: the canonical pose of a
turned pose is not the turned canonical pose. So augmentation by turning the camera stays exact, and so does a crop as
seen by a virtual camera that looks straight at the part (``looking_at``). A crop that is merely cut out shows the part
as its allocentric rotation has it, while labels judge the egocentric one: ten degrees off the axis turn the borders of
the regressors' regions by as much. Use crops of a virtual camera, or ``allocentric`` labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.dataset.reader import Instance
from synthetless.errors import UserError
from synthetless.scenes.lens import project
from synthetless.symmetry import CanonicalMap, SymmetryTable
from synthetless.symmetry.quaternions import Floats, minimal, normalise, to_matrix

Integers = NDArray[np.int64]
LabelSet = Literal["true", "map", "pitteri2019", "pitteri2019-top", "atlas"]

LABEL_SETS: tuple[LabelSet, ...] = get_args(LabelSet)
_FROM_ABOVE = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Half a turn about x: seen from above, an upright part is then at the reference, its jumps below the table."""


class OneRegressorMap(CanonicalMap):
    """The paper's Map alone: of the poses that look the same the one nearest to the reference, and one regressor."""

    @cached_property
    def anchors_wxyz(self) -> Floats:
        """The reference."""
        return CanonicalMap.anchors_wxyz.func(self)[:1]  # type: ignore[attr-defined,no-any-return]


@dataclass(frozen=True, eq=False)
class PoseTargets:
    """Labels of N instances.

    Attributes:
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm, the pose to learn.
        regressor_index: (N,) which regressor is responsible.
        n_regressors: (N,) how many the object has.
        margin_deg: (N,) discontinuity margin.
    """

    R_m2c: Floats
    t_m2c: Floats
    regressor_index: Integers
    n_regressors: Integers
    margin_deg: Floats

    def corners_px(self, boxes_mm: Floats, K: Floats, distortion: Floats | None = None) -> Floats:
        """(N, 8, 2) pixels of box corners (N, 8, 3) mm under cameras (N, 3, 3) or (3, 3), and a lens (5,) if any."""
        seen = boxes_mm @ np.swapaxes(self.R_m2c, 1, 2) + self.t_m2c[:, None]
        return project(seen, K, distortion)


class LabelMaker:
    """Labels poses of several objects by one label set."""

    def __init__(self, labels: LabelSet, table: SymmetryTable, allocentric: bool = False) -> None:
        """Prepare.

        Args:
            labels: ``true``: the poses as they are. ``map``: the paper's Map, one regressor. ``pitteri2019`` and
                ``atlas``: the schemes. ``pitteri2019-top``: the paper's scheme with its jumps below the table, for
                upright parts.
            table: the objects' symmetries; its own scheme does not matter.
            allocentric: judge rotations relative to the ray to the object, for crops that are merely cut out.

        Raises:
            UserError: an unknown label set.
        """
        if labels not in LABEL_SETS:
            raise UserError(f"unknown label set {labels!r}: use one of {', '.join(LABEL_SETS)}")
        self.labels = labels
        self._maps: Mapping[int, CanonicalMap] = {}
        if labels != "true":
            self._maps = {obj_id: _map(labels, table, obj_id, allocentric) for obj_id in table.entries}

    def n_regressors(self, obj_id: int) -> int:
        """How many regressors an object has; a UserError if the table lacks it."""
        return self._map(obj_id).n_regressors if self.labels != "true" else 1

    def __call__(self, obj_ids: ArrayLike, R_m2c: ArrayLike, t_m2c: ArrayLike) -> PoseTargets:
        """The labels of N poses.

        Args:
            obj_ids: (N,).
            R_m2c, t_m2c: true poses (N, 3, 3), (N, 3) mm, in the frame of the camera that the network sees through.

        Raises:
            UserError: an object is not in the table, or a pose is invalid.
        """
        ids = np.asarray(obj_ids, dtype=np.int64)
        R, t = np.array(R_m2c, dtype=np.float64), np.array(t_m2c, dtype=np.float64)
        index, counts, margin = np.zeros(len(ids), np.int64), np.ones(len(ids), np.int64), np.full(len(ids), 180.0)
        if self.labels != "true":
            for obj_id in np.unique(ids):
                rows = np.flatnonzero(ids == obj_id)
                found = self._map(int(obj_id))(R[rows], t[rows])
                R[rows], t[rows], index[rows] = found.R_m2c, found.t_m2c, found.regressor_index
                counts[rows], margin[rows] = found.n_regressors, found.discontinuity_margin_deg
        return PoseTargets(R, t, index, counts, margin)

    def _map(self, obj_id: int) -> CanonicalMap:
        if obj_id not in self._maps:
            raise UserError(f"object {obj_id} is not in the symmetry table, which has {sorted(self._maps)}")
        return self._maps[obj_id]


def _map(labels: LabelSet, table: SymmetryTable, obj_id: int, allocentric: bool) -> CanonicalMap:
    entry = table.entries[obj_id]
    if labels == "map":
        return OneRegressorMap(entry.group, "pitteri2019", entry.reference_rotation, allocentric)
    if labels == "pitteri2019-top":
        return replace(entry, reference_rotation=_FROM_ABOVE).canonical_map("pitteri2019", allocentric)
    return entry.canonical_map("atlas" if labels == "atlas" else "pitteri2019", allocentric)


@dataclass(frozen=True, eq=False)
class CosetTargets:
    """Labels of N instances that are learned coarsely, then finely, of objects that are nearly symmetrical.

    Attributes:
        poses: canonical under the quasi-symmetry group H, with their regressors; margins are not known: NaN.
        alike: (N, k) which left cosets h G of the exact group in H the image leaves open, all of them right answers.
        n_cosets: (N,) how many of the columns exist.
    """

    poses: PoseTargets
    alike: NDArray[np.bool_]
    n_cosets: Integers


def coset_targets(instances: Sequence[Instance], maker: LabelMaker) -> CosetTargets:
    """The labels of a dataset's instances, as ``synthetless ambiguity`` has judged them.

    What hides the detail belongs to the image, so these labels are read, not computed: an augmentation that turns the
    camera needs the dataset judged anew.

    Args:
        instances: N of them. Those of objects without a quasi-symmetry group have one coset, and the pose of ``maker``.
        maker: labels the others; egocentric, as the recorded labels are.
    """
    R, t = (np.array([getattr(n, name) for n in instances], dtype=np.float64) for name in ("R_m2c", "t_m2c"))
    exact = maker([n.obj_id for n in instances], R.reshape(-1, 3, 3), t.reshape(-1, 3))
    n_cosets = np.array([1 if n.quasi is None else len(n.quasi.alike) for n in instances], dtype=np.int64)
    alike = np.zeros((len(instances), int(n_cosets.max(initial=1))), dtype=bool)
    alike[:, 0] = True
    margin = exact.margin_deg.copy()
    for i, quasi in enumerate(n.quasi for n in instances):
        if quasi is not None:
            exact.R_m2c[i], exact.t_m2c[i] = quasi.R_m2c, quasi.t_m2c
            exact.regressor_index[i], exact.n_regressors[i] = quasi.index, quasi.n_indices
            margin[i] = np.nan
            alike[i, : len(quasi.alike)] = quasi.alike
    return CosetTargets(replace(exact, margin_deg=margin), alike, n_cosets)


def looking_at(points_px: ArrayLike, K: ArrayLike) -> Floats:
    """Rotations (N, 3, 3) from the camera to virtual ones at its place whose axes pass through pixels (N, 2).

    Of all such rotations the smallest. A pose in the virtual camera's frame is ``Q @ R_m2c``, ``Q @ t_m2c``.
    """
    pixels = np.asarray(points_px, dtype=np.float64)
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    rays = normalise(np.linalg.solve(np.asarray(K, dtype=np.float64), homogeneous[..., None])[..., 0])
    return to_matrix(minimal(rays, np.array([0.0, 0.0, 1.0])))


def rolled(angles_rad: ArrayLike) -> Floats:
    """Rotations (N, 3, 3) about the camera's axis that turn the picture clockwise (x towards y) by angles (N,)."""
    c, s = np.cos(np.asarray(angles_rad)), np.sin(np.asarray(angles_rad))
    o, i = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack(row, axis=-1) for row in ((c, -s, o), (s, c, o), (o, o, i))], axis=-2)


def turned(Q: Floats, R_m2c: Floats, t_m2c: Floats) -> tuple[Floats, Floats]:
    """Poses (N, 3, 3), (N, 3) in the frames of cameras turned by Q (N, 3, 3)."""
    return Q @ R_m2c, np.einsum("nij,nj->ni", Q, t_m2c)


def turning_homography(Q: Floats, K: Floats, K_new: Floats) -> Floats:
    """The homography (3, 3) from pixels of a camera K to those of one with K_new that is turned by Q: exact."""
    return np.asarray(K_new @ Q @ np.linalg.inv(K))
