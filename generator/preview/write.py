"""Writes the folder of pages: reads a dataset scene by scene, and draws its images side by side."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.layout import AMBIGUITY_FILE, CAMERA_FILE, PREVIEW_FOLDER, find_models_folder, refuse_target
from synthetless.dataset.palette import css_color
from synthetless.dataset.reader import Dataset, Image, Scene, read_specs
from synthetless.dataset.records import ImageSpec, ModelInfo, read_scene_json
from synthetless.errors import UserError
from synthetless.io.files import atomic_folder, atomic_write, read_json
from synthetless.io.models import INFO_FILE
from synthetless.io.parallel import processes
from synthetless.preview.image import Drawn, ImageTask, image_key, write_image
from synthetless.preview.pages import (
    PAGE_FILE,
    Summary,
    read_drawn,
    refuse_others,
    write_drawn,
    write_pages,
    write_statistics,
)
from synthetless.preview.statistics import statistics
from synthetless.symmetry import SymmetryTable

_BATCH = 16  # images that a worker takes at a time
_LARGEST_MM = 1e9  # of a diameter that can be drawn
_WORTH_A_PROCESS = 64  # images; starting one takes a second or two
FIRST_IMAGES = 60
"""The gallery's first page: it opens while the rest is being drawn."""


def write_preview(
    dataset: Path,
    to: Path | None = None,
    split: str | None = None,
    limit: int | None = None,
    workers: int | None = None,
    copy: bool = False,
    opens: Callable[[Path], object] = lambda page: None,
) -> Path:
    """Write pages that show a dataset, a folder that opens from the disk without a server or a network.

    Images that a former preview in the same place has drawn, and that have not changed since, are not drawn again.

    Args:
        dataset: folder of a dataset, or of a BOP dataset that was adopted.
        to: folder of the pages; ``preview`` inside the dataset if None. A preview that is there already is replaced
            when the new one is whole.
        split: the folder of images to show; may be left out where there is only one.
        limit: show at most this many images, evenly spread; all if None.
        workers: processes; one per available core if None.
        copy: put copies of the pictures beside the pages, for a folder to send; else the pages show the dataset's own.
        opens: called with the page as soon as it opens, where there are more images than on the gallery's first page
            and no former preview; the others are drawn meanwhile.

    Returns:
        The page to open.

    Raises:
        UserError: there is no such dataset or it is damaged; or ``to`` belongs to it, holds something else than a
            preview, or cannot be written.
    """
    source = _Source.of(Dataset.open(dataset, split), limit)
    to = dataset / PREVIEW_FOLDER if to is None else to
    refuse_target(dataset, to, own=PREVIEW_FOLDER)
    refuse_others(to)
    pages = _Pages(source, to, copy, workers)
    if source.count <= FIRST_IMAGES or (to / PAGE_FILE).exists():
        pages.write(source.count)
    else:
        summary = pages.write(FIRST_IMAGES)
        try:
            opens(to / PAGE_FILE)
            pages.write(source.count, summary)
        except BaseException:
            pages.remove()
            raise
    return to / PAGE_FILE


