"""The proof: the same network, crops and steps under several label sets, and what comes of it.

Crops are ray cast (``stream``); a run is one label set and one seed, on one thread, the runs side by side. A finished
run stays in the folder, so that an interrupted comparison goes on, and another measurement does not train again.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from synthetless.dataset.reader import Dataset
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io.files import atomic_folder, atomic_write, read_json, write_json
from synthetless.io.images import encode_png
from synthetless.io.models import ObjectModel, load_models
from synthetless.io.parallel import each
from synthetless.learning.crops import CropBatcher, CropNet
from synthetless.learning.data import crops_of, sample_of
from synthetless.learning.fit import Losses, Record, Schedule, fit, load, load_weights, save
from synthetless.learning.pages import Curve, Section, line_chart, write_page
from synthetless.learning.solve import solve_pose
from synthetless.learning.stream import Crops, CropSettings, CropStream
from synthetless.learning.targets import LABEL_SETS, LabelMaker, LabelSet
from synthetless.symmetry import SymmetryTable

Floats = NDArray[np.float64]

RECALL_DEG = (5.0, 10.0, 20.0)
_ELEVATIONS_DEG = ((-90.0, 40.0), (40.0, 70.0), (70.0, 90.1))
_MARGINS_DEG = ((0.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 180.1))
_UPRIGHT_DEG = 10.0
"""How far the axis of a part that stands upright may lean."""
_VISIBLE = 0.6
"""Share of a rendered part that must be visible."""
SETTINGS_FILE = "settings.json"
_FILES = ("pixels", "obj_ids", "R_m2c", "t_m2c", "K", "elevation_deg")
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
_PICTURES, _PICTURE_PX = 24, 144


@dataclass(frozen=True)
class Comparison:
    """What is compared, and how much is learned.

    Attributes:
        models: folder of the models.
        objects: which of them.
        labels: the label sets.
        seeds: how many runs of each.
        steps, batch: of a run.
        train_crops, validation_crops: how many are made.
        crops: how they are drawn.
        rendered: dataset folder on whose instances the networks are also measured, those that are mostly visible; of
            networks for upright parts those that stand upright.
        full_weight_deg: weight the corners' loss by the margin, which counts in full from here on; None does not.
        width: channels of the network's first layer.
        tuning: another dataset folder, from whose instances the networks learn afterwards, to be measured again.
        tuning_steps: how long; the learning rate is a quarter.
    """

    models: Path
    objects: tuple[int, ...] = (18, 27, 29, 30)
    labels: tuple[LabelSet, ...] = LABEL_SETS
    seeds: int = 3
    steps: int = 1500
    batch: int = 96
    train_crops: int = 12_000
    validation_crops: int = 1200
    crops: CropSettings = field(default_factory=CropSettings)
    rendered: Path | None = None
    full_weight_deg: float | None = None
    width: int = 16
    tuning: Path | None = None
    tuning_steps: int = 300

    def __post_init__(self) -> None:
        for name in ("seeds", "steps", "batch", "train_crops", "validation_crops", "width", "tuning_steps"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} is {getattr(self, name)}; at least 1 is needed")
        if not self.labels:
            raise UserError(f"no label sets to compare: give some of {', '.join(LABEL_SETS)}")
        for labels in self.labels:
            if labels not in LABEL_SETS:
                raise UserError(f"unknown label set {labels!r}: use some of {', '.join(LABEL_SETS)}")
        if self.tuning is not None and self.rendered is None:
            raise UserError("a dataset to tune on is given, but none of rendered images to measure on")


@dataclass(frozen=True)
class Row:
    """What a run reaches on some of the validation crops.

    Attributes:
        crops: how many.
        l1: mean distance of the responsible regressor's corners, in sides of the crop.
        spread: median over the corners of the standard deviation of the predictions over that of the labels.
        chosen: share for which the classifier chooses the responsible regressor.
        median_deg: median angle to the nearest pose that looks the same; 180 for corners without a pose.
        recalls: share within 5, 10 and 20 degrees.
    """

    crops: int
    l1: float
    spread: float
    chosen: float
    median_deg: float
    recalls: tuple[float, ...]


@dataclass(frozen=True)
class Run:
    """One label set and seed.

    Attributes:
        labels, seed: which.
        records: the log, with the validation's ``val_l1`` at every interval.
        rows: by group and name; ("all", "").
    """

    labels: LabelSet
    seed: int
    records: Sequence[Record]
    rows: Mapping[str, Row]


@dataclass(frozen=True)
class _Task:
    comparison: Comparison
    labels: LabelSet
    seed: int
    folder: Path


def compare(comparison: Comparison, out: Path, workers: int | None = None) -> list[Run]:
    """Run everything and write ``index.html``, ``runs.json`` and pictures into a folder.

    What an earlier call with the same settings has finished there, crops and networks, is used again.

    Raises:
        UserError: a model is missing, or the folder cannot be written or holds a comparison with other settings.
    """
    models = load_models(comparison.models, comparison.objects)
    datasets = {"rendered": comparison.rendered, "tuning": comparison.tuning}
    of_datasets = {name: rendered_crops(comparison, root) for name, root in datasets.items() if root is not None}
    _claim(out, comparison, models)
    for name, crops in of_datasets.items():
        _keep(crops, out / "crops" / name)
    shares = [("train", comparison.train_crops, 1), ("validation", comparison.validation_crops, 2)]
    for name, count, seed in shares:
        folder = out / "crops" / name
        if folder.exists():
            continue
        parts = [(comparison, seed, first, min(500, count - first)) for first in range(0, count, 500)]
        _keep(Crops.concatenate(list(each(_make_crops, parts, workers, f"{name} crops", "share"))), folder)
    tasks = [_Task(comparison, labels, seed, out) for seed in range(comparison.seeds) for labels in comparison.labels]
    runs = list(each(_run, tasks, workers, "runs", "run"))
    write_json(out / "runs.json", {f"{run.labels} {run.seed}": _plain(run) for run in runs})
    write_comparison_page(comparison, runs, out)
    return runs


def _claim(out: Path, comparison: Comparison, models: Mapping[int, ObjectModel]) -> None:
    """Note in the folder what the runs in it follow from, or refuse it if that is something else."""
    wanted = {
        "steps": comparison.steps,
        "batch": comparison.batch,
        "train_crops": comparison.train_crops,
        "validation_crops": comparison.validation_crops,
        "crops": asdict(comparison.crops),
        "full_weight_deg": comparison.full_weight_deg,
        "width": comparison.width,
        "models": {str(obj_id): model.digest for obj_id, model in models.items()},
        "symmetries": {
            str(obj_id): {name: value for name, value in model.info.items() if name.startswith("symmetries")}
            for obj_id, model in models.items()
        },
    }
    wanted = json.loads(json.dumps(wanted))  # as the file gives it back
    path = out / SETTINGS_FILE
    if path.exists():
        kept = read_json(path)
        for name, value in wanted.items():
            if kept.get(name) != value:
                raise UserError(f"{out}: holds a comparison with other settings ({name}); give another folder")
    else:
        write_json(path, wanted)


def _make_crops(part: tuple[Comparison, int, int, int]) -> Crops:
    comparison, seed, first, count = part
    stream = CropStream(load_models(comparison.models, comparison.objects), comparison.crops, seed)
    return stream.crops(first, count)


def _keep(crops: Crops, folder: Path) -> None:
    with atomic_folder(folder, replace=True) as draft:
        for column in _FILES:
            np.save(draft / f"{column}.npy", getattr(crops, column))


def _load_crops(folder: Path) -> Crops:
    return Crops(
        *(np.load(folder / f"{column}.npy", mmap_mode="c" if column == "pixels" else None) for column in _FILES)
    )


def _run(task: _Task) -> Run:
    torch.set_num_threads(1)
    comparison = task.comparison
    models = load_models(comparison.models, comparison.objects)
    names = [
        "train",
        "validation",
        *(["rendered"] if comparison.rendered is not None else []),
        *(["tuning"] if comparison.tuning is not None else []),
    ]
    crops = CropSets(*(_load_crops(task.folder / "crops" / name) for name in names))
    kept = task.folder / "runs" / f"{task.labels}-{task.seed}.pt"
    trained = train_crops(comparison, models, crops, task.labels, task.seed, kept)
    if task.seed == 0:
        picture = _pictures(trained.corners, crops.validation)
        atomic_write(task.folder / "pictures" / f"{task.labels}.png", encode_png(picture))
    return trained.run


@dataclass(frozen=True, eq=False)
class CropSets:
    """What is learned from, and what is measured on.

    Attributes:
        train: ray-cast crops to learn from.
        validation: others to measure on.
        rendered: rendered ones to measure on, too.
        tuning: rendered ones to learn from afterwards.
    """

    train: Crops
    validation: Crops
    rendered: Crops | None = None
    tuning: Crops | None = None


@dataclass(frozen=True, eq=False)
class Trained:
    """A run, the network, and its corners (N, 8, 2) in pixels of the validation crops, all before it was tuned."""

    run: Run
    net: CropNet
    corners: Floats


def train_crops(
    comparison: Comparison,
    models: Mapping[int, ObjectModel],
    crops: CropSets,
    labels: LabelSet,
    seed: int,
    kept: Path | None = None,
) -> Trained:
    """One run: train on crops under a label set, and measure on others.

    Args:
        comparison: see there.
        models: of the objects.
        crops: what is learned from, and what is measured on.
        labels, seed: which run.
        kept: file of the trained network: read if it exists, else written.

    Raises:
        UserError: the file is damaged or of another network.
    """
    torch.manual_seed(seed)
    table = SymmetryTable.from_models_info({obj_id: model.info for obj_id, model in models.items()})
    boxes = {obj_id: model.box_corners_mm for obj_id, model in models.items()}
    maker = LabelMaker(labels, table)
    batcher = CropBatcher(maker, boxes, sorted(models))
    net = CropNet(comparison.crops.size_px, len(models), batcher.regressors, comparison.width)
    if kept is not None and kept.exists():
        records = _read_net(net, kept)
    else:
        lesson = _Lesson(net, batcher, comparison, seed)
        records = lesson.learn(crops.train, crops.validation)
        if kept is not None:
            save(kept, {"model": net.state_dict(), "records": records})
    judge = _Judge(net, batcher, maker, table, boxes)
    rows, corners_px = judge.rows(crops.validation)
    run = Run(labels, seed, records, rows)
    if crops.rendered is not None:
        rows |= _prefixed("rendered", judge.rows(crops.rendered)[0])
    trained = Trained(run, net, corners_px)
    if crops.rendered is not None and crops.tuning is not None:
        tuned = copy.deepcopy(net)
        _Lesson(tuned, batcher, comparison, seed).tune(crops.tuning)
        rows |= _prefixed("tuned", replace(judge, net=tuned).rows(crops.rendered)[0])
    return trained


def _read_net(net: CropNet, path: Path) -> list[Record]:
    """Give a network the weights that a file keeps; the log of its training."""
    content = load(path)
    if not content.get("records"):
        raise UserError(f"{path}: is no network of a comparison")
    load_weights(net, content.get("model", {}), path)
    records: list[Record] = content["records"]
    return records


def _prefixed(name: str, rows: Mapping[str, Row]) -> dict[str, Row]:
    return {f"{name}, {of}": row for of, row in rows.items()}


@dataclass(frozen=True, eq=False)
class _Lesson:
    """Trains a network; the batches follow from the seed and the step."""

    net: CropNet
    batcher: CropBatcher
    comparison: Comparison
    seed: int

    def learn(self, train: Crops, validation: Crops) -> list[Record]:
        """On ray-cast crops, with the L1 of the corners on others in the log."""
        held_out = self.batcher.batch(validation)

        def measure() -> Mapping[str, float]:
            with torch.no_grad():
                return {"val_l1": float(held_out.losses(self.net(held_out.pixels))["corners"])}

        steps = self.comparison.steps
        schedule = Schedule(steps, log_every=max(1, steps // 15))
        return list(fit(self.net, self._losses(train, 3), schedule, measure=measure))

    def tune(self, crops: Crops) -> None:
        """On rendered ones, gently."""
        steps = self.comparison.tuning_steps
        schedule = Schedule(steps, peak_rate=Schedule.peak_rate / 4, log_every=steps)
        for _ in fit(self.net, self._losses(crops, 4), schedule):
            pass

    def _losses(self, crops: Crops, stream: int) -> Losses:
        comparison = self.comparison
        roll_deg = 180.0 if comparison.crops.poses == "any" else comparison.crops.roll_deg

        def losses(step: int) -> Mapping[str, torch.Tensor]:
            rng = np.random.default_rng([self.seed, stream, step])
            rows = rng.integers(0, len(crops), comparison.batch)
            batch = self.batcher.augmented(crops.take(rows), rng, roll_deg)
            return batch.losses(self.net(batch.pixels), comparison.full_weight_deg)

        return losses


@dataclass(frozen=True, eq=False)
class _Judge:
    """Measures a network on crops."""

    net: CropNet
    batcher: CropBatcher
    maker: LabelMaker
    table: SymmetryTable
    boxes_mm: Mapping[int, Floats]

    def rows(self, crops: Crops) -> tuple[dict[str, Row], Floats]:
        """What it reaches on all crops, by object, elevation and margin; and its corners (N, 8, 2), pixels."""
        batch, size = self.batcher.batch(crops), crops.pixels.shape[1]
        self.net.eval()
        with torch.no_grad():
            output = self.net(batch.pixels).of_class(batch.classes)
        chosen, index = output.chosen(batch.counts)
        responsible = output.corners[torch.arange(len(crops)), batch.index].numpy()
        corners_px = chosen.numpy().astype(np.float64) * size + (size - 1) / 2
        measured = _Measured(
            responsible,
            batch.corners.numpy(),
            (index == batch.index).numpy(),
            _angles_deg(corners_px, crops, self.table, self.boxes_mm),
            crops.obj_ids,
        )
        margins = self.maker(crops.obj_ids, crops.R_m2c, crops.t_m2c).margin_deg
        return {name: measured.row(rows) for name, rows in _groups(crops, margins)}, corners_px


def _groups(crops: Crops, margins_deg: Floats) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Names of rows, and which crops they are of; empty ones are left out."""
    yield "all", np.ones(len(crops), dtype=bool)
    for obj_id in np.unique(crops.obj_ids):
        mine = crops.obj_ids == obj_id
        yield f"object {obj_id}", mine
        for low, high in _ELEVATIONS_DEG:
            inside = mine & (crops.elevation_deg >= low) & (crops.elevation_deg < high)
            if inside.any():
                yield f"object {obj_id}, elevation {low:g} to {high:.3g}", inside
    for low, high in _MARGINS_DEG:
        inside = (margins_deg >= low) & (margins_deg < high)
        if inside.any():
            yield f"margin {low:g} to {high:.4g}", inside


