"""Shapes whose symmetry group is known, and ways to disguise them."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

from synthetless.symmetry import SymmetryGroup
from synthetless.symmetry.quaternions import Floats, angle_deg, normalise, to_matrix


def of(solid: Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64), process=False)


def box(x: float, y: float, z: float) -> trimesh.Trimesh:
    return trimesh.creation.box((x, y, z))


def prism(n: int, height: float = 40.0, radius: float = 25.0) -> trimesh.Trimesh:
    """A regular prism about z, centred; a cylinder for large n."""
    return of(Manifold.cylinder(height, radius, radius, n, True))


def cone() -> trimesh.Trimesh:
    return of(Manifold.cylinder(60, 25, 8, 128))


def l_bracket() -> trimesh.Trimesh:
    """Equal arms: C2 about the bisector of x and z."""
    return of(Manifold.cube((60, 20, 8)) + Manifold.cube((8, 20, 60)))


def chiral_gear(n: int, tip: float = 38.0) -> trimesh.Trimesh:
    """Saw teeth: C_n about z, not D_n."""
    step = 2 * np.pi / n
    outline = [
        (radius * np.cos((k + share) * step), radius * np.sin((k + share) * step))
        for k in range(n)
        for share, radius in ((0, 30), (0.3, 30), (0.7, tip), (0.9, tip))
    ]
    disc = Manifold.extrude(CrossSection([np.array(outline)]), 15)
    return of(disc - Manifold.cylinder(60, 8, 8, 96, True))


def notched_cylinder(depth: float, diameter: float = 50.0, height: float = 60.0) -> trimesh.Trimesh:
    """A keyway of the given depth along the cylinder's side at +x."""
    keyway = Manifold.cube((20, 8, 2 * height), True).translate((diameter / 2 - depth + 10, 0, 0))
    return of(Manifold.cylinder(height, diameter / 2, diameter / 2, 192, True) - keyway)


def grooved_cube() -> trimesh.Trimesh:
    """A cube with a slanted groove in each face: T."""
    groove = Manifold.cube((60, 8, 8), True).rotate((0, 0, 20)).translate((0, 0, 25))
    cube = Manifold.cube((50, 50, 50), True)
    for rotation in to_matrix(SymmetryGroup.from_name("T").elements_wxyz):
        cube -= groove.transform(np.hstack([rotation, np.zeros((3, 1))]))
    return of(cube)


def icosahedron() -> trimesh.Trimesh:
    return trimesh.creation.icosahedron().apply_scale(40)


def sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, 30.0)


def lump(seed: int) -> trimesh.Trimesh:
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(4)
    waves = [
        rng.normal() * 0.12 * np.cos(ball.vertices @ (3 * rng.normal(size=3)) + rng.uniform(0, 6)) for _ in range(8)
    ]
    return trimesh.Trimesh(30 * ball.vertices * (1 + sum(waves))[:, None], ball.faces, process=False)


def screw_drum(n: int) -> trimesh.Trimesh:
    """Twisted blades: D_n, without mirror planes."""
    blade = CrossSection.square((25, 6)).translate((0, -3))
    section = CrossSection()
    for k in range(n):
        section += blade.rotate(360 * k / n)
    return of(Manifold.extrude(section, 30, 40, twist_degrees=60))


KNOWN: dict[str, tuple[Callable[[], trimesh.Trimesh], str]] = {
    "L bracket": (l_bracket, "C2"),
    "gear 12": (lambda: chiral_gear(12), "C12"),
    "deep keyway": (lambda: notched_cylinder(4.0), "C2"),
    "screw drum": (lambda: screw_drum(3), "D3"),
    "prism": (lambda: prism(11), "D11"),
    "box": (lambda: box(30, 50, 80), "D2"),
    "grooved cube": (grooved_cube, "T"),
    "icosahedron": (icosahedron, "I"),
    "cone": (cone, "SO(2)"),
    "cylinder": (lambda: prism(128), "O(2)"),
    "sphere": (sphere, "SO(3)"),
    "lump": (lambda: lump(0), "C1"),
}


def moved(mesh: trimesh.Trimesh, rng: np.random.Generator) -> tuple[trimesh.Trimesh, Floats]:
    """The mesh in a random pose, and the pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = to_matrix(normalise(rng.normal(size=4)))
    pose[:3, 3] = rng.normal(size=3) * 50
    return trimesh.Trimesh(trimesh.transform_points(mesh.vertices, pose), mesh.faces, process=False), pose


def noisy(mesh: trimesh.Trimesh, rng: np.random.Generator, share: float = 1e-3) -> trimesh.Trimesh:
    """Finer triangles, and every vertex off by a normal deviate of a share of the diameter."""
    fine = remeshed(mesh)
    diameter = 2 * np.linalg.norm(fine.vertices - fine.vertices.mean(axis=0), axis=1).max()
    return trimesh.Trimesh(fine.vertices + rng.normal(size=fine.vertices.shape) * share * diameter, fine.faces)


def remeshed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface in other, smaller triangles."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, mesh.scale * 0.06, max_iter=30)
    return trimesh.Trimesh(vertices, faces)


def as_stl(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What is left after a binary STL file: single precision, three vertices for each triangle."""
    data = mesh.export(file_type="stl")
    return trimesh.load(io.BytesIO(data), file_type="stl", process=False)


def apart_deg(one: SymmetryGroup, other: SymmetryGroup) -> float:
    """How far the elements of two finite groups of one name are from each other at most."""
    return float(angle_deg(one.elements_wxyz[:, None], other.elements_wxyz[None]).min(axis=1).max())
