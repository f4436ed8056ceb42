"""Objects come to rest on the table: judged by another exact geometry (manifold3d), on simple shapes and on T-LESS."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh

from synthetless.io.cache import Cache, digest
from synthetless.scenes.collider import VERSION, standing
from synthetless.scenes.contact import Posed, Surface, measure
from synthetless.scenes.container import container_mesh, container_pieces, turn
from synthetless.scenes.physics import Collider, NotSettled, PhysicsSettings, Settled, collider, settle
from synthetless.scenes.rotations import matrix, random_rotation
from synthetless.scenes.spec import ContainerKind, ContainerSpec, Material, Mesh, Pose

bpy = pytest.importorskip("bpy", exc_type=ImportError)
pytestmark = pytest.mark.blender

Part = tuple[Mesh, Collider]
SETTINGS = PhysicsSettings()
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
TLESS_IDS = (1, 4, 6, 8, 10, 14, 18, 23, 29)
"""Fine and coarse meshes, small and large, full and hollow parts."""


def triangles(shape: trimesh.Trimesh, unit_m: float = 1.0) -> Mesh:
    return Mesh(np.array(shape.vertices) * unit_m, np.array(shape.faces, dtype=np.int32))


def part(shape: trimesh.Trimesh, unit_m: float = 1.0) -> Part:
    mesh = triangles(shape, unit_m)
    return mesh, collider(mesh)


@pytest.fixture(scope="module")
def cube() -> Part:
    return part(trimesh.creation.box((0.06, 0.06, 0.06)))


@pytest.fixture(scope="module")
def shapes(cube: Part) -> list[Part]:
    cylinder = trimesh.creation.cylinder(radius=0.02, height=0.08, sections=48)
    tube = trimesh.creation.annulus(r_min=0.035, r_max=0.04, height=0.06, sections=48)
    return [cube, part(cylinder), part(tube)]


@pytest.fixture(scope="module")
def tless(tless_models: Path) -> list[Part]:
    return [part(trimesh.load(tless_models / f"obj_{i:06d}.ply", process=False), 0.001) for i in TLESS_IDS]


def release(colliders: Sequence[Collider], seed: int) -> list[Pose]:
    """Random orientations, one above the other."""
    rng = np.random.default_rng(seed)
    poses, floor = [], 0.0
    for item in colliders:
        reach = float(np.linalg.norm(item.surface.vertices_m, axis=1).max())
        x, y = rng.uniform(-0.04, 0.04, 2).tolist()
        poses.append(Pose(random_rotation(rng), (x, y, floor + reach + 0.01)))
        floor += 2 * reach + 0.01
    return poses


def drop(parts: Sequence[Part], seed: int, throws: int = 5) -> Settled:
    """As the generator does: throw again until they rest."""
    colliders = [item for _, item in parts]
    for attempt in range(throws):
        try:
            return settle(colliders, release(colliders, 1000 * attempt + seed), SETTINGS)
        except NotSettled as failure:
            reason = failure
    raise reason


def solid(mesh: Mesh, pose: Pose) -> manifold3d.Manifold:
    """The true mesh in the world, in millimetres."""
    raw = manifold3d.Mesh(mesh.vertices_m.astype(np.float32) * 1000, mesh.faces.astype(np.uint32))
    raw.merge()
    body = manifold3d.Manifold(raw)
    assert body.status() == manifold3d.Error.NoError
    return body.transform(np.column_stack([matrix(pose.rotation_wxyz), np.array(pose.position_m) * 1000]))


def exact_gaps_mm(parts: Sequence[Part], settled: Settled) -> np.ndarray:
    """(n + 1, n + 1) distances up to 3 mm, the table last; fails where two bodies share more than 1 mm."""
    bodies = [solid(mesh, pose) for (mesh, _), pose in zip(parts, settled.poses, strict=True)]
    lowest = np.array([body.bounding_box()[2] for body in bodies])
    assert lowest.min() > -1.0
    gaps = np.full((len(bodies) + 1, len(bodies) + 1), 3.0)
    gaps[-1, :-1] = gaps[:-1, -1] = np.clip(lowest, 0, 3)
    for i, j in itertools.combinations(range(len(bodies)), 2):
        gaps[i, j] = gaps[j, i] = bodies[i].min_gap(bodies[j], 3.0)
        shared = (bodies[i] ^ bodies[j]).to_mesh().vert_properties if gaps[i, j] == 0 else ()
        if len(shared) > 3:  # no deeper inside one another than what they share is thick
            assert trimesh.PointCloud(shared).bounding_box_oriented.extents.min() <= 1.0
    return gaps


def assert_rests(parts: Sequence[Part], settled: Settled) -> None:
    """Nothing floats, nothing is inside another, nothing lies far away."""
    n = len(parts)
    gaps = exact_gaps_mm(parts, settled)
    assert gaps[:n].min(axis=1).max() <= 1.0
    np.testing.assert_allclose(np.array(settled.gaps_m) * 1000, gaps[:n].min(axis=1), atol=0.05)
    supported = {n}
    for _ in range(n):
        supported |= {i for i in range(n) if any(gaps[i, j] <= 1.0 for j in supported)}
    assert len(supported) == n + 1, "all are carried by the table in the end"
    assert max(settled.penetrations_m) <= SETTINGS.max_penetration_m
    assert max(np.hypot(*pose.position_m[:2]) for pose in settled.poses) < SETTINGS.table_radius_m + 0.1


def test_a_single_object_lands_flat_on_the_table(cube: Part) -> None:
    settled = drop([cube], 3)
    (pose,) = settled.poses
    assert np.abs(matrix(pose.rotation_wxyz)[2]).max() > 0.9999, "a cube comes to lie on a face"
    assert 0.0299 < pose.position_m[2] < 0.0305
    assert_rests([cube], settled)


def test_nothing_thrown_is_nothing_settled() -> None:
    assert settle([], [], SETTINGS) == Settled((), (), ())


@pytest.mark.parametrize("seed", range(4))
def test_simple_shapes_rest(shapes: list[Part], seed: int) -> None:
    parts = shapes + shapes[::-1]
    assert_rests(parts, drop(parts, seed))


def container(kind: ContainerKind, height_m: float, slope_deg: float) -> ContainerSpec:
    return ContainerSpec(kind, (0.16, 0.13), height_m, 0.006, slope_deg, 25.0, Material((0.5, 0.5, 0.5), 0.5, 0.0))


@pytest.mark.parametrize("slope_deg", [0.0, 33.0])
def test_a_container_is_closed_and_the_union_of_its_pieces(slope_deg: float) -> None:
    spec = container("tray", 0.05, slope_deg)
    mesh = container_mesh(spec)
    surface = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert surface.is_watertight and surface.is_winding_consistent
    pieces = [trimesh.convex.convex_hull(piece) for piece in container_pieces(spec)]
    assert surface.volume == pytest.approx(sum(piece.volume for piece in pieces), rel=1e-9)
    assert surface.bounds[:, 2].tolist() == [0.0, 0.05]
    inside = mesh.vertices_m[12:] @ turn(spec)
    np.testing.assert_allclose(np.ptp(inside, axis=0), (0.16, 0.13, 0), atol=1e-12)
    np.testing.assert_allclose(inside[:, 2], 0.006)


@pytest.mark.parametrize(("kind", "height_m", "slope_deg"), [("box", 0.1, 3.0), ("tray", 0.03, 30.0)])
def test_shapes_rest_in_a_container(shapes: list[Part], kind: ContainerKind, height_m: float, slope_deg: float) -> None:
    """By exact geometry: nothing within its sides or floor, nothing floating, and in the box nothing outside."""
    spec, parts = container(kind, height_m, slope_deg), shapes + shapes[::-1]
    colliders = [item for _, item in parts]
    settled = settle(colliders, release(colliders, 4), SETTINGS, spec)
    here = Pose(UPRIGHT, (0.0, 0.0, 0.0))
    around = solid(container_mesh(spec), here)
    bodies = [solid(mesh, pose) for (mesh, _), pose in zip(parts, settled.poses, strict=True)]
    gaps = [body.min_gap(around, 3.0) for body in bodies]
    for body, gap, stated in zip(bodies, gaps, settled.gaps_m, strict=True):
        assert stated * 1000 <= min(gap, 1.0) + 0.05
        assert gap > 0 or (body ^ around).volume() < 0.05 * body.volume()
    assert sum(gap <= 1.0 for gap in gaps) >= 3, "most lie on its floor or lean on its sides"
    assert max(settled.penetrations_m) <= SETTINGS.max_penetration_m
    if kind == "box":
        along = np.array([pose.position_m for pose in settled.poses]) @ turn(spec)
        assert (np.abs(along[:, :2]) < np.array(spec.floor_m) / 2 + 0.01).all()
    assert settle(colliders, release(colliders, 4), SETTINGS, spec) == settled


def test_what_does_not_fit_a_container_is_refused(cube: Part) -> None:
    _, item = cube
    spec = replace(container("box", 0.1, 0.0), floor_m=(0.16, 0.05))
    with pytest.raises(NotSettled, match="object 0 does not fit into the container"):
        settle([item], [Pose(UPRIGHT, (0.0, 0.0, 0.2))], SETTINGS, spec)
    within = rescaled(item, 0.9)
    with pytest.raises(NotSettled, match=r"object 0 penetrates the container by 2\.\d mm"):
        settle([within], [Pose(UPRIGHT, (0.0, 0.0, 0.1))], SETTINGS, container("box", 0.1, 0.0))


def test_what_stands_upright_and_what_does_not(cube: Part) -> None:
    found = standing(cube[1])
    assert found is not None and not found.upside_down
    assert (found.origin_m, found.height_m) == (pytest.approx(0.03, abs=3e-4), pytest.approx(0.06, abs=6e-4))
    assert found.radius_m == pytest.approx(0.03 * np.sqrt(2), rel=0.01)
    cone = trimesh.creation.cone(radius=0.03, height=0.05, sections=32)
    upright, turned = part(cone), part(cone.apply_transform(np.diag([1, -1, -1, 1])))
    stands = [standing(item) for _, item in (upright, turned)]
    assert [of is not None and of.upside_down for of in stands] == [False, True]
    assert standing(part(trimesh.creation.icosphere(subdivisions=3, radius=0.03))[1]) is None
    leaning = trimesh.creation.box((0.02, 0.02, 0.08))
    leaning.vertices[:, 0] += 2 * leaning.vertices[:, 2]
    assert standing(part(leaning)[1]) is None, "its mass centre is not above its foot"


@pytest.mark.tless
@pytest.mark.parametrize("seed", range(5))
def test_tless_mixes_rest(tless: list[Part], seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [tless[i] for i in rng.integers(0, len(tless), 2 + 2 * seed)]
    assert_rests(parts, drop(parts, seed))


def test_the_same_release_settles_alike_whatever_came_before(shapes: list[Part]) -> None:
    colliders = [item for _, item in shapes]
    first = settle(colliders, release(colliders, 1), SETTINGS)
    other = settle(colliders[::-1], release(colliders, 2), SETTINGS)
    assert other != first
    assert settle(colliders, release(colliders, 1), SETTINGS) == first
    script = (
        "import sys; sys.path.insert(0, 'tests/scenes')\n"
        "import test_physics as t, trimesh\n"
        "cube = t.part(trimesh.creation.box((0.06, 0.06, 0.06)))\n"
        "colliders = [item for _, item in t.shapes.__wrapped__(cube)]\n"
        "print('settled', t.settle(colliders, t.release(colliders, 1), t.SETTINGS))\n"
    )
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONHASHSEED": "5", "PYTHONPATH": str(root / "src")}
    done = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, cwd=root, env=environment
    )
    assert f"settled {first}" in done.stdout.splitlines(), done.stderr


def test_blender_is_left_as_it_was_and_memory_stays_flat(shapes: list[Part]) -> None:
    def state() -> tuple[object, ...]:
        blocks = {
            kind: len(getattr(bpy.data, kind)) for kind in ("scenes", "collections", "objects", "meshes", "actions")
        }
        return blocks, bpy.context.scene.name, bpy.context.scene.frame_current

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    colliders = [item for _, item in shapes]
    before, resident = state(), 0.0
    for number in range(30):
        settle(colliders, release(colliders, 1), SETTINGS)
        if number == 5:
            resident = resident_mb()
    assert state() == before
    assert resident_mb() - resident < 10


def rescaled(item: Collider, factor: float) -> Collider:
    """A body whose proxies do not fit its mesh, as physics that went wrong would have it."""
    return replace(item, hull_m=item.hull_m * factor, pieces_m=tuple(piece * factor for piece in item.pieces_m))


def test_what_does_not_rest_is_refused_with_the_reason(cube: Part) -> None:
    _, item = cube
    low = [Pose(UPRIGHT, (0.0, 0.0, 0.04))]
    with pytest.raises(NotSettled, match=r"object 0 still moves after 0\.2 s"):
        settle([item], [Pose(UPRIGHT, (0.0, 0.0, 0.5))], replace(SETTINGS, fall_s=0.1, rest_s=0.1, still_s=0.1))
    with pytest.raises(NotSettled, match=r"object 0 fell through the table"):
        settle([item], [Pose(UPRIGHT, (0.0, 0.0, -3.0))], SETTINGS)
    with pytest.raises(NotSettled, match=r"object 0 left the table: it is 0\.30 m from the middle"):
        settle([item], [Pose(UPRIGHT, (0.3, 0.0, 0.04))], replace(SETTINGS, table_radius_m=0.2))
    with pytest.raises(NotSettled, match=r"object 0 penetrates the table by 2\.\d mm"):
        settle([rescaled(item, 0.9)], low, SETTINGS)
    with pytest.raises(NotSettled, match=r"object 0 floats: more than 2\.0 mm from what is nearest to it"):
        settle([rescaled(item, 1.1)], low, SETTINGS)
    with pytest.raises(NotSettled, match=r"object 0 penetrates object 1 by 2\.\d mm"):
        settle([rescaled(item, 0.9), item], [Pose(UPRIGHT, (0.0, 0.0, 0.1)), *low], replace(SETTINGS, margin_m=0.0001))


def test_gap_and_depth_of_known_placements(shapes: list[Part]) -> None:
    cube, _, tube = (item.surface for _, item in shapes)
    turned = trimesh.transformations.euler_matrix(np.pi / 4, 0, 0)[:3, :3]
    edge = 0.03 * np.sqrt(2)  # the lowest edge of a cube that stands on one

    def contact(other: Posed) -> tuple[float, float]:
        contacts = measure([Posed(cube, np.eye(3), np.array([0, 0, 0.03])), other], reach_m=0.005)
        return float(contacts.gap_m[0, 1]), float(contacts.penetration_m[0, 1])

    def above(height: float, rotation: np.ndarray = np.eye(3), x: float = 0.0) -> Posed:  # noqa: B008
        return Posed(cube, rotation, np.array([x, 0.0, 0.06 + height]))

    assert contact(above(0.032)) == (pytest.approx(0.002, abs=1e-6), 0.0)
    assert contact(above(edge + 0.002, turned)) == (pytest.approx(0.002, abs=1e-6), 0.0)
    assert contact(above(edge - 0.002, turned)) == (0.0, pytest.approx(0.002, abs=1e-4))
    assert contact(above(0.04)) == (np.inf, 0.0)
    crossed = trimesh.transformations.euler_matrix(np.pi / 4, 0, np.pi / 2)[:3, :3]
    ridge = Posed(cube, turned, np.array([0, 0, 0.03]))
    gaps = measure([ridge, Posed(cube, crossed, np.array([0, 0, 0.03 + 2 * edge + 0.001]))], 0.005).gap_m
    assert gaps[0, 1] == pytest.approx(0.001, abs=1e-6), "edge to edge"
    core = Surface(triangles(trimesh.creation.box((0.04, 0.04, 0.04))))
    around = Posed(tube, np.eye(3), np.array([0, 0, 0.03]))
    contacts = measure([Posed(core, np.eye(3), np.array([0, 0, 0.03])), around], 0.008)
    assert contacts.penetration_m[0, 1] == 0.0, "the bore of a tube is outside"
    assert contacts.gap_m[0, 1] == pytest.approx(0.035 * np.cos(np.pi / 48) - 0.02 * np.sqrt(2), abs=2e-4)


def test_a_collider_from_the_cache_is_the_same_to_the_bit(shapes: list[Part], tmp_path: Path) -> None:
    """Computed and kept, read, and computed without a cache: the same arrays, and the same poses at rest."""
    kept = [Cache(None), Cache(tmp_path), Cache(tmp_path)]
    versions = []
    for cache in kept:
        colliders = []
        for mesh, _ in shapes:
            key = digest(mesh.vertices_m, mesh.faces)
            colliders.append(collider(mesh, partial(cache.arrays, "collider", key, VERSION)))
        versions.append(colliders)
    assert len(list(tmp_path.rglob("*.npz"))) == len(shapes)
    for without, computed, read in zip(*versions, strict=True):
        for other in (computed, read):
            assert [piece.tobytes() for piece in other.pieces_m] == [piece.tobytes() for piece in without.pieces_m]
            assert other.hull_m.tobytes() == without.hull_m.tobytes()
            assert other.mass_centre_m.tobytes() == without.mass_centre_m.tobytes()
            assert other.volume_m3 == without.volume_m3
    rests = [settle(colliders, release(colliders, 3), SETTINGS) for colliders in versions]
    assert rests[0] == rests[1] == rests[2]
