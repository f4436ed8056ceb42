"""Training of the detector on datasets: early refusals, the loop, its log and curves."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Sampler

from synthetless.dataset.layout import SYMMETRIES_FILE, find_models_folder
from synthetless.dataset.reader import Dataset
from synthetless.errors import UserError
from synthetless.io.files import read_json, write_json
from synthetless.io.models import load_models
from synthetless.io.parallel import usable_cores
from synthetless.learning.data import FolderImages, Photographs, SampleBatcher, picture
from synthetless.learning.detector import Detector, Instances
from synthetless.learning.fit import CHECKPOINT_FILE, LOG_FILE, NO_LOSSES, Record, Schedule, fit, load, read_log
from synthetless.learning.pages import Section, line_chart, write_page
from synthetless.learning.settings import Training
from synthetless.learning.targets import LabelMaker
from synthetless.scenes.settings import SensorSettings
from synthetless.symmetry import SymmetryTable

RUN_FILE, PAGE_FILE = "run.json", "index.html"
_FIXED_BYTES, _BYTES_PER_PIXEL = 200e6, 1000
"""Of a step beside the network: measured at 256 to 640 pixels a side, default settings, float32."""
_PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16}


@dataclass(frozen=True, eq=False)
class Parts:
    """The objects that a detector knows, as it is written beside its weights.

    Attributes:
        ids: sorted; the first is class 1.
        boxes_mm: (8, 3) box corners by id.
        table: their symmetries.
    """

    ids: Sequence[int]
    boxes_mm: Mapping[int, Any]
    table: SymmetryTable

    def maker(self, training: Training) -> LabelMaker:
        """What labels their poses."""
        return LabelMaker(training.labels, self.table, allocentric=True)

    def detector(self, training: Training) -> Detector:
        """A new network for them; errors as in ``Detector``."""
        maker = self.maker(training)
        return Detector(training, [maker.n_regressors(obj_id) for obj_id in self.ids])


def read_parts(datasets: Sequence[Dataset], objects: Sequence[int], models: Path | None = None) -> Parts:
    """The objects to learn, with what the datasets say of them.

    Args:
        datasets: with the same models.
        objects: ids; all if empty.
        models: folder of the models; None for the first dataset's.

    Raises:
        UserError: a model is missing, no instance of an object is in the data, or two datasets give an object
            different symmetries or models.
    """
    root = datasets[0].root
    folder = models or find_models_folder(root)
    loaded = load_models(folder, tuple(objects) or None)
    table = _table(root, loaded)
    for dataset in datasets[1:]:
        if models is None:
            others = load_models(find_models_folder(dataset.root), tuple(loaded))
            for obj_id, model in loaded.items():
                if not np.allclose(model.box_corners_mm, others[obj_id].box_corners_mm, atol=1e-3):
                    raise UserError(f"object {obj_id} is another part in {dataset.root} than in {root}")
        other = _table(dataset.root, loaded)
        for obj_id in loaded:
            if other.entries[obj_id].group != table.entries[obj_id].group:
                raise UserError(f"object {obj_id} has other symmetries in {dataset.root} than in {root}")
    there = {int(obj_id) for dataset in datasets for scene in dataset.scenes() for obj_id in scene.poses.obj_ids}
    missing = sorted(set(objects) - there)
    if missing:
        raise UserError(f"no instance of object {missing[0]} is in the data, which has {sorted(there)}")
    ids = sorted(set(loaded) & there)
    if not ids:
        raise UserError(f"{root}: no instances to learn from")
    return Parts(ids, {i: loaded[i].box_corners_mm for i in ids}, SymmetryTable({i: table.entries[i] for i in ids}))


def _table(root: Path, models: Mapping[int, Any]) -> SymmetryTable:
    """The dataset's table, or the groups that the models declare."""
    path = root / SYMMETRIES_FILE
    if not path.exists():
        return SymmetryTable.from_models_info({obj_id: model.info for obj_id, model in models.items()})
    table = SymmetryTable.read(path)
    for obj_id in models:
        if obj_id not in table.entries:
            raise UserError(f"{path}: has no object {obj_id}")
    return table