def rendered_crops(comparison: Comparison, folder: Path) -> Crops:
    """Crops of a dataset's instances, as virtual cameras that look straight at the parts see them.

    Raises:
        UserError: none of its instances can be used.
    """
    dataset = Dataset.open(folder)
    parts = []
    for image in dataset:
        sample = sample_of(image)
        if image.R_w2c is None:
            raise UserError(
                f"{dataset.root}: does not say where the table is (cam_R_w2c); whether parts stand is unknown"
            )
        up = image.R_w2c[:, 2]
        axis = sample.R_m2c[:, :, 2]
        wanted = np.isin(sample.obj_ids, comparison.objects)
        if comparison.crops.poses == "upright":
            wanted &= axis @ up > np.cos(np.radians(_UPRIGHT_DEG))
        to_camera = -sample.t_m2c / np.linalg.norm(sample.t_m2c, axis=1, keepdims=True)
        elevation = np.degrees(np.arcsin(np.clip(to_camera @ up, -1, 1)))
        own = crops_of(sample, comparison.crops.size_px, min_visib_fract=_VISIBLE, elevation=elevation, wanted=wanted)
        if len(own):
            parts.append(own)
    if not parts:
        raise UserError(f"{dataset.root}: has no instance of the objects that is visible enough and stands as needed")
    return Crops.concatenate(parts)


