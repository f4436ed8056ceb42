"""Ray casting against closed forms, an independent tree and bop_toolkit's rules."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, binary_fill_holes
from scipy.spatial.transform import Rotation

from synthetless.annotation.instances import BACKGROUND, ImageAnnotation, PosedModel, image_window
from synthetless.annotation.raycast import Plane, PosedSurface, RayCaster, Rays, Surface
from synthetless.scenes.spec import Intrinsics

CAMERA = Intrinsics(width=160, height=120, fx=240.0, fy=236.0, cx=81.3, cy=58.6)
UPRIGHT = np.eye(3)
Array = NDArray[np.float64]
MeshArrays = tuple[Array, NDArray[np.int64]]

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
RADIUS, HEIGHT = 40.0, 90.0
BOX = np.array([60.0, 80.0, 30.0])


def arrays(mesh: trimesh.Trimesh, shift: tuple[float, float, float] = (0, 0, 0)) -> MeshArrays:
    return np.asarray(mesh.vertices) + shift, np.asarray(mesh.faces)


def square(side: float) -> MeshArrays:
    """Fronto-parallel when posed upright."""
    return SQUARE * side / 2, SQUARE_FACES


SHIFT = (11.0, -7.0, 300.0)  # of a box whose origin is far outside


@cache
def caster() -> RayCaster:
    sphere, cylinder, box = trimesh.creation.icosphere, trimesh.creation.cylinder, trimesh.creation.box
    return RayCaster(
        {
            ("model", name): mesh
            for name, mesh in {
                "sphere": arrays(sphere(subdivisions=6, radius=RADIUS)),
                "cylinder": arrays(cylinder(radius=RADIUS, height=HEIGHT, sections=1024)),
                "box": arrays(box(BOX)),
                "far box": arrays(box(BOX), SHIFT),
                "coarse": arrays(sphere(subdivisions=3, radius=RADIUS)),
                "torus": arrays(trimesh.creation.torus(35.0, 12.0, major_sections=24, minor_sections=12)),
                "square": square(40.0),
                "wall": square(4000.0),
            }.items()
        }
    )


def annotate(*posed: tuple[str, Array, Array], camera: Intrinsics = CAMERA, **options: Any) -> ImageAnnotation:
    plane = options.pop("plane", None)
    instances = [PosedModel(key, R, np.asarray(t, float)) for key, R, t in posed]
    return caster().annotate(camera, plane, instances, **options)


def pixel_rays(camera: Intrinsics = CAMERA) -> Array:
    """(H, W, 3) rays with z = 1, written out independently of the module."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def random_rotation(seed: int) -> Array:
    return np.asarray(Rotation.random(random_state=seed).as_matrix())


def sphere_depth(rays: Array, center: Array, radius: float) -> Array:
    """z of the first crossing, inf beside the sphere."""
    a, b = (rays**2).sum(-1), rays @ center
    root = b**2 - a * (center @ center - radius**2)
    return np.where(root >= 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def box_depth(rays: Array, R: Array, t: Array, size: Array) -> Array:
    """The slab method, double precision."""
    origin, directions = -R.T @ t, rays @ R
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-size / 2 - origin) / directions, (size / 2 - origin) / directions
    first, last = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return np.where(first <= last, first, np.inf)


def cylinder_depth(rays: Array, R: Array, t: Array, radius: float, height: float) -> Array:
    origin, d = -R.T @ t, rays @ R
    a, b, c = (d[..., :2] ** 2).sum(-1), d[..., :2] @ origin[:2], origin[:2] @ origin[:2] - radius**2
    root = b**2 - a * c
    side = (-b - np.sqrt(np.maximum(root, 0))) / a
    on_side = (root >= 0) & (np.abs(origin[2] + side * d[..., 2]) <= height / 2)
    depth = np.where(on_side, side, np.inf)
    for z in (-height / 2, height / 2):
        cap = (z - origin[2]) / d[..., 2]
        inside = ((origin[:2] + cap[..., None] * d[..., :2]) ** 2).sum(-1) <= radius**2
        depth = np.where(inside, np.minimum(depth, cap), depth)
    return depth


# Closed forms


