"""The geometry of a container: an open box on the table, as a closed mesh, and as the convex pieces that it is of."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.spec import ContainerSpec, Mesh

Array = NDArray[np.float64]

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) / 2


def turn(container: ContainerSpec) -> Array:
    """(3, 3) rotation that takes directions along the container's sides to the world."""
    angle = math.radians(container.rotation_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def container_mesh(container: ContainerSpec) -> Mesh:
    """The closed surface of sides and floor, world frame."""
    below, above, rim, floor = range(4)  # the rings of four corners, in the order of _rings
    quads = [_ring(below)[::-1], _ring(floor)]
    for lower, upper in ((below, above), (above, rim), (rim, floor)):
        quads += [[4 * lower + k, 4 * lower + (k + 1) % 4, 4 * upper + (k + 1) % 4, 4 * upper + k] for k in range(4)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Mesh(_rings(container).reshape(-1, 3), np.array(faces, dtype=np.int32))


def container_pieces(container: ContainerSpec) -> list[Array]:
    """Corners (8, 3) of the convex pieces whose union the container is, floor first; world frame."""
    rings = _rings(container)
    sides = [rings[:, [k, (k + 1) % 4]].reshape(-1, 3) for k in range(4)]
    return [rings[[0, 3]].reshape(-1, 3), *sides]


def _ring(number: int) -> list[int]:
    return [4 * number + k for k in range(4)]


def _rings(container: ContainerSpec) -> Array:
    """(4, 4, 3) corners: outside on the table, outside at the rim, inside at the rim, inside on the floor."""
    inside, wall = np.array(container.floor_m), container.wall_m
    lean = math.tan(math.radians(container.slope_deg))
    rings = []
    for height, thickness in ((0.0, wall), (container.height_m, wall), (container.height_m, 0.0), (wall, 0.0)):
        sides = inside + 2 * thickness + 2 * (height - wall) * lean
        rings.append(np.column_stack([_CORNERS * sides, np.full(4, height)]))
    return np.array(rings) @ turn(container).T
