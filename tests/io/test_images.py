"""Pixels to bytes and back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from synthetless.io import images

seeds = st.integers(0, 2**32 - 1)


def _rgb(seed: int = 0, shape: tuple[int, int] = (37, 53)) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def _unit_vectors(seed: int, shape: tuple[int, int] = (23, 31)) -> NDArray[np.float32]:
    vectors = np.random.default_rng(seed).normal(size=(*shape, 3))
    return (vectors / np.linalg.norm(vectors, axis=2, keepdims=True)).astype(np.float32)


@given(seeds)
def test_png_is_exact_and_reproducible(seed: int) -> None:
    rgb = _rgb(seed)
    encoded = images.encode_png(rgb)
    assert np.array_equal(images.decode_rgb(encoded), rgb)
    assert images.encode_png(rgb.copy()) == encoded


def test_colours_are_where_other_programs_expect_them() -> None:
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 255
    for encoded in (images.encode_png(red), images.encode_jpeg(red, 95)):
        bgr = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        assert bgr[0, 0, 2] > 250
        assert bgr[0, 0, 0] < 5


def test_jpeg_quality_counts_and_is_checked() -> None:
    rgb = _rgb()
    assert len(images.encode_jpeg(rgb, 30)) < len(images.encode_jpeg(rgb, 95))
    assert images.encode_jpeg(rgb, 95) == images.encode_jpeg(rgb, 95)
    with pytest.raises(ValueError, match=r"JPEG quality 0 is out of range; give 1\.\.100"):
        images.encode_jpeg(rgb, 0)


@given(seeds, st.sampled_from([0.05, 0.1, 1.0]))
def test_depth_is_off_by_half_a_step_at_most(seed: int, scale: float) -> None:
    depth = np.random.default_rng(seed).uniform(scale, images.max_depth_mm(scale), (19, 29))
    depth[:3] = 0
    back = images.decode_depth(images.encode_depth(depth, scale), scale)
    assert np.abs(back - depth).max() <= scale / 2 + 1e-9
    assert np.array_equal(back == 0, depth == 0)


def test_depth_beyond_the_range_is_no_depth() -> None:
    limit = images.max_depth_mm(0.1)
    depth = np.array([[limit, limit + 0.04, limit + 0.06, 1e9]])
    assert images.decode_depth(images.encode_depth(depth, 0.1), 0.1).tolist() == [[limit, limit, 0, 0]]


@given(seeds, st.sampled_from([0.001, 0.1, 100.0]))
def test_what_a_depth_image_holds_is_known_before(seed: int, scale: float) -> None:
    """Depths that round to 0, depths beyond the range, and those on either side of both limits."""
    depth = np.exp(np.random.default_rng(seed).uniform(-8, 16, (9, 11)))
    depth[0, :4] = np.array([0.5, 0.5001, 65535.49, 65535.51]) * scale
    assert np.array_equal(images.has_depth(depth, scale), images.decode_depth(images.encode_depth(depth, scale), 1) > 0)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_impossible_depth_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"depth {bad} mm cannot be stored"):
        images.encode_depth(np.array([[500.0, bad]]), 0.1)


@given(seeds, st.floats(0, 1))
def test_masks_are_exact_and_written_as_0_and_255(seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((21, 34)) < share
    encoded = images.encode_mask(mask)
    assert np.array_equal(images.decode_mask(encoded), mask)
    raw = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint8
    assert set(np.unique(raw)) <= {0, 255}


def test_a_mask_of_other_values_is_refused() -> None:
    encoded = cv2.imencode(".png", np.array([[0, 1, 255]], np.uint8))[1].tobytes()
    with pytest.raises(ValueError, match=r"000001_000002\.png: holds the value 1"):
        images.decode_mask(encoded, "000001_000002.png")


@given(seeds)
def test_normals_keep_their_direction(seed: int) -> None:
    normals = _unit_vectors(seed)
    normals[:2] = 0
    normals[2] = (0, 0, -1)
    back = images.decode_normals(images.encode_normals(normals))
    assert np.abs(back - normals).max() < 1.6e-5
    assert not back[:2].any()
    assert np.array_equal(back[2], normals[2])


def test_normals_longer_than_one_are_refused() -> None:
    with pytest.raises(ValueError, match=r"outside -1\.\.1"):
        images.encode_normals(np.full((2, 2, 3), 1.5))


@given(seeds)
def test_object_coordinates_are_exact_to_a_hundredth_of_a_millimetre(seed: int) -> None:
    generator = np.random.default_rng(seed)
    points = generator.uniform(-655, 655, (17, 25, 3)).astype(np.float32)
    points[3, 3] = 0  # the model's origin is a point like any other
    present = generator.random((17, 25)) < 0.5
    back, there = images.decode_object_coordinates(images.encode_object_coordinates(points, present))
    assert np.array_equal(there, present)
    assert np.abs(back - points)[present].max(initial=0) <= 0.01 + 1e-4
    assert not back[~present].any()


def test_coordinates_of_a_huge_model_are_refused() -> None:
    with pytest.raises(ValueError, match="beyond 655 mm"):
        images.encode_object_coordinates(np.full((1, 1, 3), 656.0), np.array([[True]]))


def test_damaged_and_wrong_images_are_named() -> None:
    png = images.encode_png(_rgb())
    damaged = bytearray(png)
    damaged[len(png) // 2] ^= 255
    for data in (b"", b"no image", png[: len(png) // 2], png[:-4], bytes(damaged)):
        with pytest.raises(ValueError, match=r"rgb/000000\.png: not a readable image"):
            images.decode_rgb(data, "rgb/000000.png")
    jpeg = images.encode_jpeg(_rgb(), 90)
    with pytest.raises(ValueError, match="not a readable image"):
        images.decode_rgb(jpeg[: len(jpeg) // 2])
    with pytest.raises(ValueError, match=r"has 3 channel\(s\) of 8 bits; 1 of 16 are needed"):
        images.decode_depth(png, 0.1)