@pytest.mark.parametrize("seed", range(4))
def test_sphere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center = np.array([*rng.uniform(-80, 80, 2), rng.uniform(300, 900)])
    R = random_rotation(seed)
    result = annotate(("sphere", R, center), normals=True, object_coordinates=True)
    truth = sphere_depth(pixel_rays(), center, RADIUS)
    mask = result.instances[0].mask
    assert np.count_nonzero(mask != np.isfinite(truth)) <= 0.003 * np.isfinite(truth).sum()
    inner = binary_erosion(mask, iterations=3)
    assert np.abs(result.depth_mm - truth)[inner].max() < 0.02  # the facets' sagitta is 0.005 mm

    points = pixel_rays() * result.depth_mm[..., None]
    outwards = (points - center)[mask] / RADIUS
    assert result.normals is not None and result.object_coordinates_mm is not None
    assert np.einsum("ij,ij->i", result.normals[mask], outwards).min() > np.cos(np.radians(2))
    assert np.allclose(result.object_coordinates_mm[mask] @ R.T + center, points[mask], atol=1e-3)
    assert not result.normals[~mask].any() and not result.object_coordinates_mm[~mask].any()


@pytest.mark.parametrize("seed", range(4))
def test_cylinder(seed: int) -> None:
    R, t = random_rotation(seed), np.array([10.0 * seed - 20, 8.0, 420.0])
    result = annotate(("cylinder", R, t))
    truth = cylinder_depth(pixel_rays(), R, t, RADIUS, HEIGHT)
    mask = result.instances[0].mask
    assert np.count_nonzero(mask != np.isfinite(truth)) <= 0.003 * np.isfinite(truth).sum()
    difference = np.abs(result.depth_mm - truth)[binary_erosion(mask, iterations=2)]
    assert np.median(difference) < 1e-3 and np.quantile(difference, 0.99) < 0.01


@pytest.mark.parametrize(("key", "shift"), [("box", (0, 0, 0)), ("far box", SHIFT)])
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), x=st.floats(-300, 300), y=st.floats(-200, 200), z=st.floats(120, 2000))
def test_box_is_exact_wherever_it_is(
    key: str, shift: tuple[float, float, float], seed: int, x: float, y: float, z: float
) -> None:
    R, center = random_rotation(seed), np.array([x, y, z])
    t = center - R @ shift
    result = annotate((key, R, t), object_coordinates=True)
    mask = result.instances[0].mask
    truth = box_depth(pixel_rays(), R, center, BOX)
    surely = np.isfinite(box_depth(pixel_rays(), R, center, BOX - 2e-3))
    possibly = np.isfinite(box_depth(pixel_rays(), R, center, BOX + 2e-3))
    assert mask[surely].all() and not mask[~possibly].any()
    both = mask & surely
    assert np.abs(result.depth_mm - truth)[both].max(initial=0) < 0.01
    assert result.object_coordinates_mm is not None
    points = (pixel_rays() * result.depth_mm[..., None])[mask]
    assert np.allclose(result.object_coordinates_mm[mask] @ R.T + t, points, atol=1e-3)


def test_box_normals_are_those_of_its_faces() -> None:
    R, t = random_rotation(5), np.array([0, 0, 300.0])
    result = annotate(("box", R, t), normals=True)
    assert result.normals is not None
    normals = result.normals[result.instances[0].mask]
    in_model = np.abs(normals @ R)
    assert np.allclose(np.sort(in_model, axis=1), [0, 0, 1], atol=1e-6)
    assert (np.einsum("ij,ij->i", normals, pixel_rays()[result.instances[0].mask]) < 0).all()


def test_plane_is_exact() -> None:
    elevation = np.radians(35)
    R = np.array([[1, 0, 0], [0, -np.sin(elevation), -np.cos(elevation)], [0, np.cos(elevation), -np.sin(elevation)]])
    t = np.array([0, 0, 700.0])
    result = annotate(plane=Plane(R, t), normals=True)
    world = (pixel_rays() * result.depth_mm[..., None] - t) @ R
    assert np.abs(world[..., 2]).max() < 1e-9
    assert result.normals is not None and np.allclose(result.normals, R[:, 2])
    assert (result.instance_ids == BACKGROUND).all()

    square_table = annotate(plane=Plane(R, t, half_size_mm=100.0), normals=True)
    on_table = np.abs(world[..., :2]).max(-1) <= 100
    assert on_table.any() and not on_table.all()
    assert np.array_equal(square_table.depth_mm, np.where(on_table, result.depth_mm, 0))
    assert square_table.normals is not None and not square_table.normals[~on_table].any()


