"""Writes the folder of pages: reads a dataset once, scene by scene, its images side by side."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from synthetless.dataset import records
from synthetless.dataset.layout import CAMERA_FILE, DATASET_FILE, ScenePaths, find_split, scene_ids
from synthetless.dataset.reader import ImageEntries, read_entries, read_specs
from synthetless.dataset.records import Entry
from synthetless.errors import UserError
from synthetless.io.files import atomic_folder, atomic_write, read_json
from synthetless.io.models import INFO_FILE, read_models_info
from synthetless.io.parallel import processes
from synthetless.preview.image import ImageTask, write_image
from synthetless.preview.pages import PAGE_FILE, is_ours, write_pages, write_statistics
from synthetless.preview.statistics import statistics

DEFAULT_FOLDER = "preview"
_MODELS_FOLDERS = ("models", "models_cad", "models_eval")
_BATCH = 16  # images that a worker takes at a time
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
        UserError: there is no such dataset or it is damaged, or ``to`` holds something else or cannot be written.
    """
    source = _Source.of(dataset, split or find_split(dataset), limit)
    to = dataset / DEFAULT_FOLDER if to is None else to
    if to.exists() and not is_ours(to):
        raise UserError(f"{to}: exists already and is no preview; give a new or an empty folder")
    fresh = to.with_name(f".{to.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    with atomic_folder(fresh) as folder:
        _write_images(source, folder, workers)
        write_pages(folder, source.title, source.split, source.count)
        names = {obj_id: class_name(obj_id, info) for obj_id, info in source.infos.items()}
        write_statistics(folder, source.title, statistics(dataset, source.split), names)
    if to.exists():
        shutil.rmtree(to)
    fresh.replace(to)
    return to / PAGE_FILE


@dataclass(frozen=True)
class _Source:
    """What is to be shown.

    Attributes:
        dataset, split: the folders.
        images: number of images in each scene folder, by scene id.
        infos: models_info.json.
        limit: how many images to show at most; None for all.
    """

    dataset: Path
    split: str
    images: Mapping[int, int]
    infos: Mapping[int, Entry]
    limit: int | None

    @classmethod
    def of(cls, dataset: Path, split: str, limit: int | None) -> _Source:
        ids = scene_ids(dataset, split)
        images = {i: len(records.read_scene_json(ScenePaths.of(dataset, i, split).scene_gt)) for i in ids}
        folder = next((name for name in _MODELS_FOLDERS if (dataset / name / INFO_FILE).exists()), _MODELS_FOLDERS[0])
        return cls(dataset, split, images, read_models_info(dataset / folder), limit)

    @property
    def total(self) -> int:
        return sum(self.images.values())

    @property
    def count(self) -> int:
        return self.total if self.limit is None else min(self.limit, self.total)

    @property
    def title(self) -> str:
        path = self.dataset / DATASET_FILE
        name = read_json(path).get("name") if path.exists() else None
        return str(name or self.dataset.resolve().name)

    def scenes(self, to: Path) -> Iterator[list[ImageTask]]:
        """The images to show of each scene folder."""
        wanted = {number * self.total // self.count for number in range(self.count)}
        first = 0
        for scene_id, images in self.images.items():
            numbers = {number - first for number in range(first, first + images) if number in wanted}
            first += images
            if numbers:
                yield list(self._scene(ScenePaths.of(self.dataset, scene_id, self.split), numbers, to))

    def _scene(self, scene: ScenePaths, numbers: set[int], to: Path) -> Iterator[ImageTask]:
        recorded = read_specs(scene) if scene.scene_spec.exists() else {}
        for number, labels in enumerate(read_entries(scene)):
            if number in numbers:
                self._check_objects(scene, labels)
                yield ImageTask(scene, labels, recorded.get(labels.im_id), self.infos, self._size_px(), to)

    def _size_px(self) -> tuple[int, int]:
        path = self.dataset / CAMERA_FILE
        camera = read_json(path)
        try:
            return int(camera["width"]), int(camera["height"])
        except (KeyError, TypeError, ValueError):
            raise UserError(f"{path}: needs the images' width and height") from None

    def _check_objects(self, scene: ScenePaths, labels: ImageEntries) -> None:
        for entry in labels.gt:
            if entry.get("obj_id") not in self.infos:
                raise UserError(
                    f"{scene.scene_gt}: image {labels.im_id} has the object {entry.get('obj_id')}, "
                    f"of which {INFO_FILE} has no entry"
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
    for gt, info, label in zip(task.labels.gt, task.labels.gt_info, task.labels.gt_canonical, strict=True):
        visible, margin = round(1000 * info["visib_fract"]), round(10 * label["discontinuity_margin_deg"])
        flat += [gt["obj_id"], label["regressor_index"], visible, margin]
    return [task.key, flat]


def class_name(obj_id: int, info: Entry) -> str:
    """What an object is called: its id, and its name if models_info.json gives it one."""
    name = info.get("name")
    return f"{obj_id} {name}" if isinstance(name, str) and name else str(obj_id)
