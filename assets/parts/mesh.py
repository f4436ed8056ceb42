"""From a closed surface to the files of a BOP models folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from synthetless.assets.parts.sectors import FloatArray, IntArray, Surface

GRID_MM = 2.0**-14  # a power of two: float32 holds every coordinate, and half of one, without rounding
NORMAL_DECIMALS = 6  # below float32's own precision: no last bit depends on the machine's order of summing
CREASE_DEG = 30.0  # edges sharper than this stay crisp

VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])


def box_centre(vertices: FloatArray) -> FloatArray:
    """The centre of the axis-aligned bounding box, (3,) mm."""
    centre: FloatArray = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return centre


def on_grid(vertices: FloatArray) -> FloatArray:
    """The vertices rounded to the file's grid."""
    rounded: FloatArray = np.rint(vertices / GRID_MM) * GRID_MM
    return rounded


def face_areas_and_normals(surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Areas (m,) in mm^2 and unit normals (m, 3). Raises ValueError for a triangle without area."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    cross = np.cross(b - a, c - a)
    doubled = np.linalg.norm(cross, axis=1)
    if (doubled == 0).any():
        raise ValueError(f"{(doubled == 0).sum()} triangles have no area: first {surface.faces[doubled == 0][0]}")
    return doubled / 2, cross / doubled[:, None]


def corner_normals(surface: Surface, crease_deg: float = CREASE_DEG) -> FloatArray:
    """A unit normal per corner of each face, (m, 3, 3).

    The mean over the faces that meet at the corner and turn less than the crease angle from its own face, weighted by
    area and corner angle: flat faces stay flat beside a fillet, and slivers do not count.
    """
    areas, normals = face_areas_and_normals(surface)
    corners = surface.faces.ravel()
    face_of_corner = np.repeat(np.arange(len(surface.faces)), 3)
    at_vertex = csr_matrix((np.ones(len(corners)), (np.arange(len(corners)), corners)))
    one, other = (at_vertex @ at_vertex.T).nonzero()
    alike = (normals[face_of_corner[one]] * normals[face_of_corner[other]]).sum(axis=1) > np.cos(np.deg2rad(crease_deg))
    one, other = one[alike], other[alike]
    weights = (areas[:, None] * _corner_angles(surface)).ravel()[other, None] * normals[face_of_corner[other]]
    sums = np.stack([np.bincount(one, weights[:, k], len(corners)) for k in range(3)], axis=1)
    unit = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    rounded: FloatArray = np.round(unit, NORMAL_DECIMALS) + 0.0  # no negative zero
    return rounded.reshape(-1, 3, 3)


def _corner_angles(surface: Surface) -> FloatArray:
    points = surface.vertices[surface.faces]
    onward, back = np.roll(points, -1, axis=1) - points, np.roll(points, 1, axis=1) - points
    angles: FloatArray = np.arctan2(np.linalg.norm(np.cross(onward, back), axis=2), (onward * back).sum(axis=2))
    return angles


def ply_bytes(surface: Surface, comment: str) -> bytes:
    """A binary little-endian PLY with float32 positions (mm) and normals, vertices split at the creases."""
    normals = corner_normals(surface).reshape(-1, 3)
    corners = np.hstack([surface.vertices[surface.faces.ravel()], normals])
    vertices, indices = _distinct_rows(corners)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in VERTEX.names or ()),
        f"element face {len(surface.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.zeros(len(surface.faces), FACE)
    faces["count"] = 3
    faces["indices"] = indices.reshape(-1, 3)
    body = np.ascontiguousarray(vertices, "<f4").view(VERTEX).tobytes() + faces.tobytes()
    return ("\n".join(header) + "\n").encode("ascii") + body


def _distinct_rows(corners: FloatArray) -> tuple[NDArray[np.float32], IntArray]:
    """Equal corners (normals to 1e-3) as one vertex, in order of first use."""
    keys = np.hstack([np.rint(corners[:, :3] / (GRID_MM / 2)), np.rint(corners[:, 3:] * 1000)]).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]].astype(np.float32), rank[inverse.ravel()]


def model_info(vertices: FloatArray) -> dict[str, float]:
    """BOP's diameter, min_ and size_ of a model, in mm."""
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    hull = vertices[ConvexHull(vertices).vertices]
    info = {"diameter": float(pdist(hull).max())}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    return info | {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}


def write_models_info(path: Path, infos: dict[int, dict[str, Any]]) -> None:
    """One model a line, keys in numeric order, as BOP's own files."""
    lines = [f'  "{obj_id}": {json.dumps(infos[obj_id])}' for obj_id in sorted(infos)]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="ascii")