@given(
    turn=st.tuples(*[st.floats(-180, 180)] * 3),
    t=st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(-100, 900)),
    half_size_mm=st.floats(20, 4000),
)
def test_a_square_table_is_cut_out_of_the_plane(
    turn: tuple[float, ...], t: tuple[float, ...], half_size_mm: float
) -> None:
    """Seen from anywhere: the points of the unbounded plane that are on the square, and no others."""
    R = Rotation.from_euler("zyx", turn, degrees=True).as_matrix()
    rays = Rays.through(CAMERA, image_window(CAMERA))
    plane = Plane(R, np.array(t)).depth_mm(rays)
    table = Plane(R, np.array(t), half_size_mm).depth_mm(rays)
    met = np.isfinite(plane)
    reach = np.abs((pixel_rays()[met] * plane[met, None] - t) @ R)[:, :2].max(axis=1)
    assert np.array_equal(table[met][reach < half_size_mm - 1e-3], plane[met][reach < half_size_mm - 1e-3])
    assert np.isinf(table[met][reach > half_size_mm + 1e-3]).all()
    assert np.isinf(table[~met]).all()


def test_plane_seen_from_below_faces_the_camera() -> None:
    R = np.diag([1.0, -1.0, -1.0])
    above = annotate(plane=Plane(R, np.array([0, 0, 500.0])), normals=True).normals
    below = annotate(plane=Plane(-R @ np.diag([1, -1, 1]), np.array([0, 0, 500.0])), normals=True).normals
    assert above is not None and np.allclose(above, [0, 0, -1])
    assert below is not None and np.allclose(below, [0, 0, -1])