@dataclass(frozen=True, eq=False)
class _Measured:
    """Predictions and labels of N crops, from which rows are made."""

    predicted: NDArray[np.float32]
    labelled: NDArray[np.float32]
    chosen: NDArray[np.bool_]
    angles_deg: Floats
    obj_ids: NDArray[np.int64]

    def row(self, rows: NDArray[np.bool_]) -> Row:
        angles = self.angles_deg[rows]
        return Row(
            int(rows.sum()),
            float(np.abs(self.predicted[rows] - self.labelled[rows]).mean()),
            self._spread(rows),
            float(self.chosen[rows].mean()),
            float(np.median(angles)),
            tuple(float((angles < limit).mean()) for limit in RECALL_DEG),
        )

    def _spread(self, rows: NDArray[np.bool_]) -> float:
        """Each object for itself: that their means differ is no spread of one object's corners."""
        ratios = []
        for obj_id in np.unique(self.obj_ids[rows]):
            own = rows & (self.obj_ids == obj_id)
            of_labels = self.labelled[own].std(axis=0)
            ratios.append((self.predicted[own].std(axis=0) / np.maximum(of_labels, 1e-6)).ravel())
        return float(np.median(np.concatenate(ratios)))


def _angles_deg(corners_px: Floats, crops: Crops, table: SymmetryTable, boxes: Mapping[int, Floats]) -> Floats:
    """(N,) angle from the solved pose to the nearest one that looks like the true one; 180 without a pose."""
    angles = np.full(len(crops), 180.0)
    for i, obj_id in enumerate(crops.obj_ids):
        pose = solve_pose(corners_px[i], boxes[int(obj_id)], crops.K[i])
        if pose is not None:
            group = table.entries[int(obj_id)].group
            angles[i] = group.appearance_distance_deg(crops.R_m2c[i][None], pose.R_m2c[None])[0]
    return angles


