"""Where each image of a dataset comes from and where it lies: nothing here depends on what has been made already."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

IMAGES_PER_SCENE = 1000
FIRST_SCENE = 1


@dataclass(frozen=True)
class ImagePlan:
    """One image: its number in the dataset, the drop and view that it shows, and its place on disk."""

    number: int
    drop: int
    view: int
    scene_id: int
    im_id: int


@dataclass(frozen=True)
class Part:
    """A share of a dataset's drops: every ``count``-th, beginning with the ``number``-th, counted from 1."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Part:
        """Read "3/10".

        Raises:
            ValueError: it is written otherwise, or not one of the parts.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        part = cls(*map(int, match.groups())) if match else None
        if part is None or not 1 <= part.number <= part.count:
            raise ValueError(f"part {text!r}: write it as 3/10, from 1/10 to 10/10")
        return part

    def takes(self, drop: int) -> bool:
        """Whether a drop belongs to this part."""
        return drop % self.count == self.number - 1


def plan_image(number: int, views_per_drop: int) -> ImagePlan:
    """The plan of the image with a number, counted from 0."""
    drop, view = divmod(number, views_per_drop)
    scene, im_id = divmod(number, IMAGES_PER_SCENE)
    return ImagePlan(number, drop, view, FIRST_SCENE + scene, im_id)


def image_number(scene_id: int, im_id: int) -> int:
    """The number of the image at a place on disk."""
    return (scene_id - FIRST_SCENE) * IMAGES_PER_SCENE + im_id


def by_drop(numbers: Iterable[int], views_per_drop: int) -> Iterator[tuple[int, list[ImagePlan]]]:
    """The images with these ascending numbers, together with those that show the same drop."""
    plans = (plan_image(number, views_per_drop) for number in numbers)
    for drop, images in groupby(plans, key=lambda image: image.drop):
        yield drop, list(images)