def test_horizon() -> None:
    """Level camera 100 mm over the table: table below the horizon row cy, nothing at it and above."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    result = annotate(plane=Plane(R, np.array([0, 100.0, 0])))
    rows = np.arange(CAMERA.height)
    assert np.array_equal((result.depth_mm > 0).all(axis=1), rows > CAMERA.cy)
    assert np.array_equal((result.depth_mm > 0).any(axis=1), rows > CAMERA.cy)


# Pixels


def test_pixel_centres_are_at_whole_numbers() -> None:
    """A square of 0.2 px around (u, v) = (i, j) is seen in that pixel alone; one between the centres is not."""
    camera, z = Intrinsics(64, 48, 100.0, 100.0, 31.5, 23.5), 500.0
    tiny = RayCaster({("model", 1): square(0.2 * z / camera.fx)})

    def seen(u: float, v: float) -> list[list[int]]:
        t = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
        annotation = tiny.annotate(camera, None, [PosedModel(1, UPRIGHT, t)])
        return np.argwhere(annotation.instances[0].mask).tolist()

    assert seen(0, 0) == [[0, 0]]
    assert seen(40, 7) == [[7, 40]]
    assert seen(63, 47) == [[47, 63]]
    assert seen(40.5, 7.5) == []
    assert seen(40.09, 6.91) == [[7, 40]]


def test_box_is_the_span_of_the_pixels() -> None:
    """Columns 20.5 .. 30.5 are ten pixels, 21 to 30: w is 9, as bop_toolkit counts."""
    camera, z = Intrinsics(64, 48, 100.0, 100.0, 0.0, 0.0), 100.0
    instance = (
        RayCaster({("model", 1): square(10.0)})
        .annotate(camera, None, [PosedModel(1, UPRIGHT, np.array([25.5, 15.5, z]))])
        .instances[0]
    )
    assert instance.bbox_obj == instance.bbox_visib == (21, 11, 9, 9)
    assert instance.px_count_all == instance.px_count_valid == instance.px_count_visib == 100
    assert instance.visib_fract == 1.0


def test_dtypes() -> None:
    result = annotate(("box", UPRIGHT, [0, 0, 400.0]), normals=True, object_coordinates=True)
    assert result.depth_mm.dtype == np.float64 and result.instance_ids.dtype == np.int32
    assert result.normals is not None and result.normals.dtype == np.float32
    assert result.object_coordinates_mm is not None and result.object_coordinates_mm.dtype == np.float32
    assert result.instances[0].mask.dtype == result.instances[0].mask_visib.dtype == np.bool_
    bare = annotate(("box", UPRIGHT, [0, 0, 400.0]))
    assert bare.normals is None and bare.object_coordinates_mm is None


# Occlusion


def test_the_nearer_hides_the_farther_in_any_order() -> None:
    near, far = ("square", UPRIGHT, [-10, 0, 300.0]), ("square", UPRIGHT, [10, 0, 400.0])
    for order in ([near, far], [far, near]):
        result = annotate(*order, plane=Plane(np.diag([1.0, -1, -1]), np.array([0, 0, 500.0])))
        front, back = result.instances[order.index(near)], result.instances[order.index(far)]
        assert np.array_equal(front.mask_visib, front.mask)
        assert np.array_equal(back.mask_visib, back.mask & ~front.mask)
        assert 0 < back.visib_fract == back.px_count_visib / back.px_count_all < 1
        assert np.array_equal(result.instance_ids == order.index(near), front.mask)
        assert set(np.unique(result.depth_mm)) == {300.0, 400.0, 500.0}


def test_occluders_hide_but_have_no_label() -> None:
    hidden = ("square", UPRIGHT, [0, 0, 400.0])
    half = PosedModel("wall", UPRIGHT, np.array([2000.0, 0, 300.0]))  # covers u > cx
    result = annotate(hidden, occluders=[half], normals=True, object_coordinates=True)
    (instance,) = result.instances
    right = np.arange(CAMERA.width)[None] > CAMERA.cx
    assert np.array_equal(instance.mask_visib, instance.mask & ~right)
    assert (result.instance_ids[:, right[0]] == BACKGROUND).all()
    assert np.allclose(result.depth_mm[:, right[0]], 300.0)
    assert result.normals is not None and np.allclose(result.normals[:, right[0]], [0, 0, -1])
    assert result.object_coordinates_mm is not None and not result.object_coordinates_mm[:, right[0]].any()


def test_hidden_altogether() -> None:
    result = annotate(("square", UPRIGHT, [0, 0, 400.0]), ("wall", UPRIGHT, [0, 0, 300.0]))
    hidden = result.instances[0]
    assert hidden.px_count_all == hidden.px_count_valid == hidden.mask.sum() > 0
    assert hidden.px_count_visib == hidden.visib_fract == 0
    assert hidden.bbox_obj == hidden.bbox_visib == (-1, -1, -1, -1)


def test_the_table_hides_what_is_under_it() -> None:
    table = Plane(np.diag([1.0, -1, -1]), np.array([0, 0, 400.0]))
    above, below = ("square", UPRIGHT, [-30, 0, 399.0]), ("square", UPRIGHT, [30, 0, 401.0])
    result = annotate(above, below, plane=table)
    assert [instance.visib_fract for instance in result.instances] == [1.0, 0.0]


def test_tolerance_is_along_the_ray() -> None:
    """4.5 mm behind in z: within 5 mm of distance where the ray is at most 5 / 4.5 long at z = 1."""
    camera = Intrinsics(160, 120, 100.0, 100.0, 79.5, 59.5)
    scene = [("wall", UPRIGHT, [0, 0, 300.0]), ("wall", UPRIGHT, [0, 0, 304.5])]
    front, back = annotate(*scene, camera=camera, visibility_delta_mm=5.0).instances
    lengths = np.linalg.norm(pixel_rays(camera), axis=-1)
    assert front.mask_visib.all()
    assert np.array_equal(back.mask_visib, 4.5 * lengths <= 5.0)
    assert 0 < back.px_count_visib < back.px_count_valid

    assert annotate(*scene, camera=camera).instances[1].px_count_visib == 0
    assert annotate(*scene, camera=camera, visibility_delta_mm=50.0).instances[1].mask_visib.all()


# The border, and behind the camera


def on_canvas(camera: Intrinsics) -> Intrinsics:
    """The camera whose image is bop_toolkit's canvas for truncated objects."""
    w, h = camera.width, camera.height
    return Intrinsics(3 * w, 3 * h, camera.fx, camera.fy, camera.cx + w, camera.cy + h)


