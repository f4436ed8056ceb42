"""From measured poses and a symmetry table to the labels a network learns: scene_gt_canonical.json."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.layout import DATASET_FILE, PENDING_FILE, SYMMETRIES_FILE
from synthetless.dataset.reader import ScenePoses, as_floats
from synthetless.dataset.records import CameraEntry, CanonicalEntry, GtEntry, ModelInfo
from synthetless.errors import UserError
from synthetless.io.files import is_locked
from synthetless.io.models import box_corners
from synthetless.scenes.lens import project
from synthetless.symmetry import CanonicalMap, CanonicalPoses, SymmetryTable

Floats = NDArray[np.float64]


def label_scene(
    scene_gt: Mapping[int, Sequence[GtEntry]],
    scene_camera: Mapping[int, CameraEntry],
    table: SymmetryTable,
    models_info: Mapping[int, ModelInfo],
    only: Collection[int] | None = None,
    stored: Mapping[int, Sequence[CanonicalEntry]] | None = None,
) -> dict[int, list[CanonicalEntry]]:
    """Labels of every instance of a scene folder, all instances of an object at once.

    Args:
        scene_gt: BOP's poses by image id.
        scene_camera: BOP's cameras by image id.
        table: symmetries and scheme.
        models_info: BOP's entry of each object; its box is the one whose corners are projected.
        only: the objects to label; all of them if None.
        stored: labels of the same instances, from which those of all other objects are taken.

    Returns:
        Content of scene_gt_canonical.json, in the order of ``scene_gt``.

    Raises:
        UserError: an object has no entry in the table or in models_info, an image has no camera, or an entry is
            damaged; with the file, the image and the instance.
    """
    poses = ScenePoses.of(scene_gt, scene_camera)
    found = set(np.unique(poses.obj_ids).tolist())
    wanted = found if only is None else found & set(only)
    if wanted != found and stored is None:
        raise ValueError(f"objects {sorted(found - wanted)} are not to be labelled, and there are no stored labels")
    kept = [] if stored is None else [label for im_id in scene_gt for label in stored[im_id]]
    labels = dict(enumerate(kept))
    K, distortion = poses.K, poses.distortion
    for obj_id in sorted(wanted):
        corners_mm = _corners_of(obj_id, models_info)
        rows = np.flatnonzero(poses.obj_ids == obj_id)
        canonical = _canonical(poses, rows, table.canonical_map(obj_id))
        corners_px = _projected(K[rows], distortion[rows], canonical, corners_mm)
        labels |= zip(rows.tolist(), _entries(obj_id, canonical, corners_px), strict=True)
    rows_in_turn = iter(range(len(poses.obj_ids)))
    return {im_id: [labels[next(rows_in_turn)] for _ in entries] for im_id, entries in scene_gt.items()}


@dataclass(frozen=True)
class LabelState:
    """Which symmetries a dataset's labels are of.

    Attributes:
        table: those that they are of, or are being changed to.
        trusted: whether every label is of them; otherwise all of them are to be made again.
    """

    table: SymmetryTable
    trusted: bool

    @classmethod
    def read(cls, root: Path, header: Mapping[str, Any]) -> LabelState:
        """The state of the dataset in ``root`` with this dataset.json.

        Raises:
            UserError: the symmetry table is missing or damaged.
        """
        if is_half_labelled(root):
            return cls(SymmetryTable.read(root / PENDING_FILE), False)
        table = SymmetryTable.read(root / SYMMETRIES_FILE)
        return cls(table, header.get("symmetries") == describe_symmetries(table))


def describe_symmetries(table: SymmetryTable) -> dict[str, str]:
    """What dataset.json says of the symmetries that the labels were made with."""
    return {"scheme": table.scheme, "sha256": table.digest()}


def is_half_labelled(root: Path) -> bool:
    """Whether a process was killed while it replaced labels, so that they may be of two symmetry tables."""
    return (root / PENDING_FILE).exists()


def refuse_half_labelled(root: Path) -> None:
    """For those who only read: labels of two symmetry tables must not get mixed.

    Raises:
        UserError: they may be.
    """
    if is_half_labelled(root):
        raise UserError(f"{root}: is half relabelled; run relabel (or adopt) again, which completes it")


@contextmanager
def undisturbed(root: Path, may_grow: bool = False) -> Iterator[None]:
    """For those who only read a dataset: what they conclude from files that change meanwhile would be false.

    Nothing is written, so that a dataset on a read-only disk can be read.

    Args:
        root: the dataset's folder.
        may_grow: whether new images may be added meanwhile; those who read assembled files do not notice.

    Raises:
        UserError: another process writes the dataset, or has written it before the block ended.
    """
    before = _stamps(root)

    def refuse(strictly: bool) -> None:
        now = _stamps(root)
        if now[1:] != before[1:] or (strictly and (is_locked(root) or now != before)):
            raise UserError(f"{root}: another synthetless is writing here, or was meanwhile; try again when it is done")

    refuse(not may_grow)
    try:
        yield
    except UserError:
        refuse(strictly=True)
        raise
    refuse(not may_grow)


def _stamps(root: Path) -> list[tuple[int, int] | None]:
    """What becomes different when dataset.json is written anew; and, behind the first, when labels are."""
    paths = [root / name for name in (DATASET_FILE, SYMMETRIES_FILE, PENDING_FILE)]
    found = [path.stat() if path.exists() else None for path in paths]
    return [None if status is None else (status.st_ino, status.st_mtime_ns) for status in found]


def box_corners_mm(info: ModelInfo) -> Floats:
    """(8, 3) corners of the box of a models_info.json entry, model frame, in ``box_corners``' order.

    Raises:
        UserError: the entry has no box.
    """
    sides = [as_floats([info.get(f"{what}_{axis}") for axis in "xyz"]) for what in ("min", "size")]
    if not all(side.shape == (3,) and np.isfinite(side).all() for side in sides):
        raise UserError("the box needs the numbers min_x, min_y, min_z, size_x, size_y, size_z")
    low, size = sides
    return box_corners(low, low + size)


def _projected(K: Floats, distortion: Floats, poses: CanonicalPoses, points_mm: Floats) -> Floats:
    """(N, P, 2) pixels (u, v) of model points (P, 3) under N poses, cameras (N, 3, 3) and lenses (N, 5).

    A point in the camera's plane or behind it is projected all the same, and may be far away; infinite ones become 0.
    """
    in_camera = np.einsum("nij,pj->npi", poses.R_m2c, points_mm) + poses.t_m2c[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = project(in_camera, K, distortion)
    return np.where(np.isfinite(pixels), pixels, 0.0)


def _corners_of(obj_id: int, models_info: Mapping[int, ModelInfo]) -> Floats:
    if obj_id not in models_info:
        raise UserError(f"models_info.json: no entry for object {obj_id}, which scene_gt.json names")
    try:
        return box_corners_mm(models_info[obj_id])
    except ValueError as error:
        raise UserError(f"models_info.json: object {obj_id}: {error}") from None


def _canonical(poses: ScenePoses, rows: NDArray[np.intp], canonical_map: CanonicalMap) -> CanonicalPoses:
    """The canonical poses of some instances; which of them is invalid is only searched for when one is."""
    try:
        return canonical_map(poses.R_m2c[rows], poses.t_m2c[rows])
    except ValueError:
        for row in rows.tolist():
            try:
                canonical_map(poses.R_m2c[[row]], poses.t_m2c[[row]])
            except ValueError as error:
                fault = str(error).removeprefix("pose 0: ")
                raise UserError(f"{poses.place(row)}: {fault}") from None
        raise


def _entries(obj_id: int, poses: CanonicalPoses, corners_px: Floats) -> Iterator[CanonicalEntry]:
    for R, t, index, margin_deg, corners in zip(
        poses.R_m2c.reshape(-1, 9).tolist(),
        poses.t_m2c.tolist(),
        poses.regressor_index.tolist(),
        poses.discontinuity_margin_deg.tolist(),
        np.round(corners_px, 6).tolist(),
        strict=True,
    ):
        yield {
            "obj_id": obj_id,
            "cam_R_m2c_canonical": R,
            "cam_t_m2c_canonical": t,
            "regressor_index": index,
            "n_regressors": int(poses.n_regressors),
            "discontinuity_margin_deg": margin_deg,
            "bbox3d_corners_2d": corners,
        }
