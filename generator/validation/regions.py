"""A mask with its count and box, so that what follows looks at the pixels inside the box only."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.instances import Box, Window, bounding_box

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Region:
    """A mask, counted.

    Attributes:
        pixels: (H, W) bool.
        count: how many are set.
        box: [x, y, w, h] with w = xmax - xmin; (-1, -1, -1, -1) if none is.
        window: the same as a window; an empty one if none is.
    """

    pixels: Mask
    count: int
    box: Box
    window: Window

    @classmethod
    def of(cls, pixels: Mask) -> Self:
        """Count a mask."""
        x, y, w, h = box = bounding_box(pixels, Window(0, 0, pixels.shape[1], pixels.shape[0]))
        count = int(np.count_nonzero(pixels))
        return cls(pixels, count, box, Window(x, y, x + w + 1, y + h + 1) if count else Window(0, 0, 0, 0))

    @property
    def crop(self) -> tuple[slice, slice]:
        """Where the window is in an array over the image."""
        return self.window.slices_in(Window(0, 0, self.pixels.shape[1], self.pixels.shape[0]))

    @property
    def inside(self) -> Mask:
        """The pixels of the window."""
        return self.pixels[self.crop]


def union(regions: Iterable[Region], shape: tuple[int, int]) -> Mask:
    """Pixels of any of the regions."""
    result = np.zeros(shape, dtype=bool)
    for region in regions:
        result[region.crop] |= region.inside
    return result
