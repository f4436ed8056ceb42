"""Behind a lens rays are bent, and nothing else: what each pixel shows is what its own ray meets."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from synthetless.annotation.instances import PosedModel, canvas_window
from synthetless.annotation.raycast import MISS, Plane, PosedSurface, RayCaster, Rays
from synthetless.scenes.lens import straight_points
from synthetless.scenes.spec import Coefficients, Intrinsics

LENSES: tuple[Coefficients, ...] = (
    (-0.35, 0.12, 0.0, 0.0, -0.01),
    (0.3, 0.05, 0.0, 0.0, 0.02),
    (-0.05, 0.01, 0.03, -0.02, 0.0),
)
PINHOLE = Intrinsics(96, 72, 90.0, 92.0, 44.2, 37.1)
RADIUS = 60.0


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    ball, box = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS), trimesh.creation.box((80, 50, 30))
    return RayCaster({("model", 1): (ball.vertices, ball.faces), ("model", 2): (box.vertices, box.faces)})


@pytest.mark.parametrize("distortion", LENSES)
def test_a_ball_is_where_its_equation_puts_it(caster: RayCaster, distortion: Coefficients) -> None:
    camera = dataclasses.replace(PINHOLE, distortion=distortion)
    centre = np.array([70.0, -30.0, 300.0])
    seen = caster.annotate(camera, None, [PosedModel(1, np.eye(3), centre)], normals=True)
    rays = np.concatenate([straight_points(camera), np.ones((72, 96, 1))], axis=-1)
    along, square = rays @ centre, (rays * rays).sum(axis=-1)
    discriminant = along**2 - square * (centre @ centre - RADIUS**2)
    z = (along - np.sqrt(np.maximum(discriminant, 0))) / square
    hit = discriminant > 0
    assert np.count_nonzero(seen.instances[0].mask != hit) <= 4
    both = seen.instances[0].mask & (discriminant > 0.02 * discriminant.max())
    np.testing.assert_allclose(seen.depth_mm[both], z[both], atol=0.3)
    normal = (rays * z[..., None] - centre)[both] / RADIUS
    assert seen.normals is not None
    assert np.einsum("ij,ij->i", seen.normals[both], normal).min() > 0.99


@pytest.mark.parametrize("distortion", LENSES)
@pytest.mark.parametrize(
    "place", [(10.0, 5.0, 260.0), (150.0, 100.0, 240.0), (-260.0, 0.0, 300.0), (900.0, 20.0, 400.0)]
)
def test_the_window_holds_all_that_can_be_seen(
    caster: RayCaster, distortion: Coefficients, place: tuple[float, float, float]
) -> None:
    camera = dataclasses.replace(PINHOLE, distortion=distortion)
    turned = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    body: PosedSurface = caster.pose(PosedModel(2, turned, np.array(place)))
    canvas = canvas_window(camera)
    everywhere = body.first_faces(Rays.through(camera, canvas)) != MISS
    window = canvas.intersection(body.window(camera))
    inside = np.zeros_like(everywhere)
    inside[window.slices_in(canvas)] = True
    assert not (everywhere & ~inside).any()
    part = body.first_faces(Rays.through(camera, window)) != MISS
    np.testing.assert_array_equal(part, everywhere[window.slices_in(canvas)])


@pytest.mark.parametrize("distortion", LENSES)
def test_the_table_ends_where_it_ends(caster: RayCaster, distortion: Coefficients) -> None:
    camera = dataclasses.replace(PINHOLE, distortion=distortion)
    tilt = trimesh.transformations.rotation_matrix(np.pi - 0.9, [1, 0, 0])[:3, :3]
    table = Plane(tilt, np.array([0.0, 0.0, 500.0]), 250.0)
    seen = caster.annotate(camera, table, [])
    z = _table_depth(table, straight_points(camera))
    np.testing.assert_allclose(seen.depth_mm, z, rtol=1e-9)
    assert 0.2 < (z > 0).mean() < 0.98


def _table_depth(table: Plane, straight: NDArray[np.float64]) -> NDArray[np.float64]:
    rays = np.concatenate([straight, np.ones((*straight.shape[:2], 1))], axis=-1)
    up = table.R_w2c[:, 2]
    z = (up @ table.t_w2c) / (rays @ up)
    world = (rays * z[..., None] - table.t_w2c) @ table.R_w2c
    assert table.half_size_mm is not None
    return np.where((np.abs(world[..., :2]) <= table.half_size_mm).all(axis=-1) & (z > 10), z, 0.0)
