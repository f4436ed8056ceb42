"""A lens bends pixels as OpenCV says, back again to rounding, and never shows two points at one pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from synthetless.config import RecipeError, load_recipe
from synthetless.scenes import lens
from synthetless.scenes.spec import Coefficients, Intrinsics
from synthetless.scenes.warp import warped

BARREL: Coefficients = (-0.3, 0.12, 0.0, 0.0, -0.01)
PINCUSHION: Coefficients = (0.25, 0.05, 0.0, 0.0, 0.02)
TANGENTIAL: Coefficients = (-0.05, 0.01, 0.02, -0.015, 0.0)

_COEFFICIENTS = st.tuples(*(st.floats(-size, size) for size in (0.6, 0.4, 0.03, 0.03, 0.3)))


def _camera(f: float, distortion: Coefficients) -> Intrinsics:
    return Intrinsics(64, 48, f, 1.07 * f, 29.3, 26.1, distortion)


def _matrix(camera: Intrinsics) -> NDArray[np.float64]:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


@settings(max_examples=150, deadline=None)
@given(st.floats(20, 5000), _COEFFICIENTS)
def test_every_pixel_is_where_its_ray_is_projected_to(f: float, distortion: Coefficients) -> None:
    camera = _camera(f, distortion)
    assume(lens.fault(camera) is None)
    columns, rows = np.arange(64), np.arange(48)
    rays = np.stack([*np.broadcast_arrays(*lens.directions(camera, columns, rows)), np.ones((48, 64))], axis=-1)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    shown = lens.project(7.3 * rays, _matrix(camera), distortion)
    assert np.abs(shown - pixels).max() < 1e-9
    theirs, _ = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), _matrix(camera), np.array(distortion))
    assert np.abs(shown - theirs.reshape(48, 64, 2)).max() < 1e-9
    back = lens.undistorted_pixels(pixels, _matrix(camera), np.array(distortion))
    straight = lens.project(rays, _matrix(camera))
    assert np.abs(back - straight).max() < 1e-9 * max(1.0, np.abs(straight).max() / 100)


@settings(max_examples=150, deadline=None)
@given(_COEFFICIENTS, st.integers(0, 2**32 - 1))
def test_nothing_in_reach_is_shown_twice(distortion: Coefficients, seed: int) -> None:
    radius = min(lens.reach(distortion), 5.0)
    rng = np.random.default_rng(seed)
    angle, share = rng.uniform(0, 2 * np.pi, 300), np.sqrt(rng.uniform(0, 1, 300))
    points = radius * share[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    a, b, c = lens.jacobian(points, distortion)
    assert (a + c > 0).all()
    assert (a * c - b * b > 0).all()
    np.testing.assert_allclose(lens.undistorted(lens.distorted(points, distortion), distortion), points, atol=1e-9)


def test_beyond_reach_nothing_is_shown() -> None:
    distortion = (-0.3, 0.0, 0.0, 0.0, 0.0)
    edge = lens.reach(distortion)
    assert edge == pytest.approx(np.sqrt(0.95 / 0.9))
    outermost = float(lens.distorted([edge, 0.0], distortion)[0])
    seen = lens.undistorted([[outermost - 1e-6, 0.0], [outermost + 1e-6, 0.0], [0.0, 99.0]], distortion)
    np.testing.assert_array_equal(np.isnan(seen[:, 0]), [False, True, True])


@pytest.mark.parametrize(
    ("setting", "fault"),
    [
        (
            "[-0.6, 0, 0, 0, 0]",
            r"camera\.distortion = \[-0\.6, 0, 0, 0, 0\]: folds the image 0\.4\d+ focal lengths from",
        ),
        ("[0, 0, 0.3, 0, 0]", r"folds the image"),
        ("[-0.1, 0.2]", r"camera\.distortion"),
        ("[-0.1, 0.2, 0, 0, .nan]", r"camera\.distortion"),
        ("[-0.1, 0.2, 0, 0, 1000]", r"1000\.0 is outside -100\.\.100"),
        ("[0, 0, 0, 0, 100]", r"needs a render of \d+ x \d+ pixels"),
    ],
)
def test_distortion_that_cannot_be_used_is_refused(setting: str, fault: str) -> None:
    frame = [
        "camera.width=640",
        "camera.height=480",
        f"camera.fx={60 if '100]' in setting else 400}",
        "camera.fy=400",
        "camera.cx=320",
        "camera.cy=240",
    ]
    with pytest.raises(RecipeError, match=fault) as refused:
        load_recipe(None, [*frame, f"camera.distortion={setting}"])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION, TANGENTIAL])
def test_a_warped_picture_shows_what_the_rays_meet(distortion: Coefficients) -> None:
    """A smooth pattern on the plane z = 1: warped from the pinhole's view it is what each pixel's ray meets."""
    camera = _camera(60.0, distortion)
    pinhole = lens.pinhole_around(camera)

    def pattern(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
        return np.stack([2 + np.sin(9 * x), 2 + np.cos(8 * y), 2 + x * y], axis=-1).astype(np.float32)

    straight = lens.straight_points(camera)
    of_pinhole = np.broadcast_arrays(*lens.directions(pinhole, np.arange(pinhole.width), np.arange(pinhole.height)))
    assert pinhole.fx >= camera.fx
    assert all(of_pinhole[axis].min() < straight[..., axis].min() for axis in (0, 1))
    assert all(of_pinhole[axis].max() > straight[..., axis].max() for axis in (0, 1))
    seen = warped(pattern(*of_pinhole), camera)
    np.testing.assert_allclose(seen, pattern(straight[..., 0], straight[..., 1]), atol=0.01)


def _width(x: NDArray[np.float64], heights: NDArray[np.float64]) -> float:
    """Over how many pixels edges rise from 10 to 90 %, x being where their pixels are."""
    bins = np.unique(np.round(16 * x))
    mean = np.array([heights[np.round(16 * x) == place].mean() for place in bins])
    return float(np.interp(0.9, mean, bins / 16) - np.interp(0.1, mean, bins / 16))


@pytest.mark.parametrize("distortion", [BARREL, PINCUSHION])
@pytest.mark.parametrize("column", [6, 20, 31])
def test_a_rendered_edge_stays_as_wide_as_it_is(distortion: Coefficients, column: int) -> None:
    """Edges of renders rise over about 1.4 pixels; none is blurred by more than a sixth."""
    camera = Intrinsics(64, 48, 72.0, 72.0, 31.5, 23.5, distortion)
    pinhole, sigma, x, heights = lens.pinhole_around(camera), 0.55, [], []
    for place in column + np.arange(48) / 48:
        edge = pinhole.fx * lens.directions(camera, [place], [23.5])[0][0, 0] + pinhole.cx
        row = ndtr((np.arange(pinhole.width) - edge) / sigma).astype(np.float32)
        seen = warped(np.tile(row[None, :, None], (pinhole.height, 1, 3)), camera)[23:25, :, 0].mean(axis=0)
        x.append(np.arange(64) - place)
        heights.append(seen)
    width = _width(np.concatenate(x), np.concatenate(heights))
    assert 0.8 * 2.563 * sigma < width < 7 / 6 * 2.563 * sigma


def test_highlights_have_no_dark_rings() -> None:
    camera = _camera(60.0, BARREL)
    pinhole = lens.pinhole_around(camera)
    render = np.full((pinhole.height, pinhole.width, 3), 0.25, dtype=np.float32)
    render[pinhole.height // 2 : pinhole.height // 2 + 2, pinhole.width // 2 : pinhole.width // 2 + 2] = 500.0
    seen = warped(render, camera)
    assert seen.min() == 0.25
    assert seen.max() > 100