@settings(max_examples=25, deadline=None)
@given(
    key=st.sampled_from(["box", "coarse", "torus", "wall"]),
    seed=st.integers(0, 10**6),
    t=st.tuples(st.floats(-300, 300), st.floats(-250, 250), st.floats(-100, 700)),
)
def test_counts_beyond_the_border_are_those_on_a_threefold_canvas(
    key: str, seed: int, t: tuple[float, float, float]
) -> None:
    posed = (key, random_rotation(seed), np.array(t))
    instance, large = annotate(posed).instances[0], annotate(posed, camera=on_canvas(CAMERA)).instances[0]
    w, h = CAMERA.width, CAMERA.height
    assert instance.px_count_all == large.px_count_valid
    assert np.array_equal(instance.mask, large.mask[h : 2 * h, w : 2 * w])
    if instance.px_count_visib:
        x, y, *size = large.bbox_visib
        assert instance.bbox_obj == (x - w, y - h, *size)
        assert instance.visib_fract == instance.px_count_valid / large.px_count_valid


def test_truncated_at_the_border() -> None:
    camera, z = Intrinsics(64, 48, 100.0, 100.0, 0.0, 0.0), 100.0
    instance = (
        RayCaster({("model", 1): square(10.0)})
        .annotate(camera, None, [PosedModel(1, UPRIGHT, np.array([-0.5, 20.5, z]))])
        .instances[0]
    )
    assert instance.px_count_all == 100 and instance.px_count_visib == instance.px_count_valid == 50
    assert instance.bbox_obj == (-5, 16, 9, 9) and instance.bbox_visib == (0, 16, 4, 9)
    assert instance.visib_fract == 0.5


@pytest.mark.parametrize("t", [(0, 0, -400.0), (0, 0, -30.0), (5000.0, 0, 400.0), (0, -5000.0, 400.0), (0, 0, 0)])
def test_out_of_view(t: tuple[float, float, float]) -> None:
    key = "square" if t[2] == 0 else "box"  # a square in the camera's own plane
    result = annotate((key, UPRIGHT, t), normals=True, object_coordinates=True)
    (instance,) = result.instances
    assert not instance.mask.any() and not instance.mask_visib.any() and not result.depth_mm.any()
    assert (instance.px_count_all, instance.px_count_valid, instance.px_count_visib) == (0, 0, 0)
    assert instance.visib_fract == 0 and instance.bbox_obj == instance.bbox_visib == (-1, -1, -1, -1)


def test_floor_that_reaches_behind_the_camera() -> None:
    """A floor 100 mm under a level camera, 2000 mm in every direction: seen below the horizon up to its far edge."""
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    result = annotate(("wall", R, [0, 100.0, 0]))
    rays = pixel_rays()
    with np.errstate(divide="ignore"):
        z = 100 / rays[..., 1]
    seen = (z > 0) & (z <= 2000) & (np.abs(z * rays[..., 0]) <= 2000)
    assert np.array_equal(result.instances[0].mask, seen)
    assert np.allclose(result.depth_mm[seen], z[seen], rtol=1e-12)


def test_camera_inside_an_object_sees_its_inside() -> None:
    result = annotate(("sphere", UPRIGHT, [0, 0, 0.0]), normals=True)
    assert result.instances[0].mask.all()
    assert np.allclose(np.linalg.norm(pixel_rays() * result.depth_mm[..., None], axis=-1), RADIUS, atol=0.02)
    assert result.normals is not None and ((result.normals * pixel_rays()).sum(-1) < 0).all()


# No cracks


def test_no_ray_slips_between_triangles_at_their_vertices() -> None:
    """Every vertex and every edge of a grid of triangles lies exactly on pixel centres."""
    n, camera = 65, Intrinsics(64, 64, 64.0, 64.0, 0.0, 0.0)
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1).astype(float)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)])
    result = RayCaster({("model", 1): (vertices, faces)}).annotate(
        camera, None, [PosedModel(1, UPRIGHT, np.array([0, 0, 64.0]))]
    )
    assert result.instances[0].mask.all()
    assert (result.depth_mm == 64.0).all()


@settings(max_examples=60, deadline=None)
@given(
    rotation=st.one_of(
        st.integers(0, 10**6).map(random_rotation),
        st.integers(0, 23).map(lambda i: np.asarray(Rotation.create_group("O").as_matrix()[i])),
    ),
    t=st.tuples(st.integers(-40, 40), st.integers(-30, 30), st.integers(150, 900)),
    key=st.sampled_from(["coarse", "box", "cylinder"]),
)
def test_closed_convex_bodies_have_no_pinholes(rotation: Array, t: tuple[int, int, int], key: str) -> None:
    camera = Intrinsics(160, 120, 240.0, 240.0, 80.0, 60.0)
    mask = annotate((key, rotation, np.array(t, float)), camera=camera).instances[0].mask
    assert mask.any()
    assert np.array_equal(binary_fill_holes(mask), mask)
    for row in mask[mask.any(axis=1)]:
        columns = np.flatnonzero(row)
        assert len(columns) == columns[-1] - columns[0] + 1


