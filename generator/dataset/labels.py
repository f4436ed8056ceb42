"""From measured poses and a symmetry table to the labels a network learns: scene_gt_canonical.json."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.symmetry import CanonicalMap, CanonicalPoses, SymmetryTable

Entry = dict[str, Any]
Floats = NDArray[np.float64]
Place = TypeVar("Place")


def label_scene(
    scene_gt: Mapping[int, Sequence[Entry]],
    scene_camera: Mapping[int, Entry],
    table: SymmetryTable,
    models_info: Mapping[int, Entry],
    only: Collection[int] | None = None,
) -> dict[int, list[Entry]]:
    """Labels of every instance of a scene folder, all instances of an object at once.

    Args:
        scene_gt: BOP's poses by image id.
        scene_camera: BOP's cameras by image id.
        table: symmetries and scheme.
        models_info: BOP's entry of each object; its box is the one whose corners are projected.
        only: the objects to label, the entries of others stay empty; all objects if None.

    Returns:
        Content of scene_gt_canonical.json, in the order of ``scene_gt``.

    Raises:
        UserError: an object has no entry in the table or in models_info, an image has no camera, or an entry is
            damaged; with the file, the image and the instance.
    """
    poses = _Poses.of(scene_gt, scene_camera)
    labels: list[Entry] = [{} for _ in poses.places]
    for obj_id in np.unique(poses.obj_ids).tolist():
        if only is not None and obj_id not in only:
            continue
        corners_mm = _corners_of(obj_id, models_info)
        rows = np.flatnonzero(poses.obj_ids == obj_id)
        canonical = poses.labelled(table.canonical_map(obj_id), rows)
        corners_px = project(poses.K[rows], canonical, corners_mm)
        for row, entry in zip(rows.tolist(), _entries(obj_id, canonical, corners_px), strict=True):
            labels[row] = entry
    rest = iter(labels)
    return {im_id: [next(rest) for _ in entries] for im_id, entries in scene_gt.items()}


def box_corners_mm(info: Entry) -> Floats:
    """(8, 3) corners of the box of a models_info.json entry, model frame; x varies slowest, z fastest.

    Raises:
        UserError: the entry has no box.
    """
    sides = [_array([info.get(f"{what}_{axis}") for axis in "xyz"]) for what in ("min", "size")]
    if not all(side.shape == (3,) and np.isfinite(side).all() for side in sides):
        raise UserError("the box needs the numbers min_x, min_y, min_z, size_x, size_y, size_z")
    choice = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    return sides[0] + choice * sides[1]


def project(K: Floats, poses: CanonicalPoses, points_mm: Floats) -> Floats:
    """Pixel coordinates of model points under each pose.

    Args:
        K: (N, 3, 3) camera matrices.
        poses: N poses, model to camera.
        points_mm: (P, 3) in the model frame.

    Returns:
        (N, P, 2) coordinates (u, v). A point in the camera's plane or behind it is projected all the same, as
        through a pinhole, and may be far away or infinite; infinite ones become 0.
    """
    in_camera = np.einsum("nij,pj->npi", poses.R_m2c, points_mm) + poses.t_m2c[:, None]
    homogeneous = np.einsum("nij,npj->npi", K, in_camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels: Floats = homogeneous[..., :2] / homogeneous[..., 2:]
    return np.where(np.isfinite(pixels), pixels, 0.0)


def _corners_of(obj_id: int, models_info: Mapping[int, Entry]) -> Floats:
    if obj_id not in models_info:
        raise UserError(f"models_info.json: no entry for object {obj_id}, which scene_gt.json names")
    try:
        return box_corners_mm(models_info[obj_id])
    except ValueError as error:
        raise UserError(f"models_info.json: object {obj_id}: {error}") from None


@dataclass(frozen=True, eq=False)
class _Poses:
    """All instances of a scene folder, in scene_gt's order.

    Attributes:
        places: image id and number in the image.
        obj_ids: (N,).
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm.
        K: (N, 3, 3), of the image's camera.
    """

    places: list[tuple[int, int]]
    obj_ids: NDArray[np.int64]
    R_m2c: Floats
    t_m2c: Floats
    K: Floats

    @classmethod
    def of(cls, scene_gt: Mapping[int, Sequence[Entry]], scene_camera: Mapping[int, Entry]) -> _Poses:
        for im_id, entries in scene_gt.items():
            if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                raise UserError(f"scene_gt.json: image {im_id} has no list of instances")
            if not isinstance(scene_camera.get(im_id), dict):
                raise UserError(f"scene_camera.json: image {im_id} of scene_gt.json has no entry")
        places = [(im_id, gt_id) for im_id, entries in scene_gt.items() for gt_id in range(len(entries))]
        every = [entry for entries in scene_gt.values() for entry in entries]
        for place, entry in zip(places, every, strict=True):
            if not isinstance(entry.get("obj_id"), int):
                raise UserError(f"{_instance(place)}: obj_id is {entry.get('obj_id')!r}, not a whole number")
        counts = [len(entries) for entries in scene_gt.values()]
        cameras = _rows([scene_camera[im_id].get("cam_K") for im_id in scene_gt], 9, "cam_K", list(scene_gt), _image)
        return cls(
            places,
            np.array([entry["obj_id"] for entry in every], dtype=np.int64),
            _rows([entry.get("cam_R_m2c") for entry in every], 9, "cam_R_m2c", places, _instance).reshape(-1, 3, 3),
            _rows([entry.get("cam_t_m2c") for entry in every], 3, "cam_t_m2c", places, _instance),
            np.repeat(cameras, np.array(counts, dtype=np.intp), axis=0).reshape(-1, 3, 3),
        )

    def labelled(self, canonical_map: CanonicalMap, rows: NDArray[np.intp]) -> CanonicalPoses:
        """The canonical poses of some instances; which of them is no pose is only asked when one is none."""
        try:
            return canonical_map(self.R_m2c[rows], self.t_m2c[rows])
        except ValueError:
            for row in rows.tolist():
                try:
                    canonical_map(self.R_m2c[[row]], self.t_m2c[[row]])
                except ValueError as error:
                    fault = str(error).removeprefix("pose 0: ")
                    raise UserError(f"{_instance(self.places[row])}: {fault}") from None
            raise


def _rows(values: list[Any], count: int, name: str, places: list[Place], where: Callable[[Place], str]) -> Floats:
    """Lists of numbers as an array (N, count); a list that is none is named by its place."""
    if (array := _array(values)).shape == (len(values), count) and np.isfinite(array).all():
        return array
    for place, value in zip(places, values, strict=True):
        if (row := _array(value)).shape != (count,) or not np.isfinite(row).all():
            raise UserError(f"{where(place)}: {name} is {reprlib.repr(value)}, not {count} finite numbers")
    return np.empty((0, count))


def _array(values: Any) -> Floats:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(())


def _image(im_id: int) -> str:
    return f"scene_camera.json: image {im_id}"


def _instance(place: tuple[int, int]) -> str:
    return f"scene_gt.json: image {place[0]}, instance {place[1]}"


def _entries(obj_id: int, poses: CanonicalPoses, corners_px: Floats) -> Iterator[Entry]:
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
