"""Writes the folder of pages: reads a dataset scene by scene, and draws its images side by side."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.layout import AMBIGUITY_FILE, CAMERA_FILE, PREVIEW_FOLDER, find_models_folder, refuse_target
from synthetless.dataset.reader import Dataset, Image, Scene, read_specs
from synthetless.dataset.records import ImageSpec, ModelInfo, read_scene_json
from synthetless.errors import UserError
from synthetless.io.files import atomic_folder, atomic_write, read_json
from synthetless.io.models import INFO_FILE
from synthetless.io.parallel import processes
from synthetless.preview.image import ImageTask, write_image
from synthetless.preview.pages import PAGE_FILE, refuse_others, write_pages, write_statistics
from synthetless.preview.statistics import statistics
from synthetless.symmetry import SymmetryTable

_BATCH = 16  # images that a worker takes at a time
_LARGEST_MM = 1e9  # of a diameter that can be drawn
_WORTH_A_PROCESS = 64  # images; starting one takes a second or two


def write_preview(
    dataset: Path,
    to: Path | None = None,
    split: str | None = None,
    limit: int | None = None,
    workers: int | None = None,
) -> Path:
    """Write pages that show a dataset, a folder that opens from the disk without a server or a network.

    Args:
        dataset: folder of a dataset, or of a BOP dataset that was adopted.
        to: folder of the pages; ``preview`` inside the dataset if None. A preview that is there already is replaced
            when the new one is whole.
        split: the folder of images to show; may be left out where there is only one.
        limit: show at most this many images, evenly spread; all if None.
        workers: processes; one per available core if None.

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
    with atomic_folder(to, replace=True) as folder:
        _write_images(source, folder, workers)
        write_pages(folder, source.title, source.dataset.split, source.count)
        names = {obj_id: class_name(obj_id, info) for obj_id, info in source.infos.items()}
        write_statistics(folder, source.title, statistics(dataset, source.dataset.split), names)
        refuse_others(to)
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

    def scenes(self, to: Path) -> Iterator[list[ImageTask]]:
        """The images to show of each scene folder."""
        wanted = {number * self.total // self.count for number in range(self.count)}
        first = 0
        for scene_id, images in self.images.items():
            numbers = [number - first for number in range(first, first + images) if number in wanted]
            first += images
            if numbers:
                yield list(self._scene(Scene.read(self.dataset.paths(scene_id)), numbers, to))

    def _scene(self, scene: Scene, numbers: list[int], to: Path) -> Iterator[ImageTask]:
        scene.labelled()  # refuses one that is not
        for obj_id in np.unique(scene.poses.obj_ids).tolist():
            self._check_object(scene, obj_id)
        recorded = read_specs(scene.paths)
        for number in numbers:
            image = scene.image(number)
            spec = recorded.get(image.im_id)
            if spec is not None and not _fits(spec, image):
                raise UserError(f"{scene.paths.scene_spec}: image {image.im_id} is not the one of scene_gt.json")
            yield ImageTask(image, spec, self.infos, self.symmetries, self.size_px, to)

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


def _write_images(source: _Source, folder: Path, workers: int | None) -> None:
    index: list[Any] = []
    with (
        processes(workers, source.count // _WORTH_A_PROCESS) as run,
        tqdm(total=source.count, desc="preview", unit="image", disable=None) as bar,
    ):
        for tasks in source.scenes(folder):
            for _ in run(write_image, tasks, chunksize=_BATCH):
                bar.update()
            index += [_index_entry(task) for task in tasks]
    found = sorted({obj_id for _, flat in index for obj_id in flat[::4]})
    classes = [{"id": obj_id, "name": class_name(obj_id, source.infos[obj_id])} for obj_id in found]
    content = json.dumps({"images": index, "classes": classes}, separators=(",", ":"), allow_nan=False)
    atomic_write(folder / "data" / "index.js", f"synthetless.index = {content};\n".encode())


def _index_entry(task: ImageTask) -> list[Any]:
    """[key, [object, regressor, visible thousandths, margin in tenths of a degree, ...of the next instance]]."""
    flat: list[int] = []
    for instance in task.image.instances:
        label, seen = instance.label, instance.visibility
        assert label is not None and seen is not None  # see ImageTask
        visible, margin = round(1000 * seen.visib_fract), round(10 * label.discontinuity_margin_deg)
        flat += [instance.obj_id, label.regressor_index, visible, margin]
    return [task.key, flat]


def class_name(obj_id: int, info: ModelInfo) -> str:
    """What an object is called: its id, and its name if models_info.json gives it one."""
    name = info.get("name")
    return f"{obj_id} {name}" if isinstance(name, str) and name else str(obj_id)
