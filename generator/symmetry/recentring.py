"""Models moved so that their symmetry axis is z through the origin, and poses carried between both frames.

Some readers of models_info.json take every symmetry for one about a coordinate axis through the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.errors import UserError
from synthetless.io.documents import read_document, shown
from synthetless.io.files import write_json
from synthetless.symmetry.groups import SymmetryGroup
from synthetless.symmetry.quaternions import from_matrix, to_matrix
from synthetless.symmetry.table import object_id

Floats = NDArray[np.float64]

RECENTRED_FILE = "recentred.json"
"""In a models folder: how each model was moved."""


@dataclass(frozen=True, eq=False)
class Recentring:
    """A rigid motion of a model: a point p of the given frame is at R p + t in the written one.

    Attributes:
        R: (3, 3) rotation.
        t_mm: (3,) translation.
    """

    R: Floats
    t_mm: Floats

    @classmethod
    def of(cls, group: SymmetryGroup) -> Recentring:
        """What brings a group into the standard frame, its fixed point to the origin."""
        R = to_matrix(group.frame_wxyz[None])[0].T
        return cls(R, 0.0 - R @ np.array(group.offset_mm))

    @property
    def is_none(self) -> bool:
        """Whether nothing moves."""
        return bool((np.eye(3) == self.R).all() and not self.t_mm.any())

    def points(self, points_mm: ArrayLike) -> Floats:
        """(N, 3) points of the given frame in the written one."""
        moved: Floats = np.asarray(points_mm, dtype=np.float64) @ self.R.T + self.t_mm
        return moved

    def group(self, group: SymmetryGroup) -> SymmetryGroup:
        """A group of the given frame in the written one."""
        axis, secondary = (None if u is None else self.R @ np.array(u) for u in (group.axis, group.secondary_axis))
        return SymmetryGroup.from_name(group.name, axis, secondary, self.points(group.offset_mm))

    def pose_recentred(self, R_m2c: ArrayLike, t_m2c: ArrayLike) -> tuple[Floats, Floats]:
        """The pose (3, 3), (3,) mm of the written model that stands where the given one has this pose."""
        R = np.asarray(R_m2c, dtype=np.float64) @ self.R.T
        return R, np.asarray(t_m2c, dtype=np.float64) - R @ self.t_mm

    def pose_back(self, R_m2c: ArrayLike, t_m2c: ArrayLike) -> tuple[Floats, Floats]:
        """The pose (3, 3), (3,) mm of the given model that stands where the written one has this pose."""
        R, t = np.asarray(R_m2c, dtype=np.float64), np.asarray(t_m2c, dtype=np.float64)
        return R @ self.R, R @ self.t_mm + t


def write_recentrings(folder: Path, motions: Mapping[int, Recentring]) -> None:
    """Write recentred.json: {"3": {"R": [9 numbers, by rows], "t_mm": [3 numbers]}, ...}; the same float64 are read."""
    content = {str(i): {"R": m.R.ravel().tolist(), "t_mm": m.t_mm.tolist()} for i, m in motions.items()}
    write_json(folder / RECENTRED_FILE, content)


def read_recentrings(folder: Path) -> dict[int, Recentring]:
    """How the models of a folder were moved, by object id.

    Raises:
        UserError: recentred.json is missing or damaged.
    """
    path = folder / RECENTRED_FILE
    if not path.exists():
        raise UserError(f"{path}: not found; symmetries detect --recentre writes it beside the models")
    content = read_document(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: is {shown(content)}, not a mapping of object ids to R and t_mm")
    return {object_id(key): _motion(f"{path}: object {key}", entry) for key, entry in content.items()}


def _motion(place: str, entry: object) -> Recentring:
    try:
        assert isinstance(entry, dict)
        R, t_mm = np.array(entry["R"], dtype=np.float64).reshape(3, 3), np.array(entry["t_mm"], dtype=np.float64)
        assert t_mm.shape == (3,)
        assert np.isfinite(t_mm).all()
    except (AssertionError, KeyError, TypeError, ValueError):
        raise UserError(f"{place}: is {shown(entry)}; R with 9 numbers and t_mm with 3 are needed") from None
    from_matrix(R[None], name=lambda _: f"{place}: R")  # refuses what is no rotation
    return Recentring(R, t_mm)