def write_run(run: Path, training: Training, parts: Parts) -> None:
    """Write what a run is of; refuse to go on with one that is of something else.

    Raises:
        UserError: the folder holds a run with other settings or objects.
    """
    content = {
        "training": training.model_dump(mode="json"),
        "objects": {str(i): np.asarray(parts.boxes_mm[i]).tolist() for i in parts.ids},
        "symmetries": parts.table.to_dict(),
    }
    path = run / RUN_FILE
    if path.exists():
        kept = read_json(path)
        for key in ("training", "objects", "symmetries"):
            if kept.get(key) != content[key]:
                raise UserError(f"{run}: is a run with other {key}; give another folder, or the same again")
        return
    write_json(path, content)


def read_run(run: Path) -> tuple[Training, Parts]:
    """What a run is of.

    Raises:
        UserError: it is no run.
    """
    content = read_json(run / RUN_FILE)
    try:
        training = Training.model_validate(content["training"])
        boxes = {int(obj_id): np.array(box, dtype=np.float64) for obj_id, box in content["objects"].items()}
        table = SymmetryTable.from_dict(content["symmetries"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{run / RUN_FILE}: is damaged ({' '.join(str(error).split())[:120]})") from None
    return training, Parts(sorted(boxes), boxes, table)


def choose_device(name: str) -> torch.device:
    """``auto`` takes the first GPU, else the CPU.

    Raises:
        UserError: torch does not know the device, or cannot use it.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UserError(f"device {name!r} cannot be used ({str(error).splitlines()[0][:120]})") from None
    return device


class _Steps(Sampler[list[tuple[int, int]]]):
    """Which images a step takes: (step, number), so that the order and the noise follow from the step."""

    def __init__(self, images: int, training: Training, rank: int, first: int) -> None:
        self._images, self._training, self._rank, self._first = images, training, rank, first

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        schedule = self._training.schedule
        for step in range(self._first, schedule.steps):
            rng = np.random.default_rng([self._training.seed, 5, self._rank, step])
            yield [(step, int(number)) for number in rng.integers(0, self._images, schedule.images_per_step)]


class _Pictures(torch.utils.data.Dataset[tuple[Tensor, Instances]]):
    """Pictures and targets by (step, number)."""

    def __init__(self, images: FolderImages, batcher: SampleBatcher, training: Training) -> None:
        self._images, self._batcher, self._training = images, batcher, training
        sensor = training.data.sensor
        self._photographs = None if sensor == "none" else Photographs(images, SensorSettings(preset=sensor))

    def __getitem__(self, place: tuple[int, int]) -> tuple[Tensor, Instances]:
        step, number = place
        data = self._training.data
        rng = np.random.default_rng([self._training.seed, 6, step, number])
        sample = self._images[number] if self._photographs is None else self._photographs.sample(number, rng)
        return picture(sample.pixels, rng, data.brightness, data.noise), self._batcher.instances(sample)


def _stacked(items: Sequence[tuple[Tensor, Instances]]) -> tuple[Tensor, list[Instances]]:
    """Pictures of different sizes are filled up to the right and below."""
    height, width = (max(picture.shape[axis] for picture, _ in items) for axis in (1, 2))
    pictures = torch.full((len(items), 3, height, width), 127.0)
    for i, (one, _) in enumerate(items):
        pictures[i, :, : one.shape[1], : one.shape[2]] = one
    return pictures, [instances for _, instances in items]


class _WithLosses(nn.Module):
    """Makes the losses the forward pass, as DistributedDataParallel needs it."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, pictures: Tensor, instances: Sequence[Instances]) -> Mapping[str, Tensor]:
        return self.detector.losses(pictures, instances)


def train(
    training: Training,
    data: Sequence[Path],
    run: Path,
    device: str = "auto",
    models: Path | None = None,
    tell: Callable[[Record], None] = lambda _: None,
) -> list[Record]:
    """Train a detector, or continue a run that was interrupted; its folder gets checkpoints, a log and curves.

    Under ``torchrun`` every process takes its own images, and gradients are averaged.

    Args:
        training: the settings.
        data: dataset folders.
        run: folder of the run.
        device: ``auto``, or as torch names it.
        models: folder of the models, if they are not in the datasets.
        tell: gets every record of the log.

    Raises:
        UserError: what ``read_parts``, ``write_run`` and ``fit`` refuse; a dataset is empty; too little memory is free.
    """
    images = FolderImages(data)
    if len(images) == 0:
        raise UserError(f"{data[0]}: has no images")
    parts = read_parts(images.datasets, training.data.objects, models)
    batcher = SampleBatcher(parts.maker(training), parts.boxes_mm, parts.ids, training.data.min_visib_fract)
    learned = _Pictures(images, batcher, training)
    height, width = learned[0, 0][0].shape[
        1:
    ]  # refuses data that has not what is asked for, before anything is written
    with _processes(device) as (rank, place):
        _refuse_little_memory(training.schedule.images_per_step * height * width, place)
        if rank == 0:
            write_run(run, training, parts)
        torch.manual_seed(training.seed)
        detector = parts.detector(training).to(place)
        module: nn.Module = _WithLosses(detector)
        if torch.distributed.is_initialized():
            module = nn.parallel.DistributedDataParallel(module, find_unused_parameters=True)
        first = _next_step(run)
        loader = DataLoader(
            learned,
            batch_sampler=_Steps(len(images), training, rank, first),
            num_workers=min(training.data.workers, usable_cores()),  # of more torch says that they may freeze
            collate_fn=_stacked,
        )
        batches = iter(loader)

        def losses(step: int) -> Mapping[str, Tensor]:
            torch.manual_seed(training.seed + 1_000_003 * step + rank)  # which anchors and boxes are drawn
            pictures, instances = next(batches)
            parts_of_loss: Mapping[str, Tensor] = module(pictures.to(place), [known.to(place) for known in instances])
            return parts_of_loss

        settings = training.schedule
        schedule = Schedule(
            settings.steps,
            settings.peak_rate,
            settings.weight_decay,
            log_every=settings.log_every,
            save_every=settings.save_every,
        )
        precision = _PRECISIONS[settings.precision]
        for record in fit(detector, losses, schedule, run, None, precision, place, writes=rank == 0):
            tell(record)
        if rank == 0:
            write_training_page(run)
    return read_log(run)


def _refuse_little_memory(pixels: int, device: torch.device) -> None:
    """Before the first step, instead of being killed in it.

    Raises:
        UserError: less memory is free than a step of so many pixels took when it was measured.
    """
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
    needed = _FIXED_BYTES + _BYTES_PER_PIXEL * pixels
    if free < needed:
        raise UserError(
            f"a step of {pixels:,} pixels needs about {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; take a "
            "smaller schedule.images_per_step"
        )


def _next_step(run: Path) -> int:
    path = run / CHECKPOINT_FILE
    return int(load(path).get("step", 0)) if path.exists() else 0


@contextmanager
def _processes(device: str) -> Iterator[tuple[int, torch.device]]:
    """This process's number and device; joins the group that ``torchrun`` has started, if it has."""
    if int(os.environ.get("WORLD_SIZE", "1")) <= 1:
        yield 0, choose_device(device)
        return
    local = int(os.environ.get("LOCAL_RANK", "0"))
    place = choose_device(f"cuda:{local}" if device == "auto" and torch.cuda.is_available() else device)
    torch.distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield torch.distributed.get_rank(), place
    finally:
        torch.distributed.destroy_process_group()


def write_curves(runs: Sequence[Path], to: Path) -> None:
    """One figure for each loss, with a curve for each run.

    Raises:
        UserError: a folder is no run, or has no log yet; as in ``write_page``.
    """
    logs = {}
    for run in runs:
        training, _ = read_run(run)
        log = read_log(run)
        if not log:
            raise UserError(f"{run / LOG_FILE}: has no records yet")
        logs[f"{run.name} ({training.labels})"] = log
    sections = []
    for loss in _losses_of(next(iter(logs.values()))):
        curves = {
            name: ([float(record["step"]) for record in log], [float(record[loss]) for record in log])
            for name, log in logs.items()
        }
        sections.append(Section(loss, svg=line_chart(curves, "step", loss)))
    write_page(to, "Learning curves", sections)


def _losses_of(log: Sequence[Record]) -> list[str]:
    return [name for name in log[-1] if name not in NO_LOSSES] if log else []


def write_training_page(run: Path) -> None:
    """The learning curves of a run; errors as in ``write_page``."""
    records = read_log(run)
    names = _losses_of(records)
    steps = [float(record["step"]) for record in records]
    curves = {name: (steps, [float(record[name]) for record in records]) for name in names}
    sections = [Section(f"{LOG_FILE}: {len(records)} records", svg=line_chart(curves, "step", "loss"))]
    if records:
        sections.append(Section("Last", "", list(records[-1]), [[f"{value:.4g}" for value in records[-1].values()]]))
    write_page(run / PAGE_FILE, f"Training {run.name}", sections)