@dataclass(frozen=True)
class _Source:
    """What is to be shown.

    Attributes:
        dataset: the split.
        images: number of images in each scene folder, by scene id.
        infos: models_info.json.
        symmetries: symmetries.json of a dataset that ``ambiguity`` has judged.
        size_px: width and height of the images, if camera.json says them.
        limit: how many images to show at most; None for all.
    """

    dataset: Dataset
    images: Mapping[int, int]
    infos: Mapping[int, ModelInfo]
    symmetries: SymmetryTable | None
    size_px: tuple[int, int] | None
    limit: int | None

    @classmethod
    def of(cls, dataset: Dataset, limit: int | None) -> _Source:
        images = {i: len(read_scene_json(dataset.paths(i).scene_gt)) for i in dataset.scene_ids}
        symmetries = dataset.symmetries if (dataset.root / AMBIGUITY_FILE).exists() else None
        return cls(dataset, images, dataset.models_info, symmetries, _size_px(dataset.root / CAMERA_FILE), limit)

    @property
    def total(self) -> int:
        return sum(self.images.values())

    @property
    def count(self) -> int:
        return self.total if self.limit is None else min(self.limit, self.total)

    @property
    def title(self) -> str:
        name = None if self.dataset.header is None else self.dataset.header.get("name")
        return str(name or self.dataset.root.resolve().name)

    def scenes(self) -> Iterator[list[tuple[Image, ImageSpec | None]]]:
        """The images to show of each scene folder, and how they were made."""
        wanted = {number * self.total // self.count for number in range(self.count)}
        first = 0
        for scene_id, images in self.images.items():
            numbers = [number - first for number in range(first, first + images) if number in wanted]
            first += images
            if numbers:
                yield list(self._scene(Scene.read(self.dataset.paths(scene_id)), numbers))

    def _scene(self, scene: Scene, numbers: list[int]) -> Iterator[tuple[Image, ImageSpec | None]]:
        scene.labelled()  # refuses one that is not
        for obj_id in np.unique(scene.poses.obj_ids).tolist():
            self._check_object(scene, obj_id)
        recorded = read_specs(scene.paths)
        for number in numbers:
            image = scene.image(number)
            spec = recorded.get(image.im_id)
            if spec is not None and not _fits(spec, image):
                raise UserError(f"{scene.paths.scene_spec}: image {image.im_id} is not the one of scene_gt.json")
            yield image, spec

    def _check_object(self, scene: Scene, obj_id: int) -> None:
        """An object is drawn by its box and its diameter."""
        path = find_models_folder(self.dataset.root) / INFO_FILE
        if obj_id not in self.infos:
            raise UserError(f"{scene.paths.scene_gt}: has the object {obj_id}, of which {path} has no entry")
        diameter = self.infos[obj_id].get("diameter")
        number = diameter if isinstance(diameter, int | float) and not isinstance(diameter, bool) else math.nan
        if not 0 < number < _LARGEST_MM:
            raise UserError(f"{path}: object {obj_id} has diameter {diameter!r}; a positive number of mm is needed")
        try:
            box_corners_mm(self.infos[obj_id])
        except UserError as error:
            raise UserError(f"{path}: object {obj_id}: {error}") from None


def _size_px(path: Path) -> tuple[int, int] | None:
    if not path.exists():
        return None
    camera = read_json(path)
    width, height = camera.get("width"), camera.get("height")
    if width is None and height is None:
        return None
    if type(width) is not int or type(height) is not int or min(width, height) < 1:
        raise UserError(f"{path}: width {width!r} and height {height!r}; positive whole numbers are needed")
    return width, height


def _fits(spec: ImageSpec, image: Image) -> bool:
    """Whether a record can be of an image, by its numbers."""
    numbers = range(len(spec.scene.objects))
    return (
        spec.view in range(len(spec.scene.views))
        and len(spec.instances) == len(image.instances)
        and all(number in numbers for number in spec.instances)
    )


@dataclass(frozen=True)
class _Pages:
    """The folder of pages.

    Attributes:
        source: what they show.
        to: where they stand.
        copy: whether they show copies of the dataset's pictures.
        workers: processes; one per available core if None.
    """

    source: _Source
    to: Path
    copy: bool
    workers: int | None

    def write(self, most: int, summary: Summary | None = None) -> Summary:
        """Write all pages, with the first ``most`` images drawn, in the place of those that stand there.

        The statistics are summed up, which takes seconds, unless they are given; they are returned.
        """
        source = self.source
        names = {obj_id: class_name(obj_id, info) for obj_id, info in source.infos.items()}
        with atomic_folder(self.to, replace=True) as draft:
            self._write_images(draft, most)
            write_pages(draft, source.title, source.dataset.split, source.count)
            summary = summary or Summary.of(statistics(source.dataset.root, source.dataset.split))
            write_statistics(draft, source.title, summary, names)
            refuse_others(self.to)
        return summary

    def remove(self) -> None:
        """Take away pages of which the rest could not be drawn."""
        refuse_others(self.to)
        shutil.rmtree(self.to)

    def _write_images(self, draft: Path, most: int) -> None:
        former, drawn, index = read_drawn(self.to), dict[str, Drawn](), list[Any]()
        with (
            processes(self.workers, most // _WORTH_A_PROCESS) as run,
            tqdm(total=most, desc="preview", unit="image", disable=None) as bar,
        ):
            for scene in self.source.scenes():
                index += [_index_entry(image) for image, _ in scene]
                tasks = [self._task(image, spec, draft, former) for image, spec in scene[: most - len(drawn)]]
                for task, each in zip(tasks, run(write_image, tasks, chunksize=_BATCH), strict=True):
                    drawn[task.key] = each
                    bar.update()
        write_drawn(draft, drawn)
        self._write_index(draft, index)

    def _task(self, image: Image, spec: ImageSpec | None, draft: Path, former: Mapping[str, Drawn]) -> ImageTask:
        source, known = self.source, former.get(image_key(image))
        infos = {each.obj_id: source.infos[each.obj_id] for each in image.instances}
        return ImageTask(image, spec, infos, source.symmetries, source.size_px, draft, self.to, self.copy, known)

    def _write_index(self, draft: Path, index: list[Any]) -> None:
        found = sorted({obj_id for _, flat in index for obj_id in flat[::4]})
        infos = self.source.infos
        classes = [{"id": i, "name": class_name(i, infos[i]), "colour": css_color(i)} for i in found]
        content = json.dumps({"images": index, "classes": classes}, separators=(",", ":"), allow_nan=False)
        atomic_write(draft / "data" / "index.js", f"synthetless.index = {content};\n".encode())


def _index_entry(image: Image) -> list[Any]:
    """[key, [object, regressor, visible thousandths, margin in tenths of a degree, ...of the next instance]]."""
    flat: list[int] = []
    for instance in image.instances:
        label, seen = instance.label, instance.visibility
        assert label is not None and seen is not None  # see ImageTask
        visible, margin = round(1000 * seen.visib_fract), round(10 * label.discontinuity_margin_deg)
        flat += [instance.obj_id, label.regressor_index, visible, margin]
    return [image_key(image), flat]


def class_name(obj_id: int, info: ModelInfo) -> str:
    """What an object is called: its id, and its name if models_info.json gives it one."""
    name = info.get("name")
    return f"{obj_id} {name}" if isinstance(name, str) and name else str(obj_id)
