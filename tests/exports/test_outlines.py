"""Masks as polygons: the readers' own functions make the mask again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from synthetless.exports.outlines import border_polygons, centre_polygon

Mask = NDArray[np.bool_]

masks = arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 9))).filter(np.any)


def _ring() -> Mask:
    """A disc with two holes, one of a single pixel, and another piece in its larger hole."""
    y, x = np.mgrid[:40, :50]
    r = np.hypot(x - 24, y - 19)
    mask = (r < 18) & (r > 8)
    mask[19, 9] = False
    return mask | (r < 3)


def _by_pycocotools(mask: Mask) -> Mask:
    polygons = [ring.ravel().astype(float).tolist() for ring in border_polygons(mask)]
    polygons = [(polygon * 3)[: max(len(polygon), 8)] for polygon in polygons]
    decoded: Mask = coco_mask.decode(coco_mask.merge(coco_mask.frPyObjects(polygons, *mask.shape))).astype(bool)
    return decoded


def _drawn(mask: Mask) -> Mask:
    """As ultralytics draws a polygon at the image's own size."""
    canvas = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(canvas, [np.asarray(centre_polygon(mask) + 0.5, dtype=np.int32)], color=1)
    return canvas.astype(bool)


@given(masks)
def test_polygons_along_the_pixels_are_the_mask(mask: Mask) -> None:
    assert np.array_equal(_by_pycocotools(mask), mask)


@given(masks)
def test_a_line_through_the_border_pixels_is_the_mask_and_joins_its_pieces(mask: Mask) -> None:
    drawn = _drawn(mask)
    assert (drawn | ~mask).all()
    pieces, _ = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    if pieces == 2:  # the background, and one
        assert np.array_equal(drawn, mask)
    assert cv2.connectedComponents(drawn.astype(np.uint8), connectivity=8)[0] == 2


def test_holes_stay_holes() -> None:
    mask = _ring()
    assert np.array_equal(_by_pycocotools(mask), mask)
    assert len(border_polygons(mask)) == 2
    added = _drawn(mask) & ~mask
    assert 0 < np.count_nonzero(added) <= 6  # the line to the piece in the hole
    assert not added[19, 9]


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1)])
def test_a_mask_that_fills_the_image_has_its_border(shape: tuple[int, int]) -> None:
    (ring,) = border_polygons(np.ones(shape, bool))
    assert sorted(map(tuple, ring.tolist())) == sorted({(x, y) for x in (0, shape[1]) for y in (0, shape[0])})
