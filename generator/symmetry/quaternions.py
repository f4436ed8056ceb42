"""Unit quaternions (w, x, y, z), Hamilton product, as NumPy arrays with the four numbers in the last axis.

q and -q are the same rotation. `multiply(p, q)` is the rotation "first q, then p", as with matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from synthetless.errors import UserError

Floats = NDArray[np.float64]

IDENTITY: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
MAX_DEFECT = 1e-2  # Frobenius distance of a matrix from the nearest rotation that still counts as rounding
_NEARLY_OPPOSITE = 1e-2  # length of the sum of two unit vectors below which 1 + u.v has lost its last four digits


def multiply(p: Floats, q: Floats) -> Floats:
    """The product p q of (broadcastable) quaternion arrays (..., 4)."""
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: Floats) -> Floats:
    """The inverse rotations, (..., 4)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def normalise(q: ArrayLike) -> Floats:
    """Vectors of any dimension scaled to length 1 along the last axis."""
    values = np.asarray(q, dtype=np.float64)
    return np.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True))


def from_axis_angle(axis: ArrayLike, angle_rad: ArrayLike) -> Floats:
    """Rotations by angles (...) about unit axes (..., 3), as (..., 4)."""
    half = np.asarray(angle_rad, dtype=np.float64)[..., None] / 2
    vector = np.sin(half) * np.asarray(axis, dtype=np.float64)
    return np.concatenate([np.broadcast_to(np.cos(half), (*vector.shape[:-1], 1)), vector], axis=-1)


def minimal(u: Floats, v: Floats) -> Floats:
    """The smallest rotations (..., 4) taking unit vectors u to unit vectors v, both (..., 3) and not opposite.

    (1 + u.v, u x v), normalised. Near v = -u both parts lose their digits; there |u + v| / 2 is the cosine of half the
    angle and u x (u + v) the axis, in which nothing cancels.
    """
    u, v = np.broadcast_arrays(u, v)
    rotations = normalise(np.concatenate([1 + np.sum(u * v, axis=-1, keepdims=True), cross(u, v)], axis=-1))
    together = np.linalg.norm(u + v, axis=-1)
    if (near := together < _NEARLY_OPPOSITE).any():
        half, axis = together[near][:, None] / 2, cross(u[near], u[near] + v[near])
        rotations[near] = normalise(np.concatenate([half, axis / (2 * half)], axis=-1))
    return rotations


def rotate(q: Floats, v: Floats) -> Floats:
    """The vectors v (..., 3) turned by q (..., 4)."""
    w, xyz = q[..., :1], q[..., 1:]
    twice = 2 * cross(xyz, v)
    return v + w * twice + cross(xyz, twice)


def cross(u: Floats, v: Floats) -> Floats:
    """The cross products of (broadcastable) vectors (..., 3), several times as fast as `numpy.cross`."""
    (ux, uy, uz), (vx, vy, vz) = (u[..., i] for i in range(3)), (v[..., i] for i in range(3))
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=-1)


def angle_deg(p: Floats, q: Floats) -> Floats:
    """Geodesic rotation angle between p and q in degrees, 0 to 180, accurate for tiny angles as well."""
    far, near = np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1)
    return np.asarray(np.degrees(4 * np.arctan2(np.minimum(far, near), np.maximum(far, near))))


def to_matrix(q: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    products = q[..., :, None] * q[..., None, :]
    flat = products.reshape(*q.shape[:-1], 16) @ _linear_maps().matrix_of_products
    return np.asarray(flat.reshape(*q.shape[:-1], 3, 3))


def from_matrix(R: ArrayLike, name: Callable[[int], str] = "rotation {}".format) -> Floats:
    """Unit quaternions (N, 4) of rotation matrices (N, 3, 3).

    A matrix that is slightly off (rounding in a file) is replaced by its nearest rotation. With P = (K + 1) / 4, K the
    symmetric 4x4 matrix of Bar-Itzhack ("New method for extracting the quaternion from a rotation matrix", 2000), an
    exact rotation has P = q q^T, and the nearest rotation's q is P's dominant eigenvector: two power steps from the
    best axis find it to second order in the error.

    Raises:
        UserError: a matrix with NaN, a reflection, or one farther than `MAX_DEFECT` from any rotation; `name` says
            how to call number i.
    """
    matrices = np.asarray(R, dtype=np.float64)
    flat = matrices.reshape(-1, 9)
    P = (flat @ _linear_maps().projector_of_matrix + np.eye(4).ravel() / 4).reshape(-1, 4, 4)
    best = np.argmax(P[:, range(4), range(4)], axis=1)
    start = P[np.arange(len(P)), best]
    with np.errstate(invalid="ignore", divide="ignore"):
        start /= np.sqrt(np.einsum("ni,ni->n", start, start))[:, None]
        q = np.einsum("nij,nj->ni", P, start)
        eigenvalue = np.sqrt(np.einsum("ni,ni->n", q, q))
        q /= eigenvalue[:, None]
    # |R - R(q)|^2 = |R|^2 + 3 - 2 trace(R^T R(q)), and the trace is 4 q^T P q - 1.
    defect = np.einsum("ni,ni->n", flat, flat) + 5 - 8 * eigenvalue
    bad = ~(defect <= MAX_DEFECT**2)
    if bad.any():
        i = int(np.argmax(bad))
        raise UserError(f"{name(i)} is no rotation: {_what_is_wrong(flat[i].reshape(3, 3))}")
    return np.asarray(q)


def _what_is_wrong(matrix: Floats) -> str:
    shown = np.array2string(matrix.ravel(), precision=4, max_line_width=1000, separator=", ")
    if not np.isfinite(matrix).all():
        return f"{shown} has a number that is not finite"
    if abs(np.linalg.det(matrix) + 1) < 0.1:
        return f"{shown} is a reflection (determinant -1), which no rigid motion can show"
    return f"{shown} is not orthonormal with determinant 1"


class _LinearMaps(NamedTuple):
    matrix_of_products: Floats  # (16, 9): products q_i q_j -> R
    projector_of_matrix: Floats  # (9, 16): R -> P - 1/4


@cache
def _linear_maps() -> _LinearMaps:
    maps = np.zeros((4, 4, 3, 3))
    basis = np.eye(4)
    for i, p in enumerate(basis):
        for j, q in enumerate(basis):
            maps[i, j] = multiply(multiply(p, basis[1:]), conjugate(q))[:, 1:].T  # R(q) v = q v conj(q)
    symmetric = (maps + maps.transpose(1, 0, 2, 3)) / 2
    # trace(R^T R(x)) is x^T K x: K's entries are sums of R's with these coefficients.
    return _LinearMaps(maps.reshape(16, 9), symmetric.reshape(16, 9).T / 4)
