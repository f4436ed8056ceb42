"""The built-in parts: sound meshes, true models_info, symmetries that hold exactly and no others."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from synthetless.assets.parts.build import build
from synthetless.assets.parts.catalogue import PARTS
from synthetless.assets.parts.mesh import CREASE_DEG
from synthetless.assets.parts.sectors import is_closed, rotations, symmetrised

FOLDER = Path(__file__).resolve().parents[2] / "assets" / "parts"
IDS = [part.obj_id for part in PARTS]
GROUPS = {part.obj_id: part.group for part in PARTS}
TURNED = [i for i in IDS if GROUPS[i] in ("SO(2)", "O(2)")]
BALL = 37


@dataclass(frozen=True)
class Loaded:
    """A part as its file holds it, and its mesh with equal positions as one vertex."""

    vertices: np.ndarray  # split at the creases
    normals: np.ndarray
    faces: np.ndarray
    points: np.ndarray
    point_faces: np.ndarray
    info: dict[str, Any]

    @property
    def diameter(self) -> float:
        return float(self.info["diameter"])

    @property
    def mesh(self) -> trimesh.Trimesh:
        return trimesh.Trimesh(self.points, self.point_faces, process=False)

    @property
    def elements(self) -> np.ndarray:
        """The declared discrete symmetries with the identity, (k, 4, 4)."""
        declared = self.info.get("symmetries_discrete", [])
        return np.array([np.eye(4), *(np.array(element).reshape(4, 4) for element in declared)])


def infos(folder: Path) -> dict[int, dict[str, Any]]:
    return {int(key): value for key, value in json.loads((folder / "models_info.json").read_text()).items()}


@cache
def load(obj_id: int) -> Loaded:
    mesh = trimesh.load(FOLDER / f"obj_{obj_id:06d}.ply", process=False)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    points, inverse = np.unique(vertices, axis=0, return_inverse=True)
    normals = np.asarray(mesh.vertex_normals)
    return Loaded(vertices, normals, faces, points, inverse.ravel()[faces], infos(FOLDER)[obj_id])


def test_the_folder_holds_what_the_catalogue_names():
    assert [int(path.stem[4:]) for path in sorted(FOLDER.glob("obj_*.ply"))] == IDS == list(range(1, 38))
    assert list(infos(FOLDER)) == IDS
    assert sum(path.stat().st_size for path in FOLDER.glob("*.ply")) < 10e6
    readme = (FOLDER / "README.md").read_text()
    assert all(f"| {part.obj_id} | {part.name} |" in readme for part in PARTS)


def test_building_again_gives_the_same_bytes(tmp_path):
    build(tmp_path)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (FOLDER / path.name).read_bytes(), path.name


@pytest.mark.parametrize("obj_id", IDS)
def test_mesh_is_one_closed_piece_facing_outwards(obj_id):
    part = load(obj_id)
    assert 1000 <= len(part.faces) <= 15000
    assert is_closed(part.point_faces)
    assert part.mesh.volume > 0.02 * np.prod(part.mesh.extents)
    assert len(part.mesh.split(only_watertight=False)) == 1
    a, b, c = np.moveaxis(part.points[part.point_faces], 1, 0)
    longest = np.max([np.linalg.norm(a - b, axis=1), np.linalg.norm(b - c, axis=1), np.linalg.norm(c - a, axis=1)], 0)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) / longest).min() > 5e-4  # height of the thinnest triangle


@pytest.mark.parametrize("obj_id", IDS)
def test_normals_are_unit_and_follow_the_faces(obj_id):
    part = load(obj_id)
    assert np.abs(np.linalg.norm(part.normals, axis=1) - 1).max() < 1e-5
    cosine = np.einsum("fci,fi->fc", part.normals[part.faces], part.mesh.face_normals)
    assert cosine.min() > np.cos(np.deg2rad(CREASE_DEG)) - 1e-3


@pytest.mark.parametrize("obj_id", IDS)
def test_models_info_is_true_and_the_origin_central(obj_id):
    part = load(obj_id)
    low, size = part.points.min(axis=0), np.ptp(part.points, axis=0)
    assert [part.info[f"min_{axis}"] for axis in "xyz"] == low.tolist()
    assert [part.info[f"size_{axis}"] for axis in "xyz"] == size.tolist()
    assert part.diameter == pytest.approx(pdist(part.mesh.convex_hull.vertices).max(), abs=1e-9)
    assert 58 <= part.diameter <= 217
    assert (low + size / 2).tolist() == [-7.0 if obj_id in (25, 26) else 0.0, 0.0, 0.0]


@pytest.mark.parametrize("obj_id", IDS)
def test_declared_elements_are_a_group_without_the_identity(obj_id):
    elements = load(obj_id).elements
    orders = {"SO(2)": 1, "SO(3)": 1, "O(2)": 2}
    assert len(elements) == orders.get(GROUPS[obj_id]) or len(elements) == len(rotations(GROUPS[obj_id]))
    products = np.einsum("aij,bjk->abik", elements, elements)
    distances = np.abs(products[:, :, None] - elements).max(axis=(-1, -2))
    assert distances.min(axis=-1).max() < 1e-9
    assert np.abs(elements[1:] - np.eye(4)).max(axis=(1, 2)).min(initial=2) > 0.5
    assert np.abs(np.linalg.det(elements[:, :3, :3]) - 1).max() < 1e-12


@pytest.mark.parametrize("obj_id", [i for i in IDS if len(load(i).elements) > 1])
def test_discrete_symmetries_map_the_mesh_onto_itself(obj_id):
    part = load(obj_id)
    triangles = {tuple(face) for face in _rolled(part.point_faces)}
    for element in part.elements[1:]:
        moved = part.points @ element[:3, :3].T + element[:3, 3]
        distance, image = cKDTree(part.points).query(moved)
        assert distance.max() <= 1e-4
        assert len(np.unique(image)) == len(image)
        if GROUPS[obj_id] != "O(2)":  # a quad of a body of revolution is flat, its diagonal does not matter
            assert {tuple(face) for face in _rolled(image[part.point_faces])} == triangles


def _rolled(faces: np.ndarray) -> np.ndarray:
    """Each face starting with its smallest index."""
    start = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)


@pytest.mark.parametrize("obj_id", TURNED)
def test_turned_parts_are_bodies_of_revolution(obj_id):
    part = load(obj_id)
    assert part.info["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    radius, angle = np.hypot(*part.points.T[:2]), np.degrees(np.arctan2(*part.points.T[1::-1]))
    off_axis = radius > 1e-9
    rings = np.round(np.stack([radius, part.points[:, 2]], axis=1)[off_axis] / 1e-3)
    _, ring = np.unique(rings, axis=0, return_inverse=True)
    for k in np.unique(ring):
        members = np.flatnonzero(off_axis)[ring.ravel() == k]
        spacing = np.diff(np.sort(angle[members]))
        assert len(members) >= 96
        assert np.abs(np.deg2rad(spacing - 360 / len(members))).max() * radius[members].max() < 2e-4
        assert radius[members].max() * (1 - np.cos(np.pi / len(members))) < 0.03


def test_the_ball_is_round():
    part = load(BALL)
    axes = [np.array(entry["axis"]) for entry in part.info["symmetries_continuous"]]
    assert len(axes) == 2 and np.linalg.norm(np.cross(*axes)) == 1  # two axes generate SO(3)
    assert np.abs(np.linalg.norm(part.points, axis=1) - 30).max() < 1e-3
    assert (part.mesh.triangles_center * part.mesh.face_normals).sum(axis=1).min() > 29.9


@pytest.mark.parametrize("obj_id", [i for i in IDS if i != BALL])
def test_no_other_rotation_comes_near(obj_id):
    """Any larger group holds a rotation of order 2 to 6 far from the declared ones, through the area centroid.

    All those of a grid of axes are tried and the nearest ones followed downhill. The surface is a dense point set,
    which overestimates distances by up to 1 % of the diameter: 3 % seen is 2 % true.
    """
    part = load(obj_id)
    surface = trimesh.sample.sample_surface(part.mesh, 40000, seed=0)[0]
    centroid = part.mesh.area_faces @ part.mesh.triangles_center / part.mesh.area
    tree = cKDTree(surface - centroid)
    rng = np.random.default_rng(0)
    few = (
        part.points[rng.choice(np.argsort(np.linalg.norm(part.points, axis=1))[len(part.points) // 2 :], 40)] - centroid
    )
    many = np.concatenate([part.points[rng.permutation(len(part.points))[:200]], surface[:400]]) - centroid

    def residuals(turns: Rotation, probes: np.ndarray) -> np.ndarray:
        moved = np.einsum("gij,nj->gni", turns.as_matrix().reshape(-1, 3, 3), probes)
        return tree.query(moved)[0].max(axis=1) / part.diameter

    candidates = Rotation.concatenate([Rotation.from_rotvec(_directions(600) * 2 * np.pi / n) for n in (2, 3, 4, 5, 6)])
    candidates = candidates[_distance_deg(candidates, part) > 12]
    nearest = np.argsort(residuals(candidates, few))[:8]
    assert residuals(candidates[nearest], many).min() > 0.03
    for start in candidates[nearest[:3]].as_rotvec():
        descent = minimize(
            lambda rotvec: residuals(Rotation.from_rotvec(rotvec), many)[0],
            start,
            method="Nelder-Mead",
            options={"maxfev": 40, "initial_simplex": start + np.vstack([np.zeros(3), 0.06 * np.eye(3)])},
        )
        arrived = Rotation.from_rotvec(descent.x[None])
        assert descent.fun > 0.03 or _distance_deg(arrived, part)[0] < 9


def _directions(count: int) -> np.ndarray:
    """Unit vectors spread over a hemisphere (a Fibonacci lattice), (count, 3)."""
    k = np.arange(count) + 0.5
    z, azimuth = 1 - k / count, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)


def _distance_deg(turns: Rotation, part: Loaded) -> np.ndarray:
    """The angle from each rotation to the nearest declared symmetry."""
    if "symmetries_continuous" in part.info:
        tilts = np.degrees(np.arccos(np.clip(turns.as_matrix()[:, 2, 2], -1, 1)))
        return tilts if len(part.elements) == 1 else np.minimum(tilts, 180 - tilts)
    declared = Rotation.from_matrix(part.elements[:, :3, :3])
    return np.degrees(np.min([(element.inv() * turns).magnitude() for element in declared], axis=0))


def test_kinds_of_symmetry_per_id_are_those_of_tless(tless_models):
    theirs, ours = infos(tless_models), infos(FOLDER)
    for obj_id in range(1, 31):
        assert _kind(ours[obj_id]) == _kind(theirs[obj_id]), obj_id
    for obj_id in (25, 26):
        assert np.abs(np.subtract(*(np.ravel(i[obj_id]["symmetries_discrete"]) for i in (ours, theirs)))).max() < 1e-9


def _kind(info: dict[str, Any]) -> tuple[object, ...]:
    """Order, axis of the first element and whether the axis misses the origin by more than 1 mm."""
    if "symmetries_continuous" in info:
        return ("continuous", [entry["axis"] for entry in info["symmetries_continuous"]])
    elements = np.array(info.get("symmetries_discrete", [])).reshape(-1, 4, 4)
    if not len(elements):
        return ("none",)
    axis = Rotation.from_matrix(elements[-1, :3, :3]).as_rotvec()
    return (len(elements) + 1, int(np.abs(axis).argmax()), bool(np.linalg.norm(elements[0, :3, 3]) > 2))


@settings(max_examples=20, deadline=None)
@given(group=st.sampled_from(["C2", "C3", "C4", "D2", "D4", "D6", "O"]), seed=st.integers(0, 2**32 - 1))
def test_symmetrised_solids_keep_their_volume_and_close(group, seed):
    rod = Manifold.cylinder(30.0, 2.0, 3.0, 24).rotate(np.random.default_rng(seed).uniform(0, 90, 3).tolist())
    solid = sum((rod.transform(np.hstack([turn, np.zeros((3, 1))])) for turn in rotations(group)), Manifold())
    surface = symmetrised(solid, group)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.volume == pytest.approx(solid.volume(), rel=1e-6)
    for turn in rotations(group):
        assert cKDTree(surface.vertices).query(surface.vertices @ turn.T)[0].max() < 1e-9


def test_a_solid_without_the_symmetry_is_refused():
    with pytest.raises(ValueError, match="do not close under C2"):
        symmetrised(Manifold.cube((20, 10, 10)).translate((-6, -5, 0)), "C2")