def _pictures(corners_px: Floats, crops: Crops) -> NDArray[np.uint8]:
    """Some crops with the predicted box."""
    drawn = []
    scale = _PICTURE_PX / crops.pixels.shape[1]
    for pixels, corners in zip(crops.pixels[:_PICTURES], corners_px[:_PICTURES], strict=True):
        large = cv2.resize(np.array(pixels), (_PICTURE_PX, _PICTURE_PX), interpolation=cv2.INTER_CUBIC)
        at = np.clip((corners + 0.5) * scale - 0.5, -1e4, 1e4).round().astype(int)
        for a, b in _EDGES:
            cv2.line(large, at[a].tolist(), at[b].tolist(), (40, 220, 60), 1, cv2.LINE_AA)
        drawn.append(large)
    drawn += [np.zeros_like(drawn[0])] * (-len(drawn) % 8)
    return np.concatenate([np.concatenate(drawn[i : i + 8], axis=1) for i in range(0, len(drawn), 8)])


def _plain(run: Run) -> dict[str, Any]:
    return {
        "labels": run.labels,
        "seed": run.seed,
        "records": list(run.records),
        "rows": {name: asdict(row) for name, row in run.rows.items()},
    }


def _of(runs: Iterable[Run], labels: LabelSet, name: str) -> list[Row]:
    return [run.rows[name] for run in runs if run.labels == labels and name in run.rows]


