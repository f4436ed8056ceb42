"""Exact symmetry: one sector of a solid, replicated by the rotations of its group.

Booleans keep a symmetric solid symmetric only up to their triangulation. So a solid is cut down to one fundamental
sector, its seams are made to fit their own images, and the whole is assembled from rotated copies: the vertex set
and the triangles are then invariant under the group.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SEAM_TOLERANCE_MM = 1e-4


@dataclass(frozen=True)
class Surface:
    """A closed triangle mesh. `vertices` (n, 3) mm, `faces` (m, 3) indices, counter-clockwise seen from outside."""

    vertices: FloatArray
    faces: IntArray


def rotations(group: str) -> FloatArray:
    """The elements of C_n, D_n (z the main axis, x a two-fold one) or O as (order, 3, 3), the identity first."""
    if group == "C1":
        return np.eye(3)[None]
    matrices = Rotation.create_group(group).as_matrix()
    whole = np.rint(2 * matrices) / 2  # entries 0, +-1/2 and +-1 are meant exactly
    exact: FloatArray = np.where(np.abs(matrices - whole) < 1e-12, whole, matrices)
    from_identity = np.linalg.norm(exact - np.eye(3), axis=(1, 2))
    return exact[np.argsort(from_identity, kind="stable")]


def surface_of(solid: Manifold) -> Surface:
    """The triangles of a solid, without the slivers and fins that booleans leave where faces all but coincide."""
    mesh = solid.to_mesh64()
    points = mesh.vert_properties[:, :3].astype(np.float64)
    labels = _clusters(points)
    _, first = np.unique(labels, return_index=True)
    faces = labels[mesh.tri_verts.astype(np.int64)]
    return Surface(points[first], _without_folds(faces))


def _without_folds(faces: IntArray) -> IntArray:
    """The faces without those that have lost a corner and without pairs that lie back to back."""
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, group, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    single: IntArray = faces[count[group.ravel()] == 1]
    return single


def symmetrised(solid: Manifold, group: str) -> Surface:
    """The surface of `solid`, exactly invariant under `group` about the origin.

    Raises ValueError where the sectors do not close: the solid itself is not symmetric, or a face of it lies in a seam.
    """
    sector = solid.simplify(SEAM_TOLERANCE_MM)
    if group == "C1":
        return surface_of(sector)
    normals = _sector_normals(group)
    for normal in normals:
        sector = sector.trim_by_plane(normal.tolist(), 0.0)
    elements = rotations(group)
    copy = _fitted_to_images(_without_caps(surface_of(sector), normals), elements)
    surface = _merged(copy, elements)
    if not is_closed(surface.faces):
        raise ValueError(
            f"the sectors of the solid do not close under {group}: model it with that symmetry and no face in a seam"
        )
    return surface


def is_closed(faces: IntArray) -> bool:
    """Whether every directed edge occurs once and its opposite too (watertight, consistently wound)."""
    edges = _directed_edges(faces)
    once = len(np.unique(edges, axis=0)) == len(edges)
    return once and len(_boundary_edges(faces)) == 0


def _sector_normals(group: str) -> list[FloatArray]:
    """Inward normals of the planes through the origin that bound a fundamental sector of the group."""
    if group == "O":
        return [np.array(normal) / np.sqrt(2) for normal in ([-1.0, 0, 1], [1.0, -1, 0], [1.0, 1, 0])]
    order = int(group[1:])
    normals = [np.array([0.0, 1.0, 0.0])]
    if order > 2:  # for two, both planes are one
        normals.append(np.array([np.sin(2 * np.pi / order), -np.cos(2 * np.pi / order), 0.0]))
    if group[0] == "D":
        normals.append(np.array([0.0, 0.0, 1.0]))
    return normals


def _without_caps(surface: Surface, normals: Sequence[FloatArray]) -> Surface:
    """The surface without the triangles that lie in a cutting plane."""
    distances = np.abs(surface.vertices @ np.stack(normals, axis=1))
    in_plane = (distances[surface.faces] < SEAM_TOLERANCE_MM / 100).all(axis=1).any(axis=1)
    kept, faces = np.unique(surface.faces[~in_plane], return_inverse=True)
    return Surface(surface.vertices[kept], faces.reshape(-1, 3))


def _fitted_to_images(surface: Surface, elements: FloatArray) -> Surface:
    """Move every seam vertex to the mean of the images that meet it, and give each seam edge its images' vertices."""
    vertices = surface.vertices.copy()
    seam = np.unique(_boundary_edges(surface.faces))
    images = _images(vertices[seam], elements)
    meeting = cKDTree(images).query_ball_point(vertices[seam], SEAM_TOLERANCE_MM)
    vertices[seam] = [images[sorted(near)].mean(axis=0) for near in meeting]
    return _with_split_edges(Surface(vertices, surface.faces), _distinct(_images(vertices[seam], elements)))


