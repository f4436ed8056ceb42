"""Model the built-in parts again: ``python -m synthetless.assets.parts.build [FOLDER]``.

Writes obj_%06d.ply and models_info.json.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from synthetless.assets.parts.catalogue import PARTS, Part
from synthetless.assets.parts.mesh import box_centre, model_info, on_grid, ply_bytes, write_models_info
from synthetless.assets.parts.sectors import FloatArray, Surface, is_closed, rotations, surface_of, symmetrised

CONTINUOUS_AXES = {"SO(2)": ["z"], "O(2)": ["z"], "SO(3)": ["z", "x"]}
LAID_OVER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # the model's z becomes the file's y


def build(folder: Path) -> None:
    """Write all parts into the folder. Raises ValueError where a part breaks a promise of its own."""
    infos = {}
    for part in tqdm(PARTS, desc="parts", disable=None):
        surface, centre = modelled(part)
        comment = f"SyntheT-Less part {part.obj_id}: {part.name} (CC0-1.0)"
        ply_path(folder, part).write_bytes(ply_bytes(surface, comment))
        infos[part.obj_id] = model_info(surface.vertices) | symmetries(part, centre)
    write_models_info(folder / "models_info.json", infos)


def ply_path(folder: Path, part: Part) -> Path:
    return folder / f"obj_{part.obj_id:06d}.ply"


def modelled(part: Part) -> tuple[Surface, FloatArray]:
    """The part in its file's frame, and the point (3,) mm there that its symmetries fix."""
    solid = part.solid()
    raw = surface_of(solid) if part.group in CONTINUOUS_AXES else symmetrised(solid, part.group)
    vertices = on_grid(raw.vertices @ frame(part).T)
    shift = -box_centre(vertices) - [part.origin_x_mm, 0, 0]
    if not is_closed(raw.faces):
        raise ValueError(f"part {part.obj_id} ({part.name}) is not closed")
    return Surface(vertices + shift + 0.0, raw.faces), shift  # no negative zero


def frame(part: Part) -> FloatArray:
    """The rotation (3, 3) from the frame of the part's solid to the frame of its file."""
    return LAID_OVER if part.axis == "y" else np.eye(3)


def symmetries(part: Part, centre: FloatArray) -> dict[str, list[Any]]:
    """BOP's entries for the part's group: discrete ones closed and without the identity, translations in mm."""
    found: dict[str, list[Any]] = {}
    discrete = discrete_elements(part, centre)
    if len(discrete):
        found["symmetries_discrete"] = [(element.ravel() + 0.0).tolist() for element in discrete]
    if part.group in CONTINUOUS_AXES:
        axes = {"x": [1, 0, 0], "z": [0, 0, 1]}
        found["symmetries_continuous"] = [
            {"axis": axes[name], "offset": [0, 0, 0]} for name in CONTINUOUS_AXES[part.group]
        ]
    return found


def discrete_elements(part: Part, centre: FloatArray) -> FloatArray:
    """The elements but the identity as (k, 4, 4); of O(2), whose rotations about z are continuous, the flip."""
    if part.group == "O(2)":
        elements = np.diag([1.0, -1.0, -1.0])[None]
    else:
        elements = rotations("C1" if part.group in CONTINUOUS_AXES else part.group)[1:]
    turns = frame(part) @ elements @ frame(part).T
    matrices = np.tile(np.eye(4), (len(turns), 1, 1))
    matrices[:, :3, :3] = turns
    matrices[:, :3, 3] = np.round(centre - turns @ centre, 9)
    return matrices


if __name__ == "__main__":
    build(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