def _cell(values: Sequence[float], form: str) -> str:
    """Mean, and half the range over the seeds."""
    if not values:
        return ""
    mean = format(float(np.mean(values)), form)
    return mean if len(values) == 1 else f"{mean} ± {format((max(values) - min(values)) / 2, form)}"


def table_rows(runs: Sequence[Run], labels: Sequence[LabelSet], name: str = "all") -> list[tuple[str, ...]]:
    """A line for each label set: L1, spread, chosen, median, recalls at 5, 10 and 20 degrees."""
    lines = []
    for each_set in labels:
        rows = _of(runs, each_set, name)
        lines.append(
            (
                each_set,
                _cell([row.l1 for row in rows], ".3f"),
                _cell([row.spread for row in rows], ".2f"),
                _cell([row.chosen for row in rows], ".0%"),
                _cell([row.median_deg for row in rows], ".1f"),
                *(_cell([row.recalls[i] for row in rows], ".0%") for i in range(len(RECALL_DEG))),
            )
        )
    return lines


COLUMNS = ("labels", "L1", "spread", "chosen", "median", *(f"R{limit:g}" for limit in RECALL_DEG))


def write_comparison_page(comparison: Comparison, runs: Sequence[Run], out: Path) -> None:
    """The page of a comparison; errors as in ``write_page``."""
    sets = comparison.labels
    objects = ", ".join(map(str, comparison.objects))
    text = (
        f"Objects {objects} of {comparison.models.name}, poses: {comparison.crops.poses}; {comparison.steps} steps of "
        f"{comparison.batch} crops, {comparison.seeds} seeds (mean ± half the range). L1 of the corners in sides of "
        "the crop; spread: of the predicted corners over that of the labels (the collapse as a number); angles to the "
        "nearest pose that looks the same, degrees."
    )
    sections = [Section(text=text, columns=COLUMNS, rows=table_rows(runs, sets))]
    curves: dict[str, Curve] = {}
    for labels in sets:
        of_set = [run.records for run in runs if run.labels == labels]
        steps = [float(record["step"]) for record in of_set[0]]
        curves[labels] = (steps, np.mean([[record["val_l1"] for record in log] for log in of_set], axis=0).tolist())
    sections.append(Section("Corner L1 on validation crops", svg=line_chart(curves, "step", "L1 / side", True)))
    if comparison.rendered is not None:
        count = runs[0].rows["rendered, all"].crops
        text = f"{count} crops of {comparison.rendered.name}; none of its images was learned from."
        sections.append(Section("On rendered images", text, COLUMNS, table_rows(runs, sets, "rendered, all")))
    if comparison.tuning is not None:
        text = f"The same crops after {comparison.tuning_steps} more steps on crops of {comparison.tuning.name}."
        sections.append(Section("After tuning", text, COLUMNS, table_rows(runs, sets, "tuned, all")))
    names = sorted({name for run in runs for name in run.rows} - {"all", "rendered, all", "tuned, all"}, key=_in_order)
    columns = ("recall at 10 degrees", *sets)
    recalls = [
        (name, *(_cell([row.recalls[1] for row in _of(runs, labels, name)], ".0%") for labels in sets))
        for name in names
    ]
    sections.append(Section("By object, elevation and margin", "", columns, recalls))
    sections.append(
        Section(
            "Predicted boxes",
            f"The first validation crops, seed 0: {', '.join(sets)}.",
            pictures=[f"pictures/{labels}.png" for labels in sets],
        )
    )
    write_page(out / "index.html", "Label sets compared", sections)


def _in_order(name: str) -> tuple[str, list[float]]:
    kind = re.sub(r"[-\d.,]+", "", name)
    return kind, [float(word) for word in name.replace(",", "").split() if word.lstrip("-").replace(".", "").isdigit()]
