"""How a dataset is damaged on purpose: edit one file, and know where that must be told."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.layout import ScenePaths
from synthetless.validation.report import Kind

IMAGE = 1
"""Most damages are done to image 1 of scene folder 000001 ..."""
WHOLE, OTHER, HIDDEN, CUT = 1, 3, 4, 0
"""... and its instances: one seen wholly, another, one half hidden, one cut by the border."""


class Victim:
    """A copy of the dataset to be damaged."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.scene = ScenePaths.of(root, 1)

    @contextmanager
    def json(self, path: Path) -> Iterator[Any]:
        """The content of a JSON file, written back afterwards."""
        content = json.loads(path.read_text())
        yield content
        path.write_text(json.dumps(content))

    @contextmanager
    def entry(self, name: str, instance: int | None = None, scene_id: int = 1) -> Iterator[Any]:
        """Image 1's entry, or one instance's, in scene_NAME.json."""
        with self.json(getattr(ScenePaths.of(self.root, scene_id), f"scene_{name}")) as content:
            yield content[str(IMAGE)] if instance is None else content[str(IMAGE)][instance]

    @contextmanager
    def specs(self) -> Iterator[list[Any]]:
        """The lines of scene_spec.jsonl."""
        lines = [json.loads(line) for line in self.scene.scene_spec.read_text().splitlines()]
        yield lines
        self.scene.scene_spec.write_text("".join(json.dumps(line) + "\n" for line in lines))

    @contextmanager
    def annotation(self, instance: int) -> Iterator[Any]:
        """The annotation of an instance of image 1 in scene_gt_coco.json; all of the image's are visible."""
        with self.json(self.scene.scene_gt_coco) as content:
            yield [a for a in content["annotations"] if a["image_id"] == IMAGE][instance]

    @staticmethod
    def repaint(path: Path, change: Callable[[NDArray[Any]], NDArray[Any]]) -> None:
        """Replace an image file by a whole one of other pixels."""
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), change(pixels))

    def mask(self, instance: int = WHOLE) -> Path:
        """A whole silhouette."""
        return self.scene.mask(IMAGE, instance)

    def visible(self, instance: int = WHOLE) -> Path:
        """A visible part."""
        return self.scene.mask_visib(IMAGE, instance)

    @property
    def depth(self) -> Path:
        """The depth image."""
        return self.scene.depth(IMAGE)

    @property
    def rgb(self) -> Path:
        """The colour image."""
        return self.scene.rgb(IMAGE)


@dataclass(frozen=True)
class Damage:
    """One kind of damage, and the finding it must lead to.

    Attributes:
        name: of the damage.
        act: does it.
        kind: of the finding.
        file: the finding's, relative to the dataset.
        image, instance: the finding's.
        deep: whether only recomputing the image can show it.
    """

    name: str
    act: Callable[[Victim], None]
    kind: Kind
    file: str
    image: int | None
    instance: int | None
    deep: bool


DAMAGES: list[Damage] = []


def damage(
    kind: Kind, file: str, image: int | None = None, instance: int | None = None, deep: bool = False
) -> Callable[[Callable[[Victim], None]], Callable[[Victim], None]]:
    """Put a function on the list of damages; ``file`` is relative to the scene folder if it does not begin with /."""
    place = file[1:] if file.startswith("/") else f"train_synthetless/000001/{file}"

    def enlist(act: Callable[[Victim], None]) -> Callable[[Victim], None]:
        DAMAGES.append(Damage(act.__name__, act, kind, place, image, instance, deep))
        return act

    return enlist


def fringe(mask: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels next to a mask."""
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return grown & ~(mask > 0)