def test_degenerate_triangles_are_ignored() -> None:
    vertices, faces = square(40.0)
    on_a_line = np.array([[-20, 0.1, 0], [0.3, 0.1, 0], [20, 0.1, 0], [0, 0, 0], [0, 0, 0]])
    vertices = np.concatenate([vertices, on_a_line])
    faces = np.concatenate([[[4, 5, 6], [7, 7, 7], [7, 8, 4], [0, 0, 1]], faces])
    spoilt = RayCaster({("model", 1): (vertices, faces)}).annotate(
        CAMERA, None, [PosedModel(1, UPRIGHT, np.array([0, 0, 400.0]))], normals=True
    )
    clean = annotate(("square", UPRIGHT, [0, 0, 400.0]), normals=True)
    assert np.array_equal(spoilt.depth_mm, clean.depth_mm)
    assert spoilt.normals is not None and clean.normals is not None
    assert np.array_equal(spoilt.normals, clean.normals)


@pytest.mark.parametrize("tilt", [0.0, 1e-7, 1e-3])
@pytest.mark.parametrize("offset", [0.0, 1e-6])
def test_depth_of_grazed_surfaces_stays_within_their_range(tilt: float, offset: float) -> None:
    """Rays that single precision takes for hits of a square seen from its edge cross its plane anywhere or nowhere."""
    camera = Intrinsics(17, 12, 240.0, 240.0, 8.0, 6.0)
    rays = Rays.through(camera, image_window(camera))
    R = Rotation.from_euler("y", np.pi / 2 + tilt).as_matrix()
    body = PosedSurface.of(Surface(EmbreeDevice(), *square(40.0)), R, [offset, 0, 300.0])
    depth = body.depth_mm(rays, np.zeros((12, 17), dtype=np.int32))
    assert (np.abs(depth - 300) <= 20 + 1e-9).all()


# Properties of any scene


poses = st.tuples(
    st.sampled_from(["box", "coarse", "torus", "square"]),
    st.integers(0, 10**6).map(random_rotation),
    st.tuples(st.floats(-120, 120), st.floats(-90, 90), st.floats(-50, 600)).map(np.array),
)


@settings(max_examples=60, deadline=None)
@given(
    scene=st.lists(poses, max_size=4),
    occluders=st.lists(poses, max_size=2),
    delta_mm=st.sampled_from([0.0, 5.0, 15.0]),
    table=st.booleans(),
)
def test_measurements_agree_with_each_other(
    scene: list[tuple[str, Array, Array]],
    occluders: list[tuple[str, Array, Array]],
    delta_mm: float,
    table: bool,
) -> None:
    result = annotate(
        *scene,
        occluders=[PosedModel(*posed) for posed in occluders],
        visibility_delta_mm=delta_mm,
        plane=Plane(np.diag([1.0, -1, -1]), np.array([0, 0, 500.0])) if table else None,
    )
    assert len(result.instances) == len(scene)
    assert result.instance_ids.min() >= BACKGROUND and result.instance_ids.max() < max(1, len(scene))
    if table:
        assert (result.depth_mm > 0).all() and result.depth_mm.max() <= 500
    for index, instance in enumerate(result.instances):
        nearest = result.instance_ids == index
        assert not (nearest & ~instance.mask_visib).any()
        assert not (instance.mask_visib & ~instance.mask).any()
        assert (result.depth_mm[instance.mask] > 0).all()
        if delta_mm == 0:
            assert np.array_equal(nearest, instance.mask_visib)
        assert instance.px_count_visib == instance.mask_visib.sum()
        assert instance.px_count_valid == instance.mask.sum()
        assert instance.px_count_visib <= instance.px_count_valid <= instance.px_count_all
        assert 0 <= instance.visib_fract <= 1
        if instance.px_count_visib:
            x, y, w, h = instance.bbox_visib
            crop = instance.mask_visib[y : y + h + 1, x : x + w + 1]
            assert crop.sum() == instance.px_count_visib
            assert crop[0].any() and crop[-1].any() and crop[:, 0].any() and crop[:, -1].any()
            assert instance.bbox_obj[0] <= x and instance.bbox_obj[0] + instance.bbox_obj[2] >= x + w


