"""How fine the camera sees the table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from synthetless.scenes.camera import extrinsics, finest_pixel_m
from synthetless.scenes.spec import Intrinsics, View

CAMERA = Intrinsics(72, 54, 107.0, 105.0, 36.4, 25.1)


@pytest.mark.parametrize("elevation_deg", [12.0, 30.0, 60.0, 90.0])
@pytest.mark.parametrize("roll_deg", [0.0, 100.0, -33.0])
def test_the_finest_pixel_is_that_of_the_nearest_point_of_the_table(elevation_deg: float, roll_deg: float) -> None:
    R, t = extrinsics(View(0.8, elevation_deg, 40.0, roll_deg, (0.01, 0.02, 0.0)), np.array([0.1, 0.0, 0.03]))
    v, u = np.mgrid[-0.5 : CAMERA.height : 0.5, -0.5 : CAMERA.width : 0.5]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1) @ R
    with np.errstate(divide="ignore"):
        z = (R.T @ t)[2] / rays[..., 2]  # the camera's height over the ray's descent
    assert finest_pixel_m(R, t, CAMERA) == pytest.approx(z[z > 0].min() / 107.0, rel=0.02)


def test_who_looks_up_sees_no_table() -> None:
    R, t = np.diag([1.0, -1.0, -1.0]) @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, -1.0])
    assert finest_pixel_m(R, t, CAMERA) == math.inf
