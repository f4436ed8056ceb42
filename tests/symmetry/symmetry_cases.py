"""What the symmetry tests share: the groups, structured and random poses, a mesh with a given symmetry."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, from_axis_angle, multiply, normalise, to_matrix

CYCLIC = ["C2", "C3", "C4", "C5", "C6", "C12"]
DIHEDRAL = ["D2", "D3", "D4", "D5", "D6"]
POLYHEDRAL = ["T", "O", "I"]
CONTINUOUS = ["SO(2)", "O(2)", "SO(3)"]
FINITE = ["C1", *CYCLIC, *DIHEDRAL, *POLYHEDRAL]
ALL = [*FINITE, *CONTINUOUS]
SCHEMES = ["pitteri2019", "atlas"]
ORDERS = {"C1": 1, "T": 12, "O": 24, "I": 60}
ORDERS |= {name: int(name[1:]) for name in CYCLIC} | {name: 2 * int(name[1:]) for name in DIHEDRAL}

seeds = st.integers(0, 2**32 - 1)


def random_rotations(rng: np.random.Generator, n: int) -> Floats:
    return to_matrix(normalise(rng.normal(size=(n, 4))))


def axis_aligned_rotations() -> Floats:
    """The 24 rotations that permute the coordinate axes, exact to the last bit."""
    signed = [p * s for p in _permutations() for s in _signs()]
    return np.stack([m for m in signed if np.linalg.det(m) > 0])


def euler_grid(step_deg: int = 15) -> Floats:
    """Rz(a) Rx(b) Rz(c) on a grid, multiplied as matrices so that it carries ordinary rounding."""
    a, b, c = np.meshgrid(
        np.arange(0, 360, step_deg), np.arange(0, 181, step_deg), np.arange(0, 360, step_deg), indexing="ij"
    )
    x, z = np.eye(3)[[0, 2]]
    turns = [to_matrix(from_axis_angle(axis, np.radians(v.ravel()))) for axis, v in ((z, a), (x, b), (z, c))]
    return turns[0] @ turns[1] @ turns[2]


def in_random_frame(name: str, rng: np.random.Generator, offset_mm: float = 20.0) -> SymmetryGroup:
    frame = random_rotations(rng, 1)[0]
    return SymmetryGroup.from_name(name, frame=frame, offset_mm=rng.normal(size=3) * offset_mm)


def some_motions(group: SymmetryGroup, rng: np.random.Generator) -> Floats:
    """Elements (n, 4, 4): all of a finite group, random ones of a continuous group."""
    if group.is_finite:
        return group.motions()
    if group.name == "SO(3)":
        elements = normalise(rng.normal(size=(5, 4)))
    else:
        turns = from_axis_angle(np.array(group.axis), rng.uniform(0, 2 * np.pi, 4))
        discrete = group.sampled_wxyz(1)
        elements = multiply(turns[:, None], discrete[None]).reshape(-1, 4)
    motions = np.tile(np.eye(4), (len(elements), 1, 1))
    motions[:, :3, :3] = to_matrix(elements)
    motions[:, :3, 3] = np.array(group.offset_mm) - motions[:, :3, :3] @ np.array(group.offset_mm)
    return motions


def random_generators(group: SymmetryGroup, rng: np.random.Generator) -> NDArray[np.int64]:
    """Numbers of one to three random elements that generate a finite group, in random order, without the identity."""
    table = _multiplication_table(group.name)
    while True:
        chosen = rng.permutation(np.arange(1, len(table)))[: rng.integers(1, 4)]
        closure, queue = {0}, [0]
        for i in queue:
            new = set(table[i, chosen].tolist()) - closure
            closure |= new
            queue += new
        if len(closure) == len(table):
            return chosen


def moved(R: Floats, t: Floats, motion: Floats) -> tuple[Floats, Floats]:
    """The pose after the model was moved by one of its symmetries: looks the same."""
    return R @ motion[:3, :3], R @ motion[:3, 3] + t


def symmetric_vertices(group: SymmetryGroup, rng: np.random.Generator) -> Floats:
    """The orbit of random points under a finite group: a chiral mesh's vertices, mm."""
    seeds_mm = rng.uniform(-50, 50, size=(4, 3))
    motions = group.motions()
    return (np.einsum("mij,nj->mni", motions[:, :3, :3], seeds_mm) + motions[:, None, :3, 3]).reshape(-1, 3)


@cache
def _multiplication_table(name: str) -> NDArray[np.int64]:
    """(order, order): number of the product of two elements, the same in every frame."""
    elements = SymmetryGroup.from_name(name).elements_wxyz
    products = multiply(elements[:, None], elements[None])
    return np.argmax(np.abs(products @ elements.T), axis=2)


def _permutations() -> list[Floats]:
    return [np.eye(3)[list(p)] for p in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))]


def _signs() -> list[Floats]:
    return [np.array([[x, y, z]]) for x in (1.0, -1.0) for y in (1.0, -1.0) for z in (1.0, -1.0)]