@settings(max_examples=20, deadline=None)
@given(scene=st.lists(poses, min_size=1, max_size=3), seed=st.integers(0, 10**6))
def test_a_repetition_gives_the_same_bytes(scene: list[tuple[str, Array, Array]], seed: int) -> None:
    first, second = annotate(*scene, normals=True), annotate(*scene, normals=True)
    assert first.normals is not None and second.normals is not None
    assert first.depth_mm.tobytes() == second.depth_mm.tobytes()
    assert first.normals.tobytes() == second.normals.tobytes()


# Bad input


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ((np.zeros((3, 3)), np.array([[0, 1, 2]])), "none of the mesh's 1 triangles has an area"),
        ((np.eye(3), np.array([[0, 1, 3]])), "faces name vertices 0 to 3, but the mesh has 0 to 2"),
        ((np.eye(3), np.zeros((0, 3))), "faces of shape"),
        ((np.eye(3) * np.nan, np.array([[0, 1, 2]])), "finite"),
        ((np.eye(2), np.array([[0, 1, 2]])), r"vertices of shape \(2, 2\)"),
    ],
)
def test_unusable_meshes_are_refused(mesh: MeshArrays, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refusal:
        RayCaster({("model", 7): mesh}).annotate(CAMERA, None, [PosedModel(7, UPRIGHT, np.array([0, 0, 400.0]))])
    assert str(refusal.value).startswith("object 7: ") and "\n" not in str(refusal.value)


def test_unknown_objects_and_negative_tolerances_are_refused() -> None:
    with pytest.raises(ValueError, match="no mesh for object cube; there are object sphere, "):
        annotate(("cube", UPRIGHT, [0, 0, 400.0]))
    with pytest.raises(ValueError, match=r"visibility_delta_mm is -1\.0; a number >= 0 is needed"):
        annotate(visibility_delta_mm=-1.0)


# Real models


@pytest.mark.tless
@pytest.mark.parametrize("seed", range(3))
def test_real_models_agree_with_one_merged_scene(tless_models: Path, seed: int) -> None:
    """All objects moved to the camera frame and merged into one tree, rays from the camera over the whole image."""
    camera = Intrinsics(720, 540, 1075.65091572, 1073.90347929, 360.0, 270.0)
    rng = np.random.default_rng(seed)
    obj_ids = rng.choice(np.arange(1, 31), 5)
    loaded = {int(i): trimesh.load(tless_models / f"obj_{i:06d}.ply", process=False) for i in obj_ids}
    posed = [
        PosedModel(int(i), random_rotation(int(rng.integers(10**6))), rng.uniform([-150, -100, 650], [150, 100, 900]))
        for i in obj_ids
    ]
    result = RayCaster({("model", i): arrays(mesh) for i, mesh in loaded.items()}).annotate(camera, None, posed)

    vertices = [loaded[p.obj_id].vertices @ p.R_m2c.T + p.t_m2c for p in posed]
    starts = np.cumsum([0] + [len(v) for v in vertices])
    faces = np.concatenate([loaded[p.obj_id].faces + start for p, start in zip(posed, starts, strict=False)])
    owners = np.repeat(np.arange(len(posed)), [len(loaded[p.obj_id].faces) for p in posed])
    merged = EmbreeScene(robust=True)
    TriangleMesh(merged, np.concatenate(vertices).astype(np.float32), faces.astype(np.int32))
    rays = pixel_rays(camera).reshape(-1, 3).astype(np.float32)
    hit = merged.run(np.zeros_like(rays), rays, output=True)
    triangle, depth = hit["primID"].reshape(540, 720), hit["tfar"].reshape(540, 720)
    ids = np.where(triangle >= 0, owners[triangle], BACKGROUND)

    assert np.count_nonzero(ids != result.instance_ids) <= 5  # rays that touch an edge
    both = (triangle >= 0) & (result.instance_ids == ids)
    difference = np.abs(result.depth_mm - depth)[both]
    assert both.sum() > 20_000
    assert np.count_nonzero(difference > 0.01) <= 5
