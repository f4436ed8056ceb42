"""The guides of the denoiser, against plain averages of many points of each pixel."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates
from scipy.signal.windows import blackmanharris

from synthetless.annotation.guides import make_guides, table_albedo
from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import Plane, RayCaster
from synthetless.scenes.camera import extrinsics
from synthetless.scenes.materials import TableTexture, table_uv
from synthetless.scenes.spec import Intrinsics, PlaneSpec, View
from synthetless.scenes.srgb import linear_from_srgb
from synthetless.scenes.textures import ProceduralTexture

CAMERA = Intrinsics(64, 48, 110.0, 105.0, 30.2, 25.1)


def _plane(elevation_deg: float, roll_deg: float = 20.0) -> Plane:
    R, t = extrinsics(View(0.8, elevation_deg, 40.0, roll_deg, (0.0, 0.0, 0.0)), np.zeros(3))
    return Plane(R, t * 1000, 3000.0)


def _texture(seamless: bool, tile_m: float = 0.31) -> TableTexture:
    pixels = np.random.default_rng(3).integers(0, 256, (40, 56, 3), dtype=np.uint8)
    spec = PlaneSpec(ProceduralTexture("checks", 1), tile_m, 33.0, (0.3, 0.7), 1.0, 0.0)
    return TableTexture(spec, pixels, seamless)


@pytest.mark.parametrize("seamless", [True, False], ids=["repeated", "mirrored"])
@pytest.mark.parametrize("elevation_deg", [89.0, 35.0])
def test_the_table_is_as_its_texture_averaged(elevation_deg: float, seamless: bool) -> None:
    """Against the mean of many points of each pixel, interpolated by SciPy in the tile as it is laid out."""
    plane, texture = _plane(elevation_deg), _texture(seamless)
    found = table_albedo(CAMERA, plane, texture, np.ones((48, 64), dtype=bool))
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:48, :64].astype(float)
    linear = np.vectorize(linear_from_srgb)
    expected = np.zeros((48, 64, 3))
    offsets = np.linspace(-1.5, 1.5, 3001)
    weights = blackmanharris(3001)
    for right, down in rng.choice(offsets, (300, 2), p=weights / weights.sum()):
        rays = np.stack([(u + right - CAMERA.cx) / CAMERA.fx, (v + down - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
        world, origin = rays @ plane.R_w2c, -plane.t_w2c @ plane.R_w2c
        points_m = (origin - origin[2] / world[..., 2:] * world)[..., :2] / 1000
        uv = table_uv(texture.plane, points_m.reshape(-1, 2), 56 / 40)
        at = np.stack([(1 - uv[:, 1]) * 40 - 0.5, uv[:, 0] * 56 - 0.5])
        mode = "grid-wrap" if seamless else "reflect"
        for channel in range(3):
            stored = map_coordinates(texture.pixels[..., channel] / 255, at, order=1, mode=mode)
            expected[..., channel] += linear(stored).reshape(48, 64)  # Cycles interpolates what is stored
    error = found - expected / 300
    assert np.abs(error.mean()) < 0.005
    assert error.std() < 0.1 * expected.std() / 300 + 0.005


def test_a_body_covers_as_much_of_a_pixel_as_it_does() -> None:
    box = trimesh.creation.box((60, 60, 60))
    caster = RayCaster({("model", 1): (np.array(box.vertices), np.array(box.faces))})
    plane = _plane(50.0)
    posed = PosedModel(1, plane.R_w2c, plane.R_w2c @ [0, 0, 30.0] + plane.t_w2c)
    black = dataclasses.replace(_texture(True), pixels=np.zeros((4, 4, 3), dtype=np.uint8))
    guides = make_guides(caster, CAMERA, plane, [posed], [(0.2, 0.4, 0.8)], black)
    share = guides.albedo[..., 1] / 0.4
    np.testing.assert_allclose(guides.albedo, share[..., None] * [0.2, 0.4, 0.8], atol=1e-6)
    fine = dataclasses.replace(CAMERA, width=640, height=480, fx=1100, fy=1050, cx=306.5, cy=255.5)
    exact = (caster.surfaces(fine, plane, [posed])[0] == 0).reshape(48, 10, 64, 10).mean(axis=(1, 3))
    assert share.sum() == pytest.approx(exact.sum(), rel=0.01)
    assert np.abs(share - exact).max() < 0.35  # the pixel filter is wider than the pixel
    inside = exact == 1
    np.testing.assert_allclose(np.linalg.norm(guides.normals, axis=2).max(), 1, atol=1e-5)
    assert np.linalg.norm(guides.normals, axis=2)[~inside & (exact == 0)].min() > 0.6


def test_where_nothing_is_seen_guides_are_zero() -> None:
    box = trimesh.creation.box((60, 60, 60))
    caster = RayCaster({("model", 1): (np.array(box.vertices), np.array(box.faces))})
    plane = dataclasses.replace(_plane(1.0, roll_deg=0.0), half_size_mm=100.0)
    away = PosedModel(1, np.eye(3), np.array([0.0, 0.0, -500.0]))  # behind the camera
    guides = make_guides(caster, CAMERA, plane, [away], [(1.0, 1.0, 1.0)], _texture(False))
    assert not guides.albedo[0].any()
    assert not guides.normals[0].any()
    assert np.isfinite(guides.albedo).all()
    assert not guides.known[0].any()


def test_what_has_more_than_one_colour_is_not_known() -> None:
    box = trimesh.creation.box((60, 60, 60))
    caster = RayCaster({("model", 1): (np.array(box.vertices), np.array(box.faces))})
    plane = _plane(50.0)
    posed = PosedModel(1, plane.R_w2c, plane.R_w2c @ [0, 0, 30.0] + plane.t_w2c)
    owner, _ = caster.surfaces(CAMERA, plane, [posed])
    coloured = make_guides(caster, CAMERA, plane, [posed], [None], _texture(True))
    assert not coloured.known[owner == 0].any()
    assert coloured.known[owner == 1].mean() > 0.8  # all but the pixels along its edge
    assert make_guides(caster, CAMERA, plane, [posed], [(0.5, 0.5, 0.5)], _texture(True)).known.all()


def test_what_shines_shows_more_than_its_texture() -> None:
    box = trimesh.creation.box((60, 60, 60))
    caster = RayCaster({("model", 1): (np.array(box.vertices), np.array(box.faces))})
    plane, matte = _plane(50.0), _texture(True)
    posed = PosedModel(1, plane.R_w2c, plane.R_w2c @ [0, 0, 30.0] + plane.t_w2c)
    shining = dataclasses.replace(matte, plane=dataclasses.replace(matte.plane, specular=0.5))
    assert make_guides(caster, CAMERA, plane, [posed], [None], matte).textured.mean() > 0.5
    assert not make_guides(caster, CAMERA, plane, [posed], [None], shining).textured.any()
