"""Masks as polygons, for formats that know no run lengths; outlines by OpenCV.

One polygon may have holes: a seam of no width leads to the hole, around it and back, and the even-odd rule, by which
OpenCV, pycocotools and ultralytics fill polygons, leaves the hole out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from synthetless.extras import cv2

Ring = NDArray[np.int64]
"""(N, 2) corners (column, row) of a closed polygon; the last is joined with the first."""


def border_polygons(mask: NDArray[np.bool_]) -> list[Ring]:
    """A polygon along the pixels' edges for each connected piece of an (H, W) mask, with its holes.

    Pixel (i, j) covers [i, i + 1] x [j, j + 1], as in COCO: pycocotools makes exactly this mask of the polygons.
    """
    twice = np.repeat(np.repeat(mask, 2, axis=0), 2, axis=1)  # both edges of a pixel have a sample of their own
    return [_straightened(_joined([(ring + 1) // 2 for ring in piece])) for piece in _pieces(twice)]


def centre_polygon(mask: NDArray[np.bool_]) -> Ring:
    """One polygon through the centres of the border pixels of all pieces of an (H, W) mask, with their holes.

    Drawn by OpenCV, which fills what the lines touch, it is the mask again, and a line one pixel wide from each piece
    to the next: so ultralytics joins the pieces of an instance, of which it knows only one polygon.
    """
    return _straightened(_joined([ring for piece in _pieces(mask) for ring in piece]))


def _pieces(mask: NDArray[np.bool_]) -> Iterator[list[Ring]]:
    """For each connected piece the outline, and those of its holes."""
    contours, hierarchy = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = [contour[:, 0].astype(np.int64) for contour in contours]
    parents = [] if hierarchy is None else hierarchy[0, :, 3].tolist()
    for piece, parent in enumerate(parents):
        if parent < 0:
            yield [rings[piece], *(ring for ring, of in zip(rings, parents, strict=True) if of == piece)]


def _joined(rings: Sequence[Ring]) -> Ring:
    """One ring of several: the nearest one is joined next, at the points where it is nearest."""
    joined, *others = rings
    while others:
        tree = cKDTree(joined)
        found = [tree.query(ring) for ring in others]
        nearest = min(range(len(others)), key=lambda number: float(found[number][0].min()))
        distances, places = found[nearest]
        start = int(distances.argmin())
        place = int(places[start])
        around = np.roll(others.pop(nearest), -start, axis=0)
        joined = np.concatenate([joined[: place + 1], around, around[:1], joined[place:]])
    return joined


def _straightened(ring: Ring) -> Ring:
    """The ring without repeated points, and without those in the middle of a straight line."""
    ring = ring[(ring != np.roll(ring, 1, axis=0)).any(axis=1)] if len(ring) > 1 else ring
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    returns = (before * after).sum(axis=1) < 0
    return ring[turns | returns] if (turns | returns).any() else ring