def _with_split_edges(surface: Surface, points: FloatArray) -> Surface:
    """Split the open edges at those of the points that lie inside them."""
    vertices = list(surface.vertices)
    faces = [tuple(face) for face in surface.faces.tolist()]
    owner = {edge: index for index, face in enumerate(faces) for edge in _edges_of(face)}
    for a, b in _boundary_edges(surface.faces).tolist():
        inside = _points_inside(vertices[a], vertices[b], points)
        if len(inside) == 0:
            continue
        index = owner[(a, b)]
        c = next(corner for corner in faces[index] if corner not in (a, b))
        chain = [a, *range(len(vertices), len(vertices) + len(inside)), b]
        vertices.extend(inside)
        fan = [(p, q, c) for p, q in pairwise(chain)]
        places = [index, *range(len(faces), len(faces) + len(fan) - 1)]
        faces[index] = fan[0]
        faces.extend(fan[1:])
        owner.update({edge: place for face, place in zip(fan, places, strict=True) for edge in _edges_of(face)})
    return Surface(np.array(vertices), np.array(faces, dtype=np.int64))


def _points_inside(a: FloatArray, b: FloatArray, points: FloatArray) -> FloatArray:
    """The points within the tolerance of the segment from a to b and off its ends, ordered from a to b."""
    length = float(np.linalg.norm(b - a))
    direction = (b - a) / max(length, SEAM_TOLERANCE_MM)
    along = (points - a) @ direction
    off = np.linalg.norm(points - a - along[:, None] * direction, axis=1)
    inside = (off < SEAM_TOLERANCE_MM) & (along > SEAM_TOLERANCE_MM) & (along < length - SEAM_TOLERANCE_MM)
    ordered: FloatArray = points[inside][np.argsort(along[inside], kind="stable")]
    return ordered


def _merged(copy: Surface, elements: FloatArray) -> Surface:
    """All images of one sector as one surface."""
    vertices = _images(copy.vertices, elements)
    faces = (copy.faces[None] + len(copy.vertices) * np.arange(len(elements))[:, None, None]).reshape(-1, 3)
    labels = _clusters(vertices)
    _, first = np.unique(labels, return_index=True)
    return Surface(vertices[first], _without_folds(labels[faces]))


def _images(points: FloatArray, elements: FloatArray) -> FloatArray:
    images: FloatArray = np.einsum("gij,nj->gni", elements, points).reshape(-1, 3)
    return images


def _distinct(points: FloatArray) -> FloatArray:
    return points[np.unique(_clusters(points), return_index=True)[1]]


def _clusters(points: FloatArray) -> IntArray:
    """A label per point, equal for points that coincide."""
    pairs = cKDTree(points).query_pairs(SEAM_TOLERANCE_MM / 100, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    labels: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def _edges_of(face: tuple[int, ...]) -> list[tuple[int, int]]:
    return [(face[0], face[1]), (face[1], face[2]), (face[2], face[0])]


def _directed_edges(faces: IntArray) -> IntArray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _boundary_edges(faces: IntArray) -> IntArray:
    """Directed edges (k, 2) without their opposite, in a fixed order."""
    edges = _directed_edges(faces)
    count = int(faces.max()) + 1
    forward, backward = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    return edges[np.isin(forward, backward, invert=True)]
